"""How fast is a bake of many lightings, at what error, and against whom?

Question: seconds at equal error, of the relit result and of each map, against Mitsuba 3, which renders one lighting at a time;
          the share of Embree's own rate; the bias of the operator; what texels, rays, lightings and triangles cost.
Command:  python experiments/bake_speed.py --quick            under a minute; last line is JSON
          python experiments/bake_speed.py compare SCENE [full]    the whole comparison, minutes; a line of JSON at its end
          python experiments/bake_speed.py rate [SCENE]       the share of Embree's rate
          python experiments/bake_speed.py integrators        error over seconds of all three, and of both peers
          python experiments/bake_speed.py sampling           what the sequence saves against independent numbers
          python experiments/bake_speed.py draw               docs/baking.png, from what these left in runs/
          python experiments/bake_speed.py scaling            slopes over texels, rays, lightings and triangles
          python experiments/bake_speed.py bias [SCENE ...]   operator against unbiased paths, on all scenes that bounce light
Answer:   docs/baking.md

Seconds are those of making the indirect maps in memory, all that depends on a lighting included (so the direct light that the
operator bounces, but no file). What both sides share is left out: atlas, tree of the scene, compilation. "Relit" is the error
of 16 bases and 128 points, trained on the maps in question, on held-out lightings.

Truth is two independent halves of unbiased paths, r and r'. The error of maps y is then mean((y - r)(y - r')), which holds no
noise of the truth; and the bias of two independent bakes y and y' is mean((y - r)(y' - r')), which holds no noise at all.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import ddprt
from ddprt import seeds, warp
from ddprt.config import Config, load_config
from ddprt.dataset.store import average_into_points
from ddprt.fitting.encoding import Encoding
from ddprt.lights import Lighting
from ddprt.methods import make_method
from ddprt.methods.method import Examples, Frame
from ddprt.sampling.lightings import draw_lightings
from ddprt.sampling.points import place_samples
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import centred, mean_irradiance, on_texels
from ddprt.transport.effort import choose_rays
from ddprt.transport.embree import Tracer
from ddprt.transport.footprint import find_footprints
from ddprt.transport.gather import Pattern, Receivers, seen_from
from ddprt.transport.measure import measure
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.operator import Operator
from ddprt.transport.paths import trace_paths
from ddprt.transport.reference import on_texels as on_all_texels
from ddprt.transport.reference import trace_reference

RESOLUTION = 152  # 15 k texels on the Cornell box
BASES, POINTS, SUPERSAMPLE = 16, 128, 8


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene, its atlas and its lightings."""

    name: str
    scene: Scene
    atlas: Atlas
    tracer: Tracer
    config: Config
    train: tuple[Lighting, ...]
    test: tuple[Lighting, ...]


def stage(name: str, resolution: int, train: int, test: int) -> Stage:
    around = {"lightings.distribution": "around"} if name == "statue" else {}
    config = load_config("configs/cornell.toml", around)
    scene = ddprt.load_scene(name)
    tracer = Tracer.of(scene)
    atlas, _ = build_open_atlas(tracer, scene, resolution)
    draws = [
        draw_lightings(config.lightings, split, n, bounds=scene.bounds, clearance=tracer.clearance, seed=0).lightings
        for split, n in (("train", train), ("test", test))
    ]
    return Stage(name, scene, atlas, tracer, config, *draws)


def bake(
    on: Stage, lightings: Sequence[Lighting], samples: int | str, stream: str = "train 0"
) -> tuple[np.ndarray, float, dict]:
    """All indirect maps by the operator, as `ddprt.bake` makes training maps: (lightings, texels, 3), seconds, facts."""
    tracer, atlas = on.tracer, on.atlas
    transport = on.config.transport.model_copy(update={"samples": samples})
    start = time.perf_counter()
    address = stream.encode()
    places = on_texels(tracer, atlas, transport.direct_samples, seeds.stream(0, "texel positions", *address))
    operator = Operator.of(tracer, atlas, transport.sender_resolution)

    def direct(index: int) -> np.ndarray:
        light = mean_irradiance(tracer, centred(tracer, lightings[index]), places, seeds.stream(0, "direct", index, *address))
        return operator.averaged(light)

    sent = np.concatenate(list(tracer.map(direct, range(len(lightings)))), 1)
    near = operator.near(lightings, sent)
    bounced = operator.bounce(sent, seed=0, stream=stream)
    chosen = choose_rays(operator, bounced.radiosity, transport, near=near, held_out=False, seed=0, stream=stream)
    maps = np.empty((len(lightings), atlas.count, 3), np.float32)
    for _ in operator.gather(bounced.radiosity, maps, chosen.rays, near=near, seed=0, stream=stream):
        pass
    if chosen.footprints:
        for index, pooled in enumerate(tracer.map(lambda index: chosen.footprints.pooled(maps[index]), range(len(lightings)))):
            maps[index] = pooled
    np.maximum(maps, 0, out=maps)
    return maps, time.perf_counter() - start, chosen.facts


@dataclass(frozen=True, eq=False)
class Truth:
    """Two independent halves of unbiased light at some texels, and how much of the surface each stands for."""

    texels: np.ndarray
    halves: np.ndarray  # (2, lightings, texels, 3)
    weights: np.ndarray

    @property
    def mean(self) -> float:
        return self.averaged(self.halves.mean(0))

    def averaged(self, values: np.ndarray) -> float:
        """Mean over lightings, surface and channels."""
        return float(np.mean(np.einsum("ltc,t->lc", values.astype(float), self.weights)))

    def error(self, maps: np.ndarray, others: np.ndarray | None = None) -> float:
        """Relative RMSE of maps, or the bias that two independent sets of maps share."""
        return float(np.sqrt(max(self._squares(maps, others).sum(), 0.0)) / self.mean)

    def _squares(self, maps: np.ndarray, others: np.ndarray | None) -> np.ndarray:
        """Each texel's share of the squared error."""
        one, two = maps[:, self.texels], (maps if others is None else others)[:, self.texels]
        return self.weights * np.mean((one - self.halves[0]) * (two - self.halves[1]).astype(float), (0, 2))

    def between(self, maps: np.ndarray, others: np.ndarray) -> tuple[float, float]:
        """Where the bias lies, two standard errors to both sides, by drawing texels again."""
        squares, rng = self._squares(maps, others), np.random.default_rng(0)
        spread = np.std([squares[rng.integers(0, len(squares), len(squares))].sum() for _ in range(200)])
        low, high = (np.sqrt(max(squares.sum() + way * spread, 0.0)) / self.mean for way in (-2, 2))
        return float(low), float(high)

    def noise(self, maps: np.ndarray, others: np.ndarray) -> float:
        """Relative RMSE of each of two independent sets of maps about their mean."""
        return float(np.sqrt(self.averaged((maps - others)[:, self.texels] ** 2) / 2) / self.mean)


def truth(on: Stage, lightings: Sequence[Lighting], texels: int, paths: int) -> Truth:
    chosen = np.sort(seeds.stream(0, "truth").choice(on.atlas.count, texels, replace=False))
    halves = np.zeros((2, len(lightings), on.atlas.count, 3), np.float32)
    for half in range(2):
        for _ in trace_paths(
            on.tracer,
            on.scene,
            on.atlas,
            lightings,
            halves[half],
            samples=paths,
            seed=0,
            stream=f"truth {half}",
            texels=chosen,
        ):
            pass
    area = on.atlas.area[chosen]
    return Truth(chosen, halves[:, :, chosen], area / area.sum())


class Relit:
    """Held-out error of what is learned from maps."""

    def __init__(self, on: Stage, against: Truth) -> None:
        self.on, self.truth = on, against
        self.samples = place_samples(on.scene, POINTS * SUPERSAMPLE, on="surface", seed=0)
        self.train, self.test = (self._values(lightings) for lightings in (on.train, on.test))

    def _values(self, lightings: Sequence[Lighting]) -> np.ndarray:
        samples = self.samples
        measured = [measure(self.on.tracer, lighting, samples.position, samples.normal, seed=0) for lighting in lightings]
        return average_into_points(np.stack(measured), samples, POINTS, "radiosity")

    def error(self, maps: np.ndarray) -> float:
        count = len(maps)
        encoding = Encoding("linear", 2.2, "mono")
        where = [jnp.asarray(place[:POINTS], jnp.float32) for place in (self.samples.position, self.samples.normal)]
        scale = encoding.scale(jnp.asarray(self.train[:count]))
        frame = Frame(encoding.encode(jnp.asarray(self.train[:count]), scale), *where)
        area = np.asarray(self.on.atlas.area, np.float32)
        pairs = Examples(frame, encoding.encode(jnp.asarray(maps), scale), scale, area, "area", "mono")
        settings = self.on.config.fit.model_dump(exclude={"method", "points"}) | {"bases": BASES}
        fitted = make_method("svd-ridge", settings, {}).fit(pairs, pairs, key=jax.random.key(0))
        scale = encoding.scale(jnp.asarray(self.test))
        light = fitted.predict(Frame(encoding.encode(jnp.asarray(self.test), scale), *where))
        return self.truth.error(np.asarray(encoding.decode(light, scale)))


# --- the share of Embree's rate -------------------------------------------------------------------------------------------


def share_of_embree(on: Stage, rounds: int = 5) -> dict[str, float]:
    """Rays per second of both tracing stages over those of a bare loop with the very same rays, on all cores; medians."""
    tracer, atlas = on.tracer, on.atlas
    operator = Operator.of(tracer, atlas)
    receivers = Receivers.texels(atlas, 256, 0, "rate")
    tiles = list(receivers.tiles())[:128]
    places = on_texels(tracer, atlas, 4, seeds.stream(0, "texel positions"))
    lightings = [centred(tracer, lighting) for lighting in on.train[:32]]

    def gather(tile: slice) -> None:
        for _ in seen_from(tracer, receivers, tile, operator.landing):
            pass

    def shade(lighting: Lighting) -> None:
        mean_irradiance(tracer, lighting, places, seeds.stream(0, "direct"))

    def again(batch: tuple[np.ndarray, ...]) -> None:
        if len(batch) == 2:
            tracer.first(*batch)
        else:
            tracer.unoccluded(*batch[:2], batch[2].copy())

    shares = {}
    works: dict[str, tuple[Callable[[Any], None], list[Any], str]] = {
        "gather": (gather, tiles, "first"),
        "direct": (shade, lightings, "unoccluded"),
    }
    for name, (work, items, query) in works.items():
        batches = _recorded(tracer, query, work, items)
        ratios = []
        for _ in range(rounds):
            seconds = []
            for job, things in ((work, items), (again, batches)):
                start = time.perf_counter()
                for _ in tracer.map(job, things):
                    pass
                seconds.append(time.perf_counter() - start)
            ratios.append(seconds[1] / seconds[0])
        shares[name] = float(np.median(ratios))
    return shares


def rate(name: str = "cornell") -> None:
    """The share of Embree's rate, with point lamps."""
    print(name, share_of_embree(stage(name, RESOLUTION, 32, 1), 9))


def _recorded(tracer: Tracer, query: str, work: Callable[[Any], None], items: list[Any]) -> list[tuple[np.ndarray, ...]]:
    """The rays that some work shoots, call by call."""
    shoot, batches = getattr(tracer, query), []

    def note(*rays: np.ndarray) -> Any:
        batches.append(tuple(array.copy() for array in rays))
        return shoot(*rays)

    setattr(tracer, query, note)
    try:
        for item in items:
            work(item)
    finally:
        delattr(tracer, query)
    return batches


# --- the comparison -------------------------------------------------------------------------------------------------------


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
        """Seconds per lighting; the error relit from the first lightings, for some numbers of them."""
        self.peer.bake(self.on.train[0], paths, 99)  # compiles
        start = time.perf_counter()
        maps = np.stack([self.peer.bake(lighting, paths, index) for index, lighting in enumerate(self.on.train[:count])])
        seconds = (time.perf_counter() - start) / count
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
        (maps, _, facts), (other, _, _) = (bake(self.on, self.on.train[: self.tests], "auto", f"run {k}") for k in range(2))
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


def sampling() -> None:
    """Noise of independent rays, of Sobol blocks dealt out at random and in Z-order: of a texel and of 5 x 5 means."""
    on = stage("cornell", RESOLUTION, 8, 1)
    operator, count = Operator.of(on.tracer, on.atlas), on.atlas.count
    places = on_texels(on.tracer, on.atlas, 4, seeds.stream(0, "texel positions"))
    lights = [mean_irradiance(on.tracer, centred(on.tracer, light), places, seeds.stream(0, "d")) for light in on.train]
    sent = np.concatenate([operator.averaged(light) for light in lights], 1)
    radiosity = operator.bounce(sent, seed=0, stream="sampling").radiosity
    wide = find_footprints(on.atlas, np.full(count, 1e-3), 1.0)  # as good as a plain mean over the neighbours
    dealt = Pattern.of, Pattern.deal

    def independent(samples: int, seed: int) -> Pattern:
        u = np.random.default_rng(seed).random((samples, 1 << 8, 4), np.float32)
        return Pattern(np.ascontiguousarray(warp.sample_cosine(u[..., :2])[..., :2]), np.ascontiguousarray(u[..., 2:]))

    def shuffled(self: Pattern, row: np.ndarray, column: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        turn = 2 * np.pi * rng.random(len(row))
        block = rng.integers(0, self.disk.shape[1], len(row)).astype(np.int32)
        return block, np.stack([np.cos(turn), np.sin(turn)], 1).astype(np.float32)

    print("rays  numbers      relative RMSE of a texel  of a mean over 5 x 5")
    for samples in (16, 64, 256):
        for name, of, deal in (("independent", independent, shuffled), ("Sobol", dealt[0], shuffled), ("Z-order", *dealt)):
            Pattern.of, Pattern.deal = staticmethod(of), deal  # type: ignore[method-assign]
            runs = []
            for run in range(2):
                maps = np.empty((len(on.train), count, 3), np.float32)
                list(operator.gather(radiosity, maps, np.full(count, samples), seed=0, stream=f"sampling {run}"))
                runs.append(maps)
            noise = runs[0] - runs[1]
            smooth = np.stack([wide.pooled(values) for values in noise])
            texel, mean = (np.sqrt(np.mean(values**2) / 2) / runs[0].mean() for values in (noise, smooth))
            print(f"{samples:4d}  {name:12s} {texel:23.4f} {mean:21.4f}", flush=True)
    Pattern.of, Pattern.deal = dealt  # type: ignore[method-assign]


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


# --- what things cost -----------------------------------------------------------------------------------------------------


def scaling() -> None:
    """Seconds over texels, rays, lightings and triangles; the slope between logarithms of the last two."""
    on = stage("cornell", 256, 1024, 1)
    bake(on, on.train[:2], 16)

    def show(what: str, sizes: Sequence[float], seconds: Sequence[float]) -> None:
        slope = np.diff(np.log(seconds[-2:]))[0] / np.diff(np.log(sizes[-2:]))[0]
        cells = "  ".join(f"{size:.4g}: {second:.2f} s" for size, second in zip(sizes, seconds, strict=True))
        print(f"{what:10s} {cells}; slope {slope:.2f}", flush=True)

    counts = (1, 4, 16, 64, 256, 1024)
    show("lightings", counts, [bake(on, on.train[:count], 64)[1] for count in counts])
    rays = (16, 64, 256, 1024)
    show("rays", rays, [bake(on, on.train[:16], samples)[1] for samples in rays])
    atlases = [replace(on, atlas=build_open_atlas(on.tracer, on.scene, side)[0]) for side in (128, 256, 512, 1024)]
    show("texels", [each.atlas.count for each in atlases], [bake(each, on.train[:16], 64)[1] for each in atlases])
    sizes, seconds = [], []
    for subdivisions in (3, 5, 6, 7, 8):
        scene = ddprt.load_scene("furnace", subdivisions=subdivisions)
        tracer = Tracer.of(scene)
        ball = replace(on, scene=scene, tracer=tracer, atlas=build_open_atlas(tracer, scene, 256)[0])
        lights = draw_lightings(
            on.config.lightings, "train", 16, bounds=scene.bounds, clearance=ball.tracer.clearance, seed=0
        ).lightings
        sizes.append(len(scene.triangles))
        seconds.append(bake(ball, lights, 64)[1])
    show("triangles", sizes, seconds)


def bias(*names: str) -> None:
    """What senders and footprints cost, against unbiased paths, on scenes that bounce light."""
    print("scene       senders a side   noise of a bake   bias (within two standard errors)")
    for name in names or ("cornell", "corridor", "statue", "cornell-hole", "plates"):
        on = stage(name, 256, 8, 1)
        reference = truth(on, on.train, 1024, 16384)
        for side in (32, 64, 128, 256):
            transport = on.config.transport.model_copy(update={"sender_resolution": side})
            changed = replace(on, config=on.config.model_copy(update={"transport": transport}))
            maps, other = (bake(changed, on.train, "auto", f"run {k}")[0] for k in range(2))
            low, high = reference.between(maps, other)
            noise, found = reference.noise(maps, other), reference.error(maps, other)
            print(f"{name:12s}{side:14d}{noise:18.4f}{found:9.4f} ({low:.4f} to {high:.4f})", flush=True)


if __name__ == "__main__":
    verb, *rest = [word.removeprefix("--") for word in sys.argv[1:]] or ["quick"]
    verbs: dict[str, Callable[..., None]] = {
        "quick": quick,
        "compare": compare,
        "integrators": integrators,
        "rate": rate,
        "sampling": sampling,
        "draw": draw,
        "scaling": scaling,
        "bias": bias,
    }
    verbs[verb](*rest)
