"""Which piece of which triangle lies in which texel, exactly.

Triangles are clipped to the texel grid as polygons, so texel areas add up to the mesh area to rounding, and every sample
taken from a piece lies on the surface and inside its texel.
"""

from dataclasses import dataclass

import numpy as np

from ddprt.axes import Float64, Int, Int32, Int64

_PAIRS = 1 << 17  # triangle-texel pairs clipped at once: bounds the memory at about 50 MB
_SLIVER = 1e-9  # pieces below this share of a texel are dropped
_CORNERS = 12  # a clipped triangle has at most 7; rounding of slivers can repeat a few


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
      The pieces, ordered by texel. Triangles without area on the atlas have none.
    """
    a, b, c = np.moveaxis(uv, 1, 0)
    doubled = np.abs(_cross(b - a, c - a))
    low = np.clip(np.floor(uv.min(1)), 0, resolution - 1).astype(np.int64)
    high = np.clip(np.ceil(uv.max(1)), low + 1, resolution).astype(np.int64)
    wide, tall = (high - low).T
    pairs = np.where(doubled > 0, wide * tall, 0)
    ends = np.cumsum(pairs)
    parts = []
    for first in range(0, int(ends[-1]), _PAIRS):
        pair = np.arange(first, min(first + _PAIRS, int(ends[-1])))
        triangle = np.searchsorted(ends, pair, side="right")
        within = pair - (ends[triangle] - pairs[triangle])
        corner = low[triangle] + np.stack([within % wide[triangle], within // wide[triangle]], 1)
        polygon, count = _clip(uv[triangle], corner.astype(float))
        parts.append(_fan(polygon, count, triangle, corner[:, 1] * resolution + corner[:, 0], uv, doubled))
    pieces = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(pieces[0], kind="stable")
    return Pieces(*(column[order] for column in pieces))


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def _clip(triangle: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sutherland-Hodgman against the unit square at `corner`, for all pairs at once: polygons padded to _CORNERS."""
    n = len(triangle)
    polygon = np.zeros((n, _CORNERS, 2))
    polygon[:, :3] = triangle
    count = np.full(n, 3)
    slots = np.arange(_CORNERS)
    for axis in (0, 1):
        for sign, bound in ((1.0, corner[:, axis]), (-1.0, corner[:, axis] + 1)):
            inside_by = sign * (polygon[:, :, axis] - bound[:, None])
            alive = slots < count[:, None]
            after = np.where(slots + 1 < count[:, None], slots + 1, 0)
            after_by = np.take_along_axis(inside_by, after, 1)
            kept = alive & (inside_by >= 0)
            crossing = alive & ((inside_by >= 0) != (after_by >= 0))
            step = np.where(crossing, inside_by / np.where(crossing, inside_by - after_by, 1), 0)
            following = np.take_along_axis(polygon, after[..., None], 1)
            cut = polygon + step[..., None] * (following - polygon)
            cut[..., axis] = np.where(crossing, bound[:, None], cut[..., axis])
            added = kept.astype(np.int8) + crossing
            place = np.cumsum(added, 1) - added
            clipped = np.zeros_like(polygon)
            row, slot = np.nonzero(kept)
            clipped[row, place[row, slot]] = polygon[row, slot]
            row, slot = np.nonzero(crossing)
            clipped[row, place[row, slot] + kept[row, slot]] = cut[row, slot]
            polygon, count = clipped, added.sum(1)
    return polygon, count


def _fan(
    polygon: np.ndarray,
    count: np.ndarray,
    triangle: Int[np.ndarray, " n"],
    texel: np.ndarray,
    uv: np.ndarray,
    doubled: np.ndarray,
) -> tuple[np.ndarray, Int32[np.ndarray, " m"], np.ndarray, np.ndarray, np.ndarray]:
    """Polygons to triangles, with barycentric weights relative to the mesh triangle."""
    row, slot = np.nonzero(np.arange(1, _CORNERS - 1) + 1 < count[:, None])
    corners = np.stack([polygon[row, 0], polygon[row, slot + 1], polygon[row, slot + 2]], 1)
    area = 0.5 * np.abs(_cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    row, corners, area = row[area > _SLIVER], corners[area > _SLIVER], area[area > _SLIVER]
    mesh = triangle[row]
    a, b, c = (uv[mesh, k][:, None] for k in range(3))
    whole = _cross(b - a, c - a)
    second, third = _cross(corners - a, c - a) / whole, _cross(b - a, corners - a) / whole
    barycentric = np.clip(np.stack([1 - second - third, second, third], -1), 0, 1)
    return texel[row], mesh.astype(np.int32), barycentric, 2 * area / doubled[mesh], area
