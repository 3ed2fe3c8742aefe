"""Probes where something glosses: their rays end in the lightmaps, or go on where they meet gloss.

The operator's senders take surfaces as diffuse, so here rays land on the scene as its lightmaps show it
(`ddprt.transport.reflected`). What a probe sees of lamps, a sky or what glows is direct light here, too, and not in it.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ddprt import harmonics, seeds, warp
from ddprt.axes import Float32, Float64
from ddprt.transport.probes import ORDER, pilots, rays_for
from ddprt.transport.reflected import Lit

CALL = 1 << 12  # rays of one call: sums of all lightings take much room


def gather(
    lit: Lit, position: Float64[np.ndarray, "places 3"], rays: int, *, seed: int, stream: str
) -> Iterator[Float32[np.ndarray, "lightings some harmonics 3"]]:
    """Harmonics of irradiance, W/m², of some probes after others.

    Args:
      lit: the scene with the light on its maps.
      position: in free air, metres, world space.
      rays: of each, a power of two.
      seed, stream: address of the random numbers.
    """
    tracer, step = lit.surfaces.tracer, max(1, CALL // rays)
    share = harmonics.clamped_cosine(ORDER)[:, None, None] * (4 * np.pi / rays)

    def work(first: int) -> np.ndarray:
        local = (position[first : first + step] - tracer.centre).astype(np.float32)
        address = *stream.encode(), rays, first
        walk, chance = (seeds.stream(seed, name, *address) for name in ("probe walk", "probe lights"))
        directions = warp.sample_sphere(warp.sobol(rays * len(local), 2, seeds.number(seed, "probe pattern", *address)))
        origins, probe = np.repeat(local, rays, 0), np.arange(len(directions)) // rays
        Y = np.repeat(harmonics.harmonics(directions, ORDER).astype(np.float32)[:, :, None], 3, 2)
        sums = np.zeros((len(local), Y.shape[1], 3, lit.irradiance.shape[2]))
        for start in range(0, len(directions), CALL):
            part = slice(start, start + CALL)
            alive = np.arange(len(probe[part]))
            for light in lit.arriving(origins[part], directions[part], alive, walk, chance, straight=False):
                light.add(Y[part], probe[part], sums)
        return np.moveaxis(sums * share, 3, 0).astype(np.float32)

    return tracer.map(work, range(0, len(position), step))


def choose_rays(
    lit: Lit, position: Float64[np.ndarray, "places 3"], target: float, *, halves: int, seed: int, stream: str
) -> tuple[int, float]:
    """Rays of each probe (of each half) that reach a noise, and the noise that they will leave.

    Args:
      lit, position, seed, stream: as for `gather`; its random numbers stay independent of these.
      target, halves: see `ddprt.transport.probes.choose_rays`.
    """
    some, chosen = pilots(len(position), len(lit.lamps))
    fewer = np.ascontiguousarray(lit.irradiance[:, :, chosen])
    few = replace(lit, lamps=[lit.lamps[index] for index in chosen], irradiance=fewer)

    def gathered(rays: int, stream: str) -> Iterator[np.ndarray]:
        return gather(few, position[some], rays, seed=seed, stream=stream)

    return rays_for(gathered, target, halves, stream)
