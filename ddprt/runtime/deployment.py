"""What of a model runs once a frame, and what once a texel: one description for all methods, of which exports are made.

Whatever was learned, an engine does three things. From what it measures, or from its lights, it makes a few features f;
u = matrix (f - offset) + intercept says what each map counts; and a shader makes light of the maps, in one of three shapes:

    compose  y = sum of u_b B_b                      the baseline, and every network that tells what its textures count
    decode   y = sum of u_b B_b + h(B) . counts      a tiny network per texel, over the maps that the texel stores
    table    y = B_best                              one of the maps, per colour

Scale, gamma and clamp are those of `ddprt.fitting.encoding`, whatever the shape.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np

from ddprt.errors import UserError
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]
"""Weights (from, to) and biases (to) of dense layers, or (groups, to) where each colour channel has its own."""


@dataclass(frozen=True, eq=False)
class Units:
    """Hidden units of a texel.

    Attributes:
      layers: from the values of all maps at a texel, colours one after the other, to the units; `gated` after each.
      coefficients: from features to the numbers that tell of the light, (groups, numbers, features).
      turn: what each of them adds to the first layer, (numbers, from + 1, to), its biases last; of no numbers where light
        enters last.
      head: (numbers, units, out), what each number makes of each unit; one row that counts whatever the light if turned.
    """

    layers: Layers
    coefficients: np.ndarray
    turn: np.ndarray
    head: np.ndarray

    @property
    def turned(self) -> bool:
        """Whether light changes the first layer, so that colours have units of their own."""
        return len(self.turn) > 0


@dataclass(frozen=True, eq=False)
class Deployment:
    """A model taken apart for an engine.

    Attributes:
      shape: what a shader does with the maps, see above.
      features: names of the parts of f, put one after the other: "z" (encoded measurements), "units" (of a network), "size" (of
        what the network read), "harmonics" and "cosines" (of the lights).
      matrix: (groups, maps, features); none for tables.
      offset, intercept: (groups, features) and (groups, maps).
      maps: (maps, texels), or (maps, texels * 3) where each map has colours of its own.
      rgb: whether they have.
      mean: a map that always counts 1.
      tensors: what makes the features, see docs/deployment.md.
      words: the same, in words.
      units: of the shape "decode".
      lights: from lights to what features are made of, by name, where that is not measured.
      example: a lighting of a kind that it knows, to check a decoder by.
    """

    shape: Literal["compose", "decode", "table"]
    features: tuple[str, ...]
    matrix: np.ndarray
    offset: np.ndarray
    intercept: np.ndarray
    maps: np.ndarray
    rgb: bool
    mean: np.ndarray | None = None
    tensors: dict[str, np.ndarray] = field(default_factory=dict)
    words: tuple[str, ...] = ()
    units: Units | None = None
    lights: Callable[[Sequence[Any]], dict[str, np.ndarray]] | None = None
    example: tuple[dict[str, Any], ...] = ()

    def textured(self, model: Model) -> Model:
        """A linear model with the same maps and transfer, which is what textures are written from."""
        held = np.zeros(self.maps.shape[1]) if self.mean is None else self.mean
        parts = (self.matrix, self.offset, self.intercept, self.maps, held)
        matrix, offset, intercept, maps, mean = (jnp.asarray(part, jnp.float32) for part in parts)
        encoding = replace(model.encoding, channels="multi" if self.rgb else "mono")
        return replace(model, relighter=LinearTransfer(matrix, offset, intercept, maps, mean), encoding=encoding)


@runtime_checkable
class Deploys(Protocol):
    """A Relighter of another package that says how it is deployed."""

    def deployment(self, model: Model) -> Deployment:
        """The model, whose relighter this is, taken apart."""
        ...


Describing = Callable[[Any, Model], Deployment]


def deployment_of(model: Model) -> Deployment:
    """A model taken apart.

    Raises:
      UserError: it is of a kind that does not say how it is deployed, has learned nothing, or has layers that are not linear.
    """
    relighter = model.relighter
    if not isinstance(relighter, Deploys) and type(relighter) not in _known():
        raise UserError(
            f'export: got a model of method "{model.method}", whose {type(relighter).__name__} does not say how it is '
            "deployed, expected one of ddprt's own or one with deployment(model); see docs/deployment.md"
        )
    for name, part in model.layers.items():
        if not isinstance(part.model.relighter, LinearTransfer):
            raise UserError(
                f'export: got layer "{name}" of method "{model.method}", expected a linear transfer, which is all that '
                'engines read for layers; set fit.method = "svd-ridge"'
            )
    return relighter.deployment(model) if isinstance(relighter, Deploys) else _known()[type(relighter)](relighter, model)


def refusal(model: Model) -> str:
    """Why a model cannot be taken apart, in one line; empty where it can."""
    try:
        deployment_of(model)
    except UserError as error:
        return str(error)
    return ""


def _known() -> dict[type, Describing]:
    from ddprt.runtime.deployments import DEPLOYMENTS

    return DEPLOYMENTS
