"""Does any learned method beat the linear baseline, under which budget, and on what it was not trained on?

Question: who wins the leagues of bytes, operations and seconds on each scene, and who generalises; does a linear autoencoder
          find the SVD's subspace, is an interrupted training resumed to the same bits, and how near is training to what
          the machine can do?
Command:  python experiments/learned.py [SCENE ...] [--out runs/learned]      all four scenes unless named; goes on where it was
                                                                              stopped; the last line is JSON
          python experiments/learned.py size [SCENE ...] [--out runs/learned] errors from 8 to 1024 training lightings
          python experiments/learned.py --quick                               tiny data and defaults alone, less than a minute
Answer:   docs/leagues.md

Torch is compared with where it can be imported (put it on PYTHONPATH); it is no part of ddprt, and the JSON says
where it lacks.
"""

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from learned_pace import pace
from scipy.linalg import subspace_angles

import ddprt
from ddprt.bench.leagues.generalisation import Generalisation
from ddprt.bench.leagues.leagues import leagues
from ddprt.bench.leagues.search import BASELINE
from ddprt.bench.leagues.split_pages import Found, told, write_splits
from ddprt.bench.leagues.splits import SPLITS
from ddprt.bench.leagues.standings import Place
from ddprt.bench.leagues.words import against
from ddprt.config import Config, checked
from ddprt.dataset.store import Dataset
from ddprt.files import cache_folder
from ddprt.fitting.basis import entry_weights
from ddprt.machine import instruction_set
from ddprt.pipeline import Run
from ddprt.training.journal import keeping

UPPER = {"region_low": [0.1, 0.5, 0.1], "region_high": [0.9, 0.8, 0.9], "clearance": 0.1}
AROUND = {"distribution": "around", "kinds": ["point", "directional"]}
SCENES: dict[str, dict[str, Any]] = {
    "cornell": UPPER,
    "corridor": {},
    "statue": AROUND,
    "statue-marble": AROUND,
}
MANY = {"train": 1024, "validation": 64}  # lightings of the curve over data size
OPEN = 10**15  # a budget that everybody keeps
FEW = 8  # bases of what is measured once, and of --quick, so that what was compiled for one serves the other


def config(scene: str, quick: bool, **counts: int) -> Config:
    """The job of a scene; `counts` of lightings may differ."""
    lightings = {"train": 18, "validation": 4, "test": 8} if quick else {"train": 64, "validation": 16, "test": 32}
    document: dict[str, Any] = {
        "scene": {"name": scene},
        "atlas": {"resolution": 32 if quick else 48},
        "lightings": {**lightings, **SCENES.get(scene, {}), **counts},
        "points": {"count": 32 if quick else 64, "supersample": 4 if quick else 8},
        "transport": {"samples": 32, "test_samples": 256} if quick else {"target_noise": 0.01},
        "fit": {"bases": FEW if quick else 16},
        "bench": {"repeats": 1 if quick else 5},
        "leagues": {"trials": 1, "bytes": OPEN, "flops": OPEN, "seconds": 1e9} if quick else {"seconds": 20.0},
    }
    if quick:
        few = {"steps": 40, "check_every": 20}
        names = ("mlp", "residual", "neural-lightmap", "point-set", "light-network")
        own: dict[str, Any] = {name: few for name in names if name in ddprt.methods.METHODS}
        document["methods"] = {"settings": {**own, "autoencoder": {"steps": 150}, "nonnegative": {"sweeps": 50}}}
    return checked(document)


def numbers(place: Place) -> dict[str, Any]:
    """A method's entry in the JSON."""
    if not place.errors:
        return {"why": place.why}
    return {
        "relative_rmse": {"mean": round(place.mean, 5), "std": None if place.spread is None else round(place.spread, 5)},
        "bytes": max(trial["bytes"] for trial in place.trials),
        "frame_us": round(1e6 * float(np.median([test["frame"]["median"] for test in place.tests])), 1),
        "train_seconds": round(float(np.median([trial["seconds"] for trial in place.trials])), 4),
        "against_baseline": None if place.difference is None else against(place.difference),
        "verdict": None if place.difference is None else place.difference.verdict,
    }


def subspace_angle(data: Dataset, bases: int) -> float:
    """Largest angle between the spaces of the autoencoder's basis and the SVD's, degrees."""
    root = np.sqrt(np.asarray(entry_weights(np.asarray(data.area, np.float32), "area", "mono"), np.float64))
    spaces = []
    for method in ("autoencoder", BASELINE):
        relighter: Any = ddprt.fit(data, method, bases=bases).relighter
        spaces.append((np.asarray(relighter.basis, np.float64) * root).T)
    return float(np.degrees(subspace_angles(*spaces).max()))


class Stopper:
    """A stage that interrupts a training at its second look, as Ctrl-C would."""

    done = 0

    def __init__(self) -> None:
        self.looks = 0

    def pace(self, total: int) -> None:
        """See `Stage`."""

    def tell(self, words: str) -> None:
        """See `Stage`."""

    def advance(self, steps: int, *, found: bool = False) -> None:
        """See `Stage`."""
        self.looks += not found
        if self.looks == 2:
            raise KeyboardInterrupt


def resumes(data: Dataset, folder: Path) -> bool:
    """Whether a training that was interrupted after its first look comes to the same bits as one that was not."""
    fit = lambda: ddprt.fit(data, "mlp", bases=FEW, settings={"steps": 60, "check_every": 20})  # noqa: E731
    try:
        with keeping(folder, Stopper(), every=0):  # type: ignore[arg-type]
            fit()
    except KeyboardInterrupt:
        pass
    else:
        raise AssertionError("the training was not interrupted")
    with keeping(folder, every=0):
        resumed = fit()
    lines = (folder / "mlp.jsonl").read_text().splitlines()
    went_on = len(lines) == 3  # looks; a training from the start would have as many, but then the first has no checkpoint
    leaves = (jax.tree.leaves(model.relighter) for model in (resumed, fit()))
    return went_on and all(np.array_equal(one, other) for one, other in zip(*leaves, strict=True))


def keep_compiled() -> None:
    """Lets JAX keep what it compiles for the next run, where the commands of ddprt keep theirs."""
    jax.config.update("jax_compilation_cache_dir", str(cache_folder() / f"jax-{instruction_set()}"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def scene(name: str, folder: Path, quick: bool) -> tuple[dict[str, list[Place]], Dataset, list[str]]:
    """Leagues of a scene and, unless it is to be quick, its splits."""
    job = Run(config(name, quick), folder, quiet=quick)
    data, found = job.bake(), list[Found]()
    if not quick:
        found = generalised(job, data, [split for split in SPLITS if split != "size"])
    table, files = leagues(job.config, data, job.scene, folder / "bench", job.progress, splits=found)
    if not quick:
        print(files[1].read_text(), flush=True)
    return table, data, [f"{split.name}: {line}" for split in found for line in split.words]


def generalised(job: Run, data: Dataset, names: Sequence[str]) -> list[Found]:
    """What came out of some splits; also in splits.md."""
    bench = job.folder / "bench"
    found = told(Generalisation(job.config, data, job.scene, bench, job.progress).run(names), names)
    write_splits(bench, found, job.config.scene.name)
    return found


def size(names: Sequence[str], out: Path) -> None:
    """The curve over data size of each scene, with many lightings of its own."""
    for name in names:
        job = Run(config(name, quick=False, **MANY), out / f"{name}-size")
        generalised(job, job.bake(), ["size"])
        print((job.folder / "bench" / "splits.md").read_text(), flush=True)


def compared(names: Sequence[str], out: Path, quick: bool) -> dict[str, Any]:
    """Leagues and splits of each scene, and what of training is measured once, for the JSON."""
    begun, found, first = time.perf_counter(), dict[str, dict[str, Any]](), None
    for name in names:
        table, data, splits = scene(name, out / name, quick)
        by_name = {place.method: numbers(place) for place in table["seconds"]}
        wins = {league: [place.method for place in places if place.difference and place.difference.verdict == "better"]
                for league, places in table.items()}  # fmt: skip
        found[name] = {"methods": by_name, "wins": wins, "splits": splits}
        print(f"{name}: after {time.perf_counter() - begun:.1f} s", flush=True)
        first = first or data
    assert first is not None
    told = found[names[0]]["methods"]
    with tempfile.TemporaryDirectory(prefix="learned-") as scratch:
        return {
            "methods": {name: own for name, own in told.items() if name != BASELINE},
            "baseline": told[BASELINE],
            "wins": {name: own["wins"] for name, own in found.items()} if not quick else {},
            "splits": {name: own["splits"] for name, own in found.items()} if not quick else {},
            "subspace_angle_deg": round(subspace_angle(first, FEW), 4),
            "resume_bit_identical": resumes(first, Path(scratch)),
            **pace(300 if quick else 1000, 3 if quick else 7),
            "seconds": round(time.perf_counter() - begun, 1),
        }


def main(words: Sequence[str]) -> None:
    keep_compiled()
    named = [word for at, word in enumerate(words) if not word.startswith("--") and words[at - 1 : at] != ["--out"]]
    out = Path(words[words.index("--out") + 1]) if "--out" in words else Path("runs/learned")
    if named[:1] == ["size"]:
        size(named[1:] or list(SCENES), out)
    elif "--quick" in words:
        with tempfile.TemporaryDirectory(prefix="learned-") as scratch:
            print(json.dumps(compared(named or ["cornell"], Path(scratch), quick=True)))
    else:
        print(json.dumps(compared(named or list(SCENES), out, quick=False)))


if __name__ == "__main__":
    main(sys.argv[1:])
