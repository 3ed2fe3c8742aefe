"""Learned methods: what each is known to find, or to keep."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import subspace_angles

from ddprt.fitting.basis import entry_weights
from ddprt.methods import METHODS
from ddprt.methods.method import Examples, Frame
from ddprt.methods.residual import Residual
from ddprt.methods.svd_ridge import SvdRidge

EPS32 = float(np.finfo(np.float32).eps)
KEY = jax.random.key(0)


def examples(seed: int, lightings: int = 48, points: int = 24, texels: int = 300, bend: float = 0.0) -> Examples:
    """Light with a falling spectrum, linear in what is measured but for `bend` times what a square of it adds."""
    world = np.random.default_rng(0)
    cause, mixing = np.random.default_rng(seed).standard_normal((lightings, 3, 12)), world.standard_normal((12, texels))
    fall = 0.6 ** np.arange(12)
    values = np.abs(cause @ world.standard_normal((12, points))).swapaxes(1, 2)
    scale = np.linalg.norm(values, axis=1)
    light = np.einsum("lck,kt->ltc", cause * fall, mixing) + bend * np.einsum("lck,kt->ltc", cause**2 * fall, mixing[::-1])
    frame = Frame(
        jnp.asarray(values / scale[:, None], jnp.float32),
        jnp.asarray(world.uniform(0, 1, (points, 3)), jnp.float32),
        jnp.tile(jnp.array([0.0, 1.0, 0.0]), (points, 1)),
    )
    area = world.uniform(0.5, 2, texels).astype(np.float32)
    return Examples(frame, jnp.asarray(light / scale[:, None], jnp.float32), jnp.asarray(scale, jnp.float32), area)


def error(relighter: Any, held: Examples) -> float:
    share = held.area / held.area.sum()
    off = (relighter.predict(held.frame) - held.indirect) * held.scale[:, None]
    return float(jnp.einsum("ltc,t->", off**2, share))


def angle(one: Any, other: Any, train: Examples) -> float:
    """Largest angle between the spaces of two bases under the entries' weights, degrees."""
    root = np.sqrt(entry_weights(train.area, train.weights, train.channels))
    spaces = [(np.asarray(relighter.basis, np.float64) * root).T for relighter in (one, other)]
    return float(np.degrees(subspace_angles(*spaces).max()))


@pytest.mark.parametrize("seed", range(3))
def test_an_autoencoder_finds_the_subspace_of_the_svd(seed: int) -> None:
    """Within 1 degree from any start; the same light, and vectors that are orthonormal."""
    train, held = examples(1), examples(2, 12)
    svd = SvdRidge(bases=8).fit(train, held, key=KEY)
    learned = METHODS["autoencoder"](bases=8).fit(train, held, key=jax.random.key(seed))  # type: ignore[call-arg]
    assert angle(svd, learned, train) < 1
    weights = np.asarray(entry_weights(train.area, train.weights, train.channels), np.float64)
    U = np.asarray(learned.basis, np.float64)
    np.testing.assert_allclose((U * weights) @ U.T, np.eye(8), atol=100 * EPS32)
    # Coefficients turn with the basis, and leaving one out knows no basis: only the ridge may differ by the rest of the angle.
    np.testing.assert_allclose(error(learned, held), error(svd, held), rtol=0.01)
    singular = np.array(svd.report.singular_values[:8])
    np.testing.assert_allclose(learned.report.singular_values, singular, rtol=1e-3)


def test_light_of_lower_rank_gives_fewer_bases() -> None:
    train = examples(1)
    left = train.indirect @ jnp.ones((3, 3)) * jnp.ones((1, 300, 1))
    flat = replace(train, indirect=left[:, :1] * jnp.ones((1, 300, 1)))  # one map times what each lighting brings
    found = METHODS["autoencoder"](bases=8).fit(flat, flat, key=KEY)  # type: ignore[call-arg]
    assert len(found.basis) == 1
    assert "rank_deficient" in found.report.remarks


def test_a_residual_network_finds_what_is_not_linear() -> None:
    """Measurements are magnitudes here, which no matrix undoes: a network has something left to learn."""
    train, held, test = examples(1, 400, bend=0.5), examples(2, 100, bend=0.5), examples(3, 100, bend=0.5)
    base = SvdRidge(bases=12).fit(train, held, key=KEY)
    found = Residual(bases=12, steps=600).fit(train, held, key=KEY)
    assert float(found.gate) > 0.1
    assert error(found, held) < error(base, held)
    assert error(found, test) < error(base, test)


def test_a_residual_network_that_is_worth_nothing_is_shut_out() -> None:
    """Trained on noise alone it would only add noise: what is left is svd-ridge, to the bit."""
    train, held = examples(1, 24), examples(2, 200)
    rng = np.random.default_rng(0)
    noise = [
        replace(part, indirect=jnp.asarray(rng.standard_normal(part.indirect.shape), jnp.float32)) for part in (train, held)
    ]
    base = SvdRidge(bases=8).fit(*noise, key=KEY)
    found = Residual(bases=8, steps=400, width=64, learning_rate=0.05, check_every=400, weight_decay=0.0).fit(*noise, key=KEY)
    assert error(found, noise[1]) <= error(base, noise[1]) * (1 + 1e-5)
    shut = replace(found, gate=jnp.zeros(()))
    np.testing.assert_array_equal(shut.predict(held.frame), base.predict(held.frame))


def test_a_gate_is_the_best_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors at a little more and a little less are no smaller on the validation lightings."""
    train, held = examples(1, 200, bend=0.5), examples(2, 60, bend=0.5)
    found = Residual(bases=12, steps=600).fit(train, held, key=KEY)
    gate = float(found.gate)
    assert 0 < gate < 1
    errors = [error(replace(found, gate=jnp.asarray(gate + step, jnp.float32)), held) for step in (-0.05, 0.0, 0.05)]
    assert errors[1] <= min(errors) * (1 + 1e-5)
