"""Peers of a frame: light of a million texels from 16 bases, and the coefficients that it takes.

One frame reads each basis vector once and writes three floats per texel, so it is a matter of memory: "warm" asks for the same
basis again and again, as an engine with one scene does; "cold" goes round so many models that no cache holds what comes next.
Peers get coefficients for nothing and need not cut off negative light; `Model.predict` does all of it. What a work writes to is
its own affair: new arrays of the library's making, or one that was made before.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ddprt import seeds
from ddprt.bench.peers.fit import EPS
from ddprt.bench.peers.standing import OURS, Peer, Row, compare
from ddprt.fitting.encoding import Encoding
from ddprt.methods.svd_ridge import LinearTransfer, compose
from ddprt.runtime.model import Model
from ddprt.sampling.points import Samples

_LOOP = 64  # frames between two looks at the clock, where one takes microseconds


def make_model(texels: int, bases: int, points: int, seed: int) -> Model:
    """A model of random numbers that relights so many texels from so many points; its light is nowhere negative."""
    rng = seeds.stream(seed, "peers model")
    relighter = LinearTransfer(
        jnp.asarray(rng.random((3, bases, points), np.float32)),
        jnp.zeros((3, points)),
        jnp.zeros((3, bases)),
        jnp.asarray(rng.random((bases, texels), np.float32)),
        jnp.zeros(texels),
    )
    places = np.zeros((points, 3))
    samples = Samples(places, places, np.ones((points, 3)), 1.0)
    whole = np.ones((1, texels))
    return Model(
        "svd-ridge", relighter, Encoding(), samples, points, "irradiance", whole > 0, whole[0], np.zeros((0, 3, 3)), {}
    )


class Scenes:
    """Models of one size that take turns, and a frame that each is lit by.

    The turn is everybody's: who comes second would else find in the caches what the first one has just read.

    Args:
      models: a single one stays in the caches if it fits them.
      values: measured light of the frame, W/m².
    """

    def __init__(self, models: list[Model], values: Float[np.ndarray, "points 3"]) -> None:
        self.models, self.values = models, values
        self.coefficients = [model.coefficients(values) for model in models]
        self.bases = [np.asarray(learned(model).basis) for model in models]
        self.bases_count, self.texels = self.bases[0].shape
        self.turn = 0

    def advance(self) -> int:
        """The model whose turn it is."""
        self.turn = (self.turn + 1) % len(self.models)
        return self.turn

    @property
    def moved(self) -> int:
        """Bytes that a frame cannot do without: the basis read, the light written."""
        return 4 * self.texels * (self.bases_count + 3)

    def exact(self) -> np.ndarray:
        """Light of the model whose turn it was, in float64, (texels, 3)."""
        part = learned(self.models[self.turn])
        u = np.einsum("gbp,pg->bg", np.asarray(part.matrix, np.float64), self.values.astype(np.float64))
        return np.maximum(np.asarray(part.basis).T.astype(np.float64) @ u, 0)

    @property
    def blur(self) -> dict[str, float]:
        """Bound on rounding of sums of positive products in float32, one after the other (Higham 2002, 3.1): n EPS."""
        return {"relative RMSE": (self.bases_count + len(self.values)) * EPS}

    def judge(self, light: Any) -> dict[str, float]:
        """Relative RMSE of light that was just made, given by texels or by channels."""
        found, exact = np.asarray(light, np.float64), self.exact()
        found = found if found.shape == exact.shape else found.T
        return {"relative RMSE": float(np.linalg.norm(found - exact) / np.linalg.norm(exact))}


def learned(model: Model) -> LinearTransfer:
    """The relighter of a model that `make_model` made."""
    assert isinstance(model.relighter, LinearTransfer)
    return model.relighter


def make_scenes(texels: int, bases: int, points: int, models: int, seed: int) -> Scenes:
    """So many random models of one size, and a frame."""
    made = [make_model(texels, bases, points, seed + index) for index in range(models)]
    return Scenes(made, seeds.stream(seed, "peers frame").random((points, 3), np.float32))


def relight_rows(scenes: Scenes, *, repeats: int, tell: Callable[[], None] = lambda: None) -> list[Row]:
    """Everyone's frame."""
    return compare(RELIGHT, scenes, repeats=repeats, tell=tell)


def _predict(scenes: Scenes) -> Callable[[], np.ndarray]:
    return lambda: scenes.models[scenes.advance()].predict(scenes.values)


def _compose(scenes: Scenes) -> Callable[[], jax.Array]:
    add = jax.jit(compose)
    parts = [learned(model) for model in scenes.models]
    given = [(jnp.asarray(u[None]), part.basis, part.mean) for u, part in zip(scenes.coefficients, parts, strict=True)]
    return lambda: add(*given[scenes.advance()])[0]


def _numpy(scenes: Scenes) -> Callable[[], np.ndarray]:
    u, B = scenes.coefficients, scenes.bases

    def work() -> np.ndarray:
        i = scenes.advance()
        return u[i] @ B[i]

    return work


def _numpy_into(scenes: Scenes, by_texels: bool) -> Callable[[], np.ndarray]:
    u, B = scenes.coefficients, scenes.bases
    # One output for each model, or a cache would hold it.
    outs = [np.zeros((scenes.texels, 3) if by_texels else (3, scenes.texels), np.float32) for _ in B]

    def work() -> np.ndarray:
        i = scenes.advance()
        return np.matmul(B[i].T, u[i].T, out=outs[i]) if by_texels else np.matmul(u[i], B[i], out=outs[i])

    return work


def _torch(scenes: Scenes, into: bool) -> Callable[[], Any]:
    import torch

    u = [torch.from_numpy(part) for part in scenes.coefficients]
    B = [torch.from_dlpack(part) for part in scenes.bases]
    outs = [torch.zeros((3, scenes.texels)) for _ in B] if into else []

    def work() -> Any:
        i = scenes.advance()
        return torch.matmul(u[i], B[i], out=outs[i]) if into else torch.matmul(u[i], B[i])

    return work


@dataclass(frozen=True, eq=False)
class Frames:
    """Measured light to be turned into coefficients.

    Attributes:
      model: whose.
      values: of many frames, W/m².
      one: the frames come one by one, not all at once.
    """

    model: Model
    values: Float[np.ndarray, "frames points 3"]
    one: bool

    @property
    def matrix(self) -> np.ndarray:
        """(3, bases, points)."""
        return np.asarray(learned(self.model).matrix)

    @cached_property
    def exact(self) -> np.ndarray:
        """Coefficients in float64, (frames, 3, bases)."""
        return np.einsum("gbp,fpg->fgb", self.matrix.astype(np.float64), self.values.astype(np.float64))

    @property
    def flops(self) -> int:
        """Of all frames, two per multiply-add."""
        return 2 * len(self.values) * self.matrix.size

    @property
    def blur(self) -> dict[str, float]:
        """Bound on rounding of sums of positive products in float32, one after the other (Higham 2002, 3.1): n EPS."""
        return {"relative RMSE": self.matrix.shape[2] * EPS}

    def judge(self, coefficients: Any) -> dict[str, float]:
        """Relative RMSE, of the last frame where they come one by one."""
        exact = self.exact[-1] if self.one else self.exact
        found = np.asarray(coefficients, np.float64).reshape(exact.shape)
        return {"relative RMSE": float(np.linalg.norm(found - exact) / np.linalg.norm(exact))}


def make_frames(model: Model, frames: int, seed: int, *, one: bool) -> Frames:
    """Random measured light; one by one, there are 64 frames between two looks at the clock."""
    number = _LOOP if one else frames
    return Frames(model, seeds.stream(seed, "peers frames").random((number, model.points, 3), np.float32), one)


def transfer_rows(frames: Frames, *, repeats: int, tell: Callable[[], None] = lambda: None) -> list[Row]:
    """Everyone's coefficients; seconds are of one frame."""
    return compare(TRANSFER, frames, repeats=repeats, frames=len(frames.values), tell=tell)


def _public(frames: Frames) -> Callable[[], np.ndarray]:
    answer, values = frames.model.coefficients, frames.values

    def one_by_one() -> np.ndarray:
        for frame in values:
            last = answer(frame)
        return last

    return one_by_one if frames.one else lambda: answer(values)


def _product(frames: Frames, multiply: Callable[[Any, Any], Any], wrap: Callable[[np.ndarray], Any]) -> Callable[[], Any]:
    """M x by a batched product, from light laid out as suits it."""
    if frames.one:
        matrix = wrap(frames.matrix.copy())
        columns = [wrap(np.ascontiguousarray(frame.T[:, :, None])) for frame in frames.values]

        def one_by_one() -> Any:
            for frame in columns:
                last = multiply(matrix, frame)
            return last

        return one_by_one
    turned = wrap(np.ascontiguousarray(frames.matrix.swapaxes(1, 2)))
    rows = wrap(np.ascontiguousarray(np.moveaxis(frames.values, 2, 0)))
    return lambda: multiply(rows, turned).swapaxes(0, 1)


def _torch_product(frames: Frames) -> Callable[[], Any]:
    import torch

    return _product(frames, torch.matmul, torch.from_numpy)


RELIGHT = (
    Peer(OURS, _predict, remark="Model.predict: from measured light, with checks, transfer and clamp"),
    Peer("the loop inside", _compose, yardstick=True, remark="compose alone, compiled: no transfer, no clamp"),
    Peer("numpy u @ B", _numpy, remark="channel by channel; no transfer, no clamp"),
    Peer("numpy u @ B, into an array", lambda scenes: _numpy_into(scenes, False), remark="the same"),
    Peer(
        "numpy B.T @ u.T, into an array", lambda scenes: _numpy_into(scenes, True), remark="texel by texel as we do; the same"
    ),
    Peer(
        "torch.matmul", lambda scenes: _torch(scenes, False), needs="torch", remark="channel by channel; no transfer, no clamp"
    ),
    Peer("torch.matmul, into a tensor", lambda scenes: _torch(scenes, True), needs="torch", remark="the same"),
)
TRANSFER = (
    Peer(OURS, _public, remark="Model.coefficients: with checks, and scale and space of the light"),
    Peer(
        "numpy.matmul",
        lambda frames: _product(frames, np.matmul, lambda a: a),
        remark="M x alone, light laid out for it for nothing",
    ),
    Peer("torch.matmul", _torch_product, needs="torch", remark="M x alone, light laid out for it for nothing"),
)
