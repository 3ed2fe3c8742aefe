"""Forecasts of layers and of what glows: rays, files and bytes of the bake that follows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_forecast import both, config_of

import ddprt
from ddprt.scene.material import Emission
from ddprt.scene.mesh import Scene


def glowing(name: str) -> Scene:
    """A library scene of which one material glows."""
    from dataclasses import replace

    scene = ddprt.load_scene(name)
    last = scene.materials[-1].name
    return scene.made_of(lambda one: replace(one, emission=Emission((1.0, 2.0, 3.0))) if one.name == last else one)


@pytest.mark.parametrize(
    ("scene", "side", "transport", "probes"),
    [
        ("cornell", 48, {"samples": 32}, {"grid": [3, 3, 3], "rays": 128}),
        ("neon", 64, {"test_samples": 64}, {"grid": [3, 2, 3], "rays": 128}),
        ("neon", 64, {"test_samples": 64, "bounces": 0}, {}),
        ("statue", 64, {"bounces": 1}, {"grid": [3, 3, 3], "rays": "auto"}),
    ],
)
def test_layers_and_what_glows_come_as_foretold(
    scene: str, side: int, transport: dict[str, Any], probes: dict[str, Any], tmp_path: Path
) -> None:
    around = {"distribution": "around"} if scene == "statue" else {"clearance": 0.1}
    found, stages, _ = both(config_of(scene, side, lightings=around, transport=transport, probes=probes), tmp_path)
    assert [stage.name for stage in found.stages] == [*stages, "files"]
    told = {stage.name: stage for stage in found.stages}
    checked = [name for name in stages if name.startswith(("probes", "emission"))]
    assert checked
    for name in checked:
        # Of probes each ray is known; of what glows a share, whose shadow rays differ from texel to texel by as much.
        assert told[name].rays == pytest.approx(stages[name]["rays"], rel=0.1 if name == "emission" else 0.02), name
    files = {path.relative_to(tmp_path / "dataset"): path.stat().st_size for path in (tmp_path / "dataset").rglob("*.*")}
    own = {
        "emission": [size for path, size in files.items() if "constant" in path.name],
        **{
            f"probes {split}": [
                size for path, size in files.items() if path.parent.name == "probes" and hold(path, split == "test")
            ]
            for split in ("train", "test")
        },
    }
    for name in checked:
        assert told[name].files == len(own[name]), name
        assert told[name].bytes == pytest.approx(sum(own[name]), rel=0.25), name
    assert found.files == len(files)


def hold(path: Path, test: bool) -> bool:
    """Whether a file of probes is of a split; test lightings are the last three of eleven."""
    stem = path.name.split(".")[0]
    return stem.isdigit() and (int(stem) >= 8) == test


def test_what_glows_beside_gloss_is_counted_as_paths(tmp_path: Path) -> None:
    from ddprt.dataset.forecast import forecast
    from ddprt.dataset.generate import bake
    from ddprt.progress import Progress

    scene, config = glowing("glossy-room"), config_of("glossy-room", 32, transport={"test_samples": 16})
    found, progress = forecast(scene, config), Progress(quiet=True)
    bake(scene, config=config, out=tmp_path / "data", progress=progress)
    stages = {str(stage["name"]): dict(stage) for stage in progress.stages}
    told = next(stage for stage in found.stages if stage.name == "emission")
    assert told.rays == pytest.approx(stages["emission"]["rays"], rel=0.1)
    assert np.isfinite(told.seconds)
