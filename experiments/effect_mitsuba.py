"""Mitsuba's opinion of effects of light: z-scores at 256 points, which `experiments/effects.py` asks for where it is installed.

Both sides are estimates, and z is their difference over the root of both variances: 0 +- 1 where they agree, known to 0.06 and
0.04 from 256 scores. Points without light have none. Bodies of lamps block light there, so ours get black bodies behind them;
where models differ, what both have is compared (metals, spots with rims of 0.001 degrees).
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from peer_mitsuba import load_mitsuba

import ddprt
from ddprt.lights import parse_lighting
from ddprt.lights.panorama import read_panorama
from ddprt.scene.atlas import build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.exr import write_exr
from ddprt.scene.holes import Holes
from ddprt.scene.library import build
from ddprt.scene.material import Gloss, Material, bilinear
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import icosphere
from ddprt.scene.sheets import backs
from ddprt.sections import TransportConfig
from ddprt.transport.effects import force
from ddprt.transport.embree import Tracer
from ddprt.transport.emission import constant_light

POINTS, PATHS = 256, 4096
"""As many paths on either side: sums of paths are skewed, a low mean comes with a low variance, and that cancels so."""
GREEN = 1
"""One channel: all three share their paths."""
SHADE = 1e-3
"""Metres from a lamp's surface to the black body behind it."""
FINE = 2048
"""Pixels along a mask that Mitsuba gets: it blends where we cut, so it is cut beforehand."""
PARTS = 16
"""Of a sky's pixel along each side, for the same reason."""
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])[[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]]

ELSEWHERE = ("probes", "fog", "subsurface", "hair")
"""Not asked here: Mitsuba has no probes; the others have tests of their own (tests/test_mitsuba_fog.py and so on)."""

POINT = {"type": "point", "position": [0.28, 0.45, 0.2], "intensity": [1.0, 1.0, 1.0]}
LIGHTS: dict[str, dict[str, Any]] = {
    "point lights": POINT,
    "spot lights": {
        "type": "spot", "position": [0.45, 0.5, 0.1], "direction": [-0.5, -1.0, 0.6], "intensity": [2.0, 2.0, 3.0],
        "inner_deg": 34.999, "outer_deg": 35.0,
    },
    "directional lights": {"type": "directional", "direction": [-0.3, -0.5, 1.0], "irradiance": [1.0, 0.9, 0.8]},
    "rect lights": {
        "type": "rect", "center": [0.28, 0.45, 0.28], "half_u": [0.06, 0.0, 0.0], "half_v": [0.0, 0.02, 0.04],
        "radiance": [3.0, 2.0, 1.0],
    },
    "sphere lights": {"type": "sphere", "center": [0.28, 0.45, 0.28], "radius": 0.05, "radiance": [3.0, 2.0, 1.0]},
    "mesh lights": {
        "type": "mesh", "mesh": TETRAHEDRON.tolist(), "position": [0.28, 0.45, 0.28], "rotation": [0.2, 0.3, 0.1, 0.9],
        "scale": 0.04, "radiance": [3.0, 2.0, 1.0],
    },
}  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """A scene in both renderers: ours with black bodies in its lamps, and its lamp, if it has one."""

    scene: Scene
    light: dict[str, Any] | None

    @property
    def sized(self) -> bool:
        """Whether a ray can meet the light."""
        return self.light is not None and self.light["type"] in ("rect", "sphere", "mesh", "environment")


def second_opinion(name: str) -> dict[str, float] | None:
    """Mean and deviation of z-scores of an effect; None where Mitsuba has none of it."""
    if name in ELSEWHERE:
        return None
    if name == "emission":
        z = glowing_scores(build("neon"))
    elif name == "environment lights":
        with tempfile.TemporaryDirectory(prefix="effects-") as folder:
            z = scores(Stage(build("statue", subdivisions=3), turned_sky(Path(folder) / "sky.exr")))
    else:
        z = scores(staged(name))
    return {"z_mean": float(z.mean()), "z_std": float(z.std()), "z_count": len(z)}


def staged(name: str) -> Stage:
    """The Cornell box under a lamp, some of it of metal; a corridor under one; or leaves."""
    if name in ("cut-outs", "two-sided sheets"):
        leaves = build("leaves")
        lamp = {"type": "point", "position": [1.0, 1.9, 1.0], "intensity": [1.0, 1.0, 1.0]}
        return Stage(leaves if name == "cut-outs" else force(leaves, off=["cut-outs"]), lamp)
    if name == "diffuse bounces":
        return Stage(build("corridor"), {**POINT, "position": [1.2, 1.6, 1.0]})
    scene = build("cornell")
    if name == "gloss":
        material = scene.material.copy()
        material[8:28] = len(scene.materials)  # the blocks
        gilt = Material("gilt", (0.9, 0.65, 0.3), gloss=Gloss(0.45, 1.0))
        return Stage(replace(scene, material=material, materials=(*scene.materials, gilt)), POINT)
    light = LIGHTS[name]
    return Stage(shaded(scene, light), light)


def turned_sky(path: Path) -> dict[str, Any]:
    """A picture without any symmetry, and a small sun in it."""
    rng = np.random.default_rng(3)
    pixels = (rng.exponential(1, (12, 24, 3)) * rng.integers(0, 2, (12, 24, 1))).astype(np.float32)
    pixels[3, 17] = (75, 50, 30)
    write_exr(path, pixels)
    return {"type": "environment", "image": str(path), "rotation_deg": 70.0, "scale": 1.5}


def lamp_body(light: dict[str, Any], size: float = 1.0) -> np.ndarray:
    """Triangles of a lamp, (n, 3, 3): its surface, or what lies a little behind that; none of a lamp without size."""
    if light["type"] == "rect":
        u, v = np.array(light["half_u"]), np.array(light["half_v"])
        facing = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        quad = np.array(light["center"]) + np.array([-u - v, u - v, u + v, v - u]) - (size < 1) * SHADE * facing
        return quad[[[0, 1, 2], [0, 2, 3]]]
    if light["type"] == "sphere":
        directions, triangles = icosphere(4)
        return np.array(light["center"]) + size * light["radius"] * directions[triangles]
    if light["type"] == "mesh":
        (lamp,) = parse_lighting(light)
        return np.array(light["position"]) + size * lamp.shape.corners  # type: ignore[attr-defined]
    return np.empty((0, 3, 3))


def shaded(scene: Scene, light: dict[str, Any]) -> Scene:
    """The scene and a black body in its lamp."""
    body = lamp_body(light, 0.98)
    return checked(
        scene.name,
        np.concatenate([scene.positions, body.reshape(-1, 3)]),
        np.concatenate([scene.triangles, np.arange(3 * len(body)).reshape(-1, 3) + len(scene.positions)]),
        material=np.concatenate([scene.material, np.full(len(body), len(scene.materials))]),
        materials=(*scene.materials, Material("shade", (0.0,) * 3)),
    )


# --- in Mitsuba's words --------------------------------------------------------------------------------------------------


def rgb(colour: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": list(colour)}


def in_mitsuba(mi: Any, scene: Scene, light: dict[str, Any] | None) -> Any:
    """One mesh of flat triangles for each material; one-sided unless it has backs of its own."""
    parts: dict[str, Any] = {"type": "scene"}
    if light:
        parts["light"] = lamp_in_mitsuba(mi, light)
    for index, material in enumerate(scene.materials):
        chosen = (scene.material == index) & ~backs(scene)
        if material.name != "shade" and chosen.any():
            uv = None if scene.uv is None else scene.uv[scene.triangles[chosen]]
            emission = material.emission.radiance if material.emission else None
            parts[f"mesh{index}"] = mesh(mi, scene.corners[chosen], surface(mi, material), emission, uv)
    return mi.load_dict(parts)


def mesh(mi: Any, corners: np.ndarray, bsdf: dict[str, Any], radiance: Any = None, uv: np.ndarray | None = None) -> Any:
    properties, count = mi.Properties(), 3 * len(corners)
    properties["face_normals"], properties["bsdf"] = True, mi.load_dict(bsdf)
    if radiance is not None:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": rgb(radiance)})
    found = mi.Mesh("mesh", count, count // 3, has_vertex_texcoords=uv is not None, props=properties)
    handles = mi.traverse(found)
    handles["vertex_positions"] = corners.ravel().astype(np.float32)
    if uv is not None:
        handles["vertex_texcoords"] = uv.ravel().astype(np.float32)
    handles["faces"] = np.arange(count, dtype=np.uint32)
    handles.update()
    return found


def surface(mi: Any, material: Material) -> dict[str, Any]:
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": rgb(material.albedo)}
    if material.gloss:
        bsdf = {
            "type": "principled",
            "base_color": rgb(material.albedo),
            "metallic": 1.0,
            "roughness": material.gloss.roughness,
        }
    if material.two_sided:
        bsdf = {"type": "twosided", "bsdf": bsdf}
    if material.cutout:
        middles = (np.mgrid[:FINE, :FINE] + 0.5) / FINE
        opacity = bilinear(material.cutout.opacity, np.stack([middles[1].ravel(), middles[0].ravel()], 1))
        there = (opacity >= material.cutout.cutoff).reshape(FINE, FINE, 1).astype(np.float32)
        mask = {"type": "bitmap", "bitmap": mi.Bitmap(there), "raw": True, "filter_type": "nearest"}
        bsdf = {"type": "mask", "opacity": mask, "bsdf": bsdf}
    return bsdf


def lamp_in_mitsuba(mi: Any, light: dict[str, Any]) -> Any:
    kind, black = light["type"], {"type": "diffuse", "reflectance": rgb((0, 0, 0))}
    if kind == "point":
        return {"type": "point", "position": light["position"], "intensity": rgb(light["intensity"])}
    if kind == "directional":
        return {"type": "directional", "direction": light["direction"], "irradiance": rgb(light["irradiance"])}
    if kind == "spot":
        origin = np.array(light["position"])
        aim = {"origin": origin.tolist(), "target": (origin + light["direction"]).tolist(), "up": [0.0, 0.0, 1.0]}
        return {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(**aim),
            "intensity": rgb(light["intensity"]),
            "cutoff_angle": light["outer_deg"],
            "beam_width": light["inner_deg"],
        }
    if kind == "environment":
        rows = np.repeat(read_panorama(light["image"]), PARTS, 0)
        rows = (np.concatenate([rows[:1], rows]) + np.concatenate([rows, rows[-1:]])) / 2  # its outer rows are the poles
        pixels = np.repeat(rows, PARTS, 1)
        rolled = np.ascontiguousarray(np.roll(pixels, pixels.shape[1] // 2, 1))  # -z is at u = 0 there
        turned = mi.ScalarTransform4f().rotate([0, 1, 0], light["rotation_deg"])
        return {"type": "envmap", "bitmap": mi.Bitmap(rolled), "scale": light["scale"], "to_world": turned}
    if kind == "sphere":
        emitter = {"type": "area", "radiance": rgb(light["radiance"])}
        return {"type": "sphere", "center": light["center"], "radius": light["radius"], "bsdf": black, "emitter": emitter}
    return mesh(mi, lamp_body(light), black, light["radiance"])


# --- both sides ----------------------------------------------------------------------------------------------------------


def scores(stage: Stage) -> np.ndarray:
    """Of indirect light, and of direct light where lamps have a size: elsewhere it has no variance."""
    scene, rng = stage.scene, np.random.default_rng(0)
    places, normals = surface_points(scene, rng)
    ours = ddprt.irradiance(scene, stage.light, places, normals, samples=PATHS, seed=1, return_variance=True)
    mi, dr = load_mitsuba()
    theirs = in_mitsuba(mi, scene, stage.light)
    through = any(material.cutout for material in scene.materials)
    starts, facing = np.repeat(places, PATHS, 0), np.repeat(normals, PATHS, 0)
    indirect = path_light(mi, theirs, starts, facing, rng, "volpath" if through else "path", seen=not stage.sized)
    found = [z_scores(ours[1][:, GREEN], ours[3][:, GREEN], *indirect)]
    if stage.sized:
        found.append(z_scores(ours[0][:, GREEN], ours[2][:, GREEN], *emitter_light(mi, dr, theirs, starts, facing)))
    return np.concatenate(found)


def surface_points(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places on surfaces, by area; none in a hole, nor on the black body of a lamp."""
    there = np.array([material.name != "shade" for material in scene.materials])[scene.material] * scene.areas
    triangle, weights = rng.choice(len(there), 8 * POINTS, p=there / there.sum()), rng.dirichlet(np.ones(3), 8 * POINTS)
    if holes := Holes.of(scene):
        whole = ~holes.open_at(triangle, weights[:, 1], weights[:, 2])
        triangle, weights = triangle[whole], weights[whole]
    triangle, weights = triangle[:POINTS], weights[:POINTS]
    return np.einsum("nc,ncd->nd", weights, scene.corners[triangle]), scene.geometric_normals[triangle]


def path_light(
    mi: Any, scene: Any, places: np.ndarray, normals: np.ndarray, rng: np.random.Generator, kind: str, *, seen: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of what a path from each place brings, by rows of PATHS; `seen`: with lamps that it meets first."""
    sphere = rng.normal(size=places.shape)
    towards = normals + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    starts = places + 1e-5 * normals
    rays = mi.RayDifferential3f(mi.Point3f(starts.T.astype(np.float32)), mi.Vector3f(towards.T.astype(np.float32)))

    def along(depth: int) -> np.ndarray:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(7, len(starts))
        light = mi.load_dict({"type": kind, "max_depth": depth}).sample(scene, sampler, rays)[0]
        return np.pi * np.array(light, np.float64)[GREEN].reshape(-1, PATHS)

    found = along(-1) if seen else along(-1) - along(1)
    return found.mean(1), found.var(1) / PATHS


def emitter_light(mi: Any, dr: Any, scene: Any, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of direct light by the renderer's choice of emitters."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(11, len(places))
    here = dr.zeros(mi.SurfaceInteraction3f, len(places))
    here.p = mi.Point3f((places + 1e-5 * normals).T.astype(np.float32))
    facing = mi.Normal3f(normals.T.astype(np.float32))
    here.n, here.sh_frame = facing, mi.Frame3f(facing)
    there, weight = scene.sample_emitter_direction(here, sampler.next_2d(), True)
    cosine = np.maximum(np.einsum("dn,dn->n", np.array(there.d, np.float64), normals.T), 0)
    found = (cosine * np.array(weight, np.float64)[GREEN]).reshape(-1, PATHS)
    return found.mean(1), found.var(1) / PATHS


def z_scores(ours: np.ndarray, variance: np.ndarray, theirs: np.ndarray, their_variance: np.ndarray) -> np.ndarray:
    seen = variance + their_variance > 1e-12 * (ours + theirs) ** 2
    return (ours - theirs)[seen] / np.sqrt((variance + their_variance)[seen])


def glowing_scores(scene: Scene, runs: int = 8) -> np.ndarray:
    """All light of surfaces that glow, at texels: the map's, and that of paths from places of the same texels."""
    atlas, tracer, rng = build_atlas(scene, 128), Tracer.of(scene, 2), np.random.default_rng(0)
    texels = np.sort(rng.choice(atlas.count, POINTS, replace=False))
    settings = TransportConfig(test_samples=256)
    maps = [constant_light(scene, tracer, atlas, settings, seed=seed, bounces=-1) for seed in range(runs)]
    halves = np.array([one.irradiance + sign * one.noise for one in maps for sign in (1, -1)])[:, texels, GREEN].astype(float)
    place, triangle = atlas.sampler.sample(np.repeat(texels, PATHS), rng.random((POINTS * PATHS, 2), np.float32))
    mi, _ = load_mitsuba()
    theirs = in_mitsuba(mi, scene, None)
    normals = tracer.normals[triangle].astype(float)
    light = path_light(mi, theirs, place + scene.centre, normals, rng, "path", seen=True)
    return z_scores(halves.mean(0), halves.var(0, ddof=1) / len(halves), *light)
