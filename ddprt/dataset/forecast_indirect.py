"""What indirect light will take: bounces, choice of rays, gather (or paths) and files, each on a share of the work."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Int
from ddprt.dataset.denoise import denoised
from ddprt.dataset.manifest import map_name
from ddprt.dataset.sampled import WIDE, Expected, Number, Part, Sampled, extrapolated, on_a_line, scratched
from ddprt.dataset.store import read_map, write_map
from ddprt.lights import Lighting
from ddprt.transport.direct import Texels
from ddprt.transport.glossiness import valid_integrator
from ddprt.transport.sources import Sent
from ddprt.transport.translucency import filled

_BLOCK = 16  # rows of an EXR that are compressed together
_FEW, _LOOKED_AT = 8, 2  # rays and lightings that tell what maps look like
_SEEN = 1 << 16  # texels that get these rays
SCRATCHED = 1 << 25  # bytes of maps in the making that tell how long the disk takes
_REFERENCE = 512  # paths of the reference where nothing else is asked for
_SHADED = 4, 16  # lightings whose difference tells what a further one costs the paths
_WALKED, _STEPS = 256, 64  # texels of bodies, and walks of each, that tell what walks take
_NAMES = {"train": "training", "test": "held-out"}


@dataclass
class _Look:
    """What maps will look like.

    Attributes:
      radiosity: of a few lightings.
      noise: relative RMSE that the maps will have.
      pooled: what the bake makes of training maps, if anything.
      sent: light on the senders, as layers gather it, of most lightings.
    """

    operator: Any
    radiosity: Float32[np.ndarray, "senders columns"]
    noise: float
    pooled: Callable[[np.ndarray], np.ndarray] | None = None
    sent: Sent | None = None


def expect_indirect(job: Sampled, split: str, indices: list[int], seen: list[int]) -> tuple[Expected, list[Part], Sent | None]:
    """A stage of indirect light, the parts of it that a setting could shorten, and what layers are gathered from, if made.

    Args:
      job: the bake.
      split: "train" (with validation) or "test".
      indices: its lightings.
      seen: those whose direct light lies in the folder, in rising order.
    """
    integrator, parts = valid_integrator(job.config.transport.integrator, job.scene), list[Part]()
    kinds = ["indirect", "noise"] if split == "test" else ["indirect"]
    seconds, rays, look = 0.0, 0, None
    if job.bounces:
        by = {"paths": _by_paths, "reference": _by_reference}.get(integrator, _by_operator)
        seconds, rays, look = by(job, split, indices, seen, parts)
    storing, size = _stored(job, kinds, indices, look)
    side = job.config.atlas.resolution
    if side >= 16:  # half of it must be a resolution too
        parts.append(Part(f"files of {_NAMES[split]} maps", storing, f"atlas.resolution = {side // 2}", storing / 4))
    sent = look.sent if look else None
    return Expected(f"indirect {split}", seconds + storing, rays, len(kinds) * len(indices), size), parts, sent


def _by_operator(job: Sampled, split: str, indices: list[int], seen: list[int], parts: list[Part]) -> tuple[float, int, _Look]:
    """Averages, bounces and chooses as the bake does, with stand-ins for lightings whose direct light is not known."""
    from ddprt.transport.effort import choose_rays
    from ddprt.transport.operator import Operator

    config, seed, test = job.config.transport, job.config.seed, split == "test"
    halves, count, wide = 1 + test, len(indices), min(len(indices), WIDE)
    begun, before = time.perf_counter(), job.tracer.rays
    operator = Operator.of(job.tracer, job.atlas, config.sender_resolution)
    if any(filled(job.scene)):
        operator = replace(operator, inside=import_module("ddprt.transport.subsurface").Inside.of(operator, job.scene))
    covered = job.atlas.slot >= 0
    making = time.perf_counter() - begun

    def averaged(index: int) -> np.ndarray:
        return operator.averaged(read_map(job.folder / map_name("direct", index))[covered])

    averaging, columns = job.each(averaged, seen, count)
    columns += job.tracer.map(averaged, seen[len(columns) :])
    chosen = [indices[place] for place in np.linspace(0, count - 1, wide).astype(int)]
    stand_ins = np.abs(np.subtract.outer(chosen, seen)).argmin(1)
    direct = np.concatenate([columns[place] for place in stand_ins], 1)
    lightings = [job.lightings[seen[place]] for place in stand_ins]

    def costs(size: int) -> tuple[float, int, float, Any, Any, Any]:
        """Bounces and a choice of rays for so many lightings."""
        begun, before = time.perf_counter(), job.tracer.rays
        own = np.ascontiguousarray(direct[:, : 3 * size])
        bounced = operator.bounce(own, seed=seed, stream=f"{split} 0", bounces=job.bounces)
        bouncing, traced = time.perf_counter() - begun, job.tracer.rays - before
        near = operator.near(lightings[:size], own, bounces=job.bounces)
        begun = time.perf_counter()
        choice = choose_rays(operator, bounced.radiosity, config, near=near, held_out=test, seed=seed, stream=f"{split} 0")
        return bouncing, traced, time.perf_counter() - begun, choice, bounced, near

    first_rays = job.tracer.rays - before
    bouncing, traced, choosing, choice, bounced, near = costs(wide)
    rays = job.tracer.rays - before - first_rays + (halves - 1) * traced + choice.traced
    gathering = choice.seconds
    if count > wide:
        half, _, _, fewer, *_ = costs(wide // 2)
        bouncing = on_a_line((wide // 2, half), (wide, bouncing), count)
        gathering = on_a_line((wide // 2, fewer.seconds), (wide, gathering), count)
    walking = 0.0
    if operator.inside:
        walking, more = _walking(job, operator.inside, bounced.arrived, test, count / wide)
        rays += more
    again = 0.0
    if test:
        again, more = direct_again(job, seen, count, operator.averaged)
        rays += more
    given = config.test_samples if test else config.samples
    noise = float(choice.facts["noise_expected"])
    if given == "auto" and noise > 1.5 * config.target_noise:
        job.progress.warn(f"transport.target_noise: got {config.target_noise:g}, but about {noise:.2g} will be left")
    parts.append(_fewer_rays(job, split, gathering, choice.power, float(choice.facts["samples"])))
    column = 12 * operator.senders.count * count
    maps = 12 * halves * count * job.atlas.count
    job.holds(maps, column * (2 + 4 * test), (count - wide) * column / count * 2)
    writing = scratched(job.folder, maps, SCRATCHED, job.tracer.threads)
    few = np.linspace(0, wide - 1, min(wide, _LOOKED_AT)).astype(int)
    light = bounced.radiosity.reshape(operator.senders.count, -1, 3)[:, few].reshape(operator.senders.count, -1)
    sent = Sent(operator, bounced, {"seed": seed, "stream": f"{split} 0", "near": near})
    look = _Look(operator, np.ascontiguousarray(light), noise, choice.footprints.pooled if choice.footprints else None, sent)
    return making + averaging + halves * bouncing + choosing + again + walking + gathering + writing, int(rays), look


def _walking(job: Sampled, inside: Any, arrived: np.ndarray, test: bool, larger: float) -> tuple[float, float]:
    """Seconds and rays of walks through bodies: by a few from some texels; `larger`: all lightings over those at hand."""
    config, halves, address = job.config.transport, 1 + test, {"seed": job.config.seed, "stream": "walking"}
    begun, before = time.perf_counter(), job.tracer.rays
    walks = config.test_samples if test else config.samples
    if walks == "auto":
        walks = halves * inside.choose(arrived, config.target_noise * halves**0.5, **address)[0]
    choosing, some = time.perf_counter() - begun, inside.texels[:: max(1, len(inside.texels) // _WALKED)]
    found = []
    for light in (arrived[:, :3], arrived):
        start, traced = time.perf_counter(), job.tracer.rays
        for _ in inside.leave(np.ascontiguousarray(light), _STEPS, texels=some, **address):
            pass
        found.append((time.perf_counter() - start, job.tracer.rays - traced))
    (one, _), (all_of_them, each) = found
    share = walks * len(inside.texels) / (_STEPS * max(len(some), 1))
    products = max(0.0, all_of_them - one) * larger * len(inside.texels) / max(len(some), 1)
    return choosing + one * share + products, job.tracer.rays - before + each * share


def _fewer_rays(job: Sampled, split: str, seconds: float, power: float, samples: float) -> Part:
    """What fewer gather rays would do; no fewer than 8 are chosen."""
    config, key = job.config.transport, "test_samples" if split == "test" else "samples"
    what = f"gather rays for {_NAMES[split]} maps"
    given = getattr(config, key)
    if given != "auto":
        return Part(what, seconds, f"transport.{key} = {max(given // 2, 2)}", seconds * max(given // 2, 2) / given)
    share = max(2 ** (-2 / power), min(1.0, 8 / samples))
    return Part(what, seconds, f"transport.target_noise = {2 * config.target_noise:g}", seconds * share)


def direct_again(
    job: Sampled, seen: list[int], count: int, used: Callable[[np.ndarray], np.ndarray] = lambda light: light
) -> tuple[float, float]:
    """Seconds and rays of the direct light that the second half of held-out maps has of its own; `used`: what comes of it."""
    seed, begun = job.config.seed, time.perf_counter()
    places = seeds.stream(seed, "texel positions", 1)
    texels = Texels.of(job.tracer, job.atlas, job.config.transport.direct_samples, places)
    spreading, before = time.perf_counter() - begun, job.tracer.rays

    def work(index: int) -> np.ndarray:
        return used(texels.irradiance(job.lightings[index], seeds.stream(seed, "direct", index, 1)))

    seconds, done = job.each(work, seen, count)
    return spreading + seconds, (job.tracer.rays - before) * count / len(done)


def _by_paths(job: Sampled, split: str, indices: list[int], seen: list[int], parts: list[Part]) -> tuple[float, int, _Look]:
    """Paths from a tile of texels for each thread, for few lightings and for more."""
    from ddprt.transport.gather import Receivers
    from ddprt.transport.paths import choose_samples, trace_paths

    config, atlas, stream = job.config.transport, job.atlas, f"{split} paths"
    halves, count = 1 + (split == "test"), len(indices)
    given = config.test_samples if split == "test" else config.samples
    address: dict[str, Any] = {"seed": job.config.seed, "bounces": job.bounces}
    address |= {"smooth": split != "test" and config.footprint > 0}
    sizes = [min(count, size) for size in _SHADED]
    shaded = [[job.lightings[indices[place]] for place in np.linspace(0, count - 1, size).astype(int)] for size in sizes]

    def line(work: Callable[[list[Lighting]], Any]) -> tuple[Number, Number, Any]:
        """Seconds and rays of all lightings, and what the larger number gave; the smaller goes first once to load."""
        found, results = [], []
        for lightings in (shaded[0], *shaded):
            begun, before = time.perf_counter(), job.tracer.rays
            results.append(work(lightings))
            found.append((time.perf_counter() - begun, job.tracer.rays - before))
        cold, *warm = found
        few, many = sizes
        seconds, rays = (on_a_line((few, low), (many, high), count) for low, high in zip(*warm, strict=True))
        return seconds + max(0.0, cold[0] - warm[0][0]), rays, results[-1]

    scene = job.tracer, job.scene, atlas
    choosing, rays, (samples, noise) = line(
        lambda lightings: choose_samples(*scene, lightings, target=config.target_noise, stream=stream, **address)
    )
    if given != "auto":
        choosing, rays, noise, samples = 0.0, 0.0, noise * (samples / given) ** 0.5, given
    each = max(1, samples // halves)
    tile = next(Receivers.texels(atlas, each, 0, "rate", np.arange(min(atlas.count, _SEEN))).tiles()).stop
    starts = np.linspace(0, max(atlas.count - tile, 0), job.tracer.threads).astype(int)
    texels = np.unique(np.concatenate([np.arange(start, min(start + tile, atlas.count)) for start in starts]))

    def traced(lightings: list[Lighting]) -> None:
        out = np.zeros((len(lightings), atlas.count, 3), np.float32)
        for _ in trace_paths(*scene, lightings, out, samples=each, stream="rate", texels=texels, **address):
            pass

    seconds, some, _ = line(traced)
    share = halves * atlas.count / len(texels)
    parts.append(_fewer_rays(job, split, share * seconds, 1.0, float(samples)))
    maps = 12 * halves * count * atlas.count
    job.holds(maps)
    return (
        choosing + share * seconds + scratched(job.folder, maps, SCRATCHED, job.tracer.threads),
        int(rays + share * some),
        _looked(job, seen, noise),
    )


def _by_reference(job: Sampled, split: str, indices: list[int], seen: list[int], parts: list[Part]) -> tuple[float, int, _Look]:
    """Paths from some texels, for a few lightings one after the other."""
    from ddprt.transport.paths import choose_samples
    from ddprt.transport.reference import on_texels, trace_reference

    config, atlas = job.config.transport, job.atlas
    halves = 1 + (split == "test")
    given = config.test_samples if split == "test" else config.samples
    samples = _REFERENCE if given == "auto" else max(1, given // halves)
    together = 2 * job.tracer.threads * max(1, (1 << 15) // samples)
    texels = np.linspace(0, atlas.count - 1, min(atlas.count, together)).astype(int)
    few = [job.lightings[indices[place]] for place in np.linspace(0, len(indices) - 1, 4).astype(int)]
    spent, before = [], job.tracer.rays
    for light in few:
        begun, start = time.perf_counter(), on_texels(job.tracer, atlas, texels)
        seed = job.config.seed
        trace_reference(job.tracer, job.scene, light, start, len(texels), samples, seed=seed, bounces=job.bounces)
        spent.append((float(len(texels)), time.perf_counter() - begun))
    whole = halves * len(indices) * atlas.count
    seconds, rays = extrapolated(spent, whole), (job.tracer.rays - before) * whole / (len(few) * len(texels))
    fewer = max(1, samples // 2)
    setting = f"transport.{'test_samples' if split == 'test' else 'samples'} = {max(fewer * halves, 1)}"
    parts.append(Part(f"paths for {_NAMES[split]} maps", seconds, setting, seconds * fewer / samples))
    pilot: dict[str, Any] = {"target": config.target_noise, "seed": job.config.seed, "stream": split, "bounces": job.bounces}
    chosen, noise = choose_samples(job.tracer, job.scene, atlas, few, **pilot)
    return seconds, int(rays), _looked(job, seen, noise * (chosen / samples / halves) ** 0.5)


def _looked(job: Sampled, seen: list[int], noise: float) -> _Look:
    """What unbiased maps will look like: as those of the operator."""
    from ddprt.transport.operator import Operator

    operator = Operator.of(job.tracer, job.atlas, job.config.transport.sender_resolution)
    light = [read_map(job.folder / map_name("direct", index))[job.atlas.slot >= 0] for index in seen[:_LOOKED_AT]]
    direct = np.concatenate([operator.averaged(values) for values in light], 1)
    return _Look(operator, operator.bounce(direct, seed=job.config.seed, stream="look", bounces=1).radiosity, noise)


def _stored(job: Sampled, kinds: list[str], indices: list[int], look: _Look | None) -> tuple[float, int]:
    """Seconds and bytes of the files of all lightings, from a few that are made of some blocks of rows, over and over."""
    atlas, pooled = job.atlas, look.pooled if look else None
    maps, rows = _contents(job, look)
    whole = np.resize(rows, atlas.resolution)
    images = [[atlas.image(values)[whole] for values in kind] for kind in maps]
    share = atlas.count / max((atlas.slot >= 0)[whole].sum(), 1)
    filtered = job.config.transport.denoise and len(kinds) == 1

    def work(index: int) -> None:
        for kind, (values, image) in zip(kinds, zip(maps, images, strict=True), strict=False):
            turn = index % len(values)
            made = np.maximum(pooled(values[turn]) if pooled else values[turn], 0)
            atlas.image(denoised(atlas, made) if filtered else made)
            write_map(job.folder / map_name(kind, index), image[turn])

    def names(index: int) -> list[str]:
        return [map_name(kind, index) for kind in kinds]

    seconds, done = job.each(work, indices[: 8 * job.tracer.threads], len(indices), names=names)
    done_names = [name for index in indices[: len(done)] for name in names(index)]
    return seconds, round(share * job.size(done_names) * len(indices) / len(done))


def _contents(
    job: Sampled, look: _Look | None
) -> tuple[Float32[np.ndarray, "kinds lightings texels 3"], Int[np.ndarray, " rows"]]:
    """Maps and half differences of a few lightings with the noise that is expected, and the rows that hold them."""
    atlas = job.atlas
    if look is None:
        return np.zeros((2, 1, atlas.count, 3), np.float32), np.arange(atlas.resolution)
    from ddprt.transport.footprint import find_footprints

    block = atlas.texel // (_BLOCK * atlas.resolution)
    full, numbers = np.unique(block, return_counts=True)
    chosen = full[np.unique(np.linspace(0, len(full) - 1, max(1, int(_SEEN / numbers.mean()))).astype(int))]
    here = np.isin(block, chosen)
    runs = np.zeros((2, look.radiosity.shape[1] // 3, atlas.count, 3), np.float32)
    for run, out in enumerate(runs):
        address: dict[str, Any] = {"seed": run, "stream": "look"}
        for _ in look.operator.gather(look.radiosity, out, np.where(here, _FEW, 0), **address):
            pass
    mean, noise = runs.mean(0), (runs[0] - runs[1]) / 2
    wide = find_footprints(atlas, np.full(atlas.count, 1e-3 / job.tracer.radius), 1.0)  # as good as a plain mean
    mean = np.stack([wide.pooled(values) for values in mean])
    noise = np.stack([look.pooled(values) for values in noise]) if look.pooled else noise
    spread, level = float(np.sqrt((noise[:, here] ** 2).mean())), float(mean[:, here].mean())
    noise *= np.float32(look.noise * level / spread if spread > 0 else 0)
    rows = np.concatenate([np.arange(_BLOCK) + _BLOCK * start for start in chosen])
    return np.stack([np.maximum(mean + noise, 0), noise]), rows[rows < atlas.resolution]
