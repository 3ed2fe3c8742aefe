"""Charts grown outwards, smoothly, so that bilinear filtering and block compression never meet black.

The fill is linear in the values for a fixed mask, so filling the bases is the same as filling every relit map.
"""

import numpy as np

from ddprt.axes import Bool, Float


def fill_gutter(
    image: Float[np.ndarray, "height width channels"], covered: Bool[np.ndarray, "height width"], texels: int
) -> Float[np.ndarray, "height width channels"]:
    """Extends charts by `texels` rings, each the mean of the neighbours that are already filled."""
    filled = np.where(covered[..., None], image, 0)
    known = covered.astype(image.dtype)
    for _ in range(texels):
        total, count = _neighbours(filled), _neighbours(known[..., None])
        ring = (known == 0) & (count[..., 0] > 0)
        filled[ring] = total[ring] / count[ring]
        known[ring] = 1
    return filled


def _neighbours(image: np.ndarray) -> np.ndarray:
    """Sum over the 3 x 3 texels around each texel, nothing beyond the border."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    height, width = image.shape[:2]
    rows = padded[:height] + padded[1 : height + 1] + padded[2:]
    return rows[:, :width] + rows[:, 1 : width + 1] + rows[:, 2:]
