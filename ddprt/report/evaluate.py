"""Everything a report says, as data: scores, floors, curves and the check against the reference integrator."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from threadpoolctl import threadpool_limits

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.fitting.basis import entry_weights
from ddprt.fitting.encoding import Encoding
from ddprt.methods.statuses import BLIND
from ddprt.report.metrics import Maps, Truth, negative_share, negative_shares, z_scores
from ddprt.runtime.model import Model
from ddprt.runtime.train import fit_method
from ddprt.scene.mesh import Scene

_STEADY = 0.2  # standard error over brightness below which an estimate counts as near normal
_FEWEST = 8  # lightings that a rank correlation is told of


@dataclass
class Evaluation:
    """What was found on the held-out lightings.

    Attributes:
      metrics: contents of metrics.json.
      truth: the held-out maps.
      values: measured at the points, per held-out lighting.
      predicted: clamped predictions per method.
      curve: error against number of bases, rows of (bases, transfer, projection).
      spot_check: z-scores against the reference integrator, and the values behind them; empty where it was skipped.
      distance: metres from each held-out lighting's nearest lamp to the nearest surface; NaN for distant lights.
    """

    metrics: dict[str, Any]
    truth: Truth
    values: np.ndarray
    predicted: dict[str, np.ndarray]
    curve: list[tuple[int, float, float]] = field(default_factory=list)
    spot_check: dict[str, Any] = field(default_factory=dict)
    distance: np.ndarray = field(default_factory=lambda: np.zeros(0))


@threadpool_limits.wrap(limits=1, user_api="blas")  # so that scores are the same bits on any number of cores
def evaluate(data: Dataset, models: Mapping[str, Model], fit_seconds: Mapping[str, float]) -> Evaluation:
    """Scores models on a dataset's test split.

    Args:
      data: the dataset.
      models: by name of their method.
      fit_seconds: how long each took to fit; 0 where unknown.
    """
    test = data.split("test")
    truth = Truth(data.maps("indirect", test), data.area)
    whole = float(truth.squares.sum())
    predicted, scores, values = {}, {}, np.zeros((0, 0, 3))
    lightings = [data.lightings[index] for index in test]
    for name, model in models.items():
        values = data.values(test, model.points, model.quantity)
        unclamped, relight_seconds = _frame_by_frame(model, values, lightings)
        predicted[name] = np.maximum(unclamped, 0)  # the clamp commutes with decoding, which is odd and rising
        unseen = float(truth.squares[~values.any((1, 2))].sum())
        report = model.relighter.report.noting(*(["blind"] if unseen > BLIND * whole else []))
        shares = negative_shares(unclamped, truth.weight)
        scores[name] = {
            **truth.scores(predicted[name]),
            "negative_share": _finite(negative_share(unclamped, truth.weight)),
            "median_negative_share": _finite(float(np.median(shares))),
            "worst_negative_share": _finite(float(shares.max(initial=0))),
            "fit_seconds": fit_seconds.get(name, 0.0),
            "relight_seconds": relight_seconds,
            "bytes": model.relighter.nbytes,
            "flops": model.relighter.flops,
            "bases": report.bases,
            "status": report.status,
            "remarks": list(report.remarks),
            "trouble": report.trouble,
        }
    lead, main = next(iter(models.items()))
    report = main.relighter.report
    metrics = {
        "schema": 1,
        "scene": data.description["scene"]["name"],
        "texels": int(data.covered.sum()),
        "lightings": {split: len(data.split(split)) for split in ("train", "validation", "test")},
        "dark_test_lightings": int((truth.squares == 0).sum()),
        "methods": scores,
        "floors": {
            "noise_relative_rmse": None if data.lacks("noise") else truth.relative_rmse(data.maps("noise", test)),
            "projection_relative_rmse": projection_error(data, main, truth),
            "mean_relative_rmse": scores.get("mean", {}).get("relative_rmse"),
        },
        "trust": trust_agreement(
            main, data.values(test, main.points, main.quantity), truth.errors_per_lighting(predicted[lead])
        ),
        "numerics": {
            "measurement_condition": [_finite(value) for value in report.condition],
            "numerical_rank": report.numerical_rank,
            "ridge": list(report.ridge),
            "ridge_chosen_by": report.ridge_chosen_by,
        },
    }
    if main.layers:
        from ddprt.report.layers import layer_scores

        metrics["layers"] = layer_scores(data, main)
    evaluation = Evaluation(metrics, truth, values, predicted)
    evaluation.distance = _distance_to_surface(data, main, test)
    return evaluation


def trust_agreement(model: Model, values: np.ndarray, errors: np.ndarray) -> dict[str, Any] | None:
    """How well trust tells the error of held-out lightings; None for models that know no trust.

    Args:
      model: whose trust.
      values: measured light of the lightings, W/m².
      errors: norm over norm of each; NaN where the reference is dark.
    Returns:
      spearman: rank correlation of expected and true error, None for fewer than 8 lightings or none that differ;
      median_expected_error, median_error; flagged_share: of lightings called extrapolating; unseen: lightings with indirect
      light that no point measures, which count nowhere else.
    """
    found = model.trust(values)
    if found is None:
        return None
    seen, lit = values.any((1, 2)), np.isfinite(errors)
    both = seen & lit
    return {
        "spearman": rank_correlation(-found.score[both], errors[both]) if both.sum() >= _FEWEST else None,
        "median_expected_error": float(np.median(1 - found.score[both])) if both.any() else None,
        "median_error": float(np.median(errors[both])) if both.any() else None,
        "flagged_share": float(np.mean(found.extrapolating[both])) if both.any() else None,
        "unseen": int((lit & ~seen).sum()),
    }


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float | None:
    """Spearman's: the correlation of ranks, ties sharing theirs; None where all of one side are equal."""
    from scipy.stats import rankdata

    a, b = rankdata(a) - (len(a) + 1) / 2, rankdata(b) - (len(b) + 1) / 2
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else None


def projection_error(data: Dataset, model: Model, truth: Truth, bases: int | None = None) -> float | None:
    """Error of the best possible coefficients: references encoded, projected on the basis and decoded again."""
    basis = getattr(model.relighter, "basis", None)
    if basis is None:
        return None
    vectors = np.asarray(basis, np.float64)[:bases]
    if len(vectors) == 0:
        return truth.relative_rmse(truth.reference)
    measured = data.values(data.split("test"), model.points, model.quantity)
    mean = np.asarray(getattr(model.relighter, "mean", 0.0), np.float64)
    light = projected(model.encoding, vectors, mean, measured, truth.reference, data.area)
    return truth.relative_rmse(light - truth.reference)


def projected(
    encoding: Encoding,
    vectors: Float64[np.ndarray, "bases entries"],
    mean: Float64[np.ndarray, "*shape"],
    measured: Float32[np.ndarray, "lightings points 3"],
    reference: Maps,
    area: Float64[np.ndarray, " texels"],
    weights: Literal["area", "texel"] = "area",
    *,
    clamp: bool = True,
) -> Maps:
    """Maps by the best possible coefficients, decoded, and without negative light if `clamp`; see `project`."""
    coefficients, scale = project(encoding, vectors, mean, measured, reference, area, weights)
    light = coefficients @ vectors + mean
    back = np.moveaxis(light, 1, 2) if vectors.shape[1] == len(area) else light.reshape(reference.shape)
    return np.asarray(_decoded(encoding, back.astype(np.float32), scale, clamp))


def project(
    encoding: Encoding,
    vectors: Float64[np.ndarray, "bases entries"],
    mean: Float64[np.ndarray, "*shape"],
    measured: Float32[np.ndarray, "lightings points 3"],
    reference: Maps,
    area: Float64[np.ndarray, " texels"],
    weights: Literal["area", "texel"] = "area",
) -> tuple[Float64[np.ndarray, "lightings groups bases"], Float32[np.ndarray, "lightings 3"]]:
    """The best possible coefficients, by least squares under weights that need not be those that the basis was made for.

    Args:
      encoding: of the model.
      vectors: its basis; entries are texels (mono), or channels of texels (multi).
      mean: what it is centred on, or 0.
      measured: light at its points, W/m², which sets the scale; what no point sees is projected as it is.
      reference: what is projected, W/m².
      area: of the texels, m².
      weights: "area", or "texel" to weigh all texels alike.
    Returns:
      Coefficients of the encoded light, and the scale that it was encoded by.
    """
    mono = vectors.shape[1] == len(area)
    scale, encoded = _encoded(encoding, measured, reference)
    encoded = np.asarray(encoded, np.float64)
    rows = np.moveaxis(encoded, 2, 1) if mono else encoded.reshape(len(encoded), 1, -1)
    entries = entry_weights(area, weights, "mono" if mono else "multi").astype(np.float64)
    gram = (vectors * entries) @ vectors.T
    coefficients = np.linalg.solve(gram, (((rows - mean) * entries) @ vectors.T).reshape(-1, len(vectors)).T).T
    return coefficients.reshape(*rows.shape[:2], -1), np.asarray(scale)


@jax.jit
def _encoded(encoding: Encoding, measured: Array, light: Array) -> tuple[Array, Array]:
    scale = encoding.scale(measured)
    scale = jnp.where(scale > 0, scale, 1)
    return scale, encoding.encode(light, scale)


@partial(jax.jit, static_argnames="clamp")
def _decoded(encoding: Encoding, light: Array, scale: Array, clamp: bool) -> Array:
    return encoding.decode(light, scale, clamp=clamp)


def bases_curve(data: Dataset, config: Config, truth: Truth) -> list[tuple[int, float, float]]:
    """Figure 14 of the paper: (bases, error of transfer, error of projection), as far as the data's rank goes.

    One fit serves all: bases are nested, and so are the rows of the transfer matrix under one ridge.
    """
    test = data.split("test")
    settings = {**config.methods.settings.get("svd-ridge", {}), "bases": max(config.report.bases_curve)}
    model = fit_method(
        data,
        config.fit,
        "svd-ridge",
        settings,
        points=config.fit.points or None,
        quantity=config.points.quantity,
        seed=config.seed,
    )
    values, whole = data.values(test, model.points, model.quantity), model.relighter.report.bases
    has_mean = whole - len(model.relighter.basis)
    if whole == 0:
        return []
    lightings, rows = [data.lightings[index] for index in test], []
    for bases in sorted({min(bases, whole) for bases in config.report.bases_curve if bases > has_mean}):
        shorter = replace(model, relighter=model.relighter.truncated(bases - has_mean))
        error = truth.relative_rmse(np.maximum(_frame_by_frame(shorter, values, lightings)[0], 0) - truth.reference)
        floor = projection_error(data, model, truth, bases - has_mean)
        if error is not None and floor is not None:
            rows.append((bases, error, floor))
    return rows


def spot_check(scene: Scene, data: Dataset, config: Config) -> dict[str, Any]:
    """Held-out maps against the unbiased reference integrator at random texels.

    The variance of both sides counts. Values whose paths are too few to be near normal (a standard error of a fifth of the
    brightness or more, as on a floor that hardly sees an object) give no z-score, but count in the bias.

    Returns:
      z-scores, the relative bias, and the values of both sides, (lightings, texels, 3); empty where it is switched off, with
      None for what no value tells; empty too where light passes through bodies or hair: the reference follows neither.
    """
    from ddprt.transport.effects import plan
    from ddprt.transport.embree import Tracer
    from ddprt.transport.hairiness import hairy
    from ddprt.transport.openness import build_open_atlas
    from ddprt.transport.reference import Estimate, on_texels, trace_reference
    from ddprt.transport.translucency import filled

    test = data.split("test")[: config.report.spot_check_lightings]
    count = min(config.report.spot_check_texels, int(data.covered.sum()))
    if count == 0 or any(filled(scene)) or hairy(scene):
        return {}
    tracer = Tracer.of(scene, config.transport.threads)
    atlas, _ = build_open_atlas(tracer, scene, config.atlas.resolution, config.atlas.padding)
    rng = seeds.stream(config.seed, "spot check")
    texels = np.sort(rng.choice(atlas.count, count, replace=False))
    before = tracer.rays
    bounces = plan(scene, data.lightings, bounces=config.transport.bounces).bounces

    def paths(run: str) -> list[Estimate]:
        start, samples = on_texels(tracer, atlas, texels), config.report.spot_check_samples
        numbers = [seeds.number(config.seed, f"spot check {run}", index) for index in test]
        return [
            trace_reference(tracer, scene, data.lightings[index], start, count, samples, seed=number, bounces=bounces)
            for index, number in zip(test, numbers, strict=True)
        ]

    truth = np.stack([estimate.indirect for estimate in paths("light")])
    # Path sums are skewed: a low mean comes with a low variance, which would shift z. So the variance, and the choice of
    # texels whose estimates are near normal at all, come from a second run.
    second = paths("variance")
    brightness, variance = (np.stack([getattr(e, part) for e in second]) for part in ("indirect", "indirect_variance"))
    steady = np.sqrt(variance) < _STEADY * brightness
    baked = data.maps("indirect", test)[:, texels].astype(np.float64)
    variance += _bake_variance(brightness, data.maps("noise", test)[:, texels].astype(np.float64))
    variance[~steady] = 0
    return {
        **z_scores(baked, truth, variance),
        "texels": count,
        "lightings": len(test),
        "baked": baked,
        "truth": truth,
        "variance": variance,
        "rays": tracer.rays - before,
    }


def _bake_variance(brightness: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Variance of the bake from its half differences, proportional to brightness as for counts of rays that see light.

    Pooled over texels and lightings of a channel: a single half difference says little, and all lightings share their rays.
    """
    share = np.sum(noise**2, (0, 1)) / np.maximum(np.sum(brightness, (0, 1)), 1e-300)
    return share * brightness


def _frame_by_frame(model: Model, values: np.ndarray, lightings: Sequence[Any]) -> tuple[np.ndarray, float]:
    """Unclamped prediction of every frame through the public API, and the median seconds of one, compiled before."""
    model.predict(values[0], lightings=lightings[0], clamp=False, constant=False)
    light, seconds = [], []
    for frame, lighting in zip(values, lightings, strict=True):
        start = time.perf_counter()
        light.append(model.predict(frame, lightings=lighting, clamp=False, constant=False))
        seconds.append(time.perf_counter() - start)
    return np.stack(light), float(np.median(seconds))


def _distance_to_surface(data: Dataset, model: Model, indices: list[int]) -> np.ndarray:
    if data.lacks("mesh"):
        return np.full(len(indices), np.nan)
    anchors = [[a for light in data.lightings[i] if (a := light.anchor()) is not None] for i in indices]
    tracer = model._tracer
    return np.array([float(tracer.clearance(np.array(a)).min()) if a else np.nan for a in anchors])


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
