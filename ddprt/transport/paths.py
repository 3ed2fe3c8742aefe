"""Unbiased indirect light of all lightings at once: paths do not know which light is on, so all lightings share them.

Every path is traced once, to its end, and leaves a list of vertices: a place, a normal, the receiver it began at, and the
throughput, so that a light's irradiance E there adds throughput * E to the receiver. Lights come afterwards: each of them is
evaluated at all vertices, block by block, with one shadow ray each. That is the split that other materials keep: whatever
the light that leaves a vertex depends on, the walk records and the shading weighs.

Against `reference`, one lighting at a time: the rays of the paths are paid once; first directions and places are spread evenly;
what a path meets is always lit, since roulette only decides whether it goes on; and light that is too weak to matter is mostly
spared its shadow ray, by roulette again. No step of it is biased. What it cannot do is forget the paths: maps of one call share
their grain, as those of the operator do.
"""

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float32, Float64, Int, Int32
from ddprt.compiled import compiled
from ddprt.lights import Light, Lighting
from ddprt.lights.light import Illumination
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import BLOCK, centred
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.gather import Receivers

_SURVIVAL = 2.0  # times the throughput: chance to go on. Bounces are cheap beside the shadow rays of all lights
_MAX_SURVIVAL = 0.999  # a white closed room would never let a path go; a lower cap has no finite variance above its root
_FAINT = 2.0  # times the mean of a block: weaker light gets a shadow ray in proportion to its strength
_PROBED, _PILOT = 512, 32  # texels, and paths of each in two independent runs, that predict how many are needed
_LEAST, _MOST = 8, 8192  # paths per texel that "auto" may choose


@dataclass(frozen=True, eq=False)
class Vertices:
    """Where paths met a surface, ready for any light; a coordinate after another in memory.

    Attributes:
      place: origins of shadow rays (x, y, z; centred frame, metres) and unit geometric normals.
      throughput: what a receiver gains for each W/m² of light that arrives here, per channel.
      owner: the receiver.
    """

    place: Float32[np.ndarray, "6 n"]
    throughput: Float32[np.ndarray, "3 n"]
    owner: Int32[np.ndarray, " n"]

    @classmethod
    def joined(cls, parts: "Sequence[Vertices]") -> "Vertices":
        """One list of many."""
        columns = zip(*((part.place, part.throughput, part.owner) for part in parts), strict=True)
        return cls(*(np.concatenate(column, axis=-1) for column in columns))

    def blocks(self) -> "Iterator[Vertices]":
        """Parts of about equal size that fit into a core's cache."""
        edges = np.linspace(0, len(self.owner), -(-len(self.owner) // BLOCK) + 1).astype(int)
        for low, high in pairwise(edges):
            part = slice(low, high)
            place, throughput = (np.ascontiguousarray(values[:, part]) for values in (self.place, self.throughput))
            yield Vertices(place, throughput, self.owner[part])


def trace_paths(
    tracer: Tracer,
    scene: Scene,
    atlas: Atlas,
    lightings: Sequence[Lighting],
    out: Float32[np.ndarray, "lightings texels 3"],
    *,
    samples: int,
    seed: int,
    stream: str,
    bounces: int = -1,
    skip: int = 0,
    texels: Int[np.ndarray, " chosen"] | None = None,
) -> Iterator[int]:
    """Mean indirect irradiance of texels for every lighting, tile by tile.

    Equal seeds and streams give equal bits, whatever the number of threads and whatever else is in the batch.

    Args:
      tracer, scene, atlas: the geometry, its albedo, and the receivers.
      lightings: world space.
      out: written in place, W/m²; may lie on disk.
      samples: paths per texel.
      seed, stream: address of the random numbers; another stream gives independent noise.
      bounces: -1 follows every path to its end by roulette; otherwise at most this many, at least 1.
      skip: tiles that `out` holds already.
      texels: the ones that are wanted; None for all.
    Yields:
      The number of texels of each finished tile, in order, the skipped ones included.
    """
    receivers = Receivers.texels(atlas, samples, seed, f"{stream} paths", texels)
    lamps = [[(light, _shift(light)) for light in centred(tracer, lighting)] for lighting in lightings]
    albedo = _albedo(scene)

    def work(item: tuple[int, slice]) -> int:
        index, tile = item
        if index >= skip:
            address = *stream.encode(), samples, int(receivers.patch[tile.start])
            walk, chance = (seeds.stream(seed, name, *address) for name in ("path walk", "path lights"))
            sums = np.zeros((len(lamps), tile.stop - tile.start, 3))
            for start in _starts(tracer, receivers, tile):
                vertices = _walked(tracer, albedo, start, walk, bounces)
                for part in vertices.blocks():
                    _shade(tracer, lamps, part, chance, sums)
            with np.errstate(over="ignore"):  # what is not finite is refused where light is stored
                out[:, receivers.patch[tile]] = sums / samples
        return tile.stop - tile.start

    yield from tracer.map(work, enumerate(receivers.tiles()))


def choose_samples(
    tracer: Tracer,
    scene: Scene,
    atlas: Atlas,
    lightings: Sequence[Lighting],
    *,
    target: float,
    seed: int,
    stream: str,
    bounces: int = -1,
) -> tuple[int, float]:
    """Paths per texel that a target for the noise takes, measured at a few texels, and the noise to expect.

    Args:
      tracer, scene, atlas, lightings, bounces: see `trace_paths`.
      target: RMSE of all maps over their mean; more than so many thousand paths are never chosen.
      seed, stream: address of the random numbers; independent of those of `trace_paths` with that stream.
    """
    odds = atlas.area / atlas.area.sum()
    drawn = seeds.stream(seed, "path probes", *stream.encode()).choice(atlas.count, _PROBED, p=odds)
    texels, times = np.unique(drawn, return_counts=True)
    runs = []
    for run in range(2):
        out = np.zeros((len(lightings), atlas.count, 3), np.float32)
        address = f"{stream} pilot {run}"
        settings: dict[str, Any] = {"samples": _PILOT, "seed": seed, "stream": address, "bounces": bounces, "texels": texels}
        for _ in trace_paths(tracer, scene, atlas, lightings, out, **settings):
            pass
        runs.append(out[:, texels].astype(np.float64))
    values = 3 * len(lightings) * _PROBED
    mean = float(((runs[0] + runs[1]) / 2).sum((0, 2)) @ times) / values
    if mean == 0:
        return _LEAST, 0.0
    single = _PILOT * float((((runs[0] - runs[1]) / mean) ** 2).sum((0, 2)) @ times) / values / 2
    samples = int(np.clip(8 * np.ceil(single / target**2 / 8), _LEAST, _MOST))
    return samples, float(np.sqrt(single / samples))


Albedo = Callable[[Int32[np.ndarray, " n"], np.ndarray, np.ndarray], Float32[np.ndarray, "n 3"]]
"""Albedo at hits, from triangle (-1 gives anything) and weights of the second and third corner."""

Lamp = tuple[Light, Float32[np.ndarray, "3"]]
"""A light in the centred frame, and where its random numbers start."""

Rays = tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]
"""Origins, directions, and the receiver that each belongs to."""


def _albedo(scene: Scene) -> Albedo:
    """A table where triangles have one colour each, the scene's textures where not."""
    if scene.uv is not None and any(material.texture is not None for material in scene.materials):
        return lambda triangle, u, v: scene.albedo_at(triangle, np.stack([1 - u - v, u, v], 1)).astype(np.float32)
    table = np.array([entry.albedo for entry in scene.materials], np.float32)[scene.material]
    return lambda triangle, u, v: np.take(table, triangle, axis=0, mode="wrap")


def _starts(tracer: Tracer, receivers: Receivers, tile: slice) -> Iterator[Rays]:
    """First rays of a tile's paths, some samples at a time; owners count from the tile's start."""
    pattern, block, turn = receivers.pattern, receivers.block[tile], receivers.turn[tile]
    cosine, sine = turn.T
    step = max(1, BLOCK // len(block))
    for first in range(0, receivers.samples, step):
        chunk = slice(first, first + step)
        u = np.take(pattern.place[chunk], block, axis=1)
        owner = np.tile(np.arange(len(block), dtype=np.int32), len(u))
        positions, triangle = receivers.sampler.sample(np.tile(receivers.patch[tile], len(u)), u.reshape(-1, 2))
        x, y = np.moveaxis(np.take(pattern.disk[chunk], block, axis=1), 2, 0)
        z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
        local = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], 2).reshape(-1, 3)
        frames = tracer.frames[triangle]
        yield lifted(tracer, positions, frames[:, 2]), warp.to_world(local, frames), owner


def _walked(tracer: Tracer, albedo: Albedo, rays: Rays, rng: np.random.Generator, bounces: int) -> Vertices:
    """Follows paths to their ends."""
    origins, directions, owner = rays
    throughput = np.ones((3, len(owner)), np.float32)
    parts = []
    while True:
        triangle, u, v, _ = tracer.first(origins, directions)
        place = np.empty((6, len(owner)), np.float32)
        hits = triangle, u, v, directions, albedo(triangle, u, v)
        count = _arrive(*hits, tracer.normals, tracer.corners, tracer.offset, place, throughput, owner)
        place, throughput, owner = place[:, :count], throughput[:, :count], owner[:count]
        parts.append(Vertices(place, throughput, owner))
        if count == 0 or len(parts) == bounces:
            return Vertices.joined(parts)
        throughput, owner, triangle = throughput.copy(), owner.copy(), triangle[:count]
        numbers = rng.random((count, 3), np.float32)
        origins, directions = np.empty((2, count, 3), np.float32)
        count = _go_on(place, numbers, triangle, tracer.frames, throughput, owner, origins, directions)
        throughput, owner = np.ascontiguousarray(throughput[:, :count]), owner[:count].copy()
        origins, directions = origins[:count], directions[:count]
        if count == 0:
            return Vertices.joined(parts)


def _shade(
    tracer: Tracer,
    lamps: "Sequence[Sequence[Lamp]]",
    vertices: Vertices,
    rng: np.random.Generator,
    sums: Float64[np.ndarray, "lightings receivers 3"],
) -> None:
    """Adds the light that reaches vertices to their receivers, lighting by lighting.

    All lights use the same random numbers, from another start each that follows from where the light stands.
    """
    count = len(vertices.owner)
    numbers = rng.random((3, count), np.float32)
    brightness = vertices.throughput.max(0)
    u = np.empty((2, count), np.float32)
    origins, directions = np.empty((2, count, 3), np.float32)
    reach, weight = np.empty((2, count), np.float32)
    target = np.empty(count, np.uint32)  # unsigned: Numba looks at other indices for negative ones
    sample: Illumination | None = None
    for lighting, total in zip(lamps, sums, strict=True):
        for light, shift in lighting:
            if not light.delta:
                np.add(numbers[:2], shift[:2, None], out=u)
                u -= u >= 1
            sample = light.illuminate(vertices.place[:3].T, u.T, sample, vertices.place[3:].T)
            if not any(sample.colour):
                continue
            there = sample.direction.T, sample.distance, sample.strength
            chance = brightness, numbers[2], shift[2]
            rays = _aim(vertices.place, *there, tracer.offset, *chance, weight, target, origins, directions, reach)
            if rays:
                seen = tracer.unoccluded(origins[:rays], directions[:rays], reach[:rays])
                arriving = seen, target, weight, vertices.throughput, vertices.owner, sample.colour, total
                if sample.tint is None:
                    _collect(*arriving)
                else:
                    import_module("ddprt.transport.tinted").into_receivers(sample.tint.T, *arriving)


def _shift(light: Light) -> Float32[np.ndarray, "3"]:
    """Where a light's random numbers start: a hash of its place."""
    anchor = light.anchor()
    place = 0 if anchor is None else zlib.crc32(anchor.tobytes())
    return np.random.SeedSequence(place).generate_state(3).astype(np.float32) * np.float32(2**-32) % 1


@compiled
def _arrive(
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    directions: np.ndarray,
    albedo: np.ndarray,
    normals: np.ndarray,
    corners: np.ndarray,
    offset: np.float32,
    place: np.ndarray,
    throughput: np.ndarray,
    owner: np.ndarray,
) -> int:
    """Keeps the rays that meet a front that is not black, in order, and multiplies their throughput; returns their number."""
    count = 0
    for ray in range(len(triangle)):
        hit = triangle[ray]
        if hit < 0:
            continue
        facing = np.float32(0)
        for axis in range(3):
            facing += directions[ray, axis] * normals[hit, axis]
        if not facing < 0:
            continue
        brightest = np.float32(0)
        for channel in range(3):
            throughput[channel, count] = throughput[channel, ray] * albedo[ray, channel]
            brightest = max(brightest, throughput[channel, count])
        for axis in range(3):
            a = corners[hit, 0, axis]
            along = u[ray] * (corners[hit, 1, axis] - a) + v[ray] * (corners[hit, 2, axis] - a)
            place[axis, count] = a + along + offset * normals[hit, axis]
            place[3 + axis, count] = normals[hit, axis]
        owner[count], triangle[count] = owner[ray], hit
        count += int(brightest > 0)
    return count


@compiled
def _go_on(
    place: np.ndarray,
    numbers: np.ndarray,
    triangle: np.ndarray,
    frames: np.ndarray,
    throughput: np.ndarray,
    owner: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
) -> int:
    """Plays roulette for each path, keeps the survivors in order and gives them new directions; returns their number."""
    count = 0
    for i in range(len(owner)):
        brightest = max(throughput[0, i], throughput[1, i], throughput[2, i])
        survival = min(np.float32(_SURVIVAL) * brightest, np.float32(_MAX_SURVIVAL))
        if not numbers[i, 2] < survival:
            continue
        radius, turn = np.sqrt(numbers[i, 0]), np.float32(2 * np.pi) * numbers[i, 1]
        x, y, z = radius * np.cos(turn), radius * np.sin(turn), np.sqrt(np.float32(1) - numbers[i, 0])
        frame = frames[triangle[i]]
        for axis in range(3):
            origins[count, axis] = place[axis, i]
            directions[count, axis] = x * frame[0, axis] + y * frame[1, axis] + z * frame[2, axis]
            throughput[axis, count] = throughput[axis, i] / survival
        owner[count] = owner[i]
        count += 1
    return count


@compiled
def _aim(
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

    What is fainter than the mean is chosen as often as its share of it, and weighs the more. Rays stop `short` of the light.
    """
    zero, one = np.float32(0), np.float32(1)
    total = 0.0
    for i in range(len(weight)):
        cosine = place[3, i] * direction[0, i] + place[4, i] * direction[1, i] + place[5, i] * direction[2, i]
        weight[i] = cosine * strength[i] if cosine > zero else zero
    for i in range(len(weight)):
        total += weight[i] * brightness[i]
    threshold = np.float32(_FAINT * total / len(weight))
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
