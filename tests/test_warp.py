"""Samplers against their densities, their inverses, frames, and low-discrepancy points."""

from collections.abc import Callable

import numpy as np
import pytest
from oracles import chi_square
from scipy.stats import qmc

from ddprt import warp

SIGNIFICANT = 1e-4
"""Seeds are fixed, so a sound sampler passes always; one that is off by a percent in a bin fails by many decades."""

CAPS = [2.0, 1.0, 0.3, 1e-3]


def numbers(count: int, seed: int = 0, dtype: type = np.float64) -> np.ndarray:
    return np.random.default_rng(seed).random((count, 2)).astype(dtype)


def on_sphere(z: np.ndarray, turn: np.ndarray) -> np.ndarray:
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1)


def share_of_bins(pdf: Callable[[np.ndarray], np.ndarray], lowest: float, bins: int = 12, fine: int = 16) -> np.ndarray:
    """Integral of a density over bins of height z in [lowest, 1] and turn; a solid angle is dz times d(turn)."""
    middle = (np.arange(bins * fine) + 0.5) / (bins * fine)
    z, turn = np.meshgrid(lowest + (1 - lowest) * middle, 2 * np.pi * middle, indexing="ij")
    cell = (1 - lowest) * 2 * np.pi / (bins * fine) ** 2
    return cell * pdf(on_sphere(z, turn)).reshape(bins, fine, bins, fine).sum((1, 3))


def counts_of_bins(direction: np.ndarray, lowest: float, bins: int = 12) -> np.ndarray:
    z = (direction[:, 2].astype(np.float64) - lowest) / (1 - lowest)
    turn = np.mod(np.arctan2(direction[:, 1], direction[:, 0]), 2 * np.pi)
    # Rounding of float32 may put a direction 6e-8 below the rim.
    assert z.min() > -1e-7 / (1 - lowest)
    return np.histogram2d(np.clip(z, 0, 1), turn, bins, [[0, 1], [0, 2 * np.pi]])[0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_triangle_fits_its_density(dtype: type) -> None:
    bins, fine = 10, 100
    weights = warp.sample_triangle(numbers(100_000, dtype=dtype))
    assert weights.dtype == dtype
    counts = np.histogram2d(weights[:, 0], weights[:, 1], bins, [[0, 1], [0, 1]])[0]
    x, y = np.meshgrid((np.arange(bins * fine) + 0.5) / (bins * fine), (np.arange(bins * fine) + 0.25) / (bins * fine))
    density = warp.pdf_triangle(np.stack([x.T, y.T], -1))
    # The sub-cells cut by the diagonal count fully: 1 / 2000 of the whole.
    share = density.reshape(bins, fine, bins, fine).sum((1, 3)) / (bins * fine) ** 2
    assert share.sum() == pytest.approx(1, abs=1 / (bins * fine))
    assert chi_square(counts, share) > SIGNIFICANT


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_cosine_fits_its_density(dtype: type) -> None:
    direction = warp.sample_cosine(numbers(100_000, dtype=dtype))
    assert direction.dtype == dtype
    share = share_of_bins(warp.pdf_cosine, 0.0)
    assert share.sum() == pytest.approx(1, abs=1e-12)  # linear in z: the midpoint rule is exact
    assert chi_square(counts_of_bins(direction, 0.0), share) > SIGNIFICANT


def test_sphere_fits_its_density() -> None:
    share = share_of_bins(warp.pdf_sphere, -1.0)
    assert share.sum() == pytest.approx(1, abs=1e-12)
    assert chi_square(counts_of_bins(warp.sample_sphere(numbers(100_000)), -1.0), share) > SIGNIFICANT


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("cap", CAPS)
def test_cone_fits_its_density(cap: float, dtype: type) -> None:
    direction = warp.sample_cone(numbers(100_000, dtype=dtype), cap)
    assert direction.dtype == dtype
    share = share_of_bins(lambda d: warp.pdf_cone(d, cap), 1 - cap)
    assert share.sum() == pytest.approx(1, abs=1e-12)
    assert chi_square(counts_of_bins(direction, 1 - cap), share) > SIGNIFICANT


def test_a_density_that_is_wrong_is_noticed() -> None:
    uniform = warp.sample_cone(numbers(100_000), 1.0)
    assert chi_square(counts_of_bins(uniform, 0.0), share_of_bins(warp.pdf_cosine, 0.0)) < SIGNIFICANT


def test_densities_are_zero_outside() -> None:
    below = np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]])
    assert (warp.pdf_cosine(below) == 0).all()
    assert (warp.pdf_cone(below, 0.5) == 0).all()
    assert (warp.pdf_triangle(np.array([[0.6, 0.6], [-0.1, 0.2]])) == 0).all()


@pytest.mark.parametrize("cap", CAPS)
def test_cone_and_back(cap: float) -> None:
    u = numbers(1000)
    # 1 - z loses eps / cap of the first number; the turn is worst near the axis, where radius² = 2 * cap * u.
    np.testing.assert_allclose(warp.invert_cone(warp.sample_cone(u, cap), cap), u, atol=8 * 2.3e-16 / cap + 1e-14)


@pytest.mark.parametrize(
    ("sample", "invert"),
    [
        (warp.sample_triangle, warp.invert_triangle),
        (warp.sample_cosine, warp.invert_cosine),
        (warp.sample_sphere, warp.invert_sphere),
    ],
)
def test_there_and_back(sample: Callable[..., np.ndarray], invert: Callable[..., np.ndarray]) -> None:
    u = numbers(1000)
    np.testing.assert_allclose(invert(sample(u)), u, atol=1e-14)  # a few dozen roundings of 1e-16


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("sample", [warp.sample_cosine, warp.sample_sphere, lambda u: warp.sample_cone(u, 1e-7)])
def test_corners_of_the_square_give_unit_directions(sample: Callable[..., np.ndarray], dtype: type) -> None:
    last = np.nextafter(dtype(1), dtype(0))
    u = np.array([[0, 0], [0, last], [last, 0], [last, last], [0.5, 0.5]], dtype)
    np.testing.assert_allclose(np.linalg.norm(sample(u), axis=1), 1, atol=4 * np.finfo(dtype).eps)
    assert (warp.sample_triangle(u).sum(1) <= 1).all()
    assert (warp.sample_triangle(u) >= 0).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_frames_are_right_handed_and_orthonormal(dtype: type) -> None:
    random = np.random.default_rng(3).normal(size=(10_000, 3))
    axes = [[0, 0, -1.0], [0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [1, 0, -0.0], [1e-4, 0, -1], [0, -1e-20, -1]]
    normal = np.concatenate([random, axes])
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(dtype)
    frames = warp.frame(normal)
    assert frames.dtype == dtype
    # Rounded normals are off unit length by an eps, and every entry takes some five roundings.
    tolerance = 16 * np.finfo(dtype).eps
    np.testing.assert_allclose(frames @ frames.swapaxes(1, 2), np.broadcast_to(np.eye(3), frames.shape), atol=tolerance)
    np.testing.assert_allclose(np.linalg.det(frames.astype(np.float64)), 1, atol=tolerance)
    np.testing.assert_array_equal(frames[:, 2], normal)
    up = np.broadcast_to(np.array([0, 0, 1], dtype), normal.shape)
    np.testing.assert_array_equal(warp.to_world(np.ascontiguousarray(up), frames), normal)


def test_to_world_is_a_product_with_the_frame() -> None:
    rng = np.random.default_rng(4)
    local, frames = rng.normal(size=(50, 3)), rng.normal(size=(50, 3, 3))
    expected = np.array([frame.T @ vector for vector, frame in zip(local, frames, strict=True)])
    np.testing.assert_allclose(warp.to_world(local, frames), expected, atol=1e-14)
    np.testing.assert_array_equal(warp.to_world(local, frames.reshape(-1, 9)), warp.to_world(local, frames))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5, 100, 128, 1000])
def test_sobol_takes_any_count(count: int) -> None:
    points = warp.sobol(count, 4, seed=1)
    assert points.shape == (count, 4)
    assert points.dtype == np.float32
    assert ((points >= 0) & (points < 1)).all()
    np.testing.assert_array_equal(points, warp.sobol(count, 4, seed=1))


def test_sobol_seeds_differ() -> None:
    assert not np.isin(warp.sobol(64, 2, seed=1), warp.sobol(64, 2, seed=2)).any()


@pytest.mark.parametrize("count", [64, 1024])
def test_sobol_has_one_point_in_each_stratum(count: int) -> None:
    for column in warp.sobol(count, 4, seed=5).T:
        np.testing.assert_array_equal(np.sort(np.floor(column * count)), np.arange(count))


def test_sobol_is_more_even_than_chance() -> None:
    chance = min(qmc.discrepancy(np.random.default_rng(seed).random((256, 2))) for seed in range(50))
    assert max(qmc.discrepancy(warp.sobol(256, 2, seed).astype(np.float64)) for seed in range(50)) < chance / 10


def test_sobol_is_unbiased_over_seeds() -> None:
    """The scramble makes every single point uniform: 400 first points against the uniform distribution."""
    first = np.array([warp.sobol(8, 2, seed)[0] for seed in range(400)])
    counts = np.histogram2d(first[:, 0], first[:, 1], 4, [[0, 1], [0, 1]])[0]
    assert chi_square(counts, np.ones((4, 4))) > SIGNIFICANT
