"""No negative light: the clamp that keeps energy against a float64 twin and its laws, and the ends of the number range."""

import inspect
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.fitting.encoding import Encoding, without_negatives
from ddprt.runtime.model import Model

EPS = float(np.finfo(np.float32).eps)
TINY, LARGEST = (float(getattr(np.finfo(np.float32), name)) for name in ("tiny", "max"))
COMPILED = jax.jit(without_negatives)
SPACES = [Encoding("linear"), Encoding("gamma", 1.0), Encoding("gamma", 2.2), Encoding("gamma", 10.0)]


def clamped(light: np.ndarray, area: np.ndarray) -> np.ndarray:
    """One map of one channel through `without_negatives`; the other channels are its double and its half."""
    maps = jnp.asarray(light, jnp.float32)[None, :, None] * jnp.asarray([1.0, 2.0, 0.5])
    return np.asarray(COMPILED(maps, jnp.asarray(area, jnp.float32)))[0, :, 0]


def by_sorting(light: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, float]:
    """The slow twin in float64: adds the brightest places until the level that they can bear is above the next; and it."""
    light, share = light.astype(np.float64), area.astype(np.float64) / area.astype(np.float64).sum()
    total = share @ light
    if total <= 0:
        return np.zeros_like(light), np.inf
    sum_light = sum_share = 0.0
    level = -np.inf
    for at in np.argsort(-light):
        if share[at] > 0:
            if sum_share > 0 and light[at] <= (sum_light - total) / sum_share:
                break
            sum_light, sum_share = sum_light + share[at] * light[at], sum_share + share[at]
            level = (sum_light - total) / sum_share
    return np.maximum(light - max(level, 0), 0) if (light < 0).any() else light, max(level, 0.0)


def rounding(light: np.ndarray, area: np.ndarray) -> tuple[float, float]:
    """Allowed error of a map's energy, and of `payers * level`, both as shares of energy.

    Each sum over n places is off by at most (h + 3) u of its own size, u = EPS / 2: a share that was divided twice, a product
    and h additions, as n is halved h times. What shares add up to is no matter, for all sums have it as a factor. The level
    solves payers * level = debt - paid, of which none is larger than the debt, so all together are off by 3 (h + 3) u debt and
    a division and a subtraction. Energy meets those once more when it is counted with the exact shares, and every place
    rounds when the level is taken from it.
    """
    halvings = np.ceil(np.log2(len(light)))
    share = area.astype(np.float64) / area.astype(np.float64).sum()
    debt, positive = share @ np.maximum(-light.astype(np.float64), 0), share @ np.maximum(light.astype(np.float64), 0)
    off = 2 * (halvings + 5) * EPS * debt
    return off + EPS * min(positive, 2 * debt + positive), off


# --- the clamp that keeps energy --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("light", "expected"),
    [
        ([3.0, 1.0, -0.5], [2.5, 0.5, 0.0]),  # debt 1/2 * 1/2, paid by two quarters
        ([4.0, 0.25, -1.0], [2.25, 0.0, 0.0]),  # the second place cannot pay its part: the first pays the rest
        ([1.0, 1.0, -1.0], [0.0, 0.0, 0.0]),  # nothing is left
        ([1.0, 0.0, -4.0], [0.0, 0.0, 0.0]),  # more debt than light
        ([-1.0, -2.0, -4.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.1, 0.7, 0.0], [0.1, 0.7, 0.0]),
    ],
)
def test_small_maps_by_hand(light: list[float], expected: list[float]) -> None:
    got = clamped(np.array(light), np.array([1.0, 1.0, 2.0]))  # every number here is exact in binary
    np.testing.assert_array_equal(got, np.float32(expected))


@st.composite
def maps(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Float32 light of some contrast and a share of negatives, and areas of some spread, one of them zero at times."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    places, contrast = draw(st.sampled_from([1, 2, 3, 10, 200])), draw(st.floats(0, 8))
    light = np.exp(contrast * rng.normal(size=places)) * np.where(rng.random(places) < draw(st.floats(0, 1)), -1, 1)
    area = np.exp(draw(st.floats(0, 3)) * rng.normal(size=places))
    area[0] *= draw(st.sampled_from([0.0, 1.0])) if places > 1 else 1.0
    return light.astype(np.float32), area.astype(np.float32)


@settings(max_examples=80)
@given(maps())
def test_it_keeps_energy_and_is_the_nearest_map(problem: tuple[np.ndarray, np.ndarray]) -> None:
    light, area = problem
    got = clamped(light, area)
    assert (got >= 0).all()
    expected, level = by_sorting(light, area)
    share = area.astype(np.float64) / area.astype(np.float64).sum()
    energy, level_off = rounding(light, area)
    total = share @ light.astype(np.float64)
    if total <= -energy:
        assert (got == 0).all()
        return
    assert abs(share @ got.astype(np.float64) - max(total, 0)) <= energy
    # The level's error is its equation's over the share that pays; few payers make it ill-conditioned, so those of the
    # level a little higher count, where all of these errors have been paid.
    if total > energy:
        payers = share @ (light > level)
        np.testing.assert_array_less(np.abs(got - expected) * payers, level_off + EPS * np.abs(light).max() + TINY)


@settings(max_examples=50)
@given(maps(), st.integers(0, 2**32 - 1))
def test_no_map_of_that_energy_is_farther_than_before(problem: tuple[np.ndarray, np.ndarray], seed: int) -> None:
    """Projection on a convex set: whatever the reference is, if its energy was met, clamping has come nearer to it."""
    light, area = problem
    share = area.astype(np.float64) / area.astype(np.float64).sum()
    total = share @ light.astype(np.float64)
    reference = np.random.default_rng(seed).exponential(size=len(light)) ** 3
    if total <= rounding(light, area)[0] or share @ reference == 0:
        return
    reference *= total / (share @ reference)
    before, after = (np.sqrt(share @ (y.astype(np.float64) - reference) ** 2) for y in (light, clamped(light, area)))
    exact, level = by_sorting(light, area)
    assert np.sqrt(share @ (exact - reference) ** 2) <= before * (1 + 1e-12)  # float64, sums of at most 200 places
    # No place is farther off than the level, by its equation's error over the share that pays, and than its own rounding.
    off = rounding(light, area)[1] / (share @ (light > level)) + EPS * np.sqrt(share @ light.astype(np.float64) ** 2)
    assert after <= before * (1 + 1e-12) + off + TINY


@pytest.mark.parametrize("sign", [1, -1])
def test_a_map_without_negatives_stays_bit_for_bit(sign: int) -> None:
    light = np.exp(5 * np.random.default_rng(0).normal(size=1000)).astype(np.float32)
    light[::7] = sign * 0.0
    np.testing.assert_array_equal(clamped(light, np.random.default_rng(1).random(1000)), light)


@pytest.mark.parametrize("power", [-60, -1, 1, 60])
def test_twice_the_light_is_twice_the_result_to_the_bit(power: int) -> None:
    light, area = np.random.default_rng(2).normal(0.3, 1, 300).astype(np.float32), np.random.default_rng(3).random(300)
    np.testing.assert_array_equal(clamped(np.ldexp(light, power), area), np.ldexp(clamped(light, area), power))


def test_many_steps_are_taken_where_they_are_needed() -> None:
    """Each place is half as bright as the one before and twice as large: they fall below the level one by one."""
    light, area = 0.5 ** np.arange(40.0), 2.0 ** np.arange(40.0)
    debt = 40 - 1.5  # each of the forty places holds an energy of 1; 1.5 shall be left, which only the first two can hold
    light, area = np.append(light, -debt / 2.0**40), np.append(area, 2.0**40)
    got = clamped(light, area)
    # 1.5 = (1 - level) + 2 (0.5 - level) gives 1/6, below which the third place, 1/4, would still pay: so all three do.
    # (1 - l) + 2 (1/2 - l) + 4 (1/4 - l) = 1.5 gives l = 3/14; the fourth, 1/8, is below it.
    _, off = rounding(light.astype(np.float32), area.astype(np.float32))
    payers = 7 / area.sum()
    np.testing.assert_allclose(got[:3], np.array([1.0, 0.5, 0.25]) - 3 / 14, rtol=0, atol=EPS + off / payers)
    assert (got[3:] == 0).all()


@pytest.mark.parametrize(("negative", "every"), [(-0.1, 10), (-0.9, 2)])
def test_a_million_texels_keep_their_energy(negative: float, every: int) -> None:
    """Equal values, where one addition after another is off in the same direction each time."""
    light = np.where(np.arange(1_000_000) % every == 0, np.float32(negative), np.float32(1))
    got, area = clamped(light, np.ones(len(light))), np.ones(len(light), np.float32)
    assert abs((got.astype(np.float64) - light).mean()) <= rounding(light, area)[0]


@pytest.mark.parametrize("unit", [1e-30, 1e30, 3e38])
def test_areas_may_be_in_any_unit(unit: float) -> None:
    light, area = np.array([3.0, 1.0, -0.5, 0.2]), np.array([0.25, 0.5, 1.0, 0.75])
    got, expected = clamped(light, unit * area), by_sorting(light, area)[0]
    # Areas round once more when they are taken times the unit.
    np.testing.assert_allclose(got, expected, rtol=0, atol=rounding(light, area)[1] / (light[:2] > 0).mean() + 4 * EPS)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30, LARGEST / 4])
def test_it_stays_finite_at_any_size(size: float) -> None:
    light = np.array([1.0, -1.0, 0.5, -0.25]) * size
    got = clamped(light, np.ones(4))
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got / size, [0.25, 0.0, 0.0, 0.0], rtol=10 * EPS)  # four places, each rounding a few times


@pytest.mark.parametrize("encoding", SPACES, ids=lambda e: f"{e.space} {e.gamma}")
def test_energy_is_that_of_linear_light(encoding: Encoding) -> None:
    rng = np.random.default_rng(4)
    encoded, area = jnp.asarray(rng.normal(0.5, 0.5, (3, 80, 3)), jnp.float32), rng.random(80).astype(np.float32)
    scale = jnp.asarray(rng.random((3, 3)), jnp.float32)
    signed = np.asarray(encoding.decode(encoded, scale, clamp=False), np.float64)
    kept = np.asarray(jax.jit(lambda e, s, a: encoding.decode(e, s, energy_over=a))(encoded, scale, jnp.asarray(area)))
    assert (kept >= 0).all()
    for lighting in range(3):
        for channel in range(3):
            light = signed[lighting, :, channel].astype(np.float32)
            assert (light < 0).any()
            share = area.astype(np.float64) / area.astype(np.float64).sum()
            # Every place rounds twice more: by the product with the scale on both sides.
            allowed = rounding(light, area)[0] + EPS * (share @ np.abs(light))
            energy = share @ (kept[lighting, :, channel] - signed[lighting, :, channel])
            assert abs(energy) <= allowed


# --- in a model -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data() -> Dataset:
    changes = {"atlas.resolution": "32", "lightings.train": "16", "lightings.validation": "2", "lightings.test": "4"}
    changes |= {"points.count": "24", "points.supersample": "2", "transport.samples": "32", "transport.test_samples": "32"}
    return ddprt.bake(ddprt.SCENES["corridor"](albedo=0.3, door_width=0.5), config=load_config(None, changes))


@pytest.fixture(scope="module", params=["linear", "gamma"])
def model(data: Dataset, request: pytest.FixtureRequest) -> Model:
    return ddprt.fit(data, bases=6, ridge=0.0, space=request.param)


def test_a_model_keeps_the_energy_of_each_frame_and_channel(model: Model, data: Dataset) -> None:
    values = data.values(data.split("test"), 24, "radiosity")
    signed, kept = (model.predict(values, clamp=clamp).astype(np.float64) for clamp in (False, "energy"))
    assert (signed < 0).any()
    assert (kept >= 0).all()
    assert (kept != np.maximum(signed, 0)).any()
    share = model.area / model.area.sum()
    rows = (np.moveaxis(light, 2, 1).reshape(-1, len(share)) for light in (signed, kept))
    for before, after in zip(*rows, strict=True):
        light, area = before.astype(np.float32), model.area.astype(np.float32)
        allowed = rounding(light, area)[0] + EPS * (share @ np.abs(before))  # the product with the scale, on both sides
        assert abs(share @ after - max(share @ before, 0)) <= allowed


def test_a_model_scales_and_answers_frames_alone(model: Model, data: Dataset) -> None:
    values = data.values(data.split("test"), 24, "radiosity")
    whole = model.predict(values, clamp="energy")
    np.testing.assert_array_equal(model.predict(4 * values, clamp="energy"), 4 * whole)
    assert (model.predict(0 * values, clamp="energy") == 0).all()
    # The product of matrices rounds by its own batch; the level follows what it is given.
    alone = np.stack([model.predict(frame, clamp="energy") for frame in values])
    signed = [model.predict(values, clamp=False), np.stack([model.predict(frame, clamp=False) for frame in values])]
    off = np.abs(signed[0] - signed[1]).max()
    # The level moves by at most the largest change over the share of the surface that pays, here all that is lit.
    payers = np.min(np.einsum("ltc,t->lc", whole > 0, model.area / model.area.sum())[whole.any(1)])
    rounded = 2 * (np.ceil(np.log2(len(model.area))) + 5) * EPS * np.abs(signed[0]).max()
    assert np.abs(whole - alone).max() <= 2 * (off + rounded) / payers


@pytest.mark.parametrize("unit", [1e-300, 1e-45, 1e38, 1e300])
def test_a_model_keeps_energy_whatever_its_unit_of_area(model: Model, data: Dataset, unit: float) -> None:
    values = data.values(data.split("test"), 24, "radiosity")
    other = replace(model, area=model.area * 2.0 ** np.round(np.log2(unit)))
    np.testing.assert_array_equal(other.predict(values, clamp="energy"), model.predict(values, clamp="energy"))


@pytest.mark.parametrize("clamp", ["soft", None, 2, [True], np.array([True, False])], ids=str)
def test_unknown_clamps_are_refused(model: Model, clamp: Any) -> None:
    as_shipped = inspect.unwrap(Model.predict)  # without the type checks that tests run under
    with pytest.raises(UserError, match="clamp: got"):
        as_shipped(model, np.ones((24, 3)), clamp=clamp)


# --- the ends of the range --------------------------------------------------------------------------------------------

NUMBERS = np.array([0.0, 1e-45, 1e-40, TINY, 1e-30, 1e-10, 1.0, 1e10, 1e30, 1.5e38], np.float32)
NUMBERS = np.concatenate([NUMBERS, -NUMBERS])


@pytest.mark.parametrize("encoding", SPACES, ids=lambda e: f"{e.space} {e.gamma}")
def test_decode_undoes_encode_from_end_to_end_of_the_range(encoding: Encoding) -> None:
    values, scale = jnp.asarray(NUMBERS)[None, :, None] * jnp.ones(3), jnp.ones((1, 3))
    back = np.asarray(encoding.decode(encoding.encode(values, scale), scale, clamp=False), np.float64)[0, :, 0]
    exact, gamma = NUMBERS.astype(np.float64), encoding.gamma if encoding.space == "gamma" else 1.0
    size = np.maximum(np.abs(exact), TINY)
    # Each power is good to one rounding of its result (a whole exponent: gamma of them), and the second power multiplies the
    # error of the first by gamma. Both exponents are rounded, u = EPS / 2 each, which moves x^p by |p ln x| u: |ln x| twice.
    allowed = EPS * (gamma + gamma + np.abs(np.log(size))) * (gamma != 1)
    # Numbers below the smallest normal one may count as dark.
    assert (np.abs(back - exact) <= allowed * size + TINY * (np.abs(exact) < (1 + allowed) * TINY)).all()


@pytest.mark.parametrize("encoding", SPACES, ids=lambda e: f"{e.space} {e.gamma}")
def test_gradients_are_finite_everywhere(encoding: Encoding) -> None:
    values, scale = jnp.asarray(NUMBERS)[None, :, None] * jnp.ones(3), jnp.ones((1, 3))
    assert jnp.isfinite(jax.grad(lambda v: encoding.encode(v, scale).sum())(values)).all()
    for encoded in (NUMBERS, np.linspace(-2, 2, 9)):
        rows = jnp.asarray(encoded, jnp.float32)[None, :, None] * jnp.ones(3)
        assert jnp.isfinite(jax.grad(lambda e: encoding.decode(e, scale, clamp=False).sum())(rows)).all()
        assert jnp.isfinite(jax.grad(lambda e: encoding.decode(e, scale).sum())(rows)).all()


@pytest.mark.parametrize("channels", ["mono", "multi"])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1.0, 1e30])
def test_the_gradient_of_the_scale_is_the_direction(channels: str, size: float) -> None:
    values = np.float32(size) * np.random.default_rng(5).normal(size=(2, 30, 3)).astype(np.float32)
    gradient = np.asarray(jax.grad(lambda v: Encoding(channels=channels).scale(v)[:, 0].sum())(jnp.asarray(values)))
    scaled = values.astype(np.float64)
    norm = np.linalg.norm(scaled[..., 0] if channels == "mono" else scaled.reshape(2, -1), axis=1)[:, None, None]
    direction = np.divide(scaled, norm, out=np.zeros_like(scaled), where=norm > 0)
    if channels == "mono":
        direction[..., 1:] = 0
    # A sum of 30 or 90 squares, half of whose error reaches the root, and a handful of products.
    np.testing.assert_allclose(gradient, direction, rtol=0, atol=50 * EPS)


@pytest.mark.parametrize("encoding", SPACES, ids=lambda e: f"{e.space} {e.gamma}")
def test_what_passes_the_range_becomes_its_end(encoding: Encoding) -> None:
    encoded = jnp.asarray([[[1e10], [-1e10], [3e38]]]) * jnp.ones(3)
    for scale in (0.0, 1.0, 1e30, LARGEST):
        light = encoding.decode(encoded, jnp.full((1, 3), scale), clamp=False)
        assert jnp.isfinite(light).all()
        assert (light[:, 1] == -light[:, 0]).all()
        kept = encoding.decode(encoded, jnp.full((1, 3), scale), energy_over=jnp.ones(3))
        assert jnp.isfinite(kept).all()
    assert float(encoding.decode(encoded, jnp.full((1, 3), 1e30), clamp=False)[0, 2, 0]) == np.float32(LARGEST)
    assert jnp.isfinite(encoding.encode(jnp.full((1, 2, 3), 1e30), jnp.full((1, 3), 1e-30))).all()


def test_a_norm_past_the_range_is_no_trouble(data: Dataset) -> None:
    """Without a mean the scale cancels, so that one which is cut short changes nothing but rounding."""
    model = ddprt.fit(data, bases=6)
    values, power = data.values(data.split("test")[:1], 24, "radiosity")[0], 126
    values = values / values.max()
    large = np.ldexp(values, power).astype(np.float32)
    assert np.linalg.norm(values, axis=0).max() > 1
    scale = np.asarray(Encoding().scale(jnp.asarray(large)[None]))
    assert (scale <= 2.0**power).all()
    assert scale.max() == 2.0**power
    light, expected = (model.predict(v, clamp=False) for v in (large, values))
    sizes = (np.abs(np.asarray(part, np.float64)) for part in (model.relighter.basis, model.relighter.matrix, values))
    # Sums of 24 points and 6 bases, and a handful of roundings by the two scales, of all that is added.
    allowed = 2 * (24 + 6 + 6) * EPS * np.einsum("bt,cbp,pc->tc", *sizes)
    assert (np.abs(np.ldexp(light.astype(np.float64), -power) - expected) <= allowed).all()
    assert np.abs(expected).max() > allowed.max()
