"""Textures in the formats that were asked for, each with the transfer that fits it, and what the manifest says of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.export.formats.format import Format, Maps
from ddprt.export.formats.listing import FORMATS
from ddprt.export.refit import Stock, transfer_for
from ddprt.files import read_tensors, write_tensors
from ddprt.fitting.basis import entry_weights
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.runtime.precision import composed

DECODE = [
    "z as under decode; u = matrix (z - offset) + intercept, with the tensors of `transfer`",
    "map k is channel k % per_layer of layer k // per_layer; in multi channel it is layer k in RGB",
    "y = sum over maps k of u[k] * t[k], plus the last u, which weighs a texture of ones; the mean is among the maps",
    "on from y as under decode; t is what the texture holds (bytes over 255); scale * t + bias is the map, which u allows for",
]


def remove_stale(folder: Path, kept: Sequence[Path]) -> None:
    """Removes what earlier exports left of textures and their transfers."""
    patterns = {pattern for entry in FORMATS.values() for pattern in entry.files} | {transfer_name("*")}
    for pattern in patterns:
        for path in folder.glob(pattern):
            if path not in kept:
                path.unlink()


def transfer_name(name: str) -> str:
    """Of the tensors that go with a format; "exr" has those that all exports have."""
    return "transfer.safetensors" if name == "exr" else f"transfer-{name}.safetensors"


def write_format(model: Model, maps: Maps, name: str, folder: Path, *, refit: bool) -> tuple[list[Path], dict[str, Any]]:
    """Writes one format and its transfer; not "exr", whose transfer belongs to every export.

    Args:
      model: of method svd-ridge.
      maps: its textures.
      name: entry of `FORMATS`.
      folder: which exists.
      refit: fit the coefficients to the textures as they are stored.
    Returns:
      Files, and the entry for the manifest.
    Raises:
      UserError: the folder cannot be written.
      ValueError: a texture is not finite.
    """
    entry = FORMATS[name]
    stored = entry.write(maps, folder)
    transfer = transfer_for(_linear(model), _stock(model, maps, entry, folder, stored.scale, stored.bias), refit=refit)
    write_tensors(folder / transfer_name(name), {key: getattr(transfer, key) for key in ("matrix", "offset", "intercept")})
    written = [folder / file for file in (*stored.files, transfer_name(name))]
    return written, {
        "what": entry.what,
        "files": list(stored.files),
        "transfer": transfer_name(name),
        "layers": stored.layers,
        "per_layer": entry.per_layer if maps.values.shape[3] == 1 else 1,
        "maps": len(maps.values),
        "mean": len(maps.values) > maps.bases,
        **stored.told,
        "scale": stored.scale.tolist(),
        "bias": stored.bias.tolist(),
        "bytes": sum(path.stat().st_size for path in written),
        "memory_bytes": stored.memory,
        "refit": refit,
        "rounding": {"kept": transfer.kept, "refitted": transfer.refitted, "rank": transfer.rank},
    }


def as_seen(model: Model, maps: Maps, name: str, folder: Path, told: dict[str, Any]) -> Model:
    """The model as an engine has it that reads this folder.

    Args:
      model, maps, name, folder: as for `write_format`.
      told: what that gave for the manifest.
    """
    scale, bias = (np.array(told[key], np.float32) for key in ("scale", "bias"))
    t = _stock(model, maps, FORMATS[name], folder, scale, bias).stored
    return composed(model, np.concatenate([t, np.ones_like(t[:1])]), **read_tensors(folder / told["transfer"]))


def over_texels(model: Model, images: np.ndarray) -> np.ndarray:
    """(maps, height, width, channels) as entries of covered texels, (maps, entries) float32."""
    return np.ascontiguousarray(images[:, model.covered].reshape(len(images), -1), np.float32)


def weights_of(model: Model) -> np.ndarray:
    """Of the entries, by area, summing to 1."""
    return np.asarray(entry_weights(model.area, "area", model.encoding.channels), np.float64)


def _stock(model: Model, maps: Maps, entry: Format, folder: Path, scale: np.ndarray, bias: np.ndarray) -> Stock:
    exact, t = over_texels(model, maps.values), over_texels(model, entry.read(maps, folder))
    return Stock(exact, t, scale, bias, weights_of(model))


def _linear(model: Model) -> LinearTransfer:
    assert isinstance(model.relighter, LinearTransfer)  # whoever calls has refused other methods
    return model.relighter
