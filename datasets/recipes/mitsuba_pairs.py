"""Renders pairs of direct and indirect light of Mitsuba's Cornell box, as `ddprt import` takes them.

    pip install mitsuba        # and a libLLVM of 16 or later; DRJIT_LIBLLVM_PATH says where it is
    python datasets/recipes/mitsuba_pairs.py FOLDER
    ddprt import FOLDER --out runs/mitsuba --direct 'pairs/*.exr' --indirect 'pairs/*.exr' --quantity irradiance
    ddprt run runs/mitsuba/config.toml

The maps are pictures of a view: irradiance E (W/m², before albedo) where the middle of each pixel meets the room. Direct light
is one shadow ray; indirect light is the mean of cosine-weighted paths from there, times pi: they never meet a point light, and
so bring what has touched something. Each EXR holds two layers, direct.R to indirect.B; position, normal, albedo and mask lie
beside them. To render your own scene, load it in `room` and draw lights in `lamps`.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")


def room(side: int) -> dict[str, Any]:
    """The scene without its lamp."""
    scene: dict[str, Any] = mi.cornell_box()
    del scene["light"]
    scene["sensor"]["film"] |= {"width": side, "height": side, "rfilter": {"type": "box"}}
    return scene


def lamps(count: int) -> np.ndarray:
    """Places of point lights in the upper half of the box, each of 1 W/sr."""
    return np.random.default_rng(1).uniform([-0.6, 0.3, -0.6], [0.6, 0.7, 0.6], (count, 3))


def main() -> None:
    """Reads the command line and renders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lightings", type=int, default=40)
    parser.add_argument("--resolution", type=int, default=48)
    parser.add_argument("--samples", type=int, default=128)
    given = parser.parse_args()
    side, places = given.resolution, lamps(given.lightings)
    (given.folder / "pairs").mkdir(parents=True, exist_ok=True)
    with (given.folder / "lights.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["name", "type", "x", "y", "z", "r", "g", "b"])
        table.writerows([f"{index:03d}", "point", *place, 1, 1, 1] for index, place in enumerate(places.tolist()))
    integrator = mi.load_dict({"type": "path", "max_depth": -1, "hide_emitters": True})
    for index, place in enumerate(places.tolist()):
        light = {"type": "point", "position": place, "intensity": {"type": "rgb", "value": 1.0}}
        scene = mi.load_dict({**room(side), "light": light})
        surface, count = seen(scene, side), side * side
        if index == 0:
            gbuffer(given.folder, surface, side)
        towards = mi.Point3f(place) - surface.p
        distance = dr.norm(towards)
        cosine = dr.maximum(dr.dot(surface.n, towards / distance), 0)
        lit = surface.is_valid() & ~scene.ray_test(surface.spawn_ray_to(mi.Point3f(place)))
        direct = np.repeat(np.array(dr.select(lit, cosine / distance**2, 0))[:, None], 3, 1)
        total = np.zeros((count, 3))
        sampler = mi.load_dict({"type": "independent"})
        for turn in range(given.samples):
            sampler.seed(index * given.samples + turn, count)
            away = surface.sh_frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
            found, _, _ = integrator.sample(
                scene, sampler, mi.RayDifferential3f(surface.spawn_ray(away)), None, surface.is_valid()
            )
            total += np.nan_to_num(np.array(found).reshape(3, -1).T)
        indirect = np.pi * total / given.samples * np.array(surface.is_valid())[:, None]
        write(given.folder / "pairs" / f"{index:03d}.exr", side, {"direct": direct, "indirect": indirect})
        print(f"{index + 1} of {len(places)}: mean direct {direct.mean():.4f}, indirect {indirect.mean():.4f}", flush=True)


def seen(scene: Any, side: int) -> Any:
    """What the middle of each pixel meets, rows from the top, with normals towards the eye."""
    index = dr.arange(mi.UInt32, side * side)
    middle = mi.Point2f((mi.Float(index % side) + 0.5) / side, (mi.Float(index // side) + 0.5) / side)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, middle, mi.Point2f(0.5))
    surface = scene.ray_intersect(ray)
    surface.n = dr.select(dr.dot(surface.n, ray.d) > 0, -surface.n, surface.n)
    surface.sh_frame = mi.Frame3f(surface.n)
    return surface


def gbuffer(folder: Path, surface: Any, side: int) -> None:
    """Positions, normals and albedo."""
    there = np.array(surface.is_valid())[:, None]
    parts = {"position": surface.p, "normal": surface.n, "albedo": surface.bsdf().eval_diffuse_reflectance(surface)}
    for name, values in parts.items():
        image = np.array(values).reshape(3, -1).T * there
        write(folder / f"{name}.exr", side, {"": np.minimum(image, 1) if name == "albedo" else image})
    write(folder / "mask.exr", side, {"": np.repeat(there, 3, 1)})


def write(path: Path, side: int, layers: dict[str, np.ndarray]) -> None:
    """A multi-channel EXR, three channels a layer."""
    names = [f"{layer}.{channel}" if layer else channel for layer in layers for channel in "RGB"]
    pixels = np.concatenate(list(layers.values()), 1).reshape(side, side, -1).astype(np.float32)
    mi.Bitmap(np.ascontiguousarray(pixels), mi.Bitmap.PixelFormat.MultiChannel, names).write(str(path))


if __name__ == "__main__":
    main()
