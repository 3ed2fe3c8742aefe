"""Measurement points: in what is solid, on a hull, away from the light, all in one place."""

import numpy as np
from hard_bakes import BLACK, LAMPS, LIT, alike, baked, finite, fitted, given_points, point, room, worst
from hard_cases import HardCase, Outcome


def _points_inside() -> Outcome:
    """All points in what is solid: they measure nothing, the model is black, and its status says so."""
    entries = [{"position": [0.1 + 0.1 * k, -0.5, 0.5], "normal": [0, 1, 0]} for k in range(8)]
    data, images, status = given_points(room(), entries, LAMPS, LAMPS)
    return Outcome(0.0 if not (images.any() or data.measured(range(4)).any()) else np.inf, status, finite(images))


def _hull_of_a_room() -> Outcome:
    """A room's hull looks outwards: no lamp inside reaches it."""
    data = baked(room(), LAMPS, points={"count": 8, "supersample": 2, "on": "hull"})
    model, images = fitted(data, LAMPS)
    dark = not (images.any() or data.measured(range(4)).any())
    return Outcome(0.0 if dark else np.inf, model.relighter.report.status, finite(images))


def _seen_by_no_point() -> Outcome:
    """Points on the ceiling, a spot on the floor: what no point sees trains nothing, and is relit as exactly nothing."""
    entries = [{"position": [0.1 + 0.1 * k, 1.0, 0.5], "normal": [0, -1, 0]} for k in range(8)]
    spot = {**point(0.5, 0.5, 0.5), "type": "spot", "direction": [0, -1, 0], "inner_deg": 10, "outer_deg": 30}
    data, images, status = given_points(room(), entries, [*LAMPS[:3], spot], [*LAMPS[:3], spot])
    lit = bool(data.maps("indirect", [3]).any()) and not data.measured([3]).any()
    return Outcome(0.0 if lit and not images[-1].any() and images[0].any() else np.inf, status, finite(images))


def _points_at_one_place() -> Outcome:
    """Each of three points at one place measures what is there, and not nothing."""
    entries = [{"position": [0.1 + 0.1 * max(k, 2), 0.0, 0.5], "normal": [0, 1, 0]} for k in range(8)]
    data, images, status = given_points(room(), entries, LAMPS, LAMPS)
    values = data.values(range(4), 8, "irradiance")
    same = alike(values[:, 0], values[:, 1]) + alike(values[:, 0], values[:, 2])
    return Outcome(worst(same, 0.0 if values.all() else np.inf), status, finite(images))


CASES: tuple[HardCase, ...] = (
    HardCase(
        "points inside walls",
        "nothing is measured",
        "a black model that says so",
        _points_inside,
        BLACK,
    ),
    HardCase(
        "hull of a room",
        "the hull looks outwards",
        "a black model that says so",
        _hull_of_a_room,
        BLACK,
    ),
    HardCase("lamp that no point sees", "texels are lit, the column is 0", "relit as exactly nothing", _seen_by_no_point, LIT),
    HardCase(
        "points at one place", "supersamples go to the nearest point", "each measures the same light", _points_at_one_place, LIT
    ),
)
