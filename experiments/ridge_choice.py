"""Which ridge leave-one-out and generalised cross-validation choose, and which would have been best.

Question: how much held-out error does each way of choosing a ridge cost, over a ridge chosen with the held-out maps in sight?
Command:  python experiments/ridge_choice.py [splits] [PICTURE.png]
Answer:   docs/stability.md. In short: one ridge for all channels rather than one each, the mean of the left-out lightings'
          error norms rather than of their squares, and no one-standard-error rule.

Takes the datasets of runs/cornell and runs/cornell-near; where one is absent, bakes a small one of the same scenario and says
so. Lightings of all three splits are dealt anew `splits` times into training and held-out ones.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.fitting.selection import Choice, Spectrum, choose_ridge, decompose, left_out

JOBS = {"cornell": "cornell", "cornell-near": "cornell-near"}
CASES = (
    ("cornell", 128, 16),
    ("cornell", 64, 32),
    ("cornell-near", 512, 16),
    ("cornell-near", 512, 64),
    ("cornell-near", 256, 32),
    ("cornell-near", 128, 16),
)
TRAIN = (128, 64, 32)
SMALL = {"atlas.resolution": "48", "lightings.train": "64", "lightings.validation": "8", "lightings.test": "24"}
SMALL |= {"points.count": "128", "transport.samples": "256", "transport.test_samples": "256"}


@dataclass
class Lights:
    """Measurements, and indirect maps in coordinates that keep all their area-weighted products, float64.

    Attributes:
      scale: (lightings, 3).
      measured: (lightings, points, 3), W/m².
      maps: (lightings, 3, coordinates).
      mean: area-weighted mean of each map.
    """

    measured: np.ndarray
    maps: np.ndarray
    mean: np.ndarray


def main(splits: str = "10", out: str = "docs/ridge.png") -> None:
    lights = {name: compressed(dataset(name)) for name in JOBS}
    print("factors over the best ridge: pooled error (worst split), median and 90th percentile lighting")
    print(f"{'dataset':>13} points bases train  choice            pooled  worst  median    p90")
    gathered: dict[str, list[np.ndarray]] = {}
    for name, points, bases in CASES:
        for train in TRAIN:
            rows: dict[str, list[np.ndarray]] = {}
            for split in range(int(splits)):
                order = np.random.default_rng(split).permutation(len(lights[name].maps))
                if train >= len(order):
                    continue
                for way, factors in compare(Trial(lights[name], order[:train], order[train:], bases, points)).items():
                    rows.setdefault(way, []).append(factors)
            for way, values in rows.items():
                geometric = np.exp(np.log(values).mean(0))
                worst = np.max(values, 0)[0]
                print(f"{name:>13} {points:6d} {bases:5d} {train:5d}  {way:<16}", end="  ")
                print(f"{geometric[0]:6.3f} {worst:6.2f}  {geometric[1]:6.3f} {geometric[2]:6.3f}", flush=True)
                gathered.setdefault(way, []).extend(values)
    print(f"\nall {len(next(iter(gathered.values())))} splits (geometric mean)")
    for way, values in gathered.items():
        print(f"  {way:<16} {np.array2string(np.exp(np.log(values).mean(0)), precision=3)}  worst {np.max(values, 0)[0]:.2f}")
    draw(lights, out)
    print(out)


class Trial:
    """One division into training and held-out lightings: spectra, the choices, and held-out errors along the path."""

    def __init__(self, lights: Lights, train: np.ndarray, test: np.ndarray, bases: int, points: int) -> None:
        measured = lights.measured[:, :points]
        scale = np.linalg.norm(measured, axis=1)
        divisor = np.where(scale > 0, scale, 1)
        X = (measured / divisor[:, None]).astype(np.float32)
        maps = np.where(scale[..., None] > 0, lights.maps / divisor[..., None], 0)
        U = np.linalg.svd(maps[train].reshape(-1, maps.shape[2]), full_matrices=False)[2][:bases]
        C = maps @ U.T
        self.weight = [scale[train, c] ** 2 for c in range(3)]
        self.rows = [np.arange(len(train))] * 3
        self.spectra = [decompose(X[train, :, c], C[train, c]) for c in range(3)]
        self.choice = self.choose()
        self.ridges = self.choice.path[:, 0]
        left = np.sum((maps[test] - C[test] @ U) ** 2, 2) * scale[test] ** 2
        self.squares = np.stack(
            [
                np.sum((predicted(s, X[test, :, c], self.ridges) - C[test, c]) ** 2, 2) * scale[test, c] ** 2 + left[:, c]
                for c, s in enumerate(self.spectra)
            ],
            1,
        )
        self.size = np.sum(lights.maps[test] ** 2, (1, 2))
        self.mean = lights.mean[test].mean()

    def choose(self, power: float = 1.0) -> Choice:
        return choose_ridge(self.spectra, self.weight, self.rows, power=power)

    def errors(self, ridges: list[float]) -> np.ndarray:
        """Pooled relative RMSE, median and 90th percentile at a ridge per channel."""
        places = [int(np.argmin(np.abs(self.ridges - ridge))) for ridge in ridges]
        squares = sum(self.squares[place, c] for c, place in enumerate(places))
        each = np.sqrt(squares / self.size)
        return np.array([np.sqrt(squares.mean() / 3) / self.mean, np.median(each), np.quantile(each, 0.9)])


def compare(trial: Trial) -> dict[str, np.ndarray]:
    """Errors of each way of choosing, over the least that any shared ridge of the path reaches."""
    best = np.min([trial.errors([ridge] * 3) for ridge in trial.ridges], 0)
    squares, norms = trial.choose(2.0), trial.choice
    each = sum(left_out(s, trial.ridges)[0] * w / max(w.max() for w in trial.weight)
               for s, w in zip(trial.spectra, trial.weight, strict=True))  # fmt: skip
    ways = {
        "squares, own": [float(trial.ridges[own.argmin()]) for own in squares.own],
        "squares, shared": [squares.ridge] * 3,
        "norms, own": [float(trial.ridges[own.argmin()]) for own in norms.own],
        "norms, shared": [norms.ridge] * 3,
        "one standard err": [float(trial.ridges[one_standard_error(np.sqrt(each))])] * 3,
        "logarithms": [float(trial.ridges[np.log(each).sum(1).argmin()])] * 3,
        "GCV": [norms.second] * 3,
    }
    return {way: trial.errors(ridges) / best for way, ridges in ways.items()}


def one_standard_error(each: np.ndarray) -> int:
    """The largest ridge whose mean lies within a standard error (of paired differences) of the lowest."""
    more = each - each[each.sum(1).argmin()]
    return int(np.flatnonzero(more.mean(1) <= more.std(1) / np.sqrt(each.shape[1])).max())


def predicted(spectrum: Spectrum, measured: np.ndarray, ridges: np.ndarray) -> np.ndarray:
    """(ridges, lightings, bases)."""
    S, right = np.asarray(spectrum.values), np.asarray(spectrum.right)
    S, turned = S[: len(right)], np.asarray(spectrum.turned)[: len(right)]
    held = (1e-7 * S[0] < S) | (ridges[:, None] > 0)
    shrunk = np.where(held, S / np.maximum(S**2 + ridges[:, None], 1e-300), 0)
    return np.einsum("lk,rk,kb->rlb", measured @ right[: len(S)].T, shrunk, turned, optimize=True)


def dataset(name: str) -> Dataset:
    folder = Path("runs") / name / "dataset"
    if (folder / "dataset.json").is_file():
        return ddprt.open_dataset(folder)
    print(f"{folder} is absent: a small bake of configs/{JOBS[name]}.toml stands in for it")
    config = load_config(f"configs/{JOBS[name]}.toml", SMALL)
    return ddprt.bake(ddprt.load_scene(config.scene.name), config=config)


def compressed(data: Dataset) -> Lights:
    """Maps by the square root of their Gram matrix: the same norms and angles in a few hundred numbers each."""
    indices = [index for split in ("train", "validation", "test") for index in data.split(split)]
    maps = data.maps("indirect", indices)
    weight = data.area / data.area.sum()
    rows = np.moveaxis(maps, 2, 1).reshape(-1, maps.shape[1]).astype(np.float64)
    gram = (rows * weight) @ rows.T
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / size[:, None] / size)
    short = size[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    measured = data.values(indices, data.description["points"]["count"], "radiosity").astype(np.float64)
    return Lights(measured, short.reshape(len(indices), 3, -1), np.average(maps.mean(2), axis=1, weights=weight))


def draw(lights: dict[str, Lights], out: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for axes, (name, points, train) in zip(
        panels, (("cornell", 128, 128), ("cornell-near", 512, 128), ("cornell-near", 128, 128)), strict=True
    ):
        one = lights[name]
        train = min(train, len(one.maps) * 3 // 4)
        trial = Trial(one, np.arange(train), np.arange(train, len(one.maps)), 16, points)
        squares, some = trial.choose(2.0), slice(1, None)
        held = np.array([trial.errors([ridge] * 3) for ridge in trial.ridges])
        place = lambda ridge, t=trial: int(np.argmin(np.abs(t.ridges - ridge)))  # noqa: E731
        best = {"pooled": held[:, 0].min(), "median": held[:, 1].min()}
        lines = {
            "held-out, pooled": (held[:, 0] / best["pooled"], "#222222", "-"),
            "held-out, median lighting": (held[:, 1] / best["median"], "#222222", "--"),
            "leave-one-out, norms": (trial.choice.path[:, 1] / trial.choice.path[:, 1].min(), "#0b61a4", "-"),
            "leave-one-out, squares": (squares.path[:, 1] / squares.path[:, 1].min(), "#d9480f", "-"),
            "generalised cross-validation": (trial.choice.path[:, 2] / trial.choice.path[:, 2].min(), "#2b8a3e", ":"),
        }
        for label, (line, colour, style) in lines.items():
            axes.loglog(trial.ridges[some], line[some], style, color=colour, label=label)
        marks = ((trial.choice.ridge, "#0b61a4"), (squares.ridge, "#d9480f"), (trial.choice.second, "#2b8a3e"))
        for ridge, colour in marks:
            shown = max(ridge, trial.ridges[1])
            axes.plot(shown, held[place(ridge), 0] / best["pooled"], "o", color=colour, zorder=5)
        axes.set(xlabel="ridge (scaled measured²)", ylim=(0.9, 10), title=f"{name}, {points} points, {train} lightings")
        axes.set_ylabel("error over its lowest")
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
