"""What the best transfer and the best coefficients on a given basis would make of held-out lightings."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.dataset.store import Dataset
from ddprt.fitting.basis import entry_weights
from ddprt.fitting.transfer import fit_transfer
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model

_COLUMNS = 64  # lightings that are turned to float64 at once


def best_transfer(model: Model, data: Dataset, indices: Sequence[int]) -> Model:
    """The model with its basis kept and its transfer fitted anew, by least squares in W/m² on other lightings.

    The model's own fit weighs every lighting alike after scaling; this one weighs them as errors in W/m² do, by s². Then what
    it leaves is orthogonal, over the lightings' distribution, to all that is linear in the measurements: in the linear space
    the steps of a chain to either side of it have no product but by chance. A ridge is chosen by leaving one out, and is tiny
    where lightings abound.

    Args:
      model: of svd-ridge; how many points it measures may differ from its matrix.
      data: whose lightings.
      indices: lightings to fit on; dark ones train nothing.
    """
    relighter = model.relighter
    assert isinstance(relighter, LinearTransfer)
    groups, values = len(relighter.matrix), jnp.asarray(data.values(indices, model.points, model.quantity))
    scale = model.encoding.scale(values)
    seen = np.asarray(model.encoding.encode(values, scale), np.float64)
    inputs = np.moveaxis(seen, 2, 0) if groups == 3 else seen.reshape(1, len(seen), -1)
    wanted = _coefficients(model, data, indices, np.asarray(scale))
    size = np.asarray(scale, np.float64)
    centre = bool(np.any(relighter.mean))
    parts = []
    for group in range(groups):
        weight = size[:, group] / max(size[:, group].max(initial=0), np.finfo(float).tiny)
        share = weight**2 / max((weight**2).sum(), np.finfo(float).tiny)
        offset, intercept = (share @ rows if centre else np.zeros(rows.shape[1]) for rows in (inputs[group], wanted[:, group]))
        rows, answers = ((rows * weight[:, None]) for rows in (inputs[group] - offset, wanted[:, group] - intercept))
        fitted = fit_transfer(jnp.asarray(rows, jnp.float32), jnp.asarray(answers, jnp.float32))
        parts.append((fitted.matrix, offset, intercept))
    matrix, offset, intercept = (jnp.asarray(np.stack([np.asarray(p[i]) for p in parts]), jnp.float32) for i in range(3))
    return replace(model, relighter=replace(relighter, matrix=matrix, offset=offset, intercept=intercept))


def projected(
    model: Model, values: Float32[np.ndarray, "lightings points 3"], light: Float32[np.ndarray, "lightings texels 3"]
) -> Float32[np.ndarray, "lightings texels 3"]:
    """Light as the best coefficients on a model's basis give it: scaled, encoded, projected under area weights and decoded.

    Args:
      model: of svd-ridge.
      values: measured light, which sets the scale; lightings that no point sees are projected all the same, as they are.
      light: W/m².
    """
    relighter = model.relighter
    assert isinstance(relighter, LinearTransfer)
    rows = []
    for first in range(0, len(light), _COLUMNS):
        part = slice(first, first + _COLUMNS)
        scale = _own_scale(np.asarray(model.encoding.scale(jnp.asarray(values[part]))))
        columns = _encoded(model, light[part], scale)
        mean = np.asarray(relighter.mean, np.float64)
        found = _project(model, columns - mean) @ np.asarray(relighter.basis, np.float64) + mean
        back = np.moveaxis(found, 1, 2) if len(relighter.matrix) == 3 else found.reshape(light[part].shape)
        rows.append(np.asarray(model.encoding.decode(jnp.asarray(back, jnp.float32), jnp.asarray(scale), clamp=False)))
    return np.concatenate(rows)


def _coefficients(
    model: Model, data: Dataset, indices: Sequence[int], scale: Float32[np.ndarray, "lightings 3"]
) -> Float64[np.ndarray, "lightings groups bases"]:
    """Of the encoded light on the model's basis; dark lightings have none."""
    found = []
    for first in range(0, len(indices), _COLUMNS):
        part = slice(first, first + _COLUMNS)
        columns = _encoded(model, data.maps("indirect", indices[part]), _own_scale(scale[part]))
        found.append(_project(model, columns - np.asarray(model.relighter.mean, np.float64)))  # type: ignore[attr-defined]
    return np.concatenate(found)


def _own_scale(scale: Float32[np.ndarray, "lightings 3"]) -> Float32[np.ndarray, "lightings 3"]:
    """Scales by which what no point sees can be divided, too."""
    return np.where(scale > 0, scale, 1).astype(np.float32)


def _encoded(model: Model, light: np.ndarray, scale: np.ndarray) -> Float64[np.ndarray, "lightings groups entries"]:
    encoded = np.asarray(model.encoding.encode(jnp.asarray(light), jnp.asarray(scale)), np.float64)
    mono = len(model.relighter.matrix) == 3  # type: ignore[attr-defined]
    return np.moveaxis(encoded, 2, 1) if mono else encoded.reshape(len(encoded), 1, -1)


def _project(model: Model, columns: np.ndarray) -> Float64[np.ndarray, "lightings groups bases"]:
    """Least squares under area weights, whatever weights the basis was made for."""
    vectors = np.asarray(model.relighter.basis, np.float64)  # type: ignore[attr-defined]
    weighted = vectors * entry_weights(model.area, "area", model.encoding.channels)
    return (columns @ weighted.T) @ np.linalg.inv(weighted @ vectors.T).T
