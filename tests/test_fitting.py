"""Encoding, basis and transfer against float64 NumPy twins and the laws of linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from ddprt.errors import UserError
from ddprt.fitting.basis import RANK_CUT, entry_weights, fit_basis
from ddprt.fitting.encoding import Encoding
from ddprt.fitting.selection import decompose, left_out
from ddprt.fitting.transfer import fit_transfer

EPS32 = float(np.finfo(np.float32).eps)


def decaying(rows: int, entries: int, smallest: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Float32 data with known singular values from 1 down to `smallest`, and those values."""
    rng = np.random.default_rng(seed)
    left = np.linalg.qr(rng.normal(size=(rows, rows)))[0]
    right = np.linalg.qr(rng.normal(size=(entries, rows)))[0].T
    sigma = np.logspace(0, np.log10(smallest), rows)
    return ((left * sigma) @ right).astype(np.float32), sigma


# --- encoding ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", ["linear", "gamma"])
@pytest.mark.parametrize("channels", ["mono", "multi"])
def test_decode_undoes_encode(space: str, channels: str) -> None:
    encoding = Encoding(space, 2.2, channels)
    values = jnp.asarray(np.random.default_rng(0).normal(size=(4, 50, 3)), jnp.float32)
    scale = encoding.scale(values)
    back = encoding.decode(encoding.encode(values, scale), scale, clamp=False)
    # Two powers and a division, each good to a few ulp; the power multiplies a relative error by at most gamma.
    np.testing.assert_allclose(back, values, rtol=20 * EPS32, atol=1e-7 * float(jnp.abs(values).max()))


@pytest.mark.parametrize("channels", ["mono", "multi"])
@pytest.mark.parametrize("size", [1e-30, 1e-10, 1.0, 1e10, 1e30])
def test_scale_is_the_norm_at_any_size(channels: str, size: float) -> None:
    values = np.random.default_rng(1).random((3, 20, 3)).astype(np.float32)
    expected = np.linalg.norm(values.astype(float), axis=1) if channels == "mono" else None
    if expected is None:
        expected = np.repeat(np.linalg.norm(values.astype(float).reshape(3, -1), axis=1)[:, None], 3, 1)
    got = Encoding(channels=channels).scale(jnp.asarray(values * np.float32(size)))
    np.testing.assert_allclose(np.asarray(got, float) / np.float32(size), expected, rtol=60 * EPS32)  # sums of 60 terms


def test_dark_lightings_become_zero_and_stay_finite() -> None:
    for space in ("linear", "gamma"):
        encoding = Encoding(space)
        values = jnp.zeros((2, 5, 3))
        scale = encoding.scale(values)
        assert (scale == 0).all()
        assert (encoding.encode(values, scale) == 0).all()
        gradient = jax.grad(lambda v, e=encoding, s=scale: e.encode(v, s).sum())(values)
        assert jnp.isfinite(gradient).all()


def test_clamp_cuts_negative_light_only() -> None:
    encoded = jnp.asarray([[[-0.5, 0.0, 0.5]]])
    scale = jnp.full((1, 3), 2.0)
    assert (Encoding().decode(encoded, scale) == jnp.asarray([[[0.0, 0.0, 1.0]]])).all()
    assert Encoding("gamma").decode(encoded, scale, clamp=False)[0, 0, 0] < 0


# --- basis ------------------------------------------------------------------------------------------------------------


def test_singular_values_against_float64_svd() -> None:
    data, _ = decaying(32, 700, 1e-6)
    basis = fit_basis(jnp.asarray(data), jnp.ones(700), bases=32)
    exact = np.linalg.svd(data.astype(np.float64), compute_uv=False)
    # A float64 Gram matrix squares the condition: relative error eps64 (sigma_1 / sigma_k)² times a modest factor.
    bound = 32 * np.finfo(float).eps * (exact[0] / exact) ** 2
    assert (np.abs(np.asarray(basis.singular_values) - exact) / exact <= np.maximum(bound, 1e-12)).all()
    assert bound[-1] < 0.01


@pytest.mark.parametrize("centre", [False, True])
def test_basis_is_orthonormal_under_weights(centre: bool) -> None:
    rng = np.random.default_rng(2)
    data = (rng.random((12, 5)) @ rng.random((5, 400)) + 1e-4 * rng.random((12, 400))).astype(np.float32)
    weights = rng.random(400).astype(np.float32)
    weights /= weights.sum()
    basis = fit_basis(jnp.asarray(data), jnp.asarray(weights), bases=8, centre=centre)
    U = np.asarray(basis.vectors, np.float64)
    # Vectors are rounded to float32 once: each product of two moves by at most 2 eps32 of its size.
    np.testing.assert_allclose((U * weights) @ U.T, np.eye(8), atol=4 * EPS32)
    peaks = U[np.arange(8), np.abs(U).argmax(1)]
    assert (peaks > 0).all(), "sign rule"
    mean = data.mean(0) if centre else 0
    np.testing.assert_allclose(basis.coefficients, ((data - mean) * weights) @ U.T, atol=1e-6)


def test_projection_is_the_best_of_its_rank() -> None:
    data, sigma = decaying(20, 300, 1e-3)
    basis = fit_basis(jnp.asarray(data), jnp.ones(300), bases=6)
    rest = data - np.asarray(basis.coefficients) @ np.asarray(basis.vectors)
    # Eckart-Young: the squared error is the sum of the squared singular values left out.
    np.testing.assert_allclose(np.linalg.norm(rest), np.sqrt((sigma[6:] ** 2).sum()), rtol=1e-4)


def test_more_bases_than_rank_gives_fewer_and_says_so() -> None:
    data = np.outer(np.arange(1, 6), np.ones(30)).astype(np.float32)
    basis = fit_basis(jnp.asarray(data), jnp.ones(30), bases=4)
    assert (basis.rank, len(basis.vectors), basis.status) == (1, 1, "rank_deficient")
    assert fit_basis(jnp.zeros((5, 30)), jnp.ones(30), bases=4).status == "no_signal"
    equal = fit_basis(jnp.ones((5, 30)), jnp.ones(30), bases=4, centre=True)
    assert (equal.rank, equal.status) == (0, "rank_deficient"), "the mean is light"


def test_rank_is_found_beyond_reach_of_a_float32_gram() -> None:
    data, sigma = decaying(16, 500, 1e-5)
    assert fit_basis(jnp.asarray(data), jnp.ones(500), bases=16).rank == 16
    gram32 = data @ data.T
    crude = np.sqrt(np.maximum(np.linalg.eigvalsh(gram32)[::-1], 0))
    assert np.abs(crude - sigma)[-1] > 0.5 * sigma[-1], "the bad example is bad: it loses what float64 keeps"
    assert RANK_CUT < 1e-5


def test_entry_weights_sum_to_one() -> None:
    area = np.array([1.0, 2.0, 5.0])
    for channels in ("mono", "multi"):
        for kind in ("area", "texel"):
            weights = entry_weights(area, kind, channels)
            assert weights.sum() == pytest.approx(1)
            assert len(weights) == (3 if channels == "mono" else 9)
    assert entry_weights(area, "area", "mono")[2] == pytest.approx(5 / 8)


# --- transfer ---------------------------------------------------------------------------------------------------------


def problem(lightings: int, points: int, bases: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    X = rng.random((lightings, points)).astype(np.float32)
    C = (X @ rng.normal(size=(points, bases)) + 0.1 * rng.normal(size=(lightings, bases))).astype(np.float32)
    return X, C


@pytest.mark.parametrize(("lightings", "points"), [(40, 12), (12, 40)])
@pytest.mark.parametrize("ridge", [1e-8, 1e-3, 1.0, 1e4])
def test_transfer_against_normal_equations_in_both_forms(lightings: int, points: int, ridge: float) -> None:
    X, C = problem(lightings, points, 5)
    got = np.asarray(fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge).matrix, float)
    X, C = X.astype(float), C.astype(float)
    primal = C.T @ X @ np.linalg.inv(X.T @ X + ridge * np.eye(points))
    dual = C.T @ np.linalg.inv(X @ X.T + ridge * np.eye(lightings)) @ X
    condition = (np.linalg.norm(X, 2) ** 2 + ridge) / ridge
    # The normal equations are the inaccurate side: eps64 times their condition; the result is rounded to float32.
    tolerance = np.abs(primal).max() * (10 * np.finfo(float).eps * condition + EPS32)
    np.testing.assert_allclose(got, primal if points < lightings else dual, atol=tolerance)


def test_ridge_zero_is_the_pseudo_inverse() -> None:
    X, C = problem(30, 10, 4)
    X[:, 9] = X[:, 8]  # a duplicate measurement point
    fitted = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=0.0)
    expected = (np.linalg.pinv(X.astype(float), rcond=1e-7) @ C).T
    np.testing.assert_allclose(fitted.matrix, expected, atol=1e-5 * np.abs(expected).max())
    assert fitted.rank == 9
    assert np.isfinite(fitted.matrix).all()


@pytest.mark.parametrize("intercept", [False, True])
@pytest.mark.parametrize("ridge", [1e-3, 0.1, 10.0])
@pytest.mark.parametrize(("lightings", "points"), [(25, 6), (8, 20)])
def test_leave_one_out_against_brute_force(intercept: bool, ridge: float, lightings: int, points: int) -> None:
    X, C = problem(lightings, points, 3)
    weight = np.random.default_rng(5).random(lightings)
    closed = fit_transfer(
        jnp.asarray(X), jnp.asarray(C), ridge=ridge, importance=jnp.asarray(weight), intercept=intercept
    ).leave_one_out
    X, C = X.astype(float), C.astype(float)
    squares = []
    for left in range(lightings):
        keep = np.arange(lightings) != left
        x0, c0 = (X[keep].mean(0), C[keep].mean(0)) if intercept else (0, 0)
        A = X[keep] - x0
        M = np.linalg.solve(A.T @ A + ridge * np.eye(points), A.T @ (C[keep] - c0))
        squares.append(((C[left] - c0 - (X[left] - x0) @ M) ** 2).sum())
    expected = np.sqrt((weight * squares).sum() / weight.sum())
    assert closed == pytest.approx(expected, rel=1e-6)


def test_auto_takes_the_lowest_leave_one_out() -> None:
    X, C = problem(30, 25, 4)
    fitted = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge="auto")
    path = np.asarray(fitted.path)
    assert fitted.ridge == path[path[:, 1].argmin(), 0]
    assert np.isfinite(path).all()

    def mean_of_norms(ridge: float) -> float:
        return float(np.sqrt(left_out(decompose(jnp.asarray(X), jnp.asarray(C)), np.array([ridge]))[0][0]).mean())

    assert path[:, 1].min() == pytest.approx(mean_of_norms(fitted.ridge))
    for ridge in (0.0, 1e-3, 0.1, 10.0):
        assert path[:, 1].min() <= mean_of_norms(ridge) * 1.02  # the grid has four values per decade


def test_ridge_per_point() -> None:
    X, C = problem(40, 6, 3)
    equal = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=(0.3,) * 6)
    np.testing.assert_allclose(equal.matrix, fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=0.3).matrix, atol=1e-5)
    uneven = (0.1, 1.0, 5.0, 0.2, 0.7, 100.0)
    got = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=uneven).matrix
    Xd = X.astype(float)
    np.testing.assert_allclose(got, (np.linalg.inv(Xd.T @ Xd + np.diag(uneven)) @ Xd.T @ C).T, atol=1e-5)
    with pytest.raises(UserError, match="got 2 values, expected one per measurement"):
        fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=(1.0, 2.0))
    with pytest.raises(UserError, match="expected 1e-100 to"):
        fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=(0.0, 1.0, 1.0, 1.0, 1.0, 1.0))


def test_intercept_learns_an_offset() -> None:
    X, C = problem(60, 5, 3)
    fitted = fit_transfer(jnp.asarray(X), jnp.asarray(C + 7), ridge=1e-9, intercept=True)
    plain = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=1e-9, intercept=True)
    np.testing.assert_allclose(fitted.matrix, plain.matrix, atol=1e-4)
    np.testing.assert_allclose(fitted.intercept - plain.intercept, 7, atol=1e-5)


def test_trouble_is_a_status() -> None:
    X, C = problem(20, 8, 4)
    assert fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=0.0).status == "ok"
    assert fit_transfer(jnp.zeros((20, 8)), jnp.asarray(C), ridge=0.0).status == "no_signal"
    same = np.tile(X[:, :1], (1, 8))
    assert fit_transfer(jnp.asarray(same), jnp.asarray(C), ridge=1e-3).status == "rank_deficient"
    near = X.copy()
    near[:, 7] = near[:, 6] * (1 + 3e-7 * np.arange(20))
    risky = fit_transfer(jnp.asarray(near), jnp.asarray(C), ridge=0.0)
    assert risky.condition > 1e6
    assert risky.status == "ill_conditioned"
    assert fit_transfer(jnp.asarray(near), jnp.asarray(C), ridge=1e-3).status == "ok"
    for bad in (same, near, np.zeros_like(X)):
        for ridge in ("auto", 0.0, 1e-30, 1e30):
            assert np.isfinite(fit_transfer(jnp.asarray(bad), jnp.asarray(C), ridge=ridge).matrix).all()
    with pytest.raises((ValueError, TypeCheckError)):  # the second under the test's own shape checks
        fit_transfer(jnp.asarray(X), jnp.asarray(C[:3]))


@given(st.integers(0, 10_000), st.sampled_from([2, 20]), st.sampled_from([1, 6, 20]), st.sampled_from([0.0, 1e-6, 1e-2, 1.0]))
@settings(max_examples=50)
def test_residual_never_grows_with_less_ridge(seed: int, lightings: int, points: int, ridge: float) -> None:
    X, C = problem(lightings, points, 2, seed)

    def residual(value: float) -> float:
        M = np.asarray(fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=value).matrix, float)
        return float(np.linalg.norm(C - X @ M.T))

    # M is float32: its rounding can move the residual by eps32 times the size of the product.
    slack = 10 * EPS32 * np.linalg.norm(C) * np.sqrt(points)
    assert residual(ridge) <= residual(10 * ridge + 1e-4) + slack


def test_global_precision_is_left_alone() -> None:
    before = jax.config.jax_enable_x64
    X, C = problem(10, 5, 2)
    fit_transfer(jnp.asarray(X), jnp.asarray(C))
    fit_basis(jnp.asarray(X), jnp.ones(5), bases=2)
    assert jax.config.jax_enable_x64 == before
    assert jnp.ones(1).dtype == jnp.float32
