"""A search for counterexamples: random problems of every size, rank and scale, against the laws of relighting.

Each law takes a drawn problem and asserts. The search is the same in every run (`derandomize`); what it ever finds becomes a
named case of the catalogue (`hard_cases.py`). Sizes come from short lists, since every new shape is compiled.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import hard_arrays
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hard_judges import bound_left_out, judge, judge_basis, judge_fit, left_with, right_transfer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles import TINY32, over_bound

import ddprt
from ddprt.fitting.basis import fit_basis
from ddprt.fitting.encoding import Encoding
from ddprt.fitting.transfer import fit_transfer

# --- problems ---------------------------------------------------------------------------------------------------------

_SEEDS = st.integers(0, 2**32 - 1)
_DECADES = st.integers(-30, 30)


def light(seed: int, rows: int, columns: int, rank: int, decade: int, noise: float, flaws: list[str]) -> np.ndarray:
    """Float32 data of so many directions, at most 10^decade large, with flaws that make it harder."""
    rng = np.random.default_rng(seed)
    values = rng.random((rows, rank)) @ rng.normal(size=(rank, columns)) + noise * rng.normal(size=(rows, columns))
    if "twin columns" in flaws:
        values[:, -1] = values[:, 0]
    if "near columns" in flaws:
        values[:, -2] = values[:, 1] * (1 + 1e-7 * rng.random(rows))
    if "dark column" in flaws:
        values[:, columns // 2] = 0
    if "dark row" in flaws:
        values[rows // 2] = 0
    if "bright row" in flaws:
        values[0] *= 1e6
    if "decades" in flaws:
        values *= np.logspace(-6, 6, columns)
    values *= 10.0**decade / np.abs(values).max()
    return np.where(np.abs(values) < TINY32, 0, values).astype(np.float32)  # what code may flush is a case of the catalogue


_KINDS = ["twin columns", "near columns", "dark column", "dark row", "bright row", "decades"]
_FLAWS = st.lists(st.sampled_from(_KINDS), max_size=3, unique=True)
_NOISES = st.sampled_from([0.0, 1e-7, 1e-3])
_SHAPED: dict[str, Any] = {"seed": _SEEDS, "rank": st.integers(1, 8), "noise": _NOISES, "flaws": _FLAWS}


@dataclass(frozen=True)
class Regression:
    """Measurements and what they should tell."""

    seed: int
    lightings: int
    points: int
    rank: int
    decade: int
    contrast: int
    noise: float
    flaws: list[str]
    ridge: Any
    intercept: bool

    def draw(self) -> tuple[np.ndarray, np.ndarray, Any]:
        """X, C and the ridge in units of X²."""
        X = light(self.seed, self.lightings, self.points, self.rank, self.decade, self.noise, self.flaws)
        map_ = np.random.default_rng(self.seed + 1).normal(size=(self.points, 3))
        noise = np.random.default_rng(self.seed + 2).normal(size=(self.lightings, 3)) * np.linalg.norm(X.astype(float))
        C = ((X.astype(float) @ map_ + 1e-2 * noise) * 10.0**self.contrast).astype(np.float32)
        unit = float(np.linalg.norm(X.astype(float), 2)) ** 2 or 1.0
        if self.ridge == "per point":
            return X, C, tuple((unit * 10.0 ** np.linspace(-4, 4, self.points)).tolist())
        return X, C, self.ridge if self.ridge == "auto" else self.ridge * unit


_REGRESSIONS = st.builds(
    Regression,
    **_SHAPED,
    lightings=st.sampled_from([5, 12]),
    points=st.sampled_from([4, 10]),
    decade=st.integers(-25, 30),
    contrast=st.integers(-4, 4),
    ridge=st.sampled_from([0.0, "auto", "per point"]) | st.integers(-30, 6).map(lambda power: 10.0**power),
    intercept=st.booleans(),
)


def _fit(X: np.ndarray, C: np.ndarray, ridge: Any, intercept: bool) -> Any:
    return fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge, intercept=intercept)


# --- laws -------------------------------------------------------------------------------------------------------------


def transfer_is_right(problem: Regression) -> None:
    """Finite, with a status, the ridge solution within its bound; the path holds what was chosen."""
    X, C, ridge = problem.draw()
    fit = _fit(X, C, ridge, problem.intercept)
    assert np.isfinite(fit.matrix).all()
    assert np.isfinite(fit.leave_one_out)
    assert judge_fit(fit, X, C, fit.ridge if ridge == "auto" else ridge, problem.intercept) <= 1
    if ridge == "auto":
        path = np.asarray(fit.path)
        assert np.isfinite(path).all()
        assert fit.ridge == path[path[:, 1].argmin(), 0]


def transfer_has_no_units(problem: Regression) -> None:
    """Measurements times 2^k, their ridge times 4^k and targets times 2^j change no digit of the matrix: exactly 2^(j - k)."""
    X, C, ridge = problem.draw()
    base = _fit(X, C, ridge, problem.intercept)
    k, j = 1 + problem.seed % 9, 3 - problem.seed % 7
    scaled = (
        tuple(value * 4.0**k for value in ridge) if isinstance(ridge, tuple) else ridge if ridge == "auto" else ridge * 4.0**k
    )
    other = _fit(np.ldexp(X, k), np.ldexp(C, j), scaled, problem.intercept)
    np.testing.assert_array_equal(np.ldexp(np.asarray(base.matrix), j - k), other.matrix)
    assert (base.status, base.rank) == (other.status, other.rank)


def transfer_knows_no_order(problem: Regression) -> None:
    """Lightings or points in another order: the same matrix, within the bound of the original problem."""
    X, C, ridge = problem.draw()
    if ridge == "auto":
        ridge = _fit(X, C, ridge, problem.intercept).ridge
    rng = np.random.default_rng(problem.seed)
    rows, columns = rng.permutation(len(X)), rng.permutation(X.shape[1])
    turned = tuple(np.array(ridge)[columns].tolist()) if isinstance(ridge, tuple) else ridge
    other = _fit(X[rows][:, columns], C[rows], turned, problem.intercept)
    means = (part.astype(float).mean(0) * problem.intercept for part in (X, C))
    exact, bound = right_transfer(X - next(means), C - next(means), ridge)
    assert over_bound(np.asarray(other.matrix, float) - exact[:, columns], bound[:, columns]) <= 1


def leaving_one_out_is_refitting(problem: Regression) -> None:
    """The closed form against as many fits as lightings."""
    X, C, ridge = problem.draw()
    if not isinstance(ridge, float) or ridge < 1e-6 * np.linalg.norm(X.astype(float), 2) ** 2 or ridge == 0:
        ridge = 1e-4 * float(np.linalg.norm(X.astype(float), 2)) ** 2 or 1.0
    got = _fit(X, C, ridge, problem.intercept).leave_one_out
    A, B, squares = X.astype(float), C.astype(float), []
    if any(left_with(A, left).all() for left in range(len(A))):
        return  # nothing is left to learn from
    for left in range(len(A)):
        keep = ~left_with(A, left)
        x0, c0 = (A[keep].mean(0), B[keep].mean(0)) if problem.intercept else (0.0, 0.0)
        M = oracles.truncated_ridge(A[keep] - x0, B[keep] - c0, ridge, min(A[keep].shape))
        squares.append(np.sum((B[left] - c0 - (A[left] - x0) @ M.T) ** 2))
    expected = float(np.sqrt(np.mean(squares)))
    assert over_bound(got - expected, 2 * bound_left_out(A, B, ridge, problem.intercept)) <= 1


@dataclass(frozen=True)
class Columns:
    """Rows for a basis."""

    seed: int
    rank: int
    decade: int
    noise: float
    flaws: list[str]
    bases: int
    centre: bool


_COLUMNS = st.builds(Columns, **_SHAPED, decade=st.integers(-20, 30), bases=st.sampled_from([1, 4, 20]), centre=st.booleans())


def basis_is_right(problem: Columns) -> None:
    """Orthonormal, optimal, of the right rank; twice the light and another order of columns leave the space alone."""
    rows = light(problem.seed, 18, 23, problem.rank, problem.decade, problem.noise, problem.flaws)
    weights = np.random.default_rng(problem.seed).random(23).astype(np.float32)
    weights /= weights.sum()
    fit = lambda data: fit_basis(jnp.asarray(data), jnp.asarray(weights), bases=problem.bases, centre=problem.centre)  # noqa: E731
    basis, double = fit(rows), fit(np.ldexp(rows, 5))
    assert np.isfinite(basis.vectors).all()
    assert len(basis.vectors) == min(problem.bases, basis.rank)
    assert (basis.status == "ok") == (len(basis.vectors) == problem.bases)
    np.testing.assert_array_equal(basis.vectors, double.vectors)
    np.testing.assert_array_equal(np.ldexp(np.asarray(basis.singular_values), 5), double.singular_values)
    turned = fit(rows[np.random.default_rng(problem.seed).permutation(len(rows))])
    for found in (basis, turned):
        report = SimpleNamespace(singular_values=np.asarray(found.singular_values), numerical_rank=found.rank)
        U, mean = np.asarray(found.vectors, float), np.asarray(found.mean, float)
        assert judge_basis(rows, weights, U, mean, report, problem.centre) <= 1


@dataclass(frozen=True)
class Scaling:
    """Light to be encoded and decoded."""

    seed: int
    decade: int
    flaws: list[str]
    encoding: Encoding


_SCALINGS = st.builds(
    Scaling,
    seed=_SEEDS,
    decade=_DECADES,
    flaws=_FLAWS,
    encoding=st.builds(
        Encoding,
        space=st.sampled_from(["linear", "gamma"]),
        gamma=st.sampled_from([1.0, 2.2, 10.0]),
        channels=st.sampled_from(["mono", "multi"]),
    ),
)


def encoding_is_right(problem: Scaling) -> None:
    """Encoded light within its bound, whatever its size; twice the light is encoded alike; black stays black."""
    values = light(problem.seed, 4, 30, 8, problem.decade, 0.0, problem.flaws).reshape(4, 10, 3)
    encoding = problem.encoding
    scale = encoding.scale(jnp.asarray(values))
    encoded = np.asarray(encoding.encode(jnp.asarray(values), scale))
    exact, bound = oracles.bound_encode(values.astype(float), values.astype(float), encoding)
    assert over_bound(encoded - exact, bound) <= 1
    double = encoding.scale(jnp.asarray(2 * values))
    np.testing.assert_array_equal(double, 2 * scale)
    np.testing.assert_array_equal(encoding.encode(jnp.asarray(2 * values), double), encoded)
    dark = jnp.zeros_like(values)
    assert (np.asarray(encoding.encode(dark, encoding.scale(dark))) == 0).all()


@dataclass(frozen=True)
class Chain:
    """A whole dataset and how it is fitted."""

    seed: int
    rank: int
    decade: int
    flaws: list[str]
    options: dict[str, Any]


_CHAINS = st.builds(
    Chain,
    seed=_SEEDS,
    rank=st.sampled_from([3, 8]),
    decade=st.integers(-25, 25),
    flaws=_FLAWS.map(lambda flaws: [flaw for flaw in flaws if flaw != "dark row"]),  # another shape each
    options=st.fixed_dictionaries(
        {
            "space": st.sampled_from(["linear", "gamma"]),
            "channels": st.sampled_from(["mono", "multi"]),
            "centre": st.sampled_from(["none", "mean"]),
            "ridge": st.sampled_from(["auto", 0.0, 1e-8, 1e-2, 1e6]),
        }
    ),
)


def relighting_is_right(problem: Chain) -> None:
    """From light to light: every layer within its bound, and the laws of `Model`."""
    rng = np.random.default_rng(problem.seed)
    measured, indirect = hard_arrays.room(problem.rank, seed=problem.seed % 2**31)
    size = np.float32(10.0**problem.decade)
    for part in (measured, indirect):
        if "twin columns" in problem.flaws:
            part[:, -1] = part[:, 0]
        if "near columns" in problem.flaws:
            part[:, -2] = part[:, 1] * (1 + 1e-7 * rng.random((len(part), 1)))
        if "dark column" in problem.flaws:
            part[:, 2] = 0
        if "bright row" in problem.flaws:
            part[0] *= 1e6
        if "decades" in problem.flaws:
            part *= np.logspace(-6, 6, part.shape[1]).astype(np.float32)[:, None]
        part *= size
    data = hard_arrays.make_data(measured, indirect)
    model = ddprt.fit(data, bases=hard_arrays.BASES, **problem.options)
    probes = measured[-hard_arrays.TEST :]
    out = model.predict(probes)
    assert np.isfinite(out).all()
    assert judge(data, model, probes) <= 1
    assert (model.predict(0 * probes) == 0).all()
    # Exactly, but for what falls below the smallest normal number on one side.
    assert (np.abs(model.predict(2 * probes).astype(float) - 2 * out.astype(float)) <= 2 * TINY32).all()
    with tempfile.TemporaryDirectory() as folder:
        model.save(folder)
        np.testing.assert_array_equal(ddprt.load_model(folder).predict(probes), out)
    if problem.options["space"] == "linear" and problem.options["centre"] == "none":
        # Multiples of one power of two, so that their sum is exact.
        step = 2.0 ** (np.floor(np.log2(probes.max())) - 12)
        one, two = (np.rint(part / step).astype(np.float32) * np.float32(step) for part in (probes[:2], probes[2:]))
        parts = [np.asarray(model.predict(part, clamp=False), float) for part in (one, two, one + two)]
        bounds = [oracles.bound_predict(model.relighter, model.encoding, part)[1] for part in (one, two, one + two)]
        assert over_bound(parts[2] - parts[0] - parts[1], sum(bounds)) <= 1


# --- the search -------------------------------------------------------------------------------------------------------

LAWS: dict[str, tuple[Callable[[Any], None], Any, int]] = {
    "transfer is right": (transfer_is_right, _REGRESSIONS, 600),
    "transfer has no units": (transfer_has_no_units, _REGRESSIONS, 300),
    "transfer knows no order": (transfer_knows_no_order, _REGRESSIONS, 300),
    "leaving one out is refitting": (leaving_one_out_is_refitting, _REGRESSIONS, 300),
    "basis is right": (basis_is_right, _COLUMNS, 300),
    "encoding is right": (encoding_is_right, _SCALINGS, 300),
    "relighting is right": (relighting_is_right, _CHAINS, 100),
}
"""Law, problems and how many of them, by name; together more than 2000."""


def search(name: str, examples: int) -> int:
    """Tries a law on so many problems, the same in every run; the number that was tried."""
    law, problems, _ = LAWS[name]
    tried = 0

    @settings(max_examples=examples, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
    @given(problems)
    def run(problem: Any) -> None:
        nonlocal tried
        tried += 1
        law(problem)

    run()
    return tried


@pytest.mark.parametrize("name", LAWS)
def test_law_on_a_few_problems(name: str) -> None:
    search(name, LAWS[name][2] // 60)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_law_on_many_problems(name: str) -> None:
    assert search(name, LAWS[name][2]) >= LAWS[name][2]


def test_the_search_is_wide_enough() -> None:
    assert sum(examples for _, _, examples in LAWS.values()) >= 2000
