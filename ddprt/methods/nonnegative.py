"""A basis without negative texels: what does it cost, and what does it save when textures have eight bits?

Light of the training columns is split into X = C B with B >= 0. A texture of unsigned bytes holds such a map as it is: all 255
steps are light, and a shader has no bias to add. Coefficients of the runtime come from measurements by the baseline's ridge and
may have any sign, so what decides is the space that B spans. With C free in training as well (semi-NMF) it may come as near to
the SVD's as it likes, since any space that holds a positive map has a positive basis. C >= 0 (NMF) sets the maps further apart.

Maps and coefficients take turns, one map at a time in closed form (HALS): no rate is to be tuned, and the error never rises.
docs/rivals.md has what gradient descent makes of it. Texels do not mix in the step of the maps, so that texels without weight
are learned like the rest.

Reference: Lee and Seung, "Learning the parts of objects by non-negative matrix factorization", Nature 1999; Cichocki and Phan,
"Fast local algorithms for large scale nonnegative matrix and tensor factorizations", IEICE Transactions 2009 (HALS);
Boutsidis and Gallopoulos, "SVD based initialization", Pattern Recognition 2008 (NNDSVD); Ding, Li and Jordan, "Convex and
semi-nonnegative matrix factorizations", PAMI 2010.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from pydantic import Field

from ddprt.fitting.basis import RANK_CUT, Basis, entry_weights, fit_basis
from ddprt.methods.method import Examples, Method, columns, in_memory
from ddprt.methods.svd_ridge import LinearTransfer, transfer_to


class Nonnegative(Method):
    """Non-negative basis, ridge transfer. Signed light has free coefficients, whatever is asked: no others could make it."""

    relighter: ClassVar[type] = LinearTransfer
    why: ClassVar[str] = "learned: what does a basis cost whose textures are light, fit for unsigned bytes without a bias?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "coefficients": ("free", "positive"),
        "start": ("svd", "random"),
        "sweeps": (50, 200, 1000),
    }
    bases: int = Field(16, ge=1)
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] | tuple[Annotated[float, Field(ge=0)], ...] = "auto"
    coefficients: Literal["positive", "free"] = Field("free", description="signs that coefficients may have in training")
    start: Literal["svd", "random"] = Field("svd", description="maps to start from: halves of the SVD's, or columns by chance")
    sweeps: int = Field(200, ge=1, description="updates of every map and all coefficients")

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> LinearTransfer:
        """See `Method`; like the SVD it looks at the training light alone. `key` draws a random start."""
        train = replace(train, indirect=in_memory(train.indirect))
        rows, _ = columns(train)
        assert isinstance(rows, Array)  # what is in memory gives rows that are
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        svd = fit_basis(rows, entries, bases=self.bases)
        if svd.rank == 0:
            return transfer_to(svd, train, self.ridge)
        free = self.coefficients == "free" or train.signed
        first = _halves(svd, entries) if self.start == "svd" else _mixtures(rows, len(svd.vectors), key)
        maps, left = _sweep(free, self.sweeps, rows, entries, first)
        basis, turn = _orthonormal(maps, rows, entries, svd)
        # The ridge is chosen where errors of coefficients are errors of light: on an orthonormal basis of the same space.
        linear = transfer_to(basis, train, self.ridge)
        matrix = np.einsum("kb,gbp->gkp", turn, np.asarray(linear.matrix, np.float64))
        return replace(
            linear,
            matrix=jnp.asarray(matrix, jnp.float32),
            intercept=jnp.zeros((len(matrix), len(maps)), jnp.float32),
            basis=maps,
            report=replace(linear.report, bases=len(maps), loss=_looks(left)),
        )


@partial(jax.jit, static_argnums=(0, 1))
def _sweep(
    free: bool, sweeps: int, rows: Array, entries: Array, maps: Array
) -> tuple[Float[Array, "bases entries"], Float[Array, " sweeps"]]:
    """Maps with a largest value of 1, and the share of the light's squares that each sweep leaves."""
    times = partial(jnp.matmul, precision="highest")
    squares = jnp.maximum(jnp.sum(rows**2 * entries), jnp.finfo(jnp.float32).tiny)

    def best(maps: Array) -> Array:
        """Coefficients of the least error, of any sign."""
        weighed = maps * entries
        overlap = times(weighed, maps.T)
        floor = jnp.finfo(jnp.float32).eps * jnp.trace(overlap) * jnp.eye(len(overlap))
        return jnp.linalg.solve(overlap + floor, times(weighed, rows.T)).T

    def sweep(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        maps, found = state
        weighed = maps * entries
        found = best(maps) if free else _in_turn(found.T, times(weighed, maps.T), times(weighed, rows.T)).T
        maps = _in_turn(maps, times(found.T, found), times(found.T, rows))
        left = jnp.sum((rows - times(found, maps)) ** 2 * entries) / squares
        size = _positive(jnp.max(maps, 1))
        return (maps / size[:, None], found * size), left

    (maps, _), left = jax.lax.scan(sweep, (maps, jnp.maximum(best(maps), 0)), None, length=sweeps)
    return maps, left


def _in_turn(rows: Float[Array, "bases _"], square: Float[Array, "bases bases"], target: Float[Array, "bases _"]) -> Array:
    """One row after the other at its non-negative best: min over row b of |A - square row b|, where target is A's product."""

    def one(k: Array, rows: Array) -> Array:
        gain = (target[k] - jnp.matmul(square[k], rows, precision="highest")) / _positive(square[k, k])
        return rows.at[k].set(jnp.where(square[k, k] > 0, jnp.maximum(rows[k] + gain, 0), rows[k]))

    return jax.lax.fori_loop(0, len(rows), one, rows)


def _halves(svd: Basis, entries: Array) -> Float[Array, "bases entries"]:
    """Of each vector the half, positive or negative, that carries more light with the coefficients of its sign."""
    vectors, coefficients = np.asarray(svd.vectors, np.float64), np.asarray(svd.coefficients)
    root = np.sqrt(np.asarray(entries, np.float64))
    halves = [(np.maximum(sign * vectors, 0), np.maximum(sign * coefficients, 0)) for sign in (1, -1)]
    size = [np.linalg.norm(half * root, axis=1) * np.linalg.norm(own, axis=0) for half, own in halves]
    return jnp.asarray(np.where((size[0] >= size[1])[:, None], halves[0][0], halves[1][0]), jnp.float32)


def _mixtures(rows: Array, bases: int, key: Array) -> Float[Array, "bases entries"]:
    """Columns drawn without repeats, what is negative in them cut off."""
    return jnp.maximum(rows[jax.random.choice(key, len(rows), (bases,), replace=False)], 0)


def _orthonormal(maps: Array, rows: Array, weights: Array, svd: Basis) -> tuple[Basis, Float64[np.ndarray, "bases directions"]]:
    """An orthonormal basis Q of what the maps B span, in float64, and T with B^T T = Q^T."""
    root = np.sqrt(np.asarray(weights, np.float64))
    B, X = np.asarray(maps, np.float64), np.asarray(rows, np.float64)
    P, S, Rt = np.linalg.svd(B * root, full_matrices=False)
    held = RANK_CUT * S.max(initial=0) < S
    turn = P[:, held] / S[held]
    vectors = turn.T @ B
    coefficients = (X * root) @ Rt[held].T
    status: Any = "rank_deficient" if held.sum() < len(B) else svd.status
    with jax.enable_x64(True):
        C, values = jnp.asarray(coefficients), jnp.asarray(np.linalg.svd(coefficients, compute_uv=False))
    empty = jnp.zeros(len(root), jnp.float32)
    return Basis(jnp.asarray(vectors, jnp.float32), empty, C, values, svd.rank, status), turn


def _looks(left: Float[Array, " sweeps"]) -> tuple[tuple[int, float, float], ...]:
    """For `FitReport.loss`: some twenty of the sweeps, the last among them; what is left of the training light stands twice."""
    values = np.asarray(left).tolist()
    sweeps = range(len(values), 0, -max(1, len(values) // 20))
    return tuple((sweep, values[sweep - 1], values[sweep - 1]) for sweep in reversed(sweeps))


def _positive(size: Array) -> Array:
    return jnp.where(size > 0, size, 1)
