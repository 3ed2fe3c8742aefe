"""Light that reached a point without touching anything."""

import numpy as np

from ddprt.axes import Float32
from ddprt.lights import Lighting
from ddprt.transport.embree import Tracer, lifted


def direct_irradiance(
    tracer: Tracer,
    lighting: Lighting,
    positions: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    u: Float32[np.ndarray, "lights n 2"],
) -> Float32[np.ndarray, "n 3"]:
    """One sample of E from every light, shadows included.

    Args:
      tracer: the occluders.
      lighting: lights in the tracer's centred frame (see `centred`).
      positions: on the surface, centred frame, metres.
      normals: unit, geometric.
      u: uniform numbers per light and point; lights without size ignore them.
    Returns:
      Irradiance in W/m². Its mean over `u` is exact; infinities and NaN cannot occur.
    """
    total = np.zeros_like(positions)
    origins = lifted(tracer, positions, normals)
    for light, numbers in zip(lighting, u, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused where light is stored
            sample = light.illuminate(origins, numbers)
        cosine = np.einsum("nd,nd->n", sample.direction, normals)
        facing = np.flatnonzero((cosine > 0) & sample.irradiance.any(1))
        if len(facing) == 0:
            continue
        seen = tracer.unoccluded(origins[facing], sample.direction[facing], sample.distance[facing])
        lit = facing[seen]
        total[lit] += cosine[lit, None] * sample.irradiance[lit]
    return total


def centred(tracer: Tracer, lighting: Lighting) -> Lighting:
    """The lighting in the tracer's frame."""
    return tuple(light.translated(-tracer.centre) for light in lighting)
