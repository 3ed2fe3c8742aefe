"""Peers of the transfer's fit: ridge maps from measurements to coefficients, at one given ridge.

Truth is the triangular solution of a QR decomposition of the measurements with the ridge's rows below them (Björck, Numerical
Methods for Least Squares Problems, 2.7), in float64. Peers get float64 copies for nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ddprt import seeds
from ddprt.bench.peers.fit import EPS
from ddprt.bench.peers.standing import OURS, Peer, Row, compare
from ddprt.fitting.transfer import fit_transfer

_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Measurements of lightings, and what they are to be mapped to.

    Attributes:
      measured, coefficients: one lighting per row.
      ridge: in units of measured².
    """

    measured: Float[np.ndarray, "lightings points"]
    coefficients: Float[np.ndarray, "lightings bases"]
    ridge: float

    @cached_property
    def wide(self) -> tuple[np.ndarray, np.ndarray]:
        """Both in float64."""
        return self.measured.astype(np.float64), self.coefficients.astype(np.float64)

    @cached_property
    def extended(self) -> tuple[np.ndarray, np.ndarray]:
        """Both with the ridge's rows below: least squares of them are the ridge map."""
        X, C = self.wide
        points = X.shape[1]
        return np.concatenate([X, np.sqrt(self.ridge) * np.eye(points)]), np.concatenate([C, np.zeros((points, C.shape[1]))])

    @cached_property
    def exact(self) -> np.ndarray:
        """The map, bases x points."""
        X, C = self.extended
        Q, R = np.linalg.qr(X)
        return scipy.linalg.solve_triangular(R, Q.T @ C).T

    @property
    def blur(self) -> dict[str, float]:
        """Rounding of the map's entries to float32."""
        return {"map": EPS}

    def judge(self, matrix: Any) -> dict[str, float]:
        """Relative error of a map."""
        return {"map": float(np.linalg.norm(np.asarray(matrix, np.float64) - self.exact) / np.linalg.norm(self.exact))}


def make_pairs(spectrum: np.ndarray, points: int, bases: int, seed: int) -> Pairs:
    """Measurements of this spectrum, random coefficients, and a ridge of 1e-6 of the largest squared singular value."""
    rng = seeds.stream(seed, "peers pairs")
    n = len(spectrum)
    left, right = (np.linalg.qr(rng.standard_normal((size, min(n, points))))[0] for size in (n, points))
    X = (left * spectrum[: left.shape[1]]) @ right.T
    C = rng.standard_normal((n, bases))
    return Pairs(X.astype(np.float32), C.astype(np.float32), float(1e-6 * spectrum[0] ** 2))


def ridge_rows(pairs: Pairs, *, repeats: int, tell: Callable[[], None] = lambda: None) -> list[Row]:
    """Everyone's map."""
    return compare(PEERS, pairs, repeats=repeats, tell=tell)


def _ours(pairs: Pairs) -> Callable[[], Any]:
    X, C = jnp.asarray(pairs.measured), jnp.asarray(pairs.coefficients)
    return lambda: fit_transfer(X, C, ridge=pairs.ridge).matrix


def _lstsq(pairs: Pairs) -> Callable[[], np.ndarray]:
    X, C = pairs.extended
    return lambda: np.linalg.lstsq(X, C, rcond=None)[0].T


def _normal(pairs: Pairs) -> Callable[[], np.ndarray]:
    X, C = pairs.wide

    def work() -> np.ndarray:
        dual = X @ X.T
        dual[np.diag_indices_from(dual)] += pairs.ridge
        return np.linalg.solve(dual, C).T @ X

    return work


def _sklearn(pairs: Pairs, solver: str, tolerance: float | int = 1e-4) -> Callable[[], np.ndarray]:
    from sklearn.linear_model import Ridge

    X, C = pairs.wide

    def work() -> np.ndarray:
        model = Ridge(alpha=pairs.ridge, fit_intercept=False, solver=solver, tol=tolerance, max_iter=100_000, random_state=0)
        return np.asarray(model.fit(X, C).coef_)

    return work


PEERS = (
    Peer(OURS, _ours, remark="fit_transfer: with leave-one-out error, condition, rank and remarks; any other ridge is free"),
    Peer("numpy.linalg.lstsq", _lstsq, remark="of the measurements with the ridge's rows below, which are made for nothing"),
    Peer("numpy, normal equations", _normal, remark="of the smaller of the two sizes"),
    Peer("sklearn Ridge, svd", lambda pairs: _sklearn(pairs, "svd"), needs="sklearn"),
    Peer("sklearn Ridge, cholesky", lambda pairs: _sklearn(pairs, "cholesky"), needs="sklearn"),
    Peer("sklearn Ridge, lsqr", lambda pairs, e: _sklearn(pairs, "lsqr", e), "sklearn", efforts=_TOLERANCES, unit="tolerance"),
    Peer(
        "sklearn Ridge, sparse_cg",
        lambda pairs, e: _sklearn(pairs, "sparse_cg", e),
        "sklearn",
        efforts=_TOLERANCES,
        unit="tolerance",
    ),
)
