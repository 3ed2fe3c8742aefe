"""How near are relighting and fit to what the machine can do, does the budget of error close, does `tune` keep its word?

Question: which share of the memory's bandwidth does a frame reach, how does the fit compare with its peers, what do the cross
          terms of the error budget come to, and how often does `tune` meet a random budget on lightings that it never saw?
Command:  python experiments/frontier.py [--quick]              all of it; the last line is JSON
          python experiments/frontier.py tune [SCENE ...]       random budgets alone, ten per scene
Answer:   docs/frontier.md

The peers are those of `ddprt bench --peers`, cold: models take turns, so that no cache holds a basis. Random budgets are drawn
about random settings of a grid that is measured as a whole, tighter and looser than these reach. An answer counts as a hit when
the setting keeps within the limits, its error taken on held-out lightings of another seed; or when `tune` refuses and no
setting of the grid keeps within them.
"""

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt.bench.measure.trial import Workshop
from ddprt.bench.measure.yardstick import make_yardstick
from ddprt.bench.peers.peers import Sizes, measure, table
from ddprt.bench.tune.planner import Place, Trial
from ddprt.bench.tune.search import BASES, Search
from ddprt.config import Config, checked
from ddprt.pipeline import Run
from ddprt.progress import Progress
from ddprt.runtime.precision import stored
from ddprt.runtime.train import fit_config

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
}
LIMITED = ("relative_rmse", "frame_us", "megabytes", "bake_seconds")


def config(scene: str, resolution: int, train: int, **more: Any) -> Config:
    document: dict[str, Any] = {
        "scene": {"name": scene},
        "atlas": {"resolution": resolution},
        "lightings": {"train": train, "validation": 4, "test": 32, **SCENES[scene]},
        "points": {"count": 64, "supersample": 4},
        "transport": {"target_noise": 0.02},
        "bench": {"repeats": 1, "path_frames": 0, "pictures": 0, "noise": 0.01},
        "methods": {"compare": ["svd-ridge"]},
    }
    return checked({**document, **more})


def budget_closure(folder: Path, quick: bool) -> float:
    """Sum of the parts' squares over the squared total, of a small Cornell box."""
    more = {"budget": {"lightings": 32 if quick else 128, "abundance": 2 if quick else 4, "noise": 0.01, "turn": False}}
    job = Run(config("cornell", 32 if quick else 64, 32 if quick else 64, **more), folder, quiet=True)
    data = job.bake()
    models, _ = job.fit(data)
    document = job.budget(data, models)
    return float(document["closure"])


def random_budgets(scene: str, folder: Path, count: int, quick: bool) -> dict[str, Any]:
    """Asks `tune` for budgets, and checks every answer."""
    base = config(scene, 40 if quick else 64, 32 if quick else 64)
    factors: dict[str, tuple[float, ...]] = {
        "atlas.resolution": (1,) if quick else (0.5, 1),
        "lightings.train": (0.5, 1) if quick else (0.25, 0.5, 1, 2),
        "transport.target_noise": (1, 4) if quick else (0.5, 1, 2, 4),
        "points.count": (0.5, 1) if quick else (0.5, 1, 2),
    }
    workshop = Workshop(base, folder, QUIET)
    fresh = make_yardstick(workshop.scene, base.model_copy(update={"seed": 1}), folder / "fresh", QUIET)
    first = Search(base.model_copy(update={"tune": base.tune.model_copy(update={"max_megabytes": 1.0})}), workshop, factors)
    known: dict[Place, Trial] = {}
    for place in product(*first.planner.values):
        known[place] = first.measure(place)
    rng = np.random.default_rng(0)
    hits, trials, spent = 0, 0, 0.0
    for _ in range(count):
        like = known[list(known)[rng.integers(len(known))]]
        at, room = int(rng.integers(len(like.bases))), rng.uniform(0.85, 1.6, len(LIMITED))
        reached = like.errors[at], like.frame_us[at], like.megabytes["half"][at], like.bake_seconds
        limits = dict(zip(LIMITED, (np.array(reached) * room).tolist(), strict=True))
        asked = base.tune.model_copy(update={f"max_{name}": limit for name, limit in limits.items()})
        search = Search(base.model_copy(update={"tune": asked}), workshop, factors, known.__getitem__)
        outcome = search.run()
        trials += outcome.trials
        spent += sum(trial.bake_seconds for trial in search.planner.trials)
        if outcome.met:
            data, _ = workshop.bake(outcome.setting)
            model = stored(fit_config(data, outcome.setting.config, "svd-ridge"), outcome.plan.precision)
            error = fresh.tally(model).scores()["relative_rmse"]
            right = error is not None and error <= limits["relative_rmse"]
        else:
            right = not any(meets(trial, limits) for trial in known.values())
        hits += right
        answer = "met" if outcome.met else f"refused, {outcome.binding} binds"
        told = ", ".join(f"{name} {limit:.3g}" for name, limit in limits.items())
        print(f"  {scene}: {told}: {answer} after {outcome.trials} bakes, {'right' if right else 'WRONG'}", flush=True)
    grid = sum(trial.bake_seconds for trial in known.values())
    return {"hits": hits, "of": count, "trials": trials / count, "cost_of_grid": spent / count / grid, "grid": len(known)}


def meets(trial: Trial, limits: dict[str, float]) -> bool:
    """Whether any number of bases and precision at a place keeps within all limits."""
    if trial.bake_seconds > limits["bake_seconds"]:
        return False
    curves = np.log(np.array([trial.errors, trial.frame_us, *trial.megabytes.values()]))
    wanted = [bases for bases in BASES if bases <= trial.bases[-1]]
    error, frame, *sizes = (np.exp(np.interp(np.log(wanted), np.log(trial.bases), curve)) for curve in curves)
    fine = (error <= limits["relative_rmse"]) & (frame <= limits["frame_us"])
    return bool(any((fine & (size <= limits["megabytes"])).any() for size in sizes))


def main(words: Sequence[str]) -> None:
    quick, begun = "--quick" in words, time.perf_counter()
    names = [word for word in words if not word.startswith("--")]
    with tempfile.TemporaryDirectory(prefix="frontier-") as scratch:
        folder = Path(scratch)
        if names[:1] == ["tune"]:
            chosen = names[1:] or list(SCENES)
            for scene in chosen:
                print(f"{scene}: {random_budgets(scene, folder / scene, 10, quick)}", flush=True)
            return
        sizes = Sizes(texels=50_000, repeats=2, limit=1, product=1024, disk=64 << 20) if quick else Sizes()
        record = measure(config("cornell", 48, 32), QUIET, sizes)
        print(table(record))
        summary = record["summary"]
        found: dict[str, Any] = {key: summary[key] for key in ("relight_bandwidth_fraction", "fit_speedup_best_peer")}
        print(f"after {time.perf_counter() - begun:.0f} s", flush=True)
        found["budget_closure"] = round(budget_closure(folder / "budget", quick), 4)
        print(f"budget closes to {found['budget_closure']}, after {time.perf_counter() - begun:.0f} s", flush=True)
        tuned = random_budgets("cornell", folder / "tune", 10, quick)
        print(f"tune: {tuned}, after {time.perf_counter() - begun:.0f} s")
        found |= {"tune_hits": tuned["hits"] / tuned["of"], "tune_trials": tuned["trials"]}
        print(json.dumps(found | {"ddprt": ddprt.__version__, "seconds": round(time.perf_counter() - begun, 1)}))


if __name__ == "__main__":
    main(sys.argv[1:])
