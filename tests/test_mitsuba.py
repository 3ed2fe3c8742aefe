"""`ddprt.irradiance` against Mitsuba 3, a renderer that shares nothing with it: z-scores with both variances counted."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ddprt
from ddprt.lights.panorama import read_panorama
from ddprt.scene.checks import checked
from ddprt.scene.exr import write_exr
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted

mi = pytest.importorskip("mitsuba", reason='needs the extra "reference"')
pytestmark = pytest.mark.slow

POINTS = 256
SAMPLES = 4096
"""Paths per point on both sides. Path sums are skewed, and a low mean comes with a low variance; equal numbers on both sides
let that cancel in z."""

GREEN = 1
"""One channel per point: the three share their paths, and would count the same deviation three times."""

# Mitsuba's spots fall off in another way than glTF's, so these have no falloff: a rim 0.001 degrees wide.
LIGHTS: dict[str, dict[str, dict[str, Any]]] = {
    "cornell": {
        "point": {"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1.0, 0.8, 0.6]},
        "spot": {
            "type": "spot", "position": [0.45, 0.5, 0.1], "direction": [-0.5, -1.0, 0.6], "intensity": [2.0, 2.0, 3.0],
            "inner_deg": 34.999, "outer_deg": 35.0,
        },
        "directional": {"type": "directional", "direction": [-0.3, -0.5, 1.0], "irradiance": [1.0, 0.9, 0.8]},
    },
    "corridor": {
        "point": {"type": "point", "position": [1.2, 1.6, 1.0], "intensity": [1.0, 0.8, 0.6]},
        "spot": {
            "type": "spot", "position": [2.0, 2.2, 1.5], "direction": [1.0, -0.7, 0.1], "intensity": [2.0, 2.0, 3.0],
            "inner_deg": 39.999, "outer_deg": 40.0,
        },
        "rect": {
            "type": "rect", "center": [4.2, 2.4, 1.4], "half_u": [0.4, 0.0, 0.0], "half_v": [0.0, 0.0, 0.3],
            "radiance": [3.0, 2.0, 1.0],
        },
    },
}  # fmt: skip
SHADE = 1e-3
"""Metres behind a rectangle light where a black sheet stands in ddprt: Mitsuba's lights are bodies that absorb."""


def shaded(scene: Scene, light: dict[str, Any]) -> Scene:
    """The scene, and behind a rectangle light a black sheet of its size."""
    if light["type"] != "rect":
        return scene
    u, v = np.array(light["half_u"]), np.array(light["half_v"])
    facing = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    middle = np.array(light["center"]) - SHADE * facing
    sheet = faceted(
        "sheet", np.array([[middle - u - v, middle + u - v, middle + u + v, middle - u + v]]), (Material("black", (0.0,) * 3),)
    )
    return checked(
        scene.name,
        np.concatenate([scene.positions, sheet.positions]),
        np.concatenate([scene.triangles, sheet.triangles + len(scene.positions)]),
        material=np.concatenate([scene.material, np.full(2, len(scene.materials))]),
        materials=(*scene.materials, *sheet.materials),
    )  # fmt: skip


def translated(light: dict[str, Any]) -> dict[str, Any]:
    """A light in Mitsuba's words."""
    rgb = lambda colour: {"type": "rgb", "value": list(colour)}  # noqa: E731
    transform = mi.ScalarTransform4f
    if light["type"] == "point":
        return {"type": "point", "position": light["position"], "intensity": rgb(light["intensity"])}
    if light["type"] == "spot":
        origin, direction = np.array(light["position"]), np.array(light["direction"])
        return {
            "type": "spot",
            "to_world": transform().look_at(origin=origin.tolist(), target=(origin + direction).tolist(), up=[0.0, 0.0, 1.0]),
            "intensity": rgb(light["intensity"]),
            "cutoff_angle": light["outer_deg"],
            "beam_width": light["inner_deg"],
        }
    if light["type"] == "directional":
        return {"type": "directional", "direction": light["direction"], "irradiance": rgb(light["irradiance"])}
    if light["type"] == "environment":
        return {
            "type": "envmap",
            "bitmap": mi.Bitmap(stepped(read_panorama(light["image"]))),
            "scale": light["scale"],
            "to_world": transform().rotate([0, 1, 0], light["rotation_deg"]),
        }
    u, v = np.array(light["half_u"]), np.array(light["half_v"])
    columns = np.eye(4)
    columns[:3] = np.stack([u, v, np.cross(u, v) / np.linalg.norm(np.cross(u, v)), light["center"]], 1)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(columns),
        "bsdf": {"type": "diffuse", "reflectance": rgb((0, 0, 0))},
        "emitter": {"type": "area", "radiance": rgb(light["radiance"])},
    }


def stepped(pixels: np.ndarray, fine: int = 16) -> np.ndarray:
    """The same sky for Mitsuba, which interpolates between pixels, has its first and last row at the poles, and -z at u = 0.

    Each pixel becomes some 16 x 16, and what lies on an edge between rows their mean: edges are a 16th of a pixel wide, and as
    much is lost on one side of them as is gained on the other.
    """
    rows = np.repeat(pixels, fine, 0)
    rows = (np.concatenate([rows[:1], rows]) + np.concatenate([rows, rows[-1:]])) / 2
    return np.ascontiguousarray(np.roll(np.repeat(rows, fine, 1), fine * pixels.shape[1] // 2, 1).astype(np.float32))


def mitsuba_scene(scene: Scene, light: dict[str, Any]) -> Any:
    """Flat triangles, one mesh and one one-sided diffuse surface per material: backs reflect nothing, as here."""
    parts: dict[str, Any] = {"type": "scene", "light": translated(light)}
    for index, material in enumerate(scene.materials):
        corners = scene.corners[scene.material == index]
        properties = mi.Properties()
        properties["face_normals"] = True
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": list(material.albedo)}})
        mesh = mi.Mesh(material.name, 3 * len(corners), len(corners), props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = corners.reshape(-1).astype(np.float32)
        parameters["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
        parameters.update()
        parts[f"mesh{index}"] = mesh
    return mi.load_dict(parts)


def surface_points(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    triangle = rng.choice(len(scene.areas), POINTS, p=scene.areas / scene.areas.sum())
    return np.einsum("nc,ncd->nd", rng.dirichlet(np.ones(3), POINTS), scene.corners[triangle]), scene.geometric_normals[
        triangle
    ]


def mitsuba_irradiance(
    scene: Any, positions: np.ndarray, normals: np.ndarray, light: dict[str, Any], rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Direct, indirect, and the variances of both means, of one channel."""
    path = mi.load_dict({"type": "path", "hide_emitters": True, "max_depth": -1})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(int(rng.integers(2**31)))
    once = light["type"] not in ("rect", "environment")
    found = []
    for position, normal in zip(positions, normals, strict=True):
        origin = (position + 1e-6 * normal).tolist()
        sphere = rng.normal(size=(SAMPLES, 3))
        direction = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        rays = (path.sample(scene, sampler, mi.RayDifferential3f(origin, towards))[0] for towards in direction.tolist())
        indirect = np.pi * np.array([ray[GREEN] for ray in rays])

        reference = mi.SurfaceInteraction3f()
        reference.p, reference.n, reference.t = mi.Point3f(position.tolist()), mi.Normal3f(normal.tolist()), 0.0
        direct = []
        for _ in range(1 if once else SAMPLES):
            sample, weight = scene.sample_emitter_direction(reference, sampler.next_2d(), True)
            cosine = max(float(np.dot(normal, [sample.d[0], sample.d[1], sample.d[2]])), 0.0)
            direct.append(cosine * weight[GREEN])
        parts = [np.array(direct), indirect]
        found.append([*(part.mean() for part in parts), *(part.var() / len(part) for part in parts)])
    return tuple(np.array(found).T)


@pytest.fixture(scope="module")
def comparison() -> dict[str, dict[str, np.ndarray]]:
    """For each scene and light: rows ours, theirs, variance, of direct and of indirect light."""
    mi.set_variant("scalar_rgb")
    rng = np.random.default_rng(0)
    found: dict[str, dict[str, np.ndarray]] = {}
    for name, lights in LIGHTS.items():
        positions, normals = surface_points(build(name), rng)
        for kind, light in lights.items():
            scene = shaded(build(name), light)
            ours = ddprt.irradiance(scene, light, positions, normals, samples=SAMPLES, seed=1, return_variance=True)
            theirs = mitsuba_irradiance(mitsuba_scene(scene, light), positions, normals, light, rng)
            rows = [
                row
                for part in (0, 1)
                for row in (ours[part][:, GREEN], theirs[part], ours[part + 2][:, GREEN], theirs[part + 2])
            ]
            found.setdefault(name, {})[kind] = np.array(rows)
    return found


def z_scores(rows: np.ndarray) -> np.ndarray:
    ours, theirs, variance, their_variance = rows
    seen = variance + their_variance > 1e-12 * (ours + theirs) ** 2
    return (ours - theirs)[seen] / np.sqrt((variance + their_variance)[seen])


@pytest.mark.parametrize("name", LIGHTS)
def test_indirect_light_agrees_with_mitsuba(comparison: dict[str, dict[str, np.ndarray]], name: str) -> None:
    z = {kind: z_scores(rows[4:]) for kind, rows in comparison[name].items()}
    for kind, scores in z.items():
        print(f"{name}, {kind}: {len(scores)} points, z {scores.mean():+.3f} +- {scores.std():.3f}")
    pooled = np.concatenate(list(z.values()))
    print(f"{name}: {len(pooled)} points, z {pooled.mean():+.3f} +- {pooled.std():.3f}")
    assert len(pooled) > 0.9 * 3 * POINTS  # the floor beneath the blocks is dark
    # 768 scores: the mean is known to 0.036, the standard deviation to 0.026.
    assert abs(pooled.mean()) < 0.1
    assert abs(pooled.std() - 1) < 0.1


@pytest.mark.parametrize("name", LIGHTS)
def test_direct_light_agrees_with_mitsuba(comparison: dict[str, dict[str, np.ndarray]], name: str) -> None:
    for kind, rows in comparison[name].items():
        ours, theirs = rows[:2]
        assert (ours > 0).mean() > 0.1
        if kind == "rect":
            z = z_scores(rows[:4])
            print(f"{name}, {kind}: {len(z)} points, direct z {z.mean():+.3f} +- {z.std():.3f}")
            # 200 scores: the mean is known to 0.07, the standard deviation to 0.05; four of these each.
            assert abs(z.mean()) < 0.28
            assert abs(z.std() - 1) < 0.2
        else:
            # Origins stand up to 2e-4 m (Mitsuba's ray epsilon) and 3e-5 m (ours) off the surface, lamps some 0.1 m away;
            # the rim of a spot is 1e-5 of its disc wide.
            np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=1e-4 * ours.max())


def test_skies_agree_with_mitsuba(tmp_path: Path) -> None:
    """A sky of 24 x 12 pixels without any symmetry, turned, on the statue, whose hollows and ground see a part of it each."""
    mi.set_variant("scalar_rgb")
    rng = np.random.default_rng(3)
    pixels = (rng.exponential(1, (12, 24, 3)) * rng.integers(0, 2, (12, 24, 1))).astype(np.float32)
    pixels[3, 17] = (75, 50, 30)
    write_exr(tmp_path / "sky.exr", pixels)
    light = {"type": "environment", "image": str(tmp_path / "sky.exr"), "rotation_deg": 70.0, "scale": 1.5}
    scene = build("statue", subdivisions=3)
    positions, normals = surface_points(scene, rng)
    ours = ddprt.irradiance(scene, light, positions, normals, samples=SAMPLES, seed=1, return_variance=True)
    theirs = mitsuba_irradiance(mitsuba_scene(scene, light), positions, normals, light, rng)
    for part, name in enumerate(("direct", "indirect")):
        z = z_scores(np.array([ours[part][:, GREEN], theirs[part], ours[part + 2][:, GREEN], theirs[part + 2]]))
        print(f"statue, sky, {name}: {len(z)} points, z {z.mean():+.3f} +- {z.std():.3f}")
        assert len(z) > 0.8 * POINTS
        # 256 scores: the mean is known to 0.063, the standard deviation to 0.044; four of these each.
        assert abs(z.mean()) < 0.25
        assert abs(z.std() - 1) < 0.18
