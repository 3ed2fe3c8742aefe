"""Effects of light transport.

Question: is each effect right, and does an effect that nobody calls for cost anything?
Command:  python experiments/effects.py [--quick]     the last line is JSON
Answer:   docs/effects.md

`effects` holds the largest relative error against a closed form, or mean and standard deviation of z-scores against another
renderer, by name of the effect; those without a figure are named. `zero_cost_ratio` is the time of a diffuse bake with
all files of effects imported over its time in a process where they raise on import: both processes take turns, and it is the
median of the ratios of turns. `unused_effect_rays` is how many rays more the former traces.
"""

import importlib
import json
import math
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
from ddprt.progress import Progress
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, rectangle
from ddprt.transport.effects import EFFECTS

Figure = dict[str, float]
TURNS, QUICK_TURNS = 21, 9
DIFFUSE: dict[str, Any] = {
    "atlas": {"resolution": 48},
    "lightings": {"train": 16, "validation": 2, "test": 2, "clearance": 0.1},
    "points": {"count": 32, "supersample": 2},
    "transport": {"samples": 128, "test_samples": 128, "threads": 2},
}


# --- figures of effects --------------------------------------------------------------------------------------------------


def ground() -> Scene:
    """A black square, 20 m wide, that looks up."""
    square = rectangle((-10.0, -10.0), (10.0, 10.0), 0.0, 1, facing=1)
    return faceted("ground", np.array([square]), (ddprt.load_scene("furnace", albedo=0, subdivisions=1).materials[0],))


def lit(light: dict[str, Any], samples: int) -> float:
    """Irradiance of the ground in the middle."""
    return float(ddprt.irradiance(ground(), light, [[0.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]], samples=samples)[0][0, 1])


def against(found: float, expected: float) -> Figure:
    return {"closed_form_error": abs(found / expected - 1)}


def bounces(quick: bool) -> Figure:
    """A sphere of albedo a, lit from its middle: indirect light is a / (1 - a) times the direct."""
    scene = ddprt.load_scene("furnace", albedo=0.5, subdivisions=3)
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]}
    rng = np.random.default_rng(0)
    triangle = rng.choice(len(scene.areas), 256, p=scene.areas / scene.areas.sum())
    place, normal = scene.corners[triangle].mean(1), scene.geometric_normals[triangle]
    _, indirect = ddprt.irradiance(scene, lamp, place, normal, samples=400 if quick else 6400)
    return against(float(indirect.mean()), 4 * math.pi / scene.areas.sum())


def point(quick: bool) -> Figure:
    return against(lit({"type": "point", "position": [0.6, 0.8, 0], "intensity": [2, 2, 2]}, 1), 2 * 0.8)


def spot(quick: bool) -> Figure:
    light = {"type": "spot", "position": [0.6, 0.8, 0], "direction": [-0.6, -0.8, 0], "intensity": [2, 2, 2]}
    return against(lit({**light, "inner_deg": 10, "outer_deg": 30}, 1), 2 * 0.8)


def directional(quick: bool) -> Figure:
    return against(lit({"type": "directional", "direction": [0.6, -0.8, 0], "irradiance": [3, 3, 3]}, 1), 3 * 0.8)


def rect(quick: bool) -> Figure:
    """Parallel, above a corner: Lambert's formula for a quarter, four times."""
    half, height = 0.5, 1.0
    x = half / math.hypot(half, height)
    quarter = x * math.atan(x) / math.pi  # both terms of the corner's factor are alike in a square
    light = {"type": "rect", "center": [0, height, 0], "half_u": [half, 0, 0], "half_v": [0, 0, half], "radiance": [1, 1, 1]}
    return against(lit(light, 1 << 16 if quick else 1 << 20), math.pi * 4 * quarter)


def sphere(quick: bool) -> Figure:
    light = {"type": "sphere", "center": [0.6, 0.8, 0], "radius": 0.25, "radiance": [1, 1, 1]}
    return against(lit(light, 1 << 12 if quick else 1 << 16), math.pi * 0.25**2 * 0.8)


FIGURES: dict[str, Callable[[bool], Figure]] = {
    "diffuse bounces": bounces,
    "point lights": point,
    "spot lights": spot,
    "directional lights": directional,
    "rect lights": rect,
    "sphere lights": sphere,
}
"""What tells of each effect that it is right: `closed_form_error`, or `z_mean` and `z_std`. A new effect is one entry more."""


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
    quick = "--quick" in sys.argv
    figures = {}
    for name in EFFECTS:
        if name not in FIGURES:
            print(f"{name}: no figure here")
            continue
        begun = time.perf_counter()
        figures[name] = {key: float(f"{value:.3g}") for key, value in FIGURES[name](quick).items()}
        told = ", ".join(f"{key} {value:g}" for key, value in figures[name].items())
        print(f"{name}: {told} ({time.perf_counter() - begun:.1f} s)", flush=True)
    print(json.dumps({"effects": figures, **zero_cost(QUICK_TURNS if quick else TURNS)}))


if __name__ == "__main__":
    main()
