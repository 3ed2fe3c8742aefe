"""Scale and space: what a method sees of a lighting.

Values are divided by their norm, so that every method answers twice the light with twice the result; then they may be
bent by a signed power, which evens out high contrast (Belcour et al. 2022, 5.3).
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Encoding:
    """How light is written before transfer and read after it.

    Attributes:
      space: "linear", or "gamma" for v -> sign(v) |v|^(1/gamma).
      gamma: exponent of the gamma space.
      channels: "mono" scales each colour channel on its own, "multi" all together.
    """

    space: Literal["linear", "gamma"] = "linear"
    gamma: float = 2.2
    channels: Literal["mono", "multi"] = "mono"

    def scale(self, values: Float[Array, "lightings points 3"]) -> Float[Array, "lightings 3"]:
        """s = ||x|| per lighting and channel (all channels alike for "multi"), safe from overflow and underflow."""
        axes = (1,) if self.channels == "mono" else (1, 2)
        peak = jnp.max(jnp.abs(values), axes, keepdims=True)
        relative = values / jnp.where(peak > 0, peak, 1)
        norm = peak * jnp.sqrt(jnp.sum(relative**2, axes, keepdims=True))
        return jnp.broadcast_to(norm, (values.shape[0], 1, 3))[:, 0]

    def encode(
        self, values: Float[Array, "lightings places 3"], scale: Float[Array, "lightings 3"]
    ) -> Float[Array, "lightings places 3"]:
        """Scaled and bent; lightings of scale 0 become 0."""
        dark = scale[:, None] == 0
        relative = jnp.where(dark, 0, values / jnp.where(dark, 1, scale[:, None]))
        if self.space == "linear":
            return relative
        # The power has an infinite slope at 0: the inner where keeps gradients finite there.
        size = jnp.abs(relative)
        return jnp.sign(relative) * jnp.where(size > 0, jnp.where(size > 0, size, 1) ** (1 / self.gamma), 0)

    def decode(
        self, encoded: Float[Array, "lightings places 3"], scale: Float[Array, "lightings 3"], *, clamp: bool | Array = True
    ) -> Float[Array, "lightings places 3"]:
        """The inverse of `encode`, in W/m²; negative light is clamped to 0 unless asked otherwise."""
        encoded = jnp.where(clamp, jnp.maximum(encoded, 0), encoded)
        if self.space == "gamma":
            encoded = jnp.sign(encoded) * jnp.abs(encoded) ** self.gamma
        return encoded * scale[:, None]


jax.tree_util.register_dataclass(Encoding, data_fields=[], meta_fields=["space", "gamma", "channels"])
