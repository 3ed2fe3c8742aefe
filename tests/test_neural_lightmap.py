"""The decoded lightmap: it learns maps beyond those it stores, never does worse than its start, and is counted rightly."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_learned import error, examples

from ddprt.methods.method import Examples
from ddprt.methods.neural_lightmap import NeuralLightmap, NeuralMap
from ddprt.methods.svd_ridge import SvdRidge

EPS32 = float(np.finfo(np.float32).eps)
KEY = jax.random.key(0)
WHERE = pytest.mark.parametrize("light", ["last", "everywhere"])


def decoded(seed: int, lightings: int = 48, texels: int = 300) -> Examples:
    """Light of four maps and of four more that are bent from them; whatever is measured, in colours that differ."""
    world = np.random.default_rng(0)
    maps = world.standard_normal((4, texels))
    bent = np.maximum(world.standard_normal((4, 4)) @ maps, 0)
    plain = examples(seed, lightings, texels=texels)
    light = np.einsum("lpc,pk,kt->ltc", plain.frame.values, world.standard_normal((24, 8)), np.concatenate([2 * maps, bent]))
    return replace(plain, indirect=jnp.asarray(light, jnp.float32))


@pytest.fixture(scope="module")
def learned() -> dict[str, NeuralLightmap]:
    """Of four features, eight units wide."""
    return {
        light: NeuralMap(bases=4, coefficients=8, width=8, steps=300, light=light, texels=128).fit(
            decoded(1), decoded(2), key=KEY
        )
        for light in ("last", "everywhere")
    }


@WHERE
def test_maps_are_learned_beyond_those_stored(light: str, learned: dict[str, NeuralLightmap]) -> None:
    """Four features make most of eight maps; the best four maps leave the rest."""
    test = decoded(3)
    base = SvdRidge(bases=4).fit(decoded(1), decoded(2), key=KEY)
    assert error(learned[light], test) < 0.5 * error(base, test)
    history = learned[light].report.loss
    assert history[-1][2] < 0.5 * history[0][2]


def test_light_that_enters_last_adds_up(learned: dict[str, NeuralLightmap]) -> None:
    """In encoded values, that is, which differ from light by a factor per frame and channel."""
    frame = decoded(3).frame
    one, two = (replace(frame, values=frame.values[part]) for part in (slice(0, 24), slice(24, 48)))
    both = replace(frame, values=one.values + two.values)
    gap = {}
    for light, found in learned.items():
        together, apart = found.predict(both), found.predict(one) + found.predict(two)
        gap[light] = float(jnp.max(jnp.abs(together - apart)) / jnp.max(jnp.abs(together)))
        # Coefficients are sums of 24 terms over their size, maps of 4 and 8; each product of sums is rounded thrice.
        rounding = 3 * (24 + 8 + 4) * EPS32 * _growth(found, both)
        assert (gap[light] <= rounding) == (light == "last"), gap
    assert gap["everywhere"] > 1e-3


def _growth(found: NeuralLightmap, frame: Any) -> float:
    """How much larger the largest sum of magnitudes is than the largest result."""
    sizes = replace(found, matrix=jnp.abs(found.matrix), basis=jnp.abs(found.basis), head=jnp.abs(found.head))
    return float(jnp.max(jnp.abs(sizes.predict(frame))) / jnp.max(jnp.abs(found.predict(frame))))


@pytest.mark.parametrize(
    ("light", "channels"),
    [pytest.param("last", "mono", marks=pytest.mark.slow), ("everywhere", "mono"), ("everywhere", "multi")],
)
def test_a_shader_in_loops_gives_the_same_and_does_what_is_counted(light: str, channels: str) -> None:
    """A slow twin in float64, one texel and one multiply-add after the other."""
    train = replace(examples(1, 12, points=5, texels=7), channels=channels)
    found = NeuralMap(bases=2, coefficients=3, width=3, depth=2, steps=30, check_every=30, light=light).fit(
        train, train, key=KEY
    )
    assert jnp.any(found.head != 0)
    one = replace(train.frame, values=train.frame.values[:1])
    expected, done = shader(found, np.asarray(one.values[0], np.float64), light == "last")
    assert 2 * done == found.flops
    assert found.nbytes == 4 * sum(leaf.size for leaf in jax.tree.leaves(found))
    # Sums of up to 15 terms, one after the other through five layers, none of which stretches errors by much.
    np.testing.assert_allclose(found.predict(one)[0], expected, atol=1000 * EPS32 * np.abs(expected).max())


def shader(found: NeuralLightmap, values: np.ndarray, last: bool) -> tuple[np.ndarray, int]:
    """Light of one frame, and how many multiply-adds that took."""
    parts = {name: np.asarray(getattr(found, name), np.float64) for name in ("matrix", "gain", "basis", "turn", "head")}
    layers = [[np.asarray(array, np.float64) for array in pair] for pair in zip(found.weights, found.biases, strict=True)]
    _, groups, _ = parts["matrix"].shape
    out, texels = 3 // groups, parts["basis"].shape[1] * groups // 3
    done = 0

    def dot(a: np.ndarray, b: np.ndarray) -> float:
        nonlocal done
        done += len(a)
        return float(sum(x * y for x, y in zip(a, b, strict=True)))

    gated = lambda x: 0.5 * x * (1 + x / (1 + abs(x)))  # noqa: E731
    hidden = len(layers[-1][1])
    light = np.zeros((texels, groups, out))
    counts, firsts, u = {}, {}, {}
    for g in range(groups):
        z = values[:, g] if groups == 3 else values.reshape(-1)
        u[g] = np.array([dot(row, z) for row in parts["matrix"][:, g]])
        rows = parts["head"] if last else parts["head"][:1]
        told = u[g] if last else np.ones(1)
        counts[g] = np.array([[dot(told, rows[:, h, o]) for o in range(out)] for h in range(hidden)])
        weight, bias = layers[0]
        if not last:
            turn = np.array(
                [[dot(u[g], parts["turn"][:, i, h]) for h in range(weight.shape[1])] for i in range(len(weight) + 1)]
            )
            weight, bias = weight + turn[:-1], bias + turn[-1]
        firsts[g] = weight, bias
    for t in range(texels):
        f = parts["basis"].reshape(-1, texels, out)[:, t].T
        units = None
        for g in range(groups):
            if units is None or not last:
                units = f.reshape(-1)
                for weight, bias in [firsts[g], *layers[1:]]:
                    units = np.array([gated(dot(units, weight[:, h]) + bias[h]) for h in range(weight.shape[1])])
            for o in range(out):
                light[t, g, o] = dot(f[o], parts["gain"] * u[g][: len(parts["gain"])]) + dot(units, counts[g][:, o])
    return light[..., 0] if groups == 3 else light[:, 0], done


def test_what_would_be_worse_than_the_baseline_is_not_kept() -> None:
    """Trained on noise at a high rate it only gets worse: what is left are the baseline's maps, and silent units."""
    train, held = examples(1, 24), examples(2, 48)
    rng = np.random.default_rng(0)
    noise = [
        replace(part, indirect=jnp.asarray(rng.standard_normal(part.indirect.shape), jnp.float32)) for part in (train, held)
    ]
    ridge = {"bases": 4, "ridge": 1.0}
    base = SvdRidge(**ridge).fit(*noise, key=KEY)
    found = NeuralMap(**ridge, learning_rate=0.3, steps=40, check_every=40, width=8).fit(*noise, key=KEY)
    assert not found.head.any()
    np.testing.assert_array_equal(found.basis, base.basis)
    # Coefficients are divided by their size and multiplied by it again.
    light_of = base.predict(held.frame)
    np.testing.assert_allclose(found.predict(held.frame), light_of, atol=64 * EPS32 * float(jnp.max(jnp.abs(light_of))))


def test_no_light_is_black() -> None:
    train = decoded(1)
    dark = replace(train, indirect=0 * train.indirect)
    found = NeuralMap(bases=4).fit(dark, dark, key=KEY)
    assert found.report.status == "no_signal"
    assert not found.predict(train.frame).any()
