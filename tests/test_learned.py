"""Learned methods: what each is known to find, or to keep."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import subspace_angles

from ddprt.fitting import basis as bases
from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.lights import DirectionalLight
from ddprt.methods import METHODS, learned
from ddprt.methods.learned import Learned, Seen
from ddprt.methods.method import Examples, Frame, columns, grouped
from ddprt.methods.residual import Residual
from ddprt.methods.svd_ridge import SvdRidge
from ddprt.runtime import train
from ddprt.training import loop

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


SLOW_STARTS = [pytest.param(*way, marks=pytest.mark.slow) for way in ((8, 1), (8, 2), (11, 0), (11, 1))]


@pytest.mark.parametrize(("bases", "seed"), [(8, 0), *SLOW_STARTS])
def test_an_autoencoder_finds_the_subspace_of_the_svd(bases: int, seed: int) -> None:
    """Within 1 degree from any start, also where the last vectors count for little; the same light, orthonormal vectors."""
    train, held = examples(1), examples(2, 12)
    svd = SvdRidge(bases=bases).fit(train, held, key=KEY)
    learned = METHODS["autoencoder"](bases=bases).fit(train, held, key=jax.random.key(seed))  # type: ignore[call-arg]
    assert angle(svd, learned, train) < 1
    weights = np.asarray(entry_weights(train.area, train.weights, train.channels), np.float64)
    U = np.asarray(learned.basis, np.float64)
    np.testing.assert_allclose((U * weights) @ U.T, np.eye(bases), atol=100 * EPS32)
    # Coefficients turn with the basis, and leaving one out knows no basis: only the ridge may differ by the rest of the angle.
    np.testing.assert_allclose(error(learned, held), error(svd, held), rtol=0.01)
    singular = np.array(svd.report.singular_values[:bases])
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


@pytest.mark.slow
def test_a_gate_is_the_best_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors at a little more and a little less are no smaller on the validation lightings."""
    train, held = examples(1, 200, bend=0.5), examples(2, 60, bend=0.5)
    found = Residual(bases=12, steps=600).fit(train, held, key=KEY)
    gate = float(found.gate)
    assert 0 < gate < 1
    errors = [error(replace(found, gate=jnp.asarray(gate + step, jnp.float32)), held) for step in (-0.05, 0.0, 0.05)]
    assert errors[1] <= min(errors) * (1 + 1e-5)


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if issubclass(method, Learned)])
def test_every_learned_method_says_that_it_diverged_and_how(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "_trouble", lambda history: "made up" if history else "")
    few = {"steps": 2, "check_every": 1, "bases": 8, "width": 4}
    method = METHODS[name](**{key: value for key, value in few.items() if key in METHODS[name].model_fields})
    train, held = lit(examples(1)), lit(examples(2, 12))  # as in other tests, so that not all compiles anew
    report = method.fit(train, held, key=KEY).report
    assert re.fullmatch(
        r"made up; the parameters (it began with|of step 1, with a validation loss of \S+) are kept", report.trouble
    )
    assert "diverged" in report.remarks
    assert [look[0] for look in report.loss] == [1]
    assert np.isfinite(report.loss).all()


def lit(part: Examples) -> Examples:
    """With a sun for each lighting, for methods that look at the lights themselves."""
    suns = [(DirectionalLight(direction=(0.1 * i, -1.0, 0.2), irradiance=(1.0, 1.0, 1.0)),) for i in range(len(part.scale))]
    return replace(part, frame=replace(part.frame, lightings=suns))


class Sliced:
    """Light that comes in blocks of a tile, and never as a whole."""

    def __init__(self, light: np.ndarray) -> None:
        self.light, self.shape = light, light.shape

    def blocks(self) -> Iterator[jax.Array]:
        for start in range(0, self.shape[1], bases._TILE):
            yield jnp.asarray(self.light[:, start : start + bases._TILE])

    def some(self, lightings: slice) -> jax.Array:
        raise AssertionError("whole maps were asked for")

    def runs(self, starts: Sequence[int], texels: int) -> jax.Array:
        raise AssertionError("runs of texels were asked for")


def streamed(part: Examples) -> Examples:
    return replace(part, indirect=Sliced(np.asarray(part.indirect)))


@pytest.mark.parametrize("channels", ["mono", "multi"])
def test_what_networks_learn_from_is_the_same_from_disk(channels: str) -> None:
    """Two tiles and a piece, so that sums over texels are cut."""
    part = replace(examples(1, 12, texels=2 * bases._TILE + 77), channels=channels)
    groups = 3 if channels == "mono" else 1
    entries = jnp.asarray(entry_weights(part.area, part.weights, channels))  # type: ignore[arg-type]
    vectors = fit_basis(columns(part)[0], entries, bases=6).vectors
    held, found = (Seen.of(one, groups, vectors, entries) for one in (part, streamed(part)))
    for name in ("inputs", "importance", "size"):
        np.testing.assert_array_equal(getattr(found, name), getattr(held, name))
    # Sums of n products in float32, in any order and any split, are each off by at most n eps / 2 of their magnitudes' sum.
    light = np.asarray(grouped(part.indirect, groups), np.float64)
    weights, U = np.asarray(entries, np.float64), np.asarray(vectors, np.float64)
    bound = len(entries) * EPS32 * np.einsum("lge,be->lgb", np.abs(light) * weights, np.abs(U))
    exact = np.einsum("lge,be->lgb", light * weights, U)
    for one in (held, found):
        assert (np.abs(np.asarray(one.targets) - exact) <= bound).all()
    assert (np.abs(exact) > 100 * bound).any()


@pytest.mark.parametrize(
    ("name", "channels"),
    [
        ("mlp", "multi"),
        ("residual", "mono"),
        pytest.param("mlp", "mono", marks=pytest.mark.slow),
        pytest.param("residual", "multi", marks=pytest.mark.slow),
    ],
)
def test_a_network_learns_from_light_that_stays_on_disk(name: str, channels: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The basis is the same to the bit, and what is handed to training the same but for rounding."""
    handed: list[tuple[Seen, Seen]] = []
    train_whole = loop.train

    def train(called: str, problem: Any, data: Seen, held: Seen, schedule: Any, key: jax.Array) -> Any:
        handed.append((data, held))
        return train_whole(called, problem, data, held, schedule, key)

    monkeypatch.setattr(learned, "train", train)
    parts = [replace(examples(seed, count, texels=bases._TILE + 77), channels=channels) for seed, count in ((1, 16), (2, 6))]
    method = METHODS[name](bases=4, steps=2, check_every=1, width=4)  # type: ignore[call-arg]
    assert method.streams
    one, other = (method.fit(*given, key=KEY) for given in (parts, [streamed(part) for part in parts]))  # type: ignore[misc]
    np.testing.assert_array_equal(np.asarray(one.basis), np.asarray(other.basis))
    assert one.report.remarks == other.report.remarks
    # As above; by Cauchy and Schwarz the magnitudes' sum is at most the norm of the light, as vectors have length 1. Targets
    # are in units of `size`, and what the residual network takes from them comes from the very same basis, rounded once more.
    for whole, cut, part in zip(*handed, parts, strict=True):
        light = np.asarray(grouped(part.indirect, whole.inputs.shape[1]), np.float64)
        entries = np.asarray(entry_weights(part.area, part.weights, channels), np.float64)  # type: ignore[arg-type]
        norm = np.sqrt(np.einsum("lge,e->lg", light**2, entries))[..., None]
        bound = 2 * len(entries) * EPS32 * (norm / np.asarray(whole.size) + np.abs(np.asarray(whole.targets)))
        assert (np.abs(np.asarray(whole.targets) - np.asarray(cut.targets)) <= bound).all()


def test_trouble_with_a_layer_is_told_by_the_model() -> None:
    """Who looks at the model's report hears of its own trouble first, then of what a layer's training met."""
    bare = METHODS["mean"]().fit(examples(1), examples(2, 12), key=KEY)
    sound, broken = bare.report, diverged(bare, "no number").report
    assert train._with_trouble_of(bare, {"probes": sound}) is bare
    found = train._with_trouble_of(bare, {"probes": sound, "gloss-4": broken}).report
    assert (found.status, found.trouble) == ("diverged", "layer gloss-4: no number")
    both = train._with_trouble_of(diverged(bare, "none either"), {"gloss-4": broken}).report
    assert both.trouble == "none either; layer gloss-4: no number"


def diverged(relighter: Any, trouble: str) -> Any:
    return replace(relighter, report=replace(relighter.report, trouble=trouble).noting("diverged"))
