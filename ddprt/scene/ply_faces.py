"""A PLY's polygons as triangles, for a reader that wants faces of one size; what else a face has goes with its pieces."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.errors import UserError
from ddprt.scene.cutting import cut_polygons, notes_on

_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_KINDS |= {f"{name}{8 * size}": f"{name[0]}{size}" for name in ("int", "uint", "float") for size in (1, 2, 4, 8)}
_NAMES = {kind: name for name, kind in reversed(_KINDS.items())}
_INDICES = ("vertex_indices", "vertex_index")
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """A list of the file: the types of its properties, and of the count before those that are lists."""

    name: str
    count: int
    kinds: dict[str, str] = field(default_factory=dict)
    lengths: dict[str, str] = field(default_factory=dict)


@dataclass
class _Source:
    """What stands after the head: words, or bytes in an order."""

    data: Any
    order: str
    place: int = 0

    def take(self, kind: str, count: int) -> np.ndarray:
        """The next numbers; ValueError where there are fewer."""
        if not self.order:
            found = self.data[self.place : self.place + count]
            if len(found) < count:
                raise ValueError("cut short")
            self.place += count
            return found
        kinds = np.dtype(self.order + kind)
        found = np.frombuffer(self.data, kinds, count, self.place) if count else np.zeros(0, kinds)
        self.place += found.nbytes
        return found

    def rows(self, element: _Element) -> dict[str, Any]:
        """Values of each property: an array, or a list of arrays."""
        start = self.place
        first = {name: len(self.list(element, name)) for name in element.kinds} if element.count else {}
        self.place = start
        alike = self._alike(element, first)
        if alike is not None:
            return alike
        self.place = start
        found: dict[str, Any] = {name: [] for name in element.kinds}
        for _ in range(element.count):
            for name in element.kinds:
                found[name].append(self.list(element, name))
        return {name: rows if name in element.lengths else np.concatenate(rows) for name, rows in found.items()}

    def list(self, element: _Element, name: str) -> np.ndarray:
        """The next value of a property, as a list of one where it is none."""
        count = int(self.take(element.lengths[name], 1)[0]) if name in element.lengths else 1
        return self.take(element.kinds[name], count)

    def _alike(self, element: _Element, sizes: dict[str, int]) -> dict[str, Any] | None:
        """The same at once where all rows have lists as long as the first one's; else None."""
        fields = []
        for name, size in sizes.items():
            fields += [(f"count of {name}", element.lengths[name], 1)] if name in element.lengths else []
            fields.append((name, element.kinds[name], size))
        if self.order:
            kinds = np.dtype([(name, self.order + kind, (size,)) for name, kind, size in fields])
            if element.count * kinds.itemsize > len(self.data) - self.place:
                return None
            table = np.frombuffer(self.data, kinds, element.count, self.place)
            found = {name: table[name] for name, _, _ in fields}
            self.place += table.nbytes
        else:
            widths = [size for _, _, size in fields]
            words = self.data[self.place : self.place + element.count * sum(widths)]
            if len(words) < element.count * sum(widths):
                return None
            parts = np.split(words.reshape(element.count, sum(widths)), np.cumsum(widths)[:-1], axis=1) if widths else []
            found = {name: part for (name, _, _), part in zip(fields, parts, strict=True)}
            self.place += len(words)
        if any((found[f"count of {name}"] != size).any() for name, size in sizes.items() if name in element.lengths):
            return None
        return {name: found[name] if name in element.lengths else found[name][:, 0] for name in sizes}


def with_triangles(path: Path, data: bytes) -> tuple[bytes, list[str]]:
    """The file with polygons cut, and what to note of them; as it stands if it has triangles alone, or quads that halve.

    Raises:
      UserError: a face with a vertex that is not there. What else a damaged file leads to is raised as it comes.
    """
    end = re.search(rb"^end_header[ \t]*\r?\n", data, re.MULTILINE)
    if end is None:
        return data, []
    order, elements, comments = _head(data[: end.start()].decode(errors="replace"))
    known = {element.name: element for element in elements}
    vertex, face = known.get("vertex"), known.get("face")
    named = next((name for name in _INDICES if face and name in face.lengths), None)
    if vertex is None or face is None or named is None or not face.count:
        return data, []
    body = data[end.end() :]
    source = _Source(body if order else np.array(body.split(), dtype=np.float64), order)
    rows = {element.name: source.rows(element) for element in elements}
    index = rows["face"][named]
    sizes = np.array([len(row) for row in index], np.int64)
    if (sizes == 3).all():
        return data, []
    every = np.concatenate([*index]).astype(np.int64)
    if (beyond := every[(every < 0) | (every >= vertex.count)]).size:
        expected = f"vertex indices from 0 to {vertex.count - 1}"
        raise UserError(f"{path.stem}: got a face with vertex {beyond[0]}, expected {expected}; export it again")
    corners = np.stack([rows["vertex"][axis] for axis in "xyz"], 1).astype(np.float64)[every]
    cut = cut_polygons(corners, sizes)
    if (sizes == 4).all() and cut.fans.all():
        return data, []
    if source.place != len(source.data):
        raise ValueError("more than the head says")
    columns: dict[str, np.ndarray] = {named: every[cut.triangles].astype("<i4")}
    for name, kind in face.kinds.items():
        if name not in face.lengths:
            columns[name] = np.asarray(rows["face"][name])[cut.owner].astype("<" + kind)
        elif name != named and all(len(row) == 2 * size for row, size in zip(rows["face"][name], sizes, strict=True)):
            pairs = np.concatenate([*rows["face"][name]]).reshape(-1, 2)  # texture coordinates at corners
            columns[name] = pairs[cut.triangles].reshape(-1, 6).astype("<" + kind)
    single = {
        name: rows["vertex"][name].astype("<" + kind) for name, kind in vertex.kinds.items() if name not in vertex.lengths
    }
    parts = [_written("vertex", single), _written("face", columns)]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *comments,
        *(line for lines, _ in parts for line in lines),
        "end_header",
        "",
    ]
    return "\n".join(head).encode() + b"".join(rest for _, rest in parts), notes_on(cut, corners, sizes)


def _head(text: str) -> tuple[str, list[_Element], list[str]]:
    """Order of bytes, "" for words; the elements; the lines of comments."""
    order, elements, comments = "", list[_Element](), []
    for line in text.splitlines():
        match line.split():
            case ["format", name, *_]:
                order = _ORDERS[name]
            case ["comment", *_]:
                comments.append(line)
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name]:
                elements[-1].kinds[name], elements[-1].lengths[name] = _KINDS[kind], _KINDS[length]
            case ["property", kind, name]:
                elements[-1].kinds[name] = _KINDS[kind]
    return order, elements, comments


def _written(name: str, columns: dict[str, np.ndarray]) -> tuple[list[str], bytes]:
    """Lines of the head for an element, and its rows."""
    fields, values = list[Any](), []
    lines = [f"element {name} {len(next(iter(columns.values())))}"]
    for title, column in columns.items():
        kind = column.dtype.str[1:]
        if column.ndim == 2:
            lines.append(f"property list uchar {_NAMES[kind]} {title}")
            fields.append((f"count of {title}", "u1", (1,)))
            values.append(np.full((len(column), 1), column.shape[1]))
            fields.append((title, "<" + kind, column.shape[1:]))
        else:
            lines.append(f"property {_NAMES[kind]} {title}")
            fields.append((title, "<" + kind))
        values.append(column)
    table = np.zeros(len(values[0]), np.dtype(fields))
    for entry, column in zip(fields, values, strict=True):
        table[entry[0]] = column
    return lines, table.tobytes()
