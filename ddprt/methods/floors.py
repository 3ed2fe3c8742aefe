"""Floors: what can be had without learning anything about transport."""

from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ddprt.methods.method import Examples, FitReport, Frame, Method, array_bytes, as_pytree, found_in, in_memory


@as_pytree
@dataclass(frozen=True)
class MeanMap:
    """One lightmap, as bright as the measurements are."""

    mean: Float[Array, "texels 3"]
    report: FitReport = field(default=FitReport(), compare=False)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        return jnp.broadcast_to(self.mean, (len(frame.values), *self.mean.shape))

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`."""
        return int(self.mean.size)


class MeanLightmap(Method):
    """The single lightmap that is best on the training lightings, in W/m²: mean of s I / mean of s²."""

    relighter: ClassVar[type] = MeanMap
    why: ClassVar[str] = "floor: ignores where the light is"

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> MeanMap:
        """See `Method`."""
        mean = _weighted_mean(train.scale, train.indirect)
        return MeanMap(mean, FitReport().noting(*found_in(train)))


@jax.jit
def _weighted_mean(scale: Array, indirect: Array) -> Array:
    weight = (scale / jnp.maximum(jnp.max(scale, 0), jnp.finfo(jnp.float32).tiny)) ** 2
    total = jnp.sum(weight, 0)
    return jnp.einsum("lc,ltc->tc", weight / jnp.where(total > 0, total, 1), indirect, precision="highest")


@as_pytree
@dataclass(frozen=True)
class NearestMaps:
    """All training lightmaps, looked up by their measurements."""

    values: Float[Array, "lightings points 3"]
    maps: Float[Array, "lightings texels 3"]
    report: FitReport = field(default=FitReport(), compare=False)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`: per channel, the training lighting whose measurements point most nearly the same way."""
        likeness = jnp.einsum("lpc,fpc->flc", self.values, frame.values, precision="highest")
        size = jnp.sqrt(jnp.sum(self.values**2, 1))
        likeness = jnp.where(size > 0, likeness / jnp.where(size > 0, size, 1), -jnp.inf)
        best = jnp.argmax(likeness, 1)
        return jnp.stack([self.maps[best[:, c], :, c] for c in range(3)], -1)

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`."""
        return 2 * int(self.values.size)


class NearestLighting(Method):
    """The training lighting that looks most alike at the points."""

    relighter: ClassVar[type] = NearestMaps
    why: ClassVar[str] = "floor: a look-up, no transport"

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> NearestMaps:
        """See `Method`."""
        return NearestMaps(train.frame.values, in_memory(train.indirect), FitReport().noting(*found_in(train)))
