"""Indirect light of all lightings at once: G, the gather operator, is traced once per scene.

The light that leaves the surfaces lives on *senders*, small blocks of texels, each holding the direct light that it got. What
bounces on from there is smooth: it is solved for on coarser blocks, as the Neumann series of their matrix, and interpolated
back between their centres within each chart. In the end every receiver adds up the radiosity of the senders that its rays meet:

    E = G b,    b = R (E0 + P (e_1 + e_2 + ...)),    e_1 = G R E0,    e_k+1 = G P R e_k,    all e_k on the coarse blocks

A lighting is a column of these products, so one more costs its shadow rays and a column. Averaging light over a sender is the
only bias, and near senders, where it would show, are looked at more closely (`transport/near.py`); `experiments/bake_costs.py
bias` measures what is left against unbiased paths.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64, Int
from ddprt.compiled import compiled
from ddprt.lights import Lighting
from ddprt.scene.atlas import Atlas, Senders
from ddprt.transport.direct import centred
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Landing, Receivers, seen_from
from ddprt.transport.near import WIDTHS, NearField
from ddprt.transport.reflection import Reflection

_SENDER_RESOLUTION = 128  # senders along a side where nothing else is asked for
_COARSE = 3000  # most blocks that bounces are solved on
_COARSE_SAMPLES = 256  # rays of each: their noise is averaged once more over all that a texel sees
_TOGETHER = 8  # tiles whose near rays are lit together, and that are stored at once
_TOLERANCE = 1e-4  # of a lighting's largest indirect value: where the series stops
_MAX_BOUNCES = 512  # a closed white room never ends; what is left is reported


@dataclass(frozen=True)
class Bounced:
    """Light on its way from the senders, all lightings and channels side by side.

    Attributes:
      radiosity: W/m².
      bounces: bounces that will have been counted once it is gathered.
      remainder: bound on the light of all further bounces, as a share of the lighting's largest indirect value.
      arrived: on senders of bodies that light passes, direct light and all bounces, W/m²; None where there are none.
    """

    radiosity: Float32[np.ndarray, "senders columns"]
    bounces: int
    remainder: float
    arrived: Float32[np.ndarray, "inside columns"] | None = None

    @property
    def converged(self) -> bool:
        """Whether what is left is negligible."""
        return self.remainder <= _TOLERANCE


@dataclass(frozen=True)
class Pilot:
    """What a few rays from every texel tell.

    Attributes:
      nearness: mean of 1 / distance, 1/m; rays that escape count 0.
      variance: of a single ray's irradiance, summed over lightings and channels, in units of the largest radiosity squared.
    """

    nearness: Float64[np.ndarray, " texels"]
    variance: Float64[np.ndarray, " texels"]


@dataclass(frozen=True, eq=False)
class Operator:
    """G of a scene, for any number of lightings.

    Attributes:
      tracer, atlas: the scene.
      senders: what light leaves from.
      coarse: larger blocks of senders, which further bounces are solved on.
      inside: the `ddprt.transport.subsurface.Inside` of bodies that light passes; None where there are none.
    """

    tracer: Tracer
    atlas: Atlas
    senders: Senders
    coarse: Senders
    inside: Any = None

    @classmethod
    def of(cls, tracer: Tracer, atlas: Atlas, sender_resolution: int = 0) -> "Operator":
        """The operator of a scene, with so many senders along a side of the atlas; 0: at most 128."""
        block = max(1, round(atlas.resolution / (sender_resolution or min(atlas.resolution, _SENDER_RESOLUTION))))
        senders = coarse = atlas.senders(block)
        while coarse.count > _COARSE and coarse.block < atlas.resolution:  # charts are never joined, however many there are
            coarse = atlas.senders(coarse.block + block)
        return cls(tracer, atlas, senders, coarse)

    @cached_property
    def landing(self) -> Landing:
        """From hits to senders."""
        return Landing.of(self.atlas, self.senders.of_texel)

    def near(
        self,
        lightings: Sequence[Lighting],
        direct: Float32[np.ndarray, "senders columns"],
        *,
        bounces: int = -1,
        widths: float = WIDTHS,
    ) -> NearField:
        """Looks closer at what is within so many widths of a coarse block; arguments as for `bounce`."""
        area = np.zeros(self.senders.count)
        area[self.senders.of_texel] = self.coarse.area[self.coarse.of_texel]
        if self.inside:
            area[self.inside.senders] = 0  # light comes out of a body smoothly, and not where it fell on it
        lights = [centred(self.tracer, lighting) for lighting in lightings]
        albedo, reach = self.senders.albedo.astype(np.float32), (widths**2 * area).astype(np.float32)
        return NearField(self.tracer, self.landing, lights, direct, albedo, reach, bounces < 0)

    @cached_property
    def _mean(self) -> Any:
        """Sparse matrix from texels to senders: the mean by area."""
        from scipy.sparse import csr_array

        sender = self.senders.of_texel
        share = (self.atlas.area / self.senders.area[sender]).astype(np.float32)
        return csr_array((share, (sender, np.arange(self.atlas.count))), shape=(self.senders.count, self.atlas.count))

    def averaged(self, irradiance: Float32[np.ndarray, "texels 3"]) -> Float32[np.ndarray, "senders 3"]:
        """Mean irradiance of each sender."""
        return np.asarray(self._mean @ irradiance)

    @np.errstate(over="ignore", invalid="ignore")  # what is too much for float32 is refused where it is stored
    def bounce(self, direct: Float32[np.ndarray, "senders columns"], *, seed: int, stream: str, bounces: int = -1) -> Bounced:
        """Follows light between the senders.

        Args:
          direct: direct irradiance on the senders, W/m², columns (lighting, channel).
          seed, stream: address of the random numbers; another stream gives independent noise.
          bounces: -1 goes on until what is left is negligible; otherwise exactly this many, at least 1.
        """
        reflection = Reflection.of(
            self.senders, self.coarse, direct.shape[1] // 3, self.inside and self.inside.matrix(seed=seed, stream=stream)
        )
        largest, radiosity = reflection.largest, reflection.radiosity(direct)
        if bounces == 1 or largest == 0:
            peak = direct.max(0, initial=0)
            return Bounced(radiosity, 1, _remainder(largest, peak, peak), reflection.arrived(direct))
        gather, term = self._between_senders(radiosity, seed, stream)
        finer = _between(self.senders, self.coarse)
        total = term.copy()
        summed, left = 2, _remainder(largest, term.max(0), total.max(0))
        while (left > _TOLERANCE if bounces < 0 else summed < bounces) and summed < _MAX_BOUNCES:
            term = gather @ reflection.coarsely(term, finer)
            total += term
            summed += 1
            left = _remainder(largest, term.max(0), total.max(0))
        further = finer @ total
        radiosity += reflection.radiosity(further)
        return Bounced(radiosity, summed, left, reflection.arrived(direct, further))

    def _between_senders(
        self, radiosity: Float32[np.ndarray, "senders columns"], seed: int, stream: str
    ) -> tuple[Any, Float32[np.ndarray, "coarse columns"]]:
        """G among the coarse blocks, and what they gather from the senders.

        Sparse, though most rows meet a tenth of the blocks: its products are as fast, and add up in an order that does not
        depend on how many threads BLAS has.
        """
        from scipy.sparse import csr_array, vstack

        coarse = self.coarse
        place = np.arange(coarse.count), coarse.row, coarse.column
        receivers = Receivers.of(coarse.sampler, *place, _COARSE_SAMPLES, seed, f"{stream} senders")
        home = np.zeros(self.senders.count, np.int32)
        home[self.senders.of_texel] = coarse.of_texel
        table = _with_dark_row(radiosity)

        def work(tile: slice) -> tuple[Any, np.ndarray]:
            count = tile.stop - tile.start
            rows = np.zeros((count, coarse.count), np.float32)
            sums = np.zeros((count, table.shape[1]), np.float32)
            for seen in seen_from(self.tracer, receivers, tile, self.landing):
                _count_seen(seen.cells, home, rows)
                _add_seen(seen.cells, table, sums)
            return csr_array(rows * np.float32(1 / _COARSE_SAMPLES)), sums * np.float32(1 / _COARSE_SAMPLES)

        rows, sums = zip(*self.tracer.map(work, receivers.tiles()), strict=True)
        return vstack(rows, format="csr"), np.concatenate(sums)

    def gather(
        self,
        radiosity: Float32[np.ndarray, "senders columns"],
        out: Float32[np.ndarray, "lightings texels 3"],
        rays: Int[np.ndarray, " texels"],
        *,
        seed: int,
        stream: str,
        near: NearField | None = None,
        skip: int = 0,
    ) -> Iterator[int]:
        """Irradiance of texels for every lighting, stretch by stretch.

        Args:
          radiosity: from `bounce`.
          out: written in place; may lie on disk.
          rays: of each texel; 0 leaves it out.
          seed, stream: address of the random numbers.
          near: looks closer at near senders, if given.
          skip: stretches that `out` holds already.
        Yields:
          The number of texels of each finished stretch, in order, the skipped ones included.
        """
        table = _with_dark_row(radiosity)

        def work(item: tuple[int, Receivers, slice]) -> int:
            index, receivers, stretch = item
            if index >= skip:
                rng = seeds.stream(seed, "near", *stream.encode(), index)
                sums = self._sums(receivers, stretch, table, near, rng)
                _store(sums, receivers.patch[stretch], np.float32(1 / receivers.samples), out)
            return stretch.stop - stretch.start

        groups = (
            Receivers.texels(self.atlas, int(samples), seed, stream, np.flatnonzero(rays == samples))
            for samples in np.unique(rays[rays > 0])
        )
        stretches = ((receivers, stretch) for receivers in groups for stretch in receivers.tiles(_TOGETHER))
        yield from self.tracer.map(work, ((index, *stretch) for index, stretch in enumerate(stretches)))

    def gather_some(
        self,
        radiosity: Float32[np.ndarray, "senders columns"],
        texels: Int[np.ndarray, " chosen"],
        samples: int,
        *,
        seed: int,
        stream: str,
        near: NearField | None = None,
    ) -> Float32[np.ndarray, "lightings chosen 3"]:
        """Irradiance of a few texels in rising order, with as many rays from each."""
        receivers = Receivers.texels(self.atlas, samples, seed, stream, texels)
        table = _with_dark_row(radiosity)

        def work(stretch: slice) -> np.ndarray:
            return self._sums(receivers, stretch, table, near, seeds.stream(seed, "near some", *stream.encode(), stretch.start))

        parts = list(self.tracer.map(work, receivers.tiles(_TOGETHER)))
        return np.concatenate(parts).reshape(len(texels), -1, 3).swapaxes(0, 1) * np.float32(1 / samples)

    def _sums(
        self,
        receivers: Receivers,
        stretch: slice,
        table: Float32[np.ndarray, "senders_and_dark columns"],
        near: NearField | None,
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "stretch columns"]:
        """The radiosity that the rays of a stretch meet, added up."""
        sums, met = np.zeros((stretch.stop - stretch.start, table.shape[1]), np.float32), []
        for tile in receivers.tiles(within=stretch):
            own = slice(tile.start - stretch.start, tile.stop - stretch.start)
            for seen in seen_from(self.tracer, receivers, tile, self.landing):
                _add_seen(seen.cells, table, sums[own])
                if near:
                    met.append(near.pick(seen, own.start))
        if near:
            near.add(met, table, rng, sums)
        return sums

    def pilot(self, radiosity: Float32[np.ndarray, "senders columns"], samples: int, *, seed: int, stream: str) -> Pilot:
        """A first look from every texel, with random numbers of its own."""
        receivers = Receivers.texels(self.atlas, samples, seed, f"{stream} pilot")
        relative = radiosity / max(float(radiosity.max()), np.finfo(np.float32).tiny)  # its square stays in range
        table = _with_dark_row(np.concatenate([relative, (relative**2).sum(1, keepdims=True)], 1))

        def work(tile: slice) -> tuple[np.ndarray, np.ndarray]:
            sums = np.zeros((tile.stop - tile.start, table.shape[1]), np.float32)
            near = np.zeros(tile.stop - tile.start)
            for seen in seen_from(self.tracer, receivers, tile, self.landing):
                _add_seen(seen.cells, table, sums)
                _add_nearness(seen.cells, seen.distance, near)
            mean = sums.astype(np.float64) / samples
            return near / samples, np.maximum(mean[:, -1] - (mean[:, :-1] ** 2).sum(1), 0)

        parts = list(self.tracer.map(work, receivers.tiles()))
        return Pilot(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _remainder(largest: float, last: np.ndarray, total: np.ndarray) -> float:
    """Bound on the light of all further terms: rows of G sum to at most 1, so each is at most `largest` times the last."""
    ratio = np.divide(last, total, out=np.zeros_like(total), where=total > 0).max(initial=0)
    if not np.isfinite(ratio):
        return float("inf")
    return float(ratio * largest / (1 - largest)) if largest < 1 else float("inf" if ratio > 0 else 0)


def _between(senders: Senders, coarse: Senders) -> Any:
    """Sparse matrix that interpolates between the centres of coarse blocks, within each chart; rows sum to 1."""
    from scipy.sparse import csr_array, eye_array

    if coarse.block == senders.block:
        return eye_array(senders.count, dtype=np.float32, format="csr")
    across = int(max(coarse.row.max(), coarse.column.max())) + 3
    keys = (coarse.chart.astype(np.int64) * across + coarse.row + 1) * across + coarse.column + 1  # sorted, as senders are
    at = [(place + 0.5) * (senders.block / coarse.block) - 0.5 for place in (senders.row, senders.column)]
    low = [np.floor(place).astype(np.int64) for place in at]
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for down in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - down - (at[0] - low[0])) * np.abs(1 - right - (at[1] - low[1]))
            key = (senders.chart.astype(np.int64) * across + low[0] + down + 1) * across + low[1] + right + 1
            found = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
            there = np.flatnonzero((keys[found] == key) & (weight > 0))
            entries.append((weight[there], there, found[there]))
    weight, sender, block = (np.concatenate(column) for column in zip(*entries, strict=True))
    weight /= np.bincount(sender, weight, senders.count)[sender]
    return csr_array((weight.astype(np.float32), (sender, block)), shape=(senders.count, coarse.count))


def _with_dark_row(radiosity: Float32[np.ndarray, "senders columns"]) -> Float32[np.ndarray, "senders_and_dark columns"]:
    return np.concatenate([radiosity, np.zeros_like(radiosity[:1])])


@compiled
def _count_seen(cells: np.ndarray, home: np.ndarray, rows: np.ndarray) -> None:
    """Adds one to each receiver's row wherever one of its rays lands."""
    for sample in range(cells.shape[0]):
        for receiver in range(cells.shape[1]):
            cell = cells[sample, receiver]
            if cell >= 0:
                rows[receiver, home[cell]] += np.float32(1)


@compiled
def _add_seen(cells: np.ndarray, table: np.ndarray, sums: np.ndarray) -> None:
    """Adds to each receiver's row the table's rows that its rays land on; the last row of the table is dark.

    Neighbours' rays of one sample land close together: their rows are still in the cache. Four at a time save traffic.
    """
    samples, tile = cells.shape
    dark = len(table) - 1
    for sample in range(0, samples, 4):
        for receiver in range(tile):
            a, b, c, d = dark, dark, dark, dark
            if cells[sample, receiver] >= 0:
                a = cells[sample, receiver]
            if sample + 1 < samples and cells[sample + 1, receiver] >= 0:
                b = cells[sample + 1, receiver]
            if sample + 2 < samples and cells[sample + 2, receiver] >= 0:
                c = cells[sample + 2, receiver]
            if sample + 3 < samples and cells[sample + 3, receiver] >= 0:
                d = cells[sample + 3, receiver]
            for k in range(table.shape[1]):
                sums[receiver, k] += (table[a, k] + table[b, k]) + (table[c, k] + table[d, k])


@compiled
def _store(sums: np.ndarray, texels: np.ndarray, scale: np.floating, out: np.ndarray) -> None:
    """Turns rows of texels into columns of maps."""
    for lighting in range(out.shape[0]):
        for receiver in range(len(texels)):
            for channel in range(3):
                out[lighting, texels[receiver], channel] = scale * sums[receiver, 3 * lighting + channel]


@compiled
def _add_nearness(cells: np.ndarray, distance: np.ndarray, near: np.ndarray) -> None:
    """Sums 1 / distance; Embree gives rays that escape a distance of 1e37."""
    for sample in range(cells.shape[0]):
        for receiver in range(cells.shape[1]):
            near[receiver] += 1 / max(distance[sample, receiver], np.float32(1e-30))
