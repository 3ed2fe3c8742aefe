"""A fibre seen from so far that its width does not show: the phase of `ddprt.transport.fibre`, averaged over the offset h.

Where a path meets a strand from afar, h is as evenly spread as the strand is wide, and nothing else that a lamp's light there
depends on knows it: shadow rays start from the axis. So the mean over h is what the lamp gives on average, and it is smoother
than the phase of any one h. From nearby this is not so: rays from one place that pass a fibre on either side of its axis differ
in direction by its width over the distance, and what it focuses changes by as much. Who is `close` keeps the offset of its ray.

A lobe's longitudinal part knows no h; only what it leaves and where it turns do. Their mean is a table over the angle with the
plane across the fibre, its absorption, and the turn about it:

    f(light, viewer) = sum over lobes p of M_p(theta_light, theta_viewer) AN_p(turn; theta_viewer, absorption),
    AN_p = mean over h of A_p(h) N(turn - Phi_p(h)).

In the turn the table is interpolated, light by light. Between its rows over angle and absorption, a vertex chooses once for all
lights, by a number that is evenly spread: the mean of that is linear interpolation too (over triangles of the grid). Its number
is the offset of the ray, of which nothing else of the light at a vertex makes use any more.

Reference: Marschner et al., "Light Scattering from Human Hair Fibers", SIGGRAPH 2003, 5, for the sum over h.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ddprt.axes import Bool, Float, Float32, Float64, Int32
from ddprt.compiled import compiled
from ddprt.lights import Light
from ddprt.scene.material import Fibre
from ddprt.transport import fibre
from ddprt.transport.walk import Vertices

_ANGLES, _CLARITIES = 33, 33  # rows: angle with the plane across from 0 to 90 degrees, exp(-absorption) from 0 to 1
_ROOTS = 513  # of the product of both cosines, where the longitudinal part is tabulated
_FINE = 16.0  # steps of the turn, and of the sum over h, for a scale of the azimuthal part of 1
_LEAST, _MOST = 64, 768  # of these
_RECORD = 32  # numbers of a vertex
_FAINT = 8.0  # as `walk.FAINT`: shadow rays are most of the work in fur (docs/effects.md, Hair)
_NOTHING = np.float32(-0.75)  # a 32nd of an exponent below which a lobe stays 6e-11 of its peak
_ALONG = np.float32(1e-12)  # light along a fibre has no turn


@dataclass(frozen=True, eq=False)
class FarFibre:
    """Tables of one material.

    Attributes:
      around: AN_p, 1/rad, for rows of angle and clarity, steps of the turn from 0 (the viewer's side) to pi, and lobes.
      along: the longitudinal part without its exponential, for steps of the root of the product of both cosines, and lobes.
      sharp: 1 / (32 variances) of the longitudinal part.
    """

    around: Float32[np.ndarray, "rows turns 4"]
    along: Float32[np.ndarray, "roots 4"]
    sharp: Float32[np.ndarray, "4"]

    @classmethod
    def of(cls, material: Fibre) -> "FarFibre":
        """Sums over h in float64."""
        shape = fibre.shape_of(material)
        fine = 2 * int(np.clip(np.ceil(_FINE / shape[4] / 2), _LEAST // 2, _MOST // 2))
        angle, clarity = np.linspace(0, np.pi / 2, _ANGLES), np.linspace(0, 1, _CLARITIES)
        entering = (np.arange(fine) + 0.5) / fine * np.pi / 2  # h is its sine: at grazing rays turns change fast with h
        offset, share = np.tile(np.sin(entering), _CLARITIES), np.cos(entering) / np.cos(entering).sum()
        depth = np.repeat(-np.log(np.maximum(clarity, 1e-12)), fine)
        absorption = np.stack([depth, depth, depth], 1)
        step = np.linspace(0, 2, fine + 1)
        turn = np.arctan2(np.where(step < 1, step, 2 - step), 1 - step)  # see `_phase`
        around = np.empty((_ANGLES, _CLARITIES, fine + 1, 4))
        for row, seen in enumerate(np.sin(angle)):
            held = fibre.prepared(np.full(len(offset), seen), offset, absorption, material).astype(np.float64)
            passed = held[:, fibre.PASS :: 3].reshape(_CLARITIES, fine, 4)
            _add_around(passed, share, held[:fine, fibre.TURN : fibre.TURN + 3], turn, shape, around[row])
        cosine = np.linspace(0, 1, _ROOTS) ** 2
        along = [_scaled_bessel(cosine / variance) / (variance * -np.expm1(-2 / variance)) for variance in shape[:4]]
        rows = around.reshape(-1, fine + 1, 4).astype(np.float32)
        return cls(rows, np.stack(along, 1).astype(np.float32), (1 / (32 * shape[:4])).astype(np.float32))

    def rows(
        self, sine: Float[np.ndarray, " n"], absorption: Float[np.ndarray, "n 3"], number: Float[np.ndarray, " n"]
    ) -> Int32[np.ndarray, "n 3"]:
        """Rows of `around` for each channel.

        Args:
          sine: of the angle between the viewer's direction and the plane across the fibre.
          absorption: optical depth of a radius.
          number: from 0 to 1, evenly spread; chooses between neighbouring rows.
        """
        angle = np.arcsin(np.minimum(np.abs(sine.astype(np.float64)), 1)) / (np.pi / 2) * (_ANGLES - 1)
        clear = np.exp(-absorption.astype(np.float64)) * (_CLARITIES - 1)
        row = np.minimum(np.floor(angle + number), _ANGLES - 1)[:, None]
        column = np.minimum(np.floor(clear + number[:, None]), _CLARITIES - 1)
        return (row * _CLARITIES + column).astype(np.int32)

    def seen(
        self,
        there: Vertices,
        frames: Float32[np.ndarray, "n 3 3"],
        reach: Float32[np.ndarray, " n"],
        held: Float32[np.ndarray, "n 23"],
        rows: Int32[np.ndarray, "n 3"],
        shape: fibre.Shape,
        close: Bool[np.ndarray, " n"],
    ) -> "FarVertices":
        """Vertices ready for lamps.

        Args:
          there: points on the axis, and pi times what each W/(m² sr) that leaves towards the viewer is worth.
          frames: rows along the fibre, across it towards the viewer, and across both.
          reach: how far off the axis shadow rays start.
          held: see `fibre.prepared`.
          rows: see `rows`.
          shape: see `fibre.shape_of`.
          close: seen from so near that their own offset counts.
        """
        record = np.empty((len(reach), _RECORD), np.float32)
        _record(there.place, frames, reach, held, there.throughput, self.sharp, record)
        return FarVertices(there, record, rows, held, close, shape, self)


@dataclass(frozen=True, eq=False)
class FarVertices:
    """Where paths met strands, as lamps see them: `ddprt.transport.walk.Meetings`.

    Attributes:
      there: see `FarFibre.seen`; normals mean nothing.
      record: all that a light's weight needs of each but its rows, one after another in memory; see `_record`.
      rows, held, close, shape: see `FarFibre.seen`.
      far: the tables.
    """

    there: Vertices
    record: Float32[np.ndarray, "n 32"]
    rows: Int32[np.ndarray, "n 3"]
    held: Float32[np.ndarray, "n 23"]
    close: Bool[np.ndarray, " n"]
    shape: fibre.Shape
    far: FarFibre

    @classmethod
    def joined(cls, parts: "Sequence[FarVertices]") -> "FarVertices":
        """One list of many."""
        record, rows = np.concatenate([part.record for part in parts]), np.concatenate([part.rows for part in parts])
        held, close = np.concatenate([part.held for part in parts]), np.concatenate([part.close for part in parts])
        there = Vertices.joined([part.there for part in parts])
        return cls(there, record, rows, held, close, parts[0].shape, parts[0].far)

    @property
    def place(self) -> Float32[np.ndarray, "6 n"]:
        """Points on the axis."""
        return self.there.place

    @property
    def owner(self) -> Int32[np.ndarray, " n"]:
        """The receivers."""
        return self.there.owner

    @property
    def facing(self) -> None:
        """Light from all sides counts."""

    def blocks(self) -> "Iterator[FarVertices]":
        """Parts of about equal size that fit into a core's cache."""
        first = 0
        for there in self.there.blocks():
            part = slice(first, first + len(there.owner))
            own = self.record[part], self.rows[part], self.held[part], self.close[part]
            yield FarVertices(there, *own, self.shape, self.far)
            first = part.stop

    def under(self, light: Light, start: Float32[np.ndarray, "3"]) -> "FarVertices":
        """Where the light of one lamp is asked for: here, whichever it is."""
        return self

    def lit_from(self, directions: Float32[np.ndarray, "n 3"]) -> Vertices:
        """What each W/m² that arrives from directions, on a plane that faces it, is worth to the receivers.

        Shadow rays start outside of the prism; their normals are the directions themselves, which weigh nothing.
        """
        place, throughput = np.empty_like(self.there.place), np.empty_like(self.there.throughput)
        _light(self.record, self.rows, directions, self.far.around, self.far.along, place, throughput)
        close = np.flatnonzero(self.close)
        if len(close):
            local = np.einsum("nij,nj->ni", self.record[close, :9].reshape(-1, 3, 3), directions[close])
            throughput[:, close] = (self.record[close, 29:] * fibre.phase(self.held[close], self.shape, local)).T
        return Vertices(place, throughput, self.there.owner, _FAINT)


def _scaled_bessel(x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Bessel's I0 times exp(-x)."""
    from scipy.special import i0e

    return np.asarray(i0e(x), np.float64)


@compiled
def _add_around(
    passed: np.ndarray, share: np.ndarray, turned: np.ndarray, turns: np.ndarray, shape: np.ndarray, found: np.ndarray
) -> None:
    """Sums over offsets h > 0; those below it turn the other way."""
    found[:] = 0
    scale, left = shape[4], shape[5]
    for i in range(len(share)):
        for j in range(len(turns)):
            for p in range(4):
                density = 1 / np.pi
                if p < 3:
                    density = 0.0
                    for sign in (-1.0, 1.0):
                        angle = turns[j] + sign * turned[i, p]
                        away = abs(angle - 2 * np.pi * np.round(angle / (2 * np.pi)))
                        decay = np.exp(-away / scale)
                        density += decay / (scale * (1 + decay) * (1 + decay) * left)
                density *= 0.5 * share[i]
                for clarity in range(len(passed)):
                    found[clarity, j, p] += density * passed[clarity, i, p]


@compiled
def _record(
    place: np.ndarray,
    frames: np.ndarray,
    reach: np.ndarray,
    held: np.ndarray,
    throughput: np.ndarray,
    sharp: np.ndarray,
    record: np.ndarray,
) -> None:
    """The frame, a point, the reach; sines and cosines of four tilts over 32 variances, roots of these cosines, 1 over 32
    variances; the throughput."""
    for i in range(len(record)):
        row = record[i]
        for k in range(3):
            row[k], row[3 + k], row[6 + k] = frames[i, 0, k], frames[i, 1, k], frames[i, 2, k]
            row[9 + k], row[29 + k] = place[k, i], np.float32(np.pi) * throughput[k, i]
        row[12] = reach[i]
        for p in range(4):
            row[13 + p], row[17 + p] = held[i, p] * sharp[p], held[i, 4 + p] * sharp[p]
            row[21 + p], row[25 + p] = np.sqrt(held[i, 4 + p]), sharp[p]


@compiled
def _light(
    record: np.ndarray,
    rows: np.ndarray,
    directions: np.ndarray,
    around: np.ndarray,
    along: np.ndarray,
    place: np.ndarray,
    found: np.ndarray,
) -> None:
    """Shadow rays, and throughput times pi times the phase.

    The turn is told without an angle, by the sum of both coordinates' sizes: 0 before, 1 beside and 2 behind the fibre. The
    exponential of x is (1 + x/32 + ...)^32 by four terms, which is right to 3e-4 above exp(-8). Branches would cost more than
    they spare.
    """
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    half, sixth, last_term = np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24)
    steps, roots = np.float32((around.shape[1] - 1) / 2), np.float32(len(along) - 1)
    last, last_root, following = around.shape[1] - 2, len(along) - 2, np.uint32(1)
    lobes = np.empty(4, np.float32)
    for i in range(len(record)):
        row = record[i]
        to_x, to_y, to_z = directions[i, 0], directions[i, 1], directions[i, 2]
        x = row[0] * to_x + row[1] * to_y + row[2] * to_z
        y = row[3] * to_x + row[4] * to_y + row[5] * to_z
        z = row[6] * to_x + row[7] * to_y + row[8] * to_z
        cosine = np.sqrt(y * y + z * z)
        off = row[12] / max(cosine, _ALONG)
        for k in range(3):
            place[k, i] = row[9 + k] + off * (y * row[3 + k] + z * row[6 + k])
        place[3, i], place[4, i], place[5, i] = to_x, to_y, to_z
        step = abs(z) / max(abs(z) + abs(y), _ALONG)
        step = steps * (step if y >= zero else two - step)
        low = np.uint32(min(int(step), last))  # unsigned: Numba looks at other indices for negative ones
        step -= np.float32(low)
        root = roots * np.sqrt(cosine)
        for p in range(4):
            part = max(cosine * row[17 + p] - x * row[13 + p] - row[25 + p], _NOTHING)
            power = one + part * (one + part * (half + part * (sixth + part * last_term)))
            power *= power
            power *= power
            power *= power
            power *= power
            lobes[p] = power * power
        for p in range(4):
            where = root * row[21 + p]
            cell = np.uint32(min(int(where), last_root))
            where -= np.float32(cell)
            lobes[p] *= along[cell, p] + where * (along[cell + following, p] - along[cell, p])
        for channel in range(3):
            total, chosen = zero, np.uint32(rows[i, channel])
            for p in range(4):
                value = around[chosen, low, p]
                total += lobes[p] * (value + step * (around[chosen, low + following, p] - value))
            found[channel, i] = total * row[29 + channel]
