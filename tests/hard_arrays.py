"""Hard cases that are arrays alone: made-up datasets in memory, and how a case runs on one, with no scene to bake.

Most such cases fit their dataset through `ddprt.fit` and judge every layer on its own (`hard_judges.py`).
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from hard_cases import Outcome
from hard_judges import judge

import ddprt
from ddprt.dataset import store
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.runtime.model import Model
from ddprt.sampling.points import Samples

TRAIN, VALIDATION, TEST = 12, 3, 4
POINTS, TEXELS, BASES = 10, 23, 6
LAMP = {"type": "point", "position": [0.0, 1.0, 0.0], "intensity": [1.0, 1.0, 1.0]}
WITHIN = "every layer is within its bound"


@dataclass(frozen=True, eq=False)
class Arrays(Dataset):
    """A dataset whose light was never on a disk."""

    measured_light: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    indirect_light: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))

    def values(self, indices: Any, points: int, quantity: str) -> np.ndarray:
        return self.measured_light[list(indices), :points]

    def maps(self, kind: str, indices: Any) -> np.ndarray:
        return self.indirect_light[list(indices)]


def make_data(measured: np.ndarray, indirect: np.ndarray, area: np.ndarray | None = None, train: int | None = None) -> Arrays:
    """Columns of light as a dataset; what is not for training is shared out between validation and test."""
    count, points = measured.shape[:2]
    train = count - VALIDATION - TEST if train is None else train
    splits = ["train"] * train + ["validation"] * VALIDATION + ["test"] * TEST
    description = {
        "schema": store.SCHEMA,
        "scene": {"name": "arrays", "digest": "0"},
        "atlas": {"resolution": indirect.shape[1]},
        "points": {"count": points},
        "lightings": [{"split": split, "lights": [LAMP]} for split in splits[:count]],
    }
    data = Arrays(Path(), description, None, measured.astype(np.float32), indirect.astype(np.float32))
    texels = indirect.shape[1]
    area = np.linspace(1, 2, texels) if area is None else area
    places = np.linspace(0, 1, 3 * points).reshape(points, 3)
    data.__dict__["gbuffer"] = {"area": area.astype(np.float32)[:, None], "albedo": np.full((texels, 3), 0.5, np.float32)}
    data.__dict__["covered"] = np.ones((1, texels), bool)
    data.__dict__["samples"] = Samples(places, np.tile([0.0, 1.0, 0.0], (points, 1)), np.ones((points, 3)), 0.1)
    data.__dict__["occluders"] = np.zeros((1, 3, 3))
    data.__dict__["uv"] = None
    data.__dict__["holes"] = None
    return data


def room(
    rank: int = 8,
    *,
    train: int = TRAIN,
    points: int = POINTS,
    texels: int = TEXELS,
    seed: int = 0,
    spread: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Measured and indirect light of a made-up room: positive, of so many independent directions, one transport for all."""
    rng = np.random.default_rng(seed)
    count = train + VALIDATION + TEST
    lamps = rng.random((count, rank, 3)) * np.reshape(1.0 if spread is None else spread, (-1, 1))
    measured = np.einsum("lrc,rp->lpc", lamps, rng.random((rank, points)))
    indirect = np.einsum("lrc,rt->ltc", lamps, rng.random((rank, texels)))
    return measured.astype(np.float32), indirect.astype(np.float32)


def changed(change: Callable[[np.ndarray, np.ndarray], None], rank: int = 8, **sizes: Any) -> Callable[[], tuple]:
    """A room whose light a case spoils in place."""

    def make() -> tuple[np.ndarray, np.ndarray]:
        measured, indirect = room(rank, **sizes)
        change(measured, indirect)
        return measured, indirect

    return make


def predicts_lawfully(model: Model, values: np.ndarray) -> float:
    """0 if twice the light gives exactly twice the result, black gives black and a saved model answers alike, else inf."""
    light = model.predict(values)
    with tempfile.TemporaryDirectory() as folder:
        model.save(folder)
        same = (ddprt.load_model(folder).predict(values) == light).all()
    # A power of two changes no digit, as long as neither end of float32 is near.
    double = (model.predict(2 * values) == 2 * light).all() or np.abs(values).max() > 1e37 or np.abs(values).max() < 1e-36
    return 0.0 if same and double and (model.predict(0 * values) == 0).all() else np.inf


def refusal(error: UserError, says: str = "") -> Outcome:
    """A refusal is right if one is asked for, and it is one clear line with what it says; of nothing else is it an answer."""
    line = str(error)
    return Outcome(0.0 if says and says in line and "got" in line and "\n" not in line else np.inf, "refused")


def relit(
    make: Callable[[], tuple[np.ndarray, np.ndarray]],
    probes: np.ndarray | None = None,
    area: np.ndarray | None = None,
    method: str = "svd-ridge",
    says: str = "",
    **options: Any,
) -> Callable[[], Outcome]:
    """A case: fit the columns, keep the laws of every method, and judge a linear one layer by layer.

    Where it must be refused, `says` is a piece of the line to look for.
    """

    def run() -> Outcome:
        measured, indirect = make()
        data = make_data(measured, indirect, area)
        asked = data.measured_light[-TEST:] if probes is None else probes.astype(np.float32)
        try:
            model = ddprt.fit(data, method, **{"bases": BASES, **options})
        except UserError as error:
            return refusal(error, says)
        light = model.predict(asked)
        worst = predicts_lawfully(model, asked)
        if method == "svd-ridge":
            worst = max(worst, judge(data, model, asked))
        return Outcome(worst, model.relighter.report.status, bool(np.isfinite(light).all()))

    return run
