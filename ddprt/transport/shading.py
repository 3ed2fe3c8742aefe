"""Light that reaches the vertices of paths: one light after another at all of them, a shadow ray where that is worth it."""

import zlib
from collections.abc import Sequence
from importlib import import_module

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.compiled import compiled
from ddprt.lights import Light, Lighting
from ddprt.lights.light import Illumination
from ddprt.transport.direct import centred
from ddprt.transport.embree import Tracer
from ddprt.transport.walk import Meetings

Lamp = tuple[Light, Float32[np.ndarray, "3"]]
"""A light in the centred frame, and where its random numbers start."""


def shade(
    tracer: Tracer,
    lamps: Sequence[Sequence[Lamp]],
    vertices: Meetings,
    rng: np.random.Generator,
    sums: Float64[np.ndarray, "lightings receivers 3"],
) -> None:
    """Adds the light that reaches vertices to their receivers, lighting by lighting.

    All lights use the same random numbers, from another start each that follows from where the light stands.
    """
    count = len(vertices.owner)
    numbers = rng.random((3, count), np.float32)
    u = np.empty((2, count), np.float32)
    origins, directions = np.empty((2, count, 3), np.float32)
    reach, weight = np.empty((2, count), np.float32)
    target = np.empty(count, np.uint32)  # unsigned: Numba looks at other indices for negative ones
    sample: Illumination | None = None
    for lighting, total in zip(lamps, sums, strict=True):
        for light, start in lighting:
            if not light.delta:
                np.add(numbers[:2], start[:2, None], out=u)
                u -= u >= 1
            there = vertices.under(light, start)
            sample = light.illuminate(there.place[:3].T, u.T, sample, there.facing)
            if not any(sample.colour):
                continue
            arriving_from = sample.direction.T, sample.distance, sample.strength
            lit = there.lit_from(sample.direction)
            chance = lit.brightness, numbers[2], start[2]
            rays = _aim(
                lit.faint, lit.place, *arriving_from, tracer.offset, *chance, weight, target, origins, directions, reach
            )
            if rays:
                seen = tracer.unoccluded(origins[:rays], directions[:rays], reach[:rays])
                arriving = seen, target, weight, lit.throughput, lit.owner, sample.colour, total
                if sample.tint is None:
                    _collect(*arriving)
                else:
                    import_module("ddprt.transport.tinted").into_receivers(sample.tint.T, *arriving)


def lamps_of(tracer: Tracer, lightings: Sequence[Lighting]) -> list[list[Lamp]]:
    """The lamps of each lighting (world space), as `shade` takes them."""
    return [[(light, shift(light)) for light in centred(tracer, lighting)] for lighting in lightings]


def shift(light: Light) -> Float32[np.ndarray, "3"]:
    """Where a light's random numbers start: a hash of its place."""
    anchor = light.anchor()
    place = 0 if anchor is None else zlib.crc32(anchor.tobytes())
    return np.random.SeedSequence(place).generate_state(3).astype(np.float32) * np.float32(2**-32) % 1


@compiled
def _aim(
    faint: float,
    place: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
    strength: np.ndarray,
    short: np.float32,
    brightness: np.ndarray,
    numbers: np.ndarray,
    shift: np.float32,
    weight: np.ndarray,
    target: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
) -> int:
    """Weighs each vertex's light by its cosine, and writes a ray for each that is chosen; returns their number.

    What is fainter than `faint` times the mean is chosen as often as its share of that, and weighs the more. Rays stop `short`
    of the light.
    """
    zero, one = np.float32(0), np.float32(1)
    total = 0.0
    for i in range(len(weight)):
        cosine = place[3, i] * direction[0, i] + place[4, i] * direction[1, i] + place[5, i] * direction[2, i]
        weight[i] = cosine * strength[i] if cosine > zero else zero
    for i in range(len(weight)):
        total += weight[i] * brightness[i]
    threshold = np.float32(faint * total / len(weight))
    if not threshold < np.inf:  # too much for float32: infinity goes through, and is refused where light is stored
        threshold = zero
    rays = 0
    for i in range(len(weight)):
        number = numbers[i] + shift
        number = number if number < one else number - one
        there = weight[i] * brightness[i]
        target[rays] = i
        rays += int(number * threshold < there)
        weight[i] = weight[i] if there > threshold else threshold / brightness[i]
    for ray in range(rays):
        i = target[ray]
        x, y, z = place[0, i], place[1, i], place[2, i]  # all is read before anything is written: a fifth faster
        towards_x, towards_y, towards_z = direction[0, i], direction[1, i], direction[2, i]
        reach[ray] = max(distance[i] - short, zero)
        origins[ray, 0], origins[ray, 1], origins[ray, 2] = x, y, z
        directions[ray, 0], directions[ray, 1], directions[ray, 2] = towards_x, towards_y, towards_z
    return rays


@compiled
def _collect(
    seen: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    throughput: np.ndarray,
    owner: np.ndarray,
    colour: np.ndarray,
    total: np.ndarray,
) -> None:
    """Adds the light of vertices that are not in shadow to their receivers."""
    red, green, blue = colour[0], colour[1], colour[2]
    for ray in range(len(seen)):
        if seen[ray]:
            i = target[ray]
            light, receiver = weight[i], owner[i]
            total[receiver, 0] += light * throughput[0, i] * red
            total[receiver, 1] += light * throughput[1, i] * green
            total[receiver, 2] += light * throughput[2, i] * blue
