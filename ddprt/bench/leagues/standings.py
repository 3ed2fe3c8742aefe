"""Who wins in which league, by how much against the spread, and on which kind of lighting."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ddprt.axes import Float64
from ddprt.bench.leagues.search import BASELINE
from ddprt.catalogue import Catalogue
from ddprt.sections import LeaguesConfig

Record = Mapping[str, Any]
SLACK = 1.5  # of the seconds: times of one and the same fit differ by that much on a machine that others use
_DRAWS = 2000  # of the held-out lightings, with repetition
_SMALL = 5e-4  # a difference that tables round to 0.0 % is none, however sure


@dataclass(frozen=True)
class League:
    """A budget that all keep to.

    Attributes:
      key: of a trial's record and of `Budgets`.
      title: in words.
      form: as numbers are written: "bytes", "count" or "seconds".
    """

    key: str
    title: str
    form: str


LEAGUES: Catalogue[League] = Catalogue(
    "league",
    {
        "bytes": League("bytes", "shipped bytes", "bytes"),
        "flops": League("flops", "operations per frame", "count"),
        "seconds": League("seconds", "training seconds", "seconds"),
    },
)


@dataclass(frozen=True)
class Budgets:
    """What may be spent in each league."""

    bytes: float | int
    flops: float | int
    seconds: float | int


def budgets_of(asked: LeaguesConfig, baseline: Sequence[Record]) -> Budgets:
    """Those that are given, else what the baseline takes as configured, at most over the seeds; see `SLACK`."""
    most = {key: max(record[key] for record in baseline) for key in LEAGUES}
    return Budgets(asked.bytes or most["bytes"], asked.flops or most["flops"], asked.seconds or SLACK * most["seconds"])


def chosen(trials: Sequence[Record], league: str, budgets: Budgets) -> Record | None:
    """The trial of the least validation error that keeps the league's budget; None where none does."""
    key = LEAGUES[league].key
    within = [trial for trial in trials if not trial["failed"] and trial[key] <= getattr(budgets, key)]
    return min(within, key=lambda trial: trial["validation"], default=None)


@dataclass(frozen=True)
class Difference:
    """Errors of a rival over those of the baseline, less 1, paired by seed: below 0 the rival is better.

    Attributes:
      mean: over seeds.
      spread: standard deviation over seeds; None for a single one.
      doubt: half of the interval that holds the mean of all lightings with 95 % probability, by drawing the held-out ones with
        repetition; infinite for a single one.
    """

    mean: float
    spread: float | None
    doubt: float

    @property
    def verdict(self) -> str:
        """ "better", "worse" or "within the spread"; of one seed nothing is claimed."""
        if self.spread is None:
            return "one seed"
        if abs(self.mean) <= max(self.spread, self.doubt, _SMALL):
            return "within the spread"
        return "better" if self.mean < 0 else "worse"


@dataclass(frozen=True)
class Place:
    """A method in a league.

    Attributes:
      method: its name.
      errors: relative RMSE on held-out lightings of each seed; empty where no trial kept the budget for every seed.
      trials, tests: the chosen ones.
      difference: from the baseline; None of the baseline itself and of who is out.
      groups: the same on each kind of held-out lighting.
      why: it is out.
    """

    method: str
    errors: tuple[float, ...] = ()
    trials: tuple[Record, ...] = ()
    tests: tuple[Record, ...] = ()
    difference: Difference | None = None
    groups: Mapping[str, Difference] | None = None
    why: str = ""

    @property
    def mean(self) -> float:
        """Over seeds; infinite for who is out."""
        return float(np.mean(self.errors)) if self.errors else np.inf

    @property
    def spread(self) -> float | None:
        """Standard deviation over seeds."""
        return float(np.std(self.errors, ddof=1)) if len(self.errors) > 1 else None


def standings(records: Sequence[Record], budgets: Budgets, seeds: int) -> dict[str, list[Place]]:
    """Of each league all methods, the best first and who is out last.

    Args:
      records: of `Contest.run`.
      budgets: of the leagues.
      seeds: how many a method must have settings for.
    """
    header = next(record for record in records if record["what"] == "data")
    tests = {record["digest"]: record for record in records if record["what"] == "test"}
    trials: dict[str, list[list[Record]]] = {}
    for record in records:
        if record["what"] == "trial":
            trials.setdefault(record["method"], [[] for _ in range(seeds)])[record["seed"]].append(record)
    groups = groups_of(header["lightings"])
    found = {}
    for league in LEAGUES:
        picked = {name: [chosen(own, league, budgets) for own in by_seed] for name, by_seed in trials.items()}
        base = [tests[record["digest"]] for record in picked[BASELINE] if record is not None]
        places = [_place(name, picked[name], trials[name], tests, base, groups) for name in trials]
        found[league] = sorted(places, key=lambda place: place.mean)
    return found


def _place(
    name: str,
    picked: Sequence[Record | None],
    trials: Sequence[Sequence[Record]],
    tests: Mapping[str, Record],
    base: Sequence[Record],
    groups: Mapping[str, Sequence[int]],
) -> Place:
    within = [record for record in picked if record is not None]
    if len(within) < len(picked):
        whole = [record for own in trials for record in own]
        failed = [record["failed"] for record in whole if record["failed"]]
        reason = failed[0] if len(failed) == len(whole) else "no trial keeps the budget"
        return Place(name, why=reason if not within else f"{reason} for {len(picked) - len(within)} of {len(picked)} seeds")
    own = [tests[record["digest"]] for record in within]
    errors = tuple(float(record["relative_rmse"]) for record in own)
    if name == BASELINE or len(base) < len(own):
        return Place(name, errors, tuple(within), tuple(own))
    apart = {group: difference(own, base, rows) for group, rows in groups.items()}
    return Place(name, errors, tuple(within), tuple(own), difference(own, base), apart)


def groups_of(lightings: Sequence[Mapping[str, Any]]) -> dict[str, list[int]]:
    """Held-out lightings by kind of their lights; where there is one kind, by how near the lamps are to a surface.

    Returns:
      Rows of the lightings by group; none where there is nothing to tell them apart.
    """
    kinds: dict[str, list[int]] = {}
    for row, lighting in enumerate(lightings):
        kinds.setdefault(lighting["kind"], []).append(row)
    if len(kinds) > 1:
        return kinds
    near = np.array([np.nan if lighting["distance"] is None else lighting["distance"] for lighting in lightings])
    if len(near) < 2 or not np.isfinite(near).all():
        return {}
    half = float(np.median(near))
    parts = {f"lamps within {half:.2g} m of a surface": near < half, "lamps farther off": near >= half}
    return {name: [int(row) for row in np.flatnonzero(rows)] for name, rows in parts.items() if rows.any()}


def pooled(records: Sequence[Record], rows: Sequence[int] | np.ndarray | None = None) -> Float64[np.ndarray, " seeds"]:
    """Relative RMSE of each record over some of its lightings; NaN where they are black."""
    error, mean = (np.array([record[key] for record in records], np.float64) for key in ("error", "mean"))
    if rows is not None:
        error, mean = error[:, rows], mean[:, rows]
    light = mean.mean(1)
    return np.divide(np.sqrt(error.mean(1)), light, out=np.full(len(light), np.nan), where=light > 0)


def difference(own: Sequence[Record], base: Sequence[Record], rows: Sequence[int] | None = None) -> Difference:
    """See `Difference`; of some of the held-out lightings, or of all."""
    rows = range(len(own[0]["error"])) if rows is None else rows
    over = pooled(own, list(rows)) / np.maximum(pooled(base, list(rows)), 1e-30) - 1
    rng = np.random.default_rng(len(rows))
    drawn = np.asarray(rows)[rng.integers(len(rows), size=(_DRAWS, len(rows)))]
    other = _drawn(own, drawn) / np.maximum(_drawn(base, drawn), 1e-30) - 1
    few = len(rows)  # draws vary too little by (n - 1) / n, and of few lightings that is not known well: Student's t
    doubt = float(np.nanstd(other.mean(0)) * (few / (few - 1)) ** 0.5 * stats.t.ppf(0.975, few - 1)) if few > 1 else np.inf
    return Difference(float(over.mean()), float(over.std(ddof=1)) if len(over) > 1 else None, doubt)


def _drawn(records: Sequence[Record], rows: np.ndarray) -> Float64[np.ndarray, "seeds draws"]:
    error, mean = (np.array([record[key] for record in records], np.float64)[:, rows] for key in ("error", "mean"))
    light = mean.mean(2)
    return np.divide(np.sqrt(error.mean(2)), light, out=np.full(light.shape, np.nan), where=light > 0)
