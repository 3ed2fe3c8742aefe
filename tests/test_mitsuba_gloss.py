"""Indirect irradiance beside a glossy metal, against Mitsuba 3: z-scores with both variances counted."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_mitsuba import GREEN, POINTS, SAMPLES, mi, mitsuba_irradiance, surface_points, translated, z_scores

import ddprt
from ddprt.scene.library import build
from ddprt.scene.material import Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import force

pytestmark = pytest.mark.slow

LIGHT: dict[str, Any] = {"type": "point", "position": [0.28, 0.45, 0.2], "intensity": [1.0, 1.0, 1.0]}
"""Without size: Mitsuba lets the first ray through the back of a hidden lamp."""

ROUGHNESS = 0.45
"""Common ground is a metal: `principled` has Schlick's Fresnel and alpha = roughness² there, as we do. Its shadowing is the
product of both sides: at this roughness that takes another 0.2 % off a white metal's mean albedo, far below the noise."""


def room() -> Scene:
    """The Cornell box, all of its blocks of gilt: more than a quarter of what is seen glosses."""
    scene = build("cornell")
    blocks = np.arange(8, 28)
    material = scene.material.copy()
    material[blocks] = len(scene.materials)
    gilt = Material("gilt", (0.9, 0.65, 0.3), gloss=Gloss(ROUGHNESS, 1.0))
    return replace(scene, material=material, materials=(*scene.materials, gilt))


def in_mitsuba(scene: Scene) -> Any:
    """As `mitsuba_scene`, with metals."""
    parts: dict[str, Any] = {"type": "scene", "light": translated(LIGHT)}
    for index, material in enumerate(scene.materials):
        corners, colour = scene.corners[scene.material == index], {"type": "rgb", "value": list(material.albedo)}
        gloss = material.gloss
        surface = {"type": "diffuse", "reflectance": colour}
        if gloss:
            surface = {"type": "principled", "base_color": colour, "metallic": 1.0, "roughness": gloss.roughness}
        properties = mi.Properties()
        properties["face_normals"] = True
        properties["bsdf"] = mi.load_dict(surface)
        mesh = mi.Mesh(material.name, 3 * len(corners), len(corners), props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = corners.reshape(-1).astype(np.float32)
        parameters["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
        parameters.update()
        parts[f"mesh{index}"] = mesh
    return mi.load_dict(parts)


def test_light_off_a_metal_agrees_with_mitsuba() -> None:
    mi.set_variant("scalar_rgb")
    rng = np.random.default_rng(0)
    scene = room()
    positions, normals = surface_points(scene, rng)
    theirs = mitsuba_irradiance(in_mitsuba(scene), positions, normals, LIGHT, rng)

    def scores(ours: Scene) -> np.ndarray:
        found = ddprt.irradiance(ours, LIGHT, positions, normals, samples=SAMPLES, seed=1, return_variance=True)
        return z_scores(np.array([found[1][:, GREEN], theirs[1], found[3][:, GREEN], theirs[3]]))

    z, diffuse = scores(scene), scores(force(scene, off=["gloss"]))
    print(f"{len(z)} points, z {z.mean():+.3f} +- {z.std():.3f}; as if diffuse {diffuse.mean():+.3f} +- {diffuse.std():.3f}")
    assert len(z) > 0.9 * POINTS
    # 256 scores: the mean is known to 0.0625, the standard deviation to 0.044; four of these each.
    assert abs(z.mean()) < 0.25
    assert abs(z.std() - 1) < 0.18
    assert diffuse.std() > 2, "what this cannot tell apart it does not test"
