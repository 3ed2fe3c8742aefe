"""What light inside a statue costs: seconds of a bake against the error on the statue, marble and forced opaque.

Question: how many times the diffuse bake is that of a translucent statue, at equal error?
Command:  python experiments/marble_cost.py [--resolution 256] [--lightings 128]    two minutes
Answer:   docs/effects.md, "Subsurface scattering"

Errors are those of 32 training maps on the statue's own texels against many more samples, over their mean; seconds are of a
bake without its one held-out map. The last line is JSON.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt.config import checked
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.progress import Progress
from ddprt.transport.effects import force

SAMPLES = {"opaque": (48, 96, 192, 4096), "marble": (112, 224, 448, 2048)}  # the last for what is compared with
COMPARED = 32


def main() -> None:
    """Bakes the same lightings with ever more samples."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--lightings", type=int, default=128)
    asked = parser.parse_args()
    marble = ddprt.load_scene("statue-marble")
    scenes = {"opaque": force(marble, off=("subsurface",)), "marble": marble}

    def baked(name: str, samples: int, seed: int, folder: Path) -> tuple[Dataset, float]:
        document: dict[str, Any] = {
            "seed": seed,
            "atlas": {"resolution": asked.resolution},
            "points": {"count": 64, "on": "hull"},
            "lightings": {"train": asked.lightings, "validation": 1, "test": 1, "distribution": "around", "kinds": ["point"]},
            "transport": {"samples": samples, "test_samples": 8},
        }
        progress, config = Progress(quiet=True), checked(document)
        data = bake(scenes[name], split, config=config, out=folder / f"{name}-{samples}-{seed}", progress=progress)
        return data, sum(stage["seconds"] for stage in progress.stages if "test" not in stage["name"])

    found: dict[str, list[dict[str, float]]] = {name: [] for name in scenes}
    with tempfile.TemporaryDirectory() as scratch:
        split: Any = None
        drawn, _ = baked("marble", 16, 0, Path(scratch))
        inside, lightings = np.asarray(drawn.exitant), [*drawn.lightings]
        split = {"train": lightings[:-2], "validation": lightings[-2:-1], "test": lightings[-1:]}
        for name, (*tried, many) in SAMPLES.items():
            baked(name, 16, 1, Path(scratch))  # compiles
            truth = light(baked(name, many, 2, Path(scratch))[0], inside)
            for samples in tried:
                data, seconds = baked(name, samples, 1, Path(scratch))
                error = float(np.sqrt(np.mean((light(data, inside) - truth) ** 2)) / truth.mean())
                found[name].append({"samples": samples, "seconds": round(seconds, 2), "error": round(error, 4)})
                print(name, found[name][-1], flush=True)
    print(json.dumps(found))


def light(data: Dataset, inside: np.ndarray) -> np.ndarray:
    """Some maps on the statue."""
    return data.maps("indirect", data.split("train")[:COMPARED])[:, inside].astype(np.float64)


if __name__ == "__main__":
    main()
