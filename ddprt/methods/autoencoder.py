"""A linear autoencoder: is the SVD's basis what learning finds, too?

Encoder and decoder share their weights, kept orthonormal by a QR factorisation within the loss. The subspace of least error is
that of the leading singular vectors, and there are no other minima (Baldi and Hornik, "Neural networks and principal component
analysis: learning from examples without local minima", 1989). Adam hardly gets there in thousands of steps, since what is to be
told apart differs by 1e-4 of the light; L-BFGS takes some 300 for 8 vectors of the Cornell box and 1000 for 16, and stops by
itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from ddprt.fitting.basis import RANK_CUT, Basis, entry_weights
from ddprt.methods.learned import Learned, told
from ddprt.methods.method import Examples, columns, in_memory
from ddprt.methods.svd_ridge import LinearTransfer, transfer_to


class Autoencoder(Learned):
    """Basis learned from a random start, ridge transfer."""

    relighter: ClassVar[type] = LinearTransfer
    why: ClassVar[str] = "learned: does gradient descent from a random start find the SVD's subspace?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "steps": (300, 2000),
    }
    bases: int = Field(16, ge=1)
    ridge: Literal["auto"] | float = "auto"
    steps: int = Field(2000, ge=1)
    check_every: int = Field(25, ge=1)
    patience: int = Field(4, ge=0)
    by: Literal["adam", "l-bfgs"] = "l-bfgs"

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> LinearTransfer:
        """See `Method`; like the SVD it looks at the training light alone, as `validation` would choose another subspace."""
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        light = _light(train, entries)
        trained = self.trained("autoencoder", Subspace(min(self.bases, len(entries))), light, light, key)
        basis = _basis(trained.parameters, _rows(train), entries, self.bases)
        relighter = transfer_to(basis, train, self.ridge)
        return replace(relighter, report=told(relighter.report, trained))


class Light(NamedTuple):
    """Rows times the roots of the entries' weights, and the sum of their squares."""

    rows: Float[Array, "columns entries"]
    squares: Float[Array, ""]


@dataclass(frozen=True)
class Subspace:
    """See `Problem`: a subspace that rows are projected on."""

    bases: int

    def initial(self, data: Light, key: Array) -> Float[Array, "entries bases"]:
        """Random directions."""
        return jnp.linalg.qr(jax.random.normal(key, (data.rows.shape[1], self.bases)))[0]

    def loss(self, parameters: Float[Array, "entries bases"], data: Light, key: Array) -> Float[Array, ""]:
        """Of all rows at once; and a pull towards orthonormal columns, which costs nothing and keeps rounding at bay."""
        W = parameters.astype(jnp.float32)
        skew = jnp.matmul(W.T, W, precision="highest") - jnp.eye(self.bases)
        return self.check(parameters, data) + jnp.sum(skew**2)

    def check(self, parameters: Float[Array, "entries bases"], held: Light) -> Float[Array, ""]:
        """Share of the rows' squares outside of the subspace; summed there, as 1 less the share inside has no digits."""
        Q = jnp.linalg.qr(parameters.astype(jnp.float32))[0]
        outside = held.rows - jnp.matmul(jnp.matmul(held.rows, Q, precision="highest"), Q.T, precision="highest")
        return jnp.log(jnp.maximum(jnp.sum(outside**2) / held.squares, 1e-12))


def _rows(examples: Examples) -> Float[Array, "columns entries"]:
    rows, _ = columns(replace(examples, indirect=in_memory(examples.indirect)))
    assert isinstance(rows, Array)  # what is in memory gives rows that are
    return rows


def _light(examples: Examples, entries: Float[Array, " entries"]) -> Light:
    rows = _rows(examples) * jnp.sqrt(entries)
    return Light(rows, jnp.maximum(jnp.sum(rows**2), jnp.finfo(jnp.float32).tiny))


def _basis(found: Array, rows: Array, weights: Array, asked: int) -> Basis:
    """The subspace by its principal directions, in float64: decoders are told apart by how much light they carry."""
    X, root = np.asarray(rows, np.float64), np.sqrt(np.asarray(weights, np.float64))
    Q = np.linalg.qr(np.asarray(found, np.float64))[0]
    P, S, Rt = np.linalg.svd((X * root) @ Q, full_matrices=False)
    rank = int(np.count_nonzero(RANK_CUT * S.max(initial=0) < S))
    P, S, Q = P[:, :rank], S[:rank], Q @ Rt[:rank].T
    # What weighs nothing was not learned; it goes along as the rows have it.
    vectors = np.divide(Q, root[:, None], out=X.T @ (P / S), where=root[:, None] > 0).T
    sign = np.sign(np.take_along_axis(vectors, np.argmax(np.abs(vectors), 1)[:, None], 1))
    status: Any = "no_signal" if rank == 0 else "rank_deficient" if rank < asked else "ok"
    with jax.enable_x64(True):
        coefficients, values = jnp.asarray(P * S * sign.T), jnp.asarray(S)
    return Basis(jnp.asarray(vectors * sign, jnp.float32), jnp.zeros(len(root)), coefficients, values, rank, status)
