"""Do chosen lightings and chosen points learn more than random and evenly spread ones at the same cost?

Question: how many lightings chosen by what their measurements tell reach the held-out error of 128 random ones, and what do
          measurement points by pivoted QR gain over blue noise with the same number of shaded samples?
Command:  python experiments/active.py [--quick] [--seeds 6] [--most 256]
Answer:   docs/active.md

A pool of lightings is baked once per scene, into runs/active-NAME. A seed shuffles it: random design takes the first N, the
others choose N of the first 8 N (or of all there are). Held-out lightings are random and the same for all. Scores of a scene
are kept beside its pool: a run that was stopped goes on with the next scene.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset, average_into_points
from ddprt.fitting.selection import choose_ridge, decompose
from ddprt.sampling.design import choose_columns, choose_rows, directions

BASES = 16
COUNTS = (8, 16, 32, 64, 128, 256)
POINTS = (16, 32, 64, 128, 256)
TRAIN_OF_POINTS = 96
EACH = 8  # candidates per lighting
SIZE = {"atlas.resolution": "48", "transport.samples": "96", "transport.test_samples": "192"}
SIZE |= {"points.count": "256", "points.supersample": "4", "lightings.validation": "16"}
AROUND = {"lightings.distribution": "around", "points.on": "hull", "lightings.saturation": "[0.0, 0.8]"}
SCENES: dict[str, tuple[str | None, dict[str, str], int]] = {
    "cornell": ("configs/cornell.toml", {}, 256),
    "corridor": (None, {"scene.name": "corridor", "lightings.clearance": "0.1"}, 256),
    "statue": (None, {"scene.name": "statue", "points.count": "128", "points.supersample": "8"} | AROUND, 128),
    "cornell-near": ("configs/cornell-near.toml", {"points.count": "512"}, 512),
}
SCORES = ("pooled", "median", "p90", "worst")


@dataclass
class Pool:
    """Measurements and maps of all lightings; the first `train` are to choose from, the others held out.

    Attributes:
      irradiance: (lightings, samples, 3), W/m².
      maps: (lightings, 3, texels), each texel times the root of its share of the area.
      mean: of the held-out maps.
    """

    data: Dataset
    train: int
    irradiance: np.ndarray
    maps: np.ndarray
    mean: float

    @classmethod
    def of(cls, name: str, train: int, test: int) -> "Pool":
        source, own, _ = SCENES[name]
        counts = {"lightings.train": str(train), "lightings.test": str(test)}
        config = load_config(source, SIZE | own | counts)
        folder = Path("runs") / f"active-{name}-{train}"
        data = ddprt.bake(ddprt.load_scene(config.scene.name), config=config, out=folder)
        indices = data.split("train") + data.split("test")
        root = np.sqrt(data.area / data.area.sum())
        maps = np.moveaxis(data.maps("indirect", indices), 2, 1) * root
        return cls(data, train, data.measured(indices), maps, float(np.mean(maps[train:] @ root)))

    def values(self, points: int, order: np.ndarray | None = None) -> np.ndarray:
        samples, irradiance = self.data.samples, self.irradiance
        if order is not None:
            places = {key: getattr(samples, key)[order] for key in ("position", "normal", "albedo")}
            samples, irradiance = replace(samples, **places), irradiance[:, order]
        return average_into_points(irradiance, samples, points, "radiosity").astype(np.float64)

    def scores(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Pooled relative RMSE, then median, 90th percentile and worst lighting, of a fit as svd-ridge makes it."""
        scale = np.linalg.norm(values, axis=1)
        divisor = np.where(scale > 0, scale, 1)
        X, held = values / divisor[:, None], np.arange(self.train, len(values))
        Y = np.where(scale[chosen, :, None] > 0, self.maps[chosen] / divisor[chosen, :, None], 0)
        rows = Y.reshape(-1, Y.shape[2])
        sizes, vectors = np.linalg.eigh(rows @ rows.T)
        kept = np.flatnonzero(sizes > 1e-12 * sizes[-1])[::-1][:BASES]
        U = (vectors[:, kept].T @ rows) / np.sqrt(sizes[kept])[:, None]
        C = Y @ U.T
        spectra = [decompose(X[chosen, :, c].astype(np.float32), C[:, c]) for c in range(3)]
        ridge = choose_ridge(spectra, [scale[chosen, c] ** 2 for c in range(3)], [np.arange(len(chosen))] * 3).ridge
        squares = np.zeros(len(held))
        for c, spectrum in enumerate(spectra):
            S, right, turned = (np.asarray(part) for part in (spectrum.values, spectrum.right, spectrum.turned))
            S, turned = S[: len(right)], turned[: len(right)]
            shrunk = np.where(np.arange(len(S)) < spectrum.rank, S / np.maximum(S**2 + ridge, 1e-300), 0)
            light = ((X[held, :, c] @ right[: len(S)].T) * shrunk) @ turned @ U * scale[held, c, None]
            squares += ((np.maximum(light, 0) - self.maps[held, c]) ** 2).sum(1)
        size = (self.maps[held] ** 2).sum((1, 2))
        each = np.sqrt(squares[size > 0] / size[size > 0])
        pooled = np.sqrt(squares.mean() / 3) / self.mean
        return np.array([pooled, np.median(each), np.quantile(each, 0.9), each.max()])


def first(rows: np.ndarray, count: int) -> np.ndarray:
    return np.arange(count)


def greatest_variance(rows: np.ndarray, count: int) -> np.ndarray:
    """D-optimal, greedily: a pivoted QR of the candidates."""
    return choose_columns(rows.T, count)[:count]


def farthest(rows: np.ndarray, count: int) -> np.ndarray:
    """k-centre, greedily."""
    chosen = [int((rows @ rows.mean(0)).argmax())]
    apart = ((rows - rows[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, ((rows - rows[chosen[-1]]) ** 2).sum(1))
    return np.array(chosen)


def facility(rows: np.ndarray, count: int) -> np.ndarray:
    """Lowers the mean distance from a candidate to the nearest chosen one, greedily."""
    size = (rows**2).sum(1)
    distance = np.sqrt(np.maximum(size[:, None] + size - 2 * rows @ rows.T, 0))
    nearest, chosen = np.full(len(rows), 2.0), list[int]()
    for _ in range(count):
        gain = np.maximum(nearest[:, None] - distance, 0).sum(0)
        gain[chosen] = -1
        chosen.append(int(gain.argmax()))
        nearest = np.minimum(nearest, distance[:, chosen[-1]])
    return np.array(chosen)


SHORT = ("k-centre", "facility")  # shown where they may matter, not along all of the curve
WAYS = {"random": first, "active": choose_rows, "D-optimal": greatest_variance, "k-centre": farthest, "facility": facility}


def of_lightings(pool: Pool, points: int, seeds: int, counts: tuple[int, ...]) -> dict[str, dict[int, np.ndarray]]:
    """Scores by way and number of lightings: (seeds, scores)."""
    values = pool.values(points)
    rows = directions(values[: pool.train])
    found: dict[str, dict[int, np.ndarray]] = {way: {} for way in WAYS}
    for count in counts:
        for way, choose in WAYS.items():
            if way in SHORT and count > 64:
                continue
            trials = []
            for seed in range(seeds):
                candidates = np.random.default_rng(seed).permutation(pool.train)[: EACH * count]
                trials.append(pool.scores(values, candidates[choose(rows[candidates], count)]))
            found[way][count] = np.array(trials)
    return found


def of_points(pool: Pool, seeds: int, counts: tuple[int, ...]) -> dict[str, dict[int, np.ndarray]]:
    """Scores by way and number of points; all samples are shaded, whatever the number of points."""
    found: dict[str, dict[int, np.ndarray]] = {"blue-noise": {}, "qr": {}}
    light = pool.irradiance[: pool.train] * pool.data.samples.albedo
    for count in counts:
        for way, trials in found.items():
            scores = []
            for seed in range(seeds):
                chosen = np.random.default_rng(seed).permutation(pool.train)[:TRAIN_OF_POINTS]
                order = None
                if way == "qr":
                    rows = directions(light[chosen]).reshape(light[chosen].shape)
                    order = choose_columns(rows.swapaxes(1, 2).reshape(-1, rows.shape[1]), count)
                scores.append(pool.scores(pool.values(count, order), chosen))
            trials[count] = np.array(scores)
    return found


def mean(trials: np.ndarray) -> np.ndarray:
    return np.exp(np.log(trials).mean(0))


def table(name: str, what: str, found: dict[str, dict[int, np.ndarray]]) -> None:
    for count in next(iter(found.values())):
        for way, of in found.items():
            if count not in of:
                continue
            row = "".join(f"{score:8.4f}" for score in mean(of[count]))
            print(f"{name:13}{what:10}{count:5d}  {way:11}{row}   x/ {np.exp(np.log(of[count][:, 0]).std()):.3f}", flush=True)


def draw(lightings: dict, points: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(2, len(lightings), figsize=(3.3 * len(lightings), 6), layout="constrained", squeeze=False)
    colours = {"random": "#6e7781", "active": "#1f5fa8", "D-optimal": "#b8501c", "blue-noise": "#6e7781", "qr": "#1f5fa8"}
    for row, (found, label) in enumerate(((lightings, "training lightings"), (points, "measurement points"))):
        for axes, (name, curves) in zip(panels[row], found.items(), strict=True):
            for way, of in curves.items():
                if way in colours:
                    trials = np.array([of[count][:, 0] for count in of])
                    axes.fill_between(list(of), trials.min(1), trials.max(1), color=colours[way], alpha=0.2, linewidth=0)
                    axes.plot(list(of), np.exp(np.log(trials).mean(1)), "o-", color=colours[way], label=way, markersize=3)
            axes.set(xscale="log", yscale="log", xlabel=label, title=name if row == 0 else "")
            counts = list(next(iter(curves.values())))
            axes.set_xticks(counts, [str(count) for count in counts])
            axes.minorticks_off()
            low, high = axes.get_ylim()
            ticks = [
                tick
                for tick in (0.05, 0.06, 0.07, 0.08, 0.09, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9, 1, 1.1, 1.3, 1.5, 2)
                if low <= tick <= high
            ]
            axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.grid(alpha=0.3)
        panels[row][0].set_ylabel("held-out relative RMSE")
        panels[row][0].legend(fontsize=8)
    figure.savefig("docs/active.png", dpi=90)


def scene_scores(name: str, quick: bool, seeds: int, most: int) -> dict[str, dict[str, dict[int, np.ndarray]]]:
    """Scores of a scene over lightings and over points, from an earlier run if there is one."""
    train, test = (256, 64) if quick else (2048, 256)
    kept = Path("runs") / f"active-{name}-{train}-{seeds}-{most}.json"
    if kept.is_file():
        found = json.loads(kept.read_text())
        return {
            over: {way: {int(n): np.array(of) for n, of in ways.items()} for way, ways in both.items()}
            for over, both in found.items()
        }
    pool = Pool.of(name, train, test)
    points = (32, 128) if quick else POINTS
    found = {
        "lightings": of_lightings(pool, SCENES[name][2], seeds, tuple(count for count in COUNTS if count <= most)),
        "points": of_points(pool, seeds, points),
    }
    plain = {
        over: {way: {n: of.tolist() for n, of in ways.items()} for way, ways in both.items()} for over, both in found.items()
    }
    kept.write_text(json.dumps(plain))
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="one scene, a small pool, no picture")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--most", type=int, default=256, help="training lightings")
    parser.add_argument("--only", choices=SCENES, help="one scene, no picture")
    asked = parser.parse_args()
    quick = asked.quick
    seeds, most = (2, 32) if quick else (asked.seeds, asked.most)
    names = ["cornell"] if quick else [asked.only] if asked.only else list(SCENES)
    print(f"{'scene':13}{'over':10}{'':5}  {'way':11}" + "".join(f"{score:>8}" for score in SCORES) + "   spread of pooled")
    scores = {}
    for name in names:
        scores[name] = scene_scores(name, quick, seeds, most)
        for over, found in scores[name].items():
            table(name, over, found)
        found, yardstick = scores[name]["lightings"], min(128, most)
        wanted = mean(found["random"][yardstick])
        for place, score in enumerate(SCORES[:2]):
            enough = [count for count, of in found["active"].items() if mean(of)[place] <= wanted[place]]
            reached = f"{enough[0]} active ones" if enough else "no number of active ones here"
            print(
                f"{name}: {score} error of {yardstick} random lightings ({wanted[place]:.4f}): reached by {reached}", flush=True
            )
    if not quick and not asked.only:
        draw(*({name: of[over] for name, of in scores.items()} for over in ("lightings", "points")))
        print("docs/active.png")


if __name__ == "__main__":
    with threadpool_limits(limits=1, user_api="blas"):
        main()
