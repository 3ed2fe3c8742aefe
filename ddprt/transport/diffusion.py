"""What walks through thick bodies need to know beforehand: how fast light fades there, and how far the surface is."""

import numpy as np

from ddprt.axes import Float, Float32
from ddprt.compiled import compiled

EXTRAPOLATED = 0.7104
"""Free paths by which diffusion's boundary lies outside: Milne's constant."""
_POINTS = 1 << 20  # spread at a time
_BAND = 4  # cells about the surface in which distances are exact


def decay_rate(albedo: float) -> float:
    """Diffusion length's inverse in free paths, of a medium that scatters evenly: the root of albedo atanh(k) / k = 1."""
    if albedo >= 1:
        return 0.0
    low, high = 0.0, 1 - 1e-15  # where it is 1 to rounding, the function is infinite
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if albedo * np.arctanh(middle) < middle else (low, middle)
    return low


def weight_of_jump(radius: float, extinction: float, albedo: float) -> float:
    """What is left of light that starts evenly in a medium of even scattering when it first comes so far, metres."""
    x = decay_rate(albedo) * (radius * extinction + EXTRAPOLATED)
    return float(x / np.sinh(x)) if x > 0 else 1.0


def depths(
    corners: Float32[np.ndarray, "triangles 3 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], cell: float
) -> tuple[Float32[np.ndarray, "x y z"], float]:
    """Squared distances from the centres of cubic cells to a surface, square metres, and the edge of the cells, metres.

    Exact within a few cells of it, lower bounds elsewhere. These come from points that are spread over the surface so that none
    of it is further from one than half an edge over the root of three; cells that hold one count as surface, wherever it is.
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
    squared = np.maximum(distance - slack, 0).astype(np.float32) ** 2
    exact = np.full(size, np.float32((_BAND * cell) ** 2))  # what lies outside of all boxes is at least so far
    _approach(corners.astype(np.float32), low.astype(np.float32), np.float32(cell), exact)
    return np.maximum(squared, exact), cell


@compiled
def _approach(corners: np.ndarray, low: np.ndarray, cell: np.float32, squared: np.ndarray) -> None:
    """Lowers squared distances of the cells about each triangle to that of the triangle."""
    half, band, none = np.float32(0.5), np.float32(_BAND) * cell, np.float32(0)
    least, most = np.empty(3, np.float32), np.empty(3, np.float32)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for t in range(len(corners)):
        for axis in range(3):
            least[axis] = min(corners[t, 0, axis], corners[t, 1, axis], corners[t, 2, axis])
            most[axis] = max(corners[t, 0, axis], corners[t, 1, axis], corners[t, 2, axis])
            first[axis] = max(0, int((least[axis] - band - low[axis]) / cell - half))
            last[axis] = min(squared.shape[axis] - 1, int((most[axis] + band - low[axis]) / cell + half))
        for i in range(first[0], last[0] + 1):
            x = low[0] + (i + half) * cell
            away = max(least[0] - x, x - most[0], none) ** 2
            for j in range(first[1], last[1] + 1):
                y = low[1] + (j + half) * cell
                further = away + max(least[1] - y, y - most[1], none) ** 2
                for k in range(first[2], last[2] + 1):
                    z = low[2] + (k + half) * cell
                    if further + max(least[2] - z, z - most[2], none) ** 2 < squared[i, j, k]:  # to the box about it
                        squared[i, j, k] = min(squared[i, j, k], _squared_distance(corners[t], x, y, z))


@compiled
def _squared_distance(corner: np.ndarray, x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    """From a point to a triangle: to its plane where the foot is inside, else to the nearest of its edges."""
    zero, one = np.float32(0), np.float32(1)
    best, inside = np.float32(np.inf), True
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    for a in range(3):
        b = (a + 1) % 3
        ex, ey, ez = corner[b, 0] - corner[a, 0], corner[b, 1] - corner[a, 1], corner[b, 2] - corner[a, 2]
        px, py, pz = x - corner[a, 0], y - corner[a, 1], z - corner[a, 2]
        inside = inside and (ny * ez - nz * ey) * px + (nz * ex - nx * ez) * py + (nx * ey - ny * ex) * pz >= zero
        length = ex * ex + ey * ey + ez * ez
        along = min(max((px * ex + py * ey + pz * ez) / length, zero), one) if length > zero else zero
        px, py, pz = px - along * ex, py - along * ey, pz - along * ez
        best = min(best, px * px + py * py + pz * pz)
    size = nx * nx + ny * ny + nz * nz
    if inside and size > zero:
        height = (x - corner[0, 0]) * nx + (y - corner[0, 1]) * ny + (z - corner[0, 2]) * nz
        best = min(best, height * height / size)
    return best
