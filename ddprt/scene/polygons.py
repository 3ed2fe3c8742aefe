"""OBJ, PLY and STL in, by trimesh's parsers but without its clean-up, which would merge, reorder and round.

OBJ: one material per MTL material, or per object and group where there is none. `Kd` is taken as linear, as Blender,
Mitsuba and PBRT do (three.js takes it as sRGB), times the sRGB texture `map_Kd`. PLY: vertex and face colours are sRGB; a
triangle has the mean of its corners. What names no colour, as STL, has albedo 0.8. Files are in metres, Y up.
"""

import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float, Int
from ddprt.errors import UserError
from ddprt.scene import obj_faces, ply_faces
from ddprt.scene.checks import UNSAID, checked
from ddprt.scene.images import linear_image, srgb_to_linear
from ddprt.scene.material import Material, plain
from ddprt.scene.mesh import Scene

_TRIANGULATED = {"obj": obj_faces.with_triangles, "ply": ply_faces.with_triangles}

EXACT_COLOURS = 4096
"""Different colours that each become a material; where a file has more, they are rounded to 32 levels per channel."""


def load_polygons(path: Path, *, lightmap: bool = False) -> Scene:
    """Read an .obj (with its .mtl and textures beside it), .ply or .stl.

    Args:
      path: of the file.
      lightmap: its texture coordinates are those of a lightmap; materials keep their one albedo.
    Returns:
      The scene; its notes say what was assumed and which files are missing.
    Raises:
      UserError: without triangles, or a corner that is no vertex. What else a damaged file leads to is raised as it comes;
        `load_scene` puts it into words.
    """
    kind = path.suffix.lower()[1:]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        meshes, notes = _parsed(path, kind)
        parts = [_part(name, mesh, kind) for name, mesh in meshes.items() if mesh.get("faces") is not None]
        notes += _absent(path, kind)
    if not parts:
        raise UserError(f"{path.name}: got no triangles, expected a mesh; the file may be cut short")
    number: dict[str, int] = {}
    materials: list[Material] = []
    for entry in (entry for part in parts for entry in part.materials):
        if entry.name not in number:
            number[entry.name] = len(materials)
            materials.append(entry)
    starts = np.cumsum([0, *[len(part.positions) for part in parts]])
    if lightmap:
        materials = [plain(entry) for entry in materials]
    return checked(
        path.stem,
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
        normals=np.concatenate([part.normals for part in parts]),
        material=np.concatenate([np.array([number[entry.name] for entry in part.materials])[part.material] for part in parts]),
        materials=tuple(materials),
        uv=np.concatenate([part.uv for part in parts]) if any(entry.texture is not None for entry in materials) else None,
        lightmap=np.concatenate([part.uv for part in parts]) if lightmap else None,
        notes=tuple(dict.fromkeys([*notes, *[note for part in parts for note in part.notes]])),
    )


@dataclass
class _Part:
    """One mesh of the file."""

    positions: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    uv: Float[np.ndarray, "vertices 2"]
    triangles: Int[np.ndarray, "triangles 3"]
    material: Int[np.ndarray, " triangles"]
    materials: list[Material]
    notes: list[str]


def _parsed(path: Path, kind: str) -> tuple[dict[str, Any], list[str]]:
    """What trimesh finds in the file, mesh by mesh, and what to note of its polygons."""
    from trimesh.exchange.load import mesh_loaders
    from trimesh.resolvers import FilePathResolver

    split = {"split_objects": True, "split_groups": True} if kind == "obj" else {}
    data = path.read_bytes()
    if kind == "obj":
        data = _as_utf8(data)
    data, notes = _TRIANGULATED[kind](path, data) if kind in _TRIANGULATED else (data, [])
    with io.BytesIO(data) as stream:
        loaded = mesh_loaders[kind](stream, file_type=kind, resolver=FilePathResolver(str(path)), **split)
    return loaded.get("geometry", {path.stem: loaded}), notes


def _as_utf8(data: bytes) -> bytes:
    """Text in whatever encoding: names and comments in Latin-1 are common, and trimesh wants a further package for them."""
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1").encode("utf-8")
    return data


def _part(name: str, mesh: dict[str, Any], kind: str) -> _Part:
    positions = np.asarray(mesh["vertices"], dtype=np.float64)
    faces = np.asarray(mesh["faces"], dtype=np.int64)
    owner = np.arange(len(faces))
    if faces.shape[1] == 4:
        faces, owner = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]), np.tile(owner, 2)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(positions):
        beyond = faces[(faces < 0) | (faces >= len(positions))][0]
        expected = f"vertex indices from 0 to {len(positions) - 1}"
        raise UserError(f"{name}: got a face with vertex {beyond}, expected {expected}; export it again")
    given, visual = mesh.get("vertex_normals"), mesh.get("visual")
    normals = np.full(positions.shape, np.nan) if given is None else np.asarray(given, dtype=np.float64)
    uv = getattr(visual, "uv", None)
    # These formats count v from the bottom; here is the one place where it is turned to count from the top.
    uv = np.zeros((len(positions), 2)) if uv is None else np.asarray(uv, dtype=np.float64) * [1.0, -1.0] + [0.0, 1.0]
    # A material or a texture is a statement about the surface; colours beside it are often left over from a scan.
    albedo = None if _picture(visual) is not None or "kd" in _words(visual) else _colours(mesh, faces, owner)
    if albedo is None:
        material, notes = _material(name, visual)
        index, materials = np.zeros(len(faces), np.int64), [material]
    else:
        index, materials, notes = _palette(albedo)
    if kind == "obj" and given is None:
        # An OBJ without normals is faceted, as its viewers show it.
        corner = faces.ravel()
        positions, normals, uv, faces = positions[corner], normals[corner], uv[corner], np.arange(corner.size).reshape(-1, 3)
    return _Part(positions, normals, uv, faces, index, materials, notes)


def _colours(mesh: dict[str, Any], faces: np.ndarray, owner: np.ndarray) -> Float[np.ndarray, "triangles 3"] | None:
    """Linear colour per triangle where the file has one per vertex or face."""
    by_face, by_vertex = mesh.get("face_colors"), mesh.get("vertex_colors")
    encoded = by_face if by_face is not None else by_vertex
    if encoded is None or not len(encoded):
        return None
    encoded = np.asarray(encoded)[:, :3]
    full = np.iinfo(encoded.dtype).max if encoded.dtype.kind in "iu" else 1.0
    linear = srgb_to_linear(np.clip(encoded.astype(np.float64) / full, 0.0, 1.0))
    return linear[owner] if by_face is not None else linear[faces].mean(axis=1)


def _palette(linear: Float[np.ndarray, "triangles 3"]) -> tuple[Int[np.ndarray, " triangles"], list[Material], list[str]]:
    """One material per different colour, and which of them each triangle has."""
    notes: list[str] = []
    for rounded in (False, True):
        if rounded:
            # Squares of even steps: about evenly spaced to the eye.
            linear = (np.round(np.sqrt(linear) * 31) / 31) ** 2
            notes = ["more colours than materials can be told apart: rounded to 32 levels per channel"]
        code = np.round(linear * 65535).astype(np.int64) @ (1 << np.array([32, 16, 0]))
        _, first, index = np.unique(code, return_index=True, return_inverse=True)
        if len(first) <= EXACT_COLOURS:
            break
    names = (f"colour {entry:012x}" for entry in code[first])
    return (
        index,
        [Material(name, (float(r), float(g), float(b))) for name, (r, g, b) in zip(names, linear[first], strict=True)],
        notes,
    )


def _material(name: str, visual: Any) -> tuple[Material, list[str]]:
    """The material of a mesh; trimesh rounds its own colours to 8 bits but keeps the words of the MTL beside them."""
    said, image = _words(visual), _picture(visual)
    title = getattr(getattr(visual, "material", None), "name", None) or name
    ignored = [word for word in ("ke", "map_ke", "d", "map_d", "tr") if _counts(word, said.get(word))]
    notes = [f'ignored in material "{title}": {word}' for word in ignored]
    if image is not None and visual.uv is None:
        notes.append(f'material "{title}" has a texture but its mesh no texture coordinates: texture left out')
        image = None
    texture = None if image is None else linear_image(image)
    diffuse = np.broadcast_to(np.asarray(said.get("kd", 1.0 if image is not None else UNSAID), dtype=np.float64), 3)
    if texture is not None and not diffuse.any():
        diffuse = np.ones(3)
        notes.append(f'material "{title}" has Kd 0 under a texture: taken as 1')
    elif texture is None and "kd" not in said:
        notes.append(f'no colour for "{title}": albedo {UNSAID} assumed')
    red, green, blue = (float(value) for value in diffuse)
    return Material(title, (red, green, blue), texture), notes


def _words(visual: Any) -> dict[str, Any]:
    return getattr(getattr(visual, "material", None), "kwargs", None) or {}


def _picture(visual: Any) -> Any:
    """The texture's image; one that was decoded from no file is trimesh's stand-in for a material it does not know."""
    image = getattr(getattr(visual, "material", None), "image", None)
    return None if getattr(image, "format", None) is None else image


def _counts(word: str, value: Any) -> bool:
    """Whether an MTL entry that is ignored here would change the picture: `d 1`, `Tr 0` and `Ke 0 0 0` do not."""
    if value is None or word.startswith("map"):
        return value is not None
    return any(float(number) != (1.0 if word == "d" else 0.0) for number in np.atleast_1d(value))


def _absent(path: Path, kind: str) -> list[str]:
    """Files that an OBJ or PLY names and that are not there: trimesh passes over them."""
    if kind == "stl":
        return []
    text = path.read_bytes().decode(errors="replace")
    if kind == "ply":
        images = re.findall(r"^comment TextureFile (.+?)\s*$", text[: text.find("end_header")], re.MULTILINE)
        return [f"texture {image} is missing" for image in images if not (path.parent / image).is_file()]
    notes = []
    for library in re.findall(r"^\s*mtllib\s+(.+?)\s*$", text, re.MULTILINE):
        beside = path.parent / library
        if not beside.is_file():
            notes.append(f"{library} is missing: its materials are unknown")
            continue
        images = re.findall(r"^\s*map_kd\s+(.+?)\s*$", beside.read_text(errors="replace"), re.MULTILINE | re.IGNORECASE)
        lost = [image for image in dict.fromkeys(images) if not (path.parent / image).is_file()]
        notes += [f"texture {image} of {library} is missing" for image in lost]
    return notes
