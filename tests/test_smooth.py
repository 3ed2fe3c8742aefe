"""The smooth ridge against brute force, and its laws."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import U32, U64, over_bound

from ddprt.errors import UserError
from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.fitting.selection import choose_ridge, decompose, left_out
from ddprt.fitting.transfer import point_stretch, solve_transfer
from ddprt.methods.method import Examples, Frame, columns
from ddprt.methods.svd_ridge import LinearTransfer, SvdRidge, _smoothed, likeness_root

LIGHTINGS, POINTS, TEXELS, BASES = 14, 9, 21, 4
KEY = jax.random.key(0)


def places(points: int = POINTS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points in a cube with normals all around."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(points, 3))
    return rng.random((points, 3)), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def examples(
    channels: str = "mono", position: np.ndarray | None = None, normal: np.ndarray | None = None, seed: int = 0
) -> Examples:
    """A made-up room: indirect light that nearly follows the measurements."""
    given = places(seed=seed)
    position, normal = (value if value is not None else one for value, one in zip((position, normal), given, strict=True))
    rng = np.random.default_rng(seed)
    measured = rng.random((LIGHTINGS, len(position), 3))
    light = np.einsum("lpc,pt->ltc", measured, rng.random((len(position), TEXELS))) + 0.1 * rng.random((LIGHTINGS, TEXELS, 3))
    values, indirect, p, n = (jnp.asarray(part, jnp.float32) for part in (measured, light, position, normal))
    scale = jnp.asarray(rng.uniform(0.5, 2, (LIGHTINGS, 3 if channels == "mono" else 1)) * np.ones(3), jnp.float32)
    area = np.linspace(1, 2, TEXELS).astype(np.float32)
    return Examples(Frame(values, p, n), indirect, scale, area, "area", channels)


def fitted(data: Examples, **settings: object) -> LinearTransfer:
    return SvdRidge(**{"bases": BASES, **settings}).fit(data, data, key=KEY)


def likeness(frame: Frame, smooth: float) -> np.ndarray:
    """K, pair by pair, less its negative part."""
    p, n = (np.asarray(part, float) for part in (frame.positions, frame.normals))
    nearest = []
    for a in p:
        apart = [float(np.linalg.norm(a - b)) for b in p]
        nearest += [min(d for d in apart if d > 0)] if max(apart) > 0 else []
    reach = smooth * float(np.median(nearest)) if nearest else 1.0
    K = np.array(
        [
            [np.exp(-np.linalg.norm(a - b) / reach) * max(0.0, float(u @ v)) for b, v in zip(p, n, strict=True)]
            for a, u in zip(p, n, strict=True)
        ]
    )
    values, vectors = np.linalg.eigh(K)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def brute_force(X: np.ndarray, C: np.ndarray, K: np.ndarray, ridge: float) -> np.ndarray:
    """M = C^T (X K X^T + ridge)^-1 X K, which needs no inverse of K; a stationary point of |X M^T - C|² + ridge M K^-1 M^T."""
    return C.T @ np.linalg.solve(X @ K @ X.T + ridge * np.eye(len(X)), X @ K)


def bound_smooth(X: np.ndarray, C: np.ndarray, K: np.ndarray, M: np.ndarray, ridge: float, doubt: float) -> np.ndarray:
    """How far a float64 solution that is rounded to float32 may lie from the brute force.

    With A = X R and K = R R^T, M = C^T (A A^T + ridge)^-1 A R^T: doubt of C moves it by |(A A^T + ridge)^-1 A| |R|.
    Roots and decompositions are backward stable, errors of n u64 of |K| and of |A|, and so is the brute force; the worse of the
    two conditions is that of the matrix that it solves with. Then M is rounded to float32.
    """
    values = np.linalg.eigvalsh(X @ K @ X.T)
    S = np.sqrt(np.maximum(values, 0))
    held = np.max(S[S > 0] / (S[S > 0] ** 2 + ridge)) * np.sqrt(np.linalg.norm(K, 2))
    condition = (values[-1] + ridge) / (max(values[0], 0) + ridge)
    return U32 * np.abs(M) + (1 + 2 * U32) * held * (doubt + 20 * sum(X.shape) * U64 * condition * np.linalg.norm(C))


def sides(data: Examples, model: LinearTransfer) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """X, C and the doubt of C for each matrix. C is taken on the float32 basis, each vector off by u32, and rounded itself."""
    mono = data.channels == "mono"
    X = np.asarray(data.frame.values, float)
    X = np.moveaxis(X, 2, 0) if mono else X.reshape(1, LIGHTINGS, -1)
    Y = np.asarray(data.indirect, float)
    Y = np.moveaxis(Y, 2, 0) if mono else Y.reshape(1, LIGHTINGS, -1)
    W = entry_weights(data.area, data.weights, data.channels).astype(float)
    U = np.asarray(model.basis, float)
    return [(x, (y * W) @ U.T, 3 * U32 * float(np.sqrt((y**2 @ W).sum() * len(U)))) for x, y in zip(X, Y, strict=True)]


@pytest.mark.parametrize("channels", ["mono", "multi"])
@pytest.mark.parametrize("smooth", [1e-3, 0.5, 2.0, 50.0])
@pytest.mark.parametrize("ridge", [0.01, 0.1, 10.0, "auto"])
def test_matrix_against_brute_force(channels: str, smooth: float, ridge: float | str) -> None:
    data = examples(channels)
    model = fitted(data, smooth=smooth, ridge=ridge)
    K = likeness(data.frame, smooth)
    K = K if channels == "mono" else np.kron(K, np.eye(3))
    for M, used, (X, C, doubt) in zip(np.asarray(model.matrix), model.report.ridge, sides(data, model), strict=True):
        exact = brute_force(X, C, K, used)
        bound = bound_smooth(X, C, K, exact, used, doubt)
        assert over_bound(M - exact, bound) <= 1
        # The bound is no excuse for another K: neither none, nor one of another reach, nor one that mixes colours.
        further = likeness(data.frame, 1.5 * smooth)
        others = [np.eye(len(K)), further if channels == "mono" else np.kron(np.eye(3), likeness(data.frame, smooth))]
        assert smooth < 0.1 or all(over_bound(M - brute_force(X, C, other, used), bound) > 1 for other in others)


def test_penalty_is_the_one_that_is_stated() -> None:
    """Normal equations with K^-1 itself, where K has one: no change of M lowers |X M^T - C|² + ridge tr(M K^-1 M^T)."""
    normal = np.tile([0.0, 1, 0], (POINTS, 1))
    data = examples(normal=normal)
    model = fitted(data, smooth=1.0, ridge=0.3)
    K = likeness(data.frame, 1.0)
    assert np.linalg.eigvalsh(K)[0] > 0.01
    for M, (X, C, doubt) in zip(np.asarray(model.matrix, float), sides(data, model), strict=True):
        exact = np.linalg.solve(X.T @ X + 0.3 * np.linalg.inv(K), X.T @ C).T
        assert over_bound(M - exact, bound_smooth(X, C, K, exact, 0.3, doubt)) <= 1


PER_POINT = tuple(np.linspace(0.1, 1, POINTS).tolist())


@pytest.mark.parametrize("ridge", [0.1, "auto", PER_POINT], ids=["given", "auto", "per point"])
def test_no_smoothness_is_the_plain_ridge_to_the_bit(ridge: Any) -> None:
    """Put together from the same parts."""
    data = examples()
    model = fitted(data, ridge=ridge, smooth=0.0)
    assert SvdRidge().smooth == 0
    basis = fit_basis(columns(data)[0], jnp.asarray(entry_weights(data.area, "area", "mono")), bases=BASES)
    targets = np.asarray(basis.coefficients).reshape(LIGHTINGS, 3, BASES)
    stretch = point_stretch(ridge, POINTS)
    spectra = [
        decompose(data.frame.values[..., group], jnp.asarray(targets[:, group].astype(np.float32)), stretch=stretch)
        for group in range(3)
    ]
    weight = [np.asarray(data.scale[:, group], float) ** 2 for group in range(3)]
    used = choose_ridge(spectra, weight, [np.arange(LIGHTINGS)] * 3).ridge if ridge == "auto" else ridge
    for group in range(3):
        whole = solve_transfer(spectra[group], used, stretch, weight[group])
        np.testing.assert_array_equal(model.matrix[group], whole.matrix)
        assert (model.report.ridge[group], model.report.leave_one_out[group]) == (whole.ridge, whole.leave_one_out)


def refits(X: np.ndarray, C: np.ndarray, K: np.ndarray, ridge: float, intercept: bool) -> np.ndarray:
    """Squared error of each row, predicted by a brute-force fit to all others."""
    squares = []
    for row in range(len(X)):
        keep = np.arange(len(X)) != row
        x0, c0 = (X[keep].mean(0), C[keep].mean(0)) if intercept else (np.zeros(X.shape[1]), np.zeros(C.shape[1]))
        M = brute_force(X[keep] - x0, C[keep] - c0, K, ridge)
        squares.append(float(((C[row] - c0 - M @ (X[row] - x0)) ** 2).sum()))
    return np.array(squares)


@pytest.mark.parametrize("intercept", [False, True])
@pytest.mark.parametrize("ridge", [1e-3, 0.1, 10.0])
@pytest.mark.parametrize("lightings", [5, 14])
def test_leave_one_out_equals_refits(lightings: int, ridge: float, intercept: bool) -> None:
    data = examples()
    rng = np.random.default_rng(1)
    X, C = (rng.random((lightings, count)).astype(np.float32) for count in (POINTS, BASES))
    K, root = likeness(data.frame, 2.0), likeness_root(data.frame, 2.0)
    got = left_out(_smoothed(jnp.asarray(X), jnp.asarray(C), root, intercept=intercept), np.array([ridge]))[0][0]
    exact = refits(X.astype(float), C.astype(float), K, ridge, intercept)
    # Both solve the same problem backward stably, see `bound_smooth`; a row adds its own size to what M is off by.
    condition = 1 + np.linalg.norm(X @ K @ X.T, 2) / ridge
    bound = 40 * (lightings + POINTS) * U64 * condition**2 * float((C.astype(float) ** 2).sum())
    assert over_bound(got - exact, bound) <= 1
    plain = left_out(decompose(jnp.asarray(X), jnp.asarray(C), intercept=intercept), np.array([ridge]))[0][0]
    assert over_bound(plain - exact, bound) > 1


def test_what_is_negative_of_the_likeness_is_left_out() -> None:
    """max(0, n . n') alone has negative eigenvalues (its waves of degree 4): points at nearly one place that face all ways."""
    position, normal = places(60)
    frame = examples(position=1e-3 * position, normal=normal).frame
    p, n = (np.asarray(part, float) for part in (frame.positions, frame.normals))
    K, R = likeness(frame, 1e3), likeness_root(frame, 1e3)
    whole = np.exp(-np.linalg.norm(p[:, None] - p, axis=2)) * np.maximum(n @ n.T, 0)  # reaches far further than the points
    assert np.linalg.eigvalsh(whole)[0] < -0.05
    # Eigenvalues and squares of roots are off by n u64 of the largest, a few times.
    assert over_bound(R @ R.T - K, 10 * len(K) * U64 * np.linalg.norm(K, 2)) <= 1


def test_offset_is_the_mean_of_the_measurements() -> None:
    data = examples()
    smooth, plain = (fitted(data, smooth=value, centre="mean", ridge=0.1) for value in (2.0, 0.0))
    mean = np.asarray(data.frame.values, float).mean(0).T
    # A float64 mean, rounded once.
    assert over_bound(np.asarray(smooth.offset) - mean, 2 * U32 * np.abs(mean)) <= 1
    np.testing.assert_array_equal(smooth.intercept, plain.intercept)
    for M, (X, C, doubt) in zip(np.asarray(smooth.matrix), sides(data, smooth), strict=True):
        # Centred columns: the mean map takes off what the basis does not see.
        x, K = X - X.mean(0), likeness(data.frame, 2.0)
        exact = brute_force(x, C - C.mean(0), K, 0.1)
        assert over_bound(M - exact, bound_smooth(x, C - C.mean(0), K, exact, 0.1, doubt)) <= 1


def test_coincident_points_act_alike() -> None:
    position, normal = places()
    position[4], normal[4] = position[2], normal[2]
    model = fitted(examples(position=position, normal=normal), smooth=2.0, ridge=1e-3)
    M = np.asarray(model.matrix)
    assert np.isfinite(M).all()
    # Rows of the root of equal rows of K: errors of points * u64 of its size over the square root of what the cut leaves.
    assert over_bound(M[..., 4] - M[..., 2], 2 * U32 * np.abs(M[..., 2]) + np.sqrt(POINTS * U64) * np.abs(M).max()) <= 1
    plain = np.asarray(fitted(examples(position=position, normal=normal), ridge=1e-3).matrix)
    assert np.abs(plain[..., 4] - plain[..., 2]).max() > 0.01 * np.abs(plain).max()


@pytest.mark.parametrize("points", [1, 5])
def test_all_points_at_one_place(points: int) -> None:
    """K has ones everywhere: every point gets the same weight, and one point alone its plain one."""
    position, normal = np.full((points, 3), 0.5), np.tile([0.0, 0, 1], (points, 1))
    data = examples(position=position, normal=normal)
    model = fitted(data, smooth=3.0, ridge=0.1)
    M = np.asarray(model.matrix)
    for matrix, (X, C, doubt) in zip(M, sides(data, model), strict=True):
        exact = brute_force(X, C, np.ones((points, points)), 0.1)
        assert over_bound(matrix - exact, bound_smooth(X, C, np.ones((points, points)), exact, 0.1, doubt)) <= 1
    if points == 1:
        plain = np.asarray(fitted(data, ridge=0.1).matrix)
        assert over_bound(M - plain, 2 * U32 * np.abs(plain)) <= 1


def test_reach_is_in_distances_between_points() -> None:
    """A room four times as large has the same matrix, to the bit."""
    position, normal = places()
    small, large = (fitted(examples(position=size * position, normal=normal), smooth=2.0) for size in (1, 4))
    np.testing.assert_array_equal(small.matrix, large.matrix)
    assert small.report == large.report


def test_the_ridge_path_is_that_of_the_transformed_measurements() -> None:
    """Ridges run up to ten times the largest squared singular value of X R."""
    data = examples()
    model = fitted(data, smooth=2.0)
    R = likeness_root(data.frame, 2.0)
    largest = max(np.linalg.norm(X @ R, 2) for X, _, _ in sides(data, model))
    ridges = [ridge for ridge, _ in model.report.ridge_path[0]]
    assert ridges[-1] == pytest.approx(10 * largest**2, rel=1e-6)
    assert set(model.report.ridge) <= set(ridges)


def test_black_and_dark_examples_give_black() -> None:
    data = examples()
    dark = replace(data, frame=replace(data.frame, values=0 * data.frame.values), scale=0 * data.scale)
    model = fitted(dark, smooth=2.0)
    assert not np.asarray(model.matrix).any()
    assert model.report.status == "no_signal"


def test_a_ridge_per_point_is_refused() -> None:
    with pytest.raises(UserError, match="smooth = 2") as caught:
        fitted(examples(), smooth=2.0, ridge=PER_POINT)
    assert "got" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_solve_takes_any_ridge_of_the_path() -> None:
    """The same spectrum, solved at another ridge, is the brute force there: one decomposition serves all."""
    data = examples()
    X, C = (np.random.default_rng(2).random((LIGHTINGS, count)).astype(np.float32) for count in (POINTS, BASES))
    spectrum = _smoothed(jnp.asarray(X), jnp.asarray(C), likeness_root(data.frame, 2.0), intercept=False)
    K = likeness(data.frame, 2.0)
    for ridge in (1e-2, 1.0, 100.0):
        exact = brute_force(X.astype(float), C.astype(float), K, ridge)
        M = np.asarray(solve_transfer(spectrum, ridge, None, np.ones(LIGHTINGS)).matrix)
        assert over_bound(M - exact, bound_smooth(X.astype(float), C.astype(float), K, exact, ridge, 0.0)) <= 1
