"""What the baseline leaves over, learned by a network on top of it.

The network corrects the coefficients of svd-ridge. It learns from residuals of transfers that have not seen the lighting in
question, since those of the transfer itself are too small; how much of its correction is taken is decided on the validation
lightings, and it is none where that makes them worse. Reference: Wolpert, "Stacked generalization", Neural Networks 1992.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from ddprt.fitting.basis import Basis, entry_weights, fit_basis
from ddprt.fitting.selection import decompose, missed
from ddprt.methods.learned import Learned, Network, Seen, forward, told
from ddprt.methods.method import Examples, FitReport, Frame, array_bytes, as_pytree, columns, grouped, measured
from ddprt.methods.svd_ridge import LinearTransfer, compose, targets, transfer_to


@as_pytree
@dataclass(frozen=True)
class Corrected:
    """u = M z + gate * spread * network(z), y = U u."""

    matrix: Float[Array, "groups bases inputs"]
    basis: Float[Array, "bases entries"]
    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    spread: Float[Array, " bases"]
    gate: Float[Array, ""]
    report: FitReport = field(default=FitReport(), compare=False)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        groups = len(self.matrix)
        values = grouped(frame.values, groups)
        linear = jnp.einsum("gbp,fgp->fgb", self.matrix, values, precision="highest")
        network = forward(tuple(zip(self.weights, self.biases, strict=True)), values) * self.spread
        # Where the gate is shut, even a network that has gone wrong adds nothing.
        light = compose(linear + jnp.where(self.gate > 0, self.gate * network, 0), self.basis, jnp.zeros(self.basis.shape[1]))
        return light if groups == 3 else light.reshape(len(light), -1, 3)

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`."""
        groups, bases, inputs = self.matrix.shape
        network = sum(int(w.size) for w in self.weights)
        return 2 * groups * (bases * (inputs + self.basis.shape[1]) + network)


class Residual(Learned):
    """Network on top of svd-ridge, weighed by what it is worth on validation lightings."""

    relighter: ClassVar[type] = Corrected
    why: ClassVar[str] = "learned: is there anything non-linear left that the ridge misses?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "width": (16, 32, 64),
        "depth": (1, 2),
        "learning_rate": (1e-3, 2e-3, 5e-3),
        "weight_decay": (1e-3, 1e-2, 0.1),
        "steps": (500, 2000),
    }
    streams: ClassVar[bool] = True
    bases: int = Field(16, ge=1)
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"
    width: int = Field(64, ge=1, le=4096)
    depth: int = Field(2, ge=1, le=16)
    weight_decay: float = Field(1e-2, ge=0)

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> Corrected:
        """See `Method`."""
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        basis = fit_basis(columns(train)[0], entries, bases=self.bases)
        linear = transfer_to(basis, train, self.ridge)
        groups, bases, inputs = linear.matrix.shape
        if bases == 0:
            nothing = (jnp.zeros((groups + inputs, 0)),), (jnp.zeros(0),), jnp.zeros(0), jnp.zeros(())
            return Corrected(linear.matrix, linear.basis, *nothing, linear.report)
        seen, held = (Seen.of(part, groups, basis.vectors, entries) for part in (train, validation))
        seen = _left_out(basis, train, linear, seen)
        held = held._replace(targets=held.targets - linear.coefficients(validation.frame))
        seen, held = seen.over(seen.spread), held.over(seen.spread)
        trained = self.trained("residual", Network(self.width, self.depth, silent=True), seen, held, key)
        gate = _worth(trained.parameters, held)
        report = told(linear.report, trained)
        weights, biases = zip(*trained.parameters, strict=True)
        return Corrected(linear.matrix, linear.basis, weights, biases, seen.size, gate, report)


def _left_out(basis: Basis, train: Examples, linear: LinearTransfer, seen: Seen) -> Seen:
    """What the transfer misses of each training lighting when it has not seen it."""
    coefficients, residuals = targets(basis, train), np.zeros(seen.targets.shape)
    for part, ridge in zip(measured(train), linear.report.ridge, strict=True):
        spectrum = decompose(part.values, jnp.asarray(coefficients[part.group][part.rows]))
        residuals[part.rows, part.group] = missed(spectrum, ridge)
    return seen._replace(targets=jnp.asarray(residuals, jnp.float32))


@jax.jit
def _worth(parameters: Any, held: Seen) -> Float[Array, ""]:
    """The share of the correction that lowers the error on validation lightings the most: 0 to 1, 0 where it is not finite."""
    found = forward(parameters, held.inputs)
    share = held.importance[..., None] * held.size**2 / jnp.max(held.size) ** 2
    best = jnp.sum(share * found * held.targets) / jnp.maximum(jnp.sum(share * found**2), jnp.finfo(jnp.float32).tiny)
    return jnp.where(jnp.isfinite(best), jnp.clip(best, 0, 1), 0.0)
