"""glTF back out: what is read again is what went in, by ours and by other readers; what cannot be written is refused."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import trimesh
from made_up_rivals import SHAPE, TEXELS, model_of, relighters
from small_job import SMALL, call
from three_page import needs_three, told_by_three

from ddprt.config import checked as checked_config
from ddprt.errors import UserError
from ddprt.export.animated import check_settings
from ddprt.export.gltf.glb import Glb
from ddprt.export.gltf.materials import material_entry
from ddprt.export.gltf.writing import FILE, export_gltf, preview_lighting, write_gltf
from ddprt.lights import parse_lighting
from ddprt.runtime.model import Model
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.files import load_scene
from ddprt.scene.images import linear_image, plain_image, srgb_to_linear
from ddprt.scene.material import Cutout, Emission, Gloss, Material, Subsurface
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import charted
from ddprt.sections import ExportConfig

LAMP = parse_lighting([{"type": "point", "position": [0.2, 0.3, 0.6], "intensity": [1, 2, 3]}])


def of_scene(scene: Scene, uv: np.ndarray) -> Model:
    """A made-up model of a scene's triangles."""
    return replace(model_of(relighters(3, 3)["plain"]), occluders=scene.corners, uv=uv.astype(np.float32))


def rows_of(corners: np.ndarray, uv: np.ndarray, *more: np.ndarray) -> np.ndarray:
    """Triangles as rows that tell where they are, on the map, and more; sorted, since their order is nobody's concern."""
    rows = np.concatenate([part.reshape(len(corners), -1).astype(np.float32) for part in (corners, uv, *more)], 1)
    return rows[np.lexsort(rows.T[::-1])]


def document(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert (data[:4], struct.unpack_from("<I", data, 8)[0], kind) == (b"glTF", len(data), b"JSON")
    return json.loads(data[20 : 20 + length])


def pictures(seed: int) -> Callable[..., np.ndarray]:
    world = np.random.default_rng(seed)
    return lambda *shape: world.integers(0, 256, shape)


def linear(bytes_: np.ndarray) -> np.ndarray:
    return srgb_to_linear(bytes_ / 255).astype(np.float32)


def painted() -> Scene:
    """Four triangles that share corners, each of a material that has something the others lack."""
    draw = pictures(1)
    plain = lambda *shape: (draw(*shape) / np.float32(255)).astype(np.float32)  # noqa: E731
    opacity = plain(3, 2)
    opacity[0, 0], opacity[1, 0] = 0.2, 0.8
    cutout = Cutout(np.rint(opacity * 255).astype(np.float32) / 255, 0.4)
    materials = (
        Material("red", (0.7, 0.2, 0.1)),
        Material("cut", (0.5, 0.6, 0.7), linear(draw(3, 2, 3)), cutout=cutout),
        Material("bright", (0.1, 0.2, 0.3), linear(draw(2, 4, 3)), emission=Emission((3.0, 40.0, 7.0), linear(draw(2, 3, 3)))),
        Material("metal", (0.9, 0.8, 0.7), gloss=Gloss(0.3, 0.6, texture=plain(2, 2, 2))),
    )
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    uv, colour = np.random.default_rng(2).random((5, 2)) * 2 - 0.5, np.random.default_rng(3).random((5, 3))
    return checked("painted", positions, triangles, material=np.arange(4), materials=materials, uv=uv, colour=colour)


def corners_apart(scene: Scene) -> np.ndarray:
    """Lightmap coordinates of which no two triangles share any."""
    return np.random.default_rng(4).random((len(scene.triangles), 3, 2))


def test_our_reader_finds_the_same_scene(tmp_path: Path) -> None:
    scene = painted()
    uv = corners_apart(scene)
    again = load_scene(str(export_gltf(of_scene(scene, uv), tmp_path, scene)))
    assert again.lightmap is not None
    assert again.uv is not None
    assert scene.uv is not None
    assert again.colour is not None
    assert scene.colour is not None
    names = np.array([material.name for material in again.materials])[again.material]
    numbers = np.array([[material.name for material in scene.materials].index(name) for name in names])
    corner, given = again.triangles, scene.triangles
    textured = np.array([bool(material.textures) for material in scene.materials])[scene.material]  # others need no coordinates
    uvs = again.uv[corner], scene.uv[given] * textured[:, None, None]
    found = rows_of(again.corners, again.lightmap[corner], uvs[0], again.colour[corner], again.normals[corner], numbers)
    expected = rows_of(scene.corners, uv, uvs[1], scene.colour[given], scene.normals[given], scene.material)
    np.testing.assert_array_equal(found, expected)
    assert not any("ignored" in note for note in again.notes)
    for material in again.materials:
        source = next(entry for entry in scene.materials if entry.name == material.name)
        np.testing.assert_allclose(material.albedo, source.albedo, rtol=1e-6)
        assert set(material.textures) == set(source.textures)
        for name, image in material.textures.items():
            np.testing.assert_allclose(image, source.textures[name], rtol=1e-6, atol=1e-7)
        assert (material.cutout is None) == (source.cutout is None)
        assert material.cutout is None or material.cutout.cutoff == pytest.approx(0.4)
        assert (material.emission is None) == (source.emission is None)
        assert material.emission is None or material.emission.radiance == pytest.approx((3.0, 40.0, 7.0))
        gloss, told = source.gloss or Gloss(), material.gloss
        assert told is not None
        assert (told.roughness, told.metallic) == (gloss.roughness, gloss.metallic)


def test_other_readers_find_the_same_triangles(tmp_path: Path) -> None:
    scene = painted()
    uv = corners_apart(scene)
    path = export_gltf(of_scene(scene, uv), tmp_path, scene)
    mesh = trimesh.load(str(path), force="mesh", process=False)
    places = lambda corners: rows_of(np.asarray(corners), np.zeros((len(corners), 0)))  # noqa: E731
    np.testing.assert_array_equal(places(mesh.triangles), places(scene.corners))
    file = pygltflib.GLTF2().load(str(path))
    blob, entry = file.binary_blob(), file.accessors
    found = []
    for primitive in file.meshes[0].primitives:
        index, second = entry[primitive.indices], entry[primitive.attributes.TEXCOORD_1]
        assert index.count == 3
        rows = [
            np.frombuffer(blob, kind, size * one.count, file.bufferViews[one.bufferView].byteOffset).reshape(-1, size)
            for one, kind, size in ((second, "<f4", 2), (index, "<u4", 1))
        ]
        found.append(rows[0][rows[1][:, 0]])
        low, high = entry[primitive.attributes.POSITION].min, entry[primitive.attributes.POSITION].max
        assert np.all(np.array(low) <= np.array(high))
    np.testing.assert_array_equal(np.stack(found), np.float32(uv))
    told = document(path)
    assert told["nodes"][0]["extras"]["ddprt"] == {"manifest": "manifest.json", "lightmap": "TEXCOORD_1", "left_out": []}
    assert told["extensionsUsed"] == ["KHR_materials_emissive_strength"]
    assert all("extensions" not in material for material in told["materials"] if material["name"] != "bright")


def test_a_room_keeps_its_texels(cornell: Scene, cornell_atlas: Atlas, tmp_path: Path) -> None:
    """Corners that agree in all are one vertex, and the atlas of what is read again is that which was written."""
    path = export_gltf(of_scene(cornell, cornell_atlas.uv), tmp_path, cornell)
    again = load_scene(str(path))
    assert again.lightmap is not None
    np.testing.assert_array_equal(
        rows_of(again.corners, again.lightmap[again.triangles]), rows_of(cornell.corners, np.float32(cornell_atlas.uv))
    )
    assert len(again.positions) < 3 * len(again.triangles)
    atlas = build_atlas(charted(again, "own", 64, 2), 64)
    np.testing.assert_array_equal(atlas.texel, cornell_atlas.texel)
    np.testing.assert_allclose(atlas.position, cornell_atlas.position, atol=1e-5)
    np.testing.assert_allclose(atlas.albedo, cornell_atlas.albedo, atol=1e-5)


def test_without_a_scene_it_is_painted_with_the_texels(tmp_path: Path) -> None:
    model = model_of(relighters(3, 3)["plain"])
    albedo = (0.1 + 0.8 * np.random.default_rng(6).random((TEXELS, 3))).astype(np.float32)
    model = replace(model, albedo=albedo)
    again = load_scene(str(export_gltf(model, tmp_path, None)))
    assert again.lightmap is not None
    assert model.uv is not None
    np.testing.assert_array_equal(rows_of(again.corners, again.lightmap[again.triangles]), rows_of(model.occluders, model.uv))
    (material,) = again.materials
    assert material.texture is not None
    assert material.texture.shape == (*SHAPE, 3)
    np.testing.assert_allclose(material.texture[model.covered], albedo, atol=0.005)
    grey = load_scene(str(export_gltf(replace(model, albedo=None), tmp_path, None)))
    assert grey.materials[0].albedo == pytest.approx((0.8,) * 3)


def test_what_is_not_written_is_named(tmp_path: Path) -> None:
    wax = Material("wax", (0.5,) * 3, subsurface=Subsurface((0.9,) * 3, (0.1,) * 3), gloss=Gloss(dielectric=0.02))
    box = trimesh.creation.box()
    scene = checked("box", box.vertices, box.faces, materials=(wax,))
    uv = corners_apart(scene)
    told = document(path := export_gltf(of_scene(scene, uv), tmp_path, scene))
    again = load_scene(str(path))
    assert again.lightmap is not None
    np.testing.assert_array_equal(
        rows_of(again.corners, again.lightmap[again.triangles]), rows_of(scene.corners, uv), "vertices are cut where charts are"
    )
    assert told["nodes"][0]["extras"]["ddprt"]["left_out"] == ["subsurface"]
    index = told["materials"][0]["extensions"]["KHR_materials_ior"]["ior"]
    assert ((index - 1) / (index + 1)) ** 2 == pytest.approx(0.02)


def test_preview_is_irradiance(tmp_path: Path) -> None:
    made_up = model_of(relighters(3, 3)["plain"])
    model = replace(made_up, occluders=made_up.occluders.astype(np.float64))
    path = export_gltf(model, tmp_path, None, lighting=LAMP)
    told = document(path)
    shown = told["materials"][0]["extensions"]["MOZ_lightmap"]
    assert told["extensionsUsed"] == ["MOZ_lightmap"]
    assert shown["texCoord"] == 1
    view = told["bufferViews"][told["images"][told["textures"][shown["index"]]["source"]]["bufferView"]]
    start = path.read_bytes().index(b"BIN\0") + 4 + view["byteOffset"]
    image = linear_image(path.read_bytes()[start : start + view["byteLength"]]) * shown["intensity"]
    expected = np.maximum(model.relight(LAMP), 0)
    assert shown["intensity"] == pytest.approx(float(expected.max()), rel=1e-3)
    np.testing.assert_allclose(image[model.covered], expected[model.covered], atol=0.006 * expected.max())
    dark = parse_lighting([{"type": "point", "position": [0.2, 0.3, -5], "intensity": [0, 0, 0]}])
    with pytest.raises(UserError, match=r"export\.gltf_preview: got a lighting that sends no light"):
        export_gltf(model, tmp_path, None, lighting=dark)


def test_masks_of_another_size_are_brought_to_the_larger(tmp_path: Path) -> None:
    glb, opacity = Glb(), np.array([[0.0, 1.0]], np.float32)
    material = Material("leaf", (0.5,) * 3, np.full((4, 4, 3), 0.25, np.float32), cutout=Cutout(opacity))
    material_entry(glb, material)
    image = Path(tmp_path / "leaf.png")
    image.write_bytes(bytes(glb.data))
    assert plain_image(image.read_bytes())[..., 3].shape == (4, 4)
    np.testing.assert_allclose(plain_image(image.read_bytes())[0, :, 3], [0.25, 0.25, 0.75, 0.75], atol=0.002)
    np.testing.assert_allclose(linear_image(image.read_bytes()), 0.25, atol=0.003)


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (lambda model, folder: export_gltf(replace(model, uv=None), folder, None), "without triangles or lightmap coordinates"),
        (lambda model, folder: export_gltf(model, folder, painted()), 'got the scene "painted" of other triangles'),
        (lambda model, folder: check_settings({"gltf": True}), r"export\.gltf: got true with an animation"),
        (lambda model, folder: preview_lighting(str(folder / "no.json")), r"no\.json: got No such file"),
        (lambda model, folder: checked_config({"export": {"gltf_preview": "a.json"}}), 'got "a.json" with gltf = false'),
    ],
)
def test_what_cannot_be_written_is_refused(work: Callable[[Model, Path], object], words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=words):
        work(model_of(relighters(3, 3)["plain"]), tmp_path)
    assert not any(tmp_path.iterdir())


def test_it_goes_when_it_is_no_longer_asked_for(tmp_path: Path) -> None:
    model = model_of(relighters(3, 3)["plain"])

    def never() -> Scene | None:
        raise AssertionError

    write_gltf(model, tmp_path, ExportConfig(gltf=True), lambda: None)
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    write_gltf(model, tmp_path, ExportConfig(), never)
    assert not any(tmp_path.iterdir())


COUNTED = """
  const { GLTFLoader } = await import("three/examples/jsm/loaders/GLTFLoader.js");
  const { scene } = await new GLTFLoader().loadAsync("/model/scene.glb"), meshes = [];
  scene.traverse((node) => node.isMesh && meshes.push(node));
  const marked = [];
  scene.traverse((node) => node.userData.ddprt && marked.push(node.userData.ddprt.manifest));
  const place = ({ geometry: { index, attributes: { uv1, position } } }) => Array.from(index.array, (i) =>
    [position.getX(i), position.getY(i), position.getZ(i), uv1.getX(i), uv1.getY(i)]);
  told = { corners: meshes.flatMap(place), marked, shiny: meshes.map(({ material }) => material.metalness),
    bright: meshes.map(({ material }) => material.emissiveIntensity) };
"""


@pytest.mark.slow
@needs_three
def test_three_opens_it(tmp_path: Path) -> None:
    scene = painted()
    uv = corners_apart(scene)
    (tmp_path / "made").mkdir()
    export_gltf(of_scene(scene, uv), tmp_path / "made", scene)
    told = told_by_three(COUNTED, tmp_path / "made", tmp_path)
    corners = np.array(told["corners"]).reshape(-1, 3, 5)
    np.testing.assert_allclose(rows_of(corners[..., :3], corners[..., 3:]), rows_of(scene.corners, uv), atol=1e-7)
    assert told["marked"] == ["manifest.json"]
    assert sorted(told["shiny"]) == [0, 0, 0, 0.6]
    assert max(told["bright"]) == pytest.approx(40)


@pytest.mark.slow
def test_a_run_writes_it(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "lamp.json").write_text('[[{"type": "point", "position": [0.3, 0.4, 0.2], "intensity": [1, 1, 1]}]]')
    asked = ["--export.gltf", "true", "--export.gltf_preview", tmp_path / "lamp.json", "--export.engines", '["three"]']
    assert call("run", tmp_path / "small.toml", "--out", tmp_path / "run", *asked) == 0
    told = document(tmp_path / "run/export" / FILE)
    assert all("MOZ_lightmap" in material["extensions"] for material in told["materials"])
    again = load_scene(str(tmp_path / "run/export" / FILE))
    assert len(again.triangles) == len(load_scene("cornell").triangles)
