"""Distributions that lightings are drawn from, for a room or about an asset.

Every lighting has its own random stream, addressed by split and index: lighting 517 is the same whatever is drawn before it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float64
from ddprt.errors import UserError
from ddprt.lights import LIGHTS, EnvironmentLight, Light, Lighting
from ddprt.lights.light import unit
from ddprt.sections import LightingsConfig

Clearance = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, " n"]]
"""Free radius about positions, metres; 0 inside a solid."""

_TRIES = 4096  # candidate positions per light before giving up
_BATCH = 16


@dataclass(frozen=True)
class Draw:
    """Lightings, and how many candidate positions were turned down (inside a solid or too near a surface)."""

    lightings: tuple[Lighting, ...]
    rejected: int
    candidates: int


def draw_lightings(
    config: LightingsConfig,
    split: str,
    count: int,
    *,
    bounds: Float64[np.ndarray, "2 3"],
    clearance: Clearance,
    seed: int,
) -> Draw:
    """Draws `count` lightings for a split ("train", "validation" or "test"; each split is independent).

    Args:
      config: the distribution.
      bounds: bounding box of the scene, metres.
      clearance: free radius about positions.
      seed: of the run.
    Raises:
      UserError: no free position was found, or there is no such image of a sky.
    """
    lightings, rejected, candidates = [], 0, 0
    for index in range(count):
        rng = seeds.stream(seed, f"lightings {split}", index)
        lights = []
        for _ in range(rng.integers(config.lights[0], config.lights[1], endpoint=True)):
            light, turned_down, tried = _draw_light(config, bounds, clearance, rng)
            lights.append(light)
            rejected, candidates = rejected + turned_down, candidates + tried
        lightings.append(tuple(lights))
    return Draw(tuple(lightings), rejected, candidates)


def _draw_light(
    config: LightingsConfig, bounds: np.ndarray, clearance: Clearance, rng: np.random.Generator
) -> tuple[Light, int, int]:
    kind = config.kinds[rng.integers(len(config.kinds))]
    if kind == "environment":
        from ddprt.lights.panorama import stamp  # a missing image is told before anything is baked, but not yet read

        stamp(config.environment)
        scale, turn = float(np.exp(rng.uniform(*np.log(config.intensity)))), float(rng.uniform(0, 360))
        return EnvironmentLight(image=config.environment, rotation_deg=turn, scale=scale), 0, 0
    radius = float(np.linalg.norm(bounds[1] - bounds[0]) / 2)
    size = config.size * radius
    if kind == "directional" or config.distribution == "around":
        low, high = np.sin(np.deg2rad(config.elevation_deg))
        rise, turn = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
        flat = np.sqrt(max(1 - rise**2, 0))
        outward = np.array([flat * np.cos(turn), rise, flat * np.sin(turn)])
        position = bounds.mean(0) + outward * rng.uniform(*config.distance) * radius
        aim, rejected, tried = -outward, 0, 1
    else:
        room = {"rect": np.sqrt(2) * size, "sphere": size}.get(kind, 0.0)  # a square reaches as far as its corners
        position, rejected, tried = _free_position(config, bounds, clearance, room, rng)
        aim = warp.sample_sphere(rng.random((1, 2)))[0]
    if kind == "spot" and config.distribution == "around":
        target = bounds.mean(0) + 0.5 * radius * rng.uniform(-1, 1, 3)
        aim = unit(target - position)
    colour = _colour(config, rng)
    strength = float(np.exp(rng.uniform(*np.log(config.intensity))))
    return LIGHTS[kind](**_record(kind, config, position, aim, colour * strength, size, rng)), rejected, tried


def _record(
    kind: str,
    config: LightingsConfig,
    position: np.ndarray,
    aim: np.ndarray,
    intensity: np.ndarray,
    size: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Fields of a light; area lights have the radiance that gives their axis the drawn intensity."""
    place, power = tuple(position.tolist()), tuple(intensity.tolist())
    if kind == "point":
        return {"position": place, "intensity": power}
    if kind == "spot":
        outer = float(rng.uniform(*config.spot_outer_deg))
        return {
            "position": place,
            "direction": tuple(aim.tolist()),
            "intensity": power,
            "inner_deg": 0.6 * outer,
            "outer_deg": outer,
        }
    if kind == "directional":
        return {"direction": tuple(aim.tolist()), "irradiance": power}
    if kind == "sphere":
        return {"center": place, "radius": size, "radiance": tuple((intensity / (np.pi * size**2)).tolist())}
    u, v, _ = size * warp.frame(np.asarray(aim, float))
    radiance = tuple((intensity / (4 * size**2)).tolist())
    return {"center": place, "half_u": tuple(u.tolist()), "half_v": tuple(v.tolist()), "radiance": radiance}


def _free_position(
    config: LightingsConfig, bounds: np.ndarray, clearance: Clearance, room: float, rng: np.random.Generator
) -> tuple[np.ndarray, int, int]:
    low = bounds[0] + np.array(config.region_low) * (bounds[1] - bounds[0])
    high = bounds[0] + np.array(config.region_high) * (bounds[1] - bounds[0])
    for tried in range(0, _TRIES, _BATCH):
        candidates = rng.uniform(low, high, (_BATCH, 3))
        for start, stop in ((0, 1), (1, _BATCH)):  # the first is mostly free
            free = clearance(candidates[start:stop])
            accepted = start + np.flatnonzero((free > 0) & (free >= config.clearance + room))
            if len(accepted):
                return candidates[accepted[0]], tried + int(accepted[0]), tried + int(accepted[0]) + 1
    raise UserError(
        f"lightings: got no free position in {_TRIES} tries, expected free space with {config.clearance + room:g} m around; "
        "lower lightings.clearance or lightings.size, widen region_low and region_high, or set lightings.distribution = "
        '"around" for an asset'
    )


def _colour(config: LightingsConfig, rng: np.random.Generator) -> np.ndarray:
    """White moved towards a random hue; the brightest channel is 1."""
    saturation, hue = rng.uniform(*config.saturation), rng.uniform(0, 6)
    pure = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return 1 - saturation * (1 - pure)
