"""Light off a glossy metal, onto what is beside it and towards the eye, against Mitsuba 3: z-scores with both variances."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_mitsuba import GREEN, POINTS, SAMPLES, mi, mitsuba_irradiance, surface_points, translated, z_scores

import ddprt
from ddprt import seeds, warp
from ddprt.lights import parse_lighting
from ddprt.scene.library import build
from ddprt.scene.material import Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import force
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.gloss import Surfaces
from ddprt.transport.shading import lamps_of, shade
from ddprt.transport.walk import albedo_of, walked

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


def on_metal(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of the blocks, places on them by area, and directions above them by cosine."""
    odds = np.where(scene.material == len(scene.materials) - 1, scene.areas, 0)
    triangle = rng.choice(len(odds), POINTS, p=odds / odds.sum())
    weights = rng.dirichlet(np.ones(3), POINTS)
    towards = warp.to_world(warp.sample_cosine(rng.random((POINTS, 2))), warp.frame(scene.geometric_normals[triangle]))
    return triangle, weights, towards


def sent_out(scene: Scene, triangle: np.ndarray, weights: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indirect radiance of one channel that leaves places towards directions, and the variance of its mean.

    By whole paths: lightmaps, in which a layer of exitant light ends its rays, would add the blur of their texels.
    """
    tracer, lamp = Tracer.of(scene, 2), parse_lighting(LIGHT)
    surfaces, lamps, found = Surfaces.of(tracer, scene), lamps_of(tracer, [lamp]), []
    for point in range(len(triangle)):
        rng = seeds.stream(1, "mitsuba", point)
        face = np.full(SAMPLES, triangle[point], np.int32)
        u, v = (np.full(SAMPLES, weights[point, corner], np.float32) for corner in (1, 2))
        lobes = surfaces.lobes(face, u, v, np.tile(-towards[point].astype(np.float32), (SAMPLES, 1)))
        incoming, weight = lobes.scattered(rng.random((SAMPLES, 3), np.float32))
        origins, alive = lifted(tracer, tracer.on_triangle(face, u, v), tracer.normals[face]), weight[:, GREEN] > 0
        rays, sums = (origins[alive], incoming[alive], np.flatnonzero(alive).astype(np.int32)), np.zeros((1, SAMPLES, 3))
        for met in walked(tracer, albedo_of(scene), rays, rng, -1, surfaces):
            for part in met.blocks():
                shade(tracer, lamps, part, rng, sums)
        found.append(weight[:, GREEN] * sums[0, :, GREEN] / np.pi)
    return np.mean(found, 1), np.var(found, 1) / SAMPLES


def sent_out_by_mitsuba(
    scene: Any, positions: np.ndarray, towards: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The same: its reflection draws a direction, and its path integrator says what comes from there."""
    path, sampler = (
        mi.load_dict({"type": "path", "hide_emitters": True, "max_depth": -1}),
        mi.load_dict({"type": "independent"}),
    )
    sampler.seed(int(rng.integers(2**31)))
    context, found = mi.BSDFContext(), []
    for position, direction in zip(positions, towards, strict=True):
        eye = mi.RayDifferential3f((position + 1e-4 * direction).tolist(), (-direction).tolist())
        met = scene.ray_intersect(eye)
        bsdf = met.bsdf(eye)
        light = []
        for _ in range(SAMPLES):
            drawn, weight = bsdf.sample(context, met, sampler.next_1d(), sampler.next_2d())
            if weight[GREEN] > 0:
                away = mi.RayDifferential3f(met.spawn_ray(met.to_world(drawn.wo)))
                light.append(weight[GREEN] * path.sample(scene, sampler, away)[0][GREEN])
            else:
                light.append(0.0)
        found.append(light)
    return np.mean(found, 1), np.var(found, 1) / SAMPLES


def test_light_that_leaves_a_metal_agrees_with_mitsuba() -> None:
    """Radiance towards the eye at 256 places of the gilt blocks, before it is told by harmonics."""
    mi.set_variant("scalar_rgb")
    rng, scene = np.random.default_rng(1), room()
    triangle, weights, towards = on_metal(scene, rng)
    positions = np.einsum("nc,ncd->nd", weights, scene.corners[triangle])
    theirs = sent_out_by_mitsuba(in_mitsuba(scene), positions, towards, rng)
    ours = sent_out(scene, triangle, weights, towards)
    z = z_scores(np.array([ours[0], theirs[0], ours[1], theirs[1]]))
    print(
        f"{len(z)} places and directions, z {z.mean():+.3f} +- {z.std():.3f}, energy {ours[0].sum() / theirs[0].sum() - 1:+.4f}"
    )
    assert len(z) > 0.8 * POINTS  # nothing reaches the undersides
    # As above.
    assert abs(z.mean()) < 0.25
    assert abs(z.std() - 1) < 0.18
