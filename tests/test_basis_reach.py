"""What the basis promises: values to 1 % down to 1e-7, spaces within Wedin's bound, orthonormal to 1e-6.

Truth is a singular value decomposition of the float32 data as they are, in float64 (whose own error, eps64 sigma_1, is 2e-9 of
the smallest value that is checked) or in mpmath. A float32 Gram matrix must fail each check that it meets.
"""

import ast
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core
from oracles import exact_singular_values

from ddprt.fitting import basis as module
from ddprt.fitting.basis import RANK_CUT, fit_basis

EPS32, EPS64 = float(np.finfo(np.float32).eps), float(np.finfo(np.float64).eps)

SPECTRA: dict[str, Callable[[int], np.ndarray]] = {
    "flat": np.ones,
    "falls to 1e-3": lambda n: np.logspace(0, -3, n),
    "falls to 1e-7": lambda n: np.logspace(0, -6.99, n),
    "falls to 1e-16": lambda n: np.logspace(0, -16, n),
    "one large": lambda n: np.append(1, np.full(n - 1, 1.02e-7)),
    "half deep": lambda n: np.where(np.arange(n) < n // 2, 1, 1.5e-7),
    "clusters": lambda n: np.repeat(np.logspace(0, -6.9, -(-n // 4)), 4)[:n],
}


def made(sigma: np.ndarray, entries: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Float32 columns that have about these singular values under the weights, which span six decades."""
    rng = np.random.default_rng(seed)
    weights = 10 ** rng.uniform(-6, 0, entries)
    weights = (weights / weights.sum()).astype(np.float32)
    left = np.linalg.qr(rng.normal(size=(len(sigma), len(sigma))))[0]
    right = np.linalg.qr(rng.normal(size=(entries, len(sigma))))[0].T
    return ((left * sigma) @ right / np.sqrt(weights.astype(float))).astype(np.float32), weights


def weighted(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return columns.astype(float) * np.sqrt(weights.astype(float))


def fit(columns: np.ndarray, weights: np.ndarray, bases: int, centre: bool = False) -> module.Basis:
    return fit_basis(jnp.asarray(columns), jnp.asarray(weights), bases=bases, centre=centre)


def by_float32_gram(columns: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The bad example: values and right vectors."""
    rows = columns * np.sqrt(weights)
    squares, rotation = np.linalg.eigh(rows @ rows.T)
    sigma = np.sqrt(np.maximum(squares[::-1], 0)).astype(float)
    return sigma, (rotation[:, ::-1] / np.maximum(sigma, 1e-30)).T @ weighted(columns, weights)


def over_value_bound(sigma: np.ndarray, exact: np.ndarray) -> float:
    """Largest error of a value over what it may be, over all values above the rank cut.

    Weyl: the squares, eigenvalues of G, move by at most ||dG||. An inner product of m terms summed in tiles and an
    eigenvalue routine are off by at most n eps64 sigma_1² together (n stands for the usual modest factor of both), so a
    root by n eps64 sigma_1² / (2 sigma_k), and by the promised 1 % where that is more.
    """
    exact = exact[exact > RANK_CUT * exact[0]]
    allowed = np.minimum(0.01, len(sigma) * EPS64 / 2 * (exact[0] / exact) ** 2 + len(sigma) * EPS64)
    return float((np.abs(sigma[: len(exact)] - exact) / exact / allowed).max())


def over_space_bound(vectors: np.ndarray, rows: np.ndarray) -> float:
    """Largest sine between leading spaces over what it may be; `vectors` and `rows` carry the root of the weights.

    Wedin: a perturbation E of the data turns the leading k right singular vectors by at most ||E|| / (s_k - s_k+1). Allowed is
    what the rounding of the float32 data allows, ||E|| <= 2^-24 ||rows||_F, plus the rounding of the k float32 vectors, each
    by 2^-24 of its length 1. Within a cluster the gap is nothing, and so is said.
    """
    _, sigma, right = np.linalg.svd(rows, full_matrices=False)
    worst = 0.0
    for k in range(1, len(vectors) + 1):
        gap = sigma[k - 1] - (sigma[k] if k < len(sigma) else 0)
        allowed = EPS32 / 2 * (np.linalg.norm(rows) / max(gap, 1e-300) + np.sqrt(k))
        rest = vectors[:k] - vectors[:k] @ right[:k].T @ right[:k]
        worst = max(worst, float(np.linalg.norm(rest, 2) / allowed))
    return worst


# --- values and spaces ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SPECTRA)
def test_values_to_one_per_cent_and_spaces_within_wedin(name: str) -> None:
    n = 48
    columns, weights = made(SPECTRA[name](n), 1000)
    rows = weighted(columns, weights)
    exact = np.linalg.svd(rows, compute_uv=False)
    basis = fit(columns, weights, n)
    assert over_value_bound(np.asarray(basis.singular_values), exact) <= 1
    assert over_space_bound(np.asarray(basis.vectors) * np.sqrt(weights.astype(float)), rows) <= 1
    assert basis.rank == (exact > RANK_CUT * exact[0]).sum()


@pytest.mark.parametrize("name", ["falls to 1e-7", "one large", "half deep"])
def test_a_float32_gram_fails_both_checks(name: str) -> None:
    columns, weights = made(SPECTRA[name](48), 1500)
    rows = weighted(columns, weights)
    sigma, vectors = by_float32_gram(columns, weights)
    assert over_value_bound(sigma, np.linalg.svd(rows, compute_uv=False)) > 50
    # Only as many vectors as that matrix can tell: all others would fail the more.
    if name == "falls to 1e-7":
        assert over_space_bound(vectors[:24], rows) > 1


@pytest.mark.parametrize("name", ["falls to 1e-7", "one large", "half deep"])
def test_one_gram_matrix_alone_is_not_enough(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    columns, weights = made(SPECTRA[name](48), 1500)
    exact = np.linalg.svd(weighted(columns, weights), compute_uv=False)
    twice = np.abs(np.asarray(fit(columns, weights, 1).singular_values) / exact - 1).max()
    monkeypatch.setattr(module, "_deep", lambda sigma: None)
    once = np.abs(np.asarray(fit(columns, weights, 1).singular_values) / exact - 1).max()
    # The second Gram matrix leaves the error of the product with the left vectors, n eps64 sigma_1 against 1e-7 sigma_1.
    assert twice <= 48 * EPS64 / 1e-7 + 48 * EPS64 / 2 / (50 * np.sqrt(48) * EPS64)
    assert once > twice


@pytest.mark.parametrize("name", ["falls to 1e-7", "half deep"])
def test_values_against_forty_digits(name: str) -> None:
    columns, weights = made(SPECTRA[name](6), 10)
    exact = exact_singular_values(columns, weights)
    assert over_value_bound(np.asarray(fit(columns, weights, 6).singular_values), exact) <= 1


def test_a_cluster_has_a_space_but_no_vectors() -> None:
    sigma = np.array([1, 1, 1, 0.1, 0.01])
    columns, weights = made(sigma, 400)
    basis = fit(columns, weights, 3)
    rows = weighted(columns, weights)
    vectors = np.asarray(basis.vectors) * np.sqrt(weights.astype(float))
    right = np.linalg.svd(rows, full_matrices=False)[2][:3]
    # Wedin with the gap below the cluster, 0.9.
    allowed = EPS32 / 2 * (np.linalg.norm(rows) / 0.9 + np.sqrt(3))
    assert np.linalg.norm(vectors - vectors @ right.T @ right, 2) <= allowed


@pytest.mark.parametrize("name", ["falls to 1e-7", "half deep"])
def test_order_and_padding_of_columns_do_not_matter(name: str) -> None:
    columns, weights = made(SPECTRA[name](16), 600)
    order = np.random.default_rng(1).permutation(16)
    exact = np.linalg.svd(weighted(columns, weights), compute_uv=False)
    rows = weighted(columns, weights)
    padded = np.concatenate([columns, np.zeros((5, 600), np.float32)])
    for other in (columns[order], padded):
        basis = fit(other, weights, 16)
        assert over_value_bound(np.asarray(basis.singular_values), exact) <= 1
        assert over_space_bound(np.asarray(basis.vectors) * np.sqrt(weights.astype(float)), rows) <= 1


# --- vectors and coefficients -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("name", ["falls to 1e-7", "half deep"])
def test_orthonormal_signed_and_coefficients_agree(name: str, centre: bool) -> None:
    columns, weights = made(SPECTRA[name](32), 1500)
    basis = fit(columns, weights, 32, centre)
    U, W = np.asarray(basis.vectors, float), weights.astype(float)
    # Each entry is rounded once, by 2^-24 of itself: an inner product moves by at most 2^-23 |u| W |v|, and |u| W |u| = 1.
    assert np.abs((U * W) @ U.T - np.eye(len(U))).max() <= EPS32 * (1 + 1e-3) <= 1e-6
    assert (U.max(1) >= -U.min(1)).all()
    centred = columns.astype(float) - (columns.astype(float).mean(0) if centre else 0)
    # The vectors' rounding d has |d|_W <= 2^-24, so a W d is at most 2^-24 |a|_W; as much again for float64's share.
    size = np.sqrt((centred**2 * W).sum(1, keepdims=True))
    assert (np.abs(np.asarray(basis.coefficients) - (centred * W) @ U.T) <= EPS32 * size).all()


@pytest.mark.parametrize("power", [-100, 100])
def test_the_size_of_the_data_does_not_matter(power: int) -> None:
    columns, weights = made(SPECTRA["falls to 1e-3"](12), 300)
    one, other = fit(columns, weights, 12), fit(columns * np.float32(2.0**power), weights, 12)
    # A power of two changes no rounding, and float64 holds the squares.
    np.testing.assert_array_equal(np.asarray(one.singular_values) * 2.0**power, other.singular_values)
    np.testing.assert_array_equal(one.vectors, other.vectors)


def test_columns_sixty_decades_apart() -> None:
    rng = np.random.default_rng(0)
    columns = (rng.random((7, 200)) * 10.0 ** np.arange(-30, 31, 10)[:, None]).astype(np.float32)
    basis = fit(columns, np.full(200, 1 / 200, np.float32), 7)
    assert (basis.rank, basis.status) == (1, "rank_deficient")  # all other columns are less than 1e-7 of the largest
    assert np.isfinite(np.asarray(basis.vectors)).all()
    assert np.isfinite(np.asarray(basis.coefficients)).all()


@pytest.mark.parametrize("size", [1e-36, 3e38])
def test_ends_of_the_float32_range(size: float) -> None:
    rng = np.random.default_rng(0)
    columns = (rng.uniform(0.5, 1, (5, 200)) * size).astype(np.float32)
    weights = np.full(200, 1 / 200, np.float32)
    basis = fit(columns, weights, 5)
    exact = np.linalg.svd(weighted(columns, weights), compute_uv=False)
    assert basis.status == "ok"
    assert over_value_bound(np.asarray(basis.singular_values), exact) <= 1
    assert np.abs((np.asarray(basis.vectors, float) * weights) @ np.asarray(basis.vectors, float).T - np.eye(5)).max() <= 1e-6


def test_subnormal_columns_are_read_or_named() -> None:
    columns = np.full((3, 50), 1e-40, np.float32)
    basis = fit(columns, np.full(50, 0.02, np.float32), 2)
    assert basis.status == "no_signal" or np.asarray(basis.singular_values)[0] == pytest.approx(np.sqrt(3) * 1e-40, rel=1e-4)
    assert np.isfinite(np.asarray(basis.vectors)).all()


# --- shapes and outcomes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("columns", "bases", "rank", "status"),
    [
        (np.zeros((4, 30)), 2, 0, "no_signal"),
        (np.ones((1, 30)), 1, 1, "ok"),
        (np.outer(np.arange(1, 6), np.arange(30) + 1), 3, 1, "rank_deficient"),
        (np.random.default_rng(0).normal(size=(40, 6)), 6, 6, "ok"),
        (np.random.default_rng(0).normal(size=(40, 6)), 10, 6, "rank_deficient"),
        (np.ones((3, 1)), 1, 1, "ok"),
        (np.eye(8), 8, 8, "ok"),
    ],
)
def test_outcomes(columns: np.ndarray, bases: int, rank: int, status: str) -> None:
    entries = columns.shape[1]
    basis = fit(columns.astype(np.float32), np.full(entries, 1 / entries, np.float32), bases)
    assert (basis.rank, basis.status, len(basis.vectors)) == (rank, status, min(rank, bases))
    for part in (basis.vectors, basis.coefficients, basis.singular_values, basis.mean):
        assert np.isfinite(np.asarray(part)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(value: float) -> None:
    columns = np.ones((3, 20), np.float32)
    columns[1, 7] = value
    with pytest.raises(ValueError, match="expected finite columns"):
        fit(columns, np.full(20, 0.05, np.float32), 2)


# --- the same bits, the same precision --------------------------------------------------------------------------------


def digest() -> str:
    columns, weights = made(SPECTRA["falls to 1e-7"](40), 5000)
    basis = fit(columns, weights, 12, centre=True)
    parts = (basis.vectors, basis.mean, basis.coefficients, basis.singular_values)
    return hashlib.sha256(b"".join(np.asarray(part).tobytes() for part in parts)).hexdigest()


def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    cores = sorted(os.sched_getaffinity(0))
    found = {digest()}
    # Fewer cores for all, and one thread for each library that has a pool of its own.
    command = f"import os; os.sched_setaffinity(0, {{{cores[0]}}}); import test_basis_reach as t; print(t.digest())"
    paths = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    for setting in ({}, {"OPENBLAS_NUM_THREADS": "1", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}):
        run = subprocess.run(
            [sys.executable, "-c", command], env={**os.environ, "PYTHONPATH": paths, **setting}, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr
        found.add(run.stdout.strip())
    assert len(found) == 1


def products(jaxpr: core.Jaxpr) -> Iterator[core.JaxprEqn]:
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda value: hasattr(value, "eqns")):
            if hasattr(inner, "eqns"):
                yield from products(getattr(inner, "jaxpr", inner))


def loose(function: Callable[..., object], *args: object) -> tuple[int, list[str]]:
    """Number of matrix products, and those that a GPU may round to TF32: float32 operands without the highest precision."""
    found = list(products(jax.make_jaxpr(function)(*args).jaxpr))
    highest = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    return len(found), [
        str(equation)
        for equation in found
        if equation.params["precision"] != highest and any(x.aval.dtype != jnp.float64 for x in equation.invars)
    ]


def test_no_product_of_the_basis_may_round_to_tf32() -> None:
    columns, weights = jnp.ones((9, 3000)), jnp.ones(3000)
    with jax.enable_x64(True):
        values, rotation, mean = jnp.ones(9), jnp.eye(9), jnp.zeros(3000)
        for given in (None, mean):
            assert loose(module._decompose, columns, weights, given)[0] == 6  # three in the loop, three for the last tile
            assert loose(module._decompose, columns, weights, given)[1] == []
            sharpen = lambda *args: module._sharpen(*args, 2, 6)  # noqa: E731
            count, faults = loose(sharpen, columns, weights, given, values, rotation)
            assert count >= 6
            assert faults == []
            count, faults = loose(module._projected, rotation, values, rotation, columns, weights, given)
            assert count == 4, "two in the loop, two for the last tile"
            assert faults == []
        for function, arguments in (
            (module._straightened, (rotation, columns)),
            (module._weighed, (rotation, values, rotation, values)),
        ):
            count, faults = loose(function, *arguments)
            assert count == 1
            assert faults == []
    assert len(loose(lambda x: x @ x.T, columns)[1]) == 1, "the check itself bites"


@pytest.mark.parametrize("path", sorted(Path(module.__file__).parent.glob("*.py")), ids=lambda path: path.stem)
def test_every_product_in_fitting_asks_for_the_highest_precision(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {
            f"jnp.{name}" for name in ("matmul", "einsum", "dot", "vdot")
        }:
            assert {word.arg: ast.unparse(word.value) for word in node.keywords}.get("precision") == "'highest'", node.lineno
