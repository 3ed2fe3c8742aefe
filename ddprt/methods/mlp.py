"""A first learned rival: a small network from measurements to coefficients of the SVD basis, trained with optax.

Same basis, same split and same metrics as the baseline, so the comparison exists from the first day.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.methods.learned import Learned, Network, Seen, forward, told
from ddprt.methods.method import Examples, FitReport, Frame, array_bytes, as_pytree, columns, found_in, grouped, static


@as_pytree
@dataclass(frozen=True)
class Perceptron:
    """Dense layers, `gated` between them, then the basis; channels are told apart by a one-hot input."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    basis: Float[Array, "bases entries"]
    spread: Float[Array, " bases"]
    groups: int = static(default=3)
    report: FitReport = field(default=FitReport(), compare=False)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        frames = len(frame.values)
        coefficients = (
            forward(tuple(zip(self.weights, self.biases, strict=True)), grouped(frame.values, self.groups)) * self.spread
        )
        light = jnp.matmul(coefficients, self.basis, precision="highest")
        return jnp.moveaxis(light, 1, 2) if self.groups == 3 else light.reshape(frames, -1, 3)

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`."""
        return 2 * self.groups * (sum(int(w.size) for w in self.weights) + int(self.basis.size))


class Mlp(Learned):
    """Network from measurements to coefficients."""

    relighter: ClassVar[type] = Perceptron
    why: ClassVar[str] = "learned: does a nonlinear map beat the ridge on the same basis?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "width": (16, 32, 64, 128),
        "depth": (1, 2, 3),
        "learning_rate": (1e-3, 2e-3, 5e-3),
        "weight_decay": (1e-4, 1e-2, 0.1),
        "steps": (500, 2000),
    }
    streams: ClassVar[bool] = True
    bases: int = Field(16, ge=1)
    width: int = Field(128, ge=1, le=4096)
    depth: int = Field(2, ge=1, le=16)

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> Perceptron:
        """See `Method`: full-batch AdamW with a cosine schedule; keeps the weights that were best on `validation`."""
        rows, _ = columns(train)
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        basis = fit_basis(rows, entries, bases=self.bases)
        groups = 3 if train.channels == "mono" else 1
        if basis.rank == 0:
            inputs = groups + train.frame.values.shape[1] * (3 // groups)
            dark = ((jnp.zeros((inputs, 0)),), (jnp.zeros(0),), basis.vectors, jnp.zeros(0))
            return Perceptron(*dark, groups, FitReport().noting(*found_in(train), "no_signal"))
        seen, held = (Seen.of(part, groups, basis.vectors, entries) for part in (train, validation))
        spread = seen.spread
        trained = self.trained("mlp", Network(self.width, self.depth), seen.over(spread), held.over(spread), key)
        report = FitReport(
            bases=len(spread),
            numerical_rank=basis.rank,
            singular_values=tuple(np.asarray(basis.singular_values).tolist()),
        ).noting(*found_in(train), basis.status)
        weights, biases = zip(*trained.parameters, strict=True)
        return Perceptron(weights, biases, basis.vectors, spread, groups, told(report, trained))
