"""Measurement points that ride on a mesh: each keeps its triangle and its place on it, whatever the vertices do."""

from dataclasses import dataclass

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
      albedo: linear.
      spacing: of the samples in the first pose, metres; see `Samples`.
    """

    triangle: Int[np.ndarray, " samples"]
    weights: Float64[np.ndarray, "samples 3"]
    albedo: Float64[np.ndarray, "samples 3"]
    spacing: float

    def at(self, corners: Float64[np.ndarray, "triangles 3 3"], depth: float = 0.0) -> Samples:
        """Where they are in a pose.

        Args:
          corners: of all triangles there, metres.
          depth: see `Samples`, metres.
        """
        own = corners[self.triangle]
        cross = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
        position = np.einsum("nc,ncd->nd", self.weights, own)
        return Samples(position, cross / np.linalg.norm(cross, axis=1)[:, None], self.albedo, self.spacing, depth)


def place_riders(scene: Scene, count: int, *, seed: int, atlas: Atlas) -> Riders:
    """Samples spread evenly over the first pose, as `place_samples` spreads those of a scene that stands still.

    Raises:
      UserError: next to nothing is in the open.
    """
    samples, triangle, weights = placed(scene, count, on="surface", seed=seed, atlas=atlas)
    return Riders(triangle, weights, samples.albedo, samples.spacing)
