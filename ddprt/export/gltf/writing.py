"""scene.glb beside the textures: the triangles that the model knows, addressed as its lightmaps are."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float
from ddprt.errors import UserError
from ddprt.export.gltf.glb import Glb
from ddprt.export.gltf.materials import encoded, left_out, material_entry
from ddprt.files import written_whole
from ddprt.lights import Lighting, load_lightings
from ddprt.runtime.model import Model
from ddprt.scene.checks import UNSAID
from ddprt.scene.gutter import fill_gutter
from ddprt.scene.mesh import Scene
from ddprt.sections import ExportConfig

FILE, LIGHTMAP, MANIFEST = "scene.glb", "MOZ_lightmap", "manifest.json"


def write_gltf(model: Model, folder: Path, settings: ExportConfig, scene: Callable[[], Scene | None]) -> None:
    """Writes scene.glb if settings ask for it, and removes an older one if not; `scene` is called only where it is written.

    Raises:
      UserError: as for `export_gltf` and `preview_lighting`.
    """
    if not settings.gltf:
        (folder / FILE).unlink(missing_ok=True)
        return
    lighting = preview_lighting(settings.gltf_preview) if settings.gltf_preview else None
    export_gltf(model, folder, scene(), lighting=lighting, gutter=settings.gutter)


def preview_lighting(path: str) -> Lighting:
    """The first lighting of a file.

    Raises:
      UserError: it cannot be read.
    """
    return load_lightings(path)[0]


def export_gltf(model: Model, folder: Path, scene: Scene | None, *, lighting: Lighting | None = None, gutter: int = 4) -> Path:
    """Writes scene.glb into an export.

    Args:
      model: whose lightmap coordinates the second set is.
      folder: of the export; the file names its manifest.
      scene: whose triangles they are, for materials, texture coordinates and smooth normals. Without one there is a single
        material, painted with the albedo of the texels.
      lighting: whose indirect light is shown by programs that know `MOZ_lightmap`; None for none.
      gutter: texels that charts of images are extended by.
    Returns:
      The file.
    Raises:
      UserError: the model has no triangles or coordinates, the scene is another one, or the lighting leaves it dark.
    """
    if model.uv is None or not len(model.occluders):
        raise UserError(
            "export.gltf: got a model without triangles or lightmap coordinates, as of light that was imported without a mesh; "
            "import it with --geometry, or set export.gltf = false"
        )
    if scene is not None and not _same(scene.corners, model.occluders):
        raise UserError(
            f'export.gltf: got the scene "{scene.name}" of other triangles than the model was learned from; bake and fit again'
        )
    glb = Glb()
    primitives = _of_model(glb, model, gutter) if scene is None else _of_scene(glb, model.uv, scene)
    if lighting is not None:
        _add_preview(glb, model, lighting, gutter)
    told: dict[str, Any] = {"manifest": MANIFEST, "lightmap": "TEXCOORD_1", "left_out": _left_out(model, scene)}
    name = model.scene["name"]
    mesh = glb.add("meshes", {"name": name, "primitives": primitives})
    node = glb.add("nodes", {"name": name, "mesh": mesh, "extras": {"ddprt": told}})
    glb.document |= {"scene": glb.add("scenes", {"nodes": [node]})}
    path = folder / FILE
    with written_whole(path) as temporary:
        temporary.write_bytes(glb.to_bytes())
    return path


def _same(corners: np.ndarray, others: np.ndarray) -> bool:
    return corners.shape == others.shape and bool((corners.astype(np.float32) == others.astype(np.float32)).all())


def _left_out(model: Model, scene: Scene | None) -> list[str]:
    """What the scene has and the file does not say, each once."""
    parts = [] if scene is None else [part for material in scene.used_materials for part in left_out(material)]
    return sorted({*parts, *(["fog"] if model.fog is not None else [])})


def _of_scene(glb: Glb, uv: Float[np.ndarray, "triangles 3 2"], scene: Scene) -> list[dict[str, Any]]:
    """A primitive for each material in use; corners that agree in everything are one vertex."""
    primitives = []
    for number in np.unique(scene.material):
        chosen = scene.material == number
        corner, places = scene.triangles[chosen].reshape(-1), np.float32(uv[chosen]).reshape(-1, 2) + np.float32(0)
        key = np.column_stack([corner, places.view(np.int32)])
        _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
        vertex, lightmap = corner[first], places[first]
        rows = {"POSITION": scene.positions[vertex], "NORMAL": scene.normals[vertex], "TEXCOORD_1": lightmap}
        # The sets of coordinates must count up without a gap.
        rows["TEXCOORD_0"] = lightmap if scene.uv is None else scene.uv[vertex]
        rows |= {} if scene.colour is None else {"COLOR_0": scene.colour[vertex]}
        entry = glb.add("materials", material_entry(glb, scene.materials[number]))
        primitives.append(_primitive(glb, rows, index.reshape(-1), entry))
    return primitives


def _of_model(glb: Glb, model: Model, gutter: int) -> list[dict[str, Any]]:
    """All triangles flat, in the colours of the texels; the lightmap's coordinates are the first set, too."""
    assert model.uv is not None
    corners = np.asarray(model.occluders, np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = model.uv.reshape(-1, 2)
    rows = {"POSITION": corners.reshape(-1, 3), "NORMAL": np.repeat(normals, 3, 0), "TEXCOORD_0": places, "TEXCOORD_1": places}
    base: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if model.albedo is None:
        base["baseColorFactor"] = [UNSAID] * 3 + [1.0]
    else:
        painted = fill_gutter(model.image(model.albedo).astype(np.float64), model.covered, gutter)
        base["baseColorTexture"] = {"index": glb.texture(encoded(painted))}
    entry = glb.add("materials", {"name": "texels", "pbrMetallicRoughness": base})
    return [_primitive(glb, rows, np.arange(len(places)), entry)]


def _primitive(glb: Glb, rows: dict[str, np.ndarray], index: np.ndarray, material: int) -> dict[str, Any]:
    attributes = {name: glb.accessor(rows[name], bounds=name == "POSITION") for name in sorted(rows)}
    return {"attributes": attributes, "indices": glb.accessor(index, "<u4"), "material": material}


def _add_preview(glb: Glb, model: Model, lighting: Lighting, gutter: int) -> None:
    """Irradiance of one lighting, sRGB times `intensity`, in W/m²; `extras` of each material would be lost in most programs."""
    light = fill_gutter(np.maximum(model.relight(lighting), 0), model.covered, gutter)
    peak = float(light.max(initial=0))
    if peak == 0:
        raise UserError("export.gltf_preview: got a lighting that sends no light round the scene, expected one that does")
    told = {"index": glb.texture(encoded(light / peak)), "texCoord": 1, "intensity": peak}
    glb.extension(LIGHTMAP)
    for entry in glb.document["materials"]:
        entry.setdefault("extensions", {})[LIGHTMAP] = told
