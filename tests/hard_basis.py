"""What a basis leaves open or can get wrong: weights, centring, equal singular values, signs, odd sizes."""

import jax.numpy as jnp
import numpy as np
import oracles
from hard_arrays import POINTS, TEST, TEXELS, TRAIN, VALIDATION, WITHIN, relit, room
from hard_cases import REFUSED, HardCase, Outcome
from oracles import U32, over_bound

from ddprt.fitting.basis import fit_basis


def _clustered() -> tuple[np.ndarray, np.ndarray]:
    """Indirect light with three equal singular values, twice: any rotation of each three is a basis."""
    rng = np.random.default_rng(4)
    count = TRAIN + VALIDATION + TEST
    vectors = np.linalg.qr(rng.normal(size=(TEXELS, 6)))[0].T
    size = np.repeat([1.0, 1e-3], 3)
    turns = np.linalg.qr(rng.normal(size=(3 * count, 6)))[0].reshape(count, 3, 6)
    light = np.einsum("lck,k,kt->ltc", turns, size, vectors)
    measured = np.einsum("lck,kp->lpc", turns, rng.normal(size=(6, POINTS)))
    return measured.astype(np.float32), light.astype(np.float32)


def _subspaces() -> Outcome:
    """Leading spaces of data with known gaps, against Davis and Kahan.

    The Gram matrix is off by ||E||, so the left space turns by at most t = ||E|| / (sigma_k² - sigma_k+1² - ||E||) and the
    right one, A^T times it, by sigma_k+1 / sigma_k times as much; the float32 vectors add u32 sqrt(k).
    """
    rng = np.random.default_rng(5)
    sigma = np.repeat(np.logspace(0, -6, 6), 2)  # pairs: signs and rotations inside each are free
    left, right = (np.linalg.qr(rng.normal(size=(size, 12)))[0] for size in (36, TEXELS))
    rows = ((left * sigma) @ right.T).astype(np.float32)
    exact = np.linalg.svd(rows.astype(float), full_matrices=False)
    moved, worst, status = oracles.bound_gram(rows.astype(float)), 0.0, "ok"
    vectors = np.asarray(fit_basis(jnp.asarray(rows), jnp.ones(TEXELS), bases=10).vectors, float)
    for kept in (2, 4, 6, 8, 10):
        U, V, S = vectors[:kept], exact[2][:kept], exact[1]
        turned = np.linalg.norm(U - U @ V.T @ V, 2)
        tangent = moved / (S[kept - 1] ** 2 - S[kept] ** 2 - moved)
        worst = max(worst, over_bound(turned, S[kept] / S[kept - 1] * tangent + U32 * np.sqrt(kept)))
    return Outcome(worst, status)


def _signs() -> Outcome:
    """The sign rule settles what the decomposition leaves open: negated and permuted columns have the same basis.

    With distinct singular values a vector turns by at most ||E|| / gap of squares, here far below float32.
    """
    rng = np.random.default_rng(6)
    left, right = (np.linalg.qr(rng.normal(size=(size, 6)))[0] for size in (12, TEXELS))
    rows = ((left * 2.0 ** -np.arange(6)) @ right.T).astype(np.float32)
    bases = [
        np.asarray(fit_basis(jnp.asarray(r), jnp.ones(TEXELS), bases=6).vectors, float)
        for r in (rows, -rows, rows[rng.permutation(12)])
    ]
    exact = np.linalg.svd(rows.astype(float), compute_uv=False)[:6]
    gap = exact[-2] ** 2 - exact[-1] ** 2
    bound = 2 * (oracles.bound_gram(rows.astype(float)) / gap + U32)
    return Outcome(max(over_bound(other - bases[0], bound) for other in bases[1:]))


_AREA = np.where(np.arange(TEXELS) == 4, 0.0, 1.0)


CASES: tuple[HardCase, ...] = (
    HardCase("a texel without area", "its weight is 0 under a root", WITHIN, relit(room, area=_AREA)),
    HardCase(
        "areas over twelve decades",
        "weights of 1e-12 divide when vectors are made",
        WITHIN,
        relit(room, area=np.logspace(-12, 0, TEXELS)),
    ),
    HardCase(
        "mean and mono",
        "an intercept beside three channels",
        WITHIN,
        relit(room, centre="mean"),
        frozenset({"ok", "ill_conditioned"}),  # two of ten directions are rounding, on either side of the cut
    ),
    HardCase(
        "mean and multi",
        "an intercept beside interleaved colours",
        WITHIN,
        relit(room, centre="mean", channels="multi"),
        slow=True,
    ),
    HardCase(
        "clustered singular values",
        "any rotation of three vectors is as good",
        "the space is right whatever the rotation",
        relit(_clustered),
    ),
    HardCase(
        "leading subspaces over six decades",
        "pairs of equal singular values, a gap of 16 between pairs",
        "within Davis and Kahan's angle",
        _subspaces,
    ),
    HardCase("signs and order of columns", "an eigenvector's sign is arbitrary", "the sign rule gives the same basis", _signs),
    HardCase(
        "prime sizes",
        "no tile or vector register divides them",
        WITHIN,
        relit(lambda: room(train=13, points=7, texels=31)),
        slow=True,
    ),
    HardCase(
        "more texels than a tile",
        "sums are cut into pieces of 16384",
        WITHIN,
        relit(lambda: room(texels=16411)),
        slow=True,
    ),
    HardCase(
        "one texel",
        "one number is the whole map",
        WITHIN,
        relit(lambda: room(texels=1)),
        frozenset({"rank_deficient"}),
        slow=True,
    ),
    HardCase(
        "one point",
        "light is scaled by the very number it is told by",
        WITHIN,
        relit(lambda: room(points=1)),
        frozenset({"rank_deficient"}),
        slow=True,
    ),
    HardCase(
        "more points than texels",
        "the wide way round",
        WITHIN,
        relit(lambda: room(points=40, texels=3)),
        frozenset({"rank_deficient"}),
        slow=True,
    ),
    HardCase("all areas 0", "their sum divides", "refused", relit(room, area=np.zeros(TEXELS), says="area"), REFUSED),
)
