"""What glossy surfaces send to the eye of lamps and skies: direct light, which no layer holds and an engine adds by itself.

Lamps are sampled by themselves, as everywhere in transport. Skies are looked for from both sides, or a smooth metal under a
smooth sky would be all grain: by their own samples and by those of the lobe, weighed by the sum of both densities.

Reference: Veach and Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995.
"""

from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.lights import EnvironmentLight, Lighting
from ddprt.report.lamps import into_picture, sky_radiance
from ddprt.transport.direct import centred
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.reference import reflected

_SAMPLES = 16  # of what is no point, for each ray of a picture


def mirrored(
    tracer: Tracer,
    lighting: Lighting,
    position: Float32[np.ndarray, "n 3"],
    normal: Float32[np.ndarray, "n 3"],
    lobes: Any,
) -> Float64[np.ndarray, "n 3"]:
    """Pi times the radiance that lobes (`ddprt.transport.gloss.Lobes`) send to the eye, W/m².

    Args:
      tracer: the occluders.
      lighting: world space.
      position: centred frame, metres.
      normal: unit, geometric.
      lobes: the surfaces there, seen from the eye.
    """
    lamps = centred(tracer, tuple(light for light in lighting if not isinstance(light, EnvironmentLight)))
    rng, total = seeds.stream(0, "picture"), np.zeros((len(position), 3))
    samples = 1 if all(light.delta for light in lamps) else _SAMPLES
    for _ in range(samples if lamps else 0):
        u = rng.random((len(lamps), len(position), 2), np.float32)
        total += reflected(tracer, lamps, position, normal, lobes, u) / samples
    origins = lifted(tracer, position, normal)
    for light in lighting:
        if isinstance(light, EnvironmentLight):
            for _ in range(_SAMPLES):
                total += np.pi * _sky(tracer, light, origins, normal, lobes, rng) / _SAMPLES
    return total


def _sky(
    tracer: Tracer,
    light: EnvironmentLight,
    origins: Float32[np.ndarray, "n 3"],
    normal: Float32[np.ndarray, "n 3"],
    lobes: Any,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "n 3"]:
    """Radiance that lobes send on of one direction from either side."""
    from ddprt.lights.sky import load_sky, pdf_bright
    from ddprt.transport import ggx

    sky, found = load_sky(light.image), np.zeros((len(origins), 3))
    drawn = light.illuminate(origins, rng.random((len(origins), 2), np.float32), None, normal).direction
    scattered, _ = lobes.scattered(rng.random((len(origins), 3), np.float32))
    for directions in (np.ascontiguousarray(drawn), np.ascontiguousarray(scattered)):
        cosine = np.einsum("nd,nd->n", normal, directions)
        seen = tracer.unoccluded(origins, directions, np.full(len(origins), np.inf, np.float32)) != 0
        lit = np.flatnonzero(seen & (cosine > 0))
        there, exact = directions[lit], directions[lit].astype(np.float64)
        local = np.einsum("nij,nj->ni", lobes.frames[lit], there)
        by_lobe = ggx.pdf(lobes.outgoing[lit], local, lobes.base[lit], lobes.gloss[lit])
        by_sky = sky.share * pdf_bright(sky, into_picture(light, exact)) + (1 - sky.share) * cosine[lit] / np.pi
        weight = 1 / np.maximum(by_sky + by_lobe, 1e-300)
        found[lit] += lobes.reflected(directions)[lit] * sky_radiance(light, exact) * weight[:, None]
    return found
