"""The transfer matrix: from measured direct light to coefficients of the basis.

Belcour et al. (HPG 2022, Eq. 13 and 14) write C [D D^T + Lambda]^-1 D^T, which mixes the m x m and the N x N form; meant is
M = C D^T (D D^T + Lambda)^-1 = C (D^T D + Lambda)^-1 D^T. With lightings as rows, X = D^T = Q S P^T, every scalar ridge
costs one product after a single SVD: M(lambda) = C^T Q diag(S / (S² + lambda)) P^T.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ddprt.errors import UserError

RANK_CUT = 1e-7
"""Singular values below this share of the largest are rounding of the float32 measurements."""
_RIDGES = 57  # four per decade, from 1e-13 to 10 times the largest squared singular value
ILL_CONDITIONED = 1e6
"""Condition number past which coefficients of float32 measurements are not to be trusted without a ridge."""


@dataclass(frozen=True)
class Transfer:
    """A ridge map, u = matrix (z - offset) + intercept.

    Attributes:
      matrix: M.
      offset: mean of the measured rows, zero without intercept.
      intercept: mean of the coefficients, zero without intercept.
      ridge: the weight that was used; for a ridge per point its mean.
      singular_values: of the measurements, falling.
      condition: largest singular value over the smallest one that counts towards the rank; 0 without signal.
      rank: numerical rank of the measurements.
      leave_one_out: root of the weighted mean squared leave-one-out residual of a row's coefficients.
      path: leave-one-out residual at every ridge tried, as (ridge, residual) rows; empty unless it was chosen.
      status: "ok"; "rank_deficient": the measurements have fewer independent directions than there are coefficients to tell
        apart; "ill_conditioned": directions that nearly carry nothing decide, and no ridge holds them back; "no_signal":
        nothing was measured.
    """

    matrix: Float[Array, "bases points"]
    offset: Float[Array, " points"]
    intercept: Float[Array, " bases"]
    ridge: float
    singular_values: Float[Array, " values"]
    condition: float
    rank: int
    leave_one_out: float
    path: Float[Array, "ridges 2"]
    status: Literal["ok", "rank_deficient", "ill_conditioned", "no_signal"]


def fit_transfer(
    measured: Float[Array, "lightings points"],
    coefficients: Float[Array, "lightings bases"],
    *,
    ridge: float | tuple[float, ...] | Literal["auto"] = "auto",
    importance: Float[Array, " lightings"] | None = None,
    intercept: bool = False,
) -> Transfer:
    """Ridge map from measurement points to basis coefficients.

    Minimises ||X M^T - C||² + ridge ||M||² through one SVD of X, in float64.

    Args:
      measured: X, scaled and encoded direct light at the points, dimensionless; rows of zeros train nothing.
      coefficients: C, those of the scaled and encoded indirect light.
      ridge: weight in units of measured², >= 0; 0 gives the pseudo-inverse; one value per point weighs them apart;
        "auto" minimises the leave-one-out residual.
      importance: weight of each row's leave-one-out residual, s² to agree with errors in W/m²; 1 where it is left out.
      intercept: fit one, by centring both sides.
    Raises:
      UserError: negative ridges, or not as many as points; a mix of zero and positive ridges per point.
      ValueError: the two sides have different numbers of lightings.
    """
    if len(measured) != len(coefficients):
        raise ValueError(f"got {len(measured)} rows of measurements and {len(coefficients)} of coefficients, expected as many")
    weight = np.ones(len(measured)) if importance is None else np.asarray(importance, np.float64)
    per_point = _per_point(ridge, measured.shape[1])
    stretch = np.ones(measured.shape[1]) if per_point is None else 1 / np.sqrt(per_point)
    # Per-point ridges are in the stretched measurements already, so their lambda is 1; -1 stands for "auto".
    given = -1.0 if ridge == "auto" else 1.0 if per_point is not None else float(ridge)  # type: ignore[arg-type]
    if given < 0 and ridge != "auto":
        raise UserError(f"fit.ridge: got {given:g}, expected 0 or more")
    with jax.enable_x64(True):
        M, offset, start, S, used, loo, path = _solve(measured, coefficients, weight, stretch, given, intercept)
        values = np.asarray(S)
    rank = int(np.sum(values > RANK_CUT * values[0])) if values[0] > 0 else 0
    condition = float(values[0] / values[rank - 1]) if rank else 0.0
    status = _status(values[0], rank, coefficients.shape[1], condition, float(used))
    shown = float(np.mean(per_point)) if per_point is not None else float(used)
    kept = path if ridge == "auto" else path[:0]
    return Transfer(M, offset, start, shown, S, condition, rank, float(loo), kept, status)


@partial(jax.jit, static_argnames="intercept")
def _solve(
    measured: Array, coefficients: Array, weight: Array, stretch: Array, given: Array, intercept: bool
) -> tuple[Array, ...]:
    """One SVD, the whole leave-one-out path, and M at the ridge that is given (or, below 0, the best of the path)."""
    X, C = measured.astype(jnp.float64), coefficients.astype(jnp.float64)
    offset = jnp.mean(X, 0) if intercept else jnp.zeros(X.shape[1])
    start = jnp.mean(C, 0) if intercept else jnp.zeros(C.shape[1])
    Q, S, Pt = jnp.linalg.svd((X - offset) * stretch, full_matrices=False)
    C = C - start
    QtC = jnp.matmul(Q.T, C, precision="highest")
    grid = jnp.concatenate([jnp.zeros(1), jnp.logspace(-13, 1, _RIDGES)]) * jnp.maximum(S[0] ** 2, 1e-300)
    path = jax.lax.map(lambda ridge: _leave_one_out(Q, S, QtC, C, weight, ridge, intercept), grid)
    chosen = jnp.where(given < 0, grid[jnp.argmin(path)], given)
    matrix = jnp.matmul(QtC.T * _shrink(S, chosen), Pt, precision="highest") * stretch
    loo = _leave_one_out(Q, S, QtC, C, weight, chosen, intercept)
    M, d0, c0 = (part.astype(jnp.float32) for part in (matrix, offset, start))
    return M, d0, c0, S, chosen, loo, jnp.stack([grid, path], 1)


def _per_point(ridge: float | tuple[float, ...] | str, points: int) -> np.ndarray | None:
    if not isinstance(ridge, tuple):
        return None
    if len(ridge) != points:
        raise UserError(f"fit.ridge: got {len(ridge)} values, expected one per measurement ({points}), a number or auto")
    if min(ridge) <= 0:
        raise UserError(f"fit.ridge: got {min(ridge):g} for a point, expected all above 0; use 0 alone for the pseudo-inverse")
    return np.array(ridge)


def _shrink(S: Array, ridge: Array) -> Array:
    """S / (S² + ridge), where directions without signal get 0: at ridge 0 this is the pseudo-inverse."""
    held = RANK_CUT * S[0] < S
    return jnp.where(held | (ridge > 0), S / jnp.where(S**2 + ridge > 0, S**2 + ridge, 1), 0)


def _leave_one_out(Q: Array, S: Array, QtC: Array, C: Array, weight: Array, ridge: Array, intercept: bool) -> Array:
    """Weighted root mean square of e_k = (c_k - fitted_k) / (1 - h_kk)."""
    keep = S * _shrink(S, ridge)
    free = 1 - jnp.matmul(Q**2, keep, precision="highest") - (1 / len(C) if intercept else 0)
    error = C - jnp.matmul(Q * keep, QtC, precision="highest")
    # A row that alone decides its own fit (h = 1) says nothing about new ones: its error is its whole size.
    left_out = jnp.where(free[:, None] > 1e-9, error / jnp.where(free > 1e-9, free, 1)[:, None], C)
    return jnp.sqrt(jnp.sum(weight[:, None] * left_out**2) / jnp.sum(weight))


def _status(
    largest: float, rank: int, bases: int, condition: float, ridge: float
) -> Literal["ok", "rank_deficient", "ill_conditioned", "no_signal"]:
    if rank == 0:
        return "no_signal"
    if rank < bases:
        return "rank_deficient"
    held = ridge > (largest / ILL_CONDITIONED) ** 2
    return "ill_conditioned" if condition > ILL_CONDITIONED and not held else "ok"
