"""How often is a claim of `tune` right, over many draws of held-out lightings?

Question: of limits that a setting is said to keep with a chance of nine in ten, which share does it not keep, by how held-out
          lightings are drawn, by what is reckoned with, and by whether the setting was chosen on the same lightings?
Command:  python experiments/frontier_claims.py [SCENE ...] [--draws 600] [--out runs/claims]      cornell and corridor
Answer:   docs/tuning.md

A pool of 1024 lightings is baked once for each scene, at the size of the quick frontier, and every place of its grid is scored
on all of them; the error on all is the truth. A draw takes some of them at random, and candidates for those that are drawn
where errors are likely to be large. "One setting" claims at a limit that is its own true error, which is to be believed in a
case of ten: its share of all draws. "Chosen" draws a budget about a random setting as the frontier does and takes the cheapest
setting that is sure to keep it: its share of those that were claimed.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from frontier import keep_compiled
from frontier_tune import QUICK_BASES, QUIET, Contest

from ddprt.bench.measure.yardstick import make_yardstick
from ddprt.bench.tune.curves import without_last
from ddprt.bench.tune.held_out import error_of, spread_of
from ddprt.bench.tune.planner import SURE, Guess, Plan
from ddprt.bench.tune.suspects import CANDIDATES, balanced, unknown
from ddprt.report.metrics import Tally
from ddprt.runtime.precision import stored

POOL = 1024
WAYS = {  # even lightings, drawn ones, and how much worse a lighting is reckoned with
    "24 even": (24, 0, 0.0),
    "96 even": (96, 0, 0.0),
    "192 even": (192, 0, 0.0),
    "24 even, one twice as bad": (24, 0, 2.0),
    "96 even, one twice as bad": (96, 0, 2.0),
    "24 even, 24 drawn": (24, 24, 0.0),
    "24 even, 72 drawn": (24, 72, 0.0),
}


def measured(scene: str, folder: Path) -> tuple[list[Tally], np.ndarray]:
    """Errors of all settings under all lightings, the cheapest first, and what is unknown of these to the base."""
    contest = Contest(scene, folder / scene, quick=True)
    update = {"seed": 7, "lightings": contest.base.lightings.model_copy(update={"test": POOL})}
    pool = make_yardstick(contest.workshop.scene, contest.base.model_copy(update=update), contest.folder / "pool", QUIET)
    search, found = contest.search({"max_megabytes": 1.0}, None), []
    told = np.ones(POOL)
    knobs = search.planner.values
    for place in (
        (*search.base[:1], train, noise, points) for train in knobs[1] for noise in knobs[2][::-1] for points in knobs[3]
    ):
        fitted = search.fitted(Plan(place, max(QUICK_BASES), "float"))
        model, data = fitted.model, fitted.data
        most = model.relighter.report.bases
        found += [pool.tally(stored(without_last(model, most - count), "half")) for count in QUICK_BASES if count <= most]
        if place == search.base:
            told = unknown(pool.measured(model), data.values(data.split("train"), model.points, model.quantity))
    return found, told


def drawn(rng: np.random.Generator, told: np.ndarray, even: int, more: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the pool, and their densities over the even one."""
    candidates, rows = rng.integers(0, len(told), CANDIDATES), rng.integers(0, len(told), even)
    average = told[candidates].mean()
    density = 0.2 + 0.8 * told[candidates] / average
    rows = np.concatenate([rows, candidates[rng.choice(len(candidates), more, p=density / density.sum())]])
    return rows, 0.2 + 0.8 * told[rows] / average


def guess(tally: Tally, rows: np.ndarray, density: np.ndarray, even: int, worse: float) -> Guess:
    part = Tally(*(getattr(tally, name)[rows] for name in ("error", "squares", "bias", "mean", "peak")))
    part = balanced(part, density, even)
    return Guess(float(np.log(error_of(part))), *spread_of(part, worse))


def main(words: Sequence[str]) -> None:
    keep_compiled()
    options = {word: words[at + 1] for at, word in enumerate(words) if word in ("--draws", "--out")}
    scenes = [word for word in words if not word.startswith("--") and word not in options.values()] or ["cornell", "corridor"]
    for scene in scenes:
        tallies, told = measured(scene, Path(options.get("--out", "runs/claims")))
        truths = np.array([error_of(tally) for tally in tallies])
        heavy = max(np.sort(tally.error)[-len(told) // 100 :].sum() / tally.error.sum() for tally in tallies)
        print(f"{scene}: {len(tallies)} settings; of one, a hundredth of the lightings makes {heavy:.0%} of the mean square")
        print(
            "| held-out lightings | off by | one setting, wrong | at worst | chosen, wrong | claimed |\n" + "| --- " * 6 + "|"
        )
        for way, (even, more, worse) in WAYS.items():
            rng, off, wrong, claimed, missed = np.random.default_rng(0), [], np.zeros(len(tallies)), 0, 0
            draws = int(options.get("--draws", 600))
            for _ in range(draws):
                rows, density = drawn(rng, told, even, more)
                guesses = [guess(tally, rows, density, even, worse) for tally in tallies]
                off.append([found.mean - np.log(truth) for found, truth in zip(guesses, truths, strict=True)])
                wrong += [found.chance(truth) > np.log(SURE) for found, truth in zip(guesses, truths, strict=True)]
                limit = float(np.exp(guesses[rng.integers(len(guesses))].mean)) * rng.uniform(0.85, 1.6)
                taken = next((at for at, found in enumerate(guesses) if found.chance(limit) >= np.log(SURE)), None)
                claimed += taken is not None
                missed += taken is not None and truths[taken] > limit
            share = wrong / draws
            chosen = missed / max(claimed, 1)
            cells = (
                f"{np.std(off, 0).mean():.0%} | {share.mean():.1%} | {share.max():.1%} | {chosen:.1%} | {claimed / draws:.0%}"
            )
            print(f"| {way} | {cells} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
