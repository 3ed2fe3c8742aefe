"""The report: tone map and colours in closed form, views against geometry, and a page that stands on its own."""

import io
import re
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

import ddprt
from ddprt.config import Config, load_config
from ddprt.dataset.layers import Layer
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.methods.method import STATUSES
from ddprt.report import figures
from ddprt.report.evaluate import Evaluation, bases_curve, evaluate, spot_check
from ddprt.report.metrics import z_scores
from ddprt.report.page import _short, method_table, warnings, write_page
from ddprt.report.view import Camera, default_camera, first_fronts, seen, take_view
from ddprt.report.words import count, percent, seconds, size
from ddprt.runtime.model import LayerModel, Model
from ddprt.runtime.train import fit_config
from ddprt.scene.atlas import Atlas
from ddprt.scene.library import SCENES
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import Effect
from ddprt.transport.embree import Tracer

SECTIONS = {"result", "warnings", "lightings", "methods", "basis", "points", "check", "effects", "cost", "definitions"}
SECTIONS |= {"settings", "reproduce"}
VOID = {"meta", "img", "br", "hr", "input", "link", "use", "path"}
SETTINGS = {
    "atlas.resolution": "48",
    "lightings.train": "10",
    "lightings.validation": "2",
    "lightings.test": "5",
    "lightings.clearance": "0.1",
    "points.count": "24",
    "points.supersample": "2",
    "transport.samples": "16",
    "transport.test_samples": "32",
    "fit.bases": "4",
    "methods.compare": '["svd-ridge", "mean"]',
    "report.rows": "2",
    "report.bases_curve": "[2, 4]",
    "report.spot_check_texels": "16",
    "report.spot_check_lightings": "2",
    "report.spot_check_samples": "16",
}


class Job:
    """One small run up to its page."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self.scene, self.folder = scene, folder
        self.config: Config = load_config(None, SETTINGS)
        self.data: Dataset = ddprt.bake(scene, config=self.config)
        self.models: dict[str, Model] = {name: fit_config(self.data, self.config, name) for name in self.config.methods.compare}
        self.evaluation: Evaluation = evaluate(self.data, self.models, {"svd-ridge": 0.5})
        self.evaluation.curve = bases_curve(self.data, self.config, self.evaluation.truth)
        self.evaluation.spot_check = spot_check(scene, self.data, self.config)

    def write(self, **changes: Any) -> str:
        given: dict[str, Any] = {"evaluation": self.evaluation, "data": self.data, "models": self.models, "config": self.config}
        given |= {"scene": self.scene, "stages": [{"name": "direct", "seconds": 2.0, "rays": 3_000_000, "texels_seen": 7}]}
        given |= {"command": "ddprt run <tiny>.toml"}
        return write_page(self.folder / "report.html", **{**given, **changes}).read_text("utf-8")


class Outline(HTMLParser):
    """Complains about elements that are not closed in order, and collects what a page points at."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.targets: list[str] = []
        self.ids: list[str] = []
        self.scripts = 0
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        self.targets += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "srcset", "poster")]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.fixture(scope="module")
def job(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Job:
    return Job(cornell, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def page(job: Job) -> str:
    return job.write()


def outline(page: str) -> Outline:
    found = Outline()
    found.feed(page)
    found.close()
    return found


def pixels(picture: bytes) -> np.ndarray:
    return imread(io.BytesIO(picture))


# Tone map and colours


def test_tonemap_is_the_srgb_curve_of_exposed_light() -> None:
    grey = np.array([[0.0, 0.0031308, 0.18], [0.5, 1.0, 7.0]])
    expected = [[0, 0.04045, 0.4613561], [0.7353570, 1, 1]]
    np.testing.assert_allclose(figures.tonemap(grey, 0.0), expected, atol=1e-5)
    np.testing.assert_allclose(figures.tonemap(grey / 8, 3.0), expected, atol=1e-5)
    assert figures.tonemap(np.full((1, 3), -1.0), 0.0).max() == 0


@pytest.mark.parametrize("scale", [1e-4, 1.0, 300.0])
def test_exposure_shows_the_99th_percentile_at_four_fifths(scale: float) -> None:
    light = scale * np.random.default_rng(1).random((5000, 1)) * np.ones(3)
    exposure = figures.exposure_for(light)
    bright = np.full((1, 3), np.quantile(light, 0.99))
    assert figures.tonemap(bright, exposure).max() == pytest.approx(0.8, abs=0.02)
    assert exposure == round(exposure, 1)


def test_exposure_of_darkness_is_none() -> None:
    assert figures.exposure_for(np.zeros((4, 3))) == 0.0
    assert figures.exposure_for(np.zeros((0, 3))) == 0.0


def test_difference_colours_are_symmetric() -> None:
    red, blue = (figures.diverging(sign * np.linspace(0, 2, 9), 1.0) for sign in (1, -1))
    np.testing.assert_array_equal(red[0], 1)
    np.testing.assert_array_equal(blue[0], 1)
    assert (red[1:, 0] > red[1:, 2]).all()
    assert (blue[1:, 2] > blue[1:, 0]).all()
    assert (np.diff(red[:5].sum(1)) < 0).all()
    np.testing.assert_array_equal(red[4:], np.broadcast_to(red[4], (5, 3)))  # past the limit nothing changes
    np.testing.assert_allclose(red.sum(1), blue.sum(1), atol=0.35)  # neither sign looks stronger


def test_difference_range_ignores_the_sign_and_outliers() -> None:
    values = np.append(np.linspace(-1, 1, 9999), 1e6)
    assert figures.signed_range(values) == figures.signed_range(-values) == pytest.approx(1.0, abs=0.02)
    assert figures.signed_range(np.zeros(5)) == 0.0
    assert (figures.diverging(np.zeros(3), 0.0) == 1).all()


def test_rows_are_the_median_the_90th_percentile_and_the_worst_first() -> None:
    errors = np.append(np.random.default_rng(1).permutation(101) / 100, np.nan)
    named = {label: errors[row] for row, label in figures.choose_rows(errors, 6)}
    assert (named["median"], named["90th percentile"], named["worst"], named["best"]) == (0.5, 0.9, 1.0, 0.0)
    assert len(named) == 6
    assert [errors[row] for row, _ in figures.choose_rows(errors, 6)] == sorted(named.values())
    assert [label for _, label in figures.choose_rows(errors, 1)] == ["median"]


@pytest.mark.parametrize(("errors", "count", "expected"), [([0.1, 0.2], 5, 2), ([np.nan], 3, 0), ([], 1, 0), ([0.3], 4, 1)])
def test_rows_of_few_lightings(errors: list[float], count: int, expected: int) -> None:
    rows = figures.choose_rows(np.array(errors, float), count)
    assert len(rows) == len({row for row, _ in rows}) == expected


# Views


def test_camera_projects_where_its_rays_go() -> None:
    camera = Camera((1.0, 2.0, 3.0), (0.0, 0.5, -1.0), 40.0, 1.5)
    places = np.random.default_rng(1).random((50, 2))
    positions = np.array(camera.eye) + 3.7 * camera.directions(places).astype(float)
    np.testing.assert_allclose(camera.project(positions), places, atol=1e-6)
    top_left, up = camera.directions(np.array([[0.0, 0.0], [0.5, 0.0]])) @ camera.axes.T
    assert top_left[0] < 0 < top_left[1]
    assert np.degrees(np.arctan2(up[1], up[2])) == pytest.approx(20, abs=1e-4)
    assert np.isnan(camera.project(np.array([[2.0, 3.5, 7.0]]))).all()


def test_view_shows_positions_where_they_are(cornell: Scene, cornell_atlas: Atlas) -> None:
    tracer, camera = Tracer.of(cornell), default_camera(cornell)
    covered = cornell_atlas.slot >= 0
    view = take_view(tracer, cornell_atlas.uv, covered, camera, height=40)
    np.testing.assert_allclose(view.lookup.sum(1), view.alpha.reshape(-1, 1), atol=1e-12)
    assert view.alpha.max() == pytest.approx(1)
    assert view.render(np.ones((cornell_atlas.count, 3))).shape == (40, 40, 3)
    # Rendering the position buffer gives, at each pixel, a position that projects back to that pixel.
    inside = view.alpha > 0.999
    places = camera.project(view.render(cornell_atlas.position)[inside])
    row, column = np.nonzero(inside)
    error = np.abs(places - np.stack([column + 0.5, row + 0.5], 1) / 40)
    # Texels are about twice as large as pixels here, and positions are not always at their centres.
    assert np.quantile(error, 0.95) < 0.025
    assert np.median(error) < 0.008


def test_back_faces_do_not_hide(cornell: Scene, cornell_atlas: Atlas) -> None:
    tracer = Tracer.of(cornell)
    behind = np.array([0.278, 0.15, 1.5])  # outside, at the back wall's back
    hits = first_fronts(tracer, behind, np.array([[0.0, 0.0, -1.0]], np.float32))
    assert hits.triangle[0] == -1 or hits.front[0]
    above = first_fronts(tracer, np.array([0.05, 2.0, 0.5]), np.array([[0.0, -1.0, 0.0]], np.float32))
    assert cornell.corners[above.triangle[0], :, 1].max() == 0  # through the ceiling onto the floor
    visible = seen(tracer, default_camera(cornell), cornell_atlas.position)
    facing = np.einsum(
        "td,td->t", cornell_atlas.geometric_normal, np.array(default_camera(cornell).eye) - cornell_atlas.position
    )
    assert 0.3 < visible.mean() < 0.95
    assert not visible[facing < -1e-3].any()


@pytest.mark.parametrize("name", sorted(SCENES))
def test_every_library_scene_is_in_its_default_picture(name: str) -> None:
    scene = ddprt.load_scene(name)
    camera = default_camera(scene)
    across = (np.arange(48) + 0.5) / 48
    places = np.stack(np.meshgrid(across, across), -1).reshape(-1, 2)
    hits = first_fronts(Tracer.of(scene), np.array(camera.eye), camera.directions(places))
    assert (hits.triangle >= 0).mean() > 0.2


# Figures


def test_pictures_of_a_lighting_are_there_and_dark_outside(job: Job) -> None:
    test = job.data.split("test")
    direct, reference = job.data.maps("direct", test[:1])[0], job.evaluation.truth.reference[0]
    row = figures.lighting_row(direct, reference, reference, job.data.gbuffer["albedo"], job.data.covered, None)
    assert row["view"] == {}
    assert row["limit"] == 0
    assert row["exposure"] == figures.exposure_for(reference)
    for picture in row["atlas"].values():
        image = pixels(picture)
        assert image.shape == (48, 48, 4)
        np.testing.assert_array_equal(image[..., 3] > 0, job.data.covered)
    assert (pixels(row["atlas"]["difference"])[job.data.covered] == 1).all()  # ours is the reference: all white
    np.testing.assert_array_equal(pixels(row["atlas"]["ours"]), pixels(row["atlas"]["reference"]))
    assert pixels(row["atlas"]["reference"])[..., :3].std() > 0.05


def test_large_lightmaps_are_thinned_out_for_display() -> None:
    covered = np.ones((1100, 1100), bool)
    assert max(figures.on_atlas(np.zeros((covered.sum(), 3)), covered).shape) <= 512


def test_plots_are_themed_and_their_ids_their_own(job: Job) -> None:
    reports = {name: model.relighter.report for name, model in job.models.items()}
    plots = figures.plots(job.evaluation, reports, "svd-ridge")
    assert {"eigenvalues", "bases", "ridge", "distance", "spot"} <= set(plots)
    ids = [found for text in plots.values() for found in re.findall(r'id="([^"]+)"', text)]
    assert len(ids) == len(set(ids))
    for text in plots.values():
        assert text.startswith("<svg")
        assert "var(--plot-ink, " in text
        assert not re.search(r"<style|<script| width=\"\d+\.?\d*pt\"", text)
        assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', text)) <= set(ids)


def test_z_scores_stand_beside_the_unit_normal() -> None:
    truth = np.ones((2, 50, 3))
    baked = truth + np.random.default_rng(1).normal(size=truth.shape) * 0.1
    variance = np.full(truth.shape, 0.01)
    variance[0, 0] = 0  # unknown: left out rather than divided by
    assert "unit normal" in figures.z_histogram({"baked": baked, "truth": truth, "variance": variance})


def test_hero_is_one_wide_picture(job: Job) -> None:
    atlas = job.data.description["atlas"]
    uv = figures_uv(job.scene, atlas)
    view = take_view(Tracer.of(job.scene), uv, job.data.covered, default_camera(job.scene), height=64)
    reference = job.evaluation.truth.reference[0]
    direct = job.data.maps("direct", job.data.split("test")[:1])[0]
    ours = job.evaluation.predicted["svd-ridge"][0]
    image = pixels(figures.hero(direct, ours, reference, job.data.gbuffer["albedo"], job.data.covered, view, title="t"))
    assert image.shape[1] > 1.5 * image.shape[0]
    assert image[..., :3].std() > 0.1


def figures_uv(scene: Scene, atlas: dict[str, Any]) -> np.ndarray:
    from ddprt.scene.unwrap import unwrap

    return unwrap(scene, atlas["resolution"], atlas["padding"])[0]


# Page


def test_page_is_whole_and_needs_nothing_else(page: str) -> None:
    found = outline(page)
    assert found.open == []
    assert set(found.ids) >= SECTIONS
    assert len(found.ids) == len(set(found.ids))
    assert found.scripts == 0
    assert all(target.startswith(("data:image/png;base64,", "#")) for target in found.targets)
    assert all(target[1:] in found.ids for target in found.targets if target.startswith("#"))
    assert not re.search(r"@import|url\((?!#)", page)
    # Two lightings of ten pictures and two of three, four bases seen and flat, two pictures of points.
    assert sum(target.startswith("data:") for target in found.targets) == 2 * 10 + 2 * 3 + 4 * 2 + 2


def test_page_says_what_was_found(job: Job, page: str) -> None:
    text = " ".join("".join(outline(page).texts).split())
    score = job.evaluation.metrics["methods"]["svd-ridge"]
    assert f"is off by {percent(score['relative_rmse'])} (relative RMSE)".replace("\u00a0", " ") in text.replace("\u00a0", " ")
    assert "1.5 M" in text  # rays per second
    assert "texels seen 7" in text
    assert "ddprt run <tiny>.toml" in text
    assert "&lt;tiny&gt;" in page
    assert "resolution = 48" in text
    for effect in job.data.description["plan"]:
        assert effect["name"] in text
        assert effect["why"] in text
    for name, score in job.evaluation.metrics["methods"].items():
        assert score["status"] == "ok" or STATUSES[score["status"]] in text, name


def test_pages_of_equal_runs_are_equal(job: Job, page: str) -> None:
    assert job.write() == page


def test_page_without_scene_basis_or_check(job: Job) -> None:
    evaluation = Evaluation(job.evaluation.metrics, job.evaluation.truth, job.evaluation.values, job.evaluation.predicted)
    page = job.write(scene=None, models={"mean": job.models["mean"]}, evaluation=evaluation, stages=[], command="")
    found = outline(page)
    assert found.open == []
    assert set(found.ids) >= SECTIONS
    assert sum(target.startswith("data:") for target in found.targets) == 2 * 4
    assert "not recorded" in page


def test_page_without_scene_shows_a_basis_on_the_lightmap_alone(job: Job) -> None:
    found = outline(job.write(scene=None))
    assert found.open == []
    titles = "".join(found.texts)
    assert "First basis vectors" in titles
    assert titles.count("in the view") == 0


def test_page_of_darkness(job: Job) -> None:
    truth = type(job.evaluation.truth)(np.zeros_like(job.evaluation.truth.reference), job.data.area)
    metrics = {**job.evaluation.metrics, "dark_test_lightings": 5}
    metrics["floors"] = dict.fromkeys(metrics["floors"])
    metrics["methods"] = {
        "svd-ridge": {**metrics["methods"]["svd-ridge"], **truth.scores(truth.reference), "status": "no_signal", "remarks": []}
    }
    evaluation = Evaluation(metrics, truth, job.evaluation.values, {"svd-ridge": truth.reference})
    page = job.write(evaluation=evaluation, models={"svd-ridge": job.models["svd-ridge"]})
    assert outline(page).open == []
    assert STATUSES["no_signal"] in page
    assert "Dark test lightings" in page
    assert "nan" not in "".join(outline(page).texts).lower().split()


def test_warnings_speak_up_and_keep_quiet(job: Job) -> None:
    quiet = {**job.evaluation.metrics["methods"]["svd-ridge"], "status": "ok", "remarks": [], "negative_share": 0.0}
    metrics = {"methods": {"svd-ridge": quiet}, "dark_test_lightings": 0, "lightings": {"test": 5}}
    metrics["floors"] = {"noise_relative_rmse": 0.01, "projection_relative_rmse": 0.04}
    check = {"count": 96, "mean": 0.1, "std": 1.05, "relative_bias": 0.002}
    evaluation = Evaluation(metrics, job.evaluation.truth, job.evaluation.values, {}, spot_check=check)
    assert warnings(evaluation, "svd-ridge", [Effect("spot lights", False, "no lighting has one")]) == []
    metrics["floors"]["noise_relative_rmse"] = 0.02
    check["relative_bias"] = -0.03
    quiet["status"] = "ill_conditioned"
    metrics["dark_test_lightings"] = 2
    quiet["negative_share"] = 0.02
    metrics["layers"] = {"gloss-4": {}, "probes": {"unlit": 1}}
    titles = [
        title for title, _ in warnings(evaluation, "svd-ridge", [Effect("diffuse bounces", True, "forced", None, True)], ["x"])
    ]
    assert titles == [
        "svd-ridge: ill_conditioned", "Noisy references", "Spot check", "Dark test lightings", "Probes without light",
        "Negative light",
        "Effect cut short: diffuse bounces", "Scene repaired on loading",
    ]  # fmt: skip


def checked_page(job: Job, lit: int) -> tuple[Mapping[str, Any], str]:
    """A spot check of 48 values, of which so many have a variance, all off by 100 standard errors; and its page's text."""
    truth = np.ones((1, 16, 3)) if lit else np.zeros((1, 16, 3))
    baked, variance = truth + lit / 48, np.where(np.arange(48) < lit, (lit / 4800) ** 2, 0.0).reshape(truth.shape)
    check = z_scores(baked, truth, variance)
    arrays = {"texels": 16, "lightings": 1, "baked": baked, "truth": truth, "variance": variance}
    old = job.evaluation
    evaluation = Evaluation(old.metrics, old.truth, old.values, old.predicted, spot_check={**check, **arrays})
    return check, " ".join(
        "".join(outline(job.write(scene=None, models={"mean": job.models["mean"]}, evaluation=evaluation)).texts).split()
    )


def test_a_spot_check_without_values_tells_nothing(job: Job) -> None:
    check, text = checked_page(job, 0)
    assert check == {"count": 0, "mean": None, "std": None, "relative_bias": None}
    assert "too little light, or there are too few texels, to tell" in text
    assert "(0 values that are steady enough for a z-score)" in text
    assert "the total light differs" not in text
    assert "the spot check agrees" not in text


@pytest.mark.parametrize("values", [29, 30])
def test_a_spot_check_of_few_values_warns_of_nothing(job: Job, values: int) -> None:
    check, text = checked_page(job, values)
    assert check["count"] == values
    assert check["mean"] == pytest.approx(100)
    assert ("by more than noise" in text) == (values == 30)
    assert ("too few texels, to tell" in text) == (values == 29)
    assert "the z-scores have mean" in text


@pytest.mark.parametrize("integrator", ["operator", "paths", "reference"])
def test_advice_after_the_spot_check_suits_the_integrator(job: Job, integrator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(job.data.description["transport"], "integrator", integrator)
    text = checked_page(job, 48)[1]
    assert ("by more than noise. Raise transport.sender_resolution." in text) == (integrator == "operator")
    assert ("by more than noise. Both are unbiased, so raise report.spot_check_samples" in text) == (integrator != "operator")


def test_sentences_about_layers_stand_apart(job: Job) -> None:
    place = np.zeros((1, 3))
    layer = Layer("gloss-4", "radiance", 4, place, np.ones(1), np.zeros(1, np.int64))
    model = job.models["mean"]
    model = replace(model, layers={name: LayerModel(layer, model) for name in ("gloss-4", "gloss-8")})
    score = {"places": 1, "relative_rmse": 0.1, "noise_relative_rmse": 0.02}
    metrics = {**job.evaluation.metrics, "layers": {"gloss-4": score, "gloss-8": score}}
    evaluation = Evaluation(metrics, job.evaluation.truth, job.evaluation.values, job.evaluation.predicted)
    page = job.write(scene=None, models={"mean": model}, evaluation=evaluation)
    text = "".join(outline(page).texts)
    assert len(re.findall(r"uncertain by [\d.]+\s%\.\s+Layer gloss-[48] ", text)) == 2


def test_methods_are_sorted_by_error_and_complete(job: Job) -> None:
    scores = job.evaluation.metrics["methods"]
    rows = method_table({**scores, "unscored": {**scores["mean"], "relative_rmse": None}})
    assert [name for name, _ in rows][-1] == "unscored"
    errors = [scores[name]["relative_rmse"] for name, _ in rows[:-1]]
    assert errors == sorted(errors)
    assert all(len(cells) == len(scores["svd-ridge"]) - 2 for _, cells in rows), "all but remarks and trouble"


def test_numbers_for_people() -> None:
    shown = [percent(0.0481), percent(0.2), percent(2.0), percent(None), seconds(6.3e-4), seconds(0), seconds(12.3)]
    assert [text.replace("\u00a0", " ") for text in shown] == ["4.81 %", "20.0 %", "200 %", "–", "630 µs", "0 s", "12.3 s"]
    assert [size(512), size(2**20), count(2.5e6), _short(1.16e16), _short(0.25), _short("x")] == [
        "512 B", "1.0 MiB", "2.5 M", "1.16·10¹⁶", "0.25", "x",
    ]  # fmt: skip


def test_page_needs_a_model_and_a_folder_to_write_to(job: Job, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="got no model"):
        job.write(models={})
    (tmp_path / "file").write_text("")
    job_elsewhere = object.__new__(Job)
    job_elsewhere.__dict__.update(job.__dict__, folder=tmp_path / "file")
    with pytest.raises(UserError, match="cannot be"):
        job_elsewhere.write(scene=None, models={"mean": job.models["mean"]})


def test_every_learned_method_has_its_curves_over_steps_and_seconds(job: Job) -> None:
    """Positive losses on a log axis; others, which are logarithms themselves, on a plain one. Who learned nothing has none."""
    losses = {"svd-ridge": ((10, 0.5, 0.6), (20, 0.25, 0.3), (40, 0.125, 0.4)), "mean": ((10, 1.0, -2.0), (20, -1.0, -3.0))}
    models = {
        name: replace(model, relighter=replace(model.relighter, report=replace(model.relighter.report, loss=losses[name])))
        for name, model in job.models.items()
    }
    page = job.write(models=models, seconds={"svd-ridge": [3.0, 3.5, 4.75]})
    assert re.findall(r'aria-label="(Training of [^"]*)"', page) == ["Training of svd-ridge", "Training of mean"]
    with_clock, without = (page.split(f'aria-label="Training of {name}"')[1].split("</figure>")[0] for name in losses)
    labels = re.findall(r"<text[^>]*>([^<]*)</text>", with_clock)
    # At steps 0, 10, 20, 30 and 40, between looks in proportion.
    assert [label for label in labels if label in ("0", "3", "3.5", "4.12", "4.75", "seconds")][-6:] == [
        "0", "3", "3.5", "4.12", "4.75", "seconds",
    ]  # fmt: skip
    assert "seconds" not in without
    assert "10" in with_clock
    assert {label.replace("\u2212", "-") for label in re.findall(r"<text[^>]*>([^<]*)</text>", without)} >= {"-3.0", "1.0"}
    assert "Training of" not in job.write()
