"""Every layer of a linear model against its bound: encoding, basis, transfer, leaving one out, prediction.

A layer takes what the layer before it really left, so that each bound holds the rounding of one step and no cancellation hides
an error. Bounds and their derivations stand in `oracles.py`, or beside what uses them.
"""

from typing import Any

import numpy as np
import oracles
from oracles import TINY32, U32, U64, over_bound, rounding

from ddprt.dataset.store import Dataset
from ddprt.fitting.basis import RANK_CUT, entry_weights
from ddprt.fitting.selection import REPEATS
from ddprt.fitting.transfer import Transfer
from ddprt.runtime.model import Model
from ddprt.runtime.train import examples
from ddprt.sections import FitConfig


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


def right_answers(X: np.ndarray, C: np.ndarray, ridge: Any, doubt: float = 0.0) -> tuple[np.ndarray, float]:
    """X M^T of centred data on the directions that count, and how far (Frobenius) a float32 M may leave it.

    Where X is ill-conditioned and little ridge holds it, M is known to nothing while X M^T, and with it the residual, is known
    well: a matrix of zeros, or of 1.01 M, breaks this statement. A backward stable SVD solves the problem of X + dX,
    ||dX|| <= p u64 sigma_1. Its best approximation of rank r moves by that times 1 + 2 sigma_r / gap, gap being
    sigma_r - sigma_r+1, and with G as in `oracles.bound_ridge` X M^T moves by
    ||dX|| (||C - X M^T|| ||X G|| + ||X G X^T|| ||M||), once more ||dX|| ||M|| for what the kept directions take of the dropped
    ones. ||X G|| is the largest s / (s² + ridge) from sigma_r to sigma_1, ||X G X^T|| = sigma_1² / (sigma_1² + ridge) <= 1; the
    products round p u64 ||C|| of it. All of that twice, since the float64 twin is no better; float32 storage adds
    (u32 |M| + the smallest normal number) |X|, and a C that is off by `doubt` adds that.
    """
    plain = np.linalg.svd(X, compute_uv=False)
    rank = int((plain > RANK_CUT * plain[0]).sum())
    if rank == 0:
        return np.zeros(C.shape), 0.0
    root = np.sqrt(np.array(ridge)) if isinstance(ridge, tuple) else np.ones(X.shape[1])
    ridge = 1.0 if isinstance(ridge, tuple) else ridge
    Q, S, Pt = np.linalg.svd(X / root, full_matrices=False)
    Q, kept, Pt = Q[:, :rank], S[:rank], Pt[:rank]
    M = (C.T @ Q * (kept / (kept**2 + ridge))) @ Pt
    answers = (Q * (kept**2 / (kept**2 + ridge))) @ (Q.T @ C)
    share = float(kept[0] ** 2 / (kept[0] ** 2 + ridge))
    steep = np.clip(np.sqrt(ridge), kept[-1], kept[0])
    p, gap = rounding(2 * sum(X.shape), U64), kept[-1] - (S[rank] if rank < len(S) else 0.0)
    dX = p * kept[0] * (1 + 2 * kept[-1] / gap)
    size = float(np.linalg.norm(C))
    own = dX * (np.linalg.norm(C - answers) * steep / (steep**2 + ridge) + 2 * np.linalg.norm(M)) + p * size * share
    stored = float(np.linalg.norm(np.abs(X) @ (U32 * np.abs(M / root) + TINY32).T))
    return answers, 2 * float(own) + stored + doubt * share


def judge_transfer(X: np.ndarray, C: np.ndarray, doubt: np.ndarray, ridge: Any, parts: list[np.ndarray], centre: bool) -> float:
    """Means, ridge solution and what it answers to the training lightings, at the ridge that was given or reported."""
    M, offset, start = parts
    d0, c0 = (X.mean(0), C.mean(0)) if centre else (np.zeros(X.shape[1]), np.zeros(C.shape[1]))
    mean_error = rounding(len(X), U64)
    exact, bound = right_transfer(X - d0, C - c0, ridge, float(np.linalg.norm(doubt)))
    fitted, moved = right_answers(X - d0, C - c0, ridge, float(np.linalg.norm(doubt)))
    return max(
        over_bound(float(np.linalg.norm((X - d0) @ M.T - fitted)), moved),
        over_bound(offset - d0, U32 * np.abs(d0) + mean_error * np.abs(X).max(0) + TINY32),
        over_bound(start - c0, U32 * np.abs(c0) + doubt.max(0) + mean_error * np.abs(C).max(0) + TINY32),
        over_bound(M - exact, bound),
    )


def judge_fit(fit: Transfer, X: np.ndarray, C: np.ndarray, ridge: Any, intercept: bool) -> float:
    """`judge_transfer` of what `fit_transfer` returned."""
    parts = [np.asarray(part, float) for part in (fit.matrix, fit.offset, fit.intercept)]
    return judge_transfer(X.astype(float), C.astype(float), np.zeros(C.shape), ridge, parts, intercept)


def left_with(X: np.ndarray, row: int) -> np.ndarray:
    """Which rows are left out with one: those within a hundredth of their size."""
    return ((X - X[row]) ** 2).sum(1) <= REPEATS**2 / 2 * ((X**2).sum(1) + (X[row] ** 2).sum())


def bound_left_out(X: np.ndarray, C: np.ndarray, ridge: float, intercept: bool) -> float:
    """Error of a leave-one-out residual (Id - H)_rows^-1 e_rows, closed form or refits by a float64 SVD.

    With t = sigma_1 / sqrt(ridge), H = X G X^T moves by 2 ||dX|| ||X G|| <= p u64 t, a residual by that times ||C||, and a
    quotient by the squared norm of (Id - H)_rows^-1 at most, 1 / (1 - h)² for a single row. A refit's matrix moves by
    ||dX|| ||C|| / ridge, its prediction by sigma_1 times that: p u64 t² ||C||.
    """
    left, S, _ = np.linalg.svd(X - X.mean(0) * intercept, full_matrices=False)
    rest = np.eye(len(X)) - intercept / len(X) - (left * (S**2 / (S**2 + ridge))) @ left.T
    free = min(float(np.linalg.eigvalsh(rest[np.ix_(rows, rows)])[0]) for rows in (left_with(X, row) for row in range(len(X))))
    t = S[0] / np.sqrt(ridge)
    return rounding(2 * sum(X.shape), U64) * (t + t**2 + 1) * float(np.linalg.norm(C)) / free**2
