"""Lamps anywhere in a room, millimetres from a surface or inside a block: what a closed form can do about them.

Question: how much of the gap between the transfer's error and the projection floor can be had back without learning?
Command:  python experiments/near_lamps.py [seeds]      (five by default; bakes are kept in the system's temporary folder)
Answer:   docs/stability.md, docs/near-lamps.png

Three figures on 64 held-out lamps, 128 training lamps, 16 bases, 512 points of 8 samples: pooled relative RMSE, median and 90th
percentile of the error per lamp. The floor is the projection of the held-out maps on the plain basis, the same for every row.
Rows in capitals are the package's own bake and fit, end to end: what they share with the others is light alone.
"gap" is (error - floor) / (error - floor of ridge = "auto"), each a mean over the seeds: 1 is no better, 0.5 half the gap.
"""

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import qr
from scipy.spatial import cKDTree

import ddprt
from ddprt.config import Config
from ddprt.dataset.generate import DEPTH
from ddprt.dataset.store import Dataset
from ddprt.fitting.basis import fit_basis
from ddprt.fitting.transfer import fit_transfer
from ddprt.lights import Lighting, parse_lighting
from ddprt.report.metrics import Truth

BASES, POINTS, SAMPLES = 16, 512, 8
COUNTS = {"train": 128, "validation": 16, "test": 64}
SCENARIOS: dict[str, tuple[float, float] | None] = {
    "5 cm off the walls": (0.05, 0.0),  # the blocks are not avoided: lamps come near them and into them
    "anywhere": (0.002, 0.125),  # 2 mm off the walls, and one in eight 1 to 5 mm from a surface
    "upper part of the room": None,  # the default job's lamps: what must not get worse
}
DEFAULT = {**COUNTS, "region_low": [0.1, 0.5, 0.1], "region_high": [0.9, 0.8, 0.9], "clearance": 0.1}  # configs/cornell.toml
FIGURES = ("pooled", "median", "p90")
BLACK = 0.05  # share of the median brightness below which a relative error is not asked for


def draw(scene: ddprt.scene.mesh.Scene, rng: np.random.Generator, count: int, margin: float, near: float) -> list[Lighting]:
    """Point lamps in the scene's bounds, `margin` metres off them; a share `near` of them right at a surface."""
    low, high = scene.bounds
    lamps = rng.uniform(low + margin, high - margin, (count, 3))
    corners, close = scene.corners, round(near * count)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    triangle = rng.choice(len(corners), close, p=area / area.sum())
    place = np.einsum("nc,ncd->nd", rng.dirichlet([1, 1, 1], close), corners[triangle])
    lamps[:close] = place + scene.geometric_normals[triangle] * rng.uniform(0.001, 0.005, (close, 1))
    return [
        parse_lighting({"type": "point", "position": lamp.tolist(), "intensity": [1, 1, 1]}) for lamp in rng.permutation(lamps)
    ]


def bake(scenario: str, seed: int, depth: float = 0.0) -> Dataset:
    """The lamps of a scenario, baked or found baked; samples are lit from `depth` sample spacings behind their surface."""
    scene, rng = ddprt.load_scene("cornell"), np.random.default_rng([4, seed])
    where = SCENARIOS[scenario]
    lightings = {split: draw(scene, rng, count, *where) for split, count in COUNTS.items()} if where else None
    config = Config.model_validate(
        {
            "seed": seed,
            "atlas": {"resolution": 128},
            "lightings": DEFAULT,
            "points": {"count": POINTS, "supersample": SAMPLES, "depth": depth},
            # Many shadow rays, since a lamp's spot is smaller than a texel; many gather rays, since its light is pooled.
            "transport": {"samples": 256, "test_samples": 2048, "direct_samples": 64},
        }
    )
    folder = Path(tempfile.gettempdir()) / "ddprt-near-lamps" / f"{'-'.join(scenario.split())}-{seed}{'-sunk' if depth else ''}"
    return ddprt.bake(scene, lightings, config=config, out=folder)


@dataclass(frozen=True)
class Side:
    """What is measured of some lightings: light at every sample and its mean at every point, (lightings, places, 3)."""

    samples: np.ndarray
    points: np.ndarray


class Problem:
    """A baked dataset as the linear algebra of a transfer: values in, coefficients of the plain basis out."""

    def __init__(self, data: Dataset, sunk: Dataset) -> None:
        self.data, self.sunk = data, sunk
        self.splits = data.split("train"), data.split("test")
        self.train, self.test = (self.side(data.measured(split)) for split in self.splits)
        indirect = data.maps("indirect", self.splits[0])
        self.weights = (data.area / data.area.sum()).astype(np.float32)
        scale = norm(self.train.points)
        columns = np.moveaxis(divided(indirect, scale), 2, 1).reshape(-1, indirect.shape[1]).astype(np.float32)
        self.basis = np.asarray(fit_basis(columns, self.weights, bases=BASES).vectors)
        self.wanted = self.projected(indirect)
        reference = data.maps("indirect", self.splits[1])
        self.truth = Truth(reference, data.area)
        self.floor = self.scores(self.projected(reference))

    @cached_property
    def home(self) -> np.ndarray:
        """The point of each sample."""
        return self.data.samples.nearest_point(len(self.data.samples.position) // SAMPLES)

    def side(self, irradiance: np.ndarray) -> Side:
        """Radiosity of the samples and its means over points."""
        values = irradiance.astype(np.float64) * self.data.samples.albedo
        return Side(values, pooled(values, self.home))

    def projected(self, maps: np.ndarray) -> np.ndarray:
        """Coefficients (lightings, 3, bases)."""
        return np.moveaxis(np.einsum("ltc,bt->lbc", maps, self.basis * self.weights, optimize=True), 1, 2).astype(np.float64)

    def scores(self, coefficients: np.ndarray) -> np.ndarray:
        """Pooled, median and 90th percentile of the clamped maps that coefficients make."""
        return self.scores_of(np.maximum(np.moveaxis(coefficients.astype(np.float32) @ self.basis, 1, 2), 0))

    def scores_of(self, light: np.ndarray) -> np.ndarray:
        """The same of maps."""
        found = self.truth.scores(light)
        return np.array([found[f"{key}relative_rmse"] for key in ("", "median_lighting_", "p90_lighting_")], float)


def pooled(values: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Means over the samples of each point."""
    share = np.zeros((home.max() + 1, len(home)))
    share[home, np.arange(len(home))] = 1 / np.bincount(home)[home]
    return np.einsum("ps,lsc->lpc", share, values, optimize=True)


def norm(values: np.ndarray) -> np.ndarray:
    """s = ||x|| of each lighting and channel."""
    return np.linalg.norm(values, axis=1)


def divided(values: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Values over their scale, 0 where that is 0."""
    return values / np.where(scale > 0, scale, 1)[:, None] * (scale > 0)[:, None]


Measure = Callable[[Problem], tuple[np.ndarray, np.ndarray]]
Feature = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def plain(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The means over points that an engine measures, of training and of held-out lightings."""
    return problem.train.points, problem.test.points


def sunk(depth: float, *, corrected: bool = False) -> Measure:
    """Samples shaded `depth` sample spacings behind their surface, E(e); their shadow rays still start on it.

    At depth e behind a plane a lamp of height h shines as one of height h + e: the same flux, spread by a Poisson kernel, which
    multiplies a wave number k by exp(-k e). Corrected, 2 E(e) - E(2 e), by 1 - (1 - exp(-k e))²: what varies slowly passes.
    """

    def irradiance(problem: Problem, away: np.ndarray, depth: float) -> np.ndarray:
        normal, spacing = problem.data.samples.normal, problem.data.samples.spacing
        away = away + depth * spacing * normal
        return np.maximum((away * normal).sum(-1), 0) / (away**2).sum(-1) ** 1.5

    def values(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
        found = []
        for split, side in zip(problem.splits, (problem.train, problem.test), strict=True):
            lamps = [problem.data.lightings[index][0] for index in split]
            away = np.array([lamp.position for lamp in lamps])[:, None] - problem.data.samples.position
            light = irradiance(problem, away, depth)
            if corrected:
                light = 2 * light - irradiance(problem, away, 2 * depth)
            seen = side.samples.max(2) > 0
            found.append(problem.side((light * seen)[..., None] * np.array([lamp.intensity for lamp in lamps])[:, None]).points)
        return found[0], found[1]

    return values


def capped(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """No sample brings more light than all others together."""

    def values(side: Side) -> np.ndarray:
        others = side.samples.sum(1, keepdims=True) - side.samples
        return pooled(np.minimum(side.samples, others), problem.home)

    return values(problem.train), values(problem.test)


def pivoted(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """As many single samples, picked by QR with pivoting from the scaled training values of all; the rest stay blue noise."""
    values = divided(problem.train.samples, norm(problem.train.points))
    order = qr(np.concatenate(list(np.moveaxis(values, 2, 0))), mode="r", pivoting=True)[1]
    first = order[: 3 * len(values) // 2]
    rest = np.setdiff1d(np.arange(values.shape[1]), first)[: POINTS - len(first)]
    chosen = np.concatenate([first, rest])
    return problem.train.samples[:, chosen], problem.test.samples[:, chosen]


def exact(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The true mean over each point's patch, from the direct lightmaps: points without sampling error."""
    data, spread = problem.data, problem.data.samples.spacing * np.sqrt(SAMPLES)
    places = np.concatenate([data.samples.position / spread, data.samples.normal / np.sqrt(2)], 1)[:POINTS]
    texels = np.concatenate([data.gbuffer["position"] / spread, data.gbuffer["geometric_normal"] / np.sqrt(2)], 1)
    home = cKDTree(places).query(texels)[1]
    share = np.zeros((POINTS, len(home)), np.float32)
    share[home, np.arange(len(home))] = data.area / np.maximum(np.bincount(home, data.area, POINTS), 1e-12)[home]
    train, test = (
        np.einsum("pt,ltc->lpc", share, data.maps("direct", split) * data.gbuffer["albedo"], optimize=True).astype(np.float64)
        for split in problem.splits
    )
    return train, test


def as_they_are(train: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The scaled values themselves, (lightings, points)."""
    return train, test


def rooted(train: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and their square roots."""
    return np.concatenate([train, np.sqrt(train)], 1), np.concatenate([test, np.sqrt(test)], 1)


def logged(train: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and their logarithms, straight where a value is well below the root mean square."""
    return tuple(np.concatenate([rows, np.log1p(rows * np.sqrt(POINTS))], 1) for rows in (train, test))  # type: ignore[return-value]


def radial(train: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kernel ridge regression with a Gaussian of the square roots, as wide as the median distance."""
    a, b = np.sqrt(train), np.sqrt(test)
    squares = [((rows[:, None] - a) ** 2).sum(2) for rows in (a, b)]
    gram, across = (np.exp(-square / np.median(squares[0])) for square in squares)
    values, vectors = np.linalg.eigh(gram)
    half = vectors / np.sqrt(np.maximum(values, 1e-12))
    return gram @ half, across @ half


@dataclass(frozen=True)
class Way:
    """A closed-form transfer: what is measured, what is made of it, and what the ridge is asked to be good for."""

    measure: Measure = plain
    feature: Feature = as_they_are
    smooth: float = 0.0  # metres over which neighbouring points are expected to act alike
    relative: bool = False  # rows weighted by 1 / brightness of their indirect map, instead of 1 / s
    intercept: bool = False
    even: bool = False  # leave-one-out residuals weighted alike instead of by s²
    power: float = 2.0  # of the norm that scales
    per_basis: bool = False

    def scores(self, problem: Problem) -> np.ndarray:
        """Pooled, median and 90th percentile of the held-out lightings."""
        return problem.scores(self.predicted(problem))

    def predicted(self, problem: Problem) -> np.ndarray:
        """Coefficients of the held-out lightings, (lightings, 3, bases)."""
        train, test = self.measure(problem)
        scale, scale_test = (np.mean(values**self.power, 1) ** (1 / self.power) for values in (train, test))
        train, test = divided(train, scale), divided(test, scale_test)
        if self.smooth:
            spread = likeness(problem, self.smooth)
            train, test = (np.einsum("lpc,pq->lqc", values, spread, optimize=True) for values in (train, test))
        channels = [
            self.channel(train[..., c], test[..., c], scale[:, c], problem.wanted[:, c]) * scale_test[:, c, None]
            for c in range(3)
        ]
        return np.stack(channels, 1)

    def channel(self, train: np.ndarray, test: np.ndarray, scale: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Scaled coefficients of one channel."""
        train, test = self.feature(train, test)
        bright = np.linalg.norm(wanted, axis=1)
        row = scale / np.maximum(bright, BLACK * np.median(bright)) if self.relative else (scale > 0) * 1.0
        importance = (row > 0) * 1.0 if self.relative or self.even else (scale / scale.max()) ** 2
        goal = wanted / np.where(scale > 0, scale, 1)[:, None] * row[:, None]
        groups = np.split(goal, BASES, 1) if self.per_basis else [goal]
        fits = [
            fit_transfer(train * row[:, None], group, ridge="auto", importance=importance, intercept=self.intercept)
            for group in groups
        ]
        parts = [(test - np.asarray(fit.offset)) @ np.asarray(fit.matrix).T + np.asarray(fit.intercept) for fit in fits]
        return np.concatenate(parts, 1)


@dataclass(frozen=True)
class Packaged:
    """What `ddprt.bake` and `ddprt.fit` make of it; `smooth` in distances between points."""

    smooth: float = 0.0
    sunk: bool = True
    space: str = "linear"

    def scores(self, problem: Problem) -> np.ndarray:
        """See `Way`."""
        data = problem.sunk if self.sunk else problem.data
        model = ddprt.fit(data, bases=BASES, space=self.space, settings={"smooth": self.smooth})
        return problem.scores_of(model.predict(data.values(problem.splits[1], POINTS, "radiosity")))


def likeness(problem: Problem, reach: float) -> np.ndarray:
    """A root of K = exp(-distance / reach) max(0, n . n'): a ridge on its products is one on M K^-1 M^T."""
    samples = problem.data.samples
    place, normal = samples.position[:POINTS], samples.normal[:POINTS]
    distance = np.linalg.norm(place[:, None] - place, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-distance / reach) * np.maximum(normal @ normal.T, 0))
    return vectors * np.sqrt(np.maximum(values, 0))


BASE = Way()
SUNK = Way(measure=sunk(0.75, corrected=True))
WAYS: dict[str, Way | Packaged] = {
    'ridge = "auto"': BASE,
    "intercept": replace(BASE, intercept=True),
    "rows by 1 / brightness": replace(BASE, relative=True),
    "leave-one-out unweighted": replace(BASE, even=True),
    "a ridge per basis": replace(BASE, per_basis=True),
    "scale by the 1/2-norm": replace(BASE, power=0.5),
    "values and roots": replace(BASE, feature=rooted),
    "values and logarithms": replace(BASE, feature=logged),
    "Gaussian kernel": replace(BASE, feature=radial),
    "samples by pivoted QR": replace(BASE, measure=pivoted),
    "samples capped": replace(BASE, measure=capped),
    "smooth over 0.3 m": replace(BASE, smooth=0.3),
    **{f"sunk by {depth:g}": Way(measure=sunk(depth)) for depth in (0.25, 0.5, 0.75)},
    **{f"sunk by {depth:g}, corrected": Way(measure=sunk(depth, corrected=True)) for depth in (0.25, 0.5, 0.75, 1)},
    "at 0.75, unweighted": replace(SUNK, even=True),
    "at 0.75, smooth over 0.1 m": replace(SUNK, smooth=0.1),
    "at 0.75, smooth over 0.3 m": replace(SUNK, smooth=0.3),
    "at 0.75, smooth over 1 m": replace(SUNK, smooth=1.0),
    "at 0.75, Gaussian kernel": replace(SUNK, feature=radial),
    "PLAIN": Packaged(sunk=False),
    "SMOOTH 2": Packaged(2.0, sunk=False),
    "PLAIN, GAMMA 2.2": Packaged(sunk=False, space="gamma"),
    "SUNK": Packaged(),
    "SUNK, GAMMA 2.2": Packaged(space="gamma"),
    **{f"SUNK, SMOOTH {reach:g}": Packaged(reach) for reach in (1.0, 2.0, 4.0)},
    "(exact means over patches)": Way(measure=exact),
}


def main(seeds: str = "5") -> None:
    found = {scenario: compare(scenario, int(seeds)) for scenario in SCENARIOS}
    draw_bars(found)


def compare(scenario: str, seeds: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Mean figures of every way and of the floor, printed."""
    each: dict[str, list[np.ndarray]] = {name: [] for name in WAYS}
    floors = []
    for seed in range(seeds):
        problem = Problem(bake(scenario, seed), bake(scenario, seed, DEPTH))
        floors.append(problem.floor)
        for name, way in WAYS.items():
            each[name].append(way.scores(problem))
    floor = np.mean(floors, 0)
    errors = {name: np.mean(rows, 0) for name, rows in each.items()}
    widest = errors['ridge = "auto"'] - floor
    print(f"\n{scenario}, {seeds} seeds; floor: " + ", ".join(f"{f} {v:.3f}" for f, v in zip(FIGURES, floor, strict=True)))
    print(f"{'way':38s}" + "".join(f"{f:>8s}" for f in FIGURES) + "".join(f"{'gap ' + f:>12s}" for f in FIGURES))
    for name, error in errors.items():
        gap = (error - floor) / widest
        print(f"{name:38s}" + "".join(f"{v:8.3f}" for v in error) + "".join(f"{v:12.2f}" for v in gap), flush=True)
    return errors, floor


def draw_bars(found: dict[str, tuple[dict[str, np.ndarray], np.ndarray]]) -> None:
    """docs/near-lamps.png: a bar per way and figure, the floor as a line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, rows = plt.subplots(len(found), 3, figsize=(12, 6.6 * len(found)), sharey="row", layout="constrained")
    for axes, (scenario, (errors, floor)) in zip(np.atleast_2d(rows), found.items(), strict=True):
        for axis, name, column in zip(axes, FIGURES, range(3), strict=True):
            heights = [error[column] for error in errors.values()]
            colours = ["tab:orange" if "sunk" in way or "at 0.75" in way else "tab:blue" for way in errors]
            axis.barh(range(len(heights)), heights, color=colours)
            axis.axvline(floor[column], color="black", label="projection floor")
            axis.axvline((floor[column] + heights[0]) / 2, color="black", linestyle=":", label="half the gap")
            axis.set_yticks(range(len(heights)), list(errors))
            axis.set_xlim(0, 1.3 * heights[0])
            axis.set_title(f"{scenario}: {name}")
        axes[0].invert_yaxis()  # shared by the row, whose ways may not be those of another
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.savefig("docs/near-lamps.png", dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
