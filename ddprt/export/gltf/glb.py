"""A .glb in the making: JSON and one buffer, nothing of what it shows."""

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ddprt.export.formats.png import png_bytes

_CODES = {"<f4": 5126, "<u4": 5125}
_WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


@dataclass
class Glb:
    """A file that is appended to; `document` is what its JSON says."""

    document: dict[str, Any] = field(default_factory=lambda: {"asset": {"version": "2.0"}})
    data: bytearray = field(default_factory=bytearray)

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Puts an entry into one of the document's lists and tells its number."""
        entries = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def extension(self, name: str) -> None:
        """Says that the file has an extension in use."""
        used = self.document.setdefault("extensionsUsed", [])
        if name not in used:
            used.append(name)

    def accessor(self, rows: np.ndarray, kind: str = "<f4", *, bounds: bool = False) -> int:
        """Rows of 1, 2 or 3 numbers, of which POSITION must tell its bounds."""
        rows = np.ascontiguousarray(rows, kind).reshape(len(rows), -1)
        entry: dict[str, Any] = {
            "bufferView": self._view(rows.tobytes()),
            "componentType": _CODES[kind],
            "count": len(rows),
            "type": _WIDTHS[rows.shape[1]],
        }
        if bounds:
            entry |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        return self.add("accessors", entry)

    def texture(self, image: np.ndarray) -> int:
        """A texture of (height, width, 3 or 4) bytes, repeated and filtered, as glTF has them by itself."""
        image_number = self.add("images", {"bufferView": self._view(png_bytes(image)), "mimeType": "image/png"})
        return self.add("textures", {"source": image_number})

    def _view(self, data: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)})

    def to_bytes(self) -> bytes:
        """The file."""
        data = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        text = json.dumps(self.document | {"buffers": [{"byteLength": len(data)}]}, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [(_JSON, text), (_BINARY, data)]
        body = b"".join(struct.pack("<II", len(part), kind) + part for kind, part in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
