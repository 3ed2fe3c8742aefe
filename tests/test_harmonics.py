"""Spherical harmonics: orthonormal, as the literature lists them, and turning radiance into irradiance."""

import numpy as np
import pytest

from ddprt import warp
from ddprt.harmonics import clamped_cosine, count, harmonics

ORDER = 8
EPS = float(np.finfo(float).eps)


def quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights that integrate polynomials up to a degree exactly: Gauss in z, equal steps about it."""
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    turn = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    flat = np.sqrt(1 - z**2)
    directions = np.stack(
        [np.outer(flat, np.cos(turn)), np.outer(flat, np.sin(turn)), np.outer(z, np.ones_like(turn))], -1
    ).reshape(-1, 3)
    return directions, np.repeat(weight, len(turn)) * 2 * np.pi / len(turn)


def test_they_are_orthonormal() -> None:
    directions, weight = quadrature(2 * ORDER)
    Y = harmonics(directions, ORDER)
    assert Y.shape == (len(directions), count(ORDER))
    # The rule has 9 x 17 nodes; sums of 153 products, each off by the 2 ORDER steps of two recurrences.
    np.testing.assert_allclose(Y.T @ (weight[:, None] * Y), np.eye(count(ORDER)), atol=153 * 4 * ORDER * EPS)


def test_they_are_those_of_the_literature() -> None:
    x, y, z = n = np.array([0.6, -0.48, 0.64])
    listed = [
        0.282095, 0.488603 * y, 0.488603 * z, 0.488603 * x, 1.092548 * x * y, 1.092548 * y * z, 0.315392 * (3 * z * z - 1),
        1.092548 * x * z, 0.546274 * (x * x - y * y),
    ]  # fmt: skip
    np.testing.assert_allclose(harmonics(n, 2), listed, atol=2e-6)  # six digits are listed


def test_poles_are_no_trouble() -> None:
    Y = harmonics(np.array([[0, 0, 1], [0, 0, -1]], float), ORDER)
    degree = np.arange(ORDER + 1)
    np.testing.assert_allclose(Y[0, degree**2 + degree], np.sqrt((2 * degree + 1) / (4 * np.pi)), rtol=1e-13)
    assert np.count_nonzero(Y[0]) == ORDER + 1
    np.testing.assert_allclose(Y[1, degree**2 + degree], (-1.0) ** degree * Y[0, degree**2 + degree], rtol=1e-13)


def test_float32_stays_float32() -> None:
    directions = warp.sample_sphere(warp.sobol(64, 2, seed=0))
    assert harmonics(directions, 3).dtype == np.float32


@pytest.mark.parametrize("towards", [(0, 0, 1), (0.6, -0.48, 0.64)])
def test_clamped_cosine_projects_on_its_bands(towards: tuple[float, float, float]) -> None:
    """A lamp at infinity of irradiance 1 lights a plane by max(0, cos): its coefficients are the bands times Y(towards)."""
    lamp = np.array(towards, float)
    directions, weight = quadrature(400)
    cosine = np.maximum(directions @ lamp, 0)
    projected = harmonics(directions, ORDER).T @ (weight * cosine)
    # The kink at the horizon leaves an error that falls with the square of the nodes: 4 / 400² at most per unit of Y.
    np.testing.assert_allclose(projected, clamped_cosine(ORDER) * harmonics(lamp, ORDER), atol=4 * (2 * ORDER + 1) / 400**2)


def test_uniform_radiance_gives_pi_times_it() -> None:
    radiance = np.zeros(count(2))
    radiance[0] = np.sqrt(4 * np.pi)  # of a constant 1
    normals = warp.sample_sphere(warp.sobol(16, 2, seed=1)).astype(float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(harmonics(normals, 2) @ (clamped_cosine(2) * radiance), np.pi, rtol=1e-14)
