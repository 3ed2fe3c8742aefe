"""A model on disk: model.json and tensors.safetensors, self-contained, no pickle.

model.json carries the SHA-256 of the tensors, so that a damaged model is refused rather than answered from. Models of versions
that wrote none are told by its absence; of theirs it is known only that all numbers are finite and in range.
"""

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ddprt import __version__
from ddprt.catalogue import Catalogue
from ddprt.dataset.layers import Layer
from ddprt.errors import UserError
from ddprt.files import read_tensors, sha256, write_tensors, write_text
from ddprt.fitting.encoding import Encoding
from ddprt.methods import method_named
from ddprt.methods.method import FitReport
from ddprt.runtime.model import LayerModel, Model
from ddprt.runtime.trust import Yardstick
from ddprt.sampling.points import Samples
from ddprt.scene.fog import Fog
from ddprt.scene.holes import Holes
from ddprt.scene.viewpoint import Viewpoint

SCHEMA = 1
ANIMATION = "animation.json"
"""What a folder has besides if its model moves, see `animated_file`."""
_PLACES = ("position", "weight", "texel")  # tensors of a layer


class _Part(BaseModel):
    """Numbers of model.json: finite and in range, or the file is damaged."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class _Encoding(_Part):
    space: Literal["linear", "gamma"]
    gamma: float = Field(ge=1, le=10)
    channels: Literal["mono", "multi"]


class _Points(_Part):
    count: int = Field(ge=1)
    quantity: Literal["radiosity", "irradiance"]
    spacing: float = Field(ge=0)
    depth: float = Field(0.0, ge=0)


class _Trust(_Part):
    ridge: float = Field(gt=0)
    exponent: float = Field(ge=0)
    level: float = Field(ge=0)
    fade_from: float = Field(ge=0, le=1)


class _Layer(_Part):
    name: str = Field(pattern=r"^[a-z0-9][a-z0-9 -]*$")
    quantity: Literal["irradiance", "radiance"]
    order: int = Field(ge=0, le=32)


class _Document(BaseModel):
    """What model.json holds; keys of later versions of the same schema are passed over."""

    encoding: _Encoding
    layers: tuple[_Layer, ...] = ()
    points: _Points
    report: FitReport
    trust: _Trust | None = None
    tensors_sha256: str | None = None


def save_model(model: Model, folder: Path) -> None:
    """Writes a model; what was there before stays whole until the new one is.

    Raises:
      UserError: the folder cannot be written.
    """
    tensors: dict[str, np.ndarray] = {
        **{f"points.{name}": array for name, array in model.samples.tensors.items()},
        "atlas.covered": model.covered,
        "atlas.area": model.area,
        "scene.corners": model.occluders,
    }
    if model.uv is not None:
        tensors["scene.uv"] = model.uv
    for name, part in model.layers.items():
        tensors |= {f"layers.{name}.{entry}": getattr(part.layer, entry) for entry in _PLACES}
        save_model(part.model, folder / "layers" / name)
    if model.holes is not None:
        tensors |= model.holes.tensors
    if model.constant is not None:
        tensors["light.constant"] = model.constant
    if model.exitant is not None:
        tensors["atlas.exitant"] = model.exitant
    if model.albedo is not None:
        tensors["atlas.albedo"] = model.albedo
    trust: dict[str, float] = {}
    if model.yardstick is not None:
        for entry in fields(model.yardstick):
            value = getattr(model.yardstick, entry.name)
            if isinstance(value, np.ndarray):
                tensors[f"trust.{entry.name}"] = value
            else:
                trust[entry.name] = value
    static: dict[str, Any] = {}
    for entry in fields(model.relighter):  # type: ignore[arg-type]
        value = getattr(model.relighter, entry.name)
        if entry.name == "report":
            continue
        if entry.metadata.get("static") or value is None:
            static[entry.name] = value
        elif isinstance(value, tuple):
            static[entry.name] = {"tuple": len(value)}
            tensors |= {f"relighter.{entry.name}.{i}": np.asarray(part) for i, part in enumerate(value)}
        else:
            tensors[f"relighter.{entry.name}"] = np.asarray(value)
    write_tensors(folder / "tensors.safetensors", tensors)
    document = {
        "schema": SCHEMA,
        "ddprt": __version__,
        "method": model.method,
        "encoding": asdict(model.encoding),
        "points": {
            "count": model.points,
            "quantity": model.quantity,
            "spacing": model.samples.spacing,
            "depth": model.samples.depth,
        },
        "scene": model.scene,
        "relighter": static,
        "report": asdict(model.relighter.report),
        "trust": trust or None,
        **({"fog": model.fog.record} if model.fog else {}),
        **({"viewpoint": model.viewpoint.record} if model.viewpoint else {}),
        **({"layers": [_layer_entry(part.layer) for part in model.layers.values()]} if model.layers else {}),
        "unit": "W/m2",
        "tensors_sha256": sha256(folder / "tensors.safetensors"),
    }
    (folder / ANIMATION).unlink(missing_ok=True)  # of what moved before in this folder
    write_text(folder / "model.json", json.dumps(document, indent=1) + "\n")


def load_model(folder: str | Path) -> Model:
    """Reads a model; neither its dataset nor its scene file is needed.

    Raises:
      UserError: missing, damaged, of another schema, of a method that is not installed, or of an animation.
    """
    if (Path(folder) / ANIMATION).is_file():
        raise UserError(
            f"{folder}: got a model of an animation, expected one that stands still; load it with ddprt.load_animated, whose "
            "at(time) is a model of a moment"
        )
    return read_model(Path(folder))


def read_model(folder: Path) -> Model:
    """Reads a model, though it may be but the first pose of an animation; see `load_model`."""
    try:
        document = json.loads((folder / "model.json").read_text("utf-8"))
        schema = document["schema"]
    except OSError as error:
        raise UserError(f"{folder}: got {error.strerror or error}, expected a model folder; fit one first") from None
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{folder / 'model.json'}: not a model description; fit it again") from None
    if type(schema) is not int or schema != SCHEMA:
        raise UserError(f"{folder}: got model schema {schema}, expected {SCHEMA}; fit it again with this version")
    tensors = read_tensors(folder / "tensors.safetensors")
    try:
        relighter_type = method_named(document["method"]).relighter
        checked = _Document.model_validate(document)
        if checked.tensors_sha256 not in (None, sha256(folder / "tensors.safetensors")):
            raise ValueError("the tensors are not those that were saved: their checksum is another")
        odd = [name for name, array in tensors.items() if not np.isfinite(array).all()]
        if odd:
            raise ValueError(f"got NaN or infinity in {odd[0]}")
        parts = {entry.name: load_model(folder / "layers" / entry.name) for entry in checked.layers}
        model = _assemble(document, checked, tensors, relighter_type, parts)
        model.predict(np.zeros((model.points, 3)), lightings=())
        model.trust(np.zeros((model.points, 3)))
    except UserError:
        raise
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(map(str, fault["loc"]))
        raise UserError(
            f"{folder / 'model.json'}: {place}: got {repr(fault['input'])[:60]}, expected: {fault['msg']}; fit it again"
        ) from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = " ".join(str(error).split())[:120]
        raise UserError(f"{folder}: model.json and tensors.safetensors do not fit together ({why}); fit it again") from None
    return model


def _layer_entry(layer: Layer) -> dict[str, Any]:
    return {"name": layer.name, "quantity": layer.quantity, "order": layer.order}


def _layer_model(entry: _Layer, tensors: dict[str, np.ndarray], model: Model) -> LayerModel:
    layer = Layer(entry.name, entry.quantity, entry.order, *(tensors[f"layers.{entry.name}.{key}"] for key in _PLACES))
    if model.covered.shape != (len(layer.position), layer.coefficients):
        raise ValueError(f"got a model of {model.covered.shape} for layer {entry.name}")
    return LayerModel(layer, model)


def _assemble(
    document: dict[str, Any],
    checked: _Document,
    tensors: dict[str, np.ndarray],
    relighter_type: type,
    parts: dict[str, Model],
) -> Model:
    arguments: dict[str, Any] = {}
    for entry in fields(relighter_type):
        static = document["relighter"].get(entry.name)
        if entry.name == "report":
            arguments["report"] = checked.report
        elif isinstance(static, dict):
            arguments[entry.name] = tuple(jnp.asarray(tensors[f"relighter.{entry.name}.{i}"]) for i in range(static["tuple"]))
        elif entry.name in document["relighter"]:
            arguments[entry.name] = static
        else:
            arguments[entry.name] = jnp.asarray(tensors[f"relighter.{entry.name}"])
    places = checked.points
    if places.count > len(tensors["points.position"]):
        raise ValueError(f"got {places.count} points")
    uv = tensors.get("scene.uv")
    if uv is not None and uv.shape != (len(tensors["scene.corners"]), 3, 2):
        raise ValueError(f"got lightmap coordinates of shape {uv.shape}")
    constant = tensors.get("light.constant")
    if constant is not None and constant.shape != (int(tensors["atlas.covered"].sum()), 3):
        raise ValueError(f"got constant light of shape {constant.shape}")
    exitant = tensors.get("atlas.exitant")
    if exitant is not None and exitant.shape != (int(tensors["atlas.covered"].sum()),):
        raise ValueError(f"got exitant texels of shape {exitant.shape}")
    paint = tensors.get("atlas.albedo")
    if paint is not None and paint.shape != (int(tensors["atlas.covered"].sum()), 3):
        raise ValueError(f"got albedo of shape {paint.shape}")
    of_points = {name.removeprefix("points."): array for name, array in tensors.items() if name.startswith("points.")}
    samples = Samples.read(of_points, places.spacing, places.depth)
    return Model(
        document["method"],
        relighter_type(**arguments),
        Encoding(**checked.encoding.model_dump()),
        samples,
        places.count,
        places.quantity,
        tensors["atlas.covered"],
        tensors["atlas.area"],
        tensors["scene.corners"],
        document["scene"],
        uv,
        None if checked.trust is None else _yardstick(checked.trust, tensors),
        Catalogue("layer", {entry.name: _layer_model(entry, tensors, parts[entry.name]) for entry in checked.layers}),
        Holes.read(tensors, len(tensors["scene.corners"])),
        constant,
        exitant,
        paint,
        None if document.get("fog") is None else Fog.of(document["fog"], "model.json: fog"),
        None if document.get("viewpoint") is None else Viewpoint.of(document["viewpoint"], "model.json: viewpoint"),
    )


def _yardstick(numbers: _Trust, tensors: dict[str, np.ndarray]) -> Yardstick:
    directions, shares, mean = (tensors[f"trust.{name}"] for name in ("directions", "shares", "mean"))
    return Yardstick(directions, shares, mean, **numbers.model_dump())
