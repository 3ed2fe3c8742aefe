"""Direct light in blocks: against loops, closed forms, and itself in other blocks and threads."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import oracles
import pytest
from scipy import stats

from ddprt.lights import Lighting, parse_lighting
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, rectangle
from ddprt.transport import direct
from ddprt.transport.direct import Places, Texels, centred, direct_irradiance, mean_irradiance
from ddprt.transport.embree import Tracer, lifted

POINT = {"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1.0, 0.5, 0.0]}
SPOT = {"type": "spot", "position": [0.4, 0.5, 0.1], "direction": [-0.5, -1, 0.7], "intensity": [2, 1, 0.5], "outer_deg": 50}
SUN = {"type": "directional", "direction": [0.1, -0.4, 1], "irradiance": [0.5, 1, 2]}
RECT = {"type": "rect", "center": [0.28, 0.5, 0.28], "half_u": [0.1, 0, 0], "half_v": [0, 0, 0.1], "radiance": [9, 6, 3]}
BALL = {"type": "sphere", "center": [0.28, 0.4, 0.28], "radius": 0.05, "radiance": [9, 6, 3]}
ALL = parse_lighting([POINT, SPOT, SUN, RECT, BALL])


def samples(scene: Scene, atlas: Atlas, each: int, texels: int) -> tuple[Tracer, np.ndarray, np.ndarray]:
    """Positions and normals of a few samples in some of the texels."""
    tracer = Tracer.of(scene, 2)
    chosen = np.linspace(0, atlas.count - 1, texels).astype(int)
    u = np.random.default_rng(3).random((texels * each, 2), np.float32)
    positions, triangle = atlas.sampler.sample(np.repeat(chosen, each), u)
    return tracer, positions, tracer.normals[triangle]


@pytest.mark.parametrize("records", [[POINT], [SPOT], [SUN], [POINT, SPOT, SUN]])
def test_means_agree_with_loops(cornell: Scene, cornell_atlas: Atlas, records: list[Any]) -> None:
    lighting = parse_lighting(records)
    tracer, positions, normals = samples(cornell, cornell_atlas, 3, 60)
    places = Places.of(tracer, positions, normals, 3)
    fast = mean_irradiance(tracer, centred(tracer, lighting), places, np.random.default_rng(0))
    slow = [
        oracles.direct_irradiance(cornell, lighting, p + tracer.centre, n)
        for p, n in zip(lifted(tracer, positions, normals).astype(np.float64), normals.astype(np.float64), strict=True)
    ]
    mean = np.reshape(slow, (60, 3, 3)).mean(1)
    assert mean.any()
    assert not mean.all()
    # As in test_direct_light_agrees_with_loops; a sample on the very rim of a shadow may go either way.
    close = np.isclose(fast, mean, rtol=2e-4, atol=1e-4).all(1)
    assert close.sum() >= 59


@pytest.fixture
def square() -> Scene:
    """Two metres of floor, facing up, and nothing else."""
    return faceted("floor", np.array([rectangle((-1.0, -1.0), (1.0, 1.0), 0.0, 1, facing=1)]), (Material("grey", (0.5,) * 3),))


@pytest.fixture
def floor(square: Scene) -> Tracer:
    return Tracer.of(square, 1)


@pytest.fixture
def texels(square: Scene) -> Atlas:
    return build_atlas(square, 32, 2)


AREA = {
    "rect": {"type": "rect", "center": [0.1, 0.8, 0], "half_u": [0.3, 0, 0], "half_v": [0, 0, 0.2], "radiance": [3, 3, 3]},
    "sphere": {"type": "sphere", "center": [0.1, 0.8, 0], "radius": 0.3, "radiance": [3, 3, 3]},
}


@pytest.mark.parametrize("kind", AREA)
@pytest.mark.parametrize("each", [1, 4, 64])
def test_groups_are_unbiased_and_quieter_than_chance(floor: Tracer, kind: str, each: int) -> None:
    """5000 groups at one point: their mean is the closed form, and their scatter less than that of independent samples."""
    lighting, groups = parse_lighting(AREA[kind]), 5000
    positions, normals = np.zeros((groups * each, 3), np.float32), np.tile(np.float32([0, 1, 0]), (groups * each, 1))
    if kind == "rect":
        corners = np.array([[0.1 + 0.3 * a, 0.8, 0.2 * b] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        expected = oracles.polygon_irradiance(corners, 3.0, np.zeros(3), np.array([0.0, 1, 0]))
    else:
        expected = np.pi * 3 * 0.3**2 / 0.65 * 0.8 / np.sqrt(0.65)
    places = Places.of(floor, positions, normals, each)
    found = mean_irradiance(floor, lighting, places, np.random.default_rng(7))[:, 0].astype(np.float64)
    error = found.std() / np.sqrt(groups)
    assert 0 < error < 0.01 * expected
    assert abs(found.mean() - expected) < 4 * error + 1e-5 * expected  # origins stand 6e-6 m nearer
    u = np.random.default_rng(8).random((1, groups, 2), np.float32)
    single = direct_irradiance(floor, lighting, positions[:groups], normals[:groups], u)[:, 0]
    if each > 1:
        assert found.std() < 0.8 * single.std() / np.sqrt(each)
    else:
        assert found.std() == pytest.approx(single.std(), rel=0.05)


def solid_angle(height: float, x: float, z: float) -> float:
    """Of the floor's two metres from a point above it: four rectangles that meet below the point."""
    corners = [(a, b) for a in (1 - x, 1 + x) for b in (1 - z, 1 + z)]
    return float(sum(np.arctan(a * b / (height * np.sqrt(a * a + b * b + height * height))) for a, b in corners))


@pytest.mark.parametrize(("height", "share"), [(0.2, 0.8), (0.05, 1 / 8), (0.02, 1 / 8)])
def test_a_lamp_near_its_texels_loses_no_light(floor: Tracer, texels: Atlas, height: float, share: float) -> None:
    """All light that leaves towards the floor arrives: I times its solid angle, by 40 draws of places."""
    lighting, seeds = parse_lighting({"type": "point", "position": [0.31, height, -0.17], "intensity": [2, 2, 2]}), range(40)
    assert height < 5 * np.sqrt(texels.area.mean()), "a texel is 7 cm wide"
    power, coarse = np.zeros(40), np.zeros(40)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        places = Texels.of(floor, texels, 4, rng)
        light = mean_irradiance(floor, centred(floor, lighting), places.places, np.random.default_rng(seed))
        fine = places.irradiance(lighting, np.random.default_rng(seed))
        away = np.linalg.norm(texels.position - lighting[0].anchor(), axis=1) > 4 * np.sqrt(texels.area)
        np.testing.assert_array_equal(fine[away], light[away])
        power[seed], coarse[seed] = texels.area @ fine[:, 0].astype(np.float64), texels.area @ light[:, 0].astype(np.float64)
    expected, error = 2 * solid_angle(height, 0.31, -0.17), power.std() / np.sqrt(40)
    # Origins of rays stand 6e-6 m nearer than the floor, which is that share of the height at most.
    assert abs(power.mean() - expected) < 4 * error + 6e-6 / height * expected
    # Sixteen times the places at least, whose error falls nearly as their number does; at 0.2 m, three widths, most of it
    # comes from texels that are further than four.
    assert power.std() < share * coarse.std()


def test_lamps_far_from_all_texels_cost_nothing(floor: Tracer, texels: Atlas) -> None:
    lighting = parse_lighting([{"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]}, SUN])
    places, rng = Texels.of(floor, texels, 4, np.random.default_rng(0)), np.random.default_rng(1)
    before = floor.rays
    places.irradiance(lighting, rng)
    assert floor.rays - before <= 2 * 4 * texels.count
    assert rng.random() == np.random.default_rng(1).random(), "nothing was drawn"


def test_light_of_near_lamps_adds_up(floor: Tracer, texels: Atlas) -> None:
    """Whatever other lamps there are, and whichever lighting they are in: to the rounding of a sum."""
    near, far = {**POINT, "position": [0.3, 0.03, 0]}, {**POINT, "position": [-0.5, 0.2, 0.1]}
    places = Texels.of(floor, texels, 4, np.random.default_rng(0))
    both, one, other = (
        places.irradiance(parse_lighting(lamps), np.random.default_rng(seed))
        for seed, lamps in enumerate(([near, far], [near], [far]))
    )
    np.testing.assert_allclose(both, one + other, rtol=2 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("each", [1, 4, 7, 64])
def test_shifted_numbers_agree_with_loops_and_are_uniform(each: int) -> None:
    words = np.random.default_rng(0).integers(0, 1 << 32, (4000, 2), np.uint32)
    words[:2] = 0, (1 << 32) - 1
    sequence, u = direct._lattice(each), np.zeros((2, 3000 * each), np.float32)
    direct._shifted(words, sequence, 1000 * each, u)
    slow = np.zeros_like(u, np.float64)
    for axis in range(2):
        for i in range(3000 * each):
            slow[axis, i] = (words[1000 + i // each, axis] // 256 / 2**24 + float(sequence[axis, i % each])) % 1
    away = np.abs(u - slow)
    assert np.minimum(away, 1 - away).max() < 1e-6  # the sum may round up to the next turn
    assert 0 <= u.min() < u.max() < 1
    for j in range(each):
        cells = (16 * u[:, j::each]).astype(int)
        assert oracles.chi_square(np.bincount(cells[0] * 16 + cells[1], minlength=256), np.ones(256)) > 1e-4
    tail = np.full((2, 2 * each), -1, np.float32)
    direct._shifted(words, sequence, 3999 * each, tail)  # a last block that is half full
    assert (tail[:, :each] >= 0).all()
    assert (tail[:, each:] == -1).all()


def test_sequence_fills_the_square_evenly() -> None:
    for count in (4, 16, 64):
        assert stats.qmc.discrepancy(direct._sequence(count).T, method="L2-star") < 0.7 / count**0.75


def test_places_and_parts_of_a_light_do_not_move_in_step() -> None:
    """All four numbers of a sample together: wrap-around discrepancy, squared, falls faster than that of chance.

    The mean over independent points is ((3/2)^4 - (4/3)^4) / count (Hickernell 1998). One sequence for both would give 1.2
    times the bound at 8 points, 7 times at 64.
    """
    for count in (8, 16, 64, 256):
        points = np.concatenate([direct._sequence(count), direct._lattice(count)]).T
        chance = ((3 / 2) ** 4 - (4 / 3) ** 4) / count
        assert stats.qmc.discrepancy(points, method="WD") < chance / np.sqrt(count)


@pytest.mark.parametrize("block", [64, 1000, 1 << 14])
def test_blocks_do_not_show(cornell: Scene, cornell_atlas: Atlas, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tracer, positions, normals = samples(cornell, cornell_atlas, 5, 441)
    lights = centred(tracer, ALL)
    u = np.random.default_rng(1).random((len(lights), len(positions), 2), np.float32)

    def shade() -> Iterator[np.ndarray]:
        places = Places.of(tracer, positions, normals, 5)
        assert places.blocks.shape[0] * places.blocks.shape[2] >= len(positions)
        assert places.blocks.shape[2] % 5 == 0
        yield mean_irradiance(tracer, lights, places, np.random.default_rng(0))
        yield direct_irradiance(tracer, lights, positions, normals, u)

    whole = list(shade())
    monkeypatch.setattr(direct, "BLOCK", block)
    for one, other in zip(whole, shade(), strict=True):
        assert one.any()
        np.testing.assert_array_equal(one, other)


def test_bits_do_not_depend_on_the_threads(cornell: Scene, cornell_atlas: Atlas) -> None:
    _, positions, normals = samples(cornell, cornell_atlas, 4, 2000)
    results = []
    for threads in (1, 3):
        tracer = Tracer.of(cornell, threads)
        places, lights = Places.of(tracer, positions, normals, 4), centred(tracer, ALL)
        work = lambda seed: mean_irradiance(tracer, lights, places, np.random.default_rng(seed))  # noqa: B023, E731
        results.append(np.stack(list(tracer.map(work, range(6)))))
    np.testing.assert_array_equal(*results)
    assert len(np.unique(results[0][:, results[0].any((0, 2)), 0][:, 0])) > 1


@pytest.mark.parametrize(("records", "draws"), [([POINT, SPOT, SUN], False), ([POINT, RECT], True), ([BALL], True)])
def test_only_lights_with_size_draw_numbers(floor: Tracer, records: list[Any], draws: bool) -> None:
    rng = np.random.default_rng(0)
    before = str(rng.bit_generator.state)
    places = Places.of(floor, np.zeros((8, 3), np.float32), np.tile(np.float32([0, 1, 0]), (8, 1)), 4)
    mean_irradiance(floor, parse_lighting(records), places, rng)
    assert (str(rng.bit_generator.state) != before) is draws


def shade(tracer: Tracer, lighting: Lighting, positions: Any) -> np.ndarray:
    place, up = np.array(positions, np.float32), np.tile(np.float32([0, 1, 0]), (len(positions), 1))
    return direct_irradiance(tracer, lighting, place, up, np.zeros((len(lighting), len(place), 2), np.float32))


def test_no_points_no_light(floor: Tracer) -> None:
    assert shade(floor, ALL, np.zeros((0, 3))).shape == (0, 3)
    assert floor.rays == 0


def test_too_much_light_is_infinite_and_shadows_stay_black() -> None:
    """Silently: what is not finite is refused where light is stored."""
    low, high = (rectangle((-s, -s), (s, s), y, 1, facing=1) for s, y in ((1.0, 0.0), (0.25, 0.5)))
    tracer = Tracer.of(faceted("table", np.array([low, high]), (Material("grey", (0.5,) * 3),)), 1)
    lamp = parse_lighting({"type": "point", "position": [0, 0.50001, 0], "intensity": [1e30, 1e30, 0]})
    with np.errstate(all="raise", under="ignore"):
        found = shade(tracer, centred(tracer, lamp), np.array([[0, 0.5, 0], [0.1, 0, 0], [0.2, 0.5, 0]]) - tracer.centre)
    np.testing.assert_array_equal(found[:2], [[np.inf, np.inf, 0], [0, 0, 0]])
    assert 1e25 < found[2, 0] < 1e28


def test_lamps_that_shine_on_nothing_cost_no_ray(floor: Tracer) -> None:
    below = parse_lighting({**POINT, "position": [0, -1, 0]})
    dark = parse_lighting({**POINT, "intensity": [0, 0, 0]})
    assert not shade(floor, (*below, *dark), np.zeros((5, 3))).any()
    assert floor.rays == 0
    assert shade(floor, parse_lighting(POINT), np.zeros((5, 3))).any()
    assert floor.rays == 5


@pytest.mark.parametrize(("offsets", "lit"), [(-3.0, True), (0.5, True), (5.0, False)])
def test_rays_stop_short_of_what_a_lamp_is_fixed_to(offsets: float, lit: bool) -> None:
    """A lamp on a ceiling, or in it by half the offset, shines; one behind it does not."""
    below, above = (rectangle((-1.0, -1.0), (1.0, 1.0), y, 1, facing=f) for y, f in ((0.0, 1), (1.0, -1)))
    tracer = Tracer.of(faceted("room", np.array([below, above]), (Material("grey", (0.5,) * 3),)), 1)
    lamp = parse_lighting({**POINT, "position": [0, 1 + offsets * float(tracer.offset), 0]})
    found = shade(tracer, centred(tracer, lamp), [[0.3, -0.5, 0.1], [0, -0.5, 0]])
    assert found.any(1).tolist() == [lit, lit]
