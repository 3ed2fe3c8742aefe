"""Light that reached a point without touching anything.

Points go through in blocks that stay in a core's cache: the light's own arithmetic, then a choice of the points that it can
reach, then their shadow rays, then what is left of its light. All but the shadow rays is compiled.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module

import numpy as np

from ddprt.axes import Float32, Int
from ddprt.compiled import compiled
from ddprt.lights import Light, Lighting
from ddprt.scene.atlas import Atlas
from ddprt.transport.embree import Tracer, lifted

BLOCK = 1 << 14
"""Points that are shaded together: some 80 bytes each, so about a megabyte."""

MOST_PLACES = 1024
"""Shadow rays of a texel that a lamp all but touches."""

Numbers = Callable[[int, Float32[np.ndarray, "2 points"]], None]
"""Writes the uniform numbers of the points from a given one on, so that lights without size draw none."""


@dataclass(frozen=True, eq=False)
class Places:
    """Points ready for many lightings: groups of as many samples, of each of which the mean is wanted.

    Attributes:
      blocks: origins of rays (x, y, z; centred frame, metres) and normals, a coordinate after another in memory. What fills
        up the last block has no normal, so that no light falls on it.
      samples: consecutive points in a group.
      count: groups.
    """

    blocks: Float32[np.ndarray, "blocks 6 points"]
    samples: int
    count: int

    @classmethod
    def of(
        cls, tracer: Tracer, positions: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], samples: int = 1
    ) -> "Places":
        """Places on the surface (centred frame, metres) with unit geometric normals; n is a multiple of `samples`."""
        count = len(positions) // samples
        blocks = -(-len(positions) // BLOCK)
        size = -(-count // max(blocks, 1)) * samples
        rows = np.zeros((blocks * size, 6), np.float32)
        rows[: len(positions), :3] = lifted(tracer, positions, normals)
        rows[: len(positions), 3:] = normals
        return cls(np.ascontiguousarray(rows.reshape(blocks, size, 6).swapaxes(1, 2)), samples, count)


@dataclass(frozen=True, eq=False)
class Texels:
    """Places spread over every texel, uniform by area, the same for all lightings so that their light adds up.

    Attributes:
      tracer: the occluders.
      atlas: the texels.
      shift: start of each texel's sequence of places.
      places: `samples` of each texel, in the atlas's order.
    """

    tracer: Tracer
    atlas: Atlas
    shift: Float32[np.ndarray, "texels 2"]
    places: Places

    @classmethod
    def of(cls, tracer: Tracer, atlas: Atlas, samples: int, rng: np.random.Generator) -> "Texels":
        """So many places per texel."""
        shift = rng.random((atlas.count, 2), np.float32)
        texels = np.arange(atlas.count) if atlas.order is None else atlas.order
        return cls(tracer, atlas, shift, _spread(tracer, atlas, samples, shift[texels], texels))

    def irradiance(self, lighting: Lighting, rng: np.random.Generator) -> Float32[np.ndarray, "texels 3"]:
        """Mean E of each texel, shadows included.

        A lamp at distance d changes across a texel of width w by some w / d of its light, so texels nearer to it than a few of
        their widths are looked at again with more places: so many that the error there stays what it is further off.

        Args:
          lighting: world space.
          rng: for lights with size.
        Returns:
          W/m², as in `mean_irradiance`.
        """
        total = np.zeros((self.atlas.count, 3), np.float32)
        for light, there in zip(lighting, centred(self.tracer, lighting), strict=True):
            own = mean_irradiance(self.tracer, (there,), self.places, rng)
            if self.atlas.order is not None:
                own[self.atlas.order] = own.copy()
            for texels, samples in self._closer(light):
                closer = _spread(self.tracer, self.atlas, samples, self.shift[texels], texels)
                own[texels] = mean_irradiance(self.tracer, (there,), closer, rng)
            with np.errstate(over="ignore", invalid="ignore"):  # see `mean_irradiance`
                total += own
        return total

    def _closer(self, light: Light) -> list[tuple[Int[np.ndarray, " near"], int]]:
        """Texels that need more places for this light, and how many."""
        lamp = light.anchor()
        if lamp is None:
            return []
        ratio = np.linalg.norm(self.atlas.position - lamp, axis=1) / np.sqrt(self.atlas.area)
        found = []
        for low, high, factor in ((0, 1, 256), (1, 4, 16)):
            texels, samples = np.flatnonzero((ratio >= low) & (ratio < high)), min(factor * self.places.samples, MOST_PLACES)
            if len(texels) and samples > self.places.samples:
                found.append((texels, samples))
        return found


def _spread(
    tracer: Tracer, atlas: Atlas, samples: int, shift: Float32[np.ndarray, "texels 2"], texels: Int[np.ndarray, " texels"]
) -> Places:
    u = (shift[:, None] + _sequence(samples).T).reshape(-1, 2)
    u -= u >= 1
    position, triangle = atlas.sampler.sample(np.repeat(texels, samples), u)
    return Places.of(tracer, position, tracer.normals[triangle], samples)


def mean_irradiance(
    tracer: Tracer, lighting: Lighting, places: Places, rng: np.random.Generator, *, shadows: bool = True
) -> Float32[np.ndarray, "groups 3"]:
    """Mean E of each group of points, shadows included, with one ray from every point to every light.

    The samples of a group meet different parts of a light with size: a fixed sequence that is shifted at random for each
    group, so the mean stays unbiased (Cranley and Patterson 1976). Lights without size draw nothing.

    Args:
      tracer: the occluders.
      lighting: lights in the tracer's centred frame (see `centred`).
      places: where.
      rng: for lights with size.
      shadows: False lets light through everything, and traces no ray.
    Returns:
      W/m². What is too much for float32 becomes infinity or NaN, and is refused where light is stored.
    """
    total = np.zeros((places.count, 3), np.float32)
    for light in lighting:
        words = rng.integers(0, 1 << 64, 0 if light.delta else places.count, np.uint64).view(np.uint32).reshape(-1, 2)
        _add(tracer, light, places, partial(_shifted, words, _lattice(places.samples)), total, shadows)
    return total


def direct_irradiance(
    tracer: Tracer,
    lighting: Lighting,
    positions: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    u: Float32[np.ndarray, "lights n 2"],
) -> Float32[np.ndarray, "n 3"]:
    """One sample of E from every light, shadows included.

    Args:
      tracer: the occluders.
      lighting: lights in the tracer's centred frame (see `centred`).
      positions: on the surface, centred frame, metres.
      normals: unit, geometric.
      u: uniform numbers per light and point; lights without size ignore them.
    Returns:
      W/m², as in `mean_irradiance`. Its mean over `u` is exact.
    """
    places = Places.of(tracer, positions, normals)
    total = np.zeros_like(positions)
    for light, numbers in zip(lighting, u, strict=True):
        _add(tracer, light, places, partial(_given, numbers), total)
    return total


def centred(tracer: Tracer, lighting: Lighting) -> Lighting:
    """The lighting in the tracer's frame, as it is seen through the fog there if there is some."""
    there = tuple(light.translated(-tracer.centre) for light in lighting)
    return tuple(map(tracer.medium.veiled, there)) if tracer.medium else there


def _add(
    tracer: Tracer, light: Light, places: Places, numbers: Numbers, total: Float32[np.ndarray, "groups 3"], shadows: bool = True
) -> None:
    """Adds a light's share to the means."""
    size, samples = places.blocks.shape[2], places.samples
    u = np.zeros((2, size), np.float32)
    origins, directions = np.empty((2, size, 3), np.float32)
    reach, weight = np.empty((2, size), np.float32)
    target = np.empty(size, np.uint32)  # unsigned: Numba looks at other indices for negative ones
    sample = None
    for index, block in enumerate(places.blocks):
        if not light.delta:
            numbers(index * size, u)
        sample = light.illuminate(block[:3].T, u.T, sample, block[3:].T)
        light_there = sample.direction.T, sample.distance, sample.strength
        rays = _aim(block, *light_there, tracer.offset, weight, target, origins, directions, reach)
        if rays and any(sample.colour):
            seen = tracer.unoccluded(origins[:rays], directions[:rays], reach[:rays]) if shadows else np.ones(rays, np.int32)
            arriving = seen, target, weight, sample.colour / samples, samples, index * size // samples, total
            if sample.tint is None:
                _collect(*arriving)
            else:
                import_module("ddprt.transport.tinted").into_groups(sample.tint.T, *arriving)


def _given(numbers: Float32[np.ndarray, "n 2"], first: int, u: Float32[np.ndarray, "2 points"]) -> None:
    u[:, : len(numbers) - first] = numbers[first : first + u.shape[1]].T


def _sequence(samples: int) -> Float32[np.ndarray, "2 samples"]:
    """Places spread over the unit square: x -> x + (root of 2, root of 3) modulo 1.

    No whole multiples of these two and of the golden ratio add up to a whole number, so that a texel's places and the parts
    of a light that they meet (`_lattice`) are spread over all four dimensions. By one sequence both would move in step.

    Reference: Niederreiter, "Random Number Generation and Quasi-Monte Carlo Methods", 1992, 5.
    """
    return np.minimum(np.arange(samples) * np.sqrt([[2.0], [3.0]]) % 1, 1 - 2**-24).astype(np.float32)


def _lattice(samples: int) -> Float32[np.ndarray, "2 samples"]:
    """Parts of a light, spread over the unit square: even steps, and turns by the golden ratio.

    Even steps put as many samples of each group below a half as above it, where a sky divides its techniques.
    """
    steps = np.arange(samples)
    return np.stack([steps / samples, np.minimum(steps * 0.61803398874989485 % 1, 1 - 2**-24)]).astype(np.float32)


@compiled
def _shifted(words: np.ndarray, sequence: np.ndarray, first: int, u: np.ndarray) -> None:
    """The sequence from another start for each group, modulo 1; 24 bits of a word make a start."""
    samples = sequence.shape[1]
    before, one = first // samples, np.float32(1)
    for axis in range(2):
        for group in range(min(u.shape[1] // samples, len(words) - before)):
            start = np.float32(words[before + group, axis] >> 8) * np.float32(2**-24)
            for j in range(samples):
                number = start + sequence[axis, j]
                u[axis, group * samples + j] = number if number < one else number - one


@compiled
def _aim(
    block: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
    strength: np.ndarray,
    short: np.float32,
    weight: np.ndarray,
    target: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
) -> int:
    """Weighs each point's light by its cosine, and writes a ray for each point that has any; returns their number.

    Rays stop `short` of the light.
    """
    zero = np.float32(0)
    for i in range(len(weight)):
        cosine = block[3, i] * direction[0, i] + block[4, i] * direction[1, i] + block[5, i] * direction[2, i]
        weight[i] = cosine * strength[i] if cosine > zero else zero
    rays = 0
    for i in range(len(weight)):  # written always and kept by counting: a branch would be mispredicted
        target[rays] = i
        rays += weight[i] > zero
    for ray in range(rays):
        i = target[ray]
        x, y, z = block[0, i], block[1, i], block[2, i]  # all is read before anything is written: a fifth faster
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
    colour: np.ndarray,
    samples: int,
    first: int,
    total: np.ndarray,
) -> None:
    """Darkens the points in shadow, and adds each group's sum times a colour."""
    for ray in range(len(seen)):
        weight[target[ray]] = weight[target[ray]] if seen[ray] else np.float32(0)
    red, green, blue = np.float32(colour[0]), np.float32(colour[1]), np.float32(colour[2])
    start = 0
    for group in range(first, min(first + len(weight) // samples, len(total))):
        light = np.float32(0)
        for i in range(start, start + samples):
            light += weight[i]
        start += samples
        total[group, 0] += light * red
        total[group, 1] += light * green
        total[group, 2] += light * blue
