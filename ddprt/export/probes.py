"""The basis of probes, their transfer and where they stand: `probes.safetensors`, explained by `probes.json`.

An engine measures what it measures for the lightmap; a second small matrix turns it into what each basis counts, and the sum of
the basis is nine numbers a probe and colour.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.dataset.grids import ProbeGrid, nearest_valid
from ddprt.errors import UserError
from ddprt.files import write_tensors, write_text
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import LayerModel, Model

SCHEMA = 1
FILES = ("probes.safetensors", "probes.json")

DECODE = [
    "x, s and z: as for the lightmap, see manifest.json",
    "u = matrix (z - offset) + intercept",
    "y[probe, k, colour] = mean + sum over bases of u[b] * basis[b, probe, k]; in gamma space y = sign(y) |y|^gamma",
    "c = s * y, plus constant where there is such a tensor: light of surfaces that glow",
    "where source[probe] differs from probe, it stands in a solid: take c of the probe named there",
    "between probes of a grid: c trilinear; x is the slowest axis, z the fastest",
    "irradiance on a plane with unit normal n: max(0, sum over k of c[k] Y_k(n)), in W/m²; radiance = albedo / pi * irradiance",
    "Y = 0.282095, 0.488603 (y, z, x), 1.092548 (x y, y z), 0.315392 (3 z² - 1), 1.092548 x z, 0.546274 (x² - y²) of n",
    "the engine adds direct light, of lamps and skies, by itself",
]


def export_probes(model: Model, folder: str | Path, name: str = "probes") -> list[Path]:
    """Writes a model's probes; where it has none, what an earlier export left of them goes.

    Args:
      model: of method svd-ridge.
      folder: of the export.
      name: of the layer.
    Returns:
      The files; none where there are no probes.
    Raises:
      UserError: the method has no linear export.
    """
    folder, part = Path(folder), model.layers.get(name)
    if part is None:
        for stale in FILES:
            (folder / stale).unlink(missing_ok=True)
        return []
    relighter, layer = part.model.relighter, part.layer
    if not isinstance(relighter, LinearTransfer):
        raise UserError(f'export: got probes of method "{part.model.method}", expected svd-ridge; set fit.method = "svd-ridge"')
    colours = () if model.encoding.channels == "mono" else (3,)
    shape = len(layer.position), layer.coefficients, *colours
    tensors = {
        "position": layer.position,
        "basis": np.asarray(relighter.basis).reshape(-1, *shape),
        "mean": np.asarray(relighter.mean).reshape(shape),
        "matrix": np.asarray(relighter.matrix),
        "offset": np.asarray(relighter.offset),
        "intercept": np.asarray(relighter.intercept),
    }
    if part.model.constant is not None:
        tensors["constant"] = part.model.constant.reshape(*shape[:2], 3)
    floats = {key: value.astype(np.float32) for key, value in tensors.items()}
    write_tensors(folder / FILES[0], {**floats, "source": nearest_valid(layer).astype(np.int32)})
    document = {
        "schema": SCHEMA,
        "ddprt": __version__,
        "file": FILES[0],
        "probes": len(layer.position),
        "grid": _grid(part),
        "order": layer.order,
        "bases": len(relighter.basis),
        "points": model.points,
        "space": model.encoding.space,
        "gamma": model.encoding.gamma,
        "channels": model.encoding.channels,
        "axes": {
            "basis": "bases, probes, harmonics" + (", rgb" if colours else ""),
            "matrix": "1, bases, points * rgb" if colours else "rgb, bases, points",
        },
        "in_solids": np.flatnonzero(layer.weight == 0).tolist(),
        "unit": "irradiance in W/m2, before albedo",
        "decode": DECODE,
        "golden": _golden(part),
    }
    write_text(folder / FILES[1], json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    return [folder / file for file in FILES]


def _grid(part: LayerModel) -> list[int] | None:
    """Probes along x, y and z; None for a list of probes."""
    try:
        return [len(axis) for axis in ProbeGrid.of(part.layer).axes]
    except UserError:
        return None


def _golden(part: LayerModel) -> dict[str, Any]:
    """An example to check a decoder by: all points measure 1 W/m², and planes face up."""
    up = [0.0, 1.0, 0.0]
    light = part.predict(np.ones((part.model.points, 3)))[nearest_valid(part.layer)]
    return {"x": 1.0, "normal": up, "irradiance": part.layer.towards(light, np.array(up)).astype(float).tolist()}
