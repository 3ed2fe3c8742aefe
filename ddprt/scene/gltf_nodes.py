"""The nodes of a glTF file, each with its transform to the world."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from ddprt.axes import Float64
from ddprt.scene.accessors import Container


@runtime_checkable
class Pose(Protocol):
    """How the nodes of a file stand at a time; see `ddprt.scene.gltf_motion`."""

    def local(self, number: int) -> Float64[np.ndarray, "4 4"]:
        """Transform of a node to its parent."""
        ...

    def shaped(
        self, number: int, primitive: Any, positions: Float64[np.ndarray, "vertices 3"], world: Float64[np.ndarray, "4 4"]
    ) -> tuple[Float64[np.ndarray, "vertices 3"], Float64[np.ndarray, "4 4"]]:
        """A node's vertices, and what takes them to the world."""
        ...


def placed(file: Container, pose: Pose | None = None) -> list[tuple[int, Any, Float64[np.ndarray, "4 4"]]]:
    """Every node of the file's default scene: number, node and transform to the world, in the order of the hierarchy.

    Args:
      file: whose nodes.
      pose: None takes the transforms of the file.
    Raises:
      UserError: a node that is not there, or that hangs in the hierarchy twice.
    """
    nodes, scenes = file.json.nodes, file.json.scenes
    children = {child for node in nodes for child in node.children or []}
    roots = file.entry("scenes", file.json.scene or 0).nodes if scenes else [n for n in range(len(nodes)) if n not in children]
    found, seen, waiting = [], set(), [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        number, parent = waiting.pop()
        if number in seen:
            raise file.fault(f"got node {number} twice in the hierarchy, expected a tree; export it again")
        seen.add(number)
        node = file.entry("nodes", number)
        world = parent @ (transform(node) if pose is None else pose.local(number))
        found.append((number, node, world))
        waiting += [(child, world) for child in reversed(node.children or [])]
    return found


def transform(node: Any) -> Float64[np.ndarray, "4 4"]:
    """A node's matrix; glTF stores matrices by columns and applies scale, then rotation, then translation."""
    if node.matrix is not None:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    local = np.eye(4)
    local[:3, :3] = Rotation.from_quat(node.rotation or [0.0, 0.0, 0.0, 1.0]).as_matrix() * (node.scale or [1.0, 1.0, 1.0])
    local[:3, 3] = node.translation or [0.0, 0.0, 0.0]
    return local
