"""Random budgets of `experiments/frontier.py`: what `tune` answers, and whether that is so on lightings that it never saw.

Budgets are drawn about random settings of a grid that is measured as a whole, tighter and looser than these reach. An answer
counts as a hit when the setting keeps within the limits, its error taken on held-out lightings of another seed; or when `tune`
refuses and no setting of the grid keeps within them, its error taken on the same. These are so many (`FRESH`) that a limit is
not missed for the luck of the draw alone; what the answers come to on the first few of them, as many as the configuration holds
out, is told beside it. Where `tune` says that it cannot be shown, that is no hit, but counted apart, and apart of these how
often what it is in doubt about lies where it is said to: an error on fresh lightings, a time measured once more. A search costs
what baking and fitting its trials took, and drawing and baking held-out lightings beyond those of the configuration; the grid
what baking and fitting all of its places took. Places that cannot be baked are left out of the grid, and told once.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, fields
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.bench.measure.settings import Setting
from ddprt.bench.measure.trial import Workshop, environment, measured_here, why
from ddprt.bench.measure.yardstick import Yardstick, make_yardstick
from ddprt.bench.tune.curves import time_of_frame
from ddprt.bench.tune.fitted import Fitted
from ddprt.bench.tune.held_out import spread_of
from ddprt.bench.tune.outcome import Doubt
from ddprt.bench.tune.planner import Guess, Place, Plan, Trial, seconds
from ddprt.bench.tune.search import Search
from ddprt.config import Config, checked
from ddprt.dataset.forecast import forecast
from ddprt.errors import UserError
from ddprt.files import append_line
from ddprt.progress import Progress
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored

QUIET = Progress(quiet=True)
UPPER = {"region_low": [0.1, 0.5, 0.1], "region_high": [0.9, 0.8, 0.9], "clearance": 0.1}
AROUND = {"distribution": "around"}
SCENES: dict[str, dict[str, Any]] = {
    "cornell": UPPER,
    "cornell-hole": UPPER,
    "corridor": {},
    "statue": AROUND,
    "plates": {"clearance": 0.02},
    "faults": {},
    "convex": AROUND,
    "furnace": {},
}
FRESH = 256
LIMITED = ("relative_rmse", "frame_us", "megabytes", "bake_seconds")
QUICK_BASES = (1, 2, 4, 8, 16, 32, 64)  # those that a trial scores anyway, so that no other length is compiled
GRID: dict[str, tuple[float, ...]] = {
    "atlas.resolution": (0.5, 1.0),
    "lightings.train": (0.5, 1.0, 2.0),
    "transport.target_noise": (0.5, 1.0, 2.0, 4.0, 8.0),  # what differs in noise alone has the same shapes and compiles once
    "points.count": (0.5, 1.0),
}
QUICK_GRID: dict[str, tuple[float, ...]] = {
    "atlas.resolution": (1.0,),
    "lightings.train": (0.5, 1.0),
    "transport.target_noise": (1.0, 2.0, 4.0, 8.0),
    "points.count": (1.0,),
}


def config(scene: str, resolution: int, train: int, held_out: int = 32, **more: Any) -> Config:
    document: dict[str, Any] = {
        "scene": {"name": scene},
        "atlas": {"resolution": resolution},
        "lightings": {"train": train, "validation": 4, "test": held_out, **SCENES[scene]},
        "points": {"count": 64, "supersample": 4},
        "transport": {"target_noise": 0.02},
        "bench": {"repeats": 1, "path_frames": 0, "pictures": 0, "noise": 0.01},
        "methods": {"compare": ["svd-ridge"]},
    }
    return checked({**document, **more})


class UnfinishedError(Exception):
    """Time was up; what was measured lies on disk."""


class Contest:
    """Random budgets on one scene.

    Args:
      scene: of the library.
      folder: holds bakes, `grid.jsonl` and `answers.jsonl`; what they tell of the same settings, truth, version and machine
        is not measured again.
      quick: a grid of eight places, of two shapes, and fewer lightings.
      until: of `time.monotonic`, when to stop.
      budgets: seed of the budgets.
    """

    def __init__(self, scene: str, folder: Path, quick: bool, until: float = np.inf, budgets: int = 0) -> None:
        self.scene, self.folder, self.quick, self.until, self.budgets = scene, folder, quick, until, budgets
        self.base = config(scene, 32, 24, held_out=24) if quick else config(scene, 48, 32)
        self.factors = QUICK_GRID if quick else GRID
        self.workshop = Workshop(self.base, folder, QUIET)
        folder.mkdir(parents=True, exist_ok=True)
        clock = time.perf_counter.__name__
        self.key = [Setting({}, self.base).digest, self.workshop.truth, [entry.name for entry in fields(Trial)], clock]
        self.barred: dict[Place, str] = {}
        self._fresh_tallies: dict[Plan, Tally] = {}
        self._fits: dict[tuple[Place, int], Fitted] = {}

    @cached_property
    def expected(self) -> float:
        """Seconds that the base is forecast to bake, which is the same for all budgets."""
        return float(forecast(self.workshop.scene, self.base, QUIET).training_seconds)

    @cached_property
    def fresh(self) -> Yardstick:
        """Held-out lightings that no search has seen: a few times as many as the fewest, the first of another seed."""
        lightings = self.base.lightings.model_copy(update={"test": FRESH})
        unlike = self.base.model_copy(update={"seed": 1, "lightings": lightings})
        return make_yardstick(self.workshop.scene, unlike, self.folder / "fresh", QUIET)

    def grid(self) -> dict[Place, Trial]:
        """Every place that can be baked, measured now or before; the others and their reasons go to `barred`.

        Raises:
          UnfinishedError: time is up.
        """
        search = self.search({"max_megabytes": 1.0}, None)
        known = {}
        for entry in self._told("grid.jsonl"):
            if "barred" in entry:
                self._bar(search, entry["barred"], entry["why"])
            else:
                known[tuple(entry["trial"]["place"])] = trial_of(entry["trial"])
        places = list(product(*search.planner.values))
        for place in places:
            if place in known or place in self.barred:
                continue
            if time.monotonic() > self.until:
                raise UnfinishedError(f"{sum(each in known for each in places)} of {len(places)} places measured")
            try:
                known[place] = search.measure(place)
            except (UserError, MemoryError) as error:
                self._bar(search, place, why(error))
                self._tell("grid.jsonl", {"barred": place, "why": why(error)})
                continue
            self._tell("grid.jsonl", {"trial": asdict(known[place])})
        return {place: known[place] for place in places if place in known}

    def search(self, limits: dict[str, float], known: dict[Place, Trial] | None) -> Search:
        asked = self.base.model_copy(update={"tune": self.base.tune.model_copy(update=limits)})
        expected = self.expected if known else None

        def told(place: Place) -> Trial:
            if place in self.barred:
                raise UserError(self.barred[place])
            assert known is not None
            return found.scored_again(known[place]) if found.held_out.seconds else known[place]

        found = Search(asked, self.workshop, self.factors, told if known else None, expected, self._fits)
        if self.quick:
            found.bases = found.planner.bases = QUICK_BASES
        return found

    def answers(self, count: int) -> dict[str, Any]:
        """Asks `tune` for budgets, and checks every answer.

        Returns:
          hits, of; wrong; undecided, held: of these, those whose doubt has the right bounds; within: how wide these are, as a
          share, on average; frames: settings said to meet the budget, or that they may, whose time measured once more is beyond
          its limit; hits_on_few: on as many fresh lightings as the configuration holds out; refused; trials: bakes of a search,
          held_out: its lightings, on average; cost_of_grid: share of the grid's seconds that a search takes, on average, and
          largest; grid: places, barred: those that cannot be baked; fresh_spread: how far off an error on the fresh lightings
          is, as a share, at its largest.
        Raises:
          UnfinishedError: time is up.
        """
        known = self.grid()
        cost = sum(map(seconds, known.values()))
        before = {json.dumps(entry["limits"]): entry for entry in self._told("answers.jsonl")}
        rng, found = np.random.default_rng(self.budgets), []
        for _ in range(count):
            like = known[list(known)[rng.integers(len(known))]]
            at, room = int(rng.integers(len(like.bases))), rng.uniform(0.85, 1.6, len(LIMITED))
            reached = like.errors[at], like.frame_us[at], like.megabytes["half"][at], like.bake_seconds
            limits = dict(zip(LIMITED, (np.array(reached) * room).tolist(), strict=True))
            answer = before.get(json.dumps(limits))
            if answer is None:
                if time.monotonic() > self.until:
                    raise UnfinishedError(f"{len(found)} of {count} budgets asked")
                answer = self._answer(limits, known) | {"limits": limits}
                self._tell("answers.jsonl", answer)
            answer |= {"share": answer["seconds"] / cost}
            told = ", ".join(f"{name} {limit:.3g}" for name, limit in limits.items())
            print(f"  {self.scene}: {told}: {answer['told']}, {answer['share']:.1%} of the grid's cost", flush=True)
            found.append(answer)
        shares, open_ = [answer["share"] for answer in found], [answer for answer in found if answer["undecided"]]
        return {
            "hits": sum(answer["right"] for answer in found),
            "of": count,
            "wrong": sum(not (answer["right"] or answer["undecided"]) for answer in found),
            "undecided": len(open_),
            "held": sum(answer["held"] for answer in open_),
            "within": round(float(np.mean([answer["within"] for answer in open_])), 4) if open_ else None,
            "frames": sum(answer["frame_beyond"] for answer in found),
            "hits_on_few": sum(answer["right_on_few"] for answer in found),
            "refused": sum(not answer["met"] and not answer["undecided"] for answer in found),
            "trials": round(float(np.mean([answer["trials"] for answer in found])), 2),
            "held_out": round(float(np.mean([answer["held_out"] for answer in found]))),
            "cost_of_grid": round(float(np.mean(shares)), 4),
            "largest": round(max(shares), 4),
            "grid": len(known),
            "barred": len(self.barred),
            "grid_seconds": round(cost, 1),
            "fresh_spread": round(max(answer["fresh_spread"] for answer in found), 4),
        }

    def _answer(self, limits: dict[str, float], known: dict[Place, Trial]) -> dict[str, Any]:
        search = self.search({f"max_{name}": limit for name, limit in limits.items()}, known)
        outcome, limit = search.run(), limits["relative_rmse"]
        doubt, held, again = outcome.doubt, False, 0.0
        if outcome.met:
            again = self._frame_us(search, outcome.plan)
        if doubt:
            tally = self._tally(search, doubt.plan)
            truth, spread = self._truth(search, doubt, known), spread_of(tally)[0]
            right, held, right_on_few = False, doubt.low <= truth <= doubt.high, False
            what = (
                f"{'may meet' if outcome.met else 'not known'} (a chance of {doubt.chance:.0%}), undecided within "
                f"{doubt.within:.0%}: {doubt.quantity} of {doubt.low:.3g} to {doubt.high:.3g}, {truth:.3g} in truth"
            )
        elif outcome.met:
            tally = self._tally(search, outcome.plan)
            error, few, spread = pooled(tally), pooled(tally, self.base.lightings.test), spread_of(tally)[0]
            right, right_on_few = error <= limit, few <= limit
            what = f"met (a chance of {outcome.chance:.0%}), {error:.3g} on fresh lightings ({few:.3g} on the first few)"
        else:
            # What the grid's own lightings do not tell to be hopeless is looked at on the fresh ones, the likeliest first.
            plans = [found for each in known.values() if (found := best_within(each, limits, search.bases, limit))]
            tallies = []
            for _, plan in sorted(plans, key=lambda each: each[0]):
                tallies.append(self._tally(search, plan))
                if pooled(tallies[-1]) <= limit:
                    break
            least = min(tallies, key=pooled, default=None)
            right = least is None or pooled(least) > limit
            right_on_few = not any(pooled(tally, self.base.lightings.test) <= limit for tally in tallies)
            spread = spread_of(least)[0] if least else 0.0
            what = f"refused, {outcome.binding} binds, " + (
                f"the best of {len(tallies)} settings of the grid errs by {pooled(least):.3g} on fresh lightings"
                if least
                else "no setting of the grid comes near"
            )
        return {
            "met": outcome.met,
            "right": bool(right),
            "undecided": doubt is not None,
            "held": bool(held),
            "within": doubt.within if doubt else 0.0,
            "frame_beyond": bool(again > limits["frame_us"]),
            "right_on_few": bool(right_on_few),
            "trials": outcome.trials,
            "held_out": outcome.held_out,
            "fresh_spread": spread,
            "seconds": sum(map(seconds, search.planner.trials)) + search.held_out.seconds,
            "told": f"{what}, after {outcome.trials} bakes and {outcome.held_out} held-out lightings, "
            + (("held" if held else "NOT HELD") if doubt else "right" if right else "WRONG"),
        }

    def _truth(self, search: Search, doubt: Doubt, known: dict[Place, Trial]) -> float:
        """What a doubtful quantity is: an error on fresh lightings, a time measured once more or when the grid was."""
        if doubt.quantity == "relative_rmse":
            return pooled(self._tally(search, doubt.plan))
        if doubt.quantity == "frame_us":
            return self._frame_us(search, doubt.plan)
        if doubt.quantity == "megabytes":
            return shipped_bytes(self._model(search, doubt.plan), doubt.plan.precision) / 1e6
        return float(getattr(known[doubt.plan.place], doubt.quantity))

    def _model(self, search: Search, plan: Plan) -> Model:
        return stored(search.fitted(plan).model, plan.precision)

    def _frame_us(self, search: Search, plan: Plan) -> float:
        return time_of_frame(self._model(search, plan), search.fitted(plan).values, limit=search.limits["frame_us"])[0]

    def _tally(self, search: Search, plan: Plan) -> Tally:
        """Errors of a plan on fresh lightings."""
        if plan not in self._fresh_tallies:
            self._fresh_tallies[plan] = self.fresh.tally(self._model(search, plan))
        return self._fresh_tallies[plan]

    def _bar(self, search: Search, place: Sequence[float], reason: str) -> None:
        """Leaves out a place that cannot be baked, and those that cannot for the same reason; told once."""
        before = set(search.planner.barred)
        search.bar(tuple(place), reason)
        new = search.planner.barred - before
        self.barred |= dict.fromkeys(new, reason)
        print(f"  {self.scene}: {len(new)} places cannot be baked: {reason}", flush=True)

    def _told(self, name: str) -> list[dict[str, Any]]:
        path = self.folder / name
        entries = [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.is_file() else []
        return [entry for entry in entries if entry["key"] == self.key and measured_here(entry["environment"])]

    def _tell(self, name: str, entry: dict[str, Any]) -> None:
        append_line(self.folder / name, json.dumps({"key": self.key, "environment": environment(), **entry}))


def trial_of(plain: dict[str, Any]) -> Trial:
    """A trial as JSON gives it back."""
    tuples = {name: tuple(value) for name, value in plain.items() if isinstance(value, list)}
    return Trial(**{**plain, **tuples, "megabytes": {name: tuple(row) for name, row in plain["megabytes"].items()}})


def pooled(tally: Tally, first: int | None = None) -> float:
    """Relative RMSE over all lightings, or over the first so many."""
    mean = float(tally.mean[:first].mean())
    assert mean > 0, "held-out lightings are lit"
    return float(np.sqrt(tally.error[:first].mean())) / mean


def best_within(trial: Trial, limits: dict[str, float], offered: Sequence[int], error: float) -> tuple[float, Plan] | None:
    """The plan of a place that errs least among those that cost no more than the limits, where it may keep within an error.

    Returns:
      How unlikely that is, and the plan; None where nothing at the place costs so little, or where its chance to err by no
      more is under one in a thousand.
    """
    if trial.bake_seconds > limits["bake_seconds"]:
        return None
    curves = np.log(np.array([trial.errors, trial.frame_us, *trial.megabytes.values()]))
    wanted = [bases for bases in offered if bases <= trial.bases[-1]]
    errors, frame, *sizes = (np.exp(np.interp(np.log(wanted), np.log(trial.bases), curve)) for curve in curves)
    found = [
        (errors[i], Plan(trial.place, bases, precision))
        for precision, size in zip(trial.megabytes, sizes, strict=True)
        for i, bases in enumerate(wanted)
        if frame[i] <= limits["frame_us"] and size[i] <= limits["megabytes"]
    ]
    if not found:
        return None
    least, plan = min(found, key=lambda each: each[0])
    chance = Guess(float(np.log(least)), max(trial.error_spread, 1e-3), trial.error_skew).chance(error)
    return (-chance, plan) if chance > np.log(1e-3) else None
