"""Gamma and linear space on high contrast, and two ways to take out negative light: the paper's Figure 6.

Question: does transfer in gamma space ring less where hardly any light comes, and what does it cost in linear light?
Command:  python experiments/contrast.py [TRAINING LIGHTINGS]     minutes; writes docs/contrast.png
Answer:   docs/stability.md

leak:  two dim rooms (albedo 0.3) joined by a hole; a lamp in one lights the other through the hole and by bounces alone
spots: two dark rooms (albedo 0.2) and a spot of 30 to 45 degrees that hangs below the ceiling and points down or nearly so

All errors are in linear light after the clamp. "In the dark" are texels and channels where the reference is below a hundredth
of its map's mean: their relative error is the sum of |y - r| over the sum of r there, their ringing the sum of y - r where it
is positive, over the same, both weighted by area. Negative light is before the clamp. "Kept" is clamp="energy".
"""

import sys
from pathlib import Path

import numpy as np

import ddprt
from ddprt import seeds
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.lights import Lighting, PointLight, SpotLight
from ddprt.report.metrics import Truth, negative_share, negative_shares
from ddprt.report.view import Camera, exposure_for, take_view, tonemap
from ddprt.transport.embree import Tracer

SCENES = {
    "leak": {"albedo": 0.3, "door_width": 0.5, "door_height": 1.0},
    "spots": {"albedo": 0.2},
}
GAMMAS, BASES, POINTS, TEST, DARK = (1.0, 1.5, 2.2, 3.0, 5.0), (4, 8, 16, 32), 256, 48, 0.01
CAMERA, STOPS, PIXELS, SHOWN = Camera((3.0, 2.0, 9.5), (3.0, 1.1, 1.5), 23.0, 2.2), 5, 150, 8
CLEARANCE = 0.2  # metres of lamps from walls


def main(train: str = "256") -> None:
    rows = {}
    for name, parameters in SCENES.items():
        data = bake(name, parameters, int(train))
        test = data.split("test")
        truth, values = Truth(data.maps("indirect", test), data.area), data.values(test, POINTS, "radiosity")
        dark = Dark(truth)
        noise = dark.sum(np.abs(data.maps("noise", test))) / dark.light
        print(f"\n{name}: {dark.share:.1%} of the area is dark and holds {dark.of_all:.1e} of the light; ", end="")
        print(f"noise {truth.relative_rmse(data.maps('noise', test)):.4f}, in the dark {noise:.3f}")
        print("              pooled RMSE       median  error in the dark      ringing     negative light")
        print("gamma  bases     cut    kept       cut      cut     kept     cut    kept   pooled   median    worst")
        for gamma in GAMMAS:
            for bases in BASES:
                space = {"space": "gamma" if gamma > 1 else "linear", "gamma": gamma}
                model = ddprt.fit(data, bases=bases, points=POINTS, **space)
                raw, cut, kept = (model.predict(values, clamp=clamp) for clamp in (False, True, "energy"))
                pooled, median = (truth.scores(cut)[f"{kind}relative_rmse"] for kind in ("", "median_lighting_"))
                shares = negative_shares(raw, truth.weight)
                rows[name, gamma, bases] = pooled, dark.error(cut)
                cells = [f"{gamma:5.1f}  {bases:5d}  {pooled:6.4f}  {truth.scores(kept)['relative_rmse']:6.4f}  {median:8.4f}"]
                cells += [f"{dark.error(light):7.3f}" for light in (cut, kept)]
                cells += [f"{dark.ringing(light):6.3f}" for light in (cut, kept)]
                cells += [f"{share:.1e}" for share in (negative_share(raw, truth.weight), np.median(shares), shares.max())]
                print("  ".join(cells), flush=True)
                if name == "leak" and bases == SHOWN and gamma in (1.0, 2.2):
                    rows[gamma] = cut, kept
        if name == "leak":
            pictures = picture(data, truth, dark, rows.pop(1.0), rows.pop(2.2))
    draw(pictures, rows)


class Dark:
    """Where a reference is below a hundredth of its own mean."""

    def __init__(self, truth: Truth) -> None:
        self.reference = truth.reference
        mean = np.einsum("ltc,t->lc", truth.reference, truth.weight)[:, None]
        self.mask = truth.reference < DARK * mean
        self.weight = truth.weight[:, None] * self.mask
        self.light = self.sum(truth.reference)
        self.share = float(self.weight.sum() / self.mask[:, 0].size)
        self.of_all = self.light / float(np.einsum("ltc,t->", truth.reference, truth.weight))

    def sum(self, maps: np.ndarray) -> float:
        return float(np.sum(maps * self.weight))

    def error(self, light: np.ndarray) -> float:
        return self.sum(np.abs(light - self.reference)) / self.light

    def ringing(self, light: np.ndarray) -> float:
        return self.sum(np.maximum(light - self.reference, 0)) / self.light


def bake(name: str, parameters: dict[str, float], train: int) -> Dataset:
    """All lamps hang 0.2 m or more off the walls, in either room."""
    changes = {"atlas.resolution": "64", "points.count": str(POINTS), "transport.samples": "1024"}
    config = load_config(None, changes | {"transport.test_samples": "4096"})
    scene = ddprt.SCENES["corridor"](**parameters)
    counts = {"train": train, "validation": 1, "test": TEST}
    splits = {split: [lighting(name, scene.bounds, split, i) for i in range(n)] for split, n in counts.items()}
    return ddprt.bake(scene, splits, config=config)


def lighting(name: str, bounds: np.ndarray, split: str, index: int) -> Lighting:
    """A white lamp in one of the rooms."""
    rng = seeds.stream(0, f"contrast {name} {split}", index)
    low, high = bounds[0] + CLEARANCE, bounds[1] - CLEARANCE
    middle = bounds.mean(0)[0]
    wall = CLEARANCE + 0.1  # half of what is between the rooms
    if rng.random() < 0.5:
        high[0] = middle - wall
    else:
        low[0] = middle + wall
    if name == "leak":
        return (PointLight(position=tuple(rng.uniform(low, high)), intensity=(1.0, 1.0, 1.0)),)
    low[1] = bounds[1, 1] - 0.6
    turn, lean, outer = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 30)), rng.uniform(30, 45)
    down = (np.sin(lean) * np.cos(turn), -np.cos(lean), np.sin(lean) * np.sin(turn))
    place = tuple(rng.uniform(low, high))
    return (SpotLight(position=place, direction=down, intensity=(1.0, 1.0, 1.0), inner_deg=0.6 * outer, outer_deg=outer),)


def picture(
    data: Dataset, truth: Truth, dark: Dark, linear: tuple[np.ndarray, ...], gamma: tuple[np.ndarray, ...]
) -> dict[str, np.ndarray]:
    """The held-out lighting of median ringing in linear space: as it is, and the dark room five stops up."""
    excess = np.sum(np.maximum(linear[0] - dark.reference, 0) * dark.weight, (1, 2))
    dim = np.flatnonzero(excess > 0)
    chosen = dim[np.argsort(excess[dim])[len(dim) // 2]]
    view = take_view(Tracer(data.occluders), data.uv, data.covered, CAMERA, PIXELS)
    maps = {"reference": truth.reference, "linear, cut": linear[0], "linear, energy kept": linear[1], "gamma 2.2": gamma[0]}
    stops = exposure_for(truth.reference[chosen])
    return {
        name: np.concatenate([tonemap(view.render(light[chosen]), stops + more) for more in (0, STOPS)])
        for name, light in maps.items()
    }


def draw(pictures: dict[str, np.ndarray], rows: dict[tuple[str, float, int], tuple[float, ...]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(13, 7), layout="constrained")
    above, below = figure.subfigures(2, 1)
    for axes, (name, image) in zip(above.subplots(1, 4), pictures.items(), strict=True):
        axes.imshow(image)
        axes.set_title(f"{name}" + ("" if name == "reference" else f", {SHOWN} bases"), fontsize=9)
        axes.axis("off")
    above.supxlabel(f"leak: above as displayed, below the same {STOPS} stops brighter", fontsize=9)
    plots = below.subplots(1, 4)
    for (name, what), axes in zip([(n, w) for n in SCENES for w in (0, 1)], plots, strict=True):
        for bases in BASES:
            axes.semilogy(GAMMAS, [rows[name, gamma, bases][what] for gamma in GAMMAS], "o-", label=f"{bases} bases")
        axes.set_title(f"{name}: " + ("pooled relative RMSE", "relative error in the dark")[what], fontsize=10)
        axes.set_xlabel("gamma")
    plots[0].legend(fontsize=8)
    Path("docs").mkdir(exist_ok=True)
    figure.savefig("docs/contrast.png", dpi=90)


if __name__ == "__main__":
    main(*sys.argv[1:])
