"""A model on disk: model.json and tensors.safetensors, self-contained, no pickle."""

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ddprt import __version__
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors, write_text
from ddprt.fitting.encoding import Encoding
from ddprt.methods import METHODS
from ddprt.methods.method import FitReport
from ddprt.runtime.model import Model
from ddprt.runtime.trust import Yardstick
from ddprt.sampling.points import Samples

SCHEMA = 1


def save_model(model: Model, folder: Path) -> None:
    """Writes a model; what was there before stays whole until the new one is.

    Raises:
      UserError: the folder cannot be written.
    """
    tensors: dict[str, np.ndarray] = {
        "points.position": model.samples.position,
        "points.normal": model.samples.normal,
        "points.albedo": model.samples.albedo,
        "atlas.covered": model.covered,
        "atlas.area": model.area,
        "scene.corners": model.occluders,
    }
    if model.uv is not None:
        tensors["scene.uv"] = model.uv
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
        "unit": "W/m2",
    }
    write_tensors(folder / "tensors.safetensors", tensors)
    write_text(folder / "model.json", json.dumps(document, indent=1) + "\n")


def load_model(folder: str | Path) -> Model:
    """Reads a model; neither its dataset nor its scene file is needed.

    Raises:
      UserError: missing, damaged, of another schema, or of a method that is not installed.
    """
    folder = Path(folder)
    try:
        document = json.loads((folder / "model.json").read_text("utf-8"))
        schema = document["schema"]
    except OSError as error:
        raise UserError(f"{folder}: got {error.strerror or error}, expected a model folder; fit one first") from None
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{folder / 'model.json'}: not a model description; fit it again") from None
    if schema != SCHEMA:
        raise UserError(f"{folder}: got model schema {schema}, expected {SCHEMA}; fit it again with this version")
    tensors = read_tensors(folder / "tensors.safetensors")
    try:
        relighter_type = METHODS[document["method"]].relighter
        model = _assemble(document, tensors, relighter_type)
        model.predict(np.zeros((model.points, 3)))
        model.trust(np.zeros((model.points, 3)))
    except UserError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = " ".join(str(error).split())[:120]
        raise UserError(f"{folder}: model.json and tensors.safetensors do not fit together ({why}); fit it again") from None
    return model


def _assemble(document: dict[str, Any], tensors: dict[str, np.ndarray], relighter_type: type) -> Model:
    arguments: dict[str, Any] = {}
    for entry in fields(relighter_type):
        static = document["relighter"].get(entry.name)
        if entry.name == "report":
            arguments["report"] = FitReport(**{key: _tuples(value) for key, value in document["report"].items()})
        elif isinstance(static, dict):
            arguments[entry.name] = tuple(jnp.asarray(tensors[f"relighter.{entry.name}.{i}"]) for i in range(static["tuple"]))
        elif entry.name in document["relighter"]:
            arguments[entry.name] = static
        else:
            arguments[entry.name] = jnp.asarray(tensors[f"relighter.{entry.name}"])
    places, encoding = document["points"], document["encoding"]
    words = {encoding["space"]: ("linear", "gamma"), encoding["channels"]: ("mono", "multi")}
    words |= {places["quantity"]: ("radiosity", "irradiance")}
    for word, known in words.items():
        if word not in known:
            raise ValueError(f"got {word!r}, expected {' or '.join(known)}")
    if not 0 < int(places["count"]) <= len(tensors["points.position"]):
        raise ValueError(f"got {places['count']} points")
    uv = tensors.get("scene.uv")
    if uv is not None and uv.shape != (len(tensors["scene.corners"]), 3, 2):
        raise ValueError(f"got lightmap coordinates of shape {uv.shape}")
    position, normal, albedo = (tensors[f"points.{name}"] for name in ("position", "normal", "albedo"))
    samples = Samples(position, normal, albedo, places["spacing"], places.get("depth", 0.0))
    return Model(
        document["method"],
        relighter_type(**arguments),
        Encoding(**document["encoding"]),
        samples,
        places["count"],
        places["quantity"],
        tensors["atlas.covered"],
        tensors["atlas.area"],
        tensors["scene.corners"],
        document["scene"],
        uv,
        None if document.get("trust") is None else _yardstick(document["trust"], tensors),
    )


def _yardstick(numbers: dict[str, float], tensors: dict[str, np.ndarray]) -> Yardstick:
    directions, shares, mean = (tensors[f"trust.{name}"] for name in ("directions", "shares", "mean"))
    return Yardstick(directions, shares, mean, **{name: float(value) for name, value in numbers.items()})


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
