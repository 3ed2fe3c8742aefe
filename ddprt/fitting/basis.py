"""The basis: what indirect light of this scene looks like, in as few maps as possible.

Right singular vectors of the (columns x entries) data by its Gram matrix, accumulated in float64 from float32 data tile by
tile. Squaring costs half of the digits: the square of sigma_k is good to a few eps64 sigma_1², so sigma_k itself to 1 % only
down to some 4e-7 sigma_1. What lies deeper is looked at again without what lies above it: a second Gram matrix, of the data
projected on the deep left vectors, is as accurate relative to the largest deep value. Both together tell all that is light
rather than rounding (`RANK_CUT`); docs/stability.md has the table that this choice was made from.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_TILE = 1 << 10  # entries turned to float64 at once: 256 columns of them fit a core's second cache
_BLOCK = 1 << 25  # bytes of columns that come from disk at once
RANK_CUT = 1e-7
"""Singular values below this share of the largest are rounding of the float32 data, not light."""

# A Gram matrix as the products of its rows' upper and lower half: A A^T, A B^T and B B^T, a quarter less work than the whole.
_Gram = tuple[Array, Array, Array]
Status = Literal["ok", "rank_deficient", "no_signal"]


@dataclass(frozen=True)
class Basis:
    """An orthonormal basis under entry weights: U W U^T = Id.

    Vectors of equal singular values are some orthonormal basis of the space that they span: only that space has a meaning.

    Attributes:
      vectors: U, float32; the entry of largest magnitude of each is positive.
      mean: subtracted from every column before, zero where nothing was.
      coefficients: of the training columns, float64.
      singular_values: of the weighted data, falling, float64; to 1 % down to `RANK_CUT` times the largest. All of them, or
        where learning found the basis those within it.
      rank: numerical rank of the data.
      status: "ok"; "rank_deficient": fewer vectors than asked for, since the data has no more; "no_signal": no light at all.
    """

    vectors: Float[Array, "bases entries"]
    mean: Float[Array, " entries"]
    coefficients: Float[Array, "columns bases"]
    singular_values: Float[Array, " values"]
    rank: int
    status: Status


@runtime_checkable
class Columns(Protocol):
    """Columns that need not lie in memory: they come in blocks of entries, whole tiles all but the last, in order."""

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and entries."""
        ...

    def blocks(self) -> Iterator[Float[Array, "columns block"]]:
        """All entries, from the first on, as often as it is asked for."""
        ...


def block_entries(columns: int) -> int:
    """Entries of so many columns that go well in one block: whole tiles, 32 MiB or one tile."""
    return max(1, _BLOCK // (4 * max(columns, 1)) // _TILE) * _TILE


def fit_basis(
    columns: Float[Array, "columns entries"] | Columns, weights: Float[Array, " entries"], *, bases: int, centre: bool = False
) -> Basis:
    """The best `bases`-dimensional space for the columns, in the weighted least-squares sense.

    The data is walked through in blocks (an array is one), two times, three with `centre` and once more where the spectrum is
    deep. Beside a few blocks and the matrices of columns by columns, only the vectors are held, once in float64. How the
    entries are cut into blocks changes nothing: the tiles that sums run over are the same.

    Args:
      columns: one observation per row: scaled, encoded indirect light of a lighting (and channel).
      weights: of the entries, summing to 1.
      bases: how many vectors; fewer come back if the data has a lower rank.
      centre: subtract the mean column first.
    Raises:
      ValueError: columns or weights are not finite, or a weight is negative.
    Reference: Belcour et al., HPG 2022, Eq. 7 and 8; Turk and Pentland 1991 for the small matrix.
    """
    count, entries = columns.shape
    if count == 0 or bases == 0:
        empty = jnp.zeros((0, entries), jnp.float32)
        return Basis(empty, jnp.zeros(entries), jnp.zeros((count, 0)), jnp.zeros(count), 0, "no_signal")
    with jax.enable_x64(True):
        mean = _mean(columns) if centre else None
        sigma, rotation = _decompose(columns, weights, mean)
        if not np.isfinite(np.asarray(sigma)).all():
            raise ValueError("got NaN, infinity or a negative weight, expected finite columns and weights of 0 or more")
        if deep := _deep(np.asarray(sigma)):
            sigma, rotation = _sharpen(columns, weights, mean, sigma, rotation, *deep)
        rank = int(np.sum(np.asarray(sigma) > RANK_CUT * float(sigma[0])))
        kept = min(bases, rank)
        vectors, coefficients = _build(columns, weights, mean, sigma[:kept], rotation[:, :kept])
        shown = jnp.zeros(entries, jnp.float32) if mean is None else mean.astype(jnp.float32)
        dark = rank == 0 and not np.asarray(shown).any()
        status: Status = "no_signal" if dark else "rank_deficient" if kept < bases else "ok"
        return Basis(vectors, shown, coefficients, sigma, rank, status)


def _deep(sigma: np.ndarray) -> tuple[int, int] | None:
    """First and last (exclusive) of the values that the first Gram matrix does not tell to 1 % and that may still be light.

    Its squares are good to sqrt(n) eps sigma_1² (rounding errors of random signs; measured, a third of that), so that roots
    are good to 1 % from 50 sqrt(n) eps on. Well below the rank cut there is nothing to be told.
    """
    n = len(sigma)
    first = int(np.sum(sigma > np.sqrt(50 * np.sqrt(n) * np.finfo(float).eps) * sigma[0]))
    last = int(np.sum(sigma > RANK_CUT / 4 * sigma[0]))
    if last <= first:
        return None
    # In steps, since every other number is compiled anew.
    step = -(-n // 32)
    return max(0, last - -(-(last - first) // step) * step), last


def _decompose(columns: Array | Columns, weights: Array, mean: Array | None) -> tuple[Array, Array]:
    """Singular values and left singular vectors of the weighted data, falling, in float64."""
    return _eigen(_over_blocks(_squared, _no_square(columns.shape[0]), columns, weights, mean))


@jax.jit
def _squared(gram: _Gram, columns: Array, weights: Array, mean: Array | None) -> _Gram:
    def add(gram: _Gram, start: Array | int, columns: Array, weights: Array, mean: Array | None) -> _Gram:
        return _add_square(gram, _centred(columns, mean) * jnp.sqrt(weights.astype(jnp.float64)))

    return _over_tiles(add, gram, columns, weights, mean)


def _sharpen(
    columns: Array | Columns, weights: Array, mean: Array | None, sigma: Array, rotation: Array, first: int, last: int
) -> tuple[Array, Array]:
    """Singular values and left vectors, those from `first` to `last` taken from the data projected on them alone."""
    step = partial(_squared_part, first, last, rotation)
    gram = _over_blocks(step, _no_square(last - first), columns, weights, mean)
    return _in_order(first, sigma, rotation, *_eigen(gram))


@partial(jax.jit, static_argnums=(0, 1))
def _squared_part(
    first: int, last: int, rotation: Array, gram: _Gram, columns: Array, weights: Array, mean: Array | None
) -> _Gram:
    deep = jax.lax.optimization_barrier(rotation[:, first:last].T)

    def add(gram: _Gram, start: Array | int, columns: Array, weights: Array, mean: Array | None) -> _Gram:
        part = jnp.matmul(deep, _centred(columns, mean), precision="highest")
        return _add_square(gram, part * jnp.sqrt(weights.astype(jnp.float64)))

    return _over_tiles(add, gram, columns, weights, mean)


@partial(jax.jit, static_argnums=0)
def _in_order(first: int, sigma: Array, rotation: Array, values: Array, turn: Array) -> tuple[Array, Array]:
    """The deep values and vectors in their places, all falling."""
    last = first + len(values)
    sigma = sigma.at[first:last].set(values)
    rotation = rotation.at[:, first:last].set(jnp.matmul(rotation[:, first:last], turn, precision="highest"))
    order = jnp.argsort(-sigma)
    return sigma[order], rotation[:, order]


def _build(columns: Array | Columns, weights: Array, mean: Array | None, sigma: Array, rotation: Array) -> tuple[Array, Array]:
    """Orthonormal vectors (float32) and the columns' coefficients (float64)."""
    bases, (count, entries) = len(sigma), columns.shape
    if bases == 0:
        return jnp.zeros((0, entries), jnp.float32), jnp.zeros((count, 0), jnp.float64)
    parts: list[Array] = []

    def step(overlap: Array, *block: Any) -> Array:
        part, overlap = _projected(overlap, sigma, rotation, *block)
        parts.append(part)
        return overlap

    overlap = _over_blocks(step, jnp.zeros((bases, bases), jnp.float64), columns, weights, mean)
    # One Cholesky step removes what rounding left of the overlap; then the sign rule.
    L, straight = _upright(overlap)
    vectors, start = np.empty((bases, entries), np.float32), 0
    ends = np.full((2, bases), -np.inf)  # the largest entries of the vectors and of their negatives
    parts.reverse()
    while parts:  # one goes as the other comes
        part, top, bottom = _straightened(straight, parts.pop())
        vectors[:, start : start + part.shape[1]] = part
        start, ends = start + part.shape[1], np.maximum(ends, [top, bottom])
    sign = np.where(ends[0] < ends[1], -1.0, 1.0)
    vectors *= sign[:, None].astype(np.float32)
    # X = V S Y and Y = L U: the coefficients X W U^T need no further product with the data.
    return jnp.asarray(vectors), _weighed(rotation, sigma, L, sign)


@jax.jit
def _projected(
    overlap: Array, sigma: Array, rotation: Array, columns: Array, weights: Array, mean: Array | None
) -> tuple[Array, Array]:
    """Vectors of a block, nearly orthonormal, and the overlap with what the block adds to it."""
    turn = jax.lax.optimization_barrier((rotation / sigma).T)  # its layout must not hang on how many tiles there are

    def add(
        total: tuple[Array, Array], start: Array | int, columns: Array, weights: Array, mean: Array | None
    ) -> tuple[Array, Array]:
        vectors, overlap = total
        part = jnp.matmul(turn, _centred(columns, mean), precision="highest")
        overlap = overlap + jnp.matmul(part * weights, part.T, precision="highest")
        return jax.lax.dynamic_update_slice_in_dim(vectors, part, start, -1), overlap

    return _over_tiles(add, (jnp.zeros((len(turn), columns.shape[1]), jnp.float64), overlap), columns, weights, mean)


@jax.jit
def _upright(overlap: Array) -> tuple[Array, Array]:
    L = jnp.linalg.cholesky(overlap)
    return L, jax.scipy.linalg.solve_triangular(L, jnp.eye(len(L)), lower=True)


@jax.jit
def _straightened(straight: Array, part: Array) -> tuple[Array, Array, Array]:
    vectors = jnp.matmul(straight, part, precision="highest")
    return vectors.astype(jnp.float32), jnp.max(vectors, 1), -jnp.min(vectors, 1)


@jax.jit
def _weighed(rotation: Array, sigma: Array, L: Array, sign: Array) -> Array:
    return jnp.matmul(rotation * sigma, L, precision="highest") * sign


def _mean(columns: Array | Columns) -> Array:
    parts = [jax.block_until_ready(jnp.mean(block, 0, dtype=jnp.float64)) for block in _blocks(columns)]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def _centred(columns: Array, mean: Array | None) -> Array:
    return columns.astype(jnp.float64) if mean is None else columns - mean


def _no_square(n: int) -> _Gram:
    a, b = n // 2, n - n // 2
    return jnp.zeros((a, a), jnp.float64), jnp.zeros((a, b), jnp.float64), jnp.zeros((b, b), jnp.float64)


def _add_square(gram: _Gram, rows: Array) -> _Gram:
    a, b = jnp.split(rows, [len(rows) // 2])
    pairs = ((a, a), (a, b), (b, b))
    aa, ab, bb = (old + jnp.matmul(x, y.T, precision="highest") for old, (x, y) in zip(gram, pairs, strict=True))
    return aa, ab, bb


@jax.jit
def _eigen(gram: _Gram) -> tuple[Array, Array]:
    """Roots of the eigenvalues, falling, and eigenvectors."""
    aa, ab, bb = gram
    squares, vectors = jnp.linalg.eigh(jnp.block([[aa, ab], [ab.T, bb]]))
    return jnp.sqrt(jnp.maximum(squares[::-1], 0)), vectors[:, ::-1]


def _over_blocks(step: Callable[..., Any], total: Any, columns: Array | Columns, weights: Array, mean: Array | None) -> Any:
    """Folds `step` over blocks of entries: what comes from disk and what lies in memory take the same way.

    Waits for each block, so that there is never more than one at work and one on its way.
    """
    start = 0
    for block in _blocks(columns):
        size = block.shape[1]
        total = jax.block_until_ready(step(total, block, *(_cut(array, start, size) for array in (weights, mean))))
        start += size
    return total


def _blocks(columns: Array | Columns) -> Iterator[Array]:
    """Of an array there is one: cutting it would copy it, a sixth of the whole fit's time."""
    if isinstance(columns, Columns):
        yield from columns.blocks()
    else:
        yield columns


def _cut(array: Array | None, start: int, size: int) -> Array | None:
    if array is None or size == array.shape[-1]:
        return array
    return jax.lax.dynamic_slice_in_dim(array, start, size, -1)


def _over_tiles(add: Callable[..., Any], total: Any, *arrays: Array | None) -> Any:
    """Folds `add` over tiles of the last axis, so that only one tile at a time is float64."""
    entries = jax.tree.leaves(arrays)[0].shape[-1]
    whole = entries // _TILE * _TILE

    def step(i: Array, total: Any) -> Any:
        tile = jax.tree.map(lambda array: jax.lax.dynamic_slice_in_dim(array, i * _TILE, _TILE, -1), arrays)
        return add(total, i * _TILE, *tile)

    # A loop of one round would be taken apart and its last bits would be others: they must not tell how many tiles a block has.
    rounds = jax.lax.optimization_barrier(jnp.asarray(1)) if whole == _TILE else whole // _TILE
    total = jax.lax.fori_loop(0, rounds, step, total) if whole else total
    return add(total, whole, *jax.tree.map(lambda array: array[..., whole:], arrays)) if entries > whole else total


def entry_weights(area: np.ndarray, weights: Literal["area", "texel"], channels: Literal["mono", "multi"]) -> np.ndarray:
    """Weights of the entries of a column, summing to 1: one per texel, or per texel and channel when colours interleave."""
    per_texel = area / area.sum(dtype=np.float64) if weights == "area" else np.full(len(area), 1 / len(area))
    return (np.repeat(per_texel / 3, 3) if channels == "multi" else per_texel).astype(np.float32)
