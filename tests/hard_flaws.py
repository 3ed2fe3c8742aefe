"""How cases spoil the light of a made-up room, in place: measured (lightings, points, 3), indirect (lightings, texels, 3)."""

from collections.abc import Callable

import numpy as np
from hard_arrays import POINTS, TEXELS, TRAIN
from oracles import U32


def duplicate(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:, 7:] = measured[:, 6:7]


def nearly_duplicate(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:, 9] = measured[:, 8] * np.float32(1 + 2 * U32)


def collinear(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:, 8] = 0.5 * measured[:, 0] + 0.25 * measured[:, 1]
    measured[:, 9] = 0.5 * measured[:, 2] + 2 * measured[:, 3]


def coincident(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:] = measured[:, :1]


def equal_lightings(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:], indirect[:] = measured[:1], indirect[:1]


def nearly_equal_lightings(measured: np.ndarray, indirect: np.ndarray) -> None:
    shift = 1 + 1e-7 * np.random.default_rng(1).random(indirect.shape)
    measured[:], indirect[:] = measured[:1], (indirect[:1] * shift).astype(np.float32)


def some_dark(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[2:5] = indirect[2:5] = 0


def all_dark(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:] = indirect[:] = 0


def one_lit(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[1:TRAIN] = indirect[1:TRAIN] = 0


def nothing_bounces(measured: np.ndarray, indirect: np.ndarray) -> None:
    indirect[:] = 0


def red(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[..., 1:] = indirect[..., 1:] = 0


def primaries(measured: np.ndarray, indirect: np.ndarray) -> None:
    for index in range(len(measured)):
        measured[index, :, np.arange(3) != index % 3] = 0
        indirect[index, :, np.arange(3) != index % 3] = 0


def unseen(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[3:6] = 0
    indirect[3:6] *= 1e3


def barely_seen(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[3] *= np.float32(1e-6)
    measured[4] *= np.float32(1e-12)


def hardly_seen_at_all(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[3] *= np.float32(1e-30)
    indirect[3] *= np.float32(1e10)


def one_bright(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[5] *= 1e6
    indirect[5] *= 1e6


def times(factor: float) -> Callable[[np.ndarray, np.ndarray], None]:
    def change(measured: np.ndarray, indirect: np.ndarray) -> None:
        measured *= np.float32(factor)
        indirect *= np.float32(factor)

    return change


def every_size(measured: np.ndarray, indirect: np.ndarray) -> None:
    size = np.logspace(-30, 30, len(measured)).astype(np.float32)[:, None, None]
    measured *= size
    indirect *= size


def high_dynamic_range(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured *= np.logspace(-6, 6, measured.shape[1]).astype(np.float32)[:, None]
    indirect *= np.logspace(-6, 6, indirect.shape[1]).astype(np.float32)[:, None]


def noisy(measured: np.ndarray, indirect: np.ndarray) -> None:
    indirect[:, 5] = 0
    indirect[:, 6:9] *= -1e-3
    measured[:, 3] = 0
    measured[::2, 4] *= -1e-4


def offset(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured += 1e4
    indirect += 1e4


def single_spike(measured: np.ndarray, indirect: np.ndarray) -> None:
    measured[:] = indirect[:] = 0
    for index in range(len(measured)):
        measured[index, index % POINTS] = 1
        indirect[index, index % TEXELS] = 1
