"""Weights of lobes for one light after another: `ddprt.transport.ggx.evaluate` in single precision, without temporaries.

What does not depend on where light comes from is made once for all lights, so a glossy vertex costs little more than a
diffuse one.
"""

from functools import lru_cache

import numpy as np

from ddprt.axes import Float, Float32
from ddprt.compiled import compiled
from ddprt.transport.ggx import SMOOTHEST, between, between_means, root, tables

Directions = Float[np.ndarray, "n 3"]


def prepared(outgoing: Directions, base: Directions, gloss: Directions) -> Float32[np.ndarray, "n 11"]:
    """What of `evaluate` is the same wherever light comes from, for `weigh`."""
    held = np.empty((len(outgoing), 11), np.float32)
    _prepare(outgoing, base, gloss, *tables(), held)
    return held


def weigh(
    held: Float32[np.ndarray, "n 11"],
    frames: Float32[np.ndarray, "n 3 3"],
    outgoing: Float32[np.ndarray, "n 3"],
    directions: Float32[np.ndarray, "n 3"],
    throughput: Float32[np.ndarray, "3 n"],
) -> Float32[np.ndarray, "3 n"]:
    """Throughput times pi times the BSDF, for light from world directions: `evaluate` in single precision, many times over.

    Args:
      held: see `prepared`.
      frames: rows tangent, bitangent, normal.
      outgoing: unit, in these frames.
      directions: unit, world.
      throughput: per channel.
    """
    weighed = np.empty(throughput.shape, np.float32)
    _weigh(held, frames, outgoing, directions, throughput, _single_table(), weighed)
    return weighed


@lru_cache(maxsize=1)
def _single_table() -> Float32[np.ndarray, "rough tilt 2"]:
    return tables()[0].astype(np.float32)


@compiled
def _prepare(
    outgoing: np.ndarray, base: np.ndarray, gloss: np.ndarray, table: np.ndarray, means: np.ndarray, held: np.ndarray
) -> None:
    """alpha², Smith's root, f0 and the diffuse part's factor of each channel; then where the table is read."""
    for i in range(len(held)):
        roughness, metallic, dielectric = max(float(gloss[i, 0]), SMOOTHEST), float(gloss[i, 1]), float(gloss[i, 2])
        alpha, out = roughness * roughness, float(outgoing[i, 2])
        held[i, 0], held[i, 1] = alpha * alpha, root(alpha, out)
        left = (1 - between(table, roughness, out, dielectric)) / (1 - between_means(means, roughness, dielectric))
        for channel in range(3):
            held[i, 2 + channel] = dielectric + metallic * (base[i, channel] - dielectric)
            held[i, 5 + channel] = base[i, channel] * (1 - metallic) * left
        row = np.sqrt((roughness - SMOOTHEST) / (1 - SMOOTHEST)) * (table.shape[0] - 1)
        held[i, 8], held[i, 9] = min(int(row), table.shape[0] - 2), row - min(int(row), table.shape[0] - 2)
        held[i, 10] = dielectric


@compiled
def _weigh(
    held: np.ndarray,
    frames: np.ndarray,
    outgoing: np.ndarray,
    directions: np.ndarray,
    throughput: np.ndarray,
    table: np.ndarray,
    weighed: np.ndarray,
) -> None:
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    for i in range(len(held)):
        a, b, c = directions[i, 0], directions[i, 1], directions[i, 2]
        under, out = frames[i, 2, 0] * a + frames[i, 2, 1] * b + frames[i, 2, 2] * c, outgoing[i, 2]
        if not (under > zero and out > zero):
            weighed[0, i], weighed[1, i], weighed[2, i] = zero, zero, zero
            continue
        x = outgoing[i, 0] + frames[i, 0, 0] * a + frames[i, 0, 1] * b + frames[i, 0, 2] * c
        y = outgoing[i, 1] + frames[i, 1, 0] * a + frames[i, 1, 1] * b + frames[i, 1, 2] * c
        z, squared, hides = out + under, held[i, 0], held[i, 1]
        flat = x * x + y * y
        size = flat + z * z
        slope = (flat / squared + z * z) / size
        hidden = out * np.sqrt(squared + (one - squared) * under * under) + under * hides
        lobe = half / (squared * slope * slope * hidden)
        short = max(zero, one - half * np.sqrt(size))
        grazing = short * short * short * short * short
        mirrored, grazing = (one - grazing) * lobe, grazing * lobe
        diffuse = zero
        if held[i, 5] + held[i, 6] + held[i, 7] > zero:
            column = np.sqrt(np.sqrt(under)) * np.float32(table.shape[1] - 1)
            r, s = int(held[i, 8]), min(int(column), table.shape[1] - 2)
            down, right, f0 = held[i, 9], column - np.float32(s), held[i, 10]
            above = f0 * table[r, s, 0] + table[r, s, 1]
            above += right * (f0 * table[r, s + 1, 0] + table[r, s + 1, 1] - above)
            below = f0 * table[r + 1, s, 0] + table[r + 1, s, 1]
            below += right * (f0 * table[r + 1, s + 1, 0] + table[r + 1, s + 1, 1] - below)
            diffuse = one - above - down * (below - above)
        for channel in range(3):
            value = held[i, 2 + channel] * mirrored + grazing + held[i, 5 + channel] * diffuse
            weighed[channel, i] = throughput[channel, i] * value
