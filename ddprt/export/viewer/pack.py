"""What the page holds of a model: its export as engines load it, its triangles, and a view and lamps to begin with."""

import base64
import json
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float, Float32, Float64
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.textures import CONSTANT, EXITANT, export_textures
from ddprt.files import read_tensors
from ddprt.lights import DirectionalLight, Light, Lighting, PointLight, SpotLight
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.report.view import camera_for
from ddprt.runtime.model import Model
from ddprt.scene.exr import read_exr
from ddprt.scene.gutter import fill_gutter
from ddprt.transport.embree import Tracer

GUTTER = 4
DRAWN = (PointLight, SpotLight, DirectionalLight)
"""Lamps that the browser measures, draws and casts shadows of."""
HELD_OUT = 4
"""Lightings that a page holds with their references, at most; 8 bytes a texel each."""
MOST_LAMPS = 8
"""As in `src/surface.js`."""
_BLACK = 0.1  # share of texels without albedo that is worth a word
_BRIGHT = 0.25  # mean radiance, albedo included, that the first lamp is made for


@dataclass(frozen=True)
class Packed:
    """An array on its way into JSON.

    Attributes:
      type: as in NumPy, without byte order: it is little-endian.
      values: the array.
    """

    type: str
    values: np.ndarray

    @property
    def entry(self) -> dict[str, Any]:
        """What `src/data.js` reads."""
        data = np.ascontiguousarray(self.values, f"<{self.type}")
        return {"type": self.type, "shape": list(data.shape), "base64": base64.b64encode(data.tobytes()).decode("ascii")}


def pack(model: Model, data: Dataset | None = None, *, stitch: bool = True) -> dict[str, Any]:
    """All that the page holds, ready for JSON.

    Args:
      model: of a linear method.
      data: the dataset it was learned from, for held-out lightings with their references.
      stitch: as for `export_textures`.
    Raises:
      UserError: the method has no linear export, the model is too old to be drawn, or the dataset is of another scene or atlas.
    """
    if not isinstance(model.relighter, LinearTransfer):
        raise UserError(f'view: got a model of method "{model.method}", expected svd-ridge; set fit.method = "svd-ridge"')
    if model.uv is None:
        raise UserError(
            "view: got a model without lightmap coordinates, as of an import without a mesh, or of an older version; import "
            "again with --geometry MESH, or bake and fit again"
        )
    tracer = Tracer(model.occluders, holes=model.holes, fog=model.fog)
    camera = camera_for(model.scene["name"], model.occluders, model.viewpoint)
    with tempfile.TemporaryDirectory() as folder:
        export_textures(model, folder, gutter=GUTTER, stitch=stitch)
        found = _exported(Path(folder))
    stored = [] if data is None else _held_out(model, data)
    lights = stored[0]["lights"] if stored else _first_lamp(model, tracer)
    return found | {
        "name": model.scene["name"],
        "centre": tracer.centre.tolist(),
        "radius": tracer.radius,
        "lift": float(tracer.offset),
        "corners": Packed("f4", tracer.corners).entry,
        "uv": Packed("f4", model.uv).entry,
        "albedo": None if model.albedo is None else Packed("u1", _painted(model.albedo, model.covered)).entry,
        "holes": None if model.holes is None else _holes(model),
        "fog": None if tracer.medium is None else {key: getattr(tracer.medium, key).tolist() for key in ("extinction", "half")},
        "camera": {"eye": list(camera.eye), "target": list(camera.target), "fov": camera.fov_deg, "up": list(camera.up)},
        "lights": lights,
        "stored": stored,
        "notes": _notes(model),
    }


def _exported(folder: Path) -> dict[str, Any]:
    """An export folder: what `docs/export.md` says, all maps in one stack of four channels."""
    manifest = json.loads((folder / "manifest.json").read_text("utf-8"))
    names = [*manifest["layers"], *([manifest["mean"]] if manifest["mean"] else [])]
    transfer, points = read_tensors(folder / "transfer.safetensors"), json.loads((folder / "points.json").read_text("utf-8"))
    trust = manifest.pop("trust")
    if trust is not None:
        tensors = read_tensors(folder / trust["file"])
        numbers = {name: trust[name] for name in ("exponent", "level", "fade_from")}
        trust = numbers | {name: Packed("f4", tensors[name]).entry for name in ("directions", "shares")}
    extra = {name: folder / file for name, file in (("constant", CONSTANT), ("exitant", EXITANT)) if file in _files(folder)}
    images = {name: read_exr(path)[0] for name, path in extra.items()}
    return {
        "manifest": manifest,
        "maps": Packed("f2", np.stack([_four(read_exr(folder / name)[0]) for name in names])).entry,
        "constant": Packed("f4", _four(images["constant"])).entry if "constant" in images else None,
        "exitant": Packed("u1", 255 * images["exitant"][..., 0]).entry if "exitant" in images else None,
        **{name: Packed("f4", transfer[name]).entry for name in ("matrix", "offset", "intercept")},
        "trust": trust,
        "points": {name: Packed("i4" if name == "home" else "f8", np.array(points[name])).entry for name in points},
    }


def _files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _four(image: Float[np.ndarray, "height width channels"]) -> Float[np.ndarray, "height width 4"]:
    """Filled up with zeros to four channels."""
    return np.pad(image, ((0, 0), (0, 0), (0, 4 - image.shape[2])))


def _painted(albedo: Float[np.ndarray, "texels 3"], covered: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """(height, width, 4) bytes, sRGB-encoded, charts extended."""
    image = np.zeros((*covered.shape, 3))
    image[covered] = albedo
    linear = np.clip(fill_gutter(image, covered, GUTTER), 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.pad(np.rint(255 * encoded).astype(np.uint8), ((0, 0), (0, 0), (0, 1)), constant_values=255)


def _holes(model: Model) -> dict[str, Any]:
    types = {"row": "i4", "uv": "f4", "image": "i4", "size": "i4", "cutoff": "f4", "opacity": "f4"}
    return {name: Packed(type, getattr(model.holes, name)).entry for name, type in types.items()}


def _held_out(model: Model, data: Dataset) -> list[dict[str, Any]]:
    """Lightings of the test split with what was measured, what is right, and how far off the model is."""
    if {name: data.description["scene"][name] for name in ("name", "digest")} != model.scene:
        raise UserError(
            f'--dataset: got one of "{data.description["scene"]["name"]}", expected that which the model of '
            f'"{model.scene["name"]}" was learned from; give that folder'
        )
    if not np.array_equal(data.covered, model.covered) or data.samples.digest != model.samples.digest:
        raise UserError(f"--dataset: got {data.folder} with another atlas or other points; give that which the model is of")
    held_out = data.split("test")
    if not held_out:
        raise UserError(f"--dataset: got {data.folder} without held-out lightings, expected some; set lightings.test above 0")
    chosen = [held_out[round(at)] for at in np.linspace(0, len(held_out) - 1, min(HELD_OUT, len(held_out)))]
    values, light = data.values(chosen, model.points, model.quantity), data.maps("indirect", chosen)
    direct = data.maps("direct", chosen)
    if model.constant is not None:
        light = light + model.constant
    parts = zip(chosen, values, direct, light, model.predict(values), strict=True)
    return [_stored(model, index, data.lightings[index], *maps) for index, *maps in parts]


def _stored(
    model: Model,
    index: int,
    lighting: Lighting,
    values: Float32[np.ndarray, "points 3"],
    direct: Float32[np.ndarray, "texels 3"],
    truth: Float32[np.ndarray, "texels 3"],
    ours: Float32[np.ndarray, "texels 3"],
) -> dict[str, Any]:
    drawn = [light for light in lighting if isinstance(light, DRAWN)][:MOST_LAMPS]
    omitted = Counter(light.kind for light in lighting) - Counter(light.kind for light in drawn)
    share = model.area / model.area.sum()
    square = lambda light: float(share @ (light.astype(np.float64) ** 2).sum(1))  # noqa: E731
    whole, largest = square(truth), float(np.abs(truth).max(initial=0))
    half = float(np.finfo(np.float16).max)
    if largest > half:
        raise UserError(
            f"--dataset: got {largest:.3g} W/m² in lighting {index}, expected at most {half:g}, the end of "
            "half floats; leave --dataset out, or bake with weaker lamps"
        )
    return {
        "index": index,
        "lights": [_record(light) for light in drawn],
        "omitted": dict(omitted),
        "direct": _map(model, np.minimum(direct, half)) if omitted else None,  # whiter than white where it is that bright
        "values": Packed("f8", values).entry,
        "indirect": _map(model, truth),
        "error": (square(ours - truth) / whole) ** 0.5 if whole > 0 else 0.0,
        "rms": whole**0.5 or 1.0,
    }


def _map(model: Model, light: Float32[np.ndarray, "texels 3"]) -> dict[str, Any]:
    return Packed("f2", _four(fill_gutter(model.image(light), model.covered, GUTTER))).entry


def _record(light: Light) -> dict[str, Any]:
    return light.model_dump(mode="json")  # type: ignore[attr-defined]


def _first_lamp(model: Model, tracer: Tracer) -> list[dict[str, Any]]:
    """The point lamp that the model trusts most among some in and around the scene, bright enough; none where all are dark."""
    low, high = tracer.corners.reshape(-1, 3).min(0), tracer.corners.reshape(-1, 3).max(0)
    inside = [np.array([x, y, z]) for y in (0.75, 0.5) for x in (0.5, 0.3, 0.7) for z in (0.5, 0.3, 0.7)]
    around: list[Float64[np.ndarray, "3"]] = [np.array([x, 1.5, z]) for x in (-0.5, 1.5) for z in (-0.5, 1.5)]
    best, found = -1.0, []
    for place in [*inside, *around]:
        x, y, z = (low + place * (high - low) + tracer.centre).tolist()
        values = model.measure(PointLight(position=(x, y, z), intensity=(1, 1, 1)))
        told = model.trust(values)
        score = 0.0 if told is None else float(told.score)
        if values.any() and score > best:
            strength = np.pi * _BRIGHT / float(values.mean()) * (1 if model.quantity == "radiosity" else 2)
            best, found = score, [_record(PointLight(position=(x, y, z), intensity=(strength,) * 3))]
    return found


def _notes(model: Model) -> list[str]:
    """What the picture does not show."""
    notes = []
    if model.albedo is None:
        notes.append("The model is of an older version, without albedo: surfaces are shown in one grey. Fit it again.")
    elif (dark := float(np.mean(~model.albedo.any(1)))) > _BLACK:
        notes.append(
            f"{dark:.0%} of the texels have no diffuse albedo, as bare metal has none, and are black: show them without albedo."
        )
    if model.constant is not None:
        notes.append("Surfaces that glow light others; their own radiance is not in the model and is not shown.")
    if model.fog is not None:
        notes.append(
            "Lamps shine through the scene's fog, on surfaces and where they are measured. The air itself is not shown: what "
            "it sends into the eye, and what it swallows on the way there."
        )
    if model.layers:
        notes.append(f"Not shown: {', '.join(model.layers)}.")
    return notes
