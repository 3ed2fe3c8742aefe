"""Albedo and series: furnaces from black to white, scenes in which nothing faces anything."""

from typing import Any

import numpy as np
from hard_bakes import HALF, LAMPS, MIDDLE, SIGMAS, baked, everything, finite, furnace_range, over, point, room, within, worst
from hard_cases import HardCase, Outcome

import ddprt
from ddprt.progress import Progress
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene


def white_furnace(albedo: float, **transport: Any) -> Outcome:
    """Even light bounces evenly: rows of G sum to 1, so every value lies in the range of E0 times a + ... + a^bounces."""
    scene, progress = build("furnace", albedo=albedo, subdivisions=2), Progress(quiet=True)
    data = baked(scene, MIDDLE, progress=progress, atlas={"resolution": 32, "padding": 1}, transport=transport)
    low, high = furnace_range(scene)
    direct, measured, indirect = everything(data)
    facts = next(stage for stage in progress.stages if stage["name"] == "indirect train")
    bounces = int(facts.get("bounces", 0))
    series = sum(albedo**k for k in range(1, bounces + 1))
    whole = albedo / (1 - albedo) if albedo < 1 else np.inf
    if facts.get("remainder", "0") == "unbounded":
        missed = 0.0 if albedo == 1 else np.inf
    else:
        left = float(facts.get("remainder", "0")) * indirect.max()
        missed = worst(over(np.array(max(low * whole - indirect.max(), 0.0)), np.array(0.0), left + 4 * HALF * whole))
    return Outcome(
        worst(within(direct, low, high), within(indirect, low * series, high * series), missed),
        finite=finite(direct, measured, indirect),
    )


def _nothing_bounces(scene: Scene, record: dict[str, Any], **sections: dict) -> Outcome:
    direct, measured, indirect = everything(baked(scene, [record], **sections))
    return Outcome(np.inf if indirect.any() or not direct.any() else 0.0, finite=finite(direct, measured))


def _bright_room_by_paths() -> Outcome:
    albedo = 0.999
    scene, samples = build("furnace", albedo=albedo, subdivisions=2), 128
    low, high = furnace_range(scene)
    places, normals = scene.corners[::40].mean(1), scene.geometric_normals[::40]
    _, indirect, _, variance = ddprt.irradiance(scene, MIDDLE, places, normals, samples=samples, return_variance=True)
    # All places estimate one number, but for the range of E0: their mean has the variance of the mean.
    spread = np.sqrt(variance[:, 0].sum()) / len(places)
    middle, half = (low + high) / 2 * albedo / (1 - albedo), (high - low) / 2 * albedo / (1 - albedo)
    return Outcome(worst(over(indirect[:, 0].mean(), middle, half + SIGMAS * spread)), finite=finite(indirect))


def _one_triangle() -> Outcome:
    scene = checked("one", np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]), np.array([[0, 1, 2]]))
    return _nothing_bounces(scene, point(0.25, 1.0, 0.25), points={"count": 4, "supersample": 2})


CASES: tuple[HardCase, ...] = (
    HardCase("black furnace", "no surface reflects", "indirect light is exactly 0", lambda: white_furnace(0.0)),
    HardCase(
        "grey furnace", "every ray hits, light is even", "E0 a / (1 - a), whatever rays are drawn", lambda: white_furnace(0.5)
    ),
    HardCase(
        "bright furnace",
        "albedo 0.999: the series hardly converges",
        "a + ... + a^n, and a / (1 - a) within the remainder that is reported",
        lambda: white_furnace(0.999),
    ),
    HardCase(
        "white furnace",
        "albedo 1: the series does not converge",
        "n E0, and the remainder is called unbounded",
        lambda: white_furnace(1.0),
    ),
    HardCase(
        "bright furnace by paths",
        "weights grow where roulette ends paths more often than walls do",
        "a / (1 - a) within six standard errors that are reported",
        _bright_room_by_paths,
    ),
    HardCase(
        "lone convex object",
        "nothing faces anything",
        "indirect light is exactly 0",
        lambda: _nothing_bounces(build("convex"), point(0.0, 2.0, 0.25)),
    ),
    HardCase("one triangle", "the least scene there is", "indirect light is exactly 0", _one_triangle),
    HardCase(
        "black room",
        "light arrives and none leaves",
        "indirect light is exactly 0",
        lambda: _nothing_bounces(room(0.0), LAMPS[0]),
    ),  # type: ignore[arg-type]
)
