"""Charts without xatlas, for what it cannot take: patches of like normals, laid flat by projection along their axis.

xatlas joins neighbours whose normals agree to 1e-4 into one "plane" and never looks at the whole. A fine smooth surface so
becomes a plane that is bent: a tube is folded flat onto itself, and a closed body has no border left and ends the process
(xatlas issue 146). `hard_parts` finds such surfaces, `cut` gives them charts in linear time.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ddprt.axes import Bool, Float, Float64, Int, Int32
from ddprt.compiled import compiled
from ddprt.scene.folds import folded, grouped

LARGEST = 21_000
"""Triangles of one connected surface that xatlas is given: its time grows with their number to the power 1.7."""
CONE, POCKET = 50.0, 65.0
"""Degrees from a patch's axis: of faces that it grows over, and of those that it nearly encloses or that would be crumbs."""
_PLANE = 1.05e-4  # xatlas joins where the cosine differs from 1 by 1e-4; the rest is for its rounding
_BENT = 5.0  # degrees: a plane of xatlas that bends further is none, and slow besides
_SMALLEST = 1.5e-7  # of a triangle's area, scene radius 1: xatlas drops those below 1.2e-7
_AROUND = 64  # faces whose mean normal is the axis: a rough surface's single normals say little
_CRUMB = 12  # faces: a patch of fewer joins a neighbour if it can


class Patches(NamedTuple):
    """Charts of triangles.

    Attributes:
      patch: of each triangle, from 0 up.
      axis: unit vector along which each patch was projected; all its normals lie within `POCKET` degrees of it.
      flat: corners of each triangle, each patch about its own origin; lengths as in space, areas of a patch in sum too.
    """

    patch: Int[np.ndarray, " triangles"]
    axis: Float64[np.ndarray, "patches 3"]
    flat: Float64[np.ndarray, "triangles 3 2"]


def hard_parts(
    corners: Float[np.ndarray, "triangles 3 3"], weld: Int[np.ndarray, "triangles 3"]
) -> tuple[Int32[np.ndarray, " triangles"], Bool[np.ndarray, " parts"]]:
    """The connected surfaces, and which of them xatlas must not see.

    Args:
      corners: as xatlas gets them, scene radius 1.
      weld: place of each corner.
    Returns:
      Surface of each triangle; mask of surfaces that are too large, bent planes to xatlas, or have triangles that it drops.
    """
    one, other = _edges(weld, exactly_two=False)
    count, part = _components(one, other, len(weld))
    normal, area = _faces(corners.astype(np.float64))
    flat = np.einsum("nd,nd->n", normal[one], normal[other]) > 1 - _PLANE
    planes, plane = _components(one[flat], other[flat], len(weld))
    mean = _sums(plane, normal * area[:, None], planes)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    bent = np.einsum("nd,nd->n", normal, mean[plane]) < np.cos(np.radians(_BENT))
    hard = np.bincount(part, minlength=count) > LARGEST
    hard[part[bent | (area < _SMALLEST)]] = True
    return part, hard


def cut(corners: Float64[np.ndarray, "triangles 3 3"], weld: Int[np.ndarray, "triangles 3"]) -> Patches:
    """Cuts triangles into patches that lie flat without overlap.

    A patch grows over neighbours breadth first while their normals stay in a cone. What overlaps nevertheless, like the
    turns of a spiral stair, grows anew at half its size until it does not.

    Args:
      corners: metres, or any unit.
      weld: place of each corner.
    """
    beside = _beside(weld)
    normal, area = _faces(corners)
    cosines = np.cos(np.radians(CONE)), np.cos(np.radians(POCKET))
    patch, axis = np.full(len(weld), -1, np.int64), np.zeros((len(weld), 3))
    within, most = np.zeros(len(weld), np.int64), np.full(len(weld), len(weld), np.int64)
    count = _grow(beside, normal, area, *cosines, within, most, patch, axis, 0)
    order, start = grouped(patch, count)
    _absorb(beside, normal, cosines[1], order, start, patch, axis)
    while True:
        used, patch = np.unique(patch, return_inverse=True)
        kept = _centred(patch, axis[used], normal, area)
        flat = _projected(corners, patch, kept, area, normal)
        bad = folded(flat, patch, 1e-9)
        if not bad.any():
            return Patches(patch, kept, flat)
        again = bad[patch]
        size = np.bincount(patch)[patch]
        within, most = np.where(again, patch, -1), np.maximum(size // 2, 1)
        axis[: len(kept)] = kept
        patch[again] = -1
        _grow(beside, normal, area, *cosines, within, most, patch, axis, len(kept))


def _edges(weld: np.ndarray, *, exactly_two: bool) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles that share an edge: neighbours in the edge's list, or the two where there are exactly two."""
    order, pair = _sides(weld, exactly_two)
    return order[:-1][pair] // 3, order[1:][pair] // 3


def _beside(weld: np.ndarray) -> np.ndarray:
    """The triangle over each side, -1 where there is none or more than one."""
    order, pair = _sides(weld, True)
    one, other = order[:-1][pair], order[1:][pair]
    beside = np.full(3 * len(weld), -1, np.int64)
    beside[one], beside[other] = other // 3, one // 3
    return beside.reshape(-1, 3)


def _sides(weld: np.ndarray, exactly_two: bool) -> tuple[np.ndarray, np.ndarray]:
    start, end = weld.ravel().astype(np.int64), np.roll(weld, -1, axis=1).ravel().astype(np.int64)
    edge = np.minimum(start, end) * (int(weld.max()) + 1) + np.maximum(start, end)
    order = np.argsort(edge, kind="stable")
    equal = np.concatenate([[False], np.diff(edge[order]) == 0, [False]])
    pair = equal[1:-1]
    return order, pair & ~equal[:-2] & ~equal[2:] if exactly_two else pair


def _faces(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = np.moveaxis(corners, 1, 0)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-300)[:, None], 0.5 * length


def _components(one: np.ndarray, other: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return number, label


def _sums(group: np.ndarray, vectors: np.ndarray, count: int) -> np.ndarray:
    return np.stack([np.bincount(group, vectors[:, axis], count) for axis in range(vectors.shape[1])], axis=1)


def _centred(patch: np.ndarray, axis: np.ndarray, normal: np.ndarray, area: np.ndarray) -> np.ndarray:
    """The mean normals in place of the axes where they lie better in the middle."""
    mean = _sums(patch, normal * area[:, None], len(axis))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    worst = np.ones((2, len(axis)))
    for which, candidate in enumerate((axis, mean)):
        np.minimum.at(worst[which], patch, np.einsum("nd,nd->n", normal, candidate[patch]))
    return np.where((worst[1] > worst[0])[:, None], mean, axis)


def _projected(corners: np.ndarray, patch: np.ndarray, axis: np.ndarray, area: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Corners seen along the axes, scaled so that each patch keeps its area."""
    helper = np.eye(3)[np.abs(axis).argmin(axis=1)]
    tangent = np.cross(helper, axis)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(axis, tangent)], axis=1)
    middle = _sums(patch, corners.mean(axis=1), len(axis)) / np.bincount(patch)[:, None]
    seen = np.bincount(patch, area * np.einsum("nd,nd->n", normal, axis[patch]))
    frame *= np.sqrt(np.bincount(patch, area) / np.maximum(seen, 1e-300))[:, None, None]
    return np.einsum("ncd,nkd->nck", corners - middle[patch][:, None], frame[patch])


@compiled
def _grow(
    beside: np.ndarray,
    normal: np.ndarray,
    area: np.ndarray,
    cone: float,
    pocket: float,
    within: np.ndarray,
    most: np.ndarray,
    patch: np.ndarray,
    axis: np.ndarray,
    count: int,
) -> int:
    """Patches for all triangles that have none (-1); a patch stays `within` one group and below `most` triangles."""
    n = len(patch)
    queue, seen = np.empty(n, np.int64), np.full(n, -1, np.int64)
    for seed in range(n):
        if patch[seed] >= 0:
            continue
        x, y, z = 0.0, 0.0, 0.0
        queue[0], seen[seed] = seed, seed
        head, tail = 0, 1
        while head < tail:
            f = queue[head]
            head += 1
            x, y, z = x + area[f] * normal[f, 0], y + area[f] * normal[f, 1], z + area[f] * normal[f, 2]
            for k in range(3):
                g = beside[f, k]
                if g < 0 or tail >= _AROUND or patch[g] >= 0 or seen[g] == seed or within[g] != within[seed]:
                    continue
                a, b = normal[g], normal[seed]
                if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > pocket:
                    seen[g], queue[tail] = seed, g
                    tail += 1
        length = np.sqrt(x * x + y * y + z * z)
        if x * normal[seed, 0] + y * normal[seed, 1] + z * normal[seed, 2] > cone * length > 0:
            x, y, z = x / length, y / length, z / length
        else:
            x, y, z = normal[seed, 0], normal[seed, 1], normal[seed, 2]
        axis[count, 0], axis[count, 1], axis[count, 2] = x, y, z
        patch[seed], queue[0] = count, seed
        head, tail = 0, 1
        while head < tail:
            f = queue[head]
            head += 1
            for k in range(3):
                g = beside[f, k]
                if g < 0 or patch[g] >= 0 or within[g] != within[seed] or tail >= most[seed]:
                    continue
                cosine = x * normal[g, 0] + y * normal[g, 1] + z * normal[g, 2]
                around = 0
                for j in range(3):
                    if beside[g, j] >= 0 and patch[beside[g, j]] == count:
                        around += 1
                if cosine > cone or (around > 1 and cosine > pocket):
                    patch[g], queue[tail] = count, g
                    tail += 1
        count += 1
    return count


@compiled
def _absorb(
    beside: np.ndarray,
    normal: np.ndarray,
    pocket: float,
    order: np.ndarray,
    start: np.ndarray,
    patch: np.ndarray,
    axis: np.ndarray,
) -> None:
    """Crumbs join the larger patch with which they share most sides, if its axis is near enough to all their normals."""
    for crumb in range(len(start) - 1):
        first, last = start[crumb], start[crumb + 1]
        if last - first >= _CRUMB:
            continue
        best, longest = -1, 0
        for i in range(first, last):
            for k in range(3):
                f = beside[order[i], k]
                other = patch[f] if f >= 0 else -1
                if other < 0 or other == crumb or start[other + 1] - start[other] < _CRUMB:
                    continue
                sides, fits = 0, True
                for j in range(first, last):
                    g = order[j]
                    x, y, z = axis[other]
                    if x * normal[g, 0] + y * normal[g, 1] + z * normal[g, 2] <= pocket:
                        fits = False
                        break
                    for m in range(3):
                        if beside[g, m] >= 0 and patch[beside[g, m]] == other:
                            sides += 1
                if fits and sides > longest:
                    best, longest = other, sides
        if best >= 0:
            for i in range(first, last):
                patch[order[i]] = best
