"""The bytes behind a glTF file: its JSON, buffers and accessors, at full precision."""

import base64
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pygltflib

from ddprt.axes import Float64
from ddprt.errors import UserError

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_EMPTY = 1 << 22
"""Rows of an accessor that no bytes stand behind: a count alone must not fill the memory."""


@dataclass(frozen=True)
class Container:
    """A glTF file whose parts are read when asked for. Every method raises UserError where the file is cut short.

    Attributes:
      path: where it lies; buffers and images of a .gltf are looked for beside it.
      json: what it says, as pygltflib's object.
    """

    path: Path
    json: Any
    _buffers: dict[int, bytes] = field(default_factory=dict, repr=False)

    def fault(self, message: str) -> UserError:
        """The error to raise, with the file's name in front."""
        return UserError(f"{self.path.name}: {message}")

    def entry(self, kind: str, number: int) -> Any:
        """An entry of one of the file's lists, such as "accessors"."""
        entries = getattr(self.json, kind) or []
        if not 0 <= number < len(entries):
            raise self.fault(f"got number {number} among {kind}, expected one of the {len(entries)} there are; export it again")
        return entries[number]

    def accessor(self, number: int, width: int) -> Float64[np.ndarray, "count width"]:
        """Rows of an accessor: strides are followed, normalised integers become -1 to 1, other integers stay exact.

        Sparse accessors are filled in.

        Args:
          number: of the accessor.
          width: numbers per row that its type must have.
        """
        accessor = self.entry("accessors", number)
        if _WIDTHS.get(accessor.type) != width:
            raise self.fault(f"got accessor {number} of {accessor.type}, expected {width} numbers; export it again")
        kind = self._kind(number, accessor.componentType)
        if not isinstance(accessor.count, int) or accessor.count < 0:
            raise self.fault(f"got {accessor.count} rows in accessor {number}, expected a count; export it again")
        if accessor.bufferView is None:
            rows = self._zeros(number, accessor, kind, width)
        else:
            rows = self._rows(number, accessor.bufferView, accessor.byteOffset, kind, (accessor.count, width))
        if accessor.sparse is not None:
            rows = self._replaced(number, accessor, rows)
        if accessor.normalized and kind.kind in "iu":
            return np.maximum(rows / float(np.iinfo(kind).max), -1.0)
        return rows.astype(np.float64)

    def width(self, number: int) -> int:
        """Numbers per row of an accessor; 0 for a type that is no row, such as a matrix."""
        return _WIDTHS.get(self.entry("accessors", number).type, 0)

    def _kind(self, number: int, component: int) -> np.dtype:
        if component not in _TYPES:
            known = ", ".join(map(str, _TYPES))
            raise self.fault(f"got accessor {number} of component type {component}, expected one of {known}; export it again")
        return np.dtype(_TYPES[component])

    def _zeros(self, number: int, accessor: Any, kind: np.dtype, width: int) -> np.ndarray:
        """What an accessor without bytes of its own holds before sparse rows are put in."""
        if accessor.sparse is None:
            raise self.fault(f"got accessor {number} without a buffer view, expected its bytes; export it again")
        if accessor.count > _EMPTY:
            raise self.fault(
                f"got accessor {number} of {accessor.count} rows without a buffer view, expected at most {_EMPTY}; export "
                "without sparse accessors"
            )
        return np.zeros((accessor.count, width), kind)

    def _rows(self, number: int, view: int, offset: int | None, kind: np.dtype, shape: tuple[int, int]) -> np.ndarray:
        """Rows as they lie in a buffer view, without a copy."""
        count, width = shape
        entry = self.entry("bufferViews", view)
        least, data, start = kind.itemsize * width, self.view(view), offset or 0
        step = least if entry.byteStride is None else entry.byteStride
        if step < least or step % kind.itemsize:
            raise self.fault(
                f"got byteStride {step} of buffer view {view} for rows of {least} bytes (accessor {number}), expected as many "
                f"or more, in steps of {kind.itemsize}; export it again"
            )
        if (start + (entry.byteOffset or 0)) % kind.itemsize or start % kind.itemsize:
            raise self.fault(
                f"got byteOffset {start} of accessor {number} in buffer view {view} at {entry.byteOffset or 0}, expected both "
                f"together, and the accessor's own, in steps of the {kind.itemsize} bytes of its numbers; export it again"
            )
        end = start + (count - 1) * step + width * kind.itemsize if count else start
        if not 0 <= start <= end <= len(data):
            raise self.fault(f"got {len(data)} bytes for accessor {number}, expected {end}; it is damaged: export it again")
        return np.ndarray(shape, kind, data, start, (step, kind.itemsize))

    def _replaced(self, number: int, accessor: Any, rows: np.ndarray) -> np.ndarray:
        """The rows with those in their places that a sparse accessor lists."""
        sparse = accessor.sparse
        if not (sparse.count and sparse.indices and sparse.values) or sparse.count > len(rows):
            raise self.fault(
                f"got sparse accessor {number} of {sparse.count} rows without indices, values or as many rows to replace, "
                f"expected 1 to {len(rows)} with both; export without sparse accessors"
            )
        of_index, of_value = sparse.indices, sparse.values
        kind = self._kind(number, of_index.componentType)
        where = self._rows(number, of_index.bufferView, of_index.byteOffset, kind, (sparse.count, 1))[:, 0].astype(np.int64)
        if not ((where >= 0) & (where < len(rows))).all():
            raise self.fault(
                f"got row {where.max()} in sparse accessor {number}, expected 0 to {len(rows) - 1}; export it again"
            )
        replaced = rows.copy()
        shape = (sparse.count, rows.shape[1])
        replaced[where] = self._rows(number, of_value.bufferView, of_value.byteOffset, rows.dtype, shape)
        return replaced

    def view(self, number: int) -> memoryview:
        """The bytes of a buffer view."""
        view = self.entry("bufferViews", number)
        buffer, start = self._buffer(view.buffer), view.byteOffset or 0
        end = start + view.byteLength
        if not 0 <= start <= end <= len(buffer):
            raise self.fault(f"got a buffer of {len(buffer)} bytes, expected {end}; it is cut short: copy it again")
        return memoryview(buffer)[start:end]

    def uri(self, uri: str) -> bytes:
        """The bytes of a data URI or of a file beside this one."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        beside = self.path.parent / unquote(uri)
        if not beside.is_file():
            raise self.fault(f'got no "{uri}" beside it, expected that file; copy it along or export as .glb')
        return beside.read_bytes()

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            uri = self.entry("buffers", number).uri
            data = self.json.binary_blob() if uri is None else self.uri(uri)
            if data is None:
                raise self.fault(f"got no data for buffer {number}, expected some; it is cut short: copy it again")
            self._buffers[number] = data
        return self._buffers[number]


def open_gltf(path: Path) -> Container:
    """Read the JSON of a .glb (known by its first four bytes) or a .gltf.

    Raises:
      UserError: the file is shorter than its header says, or of another version. What else it meets is raised as it comes.
    """
    data = path.read_bytes()
    if data[:4] != b"glTF":
        return _of_version_2(Container(path, pygltflib.GLTF2.from_json(data.decode("utf-8"), infer_missing=True)))
    _, length = struct.unpack("<4xII", data[:12])
    if length > len(data):
        raise UserError(f"{path.name}: got {len(data)} bytes, expected {length}; the file is cut short: copy it again")
    return _of_version_2(Container(path, pygltflib.GLTF2.load_from_bytes(data)))


def _of_version_2(file: Container) -> Container:
    asset = file.json.asset
    version, least = (str(getattr(asset, name, None) or "2.0") for name in ("version", "minVersion"))
    if version.partition(".")[0] != "2" or least not in ("2", "2.0"):
        told = version if version.partition(".")[0] != "2" else f"{version} that asks for {least}"
        raise file.fault(f"got glTF of version {told}, expected 2.0; export it again as glTF 2.0")
    return file
