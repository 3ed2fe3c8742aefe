"""Files that lights are read from: pictures of skies, and meshes of lamps.

dataset.json names them as seen from its own folder, so that a dataset may be used from anywhere, and moved together with them.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ddprt.config import seen_from
from ddprt.errors import UserError
from ddprt.files import sha256
from ddprt.lights import EnvironmentLight, Lighting, lighting_json

_FILE_OF = {"environment": "image", "mesh": "mesh"}


def kept(lighting: Lighting, folder: Path) -> list[dict[str, Any]]:
    """Records of a lighting for the dataset.json of a folder."""
    return _moved(lighting_json(lighting), lambda path: seen_from(path, folder))


def lit(records: Sequence[dict[str, Any]], folder: Path) -> list[dict[str, Any]]:
    """Records of the dataset.json of a folder as they shine here."""
    return _moved(records, lambda path: seen_from(str(folder / path), Path()))


def pictures(lightings: Sequence[Lighting], folder: Path) -> dict[str, str]:
    """Digests of the files that skies are read from, for dataset.json: a picture that has changed makes another dataset."""
    found = {kept((light,), folder)[0]["image"]: Path(light.image) for light in _skies(lightings)}
    return {name: sha256(path) for name, path in sorted(found.items()) if path.is_file()}


def check_skies(description: dict[str, Any], lightings: Sequence[Lighting], folder: Path) -> None:
    """Makes sure that the skies of a dataset can shine again, and as they did.

    Raises:
      UserError: a file that is missing, or another one than was baked with.
    """
    found, before = pictures(lightings, folder), description.get("skies", {})
    for light in _skies(lightings):
        from ddprt.lights.panorama import stamp  # most datasets have no sky

        stamp(light.image)
        name = kept((light,), folder)[0]["image"]
        if found.get(name) != before.get(name, found.get(name)):
            raise UserError(
                f"environment.image {light.image}: got another picture than the dataset was baked with, expected the same; put "
                "that back, or bake again into another --out"
            )


def _skies(lightings: Sequence[Lighting]) -> list[EnvironmentLight]:
    """One light of each picture."""
    found = {light.image: light for lighting in lightings for light in lighting if isinstance(light, EnvironmentLight)}
    return [found[name] for name in sorted(found)]


def _moved(records: Sequence[dict[str, Any]], move: Callable[[str], str]) -> list[dict[str, Any]]:
    """Records whose files have another name; skies in code and triangles have none."""
    moved = [dict(record) for record in records]
    for record in moved:
        key = _FILE_OF.get(record.get("type", ""), "")
        if isinstance(name := record.get(key), str) and Path(name).suffix:
            record[key] = move(name)
    return moved
