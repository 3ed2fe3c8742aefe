"""How near are relighting and fit to what the machine can do, does the budget of error close, does `tune` keep its word?

Question: which share of the memory's bandwidth does a frame reach, how does the fit compare with its peers, what do the cross
          terms of the error budget come to, and how often does `tune` meet a random budget on lightings that it never saw?
Command:  python experiments/frontier.py [--quick]      all of it; the last line is JSON
          python experiments/frontier.py tune [SCENE ...] [--minutes 10] [--out runs/frontier] [--budgets 0] [--processors]
                                                        random budgets alone, ten per scene, of that seed; goes on where it
                                                        was stopped; --processors counts seconds of processors in place of
                                                        the clock's, for machines that others work on, too
Answer:   docs/frontier.md

Relighting is cold: models take turns, so that no cache holds a basis. Peers of the quick part stand in `frontier_peers.py`,
random budgets and what counts as a hit in `frontier_tune.py`; `frontier_claims.py` asks how often such a claim is right over
many held-out draws.
"""

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from frontier_peers import QUIET, quick_peers
from frontier_tune import SCENES, Contest, UnfinishedError, config

import ddprt
from ddprt.bench.budget.bakes import Bakery
from ddprt.bench.budget.budget import measure_budget
from ddprt.bench.peers.peers import Sizes, measure, table
from ddprt.errors import UserError
from ddprt.files import cache_folder
from ddprt.machine import instruction_set
from ddprt.pipeline import Run
from ddprt.runtime.train import fit_config


def budget_closure(folder: Path, quick: bool) -> float:
    """Sum of the parts' squares over the squared total, of a small Cornell box."""
    more = {"budget": {"lightings": 24 if quick else 128, "abundance": 2 if quick else 4, "noise": 0.01, "turn": False}}
    base = config("cornell", 32 if quick else 64, 24 if quick else 64, **more)
    job = Run(base, folder, quiet=True)
    data = job.bake()
    bakery = Bakery(job.scene, base, data, folder / "budget", QUIET)
    return measure_budget(fit_config(data, base, "svd-ridge"), bakery).parts.closure


def keep_compiled() -> None:
    """Lets JAX keep what it compiles for the next run, where the commands of ddprt keep theirs."""
    jax.config.update("jax_compilation_cache_dir", str(cache_folder() / f"jax-{instruction_set()}"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def clock(begun: float) -> str:
    """How long it has been; the processors' time tells a busy machine from a slow program."""
    return f"after {time.perf_counter() - begun:.1f} s, {time.process_time():.1f} s of processors"


def tune(words: Sequence[str]) -> int:
    """Random budgets on scenes; how many could not be ended in time."""
    options = {word: words[at + 1] for at, word in enumerate(words) if word in ("--minutes", "--out", "--budgets")}
    values = set(options.values())
    chosen = [word for word in words if not word.startswith("--") and word not in values] or list(SCENES)
    left = 0
    if "--processors" in words:
        time.perf_counter = time.process_time
    for scene in chosen:
        until = time.monotonic() + 60 * float(options.get("--minutes", 10))
        folder, budgets = Path(options.get("--out", "runs/frontier")) / scene, int(options.get("--budgets", 0))
        try:
            print(f"{scene}: {json.dumps(Contest(scene, folder, '--quick' in words, until, budgets).answers(10))}", flush=True)
        except UserError as told:
            print(f"{scene}: no budgets can be asked: {told}", flush=True)
        except UnfinishedError as told:
            print(f"{scene}: {told}, time is up; the same command goes on from here", flush=True)
            left += 1
    return left


def main(words: Sequence[str]) -> int:
    keep_compiled()
    if words[:1] == ["tune"]:
        return tune(words[1:])
    quick, begun = "--quick" in words, time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="frontier-") as scratch:
        folder = Path(scratch)
        base = config("cornell", 48, 32)
        if quick:
            found: dict[str, Any] = quick_peers(base)
        else:
            record = measure(base, QUIET, Sizes())
            print(table(record))
            found = {key: record["summary"][key] for key in ("relight_bandwidth_fraction", "fit_speedup_best_peer")}
        print(f"peers: {clock(begun)}", flush=True)
        found["budget_closure"] = round(budget_closure(folder / "budget", quick), 4)
        print(f"budget closes to {found['budget_closure']}: {clock(begun)}", flush=True)
        tuned = Contest("cornell", folder / "tune", quick).answers(10)
        print(f"tune: {tuned}: {clock(begun)}")
        found |= {name: tuned[key] / tuned["of"] for name, key in (("tune_hits", "hits"), ("tune_undecided", "undecided"))}
        found |= {"tune_trials": tuned["trials"]}
        found |= {"tune_cost_of_grid": tuned["cost_of_grid"], "tune_grid": tuned["grid"]}
        print(json.dumps(found | {"ddprt": ddprt.__version__, "seconds": round(time.perf_counter() - begun, 1)}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
