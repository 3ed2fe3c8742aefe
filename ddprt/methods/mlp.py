"""A first learned rival: a small network from measurements to coefficients of the SVD basis, trained with optax.

Same basis, same split and same metrics as the baseline, so the comparison exists from the first day.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from pydantic import Field

from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.methods.method import Examples, FitReport, Frame, Method, array_bytes, as_pytree, columns, found_in, static

Layers = tuple[tuple[Float[Array, "_ _"], Float[Array, " _"]], ...]


@as_pytree
@dataclass(frozen=True)
class Perceptron:
    """Dense layers with GELU between them, then the basis; channels are told apart by a one-hot input."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    basis: Float[Array, "bases entries"]
    spread: Float[Array, " bases"]
    groups: int = static(default=3)
    report: FitReport = field(default=FitReport(), compare=False)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        frames = len(frame.values)
        values = jnp.moveaxis(frame.values, 2, 1) if self.groups == 3 else frame.values.reshape(frames, 1, -1)
        coefficients = _forward(tuple(zip(self.weights, self.biases, strict=True)), values) * self.spread
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


class Mlp(Method):
    """Network from measurements to coefficients."""

    relighter: ClassVar[type] = Perceptron
    why: ClassVar[str] = "learned: does a nonlinear map beat the ridge on the same basis?"
    bases: int = Field(16, ge=1)
    width: int = Field(128, ge=1, le=4096)
    depth: int = Field(2, ge=1, le=16)
    steps: int = Field(2000, ge=1)
    learning_rate: float = Field(2e-3, gt=0)
    weight_decay: float = Field(1e-4, ge=0)
    check_every: int = Field(50, ge=1)

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
        data = tuple((e.frame.values, e.indirect, e.scale) for e in (train, validation))
        layers, spread, losses = _train(self, groups, *data, basis.vectors, entries, key)
        history = tuple((int(i + 1) * self.check_every, float(a), float(b)) for i, (a, b) in enumerate(np.asarray(losses)))
        finite = all(np.isfinite(row).all() for row in history)
        report = FitReport(
            bases=len(spread),
            numerical_rank=basis.rank,
            singular_values=tuple(np.asarray(basis.singular_values).tolist()),
            loss=history,
        ).noting(*found_in(train), basis.status, *(() if finite else ("diverged",)))
        weights, biases = zip(*layers, strict=True)
        return Perceptron(weights, biases, basis.vectors, spread, groups, report)

    def initial(self, inputs: int, outputs: int, key: Array) -> Layers:
        """He-normal weights, zero biases."""
        sizes = [inputs, *[self.width] * self.depth, outputs]
        keys = jax.random.split(key, len(sizes) - 1)
        start = jax.nn.initializers.he_normal()
        return tuple((start(k, (a, b), jnp.float32), jnp.zeros(b)) for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True))

    def optimiser(self) -> optax.GradientTransformation:
        """Clipped AdamW under a cosine schedule."""
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=self.weight_decay))


def _pairs(groups: int, data: tuple[Array, Array, Array], vectors: Array, entries: Array) -> tuple[Array, Array, Array]:
    """(lightings, groups, inputs), (lightings, groups, bases) and (lightings, groups) importance, mean 1."""
    values, light, scale = data
    inputs = jnp.moveaxis(values, 2, 1) if groups == 3 else values.reshape(len(values), 1, -1)
    rows = jnp.moveaxis(light, 2, 1) if groups == 3 else light.reshape(len(light), 1, -1)
    targets = jnp.matmul(rows * entries, vectors.T, precision="highest")
    share = (scale[:, :groups] / jnp.maximum(jnp.max(scale), jnp.finfo(jnp.float32).tiny)) ** 2
    return inputs, targets, share / jnp.maximum(jnp.mean(share), jnp.finfo(jnp.float32).tiny)


def _forward(layers: Layers, values: Float[Array, "frames groups inputs"]) -> Float[Array, "frames groups bases"]:
    frames, groups = values.shape[:2]
    which = jnp.broadcast_to(jnp.eye(groups, dtype=values.dtype), (frames, groups, groups))
    # Unit-norm measurements are small numbers; this brings them to about 1.
    hidden = jnp.concatenate([values * jnp.sqrt(values.shape[2]), which], -1)
    for weight, bias in layers[:-1]:
        hidden = jax.nn.gelu(hidden @ weight + bias)
    weight, bias = layers[-1]
    return hidden @ weight + bias


@partial(jax.jit, static_argnums=(0, 1))
def _train(
    method: Mlp,
    groups: int,
    train: tuple[Array, Array, Array],
    validation: tuple[Array, Array, Array],
    vectors: Array,
    entries: Array,
    key: Array,
) -> tuple[Layers, Array, Array]:
    """All of training as one compiled loop: the best layers, the spread of coefficients, and losses per round."""
    inputs, targets, importance = _pairs(groups, train, vectors, entries)
    peak = jnp.maximum(jnp.max(jnp.abs(targets), (0, 1)), 1e-12)
    spread = jnp.maximum(peak * jnp.sqrt(jnp.mean((targets / peak) ** 2, (0, 1))), 1e-12)
    checked, wanted, checked_importance = _pairs(groups, validation, vectors, entries)
    relative = spread / jnp.max(spread)  # of lightings that hardly any point sees, squares could pass the range of float32
    share = relative**2 / jnp.sum(relative**2)
    optimiser = method.optimiser()

    def loss(layers: Layers, inputs: Array, targets: Array, importance: Array) -> Array:
        return jnp.mean(importance[..., None] * share * (_forward(layers, inputs) - targets / spread) ** 2)

    def step(state: tuple, _: None) -> tuple[tuple, None]:
        layers, memory = state
        updates, memory = optimiser.update(jax.grad(loss)(layers, inputs, targets, importance), memory, layers)
        return (optax.apply_updates(layers, updates), memory), None

    def one_round(carry: tuple, _: None) -> tuple[tuple, Array]:
        state, best, lowest = carry
        state, _ = jax.lax.scan(step, state, None, length=min(method.check_every, method.steps))
        now = loss(state[0], checked, wanted, checked_importance)
        better = now < lowest  # never of NaN: weights that are not finite are not kept
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), state[0], best)
        return (state, best, jnp.where(better, now, lowest)), jnp.stack([loss(state[0], inputs, targets, importance), now])

    layers = method.initial(groups + inputs.shape[2], len(spread), key)
    start = ((layers, optimiser.init(layers)), layers, jnp.inf)
    (_, best, _), losses = jax.lax.scan(one_round, start, None, length=max(1, method.steps // method.check_every))
    return best, spread, losses
