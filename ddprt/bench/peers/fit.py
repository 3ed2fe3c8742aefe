"""Peers of the fit: a basis of a million texels.

Data have the spectrum of a bake of the scene in question, drawn out to as many texels as asked for, and every column has a
mean of 0 over the texels: then what subtracts that mean first, as scikit-learn's PCA does, solves the same problem. Truth is a
tall-skinny QR in float64 (Demmel et al. 2012) of the data as they are, in float32. Everyone starts from these float32 data, so
who needs a float64 copy makes it in its own time.
Solvers that iterate get as many iterations as they need on a piece to be as accurate as we are, if any number does.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ddprt import seeds
from ddprt.bench.peers.standing import OURS, Peer, Row, compare
from ddprt.config import Config, checked
from ddprt.dataset.generate import bake
from ddprt.fitting.basis import fit_basis
from ddprt.progress import Progress
from ddprt.transport.configured import configured_scene

EPS = 2.0**-24
"""Largest relative error of rounding to float32."""
_TILE = 1 << 14
_ITERATIONS = (2, 4, 8, 16, 32)
_TIMES = "iterations"
_MORE = 10  # vectors that randomised solvers carry beyond those asked for, scikit-learn's default

Solution = tuple[Any, Any]
"""Leading singular values, and right vectors as rows, of any length."""


@dataclass(frozen=True, eq=False)
class Maps:
    """A fit: what spans the columns best?

    Attributes:
      columns: indirect light, one observation per row.
      bases: how many vectors.
    """

    columns: Float[np.ndarray, "columns entries"]
    bases: int

    def wide(self) -> np.ndarray:
        """The columns in float64, made anew."""
        return self.columns.astype(np.float64)

    @cached_property
    def exact(self) -> tuple[np.ndarray, np.ndarray]:
        """All singular values, and the leading right vectors, in float64."""
        R: Any = np.zeros((0, len(self.columns)))
        for start in range(0, self.columns.shape[1], _TILE):
            tile = self.columns[:, start : start + _TILE].T.astype(np.float64)
            R = np.linalg.qr(np.concatenate([R, tile]), mode="r")
        _, sigma, rotation = np.linalg.svd(R)
        turn = rotation[: self.bases] / sigma[: self.bases, None]
        tiles = [turn @ self.columns[:, start : start + _TILE] for start in range(0, self.columns.shape[1], _TILE)]
        return sigma, np.concatenate(tiles, 1)

    @property
    def blur(self) -> dict[str, float]:
        """What rounding to float32 does to a perfect answer, in size.

        Independent errors of the n x T data, EPS ||A||_F / sqrt(n T) each, turn a right vector by EPS ||A||_F / (sqrt(n)
        sigma_k); errors of the k vectors' own entries by EPS each, so the space by EPS sqrt(k). Values are off by EPS.
        """
        sigma = self.exact[0]
        data = np.linalg.norm(sigma) / (np.sqrt(len(sigma)) * sigma[self.bases - 1])
        return {"sine of angle": EPS * float(data + np.sqrt(self.bases)), "singular values": EPS}

    def judge(self, solution: Solution) -> dict[str, float]:
        """Sine of the largest angle between the leading space and the exact one; largest relative error of its values."""
        sigma, vectors = (np.asarray(part)[: self.bases].astype(np.float64) for part in solution)
        exact, right = self.exact
        if len(vectors) < self.bases or not (np.isfinite(vectors).all() and np.isfinite(sigma).all()):
            return dict.fromkeys(self.blur, float("nan"))
        straight = np.linalg.qr(vectors.T)[0].T
        apart = straight - straight @ right.T @ right
        sine = np.sqrt(np.linalg.eigvalsh(apart @ apart.T)[-1])
        values = np.max(np.abs(sigma / exact[: self.bases] - 1))
        return {"sine of angle": float(sine), "singular values": float(values)}


def real_spectrum(config: Config, columns: int, progress: Progress) -> np.ndarray:
    """Singular values of a small bake of the configured scene, maps scaled to norm 1, drawn out to so many columns.

    The bake has a third as many lightings as there are columns, 48² texels and 64 rays per texel: its tail is noise, as any
    bake's is.
    """
    plain = config.model_dump()
    plain["atlas"] |= {"resolution": 48}
    plain["lightings"] |= {"train": max(2, columns // 3), "validation": 1, "test": 1, "choose": "random"}
    plain["transport"] |= {"samples": 64, "test_samples": 2, "integrator": "operator"}
    plain["points"] |= {"count": 16, "supersample": 1, "choose": "blue-noise"}
    data = bake(configured_scene(config), config=checked(plain), progress=progress)
    maps = data.maps("indirect", data.split("train")).astype(np.float64)
    rows = np.moveaxis(maps, 2, 1).reshape(-1, maps.shape[1])
    norms = np.linalg.norm(rows, axis=1)
    sigma = np.linalg.svd(rows[norms > 0] / norms[norms > 0, None], compute_uv=False)
    lit = np.log(np.maximum(sigma, 1e-12 * sigma[0]))
    return np.exp(np.interp(np.linspace(0, 1, columns), np.linspace(0, 1, len(lit)), lit))


def make_columns(spectrum: np.ndarray, texels: int, seed: int) -> Float[np.ndarray, "columns texels"]:
    """Data of about this spectrum, float32, every column of mean 0."""
    n = len(spectrum)
    left = np.linalg.qr(seeds.stream(seed, "peers left").standard_normal((n, n)))[0]
    mix = (left * spectrum / np.sqrt(texels)).astype(np.float32)
    columns = np.empty((n, texels), np.float32)
    for start, stop in pairwise([*range(0, texels, _TILE), texels]):
        columns[:, start:stop] = mix @ seeds.stream(seed, "peers right", start).standard_normal((n, stop - start), np.float32)
    return centred(columns)


def centred(columns: Float[np.ndarray, "columns texels"]) -> Float[np.ndarray, "columns texels"]:
    """The columns less their means over the texels."""
    return columns - columns.mean(1, keepdims=True, dtype=np.float64).astype(np.float32)


def fit_rows(
    maps: Maps, *, repeats: int, limit: float | int, share: int = 10, tell: Callable[[], None] = lambda: None
) -> list[Row]:
    """Everyone's basis of the maps; a share of the texels is the piece that they are tried on."""
    texels = maps.columns.shape[1]
    piece = Maps(centred(maps.columns[:, : max(len(maps.columns), texels // share)]), maps.bases)
    times = texels / piece.columns.shape[1]
    return compare(PEERS, maps, repeats=repeats, piece=piece, times=times, limit=limit, tell=tell)


def _ours(maps: Maps) -> Callable[[], Any]:
    columns, weights = jnp.asarray(maps.columns), jnp.ones(maps.columns.shape[1], jnp.float32)

    def work() -> Any:
        basis = fit_basis(columns, weights, bases=maps.bases)
        return basis.singular_values, basis.vectors

    return work


def _numpy_svd(maps: Maps) -> Callable[[], Solution]:
    return lambda: np.linalg.svd(maps.wide(), full_matrices=False)[1:]


def _scipy_svd(maps: Maps, single: bool = False) -> Callable[[], Solution]:
    data = (lambda: maps.columns) if single else maps.wide
    return lambda: scipy.linalg.svd(data(), full_matrices=False, lapack_driver="gesdd", check_finite=False)[1:]


def _scipy_svds(maps: Maps) -> Callable[[], Solution]:
    from scipy.sparse.linalg import svds

    start = np.ones(len(maps.columns))

    def work() -> Solution:
        _, sigma, right = svds(maps.wide(), k=maps.bases, v0=start)
        return sigma[::-1], right[::-1]

    return work


def _pca(maps: Maps, solver: str, iterations: float | int | str = "auto") -> Callable[[], Solution]:
    from sklearn.decomposition import PCA

    n = iterations if isinstance(iterations, str) else int(iterations)
    settings = {"svd_solver": solver, "iterated_power": n, "n_oversamples": _MORE, "random_state": 0}

    def work() -> Solution:
        pca = PCA(maps.bases, **settings)
        projected = pca.fit_transform(maps.wide().T)
        return pca.singular_values_, projected.T

    return work


def _truncated(maps: Maps, algorithm: str, iterations: float | int = 5) -> Callable[[], Solution]:
    from sklearn.decomposition import TruncatedSVD

    def work() -> Solution:
        svd = TruncatedSVD(maps.bases, algorithm=algorithm, n_iter=int(iterations), n_oversamples=_MORE, random_state=0)
        projected = svd.fit_transform(maps.wide().T)
        return svd.singular_values_, projected.T

    return work


def _randomized(maps: Maps, iterations: float | int) -> Callable[[], Solution]:
    from sklearn.utils.extmath import randomized_svd

    return lambda: randomized_svd(maps.wide(), maps.bases, n_oversamples=_MORE, n_iter=int(iterations), random_state=0)[1:]


def _torch_svd(maps: Maps) -> Callable[[], Solution]:
    import torch

    def work() -> Solution:
        _, sigma, right = torch.linalg.svd(torch.from_numpy(maps.wide()), full_matrices=False)
        return sigma.numpy(), right.numpy()

    return work


def _torch_lowrank(maps: Maps, iterations: float | int, name: str) -> Callable[[], Solution]:
    import torch

    settings = {"center": False} if name == "pca_lowrank" else {}

    def work() -> Solution:
        torch.manual_seed(0)
        A = torch.from_numpy(maps.wide())
        _, sigma, right = getattr(torch, name)(A, q=maps.bases + _MORE, niter=int(iterations), **settings)
        return sigma.numpy(), right.numpy().T

    return work


def _gram(maps: Maps) -> Callable[[], np.ndarray]:
    A = maps.wide()
    return lambda: A @ A.T


def _conversion(maps: Maps) -> Callable[[], np.ndarray]:
    return maps.wide


_ALL = "all singular values, as we do"
PEERS = (
    Peer(OURS, _ours, remark="fit_basis: from float32, with all singular values and the columns' coefficients"),
    Peer("numpy.linalg.svd", _numpy_svd, remark=_ALL),
    Peer("scipy.linalg.svd, gesdd", _scipy_svd, remark=_ALL),
    # NumPy has no such thing: it computes in float64 whatever it is given.
    Peer("scipy.linalg.svd, gesdd, float32", lambda maps: _scipy_svd(maps, single=True), remark=_ALL),
    Peer("scipy.sparse.linalg.svds", _scipy_svds, remark="ARPACK, leading values alone"),
    Peer("sklearn PCA, full", lambda maps: _pca(maps, "full"), needs="sklearn", remark=_ALL),
    Peer("sklearn PCA, covariance_eigh", lambda maps: _pca(maps, "covariance_eigh"), needs="sklearn", remark=_ALL),
    Peer("sklearn TruncatedSVD, arpack", lambda maps: _truncated(maps, "arpack"), needs="sklearn"),
    Peer("torch.linalg.svd", _torch_svd, needs="torch", remark=_ALL),
    Peer("NumPy float64", _conversion, yardstick=True, remark="the conversion to float64 alone"),
    Peer("NumPy Gram product", _gram, yardstick=True, remark="A @ A.T in float64 alone, the conversion apart"),
    Peer("sklearn PCA, randomized", lambda maps, n: _pca(maps, "randomized", n), "sklearn", efforts=_ITERATIONS, unit=_TIMES),
    Peer(
        "sklearn TruncatedSVD, randomized",
        lambda maps, n: _truncated(maps, "randomized", n),
        "sklearn",
        efforts=_ITERATIONS,
        unit=_TIMES,
    ),
    Peer("sklearn randomized_svd", _randomized, "sklearn", efforts=_ITERATIONS, unit=_TIMES),
    Peer(
        "torch.svd_lowrank", lambda maps, n: _torch_lowrank(maps, n, "svd_lowrank"), "torch", efforts=_ITERATIONS, unit=_TIMES
    ),
    Peer(
        "torch.pca_lowrank", lambda maps, n: _torch_lowrank(maps, n, "pca_lowrank"), "torch", efforts=_ITERATIONS, unit=_TIMES
    ),
)
