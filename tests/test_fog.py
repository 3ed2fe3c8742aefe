"""Fog: transmittance, its samplers, single scattering by quadrature, furnaces, two integrators, plans, bakes and refusals."""

import sys
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2

import ddprt
from ddprt import warp
from ddprt.config import Config, checked
from ddprt.dataset import generate
from ddprt.dataset.splits import doubt
from ddprt.errors import UserError
from ddprt.files import sha256
from ddprt.lights import parse_lighting
from ddprt.progress import Doubt
from ddprt.scene.atlas import Atlas
from ddprt.scene.fog import Fog
from ddprt.scene.library import build
from ddprt.scene.material import Emission, Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, hollow
from ddprt.transport.configured import configured_scene
from ddprt.transport.direct import Texels
from ddprt.transport.effects import force, plan
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.fog import Air
from ddprt.transport.fog_reference import stretch, turned
from ddprt.transport.fogginess import long_in_fog
from ddprt.transport.measure import measure
from ddprt.transport.medium import Medium
from ddprt.transport.meetings import pdf_henyey, sample_henyey
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.paths import trace_paths
from ddprt.transport.reference import on_points, on_texels, trace_reference
from ddprt.transport.shading import lamps_of, shade
from ddprt.transport.walk import albedo_of, walked

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

from effect_figures import scattered_once

LAMP: dict[str, Any] = {"type": "point", "position": [0.3, 0.4, 0.2], "intensity": [1, 1, 1]}
SUN: dict[str, Any] = {"type": "directional", "direction": [0.2, -0.3, 1], "irradiance": [1, 1, 1]}
PATHS = (0.6, 0.5, 0.4)


@pytest.fixture(scope="module")
def room() -> Scene:
    return build("foggy-room")


def black_box(edge: float) -> Scene:
    """A closed black room about the origin."""
    half = np.array([-edge / 2, edge / 2])
    return faceted("box", hollow(np.ones((1, 1, 1), bool), half, half, half), (Material("black", (0.0,) * 3),))


def medium(paths: Any = PATHS, albedo: Any = (1.0, 0.9, 0.5), g: float = 0.3, half: float = 1.0) -> Medium:
    return Medium.of(Fog.of({"mean_free_path": paths, "albedo": albedo, "anisotropy": g}), np.full(3, half))


def traced(tracer: Tracer, scene: Scene, atlas: Atlas, lightings: list[Any], samples: int, **given: Any) -> np.ndarray:
    out = np.zeros((len(lightings), atlas.count, 3), np.float32)
    lamps = [parse_lighting(lighting) for lighting in lightings]
    for _ in trace_paths(tracer, scene, atlas, lamps, out, samples=samples, **{"seed": 0, "stream": "fog", **given}):
        pass
    return out


def agrees(found: np.ndarray, expected: np.ndarray) -> bool:
    """Chi-square of counts."""
    kept = expected > 5
    return bool(((found - expected)[kept] ** 2 / expected[kept]).sum() < chi2.ppf(1 - 1e-4, int(kept.sum())))


# --- transmittance -------------------------------------------------------------------------------------------------------


def test_light_fades_by_the_length_of_its_way_through_the_box(cornell: Scene) -> None:
    """Lamps inside and outside and the sun, seen from inside and outside: exp(-length / free path) of that in clear air."""
    low, high = cornell.bounds
    places = np.random.default_rng(0).uniform([0.1, 0.35, 0.02], [0.4, 0.5, 0.05], (64, 3))
    normals = np.tile([0.0, 0.0, -1.0], (64, 1))  # out of the open front
    places[::4, 2], normals[::4, 2] = -0.4, 1  # and from before it into the box
    misty = Tracer.of(replace(cornell, fog=Fog.of({"mean_free_path": PATHS})), 1)
    for light, towards in (
        ({**LAMP, "position": [0.3, 0.4, -2.0]}, np.array([0.3, 0.4, -2.0]) - places),
        ({**LAMP, "position": [0.3, 0.4, 0.01]}, np.array([0.3, 0.4, 0.01]) - places),
        ({**LAMP, "position": [0.3, 0.45, 0.3]}, np.array([0.3, 0.45, 0.3]) - places),
        (SUN, np.tile(-np.array(SUN["direction"]), (64, 1))),
    ):
        lighting = parse_lighting(light)
        clear = measure(Tracer.of(cornell, 1), lighting, places, normals, seed=0)
        found = measure(misty, lighting, places, normals, seed=0)
        way = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        sides = np.stack([(low - places) / way, (high - places) / way])
        reach = np.linalg.norm(towards, axis=1) if light is not SUN else np.inf
        length = np.minimum(sides.max(0).min(1), reach) - np.maximum(sides.min(0).max(1), 0)
        assert (clear > 0).all(1).sum() > 12
        np.testing.assert_allclose(found, clear * np.exp(-length[:, None] / PATHS), rtol=2e-5)


def test_stretches_of_fog_are_those_of_the_slow_twin() -> None:
    """Rays from inside and outside, along the axes too, some of which miss the box."""
    rng, air = np.random.default_rng(1), medium(half=0.7)
    origins = rng.uniform(-1.2, 1.2, (4000, 3)).astype(np.float32)
    ways = rng.standard_normal((4000, 3))
    ways[:300, 1:] = 0
    ways = (ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)
    reach = np.where(rng.random(4000) < 0.5, np.inf, rng.random(4000)).astype(np.float32)
    near, far = air.spans(origins, ways, reach)
    other_near, other_far = stretch(air.half, origins, ways, reach.astype(np.float64))
    np.testing.assert_allclose(far - near, other_far - other_near, atol=1e-12)
    assert 0.1 < (far > near).mean() < 0.9
    inside = far > near
    np.testing.assert_allclose(near[inside], other_near[inside], atol=1e-12)
    middle = origins[inside] + ((near + far)[inside] / 2)[:, None] * ways[inside]
    assert (np.abs(middle) <= 0.7 + 1e-6).all()


# --- samplers ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [-0.7, 0.0, 0.3, 0.9])
def test_ways_on_are_henyey_and_greensteins(g: float) -> None:
    rng = np.random.default_rng(2)
    ways = rng.standard_normal((20_000, 3))
    ways = (ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)
    ways[:2] = [[0, 0, 1], [0, 0, -1]]
    numbers = rng.random((20_000, 2), np.float32)
    drawn = medium(g=g).scattered(ways, numbers)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-6)
    cosine = np.einsum("nd,nd->n", drawn, ways)
    np.testing.assert_allclose(cosine, sample_henyey(numbers[:, 0].astype(np.float64), g), atol=1e-4)
    edges = np.linspace(-1, 1, 33)
    density = [quad(lambda c: 2 * np.pi * float(pdf_henyey(np.array([c]), g)[0]), *ends)[0] for ends in pairwise(edges)]
    for ways_on in (drawn, turned(ways, g, rng)):
        found = np.histogram(np.clip(np.einsum("nd,nd->n", ways_on, ways), -1, 1), edges)[0]
        assert agrees(found, 20_000 * np.array(density))
    across = np.einsum("nd,nd->n", drawn, np.cross(ways, [0.36, 0.48, 0.8]).astype(np.float32))
    assert abs(across.mean()) < 5 * across.std() / 20_000**0.5  # to no side more than to the other
    np.testing.assert_allclose(medium(g=g).phase(cosine), pdf_henyey(cosine, g), rtol=1e-4)


def test_flights_share_their_channels_and_lose_no_light() -> None:
    """Chi-square of where paths meet fog, and means of what they are then worth: Beer and Lambert's law in each channel."""
    count, length = 200_000, 0.9
    air, rng = medium(paths=(0.8, 0.4, 0.1)), np.random.default_rng(3)
    span = np.tile([[0.2], [0.2 + length]], (1, count))
    throughput = np.tile(np.array([[1.0], [0.5], [0.25]], np.float32), (1, count))
    where, factor = air.fly(span, throughput, rng.random((2, count), np.float32))
    meets, weight = where < np.inf, throughput * factor
    np.testing.assert_allclose(weight.sum(0), 1.75, rtol=1e-6)  # the sum never grows, whatever was drawn
    edges = np.append(np.linspace(0, length, 25), np.inf)
    odds = np.array([1.0, 0.5, 0.25]) / 1.75
    left = np.exp(-np.append(edges[:-1], np.inf)[:, None] * air.extinction)
    expected = -np.diff(left, axis=0) @ odds
    expected[-1] = left[-2] @ odds
    assert agrees(np.histogram(np.where(meets, where - 0.2, 1e9), edges)[0], count * expected)
    for part, of_all in ((~meets, np.exp(-length * air.extinction)), (meets, -np.expm1(-length * air.extinction))):
        worth = weight * part
        error = worth.std(1) / count**0.5
        assert (np.abs(worth.mean(1) - [1.0, 0.5, 0.25] * of_all) < 4 * error + 1e-7).all()


@pytest.mark.parametrize("lamp", [None, (0.5, 0.05, 0.0), (-3.0, 2.0, 0.0)])
def test_places_on_a_stretch_are_drawn_by_the_density_they_weigh_by(lamp: tuple[float, ...] | None) -> None:
    count, air, rng = 100_000, medium(paths=(0.8, 0.4, 0.1)), np.random.default_rng(4)
    place = np.tile(np.array([[-0.2], [0], [0], [1], [0], [0]], np.float32), (1, count))
    throughput = np.tile(np.array([[1.0], [0.5], [0.25]], np.float32), (1, count))
    span = np.tile([[0.1], [1.1]], (1, count))
    anchor = None if lamp is None else np.array(lamp)
    there, worth = air.stops(place, span, throughput, rng.random((2, count), np.float32), anchor)
    flown = there[0] + 0.2 - 0.1
    np.testing.assert_array_equal(there[1:], place[1:])
    law = throughput.astype(np.float64) * (air.albedo * air.extinction)[:, None] * np.exp(-air.extinction[:, None] * flown)
    density = law / worth
    np.testing.assert_allclose(density[0], density[2], rtol=1e-3)  # of the place, whatever the channel
    order = np.argsort(flown)
    edges = np.linspace(0, 1, 33)
    fine = np.interp(np.linspace(0, 1, 3201), flown[order], density[0][order])
    mass = np.add.reduceat((fine[1:] + fine[:-1]) / 6400, np.arange(0, 3200, 100))
    assert mass.sum() == pytest.approx(1, abs=2e-3)
    assert agrees(np.histogram(np.clip(flown, 0, 1), edges)[0], count * mass / mass.sum())
    lit = worth / np.maximum(((there[:3].T - (lamp or (9.0, 0, 0))) ** 2).sum(1), 1e-12)
    for channel in range(3):
        extinct = air.extinction[channel]

        def light(t: float, extinct: float = extinct) -> float:
            return float(np.exp(-extinct * t) * extinct / ((np.array([t - 0.1, 0, 0]) - (lamp or (9.0, 0, 0))) ** 2).sum())

        expected = throughput[channel, 0] * air.albedo[channel] * quad(light, 0, 1, points=[0.6], limit=200)[0]
        assert abs(lit[channel].mean() - expected) < 4.5 * lit[channel].std() / count**0.5


# --- closed forms --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [0.0, 0.6])
def test_light_that_scatters_once_is_that_of_quadrature(g: float) -> None:
    """A lamp half a metre over the floor of a black room whose walls are ten free paths away; both integrators."""
    fog = Fog((1.0, 0.7, 0.4), (1.0, 0.8, 0.5), g)
    scene = replace(black_box(20.0), fog=fog)
    lamp = parse_lighting({"type": "point", "position": [0, -9.5, 0], "intensity": [1, 1, 1]})
    expected = np.array([scattered_once(0.5, *of, g) for of in zip(fog.mean_free_path, fog.albedo, strict=True)])
    tracer = Tracer.of(scene, 1)
    start = on_points(tracer, np.array([[0.0, -10.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]))
    found = trace_reference(tracer, scene, lamp, start, 1, 1 << 15, seed=0, bounces=1)
    error = np.sqrt(found.indirect_variance[0])
    assert (error < 0.04 * expected).all()
    assert (np.abs(found.indirect[0] - expected) < 4 * error).all()
    np.testing.assert_allclose(found.direct[0], 4 * np.exp(-0.5 / np.array(fog.mean_free_path)), rtol=1e-3)

    count, runs, rng = 1 << 12, np.zeros((8, 1, 1, 3)), np.random.default_rng(5)
    lamps = lamps_of(tracer, [lamp])
    for sums in runs:
        place, facing = start(np.zeros(count, int), rng)
        ways = warp.to_world(warp.sample_cosine(rng.random((count, 2), np.float32)), warp.frame(facing))
        rays = lifted(tracer, place, facing).astype(np.float32), ways, np.zeros(count, np.int32)
        for met in walked(tracer, albedo_of(scene), rays, rng, 1, air=Air(tracer.medium)):
            for part in met.blocks():
                shade(tracer, lamps, part, rng, sums)
    values = runs[:, 0, 0] / count
    error = values.std(0, ddof=1) / 8**0.5
    assert (error < 0.04 * expected).all()
    assert (np.abs(values.mean(0) - expected) < 4.5 * error).all()


@pytest.mark.parametrize(
    ("paths", "g"),
    [
        pytest.param((4.0, 1.0, 0.25), 0.3, id="apart"),
        pytest.param((2.0, 2.0, 2.0), 0.0, id="thin", marks=pytest.mark.slow),
        pytest.param((0.5, 0.5, 0.5), 0.7, id="forwards", marks=pytest.mark.slow),
    ],
)
def test_white_fog_in_a_closed_room_keeps_the_energy(furnace: Scene, furnace_atlas: Atlas, paths: Any, g: float) -> None:
    """What walls absorb is what the lamp sends out, wherever fog sends it before: the mean of (1 - a) E is flux over area."""
    scene = replace(furnace, fog=Fog.of({"mean_free_path": paths, "anisotropy": g}))
    square = {"center": [0.3, 0.2, -0.1], "half_u": [0.2, 0, 0], "half_v": [0, 0, 0.2], "radiance": [25, 25, 25]}
    tracer, lamp = Tracer.of(scene, 2), {"type": "rect", **square}
    share = furnace_atlas.area / furnace_atlas.area.sum()
    rng = np.random.default_rng(0)
    direct = share @ Texels.of(tracer, furnace_atlas, 4, rng).irradiance(parse_lighting(lamp), rng)
    runs = [share @ traced(tracer, scene, furnace_atlas, [lamp], 8, stream=f"run {run}")[0] for run in range(6)]
    error = np.std(runs, axis=0, ddof=1) / 6**0.5
    expected = np.pi * 25 * 0.16 / (furnace_atlas.area.sum() * (1 - 0.5))
    found = direct + np.mean(runs, axis=0)
    assert (error < 0.03 * expected).all()
    # Student's t of 5 degrees of freedom exceeds 6 once in 500 times.
    assert (np.abs(found - expected) < 6 * error + 1e-3 * expected).all()
    assert (direct < 0.45 * expected).all()


def test_fog_that_swallows_all_leaves_direct_light_alone(furnace: Scene, furnace_atlas: Atlas) -> None:
    black = furnace.made_of(lambda wall: replace(wall, albedo=(0.0,) * 3))
    scene = replace(black, fog=Fog((0.5,) * 3, (0.0, 0.5, 0.0)))
    light = traced(Tracer.of(scene, 1), scene, furnace_atlas, [LAMP], 4)[0]
    assert not light[:, [0, 2]].any()
    assert (light[:, 1] > 0).mean() > 0.5  # shadow rays of what is faint are few


# --- two integrators, and laws -------------------------------------------------------------------------------------------


def test_paths_agree_with_the_reference(room: Scene) -> None:
    """Three kinds of light in the Cornell box; the variance of paths is that of eight runs."""
    lightings = [
        LAMP,
        SUN,
        {"type": "rect", "center": [0.3, 0.5, 0.3], "half_u": [0.05, 0, 0], "half_v": [0, 0, 0.05], "radiance": [9, 9, 9]},
    ]
    tracer = Tracer.of(room, 2)
    atlas, _ = build_open_atlas(tracer, room, 24)
    some = np.arange(0, atlas.count, 2)
    runs = np.stack([traced(tracer, room, atlas, lightings, 32, stream=f"run {run}", texels=some) for run in range(8)])
    mean, variance = runs.mean(0)[:, some], runs.var(0, ddof=1)[:, some] / 8
    for index, lighting in enumerate(lightings):
        start = on_texels(tracer, atlas, some)
        truth = trace_reference(tracer, room, parse_lighting(lighting), start, len(some), 512, seed=index)
        z = (mean[index] - truth.indirect) / np.sqrt(variance[index] + truth.indirect_variance)
        # Channels of a texel hang together: about as many scores as texels. Variances of 8 runs widen them to 1.2.
        print(f"{lighting['type']}: {len(some)} texels, z {z.mean():+.3f} +- {z.std():.3f}")
        assert abs(z.mean()) < 4 / len(some) ** 0.5
        assert 0.7 < z.std() < 1.4
        assert np.abs(mean[index].mean(0) / truth.indirect.mean(0) - 1).max() < 0.1


def test_light_adds_and_knows_no_threads(room: Scene) -> None:
    tracer, one = Tracer.of(room, 2), Tracer.of(room, 1)
    atlas, _ = build_open_atlas(tracer, room, 24)
    out = traced(tracer, room, atlas, [[LAMP], [SUN], [LAMP, SUN], [{**LAMP, "intensity": [2, 2, 2]}]], 8)
    np.testing.assert_array_equal(out[0], traced(one, room, atlas, [[LAMP]], 8)[0])
    np.testing.assert_allclose(out[3], 2 * out[0], rtol=1e-5)
    np.testing.assert_allclose(out[2], out[0] + out[1], rtol=1e-4)
    assert out.min() >= 0
    first, two, more = (traced(tracer, room, atlas, [LAMP], 8, bounces=count).mean() for count in (1, 2, -1))
    assert 0 < first < two < more


# --- plans, scenes, refusals ---------------------------------------------------------------------------------------------


def line(scene: Scene, name: str = "fog", **given: Any) -> Any:
    return next(effect for effect in plan(scene, [], **given).effects if effect.name == name)


def test_the_plan_names_fog_and_off_clears_the_air(room: Scene, cornell: Scene) -> None:
    assert line(room).called
    assert line(room).why == "the scene is up to 2.4 free paths wide, its fog's largest albedo 0.95"
    assert not line(cornell).called
    off = force(room, off=["fog"])
    assert (off.fog, line(off).called, line(off).bound, line(off).forced) == (None, False, None, True)
    assert force(off, on=["fog"]).fog == room.fog
    assert replace(off, name="cornell").digest == cornell.digest != room.digest
    assert replace(room, fog=Fog((1.0,) * 3)).digest != replace(room, fog=Fog((1.0,) * 3, anisotropy=0.1)).digest
    assert line(room, "diffuse bounces", bounces=1).bound is None
    black = build("foggy-room", brightness=0.0)
    assert line(black, "diffuse bounces").called
    assert not line(replace(black, fog=None), "diffuse bounces").called
    ball = replace(build("furnace", subdivisions=1), fog=room.fog)
    assert line(ball, "diffuse bounces").called
    flat = replace(faceted("flat", _floor(), (Material("grey", (0.5,) * 3),)), fog=room.fog)
    assert not line(flat).called
    assert line(flat).why == "the bounding box is flat and holds no air"


def _floor() -> np.ndarray:
    return np.array([[[0.0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]]])


def test_a_black_room_in_fog_has_indirect_light_at_any_place() -> None:
    scene = build("foggy-room", brightness=0.0)
    _, light = ddprt.irradiance(scene, LAMP, [[0.28, 0.0, 0.05]], [[0, 1, 0]], samples=64)
    assert (light > 0).all()
    _, dark = ddprt.irradiance(force(scene, off=["fog"]), LAMP, [[0.28, 0.0, 0.05]], [[0, 1, 0]], samples=64)
    assert not dark.any()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "fog: got no mean_free_path, expected metres per channel"),
        ({"mean_free_path": 0}, "fog.mean_free_path: got .0.0, 0.0, 0.0., expected 1e-09 to 1e.12 m"),
        ({"mean_free_path": [1, 2]}, "fog.mean_free_path: got .1, 2., expected a finite number, or three"),
        ({"mean_free_path": float("nan")}, "fog.mean_free_path: got nan, expected a finite number"),
        ({"mean_free_path": "thick"}, "fog.mean_free_path: got 'thick', expected a finite number"),
        ({"mean_free_path": 1, "albedo": 1.5}, "fog.albedo: got .1.5, 1.5, 1.5., expected 0 to 1"),
        ({"mean_free_path": 1, "anisotropy": 1}, "fog.anisotropy: got 1, expected a number between -1 and 1"),
        ({"mean_free_path": 1, "density": 1}, "fog.density: unknown key"),
        (0.5, "scene.fog: got 0.5, expected a table"),
    ],
)
def test_fog_that_cannot_be_is_refused_in_one_line(given: Any, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        Fog.of(given, "scene.fog") if not isinstance(given, dict) else ddprt.load_scene("cornell", fog=given)
    assert "\n" not in str(caught.value)


def test_a_configuration_says_fog_and_says_it_again() -> None:
    config = checked({"scene": {"fog": {"mean_free_path": 0.5, "albedo": [0.9, 0.8, 0.7]}}})
    scene = configured_scene(config)
    assert scene.fog == Fog((0.5,) * 3, (0.9, 0.8, 0.7))
    again = checked(tomllib.loads(config.to_toml()))
    assert again == config
    assert configured_scene(checked({})).fog is None
    assert configured_scene(checked({"scene": {"name": "foggy-room"}})).fog == build("foggy-room").fog
    with pytest.raises(UserError, match="mean_free_path: got none, expected metres"):
        checked({"scene": {"fog": {"albedo": 0.5}}})
    with pytest.raises(UserError, match=r"scene\.fog\.mean_free_path: got .-1\.0"):
        configured_scene(checked({"scene": {"fog": {"mean_free_path": -1}}}))
    with pytest.raises(UserError, match=r"foggy-room\.brightness: got 2, expected 0 to 1"):
        build("foggy-room", brightness=2)


def job(**changes: Any) -> Config:
    base: dict[str, Any] = {
        "atlas": {"resolution": 24},
        "points": {"count": 8, "supersample": 1},
        "lightings": {"train": 3, "validation": 1, "test": 1, "kinds": ["point", "rect"]},
        "transport": {"samples": 8, "test_samples": 16, "threads": 2},
    }
    return checked({**base, **{key: {**base.get(key, {}), **value} for key, value in changes.items()}})


@pytest.mark.parametrize(
    ("part", "name"),
    [
        ({"gloss": Gloss(0.3, 1.0)}, "gloss"),
        ({"emission": Emission((1.0, 1.0, 1.0))}, "emission"),
    ],
)
def test_what_is_beside_fog_is_refused_before_anything_is_baked(
    room: Scene, part: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generate, "choose_lightings", None)  # and so before lightings are drawn, too
    other = room.made_of(lambda wall: replace(wall, **part) if wall.name == "red" else wall)
    with pytest.raises(UserError, match=f"got fog beside {name}, which is not simulated yet") as caught:
        ddprt.bake(other, config=job(), out=tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out" / "dataset.json").exists()


def test_others_are_refused_beside_fog_too(room: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "choose_lightings", None)
    fog, few = room.fog, {"points": {"on": "hull"}, "lightings": {"distribution": "around"}}
    with pytest.raises(UserError, match='got "operator", which sees through fog'):
        ddprt.bake(room, config=job(transport={"integrator": "operator"}))
    hair = replace(build("furball", strands=20, subdivisions=1), fog=fog)
    with pytest.raises(UserError, match="got fog beside hair"):
        ddprt.bake(hair, config=job(atlas={"resolution": 48}, **few))
    marble = replace(build("statue-marble", subdivisions=1), fog=fog)
    with pytest.raises(UserError, match=r"got material .marble. with subsurface|got fog beside subsurface"):
        ddprt.bake(marble, config=job(atlas={"resolution": 48}, **few))
    glossy = room.made_of(lambda wall: replace(wall, gloss=Gloss(0.3, 1.0)))
    with pytest.raises(UserError, match="got fog beside gloss"):
        ddprt.irradiance(glossy, LAMP, [[0.28, 0.0, 0.05]], [[0, 1, 0]], samples=2)


def test_lamps_that_fog_swallows_are_told_from_lamps_that_face_away(cornell: Scene) -> None:
    thick = replace(cornell, fog=Fog.of({"mean_free_path": 1e-4}))
    behind = {"type": "directional", "direction": [0, 0, -1], "irradiance": [1, 1, 1]}  # on the back of the back wall
    for lamp, scene, why in (
        (LAMP, thick, "shines, but the fog swallows all of it on the way"),
        (behind, thick, "faces away or is shadowed"),
        (behind, cornell, "faces away or is shadowed"),
    ):
        assert doubt(parse_lighting(lamp), True, scene, Tracer.of(scene)) == f"lights nothing: it {why}"


def test_fog_that_paths_hardly_leave_is_warned_of(room: Scene) -> None:
    def told(bounces: int = -1, **fog: Any) -> str | None:
        return long_in_fog(replace(room, fog=Fog.of(fog)), bounces)

    line = told(mean_free_path=0.001)
    assert line is not None
    assert line.startswith(f"fog: the scene is up to {2 * room.radius / 0.001:.3g} free paths wide")
    assert told(mean_free_path=[9, 9, 0.001], albedo=[0, 0, 1]) is not None
    assert long_in_fog(room, -1) is long_in_fog(replace(room, fog=None), -1) is told(5, mean_free_path=0.001) is None
    assert told(mean_free_path=0.001, albedo=0.9) is None
    with pytest.warns(Doubt, match="which takes long"), pytest.raises(UserError, match="light nothing"):
        ddprt.bake(replace(room, fog=Fog.of({"mean_free_path": 1e-4})), config=job())


# --- bakes ---------------------------------------------------------------------------------------------------------------


def test_a_bake_keeps_its_fog(room: Scene, tmp_path: Path) -> None:
    data = ddprt.bake(room, config=job(), out=tmp_path / "a")
    assert data.description["transport"]["integrator"] == "paths"
    assert ddprt.open_dataset(tmp_path / "a").fog == data.fog == room.fog
    there = ddprt.bake(room, config=job(), out=tmp_path / "a")  # all is there
    np.testing.assert_array_equal(there.maps("indirect", range(5)), data.maps("indirect", range(5)))
    with pytest.raises(UserError, match="holds another dataset"):
        ddprt.bake(force(room, off=["fog"]), config=job(), out=tmp_path / "a")


@pytest.mark.slow  # for the time that JAX takes to begin
def test_a_model_keeps_its_fog_through_save_and_load(room: Scene, tmp_path: Path) -> None:
    model = ddprt.fit(ddprt.bake(room, config=job()), method="mean")
    model.save(tmp_path / "model")
    back = ddprt.load_model(tmp_path / "model")
    assert back.fog == model.fog == room.fog
    np.testing.assert_array_equal(back.measure(LAMP), model.measure(LAMP))
    np.testing.assert_array_equal(back.relight(LAMP), model.relight(LAMP))
    clear = replace(model, fog=None).measure(LAMP)
    lit = clear[:, 0] > 0
    assert (model.measure(LAMP)[lit] < 0.95 * clear[lit]).all()


def test_fog_forced_off_gives_the_bits_of_clear_air(room: Scene, cornell: Scene, tmp_path: Path) -> None:
    for name, scene in (("off", replace(force(room, off=["fog"]), name="cornell")), ("clear", cornell)):
        ddprt.bake(scene, config=job(transport={"integrator": "paths"}), out=tmp_path / name)
    one, other = ({path.name: sha256(path) for path in sorted((tmp_path / name).rglob("*.exr"))} for name in ("off", "clear"))
    assert one == other
    assert len(one) > 10
