"""What moves: lights, and lightings (lists of lights that are on together).

Enters: JSON or Python records. Leaves: irradiance, direction and distance for any point, never knowing what stands in
between. Geometry, rays and randomness never enter; random numbers come in as arguments.
"""

import json
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from ddprt.catalogue import Catalogue
from ddprt.errors import UserError, nearest
from ddprt.lights.area import RectLight, SphereLight
from ddprt.lights.distant import DirectionalLight
from ddprt.lights.light import Light
from ddprt.lights.point import PointLight, SpotLight

LIGHTS: Catalogue[type] = Catalogue(
    "light type",
    {light.kind: light for light in (PointLight, SpotLight, DirectionalLight, RectLight, SphereLight)},
)
Lighting = tuple[Light, ...]
"""Lights that are on together."""

_ADAPTER: TypeAdapter[Any] = TypeAdapter(
    tuple[Annotated[PointLight | SpotLight | DirectionalLight | RectLight | SphereLight, Field(discriminator="type")], ...]
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
        raise UserError(f"{where}: got {type(records).__name__}, expected a light or a list of lights")
    if len(records) == 0:
        raise UserError(f"{where}: got no light, expected at least one")
    for index, record in enumerate(records):
        if isinstance(record, dict) and record.get("type") not in list(LIGHTS):
            hint = nearest(str(record.get("type")), LIGHTS)
            raise UserError(
                f"{where}[{index}].type: got {record.get('type')!r}, expected one of {', '.join(sorted(LIGHTS))}{hint}"
            )
    try:
        return tuple(_ADAPTER.validate_python(tuple(records)))
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(str(part) for part in fault["loc"] if part not in LIGHTS)
        got = "" if fault["type"] in ("missing", "value_error") else f" got {fault['input']!r},"
        raise UserError(f"{where}.{place}:{got} {fault['msg'].removeprefix('Value error, ')}") from None


def load_lightings(path: str | Path) -> list[Lighting]:
    """Reads a JSON list of lightings (each a list of lights).

    Raises:
      UserError: missing, not JSON, empty, or a faulty light.
    """
    try:
        document = json.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise UserError(f"{path}: got {error.strerror or error}, expected a readable JSON list of lightings") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not JSON: {error}") from None
    if not isinstance(document, list) or not document:
        raise UserError(f"{path}: got {'an empty list' if document == [] else type(document).__name__}, expected lightings")
    return [parse_lighting(entry, f"{path}[{index}]") for index, entry in enumerate(document)]


def lighting_json(lighting: Lighting) -> list[dict[str, Any]]:
    """JSON-ready records of a lighting."""
    return [light.model_dump(mode="json") for light in lighting]  # type: ignore[attr-defined]


__all__ = [
    "LIGHTS",
    "DirectionalLight",
    "Light",
    "Lighting",
    "PointLight",
    "RectLight",
    "SphereLight",
    "SpotLight",
    "lighting_json",
    "load_lightings",
    "parse_lighting",
]
