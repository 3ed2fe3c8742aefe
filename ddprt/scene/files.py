"""`load_scene`: a name of the library or a file becomes a checked scene."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ddprt.errors import UserError, nearest
from ddprt.scene.fog import Fog
from ddprt.scene.library import SCENES, build
from ddprt.scene.mesh import Scene
from ddprt.scene.sheets import without_backs

EXPECTED = {
    ".glb": "binary glTF 2.0, a JSON chunk and its buffer",
    ".gltf": "glTF 2.0, whole JSON with asset, meshes and accessors",
    ".obj": "OBJ, lines of v x y z and f with three or more vertices",
    ".ply": "PLY, vertices with x, y and z and faces with vertex_indices",
    ".stl": "STL, as many triangles as its head says",
    ".hair": "a .hair file, a header of 128 bytes and its arrays",
    ".strands": "strands as text, see ddprt/scene/strands.py",
}
"""What is read, by suffix, and what a whole file has."""

SUFFIXES = tuple(EXPECTED)

IMPORTED = "imported"
"""The `scene.name` of runs whose light comes from elsewhere."""

_BEYOND = 1e-4  # of the unit square, that rounding may move coordinates out of it


def load_scene(source: str | Path, *, fog: Fog | Mapping[str, Any] | None = None, **parameters: float | int) -> Scene:
    """A scene by its name in the library, or from a mesh file (metres, Y up).

    Args:
      source: a key of `SCENES`, or a path that ends in .glb, .gltf, .obj, .ply or .stl, or in .hair or .strands; a text
        with a separator or a suffix is a path, unless the library has it.
      fog: what fills its bounding box, e.g. {"mean_free_path": 0.5, "albedo": 0.9, "anisotropy": 0.3}; None leaves the air as
        the scene says.
      parameters: numbers that a scene of the library takes; of strands the `scale`, metres of a unit of the file.
    Raises:
      UserError: no such scene, parameter, file or format, a file that is damaged or fails a check, or fog that cannot be.
    """
    air = None if fog is None else Fog.of(fog, "scene.fog")
    scene = _clear(source, parameters)
    return replace(scene, fog=air) if air else scene


def _clear(source: str | Path, parameters: dict[str, float | int], *, lightmap: bool = False) -> Scene:
    path, name = Path(source), str(source)
    if isinstance(source, str) and name in SCENES:
        return build(name, **parameters)
    suffix = path.suffix.lower()
    if name == IMPORTED:
        raise UserError(
            f'scene.name: got "{IMPORTED}", expected a scene: this run holds light that was imported, which `ddprt fit`, '
            "`eval` and `export` work on; what traces light needs a scene of its own"
        )
    if suffix not in SUFFIXES and isinstance(source, str) and not path.suffix and not re.search(r"[/\\]", name):
        known = ", ".join(sorted(SCENES))
        raise UserError(
            f'no scene "{name}"{nearest(name, SCENES)}; known: {known}, or a path that ends in {", ".join(SUFFIXES)}'
        )
    if suffix not in SUFFIXES:
        if path.is_dir():
            raise UserError(f"{path}: got a folder, expected a file that ends in {', '.join(SUFFIXES)}; name one in it")
        raise UserError(f'{path}: got suffix "{path.suffix}", expected {", ".join(SUFFIXES)}; export to glTF')
    try:
        there = path.is_file()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UserError(f"{name[:60]}...: got {why}, expected a path; check it") from None
    if not there:
        counts = "" if path.is_absolute() else f", which counts from {Path.cwd()}"
        raise UserError(f"{path}: got no such file, expected a mesh; check the path{counts}")
    if suffix in (".hair", ".strands") and set(parameters) <= {"scale"}:
        from ddprt.scene.tubes import load_hair

        return load_hair(path, float(parameters.get("scale", 1.0)))
    if parameters:
        raise UserError(f"{path.name}: got parameter {next(iter(parameters))}, expected none for a file; leave it out")
    try:
        return _read(path, suffix, lightmap)
    except UserError:
        raise
    except Exception as problem:  # what a reader's library says of its own insides helps nobody to export again
        raise UserError(
            f"{path.name}: got a damaged file, expected {EXPECTED[suffix]}; export it again, or run with --debug to see "
            "where reading stopped"
        ) from problem


def load_lightmapped(path: Path) -> Scene:
    """A mesh with a `lightmap`: TEXCOORD_1 of glTF, the texture coordinates of an OBJ, whose textures are left out for it.

    Raises:
      UserError: missing, damaged, of a format without such coordinates, without them, or outside of the unit square.
    """
    suffix = path.suffix.lower()
    if suffix not in (".glb", ".gltf", ".obj"):
        raise UserError(f'{path}: got suffix "{path.suffix}", expected .glb, .gltf or .obj, which have lightmap coordinates')
    scene = without_backs(_clear(path, {}, lightmap=True))
    if scene.lightmap is None:
        raise UserError(f"{path.name}: got no TEXCOORD_1, expected coordinates of the lightmap; unwrap it, and export them")
    used = scene.lightmap[scene.triangles]
    if not (used >= -_BEYOND).all() or not (used <= 1 + _BEYOND).all() or not used.any():
        raise UserError(
            f"{path.name}: got lightmap coordinates from {used.min():.3g} to {used.max():.3g}, expected 0 to 1; unwrap it anew"
        )
    return scene


def _read(path: Path, suffix: str, lightmap: bool) -> Scene:
    # Each reader brings its own library, which a scene in code should not wait for.
    if suffix in (".glb", ".gltf"):
        from ddprt.scene.gltf import load_gltf

        return load_gltf(path)
    from ddprt.scene.polygons import load_polygons

    if suffix == ".obj":
        _check_corners(path)
    return load_polygons(path, lightmap=lightmap and suffix == ".obj")


def _check_corners(path: Path) -> None:
    """Makes sure that the faces of an OBJ name vertices that there are; trimesh would take 0 for the last one."""
    data = path.read_bytes()
    count = len(re.findall(rb"^[ \t]*v[ \t]", data, re.MULTILINE))
    faces = b"\n".join(re.findall(rb"^[ \t]*f([ \t][^#\r\n]*)", data, re.MULTILINE))
    wrong = [index for index in map(int, re.findall(rb"(?<=\s)-?\d+", faces)) if not 0 < abs(index) <= count]
    if wrong:
        raise UserError(
            f"{path.name}: got a face with vertex {wrong[0]} ({len(wrong)} out of range), expected vertex indices from 1 to "
            f"{count}; export it again"
        )
