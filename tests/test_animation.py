"""A bake of poses, one basis of them all, matrices for each or for all: laws, closed forms, and the way through the verbs."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import call

import ddprt
from ddprt.config import Config, checked, load_config
from ddprt.dataset.animated import AnimatedData, bake_animation, open_animation, refuse_still
from ddprt.dataset.store import open_dataset
from ddprt.errors import UserError
from ddprt.export.animated import export_animated
from ddprt.export.deployed import export_model
from ddprt.export.viewer.pack import pack
from ddprt.files import read_tensors, write_tensors
from ddprt.lights import parse_lighting
from ddprt.pipeline_animation import AnimatedRun
from ddprt.pipeline_inspect import examine
from ddprt.report.animated import at_pose, maps, noise, picture, poses, score, table
from ddprt.runtime.animated import AnimatedModel
from ddprt.runtime.animated_file import load_animated
from ddprt.runtime.train import fit_config
from ddprt.runtime.train_animated import fit_animation
from ddprt.sampling.points import Samples
from ddprt.scene.exr import write_exr
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.poses import Animation, load_animation, posed
from ddprt.scene.shapes import box, faceted, rectangle
from ddprt.transport.configured import configured_scene
from ddprt.transport.effects import plan
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure

DOCS = Path(__file__).parent.parent / "docs"
ARM = {"rings": 6, "around": 6}
RIDGE = 1e-3
JOB = {
    "scene": {"name": "bending", "parameters": ARM},
    "animation": {"keys": [0.0, 0.5], "between": [0.25]},
    "atlas": {"resolution": 32},
    "lightings": {"train": 6, "validation": 2, "test": 3, "distribution": "around", "kinds": ["directional"]},
    "points": {"count": 12, "supersample": 2},
    "transport": {"samples": 16, "test_samples": 16, "threads": 2},
    "fit": {"bases": 4, "ridge": RIDGE},
}


def job(**sections: dict) -> Config:
    return checked({name: {**JOB.get(name, {}), **sections.get(name, {})} for name in {*JOB, *sections}})


@pytest.fixture(scope="module")
def arm() -> Animation:
    return load_animation("bending", keys=[0.0, 0.5], **ARM)


@pytest.fixture(scope="module")
def data(arm: Animation, tmp_path_factory: pytest.TempPathFactory) -> AnimatedData:
    return bake_animation(arm, config=job(), out=tmp_path_factory.mktemp("moving"))


@pytest.fixture(scope="module")
def models(data: AnimatedData) -> dict[str, AnimatedModel]:
    return fit_animation(data, job())


@pytest.mark.slow  # compiles two fits
def test_one_key_is_the_scene_that_stands_still(tmp_path: Path) -> None:
    scene, config = build("bending", **ARM), job(animation={"keys": 1})
    still = ddprt.bake(scene, config=job(animation={"keys": 0}), out=tmp_path / "still")
    moving = bake_animation(load_animation("bending", keys=1, **ARM), config=config, out=tmp_path / "moving")
    (key,) = moving.keys
    assert moving.between == ()
    for name in ("direct/000003.exr", "indirect/000003.exr", "indirect/000009.exr", "measured/000001.safetensors"):
        assert (still.folder / name).read_bytes() == (key.folder / name).read_bytes()
    assert key.samples.digest == still.samples.digest
    assert not any(effect["called"] for effect in still.description["plan"] if effect["name"] == "animation")
    assert [effect["called"] for effect in key.description["plan"] if effect["name"] == "animation"] == [True]
    expected = fit_config(still, config, "svd-ridge")
    found = fit_animation(moving, config)
    assert set(found) == {"one", "each"}
    for model in found.values():
        for name in ("matrix", "offset", "intercept", "basis", "mean"):
            np.testing.assert_array_equal(getattr(model.at(0.0).relighter, name), getattr(expected.relighter, name))
        light = {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": [1, 1, 1]}
        np.testing.assert_array_equal(model.relight(light, time=0.0), expected.relight(light))
        values = np.random.default_rng(0).random((12, 3))
        assert model.at(0.0).trust(values).score == expected.trust(values).score


def test_light_moves_with_what_it_lights(data: AnimatedData) -> None:
    """Moved as a whole, lamps and all, a pose has the same light: the same rays, from float32 of other places."""
    scene, key = data.animation.key(1), data.keys[1]
    splits = {
        name: [parse_lighting(key.description["lightings"][i]["lights"]) for i in key.split(name)][:1]
        for name in ("train", "validation", "test")
    }
    lamp = [{"type": "point", "position": [0.9, 1.1, 0.4], "intensity": [2, 1, 1]}]
    step = np.array([4.0, -2.0, 8.0])
    moved = posed(data.animation.scene, scene.positions + step, "gone")
    away = [{"type": "point", "position": (np.array([0.9, 1.1, 0.4]) + step).tolist(), "intensity": [2, 1, 1]}]
    here, there = (
        ddprt.bake(pose, splits | {"train": [*splits["train"], parse_lighting(light)]}, config=job())
        for pose, light in ((scene, lamp), (moved, away))
    )
    for kind in ("direct", "indirect"):
        one, other = here.maps(kind, [0, 1]), there.maps(kind, [0, 1])
        assert np.abs(one - other).mean() < 2e-3 * one.mean(), kind
    np.testing.assert_allclose(here.area, there.area, rtol=1e-5)


def test_every_pose_has_its_own_light_and_the_same_texels(data: AnimatedData, arm: Animation) -> None:
    first, second = data.keys
    np.testing.assert_array_equal(first.uv, second.uv)
    assert first.description["lightings"] != second.description["lightings"]
    (time, between), triangles = data.between[0], arm.scene.triangles
    assert time == 0.125
    assert [len(between.split(name)) for name in ("train", "validation", "test")] == [1, 1, 3]
    for found, positions in ((second, arm.positions[1]), (between, arm.motion(0.125))):
        np.testing.assert_array_equal(found.occluders, positions[triangles])
        np.testing.assert_array_equal(found.samples.position, data.riders.at(positions[triangles]).position)
    again = open_animation(arm, job(), data.folder)
    assert [part.folder for part in again.keys] == [part.folder for part in data.keys]
    with pytest.raises(UserError, match="another pose or atlas"):
        open_animation(arm, job(atlas={"resolution": 64}), data.folder)
    with pytest.raises(UserError, match=r"key-00: got no dataset.*ddprt bake"):
        open_animation(arm, job(), data.folder / "nowhere")


LAMP = [{"type": "point", "position": [0.4, 1.1, 0.3], "intensity": [1, 2, 0.5]}]


def home_of_the_first_pose(data: AnimatedData) -> np.ndarray:
    """The point of each sample, 12 points, by a loop over the first pose."""
    first = data.keys[0].samples
    spread = first.spacing * np.sqrt(2)
    place, turned = (np.linalg.norm(part[:, None] - part[None, :12], axis=2) for part in (first.position, first.normal))
    found = np.hypot(place / spread, turned / np.sqrt(2)).argmin(1)
    return np.where(np.arange(len(found)) < 12, np.arange(len(found)), found)


def grouped(light: np.ndarray, samples: Samples, home: np.ndarray) -> np.ndarray:
    return np.stack([(light * samples.albedo)[home == point].mean(0) for point in range(12)])


def test_samples_stay_with_their_points(data: AnimatedData, models: dict[str, AnimatedModel], tmp_path: Path) -> None:
    """In the datasets of all poses, in a model of any moment, and in what is saved of that."""
    home = home_of_the_first_pose(data)
    moved = data.keys[1].samples
    assert (replace(moved, rest=None).nearest_point(12) != home).any(), "by nearness in its own pose one would change"
    for part in (*data.keys, data.between[0][1], *data.wide):
        again = part if part in data.wide else open_dataset(part.folder)
        light = again.measured([0])[0]
        np.testing.assert_allclose(again.values([0], 12, "radiosity")[0], grouped(light, again.samples, home), rtol=2e-6)
    lamp = parse_lighting(LAMP)
    for time in (0.0, 0.4, 0.5):
        model = models["each"].at(time)
        model.save(tmp_path / "moment")
        models["each"].save(tmp_path / "all")
        for found in (model, load_animated(tmp_path / "all").at(time), ddprt.load_model(tmp_path / "moment")):
            samples = found.samples
            light = measure(Tracer(found.occluders), lamp, samples.position, samples.normal, seed=0, depth=samples.depth)
            np.testing.assert_allclose(found.measure(LAMP), grouped(light, samples, home), rtol=2e-6, atol=1e-9)


def test_older_bakes_whose_samples_change_their_points_are_refused(data: AnimatedData, arm: Animation, tmp_path: Path) -> None:
    shutil.copytree(data.folder, tmp_path / "old")
    path = tmp_path / "old" / "key-01" / "points.safetensors"
    tensors = {name: array for name, array in read_tensors(path).items() if not name.startswith("rest.")}
    assert len(tensors) == 5
    write_tensors(path, tensors)
    with pytest.raises(UserError, match=r"key-01: got samples of an older version.*bake again into another --out"):
        open_animation(arm, job(), tmp_path / "old")


def slow_fit(data: AnimatedData, keys: list[int], U: np.ndarray, area: np.ndarray) -> np.ndarray:
    """M of the red channel: ridge regression of projections on measurements, in float64 with loops over keyframes."""
    D, C = [], []
    for k in keys:
        part, train = data.wide[k], data.wide[k].split("train")
        values = part.values(train, 12, "radiosity")[..., 0].astype(np.float64)
        light = part.maps("indirect", train)[..., 0].astype(np.float64)
        for x, y in zip(values, light, strict=True):
            D.append(x / np.linalg.norm(x))
            C.append(U @ (area / area.sum() * y / np.linalg.norm(x)))
    X, Y = np.array(D), np.array(C)
    return np.linalg.solve(X.T @ X + RIDGE * np.eye(X.shape[1]), X.T @ Y).T


def test_transfers_are_ridge_regressions_onto_one_basis(data: AnimatedData, models: dict[str, AnimatedModel]) -> None:
    each, one = models["each"], models["one"]
    U = np.asarray(each.rest.relighter.basis, np.float64)
    np.testing.assert_array_equal(U, one.rest.relighter.basis)
    area = np.mean([part.area for part in data.wide], 0)
    np.testing.assert_allclose(U * (area / area.sum()) @ U.T, np.eye(4), atol=1e-5)
    assert each.matrix.shape == (2, 3, 4, 12)
    assert one.matrix.shape == (1, 3, 4, 12)
    for k in (0, 1):
        np.testing.assert_allclose(each.matrix[k, 0], slow_fit(data, [k], U, area), atol=2e-4 * np.abs(each.matrix).max())
    np.testing.assert_allclose(one.matrix[0, 0], slow_fit(data, [0, 1], U, area), atol=2e-4 * np.abs(one.matrix).max())


def test_albedo_is_kept_to_be_shown(data: AnimatedData, models: dict[str, AnimatedModel]) -> None:
    model = models["one"].at(0.2)
    for part in data.keys:
        np.testing.assert_array_equal(model.image(model.albedo)[part.covered], part.gbuffer["albedo"])
    assert not any("albedo" in note for note in pack(model)["notes"])


def test_the_basis_is_the_best_of_all_keys_together(data: AnimatedData, models: dict[str, AnimatedModel]) -> None:
    area = np.mean([part.area for part in data.wide], 0)
    rows = []
    for part in data.wide:
        train = part.split("train")
        size = np.linalg.norm(part.values(train, 12, "radiosity").astype(np.float64), axis=1)
        rows.append((part.maps("indirect", train) / size[:, None]).transpose(0, 2, 1).reshape(-1, len(area)))
    sigma = np.linalg.svd(np.concatenate(rows) * np.sqrt(area / area.sum()), compute_uv=False)
    np.testing.assert_allclose(models["one"].rest.relighter.report.singular_values[:4], sigma[:4], rtol=1e-4)


def test_between_keys_matrices_are_mixed_and_places_follow(models: dict[str, AnimatedModel], arm: Animation) -> None:
    each, one = models["each"], models["one"]
    for k, time in enumerate(arm.times.tolist()):
        np.testing.assert_array_equal(each.at(time).relighter.matrix, each.matrix[k])
        np.testing.assert_array_equal(each.at(time).occluders, arm.key(k).corners)
        np.testing.assert_array_equal(each.at(time).area, each.area[k])
    found = each.at(0.4)
    np.testing.assert_allclose(found.relighter.matrix, 0.2 * each.matrix[0] + 0.8 * each.matrix[1], rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(one.at(0.4).relighter.matrix, one.matrix[0])
    straight = 0.2 * arm.positions[0] + 0.8 * arm.positions[1]
    np.testing.assert_allclose(found.occluders, straight[arm.scene.triangles], atol=1e-12)
    exact = arm.motion(0.4)
    bent = each.at(0.4, exact)
    np.testing.assert_array_equal(bent.samples.position, each.riders.at(exact[arm.scene.triangles]).position)
    assert np.abs(bent.samples.position - found.samples.position).max() > 0.01
    for time in (-0.01, 0.51, float("nan")):
        with pytest.raises(UserError, match=r"expected 0 to 0\.5"):
            each.at(time)
    np.testing.assert_array_equal(each.at(0.4, exact.tolist()).occluders, bent.occluders)


def test_moments_that_are_none_are_refused(models: dict[str, AnimatedModel], arm: Animation) -> None:
    model, exact = models["each"], arm.motion(0.4)
    mirrored = replace(model, positions=np.stack([model.positions[0], -model.positions[0]]))
    table = [
        (lambda: model.at(0.4, exact[:-1]), r"positions: got shape .*, a row for each vertex"),
        (lambda: model.at(0.4, exact * np.nan), r"positions: got vertex 0 at \[nan, nan, nan\], expected finite metres"),
        (lambda: model.at(0.4, exact * 1e30), r"positions: got vertex 0 at"),
        (lambda: model.at(0.4, exact * 0), r"positions: got \d+ triangles without area"),
        (lambda: model.at(0.4, exact * [1.0, 1.0, 0.0]), r"positions: got \d+ triangles without area.*mend the pose"),
        (lambda: model.at(0.4, "soon"), "positions: got 'soon', expected an array of numbers"),
        (lambda: mirrored.at(0.25), r"the pose straight between keyframes at 0.25 s: got \d+ triangles.*pass positions"),
        (lambda: model.at("x"), r"time: got 'x', expected 0 to 0\.5"),
        (lambda: model.at(None), "time: got None, expected 0"),
        (lambda: model.at(True), "time: got True, expected 0"),
        (lambda: model.relight(LAMP, time=[0, 1]), r"time: got \[0, 1\], expected 0"),
    ]
    for work, says in table:
        with pytest.raises(UserError, match=says) as caught:
            work()
        assert "\n" not in str(caught.value)
    assert mirrored.at(0.25, exact).occluders.shape == (len(arm.scene.triangles), 3, 3)
    assert model.at(0).area.shape == model.at(np.float32(0.25)).area.shape


def test_saved_is_loaded(models: dict[str, AnimatedModel], tmp_path: Path) -> None:
    light = {"type": "directional", "direction": [-0.4, -1, 0.1], "irradiance": [1, 2, 3]}
    for name, model in models.items():
        model.save(tmp_path / name)
        again = load_animated(tmp_path / name)
        np.testing.assert_array_equal(again.relight(light, time=0.3), model.relight(light, time=0.3))
        assert again.nbytes == model.nbytes
        assert again.statuses == model.statuses
    with pytest.raises(UserError, match=r"each: got a model of an animation, expected .* ddprt\.load_animated"):
        ddprt.load_model(tmp_path / "each")
    models["one"].rest.save(tmp_path / "rest")
    for name in ("model.json", "tensors.safetensors"):
        shutil.copy(tmp_path / "rest" / name, tmp_path / "each" / name)
    with pytest.raises(UserError, match=r"tensors\.safetensors is not what was saved with it"):
        load_animated(tmp_path / "each")
    models["one"].rest.save(tmp_path / "each")  # in its place, a model that stands still
    at_rest = ddprt.load_model(tmp_path / "each")
    np.testing.assert_array_equal(at_rest.relight(light), models["one"].relight(light, time=0.0))
    with pytest.raises(UserError, match=r"got no animation\.json"):
        load_animated(tmp_path / "each")
    for damage, says in (
        (lambda text: text.replace('"schema": 2', '"schema": 1'), "schema 1, expected 2; fit it again"),
        (lambda text: text.replace("statuses", "statutes"), "statuses"),
        (lambda text: text[: len(text) // 2], "animation.json: got"),
    ):
        models["one"].save(tmp_path / "one")
        path = tmp_path / "one" / "animation.json"
        path.write_text(damage(path.read_text()))
        with pytest.raises(UserError, match=says) as caught:
            load_animated(tmp_path / "one")
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"got no animation\.json"):
        load_animated(tmp_path)


@pytest.mark.slow  # two bakes of its own
def test_texels_that_a_pose_buries_are_dark_there_and_kept(tmp_path: Path) -> None:
    """A cube that sinks into the floor: what it covers then had light before."""
    floor = rectangle((-1.0, -1.0), (1.0, 1.0), 0.0, 1, facing=1)
    cube = box(np.array([-0.4, 0.3, -0.4]), np.array([0.4, 0.9, 0.4]))
    scene = faceted("sinking", np.concatenate([floor[None], cube]), (Material("grey", (0.6,) * 3),))
    sunk = scene.positions - np.where(np.arange(len(scene.positions)) < 4, 0.0, 0.6)[:, None] * [0.0, 1.0, 0.0]
    moving = Animation(scene, np.array([0.0, 1.0]), np.stack([scene.positions, sunk]), lambda time: scene.positions)
    config = job(scene={"parameters": {}}, animation={"between": []})
    data = bake_animation(moving, config=config, out=tmp_path)
    up, down = (part.covered for part in data.keys)
    hidden = up & ~down
    assert hidden.sum() > 20
    np.testing.assert_array_equal(data.covered, up | down)
    assert (data.keys[1].gbuffer["albedo"] == np.float32(0.6)).all()
    np.testing.assert_array_equal(data.albedo, np.full((len(data.albedo), 3), 0.6, np.float32))
    lost = hidden[data.covered]
    light = data.wide[1].maps("indirect", [0, 1])
    assert not light[:, lost].any()
    assert not data.wide[1].area[lost].any()
    np.testing.assert_array_equal(light[:, ~lost], data.keys[1].maps("indirect", [0, 1])[:, (up & down)[down]])
    assert data.wide[0].maps("indirect", [0, 1])[:, lost].any()
    assert data.wide[1].area.sum() == pytest.approx(data.keys[1].area.sum(), rel=1e-12)


def test_scores_are_those_of_the_poses(data: AnimatedData, models: dict[str, AnimatedModel]) -> None:
    found = score(data, models)
    assert list(found) == ["each", "one", "nearest"]
    assert found["nearest"]["seen"] == found["each"]["seen"]
    assert found["nearest"]["between"] != found["each"]["between"]
    seen = [pose for pose in poses(data) if pose.seen]
    assert [pose.time for pose in poses(data)] == [0.0, 0.125, 0.5]
    squares, means = [], []
    for pose in seen:
        test = pose.data.split("test")
        model = models["one"].at(pose.time, pose.scene.positions)
        light = model.predict(pose.data.values(test, 12, "radiosity"))
        wide = np.stack([model.image(row) for row in light])[:, pose.data.covered]
        truth, weight = pose.data.maps("indirect", test).astype(np.float64), pose.data.area / pose.data.area.sum()
        squares.append(np.einsum("ltc,t->", (wide - truth) ** 2, weight) / truth.shape[0] / 3)
        means.append(np.einsum("ltc,t->", truth, weight) / truth.shape[0] / 3)
    expected = np.sqrt(np.mean(squares)) / np.mean(means)
    assert found["one"]["seen"]["relative_rmse"] == pytest.approx(expected, rel=1e-5)
    assert "at keyframes" in table(found)
    assert 0 < noise(data) < 1
    light, truth = maps(at_pose(models["each"], "each", poses(data)[1]), data.between[0][1])
    assert light.shape == truth.reference.shape
    whole, learned = (picture(models["each"], seen[1], 0, 24, lamps=lamps) for lamps in (True, False))
    np.testing.assert_array_equal(whole["difference"], learned["difference"])
    assert (whole["reference"][..., :3] != learned["reference"][..., :3]).any()


def documented(name: str) -> dict[str, Any]:
    """The Python blocks of a page of docs/, executed; of effects.md the one about what moves."""
    scope: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(), re.DOTALL):
        if name != "effects.md" or "def moment" in block:
            exec(block, scope)
    return scope


@pytest.mark.parametrize("way", ["each", "one", "glowing"])
def test_an_export_is_decoded_by_the_documented_steps(
    way: str, models: dict[str, AnimatedModel], arm: Animation, tmp_path: Path
) -> None:
    """Measured, mixed and lit from the files alone, at keys and between, where the mesh goes straight."""
    model = models["one" if way == "one" else "each"]
    if way == "glowing":
        glow = np.random.default_rng(1).random((2, len(model.rest.area), 3)).astype(np.float32)
        model = replace(model, constant=glow, rest=replace(model.rest, constant=glow[0]))
        drawn = np.random.default_rng(2)
        shifts = {name: 0.1 * drawn.random(getattr(model, name).shape).astype(np.float32) for name in ("offset", "intercept")}
        model = replace(model, **shifts)  # as where the mean was taken off
    folder, then = tmp_path / "export", tmp_path / "then"
    files = export_animated(model, folder, precision="float", stitch=False)
    assert {path.name for path in files} == {path.name for path in folder.iterdir()}
    shutil.copytree(folder, then)
    moment, page = documented("effects.md")["moment"], documented("deployment.md")
    manifest = json.loads((folder / "manifest.json").read_text())
    golden = {entry["time"]: entry for entry in json.loads((folder / "animation-golden.json").read_text())["moments"]}
    assert list(golden) == pytest.approx([0.0, 0.15, 0.5])
    lamp = parse_lighting(LAMP)
    for time in (0.0, 0.2, 0.5, *golden):
        still = model.at(time)
        transfer, points = moment(folder, time)
        light = measure(Tracer(still.occluders), lamp, points["position"], points["normal"], seed=0, depth=manifest["depth"])
        home, size = np.array(points["home"]), np.abs(still.measure(LAMP)).max()
        x = np.stack([(light * points["albedo"])[home == point].mean(0) for point in range(12)])
        np.testing.assert_allclose(x, still.measure(LAMP), atol=1e-4 * size)
        write_tensors(then / "transfer.safetensors", transfer)
        if way == "glowing":
            write_exr(then / "constant.exr", points["constant"], half=False)
        image = page["light"](then, page["frame"](then, x))
        expected = still.predict(x.astype(np.float32))
        np.testing.assert_allclose(image[still.covered], expected, atol=1e-4 * expected.max())
        if time in golden:
            entry = golden[time]
            np.testing.assert_allclose(entry["measured"], still.measure(entry["lighting"]), rtol=1e-6)
            assert np.max(entry["measured"]) > 0
            rows = page["frame"](then, np.array(entry["values"]))
            np.testing.assert_allclose(entry["rows"], rows, atol=1e-5 * np.abs(rows).max())
            lit = page["light"](then, rows)[tuple(np.transpose(entry["texels"]))]
            np.testing.assert_allclose(entry["light"], lit, atol=1e-4 * lit.max())
    assert (np.array(golden[0.0]["rows"]) != np.array(golden[0.5]["rows"])).any()


def test_an_export_of_what_moves_is_one_of_its_first_pose_and_more(models: dict[str, AnimatedModel], tmp_path: Path) -> None:
    export_animated(models["each"], tmp_path / "moving")
    (tmp_path / "moving" / "constant-07.exr").touch()  # of an earlier one, with more keys and a glow
    export_animated(models["each"], tmp_path / "moving")
    export_model(models["each"].rest, tmp_path / "still")
    found, still = ({path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("moving", "still"))
    assert found.keys() - still.keys() == {"animation.safetensors", "animation-golden.json"}
    manifest = json.loads(found["manifest.json"])
    del manifest["animation"]
    assert manifest == json.loads(still.pop("manifest.json"))
    assert {name: found[name] for name in still} == still


def test_what_cannot_follow_a_pose_is_refused(arm: Animation, tmp_path: Path) -> None:
    table = [
        ({"points": {"on": "hull"}}, 'points.on = "hull"'),
        ({"points": {"file": "x.json"}}, "points.file"),
        ({"points": {"choose": "qr"}}, 'points.choose = "qr"'),
        ({"lightings": {"choose": "active"}}, 'lightings.choose = "active"'),
        ({"probes": {"grid": [2, 2, 2]}}, "probes"),
    ]
    for sections, says in table:
        with pytest.raises(UserError, match=says) as caught:
            refuse_still(arm.key(0), job(**sections))
        assert "beside an animation, expected" in str(caught.value)
    with pytest.raises(UserError, match="got 1, expected those of each of 2 keyframes"):
        bake_animation(arm, [{}], config=job(), out=tmp_path)
    for text, says in (
        ("[animation]\nkeys = -1", "animation.keys"),
        ("[animation]\nkeys = []", r"animation.keys: got \[\], expected integer"),
        ("[animation]\nbetween = [1.0]", "animation.between"),
        ("[animation]\nbetween = [0, 1]", r"animation.between: got 0, expected shares above 0 and below 1; leave it out"),
        ("[animation]\nbetween = [0.5, 0.5]", r"animation.between: got \[0.5, 0.5\], expected each share once"),
        ('[animation]\nmatrices = "some"', "animation.matrices"),
    ):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(UserError, match=says):
            load_config(tmp_path / "bad.toml")


def test_a_clip_may_be_a_number(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[animation]\nclip = 1")
    assert load_config(tmp_path / "a.toml").animation.clip == load_config(None, {"animation.clip": "1"}).animation.clip == "1"


@pytest.mark.parametrize("setting", [{"clip": "walk"}, {"between": [0.2]}, {"matrices": "one"}])
def test_a_motion_without_keyframes_is_not_baked_as_a_scene_that_stands_still(setting: dict) -> None:
    scene = {"name": "bending", "parameters": ARM}
    says = rf"animation\.keys: got none beside animation\.{next(iter(setting))}, expected how many"
    with pytest.raises(UserError, match=says):
        configured_scene(checked({"scene": scene, "animation": setting}))
    for still in ({**setting, "keys": 0}, {}, tomllib.loads(checked({}).to_toml())["animation"]):
        assert configured_scene(checked({"scene": scene, "animation": still})).name == "bending"


def test_verbs_that_know_no_poses_say_so_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm.toml").write_text(job().to_toml())
    table = [
        (("export", "--table"), "--table: got an animation, expected a scene that stands still"),
        (("eval", "--budget"), "--budget: got an animation"),
        (("bake", "--dry-run"), "--dry-run: got an animation"),
        (("bench", "--effects"), "--effects: got an animation"),
        (("bench", "--leagues"), "--leagues and --splits: got an animation"),
    ]
    for (verb, flag), says in table:
        assert call(verb, tmp_path / "arm.toml", flag, "--out", tmp_path / "run", "--quiet") == 2
        error = capsys.readouterr().err
        assert says in error
        assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_all_poses_are_verified(data: AnimatedData, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("verify", data.folder) == 0
    out = capsys.readouterr().out
    assert [line.split(":")[0].split("/")[-1] for line in out.splitlines()] == ["between-00", "key-00", "key-01"]
    shutil.copytree(data.folder, tmp_path / "run" / "dataset")
    (tmp_path / "run" / "dataset" / "key-01" / "indirect" / "000001.exr").write_bytes(b"")
    assert call("verify", tmp_path / "run") == 2
    found = capsys.readouterr()
    assert "key-01/indirect/000001.exr" in found.out
    assert "got 1 faulty files" in found.err


def test_what_an_animation_leaves_out_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], data: AnimatedData) -> None:
    config = job(methods={"compare": ["svd-ridge", "mean", "mlp"]})
    AnimatedRun(config, tmp_path, quiet=False).fit(data)
    assert "methods.compare: mean, mlp left out: with an animation" in capsys.readouterr().err
    (tmp_path / "arm.toml").write_text(job(animation={"keys": [0.0, 0.5, 0.75]}).to_toml())
    words = examine(str(tmp_path / "arm.toml"), {}).text
    assert "animation   3 keyframes, at 0, 0.5, 0.75 s, each with a bake as below" in words
    assert "2 poses between with 5 lightings each" in words


def test_scenes_that_stand_still_know_nothing_of_it(arm: Animation) -> None:
    scene = build("plates")
    assert not plan(scene, []).called("animation")
    assert plan(arm.key(0), []).called("animation")
    assert replace(scene, rest=scene).digest != scene.digest
    absent = "poses", "riding", "animated", "gltf_motion", "train_animated"
    code = f"import sys, ddprt.pipeline; print([m for m in sys.modules if m.split('.')[-1] in {absent}])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.slow
def test_from_configuration_to_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, out = tmp_path / "arm.toml", tmp_path / "run"
    config.write_text(job().to_toml())
    assert call("run", config, "--out", out, "--quiet") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["keys"] == [0.0, 0.5]
    assert set(metrics["ways"]) == {"each", "one", "nearest"}
    assert "between keyframes" in (out / "report.html").read_text()
    assert call("eval", out / "config.toml", "--out", out, "--quiet") == 0
    assert json.loads((out / "metrics.json").read_text())["ways"] == metrics["ways"]
    assert call("export", config, "--out", out, "--quiet") == 0
    light = '[{"type": "directional", "direction": [0, -1, 0.3], "irradiance": [1, 1, 1]}]'
    model = out / "model.ddprt"
    assert call("relight", model, "--lighting", light, "--time", "0.2", "--out", tmp_path / "relit.exr") == 0
    assert call("view", model, "--time", "0.2", "--html", tmp_path / "arm.html") == 0
    assert "the pose at 0.2 s is shown" in (tmp_path / "arm.html").read_text("utf-8")
    capsys.readouterr()
    for words, says in (
        (("relight", model, "--lighting", light), "no --time"),
        (("relight", model, "--lighting", light, "--time", "soon"), "--time: got soon"),
        (("relight", model, "--lighting", light, "--time", "2"), "got 2 s, expected 0 to 0.5"),
        (("bench", config), "got an animation"),
        (("tune", config, "--max-frame-us", "5"), "got an animation"),
        (("bake", config, "--out", out, "--fit.method", "mlp"), "fit.method"),
    ):
        assert call(*words) == 2
        error = capsys.readouterr().err
        assert says in error, error
        assert len(error.strip().splitlines()) == 1
