"""The transfer matrix: from measured direct light to coefficients of the basis.

Belcour et al. (HPG 2022, Eq. 13 and 14) write C [D D^T + Lambda]^-1 D^T, which mixes the m x m and the N x N form; meant is
M = C D^T (D D^T + Lambda)^-1 = C (D^T D + Lambda)^-1 D^T. With lightings as rows, X = D^T = Q S P^T, every scalar ridge
costs one product after a single SVD: M(lambda) = C^T Q diag(S / (S² + lambda)) P^T.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ddprt.errors import UserError
from ddprt.fitting.selection import Spectrum, choose_ridge, decompose, left_out

ILL_CONDITIONED = 1e6
"""Condition number past which coefficients of float32 measurements are not to be trusted without a ridge."""
_WIDEST = 1e100  # of the ridge of a point, so that squares of what it stretches keep in range
_ENDLESS = 1e30  # times the largest squared singular value: a ridge that leaves nothing of M

Status = Literal["ok", "rank_deficient", "ill_conditioned", "no_signal", "overdamped", "overfitted"]


@dataclass(frozen=True)
class Transfer:
    """A ridge map, u = matrix (z - offset) + intercept.

    Attributes:
      matrix: M.
      offset: mean of the measured rows, zero without intercept.
      intercept: mean of the coefficients, zero without intercept.
      ridge: the weight that was used; for a ridge per point its mean.
      singular_values: of the measurements with twins merged, falling.
      condition: largest singular value over the smallest one that counts towards the rank; 0 without signal.
      rank: numerical rank of the measurements.
      leave_one_out: root of the weighted mean squared leave-one-out residual of a row's coefficients.
      path: the leave-one-out error that decided, at every ridge tried, as (ridge, error) rows; empty unless it was chosen here.
      remarks: all of these that hold, the worst first. "no_signal": nothing was measured; "overfitted": a lighting that is
        left out is predicted no better than by black (by the mean, with an intercept); "ill_conditioned": directions that
        nearly carry nothing decide, and no ridge holds them back; "overdamped": the ridge takes more than half even of the
        strongest direction; "rank_deficient": the measurements have fewer independent directions than there are coefficients
        to tell apart.
    """

    matrix: Float[Array, "bases points"]
    offset: Float[Array, " points"]
    intercept: Float[Array, " bases"]
    ridge: float
    singular_values: Float[Array, " values"]
    condition: float
    rank: int
    leave_one_out: float
    path: Float[np.ndarray, "ridges 2"]
    remarks: tuple[Status, ...]

    @property
    def status(self) -> Status:
        """The first of the remarks, "ok" where there is none."""
        return self.remarks[0] if self.remarks else "ok"


def fit_transfer(
    measured: Float[Array, "lightings points"],
    coefficients: Float[Array, "lightings bases"],
    *,
    ridge: float | int | tuple[float, ...] | Literal["auto"] = "auto",
    importance: Float[Array, " lightings"] | None = None,
    intercept: bool = False,
) -> Transfer:
    """Ridge map from measurement points to basis coefficients.

    Minimises ||X M^T - C||² + ridge ||M||² through one SVD of X, in float64.

    Args:
      measured: X, scaled and encoded direct light at the points, dimensionless; rows of zeros train nothing.
      coefficients: C, those of the scaled and encoded indirect light.
      ridge: weight in units of measured², >= 0; 0 gives the pseudo-inverse; one value per point weighs them apart;
        "auto" is `choose_ridge` of this matrix alone (methods choose for all channels at once).
      importance: weight of each row's leave-one-out residual, s² to agree with errors in W/m²; 1 where it is left out, or
        where all of it is zero.
      intercept: fit one, by centring both sides.
    Raises:
      UserError: ridges that are negative or not finite, or not as many as points; one for a point outside of 1e-100 to 1e100.
      ValueError: the two sides have different numbers of lightings.
    """
    if len(measured) != len(coefficients):
        raise ValueError(f"got {len(measured)} rows of measurements and {len(coefficients)} of coefficients, expected as many")
    weight = np.ones(len(measured)) if importance is None else np.asarray(importance, np.float64)
    stretch = point_stretch(ridge, measured.shape[1])
    spectrum = decompose(measured, coefficients, stretch=stretch, intercept=intercept)
    if ridge != "auto":
        return solve_transfer(spectrum, ridge, stretch, weight)
    choice = choose_ridge([spectrum], [weight], [np.arange(len(weight))])
    return solve_transfer(spectrum, choice.ridge, None, weight, path=choice.path[:, :2])


def solve_transfer(
    spectrum: Spectrum,
    ridge: float | int | tuple[float, ...],
    stretch: Float[np.ndarray, " points"] | None,
    weight: Float[np.ndarray, " lightings"],
    *,
    path: Float[np.ndarray, "ridges 2"] = np.zeros((0, 2)),  # noqa: B008
) -> Transfer:
    """The map at one ridge, of a problem decomposed before; `stretch` from `point_stretch`, the rest as in `fit_transfer`."""
    # Ridges of the points are in the stretched measurements already, so their lambda is 1.
    used = float(ridge) if stretch is None else 1.0  # type: ignore[arg-type]
    if not 0 <= used < np.inf:
        raise UserError(f"fit.ridge: got {used:g}, expected a finite number, 0 or more")
    largest, rank, count = spectrum.largest, spectrum.rank, len(spectrum.right)
    S = np.asarray(spectrum.values)[:count]
    shrink = np.divide(S, S**2 + used, out=np.zeros_like(S), where=np.arange(len(S)) < rank)
    with jax.enable_x64(True):
        matrix = jnp.matmul(spectrum.turned[: len(S)].T * shrink, spectrum.right[: len(S)], precision="highest")
        matrix = matrix if stretch is None else matrix * stretch
        M, d0, c0 = (part.astype(jnp.float32) for part in (matrix, spectrum.offset, spectrum.start))
    squares = left_out(spectrum, np.array([used]))[0][0]
    weight = weight / weight.max() if weight.max(initial=0) > 0 else np.ones(len(weight))
    remarks: dict[Status, bool] = {
        "no_signal": rank == 0,
        "overfitted": rank > 0 and weight @ squares > weight @ _answering_nothing(spectrum),
        "ill_conditioned": rank > 0 and largest > ILL_CONDITIONED * S[rank - 1] and used <= (largest / ILL_CONDITIONED) ** 2,
        "overdamped": rank > 0 and used > largest**2,
        "rank_deficient": 0 < rank < spectrum.turned.shape[1],
    }
    return Transfer(
        M,
        d0,
        c0,
        float(np.mean(ridge)) if stretch is not None else float(ridge),  # type: ignore[arg-type]
        spectrum.values,
        float(largest / max(S[rank - 1], 1e-300)) if rank else 0.0,
        rank,
        float(np.sqrt(weight @ squares / weight.sum())),
        path,
        tuple(name for name, holds in remarks.items() if holds),
    )


def point_stretch(ridge: float | int | tuple[float, ...] | str, points: int) -> Float[np.ndarray, " points"] | None:
    """Factors of the measurements under which a ridge of 1 weighs each point as asked; None where all are weighed alike.

    Raises:
      UserError: see `fit_transfer`.
    """
    if not isinstance(ridge, tuple):
        return None
    if len(ridge) != points:
        raise UserError(f"fit.ridge: got {len(ridge)} values, expected one per measurement ({points}), a number or auto")
    wrong = [value for value in ridge if not 1 / _WIDEST <= value <= _WIDEST]
    if wrong:
        raise UserError(
            f"fit.ridge: got {wrong[0]:g} for a point, expected {1 / _WIDEST:g} to {_WIDEST:g}; "
            "use 0 alone for the pseudo-inverse"
        )
    return 1 / np.sqrt(np.array(ridge, np.float64))


def _answering_nothing(spectrum: Spectrum) -> np.ndarray:
    """Squared error of each row left out under an endless ridge."""
    return left_out(spectrum, np.array([_ENDLESS * max(spectrum.largest**2, 1e-300)]))[0][0]
