"""Paths from receivers to their ends, and what they leave behind: a list of vertices that any light can be evaluated at."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ddprt import warp
from ddprt.axes import Float32, Int32
from ddprt.compiled import compiled
from ddprt.lights import Light
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import BLOCK
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.gather import Receivers

SURVIVAL = 2.0
"""Times the throughput: chance to go on. Bounces are cheap beside the shadow rays of all lights."""

FAINT = 2.0
"""Times the mean of a block: weaker light gets a shadow ray in proportion to its strength."""

MAX_SURVIVAL = 0.999
"""A white closed room would never let a path go; a lower cap has no finite variance above its root."""

Albedo = Callable[[Int32[np.ndarray, " n"], np.ndarray, np.ndarray], Float32[np.ndarray, "n 3"]]
"""Albedo at hits, from triangle (-1 gives anything) and weights of the second and third corner."""

Gloss = Any
"""What `ddprt.transport.gloss.Surfaces` or `ddprt.transport.hair.Hair` is; not imported where there is none."""

Air = Any
"""A `ddprt.transport.fog.Air`, likewise."""

Rays = tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]
"""Origins, directions, and the receiver that each belongs to."""


@dataclass(frozen=True, eq=False)
class Vertices:
    """Where paths met a surface, ready for any light; a coordinate after another in memory.

    Attributes:
      place: origins of shadow rays (x, y, z; centred frame, metres) and unit geometric normals.
      throughput: what a receiver gains for each W/m² of light that arrives here, per channel.
      owner: the receiver.
      faint: see `FAINT`.
    """

    place: Float32[np.ndarray, "6 n"]
    throughput: Float32[np.ndarray, "3 n"]
    owner: Int32[np.ndarray, " n"]
    faint: float = FAINT

    @cached_property
    def brightness(self) -> Float32[np.ndarray, " n"]:
        """Largest throughput of the channels."""
        return self.throughput.max(0)

    @property
    def facing(self) -> Float32[np.ndarray, "n 3"]:
        """The normals."""
        return self.place[3:].T

    def under(self, light: Light, start: Float32[np.ndarray, "3"]) -> "Vertices":
        """Where the light of one lamp is asked for: here, whichever it is."""
        return self

    def lit_from(self, directions: Float32[np.ndarray, "n 3"]) -> "Vertices":
        """What each W/m² that arrives from directions is worth to the receivers: the same from all."""
        return self

    @classmethod
    def joined(cls, parts: "Sequence[Vertices]") -> "Vertices":
        """One list of many."""
        columns = zip(*((part.place, part.throughput, part.owner) for part in parts), strict=True)
        place, throughput, owner = (np.concatenate(column, axis=-1) for column in columns)
        return cls(place, throughput, owner)

    def blocks(self) -> "Iterator[Vertices]":
        """Parts of about equal size that fit into a core's cache."""
        edges = np.linspace(0, len(self.owner), -(-len(self.owner) // BLOCK) + 1).astype(int)
        for low, high in pairwise(edges):
            part = slice(low, high)
            place, throughput = (np.ascontiguousarray(values[:, part]) for values in (self.place, self.throughput))
            yield Vertices(place, throughput, self.owner[part])


@runtime_checkable
class Meetings(Protocol):
    """Vertices on surfaces of one kind: what shading asks of them."""

    @property
    def place(self) -> Float32[np.ndarray, "6 n"]:
        """As in `Vertices`."""
        ...

    @property
    def owner(self) -> Int32[np.ndarray, " n"]:
        """As in `Vertices`."""
        ...

    @property
    def facing(self) -> Float32[np.ndarray, "n 3"] | None:
        """Normals of the half-spaces that light comes from; None where it comes from all sides."""
        ...

    def under(self, light: Light, start: Float32[np.ndarray, "3"]) -> "Meetings":
        """Where the light of one lamp (centred frame) is asked for; its random numbers start there."""
        ...

    def lit_from(self, directions: Float32[np.ndarray, "n 3"]) -> Vertices:
        """What each W/m² that arrives from directions is worth to the receivers, and where its shadow rays start."""
        ...

    def blocks(self) -> "Iterator[Meetings]":
        """Parts of about equal size that fit into a core's cache."""
        ...


def albedo_of(scene: Scene) -> Albedo:
    """A table where triangles have one colour each, the scene's textures and colours of vertices where not."""
    textured = scene.uv is not None and any(material.texture is not None for material in scene.materials)
    if textured or scene.colour is not None:
        return lambda triangle, u, v: scene.albedo_at(triangle, np.stack([1 - u - v, u, v], 1)).astype(np.float32)
    table = np.array([entry.albedo for entry in scene.materials], np.float32)[scene.material]
    return lambda triangle, u, v: np.take(table, triangle, axis=0, mode="wrap")


def starts(tracer: Tracer, receivers: Receivers, tile: slice) -> Iterator[tuple[Rays, Int32[np.ndarray, " n"]]]:
    """First rays of a tile's paths, some samples at a time, and where they start; owners count from the tile's start."""
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
        yield (lifted(tracer, positions, frames[:, 2]), warp.to_world(local, frames), owner), triangle


def walked(
    tracer: Tracer,
    albedo: Albedo,
    rays: Rays,
    rng: np.random.Generator,
    bounces: int,
    gloss: Gloss | None = None,
    throughput: Float32[np.ndarray, "3 n"] | None = None,
    air: Air | None = None,
) -> "list[Meetings]":
    """Follows paths to their ends, and lists what they met: diffuse surfaces, and glossy ones, strands or fog if there are any.

    They begin with a throughput of 1, or with that given, which is overwritten.
    """
    origins, directions, owner = rays
    throughput = np.ones((3, len(owner)), np.float32) if throughput is None else throughput
    parts, shiny, ways, met, flights = list[Vertices](), list[Any](), list[Any](), None, None
    while True:
        triangle, u, v, distance = tracer.first(origins, directions)
        if air:
            triangle, flights = air.crossed(origins, directions, (triangle, distance), throughput, owner, rng)
            ways += [flights.ways] if flights.ways else []
        if gloss:
            triangle, met = gloss.met(triangle, u, v, directions, throughput, owner, distance)
        place = np.empty((6, len(owner)), np.float32)
        hits = triangle, u, v, directions, albedo(triangle, u, v)
        count = _arrive(*hits, tracer.normals, tracer.corners, tracer.offset, place, throughput, owner)
        place, throughput, owner = place[:, :count], throughput[:, :count], owner[:count]
        parts.append(Vertices(place, throughput, owner))
        shiny += [met] if met else []
        if (count == 0 and not met and not flights) or len(parts) == bounces:
            break
        throughput, owner, triangle = throughput.copy(), owner.copy(), triangle[:count]
        numbers = rng.random((count, 3), np.float32)
        origins, directions = np.empty((2, count, 3), np.float32)
        count = _go_on(place, numbers, triangle, tracer.frames, throughput, owner, origins, directions)
        throughput, owner = np.ascontiguousarray(throughput[:, :count]), owner[:count].copy()
        origins, directions = origins[:count], directions[:count]
        for other in filter(None, (met, flights)):
            more = other.go_on(rng)
            origins, directions = np.concatenate([origins, more[0]]), np.concatenate([directions, more[1]])
            throughput, owner = np.concatenate([throughput, more[2]], 1), np.concatenate([owner, more[3]])
        if len(owner) == 0:
            break
    return [Vertices.joined(parts), *(type(kind[0]).joined(kind) for kind in (shiny, ways) if kind)]


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
        survival = min(np.float32(SURVIVAL) * brightest, np.float32(MAX_SURVIVAL))
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
