"""Where lamps stand and what they are: on, in and behind walls, far away, needles, points of light, and worse."""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hard_bakes import (
    FLOAT,
    LAMPS,
    SIGMAS,
    baked,
    everything,
    finite,
    from_lamp,
    over,
    point,
    refused,
    room,
    worst,
)
from hard_cases import REFUSED, HardCase, Outcome

import ddprt
from ddprt.lights import parse_lighting
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted
from ddprt.transport.embree import SELF_OFFSET


def lamp_at(record: dict[str, Any], *, dark: bool = False, scene: Scene | None = None) -> Outcome:
    """Measured light against the closed form (nothing, if `dark`); maps are finite, and dark where they must be."""
    scene = scene or room()
    ordinary = LAMPS[0] if scene.name == "room" else point(0.28, 0.45, 0.28)
    data = baked(scene, [ordinary, record], atlas={"resolution": 16 if scene.name == "room" else 32})
    direct, measured, indirect = everything(data)
    expected, bound = from_lamp(scene, record, data.samples.position, data.samples.normal)
    known = np.isfinite(bound)
    if dark:
        return Outcome(0.0 if not (direct[1].any() or measured[1].any() or indirect[1].any()) else np.inf)
    ratio = over(np.where(known, measured[1], 0), np.where(known, expected, 0), np.where(known, bound, 1))
    lit = 0.0 if direct[1].any() and indirect[1].any() else np.inf
    return Outcome(worst(ratio, lit), finite=finite(direct, measured, indirect))


def _barely_behind() -> Outcome:
    """A micrometre outside, rays from far walls stop short of the wall between: the lamp counts as in it."""
    record = point(0.5, -1e-6, 0.5)
    found, _ = ddprt.irradiance(room(), record, [[0.5, 1.0, 0.5]], [[0.0, -1.0, 0.0]], samples=2)
    expected, bound = from_lamp(room(), record, np.array([[0.5, 1.0, 0.5]]), np.array([[0.0, -1.0, 0.0]]))
    return Outcome(worst(over(found, expected, bound)), finite=finite(found))


def _far_lamp() -> Outcome:
    """A cube and a lamp 1e6 m above: its top gets I cos / r², its sides what grazes them, its bottom nothing."""
    record, scene = point(0.0, 1e6, 0.0, 1e12), build("convex")
    places = np.array([[0.25, 0.5, 0.25], [0.0, -0.5, 0.0]])
    normals = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    found, indirect = ddprt.irradiance(scene, record, places, normals, samples=2)
    expected, bound = from_lamp(scene, record, places, normals)
    data = baked(scene, [record])
    return Outcome(worst(over(found, expected, bound), 0.0 if not indirect.any() else np.inf), finite=finite(*everything(data)))


def _in_a_block() -> Outcome:
    return lamp_at(point(0.186, 0.08, 0.169), dark=True, scene=build("cornell"))


def spot_of(outer: float, inner: float) -> Outcome:
    """A spot a metre above points across its rim, against the falloff of glTF in float64.

    1 - cosine is half the square of the chord between the axis and the direction. Rounding moves the direction by at most
    2 units, so that this is off by 2 units times the chord (and their square), the falloff by that over the rim's width.
    """
    reach = min(1.2 * outer, 89.95)
    places = np.zeros((200, 3), np.float32)
    places[:, 0] = np.tan(np.radians(np.linspace(0, reach, 201)[1:]))
    record = {"type": "spot", "position": [0, 1, 0], "direction": [0, -1, 0], "intensity": [1, 1, 1]}
    (spot,) = parse_lighting({**record, "outer_deg": outer, "inner_deg": inner})
    found = spot.illuminate(places, np.zeros((200, 2), np.float32)).strength
    across = places[:, 0].astype(np.float64)
    drop, rim, full = (2 * np.sin(angle / 2) ** 2 for angle in (np.arctan(across), *np.radians([outer, inner])))
    falloff, light = np.clip((rim - drop) / (rim - full), 0, 1), 1 / (1 + across**2)
    moves = (np.sqrt(2 * drop) * 2 * FLOAT + (2 * FLOAT) ** 2) / (rim - full)
    return Outcome(
        worst(over(found, falloff**2 * light, light * (2 * falloff * moves + moves**2 + 3 * FLOAT))), finite=finite(found)
    )


def _tiny_ball() -> Outcome:
    """A sphere of 1 µm is a lamp of pi r² L: from 0.1 m on the ball's own size changes E by at most (r / d)² = 1e-10."""
    radius, lamp = 1e-6, point(0.5, 0.75, 0.5)
    glow = {"type": "sphere", "center": lamp["position"], "radius": radius, "radiance": [1 / (np.pi * radius**2)] * 3}
    data = baked(room(), [glow])
    expected, bound = from_lamp(room(), lamp, data.samples.position, data.samples.normal)
    return Outcome(worst(over(data.measured([0])[0], expected, bound + 1e-10 * expected)), finite=finite(*everything(data)))


def _touching_ball() -> Outcome:
    """A ball that lies on the floor is wholly above the horizon of all of it: E = pi L (r / d)² cos(theta), in the mean."""
    ball = {"type": "sphere", "center": [0.5, 0.25, 0.5], "radius": 0.25, "radiance": [1.0, 1.0, 1.0]}
    scene, across = room(), np.array([0.02, 0.1, 0.2, 0.3, 0.45])
    places = np.stack([0.5 + across, 0 * across, 0 * across + 0.5], 1)
    normals = np.tile([0.0, 1.0, 0.0], (5, 1))
    found, indirect, variance, _ = ddprt.irradiance(scene, ball, places, normals, samples=4096, return_variance=True)
    towards = np.array([0.5, 0.25, 0.5]) - places
    squared = (towards**2).sum(1)
    expected = np.pi * 0.25**2 * (towards * normals).sum(1) / squared**1.5
    # Near the touching point half the ball is within the rays' offset of the horizon; the shift counts as for a lamp.
    shift = 4 * (2 * SELF_OFFSET * scene.radius + 4 * FLOAT) * np.pi / np.sqrt(squared)
    return Outcome(worst(over(found[:, 0], expected, SIGMAS * np.sqrt(variance[:, 0]) + shift)), finite=finite(found, indirect))


def _ball_around_everything() -> Outcome:
    ball = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 2.0, "radiance": [1.0, 1.0, 1.0]}
    return refused(lambda: baked(room(), [ball]), "light nothing")


def _grazing_sun() -> Outcome:
    """Light along a wall that is turned to no axis: n.d is 0 but for the rounding of six numbers and of five operations."""
    turn = np.radians(33)
    along = np.array([np.cos(turn), np.sin(turn), 0.0])
    normal = np.array([-np.sin(turn), np.cos(turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    corners = np.array([[0 * up, up, along + up, along]])
    if np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0]) @ normal < 0:
        corners = corners[:, ::-1]
    wall = faceted("wall", corners, (Material("grey", (0.5,) * 3),))
    sun = {"type": "directional", "direction": along.tolist(), "irradiance": [1.0, 1.0, 1.0]}
    found, _ = ddprt.irradiance(wall, sun, [0.5 * along + 0.5 * up], [normal], samples=2)
    return Outcome(worst(over(found, np.zeros(3), 11 * FLOAT)), finite=finite(found))


def _edge_on() -> Outcome:
    """The wall in whose plane a rectangle lies gets nothing from it, the opposite of which it shows its back nothing either."""
    lamp = {"type": "rect", "center": [0.0, 0.5, 0.5], "half_u": [0, 0.125, 0], "half_v": [0, 0, 0.125], "radiance": [1.0] * 3}
    places, normals = np.array([[0.0, 0.9, 0.5], [1.0, 0.5, 0.5]]), np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    facing, _ = ddprt.irradiance(room(), lamp, places, normals, samples=64)
    back = {**lamp, "half_u": [0, -0.125, 0]}
    away, _ = ddprt.irradiance(room(), back, places, normals, samples=64)
    dark = not facing[0].any() and not away.any() and bool(facing[1].all())
    return Outcome(0.0 if dark else np.inf, finite=finite(facing, away))


def in_json(record: dict[str, Any], *words: str) -> Outcome:
    """A file of lightings that must be refused; JSON as Python writes it says NaN and Infinity."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lights.json"
        path.write_text(json.dumps([[record]]))
        return refused(lambda: ddprt.load_lightings(path), path.name, *words)


CASES: tuple[HardCase, ...] = (
    HardCase(
        "lamp on a wall", "its distance to that wall is 0", "I cos / r² on all others", lambda: lamp_at(point(0.5, 0.0, 0.5))
    ),
    HardCase(
        "lamp at a vertex", "three walls meet in it", "I cos / r² on the other three", lambda: lamp_at(point(0.0, 0.0, 0.0))
    ),
    HardCase(
        "lamp a micrometre off a wall",
        "nearer than rays start",
        "I cos / r² within the offset of rays",
        lambda: lamp_at(point(0.5, 1e-6, 0.5)),
    ),
    HardCase(
        "lamp a micrometre behind a wall",
        "nearer than rays stop short",
        "I cos / r² or nothing, to either side of the wall",
        _barely_behind,
    ),
    HardCase(
        "lamp behind a wall",
        "walls are blind from behind",
        "exactly nothing",
        lambda: lamp_at(point(0.5, -0.25, 0.5), dark=True),
    ),
    HardCase(
        "lamp a thousand kilometres away",
        "float32 has 0.06 m there",
        "a distant lamp lights what is convex as I cos / r²",
        _far_lamp,
    ),
    HardCase("lamp in a block", "its light never leaves", "exactly nothing", _in_a_block),
    HardCase(
        "spot of 0.1 degrees",
        "1 - cosine is 1.5e-6",
        "glTF falloff within what float32 directions allow",
        lambda: spot_of(0.1, 0.05),
    ),
    HardCase(
        "spot with a rim of 0.001 degrees",
        "inner and outer cosine agree to 3e-9",
        "glTF falloff within what float32 directions allow",
        lambda: spot_of(0.1, 0.099),
    ),
    HardCase(
        "spot of 89.9 degrees",
        "nearly a half space",
        "glTF falloff within what float32 directions allow",
        lambda: spot_of(89.9, 0.0),
    ),
    HardCase(
        "spot without a rim",
        "inner = outer divides by zero",
        "refused",
        lambda: in_json(
            {**point(0, 0, 0), "type": "spot", "direction": [0, 1, 0], "inner_deg": 30, "outer_deg": 30}, "inner_deg"
        ),
        REFUSED,
    ),
    HardCase(
        "rectangle without area",
        "it has no normal",
        "refused",
        lambda: in_json(
            {"type": "rect", "center": [0, 0, 0], "half_u": [1, 0, 0], "half_v": [2, 0, 0], "radiance": [1, 1, 1]}, "half_u"
        ),
        REFUSED,
    ),
    HardCase("rectangle edge-on", "its cosine is 0 within a wall and from behind", "exactly nothing there", _edge_on),
    HardCase("ball of a micrometre", "its cone is 1e-12 of the sphere", "a lamp of pi r² L", _tiny_ball),
    HardCase(
        "ball that touches the floor",
        "its cone reaches the horizon",
        "pi L (r / d)² cos within six standard errors",
        _touching_ball,
    ),
    HardCase(
        "ball around everything",
        "the inside of a lamp is no part of the scene",
        "refused",
        _ball_around_everything,
        REFUSED,
    ),
    HardCase("sun along a wall", "cosine 0 of rounded vectors", "at most the rounding of a cosine", _grazing_sun),
    *(
        HardCase(
            f"{what} in a lighting",
            "JSON of Python says NaN and Infinity",
            "refused",
            lambda v=value: in_json(point(0, 0, 0, v, 1, 1), "intensity"),
            REFUSED,
        )
        for what, value in (("NaN", np.nan), ("infinity", np.inf), ("a negative", -1.0))
    ),
)
