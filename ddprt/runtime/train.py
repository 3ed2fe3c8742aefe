"""From a dataset to a Model."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from threadpoolctl import threadpool_limits

from ddprt import seeds
from ddprt.catalogue import Catalogue
from ddprt.config import Config
from ddprt.dataset.layers import Layer, LayerData, layers
from ddprt.dataset.pack import Pack
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.fitting.encoding import Encoding
from ddprt.methods import make_method
from ddprt.methods.floors import MeanLightmap, MeanMap
from ddprt.methods.method import AsksForLights, Examples, FitReport, Frame, Maps, Method, Relighter, block_texels, unseen_share
from ddprt.methods.packages import blamed
from ddprt.methods.statuses import BLIND
from ddprt.runtime.model import LayerModel, Model
from ddprt.runtime.programs import make_room
from ddprt.runtime.streamed import StreamedMaps, encoded
from ddprt.runtime.trust import Yardstick, calibrated, make_yardstick, outside
from ddprt.sections import FitConfig

ROUNDING = 1e-6
"""Relative error that float32 makes by itself: an eps for each of some 16 bases, with random signs and room for more."""

_WORTH_PACKING = 2**22  # bytes of half floats: below, reading the maps one by one takes a fifth of a second or less
_SHARE = 0.25  # of the free memory: an in-memory fit holds the light three times over, and others want some too

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
    stream: bool | None = None,
) -> Model:
    """The same from a [fit] section; `name` overrides its method.

    Light that takes more than a quarter of the free memory is read a part at a time by methods that can (`Method.streams`);
    `stream` says so or not whatever the sizes. The model is the same but for rounding.
    """
    make_room()
    method = make_method(name, config.model_dump(exclude={"method", "points"}), settings)
    points = data.description["points"]["count"] if points is None else points
    if points > len(data.samples.position):
        raise UserError(f"points: got {points}, but the dataset has {len(data.samples.position)} samples; bake with more")
    if not data.area.sum() > 0:
        raise UserError("area: got texels of 0 m² alone, expected some surface to light; check the atlas and bake again")
    encoding = Encoding(getattr(method, "space", config.space), config.gamma, config.channels)
    pack = _streamed(data, method, name, stream)
    train, validation = (examples(data, split, encoding, config, points, quantity, pack) for split in ("train", "validation"))
    with blamed(name):
        relighter = method.fit(train, validation, key=jax.random.key(seeds.number(seed, f"method {name}")))
        relighter, yardstick = judged(relighter, encoding, train, validation)

    def of_layer(layer: Layer) -> LayerModel:
        part = LayerData.of(data, layer)
        return LayerModel(layer, fit_method(part, config, name, settings, points=points, quantity=quantity, seed=seed))

    of_layers = {} if isinstance(data, LayerData) else {layer.name: of_layer(layer) for layer in layers(data)}
    relighter = _with_trouble_of(relighter, {key: layer.model.relighter.report for key, layer in of_layers.items()})
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
        {key: data.description["scene"][key] for key in ("name", "digest")} | _unmeasured(data),
        data.uv,
        yardstick,
        Catalogue("layer", of_layers),
        None if isinstance(data, LayerData) else data.holes,
        data.constant,
        None if isinstance(data, LayerData) else data.exitant,
        None if isinstance(data, LayerData) else data.gbuffer["albedo"],
        None if isinstance(data, LayerData) else data.fog,
        None if isinstance(data, LayerData) else data.viewpoint,
    )


def _unmeasured(data: Dataset) -> dict[str, str]:
    """Why a model of imported light cannot measure lamps by itself, where it cannot."""
    why = "" if isinstance(data, LayerData) else data.imported.get("unmeasured", "")
    return {"unmeasured": why} if why else {}


def _with_trouble_of(relighter: Relighter, of_layers: Mapping[str, FitReport]) -> Relighter:
    """What went wrong in training for a layer is told by the model, which is looked at."""
    troubles = {f"layer {name}": report.trouble for name, report in of_layers.items() if "diverged" in report.remarks}
    if not troubles:
        return relighter
    own = relighter.report
    told = "; ".join([*filter(None, [own.trouble]), *(f"{name}: {trouble}" for name, trouble in troubles.items())])
    return replace(relighter, report=replace(own, trouble=told).noting("diverged"))  # type: ignore[type-var]


def judged(relighter: Relighter, encoding: Encoding, train: Examples, validation: Examples) -> tuple[Relighter, Yardstick]:
    """The laws that a method beats mean lightmap and black on its validation set and was trained on its kind, or says not.

    Raises:
      FloatingPointError: its answers are no numbers, which no method may do.
    """
    mean = _mean_lightmap(train, validation)
    ours, floor, whole = (_squares(one, encoding, validation) for one in (relighter, mean, None))
    if np.isnan(ours).any():
        raise FloatingPointError(f"answers of NaN for {np.isnan(ours).sum()} of {len(ours)} validation lightings")
    yardstick = make_yardstick(train, encoding)
    novelty = yardstick.novelty(validation.frame.values, validation.scale)
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


def _mean_lightmap(train: Examples, validation: Examples) -> MeanMap:
    fitted = lambda part: MeanLightmap().fit(part, validation, key=jax.random.key(0))  # noqa: E731
    if not isinstance(train.indirect, Maps):
        return fitted(train)
    means: list[Array] = []
    start = 0
    for block in train.indirect.blocks():
        stop = start + block.shape[1]
        means.append(jax.block_until_ready(fitted(replace(train, indirect=block, area=train.area[start:stop])).mean))
        start = stop
    return MeanMap(jnp.concatenate(means))


def _squares(relighter: Relighter | None, encoding: Encoding, examples: Examples) -> np.ndarray:
    """Area-weighted squared error of each lighting (None answers with black), in units of the peak to keep in range."""
    light, frame = examples.indirect, examples.frame
    area = jnp.asarray(examples.area / examples.area.sum(dtype=np.float64), jnp.float32)
    if isinstance(light, Maps):
        step = max(1, block_texels(1) // max(light.shape[1], 1))
        parts = [slice(start, start + step) for start in range(0, light.shape[0], step)]
    else:
        parts = [slice(None)]
    told = relighter.describe(frame.lightings or ()) if isinstance(relighter, AsksForLights) else None
    described = None if told is None else jnp.asarray(told, jnp.float32)
    squares, peaks = [], []
    for part in parts:
        truth = light.some(part) if isinstance(light, Maps) else light
        values, scale, lamps = (
            whole if truth is light or whole is None else whole[part] for whole in (frame.values, examples.scale, described)
        )
        largest = jnp.max(examples.scale, initial=0)
        seen = values, frame.positions, frame.normals
        found = _squares_of(relighter, encoding, *seen, truth, scale, largest, area, lamps, not examples.signed)
        squares.append(np.asarray(found[0], np.float64))
        peaks.append(float(found[1]))
    unit = max((peak for peak in peaks if peak > 0), default=1.0)
    return np.concatenate([part * ((peak or 1.0) / unit) ** 2 for part, peak in zip(squares, peaks, strict=True)])


@partial(jax.jit, static_argnames="clamp")
def _squares_of(
    relighter: Relighter | None,
    encoding: Encoding,
    values: Array,
    positions: Array,
    normals: Array,
    indirect: Array,
    scale: Array,
    largest: Array,
    area: Array,
    described: Array | None,
    clamp: bool,
) -> tuple[Array, Array]:
    """The squares of some lightings in units of the peak of their own, and that peak."""
    relative = scale / jnp.maximum(largest, jnp.finfo(jnp.float32).tiny)
    truth = encoding.decode(indirect, relative, clamp=clamp)
    peak = jnp.max(jnp.abs(truth), initial=0)
    frame = Frame(values, positions, normals, described=None if described is None else encoding.encode(described, scale))
    answer = 0.0 if relighter is None else encoding.decode(relighter.predict(frame), relative, clamp=clamp)
    return jnp.einsum("ltc,t->l", ((answer - truth) / jnp.where(peak > 0, peak, 1)) ** 2, area), peak


def examples(
    data: Dataset, split: str, encoding: Encoding, config: FitConfig, points: int, quantity: str, pack: Pack | None = None
) -> Examples:
    """Scaled and encoded pairs of a split: here arrays pass from NumPy to JAX.

    Args:
      data: the dataset.
      split: "train" or "validation".
      encoding: of values and light.
      config: weights and channels.
      points: how many.
      quantity: "radiosity" or "irradiance" at the points.
      pack: leaves the indirect light in it, to be read a part at a time.
    """
    indices = data.split(split)
    values, scale = _measured(encoding, data.values(indices, points, quantity))
    frame = Frame(
        values,
        jnp.asarray(data.samples.position[:points], jnp.float32),
        jnp.asarray(data.samples.normal[:points], jnp.float32),
        [data.lightings[index] for index in indices],
    )
    if pack is None:
        light = data.maps("indirect", indices)
        indirect: Array | Maps = encoded(encoding, light, scale)
        unseen = unseen_share(np.asarray(scale), light)
    else:
        indirect = StreamedMaps(pack, tuple(indices), encoding, scale)
        dark = bool((np.asarray(scale) == 0).any())  # else there is no need to look
        unseen = unseen_share(np.asarray(scale), (pack.read([index])[0] for index in indices)) if dark else 0.0
    area, signed = np.asarray(data.area, np.float32), isinstance(data, LayerData)
    return Examples(frame, indirect, scale, area, config.weights, config.channels, unseen, signed)


@jax.jit
def _measured(encoding: Encoding, values: Array) -> tuple[Array, Array]:
    scale = encoding.scale(values)
    return encoding.encode(values, scale), scale


def _streamed(data: Dataset, method: Method, name: str, asked: bool | None) -> Pack | None:
    """The pack to read a part at a time, None for what is to be held in memory; large maps are packed either way.

    Raises:
      UserError: the light cannot fit in memory, and must.
    """
    lightings = len(data.split("train")) + len(data.split("validation"))
    size, free = 12 * len(data.area) * lightings, _free_memory()
    wanted = asked or (asked is None and method.streams and free is not None and size > _SHARE * free)
    pack = data.packed() if wanted or size // 2 > _WORTH_PACKING else None
    if wanted:
        if method.streams and pack is not None:
            return pack
        if asked:
            why = "its folder cannot be written to" if method.streams else "the method holds all light in memory"
            raise UserError(f"stream: got true for {name}, but {why}; leave it out")
    if free is not None and 2 * size > free:
        raise UserError(
            f"{name}: got {size / 2**30:.3g} GiB of light that it holds twice, but {free / 2**30:.3g} GiB of memory are free; "
            "use svd-ridge and a folder that can be written to, fewer lightings, or a machine with more memory"
        )
    return None


def _free_memory() -> int | None:
    """Bytes that this process can still have, swap not counted; None where the system does not tell (it is Linux that does)."""
    try:
        lines = Path("/proc/meminfo").read_text("utf-8").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
    try:
        group = Path("/sys/fs/cgroup")
        limit, used = ((group / name).read_text("utf-8").strip() for name in ("memory.max", "memory.current"))
        return free if limit == "max" else min(free, max(0, int(limit) - int(used)))
    except (OSError, ValueError):
        return free


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
