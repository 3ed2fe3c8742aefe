"""Hundreds of damaged glTF files: each loads soundly or is refused in one line; none hangs or fills the memory."""

import json
import re
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_files import HALVES, QUAD, Writer, png

from ddprt import seeds
from ddprt.errors import UserError
from ddprt.lights import scene_lights
from ddprt.scene.files import load_scene

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json", "ignore::UserWarning:pygltflib")

ODD: tuple[Any, ...] = (
    None,
    -1,
    0,
    7,
    1 << 40,
    -(1 << 70),
    0.5,
    1e308,
    float("nan"),
    float("inf"),
    "x",
    "",
    True,
    [],
    [[]],
    {},
)
"""What a number, a name or a list of the file is replaced by."""
MEMORY = 100 << 20
"""Bytes that no file of three thousand may take."""
UV = np.array([[0.1, 0.2], [0.9, 0.2], [0.9, 0.7], [0.1, 0.7]])


def rich() -> Writer:
    """A file in which most of what is read is there."""
    writer = Writer()
    base = {"baseColorTexture": {"index": 0, "texCoord": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}}
    base |= {"baseColorFactor": [0.5, 0.5, 0.5, 1], "roughnessFactor": 0.5, "metallicFactor": 0.5}
    extensions = {"KHR_materials_emissive_strength": {"emissiveStrength": 2}}
    paint = {"name": "paint", "alphaMode": "MASK", "alphaCutoff": 0.5, "emissiveFactor": [1, 1, 1], "doubleSided": False}
    samplers = ({"wrapS": 33071, "wrapT": 33648},)
    writer.paint({**paint, "pbrMetallicRoughness": base, "extensions": extensions}, pictures=(png(),), samplers=samplers)
    writer.shine({"type": "spot", "intensity": 5, "color": [1, 1, 1], "spot": {"outerConeAngle": 0.5}}, {"type": "point"})
    uv, own = writer.accessor(UV), writer.accessor(np.round(UV * 65535), "<u2", normalized=True)
    colour = writer.accessor(np.full((4, 4), 200), "|u1", normalized=True)
    mesh = writer.quad(HALVES, "|u1", TEXCOORD_0=uv, TEXCOORD_1=own, COLOR_0=colour, material=0, mode=4)
    where = {"bufferView": writer.view(np.array([1], "<u2").tobytes()), "componentType": 5123, "byteOffset": 0}
    values = {"bufferView": writer.view(QUAD[1:2].astype("<f4").tobytes()), "byteOffset": 0}
    place = writer.json["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"]
    writer.json["accessors"][place]["sparse"] = {"count": 1, "indices": where, "values": values}
    child = writer.node(root=False, mesh=mesh, translation=[0, 0, 1], rotation=[0, 0, 0, 1], scale=[1, 1, 1])
    writer.node(children=[child], matrix=np.eye(4).ravel().tolist())
    writer.node(mesh=writer.quad([0, 1, 2, 3], mode=6, material=0, TEXCOORD_0=uv, TEXCOORD_1=own))
    writer.node(extensions={"KHR_lights_punctual": {"light": 0}})
    writer.json["bufferViews"][0]["byteStride"] = 12
    writer.json["scene"] = 0
    return writer


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Every place of a document, by the keys that lead there."""
    if path:
        yield path
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from places(inner, (*path, key))


def changed(document: dict, path: tuple, value: Any) -> dict:
    """A copy with one place replaced; None removes it."""
    copy = json.loads(json.dumps(document))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    if value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return copy


def packed(document: dict, data: bytes) -> bytes:
    """A .glb, whatever its JSON holds."""
    text = json.dumps(document).encode()
    text, data = text + b" " * (-len(text) % 4), data + b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def whole() -> tuple[dict, bytes]:
    writer = rich()
    return {**writer.json, "buffers": [{"byteLength": len(writer.data)}]}, writer.data


def of_the_text(count: int) -> Iterator[tuple[str, bytes]]:
    """One place of the JSON replaced by something odd."""
    document, data = whole()
    everywhere = list(places(document))
    stream = seeds.stream(0, "mutations of the text")
    for number in stream.choice(len(everywhere) * len(ODD), count, replace=False):
        path, value = everywhere[number // len(ODD)], ODD[number % len(ODD)]
        yield f"{'.'.join(map(str, path))} = {value!r}", packed(changed(document, path, value), data)


def chosen() -> Iterator[tuple[str, bytes]]:
    """Faults that chance would seldom find."""
    document, data = whole()
    own = document["accessors"][3]["bufferView"]  # of positions
    for path, value in (
        (("nodes", 1, "children"), [1]),
        (("nodes", 0, "children"), [1]),
        (("scenes", 0, "nodes"), [0, 0]),
        (("accessors", 3, "count"), 1 << 31),
        (("accessors", 3, "sparse", "count"), 1 << 31),
        (("accessors", 3, "sparse", "indices", "componentType"), 5126),
        (("bufferViews", own, "byteStride"), -12),
        (("bufferViews", own, "byteStride"), 1 << 60),
        (("bufferViews", 0, "byteOffset"), -4),
        (("bufferViews", 0, "byteLength"), 1 << 40),
        (("buffers", 0, "byteLength"), 1 << 40),
        (("images", 0, "bufferView"), 0),
        (("buffers",), []),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"]),
        (("meshes", 0, "primitives", 0, "attributes"), {}),
        (("nodes", 0, "scale"), [0, 0, 0]),
        (("nodes", 0, "rotation"), [0, 0, 0, 0]),
        (("nodes", 0, "matrix"), [1e300] * 16),
        (
            ("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "extensions", "KHR_texture_transform", "scale"),
            [1e300, 1],
        ),
    ):
        yield f"{path} = {value}", packed(changed(document, path, value), data)
    without = json.loads(json.dumps(document))
    for key in ("bufferView", "byteOffset"):
        without["accessors"][3].pop(key, None)
    yield "zeros of a huge count", packed(changed(without, ("accessors", 3, "count"), 1 << 40), data)
    deep = "[" * 20_000 + "]" * 20_000
    yield "deep", packed(document, data).replace(b'"asset"', f'"extras": {deep}, "asset"'.encode())


def of_the_bytes(count: int) -> Iterator[tuple[str, bytes]]:
    """Cuts, noise, numbers that are none, and headers that lie."""
    document, data = whole()
    file = packed(document, data)
    stream = seeds.stream(0, "mutations of the bytes")
    for cut in stream.integers(0, len(file), count // 3):
        yield f"cut at {cut}", file[:cut]
    for _ in range(count // 3):
        noisy = np.frombuffer(file, np.uint8).copy()
        where = stream.integers(0, len(noisy), 3)
        noisy[where] = stream.integers(0, 256, 3)
        yield f"noise at {where}", noisy.tobytes()
    for _ in range(count // 3):
        start = 4 * int(stream.integers(0, len(data) // 4))
        pattern = (np.nan, np.inf, -1e38, 1e-45)[int(stream.integers(4))]
        yield f"{pattern} at {start}", packed(document, data[:start] + np.float32(pattern).tobytes() + data[start + 4 :])
    for where, value in (
        (0, b"glTX"),
        (4, b"\1\0\0\0"),
        (8, b"\xff" * 4),
        (8, bytes(4)),
        (12, b"\xff" * 4),
        (12, bytes(4)),
        (16, b"LAND"),
    ):
        yield f"header at {where}", file[:where] + value + file[where + 4 :]
    yield "empty", b""


def outcome(read: Callable[[Path], Any], path: Path) -> tuple[Any, str]:
    """What is read, or why not; any exception but the one for users passes through."""
    try:
        return read(path), ""
    except UserError as problem:
        return None, str(problem)


def holds(files: list[tuple[str, bytes]], path: Path) -> tuple[int, int]:
    """Reads every file for its scene and its lights; counts those that load and those that are refused."""
    refused, loaded = 0, 0
    for name, data in files:
        path.write_bytes(data)
        scene, said = outcome(load_scene, path)
        lamps, told = outcome(scene_lights, path)
        assert "\n" not in said + told, name
        assert "0x" not in said, name
        if scene is None:
            assert re.match(r"bad(\.glb)?: got .*(expected|not read).*;", said), (name, said)
            refused += 1
        else:
            assert np.isfinite(scene.corners).all(), name
            assert (scene.areas > 0).all(), name
            loaded += 1
        anchors = [anchor for lamp in lamps or () if (anchor := lamp.anchor()) is not None]
        assert np.isfinite(anchors).all(), name
    return loaded, refused


def test_the_whole_file_is_sound(tmp_path: Path) -> None:
    (tmp_path / "whole.glb").write_bytes(packed(*whole()))
    assert len(load_scene(tmp_path / "whole.glb").triangles) == 4
    assert len(scene_lights(tmp_path / "whole.glb")) == 1


def test_no_chosen_fault_raises_anything_but_one_line(tmp_path: Path) -> None:
    loaded, refused = holds(list(chosen()), tmp_path / "bad.glb")
    assert refused > 2 * loaded


def test_no_count_fills_the_memory(tmp_path: Path) -> None:
    files = [(name, data) for name, data in chosen() if "count" in name]
    assert len(files) == 3
    tracemalloc.start()
    loaded, _ = holds(files, tmp_path / "bad.glb")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert loaded == 0
    assert peak < MEMORY


def test_no_damaged_file_raises_anything_but_one_line(tmp_path: Path) -> None:
    loaded, refused = holds([*list(of_the_text(250))[:30], *of_the_bytes(30)], tmp_path / "bad.glb")
    assert min(loaded, refused) > 5


@pytest.mark.slow
def test_nor_do_hundreds_of_others(tmp_path: Path) -> None:
    files = [*of_the_text(500), *of_the_bytes(240)]
    assert len({name for name, _ in files}) > 700
    assert min(holds(files, tmp_path / "bad.glb")) > 100
