"""Glossy receivers: what an order of harmonics loses of what leaves a glossy surface, and how well few bases answer for it.

Question: which order is each roughness worth, and how large is the error at 16 and at 64 bases, for the glossy room under its
          lamps and for a glossy lion under sun and sky, for the lightmap and for what the eye sees on the glossy texels?
Command:  python experiments/glossy_receivers.py [projection|bases]     (both by default)
Answer:   docs/effects.md, "Gloss"

Projection: f is radiance towards every direction, mirrored at the surface's plane. What an order leaves out is the mean square
of the coefficients above it, up to order 16, and that a mean of products of two independent estimates, so that noise does not
count; a lobe of roughness below 0.3 has more above order 16. Errors are shares of mean radiance, texels by their glossy area.

Bases: held-out lightings. "noise" is what the held-out light itself is uncertain by, "floor" what the best coefficients on the
basis leave: both are in the error.
"""

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import ddprt
from ddprt import seeds
from ddprt.config import checked
from ddprt.dataset.store import Dataset
from ddprt.harmonics import count
from ddprt.lights import Lighting, parse_lighting
from ddprt.report.layers import layer_scores
from ddprt.report.metrics import Truth
from ddprt.scene.atlas import build_atlas
from ddprt.scene.library import build
from ddprt.scene.material import Gloss
from ddprt.scene.mesh import Scene
from ddprt.transport import exitant
from ddprt.transport.direct import Texels
from ddprt.transport.effects import force
from ddprt.transport.embree import Tracer
from ddprt.transport.paths import trace_paths
from ddprt.transport.reflected import Lit

ROUGHNESS = (0.15, 0.25, 0.35, 0.45, 0.6, 0.8, 1.0)
SHOWN, WIDE = (0, 2, 4, 6, 8, 12), 16
PATHS = 1024  # of each texel, twice
BASES = (16, 64)
COUNTS = {"train": 96, "validation": 8, "test": 12}
LAMPS = [
    parse_lighting(light)
    for light in (
        {"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]},
        {"type": "point", "position": [0.45, 0.4, 0.45], "intensity": [1, 1, 1]},
        {"type": "point", "position": [0.1, 0.35, 0.4], "intensity": [1, 1, 1]},
    )
]
GREEN = 1


def coated(scene: Scene, part: Gloss, name: str = "gilt") -> Scene:
    """The scene with another finish of one material."""
    return force(scene.made_of(lambda entry: replace(entry, gloss=part) if entry.name == name else entry), on=["gloss"])


def projection(roughness: float) -> list[float]:
    """Relative RMSE that each order leaves, of a metal vase under three lamps."""
    scene = coated(build("glossy-room"), Gloss(roughness, 1.0))
    tracer, atlas, fine = Tracer.of(scene), build_atlas(scene, 32), build_atlas(scene, 128)
    texels, light = Texels.of(tracer, fine, 4, np.random.default_rng(0)), np.zeros((len(LAMPS), fine.count, 3), np.float32)
    list(trace_paths(tracer, scene, fine, LAMPS, light, samples=64, seed=0, stream="shown"))
    light += np.stack([texels.irradiance(lamp, np.random.default_rng(1)) for lamp in LAMPS])
    lit = Lit.of(tracer, scene, fine, LAMPS, np.ascontiguousarray(light.transpose(1, 2, 0)))
    exits = exitant.Exits.of(scene, atlas, exitant.order_for(roughness))
    wide, runs = replace(exits, order=WIDE), []
    for run in range(2):
        out = np.zeros((len(LAMPS), exits.count * count(wide.order), 3), np.float32)
        list(exitant.trace_exitant(lit, wide, out, samples=PATHS, seed=0, stream=f"projection {run}"))
        runs.append(out.reshape(len(LAMPS), exits.count, -1, 3)[..., GREEN].astype(float))
    share = exits.weight / exits.weight.sum()
    bands = np.einsum("lpk,lpk,p->k", *runs, share) / len(LAMPS)
    mean = float(np.einsum("lpk,p->k", runs[0] + runs[1], share)[0]) / 2 / len(LAMPS)
    return [float(np.sqrt(max(bands[count(order) :].sum(), 0)) / mean) for order in SHOWN]


def lamps(scene: Scene, total: int) -> None:
    """The lamps that a configuration draws."""


def skies(scene: Scene, total: int) -> list[Lighting]:
    """A sky that is turned at random, and a sun from anywhere above."""
    found = []
    for index in range(total):
        rng = seeds.stream(0, "sun and sky", index)
        turn, height = rng.uniform(0, 360), rng.uniform(0.1, 1)
        flat, side = np.sqrt(1 - height**2), rng.uniform(0, 2 * np.pi)
        sky = {"type": "environment", "image": "sun-sky", "rotation_deg": turn, "scale": rng.uniform(0.3, 1)}
        sun = {
            "type": "directional",
            "direction": [flat * np.cos(side), -height, flat * np.sin(side)],
            "irradiance": [3.0, 2.8, 2.5],
        }
        found.append(parse_lighting([sky, sun]))
    return found


SCENES: dict[str, tuple[Callable[[], Scene], Callable[[Scene, int], list[Lighting] | None], int, int]] = {
    "glossy-room, roughness 0.25": (lambda: build("glossy-room"), lamps, 32, 512),
    "glossy-room, roughness 0.5": (lambda: build("glossy-room", roughness=0.5), lamps, 32, 512),
    "lion, metal, sun and sky": (lambda: coated(build("lion", cells=36), Gloss(0.5, 1.0), "fur"), skies, 48, 128),
    "lion, glazed, sun and sky": (lambda: coated(build("lion", cells=36), Gloss(0.5, 0.0), "fur"), skies, 48, 128),
}
"""Scene, lightings (None: drawn), texels a side, paths of each."""


def baked(name: str) -> Dataset:
    """A scene under its lightings."""
    make, light, resolution, paths = SCENES[name]
    scene = make()
    drawn = light(scene, sum(COUNTS.values()))
    ends = np.cumsum(list(COUNTS.values()))
    splits = drawn and {split: drawn[end - COUNTS[split] : end] for split, end in zip(COUNTS, ends, strict=True)}
    config = checked(
        {
            "atlas": {"resolution": resolution},
            "lightings": {
                **COUNTS,
                "region_low": [0.1, 0.5, 0.1],
                "region_high": [0.9, 0.8, 0.9],
                "clearance": 0.1,
            },
            "points": {"count": 96, "supersample": 4},
            "transport": {"samples": paths, "test_samples": 2 * paths},
        }
    )
    folder = Path(tempfile.gettempdir()) / "ddprt-glossy-receivers" / name.replace(" ", "-")
    return ddprt.bake(scene, splits, config=config, out=folder)


def bases(name: str) -> None:
    """A row for each number of bases: the lightmap, and each layer."""
    data = baked(name)
    test = data.split("test")
    truth = Truth(data.maps("indirect", test), data.area)
    noise = truth.relative_rmse(data.maps("noise", test)) or 0.0
    for number in BASES:
        model = ddprt.fit(data, bases=number)
        light = model.predict(data.values(test, model.points, model.quantity), lightings=[data.lightings[i] for i in test])
        error = truth.relative_rmse(light - truth.reference) or 0.0
        print(f"| {name} | {number} | lightmap | {100 * error:.1f} % | {100 * noise:.1f} % | - |")
        for layer, scores in layer_scores(data, model).items():
            found = (scores["relative_rmse"], scores["noise_relative_rmse"], scores["projection_relative_rmse"])
            print(f"| {name} | {number} | {layer} | {' | '.join(f'{100 * value:.1f} %' for value in found)} |", flush=True)


def main(*parts: str) -> None:
    if "projection" in parts or not parts:
        print(f"| roughness | order taken | {' | '.join(f'order {order}' for order in SHOWN)} |")
        for roughness in ROUGHNESS:
            errors = projection(roughness)
            row = " | ".join(f"{100 * error:.1f} %" for error in errors)
            print(f"| {roughness} | {exitant.order_for(roughness)} | {row} |", flush=True)
    if "bases" in parts or not parts:
        print("| scene | bases | of | error | noise | floor |")
        for name in SCENES:
            bases(name)


if __name__ == "__main__":
    main(*sys.argv[1:])
