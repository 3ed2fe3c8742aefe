"""Surfaces as glTF says them, and what it has no words for that anybody reads.

Textures leave as they came, 8 bits a channel, colours in sRGB. A mask's opacity is the alpha of the base colour.
"""

from typing import Any

import numpy as np

from ddprt.axes import Float, Float32
from ddprt.export.gltf.glb import Glb
from ddprt.report.view import tonemap
from ddprt.scene.material import Cutout, Emission, Gloss, Material, bilinear

_STRENGTH, _INDEX = "KHR_materials_emissive_strength", "KHR_materials_ior"
USUAL = Gloss().dielectric
"""Reflectance at normal incidence that glTF assumes: that of an index of 1.5."""


def material_entry(glb: Glb, material: Material) -> dict[str, Any]:
    """What stands in the list of materials; its textures are appended to the file.

    Backs that reflect are triangles of their own by now, so no material is double-sided.
    """
    base: dict[str, Any] = {"baseColorFactor": [*material.albedo, 1.0]}
    entry: dict[str, Any] = {"name": material.name, "pbrMetallicRoughness": base, "extensions": {}}
    colour = None if material.texture is None else encoded(material.texture)
    if material.cutout is not None:
        colour = _with_alpha(colour, material.cutout)
        entry |= {"alphaMode": "MASK", "alphaCutoff": material.cutout.cutoff}
    if colour is not None:
        base["baseColorTexture"] = {"index": glb.texture(colour)}
    _add_gloss(glb, entry, material.gloss or Gloss())
    if material.emission is not None:
        _add_emission(glb, entry, material.emission)
    for name in entry["extensions"]:
        glb.extension(name)
    return entry if entry["extensions"] else {key: value for key, value in entry.items() if key != "extensions"}


def left_out(material: Material) -> list[str]:
    """What of a material the file does not say."""
    return [name for name in ("subsurface", "fibre") if getattr(material, name) is not None]


def encoded(linear: Float[np.ndarray, "height width 3"]) -> np.ndarray:
    """(height, width, 3) bytes in sRGB."""
    return np.rint(255 * tonemap(linear, 0.0)).astype(np.uint8)


def _with_alpha(colour: np.ndarray | None, cutout: Cutout) -> np.ndarray:
    """Colour and opacity in one image, as large as the larger of the two."""
    shape = cutout.opacity.shape if colour is None else np.maximum(cutout.opacity.shape, colour.shape[:2])
    colour = np.full((1, 1, 3), 255, np.uint8) if colour is None else colour
    height, width = (int(side) for side in shape)
    both = [_sized(colour.astype(np.float32), height, width), _sized(255 * cutout.opacity[..., None], height, width)]
    return np.rint(np.concatenate(both, 2)).clip(0, 255).astype(np.uint8)


def _sized(image: Float32[np.ndarray, "rows columns channels"], height: int, width: int) -> np.ndarray:
    """Looked up at the texels of another size; of its own size, as it is."""
    if image.shape[:2] == (height, width):
        return image
    row, column = np.divmod(np.arange(height * width), width)
    return bilinear(image, (np.stack([column, row], 1) + 0.5) / [width, height]).reshape(height, width, -1)


def _add_gloss(glb: Glb, entry: dict[str, Any], gloss: Gloss) -> None:
    base = entry["pbrMetallicRoughness"]
    base |= {"roughnessFactor": gloss.roughness, "metallicFactor": gloss.metallic}
    if gloss.texture is not None:  # green is roughness, blue metalness
        image = np.rint(255 * np.pad(gloss.texture, ((0, 0), (0, 0), (1, 0)), constant_values=1)).clip(0, 255)
        base["metallicRoughnessTexture"] = {"index": glb.texture(image.astype(np.uint8))}
    if gloss.dielectric != USUAL:
        root = gloss.dielectric**0.5
        entry["extensions"][_INDEX] = {"ior": (1 + root) / (1 - root)}


def _add_emission(glb: Glb, entry: dict[str, Any], emission: Emission) -> None:
    """Factors and textures end at 1; what is brighter is a strength."""
    radiance, peak = np.array(emission.radiance), 1.0
    if emission.texture is not None:
        peak = max(float(emission.texture.max()), 1.0)
        entry["emissiveTexture"] = {"index": glb.texture(encoded(emission.texture / peak))}
    strength = max(float(radiance.max()) * peak, 1.0)
    entry["emissiveFactor"] = (radiance * peak / strength).tolist()
    if strength > 1:
        entry["extensions"][_STRENGTH] = {"emissiveStrength": strength}
