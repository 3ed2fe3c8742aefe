"""A model at work: relighting with shadow rays, shapes, and files that are whole or refused."""

import json
from pathlib import Path

import numpy as np
import pytest

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    changes = {"atlas.resolution": "32", "lightings.train": "12", "lightings.validation": "2", "lightings.test": "3"}
    changes |= {"points.count": "16", "points.supersample": "2", "transport.samples": "64", "transport.test_samples": "64"}
    return ddprt.bake(cornell, config=load_config(None, changes))


@pytest.fixture(scope="module")
def model(data: Dataset) -> Model:
    return ddprt.fit(data, bases=5)


@pytest.fixture
def saved(model: Model, tmp_path: Path) -> Path:
    model.save(tmp_path / "model.ddprt")
    return tmp_path / "model.ddprt"


def test_relight_measures_what_the_dataset_measured(model: Model, data: Dataset) -> None:
    for index in data.split("test"):
        # The same rays from the same points: equal to the last bit.
        np.testing.assert_array_equal(model.measure(data.lightings[index]), data.values([index], 16, "radiosity")[0])


def test_relight_is_an_image_with_row_zero_on_top(model: Model, data: Dataset) -> None:
    lighting = data.lightings[data.split("test")[0]]
    image = model.relight(lighting)
    assert image.shape == (32, 32, 3)
    np.testing.assert_array_equal(image[model.covered], model.predict(model.measure(lighting)))
    assert (image[~model.covered] == 0).all()


def test_records_lights_and_lightings_mean_the_same(model: Model) -> None:
    record = {"type": "point", "position": [0.2, 0.4, 0.2], "intensity": [1, 2, 3]}
    light = ddprt.lights.PointLight(**{key: value for key, value in record.items() if key != "type"})
    assert (model.relight(record) == model.relight(light)).all()
    assert (model.relight([record]) == model.relight((light,))).all()


def test_a_loaded_model_needs_nothing_else(saved: Path, model: Model, data: Dataset) -> None:
    assert sorted(path.name for path in saved.iterdir()) == ["model.json", "tensors.safetensors"]
    loaded = ddprt.load_model(saved)
    lighting = data.lightings[0]
    np.testing.assert_array_equal(loaded.relight(lighting), model.relight(lighting))


@pytest.mark.parametrize("shape", [(15, 3), (3, 16), (16,), (1, 1, 16, 3), (2, 17, 3)])
def test_wrong_shapes_are_refused(model: Model, shape: tuple) -> None:
    with pytest.raises(UserError, match=r"values: got shape .* expected \(16, 3\)"):
        model.predict(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(model: Model, value: float) -> None:
    values = np.zeros((16, 3))
    values[3, 1] = value
    with pytest.raises(UserError, match="got NaN or infinity"):
        model.predict(values)


def test_damaged_models_are_refused(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a model folder"):
        ddprt.load_model(tmp_path / "nothing")
    text = (saved / "model.json").read_text()
    document = json.loads(text)
    for change, expected in (
        ("{", "not a model description"),
        (json.dumps({**document, "schema": 7}), "got model schema 7"),
        (json.dumps({**document, "method": "magic"}), 'no method "magic"'),
        (json.dumps({**document, "points": {}}), "do not fit together"),
        (json.dumps({key: value for key, value in document.items() if key != "method"}), "do not fit together"),
        (json.dumps({**document, "points": {**document["points"], "count": 5}}), "do not fit together"),
        (json.dumps({**document, "points": {**document["points"], "count": 0}}), "do not fit together"),
        (json.dumps({**document, "encoding": {**document["encoding"], "space": "weird"}}), "do not fit together"),
    ):
        (saved / "model.json").write_text(change)
        with pytest.raises(UserError, match=expected):
            ddprt.load_model(saved)
    (saved / "model.json").write_text(text)
    whole = (saved / "tensors.safetensors").read_bytes()
    for length in (0, 5, len(whole) // 2, len(whole) - 1):
        (saved / "tensors.safetensors").write_bytes(whole[:length])
        with pytest.raises(UserError, match="not a whole tensor file"):
            ddprt.load_model(saved)


def test_saving_into_an_unwritable_place(model: Model, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be made"):
        model.save(tmp_path / "file" / "model.ddprt")


def test_irradiance_measurements_are_an_option(data: Dataset) -> None:
    model = ddprt.fit(data, bases=5, quantity="irradiance")
    index = data.split("test")[0]
    np.testing.assert_array_equal(model.measure(data.lightings[index]), data.values([index], 16, "irradiance")[0])
