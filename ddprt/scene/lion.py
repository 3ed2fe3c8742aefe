"""A standing lion on its plinth: one closed body with hollows, cut out of a smooth field of distances.

Parts are ellipsoids, rods, a ring and a slab. Where parts meet, the smaller of their distances is rounded off, so that there is
no edge and no part inside another. The surface is that of surface nets: one vertex in each cell of a grid that the surface
passes, in the middle of where it crosses the cell's edges (Gibson 1998, "Constrained Elastic Surface Nets").
"""

import numpy as np

from ddprt.axes import Float64, Int
from ddprt.scene.checks import checked, vertex_normals
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene

_ROUNDING = 0.035  # metres over which parts of a lion one metre long run into each other
_LOW, _HIGH = np.array([-0.36, -0.1, -0.68]), np.array([0.36, 1.06, 0.68])


def lion(*, length: float = 1.2, cells: int = 72) -> Scene:
    """A lion that looks along z. Its flanks shade its legs, its mane shades its shoulders, and it shades the plinth.

    Args:
      length: of the plinth, metres.
      cells: of the grid along it; at 36 and more no part falls apart.
    """
    step = (_HIGH - _LOW).max() / max(cells, 8)
    counts = np.ceil((_HIGH - _LOW) / step).astype(int) + 1
    axes = [low + step * np.arange(count) for low, count in zip(_LOW, counts, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    positions, triangles = _surface(_distance(grid), grid)
    # Rounded: roots and exponentials differ in their last bit from machine to machine.
    positions = np.round(positions * length / 1.2, 9)
    positions[:, 1] -= positions[:, 1].min()
    positions, triangles, normals = _shaded(positions, triangles)
    stone = positions[triangles][:, :, 1].mean(1) < 0.07 * length
    return checked(
        "lion",
        positions,
        triangles,
        normals=normals,
        material=stone.astype(int),
        materials=(Material("fur", (0.72, 0.55, 0.35)), Material("plinth", (0.62, 0.62, 0.6))),
    )


def _distance(at: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
    """Metres to the surface, negative inside; near it exact enough to tell sides."""
    parts = [
        _ball(at, (0.0, 0.60, -0.02), (0.15, 0.16, 0.36)),
        _ball(at, (0.0, 0.62, 0.24), (0.16, 0.19, 0.16)),
        _ball(at, (0.0, 0.82, 0.42), (0.115, 0.12, 0.13)),
        _ball(at, (0.0, 0.77, 0.53), (0.065, 0.055, 0.07)),
        _ring(at, (0.0, 0.78, 0.36), 0.17, 0.065),
        *[_ball(at, (side * 0.09, 0.94, 0.43), (0.035, 0.045, 0.03)) for side in (-1, 1)],
        *[_rod(at, (side * 0.10, 0.55, 0.27), (side * 0.12, 0.06, 0.30), 0.06) for side in (-1, 1)],
        *[_rod(at, (side * 0.11, 0.55, -0.28), (side * 0.13, 0.30, -0.36), 0.075) for side in (-1, 1)],
        *[_rod(at, (side * 0.13, 0.30, -0.36), (side * 0.13, 0.06, -0.29), 0.055) for side in (-1, 1)],
        *[_ball(at, (side * 0.125, 0.05, front), (0.07, 0.045, 0.1)) for side in (-1, 1) for front in (0.35, -0.24)],
        _rod(at, (0.0, 0.66, -0.36), (0.0, 0.62, -0.50), 0.035),
        _rod(at, (0.0, 0.62, -0.50), (0.08, 0.28, -0.53), 0.035),
        _ball(at, (0.08, 0.25, -0.53), (0.06, 0.08, 0.05)),
    ]
    slab = np.abs(at) - [0.26, 0.025, 0.56]
    rounded = np.linalg.norm(np.maximum(slab, 0), axis=-1) + np.minimum(slab.max(-1), 0) - 0.035
    return _joined([*parts, rounded])


def _ball(at: np.ndarray, middle: tuple[float, ...], radii: tuple[float, ...]) -> np.ndarray:
    """An ellipsoid: the length in units of the radii, brought back to metres by its slope."""
    relative = (at - middle) / np.array(radii)
    size = np.linalg.norm(relative, axis=-1)
    slope = np.linalg.norm(relative / np.array(radii), axis=-1)
    return np.where(slope > 0, size * (size - 1) / np.where(slope > 0, slope, 1), -min(radii))


def _rod(at: np.ndarray, start: tuple[float, ...], end: tuple[float, ...], radius: float) -> np.ndarray:
    """Everything within a radius of a line from a start to an end."""
    along, offset = np.subtract(end, start), at - np.array(start)
    share = np.clip(offset @ along / (along @ along), 0, 1)
    return np.linalg.norm(offset - share[..., None] * along, axis=-1) - radius


def _ring(at: np.ndarray, middle: tuple[float, ...], radius: float, thickness: float) -> np.ndarray:
    """A torus about the z axis."""
    offset = at - np.array(middle)
    return np.hypot(np.hypot(offset[..., 0], offset[..., 1]) - radius, offset[..., 2]) - thickness


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """The least of several distances without its kinks: at most `_ROUNDING` / 4 below it where two are equal."""
    whole = parts[0]
    for part in parts[1:]:
        overlap = np.maximum(_ROUNDING - np.abs(whole - part), 0) / _ROUNDING
        whole = np.minimum(whole, part) - overlap**2 * _ROUNDING / 4
    return whole


def _surface(
    distance: Float64[np.ndarray, "x y z"], grid: Float64[np.ndarray, "x y z 3"]
) -> tuple[Float64[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    """The surface where a field on a grid changes sign, seen from where it is positive."""
    inside = distance < 0
    sums, crossings = np.zeros((*(n - 1 for n in distance.shape), 3)), np.zeros(tuple(n - 1 for n in distance.shape))
    edges = []
    for axis in range(3):
        ahead, across, upward = np.roll(np.eye(3, dtype=int), -axis, 0)
        place = np.argwhere(np.diff(inside, axis=axis))
        here, there = tuple(place.T), tuple((place + ahead).T)
        share = distance[here] / (distance[here] - distance[there])
        point = grid[here] + share[:, None] * (grid[there] - grid[here])
        around = [place, place - across, place - across - upward, place - upward]  # the four cells about an edge, in turn
        for cell in around:
            np.add.at(sums, tuple(cell.T), point)
            np.add.at(crossings, tuple(cell.T), 1)
        edges.append((np.stack(around, 1), inside[here]))
    used = crossings > 0
    index = np.full(used.shape, -1)
    index[used] = np.arange(used.sum())
    quads = []
    for cells, outward in edges:
        quad = index[tuple(np.moveaxis(cells, -1, 0))]
        quads.append(np.where(outward[:, None], quad, quad[:, ::-1]))
    corners = np.concatenate(quads)
    return sums[used] / crossings[used][:, None], corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _shaded(positions: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, triangles and normals; where sheets touch along an edge, triangles that face elsewhere are flat."""
    normals = vertex_normals(positions, triangles)
    a, b, c = np.moveaxis(positions[triangles], 1, 0)
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    flat = (np.einsum("tcd,td->tc", normals[triangles], face) <= 0.5).any(1)
    own = len(positions) + np.arange(3 * np.count_nonzero(flat)).reshape(-1, 3)
    positions = np.concatenate([positions, positions[triangles[flat]].reshape(-1, 3)])
    triangles = triangles.copy()
    triangles[flat] = own
    return positions, triangles, np.concatenate([normals, np.repeat(face[flat], 3, axis=0)])
