"""Which materials' gloss is simulated, and how much light the lobes of the others would have added.

Judged from the materials alone: what simulates gloss is `ddprt.transport.gloss`, which is imported where there is some.
"""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from ddprt.errors import UserError
from ddprt.scene.material import Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.fogginess import foggy
from ddprt.transport.hairiness import hairy, refuse_hairy


def worth_gloss(material: Material) -> bool:
    """Whether a material is a metal, or its lobe brighter at its peak than a white wall, seen along the normal.

    That peak is f0 / (4 pi roughness^4) against 1 / pi: a roughness of 0.32 for the usual reflectance of 0.04.
    """
    gloss = material.gloss
    if gloss is None:
        return False
    roughness, metallic = _extremes(gloss)
    return metallic > 0 or gloss.dielectric > 4 * roughness**4


def glossy(scene: Scene) -> tuple[bool, ...]:
    """Which of a scene's materials are simulated as glossy: those that are worth it, or all where that is forced."""
    used, forced = set(np.unique(scene.material).tolist()), "gloss" in scene.forced
    chosen = (
        (index in used) and (worth_gloss(entry) or (forced and entry.gloss)) for index, entry in enumerate(scene.materials)
    )
    return tuple(map(bool, chosen))


def glossy_surfaces(tracer: Tracer, scene: Scene) -> Any:
    """The `ddprt.transport.gloss.Surfaces` of a scene; None, and nothing imported, where no material is simulated as glossy."""
    return import_module("ddprt.transport.gloss").Surfaces.of(tracer, scene) if any(glossy(scene)) else None


def scattering(scene: Scene) -> Scene:
    """The scene whose albedo is what its surfaces scatter in all directions; the same where none is simulated as glossy."""
    return import_module("ddprt.transport.gloss").scattering(scene) if any(glossy(scene)) else scene


def valid_integrator(asked: str, scene: Scene) -> str:
    """The cheapest integrator that is valid for a scene, where "auto" is asked for; else the one asked for.

    Raises:
      UserError: the operator, which knows diffuse surfaces and clear air, for a scene with gloss, hair or fog, or the reference
        for hair. Leaving these out is the user's to say, so that the plan tells of it.
    """
    users = [f'"{entry.name}"' for entry, chosen in zip(scene.materials, glossy(scene), strict=True) if chosen]
    if users and asked == "operator":
        raise UserError(
            f'transport.integrator: got "operator", which takes all surfaces as diffuse, but material {", ".join(users[:3])} '
            'glosses; expected "auto", "paths" or "reference", or effects.off = ["gloss"]'
        )
    if asked in ("operator", "reference"):
        refuse_hairy(scene, f'transport.integrator = "{asked}"', 'set transport.integrator = "auto"')
    if asked == "operator" and foggy(scene):
        raise UserError(
            'transport.integrator: got "operator", which sees through fog, for a scene with fog; expected "auto", "paths" or '
            '"reference", or effects.off = ["fog"]'
        )
    return ("paths" if users or hairy(scene) or foggy(scene) else "operator") if asked == "auto" else asked


GRAZING = (1.0, 0.85, 0.62, 0.43, 0.29, 0.2, 0.14, 0.1, 0.075, 0.06, 0.05)
"""Bounds of what facets of no reflectance at normal incidence send back from any direction, by roughness 0, 0.1, ... 1."""


def least_roughness(gloss: Gloss) -> float:
    """Of a material, texture included."""
    return _extremes(gloss)[0]


def _extremes(gloss: Gloss) -> tuple[float, float]:
    """Least roughness and largest metallic, textures included."""
    rough, metal = (1.0, 1.0) if gloss.texture is None else (gloss.texture[..., 0].min(), gloss.texture[..., 1].max())
    return gloss.roughness * float(rough), gloss.metallic * float(metal)


def lobe_left(scene: Scene, materials: Sequence[Material]) -> float | None:
    """Bound of the light that lobes of some materials would add, as a share of mean direct irradiance; None if unbounded.

    A lobe sends back at most a share e of what arrives, so light dies away by c + (1 - c) e instead of c, the largest albedo:
    the sums of both series differ by e / ((1 - c) (1 - e)).
    """
    shares = [0.0]
    for gloss in (material.gloss for material in materials if material.gloss):
        roughness, metallic = _extremes(gloss)
        f0 = 1.0 if metallic > 0 else gloss.dielectric
        shares.append(f0 + (1 - f0) * GRAZING[int(10 * roughness)])
    share, albedo = max(shares), max(material.brightest for material in scene.used_materials)
    return share / ((1 - albedo) * (1 - share)) if max(share, albedo) < 1 else None
