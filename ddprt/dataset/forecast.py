"""What a bake will take, before it begins: seconds of each stage, rays, files, bytes and memory.

The bake's own code runs on a small share of its work, on this machine and now, and what that took is scaled by laws that follow
from the code. Nothing is a constant of some machine.

| part | measured on | grows with |
| --- | --- | --- |
| lightings, atlas, points | all of it | |
| direct light, files, reading back | up to 64 lightings, files and all | lamps; the first ones apart, which load and compile |
| bounces | all of it, stand-ins for the lightings that were not drawn | columns, past 512 lightings |
| choice of rays | all of it | |
| gather | a stretch for each thread (`transport/effort.py`) | rays; columns, past 512 lightings |
| maps in the making | 32 MiB | bytes |
| files of indirect light | two maps for each thread | files |
| probes | their choice of rays; some places twice, and files as they come | places, columns |
| gloss | choice of rays in stand-ins of the maps; some tiles of texels, all lightings in each | tiles; lightings, past 512 |
| light of what glows | its direct part on some texels, its bounces and choice of rays | samples |

An EXR is compressed in blocks of 16 rows, each by itself. So maps need not be made whole to tell their size: some blocks get
a few rays, are smoothed, and get the noise that is expected of them.
"""

import json
import re
import tempfile
import time
from dataclasses import dataclass, replace
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np

from ddprt import seeds
from ddprt.config import Config
from ddprt.dataset import store
from ddprt.dataset.denoise import find_denoiser
from ddprt.dataset.forecast_effects import effect_costs
from ddprt.dataset.forecast_indirect import expect_indirect
from ddprt.dataset.forecast_layers import expect_constant, expect_layers
from ddprt.dataset.generate import check_points, sunk
from ddprt.dataset.manifest import Manifest, map_name
from ddprt.dataset.sameness import baked_settings
from ddprt.dataset.sampled import Expected, Part, Sampled
from ddprt.dataset.splits import choose_lightings, doubt
from ddprt.dataset.store import ATLAS_FILES
from ddprt.files import write_tensors
from ddprt.lights import Lighting, lighting_json
from ddprt.machine import peak_memory_gib
from ddprt.progress import Progress, amount
from ddprt.sampling.points import Samples, load_samples, place_samples
from ddprt.scene.mesh import Scene
from ddprt.scene.unwrap import unwrap
from ddprt.transport.direct import Texels
from ddprt.transport.effects import Plan, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import scattering
from ddprt.transport.measure import measure
from ddprt.transport.openness import build_open_atlas

_MOST = 32  # lightings of a split that are looked at: as many as the choice of rays looks at
_LEAST = 16  # of both splits together: what rays they need differs between lightings


@dataclass(frozen=True)
class Forecast:
    """What a bake will take.

    Attributes:
      stages: in order.
      training_seconds: without held-out lightings.
      peak_gib: resident memory at the highest, maps in the making included.
      parts: what dominates, longest first.
      effects: the plan, with what each effect will take.
      spent: seconds that forecasting took.
    """

    stages: tuple[Expected, ...]
    training_seconds: float
    peak_gib: float
    parts: tuple[Part, ...]
    effects: Plan
    spent: float

    @property
    def seconds(self) -> float:
        """Of the whole bake."""
        return sum(stage.seconds for stage in self.stages)

    @property
    def bytes(self) -> int:
        """On disk at the end."""
        return sum(stage.bytes for stage in self.stages)

    @property
    def files(self) -> int:
        """Of the finished dataset, its description and manifest included."""
        return sum(stage.files for stage in self.stages)

    @property
    def rays(self) -> int:
        """Of all kinds."""
        return sum(stage.rays for stage in self.stages)

    def __str__(self) -> str:
        rows = [*self.stages, Expected("total", self.seconds, self.rays, self.files, self.bytes)]
        wide = 2 + max(14, *(len(row.name) for row in rows))
        lines = [f"{'stage':<{wide}}{'seconds':>9}{'rays':>9}{'files':>7}{'MB':>9}"]
        for row in rows:
            told = f"{row.seconds:9.2f}" if row.seconds < 100 else f"{row.seconds:9.0f}"
            lines.append(f"{row.name:<{wide}}{told}{amount(row.rays):>9}{row.files:>7}{row.bytes / 1e6:9.2f}")
        lines.append(f"memory at the peak about {self.peak_gib:.2g} GiB; forecast in {self.spent:.1f} s")
        if self.parts:
            part = self.parts[0]
            lines.append(
                f"of {self.seconds:.3g} s, {part.seconds:.2g} are {part.what}: {part.setting} would take about {part.then:.2g}"
            )
        called = {effect.name for effect in self.effects.effects if effect.called}
        lines += [f"effect {line}" for line in self.effects.lines() if line.split(":")[0] in called]
        return "\n".join(lines)


def forecast(
    scene: Scene, config: Config, progress: Progress | None = None, *, beside: Path | None = None, loading: float = 0.0
) -> Forecast:
    """Predicts a bake from nothing; what an earlier one left is not counted.

    Args:
      scene, config: as for `bake`.
      progress: told where the noise that is aimed at will not be reached.
      beside: folder on the disk that will be baked to; samples of files are written there and removed. None: the system's
        folder for temporary files.
      loading: seconds that the scene took to load.
    Raises:
      UserError: as `bake` would.
    """
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix=".ddprt-forecast-", dir=beside) as folder:
        found = _foreseen(scene, config, Path(folder), progress or Progress(quiet=True), loading)
    return replace(found, spent=time.perf_counter() - begun)


def _foreseen(scene: Scene, config: Config, folder: Path, progress: Progress, between: float) -> Forecast:
    """All stages in their order; `between` gathers what lies between them."""
    if config.transport.denoise:
        find_denoiser()
    stages: list[Expected] = []

    def staged(name: str) -> float:
        stages.append(Expected(name, time.perf_counter() - begun))
        return time.perf_counter()

    begun = time.perf_counter()
    tracer = Tracer.of(scene, config.transport.threads)
    listed = load_samples(config.points.file) if config.points.file else None
    between += time.perf_counter() - begun
    begun = time.perf_counter()
    entries, _ = choose_lightings(None, config.lightings, scene, tracer, config.seed)
    begun = staged("lightings")
    lightings = [lighting for _, lighting in entries]
    effects = plan(scene, lightings, bounces=config.transport.bounces, probes=config.probes.asked)
    between += time.perf_counter() - begun
    unwrap(scene, config.atlas.resolution, config.atlas.padding)  # kept for the bake, which finds it there
    begun = time.perf_counter()
    atlas, _ = build_open_atlas(tracer, scattering(scene), config.atlas.resolution, config.atlas.padding)
    begun = staged("atlas")
    peak = peak_memory_gib() or 0.0
    samples = listed
    if samples is None:
        check_points(config, scene, atlas)
        wanted = config.points.count * config.points.supersample
        samples = place_samples(scene, wanted, on=config.points.on, seed=config.seed, atlas=atlas)
    samples = sunk(samples, lightings, config.points, tracer)
    staged("points")
    job = Sampled(scene, config, folder, progress, tracer, lightings, effects.bounces, atlas, Manifest(folder), peak)
    placing, described = _placed(job, samples, entries)
    train, test = ([i for i, (name, _) in enumerate(entries) if (name == "test") is held] for held in (False, True))
    direct, seen, parts = _expect_direct(job, samples, train, test)
    stages.append(direct)
    reading, named = _reading(job, seen), 2 + len(ATLAS_FILES)
    for name, indices in (("train", train), ("test", test)):
        some = sorted({*seen} & {*indices})
        expected, more, sent = expect_indirect(job, name, indices, some)
        layers, placed = expect_layers(job, name, indices, some, sent)
        stages += [expected, *layers]
        parts, between = parts + more, between + placed.seconds
        named, described = named + placed.files, described + placed.bytes
    stages += expect_constant(job)
    line = len(json.dumps({"file": map_name("indirect", 0), "bytes": 10**6, "sha256": "0" * 64})) + 1
    listing = line * (sum(stage.files for stage in stages) + named)
    between += placing + reading * len(entries)
    stages.append(Expected("files", between, 0, named + 2, described + listing))
    lamps = [sum(map(len, (lightings[index] for index in part))) for part in (train, test)]
    tested = sum(stage.seconds for stage in stages if "test" in re.findall(r"\w+", stage.name))
    held_out = tested + reading * len(test) + direct.seconds * lamps[1] / sum(lamps)
    shorter = sorted((part for part in parts if part.then < part.seconds), key=lambda part: -part.seconds)
    effects = replace(effects, costs={**effects.costs, **effect_costs(job, stages, effects)})
    return Forecast(tuple(stages), sum(stage.seconds for stage in stages) - held_out, job.peak, tuple(shorter), effects, 0.0)


def _placed(job: Sampled, samples: Samples, entries: list[tuple[str, Lighting]]) -> tuple[float, int]:
    """Seconds and bytes of what lies beside the maps."""
    begun = time.perf_counter()
    records = [{"split": split, "lights": lighting_json(lighting)} for split, lighting in entries]
    store.write_description(job.folder, {**baked_settings(job.config, job.scene), "lightings": records})
    places = {"position": samples.position, "normal": samples.normal, "albedo": samples.albedo}
    write_tensors(job.folder / "points.safetensors", {**places, "spacing": np.zeros(1), "depth": np.zeros(1)})
    write_tensors(job.folder / "scene.safetensors", store.scene_tensors(job.scene, job.atlas))
    for name in ("points.safetensors", "scene.safetensors"):
        job.manifest.add(name)
    store.write_atlas(job.folder, job.atlas, job.manifest)
    return time.perf_counter() - begun, job.size([*job.manifest.entries]) + (job.folder / "dataset.json").stat().st_size


def _expect_direct(job: Sampled, samples: Samples, train: list[int], test: list[int]) -> tuple[Expected, list[int], list[Part]]:
    """Direct light of lightings of both splits, as the bake makes it, and which these were."""
    config, seed, lightings = job.config.transport, job.config.seed, job.lightings
    begun = time.perf_counter()
    texels = Texels.of(job.tracer, job.atlas, config.direct_samples, seeds.stream(seed, "texel positions"))
    spreading, before = time.perf_counter() - begun, job.tracer.rays

    def work(index: int) -> int:
        light = texels.irradiance(lightings[index], seeds.stream(seed, "direct", index))
        store.write_map(job.folder / map_name("direct", index), job.atlas.image(light))
        places = samples.position, samples.normal
        measured = measure(job.tracer, lightings[index], *places, seed=seed, index=index, depth=samples.depth)
        write_tensors(job.folder / map_name("measured", index), {"irradiance": measured})
        return index

    def names(index: int) -> list[str]:
        return [map_name("direct", index), map_name("measured", index)]

    orders = []
    for part in (train, test):
        spread = np.unique(np.linspace(0, len(part) - 1, min(len(part), _MOST)).astype(int))  # those that choose rays
        orders.append([part[place] for place in seeds.stream(0, "forecast").permutation(spread)])
    items = [index for index in chain.from_iterable(zip_longest(*orders)) if index is not None]
    whole = sum(map(len, lightings))
    seconds, seen = job.each(work, items, whole, size=lambda index: len(lightings[index]), names=names, least=_LEAST)
    share = whole / sum(len(lightings[index]) for index in seen)
    rays, count = int(share * (job.tracer.rays - before)), len(lightings)
    size = job.size([name for index in seen for name in names(index)]) * count // len(seen)
    job.holds(3 * job.tracer.threads * 12 * job.atlas.resolution**2)
    parts = []
    if config.direct_samples > 1:
        fewer = config.direct_samples // 2
        setting = f"transport.direct_samples = {fewer}"
        parts.append(Part("direct light", seconds, setting, seconds * fewer / config.direct_samples))
    return Expected("direct", spreading + seconds, rays, 2 * count, size), sorted(seen), parts


def _reading(job: Sampled, seen: list[int]) -> float:
    """Seconds to look at a lighting once it is baked: for darkness and doubt, and for the record's shares of light."""
    covered, weight = job.atlas.slot >= 0, job.atlas.area / job.atlas.area.sum()
    indices = seen[: 2 * job.tracer.threads]
    paths = [job.folder / map_name("direct", index) for index in indices]
    begun = time.perf_counter()
    dark = list(job.tracer.map(lambda path: not store.read_map(path).any(), paths))
    for index, black in zip(indices, dark, strict=True):
        doubt(job.lightings[index], black, job.scene, job.tracer)
    for path in paths * 2:  # one after the other, as direct and as indirect
        np.einsum("tc,t->", store.read_map(path)[covered], weight)
    return (time.perf_counter() - begun) / len(indices)
