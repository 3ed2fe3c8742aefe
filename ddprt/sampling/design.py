"""Design of experiments: which lightings tell most about all others, and which samples tell them apart.

A ridge map from measured light x to coefficients is a Gaussian process with the kernel k(x, x') = x . x'. What it still does
not know of a lighting, once some are baked, is the variance k(x, x | baked), whatever their maps turn out to be: the choice
needs measured values alone, and shadow rays at a few places are all that a candidate costs.

Lightings are taken one after the other, each the one that lowers the mean of that variance over all candidates most
(V-optimal design). Candidates are drawn as the held-out lightings are, so this mean is what a held-out error asks for. To take
the lighting of the greatest variance instead (D-optimal; up to its ridge a pivoted QR of the candidates) takes lamps at the
rim of their range first: docs/active.md measures both, and others.

Points are taken by a pivoted QR of the measurements, columns being samples: each the one that the ones before tell least
about (QDEIM: Drmac and Gugercin 2016).
"""

import numpy as np
from scipy.linalg import qr
from threadpoolctl import threadpool_limits

from ddprt.axes import Float, Float64, Int

RIDGE = 1e-2
"""Variance of what a map says beside what its measurements explain, where a lighting's own is 1; 1e-3 and 0.1 choose no better
(docs/active.md)."""
TWINS = 8 * float(np.finfo(np.float32).eps)
"""Lightings nearer than this share of their size have the same measurements but for the rounding of float32."""
RANK_CUT = 1e-7
"""Columns with less than this share of the largest left are rounding of the float32 measurements."""


def directions(values: Float[np.ndarray, "lightings places 3"]) -> Float64[np.ndarray, "lightings columns"]:
    """What a fit sees of lightings: each channel over its own norm, side by side, unit length where there is light.

    The strength of a lamp drops out, and so does its colour: only lamps of different colours at different places make channels
    that differ. A dark channel is left out, a dark lighting is zero.

    Args:
      values: measured light, in any unit.
    """
    peak = np.abs(values).max(1, keepdims=True, initial=0)
    relative = values.astype(np.float64) / np.where(peak > 0, peak, 1)
    norm = np.linalg.norm(relative, axis=1, keepdims=True)
    unit = relative / np.where(norm > 0, norm, 1)
    lit = (norm > 0).sum((1, 2), keepdims=True)
    return (unit / np.sqrt(np.maximum(lit, 1))).reshape(len(values), -1)


@threadpool_limits.wrap(limits=1, user_api="blas")  # the last bits of a product depend on how many threads it has
def choose_rows(
    rows: Float64[np.ndarray, "candidates columns"], count: int, *, ridge: float = RIDGE
) -> Int[np.ndarray, " count"]:
    """Candidates that lower the mean variance of all candidates most, greedily: every beginning is itself such a choice.

    With K the kernel of the candidates after those chosen so far, candidate j lowers the sum of variances by
    (K²)_jj / (K_jj + ridge). Both diagonals are kept up to date: K' = K - l l^T with l = K_j / sqrt(K_jj + ridge), so a choice
    costs two products with the rows and no matrix of candidates by candidates is kept.

    Candidates that are dark, or repeat a chosen one up to rounding, come after all others, in their order.

    Args:
      rows: of unit length, or zero; see `directions`.
      count: how many to choose, at most all.
      ridge: variance of what no measurement explains, > 0.
    Raises:
      ValueError: more are asked for than there are, or a ridge of 0 or less.
    """
    if not 0 <= count <= len(rows):
        raise ValueError(f"count: got {count}, expected 0 to {len(rows)}")
    if not ridge > 0:
        raise ValueError(f"ridge: got {ridge}, expected more than 0")
    size = np.einsum("ij,ij->i", rows, rows)
    variance, lowered = size.copy(), _squared_diagonal(rows)
    spent, chosen = size == 0, list[int]()
    factor = np.empty((len(rows), count))
    for step in range(count):
        gain = np.where(spent, -1.0, lowered / (np.maximum(variance, 0) + ridge))
        best = int(np.argmax(gain))
        if spent[best]:
            rest = np.setdiff1d(np.arange(len(rows)), chosen)[: count - step]
            return np.concatenate([np.array(chosen, int), rest])
        chosen.append(best)
        before = factor[:, :step]
        likeness = rows @ rows[best]
        column = (likeness - before @ before[best]) / np.sqrt(max(variance[best], 0) + ridge)
        onto = rows @ (rows.T @ column) - before @ (before.T @ column)
        lowered += column * (column * (column @ column) - 2 * onto)
        variance -= column**2
        factor[:, step] = column
        spent |= size + size[best] - 2 * likeness <= TWINS**2
    return np.array(chosen, int)


@threadpool_limits.wrap(limits=1, user_api="blas")
def choose_columns(rows: Float64[np.ndarray, "lightings samples"], count: int) -> Int[np.ndarray, " samples"]:
    """An order of all samples: first `count` pivots of a QR, then the others as they came.

    Where the lightings tell fewer samples apart than are asked for, the first of those that came earliest make up the number.

    Args:
      rows: what lightings measure there, each scaled to its own size; three per lighting, one per channel.
      count: how many become points.
    """
    triangle, pivots = qr(rows, mode="r", pivoting=True)
    left = np.abs(np.diag(triangle))
    told = int(np.sum(left > RANK_CUT * left.max(initial=0)))
    first = pivots[: min(count, told)]
    return np.concatenate([first, np.setdiff1d(np.arange(rows.shape[1]), first)])


def _squared_diagonal(rows: np.ndarray) -> np.ndarray:
    """Diagonal of (X X^T)², by whichever Gram matrix is the smaller."""
    if len(rows) <= rows.shape[1]:
        return np.asarray(((rows @ rows.T) ** 2).sum(1))
    return np.einsum("ij,ij->i", rows @ (rows.T @ rows), rows)
