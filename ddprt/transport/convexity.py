"""Whether a scene is convex seen from outside, so that no surface lights another."""

import numpy as np

from ddprt.scene.mesh import Scene

_FLAT = 1e-6  # of the radius: how far a corner may stand before a triangle's plane and still be in it
_CHUNK = 1 << 22


def sees_nothing(scene: Scene) -> bool:
    """Whether no corner of the scene stands in front of any triangle's plane: then nothing can be gathered."""
    corners = np.unique(scene.corners.reshape(-1, 3), axis=0) - scene.centre
    height = np.einsum("nd,nd->n", scene.geometric_normals, scene.corners[:, 0] - scene.centre)
    step = max(1, _CHUNK // len(corners))
    for first in range(0, len(height), step):
        chunk = slice(first, first + step)
        if (corners @ scene.geometric_normals[chunk].T > height[chunk] + _FLAT * scene.radius).any():
            return False
    return True
