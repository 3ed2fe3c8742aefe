"""Simulate only the effects a scene calls for.

An effect is a part of light transport that some scenes lack. The plan says for each: called for or not, why, and, where it
is left out, an upper bound of the light it could have added.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ddprt.catalogue import Catalogue
from ddprt.lights import LIGHTS, Lighting, parse_lighting
from ddprt.scene.mesh import Scene

_FLAT = 1e-6  # of the radius: how far a corner may stand before a triangle's plane and still be in it
_CHUNK = 1 << 22


@dataclass(frozen=True)
class Effect:
    """One line of a plan.

    Attributes:
      name: entry of `EFFECTS`.
      called: whether it is simulated.
      why: the material, light or shape that decides.
      bound: upper bound of the light left out, as a share of the largest direct irradiance; None where it is unbounded.
      forced: the user decided, not the scene.
    """

    name: str
    called: bool
    why: str
    bound: float | None = 0.0
    forced: bool = False


@dataclass(frozen=True)
class Plan:
    """What will be simulated.

    Attributes:
      effects: every entry of `EFFECTS`, in order.
      bounces: -1 follows light until nothing is left, 0 traces none.
    """

    effects: tuple[Effect, ...]
    bounces: int

    def called(self, name: str) -> bool:
        """Whether an effect is simulated."""
        return any(effect.called for effect in self.effects if effect.name == name)


def plan(scene: Scene, lightings: Sequence[Lighting], *, bounces: int = -1) -> Plan:
    """Decides what to simulate.

    Args:
      scene: its materials and shape.
      lightings: all that will be baked.
      bounces: -1 lets the scene decide; 0 and up is forced.
    """
    parsed = [parse_lighting(lighting, f"lighting {index}") for index, lighting in enumerate(lightings)]
    effects = tuple(decide(name, scene, parsed, bounces) for name, decide in EFFECTS.items())
    return Plan(effects, bounces if effects[0].called else 0)


def _diffuse_bounces(name: str, scene: Scene, lightings: Sequence[Lighting], bounces: int) -> Effect:
    brightest = max(scene.materials, key=lambda material: max(material.albedo))
    albedo = max(brightest.albedo)
    if albedo == 0:
        return Effect(name, False, "every material is black")
    if sees_nothing(scene):
        return Effect(name, False, "no surface faces another: the scene is convex seen from outside")
    if bounces >= 0:
        left = albedo ** (bounces + 1) / (1 - albedo) if albedo < 1 else None
        return Effect(name, bounces > 0, f"forced to {bounces} (largest albedo {albedo:.3g})", left, True)
    why = f'largest albedo {albedo:.3g} ("{brightest.name}"), and surfaces face each other'
    if albedo >= 1:
        return Effect(name, True, f"{why}; where they close it in, light never dies away: lower it", None)
    return Effect(name, True, why)


def _light_kind(kind: str) -> Callable[[str, Scene, Sequence[Lighting], int], Effect]:
    def decide(name: str, scene: Scene, lightings: Sequence[Lighting], bounces: int) -> Effect:
        users = [index for index, lighting in enumerate(lightings) if any(light.kind == kind for light in lighting)]
        why = f"{len(users)} of {len(lightings)} lightings, first {users[0]}" if users else "no lighting has one"
        return Effect(name, bool(users), why)

    return decide


EFFECTS: Catalogue[Callable[[str, Scene, Sequence[Lighting], int], Effect]] = Catalogue(
    "effect", {"diffuse bounces": _diffuse_bounces, **{f"{kind} lights": _light_kind(kind) for kind in LIGHTS}}
)


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
