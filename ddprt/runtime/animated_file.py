"""A model of what moves on disk: an ordinary model of the first keyframe, and beside it what the others add.

animation.json carries the SHA-256 of its own tensors and of the model's, so that neither is taken with another's.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.errors import UserError
from ddprt.files import read_tensors, sha256, write_tensors, write_text
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.animated import AnimatedModel
from ddprt.runtime.model_file import ANIMATION as DOCUMENT
from ddprt.runtime.model_file import read_model
from ddprt.sampling.riding import Riders

SCHEMA = 2  # 1: every pose gave samples to points anew
TENSORS = "animation.safetensors"
_OWN = ("times", "positions", "triangles", "matrix", "offset", "intercept", "area")
_RIDERS = ("triangle", "weights")


def save_animated(model: AnimatedModel, folder: Path) -> None:
    """Writes a model; see `AnimatedModel.save`.

    Raises:
      UserError: the folder cannot be written.
    """
    model.rest.save(folder)  # which takes the document of another away, until this one is whole
    tensors = {name: getattr(model, name) for name in _OWN}
    tensors |= {f"riders.{name}": getattr(model.riders, name) for name in _RIDERS}
    if model.constant is not None:
        tensors["constant"] = model.constant
    write_tensors(folder / TENSORS, tensors)
    document = {
        "schema": SCHEMA,
        "statuses": list(model.statuses),
        "tensors_sha256": sha256(folder / TENSORS),
        "model_sha256": sha256(folder / "tensors.safetensors"),
    }
    write_text(folder / DOCUMENT, json.dumps(document, indent=1) + "\n")


def is_animated(folder: str | Path) -> bool:
    """Whether a folder holds a model of what moves."""
    return (Path(folder) / DOCUMENT).is_file()


def load_animated(folder: str | Path) -> AnimatedModel:
    """Reads a model that `AnimatedModel.save` wrote; needs neither datasets nor scene.

    Raises:
      UserError: there is none, or it is damaged.
    """
    folder = Path(folder)
    if not is_animated(folder):
        raise UserError(f"{folder}: got no {DOCUMENT}, expected a model of an animation; load others with ddprt.load_model")
    rest = read_model(folder)
    try:
        document: dict[str, Any] = json.loads((folder / DOCUMENT).read_text("utf-8"))
        if document["schema"] != SCHEMA:
            raise ValueError(f"schema {document['schema']}, expected {SCHEMA}")
        for key, name in (("tensors_sha256", TENSORS), ("model_sha256", "tensors.safetensors")):
            if document[key] != sha256(folder / name):
                raise ValueError(f"{name} is not what was saved with it: its checksum is another")
        tensors = read_tensors(folder / TENSORS)
        riders = Riders(**{name: tensors[f"riders.{name}"] for name in _RIDERS}, rest=rest.samples)
        parts: dict[str, Any] = {name: tensors[name] for name in _OWN}
        parts |= {"constant": tensors.get("constant"), "statuses": tuple(document["statuses"])}
        model = AnimatedModel(rest, riders=riders, **parts)
        _check(model)
    except UserError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{folder / DOCUMENT}: got {' '.join(str(error).split())[:120]}; fit it again") from None
    return model


def _check(model: AnimatedModel) -> None:
    """Makes sure that all parts are of one animation.

    Raises:
      ValueError: they are not.
    """
    keys, relighter = len(model.times), model.rest.relighter
    if not isinstance(relighter, LinearTransfer) or model.matrix.shape[1:] != relighter.matrix.shape:
        raise ValueError("matrices of another basis than the model's")
    fine = len(model.positions) == len(model.area) == keys and len(model.matrix) in (1, keys)
    if not fine or len(model.riders.triangle) != len(model.rest.samples.position):
        raise ValueError(f"parts that do not fit {keys} keyframes")
    if not all(np.isfinite(getattr(model, name)).all() for name in _OWN):
        raise ValueError("NaN or infinity")
