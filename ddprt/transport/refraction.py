"""How light passes a smooth boundary between two media: Snell's law and Fresnel's reflectance, unpolarised."""

import numpy as np

from ddprt.axes import Float, Float32


def entered(
    outwards: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], index: float
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
    """Where light from outside goes on inside, and the share of it that enters.

    Args:
      outwards: unit, towards where it comes from.
      normals: unit, outwards.
      index: relative.
    """
    cosine = np.einsum("nd,nd->n", outwards, normals)
    if index == 1:
        return -outwards, np.ones(len(outwards), np.float32)
    inner = np.sqrt(1 - (1 - cosine**2) / index**2)
    inwards = (cosine[:, None] * normals - outwards) / np.float32(index) - inner[:, None] * normals
    return inwards.astype(np.float32), (1 - fresnel(cosine, inner, index)).astype(np.float32)


def fresnel(outer: Float[np.ndarray, " n"], inner: Float[np.ndarray, " n"], index: float) -> Float[np.ndarray, " n"]:
    """Reflectance of a smooth boundary, unpolarised, by the cosines on both sides."""
    across, along = (outer - index * inner) / (outer + index * inner), (index * outer - inner) / (index * outer + inner)
    return (across**2 + along**2) / 2


def mean_entering(index: float) -> float:
    """Share of light from everywhere that enters: the integral of the transmittance over the hemisphere."""
    squared = np.linspace(0, 1, 4097)[1:] - 1 / 8192  # of cosines: their density is even
    outer = np.sqrt(squared)
    return float(1 - fresnel(outer, np.sqrt(1 - (1 - squared) / index**2), index).mean()) if index > 1 else 1.0
