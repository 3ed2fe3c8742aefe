"""Files in: glTF written here byte by byte, OBJ, PLY and STL; what they say arrives, what is damaged is a UserError."""

import base64
import io
import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gltf_files import FACING, PICTURE, TRIANGLE, Writer, one, png
from PIL import Image

from ddprt.errors import UserError
from ddprt.scene.files import load_scene
from ddprt.scene.images import linear_image, srgb_to_linear
from ddprt.scene.material import Emission
from ddprt.scene.shapes import icosphere

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")


@pytest.mark.parametrize("indices", ["|u1", "<u2", "<u4", None])
def test_index_types(tmp_path: Path, indices: str | None) -> None:
    scene = load_scene(one(indices=indices).glb(tmp_path / "one.glb"))
    assert scene.name == "one"
    np.testing.assert_array_equal(scene.positions, TRIANGLE)
    np.testing.assert_array_equal(scene.triangles, [[0, 1, 2]])
    np.testing.assert_array_equal(scene.normals, FACING)


def test_hierarchy_of_transforms_and_instances(tmp_path: Path) -> None:
    writer = Writer()
    mesh = writer.mesh()
    half = np.sqrt(0.5)
    child = writer.node(root=False, mesh=mesh, translation=[0, 0, 2], rotation=[0, half, 0, half], scale=[1, 2, 3])
    writer.node(children=[child], translation=[10, 0, 0])
    matrix = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    writer.node(mesh=mesh, matrix=matrix.T.ravel().tolist())
    scene = load_scene(writer.glb(tmp_path / "tree.glb"))
    # A quarter turn about y takes x to -z; then two along z; then ten along x.
    np.testing.assert_allclose(scene.corners[0], [[10, 0, 2], [10, 0, 1], [10, 2, 2]], atol=1e-12)
    np.testing.assert_allclose(scene.normals[:3], [[1, 0, 0]] * 3, atol=1e-12)
    np.testing.assert_allclose(scene.corners[1], [[5, 6, 7], [5, 7, 7], [4, 6, 7]], atol=1e-12)
    assert len(scene.materials) == 1


def test_normals_follow_the_inverse_transpose(tmp_path: Path) -> None:
    slope = np.array([[0.0, 0, 0], [1, 0, -1], [0, 1, 0]])
    writer = one(positions=slope, normals=False)
    writer.json["nodes"][0]["scale"] = [1, 1, 3]
    writer.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = writer.accessor(
        np.array([[1.0, 0, 1]] * 3) / np.sqrt(2)
    )
    scene = load_scene(writer.glb(tmp_path / "slope.glb"))
    np.testing.assert_allclose(scene.normals, np.repeat(scene.geometric_normals, 3, axis=0), atol=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
def test_mirrored_bodies_keep_their_outside(tmp_path: Path, mirrored: bool) -> None:
    points, triangles = icosphere(1)
    writer = Writer()
    index, normal = writer.accessor(triangles.ravel(), "|u1"), writer.accessor(points)
    writer.json["meshes"] = [{"primitives": [{"attributes": {"POSITION": normal, "NORMAL": normal}, "indices": index}]}]
    writer.node(mesh=0, scale=[-2, 1, 1] if mirrored else [2, 1, 1], translation=[1, 2, 3])
    scene = load_scene(writer.glb(tmp_path / "ball.glb"))
    outward = scene.corners.mean(1) - [1, 2, 3]
    assert (np.einsum("td,td->t", outward, scene.geometric_normals) > 0).all()
    assert (np.einsum("vd,vd->v", scene.positions - [1, 2, 3], scene.normals) > 0).all()
    assert scene.notes == ("no material on some triangles: albedo 0.8 assumed",)


def test_without_normals_a_primitive_is_flat(tmp_path: Path) -> None:
    writer = one(normals=False, positions=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), indices=None)
    writer.json["meshes"][0]["primitives"][0]["indices"] = writer.accessor(np.array([0, 2, 1, 0, 1, 3]), "|u1")
    scene = load_scene(writer.glb(tmp_path / "fold.glb"))
    np.testing.assert_allclose(scene.normals, [[0, 0, -1]] * 3 + [[0, -1, 0]] * 3, atol=1e-12)
    assert any("6 missing shading normals" in note for note in scene.notes)


def test_colour_factor_keeps_its_precision_and_materials_stay_apart(tmp_path: Path) -> None:
    writer = Writer()
    factor = [0.123456789, 0.5000001, 0.98765432, 1]
    writer.json["materials"] = [
        {"name": "paint", "pbrMetallicRoughness": {"baseColorFactor": factor, "metallicFactor": 0}},
        {"name": "unsaid"},
    ]
    for material in (1, 0, 0):
        writer.node(mesh=writer.mesh(material=material), translation=[0, 0, len(writer.json["nodes"])])
    scene = load_scene(writer.glb(tmp_path / "paint.glb"))
    assert [entry.name for entry in scene.materials] == ["paint", "unsaid"]
    assert scene.materials[0].albedo == tuple(factor[:3])
    assert scene.materials[1].albedo == (1.0, 1.0, 1.0)
    assert scene.material.tolist() == [1, 0, 0]
    assert scene.uv is None


def textured(**texture: object) -> Writer:
    writer = Writer()
    uv = writer.accessor(np.array([[0.5 / 3, 0.25], [2.5 / 3, 0.25], [0.5 / 3, 0.75]]))
    writer.node(mesh=writer.mesh(attributes={"TEXCOORD_0": uv}, material=0))
    writer.json["materials"] = [
        {
            "name": "print",
            "pbrMetallicRoughness": {"baseColorFactor": [0.5, 1, 1, 1], "baseColorTexture": {"index": 0, **texture}},
        }
    ]
    writer.json["textures"] = [{"source": 0}]
    return writer


CORNERS = ([1.0, 0, 0], [0.0, 1, 0], [0.0, 0, 1])
SHOWN = np.array([[0.5, 0, 0], [0, 0, 1], [0, 0, 0]])
"""Corners of the textured triangle look at the picture's first, third and fourth pixel."""


@pytest.mark.parametrize("place", ["view", "uri", "file"])
def test_texture_is_the_right_way_up(tmp_path: Path, place: str) -> None:
    writer = textured()
    if place == "view":
        writer.json["images"] = [{"bufferView": writer.view(png()), "mimeType": "image/png"}]
    elif place == "uri":
        writer.json["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(png()).decode()}]
    else:
        (tmp_path / "the picture.png").write_bytes(png())
        writer.json["images"] = [{"uri": "the%20picture.png"}]
    scene = load_scene(writer.gltf(tmp_path / "print.gltf"))
    np.testing.assert_allclose(scene.albedo_at(np.zeros(3, int), np.array(CORNERS)), SHOWN, atol=1e-6)


def test_texture_transform_turns_scales_and_shifts(tmp_path: Path) -> None:
    change = {"offset": [0.25, 0.5], "rotation": np.pi / 2, "scale": [2.0, 4.0]}
    writer = textured(extensions={"KHR_texture_transform": change})
    writer.json["extensionsRequired"] = writer.json["extensionsUsed"] = ["KHR_texture_transform"]
    writer.json["images"] = [{"bufferView": writer.view(png())}]
    scene = load_scene(writer.glb(tmp_path / "print.glb"))
    # Where v points down, a counter-clockwise quarter turn takes u to -v and v to u.
    np.testing.assert_allclose(scene.uv, [[0.25 + 1, 0.5 - 1 / 3], [0.25 + 1, 0.5 - 5 / 3], [0.25 + 3, 0.5 - 1 / 3]], atol=1e-6)
    assert not any("texture_transform" in note for note in scene.notes)


def test_strides_normalised_integers_and_two_texture_sets(tmp_path: Path) -> None:
    writer = textured(texCoord=1)
    writer.json["images"] = [{"bufferView": writer.view(png())}]
    mixed = np.zeros(3, [("position", "<f4", 3), ("uv", "<u2", 2), ("rest", "<u4")])
    mixed["position"], mixed["uv"], mixed["rest"] = TRIANGLE, [[0, 65535], [65535, 0], [32768, 0]], 0xFFFFFFFF
    view = writer.view(mixed.tobytes(), byteStride=20)
    writer.json["accessors"] += [
        {"bufferView": view, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": view, "byteOffset": 12, "componentType": 5123, "normalized": True, "count": 3, "type": "VEC2"},
    ]
    attributes = writer.json["meshes"][0]["primitives"][0]["attributes"]
    attributes.update({"POSITION": len(writer.json["accessors"]) - 2, "TEXCOORD_1": len(writer.json["accessors"]) - 1})
    attributes["NORMAL"] = writer.accessor(np.array([[0, 0, 127]] * 3), "|i1", normalized=True)
    scene = load_scene(writer.glb(tmp_path / "mixed.glb"))
    np.testing.assert_array_equal(scene.positions, TRIANGLE)
    np.testing.assert_allclose(scene.uv, [[0, 1], [1, 0], [32768 / 65535, 0]])
    np.testing.assert_array_equal(scene.normals, FACING)


def test_what_is_ignored_is_listed_once(tmp_path: Path) -> None:
    writer = one(material=0)
    writer.mesh(mode=1)
    writer.node(mesh=1)
    writer.json["materials"] = [{"emissiveFactor": [1, 0, 0], "alphaMode": "MASK", "pbrMetallicRoughness": {}}] * 2
    writer.json["materials"][1] = {"normalTexture": {"index": 0}, "occlusionTexture": {"index": 0}}
    writer.mesh(material=1, positions=TRIANGLE + FACING)
    writer.node(mesh=2)
    writer.json["extensionsUsed"] = ["KHR_lights_punctual"]
    scene = load_scene(writer.glb(tmp_path / "much.glb"))
    (note,) = scene.notes
    for word in ("KHR_lights_punctual", "normal maps", "occlusion maps", "points and lines"):
        assert note.count(word) == 1


def spoil(writer: Writer, **entries: object) -> Writer:
    writer.json.update(entries)
    return writer


def laid(accessor: dict | None = None, **view: int) -> Writer:
    """A triangle whose positions lie in a buffer otherwise than the format allows."""
    writer = one()
    writer.data += bytes(64)
    writer.json["accessors"][0] |= accessor or {}
    writer.json["bufferViews"][0] |= {"byteLength": 64, **view}
    return writer


@pytest.mark.parametrize(
    ("writer", "says"),
    [
        (lambda: spoil(one(), extensionsUsed=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression.*without Draco"),
        (lambda: spoil(one(), extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
        (lambda: spoil(one(), extensionsRequired=["XYZ_unheard_of"]), "required extension XYZ_unheard_of"),
        (lambda: one(mode=7), "mode 7, expected 0 to 6"),
        (lambda: one(mode=1), "no triangles"),
        (lambda: spoil(one(), meshes=[]), "number 0 among meshes, expected one of the 0 there are; export it again"),
        (lambda: spoil(one(), scenes=[{"nodes": [7]}]), "number 7 among nodes, expected one of the 1 there are"),
        (lambda: spoil(one(), nodes=[{"children": [0], "mesh": 0}]), "twice in the hierarchy"),
        (
            lambda: spoil(one(), accessors=[{"componentType": 5126, "count": 3, "type": "VEC3", "sparse": {"count": 1}}] * 3),
            "sparse",
        ),
        (lambda: spoil(one(), accessors=[{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC2"}] * 3), "VEC2"),
        (
            lambda: spoil(one(), accessors=[{"bufferView": 0, "componentType": 5126, "count": 9**9, "type": "VEC3"}] * 3),
            r"got 36 bytes for accessor 0, expected 4649045868; it is damaged",  # 12 * 9**9
        ),
        (
            lambda: spoil(one(), accessors=[{"bufferView": 0, "componentType": 9999, "count": 3, "type": "VEC3"}] * 3),
            "component type 9999, expected one of 5120, 5121",
        ),
        (lambda: spoil(one(), nodes=[{"mesh": "a"}]), "got a damaged file, expected glTF 2.0, whole JSON .*; export it again"),
        (lambda: spoil(one(), bufferViews=[{"buffer": 0, "byteOffset": 0, "byteLength": 10**6}] * 3), "cut short"),
        (
            lambda: laid(byteStride=4),
            r"got byteStride 4 of buffer view 0 for rows of 12 bytes \(accessor 0\), expected as many or",
        ),
        (lambda: laid(byteStride=14), "got byteStride 14 .*, in steps of 4"),
        (lambda: laid(byteOffset=2), "got byteOffset 0 of accessor 0 in buffer view 0 at 2, expected both together"),
        (lambda: laid({"byteOffset": 6}, byteOffset=6), "got byteOffset 6 of accessor 0 in buffer view 0 at 6"),
        (lambda: spoil(one(), asset={"version": "1.0"}), "got glTF of version 1.0, expected 2.0"),
        (lambda: spoil(one(), asset={"version": "2.1", "minVersion": "2.1"}), "got glTF of version 2.1 that asks for 2.1"),
        (lambda: spoil(textured(), images=[{"uri": "nowhere.png"}]), 'no "nowhere.png" beside it'),
        (lambda: spoil(textured(), images=[{"uri": "data:image/png;base64,AAAA"}]), "image 0 that cannot be read"),
        (lambda: spoil(textured(texCoord=1), images=[{"uri": "x"}]), "no TEXCOORD_1"),
        (lambda: spoil(one(material=0), materials=[{"pbrMetallicRoughness": {"baseColorFactor": [2, 0, 0, 1]}}]), "0 to 1"),
    ],
)
def test_refused_gltf(tmp_path: Path, writer: object, says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        load_scene(writer().gltf(tmp_path / "bad.gltf"))  # type: ignore[operator]
    assert str(caught.value).startswith("bad")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("corner", "count"), [("0", 1), ("9", 1), ("-9/1", 1), ("0//1", 1), ("9 9", 2)])
def test_an_obj_says_which_vertices_there_are(tmp_path: Path, corner: str, count: int) -> None:
    """trimesh would take 0 for the last vertex, without a word."""
    vertices = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    (tmp_path / "box.obj").write_text(f"{vertices}f 1 2 3 # 99\nf 2 3 4\nf 5 6 {corner} 7\n")
    with pytest.raises(UserError) as caught:
        load_scene(tmp_path / "box.obj")
    wrong = corner.split("/")[0].split()[0]
    assert str(caught.value) == (
        f"box.obj: got a face with vertex {wrong} ({count} out of range), expected vertex indices from 1 to 8; export it again"
    )


def test_a_ply_says_what_it_lacks(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"
    (tmp_path / "a.ply").write_text(head + "end_header\n0\n1\n2\n")
    with pytest.raises(
        UserError, match=r"a\.ply: got a damaged file, expected PLY, vertices with x, y and z .*; export it again"
    ):
        load_scene(tmp_path / "a.ply")
    rest = "property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "b.ply").write_text(head + rest + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    with pytest.raises(UserError, match=r"b: got a face with vertex 7, expected vertex indices from 0 to 2; export it again"):
        load_scene(tmp_path / "b.ply")


def test_an_obj_may_count_from_the_end(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3//-1  -2 -1\n")
    assert len(load_scene(tmp_path / "a.obj").triangles) == 1


def test_missing_buffer_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r'no "gone\.bin" beside it'):
        load_scene(one().gltf(tmp_path / "bad.gltf", "gone.bin"))


OBJ = """mtllib room.mtl
o floor
v 0 0 0
v 0 0 1
v 1 0 1
v 1 0 0
vt 0.1666667 0.75
vt 0.8333333 0.75
vt 0.1666667 0.25
vt 0.5 0.5
usemtl print
f 1/1 2/2 3/3
f 1/1 3/3 4/4
o wall
v 0 1 0
v 1 1 0
usemtl red
f 1 4 6 5
"""
MTL = "newmtl print\nKd 0.5 1 1\nmap_Kd print.png\nnewmtl red\nKd 0.1234567 0.25 0.5\nKe 1 0 0\nd 1.0\n"


def write_obj(folder: Path) -> Path:
    (folder / "room.mtl").write_text(MTL)
    (folder / "print.png").write_bytes(png())
    (folder / "room.obj").write_text(OBJ)
    return folder / "room.obj"


def test_obj_with_materials_and_texture(tmp_path: Path) -> None:
    scene = load_scene(str(write_obj(tmp_path)))
    assert scene.areas.sum() == pytest.approx(2)
    names = [entry.name for entry in scene.materials]
    assert sorted(names) == ["print", "red"]
    assert scene.materials[names.index("red")].albedo == (0.1234567, 0.25, 0.5)
    wall = scene.material == names.index("red")
    np.testing.assert_allclose(scene.geometric_normals[wall], [[0, 0, 1]] * 2)
    np.testing.assert_allclose(scene.geometric_normals[~wall], [[0, 1, 0]] * 2)
    np.testing.assert_allclose(scene.normals[scene.triangles].mean(1), scene.geometric_normals, atol=1e-12)
    corners = {(0, 0): SHOWN[0], (0, 1): SHOWN[1], (1, 1): SHOWN[2]}
    first = np.flatnonzero(~wall)[(scene.corners[~wall] == [0, 0, 1]).all(2).any(1)]
    albedo = scene.albedo_at(np.repeat(first, 3), np.array(CORNERS))
    for corner, seen in zip(scene.corners[first[0]], albedo, strict=True):
        np.testing.assert_allclose(seen, corners[corner[0], corner[2]], atol=1e-5)
    assert scene.materials[names.index("red")].emission == Emission((1.0, 0.0, 0.0))
    assert scene.materials[names.index("print")].emission is None
    assert not any("red" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("words", "opacity"),
    [
        ("d 0.25\n", 0.25),
        ("Tr 0.75\n", 0.25),
        ("d 0.25\nTr 0\n", 0.25),
        ("d -halo 0\n", 0.0),
        ("d 0.75\n", 0.75),
        ("d 1\nTr 0\n", 1.0),
    ],
)
def test_obj_surfaces_that_are_rather_not_there_are_holes(tmp_path: Path, words: str, opacity: float) -> None:
    path = write_obj(tmp_path)
    (tmp_path / "room.mtl").write_text(MTL.replace("Ke 1 0 0\nd 1.0\n", words))
    scene = load_scene(path)
    (red,) = (entry for entry in scene.materials if entry.name == "red")
    assert (red.cutout is not None) == (opacity < 0.5)
    if red.cutout is not None:
        assert (red.cutout.opacity < red.cutout.cutoff).all()
    fate = "a hole" if opacity < 0.5 else "opaque"
    said = [note for note in scene.notes if '"red"' in note]
    assert said == ([f'material "red": opacity {opacity:g} is not simulated; taken as {fate}'] if opacity < 1 else [])


@pytest.mark.parametrize(("words", "says"), [("Ke 1 0", "got ke 1 0, expected 1 or 3"), ("d half", "got d half, expected 1")])
def test_faulty_words_of_a_material_are_told(tmp_path: Path, words: str, says: str) -> None:
    path = write_obj(tmp_path)
    (tmp_path / "room.mtl").write_text(f"newmtl red\nKd 1 1 1\n{words}\n")
    with pytest.raises(UserError, match=says):
        load_scene(path)


def test_obj_says_which_files_are_missing(tmp_path: Path) -> None:
    path = write_obj(tmp_path)
    (tmp_path / "print.png").unlink()
    assert any("print.png" in note for note in load_scene(path).notes)
    (tmp_path / "room.mtl").unlink()
    scene = load_scene(path)
    assert "room.mtl is missing: its materials are unknown" in scene.notes
    assert {entry.albedo for entry in scene.materials} == {(0.8, 0.8, 0.8)}


def test_obj_colours_count_only_where_no_material_speaks(tmp_path: Path) -> None:
    mesh = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\n{}f 1 2 3\n"
    (tmp_path / "a.obj").write_text(mesh.format(""))
    scene = load_scene(tmp_path / "a.obj")
    np.testing.assert_array_equal(scene.colour, [[1, 0, 0]] * 3)
    (tmp_path / "b.obj").write_text(mesh.format("v 0 0 1 0 0 1\nf 1 4 2\n"))  # corners that are shared
    both = load_scene(tmp_path / "b.obj")
    assert both.colour is not None
    np.testing.assert_array_equal(both.colour[:, 2], both.positions[:, 2])
    assert scene.materials[0].albedo == (1.0, 1.0, 1.0)
    (tmp_path / "room.mtl").write_text(MTL)
    (tmp_path / "a.obj").write_text("mtllib room.mtl\n" + mesh.format("usemtl red\n"))
    scene = load_scene(tmp_path / "a.obj")
    assert scene.colour is None
    assert scene.materials[0].albedo == (0.1234567, 0.25, 0.5)


def test_obj_groups_without_materials_stay_apart_and_normals_are_kept(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0.6 0.8\no one\nf 1//1 2//1 3//1\no two\nf 1//1 3//1 4//1\n"
    )
    scene = load_scene(tmp_path / "a.obj")
    assert sorted(entry.name for entry in scene.materials) == ["one", "two"]
    assert len(set(scene.material.tolist())) == 2
    np.testing.assert_allclose(scene.normals, [[0, 0.6, 0.8]] * len(scene.normals))


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{vertex}element face 2
property list uchar int vertex_indices
{face}end_header
0 0 0{a}
1 0 0{a}
1 1 0{a}
0 1 0{b}
3 0 1 2{c}
3 0 2 3{d}
"""
COLOUR = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
GREY = float(srgb_to_linear(np.array(128 / 255.0)))


@pytest.mark.parametrize(
    ("fields", "albedo", "noted"),
    [
        ({}, [[0.8] * 3] * 2, True),
        ({"face": COLOUR, "c": " 255 0 128", "d": " 0 255 0"}, [[1, 0, GREY], [0, 1, 0]], False),
        ({"vertex": COLOUR, "a": " 255 0 128", "b": " 0 255 128"}, [[1, 0, GREY], [2 / 3, 1 / 3, GREY]], False),
    ],
)
def test_ply_colours(tmp_path: Path, fields: dict[str, str], albedo: list, noted: bool) -> None:
    (tmp_path / "a.ply").write_text(PLY.format(**{key: fields.get(key, "") for key in ("vertex", "face", "a", "b", "c", "d")}))
    scene = load_scene(tmp_path / "a.ply")
    np.testing.assert_allclose(scene.albedo_at(np.arange(2), np.full((2, 3), 1 / 3)), albedo, atol=1e-12)
    assert any("albedo 0.8 assumed" in note for note in scene.notes) == noted


def test_ply_quads_keep_their_colours_and_their_side(tmp_path: Path) -> None:
    text = PLY.format(vertex="", face=COLOUR, a="", b="", c="", d="")
    head = text[: text.index("3 0 1 2")].replace("element vertex 4", "element vertex 6")
    (tmp_path / "a.ply").write_text(head + "0 2 0\n1 2 0\n4 0 1 2 3 255 0 0\n4 3 2 5 4 0 255 0\n")
    scene = load_scene(tmp_path / "a.ply")
    assert not any("turned" in note for note in scene.notes)
    np.testing.assert_allclose(scene.geometric_normals, [[0, 0, 1]] * 4)
    albedo = scene.albedo_at(np.arange(4), np.full((4, 3), 1 / 3))
    np.testing.assert_allclose(albedo[:, 0], scene.corners[..., 1].max(axis=1) <= 1)
    assert scene.areas.sum() == pytest.approx(2)


def test_ply_says_that_its_texture_is_missing(tmp_path: Path) -> None:
    text = PLY.format(**dict.fromkeys(("vertex", "face", "a", "b", "c", "d"), ""))
    (tmp_path / "a.ply").write_text(text.replace("ascii 1.0\n", "ascii 1.0\ncomment TextureFile gone.png\n"))
    assert "texture gone.png is missing" in load_scene(tmp_path / "a.ply").notes


def test_colours_of_vertices_blend_between_them(tmp_path: Path) -> None:
    """As those of glTF do, and exactly; linear light is what blends."""
    import trimesh

    points, triangles = icosphere(2)
    colours = ((points + 1) * 127.5).astype(np.uint8)
    trimesh.Trimesh(points, triangles, vertex_colors=colours, process=False).export(tmp_path / "ball.ply")
    scene = load_scene(tmp_path / "ball.ply")
    weights = np.random.default_rng(4).dirichlet(np.ones(3), len(triangles))
    expected = np.einsum("tc,tcd->td", weights, srgb_to_linear(colours[triangles] / 255.0))
    np.testing.assert_allclose(scene.albedo_at(np.arange(len(triangles)), weights), expected, atol=1e-12)
    assert len(scene.materials) == 1


def test_many_face_colours_are_rounded(tmp_path: Path) -> None:
    import trimesh

    points, triangles = icosphere(5)
    colours = ((points[triangles].mean(1) + 1) * 127.5).astype(np.uint8)
    trimesh.Trimesh(points, triangles, face_colors=colours, process=False).export(tmp_path / "ball.ply")
    scene = load_scene(tmp_path / "ball.ply")
    assert 100 < len(scene.materials) <= 4096
    assert any("32 levels" in note for note in scene.notes)
    expected = srgb_to_linear(colours / 255.0)
    seen = scene.albedo_at(np.arange(len(triangles)), np.full((len(triangles), 3), 1 / 3))
    assert np.abs(np.sqrt(seen) - np.sqrt(expected)).max() <= 0.51 / 31


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl"])
def test_round_trip_of_a_ball(tmp_path: Path, suffix: str) -> None:
    import trimesh

    points, triangles = icosphere(2)
    trimesh.Trimesh(points, triangles, process=False).export(tmp_path / f"ball.{suffix}")
    scene = load_scene(tmp_path / f"ball.{suffix}")
    np.testing.assert_allclose(scene.corners, points[triangles], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1)


def binary_ply(path: Path) -> Path:
    import trimesh

    trimesh.Trimesh(*icosphere(1), process=False).export(path)
    return path


def complaint(path: Path) -> str:
    """What `load_scene` has against the file, empty if nothing; any other exception passes through."""
    try:
        load_scene(path)
    except UserError as problem:
        return str(problem)
    return ""


@pytest.mark.parametrize("kind", ["glb", "gltf", "obj", "ply", "stl"])
def test_cut_files_raise_nothing_but_user_errors(tmp_path: Path, kind: str) -> None:
    if kind in ("glb", "gltf"):
        writer = textured()
        writer.json["images"] = [{"bufferView": writer.view(png())}]
        whole = getattr(writer, kind)(tmp_path / f"whole.{kind}").read_bytes()
    elif kind == "obj":
        whole = write_obj(tmp_path).read_bytes()
    else:
        whole = binary_ply(tmp_path / f"whole.{kind}").read_bytes()
    refused = 0
    cuts = sorted({0, 1, 3, 4, 11, 12, 20, 83, 84, *range(30, len(whole), max(1, len(whole) // 60)), len(whole) - 1})
    for cut in cuts:
        path = tmp_path / f"cut.{kind}"
        path.write_bytes(whole[:cut])
        said = complaint(path)
        refused += bool(said)
        assert not re.search(r"Error|Exception", said), said
        assert "\n" not in said
    # A text file that ends early after a whole line may still be a mesh.
    assert refused == len(cuts) if kind in ("glb", "gltf", "ply", "stl") else refused > 5


@pytest.mark.parametrize("kind", ["glb", "ply", "stl", "obj"])
def test_scrambled_files_raise_nothing_but_user_errors(tmp_path: Path, kind: str) -> None:
    generator = np.random.default_rng(3)
    if kind == "glb":
        whole = one().glb(tmp_path / "whole.glb").read_bytes()
    else:
        whole = write_obj(tmp_path).read_bytes() if kind == "obj" else binary_ply(tmp_path / f"whole.{kind}").read_bytes()
    for _ in range(60):
        data = np.frombuffer(whole, np.uint8).copy()
        where = generator.integers(0, len(data), 4)
        data[where] = generator.integers(0, 256, 4)
        path = tmp_path / f"noise.{kind}"
        path.write_bytes(data.tobytes())
        assert "\n" not in complaint(path)


def test_glb_header_is_held_against_the_length(tmp_path: Path) -> None:
    path = one().glb(tmp_path / "a.glb")
    data = bytearray(path.read_bytes())
    data[8:12] = struct.pack("<I", len(data) + 100)
    path.write_bytes(bytes(data))
    with pytest.raises(UserError, match=f"got {len(data)} bytes, expected {len(data) + 100}"):
        load_scene(path)


@pytest.mark.parametrize(
    ("source", "parameters", "says"),
    [
        ("cornel", {}, 'did you mean "cornell".*known: bending, convex, .*or a path that ends in .glb'),
        ("room.fbx", {}, 'suffix ".fbx", expected .glb'),
        ("some/where", {}, 'suffix ""'),
        ("nowhere/room.glb", {}, rf"no such file.*, which counts from {re.escape(str(Path.cwd()))}$"),
        ("/nowhere/room.obj", {}, "no such file, expected a mesh; check the path$"),
        (Path("cornell"), {}, 'suffix ""'),
        (str(Path(__file__).parent), {}, "got a folder, expected a file that ends in .glb"),
        ("furnace", {"albdeo": 1.0}, 'did you mean "albedo"'),
    ],
)
def test_sources_that_are_not_there(source: str | Path, parameters: dict[str, float], says: str) -> None:
    with pytest.raises(UserError, match=says):
        load_scene(source, **parameters)


def test_load_scene_takes_library_names_with_parameters_and_files_without(tmp_path: Path) -> None:
    assert load_scene("furnace", albedo=0.25, subdivisions=1).materials[0].albedo == (0.25,) * 3
    path = one().glb(tmp_path / "ROOM.GLB")
    assert load_scene(path).name == "ROOM"
    with pytest.raises(UserError, match="got parameter albedo, expected none for a file"):
        load_scene(path, albedo=0.5)
    with pytest.raises(UserError, match="no such file"):
        load_scene(tmp_path / "folder.glb")


def test_pictures_become_linear() -> None:
    linear = linear_image(png())
    assert linear.dtype == np.float32
    np.testing.assert_allclose(linear[0], np.eye(3), atol=1e-7)
    np.testing.assert_allclose(linear[1], [[0] * 3, [0.502886] * 3, [1] * 3], atol=1e-5)
    deep = linear_image(Image.fromarray(np.array([[0, 32768, 65535]], np.uint16)))
    np.testing.assert_allclose(deep[0, :, 0], [0, 0.21404, 1], atol=1e-4)


def rgba_png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(stream, "PNG")
    return stream.getvalue()


def painted(material: dict, *pictures: bytes, coordinates: int = 1) -> Writer:
    """A triangle of one material, whose textures 0, 1, ... are these pictures."""
    writer = Writer()
    places = [np.array([[0.0, 1], [1, 0], [0.5, 0]]), np.array([[0.25, 0.5], [1, 0], [0.5, 0]])]
    attributes = {f"TEXCOORD_{k}": writer.accessor(places[k]) for k in range(coordinates)}
    writer.node(mesh=writer.mesh(material=0, attributes=attributes))
    writer.json["materials"] = [{"name": "paint", **material}]
    writer.json["images"] = [{"bufferView": writer.view(picture), "mimeType": "image/png"} for picture in pictures]
    writer.json["textures"] = [{"source": k} for k in range(len(pictures))]
    return writer


ALPHA = np.array([[[255, 0, 0, 0], [0, 255, 0, 100]], [[0, 0, 255, 200], [9, 9, 9, 255]]])


def test_masks_become_cutouts(tmp_path: Path) -> None:
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.5]}
    mask = {"alphaMode": "MASK", "alphaCutoff": 0.25, "doubleSided": True, "pbrMetallicRoughness": base}
    scene = load_scene(painted(mask, rgba_png(ALPHA)).glb(tmp_path / "mask.glb"))
    (material,) = scene.materials
    assert material.cutout is not None
    assert material.cutout.cutoff == 0.25
    np.testing.assert_allclose(material.cutout.opacity, ALPHA[..., 3] / 255 / 2, rtol=1e-6)
    np.testing.assert_allclose(material.texture, srgb_to_linear(ALPHA[..., :3] / 255), rtol=1e-6)
    assert material.two_sided
    assert len(scene.triangles) == 2
    assert not any("alpha" in note or "double" in note or "ignored" in note for note in scene.notes)

    by_default = {**mask, "alphaCutoff": None, "doubleSided": False}
    (material,) = load_scene(
        painted({k: v for k, v in by_default.items() if v}, rgba_png(ALPHA)).glb(tmp_path / "a.glb")
    ).materials
    assert material.cutout is not None
    assert material.cutout.cutoff == 0.5
    assert not material.two_sided


def test_masks_that_nothing_passes_are_none(tmp_path: Path) -> None:
    whole = {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}}
    assert load_scene(painted(whole).glb(tmp_path / "whole.glb")).materials[0].cutout is None
    opaque = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    assert load_scene(painted(opaque, rgba_png(ALPHA)).glb(tmp_path / "opaque.glb")).materials[0].cutout is None
    for cutoff in (0.6, 3.0):  # the standard lets it exceed 1
        gone = load_scene(painted({**whole, "alphaCutoff": cutoff}).glb(tmp_path / "gone.glb")).materials[0].cutout
        assert gone is not None
        assert (gone.opacity < gone.cutoff).all()


@pytest.mark.parametrize("mode", ["FOO", "mask"])
def test_a_transparency_that_nobody_knows_is_refused(tmp_path: Path, mode: str) -> None:
    with pytest.raises(UserError, match=f'got alphaMode "{mode}" of material "paint", expected OPAQUE, MASK or BLEND'):
        load_scene(painted({"alphaMode": mode}).glb(tmp_path / "foo.glb"))


def test_blending_is_a_mask_and_named(tmp_path: Path) -> None:
    blend = {"alphaMode": "BLEND", "alphaCutoff": 0.1, "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    scene = load_scene(painted(blend, rgba_png(ALPHA)).glb(tmp_path / "blend.glb"))
    assert scene.materials[0].cutout is not None
    assert scene.materials[0].cutout.cutoff == 0.5
    assert any(note.startswith('material "paint": blending') for note in scene.notes)


def test_emission_and_gloss_are_read(tmp_path: Path) -> None:
    mixed = np.array([[[10, 51, 102], [20, 255, 0]]])
    material = {
        "emissiveFactor": [1, 0.5, 0.25],
        "emissiveTexture": {"index": 0},
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 8}},
        "pbrMetallicRoughness": {
            "metallicFactor": 0.5,
            "roughnessFactor": 0.8,
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
        },
    }
    writer = painted(material, png(), rgba_png(mixed))
    writer.json["extensionsUsed"] = ["KHR_materials_emissive_strength"]
    scene = load_scene(writer.glb(tmp_path / "lamp.glb"))
    emission, gloss = scene.materials[0].emission, scene.materials[0].gloss
    assert emission is not None
    assert gloss is not None
    assert emission.radiance == (8, 4, 2)
    np.testing.assert_allclose(emission.texture, srgb_to_linear(PICTURE / 255), atol=1e-7)
    assert (gloss.roughness, gloss.metallic, gloss.dielectric) == (0.8, 0.5, 0.04)
    np.testing.assert_allclose(gloss.texture, mixed[..., 1:] / 255, rtol=1e-6)
    assert scene.uv is not None
    assert scene.notes == ()


def test_what_a_material_leaves_out_is_as_the_standard_says(tmp_path: Path) -> None:
    scene = load_scene(painted({}).glb(tmp_path / "plain.glb"))
    gloss = scene.materials[0].gloss
    assert gloss is not None
    assert (gloss.roughness, gloss.metallic, gloss.texture) == (1.0, 1.0, None)
    assert scene.materials[0].emission is None
    assert scene.materials[0].cutout is None
    assert scene.uv is None
    dark = painted({"emissiveTexture": {"index": 0}}, png())  # the factor's default is black
    assert load_scene(dark.glb(tmp_path / "dark.glb")).materials[0].emission is None


def test_textures_with_coordinates_of_their_own_count_by_their_mean(tmp_path: Path) -> None:
    material = {
        "emissiveFactor": [2, 2, 2],
        "emissiveTexture": {"index": 0, "texCoord": 1},
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 0, "texCoord": 1}},
    }
    scene = load_scene(painted(material, png(), coordinates=2).glb(tmp_path / "two.glb"))
    emission, gloss = scene.materials[0].emission, scene.materials[0].gloss
    assert emission is not None
    assert gloss is not None
    np.testing.assert_allclose(emission.radiance, 2 * srgb_to_linear(PICTURE / 255).mean((0, 1)), rtol=1e-6)
    np.testing.assert_allclose([gloss.roughness, gloss.metallic], PICTURE[..., 1:].mean((0, 1)) / 255, rtol=1e-6)
    assert emission.texture is gloss.texture is None
    for what in ("emission", "metallic and roughness"):
        assert any(note.startswith(f'material "paint": {what} texture') for note in scene.notes)
    # Without a base texture the coordinates are those of the first there is.
    del material["pbrMetallicRoughness"]
    scene = load_scene(painted(material, png(), coordinates=2).glb(tmp_path / "one.glb"))
    assert scene.materials[0].emission is not None
    assert scene.materials[0].emission.texture is not None
    assert scene.uv is not None
    np.testing.assert_allclose(scene.uv[0], [0.25, 0.5])


def milky(**extensions: dict) -> Writer:
    """A tetrahedron of a material with extensions, closed."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    writer = Writer()
    found = {f"KHR_materials_{name}": value for name, value in extensions.items()}
    writer.json["materials"] = [{"name": "milk", "extensions": found}]
    writer.json["extensionsUsed"] = list(found)
    writer.node(mesh=writer.mesh(normals=False, positions=corners.reshape(-1, 3), material=0))
    return writer


def test_volumes_that_scatter_are_media(tmp_path: Path) -> None:
    """Extinction is -log(colour) / distance; the albedo sends back the colour of multiple scattering."""
    volume = {"thicknessFactor": 1, "attenuationDistance": 0.02, "attenuationColor": [0.5, 0.25, 0.1]}
    scatter = {"multiscatterColor": [0.9, 0.6, 0.2], "scatterAnisotropy": 0.4}
    through = {"transmission": {"transmissionFactor": 1}}
    whole = milky(volume=volume, volume_scatter=scatter, ior={"ior": 1.3}, **through)
    scene = load_scene(whole.glb(tmp_path / "milk.glb"))
    medium = scene.materials[0].subsurface
    assert medium is not None
    np.testing.assert_allclose(medium.mean_free_path, -0.02 / np.log([0.5, 0.25, 0.1]))
    assert (medium.anisotropy, medium.index) == (0.4, 1.3)
    np.testing.assert_allclose(replace(medium, index=1.0).thick_albedo, [0.9, 0.6, 0.2], atol=1e-9)
    assert scene.materials[0].gloss is None
    assert scene.notes == ("12 missing shading normals made from the faces",)
    for left_out in ("volume", "volume_scatter", "transmission"):
        parts = {"volume": volume, "volume_scatter": scatter, **through}
        del parts[left_out]
        opaque = load_scene(milky(**parts).glb(tmp_path / f"{left_out}.glb"))
        assert opaque.materials[0].subsurface is None
        assert any("no KHR_materials_volume_scatter" in note for note in opaque.notes) is (left_out == "volume_scatter")
