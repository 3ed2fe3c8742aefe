"""Probes by paths: where fog fills the air, or where the lightmap is traced without the operator, too.

A path goes out from a probe in a direction drawn evenly from the sphere, and what it is worth to the probe is known when it has
ended: its light times the harmonics of that first direction. Nothing of it is biased. All lightings share the paths; light that
a probe sees of lamps or a sky themselves is direct, and not in it, but light that the fog around it scatters is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from ddprt import harmonics, seeds, warp
from ddprt.axes import Float32, Float64
from ddprt.lights import Lighting
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.probes import ORDER, pilots, rays_for
from ddprt.transport.shading import Lamp, lamps_of, shade
from ddprt.transport.walk import Air, Albedo, albedo_of, walked

CALL = 1 << 12  # paths at a time: each keeps its light of all lightings


@dataclass(frozen=True, eq=False)
class Walks:
    """What paths from probes need to know.

    Attributes:
      tracer, albedo, air: the scene; `air` is its fog, None where it is clear.
      lamps: of each lighting.
      bounces: how often they may meet surfaces and fog; -1 for as often as they live.
    """

    tracer: Tracer
    albedo: Albedo
    air: Air | None
    lamps: list[list[Lamp]]
    bounces: int

    @classmethod
    def of(cls, tracer: Tracer, scene: Scene, lightings: Sequence[Lighting], bounces: int) -> "Walks":
        """In a scene of diffuse surfaces; lightings in world space."""
        air = import_module("ddprt.transport.fog").Air(tracer.medium) if tracer.medium else None
        return cls(tracer, albedo_of(scene), air, lamps_of(tracer, lightings), bounces)


def gather(
    walks: Walks, position: Float64[np.ndarray, "places 3"], rays: int, *, seed: int, stream: str
) -> Iterator[Float32[np.ndarray, "lightings some harmonics 3"]]:
    """Harmonics of irradiance, W/m², of some probes after others.

    Args:
      walks: the scene under its lightings.
      position: in free air, metres, world space.
      rays: paths of each, a power of two.
      seed, stream: address of the random numbers.
    """
    tracer, step = walks.tracer, max(1, CALL // rays)
    share = harmonics.clamped_cosine(ORDER) * (4 * np.pi / rays / np.pi)  # what paths gather is pi times radiance

    def work(first: int) -> np.ndarray:
        local = (position[first : first + step] - tracer.centre).astype(np.float32)
        address = *stream.encode(), rays, first
        walk, chance = (seeds.stream(seed, name, *address) for name in ("probe walk", "probe lights"))
        directions = warp.sample_sphere(warp.sobol(rays * len(local), 2, seeds.number(seed, "probe pattern", *address)))
        light = np.zeros((len(walks.lamps), len(local), harmonics.count(ORDER), 3))
        for start in range(0, len(directions), CALL):
            out = directions[start : start + CALL]
            probe = np.arange(start, start + len(out)) // rays
            begun = np.ascontiguousarray(local[probe]), out, np.arange(len(out), dtype=np.int32)
            sums = np.zeros((len(walks.lamps), len(out), 3))
            for met in walked(tracer, walks.albedo, begun, walk, walks.bounces, air=walks.air):
                for part in met.blocks():
                    shade(tracer, walks.lamps, part, chance, sums)
            Y = harmonics.harmonics(out, ORDER) * share
            for own in np.unique(probe):
                light[:, own] += np.einsum("lrc,rk->lkc", sums[:, probe == own], Y[probe == own])
        return light.astype(np.float32)

    return tracer.map(work, range(0, len(position), step))


def choose_rays(
    walks: Walks, position: Float64[np.ndarray, "places 3"], target: float, *, halves: int, seed: int, stream: str
) -> tuple[int, float]:
    """Paths of each probe (of each half) that reach a noise, and the noise that they will leave.

    Args:
      walks, position, seed, stream: as for `gather`; its random numbers stay independent of these.
      target, halves: see `ddprt.transport.probes.choose_rays`.
    """
    some, chosen = pilots(len(position), len(walks.lamps))
    few = replace(walks, lamps=[walks.lamps[index] for index in chosen])

    def gathered(rays: int, stream: str) -> Iterator[np.ndarray]:
        return gather(few, position[some], rays, seed=seed, stream=stream)

    return rays_for(gathered, target, halves, stream)
