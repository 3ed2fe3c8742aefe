"""Exact distance from points to triangles."""

import numpy as np

from ddprt.axes import Float64


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
    gap = np.maximum(np.maximum(bounds[:, 0] - point, point - bounds[:, 1]), 0)
    near = np.einsum("nd,nd->n", gap, gap) <= reach**2
    if not near.any():
        return reach
    return min(reach, float(np.sqrt(_squared(corners[near], point).min())))


def _squared(corners: Float64[np.ndarray, "n 3 3"], point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " n"]:
    """Squared distances: to the plane where the foot lies inside the triangle, to the nearest edge elsewhere."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    length2 = np.einsum("nd,nd->n", normal, normal)
    inside = length2 > 0
    nearest = np.full(len(corners), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, away = end - start, point - start
        size2 = np.einsum("nd,nd->n", edge, edge)
        along = np.divide(np.einsum("nd,nd->n", edge, away), size2, out=np.zeros_like(size2), where=size2 > 0)
        rest = away - np.clip(along, 0, 1)[:, None] * edge
        nearest = np.minimum(nearest, np.einsum("nd,nd->n", rest, rest))
        inside &= np.einsum("nd,nd->n", np.cross(edge, away), normal) >= 0
    height = np.einsum("nd,nd->n", point - a, normal)
    plane = np.divide(height**2, length2, out=np.full_like(height, np.inf), where=inside)
    return np.minimum(nearest, plane)
