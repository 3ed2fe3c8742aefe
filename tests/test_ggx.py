"""Metal-rough reflection: energy, reciprocity, and samples against their density."""

import numpy as np
import pytest
from oracles import chi_square

from ddprt import warp
from ddprt.transport import ggx, weighing

SIGNIFICANT = 1e-4
"""Seeds are fixed, so a sound sampler passes always; one that is off by a percent in a bin fails by many decades."""

ROUGH = [0.1, 0.25, 0.5, 0.8, 1.0]
TILTS = [0.999, 0.7, 0.2]
"""Cosines of outgoing directions."""

FINISHES = {"metal": (1.0, (0.9, 0.6, 0.2)), "glazed": (0.0, (0.8, 0.5, 0.1)), "mixed": (0.5, (0.9, 0.6, 0.2))}


def directions(cosine: np.ndarray | float, turn: np.ndarray | float) -> np.ndarray:
    z, turn = np.broadcast_arrays(np.asarray(cosine, np.float64), np.asarray(turn, np.float64))
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1).reshape(-1, 3)


def of(
    count: int, roughness: float, metallic: float, base: tuple[float, ...] = (1.0, 1.0, 1.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Base colour and gloss of as many places."""
    return np.tile(np.array(base), (count, 1)), np.tile([roughness, metallic, 0.04], (count, 1))


UP, AROUND, FINE = 20, 16, 24
"""Bins in polar coordinates, and cells of a bin along either."""


def polar(pole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of cells about a pole, by the cube root of the angle so that narrow lobes are seen; and their solid angles."""
    root, turn = (np.arange(UP * FINE) + 0.5) / (UP * FINE), 2 * np.pi * (np.arange(AROUND * FINE) + 0.5) / (AROUND * FINE)
    angle = np.sin(np.pi * root**3) * 3 * np.pi * root**2 / (UP * FINE) * 2 * np.pi / (AROUND * FINE)
    root, turn = np.meshgrid(root, turn, indexing="ij")
    return directions(np.cos(np.pi * root**3), turn) @ warp.frame(pole), np.repeat(angle, AROUND * FINE)


def shares(values: np.ndarray) -> np.ndarray:
    """Sums over the cells of each bin."""
    return values.reshape(UP, FINE, AROUND, FINE).sum((1, 3))


def counts(found: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """How many directions lie in each bin."""
    x, y, z = (found.astype(np.float64) @ warp.frame(pole).T).T
    root = np.cbrt(np.arctan2(np.hypot(x, y), z) / np.pi)
    turn = np.mod(np.arctan2(y, x), 2 * np.pi)
    return np.histogram2d(root, turn, [UP, AROUND], [[0, 1], [0, 2 * np.pi]])[0]


def mirror(tilt: float, turn: float) -> np.ndarray:
    return directions(tilt, turn + np.pi)[0]


def sent_back(tilt: float, roughness: float, metallic: float, base: tuple[float, ...] = (1.0, 1.0, 1.0)) -> np.ndarray:
    """Share of light along a direction that comes back, per channel: an integral over all directions, not by samples."""
    incoming, angle = polar(mirror(tilt, 0.3))
    outgoing = np.tile(directions(tilt, 0.3), (len(incoming), 1))
    value = ggx.evaluate(outgoing, incoming, *of(len(incoming), roughness, metallic, base))
    return angle @ value.astype(np.float64)


def independent(o: np.ndarray, i: np.ndarray, roughness: float, metallic: float, base: np.ndarray, f0: float) -> np.ndarray:
    """The model's facets alone as Appendix B words them, with heights correlated: BSDF times cosine, without diffuse part."""
    a, h = roughness**2, (o + i) / np.linalg.norm(o + i)
    dense = a**2 / (np.pi * ((h[2] ** 2) * (a**2 - 1) + 1) ** 2)
    lam = [(np.sqrt(1 + a**2 * (1 / d[2] ** 2 - 1)) - 1) / 2 for d in (o, i)]
    reflectance = f0 + metallic * (base - f0)
    fresnel = reflectance + (1 - reflectance) * (1 - o @ h) ** 5
    return fresnel * dense / (1 + lam[0] + lam[1]) / (4 * o[2] * i[2]) * i[2]


# --- the model --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("roughness", ROUGH)
def test_metal_is_the_formula(roughness: float) -> None:
    rng = np.random.default_rng(0)
    o, i = (directions(rng.uniform(0.05, 1, 200), rng.uniform(0, 6.28, 200)) for _ in range(2))
    base = np.array([0.9, 0.6, 0.2])
    found = ggx.evaluate(o, i, *of(200, roughness, 1.0, tuple(base)))
    expected = np.array([independent(a, b, roughness, 1.0, base, 0.04) for a, b in zip(o, i, strict=True)])
    # float32 of the result, and the formula's cancellation in h.z² (a² - 1) + 1 near the peak: 2e-16 / a².
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("name", FINISHES)
@pytest.mark.parametrize("roughness", [0.0, *ROUGH])
def test_reciprocity(roughness: float, name: str) -> None:
    rng = np.random.default_rng(1)
    o, i = (directions(rng.random(1000), rng.uniform(0, 6.28, 1000)) for _ in range(2))
    metallic, base = FINISHES[name]
    there = ggx.evaluate(o, i, *of(1000, roughness, metallic, base)) * o[:, 2:]
    back = ggx.evaluate(i, o, *of(1000, roughness, metallic, base)) * i[:, 2:]
    np.testing.assert_allclose(there, back, rtol=1e-6)  # both rounded to float32 once
    assert (there > 0).all()


def test_nothing_comes_from_below_or_goes_there() -> None:
    up, down = directions(0.4, np.arange(4.0)), directions(-0.4, np.arange(4.0))
    for o, i in ((up, down), (down, up), (down, down)):
        assert not ggx.evaluate(o, i, *of(4, 0.4, 0.5)).any()
        assert not ggx.pdf(o, i, *of(4, 0.4, 0.5)).any()


def test_the_smoothest_is_clamped() -> None:
    o, i = directions(0.6, 0.0), directions(0.6, np.pi)
    mirror = ggx.evaluate(o, i, *of(1, 0.0, 1.0))
    np.testing.assert_array_equal(mirror, ggx.evaluate(o, i, *of(1, ggx.SMOOTHEST, 1.0)))
    # At the mirror direction D = 1 / (pi a²), and Smith's term is 1 but for a² / (4 cos²).
    assert mirror[0, 0] == pytest.approx(1 / (4 * np.pi * ggx.SMOOTHEST**4 * 0.6), rel=1e-4)


# --- white furnace ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("roughness", ROUGH)
def test_a_white_dielectric_keeps_all_light(roughness: float, tilt: float) -> None:
    assert sent_back(tilt, roughness, 0.0) == pytest.approx(1, abs=0.005)


@pytest.mark.parametrize("roughness", ggx.LOSS)
def test_a_white_metal_loses_what_is_stated(roughness: float) -> None:
    """Directional albedos by the integral over the hemisphere, and their mean against the stated loss."""
    x, weight = np.polynomial.legendre.leggauss(12)
    tilts = (x + 1) / 2
    found = np.array([sent_back(tilt, roughness, 1.0)[0] for tilt in tilts])
    np.testing.assert_allclose(ggx.albedo(tilts, roughness, 1.0), found, atol=2.5e-3)  # the table's own error is 0.002
    assert 1 - (weight * tilts) @ found == pytest.approx(ggx.LOSS[roughness], abs=1e-3)  # 0.0005 of it from rounding
    assert 1 - ggx.mean_albedo(roughness, 1.0) == pytest.approx(ggx.LOSS[roughness], abs=1.5e-3)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_mixtures_lie_between(roughness: float) -> None:
    """Half a metal sends back the mean of both: all terms are linear in `metallic`."""
    base = (0.9, 0.4, 0.1)
    whole, none, half = (sent_back(0.5, roughness, metallic, base) for metallic in (1.0, 0.0, 0.5))
    np.testing.assert_allclose(half, (whole + none) / 2, rtol=1e-5)
    assert (whole < 1).all()
    assert (none < 1).all()


# --- samples ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FINISHES)
@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("roughness", [0.0, *ROUGH])
def test_samples_fit_their_density(roughness: float, tilt: float, name: str) -> None:
    """Chi-square over bins about the mirror direction, one more for what goes below the surface: so the mass fits as well."""
    count, pole = 60_000, mirror(tilt, 1.1)
    metallic, base = FINISHES[name]
    o = np.tile(directions(tilt, 1.1), (count, 1))
    incoming, weight = ggx.sample(o, np.random.default_rng(2).random((count, 3)), *of(count, roughness, metallic, base))
    grid, angle = polar(pole)
    density = ggx.pdf(np.tile(o[:1], (len(grid), 1)), grid, *of(len(grid), roughness, metallic, base))
    share = shares(density.astype(np.float64) * angle)
    above = incoming[:, 2] > 0
    assert share.sum() < 1 + 1e-3
    lost = max(1 - share.sum(), 0.0)
    assert chi_square(np.append(counts(incoming[above], pole), (~above).sum()), np.append(share, lost)) > SIGNIFICANT
    assert (~above).mean() == pytest.approx(lost, abs=4.5 * np.sqrt(lost / count) + 1e-3)
    assert not weight[~above].any()
    assert weight.max() < 3  # never a path of great weight


@pytest.mark.parametrize("name", FINISHES)
@pytest.mark.parametrize("roughness", [0.0, *ROUGH])
def test_weights_are_value_over_density(roughness: float, name: str) -> None:
    metallic, base = FINISHES[name]
    finish, rng = of(2000, roughness, metallic, base), np.random.default_rng(5)
    o = directions(rng.uniform(0.1, 1, 2000), rng.uniform(0, 6.28, 2000))
    incoming, weight = ggx.sample(o, rng.random((2000, 3)), *finish)
    above = incoming[:, 2] > 0
    value, density = ggx.evaluate(o, incoming, *finish), ggx.pdf(o, incoming, *finish)
    # `incoming` is rounded to float32: 1e-7 against a lobe of width a², whose slope is some 4 / a², gives 2e-4 at the clamp.
    np.testing.assert_allclose(weight[above] * density[above, None], value[above], rtol=3e-3)


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("name", FINISHES)
def test_weights_average_to_the_albedo(name: str, tilt: float) -> None:
    metallic, base = FINISHES[name]
    count = 200_000
    o = np.tile(directions(tilt, 0.3), (count, 1))
    _, weight = ggx.sample(o, np.random.default_rng(3).random((count, 3)), *of(count, 0.5, metallic, base))
    error = weight.std(0, dtype=np.float64) / np.sqrt(count)
    assert (np.abs(weight.mean(0, dtype=np.float64) - sent_back(tilt, 0.5, metallic, base)) < 4.5 * error + 1e-4).all()


@pytest.mark.parametrize("tilt", [1.0, *TILTS])
@pytest.mark.parametrize("roughness", [ggx.SMOOTHEST, *ROUGH])
def test_visible_facets_fit_and_invert(roughness: float, tilt: float) -> None:
    count, up = 60_000, np.array([0.0, 0.0, 1.0])
    alpha, u = np.full(count, roughness**2), np.random.default_rng(4).random((count, 2))
    o = np.tile(directions(tilt, 1.1), (count, 1))
    facing = ggx.sample_visible(u, o, alpha)
    np.testing.assert_allclose(np.linalg.norm(facing, axis=1), 1, atol=1e-12)
    grid, angle = polar(up)
    density = ggx.pdf_visible(grid, np.tile(o[:1], (len(grid), 1)), np.full(len(grid), roughness**2))
    share = shares(density * angle)
    assert share.sum() == pytest.approx(1, abs=2e-3)
    assert chi_square(counts(facing, up), share) > SIGNIFICANT
    back = ggx.invert_visible(facing, o, alpha)
    # Near the rim of the disc, facets at the horizon: a number is lost there, as a root is of what is 0 but for rounding.
    sound = facing[:, 2] > 1e-3
    np.testing.assert_allclose(np.abs((back - u + 0.5) % 1 - 0.5)[sound], 0, atol=1e-6)
    assert sound.mean() > 0.99


def test_weights_for_a_light_are_those_of_the_lobe() -> None:
    """Single precision against double, for lobes of all kinds, most of all about their peaks."""
    rng, n = np.random.default_rng(0), 60000
    outgoing, incoming, normals = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(3, n, 3)))
    outgoing[:, 2] = np.abs(outgoing[:, 2])
    peaks = outgoing * [-1, -1, 1] + 0.02 * rng.normal(size=(n, 3))
    incoming[: n // 2] = (peaks / np.linalg.norm(peaks, axis=1, keepdims=True))[: n // 2]
    base, gloss = rng.random((2, n, 3)).astype(np.float32)
    gloss[: n // 4, 1], gloss[n // 8 : n // 3, 0] = 1, 0.0
    throughput, frames = rng.random((3, n)).astype(np.float32), warp.frame(normals.astype(np.float32))
    outgoing = outgoing.astype(np.float32)
    directions = warp.to_world(incoming.astype(np.float32), frames)
    held = weighing.prepared(outgoing, base, gloss)
    found = weighing.weigh(held, frames, outgoing, directions, throughput)
    local = np.einsum("nij,nj->ni", frames.astype(float), directions)
    under, out = local[:, 2], outgoing[:, 2].astype(float)
    assert not found[:, under < 0].any()
    exact = ggx.evaluate(outgoing, local, base, gloss).T * throughput * np.pi / np.where(under > 0, under, 1)
    # A half vector is off by 4 eps over its length, z at least; as a slope by alpha more, to the fourth power; and some
    # twenty roundings besides. Near the horizon the sign of a cosine itself is open.
    alpha, z = np.maximum(gloss[:, 0], ggx.SMOOTHEST) ** 2.0, out + under
    seen = (under > 1e-3) & (out > 1e-3)
    bound = (16 / (alpha * np.where(seen, z, 1)) + 20 + 8 / np.where(seen, np.minimum(under, out), 1)) * np.finfo(
        np.float32
    ).eps
    assert (np.abs(found - exact) <= bound * exact)[:, seen].all()
    assert np.median(bound[seen]) < 1e-4, "what is as wide as this tests nothing"
