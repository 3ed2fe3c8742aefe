"""Twenty and more glTF files, one for each way to say a thing: exactly the triangles, colours and coordinates they hold."""

import base64
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from gltf_files import HALVES, PICTURE, QUAD, Writer, png

from ddprt.errors import UserError
from ddprt.scene.atlas import build_atlas
from ddprt.scene.files import load_scene
from ddprt.scene.filtered import mean_albedo
from ddprt.scene.images import srgb_to_linear
from ddprt.scene.mesh import Scene
from ddprt.transport.irradiance import irradiance
from ddprt.transport.walk import albedo_of

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")

CLAMP, MIRROR, REPEAT = 33071, 33648, 10497
LINEAR = srgb_to_linear(PICTURE / 255)
UV = np.array([[0.1, 0.2], [0.9, 0.2], [0.9, 0.7], [0.1, 0.7]])
GREY = {"pbrMetallicRoughness": {"baseColorFactor": [0.25, 0.5, 0.75, 1]}}
PRINTED = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.25, 1, 1]}}
COLOURS = np.array([[1.0, 0, 0.2], [0, 1, 0.4], [0.2, 0.4, 1], [0.6, 0.8, 0]])


@dataclass
class File:
    """A file and what it holds, for corners of its triangles in their order."""

    writer: Writer
    corners: np.ndarray
    albedo: np.ndarray | None = None
    uv: np.ndarray | None = None
    save: str = "glb"


def placed(*, corners: np.ndarray = QUAD[HALVES], material: dict | None = None, save: str = "glb", **quad: object) -> File:
    """A file of one rectangle."""
    writer = Writer()
    made = {name: (value(writer) if callable(value) else value) for name, value in quad.items()}
    if material:
        writer.paint(material)
        made["material"] = 0
    writer.node(mesh=writer.quad(**made))
    return File(writer, corners, save=save)


def rows(order: object) -> dict[str, Callable[[Writer], int]]:
    """Attributes of the rectangle in another order of its vertices."""
    return {
        "POSITION": lambda writer: writer.accessor(QUAD[order]),
        "NORMAL": lambda writer: writer.accessor(np.array([[0.0, 0, 1]] * len(QUAD[order]))),
    }


def sparse(*, base: bool) -> Callable[[Writer], int]:
    """Places of vertices of which some, or all, are replaced."""

    def write(writer: Writer) -> int:
        wrong = QUAD.copy()
        wrong[1:3] = 7
        number = writer.accessor(wrong)
        where = np.array([1, 2]) if base else np.arange(4)
        entry = writer.json["accessors"][number]
        if not base:
            del entry["bufferView"]
        entry["sparse"] = {
            "count": len(where),
            "indices": {"bufferView": writer.view(where.astype("<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": writer.view(QUAD[where].astype("<f4").tobytes())},
        }
        return number

    return write


def interleaved() -> File:
    file = placed(POSITION=None)
    mixed = np.zeros(4, [("place", "<f4", 3), ("normal", "|i1", 4), ("rest", "<u4", 2)])
    mixed["place"], mixed["normal"], mixed["rest"] = QUAD, [0, 0, 127, 99], 0xFFFFFFFF
    view = file.writer.view(mixed.tobytes(), byteStride=24)
    shared = {"bufferView": view, "count": 4, "type": "VEC3"}
    first = len(file.writer.json["accessors"])
    file.writer.json["accessors"] += [
        {**shared, "componentType": 5126},
        {**shared, "componentType": 5120, "byteOffset": 12, "normalized": True},
    ]
    file.writer.json["meshes"][0]["primitives"][0]["attributes"].update(POSITION=first, NORMAL=first + 1)
    return file


def quantised() -> File:
    """Whole numbers for metres, which the node scales, as gltfpack writes them."""
    file = placed(POSITION=lambda writer: writer.accessor(QUAD * 1000 - 500, "<i2"))
    file.writer.json["nodes"][0] |= {"scale": [1e-3] * 3, "translation": [0.5, 0.5, 0.5]}
    file.writer.json["extensionsRequired"] = file.writer.json["extensionsUsed"] = ["KHR_mesh_quantization"]
    return file


def instances() -> File:
    file = placed()
    file.writer.node(mesh=0, translation=[0, 0, 3])
    child = file.writer.node(root=False, mesh=0, scale=[2, 2, 2])
    file.writer.node(children=[child], translation=[10, 0, 0])
    file.corners = np.concatenate([QUAD[HALVES], QUAD[HALVES] + [0, 0, 3], 2 * QUAD[HALVES] + [10, 0, 0]])
    return file


def several() -> File:
    """Two primitives of a mesh with materials of their own, and points, which are none."""
    writer = Writer()
    writer.paint(GREY, {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}})
    meshes = [writer.quad(material=1), writer.quad([[0, 1, 3]], material=0), writer.quad(None, mode=0)]
    primitives = [writer.json["meshes"][k]["primitives"][0] for k in meshes]
    primitives[1]["attributes"]["POSITION"] = writer.accessor(np.add(QUAD, [0, 0, 5]))
    writer.node(mesh=writer.plain_mesh(*primitives))
    corners = np.concatenate([QUAD[HALVES], QUAD[[[0, 1, 3]]] + [0, 0, 5]])
    return File(writer, corners, np.repeat([[1, 0, 0], [1, 0, 0], [0.25, 0.5, 0.75]], 3, axis=0).reshape(3, 3, 3))


def coloured(kind: str, channels: int, *, picture: bool = False) -> File:
    full = {"|u1": 255, "<u2": 65535, "<f4": 1}[kind]
    rows = np.round(COLOURS * full) if full > 1 else COLOURS
    rows = np.column_stack([rows, np.full(4, full)])[:, :channels]
    writer = Writer()
    writer.paint(PRINTED if picture else GREY, pictures=(png(),) if picture else ())
    colour, uv = writer.accessor(rows, kind, normalized=full > 1), writer.accessor(UV)
    writer.node(mesh=writer.quad(COLOR_0=colour, TEXCOORD_0=uv, material=0))
    albedo = COLOURS[HALVES] * ([0.25, 0.5, 0.75] if not picture else lookup(UV[HALVES]) * [0.5, 0.25, 1])
    return File(writer, QUAD[HALVES], albedo)


def lookup(uv: np.ndarray, across: int = REPEAT, down: int = REPEAT) -> np.ndarray:
    """The picture at places, pixel by pixel: the oracle."""

    def pixel(at: int, size: int, mode: int) -> int:
        if mode == CLAMP:
            return min(max(at, 0), size - 1)
        if mode == MIRROR and (at // size) % 2:
            return size - 1 - at % size
        return at % size

    found = []
    height, width = LINEAR.shape[:2]
    for u, v in uv.reshape(-1, 2):
        x, y = u * width - 0.5, v * height - 0.5
        total = np.zeros(3)
        for column in (int(np.floor(x)), int(np.floor(x)) + 1):
            for row in (int(np.floor(y)), int(np.floor(y)) + 1):
                weight = (1 - abs(x - column)) * (1 - abs(y - row))
                total += weight * LINEAR[pixel(row, height, down), pixel(column, width, across)]
        found.append(total)
    return np.array(found).reshape(*uv.shape[:-1], 3)


def printed(
    places: np.ndarray, *modes: int, change: dict | None = None, seen: np.ndarray | None = None, number: int = 0
) -> File:
    writer = Writer()
    texture = {"index": 0, "texCoord": number, **({"extensions": {"KHR_texture_transform": change}} if change else {})}
    sampler = ({"wrapS": modes[0], "wrapT": modes[1]},) if modes else ()
    writer.paint({"pbrMetallicRoughness": {"baseColorTexture": texture}}, pictures=(png(),), samplers=sampler)
    writer.node(mesh=writer.quad(**{f"TEXCOORD_{number}": writer.accessor(places)}, material=0))
    if change:
        writer.json["extensionsUsed"] = ["KHR_texture_transform"]
    seen = (places if seen is None else seen)[HALVES]
    return File(writer, QUAD[HALVES], lookup(seen, *modes), seen if not modes else None)


def unlit() -> File:
    file = placed(material={**GREY, "name": "sign", "extensions": {"KHR_materials_unlit": {}}})
    file.writer.json["extensionsUsed"] = ["KHR_materials_unlit"]
    return file


WIDE = np.array([[-1.3, 0.4], [1.7, 0.4], [1.7, 2.6], [-1.3, 2.6]])
FILES: dict[str, Callable[[], File]] = {
    "indices of one byte": lambda: placed(kind="|u1"),
    "indices of two bytes": lambda: placed(kind="<u2"),
    "indices of four bytes": lambda: placed(kind="<u4"),
    "no indices": lambda: placed(index=None, corners=QUAD[HALVES], **rows(HALVES.ravel())),
    "strip": lambda: placed(index=[3, 0, 2, 1], mode=5, corners=QUAD[[[3, 0, 2], [0, 1, 2]]]),
    "strip of five": lambda: placed(index=[3, 0, 2, 1, 1], mode=5, corners=QUAD[[[3, 0, 2], [0, 1, 2]]]),
    "strip without indices": lambda: placed(index=None, mode=5, corners=QUAD[[[3, 0, 2], [0, 1, 2]]], **rows([3, 0, 2, 1])),
    "fan": lambda: placed(index=[1, 2, 3, 0], mode=6, corners=QUAD[[[2, 3, 1], [3, 0, 1]]]),
    "sparse": lambda: placed(POSITION=sparse(base=True)),
    "sparse from nothing": lambda: placed(POSITION=sparse(base=False)),
    "interleaved": interleaved,
    "quantised": quantised,
    "data in the text": lambda: placed(save="gltf"),
    "data beside it": lambda: placed(save="beside"),
    "instances": instances,
    "several primitives": several,
    "colour factor": lambda: File(placed(material=GREY).writer, QUAD[HALVES], np.full((2, 3, 3), [0.25, 0.5, 0.75])),
    "colours in bytes": lambda: coloured("|u1", 4),
    "colours in words": lambda: coloured("<u2", 3),
    "colours over a picture": lambda: coloured("<f4", 3, picture=True),
    "picture": lambda: printed(UV),
    "picture repeated": lambda: printed(WIDE, REPEAT, REPEAT),
    "picture clamped": lambda: printed(WIDE, CLAMP, CLAMP),
    "picture mirrored": lambda: printed(WIDE, MIRROR, MIRROR),
    "picture clamped across, mirrored down": lambda: printed(WIDE, CLAMP, MIRROR),
    "picture mirrored across, repeated down": lambda: printed(WIDE, MIRROR, REPEAT),
    "picture clamped to its rim": lambda: printed(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), CLAMP, CLAMP),
    "picture moved": lambda: printed(UV, change={"offset": [0.3, -0.2], "scale": [2, 3]}, seen=UV * [2, 3] + [0.3, -0.2]),
    "third coordinates": lambda: printed(UV, number=2),
    "unlit": unlit,
}


def written(file: File, folder: Path) -> Path:
    if file.save == "beside":
        (folder / "the bytes é.bin").write_bytes(file.writer.data)
        return file.writer.gltf(folder / "a.gltf", "the%20bytes%20%C3%A9.bin")
    return getattr(file.writer, file.save)(folder / f"a.{file.save}")


@pytest.mark.parametrize("name", FILES)
def test_a_file_holds_what_was_put_in(tmp_path: Path, name: str) -> None:
    file = FILES[name]()
    scene = load_scene(written(file, tmp_path))
    assert len(scene.triangles) == len(file.corners)
    np.testing.assert_allclose(scene.corners, file.corners, atol=1e-6)
    np.testing.assert_allclose(scene.geometric_normals, [[0, 0, 1]] * len(file.corners), atol=1e-6)
    np.testing.assert_allclose(scene.normals, np.broadcast_to([0, 0, 1], scene.normals.shape), atol=1e-6)
    if file.albedo is not None:
        triangle = np.repeat(np.arange(len(file.corners)), 3)
        corner = np.tile(np.eye(3), (len(file.corners), 1))
        expected = file.albedo.reshape(-1, 3)
        atol = 0.5 / 255 if "bytes" in name else 1e-5
        np.testing.assert_allclose(scene.albedo_at(triangle, corner), expected, atol=atol)
        np.testing.assert_allclose(albedo_of(scene)(triangle, corner[:, 1], corner[:, 2]), expected, atol=atol)
    if file.uv is not None:
        assert scene.uv is not None
        np.testing.assert_allclose(scene.uv[scene.triangles], file.uv, atol=1e-6)
    assert not any("ignored" in note for note in scene.notes) or name == "several primitives"


@pytest.mark.parametrize("modes", [(CLAMP, CLAMP), (MIRROR, MIRROR), (CLAMP, MIRROR), (MIRROR, REPEAT)])
def test_wrapped_pictures_are_the_same_everywhere(tmp_path: Path, modes: tuple[int, int]) -> None:
    scene = load_scene(written(printed(WIDE, *modes), tmp_path))
    weights = np.random.default_rng(1).dirichlet(np.ones(3), 200)
    triangle = np.arange(200) % 2
    places = np.einsum("nc,ncd->nd", weights, WIDE[HALVES][triangle])
    np.testing.assert_allclose(scene.albedo_at(triangle, weights), lookup(places, *modes), atol=1e-5)


def test_samplers_of_other_images_of_a_material_count_too(tmp_path: Path) -> None:
    """A mask, a glow and gloss of another size than the base picture: clamped, mirrored and repeated side by side."""
    alpha = np.zeros((2, 3, 4))
    alpha[..., :3], alpha[..., 3] = PICTURE, [[0, 50, 100], [150, 200, 250]]
    glow = np.zeros((1, 6, 3))
    glow[0, :, 0] = [255, 0, 0, 0, 0, 0]
    material = {
        "alphaMode": "MASK",
        "emissiveFactor": [1, 1, 1],
        "emissiveTexture": {"index": 1},
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 2}},
    }
    writer = Writer()
    samplers = {"wrapS": CLAMP, "wrapT": REPEAT}, {"wrapS": MIRROR, "wrapT": REPEAT}
    writer.paint(material, pictures=(png(alpha), png(glow), png()), samplers=samplers)
    writer.node(mesh=writer.quad(TEXCOORD_0=writer.accessor(WIDE), material=0))
    scene = load_scene(writer.glb(tmp_path / "a.glb"))
    emission, gloss, cutout = scene.materials[0].emission, scene.materials[0].gloss, scene.materials[0].cutout
    assert emission is not None and emission.texture is not None  # noqa: PT018
    assert gloss is not None and gloss.texture is not None  # noqa: PT018
    assert cutout is not None
    assert scene.uv is not None
    # The middle of the first pixel of the glow, of its mirror image, and of the same pixel of the base picture.
    low, high = -1.3, 1.7
    for place in (1 / 12, -1 / 12, 2 - 1 / 12 - 0.5):
        share = (place - low) / (high - low)
        shown = scene.uv[:, 0].min() + share * np.ptp(scene.uv[:, 0])
        pixel = int(np.floor(shown * emission.texture.shape[1]))
        mirrored = place % 2 if place % 2 < 1 else 2 - place % 2
        assert emission.texture[0, pixel, 0] == (1.0 if mirrored < 1 / 6 else 0.0)
        column = int(np.floor(shown * cutout.opacity.shape[1]))
        clamped = min(max(int(np.floor(place * 3)), 0), 2)
        np.testing.assert_allclose(cutout.opacity[:2, column], alpha[:, clamped, 3] / 255, rtol=1e-6)
        turned = int(np.floor(place * 3)) % 3
        rough = gloss.texture[:2, int(np.floor(shown * gloss.texture.shape[1])), 0]
        np.testing.assert_allclose(rough, PICTURE[:, turned, 1] / 255, rtol=1e-6)


def test_a_picture_too_far_to_wrap_is_repeated_and_said_so(tmp_path: Path) -> None:
    scene = load_scene(written(printed(WIDE * 1e7, CLAMP, CLAMP), tmp_path))
    assert any("too far to wrap: repeated" in note for note in scene.notes)


def test_an_unknown_wrap_mode_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="got wrap mode 5 in sampler 0, expected 10497, 33071 or 33648; export it again"):
        load_scene(written(printed(UV, 5, REPEAT), tmp_path))


def test_a_repeating_picture_stays_as_it_was(tmp_path: Path) -> None:
    plain, said = load_scene(written(printed(WIDE), tmp_path)), load_scene(written(printed(WIDE, REPEAT, REPEAT), tmp_path))
    assert plain.digest == said.digest


def test_unlit_is_matt_and_said_so(tmp_path: Path) -> None:
    scene = load_scene(written(unlit(), tmp_path))
    assert scene.materials[0].gloss is None
    assert scene.notes == ('material "sign" is unlit: taken as matt, lit as all others',)


def test_colours_of_vertices_reach_texels_and_light(tmp_path: Path) -> None:
    """Means over texels are exact, since colours are linear over a triangle; a brighter half sends back more light."""
    scene = load_scene(written(coloured("<f4", 3), tmp_path))
    atlas = build_atlas(scene, 16)
    whole = np.einsum("t,tc->c", atlas.area, atlas.albedo) / atlas.area.sum()
    np.testing.assert_allclose(whole, COLOURS[HALVES].mean((0, 1)) * [0.25, 0.5, 0.75], atol=1e-9)
    thirds = np.tile(np.eye(3), (2, 1, 1))
    np.testing.assert_allclose(mean_albedo(scene, np.arange(2), thirds), COLOURS[HALVES].mean(1) * [0.25, 0.5, 0.75], atol=1e-9)
    assert scene.digest != load_scene(written(placed(material=GREY), tmp_path)).digest


def test_light_from_coloured_walls_is_as_from_painted_ones(tmp_path: Path) -> None:
    """One colour at all vertices is that colour of the material."""

    def room(*, vertices: bool) -> Scene:
        tint, writer = np.array([0.25, 0.5, 0.75]), Writer()
        writer.paint(
            {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1] if vertices else [*tint, 1], "metallicFactor": 0}}
        )
        more = {"COLOR_0": writer.accessor(np.tile(tint, (4, 1)))} if vertices else {}
        mesh = writer.quad(material=0, **more)
        writer.node(mesh=mesh)
        writer.node(mesh=mesh, rotation=[1, 0, 0, 0], translation=[0, 1, 1])  # faces the other
        return load_scene(writer.glb(tmp_path / "room.glb"))

    lamp = {"type": "point", "position": [0.5, 0.5, 0.5], "intensity": [1, 1, 1]}
    place = np.array([[1.0, 0.5, 0.0]]), np.array([[0.0, 0, 1]])
    (_, one), (_, other) = (irradiance(room(vertices=flag), lamp, *place, samples=256, seed=3) for flag in (True, False))
    assert (other > 0).all()
    np.testing.assert_allclose(one, other, rtol=1e-5)


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (np.ones((4, 2)), "got vertex colours .* of VEC2, expected VEC3 or VEC4"),
        (np.ones((3, 3)), "got 3 colours for 4 vertices"),
        (-np.ones((4, 3)), "vertex colours that are not 0 to 1"),
        (np.full((4, 3), np.nan), "vertex colours that are not 0 to 1"),
    ],
)
def test_colours_that_cannot_be(tmp_path: Path, rows: np.ndarray, says: str) -> None:
    with pytest.raises(UserError, match=says):
        load_scene(written(placed(material=GREY, COLOR_0=lambda writer: writer.accessor(rows)), tmp_path))


def test_odd_colours_are_told(tmp_path: Path) -> None:
    bright = np.column_stack([COLOURS * 2, np.full(4, 0.5)])
    scene = load_scene(written(placed(material=GREY, COLOR_0=lambda writer: writer.accessor(bright)), tmp_path))
    assert scene.colour is not None
    assert scene.colour.max() == 1
    assert "vertex colours above 1 are taken as 1" in scene.notes
    assert any("ignored in the file: opacity of vertex colours" in note for note in scene.notes)
    white = load_scene(written(placed(material=GREY, COLOR_0=lambda writer: writer.accessor(np.ones((4, 4)))), tmp_path))
    assert white.colour is None
    assert white.digest == load_scene(written(placed(material=GREY), tmp_path)).digest


def test_corners_left_over_are_told(tmp_path: Path) -> None:
    scene = load_scene(written(placed(index=[0, 1, 2, 0, 2]), tmp_path))
    assert len(scene.triangles) == 1
    assert any("corners after the last whole triangle" in note for note in scene.notes)


def test_compressed_pictures_are_named(tmp_path: Path) -> None:
    writer = printed(UV).writer
    uri = "data:image/ktx2;base64," + base64.b64encode(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(64)).decode()
    writer.json["images"] = [{"uri": uri}]
    with pytest.raises(UserError, match="image 0 as KTX2, which is not read; export textures as PNG"):
        load_scene(writer.glb(tmp_path / "a.glb"))
