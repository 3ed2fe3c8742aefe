"""Lightings that nearly repeat each other are left out together, as brute force does it."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from test_ridge_choice import EPS64, problem, refits, sensitivity

from ddprt.fitting.selection import REPEATS, choose_ridge, decompose, left_out
from ddprt.runtime.trust import _left_out


def repeated(lightings: int, points: int, gap: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Every fourth row is the one before but for `gap` of its size."""
    X, C = problem(lightings, points, seed=seed)
    away = np.random.default_rng(seed + 1).normal(size=X.shape)
    for row in range(1, lightings, 4):
        X[row] = X[row - 1] + gap * np.linalg.norm(X[row - 1]) * away[row] / np.linalg.norm(away[row])
    return X.astype(np.float32), C


@pytest.mark.parametrize("intercept", [False, True])
@pytest.mark.parametrize("ridge", [0.0, 1e-6, 1e-2, 1.0])
@pytest.mark.parametrize(("lightings", "points"), [(24, 6), (12, 20)])
def test_against_refits(lightings: int, points: int, ridge: float, intercept: bool) -> None:
    X, C = repeated(lightings, points, 3e-3)
    spectrum = decompose(jnp.asarray(X), jnp.asarray(C), intercept=intercept)
    pairs = [[row - 1, row] for row in range(1, lightings, 4)]
    assert [rows.tolist() for rows in spectrum.repeats] == [order for a, b in pairs for order in ([a, b], [b, a])]
    group = np.arange(lightings)
    group[1::4] -= 1
    got, exact = left_out(spectrum, np.array([ridge]))[0][0], refits(X, C, ridge, intercept, group)
    # As for single rows in test_ridge_choice.py; a set of two leaves two rows fewer, so the worst of both removals counts.
    worst = max(sensitivity(np.delete(X, row, 0), ridge, intercept) for row in range(lightings))
    stacked = np.sqrt(1 + np.linalg.norm(X, 2) ** 2 / ridge) if ridge > 0 and lightings <= points + 2 else 1.0
    bound = 4 * (lightings + points) * EPS64 * worst * max(worst, stacked) * (C.astype(float) ** 2).sum()
    assert np.abs(got - exact).max() <= bound
    assert np.abs(got - refits(X, C, ridge, intercept)).max() > 1e3 * bound, "its like would have told"


@pytest.mark.parametrize("gap", [1e-5, 1e-4, 1e-3, 5e-3])
def test_noise_given_twice_is_noise(gap: float) -> None:
    """Targets that have nothing to do with the measurements, alike in both of a pair: nothing can be learned."""
    rng = np.random.default_rng(5)
    X, C = rng.random((8, 20)), rng.normal(size=(8, 3))
    away = rng.normal(size=X.shape)
    X = np.concatenate([X, X + gap * np.linalg.norm(X, axis=1)[:, None] * away / np.linalg.norm(away, axis=1)[:, None]])
    C = np.tile(C, (2, 1))

    def chosen(rows: slice) -> Any:
        spectrum = decompose(jnp.asarray(X[rows].astype(np.float32)), jnp.asarray(C[rows].astype(np.float32)))
        return choose_ridge([spectrum], [np.ones(len(X[rows]))], [np.arange(len(X[rows]))])

    once, twice = chosen(slice(8)), chosen(slice(None))
    # Rows given twice double S², so that the same shrinkage needs twice the ridge; the grid has four steps per decade.
    assert twice.ridge / 2 == pytest.approx(once.ridge, rel=10**0.25 - 1)
    assert once.ridge > 1, "each of the eight alone says that the others tell nothing"


def test_a_path_of_small_steps_leaves_out_neighbours_alone() -> None:
    angle = np.arange(40) * 0.6 * REPEATS
    X = np.stack([np.cos(angle), np.sin(angle)], 1).astype(np.float32)
    found = {int(rows[0]): sorted(rows[1:].tolist()) for rows in decompose(jnp.asarray(X), jnp.asarray(X)).repeats}
    assert found == {row: [other for other in (row - 1, row + 1) if 0 <= other < 40] for row in range(40)}


def test_novelty_leaves_out_their_like_too() -> None:
    X, _ = repeated(12, 20, 3e-3)
    ridge = 1e-3
    found = _left_out(decompose(jnp.asarray(X), jnp.asarray(X[:, :2])), ridge)
    D, group = X.astype(float), np.arange(12)
    group[1::4] -= 1
    for row in range(12):
        rest = D[group != group[row]]
        A = rest.T @ rest + ridge * np.eye(20)
        expected = ridge * D[row] @ np.linalg.solve(A, D[row])
        # Two solves with A, each good to its condition.
        assert found[row] == pytest.approx(expected, rel=100 * EPS64 * np.linalg.cond(A) + 1e-9)
