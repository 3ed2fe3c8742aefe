"""Measurement points that ride on a mesh: each keeps its triangle and its place on it, whatever the vertices do."""

from dataclasses import dataclass, replace

import numpy as np

from ddprt.axes import Float64, Int
from ddprt.sampling.points import Samples, placed
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene


@dataclass(frozen=True, eq=False)
class Riders:
    """Samples by their places on a mesh, in progressive order.

    Attributes:
      triangle: of each.
      weights: of its corners there, adding up to 1.
      rest: they in the first pose, whose points they stay with.
    """

    triangle: Int[np.ndarray, " samples"]
    weights: Float64[np.ndarray, "samples 3"]
    rest: Samples

    def at(self, corners: Float64[np.ndarray, "triangles 3 3"], depth: float = 0.0) -> Samples:
        """Where they are in a pose.

        Args:
          corners: of all triangles there, metres.
          depth: see `Samples`, metres.
        """
        position, normal = _carried(corners, self.triangle, self.weights)
        at_rest = np.array_equal(position, self.rest.position) and np.array_equal(normal, self.rest.normal)
        return replace(self.rest, position=position, normal=normal, depth=depth, rest=None if at_rest else self.rest)


def place_riders(scene: Scene, count: int, *, seed: int, atlas: Atlas) -> Riders:
    """Samples spread evenly over the first pose, as `place_samples` spreads those of a scene that stands still.

    Raises:
      UserError: next to nothing is in the open.
    """
    samples, triangle, weights = placed(scene, count, on="surface", seed=seed, atlas=atlas)
    position, normal = _carried(scene.corners, triangle, weights)
    return Riders(triangle, weights, replace(samples, position=position, normal=normal))


def _carried(
    corners: Float64[np.ndarray, "triangles 3 3"],
    triangle: Int[np.ndarray, " samples"],
    weights: Float64[np.ndarray, "samples 3"],
) -> tuple[Float64[np.ndarray, "samples 3"], Float64[np.ndarray, "samples 3"]]:
    """Places and normals on a mesh."""
    own = corners[triangle]
    cross = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
    return np.einsum("nc,ncd->nd", weights, own), cross / np.linalg.norm(cross, axis=1)[:, None]
