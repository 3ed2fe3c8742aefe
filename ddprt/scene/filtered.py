"""Means of textures over pieces of a surface, so that what is finer than a texel is neither missed nor counted twice.

A piece is cut into equal small triangles, and the texture averaged over a box of each one's size about its middle: by sums
over rectangles, whose cost does not depend on how many pixels lie in them. A box of one pixel gives the bilinear lookup.

Reference: Crow, "Summed-Area Tables for Texture Mapping", SIGGRAPH 1984.
"""

import numpy as np

from ddprt.axes import Float64, Int
from ddprt.compiled import compiled
from ddprt.scene.mesh import Scene

_FINEST = 4  # halvings of a piece's sides, at most: boxes reach a thirty-second of its width beyond its rim


def mean_albedo(
    scene: Scene, triangle: Int[np.ndarray, " pieces"], weights: Float64[np.ndarray, "pieces 3 3"]
) -> Float64[np.ndarray, "pieces 3"]:
    """Linear albedo of pieces, each the mean over its area.

    Args:
      scene: its materials.
      triangle: that each piece is part of.
      weights: of its corners, at each of the piece's.
    """
    material = scene.material[triangle]
    albedo = np.array([entry.albedo for entry in scene.materials])[material]
    for index, entry in enumerate(scene.materials):
        chosen = np.flatnonzero(material == index)
        if entry.texture is not None and scene.uv is not None and len(chosen):
            corners = np.einsum("nkc,ncd->nkd", weights[chosen], scene.uv[scene.triangles[triangle[chosen]]])
            albedo[chosen] *= area_mean(entry.texture, corners)
    if scene.colour is not None:  # linear over a piece, so that its middle is its mean
        albedo *= np.einsum("nc,ncd->nd", weights.mean(1), scene.colour[scene.triangles[triangle]])
    return albedo


def area_mean(image: np.ndarray, corners: Float64[np.ndarray, "n 3 2"]) -> Float64[np.ndarray, "n channels"]:
    """Means of a repeating image over triangles of texture coordinates.

    Args:
      image: (height, width, channels), row 0 at the top.
      corners: origin top-left, the image from 0 to 1.
    """
    height, width = image.shape[:2]
    pixels = (corners - np.floor(corners.mean(1, keepdims=True))) * [width, height]
    extent = np.ptp(pixels, axis=1)
    depth = np.clip(np.ceil(np.log2(np.maximum(2 * extent.max(1), 1))), 0, _FINEST).astype(int)
    box = np.maximum(extent / 2.0 ** depth[:, None], 1)
    means = np.zeros((len(corners), image.shape[2]))
    for channel in range(image.shape[2]):
        total = np.zeros((height + 1, width + 1))
        np.cumsum(np.cumsum(image[..., channel], 0, dtype=np.float64), 1, out=total[1:, 1:])
        for level in np.unique(depth):
            part = np.flatnonzero(depth == level)
            means[part, channel] = _averaged(total, pixels[part], box[part], _middles(int(level)))
    return means


def _middles(depth: int) -> Float64[np.ndarray, "parts 3"]:
    """Middles of the equal triangles that a triangle is cut into, as weights of its corners."""
    count = 1 << depth
    first, second = np.divmod(np.arange(count**2), count)
    up = first + second < count
    # What of the square of cells lies beyond the triangle stands for those that are upside down.
    first, second = np.where(up, first, count - 1 - first), np.where(up, second, count - 1 - second)
    a, b = (first + np.where(up, 1, 2) / 3) / count, (second + np.where(up, 1, 2) / 3) / count
    return np.stack([1 - a - b, a, b], 1)


@compiled
def _averaged(total: np.ndarray, corners: np.ndarray, box: np.ndarray, middles: np.ndarray) -> np.ndarray:
    means = np.zeros(len(corners))
    for i in range(len(corners)):
        wide, high = box[i]
        for part in range(len(middles)):
            x, y = -wide / 2, -high / 2
            for corner in range(3):
                x += middles[part, corner] * corners[i, corner, 0]
                y += middles[part, corner] * corners[i, corner, 1]
            inside = _sum(total, x + wide, y + high) - _sum(total, x, y + high)
            means[i] += inside - _sum(total, x + wide, y) + _sum(total, x, y)
        means[i] /= wide * high * len(middles)
    return means


@compiled
def _sum(total: np.ndarray, x: float, y: float) -> float:
    """Sum of a repeating image from its corner to a place, pixels being squares; negative to the left or above."""
    height, width = total.shape[0] - 1, total.shape[1] - 1
    across, down = np.floor(x / width), np.floor(y / height)
    x, y = min(max(x - across * width, 0.0), float(width)), min(max(y - down * height, 0.0), float(height))
    row, column = min(int(y), height - 1), min(int(x), width - 1)
    fx, fy = x - column, y - row
    left = (1 - fy) * total[row, column] + fy * total[row + 1, column]
    right = (1 - fy) * total[row, column + 1] + fy * total[row + 1, column + 1]
    below = (1 - fx) * total[height, column] + fx * total[height, column + 1]
    beside = (1 - fy) * total[row, width] + fy * total[row + 1, width]
    return across * down * total[height, width] + across * beside + down * below + (1 - fx) * left + fx * right
