"""Motions in code: scenes of the library that move, as functions of time.

Each is a map of space that leaves the ground where it is, so that one line moves a whole scene. A second is the whole motion.
"""

from collections.abc import Callable

import numpy as np

from ddprt.axes import Float64
from ddprt.catalogue import Catalogue
from ddprt.scene.checks import checked, vertex_normals
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import rectangle

BENT = 2.6
"""Radians that the arm has turned by at its tip after a second."""
TWISTED = 2.0
"""Radians that the statue's head has turned by after a second."""


def bending(*, height: float = 1.0, radius: float = 0.16, ground: float = 1.6, rings: int = 24, around: int = 20) -> Scene:
    """An arm that stands on a floor of two colours, and bows down to one of them as it moves: the light between them changes.

    Args:
      height: of the arm, metres.
      radius: in its middle, metres.
      ground: edge of the floor, metres.
      rings: of facets along the arm, at least 2.
      around: facets of a ring, at least 3.
    """
    along = (np.arange(rings + 1) / rings)[1:-1]
    reach = radius * (1 - np.abs(2 * along - 1) ** 6) ** 0.5 * (1.15 - 0.3 * along)
    angle = 2 * np.pi * np.arange(around) / around
    rim = np.stack([np.cos(angle), np.zeros(around), np.sin(angle)], 1)
    rows = reach[:, None, None] * rim + (height * (0.02 + 0.98 * along))[:, None, None] * [0.0, 1.0, 0.0]
    ends = np.array([[0.0, 0.02 * height, 0.0], [0.0, height, 0.0]])
    body = np.round(np.concatenate([rows.reshape(-1, 3), ends]), 9)  # sines differ in their last bit from machine to machine
    low = (around * np.arange(rings - 2)[:, None] + np.arange(around)).ravel()
    after = (around * np.arange(rings - 2)[:, None] + (np.arange(around) + 1) % around).ravel()
    side = np.concatenate([np.stack([low, low + around, after], 1), np.stack([after, low + around, after + around], 1)])
    first, foot, tip = np.arange(around), len(body) - 2, len(body) - 1
    last = around * (rings - 2) + first
    caps = [np.stack([np.full(around, foot), first, np.roll(first, -1)], 1)]
    caps += [np.stack([last, np.full(around, tip), np.roll(last, -1)], 1)]
    half = ground / 2
    floor = [rectangle((-half, -half), (half, 0.0), 0.0, 1, facing=1), rectangle((-half, 0.0), (half, half), 0.0, 1, facing=1)]
    positions = np.concatenate([body, *floor])
    squares = len(body) + np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    faces = np.concatenate([side, *caps, squares])
    return checked(
        "bending",
        positions,
        faces,
        normals=vertex_normals(positions, faces),
        material=np.repeat([0, 1, 2], [len(faces) - 4, 2, 2]),
        materials=(
            Material("arm", (0.75, 0.75, 0.72)),
            Material("blue floor", (0.15, 0.3, 0.7)),
            Material("red floor", (0.75, 0.2, 0.12)),
        ),
    )


def bent(rest: Float64[np.ndarray, "vertices 3"], time: float) -> Float64[np.ndarray, "vertices 3"]:
    """Space bent towards +x: what stood upright lies on an arc of a circle, whose length stays."""
    height = rest[:, 1].max()
    turn = BENT * time * rest[:, 1] / height
    curvature = BENT * time / height
    if curvature == 0:
        return rest
    x, z = rest[:, 0], rest[:, 2]
    return np.stack([(1 - np.cos(turn)) / curvature + x * np.cos(turn), np.sin(turn) / curvature - x * np.sin(turn), z], 1)


def twisted(rest: Float64[np.ndarray, "vertices 3"], time: float) -> Float64[np.ndarray, "vertices 3"]:
    """Space twisted about the vertical, the more the higher."""
    angle = TWISTED * time * rest[:, 1] / rest[:, 1].max()
    x, y, z = rest.T
    return np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], 1)


MOTIONS: Catalogue[Callable[[np.ndarray, float], np.ndarray]] = Catalogue(
    "scene that moves", {"bending": bent, "statue": twisted, "statue-marble": twisted}
)
"""What moves the vertices of a scene of the library, given them at rest and seconds from 0 to 1."""
