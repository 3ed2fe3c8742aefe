"""Random walks against closed forms: furnaces, half-spaces, slabs; samplers by chi-square; reciprocity."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import cKDTree
from scipy.stats import chi2

from ddprt import warp
from ddprt.scene.material import Subsurface
from ddprt.scene.shapes import box, icosphere
from ddprt.transport.diffusion import decay_rate, depths, weight_of_jump
from ddprt.transport.meetings import invert_flight, invert_henyey, pdf_flight, pdf_henyey, sample_flight, sample_henyey
from ddprt.transport.random_walk import Body, Exits, _free, drawn
from ddprt.transport.refraction import entered, fresnel, mean_entering

OFFSET = 1e-6
"""Metres, for bodies of a metre."""

WALKS = 16_000


def ball(subdivisions: int = 2) -> np.ndarray:
    points, triangles = icosphere(subdivisions)
    return points[triangles].astype(np.float32)


def slab(thickness: float, width: float) -> np.ndarray:
    """Its upper side at y = 0."""
    return _cut(box(np.array([-width / 2, -thickness, -width / 2]), np.array([width / 2, 0.0, width / 2])))


def _cut(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.float32)


def on_top(count: int) -> np.ndarray:
    return np.tile(np.array([0, -OFFSET, 0], np.float32), (count, 1))


def from_everywhere(corners: np.ndarray, index: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Places all over a body, directions of light that enters there from everywhere, and the share that does."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    at = warp.sample_triangle(rng.random((count, 2), np.float32))
    normals = (cross / area[:, None])[chosen].astype(np.float32)
    outwards = warp.to_world(warp.sample_cosine(rng.random((count, 2), np.float32)), warp.frame(normals))
    inwards, share = entered(outwards, normals, index)
    return a + at[:, :1] * (b - a) + at[:, 1:] * (c - a) - np.float32(OFFSET) * normals, inwards, share


def through(
    medium: Subsurface, corners: np.ndarray, seed: int = 0, *, count: int = WALKS, jumps: bool = True
) -> tuple[Exits, np.ndarray]:
    rng = np.random.default_rng(seed)
    places, inwards, share = from_everywhere(corners, medium.index, count, rng)
    body = Body.of(medium, corners, OFFSET, jumps=jumps)
    return body.walk(places, inwards, np.repeat(share[:, None], 3, 1), rng), share


def straight(
    medium: Subsurface, corners: np.ndarray, cosine: float, seed: int, count: int = WALKS, *, jumps: bool = True
) -> Exits:
    """Light that enters the top of a slab at an angle, unbent."""
    rng = np.random.default_rng(seed)
    towards = np.tile(np.array([(1 - cosine**2) ** 0.5, -cosine, 0], np.float32), (count, 1))
    return Body.of(medium, corners, OFFSET, jumps=jumps).walk(on_top(count), towards, np.ones((count, 3), np.float32), rng)


def share_of(exits: Exits, chosen: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean weight of all walks that left somewhere, and its standard error."""
    weight = np.zeros((count, 3))
    weight[exits.owner[chosen]] = exits.weight[chosen]
    return weight.mean(0), weight.std(0) / count**0.5


# --- samplers ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [-0.7, 0.0, 0.4, 0.9])
def test_angles_of_scattering_are_henyey_and_greensteins(g: float) -> None:
    drawn = sample_henyey(np.random.default_rng(3).random(20_000), g)
    edges = np.linspace(-1, 1, 33)
    density = lambda cosine: float(pdf_henyey(np.array([cosine]), g)[0])  # noqa: E731
    expected = 2 * np.pi * np.array([quad(density, *ends)[0] for ends in pairwise(edges)])
    assert expected.sum() == pytest.approx(1, abs=1e-6)
    assert drawn.mean() == pytest.approx(g, abs=5 / 20_000**0.5)
    kept = expected * len(drawn) > 5
    found = np.histogram(drawn, edges)[0]
    statistic = ((found - expected * len(drawn))[kept] ** 2 / (expected * len(drawn))[kept]).sum()
    assert statistic < chi2.ppf(1 - 1e-4, kept.sum())
    u = np.linspace(0.02, 0.98, 25)
    # Single precision: a cosine's rounding of 1e-7 is one of u that is the density times as large, 95 at g = 0.9.
    np.testing.assert_allclose(invert_henyey(sample_henyey(u, g), g), u, atol=3e-5)


@pytest.mark.parametrize("extinction", [0.25, 40.0])
def test_flights_by_chi_square(extinction: float) -> None:
    """Drawn with the walks' own numbers: 31 bins of a length of a tenth of the mean each, and the rest."""
    state = np.random.default_rng(8).integers(0, 1 << 64, 20_000, np.uint64)
    numbers = np.array([drawn(state, i) for i in range(len(state))])
    lengths = sample_flight(numbers, extinction)
    edges = np.append(np.arange(32) / 10 / extinction, np.inf)
    expected = np.array([quad(lambda t: float(pdf_flight(np.array([t]), extinction)[0]), *ends)[0] for ends in pairwise(edges)])
    assert expected.sum() == pytest.approx(1, abs=1e-6)
    found = np.histogram(lengths, edges)[0]
    assert found.sum() == len(lengths)
    assert ((found - expected * len(lengths)) ** 2 / (expected * len(lengths))).sum() < chi2.ppf(1 - 1e-4, len(expected) - 1)
    # Numbers are multiples of 2^-24, and single precision rounds 1 - u and the logarithm by as much.
    np.testing.assert_allclose(invert_flight(lengths, extinction), numbers, atol=3e-7)


def test_free_paths_fall_off_as_beer_and_lambert_say() -> None:
    """A medium that swallows all it meets, channels that share their flights: what crosses a slab is exp(-thickness / l)."""
    lengths, thickness = np.array([0.4, 0.2, 0.1]), 0.3
    medium = Subsurface((0.0, 0.0, 0.0), tuple(lengths.tolist()))
    for cosine in (1.0, 0.5):
        exits = straight(medium, slab(thickness, 50.0), cosine, 1)
        mean, error = share_of(exits, exits.direction[:, 1] < 0, WALKS)
        np.testing.assert_array_less(np.abs(mean - np.exp(-thickness / cosine / lengths)), 4 * error)
        assert (exits.weight.sum(1) <= 3.0001).all()


# --- furnaces ------------------------------------------------------------------------------------------------------------

WHITE = {
    "three free paths": Subsurface((1.0, 1.0, 1.0), (0.5, 0.25, 0.1)),
    "forwards": Subsurface((1.0, 1.0, 1.0), (0.1, 0.1, 0.1), 0.8),
    "refractive": Subsurface((1.0, 1.0, 1.0), (0.2, 0.2, 0.2), 0.0, 1.5),
    "thick": Subsurface((1.0, 1.0, 1.0), (0.02, 0.02, 0.02), 0.5, 1.3),
}


@pytest.mark.parametrize("name", WHITE)
def test_a_white_body_gives_back_all_light_that_enters(name: str) -> None:
    """With one free path every walk keeps its weight; with three, weights of a channel vary, and their sum never does."""
    exits, share = through(WHITE[name], ball())
    assert exits.lost <= 1e-4 * WALKS
    entering = share.sum(dtype=np.float64)
    if name == "three free paths":
        assert exits.weight.sum() == pytest.approx(3 * entering, rel=1e-4)
        error = np.array([exits.weight[:, channel].std() for channel in range(3)]) * WALKS**0.5 / entering
        assert error.max() < 0.02
        np.testing.assert_array_less(np.abs(exits.weight.sum(0, dtype=np.float64) / entering - 1), 4 * error)
    else:
        # Roulette plays for weights below 1/6, which walks have that enter flat through a refractive surface.
        np.testing.assert_allclose(exits.weight.sum(0, dtype=np.float64) / entering, 1, atol=1e-3)
    assert share.mean() == pytest.approx(mean_entering(WHITE[name].index), abs=0.005)


def test_light_from_everywhere_leaves_a_white_body_everywhere_alike() -> None:
    """The furnace as a distribution: radiance in equilibrium is even, so exits are even over the area and cosine-weighted."""
    corners = ball()
    exits, _ = through(Subsurface((1.0, 1.0, 1.0), (0.05, 0.05, 0.05), 0.6, 1.3), corners)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    expected = area / area.sum() * exits.weight[:, 0].sum()
    found = np.bincount(exits.triangle, exits.weight[:, 0], len(area))
    assert ((found - expected) ** 2 / expected).sum() < chi2.ppf(1 - 1e-4, len(area))
    cosine = np.einsum("nd,nd->n", exits.direction, cross[exits.triangle] / area[exits.triangle, None])
    passed = 1 - fresnel(np.linspace(0.025, 0.975, 20) ** 0.5, np.sqrt(1 - (1 - np.linspace(0.025, 0.975, 20)) / 1.3**2), 1.3)
    binned = np.histogram(cosine**2, 20, (0, 1), weights=exits.weight[:, 0])[0]
    assert np.corrcoef(binned, passed)[0, 1] > 0.9
    # Squares of cosines are even but for what is reflected inside; bins of 1/20 blur the steep end by less than 2 %.
    whole = passed / passed.sum() * binned.sum()
    assert (((binned - whole)[1:] / whole[1:]) ** 2).mean() ** 0.5 < 0.05


# --- half-space and slab -------------------------------------------------------------------------------------------------


def h_function(albedo: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chandrasekhar's H for even scattering, by iterating 1/H(m) = sqrt(1 - a) + a/2 integral of n H(n) / (m + n).

    Returns:
      Nodes on (0, 1), their weights, H there.
    """
    nodes, weights = np.polynomial.legendre.leggauss(128)
    nodes, weights = (nodes + 1) / 2, weights / 2
    found = np.ones_like(nodes)
    for _ in range(3000):
        kernel = (weights * nodes * found) / (nodes[:, None] + nodes)
        fresh = 1 / ((1 - albedo) ** 0.5 + albedo / 2 * kernel.sum(1))
        if np.abs(fresh - found).max() < 1e-12:
            break
        found = fresh
    return nodes, weights, found


@pytest.mark.parametrize("cosine", [1.0, 0.3])
def test_a_half_space_sends_back_what_chandrasekhar_says(cosine: float) -> None:
    """Light at an angle: 1 - H(m) sqrt(1 - a), for three albedos at once. 60 free paths let nothing of 0.9 through."""
    albedos = np.array([0.5, 0.8, 0.9])
    medium = Subsurface(tuple(albedos.tolist()), (0.1, 0.1, 0.1))
    exits = straight(medium, slab(6.0, 400.0), cosine, 5)
    mean, error = share_of(exits, exits.direction[:, 1] > 0, WALKS)
    for channel, albedo in enumerate(albedos):
        nodes, _, h = h_function(albedo)
        at = 1 / ((1 - albedo) ** 0.5 + albedo / 2 * np.sum(_weights() * nodes * h / (cosine + nodes)))
        assert mean[channel] == pytest.approx(1 - at * (1 - albedo) ** 0.5, abs=4 * error[channel])


def _weights() -> np.ndarray:
    return np.polynomial.legendre.leggauss(128)[1] / 2


def test_thick_albedo_is_that_of_light_from_everywhere() -> None:
    """The material's own closed form, van de Hulst's fit, against the H-function: within what it says of itself."""
    for albedo in (0.3, 0.9, 0.99, 0.999):
        nodes, weights, h = h_function(albedo)
        exact = 2 * np.sum(weights * nodes * (1 - h * (1 - albedo) ** 0.5))
        given = Subsurface((albedo,) * 3, (0.1,) * 3).thick_albedo[0]
        assert given == pytest.approx(exact, abs=0.01)


def test_a_thin_slab_scatters_once() -> None:
    """Of light that falls straight on 0.01 free paths, a t / 2 goes back: t² log t / 2, some 0.0003, from second meetings."""
    thickness = 0.01
    medium = Subsurface((0.8, 0.5, 0.2), (1.0, 1.0, 1.0))
    count = 200_000
    exits = straight(medium, slab(thickness, 50.0), 1.0, 7, count)
    back, error = share_of(exits, exits.direction[:, 1] > 0, count)
    np.testing.assert_allclose(back, np.array(medium.albedo) * thickness / 2, atol=float(4 * error.max() + 3e-4))
    on, _ = share_of(exits, exits.direction[:, 1] < 0, count)
    assert on[0] > 1 - thickness


@pytest.mark.parametrize("jumps", [True, False])
def test_a_thick_white_slab_lets_through_what_diffusion_says(jumps: bool) -> None:
    """White and 20 free paths thick, light from everywhere: T = (4/3) / (t + 2 * 0.7104), exact up to exp(-t)."""
    count, thickness = 40_000 if jumps else 20_000, 1.0
    medium = Subsurface((1.0, 1.0, 1.0), (0.05, 0.05, 0.05))
    corners = slab(thickness, 60.0)
    rng = np.random.default_rng(11)
    towards = warp.sample_cosine(rng.random((count, 2), np.float32))[:, [0, 2, 1]] * np.array([1, -1, 1], np.float32)
    body = Body.of(medium, corners, OFFSET, jumps=jumps)
    exits = body.walk(on_top(count), np.ascontiguousarray(towards), np.ones((count, 3), np.float32), rng)
    mean, error = share_of(exits, exits.direction[:, 1] < 0, count)
    assert mean[0] == pytest.approx(4 / 3 / (20 + 2 * 0.7104), abs=float(4 * error[0]))


# --- jumps ---------------------------------------------------------------------------------------------------------------


def test_jumps_and_the_similar_medium_change_no_energy() -> None:
    """Forward scattering, three albedos: every step against jumps in a thick ball."""
    medium = Subsurface((1.0, 0.999, 0.99), (0.015, 0.015, 0.015), 0.7)
    (quick, share), (slow, other) = (through(medium, ball(), seed, jumps=jumps) for seed, jumps in ((1, True), (2, False)))
    assert quick.rays < slow.rays
    for channel in range(3):
        one, two = (e.weight[:, channel].astype(np.float64) for e in (quick, slow))
        a, b = one.sum() / share.sum(), two.sum() / other.sum()
        error = np.hypot(one.std(), two.std()) / WALKS**0.5
        assert a == pytest.approx(b, abs=4 * error + 1e-4)


def test_a_jump_weighs_what_walks_lose() -> None:
    """Walks from the middle of a ball of five free paths, every step, against x / sinh x: 5e-4 of it, and noise."""
    albedos = (0.999, 0.99, 0.98)
    rng = np.random.default_rng(4)
    body = Body.of(Subsurface(albedos, (0.2, 0.2, 0.2)), ball(4), OFFSET, jumps=False)
    towards = warp.sample_sphere(rng.random((40_000, 2), np.float32))
    exits = body.walk(np.zeros((40_000, 3), np.float32), towards, np.ones((40_000, 3), np.float32), rng)
    mean, error = share_of(exits, np.arange(len(exits.owner)), 40_000)
    for channel, albedo in enumerate(albedos):
        # Facets of 1280 * 4 triangles stand up to 0.2 % inside the ball: as much of the loss.
        expected = weight_of_jump(1.0, 5.0, albedo)
        assert mean[channel] == pytest.approx(expected, abs=4 * error[channel] + 5e-3 * (1 - expected))


def test_decay_is_the_root_of_its_equation() -> None:
    for albedo in (0.5, 0.9, 0.999):
        k = decay_rate(albedo)
        assert albedo * np.arctanh(k) / k == pytest.approx(1, abs=1e-9)
    assert decay_rate(1.0) == 0
    assert decay_rate(0.9999) == pytest.approx((3 * 1e-4) ** 0.5, rel=1e-3)  # diffusion's limit


def test_depths_are_exact_near_the_surface_and_lower_bounds_elsewhere() -> None:
    """In a cube, where distances are known; inside they are short by no more than what counts as the surface may be off."""
    corners = _cut(box(np.full(3, -1.0), np.full(3, 1.0)))
    squared, cell = depths(corners, np.full(3, -1.0), np.full(3, 1.0), 0.1)
    place = (np.stack(np.meshgrid(*(np.arange(n) for n in squared.shape), indexing="ij"), -1) + 0.5) * cell - 1
    exact, found = (1 - np.abs(place)).min(-1), np.sqrt(squared)
    inside, close = exact > 0, (exact > 0) & (exact < 4 * cell)
    assert (found <= np.abs(exact) + 1e-6)[inside].all()
    np.testing.assert_allclose(found[close], exact[close], atol=1e-6)
    assert (exact - found)[inside].max() < 2 * cell * (3**0.5 / 2 + 0.5 / 3**0.5)
    assert found.max() > 0.7


def test_what_lies_free_about_a_walk_is_never_too_much_and_hardly_too_little() -> None:
    """In a body with dents, by all of its surface; in a slab, where what lies along it is lost: half a cell's square."""
    hollow = ball(3)
    hollow *= np.float32(1) - np.float32(0.6) * np.exp(-8 * (hollow[..., :1] - 0.8) ** 2)
    rng = np.random.default_rng(2)
    body = Body.of(Subsurface((1.0, 1.0, 1.0), (0.05, 0.05, 0.05)), hollow, OFFSET)
    chosen = hollow[rng.integers(len(hollow), size=200)]
    place = (rng.dirichlet((1, 1, 1), 200)[:, :, None] * chosen).sum(1) * rng.uniform(0.7, 1, (200, 1))
    weights = np.stack([np.r_[a, 1 - sum(a)] for a in ((i / 12, j / 12) for i in range(13) for j in range(13 - i))])
    dense = np.einsum("kc,tcd->tkd", weights, hollow).reshape(-1, 3)
    exact = cKDTree(dense).query(place)[0]  # of points 0.012 apart: too far by less than 0.007 squared over twice the distance
    found = np.array([free_at(body, one) for one in place])
    assert (found <= exact + 1e-6).all()
    flat = slab(1.0, 8.0)
    body = Body.of(Subsurface((1.0, 1.0, 1.0), (0.05, 0.05, 0.05)), flat, OFFSET)
    place = np.stack([rng.uniform(-1, 1, 200), -rng.uniform(0, 3 * body.cell, 200), rng.uniform(-1, 1, 200)], 1)
    found = np.array([free_at(body, one) for one in place])
    assert (found <= -place[:, 1] + 1e-6).all()
    # Along each of two axes the spread is f (1 - f) of a cell squared, a quarter at most; and 1e-5 for rounding, which doubles.
    assert (found**2 >= place[:, 1] ** 2 - (0.5 + 1e-4) * body.cell**2).all()
    assert free_at(body, np.array([0, 1.0, 0])) == 0


def free_at(body: Body, place: np.ndarray) -> float:
    return float(_free(*place.astype(np.float32), body.depth, body.low, np.float32(body.cell)))


# --- reciprocity ---------------------------------------------------------------------------------------------------------


def test_as_much_light_goes_there_as_comes_back() -> None:
    """From the ball's north to its equator and back: the operator's rows are found backwards, so they must agree."""
    medium = Subsurface((0.99, 0.9, 0.5), (0.3, 0.2, 0.15), 0.4, 1.4)
    corners = ball(3)
    rng = np.random.default_rng(9)
    count = 100_000
    places, inwards, share = from_everywhere(corners, medium.index, count, rng)
    exits = Body.of(medium, corners, OFFSET).walk(places, inwards, np.repeat(share[:, None], 3, 1), rng)
    begin, end = places[exits.owner], corners[exits.triangle].mean(1)
    north, side = (lambda at: at[:, 1] > 0.6), (lambda at: (np.abs(at[:, 1]) < 0.3) & (at[:, 0] > 0))
    for channel in range(3):
        ways = [exits.weight[first(begin) & then(end), channel] for first, then in ((north, side), (side, north))]
        one, two = (way.sum(dtype=np.float64) for way in ways)
        error = sum((way.astype(np.float64) ** 2).sum() for way in ways) ** 0.5
        assert error < 0.3 * one
        assert abs(one - two) < 4 * error


def test_fresnel_and_snell() -> None:
    """Normal incidence ((n - 1) / (n + 1))², grazing all, Brewster's angle half of what is polarised across; n sin = sin."""
    one = np.array([1.0])
    assert fresnel(one, one, 1.5)[0] == pytest.approx(0.04)
    assert fresnel(np.array([1e-9]), np.array([(1 - 1 / 2.25) ** 0.5]), 1.5)[0] == pytest.approx(1, abs=1e-6)
    cosine = 1 / (1 + 1.5**2) ** 0.5
    inner = (1 - (1 - cosine**2) / 2.25) ** 0.5
    assert 2 * fresnel(np.array([cosine]), np.array([inner]), 1.5)[0] == pytest.approx(
        ((cosine - 1.5 * inner) / (cosine + 1.5 * inner)) ** 2
    )
    # The published diffuse reflectance of n = 1.5 is 0.0918 (Duntley, "The Optical Properties of Diffusing Materials", 1942).
    assert mean_entering(1.5) == pytest.approx(1 - 0.0918, abs=2e-4)
    normal, outwards = np.array([[0, 0, 1]], np.float32), np.array([[0.6, 0, 0.8]], np.float32)
    inwards, _ = entered(outwards, normal, 1.5)
    np.testing.assert_allclose(inwards, [[-0.4, 0, -((1 - 0.16) ** 0.5)]], atol=1e-6)
