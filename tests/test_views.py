"""The scene as an engine shows it: lamps and skies in closed form, layers by known functions, balls by geometry."""

import io
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

import ddprt
from ddprt import harmonics, warp
from ddprt.config import checked
from ddprt.dataset.layers import Layer
from ddprt.errors import UserError
from ddprt.lights import EnvironmentLight, MeshLight, PointLight, RectLight, SphereLight
from ddprt.report.evaluate import evaluate
from ddprt.report.lamps import has_size, on_picture, seen_lamps, sky_radiance
from ddprt.report.layers import _seen
from ddprt.report.scenery import WHITE, Scenery, close_cameras
from ddprt.report.shots import cameras, chosen, shots
from ddprt.report.view import Camera, Rays, default_camera, nearest_texels, seen, take_view
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.exr import write_exr
from ddprt.scene.library import build
from ddprt.scene.material import Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, rectangle
from ddprt.scene.unwrap import unwrap
from ddprt.transport import ggx
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import scattering

EPS = float(np.finfo(np.float32).eps)
LAMP = PointLight(position=(0.3, 0.45, 0.1), intensity=(1.0, 0.5, 0.2))
SHOW = Camera((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), 60.0, 4 / 3)


@pytest.fixture(scope="module")
def vase() -> tuple[Scene, Tracer, Atlas]:
    scene = build("glossy-room")
    return scene, Tracer.of(scene), build_atlas(scattering(scene), 64)


def directions(camera: Camera, height: int) -> np.ndarray:
    across, down = ((np.arange(2 * n) + 0.5) / (2 * n) for n in (round(height * camera.aspect), height))
    return camera.directions(np.stack(np.meshgrid(across, down), -1).reshape(-1, 2))


def probes(*position: tuple[float, float, float], weight: Any = 1.0) -> Layer:
    place = np.array(position, float)
    return Layer(
        "probes", "irradiance", 2, place, np.broadcast_to(np.array(weight, float), len(place)), np.full(len(place), -1)
    )


def tilted(order: int, level: float, slope: np.ndarray) -> np.ndarray:
    """(coefficients, 3) of the function level + slope . direction, in all colours."""
    found = np.zeros((harmonics.count(order), 3))
    found[0] = level * np.sqrt(4 * np.pi)
    found[[3, 1, 2]] = slope[:, None] * np.sqrt(4 * np.pi / 3)
    return found


# Lamps and skies


@pytest.mark.parametrize("turn", [0.0, 90.0, 217.0])
def test_a_sky_shows_what_it_shines_with(turn: float, tmp_path: Path) -> None:
    image = np.random.default_rng(3).random((9, 20, 3)).astype(np.float32)
    write_exr(tmp_path / "sky.exr", image)
    light = EnvironmentLight(image=str(tmp_path / "sky.exr"), rotation_deg=turn, scale=2.5)
    sample = light.illuminate(np.zeros((4000, 3)), warp.sobol(4000, 2, seed=1).astype(float), None, None)
    # A sky without bright parts is sampled uniformly where no surface is told.
    same = np.isclose(4 * np.pi * sky_radiance(light, sample.direction), sample.irradiance, rtol=1e-5).all(1)
    # Its sines are float32, so that directions within 1e-6 of an edge may be told to lie beyond it: far less than one of
    # 4000 samples is expected among 29 edges.
    assert same.sum() >= 3999


def test_the_middle_of_a_sky_lies_at_minus_z_and_turns_with_y(tmp_path: Path) -> None:
    image = np.zeros((3, 5, 3), np.float32)
    image[1, 2] = 1
    write_exr(tmp_path / "sky.exr", image)
    ways = np.array([[0, 0, -1], [-1, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    for turn, lit in ((0, 0), (90, 1), (180, 2), (-90, 3)):
        light = EnvironmentLight(image=str(tmp_path / "sky.exr"), rotation_deg=turn)
        assert np.flatnonzero(sky_radiance(light, ways).any(1)).tolist() == [lit]


@pytest.mark.parametrize("kind", ["rect", "mesh", "sphere"])
def test_lamps_show_their_fronts_as_large_as_they_are(kind: str) -> None:
    corners = (((-0.3, -0.2, 0.0), (0.3, -0.2, 0.0), (0.3, 0.2, 0.0)), ((-0.3, -0.2, 0.0), (0.3, 0.2, 0.0), (-0.3, 0.2, 0.0)))
    lamp: Any = {
        "rect": RectLight(center=(0.1, 0, 0.5), half_u=(0.3, 0, 0), half_v=(0, 0.2, 0), radiance=(3, 2, 1)),
        "mesh": MeshLight(mesh=corners, position=(0.1, 0, 0.5), radiance=(3, 2, 1)),
        "sphere": SphereLight(center=(0, 0, 0.5), radius=0.3, radiance=(3, 2, 1)),
    }[kind]
    rays, eye = directions(SHOW, 120), np.array(SHOW.eye)
    found = seen_lamps((lamp,), eye, rays, np.full(len(rays), np.inf))
    lit = found.any(1)
    np.testing.assert_array_equal(found[lit], np.tile([3.0, 2.0, 1.0], (lit.sum(), 1)))
    reach = SHOW.reach
    # On a plane at distance 1: the rectangle's shadow, or the circle of the ball's tangent cone.
    size = 0.6 * 0.4 / 1.5**2 if kind != "sphere" else np.pi * 0.3**2 / (1.5**2 - 0.3**2)
    outline = 2 * (0.6 + 0.4) / 1.5 if kind != "sphere" else 2 * np.pi * 0.3 / 1.5
    step = 2 * reach[1] / 240
    # Of a grid's points within a shape, what is counted wrongly lies within a step of its outline.
    assert abs(lit.mean() * 4 * np.prod(reach) - size) < outline * step
    assert not seen_lamps((lamp,), eye, rays, np.full(len(rays), 0.4)).any()  # behind what is nearer
    if kind != "sphere":
        assert not seen_lamps((lamp,), np.array([0, 0, -2.0]), -rays, np.full(len(rays), np.inf)).any()  # its back is dark
    assert has_size(lamp)
    assert not has_size(LAMP)


def test_lamps_that_are_behind_the_camera_are_not_marked() -> None:
    assert on_picture(SHOW, [np.zeros(3), None, np.array([0, 0, 5.0]), np.array([9.0, 0, 0])]) == [(50.0, 50.0)]
    assert on_picture(SHOW, [None]) == []


# Surfaces


def test_plain_surfaces_look_as_the_lightmap_does(cornell: Scene, cornell_atlas: Atlas) -> None:
    """Albedo times light, and nothing of the files that other effects are in."""
    hidden = ["ddprt.transport.gloss", "ddprt.transport.emission", "ddprt.lights.sky", "ddprt.transport.cutouts"]
    kept = {name: sys.modules.pop(name, None) for name in hidden}
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        tracer, covered = Tracer.of(cornell), cornell_atlas.slot >= 0
        camera = default_camera(cornell)
        scenery = Scenery.of(tracer, cornell, cornell_atlas.uv, covered, camera, height=60)
        light = np.random.default_rng(1).random((cornell_atlas.count, 3)).astype(np.float32)
        lit = scenery.lit((LAMP,), light)
        emitted = scenery.emitted((LAMP,))
    finally:
        for name, module in kept.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
    assert not emitted.any()
    np.testing.assert_allclose(lit, scenery.learned(light, {}), rtol=1e-12)
    np.testing.assert_allclose(scenery.lit((LAMP,), light, light), 2 * lit, rtol=1e-12)
    view = take_view(tracer, cornell_atlas.uv, covered, camera, height=60)
    np.testing.assert_allclose(scenery.alpha((LAMP,)), view.alpha, atol=1e-12)
    # The same where each quad has one albedo: chart edges, which no look-up crosses, aside by what it counts the uncovered.
    flat = view.render((cornell_atlas.albedo * light).astype(np.float64))
    np.testing.assert_allclose(lit, flat, atol=1e-5)


def test_glossy_pixels_show_their_layer_towards_the_eye(vase: tuple[Scene, Tracer, Atlas]) -> None:
    scene, tracer, atlas = vase
    covered, camera = atlas.slot >= 0, default_camera(scene)
    texel = np.flatnonzero(atlas.albedo.max(1) == 0)
    rng = np.random.default_rng(2)
    texel = np.append(texel, np.flatnonzero(atlas.albedo.max(1) > 0)[:50])  # texels may hold other surfaces beside gloss
    rng.shuffle(texel)  # places need not be in the order of the lightmap
    layer = Layer("gloss-2", "radiance", 2, atlas.position[texel], atlas.area[texel], texel)
    scenery = Scenery.of(tracer, scene, atlas.uv, covered, camera, [layer], height=60)
    slope = np.array([8.0, -0.2, -0.1])
    light = np.tile(tilted(2, -0.8, slope), (len(texel), 1, 1)).astype(np.float32)
    shown = scenery.learned(np.zeros((atlas.count, 3), np.float32), {"gloss-2": light})
    rays = scenery.rays
    gilt = scene.material == len(scene.materials) - 1
    on_it = (rays.hits.triangle >= 0) & gilt[rays.hits.triangle]
    value = np.maximum(-0.8 - rays.directions.astype(np.float64) @ slope, 0)  # towards the eye is against the ray
    expected = rays.mean(np.pi * np.where(on_it, value, 0))
    assert on_it.sum() > 500
    assert (value[on_it] == 0).any()
    assert (value[on_it] > 0).any()
    np.testing.assert_allclose(shown, np.repeat(expected[..., None], 3, 2), atol=20 * EPS)
    # A place of its own for each texel: what lies in the middle of one shows that one.
    own = np.zeros((len(texel), 9, 3), np.float32)
    own[:, 0] = (np.sqrt(4 * np.pi) * texel[:, None] / np.pi).astype(np.float32)
    part = scenery.shown[0]
    lookup = Scenery.of(tracer, scene, atlas.uv, covered, camera, height=60).lookup
    mine = np.searchsorted(scenery.met, part.rays)
    whole = np.asarray(lookup[mine].max(1).todense())[:, 0] > 0.9
    expected = (lookup @ np.arange(atlas.count))[mine]
    assert whole.sum() > 10
    np.testing.assert_allclose(part.values(own)[whole, 0], expected[whole], rtol=1e-5)


def test_a_white_sky_in_a_metal_mirror() -> None:
    """A lonely metal under light from everywhere sends out its facets' albedo, by the angle that it is seen at."""
    metal = Material("metal", (1.0, 1.0, 1.0), gloss=Gloss(0.5, 1.0))
    scene = faceted("plate", rectangle((-1.0, -1.0), (1.0, 1.0), 0.0, 2, facing=1)[None], (metal,))
    atlas, tracer = build_atlas(scene, 16), Tracer.of(scene)
    camera = Camera((0.2, 1.5, 1.2), (0.0, 0.0, 0.0), 40.0, 1.0)
    scenery = Scenery.of(tracer, scene, atlas.uv, atlas.slot >= 0, camera, height=48)
    sky, dark = EnvironmentLight(image="white"), np.zeros((atlas.count, 3), np.float32)
    lit = scenery.lit((sky,), dark)
    np.testing.assert_allclose(
        scenery.emitted((sky,))[scenery.rays.mean(np.isinf(scenery.ends).astype(float)) == 1], np.pi, rtol=1e-6
    )
    assert (scenery.alpha((sky,)) == 1).all()
    rays = scenery.rays
    on_it = rays.hits.triangle >= 0
    cosine = np.where(on_it, -rays.directions[:, 2].astype(float), 1.0)
    expected = rays.mean(np.where(on_it, np.pi * ggx.albedo(cosine, 0.5, 1.0), 0))
    inside = rays.mean(on_it.astype(float)) == 1
    assert not scenery.emitted((sky,))[inside].any()
    error = (lit - expected[..., None])[inside][:, 0]
    # Pixels are independent; the table of albedos is interpolated, to 2e-3 (tests/test_ggx.py).
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error)) + 2e-3 * np.pi
    assert error.std() < 0.05 * np.pi  # the lobe is sampled, too: light's own samples alone leave 0.2 pi


def test_a_glowing_sign_shows_its_radiance() -> None:
    scene = build("neon")
    tracer, atlas = Tracer.of(scene), build_atlas(scene, 64)
    camera = Camera((0.0, 1.5, 1.5), (0.0, 1.5, 0.0), 60.0, 1.0)
    scenery = Scenery.of(tracer, scene, atlas.uv, atlas.slot >= 0, camera, height=60)
    glow, rays = scenery.emitted((LAMP,)), scenery.rays
    expected = np.zeros((len(rays.pixel), 3))
    for index, material in enumerate(scene.materials):
        if material.emission:
            there = (rays.hits.triangle >= 0) & (scene.material[rays.hits.triangle] == index)
            assert there.any()
            expected[there] = np.pi * np.array(material.emission.radiance)
    np.testing.assert_allclose(glow, rays.mean(expected), rtol=1e-12)


# Probes


def test_probes_are_balls_shaded_by_their_own_normals(cornell: Scene, cornell_atlas: Atlas) -> None:
    tracer, covered, camera = Tracer.of(cornell), cornell_atlas.slot >= 0, default_camera(cornell)
    places = ((0.2, 0.4, 0.05), (0.26, 0.4, 0.05), (0.4, 0.2, 0.05))
    layer = probes(*places, weight=[1, 1, 0])  # the third is said to stand in a solid
    scenery = Scenery.of(tracer, cornell, cornell_atlas.uv, covered, camera, [layer], height=240)
    (balls,) = scenery.balls
    assert set(balls.probe) == {0, 1}
    away = balls.position - layer.position[balls.probe]
    radius = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(radius, radius[0], rtol=1e-5)
    np.testing.assert_allclose(radius[0], 0.16 * 0.06, rtol=1e-5)
    np.testing.assert_allclose(balls.normal, away / radius[:, None], atol=1e-6)
    rays = scenery.rays.directions[balls.rays].astype(float)
    assert (np.einsum("nd,nd->n", rays, balls.normal) < 0).all()  # the near side
    for index in range(2):
        # The tangent cone of a ball near the middle of a picture, as its share of the plane at distance 1: within the
        # outline's step, and stretched off the axis by less than a tenth.
        distance = np.linalg.norm(np.array(places[index]) - camera.eye)
        size = np.pi * radius[0] ** 2 / distance**2
        share = (balls.probe == index).mean() * len(balls.rays) / len(scenery.rays.pixel) * 4 * np.prod(camera.reach)
        assert share == pytest.approx(size, rel=0.2)
    slope = np.array([0.5, 0.2, -0.7])
    light = np.tile(tilted(2, 0.4, slope), (3, 1, 1)).astype(np.float32)
    values = scenery.shown[0].values(light)
    np.testing.assert_allclose(values[:, 0], WHITE * np.maximum(0.4 + balls.normal @ slope, 0), atol=20 * EPS)
    # The direct light is that of the lamp, at the ball's own place; what faces away has none.
    found = np.zeros((len(scenery.rays.pixel), 3))
    towards = np.array(LAMP.position) - balls.position
    squared = np.einsum("nd,nd->n", towards, towards)
    cosine = np.maximum(np.einsum("nd,nd->n", towards, balls.normal) / np.sqrt(squared), 0)
    found[balls.rays] = WHITE * (cosine / squared)[:, None] * np.array(LAMP.intensity)
    whole = scenery.rays.mean(np.isin(np.arange(len(found)), balls.rays).astype(float)) == 1
    lit = scenery.lit((LAMP,), np.zeros((cornell_atlas.count, 3), np.float32))
    assert whole.sum() > 50
    # Places are float32 in the room's frame: off by 6e-8 m, which turns a normal of 1 cm by 6e-6 and a cosine by as much.
    bound = 2 * 6e-6 * WHITE * (np.max(LAMP.intensity) / squared.min())
    np.testing.assert_allclose(lit[whole], scenery.rays.mean(found)[whole], rtol=1e-4, atol=bound)


def test_what_is_nearer_hides_a_ball_and_a_ball_hides_what_is_farther(cornell: Scene, cornell_atlas: Atlas) -> None:
    tracer, covered, camera = Tracer.of(cornell), cornell_atlas.slot >= 0, default_camera(cornell)
    # Behind the tall block; in the open before the back wall; and the same two one behind the other.
    behind, open_air, nearer = (0.37, 0.1, 0.5), (0.15, 0.45, 0.4), (0.278 - 0.128 * 0.5, 0.273 + 0.177 * 0.5, -0.2)
    layer = probes(behind, open_air, nearer)
    (balls,) = Scenery.of(tracer, cornell, cornell_atlas.uv, covered, camera, [layer], height=90).balls
    assert 2 in balls.probe
    assert 0 not in balls.probe
    alone = Scenery.of(tracer, cornell, cornell_atlas.uv, covered, camera, [probes(open_air, (9, 9, 9))], height=90)
    assert len(alone.balls[0].rays) > 0
    assert len(np.unique(balls.rays)) == len(balls.rays)
    plain = Scenery.of(tracer, cornell, cornell_atlas.uv, covered, camera, height=90)
    both = Scenery.of(tracer, cornell, cornell_atlas.uv, covered, camera, [layer], height=90)
    assert not set(both.met) & set(balls.rays)
    assert set(plain.met) == set(both.met) | (set(balls.rays) & set(plain.met))


@pytest.mark.slow
def test_a_report_of_a_glossy_room_shows_it_from_three_places(tmp_path: Path) -> None:
    config = checked(
        {
            "atlas": {"resolution": 64},
            "lightings": {"train": 4, "validation": 1, "test": 3, "clearance": 0.1},
            "points": {"count": 12, "supersample": 1},
            "transport": {"samples": 4, "test_samples": 8},
        }
    )
    scene = build("glossy-room")
    data = ddprt.bake(scene, config=config, out=tmp_path / "d")
    model = ddprt.fit(data, bases=3)
    assert [part.layer.quantity for part in model.layers.values()] == ["radiance"]
    evaluation = evaluate(data, {"svd-ridge": model}, {})
    (score,) = evaluation.metrics["layers"].values()
    assert score["seen_relative_rmse"] > 0
    uv, _ = unwrap(scene, 64, config.atlas.padding)
    rows = shots(evaluation, data, "svd-ridge", model, scene, Tracer.of(scene), uv)
    assert [row["label"] for row in rows] == ["median", "worst"]
    for row in rows:
        assert len({view["eye"] for view in row["views"]}) == 3
        for view in row["views"]:
            images = [imread(io.BytesIO(view[name])) for name in ("ours", "reference", "difference")]
            assert {image.shape for image in images} == {(320, 320, 4)}
            assert not np.array_equal(images[0], images[1])
            assert view["off"] > 0
    (one,) = shots(evaluation, data, "svd-ridge", model, scene, Tracer.of(scene), uv, [(0.1, 0.3, -0.5)])[0]["views"]
    assert one["eye"] == (0.1, 0.3, -0.5)


# From where


def test_close_cameras_see_what_is_glossy(vase: tuple[Scene, Tracer, Atlas]) -> None:
    scene, tracer, atlas = vase
    texel = np.flatnonzero(atlas.albedo.max(1) == 0)
    layer = Layer("gloss-2", "radiance", 2, atlas.position[texel], atlas.area[texel], texel)
    first = default_camera(scene)
    assert close_cameras(tracer, first, [probes((0.1, 0.1, 0.1))]) == []
    left, right = close_cameras(tracer, first, [layer])
    gilt = scene.material == len(scene.materials) - 1
    share = []
    for camera in (first, left, right):
        hits = Rays.of(tracer, camera, 40).hits
        share.append(float(((hits.triangle >= 0) & gilt[hits.triangle]).mean()))
        assert seen(tracer, camera, atlas.position[texel]).mean() > 0.3
    assert min(share[1:]) > 2 * share[0]
    assert np.linalg.norm(np.subtract(left.eye, right.eye)) > 0.2


def test_given_places_look_at_the_middle(cornell: Scene) -> None:
    tracer = Tracer.of(cornell)
    first = default_camera(cornell)
    assert cameras(cornell, tracer, (), []) == [first]
    x, y, z = cornell.centre.tolist()
    side, above = cameras(cornell, tracer, ((0.1, 0.3, -0.5), (x, 3.0, z)), [])
    assert side.eye == (0.1, 0.3, -0.5)
    assert side.target == above.target == (x, y, z)
    assert np.isfinite(above.axes).all()  # straight down
    with pytest.raises(UserError, match=r"report\.views: got"):
        cameras(cornell, tracer, ((x, y, z),), [])
    gloss = Layer("gloss-2", "radiance", 2, np.array([[0.1, 0.2, 0.3], [0.3, 0.4, 0.3]]), np.ones(2), np.arange(2))
    (one,) = cameras(cornell, tracer, ((0.1, 0.3, -0.5),), [probes((0.5, 0.5, 0.5)), gloss])
    np.testing.assert_allclose(one.target, [0.2, 0.3, 0.3])


def test_the_median_and_the_worst_are_shown() -> None:
    assert chosen(np.array([0.3, np.nan, 0.1, 0.9, 0.5, 0.2])) == [(0, "median"), (3, "worst")]
    assert chosen(np.array([np.nan, 0.1])) == [(1, "median")]
    assert chosen(np.full(3, np.nan)) == []


def test_places_lie_in_their_texels(cornell_atlas: Atlas) -> None:
    covered = cornell_atlas.slot >= 0
    row, column = np.nonzero(covered)
    inside = np.random.default_rng(0).uniform(0.01, 0.99, (len(row), 2))
    place = (np.stack([column, row], 1) + inside) / covered.shape[1]
    np.testing.assert_array_equal(nearest_texels(place, covered), np.arange(len(row)))
    assert nearest_texels(np.array([[0.0, 0.0], [1.0, 1.0]]), covered).min() >= 0


# Scores


def test_errors_as_seen_are_of_what_lies_before_the_surface() -> None:
    """An error that only shows behind the surface is none; one of a tenth everywhere is a tenth."""
    normal = np.array([[0, 0, 1.0], [0, 1, 0]], np.float32)
    layer = Layer("gloss-1", "radiance", 1, np.zeros((2, 3)), np.array([1.0, 3.0]), np.arange(2))
    even = np.tile(tilted(1, 1.0, np.zeros(3)), (4, 2, 1, 1)).astype(np.float32)
    assert _seen(layer, 1.1 * even, even, normal) == pytest.approx(0.1, rel=1e-5)
    assert _seen(layer, even, 0 * even, normal) is None
    behind, twice = even.copy(), even.copy()
    behind[:, 1], twice[:, 1] = (tilted(1, 0.0, np.array([0, -size, 0.0])) for size in (1, 2))  # dark before the second place
    assert _seen(layer, twice, behind, normal) == 0
    one = replace(layer, weight=np.array([1.0, 0.0]))
    below = even.copy()
    below[:, 1] = 7  # counts nothing
    assert _seen(one, below, even, normal) == pytest.approx(0.0, abs=1e-6)
    # 1 + cos against 1: the cosine's own mean square under the cosine is 1/2; 64 directions know it to a few percent.
    leaning = np.tile(tilted(1, 1.0, np.array([0, 0, 1.0])), (4, 2, 1, 1)).astype(np.float32)
    assert _seen(one, leaning, even, normal) == pytest.approx(np.sqrt(0.5), rel=0.03)
