"""The basis without negative texels: what it finds, and that its transfer is the baseline's."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_learned import error

from ddprt.fitting.basis import entry_weights
from ddprt.fitting.selection import RANK_CUT
from ddprt.methods.method import Examples, Frame
from ddprt.methods.nonnegative import Nonnegative
from ddprt.methods.svd_ridge import SvdRidge

EPS32 = float(np.finfo(np.float32).eps)
KEY = jax.random.key(0)
LONG = 400
BOTH = pytest.mark.parametrize("coefficients", ["positive", "free"])


def parts(seed: int, kinds: int = 4, texels: int = 120, lightings: int = 16, noise: float = 0.0) -> Examples:
    """Light of so many lamps that each reach texels of their own, in colours that differ; at first each lamp alone."""
    world, rng = np.random.default_rng(0), np.random.default_rng(seed)
    own = np.arange(texels) % kinds == np.arange(kinds)[:, None]
    maps = np.where(own, world.uniform(0.2, 1, (kinds, texels)), 0)
    cause = rng.uniform(0, 1, (lightings, 3, kinds))
    cause[:kinds] *= np.eye(kinds)[:, None]
    values = cause @ world.uniform(0, 1, (kinds, 12))
    light = cause @ maps + noise * rng.uniform(0, 1, (lightings, 3, texels))
    scale = np.linalg.norm(values, axis=2, keepdims=True)
    turned = [jnp.asarray((part / scale).swapaxes(1, 2), jnp.float32) for part in (values, light)]
    frame = Frame(turned[0], jnp.zeros((12, 3)), jnp.tile(jnp.array([0.0, 1.0, 0.0]), (12, 1)))
    area = world.uniform(0.5, 2, texels).astype(np.float32)
    return Examples(frame, turned[1], jnp.asarray(scale[..., 0], jnp.float32), area)


def fitted(train: Examples, **settings: Any) -> Any:
    return Nonnegative(**{"bases": 4, "sweeps": 20, **settings}).fit(train, train, key=KEY)


@pytest.mark.parametrize(("coefficients", "start"), [("positive", "svd"), ("free", "random")])
def test_no_map_is_negative_and_each_fills_its_range(coefficients: str, start: str) -> None:
    found = fitted(parts(1, noise=0.3), coefficients=coefficients, start=start)
    assert (found.basis >= 0).all()
    np.testing.assert_allclose(found.basis.max(1), 1, rtol=EPS32)


def test_parts_that_do_not_overlap_are_found() -> None:
    """No other non-negative maps make this light, as each lamp has texels and lightings of its own (Donoho, Stodden 2003)."""
    train = parts(1)
    found = np.asarray(fitted(train, coefficients="positive", sweeps=LONG).basis)
    owner = found.argmax(0)
    assert all(len(set(owner[kind::4])) == 1 for kind in range(4))
    # Foreign light in a map is what HALS has not yet taken out: seen, 1e-4 of the largest.
    foreign = np.where(np.arange(4)[:, None] == owner, 0, found)
    assert foreign.max() < 0.01


@BOTH
def test_the_error_never_rises_and_stays_above_that_of_the_svd(coefficients: str) -> None:
    """A step has the least error that its map can have; what any four maps leave is no less than what the SVD's four do."""
    train = parts(1, noise=0.5)
    report = fitted(train, coefficients=coefficients).report
    left = np.array([look[1] for look in report.loss])
    assert [look[0] for look in report.loss] == list(range(1, 21))
    entries = np.asarray(entry_weights(train.area, "area", "mono"), np.float64)
    rows = np.moveaxis(np.asarray(train.indirect, np.float64), 2, 1).reshape(-1, len(entries))
    squares = np.linalg.svd(rows * np.sqrt(entries), compute_uv=False) ** 2
    # A sum of squares of float32 products of 4 terms is good to a few eps of the light's own squares.
    rounding = 16 * EPS32
    assert (np.diff(left) <= rounding).all()
    assert left[-1] >= squares[4:].sum() / squares.sum() - rounding


@BOTH
def test_the_transfer_is_the_ridge_on_coefficients_of_the_maps(coefficients: str) -> None:
    """A slow twin: projections on the maps by least squares in float64, and the chosen ridge on an SVD of the points."""
    train = parts(1, noise=0.3)
    found = fitted(train, coefficients=coefficients)
    root = np.sqrt(np.asarray(entry_weights(train.area, "area", "mono"), np.float64))
    B = np.asarray(found.basis, np.float64)
    condition = np.linalg.cond(B * root)
    for group in range(3):
        X = np.asarray(train.frame.values[:, :, group], np.float64)
        C = np.linalg.lstsq((B * root).T, (np.asarray(train.indirect[:, :, group], np.float64) * root).T, rcond=None)[0].T
        Q, S, Pt = np.linalg.svd(X, full_matrices=False)
        S = np.where(RANK_CUT * S[0] < S, S, 0)  # four lamps: the other directions are rounding
        expected = (C.T @ Q * (S / (S**2 + found.report.ridge[group]))) @ Pt
        # On the orthonormal basis each entry of 4 rows is rounded by eps / 2 of what it is, which is up to sqrt(4) times the
        # longest stretch of B as large as here; turned back, sqrt(4) such errors over the shortest; and once rounded here.
        size = np.abs(expected).max() * condition
        np.testing.assert_allclose(found.matrix[group], expected, atol=3 * EPS32 * size, rtol=0)


def test_free_coefficients_reach_the_space_of_the_svd() -> None:
    """Light that fits into four maps is relit as the baseline relights it, whatever signs the maps may have."""
    train, held = parts(1), parts(2)
    base = SvdRidge(bases=4).fit(train, held, key=KEY)
    whole = float(jnp.einsum("ltc,t->", (held.indirect * held.scale[:, None]) ** 2, held.area / held.area.sum()))
    # Both are as far off as a ridge near 0 and float32 leave them: amplitudes of a few hundred eps, squared.
    assert error(base, held) < (1e-4) ** 2 * whole
    assert error(fitted(train, sweeps=LONG), held) < (1e-3) ** 2 * whole


def test_light_of_lower_rank_gives_fewer_maps_and_says_so() -> None:
    train = parts(1)
    flat = replace(train, indirect=train.indirect[:, :1] * jnp.ones((1, 120, 1)))
    found = fitted(flat)
    assert len(found.basis) == found.matrix.shape[1] == found.report.bases == 1
    assert found.report.status == "rank_deficient"


def test_signed_light_has_free_coefficients() -> None:
    """Where all light is negative, positive coefficients would learn nothing at all."""
    train = parts(1)
    signed = replace(train, indirect=-train.indirect, signed=True)
    found = fitted(signed, coefficients="positive", sweeps=LONG)
    assert (found.basis >= 0).all()
    assert error(found, signed) < 1e-4 * error(replace(found, matrix=0 * found.matrix), signed)


@BOTH
def test_texels_without_weight_are_learned_like_the_rest(coefficients: str) -> None:
    """A twin of each texel that counts nothing ends up with its twin's value."""
    train = parts(1, noise=0.3)
    area = np.concatenate([train.area, np.zeros(120, np.float32)])
    twins = replace(train, indirect=jnp.concatenate([train.indirect] * 2, 1), area=area)
    maps = np.asarray(fitted(twins, coefficients=coefficients, start="random").basis)
    # The same sums of 48 terms, perhaps in another order.
    np.testing.assert_allclose(maps[:, 120:], maps[:, :120], atol=48 * EPS32)
