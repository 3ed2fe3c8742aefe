"""What learned methods share: how they are trained, and coefficients of a basis as what is to be learned."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from ddprt.methods.method import Examples, FitReport, Maps, Method, grouped
from ddprt.training.loop import Problem, Trained, train
from ddprt.training.schedule import Schedule

Layers = tuple[tuple[Float[Array, "_ _"], Float[Array, " _"]], ...]


@runtime_checkable
class TakesAnyPoints(Protocol):
    """A Relighter that answers from some of the points it was trained with, in any order, by their positions and normals."""

    any_points: ClassVar[bool]


class Learned(Method):
    """A method that is trained: how long and how fast, see `Schedule`."""

    steps: int = Field(2000, ge=1)
    learning_rate: float = Field(2e-3, gt=0)
    weight_decay: float = Field(1e-4, ge=0)
    warmup: float = Field(0.0, ge=0, lt=1)
    check_every: int = Field(50, ge=1)
    patience: int = Field(0, ge=0)
    precision: Literal["float32", "bfloat16"] = "float32"

    @property
    def schedule(self) -> Schedule:
        """The settings that training knows."""
        return Schedule(**{name: getattr(self, name) for name in Schedule.model_fields if name in type(self).model_fields})

    def trained(self, name: str, problem: Problem, data: Any, held: Any, key: Array) -> Trained:
        """Trains by the method's own schedule."""
        return train(name, problem, data, held, self.schedule, key)


def told(report: FitReport, trained: Trained) -> FitReport:
    """A report with what came of the training: its losses, and its trouble in words and as a status."""
    return replace(report, loss=losses(trained), trouble=trained.trouble).noting(*statuses(trained))


def losses(trained: Trained) -> tuple[tuple[int, float, float], ...]:
    """For `FitReport.loss`: looks at which both were finite, as JSON knows no other number; `trouble` tells of the last one."""
    looks = [(entry.step, entry.loss, entry.validation) for entry in trained.history]
    return tuple(look for look in looks if np.isfinite(look).all())


def statuses(trained: Trained) -> tuple[str, ...]:
    """For `FitReport.noting`."""
    return ("diverged",) if trained.trouble else ()


def dense_layers(sizes: list[int], key: Array) -> Layers:
    """He-normal weights, zero biases."""
    keys = jax.random.split(key, len(sizes) - 1)
    start = jax.nn.initializers.he_normal()
    return tuple((start(k, (a, b), jnp.float32), jnp.zeros(b)) for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True))


class Seen(NamedTuple):
    """Measurements and the coefficients that they should give.

    Attributes:
      inputs: scaled and encoded measurements.
      targets: coefficients, over `size`.
      importance: of each lighting and group, mean 1: its share in squared errors of light.
      size: what targets were divided by.
    """

    inputs: Float[Array, "lightings groups inputs"]
    targets: Float[Array, "lightings groups bases"]
    importance: Float[Array, "lightings groups"]
    size: Float[Array, " bases"]

    @classmethod
    def of(cls, examples: Examples, groups: int, vectors: Array, entries: Array) -> "Seen":
        """Projections of all light on basis vectors, a block at a time where it stays on disk."""
        light = examples.indirect
        targets = jnp.zeros((examples.frame.values.shape[0], groups, len(vectors)))
        start = 0
        for block in light.blocks() if isinstance(light, Maps) else [light]:
            stop = start + block.shape[1] * (3 // groups)
            targets = _projected(groups, targets, block, vectors[:, start:stop], entries[start:stop])
            start = stop
        importance = importance_of(groups, examples.scale)
        return cls(grouped(examples.frame.values, groups), targets, importance, jnp.ones(len(vectors)))

    @property
    def spread(self) -> Float[Array, " bases"]:
        """Root of the mean square of each coefficient, without squares that leave the range of float32."""
        peak = jnp.maximum(jnp.max(jnp.abs(self.targets), (0, 1)), 1e-12)
        return jnp.maximum(peak * jnp.sqrt(jnp.mean((self.targets / peak) ** 2, (0, 1))), 1e-12)

    def over(self, size: Float[Array, " bases"]) -> "Seen":
        """With targets of about 1."""
        return self._replace(targets=self.targets / size, size=size)

    def error(self, found: Float[Array, "lightings groups bases"]) -> Float[Array, ""]:
        """Mean squared error of light where `found` are targets, in units of the training light's."""
        relative = self.size / jnp.max(self.size)  # of lightings that hardly any point sees, squares could pass float32's range
        share = relative**2 / jnp.sum(relative**2)
        return jnp.mean(self.importance[..., None] * share * (found.astype(jnp.float32) - self.targets) ** 2)


@partial(jax.jit, static_argnums=0)
def _projected(groups: int, before: Array, light: Array, vectors: Array, entries: Array) -> Array:
    return before + jnp.matmul(grouped(light, groups) * entries, vectors.T, precision="highest")


@partial(jax.jit, static_argnums=0)
def importance_of(groups: int, scale: Float[Array, "lightings 3"]) -> Float[Array, "lightings groups"]:
    """Each lighting's share in squared errors of light, mean 1."""
    share = (scale[:, :groups] / jnp.maximum(jnp.max(scale), jnp.finfo(jnp.float32).tiny)) ** 2
    return share / jnp.maximum(jnp.mean(share), jnp.finfo(jnp.float32).tiny)


@dataclass(frozen=True)
class Network:
    """See `Problem`: dense layers from measurements to coefficients.

    Attributes:
      width, depth: of the hidden layers.
      silent: start with an answer of 0, for what corrects others.
    """

    width: int
    depth: int
    silent: bool = False

    def initial(self, data: Seen, key: Array) -> Layers:
        """See `dense_layers`."""
        groups, inputs = data.inputs.shape[1:]
        layers = dense_layers([groups + inputs, *[self.width] * self.depth, data.targets.shape[2]], key)
        return (*layers[:-1], jax.tree.map(jnp.zeros_like, layers[-1])) if self.silent else layers

    def loss(self, parameters: Layers, data: Seen, key: Array) -> Float[Array, ""]:
        """Of all lightings at once."""
        return self.check(parameters, data)

    def check(self, parameters: Layers, held: Seen) -> Float[Array, ""]:
        """Mean squared error of light, in units of the training light's."""
        return held.error(forward(parameters, held.inputs))


def gated(values: Float[Array, "*_"]) -> Float[Array, "*_"]:
    """a (1 + a / (1 + |a|)) / 2: the activation of all networks here.

    SiLU with Elliott's sigmoid: as smooth as it need be, without an exponential, in training as in a shader. A network alone on
    coefficients of light errs no more by it than by SiLU, and less than by GELU or ReLU (docs/rivals.md).

    Reference: Elfwing, Uchibe and Doya, "Sigmoid-weighted linear units", Neural Networks 2018; Elliott, "A better activation
    function for artificial neural networks", 1993.
    """
    apart = 1 / (1 + jnp.abs(values))  # the one division, which the derivative shares
    return values * (0.5 + 0.5 * values * apart)


def forward(layers: Layers, values: Float[Array, "frames groups inputs"]) -> Float[Array, "frames groups bases"]:
    """Dense layers, `gated` between them; groups are told apart by a one-hot input."""
    frames, groups = values.shape[:2]
    which = jnp.broadcast_to(jnp.eye(groups, dtype=values.dtype), (frames, groups, groups))
    # Unit-norm measurements are small numbers; this brings them to about 1.
    hidden = jnp.concatenate([values * jnp.sqrt(values.shape[2]), which], -1).astype(layers[0][0].dtype)
    for weight, bias in layers[:-1]:
        hidden = gated(hidden @ weight + bias)
    weight, bias = layers[-1]
    return hidden @ weight + bias
