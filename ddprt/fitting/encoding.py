"""Scale and space: what a method sees of a lighting.

Values are divided by their norm, so that every method answers twice the light with twice the result; then they may be
bent by a signed power, which evens out high contrast (Belcour et al. 2022, 5.3).

Finite light stays finite: what would pass the range of float32 becomes its largest number, so that no infinity meets a zero
and turns into NaN. Light below its smallest normal number may count as dark.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LARGEST = float(jnp.finfo(jnp.float32).max)
_DIVISIBLE = 2.0**126  # past it a reciprocal, which is how broadcast divisions are compiled, is subnormal and flushed to 0


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
        """s = ||x|| per lighting and channel (all channels alike for "multi"), safe from overflow and underflow.

        Past 2^126 it stays there. Without a mean that changes nothing: what is divided by it is multiplied by it again.
        """
        axes = (1,) if self.channels == "mono" else (1, 2)
        # The norm does not depend on what it is taken in units of, so neither does its gradient.
        peak = jax.lax.stop_gradient(jnp.minimum(jnp.max(jnp.abs(values), axes, keepdims=True), _DIVISIBLE))
        relative = values / jnp.where(peak > 0, peak, 1)
        # The root has an infinite slope at 0: in the dark it is taken of 1, for the sake of gradients.
        square = jnp.where(peak > 0, jnp.sum(relative**2, axes, keepdims=True), 1)
        norm = jnp.minimum(peak * jnp.sqrt(square), _DIVISIBLE)
        return jnp.broadcast_to(norm, (values.shape[0], 1, 3))[:, 0]

    def encode(
        self, values: Float[Array, "lightings places 3"], scale: Float[Array, "lightings 3"]
    ) -> Float[Array, "lightings places 3"]:
        """Scaled and bent; lightings of scale 0 become 0."""
        dark = scale[:, None] == 0
        relative = _finite(jnp.where(dark, 0, values / jnp.where(dark, 1, scale[:, None])))
        if self.space == "linear":
            return relative
        # The power has an infinite slope at 0: the inner where keeps gradients finite there.
        size = jnp.abs(relative)
        return jnp.sign(relative) * jnp.where(size > 0, jnp.where(size > 0, size, 1) ** (1 / self.gamma), 0)

    def decode(
        self,
        encoded: Float[Array, "lightings places 3"],
        scale: Float[Array, "lightings 3"],
        *,
        clamp: bool | Array = True,
        energy_over: Float[Array, " places"] | None = None,
    ) -> Float[Array, "lightings places 3"]:
        """The inverse of `encode`, in W/m².

        Args:
          encoded: what `encode` made, or a method predicts.
          scale: as it was for `encode`.
          clamp: cut negative light off.
          energy_over: area of each place; negative light is then taken out by `without_negatives` instead.
        """
        if energy_over is None:
            encoded = jnp.where(clamp, jnp.maximum(encoded, 0), encoded)
        if self.space == "gamma":
            # Half the range is left for the rounding of the power, which grows with gamma.
            size = jnp.minimum(jnp.abs(encoded), (_LARGEST / 2) ** (1 / self.gamma))
            encoded = jnp.sign(encoded) * size**self.gamma
        if energy_over is not None:
            encoded = without_negatives(encoded, energy_over)
        return _finite(encoded * scale[:, None])


def without_negatives(
    light: Float[Array, "lightings places 3"], area: Float[Array, " places"]
) -> Float[Array, "lightings places 3"]:
    """The nearest map without negative light that has the same energy, of each lighting and channel.

    Cutting at zero adds the energy that was negative. Nearest in the area-weighted least squares sense among the maps that do
    not is max(0, light - level) with one level per map, a projection on a simplex (Held, Wolfe and Crowder 1974). What it has
    to take from the positive light equals the negative: sum area min(max(0, light), level) = sum area max(0, -light), a concave
    rising function of the level. Newton's method nears its root from below and comes to rest when no more places fall below
    the level, on maps after about five steps. A map without negative light stays as it is; one whose total is not positive
    turns black.

    Args:
      light: linear light in any unit.
      area: of the places, in any unit in which float32 tells the largest from 0.
    """
    # A sum of areas may pass the range; one of relative areas does not.
    relative = area[:, None] / jnp.minimum(jnp.max(area, initial=0), _DIVISIBLE)
    share = relative / _sum_by_halves(relative[None])[0]
    total = lambda values: _sum_by_halves(values * share)  # noqa: E731
    positive = jnp.maximum(light, 0)
    debt = total(positive - light)

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        level, _ = state
        above = positive > level
        paid, payers = total(jnp.where(above, 0, positive)), total(above.astype(light.dtype))
        rise = jnp.where(payers > 0, (debt - paid) / jnp.where(payers > 0, payers, 1), 0)
        return jnp.maximum(level, rise), jnp.any(rise > level)

    level, _ = jax.lax.while_loop(lambda state: state[1], step, (jnp.zeros_like(debt), jnp.array(True)))
    return jnp.where(debt < total(positive), jnp.maximum(positive - level, 0), 0)


def _sum_by_halves(values: Float[Array, "lightings places _"]) -> Float[Array, "lightings 1 _"]:
    """Sum over the places, off by the rounding of as many additions as there are halvings: one by one, equal values drift."""
    while (half := values.shape[1] // 2) > 0:
        folded = values[:, :half] + values[:, half : 2 * half]
        values = folded if values.shape[1] % 2 == 0 else jnp.concatenate([folded, values[:, 2 * half :]], 1)
    return jnp.sum(values, 1, keepdims=True)


def _finite(light: Array) -> Array:
    return jnp.clip(light, -_LARGEST, _LARGEST)


jax.tree_util.register_dataclass(Encoding, data_fields=[], meta_fields=["space", "gamma", "channels"])
