"""Lights of a glTF file: where its nodes put them, in W/sr and W/m²."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gltf_files import Writer, one
from small_job import call

import ddprt
from ddprt import verbs_alone
from ddprt.config import load_config
from ddprt.dataset.splits import choose_lightings
from ddprt.errors import UserError
from ddprt.lights import DirectionalLight, PointLight, SpotLight, load_lightings, scene_lights
from ddprt.scene.files import load_scene
from ddprt.transport.embree import Tracer

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")

POINT = {"type": "point", "intensity": 683.0, "color": [1, 0.5, 0.25], "range": 3}
SPOT = {"type": "spot", "intensity": 1366.0, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.6}}
SUN = {"type": "directional", "intensity": 341.5}


def lit(*lamps: dict, nodes: tuple[dict, ...] = ()) -> Writer:
    writer = one()
    writer.shine(*lamps)
    for number, node in enumerate(nodes or [{"translation": [number, 1, 2]} for number in range(len(lamps))]):
        writer.node(**{"extensions": {"KHR_lights_punctual": {"light": number}}, **node})
    return writer


def test_every_kind_where_its_node_is(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    nodes = {"translation": [1, 2, 3]}, {"translation": [0, 0, 5], "rotation": [-half, 0, 0, half], "scale": [2, 2, 2]}, {}
    path = lit(POINT, SPOT, SUN, nodes=nodes).glb(tmp_path / "lit.glb")
    point, spot, sun = scene_lights(path)
    assert point == PointLight(position=(1, 2, 3), intensity=(1, 0.5, 0.25))
    assert isinstance(spot, SpotLight)
    assert spot.position == (0, 0, 5)
    np.testing.assert_allclose(spot.direction, [0, -1, 0], atol=1e-12)  # -z, turned down
    np.testing.assert_allclose(spot.intensity, [2, 2, 2], rtol=1e-12)
    np.testing.assert_allclose([spot.inner_deg, spot.outer_deg], np.rad2deg([0.2, 0.6]))
    assert sun == DirectionalLight(direction=(0, 0, -1), irradiance=(0.5, 0.5, 0.5))
    assert scene_lights(path, "radiometric")[2] == DirectionalLight(direction=(0, 0, -1), irradiance=(341.5,) * 3)
    assert load_lightings(path) == [(point,), (spot,), (sun,)]
    assert ddprt.scene_lights(str(path)) == (point, spot, sun)
    assert load_scene(path).notes == (
        "no material on some triangles: albedo 0.8 assumed",
        "3 lights in the file, to shine where lightings.file names it",
    )


def test_lights_hang_in_the_hierarchy_and_may_hang_twice(tmp_path: Path) -> None:
    writer = lit(POINT)
    child = writer.node(root=False, translation=[0, 1, 0], extensions={"KHR_lights_punctual": {"light": 0}})
    writer.node(children=[child], scale=[2, 2, 2], translation=[5, 0, 0])
    first, second = scene_lights(writer.gltf(tmp_path / "lit.gltf"))
    assert isinstance(first, PointLight) and isinstance(second, PointLight)  # noqa: PT018
    assert (first.position, second.position) == ((0, 1, 2), (5, 2, 0))


def test_what_a_light_leaves_out_is_as_the_standard_says(tmp_path: Path) -> None:
    (spot,) = scene_lights(lit({"type": "spot"}).glb(tmp_path / "lit.glb"), "radiometric")
    assert isinstance(spot, SpotLight)
    assert (spot.intensity, spot.inner_deg) == ((1, 1, 1), 0)
    np.testing.assert_allclose(spot.outer_deg, 45)


def test_a_hard_rim_is_nearly_as_hard(tmp_path: Path) -> None:
    (spot,) = scene_lights(
        lit({"type": "spot", "spot": {"innerConeAngle": 0.5, "outerConeAngle": 0.5}}).glb(tmp_path / "lit.glb")
    )
    assert isinstance(spot, SpotLight)
    np.testing.assert_allclose(spot.outer_deg, np.rad2deg(0.5))
    assert 0.999 * spot.outer_deg < spot.inner_deg < spot.outer_deg


@pytest.mark.parametrize(
    ("lamps", "says"),
    [
        ([], "got no light, expected some of KHR_lights_punctual in its scene; export punctual lights"),
        ([{"type": "area"}], 'got light 0 of type "area", expected directional, point or spot'),
        ([{"type": "point", "intensity": -1}], "intensity"),
        ([{"type": "spot", "spot": {"innerConeAngle": 0.7, "outerConeAngle": 0.5}}], "inner_deg: got .*expected less than"),
        ([{"type": "spot", "spot": {"outerConeAngle": 2.0}}], "outer_deg"),
        ([{"type": "point", "intensity": "much"}], "got a damaged file, expected glTF 2.0 with KHR_lights_punctual"),
        ([{"type": "point", "color": [1, 1]}], "intensity"),
    ],
)
def test_lights_that_cannot_be(tmp_path: Path, lamps: list, says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        scene_lights(lit(*lamps).glb(tmp_path / "lit.glb"))
    assert "\n" not in str(caught.value)
    assert "lit.glb" in str(caught.value)


def test_a_light_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="got light 1 at a node, expected one of the 1 there are"):
        scene_lights(lit(POINT, nodes=({}, {})).glb(tmp_path / "lit.glb"))
    with pytest.raises(UserError, match="got no such file"):
        scene_lights(tmp_path / "gone.glb")
    (tmp_path / "bad.gltf").write_text("{")
    with pytest.raises(UserError, match="got a damaged file"):
        scene_lights(tmp_path / "bad.gltf")


def test_lightings_file_takes_gltf_and_its_units(tmp_path: Path) -> None:
    path = lit(POINT, SPOT, SUN).glb(tmp_path / "lit.glb")
    counts = {f"lightings.{split}": "1" for split in ("train", "validation", "test")}
    scene = load_scene(path)

    def chosen(**more: str) -> list:
        config = load_config(None, {**counts, "lightings.file": f'"{path}"', **more})
        return choose_lightings(None, config.lightings, scene, Tracer.of(scene), 0)[0]

    entries = chosen()
    assert [split for split, _ in entries] == ["train", "validation", "test"]
    assert [lighting for _, lighting in entries] == load_lightings(path)
    bright = chosen(**{"lightings.gltf_units": '"radiometric"'})
    assert bright[0][1] == load_lightings(path, "radiometric")[0]
    with pytest.raises(UserError, match="got 3 lightings, expected 4"):
        chosen(**{"lightings.train": "2"})


def test_json_lists_are_read_as_before(tmp_path: Path) -> None:
    lamp = {"type": "point", "position": [0, 1, 0], "intensity": [683, 683, 683]}
    (tmp_path / "a.json").write_text(json.dumps([[lamp]]))
    assert load_lightings(tmp_path / "a.json") == [(PointLight(position=(0, 1, 0), intensity=(683,) * 3),)]


def test_relight_takes_the_lights_of_a_file_in_its_units(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The verb asks a model that keeps what shone and answers with black."""
    path, shone = lit(POINT, SUN).glb(tmp_path / "lit.glb"), list[Any]()

    class Dark:
        def measure(self, lighting: Any) -> np.ndarray:
            shone.append(lighting)
            return np.zeros((1, 3))

        def predict(self, values: np.ndarray, lightings: Any) -> np.ndarray:
            return values

        def image(self, light: np.ndarray) -> np.ndarray:
            return np.zeros((2, 2, 3), np.float32)

        def trust(self, values: np.ndarray) -> Any:
            return None

    monkeypatch.setattr(verbs_alone, "_model_at", lambda call, folder: Dark())
    given = ("relight", "model.ddprt", "--lighting", path, "--out", tmp_path / "out.exr")
    for units in ([], ["--units", "photometric"], ["--units", "radiometric"]):
        assert call(*given, *units) == 0
    assert shone == [scene_lights(path), scene_lights(path), scene_lights(path, "radiometric")]
    assert shone[0] != shone[2]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--lighting", "a.glb", "--units", "candela"], '--units: got "candela", expected photometric or radiometric'),
        (["--lighting", "[]", "--units", "radiometric"], "--units: got radiometric for lights of ddprt's own list"),
    ],
)
def test_faulty_units_are_told(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("relight", "model.ddprt", *words) == 2
    assert says in capsys.readouterr().err
