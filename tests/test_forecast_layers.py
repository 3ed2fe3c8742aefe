"""Forecasts of layers and of what glows: rays, files and bytes of the bake that follows."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_forecast import both, config_of

import ddprt
from ddprt.config import Config
from ddprt.dataset.forecast import Forecast, forecast
from ddprt.dataset.generate import bake
from ddprt.dataset.sampled import Sampled
from ddprt.progress import Progress
from ddprt.scene.material import Emission, Gloss
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.exitant import Exits
from ddprt.transport.glossiness import scattering
from ddprt.transport.openness import build_open_atlas


def glowing(name: str) -> Scene:
    """A library scene of which one material glows."""
    scene = ddprt.load_scene(name)
    last = scene.materials[-1].name
    return scene.made_of(lambda one: replace(one, emission=Emission((1.0, 2.0, 3.0))) if one.name == last else one)


@pytest.mark.parametrize(
    ("scene", "side", "transport", "probes"),
    [
        ("cornell", 48, {"samples": 32}, {"grid": [3, 3, 3], "rays": 128}),
        pytest.param("neon", 64, {"test_samples": 64}, {"grid": [3, 2, 3], "rays": 128}, marks=pytest.mark.slow),
        ("neon", 64, {"test_samples": 64, "bounces": 0}, {}),
        ("neon", 48, {"test_samples": "auto", "target_noise": 0.02}, {}),
        pytest.param("statue", 64, {"bounces": 1}, {"grid": [3, 3, 3], "rays": "auto"}, marks=pytest.mark.slow),
        ("glossy-room", 48, {"samples": 4, "test_samples": 8}, {"grid": [2, 2, 2], "rays": 128}),
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


def gilded(name: str, **part: float) -> Scene:
    """The glossy room, one more material of which is a metal."""
    metal = Gloss(**part, metallic=1.0)
    return ddprt.load_scene("glossy-room").made_of(lambda one: replace(one, gloss=metal) if one.name == name else one)


def baked(scene: Scene, config: Config, folder: Path) -> tuple[Forecast, dict[str, dict[str, Any]]]:
    """A forecast, and the stages of the bake."""
    found, progress = forecast(scene, config), Progress(quiet=True)
    bake(scene, config=config, out=folder / "data", progress=progress)
    stages = {str(stage["name"]): dict(stage) for stage in progress.stages}
    assert [stage.name for stage in found.stages] == [*stages, "files"]
    return found, stages


def gloss_files(folder: Path, order: int, test: bool) -> list[int]:
    """Bytes of the layer's files of a split, without its places and what is constant."""
    files = {path.stem: path.stat().st_size for path in (folder / "data" / f"gloss-{order}").iterdir()}
    return [size for stem, size in files.items() if stem.split(".")[0].isdigit() and (int(stem.split(".")[0]) >= 8) == test]


@pytest.mark.parametrize("bounces", [-1, 0])
def test_each_order_of_gloss_is_a_stage_of_its_own(bounces: int, tmp_path: Path) -> None:
    """All lightings and all tiles are looked at: what has one half is exact, the other half has random numbers of its own."""
    scene = gilded("white", roughness=0.6)
    transport = {"samples": 4, "test_samples": 8, "bounces": bounces}
    found, stages = baked(scene, config_of("glossy-room", 20, lightings={"clearance": 0.1}, transport=transport), tmp_path)
    told = {stage.name: stage for stage in found.stages}
    glossy = [name for name in stages if name.startswith("gloss")]
    assert len(glossy) == 4
    for name in glossy:
        order, test = int(name.split()[-1]), " test," in name
        fact, rays = stages[name]["rays"], told[name].rays
        if not test or bounces == 0:
            assert rays == fact, name
            assert fact > 0 or bounces == 0
        else:
            # Rays beyond those that leave and those of direct light go on from metal, each with a shadow ray of three lamps.
            # Their number is a count: it scatters by its root, in each of two halves that stand for each other.
            onwards = rays - stages[name]["texels"] * stages[name]["samples"]
            assert abs(rays - fact) <= 4 * np.sqrt(2 * 4 * onwards), name
        own = gloss_files(tmp_path, order, test)
        assert (told[name].files, told[name].bytes) == (len(own), sum(own)), name
    assert found.files == sum(path.is_file() for path in (tmp_path / "data").rglob("*"))
    tests = sum(stage.seconds for stage in found.stages if "test" in stage.name)
    assert found.training_seconds <= found.seconds - tests
    lines = str(found).splitlines()
    total = next(line for line in lines if line.startswith("total"))
    assert len({line.index(word) + len(word) for line, word in ((lines[0], "files"), (total, str(found.files)))}) == 1


def test_rays_of_gloss_are_chosen_in_what_stands_in_for_the_maps(tmp_path: Path) -> None:
    """As many as the square of the mean light says: 5 % of it, which is what the vase reflects, are 10 % of the rays.
    With direct light alone they are further off."""
    transport = {"samples": 32, "test_samples": "auto", "target_noise": 0.1}
    config = config_of("glossy-room", 32, lightings={"clearance": 0.1}, transport=transport)
    found, stages = baked(gilded("gilt", roughness=0.6), config, tmp_path)
    told = {stage.name: stage for stage in found.stages}
    name = "gloss test, order 4"
    assert 8 < stages[name]["samples"] < 8192, "a choice at its bounds tells nothing"
    assert told[name].rays == pytest.approx(stages[name]["rays"], rel=0.1)


def test_layers_that_are_not_kept_are_not_counted(tmp_path: Path) -> None:
    transport = {"samples": 4, "test_samples": 8}
    config = config_of("glossy-room", 20, transport=transport, effects={"glossy_layers": False})
    found, stages = baked(glowing("glossy-room"), config, tmp_path)
    assert not any(name.startswith("gloss") for name in stages)
    assert found.files == sum(path.is_file() for path in (tmp_path / "data").rglob("*"))


def test_maps_and_layers_of_both_halves_lie_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 bytes for each texel, and for each coefficient, of each lighting and half; one half of the maps is there already."""
    held: list[float] = []
    monkeypatch.setattr(Sampled, "holds", lambda job, *sizes: held.append(sum(sizes)))
    scene, config = ddprt.load_scene("glossy-room"), config_of("glossy-room", 20, lightings={"clearance": 0.1})
    forecast(scene, config)
    tracer = Tracer.of(scene, 1)
    atlas, _ = build_open_atlas(tracer, scattering(scene), 20, config.atlas.padding)
    entries = 81 * Exits.of(scene, atlas, 8).count
    assert 12 * 8 * entries in held
    assert 12 * 3 * (2 * entries + atlas.count) in held


def test_past_so_many_lightings_columns_are_told_on_a_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Rays that leave are shared, shadow rays are not: both are told from half as many lightings and from all that are made.

    As many lamps each, which the metal sees all: nothing but the stand-ins' clearance of a few lamps differs."""
    monkeypatch.setattr("ddprt.dataset.forecast_gloss.WIDE", 4)
    scene = gilded("white", roughness=0.6)
    config = config_of("glossy-room", 20, lightings={"clearance": 0.1}, transport={"samples": 4, "test_samples": 8})
    found, stages = baked(scene, config, tmp_path)
    told = {stage.name: stage for stage in found.stages}
    for name in ("gloss train, order 4", "gloss train, order 8"):
        assert told[name].rays == pytest.approx(stages[name]["rays"], rel=0.05), name


def test_what_glows_beside_gloss_is_counted_as_paths(tmp_path: Path) -> None:
    scene, config = glowing("glossy-room"), config_of("glossy-room", 32, transport={"test_samples": 16})
    found, stages = baked(scene, config, tmp_path)
    told = next(stage for stage in found.stages if stage.name == "emission")
    assert told.rays == pytest.approx(stages["emission"]["rays"], rel=0.1)
    assert np.isfinite(told.seconds)
    files = [path.stat().st_size for path in (tmp_path / "data").rglob("*constant*")]
    assert (told.files, len(files)) == (2, 2)
    assert told.bytes == pytest.approx(sum(files), rel=0.25)
