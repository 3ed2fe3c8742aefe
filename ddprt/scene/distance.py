"""Exact distance from points to triangles."""

import math

import numpy as np

from ddprt.axes import Float64
from ddprt.compiled import compiled


@compiled
def distance_within(
    corners: Float64[np.ndarray, "triangles 3 3"],
    bounds: Float64[np.ndarray, "triangles 2 3"],
    point: Float64[np.ndarray, "3"],
    reach: float,
) -> float:
    """Distance from a point to the nearest triangle, or `reach` if none is nearer.

    Args:
      corners: metres.
      bounds: lowest and highest corner of each triangle's bounding box; most triangles are ruled out by it.
      point: metres.
      reach: an upper bound that is already known; infinity looks at all.
    """
    best = reach * reach
    for triangle in range(len(corners)):
        gap = 0.0
        for axis in range(3):
            outside = max(bounds[triangle, 0, axis] - point[axis], point[axis] - bounds[triangle, 1, axis], 0.0)
            gap += outside * outside
        if gap <= best:
            best = min(best, _squared(corners[triangle], point))
    return math.sqrt(best)


@compiled
def _squared(corners: Float64[np.ndarray, "3 3"], point: Float64[np.ndarray, "3"]) -> float:
    """Squared distance: to the plane where the foot lies inside the triangle, to the nearest edge elsewhere."""
    normal = _cross(corners[1] - corners[0], corners[2] - corners[0])
    length2 = _dot(normal, normal)
    inside = length2 > 0
    nearest = math.inf
    for first in range(3):
        edge, away = corners[(first + 1) % 3] - corners[first], point - corners[first]
        size2 = _dot(edge, edge)
        along = min(max(_dot(edge, away) / size2, 0.0), 1.0) if size2 > 0 else 0.0
        rest = away - along * edge
        nearest = min(nearest, _dot(rest, rest))
        inside = inside and _dot(_cross(edge, away), normal) >= 0
    height = _dot(point - corners[0], normal)
    return min(nearest, height * height / length2) if inside else nearest


@compiled
def _dot(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
