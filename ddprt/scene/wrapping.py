"""Textures that do not repeat, made into ones that do: the only lookup there is repeats.

A texture that is clamped or mirrored is rolled out over all that its surface shows of it, with as much beyond as the lookup
reaches, and the texture coordinates are moved to match. What is seen stays the same, pixel by pixel.
"""

from collections.abc import Mapping

import numpy as np

from ddprt.axes import Float64

CLAMP, MIRROR, REPEAT = 33071, 33648, 10497
"""Wrap modes as glTF numbers them."""
LARGEST = 1 << 25
"""Pixels that a texture may be rolled out to."""


def unrolled(
    images: Mapping[str, np.ndarray], modes: Mapping[str, tuple[int, int]], uv: Float64[np.ndarray, "n 2"]
) -> tuple[dict[str, np.ndarray], Float64[np.ndarray, "n 2"]] | None:
    """Images and texture coordinates that show, repeated, what these show by their own modes.

    Args:
      images: of one material, (height, width, ...) each.
      modes: of those that do not repeat both ways: across and down.
      uv: all places that the material is looked up at: corners of its triangles, finite.
    Returns:
      Both, changed; None where an image would get too large.
    """
    found, moved = dict(images), uv.copy()
    for axis in (0, 1):
        # A single pixel is the same everywhere.
        sized = {name: image.shape[1 - axis] for name, image in images.items() if image.shape[0] * image.shape[1] > 1}
        wrap = {name: modes.get(name, (REPEAT, REPEAT))[axis] for name in sized}
        if all(mode == REPEAT for mode in wrap.values()):
            continue
        # All images keep whole pixels if the cuts lie on a grid that they have in common.
        grain, half = int(np.gcd.reduce(list(sized.values()))), 0.5 / min(sized.values())
        low, high = uv[:, axis].min() - half, uv[:, axis].max() + half
        first, last = int(np.floor(low * grain)), int(np.ceil(high * grain))
        for name, size in sized.items():
            pixels = (last - first) * size // grain
            if pixels * found[name].shape[axis] > LARGEST:
                return None
            index = np.arange(pixels) + first * (size // grain)
            found[name] = np.take(found[name], _source(index, size, wrap[name]), axis=1 - axis)
        moved[:, axis] = (uv[:, axis] * grain - first) / (last - first)
    return found, moved


def _source(index: np.ndarray, size: int, mode: int) -> np.ndarray:
    """The pixel that is shown at each place of an endless row."""
    if mode == CLAMP:
        return np.clip(index, 0, size - 1)
    if mode == MIRROR:
        there = index % (2 * size)
        return np.where(there < size, there, 2 * size - 1 - there)
    return index % size
