"""Exports of every method: textures as of a linear model, what makes a frame, a shader, and numbers to check by."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.errors import UserError
from ddprt.export import fog
from ddprt.export.engines.packed import FORMAT
from ddprt.export.engines.writing import check_engines, export_engines
from ddprt.export.frame import Frames
from ddprt.export.glsl import shader
from ddprt.export.golden import example_values, golden
from ddprt.export.texel import texel_of
from ddprt.export.textures import export_textures
from ddprt.files import write_tensors, write_text
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.deployment import Deployment, deployment_of
from ddprt.runtime.model import Model

NETWORK, SHADER, GOLDEN = "network.safetensors", "decode.glsl", "golden.json"
_U = "u = matrix (z - offset) + intercept"  # of the manifest's steps, the one that differs


def export_model(
    model: Model,
    folder: str | Path,
    *,
    precision: str = "half",
    formats: Sequence[str] = ("exr",),
    engines: Sequence[str] = (),
    **options: Any,
) -> list[Path]:
    """Writes the export of a model of any method.

    Args:
      model: as fitted or loaded.
      folder: created if need be.
      precision: "half" or "float" textures; weights are floats, being few.
      formats: as for `export_textures`.
      engines: entries of `ENGINES` that get a folder each; for linear methods. They bring the format that they load.
      options: as for `export_textures`.
    Returns:
      The files, the manifest last.
    Raises:
      UserError: the method does not say how it is deployed, has learned nothing, does more than add textures up and is to be
        stored in formats whose transfer does no more than that, or the folder cannot be written.
    """
    folder, found = Path(folder), deployment_of(model)
    if engines:
        check_engines(found, model.method)
        formats = (*formats, *({FORMAT} - set(formats)))
    _check_formats(model, found, formats)
    linear = isinstance(model.relighter, LinearTransfer)
    *written, path = export_textures(
        model if linear else found.textured(model), folder, precision=precision, formats=formats, **options
    )
    for name in (NETWORK, SHADER, GOLDEN):
        (folder / name).unlink(missing_ok=True)
    manifest = json.loads(path.read_text())
    scale, gamma = np.array(manifest["basis_scale"], np.float32), model.encoding.gamma
    texel, more = texel_of(
        found, scale, gamma=gamma if model.encoding.space == "gamma" else 1.0, constant=model.constant is not None
    )
    tensors = {**found.tensors, **more}
    if tensors:
        write_tensors(folder / NETWORK, {name: np.ascontiguousarray(part, np.float32) for name, part in tensors.items()})
        written.append(folder / NETWORK)
    why = texel.why_not or ("" if manifest["layers"] else 'it reads EXR layers; add "exr" to export.formats')
    if not why:
        write_text(folder / SHADER, shader(texel, __version__))
        written.append(folder / SHADER)
    if not linear:
        manifest |= _told(manifest, found, model)
    manifest["deployment"] = {
        "shape": found.shape,
        "features": list(found.features),
        "network": NETWORK if tensors else None,
        "frame": {name: list(where) for name, where in texel.rows.items()},
        "shader": {"file": None, "why": why} if why else {"file": SHADER, "reads": texel.reads},
        "golden": GOLDEN if manifest["layers"] else None,
    }
    write_text(path, json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")
    if manifest["layers"]:
        document = golden(model, found, Frames.read(folder), folder)
        write_text(folder / GOLDEN, json.dumps(document, allow_nan=False) + "\n")
        written.append(folder / GOLDEN)
    written += export_engines(folder, engines, model.covered, example_values(model), fog.notes(model))
    return [*written, path]


def _check_formats(model: Model, found: Deployment, formats: Sequence[str]) -> None:
    """Formats other than EXR layers put their scales into a transfer, which networks of texels and tables do not go by."""
    further = [name for name in formats if name != "exr"]
    if further and found.shape != "compose":
        raise UserError(
            f'export.formats: got "{further[0]}" with {model.method}, whose texels do more than add textures up, '
            'expected "exr" alone; set export.formats = ["exr"]'
        )


def _told(manifest: dict[str, Any], found: Deployment, model: Model) -> dict[str, Any]:
    """What the manifest says otherwise of a model that is not linear."""
    steps = manifest["decode"]
    at = steps.index(_U)
    before = [] if found.lights else steps[:at]
    sums = [_U.replace("z", "f"), *steps[at + 1 :]]
    if found.shape == "table":
        sums = ["y[c] = basis_scale[best[c]] * basis texture best[c], channel c", *steps[at + 2 :]]
    if "decode_formats" in manifest:
        manifest["decode_formats"] = [
            step.replace("z as", "f as").replace("(z -", "(f -") for step in manifest["decode_formats"]
        ]
    return {
        "channels": model.encoding.channels,
        "matrix": {**manifest["matrix"], "axes": f"{'1' if len(found.matrix) == 1 else 'rgb'}, bases, features"},
        "decode": [*before, *found.words, *sums],
    }
