"""Gathering light that has a colour of its own at every point, as a sky's has; imported when a lighting really has such.

Twins of the last step of `direct` and of `paths`, where light of one colour is multiplied by it once for many points.
"""

import numpy as np

from ddprt.compiled import compiled


@compiled
def into_groups(
    tint: np.ndarray,
    seen: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    colour: np.ndarray,
    samples: int,
    first: int,
    total: np.ndarray,
) -> None:
    """Darkens the points in shadow, and adds each group's sum of light times a colour."""
    for ray in range(len(seen)):
        weight[target[ray]] = weight[target[ray]] if seen[ray] else np.float32(0)
    red, green, blue = np.float32(colour[0]), np.float32(colour[1]), np.float32(colour[2])
    start = 0
    for group in range(first, min(first + len(weight) // samples, len(total))):
        light = np.float32(0), np.float32(0), np.float32(0)
        for i in range(start, start + samples):
            light = light[0] + weight[i] * tint[0, i], light[1] + weight[i] * tint[1, i], light[2] + weight[i] * tint[2, i]
        start += samples
        total[group, 0] += light[0] * red
        total[group, 1] += light[1] * green
        total[group, 2] += light[2] * blue


@compiled
def into_receivers(
    tint: np.ndarray,
    seen: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    throughput: np.ndarray,
    owner: np.ndarray,
    colour: np.ndarray,
    total: np.ndarray,
) -> None:
    """Adds the light of vertices that are not in shadow to their receivers."""
    for ray in range(len(seen)):
        if seen[ray]:
            i = target[ray]
            for channel in range(3):
                light = weight[i] * throughput[channel, i] * tint[channel, i]
                total[owner[i], channel] += light * colour[channel]
