"""Polygons into triangles that cover them once, whatever their outline.

Most polygons are fans: all triangles from their first corner turn the same way, once round at most. The others lose their ears,
corners whose triangle holds no other corner, one by one. An outline that crosses itself has no inside that all would agree on.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float, Int

_FLAT = 1e-9  # of a polygon's own size: areas below are none


@dataclass(frozen=True)
class Cut:
    """Polygons as triangles, polygon by polygon.

    Attributes:
      triangles: numbers of corners, counted through all polygons.
      owner: polygon of each triangle, ascending.
      fans: polygons that every triangle of some area from the first corner covers once.
      crossing: polygons whose outline crosses itself; they are fans all the same, whose triangles overlap.
    """

    triangles: Int[np.ndarray, "triangles 3"]
    owner: Int[np.ndarray, " triangles"]
    fans: Bool[np.ndarray, " polygons"]
    crossing: Bool[np.ndarray, " polygons"]


def cut_polygons(corners: Float[np.ndarray, "corners 3"], sizes: Int[np.ndarray, " polygons"]) -> Cut:
    """Triangles of polygons, which keep their winding; what has fewer than three corners has none.

    Args:
      corners: of all polygons one after the other, metres; none need be flat.
      sizes: how many corners each has.
    """
    starts = np.cumsum(sizes) - sizes
    fans, crossing = np.zeros(len(sizes), bool), np.zeros(len(sizes), bool)
    triangles, owner = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(sizes[sizes > 2]):
        own = np.flatnonzero(sizes == size)
        outlines = corners[starts[own, None] + np.arange(size)]
        fans[own] = _fans(outlines)
        fan = np.stack([np.zeros(size - 2, int), np.arange(1, size - 1), np.arange(2, size)], 1)
        pieces = np.tile(fan, (len(own), 1, 1))
        for row in np.flatnonzero(~fans[own]):
            found = _without_ears(outlines[row])
            crossing[own[row]] = found is None
            pieces[row] = fan if found is None else found
        triangles.append((pieces + starts[own, None, None]).reshape(-1, 3))
        owner.append(np.repeat(own, size - 2))
    order = np.argsort(np.concatenate(owner), kind="stable")
    return Cut(np.concatenate(triangles)[order], np.concatenate(owner)[order], fans, crossing)


def notes_on(cut: Cut, corners: Float[np.ndarray, "corners 3"], sizes: Int[np.ndarray, " polygons"]) -> list[str]:
    """What a reader is to know about its polygons, a line each."""
    notes = []
    if lines := np.count_nonzero(sizes < 3):
        notes.append(f"{lines} faces of fewer than three corners left out")
    if cut.crossing.any():
        first = int(np.flatnonzero(cut.crossing)[0])
        x, y, z = corners[sizes[:first].sum()].round(4).tolist()
        notes.append(
            f"{np.count_nonzero(cut.crossing)} polygons cross themselves, the first at ({x:g}, {y:g}, {z:g}) m: their "
            "triangles overlap; cut them in the program that made them"
        )
    return notes


def _fans(outlines: Float[np.ndarray, "polygons corners 3"]) -> Bool[np.ndarray, " polygons"]:
    """Whether triangles from the first corner cover each polygon once: all turn one way, and all together less than once."""
    spokes = outlines[:, 1:] - outlines[:, :1]
    cross = np.cross(spokes[:, :-1], spokes[:, 1:])
    total = cross.sum(1)
    size = np.linalg.norm(total, axis=1)
    height = np.einsum("pcd,pd->pc", cross, total / np.maximum(size, 1e-300)[:, None])
    angle = np.arctan2(height, np.einsum("pcd,pcd->pc", spokes[:, :-1], spokes[:, 1:]))
    return (height > _FLAT * np.maximum(size, 1e-300)[:, None]).all(1) & (angle.sum(1) < 2 * np.pi)


def _without_ears(outline: Float[np.ndarray, "corners 3"]) -> Int[np.ndarray, "triangles 3"] | None:
    """Triangles of one polygon, of area 0 where corners are in line or in one place; None where its outline crosses itself.

    Reference: Meisters, "Polygons Have Ears", American Mathematical Monthly 82, 1975.
    """
    away = outline - outline[0]
    normal = np.cross(away, np.roll(away, -1, axis=0)).sum(0)
    length, extent = float(np.linalg.norm(normal)), float((away**2).sum(1).max())
    fan = np.stack([np.zeros(len(outline) - 2, int), np.arange(1, len(outline) - 1), np.arange(2, len(outline))], 1)
    if length <= _FLAT * extent:
        areas = np.linalg.norm(np.cross(away[1:-1], away[2:]), axis=1)
        return fan if areas.max() <= _FLAT * extent else None
    front = normal / length
    right = np.cross(np.eye(3)[np.abs(front).argmin()], front)
    right /= np.linalg.norm(right)
    flat = away @ np.stack([right, np.cross(front, right)], 1)
    if _crosses(flat):
        return None
    left, triangles, place, tried = list(range(len(flat))), [], 0, 0
    while len(left) > 3 and tried < len(left):
        place %= len(left)
        ear = [left[place - 1], left[place], left[(place + 1) % len(left)]]
        if _is_ear(flat[ear], flat[left], _FLAT * extent):
            triangles.append(ear)
            left.pop(place)
            tried = 0
        else:
            tried += 1
        place += 1  # not the same corner's neighbour again: that would make a fan of slivers
    rest = flat[left] - flat[left[0]]
    areas = rest[1:-1, 0] * rest[2:, 1] - rest[1:-1, 1] * rest[2:, 0]
    if areas.min() < -_FLAT * extent:
        return None
    return np.array([*triangles, *([left[0], a, b] for a, b in pairwise(left[1:]))])


def _crosses(flat: Float[np.ndarray, "corners 2"]) -> bool:
    """Whether two edges of an outline cross in their midst; corners that touch others do not count."""
    ends = np.roll(flat, -1, axis=0)
    for index in range(len(flat) - 2):
        start, end, starts, stops = flat[index], ends[index], flat[index + 2 :], ends[index + 2 :]
        here = _side(start, end, starts) * _side(start, end, stops)
        there = _side(starts, stops, start) * _side(starts, stops, end)
        if ((here < 0) & (there < 0)).any():
            return True
    return False


def _is_ear(ear: Float[np.ndarray, "3 2"], others: Float[np.ndarray, "n 2"], least: float) -> bool:
    """Whether a corner and its neighbours turn left and hold no other corner; one in the same place as theirs is none."""
    a, b, c = ear
    if _side(a, b, c) <= least:
        return False
    apart = (others[:, None] != ear).any(2).all(1)
    within = (_side(a, b, others) >= -least) & (_side(b, c, others) >= -least) & (_side(c, a, others) >= -least)
    return not bool((apart & within).any())


def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> Any:
    """Twice the area of the triangles a, b, point in the plane; above 0 where they turn left."""
    return (b[..., 0] - a[..., 0]) * (point[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (point[..., 0] - a[..., 0])
