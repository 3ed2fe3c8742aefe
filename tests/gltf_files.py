"""glTF files made in tests, byte by byte, by no reader's library."""

import base64
import io
import json
from pathlib import Path

import numpy as np
import pygltflib
from PIL import Image

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FACING = np.array([[0.0, 0, 1]] * 3)
PICTURE = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[0, 0, 0], [188, 188, 188], [255, 255, 255]]], np.uint8)
QUAD = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
_CODES = {"|i1": 5120, "|u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}


def png(pixels: np.ndarray = PICTURE) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(stream, "PNG")
    return stream.getvalue()


class Writer:
    """A glTF document in the making; attributes are appended to one buffer."""

    def __init__(self) -> None:
        self.json: dict = {"asset": {"version": "2.0"}, "scenes": [{"nodes": []}]}
        self.json |= {name: [] for name in ("accessors", "bufferViews", "meshes", "nodes")}
        self.data = b""

    def view(self, data: bytes, **more: int) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, rows: np.ndarray, kind: str = "<f4", **more: object) -> int:
        rows = np.asarray(rows).astype(kind)
        width = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[1 if rows.ndim == 1 else rows.shape[1]]
        view = self.view(rows.tobytes())
        entry = {"bufferView": view, "componentType": _CODES[rows.dtype.str], "count": len(rows), "type": width}
        self.json["accessors"].append({**entry, **more})
        return len(self.json["accessors"]) - 1

    def mesh(
        self, *, normals: bool = True, indices: str | None = "<u2", positions: np.ndarray = TRIANGLE, **primitive: object
    ) -> int:
        attributes = {"POSITION": self.accessor(positions), **dict(primitive.pop("attributes", {}))}  # type: ignore[call-overload]
        if normals:
            attributes["NORMAL"] = self.accessor(FACING)
        if indices:
            primitive["indices"] = self.accessor(np.arange(len(positions)), indices)
        return self.plain_mesh({"attributes": attributes, **primitive})

    def plain_mesh(self, *primitives: dict) -> int:
        self.json["meshes"].append({"primitives": list(primitives)})
        return len(self.json["meshes"]) - 1

    def quad(self, index: object = HALVES, kind: str = "<u2", **more: object) -> int:
        """A mesh of a rectangle; attributes by name, other words go to the primitive."""
        attributes = {name: more.pop(name) for name in list(more) if name.isupper()}
        attributes = {"POSITION": self.accessor(QUAD), "NORMAL": self.accessor(np.array([[0.0, 0, 1]] * 4)), **attributes}
        indices = {} if index is None else {"indices": self.accessor(np.ravel(index), kind)}
        return self.plain_mesh({"attributes": attributes, **indices, **more})

    def paint(self, *materials: dict, pictures: tuple[bytes, ...] = (), samplers: tuple[dict, ...] = ()) -> None:
        """Materials; textures 0, 1, ... are the pictures, each with its sampler where there is one."""
        self.json["materials"] = list(materials)
        if pictures:
            self.json["images"] = [{"bufferView": self.view(data), "mimeType": "image/png"} for data in pictures]
            own = [{"sampler": k} if k < len(samplers) else {} for k in range(len(pictures))]
            self.json["textures"] = [{"source": k, **sampler} for k, sampler in enumerate(own)]
            self.json["samplers"] = list(samplers)

    def shine(self, *lamps: dict) -> None:
        self.json["extensions"] = {"KHR_lights_punctual": {"lights": list(lamps)}}
        self.json["extensionsUsed"] = ["KHR_lights_punctual"]

    def node(self, *, root: bool = True, **node: object) -> int:
        self.json["nodes"].append(node)
        if root:
            self.json["scenes"][0]["nodes"].append(len(self.json["nodes"]) - 1)
        return len(self.json["nodes"]) - 1

    def glb(self, path: Path) -> Path:
        document = pygltflib.GLTF2.from_dict({**self.json, "buffers": [{"byteLength": len(self.data)}]})
        document.set_binary_blob(self.data)
        document.save_binary(str(path))
        return path

    def gltf(self, path: Path, uri: str | None = None) -> Path:
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        path.write_text(json.dumps({**self.json, "buffers": [{"byteLength": len(self.data), "uri": uri}]}))
        return path


def one(**mesh: object) -> Writer:
    writer = Writer()
    writer.node(mesh=writer.mesh(**mesh))  # type: ignore[arg-type]
    return writer
