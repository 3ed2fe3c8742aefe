"""A model at work: relighting with shadow rays, shapes, and files that are whole or refused."""

import inspect
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors
from ddprt.runtime.model import Model
from ddprt.runtime.train import _text
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


def test_many_lightings_measure_as_each_does(model: Model, data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ddprt.runtime.model._AT_ONCE", 4)
    lightings = data.lightings[:9]
    np.testing.assert_array_equal(model.measure_all(lightings), data.values(range(9), 16, "radiosity"))
    assert model.measure_all([]).shape == (0, 16, 3)


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
        (json.dumps({**document, "schema": True}), "got model schema True"),
        (json.dumps({**document, "points": {}}), "points.count: got {}, expected: Field required"),
        (json.dumps({key: value for key, value in document.items() if key != "method"}), "do not fit together"),
        (json.dumps({**document, "points": {**document["points"], "count": 5}}), "do not fit together"),
        (json.dumps({**document, "points": {**document["points"], "count": 0}}), "points.count: got 0"),
        (json.dumps({**document, "encoding": {**document["encoding"], "space": "weird"}}), "encoding.space: got 'weird'"),
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


ODD_NUMBERS: dict[str, list[Any]] = {
    "encoding.gamma": [0, -2.0, float("nan"), float("inf"), "2.2", True],
    "points.count": [-1, 15.5, "16", True, None],
    "points.spacing": [-1.0, float("nan"), float("inf")],
    "points.depth": [-1.0, float("nan")],
    "points.quantity": ["Radiosity"],
    "trust.ridge": [0.0, -1.0, float("nan")],
    "trust.exponent": [-1.0, float("nan"), float("inf")],
    "trust.level": [-0.1, float("nan")],
    "trust.fade_from": [-0.1, 1.5, float("nan")],
    "report.condition": ["high", [None]],
}


@pytest.mark.parametrize(
    ("place", "number"), [(place, number) for place, odd in ODD_NUMBERS.items() for number in odd], ids=str
)
def test_numbers_out_of_range_are_refused(saved: Path, place: str, number: Any) -> None:
    section, name = place.split(".")
    document = json.loads((saved / "model.json").read_text())
    document[section][name] = number
    (saved / "model.json").write_text(json.dumps(document))
    with pytest.raises(UserError, match=rf"model.json: {place}.*: got .*, expected: .*; fit it again"):
        ddprt.load_model(saved)


def payload(saved: Path) -> int:
    """Where the numbers begin in the tensor file: after the header and the eight bytes of its length."""
    return 8 + int.from_bytes((saved / "tensors.safetensors").read_bytes()[:8], "little")


def test_a_flipped_bit_anywhere_is_found(saved: Path) -> None:
    path = saved / "tensors.safetensors"
    whole = path.read_bytes()
    for place in np.linspace(payload(saved), len(whole) - 1, 12).astype(int):
        damaged = bytearray(whole)
        damaged[place] ^= 0x40
        path.write_bytes(damaged)
        with pytest.raises(UserError, match="their checksum is another"):
            ddprt.load_model(saved)
    path.write_bytes(whole)
    ddprt.load_model(saved)


def test_models_without_a_checksum_load_if_all_is_finite(saved: Path, model: Model, data: Dataset) -> None:
    document = json.loads((saved / "model.json").read_text())
    del document["tensors_sha256"]  # as older versions wrote it
    (saved / "model.json").write_text(json.dumps(document))
    lighting = data.lightings[0]
    np.testing.assert_array_equal(ddprt.load_model(saved).relight(lighting), model.relight(lighting))
    tensors = read_tensors(saved / "tensors.safetensors")
    for name, array in tensors.items():
        if array.dtype.kind == "f" and array.size:
            odd = array.copy()
            odd.reshape(-1)[-1] = np.nan
            write_tensors(saved / "tensors.safetensors", {**tensors, name: odd})
            with pytest.raises(UserError, match=f"got NaN or infinity in {name}"):
                ddprt.load_model(saved)


NO_LIGHT: dict[str, tuple[Any, str]] = {
    "ragged": ([[1, 2], [3]], "got rows of unequal length"),
    "words": ([["a", "b", "c"]] * 16, "got <U1 entries"),
    "numbers in words": ([["1", "2", "3"]] * 16, "got <U1 entries"),
    "complex": (np.ones((16, 3)) + 1j, "got complex128 entries"),
    "truth": (np.ones((16, 3), bool), "got bool entries"),
    "nothing": (None, "got object entries"),
    "past float32": (np.full((16, 3), 1e39), "got NaN or infinity in float32"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", NO_LIGHT)
def test_what_is_no_light_is_refused(model: Model, name: str) -> None:
    given, expected = NO_LIGHT[name]
    for asked in (model.predict, model.trust):
        with pytest.raises(UserError, match=f"values: {expected}"):
            asked(given)


def test_light_may_be_any_real_array(model: Model) -> None:
    values = np.arange(48).reshape(16, 3)
    expected = model.predict(values.astype(np.float32))
    for same in (values, values.tolist(), values.astype(np.float16), jnp.asarray(values, jnp.bfloat16)):
        np.testing.assert_array_equal(model.predict(same), expected)  # up to 47, so exact in each of them


ODD_ARGUMENTS: dict[str, tuple[dict[str, Any], str]] = {
    "no points": ({"points": 0}, "points.count: got 0"),
    "half a point": ({"points": 1.5}, "points.count: got 1.5"),
    "half a seed": ({"seed": 1.5}, "seed: got 1.5"),
    "less than none": ({"points": -1}, "points.count: got -1"),
    "a truth of points": ({"points": True}, "points.count: got 'True'"),
    "a negative seed": ({"seed": -1}, "seed: got -1"),
    "another quantity": ({"quantity": "Radiosity"}, "quantity: got 'Radiosity'"),
    "the mean alone": ({"bases": 1, "centre": "mean"}, "fit.bases: got 1 with centre = mean"),
}


@pytest.mark.parametrize("name", ODD_ARGUMENTS)
def test_arguments_of_a_fit_that_make_no_sense_are_refused(data: Dataset, name: str) -> None:
    arguments, expected = ODD_ARGUMENTS[name]
    as_shipped = inspect.unwrap(ddprt.fit)  # without the type checks that tests run under
    with pytest.raises(UserError, match=expected):
        as_shipped(data, **arguments)


def test_the_mean_counts_as_one_basis(data: Dataset) -> None:
    model = ddprt.fit(data, bases=2, centre="mean")
    assert model.relighter.report.bases == 2
    assert len(model.relighter.basis) == 1  # type: ignore[attr-defined]


def test_numbers_of_numpy_and_jax_are_numbers(data: Dataset) -> None:
    for number in (np.float64(0.25), np.float32(0.25), jnp.float32(0.25), np.array(0.25)):
        assert _text(number) == "0.25"
    assert (_text(np.int64(4)), _text(True), _text("auto")) == ("4", "True", "auto")
    assert _text((np.float64(0.25), 1)) == _text([0.25, np.int64(1)]) == "[0.25, 1]"
    each = ddprt.fit(data, bases=4, ridge=(0.25,) * 16).relighter.report
    assert ddprt.fit(data, bases=4, ridge=np.full(16, 0.25)).relighter.report == each
    assert ddprt.fit(data, bases=4, ridge=[0.25] * 16).relighter.report == each


def test_a_lightmap_without_any_area_is_refused(data: Dataset) -> None:
    bare = replace(data)
    bare.__dict__["gbuffer"] = {**data.gbuffer, "area": np.zeros_like(data.gbuffer["area"])}
    with pytest.raises(UserError, match="area: got texels of 0 m² alone"):
        ddprt.fit(bare, bases=4)


def test_saving_into_an_unwritable_place(model: Model, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be made"):
        model.save(tmp_path / "file" / "model.ddprt")


def test_irradiance_measurements_are_an_option(data: Dataset) -> None:
    model = ddprt.fit(data, bases=5, quantity="irradiance")
    index = data.split("test")[0]
    np.testing.assert_array_equal(model.measure(data.lightings[index]), data.values([index], 16, "irradiance")[0])
