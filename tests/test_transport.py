"""Light against closed forms, slow twins, and itself: direct, reference, operator, plan, and the public yardstick."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import oracles
import pytest
from scipy import stats

import ddprt
from ddprt.errors import UserError
from ddprt.lights import Lighting, parse_lighting
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, icosphere, rectangle
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure
from ddprt.transport.openness import open_atlas
from ddprt.transport.operator import Operator
from ddprt.transport.reference import Estimate, on_points, on_texels, trace_reference

CENTRE = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]})
LAMP = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})
SPOT = {
    "type": "spot", "position": [0.4, 0.5, 0.1], "direction": [-0.5, -1, 0.7], "intensity": [2, 1, 0.5], "inner_deg": 15,
    "outer_deg": 40,
}  # fmt: skip
SUN = {"type": "directional", "direction": [0.1, -0.4, 1], "irradiance": [0.5, 1, 2]}


def reference(scene: Scene, atlas: Atlas, lighting: Lighting, samples: int, **settings: Any) -> Estimate:
    tracer = Tracer.of(scene, settings.pop("threads", 0))
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    return trace_reference(tracer, scene, lighting, start, atlas.count, samples, **{"seed": 0, **settings})


@dataclass
class Found:
    indirect: np.ndarray
    bounces: int
    remainder: float
    senders: int


def operator(
    scene: Scene,
    atlas: Atlas,
    direct: np.ndarray,
    samples: int = 128,
    sender_resolution: int = 32,
    seed: int = 0,
    stream: str = "test",
    bounces: int = -1,
    threads: int = 0,
) -> Found:
    """Plain operator, an even number of rays everywhere."""
    made = Operator.of(Tracer.of(scene, threads), atlas, sender_resolution=sender_resolution)
    averaged = np.concatenate([made.averaged(light.astype(np.float32)) for light in direct], 1)
    bounced = made.bounce(averaged, seed=seed, stream=stream, bounces=bounces)
    out = np.zeros(direct.shape, np.float32)
    for _ in made.gather(bounced.radiosity, out, np.full(atlas.count, samples), seed=seed, stream=stream):
        pass
    return Found(out, bounced.bounces, bounced.remainder, made.senders.count)


def mean(atlas: Atlas, values: np.ndarray, variance: np.ndarray | None = None) -> tuple[float, float]:
    """Area-weighted mean of the first channel, and its standard error."""
    weights = atlas.area / atlas.area.sum()
    return float(weights @ values[:, 0]), 0.0 if variance is None else float(np.sqrt(weights**2 @ variance[:, 0]))


# --- the furnace ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("albedo", "samples"), [(0.0, 16), (0.2, 1000), (0.5, 400), (0.9, 360)])
def test_furnace(albedo: float, samples: int) -> None:
    """A closed uniform mesh: mean direct F / A and mean indirect F / A * a / (1 - a), whatever its facets."""
    scene = build("furnace", albedo=albedo, subdivisions=3)
    atlas = build_atlas(scene, 64)
    unit = 4 * np.pi / scene.areas.sum()
    expected = unit * albedo / (1 - albedo)
    found = reference(scene, atlas, CENTRE, samples)
    # Origins stand 7e-6 of the radius nearer to the lamp, so direct light is 1.4e-5 too high; facets vary it by 1 %, over
    # 2200 texels of 16 samples and more: 5e-5.
    assert mean(atlas, found.direct)[0] == pytest.approx(unit, rel=2e-4)
    indirect, error = mean(atlas, found.indirect, found.indirect_variance)
    by_operator = mean(atlas, operator(scene, atlas, found.direct[None]).indirect[0])[0]
    if albedo == 0:
        assert indirect == by_operator == 0
        return
    assert 0 < error < 0.002 * expected
    assert indirect == pytest.approx(expected, rel=0.005)
    assert abs(indirect - expected) < 4 * error
    # Direct light is uniform, so the operator has hardly any noise; it stops with 1e-4 left at most.
    assert by_operator == pytest.approx(expected, rel=3e-4)


@pytest.mark.parametrize("bounces", [1, 2, 5])
def test_forced_bounces_of_the_furnace(bounces: int) -> None:
    scene = build("furnace", albedo=0.9, subdivisions=3)
    atlas = build_atlas(scene, 64)
    expected = 4 * np.pi / scene.areas.sum() * sum(0.9**k for k in range(1, bounces + 1))
    found = reference(scene, atlas, CENTRE, 64, bounces=bounces)
    indirect, error = mean(atlas, found.indirect, found.indirect_variance)
    assert 0 < error < 0.002 * expected
    assert abs(indirect - expected) < 4 * error
    by_operator = operator(scene, atlas, found.direct[None], bounces=bounces)
    assert by_operator.bounces == bounces
    # As above without a remainder; 1e-4 for the noise of facets (1 % over 32 x 32 senders).
    assert mean(atlas, by_operator.indirect[0])[0] == pytest.approx(expected, rel=2e-4)


def test_an_off_centre_lamp_in_a_sphere_lights_it_evenly() -> None:
    """Any two patches of a sphere see each other by 1 / A, so light of one bounce and more is F / A * a / (1 - a) everywhere.

    The mesh has 20480 facets of edge e = 0.035 R. Normals tilt by up to e / 2 from the sphere's, which changes what a point
    gathers by as much, times the share of light that comes from one side; over a facet the tilts cancel, and what is left
    goes with e² = 0.12 %. Twelve regions of some 1700 facets each are compared.
    """
    scene = build("furnace", albedo=0.5, subdivisions=5)
    atlas = build_atlas(scene, 64)
    lamp = parse_lighting({"type": "point", "position": [0.3, -0.2, 0.4], "intensity": [1, 1, 1]})
    found = reference(scene, atlas, lamp, 800)
    by_operator = operator(scene, atlas, found.direct[None], samples=256).indirect[0]
    region = (atlas.position @ icosphere(0)[0].T).argmax(1)
    area = np.bincount(region, atlas.area)
    over = lambda values: np.bincount(region, atlas.area * values[:, 0]) / area  # noqa: E731
    expected = 4 * np.pi / scene.areas.sum()
    assert over(found.direct).max() > 5 * over(found.direct).min()  # the lamp is far from even
    error = np.sqrt(np.bincount(region, atlas.area**2 * found.indirect_variance[:, 0])) / area
    assert error.max() < 0.006 * expected
    assert (np.abs(over(found.indirect) - expected) < 4 * error + 0.0012 * expected).all()
    assert mean(atlas, found.indirect)[0] == pytest.approx(expected, rel=0.005)
    # The operator gathers 256 evenly spread rays for each of 180 texels a region.
    np.testing.assert_allclose(over(by_operator), expected, rtol=0.0025)


# --- plates -----------------------------------------------------------------------------------------------------------


def test_a_lamp_that_fills_a_plate(plates: Scene) -> None:
    """Mean direct light on the other plate is pi L F, F of two unit squares one apart in closed form: 0.19982."""
    factor = 2 / np.pi * (np.log(np.sqrt(4 / 3)) + 2 * np.sqrt(2) * np.arctan(1 / np.sqrt(2)) - np.pi / 2)
    lamp = {"type": "rect", "center": [0, 0, 0], "half_u": [0, 0, 0.5], "half_v": [0.5, 0, 0], "radiance": [3, 3, 3]}
    atlas = build_atlas(plates, 32)
    found = reference(plates, atlas, parse_lighting(lamp), 4000, bounces=0)
    upper = atlas.position[:, 1] > 0.5
    weights = np.where(upper, atlas.area, 0) / atlas.area[upper].sum()
    direct, error = weights @ found.direct[:, 0], np.sqrt(weights**2 @ found.direct_variance[:, 0])
    assert direct == pytest.approx(3 * np.pi * factor, rel=0.005)
    assert 0 < error < 0.001 * direct
    assert abs(direct - 3 * np.pi * factor) < 4 * error + 2e-5 * direct  # origins stand 5e-6 nearer
    assert not found.direct[~upper].any()


def test_perpendicular_squares() -> None:
    """A glowing wall lights the floor it stands on: F = 0.20004 in closed form for unit squares with a common edge.

    By the operator, since shadow rays to a rectangle that touches the receiver have no finite variance.
    """
    floor, wall = rectangle((0.0, 0.0), (1.0, 1.0), 0.0, 1, facing=1), rectangle((0.0, 0.0), (1.0, 1.0), 0.0, 0, facing=1)
    scene = faceted("corner", np.array([floor, wall]), (Material("grey", (0.5,) * 3),))
    atlas = build_atlas(scene, 64)
    standing = np.abs(atlas.geometric_normal[:, 0]) > 0.5
    direct = np.where(standing, 1.0, 0.0)[None, :, None] * np.ones(3)
    gathered = operator(scene, atlas, direct, samples=1024, sender_resolution=64, bounces=1).indirect[0, :, 0]
    down = np.where(~standing, atlas.area, 0) / atlas.area[~standing].sum()
    factor = (2 * np.arctan(1) - np.sqrt(2) * np.arctan(1 / np.sqrt(2)) + 0.25 * np.log(3 / 4)) / np.pi
    # 900 texels of 1024 rays: less than sqrt(F (1 - F) / 920000) / F = 0.2 % even for independent ones.
    assert down @ gathered == pytest.approx(0.5 * factor, rel=0.002)
    assert down @ gathered == pytest.approx(0.5 * 0.20004, rel=0.005)
    assert not gathered[standing].any()  # a flat wall does not see itself


# --- slow twins -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def probes(cornell: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Points anywhere on the surface of the Cornell box."""
    rng = np.random.default_rng(5)
    triangle = rng.choice(len(cornell.areas), 150, p=cornell.areas / cornell.areas.sum())
    weights = rng.dirichlet(np.ones(3), 150)
    return np.einsum("nc,ncd->nd", weights, cornell.corners[triangle]), cornell.geometric_normals[triangle]


@pytest.mark.parametrize("records", [LAMP, parse_lighting(SPOT), parse_lighting(SUN), parse_lighting([*LAMP, SPOT, SUN])])
def test_direct_light_agrees_with_loops(cornell: Scene, probes: tuple[np.ndarray, np.ndarray], records: Lighting) -> None:
    positions, normals = probes
    tracer = Tracer.of(cornell)
    fast = measure(tracer, records, positions, normals, seed=0)
    slow = np.array([oracles.direct_irradiance(cornell, records, p, n) for p, n in zip(positions, normals, strict=True)])
    assert (slow.any(1)).mean() > 0.2
    assert (~slow.any(1)).mean() > 0.1 or len(records) == 3
    # Origins stand 1.6e-6 m off the surface, lamps at least 0.04 m away: four times their ratio for 1/r² and the cosine,
    # relative to the light at a right angle, and float32.
    np.testing.assert_allclose(fast, slow, rtol=2e-4, atol=1e-4)
    np.testing.assert_array_equal(fast.any(1), slow.any(1))


def test_reference_agrees_with_a_path_tracer_of_loops(cornell: Scene) -> None:
    lighting = parse_lighting([*LAMP, SPOT])
    position, normal = np.array([0.15, 0.0, 0.35]), np.array([0.0, 1.0, 0.0])
    paths = oracles.indirect_irradiance(cornell, lighting, position, normal, 2, 1500, np.random.default_rng(0))
    tracer = Tracer.of(cornell)
    fast = trace_reference(
        tracer, cornell, lighting, on_points(tracer, position[None], normal[None]), 1, 100_000, seed=0, bounces=2
    )
    error = np.sqrt(paths.var(0) / len(paths) + fast.indirect_variance[0])
    assert (error < 0.06 * fast.indirect[0]).all()
    assert (np.abs(paths.mean(0) - fast.indirect[0]) < 4 * error).all()
    np.testing.assert_allclose(
        fast.direct[0], oracles.direct_irradiance(cornell, lighting, position, normal), rtol=1e-4
    )  # as above


def test_gather_rows_agree_with_brute_force(cornell: Scene) -> None:
    """One-hot direct light brings out G: which share of a texel's hemisphere sees each sender."""
    atlas = build_atlas(cornell, 32)
    senders = atlas.senders(32 // 8)
    one_hot = (senders.of_texel == np.arange(len(senders.area))[:, None])[..., None] * np.ones(3)
    found = operator(cornell, atlas, one_hot, samples=4096, sender_resolution=8, bounces=1)
    assert found.senders == len(senders.area)
    rows = found.indirect[:, :, 0].T / senders.albedo[:, 0]
    rng = np.random.default_rng(0)
    for texel in (atlas.count // 5, atlas.count // 2):
        pieces = np.flatnonzero(atlas.piece_texel == texel)
        counts = np.zeros(len(senders.area) + 1)  # the last one: nothing, or a back
        for _ in range(1200):
            piece = rng.choice(pieces, p=atlas.piece_area[pieces] / atlas.piece_area[pieces].sum())
            normal = cornell.geometric_normals[atlas.piece_triangle[piece]]
            start = rng.dirichlet(np.ones(3)) @ atlas.piece_corners[piece].astype(float) + atlas.centre
            direction = oracles.cosine_direction(normal, rng)
            triangle, _, u, v = oracles.first_hit(cornell, start + 1e-6 * normal, direction)
            if triangle < 0 or cornell.geometric_normals[triangle] @ direction >= 0:
                counts[-1] += 1
                continue
            column, row = (np.array([1 - u - v, u, v]) @ atlas.uv[triangle] * 32).astype(int)
            counts[senders.of_texel[atlas.slot[row, column]]] += 1  # -1, a texel in a solid, is the last entry
        expected = np.append(rows[texel], max(1 - rows[texel].sum(), 0))
        assert (expected > 0.01).sum() > 5
        # The fast row's own noise (4096 even rays against 1200) is an eighth of the twin's variance at most.
        assert oracles.chi_square(counts, np.where(expected < 1e-6, 0, expected)) > 1e-4


@pytest.fixture(scope="module")
def bare(cornell: Scene) -> Scene:
    """The Cornell box without its blocks."""
    walls = [*range(8), 28, 29]
    return checked(
        "bare", cornell.positions, cornell.triangles[walls], material=cornell.material[walls], materials=cornell.materials
    )


@pytest.mark.parametrize("name", ["bare", "corridor"])
def test_operator_agrees_with_the_reference(name: str, request: pytest.FixtureRequest) -> None:
    """Texel by texel, with both variances, where no sender reaches under a block."""
    scene = request.getfixturevalue(name)
    atlas = build_atlas(scene, 64)
    lamp = LAMP if name == "bare" else parse_lighting({"type": "point", "position": [1, 1.5, 1], "intensity": [1, 1, 1]})
    direct = reference(scene, atlas, lamp, 64, seed=1, bounces=0).direct
    # Path sums are skewed: a low mean comes with a low variance, which would shift z. So the variance is another run's.
    found, other = (reference(scene, atlas, lamp, 400, seed=seed) for seed in (2, 3))
    runs = [
        operator(scene, atlas, direct[None], samples=64, sender_resolution=64, stream=f"run {k}").indirect[0] for k in range(6)
    ]
    by_operator, variance = np.mean(runs, axis=0), np.var(runs, axis=0, ddof=1) / len(runs)
    # The dimmest corners behind the door see light in one path of hundreds: far from normal.
    lit = by_operator[:, 1] > 0.1 * np.median(by_operator[:, 1])
    assert lit.mean() > 0.95
    z = ((by_operator - found.indirect) / np.sqrt(variance + other.indirect_variance))[lit, 1]
    assert abs(z.mean()) < 0.1  # 2000 texels: 0.02 of noise
    assert abs(z.std() - 1) < 0.1
    total, error = mean(atlas, found.indirect, found.indirect_variance)
    assert error < 0.003 * total
    assert mean(atlas, by_operator)[0] == pytest.approx(total, rel=0.01)


def test_operator_on_the_cornell_box(cornell: Scene, cornell_atlas: Atlas) -> None:
    """What lies under the blocks takes no part; texels that reach half under them are judged by their open half."""
    atlas, _ = open_atlas(Tracer.of(cornell), cornell_atlas, cornell)
    found = reference(cornell, atlas, LAMP, 256, seed=2)
    by_operator = operator(cornell, atlas, found.direct[None], sender_resolution=64)
    expected, error = mean(atlas, found.indirect, found.indirect_variance)
    assert error < 0.004 * expected
    assert mean(atlas, by_operator.indirect[0])[0] == pytest.approx(expected, rel=0.01)


def test_sender_bias_falls_with_resolution(cornell: Scene, cornell_atlas: Atlas) -> None:
    """The same rays land in finer and finer senders, so what differs is the light averaged inside them."""
    direct = reference(cornell, cornell_atlas, LAMP, 64, seed=1, bounces=0).direct[None]
    values = {size: operator(cornell, cornell_atlas, direct, sender_resolution=size).indirect for size in (4, 8, 16, 32, 64)}
    bias = [np.sqrt(np.mean((values[size] - values[64]) ** 2)) / values[64].mean() for size in (4, 8, 16, 32)]
    assert bias[0] > bias[1] > bias[2] > bias[3]
    assert bias[3] < 0.1


# --- laws -------------------------------------------------------------------------------------------------------------


def test_bits_do_not_depend_on_the_threads(cornell: Scene, cornell_atlas: Atlas) -> None:
    one, three = (reference(cornell, cornell_atlas, LAMP, 40, threads=threads) for threads in (1, 3))
    for name in ("direct", "indirect", "direct_variance", "indirect_variance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
    single, triple = (operator(cornell, cornell_atlas, one.direct[None], threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(single.indirect, triple.indirect)
    assert single.bounces == triple.bounces


def test_streams_and_seeds_are_independent(cornell: Scene, cornell_atlas: Atlas) -> None:
    direct = reference(cornell, cornell_atlas, LAMP, 8, bounces=0).direct[None]
    runs = [
        operator(cornell, cornell_atlas, direct, seed=seed, stream=stream).indirect
        for seed, stream in ((0, "a"), (0, "b"), (1, "a"))
    ]
    again = operator(cornell, cornell_atlas, direct, seed=0, stream="a").indirect
    np.testing.assert_array_equal(runs[0], again)
    lit = np.all([run[0, :, 0] > 0 for run in runs], axis=0)
    noise = [run[0, lit, 0] / np.mean(runs, axis=0)[0, lit, 0] - 1 for run in runs]
    # Deviations from a mean of three correlate by -1/2 if independent; 2000 texels have a standard error of 0.02, and
    # senders are shared, which spoils it a little.
    for k in range(3):
        assert np.corrcoef(noise[k], noise[k - 1])[0, 1] == pytest.approx(-0.5, abs=0.2)


def test_the_operator_is_linear(cornell: Scene, cornell_atlas: Atlas) -> None:
    """Light adds and scales. The number of bounces is fixed, since the brightest lighting of a batch decides it."""
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 1, cornell_atlas.count, 3)).astype(np.float32)
    batch = operator(cornell, cornell_atlas, np.concatenate([a, b, a + b, 4 * a, 0 * a]), bounces=6).indirect
    # Six products of 700 terms in float32: 1e-6 each.
    np.testing.assert_allclose(batch[2], batch[0] + batch[1], rtol=1e-5)
    np.testing.assert_array_equal(batch[3], 4 * batch[0])
    assert not batch[4].any()
    alone = operator(cornell, cornell_atlas, a, bounces=6).indirect[0]
    np.testing.assert_allclose(alone, batch[0], rtol=1e-5)


def test_the_reference_is_homogeneous_and_additive(cornell: Scene, cornell_atlas: Atlas) -> None:
    once, twice = (reference(cornell, cornell_atlas, tuple(lamp.scaled(f) for lamp in LAMP), 32) for f in (1.0, 2.0))
    np.testing.assert_array_equal(twice.indirect, 2 * once.indirect)
    np.testing.assert_array_equal(twice.direct, 2 * once.direct)
    np.testing.assert_allclose(twice.indirect_variance, 4 * once.indirect_variance, rtol=1e-12)
    spot, both = (reference(cornell, cornell_atlas, parse_lighting(lights), 32) for lights in ([SPOT], [*LAMP, SPOT]))
    total = [mean(cornell_atlas, found.indirect, found.indirect_variance) for found in (once, spot, both)]
    error = np.sqrt(sum(part[1] ** 2 for part in total))
    assert error < 0.02 * total[2][0]
    assert abs(total[0][0] + total[1][0] - total[2][0]) < 4 * error


def test_channels_do_not_mix() -> None:
    points, triangles = icosphere(1)
    scene = checked("room", points, triangles[:, ::-1], materials=(Material("magenta", (0.8, 0.0, 0.4)),))
    _, indirect = ddprt.irradiance(scene, CENTRE, [[0, 0.5, 0]], [[0, 1, 0]], samples=4096)
    assert indirect[0, 1] == 0
    assert indirect[0, 0] > 3 * indirect[0, 2] > 0


def test_no_light_gives_exactly_nothing(cornell: Scene) -> None:
    dark = tuple(lamp.scaled(0.0) for lamp in LAMP)
    assert not np.any(ddprt.irradiance(cornell, dark, [[0.3, 0, 0.3]], [[0, 1, 0]], samples=64))


# --- awkward places ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "position",
    [
        (0.28, 0.3, 0.8),  # behind the back wall
        (0.28, -0.1, 0.28),  # below the floor
        (0.2, 0.1, 0.15),  # inside the short block
    ],
)
def test_light_behind_walls_reaches_nothing(cornell: Scene, cornell_atlas: Atlas, position: tuple[float, float, float]) -> None:
    lamp = parse_lighting({"type": "point", "position": position, "intensity": [1, 1, 1]})
    found = reference(cornell, cornell_atlas, lamp, 64)
    reached = found.direct.any(1) | found.indirect.any(1)
    if position[1] == 0.1:  # the block has no bottom: its lamp lights the floor it stands on, and nothing else
        corners = np.array([[130, 65], [82, 225], [240, 272], [290, 114]]) / 1000
        margin = 1.5 / cornell_atlas.texels_per_metre
        assert (np.abs(cornell_atlas.position[reached, 1]) < 1e-9).all()
        assert (cornell_atlas.position[reached][:, [0, 2]] > corners.min(0) - margin).all()
        assert (cornell_atlas.position[reached][:, [0, 2]] < corners.max(0) + margin).all()
    else:
        assert not reached.any()


def test_backs_block_and_absorb() -> None:
    """A sheet lit from above, with its back to the floor beneath it: the floor gets nothing, by either integrator."""
    floor = rectangle((-0.2, -0.2), (0.2, 0.2), 0.0, 1, facing=1)
    sheet = rectangle((-2.0, -2.0), (2.0, 2.0), 0.5, 1, facing=1)
    scene = faceted("sheet", np.array([floor, sheet]), (Material("white", (0.9,) * 3),))
    lamp = parse_lighting({"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]})
    atlas = build_atlas(scene, 32)
    found = reference(scene, atlas, lamp, 64)
    beneath = atlas.position[:, 1] < 0.1
    assert beneath.any()
    assert found.direct[~beneath].all()
    by_operator = operator(scene, atlas, found.direct[None]).indirect[0]
    assert not found.direct[beneath].any()
    assert not found.indirect.any()
    assert not by_operator.any()


def test_the_next_room_is_lit_through_the_door_alone(corridor: Scene) -> None:
    lamp = {"type": "point", "position": [1.0, 1.25, 0.4], "intensity": [1, 1, 1]}
    # On the far wall: straight on the line through the door, and beside it.
    direct, indirect = ddprt.irradiance(
        corridor, lamp, [[6.0, 1.25, 2.5], [6.0, 1.25, 0.2], [6.0, 2.4, 2.5]], [[-1, 0, 0]] * 3, samples=512
    )
    behind = np.array([oracles.direct_irradiance(corridor, parse_lighting(lamp), np.array(p), np.array([-1.0, 0, 0]))
                       for p in ([6.0, 1.25, 2.5], [6.0, 1.25, 0.2], [6.0, 2.4, 2.5])])  # fmt: skip
    np.testing.assert_allclose(direct, behind, rtol=1e-4)
    assert not direct[1].any()
    assert (indirect > 0).all()


@pytest.mark.parametrize(
    "position",
    [
        (0.0, 0.0, 0.5592),  # a vertex of floor, wall and back
        (0.28, 0.5488, 0.28),  # on the ceiling
        (0.13, 0.165, 0.065),  # a vertex of the short block
        (0.278, 0.2744, 0.2796),  # the scene's centre, where local coordinates are zero
    ],
)
@pytest.mark.parametrize("kind", ["point", "sphere", "rect"])
def test_lights_at_vertices_and_on_surfaces_stay_finite(
    cornell: Scene, kind: str, position: tuple[float, float, float]
) -> None:
    record = {
        "point": {"type": "point", "position": position, "intensity": [1, 1, 1]},
        "sphere": {"type": "sphere", "center": position, "radius": 0.02, "radiance": [1, 1, 1]},
        "rect": {"type": "rect", "center": position, "half_u": [0.1, 0, 0], "half_v": [0, 0, 0.1], "radiance": [1, 1, 1]},
    }[kind]
    places = np.concatenate([cornell.corners[:6].reshape(-1, 3), [position]])
    normals = np.concatenate([np.repeat(cornell.geometric_normals[:6], 3, 0), [[0, 1, 0]]])
    with np.errstate(all="raise", under="ignore"):
        found = ddprt.irradiance(cornell, record, places, normals, samples=64, return_variance=True)
    assert all(np.isfinite(part).all() for part in found)
    assert all((part >= 0).all() for part in found)
    if kind != "rect":
        assert found[1].any()


def test_a_scene_far_away_is_lit_as_here(cornell: Scene) -> None:
    """Rays live about the scene's centre, so a kilometre of offset costs no precision."""
    offset = np.array([1024.0, -2048.0, 512.0])  # exact in float64 for millimetres up to rounding of 2e-13
    far = checked("far", cornell.positions + offset, cornell.triangles, material=cornell.material, materials=cornell.materials)
    place, normal = np.array([[0.4, 0.0, 0.1], [0.1, 0.0, 0.4]]), np.array([[0.0, 1, 0], [0, 1, 0]])
    here = ddprt.irradiance(cornell, LAMP, place, normal, samples=256, return_variance=True)
    there = ddprt.irradiance(
        far, tuple(lamp.translated(offset) for lamp in LAMP), place + offset, normal, samples=256, return_variance=True
    )
    np.testing.assert_allclose(there[0], here[0], rtol=1e-5)
    # The same random numbers take the same ways but for rays that just miss an edge: one path in 256 at most.
    np.testing.assert_allclose(there[1], here[1], rtol=0.02)


# --- the public yardstick ---------------------------------------------------------------------------------------------


def test_irradiance_takes_lists_and_records(cornell: Scene) -> None:
    as_lists = ddprt.irradiance(cornell, LAMP, [[0.3, 0, 0.3]], [[0, 2, 0]], samples=32)
    as_arrays = ddprt.irradiance(
        cornell, [{"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]}],
        np.array([[0.3, 0, 0.3]]), np.array([[0, 1, 0]]), samples=32,
    )  # fmt: skip
    for a, b in zip(as_lists, as_arrays, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.shape == (1, 3)
    assert len(ddprt.irradiance(cornell, LAMP, [[0.3, 0, 0.3]], [[0, 1, 0]], samples=2, return_variance=True)) == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": [0.3, 0, 0.3]}, r"got shapes \(3,\) and \(1, 3\), expected \(points, 3\)"),
        ({"positions": [[0.3, 0]]}, r"got shapes \(1, 2\)"),
        ({"normals": [[0, 1, 0]] * 2}, r"got shapes \(1, 3\) and \(2, 3\)"),
        ({"positions": np.zeros((0, 3)), "normals": np.zeros((0, 3))}, r"got shapes \(0, 3\)"),
        ({"positions": [[np.nan, 0, 0]]}, "not finite"),
        ({"normals": [[0, np.inf, 0]]}, "not finite"),
        ({"normals": [[0, 0, 0]]}, "normal of length 0"),
        ({"samples": 0}, "samples: got 0, expected at least 1"),
        ({"samples": -5}, "samples: got -5"),
        ({"samples": 1, "return_variance": True}, "samples: got 1, expected at least 2"),
        ({"lighting": {"type": "torch"}}, r"lighting\[0\]\.type: got 'torch'"),
    ],
)
def test_bad_probes_get_one_line(cornell: Scene, changes: dict[str, Any], message: str) -> None:
    given = {"lighting": LAMP, "positions": [[0.3, 0, 0.3]], "normals": [[0, 1, 0]], "samples": 4, **changes}
    with pytest.raises(UserError, match=message) as caught:
        ddprt.irradiance(cornell, **given)
    assert "\n" not in str(caught.value)


def test_one_sample_gives_an_estimate(cornell: Scene) -> None:
    direct, indirect = ddprt.irradiance(cornell, LAMP, [[0.3, 0, 0.3]], [[0, 1, 0]], samples=1)
    assert np.isfinite(direct).all()
    assert np.isfinite(indirect).all()


def test_many_samples_are_traced_in_rounds(cornell: Scene) -> None:
    """More than one batch of 2^15 paths at a point: the mean is that of all, and its variance falls with all."""
    few = ddprt.irradiance(cornell, LAMP, [[0.3, 0, 0.5]], [[0, 1, 0]], samples=1 << 14, return_variance=True)
    many = ddprt.irradiance(cornell, LAMP, [[0.3, 0, 0.5]], [[0, 1, 0]], samples=3 << 15, return_variance=True)
    assert (np.abs(few[1] - many[1]) < 4 * np.sqrt(few[3] + many[3])).all()
    first = ddprt.irradiance(cornell, LAMP, [[0.3, 0, 0.5]], [[0, 1, 0]], samples=1 << 15)[1]
    assert (np.abs(first - many[1]) > 1e-6 * first).all()  # the second and third round are not the first again
    np.testing.assert_allclose(many[3] * 6, few[3], rtol=0.25)  # the variance of a variance, heavy-tailed: a few percent


@pytest.mark.parametrize("lamp", ["point", "rect"])
def test_reported_variance_is_that_of_repeated_runs(cornell: Scene, probes: tuple[np.ndarray, np.ndarray], lamp: str) -> None:
    """Scatter over 40 seeds divided by the mean reported variance: chi-square with 39 degrees of freedom per point."""
    lighting: Any = LAMP
    if lamp == "rect":
        lighting = {
            "type": "rect", "center": [0.28, 0.54, 0.28], "half_u": [0.1, 0, 0], "half_v": [0, 0, 0.1], "radiance": [9, 9, 9]
        }  # fmt: skip
    positions, normals = (part[:24] for part in probes)
    runs = [
        ddprt.irradiance(cornell, lighting, positions, normals, samples=512, seed=seed, return_variance=True)
        for seed in range(40)
    ]
    for kind in (0, 1):
        values = np.array([run[kind][:, 1] for run in runs])
        reported = np.mean([run[kind + 2][:, 1] for run in runs], axis=0)
        noisy = reported > 1e-12 * values.mean(0) ** 2
        assert not values[:, ~noisy].std(0).any() or (values[:, ~noisy].std(0) < 1e-5 * values[:, ~noisy].mean(0)).all()
        if kind == 0 and lamp == "point":
            assert not noisy.any()  # nothing is random about direct light from a point
            continue
        assert noisy.sum() > 10
        scatter = ((values - values.mean(0)) ** 2 / np.where(noisy, reported, 1))[:, noisy].sum()
        freedom = 39 * noisy.sum()
        # Means of 512 paths are nearly normal; the excess kurtosis left (some 0.2) widens the law by 5 %.
        assert stats.chi2.cdf(scatter, freedom) > 1e-3
        assert stats.chi2.sf(scatter, freedom) > 1e-3
