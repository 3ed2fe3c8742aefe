"""Direct light at the measurement points, exactly as an engine would shade them."""

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.lights import Lighting
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
) -> Float32[np.ndarray, "n 3"]:
    """Direct irradiance (W/m²) at world-space points.

    Args:
      tracer: the occluders.
      lighting: world space.
      positions: metres.
      normals: unit.
      seed, index: address of the random numbers that lights with size need.
    """
    lights = centred(tracer, lighting)
    samples = 1 if all(light.delta for light in lights) else AREA_SAMPLES
    place, facing = (positions - tracer.centre).astype(np.float32), normals.astype(np.float32)
    places = Places.of(tracer, np.repeat(place, samples, 0), np.repeat(facing, samples, 0), samples)
    return mean_irradiance(tracer, lights, places, seeds.stream(seed, "measure", index))
