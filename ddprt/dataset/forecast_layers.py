"""What layers beside the lightmap will take, and the light of what glows: each on a share of the work."""

import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from ddprt.dataset.forecast_gloss import expect_gloss, expect_gloss_constant, lit_by
from ddprt.dataset.forecast_indirect import direct_again
from ddprt.dataset.layers import write_light, write_places
from ddprt.dataset.manifest import layer_name, map_name
from ddprt.dataset.probes import NAME, name_shut, name_unlit, placed_probes, scatters, shown_glow
from ddprt.dataset.sampled import Expected, Sampled, on_a_line
from ddprt.dataset.store import CONSTANT, read_map, write_map
from ddprt.transport.effects import plan, probed
from ddprt.transport.glossiness import glossy, valid_integrator
from ddprt.transport.sources import Sent, Shown, Source, Walked

_TEXELS = 1 << 14  # that tell what samples of direct light cost, and how many are needed
_LOOKS, _LOOKED_AT = 64, 1 << 12  # rays that tell whether any light reaches a probe, and probes that are asked
_PLACES = 16, 64  # probes whose difference tells what a further one costs
_STRAIGHT = 1 << 22  # samples of all texels together that bounce in place of all
_SAMPLES = 64  # of each texel, at least: with fewer, their noise would ask for more gather rays


def expect_layers(
    job: Sampled, split: str, indices: list[int], seen: list[int], sent: Sent | None
) -> tuple[list[Expected], Expected]:
    """Stages of a split's layers, and what is made once, between stages, before the first of them.

    Args:
      job: the bake.
      split: "train" (with validation) or "test".
      indices, seen: its lightings, and those whose direct light lies in the folder.
      sent: the light of its lightings on the senders; None where nothing else asks for it.
    """
    found, once = [], [Expected("places", 0.0)]
    for expect in LAYERS.values():
        stages, place = expect(job, split, indices, seen, sent)
        found += stages
        once += [place]
    return found, Expected("places", sum(p.seconds for p in once), 0, sum(p.files for p in once), sum(p.bytes for p in once))


def _probes(
    job: Sampled, split: str, indices: list[int], seen: list[int], sent: Sent | None
) -> tuple[list[Expected], Expected]:
    """Probes: their choice of rays as the bake makes it, some of them gathered, and files."""
    nothing = Expected("places", 0.0)
    if not probed(job.config, job.scene):
        return [], nothing
    module, halves = import_module("ddprt.transport.probes"), 1 + (split == "test")
    begun = time.perf_counter()
    layer = placed_probes(module, job.config, job.scene, job.tracer, job.atlas)
    write_places(job.folder, layer, job.manifest)
    if split == "train":
        nothing = Expected("places", time.perf_counter() - begun, 0, 1, job.size([layer_name(NAME, "places")]))
        name_shut(layer, job.progress)
    seconds, rays, position = 0.0, 0.0, layer.position[layer.weight > 0]
    if job.config.transport.bounces != 0 and scatters(job.scene):
        source: Source
        making, again = 0.0, (0.0, 0.0)
        before, begun = job.tracer.rays, time.perf_counter()
        if any(glossy(job.scene)):
            lit, reading = lit_by(job, indices, seen)
            source, columns = Shown(lit, {"seed": job.config.seed, "stream": f"{split} 0"}), len(lit.lamps)
            again = direct_again(job, seen, len(indices)) if halves > 1 else again
            making = (1, 2.5)[halves - 1] * reading  # maps: 2, or 3 and 2
            before, begun = job.tracer.rays, time.perf_counter()
            step = import_module("ddprt.transport.lit_probes").CALL
        elif valid_integrator(job.config.transport.integrator, job.scene) != "operator":
            walked = job.tracer, job.scene, [job.lightings[index] for index in indices], job.bounces or 1
            source, columns = Walked.of(*walked, seed=job.config.seed, stream=f"{split} 0"), len(indices)
            step = import_module("ddprt.transport.path_probes").CALL
        else:
            source = sent or _sent(job, split, indices, seen)
            columns, step = source.bounced.radiosity.shape[1] // 3, module.CALL
        given, target = job.config.probes.rays, job.config.transport.target_noise
        each = source.choose_rays(position, target, halves)[0] if given == "auto" else module.power_of_two(given)
        seconds, rays = time.perf_counter() - begun + making + again[0], float(job.tracer.rays - before) + again[1]
        more, traced = job.rounds(lambda some: _gathered(source, some, each), position, max(1, step // each))
        if split == "train":
            some = np.flatnonzero(layer.weight > 0)
            some = some[np.unique(np.linspace(0, len(some) - 1, min(len(some), _LOOKED_AT)).astype(int))]
            light = np.concatenate(list(source.gather(layer.position[some], _LOOKS)), 1)
            unlit = np.zeros(len(layer.weight), bool)
            unlit[some[~light.any((0, 2, 3))]] = True
            name_unlit(layer, unlit, job.progress)
        share = halves * len(indices) / columns  # of lightings past those whose columns were made
        seconds, rays = seconds + share * more, rays + halves * traced
    storing, size = job.layered(layer, indices, halves)
    return [Expected(f"probes {split}", seconds + storing, int(rays), halves * len(indices), size)], nothing


LAYERS: dict[str, Callable[..., tuple[list[Expected], Expected]]] = {NAME: _probes, "gloss": expect_gloss}
"""What layers take: stages of a split, none where there is no such layer, and what is made once, before training's."""


def _sent(job: Sampled, split: str, indices: list[int], seen: list[int]) -> Sent:
    """Light of a body that sees nothing of itself, which bounces to probes alone."""
    from ddprt.transport.operator import Operator

    operator = Operator.of(job.tracer, job.atlas, job.config.transport.sender_resolution)
    covered = job.atlas.slot >= 0
    columns = [operator.averaged(read_map(job.folder / map_name("direct", index))[covered]) for index in seen]
    stand_ins = np.abs(np.subtract.outer(indices, seen)).argmin(1)
    direct = np.concatenate([columns[place] for place in stand_ins], 1)
    address: dict[str, Any] = {"seed": job.config.seed, "stream": f"{split} 0"}
    near = operator.near([job.lightings[seen[place]] for place in stand_ins], direct, bounces=1)
    return Sent(operator, operator.bounce(direct, bounces=1, **address), address | {"near": near})


def _gathered(source: Source, position: np.ndarray, rays: int) -> None:
    for _ in source.gather(position, rays):
        pass


def expect_constant(job: Sampled) -> list[Expected]:
    """The stage of what glows, on the lightmap and in layers; none where nothing is called for."""
    if not plan(job.scene, ()).called("emission"):
        return []
    from ddprt.transport import emission

    emitters = emission.Emitters.of(job.scene)
    light, seconds, rays = np.zeros((job.atlas.count, 3), np.float32), 0.0, 0.0
    if len(emitters.triangle):
        light, seconds, rays = _straight(job, emission, emitters)
        if job.bounces != 0:
            more = _constant_by_paths if any(glossy(job.scene)) else _constant_by_operator
            spent, traced = more(job, emission, emitters, light)
            seconds, rays = seconds + spent, rays + traced
    files = [CONSTANT]
    begun = time.perf_counter()
    write_map(job.folder / CONSTANT, job.atlas.image(light))
    job.manifest.add(CONSTANT)
    seconds += time.perf_counter() - begun
    if probed(job.config, job.scene):
        spent, traced = _constant_of_probes(job, emitters, light)
        seconds, rays = seconds + spent, rays + traced
        files.append(layer_name(NAME, "constant"))
    spent, traced, names = expect_gloss_constant(job, emitters, light)
    seconds, rays, files = seconds + spent, rays + traced, files + names
    return [Expected("emission", seconds, int(rays), len(files), job.size(files))]


def _straight(job: Sampled, emission: Any, emitters: Any) -> tuple[np.ndarray, float, float]:
    """Direct light on all texels, and the seconds and rays of both halves of it.

    Where that is little work it is the bake's first half: how many rays are chosen for what bounces depends on each sample,
    where some glowing things are all but touched. From 64 to 4096 samples the choice went up and down by 5 in the small room of
    the library's "neon".
    """
    config, seed, atlas = job.config.transport, job.config.seed, job.atlas
    few = np.unique(np.linspace(0, atlas.count - 1, min(atlas.count, _TEXELS)).astype(int))
    emission.straight(emitters, job.tracer, atlas, 1, seed, 0, few)  # loads and compiles
    before, begun = job.tracer.rays, time.perf_counter()
    halves = [emission.straight(emitters, job.tracer, atlas, emission.FEW, seed, half, few) for half in range(2)]
    share = atlas.count / len(few) / emission.FEW
    seconds, rays = share * (time.perf_counter() - begun), share * (job.tracer.rays - before)
    tried = 0
    if config.test_samples != "auto":
        samples = max(1, config.test_samples // 2)
    else:
        samples = max(emission.FEW, emission.wanted_samples(halves, atlas.area[few], config.target_noise))
        tried = emission.FEW if samples > emission.FEW else 0
    known = min(samples, max(_SAMPLES, _STRAIGHT // atlas.count))
    light = emission.straight(emitters, job.tracer, atlas, known, seed, 0)
    return light, (tried + samples) * seconds, (tried + samples) * rays


def _constant_by_operator(job: Sampled, emission: Any, emitters: Any, light: np.ndarray) -> tuple[float, float]:
    """What bounces: all of it but the gather, which is told by its choice of rays."""
    from dataclasses import replace

    from ddprt.transport.effort import choose_rays
    from ddprt.transport.operator import Operator

    before, begun = job.tracer.rays, time.perf_counter()
    operator = Operator.of(job.tracer, job.atlas, job.atlas.resolution)
    making = time.perf_counter() - begun
    begun = time.perf_counter()
    address: dict[str, Any] = {"seed": job.config.seed, "stream": "emission 0"}
    averaged = operator.averaged(light)
    radiosity = operator.bounce(averaged, **address, bounces=job.bounces).radiosity
    near = replace(operator.near([()], averaged, bounces=job.bounces), shine=emitters.shine)
    bouncing, traced = time.perf_counter() - begun, job.tracer.rays - before
    begun, before = time.perf_counter(), job.tracer.rays
    choice = choose_rays(operator, radiosity, job.config.transport, near=near, held_out=True, **address)
    choosing = time.perf_counter() - begun
    return making + 2 * bouncing + choosing + choice.seconds, float(2 * traced + job.tracer.rays - before + choice.traced)


def _constant_by_paths(job: Sampled, emission: Any, emitters: Any, light: np.ndarray) -> tuple[float, float]:
    """What bounces: the choice of samples, and some tiles of paths."""
    from functools import partial

    from ddprt.transport.gather import Receivers
    from ddprt.transport.paths import samples_for

    config, atlas, tracer = job.config.transport, job.atlas, job.tracer
    tracing, address = partial(emission.along_paths, emitters, tracer, atlas), {"seed": job.config.seed, "bounces": job.bounces}

    def timed(work: Callable[[], Any]) -> tuple[float, float, Any]:
        before, begun = tracer.rays, time.perf_counter()
        result = work()
        return time.perf_counter() - begun, float(tracer.rays - before), result

    seconds, rays, samples = 0.0, 0.0, config.test_samples
    if samples == "auto":
        pilot = partial(samples_for, tracing, atlas, 1, target=config.target_noise, stream="emission", **address)
        seconds, rays, (samples, _) = timed(pilot)
    each = max(1, samples // 2)
    tile = next(Receivers.texels(atlas, each, 0, "rate").tiles()).stop
    texels = np.linspace(0, atlas.count - 1, min(atlas.count, 2 * tile * tracer.threads)).astype(int)

    def some() -> None:
        out = np.zeros((1, atlas.count, 3), np.float32)
        for _ in tracing(out, samples=each, stream="rate", texels=np.unique(texels), **address):
            pass

    spent, traced, _ = timed(some)
    share = 2 * atlas.count / len(np.unique(texels))
    return seconds + share * spent, rays + share * traced


def _constant_of_probes(job: Sampled, emitters: Any, light: np.ndarray) -> tuple[float, float]:
    """What probes see of it: a few of them, and a few more."""
    glow = import_module("ddprt.transport.emission_probes")
    layer = placed_probes(import_module("ddprt.transport.probes"), job.config, job.scene, job.tracer, job.atlas)
    position, config, found = layer.position[layer.weight > 0], job.config, []
    for count in (_PLACES[0], *_PLACES):
        some = position[np.unique(np.linspace(0, len(position) - 1, min(count, len(position))).astype(int))]
        before, begun = job.tracer.rays, time.perf_counter()
        shown = shown_glow(job.tracer, job.scene, job.atlas, light, emitters, config.seed)
        address: dict[str, Any] = {"seed": config.seed, "bounces": job.bounces, "shown": shown}
        glow.probe_light(emitters, job.tracer, job.atlas, light, some, config.transport, config.probes.rays, **address)
        found.append((len(some), time.perf_counter() - begun, job.tracer.rays - before))
    (_, cold, _), few, many = found
    whole = [on_a_line((few[0], few[k]), (many[0], many[k]), len(position)) for k in (1, 2)]
    write_light(job.folder, NAME, "constant", np.zeros((len(layer.weight), layer.coefficients, 3), np.float32), job.manifest)
    return whole[0] + max(0.0, cold - few[1]), float(whole[1])
