"""The law book: what every entry of METHODS must keep, in every space and channel mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import suns
from hard_arrays import Arrays, make_data, room
from oracles import U32

import ddprt
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.methods import METHODS
from ddprt.methods.learned import Learned
from ddprt.methods.method import STATUSES, Frame
from ddprt.runtime import model as runtime
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene

SETTINGS = suns.SETTINGS
VARIANTS = {
    "plain": {},
    "gamma": {"space": "gamma"},
    "multi": {"channels": "multi"},
    "texel": {"weights": "texel"},
    "mean": {"centre": "mean"},
    "mean gamma multi": {"centre": "mean", "space": "gamma", "channels": "multi"},
}
EPS32 = float(np.finfo(np.float32).eps)


def case(method: str, variant: str) -> object:
    """Training takes seconds: of methods that are trained, one variant is in the fast suite, of others but the baseline two."""
    few = {"plain"} if issubclass(METHODS[method], Learned) else {"plain", "mean gamma multi"}
    long = method != "svd-ridge" and variant not in few
    return pytest.param((method, variant), id=f"{method}-{variant}", marks=[pytest.mark.slow] if long else [])


CASES = [case(method, variant) for method in METHODS for variant in VARIANTS]


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    from ddprt.config import load_config

    config = load_config(
        None,
        {
            "atlas.resolution": "32",
            "lightings.train": "24",
            "lightings.validation": "6",
            "lightings.test": "6",
            "lightings.region_low": "[0.1, 0.5, 0.1]",
            "lightings.region_high": "[0.9, 0.8, 0.9]",
            "lightings.saturation": "[0.0, 0.5]",
            "points.count": "24",
            "points.supersample": "2",
            "transport.samples": "128",
            "transport.test_samples": "128",
        },
    )
    return ddprt.bake(cornell, config=config)


@pytest.fixture(scope="module", params=CASES)
def model(request: pytest.FixtureRequest, data: Dataset) -> Model:
    return fitted(*request.param, data)


@pytest.fixture(scope="module")
def values(data: Dataset) -> np.ndarray:
    return data.values(data.split("test"), 24, "radiosity")


def told(data: Dataset, measured: np.ndarray, indirect: np.ndarray) -> Dataset:
    """The same scene with other light."""
    other = Arrays(data.folder, data.description, None, measured, indirect)
    known = {name: getattr(data, name) for name in ("gbuffer", "covered", "samples", "occluders", "uv")}
    other.__dict__.update(known)
    return other


@pytest.fixture(scope="module")
def light(data: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Measured and indirect light of all lightings."""
    every = range(len(data.lightings))
    return data.values(every, 24, "radiosity"), data.maps("indirect", every)


def fitted(method: str, variant: str, data: Dataset, **options: object) -> Model:
    return suns.fit(data, method, bases=6, **VARIANTS[variant], **options)


def assert_lawful(model: Model, values: np.ndarray) -> None:
    """Finite, black for black, and homogeneous; a power of two changes no digit, so that twice the light is exactly twice."""
    light = model.predict(values)
    assert np.isfinite(light).all()
    np.testing.assert_array_equal(model.predict(2 * values), 2 * light)
    assert (model.predict(0 * values) == 0).all()
    for factor in (1e-20, 1e20):  # as in test_scaling_the_light_scales_the_result, which has the tolerance
        scaled = model.predict(values * np.float32(factor)) / np.float32(factor)
        np.testing.assert_allclose(scaled, light, atol=300 * EPS32 * light.max(), rtol=0)
    assert model.relighter.report.status in STATUSES


def test_batch_equals_loop(model: Model, values: np.ndarray) -> None:
    together = model.predict(values)
    apart = np.stack([model.predict(frame) for frame in values])
    # The same float32 sums of at most 72 terms in another order.
    np.testing.assert_allclose(together, apart, atol=72 * EPS32 * np.abs(together).max(), rtol=0)


def test_save_equals_load(model: Model, values: np.ndarray, tmp_path: object) -> None:
    model.save(f"{tmp_path}/model.ddprt")
    loaded = suns.load_model(f"{tmp_path}/model.ddprt")
    assert (loaded.predict(values) == model.predict(values)).all()
    assert loaded.relighter.report == model.relighter.report
    assert (loaded.encoding, loaded.method, loaded.scene) == (model.encoding, model.method, model.scene)


def test_no_second_compile_for_equal_shapes(model: Model, values: np.ndarray) -> None:
    model.predict(values)
    compiled = runtime._relight._cache_size()
    model.predict(values * 3)
    model.predict(np.zeros_like(values))
    assert runtime._relight._cache_size() == compiled


def test_dark_lightings_give_black(model: Model, values: np.ndarray) -> None:
    dark = values.copy()
    dark[0] = 0
    dark[1, :, 1] = 0  # a lamp without green
    light = model.predict(dark)
    assert np.isfinite(light).all()
    assert (light[0] == 0).all()
    if model.encoding.channels == "mono":
        assert (light[1, :, 1] == 0).all()


@pytest.mark.parametrize("factor", [1e-20, 0.5, 2.0, 1e20])
def test_scaling_the_light_scales_the_result(model: Model, values: np.ndarray, factor: float) -> None:
    base = model.predict(values)
    scaled = model.predict(values * np.float32(factor))
    # Norms and quotients are rounded anew; gamma multiplies a relative error by 2.2, sums have at most 72 terms.
    np.testing.assert_allclose(scaled / np.float32(factor), base, atol=300 * EPS32 * base.max(), rtol=0)


@pytest.mark.parametrize("power", [-67, 67], ids=["below 1e-20", "above 1e20"])
def test_training_light_has_no_unit(
    model: Model,
    power: int,
    data: Dataset,
    light: tuple[np.ndarray, np.ndarray],
    values: np.ndarray,
    request: pytest.FixtureRequest,
) -> None:
    """Trained at 2^-67 or 2^67 of the light, a model is the same one, to the last bit.

    2^-67 = 6.8e-21, 2^67 = 1.5e20: squares of neither fit into float32. A power of two changes no digit, so that no tolerance
    is due, whatever training would make of a rounding.
    """
    other = fitted(*request.node.callspec.params["model"], told(data, *(np.ldexp(part, power) for part in light)))
    expected = model.predict(values)
    assert expected.any()
    np.testing.assert_array_equal(other.predict(values), expected)
    np.testing.assert_array_equal(other.predict(np.ldexp(values, power)), np.ldexp(expected, power))
    assert other.relighter.report.remarks == model.relighter.report.remarks


DISTINCT = 5
"""Points that are left when all from the fifth on measure the same light: fewer than the six bases asked for."""


@pytest.mark.parametrize("named", CASES)
def test_duplicated_points_are_lawful(
    named: tuple[str, str], data: Dataset, light: tuple[np.ndarray, np.ndarray], values: np.ndarray
) -> None:
    """Twenty points of one light, and no ridge: nothing but the rank cut stands between rounding and the result."""
    method, variant = named
    measured = light[0].copy()
    measured[:, DISTINCT:] = measured[:, DISTINCT - 1 : DISTINCT]
    twins = told(data, measured, light[1])
    model = fitted(method, variant, twins, ridge=0.0)
    asked = measured[twins.split("test")]
    assert_lawful(model, asked)
    report = model.relighter.report
    directions = DISTINCT * (3 if model.encoding.channels == "multi" else 1)
    assert all(rank <= directions for rank in report.ranks)
    # Weights that rounding has driven apart cancel over twins to fewer digits than float32 has.
    mean = fitted("mean", variant, twins)
    truth, weight = light[1][twins.split("validation")], data.area / data.area.sum()
    ours, floor = (
        np.einsum("ltc,t->", (m.predict(measured[twins.split("validation")]) - truth) ** 2, weight) for m in (model, mean)
    )
    assert ours <= floor * (1 + 1e-5) or report.status != "ok"


@pytest.mark.parametrize("named", [case(method, variant) for method in METHODS for variant in ("plain", "mean gamma multi")])
def test_a_single_training_lighting_is_lawful(named: tuple[str, str]) -> None:
    """Who has bases to fill says that one lighting does not; who says nothing gives that lighting back.

    The room is that of the catalogue's case "one lighting", so that nothing compiles twice.
    """
    method, variant = named
    measured, indirect = room(train=1)
    model = fitted(method, variant, make_data(measured, indirect))
    assert_lawful(model, measured[1:])
    status = model.relighter.report.status
    if "bases" in METHODS[method].model_fields:
        assert status != "ok"
    if status == "ok":
        # Two norms of n <= 30 squares are each off by (n / 2 + 2) u32, the quotient, the weight and the product by 5 more. A
        # power p is off by (2 p |log x| + 4) u32, and what goes in by p times as much comes out: with x above e^-5 the root is
        # off by 2 * 5 + 4 * 2.2 when it is raised again, and raising adds 2 * 5 + 4. Together below 80.
        assert indirect[0].min() > np.exp(-5.0) * np.linalg.norm(measured[0].ravel())
        np.testing.assert_allclose(model.predict(measured[:1]), indirect[:1], rtol=80 * U32, atol=0)


def test_better_than_the_mean_or_says_so(model: Model, data: Dataset) -> None:
    encoding, validation = model.encoding, data.split("validation")
    mean = ddprt.fit(data, "mean", space=encoding.space, channels=encoding.channels)
    truth, weight = data.maps("indirect", validation), data.area / data.area.sum()
    measured = data.values(validation, 24, "radiosity")
    ours, floor = (np.einsum("ltc,t->", (m.predict(measured) - truth) ** 2, weight) for m in (model, mean))
    assert ours <= floor * (1 + 1e-5) or model.relighter.report.status != "ok"
    assert model.relighter.report.status in STATUSES


def test_a_useless_method_is_told_so(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    from ddprt.methods.floors import MeanLightmap, MeanMap

    class Wrong(MeanLightmap):
        def fit(self, train: object, validation: object, *, key: object) -> MeanMap:
            return MeanMap(-super().fit(train, validation, key=key).mean)

    monkeypatch.setitem(METHODS, "wrong", Wrong)
    assert ddprt.fit(data, "wrong").relighter.report.status == "worse_than_mean"


def test_counts_are_positive_and_shapes_fit(model: Model, data: Dataset, values: np.ndarray) -> None:
    assert model.relighter.nbytes > 0
    assert model.relighter.flops > 0
    light = model.predict(values)
    assert light.shape == (6, int(data.covered.sum()), 3)
    assert light.dtype == np.float32
    assert (light >= 0).all()
    unclamped = model.predict(values, clamp=False)
    np.testing.assert_array_equal(light, np.maximum(unclamped, 0))


@pytest.mark.parametrize("channels", ["mono", "multi"])
def test_uncentred_linear_transfer_adds_up(channels: str, data: Dataset, values: np.ndarray) -> None:
    model = ddprt.fit(data, bases=6, channels=channels)
    one, two = values[:3], values[3:]
    together = model.predict(one + two, clamp=False)
    apart = model.predict(one, clamp=False) + model.predict(two, clamp=False)
    np.testing.assert_allclose(together, apart, atol=300 * EPS32 * together.max(), rtol=0)


def test_centring_the_mean_does_not_add_up(data: Dataset, values: np.ndarray) -> None:
    """A known trap: the mean scaled by ||x|| is homogeneous but not additive."""
    model = ddprt.fit(data, bases=6, centre="mean")
    one, two = values[:3], values[3:]
    gap = model.predict(one + two, clamp=False) - model.predict(one, clamp=False) - model.predict(two, clamp=False)
    assert np.abs(gap).max() > 1e-3 * model.predict(one).max()


def test_all_bases_and_no_ridge_reproduce_the_training_set(data: Dataset) -> None:
    """72 columns of rank 72, 24 lightings and 24 measurements per channel: interpolation, up to the data's rounding."""
    model = ddprt.fit(data, bases=72, ridge=0.0)
    train = data.split("train")
    predicted = model.predict(data.values(train, 24, "radiosity"), clamp=False)
    reference = data.maps("indirect", train)
    condition = max(model.relighter.report.condition)
    assert np.abs(predicted - reference).max() <= 10 * EPS32 * condition * reference.max()


def test_equal_seeds_train_equal_networks(data: Dataset, values: np.ndarray) -> None:
    one, two = (ddprt.fit(data, "mlp", bases=6, settings=SETTINGS["mlp"], seed=3) for _ in range(2))
    assert (one.predict(values) == two.predict(values)).all()
    other = ddprt.fit(data, "mlp", bases=6, settings=SETTINGS["mlp"], seed=4)
    assert (one.predict(values) != other.predict(values)).any()


def test_training_lowers_the_loss(data: Dataset) -> None:
    history = ddprt.fit(data, "mlp", bases=6, settings=SETTINGS["mlp"]).relighter.report.loss
    assert history[-1][1] < 0.5 * history[0][1]


BAD = {
    "unknown method": (("svd", {}), 'no method "svd"; did you mean'),
    "unknown setting": (
        ("mlp", {"settings": {"widht": 3}}),
        'methods.settings.mlp.widht: unknown setting; did you mean "width"?',
    ),
    "setting out of range": (
        ("mlp", {"settings": {"steps": 0}}),
        "methods.settings.mlp.steps: got 0, expected greater than or equal to 1; raise it",
    ),
    "setting of another type": (
        ("point-set", {"settings": {"ridge": "atuo"}}),
        "methods.settings.point-set.ridge: got 'atuo', expected 'auto' or number; did you mean \"auto\"?",
    ),
    "bases": (("svd-ridge", {"bases": 0}), "--fit.bases: got 0"),
    "ridge": (("svd-ridge", {"ridge": -1.0}), "--fit.ridge: got -1.0"),
    "ridge per point": (("svd-ridge", {"ridge": (1.0, 2.0)}), "got 2 values, expected one per measurement"),
    "space": (("svd-ridge", {"space": "log"}), "--fit.space: got 'log'"),
    "too many points": (("svd-ridge", {"points": 49}), "points: got 49, but the dataset has 48 samples"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_requests_are_one_line(name: str, data: Dataset) -> None:
    (method, options), expected = BAD[name]
    with pytest.raises(UserError) as caught:
        ddprt.fit(data, method, **options)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_fewer_points_need_no_new_bake(data: Dataset) -> None:
    model = ddprt.fit(data, bases=4, points=12)
    assert model.predict(data.values(data.split("test"), 12, "radiosity")).shape[0] == 6


def test_more_bases_than_rank_gives_fewer_and_says_so(data: Dataset) -> None:
    report = ddprt.fit(data, bases=500).relighter.report
    assert report.bases == report.numerical_rank == 72
    assert report.status == "rank_deficient"


def test_gradients_are_finite_in_the_dark(model: Model) -> None:
    places = model._places

    numbers = model.relighter.describe([()]).shape[1] if suns.asks(model.method) else 0
    told = jnp.ones((2, numbers, 3)) if numbers else None  # numbers of order 1

    def total(values: jax.Array) -> jax.Array:
        scale = model.encoding.scale(values)
        described = None if told is None else model.encoding.encode(told, scale)
        frame = Frame(model.encoding.encode(values, scale), *places, described=described)
        return model.encoding.decode(model.relighter.predict(frame), scale).sum()

    for values in (jnp.zeros((2, 24, 3)), jnp.zeros((2, 24, 3)).at[0, 3, 0].set(1.0)):
        assert jnp.isfinite(jax.grad(total)(values)).all()
