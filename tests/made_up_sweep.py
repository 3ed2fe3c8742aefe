"""Records of a sweep that nobody measured, for tests of what is drawn from them; run it to see the page that they make."""

import math
import sys
from typing import Any

import numpy as np

from ddprt.bench.frontier.page import BASE, Sweep, write_all

KNOBS: dict[str, tuple[Any, ...]] = {
    "fit.bases": (2, 4, 8, 32, 64),
    "fit.points": (16, 32, 64),
    "fit.ridge": (0.0, 1e-4, 1e-2),
    "fit.space": ("gamma",),
    "fit.centre": ("mean",),
    "fit.method": ("mean", "nearest", "mlp"),
    "export.precision": ("float",),
    "lightings.train": (16, 32, 64, 256),
    "transport.target_noise": (0.005, 0.02, 0.04, 0.08),
    "transport.sender_resolution": (32, 64, 128),
    "transport.bounces": (1, 2, 4),
    "points.supersample": (1, 2, 4, 16),
    "atlas.resolution": (64, 96, 192, 512),
}


def example(changes: dict[str, Any], order: int) -> dict[str, Any]:
    """An invented record, shaped as a sweep's own; its numbers are made up by rules of thumb, not measured."""
    rng = np.random.default_rng(order)
    jitter = lambda: float(np.exp(0.04 * rng.standard_normal()))  # noqa: E731
    at = {"fit.bases": 16, "fit.points": 128, "fit.ridge": "auto", "fit.space": "linear", "fit.centre": "none"}
    at |= {"fit.method": "svd-ridge", "export.precision": "half", "lightings.train": 128, "transport.target_noise": 0.01}
    at |= {"transport.sender_resolution": 96, "transport.bounces": 7, "points.supersample": 8, "atlas.resolution": 256}
    at |= changes
    bases, texels, method = at["fit.bases"], 0.8 * at["atlas.resolution"] ** 2, at["fit.method"]
    projection = 0.11 * (4 / bases) ** 0.75
    squares = projection**2 + (0.9 / at["fit.points"]) ** 2 * 4 + (1.1 / at["lightings.train"]) ** 2 + 2e-5
    squares += (
        at["transport.target_noise"] ** 2
        + (0.6 / at["transport.sender_resolution"]) ** 2
        + (0.01 * 8 / at["points.supersample"]) ** 2 / 8
    )
    squares += (2.2 / at["atlas.resolution"]) ** 2 + (0.5 ** at["transport.bounces"] * 0.4) ** 2
    squares *= {"linear": 1.0, "gamma": 0.86}[at["fit.space"]] * {"none": 1.0, "mean": 1.04}[at["fit.centre"]]
    squares *= 1.0 if at["fit.ridge"] == "auto" else {0.0: 2.4, 1e-4: 1.05, 1e-2: 1.3}[at["fit.ridge"]]
    error = math.sqrt(squares) * {"svd-ridge": 1.0, "mean": 9.0, "nearest": 5.0, "mlp": 0.8}[method]
    bake = (3 + 90 * texels / 5e4 * (0.01 / at["transport.target_noise"]) ** 2 / 10 + 0.02 * at["lightings.train"]) * jitter()
    fit = (
        (0.02 + 2e-9 * texels * at["lightings.train"] ** 2)
        * {"mean": 0.1, "nearest": 0.3, "mlp": 160}.get(method, 1.0)
        * jitter()
    )
    frame = (1.2e-5 + 2.4e-10 * texels * (1 if method == "mean" else bases)) * (3 if method == "mlp" else 1) * jitter()
    if at["fit.space"] == "gamma":
        frame *= 3.1
    size = int(texels * 3 * (1 if method == "mean" else bases) * (4 if at["export.precision"] == "float" else 2))

    def timing(seconds: float, compile_seconds: float, repeats: int) -> dict[str, Any]:
        low, high = seconds * (1 - 0.02 * jitter()), seconds * (1 + 0.06 * jitter())
        return {"median": seconds, "low": low, "high": high, "compile": compile_seconds, "repeats": repeats}

    flip = None if order % 17 == 5 else 0.9 * error * jitter()
    scores = {
        "relative_rmse": error,
        "relative_mse": error**2 * 1.7,
        "psnr_db": -20 * math.log10(error) + 14,
        "pu21_psnr_db": -20 * math.log10(error) + 21 + 0.3 * jitter(),
        "flip": flip,
        "flip_reason": "the scene has no camera" if flip is None else "",
        "energy_bias": -0.1 * error,
        "median_lighting_relative_rmse": 0.7 * error,
        "p90_lighting_relative_rmse": 1.6 * error,
        "worst_lighting_relative_rmse": 3.2 * error * jitter(),
        "negative_share": 0.002,
        "flicker": 0.0 if method == "mean" else 0.2 * error * jitter(),
        "unseen_lightings": 0,
    }
    name = ", ".join(f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {value}" for key, value in changes.items())
    linear = method == "svd-ridge"
    return {
        "schema": 1,
        "digest": f"{order + 10:012x}",
        "digest_bake": f"{order:012x}",
        "name": name or BASE,
        "changes": changes,
        "failed": None,
        "scores": scores,
        "floors": {"noise_relative_rmse": 0.004, "projection_relative_rmse": projection if linear else None},
        "bake": {"seconds": bake, "stages": {"direct": 0.2 * bake, "indirect train": 0.7 * bake}, "rays": int(2e6 * bake),
                 "bytes": int(400 * texels), "peak_gib": 0.4 + texels / 2e5},
        "fit": {**timing(fit, 0.8, 5), "peak_gib": 0.3 * jitter()},
        "frame": timing(frame, 0.11, 100),
        "batch": {**timing(9 * frame, 0.13, 5), "frames": 16},
        "coefficients": timing(4e-6 * jitter(), 0.0, 100) if linear else None,
        "bytes": size,
        "flops": int(6 * texels * bases),
        "bases": bases,
        "method": method,
        "status": "ok" if bases < 64 else "rank_deficient",
        "remarks": [],
        "config": f'[scene]\nname = "cornell"\n\n[fit]\nbases = {bases}\nmethod = "{method}"\n',
        "environment": {"ddprt": "0.1.0", "commit": "9b11239", "when": f"2026-11-22T11:{order % 60:02d}:00+00:00",
                        "machine": {"processor": "Example CPU", "cores": 2, "memory_gib": 8.0, "system": "Linux x86_64",
                                    "python": "3.11.7", "packages": {"numpy": "2.3.5", "jax": "0.10.0"}}},
    }  # fmt: skip


def failure(order: int, name: str = "atlas.resolution = 4096", why: str = "got too little memory; lower it") -> dict[str, Any]:
    record = example({}, order)
    kept = {key: record[key] for key in ("schema", "digest", "digest_bake", "config", "environment")}
    return {**kept, "name": name, "changes": {"atlas.resolution": 4096}, "failed": why}


def examples() -> list[dict[str, Any]]:
    """A sweep of every knob on its own, one setting of two, and one that failed."""
    ways = [{}, *({key: value} for key, values in KNOBS.items() for value in values)]
    ways += [{"fit.bases": 64, "lightings.train": 256}]
    return [*(example(changes, order) for order, changes in enumerate(ways)), failure(900)]


def bent(places: list[tuple[float, float]]) -> Sweep:
    """Settings with given bake seconds and errors."""
    records = []
    for order, (cost, error) in enumerate(places):
        record = example({} if order == 0 else {"fit.bases": order}, order)
        record["bake"] = {**record["bake"], "seconds": cost}
        record["scores"] = {**record["scores"], "relative_rmse": error}
        records.append(record)
    return Sweep(records)


if __name__ == "__main__":
    for made in write_all(sys.argv[1], examples(), title="EXAMPLE (invented numbers)"):
        print(made)
