"""Light of surfaces that glow beside surfaces that gloss: by paths, against the reference under lamps of the same triangles."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ddprt import warp
from ddprt.lights import Lighting, parse_lighting
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.library import build
from ddprt.scene.material import Emission, Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted, rectangle
from ddprt.sections import TransportConfig
from ddprt.transport import emission
from ddprt.transport.effects import force
from ddprt.transport.embree import Tracer
from ddprt.transport.gloss import Lobes
from ddprt.transport.glossiness import scattering
from ddprt.transport.reference import on_texels, trace_reference

RADIANCE = (3.0, 2.0, 1.0)
RUNS, SIDE = 8, 48


def room(roughness: float) -> Scene:
    """The Cornell box with blocks of gilt, and a gilt box that glows; it touches nothing, so that variances are finite."""
    scene = build("cornell")
    quads = box(np.array([0.2, 0.42, 0.2]), np.array([0.36, 0.48, 0.36]))
    first = len(scene.positions) + 4 * np.arange(6)[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(np.int32)
    cross = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
    normals = np.repeat(cross / np.linalg.norm(cross, axis=1, keepdims=True), 4, axis=0)
    material = np.concatenate([scene.material, np.full(12, len(scene.materials) + 1, np.int32)])
    material[8:28] = len(scene.materials)
    gilt = Material("gilt", (0.9, 0.65, 0.3), gloss=Gloss(roughness, 1.0))
    return replace(
        scene,
        positions=np.concatenate([scene.positions, quads.reshape(-1, 3)]),
        triangles=np.concatenate([scene.triangles, triangles]),
        normals=np.concatenate([scene.normals, normals]),
        material=material,
        materials=(*scene.materials, gilt, replace(gilt, name="lamp", emission=Emission(RADIANCE))),
    )


def as_lamp(scene: Scene) -> Lighting:
    """The triangles that glow as a lamp, which does not occlude: the surfaces themselves do."""
    corners = scene.corners[scene.material == len(scene.materials) - 1]
    return parse_lighting({"type": "mesh", "mesh": corners.tolist(), "position": [0, 0, 0], "radiance": RADIANCE})


def coarse(atlas: Atlas, light: np.ndarray) -> np.ndarray:
    """Irradiance of blocks of 6 x 6 texels, (blocks, rgb): where light goes shows, and not each texel's noise."""
    row, column = np.divmod(atlas.texel, atlas.resolution)
    block = np.unique(row // 6 * atlas.resolution + column // 6, return_inverse=True)[1]
    sums = np.stack([np.bincount(block, atlas.area * channel) for channel in light.astype(float).T], 1)
    return sums / np.bincount(block, atlas.area)[:, None]


def ours(scene: Scene, atlas: Atlas, runs: int = RUNS, **settings: Any) -> np.ndarray:
    tracer, config = Tracer.of(scene, 2), TransportConfig(test_samples=96)
    found = [emission.constant_light(scene, tracer, atlas, config, seed=seed, **settings) for seed in range(runs)]
    return np.array([coarse(atlas, one.irradiance) for one in found])


def scores(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Welch's t of every block, green."""
    difference = one.mean(0) - other.mean(0)
    return (difference / np.sqrt(one.var(0, ddof=1) / len(one) + other.var(0, ddof=1) / len(other)))[:, 1]


@pytest.mark.parametrize(("roughness", "bounces"), [(0.3, -1), pytest.param(0.6, 1, marks=pytest.mark.slow)])
def test_constant_light_beside_gloss_is_that_of_the_reference(
    roughness: float, bounces: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = room(roughness)
    atlas, tracer = build_atlas(scattering(scene), SIDE), Tracer.of(scene, 2)
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    theirs = []
    for seed in range(RUNS):
        one = trace_reference(tracer, scene, as_lamp(scene), start, atlas.count, 128, seed=seed, bounces=bounces)
        theirs.append(coarse(atlas, one.direct + one.indirect))
    truth = np.array(theirs)
    z = scores(ours(scene, atlas, bounces=bounces), truth)
    diffuse = scores(ours(force(scene, off=["gloss"]), build_atlas(scene, SIDE), bounces=bounces), truth)
    monkeypatch.setattr(emission, "glossy", lambda scene: ())
    black = scores(ours(scene, atlas, bounces=bounces), truth)
    print([f"{v.mean():+.2f} +- {v.std():.2f}, at most {np.abs(v).max():.1f}" for v in (z, diffuse, black)])
    assert np.abs(z).max() < 5  # t with 14 degrees of freedom at most, 63 times: 1 %
    assert abs(z.mean()) < 4 * 1.1 / np.sqrt(8)  # blocks that see the same share their noise; some 8 walls and sides do not
    for other in (diffuse, black):
        assert np.abs(other).max() > 5, "what this cannot tell apart it does not test"
    assert abs(black.mean()) > 1


@pytest.mark.parametrize(("roughness", "metallic"), [(0.15, 1.0), (0.6, 0.5)])
def test_a_lobe_sends_out_the_integral_over_what_glows(roughness: float, metallic: float) -> None:
    """One place under a panel 1 m away, by quadrature over it: both techniques matter, for a narrow lobe and a wide one."""
    panel = rectangle((-0.5, -0.5), (0.5, 0.5), 1.0, 1, facing=-1)
    scene = faceted("panel", panel[None], (Material("panel", (0.5,) * 3, emission=Emission(RADIANCE)),), np.array([0]))
    emitters, tracer, count = emission.Emitters.of(scene), Tracer.of(scene, 1), 1 << 15
    normals = np.tile(np.array([0, 1, 0], np.float32), (count, 1))
    towards = np.array([0.3, 0.9, 0.2]) / np.linalg.norm([0.3, 0.9, 0.2])
    frames = warp.frame(normals)
    outgoing = np.einsum("nij,j->ni", frames, towards).astype(np.float32)
    finish = np.tile(np.array([roughness, metallic, 0.04], np.float32), (count, 1))
    lobes = Lobes(frames, outgoing, np.full((count, 3), 0.8, np.float32), finish)
    origins = np.tile((np.zeros(3) - tracer.centre).astype(np.float32), (count, 1))
    found = emitters.irradiance(tracer, origins, normals, np.random.default_rng(0).random((count, 5), np.float32), lobes)
    x, z = (part.ravel() for part in np.meshgrid(*2 * [(np.arange(128) + 0.5) / 128 - 0.5]))
    away = np.stack([x, np.ones_like(x), z], 1)
    squared = (away**2).sum(1)
    directions = (away / np.sqrt(squared)[:, None]).astype(np.float32)
    some = lobes.part(slice(0, len(x)))
    worth = np.pi * some.reflected(directions).astype(float) * (squared**-1.5)[:, None] / len(x)
    expected = worth.sum(0) * RADIANCE
    error = found.std(0) / np.sqrt(count)
    assert (error < 0.01 * expected).all()
    assert (np.abs(found.mean(0) - expected) < 5 * error + 1e-3 * expected).all()  # cells are 1 / 128 of a metre
