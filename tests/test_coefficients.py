"""The quick transfer: what a shader gets composes to what `predict` answers, to the rounding of float32."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.methods.svd_ridge import compose
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene

EPS = float(np.finfo(np.float32).eps)
POINTS = 18  # not a multiple of the four that the loop takes at once
WAYS = list(itertools.product(("linear", "gamma"), ("none", "mean"), ("mono", "multi")))


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    changes = {"atlas.resolution": "24", "lightings.train": "14", "lightings.validation": "2", "lightings.test": "3"}
    changes |= {
        "points.count": str(POINTS),
        "points.supersample": "1",
        "transport.samples": "16",
        "transport.test_samples": "16",
    }
    changes |= {"lightings.saturation": "[0.0, 0.8]", "lightings.intensity": "[0.01, 100.0]", "transport.test_samples": "16"}
    return ddprt.bake(cornell, config=load_config(None, changes))


@pytest.fixture(scope="module", params=WAYS, ids=["-".join(way) for way in WAYS])
def model(request: pytest.FixtureRequest, data: Dataset) -> Model:
    space, centre, channels = request.param
    return ddprt.fit(data, bases=6, space=space, centre=centre, channels=channels)


def frames(data: Dataset) -> np.ndarray:
    return data.values(data.split("test"), POINTS, "radiosity")


def composed(model: Model, u: np.ndarray) -> np.ndarray:
    """What a shader adds up before its gamma, in float64."""
    if model.encoding.channels == "mono":
        return np.einsum("cb,bt->tc", u.astype(float), model.textures)
    return np.einsum("b,btc->tc", u[0].astype(float), model.textures)


def rounding(model: Model, values: np.ndarray) -> np.ndarray:
    """Bound on what two orders of the same float32 sums differ by, before the gamma.

    A sum of n products is off by at most n eps times the sum of their magnitudes (n eps / (1 - n eps), eps the half of the
    spacing, Higham 2002, 3.1); z itself carries the rounding of scale, quotient and power, 8 spacings with room. Twice, since
    both sides round.
    """
    encoding, learned = model.encoding, model.relighter
    scale = encoding.scale(jnp.asarray(values[None]))
    z = np.abs(np.asarray(encoding.encode(jnp.asarray(values[None]), scale), float)[0])
    z = z.T if encoding.channels == "mono" else z.reshape(1, -1)
    M, U = np.abs(np.asarray(learned.matrix, float)), np.abs(np.asarray(learned.basis, float))  # type: ignore[attr-defined]
    offset, start = np.abs(np.asarray(learned.offset)), np.abs(np.asarray(learned.intercept))  # type: ignore[attr-defined]
    u = np.einsum("gbp,gp->gb", M, z + offset) + start
    whole = u @ U + np.abs(np.asarray(learned.mean))  # type: ignore[attr-defined]
    power = 1 if encoding.space == "linear" else 1 / encoding.gamma
    bright = np.asarray(scale, float)[0] ** power
    field = whole.T * bright if encoding.channels == "mono" else whole.reshape(-1, 3) * bright
    return 2 * (M.shape[2] + len(U) + 8) * EPS * field


def test_coefficients_and_textures_compose_to_the_prediction(model: Model, data: Dataset) -> None:
    gamma = 1 if model.encoding.space == "linear" else model.encoding.gamma
    for values in frames(data):
        predicted = model.predict(values).astype(float) ** (1 / gamma)
        shader = np.maximum(composed(model, model.coefficients(values)), 0)
        assert shader.max() > 0
        assert (np.abs(shader - predicted) <= rounding(model, values) + 4 * EPS * predicted).all()


def test_many_frames_are_answered_as_one_by_one(model: Model, data: Dataset) -> None:
    batch = np.concatenate([scale * frames(data) for scale in (1, 0.5, 3, 7, 1e-3, 1e4)])
    assert len(batch) > 16, "enough for the product of matrices"
    together = model.coefficients(batch)
    for values, u in zip(batch, together, strict=True):
        alone = model.coefficients(values)
        field, bound = np.abs(composed(model, u) - composed(model, alone)), rounding(model, values)
        assert (field <= bound).all()


def test_dark_frames_have_no_coefficients(model: Model) -> None:
    assert not model.coefficients(np.zeros((POINTS, 3), np.float32)).any()
    assert not model.coefficients(np.zeros((20, POINTS, 3), np.float32)).any()


def test_a_dark_channel_stays_dark(model: Model, data: Dataset) -> None:
    values = frames(data)[0].copy()
    values[:, 1] = 0
    u = model.coefficients(values)
    assert u.any()
    if model.encoding.channels == "mono":
        assert not u[1].any()


@pytest.mark.parametrize("count", [1, 20])
def test_light_that_is_not_finite_is_refused(model: Model, count: int) -> None:
    for odd in (np.nan, np.inf):
        values = np.ones((count, POINTS, 3), np.float32)
        values[-1, 3, 2] = odd
        with pytest.raises(UserError, match="got NaN or infinity"):
            model.coefficients(values)


def test_any_numbers_of_the_right_shape_do(data: Dataset) -> None:
    model = ddprt.fit(data, bases=4)
    values = frames(data)[0]
    expected = model.coefficients(values)
    for given in (values.tolist(), values.astype(float), jnp.asarray(values), values[::-1][::-1], np.asfortranarray(values)):
        np.testing.assert_allclose(model.coefficients(given), expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    with pytest.raises(UserError, match=r"values: got shape \(3, 3\)"):
        model.coefficients(np.ones((3, 3), np.float32))
    with pytest.raises(UserError, match="expected svd-ridge"):
        ddprt.fit(data, method="nearest").coefficients(values)


def test_the_brightest_light_stays_finite(data: Dataset) -> None:
    largest = np.full((POINTS, 3), np.finfo(np.float32).max, np.float32)
    model = ddprt.fit(data, bases=4)
    assert np.isfinite(model.coefficients(largest)).all()
    assert np.isfinite(model.coefficients(np.stack([largest] * 20))).all()


@pytest.mark.parametrize("bases", [0, 1, 16, 17, 40])
@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("groups", [1, 3])
def test_a_composed_map_is_the_product_of_matrices(bases: int, count: int, groups: int) -> None:
    rng = np.random.default_rng(bases)
    u, U, mean = rng.normal(size=(count, groups, bases)), rng.normal(size=(bases, 37)), rng.normal(size=37)
    arrays: list[Array] = [jnp.asarray(part, jnp.float32) for part in (u, U, mean)]
    exact = np.moveaxis(u @ U + mean, 1, 2)
    bound = (bases + 3) * EPS * np.moveaxis(np.abs(u) @ np.abs(U) + np.abs(mean), 1, 2)  # sums of n, three roundings of input
    assert (np.abs(np.asarray(compose(*arrays)) - exact) <= bound).all()
