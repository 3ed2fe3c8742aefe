"""One truth for all settings: identity on the same lightmap, exact look-ups across resolutions, laws of the scores."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ddprt.bench.measure.yardstick as module
from ddprt.bench.measure.yardstick import Yardstick, carrier, make_yardstick
from ddprt.config import Config, load_config
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.report.evaluate import evaluate
from ddprt.report.metrics import Truth
from ddprt.report.view import look_up
from ddprt.runtime.model import Model
from ddprt.runtime.train import fit_config
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene

EPS = float(np.finfo(np.float64).eps)
SETTINGS = {
    "atlas.resolution": "40",
    "lightings.train": "12",
    "lightings.validation": "2",
    "lightings.test": "4",
    "lightings.clearance": "0.1",
    "points.count": "24",
    "points.supersample": "2",
    "transport.samples": "16",
    "transport.test_samples": "32",
    "transport.threads": "2",
    "fit.bases": "8",
    "bench.noise": "0.1",
    "bench.path_frames": "4",
    "bench.pictures": "0",  # each takes seconds
}
ALIKE = ("relative_rmse", "relative_mse", "psnr_db", "psnr_peak", "energy_bias", "negative_share")
ALIKE += tuple(f"{name}_lighting_relative_rmse" for name in ("median", "p90", "worst"))
KEYS = {*ALIKE, "pu21_psnr_db", "flip", "flip_reason", "flicker", "unseen_lightings"}


def configured(**changes: str) -> Config:
    return load_config(None, SETTINGS | {key.replace("__", "."): value for key, value in changes.items()})


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    return bake(cornell, config=configured())


@pytest.fixture(scope="module")
def models(data: Dataset) -> dict[str, Model]:
    return {name: fit_config(data, configured(), name) for name in ("svd-ridge", "mean")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("yardstick")


@pytest.fixture(scope="module")
def yardstick(cornell: Scene, folder: Path) -> Yardstick:
    return make_yardstick(cornell, configured(), folder)


# --- the truth --------------------------------------------------------------------------------------------------------


def test_held_out_lightings_are_those_of_a_bake_and_then_the_path(yardstick: Yardstick, data: Dataset) -> None:
    mine = [yardstick.data.lightings[index] for index in yardstick.held_out]
    assert mine == [data.lightings[index] for index in data.split("test")]
    path = [yardstick.data.lightings[index][0].anchor() for index in yardstick.path]
    assert len(path) == 4
    np.testing.assert_allclose((path[0] + path[-1]) / 2, mine[0][0].anchor(), atol=4 * EPS)  # type: ignore[operator]
    assert [len(yardstick.data.split(name)) for name in ("train", "validation")] == [1, 1]
    assert len(yardstick.data.samples.position) == 1


def test_the_second_time_it_is_there(cornell: Scene, folder: Path, yardstick: Yardstick) -> None:
    progress = Progress(quiet=True)
    again = make_yardstick(cornell, configured(), folder, progress)
    assert not any(stage.get("rays") for stage in progress.stages)
    assert again.noise == yardstick.noise
    with pytest.raises(UserError, match="holds another dataset"):
        make_yardstick(cornell, configured(lightings__test="5"), folder)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {"integrator": "auto", "test_samples": "auto"}),
        ({"transport__integrator": "paths"}, {"integrator": "paths", "test_samples": "auto"}),
        ({"transport__integrator": "reference"}, {"integrator": "reference", "test_samples": 32}),
        ({"atlas__resolution": "64"}, {"resolution": 64}),
        ({"lightings__choose": "active", "lightings__target_error": "0.1"}, {"choose": "random", "target_error": 0}),
        ({"bench__path_frames": "0"}, {"test": 4}),
    ],
)
def test_what_is_baked(
    cornell: Scene, data: Dataset, monkeypatch: pytest.MonkeyPatch, changes: dict[str, str], expected: dict[str, Any]
) -> None:
    def stub(scene: Scene, splits: dict[str, Any], *, config: Config, out: Path, progress: Any) -> Dataset:
        sections = config.lightings.model_dump() | config.transport.model_dump() | config.atlas.model_dump()
        told.update(sections | {"test": len(splits["test"])}, splits=splits)
        return data

    told: dict[str, Any] = {}
    monkeypatch.setattr(module, "bake", stub)
    make_yardstick(cornell, configured(**changes), "nowhere", resolution=48)
    cheap = {"samples": 1, "footprint": 0, "adaptive": False, "denoise": False, "target_noise": 0.1}
    wanted = {"resolution": 48, "test": 8} | cheap | expected
    assert wanted == {key: told[key] for key in wanted}
    assert told["splits"]["test"][:4] == [data.lightings[index] for index in data.split("test")]


def test_listed_lightings_are_found_in_their_places(
    cornell: Scene, data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lamp = '[{"type": "point", "position": [0.28, 0.%d, 0.28], "intensity": [1, 1, 1]}]'
    (tmp_path / "lamps.json").write_text(f"[{', '.join(lamp % place for place in (31, 32, 33, 34, 35, 36))}]")
    told: list[Any] = []
    monkeypatch.setattr(module, "bake", lambda scene, splits, **_: (told.append(splits), data)[1])
    counts = {"lightings__train": "3", "lightings__validation": "2", "lightings__test": "1"}
    make_yardstick(cornell, configured(lightings__file=str(tmp_path / "lamps.json"), **counts), "nowhere")
    heights = {name: [lighting[0].anchor()[1] for lighting in told[0][name]] for name in told[0]}
    assert heights["train"] == [0.31]
    assert heights["validation"] == [0.34]
    assert heights["test"][0] == 0.36


@pytest.mark.parametrize("frames", ["1", "2"])
def test_too_few_frames_are_refused(cornell: Scene, frames: str) -> None:
    with pytest.raises(UserError, match=r"bench.path_frames: got \d, expected 0 or at least 3"):
        make_yardstick(cornell, configured(bench__path_frames=frames), "nowhere")


# --- the same lightmap ------------------------------------------------------------------------------------------------


def test_on_its_own_dataset_it_agrees_with_evaluate_to_the_last_bit(
    cornell: Scene, data: Dataset, models: dict[str, Model]
) -> None:
    yardstick = Yardstick(cornell, data)
    found = evaluate(data, models, {}).metrics
    for name, model in models.items():
        score = yardstick.score(model)
        assert set(score) == KEYS
        assert {key: score[key] for key in ALIKE} == {key: found["methods"][name][key] for key in ALIKE}
        assert (score["flicker"], score["flip"], score["flip_reason"]) == (None, None, "bench.pictures = 0")
    assert yardstick.noise == found["floors"]["noise_relative_rmse"]
    assert yardstick.projection(models["svd-ridge"]) == found["floors"]["projection_relative_rmse"]
    assert yardstick.projection(models["mean"]) is None


def test_flicker_is_that_of_the_path(yardstick: Yardstick, models: dict[str, Model]) -> None:
    model = models["svd-ridge"]
    truth = Truth(yardstick.data.maps("indirect", yardstick.path), yardstick.data.area)
    light = np.stack([model.relight(yardstick.data.lightings[index])[model.covered] for index in yardstick.path])
    # Sums in another order: of 3 x 1600 products at most.
    assert yardstick.score(model)["flicker"] == pytest.approx(truth.flicker(light), rel=4800 * EPS)
    assert yardstick.score(model)["flicker"] > 0


def test_maps_are_held_a_few_at_a_time(yardstick: Yardstick, models: dict[str, Model], monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[int] = []
    maps = Dataset.maps

    def counting(self: Dataset, kind: str, indices: list[int]) -> np.ndarray:
        held.append(len(indices))
        return maps(self, kind, indices)

    yardstick.measured(models["svd-ridge"])
    monkeypatch.setattr(Dataset, "maps", counting)
    monkeypatch.setattr(module, "_AT_ONCE", 3)
    whole = yardstick.projection(models["svd-ridge"])
    assert sorted(held) == [1, 1, 1, 1, 1, 3]  # three and one projected, and each of the four as what it is compared with
    monkeypatch.undo()
    # Products of other shapes may sum in another order, float64 over 8 bases and 1600 texels, and are rounded to float32.
    assert whole == pytest.approx(yardstick.projection(models["svd-ridge"]), rel=1e-6)


def test_points_are_measured_once(yardstick: Yardstick, models: dict[str, Model], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, int]] = []
    measure = Model.measure_all
    record = lambda self, lightings: (calls.append((self.points, len(lightings))), measure(self, lightings))[1]  # noqa: E731
    monkeypatch.setattr(Model, "measure_all", record)
    fresh = Yardstick(yardstick.scene, yardstick.data, yardstick.frames)
    first, second = models["svd-ridge"], models["mean"]
    fewer = replace(first, points=12)
    assert fresh.measured(first) is fresh.measured(second)
    assert calls == [(24, 8)]
    assert fresh.measured(fewer).shape == (8, 12, 3)
    irradiance = replace(first, quantity="irradiance")
    assert not np.array_equal(fresh.measured(irradiance), fresh.measured(first))


# --- other lightmaps --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def atlases(plates: Scene) -> dict[int, Atlas]:
    return {resolution: build_atlas(plates, resolution) for resolution in (32, 47, 64)}


PAIRS = [(32, 64), (64, 32), (47, 64), (64, 47)]


def test_missing_texels_leave_their_weight_to_the_others() -> None:
    covered = np.array([[True, True], [True, False]])
    # A quarter of a texel right of and below the middle of the first: 9, 3, 3 and 1 sixteenths; and that middle itself.
    place, share = np.array([[0.375, 0.375], [0.25, 0.25]]), np.array([1.0, 0.5])
    matrix = look_up(place, np.array([0, 1]), share, 2, covered).toarray()
    # What is missing keeps a millionth, so that a place with nothing about it finds something.
    np.testing.assert_allclose(matrix, [[9 / 15, 3 / 15, 3 / 15], [0.5, 0, 0]], atol=2e-6)
    np.testing.assert_allclose(matrix.sum(1), share, rtol=4 * EPS)


@pytest.mark.parametrize(("coarse", "fine"), PAIRS)
def test_what_is_constant_stays_constant(plates: Scene, atlases: dict[int, Atlas], coarse: int, fine: int) -> None:
    there, here = atlases[coarse], atlases[fine]
    carry = carrier(here, plates, there.uv, there.slot >= 0)
    assert carry.shape == (here.count, there.count)
    light = np.full((there.count, 3), np.float32(0.3))
    # Weights are renormalised in float64, a few roundings that float32 does not see.
    np.testing.assert_array_equal((carry @ light).astype(np.float32), np.full((here.count, 3), np.float32(0.3)))
    assert carry.data.min() >= 0


@pytest.mark.parametrize(("coarse", "fine"), PAIRS)
def test_what_is_linear_is_carried_exactly_inside_charts(
    plates: Scene, atlases: dict[int, Atlas], coarse: int, fine: int
) -> None:
    """Plates are flat, so that position is linear in the coordinates of a chart, and so is what is linear in position.

    A texel that is covered in full holds the function's value in its middle, so a bilinear look-up between such texels is the
    function itself, and the mean over a texel's pieces is that of the function. At a rim, texels hold the value of a place that
    is at most half a texel off their middle, and neighbours that are missing shift the weights: each value that is summed is
    that of a place within 1.5 texels per axis of the one that is looked up.
    """
    there, here = atlases[coarse], atlases[fine]
    slope = np.array([0.7, -1.3, 0.4])
    before, after = (light_of(atlas, slope) for atlas in (there, here))
    carry = carrier(here, plates, there.uv, there.slot >= 0)
    error = np.abs(carry @ before - after)
    grid = np.zeros((coarse, coarse))
    grid.ravel()[there.texel] = there.coverage > 1 - 1e-6
    inner = np.ones_like(grid)
    for down in (-1, 0, 1):  # nothing about it is missing, so that no look-up between such texels was mended
        for right in (-1, 0, 1):
            inner *= np.roll(grid, (down, right), (0, 1))
    exact = np.asarray(carry @ (1 - inner.ravel()[there.texel])).ravel() == 0
    assert exact.mean() > 0.3, "hardly a texel is inside a chart"
    # Corners of pieces are float32 and relative to the scene's centre; those of two texels and of a look-up enter.
    assert error[exact].max() <= 3 * np.abs(slope).sum() * np.abs(plates.corners).max() * 2.0**-24
    edges = plates.corners[:, 1:] - plates.corners[:, :1]
    across = np.linalg.solve((there.uv[:, 1:] - there.uv[:, :1]) * coarse, (edges @ slope)[..., None])[..., 0]
    assert error.max() <= 1.5 * np.abs(across).sum(1).max()


def light_of(atlas: Atlas, slope: np.ndarray) -> np.ndarray:
    """Mean over each texel of a linear function of position."""
    value = (atlas.piece_corners.mean(1, dtype=np.float64) + atlas.centre) @ slope
    return np.bincount(atlas.piece_texel, atlas.piece_area * value) / np.bincount(atlas.piece_texel, atlas.piece_area)


@pytest.fixture(scope="module")
def coarser(cornell: Scene) -> Model:
    config = configured(atlas__resolution="28")
    return fit_config(bake(cornell, config=config), config, "svd-ridge")


def test_a_coarser_lightmap_is_scored_as_well(yardstick: Yardstick, models: dict[str, Model], coarser: Model) -> None:
    theirs, ours = yardstick.score(coarser), yardstick.score(models["svd-ridge"])
    assert set(theirs) == KEYS
    assert ours["relative_rmse"] < theirs["relative_rmse"] < 1
    assert ours["pu21_psnr_db"] > theirs["pu21_psnr_db"]
    truth = Truth(yardstick.data.maps("indirect", yardstick.held_out), yardstick.data.area)
    carry = carrier(yardstick.atlas, yardstick.scene, coarser.uv, coarser.covered)  # type: ignore[arg-type]
    errors = {}
    for clamp in (True, False):
        light = coarser.predict(yardstick.measured(coarser)[:4], clamp=clamp)
        errors[clamp] = truth.relative_rmse(np.stack([(carry @ row).astype(np.float32) for row in light]) - truth.reference)
    # Frames predicted together and one by one: float32 sums over 24 points and 8 bases.
    assert theirs["relative_rmse"] == pytest.approx(errors[True], rel=(24 + 8) * 2.0**-23)
    # A prediction that is not clamped lies in the span of the carried basis, where nothing beats a projection.
    assert 0.5 * errors[False] < yardstick.projection(coarser) < errors[False]


# --- laws -------------------------------------------------------------------------------------------------------------


def test_fewer_bases_score_worse(yardstick: Yardstick, models: dict[str, Model]) -> None:
    whole = models["svd-ridge"]
    shorter = [replace(whole, relighter=whole.relighter.truncated(bases)) for bases in (8, 3, 1, 0)]  # type: ignore[attr-defined]
    scores, floors = [yardstick.score(model) for model in shorter], [yardstick.projection(model) for model in shorter]
    for key in ("relative_rmse", "relative_mse", "median_lighting_relative_rmse"):
        assert scores[0][key] < scores[1][key] < scores[2][key] < scores[3][key]
    for key in ("psnr_db", "pu21_psnr_db"):
        assert scores[0][key] > scores[1][key] > scores[2][key] > scores[3][key]
    assert floors[0] < floors[1] < floors[2] < floors[3]
    assert all(floor < score["relative_rmse"] for floor, score in zip(floors[:3], scores, strict=False))
    assert floors[3] == scores[3]["relative_rmse"], "without a basis all is black"


def test_a_model_that_sees_nothing_is_told(yardstick: Yardstick, models: dict[str, Model]) -> None:
    model = models["svd-ridge"]
    blind = replace(model, samples=replace(model.samples, normal=-model.samples.normal))
    score = yardstick.score(blind)
    assert score["unseen_lightings"] == 4
    assert [score[f"{name}_lighting_relative_rmse"] for name in ("median", "p90", "worst")] == [1, 1, 1]
    assert (score["energy_bias"], score["negative_share"]) == (-1, 0)
    assert yardstick.score(model)["unseen_lightings"] == 0


def test_other_scenes_and_older_models_are_refused(yardstick: Yardstick, models: dict[str, Model]) -> None:
    model = models["svd-ridge"]
    other = build("plates")
    with pytest.raises(UserError, match=r"got one of scene .cornell. .*expected .plates."):
        Yardstick(other, yardstick.data).score(model)
    with pytest.raises(UserError, match="kept no lightmap coordinates"):
        yardstick.score(replace(model, uv=None))


# --- pictures ---------------------------------------------------------------------------------------------------------


def seen(yardstick: Yardstick, pictures: int) -> Yardstick:
    """The same with pictures."""
    return Yardstick(yardstick.scene, yardstick.data, yardstick.frames, pictures)


def test_pictures_are_those_of_the_first_lightings(
    yardstick: Yardstick, models: dict[str, Model], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(module, "flip", lambda pictures, alpha: (told.append((pictures, alpha)), (0.25, ""))[1])
    model, yardstick = models["svd-ridge"], seen(yardstick, 2)
    score = yardstick.score(model)
    assert (score["flip"], score["flip_reason"]) == (0.25, "")
    ((pictures, alpha),) = told
    assert len(pictures) == 2
    assert alpha.shape == (320, 320)
    for (test, reference), index in zip(pictures, yardstick.held_out, strict=False):
        albedo = yardstick.data.gbuffer["albedo"]
        truth = yardstick.view.render(yardstick.data.maps("indirect", [index])[0] * albedo)
        np.testing.assert_array_equal(reference, truth)
        assert truth.max() > 0
        light = model.relight(yardstick.data.lightings[index])[model.covered]
        np.testing.assert_array_equal(test, yardstick.view.render(light * albedo))


def test_a_missing_package_leaves_a_reason(
    yardstick: Yardstick, models: dict[str, Model], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    score = seen(yardstick, 1).score(models["mean"])
    assert score["flip"] is None
    assert "ddprt[flip]" in score["flip_reason"]
    assert score["pu21_psnr_db"] > 0


def test_flip_of_the_better_model_is_lower(yardstick: Yardstick, models: dict[str, Model]) -> None:
    pytest.importorskip("flip_evaluator", reason='needs the extra "flip"')
    better, worse = (seen(yardstick, 1).score(models[name])["flip"] for name in ("svd-ridge", "mean"))
    assert 0 < better < worse < 1
