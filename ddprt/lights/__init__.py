"""What moves: lights, and lightings (lists of lights that are on together).

Enters: JSON or Python records, pictures of skies. Leaves: irradiance, direction and distance for any point, never knowing
what stands in between. Geometry, rays and randomness never enter; random numbers come in as arguments.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from ddprt.catalogue import Catalogue
from ddprt.errors import UserError, explain, nearest, spoken
from ddprt.lights.area import RectLight, SphereLight
from ddprt.lights.distant import DirectionalLight
from ddprt.lights.environment import EnvironmentLight
from ddprt.lights.light import Light
from ddprt.lights.mesh import MeshLight
from ddprt.lights.point import PointLight, SpotLight

LIGHTS: Catalogue[type] = Catalogue(
    "light type",
    {
        light.kind: light
        for light in (PointLight, SpotLight, DirectionalLight, RectLight, SphereLight, EnvironmentLight, MeshLight)
    },
)
Units = Literal["photometric", "radiometric"]
Lighting = tuple[Light, ...]
"""Lights that are on together."""

_EXAMPLE = '[{"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]}]'
_ADAPTER: TypeAdapter[Any] = TypeAdapter(
    tuple[
        Annotated[
            PointLight | SpotLight | DirectionalLight | RectLight | SphereLight | EnvironmentLight | MeshLight,
            Field(discriminator="type"),
        ],
        ...,
    ]
)


def parse_lighting(records: Any, where: str = "lighting") -> Lighting:
    """A lighting from JSON-like records, from lights, or from one of either.

    Args:
      records: a light, a dict, or a sequence of them.
      where: named in messages.
    Raises:
      UserError: unknown type, missing or unknown key, wrong type or range.
    """
    if isinstance(records, (dict, *LIGHTS.values())):
        records = [records]
    if not isinstance(records, list | tuple):
        raise UserError(
            f"{where}: got {type(records).__name__}, expected a light or a list of lights; write {_EXAMPLE} or the like"
        )
    if len(records) == 0:
        raise UserError(f"{where}: got no light, expected at least one; write {_EXAMPLE} or the like")
    for index, record in enumerate(records):
        if isinstance(record, tuple(LIGHTS.values())):
            continue
        if not isinstance(record, dict):
            raise UserError(f"{where}[{index}]: got {record!r}, expected a light; write {_EXAMPLE} or the like")
        kind = record.get("type")
        if kind not in list(LIGHTS):
            hint = nearest(str(kind), LIGHTS) or "; choose one"
            raise UserError(f"{where}[{index}].type: got {kind!r}, expected one of {', '.join(sorted(LIGHTS))}{hint}")
    try:
        return tuple(_ADAPTER.validate_python(tuple(records)))
    except ValidationError as error:
        raise UserError(_fault(error.errors()[0], where)) from None


def _fault(fault: Any, where: str) -> str:
    """A fault of pydantic in one line, as those of the configuration are told."""
    index, kind, *inner = fault["loc"]
    key, text = spoken(fault)
    short = fault["type"] == "missing" and isinstance(inner[-1], int)  # of an entry: told with the list that lacks it
    parts = [*inner[: len(inner) - short], *([key] if key else [])]
    place = f"{where}[{index}]" + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts)
    known = ", ".join(LIGHTS[kind].model_fields)  # type: ignore[attr-defined]
    if fault["type"] == "extra_forbidden":
        return f"{place}: unknown key{nearest(inner[-1], LIGHTS[kind].model_fields)}; known here: {known}"  # type: ignore[attr-defined]
    if fault["type"] == "missing" and not short:
        return f"{place}: got none, expected it among {known}; add it"
    return f"{place}: {text or explain([fault], [0, 1, 0])}"


def scene_lights(path: str | Path, units: Units = "photometric") -> Lighting:
    """The lights of a glTF file, all on together, as its author sees them; see `ddprt.lights.gltf`.

    Args:
      path: a .glb or .gltf with KHR_lights_punctual.
      units: "photometric": candela and lux, by 683 lm a watt; "radiometric": W/sr and W/m² as they stand.
    Raises:
      UserError: missing, damaged, without lights, or a faulty light.
    """
    from ddprt.lights.gltf import light_records  # brings a reader of glTF

    return parse_lighting(light_records(Path(path), units), f"{path}: lights")


def load_lightings(path: str | Path, units: Units = "photometric") -> list[Lighting]:
    """Reads a JSON list of lightings (each a list of lights), or a glTF file, of which each light is a lighting.

    Args:
      path: of either.
      units: of a glTF file's lights; see `scene_lights`.
    Raises:
      UserError: missing, not JSON, empty, or a faulty light.
    """
    if Path(path).suffix.lower() in (".glb", ".gltf"):
        return [(light,) for light in scene_lights(path, units)]
    try:
        document = json.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"{path}: got {why}, expected a readable JSON list of lightings; check the path") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: got text that is not JSON ({error}), expected a list of lightings; mend it") from None
    if not isinstance(document, list) or not document:
        got = "an empty list" if document == [] else type(document).__name__
        raise UserError(f"{path}: got {got}, expected a list of lightings; write [{_EXAMPLE}] or the like")
    return [parse_lighting(entry, f"{path}[{index}]") for index, entry in enumerate(document)]


def lighting_json(lighting: Lighting) -> list[dict[str, Any]]:
    """JSON-ready records of a lighting."""
    return [light.model_dump(mode="json") for light in lighting]  # type: ignore[attr-defined]


__all__ = [
    "LIGHTS",
    "DirectionalLight",
    "EnvironmentLight",
    "Light",
    "Lighting",
    "MeshLight",
    "PointLight",
    "RectLight",
    "SphereLight",
    "SpotLight",
    "lighting_json",
    "load_lightings",
    "parse_lighting",
    "scene_lights",
]
