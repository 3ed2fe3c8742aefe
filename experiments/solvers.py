"""Which way to a basis reaches how deep, in how much time and memory?

Question: which singular values and which spaces of (columns x entries) float32 data does each solver get right, over condition
          numbers from 1 to 1e16, and what does it cost, up to 10^6 entries x 1024 columns?
Command:  python experiments/solvers.py accuracy [--quick]    table and docs/solvers.png
          python experiments/solvers.py cost [--quick]        seconds, peak memory and ratio to NumPy's float64 Gram product
          python experiments/solvers.py product [SPECTRUM]    fit_basis at 200 k x 256 against that product, median of rounds
Answer:   docs/stability.md

Rounding data to float32 moves their singular values by up to 6e-8 of their norm, so the truth is that of the rounded data: a
triangular factor's decomposition in float64, good to 1e-15 sigma_1. Where the entries fit one tile, that is the tall-skinny
QR itself: then its line shows no more than that it repeats.
Values count as right within 1 %; leading spaces, where the sine of their angle to the true ones is within Wedin's bound for
the rounding of float32 data, 2^-24 ||A||_F / (sigma_k - sigma_k+1), as long as that bound says anything (is below 0.5).
"""

import sys
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from resource import RUSAGE_SELF, getrusage

import jax
import jax.numpy as jnp
import numpy as np

from ddprt.fitting.basis import fit_basis

EPS32 = float(np.finfo(np.float32).eps)
TILE = 1 << 14
Solution = tuple[np.ndarray, np.ndarray]  # singular values, and right vectors as rows


def package(A: np.ndarray, bases: int) -> Solution:
    """fit_basis; its vectors are float32."""
    basis = fit_basis(jnp.asarray(A), jnp.ones(A.shape[1]), bases=bases)
    return np.asarray(basis.singular_values), np.asarray(basis.vectors)


def gram(A: np.ndarray, bases: int, dtype: type = np.float64) -> Solution:
    """One Gram matrix, in tiles."""
    G = np.zeros((len(A), len(A)), dtype)
    for start in range(0, A.shape[1], TILE):
        rows = A[:, start : start + TILE].astype(dtype)
        G += rows @ rows.T
    squares, rotation = np.linalg.eigh(G)
    sigma = np.sqrt(np.maximum(squares[::-1], 0))
    return sigma, _right(A, sigma, rotation[:, ::-1], bases)


def gram32(A: np.ndarray, bases: int) -> Solution:
    """The bad example."""
    return gram(A, bases, np.float32)


def tall_qr(A: np.ndarray, bases: int) -> Solution:
    """Tall-skinny QR (Demmel et al. 2012): factors of tiles, folded into one triangle, whose SVD is the data's."""
    R = np.zeros((0, len(A)))
    for start in range(0, A.shape[1], TILE):
        R = np.linalg.qr(np.concatenate([R, A[:, start : start + TILE].T.astype(float)]), mode="r")
    _, sigma, rotation = np.linalg.svd(R)
    return sigma, _right(A, sigma, rotation.T, bases)


def full_svd(A: np.ndarray, bases: int) -> Solution:
    _, sigma, right = np.linalg.svd(A.astype(float), full_matrices=False)
    return sigma, right[:bases]


def randomized(A: np.ndarray, bases: int, dtype: type = np.float64) -> Solution:
    """Range finder with two power iterations and ten more vectors than asked for (Halko et al. 2011, 4.4 and 5.1)."""
    A = A.astype(dtype)
    Q = np.linalg.qr(A @ np.random.default_rng(0).normal(size=(A.shape[1], min(bases + 10, len(A)))).astype(dtype))[0]
    for _ in range(2):
        Q = np.linalg.qr(A @ np.linalg.qr(A.T @ Q)[0])[0]
    _, sigma, right = np.linalg.svd(Q.T @ A, full_matrices=False)
    return sigma, right[:bases]


def randomized32(A: np.ndarray, bases: int) -> Solution:
    return randomized(A, bases, np.float32)


def _right(A: np.ndarray, sigma: np.ndarray, rotation: np.ndarray, bases: int) -> np.ndarray:
    """Right vectors by tiles; those without a value are left 0."""
    turn = np.divide(rotation[:, :bases], sigma[:bases], out=np.zeros_like(rotation[:, :bases]), where=sigma[:bases] > 0)
    tiles = [turn.T @ A[:, start : start + TILE].astype(turn.dtype) for start in range(0, A.shape[1], TILE)]
    return np.concatenate(tiles, 1)


SOLVERS: dict[str, Callable[[np.ndarray, int], Solution]] = {
    "fit_basis": package,
    "Gram, float64": gram,
    "Gram, float32": gram32,
    "tall-skinny QR": tall_qr,
    "full SVD": full_svd,
    "randomized": randomized,
    "randomized, float32": randomized32,
}


def data(n: int, entries: int, condition: float) -> np.ndarray:
    """Columns whose singular values fall geometrically, rounded to float32."""
    rng = np.random.default_rng(0)
    left = np.linalg.qr(rng.normal(size=(n, n)))[0]
    right = np.linalg.qr(rng.normal(size=(entries, n)))[0].T
    return ((left * np.logspace(0, -np.log10(condition), n)) @ right).astype(np.float32)


def accuracy(quick: bool) -> None:
    n, entries = (48, 4000) if quick else (64, 20000)
    conditions = [1e0, 1e4, 1e8, 1e16] if quick else [10.0**k for k in range(0, 17, 2)]
    print(f"{n} columns x {entries} entries; all vectors asked for")
    print("condition  solver               values right down to  spaces right   worst error/Wedin  orthonormal to")
    curves = {}
    for condition in conditions:
        A = data(n, entries, condition)
        exact, right = full_svd(np.linalg.qr(A.T.astype(float), mode="r").T, n)[0], full_svd(A, n)[1]
        for name, solve in SOLVERS.items():
            sigma, vectors = solve(A, n)
            error = np.abs(sigma[:n] - exact[: len(sigma)]) / exact[: len(sigma)]
            wrong = np.flatnonzero(error > 0.01)
            reach = exact[wrong[0] - 1] / exact[0] if len(wrong) and wrong[0] else exact[-1] / exact[0]
            good, asked, worst = _spaces(vectors.astype(float), right, exact, float(np.linalg.norm(A)))
            overlap = np.abs(vectors.astype(float) @ vectors.T - np.eye(len(vectors))).max()
            print(
                f"{condition:9.0e}  {name:20s} {reach:20.1e}  {good:4d} of {asked:3d}  {worst:18.2g}  {overlap:14.1e}",
                flush=True,
            )
            curves[condition, name] = (exact[: len(sigma)] / exact[0], error)
    _draw({name: curves[1e16, name] for name in SOLVERS})


def _spaces(vectors: np.ndarray, right: np.ndarray, exact: np.ndarray, norm: float) -> tuple[int, int, float]:
    """Leading spaces that are within the bound, those for which it says anything, and the largest error over bound."""
    good, asked, worst = 0, 0, 0.0
    for k in range(1, len(exact)):
        bound = EPS32 / 2 * (norm / max(exact[k - 1] - exact[k], 1e-300) + np.sqrt(k))
        if bound < 0.5:
            # A solver that has fewer vectors than k has lost the others.
            off = np.linalg.norm(vectors[:k] - vectors[:k] @ right[:k].T @ right[:k], 2) if len(vectors) >= k else 1.0
            asked, good, worst = asked + 1, good + (off <= bound), max(worst, off / bound)
    return good, asked, float(worst)


def _draw(curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for name, (depth, error) in curves.items():
        axes.loglog(depth, np.clip(error, 1e-16, 10), ".-", label=name, lw=1, ms=4)
    axes.axhline(0.01, color="0.6", lw=1)
    axes.axvline(1e-7, color="0.6", lw=1)
    axes.invert_xaxis()
    axes.set(
        xlabel="singular value / largest", ylabel="relative error", title="Singular values of float32 data, condition 1e16"
    )
    axes.legend(fontsize=8)
    figure.savefig(Path("docs/solvers.png"), dpi=130)


def cost(quick: bool) -> None:
    """Each measurement in a process of its own, so that peak memory is its own."""
    sizes = [(10_000, 32), (20_000, 64)] if quick else [(50_000, 64), (200_000, 256), (1_000_000, 256), (1_000_000, 1024)]
    print(" entries  columns  solver               seconds  / NumPy Gram  memory beyond data, MB")
    for entries, n in sizes:
        for name in SOLVERS:
            # Wide float64 copies and their factors: what would not fit in 24 GiB is left out, and said.
            if name in ("full SVD", "randomized") and entries * n * 8 * 2.5 > 16e9:
                print(f"{entries:8d}  {n:7d}  {name:20s} left out: more than 16 GB")
                continue
            with get_context("spawn").Pool(1) as pool:
                seconds, ratio, memory = pool.apply(_measure, (name, entries, n))
            print(f"{entries:8d}  {n:7d}  {name:20s} {seconds:7.2f}  {ratio:12.2f}  {memory:22.0f}", flush=True)


def _measure(name: str, entries: int, n: int, rounds: int = 3) -> tuple[float, float, float]:
    """Seconds for 16 vectors, the ratio to NumPy's product, and megabytes of the solver beyond its data."""
    A = np.random.default_rng(0).random((n, entries), dtype=np.float32)
    solve = SOLVERS[name]
    solve(A[:, :2000], 16)  # brings libraries into memory
    before = getrusage(RUSAGE_SELF).ru_maxrss
    solve(A, 16)
    memory = (getrusage(RUSAGE_SELF).ru_maxrss - before) / 1024
    seconds = _seconds(lambda: solve(A, 16), rounds)
    return seconds, seconds / _product_seconds(A, rounds), memory


def _seconds(run: Callable[[], object], rounds: int) -> float:
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def _product_seconds(A: np.ndarray, rounds: int) -> float:
    """NumPy's product of float64 data with themselves (BLAS syrk); past 6 GB of them, of a part, scaled."""
    part = A[:, : int(6e9 / 8 / len(A))].astype(float)
    return _seconds(lambda: part @ part.T, rounds) * A.shape[1] / part.shape[1]


def product(spectrum: str = "noise", entries: int = 200_000, n: int = 256) -> None:
    """SPECTRUM: "noise" has no deep values; "1e7" and "1e16" fall geometrically to there."""
    rng = np.random.default_rng(0)
    A = rng.random((n, entries), dtype=np.float32) if spectrum == "noise" else data(n, entries, float(spectrum))
    columns, weights = jnp.asarray(A), jnp.full(entries, 1 / entries)
    rows = A.astype(float)
    run = lambda: jax.block_until_ready(fit_basis(columns, weights, bases=16).vectors)  # noqa: E731
    run()
    ratios = []
    for _ in range(7):
        ours, theirs = _seconds(run, 1), _seconds(lambda: rows @ rows.T, 1)
        ratios.append(ours / theirs)
        print(f"fit_basis {ours:.3f} s  NumPy product {theirs:.3f} s  ratio {ours / theirs:.2f}", flush=True)
    print(f"median ratio {np.median(ratios):.2f}")


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "--quick"]
    verb = words[0] if words else "accuracy"
    if verb == "product":
        product(*words[1:2])
    else:
        {"accuracy": accuracy, "cost": cost}[verb]("--quick" in sys.argv)
