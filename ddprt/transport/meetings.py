"""How far walks fly until they meet something, and at what angle they go on: their samplers, with densities and inverses.

The samplers are the compiled ones of `ddprt.transport.random_walk`, one number at a time.
"""

import numpy as np

from ddprt.axes import Float, Float64
from ddprt.transport.random_walk import flown, scattered_at


def sample_flight(u: Float64[np.ndarray, " n"], extinction: float) -> Float64[np.ndarray, " n"]:
    """Lengths of flights in a medium, metres, as walks draw them; `extinction` in 1/m."""
    return np.array([flown(np.float32(one), np.float32(extinction)) for one in u], np.float64)


def pdf_flight(length: Float[np.ndarray, " n"], extinction: float) -> Float[np.ndarray, " n"]:
    """Per metre: Beer and Lambert's law."""
    return extinction * np.exp(-extinction * length)


def invert_flight(length: Float[np.ndarray, " n"], extinction: float) -> Float[np.ndarray, " n"]:
    """The uniform numbers that give these lengths."""
    return -np.expm1(-extinction * length)


def sample_henyey(u: Float64[np.ndarray, " n"], anisotropy: float) -> Float64[np.ndarray, " n"]:
    """Cosines of the angle of scattering, as walks draw them."""
    return np.array([scattered_at(np.float32(one), np.float32(anisotropy)) for one in u], np.float64)


def pdf_henyey(cosine: Float[np.ndarray, " n"], anisotropy: float) -> Float[np.ndarray, " n"]:
    """Per steradian. Reference: Henyey and Greenstein, "Diffuse Radiation in the Galaxy", 1941."""
    return (1 - anisotropy**2) / (4 * np.pi * (1 + anisotropy**2 - 2 * anisotropy * cosine) ** 1.5)


def invert_henyey(cosine: Float[np.ndarray, " n"], anisotropy: float) -> Float[np.ndarray, " n"]:
    """The uniform numbers that give these cosines."""
    g = anisotropy
    if abs(g) < 1e-3:
        return (1 + cosine) / 2
    return ((1 - g * g) / np.sqrt(1 + g * g - 2 * g * cosine) - 1 + g) / (2 * g)
