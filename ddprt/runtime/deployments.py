"""How each kind of Relighter is taken apart: the catalogue behind `ddprt.runtime.deployment`.

Constants are folded where they cost nothing: the gain of a network's inputs into its first layer, the channel's one-hot input
into a bias per channel, gate and spread of what it adds into the rows of the matrix. A network whose gate is shut is left out.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ddprt.errors import UserError
from ddprt.methods.floors import MeanMap, NearestMaps
from ddprt.methods.light_network import LightNetwork, Surroundings
from ddprt.methods.mlp import Perceptron
from ddprt.methods.neural_lightmap import NeuralLightmap
from ddprt.methods.point_set import SetEncoder, attention, reader, squared_distances, strength
from ddprt.methods.residual import Corrected
from ddprt.methods.sh_prt import HarmonicTransfer
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.deployment import Deployment, Describing, Layers, Units
from ddprt.runtime.model import Model

_GATED = "gated(a) = a (1 + a / (1 + |a|)) / 2"
_UNITS = "units: h = z; h = gated(weight_k^T h + bias_k) for k = 0, 1, ...; bias_0 has a row per channel; " + _GATED
_READ = "c = reader z; size = |c|; units: h = c / size, 0 where size is 0; " + _UNITS.split("; ", 1)[1] + "; units = size h"
_UNLIT = "lights are known, so nothing is measured: s = 1"
_EXAMPLE = (4.0, 3.0, 2.0)


def _linear(found: LinearTransfer, model: Model) -> Deployment:
    matrix, offset, intercept, basis, mean = (
        np.asarray(part) for part in (found.matrix, found.offset, found.intercept, found.basis, found.mean)
    )
    rgb = model.encoding.channels == "multi"
    return Deployment("compose", ("z",), matrix, offset, intercept, basis, rgb, mean if mean.any() else None)


def _composed(
    basis: Any, features: Sequence[str], blocks: Sequence[np.ndarray], intercept: np.ndarray | None = None, **rest: Any
) -> Deployment:
    """Blocks of the matrix side by side, (groups, bases, numbers) for each part of the features."""
    matrix = np.concatenate(blocks, 2)
    groups, bases, inputs = matrix.shape
    if bases == 0:
        raise UserError(
            "export: got a model without bases, whose light is black, expected one that has learned; see its status"
        )
    intercept = np.zeros((groups, bases)) if intercept is None else np.broadcast_to(intercept, (groups, bases))
    return Deployment(
        "compose", tuple(features), matrix, np.zeros((groups, inputs)), intercept, np.asarray(basis), groups == 1, **rest
    )


def _network(weights: Sequence[Any], biases: Sequence[Any], groups: int) -> tuple[Layers, np.ndarray, np.ndarray]:
    """Hidden layers of `ddprt.methods.learned.forward`, and its last one apart: (bases, units) and (bases)."""
    layers = [(np.asarray(w, np.float64), np.asarray(b, np.float64)) for w, b in zip(weights, biases, strict=True)]
    inputs = len(layers[0][0]) - groups
    first = layers[0][0][:inputs] * np.sqrt(inputs)
    layers[0] = (first, layers[0][1] + layers[0][0][inputs:])
    return tuple(layers[:-1]), layers[-1][0].T, layers[-1][1]


def _tensors(layers: Layers) -> dict[str, np.ndarray]:
    return {f"{kind}_{k}": part for k, layer in enumerate(layers) for kind, part in zip(("weight", "bias"), layer, strict=True)}


def _per_group(block: np.ndarray, groups: int) -> np.ndarray:
    return np.broadcast_to(block, (groups, *block.shape))


def _perceptron(found: Perceptron, model: Model) -> Deployment:
    if not len(found.basis):
        return _composed(found.basis, ("units",), [np.zeros((found.groups, 0, 0))])
    layers, last, bias = _network(found.weights, found.biases, found.groups)
    spread = np.asarray(found.spread, np.float64)
    block = _per_group(spread[:, None] * last, found.groups)
    return _composed(found.basis, ("units",), [block], spread * bias, tensors=_tensors(layers), words=(_UNITS, "f = units"))


def _corrected(found: Corrected, model: Model) -> Deployment:
    linear, groups = np.asarray(found.matrix, np.float64), len(found.matrix)
    gain = float(found.gate) * np.asarray(found.spread, np.float64)
    if not gain.any():
        return _composed(found.basis, ("z",), [linear])
    layers, last, bias = _network(found.weights, found.biases, groups)
    blocks = [linear, _per_group(gain[:, None] * last, groups)]
    words = (_UNITS, "f = z, then units")
    return _composed(found.basis, ("z", "units"), blocks, gain * bias, tensors=_tensors(layers), words=words)


def _set_encoder(found: SetEncoder, model: Model) -> Deployment:
    """Of all points: attention among them and what is read from them are matrices, whatever the light."""
    groups, F = len(found.matrix), found.features
    position, normal = (
        jnp.asarray(part[: model.points], jnp.float32) for part in (model.samples.position, model.samples.normal)
    )
    apart = squared_distances(found.positions, found.normals, position, normal, found.positions)
    taken = np.asarray(attention(apart), np.float64)
    transfer = np.asarray(found.matrix, np.float64).reshape(*found.matrix.shape[:2], *F.shape[:2])
    linear = np.einsum("gbtc,tp->gbpc", transfer, taken).reshape(*transfer.shape[:2], -1)
    gain = float(found.gates[0]) * np.asarray(found.spread, np.float64)
    if not gain.any():
        return _composed(found.basis, ("z",), [linear])
    seen = jnp.einsum("pt,tcr->pcr", attention(apart.T), F, precision="highest")
    read = np.asarray(reader(seen, found.noise), np.float64) * np.asarray(strength(F), np.float64)[:, None, None]
    layers, last, bias = _network(found.weights, found.biases, groups)
    blocks = [linear, *(_per_group(gain[:, None] * part, groups) for part in (last, bias[:, None]))]
    tensors = {"reader": read.reshape(len(read), -1), **_tensors(layers)}
    words = (_READ, "f = z, then units, then size")
    return _composed(found.basis, ("z", "units", "size"), blocks, tensors=tensors, words=words)


def _harmonics(found: HarmonicTransfer, model: Model) -> Deployment:
    count, texels, _ = found.transfer.shape
    words = (
        _UNLIT,
        "f[c] = harmonics of the light's channel c: L_k = sum over parallel lights of irradiance * Y_k(-direction) + integral "
        "over a sky of radiance Y_k; W/m²",
        f"Y: real harmonics of world axes, orthonormal, k = l² + l + m, l up to {found.order}",
    )
    eye = np.broadcast_to(np.eye(count), (3, count, count))
    zero = np.zeros((3, count))
    maps = np.asarray(found.transfer).reshape(count, texels * 3)
    sun = {"type": "directional", "direction": [0.36, -0.8, 0.48], "irradiance": list(_EXAMPLE)}
    told = lambda lights: {"harmonics": found.describe([lights])[0]}  # noqa: E731
    return Deployment("compose", ("harmonics",), eye, zero, zero, maps, True, words=words, lights=told, example=(sun,))


def _cosines(found: LightNetwork, model: Model) -> Deployment:
    outputs = np.moveaxis(np.asarray(found.outputs, np.float64), 1, 2)  # colours of light, bases, features
    matrix = outputs if found.groups == 3 else np.concatenate(list(outputs), 1)[None]
    gain = np.sqrt(2 / found.frequencies.shape[1])
    words = (
        _UNLIT,
        "each light is a strength per channel and eleven numbers t: (position - centre) / radius, direction (0 if all around), "
        "cosines of inner and outer half-angle (-1 if none), 1 if it is a surface, 1 if it has a place, reach / radius",
        "strength: intensity of point and spot, radiance * area of a surface, pi r² * radiance of a sphere, each over "
        "max(radius, distance from the centre)²; irradiance of parallel light, which has no place; a sky is many",
        "position of a surface: its centre; its direction: mean of normals by area; reach: from there to its farthest point",
        "phi[c] = sum over lights of strength[c] cos(t frequencies + phases); f = phi[c] for channel c (mono), or phi of red, "
        "green and blue one after the other (multi)",
    )
    numbers = {name: np.asarray(getattr(found, name)) for name in ("frequencies", "phases", "centre")}
    tensors = {**numbers, "radius": np.asarray(found.radius).reshape(1)}
    around = Surroundings(np.asarray(found.centre, np.float64), float(found.radius))
    lamp = {"type": "point", "position": around.centre.tolist(), "intensity": list(_EXAMPLE)}

    def told(lights: Sequence[Any]) -> dict[str, np.ndarray]:
        strength, numbers = zip(*(lobe for light in lights for lobe in around.lobes(light)), strict=True)
        return {"strength": np.stack(strength), "told": np.stack(numbers)}

    plain = _composed(found.basis, ("cosines",), [gain * matrix])
    return replace(plain, tensors=tensors, words=words, lights=told, example=(lamp,))


def _neural(found: NeuralLightmap, model: Model) -> Deployment:
    coefficients = np.moveaxis(np.asarray(found.matrix, np.float64), 0, 1)
    gain = np.asarray(found.gain, np.float64)
    linear = coefficients[:, : len(gain)] * gain[:, None]
    layers = tuple(
        (np.asarray(w, np.float64), np.asarray(b, np.float64)) for w, b in zip(found.weights, found.biases, strict=True)
    )
    turn, head = (np.asarray(part, np.float64) for part in (found.turn, found.head))
    units = Units(layers, coefficients, turn, head)
    plain = _composed(found.basis, ("z",), [linear])
    if not head.any():  # the baseline, which training could not better
        return plain
    last = (
        "counts = counts f: what each unit counts; y = sum of u_b B_b + sum of counts_j h_j, h the units of the texel, "
        + _GATED
    )
    bent = (
        "v = coefficients f; first = first + sum of v_k turn_k: the first layer of the texel's units, one for each channel; "
        "y = sum of u_b B_b + head . h, " + _GATED
    )
    words = (bent if units.turned else last, "maps are filtered before units are made of them")
    return replace(plain, shape="decode", words=words, units=units)


def _table(maps: np.ndarray, tensors: dict[str, np.ndarray], words: tuple[str, ...]) -> Deployment:
    count = len(maps)
    nothing = np.zeros((3, count, 0)), np.zeros((3, 0)), np.zeros((3, count))
    return Deployment("table", ("z",), *nothing, maps.reshape(count, -1), True, tensors=tensors, words=words)


def _mean(found: MeanMap, model: Model) -> Deployment:
    return _table(np.asarray(found.mean)[None], {}, ("there is one map",))


def _nearest(found: NearestMaps, model: Model) -> Deployment:
    values = np.moveaxis(np.asarray(found.values, np.float64), 2, 0)  # channels, lightings, points
    size = np.linalg.norm(values, axis=2, keepdims=True)
    tensors = {"seen": values / np.where(size > 0, size, 1), "lit": (size[..., 0] > 0).astype(np.float64)}
    words = (
        "best[c] = the map whose row of seen[c] has the largest product with z of channel c, among those with lit = 1; "
        "for multi, z of a channel is every third number",
    )
    return _table(np.asarray(found.maps), tensors, words)


DEPLOYMENTS: dict[type, Describing] = {
    LinearTransfer: _linear,
    Perceptron: _perceptron,
    Corrected: _corrected,
    SetEncoder: _set_encoder,
    HarmonicTransfer: _harmonics,
    LightNetwork: _cosines,
    NeuralLightmap: _neural,
    MeanMap: _mean,
    NearestMaps: _nearest,
}
"""By kind of Relighter, so that methods which leave the same kind share an entry."""
