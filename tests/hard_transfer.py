"""From measurements to coefficients: ridges of any size, famous matrices, leaving one lighting out."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import oracles
from hard_arrays import WITHIN, refusal
from hard_cases import REFUSED, HardCase, Outcome
from hard_judges import bound_left_out, judge_fit
from oracles import U64, over_bound, rounding

from ddprt.errors import UserError
from ddprt.fitting.selection import decompose, left_out
from ddprt.fitting.transfer import fit_transfer


def problem(lightings: int = 12, points: int = 10, bases: int = 4, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Measurements and coefficients that a linear map relates but for some noise."""
    rng = np.random.default_rng(seed)
    X = rng.random((lightings, points))
    return X, X @ rng.normal(size=(points, bases)) + 0.1 * rng.normal(size=(lightings, bases))


def _duplicated_problem() -> tuple[np.ndarray, np.ndarray]:
    X, C = problem()
    X[:, 7:] = X[:, 6:7]
    return X, C


def _near_problem() -> tuple[np.ndarray, np.ndarray]:
    X, C = problem()
    X[:, 9] = X[:, 8] * (1 + 1e-7 * np.arange(12))
    return X, C


def measured_by(matrix: np.ndarray) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Measurements with a famous matrix, and coefficients that follow from them."""
    return lambda: (matrix, matrix @ np.random.default_rng(1).normal(size=(matrix.shape[1], 4)))


def _hilbert(rows: int, columns: int) -> np.ndarray:
    return 1 / (1.0 + np.arange(rows)[:, None] + np.arange(columns))


def _vandermonde(rows: int, columns: int) -> np.ndarray:
    return np.linspace(0.1, 1, rows)[:, None] ** np.arange(columns)


def transferred(
    make: Callable[[], tuple[np.ndarray, np.ndarray]], ridge: Any, *, intercept: bool = False, says: str = ""
) -> Callable[[], Outcome]:
    """A case: the transfer alone, against 50 digits (or float64 beyond a rank cut); what it `says` where it must refuse."""

    def run() -> Outcome:
        X, C = (part.astype(np.float32) for part in make())
        try:
            fit = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge, intercept=intercept)
        except UserError as error:
            return refusal(error, says)
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


def _path_ends() -> Outcome:
    """An automatic ridge can be no worse than any of its path, and the path ends at the pseudo-inverse and at nothing."""
    X, C = (part.astype(np.float32) for part in problem(24, 10))
    fit = fit_transfer(jnp.asarray(X), jnp.asarray(C))
    path = np.asarray(fit.path)
    zero, best = (
        float(np.mean(np.sqrt(left_out(decompose(jnp.asarray(X), jnp.asarray(C)), np.array([r]))[0][0])))
        for r in (0.0, fit.ridge)
    )
    nothing = float(np.mean(np.sqrt(np.sum(C.astype(float) ** 2, 1))))
    # At the far end the map shrinks by sigma² / (sigma² + ridge) at most: so near is its residual to that of no map.
    share = float(np.asarray(fit.singular_values)[0] ** 2 / path[-1, 0])
    worst = max(
        over_bound(path[0, 1] - zero, rounding(sum(X.shape), U64) * zero),
        over_bound(path[-1, 1] - nothing, 2 * share * nothing),
        over_bound(best - path[:, 1].min(), rounding(sum(X.shape), U64) * path[:, 1].min()),
    )
    return Outcome(worst, fit.status, bool(np.isfinite(path).all()))


CASES: tuple[HardCase, ...] = (
    HardCase(
        "duplicate points, ridge 1e-30",
        "a ridge far below rounding holds nothing, and 1 / (2 sqrt(ridge)) is 5e14",
        "as the pseudo-inverse: rounding is not amplified",
        transferred(_duplicated_problem, 1e-30),
    ),
    HardCase(
        "duplicate points, ridge 1e-300",
        "squares of singular values underflow beside it",
        "as the pseudo-inverse",
        transferred(_duplicated_problem, 1e-300),
    ),
    HardCase(
        "points 1e-7 apart, pseudo-inverse",
        "what tells two points apart is near the rank cut",
        "on the kept directions within the bound, or a status",
        transferred(_near_problem, 0.0),
    ),
    HardCase(
        "points 1e-7 apart, ridge 1e-12",
        "the ridge is near the squared difference",
        "the exact ridge solution",
        transferred(_near_problem, 1e-12),
    ),
    HardCase("ridge 0", "nothing holds small singular values back", WITHIN, transferred(problem, 0.0)),
    HardCase("ridge 1e-30", "as good as none", "the exact ridge solution", transferred(problem, 1e-30)),
    HardCase(
        "ridge 1e30", "the matrix is 1e-30", "the exact ridge solution", transferred(problem, 1e30), frozenset({"overdamped"})
    ),
    HardCase("ridge 1e300", "the matrix is below every float32", "0", _nothing_left, frozenset({"overdamped"})),
    HardCase("ridge infinite", "S / (S² + inf)", "refused", transferred(problem, np.inf, says="fit.ridge: got inf"), REFUSED),
    HardCase(
        "ridge NaN",
        "compares false with everything",
        "refused",
        transferred(problem, np.nan, says="fit.ridge: got nan"),
        REFUSED,
    ),
    HardCase(
        "ridge negative",
        "makes the matrix singular somewhere",
        "refused",
        transferred(problem, -1e-3, says="fit.ridge: got -0.001"),
        REFUSED,
    ),
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
    ),
    HardCase(
        "ridge per point, one NaN",
        "one bad number among ten",
        "refused",
        transferred(problem, (1.0,) * 9 + (np.nan,), says="fit.ridge: got nan"),
        REFUSED,
    ),
    HardCase(
        "ridge per point, one infinite",
        "a stretch of 0",
        "refused",
        transferred(problem, (1.0,) * 9 + (np.inf,), says="fit.ridge: got inf"),
        REFUSED,
    ),
    *(
        HardCase(
            f"ridge per point, {what}",
            "measurements are stretched by 1 / sqrt(ridge), and squared",
            "refused",
            transferred(problem, ridge, says="fit.ridge: got"),
            REFUSED,
        )
        for what, ridge in (
            ("all 1e-300", (1e-300,) * 10),
            ("all the smallest number", (5e-324,) * 10),
            ("from 1e-300 to 1e3", tuple(np.logspace(-300, 3, 10).tolist())),
        )
    ),
    HardCase(
        "Hilbert measurements, pseudo-inverse",
        "condition 1e13 before rounding, 1e8 after",
        "on the kept directions within the bound, or a status",
        transferred(measured_by(_hilbert(12, 10)), 0.0),
        frozenset({"ill_conditioned"}),
    ),
    HardCase(
        "Hilbert measurements, ridge 1e-10",
        "half of the directions are below the ridge",
        "the exact ridge solution",
        transferred(measured_by(_hilbert(12, 10)), 1e-10),
    ),
    HardCase(
        "Hilbert measurements, automatic ridge",
        "leave-one-out with next to no noise",
        "the exact ridge solution at the ridge it takes",
        transferred(measured_by(_hilbert(12, 10)), "auto"),
        frozenset({"ill_conditioned"}),
    ),
    HardCase(
        "Vandermonde measurements",
        "powers 0 to 9 of numbers below 1",
        "the exact ridge solution at the ridge it takes",
        transferred(measured_by(_vandermonde(12, 10)), "auto"),
    ),
    HardCase(
        "transfer of a huge offset, intercept",
        "means cancel five digits",
        "the exact ridge solution of centred data",
        transferred(lambda: tuple(part + 1e5 for part in problem()), 1e-3, intercept=True),
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
)
