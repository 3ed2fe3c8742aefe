"""Subsurface scattering in closed bodies, as an operator: R, from light that enters to light that leaves, traced once.

A row of R is a texel or sender of a body's surface, an entry the share of the light that falls on a sender and leaves there.
It is found backwards, by reciprocity: walks (`ddprt.transport.random_walk`) go in where light will be seen to come out, spread
over directions by the cosine, and land where it entered. So rows are stratified as those of G are, and a lighting more costs a
product. What a row times light gives is radiosity, W/m², before the material's albedo multiplies it: all that leaves, averaged
over the hemisphere. Lightmaps hold that where surfaces that are opaque hold irradiance, and both are multiplied by the albedo.

R takes light to fall on the surface from everywhere alike. Through a refractive surface light enters the less the flatter it
comes: `Inside.entering` weighs every lamp by Fresnel's transmittance at its own angle, so that the amount that enters is that
of the lamp; only its direction until it is first scattered stays an average. docs/effects.md tells the bias.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float32, Float64, Int, Int32
from ddprt.lights import Light, Lighting
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import BLOCK, centred
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.footprint import Footprints, find_footprints
from ddprt.transport.gather import Landing, Receivers, landed_on
from ddprt.transport.random_walk import Body
from ddprt.transport.refraction import entered, fresnel, mean_entering
from ddprt.transport.translucency import filled

_SENDER_WALKS = 64  # of each sender: their noise is averaged once more by what sees it
_PROBED, _PILOT = 512, 32  # texels, and walks of each in two independent runs, that predict how many are needed
_LEAST, _MOST = 16, 8192  # walks per texel that "auto" may choose
_SHARED = 0.0, 0.4, 0.5, 0.6, 0.75, 1.0  # standard deviations, in texels, of footprints that may share walks
_JUDGED = 32  # lightings that tell which is best
_ANGLES = 4  # places of a texel where the angle of lamps is looked at

Matrix = Any
"""A sparse matrix of SciPy's."""


@dataclass(frozen=True, eq=False)
class Inside:
    """R of a scene.

    Attributes:
      tracer, atlas: the scene.
      bodies: what light passes, and the scene's triangles that shut each in.
      body: of each triangle of the scene, -1 for opaque ones.
      landing: from hits to rows of `senders`.
      texels, senders: those on bodies, in rising order.
      receivers: makes receivers of so many walks: of `senders` by default, of texels where some are given.
    """

    tracer: Tracer
    atlas: Atlas
    bodies: tuple[tuple[Body, Int32[np.ndarray, " own"]], ...]
    body: Int[np.ndarray, " triangles"]
    landing: Landing
    texels: Int[np.ndarray, " texels"]
    senders: Int[np.ndarray, " senders"]
    receivers: Callable[..., Receivers]

    @classmethod
    def of(cls, operator: Any, scene: Scene, *, jumps: bool = True) -> "Inside":
        """R among an operator's senders.

        Args:
          operator: `ddprt.transport.operator.Operator` of the scene.
          scene: its materials.
          jumps: False walks every step (see `random_walk`).
        """
        tracer, atlas, senders = operator.tracer, operator.atlas, operator.senders
        chosen = np.array(filled(scene))
        number = np.where(chosen, np.cumsum(chosen) - 1, -1)
        body = number[scene.material]
        bodies = []
        for index in np.flatnonzero(chosen):
            medium, own = scene.materials[index].subsurface, np.flatnonzero(scene.material == index).astype(np.int32)
            assert medium is not None
            bodies.append((Body.of(medium, tracer.corners[own], float(tracer.offset), jumps=jumps), own))
        of_texel = np.full(atlas.count, -1)  # pieces of a texel share its chart, and so its body
        of_texel[atlas.piece_texel] = body[atlas.piece_triangle]
        texels = np.flatnonzero(of_texel >= 0)
        rows = np.unique(senders.of_texel[texels])
        row_of = np.full(senders.count, -1, np.int32)
        row_of[rows] = np.arange(len(rows))

        def receivers(samples: int, seed: int, stream: str, some: Any = None) -> Receivers:
            if some is not None:
                return Receivers.texels(atlas, samples, seed, stream, some)
            return Receivers.of(senders.sampler, rows, senders.row[rows], senders.column[rows], samples, seed, stream)

        landing = Landing.of(atlas, row_of[senders.of_texel])
        return cls(tracer, atlas, tuple(bodies), body, landing, texels, rows, receivers)

    @cached_property
    def indices(self) -> set[float]:
        """Of refraction, of all bodies."""
        return {body.index for body, _ in self.bodies}

    @cached_property
    def largest(self) -> float:
        """Share of light from everywhere that enters the body that takes most."""
        return max(map(mean_entering, self.indices), default=0.0)

    def matrix(self, *, seed: int, stream: str) -> "Passage":
        """R among the senders on bodies."""
        receivers = self.receivers(_SENDER_WALKS, seed, f"{stream} inside senders")
        parts = list(self._rows(receivers, seed, f"{stream} inside senders"))
        from scipy.sparse import vstack

        return Passage(
            tuple(vstack([part[channel] for part in parts], format="csr") for channel in range(3)), self.senders, self.largest
        )

    def leave(
        self,
        arrived: Float32[np.ndarray, "senders columns"],
        samples: int,
        *,
        seed: int,
        stream: str,
        texels: Int[np.ndarray, " some"] | None = None,
    ) -> Iterator[tuple[Int[np.ndarray, " tile"], Float32[np.ndarray, "lightings tile 3"]]]:
        """Light that leaves texels of bodies, tile by tile.

        Args:
          arrived: on the senders of bodies, W/m²; columns (lighting, channel).
          samples: walks per texel.
          seed, stream: address of the random numbers.
          texels: in rising order; all of bodies unless given.
        Yields:
          The texels, and what leaves them, W/m².
        """
        wanted = self.texels if texels is None else texels
        receivers = self.receivers(samples, seed, f"{stream} inside", wanted)
        first = 0
        for rows in self._rows(receivers, seed, f"{stream} inside"):
            count = rows[0].shape[0]
            light = Passage(rows, self.senders, self.largest).of(arrived).reshape(count, -1, 3)
            yield wanted[first : first + count], light.swapaxes(0, 1)
            first += count

    def whole(
        self,
        arrived: Float32[np.ndarray, "senders columns"],
        samples: int,
        told: Callable[[int], Any],
        *,
        seed: int,
        stream: str,
    ) -> tuple[Float32[np.ndarray, "lightings inside 3"], dict[str, float]]:
        """The same of all texels of bodies at once, and no facts; `told` hears of each tile's number of texels."""
        values, first = np.empty((arrived.shape[1] // 3, len(self.texels), 3), np.float32), 0
        for tile, light in self.leave(arrived, samples, seed=seed, stream=stream):
            values[:, first : first + len(tile)] = light
            first += len(tile)
            told(len(tile))
        return values, {}

    def borrowed(
        self,
        arrived: Float32[np.ndarray, "senders columns"],
        samples: int,
        told: Callable[[int], Any],
        *,
        seed: int,
        stream: str,
    ) -> tuple[Float32[np.ndarray, "lightings inside 3"], dict[str, float]]:
        """The same from two halves of the walks, with what `shared` makes of them; `told` hears of each texel twice."""
        one, other = (
            self.whole(arrived, walks, told, seed=seed, stream=f"{stream} part {part}")[0]
            for part, walks in enumerate((samples - samples // 2, samples // 2))
        )
        return self.shared(one, other)

    def shared(
        self, one: Float32[np.ndarray, "lightings inside 3"], other: Float32[np.ndarray, "lightings inside 3"]
    ) -> tuple[Float32[np.ndarray, "lightings inside 3"], dict[str, float]]:
        """The mean of two independent halves, texels sharing walks with neighbours as far as the halves say that it pays.

        A mean over neighbours trades noise for detail. The halves tell both: their difference what noise it leaves, and the
        product of what it changes in one and in the other, whose noise is independent, how much detail it takes.

        Args:
          one, other: light that leaves all texels of bodies, from `whole`.
        Returns:
          The light; standard deviation of the footprints in texels, and relative RMSE to expect, noise and lost detail.
        """
        count = one.shape[0]
        some = np.unique(np.linspace(0, count - 1, min(count, _JUDGED)).astype(int))
        weight = self.atlas.area[self.texels] / self.atlas.area[self.texels].sum()

        def mean(values: np.ndarray) -> float:
            return float(np.einsum("tc,t->", values.reshape(len(values), -1), weight, dtype=np.float64) / values[0].size)

        def beside(light: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(light.swapaxes(0, 1).reshape(len(self.texels), -1))

        a, b = beside(one[some]), beside(other[some])
        errors = [mean((a - b) ** 2) / 4]
        for share in _SHARED[1:]:
            near = self._footprints(share)
            c, d = near.pooled(a), near.pooled(b)
            errors.append(max(mean((c - a) * (d - b)), 0.0) + mean((c - d) ** 2) / 4)
        best, level = int(np.argmin(errors)), max(mean(a) / 2 + mean(b) / 2, float(np.finfo(np.float32).tiny))
        light = (one + other) / 2
        if best:
            pooled = self._footprints(_SHARED[best]).pooled(beside(light))
            light = np.ascontiguousarray(pooled.reshape(len(self.texels), -1, 3).swapaxes(0, 1))
        return light, {"shared_over": _SHARED[best], "error_expected": float(f"{errors[best] ** 0.5 / level:.3g}")}

    def _footprints(self, share: float) -> Footprints:
        """Of the texels of bodies alone, with a standard deviation in texels."""
        wide = find_footprints(self.atlas, np.full(self.atlas.count, self.atlas.texels_per_metre), share)
        own = np.full(self.atlas.count + 1, -1, np.int32)  # the last is that of no texel
        own[self.texels] = np.arange(len(self.texels))
        return Footprints(wide.weight[self.texels], own[wide.slot], wide.centre[self.texels])

    def choose(
        self, arrived: Float32[np.ndarray, "senders columns"], target: float, *, seed: int, stream: str
    ) -> tuple[int, float]:
        """Walks per texel that a target for the noise takes, and the noise to expect: RMSE of all maps over their mean."""
        if not len(self.texels):
            return _LEAST, 0.0
        odds = self.atlas.area[self.texels] / self.atlas.area[self.texels].sum()
        drawn = seeds.stream(seed, "inside probes", *stream.encode()).choice(self.texels, _PROBED, p=odds)
        some, times = np.unique(drawn, return_counts=True)
        runs = list[np.ndarray]()
        for run in range(2):
            tiles = self.leave(arrived, _PILOT, seed=seed, stream=f"{stream} pilot {run}", texels=some)
            runs.append(np.concatenate([light for _, light in tiles], 1))
        one, other = (run.astype(np.float64) for run in runs)
        values = 3 * len(one) * _PROBED
        mean = float(((one + other) / 2).sum((0, 2)) @ times) / values
        if mean == 0:
            return _LEAST, 0.0
        single = _PILOT * float((((one - other) / mean) ** 2).sum((0, 2)) @ times) / values / 2
        samples = int(np.clip(8 * np.ceil(single / target**2 / 8), _LEAST, _MOST))
        return samples, float(np.sqrt(single / samples))

    def _rows(self, receivers: Receivers, seed: int, stream: str) -> Iterator[tuple[Matrix, Matrix, Matrix]]:
        """R's rows of some receivers, tile by tile, for each channel."""

        def work(tile: slice) -> tuple[tuple[Matrix, Matrix, Matrix], int]:
            rng = seeds.stream(seed, "inside", *stream.encode(), receivers.samples, int(receivers.patch[tile.start]))
            count, parts, rays = tile.stop - tile.start, list[tuple[np.ndarray, np.ndarray, np.ndarray]](), 0
            for owner, places, towards, triangle in _starts(self.tracer, receivers, tile):
                for number, (body, own) in enumerate(self.bodies):
                    of = np.flatnonzero(self.body[triangle] == number)
                    if not len(of):
                        continue
                    normals = self.tracer.normals[triangle[of]]
                    inwards, share = entered(towards[of], normals, body.index)
                    start = places[of] - np.float32(body.offset) * normals
                    found = body.walk(start, inwards, np.repeat(share[:, None], 3, 1), rng)
                    out = found.direction
                    cells = landed_on(self.tracer, self.landing, -out, own[found.triangle], found.u, found.v)
                    lit = np.flatnonzero(cells >= 0)
                    parts.append((owner[of][found.owner[lit]], cells[lit], found.weight[lit]))
                    rays += found.rays
            return _sparse(parts, (count, len(self.senders)), receivers.samples), rays

        for rows, rays in self.tracer.map(work, receivers.tiles()):
            self.tracer.rays += rays  # by the one who waits for all others
            yield rows

    def entering(
        self,
        light: Float32[np.ndarray, "texels 3"],
        lighting: Lighting,
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "texels 3"]:
        """Irradiance from everywhere alike of which as much would enter bodies as of what falls on them.

        Where one lamp without size is all there is, what falls on a texel comes from it, and no ray is needed. Otherwise a
        texel's share is that of a few places with shadow rays of their own.

        Args:
          light: direct irradiance on all texels, W/m².
          lighting: that it comes from, world space.
          rng: for places on texels, and for lights with size.
        """
        if self.indices <= {1.0} or not light[self.texels].any():
            return light
        out, lamps = light.copy(), centred(self.tracer, lighting)
        alone = len(lamps) == 1 and lamps[0].delta
        step = BLOCK // _ANGLES
        for low in range(0, len(self.texels), step):
            some = self.texels[low : low + step]
            u = rng.random((len(some) * _ANGLES, 2), np.float32)
            places, triangle = self.atlas.sampler.sample(np.repeat(some, _ANGLES), u)
            index = np.array([body.index for body, _ in self.bodies])[self.body[triangle]]
            normals = self.tracer.normals[triangle]
            sums = np.zeros((2, 2, len(some), 3))  # shadows or none; all, what enters
            for lamp in lamps:
                numbers = rng.random((len(places), 2), np.float32)
                sums += (
                    _weighed(self.tracer, lamp, places, normals, index, numbers, alone).reshape(2, 2, len(some), -1, 3).sum(3)
                )
            shaded = sums[0, 0] > 0
            whole, passed = np.where(shaded, sums[0], sums[1])
            out[some] *= np.divide(passed, whole, out=np.ones_like(whole), where=whole > 0).astype(np.float32)
        return out


@dataclass(frozen=True, eq=False)
class Passage:
    """Rows of R for each channel.

    Attributes:
      channels: sparse, from senders on bodies to receivers.
      senders: those on bodies.
      largest: share of light from everywhere that a body sends out, at most: what enters. Sums of rows vary about less.
    """

    channels: tuple[Matrix, ...]
    senders: Int[np.ndarray, " senders"]
    largest: float

    def of(self, light: Float32[np.ndarray, "senders columns"]) -> Float32[np.ndarray, "receivers columns"]:
        """What leaves of light that arrives."""
        out = np.empty((self.channels[0].shape[0], light.shape[1]), np.float32)
        for channel, rows in enumerate(self.channels):
            out[:, channel::3] = rows @ np.ascontiguousarray(light[:, channel::3])
        return out


def _starts(
    tracer: Tracer, receivers: Receivers, tile: slice
) -> Iterator[tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]]:
    """Where walks of a tile begin, some samples at a time: receiver, place, outward direction, triangle of the scene."""
    pattern, block, turn = receivers.pattern, receivers.block[tile], receivers.turn[tile]
    cosine, sine = turn.T
    step = max(1, BLOCK // len(block))
    for first in range(0, receivers.samples, step):
        chunk = slice(first, first + step)
        places, triangle = receivers.sampler.spread(receivers.patch[tile], pattern.place[chunk], block)
        x, y = np.moveaxis(np.take(pattern.disk[chunk], block, axis=1), 2, 0)
        z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
        local = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], 2).reshape(-1, 3)
        owner = np.tile(np.arange(len(block), dtype=np.int32), len(x))
        yield owner, places, warp.to_world(local, tracer.frames[triangle]), triangle


def _sparse(
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]], shape: tuple[int, int], samples: int
) -> tuple[Matrix, Matrix, Matrix]:
    """A matrix for each channel of the same pattern: weights of walks, added up by receiver and cell, over their number."""
    from scipy.sparse import csr_array

    if not parts:
        return tuple(csr_array(shape, dtype=np.float32) for _ in range(3))
    owner, cell, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    key = owner.astype(np.int64) * shape[1] + cell
    order = np.argsort(key, kind="stable")
    key, weight = key[order], weight[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    row, column = np.divmod(key[first], shape[1])
    values = np.add.reduceat(weight, first, axis=0) / np.float32(samples) if len(first) else np.zeros((0, 3), np.float32)
    begin = np.searchsorted(row, np.arange(shape[0] + 1))
    red, green, blue = (csr_array((values[:, channel].copy(), column, begin), shape=shape) for channel in range(3))
    return red, green, blue


def _weighed(
    tracer: Tracer,
    lamp: Light,
    places: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    index: Float64[np.ndarray, " n"],
    numbers: Float32[np.ndarray, "n 2"],
    alone: bool,
) -> Float64[np.ndarray, "2 2 n 3"]:
    """A lamp's light at places, with shadows (which a lamp that is alone needs not) and without: all, and what of it enters.

    What enters is told as if it came from everywhere: over the mean transmittance.
    """
    origins = lifted(tracer, places, normals)
    sample = lamp.illuminate(origins, numbers, None, normals)
    towards = np.ascontiguousarray(sample.direction)
    cosine = np.maximum(np.einsum("nd,nd->n", normals, towards), 0).astype(np.float64)
    light = cosine[:, None] * sample.irradiance.astype(np.float64)
    passing = np.empty(len(places))
    for one in np.unique(index):
        of = index == one
        inner = np.sqrt(1 - (1 - np.minimum(cosine[of], 1) ** 2) / one**2)
        passing[of] = (1 - fresnel(cosine[of], inner, float(one))) / mean_entering(float(one))
    seen = np.ones(len(places))
    if not alone:
        seen = (
            tracer.unoccluded(origins, towards, np.maximum(sample.distance - tracer.offset, 0).astype(np.float32)) != 0
        ) * 1.0
    both = np.stack([light, light * passing[:, None]])
    return np.stack([both * seen[:, None], both])
