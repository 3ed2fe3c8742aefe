"""Layers for engines: of each its basis, transfer and places in `NAME.safetensors`, explained by `NAME.json`.

An engine measures what it measures for the lightmap; a second small matrix turns it into what each basis counts, and the sum of
the basis is a few numbers for each place and colour: nine for a probe, more for a place of a glossy surface.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.axes import Bool
from ddprt.dataset.grids import ProbeGrid, nearest_valid
from ddprt.dataset.layers import Layer
from ddprt.errors import UserError
from ddprt.files import write_tensors, write_text
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import LayerModel, Model

SCHEMA = 1

_TO_HARMONICS = [
    "x, s and z: as for the lightmap, see manifest.json",
    "u = matrix (z - offset) + intercept",
    "y[place, k, colour] = mean + sum over bases of u[b] * basis[b, place, k]; in gamma space y = sign(y) |y|^gamma",
]
_PROBES = [
    "c = s * y, plus constant where there is such a tensor: light of surfaces that glow",
    "where source[probe] differs from probe, it stands in a solid: take c of the probe named there",
    "between probes of a grid: c trilinear; x is the slowest axis, z the fastest",
    "irradiance on a plane with unit normal n: max(0, sum over k of c[k] Y_k(n)), in W/m²; radiance = albedo / pi * irradiance",
    "Y = 0.282095, 0.488603 (y, z, x), 1.092548 (x y, y z), 0.315392 (3 z² - 1), 1.092548 x z, 0.546274 (x² - y²) of n",
    "the engine adds direct light, of lamps and skies, by itself",
]
_SURFACE = [
    "c = s * y, plus constant where there is such a tensor: light of surfaces that glow",
    "between texels of the layer: c bilinear, by their row and column on the lightmap",
    "radiance towards the eye, w the unit vector from the surface to it: max(0, sum over k of c[k] Y_k(w)), in W/(m² sr)",
    "Y: real harmonics of world axes, orthonormal, k = l² + l + m: for m = 0 sqrt(K) P, for m > 0 sqrt(2K) P cos(m t), for "
    "m < 0 sqrt(2K) P sin(|m| t), where t = atan2(y, x), K = (2l + 1) (l - |m|)! / (4 pi (l + |m|)!), P = (-1)^m P_l^|m|(z)",
    "it is all that leaves the surface of indirect light, the diffuse part too: it stands in place of albedo / pi * E_indirect",
    "the engine adds what the surface sends on of lamps and skies by itself",
]
_GOLDEN = 64  # places of a surface that the example tells of, at most


def export_layers(model: Model, folder: str | Path) -> list[Path]:
    """Writes all layers of a model; what an earlier export left of others goes.

    Args:
      model: of method svd-ridge, if it has layers.
      folder: of the export.
    Returns:
      The files; none where there are no layers.
    Raises:
      UserError: the method has no linear export.
    """
    folder = Path(folder)
    for name in _earlier(folder):
        if name not in model.layers:
            for suffix in (".safetensors", ".json"):
                (folder / f"{name}{suffix}").unlink(missing_ok=True)
    return [file for name, part in model.layers.items() for file in _export(part, model.covered, folder, name)]


def _earlier(folder: Path) -> list[str]:
    """Layers that a folder holds: what is explained by a file that names the other."""
    found = []
    for path in folder.glob("*.json"):
        tensors = path.with_suffix(".safetensors")
        if tensors.is_file():
            told = json.loads(path.read_text())
            if isinstance(told, dict) and told.get("file") == tensors.name and "ddprt" in told:
                found.append(path.stem)
    return found


def _export(part: LayerModel, covered: Bool[np.ndarray, "height width"], folder: Path, name: str) -> list[Path]:
    model, layer = part.model, part.layer
    relighter, encoding = model.relighter, model.encoding
    if not isinstance(relighter, LinearTransfer):
        raise UserError(
            f'export: got layer "{name}" of method "{model.method}", expected svd-ridge; set fit.method = "svd-ridge"'
        )
    free = layer.quantity == "irradiance"
    colours = () if encoding.channels == "mono" else (3,)
    shape = len(layer.position), layer.coefficients, *colours
    tensors = {
        "position": layer.position,
        "basis": np.asarray(relighter.basis).reshape(-1, *shape),
        "mean": np.asarray(relighter.mean).reshape(shape),
        "matrix": np.asarray(relighter.matrix),
        "offset": np.asarray(relighter.offset),
        "intercept": np.asarray(relighter.intercept),
    }
    if model.constant is not None:
        tensors["constant"] = model.constant.reshape(*shape[:2], 3)
    floats = {key: value.astype(np.float32) for key, value in tensors.items()}
    whose = nearest_valid(layer) if free else np.argwhere(covered)[layer.texel]
    files = folder / f"{name}.safetensors", folder / f"{name}.json"
    write_tensors(files[0], {**floats, "source" if free else "texel": whose.astype(np.int32)})
    places = "probes" if free else "places"
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "ddprt": __version__,
        "file": files[0].name,
        "quantity": layer.quantity,
        places: len(layer.position),
        **({"grid": _grid(part)} if free else {}),
        "order": layer.order,
        "bases": len(relighter.basis),
        "points": model.points,
        "space": encoding.space,
        "gamma": encoding.gamma,
        "channels": encoding.channels,
        "axes": {
            "basis": f"bases, {places}, harmonics" + (", rgb" if colours else ""),
            "matrix": "1, bases, points * rgb" if colours else "rgb, bases, points",
            **({} if free else {"texel": "places, (row, column) of the lightmap"}),
        },
        **({"in_solids": np.flatnonzero(layer.weight == 0).tolist(), "unlit": _unlit(layer, tensors)} if free else {}),
        "unit": "irradiance in W/m2, before albedo" if free else "radiance in W/(m2 sr), of indirect light",
        "decode": [*_TO_HARMONICS, *(_PROBES if free else _SURFACE)],
        "golden": _golden_probes(part) if free else _golden_surface(part),
    }
    write_text(files[1], json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    return list(files)


def _grid(part: LayerModel) -> list[int] | None:
    """Probes along x, y and z; None for a list of probes."""
    try:
        return [len(axis) for axis in ProbeGrid.of(part.layer).axes]
    except UserError:
        return None


def _unlit(layer: Layer, tensors: dict[str, np.ndarray]) -> list[int]:
    """Probes in free air that no light has reached."""
    light = np.abs(tensors["basis"]).sum(axis=(0, *range(2, tensors["basis"].ndim)))
    for name in {"mean", "constant"} & tensors.keys():
        light = light + np.abs(tensors[name]).sum(axis=tuple(range(1, tensors[name].ndim)))
    return np.flatnonzero((layer.weight > 0) & (light == 0)).tolist()


def _golden_probes(part: LayerModel) -> dict[str, Any]:
    """An example to check a decoder by: all points measure 1 W/m², and planes face up."""
    up = [0.0, 1.0, 0.0]
    light = part.predict(np.ones((part.model.points, 3)))[nearest_valid(part.layer)]
    return {"x": 1.0, "normal": up, "irradiance": part.layer.towards(light, np.array(up)).astype(float).tolist()}


def _golden_surface(part: LayerModel) -> dict[str, Any]:
    """The same of some places, seen along each axis from both sides."""
    layer, axes = part.layer, np.concatenate([np.eye(3), -np.eye(3)])
    light = part.predict(np.ones((part.model.points, 3)))
    some = np.unique(np.linspace(0, len(light) - 1, min(len(light), _GOLDEN)).astype(int))
    radiance = [layer.towards(light, axis)[some].astype(float).tolist() for axis in axes]
    return {"x": 1.0, "towards": axes.tolist(), "place": some.tolist(), "radiance": radiance}
