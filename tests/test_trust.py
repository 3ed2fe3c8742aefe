"""Trust: closed forms against float64 brute force, its calibration, fading, and what is kept in files."""

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import suns

import ddprt
from ddprt.cli import main
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.textures import export_textures
from ddprt.fitting.encoding import Encoding
from ddprt.fitting.selection import decompose
from ddprt.lights import PointLight
from ddprt.methods.method import STATUSES, Examples, Frame
from ddprt.report.evaluate import rank_correlation, trust_agreement
from ddprt.runtime.model import Model
from ddprt.runtime.trust import FALSE_ALARMS, Yardstick, _left_out, calibrated, make_yardstick, outside
from ddprt.scene.mesh import Scene

DOCS = Path(__file__).parent.parent / "docs" / "export.md"
EPS32, EPS64 = float(np.finfo(np.float32).eps), float(np.finfo(np.float64).eps)
POINTS = 24
SMALL = {
    "points.depth": "0",  # so few points that all lamps are near them: sunk, they would take low lamps for high ones
    "atlas.resolution": "32",
    "lightings.train": "16",
    "lightings.validation": "4",
    "lightings.test": "8",
    "lightings.region_low": "[0.1, 0.5, 0.1]",
    "lightings.region_high": "[0.9, 0.8, 0.9]",
    "lightings.saturation": "[0.0, 0.5]",
    "points.count": str(POINTS),
    "points.supersample": "2",
    "transport.samples": "64",
    "transport.test_samples": "64",
}
VARIANTS: dict[str, dict] = {"plain": {}, "gamma": {"space": "gamma"}, "multi": {"channels": "multi"}}


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    return ddprt.bake(cornell, config=load_config(None, SMALL))


@pytest.fixture(scope="module", params=VARIANTS)
def model(request: pytest.FixtureRequest, data: Dataset) -> Model:
    return ddprt.fit(data, bases=6, **VARIANTS[request.param])


@pytest.fixture(scope="module")
def values(data: Dataset) -> np.ndarray:
    """Held-out light, and light of no kind that was trained on."""
    held_out = data.values(data.split("test"), POINTS, "radiosity")
    strange = np.random.default_rng(0).uniform(0, 1, (6, POINTS, 3)).astype(np.float32) ** 8
    return np.concatenate([held_out, strange])


def ruler_of(model: Model) -> Yardstick:
    assert model.yardstick is not None
    return model.yardstick


def encoded(model: Model, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(groups, lightings, inputs) as the model sees them, and (groups, lightings) scale."""
    batch = jnp.asarray(values)
    scale = model.encoding.scale(batch)
    z = np.asarray(model.encoding.encode(batch, scale), np.float64)
    groups = len(ruler_of(model).directions)
    rows = np.moveaxis(z, 2, 0) if groups == 3 else z.reshape(1, len(z), -1)
    return rows, np.asarray(scale, np.float64).T[:groups]


def brute_force(model: Model, data: Dataset, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Novelty, leverage and unexplained part of each frame by solving with D D^T + lambda Id in float64."""
    train, _ = encoded(model, data.values(data.split("train"), POINTS, "radiosity"))
    z, scale = encoded(model, values)
    ridge, parts = ruler_of(model).ridge, []
    for rows, frames in zip(train, z, strict=True):
        solved = np.linalg.solve(rows.T @ rows + ridge * np.eye(rows.shape[1]), frames.T).T
        size = (frames**2).sum(1)
        leverage = (frames * solved).sum(1)
        parts.append((ridge * leverage / size, leverage, ridge**2 * (solved**2).sum(1) / size))
    weight = scale**2 / (scale**2).sum(0)
    novelty, leverage, square = (np.einsum("gf,gf->f", weight, part) for part in zip(*parts, strict=True))
    return novelty, leverage, np.sqrt(square)


def rounding(model: Model, share: np.ndarray) -> np.ndarray:
    """How far a share of energy (novelty, or the unexplained part squared) may be off.

    Of an x of norm 1: a product of n terms is off by n eps of its absolute sum, at most 1 for unit rows. So p = P x is off by
    (n + 1) eps sqrt(d) with P's own rounding, P^T p by as much again (|P| = 1), by P's rounding sqrt(d) eps and by d sqrt(n)
    eps of its own sums: r by delta, all told, and the same holds for p. A sum of squares s is then off by
    2 sqrt(s) delta + delta², and by (n + d + 16) eps of itself for the sums, weights, shares and quotients. The solve that it
    is compared with is good to n eps64 times the condition number.
    """
    ruler = ruler_of(model)
    d, n = ruler.directions.shape[1:]
    delta = EPS32 * (2 * (n + 1) * np.sqrt(d) + d * np.sqrt(n) + 2)
    condition = 1 / float(ruler.shares.min())
    return 2 * np.sqrt(share) * delta + delta**2 + ((n + d + 16) * EPS32 + n * EPS64 * condition) * share


def test_closed_form_equals_brute_force(model: Model, data: Dataset, values: np.ndarray) -> None:
    novelty, leverage, unexplained = brute_force(model, data, values)
    found, ruler = model.trust(values), ruler_of(model)
    assert found is not None
    z, _ = encoded(model, values)
    # Leverage is novelty times ||z||² / lambda in each channel; ||z|| is 1 in linear space, at most n^(1/2 - 1/(2 gamma)) else.
    allowed = rounding(model, novelty)
    assert (np.abs(found.leverage - leverage) <= 3 * allowed * (z**2).sum(2).max() / ruler.ridge).all()
    assert (np.abs(found.unexplained**2 - unexplained**2) <= rounding(model, unexplained**2)).all()
    scale = jnp.asarray(model.encoding.scale(jnp.asarray(values)))
    ours = ruler.novelty(model.encoding.encode(jnp.asarray(values), scale), scale)
    assert (np.abs(ours - novelty) <= allowed).all()
    assert (np.diff(found.score[np.argsort(novelty)]) <= 0).sum() >= len(values) - 2  # falls with novelty, but for near ties


def test_a_direction_of_training_keeps_its_share_of_the_ridge(model: Model, data: Dataset) -> None:
    if model.encoding.space == "gamma":
        pytest.skip("singular vectors are encoded light there: the same test in linear space says it all")
    ruler = ruler_of(model)
    train, _ = encoded(model, data.values(data.split("train"), POINTS, "radiosity"))
    sigma = [np.linalg.svd(rows, compute_uv=False) for rows in train]
    count = ruler.directions.shape[1]
    frames = np.moveaxis(ruler.directions, 0, 2) if len(train) == 3 else ruler.directions[0].reshape(count, POINTS, 3)
    found = model.trust(frames)
    assert found is not None
    weight = np.ones(len(train)) / len(train)  # the same energy in every channel
    share = np.stack([ruler.ridge / (s[:count] ** 2 + ruler.ridge) for s in sigma])
    square = weight @ share**2
    assert (np.abs(found.unexplained**2 - square) <= rounding(model, square)).all()


def test_light_at_right_angles_to_training_is_wholly_unexplained(model: Model) -> None:
    if model.encoding.space == "gamma":
        pytest.skip("right angles are between encoded lights there")
    found = model.trust(orthogonal(model))
    assert found is not None
    slack = rounding(model, np.array(1.0))
    assert abs(found.unexplained**2 - 1) <= slack
    assert found.score <= slack * max(ruler_of(model).exponent, 1)
    assert found.extrapolating


def orthogonal(model: Model) -> np.ndarray:
    """(points, 3) light outside of the span of training, in linear space."""
    directions = np.asarray(ruler_of(model).directions, np.float64)
    noise = np.random.default_rng(1).normal(size=(directions.shape[0], directions.shape[2]))
    for rows, light in zip(directions, noise, strict=True):
        light -= np.linalg.lstsq(rows.T, light, rcond=None)[0] @ rows
    return (noise.T if len(noise) == 3 else noise.reshape(POINTS, 3)).astype(np.float32)


@pytest.mark.parametrize("factor", [2.0**-60, 2.0**-3, 2.0**90])
def test_scaling_the_light_by_a_power_of_two_changes_no_bit(model: Model, values: np.ndarray, factor: float) -> None:
    before, after = model.trust(values), model.trust(values * np.float32(factor))
    for name in ("score", "leverage", "unexplained", "extrapolating"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_trust_knows_no_end_of_the_range(model: Model, values: np.ndarray) -> None:
    """Scales end at 2^126; norms of light near the largest number lie past it."""
    unit = values / values.max((1, 2), keepdims=True)
    before, after = model.trust(unit), model.trust(np.ldexp(unit, 127))
    assert np.isfinite(np.ldexp(unit, 127)).all()
    for name in ("score", "leverage", "unexplained", "extrapolating"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_fading_stays_finite_at_the_end_of_the_range(model: Model, values: np.ndarray) -> None:
    unit = values / values.max((1, 2), keepdims=True)
    ruler = replace(ruler_of(model), exponent=0.0, mean=np.float32(1e6) * ruler_of(model).mean)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        light = replace(model, yardstick=ruler).predict(np.ldexp(unit, 127), fade=True)
    assert np.isfinite(light).all()
    assert light.max() == np.finfo(np.float32).max


def test_scaling_the_light_otherwise_changes_rounding_alone(model: Model, values: np.ndarray) -> None:
    before, after = model.trust(values), model.trust(values * np.float32(np.pi))
    assert before is not None
    assert after is not None
    # Both are within the bound of the exact value for the rows they saw, and the rows differ by 4 roundings.
    square = before.unexplained**2
    allowed = 2 * rounding(model, square) + 2 * np.sqrt(square) * 4 * EPS32
    assert (np.abs(after.unexplained**2 - square) <= allowed).all()


@pytest.mark.parametrize("name", suns.ALL_METHODS)
def test_every_method_has_trust(name: str, data: Dataset, values: np.ndarray, tmp_path: Path) -> None:
    settings = suns.SETTINGS.get(name)
    model = suns.fit(data, name, settings=settings, **({"bases": 6} if name == "svd-ridge" else {}))
    found = model.trust(values)
    assert found is not None
    assert ((found.score >= 0) & (found.score <= 1)).all()
    assert np.isfinite(found.leverage).all()
    assert found.score[:8].min() > found.score[8:].max(), "the kind of training is trusted more than noise"
    plain = ddprt.fit(data, "mean")
    np.testing.assert_array_equal(found.leverage, plain.trust(values).leverage, "what is strange does not depend on the method")
    model.save(tmp_path)
    loaded = ddprt.load_model(tmp_path).trust(values)
    for part in ("score", "leverage", "unexplained", "extrapolating"):
        np.testing.assert_array_equal(getattr(loaded, part), getattr(found, part))


def test_models_of_older_versions_know_no_trust(data: Dataset, values: np.ndarray, tmp_path: Path) -> None:
    model = ddprt.fit(data, bases=6)
    replace(model, yardstick=None).save(tmp_path / "old")
    document = json.loads((tmp_path / "old" / "model.json").read_text())
    del document["trust"]
    (tmp_path / "old" / "model.json").write_text(json.dumps(document))
    old = ddprt.load_model(tmp_path / "old")
    assert old.trust(values) is None
    np.testing.assert_array_equal(old.predict(values), model.predict(values))
    with pytest.raises(UserError, match="older version"):
        old.predict(values, fade=True)
    assert trust_agreement(old, values, np.ones(len(values))) is None
    assert json.loads(export_textures(old, tmp_path / "export")[-1].read_text())["trust"] is None


@pytest.mark.parametrize("change", [{"exponent": "a lot"}, {"colour": 1.0}], ids=str)
def test_damaged_trust_is_refused(change: dict, data: Dataset, tmp_path: Path) -> None:
    ddprt.fit(data, "mean").save(tmp_path)
    document = json.loads((tmp_path / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps({**document, "trust": {**document["trust"], **change}}))
    with pytest.raises(UserError, match=f"trust.{next(iter(change))}: got"):
        ddprt.load_model(tmp_path)


@pytest.mark.parametrize("part", ["directions", "shares"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_cannot_be_told_is_not_trusted(model: Model, values: np.ndarray, part: str, value: float) -> None:
    broken = replace(model, yardstick=replace(ruler_of(model), **{part: np.full_like(getattr(ruler_of(model), part), value)}))
    found = broken.trust(values)
    assert found is not None
    assert (found.score == 0).all()
    assert found.extrapolating.all()


def test_dark_frames_and_channels(model: Model, values: np.ndarray) -> None:
    dark = values[:3].copy()
    dark[0] = 0
    dark[1, :, 1] = 0
    found, alone = model.trust(dark), model.trust(dark[0])
    assert found is not None
    assert alone is not None
    assert (found.score[0], found.leverage[0], found.unexplained[0], found.extrapolating[0]) == (1, 0, 0, False)
    assert alone.score.shape == ()
    assert alone.score == 1
    assert np.isfinite(found.score).all()
    assert np.isfinite(found.leverage).all()
    if len(ruler_of(model).directions) == 3:
        # The green channel carries no energy, so what was strange in it does not count.
        other = dark[1].copy()
        other[:, [0, 2]] = values[1][:, [0, 2]]
        alone = model.trust(other)
        assert alone is not None
        square = found.unexplained[1] ** 2  # a frame alone and among others are summed in another order
        assert abs(alone.unexplained**2 - square) <= 2 * rounding(model, square)


@pytest.mark.parametrize(("place", "value"), [((0, 0), np.nan), ((2, 1), np.inf)])
def test_values_that_are_not_finite_are_refused(model: Model, values: np.ndarray, place: tuple, value: float) -> None:
    light = values[0].copy()
    light[place] = value
    with pytest.raises(UserError, match="got NaN or infinity"):
        model.trust(light)
    with pytest.raises(UserError, match="got shape"):
        model.trust(light[:-1])


def test_fading_changes_nothing_where_trust_is_full(model: Model, values: np.ndarray) -> None:
    sure = replace(model, yardstick=replace(ruler_of(model), fade_from=0.0, exponent=1e9))
    found = sure.trust(values)
    assert found is not None
    assert (found.score == 1).any()
    full = found.score == 1
    np.testing.assert_array_equal(sure.predict(values, fade=True)[full], sure.predict(values)[full])


def test_fading_ends_at_the_mean_map_as_bright_as_the_light(model: Model, values: np.ndarray) -> None:
    lost = replace(model, yardstick=replace(ruler_of(model), exponent=0.0))
    scale = np.asarray(model.encoding.scale(jnp.asarray(values)))[:, None]
    expected = model.predict(ruler_of(model).mean) * scale
    np.testing.assert_array_equal(lost.predict(values, fade=True), expected)
    between = replace(model, yardstick=replace(ruler_of(model), exponent=0.5, fade_from=0.3)).predict(values, fade=True)
    ends = np.stack([expected, model.predict(values)])
    # Between the two, within the rounding of a sum of two products.
    slack = 3 * EPS32 * np.abs(ends).max(0)
    assert ((between >= ends.min(0) - slack) & (between <= ends.max(0) + slack)).all()


def test_fading_is_smooth_and_rises_with_trust() -> None:
    ruler = Yardstick(np.zeros((1, 0, 3), np.float32), np.zeros((1, 0), np.float32), np.zeros((1, 3), np.float32), 1.0)
    score = np.linspace(0, 1, 1001)
    for start in (0.0, 0.3, 0.999):
        kept = replace(ruler, fade_from=start).kept(score)
        assert kept[0] == 0
        assert (kept[score >= 1 - start] == 1).all()
        # A smooth step of width 1 - start is steepest in its middle, by 3/2 over its width.
        steps = np.diff(kept)
        assert steps.min() >= 0
        assert steps.max() <= 1.5 / (1 - start) * 1e-3 + 4 * EPS64
    assert (replace(ruler, fade_from=1.0).kept(np.array([0.0, 1e-3])) == [0, 1]).all()


def test_the_map_faded_to_is_the_mean_lightmap_but_for_what_the_model_misses(data: Dataset) -> None:
    model, mean = ddprt.fit(data, bases=6), ddprt.fit(data, "mean")
    train = data.split("train")
    measured, truth = data.values(train, POINTS, "radiosity"), data.maps("indirect", train)
    scale = np.asarray(model.encoding.scale(jnp.asarray(measured)), np.float64)
    weight = scale**2 / (scale**2).sum(0)
    residual = (model.predict(measured, clamp=False) - truth) / scale[:, None]
    # A mean of residuals is no longer than the root of their mean square (Jensen). Both maps are float32 sums over at most
    # `POINTS` points and as many lightings.
    allowed = np.sqrt(np.einsum("lc,ltc->c", weight, residual**2))
    got = model.predict(ruler_of(model).mean, clamp=False)
    wanted = np.asarray(mean.relighter.mean)  # type: ignore[attr-defined]
    off = np.linalg.norm(got - wanted, axis=0)
    assert (off <= allowed + 4 * POINTS * EPS32 * np.linalg.norm(wanted, axis=0)).all()


def pairs(rng: np.random.Generator, lightings: int, points: int, rank: int) -> Examples:
    """Measurements of some rank and light that depends on them linearly."""
    mixing, light = rng.normal(size=(rank, points)), rng.normal(size=(rank, 40))
    return of_kind(rng, mixing, light, lightings)


def of_kind(rng: np.random.Generator, mixing: np.ndarray, light: np.ndarray, lightings: int) -> Examples:
    cause = rng.normal(size=(lightings, 3, len(mixing)))
    values = np.moveaxis(cause @ mixing, 1, 2) + 0.1 * rng.normal(size=(lightings, mixing.shape[1], 3))
    scale = np.linalg.norm(values, axis=1)
    places = jnp.zeros((mixing.shape[1], 3))
    frame = Frame(jnp.asarray(values / scale[:, None], jnp.float32), places, places)
    indirect = np.moveaxis(cause @ light, 1, 2) / scale[:, None]
    return Examples(frame, jnp.asarray(indirect, jnp.float32), jnp.asarray(scale, jnp.float32), np.ones(40, np.float32))


def test_leaving_out_equals_refitting_and_takes_twins_along() -> None:
    rng = np.random.default_rng(2)
    X = rng.normal(size=(14, 9)).astype(np.float32).astype(np.float64)
    X[5] = X[2]
    for ridge in (1e-6, 1e-2, 1.0):
        found = _left_out(decompose(jnp.asarray(X), jnp.asarray(X[:, :2])), ridge)
        for row, x in enumerate(X):
            others = X[~(x == X).all(1)]
            A = others.T @ others + ridge * np.eye(9)
            expected = ridge * x @ np.linalg.solve(A, x)
            # Both solve with conditions of at most cond(A); h / (1 - h) doubles it.
            allowed = 4 * len(X) * EPS64 * np.linalg.cond(A) * max(expected, 1e-300) + 4 * len(X) * EPS64 * ridge * (x @ x)
            assert abs(found[row] - expected) <= allowed


def test_lightings_of_the_same_kind_are_seldom_called_extrapolating() -> None:
    rng = np.random.default_rng(3)
    mixing, light = rng.normal(size=(6, 30)), rng.normal(size=(6, 40))
    ruler = make_yardstick(of_kind(rng, mixing, light, 100), Encoding())
    same, other = of_kind(rng, mixing, light, 400), of_kind(rng, rng.normal(size=(6, 30)), light, 50)
    flagged = np.mean(ruler.novelty(same.frame.values, same.scale) > ruler.level)
    # The level is a quantile of 100 and is tried on 400: five standard deviations of both.
    assert flagged <= FALSE_ALARMS + 5 * np.sqrt(FALSE_ALARMS * (1 - FALSE_ALARMS) * (1 / 100 + 1 / 400))
    assert (ruler.novelty(other.frame.values, other.scale) > ruler.level).all()


def test_the_level_is_that_of_the_place_which_leaves_false_alarms() -> None:
    """Of 39 lightings and one more, 5 % are 2: one of the 39 and, as likely as each of them, the new one lie above."""
    train = pairs(np.random.default_rng(7), 39, 12, 3)
    ruler = make_yardstick(train, Encoding())
    rows, scale = np.moveaxis(np.asarray(train.frame.values, np.float64), 2, 0), np.asarray(train.scale, np.float64)
    alone, slack = np.zeros(39), 0.0
    for channel, X in enumerate(rows):
        for row, x in enumerate(X):
            A = np.delete(X, row, 0).T @ np.delete(X, row, 0) + ruler.ridge * np.eye(12)
            share = min(ruler.ridge * x @ np.linalg.solve(A, x) / (x @ x), 1)
            alone[row] += scale[row, channel] ** 2 * share / (scale[row] ** 2).sum()
            slack = max(slack, 8 * 39 * EPS64 * np.linalg.cond(A))  # as for leaving one out, relative to 1
    alone.sort()
    assert np.diff(alone[-4:]).min() > 2 * slack, "the places could not be told apart"
    assert abs(ruler.level - alone[-2]) <= slack


def test_the_mean_lightmap_is_typically_as_good_where_fading_begins() -> None:
    ruler = make_yardstick(pairs(np.random.default_rng(4), 20, 12, 3), Encoding())
    novelty, error = np.array([0.1, 0.2, 0.3, 0.0]), np.array([0.3, 0.4, 0.5, np.nan])
    assert calibrated(ruler, novelty, error, np.array([0.9, 0.2, 0.3, 0.1])).fade_from == 0.3


def test_the_exponent_is_found_again() -> None:
    ruler = make_yardstick(pairs(np.random.default_rng(4), 20, 12, 3), Encoding())
    novelty = np.array([1e-3, 0.1, 0.4, 0.0, 0.2])
    error = np.array([*novelty[:3] ** 0.7, 0.0, np.nan])
    found = calibrated(ruler, novelty, error, np.full(5, 0.4))
    # Logarithms of rounded powers, of size at most 7, in a quotient of two sums of three.
    assert abs(found.exponent - 0.7) <= 16 * EPS64
    assert found.fade_from == 0.4
    assert calibrated(ruler, novelty, np.full(5, 3.0), np.full(5, 2.0)).exponent == 0
    assert calibrated(ruler, novelty, np.full(5, 3.0), np.full(5, 2.0)).fade_from == 1
    assert calibrated(ruler, novelty, np.full(5, np.nan), np.full(5, np.nan)) is ruler


@pytest.mark.parametrize(("above", "of", "expected"), [(0, 0, False), (2, 2, False), (3, 3, True), (3, 6, False), (4, 6, True)])
def test_when_validation_lies_outside(above: int, of: int, expected: bool) -> None:
    ruler = Yardstick(*(np.zeros(shape, np.float32) for shape in ((1, 0, 3), (1, 0), (1, 3))), 1.0, level=0.1)
    assert outside(ruler, np.where(np.arange(of) < above, 0.2, 0.1)) == expected


@pytest.mark.parametrize("lightings", [0, 1])
def test_next_to_nothing_to_learn_from(lightings: int) -> None:
    few = pairs(np.random.default_rng(5), 2, 6, 2)
    scale = few.scale.at[lightings:].set(0)
    dark = replace(few, scale=scale, frame=replace(few.frame, values=few.frame.values * (scale > 0)[:, None]))
    ruler = make_yardstick(dark, Encoding())
    found = ruler.measure(Encoding(), few.frame.values)
    assert np.isfinite(found.leverage).all()
    assert found.score[1] < found.score[0] if lightings else found.score[1] <= 4 * EPS32, "what was learned is trusted more"
    assert bool(found.extrapolating[1]) == (lightings == 0)  # of one lighting nobody knows how it differs from others


def test_a_fit_says_that_its_validation_lightings_are_of_another_kind(cornell: Scene, data: Dataset) -> None:
    assert ddprt.fit(data, bases=6).relighter.report.status != "extrapolating"
    low = [(PointLight(position=(0.1 * i, 0.02, 0.05 * i), intensity=(1, 1, 1)),) for i in range(1, 5)]
    high = [data.lightings[index] for index in data.split("train")]
    lightings = {"train": high, "validation": low, "test": low[:1]}
    foreign = ddprt.bake(cornell, lightings, config=load_config(None, SMALL))
    report = ddprt.fit(foreign, bases=6).relighter.report
    assert "extrapolating" in report.remarks
    assert "extrapolating" in STATUSES


def test_relight_says_how_far_to_trust(data: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    ddprt.fit(data, bases=6).save(tmp_path / "model")

    def relit(position: list[float]) -> tuple[str, str]:
        lamp = json.dumps({"type": "point", "position": position, "intensity": [1, 1, 1]})
        with pytest.raises(SystemExit) as stop:
            main(["relight", str(tmp_path / "model"), "--lighting", lamp, "--out", str(tmp_path / "a.exr")])
        assert stop.value.code == 0
        told = capsys.readouterr()
        return told.out, told.err

    low, known = [0.5, 0.01, 0.02], data.lightings[data.split("train")[0]][0].anchor()
    out, warning = relit(np.asarray(known).tolist())
    assert re.search(r"trust: +0\.[0-9]{2}, an expected error of \d+%", out)
    assert "extrapolating" not in warning
    out, warning = relit(low)
    assert "trust:" in out
    assert STATUSES["extrapolating"] in warning


def test_the_exported_formula_equals_trust(model: Model, values: np.ndarray, tmp_path: Path) -> None:
    export_textures(model, tmp_path, precision="float")
    scope: dict = {}
    for block in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL):
        exec(block, scope)
    novelty, _, _ = brute_force_free(model, values)
    found = model.trust(values)
    assert found is not None
    for index, frame in enumerate(values):
        score, share = scope["trust"](tmp_path, frame)
        assert abs(share - novelty[index]) <= 2 * rounding(model, novelty[index])
        # d(novelty^b) = b novelty^(b - 1) d(novelty), and one rounding of the power.
        slope = ruler_of(model).exponent * novelty[index] ** (ruler_of(model).exponent - 1)
        assert abs(score - found.score[index]) <= 2 * slope * rounding(model, novelty[index]) + 4 * EPS32
    assert scope["trust"](tmp_path, np.zeros((POINTS, 3), np.float32))[0] == 1


def brute_force_free(model: Model, values: np.ndarray) -> tuple[np.ndarray, None, None]:
    scale = model.encoding.scale(jnp.asarray(values))
    return ruler_of(model).novelty(model.encoding.encode(jnp.asarray(values), scale), scale), None, None


def test_ranks_agree_with_scipy() -> None:
    from scipy.stats import spearmanr

    rng = np.random.default_rng(6)
    a, b = rng.integers(0, 5, 30).astype(float), rng.normal(size=30)
    found = rank_correlation(a, b)
    assert found is not None
    # Correlations of 30 ranks: sums of integers and halves, exact, but for a root and a quotient.
    assert abs(found - spearmanr(a, b)[0]) <= 64 * EPS64
    assert rank_correlation(np.ones(3), b[:3]) is None


def test_what_the_metrics_say_of_trust(data: Dataset, values: np.ndarray) -> None:
    model = ddprt.fit(data, bases=6)
    found = model.trust(values)
    assert found is not None
    section = trust_agreement(model, values, 1 - found.score)
    assert section is not None
    assert section["spearman"] == 1
    assert section["flagged_share"] == np.mean(found.extrapolating)
    assert section["unseen"] == 0
    assert section["median_error"] == section["median_expected_error"]
    dark = np.concatenate([np.zeros_like(values[:1]), values[:7]])
    few = trust_agreement(model, dark, np.ones(8))
    assert few is not None
    assert (few["spearman"], few["unseen"]) == (None, 1)
    json.dumps([section, few], allow_nan=False)
