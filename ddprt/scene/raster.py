"""Which piece of which triangle lies in which texel, exactly.

Triangles are clipped to the texel grid as polygons, so texel areas add up to the mesh area to rounding, and every sample
taken from a piece lies on the surface and inside its texel.
"""

from dataclasses import dataclass

import numpy as np

from ddprt.axes import Float, Float64, Int32, Int64
from ddprt.compiled import compiled

_SLIVER = 1e-9  # pieces below this share of a texel are dropped
_CORNERS = 13  # a clipped triangle has at most 7; 13 even where rounding bends it: each side makes half as many again


@dataclass(frozen=True)
class Pieces:
    """Small triangles, each inside one texel and one mesh triangle.

    Attributes:
      texel: row * width + column.
      triangle: index of the mesh triangle.
      barycentric: weights of its corners at the piece's three corners.
      share: the piece's area as a share of the mesh triangle's.
      uv_area: in texels.
    """

    texel: Int64[np.ndarray, " pieces"]
    triangle: Int32[np.ndarray, " pieces"]
    barycentric: Float64[np.ndarray, "pieces 3 3"]
    share: Float64[np.ndarray, " pieces"]
    uv_area: Float64[np.ndarray, " pieces"]


def rasterise(uv: Float64[np.ndarray, "triangles 3 2"], resolution: int) -> Pieces:
    """Cuts triangles along the texel grid.

    Args:
      uv: corners in texels (x to the right, y down), inside [0, resolution].
      resolution: texels per side.
    Returns:
      The pieces, ordered by texel and, within one, by triangle. Triangles without area on the atlas have none.
    """
    uv = np.ascontiguousarray(uv)
    end = np.zeros(resolution**2, np.int64)
    _cut(uv, resolution, end, _room(0))
    count = end.copy()
    np.cumsum(end, out=end)
    pieces = _room(int(end[-1]))
    _cut(uv, resolution, end - count, pieces)
    return Pieces(np.repeat(np.arange(resolution**2), count), *pieces)


def interpolate(
    barycentric: Float64[np.ndarray, "n points 3"],
    triangle: Int32[np.ndarray, " n"],
    corners: Float64[np.ndarray, "triangles 3 3"],
    dtype: type[np.floating] = np.float64,
) -> Float[np.ndarray, "n points 3"]:
    """Vectors at points of triangles, from vectors at the corners of every triangle and the points' weights of them."""
    vectors = np.empty(barycentric.shape, dtype)
    _blend(barycentric, triangle, corners, vectors)
    return vectors


def _room(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return np.empty(count, np.int32), np.empty((count, 3, 3)), np.empty(count), np.empty(count)


@compiled
def _cut(
    uv: np.ndarray, resolution: int, place: np.ndarray, pieces: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """Writes each piece where `place` says for its texel, moving that on by one; pieces beyond the room are only counted.

    Counting and writing are the same instructions, so that they agree to the last bit on what a sliver is.
    """
    triangle, barycentric, share, uv_area = pieces
    columns, cell, spare = np.empty((resolution, _CORNERS, 2)), np.empty((_CORNERS, 2)), np.empty((_CORNERS, 2))
    count, top, bottom = np.zeros((3, resolution), np.int64)
    for index in range(len(uv)):
        a, b, c = _point(uv[index], 0), _point(uv[index], 1), _point(uv[index], 2)
        whole = _cross(a, b, c)
        if whole == 0:
            continue
        left, right = _span(uv[index], 3, 0, resolution)
        for x in range(left, right):
            count[x] = _between(uv[index], 3, 0, x, spare, columns[x])
            top[x], bottom[x] = _span(columns[x], count[x], 1, resolution)
        for y in range(top[left:right].min(), bottom[left:right].max()):
            for x in range(left, right):
                if not top[x] <= y < bottom[x]:
                    continue
                corners = _between(columns[x], count[x], 1, y, spare, cell)
                for k in range(1, corners - 1):
                    piece = _point(cell, 0), _point(cell, k), _point(cell, k + 1)
                    area = 0.5 * abs(_cross(*piece))
                    if area <= _SLIVER:
                        continue
                    at = place[y * resolution + x]
                    place[y * resolution + x] = at + 1
                    if at >= len(triangle):
                        continue
                    triangle[at], share[at], uv_area[at] = index, 2 * area / abs(whole), area
                    for corner, point in enumerate(piece):
                        second, third = _cross(a, point, c) / whole, _cross(a, b, point) / whole
                        for side, weight in enumerate((1 - second - third, second, third)):
                            barycentric[at, corner, side] = min(max(weight, 0.0), 1.0)


@compiled
def _between(polygon: np.ndarray, count: int, axis: int, low: int, spare: np.ndarray, kept: np.ndarray) -> int:
    """What of a polygon lies between low and low + 1 on an axis, and how many corners it has."""
    return _clip(spare, _clip(polygon, count, axis, 1.0, low, spare), axis, -1.0, low + 1, kept)


@compiled
def _clip(polygon: np.ndarray, count: int, axis: int, sign: float, bound: float, kept: np.ndarray) -> int:
    """Sutherland-Hodgman: what of a polygon lies where sign * (coordinate - bound) >= 0, and how many corners it has."""
    found, other = 0, 1 - axis
    for k in range(count):
        after = k + 1 if k + 1 < count else 0
        depth, next_depth = sign * (polygon[k, axis] - bound), sign * (polygon[after, axis] - bound)
        if depth >= 0:
            kept[found, 0], kept[found, 1] = _point(polygon, k)
            found += 1
        if (depth >= 0) != (next_depth >= 0):
            step = depth / (depth - next_depth)
            kept[found, other] = polygon[k, other] + step * (polygon[after, other] - polygon[k, other])
            kept[found, axis] = bound
            found += 1
    return found


@compiled
def _span(polygon: np.ndarray, count: int, axis: int, resolution: int) -> tuple[int, int]:
    """First texel of a polygon on an axis, and the one behind its last."""
    low, high = float(resolution), 0.0
    for k in range(count):
        low, high = min(low, polygon[k, axis]), max(high, polygon[k, axis])
    return max(int(low), 0), min(int(np.ceil(high)), resolution)


@compiled
def _point(polygon: np.ndarray, k: int) -> tuple[float, float]:
    return polygon[k, 0], polygon[k, 1]


@compiled
def _cross(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@compiled
def _blend(weights: np.ndarray, triangle: np.ndarray, corners: np.ndarray, vectors: np.ndarray) -> None:
    for n in range(len(triangle)):
        for k in range(weights.shape[1]):
            first, second, third = weights[n, k, 0], weights[n, k, 1], weights[n, k, 2]
            for axis in range(3):
                vectors[n, k, axis] = (
                    first * corners[triangle[n], 0, axis]
                    + second * corners[triangle[n], 1, axis]
                    + third * corners[triangle[n], 2, axis]
                )
