"""What moves for engines: textures once, matrices and points of every keyframe, how to mix them, and numbers to check that by.

It is an export like any other: points.json, transfer.safetensors and golden.json hold for the first keyframe, textures and
shader for all. What the keyframes add is in animation.safetensors, whose matrices carry the scales of these textures.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float32
from ddprt.errors import UserError
from ddprt.export.deployed import export_model
from ddprt.export.frame import Frames
from ddprt.export.golden import golden
from ddprt.export.textures import CONSTANT, glow
from ddprt.files import write_tensors, write_text
from ddprt.runtime.animated import AnimatedModel
from ddprt.runtime.deployment import deployment_of
from ddprt.scene.exr import write_exr

FILE, GOLDEN, GLOWING = "animation.safetensors", "animation-golden.json", "constant-{:02d}.exr"
_SHARE = 0.3  # of the way to the next keyframe: mixing the wrong way round shows
_MIXED = ("matrix", "offset", "intercept")

DECODE = [
    "times: of the keyframes, seconds; between keys k and k + 1: t = (time - times[k]) / (times[k + 1] - times[k])",
    "matrix, offset, intercept = (1 - t) * those of k + t * those of k + 1, in place of transfer.safetensors; where there is "
    "one of each, that holds for all times",
    "sample i lies on a triangle, at the sum of weights[i] times its corners, as the mesh is skinned and blended at that time; "
    "its normal is along cross(corner 1 - corner 0, corner 2 - corner 0)",
    "corners[k, i]: of that triangle at keyframe k, by which it is found in a mesh; triangle[i]: its number as ddprt read the "
    "mesh; without skinning, corners = (1 - t) * corners[k] + t * corners[k + 1]; position and normal: at the keyframes",
    "home and albedo of points.json, and depth, hold for all times: a sample stays with its point",
    "then as the decode steps above and the shader, with the first pose's lightmap coordinates, which ride on the mesh",
]
_CONSTANT = "constant: images of the keyframes, mixed as matrices are, in place of the one that the shader adds"


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
      UserError: formats other than "exr", engines or glTF are asked for, or the folder cannot be written.
    """
    check_settings(settings)
    folder = Path(folder)
    settings = {name: value for name, value in settings.items() if name not in ("gltf", "gltf_preview")}
    *files, path = export_model(model.rest, folder, **settings)
    manifest = json.loads(path.read_text("utf-8"))
    scale = np.asarray(manifest["basis_scale"], np.float32)
    moments = [model.at(time).samples for time in model.times.tolist()]
    riders, corners = model.riders, model.positions[:, model.triangles[model.riders.triangle]]
    tensors = {
        "times": model.times,
        "matrix": model.matrix * scale[:, None],
        "offset": model.offset,
        "intercept": model.intercept * scale,
        "triangle": riders.triangle.astype(np.int32),
        "weights": riders.weights.astype(np.float32),
        "corners": corners.astype(np.float32),
        "position": np.stack([samples.position for samples in moments]).astype(np.float32),
        "normal": np.stack([samples.normal for samples in moments]).astype(np.float32),
    }
    write_tensors(folder / FILE, tensors)
    images = _write_glow(model, folder, **settings)
    write_text(folder / GOLDEN, json.dumps(_moments(model, folder, tensors), allow_nan=False) + "\n")
    manifest["animation"] = {
        "file": FILE,
        "keys": len(model.times),
        "matrices": len(model.matrix),
        "axes": f"matrix: {len(model.matrix)} matrices of {manifest['matrix']['axes']}",
        "golden": GOLDEN,
        **({"constant": images} if images else {}),
        "decode": [*DECODE, *([_CONSTANT] if images else [])],
    }
    write_text(path, json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")
    return [*files, *(folder / name for name in (*images[1:], FILE, GOLDEN)), path]


def mixed(tensors: Mapping[str, np.ndarray], time: float) -> dict[str, Float32[np.ndarray, "..."]]:
    """Matrix, offset and intercept of a time, from the tensors of an export."""
    times = tensors["times"]
    k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, max(0, len(times) - 2)))
    t = (time - times[k]) / (times[k + 1] - times[k]) if len(times) > 1 else 0.0
    several = len(tensors["matrix"]) > 1
    parts = {name: tensors[name] for name in _MIXED}
    both = {name: (1 - t) * part[k] + t * part[k + 1] if several else part[0] for name, part in parts.items()}
    return {name: part.astype(np.float32) for name, part in both.items()}


def _write_glow(model: AnimatedModel, folder: Path, *, gutter: int = 4, stitch: bool = True, **_: Any) -> list[str]:
    """Images of what glows at each keyframe, of which the first one is there; names of all, none where nothing does."""
    for path in folder.glob(GLOWING.replace("{:02d}", "*")):
        path.unlink()
    names = [] if model.constant is None else [CONSTANT, *(GLOWING.format(k) for k in range(1, len(model.constant)))]
    for k, name in enumerate(names[1:], 1):
        assert model.constant is not None
        still = replace(model.rest, constant=model.constant[k])  # seams are those of the first pose, as in the textures
        write_exr(folder / name, glow(still, gutter=gutter, stitch=stitch), half=False)
    return names


def _moments(model: AnimatedModel, folder: Path, tensors: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Numbers to check a decoder by, at keyframes and between them: what a lamp near a sample measures, and `golden`."""
    times, frames, found = model.times, Frames.read(folder), []
    between = [(1 - _SHARE) * times[k] + _SHARE * times[k + 1] for k in sorted({0, len(times) - 2}) if len(times) > 1]
    for time in sorted({float(times[0]), float(times[-1]), *map(float, between)}):
        still = model.at(time)
        samples = still.samples
        place = samples.position[0] + 3 * samples.spacing * samples.normal[0]
        lamp = {"type": "point", "position": place.tolist(), "intensity": [1.0, 2.0, 0.5]}
        own = replace(frames, transfer=mixed(tensors, time))
        measured = {"lighting": [lamp], "measured": still.measure(lamp).tolist()}
        found.append({"time": time, **measured, **golden(still, deployment_of(still), own, folder)})
    return {"moments": found}
