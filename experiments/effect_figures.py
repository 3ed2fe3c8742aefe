"""Closed forms of effects of light, one figure for each; `experiments/effects.py` shows them.

`closed_form_error` is the largest relative deviation among the numbers that are compared; `standard_error`, where light is
sampled, the mean square root of what their samples leave uncertain, relative as well: about four of these are no news.
"""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import integrate

import ddprt
from ddprt.config import checked as configured
from ddprt.dataset.layers import read_layer, read_light
from ddprt.lights import parse_lighting
from ddprt.sampling.riding import place_riders
from ddprt.scene.atlas import build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.exr import write_exr
from ddprt.scene.fog import Fog
from ddprt.scene.library import build
from ddprt.scene.material import Cutout, Emission, Gloss, Material, Subsurface
from ddprt.scene.mesh import Scene
from ddprt.scene.poses import posed
from ddprt.scene.shapes import faceted, hollow, icosphere, rectangle
from ddprt.sections import TransportConfig
from ddprt.transport import ggx
from ddprt.transport.embree import Tracer
from ddprt.transport.reference import on_points, trace_reference

Figure = dict[str, float]
UP = (0.0, 1.0, 0.0)
SUN = {"type": "directional", "direction": [0.6, -0.8, 0.0], "irradiance": [3.0, 3.0, 3.0]}
HALF = 10.0
POINT = {"type": "point", "position": [0.0, 1.0, 0.0], "intensity": [1.0, 1.0, 1.0]}


def compared(found: Any, expected: Any, error: Any = None, *, unit: float = 0.0) -> Figure:
    """Deviations, relative to what is expected or to a unit that all have in common."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    size = np.full(expected.shape, unit) if unit else np.abs(expected)
    figure = {"closed_form_error": float((np.abs(found - expected) / size).max())}
    if error is not None:
        share = np.asarray(error, float) / size
        figure["standard_error"] = (
            float(np.sqrt((share[share > 0] ** 2).mean())) if share.any() else 0.0
        )  # what is dark is sure
    return figure


def square(side: float, height: float, facing: int) -> np.ndarray:
    """Corners about the axis of y."""
    return rectangle((-side / 2,) * 2, (side / 2,) * 2, height, 1, facing=facing)


def ground(material: Material | None = None) -> Scene:
    """A square, 20 m wide, that looks up; black unless said otherwise."""
    return faceted("ground", np.array([square(2 * HALF, 0.0, 1)]), (material or Material("black", (0.0,) * 3),))


def light_at(scene: Scene, light: Any, places: Any, normals: Any, samples: int, part: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Direct (0) or indirect (1) light of the first channel, and its standard error."""
    found = ddprt.irradiance(scene, light, places, normals, samples=samples, return_variance=True)
    return found[part][:, 0], np.sqrt(found[part + 2][:, 0])


def on_ground(light: dict[str, Any], expected: float, samples: int = 0) -> Figure:
    """Light of the ground in its middle, of samples where the light has a size."""
    found, error = light_at(ground(), light, [[0.0, 0.0, 0.0]], [UP], samples or 2)
    return compared(found, [expected], error if samples else None)


def lambert(corners: np.ndarray, place: Any, normal: Any = UP) -> float:
    """Irradiance from a polygon of radiance 1, all of it above the horizon: half the sum of what its edges subtend."""
    towards = corners - place
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    after = np.roll(towards, -1, 0)
    across = np.cross(towards, after)
    size = np.linalg.norm(across, axis=1)
    return abs(float((np.arctan2(size, (towards * after).sum(1)) / size * (across @ normal)).sum())) / 2


# --- light that bounces, and lamps ---------------------------------------------------------------------------------------


def bounces(quick: bool) -> Figure:
    """A sphere of albedo a, lit from its middle: indirect light is a / (1 - a) times the direct."""
    scene = ddprt.load_scene("furnace", albedo=0.5, subdivisions=3)
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]}
    triangle = np.random.default_rng(0).choice(len(scene.areas), 256, p=scene.areas / scene.areas.sum())
    place, normal = scene.corners[triangle].mean(1), scene.geometric_normals[triangle]
    found, error = light_at(scene, lamp, place, normal, 400 if quick else 6400, part=1)
    return compared(found.mean(), 4 * math.pi / scene.areas.sum(), np.linalg.norm(error) / len(error))


def point(quick: bool) -> Figure:
    return on_ground({"type": "point", "position": [0.6, 0.8, 0], "intensity": [2, 2, 2]}, 2 * 0.8)


def spot(quick: bool) -> Figure:
    light = {"type": "spot", "position": [0.6, 0.8, 0], "direction": [-0.6, -0.8, 0], "intensity": [2, 2, 2]}
    return on_ground({**light, "inner_deg": 10, "outer_deg": 30}, 2 * 0.8)


def directional(quick: bool) -> Figure:
    return on_ground(SUN, 3 * 0.8)


def rect(quick: bool) -> Figure:
    light = {"type": "rect", "center": [0, 1, 0], "half_u": [0.5, 0, 0], "half_v": [0, 0, 0.5], "radiance": [1, 1, 1]}
    return on_ground(light, lambert(square(1.0, 1.0, -1), [0, 0, 0]), 1 << 16 if quick else 1 << 20)


def sphere(quick: bool) -> Figure:
    light = {"type": "sphere", "center": [0.6, 0.8, 0], "radius": 0.25, "radiance": [1, 1, 1]}
    return on_ground(light, math.pi * 0.25**2 * 0.8, 1 << 16 if quick else 1 << 20)


def mesh(quick: bool) -> Figure:
    """A pyramid without a base, by Lambert's formula for each of the faces that look down at the ground."""
    tip, base = np.array([[0.1, 0.6, 0.05]]), square(0.8, 1.0, 1)
    faces = np.stack([np.repeat(tip, 4, 0), base, np.roll(base, -1, 0)], 1)
    faces = faces if np.cross(*(faces[0, 1:] - faces[0, 0]))[1] < 0 else faces[:, ::-1]
    light = {"type": "mesh", "mesh": faces.tolist(), "position": [0, 0, 0], "radiance": [1, 1, 1]}
    return on_ground(light, sum(lambert(face, [0, 0, 0]) for face in faces), 1 << 16 if quick else 1 << 20)


# --- skies ---------------------------------------------------------------------------------------------------------------


def environment(quick: bool) -> Figure:
    """A ball under a turned picture of 24 x 12 pixels, by midpoints of its pixels' parts; and under a white sky, by pi."""
    rng, turn, parts = np.random.default_rng(0), 70.0, 32
    pixels = (rng.exponential(1, (12, 24, 3)) * rng.integers(0, 2, (12, 24, 1))).astype(np.float32)
    pixels[3, 17] = (75, 50, 30)
    directions, triangles = icosphere(2)
    ball = checked("ball", directions, triangles, materials=(Material("black", (0.0,) * 3),))
    normals, places = ball.geometric_normals[::5], ball.corners.mean(1)[::5]
    edges = np.cos(np.pi * np.arange(12 * parts + 1) / (12 * parts))
    y, solid = (edges[1:] + edges[:-1])[:, None] / 2, -np.diff(edges)[:, None] * 2 * np.pi / (24 * parts)
    around = 2 * np.pi * ((np.arange(24 * parts) + 0.5) / (24 * parts) - 0.5) - np.deg2rad(turn)
    flat = np.sqrt(1 - y**2)
    towards = np.stack(np.broadcast_arrays(flat * np.sin(around), y, -flat * np.cos(around)), -1)
    red = np.kron(pixels[..., 0], np.ones((parts, parts))) * solid
    expected = [float((np.maximum(towards @ normal, 0) * red).sum()) for normal in normals]
    with tempfile.TemporaryDirectory(prefix="effects-") as folder:
        write_exr(Path(folder) / "sky.exr", pixels)
        sky = {"type": "environment", "image": str(Path(folder) / "sky.exr"), "rotation_deg": turn}
        found, error = light_at(ball, sky, places, normals, 1 << 14 if quick else 1 << 18)
    white, own = light_at(ball, {"type": "environment", "image": "white"}, places, normals, 16)
    drawn, uniform = compared(found, expected, error, unit=float(np.mean(expected))), compared(white, [np.pi] * len(white), own)
    return {key: max(drawn[key], uniform[key]) for key in drawn}


# --- surfaces ------------------------------------------------------------------------------------------------------------


def gloss(quick: bool) -> Figure:
    """What a metal plate without end sends back of a white sky: its facets' albedo, by quadrature of what `ggx` evaluates."""
    part, base, nodes = Gloss(0.5, 1.0), 0.8, 48
    x, weight = np.polynomial.legendre.leggauss(nodes)
    tilt, turn = (x + 1) / 2, 2 * np.pi * (np.arange(2 * nodes) + 0.5) / (2 * nodes)
    i, o, phi = (grid.ravel() for grid in np.meshgrid(tilt, tilt, turn, indexing="ij"))
    arriving = np.stack([np.sqrt(1 - i**2), np.zeros_like(i), i], 1)
    leaving = np.stack([np.sqrt(1 - o**2) * np.cos(phi), np.sqrt(1 - o**2) * np.sin(phi), o], 1)
    finish = np.tile([part.roughness, part.metallic, part.dielectric], (len(i), 1))
    value = ggx.evaluate(arriving, leaving, np.full((len(i), 3), base), finish)[:, 0].reshape(nodes, nodes, -1)
    albedo = 4 * np.pi * (weight / 2 * tilt) @ value.mean(2) @ (weight / 2)  # `evaluate` holds the other cosine
    plate, count, height = ground(Material("metal", (base,) * 3, gloss=part)), 16, 0.05
    places = np.stack([np.linspace(-0.5, 0.5, count), np.full(count, height), np.zeros(count)], 1)
    white = {"type": "environment", "image": "white"}
    found, error = light_at(plate, white, places, [[0, -1, 0]] * count, 1 << 13 if quick else 1 << 18, part=1)
    seen = lambert(square(2 * HALF, 0.0, 1), [0, height, 0], (0, -1, 0))  # nearly pi
    return compared(found.mean(), seen * albedo, np.linalg.norm(error) / count)


def cutouts(quick: bool) -> Figure:
    """Slanted sun through stripes: opacity rises and falls by straight lines, so what the cutoff leaves open is the cutoff."""
    cutoff, count = 0.3, 1 << 14
    opacity = np.array([[0.0, 1.0]], np.float32)
    sheet = Material("sheet", (0.5,) * 3, cutout=Cutout(opacity, cutoff))
    corners = np.concatenate([square(2 * HALF, 0.0, 1), square(2 * HALF, 1.0, 1)])
    uv = corners[:, [0, 2]]  # a stripe each metre
    scene = checked(
        "stripes",
        corners,
        np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
        material=np.array([0, 0, 1, 1]),
        materials=(Material("black", (0.0,) * 3), sheet),
        uv=uv,
    )
    places = np.zeros((count, 3))
    places[:, 0] = (np.arange(count) + 0.5) / count - 0.5  # the rims of stripes are met to a step: 4e-4 of what is open
    found, _ = light_at(scene, SUN, places, np.tile(UP, (count, 1)), 2)
    return compared(found.mean(), 3 * 0.8 * cutoff)


def two_sided(quick: bool) -> Figure:
    """A sheet without thickness, lit from above or from below: the side that is lit reflects, the other does not."""
    albedo, side, away = 0.5, 2.0, 0.7
    sheet = faceted("sheet", np.array([square(side, 0.0, 1)]), (Material("sheet", (albedo,) * 3, two_sided=True),))
    places, normals = [[0.2, away, 0.1], [0.2, -away, 0.1]], [[0, -1, 0], [0, 1, 0]]
    suns = [SUN, {**SUN, "direction": [0.6, 0.8, 0.0]}]
    lit = [light_at(sheet, sun, places, normals, 1 << 16 if quick else 1 << 20, part=1) for sun in suns]
    bright = albedo * 3 * 0.8 / math.pi * lambert(square(side, 0.0, 1), places[0], normals[0])
    return compared([found for found, _ in lit], np.diag([bright] * 2), [error for _, error in lit], unit=bright)


def emission(quick: bool) -> Figure:
    """A square that glows, over a floor: the map's mean over the floor's texels, by Lambert's formula in the middle of each."""
    from ddprt.transport.emission import constant_light

    materials = Material("floor", (0.0,) * 3), Material("lamp", (0.0,) * 3, emission=Emission((2.0, 1.0, 0.5)))
    scene = faceted("square", np.array([square(1.0, 0.0, 1), square(0.6, 0.5, -1)]), materials, np.array([0, 1]))
    atlas = build_atlas(scene, 64)
    settings = TransportConfig(target_noise=0.02 if quick else 0.004)
    light = constant_light(scene, Tracer.of(scene, 2), atlas, settings, seed=0, bounces=0)
    floor = np.flatnonzero(atlas.position[:, 1] < 0.25)
    share = atlas.area[floor] / atlas.area[floor].sum()
    lamp = square(0.6, 0.5, -1)
    expected = 2 * np.array([lambert(lamp, place) for place in atlas.position[floor]])
    mean, error = share @ light.irradiance[floor, 0], np.linalg.norm(share * light.noise[floor, 0])
    return compared(mean, share @ expected, error)


def subsurface(quick: bool) -> Figure:
    """A white ball whose boundary refracts nothing: what falls on it leaves it, elsewhere. Its error is that of eight bakes."""
    milk = Material("milk", (1.0,) * 3, subsurface=Subsurface((1.0,) * 3, (0.2,) * 3))
    points, triangles = icosphere(2)
    ball, sun, shares = checked("ball", points, triangles, materials=(milk,)), parse_lighting(SUN), []
    for seed in range(8):
        walks = 16 if quick else 256
        config = configured(
            {
                "seed": seed,
                "atlas": {"resolution": 24},
                "points": {"on": "hull", "count": 4, "supersample": 1},
                "transport": {"samples": walks, "test_samples": walks, "threads": 2},
            }
        )
        data = ddprt.bake(ball, {split: [sun] for split in ("train", "validation", "test")}, config=config)
        falls, leaves = (data.area @ data.maps(kind, data.split("test"))[0].astype(float) for kind in ("direct", "indirect"))
        shares.append(leaves.sum() / falls.sum())
    return compared(np.mean(shares), 1.0, np.std(shares, ddof=1) / math.sqrt(len(shares)))


def probes(quick: bool) -> Figure:
    """In a closed sphere of albedo a about a lamp: a / (1 - a) of its light from all sides, and no other harmonic."""
    albedo, rays = 0.5, 1 << 12 if quick else 1 << 16
    scene = ddprt.load_scene("furnace", albedo=albedo, subdivisions=4)
    lamp = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]})
    config = configured(
        {
            "atlas": {"resolution": 32 if quick else 64},
            "points": {"count": 8, "supersample": 1},
            "transport": {"samples": 64, "test_samples": 256 if quick else 4096, "threads": 2},
            "probes": {"grid": [2, 2, 2], "rays": rays, "region_low": [0.3] * 3, "region_high": [0.7] * 3},
        }
    )
    data = ddprt.bake(scene, {split: [lamp] for split in ("train", "validation", "test")}, config=config)
    layer, test = read_layer(data, "probes"), data.split("test")
    found, noise = (read_light(data, layer, test, kind)[0, ..., 0].astype(float) for kind in ("light", "noise"))
    expected = np.zeros(found.shape)
    expected[:, 0] = math.sqrt(4 * math.pi) * albedo / (1 - albedo) * 4 * math.pi / scene.areas.sum()
    return compared(found, expected, noise, unit=expected[0, 0])


def scattered_once(height: float, free: float, albedo: float, g: float) -> float:
    """Irradiance of a place that faces a lamp of 1 W/sr, by fog without an end that scatters once.

    Along each ray in the angle that the lamp sees it under, so that its singularity is gone.
    """

    def part(angle: float, theta: float) -> float:
        foot, beside = height * np.cos(theta), height * np.sin(theta)
        along, far = foot + beside * np.tan(angle), beside / np.cos(angle)
        cosine = -np.sin(angle)  # between the ray and the way from there to the lamp
        phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
        return float(2 * np.pi * np.cos(theta) * np.sin(theta) / beside * albedo / free * np.exp(-(along + far) / free) * phase)

    ends = lambda theta: theta - np.pi / 2  # noqa: E731  # where the ray begins
    return float(integrate.dblquad(part, 1e-9, np.pi / 2, ends, lambda _: np.pi / 2 - 1e-9, epsabs=1e-7)[0])


def fog(quick: bool) -> Figure:
    """A lamp half a metre over the floor of a black room whose walls are ten free paths and more away: light scattered once."""
    half, free, share, g = np.array([-HALF, HALF]), (1.0, 0.7, 0.4), (1.0, 0.8, 0.5), 0.3
    room = faceted("room", hollow(np.ones((1, 1, 1), bool), half, half, half), (Material("black", (0.0,) * 3),))
    scene, lamp = replace(room, fog=Fog(free, share, g)), parse_lighting({**POINT, "position": [0.0, 0.5 - HALF, 0.0]})
    tracer = Tracer.of(scene, 2)
    start = on_points(tracer, np.array([[0.0, -HALF, 0.0]]), np.array([UP]))
    found = trace_reference(tracer, scene, lamp, start, 1, 1 << (14 if quick else 20), seed=0, bounces=1)
    expected = [scattered_once(0.5, *of, g) for of in zip(free, share, strict=True)]
    return compared(found.indirect[0], expected, np.sqrt(found.indirect_variance[0]))


def hair(quick: bool) -> Figure:
    """White fur under a white sky of radiance 1: pi leaves every fibre, of which what the sky sends there straight is direct.

    The sum over all texels; its error is that of eight runs.
    """
    from ddprt.transport.gather import Receivers
    from ddprt.transport.hair import Hair
    from ddprt.transport.openness import build_open_atlas
    from ddprt.transport.paths import trace_paths
    from ddprt.transport.walk import starts

    fur = build("furball", strands=100, subdivisions=1)
    assert fur.tubes is not None
    fur = replace(fur, tubes=replace(fur.tubes, colour=np.ones_like(fur.tubes.colour)))
    fur = fur.made_of(lambda material: replace(material, albedo=(1.0,) * 3))
    tracer = Tracer.of(fur, 2)
    atlas, _ = build_open_atlas(tracer, fur, 48)
    strands, samples, runs = Hair.of(tracer, fur), 64 if quick else 1024, []
    with tempfile.TemporaryDirectory() as folder:
        write_exr(Path(folder) / "white.exr", np.ones((4, 8, 3), np.float32))
        sky = parse_lighting({"type": "environment", "image": str(Path(folder) / "white.exr")})
        for run in range(8):
            light = np.zeros((1, atlas.count, 3), np.float32)
            for _ in trace_paths(tracer, fur, atlas, [sky], light, samples=samples, seed=0, stream=f"run {run}"):
                pass
            straight, receivers = 0.0, Receivers.texels(atlas, samples, 0, f"run {run} paths")
            for tile in receivers.tiles():
                for (origins, directions, owner), triangle in starts(tracer, receivers, tile):
                    weight = strands.begun(origins, directions, triangle)[0]
                    escaped = tracer.first(origins, directions)[0] < 0
                    straight += float(weight[escaped] @ atlas.area[tile][owner[escaped]]) / samples
            runs.append((light[0, :, 0].astype(float) @ atlas.area / np.pi + straight) / atlas.area.sum())
    return compared(np.mean(runs), 1.0, np.std(runs, ddof=1) / math.sqrt(len(runs)))


# --- what moves ----------------------------------------------------------------------------------------------------------


def animation(quick: bool) -> Figure:
    """A ball that has rolled and gone away, seen from inside: its points ride along, and light is a / (1 - a) as before."""
    ball, turn = build("furnace", albedo=0.5, subdivisions=3), 1.1
    cosine, sine = math.cos(turn), math.sin(turn)
    moved = posed(ball, ball.positions @ [[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]] + [3.0, -1.0, 2.0], "rolled")
    lamp = {"type": "point", "position": [3, -1, 2], "intensity": [1, 1, 1]}
    riders = place_riders(ball, 256, seed=0, atlas=build_atlas(ball, 64)).at(moved.corners)
    found, error = light_at(moved, lamp, riders.position, riders.normal, 400 if quick else 6400, part=1)
    return compared(found.mean(), 4 * math.pi / ball.areas.sum(), np.linalg.norm(error) / len(error))


FIGURES: dict[str, Callable[[bool], Figure]] = {
    "diffuse bounces": bounces,
    "point lights": point,
    "spot lights": spot,
    "directional lights": directional,
    "rect lights": rect,
    "sphere lights": sphere,
    "environment lights": environment,
    "mesh lights": mesh,
    "gloss": gloss,
    "cut-outs": cutouts,
    "two-sided sheets": two_sided,
    "emission": emission,
    "subsurface": subsurface,
    "hair": hair,
    "fog": fog,
    "probes": probes,
    "animation": animation,
}
"""What tells of each effect that it is right. A new effect is one entry more, or the experiment and its test fail."""
