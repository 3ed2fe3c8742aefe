"""What is left of a model once it is stored in few bits, and how many bytes that takes."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ddprt.catalogue import Catalogue
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model

Rounding = Callable[[Float[np.ndarray, "*n"]], Float[np.ndarray, "*n"]]


def _half(values: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return values.astype(np.float16).astype(np.float32)


def _byte(values: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Signed normalised integers, as textures of 8 bits a channel hold them."""
    return (np.rint(127 * np.clip(values, -1, 1)) / 127).astype(np.float32)


PRECISIONS: Catalogue[tuple[int, Rounding]] = Catalogue(
    "precision", {"float": (4, lambda values: values.astype(np.float32)), "half": (2, _half), "byte": (1, _byte)}
)
"""Bytes of a number, and the rounding of numbers between -1 and 1."""


def stored(model: Model, precision: str) -> Model:
    """The model as it comes back from its stored form.

    Of every method the maps are stored so, that is, arrays one of whose axes has the texels of the atlas, or their colours side
    by side; each map is scaled to a largest magnitude of 1 (svd-ridge's mean in halves as it is, as `ddprt.export.textures`
    writes it). Matrices, weights and scales stay float32: they are small, and a shader holds them in no texture.

    Args:
      model: as it was fitted.
      precision: entry of `PRECISIONS`; "float" changes nothing.
    Raises:
      UserError: no such precision.
    """
    _, rounding = PRECISIONS[precision]
    if precision == "float":
        return model
    relighter = model.relighter
    if isinstance(relighter, LinearTransfer):
        mean = np.asarray(relighter.mean, np.float32)
        kept = _half(mean) if precision == "half" else _by_rows(mean[None], rounding)[0]
        basis = _by_rows(np.asarray(relighter.basis, np.float32), rounding)
        return replace(model, relighter=replace(relighter, basis=jnp.asarray(basis), mean=jnp.asarray(kept)))
    texels = len(model.area)
    rounded = jax.tree.map(lambda leaf: jnp.asarray(_leaf(np.asarray(leaf), texels, rounding)), relighter)
    return replace(model, relighter=replace(rounded, report=relighter.report))


def composed(
    model: Model,
    basis: Float[np.ndarray, "rows entries"],
    *,
    matrix: Float[np.ndarray, "groups rows inputs"],
    offset: Float[np.ndarray, "groups inputs"],
    intercept: Float[np.ndarray, "groups rows"],
) -> Model:
    """The model with other textures and the transfer that goes with them; a mean is one of the textures.

    Args:
      model: of method svd-ridge.
      basis: over covered texels, colours of a texel side by side for multi channel.
      matrix, offset, intercept: as in `LinearTransfer`.
    """
    relighter = model.relighter
    assert isinstance(relighter, LinearTransfer)
    m, o, i, u = (jnp.asarray(part, jnp.float32) for part in (matrix, offset, intercept, basis))
    changed = replace(relighter, matrix=m, offset=o, intercept=i, basis=u, mean=jnp.zeros(basis.shape[1], jnp.float32))
    return replace(model, relighter=changed)


def shipped_bytes(model: Model, precision: str) -> int:
    """Bytes of the arrays that an engine needs to relight: maps over covered texels and matrices, in that precision.

    Scales of the maps are counted, points are not; padding of textures (texels that nothing covers, channels that fill up a
    layer) is not either, so that "float" gives `Relighter.nbytes` and a scale for each map.

    Raises:
      UserError: no such precision.
    """
    size, _ = PRECISIONS[precision]
    relighter = model.relighter
    if isinstance(relighter, LinearTransfer):
        has_mean = bool(np.any(relighter.mean))
        maps = relighter.basis.size + (relighter.mean.size if has_mean else 0)
        rest = relighter.matrix.size + relighter.offset.size + relighter.intercept.size
        return int(size * maps + 4 * (rest + len(relighter.basis)))
    leaves = [(leaf, axis) for leaf in jax.tree.leaves(relighter) if (axis := _along(leaf, len(model.area))) is not None]
    scales = 0 if precision == "float" else sum(len(_maps(np.asarray(leaf), axis)) for leaf, axis in leaves)
    return int(relighter.nbytes - sum((leaf.dtype.itemsize - size) * leaf.size for leaf, _ in leaves) + 4 * scales)


def _along(leaf: Any, texels: int) -> int | None:
    """The axis that runs over texels, or over their colours; None for what is no map."""
    if not jnp.issubdtype(leaf.dtype, jnp.floating) or leaf.size == 0:
        return None
    return next((axis for axis in reversed(range(leaf.ndim)) if leaf.shape[axis] in (texels, 3 * texels)), None)


def _leaf(leaf: np.ndarray, texels: int, rounding: Rounding) -> np.ndarray:
    axis = _along(leaf, texels)
    if axis is None:
        return leaf
    rounded = _by_rows(_maps(leaf, axis), rounding)
    if _coloured(leaf, axis):
        return rounded.reshape(leaf.shape)
    last = np.moveaxis(leaf, axis, -1)
    return np.moveaxis(rounded.reshape(last.shape), -1, axis)


def _maps(leaf: np.ndarray, axis: int) -> Float[np.ndarray, "maps entries"]:
    """Maps as rows, each with its colours: a texture's scale is that of all of them."""
    if _coloured(leaf, axis):
        return leaf.reshape(-1, 3 * leaf.shape[axis])
    return np.moveaxis(leaf, axis, -1).reshape(-1, leaf.shape[axis])


def _coloured(leaf: np.ndarray, axis: int) -> bool:
    return axis == leaf.ndim - 2 and leaf.shape[-1] == 3


def _by_rows(rows: Float[np.ndarray, "rows entries"], rounding: Rounding) -> Float[np.ndarray, "rows entries"]:
    """Rounded in units of the largest magnitude of each row; rows of zeros stay."""
    largest = np.abs(rows).max(1, initial=0, keepdims=True)
    scale = np.where(largest > 0, largest, 1)
    return rounding(rows / scale) * scale
