"""How long and how fast to train."""

from typing import Literal

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int
from pydantic import BaseModel, ConfigDict, Field


class Schedule(BaseModel):
    """How steps are made: by Adam or by L-BFGS.

    Adam has decoupled weight decay, clipped gradients, and a rate that warms up and falls as a cosine. L-BFGS is for smooth
    problems whose loss has no chance in it: a line search finds the length of each step, so that rate, decay and clip do
    nothing. A learned method repeats those fields that its users may set.

    Reference: Loshchilov and Hutter, "Decoupled Weight Decay Regularization", ICLR 2019; Nocedal and Wright, "Numerical
    Optimization", 2006, algorithms 7.5 and 3.5.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    steps: int = Field(2000, ge=1)
    learning_rate: float = Field(2e-3, gt=0)
    weight_decay: float = Field(1e-4, ge=0)
    warmup: float = Field(0.0, ge=0, lt=1, description="share of the steps in which the rate rises")
    clip: float = Field(1.0, gt=0, description="largest norm of a gradient")
    check_every: int = Field(50, ge=1, description="steps between looks at the validation data")
    patience: int = Field(0, ge=0, description="looks without a better one before training stops; 0 trains to the end")
    precision: Literal["float32", "bfloat16"] = "float32"
    by: Literal["adam", "l-bfgs"] = "adam"

    @property
    def round(self) -> int:
        """Steps of a round; what the last round has too few of is left out."""
        return min(self.check_every, self.steps)

    @property
    def rounds(self) -> int:
        """Looks at the validation data."""
        return max(1, self.steps // self.check_every)

    @property
    def dtype(self) -> jnp.dtype:
        """What parameters are multiplied in; they are kept and updated in float32."""
        return jnp.dtype(self.precision)

    @property
    def numbers(self) -> Float[Array, " 5"]:
        """What the loop takes as data, so that another value compiles nothing: rate, decay, warm-up, clip and steps."""
        return jnp.array([self.learning_rate, self.weight_decay, self.warmup, self.clip, self.steps], jnp.float32)


def rate(numbers: Float[Array, " 5"], step: Int[Array, ""]) -> Float[Array, ""]:
    """Learning rate of a step, counted from 0."""
    peak, _, warmup, _, steps = numbers
    rising = warmup * steps
    share = (step - rising) / jnp.maximum(steps - rising, 1)
    cosine = 0.5 * (1 + jnp.cos(jnp.pi * jnp.clip(share, 0, 1)))
    return peak * jnp.where(step < rising, (step + 1) / jnp.maximum(rising, 1), cosine)


def memory(by: str) -> optax.GradientTransformation:
    """What remembers gradients; Adam's rate, decay and clip are the loop's."""
    return optax.scale_by_adam() if by == "adam" else optax.lbfgs(memory_size=20)
