"""Light of all sizes and signs: either end of float32, decades in one map, gamma and noise, foreign lightings."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import oracles
from hard_arrays import BASES, POINTS, TEST, TEXELS, WITHIN, changed, make_data, relit, room
from hard_cases import HardCase, Outcome
from hard_flaws import every_size, high_dynamic_range, noisy, offset, one_bright, times
from hard_judges import judge
from oracles import U32, over_bound, rounding

import ddprt
from ddprt.runtime.model import Model


def _linear_answers(space: str, factor: float) -> Callable[[], Outcome]:
    """Near either end of float32: the answer is within its bound (at the largest number where it is past it)."""

    def run() -> Outcome:
        measured, indirect = room()
        data = make_data(measured, indirect)
        model = ddprt.fit(data, bases=BASES, ridge=1e-3, space=space)
        probes = (measured[-TEST:].astype(float) * (factor / measured.max())).astype(np.float32)
        light = model.predict(probes, clamp=False)
        truth, bound = oracles.bound_predict(model.relighter, model.encoding, probes)
        worst = max(over_bound(light - truth, bound), judge(data, model))
        return Outcome(worst, model.relighter.report.status, bool(np.isfinite(light).all()))

    return run


def _adds_up() -> Outcome:
    """Lights of very different strength: linear uncentred light adds, up to the bounds of its three predictions."""
    measured, indirect = room()
    data = make_data(measured, indirect)
    model = ddprt.fit(data, bases=BASES, channels="multi", ridge=1e-4)
    one, two = measured[-TEST:-2] * np.float32(1e3), measured[-2:] * np.float32(1e-3)
    both = one + two
    light = [np.asarray(model.predict(v, clamp=False), float) for v in (one, two, both)]
    parts = [oracles.bound_predict(model.relighter, model.encoding, v)[1] for v in (one, two, both)]
    rounded = U32 * np.abs(both)  # of the sum that is asked for
    M, U = (np.asarray(part, float) for part in (model.relighter.matrix, model.relighter.basis))
    carried = (np.einsum("bp,fp->fb", np.abs(M[0]), rounded.reshape(2, -1)) @ np.abs(U)).reshape(2, TEXELS, 3)
    worst = max(over_bound(light[2] - light[0] - light[1], sum(parts) + carried), judge(data, model))
    return Outcome(worst, model.relighter.report.status)


def _at_the_end(power: int, **options: Any) -> Callable[[], Outcome]:
    """Light times 2^power is answered by 2^power times as much, cut at the largest number, whatever is asked of the answer.

    Both answers round, by e at most in the worst texel (`oracles.bound_predict`). The level that pays for negative light moves
    by as much, and by the (n + 4) u32 of a sum, over the share of the area that pays; its energy is that of the map before.
    Fading from a share of a map to another moves by the error of that share times both, see `_error_of_share`.
    """

    def run() -> Outcome:
        measured, indirect = room()
        data = make_data(measured, 8 * indirect)  # so bright that some of it is past the range at the upper end
        model = ddprt.fit(data, bases=BASES, ridge=1e-3)
        middle = (_UNLIKE * 0.99).astype(np.float32)
        plain, light = (np.asarray(model.predict(part, **options), float) for part in (middle, np.ldexp(middle, power)))
        truth = np.clip(np.ldexp(plain, power), -oracles.LARGEST32, oracles.LARGEST32)
        near, far = (
            oracles.bound_predict(model.relighter, model.encoding, part)[1] for part in (middle, np.ldexp(middle, power))
        )
        error = (np.ldexp(near, power) + far).max(1, keepdims=True)
        peak = np.ldexp(np.abs(np.asarray(model.predict(middle, clamp=False), float)).max(1, keepdims=True), power)
        whole = 0.0
        error += 4 * U32 * peak + 3 * oracles.TINY32
        if options.get("clamp") == "energy":
            share = data.area / data.area.sum()
            clamped, free = (np.asarray(model.predict(middle, clamp=how), float) for how in ("energy", False))
            paying = np.einsum("ltc,t->lc", clamped > 0, share)[:, None]
            kept = np.einsum("ltc,t->lc", clamped, share) - np.maximum(np.einsum("ltc,t->lc", free, share), 0)
            whole = over_bound(kept, (rounding(TEXELS + 4, U32) * np.abs(free) + 2 * near).max(1))
            error = (error + rounding(TEXELS + 4, U32) * peak) * (1 + 1 / np.where(paying > 0, paying, np.inf))
        if options.get("fade"):
            error = error + 2 * _error_of_share(model, middle)[:, None, None] * 2 * peak
        return Outcome(
            max(whole, over_bound(light - truth, error), judge(data, model)),
            model.relighter.report.status,
            bool(np.isfinite(light).all()),
        )

    return run


def _error_of_share(model: Model, values: np.ndarray) -> np.ndarray:
    """How far float32 may move the share of a prediction that fading keeps, for each lighting.

    Novelty is a ratio of sums of squares of at most 2 n terms, each off by what encoding and two sums of n round: 8 (2 n + 9)
    u32 in all. Trust is 1 - novelty^exponent, and the share rises with it.
    """
    yardstick = model.yardstick
    assert yardstick is not None
    score = model.trust(values).score.astype(float)  # type: ignore[union-attr]
    if yardstick.exponent == 0:  # every lighting has no trust at all
        return np.full(len(score), 4 * U32)
    novelty = np.maximum(1 - score, 0) ** (1 / yardstick.exponent)
    moved = rounding(8 * (2 * POINTS + 9), U32)
    ends = (1 - np.clip(novelty + sign * moved, 0, 1) ** yardstick.exponent for sign in (1, -1))
    return np.abs(yardstick.kept(next(ends)) - yardstick.kept(next(ends))) + 4 * U32


_UNLIKE = np.eye(POINTS)[:TEST, :, None] * [1.0, 0.1, 0.01] + 1e-3
"""Lightings that one point sees nearly alone, so that trust in them is low and their maps ring."""
_FOREIGN = np.random.default_rng(9).normal(size=(TEST, POINTS, 3)) * np.logspace(-10, 10, TEST)[:, None, None]
_NOISE = np.where(
    np.random.default_rng(8).random((TEST, POINTS, 3)) < 0.3, 0, np.random.default_rng(7).normal(size=(TEST, POINTS, 3))
)


def _energy_over_areas(factor: float) -> Outcome:
    """Areas have no unit in the energy clamp: times a power of two the same map, but for n roundings of the areas' sum."""
    measured, indirect = room()
    area = np.linspace(1, 2, TEXELS).astype(np.float32)
    probes = (np.eye(10)[:TEST, :, None] + np.full(3, 1e-3)).astype(np.float32)
    plain, other = (
        ddprt.fit(make_data(measured, indirect, part), bases=BASES, ridge=1e-3).predict(probes, clamp="energy").astype(float)
        for part in (area, area * np.float32(factor))
    )
    worst = over_bound(other - plain, rounding(8 * TEXELS, U32) * np.abs(plain).max())
    return Outcome(worst, "ok", bool(np.isfinite(other).all()))


CASES: tuple[HardCase, ...] = (
    *(
        HardCase(
            f"energy clamp over areas of {factor:g}",
            "their sum overflows, or is flushed to 0",
            "as over areas of 1",
            partial(_energy_over_areas, factor),
        )
        for factor in (2.0**125, 2.0**-133)
    ),
    HardCase("one light 1e6 times brighter", "errors in W/m² are those of one lighting", WITHIN, relit(changed(one_bright))),
    HardCase("intensities 1e-30", "squares underflow float32", WITHIN, relit(changed(times(1e-30)))),
    HardCase("intensities 1e30", "squares overflow float32", WITHIN, relit(changed(times(1e30)))),
    HardCase("intensities 1e-30 to 1e30", "sixty decades in one training set", WITHIN, relit(changed(every_size))),
    HardCase(
        "subnormal intensities",
        "compiled code may flush 1e-40 to 0",
        "black or right, to the smallest normal number",
        relit(changed(times(1e-40))),
        frozenset({"no_signal"}),
    ),
    HardCase(
        "twelve decades in one map",
        "the faint texels are below rounding of the bright ones",
        WITHIN,
        relit(changed(high_dynamic_range)),
        frozenset({"worse_than_mean"}),
    ),
    HardCase(
        "twelve decades in one map, gamma",
        "the power brings faint texels up",
        WITHIN,
        relit(changed(high_dynamic_range), space="gamma"),
    ),
    HardCase("gamma 1", "the power that is none", WITHIN, relit(changed(noisy), _NOISE, space="gamma", gamma=1.0), slow=True),
    HardCase(
        "gamma 2.2 with noise",
        "zeros and negative values meet a root",
        WITHIN,
        relit(changed(noisy), _NOISE, space="gamma"),
    ),
    HardCase(
        "gamma 10 with noise",
        "the slope at 0 is steep one way and flat the other",
        WITHIN,
        relit(changed(noisy), _NOISE, space="gamma", gamma=10.0),
        slow=True,
    ),
    HardCase(
        "gamma 10, twelve decades, mean",
        "all of it at once",
        WITHIN,
        relit(changed(high_dynamic_range), space="gamma", gamma=10.0, centre="mean", channels="multi", ridge=1e-6),
        slow=True,
    ),
    HardCase("noise in linear light", "negative and zero measurements", WITHIN, relit(changed(noisy), _NOISE)),
    HardCase(
        "huge common offset",
        "light differs in the last three digits of float32",
        WITHIN,
        relit(changed(offset)),
    ),
    HardCase(
        "huge common offset, mean",
        "centring cancels all but the last three digits",
        WITHIN,
        relit(changed(offset), centre="mean"),
        frozenset({"ok", "overfitted"}),  # lightings differ by 1e-4: those that count as one are left out together
        slow=True,
    ),
    HardCase("a foreign lighting", "signs, sizes and directions that no training lighting had", WITHIN, relit(room, _FOREIGN)),
    HardCase(
        "values near the smallest float32",
        "products underflow",
        "black or right, to the smallest normal number",
        _linear_answers("linear", 1e-37),
    ),
    HardCase(
        "values near the largest float32",
        "norms and products overflow",
        "right, and cut at the largest number",
        _linear_answers("linear", 3.4e38),
    ),
    HardCase(
        "values near the largest float32, gamma",
        "norms and powers overflow",
        "right, and cut at the largest number",
        _linear_answers("gamma", 3.4e38),
        slow=True,
    ),
    HardCase(
        "lights of 1e3 and 1e-3 together",
        "the faint one is below rounding of the sum",
        "they add up within the bounds of three predictions",
        _adds_up,
    ),
    *(
        HardCase(
            f"{what} of float32",
            "levels and shares are made of sums, products and quotients of what is near the end",
            "as in the middle of the range, times a power of two",
            _at_the_end(power, **options),
        )
        for what, power, options in (
            ("energy clamp at the lower end", -122, {"clamp": "energy"}),
            ("energy clamp at the upper end", 128, {"clamp": "energy"}),
            ("fading at the lower end", -122, {"clamp": False, "fade": True}),
            ("energy clamp and fading at the lower end", -122, {"clamp": "energy", "fade": True}),
        )
    ),
)
