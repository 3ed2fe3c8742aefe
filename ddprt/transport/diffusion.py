"""What walks through thick bodies need to know beforehand: how fast light fades there, and how far the surface is."""

import numpy as np

from ddprt.axes import Float, Float32

_POINTS = 1 << 20  # spread at a time


def decay_rate(albedo: float) -> float:
    """Diffusion length's inverse in free paths, of a medium that scatters evenly: the root of albedo atanh(k) / k = 1."""
    if albedo >= 1:
        return 0.0
    low, high = 0.0, 1 - 1e-15  # where it is 1 to rounding, the function is infinite
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if albedo * np.arctanh(middle) < middle else (low, middle)
    return low


def depths(
    corners: Float32[np.ndarray, "triangles 3 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], cell: float
) -> tuple[Float32[np.ndarray, "x y z"], float]:
    """Lower bounds of the distance from the centres of cubic cells to a surface, and the edge of the cells, metres.

    Points are spread over the surface so that none of it is further from one than half an edge over the root of three; cells
    that hold one count as the surface, wherever in them it is.
    """
    from scipy.ndimage import distance_transform_edt

    size = np.ceil((high - low) / cell).astype(int) + 1
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    cuts, clear = np.maximum(np.ceil(2 * longest / cell), 1).astype(int), np.ones(size, bool)
    for number in np.unique(cuts):
        i, j = np.mgrid[: number + 1, : number + 1]
        weights = np.stack([i, j, number - i - j], -1)[i + j <= number] / number
        own, step = np.flatnonzero(cuts == number), max(1, _POINTS // len(weights))
        for first in range(0, len(own), step):
            spread = np.einsum("kc,tcd->tkd", weights, corners[own[first : first + step]]).reshape(-1, 3)
            clear[tuple(np.clip(((spread - low) / cell).astype(int), 0, size - 1).T)] = False
    distance = cell * distance_transform_edt(clear)
    slack = cell * (3**0.5 / 2 + 0.5 / 3**0.5)
    return np.maximum(distance - slack, 0).astype(np.float32), cell
