"""Unbiased indirect light of all lightings at once: paths do not know which light is on, so all lightings share them.

Every path is traced once, to its end, and leaves a list of vertices: a place, a normal, the receiver it began at, and the
throughput, so that a light's irradiance E there adds throughput * E to the receiver. Lights come afterwards: each of them is
evaluated at all vertices, block by block, with one shadow ray each. That is the split that other materials keep: whatever
the light that leaves a vertex depends on, the walk records and the shading weighs.

Against `reference`, one lighting at a time: the rays of the paths are paid once; first directions and places are spread evenly;
what a path meets is always lit, since roulette only decides whether it goes on; and light that is too weak to matter is mostly
spared its shadow ray, by roulette again. No step of it is biased. What it cannot do is forget the paths: maps of one call share
their grain, as those of the operator do.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64, Int
from ddprt.lights import Lighting
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.fogginess import refuse_fog_beside
from ddprt.transport.gather import Receivers
from ddprt.transport.glossiness import glossy, glossy_surfaces
from ddprt.transport.hairiness import strands_of
from ddprt.transport.shading import lamps_of, shade
from ddprt.transport.translucency import refuse_filled
from ddprt.transport.walk import Meetings, albedo_of, starts, walked

_PROBED, _PILOT = 512, 32  # texels, and paths of each in two independent runs, that predict how many are needed
_LEAST, _MOST = 8, 8192  # paths per texel that "auto" may choose

Shading = Callable[[Meetings, np.random.Generator, Float64[np.ndarray, "lightings receivers 3"]], None]
"""Adds to receivers what vertices give them under every lighting; the random numbers are for it alone."""


def trace_paths(
    tracer: Tracer,
    scene: Scene,
    atlas: Atlas,
    lightings: Sequence[Lighting],
    out: Float32[np.ndarray, "lightings texels 3"],
    *,
    samples: int,
    seed: int,
    stream: str,
    bounces: int = -1,
    skip: int = 0,
    texels: Int[np.ndarray, " chosen"] | None = None,
    smooth: bool = False,
) -> Iterator[int]:
    """Mean indirect irradiance of texels for every lighting, tile by tile.

    Equal seeds and streams give equal bits, whatever the number of threads and whatever else is in the batch.

    Args:
      tracer, scene, atlas: the geometry, its albedo, and the receivers.
      lightings: world space.
      out: written in place, W/m²; may lie on disk.
      samples: paths per texel.
      seed, stream: address of the random numbers; another stream gives independent noise.
      bounces: -1 follows every path to its end by roulette; otherwise at most this many, at least 1.
      skip: tiles that `out` holds already.
      texels: the ones that are wanted; None for all.
      smooth: lamps are weighed by what strands do on average over their width: a fraction of the noise, for a bias that
        `ddprt.transport.far_fibre` tells of. Without hair it changes nothing.
    Yields:
      The number of texels of each finished tile, in order, the skipped ones included.
    """
    lamps = lamps_of(tracer, lightings)
    settings: dict[str, Any] = {"samples": samples, "seed": seed, "stream": stream, "bounces": bounces}
    chosen: dict[str, Any] = {"skip": skip, "texels": texels, "smooth": smooth}
    yield from follow(tracer, scene, atlas, partial(shade, tracer, lamps), out, **chosen, **settings)


def follow(
    tracer: Tracer,
    scene: Scene,
    atlas: Atlas,
    shading: Shading,
    out: Float32[np.ndarray, "lightings texels 3"],
    *,
    samples: int,
    seed: int,
    stream: str,
    bounces: int = -1,
    skip: int = 0,
    texels: Int[np.ndarray, " chosen"] | None = None,
    smooth: bool = False,
) -> Iterator[int]:
    """The same with light of any kind: `shading` tells what vertices are worth."""
    refuse_filled(scene, "unbiased paths")
    refuse_fog_beside(scene, any(glossy(scene)))
    air = import_module("ddprt.transport.fog").Air(tracer.medium) if tracer.medium else None
    receivers = Receivers.texels(atlas, samples, seed, f"{stream} paths", atlas.order if texels is None else texels)
    albedo, hair = albedo_of(scene), strands_of(tracer, scene, smooth)
    gloss = hair or glossy_surfaces(tracer, scene)

    def work(item: tuple[int, slice]) -> int:
        index, tile = item
        if index >= skip:
            address = *stream.encode(), samples, int(receivers.patch[tile.start])
            walk, chance = (seeds.stream(seed, name, *address) for name in ("path walk", "path lights"))
            sums = np.zeros((len(out), tile.stop - tile.start, 3))
            for start, triangle in starts(tracer, receivers, tile):
                begun = hair.begun(*start[:2], triangle) if hair else None
                for met in walked(tracer, albedo, start, walk, bounces, gloss, begun, air):
                    for part in met.blocks():
                        shading(part, chance, sums)
            with np.errstate(over="ignore"):  # what is not finite is refused where light is stored
                out[:, receivers.patch[tile]] = sums / samples
        return tile.stop - tile.start

    yield from tracer.map(work, enumerate(receivers.tiles()))


def choose_samples(
    tracer: Tracer,
    scene: Scene,
    atlas: Atlas,
    lightings: Sequence[Lighting],
    *,
    target: float,
    seed: int,
    stream: str,
    bounces: int = -1,
    smooth: bool = False,
) -> tuple[int, float]:
    """Paths per texel that a target for the noise takes, measured at a few texels, and the noise to expect.

    Args:
      tracer, scene, atlas, lightings, bounces, smooth: see `trace_paths`.
      target: RMSE of all maps over their mean; more than so many thousand paths are never chosen.
      seed, stream: address of the random numbers; independent of those of `trace_paths` with that stream.
    """
    tracing = partial(trace_paths, tracer, scene, atlas, lightings, smooth=smooth)
    return samples_for(tracing, atlas, len(lightings), target=target, seed=seed, stream=stream, bounces=bounces)


def samples_for(
    tracing: Callable[..., Iterator[int]],
    atlas: Atlas,
    lightings: int,
    *,
    target: float,
    seed: int,
    stream: str,
    bounces: int = -1,
) -> tuple[int, float]:
    """The same for paths of any kind: `tracing` is `follow` or the like, from `out` on."""
    odds = atlas.area / atlas.area.sum()
    drawn = seeds.stream(seed, "path probes", *stream.encode()).choice(atlas.count, _PROBED, p=odds)
    texels, times = np.unique(drawn, return_counts=True)
    runs = []
    for run in range(2):
        out = np.zeros((lightings, atlas.count, 3), np.float32)
        address = f"{stream} pilot {run}"
        settings: dict[str, Any] = {"samples": _PILOT, "seed": seed, "stream": address, "bounces": bounces, "texels": texels}
        for _ in tracing(out, **settings):
            pass
        runs.append(out[:, texels].astype(np.float64))
    values = 3 * lightings * _PROBED
    mean = float(((runs[0] + runs[1]) / 2).sum((0, 2)) @ times) / values
    if mean == 0:
        return _LEAST, 0.0
    single = _PILOT * float((((runs[0] - runs[1]) / mean) ** 2).sum((0, 2)) @ times) / values / 2
    samples = int(np.clip(8 * np.ceil(single / target**2 / 8), _LEAST, _MOST))
    return samples, float(np.sqrt(single / samples))
