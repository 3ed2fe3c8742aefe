"""One setting, really tried: what its record says, what its bake counts, and when an earlier one still holds."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ddprt
from ddprt.bench.frontier import pareto
from ddprt.bench.measure import trial
from ddprt.bench.measure.settings import Setting, changed
from ddprt.bench.measure.trial import Workshop, frame_seconds, measured_here
from ddprt.config import Config, checked
from ddprt.dataset.splits import SPLITS
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config
from ddprt.transport.embree import Tracer

SMALL: dict[str, Any] = {
    "atlas": {"resolution": 32},
    "lightings": {"train": 8, "validation": 2, "test": 3},
    "points": {"count": 12, "supersample": 2},
    "transport": {"samples": 8, "threads": 2},
    "fit": {"bases": 4},
    "bench": {"repeats": 1, "path_frames": 6, "pictures": 0, "noise": 0.3},
}
BASE = checked(SMALL)
KEYS = {
    *("schema", "digest", "digest_bake", "name", "changes", "config", "failed", "truth", "sources", "repeats"),
    *("scores", "floors", "bake"),
    *("fit", "frame", "batch", "coefficients", "bytes", "flops", "bases", "method", "status", "remarks", "environment"),
}
TIMES = {"median", "low", "high", "compile", "repeats"}


def about(**changes: Any) -> Setting:
    told = {key.replace("__", "."): value for key, value in changes.items()}
    return Setting(told, changed(BASE, told))


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(BASE, tmp_path_factory.mktemp("shop"), Progress(quiet=True))


@pytest.fixture(scope="module")
def record(shop: Workshop) -> dict[str, Any]:
    return shop.measure(about())


@pytest.fixture
def fresh(shop: Workshop, tmp_path: Path) -> Workshop:
    """A workshop with a bake in it that may be spoilt."""
    shop.bake(about())
    shutil.copytree(shop.folder / "datasets", tmp_path / "datasets")
    return Workshop(BASE, tmp_path, Progress(quiet=True))


def test_a_record_has_every_key_and_is_json(record: dict[str, Any]) -> None:
    assert set(record) == KEYS
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert set(record["fit"]) >= TIMES
    assert "peak_gib" in record["fit"]
    assert set(record["frame"]) == set(record["coefficients"]) == TIMES
    assert set(record["batch"]) == TIMES | {"frames"}
    assert record["batch"]["frames"] == 8, "as many as there are, at most 16"
    assert set(record["bake"]) == {"seconds", "stages", "rays", "bytes", "peak_gib"}
    assert set(record["environment"]) == {"ddprt", "commit", "when", "machine"}


def test_every_measure_of_the_page_finds_its_number(record: dict[str, Any]) -> None:
    absent = {name for name, measure in {**pareto.COSTS, **pareto.ERRORS}.items() if measure.of(record) is None}
    assert absent == {"flip"}, "no pictures were asked for"


def test_scores_are_those_of_the_model_on_the_truth(shop: Workshop, record: dict[str, Any]) -> None:
    data, _ = shop.bake(about())
    model = stored(fit_config(data, BASE, "svd-ridge"), "half")
    truth = shop.yardstick.data
    held = truth.split("test")[:3]
    weight = (truth.area / truth.area.sum()).astype(np.float64)
    errors, means = [], []
    for index in held:  # the definition, in float64 and without the code that is judged
        reference = truth.maps("indirect", [index])[0].astype(np.float64)
        light = np.asarray(model.relight(truth.lightings[index]), np.float64)[truth.covered]
        errors.append(np.sum(weight[:, None] * (light - reference) ** 2) / 3)
        means.append(np.sum(weight[:, None] * reference) / 3)
    # Float32 sums over some 300 texels differ from float64 by far less than 1e-5 of themselves.
    assert record["scores"]["relative_rmse"] == pytest.approx(np.sqrt(np.mean(errors)) / np.mean(means), rel=1e-5)
    assert record["bytes"] == shipped_bytes(model, "half")
    assert record["flops"] == model.relighter.flops
    assert record["bases"] == 4


def test_methods_without_coefficients_say_none(shop: Workshop) -> None:
    data, _ = shop.bake(about())
    model = fit_config(data, BASE, "nearest")
    assert frame_seconds(model, data, 1)["coefficients"] is None


def test_the_training_data_are_those_of_a_whole_bake(shop: Workshop, tmp_path: Path) -> None:
    data, _ = shop.bake(about())
    whole = ddprt.bake(shop.scene, config=BASE, out=tmp_path / "whole")
    for split in ("train", "validation"):
        assert np.array_equal(data.maps("indirect", data.split(split)), whole.maps("indirect", whole.split(split)))
        values = [each.values(each.split(split), 12, "radiosity") for each in (data, whole)]
        assert np.array_equal(*values), "points, too, stand where they would"
    assert len(data.split("test")) < len(whole.split("test"))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("choose", ["random", "active"])
def test_the_lamp_nearest_to_a_surface_is_there(shop: Workshop, seed: int, choose: str) -> None:
    """points.depth goes by it, held out or not."""
    config = changed(BASE, {"seed": seed, "lightings.train": 2, "lightings.test": 8})
    tracer = Tracer.of(shop.scene)

    def least(config: Config) -> tuple[float, int]:
        entries, _ = trial.choose_lightings(None, config.lightings, shop.scene, tracer, config.seed)
        places = [place for _, lighting in entries for light in lighting if (place := light.anchor()) is not None]
        return float(tracer.clearance(np.array(places)).min()), sum(split == "test" for split, _ in entries)

    cut, splits = shop._training_only(changed(config, {"lightings.choose": choose}))
    assert splits is None
    few, all_of_them = least(changed(cut, {"lightings.choose": "random"})), least(config)
    assert few[0] == all_of_them[0]
    assert few[1] <= all_of_them[1]


def test_listed_lightings_keep_the_nearest_held_out_one(shop: Workshop, tmp_path: Path) -> None:
    low, high = shop.scene.bounds
    middle = low + (high - low) * [0.5, 0.8, 0.5]  # above the blocks
    lamp = lambda place: [{"type": "point", "position": [float(x) for x in place], "intensity": [1, 1, 1]}]  # noqa: E731
    shift = np.array([0.05, 0.0, 0.0])
    places = [middle + i * shift for i in range(-3, 4)] + [np.array([middle[0], high[1] - 0.01, middle[2]])]
    listed = tmp_path / "lightings.json"
    listed.write_text(json.dumps([lamp(place) for place in places]))
    counts = {"lightings.train": 5, "lightings.validation": 1, "lightings.test": 2}
    # A hundred points of two samples are 0.07 m apart: nearer to a surface than that is the last lamp alone.
    config = changed(BASE, {"lightings.file": str(listed), "points.count": 100, **counts})
    own = Workshop(config, tmp_path / "own", Progress(quiet=True))
    data, _ = own.bake(Setting({}, config))
    whole = ddprt.bake(own.scene, config=config, out=tmp_path / "whole")
    assert data.samples.depth == whole.samples.depth > 0
    assert [len(data.split(name)) for name in SPLITS] == [5, 1, 1]


def test_bake_seconds_leave_out_held_out_maps_and_the_atlas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = {"lightings": 0.25, "atlas": 2.0, "points": 0.25, "direct": 1.0, "indirect train": 3.0, "indirect test": 4.0}

    def fake(scene: Any, lightings: Any, *, config: Config, out: Path, progress: Progress) -> Any:
        out.mkdir(parents=True)
        (out / "maps").write_bytes(b"12345")
        progress.stages += [{"name": name, "seconds": seconds, "rays": 10} for name, seconds in stages.items()]
        return Dataset(out, {})

    clock = iter([100.0, 111.0])
    monkeypatch.setattr(trial, "bake", fake)
    monkeypatch.setattr(trial, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    _, told = Workshop(BASE, tmp_path, Progress(quiet=True)).bake(about())
    assert told["seconds"] == 11 - 2 - 4
    assert told["rays"] == 10 * (len(stages) - 1)
    assert told["bytes"] == 5
    assert told["stages"] == {name: seconds for name, seconds in stages.items() if name != "indirect test"}


def forbidden(*_: Any, **__: Any) -> Dataset:
    raise AssertionError("baked again")


def test_what_was_baked_is_found(fresh: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "bake", forbidden)
    assert fresh.bake(about(fit__bases=2))[1] == fresh.bake(about(points__quantity="irradiance"))[1]
    with pytest.raises(AssertionError, match="baked again"):
        fresh.bake(about(seed=3))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("environment", "ddprt"), "0.0.0"),
        (("environment", "machine", "processor"), "another"),
        (("environment", "machine", "cores"), 1000),
        (("sources",), "other files"),
    ],
)
def test_a_bake_of_another_version_machine_or_file_is_made_anew(
    fresh: Workshop, place: tuple[str, ...], value: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (told,) = fresh.folder.glob("datasets/*/baked.json")
    document = json.loads(told.read_text())
    table = document
    for key in place[:-1]:
        table = table[key]
    assert table[place[-1]] != value
    table[place[-1]] = value
    told.write_text(json.dumps(document))
    monkeypatch.setattr(trial, "bake", forbidden)
    with pytest.raises(AssertionError, match="baked again"):
        fresh.bake(about())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda whole: whole[: len(whole) // 2],
        lambda whole: "",
        lambda whole: "[]",
        lambda whole: "{}",
        lambda whole: whole.replace('"seconds"', '"hours"', 1),
        lambda whole: whole.replace('"environment"', '"surroundings"'),
        lambda whole: whole.replace('"sources"', '"files"'),
        lambda whole: whole.replace('"bake": {', '"bake": 1, "bait": {'),
        lambda whole: whole.replace('"machine": {', '"machine": "this one", "engine": {'),
    ],
)
def test_a_bake_whose_note_was_spoilt_is_made_anew(fresh: Workshop, spoil: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (told,) = fresh.folder.glob("datasets/*/baked.json")
    whole = told.read_text()
    assert spoil(whole) != whole
    told.write_text(spoil(whole))
    monkeypatch.setattr(trial, "bake", forbidden)
    with pytest.raises(AssertionError, match="baked again"):
        fresh.bake(about())


def test_a_bake_that_was_cut_off_begins_anew(fresh: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    (told,) = fresh.folder.glob("datasets/*/baked.json")
    told.unlink()
    seen: list[bool] = []

    def look(*_: Any, out: Path, **__: Any) -> Dataset:
        seen.append(out.exists())
        raise UserError("looked")

    monkeypatch.setattr(trial, "bake", look)
    with pytest.raises(UserError, match="looked"):
        fresh.bake(about())
    assert seen == [False], "a part of it would make the whole look quick"


@pytest.mark.parametrize(
    ("key", "value", "same"),
    [
        ("fit.bases", 2, True),
        ("lightings.train", 5, True),
        ("lightings.choose", "active", True),
        ("points.count", 3, True),
        ("transport.samples", 5, True),
        ("transport.test_samples", 50, True),
        ("bench.repeats", 3, True),
        ("lightings.test", 5, False),
        ("lightings.intensity", [1.0, 2.0], False),
        ("bench.noise", 0.1, False),
        ("bench.path_frames", 0, False),
        ("bench.pictures", 1, False),
        ("transport.bounces", 1, False),
        ("atlas.resolution", 64, False),
        ("seed", 1, False),
        ("scene.name", "plates", False),
    ],
)
def test_the_truth_is_told_apart_by_what_scores_depend_on(shop: Workshop, key: str, value: Any, same: bool) -> None:
    assert (replace(shop, config=changed(BASE, {key: value})).truth == shop.truth) == same


def test_a_finer_atlas_of_the_sweep_is_another_truth(shop: Workshop) -> None:
    assert replace(shop, resolution=64).truth != shop.truth == replace(shop, resolution=16).truth


def test_listed_lightings_are_told_apart_by_their_contents(shop: Workshop, tmp_path: Path) -> None:
    file = tmp_path / "list.json"
    config = changed(BASE, {"lightings.file": str(file)})
    own = [replace(shop, config=config) for _ in range(3)]
    file.write_text("[1]")
    first = own[0].truth, own[0].sources(config)
    assert (own[1].truth, own[1].sources(config)) == first
    file.write_text("[2]")
    second = own[2].truth, own[2].sources(config)
    assert second[0] != first[0]
    assert second[1] != first[1]
    file.unlink()
    assert own[2].sources(config) not in (first[1], second[1]), "it is missing, which the bake will tell"


def test_a_base_that_chooses_its_lightings_has_the_same_truth(shop: Workshop, record: dict[str, Any]) -> None:
    active = replace(shop, config=changed(BASE, {"lightings.choose": "active"}))
    assert active.yardstick.data.lightings == shop.yardstick.data.lightings


def test_a_black_truth_is_refused(tmp_path: Path) -> None:
    dark = Workshop(changed(BASE, {"transport.bounces": 0, "bench.path_frames": 0}), tmp_path, Progress(quiet=True))
    with pytest.raises(UserError, match="held-out lightings without indirect light, expected some"):
        _ = dark.yardstick


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene.name": "plates"}, 'scene: got "plates", expected that of the configuration, "cornell"'),
        ({"scene.parameters": {"albedo": 0.5}}, "scene: got"),
        ({"fit.method": "svd"}, 'no method "svd"'),
        ({"methods.settings": {"mlp": {"stepz": 3}}}, "stepz"),
        ({"lightings.choose": "active", "lightings.target_error": 0.1}, "lightings.target_error: got 0.1, expected 0"),
    ],
)
def test_what_can_be_known_before_a_bake_is_told_before(
    shop: Workshop, changes: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "bake", forbidden)
    with pytest.raises(UserError, match=message):
        shop.bake(Setting(changes, changed(BASE, changes)))


def test_records_hold_until_something_differs(shop: Workshop, record: dict[str, Any]) -> None:
    assert shop.holds(record, about())
    for other in (
        {"schema": 0},
        {"failed": "why"},
        {"truth": "another"},
        {"sources": "others"},
        {"environment": {**record["environment"], "ddprt": "0"}},
        {"repeats": 0},
    ):
        assert not shop.holds({**record, **other}, about()), other
    assert not shop.holds({}, about())
    assert not measured_here({**record["environment"], "machine": {}})


def test_more_repeats_than_were_asked_for_are_measured_anew(shop: Workshop, record: dict[str, Any]) -> None:
    """What counts is what was asked: where a fit takes long fewer are made, and no other run would make more."""
    again = replace(shop, config=changed(BASE, {"bench.repeats": 5}))
    assert not again.holds(record, about())
    assert again.holds({**record, "repeats": 5, "fit": {**record["fit"], "repeats": 2}}, about())
    assert shop.holds({**record, "repeats": 5}, about()), "fewer are asked for"


def test_forgetting_removes_what_it_says(shop: Workshop, record: dict[str, Any], tmp_path: Path) -> None:
    own = replace(shop, folder=tmp_path)
    kept, other, data = tmp_path / f"truth-{shop.truth}", tmp_path / "truth-other", own._dataset(about())
    for folder in (kept, other, data, tmp_path / "datasets" / "more"):
        folder.mkdir(parents=True)
    own.forget(about())
    assert not data.exists()
    assert (tmp_path / "datasets" / "more").exists()
    own.forget_all(but_truth=True)
    assert [path.name for path in tmp_path.iterdir()] == [kept.name]
    own.forget_all()
    assert not list(tmp_path.iterdir())
