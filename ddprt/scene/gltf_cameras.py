"""The first perspective camera of a glTF file, as the place to look from first; the others are named."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ddprt.axes import Float64
from ddprt.scene.accessors import Container
from ddprt.scene.mesh import Scene
from ddprt.scene.viewpoint import Viewpoint

_NEAREST = 0.05  # of the scene's radius, that a target is away at least


def seen_from(scene: Scene, file: Container, nodes: Sequence[tuple[int, Any, Float64[np.ndarray, "4 4"]]]) -> Scene:
    """The scene with the viewpoint of its first perspective camera, and notes on all there are.

    A camera looks along its node's -z, its y upright; what it looks at is as far away as the middle of the scene.

    Args:
      scene: checked.
      file: whose cameras.
      nodes: number, node and transform to the world of those that are placed.
    Raises:
      UserError: a camera that is not there, of no known type, or whose numbers are no view.
    """
    held = [(node.camera, world) for _, node, world in nodes if node.camera is not None]
    found, flat = list[tuple[str, Viewpoint]](), 0
    for number, world in held:
        camera = file.entry("cameras", number)
        if camera.type not in ("perspective", "orthographic"):
            raise file.fault(
                f'got camera {number} of type "{camera.type}", expected perspective or orthographic; export it again'
            )
        flat += camera.type == "orthographic"
        if camera.type == "perspective":
            found.append((camera.name or f"camera {number}", _viewpoint(scene, file, number, camera.perspective, world)))
    notes = [f'first view: camera "{found[0][0]}" of the file'] if found else []
    idle = [("orthographic cameras", flat), ("further cameras", max(len(found) - 1, 0))]
    idle.append(("cameras at no node", len(file.json.cameras or []) - len({number for number, _ in held})))
    if any(count for _, count in idle):
        notes.append("ignored in the file: " + ", ".join(f"{count} {what}" for what, count in idle if count))
    return replace(scene, viewpoint=found[0][1] if found else None, notes=(*scene.notes, *notes))


def _viewpoint(scene: Scene, file: Container, number: int, lens: Any, world: Float64[np.ndarray, "4 4"]) -> Viewpoint:
    angle = getattr(lens, "yfov", None)
    if not isinstance(angle, int | float) or not 0 < angle < math.pi:
        raise file.fault(f"got yfov {angle} of camera {number}, expected an angle between 0 and pi; export it again")
    aspect = getattr(lens, "aspectRatio", None)
    if aspect is not None and not 0 < aspect < math.inf:
        raise file.fault(f"got aspectRatio {aspect} of camera {number}, expected a ratio above 0; export it again")
    eye, up, back = world[:3, 3], world[:3, 1], world[:3, 2]
    forward = -back / max(float(np.linalg.norm(back)), 1e-300)
    distance = max(float((scene.centre - eye) @ forward), _NEAREST * scene.radius)
    record = {"eye": eye, "target": eye + distance * forward, "up": up, "fov_deg": math.degrees(angle), "aspect": aspect}
    return Viewpoint.of(record, f"{file.path.name}: camera {number}")
