"""Pictures in, linear factors out: the only place where the sRGB curve is undone."""

import io

import numpy as np
from PIL import Image

from ddprt.axes import Float, Float32


def srgb_to_linear(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Undo the sRGB transfer curve; values 0 to 1 in, linear values 0 to 1 out. Source: IEC 61966-2-1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_image(source: bytes | Image.Image) -> Float32[np.ndarray, "height width 3"]:
    """Decode an sRGB picture (PNG, JPEG, WebP, ...) to a linear factor.

    Args:
      source: the file's bytes, or an image that Pillow has opened.
    Returns:
      Linear Rec.709, 0 to 1, row 0 at the top; alpha is dropped, a grey picture is repeated over the channels.
    Raises:
      OSError: Pillow cannot decode it.
    """
    image = _opened(source)
    if image.mode.startswith("I"):
        # Pillow would clip 16-bit grey at 255 when it converts.
        grey = srgb_to_linear(np.clip(np.asarray(image) / 65535.0, 0.0, 1.0))
        return np.repeat(grey[..., None], 3, axis=2).astype(np.float32)
    curve = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    return curve[np.asarray(image.convert("RGB"))]


def plain_image(source: bytes | Image.Image) -> Float32[np.ndarray, "height width 4"]:
    """Decode a picture whose numbers are no colours: as stored, 0 to 1, row 0 at the top; alpha 1 where it has none.

    Raises:
      OSError: Pillow cannot decode it.
    """
    return np.asarray(_opened(source).convert("RGBA")) / np.float32(255)


def _opened(source: bytes | Image.Image) -> Image.Image:
    return Image.open(io.BytesIO(source)) if isinstance(source, bytes) else source
