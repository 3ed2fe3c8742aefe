"""Basis textures, transfer matrices and a manifest: everything a shader needs, nothing it does not.

Mono channel packs four bases into an RGBA layer; multi channel gives each basis an RGB image. Every basis is scaled to a
largest magnitude of 1, which spends the bits of half floats best, and the scale is pushed into its row of the matrix. Formats
other than EXR layers bring a transfer of their own, see `ddprt.export.stored`.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.errors import UserError
from ddprt.export import fog
from ddprt.export.formats.exr import MEAN
from ddprt.export.formats.format import Maps
from ddprt.export.formats.listing import FORMATS, check_formats
from ddprt.export.seams import Stitcher, find_seams
from ddprt.export.stored import DECODE as DECODE_FORMAT
from ddprt.export.stored import remove_stale, transfer_name, write_format
from ddprt.files import make_folder, write_tensors, write_text
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.scene.exr import write_exr
from ddprt.scene.gutter import fill_gutter

SCHEMA = 1
CONSTANT = "constant.exr"
EXITANT = "exitant.exr"

DECODE = [
    "home = points.home; x[p] = mean over samples k with home[k] == p of (albedo[k] *) E_direct[k], per colour channel",
    "where depth is not 0: E_direct = visible from position * max(0, 2 E(position - depth * normal) - E(position - 2 depth * "
    "normal)), lit without shadows and with the same normal; depth in metres",
    "s = norm of x over the points (per channel for mono, over all for multi); s = 0 gives black",
    "z = x / s; in gamma space z = sign(z) |z|^(1/gamma)",
    "u = matrix (z - offset) + intercept",
    "y = mean texture + sum over bases of u[b] * basis texture b",
    "y = max(y, 0); in gamma space y = y^gamma; E_indirect = s * y, in W/m²; radiance = albedo / pi * E_indirect",
]

GLOWING = "E = E_indirect + constant texture, added after the sum, the clamp, gamma and s: light of surfaces that glow"

LEAVING = (
    "where the exitant texture is 1, E is all light that leaves, before albedo, that of lamps which went through the body too: "
    "add no diffuse reflection of lamps there"
)

TRUST = [
    "x as above, encoded: z; per channel for mono, over all for multi; weight of a channel w = s² / sum of s²",
    "p = directions z; r = z - directions^T p",
    "novelty = sum over channels of w (sum of shares p² + sum of r²) / (sum of z²), at most 1",
    "expected error = novelty^exponent; trust = 1 - expected error; 1 where s is 0; extrapolating where novelty > level",
    "to fade: k = clip(trust / (1 - fade_from), 0, 1); k = k² (3 - 2 k); E = k E + (1 - k) s E(mean)",
]


def export_textures(
    model: Model,
    folder: str | Path,
    *,
    precision: str = "half",
    gutter: int = 4,
    stitch: bool = True,
    formats: Sequence[str] = ("exr",),
    refit: bool = True,
) -> list[Path]:
    """Writes the export of a linear model.

    Args:
      model: of method svd-ridge.
      folder: created if need be.
      precision: "half" or "float" EXR.
      gutter: texels that charts are extended by.
      stitch: make charts agree where a smooth surface was cut; the manifest says what that did, or why it was not done.
      formats: entries of `FORMATS` for the basis textures.
      refit: fit the transfer of each format but "exr" to the textures as it holds them.
    Returns:
      The files, the manifest last.
    Raises:
      UserError: the method has no linear export, the folder cannot be written, or a format is unknown, cannot hold the
        lightmap or lacks its library.
    """
    maps, seams = textures(model, precision=precision, gutter=gutter, stitch=stitch)
    relighter = model.relighter
    assert isinstance(relighter, LinearTransfer)
    check_formats(formats, *model.covered.shape)
    folder = Path(folder)
    mono, has_mean = model.encoding.channels == "mono", len(maps.values) > maps.bases
    if tuple(formats) != ("exr",) and not len(maps.values):
        raise UserError(
            "export.formats: got a model without any light, expected some to scale by; leave formats and engines out"
        )
    sizes = np.abs(maps.values[: maps.bases]).max((1, 2, 3), initial=0)
    scale = np.where(sizes > 0, sizes, 1).astype(np.float32)
    written: list[Path] = []
    constant = None if model.constant is None else glow(model, gutter=gutter, stitch=stitch)
    layers: list[str] = []
    if "exr" in formats:
        layers = list(FORMATS["exr"].write(maps, folder).files)
        written += [folder / name for name in layers]
    told = {}
    for name in [name for name in formats if name != "exr"]:
        make_folder(folder)
        files, told[name] = write_format(model, maps, name, folder, refit=refit)
        written += files
    remove_stale(folder, [*written, folder / transfer_name("exr")])
    for name, there in ((CONSTANT, constant is not None), (EXITANT, model.exitant is not None)):
        if not there:
            (folder / name).unlink(missing_ok=True)
    if constant is not None:  # in W/m², which halves may not reach
        write_exr(folder / CONSTANT, constant, half=False)
        written.append(folder / CONSTANT)
    if model.exitant is not None:  # whole numbers in the gutter too, where charts of either kind meet
        write_exr(folder / EXITANT, np.rint(_image(model, model.exitant.astype(np.float32), gutter)), half=True)
        written.append(folder / EXITANT)

    points = {
        "position": model.samples.position,
        "normal": model.samples.normal,
        "albedo": model.samples.albedo,
        "home": model.samples.nearest_point(model.points).astype(np.int32),
    }
    tensors = {
        "matrix": np.asarray(relighter.matrix) * scale[None, :, None],
        "offset": np.asarray(relighter.offset),
        "intercept": np.asarray(relighter.intercept) * scale,
    }
    write_tensors(folder / "transfer.safetensors", {name: value.astype(np.float32) for name, value in tensors.items()})
    write_text(folder / "points.json", json.dumps({name: np.asarray(value).tolist() for name, value in points.items()}) + "\n")
    trust = None
    if model.yardstick is not None:
        ruler = model.yardstick
        write_tensors(folder / "trust.safetensors", {name: getattr(ruler, name) for name in ("directions", "shares", "mean")})
        written.append(folder / "trust.safetensors")
        numbers = {name: getattr(ruler, name) for name in ("exponent", "level", "fade_from")}
        trust = {"file": "trust.safetensors", **numbers, "formula": TRUST}
    manifest: dict[str, Any] = {
        "schema": SCHEMA,
        "ddprt": __version__,
        "scene": model.scene,
        "width": model.covered.shape[1],
        "height": model.covered.shape[0],
        "bases": maps.bases,
        "points": model.points,
        "samples": len(model.samples.position),
        "quantity": model.quantity,
        "depth": model.samples.depth,
        "space": model.encoding.space,
        "gamma": model.encoding.gamma,
        "channels": model.encoding.channels,
        "precision": precision,
        "layers": [name for name in layers if name != MEAN],
        "packing": "basis 4 i + c is channel c of layer i" if mono else "layer i is basis i in RGB",
        "mean": MEAN if has_mean and layers else None,
        "basis_scale": scale.tolist(),
        "seams": seams,
        "matrix": {"file": "transfer.safetensors", "axes": "rgb, bases, points" if mono else "1, bases, points * rgb"},
        "uv": "lightmap coordinates (TEXCOORD_1), origin top-left, row 0 at the top",
        "unit": "irradiance in W/m2, before albedo",
        "decode": [
            *DECODE,
            *([] if constant is None else [GLOWING]),
            *([] if model.exitant is None else [LEAVING]),
            *([] if model.fog is None else [fog.DECODE]),
        ],
        "trust": trust,
    }
    if constant is not None:
        manifest["constant"] = CONSTANT
    if model.exitant is not None:
        manifest["exitant"] = EXITANT
    manifest |= fog.told(model)
    if told:
        manifest["formats"] = told
        manifest["decode_formats"] = DECODE_FORMAT
    write_text(folder / "manifest.json", json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")
    return [*written, folder / "transfer.safetensors", folder / "points.json", folder / "manifest.json"]


def textures(model: Model, *, precision: str = "half", gutter: int = 4, stitch: bool = True) -> tuple[Maps, dict[str, Any]]:
    """All textures of a linear model in float32, charts extended and stitched, and what the manifest says of seams.

    Args:
      model: of method svd-ridge.
      precision, gutter, stitch: as for `export_textures`.
    Raises:
      UserError: the method has no linear export.
    """
    relighter = model.relighter
    if not isinstance(relighter, LinearTransfer):
        raise UserError(f'export: got a model of method "{model.method}", expected svd-ridge; set fit.method = "svd-ridge"')
    bases, mean = np.asarray(relighter.basis, np.float32), np.asarray(relighter.mean)
    images = [_image(model, entries, gutter) for entries in [*bases, *([mean] if np.any(mean) else [])]]
    images, seams = _stitched(model, images, gutter, stitch)
    empty = np.zeros((0, *model.covered.shape, 1 if model.encoding.channels == "mono" else 3), np.float32)
    return Maps(np.stack(images) if images else empty, len(bases), _known(model, gutter), precision), seams


def glow(model: Model, *, gutter: int, stitch: bool) -> np.ndarray:
    """The light of what glows as an image, W/m², as `export_textures` writes it."""
    assert model.constant is not None
    return _stitched(model, [_image(model, model.constant, gutter)], gutter, stitch)[0][0]


def _image(model: Model, entries: np.ndarray, gutter: int) -> np.ndarray:
    """Entries of a basis or mean as an image of 1 (mono) or 3 (multi) channels, charts extended."""
    return fill_gutter(model.image(entries.reshape(int(model.covered.sum()), -1)), model.covered, gutter)


def _known(model: Model, gutter: int) -> np.ndarray:
    """Texels of charts and gutter."""
    return fill_gutter(model.covered[..., None].astype(np.float32), model.covered, gutter)[..., 0] > 0


def _stitched(model: Model, images: list[np.ndarray], gutter: int, stitch: bool) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Images with their seams closed, and what the manifest says of that."""
    if not stitch:
        return images, {"stitched": False, "why": "export.stitch is false"}
    if gutter == 0:
        return images, {"stitched": False, "why": "export.gutter is 0: filtering at a chart's edge reads texels of nothing"}
    if model.uv is None:
        return images, {
            "stitched": False,
            "why": "no lightmap coordinates: the light was imported without a mesh, or an older version baked it",
        }
    stitcher = Stitcher(find_seams(model.occluders, model.uv, _known(model, gutter)))
    closed = [stitcher.stitch(image) for image in images]
    size = [max(float(np.abs(image).max(initial=0)), 1e-30) for image in closed]
    before, after = (
        sum(float(stitcher.mismatch(image).mean()) / large for image, large in zip(group, size, strict=True))
        / max(len(size), 1)
        for group in (images, closed)
    )
    told = {"stitched": True, "edges": stitcher.seams.edges, "texels": len(stitcher.texels)}
    return closed, {**told, "difference_before": before, "difference_after": after}
