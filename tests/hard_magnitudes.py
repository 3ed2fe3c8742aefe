"""Light of all sizes and signs: either end of float32, decades in one map, gamma and noise, foreign lightings."""

from collections.abc import Callable

import numpy as np
import oracles
from hard_arrays import ANY, BASES, POINTS, TEST, TEXELS, WITHIN, changed, make_data, refusal, relit, room
from hard_cases import HardCase, Outcome
from hard_flaws import every_size, high_dynamic_range, noisy, offset, one_bright, times
from oracles import U32, over_bound

import ddprt
from ddprt.errors import UserError


def _linear_answers(space: str, factor: float) -> Callable[[], Outcome]:
    """Near either end of float32: the answer is within its bound (at the largest number where it is past it), or refused."""

    def run() -> Outcome:
        measured, indirect = room()
        data = make_data(measured, indirect)
        model = ddprt.fit(data, bases=BASES, ridge=1e-3, space=space)
        probes = (measured[-TEST:].astype(float) * (factor / measured.max())).astype(np.float32)
        try:
            light = model.predict(probes, clamp=False)
        except UserError as error:
            return refusal(error)
        truth, bound = oracles.bound_predict(model.relighter, model.encoding, probes)
        return Outcome(over_bound(light - truth, bound), model.relighter.report.status, bool(np.isfinite(light).all()))

    return run


def _adds_up() -> Outcome:
    """Lights of very different strength: linear uncentred light adds, up to the bounds of its three predictions."""
    measured, indirect = room()
    model = ddprt.fit(make_data(measured, indirect), bases=BASES, channels="multi", ridge=1e-4)
    one, two = measured[-TEST:-2] * np.float32(1e3), measured[-2:] * np.float32(1e-3)
    both = one + two
    light = [np.asarray(model.predict(v, clamp=False), float) for v in (one, two, both)]
    parts = [oracles.bound_predict(model.relighter, model.encoding, v)[1] for v in (one, two, both)]
    rounded = U32 * np.abs(both)  # of the sum that is asked for
    M, U = (np.asarray(part, float) for part in (model.relighter.matrix, model.relighter.basis))
    carried = (np.einsum("bp,fp->fb", np.abs(M[0]), rounded.reshape(2, -1)) @ np.abs(U)).reshape(2, TEXELS, 3)
    return Outcome(over_bound(light[2] - light[0] - light[1], sum(parts) + carried), model.relighter.report.status)


_FOREIGN = np.random.default_rng(9).normal(size=(TEST, POINTS, 3)) * np.logspace(-10, 10, TEST)[:, None, None]
_NOISE = np.where(
    np.random.default_rng(8).random((TEST, POINTS, 3)) < 0.3, 0, np.random.default_rng(7).normal(size=(TEST, POINTS, 3))
)


CASES: tuple[HardCase, ...] = (
    HardCase(
        "one light 1e6 times brighter", "errors in W/m² are those of one lighting", WITHIN, relit(changed(one_bright)), ANY
    ),
    HardCase("intensities 1e-30", "squares underflow float32", WITHIN, relit(changed(times(1e-30))), ANY),
    HardCase("intensities 1e30", "squares overflow float32", WITHIN, relit(changed(times(1e30))), ANY),
    HardCase("intensities 1e-30 to 1e30", "sixty decades in one training set", WITHIN, relit(changed(every_size)), ANY),
    HardCase(
        "subnormal intensities",
        "compiled code may flush 1e-40 to 0",
        "black or right, to the smallest normal number",
        relit(changed(times(1e-40))),
        ANY,
    ),
    HardCase(
        "twelve decades in one map",
        "the faint texels are below rounding of the bright ones",
        WITHIN,
        relit(changed(high_dynamic_range)),
        ANY,
    ),
    HardCase(
        "twelve decades in one map, gamma",
        "the power brings faint texels up",
        WITHIN,
        relit(changed(high_dynamic_range), space="gamma"),
        ANY,
    ),
    HardCase(
        "gamma 1", "the power that is none", WITHIN, relit(changed(noisy), _NOISE, space="gamma", gamma=1.0), ANY, slow=True
    ),
    HardCase(
        "gamma 2.2 with noise",
        "zeros and negative values meet a root",
        WITHIN,
        relit(changed(noisy), _NOISE, space="gamma"),
        ANY,
    ),
    HardCase(
        "gamma 10 with noise",
        "the slope at 0 is steep one way and flat the other",
        WITHIN,
        relit(changed(noisy), _NOISE, space="gamma", gamma=10.0),
        ANY,
        slow=True,
    ),
    HardCase(
        "gamma 10, twelve decades, mean",
        "all of it at once",
        WITHIN,
        relit(changed(high_dynamic_range), space="gamma", gamma=10.0, centre="mean", channels="multi", ridge=1e-6),
        ANY,
        slow=True,
    ),
    HardCase("noise in linear light", "negative and zero measurements", WITHIN, relit(changed(noisy), _NOISE), ANY),
    HardCase("huge common offset", "light differs in the last three digits of float32", WITHIN, relit(changed(offset)), ANY),
    HardCase(
        "huge common offset, mean",
        "centring cancels all but the last three digits",
        WITHIN,
        relit(changed(offset), centre="mean"),
        ANY,
        slow=True,
    ),
    HardCase(
        "a foreign lighting", "signs, sizes and directions that no training lighting had", WITHIN, relit(room, _FOREIGN), ANY
    ),
    HardCase(
        "values near the smallest float32",
        "products underflow",
        "black or right, to the smallest normal number",
        _linear_answers("linear", 1e-37),
        ANY,
    ),
    HardCase(
        "values near the largest float32",
        "norms and products overflow",
        "right and cut at the largest number, or refused",
        _linear_answers("linear", 3.4e38),
        ANY,
    ),
    HardCase(
        "values near the largest float32, gamma",
        "norms and powers overflow",
        "right and cut at the largest number, or refused",
        _linear_answers("gamma", 3.4e38),
        ANY,
        slow=True,
    ),
    HardCase(
        "lights of 1e3 and 1e-3 together",
        "the faint one is below rounding of the sum",
        "they add up within the bounds of three predictions",
        _adds_up,
        ANY,
    ),
)
