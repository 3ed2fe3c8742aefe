"""Forecasts against bakes.

Question: does `ddprt bake --dry-run` tell the seconds, rays, files, bytes and memory of the bake that follows, within 25 %?
Command:  python experiments/forecast.py [--quick] [--rounds N] [--side N] [--lightings N] [--processor] [NAME ...]
Answer:   docs/baking.md

Each job is forecast and baked in fresh processes, one after the other, N times (3 unless given; 1 with --quick), with nothing
compiled or unwrapped anew; --side N sets the atlas of all, --lightings N those that are trained on, a quarter as many held
out. What is told are medians over rounds of expected / actual. A stage
below 0.3 s in fact is put in brackets: it is told, and does not matter. Seconds of a bake are those of run.json and of what its
record takes. With --processor all is done on one thread and seconds are the processor's, which other jobs of a busy machine
disturb little; what waits for the disk is then not counted.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from ddprt.config import load_config
from ddprt.dataset.store import CONSTANT
from ddprt.pipeline import Run
from ddprt.scene.library import SCENES

_OWN = {
    **{name: {"lightings.distribution": "around"} for name in ("statue", "convex")},
    "glossy-room": {"transport.target_noise": 0.05},  # else paths take hours
}
_SMALL = 0.3  # seconds
_PROCESSOR = "processor"  # beside the settings of a job
JOBS: dict[str, dict[str, Any]] = {
    **{name: {"scene.name": name, **_OWN.get(name, {})} for name in SCENES},
    **{f"cornell {side}": {"atlas.resolution": side} for side in (64, 128, 512)},
    "cornell 16 lightings": {"lightings.train": 16, "lightings.validation": 2, "lightings.test": 4},
    "all kinds": {"lightings.kinds": '["point", "spot", "directional", "rect", "sphere"]', "lightings.lights": "[1, 3]"},
    "probes": {"atlas.resolution": 96, "lightings.train": 64, "probes.grid": "[6, 6, 6]", "transport.target_noise": 0.02},
    "neon with probes": {"scene.name": "neon", "atlas.resolution": 96, "probes.grid": "[5, 5, 5]"},
    "paths": {"transport.integrator": "paths", "atlas.resolution": 64, "transport.target_noise": 0.05},
    "reference": {
        "transport.integrator": "reference",
        "atlas.resolution": 48,
        "transport.samples": 64,
        "transport.test_samples": 128,
        "lightings.train": 16,
    },
}
QUICK = ("cornell 64", "cornell 16 lightings", "plates", "convex")


def one(kind: str, changes: dict[str, str], folder: str) -> dict[str, Any]:
    """What a fresh process does: a forecast, or a bake and its record."""
    if changes.pop(_PROCESSOR, None):
        time.perf_counter = time.process_time  # type: ignore[assignment]
    config = load_config("configs/cornell.toml", changes)
    run, begun = Run(config, Path(folder) / "run", quiet=True), time.perf_counter()
    if kind == "forecast":
        found = run.forecast()
        if [*Path(folder).iterdir()]:
            raise SystemExit(f"{folder}: the forecast left something behind")
        stages = {stage.name: [stage.seconds, stage.rays, stage.files, stage.bytes] for stage in found.stages}
        return {"stages": stages, "peak": found.peak_gib, "spent": found.spent}
    data = run.bake()
    run.record(data)
    seconds = time.perf_counter() - begun
    baked = {stage["name"]: [stage["seconds"], stage.get("rays", 0), 0, 0] for stage in run.progress.stages}
    baked["files"] = [seconds - sum(stage[0] for stage in baked.values()), 0, 0, 0]
    files = [path for path in data.folder.rglob("*") if path.is_file()]
    for path in files:
        name = path.parent.name
        test = name == "indirect" and int(path.stem) in data.split("test")
        own = {"direct": "direct", "measured": "direct", "noise": "indirect test"}.get(name, "files")
        own = ("indirect test" if test else "indirect train") if name == "indirect" else own
        if name == "probes" and path.stem != "places":
            held = path.stem.split(".")[0]
            own = "emission" if held == "constant" else f"probes {'test' if int(held) in data.split('test') else 'train'}"
        if name.startswith("gloss-") and path.stem != "places":
            held = path.stem.split(".")[0]
            split = "test" if held != "constant" and int(held) in data.split("test") else "train"
            own = "emission" if held == "constant" else f"gloss {split}, order {name.removeprefix('gloss-')}"
        own = "emission" if path.name == CONSTANT else own
        baked[own][2] += 1
        baked[own][3] += path.stat().st_size
    peak = json.loads((run.folder / "run.json").read_text())["peak_memory_gib"]
    return {"stages": baked, "peak": peak, "spent": seconds}


def fresh(kind: str, changes: dict[str, Any]) -> dict[str, Any]:
    """The same in a process of its own, in a folder that goes."""
    with tempfile.TemporaryDirectory(prefix="forecast-") as folder:
        words = [sys.executable, __file__, "--one", kind, json.dumps({k: str(v) for k, v in changes.items()}), folder]
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=os.environ)
    if done.returncode:
        raise SystemExit(f"{changes}: {kind} failed: {done.stderr.strip()[-500:]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def totals(found: dict[str, Any]) -> list[float]:
    return [sum(column) for column in zip(*found["stages"].values(), strict=True)]


def ratio(one: float, other: float) -> float:
    return one / other if other else (1.0 if not one else float("inf"))


def compare(name: str, rounds: int, changes: dict[str, Any]) -> list[float]:
    """Prints a job's row; expected over actual of the seconds of each round."""
    fresh("bake", {**changes, "lightings.train": 2, "lightings.validation": 1, "lightings.test": 2})  # compiles and unwraps
    pairs = [(fresh("forecast", changes), fresh("bake", changes)) for _ in range(rounds)]
    cells = []
    for stage in pairs[0][1]["stages"]:
        share = median(ratio(told["stages"][stage][0], done["stages"][stage][0]) for told, done in pairs)
        actual = median(done["stages"][stage][0] for _, done in pairs)
        cells.append(f"{share:.2f}" if actual >= _SMALL else f"({share:.2f})")
    both = [(totals(told), totals(done)) for told, done in pairs]
    shares = [ratio(told[0], done[0]) for told, done in both]
    rays, files, size = (ratio(both[0][0][k], both[0][1][k]) for k in (1, 2, 3))
    first, then = (one["stages"] for one in pairs[0])
    traced = [ratio(first[stage][1], then[stage][1]) for stage in then]
    peak = median(ratio(told["peak"], done["peak"]) for told, done in pairs)
    spent, actual = median(told["spent"] for told, _ in pairs), median(done[0] for _, done in both)
    print(
        f"{name:<21}{actual:8.2f}{median(shares):7.2f} {min(shares):.2f}-{max(shares):.2f} "
        + " ".join(f"{cell:>7}" for cell in cells)
        + f"{rays:8.3f}  {min(traced):.3f}-{max(traced):.3f}{files:7.3f}{size:7.3f}{peak:7.2f}{spent:8.2f}",
        flush=True,
    )
    return shares


def main(words: Sequence[str]) -> None:
    if words[:1] == ["--one"]:
        print(json.dumps(one(words[1], json.loads(words[2]), words[3])))
        return
    quick = "--quick" in words
    rounds = int(words[words.index("--rounds") + 1]) if "--rounds" in words else (1 if quick else 3)
    side = {"atlas.resolution": int(words[words.index("--side") + 1])} if "--side" in words else {}
    count = int(words[words.index("--lightings") + 1]) if "--lightings" in words else 0
    counts = {"train": count, "validation": max(1, count // 8), "test": max(1, count // 4)} if count else {}
    side |= {f"lightings.{split}": number for split, number in counts.items()}
    alone = {"transport.threads": 1, _PROCESSOR: 1} if "--processor" in words else {}
    names = [word for word in words if word in JOBS] or [*(QUICK if quick else JOBS)]
    print("expected / actual: total (range), lightings, atlas, points, direct, train, test, other stages, files; then of all,")
    print("rays also of the stages that are farthest off:")
    print(
        f"{'job':<21}{'seconds':>8}{'total':>7}"
        + " " * 66
        + f"{'rays':>8}{'least-most':>13}{'files':>7}{'bytes':>7}{'peak':>7}{'spent':>8}"
    )
    shares = {name: median(compare(name, rounds, JOBS[name] | side | alone)) for name in names}
    worst = max(shares, key=lambda name: abs(shares[name] - 1))
    within = sum(0.75 <= share <= 1.25 for share in shares.values())
    print(json.dumps({"within_25_percent": within, "of": len(shares), "worst": worst, "worst_ratio": round(shares[worst], 3)}))


if __name__ == "__main__":
    main(sys.argv[1:])
