"""RGBA half floats one after another, as WebGL uploads them: no header, layer after layer."""

from pathlib import Path

import numpy as np

from ddprt.export.formats.format import Format, Maps, Stored, layered, peaks, unlayered
from ddprt.files import written_whole

NAME = "basis.rgba16f"
LAYER = 4


def halves(maps: Maps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale, bias and (layers, height, width, 4) little-endian half floats of magnitudes up to 1; alpha is 1 in RGB layers."""
    scale, bias = peaks(maps)
    layers = layered(maps.values / scale[:, None, None, None], LAYER)
    opaque = np.ones((*layers.shape[:3], LAYER - layers.shape[3]), np.float32)
    return scale, bias, np.concatenate([layers, opaque], 3).astype("<f2")


def _write(maps: Maps, folder: Path) -> Stored:
    scale, bias, layers = halves(maps)
    with written_whole(folder / NAME) as temporary:
        temporary.write_bytes(layers.tobytes())
    told = {
        "texel": "RGBA16F, four little-endian half floats; rows from the top, no padding",
        "offsets": [index * layers[0].nbytes for index in range(len(layers))],
        "layer_bytes": layers[0].nbytes,
    }
    return Stored((NAME,), len(layers), layers.nbytes, scale, bias, told)


def _read(maps: Maps, folder: Path) -> np.ndarray:
    height, width = maps.known.shape
    layers = np.frombuffer((folder / NAME).read_bytes(), "<f2").reshape(-1, height, width, LAYER)
    return unlayered(layers.astype(np.float32), maps)


RAW = Format("raw half floats, for WebGL", (NAME,), LAYER, _write, _read)
