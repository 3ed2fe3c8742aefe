"""What training and the lightings it is asked for do not share: units, points that see, noise; and lightings nearly twice."""

from collections.abc import Callable
from functools import partial

import numpy as np
from hard_arrays import BASES, TEST, TRAIN, VALIDATION, WITHIN, changed, make_data, relit, room
from hard_cases import HardCase, Outcome
from hard_judges import judge

import ddprt

FRESH = 40  # lightings that judge what a ridge was worth: their mean error is good to a sixth


def _other_units(factor: float) -> Callable[[np.ndarray, np.ndarray], None]:
    """Indirect light of validation and test in other units than their measurements and all of training."""

    def change(measured: np.ndarray, indirect: np.ndarray) -> None:
        measured[TRAIN:] /= np.float32(factor)

    return change


def _unseen(rows: slice) -> Callable[[np.ndarray, np.ndarray], None]:
    def change(measured: np.ndarray, indirect: np.ndarray) -> None:
        measured[rows] = 0

    return change


def _near_twins(gap: float, noise: float, seed: int) -> Outcome:
    """Every lamp twice, `gap` of its size apart, with the same noise in both maps: a twin left in predicts that noise.

    Relit light of fresh lamps, noise-free, may be twice as far off as where twins were merged by hand.
    """
    rng = np.random.default_rng(seed + 3)
    measured, indirect = room(12, train=TRAIN + FRESH, points=24, seed=seed)
    lamps, fresh, rest = slice(TRAIN), slice(TRAIN, TRAIN + FRESH), slice(TRAIN + FRESH, None)
    noisy = indirect[lamps] * (1 + noise * rng.normal(size=indirect[lamps].shape)).astype(np.float32)
    beside = measured[lamps] * (1 + gap * rng.normal(size=measured[lamps].shape)).astype(np.float32)
    errors, statuses, layers = [], [], 0.0
    for rows, light in (
        ([measured[lamps], beside, measured[rest]], [noisy, noisy, indirect[rest]]),
        ([(measured[lamps] + beside) / 2, measured[rest]], [noisy, indirect[rest]]),
    ):
        data = make_data(np.concatenate(rows), np.concatenate(light))
        model = ddprt.fit(data, bases=BASES)
        layers = max(layers, judge(data, model))
        error = model.predict(measured[fresh], clamp=False) - indirect[fresh]
        errors.append(float(np.linalg.norm(error)))
        statuses.append(model.relighter.report.status)
    return Outcome(max(layers, errors[0] / (2 * errors[1])), statuses[0], bool(np.isfinite(errors).all()))


CASES: tuple[HardCase, ...] = (
    *(
        HardCase(
            f"lightings of validation and test in units {factor:g} times as large",
            "scaled light has no units, so that nothing but the error can tell",
            WITHIN + ", and a status that warns",
            relit(changed(_other_units(factor))),
            frozenset({"worse_than_mean"}),
        )
        for factor in (1e-25, 1e-3, 1e3, 1e25)
    ),
    HardCase(
        "validation lightings no point sees",
        "they are bright, and their measurement is 0",
        "blind, and " + WITHIN,
        relit(changed(_unseen(slice(TRAIN, TRAIN + VALIDATION)))),
        frozenset({"blind"}),
    ),
    HardCase(
        "test lightings no point sees",
        "nothing in training or validation tells of them",
        "black, and a status that knows nothing of it",
        relit(changed(_unseen(slice(-TEST, None)))),
    ),
    *(
        HardCase(
            f"near twins, {gap:g} of their size apart",
            "a twin left in predicts the noise it shares, and the ridge goes to 0",
            "fresh lamps no worse than twice those of twins merged by hand",
            partial(_near_twins, gap, 0.05, 0),
        )
        for gap in (1e-5, 1e-4, 1e-3)
    ),
)
