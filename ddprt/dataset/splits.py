"""Which lightings a dataset has (given, listed in a file, or drawn), and which of them are doubtful."""

from collections.abc import Mapping, Sequence

import numpy as np

from ddprt.errors import UserError
from ddprt.lights import Lighting, lighting_json, load_lightings, parse_lighting
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.distance import distance_within
from ddprt.scene.mesh import Scene
from ddprt.sections import LightingsConfig
from ddprt.transport.embree import Tracer

SPLITS = ("train", "validation", "test")
Splits = Mapping[str, Sequence[Lighting]]

_STRENGTHS = ("intensity", "irradiance", "radiance")


def choose_lightings(
    given: Sequence[Lighting] | Splits | None, config: LightingsConfig, scene: Scene, tracer: Tracer, seed: int
) -> tuple[list[tuple[str, Lighting]], dict[str, int]]:
    """(split, lighting) pairs in the order of their indices, and how many positions were tried and rejected.

    Raises:
      UserError: a split is empty, a light is faulty, a file has too few or too many, or no free position is found.
    """
    facts: dict[str, int] = {}
    if given is None and config.file:
        given = _listed(config)
    elif given is None:
        given, facts = _drawn(config, scene, tracer, seed)
    splits = given if isinstance(given, Mapping) else split_lightings(given)
    for name in SPLITS:
        if not splits.get(name):
            raise UserError(f"lightings: got none for {name}, expected at least 1 each for train, validation and test")
    named = [(name, index, lighting) for name in SPLITS for index, lighting in enumerate(splits[name])]
    return [(name, parse_lighting(lighting, f"{name} lighting {index}")) for name, index, lighting in named], facts


def split_lightings(lightings: Sequence[Lighting]) -> dict[str, list[Lighting]]:
    """One list into train, validation and test by order: the last fifth is test, the tenth before it validation.

    Raises:
      UserError: fewer than 3.
    """
    count = len(lightings)
    if count < 3:
        raise UserError(f"lightings: got {count}, expected at least 3 (train, validation, test)")
    test, validation = max(1, count // 5), max(1, count // 10)
    first = count - test - validation
    return {"train": [*lightings[:first]], "validation": [*lightings[first:-test]], "test": [*lightings[-test:]]}


def doubt(lighting: Lighting, lights_nothing: bool, scene: Scene, tracer: Tracer) -> str:
    """Why a lighting is doubtful, empty where it is not.

    Args:
      lighting: world space.
      lights_nothing: its direct light is 0 everywhere.
      scene, tracer: where it stands.
    """
    places = [anchor for light in lighting if (anchor := light.anchor()) is not None]
    all_placed = len(places) == len(lighting)
    prefix = "lights nothing: it " if lights_nothing else ""
    strengths = [value for light in lighting_json(lighting) for key in _STRENGTHS for value in light.get(key, ())]
    if not any(strengths):
        return prefix + "has no intensity"
    if all_placed and not (tracer.clearance(np.array(places)) > 0).any():
        boxes = np.stack([scene.corners.min(1), scene.corners.max(1)], 1)
        touching = any(distance_within(scene.corners, boxes, place, float(tracer.offset)) < tracer.offset for place in places)
        return prefix + ("stands on a surface" if touching else "stands inside a solid or behind a wall")
    if not lights_nothing:
        return ""
    low, high = scene.bounds
    outside = all_placed and all(((place < low) | (place > high)).any() for place in places)
    return prefix + ("stands outside the scene" if outside else "faces away or is shadowed")


def grouped(reasons: Mapping[str, str], most: int) -> str:
    """Doubtful lightings in one line, those of one reason together.

    Args:
      reasons: why each is doubtful, by name: `{"3 (train)": "has no intensity"}`.
      most: names that are spelt out for each reason.
    """
    told = []
    for why in dict.fromkeys(reasons.values()):
        names = [name for name, reason in reasons.items() if reason == why]
        more = f" and {len(names) - most} more" if len(names) > most else ""
        told.append(f"{', '.join(names[:most])}{more}: {why}")
    return "; ".join(told)


def _listed(config: LightingsConfig) -> Splits:
    counts = {name: getattr(config, name) for name in SPLITS}
    listed = load_lightings(config.file)
    if len(listed) != sum(counts.values()):
        wanted = " + ".join(f"{name} {count}" for name, count in counts.items())
        raise UserError(
            f"lightings.file {config.file}: got {len(listed)} lightings, expected {sum(counts.values())} ({wanted}); "
            "set lightings.train, lightings.validation and lightings.test to share them out"
        )
    ends = np.cumsum(list(counts.values()))
    return {name: listed[end - counts[name] : end] for name, end in zip(SPLITS, ends, strict=True)}


def _drawn(config: LightingsConfig, scene: Scene, tracer: Tracer, seed: int) -> tuple[Splits, dict[str, int]]:
    draws = {
        name: draw_lightings(config, name, getattr(config, name), bounds=scene.bounds, clearance=tracer.clearance, seed=seed)
        for name in SPLITS
    }
    facts = {
        "positions_tried": sum(draw.candidates for draw in draws.values()),
        "positions_rejected": sum(draw.rejected for draw in draws.values()),
    }
    return {name: draw.lightings for name, draw in draws.items()}, facts
