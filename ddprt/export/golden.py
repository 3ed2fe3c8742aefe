"""Numbers to check a decoder by: a frame's inputs, the rows that they make, and the light of five texels."""

from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float, Int
from ddprt.export.frame import Frames
from ddprt.lights import parse_lighting
from ddprt.runtime.deployment import Deployment
from ddprt.runtime.model import Model
from ddprt.runtime.precision import stored
from ddprt.scene.exr import read_exr

TEXELS = 5
_STEP = {"half": 2.0**-11, "float": 2.0**-23}
_TOWARDS = np.array([0.36, 0.8, 0.48])


def example_values(model: Model) -> Float[np.ndarray, "points 3"]:
    """Measured light that is made up: a bright side, a dark side of another colour, and neighbours that differ, W/m²."""
    facing = np.maximum(model.samples.normal[: model.points] @ _TOWARDS, 0)
    uneven = 1 + 0.2 * (np.arange(model.points) % 4)
    return (uneven[:, None] * (np.array([0.2, 0.3, 0.4]) + facing[:, None] * [3.0, 2.0, 1.0])).astype(np.float32)


def golden(model: Model, found: Deployment, frames: Frames, folder: Path) -> dict[str, Any]:
    """The document.

    Args:
      model: as it was fitted; its light is told as it comes back from the exported precision.
      found: the model taken apart.
      frames: of the export.
      folder: of the export, whose textures say which texels stitching moved: none of these is among the five.
    """
    values = example_values(model)
    lighting = parse_lighting(list(found.example)) if found.example else None
    inputs = found.lights(lighting) if found.lights and lighting else {"values": values}
    light = stored(model, frames.manifest["precision"]).predict(values, lightings=lighting)
    chosen = _unmoved(found, frames, folder, model.covered)
    return {
        **({"lighting": list(found.example)} if found.lights else {}),
        **{name: np.asarray(part, np.float32).tolist() for name, part in inputs.items()},
        "rows": frames.rows(inputs).tolist(),
        "texels": np.argwhere(model.covered)[chosen].tolist(),
        "light": light[chosen].tolist(),
    }


def texture_maps(manifest: dict[str, Any], folder: Path) -> Float[np.ndarray, "maps height width colours"]:
    """Maps as the textures of an export hold them, over their largest magnitude; one colour, or three where they are RGB."""
    images = [read_exr(folder / name)[0] for name in manifest["layers"]]
    if images[0].shape[2] == 3:
        return np.stack(images)
    return np.moveaxis(np.concatenate(images, 2)[..., : manifest["bases"]], 2, 0)[..., None]


def _unmoved(found: Deployment, frames: Frames, folder: Path, covered: np.ndarray) -> Int[np.ndarray, " texels"]:
    """Covered texels that hold what was learned, spread over the map."""
    manifest = frames.manifest
    held = texture_maps(manifest, folder)[:, covered]
    learned = found.maps.reshape(held.shape) / np.array(manifest["basis_scale"])[:, None, None]
    near = np.abs(held - learned) <= _STEP[manifest["precision"]] * (np.abs(learned) + 2.0**-13)
    quiet = np.flatnonzero(near.all((0, 2)))
    return quiet[np.unique(np.linspace(0, len(quiet) - 1, min(TEXELS, len(quiet))).astype(int))] if len(quiet) else quiet
