"""The nodes of a glTF file, each with its transform to the world."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ddprt.axes import Float64
from ddprt.scene.accessors import Container


def placed(file: Container) -> list[tuple[Any, Float64[np.ndarray, "4 4"]]]:
    """Every node of the file's default scene with its transform to the world, in the order of the hierarchy.

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
        world = parent @ _transform(node)
        found.append((node, world))
        waiting += [(child, world) for child in reversed(node.children or [])]
    return found


def _transform(node: Any) -> Float64[np.ndarray, "4 4"]:
    """A node's matrix; glTF stores matrices by columns and applies scale, then rotation, then translation."""
    if node.matrix is not None:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    local = np.eye(4)
    local[:3, :3] = Rotation.from_quat(node.rotation or [0.0, 0.0, 0.0, 1.0]).as_matrix() * (node.scale or [1.0, 1.0, 1.0])
    local[:3, 3] = node.translation or [0.0, 0.0, 0.0]
    return local
