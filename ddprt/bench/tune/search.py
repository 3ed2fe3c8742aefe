"""`ddprt tune`: the setting that meets a budget, found by few trials, and a configuration that makes it again."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.bench.measure.settings import Setting, changed
from ddprt.bench.measure.timing import timed
from ddprt.bench.measure.trial import Workshop, about, environment, why
from ddprt.bench.tune.held_out import HeldOut, error_of, spread_of
from ddprt.bench.tune.planner import KNOBS, QUANTITIES, Place, Plan, Planner, Trial
from ddprt.config import Config
from ddprt.dataset.forecast import forecast
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import alone_in, append_line, make_folder, write_text
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config

BASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
_SCORED = (1, 2, 4, 8, 16, 32, 64, 128)
_PRECISIONS = ("half", "float")
FACTORS: dict[str, tuple[float, ...]] = {
    "atlas.resolution": (0.25, 0.5, 2**-0.5, 1.0),
    "lightings.train": (0.125, 0.25, 0.5, 1.0, 2.0),
    "transport.target_noise": (0.5, 1.0, 2.0, 4.0, 8.0),
    "points.count": (0.5, 1.0, 2.0, 4.0),
}
_LEAST = {"atlas.resolution": 16, "lightings.train": 4, "transport.target_noise": 1e-3, "points.count": 4}
_SURE = 0.9
_FRAMES = 50  # timings of a frame
UNITS = {"relative_rmse": "", "frame_us": " µs", "megabytes": " MB", "bake_seconds": " s", "fit_seconds": " s"}


@dataclass(frozen=True)
class Outcome:
    """What came of a search.

    Attributes:
      plan: the best that was tried.
      reached: each of `QUANTITIES`, as measured.
      chance: that lightings of another seed are within the limits, too.
      met: whether the budget is met.
      binding: the limit that stands in the way, or that was met with the least room.
      trials: bakes that were made.
      held_out: lightings that the error was told on.
      setting: the plan as a configuration.
      limits: what was asked for.
    """

    plan: Plan
    reached: dict[str, float]
    chance: float
    met: bool
    binding: str
    trials: int
    held_out: int
    setting: Setting
    limits: dict[str, float]


class Search:
    """Trials until the budget is met, is out of reach, or `tune.trials` are used up.

    Args:
      config: the base, with its [tune] section.
      workshop: where settings are tried.
      factors: what each of `KNOBS` may be, over the base.
      measure: what is found at a place, for those who know it already; None bakes there.
      expected: seconds that the base's bake is forecast to take, for those who know; None forecasts where that matters.
    Raises:
      UserError: no limit is set, or another method than svd-ridge is to be tuned.
    """

    def __init__(
        self,
        config: Config,
        workshop: Workshop,
        factors: Mapping[str, Sequence[float]] = FACTORS,
        measure: Callable[[Place], Trial] | None = None,
        expected: float | None = None,
    ) -> None:
        limits = {name: getattr(config.tune, f"max_{name}") for name in QUANTITIES}
        self.limits = {name: limit for name, limit in limits.items() if limit > 0}
        if not self.limits:
            raise UserError(
                "ddprt tune: got no limit, expected at least one of "
                + ", ".join(f"--max-{name.replace('_', '-')}" for name in QUANTITIES)
                + "; give one"
            )
        if config.fit.method != "svd-ridge":
            raise UserError(f'fit.method: got "{config.fit.method}", expected "svd-ridge", whose bases are counted; set it')
        workshop.check(config)
        self.config, self.workshop = config, workshop
        self.base: Place = tuple(float(_value(config, knob)) for knob in KNOBS)
        values = [_around(config, knob, base, factors[knob]) for knob, base in zip(KNOBS, self.base, strict=True)]
        self._known = measure or self.measure
        self._expected = expected
        self.bases = tuple(
            count for count in BASES if count > (config.fit.centre == "mean")
        )  # the mean alone is another method
        self.planner = Planner(self.base, values, self.bases, _PRECISIONS, self.limits)
        self.held_out = HeldOut(workshop)
        self._failed = 0

    def run(self) -> Outcome:
        """Searches."""
        progress, planner = self.workshop.progress, self.planner
        start = self._start()
        if start == self.base or not self._tried(start):
            self._try(self.base)  # what hinders that is to be mended
        verified: dict[Plan, dict[str, float]] = {}
        while True:
            plan, chance = planner.next()
            tried = any(trial.place == plan.place for trial in planner.trials)
            if tried and plan not in verified:
                verified[plan] = self._verify(plan)
                continue
            if self._more_lightings(plan if tried else self._best_tried()):
                verified.clear()
                continue
            if tried or planner.hopeless(chance) or len(planner.trials) + self._failed >= self.config.tune.trials:
                break
            progress.say(f"next: {self._name(plan.place)}, a chance of {chance:.0%}")
            self._tried(plan.place)
        plan = self._best_tried()
        if plan not in verified:  # a better one lies where no trial may be made any more
            verified[plan] = self._verify(plan)
        plan = max(verified, key=lambda each: (self._meets(verified[each]), planner.rank(each)))
        reached, chance, met = verified[plan], self._chance(plan), self._meets(verified[plan])
        room = {name: limit / reached[name] for name, limit in self.limits.items()}
        binding = min(room, key=lambda name: room[name]) if met else planner.binding()
        trials, lightings = len(planner.trials), self.held_out.count
        return Outcome(plan, reached, chance, met, binding, trials, lightings, self.setting(plan), self.limits)

    def _more_lightings(self, plan: Plan) -> bool:
        """Doubles the held-out lightings if that may decide about a plan, and scores all that was tried on them.

        They never cost more than the trials have: another trial is what they are drawn in place of.
        """
        if not self.planner.undecided(plan):
            return False
        spent = sum(trial.bake_seconds + trial.fit_seconds for trial in self.planner.trials)
        if not self.held_out.more(self.limits["relative_rmse"], spent):
            return False
        for trial in self.planner.trials:
            self.planner.replace(self._scored_again(trial))
        return True

    def _start(self) -> Place:
        """The base, or a coarser place where a forecast says that baking the base alone takes several budgets."""
        limit = self.limits.get("bake_seconds")
        if limit is None:
            return self.base
        expected = self._expected
        if expected is None:
            expected = forecast(self.workshop.scene, self.config, self.workshop.progress).training_seconds
        place = self.base
        for knob, step in ((2, 1), (1, -1), (0, -1)) * 4:
            if expected <= 2 * limit:
                break
            ladder = sorted(self.planner.values[knob])
            at = ladder.index(place[knob]) + step
            if 0 <= at < len(ladder):
                factor = ladder[at] / place[knob]
                expected *= factor ** (-0.8, 0.6, 1.5)[(2, 1, 0).index(knob)]
                place = (*place[:knob], ladder[at], *place[knob + 1 :])
        return place

    def _tried(self, place: Place) -> bool:
        """Whether a place can be baked; one that cannot is left out from now on."""
        try:
            self._try(place)
        except (UserError, MemoryError) as error:
            self._failed += 1
            self.bar(place, why(error))
            return False
        return True

    def bar(self, place: Place, reason: str) -> None:
        """Leaves out a place that cannot be baked, with all that cannot for the same reason, and tells so once."""
        count = self.planner.bar(place, reason.partition(":")[0])  # an error begins with the setting that is to blame
        alike = f", and {count - 1} more places for the same reason" if count > 1 else ""
        self.workshop.progress.say(f"left out: {self._name(place)}{alike}: {reason}")

    def _try(self, place: Place) -> None:
        """Learns what a place is."""
        trial = self._known(place)
        self.planner.add(trial)
        curve = ", ".join(f"{error:.3g} at {bases}" for bases, error in zip(trial.bases, trial.errors, strict=True))
        self.workshop.progress.say(
            f"trial {len(self.planner.trials)}: {self._name(place)}: {trial.bake_seconds:.1f} s of bake, error {curve} bases"
        )

    def measure(self, place: Place) -> Trial:
        """Bakes at a place, scores all numbers of bases, and notes it in trials.jsonl.

        Raises:
          UserError: whatever hinders a bake or a fit.
        """
        setting = self.setting(Plan(place, max(BASES), "float"))
        data, baked = self.workshop.bake(setting)
        model, fitted = self._fit(setting, data)
        most = model.relighter.report.bases
        sizes = [count for count in _SCORED if count in self.bases and count < most] + [most]
        shorter = [first_bases(model, count) for count in sizes]
        errors, spread, skew = self._curve(model, sizes)
        values = data.values(data.split("train")[:1], model.points, model.quantity)[0]
        trial = Trial(
            place,
            tuple(sizes),
            errors,
            spread,
            skew,
            tuple(_frame_us(one, values) for one in shorter),
            {name: tuple(shipped_bytes(one, name) / 1e6 for one in shorter) for name in _PRECISIONS},
            baked["seconds"],
            fitted,
        )
        record = {**about(setting), "trial": asdict(trial), "bake": baked, "environment": environment()}
        append_line(self.workshop.folder / "trials.jsonl", json.dumps(record, allow_nan=False))
        return trial

    def _curve(self, model: Model, sizes: Sequence[int]) -> tuple[tuple[float, ...], float, float]:
        """Errors at so many bases, and how sure that of the most is."""
        most = model.relighter.report.bases
        tallies = [self.held_out.tally(stored(without_last(model, most - count), "half")) for count in sizes]
        return tuple(map(error_of, tallies)), *spread_of(tallies[-1])

    def _scored_again(self, trial: Trial) -> Trial:
        """The same with its errors on all held-out lightings there are now."""
        setting = self.setting(Plan(trial.place, max(BASES), "float"))
        data, _ = self.workshop.bake(setting)
        errors, spread, skew = self._curve(self._fit(setting, data)[0], trial.bases)
        return replace(trial, errors=errors, error_spread=spread, error_skew=skew)

    def _verify(self, plan: Plan) -> dict[str, float]:
        """The plan itself, fitted and scored; the trial of its place takes over what differs from its curves."""
        setting = self.setting(plan)
        data, baked = self.workshop.bake(setting)
        model, fitted = self._fit(setting, data)
        model = stored(model, plan.precision)
        values = data.values(data.split("train")[:1], model.points, model.quantity)[0]
        tally = self.held_out.tally(model)
        reached = {
            "relative_rmse": error_of(tally),
            "frame_us": _frame_us(model, values),
            "megabytes": shipped_bytes(model, plan.precision) / 1e6,
            "bake_seconds": float(baked["seconds"]),
            "fit_seconds": fitted,
        }
        known = next(trial for trial in reversed(self.planner.trials) if trial.place == plan.place)
        self.planner.trials.remove(known)
        self.planner.add(with_measured(known, plan, reached, *spread_of(tally)))
        return reached

    def _fit(self, setting: Setting, data: Dataset) -> tuple[Model, float]:
        model, timing = timed(lambda: fit_config(data, setting.config, "svd-ridge"), 1)
        return model, timing.median

    def setting(self, plan: Plan) -> Setting:
        """A plan as a configuration."""
        changes: dict[str, Any] = {
            knob: value if knob == "transport.target_noise" else round(value)
            for knob, value, base in zip(KNOBS, plan.place, self.base, strict=True)
            if value != base
        }
        changes |= {"fit.bases": plan.bases, "export.precision": plan.precision}
        return Setting(changes, changed(self.config, changes))

    def _name(self, place: Place) -> str:
        turned = [(knob, value) for knob, value, base in zip(KNOBS, place, self.base, strict=True) if value != base]
        return ", ".join(f"{knob} = {value:g}" for knob, value in turned) or "as configured"

    def _meets(self, reached: Mapping[str, float]) -> bool:
        return all(reached[name] <= limit for name, limit in self.limits.items())

    def _chance(self, plan: Plan) -> float:
        guesses = self.planner.guesses(plan)
        return float(np.exp(sum(guesses[name].chance(limit) for name, limit in self.limits.items())))

    def _best_tried(self) -> Plan:
        places = [trial.place for trial in self.planner.trials]
        plans = [Plan(*parts) for parts in product(places, self.bases, _PRECISIONS)]
        return max(plans, key=self.planner.rank)


def tune(config: Config, folder: Path, progress: Any) -> Outcome:
    """Finds a setting within the limits of [tune], and writes it down as `tuned.toml` (or `nearest.toml`).

    Args:
      config: the base; its knobs are turned about where they stand, the resolution never above.
      folder: for trials and their datasets, which go when the search is over.
      progress: shown while working.
    Raises:
      UserError: no limit, or whatever hinders a bake.
    """
    make_folder(folder)
    with alone_in(folder):
        workshop = Workshop(config, folder, progress)
        (folder / "trials.jsonl").unlink(missing_ok=True)
        outcome = Search(config, workshop).run()
        for name in ("tuned.toml", "nearest.toml"):
            (folder / name).unlink(missing_ok=True)
        write_text(folder / ("tuned.toml" if outcome.met else "nearest.toml"), outcome.setting.config.to_toml())
        if not config.bench.keep:
            workshop.forget_all()
    return outcome


def first_bases(model: Model, count: int) -> Model:
    """The model with its first bases alone; a mean counts as one of them."""
    linear = model.relighter
    assert isinstance(linear, LinearTransfer), "the planner fits svd-ridge"
    report = linear.report
    kept = count - (report.bases - len(linear.basis))
    shorter = replace(linear, matrix=linear.matrix[:, :kept], intercept=linear.intercept[:, :kept], basis=linear.basis[:kept])
    return replace(model, relighter=replace(shorter, report=replace(report, bases=count)))


def without_last(model: Model, count: int) -> Model:
    """The same with its last bases black: shapes stay, so that nothing compiles again."""
    linear = model.relighter
    assert isinstance(linear, LinearTransfer), "the planner fits svd-ridge"
    return replace(model, relighter=linear.truncated(len(linear.basis) - count))


def with_measured(trial: Trial, plan: Plan, reached: dict[str, float], spread: float, skew: float) -> Trial:
    """A trial with one more number of bases on its curves, or with another value there."""
    rows = {
        bases: (error, frame, {name: sizes[i] for name, sizes in trial.megabytes.items()})
        for i, (bases, error, frame) in enumerate(zip(trial.bases, trial.errors, trial.frame_us, strict=True))
    }
    between = {name: float(np.interp(plan.bases, trial.bases, sizes)) for name, sizes in trial.megabytes.items()}
    rows[plan.bases] = reached["relative_rmse"], reached["frame_us"], {**between, plan.precision: reached["megabytes"]}
    order: Sequence[int] = sorted(rows)
    return replace(
        trial,
        bases=tuple(order),
        errors=tuple(rows[bases][0] for bases in order),
        error_spread=spread,
        error_skew=skew,
        frame_us=tuple(rows[bases][1] for bases in order),
        megabytes={name: tuple(rows[bases][2][name] for bases in order) for name in trial.megabytes},
        fit_seconds=reached["fit_seconds"],
    )


def told(outcome: Outcome) -> str:
    """The trade that was made, as a table and a sentence."""
    lines = [f"{'':<16}{'reached':>12}{'limit':>12}"]
    for name in QUANTITIES:
        limit = f"{outcome.limits[name]:.4g}{UNITS[name]}" if name in outcome.limits else "-"
        lines.append(f"{name:<16}{f'{outcome.reached[name]:.4g}{UNITS[name]}':>12}{limit:>12}")
    setting = f"{outcome.setting.name}, after {outcome.trials} bakes, on {outcome.held_out} held-out lightings"
    if outcome.met:
        lines.append(f"meets the budget: {setting}; the least room is left by {outcome.binding}")
        if outcome.chance < _SURE:
            lines.append(f"just so: other lightings may be beyond it (a chance of {outcome.chance:.0%} that they are not)")
    else:
        lines.append(f"no setting meets the budget; {outcome.binding} stands in the way; nearest: {setting}")
    return "\n".join(lines)


def _value(config: Config, knob: str) -> float:
    section, key = knob.split(".")
    return float(getattr(getattr(config, section), key))


def _around(config: Config, knob: str, base: float, factors: Sequence[float]) -> tuple[float, ...]:
    """What a knob may be; alone what it is where it has no effect."""
    still = (knob == "transport.target_noise" and config.transport.samples != "auto") or (
        knob == "points.count" and bool(config.points.file)
    )
    if still or (knob == "lightings.train" and config.lightings.file):
        return (base,)
    steps = {max(_LEAST[knob], factor * base) for factor in factors if factor != 1}
    if knob == "transport.target_noise":
        return tuple(sorted({base, *(min(1.0, float(f"{step:.3g}")) for step in steps)}))
    if knob == "atlas.resolution":
        return tuple(sorted({base, *(step for each in steps if (step := float(8 * round(each / 8))) < base)}))
    return tuple(sorted({base, *(float(round(step)) for step in steps)}))


def _frame_us(model: Model, values: np.ndarray) -> float:
    return 1e6 * timed(lambda: model.predict(values), _FRAMES)[1].median
