"""Which way triangles face, by what they share: vertices at one place, edges, all three corners.

In go corners named by place (see `welded`), out come masks over triangles; nothing here knows inside from outside.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ddprt.axes import Bool, Float, Int


def welded(positions: Float[np.ndarray, "vertices 3"]) -> Int[np.ndarray, " vertices"]:
    """A number per vertex, the same for vertices at exactly the same place."""
    order = np.lexsort(positions.T)
    fresh = (np.diff(positions[order], axis=0) != 0).any(axis=1)
    number = np.empty(len(positions), np.int64)
    number[order] = np.concatenate([[0], np.cumsum(fresh)])
    return number


def repeats(
    corners: Int[np.ndarray, "triangles 3"], keep: Bool[np.ndarray, " triangles"]
) -> tuple[Bool[np.ndarray, " triangles"], Int[np.ndarray, " opposed"]]:
    """Triangles that repeat an earlier one.

    Args:
      corners: place of each corner.
      keep: which triangles count at all.
    Returns:
      Mask of those whose three places an earlier triangle has, and for each of them that faces the other way that earlier one.
    """
    rank = np.argsort(corners, axis=1)
    odd = (rank[:, 0] - rank[:, 1]) % 3 == 1
    places = np.take_along_axis(corners, rank, axis=1)
    order = np.lexsort([*places.T, ~keep])
    equal = (np.diff(places[order], axis=0) == 0).all(axis=1) & keep[order[1:]] & keep[order[:-1]]
    group = np.concatenate([[0], np.cumsum(~equal)])
    first = order[np.searchsorted(group, group)]
    repeated = np.zeros(len(corners), bool)
    repeated[order] = first != order
    return repeated, first[odd[first] != odd[order]]


def winding(
    corners: Int[np.ndarray, "triangles 3"], areas: Float[np.ndarray, " triangles"]
) -> tuple[Bool[np.ndarray, " triangles"], int]:
    """Triangles to turn so that neighbours over an edge of exactly two agree.

    Each triangle stands twice in a graph, as it is and turned; an edge joins the two states that agree. An orientable
    surface then falls into two components, its two windings, of which the one with more area as it is wins (the first
    triangle's, at a tie); a one-sided surface is a single component.

    Args:
      corners: place of each corner, no two of a triangle the same.
      areas: of the triangles, any unit.
    Returns:
      Mask of triangles to turn, never more than half of a surface's area, and the number of one-sided surfaces.
    """
    count = len(corners)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    edge = np.minimum(start, end) * (corners.max() + 1) + np.maximum(start, end)
    order = np.argsort(edge, kind="stable")
    equal = np.concatenate([[False], np.diff(edge[order]) == 0, [False]])
    pair = equal[1:-1] & ~equal[:-2] & ~equal[2:]
    one, other = order[:-1][pair], order[1:][pair]
    clash = start[one] == start[other]
    a, b = one // 3, other // 3
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + count * clash, b + count * ~clash])
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(2 * count, 2 * count))
    label, mirror = connected_components(graph, directed=False)[1].reshape(2, count)
    surface, turned = np.minimum(label, mirror), label > mirror
    majority = np.bincount(surface, areas * np.where(turned, 1, -1)) > 1e-9 * np.bincount(surface, areas)
    # Where the two labels are one, nothing is `turned` and so nothing is a majority: such surfaces stay as they are.
    one_sided = label == mirror
    return turned ^ majority[surface], len(np.unique(surface[one_sided]))


def surfaces(corners: Int[np.ndarray, "triangles 3"]) -> tuple[Int[np.ndarray, " triangles"], Bool[np.ndarray, " surfaces"]]:
    """Which triangles hang together by edges, and whether each such surface is closed: every edge has a triangle on each side.

    Args:
      corners: place of each corner, wound alike.
    """
    count = len(corners)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    edges, edge = np.unique(np.sort(np.stack([start, end], 1), axis=1), axis=0, return_inverse=True)
    owner, number = np.repeat(np.arange(count), 3), edge.ravel()
    joined = coo_array((np.ones(3 * count, bool), (owner, count + number)), shape=(count + len(edges),) * 2)
    surface = connected_components(joined, directed=False)[1]
    balance = np.bincount(number, np.where(start < end, 1, -1), len(edges))
    is_closed = np.ones(surface.max() + 1, bool)
    is_closed[surface[count:][balance != 0]] = False
    _, own = np.unique(surface[:count], return_inverse=True)
    return own, is_closed[np.unique(surface[:count])]


def rims(corners: Int[np.ndarray, "triangles 3"]) -> tuple[int, int]:
    """How many edges lack a triangle on one side, and where the first of them starts: 3 * triangle + corner.

    Args:
      corners: place of each corner, wound alike.
    """
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    edges, number = np.unique(np.sort(np.stack([start, end], 1), axis=1), axis=0, return_inverse=True)
    is_open = np.bincount(number.ravel(), np.where(start < end, 1, -1), len(edges)) != 0
    found = np.flatnonzero(is_open[number.ravel()])
    return int(is_open.sum()), int(found[0]) if len(found) else -1
