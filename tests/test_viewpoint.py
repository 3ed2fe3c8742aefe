"""Cameras of glTF files: where the first of them stands is where reports and the viewer look from."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gltf_files import Writer, one
from small_job import base

import ddprt
from ddprt.dataset.generate import bake
from ddprt.errors import UserError
from ddprt.export.viewer.pack import pack
from ddprt.report.view import camera_for, default_camera
from ddprt.scene.files import load_scene
from ddprt.scene.mesh import Scene
from ddprt.scene.viewpoint import Viewpoint

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")

LENS = {"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}
FLAT = {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "zfar": 9, "znear": 0.1}}
HALF = np.sqrt(0.5)


def filmed(*cameras: dict, at: tuple[int, ...] = (0,)) -> Writer:
    """A triangle about the origin, and cameras 3 m along x that look back at it, each at a node below one that is scaled."""
    writer = one()
    writer.json["cameras"] = list(cameras)
    for number in at:
        eye = writer.node(root=False, camera=number, translation=[0, 1, 0], rotation=[0, HALF, 0, HALF])
        writer.node(children=[eye], translation=[3, 0, 0], scale=[2, 2, 2])
    return writer


def test_the_first_perspective_camera_is_the_first_view(tmp_path: Path) -> None:
    wide = {**LENS, "name": "door", "perspective": {**LENS["perspective"], "aspectRatio": 2.0}}  # type: ignore[dict-item]
    scene = load_scene(filmed(FLAT, wide, LENS, LENS, at=(0, 1, 2)).glb(tmp_path / "a.glb"))
    camera = default_camera(scene)
    np.testing.assert_allclose(camera.eye, [3, 2, 0], atol=1e-12)
    np.testing.assert_allclose(camera.axes, [[0, 0, -1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)  # right, up, forward
    np.testing.assert_allclose(camera.target, [0.5, 2, 0], atol=1e-12)  # as far as the triangle's middle
    np.testing.assert_allclose(camera.reach, np.tan(0.25) * np.array([2, 1]))
    assert scene.notes[-2:] == (
        'first view: camera "door" of the file',
        "ignored in the file: 1 orthographic cameras, 1 further cameras, 1 cameras at no node",
    )
    plain = load_scene(one().glb(tmp_path / "b.glb"))
    assert plain.viewpoint is None
    assert plain.digest == scene.digest
    assert default_camera(plain) == camera_for("a", plain.corners) != camera


def test_no_shape_of_a_picture_is_the_usual_one(tmp_path: Path) -> None:
    assert default_camera(load_scene(filmed(LENS).glb(tmp_path / "a.glb"))).aspect == pytest.approx(4 / 3)


@pytest.mark.parametrize("at", [(0,), ()])
def test_other_cameras_are_listed_and_change_nothing(tmp_path: Path, at: tuple[int, ...]) -> None:
    scene = load_scene(filmed(FLAT, at=at).glb(tmp_path / "a.glb"))
    assert scene.viewpoint is None
    assert scene.notes[1:] == (f"ignored in the file: 1 {'orthographic cameras' if at else 'cameras at no node'}",)


@pytest.mark.parametrize(
    ("camera", "at", "says"),
    [
        (
            {"type": "perspective", "perspective": {"yfov": 0.0}},
            0,
            "got yfov 0.0 of camera 0, expected an angle between 0 and pi",
        ),
        ({"type": "perspective", "perspective": {"yfov": 3.2}}, 0, "got yfov 3.2 of camera 0"),
        ({"type": "perspective"}, 0, "got yfov None of camera 0"),
        ({"type": "perspective", "perspective": {"yfov": 1, "aspectRatio": 0.0}}, 0, "got aspectRatio 0.0 of camera 0"),
        ({"type": "fisheye"}, 0, 'got camera 0 of type "fisheye", expected perspective or orthographic'),
        (LENS, 4, "got number 4 among cameras, expected one of the 1 there are"),
    ],
)
def test_faulty_cameras_are_refused(tmp_path: Path, camera: dict, at: int, says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        load_scene(filmed(camera, at=(at,)).gltf(tmp_path / "a.gltf"))
    assert "\n" not in str(caught.value)


def test_a_camera_without_extent_sees_nothing(tmp_path: Path) -> None:
    writer = filmed(LENS)
    writer.json["nodes"][2]["scale"] = [0, 0, 0]
    with pytest.raises(UserError, match=r"a\.glb: camera 0: got .* from where nothing can be seen"):
        load_scene(writer.glb(tmp_path / "a.glb"))


EYE = Viewpoint((0.3, 0.25, 0.5), (0.2, 0.2, 0.0), (0.0, 1.0, 0.1), 70.0, 1.5)


def test_a_dataset_keeps_the_viewpoint(cornell: Scene, tmp_path: Path) -> None:
    small = base(atlas__resolution=24, lightings__train=2, lightings__validation=1, lightings__test=1, transport__samples=1)
    bake(replace(cornell, viewpoint=EYE), config=small, out=tmp_path)
    assert ddprt.open_dataset(tmp_path).viewpoint == EYE
    for eye in (EYE, replace(EYE, fov_deg=50.0)):  # the same light: nothing is baked again, and the first view stays
        bake(replace(cornell, viewpoint=eye), config=small, out=tmp_path)
    assert ddprt.open_dataset(tmp_path).viewpoint == EYE


@pytest.mark.parametrize(
    "change", [{"up": [-0.1, -0.05, -0.5]}, {"fov_deg": 180.0}, {"aspect": 0.0}, {"target": EYE.eye}, {"eye": [np.nan] * 3}]
)
def test_a_viewpoint_that_sees_nothing_is_refused(change: dict) -> None:
    assert Viewpoint.of(EYE.record, "here") == EYE
    with pytest.raises(UserError, match=r"^here: got .* from where nothing can be seen"):
        Viewpoint.of(EYE.record | change, "here")
    for given in ({}, EYE.record | {"eye": 1.0}, [1]):
        with pytest.raises(UserError, match=r"^here: got .* expected eye, target, up and fov_deg"):
            Viewpoint.of(given, "here")


@pytest.mark.slow
def test_a_viewpoint_reaches_the_viewer(cornell: Scene, tmp_path: Path) -> None:
    """Through dataset and model, which the viewer knows alone."""
    data = bake(replace(cornell, viewpoint=EYE), config=base(), out=tmp_path / "data")
    ddprt.fit(data, bases=4).save(tmp_path / "model")
    model = ddprt.load_model(tmp_path / "model")
    assert model.viewpoint == EYE
    assert pack(model)["camera"] == {"eye": [0.3, 0.25, 0.5], "target": [0.2, 0.2, 0.0], "fov": 70.0, "up": [0.0, 1.0, 0.1]}
    document = json.loads((tmp_path / "model" / "model.json").read_text())
    document["viewpoint"]["up"] = [0, 0, 0]
    (tmp_path / "model" / "model.json").write_text(json.dumps(document))
    with pytest.raises(UserError, match=r"model\.json: viewpoint: got .* from where nothing can be seen"):
        ddprt.load_model(tmp_path / "model")
