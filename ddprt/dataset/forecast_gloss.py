"""What layers of glossy texels will take: their choice of rays and some tiles of them, in what stands in for the maps."""

import time
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from ddprt.axes import Float32, Float64, Int
from ddprt.dataset.forecast_indirect import SCRATCHED, direct_again
from ddprt.dataset.gloss import RAYS_FOR_A_PATH, gloss_layers
from ddprt.dataset.layers import Layer, write_light, write_places
from ddprt.dataset.manifest import layer_name, map_name
from ddprt.dataset.sampled import WIDE, Expected, Sampled, on_a_line, scratched
from ddprt.dataset.store import read_map
from ddprt.lights import Lighting
from ddprt.scene.atlas import weights_at
from ddprt.transport.sources import Sent

_CHOICE = 7  # times as much as in float32 it holds of them: two runs and their difference in float64, one as it came


def expect_gloss(
    job: Sampled, split: str, indices: list[int], seen: list[int], _: Sent | None
) -> tuple[list[Expected], Expected]:
    """A stage for each order, and the files that tell where the texels are.

    Args:
      job: the bake.
      split: "train" (with validation) or "test".
      indices, seen: its lightings, and those whose direct light lies in the folder.
    """
    begun = time.perf_counter()
    places, halves, stages = _placed(job), 1 + (split == "test"), list[Expected]()
    once = Expected("places", 0.0)
    if places and split == "train":
        names = [layer_name(layer.name, "places") for layer, _ in places]
        once = Expected("places", time.perf_counter() - begun, 0, len(names), job.size(names))
    lit, reading, again = None, 0.0, (0.0, 0.0)
    for layer, exits in places:
        seconds, rays = 0.0, 0.0
        if job.bounces != 0 and exits.count:
            if lit is None:
                lit, reading = lit_by(job, indices, seen)
                again = direct_again(job, seen, len(indices)) if halves > 1 else again
            seconds, rays = _traced(job, lit, layer, exits, split, len(indices))
            seconds, rays = seconds + again[0] + (1, 2.5)[halves - 1] * reading, rays + again[1]  # maps: 2, or 3 and 2
        storing, size = job.layered(layer, indices, halves)
        name = f"gloss {split}, order {layer.order}"
        stages.append(Expected(name, seconds + storing, int(rays), halves * len(indices), size))
    return stages, once


def expect_gloss_constant(
    job: Sampled, emitters: Any, light: Float32[np.ndarray, "texels 3"]
) -> tuple[float, float, list[str]]:
    """Seconds, rays and files of what is to be seen of what glows.

    Args:
      job, emitters: the bake, and what glows.
      light: of it, on all texels, as it comes straight from there.
    """
    seconds, rays, names = 0.0, 0.0, list[str]()
    lit = None
    for layer, exits in _placed(job):
        if job.bounces != 0 and exits.count:
            lit = lit or _shown(job, [()], light[None], np.zeros(1, int), emitters)
            spent, traced = _traced(job, lit, layer, exits, "constant", 1)
            seconds, rays = seconds + spent, rays + traced
        begun, zero = time.perf_counter(), np.zeros((len(layer.position), layer.coefficients, 3), np.float32)
        write_light(job.folder, layer.name, "constant", zero, job.manifest)
        seconds += time.perf_counter() - begun
        names.append(layer_name(layer.name, "constant"))
    return seconds, rays, names


def _placed(job: Sampled) -> list[tuple[Layer, Any]]:
    """Layers, and their places as the simulation knows them; written as the bake does. None, and no import, without gloss."""
    found = list[tuple[Layer, Any]]()
    for entry in gloss_layers(job.config, job.scene):
        exits = import_module("ddprt.transport.exitant").Exits.of(job.scene, job.atlas, entry["order"])
        kind = {key: entry[key] for key in ("name", "quantity", "order")}
        layer = Layer(**kind, position=job.atlas.position[exits.texel], weight=exits.weight, texel=exits.texel)
        write_places(job.folder, layer, job.manifest)
        found.append((layer, exits))
    return found


def lit_by(job: Sampled, indices: list[int], seen: list[int]) -> tuple[Any, float]:
    """The scene with stand-ins for its maps, and the seconds that reading two maps of each lighting takes."""
    direct, reading = _read(job, seen, len(indices))
    chosen = [indices[place] for place in np.linspace(0, len(indices) - 1, min(len(indices), WIDE)).astype(int)]
    stand_ins = np.abs(np.subtract.outer(chosen, seen)).argmin(1)
    return _shown(job, [job.lightings[seen[place]] for place in stand_ins], direct, stand_ins), reading


def _read(job: Sampled, seen: list[int], count: int) -> tuple[Float32[np.ndarray, "sampled texels 3"], float]:
    """Direct light, and the seconds in which two maps of each of so many lightings become columns."""
    covered = job.atlas.slot >= 0
    direct = np.empty((len(seen), job.atlas.count, 3), np.float32)
    columns = np.empty((job.atlas.count, 3, count), np.float32)

    def work(place: int) -> None:
        path = job.folder / map_name("direct", seen[place])
        direct[place] = read_map(path)[covered]
        columns[:, :, place] = direct[place] + read_map(path)[covered]

    reading, done = job.each(work, range(len(seen)), count)
    list(job.tracer.map(work, range(len(done), len(seen))))
    return direct, reading


def _shown(
    job: Sampled,
    lightings: Sequence[Lighting],
    direct: Float32[np.ndarray, "sampled texels 3"],
    stand_ins: Int[np.ndarray, " lightings"],
    emitters: Any = None,
) -> Any:
    """What is to be seen: indirect light as the operator's senders have it, as if metals scattered evenly what they reflect.

    Direct light alone would do for the time that rays take, not for how many: it is darker, and differs more from place to
    place. Where nothing is scattered no light is told, and none is seen.
    """
    from ddprt.transport.operator import Operator
    from ddprt.transport.reflected import Lit

    atlas = replace(job.atlas, albedo=_reflected(job))
    operator = Operator.of(job.tracer, atlas, job.config.transport.sender_resolution)
    averaged = np.concatenate([operator.averaged(light) for light in direct], 1)
    bounces = job.bounces + (job.bounces > 0)  # one of them is counted as gathered
    radiosity = operator.bounce(averaged, seed=job.config.seed, stream="shown", bounces=bounces).radiosity
    albedo = np.tile(operator.senders.albedo.astype(np.float32), len(direct))
    indirect = np.divide(radiosity, albedo, out=averaged.copy(), where=albedo > 0) - averaged
    spread = indirect.reshape(len(indirect), len(direct), 3)[operator.senders.of_texel]
    irradiance = spread.transpose(0, 2, 1) + direct.transpose(1, 2, 0)
    return Lit.of(job.tracer, job.scene, job.atlas, lightings, irradiance[:, :, stand_ins], emitters)


def _reflected(job: Sampled) -> Float64[np.ndarray, "texels 3"]:
    """Albedo of texels, that of metals included: by the middle of each piece of a triangle."""
    atlas, triangle = job.atlas, job.atlas.piece_triangle
    middle = atlas.piece_corners.mean(1, dtype=np.float64)
    albedo = job.scene.albedo_at(triangle, weights_at(job.tracer.corners[triangle].astype(np.float64), middle))
    total = np.bincount(atlas.piece_texel, atlas.piece_area, atlas.count)
    sums = [np.bincount(atlas.piece_texel, atlas.piece_area * albedo[:, channel], atlas.count) for channel in range(3)]
    return np.stack(sums, 1) / np.maximum(total, np.finfo(float).tiny)[:, None]


def _traced(job: Sampled, lit: Any, layer: Layer, exits: Any, split: str, count: int) -> tuple[float, float]:
    """Seconds and rays of the light of an order: its choice of rays, some tiles as the bake has them, and their storing."""
    halves, wide, config = 1 + (split == "test"), len(lit.lamps), job.config.transport
    maps, entries = 12 * job.atlas.count, 12 * exits.count * layer.coefficients
    held = (halves * count - wide) * maps  # beside those that stand in
    given = config.samples if split == "train" else config.test_samples
    choosing, rays, samples = 0.0, 0.0, RAYS_FOR_A_PATH * given if isinstance(given, int) else 0
    if given == "auto":
        job.holds(
            held - (halves - 1) * count * maps,
            _CHOICE * 12 * min(exits.count, import_module("ddprt.transport.exitant").PROBED) * layer.coefficients * count,
        )
        choosing, rays, samples = _chosen(job, lit, layer, exits, split)
    each = max(1, samples // halves)
    tracing, traced = _tiles(job, lit, layer, exits, split, each)
    if count > wide:
        fewer = replace(lit, lamps=lit.lamps[: wide // 2], irradiance=np.ascontiguousarray(lit.irradiance[:, :, : wide // 2]))
        choice = _chosen(job, fewer, layer, exits, split)[:2] if given == "auto" else (0.0, 0.0)
        less = *choice, *_tiles(job, fewer, layer, exits, split, each)
        more = choosing, rays, tracing, traced
        choosing, rays, tracing, traced = (on_a_line((wide // 2, a), (wide, b), count) for a, b in zip(less, more, strict=True))
    writing = 0.0
    if split != "constant":
        job.holds(held, halves * count * entries)
        writing = scratched(job.folder, halves * count * entries, SCRATCHED, job.tracer.threads)
    return choosing + halves * tracing + writing, rays + halves * traced


def _chosen(job: Sampled, lit: Any, layer: Layer, exits: Any, split: str) -> tuple[float, float, int]:
    """Seconds and rays of a choice of rays, and what it chooses."""
    target, begun, before = job.config.transport.target_noise, time.perf_counter(), job.tracer.rays
    address: dict[str, Any] = {"seed": job.config.seed, "stream": f"{layer.name} {split}"}
    samples, noise = import_module("ddprt.transport.exitant").choose_samples(lit, exits, target=target, **address)
    if split != "constant" and noise > 1.5 * target:
        job.progress.warn(f"{layer.name}: transport.target_noise: got {target:g}, but about {noise:.2g} will be left")
    return time.perf_counter() - begun, float(job.tracer.rays - before), int(samples)


def _tiles(job: Sampled, lit: Any, layer: Layer, exits: Any, split: str, samples: int) -> tuple[float, float]:
    """Seconds and rays of all tiles of a half, from some."""
    trace, part = import_module("ddprt.transport.exitant").trace_exitant, "constant" if split == "constant" else f"{split}-0"
    address: dict[str, Any] = {"samples": samples, "seed": job.config.seed, "stream": f"{layer.name} {part}"}
    out = np.zeros((len(lit.lamps), exits.count * layer.coefficients, 3), np.float32)
    step = next(trace(lit, exits, out, skip=exits.count, **address))  # which leaves all tiles out

    def work(firsts: np.ndarray) -> None:
        # The last tile may be short, and a tile begins after as many places as one holds.
        chosen = np.concatenate([np.arange(first, min(first + step, exits.count)) for first in np.sort(firsts)])
        for _ in trace(lit, exits, out, chosen=chosen, **address):
            pass

    return job.rounds(work, np.arange(0, exits.count, step))
