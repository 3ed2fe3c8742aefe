"""What surfaces see: low-discrepancy cosine-weighted rays from texels or senders, and where on the atlas they land.

All rays of a call leave neighbouring receivers in similar directions, sample by sample: on a mesh of 330 k triangles that
alone is worth a factor of 1.8. Between the rays runs compiled code; all arrays of a call fit into a core's cache.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float32, Int, Int32
from ddprt.compiled import compiled
from ddprt.scene.atlas import Atlas, SurfaceSampler
from ddprt.transport.embree import Tracer

TILE = 64  # fewest receivers whose rays are traced together
_CALL = 1 << 14  # rays of one call
_TABLE = 1 << 16  # samples of all blocks of a pattern
NOTHING, BACK = -1, -2  # what a ray met that is no cell
PARTED = -3  # and below, in `Landing.cell` alone: texels that lie on both sides of a wall
_CELLS = 5  # bits per axis of the order that directions are sorted by


@dataclass(frozen=True, eq=False)
class Pattern:
    """Owen-scrambled Sobol points, dealt out in blocks to texels.

    Consecutive blocks of one sequence go to neighbouring texels in Z-order, so that what one texel misses its neighbours see:
    the error of a texel stays that of its own block, while the mean over a neighbourhood is far better ("blue noise").
    Every 16 x 16 texels the deal is shuffled and the hemisphere turned.

    Attributes:
      disk: points on the unit disk below each cosine-weighted direction; sample k goes about the same way in all blocks.
      place: uniform numbers for the place within a texel.
    Reference: Ahmed and Wonka, "Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error via Hierarchical Ordering of
    Pixels", 2020.
    """

    disk: Float32[np.ndarray, "samples blocks 2"]
    place: Float32[np.ndarray, "samples blocks 2"]

    @classmethod
    def of(cls, samples: int, seed: int) -> "Pattern":
        """A pattern for so many rays per receiver."""
        blocks = 1 << int(np.clip((_TABLE // samples).bit_length() - 1, 2, 8))
        points = warp.sobol(blocks * samples, 4, seed).reshape(blocks, samples, 4)
        cell = (points[..., :2] * (1 << _CELLS)).astype(np.int64)
        order = np.argsort(_interleaved(cell[..., 0], cell[..., 1]), 1, kind="stable")
        points = np.take_along_axis(points, order[..., None], 1).swapaxes(0, 1)
        disk = warp.sample_cosine(np.ascontiguousarray(points[..., :2]))[..., :2]
        return cls(np.ascontiguousarray(disk), np.ascontiguousarray(points[..., 2:]))

    def deal(
        self, row: Int[np.ndarray, " n"], column: Int[np.ndarray, " n"], seed: int
    ) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, "n 2"]]:
        """Block of each texel, and cosine and sine of the turn of its hemisphere."""
        blocks = self.disk.shape[1]
        tile = (row // 16).astype(np.uint64) << np.uint64(32) | (column // 16).astype(np.uint64)
        key, of_tile = np.unique(tile, return_inverse=True)
        bits = _scrambled(_scrambled(key) ^ np.uint64(seed))
        mask, turn = (bits % np.uint64(blocks)).astype(np.int64), 2 * np.pi * (bits >> np.uint64(11)) * 2.0**-53
        block = (_interleaved(row % 16, column % 16) % blocks) ^ mask[of_tile]
        return block.astype(np.int32), np.stack([np.cos(turn), np.sin(turn)], 1).astype(np.float32)[of_tile]


def _scrambled(key: np.ndarray) -> np.ndarray:
    """Random 64 bits for each key, whichever others are asked for (SplitMix64)."""
    key = key + np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        key = (key ^ (key >> np.uint64(shift))) * np.uint64(factor)
    return key ^ (key >> np.uint64(31))


def _interleaved(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Z-order of small non-negative integers."""
    code = np.zeros(row.shape, np.int64)
    for bit in range(_CELLS):
        code |= ((row >> bit) & 1) << (2 * bit + 1) | ((column >> bit) & 1) << (2 * bit)
    return code


@dataclass(frozen=True, eq=False)
class Receivers:
    """Patches of the surface that gather light, ready to shoot.

    Attributes:
      sampler: surfaces, in patches.
      pattern: the rays.
      patch: which patch of the sampler each of them is.
      block, turn: see `Pattern.deal`.
    """

    sampler: SurfaceSampler
    pattern: Pattern
    patch: Int[np.ndarray, " receivers"]
    block: Int32[np.ndarray, " receivers"]
    turn: Float32[np.ndarray, "receivers 2"]

    @classmethod
    def of(
        cls,
        sampler: SurfaceSampler,
        patch: Int[np.ndarray, " receivers"],
        row: Int[np.ndarray, " receivers"],
        column: Int[np.ndarray, " receivers"],
        samples: int,
        seed: int,
        stream: str,
    ) -> "Receivers":
        """Some patches, at rows and columns of a lattice, with random numbers of their own stream."""
        address = *stream.encode(), samples
        pattern = Pattern.of(samples, seeds.number(seed, "gather pattern", *address))
        return cls(sampler, pattern, patch, *pattern.deal(row, column, seeds.number(seed, "gather deal", *address)))

    @classmethod
    def texels(
        cls, atlas: Atlas, samples: int, seed: int, stream: str, chosen: Int[np.ndarray, " receivers"] | None = None
    ) -> "Receivers":
        """All texels of an atlas, or chosen ones."""
        patch = np.arange(atlas.count) if chosen is None else chosen
        row, column = np.divmod(atlas.texel[patch], atlas.resolution)
        return cls.of(atlas.sampler, patch, row, column, samples, seed, stream)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.block)

    @property
    def samples(self) -> int:
        """Rays of each."""
        return len(self.pattern.disk)

    def tiles(self, together: int = 1, within: slice | None = None) -> Iterator[slice]:
        """Neighbours whose rays are traced together, or so many such tiles at once; of all receivers or within some."""
        size = together * max(TILE, _CALL // self.samples)
        start, stop = (0, self.count) if within is None else (within.start, within.stop)
        return (slice(first, min(first + size, stop)) for first in range(start, stop, size))


@dataclass(frozen=True, eq=False)
class Landing:
    """How a hit becomes a place on the atlas.

    Attributes:
      chart: texel coordinates of each triangle's first corner and of its two edges.
      cell: what lies at each texel of the atlas, `NOTHING` where there is none; PARTED - k for the k-th parted texel.
      part: cells of the small squares of each parted texel.
    """

    chart: Float32[np.ndarray, "triangles 6"]
    cell: Int32[np.ndarray, "height width"]
    part: Int32[np.ndarray, "parted down across"]

    @classmethod
    def of(cls, atlas: Atlas, of_texel: Int32[np.ndarray, " texels"]) -> "Landing":
        """Landing on groups of texels: `of_texel` names the group of each covered texel, `NOTHING` for none."""
        edges = atlas.uv[:, 1:] - atlas.uv[:, :1]
        chart = np.concatenate([atlas.uv[:, :1], edges], 1).reshape(-1, 6) * atlas.resolution
        cell = np.where(atlas.lookup >= 0, of_texel[atlas.lookup], NOTHING).astype(np.int32)
        cell.ravel()[atlas.texel[atlas.parted]] = PARTED - np.arange(len(atlas.parted))
        part = np.where(atlas.part >= 0, of_texel[atlas.part], NOTHING).astype(np.int32)
        return cls(chart.astype(np.float32), cell, part)


@dataclass(frozen=True, eq=False)
class Seen:
    """What some rays of a tile met.

    Attributes:
      cells: where each landed: `NOTHING` where it escaped or landed outside all cells, `BACK` on the back of a surface.
      distance: of the hit, metres; 1e37 where it escaped.
      triangle, u, v: of the hit, as `Tracer.first` gives them, sample by sample.
    """

    cells: Int32[np.ndarray, "samples tile"]
    distance: Float32[np.ndarray, "samples tile"]
    triangle: Int32[np.ndarray, " rays"]
    u: Float32[np.ndarray, " rays"]
    v: Float32[np.ndarray, " rays"]


def seen_from(tracer: Tracer, receivers: Receivers, tile: slice, landing: Landing) -> Iterator[Seen]:
    """What a tile of receivers sees, some samples at a time."""
    pattern, block, patch = receivers.pattern, receivers.block[tile], receivers.patch[tile]
    step = max(1, _CALL // len(block))
    for start in range(0, receivers.samples, step):
        chunk = slice(start, start + step)
        origins, triangle = receivers.sampler.spread(patch, pattern.place[chunk], block)
        directions = np.empty_like(origins)
        _aim(pattern.disk[chunk], block, receivers.turn[tile], triangle, tracer.frames, tracer.offset, origins, directions)
        triangle, u, v, distance = tracer.first(origins, directions)
        cells = landed_on(tracer, landing, directions, triangle, u, v).reshape(-1, len(block))
        yield Seen(cells, distance.reshape(cells.shape), triangle, u, v)


def landed_on(
    tracer: Tracer,
    landing: Landing,
    directions: Float32[np.ndarray, "rays 3"],
    triangle: Int32[np.ndarray, " rays"],
    u: Float32[np.ndarray, " rays"],
    v: Float32[np.ndarray, " rays"],
) -> Int32[np.ndarray, " rays"]:
    """Cells of hits; see `Seen`."""
    cells = np.empty(len(triangle), np.int32)
    _land(triangle, u, v, directions, tracer.normals, landing.chart, landing.cell, landing.part, cells)
    return cells


@compiled
def _aim(
    disk: np.ndarray,
    block: np.ndarray,
    turn: np.ndarray,
    triangle: np.ndarray,
    frames: np.ndarray,
    offset: np.floating,
    origins: np.ndarray,
    directions: np.ndarray,
) -> None:
    """Lifts origins off their surface and turns disk points into directions about its normal."""
    samples, tile = len(disk), len(block)
    for sample in range(samples):
        for receiver in range(tile):
            ray = sample * tile + receiver
            frame, point = frames[np.uint32(triangle[ray])], disk[sample, np.uint32(block[receiver])]
            x, y = point[0], point[1]
            cosine, sine = turn[receiver, 0], turn[receiver, 1]
            x, y = cosine * x - sine * y, sine * x + cosine * y
            z = np.sqrt(max(np.float32(0), np.float32(1) - x * x - y * y))
            for axis in range(3):
                origins[ray, axis] += offset * frame[2, axis]
                directions[ray, axis] = x * frame[0, axis] + y * frame[1, axis] + z * frame[2, axis]


@compiled
def _land(
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    directions: np.ndarray,
    normals: np.ndarray,
    chart: np.ndarray,
    cell: np.ndarray,
    part: np.ndarray,
    cells: np.ndarray,
) -> None:
    """Cell at each hit. Unsigned indices spare the look at whether they count from the end."""
    last = len(cell) - 1
    for ray in range(len(cells)):
        hit = triangle[ray]
        if hit < 0:
            cells[ray] = NOTHING
            continue
        facing = np.float32(0)
        for axis in range(3):
            facing += directions[ray, axis] * normals[hit, axis]
        if facing < 0:
            column = chart[hit, 0] + u[ray] * chart[hit, 2] + v[ray] * chart[hit, 4]
            row = chart[hit, 1] + u[ray] * chart[hit, 3] + v[ray] * chart[hit, 5]
            down, across = min(max(int(row), 0), last), min(max(int(column), 0), last)
            found = cell[down, across]
            if found <= PARTED:
                size = part.shape[1]
                y, x = int((row - down) * size), int((column - across) * size)
                found = part[PARTED - found, min(max(y, 0), size - 1), min(max(x, 0), size - 1)]
            cells[ray] = found
        else:
            cells[ray] = BACK
