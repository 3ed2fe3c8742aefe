"""What every format of textures has to do, and how maps lie in layers.

A map is what one coefficient weighs: a basis, or the mean behind them. In mono channel a map has one channel and several share
a layer; in multi channel a map is an RGB layer of its own. Whatever a file holds is called t here, and a map is
scale * t + bias.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float32


@dataclass(frozen=True, eq=False)
class Maps:
    """All textures of an export, row 0 at the top.

    Attributes:
      values: the bases and, where there is one, the mean: 1 channel for mono, 3 for multi, finite.
      bases: how many of them are bases.
      known: texels that hold something, charts and gutter; the others may come back as anything.
      precision: "half" or "float", for formats that know both.
    """

    values: Float32[np.ndarray, "maps height width channels"]
    bases: int
    known: Bool[np.ndarray, "height width"]
    precision: str = "half"


@dataclass(frozen=True, eq=False)
class Stored:
    """What a format made of them.

    Attributes:
      files: names, in order.
      layers: how many images there are in all of them.
      memory: bytes of the textures in graphics memory, without coarser levels.
      scale, bias: of each map, as above.
      told: further entries for the manifest.
    """

    files: tuple[str, ...]
    layers: int
    memory: int
    scale: Float32[np.ndarray, " maps"]
    bias: Float32[np.ndarray, " maps"]
    told: dict[str, Any]


@dataclass(frozen=True)
class Format:
    """One entry of `FORMATS`.

    Attributes:
      what: one sentence, for the manifest.
      files: patterns of all names that it ever writes.
      per_layer: mono maps in a layer.
      write: the maps into a folder that exists.
      read: t of all maps, from what the folder holds now, float32.
      fits: refuses, by a `UserError`, a height and width that it cannot hold, and to work where a library is missing.
      refit: whether it rounds coarsely enough for the transfer to be fitted anew.
    """

    what: str
    files: tuple[str, ...]
    per_layer: int
    write: Callable[[Maps, Path], Stored]
    read: Callable[[Maps, Path], Float32[np.ndarray, "maps height width channels"]]
    fits: Callable[[int, int], None] = lambda height, width: None
    refit: bool = True


def layered(
    values: Float32[np.ndarray, "maps height width channels"], per_layer: int
) -> Float32[np.ndarray, "layers height width rgba"]:
    """Maps side by side in channels, `per_layer` of them where they have one channel; what is left over is 0."""
    count, height, width, channels = values.shape
    if channels > 1:
        return values
    layers = -(-count // per_layer)
    empty = np.zeros((layers * per_layer - count, height, width), np.float32)
    return np.moveaxis(np.concatenate([values[..., 0], empty]).reshape(layers, per_layer, height, width), 1, 3)


def unlayered(
    layers: Float32[np.ndarray, "layers height width rgba"], maps: Maps
) -> Float32[np.ndarray, "maps height width channels"]:
    """The inverse: `maps` says how many there are, and of how many channels."""
    count, height, width, channels = maps.values.shape
    if channels > 1:
        return np.ascontiguousarray(layers[..., :channels])
    return np.moveaxis(layers, 3, 1).reshape(-1, height, width)[:count, ..., None]


def peaks(maps: Maps) -> tuple[Float32[np.ndarray, " maps"], Float32[np.ndarray, " maps"]]:
    """Scale and bias by which every map has a largest magnitude of 1, and keeps its sign."""
    size = np.abs(maps.values).max((1, 2, 3), initial=0)
    return np.where(size > 0, size, 1).astype(np.float32), np.zeros(len(size), np.float32)


def ranges(
    maps: Maps, low: float, high: float
) -> tuple[Float32[np.ndarray, " maps"], Float32[np.ndarray, " maps"], Float32[np.ndarray, "maps height width channels"]]:
    """Scale and bias by which the known texels of every map go from `low` to `high`, and t; other texels are cut off."""
    if not maps.known.any():
        least = most = np.zeros(len(maps.values))
    else:
        seen = maps.values[:, maps.known].astype(np.float64)
        least, most = seen.min((1, 2)), seen.max((1, 2))
    wide = np.where(most > least, most - least, 1)
    scale = wide / (high - low)
    bias = least - low * scale
    t = (maps.values - bias[:, None, None, None]) / scale[:, None, None, None]
    return scale.astype(np.float32), bias.astype(np.float32), np.clip(t, low, high).astype(np.float32)
