"""What shadows that cross measurement points do to a lamp's path, and what supersampled points save: the paper's Figure 4.

Question: how unsteady is relit light while a lamp moves in small steps, beyond what its true light does?
Command:  python experiments/flicker.py [BAKES PER ROW]     minutes; writes docs/flicker.png
Answer:   docs/stability.md

A lamp passes above the blocks of the Cornell box, 3 mm per frame, so that shadow edges sweep over floor, walls and blocks. A
measurement of one sample jumps when an edge crosses it; the mean of n samples jumps n times as often by an nth, which should
leave 1 / sqrt(n). Flicker is `Truth.flicker`: jitter of the relit light minus the reference, over the reference's mean. The
reference has some jitter of its own, since its direct light is sampled as well; below that nothing is measured. Bakes differ
in everything that is random: points, training lamps and gather rays.
"""

import sys
from pathlib import Path

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.lights import PointLight
from ddprt.report.metrics import Truth, jitter
from ddprt.sampling.lightings import draw_lightings
from ddprt.transport.embree import Tracer

SUPERSAMPLES, POINTS, BASES, FRAMES, STEP = (1, 2, 4, 8, 16), 128, 16, 121, 0.003
SPACES = {"linear": {}, "gamma 2.2": {"space": "gamma"}}


def main(bakes: str = "3") -> None:
    scene = ddprt.load_scene("cornell")
    tracer = Tracer.of(scene)
    path = [(PointLight(position=(0.1 + STEP * f, 0.45, 0.28), intensity=(1.0, 1.0, 1.0)),) for f in range(FRAMES)]
    flicker: dict[str, list[list[float]]] = {name: [[] for _ in SUPERSAMPLES] for name in SPACES}
    own, curves = [], {}
    for seed in range(int(bakes)):
        for row, supersample in enumerate(SUPERSAMPLES):
            changes = {"seed": str(seed), "atlas.resolution": "64", "points.count": str(POINTS)}
            changes |= {"points.supersample": str(supersample), "lightings.region_low": "[0.0, 0.65, 0.0]"}
            changes |= {"transport.samples": "512", "transport.test_samples": "512", "transport.direct_samples": "64"}
            config = load_config(None, changes)
            splits = {
                split: draw_lightings(
                    config.lightings, split, count, bounds=scene.bounds, clearance=tracer.clearance, seed=seed
                ).lightings
                for split, count in (("train", 128), ("validation", 1))
            }
            data = ddprt.bake(scene, splits | {"test": path}, config=config)
            test = data.split("test")
            truth, values = Truth(data.maps("indirect", test), data.area), data.values(test, POINTS, "radiosity")
            own.append(jitter(truth.reference, truth.weight) / truth.mean)
            for name, settings in SPACES.items():
                light = ddprt.fit(data, bases=BASES, points=POINTS, **settings).predict(values)
                flicker[name][row].append(truth.flicker(light))
                if name == "linear" and seed == 0:
                    curves[supersample] = light, truth
                    error = truth.relative_rmse(light - truth.reference)
                    print(f"{supersample:3d} samples per point: relative RMSE along the path {error:.4f}", flush=True)
    print(f"jitter of the reference itself {np.mean(own):.2e} of its mean, half-float storage included")
    print("flicker over the mean of the reference, mean over bakes (and least to most)")
    print("samples  " + "  ".join(f"{name:>32s}" for name in SPACES))
    for row, supersample in enumerate(SUPERSAMPLES):
        cells = [f"{np.mean(v[row]):.2e} ({min(v[row]):.2e} to {max(v[row]):.2e})" for v in flicker.values()]
        print(f"{supersample:7d}  " + "  ".join(f"{cell:>32s}" for cell in cells))
    slope = np.polyfit(np.log(SUPERSAMPLES), np.log([np.mean(row) for row in flicker["linear"]]), 1)[0]
    print(f"linear flicker falls with samples to the power {slope:.2f}")
    draw(curves, flicker, float(np.mean(own)))


def draw(curves: dict[int, tuple[np.ndarray, Truth]], flicker: dict[str, list[list[float]]], own: float) -> None:
    """One texel's light along the path, and flicker against supersamples."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    light, truth = curves[1]
    # A typical texel where light matters: the median of jitter among those brighter than the mean.
    bends = np.sqrt(np.mean(np.diff((light - truth.reference)[..., 1], 2, axis=0) ** 2, 0))
    bright = np.flatnonzero(truth.reference[..., 1].mean(0) > truth.mean)
    texel = bright[np.argsort(bends[bright])[len(bright) // 2]]
    travel = 1000 * STEP * np.arange(FRAMES)
    for supersample in (1, 8):
        light, truth = curves[supersample]
        left.plot(travel, light[:, texel, 1], linewidth=1, label=f"relit, {supersample} per point")
    left.plot(travel, truth.reference[:, texel, 1], "k--", linewidth=1, label="reference")
    left.set(xlabel="lamp moved, mm", ylabel="indirect irradiance, W/m² (green)", title="one texel along the path")
    left.legend(fontsize=8)
    for name, rows in flicker.items():
        right.loglog(SUPERSAMPLES, [np.mean(row) for row in rows], "o-", label=name)
    first = np.mean(flicker["linear"][0])
    right.loglog(SUPERSAMPLES, first / np.sqrt(SUPERSAMPLES), ":", color="grey", label="1 / sqrt(samples)")
    right.axhline(own, color="grey", linewidth=0.8, label="jitter of the reference itself")
    right.set(xlabel="samples per measurement point", ylabel="flicker, share of the mean light", title="flicker")
    right.set_xticks(SUPERSAMPLES, [str(n) for n in SUPERSAMPLES], minor=False)
    right.legend(fontsize=8)
    Path("docs").mkdir(exist_ok=True)
    figure.savefig("docs/flicker.png", dpi=90)


if __name__ == "__main__":
    main(*sys.argv[1:])
