"""Sheets without thickness: triangles that lie back to back in one plane.

A ray meets both sides of such a sheet at one distance, so that which of them it finds is a matter of rounding. Where the sides
are cut alike they share their corners (see `checks`); where they are cut differently they must be looked for. Triangles are
sorted by their plane, then into strips and along these, and only those whose boxes meet are cut against each other.
"""

from dataclasses import replace

import numpy as np

from ddprt.axes import Bool, Float64
from ddprt.compiled import compiled
from ddprt.scene.mesh import Scene
from ddprt.scene.winding import repeats, welded

_CELL = 1 / 32
"""Side of a cell of planes, as a share of the radius. Feet of one plane differ by at most 5 radii times the error of their
normals. Corners rounded to float32 turn the normal of a triangle of height w by 1e-7 radii / w, so that the two sides share
a cell where both are higher than 1/7000 of the radius."""

_GRIDS = 4  # one more than there are axes: each axis parts two points nearer than a cell / 4 in at most one of them
_FACING = -0.9  # greatest cosine between normals that counts as opposite: slivers are turned by rounding


def backs(scene: Scene) -> Bool[np.ndarray, " triangles"]:
    """Triangles that `checked` has given to open surfaces of two-sided materials as their backs.

    They share their three places with an earlier triangle, which nothing else in a checked scene does.
    """
    return repeats(welded(scene.positions)[scene.triangles], np.ones(len(scene.triangles), bool))[0]


def without_backs(scene: Scene) -> Scene:
    """The scene with one-sided materials alone: backs are no surfaces of their own, they block light and absorb it."""
    kept = ~backs(scene)
    scene = scene.made_of(lambda material: replace(material, two_sided=False) if material.two_sided else material)
    if kept.all():
        return scene
    used, triangles = np.unique(scene.triangles[kept], return_inverse=True)
    return replace(
        scene,
        positions=scene.positions[used],
        triangles=triangles.reshape(-1, 3).astype(np.int32),
        normals=scene.normals[used],
        material=scene.material[kept],
        uv=None if scene.uv is None else scene.uv[used],
        colour=None if scene.colour is None else scene.colour[used],
        lightmap=None if scene.lightmap is None else scene.lightmap[used],
    )


def back_to_back(corners: Float64[np.ndarray, "triangles 3 3"], tolerance: float) -> Bool[np.ndarray, " triangles"]:
    """Triangles that another one, facing the opposite way, lies on.

    Args:
      corners: about the middle of their bounding box, metres.
      tolerance: metres; sides count as one plane where they are nowhere further apart, and as overlapping where they do so
        in a strip that is wider.
    """
    found = np.zeros(len(corners), bool)
    low, high = corners.min(1) - tolerance, corners.max(1)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    radius = max(float(np.linalg.norm(corners, axis=2).max()), 1e-300)
    # The foot of the perpendicular from one point names a plane, whichever way that faces. Planes through the point itself
    # share a cell, so it stands outside, askew.
    away = corners.mean(1) / radius - [1.37, 1.03, 0.71]
    height = np.einsum("nd,nd->n", normals, away)
    foot = height[:, None] * normals / _CELL
    cells: list[np.ndarray] = []
    for grid in range(_GRIDS):
        x, y, z = np.floor(foot + grid / _GRIDS).astype(np.int64).T
        cell = ((x << 20) + y << 20) + z
        order = np.argsort(cell, kind="stable")
        first = np.flatnonzero(np.diff(cell[order], prepend=cell[order[0]] - 1))
        # Next to the point a height's sign says nothing.
        both = np.logical_or.reduceat(height[order] > -_CELL, first) & np.logical_or.reduceat(height[order] < _CELL, first)
        count = np.diff(first, append=len(order))
        both &= count > 1
        for other in cells:  # what shared a cell before has been compared
            both &= np.minimum.reduceat(other[order], first) < np.maximum.reduceat(other[order], first)
        cells.append(cell)
        if both.any():
            members, start = order[np.repeat(both, count)], np.concatenate([[0], np.cumsum(count[both])])
            along, across = _axes(normals[members], low[members], high[members], start[:-1])
            group = np.repeat(np.arange(len(along)), count[both])
            members = members[np.lexsort((low[members, along[group]], group))]
            _compare(corners, normals, low, high, members, start, along, across, tolerance, found)
    return found


def _axes(normals: np.ndarray, low: np.ndarray, high: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each group the axis along which its boxes are shortest as a share of it, and the other one in its plane."""
    extent = np.maximum.reduceat(high, first) - np.minimum.reduceat(low, first)
    share = np.add.reduceat(high - low, first) / extent
    up = np.add.reduceat(np.abs(normals), first).argmax(1)
    share[np.arange(len(up)), up] = np.inf
    along, across, _ = share.argsort(1).T
    return along, across


@compiled
def _compare(
    corners: np.ndarray,
    normals: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    members: np.ndarray,
    start: np.ndarray,
    along_of: np.ndarray,
    across_of: np.ndarray,
    tolerance: float,
    found: np.ndarray,
) -> None:
    """Compares the triangles of each group whose boxes meet: strip by strip, and along each strip in order."""
    for group in range(len(start) - 1):
        mine, along, across = members[start[group] : start[group + 1]], along_of[group], across_of[group]
        up = 3 - along - across
        begin, stop, width = np.inf, -np.inf, 0.0
        for i in mine:
            begin, stop = min(begin, low[i, across]), max(stop, high[i, across])
            width += (high[i, across] - low[i, across]) / len(mine)
        strips = min(int((stop - begin) / width) + 1, len(mine))
        width = (stop - begin) / strips
        # First how many lie in each strip, then which: a triangle stands in all that it reaches.
        end = np.zeros(strips + 1, np.int64)
        entries = np.empty(0, np.int64)
        for fill in range(2):
            if fill:
                end = np.cumsum(end)
                entries = np.empty(end[-1], np.int64)
            for i in mine:
                last = min(int((high[i, across] - begin) / width), strips - 1)
                for strip in range(min(int((low[i, across] - begin) / width), strips - 1), last + 1):
                    if fill:
                        entries[end[strip]] = i
                        end[strip] += 1
                    else:
                        end[strip + 1] += 1
        for strip in range(strips):
            for at in range(end[strip - 1] if strip else 0, end[strip]):
                i = entries[at]
                for other in range(at + 1, end[strip]):
                    j = entries[other]
                    if low[j, along] > high[i, along]:
                        break
                    if (found[i] and found[j]) or max(low[i, across], low[j, across]) > min(high[i, across], high[j, across]):
                        continue
                    if max(low[i, up], low[j, up]) > min(high[i, up], high[j, up]) or _dot(normals[i], normals[j]) > _FACING:
                        continue
                    if _lies_on(corners[j], corners[i], normals[i], tolerance):
                        found[i] = found[j] = True


@compiled
def _lies_on(one: np.ndarray, other: np.ndarray, normal: np.ndarray, tolerance: float) -> bool:
    """Whether one triangle lies above another in a strip wider than the tolerance, and nowhere further off than that."""
    polygon, clipped = np.empty((24, 3)), np.empty((24, 3))  # six corners, but slivers may be dented by rounding
    polygon[:3] = one
    count = 3
    for edge in range(3):
        begin, end = other[edge], other[(edge + 1) % 3]
        kept = 0
        for k in range(count):
            here, there = polygon[k], polygon[(k + 1) % count]
            depth, next_depth = _turn(begin, end, here, normal), _turn(begin, end, there, normal)
            if depth >= 0:
                clipped[kept] = here
                kept += 1
            if (depth >= 0) != (next_depth >= 0):
                share = depth / (depth - next_depth)
                for axis in range(3):
                    clipped[kept, axis] = here[axis] + share * (there[axis] - here[axis])
                kept += 1
        if kept == 0:
            return False
        polygon, clipped, count = clipped, polygon, kept
    area = rim = 0.0
    for k in range(count):
        here, there = polygon[k], polygon[(k + 1) % count]
        above = square = 0.0
        for axis in range(3):
            above += normal[axis] * (here[axis] - other[0, axis])
            square += (there[axis] - here[axis]) ** 2
        if abs(above) > tolerance:
            return False
        area += abs(_turn(polygon[0], here, there, normal))  # twice, as its rim is twice as long as the strip
        rim += np.sqrt(square)
    return area > tolerance * rim


@compiled
def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray, normal: np.ndarray) -> float:
    """Twice the area of a triangle seen along a normal, positive where it is counter-clockwise."""
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    p, q, r = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return normal[0] * (y * r - z * q) + normal[1] * (z * p - x * r) + normal[2] * (x * q - y * p)


@compiled
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
