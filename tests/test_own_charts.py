"""A lightmap layout of the file's own: taken to the last bit where it is sound, named and replaced where it is not."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gltf_files import HALVES, QUAD, Writer

import ddprt
from ddprt.config import load_config
from ddprt.dataset.sameness import baked_settings
from ddprt.errors import UserError
from ddprt.files import read_tensors
from ddprt.pipeline_inspect import examine
from ddprt.scene.atlas import build_atlas
from ddprt.scene.files import load_scene
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import charted, fault_of, own_charts
from ddprt.scene.unwrap import unwrap
from ddprt.transport.configured import configured_scene

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")

LEFT = np.array([[0.05, 0.1], [0.45, 0.1], [0.45, 0.3], [0.05, 0.3]])
"""Upright, in the upper left: nothing that is turned or mirrored is the same."""
RIGHT = np.array([[0.6, 0.55], [0.95, 0.6], [0.9, 0.9], [0.62, 0.8]])


def moved(right: float, down: float = 0.0) -> np.ndarray:
    return LEFT + np.array([right, down])


def two(
    first: np.ndarray | None = LEFT, second: np.ndarray | None = RIGHT, *, one_mesh: bool = False, **material: object
) -> Writer:
    """Two rectangles that face each other, a metre apart, with layouts."""
    writer = Writer()
    writer.paint({"pbrMetallicRoughness": {"metallicFactor": 0}, **material})
    turned = {"rotation": [1, 0, 0, 0], "translation": [0, 1, 1]}
    for layout, place in ((first, {}), (second, turned)):
        own = {} if layout is None else {"TEXCOORD_1": writer.accessor(layout)}
        writer.node(mesh=0 if one_mesh and place else writer.quad(material=0, **own), **place)
    return writer


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    return two().glb(tmp_path / "two.glb")


def expected() -> np.ndarray:
    return np.concatenate([LEFT[HALVES], RIGHT[HALVES]]).astype(np.float32)


def test_the_layout_is_the_files_to_the_last_bit(sound: Path) -> None:
    scene = load_scene(sound)
    atlas = build_atlas(scene, 64)
    np.testing.assert_array_equal(atlas.uv, expected())
    np.testing.assert_array_equal(atlas.chart[[0, -1]], [0, 1])
    np.testing.assert_allclose(atlas.area.sum(), 4, rtol=1e-9)
    # Row 0 is the top, v counts from there: the first rectangle's texels lie in the upper left and below is its y = 1.
    first = atlas.chart == 0
    row, column = np.divmod(atlas.texel[first], 64)
    assert row.max() < 0.31 * 64
    assert column.max() < 0.46 * 64
    np.testing.assert_allclose(atlas.position[first, 0], ((column + 0.5) / 64 - 0.05) / 0.4 * 2, atol=0.06)
    np.testing.assert_allclose(atlas.position[first, 1], ((row + 0.5) / 64 - 0.1) / 0.2, atol=0.06)


def test_a_mirrored_layout_is_as_good(tmp_path: Path) -> None:
    scene = load_scene(two(LEFT[:, ::-1], RIGHT).glb(tmp_path / "two.glb"))
    assert fault_of(scene, 64, 2) == ""
    np.testing.assert_allclose(build_atlas(scene, 64).area.sum(), 4, rtol=1e-9)


@pytest.mark.parametrize(
    ("writer", "says"),
    [
        (lambda: two(LEFT, LEFT), "lies on itself"),
        (lambda: two(one_mesh=True), "lies on itself, as where several nodes share a mesh"),
        (lambda: two(LEFT, moved(0.2, 0.1)), "lies on itself"),
        (lambda: two(LEFT, np.add(RIGHT, [0.1, 0])), "reaches from 0.05 to 1.05, beyond the unit square"),
        (lambda: two(moved(-0.06), RIGHT), "reaches from -0.01"),
        (lambda: two(LEFT, None), "leaves out 2 of 4 triangles"),
        (lambda: two(LEFT, np.tile(RIGHT[:1], (4, 1))), "has 2 triangles of no area"),
        (lambda: two(LEFT, RIGHT[[0, 1, 1, 3]]), "has 1 triangles of no area"),
        (lambda: two(doubleSided=True), "has no place for the backs"),
        (lambda: two(LEFT, moved(0.4 + 0.1 / 64)), "has charts in the same texels at atlas.resolution 64"),
        (lambda: two(LEFT, moved(0.4 + 2.1 / 64)), "has charts only 1 texels apart .* lower atlas.padding to 1"),
        (lambda: two(np.full((4, 2), np.inf), RIGHT), "reaches from 0.55 to inf, beyond the unit square"),
    ],
)
def test_a_faulty_layout_is_named_and_replaced(tmp_path: Path, writer: Callable[[], Writer], says: str) -> None:
    scene = load_scene(writer().glb(tmp_path / "two.glb"))
    new = charted(scene, "auto", 64, 2)
    assert new.lightmap is None
    assert re.search(f"lightmap: the file's own layout is not used, since it {says}", new.notes[-1])
    with pytest.raises(UserError, match=f'atlas.use: got "own", but the layout of "two" {says}.*; mend'):
        charted(scene, "own", 64, 2)
    uv, _ = unwrap(scene, 64, 2)  # who asks for no note gets charts that are sound all the same
    assert ((uv >= 0) & (uv <= 1)).all()
    assert scene.lightmap is not None
    assert not np.array_equal(uv, scene.lightmap[scene.triangles])


def test_gaps_count_in_texels_of_the_asked_resolution(tmp_path: Path) -> None:
    """What is too near at 64 is far enough at twice that."""
    scene = load_scene(two(LEFT, moved(0.4 + 2.1 / 64)).glb(tmp_path / "two.glb"))
    assert "only 1 texels apart" in fault_of(scene, 64, 2)
    assert fault_of(scene, 64, 1) == ""
    assert fault_of(scene, 128, 2) == ""


def test_what_xatlas_packs_is_sound(cornell: Scene) -> None:
    uv, chart = unwrap(cornell, 64, 2)
    corner = cornell.triangles.ravel()
    split = replace(
        cornell,
        positions=cornell.positions[corner],
        normals=cornell.normals[corner],
        triangles=np.arange(len(corner), dtype=np.int32).reshape(-1, 3),
        lightmap=uv.reshape(-1, 2),
    )
    assert fault_of(split, 64, 2) == ""
    own, again = own_charts(split)
    np.testing.assert_array_equal(own, uv)
    pairs = {(int(a), int(b)) for a, b in zip(chart, again, strict=True)}
    assert len(pairs) == len(set(chart.tolist())) == len(set(again.tolist()))


def test_the_setting_decides(sound: Path) -> None:
    def scene(use: str) -> Scene:
        return configured_scene(
            load_config(None, {"scene.name": f'"{sound}"', "atlas.use": f'"{use}"', "atlas.resolution": "64"})
        )

    auto, own, new = (scene(use) for use in ("auto", "own", "new"))
    assert auto.notes[-1] == own.notes[-1] == "lightmap: the file's own second texture coordinates are used"
    assert auto.digest == own.digest != new.digest
    assert new.lightmap is None
    assert new.notes[-1] == "lightmap: the file's own layout is not used, as asked"
    assert charted(auto, "auto", 64, 2) is auto  # asked twice, said once
    with pytest.raises(UserError, match='got "own", but "cornell" has no second texture coordinates'):
        configured_scene(load_config(None, {"atlas.use": '"own"'}))


def test_settings_of_older_datasets_stay_as_they_were(cornell: Scene) -> None:
    assert baked_settings(load_config(None), cornell)["atlas"] == {"resolution": 256, "padding": 2}


@pytest.mark.slow
def test_inspect_says_whose_charts_they_are(sound: Path) -> None:
    more = {"lightings.train": "1", "atlas.resolution": "32", "transport.samples": "1", "transport.test_samples": "2"}
    more |= {"lightings.kinds": '["point"]', "transport.bounces": "0"}
    assert "2 charts of the file" in examine(str(sound), more).text
    told = examine(str(sound), {**more, "atlas.use": '"new"'}).text
    assert "of the file" not in told
    assert "is not used, as asked" in told


@pytest.mark.slow
def test_a_dataset_keeps_the_files_layout(sound: Path, tmp_path: Path) -> None:
    lamp = [[{"type": "point", "position": [x, 0.5, 0.5], "intensity": [1, 1, 1]}] for x in (0.5, 1.0, 1.5)]
    (tmp_path / "lamps.json").write_text(json.dumps(lamp))
    config = load_config(
        None,
        {
            "atlas.resolution": "32",
            "lightings.file": f'"{tmp_path / "lamps.json"}"',
            **{f"lightings.{split}": "1" for split in ("train", "validation", "test")},
            "transport.samples": "1",
            "transport.test_samples": "2",
            "points.count": "4",
        },
    )
    ddprt.bake(load_scene(sound), config=config, out=tmp_path / "set")
    kept = read_tensors(tmp_path / "set" / "scene.safetensors")["uv"]
    np.testing.assert_array_equal(kept, expected())


def test_layouts_follow_what_checks_do_to_vertices(tmp_path: Path) -> None:
    """A triangle without area and a vertex of no triangle go; the others keep their places."""
    writer = two()
    primitive = writer.json["meshes"][0]["primitives"][0]
    primitive["attributes"]["POSITION"] = writer.accessor(np.concatenate([QUAD[:1] + 9, QUAD]))
    primitive["attributes"]["NORMAL"] = writer.accessor(np.array([[0.0, 0, 1]] * 5))
    primitive["attributes"]["TEXCOORD_1"] = writer.accessor(np.concatenate([LEFT[:1], LEFT]))
    primitive["indices"] = writer.accessor(np.concatenate([[1, 1, 2], 1 + HALVES.ravel()]), "<u2")
    scene = load_scene(writer.glb(tmp_path / "two.glb"))
    assert scene.lightmap is not None
    np.testing.assert_array_equal(scene.lightmap[scene.triangles], expected())
