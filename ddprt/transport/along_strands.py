"""Texels of one strand borrow light from each other: they lie millimetres apart and see nearly the same.

A texel takes the value there of a line that is fitted to the strand's texels, weighed by a normal distribution about it. What
changes evenly along a strand is kept, up to its ends; what bends is flattened. The more paths a texel has, the less it borrows,
by the power of a fifth at which squares of noise and of lost detail fall alike: with ever more paths maps are right.

It is a linear operation, the same for every lighting and strand, and for maps to learn from alone.
Reference: Fan and Gijbels, "Local Polynomial Modelling and Its Applications", 1996, 3.2.
"""

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.scene.tubes import TEXELS

_SPREAD, _PATHS = 24.0, 1024  # standard deviation in texels, for a share of 1 and so many paths


def borrowing(share: float, paths: int) -> Float64[np.ndarray, "texels texels"]:
    """Weights of a strand's texels (columns) for each of them; rows sum to 1.

    Args:
      share: `transport.footprint`; 0 borrows nothing.
      paths: of each texel.
    """
    deviation = _SPREAD * share * (_PATHS / paths) ** 0.2
    if deviation == 0:
        return np.eye(TEXELS)
    away = np.arange(TEXELS)[None, :] - np.arange(TEXELS)[:, None]
    weight = np.exp(-0.5 * (away / max(deviation, 0.1)) ** 2) + 1e-12 * (np.abs(away) == 1)  # two texels make a line
    mass, first, second = (np.sum(weight * away**power, 1, keepdims=True) for power in range(3))
    return weight * (second - first * away) / (mass * second - first**2)


def borrowed(
    light: Float32[np.ndarray, "texels 3"], strands: int, weights: Float64[np.ndarray, "own others"]
) -> Float32[np.ndarray, "texels 3"]:
    """A map whose last texels, strand after strand, borrow from each other."""
    first = len(light) - strands * TEXELS
    found = light.copy()
    found[first:] = np.einsum("ij,sjc->sic", weights.astype(np.float32), light[first:].reshape(-1, TEXELS, 3)).reshape(-1, 3)
    return found
