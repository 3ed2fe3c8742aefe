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

_FLAT = 1e-6  # of the bounding box's diagonal: a thinner box holds no air


def foggy(scene: Scene) -> bool:
    """Whether there is fog, and room for it in the bounding box."""
    return scene.fog is not None and float(np.ptp(scene.bounds, axis=0).min()) > 2 * _FLAT * scene.radius


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
