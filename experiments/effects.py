"""Effects of light transport.

Question: is each effect right, and does an effect that nobody calls for cost anything?
Command:  python experiments/effects.py [--quick]     the last line is JSON
Answer:   docs/effects.md

`effects` holds by name of the effect the largest relative error against a closed form, with the standard error of what is
sampled (`effect_figures.py`), and without --quick mean and standard deviation of z-scores against Mitsuba, if it is installed
(`effect_mitsuba.py`). An effect without a figure ends the experiment before it begins. `zero_cost_ratio` is the time of a
diffuse bake with all files of effects imported over its time in a process where they raise on import: both processes take
turns, and it is the median of the ratios of turns. `unused_effect_rays` is how many rays more the former traces.
"""

import importlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.abc import MetaPathFinder
from statistics import median
from typing import Any

import numpy as np

import ddprt
from ddprt.config import Config, checked
from ddprt.dataset.generate import bake
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import EFFECTS

TURNS, QUICK_TURNS = 21, 9
DIFFUSE: dict[str, Any] = {
    "atlas": {"resolution": 48},
    "lightings": {"train": 16, "validation": 2, "test": 2, "clearance": 0.1},
    "points": {"count": 32, "supersample": 2},
    "transport": {"samples": 128, "test_samples": 128, "threads": 2},
}


# --- what nobody calls for -----------------------------------------------------------------------------------------------


class Absent(MetaPathFinder):
    """Refuses to import some modules."""

    def __init__(self, modules: list[str]) -> None:
        self.modules = modules

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name in self.modules:
            raise ImportError(f"{name}: imported, though nothing calls for it")


def serve(way: str) -> None:
    """Bakes the diffuse scene whenever a line comes in, and answers with seconds and rays."""
    modules = sorted({f"ddprt.transport.{entry.module}" for entry in EFFECTS.values() if entry.module})
    if early := set(modules) & set(sys.modules):
        raise SystemExit(f"effects {way}: {', '.join(sorted(early))} imported before any bake")
    if way == "absent":
        sys.meta_path.insert(0, Absent(modules))
    else:
        for module in modules:
            importlib.import_module(module)
    scene, config = ddprt.load_scene("cornell"), checked(DIFFUSE)
    for _ in sys.stdin:
        print(json.dumps(one_bake(scene, config)), flush=True)


def one_bake(scene: Scene, config: Config) -> tuple[float, int]:
    progress = Progress(quiet=True)
    with tempfile.TemporaryDirectory(prefix="effects-") as folder:
        begun = time.perf_counter()
        bake(scene, config=config, out=folder, progress=progress)
        seconds = time.perf_counter() - begun
    return seconds, sum(int(stage.get("rays", 0)) for stage in progress.stages)


def zero_cost(turns: int) -> dict[str, Any]:
    """Both processes in turn; the first bake of each, which compiles, is not counted."""
    found: dict[str, list[tuple[float, int]]] = {"present": [], "absent": []}
    processes = {
        way: subprocess.Popen(
            [sys.executable, __file__, "--serve", way], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for way in found
    }
    try:
        for turn in range(1 + turns):
            for way in sorted(found, reverse=turn % 2 == 1):
                process = processes[way]
                assert process.stdin is not None
                assert process.stdout is not None
                process.stdin.write("bake\n")
                process.stdin.flush()
                answer = process.stdout.readline()
                if not answer:
                    raise SystemExit(f"effects {way}: the bake failed")
                if turn:
                    found[way].append(tuple(json.loads(answer)))
    finally:
        for process in processes.values():
            process.communicate()
    ratios = [one[0] / other[0] for one, other in zip(found["present"], found["absent"], strict=True)]
    low, high = np.quantile(ratios, [0.25, 0.75])
    print(
        f"a diffuse bake: {median(one[0] for one in found['present']):.3f} s with all files of effects, "
        f"{median(one[0] for one in found['absent']):.3f} s without; ratios {low:.3f} to {high:.3f} (quartiles of {turns})"
    )
    rays = found["present"][0][1] - found["absent"][0][1]
    return {"zero_cost_ratio": round(median(ratios), 4), "unused_effect_rays": rays}


def main() -> None:
    """Figures one by one, then the cost of nothing, then all as JSON."""
    if "--serve" in sys.argv:
        serve(sys.argv[-1])
        return
    from effect_figures import FIGURES  # not above: the bakes without effects import nothing of them

    quick = "--quick" in sys.argv
    if missing := [name for name in EFFECTS if name not in FIGURES]:
        raise SystemExit(f"effects: no figure for {', '.join(missing)}; add one to experiments/effect_figures.py")
    opinion = None if quick else second_opinions()
    figures = {}
    for name in EFFECTS:
        begun = time.perf_counter()
        figure = FIGURES[name](quick) | ((opinion(name) if opinion else None) or {})
        figures[name] = {key: float(f"{value:.3g}") for key, value in figure.items()}
        told = ", ".join(f"{key} {value:g}" for key, value in figures[name].items())
        print(f"{name}: {told} ({time.perf_counter() - begun:.1f} s)", flush=True)
    print(json.dumps({"effects": figures, **zero_cost(QUICK_TURNS if quick else TURNS)}))


def second_opinions() -> Callable[[str], dict[str, float] | None] | None:
    """Mitsuba's, where it is installed; where not, that is said."""
    from effect_mitsuba import load_mitsuba, second_opinion

    try:
        load_mitsuba()
    except UserError as error:
        print(f"no second opinion: {error}")
        return None
    return second_opinion


if __name__ == "__main__":
    main()
