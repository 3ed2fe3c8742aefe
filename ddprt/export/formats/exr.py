"""EXR: one image per layer, as `basis_00.exr` and so on with the mean apart, or all layers in the grid of one image."""

from pathlib import Path

import numpy as np

from ddprt.export.formats.format import Format, Maps, Stored, layered, peaks, unlayered
from ddprt.scene.exr import read_exr, write_exr

MEAN = "mean.exr"
GRID = "basis-grid.exr"
LAYER = 4  # maps of one channel in an RGBA layer


def _scaled(maps: Maps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scale, bias = peaks(maps)
    return scale, bias, maps.values / scale[:, None, None, None]


def _memory(layers: np.ndarray, precision: str) -> int:
    return layers.size * (2 if precision == "half" else 4)


def _write(maps: Maps, folder: Path) -> Stored:
    """Bases in layers, scaled to a largest magnitude of 1; the mean as it is, in an image of its own."""
    scale, bias, scaled = _scaled(maps)
    scale[maps.bases :] = 1
    layers = layered(scaled[: maps.bases], LAYER)
    images = {f"basis_{index:02d}.exr": layer for index, layer in enumerate(layers)}
    images |= dict.fromkeys([MEAN], maps.values[-1]) if len(maps.values) > maps.bases else {}
    for name, image in images.items():
        write_exr(folder / name, image, half=maps.precision == "half")
    mean = maps.values[maps.bases :]
    memory = _memory(layers, maps.precision) + _memory(mean, maps.precision)
    return Stored(tuple(images), len(images), memory, scale, bias, {})


def _read(maps: Maps, folder: Path) -> np.ndarray:
    count = len(layered(maps.values[: maps.bases], LAYER))
    layers = np.stack([read_exr(folder / f"basis_{index:02d}.exr")[0] for index in range(count)])
    bases = unlayered(layers, Maps(maps.values[: maps.bases], maps.bases, maps.known))
    return np.concatenate([bases, *([read_exr(folder / MEAN)[0][None]] if len(maps.values) > maps.bases else [])])


def _write_grid(maps: Maps, folder: Path) -> Stored:
    """As near to a square of layers as can be; the cells that are left over are 0."""
    scale, bias, scaled = _scaled(maps)
    layers = layered(scaled, LAYER)
    columns = int(np.ceil(np.sqrt(len(layers))))
    rows = -(-len(layers) // columns)
    count, height, width, channels = layers.shape
    cells = np.concatenate([layers, np.zeros((rows * columns - count, height, width, channels), np.float32)])
    image = cells.reshape(rows, columns, height, width, channels).swapaxes(1, 2).reshape(rows * height, -1, channels)
    write_exr(folder / GRID, image, half=maps.precision == "half")
    told = {"columns": columns, "rows": rows, "order": "layer i is in row i // columns from the top, column i % columns"}
    return Stored((GRID,), count, _memory(layers, maps.precision), scale, bias, told)


def _read_grid(maps: Maps, folder: Path) -> np.ndarray:
    image, _ = read_exr(folder / GRID)
    height, width = maps.known.shape
    rows, columns = image.shape[0] // height, image.shape[1] // width
    cells = image.reshape(rows, height, columns, width, -1).swapaxes(1, 2).reshape(rows * columns, height, width, -1)
    return unlayered(cells, maps)[: len(maps.values)]


EXR = Format("an EXR image per layer", ("basis_*.exr", MEAN), LAYER, _write, _read, refit=False)
EXR_GRID = Format("all layers in the grid of one EXR image, for texture arrays", (GRID,), LAYER, _write_grid, _read_grid)
