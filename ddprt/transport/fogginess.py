"""Whether a scene lies in fog, and what cannot be simulated beside it.

Judged from the scene alone: what simulates fog is `ddprt.transport.fog`, which is imported where there is some.
"""

from collections.abc import Callable

import numpy as np

from ddprt.errors import UserError
from ddprt.scene.mesh import Scene
from ddprt.transport.hairiness import hairy
from ddprt.transport.translucency import filled

BESIDE = ("gloss", "emission", "subsurface", "hair")
"""Effects that nothing simulates yet in a scene with fog."""

_MANY = 50.0  # meetings of a path with fog from wall to wall
_FLAT = 1e-6  # of the bounding box's diagonal: a thinner box holds no air


def foggy(scene: Scene) -> bool:
    """Whether there is fog, and room for it in the bounding box."""
    return scene.fog is not None and float(np.ptp(scene.bounds, axis=0).min()) > 2 * _FLAT * scene.radius


def long_in_fog(scene: Scene, bounces: int) -> str | None:
    """A line about fog that takes paths very long to get out of; None where it does not, or where there is none.

    Paths from wall to wall are as long as without fog, on average over all ways (Blanco and Fournier, "An invariance property
    of diffusive random walks", 2003), so they meet fog about as often as free paths fit into the scene, unless that swallows
    them or their bounces are counted.

    Args:
      scene: with fog or without.
      bounces: asked for; -1 follows light until nothing is left.
    """
    if scene.fog is None or not foggy(scene):
        return None
    across = 2 * scene.radius / min(scene.fog.mean_free_path)
    white = max(scene.fog.albedo)
    meetings = min(across, 1 / (1 - white) if white < 1 else np.inf, bounces if bounces >= 0 else np.inf)
    if meetings <= _MANY:
        return None
    return (
        f"fog: the scene is up to {across:.3g} free paths wide, and paths meet it up to {meetings:.2g} times between walls, "
        "which takes long (ddprt bake --dry-run tells the seconds); raise scene.fog.mean_free_path, lower its albedo, or "
        "set transport.bounces"
    )


def hazy(scene: Scene) -> bool:
    """Whether there is fog that scatters light."""
    return scene.fog is not None and any(scene.fog.albedo) and foggy(scene)


def refuse_beside_fog(called: Callable[[str], bool]) -> None:
    """Makes sure that a plan with fog has nothing that knows no fog.

    Args:
      called: whether an effect is simulated, by name.
    Raises:
      UserError: it has.
    """
    found = [name for name in BESIDE if called(name)] if called("fog") else []
    if found:
        raise UserError(
            f"effects: got fog beside {' and '.join(found)}, which is not simulated yet, expected one without the other; "
            f'set effects.off = ["{found[0]}"] or ["fog"]'
        )


def refuse_fog_beside(scene: Scene, gloss: bool) -> None:
    """The same of a scene without a plan, as far as paths meet what is beside fog; `gloss`: whether something glosses."""
    has = {"fog": foggy(scene), "gloss": gloss, "subsurface": any(filled(scene)), "hair": hairy(scene)}
    refuse_beside_fog(lambda name: has.get(name, False))
