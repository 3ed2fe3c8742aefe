"""From a dataset to a Model."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from threadpoolctl import threadpool_limits

from ddprt import seeds
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.fitting.encoding import Encoding
from ddprt.lights import Lighting
from ddprt.methods import make_method
from ddprt.methods.floors import MeanLightmap
from ddprt.methods.method import Examples, Frame, Relighter, unseen_share
from ddprt.methods.statuses import BLIND
from ddprt.runtime.model import Model
from ddprt.runtime.trust import Yardstick, calibrated, make_yardstick, outside
from ddprt.sections import FitConfig

ROUNDING = 1e-6
"""Relative error that float32 makes by itself: an eps for each of some 16 bases, with random signs and room for more."""

USELESS = 0.99
"""Share of the error of black from which a method counts as no better than it."""


def fit(
    data: Dataset,
    method: str = "svd-ridge",
    *,
    bases: int = 16,
    ridge: float | str | Sequence[float] | np.ndarray = "auto",
    space: str = "linear",
    gamma: float = 2.2,
    centre: str = "none",
    channels: str = "mono",
    weights: str = "area",
    points: int | None = None,
    quantity: str = "radiosity",
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> Model:
    """Learns a model from a dataset's train split.

    Args:
      data: from `ddprt.bake` or `ddprt.open_dataset`.
      method: entry of `METHODS`.
      bases: basis vectors, the mean counted in where there is one.
      ridge: "auto" (leave-one-out), a number in units of scaled measured², or one number per measurement.
      space: "linear" or "gamma", with exponent `gamma`.
      centre: "none" keeps relighting linear, "mean" is the paper's.
      channels: "mono" or "multi".
      weights: "area" or "texel".
      points: measurement points to use; None takes as many as were baked.
      quantity: "radiosity" or "irradiance" at the points.
      settings: the method's own.
      seed: of learned methods.
    Raises:
      UserError: unknown names, values out of range, or more points than the dataset has.
    """
    from ddprt.config import load_config

    shared = {"method": method, "bases": bases, "ridge": ridge, "space": space, "gamma": gamma}
    shared |= {"centre": centre, "channels": channels, "weights": weights}
    overrides = {f"fit.{key}": _text(value) for key, value in shared.items()}
    overrides |= {"points.quantity": _text(quantity), "seed": _text(seed)}
    if points is not None:
        overrides["points.count"] = _text(points)
    config = load_config(None, overrides)
    count = None if points is None else config.points.count
    return fit_method(data, config.fit, method, settings or {}, points=count, quantity=config.points.quantity, seed=config.seed)


@threadpool_limits.wrap(limits=1, user_api="blas")  # the last bits of LAPACK's factors depend on how many threads it has
def fit_method(
    data: Dataset,
    config: FitConfig,
    name: str,
    settings: Mapping[str, Any],
    *,
    points: int | None,
    quantity: str,
    seed: int,
) -> Model:
    """The same from a [fit] section; `name` overrides its method."""
    method = make_method(name, config.model_dump(exclude={"method", "points"}), settings)
    points = data.description["points"]["count"] if points is None else points
    if points > len(data.samples.position):
        raise UserError(f"points: got {points}, but the dataset has {len(data.samples.position)} samples; bake with more")
    if not data.area.sum() > 0:
        raise UserError("area: got texels of 0 m² alone, expected some surface to light; check the atlas and bake again")
    encoding = Encoding(config.space, config.gamma, config.channels)
    train, validation = (examples(data, split, encoding, config, points, quantity) for split in ("train", "validation"))
    relighter = method.fit(train, validation, key=jax.random.key(seeds.number(seed, f"method {name}")))
    relighter, yardstick = _judged(relighter, encoding, train, validation)
    return Model(
        name,
        relighter,
        encoding,
        data.samples,
        points,
        quantity,
        data.covered,
        data.area,
        data.occluders,
        {key: data.description["scene"][key] for key in ("name", "digest")},
        data.uv,
        yardstick,
    )


def _judged(relighter: Relighter, encoding: Encoding, train: Examples, validation: Examples) -> tuple[Relighter, Yardstick]:
    """The laws that a method beats mean lightmap and black on its validation set and was trained on its kind, or says not."""
    mean = MeanLightmap().fit(train, validation, key=jax.random.key(0))
    frame = validation.frame
    area = jnp.asarray(validation.area / validation.area.sum(dtype=np.float64), jnp.float32)
    data = frame.values, frame.positions, frame.normals, validation.indirect, validation.scale, area
    lightings = None if frame.lightings is None else tuple(frame.lightings)
    ours, floor, whole = (np.asarray(_squares(one, encoding, *data, lightings), np.float64) for one in (relighter, mean, None))
    yardstick = make_yardstick(train, encoding)
    novelty = yardstick.novelty(frame.values, validation.scale)
    lit = whole > 0
    of_ours, of_mean = (np.sqrt(np.divide(part, whole, out=np.full_like(whole, np.nan), where=lit)) for part in (ours, floor))
    yardstick = calibrated(yardstick, novelty, of_ours, of_mean)
    report = relighter.report
    if not ours.sum() <= min(floor.sum() + ROUNDING**2 * whole.sum(), USELESS**2 * whole.sum()):
        report = report.noting("worse_than_mean")
    if outside(yardstick, novelty[np.asarray(validation.scale).max(1) > 0]):
        report = report.noting("extrapolating")
    if validation.unseen > BLIND:
        report = report.noting("blind")
    return replace(relighter, report=report), yardstick  # type: ignore[type-var]


@partial(jax.jit, static_argnames="lightings")
def _squares(
    relighter: Relighter | None,
    encoding: Encoding,
    values: Array,
    positions: Array,
    normals: Array,
    indirect: Array,
    scale: Array,
    area: Array,
    lightings: tuple[Lighting, ...] | None,
) -> Array:
    """Area-weighted squared error of each lighting (None answers with black), in units of the peak to keep in range."""
    relative = scale / jnp.maximum(jnp.max(scale), jnp.finfo(jnp.float32).tiny)
    truth = encoding.decode(indirect, relative)
    peak = jnp.max(jnp.abs(truth), initial=0)
    answer = (
        0.0 if relighter is None else encoding.decode(relighter.predict(Frame(values, positions, normals, lightings)), relative)
    )
    return jnp.einsum("ltc,t->l", ((answer - truth) / jnp.where(peak > 0, peak, 1)) ** 2, area)


def examples(data: Dataset, split: str, encoding: Encoding, config: FitConfig, points: int, quantity: str) -> Examples:
    """Scaled and encoded pairs of a split: here arrays pass from NumPy to JAX."""
    indices = data.split(split)
    light = data.maps("indirect", indices)
    values, scale, indirect = _encoded(encoding, data.values(indices, points, quantity), light)
    frame = Frame(
        values,
        jnp.asarray(data.samples.position[:points], jnp.float32),
        jnp.asarray(data.samples.normal[:points], jnp.float32),
        [data.lightings[index] for index in indices],
    )
    unseen = unseen_share(np.asarray(scale), light)
    return Examples(frame, indirect, scale, np.asarray(data.area, np.float32), config.weights, config.channels, unseen)


@jax.jit
def _encoded(encoding: Encoding, values: Array, indirect: Array) -> tuple[Array, Array, Array]:
    scale = encoding.scale(values)
    return encoding.encode(values, scale), scale, encoding.encode(indirect, scale)


def fit_config(data: Dataset, config: Config, name: str) -> Model:
    """Fits one entry of the comparison as a configuration says."""
    return fit_method(
        data,
        config.fit,
        name,
        config.methods.settings.get(name, {}),
        points=config.fit.points or None,
        quantity=config.points.quantity,
        seed=config.seed,
    )


def _text(value: Any) -> str:
    plain = value.tolist() if isinstance(value, np.ndarray | np.generic | Array) else value
    if isinstance(plain, list | tuple):
        return f"[{', '.join(map(_text, plain))}]"
    return plain if isinstance(plain, str) else repr(plain)
