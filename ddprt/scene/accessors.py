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

        Args:
          number: of the accessor.
          width: numbers per row that its type must have.
        """
        accessor = self.entry("accessors", number)
        if accessor.sparse is not None or accessor.bufferView is None:
            raise self.fault("got a sparse accessor, which is not read; export without sparse accessors")
        if _WIDTHS.get(accessor.type) != width:
            raise self.fault(f"got accessor {number} of {accessor.type}, expected {width} numbers; export it again")
        if accessor.componentType not in _TYPES:
            known = ", ".join(map(str, _TYPES))
            raise self.fault(
                f"got accessor {number} of component type {accessor.componentType}, expected one of {known}; export it again"
            )
        kind = np.dtype(_TYPES[accessor.componentType])
        step = self.entry("bufferViews", accessor.bufferView).byteStride or kind.itemsize * width
        shape, strides, start = (accessor.count, width), (step, kind.itemsize), accessor.byteOffset or 0
        data = self.view(accessor.bufferView)
        end = start + (accessor.count - 1) * step + width * kind.itemsize if accessor.count else start
        if not 0 <= start <= end <= len(data):
            raise self.fault(f"got {len(data)} bytes for accessor {number}, expected {end}; it is damaged: export it again")
        rows = np.ndarray(shape, kind, data, start, strides)
        if accessor.normalized:
            return np.maximum(rows / float(np.iinfo(kind).max), -1.0)
        return rows.astype(np.float64)

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
      UserError: the file is shorter than its header says. What else pygltflib meets it raises as it likes.
    """
    data = path.read_bytes()
    if data[:4] != b"glTF":
        return Container(path, pygltflib.GLTF2.from_json(data.decode("utf-8"), infer_missing=True))
    _, length = struct.unpack("<4xII", data[:12])
    if length > len(data):
        raise UserError(f"{path.name}: got {len(data)} bytes, expected {length}; the file is cut short: copy it again")
    return Container(path, pygltflib.GLTF2.load_from_bytes(data))
