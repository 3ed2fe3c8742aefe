"""Networks that learn from light on disk: what each asks for, and that it learns as well as from memory.

Coefficients of a basis are sums over texels, which come in another order from disk: they differ by rounding, and so does what
is trained on them. A lightmap's decoder sees other texels than in memory, and is judged by its error.
"""

from pathlib import Path

import jax
import numpy as np
import pytest

from ddprt.config import load_config
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.fitting import basis as bases
from ddprt.fitting.encoding import Encoding
from ddprt.methods import METHODS, neural_lightmap
from ddprt.methods.learned import Learned
from ddprt.runtime import train
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.sections import FitConfig
from ddprt.training.journal import keeping

FEW = {"steps": 40, "check_every": 20}
FAST = {"light-network", "neural-lightmap"}
STREAMS = sorted(name for name, method in METHODS.items() if issubclass(method, Learned) and method.streams)


@pytest.fixture(scope="module")
def data(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A box of 1163 texels or so: with 12 lightings, two tiles of which the last is not whole."""
    out = tmp_path_factory.mktemp("streaming") / "dataset"
    few = {"lightings.train": "12", "lightings.validation": "4", "lightings.test": "4", "transport.samples": "16"}
    config = load_config(None, {"atlas.resolution": "48", "points.count": "24", "points.supersample": "1", **few})
    return bake(cornell, config=config, out=out)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of one tile, and a lightmap's rounds and looks of fewer texels than there are."""
    monkeypatch.setattr(bases, "_BLOCK", 1)
    monkeypatch.setattr(neural_lightmap, "RUN", 100)
    monkeypatch.setattr(neural_lightmap, "RUNS", 4)


def fitted(data: Dataset, name: str, stream: bool, **settings: object) -> Model:
    config = FitConfig.model_validate({"bases": 6})
    return train.fit_method(data, config, name, {**FEW, **settings}, points=None, quantity="radiosity", seed=0, stream=stream)


def error(model: Model, data: Dataset, split: str = "test") -> float:
    values = data.values(data.split(split), model.points, "radiosity")
    lightings = [data.lightings[index] for index in data.split(split)]
    predicted = np.stack([model.predict(each, lightings=lit) for each, lit in zip(values, lightings, strict=True)])
    truth = data.maps("indirect", data.split(split))
    return float(np.sqrt((data.area[:, None] * (predicted - truth) ** 2).sum() / (data.area[:, None] * truth**2).sum()))


def test_all_that_look_at_light_by_its_coefficients_stream() -> None:
    assert STREAMS == ["light-network", "mlp", "neural-lightmap", "point-set", "residual"]


@pytest.mark.parametrize("name", [pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow]) for name in STREAMS])
def test_it_learns_from_disk_what_it_learns_from_memory(name: str, data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """To a hundredth of the error, as what was rounded otherwise is trained on; a twentieth where other texels are seen."""
    held = fitted(data, name, stream=False)
    maps, sizes, kept = Dataset.maps, list[tuple[int, ...]](), train.StreamedMaps._encode

    def encode(self: train.StreamedMaps, light: np.ndarray, scale: jax.Array) -> jax.Array:
        sizes.append(light.shape)
        return kept(self, light, scale)

    monkeypatch.setattr(train.StreamedMaps, "_encode", encode)
    monkeypatch.setattr(Dataset, "maps", None)
    streamed = fitted(data, name, stream=True)
    monkeypatch.setattr(Dataset, "maps", maps)
    largest = max(1024, neural_lightmap.CHECKED * neural_lightmap.RUNS * neural_lightmap.RUN)
    assert {size[1] for size in sizes if size[0] == 12} <= {*range(1, largest + 1)}
    assert error(streamed, data) == pytest.approx(error(held, data), rel=5e-2 if name == "neural-lightmap" else 1e-2)


@pytest.mark.parametrize("start", [0, 17, -6])
def test_runs_of_texels_go_on_at_the_first(start: int, data: Dataset) -> None:
    config = FitConfig()
    encoding = Encoding()
    pack = data.packed()
    held, streamed = (train.examples(data, "train", encoding, config, 24, "radiosity", p) for p in (None, pack))
    whole = held.indirect.shape[1]
    wanted = np.concatenate([(np.arange(100) + first) % whole for first in (start, 5)])
    found = streamed.indirect.runs([start % whole, 5], 100)  # type: ignore[union-attr]
    np.testing.assert_array_equal(np.asarray(found), np.asarray(held.indirect)[:, wanted])  # type: ignore[index]


def test_a_lightmap_sees_other_texels_each_round(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, ...]] = []
    kept = train.StreamedMaps.runs

    def runs(self: train.StreamedMaps, starts: list[int], texels: int) -> jax.Array:
        asked.append(tuple(starts))
        return kept(self, starts, texels)

    monkeypatch.setattr(train.StreamedMaps, "runs", runs)
    fitted(data, "neural-lightmap", stream=True, steps=80)
    rounds = [starts for starts in asked if len(starts) == neural_lightmap.RUNS]
    assert len(set(rounds)) == 4  # of 20 steps each


def test_a_lightmap_learns_from_runs_of_texels(data: Dataset) -> None:
    """What is best on some texels of the validation light is better than what it begins with on all of them."""
    config = FitConfig.model_validate({"bases": 6})
    base = train.fit_method(data, config, "svd-ridge", {}, points=None, quantity="radiosity", seed=0)
    assert error(fitted(data, "neural-lightmap", stream=True), data, "validation") < 0.99 * error(base, data, "validation")


def test_a_lightmap_in_fewer_texels_than_a_run_sees_them_all(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neural_lightmap, "RUN", 10**6)
    assert error(fitted(data, "neural-lightmap", stream=True), data) < error(fitted(data, "mlp", stream=True), data)


def test_a_streamed_training_goes_on_to_the_same_bits(data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fitted(data, "neural-lightmap", stream=True, steps=80)
    looks, round_of = [0], neural_lightmap._looked_at

    def stops(*arguments: object) -> object:
        looks[0] += 1
        if looks[0] == 6:  # what is left, what is held, twice the first round, the second, the third
            raise KeyboardInterrupt
        return round_of(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(neural_lightmap, "_looked_at", stops)
    with pytest.raises(KeyboardInterrupt), keeping(tmp_path, every=0.0):
        fitted(data, "neural-lightmap", stream=True, steps=80)
    monkeypatch.setattr(neural_lightmap, "_looked_at", round_of)
    with keeping(tmp_path, every=0.0):
        resumed = fitted(data, "neural-lightmap", stream=True, steps=80)
    for one, other in zip(*(jax.tree.leaves(model.relighter) for model in (whole, resumed)), strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    assert len((tmp_path / "neural-lightmap.jsonl").read_text().splitlines()) == 4
