"""The viewer: what the page holds, what it is refused for, and the address that it is served from."""

import base64
import html
import json
import re
import shutil
import subprocess
import threading
import urllib.error
import urllib.request
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import browsed, displayed, off, seen
from small_job import call

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.viewer.pack import HELD_OUT, Packed, pack
from ddprt.export.viewer.page import page
from ddprt.export.viewer.serve import server
from ddprt.lights import lighting_json
from ddprt.report.view import default_camera
from ddprt.runtime.model import Model
from ddprt.scene.fog import Fog
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

TYPES = {"f2": "<f2", "f4": "<f4", "f8": "<f8", "i4": "<i4", "u1": "u1"}

PROBE = "".join((Path(__file__).parent / name).read_text("utf-8") for name in ("page_probe.js", "viewer_probe.js"))


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    changes = {"atlas.resolution": "32", "lightings.train": "8", "lightings.validation": "2", "lightings.test": "6"}
    changes |= {"points.count": "16", "points.supersample": "2", "transport.samples": "16", "transport.test_samples": "16"}
    return ddprt.bake(cornell, config=load_config(None, changes))


@pytest.fixture(scope="module")
def model(data: Dataset) -> Model:
    return ddprt.fit(data, bases=6)


def unpacked(entry: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(entry["base64"]), TYPES[entry["type"]]).reshape(entry["shape"])


@pytest.mark.parametrize("type", sorted(TYPES))
def test_arrays_come_back(type: str) -> None:
    values = np.arange(24, dtype=TYPES[type])[::-2].reshape(3, 4)
    np.testing.assert_array_equal(unpacked(Packed(type, values).entry), values)


def test_page_stands_on_its_own(model: Model) -> None:
    packed = pack(replace(model, scene=model.scene | {"name": "</script><b>&"}))
    text = page(packed)
    block = re.search(r'<script type="application/json" id="model">(.*?)</script>', text, re.DOTALL)
    assert block
    assert json.loads(block[1]) == packed, "nothing of it ends the block early"
    assert f"<title>{html.escape('</script><b>&')}: ddprt</title>" in text
    assert not re.search(r'(?:src|href)\s*=\s*["\']?(?:https?:)?//', text), "asks nobody"
    assert "Permission is hereby granted, free of charge" in text, "the licence of three.js stays in it"


def test_held_out_lightings_have_their_references(model: Model, data: Dataset) -> None:
    stored = pack(model, data)["stored"]
    test = data.split("test")
    assert len(stored) == HELD_OUT
    assert [stored[0]["index"], stored[-1]["index"]] == [test[0], test[-1]]
    for entry in stored:
        (truth,) = data.maps("indirect", [entry["index"]])
        (values,) = data.values([entry["index"]], model.points, model.quantity)
        np.testing.assert_allclose(unpacked(entry["indirect"])[model.covered][:, :3], truth, rtol=2**-10, atol=1e-6)
        np.testing.assert_array_equal(unpacked(entry["values"]).astype(np.float32), values)
        lamps = data.lightings[entry["index"]]
        assert entry["omitted"] == {}
        assert entry["lights"] == lighting_json(lamps)
        weight = np.repeat(data.area, 3)
        off, whole = (weight @ np.square(part, dtype=np.float64).ravel() for part in (model.predict(values) - truth, truth))
        assert entry["error"] == pytest.approx(np.sqrt(off / whole), rel=1e-6)
        assert entry["rms"] == pytest.approx(np.sqrt(whole / data.area.sum()), rel=1e-6)


def test_first_lamp_is_trusted_and_bright_enough(model: Model) -> None:
    (lamp,) = pack(model)["lights"]
    values = model.measure(lamp)
    assert values.mean() == pytest.approx(np.pi / 4, rel=1e-3)
    others = [model.measure({**lamp, "position": place}) for place in ([0.278, 0.41, 0.28], [0.278, 0.27, 0.28])]
    score = model.trust(values)
    assert score is not None
    assert all(score.score >= model.trust(other).score - 0.02 for other in others if other.any())  # type: ignore[union-attr]


def test_albedo_is_kept_and_old_models_are_told(model: Model, data: Dataset, tmp_path: Path) -> None:
    model.save(tmp_path / "new")
    again = ddprt.load_model(tmp_path / "new")
    np.testing.assert_array_equal(again.albedo, data.gbuffer["albedo"])
    replace(model, albedo=None).save(tmp_path / "old")
    old = ddprt.load_model(tmp_path / "old")
    assert old.albedo is None
    packed = pack(old)
    assert packed["albedo"] is None
    assert "without albedo" in packed["notes"][0]
    painted = unpacked(pack(again)["albedo"])[model.covered][:, :3] / 255
    linear = np.where(painted <= 0.04045, painted / 12.92, ((painted + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(linear, data.gbuffer["albedo"], atol=0.006)
    replace(model, albedo=np.ones((3, 3), np.float32)).save(tmp_path / "odd")
    with pytest.raises(UserError, match="albedo of shape"):
        ddprt.load_model(tmp_path / "odd")


def test_black_surfaces_are_told(model: Model) -> None:
    assert model.albedo is not None
    assert pack(model)["notes"] == []
    bare = np.where(np.arange(len(model.albedo))[:, None] % 4 == 0, 0, model.albedo).astype(np.float32)
    (note,) = pack(replace(model, albedo=bare))["notes"]
    assert note.startswith("25% of the texels have no diffuse albedo, as bare metal has none")
    red = np.where(np.arange(3) > 0, 0, model.albedo).astype(np.float32)
    assert pack(replace(model, albedo=red))["notes"] == []


@pytest.fixture(scope="module")
def saved(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "model.ddprt"
    model.save(folder)
    return folder


def test_command_writes_a_page(saved: Path, data: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("view", saved.parent, "--html", tmp_path / "a.html", "--dataset", data.folder) == 0
    assert (tmp_path / "a.html").read_text("utf-8").startswith("<!doctype html>")
    assert capsys.readouterr().out == f"viewer:   {tmp_path / 'a.html'}\n"


BAD = {
    "no model": (["/nowhere"], "expected a model folder"),
    "two models": (["a", "b"], "got 2 files"),
    "not a page": (["SAVED", "--html", "a.png"], "expected a path that ends in .html"),
    "no port": (["SAVED", "--port", "x"], "expected a whole number from 0 to 65535"),
    "port past the end": (["SAVED", "--port", "65536"], "expected a whole number from 0 to 65535"),
    "no dataset": (["SAVED", "--dataset", "/nowhere"], "/nowhere"),
    "the model as a dataset": (["SAVED", "--dataset", "SAVED"], "model.ddprt"),
    "unknown option": (["SAVED", "--htm", "a.html"], "unknown option"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_words_are_told_in_one_line(case: str, saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words, told = BAD[case]
    assert call("view", *(str(saved) if word == "SAVED" else word for word in words)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert told in error


def test_models_that_cannot_be_shown_are_refused(model: Model, data: Dataset) -> None:
    with pytest.raises(UserError, match='got a model of method "mean", expected svd-ridge'):
        pack(ddprt.fit(data, "mean"))
    with pytest.raises(UserError, match="without lightmap coordinates"):
        pack(replace(model, uv=None))
    with pytest.raises(UserError, match='got one of "cornell", expected that'):
        pack(replace(model, scene={"name": "other", "digest": "0"}), data)
    with pytest.raises(UserError, match="with another atlas or other points"):
        pack(replace(model, covered=model.covered[:, ::-1]), data)
    description = {**data.description, "lightings": [{**entry, "split": "train"} for entry in data.description["lightings"]]}
    with pytest.raises(UserError, match="without held-out lightings"):
        pack(model, Dataset(data.folder, description))


def test_server_knows_one_page() -> None:
    with server("<p>é", 0) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        host, port = running.server_address[:2]
        assert host == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert answer.read().decode("utf-8") == "<p>é"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/../etc/passwd")
        with pytest.raises(UserError, match=f"--port: got {port}"):
            server("", int(port))
        running.shutdown()


OPTIONS: list[dict[str, Any]] = [
    {},
    {"space": "gamma", "centre": "mean"},
    {"channels": "multi", "centre": "mean", "quantity": "irradiance"},
]
LAMPS = {
    "point": [{"type": "point", "position": [0.2, 0.4, 0.25], "intensity": [1, 0.5, 2]}],
    "spot": [
        {
            "type": "spot",
            "position": [0.2, 0.5, 0.2],
            "direction": [0.3, -1, 0.5],
            "intensity": [3, 2, 1],
            "inner_deg": 10,
            "outer_deg": 50,
        }
    ],
    "directional": [{"type": "directional", "direction": [0.4, -0.3, 1], "irradiance": [1, 2, 3]}],
}
LAMPS["all"] = [lamp for lamps in LAMPS.values() for lamp in lamps]
LAMPS["touching the ceiling"] = [{"type": "point", "position": [0.3, 0.547, 0.3], "intensity": [1, 1, 1]}]
BAD_LINKS = ["#%7B", "#[1", "#5", '#{"show":"all"}', '#{"lamps":[{"type":"point"}]}', '#{"eye":[0,0,null]}', '#{"x":1}']


def test_page_opens_from_disk_and_lights_as_predict_does(model: Model, data: Dataset, tmp_path: Path) -> None:
    probe = """const frame = window.ddprt.frame, lamps = JSON.parse(document.getElementById("asked").textContent).lamps;
    const node = document.createElement("p"), map = Array.from(frame.composer.read());
    node.id = "probe";
    const { foggy } = JSON.parse(document.getElementById("asked").textContent), { ddprt } = window;
    const through = foggy.map((one) => Array.from(ddprt.framed(one).measuring.measure(lamps)));
    node.textContent = JSON.stringify({ faults, map, measured: Array.from(frame.measuring.measure(lamps)), through });
    document.body.append(node);"""
    fog = Fog((0.2, 0.4, 1.0))
    foggy = [replace(model, fog=fog, samples=replace(model.samples, depth=depth)) for depth in (0.0, 0.05)]
    question = {"lamps": LAMPS["all"], "foggy": [pack(one, stitch=False) for one in foggy]}
    found = browsed(page(pack(model, data, stitch=False)), question, probe, tmp_path)
    assert found["faults"] == []
    (values,) = data.values(data.split("test")[:1], model.points, model.quantity)
    got, expected = np.reshape(found["map"], (*model.covered.shape, 4))[model.covered][:, :3], model.predict(values)
    assert np.abs(got - expected).max() < 2e-3 * expected.max()
    for one, told in zip([model, *foggy], [found["measured"], *found["through"]], strict=True):
        measured = one.measure(LAMPS["all"])
        np.testing.assert_allclose(np.reshape(told, (-1, 3)), measured, rtol=2e-4, atol=2e-5 * measured.max())
    clear, misty = (np.sum(one.measure(LAMPS["all"])) for one in (model, foggy[0]))
    assert misty < 0.9 * clear


@dataclass(frozen=True)
class Asked:
    """What the browser is asked about, and what it answers."""

    models: list[Model]
    values: np.ndarray
    measuring: list[Model]
    rays: np.ndarray
    statue: Scene
    found: dict[str, Any]


@pytest.fixture(scope="module")
def asked(model: Model, data: Dataset, statue: Scene, tmp_path_factory: pytest.TempPathFactory) -> Asked:
    folder, rng = tmp_path_factory.mktemp("viewer"), np.random.default_rng(0)
    models = [ddprt.fit(data, bases=6, **options) for options in OPTIONS]
    test = data.split("test")[:2]
    measuring = [
        replace(one, samples=replace(one.samples, depth=depth)) for one in (models[0], models[-1]) for depth in (0.0, 0.07)
    ]
    values = [data.values(test, one.points, one.quantity) for one in models]
    origins = 3 * statue.radius * rng.uniform(-1, 1, (300, 3))
    towards = rng.permutation(statue.corners.mean(1) - statue.centre)[:300]  # hardly any of them on the ground
    directions = towards - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = np.column_stack([origins, directions, rng.uniform(0.5, 8, 300) * statue.radius])
    of_statue = replace(model, occluders=statue.corners, uv=np.zeros((len(statue.corners), 3, 2)))
    question = {
        "models": [
            {"packed": pack(one, stitch=False), "values": seen.tolist()} for one, seen in zip(models, values, strict=True)
        ],
        "measured": [{"packed": pack(one), "lightings": list(LAMPS.values())} for one in measuring],
        "rays": {"packed": pack(of_statue, stitch=False), "rays": rays.tolist()},
        "bad_links": BAD_LINKS,
        "drawn": {"lamps": LAMPS["all"]},
    }
    found = browsed(page(pack(model, data)), question, PROBE, folder)
    return Asked(models, np.array(values), measuring, rays, statue, found)


@pytest.mark.slow
def test_page_has_no_faults(asked: Asked) -> None:
    assert asked.found["faults"] == []
    assert asked.found["wide"] == 0, "nothing sticks out"
    assert asked.found["panel"] > 200


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(OPTIONS)), ids=lambda index: str(OPTIONS[index]))
def test_composed_lightmaps_are_those_of_predict(index: int, asked: Asked) -> None:
    model, found = asked.models[index], asked.found["models"][index]
    for values, composed, told in zip(asked.values[index], found["maps"], found["told"], strict=True):
        got, expected = np.reshape(composed, (*model.covered.shape, 4))[model.covered][:, :3], model.predict(values)
        assert expected.max() > 0.01
        assert np.abs(got - expected).max() < 2e-3 * expected.max()
        trust = model.trust(values)
        assert trust is not None
        assert told["score"] == pytest.approx(float(trust.score), abs=1e-4)
        assert told["extrapolating"] == bool(trust.extrapolating)


@pytest.mark.slow
def test_fewer_bases_are_the_first_ones(asked: Asked) -> None:
    model = asked.models[0]
    weights, textures = model.coefficients(asked.values[0][0].astype(np.float32)), model.textures
    expected = np.maximum(np.einsum("cb,bt->tc", weights[:, :3], textures[:3]), 0)
    got = np.reshape(asked.found["cut"], (*model.covered.shape, 4))[model.covered][:, :3]
    assert np.abs(got - expected).max() < 2e-3 * expected.max()


@pytest.mark.slow
@pytest.mark.parametrize("name", LAMPS)
def test_measured_light_is_that_of_measure(name: str, asked: Asked) -> None:
    for model, found in zip(asked.measuring, asked.found["measured"], strict=True):
        expected = model.measure(LAMPS[name])
        assert expected.any()
        got = np.reshape(found[list(LAMPS).index(name)], (-1, 3))
        np.testing.assert_allclose(got, expected, rtol=2e-4, atol=2e-5 * expected.max())


@pytest.mark.slow
def test_shadow_rays_are_those_of_embree(asked: Asked) -> None:
    tracer = Tracer(asked.statue.corners)
    origins, directions, reach = (np.ascontiguousarray(part, np.float32) for part in np.split(asked.rays, [3, 6], 1))
    expected = tracer.unoccluded(origins, directions, reach[:, 0].copy()) == 0
    assert 20 < expected.sum() < 280
    assert (np.array(asked.found["occluded"], bool) == expected).mean() > 0.99  # edges of float32 and float64


@pytest.mark.slow
def test_what_a_user_does_shows(asked: Asked) -> None:
    found = asked.found
    for change in ("error", "reference", "moved", "reset"):
        assert found[f"{change}_differs"] > 1000, change
    assert found["lighting_after_edit"] is None, "a lamp that is moved is no held-out lighting any more"
    np.testing.assert_allclose(found["dragged"], [0.3, 0.4, 0.2], atol=1e-6)
    assert found["dark"] < 40, "without lamps there is the background alone"


@pytest.mark.slow
def test_links_restore_the_state(asked: Asked) -> None:
    assert asked.found["link_differs"] == 0
    assert asked.found["link_same"]
    assert asked.found["bad_links"] == [False] * len(BAD_LINKS), "nothing of a faulty link is taken"
    assert asked.found["warned"] == [
        'link: got one that cannot be followed ("x" is not as expected); nothing of it is taken',
        True,
    ]
    assert asked.found["too_many"] == "link: got one that cannot be followed (9 lamps, at most 8); nothing of it is taken"
    assert asked.found["followed"] == ["", False], "a link that can be followed takes the warning away"


@pytest.mark.slow
def test_keys_do_what_the_panel_does(asked: Asked) -> None:
    found = asked.found
    assert (found["key 2"], found["key b"], found["key ]"]) == ("direct", "basis", 1.75)
    assert [lamp["type"] for lamp in found["key s"]] == ["point", "spot"]
    assert (found["tab_lists"], found["after_delete"]) == (2, 1)
    assert found["error_refused"] == "basis", "there is no error without a held-out lighting"


@pytest.mark.slow
def test_direct_light_on_the_screen_is_right(asked: Asked, cornell: Scene) -> None:
    """Radiance, camera, shadow maps, albedo and tone map against rays, but for pixels at edges of objects and shadows."""
    tracer = Tracer.of(cornell)
    found = seen(asked.found["drawn"], default_camera(cornell), asked.found["fov"], tracer)
    direct, _ = ddprt.irradiance(cornell, LAMPS["all"], found.position, found.normal, samples=1)
    assert off(found, displayed(cornell.albedo_at(found.triangle, found.corners) / np.pi * direct)) < 0.07


@pytest.mark.slow
def test_bundle_is_built_from_its_source(tmp_path: Path) -> None:
    """`make viewer` again, from the pinned packages: the same bytes."""
    npm, source = shutil.which("npm"), Path(ddprt.__file__).parent / "export" / "viewer"
    if npm is None:
        pytest.skip("needs node and npm on the path")
    for name in ("package.json", "build.mjs"):
        shutil.copy(source / name, tmp_path)
    shutil.copytree(source / "src", tmp_path / "src")
    got = subprocess.run([npm, "install", "--no-audit", "--no-fund"], cwd=tmp_path, capture_output=True, timeout=300)
    if got.returncode:
        pytest.skip("npm cannot reach its packages")
    subprocess.run([npm, "run", "build"], cwd=tmp_path, capture_output=True, check=True, timeout=100)
    assert (tmp_path / "viewer.js").read_bytes() == (source / "viewer.js").read_bytes()
