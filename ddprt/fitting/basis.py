"""The basis: what indirect light of this scene looks like, in as few maps as possible.

Right singular vectors of the (columns x entries) data by its Gram matrix, accumulated in float64 from float32 data tile by
tile. That is as accurate as a full SVD of the same data down to sigma_k / sigma_1 of about 2e-8, at a fifth of its time; a
float32 Gram matrix would be wrong from 5e-4 on.
"""

from dataclasses import dataclass
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
    with jax.enable_x64(True):
        mean = jnp.mean(columns, 0, dtype=jnp.float64) if centre else jnp.zeros(columns.shape[1], jnp.float64)
        tiles = [slice(first, first + _TILE) for first in range(0, columns.shape[1], _TILE)]
        gram = jnp.zeros((len(columns), len(columns)), jnp.float64)
        for tile in tiles:
            gram = gram + _gram(columns[:, tile], mean[tile], weights[tile])
        squares, rotation = jnp.linalg.eigh(gram)
        sigma = jnp.sqrt(jnp.maximum(squares[::-1], 0))
        rank = int(jnp.sum(sigma > RANK_CUT * sigma[0]))
        kept = min(bases, rank)
        turn = rotation[:, ::-1][:, :kept] / jnp.where(sigma[:kept] > 0, sigma[:kept], 1)
        parts = [_project(columns[:, tile], mean[tile], turn) for tile in tiles]
        vectors = jnp.concatenate(parts, 1) if kept else jnp.zeros((0, columns.shape[1]), jnp.float64)
        vectors = _orthonormal(vectors, weights.astype(jnp.float64)).astype(jnp.float32)
        coefficients = sum(
            (_coefficients(columns[:, tile], mean[tile], weights[tile], vectors[:, tile]) for tile in tiles),
            jnp.zeros((len(columns), kept), jnp.float64),
        )
        status: Status = "no_signal" if rank == 0 else "rank_deficient" if kept < bases else "ok"
        return Basis(vectors, mean.astype(jnp.float32), coefficients, sigma, rank, status)


@jax.jit
def _gram(tile: Array, mean: Array, weights: Array) -> Array:
    rows = (tile - mean) * jnp.sqrt(weights.astype(jnp.float64))
    return jnp.matmul(rows, rows.T, precision="highest")


@jax.jit
def _project(tile: Array, mean: Array, turn: Array) -> Array:
    return jnp.matmul(turn.T, tile - mean, precision="highest")


@jax.jit
def _coefficients(tile: Array, mean: Array, weights: Array, vectors: Array) -> Array:
    return jnp.matmul((tile - mean) * weights.astype(jnp.float64), vectors.T.astype(jnp.float64), precision="highest")


@jax.jit
def _orthonormal(vectors: Array, weights: Array) -> Array:
    """One Cholesky step removes what rounding left of the overlap; then the sign rule."""
    if vectors.shape[0] == 0:
        return vectors
    overlap = jnp.matmul(vectors * weights, vectors.T, precision="highest")
    vectors = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(overlap), vectors, lower=True)
    peak = jnp.take_along_axis(vectors, jnp.argmax(jnp.abs(vectors), 1)[:, None], 1)
    return vectors * jnp.where(peak < 0, -1, 1)


def entry_weights(area: np.ndarray, weights: Literal["area", "texel"], channels: Literal["mono", "multi"]) -> np.ndarray:
    """Weights of the entries of a column, summing to 1: one per texel, or per texel and channel when colours interleave."""
    per_texel = area / area.sum() if weights == "area" else np.full(len(area), 1 / len(area))
    return (np.repeat(per_texel / 3, 3) if channels == "multi" else per_texel).astype(np.float32)
