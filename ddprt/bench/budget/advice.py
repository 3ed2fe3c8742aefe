"""Which knob to turn first: what each would gain by a law or a cheap look, what it would cost, and whether that holds."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ddprt.bench.budget.bakes import Bakery
from ddprt.bench.budget.best_fit import best_transfer, projected
from ddprt.bench.budget.budget import Budget, engine_values
from ddprt.bench.budget.chain import squared_error
from ddprt.config import Config, checked
from ddprt.dataset.store import Dataset
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config

_SENDERS = 128  # the most that transport.sender_resolution = 0 takes
_LOOKED = "by the same fit on clean maps"


@dataclass(frozen=True)
class Knob:
    """A setting, turned one step.

    Attributes:
      cause: the part that it works on.
      setting: dotted key; "lightings" stands for the whole distribution.
      now, then: its values.
      relative_rmse: expected of the whole.
      why: where that comes from.
      bakes: the training maps have to be baked anew.
      effort: how many times as long their bake is expected to take; None where nothing tells.
      bytes, flops: expected of the model; None where nothing tells.
    """

    cause: str
    setting: str
    now: Any
    then: Any
    relative_rmse: float
    why: str
    bakes: bool = False
    effort: float | None = 1.0
    bytes: int | None = None
    flops: int | None = None


@dataclass(frozen=True)
class Turned:
    """What turning a knob did."""

    relative_rmse: float
    bytes: int
    flops: int
    fit_seconds: float
    bake_seconds: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def weigh_knobs(budget: Budget, model: Model, bakery: Bakery) -> list[Knob]:
    """Every knob that works on a part, the one that is expected to gain most first.

    Args:
      budget: the error taken apart.
      model: the one that it is of.
      bakery: of the run.
    """
    config = bakery.config
    makers: list[Callable[[Budget, Config], Knob | None]] = [
        _against_noise,
        _against_bias,
        _against_truncation,
        _against_measurement,
        _against_regularisation,
        _against_scenario,
        _against_quantisation,
        _against_mismatch,
    ]
    found = [knob for maker in makers if (knob := maker(budget, config)) is not None]
    told = [replace(knob, **_size(knob, model, config)) for knob in found if knob.cause in budget.parts.causes]
    return sorted(told, key=lambda knob: knob.relative_rmse)


def turn(knob: Knob, budget: Budget, bakery: Bakery) -> Turned:
    """Turns a knob for real: bakes where that takes a bake, fits, stores, measures as an engine, and meets the same truth."""
    config = _turned(bakery.config, knob)
    data, seconds = _baked(knob, config, budget, bakery)
    start = time.perf_counter()
    model = fit_config(data, config, config.fit.method)
    fit_seconds = time.perf_counter() - start
    kept = stored(model, config.export.precision)
    engine, _ = engine_values(model, budget.lightings, config.budget)
    error = squared_error(np.maximum(kept.predict(engine, clamp=False, constant=False), 0), budget.truth, budget.weight)
    size = shipped_bytes(model, config.export.precision)
    root = float(np.sqrt(max(error, 0.0))) / budget.parts.mean
    return Turned(root, size, model.relighter.flops, round(fit_seconds, 3), seconds, {"status": model.relighter.report.status})


def record(budget: Budget, model: Model, bakery: Bakery) -> dict[str, Any]:
    """Everything that budget.json holds."""
    config, parts = bakery.config, budget.parts
    knobs = weigh_knobs(budget, model, bakery)
    size, flops = shipped_bytes(model, config.export.precision), model.relighter.flops
    baked = _seconds_of_bake(bakery.folder.parent / "run.json")
    document: dict[str, Any] = {
        "schema": 1,
        "scene": bakery.scene.name,
        "method": model.method,
        "lightings": len(budget.lightings),
        "truth_noise": budget.truth_noise,
        "chance": budget.chance,
        "scenario": config.budget.scenario,
        **parts.record(),
        "now": {"relative_rmse": float(np.sqrt(max(parts.squared, 0))), "bytes": size, "flops": flops, "bake_seconds": baked},
        "predicted": [asdict(knob) for knob in knobs],
        "measured": None,
    }
    if knobs and config.budget.turn:
        with bakery.progress.stage(f"budget: turning {knobs[0].setting}"):
            document["measured"] = asdict(turn(knobs[0], budget, bakery))
    return document | {"advice": advice(document)}


def advice(document: dict[str, Any]) -> str:
    """Which knob to turn first, in words."""
    now, parts = document["now"], {part["cause"]: part["share"] for part in document["parts"]}
    largest = max(parts, key=lambda cause: parts[cause])
    if not document["predicted"]:
        return f"{largest} is the largest part, {parts[largest]:.0%} of the squared error; no knob is known to work on it."
    first = document["predicted"][0]
    words = (
        f"Turn {first['setting']} first, from {first['now']} to {first['then']}: {first['cause']} is "
        f"{parts[first['cause']]:.0%} of the squared error. Expected: {now['relative_rmse']:.2%} becomes "
        f"{first['relative_rmse']:.2%} ({first['why']})"
    )
    costs = [
        f"{first[key] / now[key]:.2g} times the {name}"
        for key, name in (("bytes", "bytes"), ("flops", "operations a frame"))
        if first[key] and first[key] != now[key]
    ]
    if first["bakes"]:
        costs.append("another bake" + (f" of {first['effort']:.2g} times the time" if first["effort"] else ""))
    words += f", for {', '.join(costs)}." if costs else ", at no cost to model or bake."
    if parts[largest] > parts[first["cause"]]:
        words += f" The largest part, {largest}, is {parts[largest]:.0%}, but no knob is expected to gain as much there."
    done = document["measured"]
    if done is None:
        return words + " It was not turned (budget.turn = false)."
    seconds = f", {done['bake_seconds']:.3g} s of baking" if done["bake_seconds"] else ""
    return words + (
        f" Turned: {done['relative_rmse']:.2%}, with {done['bytes']} bytes (before: {now['bytes']}), {done['flops']} "
        f"operations (before: {now['flops']}){seconds} and {done['fit_seconds']:.3g} s of fitting."
    )


def _against_noise(budget: Budget, config: Config) -> Knob:
    transport, expected = config.transport, _left(budget, "noise", 0.25)
    why = "half the noise is a quarter of its square"
    if transport.samples == "auto":
        now = transport.target_noise
        return Knob("noise", "transport.target_noise", now, max(now / 2, 1e-4), expected, why, True, 4.0)
    return Knob("noise", "transport.samples", transport.samples, min(4 * transport.samples, 65536), expected, why, True, 4.0)


def _against_bias(budget: Budget, config: Config) -> Knob | None:
    if config.transport.integrator in ("paths", "reference"):
        return None
    resolution, cause = config.atlas.resolution, "operator bias"
    now = min(config.transport.sender_resolution or _SENDERS, resolution)
    if now < min(resolution, 1024):
        then, why = min(2 * now, resolution, 1024), "bias falls with the square of the width of what light is averaged over"
        return Knob(cause, "transport.sender_resolution", now, then, _left(budget, cause, (now / then) ** 4), why, True, None)
    return Knob(cause, "transport.integrator", "operator", "paths", _left(budget, cause, 0.0), "paths are unbiased", True, None)


def _against_truncation(budget: Budget, config: Config) -> Knob | None:
    relighter = budget.clean.relighter
    if not isinstance(relighter, LinearTransfer):
        return None
    now = config.fit.bases
    more = min(len(relighter.basis), relighter.report.numerical_rank - len(relighter.basis))
    if more <= 0:
        return None
    knob = Knob("truncation", "fit.bases", now, now + more, 0.0, _LOOKED)
    yard = budget.yardsticks
    return replace(knob, relative_rmse=_looked(budget, yard.bounded(yard.clean, yard.train), _turned(config, knob)))


def _against_measurement(budget: Budget, config: Config) -> Knob | None:
    """The part fell from half the points to all, and is expected to fall once more by as much."""
    model, yard = budget.model, budget.yardsticks
    points = model.points
    if not isinstance(model.relighter, LinearTransfer) or points < 2 or config.points.file:
        return None
    fewer = best_transfer(replace(model, points=points // 2), *yard.unseen())
    values = yard.clean.values(yard.clean.split("test"), points // 2, model.quantity)
    one, other = (projected(model, budget.values, half) for half in budget.own)
    before = squared_error(fewer.predict(values, clamp=False, constant=False), (one, other), budget.weight)
    now = budget.parts.part("measurement") * budget.parts.mean**2
    expected = _left(budget, "measurement", float(np.clip(now / before, 0.0, 1.0)) if before > 0 else 1.0)
    why = f"as from {points // 2} points to {points}"
    if 0 < config.fit.points < config.points.count:
        more = min(2 * config.fit.points, config.points.count)
        return Knob("measurement", "fit.points", config.fit.points, more, expected, why)
    return Knob("measurement", "points.count", config.points.count, 2 * config.points.count, expected, why, True)


def _against_regularisation(budget: Budget, config: Config) -> Knob | None:
    """None where the lightings come from a file: no more of their kind can be drawn."""
    if config.lightings.file:
        return None
    yard = budget.yardsticks
    knob = Knob("regularisation", "lightings.train", yard.train, 2 * yard.train, 0.0, _LOOKED, True, 2.0)
    if config.budget.abundance < 2:
        why = "variance falls as one over the number of lightings"
        return replace(knob, relative_rmse=_left(budget, knob.cause, 0.5), why=why)
    return replace(knob, relative_rmse=_looked(budget, yard.bounded(yard.clean, knob.then), config))


def _against_scenario(budget: Budget, config: Config) -> Knob | None:
    wanted, cause = config.budget.scenario, "scenario shift"
    if not wanted:
        return None
    now = {key: getattr(config.lightings, key) for key in wanted}
    why = "trained on as held out; what the basis gains is not counted"
    return Knob(cause, "lightings", now, dict(wanted), _left(budget, cause, 0.0), why, True)


def _against_quantisation(budget: Budget, config: Config) -> Knob | None:
    if config.export.precision == "float":
        return None
    expected = _left(budget, "quantisation", 0.0)
    return Knob("quantisation", "export.precision", config.export.precision, "float", expected, "float32 rounds by 6e-8")


def _against_mismatch(budget: Budget, config: Config) -> Knob | None:
    cause, now = "runtime mismatch", config.budget.shadow_map
    if 2 * now > 8192:
        return None
    why = "what is misjudged lies within a texel of a shadow's edge"
    return Knob(cause, "budget.shadow_map", now, 2 * now, _left(budget, cause, 0.5), why)


def _left(budget: Budget, cause: str, kept: float) -> float:
    """Relative RMSE of the whole if a share of a part's square were left."""
    return float(np.sqrt(max(budget.parts.shrunk(cause, kept), 0.0)))


def _looked(budget: Budget, data: Dataset, config: Config) -> float:
    """Relative RMSE of the whole by a fit on clean maps: what that gains there it is expected to gain on those of the run."""
    before, after = (
        squared_error(model.predict(budget.values, clamp=False, constant=False), budget.truth, budget.weight)
        / budget.parts.mean**2
        for model in (budget.clean, fit_config(data, config, budget.clean.method))
    )
    return float(np.sqrt(max(budget.parts.squared + after - before, 0.0)))


def _size(knob: Knob, model: Model, config: Config) -> dict[str, Any]:
    """Bytes and operations of the model that a turned knob is expected to give."""
    precision = _turned(config, knob).export.precision
    if not isinstance(model.relighter, LinearTransfer):
        return {"bytes": shipped_bytes(model, precision), "flops": model.relighter.flops}
    groups, bases, inputs = model.relighter.matrix.shape
    entries, now = model.relighter.basis.shape[1], model.relighter
    bases += knob.then - knob.now if knob.setting == "fit.bases" else 0
    inputs *= 2 if knob.cause == "measurement" else 1
    shapes = {"matrix": (groups, bases, inputs), "offset": (groups, inputs), "intercept": (groups, bases)}
    blank = replace(now, **{name: jnp.zeros(shape) for name, shape in {**shapes, "basis": (bases, entries)}.items()})  # type: ignore[arg-type]
    return {"bytes": shipped_bytes(replace(model, relighter=blank), precision), "flops": blank.flops}


def _turned(config: Config, knob: Knob) -> Config:
    if knob.setting == "lightings":
        return config
    section, name = knob.setting.split(".")
    document = config.model_dump(mode="json")
    document[section][name] = knob.then
    return checked(document)


def _baked(knob: Knob, config: Config, budget: Budget, bakery: Bakery) -> tuple[Dataset, float | None]:
    """The dataset that a turned knob learns from, and the seconds of its bake; None where it lay there."""
    data = bakery.data
    if not knob.bakes:
        return data, None
    train, validation = ([data.lightings[i] for i in data.split(split)] for split in ("train", "validation"))
    if knob.setting == "lightings":
        train = bakery.more(len(train), scenario=True)
    if knob.setting == "lightings.train":
        train = [*train, *bakery.more(knob.then - len(train))]
    before = len(bakery.progress.stages)
    lightings = {"train": train, "validation": validation, "test": budget.lightings[:1]}
    baked = bakery.bake("turned", lightings, config=config, transport={"test_samples": 2})
    stages = bakery.progress.stages[before:]
    spent = sum(float(stage["seconds"]) for stage in stages)
    return baked, round(spent, 2) if any(stage.get("rays") for stage in stages) else None


def _seconds_of_bake(path: Path) -> float | None:
    """What the run's own bake took, by its record; None where there is none."""
    try:
        stages = json.loads(path.read_text())["stages"]
        names = ("lightings", "atlas", "points", "direct", "indirect train")
        return round(sum(float(stage["seconds"]) for stage in stages if stage["name"] in names), 2) or None
    except (OSError, ValueError, KeyError, TypeError):
        return None
