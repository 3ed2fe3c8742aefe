"""Fur in numbers and pictures: what a bake takes, how well it is learned, and the ball lit from behind.

    python experiments/hair.py [--quick] [--bake] [--strands 1000 10000] [--samples 64] [--folder out]

Prints, by number of strands, seconds (by the clock, and of all cores together), memory and rays of the stages of a bake of 128
lightings, and, unless --bake asks for no more, the relative RMSE on held-out ones with 4, 16 and 64 bases, linear and gamma.
Writes hair-STRANDS.png: the ball lit from behind, from the side and from the camera; above as baked, direct and indirect light
together, in the middle its indirect light alone, below that as learned with 16 bases.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt import seeds
from ddprt.config import checked
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.lights import parse_lighting
from ddprt.machine import peak_memory_gib
from ddprt.progress import Progress
from ddprt.report.metrics import Truth
from ddprt.report.view import Camera, png, tonemap
from ddprt.scene.atlas import Atlas
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import centred, direct_irradiance
from ddprt.transport.embree import Tracer
from ddprt.transport.hair import Hair
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.paths import trace_paths
from ddprt.transport.shading import lamps_of, shade

RESOLUTION = {300: 96, 1000: 128, 10_000: 352, 140_000: 1216}
BASES, SPACES = (4, 16, 64), ("linear", "gamma")
LIGHTS = {"behind": (0.25, -0.35, 1.0), "side": (-1.0, -0.4, 0.15), "camera": (0.3, -0.5, -1.0)}  # where sunlight goes
PIXELS, WITHIN = 300, 6  # a side of a picture, and rays of a pixel along a side


def settings(strands: int, samples: int, quick: bool) -> dict[str, Any]:
    train, test = (24, 8) if quick else (128, 16)
    return {
        "atlas": {"resolution": RESOLUTION[strands]},
        "points": {"count": 128, "on": "hull", "supersample": 4},
        "lightings": {"train": train, "validation": 1, "test": test, "distribution": "around"},
        "transport": {"samples": samples, "test_samples": 4 * samples, "threads": 2},
    }


def learned(data: Dataset) -> dict[str, Any]:
    """Relative RMSE by space and bases, and the noise of what they are measured against."""
    test = data.split("test")
    truth = Truth(data.maps("indirect", test), data.area)
    noise = data.maps("noise", test)
    square = float((noise.astype(np.float64) ** 2 * data.area[None, :, None]).sum() / truth.squares.sum())
    found: dict[str, Any] = {"noise of held-out maps": round(square**0.5, 4)}
    for space in SPACES:
        for bases in BASES:
            model = ddprt.fit(data, bases=bases, space=space)
            predicted = np.stack([model.predict(value) for value in values_of(model, data, test)])
            error = float(truth.tally(predicted).error.sum() / truth.squares.sum()) ** 0.5
            found[f"{space} {bases}"] = round(error, 4)
    return found


def values_of(model: Any, data: Dataset, indices: list[int]) -> np.ndarray:
    """What the model measures."""
    return data.values(indices, model.points, "radiosity")


def pictures(scene: Scene, model: Any, samples: int) -> np.ndarray:
    """Three columns by light, three rows: all light, indirect light, indirect light as learned."""
    tracer = Tracer.of(scene, 2)
    atlas, _ = build_open_atlas(tracer, scene, RESOLUTION[len(scene.tubes.axis)])  # type: ignore[union-attr]
    records = [{"type": "directional", "direction": list(way), "irradiance": [3.0, 3.0, 3.0]} for way in LIGHTS.values()]
    lightings = [parse_lighting(record) for record in records]
    baked = np.zeros((len(lightings), atlas.count, 3), np.float32)
    for _ in trace_paths(tracer, scene, atlas, lightings, baked, samples=samples, seed=1, stream="picture"):
        pass
    columns = []
    for index, lighting in enumerate(lightings):
        ours = model.relight(records[index])[model.covered]
        columns.append(np.concatenate(seen(tracer, scene, atlas, lighting, (baked[index], ours))))
    return np.concatenate(columns, 1)


def seen(
    tracer: Tracer, scene: Scene, atlas: Atlas, lighting: Any, maps: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a camera sees: fibres by what they scatter towards it, and the maps."""
    camera, hair = Camera((0.0, 0.12, 0.34), (0.0, -0.012, 0.0), 38.0, 1.0), Hair.of(tracer, scene)
    side = PIXELS * WITHIN
    indirect, direct = np.zeros((2, side * side, 3)), np.zeros((side * side, 3))
    lamps = lamps_of(tracer, [lighting])
    rng, corners = seeds.stream(0, "camera"), atlas.uv * atlas.resolution
    for first in range(0, side * side, 1 << 16):
        pixel = np.arange(first, min(first + (1 << 16), side * side))
        places = (np.stack([pixel % side, pixel // side], 1) + rng.random((len(pixel), 2))) / side
        directions = camera.directions(places)
        origins = np.tile((np.array(camera.eye) - tracer.centre).astype(np.float32), (len(pixel), 1))
        triangle, u, v, distance = tracer.first(origins, directions)
        hit = triangle >= 0
        uv = np.einsum("nc,ncd->nd", np.stack([1 - u - v, u, v], 1)[hit], corners[triangle[hit]])
        column, row = np.clip(uv.astype(int), 0, atlas.resolution - 1).T
        texel = atlas.lookup[row, column]
        for which, light in enumerate(maps):
            indirect[which, pixel[hit]] = np.where(texel[:, None] >= 0, (light * atlas.albedo)[texel] / np.pi, 0)
        ones = np.ones((3, len(pixel)), np.float32)
        sums = np.zeros((1, len(pixel), 3))
        _, there = hair.met(triangle, u, v, directions, ones, np.arange(len(pixel), dtype=np.int32), distance)
        if there:
            shade(tracer, lamps, there.far, rng, sums)
        direct[pixel] = sums[0] / np.pi
        skin = np.flatnonzero(hit & (triangle < hair.first))
        normals = tracer.normals[triangle[skin]]
        where = tracer.on_triangle(triangle[skin], u[skin], v[skin])
        there_light = direct_irradiance(
            tracer, centred(tracer, lighting), where, normals, np.zeros((1, len(skin), 2), np.float32)
        )
        direct[pixel[skin]] = there_light * np.array(scene.materials[0].albedo) / np.pi
    images = (direct + indirect[0], indirect[0], indirect[1])
    return tuple(image.reshape(PIXELS, WITHIN, PIXELS, WITHIN, 3).mean((1, 3)) for image in images)  # type: ignore[return-value]


def main() -> None:
    """Bakes, fits and draws."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--bake", action="store_true")
    parser.add_argument("--strands", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--folder", type=Path, default=Path("out"))
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    for strands in asked.strands:
        scene, progress = build("furball", strands=strands), Progress()
        config, begun = checked(settings(strands, asked.samples, asked.quick)), (time.perf_counter(), time.process_time())
        data = bake(scene, config=config, out=asked.folder / f"hair-{strands}", progress=progress)
        row = {"strands": strands, "texels": len(data.area), "seconds": round(time.perf_counter() - begun[0], 1)}
        row["seconds of cores"] = round(time.process_time() - begun[1], 1)
        row["peak GiB"] = peak_memory_gib()
        print(json.dumps(row | {"stages": progress.stages}), flush=True)
        if asked.bake:
            continue
        print(json.dumps(learned(data)), flush=True)
        image = tonemap(pictures(scene, ddprt.fit(data, bases=16), 4 * asked.samples), 1.0)
        path = asked.folder / f"hair-{strands}.png"
        path.write_bytes(png(np.concatenate([image, np.ones((*image.shape[:2], 1))], 2)))
        print(path, flush=True)


if __name__ == "__main__":
    main()
