"""`ddprt tune`: the setting that meets a budget, found by few trials, and a configuration that makes it again."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.bench.measure.settings import Setting, changed
from ddprt.bench.measure.timing import timed
from ddprt.bench.measure.trial import Workshop, about, environment, why
from ddprt.bench.tune.curves import first_bases, time_of_frame, with_measured, without_last
from ddprt.bench.tune.fitted import Fitted
from ddprt.bench.tune.held_out import HeldOut, error_of
from ddprt.bench.tune.knobs import FACTORS, around, value_of
from ddprt.bench.tune.outcome import UNITS, Doubt, Outcome
from ddprt.bench.tune.planner import HOPELESS, KNOBS, QUANTITIES, SURE, Place, Plan, Planner, Trial, seconds
from ddprt.config import Config
from ddprt.dataset.forecast import forecast
from ddprt.errors import UserError
from ddprt.files import alone_in, append_line, make_folder, write_text
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config

BASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
_SCORED = (1, 2, 4, 8, 16, 32, 64, 128)
_PRECISIONS = ("half", "float")
_SHARE = 0.1  # of what it costs to try all places, beyond which nothing more is tried
_FEW = 3  # bakes that are made whatever they cost
_LIGHTINGS = 2.0  # times what the trials took, beyond which no more held-out lightings are drawn
_PAYS = 0.2  # chance that more held-out lightings decide, below which they are not drawn


class Search:
    """Trials until the budget is met, is out of reach, or `tune.trials` are used up.

    Args:
      config: the base, with its [tune] section.
      workshop: where settings are tried.
      factors: what each of `KNOBS` may be, over the base.
      measure: what is found at a place, for those who know it already; None bakes there.
      expected: seconds that the base's bake is forecast to take, for those who know; None forecasts where that matters.
      fits: of other searches in the same workshop, by place and number of bases; what is fitted comes to them.
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
        fits: dict[tuple[Place, int], Fitted] | None = None,
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
        self.base: Place = tuple(float(value_of(config, knob)) for knob in KNOBS)
        values = [around(config, knob, base, factors[knob]) for knob, base in zip(KNOBS, self.base, strict=True)]
        self._known = measure or self.measure
        self._expected = expected
        self._fits = {} if fits is None else fits
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
            found = None if planner.hopeless(chance) else self._elsewhere(None if tried else plan, chance)
            if found is None or not self._affords(found.place):
                break
            progress.say(f"next: {self._name(found.place)}, a chance of {self._chance(found):.0%}")
            self._tried(found.place)
        plan = self._best_tried()
        if plan not in verified:  # a better one lies where no trial may be made any more
            verified[plan] = self._verify(plan)
        plan = max(verified, key=lambda each: (self._meets(verified[each]), planner.rank(each)))
        reached, chance, met = verified[plan], self._chance(plan), self._meets(verified[plan])
        room = {name: limit / reached[name] for name, limit in self.limits.items()}
        binding = min(room, key=lambda name: room[name]) if met else planner.binding()
        trials, lightings = len(planner.trials), self.held_out.count
        doubt = self._doubt(plan if met or chance >= HOPELESS else planner.next()[0], met)
        return Outcome(plan, reached, chance, met, doubt, binding, trials, lightings, self.setting(plan), self.limits)

    def _elsewhere(self, plan: Plan | None, chance: float) -> Plan | None:
        """The plan to bake for next, if any is worth it.

        Where what was tried may do, for all that can be told, another place is only baked if it promises more: being as likely
        again is to throw the same dice once more.

        Args:
          plan: elsewhere, the likeliest; None where one that was tried is.
          chance: of the likeliest.
        """
        best = self._best_tried()
        before = self._chance(best)
        if plan is not None and (not HOPELESS <= before < SURE or chance > 2 * before):
            return plan
        return self.planner.surer(best)

    def _affords(self, place: Place) -> bool:
        """Whether one more bake is allowed: of so many, and with all before it for a share of what all places cost."""
        planner = self.planner
        if len(planner.trials) + self._failed >= self.config.tune.trials:
            return False
        spent = sum(map(seconds, planner.trials)) + self.held_out.seconds
        return len(planner.trials) < _FEW or spent + planner.cost(place) <= self._allowed()

    def _allowed(self) -> float:
        """Seconds that a search may take: a share of what all places are expected to, or a few bakes where that is more."""
        return max(_SHARE * self.planner.cost_of_all(), _FEW * max(map(seconds, self.planner.trials)))

    def _doubt(self, plan: Plan, met: bool) -> Doubt | None:
        """What is open about the likeliest plan; None where it is sure that it is within the limits, or out of reach."""
        guesses, chance = self.planner.guesses(plan), self._chance(plan)
        if chance >= SURE if met else chance < HOPELESS:
            return None
        quantity = min(self.limits, key=lambda name: guesses[name].chance(self.limits[name]))
        guess = guesses[quantity]
        low = guess.quantile(min(1 - SURE, float(np.exp(guess.chance(self.limits[quantity])))))
        high = guess.quantile(SURE)
        return Doubt(plan, self.setting(plan), chance, quantity, float(np.exp(guess.mean)), low, high)

    def _more_lightings(self, plan: Plan) -> bool:
        """Draws more held-out lightings if that may decide about a plan, and scores all that was tried on them.

        They never cost more than twice what the trials have, nor bring the whole beyond its share. After the first time they
        have to promise that they decide. Twice as many are drawn where these are likely to, else four times as many, since each
        bake costs something for itself.
        """
        planner = self.planner
        if not planner.undecided(plan):
            return False
        times = 2 if planner.telling(plan) > 0.5 else 4
        if self.held_out.seconds and planner.telling(plan, times) < _PAYS:
            return False
        tried = sum(map(seconds, planner.trials))
        left = self._allowed() - tried
        allowed = min(_LIGHTINGS * tried, left)

        def expected(count: int, noise: float) -> float:
            return planner.cost((self.base[0], float(count), noise, self.base[3]))

        if left <= 0 or not self.held_out.more(
            lambda: self.fitted(plan), self.limits["relative_rmse"], allowed, times, expected
        ):
            return False
        for trial in planner.trials:
            planner.replace(self.scored_again(trial))
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
        plan = Plan(place, max(BASES), "float")
        setting, found = self.setting(plan), self.fitted(plan)
        most = found.model.relighter.report.bases
        sizes = [count for count in _SCORED if count in self.bases and count < most] + [most]
        shorter = [first_bases(found.model, count) for count in sizes]
        errors, spread, skew = self._curve(found, sizes)
        frames = [time_of_frame(one, found.values) for one in shorter]
        trial = Trial(
            place,
            tuple(sizes),
            errors,
            spread,
            skew,
            tuple(frame for frame, _ in frames),
            tuple(off for _, off in frames),
            {name: tuple(shipped_bytes(one, name) / 1e6 for one in shorter) for name in _PRECISIONS},
            found.bake["seconds"],
            found.seconds,
        )
        record = {**about(setting), "trial": asdict(trial), "bake": found.bake, "environment": environment()}
        append_line(self.workshop.folder / "trials.jsonl", json.dumps(record, allow_nan=False))
        return trial

    def _curve(self, found: Fitted, sizes: Sequence[int]) -> tuple[tuple[float, ...], float, float]:
        """Errors at so many bases, and how sure that of the most is."""
        most = found.model.relighter.report.bases
        tallies = [self._tally(found, without_last(found.model, most - count), count, "half") for count in sizes]
        return tuple(map(error_of, tallies)), *self.held_out.spread(tallies[-1])

    def _tally(self, found: Fitted, model: Model, bases: int, precision: str) -> Tally:
        """Errors of a model as it ships, which is one that was fitted, or its first bases."""
        return self.held_out.tally(stored(model, precision), found.tallies.setdefault((bases, precision), {}))

    def scored_again(self, trial: Trial) -> Trial:
        """The same with its errors on all held-out lightings there are now."""
        errors, spread, skew = self._curve(self.fitted(Plan(trial.place, max(BASES), "float")), trial.bases)
        return replace(trial, errors=errors, error_spread=spread, error_skew=skew)

    def _verify(self, plan: Plan) -> dict[str, float]:
        """The plan itself, fitted and scored; the trial of its place takes over what differs from its curves."""
        found = self.fitted(plan)
        model = stored(found.model, plan.precision)
        tally = self._tally(found, found.model, model.relighter.report.bases, plan.precision)
        known = next(trial for trial in reversed(self.planner.trials) if trial.place == plan.place)
        curves = zip(known.bases, known.frame_us, known.frame_spread, strict=True)
        before = [(taken, spread) for bases, taken, spread in curves if bases == plan.bases]
        frame, off = time_of_frame(model, found.values, limit=self.limits.get("frame_us"), before=before)
        reached = {
            "relative_rmse": error_of(tally),
            "frame_us": frame,
            "megabytes": shipped_bytes(model, plan.precision) / 1e6,
            "bake_seconds": float(found.bake["seconds"]),
            "fit_seconds": found.seconds,
        }
        self.planner.trials.remove(known)
        self.planner.add(with_measured(known, plan, reached, *self.held_out.spread(tally), off))
        return reached

    def fitted(self, plan: Plan) -> Fitted:
        """A plan baked and fitted, now or before; in which precision it is stored does not matter."""
        key = plan.place, plan.bases
        if key not in self._fits:
            setting = self.setting(plan)
            data, baked = self.workshop.bake(setting)
            model, timing = timed(lambda: fit_config(data, setting.config, "svd-ridge"), 1)
            self._fits[key] = Fitted(model, data, baked, timing.median)
        return self._fits[key]

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
        write_text(folder / ("tuned.toml" if outcome.met else "nearest.toml"), outcome.setting.config.to_toml(folder))
        if not config.bench.keep:
            workshop.forget_all()
    return outcome


def told(outcome: Outcome) -> str:
    """The trade that was made, as a table and a sentence."""
    lines = [f"{'':<16}{'reached':>12}{'limit':>12}"]
    for name in QUANTITIES:
        limit = f"{outcome.limits[name]:.4g}{UNITS[name]}" if name in outcome.limits else "-"
        lines.append(f"{name:<16}{f'{outcome.reached[name]:.4g}{UNITS[name]}':>12}{limit:>12}")
    setting = f"{outcome.setting.name}, after {outcome.trials} bakes, on {outcome.held_out} held-out lightings"
    if outcome.met:
        sure = outcome.doubt is None
        lines.append(f"{'meets' if sure else 'may meet'} the budget: {setting}; the least room is left by {outcome.binding}")
    elif outcome.doubt is None:
        lines.append(f"no setting meets the budget; {outcome.binding} stands in the way; nearest: {setting}")
    else:
        lines.append(f"no setting is known to meet the budget; nearest: {setting}")
    if doubt := outcome.doubt:
        name, unit = doubt.quantity, UNITS[doubt.quantity]
        lines.append(
            f"undecided within {doubt.within:.0%}, it cannot be shown: {name} lies at {doubt.expected:.3g}{unit}, between "
            f"{doubt.low:.3g} and {doubt.high:.3g}, the limit is {outcome.limits[name]:.3g}"
        )
        which = "" if doubt.plan == outcome.plan else f" with {doubt.setting.name}"
        lines.append(f"the chance that the limits are kept{which} is {doubt.chance:.0%}")
    return "\n".join(lines)
