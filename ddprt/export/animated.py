"""What moves for engines: basis textures once, matrices and points of every keyframe, and how to mix them.

The textures are those of the first keyframe's model; its points.json and transfer.safetensors hold for the first keyframe. All
matrices carry the same scales as that one.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.errors import UserError
from ddprt.export.textures import export_textures
from ddprt.files import write_tensors, write_text
from ddprt.runtime.animated import AnimatedModel

FILE = "animation.safetensors"

DECODE = [
    "times: of the keyframes, seconds; between keys k and k + 1: t = (time - times[k]) / (times[k + 1] - times[k])",
    "where there are several matrices: matrix, offset, intercept = (1 - t) * those of k + t * those of k + 1; else the first",
    "measurement point k lies on triangle[k] of the mesh (numbered as its Scene has them), at the sum of weights[k] times "
    "its corners, as the mesh is skinned and blended at that time; its normal is the triangle's",
    "position and normal: of the points at the keyframes; home and albedo as in points.json hold for all",
    "then as the decode steps above, with the first pose's lightmap coordinates, which ride on the mesh",
]


def check_settings(settings: Mapping[str, Any]) -> None:
    """Refuses what is written of one transfer alone, of which what moves has several.

    Args:
      settings: of [export].

    Raises:
      UserError: there is such a setting.
    """
    further = [name for name in settings.get("formats", ()) if name != "exr"]
    if further:
        raise UserError(
            f'export.formats: got "{further[0]}" with an animation, expected "exr" alone, whose scales the matrices of all '
            'keyframes carry; set export.formats = ["exr"]'
        )
    if settings.get("engines"):
        raise UserError(
            f'export.engines: got "{settings["engines"][0]}" with an animation, expected none: loaders know one transfer; '
            "set export.engines = []"
        )
    if settings.get("gltf"):
        raise UserError(
            "export.gltf: got true with an animation, expected false: the file would stand still; set export.gltf = false"
        )


def export_animated(model: AnimatedModel, folder: str | Path, **settings: Any) -> list[Path]:
    """Writes the export of a model of what moves.

    Args:
      model: of `fit_animation` or `load_animated`.
      folder: created if need be.
      settings: of `export_textures`.
    Returns:
      The files, the manifest last.
    Raises:
      UserError: formats other than "exr" are asked for, or the folder cannot be written.
    """
    check_settings(settings)
    folder = Path(folder)
    settings = {name: value for name, value in settings.items() if name not in ("engines", "gltf", "gltf_preview")}
    *files, path = export_textures(model.rest, folder, **settings)
    manifest = json.loads(path.read_text("utf-8"))
    scale = np.asarray(manifest["basis_scale"], np.float32)
    moments = [model.at(float(time)).samples for time in model.times]
    tensors = {
        "times": model.times,
        "matrix": model.matrix * scale[:, None],
        "offset": model.offset,
        "intercept": model.intercept * scale,
        "triangle": model.riders.triangle.astype(np.int32),
        "weights": model.riders.weights.astype(np.float32),
        "position": np.stack([samples.position for samples in moments]).astype(np.float32),
        "normal": np.stack([samples.normal for samples in moments]).astype(np.float32),
    }
    if model.constant is not None:
        tensors["constant"] = model.constant
    write_tensors(folder / FILE, tensors)
    manifest["animation"] = {
        "file": FILE,
        "keys": len(model.times),
        "matrices": len(model.matrix),
        "axes": f"matrix: {len(model.matrix)} matrices of {manifest['matrix']['axes']}",
        "decode": DECODE,
    }
    if model.constant is not None:
        manifest["animation"]["constant"] = "constant[key, covered texel in row-major order, rgb], mixed as matrices are, W/m²"
    write_text(path, json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")
    return [*files, folder / FILE, path]
