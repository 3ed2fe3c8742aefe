"""Which lightings a dataset has (given, listed in a file, drawn, or chosen among many), and which of them are doubtful."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32
from ddprt.config import Config
from ddprt.dataset.store import average_into_points
from ddprt.errors import UserError
from ddprt.lights import Lighting, lighting_json, load_lightings, parse_lighting
from ddprt.sampling.design import choose_columns, choose_rows, directions
from ddprt.sampling.lightings import draw_lightings
from ddprt.sampling.points import Samples
from ddprt.scene.distance import distance_within
from ddprt.scene.mesh import Scene
from ddprt.sections import LightingsConfig
from ddprt.transport.direct import Places, mean_irradiance
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure

SPLITS = ("train", "validation", "test")
Splits = Mapping[str, Sequence[Lighting]]
Given = ParamSpec("Given")
Result = TypeVar("Result")

_LOOKED_AT = 4096  # triangles, at most, that are asked whether a lighting would reach them without fog
_STRENGTHS = ("intensity", "irradiance", "radiance", "scale")


class Once:
    """Steps that bakes of one scene and its settings share."""

    def __init__(self) -> None:
        self._shared: tuple[object, ...] = ()
        self._found: dict[str, Any] = {}

    def bind(self, *shared: object) -> None:
        """Makes sure that what is kept depends on nothing else than it did.

        Raises:
          ValueError: it would.
        """
        if self._shared and self._shared != shared:
            raise ValueError("once: got another scene or other settings, expected those that it was first used with")
        self._shared = shared

    def __call__(self, step: Callable[Given, Result], *args: Given.args, **named: Given.kwargs) -> Result:
        """What a step came to when it was first asked for; it is not taken again."""
        if step.__name__ not in self._found:
            self._found[step.__name__] = step(*args, **named)
        return cast("Result", self._found[step.__name__])


def choose_lightings(
    given: Sequence[Lighting] | Splits | None, config: LightingsConfig, scene: Scene, tracer: Tracer, seed: int
) -> tuple[list[tuple[str, Lighting]], dict[str, int]]:
    """(split, lighting) pairs in the order of their indices, and how many positions were tried and rejected.

    Where the configuration is to choose among candidates, all of them are "train": see `choose_among`.

    Raises:
      UserError: a split is empty, a light is faulty, a file has too few or too many, or no free position is found.
    """
    facts: dict[str, int] = {}
    if given is not None and config.choose == "active":
        raise UserError(
            'lightings: got a list beside lightings.choose = "active", expected one of the two; leave the other out'
        )
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


def check_choice(config: Config, first: int | None) -> None:
    """Makes sure that settings of a choice have one to apply to.

    Args:
      config: all settings.
      first: how many of the chosen training lightings are baked; None for all.
    Raises:
      UserError: they have none.
    """
    lightings, points = config.lightings, config.points
    active = lightings.choose == "active"
    if active and lightings.file:
        raise UserError(
            f'lightings.choose: got "active" beside lightings.file {lightings.file}, expected lightings that are drawn; '
            "leave one of the two out"
        )
    if lightings.target_error and not active:
        raise UserError(
            f'lightings.target_error: got {lightings.target_error:g} beside lightings.choose = "random", expected "active"; '
            "set that, or leave the target out"
        )
    if lightings.target_error and first is None:
        raise UserError(
            f"lightings.target_error: got {lightings.target_error:g}, but a bake by itself fits nothing; "
            "use `ddprt bake` or `ddprt run`, or set it to 0"
        )
    if first is not None and not (active and 1 <= first <= lightings.train):
        raise UserError(
            f'first: got {first}, expected 1 to {lightings.train} with lightings.choose = "active"; leave it out, or set that'
        )
    if points.choose == "qr" and points.file:
        raise UserError(
            f'points.choose: got "qr" beside points.file {points.file}, expected points that are placed; '
            "leave one of the two out"
        )


def chosen(
    entries: Sequence[tuple[str, Lighting]],
    samples: Samples,
    config: Config,
    tracer: Tracer,
    first: int | None,
    once: Once,
) -> tuple[list[tuple[str, Lighting]], Samples, int]:
    """What a configuration chooses: entries with fewer training lightings, samples with the points first; shadow rays spent.

    Args:
      entries: (split, lighting) pairs; all candidates are "train".
      samples: evenly spread.
      config: all settings.
      tracer: the occluders.
      first: of the chosen lightings, keep only so many; None keeps all.
      once: keeps the choice, of which any number is a beginning.
    """
    train = [lighting for split, lighting in entries if split == "train"]
    points, seed, before = config.points.count, config.seed, tracer.rays
    if config.lightings.choose == "active":
        train = once(choose_among, train, config.lightings.train, samples, points, tracer, seed)[:first]
    if config.points.choose == "qr":
        samples = reorder(samples, train, points, tracer, seed)
    held = [entry for entry in entries if entry[0] != "train"]
    return [*(("train", lighting) for lighting in train), *held], samples, tracer.rays - before


def choose_among(
    candidates: Sequence[Lighting], count: int, samples: Samples, points: int, tracer: Tracer, seed: int
) -> list[Lighting]:
    """The lightings whose measurements tell most about those of all candidates, the most telling first.

    They are told apart by the radiosity at the points that a fit will use; choosing fewer gives a beginning of the same list.

    Args:
      candidates: drawn as the held-out lightings are.
      count: how many to choose, at most all.
      samples: where light is measured.
      points: how many of them are points, that the others are averaged into.
      tracer, seed: as `transport.measure` takes them.
    """
    values = average_into_points(_measured(candidates, samples, tracer, seed), samples, points, "radiosity")
    return [candidates[index] for index in choose_rows(directions(values), count)]


def reorder(samples: Samples, lightings: Sequence[Lighting], points: int, tracer: Tracer, seed: int) -> Samples:
    """The same samples, those first that tell lightings apart best; the others are averaged into the nearest of them.

    Args:
      samples: where light is measured, evenly spread in any beginning.
      lightings: of training.
      points: how many become points.
      tracer, seed: as `transport.measure` takes them.
    """
    light = _measured(lightings, samples, tracer, seed) * samples.albedo.astype(np.float32)
    rows = directions(light).reshape(light.shape).swapaxes(1, 2).reshape(-1, light.shape[1])
    order = choose_columns(rows, points)
    return replace(samples, position=samples.position[order], normal=samples.normal[order], albedo=samples.albedo[order])


def _measured(
    lightings: Sequence[Lighting], samples: Samples, tracer: Tracer, seed: int
) -> Float32[np.ndarray, "lightings samples 3"]:
    seed = seeds.number(seed, "choice")  # its random numbers are not those of the dataset's own measurements

    def work(index: int) -> np.ndarray:
        light = lightings[index]
        return measure(tracer, light, samples.position, samples.normal, seed=seed, index=index, depth=samples.depth)

    return np.stack(list(tracer.map(work, range(len(lightings)))))


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
    strengths = [value for light in lighting_json(lighting) for key in _STRENGTHS for value in np.ravel(light.get(key, ()))]
    if not any(strengths):
        return prefix + "has no intensity"
    if all_placed and not (tracer.clearance(np.array(places)) > 0).any():
        boxes = np.stack([scene.corners.min(1), scene.corners.max(1)], 1)
        touching = any(distance_within(scene.corners, boxes, place, float(tracer.offset)) < tracer.offset for place in places)
        return prefix + ("stands on a surface" if touching else "stands inside a solid or behind a wall")
    if not lights_nothing:
        return ""
    if tracer.medium is not None and _shines_in_clear_air(lighting, tracer):
        return prefix + "shines, but the fog swallows all of it on the way"
    low, high = scene.bounds
    outside = all_placed and all(((place < low) | (place > high)).any() for place in places)
    return prefix + ("stands outside the scene" if outside else "faces away or is shadowed")


def _shines_in_clear_air(lighting: Lighting, tracer: Tracer) -> bool:
    """Whether some triangle's middle would be lit without fog."""
    few = np.linspace(0, len(tracer.corners) - 1, min(_LOOKED_AT, len(tracer.corners))).astype(int)
    places = Places.of(tracer, tracer.corners[few].mean(1), tracer.normals[few])
    clear = tuple(light.translated(-tracer.centre) for light in lighting)
    return bool(mean_irradiance(tracer, clear, places, np.random.default_rng(0)).any())


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
    listed = load_lightings(config.file, config.gltf_units)
    if len(listed) != sum(counts.values()):
        wanted = " + ".join(f"{name} {count}" for name, count in counts.items())
        raise UserError(
            f"lightings.file {config.file}: got {len(listed)} lightings, expected {sum(counts.values())} ({wanted}); "
            "set lightings.train, lightings.validation and lightings.test to share them out"
        )
    ends = np.cumsum(list(counts.values()))
    return {name: listed[end - counts[name] : end] for name, end in zip(SPLITS, ends, strict=True)}


def _drawn(config: LightingsConfig, scene: Scene, tracer: Tracer, seed: int) -> tuple[Splits, dict[str, int]]:
    counts = {name: getattr(config, name) for name in SPLITS}
    if config.choose == "active":
        counts["train"] *= config.candidates
    draws = {
        name: draw_lightings(config, name, count, bounds=scene.bounds, clearance=tracer.clearance, seed=seed)
        for name, count in counts.items()
    }
    facts = {
        **({"candidates": counts["train"]} if config.choose == "active" else {}),
        "positions_tried": sum(draw.candidates for draw in draws.values()),
        "positions_rejected": sum(draw.rejected for draw in draws.values()),
    }
    return {name: draw.lightings for name, draw in draws.items()}, facts
