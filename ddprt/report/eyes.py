"""Whether the places that pictures are asked for from show anything: judged by the scene alone, before a bake begins."""

from collections.abc import Sequence

import numpy as np

from ddprt.errors import UserError
from ddprt.report.view import Camera, Rays, default_camera, triple
from ddprt.scene.checks import FARTHEST
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import glossy

Eye = tuple[float, float, float]

NEAREST = 1e-3
"""Of the scene's radius: how far an eye must be from what it looks at."""
_ROWS = 32  # of a picture that tells whether there is anything to be seen


def check_eyes(scene: Scene, eyes: Sequence[Eye], *, layers: bool) -> None:
    """Makes sure that each place can be looked from.

    Backs do not hide, so an eye may stand outside, behind a wall that turns its back; but not inside something solid.

    Args:
      scene: what is looked at.
      eyes: metres; `config.report.views`.
      layers: whether glossy texels have layers, the middle of which is what eyes look at then.
    Raises:
      UserError: a place too far away, inside a solid, at what is looked at, or from which nothing is seen.
    """
    if not eyes:
        return
    shiny = np.array(glossy(scene))[scene.material] if layers else np.zeros(len(scene.material), bool)
    corners = scene.corners[shiny].reshape(-1, 3)
    target = (corners.min(0) + corners.max(0)) / 2 if len(corners) else scene.centre
    tracer, (low, high) = Tracer.of(scene), scene.bounds
    for index, eye in enumerate(eyes):
        name, place = f"report.views[{index}]: got {list(eye)}", np.array(eye)
        if not (np.abs(place) < FARTHEST).all():
            raise UserError(f"{name}, expected less than {FARTHEST:g} m; move it nearer")
        if np.linalg.norm(target - place) < NEAREST * scene.radius:
            raise UserError(f"{name}, which is what all views look at; expected a place at a distance; move it")
        if ((place > low) & (place < high)).all() and tracer.clearance(place[None])[0] == 0:
            raise UserError(f"{name}, which is inside a solid or a wall, expected free air; move it out")
        camera = looking(default_camera(scene), place, target)
        if not (Rays.of(tracer, camera, _ROWS).hits.triangle >= 0).any():
            raise UserError(f"{name}, from where nothing of the scene is seen, expected fronts of surfaces; move it")


def looking(first: Camera, eye: np.ndarray, target: np.ndarray) -> Camera:
    """A camera like another that looks from one place at another, metres; upright but where it looks straight up or down."""
    away = target - eye
    upright = np.linalg.norm(np.cross(away, first.up)) > 1e-3 * np.linalg.norm(away)
    return Camera(triple(eye), triple(target), first.fov_deg, first.aspect, first.up if upright else (0.0, 0.0, -1.0))
