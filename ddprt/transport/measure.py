"""Direct light at the measurement points, exactly as an engine would shade them."""

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.lights import Lighting
from ddprt.transport.direct import centred, direct_irradiance
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
) -> Float32[np.ndarray, "n 3"]:
    """Direct irradiance (W/m²) at world-space points.

    Args:
      tracer: the occluders.
      lighting: world space.
      positions: metres.
      normals: unit.
      seed, index: address of the random numbers that lights with size need.
    """
    place, facing = (positions - tracer.centre).astype(np.float32), normals.astype(np.float32)
    lights = centred(tracer, lighting)
    count = 1 if all(light.delta for light in lights) else AREA_SAMPLES
    rng = seeds.stream(seed, "measure", index)
    total = np.zeros(place.shape)
    for _ in range(count):
        total += direct_irradiance(tracer, lights, place, facing, rng.random((len(lights), len(place), 2), np.float32))
    return (total / count).astype(np.float32)
