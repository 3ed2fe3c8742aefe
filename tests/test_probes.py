"""Probes: closed forms, the reference integrator, solids, and what they cost where nobody asks for them: nothing."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_job import call

import ddprt
from ddprt import seeds
from ddprt.config import Config, checked
from ddprt.dataset.grids import ProbeGrid, nearest_valid
from ddprt.dataset.layers import Layer, read_layer, read_light
from ddprt.dataset.manifest import Manifest, layer_name
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.layers import export_layers
from ddprt.harmonics import clamped_cosine, harmonics
from ddprt.lights import parse_lighting
from ddprt.progress import Progress
from ddprt.report.layers import layer_scores
from ddprt.runtime.model import Model
from ddprt.scene.atlas import Atlas
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.transport import probes
from ddprt.transport.direct import Texels
from ddprt.transport.effects import plan
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.operator import Operator

DOCS = Path(__file__).parent.parent / "docs" / "effects.md"
EPS = float(np.finfo(np.float32).eps)
RAYS = 4096
GRID = (4, 4, 4)
LAMP = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})


def noise_of_rays(radiosity: float, rays: int) -> np.ndarray:
    """Standard deviation of each harmonic under independent rays, at most; a scrambled net has at most e times the variance.

    A ray adds A_l 4 pi Y b / pi, and Y has a mean square of 1 / 4 pi.
    """
    return np.sqrt(np.e) * np.abs(clamped_cosine(probes.ORDER)) * 4 * radiosity / np.sqrt(4 * np.pi * rays)


def gathered(operator: Operator, radiosity: np.ndarray, position: Any, rays: int = RAYS, **options: Any) -> np.ndarray:
    options = {"seed": 0, "stream": "test", **options}
    parts = probes.gather(operator, radiosity, np.array(position, float), rays, **options)
    return np.concatenate(list(parts), 1).astype(float)


def test_a_furnace_sends_the_same_from_all_sides(furnace: Scene, furnace_atlas: Atlas) -> None:
    """Walls of albedo 1/2 that receive 1 W/m² of direct light send 1 W/m² after all bounces, wherever the probe stands."""
    operator = Operator.of(Tracer.of(furnace), furnace_atlas)
    bounced = operator.bounce(np.ones((operator.senders.count, 3), np.float32), seed=0, stream="test")
    found = gathered(operator, bounced.radiosity, [[0, 0, 0], [0.4, -0.3, 0.5]])[0]
    lost = 1 - float(np.mean(bounced.radiosity))  # bounces' rays that land on no cell, and what the series left out
    assert 0 <= lost < 2e-3
    first = np.sqrt(4 * np.pi)
    np.testing.assert_allclose(found[:, 0], first, rtol=3e-3)  # as much again of the probes' own rays
    assert (np.abs(found[:, 1:]) < 5 * noise_of_rays(1.0, RAYS)[1:, None]).all()
    normals = np.array([[1.0, 0, 0], [0, 0.6, -0.8]])
    E = np.einsum("pkc,nk->pnc", found, harmonics(normals, probes.ORDER))
    np.testing.assert_allclose(E, 1, rtol=3e-2)


def test_a_lit_square_seen_from_above() -> None:
    """The top of a lonely white box, lit straight down; its lightmap is dark, for nothing faces it, but probes see it."""
    scene, height, albedo = build("convex"), 0.3, 0.8
    low, high = scene.bounds
    at = np.array([(low[0] + high[0]) / 2, high[1] + height, (low[2] + high[2]) / 2])
    sun = parse_lighting({"type": "directional", "direction": [0, -1, 0], "irradiance": [2, 1, 0]})
    config = checked(
        {
            "atlas": {"resolution": 24},
            "points": {"count": 4, "supersample": 1},
            "probes": {"rays": RAYS, "file": "given"},
        }
    )
    shown = Progress(quiet=True)
    data = baked(scene, config, [sun] * 10, [at.tolist()], progress=shown)
    traced = [stage["rays"] for stage in shown.stages if str(stage["name"]).startswith("probes")]
    tracer = Tracer.of(scene)
    atlas, _ = build_open_atlas(tracer, scene, 24, config.atlas.padding)
    opened = tracer.rays
    Texels.of(tracer, atlas, config.transport.direct_samples, seeds.stream(0, "texel positions", 1)).irradiance(
        sun, seeds.stream(0, "direct", 0)
    )
    shadow = len(data.split("test")) * (tracer.rays - opened)
    # None between surfaces that do not face each other; the second half of held-out maps has direct light of its own.
    assert traced == [RAYS, 2 * RAYS + shadow]
    assert not data.maps("indirect", [0]).any()
    layer = read_layer(data, "probes")
    found = read_light(data, layer, [0])[0, 0]
    # The square from below, in small pieces: L Y dω with dω = height dA / r³.
    side, n = high[0] - low[0], 400
    x = (np.arange(n) + 0.5) / n * side - side / 2
    toward = np.stack(np.broadcast_arrays(x[:, None], -height, x[None]), -1)
    r = np.linalg.norm(toward, axis=-1, keepdims=True)
    solid = height * (side / n) ** 2 / r**3
    L = albedo / np.pi
    exact = clamped_cosine(2) * (L * harmonics(toward / r, 2) * solid).sum((0, 1))
    assert (np.abs(found[:, 0] - 2 * exact) < 4 * noise_of_rays(2 * albedo, RAYS)).all()
    np.testing.assert_allclose(found[:, 1], found[:, 0] / 2, rtol=1e-5, atol=1e-6)
    assert not found[:, 2].any()
    assert found[0, 0] > 10 * noise_of_rays(2 * albedo, RAYS)[0]


def job(**changes: Any) -> Config:
    document: dict[str, Any] = {
        "atlas": {"resolution": 48},
        "lightings": {"train": 10, "validation": 2, "test": 2, "region_low": [0.1, 0.5, 0.1], "region_high": [0.9, 0.8, 0.9]},
        "points": {"count": 16, "supersample": 2},
        "transport": {"samples": 16, "test_samples": 32, "threads": 2},
        "probes": {"grid": GRID, "rays": 512},
    }
    for key, value in changes.items():
        document[key] = {**document.get(key, {}), **value}
    return checked(document)


def baked(scene: Scene, config: Config, lightings: Any, position: Any, **options: Any) -> Dataset:
    """A bake with listed probes."""
    import tempfile

    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        file.write(json.dumps(position))
        file.flush()
        config = config.model_copy(update={"probes": config.probes.model_copy(update={"file": file.name})})
        return ddprt.bake(scene, lightings, config=config, **options)


@pytest.fixture(scope="module")
def progress() -> Progress:
    return Progress(quiet=True)


@pytest.fixture(scope="module")
def data(cornell: Scene, progress: Progress, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    with pytest.warns(UserWarning, match="inside solids"):
        return ddprt.bake(cornell, config=job(), out=tmp_path_factory.mktemp("probes") / "d", progress=progress)


@pytest.fixture(scope="module")
def plain(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The same without probes, where their file raises on import."""
    found = sys.modules.pop("ddprt.transport.probes")
    sys.modules["ddprt.transport.probes"] = None  # type: ignore[assignment]
    try:
        config = job(probes={"grid": [0, 0, 0]})
        return ddprt.bake(cornell, config=config, out=tmp_path_factory.mktemp("plain") / "d")
    finally:
        sys.modules["ddprt.transport.probes"] = found


def sums(data: Dataset) -> dict[str, str]:
    return {name: entry["sha256"] for name, entry in Manifest(data.folder).entries.items()}


def test_without_probes_nothing_is_imported_and_all_bits_are_the_same(
    data: Dataset, plain: Dataset, cornell: Scene, tmp_path: Path
) -> None:
    ours, without = sums(data), sums(plain)
    assert {name for name in ours if name not in without} == {name for name in ours if name.startswith("probes/")}
    assert {name: ours[name] for name in without} == without
    assert "layers" not in plain.description
    off = Progress(quiet=True)
    refused = ddprt.force(cornell, off=["probes"])
    third = ddprt.bake(refused, config=job(), out=tmp_path / "off", progress=off)
    assert sums(third) == without
    assert not any(str(stage["name"]).startswith("probes") for stage in off.stages)
    (line,) = (effect for effect in third.description["plan"] if effect["name"] == "probes")
    assert line["forced"]
    assert not line["called"]
    assert line["bound"] == 0
    assert "4 x 4 x 4" in line["why"]
    for one in (third, plain):
        del one.description["plan"]
        del one.description["ddprt"]
    assert third.description == plain.description


def traced(scene: Scene, place: np.ndarray, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the reference and their variance: irradiance for 45 normals, which integrate order 8 exactly."""
    z, step = np.polynomial.legendre.leggauss(5)
    turn = 2 * np.pi * np.arange(9) / 9
    flat = np.sqrt(1 - z**2)[:, None]
    normals = np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), z[:, None]), -1).reshape(-1, 3)
    where, facing = np.repeat(place, len(normals), 0), np.tile(normals, (len(place), 1))
    _, light, _, variance = ddprt.irradiance(scene, LAMP, where, facing, samples=samples, return_variance=True)
    Y = (np.repeat(step, 9) * 2 * np.pi / 9)[:, None] * harmonics(normals, 2)
    shape = len(place), len(normals), 3
    return np.einsum("pnc,nk->pkc", light.reshape(shape), Y), np.einsum("pnc,nk->pkc", variance.reshape(shape), Y**2)


def test_near_senders_are_looked_at_more_closely(cornell: Scene, cornell_atlas: Atlas) -> None:
    """5 mm above a floor of senders of 31 mm: most of the error that their size makes goes."""
    operator = Operator.of(Tracer.of(cornell), cornell_atlas)
    texels = Texels.of(operator.tracer, cornell_atlas, 64, np.random.default_rng(0))
    direct = operator.averaged(texels.irradiance(LAMP, np.random.default_rng(1)))
    radiosity = operator.bounce(direct, seed=0, stream="near").radiosity
    place = np.stack(np.broadcast_arrays(np.linspace(0.05, 0.5, 12), 0.005, 0.04), 1)
    truth, variance = traced(cornell, place, 1024)
    squares = [
        ((gathered(operator, radiosity, place, near=near)[0] - truth) ** 2).mean() - variance.mean()
        for near in (operator.near([LAMP], direct), None)
    ]
    print("near", squares, variance.mean())
    assert squares[0] < squares[1] / 2


def test_light_is_that_of_the_reference(cornell: Scene) -> None:
    """Coefficients of both, where each is uncertain; the standard errors below are those of 108 values."""
    rng = np.random.default_rng(3)
    low, high = cornell.bounds
    place = low + (high - low) * rng.uniform(0.08, 0.92, (40, 3))
    place = place[Tracer.of(cornell).clearance(place) > 0.03][:12]
    config = job(atlas={"resolution": 128}, transport={"test_samples": 64, "direct_samples": 64}, probes={"grid": [0] * 3})
    config = config.model_copy(update={"probes": config.probes.model_copy(update={"rays": 4096})})
    data = baked(cornell, config, {"train": [LAMP], "validation": [LAMP], "test": [LAMP]}, place.tolist())
    layer = read_layer(data, "probes")
    ours, noise = (read_light(data, layer, [2], kind)[0].astype(float) for kind in ("light", "noise"))
    truth, spread = traced(cornell, place, 1024)
    own = (noise**2).mean(0)  # of each harmonic, pooled over probes
    z = ((ours - truth) / np.sqrt(spread + own))[..., 1]
    print(
        f"z {z.mean():+.3f} +- {z.std():.3f}; mean {z[:, 0].mean():+.3f}, bias {ours[:, 0].sum() / truth[:, 0].sum() - 1:+.4f}"
    )
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.std() - 1) < 4 / np.sqrt(2 * z.size)


def test_probes_in_blocks_and_behind_walls_are_found(cornell: Scene, data: Dataset) -> None:
    """Points of the published geometry: in the short and in the tall block, beneath the floor, behind a wall; and free ones."""
    shut = [[0.186, 0.08, 0.169], [0.368, 0.2, 0.351], [0.186, 0.002, 0.169], [0.28, -0.1, 0.28], [0.28, 0.28, 0.7]]
    free = [[0.28, 0.45, 0.28], [0.186, 0.17, 0.169], [0.03, 0.03, 0.03], [0.5, 0.1, 0.5]]
    found = probes.in_the_open(Tracer.of(cornell), np.array(shut + free))
    assert found.tolist() == [False] * len(shut) + [True] * len(free)
    layer, area = read_layer(data, "probes"), data.area.sum()
    closed = layer.weight == 0
    assert 0 < closed.sum() < len(closed) / 2
    assert len(set(layer.weight[~closed])) == 1
    np.testing.assert_allclose(layer.weight.sum(), area, rtol=1e-6)  # the atlas keeps float32
    light = read_light(data, layer, range(len(data.lightings)))
    assert not light[:, closed].any()
    assert light[:, ~closed, 0].all()


@pytest.fixture(scope="module")
def models(data: Dataset) -> dict[str, Model]:
    other: dict[str, Any] = {"channels": "multi", "centre": "mean", "space": "gamma"}
    return {"plain": ddprt.fit(data, bases=4), "other": ddprt.fit(data, bases=4, **other)}


def test_a_fit_passes_over_what_counts_nothing(data: Dataset, models: dict[str, Model]) -> None:
    layer, test = read_layer(data, "probes"), data.split("test")
    for model in models.values():
        part = model.layers["probes"]
        light = part.predict(data.values(test, 16, "radiosity"))
        assert np.isfinite(light).all()
        assert not light[:, layer.weight == 0].any()
        assert light[:, layer.weight > 0].any((0, 2, 3)).all()


def test_bakes_go_on_with_the_same_bits(data: Dataset, cornell: Scene, tmp_path: Path) -> None:
    """Light that is there is not written again, and what is missing comes back as it was; a finished bake traces no ray."""
    folder = tmp_path / "d"
    shutil.copytree(data.folder, folder)
    lost = [layer_name("probes", 3), layer_name("probes", 12, "noise")]
    for name in lost:
        (folder / name).unlink()
    written = {name: (folder / name).stat().st_mtime_ns for name in sums(data) if name not in lost}
    with pytest.warns(UserWarning, match="inside solids"):
        again = ddprt.bake(cornell, config=job(), out=folder)
    assert sums(again) == sums(data)
    assert Manifest(folder).damaged() == []
    both = layer_name("probes", 12)  # written beside its noise, with the same bits
    assert {name for name, time in written.items() if (folder / name).stat().st_mtime_ns != time} == {both}
    last = Progress(quiet=True)
    ddprt.bake(cornell, config=job(), out=folder, progress=last)
    assert not any(stage.get("rays") for stage in last.stages)


@pytest.mark.parametrize(
    "change", [{"rays": 1024}, {"grid": (4, 4, 3)}, {"region_high": (1, 1, 0.9)}, {"grid": (0, 0, 0)}], ids=str
)
def test_other_probes_are_another_dataset(data: Dataset, cornell: Scene, change: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="holds another dataset"):
        ddprt.bake(cornell, config=job(probes=change), out=data.folder)


def test_rays_follow_the_noise_that_is_aimed_at(cornell: Scene) -> None:
    """What is measured between the halves of held-out light is what was expected, and near the target."""
    shown = Progress(quiet=True)
    config = job(probes={"rays": "auto"}, transport={"target_noise": 0.03})
    with pytest.warns(UserWarning, match="inside solids"):
        data = ddprt.bake(cornell, config=config, progress=shown)
    (stage,) = (stage for stage in shown.stages if stage["name"] == "probes test")
    layer, test = read_layer(data, "probes"), data.split("test")
    light, noise = (read_light(data, layer, test, kind)[:, layer.weight > 0].astype(float) for kind in ("light", "noise"))
    found = np.sqrt((noise**2).sum(2).mean()) / light[:, :, 0].mean()  # both in units of sqrt(4 pi)
    assert stage["noise_expected"] <= 0.03
    assert found == pytest.approx(stage["noise_expected"], rel=0.5)  # of 2 lightings, told by 61 probes
    gathered_rays = stage["samples"] * stage["in_the_open"]
    assert stage["rays"] >= gathered_rays + 2 * (64 + 256) * stage["in_the_open"]  # both pilots


def test_scores_are_of_irradiance_over_the_sphere(data: Dataset, models: dict[str, Model]) -> None:
    model, test = models["plain"], data.split("test")
    part, values = model.layers["probes"], data.values(data.split("test"), 16, "radiosity")
    found = layer_scores(data, model)["probes"]
    z, step = np.polynomial.legendre.leggauss(4)
    turn = 2 * np.pi * np.arange(6) / 6
    flat = np.sqrt(1 - z**2)[:, None]
    normals = np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), z[:, None]), -1).reshape(-1, 3)
    Y, share = harmonics(normals, 2), np.repeat(step / 12, 6)
    truth, ours = (
        np.einsum("lpkc,nk->lpnc", light.astype(float), Y)[:, part.layer.weight > 0]
        for light in (read_light(data, part.layer, test), part.predict(values))
    )
    error = np.sqrt(np.einsum("lpnc,n->lpc", (ours - truth) ** 2, share).mean())
    exact = error / np.einsum("lpnc,n->lpc", truth, share).mean()
    assert found["relative_rmse"] == pytest.approx(exact, rel=1e-5)
    assert [row["bases"] for row in found["curve"]] == [1, 2, 4]
    assert found["curve"][-1]["relative_rmse"] == pytest.approx(found["relative_rmse"], rel=1e-6)
    assert found["projection_relative_rmse"] <= found["relative_rmse"]


def grid(weight: np.ndarray | None = None) -> Layer:
    axes = [0.0, 1.0, 3.5], [2.0, 4.0], [1.0]
    place = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return Layer("probes", "irradiance", 2, place, np.ones(6) if weight is None else weight, np.full(6, -1))


def test_light_between_probes_is_trilinear() -> None:
    layer = grid()
    slope = np.random.default_rng(0).normal(size=(3, 9, 3))
    light = np.einsum("pd,dkc->pkc", layer.position, slope).astype(np.float32)
    at = np.array([[0.25, 2.5, 1.0], [2.0, 4.0, 1.0], [3.0, 2.0, 1.0]])
    bound = 16 * EPS * np.abs(light).max()
    np.testing.assert_allclose(ProbeGrid.of(layer).at(light, at), np.einsum("pd,dkc->pkc", at, slope), atol=bound)
    frames = ProbeGrid.of(layer).at(np.stack([light, 2 * light]), at)
    np.testing.assert_allclose(frames[1], 2 * frames[0], atol=2 * bound)
    beyond = np.array([[-1.0, 9.0, 5.0]])
    np.testing.assert_array_equal(ProbeGrid.of(layer).at(light, beyond)[0], light[1])


def test_probes_in_solids_take_the_light_of_the_nearest_free_one() -> None:
    layer = grid(np.array([1.0, 0, 1, 1, 0, 1]))
    assert nearest_valid(layer).tolist() == [0, 3, 2, 3, 5, 5]
    light = np.arange(6, dtype=np.float32)[:, None, None] * np.ones((1, 9, 3), np.float32)
    np.testing.assert_allclose(ProbeGrid.of(layer).at(light, [[0.0, 3.0, 1.0]]), 1.5)


@pytest.mark.parametrize(
    ("position", "fault"),
    [
        ([[0.0, 3.0, 1.0], [0.0, float("nan"), 1.0]], r"position\[1\]: got \[0.0, nan, 1.0\]"),
        ([0.0, 3.0, 1.0], r"position: got shape \(3,\), expected \(n, 3\)"),
        ([[0.0, 3.0]], r"position: got shape \(1, 2\), expected \(n, 3\)"),
        ([[0.0, 3.0, 1.0, 9.0]], r"position: got shape \(1, 4\), expected \(n, 3\)"),
        ([[0.0], [3.0, 1.0]], "position: got no array of numbers"),
    ],
)
def test_light_is_looked_up_at_positions_alone(position: list[Any], fault: str) -> None:
    with pytest.raises(UserError, match=fault):
        ProbeGrid.of(grid()).at(np.ones((6, 9, 3), np.float32), position)


@pytest.mark.parametrize("places", [5, 7])
def test_light_is_looked_up_in_that_of_all_places(places: int) -> None:
    with pytest.raises(UserError, match=rf"light: got shape \(2, {places}, 9, 3\), expected \(..., 6, coefficients, 3\)"):
        ProbeGrid.of(grid()).at(np.ones((2, places, 9, 3), np.float32), [[0.0, 3.0, 1.0]])


def test_a_list_of_probes_is_no_grid() -> None:
    layer = grid()
    with pytest.raises(UserError, match="no grid"):
        ProbeGrid.of(replace(layer, position=layer.position[::-1].copy()))


@pytest.mark.parametrize("which", ["plain", "other"])
def test_the_documented_decoder_reproduces_probes(which: str, models: dict[str, Model], data: Dataset, tmp_path: Path) -> None:
    """Irradiance from the exported files alone, by the block that docs/effects.md prints, and the golden numbers."""
    model = models[which]
    files = export_layers(model, tmp_path)
    assert [file.name for file in files] == ["probes.safetensors", "probes.json"]
    block = re.search(r"```python\n((?:(?!```).)*?def probes.*?)```", DOCS.read_text(), re.DOTALL)
    assert block
    scope: dict[str, Any] = {}
    exec(block[1], scope)
    part = model.layers["probes"]
    values = data.values(data.split("test"), 16, "radiosity")[0]
    for normal in np.vstack([np.eye(3), -np.eye(3)]):
        expected = part.layer.towards(part.predict(values)[nearest_valid(part.layer)], normal)
        # u, the sum over bases and that over harmonics are float32 on one side and float64 on the other.
        bound = 100 * EPS * np.abs(part.predict(values)).max()
        np.testing.assert_allclose(scope["probes"](tmp_path, values, normal), expected, atol=bound)
    told = json.loads(files[1].read_text())
    golden = told["golden"]
    ones = np.full((16, 3), golden["x"])
    size = np.abs(part.predict(ones)).max()
    np.testing.assert_allclose(scope["probes"](tmp_path, ones, golden["normal"]), golden["irradiance"], atol=100 * EPS * size)
    assert told["grid"] == list(GRID)
    assert told["in_solids"] == np.flatnonzero(part.layer.weight == 0).tolist()
    assert export_layers(replace(model, layers={}), tmp_path) == []
    assert not list(tmp_path.iterdir())


def test_a_black_scene_traces_no_ray_for_probes() -> None:
    scene = build("furnace", albedo=0.0, subdivisions=1)
    shown = Progress(quiet=True)
    config = checked({"atlas": {"resolution": 16}, "points": {"count": 4, "supersample": 1}, "probes": {"grid": [1, 1, 1]}})
    lamp = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]})
    data = ddprt.bake(scene, [lamp] * 10, config=config, progress=shown)
    assert [stage["rays"] for stage in shown.stages if str(stage["name"]).startswith("probes")] == [0, 0]
    assert not read_light(data, read_layer(data, "probes"), range(10)).any()


def test_no_probe_in_free_air_is_refused(cornell: Scene) -> None:
    with pytest.raises(UserError, match="none of them in free air"):
        baked(cornell, job(probes={"grid": [0] * 3}), None, [[0.186, 0.08, 0.169]])


def test_probes_are_planned(cornell: Scene) -> None:
    called = {effect.name: effect for effect in plan(cornell, [LAMP], probes="2 x 2 x 2").effects}["probes"]
    assert called.called
    assert "2 x 2 x 2" in called.why
    left = {effect.name: effect for effect in plan(cornell, [LAMP]).effects}["probes"]
    assert not left.called
    with pytest.raises(UserError, match="forced on"):
        ddprt.bake(ddprt.force(cornell, on=["probes"]), config=job(probes={"grid": [0] * 3}))


@pytest.mark.parametrize(
    ("section", "fault"),
    [
        ({"grid": [2, 0, 2]}, "at least 1 along each axis"),
        ({"grid": [2, 2, 2], "file": "a.json"}, "one of the two"),
        ({"grid": [2, 2, 2], "region_low": [0.5, 0, 0], "region_high": [0.5, 1, 1]}, "region_low"),
        ({"rays": 0}, "rays"),
    ],
    ids=str,
)
def test_bad_settings(section: dict[str, Any], fault: str) -> None:
    with pytest.raises(UserError, match=fault):
        checked({"probes": section})


@pytest.mark.parametrize(
    "text",
    ["[]", "[[1, 2]]", '{"a": 1}', "[[1, 2, 1e99]]", "no", "[[1, 2, NaN]]", "[[0.2, true, 0.3]]", '[["0.2", "0.3", "0.3"]]'],
)
def test_bad_files(text: str, tmp_path: Path) -> None:
    path = tmp_path / "probes.json"
    path.write_text(text)
    with pytest.raises(UserError, match=r"probes\.file"):
        probes.places(checked({"probes": {"file": str(path)}}).probes, np.array([[0.0] * 3, [1.0] * 3]))
    with pytest.raises(UserError, match=r"probes\.file"):
        probes.places(checked({"probes": {"file": str(tmp_path / "none.json")}}).probes, np.array([[0.0] * 3, [1.0] * 3]))


def test_a_bad_file_is_told_before_anything_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "probes.json").write_text("[[1, 2]]")
    smoke = Path(__file__).parent.parent / "configs" / "smoke.toml"
    assert call("bake", smoke, "--probes.file", tmp_path / "probes.json", "--out", tmp_path / "run") == 2
    (line,) = capsys.readouterr().err.splitlines()  # no stage before it
    assert line.startswith("ddprt: probes.file")


@pytest.mark.parametrize("source", ["grid", "file"])
def test_more_probes_than_the_limit_are_refused_before_they_are_placed(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A billion would take 24 GB; no array is made of what is past the limit, which itself is held."""
    path = tmp_path / "probes.json"
    path.write_text(json.dumps([[0, 0, 0]] * 9))
    assert probes.MOST == 2**20
    if source == "grid":
        key, value, words = (
            "grid",
            [1000] * 3,
            "probes.grid: got 1000000000 probes, expected at most 1048576; lower it",
        )
    else:
        key, value, words = "file", str(path), "9 probes, expected at most 8; list fewer"
        monkeypatch.setattr(probes, "MOST", 8)
    with monkeypatch.context() as patch:
        patch.setattr(probes, "np", SimpleNamespace(float64=np.float64))  # without what makes arrays
        with pytest.raises(UserError, match=words):
            placed({key: value})
    smoke = Path(__file__).parent.parent / "configs" / "smoke.toml"
    for also in ([], ["--dry-run"]):
        assert call("bake", smoke, f"--probes.{key}", value, "--out", tmp_path / "run", *also) == 2
        told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ddprt: ")]
        assert len(told) == 1
        assert told[0].endswith(words)
    monkeypatch.setattr(probes, "MOST", 8)
    path.write_text(json.dumps([[0, 0, 0]] * 8))
    assert len(placed({"file": str(path)} if source == "file" else {"grid": [2, 2, 2]})) == 8


def placed(section: dict[str, Any]) -> np.ndarray:
    return probes.places(checked({"probes": section}).probes, np.array([[0.0] * 3, [1.0] * 3]))


def test_grids_stand_in_the_middle_of_their_cells() -> None:
    config = checked({"probes": {"grid": [2, 1, 3], "region_low": [0.5, 0, 0], "region_high": [1, 0.5, 1]}}).probes
    place = probes.places(config, np.array([[0.0, 10, 0], [4, 12, 6]]))
    np.testing.assert_allclose(place, [[x, 10.5, z] for x in (2.5, 3.5) for z in (1, 3, 5)])
