"""Shapes that scenes in code are put together from. Fronts face the free space; metres."""

import numpy as np

from ddprt.axes import Bool, Float, Int
from ddprt.errors import UserError
from ddprt.scene.checks import checked, vertex_normals
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene

FINEST = 8
"""Subdivisions of an icosphere: 1.3 M triangles."""


def faceted(
    name: str,
    quads: Float[np.ndarray, "quads 4 3"],
    materials: tuple[Material, ...],
    material: Int[np.ndarray, " quads"] | None = None,
) -> Scene:
    """A scene of flat quads, counter-clockwise from the front, each cut from its first to its third corner.

    Quads share no vertices, so that each keeps its own normal.
    """
    positions = quads.reshape(-1, 3)
    triangles = (4 * np.arange(len(quads))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    index = np.zeros(len(quads), int) if material is None else material
    solid = np.linalg.norm(np.cross(*np.diff(positions[triangles], axis=1).swapaxes(0, 1)), axis=1) > 0
    # A quad of no area has no normal of its own; `checked` reports and removes it.
    normals = vertex_normals(positions, triangles) if solid.all() else None
    return checked(name, positions, triangles, normals=normals, material=np.repeat(index, 2), materials=materials)


def rectangle(
    low: tuple[float, float], high: tuple[float, float], at: float, axis: int, *, facing: int
) -> Float[np.ndarray, "4 3"]:
    """An axis-aligned rectangle in the plane where coordinate `axis` is `at`.

    Args:
      low: lowest of the two coordinates that follow `axis` cyclically (y, z for x; z, x for y; x, y for z).
      high: highest, likewise.
      at: position along `axis`.
      axis: 0, 1 or 2.
      facing: 1 or -1, the side of `axis` that the front faces.
    """
    (u0, v0), (u1, v1) = low, high
    corners = np.array([[at, u0, v0], [at, u1, v0], [at, u1, v1], [at, u0, v1]], dtype=np.float64)
    return np.roll(corners, axis, axis=1)[::facing]


def hollow(
    free: Bool[np.ndarray, "cells_x cells_y cells_z"],
    x: Float[np.ndarray, " planes_x"],
    y: Float[np.ndarray, " planes_y"],
    z: Float[np.ndarray, " planes_z"],
) -> Float[np.ndarray, "quads 4 3"]:
    """The closed surface of the free cells of a grid, seen from inside them.

    Corners always meet corners, so that no ray slips through a seam.

    Args:
      free: which cells are air; all around the grid is solid.
      x: planes of the grid, ascending, metres; one more than there are cells. `y` and `z` likewise.
    """
    planes, padded = (x, y, z), np.pad(free, 1)
    quads = []
    for axis in range(3):
        for side in (-1, 1):
            walls = free & ~np.roll(padded, -side, axis=axis)[1:-1, 1:-1, 1:-1]
            for cell in np.argwhere(walls):
                u, v = (axis + 1) % 3, (axis + 2) % 3
                low, high = (
                    (float(planes[u][cell[u]]), float(planes[v][cell[v]])),
                    (float(planes[u][cell[u] + 1]), float(planes[v][cell[v] + 1])),
                )
                quads.append(rectangle(low, high, float(planes[axis][cell[axis] + (side > 0)]), axis, facing=-side))
    return np.array(quads)


def box(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6 4 3"]:
    """A closed box seen from outside."""
    inside = hollow(np.ones((1, 1, 1), bool), *(np.array([low[axis], high[axis]]) for axis in range(3)))
    return np.ascontiguousarray(inside[:, ::-1])


def icosphere(subdivisions: int) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    """A unit sphere of 20 * 4^subdivisions triangles seen from outside, vertices shared.

    Raises:
      UserError: fewer than 0 or more than 8 subdivisions.
    """
    if not 0 <= subdivisions <= FINEST:
        raise UserError(f"subdivisions: got {subdivisions}, expected 0 to {FINEST}; each one makes four triangles of one")
    golden = (1 + 5**0.5) / 2
    edges = np.array([[a, b * golden, 0.0] for a in (-1, 1) for b in (-1, 1)])
    points = np.concatenate([np.roll(edges, axis, axis=1) for axis in range(3)])
    # The twenty faces are the triples of vertices that lie two apart from one another.
    near = np.isclose(np.linalg.norm(points[:, None] - points, axis=2), 2.0)
    a, b, c = np.nonzero(near[:, :, None] & near[:, None, :] & near[None])
    triangles = np.stack([a, b, c], axis=1)[(a < b) & (b < c)]
    inward = np.linalg.det(points[triangles]) < 0
    triangles[inward] = triangles[inward, ::-1]
    for _ in range(subdivisions):
        ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
        edge, middle = np.unique(ends, axis=0, return_inverse=True)
        ab, bc, ca = (middle.reshape(-1, 3) + len(points)).T
        a, b, c = triangles.T
        points = np.concatenate([points, points[edge].mean(axis=1)])
        triangles = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return points / np.linalg.norm(points, axis=1, keepdims=True), triangles
