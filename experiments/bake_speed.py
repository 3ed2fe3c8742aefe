"""How fast is a bake of many lightings against renderers that take one at a time?

Question: seconds at equal error, of the relit result and of each map, against Mitsuba 3 and Cycles.
Command:  python experiments/bake_speed.py --quick            under a minute; last line is JSON
          python experiments/bake_speed.py compare SCENE [full]    the whole comparison, minutes; a line of JSON at its end
          python experiments/bake_speed.py integrators        error over seconds of all three, and of both peers
          python experiments/bake_speed.py draw               docs/baking.png, from what these left in runs/
Answer:   docs/baking.md

What seconds and errors are is said in `bake_stage.py`; the peer's scene and compilation are left out as ours are. "Relit" is
the error of 16 bases and 128 points, trained on the maps in question, on held-out lightings. Points lie on the surface, where
a bake of the corridor would sink them (`points.depth`).
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from bake_costs import share_of_embree
from bake_stage import RESOLUTION, Stage, Truth, bake, bake_twice, command, stage, truth

from ddprt.dataset.store import average_into_points
from ddprt.fitting.encoding import Encoding
from ddprt.lights import Lighting
from ddprt.methods import make_method
from ddprt.methods.method import Examples, Frame, Relighter
from ddprt.sampling.points import place_samples
from ddprt.transport.measure import measure
from ddprt.transport.paths import trace_paths
from ddprt.transport.reference import on_texels as on_all_texels
from ddprt.transport.reference import trace_reference

BASES, POINTS, SUPERSAMPLE = 16, 128, 8
ENCODING = Encoding("linear", 2.2, "mono")


class Relit:
    """Held-out error of what is learned from maps."""

    def __init__(self, on: Stage, against: Truth) -> None:
        self.on, self.truth = on, against
        self.samples = place_samples(on.scene, POINTS * SUPERSAMPLE, on="surface", seed=0, atlas=on.atlas)
        self.train, self.test = (self._values(lightings) for lightings in (on.train, on.test))

    def _values(self, lightings: Sequence[Lighting]) -> np.ndarray:
        samples = self.samples
        measured = [measure(self.on.tracer, lighting, samples.position, samples.normal, seed=0) for lighting in lightings]
        return average_into_points(np.stack(measured), samples, POINTS, "radiosity")

    def error(self, maps: np.ndarray) -> float:
        measured = self.train[: len(maps)]
        where = [jnp.asarray(place[:POINTS], jnp.float32) for place in (self.samples.position, self.samples.normal)]
        light, scale = _encoded(maps, measured)
        area = np.asarray(self.on.atlas.area, np.float32)
        pairs = Examples(Frame(_encoded(measured, measured)[0], *where), light, scale, area, "area", "mono")
        settings = self.on.config.fit.model_dump(exclude={"method", "points"}) | {"bases": BASES}
        fitted = make_method("svd-ridge", settings, {}).fit(pairs, pairs, key=jax.random.key(0))
        inputs, scale = _encoded(self.test, self.test)
        return self.truth.error(np.asarray(_relit(fitted, inputs, *where, scale)))


# Compiled as wholes: step by step they are some sixty programs, which take seconds of what is to be quick.
@jax.jit
def _encoded(values: jax.Array, measured: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Light in units of what was measured of each lighting, and these units."""
    scale = ENCODING.scale(measured)
    return ENCODING.encode(values, scale), scale


@jax.jit
def _relit(fitted: Relighter, values: jax.Array, positions: jax.Array, normals: jax.Array, scale: jax.Array) -> jax.Array:
    return ENCODING.decode(fitted.predict(Frame(values, positions, normals)), scale)


@dataclass(frozen=True, eq=False)
class Run:
    """One setting of one side.

    Attributes:
      samples: rays or paths per texel.
      seconds: of all lightings.
      maps: of the lightings that are judged.
      relit: relative RMSE of what was learned, if it was.
    """

    samples: float
    seconds: float
    maps: np.ndarray
    relit: float = float("nan")


def seconds_at(seconds: Sequence[float], errors: Sequence[float], wanted: float) -> float:
    """Seconds of the cheapest setting with at most this error, straight lines between logarithms; NaN if none reaches it."""
    order = np.argsort(seconds)
    falling = np.minimum.accumulate(np.array(errors)[order])
    if falling[-1] > wanted:
        return float("nan")
    return float(np.exp(np.interp(-np.log(wanted), -np.log(falling), np.log(np.array(seconds)[order]))))


class Comparison:
    """Both sides on one scene with the same truth.

    Args:
      name: of the scene.
      count: training lightings.
      tests: held-out ones, and training ones whose maps are judged.
      paths: of the truth, for what is relit and for single maps.
    """

    def __init__(self, name: str, count: int, tests: int, paths: tuple[int, int]) -> None:
        from peer_mitsuba import MitsubaBaker

        self.on = stage(name, RESOLUTION, count, tests)
        self.tests = tests
        bake(self.on, self.on.train[:2], 16)  # compiles
        self.relit = Relit(self.on, truth(self.on, self.on.test, 1024, paths[0]))
        self.truth = truth(self.on, self.on.train[:tests], 192, paths[1])
        self.peer = MitsubaBaker(self.on.scene, self.on.atlas)
        self.peer.bake(self.on.train[0], 4, 99)  # makes its scene
        self.peer.dr.set_flag(self.peer.dr.JitFlag.KernelHistory, True)
        print(f"{name}: {self.on.atlas.count} texels, {count} lightings", flush=True)

    def error(self, maps: np.ndarray) -> float:
        """Of single maps, those of the first training lightings."""
        return replace(self.truth, halves=self.truth.halves[:, : len(maps)]).error(maps)

    def ours(self, rays: Sequence[int], count: int, learn: bool = True, repeats: int = 2) -> list[Run]:
        print(f"operator, {count} lightings: rays, seconds, error of a map, relit")
        runs = []
        for samples in rays:
            maps, seconds, facts = min(
                (bake(self.on, self.on.train[:count], samples) for _ in range(repeats)), key=lambda got: got[1]
            )
            run = Run(facts["samples"], seconds, maps[: self.tests], self.relit.error(maps) if learn else float("nan"))
            print(f"{run.samples:9.0f} {seconds:8.2f} {self.error(run.maps):8.4f} {run.relit:8.4f}", flush=True)
            runs.append(run)
        return runs

    def theirs(self, paths: int, count: int, learn: Sequence[int] = ()) -> tuple[Run, dict[int, float]]:
        """Seconds per lighting; the error relit from the first lightings, for some numbers of them.

        A kernel is compiled by the first bake with so many paths. Dr.Jit tells how long that took, which is taken off, so that
        no bake is made to be thrown away.
        """
        self.peer.dr.kernel_history_clear()
        start = time.perf_counter()
        maps = np.stack([self.peer.bake(lighting, paths, index) for index, lighting in enumerate(self.on.train[:count])])
        whole = time.perf_counter() - start
        compiling = (
            sum(kernel.get("backend_time", 0) for kernel in self.peer.dr.kernel_history()) / 1000
        )  # it counts milliseconds
        seconds = (whole - compiling) / count
        relit = {number: self.relit.error(maps[:number]) for number in learn}
        run = Run(paths, seconds, maps[: self.tests])
        print(
            f"Mitsuba: {paths} paths, {seconds:.3f} s a lighting, error of a map {self.error(run.maps):.4f}, relit {relit}",
            flush=True,
        )
        return run, relit

    def faster(self, ours: Sequence[Run], theirs: Run, count: int) -> float:
        """How many times at equal error of a map, on the same lightings."""
        lightings = len(theirs.maps)
        errors = [self.error(run.maps[:lightings]) for run in ours]
        return theirs.seconds * count / seconds_at([run.seconds for run in ours], errors, self.error(theirs.maps))

    def default(self) -> dict[str, float]:
        """Noise and bias of the default settings, from two independent bakes."""
        maps, other, facts = bake_twice(self.on, self.on.train[: self.tests])
        noise, bias = self.truth.noise(maps, other), self.truth.error(maps, other)
        print(f"default settings: {facts}, noise {noise:.4f}, bias {bias:.4f}", flush=True)
        return {"noise_floor": noise, "operator_bias": bias}


def relit_faster(ours: Sequence[Run], seconds: float, error: float) -> float:
    return seconds / seconds_at([run.seconds for run in ours], [run.relit for run in ours], error)


def quick() -> None:
    begun = time.perf_counter()
    count = 128
    both = Comparison("cornell", count, 5, (512, 4096))
    shares = share_of_embree(both.on, 3)
    ours = both.ours((16, 64, 256), count) + both.ours((1024,), count, repeats=1)  # the last is the floor alone
    low, relit = both.theirs(16, count, (count,))
    high, _ = both.theirs(1024, 2)
    # Independent noise falls with its variance, in the maps and in what is learned from them (`compare` measures it).
    floor = ours[-1].relit ** 2
    share = (both.error(high.maps) / both.error(low.maps[: len(high.maps)])) ** 2
    expected = float(np.sqrt(floor + max(relit[count] ** 2 - floor, 0) * share))
    answer = {
        "speedup_vs_mitsuba_equal_relit_error": relit_faster(ours, high.seconds * count, expected),
        "speedup_vs_mitsuba_equal_error": both.faster(ours, high, count),
        "mitsuba_paths": 1024,
        "relit_error": expected,
        "speedup_at_16_paths_equal_relit_error": relit_faster(ours, low.seconds * count, relit[count]),
        "speedup_at_16_paths_equal_error": both.faster(ours, low, count),
        "lightings": count,
        "fraction_of_embree_rate_direct": shares["direct"],
        "fraction_of_embree_rate_gather": shares["gather"],
        **both.default(),
        "seconds": time.perf_counter() - begun,
    }
    print(json.dumps({key: float(f"{value:.4g}") for key, value in answer.items()}))


def compare(name: str = "cornell", extent: str = "brief") -> None:
    """Equal error over paths, and over the number of lightings."""
    full = extent == "full"
    both = Comparison(name, 1024 if full else 128, 16, (2048, 16384))
    both.default()
    learned = {16: (64, 128, 256), 64: (64, 128), 256: (128,)} if full else {16: (128,), 64: (128,)}
    theirs = {paths: both.theirs(paths, max(numbers), numbers) for paths, numbers in learned.items()}
    theirs |= {paths: both.theirs(paths, lightings) for paths, lightings in ((1024, 4), (4096, 2))}
    table = []
    for count in (1, 4, 16, 64, 128, 256, 1024) if full else (1, 16, 128):
        ours = both.ours((8, 16, 64, 256, 1024), count, learn=count >= 64)
        for paths, (run, relit) in theirs.items():
            entry = {"lightings": count, "paths": paths}
            judged = replace(run, maps=run.maps[: min(count, len(run.maps))])
            entry["per_map"] = both.faster(ours, judged, count)
            if count in relit:
                entry["relit"] = relit_faster(ours, run.seconds * count, relit[count])
            table.append({key: float(f"{value:.4g}") for key, value in entry.items()})
            print(f"  times faster at equal error: {table[-1]}", flush=True)
    keep(name, table)


def keep(name: str, table: list[dict[str, Any]]) -> None:
    """Leaves results for `draw`, and prints them."""
    path = Path("runs") / f"bake_speed-{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(table) + "\n")
    print(json.dumps(table))


def integrators() -> None:
    """Seconds and error per map of 128 lightings of the Cornell box; slow ones are measured on fewer and multiplied."""
    count, both = 128, Comparison("cornell", 128, 16, (512, 16384))
    atlas, table = both.on.atlas, []

    def note(name: str, samples: float, seconds: float, maps: np.ndarray) -> None:
        error = both.error(maps[: both.tests])
        table.append({"integrator": name, "samples": samples, "seconds": round(seconds, 3), "error": round(error, 5)})
        print(table[-1], flush=True)

    for run in both.ours((8, 16, 64, 256, 1024), count, learn=False):
        note("operator", run.samples, run.seconds, run.maps)
    for samples in (4, 16, 64, 256):
        maps = np.zeros((count, atlas.count, 3), np.float32)
        for measured in (2, count):  # the first compiles
            start = time.perf_counter()
            for _ in trace_paths(
                both.on.tracer,
                both.on.scene,
                atlas,
                both.on.train[:measured],
                maps[:measured],
                samples=samples,
                seed=0,
                stream="speed",
            ):
                pass
        note("paths", samples, time.perf_counter() - start, maps)
    few = 4
    for samples in (16, 64, 256):
        start = time.perf_counter()
        texels = on_all_texels(both.on.tracer, atlas, np.arange(atlas.count))
        maps = np.stack(
            [
                trace_reference(both.on.tracer, both.on.scene, lighting, texels, atlas.count, samples, seed=index).indirect
                for index, lighting in enumerate(both.on.train[:few])
            ]
        )
        note("reference", samples, (time.perf_counter() - start) * count / few, maps)
    for samples, lightings in ((16, 16), (64, 16), (256, 8), (1024, 2)):
        run, _ = both.theirs(samples, lightings)
        note("Mitsuba", samples, run.seconds * count, run.maps)
    keep("integrators", table)


def draw() -> None:
    """docs/baking.png: ratios over lightings, and errors over seconds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    table = json.loads(Path("runs/bake_speed-cornell.json").read_text())
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for paths in sorted({entry["paths"] for entry in table}):
        rows = [entry for entry in table if entry["paths"] == paths]
        left.loglog(
            [row["lightings"] for row in rows], [row["per_map"] for row in rows], "o-", label=f"{paths:.0f} paths, per map"
        )
        relit = [row for row in rows if "relit" in row]
        if relit:
            left.loglog([row["lightings"] for row in relit], [row["relit"] for row in relit], "kx")
    left.plot([], [], "kx", label="relit from 16 bases")
    left.axhline(1, color="grey", linewidth=0.8)
    left.set(xlabel="lightings", ylabel="times faster than Mitsuba at equal error", title="Cornell box, 15 k texels")
    left.legend(fontsize=8)
    rows = json.loads(Path("runs/bake_speed-integrators.json").read_text()) + CYCLES
    for name in dict.fromkeys(row["integrator"] for row in rows):
        mine = [row for row in rows if row["integrator"] == name]
        right.loglog([row["seconds"] for row in mine], [row["error"] for row in mine], "o-", label=name)
    right.set(xlabel="seconds for 128 lightings, two cores", ylabel="relative RMSE of a map", title="error over seconds")
    right.legend(fontsize=8)
    figure.savefig("docs/baking.png", dpi=90)


CYCLES = [
    {"integrator": "Cycles", "samples": 16, "seconds": 128 * 0.216, "error": 0.385},
    {"integrator": "Cycles", "samples": 64, "seconds": 128 * 0.789, "error": 0.177},
    {"integrator": "Cycles", "samples": 256, "seconds": 128 * 3.11, "error": 0.0837},
]
"""One lighting by datasets/recipes/cycles_bake.py on the same machine, times 128; error from two runs."""


if __name__ == "__main__":
    command({"quick": quick, "compare": compare, "integrators": integrators, "draw": draw})
