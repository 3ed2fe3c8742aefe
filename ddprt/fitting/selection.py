"""The choice of a ridge: leave one lighting out, in closed form, for every ridge of a path after a single decomposition.

Three things can fool a plain leave-one-out, and each is met here. A lighting with a twin (the same lamp at another
brightness has the same scaled measurements) is predicted by its twin: twins are left out together, and so are lightings that
nearly repeat each other (a lamp measured twice, frames of a slow path). A few lightings with
great errors decide a mean of squares: the mean of norms is minimised instead. And 1 - h, by which a residual is divided,
cancels where a lighting decides its own fit: it is summed from its positive parts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

RANK_CUT = 1e-7
"""Singular values below this share of the largest are rounding of the float32 measurements."""
TWINS = 8 * float(np.finfo(np.float32).eps)
"""Rows nearer than this share of their size are one lighting: scaling rounds each value three times, in each of two rows."""
REPEATS = 0.01
"""Rows nearer than this share of their size are left out with a row: lamps drawn in a room lie ten times further apart."""
SECOND_OPINION = 1.1
"""How far the leave-one-out error at the ridge of generalised cross-validation may lie above its own minimum: a tenth."""
_EPS = float(np.finfo(np.float64).eps)
_RIDGES = 57  # four per decade, from 1e-13 to 10 times the largest squared singular value; below it the rank cut decides


@dataclass(frozen=True)
class Spectrum:
    """One transfer problem, decomposed so that any ridge costs one product; float64.

    Attributes:
      left: Q, all of it, so that directions without signal are columns too; orthogonal to the intercept where there is one.
      values: S, falling, one per column of `left`, 0 where there are more lightings than points.
      right: P^T over the stretched measurements.
      turned: Q^T C.
      targets: C of every row, centred.
      group: which row of `left` each row of the data went to; twins share one.
      count: how many twins each row of `left` stands for.
      repeats: a row of `left` that others nearly repeat, and those others; one entry per such row.
      offset, start: means taken off both sides, zero without intercept.
      rank: how many directions carry signal; the others are rounding and get no weight under any ridge, since a tiny one
        would blow them up.
    """

    left: Float[Array, "groups directions"]
    values: Float[Array, " directions"]
    right: Float[Array, "values points"]
    turned: Float[Array, "directions bases"]
    targets: Float[Array, "lightings bases"]
    group: Int[np.ndarray, " lightings"]
    count: Float[np.ndarray, " groups"]
    repeats: tuple[Int[np.ndarray, " _"], ...]
    offset: Float[Array, " points"]
    start: Float[Array, " bases"]
    rank: int

    @property
    def largest(self) -> float:
        """The largest singular value, 0 where there is none."""
        return float(self.values[0]) if len(self.values) else 0.0


@dataclass(frozen=True)
class Choice:
    """A ridge, and how it was come by.

    Attributes:
      ridge: the one with the lowest leave-one-out error.
      path: (ridge, leave-one-out error, generalised cross-validation) of all matrices together.
      own: the same leave-one-out error of each matrix alone, over the same ridges.
      second: the ridge that generalised cross-validation would take.
      remarks: of "few_lightings", "dominated", "ridge_at_end" and "choices_disagree", those that hold.
    """

    ridge: float
    path: Float[np.ndarray, "ridges 3"]
    own: Float[np.ndarray, "matrices ridges"]
    second: float
    remarks: tuple[str, ...]


def decompose(
    measured: Float[Array, "lightings points"],
    coefficients: Float[Array, "lightings bases"],
    *,
    stretch: Float[np.ndarray, " points"] | None = None,
    intercept: bool = False,
) -> Spectrum:
    """The singular value decomposition of the measurements with twins merged.

    m equal rows and their m targets weigh in the fit as one row and its mean target, both times the root of m. So the matrix
    is the same, and leaving that row out leaves out all twins.

    Args:
      measured: X.
      coefficients: C.
      stretch: factor of each point; a ridge of 1 then weighs point i by 1 / stretch_i².
      intercept: centre both sides.
    """
    X = np.asarray(measured, np.float64)
    _, first, group, count = np.unique(
        np.argmax(_near(X, TWINS), 1), return_index=True, return_inverse=True, return_counts=True
    )
    near = _near(X[first], REPEATS)
    np.fill_diagonal(near, False)
    repeats = tuple(np.append(row, np.flatnonzero(near[row])) for row in np.flatnonzero(near.any(1)))
    with jax.enable_x64(True):
        parts = _decompose(
            jnp.asarray(X),
            jnp.asarray(np.asarray(coefficients, np.float64)),
            jnp.ones(X.shape[1]) if stretch is None else jnp.asarray(stretch),
            jnp.asarray(group),
            jnp.asarray(count.astype(np.float64)),
            intercept,
            stretch is not None,
        )
        plain = np.asarray(parts[-1])
    rank = int(np.sum(plain > RANK_CUT * plain.max(initial=0)))
    left, values, right, turned, targets, offset, start, _ = parts
    return Spectrum(left, values, right, turned, targets, group, count.astype(np.float64), repeats, offset, start, rank)


def left_out(
    spectrum: Spectrum, ridges: Float[np.ndarray, " ridges"]
) -> tuple[Float[np.ndarray, "ridges lightings"], Float[np.ndarray, "ridges lightings"]]:
    """Squared norm of each lighting's error when it is left out with its like, and what its mean leverage would make it.

    The second is for generalised cross-validation, which puts the mean of 1 - h in the place of each (Golub, Heath and
    Wahba 1979).
    """
    found = [[np.sum(part**2, 1) for part in both] for both in _errors(spectrum, ridges)]
    each, generalised = np.array(found).reshape(len(ridges), 2, -1).swapaxes(0, 1)
    return each, generalised


def missed(spectrum: Spectrum, ridge: float) -> Float[np.ndarray, "lightings bases"]:
    """What each lighting's coefficients are off by, true less predicted, when it is left out with its like."""
    return next(_errors(spectrum, np.array([ridge])))[0]


def _errors(spectrum: Spectrum, ridges: Float[np.ndarray, " ridges"]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each ridge the vectors whose squares `left_out` sums."""
    Q, S, QtC, C = (np.asarray(part) for part in (spectrum.left, spectrum.values, spectrum.turned, spectrum.targets))
    group, count = spectrum.group, spectrum.count
    held = np.arange(len(S)) < spectrum.rank
    # A row that is orthogonal to all directions without signal, up to rounding, decides its own fit as the ridge goes to 0.
    # There both sides of the quotient vanish with the ridge; without that factor they have a limit.
    alone = np.sum(Q[:, ~held] ** 2, 1) <= (len(count) * _EPS) ** 2
    mean = np.zeros((len(count), C.shape[1]))
    np.add.at(mean, group, C / count[group, None])
    inward, weight, squares = C - mean[group], 1 / np.sqrt(count[group, None]), Q**2

    def parts(share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return Q @ (share[:, None] * QtC), squares @ share

    for ridge in ridges:
        # e_k = ((Id - H) c)_k / (1 - h_kk), where Id - H = Q diag(t) Q^T with t = ridge / (S² + ridge), 1 past the rank.
        sizes = _positive(np.where(held, S**2 + ridge, 1))
        least = np.min(sizes, where=held, initial=np.inf)
        loose, tight = np.where(held, ridge / sizes, 1), np.where(held, least / sizes, 0)
        error, free = typical = parts(loose)
        if alone.any():
            near, bound = limit = parts(tight)
            error, free = np.where(alone[:, None], near, error), np.where(alone, bound, free)
            typical = limit if held.all() else typical
        error, general = error / _positive(free)[:, None], typical[0] / (np.mean(typical[1]) or 1)
        for rows in spectrum.repeats:
            # e = ((Id - H)_rows)^-1 ((Id - H) c)_rows is a least-squares solution, which does not square their likeness.
            share = tight if alone[rows].all() else np.maximum(loose, np.where(held, _EPS * least / sizes, 1))
            root = np.sqrt(share)[:, None]
            error[rows[0]] = np.linalg.lstsq(root * Q[rows].T, root * QtC, rcond=None)[0][0]
        # Twins share a prediction: their mean target less the error of their row.
        yield inward + error[group] * weight, inward + general[group] * weight


def choose_ridge(
    spectra: Sequence[Spectrum],
    importance: Sequence[Float[np.ndarray, " _"]],
    lightings: Sequence[Int[np.ndarray, " _"]],
    *,
    power: float = 1.0,
) -> Choice:
    """The ridge that predicts left-out lightings best, one for all matrices.

    A lighting is left out of all matrices at once; its errors in all of them make one norm. The mean of these norms (power
    1) is minimised, or of their squares (power 2). On 72 splits of two baked rooms (experiments/ridge_choice.py) norms cost
    1.0 % over the best ridge and squares 1.9 %; where samples hit or miss the spots of near lamps, 8 and 15 %. Where one
    lighting makes more than half of the mean of norms, its error is a sample of one: then the geometric mean is minimised, in
    which all lightings count alike.

    Args:
      spectra: one per transfer matrix.
      importance: s² of each row, up to a factor common to all matrices.
      lightings: which lighting each row is.
    """
    weights = _relative(importance)
    largest = max((spectrum.largest for spectrum in spectra), default=0.0)
    ridges = np.concatenate([[0.0], np.logspace(-13, 1, _RIDGES)]) * max(largest**2, 1e-300)
    total = 1 + max((int(rows.max()) for rows in lightings), default=0)
    errors, seconds, weight = np.zeros((len(ridges), total)), np.zeros((len(ridges), total)), np.zeros(total)
    apart = []
    for spectrum, share, rows in zip(spectra, weights, lightings, strict=True):
        squares, generalised = (part * share for part in left_out(spectrum, ridges))
        errors[:, rows] += squares
        seconds[:, rows] += generalised
        weight[rows] += share
        apart.append((squares, share))
    distinct = max((len(spectrum.count) for spectrum in spectra), default=0)
    parts = errors[np.argmin(_mean(errors, weight, power))] ** (power / 2)
    dominated = bool(distinct > 2 and parts.max() > parts.sum() / 2)
    if dominated and power == 1:
        power = 0.0
    path, second = _mean(errors, weight, power), _mean(seconds, weight, power)
    best, other = int(np.argmin(path)), int(np.argmin(second))
    remarks = {
        "few_lightings": distinct <= 2,
        "dominated": dominated,
        "ridge_at_end": distinct > 2 and best in (0, len(ridges) - 1),
        "choices_disagree": path[other] > SECOND_OPINION * path[best],
    }
    held = tuple(name for name, holds in remarks.items() if holds)
    own = np.array([_mean(*rows, power) for rows in apart])
    return Choice(float(ridges[best]), np.stack([ridges, path, second], 1), own, float(ridges[other]), held)


def _relative(importance: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Importance with 1 as its largest, so that no sum overflows; all alike where all of it is zero."""
    peak = max((float(np.max(part, initial=0)) for part in importance), default=0.0)
    return [np.asarray(part, np.float64) / peak if peak > 0 else np.ones(len(part)) for part in importance]


def _mean(squares: np.ndarray, weight: np.ndarray, power: float) -> np.ndarray:
    """Mean norm over mean weight of its kind: power 2 root mean square, 1 mean, 0 geometric mean."""
    if power > 0:
        return (np.sum(squares ** (power / 2), -1) / np.sum(weight ** (power / 2))) ** (1 / power)
    lit = weight > 0
    least = _EPS**2  # of its weight: a residual below it is rounding
    return np.exp(np.mean(np.log(np.maximum(squares[..., lit] / weight[lit], least)), -1) / 2)


def _near(X: np.ndarray, share: float) -> np.ndarray:
    """Whether two rows are within a share of their size of each other."""
    size = np.einsum("lp,lp->l", X, X)
    pair = size[:, None] + size
    # Gram entries are good to about points * eps64 of their size, far below the square of TWINS.
    return pair - 2 * X @ X.T <= share**2 / 2 * pair


@partial(jax.jit, static_argnums=(5, 6))
def _decompose(
    X: Array, C: Array, stretch: Array, group: Array, count: Array, intercept: bool, stretched: bool
) -> tuple[Array, ...]:
    offset = jnp.mean(X, 0) if intercept else jnp.zeros(X.shape[1])
    start = jnp.mean(C, 0) if intercept else jnp.zeros(C.shape[1])
    X, C = X - offset, C - start
    root = jnp.sqrt(count)[:, None]
    merged, wanted = (jax.ops.segment_sum(part, group, len(count)) / root for part in (X, C))
    # The intercept fits the direction of `root` alone, to which centred rows are orthogonal: work in what is left.
    frame = jnp.linalg.qr(root, mode="complete")[0][:, 1:] if intercept else jnp.eye(len(count))
    rows = jnp.matmul(frame.T, merged, precision="highest")
    Q, S, Pt = jnp.linalg.svd(rows * stretch, full_matrices=rows.shape[0] > rows.shape[1])
    # Whether a direction is rounding is asked of the measurements as they came: stretching spreads singular values at will.
    plain = jnp.linalg.svd(rows, compute_uv=False) if stretched else S
    S = jnp.concatenate([S, jnp.zeros(rows.shape[0] - len(S))])
    Q = jnp.matmul(frame, Q, precision="highest")
    return Q, S, Pt, jnp.matmul(Q.T, wanted, precision="highest"), C, offset, start, plain


def _positive(value: np.ndarray) -> np.ndarray:
    return np.where(value > 0, value, 1)
