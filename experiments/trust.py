"""Does trust tell the error of a relit lightmap, for lightings that the model was never trained for? The paper's Figure 8.

Question: which score of the measured light ranks lightings as their true errors do, inside of what was trained on and far
          outside: trained on points or spots under the ceiling, asked for lamps near the floor, near surfaces, in colour,
          several at once, of area, of the other kind, and for a directional light? Does fading to the mean help there?
Command:  python experiments/trust.py [--quick] [SEEDS ...]
Answer:   docs/stability.md
"""

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import ddprt
from ddprt import seeds
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.lights import DirectionalLight, Lighting, SpotLight
from ddprt.report.evaluate import rank_correlation
from ddprt.report.metrics import Truth
from ddprt.runtime.model import Model
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

UPPER = {"region_low": "[0.1, 0.5, 0.1]", "region_high": "[0.9, 0.8, 0.9]", "clearance": "0.1"}
FLOOR = {"region_low": "[0.05, 0.0, 0.05]", "region_high": "[0.95, 0.25, 0.95]", "clearance": "0.05"}
KINDS = {
    "points": UPPER,
    "spots": UPPER,
    "near the floor": FLOOR,
    "3 mm off surfaces": {"clearance": "0.003"},
    "coloured": {**UPPER, "saturation": "[0.5, 1.0]"},
    "2 to 4 at once": {**UPPER, "lights": "[2, 4]"},
    "area lights": {**UPPER, "kinds": '["rect"]', "size": "0.1"},
    "directional": UPPER,
}
TRAINED = ("points", "spots")
QUICK = ("points", "spots", "near the floor", "3 mm off surfaces", "area lights")


@dataclass
class Asked:
    """What one model was asked, and what it said: an entry per held-out lighting that is lit and measured."""

    name: str
    kind: np.ndarray
    error: np.ndarray
    scores: dict[str, np.ndarray]
    flagged: np.ndarray
    faded: np.ndarray
    of_mean: np.ndarray


def main(*arguments: str) -> None:
    if "--quick" in arguments:
        print(json.dumps(quick()))
        return
    runs = []
    for seed in [int(text) for text in arguments] or [0, 1, 2]:
        for scene in ("cornell", "corridor"):
            for trained in TRAINED:
                with tempfile.TemporaryDirectory() as folder:
                    data, kinds = baked(scene, trained, seed, Path(folder), size=(64, 96, 24, 12), asked=tuple(KINDS))
                    runs.append(answers(data, ddprt.fit(data), kinds, f"{scene}, {trained}, seed {seed}"))
                print(f"{runs[-1].name:28s} rank correlation {agreement(runs[-1:]):.3f}", flush=True)
    for name in ("cornell", "cornell-near"):
        if Path(f"runs/{name}/dataset").is_dir():
            data = ddprt.open_dataset(f"runs/{name}/dataset")
            run = answers(data, ddprt.fit(data), np.full(len(data.split("test")), "as trained"), f"runs/{name}")
            print(f"{run.name:28s} rank correlation {agreement([run]):.3f}")
    tell(runs)
    draw(runs, Path("docs/trust.png"))


def quick() -> dict[str, float]:
    """The pooled rank correlation of trust and error in a small Cornell box."""
    with tempfile.TemporaryDirectory() as folder:
        data, kinds = baked("cornell", "points", 0, Path(folder), size=(48, 64, 12, 8), asked=QUICK)
        return {"spearman_trust": agreement([answers(data, ddprt.fit(data), kinds, "quick")])}


def baked(
    name: str, trained: str, seed: int, folder: Path, *, size: tuple[int, int, int, int], asked: tuple[str, ...]
) -> tuple[Dataset, np.ndarray]:
    """A dataset with test lightings of all kinds asked for, and their kinds; size: texels, train, validation, of each kind."""
    scene = ddprt.load_scene(name)
    tracer, (resolution, train, validation, each) = Tracer.of(scene), size
    kinds = [kind for kind in asked if kind != "directional" or name == "cornell"]  # the corridor has no opening
    lightings = {
        "train": lamps(scene, tracer, trained, "train", train, seed),
        "validation": lamps(scene, tracer, trained, "validation", validation, seed),
        "test": [lamp for kind in kinds for lamp in lamps(scene, tracer, kind, f"test {kind}", each, seed, trained)],
    }
    changes = {"atlas.resolution": resolution, "points.supersample": 4, "transport.samples": 128, "transport.test_samples": 256}
    config = load_config(None, {"seed": str(seed), **{key: str(value) for key, value in changes.items()}})
    return ddprt.bake(scene, lightings, config=config, out=folder), np.repeat(
        ["as trained" if kind == trained else kind for kind in kinds], each
    )


def lamps(scene: Scene, tracer: Tracer, kind: str, split: str, count: int, seed: int, trained: str = "") -> list[Lighting]:
    """Lightings of a kind; what is not a kind of lamp is asked of the kind of lamp that was trained on."""
    config = load_config(None, {f"lightings.{key}": value for key, value in KINDS[kind].items()}).lightings
    bounds = np.array(scene.bounds)
    drawn = draw_lightings(config, split, count, bounds=bounds, clearance=tracer.clearance, seed=seed).lightings
    lightings = []
    for index, lighting in enumerate(drawn):
        rng = seeds.stream(seed, f"aim {split}", index)
        if kind == "directional":  # in through the open side of the box
            way = rng.uniform([-0.4, -0.6, 1], [0.4, 0.2, 1])
            lighting = (DirectionalLight(direction=tuple(way.tolist()), irradiance=(1, 1, 1)),)
        elif kind == "spots" or (trained == "spots" and kind not in ("points", "area lights")):
            lighting = tuple(spot(lamp, rng) for lamp in lighting)
        lightings.append(lighting)
    return lightings


def spot(lamp: object, rng: np.random.Generator) -> SpotLight:
    """A spot in the place of a point light that shines down, more or less."""
    x, z, outer = rng.uniform([-0.7, -0.7, 35], [0.7, 0.7, 60])
    place, power = lamp.position, lamp.intensity  # type: ignore[attr-defined]
    return SpotLight(position=place, direction=(x, -1, z), intensity=power, inner_deg=0.6 * outer, outer_deg=outer)


def answers(data: Dataset, model: Model, kinds: np.ndarray, name: str) -> Asked:
    """Errors of a model on the test split, and every score that might tell them; a high score stands for a high error."""
    test, ruler = data.split("test"), model.yardstick
    assert ruler is not None
    truth, values = Truth(data.maps("indirect", test), data.area), data.values(test, model.points, model.quantity)
    found, light = model.trust(values), model.predict(values)
    assert found is not None
    error = truth.errors_per_lighting(light)
    known = np.isfinite(error) & values.any((1, 2))
    scale = np.asarray(model.encoding.scale(jnp.asarray(values)), np.float64)
    x = values / np.where(scale > 0, scale, 1)[:, None]
    weight = scale**2 / np.maximum((scale**2).sum(1, keepdims=True), 1e-300)
    p = np.einsum("gdi,fig->fgd", ruler.directions, x)
    trained = data.values(data.split("train"), model.points, model.quantity).astype(np.float64)
    trained /= np.maximum(np.linalg.norm(trained, axis=1, keepdims=True), 1e-300)
    cosine = np.max(np.einsum("lpc,fpc->flc", trained, x), 1)
    brightness = np.sqrt(truth.per_lighting(light)) / np.maximum(np.sqrt((scale**2).mean(1)), 1e-300)
    novelty = (1 - found.score) ** (1 / ruler.exponent)
    scores = {
        "1 - trust": 1 - found.score,
        "leverage": found.leverage,
        "unexplained": found.unexplained,
        "badly determined directions": 1 - np.einsum("fgd,gd,fg->f", p**2, ruler.shares < 0.5, weight),
        "nearest training lighting": np.einsum("fc,fc->f", 1 - cosine**2, weight),
        "faintness of the answer": 1 / np.maximum(brightness, 1e-30),
        "novelty over brightness": np.sqrt(novelty) / np.maximum(brightness, 1e-30),
    }
    faded = truth.errors_per_lighting(model.predict(values, fade=True))
    mean = truth.errors_per_lighting(model.predict(ruler.mean) * scale[:, None].astype(np.float32))
    return Asked(
        name,
        kinds[known],
        error[known],
        {k: s[known] for k, s in scores.items()},
        found.extrapolating[known],
        faded[known],
        mean[known],
    )


def agreement(runs: list[Asked], score: str = "1 - trust", kind: str = "") -> float:
    """Rank correlation of a score and the true error over all lightings of some runs."""
    chosen = [(run.scores[score][mask], run.error[mask]) for run in runs for mask in [np.isin(run.kind, kind or run.kind)]]
    found = rank_correlation(*(np.concatenate(side) for side in zip(*chosen, strict=True)))
    return np.nan if found is None else found


def tell(runs: list[Asked]) -> None:
    """The tables."""
    print("\n| score | worst run | median run | all runs pooled |\n| --- | --- | --- | --- |")
    for score in runs[0].scores:
        each = [agreement([run], score) for run in runs]
        print(f"| {score} | {min(each):.3f} | {np.median(each):.3f} | {agreement(runs, score):.3f} |")
    for trained in TRAINED:
        some = [run for run in runs if trained in run.name]
        print(f"\n| asked of models trained on {trained} | true error | expected | flagged | faded | mean | rank correlation |")
        print("| --- | --- | --- | --- | --- | --- | --- |")
        for kind in dict.fromkeys(kind for run in some for kind in ("as trained", *run.kind)):
            pick = lambda part: np.concatenate([part(run)[run.kind == kind] for run in some])  # noqa: B023, E731
            error, expected = pick(lambda run: run.error), pick(lambda run: run.scores["1 - trust"])
            faded, mean, flagged = (pick(lambda run, n=name: getattr(run, n)) for name in ("faded", "of_mean", "flagged"))
            middle = " | ".join(f"{np.median(part):.3f}" for part in (error, expected))
            print(f"| {kind} | {middle} | {flagged.mean():.0%} | {np.median(faded):.3f} | ", end="")
            print(f"{np.median(mean):.3f} | {agreement(some, kind=kind):.2f} |")
    error, expected = (
        np.concatenate([part(run) for run in runs]) for part in (lambda r: r.error, lambda r: r.scores["1 - trust"])
    )
    half, most = np.exp(np.quantile(np.abs(np.log(expected / error)), [0.5, 0.9]))
    print(f"\n{len(error)} lightings: expected over true error off by a factor of {half:.2f} (median), {most:.2f} (90th pct.)")
    print(json.dumps({"spearman_trust": agreement(runs), "worst_run": min(agreement([run]) for run in runs)}))


def draw(runs: list[Asked], path: Path) -> None:
    """Expected against true error, kinds in colours, one panel per trained kind."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4.8), sharex=True, sharey=True, layout="constrained")
    for axis, trained in zip(axes, TRAINED, strict=True):
        some = [run for run in runs if trained in run.name]
        for colour, kind in enumerate(["as trained", *KINDS]):
            x, y = (
                np.concatenate([side[run.kind == kind] for run, side in pairs])
                for pairs in (
                    [(run, run.scores["1 - trust"]) for run in some],
                    [(run, run.error) for run in some],
                )
            )
            if len(x):
                axis.loglog(x, y, "o", ms=3.5, alpha=0.6, color=f"C{colour}", label=kind, mew=0)
        axis.plot([0.01, 1], [0.01, 1], color="0.6", lw=1, zorder=0)
        axis.set_title(
            f"trained on {trained}, 2 scenes, {len(some) // 2} seeds: rank correlation {agreement(some):.2f}", fontsize=10
        )
        axis.set_xlabel("expected error, 1 - trust")
        axis.legend(fontsize=8, frameon=False)
    axes[0].set_ylabel("true error, norm over norm")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
