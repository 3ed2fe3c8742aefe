"""Classical PRT by harmonics: the fit is the projection, windows, what lights it takes, and that lights reach it everywhere."""

import re
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_arrays import make_data, room
from oracles import U32

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.harmonics import count, harmonics
from ddprt.lights import DirectionalLight, PointLight
from ddprt.methods import make_method
from ddprt.methods.method import Examples, Frame
from ddprt.methods.sh_prt import HarmonicTransfer, describe, window
from ddprt.report.evaluate import evaluate
from ddprt.runtime import model as runtime
from ddprt.runtime.model import Model
from ddprt.scene.lion import lion
from ddprt.scene.winding import welded

GOLDEN = (1 + np.sqrt(5)) / 2
TEXELS = 7
EVEN = 200
SMALL = {"atlas.resolution": "48", "points.count": "16", "points.supersample": "2"}


def icosahedron() -> np.ndarray:
    """Its corners: their mean of a polynomial of degree 5 or less is that over the sphere."""
    signs = np.array([[a, b * GOLDEN] for a in (-1, 1) for b in (-1, 1)])
    flat = np.concatenate([np.zeros((4, 1)), signs], 1)
    return np.concatenate([np.roll(flat, turn, 1) for turn in range(3)]) / np.sqrt(1 + GOLDEN**2)


def spiral(size: int) -> np.ndarray:
    """Directions that fill the sphere evenly, in golden turns."""
    rise, turn = 1 - (2 * np.arange(size) + 1) / size, 2 * np.pi * np.arange(size) / GOLDEN
    return np.stack([np.sqrt(1 - rise**2) * np.cos(turn), rise, np.sqrt(1 - rise**2) * np.sin(turn)], 1)


def product_rule(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights (they sum to 4 pi) that integrate polynomials up to a degree: Gauss in height, even about it."""
    rise, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    turn = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    flat = np.sqrt(1 - rise**2)[:, None]
    grid = np.stack([flat * np.cos(turn), np.broadcast_to(rise[:, None], (len(rise), len(turn))), flat * np.sin(turn)], -1)
    return grid.reshape(-1, 3), np.repeat(weight * 2 * np.pi / (degree + 1), degree + 1)


def suns(towards: np.ndarray, irradiance: Any = (1.0, 1.0, 1.0)) -> list[tuple[DirectionalLight]]:
    colours = np.broadcast_to(irradiance, (len(towards), 3))
    return [
        (DirectionalLight(direction=tuple((-w).tolist()), irradiance=tuple(c.tolist())),)
        for w, c in zip(towards, colours, strict=True)
    ]


def pairs(light: np.ndarray, lightings: Any, scale: np.ndarray | None = None) -> Examples:
    """Light of some lightings, (lightings, texels, 3), over scales that points would give it."""
    scale = np.ones((len(light), 3)) if scale is None else scale
    frame = Frame(jnp.ones((len(light), 4, 3)), jnp.zeros((4, 3)), jnp.zeros((4, 3)), lightings)
    encoded = jnp.asarray(light / scale[:, None], jnp.float32)
    return Examples(frame, encoded, jnp.asarray(scale, jnp.float32), np.linspace(1, 2, light.shape[1], dtype=np.float32))


def fitted(examples: Examples, **settings: Any) -> HarmonicTransfer:
    return make_method("sh-prt", {}, settings).fit(examples, examples, key=jax.random.key(0))


def transport(degree: int) -> np.ndarray:
    """Indirect light of some texels under unit light, as coefficients up to a degree, (harmonics, texels, 3)."""
    return np.random.default_rng(degree).uniform(-1, 1, (count(degree), TEXELS, 3))


def under(coefficients: np.ndarray, degree: int, towards: np.ndarray) -> np.ndarray:
    return np.einsum("lk,ktc->ltc", harmonics(towards, degree), coefficients)


@pytest.mark.parametrize("ridge", [0.0, "auto"])
def test_light_within_the_order_is_learned_as_it_is(ridge: Any) -> None:
    """Transport made of harmonics up to the order, under suns of any colour: the matrix is that transport."""
    truth, rng = transport(2), np.random.default_rng(1)
    towards, colour = spiral(40), rng.uniform(0.5, 2, (40, 3))
    light = under(truth, 2, towards) * colour[:, None]
    found = fitted(pairs(light, suns(towards, colour), rng.uniform(0.1, 9, (40, 3))), order=2, ridge=ridge)
    # Light and scale are rounded to float32, and so is the matrix: each row of light is off by 2 u32 of itself. By least
    # squares that reaches the matrix at most times 1 / the smallest singular value of the rows, over all 40 of them.
    least = np.linalg.svd(harmonics(towards, 2), compute_uv=False)[-1]
    rows = under(truth, 2, towards)
    allowed = 3 * U32 * (np.sqrt((rows**2).sum(0)) / least + np.abs(truth).max(0))
    # A ridge by leave-one-out is the lowest of the path where there is no noise: 1e-13 of the largest squared value.
    if ridge == "auto":
        assert found.report.ridge[0] <= 1e-10
        allowed = allowed + 1e-10 / (least**2 * 4 * np.pi / count(2)) * np.abs(truth).max()
    assert (np.abs(np.asarray(found.transfer) - truth) <= allowed).all()


def test_the_fit_is_the_projection_where_directions_integrate_exactly() -> None:
    """Suns at an icosahedron's corners integrate products of order 2 with light of degree 3: both are the same matrix.

    Projection is the classical way, by a rule of its own: the sum of weights times light times harmonic.
    """
    truth = transport(3)
    towards, weights = product_rule(8)
    classical = np.einsum("l,lk,ltc->ktc", weights, harmonics(towards, 2), under(truth, 3, towards))
    found = fitted(pairs(under(truth, 3, icosahedron()), suns(icosahedron())), order=2, ridge=0.0)
    # 12 rows of light rounded to float32, of harmonics whose singular values are all sqrt(12 / 4 pi), and the matrix rounded.
    allowed = (
        2 * U32 * (np.sqrt((under(truth, 3, icosahedron()) ** 2).sum(0)) / np.sqrt(12 / (4 * np.pi)) + np.abs(truth).max())
    )
    np.testing.assert_allclose(classical, truth[:9], atol=1e-12, rtol=0)
    assert (np.abs(np.asarray(found.transfer) - classical) <= allowed).all()
    # Degree 4 times order 2 is degree 6, which the corners do not integrate.
    more = transport(4)
    missed = fitted(pairs(under(more, 4, icosahedron()), suns(icosahedron())), order=2, ridge=0.0).transfer
    assert np.abs(np.asarray(missed) - more[:9]).max() > 0.01


@pytest.fixture(scope="module")
def baked() -> Dataset:
    """A small lion under even suns and those of a rule (all train, so that one set of rays is behind them), and others."""
    towards = np.concatenate([spiral(EVEN), product_rule(14)[0]])
    config = load_config(None, {**SMALL, "transport.samples": "64", "transport.test_samples": "64"})
    splits = {"train": suns(towards), "validation": suns(spiral(5)), "test": suns(spiral(9))}
    return ddprt.bake(lion(cells=24), splits, config=config)


def test_a_dense_fit_is_the_classical_projection(baked: Dataset) -> None:
    """Transport of a real scene, whose light has all degrees: the fit is as near the projection as its directions allow.

    Found T = (A^T A)^-1 A^T y and y = A t + r for any t, so T - t = (A^T A)^-1 A^T r, exactly. With t the projection by the
    rule, both factors are known: that is the bound, which only rounding widens. That it is small is told beside it.
    """
    order = 3
    towards, weights = product_rule(14)
    y, light = np.split(baked.maps("indirect", baked.split("train")).astype(np.float64), [EVEN])
    classical = np.einsum("l,lk,ltc->ktc", weights, harmonics(towards, order), light)
    found = np.asarray(fitted(pairs(y, suns(spiral(EVEN))), order=order, ridge=0.0).transfer, np.float64)
    A = harmonics(spiral(EVEN), order)
    left = y - np.einsum("lk,ktc->ltc", A, classical)
    allowed = np.linalg.norm(np.einsum("lk,ltc->ktc", A, left), axis=0) / np.linalg.svd(A, compute_uv=False)[-1] ** 2
    # Light is scaled and rounded once each, in as many rows, and the matrix once.
    allowed += (
        3 * U32 * (np.linalg.norm(y, axis=0) / np.linalg.svd(A, compute_uv=False)[-1] + np.linalg.norm(classical, axis=0))
    )
    apart = np.linalg.norm(found - classical, axis=0)
    assert (apart <= allowed).all()
    assert np.linalg.norm(apart) < 0.1 * np.linalg.norm(classical), "the suns fill the sphere well enough to see it"


def test_windows() -> None:
    """Written out for order 2: bands at 0, 1/3 and 2/3 of the window's width."""
    third = np.sqrt(3) / 2 / (np.pi / 3)  # sin x / x at pi / 3
    for name, bands in {"none": (1, 1, 1), "hanning": (1, 0.75, 0.25), "lanczos": (1, third, third / 2)}.items():
        np.testing.assert_allclose(window(name, 2), np.repeat(bands, [1, 3, 5]), rtol=1e-15)
    truth = transport(2)
    examples = pairs(under(truth, 2, spiral(40)), suns(spiral(40)))
    plain, soft = (np.asarray(fitted(examples, order=2, ridge=0.0, window=name).transfer) for name in ("none", "hanning"))
    np.testing.assert_allclose(soft, plain * window("hanning", 2)[:, None, None], rtol=2 * U32)


def test_a_window_takes_ringing_down() -> None:
    """Light behind a wall is 0 where the sun is behind it; order 6 rings below zero there, windows do so less."""
    towards = spiral(200)
    light = np.repeat(np.repeat(np.maximum(towards[:, :1, None], 0) > 0, TEXELS, 1), 3, 2).astype(float)
    below = []
    for name in ("none", "lanczos", "hanning"):
        found = fitted(pairs(light, suns(towards)), order=6, ridge=0.0, window=name)
        answer = np.einsum("lk,kt->lt", harmonics(towards, 6), np.asarray(found.transfer)[:, :, 0])
        below.append(-answer.min())
    assert below[0] > 0.05
    assert below[2] < below[1] < below[0] / 2


def test_description_of_lights() -> None:
    """Order 1 in closed form: the mean is 1 / sqrt(4 pi), the rest sqrt(3 / 4 pi) times y, z and x of where light is from."""
    one, two = suns(np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0]]), np.array([[1.0, 2.0, 0.0], [4.0, 0.0, 8.0]]))
    a, b = 1 / np.sqrt(4 * np.pi), np.sqrt(3 / (4 * np.pi))
    expected = np.outer([a, 0, 0.8 * b, 0.6 * b], [1, 2, 0]) + np.outer([a, -b, 0, 0], [4, 0, 8])
    np.testing.assert_allclose(describe([one + two, ()], 1), [expected, 0 * expected], atol=1e-15)


def test_a_light_that_knows_its_harmonics_tells_them() -> None:
    """What another kind of distant light needs to be taken: one member."""

    class Sky:
        kind = "sky"

        def harmonics(self, order: int) -> np.ndarray:
            return np.arange(3.0 * count(order)).reshape(-1, 3)

    np.testing.assert_array_equal(describe([(Sky(), Sky())], 1)[0], 2 * np.arange(12.0).reshape(4, 3))


def test_lamps_are_refused_in_one_line() -> None:
    lamp = PointLight(position=(0.0, 1.0, 0.0), intensity=(1.0, 1.0, 1.0))
    said = r'^sh-prt: got a light of type point, which stands somewhere; expected distant light, as .*"directional"[^\n]*$'
    with pytest.raises(UserError, match=said):
        describe([suns(spiral(1))[0], (lamp,)], 2)
    with pytest.raises(UserError, match=said):
        ddprt.fit(make_data(*room()), "sh-prt")


def test_gamma_is_refused_and_said_how_to_mend(baked: Dataset) -> None:
    with pytest.raises(UserError, match=re.escape("methods.settings.sh-prt.space: got 'gamma', expected 'linear'; mend it")):
        ddprt.fit(baked, "sh-prt", space="gamma")
    model = ddprt.fit(baked, "sh-prt", space="gamma", settings={"space": "linear"})
    assert model.encoding.space == "linear"


@pytest.fixture(scope="module")
def model(baked: Dataset) -> Model:
    return ddprt.fit(baked, "sh-prt", settings={"order": 2})


def test_predict_asks_for_lights(model: Model, baked: Dataset) -> None:
    test = baked.split("test")[:3]
    values, lightings = baked.values(test, 16, "radiosity"), [baked.lightings[index] for index in test]
    with pytest.raises(UserError, match=r"^lightings: got none, expected what was measured, since sh-prt answers from lights"):
        model.predict(values)
    with pytest.raises(UserError, match=r"^lightings: got 2, expected one for each of 3 frames"):
        model.predict(values, lightings=lightings[:2])
    with pytest.raises(UserError, match=r"^fade: got True for sh-prt"):
        model.predict(values, lightings=lightings, fade=True)
    together = model.predict(values, lightings=lightings)
    # The transfer of described light, whatever the points measured: scaled, rounded thrice and summed over 9 harmonics.
    exact = np.einsum("fkc,ktc->ftc", describe(lightings, 2), np.asarray(model.relighter.transfer, np.float64))
    allowed = 12 * U32 * np.einsum("fkc,ktc->ftc", abs(describe(lightings, 2)), abs(np.asarray(model.relighter.transfer)))
    assert (np.abs(together - np.maximum(exact, 0)) <= allowed).all()
    np.testing.assert_array_equal(
        model.predict(values[0], lightings=lightings[0]), model.predict(values[:1], lightings=lightings[:1])[0]
    )


def test_relight_passes_lights_on(model: Model, baked: Dataset) -> None:
    sun = {"type": "directional", "direction": [0.3, -1.0, 0.2], "irradiance": [1.0, 2.0, 3.0]}
    image = model.relight(sun)
    expected = model.predict(model.measure(sun), lightings=sun)
    np.testing.assert_array_equal(image[model.covered], expected)
    assert expected.any()
    half = model.relight([{**sun, "irradiance": [0.5, 1.0, 1.5]}, {**sun, "irradiance": [0.5, 1.0, 1.5]}])
    np.testing.assert_allclose(half, image, atol=20 * U32 * image.max())


def test_other_suns_compile_nothing(model: Model, baked: Dataset) -> None:
    lit = suns(spiral(5))
    model.relight(lit[0])
    compiled = runtime._relight._cache_size()
    for one in lit:
        model.relight(one)
    model.relight(lit[0] + lit[1] + lit[2])
    assert runtime._relight._cache_size() == compiled


def test_methods_that_ask_for_no_lights_never_look_at_them(baked: Dataset) -> None:
    class Untouchable:
        def __getattribute__(self, name: str) -> Any:
            raise AssertionError(f"{name} was looked at")

    plain = ddprt.fit(baked, bases=4)
    values = baked.values(baked.split("test")[:2], 16, "radiosity")
    expected = plain.predict(values)
    compiled = runtime._relight._cache_size()
    np.testing.assert_array_equal(plain.predict(values, lightings=Untouchable()), expected)
    assert runtime._relight._cache_size() == compiled


def test_scores_are_those_of_its_own_answers(model: Model, baked: Dataset) -> None:
    test = baked.split("test")
    found = evaluate(baked, {"sh-prt": model}, {})
    truth, weight = baked.maps("indirect", test).astype(float), baked.area / baked.area.sum()
    light = np.maximum(
        np.einsum("fkc,ktc->ftc", describe([baked.lightings[i] for i in test], 2), np.asarray(model.relighter.transfer)), 0
    )
    error = np.sqrt(np.einsum("ltc,t->", (light - truth) ** 2, weight) / truth[..., 0].size * len(weight) / 3)
    mean = np.einsum("ltc,t->", truth, weight) / len(truth) / 3
    assert found.metrics["methods"]["sh-prt"]["relative_rmse"] == pytest.approx(error / mean, rel=1e-4)  # of float32 maps


def test_fewer_suns_than_harmonics_is_said() -> None:
    examples = pairs(under(transport(2), 2, spiral(8)), suns(spiral(8)))
    report = fitted(examples, order=2).report
    assert "rank_deficient" in report.remarks
    assert set(report.ranks) == {8}


def test_the_dark_side_counts_as_dark() -> None:
    """Suns that light nothing, as from below a ground, are measured as dark: they teach that there is no light."""
    towards = spiral(200)
    light = np.repeat(np.repeat(np.maximum(towards[:, 1, None, None], 0), TEXELS, 1), 3, 2)
    scale = np.where(light[:, 0] > 0, 1.0, 0.0)
    frame_light = np.where(scale[:, None] > 0, light, 0)
    examples = pairs(light, suns(towards))
    dark = replace(examples, scale=jnp.asarray(scale, jnp.float32), indirect=jnp.asarray(frame_light, jnp.float32))
    found, expected = fitted(dark, order=2, ridge=0.0), fitted(examples, order=2, ridge=0.0)
    np.testing.assert_allclose(np.asarray(found.transfer), np.asarray(expected.transfer), atol=4 * U32)


def test_the_lion_is_closed() -> None:
    """Each edge has as many triangles to one side as to the other, and fronts face out."""
    scene = lion(cells=36)
    corners = welded(scene.positions)[scene.triangles]  # some triangles have corners of their own, for their normals
    sides = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    assert set(np.unique(sides, axis=0, return_counts=True)[1] % 2) == {0}
    a, b, c = np.moveaxis(scene.positions[scene.triangles], 1, 0)
    assert 0.1 < np.einsum("ij,ij->", a, np.cross(b, c)) / 6 < 0.3
    assert scene.notes == ()
    assert len(scene.materials) == 2
