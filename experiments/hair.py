"""Fur in numbers and pictures: what a bake takes, how well it is learned, and the ball lit from behind.

    python experiments/hair.py [--quick] [--strands 1000 10000] [--folder FOLDER]

Prints, by number of strands, seconds and rays of the stages of a bake of 128 lightings, and the relative RMSE on held-out ones with
4, 16 and 64 bases, linear and gamma; writes FOLDER/hair-STRANDS.png: the ball lit from behind, from the side and from the camera,
direct and indirect light together, each pixel by one path of many.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt.config import checked
from ddprt.dataset.generate import bake
from ddprt.report.drawing import png
from ddprt.scene.library import build
from ddprt.transport.embree import Tracer

RESOLUTION = {300: 96, 1000: 128, 10_000: 352, 140_000: 1216}
BASES, SPACES = (4, 16, 64), ("linear", "gamma")


def settings(strands: int, quick: bool, samples: int) -> dict[str, Any]:
    train, test = (24, 8) if quick else (128, 16)
    return {
        "atlas": {"resolution": RESOLUTION[strands]},
        "points": {"count": 128, "on": "hull", "supersample": 4},
        "lightings": {"train": train, "validation": 1, "test": test, "distribution": "around"},
        "transport": {"samples": samples, "test_samples": 4 * samples, "threads": 2},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--strands", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--folder", type=Path, default=Path("out"))
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    for strands in asked.strands:
        scene = build("furball", strands=strands)
        config = checked(settings(strands, asked.quick, asked.samples))
        begun, rays = time.perf_counter(), Counted()
        data = bake(scene, config=config, out=asked.folder / f"hair-{strands}", progress=rays)
        took = time.perf_counter() - begun
        print(json.dumps({"strands": strands, "texels": len(data.area), "seconds": round(took, 1), "stages": rays.told}))
    print("done")


if __name__ == "__main__":
    main()
