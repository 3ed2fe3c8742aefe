"""A model of every kind of Relighter, of random numbers: nothing is baked and nothing is trained."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ddprt.export.golden import texture_maps
from ddprt.fitting.encoding import Encoding
from ddprt.methods.floors import MeanMap, NearestMaps
from ddprt.methods.light_network import LightNetwork
from ddprt.methods.mlp import Perceptron
from ddprt.methods.neural_lightmap import NeuralLightmap
from ddprt.methods.point_set import SetEncoder
from ddprt.methods.residual import Corrected
from ddprt.methods.sh_prt import HarmonicTransfer
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.sampling.points import Samples

POINTS, BASES, WIDTH, LATENT, NUMBERS = 7, 6, 5, 4, 9
SHAPE = 12, 10  # of the atlas: two charts with a gap

Draw = Callable[..., Any]


def covered() -> np.ndarray:
    found = np.zeros(SHAPE, bool)
    found[1:11, 1:4] = found[1:11, 6:9] = True
    return found


TEXELS = int(covered().sum())


def relighters(seed: int, groups: int) -> dict[str, Any]:
    """One of each kind, and of some with a network of more layers, or one that turns."""
    world = np.random.default_rng(seed)
    draw: Draw = lambda *shape: jnp.asarray(world.standard_normal(shape) / np.sqrt(max(shape[:1], default=1)), jnp.float32)  # noqa: E731
    out, inputs, entries = 3 // groups, POINTS * (3 // groups), TEXELS * (3 // groups)
    basis = lambda: draw(BASES, entries)  # noqa: E731
    spread = jnp.abs(draw(BASES)) + 0.1

    def layers(*sizes: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        pairs = list(pairwise(sizes))
        return tuple(draw(*pair) for pair in pairs), tuple(draw(pair[1]) for pair in pairs)

    def decoder(*hidden: int, turned: bool, features: int = BASES) -> NeuralLightmap:
        numbers, first = (features, features * out) if turned else (NUMBERS, features * out)
        turn = draw(numbers if turned else 0, first + 1, hidden[0])
        head = draw(1 if turned else numbers, hidden[-1], out)
        gain = jnp.abs(draw(features)) + 0.1
        return NeuralLightmap(draw(numbers, groups, inputs), gain, draw(features, entries), *layers(first, *hidden), turn, head)

    seen = jnp.abs(draw(4, POINTS, 3)).at[2, :, 1].set(0)
    features = 20
    return {
        "linear": LinearTransfer(
            draw(groups, BASES, inputs), draw(groups, inputs), draw(groups, BASES), basis(), draw(entries)
        ),
        "plain": LinearTransfer(
            draw(groups, BASES, inputs), jnp.zeros((groups, inputs)), jnp.zeros((groups, BASES)), basis(), jnp.zeros(entries)
        ),
        "perceptron": Perceptron(*layers(groups + inputs, WIDTH, WIDTH, BASES), basis(), spread, groups),
        "corrected": Corrected(
            draw(groups, BASES, inputs), basis(), *layers(groups + inputs, WIDTH, BASES), spread, jnp.float32(0.7)
        ),
        "set": SetEncoder(
            draw(groups, BASES, inputs),
            basis(),
            *(jnp.asarray(part, jnp.float32) for part in places()),
            draw(POINTS, out, LATENT),
            jnp.float32(0.1),
            *layers(groups + LATENT, WIDTH, BASES),
            spread,
            jnp.asarray([0.6, 0.9], jnp.float32),
        ),
        "harmonics": HarmonicTransfer(draw(NUMBERS, TEXELS, 3), 2),
        "cosines": LightNetwork(
            draw(11, features), draw(features), draw(3, features, BASES), basis(), draw(3), jnp.float32(2.5), groups
        ),
        "decoder": decoder(WIDTH, turned=False),
        "deep decoder": decoder(WIDTH, 3, turned=False),
        "turned decoder": decoder(WIDTH, turned=True),
        "deep turned decoder": decoder(WIDTH, 9, turned=True),
        "mean": MeanMap(draw(TEXELS, 3)),
        "nearest": NearestMaps(seen, draw(4, TEXELS, 3)),
    }


def places() -> tuple[np.ndarray, np.ndarray]:
    """Of the points; two of them at one place."""
    world = np.random.default_rng(5)
    position, normal = world.random((2, POINTS, 3))
    position[4], normal[4] = position[1], normal[1]
    return position, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def model_of(relighter: Any, channels: str = "mono", space: str = "linear", **more: Any) -> Model:
    """Around it the least that a model needs: two triangles that share an edge, cut there on the atlas."""
    corners = np.array([[[0, 0, 0], [0, 1, 0], [1, 0, 0]], [[1, 1, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
    uv = (corners[..., :2] * [3, 10] + np.array([[[1, 1]], [[6, 1]]])) / [SHAPE[1], SHAPE[0]]
    samples = Samples(*places(), np.full((POINTS, 3), 0.5), 0.3)
    encoding = Encoding(space, 2.2, channels)  # type: ignore[arg-type]
    area = np.full(TEXELS, 1e-2)
    scene = {"name": "made up", "digest": "0"}
    return Model(
        "made-up",
        relighter,
        encoding,
        samples,
        POINTS,
        "radiosity",
        covered(),
        area,
        corners,
        scene,
        uv.astype(np.float32),
        **more,
    )


_MAPS = {HarmonicTransfer: "transfer", MeanMap: "mean", NearestMaps: "maps"}  # all others call them basis


def as_exported(model: Model, folder: Path, manifest: dict[str, Any]) -> Model:
    """The same model with the maps that its textures hold, rounded and stitched as they are."""
    held = texture_maps(manifest, folder)[:, model.covered]
    held = held * np.asarray(manifest["basis_scale"], np.float32)[:, None, None]
    name = _MAPS.get(type(model.relighter), "basis")
    old = getattr(model.relighter, name)
    changes = {name: jnp.asarray(held.reshape(old.shape), jnp.float32)}
    if isinstance(model.relighter, LinearTransfer) and manifest["mean"]:
        from ddprt.scene.exr import read_exr

        changes["mean"] = jnp.asarray(read_exr(folder / "mean.exr")[0][model.covered].reshape(-1))
    return replace(model, relighter=replace(model.relighter, **changes))
