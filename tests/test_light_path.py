"""Light paths: even steps, free space, nothing else changes."""

from typing import Any

import numpy as np
import pytest

from ddprt.config import load_config
from ddprt.lights import LIGHTS, Lighting, lighting_json, parse_lighting
from ddprt.sampling.light_path import SHARE, TURN_DEG, light_path
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

EPS = float(np.finfo(np.float64).eps)
DRAWN = [kind for kind in LIGHTS if kind != "mesh"]  # distributions draw none of these
PLACED = [kind for kind in DRAWN if kind not in ("directional", "environment")]


def drawn(scene: Scene, tracer: Tracer, kinds: list[str], count: int = 3, lights: int = 1) -> tuple[Lighting, ...]:
    settings = {"lightings.kinds": str(kinds).replace("'", '"'), "lightings.lights": f"[{lights}, {lights}]"}
    config = load_config(None, settings).lightings
    return draw_lightings(config, "test", count, bounds=scene.bounds, clearance=tracer.clearance, seed=1).lightings


@pytest.fixture(scope="module")
def tracer(cornell: Scene) -> Tracer:
    return Tracer.of(cornell)


def parts(lamp: Any) -> np.ndarray:
    """The lamp's farthest places: corners of a rectangle, poles of a ball."""
    if lamp.kind == "rect":
        u, v = np.array(lamp.half_u), np.array(lamp.half_v)
        return lamp.anchor() + np.array([u + v, u - v, v - u, -u - v])
    return lamp.anchor() + lamp.reach() * np.concatenate([np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("kind", PLACED)
def test_lamps_go_straight_and_stay_in_free_space(cornell: Scene, tracer: Tracer, kind: str) -> None:
    for seed, lighting in enumerate(drawn(cornell, tracer, [kind])):
        path = light_path(lighting, tracer.clearance, 7, seed=seed)
        middle = lighting[0].anchor()
        free = float(tracer.clearance(middle[None])[0])
        places = np.array([frame[0].anchor() for frame in path])
        # Coordinates below 1 m, a product and a sum each, twice differenced.
        np.testing.assert_allclose(np.diff(places, 2, axis=0), 0, atol=8 * EPS)
        np.testing.assert_allclose(places[3], middle, atol=EPS)
        length = np.linalg.norm(places[-1] - places[0])
        assert length == pytest.approx(2 * SHARE * (free - lighting[0].reach()), rel=1e-12)
        assert length > 0.01, "a path that goes nowhere shows nothing"
        for frame in path:
            assert np.linalg.norm(parts(frame[0]) - middle, axis=1).max() <= free
        assert (tracer.clearance(places) >= (1 - SHARE) * free * (1 - 1e-9)).all()


def test_reach_in_closed_form() -> None:
    lamps = parse_lighting(
        [
            {"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]},
            {"type": "spot", "position": [0, 1, 0], "direction": [0, -1, 0], "intensity": [1, 1, 1]},
            {"type": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]},
            {"type": "sphere", "center": [0, 1, 0], "radius": 0.25, "radiance": [1, 1, 1]},
            {"type": "rect", "center": [0, 1, 0], "half_u": [0.3, 0, 0], "half_v": [0, 0, 0.4], "radiance": [1, 1, 1]},
            {"type": "rect", "center": [0, 1, 0], "half_u": [3, 0, 0], "half_v": [-1, 3, 0], "radiance": [1, 1, 1]},
        ]
    )
    assert [lamp.reach() for lamp in lamps] == pytest.approx([0, 0, 0, 0.25, 0.5, 5], rel=4 * EPS)


def test_distant_lights_turn_evenly(tracer: Tracer) -> None:
    lighting = parse_lighting({"type": "directional", "direction": [0.3, -0.8, 0.4], "irradiance": [1, 2, 3]})
    path = light_path(lighting, tracer.clearance, 5)
    directions = np.array([frame[0].direction for frame in path])  # type: ignore[attr-defined]
    angle = np.degrees(np.arcsin(np.linalg.norm(np.cross(directions, directions[2]), axis=1)))
    # Sines near 0.1 are good to a few roundings; degrees are 57 times as large.
    np.testing.assert_allclose(angle, TURN_DEG * np.array([1, 0.5, 0, 0.5, 1]), atol=57 * 16 * EPS)
    np.testing.assert_allclose(directions[0] + directions[4], 2 * np.cos(np.radians(TURN_DEG)) * directions[2], atol=16 * EPS)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=4 * EPS)


def test_skies_turn_evenly(tracer: Tracer) -> None:
    lighting = parse_lighting({"type": "environment", "image": "white", "rotation_deg": 350.0})
    turns = [frame[0].rotation_deg for frame in light_path(lighting, tracer.clearance, 5)]  # type: ignore[attr-defined]
    np.testing.assert_allclose(turns, 350 + TURN_DEG * np.array([-1, -0.5, 0, 0.5, 1]), atol=512 * EPS)


@pytest.mark.parametrize("kind", DRAWN)
def test_nothing_else_changes(cornell: Scene, tracer: Tracer, kind: str) -> None:
    (lighting,) = drawn(cornell, tracer, [kind], 1)
    moving = {"directional": {"direction"}, "environment": {"rotation_deg"}}.get(kind, {"position", "center"})
    kept = {key: value for key, value in lighting_json(lighting)[0].items() if key not in moving}
    for frame in light_path(lighting, tracer.clearance, 4):
        assert kept == {key: value for key, value in lighting_json(frame)[0].items() if key not in moving}


def test_lights_move_each_its_own_way_by_the_seed(cornell: Scene, tracer: Tracer) -> None:
    (lighting,) = drawn(cornell, tracer, ["point", "spot"], 1, lights=3)
    assert len(lighting) == 3
    paths = [light_path(lighting, tracer.clearance, 3, seed=seed) for seed in (5, 5, 6)]
    assert paths[0] == paths[1]
    ways = np.array([[np.subtract(path[2][i].anchor(), path[0][i].anchor()) for i in range(3)] for path in paths[1:]])
    ways = (ways / np.linalg.norm(ways, axis=2, keepdims=True)).reshape(6, 3)
    assert (ways @ ways.T - np.eye(6)).max() < 0.999, "two of six go the same way"


def test_a_lamp_without_room_stays(cornell: Scene, tracer: Tracer) -> None:
    inside = parse_lighting({"type": "point", "position": [0.18, 0.05, 0.17], "intensity": [1, 1, 1]})  # in the short block
    assert tracer.clearance(inside[0].anchor()[None])[0] == 0
    assert light_path(inside, tracer.clearance, 3) == (inside,) * 3
    wide = parse_lighting({"type": "sphere", "center": [0.28, 0.5, 0.28], "radius": 2.0, "radiance": [1, 1, 1]})
    assert light_path(wide, tracer.clearance, 3) == (wide,) * 3


def test_one_frame_is_no_path(tracer: Tracer) -> None:
    lighting = parse_lighting({"type": "point", "position": [0.28, 0.5, 0.28], "intensity": [1, 1, 1]})
    with pytest.raises(ValueError, match="got 1, expected at least 2"):
        light_path(lighting, tracer.clearance, 1)
