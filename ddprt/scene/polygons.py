"""OBJ, PLY and STL in, by trimesh's parsers but without its clean-up, which would merge, reorder and round.

OBJ: one material per MTL material, or per object and group where there is none. `Kd` is taken as linear, as Blender,
Mitsuba and PBRT do (three.js takes it as sRGB), times the sRGB texture `map_Kd`; `Ke` is emission in W/(m² sr). A surface
whose opacity (`d`, or 1 less `Tr`) is below a half is a hole, as one of glTF is that blends. Colours of vertices and faces are
sRGB. What names no colour, as STL, has albedo 0.8. Files are in metres, Y up.
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
from ddprt.scene.material import Cutout, Emission, Material, plain
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
        uv=np.concatenate([part.uv for part in parts]) if any(entry.textures for entry in materials) else None,
        colour=np.concatenate([_painted(part) for part in parts]) if any(part.colour is not None for part in parts) else None,
        lightmap=np.concatenate([part.uv for part in parts]) if lightmap else None,
        notes=tuple(dict.fromkeys([*notes, *[note for part in parts for note in part.notes]])),
    )


@dataclass
class _Part:
    """One mesh of the file."""

    positions: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    uv: Float[np.ndarray, "vertices 2"]
    colour: Float[np.ndarray, "vertices 3"] | None
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
    said = _picture(visual) is not None or "kd" in _words(visual)
    by_face, colour = (None, None) if said else (_linear(mesh.get("face_colors")), _linear(mesh.get("vertex_colors")))
    if by_face is not None:
        (index, materials, notes), colour = _palette(by_face[owner]), None
    elif colour is not None:
        index, materials, notes = np.zeros(len(faces), np.int64), [Material("colours of vertices", (1.0, 1.0, 1.0))], []
    else:
        material, notes = _material(name, visual)
        index, materials = np.zeros(len(faces), np.int64), [material]
    if kind == "obj" and given is None:
        # An OBJ without normals is faceted, as its viewers show it.
        corner = faces.ravel()
        positions, normals, uv, faces = positions[corner], normals[corner], uv[corner], np.arange(corner.size).reshape(-1, 3)
        colour = None if colour is None else colour[corner]
    return _Part(positions, normals, uv, colour, faces, index, materials, notes)


def _painted(part: _Part) -> Float[np.ndarray, "vertices 3"]:
    return np.ones(part.positions.shape) if part.colour is None else part.colour


def _linear(encoded: Any) -> Float[np.ndarray, "n 3"] | None:
    """Linear colours of those that a file has for its vertices or faces; None where it has none."""
    if encoded is None or not len(encoded):
        return None
    encoded = np.asarray(encoded)[:, :3]
    full = np.iinfo(encoded.dtype).max if encoded.dtype.kind in "iu" else 1.0
    return srgb_to_linear(np.clip(encoded.astype(np.float64) / full, 0.0, 1.0))


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
    notes = [f'ignored in material "{title}": {word}' for word in ("map_ke", "map_d") if word in said]
    emission, cutout, remarks = _glow(title, said), *_hole(title, said)
    notes += remarks
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
    return Material(title, (red, green, blue), texture, cutout=cutout, emission=emission), notes


def _glow(title: str, said: dict[str, Any]) -> Emission | None:
    """What `Ke` sends out; None where it is black or not there."""
    red, green, blue = (float(value) for value in np.broadcast_to(_numbers(title, said, "ke", (1, 3)) or [0.0], 3))
    return Emission((red, green, blue)) if (red, green, blue) != (0.0, 0.0, 0.0) else None


def _hole(title: str, said: dict[str, Any]) -> tuple[Cutout | None, list[str]]:
    """A hole of the whole surface where its opacity is below a half, and what to note of an opacity that is not 1.

    Only where neither says anything else is `Tr` 1 less `d`: programs that write both mean `d`.
    """
    whole, clear = _numbers(title, said, "d", (1,)), _numbers(title, said, "tr", (1,))
    opacity = whole[0] if whole else 1.0 - clear[0] if clear else 1.0
    if opacity == 1.0:
        return None, []
    note = f'material "{title}": opacity {opacity:g} is not simulated; taken as {"a hole" if opacity < 0.5 else "opaque"}'
    return (Cutout(np.full((1, 1), max(opacity, 0.0), np.float32)) if opacity < 0.5 else None), [note]


def _numbers(title: str, said: dict[str, Any], word: str, lengths: tuple[int, ...]) -> list[float]:
    """The numbers after a word of the MTL, empty where it is not there.

    Raises:
      UserError: others than so many, or none that are numbers.
    """
    if word not in said:
        return []
    given = [text for text in np.atleast_1d(said[word]).tolist() if text != "-halo"]
    try:
        numbers = [float(text) for text in given]
    except ValueError:
        numbers = []
    if len(numbers) not in lengths or not np.isfinite(numbers).all():
        expected = " or ".join(map(str, lengths))
        raise UserError(
            f'material "{title}": got {word} {" ".join(map(str, given))}, expected {expected} numbers; mend the MTL'
        )
    return numbers


def _words(visual: Any) -> dict[str, Any]:
    return getattr(getattr(visual, "material", None), "kwargs", None) or {}


def _picture(visual: Any) -> Any:
    """The texture's image; one that was decoded from no file is trimesh's stand-in for a material it does not know."""
    image = getattr(getattr(visual, "material", None), "image", None)
    return None if getattr(image, "format", None) is None else image


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
