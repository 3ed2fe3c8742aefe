"""Layers: light besides the lightmap, learned and kept as it is."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ddprt
from ddprt import warp
from ddprt.config import checked
from ddprt.dataset import store
from ddprt.dataset.layers import Layer, LayerData, layers, read_layer, read_light, write_light, write_places
from ddprt.dataset.manifest import Manifest
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.harmonics import harmonics

ORDER, PLACES = 2, 5
EPS = float(np.finfo(np.float32).eps)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A small bake without layers."""
    config = checked(
        {
            "atlas": {"resolution": 24},
            "lightings": {
                "train": 12,
                "validation": 3,
                "test": 3,
                "region_low": [0.1, 0.5, 0.1],
                "region_high": [0.9, 0.8, 0.9],
            },
            "points": {"count": 24, "supersample": 2},
            "transport": {"samples": 16, "test_samples": 32},
        }
    )
    return ddprt.bake(ddprt.load_scene("cornell"), config=config, out=tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def data(plain: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The same with a layer whose light is a fixed map of a few texels' light, so that it can be learned as well as these."""
    import shutil

    folder = tmp_path_factory.mktemp("layered") / "dataset"
    shutil.copytree(plain.folder, folder)
    description = json.loads((folder / "dataset.json").read_text())
    description["layers"] = [{"name": "probes", "quantity": "irradiance", "order": ORDER}]
    store.write_description(folder, description)
    manifest = Manifest(folder)
    rng = np.random.default_rng(0)
    where = rng.random((PLACES, 3))
    layer = Layer("probes", "irradiance", ORDER, where, np.full(PLACES, 0.5), np.full(PLACES, -1))
    write_places(folder, layer, manifest)
    mix = rng.normal(size=(PLACES, layer.coefficients, len(plain.area))) / len(plain.area)
    for index in range(len(plain.lightings)):
        light = np.einsum("pkt,tc->pkc", mix, plain.maps("indirect", [index])[0])
        write_light(folder, "probes", index, light, manifest)
        if plain.description["lightings"][index]["split"] == "test":
            write_light(folder, "probes", index, 0 * light, manifest, "noise")
    return ddprt.open_dataset(folder)


@pytest.mark.parametrize("wrong", [(0, 0, 0), (0, np.nan, 1), (0, 1), "up", [[1, 0, 0]] * 2], ids=str)
def test_a_direction_that_is_none_is_refused(wrong: Any) -> None:
    layer = Layer("gloss-2", "radiance", 2, np.zeros((5, 3)), np.ones(5), np.arange(5))
    light = np.random.default_rng(0).standard_normal((5, 9, 3)).astype(np.float32)
    with pytest.raises(UserError, match=r"^directions: got .*, expected \(3,\) or \(5, 3\)"):
        layer.towards(light, np.asarray(wrong))
    near, far = (layer.towards(light, np.array([0.0, length, 0.0])) for length in (1.0, 1e3))
    np.testing.assert_array_equal(near, far)


def test_a_dataset_tells_its_layers(data: Dataset, plain: Dataset) -> None:
    assert layers(plain) == []
    (layer,) = layers(data)
    assert (layer.name, layer.quantity, layer.order, layer.coefficients) == ("probes", "irradiance", ORDER, 9)
    assert read_light(data, layer, [0, 3]).shape == (2, PLACES, 9, 3)
    with pytest.raises(UserError, match="no layer"):
        read_layer(plain, "probes")


def test_a_dataset_that_lacks_light_of_a_layer_is_not_finished(data: Dataset, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "cut"
    shutil.copytree(data.folder, folder)
    lines = (folder / "manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "manifest.jsonl").write_text("".join(line for line in lines if "probes/000004" not in line))
    with pytest.raises(UserError, match="probes/000004"):
        ddprt.open_dataset(folder)


def test_the_lightmap_is_learned_as_without_layers(data: Dataset, plain: Dataset) -> None:
    values = plain.values(plain.split("test"), 24, "radiosity")
    ours, alone = (ddprt.fit(d, bases=8) for d in (data, plain))
    np.testing.assert_array_equal(ours.predict(values), alone.predict(values))
    assert list(ours.layers) == ["probes"]
    assert not alone.layers
    for model, name, known in ((ours, "probs", 'did you mean "probes".; known: probes'), (alone, "probes", "known: none")):
        with pytest.raises(UserError, match=f'no layer "{name}".*{known}'):
            model.layers[name]


def test_a_layer_is_learned_with_its_sign(data: Dataset) -> None:
    """Answers are nearer than any without negative coefficients could be, and beat the mean of them as they are."""
    model, test = ddprt.fit(data, bases=12), data.split("test")
    part = model.layers["probes"]
    truth = read_light(data, part.layer, test)
    assert (truth < 0).any()
    found = part.predict(data.values(test, 24, "radiosity"))
    assert found.shape == truth.shape
    cut = np.linalg.norm(np.maximum(truth, 0) - truth)  # as near as answers without negative numbers can come
    assert np.linalg.norm(found - truth) < cut
    assert part.model.relighter.report.status == "ok"


def test_one_frame_and_directions(data: Dataset) -> None:
    model = ddprt.fit(data, bases=8)
    part, values = model.layers["probes"], data.values(data.split("test"), 24, "radiosity")
    up = part.towards(values, (0, 1, 0))
    assert up.shape == (3, PLACES, 3)
    Y = harmonics(np.array([0.0, 1.0, 0.0]), ORDER)
    light = part.predict(values[0])
    exact = np.maximum(np.einsum("pkc,k->pc", light.astype(float), Y), 0)
    np.testing.assert_allclose(part.towards(values[0], (0, 1, 0)), exact, atol=12 * EPS * np.abs(light).max())
    assert (up >= 0).all()


def test_models_keep_their_layers(data: Dataset, tmp_path: Path) -> None:
    model = ddprt.fit(data, bases=8)
    model.save(tmp_path / "m.ddprt")
    again = ddprt.load_model(tmp_path / "m.ddprt")
    values = data.values(data.split("test"), 24, "radiosity")
    np.testing.assert_array_equal(again.layers["probes"].predict(values), model.layers["probes"].predict(values))
    np.testing.assert_array_equal(again.layers["probes"].layer.position, model.layers["probes"].layer.position)


def test_a_model_that_lost_a_layer_is_refused(data: Dataset, tmp_path: Path) -> None:
    import shutil

    ddprt.fit(data, bases=8).save(tmp_path / "m.ddprt")
    shutil.rmtree(tmp_path / "m.ddprt" / "layers")
    with pytest.raises(UserError, match="layers"):
        ddprt.load_model(tmp_path / "m.ddprt")


@pytest.mark.parametrize("quantity", ["irradiance", "radiance"])
def test_weights_turn_coefficients_into_irradiance(quantity: str) -> None:
    """The weighted squares of coefficients are the mean over the sphere of squared irradiance, or of pi times radiance."""
    rng = np.random.default_rng(1)
    light = rng.normal(size=(1, 9, 3))
    layer = Layer("x", quantity, ORDER, np.zeros((1, 3)), np.ones(1), np.array([-1]))
    weighted = LayerData.of(Dataset(Path(), {}), layer).area @ (light.reshape(9, 3) ** 2)
    z, step = np.polynomial.legendre.leggauss(6)
    turn = 2 * np.pi * np.arange(9) / 9
    flat = np.sqrt(1 - z**2)
    x, y = (np.outer(flat, part) for part in (np.cos(turn), np.sin(turn)))
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1)
    value = np.einsum("pkc,abk->abc", light, harmonics(directions, ORDER)) * (np.pi if quantity == "radiance" else 1)
    mean = np.einsum("abc,a->c", value**2, step) / 2 / 9
    np.testing.assert_allclose(weighted, mean, rtol=1e-12)


def test_values_never_go_below_zero() -> None:
    layer = Layer("x", "irradiance", 1, np.zeros((2, 3)), np.ones(2), np.full(2, -1))
    light = np.zeros((2, 4, 3), np.float32)
    light[:, 2] = 1  # along z
    directions = warp.sample_sphere(warp.sobol(2, 2, seed=3)).astype(float)
    assert (layer.towards(light, directions) >= 0).all()
    assert not layer.towards(light, np.array([0, 0, -1.0])).any()
