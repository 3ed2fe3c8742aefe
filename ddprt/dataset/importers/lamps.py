"""Tables of lights: which lamps shone in which picture.

JSON is ddprt's own list; an entry may also be {"name": .., "split": .., "lights": [..]}. In a CSV a row is a light:

    name        of the lighting; rows of one name are on together. Without it a row is a lighting, in the order of pictures
    split       train, validation or test; of all lightings or of none
    type        point, spot, directional, rect, sphere, environment or mesh
    x y z       position, or centre; metres
    dx dy dz    direction that light travels in
    r g b       intensity (W/sr), irradiance (W/m²) or radiance (W/(m² sr)), as the type has it
    ux uy uz, vx vy vz    half axes of a rectangle
    radius, inner_deg, outer_deg, image, rotation_deg, scale, mesh    as in JSON
"""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ddprt.dataset.splits import SPLITS
from ddprt.errors import UserError, nearest
from ddprt.lights import LIGHTS, Lighting, parse_lighting

_VECTORS = {
    "position": ("x", "y", "z"),
    "center": ("x", "y", "z"),
    "direction": ("dx", "dy", "dz"),
    "half_u": ("ux", "uy", "uz"),
    "half_v": ("vx", "vy", "vz"),
    **dict.fromkeys(("intensity", "irradiance", "radiance"), ("r", "g", "b")),
}
_PLAIN = ("radius", "inner_deg", "outer_deg", "image", "rotation_deg", "scale", "mesh")
_WORDS = ("image", "mesh")
COLUMNS = ("name", "split", "type", *dict.fromkeys(c for columns in _VECTORS.values() for c in columns), *_PLAIN)


@dataclass(frozen=True)
class Row:
    """One lighting of a table.

    Attributes:
      name: of the lighting; "" where the table has no names.
      split: "" where the table has none.
      lighting: its lights.
    """

    name: str
    split: str
    lighting: Lighting


def read_table(path: Path) -> list[Row]:
    """Lightings of a table of lights.

    Raises:
      UserError: missing, of another format, or a faulty row.
    """
    if path.suffix.lower() not in (".csv", ".json"):
        raise UserError(f'{path}: got suffix "{path.suffix}", expected .csv, .json or .lp; write one of these')
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: got {error}, expected a readable table of lights; check the path") from None
    rows = _json(path, text) if path.suffix.lower() == ".json" else _csv(path, text)
    if not rows:
        raise UserError(f"{path}: got no lighting, expected one for each picture; fill the table")
    wrong = next((row.split for row in rows if row.split and row.split not in SPLITS), None)
    if wrong is not None:
        raise UserError(f'{path}: got split "{wrong}", expected {", ".join(SPLITS)}{nearest(wrong, SPLITS) or "; mend it"}')
    if len({bool(row.split) for row in rows}) > 1:
        raise UserError(f"{path}: got a split for some lightings alone, expected it for all or for none; fill or empty it")
    names = [row.name for row in rows if row.name]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f'{path}: got "{twice}" twice, expected each name once; mend it')
    return rows


def match(rows: Sequence[Row], keys: Sequence[str], where: str) -> list[Row]:
    """The lighting of each picture: by name where the table has names, else in order.

    Args:
      rows: of the table.
      keys: names of the lightings, from those of the files.
      where: named in messages.
    Raises:
      UserError: fewer or more lightings than pictures, or a picture that the table does not name.
    """
    if all(row.name for row in rows):
        table = {row.name: row for row in rows}
        missing = [key for key in keys if key not in table]
        if missing:
            raise UserError(
                f'{where}: got no lights for picture "{missing[0]}" ({len(missing)} lack them), expected a row for each; '
                "names are what the star of the pattern stands for"
            )
        return [table[key] for key in keys]
    if len(rows) != len(keys):
        raise UserError(
            f"{where}: got {len(rows)} lightings for {len(keys)} pictures, expected as many; add rows, or give both names"
        )
    return list(rows)


def _json(path: Path, text: str) -> list[Row]:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: got text that is not JSON ({error}), expected a list of lightings; mend it") from None
    entries = document.get("lightings") if isinstance(document, dict) else document
    if not isinstance(entries, list):
        raise UserError(f"{path}: got {type(document).__name__}, expected a list of lightings; mend it")
    rows = []
    for index, entry in enumerate(entries):
        named = isinstance(entry, dict) and "lights" in entry
        lights = entry["lights"] if named else entry
        lighting = parse_lighting(lights, f"{path}[{index}]")
        rows.append(Row(str(entry.get("name", "")), str(entry.get("split", "")), lighting) if named else Row("", "", lighting))
    return rows


def _csv(path: Path, text: str) -> list[Row]:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    table = csv.reader(lines)
    heads = [head.strip() for head in next(table, [])]
    for head in heads:
        if head not in COLUMNS:
            raise UserError(f'{path}: got column "{head}", expected columns among {", ".join(COLUMNS)}{nearest(head, COLUMNS)}')
    if "type" not in heads:
        raise UserError(f"{path}: got no column type, expected a header such as name,type,x,y,z,r,g,b; add it")
    found: dict[str, tuple[str, list[Mapping[str, Any]]]] = {}
    for number, cells in enumerate(table, 1):
        if len(cells) != len(heads):
            raise UserError(f"{path}: got {len(cells)} cells in row {number}, expected {len(heads)}; mend the row")
        row = {head: cell.strip() for head, cell in zip(heads, cells, strict=True) if cell.strip()}
        key = row.get("name", f"\0{number}")
        split, lights = found.setdefault(key, (row.get("split", ""), []))
        if row.get("split", "") != split:
            raise UserError(f'{path}: got "{key}" in two splits, expected one; mend row {number}')
        lights.append(_light(path, number, row))
    return [
        Row("" if key.startswith("\0") else key, split, parse_lighting(lights, f"{path}: lighting {index}"))
        for index, (key, (split, lights)) in enumerate(found.items())
    ]


def _light(path: Path, number: int, row: Mapping[str, str]) -> dict[str, Any]:
    kind = row.get("type", "")
    if kind not in list(LIGHTS):
        hint = nearest(kind, LIGHTS) or "; mend it"
        raise UserError(f'{path}: got type "{kind}" in row {number}, expected one of {", ".join(sorted(LIGHTS))}{hint}')
    fields = LIGHTS[kind].model_fields  # type: ignore[attr-defined]
    used, light = {"name", "split", "type"}, dict[str, Any](type=kind)
    for field, columns in _VECTORS.items():
        if field in fields and any(column in row for column in columns):
            light[field] = [_number(path, number, column, row.get(column, "0")) for column in columns]
            used.update(columns)
    for field in _PLAIN:
        if field in fields and field in row:
            light[field] = row[field] if field in _WORDS else _number(path, number, field, row[field])
            used.add(field)
    idle = [column for column in row if column not in used]
    if idle:
        raise UserError(f"{path}: got {idle[0]} in row {number}, which a {kind} light has not; leave the cell empty")
    return light


def _number(path: Path, row: int, column: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UserError(f'{path}: got {column} "{text}" in row {row}, expected a number; mend it') from None
