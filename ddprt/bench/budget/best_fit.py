"""The best transfer and the best coefficients on a given basis, and the model's own fit on that basis and other maps."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.fitting.transfer import fit_transfer
from ddprt.methods import make_method
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.report import evaluate
from ddprt.runtime.model import Model
from ddprt.runtime.train import examples

_AT_ONCE = 64  # maps that are turned to float64 at once

Light = Float32[np.ndarray, "lightings texels 3"]
Values = Float32[np.ndarray, "lightings points 3"]


def best_transfer(model: Model, *lightings: tuple[Dataset, Sequence[int]]) -> Model:
    """The model with its basis kept and its transfer fitted anew, by least squares in W/m² on other lightings.

    The model's own fit weighs every lighting alike after scaling; this one weighs them as errors in W/m² do, by s². Then what
    it leaves is orthogonal, summed over its lightings, to all that is linear in the measurements: in the linear space the
    steps of a chain to either side of it have no product but by chance. A ridge is chosen by leaving one out, and is tiny where
    lightings abound.

    Args:
      model: of svd-ridge; how many points it measures may differ from its matrix.
      lightings: datasets of the same points, and which of their lightings to fit on; dark ones train nothing.
    """
    relighter = model.relighter
    assert isinstance(relighter, LinearTransfer)
    rows = [data.values(indices, model.points, model.quantity) for data, indices in lightings]
    groups, values = len(relighter.matrix), jnp.asarray(np.concatenate(rows))
    scale = model.encoding.scale(values)
    seen = np.asarray(model.encoding.encode(values, scale), np.float64)
    inputs = np.moveaxis(seen, 2, 0) if groups == 3 else seen.reshape(1, len(seen), -1)
    parts = zip(rows, lightings, strict=True)
    wanted = np.concatenate([_coefficients(model, data, indices, measured) for measured, (data, indices) in parts])
    size = np.asarray(scale, np.float64)
    centre = bool(np.any(relighter.mean))
    fits = []
    for group in range(groups):
        weight = size[:, group] / max(size[:, group].max(initial=0), np.finfo(float).tiny)
        share = weight**2 / max((weight**2).sum(), np.finfo(float).tiny)
        offset, intercept = (share @ rows if centre else np.zeros(rows.shape[1]) for rows in (inputs[group], wanted[:, group]))
        told, answers = ((part * weight[:, None]) for part in (inputs[group] - offset, wanted[:, group] - intercept))
        fitted = fit_transfer(jnp.asarray(told, jnp.float32), jnp.asarray(answers, jnp.float32))
        fits.append((fitted.matrix, offset, intercept))
    matrix, offset, intercept = (jnp.asarray(np.stack([np.asarray(fit[i]) for fit in fits]), jnp.float32) for i in range(3))
    return replace(model, relighter=replace(relighter, matrix=matrix, offset=offset, intercept=intercept))


def same_fit(model: Model, data: Dataset, config: Config) -> Model:
    """The model's own fit, ridge and all, on other maps of which only what its basis can show is left.

    Maps projected on a basis of n vectors have no more than n of their own, which span the same: so the basis is kept, whatever
    the method's settings, and what changes is the transfer.

    Args:
      model: of svd-ridge.
      data: whose training lightings are fitted on.
      config: that the model was fitted by.
    """
    train, validation = (
        examples(data, split, model.encoding, config.fit, model.points, model.quantity) for split in ("train", "validation")
    )
    indices = data.split("train")
    values = data.values(indices, model.points, model.quantity)
    light = jnp.asarray(projected(model, values, data.maps("indirect", indices), config.fit.weights))
    train = replace(train, indirect=model.encoding.encode(light, train.scale))
    settings = config.methods.settings.get(model.method, {})
    method = make_method(model.method, config.fit.model_dump(exclude={"method", "points"}), settings)
    relighter = method.fit(train, validation, key=jax.random.key(seeds.number(config.seed, f"method {model.method}")))
    return replace(model, relighter=relighter)


def projected(model: Model, values: Values, light: Light, weights: Literal["area", "texel"] = "area") -> Light:
    """Light as the best coefficients on a model's basis give it; see `ddprt.report.evaluate.project`.

    Args:
      model: of svd-ridge.
      values: measured light, W/m².
      light: W/m².
      weights: of the texels.
    """
    vectors, mean = _maps_of(model)
    parts = [slice(first, first + _AT_ONCE) for first in range(0, len(light), _AT_ONCE)]
    found = [
        evaluate.projected(model.encoding, vectors, mean, values[part], light[part], model.area, weights, clamp=False)
        for part in parts
    ]
    return np.concatenate(found)


def _coefficients(
    model: Model, data: Dataset, indices: Sequence[int], values: Values
) -> Float64[np.ndarray, "lightings groups bases"]:
    vectors, mean = _maps_of(model)
    found = []
    for first in range(0, len(indices), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        light = data.maps("indirect", indices[part])
        found.append(evaluate.project(model.encoding, vectors, mean, values[part], light, model.area)[0])
    return np.concatenate(found) if found else np.zeros((0, len(model.relighter.matrix), len(vectors)))  # type: ignore[attr-defined, arg-type]


def _maps_of(model: Model) -> tuple[np.ndarray, np.ndarray]:
    relighter = model.relighter
    assert isinstance(relighter, LinearTransfer)
    return np.asarray(relighter.basis, np.float64), np.asarray(relighter.mean, np.float64)
