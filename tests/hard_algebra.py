"""Hard cases that are arrays alone: encoding, basis, transfer, prediction and files, with no scene to bake.

Most cases make a small dataset in memory, fit it through `ddprt.fit` and judge every layer on its own (`judge`): a layer
takes what the layer before it really left, so that each bound holds the rounding of one step and no cancellation hides an
error. Bounds and their derivations stand in `oracles.py`.
"""

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import oracles
from hard_cases import HardCase, Outcome
from oracles import TINY32, U32, U64, over_bound, rounding

import ddprt
import ddprt.export.textures
from ddprt.config import FitConfig
from ddprt.dataset import store
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors
from ddprt.fitting.basis import RANK_CUT, entry_weights, fit_basis
from ddprt.fitting.transfer import Transfer, fit_transfer
from ddprt.methods.statuses import STATUSES
from ddprt.runtime.model import Model
from ddprt.runtime.train import examples
from ddprt.sampling.points import Samples
from ddprt.scene.exr import exposure_for, read_exr, write_exr

TRAIN, VALIDATION, TEST = 12, 3, 4
POINTS, TEXELS, BASES = 10, 23, 6
_LAMP = {"type": "point", "position": [0.0, 1.0, 0.0], "intensity": [1.0, 1.0, 1.0]}


# --- data sets in memory ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Arrays(Dataset):
    """A dataset whose light was never on a disk."""

    measured_light: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    indirect_light: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))

    def values(self, indices: Any, points: int, quantity: str) -> np.ndarray:
        return self.measured_light[list(indices), :points]

    def maps(self, kind: str, indices: Any) -> np.ndarray:
        return self.indirect_light[list(indices)]


def make_data(measured: np.ndarray, indirect: np.ndarray, area: np.ndarray | None = None, train: int | None = None) -> Arrays:
    """Columns of light as a dataset; what is not for training is shared out between validation and test."""
    count, points = measured.shape[:2]
    train = count - VALIDATION - TEST if train is None else train
    splits = ["train"] * train + ["validation"] * VALIDATION + ["test"] * TEST
    description = {
        "schema": store.SCHEMA,
        "scene": {"name": "arrays", "digest": "0"},
        "atlas": {"resolution": indirect.shape[1]},
        "points": {"count": points},
        "lightings": [{"split": split, "lights": [_LAMP]} for split in splits[:count]],
    }
    data = Arrays(Path(), description, None, measured.astype(np.float32), indirect.astype(np.float32))
    texels = indirect.shape[1]
    area = np.linspace(1, 2, texels) if area is None else area
    places = np.linspace(0, 1, 3 * points).reshape(points, 3)
    data.__dict__["gbuffer"] = {"area": area.astype(np.float32)[:, None]}
    data.__dict__["covered"] = np.ones((1, texels), bool)
    data.__dict__["samples"] = Samples(places, np.tile([0.0, 1.0, 0.0], (points, 1)), np.ones((points, 3)), 0.1)
    data.__dict__["occluders"] = np.zeros((1, 3, 3))
    data.__dict__["uv"] = None
    return data


def room(
    rank: int = 8,
    *,
    train: int = TRAIN,
    points: int = POINTS,
    texels: int = TEXELS,
    seed: int = 0,
    spread: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Measured and indirect light of a made-up room: positive, of so many independent directions, one transport for all."""
    rng = np.random.default_rng(seed)
    count = train + VALIDATION + TEST
    lamps = rng.random((count, rank, 3)) * np.reshape(1.0 if spread is None else spread, (-1, 1))
    measured = np.einsum("lrc,rp->lpc", lamps, rng.random((rank, points)))
    indirect = np.einsum("lrc,rt->ltc", lamps, rng.random((rank, texels)))
    return measured.astype(np.float32), indirect.astype(np.float32)


# --- judging each layer by its bound ----------------------------------------------------------------------------------


def judge(data: Dataset, model: Model, probes: np.ndarray | None = None) -> float:
    """Worst error over bound of encoding, basis, transfer and prediction of a linear model."""
    relighter, encoding = model.relighter, model.encoding
    mono = encoding.channels == "mono"
    train = data.split("train")
    given = data.values(train, model.points, model.quantity), data.maps("indirect", train)
    # Compiled as the fit does it: other code rounds quotients in another way, and every layer starts from what was there.
    pairs = examples(data, "train", encoding, FitConfig(channels=encoding.channels), model.points, model.quantity)
    seen = [np.asarray(pairs.frame.values), np.asarray(pairs.indirect)]
    exact = [oracles.bound_encode(light, given[0], encoding) for light in given]
    worst = [over_bound(got - light, bound) for got, (light, bound) in zip(seen, exact, strict=True)]
    z, y = (np.moveaxis(a, 2, 1) if mono else a.reshape(len(a), 1, -1) for a in seen)
    groups = 3 if mono else 1
    probes = data.values(data.split("test"), model.points, model.quantity) if probes is None else probes
    lit = np.asarray(pairs.scale)[:, :groups] > 0
    if not lit.any():
        return max(*worst, over_bound(model.predict(probes), 0.0))
    weights = entry_weights(pairs.area, "area", encoding.channels)
    U = np.asarray(relighter.basis, float)
    centre = bool(np.any(np.asarray(relighter.mean)) or np.any(np.asarray(relighter.offset)))
    worst.append(judge_basis(y[lit], weights, U, np.asarray(relighter.mean, float), relighter.report, centre))
    y = y.astype(float) - y[lit].mean(0, dtype=float) if centre else y.astype(float)
    fits = zip(np.flatnonzero(lit.any(0)), relighter.report.ridge, strict=True) if len(U) else ()
    for group, ridge in fits:
        rows = lit[:, group]
        C = (y[rows, group] * weights) @ U.T
        # Compiled code may keep float64 vectors for the product and only store float32 ones: u32 of each term.
        doubt = (U32 + rounding(U.shape[1] + 4, U64)) * (np.abs(y[rows, group]) * weights) @ np.abs(U).T
        fitted = [np.asarray(part[group], float) for part in (relighter.matrix, relighter.offset, relighter.intercept)]
        worst.append(judge_transfer(z[rows, group].astype(float), C, doubt, ridge, fitted, centre))
    for clamp in (False, True):
        truth, bound = oracles.bound_predict(relighter, encoding, probes, clamp=clamp)
        worst.append(over_bound(model.predict(probes, clamp=clamp) - truth, bound))
    return max(worst)


def judge_basis(rows: np.ndarray, weights: np.ndarray, U: np.ndarray, mean: np.ndarray, report: Any, centre: bool) -> float:
    """Orthonormal, spanning as much as any space of its size, with the right singular values and rank.

    Eckart-Young under a perturbed Gram matrix: trace(U G U^T) is at least the K largest eigenvalues less 2 K ||E||, so the
    squared residual is at most its minimum plus 2 K ||E||; float32 vectors turn each by u32, three times over a projection.
    """
    exact_mean = rows.mean(0, dtype=float) if centre else np.zeros(rows.shape[1])
    root = np.sqrt(weights.astype(float))
    A = (rows - exact_mean) * root
    sigma = np.linalg.svd(A, compute_uv=False)
    sigma = np.concatenate([sigma, np.zeros(max(0, len(rows) - len(sigma)))])
    moved, size, kept = oracles.bound_gram(A), float(np.linalg.norm(A)), len(U)
    got = np.asarray(report.singular_values)
    slack = oracles.bound_singular_values(sigma, moved)
    cut = RANK_CUT * sigma[0]
    ranks = int((sigma > cut + slack).sum()), int((sigma > cut - slack).sum())
    if not ranks[0] <= report.numerical_rank <= ranks[1]:
        return np.inf
    V = U * root
    residual = A - A @ V.T @ V
    least = np.sqrt((sigma[kept:] ** 2).sum())
    slack_of_span = np.sqrt(least**2 + 2 * kept * moved) - least + 3 * U32 * np.sqrt(kept) * size
    return max(
        over_bound(
            mean - exact_mean, U32 * np.abs(exact_mean) + rounding(len(rows), U64) * np.abs(rows).max(initial=0) + TINY32
        ),
        over_bound(got[: len(sigma)] - sigma[: len(got)], slack[: len(got)]),
        # An entry of V V^T is a sum of products of two float32 numbers of norm 1: 2 u32, and as much again second order.
        over_bound(V @ V.T - np.eye(kept), rounding(3, U32) + rounding(rows.shape[1], U64)),
        over_bound(max(float(np.linalg.norm(residual)) - least, 0.0), slack_of_span),
    )


def right_transfer(X: np.ndarray, C: np.ndarray, ridge: Any, doubt: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """M and its bound, of centred data: by exact elimination where the ridge holds all that a rank cut would drop.

    Where the ridge is too weak to hold the rounding of float32 data back, those directions are cut. A ridge per point is a
    ridge of 1 on measurements stretched by 1 / sqrt(ridge); how many directions count is for the plain ones to say.
    """
    plain = np.linalg.svd(X, compute_uv=False)
    rank = int((plain > RANK_CUT * plain[0]).sum())
    if rank == 0:
        return np.zeros((C.shape[1], X.shape[1])), np.zeros((C.shape[1], X.shape[1]))
    root = np.sqrt(np.array(ridge)) if isinstance(ridge, tuple) else np.ones(X.shape[1])
    X, ridge = X / root, 1.0 if isinstance(ridge, tuple) else ridge
    S = np.append(np.linalg.svd(X, compute_uv=False), 0.0)
    held = ridge >= (RANK_CUT * S[0]) ** 2
    M = oracles.exact_ridge(X, C, ridge) if held else oracles.truncated_ridge(X, C, ridge, rank)
    bound = oracles.bound_ridge(X, C, M, ridge, rank, doubt)
    # A cut drops at most sigma / ridge of what the ridge holds; without one, the twin is as inexact as what it checks.
    return M / root, (bound + np.linalg.norm(C) * S[rank] / ridge if held else 2 * bound) / root


def judge_transfer(X: np.ndarray, C: np.ndarray, doubt: np.ndarray, ridge: Any, parts: list[np.ndarray], centre: bool) -> float:
    """Means and ridge solution, at the ridge that was given or reported."""
    M, offset, start = parts
    d0, c0 = (X.mean(0), C.mean(0)) if centre else (np.zeros(X.shape[1]), np.zeros(C.shape[1]))
    mean_error = rounding(len(X), U64)
    exact, bound = right_transfer(X - d0, C - c0, ridge, float(np.linalg.norm(doubt)))
    return max(
        over_bound(offset - d0, U32 * np.abs(d0) + mean_error * np.abs(X).max(0) + TINY32),
        over_bound(start - c0, U32 * np.abs(c0) + doubt.max(0) + mean_error * np.abs(C).max(0) + TINY32),
        over_bound(M - exact, bound),
    )


def judge_fit(fit: Transfer, X: np.ndarray, C: np.ndarray, ridge: Any, intercept: bool) -> float:
    """`judge_transfer` of what `fit_transfer` returned."""
    parts = [np.asarray(part, float) for part in (fit.matrix, fit.offset, fit.intercept)]
    return judge_transfer(X.astype(float), C.astype(float), np.zeros(C.shape), ridge, parts, intercept)


def predicts_lawfully(model: Model, values: np.ndarray) -> float:
    """0 if twice the light gives exactly twice the result, black gives black and a saved model answers alike, else inf."""
    light = model.predict(values)
    with tempfile.TemporaryDirectory() as folder:
        model.save(folder)
        same = (ddprt.load_model(folder).predict(values) == light).all()
    # A power of two changes no digit, as long as neither end of float32 is near.
    double = (model.predict(2 * values) == 2 * light).all() or np.abs(values).max() > 1e37 or np.abs(values).max() < 1e-36
    return 0.0 if same and double and (model.predict(0 * values) == 0).all() else np.inf


def refused(error: UserError) -> Outcome:
    """A refusal is right if it is one clear line that says what it got."""
    return Outcome(0.0 if "\n" not in str(error) and "got" in str(error) else np.inf, "refused")


def relit(
    make: Callable[[], tuple[np.ndarray, np.ndarray]],
    probes: np.ndarray | None = None,
    area: np.ndarray | None = None,
    method: str = "svd-ridge",
    **options: Any,
) -> Callable[[], Outcome]:
    """A case: fit the columns, keep the laws of every method, and judge a linear one layer by layer."""

    def run() -> Outcome:
        measured, indirect = make()
        data = make_data(measured, indirect, area)
        asked = data.measured_light[-TEST:] if probes is None else probes.astype(np.float32)
        try:
            model = ddprt.fit(data, method, **{"bases": BASES, **options})
        except UserError as error:
            return refused(error)
        light = model.predict(asked)
        worst = predicts_lawfully(model, asked)
        if method == "svd-ridge":
            worst = max(worst, judge(data, model, asked))
        return Outcome(worst, model.relighter.report.status, bool(np.isfinite(light).all()))

    return run


def changed(change: Callable[[np.ndarray, np.ndarray], None], rank: int = 8, **sizes: Any) -> Callable[[], tuple]:
    """A room whose light a case spoils in place."""

    def make() -> tuple[np.ndarray, np.ndarray]:
        measured, indirect = room(rank, **sizes)
        change(measured, indirect)
        return measured, indirect

    return make


def transferred(
    make: Callable[[], tuple[np.ndarray, np.ndarray]], ridge: Any, *, intercept: bool = False
) -> Callable[[], Outcome]:
    """A case: the transfer alone, against 50 digits (or float64 beyond a rank cut)."""

    def run() -> Outcome:
        X, C = (part.astype(np.float32) for part in make())
        try:
            fit = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge, intercept=intercept)
        except UserError as error:
            return refused(error)
        finite = bool(np.isfinite(fit.matrix).all())
        if ridge != "auto" and not np.isfinite(ridge).all():
            return Outcome(np.inf, fit.status, finite)  # fitted, instead of refused
        return Outcome(judge_fit(fit, X, C, fit.ridge if ridge == "auto" else ridge, intercept), fit.status, finite)

    return run


def _nothing_left() -> Outcome:
    """A ridge past any signal leaves no map: at most what float64 rounding of C on the strongest direction would."""
    X, C = (part.astype(np.float32) for part in problem())
    fit = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=1e300)
    bound = U64 * float(np.linalg.norm(C)) / float(np.linalg.norm(X, 2))
    return Outcome(over_bound(np.asarray(fit.matrix), bound), fit.status)


def problem(lightings: int = 12, points: int = 10, bases: int = 4, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Measurements and coefficients that a linear map relates but for some noise."""
    rng = np.random.default_rng(seed)
    X = rng.random((lightings, points))
    return X, X @ rng.normal(size=(points, bases)) + 0.1 * rng.normal(size=(lightings, bases))


def measured_by(matrix: np.ndarray) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Measurements with a famous matrix, and coefficients that follow from them."""
    return lambda: (matrix, matrix @ np.random.default_rng(1).normal(size=(matrix.shape[1], 4)))


# --- how cases spoil a room -------------------------------------------------------------------------------------------


def _duplicate(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:, 7:] = measured[:, 6:7]


def _nearly_duplicate(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:, 9] = measured[:, 8] * np.float32(1 + 2 * U32)


def _collinear(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:, 8] = 0.5 * measured[:, 0] + 0.25 * measured[:, 1]
    measured[:, 9] = 0.5 * measured[:, 2] + 2 * measured[:, 3]


def _coincident(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:] = measured[:, :1]


def _equal_lightings(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:], indirect[:] = measured[:1], indirect[:1]


def _nearly_equal_lightings(measured: np.ndarray, indirect: np.ndarray) -> None:
    shift = 1 + 1e-7 * np.random.default_rng(1).random(indirect.shape)
    measured[:], indirect[:] = measured[:1], (indirect[:1] * shift).astype(np.float32)


def _some_dark(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[2:5] = indirect[2:5] = 0


def _all_dark(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:] = indirect[:] = 0


def _one_lit(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[1:TRAIN] = indirect[1:TRAIN] = 0


def _nothing_bounces(measured: np.ndarray, indirect: np.ndarray) -> None:
    indirect[:] = 0


def _red(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[..., 1:] = indirect[..., 1:] = 0


def _primaries(measured: np.ndarray, indirect: np.ndarray) -> None:
    for index in range(len(measured)):
        measured[index, :, np.arange(3) != index % 3] = 0
        indirect[index, :, np.arange(3) != index % 3] = 0


def _unseen(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[3:6] = 0
    indirect[3:6] *= 1e3


def _barely_seen(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[3] *= np.float32(1e-6)
    measured[4] *= np.float32(1e-12)


def _hardly_seen_at_all(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[3] *= np.float32(1e-30)
    indirect[3] *= np.float32(1e10)


def _one_bright(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[5] *= 1e6
    indirect[5] *= 1e6


def _times(factor: float) -> Callable[[np.ndarray, np.ndarray], None]:
    def change(measured: np.ndarray, indirect: np.ndarray) -> None:
        measured *= np.float32(factor)
        indirect *= np.float32(factor)

    return change


def _every_size(measured: np.ndarray, indirect: np.ndarray) -> None:
    size = np.logspace(-30, 30, len(measured)).astype(np.float32)[:, None, None]
    measured *= size
    indirect *= size


def _high_dynamic_range(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured *= np.logspace(-6, 6, measured.shape[1]).astype(np.float32)[:, None]
    indirect *= np.logspace(-6, 6, indirect.shape[1]).astype(np.float32)[:, None]


def _noisy(measured: np.ndarray, indirect: np.ndarray) -> None:
    indirect[:, 5] = 0
    indirect[:, 6:9] *= -1e-3
    measured[:, 3] = 0
    measured[::2, 4] *= -1e-4


def _offset(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured += 1e4
    indirect += 1e4


def _single_spike(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:] = indirect[:] = 0
    for index in range(len(measured)):
        measured[index, index % POINTS] = 1
        indirect[index, index % TEXELS] = 1


def _clustered() -> tuple[np.ndarray, np.ndarray]:
    """Indirect light with three equal singular values, twice: any rotation of each three is a basis."""
    rng = np.random.default_rng(4)
    count = TRAIN + VALIDATION + TEST
    vectors = np.linalg.qr(rng.normal(size=(TEXELS, 6)))[0].T
    size = np.repeat([1.0, 1e-3], 3)
    turns = np.linalg.qr(rng.normal(size=(3 * count, 6)))[0].reshape(count, 3, 6)
    light = np.einsum("lck,k,kt->ltc", turns, size, vectors)
    measured = np.einsum("lck,kp->lpc", turns, rng.normal(size=(6, POINTS)))
    return measured.astype(np.float32), light.astype(np.float32)


def _hilbert(rows: int, columns: int) -> np.ndarray:
    return 1 / (1.0 + np.arange(rows)[:, None] + np.arange(columns))


def _vandermonde(rows: int, columns: int) -> np.ndarray:
    return np.linspace(0.1, 1, rows)[:, None] ** np.arange(columns)


def _duplicated_problem() -> tuple[np.ndarray, np.ndarray]:
    X, C = problem()
    X[:, 7:] = X[:, 6:7]
    return X, C


def _near_problem() -> tuple[np.ndarray, np.ndarray]:
    X, C = problem()
    X[:, 9] = X[:, 8] * (1 + 1e-7 * np.arange(12))
    return X, C


# --- cases with a right answer of their own ---------------------------------------------------------------------------


def _subspaces() -> Outcome:
    """Leading spaces of data with known gaps, against Davis and Kahan.

    The Gram matrix is off by ||E||, so the left space turns by at most t = ||E|| / (sigma_k² - sigma_k+1² - ||E||) and the
    right one, A^T times it, by sigma_k+1 / sigma_k times as much; the float32 vectors add u32 sqrt(k).
    """
    rng = np.random.default_rng(5)
    sigma = np.repeat(np.logspace(0, -6, 6), 2)  # pairs: signs and rotations inside each are free
    left, right = (np.linalg.qr(rng.normal(size=(size, 12)))[0] for size in (36, TEXELS))
    rows = ((left * sigma) @ right.T).astype(np.float32)
    exact = np.linalg.svd(rows.astype(float), full_matrices=False)
    moved, worst, status = oracles.bound_gram(rows.astype(float)), 0.0, "ok"
    for kept in (2, 4, 6, 8, 10):
        basis = fit_basis(jnp.asarray(rows), jnp.ones(TEXELS), bases=kept)
        U, V, S = np.asarray(basis.vectors, float), exact[2][:kept], exact[1]
        turned = np.linalg.norm(U - U @ V.T @ V, 2)
        tangent = moved / (S[kept - 1] ** 2 - S[kept] ** 2 - moved)
        worst = max(worst, over_bound(turned, S[kept] / S[kept - 1] * tangent + U32 * np.sqrt(kept)))
    return Outcome(worst, status)


def _signs() -> Outcome:
    """The sign rule settles what the decomposition leaves open: negated and permuted columns have the same basis.

    With distinct singular values a vector turns by at most ||E|| / gap of squares, here far below float32.
    """
    rng = np.random.default_rng(6)
    left, right = (np.linalg.qr(rng.normal(size=(size, 6)))[0] for size in (12, TEXELS))
    rows = ((left * 2.0 ** -np.arange(6)) @ right.T).astype(np.float32)
    bases = [
        np.asarray(fit_basis(jnp.asarray(r), jnp.ones(TEXELS), bases=6).vectors, float)
        for r in (rows, -rows, rows[rng.permutation(12)])
    ]
    exact = np.linalg.svd(rows.astype(float), compute_uv=False)[:6]
    gap = exact[-2] ** 2 - exact[-1] ** 2
    bound = 2 * (oracles.bound_gram(rows.astype(float)) / gap + U32)
    return Outcome(max(over_bound(other - bases[0], bound) for other in bases[1:]))


def _brute_force(X: np.ndarray, C: np.ndarray, ridge: float, weight: np.ndarray, intercept: bool) -> float:
    """Leave-one-out residual by as many fits as rows, 50 digits each."""
    total = 0.0
    for left in range(len(X)):
        keep = np.arange(len(X)) != left
        x0, c0 = (X[keep].mean(0), C[keep].mean(0)) if intercept else (0.0, 0.0)
        M = oracles.exact_ridge(X[keep] - x0, C[keep] - c0, ridge)
        total += weight[left] * float(np.sum((C[left] - c0 - (X[left] - x0) @ M.T) ** 2))
    return float(np.sqrt(total / weight.sum()))


def _left_out(
    make: Callable[[], tuple[np.ndarray, np.ndarray]], ridges: tuple[float, ...], intercept: bool = False, uneven: bool = False
) -> Callable[[], Outcome]:
    """The closed form against refits.

    See `bound_left_out`.
    """

    def run() -> Outcome:
        X, C = (part.astype(np.float32) for part in make())
        weight = np.logspace(0, -12, len(X)).astype(np.float32) if uneven else np.ones(len(X), np.float32)
        worst = 0.0
        for ridge in ridges:
            data = (jnp.asarray(part) for part in (X, C, weight))
            got = fit_transfer(next(data), next(data), ridge=ridge, importance=next(data), intercept=intercept).leave_one_out
            exact = _brute_force(X.astype(float), C.astype(float), ridge, weight.astype(float), intercept)
            worst = max(worst, over_bound(got - exact, bound_left_out(X.astype(float), C.astype(float), ridge, intercept)))
        return Outcome(worst)

    return run


def bound_left_out(X: np.ndarray, C: np.ndarray, ridge: float, intercept: bool) -> float:
    """Error of a leave-one-out residual e / (1 - h), closed form or refits by a float64 SVD.

    With t = sigma_1 / sqrt(ridge), H = X G X^T moves by 2 ||dX|| ||X G|| <= p u64 t, a residual by that times ||C||, and a
    quotient by 1 / (1 - h)² at most. A refit's matrix moves by ||dX|| ||C|| / ridge, its prediction by sigma_1 times
    that: p u64 t² ||C||.
    """
    left, S, _ = np.linalg.svd(X - X.mean(0) * intercept, full_matrices=False)
    free = 1 - intercept / len(X) - float((left**2 * (S**2 / (S**2 + ridge))).sum(1).max())
    t = S[0] / np.sqrt(ridge)
    return rounding(2 * sum(X.shape), U64) * (t + t**2 + 1) * float(np.linalg.norm(C)) / free**2


def _path_ends() -> Outcome:
    """An automatic ridge can be no worse than any of its path, and the path ends at the pseudo-inverse and at nothing."""
    X, C = (part.astype(np.float32) for part in problem(24, 10))
    fit = fit_transfer(jnp.asarray(X), jnp.asarray(C))
    path = np.asarray(fit.path)
    zero = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=0.0).leave_one_out
    nothing = float(np.sqrt(np.mean(np.sum(C.astype(float) ** 2, 1))))
    # At the far end the map shrinks by sigma² / (sigma² + ridge) at most: so near is its residual to that of no map.
    share = float(np.asarray(fit.singular_values)[0] ** 2 / path[-1, 0])
    worst = max(
        over_bound(path[0, 1] - zero, rounding(sum(X.shape), U64) * zero),
        over_bound(path[-1, 1] - nothing, 2 * share * nothing),
        over_bound(max(fit.leave_one_out - path[:, 1].min(), 0.0), rounding(sum(X.shape), U64) * path[:, 1].min()),
    )
    return Outcome(worst, fit.status, bool(np.isfinite(path).all()))


def _linear_answers(space: str, factor: float) -> Callable[[], Outcome]:
    """Near either end of float32: the answer is within its bound (at the largest number where it is past it), or refused."""

    def run() -> Outcome:
        measured, indirect = room()
        data = make_data(measured, indirect)
        model = ddprt.fit(data, bases=BASES, ridge=1e-3, space=space)
        probes = (measured[-TEST:].astype(float) * (factor / measured.max())).astype(np.float32)
        try:
            light = model.predict(probes, clamp=False)
        except UserError as error:
            return refused(error)
        truth, bound = oracles.bound_predict(model.relighter, model.encoding, probes)
        return Outcome(over_bound(light - truth, bound), model.relighter.report.status, bool(np.isfinite(light).all()))

    return run


def _adds_up() -> Outcome:
    """Lights of very different strength: linear uncentred light adds, up to the bounds of its three predictions."""
    measured, indirect = room()
    model = ddprt.fit(make_data(measured, indirect), bases=BASES, channels="multi", ridge=1e-4)
    one, two = measured[-TEST:-2] * np.float32(1e3), measured[-2:] * np.float32(1e-3)
    both = one + two
    light = [np.asarray(model.predict(v, clamp=False), float) for v in (one, two, both)]
    parts = [oracles.bound_predict(model.relighter, model.encoding, v)[1] for v in (one, two, both)]
    rounded = U32 * np.abs(both)  # of the sum that is asked for
    M, U = (np.asarray(part, float) for part in (model.relighter.matrix, model.relighter.basis))
    carried = (np.einsum("bp,fp->fb", np.abs(M[0]), rounded.reshape(2, -1)) @ np.abs(U)).reshape(2, TEXELS, 3)
    return Outcome(over_bound(light[2] - light[0] - light[1], sum(parts) + carried), model.relighter.report.status)


def _half_floats(peak: float, least: float) -> Callable[[], Outcome]:
    """A map as half floats: 11 bits for all above 2^-29 of the peak, half the smallest step below."""

    def run() -> Outcome:
        image = np.logspace(np.log10(least), np.log10(peak), 48).astype(np.float32).reshape(4, 4, 3)
        with tempfile.TemporaryDirectory() as folder:
            try:
                store.write_map(Path(folder) / "map.exr", image)
            except UserError as error:
                return refused(error)
            back = store.read_map(Path(folder) / "map.exr")
        exposure = exposure_for(float(image.max())) - 15
        bound = np.maximum(2.0**-11 * np.abs(image.astype(float)), np.ldexp(2.0**-25, exposure)) + 2.0**-150
        return Outcome(over_bound(back.astype(float) - image, bound), "ok", bool(np.isfinite(back).all()))

    return run


def _half_overflow() -> Outcome:
    """Basis textures as half floats without an exposure: what does not fit is refused, never infinite."""
    image = np.full((2, 2, 3), 65536.0, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        try:
            write_exr(Path(folder) / "map.exr", image, half=True)
        except ValueError as error:
            return Outcome(0.0 if "\n" not in str(error) else np.inf, "refused")
        return Outcome(np.inf, "ok", bool(np.isfinite(read_exr(Path(folder) / "map.exr")[0]).all()))


def _tensors() -> Outcome:
    """Every finite float32, the odd ones among them, comes back bit by bit."""
    odd = np.array([0.0, -0.0, 2.0**-149, -(2.0**-126), 1 + 2 * U32, oracles.LARGEST32, -oracles.LARGEST32], np.float32)
    with tempfile.TemporaryDirectory() as folder:
        write_tensors(Path(folder) / "t.safetensors", {"odd": odd})
        back = read_tensors(Path(folder) / "t.safetensors")["odd"]
    return Outcome(0.0 if back.tobytes() == odd.tobytes() else np.inf)


def _exported() -> Outcome:
    """Basis textures in half floats, scaled to a peak of 1, with a basis of 12 decades: 2^-11 relative or 2^-25 absolute."""
    measured, indirect = changed(_high_dynamic_range)()
    model = ddprt.fit(make_data(measured, indirect), bases=4, ridge=1e-6)
    U = np.asarray(model.relighter.basis, float)
    with tempfile.TemporaryDirectory() as folder:
        ddprt.export.textures.export_textures(model, folder, gutter=0)
        layer = read_exr(Path(folder) / "basis_00.exr")[0][0].astype(float)
        scale = np.array(json.loads((Path(folder) / "manifest.json").read_text())["basis_scale"])
    back = (layer * scale[: layer.shape[1]]).T[: len(U)]
    bound = scale[: len(U), None] * np.maximum(2.0**-11 * np.abs(U) / scale[: len(U), None], 2.0**-25) + 4 * U32 * np.abs(U)
    return Outcome(over_bound(back - U, bound), model.relighter.report.status, bool(np.isfinite(layer).all()))


def _imported(kind: str, value: float, *, split: str = "train") -> Callable[[], Outcome]:
    """A dataset on disk with one odd number in it."""

    def run() -> Outcome:
        measured, indirect = room()
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            data = make_data(measured, indirect)
            on_disk(data, folder)
            index = data.split(split)[1]
            if kind == "measured":
                light = data.measured_light[index].copy()
                light[3, 1] = value
                write_tensors(folder / store.map_name(kind, index), {"irradiance": light})
            else:
                image = data.indirect_light[index][None].copy() if kind != "area" else np.ones((1, TEXELS, 1), np.float32)
                image[0, 3, -1] = value
                path = folder / (f"atlas/{kind}.exr" if kind == "area" else store.map_name(kind, index))
                raw_exr(path, image)
            try:
                model = ddprt.fit(ddprt.open_dataset(folder), bases=BASES, ridge=1e-3)
            except UserError as error:
                return refused(error)
            light = model.predict(measured[-TEST:])
            return Outcome(0.0, model.relighter.report.status, bool(np.isfinite(light).all()))

    return run


def raw_exr(path: Path, image: np.ndarray) -> None:
    """A float EXR as another program may write it, with whatever is in it."""
    import OpenEXR

    name, pixels = ("Y", image[..., 0].copy()) if image.shape[2] == 1 else ("RGB", image)
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {name: pixels}) as file:
        file.write(str(path))


def on_disk(data: Arrays, folder: Path) -> None:
    """Writes a made-up dataset as a bake would."""
    store.write_description(folder, data.description)
    manifest, samples = store.Manifest(folder), data.samples
    tensors = {"position": samples.position, "normal": samples.normal, "albedo": samples.albedo}
    write_tensors(folder / "points.safetensors", {**tensors, "spacing": np.array([samples.spacing])})
    write_tensors(folder / "scene.safetensors", {"corners": data.occluders})
    for name in store.ATLAS_FILES:
        channels = 1 if name.endswith(("area.exr", "coverage.exr")) else 3
        values = data.area[:, None] if name.endswith("area.exr") else np.full((len(data.area), channels), 0.5)
        write_exr(folder / name, values[None].astype(np.float32))
    for index in range(len(data.measured_light)):
        write_tensors(folder / store.map_name("measured", index), {"irradiance": data.measured_light[index]})
        for kind in ("direct", "indirect", "noise"):
            write_exr(folder / store.map_name(kind, index), data.indirect_light[index][None])
    for name in store.expected_files(data.description):
        manifest.add(name)


def _refuses_values(value: float) -> Callable[[], Outcome]:
    def run() -> Outcome:
        measured, indirect = room()
        model = ddprt.fit(make_data(measured, indirect), bases=BASES, ridge=1e-3)
        probes = measured[-TEST:].copy()
        probes[0, 0, 0] = value
        try:
            light = model.predict(probes)
        except UserError as error:
            return refused(error)
        return Outcome(np.inf, "ok", bool(np.isfinite(light).all()))

    return run


# --- the catalogue ----------------------------------------------------------------------------------------------------

_FOREIGN = np.random.default_rng(9).normal(size=(TEST, POINTS, 3)) * np.logspace(-10, 10, TEST)[:, None, None]
_NOISE = np.where(
    np.random.default_rng(8).random((TEST, POINTS, 3)) < 0.3, 0, np.random.default_rng(7).normal(size=(TEST, POINTS, 3))
)
_AREA = np.where(np.arange(TEXELS) == 4, 0.0, 1.0)
_WARNED = frozenset(STATUSES) - {"ok"} | {"refused"}
_ANY = _WARNED | {"ok"}  # the case is about the numbers; what the status should be is not for it to say
_REFUSED = frozenset({"refused"})
_FEW = {"settings": {"steps": 40, "width": 8, "check_every": 20}, "method": "mlp"}
_WITHIN = "every layer is within its bound"
_KEPT = "finite, black for black, twice the light exactly twice the result, and the same after saving"


CASES = (
    HardCase(
        "duplicate points",
        "four measurements are the same number, so three directions carry nothing",
        _WITHIN,
        relit(changed(_duplicate)),
        _ANY,
    ),
    HardCase(
        "duplicate points, pseudo-inverse",
        "the smallest singular values are exactly 0 and get inverted",
        "the rank is cut, the rest is " + _WITHIN,
        relit(changed(_duplicate), ridge=0.0),
        _ANY,
    ),
    HardCase(
        "duplicate points, ridge 1e-30",
        "a ridge far below rounding holds nothing, and 1 / (2 sqrt(ridge)) is 5e14",
        "as the pseudo-inverse: rounding is not amplified",
        transferred(_duplicated_problem, 1e-30),
        _ANY,
    ),
    HardCase(
        "duplicate points, ridge 1e-300",
        "squares of singular values underflow beside it",
        "as the pseudo-inverse",
        transferred(_duplicated_problem, 1e-300),
        _ANY,
    ),
    HardCase("collinear points", "two measurements are sums of others", _WITHIN, relit(changed(_collinear)), _ANY),
    HardCase(
        "coincident points",
        "all measurements are one and the same",
        "one direction is used, and the status says so",
        relit(changed(_coincident)),
        frozenset({"rank_deficient", "worse_than_mean"}),
        slow=True,
    ),
    HardCase(
        "points equal to an ulp",
        "two measurements differ by 1.2e-7 of themselves",
        _WITHIN,
        relit(changed(_nearly_duplicate)),
        _ANY,
    ),
    HardCase(
        "points 1e-7 apart, pseudo-inverse",
        "what tells two points apart is near the rank cut",
        "on the kept directions within the bound, or a status",
        transferred(_near_problem, 0.0),
        _ANY,
    ),
    HardCase(
        "points 1e-7 apart, ridge 1e-12",
        "the ridge is near the squared difference",
        "the exact ridge solution",
        transferred(_near_problem, 1e-12),
        _ANY,
    ),
    HardCase(
        "rank 1",
        "all light is one map times a number",
        "one basis vector, and the status says so",
        relit(lambda: room(1)),
        frozenset({"rank_deficient"}),
        slow=True,
    ),
    HardCase(
        "rank 1, multi channel, mean",
        "centring takes away the only direction there is in most colours",
        _WITHIN,
        relit(lambda: room(1), channels="multi", centre="mean"),
        _ANY,
        slow=True,
    ),
    HardCase("one lighting", "nothing can be left out, no condition can be told", _WITHIN, relit(lambda: room(train=1)), _ANY),
    HardCase(
        "one lighting, mean",
        "centring leaves exactly nothing",
        "finite, with a status",
        relit(lambda: room(train=1), centre="mean", channels="multi"),
        _WARNED,
        slow=True,
    ),
    HardCase(
        "all lightings equal",
        "twelve times the same column",
        "one direction, and the status says so",
        relit(changed(_equal_lightings)),
        frozenset({"rank_deficient", "worse_than_mean"}),
        slow=True,
    ),
    HardCase(
        "all lightings equal, mean",
        "centring leaves rounding alone",
        "rounding is not taken for light",
        relit(changed(_equal_lightings), centre="mean", channels="multi"),
        _WARNED,
        slow=True,
    ),
    HardCase(
        "lightings 1e-7 apart",
        "columns differ by the last bit of float32",
        "the difference is cut or within the bound",
        relit(changed(_nearly_equal_lightings)),
        _ANY,
        slow=True,
    ),
    HardCase(
        "lightings 1e-7 apart, mean",
        "centring turns the last bit into all there is",
        _WITHIN,
        relit(changed(_nearly_equal_lightings), centre="mean", ridge=1e-3),
        _ANY,
        slow=True,
    ),
    HardCase(
        "fewer lightings than bases",
        "more vectors are asked for than there are columns",
        "fewer come back, and the status says so",
        relit(lambda: room(train=3), bases=20),
        frozenset({"rank_deficient", "worse_than_mean"}),
        slow=True,
    ),
    HardCase(
        "fewer lightings than points",
        "the normal equations are singular without a ridge",
        _WITHIN,
        relit(lambda: room(train=5)),
        _ANY,
        slow=True,
    ),
    HardCase(
        "many more lightings than points",
        "a tall problem, fitted and left out 60 times",
        _WITHIN,
        relit(lambda: room(train=60, points=5), ridge=1e-6),
        _ANY,
        slow=True,
    ),
    HardCase(
        "more bases than rank",
        "the rest of the vectors would be rounding",
        "as many as the rank, and the status says so",
        relit(lambda: room(3), bases=20),
        frozenset({"rank_deficient"}),
        slow=True,
    ),
    HardCase("dark lightings", "a norm of 0 divides", _WITHIN, relit(changed(_some_dark)), _ANY),
    HardCase(
        "all lightings dark",
        "nothing to learn from",
        "black, and no_signal",
        relit(changed(_all_dark)),
        frozenset({"no_signal"}),
        slow=True,
    ),
    HardCase("one lighting lit", "eleven of twelve are dark", _WITHIN, relit(changed(_one_lit)), _ANY),
    HardCase(
        "nothing bounces",
        "measurements without any indirect light",
        "black, and no_signal",
        relit(changed(_nothing_bounces)),
        frozenset({"no_signal"}),
        slow=True,
    ),
    HardCase("pure red light", "two channels have no signal, the third has", _WITHIN, relit(changed(_red)), _ANY),
    HardCase(
        "pure red light, multi channel",
        "two thirds of a column are 0",
        _WITHIN,
        relit(changed(_red), channels="multi"),
        _ANY,
        slow=True,
    ),
    HardCase("primary lights", "every lighting has one channel, another each time", _WITHIN, relit(changed(_primaries)), _ANY),
    HardCase(
        "lightings no point sees",
        "texels are bright, the measurement is 0",
        "they train nothing and poison nothing",
        relit(changed(_unseen)),
        _ANY,
        slow=True,
    ),
    HardCase(
        "lightings hardly seen",
        "columns are divided by measurements of 1e-6 and 1e-12",
        _WITHIN,
        relit(changed(_barely_seen)),
        _ANY,
        slow=True,
    ),
    HardCase(
        "a lighting seen at 1e-30 beside texels of 1e10",
        "the scaled column is past float32",
        "refused, or another status than ok",
        relit(changed(_hardly_seen_at_all)),
        _WARNED,
        slow=True,
    ),
    HardCase(
        "one light 1e6 times brighter", "errors in W/m² are those of one lighting", _WITHIN, relit(changed(_one_bright)), _ANY
    ),
    HardCase("intensities 1e-30", "squares underflow float32", _WITHIN, relit(changed(_times(1e-30))), _ANY),
    HardCase("intensities 1e30", "squares overflow float32", _WITHIN, relit(changed(_times(1e30))), _ANY),
    HardCase("intensities 1e-30 to 1e30", "sixty decades in one training set", _WITHIN, relit(changed(_every_size)), _ANY),
    HardCase(
        "subnormal intensities",
        "compiled code may flush 1e-40 to 0",
        "black or right, to the smallest normal number",
        relit(changed(_times(1e-40))),
        _ANY,
    ),
    HardCase(
        "twelve decades in one map",
        "the faint texels are below rounding of the bright ones",
        _WITHIN,
        relit(changed(_high_dynamic_range)),
        _ANY,
    ),
    HardCase(
        "twelve decades in one map, gamma",
        "the power brings faint texels up",
        _WITHIN,
        relit(changed(_high_dynamic_range), space="gamma"),
        _ANY,
    ),
    HardCase("a texel without area", "its weight is 0 under a root", _WITHIN, relit(room, area=_AREA), _ANY),
    HardCase(
        "areas over twelve decades",
        "weights of 1e-12 divide when vectors are made",
        _WITHIN,
        relit(room, area=np.logspace(-12, 0, TEXELS)),
        _ANY,
    ),
    HardCase(
        "gamma 1", "the power that is none", _WITHIN, relit(changed(_noisy), _NOISE, space="gamma", gamma=1.0), _ANY, slow=True
    ),
    HardCase(
        "gamma 2.2 with noise",
        "zeros and negative values meet a root",
        _WITHIN,
        relit(changed(_noisy), _NOISE, space="gamma"),
        _ANY,
    ),
    HardCase(
        "gamma 10 with noise",
        "the slope at 0 is steep one way and flat the other",
        _WITHIN,
        relit(changed(_noisy), _NOISE, space="gamma", gamma=10.0),
        _ANY,
        slow=True,
    ),
    HardCase(
        "gamma 10, twelve decades, mean",
        "all of it at once",
        _WITHIN,
        relit(changed(_high_dynamic_range), space="gamma", gamma=10.0, centre="mean", channels="multi", ridge=1e-6),
        _ANY,
        slow=True,
    ),
    HardCase("noise in linear light", "negative and zero measurements", _WITHIN, relit(changed(_noisy), _NOISE), _ANY),
    HardCase("mean and mono", "an intercept beside three channels", _WITHIN, relit(room, centre="mean"), _ANY),
    HardCase(
        "mean and multi",
        "an intercept beside interleaved colours",
        _WITHIN,
        relit(room, centre="mean", channels="multi"),
        _ANY,
        slow=True,
    ),
    HardCase("huge common offset", "light differs in the last three digits of float32", _WITHIN, relit(changed(_offset)), _ANY),
    HardCase(
        "huge common offset, mean",
        "centring cancels all but the last three digits",
        _WITHIN,
        relit(changed(_offset), centre="mean"),
        _ANY,
        slow=True,
    ),
    HardCase(
        "one lamp, one point, one texel",
        "every lighting is a unit vector: leaving one out leaves nothing to tell it by",
        _WITHIN,
        relit(changed(_single_spike)),
        _ANY,
        slow=True,
    ),
    HardCase(
        "clustered singular values",
        "any rotation of three vectors is as good",
        "the space is right whatever the rotation",
        relit(_clustered),
        _ANY,
    ),
    HardCase(
        "leading subspaces over six decades",
        "pairs of equal singular values, a gap of 16 between pairs",
        "within Davis and Kahan's angle",
        _subspaces,
    ),
    HardCase("signs and order of columns", "an eigenvector's sign is arbitrary", "the sign rule gives the same basis", _signs),
    HardCase(
        "prime sizes",
        "no tile or vector register divides them",
        _WITHIN,
        relit(lambda: room(train=13, points=7, texels=31)),
        _ANY,
        slow=True,
    ),
    HardCase(
        "more texels than a tile",
        "sums are cut into pieces of 16384",
        _WITHIN,
        relit(lambda: room(texels=16411)),
        _ANY,
        slow=True,
    ),
    HardCase("one texel", "one number is the whole map", _WITHIN, relit(lambda: room(texels=1)), _ANY, slow=True),
    HardCase(
        "one point", "light is scaled by the very number it is told by", _WITHIN, relit(lambda: room(points=1)), _ANY, slow=True
    ),
    HardCase(
        "more points than texels", "the wide way round", _WITHIN, relit(lambda: room(points=40, texels=3)), _ANY, slow=True
    ),
    HardCase(
        "a foreign lighting", "signs, sizes and directions that no training lighting had", _WITHIN, relit(room, _FOREIGN), _ANY
    ),
    HardCase(
        "values near the smallest float32",
        "products underflow",
        "black or right, to the smallest normal number",
        _linear_answers("linear", 1e-37),
        _ANY,
    ),
    HardCase(
        "values near the largest float32",
        "norms and products overflow",
        "right and cut at the largest number, or refused",
        _linear_answers("linear", 3.4e38),
        _ANY,
    ),
    HardCase(
        "values near the largest float32, gamma",
        "norms and powers overflow",
        "right and cut at the largest number, or refused",
        _linear_answers("gamma", 3.4e38),
        _ANY,
        slow=True,
    ),
    HardCase(
        "lights of 1e3 and 1e-3 together",
        "the faint one is below rounding of the sum",
        "they add up within the bounds of three predictions",
        _adds_up,
        _ANY,
    ),
    HardCase("ridge 0", "nothing holds small singular values back", _WITHIN, transferred(problem, 0.0), _ANY),
    HardCase("ridge 1e-30", "as good as none", "the exact ridge solution", transferred(problem, 1e-30), _ANY),
    HardCase("ridge 1e30", "the matrix is 1e-30", "the exact ridge solution", transferred(problem, 1e30), _ANY),
    HardCase("ridge 1e300", "the matrix is below every float32", "0", _nothing_left, _ANY),
    HardCase("ridge infinite", "S / (S² + inf)", "refused", transferred(problem, np.inf), _REFUSED),
    HardCase("ridge NaN", "compares false with everything", "refused", transferred(problem, np.nan), _REFUSED),
    HardCase("ridge negative", "makes the matrix singular somewhere", "refused", transferred(problem, -1e-3), _REFUSED),
    HardCase(
        "ridge per point",
        "every point has its own weight",
        "the exact solution",
        transferred(problem, tuple(np.logspace(-3, 3, 10).tolist())),
    ),
    HardCase(
        "ridge per point, sixty decades",
        "stretched measurements span 1e30",
        "the exact solution where it counts",
        transferred(problem, tuple(np.logspace(-6, 30, 10).tolist())),
        _ANY,
    ),
    HardCase(
        "ridge per point, one NaN",
        "one bad number among ten",
        "refused",
        transferred(problem, (1.0,) * 9 + (np.nan,)),
        _REFUSED,
    ),
    HardCase(
        "ridge per point, one infinite", "a stretch of 0", "refused", transferred(problem, (1.0,) * 9 + (np.inf,)), _REFUSED
    ),
    HardCase(
        "Hilbert measurements, pseudo-inverse",
        "condition 1e13 before rounding, 1e8 after",
        "on the kept directions within the bound, or a status",
        transferred(measured_by(_hilbert(12, 10)), 0.0),
        _ANY,
    ),
    HardCase(
        "Hilbert measurements, ridge 1e-10",
        "half of the directions are below the ridge",
        "the exact ridge solution",
        transferred(measured_by(_hilbert(12, 10)), 1e-10),
        _ANY,
    ),
    HardCase(
        "Hilbert measurements, automatic ridge",
        "leave-one-out with next to no noise",
        "the exact ridge solution at the ridge it takes",
        transferred(measured_by(_hilbert(12, 10)), "auto"),
        _ANY,
    ),
    HardCase(
        "Vandermonde measurements",
        "powers 0 to 9 of numbers below 1",
        "the exact ridge solution at the ridge it takes",
        transferred(measured_by(_vandermonde(12, 10)), "auto"),
        _ANY,
    ),
    HardCase(
        "transfer of a huge offset, intercept",
        "means cancel five digits",
        "the exact ridge solution of centred data",
        transferred(lambda: tuple(part + 1e5 for part in problem()), 1e-3, intercept=True),
        _ANY,
        slow=True,
    ),
    HardCase(
        "leave-one-out", "the closed form divides by 1 - h", "as 12 refits in 50 digits", _left_out(problem, (1e-6, 1e-2, 1e2))
    ),
    HardCase(
        "leave-one-out, intercept",
        "each refit has its own mean",
        "as 12 refits in 50 digits",
        _left_out(problem, (1e-4, 1.0), intercept=True),
        slow=True,
    ),
    HardCase(
        "leave-one-out, importance over twelve decades",
        "faint lightings count next to nothing",
        "as 12 refits in 50 digits",
        _left_out(problem, (1e-3,), uneven=True),
    ),
    HardCase(
        "leave-one-out, fewer lightings than points",
        "without ridge every h is 1",
        "as 6 refits in 50 digits",
        _left_out(lambda: problem(6, 10), (1e-6, 1e-2)),
        slow=True,
    ),
    HardCase(
        "ends of the ridge path",
        "no ridge on one side, no map on the other",
        "pseudo-inverse, nothing, and the lowest is taken",
        _path_ends,
    ),
    HardCase(
        "a map of 1e30 in half floats", "halves end at 65504", "11 bits, thanks to the exposure", _half_floats(1e30, 1e24)
    ),
    HardCase(
        "a map of 1e-30 in half floats", "halves begin at 6e-8", "11 bits, thanks to the exposure", _half_floats(1e-30, 1e-36)
    ),
    HardCase(
        "a map of subnormals in half floats",
        "the exposure itself is past 2^126",
        "to the smallest step",
        _half_floats(1e-39, 1e-44),
    ),
    HardCase(
        "eighteen decades in half floats",
        "halves span twelve",
        "11 bits down to 2^-29 of the peak, then the smallest step",
        _half_floats(1e6, 1e-12),
    ),
    HardCase("the largest float32 in half floats", "its power of two is past float32", "11 bits", _half_floats(3.4e38, 1e30)),
    HardCase("a half float past 65504", "a plain cast makes it infinite", "refused", _half_overflow, _REFUSED),
    HardCase("odd numbers in a tensor file", "subnormals, negative zero, the largest", "the same bits", _tensors),
    HardCase(
        "basis textures of twelve decades",
        "a peak of 1 leaves 2^-24 for the faintest",
        "11 bits or the smallest step",
        _exported,
        _ANY,
    ),
    HardCase(
        "NaN among imported measurements",
        "spreads through every norm",
        "refused by the name of the file",
        _imported("measured", np.nan),
        _REFUSED,
    ),
    HardCase(
        "infinity among imported measurements",
        "inf / inf",
        "refused by the name of the file",
        _imported("measured", np.inf),
        _REFUSED,
    ),
    HardCase(
        "a negative imported measurement",
        "no light is negative",
        "refused by the name of the file",
        _imported("measured", -1.0),
        _REFUSED,
    ),
    HardCase(
        "NaN in an imported map",
        "one texel of one lighting",
        "refused by the name of the file",
        _imported("indirect", np.nan),
        _REFUSED,
    ),
    HardCase(
        "infinity in an imported map",
        "one texel of one lighting",
        "refused by the name of the file",
        _imported("indirect", np.inf),
        _REFUSED,
    ),
    HardCase(
        "a negative value in an imported map",
        "other renderers' filters ring",
        "refused, or fitted",
        _imported("indirect", -1e-3),
        _ANY,
    ),
    HardCase(
        "NaN in an imported area",
        "all weights become NaN",
        "refused by the name of the file",
        _imported("area", np.nan),
        _REFUSED,
    ),
    HardCase("NaN asked at run time", "an engine divides by 0", "refused", _refuses_values(np.nan), _REFUSED),
    HardCase("infinity asked at run time", "an engine overflows", "refused", _refuses_values(-np.inf), _REFUSED),
    *(
        HardCase(f"network: {name}", why, _KEPT, relit(make, **_FEW), _ANY | {"diverged"}, slow)
        for name, why, make, slow in (
            ("duplicate points", "inputs repeat", changed(_duplicate), True),
            ("rank 1", "one output", lambda: room(1), True),
            ("one lighting", "a spread of one number", lambda: room(train=1), True),
            ("all dark", "nothing to train", changed(_all_dark), False),
            ("pure red light", "zero inputs, zero gradients", changed(_red), True),
            ("lightings 1e-30 to 1e30", "importances underflow", changed(_every_size), True),
            ("twelve decades in one map", "targets of all sizes", changed(_high_dynamic_range), True),
            ("hardly seen", "targets of 1e12", changed(_barely_seen), True),
        )
    ),
    *(
        HardCase(f"{method}: {name}", why, _KEPT, relit(make, method=method), _ANY)
        for method in ("mean", "nearest")
        for name, why, make in (
            ("dark lightings", "a norm of 0 divides", changed(_some_dark)),
            ("all dark", "nothing to learn from", changed(_all_dark)),
            ("lightings 1e-30 to 1e30", "weights overflow", changed(_every_size)),
        )
    ),
)
