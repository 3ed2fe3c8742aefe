"""`load_scene`: a name of the library or a file becomes a checked scene."""

import re
from pathlib import Path

from ddprt.errors import UserError, nearest
from ddprt.scene.library import SCENES, build
from ddprt.scene.mesh import Scene

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")


def load_scene(source: str | Path, **parameters: float | int) -> Scene:
    """A scene by its name in the library, or from a mesh file (metres, Y up).

    Args:
      source: a key of `SCENES`, or a path that ends in .glb, .gltf, .obj, .ply or .stl; a text with a separator or a
        suffix is a path, unless the library has it.
      parameters: numbers that a scene of the library takes.
    Raises:
      UserError: no such scene, parameter, file or format, or a file that is damaged or fails a check.
    """
    path, name = Path(source), str(source)
    if isinstance(source, str) and name in SCENES:
        return build(name, **parameters)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES and isinstance(source, str) and not path.suffix and not re.search(r"[/\\]", name):
        known = ", ".join(sorted(SCENES))
        raise UserError(
            f'no scene "{name}"{nearest(name, SCENES)}; known: {known}, or a path that ends in {", ".join(SUFFIXES)}'
        )
    if suffix not in SUFFIXES:
        raise UserError(f'{path}: got suffix "{path.suffix}", expected {", ".join(SUFFIXES)}; export to glTF')
    try:
        there = path.is_file()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UserError(f"{name[:60]}...: got {why}, expected a path; check it") from None
    if not there:
        raise UserError(f"{path}: got no such file, expected a mesh; check the path")
    if parameters:
        raise UserError(f"{path.name}: got parameter {next(iter(parameters))}, expected none for a file; leave it out")
    # Each reader brings its own library, which a scene in code should not wait for.
    if suffix in (".glb", ".gltf"):
        from ddprt.scene.gltf import load_gltf

        return load_gltf(path)
    from ddprt.scene.polygons import load_polygons

    return load_polygons(path)
