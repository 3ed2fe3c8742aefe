"""Surfaces that glow: closed forms, what calls for them, the map in dataset, model and export, and Mitsuba's opinion."""

import hashlib
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import polygon_irradiance
from test_export import documented_decoder

import ddprt
from ddprt.config import Config, load_config
from ddprt.dataset.store import Dataset
from ddprt.export.textures import export_textures
from ddprt.files import read_tensors
from ddprt.lights import parse_lighting
from ddprt.report.evaluate import evaluate
from ddprt.scene.atlas import build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.material import Cutout, Emission, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, rectangle
from ddprt.sections import TransportConfig
from ddprt.transport.effects import force, plan
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.emission import Constant, Emitters, constant_light

LAMP = {"type": "point", "position": [0.0, 2.0, 1.5], "intensity": [1.0, 1.0, 1.0]}
SIGMAS = 4.0
EPS32 = float(np.finfo(np.float32).eps)
COLOUR = np.array([2.0, 1.0, 0.5])


def glowing(scene: Scene, name: str, emission: Emission) -> Scene:
    return scene.made_of(lambda material: replace(material, emission=emission) if material.name == name else material)


def lit(scene: Scene, resolution: int = 48, bounces: int = -1, **settings: Any) -> tuple[Constant, Any]:
    tracer = Tracer.of(scene, 2)
    atlas = build_atlas(scene, resolution)
    return constant_light(scene, tracer, atlas, TransportConfig(**settings), seed=0, bounces=bounces), atlas


def mean_and_error(found: Constant, area: np.ndarray, texels: Any = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Mean irradiance over a surface, and its standard error: half differences of texels are independent."""
    share = (area[texels] / area[texels].sum())[:, None]
    light, noise = (getattr(found, part)[texels].astype(float) for part in ("irradiance", "noise"))
    return (share * light).sum(0), np.sqrt(((share * noise) ** 2).sum(0))


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bounces", "series"), [(0, 1.0), (1, 1.6), (-1, 2.5)])
def test_a_glowing_furnace_is_as_bright_everywhere(bounces: int, series: float) -> None:
    scene = glowing(build("furnace", albedo=0.6, subdivisions=2), "wall", Emission(tuple(COLOUR)))
    found, atlas = lit(scene, bounces=bounces)
    expected = series * np.pi * COLOUR
    mean, error = mean_and_error(found, atlas.area)
    # Bounced noise is shared by texels that see the same senders: its mean errs by what the senders' mean does, once more
    # for each bounce; and the series ends at 1e-4.
    assert (np.abs(mean - expected) < (SIGMAS * error * series + (1e-4 if bounces else 0) * expected)).all()
    off = found.irradiance / expected - 1
    assert np.sqrt(np.average((off**2).mean(1), weights=atlas.area)) < 1.2 * found.relative + 1e-4  # a few thousand texels
    assert 0 < found.relative < 1.2 * TransportConfig().target_noise


def test_a_glowing_plate_lights_another_by_its_form_factor() -> None:
    size, distance = 1.0, 1.0
    quads = [rectangle((-size / 2,) * 2, (size / 2,) * 2, at, 1, facing=facing) for at, facing in ((0.0, 1), (distance, -1))]
    materials = Material("lamp", (0.3,) * 3, emission=Emission(tuple(COLOUR))), Material("plate", (0.7,) * 3)
    scene = faceted("plates", np.array(quads), materials, np.array([0, 1]))
    found, atlas = lit(scene, bounces=0, target_noise=0.005)
    upper = np.flatnonzero(atlas.position[:, 1] > distance / 2)
    lower = np.flatnonzero(atlas.position[:, 1] < distance / 2)
    x = size / distance
    factor = 2 / (np.pi * x**2) * (
        np.log((1 + x**2) / np.sqrt(1 + 2 * x**2)) + 2 * x * np.sqrt(1 + x**2) * np.arctan(x / np.sqrt(1 + x**2))
        - 2 * x * np.arctan(x)
    )  # fmt: skip
    mean, error = mean_and_error(found, atlas.area, upper)
    assert (np.abs(mean - np.pi * COLOUR * factor) < SIGMAS * error).all()
    assert (error < 0.002 * mean).all()
    assert not found.irradiance[lower].any(), "direct light of a lamp falls on what it faces"
    bounced, _ = lit(scene, bounces=1, target_noise=0.005)
    mean, _ = mean_and_error(bounced, atlas.area, lower)
    assert (mean > 0.7 * 0.9 * factor**2 * np.pi * COLOUR).all(), "lamps receive what comes back"
    mean, _ = mean_and_error(lit(scene, bounces=2, target_noise=0.005)[0], atlas.area, upper)
    assert (mean > np.pi * COLOUR * (factor + 0.9 * 0.3 * 0.7 * factor**3)).all(), "and reflect it"


def sampled(emitters: Emitters, tracer: Tracer, point: np.ndarray, count: int) -> np.ndarray:
    """Samples of light on a floor at a point in world space."""
    place = np.tile((point - emitters.scene.centre).astype(np.float32), (count, 1))
    up = np.tile(np.array([0, 1, 0], np.float32), (count, 1))
    u = np.random.default_rng(0).random((count, 4), np.float32)
    return emitters.irradiance(tracer, lifted(tracer, place, up), up, u)


def corner_scene(height: float = 0.5) -> Scene:
    """A floor, and a glowing wall that stands on it."""
    floor = rectangle((-1.0, -1.0), (1.0, 1.0), 0.0, 1, facing=1)
    wall = rectangle((0.0, -0.5), (height, 0.5), 0.0, 0, facing=1)
    materials = Material("floor", (0.5,) * 3), Material("lamp", (0.1,) * 3, emission=Emission(tuple(COLOUR)))
    return faceted("corner", np.array([floor, wall]), materials, np.array([0, 1]))


@pytest.mark.parametrize("away", [1e-3, 0.03, 0.5])
def test_points_beside_a_glowing_wall_meet_lamberts_formula(away: float) -> None:
    """Where they touch, 1 / r² has no bound; a sample does."""
    scene, count = corner_scene(), 1 << 16
    tracer, emitters = Tracer.of(scene), Emitters.of(scene)
    point = np.array([away, 0.0, 0.1])
    wall = scene.corners[emitters.triangle].reshape(-1, 3)
    low, high = wall.min(0), wall.max(0)
    outline = np.array([[0, low[1], low[2]], [0, high[1], low[2]], [0, high[1], high[2]], [0, low[1], high[2]]])
    expected = polygon_irradiance(outline, 1.0, point, np.array([0.0, 1.0, 0.0])) * COLOUR
    values = sampled(emitters, tracer, point, count)
    error = values.std(0) / np.sqrt(count)
    # The ray's origin stands `offset` above the floor, which a thousandth of a metre away matters.
    assert (np.abs(values.mean(0) - expected) < SIGMAS * error + 2 * tracer.offset / away * expected).all()
    assert (error < 0.01 * expected).all()
    assert (values <= 2 * np.pi * COLOUR * (1 + 1e-5)).all(), "either side of a sample is worth pi times the radiance at most"


@pytest.mark.parametrize("holes", [False, True])
def test_textured_light_is_the_integral_over_its_texture(holes: bool) -> None:
    image = np.random.default_rng(5).random((3, 4, 3)).astype(np.float32)
    opacity = np.tile(np.array([0.0, 1.0], np.float32), (2, 1))
    lamp = Material("lamp", (0.1,) * 3, emission=Emission(tuple(COLOUR), image), cutout=Cutout(opacity, 0.5) if holes else None)
    positions = np.array(
        [[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1], [-0.5, 1, -0.5], [0.5, 1, -0.5], [0.5, 1, 0.5], [-0.5, 1, 0.5]]
    )
    uv = np.array([[0.0, 0.0]] * 4 + [[0, 0], [1, 0], [1, 1], [0, 1]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    scene = checked(
        "sign", positions, triangles, material=np.array([0, 0, 1, 1]), materials=(Material("floor", (0.5,) * 3), lamp), uv=uv
    )
    emitters = Emitters.of(scene)
    assert sum(emitters.density * scene.areas) == pytest.approx(1, abs=1e-12)
    n = 512
    a, b = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    from ddprt.scene.material import bilinear

    places = np.stack([a, b], -1).reshape(-1, 2)
    light = bilinear(image, places) * COLOUR
    if holes:
        light[bilinear(opacity, places) < 0.5] = 0
    point = np.array([0.3, 0.0, -0.2])
    away = np.column_stack([places[:, 0] - 0.5, np.ones(n * n), places[:, 1] - 0.5]) - point
    expected = (light * (1 / (away**2).sum(1) ** 2)[:, None]).mean(0)  # cosines are 1 / r each
    count = 1 << 16
    tracer = Tracer.of(scene)
    if holes:  # the tracer of this test knows no holes: only points are asked, each twice as likely to be looked up
        weights = np.zeros((count, 3))
        u = np.random.default_rng(0).random((count, 2))
        from ddprt.lights.mesh import sample_triangles

        index, inner = sample_triangles(emitters.cumulative, u)
        there = emitters.triangle[index]
        weights = emitters.radiance(there, inner) / emitters.density[there][:, None]
        corners = scene.corners[there]
        spot = corners[:, 0] + inner[:, :1] * (corners[:, 1] - corners[:, 0]) + inner[:, 1:] * (corners[:, 2] - corners[:, 0])
        values = weights / (((spot - point) ** 2).sum(1) ** 2)[:, None]
    else:
        values = sampled(emitters, tracer, point, count)
    error = values.std(0) / np.sqrt(count)
    # The midpoint rule errs by its step squared, and by a step along the rim of holes.
    assert (np.abs(values.mean(0) - expected) < SIGMAS * error + (1 / n if holes else 1 / n**2) * expected).all()
    assert (error < 0.02 * expected).all()


# --- what calls for it ------------------------------------------------------------------------------------------------


def decided(scene: Scene) -> Any:
    return next(effect for effect in plan(scene, [parse_lighting(LAMP)]).effects if effect.name == "emission")


def test_only_what_shines_calls_for_it() -> None:
    furnace = build("furnace", subdivisions=1)
    assert not decided(furnace).called
    assert not decided(glowing(furnace, "wall", Emission((0.0, 0.0, 0.0)))).called
    assert not decided(glowing(furnace, "wall", Emission((1.0, 1.0, 1.0), np.zeros((2, 2, 3), np.float32)))).called
    unused = replace(furnace, materials=(*furnace.materials, Material("lamp", (0.1,) * 3, emission=Emission((1.0,) * 3))))
    assert not decided(unused).called
    found = decided(glowing(furnace, "wall", Emission((0.0, 2.0, 0.0))))
    assert found.called
    assert found.why == f'material "wall", at most {2 * np.pi / 0.5:.3g} W/m² of irradiance'


def test_forced_off_says_how_much_is_left_out() -> None:
    scene = force(glowing(build("furnace", subdivisions=1), "wall", Emission((0.0, 2.0, 0.0))), off=["emission"])
    found = decided(scene)
    assert (found.called, found.forced) == (False, True)
    assert re.search('forced off, though it is called for: material "wall", at most 12.6 W/m²', found.why)


def test_the_bound_bounds() -> None:
    scene = glowing(build("furnace", albedo=0.6, subdivisions=1), "wall", Emission((0.0, 2.0, 0.0)))
    found, _ = lit(scene, resolution=32)
    most = float(re.search(r"at most (\S+) W", decided(scene).why)[1])  # type: ignore[index]
    assert found.irradiance.mean() < most / 3 * 1.01
    assert found.irradiance[:, 1].mean() > 0.98 * most


def test_forced_on_gives_darkness_where_nothing_glows() -> None:
    found, _ = lit(build("furnace", subdivisions=1), resolution=32)
    assert not found.irradiance.any()


# --- dataset, model and export ----------------------------------------------------------------------------------------

SMALL = {
    "scene.name": '"neon"',
    "atlas.resolution": "48",
    "lightings.train": "6",
    "lightings.validation": "1",
    "lightings.test": "2",
    "points.count": "16",
    "points.supersample": "2",
    "transport.samples": "16",
    "transport.test_samples": "32",
    "transport.threads": "2",
    "fit.bases": "4",
}


def config(**changes: str) -> Config:
    return load_config("configs/smoke.toml", {**SMALL, **changes})


def hashes(folder: Path, skip: str = "") -> dict[str, str]:
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and name not in (skip, "manifest.jsonl"):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


@pytest.fixture(scope="module")
def neon() -> Scene:
    return build("neon")


@pytest.fixture(scope="module")
def data(neon: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return ddprt.bake(neon, config=config(), out=tmp_path_factory.mktemp("neon") / "data")


def test_relit_is_what_the_lights_change_and_what_they_do_not(data: Dataset, tmp_path: Path) -> None:
    assert data.constant is not None
    assert data.constant.shape == (int(data.covered.sum()), 3)
    assert data.constant.any()
    model = ddprt.fit(data, bases=4, points=16)
    moving = model.relight(LAMP, constant=False)
    np.testing.assert_array_equal(model.relight(LAMP)[model.covered], moving[model.covered] + data.constant)
    values = model.measure(LAMP)
    np.testing.assert_array_equal(model.predict(0 * values), data.constant)
    frames = np.stack([values, 2 * values])
    np.testing.assert_array_equal(model.predict(frames), model.predict(frames, constant=False) + data.constant)
    np.testing.assert_array_equal(model.predict(0 * values, fade=True), data.constant, err_msg="once, however it fades")

    model.save(tmp_path / "model")
    np.testing.assert_array_equal(ddprt.load_model(tmp_path / "model").relight(LAMP), model.relight(LAMP))
    replace(model, constant=None).save(tmp_path / "plain")
    assert "light.constant" not in read_tensors(tmp_path / "plain" / "tensors.safetensors")
    assert ddprt.load_model(tmp_path / "plain").constant is None

    export_textures(model, tmp_path / "export", precision="float", gutter=0)
    got = documented_decoder()["decode"](tmp_path / "export", values)[model.covered]
    largest = np.abs(model.predict(values)).max()
    np.testing.assert_allclose(got, model.predict(values), atol=200 * EPS32 * largest)  # as test_export.py bounds it
    export_textures(replace(model, constant=None), tmp_path / "export", precision="float")
    assert not (tmp_path / "export" / "constant.exr").exists()
    assert "constant" not in (tmp_path / "export" / "manifest.json").read_text()


def test_scores_are_of_what_the_lights_change(data: Dataset) -> None:
    model = ddprt.fit(data, bases=4, points=16)
    with_it, without = (evaluate(data, {"svd-ridge": one}, {}).metrics for one in (model, replace(model, constant=None)))
    for metrics in (with_it, without):
        metrics["methods"]["svd-ridge"]["relight_seconds"] = 0
    assert with_it == without


def test_training_pairs_know_nothing_of_it(data: Dataset, neon: Scene, tmp_path: Path) -> None:
    ddprt.bake(force(neon, off=["emission"]), config=config(), out=tmp_path / "dark")
    ours, dark = hashes(data.folder), hashes(tmp_path / "dark")
    assert set(ours) - set(dark) == {"constant.exr"}
    assert {name for name in dark if dark[name] != ours[name]} == {"dataset.json"}
    assert Dataset(tmp_path / "dark", ddprt.open_dataset(tmp_path / "dark").description).constant is None


def test_a_bake_goes_on_to_the_same_bits(data: Dataset, neon: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import ddprt.transport.emission as emission

    class Killed(BaseException):
        pass

    def killed(*_: Any, **__: Any) -> None:
        raise Killed

    whole: Callable[..., Constant] = emission.constant_light
    with monkeypatch.context() as patch:
        patch.setattr(emission, "constant_light", killed)
        with pytest.raises(Killed):
            ddprt.bake(neon, config=config(), out=tmp_path / "data")
    with pytest.raises(ddprt.UserError, match=r"1 files missing \(first constant.exr\)"):
        ddprt.open_dataset(tmp_path / "data")
    ddprt.bake(neon, config=config(), out=tmp_path / "data")
    assert hashes(tmp_path / "data") == hashes(data.folder)
    (tmp_path / "data" / "constant.exr").unlink()
    ddprt.bake(neon, config=config(**{"transport.threads": "1"}), out=tmp_path / "data")
    assert hashes(tmp_path / "data") == hashes(data.folder)
    monkeypatch.setattr(emission, "constant_light", killed)
    ddprt.bake(neon, config=config(), out=tmp_path / "data")  # what is there is not made again
    assert emission.constant_light is not whole


def test_scenes_that_do_not_glow_never_import_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"scene.name": '"cornell"', "atlas.resolution": "32"}
    ddprt.bake(build("cornell"), config=config(**small), out=tmp_path / "with")
    monkeypatch.setitem(sys.modules, "ddprt.transport.emission", None)  # an import of it raises
    black = build("cornell").made_of(lambda material: replace(material, emission=Emission((0.0, 0.0, 0.0))))
    ddprt.bake(build("cornell"), config=config(**small), out=tmp_path / "without")
    ddprt.bake(black, config=config(**small), out=tmp_path / "black")
    assert hashes(tmp_path / "with") == hashes(tmp_path / "without")
    assert hashes(tmp_path / "with", "dataset.json") == hashes(tmp_path / "black", "dataset.json")  # its digest is another
    with pytest.raises(ImportError):
        ddprt.bake(build("neon"), config=config(), out=tmp_path / "neon")


# --- Mitsuba ----------------------------------------------------------------------------------------------------------

TEXELS = 256
SAMPLES = 2048
RUNS = 8


def mitsuba_scene(mi: Any, scene: Scene) -> Any:
    """One mesh per material in the centred frame, flat and one-sided, with `area` emitters."""
    parts: dict[str, Any] = {"type": "scene"}
    for index, material in enumerate(scene.materials):
        corners = scene.corners[scene.material == index] - scene.centre
        properties = mi.Properties()
        properties["face_normals"] = True
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": list(material.albedo)}})
        if material.emission:
            radiance = {"type": "rgb", "value": list(material.emission.radiance)}
            properties["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
        mesh = mi.Mesh(material.name, 3 * len(corners), len(corners), props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = corners.reshape(-1).astype(np.float32)
        parameters["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
        parameters.update()
        parts[f"mesh{index}"] = mesh
    return mi.load_dict(parts)


def mitsuba_samples(
    mi: Any, scene: Any, places: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Direct light by its choice of emitters, and what its paths bring less what they see of emitters first; red."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(int(rng.integers(2**31)))
    path = mi.load_dict({"type": "path", "max_depth": -1})
    sphere = rng.normal(size=places.shape)
    towards = normals + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    direct, indirect = np.zeros((2, len(places)))
    for index, (origin, direction) in enumerate(zip((places + 1e-5 * normals).tolist(), towards.tolist(), strict=True)):
        ray = mi.RayDifferential3f(origin, direction)
        light = path.sample(scene, sampler, ray)[0][0]
        first = scene.ray_intersect(ray)
        emitter = first.emitter(scene)
        indirect[index] = np.pi * (light - (emitter.eval(first)[0] if emitter is not None else 0))
        reference = mi.SurfaceInteraction3f()
        reference.p, reference.n, reference.t = mi.Point3f(origin), mi.Normal3f(normals[index].tolist()), 0.0
        sample, weight = scene.sample_emitter_direction(reference, sampler.next_2d(), True)
        direct[index] = max(float(np.dot(normals[index], [sample.d[0], sample.d[1], sample.d[2]])), 0.0) * weight[0]
    return direct, indirect


@pytest.mark.slow
def test_constant_light_agrees_with_mitsuba(neon: Scene) -> None:
    """Emitters as meshes with `area` emitters; paths begin at places of the same texels."""
    mi = pytest.importorskip("mitsuba", reason='needs the extra "reference"')
    mi.set_variant("scalar_rgb")
    atlas, tracer = build_atlas(neon, 128), Tracer.of(neon, 2)
    rng = np.random.default_rng(0)
    texels = np.sort(rng.choice(atlas.count, TEXELS, replace=False))
    scene = mitsuba_scene(mi, neon)
    # Values are skewed: a low mean comes with a low variance, which would shift z. So the variance is of a second run.
    theirs, variance = np.zeros((2, 2, TEXELS))
    for row, texel in enumerate(texels):
        for run in range(2):
            places, triangle = atlas.sampler.sample(np.full(SAMPLES, texel), rng.random((SAMPLES, 2), np.float32))
            parts = mitsuba_samples(mi, scene, places, tracer.normals[triangle].astype(float), rng)
            for part, values in enumerate(parts):
                if run == 0:
                    theirs[part, row] = values.mean()
                else:
                    variance[part, row] = values.var() / SAMPLES
    theirs[1] += theirs[0]
    variance[1] += variance[0]
    for part, bounces in enumerate((0, -1)):
        runs = [
            constant_light(neon, tracer, atlas, TransportConfig(test_samples=256), seed=seed, bounces=bounces)
            for seed in range(RUNS)
        ]
        halves = np.array([run.irradiance + sign * run.noise for run in runs for sign in (1, -1)])[:, texels, 0].astype(float)
        lit = np.flatnonzero(variance[part] > 0)
        ours, own = halves.mean(0)[lit], halves.var(0, ddof=1)[lit] / len(halves)
        z = (ours - theirs[part][lit]) / np.sqrt(own + variance[part][lit])
        bias = ours.mean() / theirs[part][lit].mean() - 1
        print(f"neon, bounces {bounces}: {len(z)} texels, z {z.mean():+.3f} +- {z.std():.3f}, means differ by {bias:+.4f}")
        # 256 scores: the mean is known to 0.063, the standard deviation to 0.045; four of these each. Tails are heavy, since
        # r² in the choice of emitters has no bound.
        assert len(z) > 0.9 * TEXELS
        assert abs(z.mean()) < 0.25
        assert abs(z.std() - 1) < 0.2
