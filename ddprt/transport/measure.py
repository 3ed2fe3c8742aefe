"""Direct light at the measurement points, exactly as an engine would shade them.

A lamp nearer to a surface than the samples there are to each other shines on a spot that they miss or hit: what they measure
says little about the light that is there. So samples may be *sunk*: seen from a depth e behind the surface, a lamp at height
h shines as one at height h + e would, with the same flux on a wider spot. For a plane that is a Poisson kernel; it multiplies
wave number k by exp(-k e), and so what samples a distance d apart mistake for a constant, k = 2 pi / d: to 0.9 % at e = 0.75 d.
Twice that less the same at twice the depth has the response 1 - (1 - exp(-k e))²: light that varies slowly is measured as it
is, and what is mistaken, still 1.8 %, has but doubled. Shadows are those of the surface. Each lamp is kept at zero or more by
itself, so that light adds up.
"""

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.lights import Light, Lighting, PointLight
from ddprt.transport.direct import Places, centred, mean_irradiance
from ddprt.transport.embree import Tracer

AREA_SAMPLES = 64  # shadow rays per sample point towards a light with size


def measure(
    tracer: Tracer,
    lighting: Lighting,
    positions: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    *,
    seed: int,
    index: int = 0,
    depth: float = 0.0,
) -> Float32[np.ndarray, "n 3"]:
    """Direct irradiance (W/m²) at world-space points.

    Args:
      tracer: the occluders.
      lighting: world space.
      positions: metres.
      normals: unit.
      seed, index: address of the random numbers that lights with size need.
      depth: how far behind the surface light is evaluated, metres; 0 on it.
    """
    lights = centred(tracer, lighting)
    samples = 1 if all(light.delta for light in lights) else AREA_SAMPLES

    def at(depth: float) -> Places:
        place, facing = (positions - depth * normals - tracer.centre).astype(np.float32), normals.astype(np.float32)
        return Places.of(tracer, np.repeat(place, samples, 0), np.repeat(facing, samples, 0), samples)

    def light(of: Lighting, places: Places, shadows: bool) -> Float32[np.ndarray, "n 3"]:
        return mean_irradiance(tracer, of, places, seeds.stream(seed, "measure", index), shadows=shadows)

    surface = at(0.0)
    if depth == 0:
        return light(lights, surface, True)
    near, far = at(depth), at(2 * depth)
    total = np.zeros((len(positions), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # see `mean_irradiance`
        for lamp in lights:
            if lamp.anchor() is None and not lamp.delta:  # a sky is the same behind the surface, and its shadows have colours
                total += light((lamp,), surface, True)
                continue
            whole, seen = (light((_bare(lamp),), surface, shadows).max(1) for shadows in (False, True))
            visible = np.where(whole > seen, seen / np.where(whole > 0, whole, 1), seen > 0)
            sunk = 2 * light((lamp,), near, False) - light((lamp,), far, False)
            total += visible[:, None] * np.maximum(sunk, 0)
    return total


def _bare(lamp: Light) -> Light:
    """A lamp to ask for shadows: a spot's cone, which its sunk light leaves behind on the surface, casts none."""
    place = lamp.anchor()
    if not lamp.delta or place is None:
        return lamp
    x, y, z = place.tolist()
    return PointLight(position=(x, y, z), intensity=(1, 1, 1))
