"""The encoder over a set of points: any order, any number, and svd-ridge where all are there."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_arrays import POINTS, make_data, room
from oracles import U32
from test_learned import error, examples

import ddprt
from ddprt.errors import UserError
from ddprt.methods.method import Examples, Frame
from ddprt.methods.point_set import PointSet, SetEncoder
from ddprt.methods.svd_ridge import SvdRidge
from ddprt.runtime.model import Model

KEY = jax.random.key(0)
SETTINGS: dict[str, Any] = {"bases": 8, "latent": 24, "width": 16, "steps": 60, "check_every": 20}
QUICK = {"steps": 20, "check_every": 10, "width": 8}


@pytest.fixture(scope="module")
def parts() -> tuple[Examples, Examples, Examples]:
    return tuple(low(seed, count) for seed, count in ((1, 60), (2, 16), (3, 24)))  # type: ignore[return-value]


def low(seed: int, lightings: int) -> Examples:
    """Light of six causes, each of which 24 points see: any six points tell them apart."""
    world, rng = np.random.default_rng(0), np.random.default_rng(seed)
    cause = np.abs(rng.standard_normal((lightings, 3, 6)))
    values = np.moveaxis(cause @ world.uniform(0, 1, (6, 24)), 1, 2)
    light = np.moveaxis(cause @ world.standard_normal((6, 300)), 1, 2)
    scale = np.linalg.norm(values, axis=1)
    of = examples(seed, lightings)
    frame = replace(of.frame, values=jnp.asarray(values / scale[:, None], jnp.float32))
    light = jnp.asarray(light / scale[:, None], jnp.float32)
    return replace(of, frame=frame, indirect=light, scale=jnp.asarray(scale, jnp.float32))


@pytest.fixture(scope="module")
def fitted(parts: tuple[Examples, Examples, Examples]) -> SetEncoder:
    return PointSet(**SETTINGS).fit(parts[0], parts[1], key=KEY)


@pytest.fixture(scope="module")
def bent() -> tuple[SetEncoder, Examples]:
    """One whose network has something to say."""
    train, held, test = (examples(seed, count, bend=2.0) for seed, count in ((1, 400), (2, 100), (3, 100)))
    settings = {**SETTINGS, "bases": 12, "steps": 300, "learning_rate": 5e-4, "width": 64, "keep": 0.9}
    return PointSet(**settings).fit(train, held, key=KEY), test


def some(part: Examples, which: np.ndarray) -> Examples:
    """The same lightings seen by some of the points, scaled by what these see."""
    seen = part.frame.values[:, which]
    own = jnp.linalg.norm(seen, axis=1)
    frame = Frame(seen / own[:, None], part.frame.positions[which], part.frame.normals[which])
    return replace(part, frame=frame, indirect=part.indirect / own[:, None], scale=part.scale * own)


def test_all_points_and_no_network_are_the_ridge(fitted: SetEncoder, parts: tuple[Examples, Examples, Examples]) -> None:
    train, held, test = parts
    ridge = SvdRidge(bases=8).fit(train, held, key=KEY)  # type: ignore[call-arg]
    found = replace(fitted, gates=jnp.zeros(2)).predict(test.frame)
    # Attention to oneself is 1 but for 1e-24, and a transfer of 24 terms to 8 bases is summed in another order.
    bound = 64 * U32 * float(jnp.abs(ridge.matrix).sum(2).max() * jnp.abs(ridge.basis).sum(0).max())
    np.testing.assert_allclose(found, ridge.predict(test.frame), atol=bound, rtol=0)


@pytest.mark.parametrize("count", [24, 12, 5])
def test_the_order_of_points_does_not_matter(count: int, bent: tuple[SetEncoder, Examples]) -> None:
    encoder, test = bent
    encoder = replace(encoder, gates=jnp.ones(2))  # so that the network is tested, too
    rng = np.random.default_rng(count)
    which = rng.permutation(24)[:count]
    one, other = (encoder.predict(some(test, order).frame) for order in (which, rng.permutation(which)))
    # The stacked problem has a condition of at most the root of largest square over noise, (1 / 1e-6)^0.5; sums are of 24.
    np.testing.assert_allclose(one, other, atol=1e3 * 24 * U32 * float(jnp.abs(one).max()), rtol=0)


def test_half_of_the_points_tell_all_where_they_can(fitted: SetEncoder, parts: tuple[Examples, Examples, Examples]) -> None:
    """Six causes and twelve points; who takes missing points for black is far off."""
    test = parts[2]
    whole = error(replace(fitted, matrix=fitted.matrix * 0, gates=jnp.zeros(2)), test)  # of black
    which = np.random.default_rng(1).permutation(24)[:12]
    half = error(fitted, some(test, which))
    mask = np.isin(np.arange(24), which)[:, None]
    dark = replace(test, frame=replace(test.frame, values=test.frame.values * mask))
    ridge = SvdRidge(bases=8).fit(parts[0], parts[1], key=KEY)  # type: ignore[call-arg]
    assert half < 0.05**2 * whole
    assert half < 0.2**2 * error(ridge, dark)


def test_points_nearby_stand_in(fitted: SetEncoder, parts: tuple[Examples, Examples, Examples]) -> None:
    """A thousandth of the room beside a trained point, another answers as that one does: weights fall with d^-4.

    The points are a tenth of the room apart or more: 23 others weigh 23 (3e-6 / 1e-2)^2 = 2e-6 together, and what the noise of
    1e-6 or more lets through makes features no more than a thousand times as important.
    """
    test = parts[2]
    moved = replace(test, frame=replace(test.frame, positions=test.frame.positions + 1e-3))
    there, beside = (fitted.predict(part.frame) for part in (some(test, np.arange(12)), some(moved, np.arange(12))))
    np.testing.assert_allclose(beside, there, atol=2e-3 * float(jnp.abs(there).max()), rtol=0)
    assert (np.asarray(beside) != np.asarray(there)).any()


def test_a_network_that_is_worth_something_is_taken(bent: tuple[SetEncoder, Examples]) -> None:
    encoder, test = bent
    assert encoder.gates[0] > 0.1
    # Of squares that are most of the light, 400 lightings teach little: 0.4 %. Slopes that mislead would cost as much.
    assert float(error(encoder, test)) < 0.998 * float(error(replace(encoder, gates=jnp.zeros(2)), test))


@pytest.fixture(scope="module")
def models() -> dict[str, Model]:
    data = make_data(*room())
    return {"point-set": ddprt.fit(data, "point-set", bases=4, settings=QUICK), "svd-ridge": ddprt.fit(data, bases=4)}


@pytest.mark.parametrize("space", ["linear", "gamma"])
def test_a_model_takes_some_of_its_points(space: str, models: dict[str, Model]) -> None:
    values = room()[0][0]
    model = models["point-set"]
    if space == "gamma":
        model = ddprt.fit(make_data(*room()), "point-set", bases=4, space="gamma", settings=QUICK)
    order = np.random.default_rng(0).permutation(POINTS)
    whole = model.predict(values)
    shuffled = model.predict(values[order], points=order)
    np.testing.assert_allclose(shuffled, whole, atol=1e4 * U32 * whole.max(), rtol=0)
    half = model.predict(values[order[: POINTS // 2]], points=order[: POINTS // 2])
    assert np.isfinite(half).all()
    assert half.shape == whole.shape
    # As bright as by all points: the missing are filled in, not black. A room of positive light knows no factor of 2.
    assert 0.5 < half.mean() / whole.mean() < 2


BAD = {
    "too many values": (range(3), r"values: got shape \(\d+, 3\), expected \(3, 3\)"),
    "twice": ([0, 0], r"points: got \[0, 0\], expected different whole numbers"),
    "out of range": ([0, 10**6], "points: got"),
    "negative": ([-1], "points: got"),
    "none": ([], "points: got"),
    "fractions": ([0.5], "points: got"),
}


@pytest.mark.parametrize("name", BAD)
def test_points_that_cannot_be_are_refused(name: str, models: dict[str, Model]) -> None:
    points, expected = BAD[name]
    with pytest.raises(UserError, match=expected):
        models["point-set"].predict(room()[0][0], points=points)


def test_who_needs_all_points_says_so(models: dict[str, Model]) -> None:
    values = room()[0][0]
    with pytest.raises(UserError, match=r"^points: got some of them, but svd-ridge answers from all"):
        models["svd-ridge"].predict(values[:2], points=[0, 1])
    with pytest.raises(UserError, match=r"^values: got shape \(2, 3\)"):
        models["point-set"].predict(values[:2])
    with pytest.raises(UserError, match=r"^fade: got True with points"):
        models["point-set"].predict(values[:2], points=[0, 1], fade=True)
