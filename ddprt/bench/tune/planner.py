"""Which setting to try next so that a budget is met with few trials: models of cost and error, fitted as trials come in.

A trial bakes, which is dear; how many bases are kept and in which precision they are stored is then a matter of
milliseconds. So a place is a choice of the dear knobs, and each trial of a place tells the errors of all numbers of bases at
once. Costs are power laws of the knobs: log q = c + sum beta log(knob / base), whose exponents have a prior from how the code
works and learn from the trials (Bayesian linear regression). Squared errors add up: e² = truncation² + rest², where truncation
depends on the bases alone and the rest, what even all bases leave, is a power law of the knobs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import exp, log

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

from ddprt.axes import Float64

QUANTITIES = ("relative_rmse", "frame_us", "megabytes", "bake_seconds", "fit_seconds")
"""What a budget may limit."""
KNOBS = ("atlas.resolution", "lightings.train", "transport.target_noise", "points.count")
"""Dear knobs, each of which asks for another bake."""
SURE = 0.9
"""Chance of meeting a limit from which a plan counts as safe."""
HOPELESS = 0.02
"""Chance below which it counts as out of reach."""
_WORTHWHILE = 0.05  # promised fall of the error, in logarithms, that another bake is made for
_AGAIN = 0.03  # by how much a measurement differs when it is made again, in logarithms
_BETTER = 0.05  # by how much another setting has to be likelier that is baked although one was found within the limits
_TINY = 1e-12
_FREE = 3.0  # standard deviation of a constant that nothing is known of, in logarithms

_PRIOR: dict[str, tuple[tuple[float, ...], tuple[float, ...], float]] = {
    "rest": ((-0.4, -0.5, 0.1, -0.3), (0.4, 0.4, 0.15, 0.3), 0.05),
    "frame_us": ((2.0, 0.0, 0.0, 0.0), (0.3, 0.01, 0.01, 0.05), 0.08),
    "megabytes": ((2.0, 0.0, 0.0, 0.05), (0.05, 0.001, 0.001, 0.05), 0.01),
    "bake_seconds": ((1.5, 0.6, -0.8, 0.1), (0.5, 0.4, 0.5, 0.15), 0.1),
    "fit_seconds": ((1.3, 1.0, 0.0, 0.3), (0.5, 0.5, 0.02, 0.3), 0.1),
}
"""Exponents of the knobs, how sure they are, and by how much a measurement is off its law, in logarithms."""

Place = tuple[float, ...]
"""Values of `KNOBS`."""
Rank = tuple[float, float, float]
"""How good a plan is, the higher the better: how likely it is to meet the budget, how near it is, how cheap or exact."""


@dataclass(frozen=True)
class Plan:
    """A setting that could be tried: a place, a number of bases, a precision."""

    place: Place
    bases: int
    precision: str


@dataclass(frozen=True)
class Trial:
    """What a place was found to be.

    Attributes:
      place: where.
      bases: numbers of bases that were scored, rising.
      errors: relative RMSE at each.
      error_spread, error_skew: of its logarithm over held-out lightings, see `ddprt.bench.tune.held_out.spread_of`.
      frame_us: at each, the median of some frames.
      frame_spread: of its logarithm, at each: a median's standard deviation as far as it can be told, see `spread_of_time`
        in `ddprt.bench.tune.curves`.
      megabytes: at each, by precision.
      bake_seconds, fit_seconds: of the whole.
    """

    place: Place
    bases: tuple[int, ...]
    errors: tuple[float, ...]
    error_spread: float
    error_skew: float
    frame_us: tuple[float, ...]
    frame_spread: tuple[float, ...]
    megabytes: dict[str, tuple[float, ...]]
    bake_seconds: float
    fit_seconds: float


@dataclass(frozen=True)
class Guess:
    """Logarithm of a quantity: what is expected, how far off that may be, and how much farther off above than below.

    Attributes:
      mean, spread: of a Gaussian, were it not skewed.
      skew: third moment of the estimate over the cube of its spread; above 0 where few large values make up a mean, of which
        a sample mostly has too few, and then looks both smaller and surer than it is.
    """

    mean: float
    spread: float
    skew: float = 0.0

    def chance(self, limit: float) -> float:
        """Logarithm of the chance that it is within a limit.

        Hall's cubic, which turns a skewed Student's t into a Gaussian to second order and rises everywhere (P. Hall, On the
        removal of skewness by transformation, J. R. Stat. Soc. B 54, 1992). Without skew it is the Gaussian.
        """
        t, skew = (self.mean - log(limit)) / max(self.spread, 1e-6), self.skew
        return float(log_ndtr(-(t + skew * t**2 / 3 + skew**2 * t**3 / 27 + skew / 6)))

    def quantile(self, chance: float) -> float:
        """The limit that it is within by so much of a chance: what `chance` does, turned about."""
        x, skew = -float(ndtri(chance)), self.skew
        t = 3 / skew * float(np.cbrt(1 + skew * (x - skew / 6)) - 1) if abs(skew) > 1e-6 else x
        return exp(self.mean - max(self.spread, 1e-6) * t)


@dataclass(frozen=True)
class Law:
    """A power law with what is known of its constant and exponents.

    Attributes:
      mean, covariance: of (constant, exponents), in logarithms.
      noise: by how much a measurement is off it.
    """

    mean: Float64[np.ndarray, " terms"]
    covariance: Float64[np.ndarray, "terms terms"]
    noise: float

    @classmethod
    def of(
        cls,
        rows: Float64[np.ndarray, "trials terms"],
        told: Float64[np.ndarray, " trials"],
        exponents: tuple[float, ...],
        sure: tuple[float, ...],
        noise: float,
    ) -> "Law":
        """After trials: the posterior of a Gaussian prior under Gaussian noise."""
        told = np.log(np.maximum(told, _TINY))
        prior = np.concatenate([[told[0] - rows[0, 1:] @ exponents], exponents])  # the constant is about that of the first
        precision = np.diag(1 / np.array([_FREE, *sure]) ** 2)
        covariance = np.linalg.inv(precision + rows.T @ rows / noise**2)
        return cls(covariance @ (precision @ prior + rows.T @ told / noise**2), covariance, noise)

    def at(self, row: Float64[np.ndarray, " terms"]) -> Guess:
        """What it says of a place."""
        return Guess(float(row @ self.mean), float(np.sqrt(row @ self.covariance @ row + self.noise**2)))


@dataclass
class Planner:
    """Remembers trials, and says what to try next.

    Args:
      base: the place that all others are relative to.
      values: what each knob may be, in the order of `KNOBS`.
      bases: numbers of bases that may be asked for, rising.
      precisions: that may be stored.
      limits: the budget; quantities that are missing are free.
    Attributes:
      trials: what was learned from, at places made of `values`.
      barred: places that cannot be baked, so none that was tried.
    """

    base: Place
    values: Sequence[Sequence[float]]
    bases: Sequence[int]
    precisions: Sequence[str]
    limits: Mapping[str, float]
    trials: list[Trial] = field(default_factory=list, init=False)
    barred: set[Place] = field(default_factory=set, init=False)
    _laws: dict[str, Law] = field(default_factory=dict, init=False)

    def add(self, trial: Trial) -> None:
        """Learns from a trial."""
        self.trials.append(trial)
        self.barred.discard(trial.place)  # whatever others let expect
        self._learn()

    def replace(self, trial: Trial) -> None:
        """Learns what a place is found to be when it is looked at again."""
        self.trials = [trial if other.place == trial.place else other for other in self.trials]
        self._learn()

    def bar(self, place: Place, knob: str) -> int:
        """Leaves out a place that cannot be baked, and those that cannot for the same reason.

        Args:
          place: that was tried.
          knob: that is to blame. A resolution that cannot be unwrapped cannot whatever the others are; what has too few texels
            for its points has too few for more of them. Any other leaves out the place alone.
        Returns:
          How many places are left out now that were not before.
        """
        before, at, tried = len(self.barred), KNOBS.index("points.count"), {trial.place for trial in self.trials}
        self.barred |= {
            other
            for other in product(*self.values)
            if other == place or (other[0] == place[0] and (knob == KNOBS[0] or (knob == KNOBS[at] and other[at] >= place[at])))
        } - tried
        return len(self.barred) - before

    def _learn(self) -> None:
        rows = np.array([self._row(each.place) for each in self.trials])
        self._laws = {
            name: Law.of(rows, np.array([_told(name, each) for each in self.trials]), *_PRIOR[name]) for name in _PRIOR
        }

    def next(self) -> tuple[Plan, float]:
        """The plan to try or to take next, and the chance that it meets the budget.

        A plan whose place was tried is taken as soon as it is safe. Before that, the likeliest to meet the budget, or the
        nearest to it where none is likely at all; of plans that are safe, the cheapest bake. Where no error is asked for it is
        the least one that is safe, and a place that was tried is only left for one that promises a twentieth less. At least
        one place was tried before.
        """
        _, plan, likely = self._next(self.limits)
        return plan, exp(likely)

    def rank(self, plan: Plan) -> Rank:
        """How good a plan is, as far as it is known."""
        return _rank(self.guesses(plan), self.limits)

    def undecided(self, plan: Plan) -> bool:
        """Whether more held-out lightings may tell if a plan meets the budget, which else it seems to meet.

        While there may be more, it is decided when a chance of one in fifty is left that it is otherwise: looking again and
        again would let chance in often enough if nine in ten were taken for sure each time.
        """
        guesses = self.guesses(plan)
        error, limit = guesses["relative_rmse"], self.limits.get("relative_rmse")
        if limit is None or error.spread <= _AGAIN:
            return False
        others = [name for name in self.limits if name != "relative_rmse"]
        within = all(guesses[name].mean <= log(self.limits[name]) for name in others)
        return within and log(HOPELESS) < error.chance(limit) < log(1 - HOPELESS)

    def telling(self, plan: Plan, times: int = 2) -> float:
        """Chance that so many times as many held-out lightings decide about a plan whose error has a limit.

        They divide the square of the spread by as much, and by the rest of it the mean may move. In units of the new spread,
        the room t to the limit becomes a Gaussian about sqrt(times) t, of standard deviation sqrt(times - 1), without skew.
        """
        error = self.guesses(plan)["relative_rmse"]
        room = np.sqrt(times) * (log(self.limits["relative_rmse"]) - error.mean) / error.spread
        moved = np.sqrt(times - 1)
        return float(ndtr((room - ndtri(SURE)) / moved) + ndtr((ndtri(HOPELESS) - room) / moved))

    def surer(self, plan: Plan) -> Plan | None:
        """A plan elsewhere that is likelier to meet the budget than one that was tried, should all be as expected there.

        What is not tried is known less well, so that it rarely looks likelier as it stands. Here it is taken for known as well
        as what was tried.

        Returns:
          The likeliest; None where none would be sure, or likelier by a twentieth, and where the plan is sure already.
        """
        known = self.guesses(plan)
        before, found, most = exp(_likely(known, self.limits)), None, 0.0
        if before >= SURE:
            return None
        tried = {trial.place for trial in self.trials}
        for place in product(*self.values):
            if place in self.barred or place in tried:
                continue
            told = self._of_place(place)
            for bases, precision in product(self.bases, self.precisions):
                expected = self._guesses(told, bases, precision)
                likely = exp(_likely({name: replace(known[name], mean=expected[name].mean) for name in known}, self.limits))
                if likely > most:
                    found, most = Plan(place, bases, precision), likely
        return found if most >= min(before + _BETTER, SURE) else None

    def cost(self, place: Place) -> float:
        """Seconds of a bake and a fit, as measured or else as expected."""
        _, known, laws, _ = self._of_place(place)
        if known:
            return next(seconds(trial) for trial in self.trials if trial.place == place)
        return exp(laws["bake_seconds"].mean) + exp(laws["fit_seconds"].mean)

    def cost_of_all(self) -> float:
        """Seconds that it would take to try every place that can be baked."""
        return sum(self.cost(place) for place in product(*self.values) if place not in self.barred)

    def hopeless(self, chance: float) -> bool:
        """Whether a chance is too small to go on."""
        return len(self.trials) > 1 and chance < HOPELESS

    def binding(self) -> str:
        """The limit without which the rest of the budget would be met most easily."""
        if len(self.limits) == 1:
            return next(iter(self.limits))
        gains = {}
        for name in self.limits:
            rank, _, likely = self._next({other: limit for other, limit in self.limits.items() if other != name})
            gains[name] = *rank[:2], likely  # what a rank ends with is not the same without a limit of the error
        return max(gains, key=lambda name: gains[name])

    def guesses(self, plan: Plan) -> dict[str, Guess]:
        """What is expected of a plan: as measured where its place was tried, else by the laws."""
        return self._guesses(self._of_place(plan.place), plan.bases, plan.precision)

    def _next(self, limits: Mapping[str, float]) -> tuple[Rank, Plan, float]:
        """What `next` says of these limits: with its rank, and the logarithm of its chance."""
        best: dict[bool, tuple[Rank, Plan, float]] = {}
        for place in product(*self.values):
            if place in self.barred:
                continue
            told = self._of_place(place)
            for bases, precision in product(self.bases, self.precisions):
                guesses = self._guesses(told, bases, precision)
                rank, tried = _rank(guesses, limits), told[1]
                if tried not in best or rank > best[tried][0]:
                    best[tried] = rank, Plan(place, bases, precision), _likely(guesses, limits)
        there, elsewhere = best[True], best.get(False)
        if elsewhere is None:
            return there
        promised = elsewhere[0][2] - there[0][2]
        safe = there[0][0] == log(SURE) and ("relative_rmse" in limits or promised < _WORTHWHILE)
        return there if safe or there[0] >= elsewhere[0] else elsewhere

    def _of_place(self, place: Place) -> tuple[Trial, bool, dict[str, Guess], dict[str, float]]:
        """The trial to tell a place from, whether it is that very place's, the laws there, and how far they moved from it."""
        known = next((trial for trial in reversed(self.trials) if trial.place == place), None)
        trial, row = known or self.trials[-1], self._row(place)
        laws = {name: law.at(row) for name, law in self._laws.items()}
        there = self._row(trial.place)
        return trial, known is not None, laws, {name: laws[name].mean - law.at(there).mean for name, law in self._laws.items()}

    def _guesses(
        self, told: tuple[Trial, bool, dict[str, Guess], dict[str, float]], bases: int, precision: str
    ) -> dict[str, Guess]:
        trial, known, laws, moved = told
        error, spread, skew = _between(trial.bases, trial.errors, bases), trial.error_spread, trial.error_skew
        if not known:
            # What is left at the most bases is the rest; what fewer add to it is truncation, the same wherever it is looked at.
            truncation, rest = max(error**2 - min(trial.errors) ** 2, 0.0), np.exp(2 * laws["rest"].mean)
            error = float(np.sqrt(truncation + rest))
            whole = float(np.hypot(spread, rest / error**2 * laws["rest"].spread))
            spread, skew = whole, skew * (spread / whole) ** 3  # third moments add up, and a law's is 0
        found = {"relative_rmse": Guess(log(max(error, _TINY)), max(spread, 1e-3), skew)}
        off = {"frame_us": max(_AGAIN, _between(trial.bases, trial.frame_spread, bases)), "megabytes": 0.0}  # bytes are counted
        for name, curve in (("frame_us", trial.frame_us), ("megabytes", trial.megabytes[precision])):
            certain = known and bases in trial.bases
            farther = off[name] if certain else max(off[name], laws[name].spread)
            found[name] = Guess(log(_between(trial.bases, curve, bases)) + moved[name], farther)
        for name in ("bake_seconds", "fit_seconds"):
            found[name] = Guess(log(getattr(trial, name)), _AGAIN) if known else laws[name]
        return found

    def _row(self, place: Place) -> np.ndarray:
        return np.concatenate([[1.0], np.log(np.array(place) / np.array(self.base))])


def seconds(trial: Trial) -> float:
    """What a place cost: its bake, and one fit."""
    return trial.bake_seconds + trial.fit_seconds


def _likely(guesses: Mapping[str, Guess], limits: Mapping[str, float]) -> float:
    """Logarithm of the chance that all limits are kept."""
    return float(sum(guesses[name].chance(limit) for name, limit in limits.items()))


def _rank(guesses: Mapping[str, Guess], limits: Mapping[str, float]) -> Rank:
    """Plans that are safe are alike likely, and so are hopeless ones, of which the nearest exceeds the limits by the least.

    So far from its limit, a chance tells how well a quantity is known, not how much too large it is.
    """
    likely = _likely(guesses, limits)
    beyond = sum(max(guesses[name].mean - log(limit), 0.0) for name, limit in limits.items())
    least = "bake_seconds" if "relative_rmse" in limits else "relative_rmse"
    return min(max(likely, log(HOPELESS)), log(SURE)), -beyond if likely < log(HOPELESS) else 0.0, -guesses[least].mean


def _told(name: str, trial: Trial) -> float:
    """What a trial says to a law: curves over the bases speak through their middle."""
    if name == "rest":
        return min(trial.errors)
    if name == "frame_us":
        return float(np.exp(np.mean(np.log(trial.frame_us))))
    if name == "megabytes":
        return float(np.exp(np.mean(np.log(next(iter(trial.megabytes.values()))))))
    return float(getattr(trial, name))


def _between(bases: Sequence[int], values: Sequence[float], wanted: int) -> float:
    """A curve over the number of bases at a number between, straight in logarithms."""
    return float(np.exp(np.interp(np.log(wanted), np.log(bases), np.log(np.maximum(values, _TINY)))))
