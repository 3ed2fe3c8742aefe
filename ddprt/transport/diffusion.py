"""What walks through thick bodies need to know beforehand: how fast light fades there, and how far the surface is."""

import numpy as np

from ddprt.axes import Float, Float32


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

    Points are spread over the surface so that none of it is further from one than an edge over the root of three.
    """
    from scipy.spatial import cKDTree

    size = np.ceil((high - low) / cell).astype(int) + 1
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    cuts, spread = np.maximum(np.ceil(longest / cell), 1).astype(int), []
    for number in np.unique(cuts):
        i, j = np.mgrid[: number + 1, : number + 1]
        weights = np.stack([i, j, number - i - j], -1)[i + j <= number] / number
        spread.append(np.einsum("kc,tcd->tkd", weights, corners[cuts == number]).reshape(-1, 3))
    centres = np.stack(np.meshgrid(*(np.arange(count) + 0.5 for count in size), indexing="ij"), -1) * cell + low
    distance, _ = cKDTree(np.concatenate(spread)).query(centres.reshape(-1, 3), workers=-1)
    step = float((longest / cuts).max()) / 3**0.5
    return np.maximum(distance - step, 0).reshape(size).astype(np.float32), cell
