"""Denoising of training maps, for who asks for it: the only door to Open Image Denoise (extra `denoise`).

It is not linear and has a bias nobody can bound, so held-out maps never see it.
"""

from collections.abc import Callable

import numpy as np

from ddprt.axes import Float32
from ddprt.errors import UserError
from ddprt.scene.atlas import Atlas
from ddprt.scene.gutter import fill_gutter

_MARGIN = 16  # texels that charts are extended by, so that the filter never meets black


def find_denoiser() -> Callable[..., np.ndarray]:
    """The filter, asked for before a long bake begins.

    Raises:
      UserError: pyoidn is missing.
    """
    try:
        from pyoidn import denoise
    except ImportError as error:
        raise UserError(f'transport.denoise: got {error}, expected pyoidn; pip install "ddprt[denoise]"') from None
    return denoise


def denoised(atlas: Atlas, light: Float32[np.ndarray, "texels 3"]) -> Float32[np.ndarray, "texels 3"]:
    """A lightmap after the filter for lightmaps; brightness is scaled to about 1 on the way, since the filter has a range."""
    mean = float(light.mean(dtype=float))
    if mean <= 0:
        return light
    image = fill_gutter(atlas.image(light / np.float32(mean)), atlas.slot >= 0, _MARGIN)
    smooth = find_denoiser()(np.ascontiguousarray(image), filter_type="RTLightmap")
    return np.asarray(smooth.reshape(-1, 3)[atlas.texel] * np.float32(mean), np.float32)
