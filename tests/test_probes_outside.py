"""Probes in free air that no light reaches: a house of closed rooms, lit from inside, with probes in its garden."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_probes import job

import ddprt
from ddprt.config import Config
from ddprt.dataset.forecast import forecast
from ddprt.dataset.layers import read_layer
from ddprt.dataset.store import Dataset
from ddprt.export.layers import export_layers
from ddprt.progress import Doubt, Progress
from ddprt.report.layers import layer_scores
from ddprt.runtime.model import Model
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted, hollow

SHUT = "1 of 5 stand inside solids or behind walls"
UNLIT = "probes: 2 of 5 get no light under any training lighting, as outside of a closed room; move the grid"


@pytest.fixture(scope="module")
def house() -> Scene:
    """A room of 1 m with walls of 0.2 m, whose outsides are surfaces too, on a lawn."""
    room = hollow(np.ones((1, 1, 1), bool), *(np.array([0.0, 1.0]) for _ in range(3)))
    lawn = box(np.array([-2.0, -0.3, -2.0]), np.array([3.0, -0.21, 3.0]))
    outside = box(np.full(3, -0.2), np.full(3, 1.2))
    return faceted("house", np.concatenate([room, outside, lawn]), (Material("plaster", (0.5, 0.5, 0.5)),))


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """Two probes in the room, one in its wall, two in the garden."""
    place = [[0.3, 0.5, 0.4], [1.1, 0.5, 0.5], [1.8, 0.4, 0.5], [0.7, 0.6, 0.5], [0.5, 0.6, -0.9]]
    file = tmp_path_factory.mktemp("places") / "probes.json"
    file.write_text(json.dumps(place))
    low, high = [0.44, 0.45, 0.44], [0.56, 0.9, 0.56]  # the room, of a box that the lawn spans
    around: dict[str, Any] = {"train": 4, "validation": 2, "test": 2, "region_low": low, "region_high": high}
    return job(lightings=around, probes={"grid": [0, 0, 0], "file": str(file), "rays": 64}, points={"count": 48})


@pytest.fixture(scope="module")
def shown() -> Progress:
    return Progress(quiet=True)


@pytest.fixture(scope="module")
def data(house: Scene, config: Config, shown: Progress, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    with pytest.warns(Doubt) as told:
        found = ddprt.bake(house, config=config, out=tmp_path_factory.mktemp("house") / "d", progress=shown)
    lines = [str(one.message) for one in told]
    assert any(SHUT in line for line in lines)
    (unlit,) = (line for line in lines if UNLIT in line)
    assert re.findall(r"(\d) at ", unlit) == ["2", "4"]
    return found


@pytest.fixture(scope="module")
def model(data: Dataset) -> Model:
    return ddprt.fit(data, bases=2)


def test_the_bake_counts_them_and_they_stay_in_free_air(data: Dataset, shown: Progress) -> None:
    (stage,) = (stage for stage in shown.stages if stage["name"] == "probes train")
    assert (stage["probes"], stage["in_the_open"], stage["unlit"]) == (5, 4, 2)
    assert (read_layer(data, "probes").weight > 0).tolist() == [True, False, True, True, True]


def test_a_forecast_names_them_before_the_bake(house: Scene, config: Config) -> None:
    with pytest.warns(Doubt) as told:
        forecast(house, config)
    lines = [str(one.message) for one in told]
    assert any(SHUT in line for line in lines)
    assert any(UNLIT in line for line in lines)


def test_report_and_export_tell_of_them(data: Dataset, model: Model, tmp_path: Path) -> None:
    scores = layer_scores(data, model)
    assert scores["probes"]["unlit"] == 2
    assert json.loads(export_layers(model, tmp_path)[1].read_text())["unlit"] == [2, 4]
