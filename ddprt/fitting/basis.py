"""The basis: what indirect light of this scene looks like, in as few maps as possible.

Right singular vectors of the (columns x entries) data by its Gram matrix, accumulated in float64 from float32 data tile by
tile. That is as accurate as a full SVD of the same data down to sigma_k / sigma_1 of about 2e-8, at a fifth of its time; a
float32 Gram matrix would be wrong from 5e-4 on.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_TILE = 1 << 14  # entries turned to float64 at once
RANK_CUT = 1e-7
"""Singular values below this share of the largest are rounding of the float32 data, not light."""


Status = Literal["ok", "rank_deficient", "no_signal"]


@dataclass(frozen=True)
class Basis:
    """An orthonormal basis under entry weights: U W U^T = Id.

    Attributes:
      vectors: U, float32; the entry of largest magnitude of each is positive.
      mean: subtracted from every column before, zero where nothing was.
      coefficients: of the training columns, float64.
      singular_values: of the weighted data, all of them, falling, float64.
      rank: numerical rank of the data.
      status: "ok"; "rank_deficient": fewer vectors than asked for, since the data has no more; "no_signal": no light at all.
    """

    vectors: Float[Array, "bases entries"]
    mean: Float[Array, " entries"]
    coefficients: Float[Array, "columns bases"]
    singular_values: Float[Array, " columns"]
    rank: int
    status: Status


def fit_basis(
    columns: Float[Array, "columns entries"], weights: Float[Array, " entries"], *, bases: int, centre: bool = False
) -> Basis:
    """The best `bases`-dimensional space for the columns, in the weighted least-squares sense.

    Args:
      columns: one observation per row: scaled, encoded indirect light of a lighting (and channel).
      weights: of the entries, summing to 1.
      bases: how many vectors; fewer come back if the data has a lower rank.
      centre: subtract the mean column first.
    Reference: Belcour et al., HPG 2022, Eq. 7 and 8; Turk and Pentland 1991 for the small matrix.
    """
    if len(columns) == 0 or bases == 0:
        empty = jnp.zeros((0, columns.shape[1]), jnp.float32)
        return Basis(empty, jnp.zeros(columns.shape[1]), jnp.zeros((len(columns), 0)), jnp.zeros(len(columns)), 0, "no_signal")
    with jax.enable_x64(True):
        mean, sigma, rotation = _decompose(columns, weights, centre)
        rank = int(np.sum(np.asarray(sigma) > RANK_CUT * float(sigma[0])))
        kept = min(bases, rank)
        vectors, coefficients = _build(columns, weights, mean, rotation[:, :kept] / sigma[:kept])
        status: Status = "no_signal" if rank == 0 else "rank_deficient" if kept < bases else "ok"
        return Basis(vectors, mean.astype(jnp.float32), coefficients, sigma, rank, status)


@partial(jax.jit, static_argnames="centre")
def _decompose(columns: Array, weights: Array, centre: bool) -> tuple[Array, Array, Array]:
    """Mean column, singular values and left singular vectors of the weighted data, falling, in float64."""
    mean = jnp.mean(columns, 0, dtype=jnp.float64) if centre else jnp.zeros(columns.shape[1], jnp.float64)

    def add(gram: Array, columns: Array, mean: Array, weights: Array) -> Array:
        rows = (columns - mean) * jnp.sqrt(weights.astype(jnp.float64))
        return gram + jnp.matmul(rows, rows.T, precision="highest")

    gram = _over_tiles(add, jnp.zeros((len(columns), len(columns)), jnp.float64), columns, mean, weights)
    squares, rotation = jnp.linalg.eigh(gram)
    return mean, jnp.sqrt(jnp.maximum(squares[::-1], 0)), rotation[:, ::-1]


@jax.jit
def _build(columns: Array, weights: Array, mean: Array, turn: Array) -> tuple[Array, Array]:
    """Orthonormal vectors (float32) and the columns' coefficients (float64)."""
    if turn.shape[1] == 0:
        return jnp.zeros((0, columns.shape[1]), jnp.float32), jnp.zeros((len(columns), 0), jnp.float64)
    vectors = jnp.matmul(turn.T, columns - mean, precision="highest")
    # One Cholesky step removes what rounding left of the overlap; then the sign rule.
    overlap = jnp.matmul(vectors * weights, vectors.T, precision="highest")
    vectors = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(overlap), vectors, lower=True)
    peak = jnp.take_along_axis(vectors, jnp.argmax(jnp.abs(vectors), 1)[:, None], 1)
    vectors = (vectors * jnp.where(peak < 0, -1, 1)).astype(jnp.float32)

    def add(total: Array, columns: Array, mean: Array, weights: Array, vectors: Array) -> Array:
        return total + jnp.matmul((columns - mean) * weights, vectors.T.astype(jnp.float64), precision="highest")

    empty = jnp.zeros((len(columns), len(vectors)), jnp.float64)
    return vectors, _over_tiles(add, empty, columns, mean, weights, vectors)


def _over_tiles(add: Callable[..., Array], total: Array, *arrays: Array) -> Array:
    """Folds `add` over tiles of the last axis, so that only one tile at a time is float64."""
    entries = arrays[0].shape[-1]
    whole = entries // _TILE

    def step(i: Array, total: Array) -> Array:
        return add(total, *(jax.lax.dynamic_slice_in_dim(array, i * _TILE, _TILE, -1) for array in arrays))

    total = jax.lax.fori_loop(0, whole, step, total) if whole else total
    return add(total, *(array[..., whole * _TILE :] for array in arrays)) if entries % _TILE else total


def entry_weights(area: np.ndarray, weights: Literal["area", "texel"], channels: Literal["mono", "multi"]) -> np.ndarray:
    """Weights of the entries of a column, summing to 1: one per texel, or per texel and channel when colours interleave."""
    per_texel = area / area.sum() if weights == "area" else np.full(len(area), 1 / len(area))
    return (np.repeat(per_texel / 3, 3) if channels == "multi" else per_texel).astype(np.float32)
