"""Which activation do networks on coefficients of light want?

Question: how do the error on held-out lightings and the three kinds of networks hang on the activation between their layers?
Command:  python experiments/activations.py [--seeds 3] [--scenes cornell corridor statue]
Answer:   docs/rivals.md
"""

import argparse
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import ddprt
from ddprt.config import checked
from ddprt.dataset.store import Dataset
from ddprt.methods import learned, neural_lightmap
from ddprt.report.metrics import Truth

SETTINGS = {
    "atlas": {"resolution": 48},
    "points": {"count": 64},
    "lightings": {"train": 64, "validation": 16, "test": 32},
    "transport": {"target_noise": 0.01},
}
LIGHTINGS: dict[str, dict[str, Any]] = {
    "cornell": {"region_low": [0.1, 0.5, 0.1], "region_high": [0.9, 0.8, 0.9], "clearance": 0.1},
    "corridor": {},
    "statue": {"distribution": "around", "kinds": ["point", "directional"]},
}
METHODS = ("mlp", "residual", "neural-lightmap")
ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "gated": learned.gated,
    "SiLU": jax.nn.silu,
    "GELU": jax.nn.gelu,
    "ReLU": jax.nn.relu,
}


def bake(scene: str) -> Dataset:
    lightings = {**SETTINGS["lightings"], **LIGHTINGS[scene]}
    return ddprt.bake(ddprt.load_scene(scene), config=checked({**SETTINGS, "scene": {"name": scene}, "lightings": lightings}))


def error(data: Dataset, method: str, seed: int) -> float:
    """Relative RMSE over held-out lightings."""
    test = data.split("test")
    truth, model = Truth(data.maps("indirect", test), data.area), ddprt.fit(data, method, seed=seed)
    missed = model.predict(data.values(test, model.points, "radiosity")) - truth.reference
    return float(truth.relative_rmse(missed) or 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scenes", nargs="+", choices=LIGHTINGS, default=list(LIGHTINGS))
    chosen = parser.parse_args()
    print("| scene, method | " + " | ".join(ACTIVATIONS) + " |\n| --- |" + " --- |" * len(ACTIVATIONS), flush=True)
    for scene in chosen.scenes:
        data = bake(scene)
        for method in METHODS:
            cells = []
            for activation in ACTIVATIONS.values():
                learned.gated = neural_lightmap.gated = activation  # what was compiled holds the one before
                jax.clear_caches()
                errors = [error(data, method, seed) for seed in range(chosen.seeds)]
                cells.append(f"{np.mean(errors):.4f} ± {np.std(errors):.4f}")
            print(f"| {scene}, {method} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
