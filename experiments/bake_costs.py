"""What does a bake of many lightings cost by itself, and what does it get wrong?

Question: the share of Embree's own rate; what the low-discrepancy sequence saves; what texels, rays, lightings and triangles
          cost; the bias of the operator; seconds, memory and noise of a large bake from scene to files.
Command:  python experiments/bake_costs.py rate [SCENE]       the share of Embree's rate
          python experiments/bake_costs.py sampling           what the sequence saves against independent numbers
          python experiments/bake_costs.py scaling            slopes over texels, rays, lightings and triangles
          python experiments/bake_costs.py bias [SCENE ...]   operator against unbiased paths, on all scenes that bounce light
          python experiments/bake_costs.py large [RESOLUTION ...]    the whole bake of the Cornell box; 1024 unless given
Answer:   docs/baking.md

What seconds and errors are is said in `bake_stage.py`; only those of `large` hold everything that a user waits for.
"""

import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bake_stage import RESOLUTION, Stage, bake, bake_twice, command, stage, truth

import ddprt
from ddprt import seeds, warp
from ddprt.config import load_config
from ddprt.dataset.manifest import Manifest
from ddprt.errors import UserError
from ddprt.lights import Lighting
from ddprt.progress import Progress
from ddprt.transport.direct import Texels, centred, mean_irradiance
from ddprt.transport.embree import Tracer
from ddprt.transport.footprint import find_footprints
from ddprt.transport.gather import Pattern, Receivers, seen_from
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.operator import Operator


def share_of_embree(on: Stage, rounds: int = 5) -> dict[str, float]:
    """Rays per second of both tracing stages over those of a bare loop with the very same rays, on all cores; medians."""
    tracer, atlas = on.tracer, on.atlas
    operator = Operator.of(tracer, atlas)
    receivers = Receivers.texels(atlas, 256, 0, "rate")
    tiles = list(receivers.tiles())[:128]
    places = Texels.of(tracer, atlas, 4, seeds.stream(0, "texel positions")).places
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
            tracer.unoccluded(*batch)

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


def sampling() -> None:
    """Noise of independent rays, of Sobol blocks dealt out at random and in Z-order: of a texel and of 5 x 5 means."""
    on = stage("cornell", RESOLUTION, 8, 1)
    operator, count = Operator.of(on.tracer, on.atlas), on.atlas.count
    places = Texels.of(on.tracer, on.atlas, 4, seeds.stream(0, "texel positions")).places
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
        ball = stage("furnace", 256, 16, 1, subdivisions=subdivisions)
        sizes.append(len(ball.scene.triangles))
        seconds.append(bake(ball, ball.train, 64)[1])
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
            maps, other, _ = bake_twice(changed, on.train)
            low, high = reference.between(maps, other)
            noise, found = reference.noise(maps, other), reference.error(maps, other)
            print(f"{name:12s}{side:14d}{noise:18.4f}{found:9.4f} ({low:.4f} to {high:.4f})", flush=True)


def large(*resolutions: str) -> None:
    """Seconds, memory and noise of whole bakes, each in a process of its own and with files in a temporary folder."""
    for resolution in map(int, resolutions or ("1024",)):
        begun = time.perf_counter()
        # Spawned, so that neither memory nor anything compiled or unwrapped before is shared.
        with (
            tempfile.TemporaryDirectory(prefix="bake_costs-") as folder,
            ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as child,
        ):
            found = child.submit(bake_files, resolution, folder).result()
            whole = time.perf_counter() - begun
        print(
            f"{resolution}²: {found['texels']} texels, {found['lightings']} lightings: {found['seconds']:.1f} s from scene to "
            f"verified pairs ({whole:.1f} s with the start of Python), {found['peak'] / 2**30:.2f} GiB at the peak; noise of "
            f"the held-out maps {found['noise']:.4f}, expected of the training maps {found['expected']:.4f}",
            flush=True,
        )


def bake_files(resolution: int, folder: str) -> dict[str, Any]:
    """The Cornell box with 128 training lightings at a noise of 2 %, baked as a user would and read back against its hashes."""
    os.environ["DDPRT_CACHE"] = f"{folder}/cache"  # an atlas that was unwrapped before would cost nothing
    changes = {"atlas.resolution": str(resolution), "transport.target_noise": "0.02"}
    changes |= {"lightings.train": "128", "lightings.validation": "1", "lightings.test": "1"}
    config, progress, begun = load_config("configs/cornell.toml", changes), Progress(), time.perf_counter()
    data = ddprt.bake(ddprt.load_scene("cornell"), config=config, out=f"{folder}/dataset", progress=progress)
    if faults := Manifest(Path(data.folder)).damaged():
        raise UserError(f"{data.folder}: {'; '.join(faults)}")
    seconds = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    test, area = data.split("test"), data.area
    light, noise = (data.maps(kind, test).astype(float) for kind in ("indirect", "noise"))
    stages = {stage["name"]: stage for stage in progress.stages}
    return {
        "texels": len(area),
        "lightings": len(data.lightings),
        "seconds": seconds,
        "peak": peak,
        # Each map is the mean of two halves, so half their difference has its variance.
        "noise": np.sqrt(np.average(np.mean(noise**2, (0, 2)), weights=area)) / np.average(light.mean((0, 2)), weights=area),
        "expected": stages["indirect train"]["noise_expected"],
    }


if __name__ == "__main__":
    command({"rate": rate, "sampling": sampling, "scaling": scaling, "bias": bias, "large": large})
