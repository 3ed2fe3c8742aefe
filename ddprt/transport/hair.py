"""Hair on the way of light: where paths begin on strands or meet one, and what they carry on from there.

A strand is traced as a prism (`ddprt.scene.tubes`) and scatters as the round fibre that it stands for
(`ddprt.transport.fibre`). Where a ray meets the prism tells how far off the axis it passes: its place within the prism's
outline as seen by the ray, which is as evenly spread as that of rays on a round fibre. What leaves the fibre starts on its
axis, moved out of the prism across it.

A texel of a strand keeps pi times the radiance that leaves it, averaged about the fibre and over directions as a surface
that they leave does, by the cosine with the plane across it: W/m², as the radiosity of its side area. By exchanging both
integrals that is the light that falls on the fibre, weighed by what it makes of light from there (`fibre.gains`). Rays that
leave the prism's faces by their cosine are spread as its outline is wide, and so the first rays of all paths are those of any
surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ddprt.axes import Float32, Float64, Int32
from ddprt.compiled import compiled
from ddprt.scene.material import Fibre
from ddprt.scene.mesh import SIDES, Scene
from ddprt.scene.tubes import CORNER, ring_corners
from ddprt.transport import fibre
from ddprt.transport.embree import Tracer
from ddprt.transport.far_fibre import FarFibre, FarVertices
from ddprt.transport.walk import MAX_SURVIVAL, SURVIVAL, Vertices

_FAR = 8.0  # reaches of a fibre, across it, from which its width hardly shows: see docs/effects.md
_NOT_ACROSS = 1e-6  # sine of the angle between ray and fibre below which any direction across will do


@dataclass(frozen=True, eq=False)
class FibreVertices:
    """Where paths met strands, and what they go on from.

    Attributes:
      there: points on the axis (the normal is the direction across it towards the viewer) and receivers; the throughput is what
        a receiver gains for each W/(m² sr) that leaves towards the path's last vertex, over pi.
      frames: rows along the fibre, across it towards the viewer, and across both.
      reach: of the prism from its axis, metres.
      held: see `fibre.prepared`.
      shape: see `fibre.shape_of`.
      far: the same for lamps.
    """

    there: Vertices
    frames: Float32[np.ndarray, "n 3 3"]
    reach: Float32[np.ndarray, " n"]
    held: Float32[np.ndarray, "n 23"]
    shape: Float64[np.ndarray, "6"]
    far: FarVertices

    @classmethod
    def joined(cls, parts: "Sequence[FibreVertices]") -> FarVertices:
        """What lamps see of many."""
        return FarVertices.joined([part.far for part in parts])

    def scattered(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins and directions that light may come from, and phase over density."""
        local, weight = fibre.sample(self.held, self.shape, rng.random((len(self.reach), 4), np.float32))
        directions = np.einsum("ni,nij->nj", local, self.frames).astype(np.float32)
        place, again = np.empty_like(self.there.place), np.empty_like(local)
        _leave(self.there.place, self.frames, self.reach, directions, again, place)
        return np.ascontiguousarray(place[:3].T), directions, weight

    def go_on(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Origins and directions of the paths that survive roulette, their throughput and receivers."""
        origins, directions, weight = self.scattered(rng)
        throughput = self.there.throughput * weight.T
        survival = np.minimum(np.float32(SURVIVAL) * throughput.max(0), np.float32(MAX_SURVIVAL))
        kept = np.flatnonzero(rng.random(len(survival), np.float32) < survival)
        return origins[kept], directions[kept], throughput[:, kept] / survival[kept], self.there.owner[kept]


@dataclass(frozen=True, eq=False)
class Hair:
    """The strands of a scene.

    Attributes:
      tracer: the geometry.
      first: triangle that they begin with; all after it are theirs.
      pieces: of a strand.
      rings: axis and corners of the prisms, centred frame, metres.
      reach: of each ring from its axis, metres, with what keeps rays off it.
      absorption: optical depth of a radius, for each strand and channel.
      material: how they scatter.
      gains: see `fibre.gains`.
      far: tables of the phase averaged over offsets.
      near: reaches of a fibre, across it, within which lamps are weighed by the offset of the very ray; beyond, by tables.
    """

    tracer: Tracer
    first: int
    pieces: int
    rings: Float32[np.ndarray, "rings points 3"]
    reach: Float32[np.ndarray, " rings"]
    absorption: Float64[np.ndarray, "strands 3"]
    material: Fibre
    gains: Float64[np.ndarray, "clarities angles"]
    far: FarFibre
    near: float

    @classmethod
    def of(cls, tracer: Tracer, scene: Scene, smooth: bool = False) -> "Hair":
        """Those of a scene that has some, of a material with a fibre; the tables are for `smooth` ones alone."""
        tubes, made_of = scene.tubes, scene.strand_material
        assert tubes is not None
        assert made_of is not None
        material = made_of.fibre
        assert material is not None
        corners = ring_corners(tubes)
        rings = np.concatenate([tubes.axis[:, :, None], corners], 2) - tracer.centre
        colour = fibre.absorption_of(tubes.colour, material.around)
        absorption = (
            colour if material.absorption is None else np.tile(np.array(material.absorption, np.float64), (len(colour), 1))
        )
        reach = (CORNER * tubes.radius).ravel().astype(np.float32) + tracer.offset
        first = len(scene.triangles) - tubes.triangles
        rows = np.ascontiguousarray(rings.reshape(-1, 1 + SIDES, 3), np.float32)
        tables = fibre.gains(material), FarFibre.of(material), _FAR if smooth else np.inf
        return cls(tracer, first, tubes.pieces, rows, reach, absorption, material, *tables)

    def seen(
        self,
        triangle: Int32[np.ndarray, " n"],
        place: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        throughput: Float32[np.ndarray, "3 n"],
        owner: Int32[np.ndarray, " n"],
        distance: Float32[np.ndarray, " n"],
    ) -> FibreVertices:
        """Strands that someone sees.

        Args:
          triangle, place: of the prisms, and where on them.
          directions: unit, towards the viewer.
          throughput, owner: see `FibreVertices`.
          distance: of the viewer, metres.
        """
        look = self._look(triangle, place, directions)
        absorption = self.absorption[look.strand]
        held = fibre.prepared(look.sine, look.offset, absorption, self.material)
        rows = self.far.rows(look.sine, absorption, (look.offset + 1) / 2)
        there = Vertices(look.rows, throughput, owner)
        shape, across = fibre.shape_of(self.material), np.sqrt(np.maximum(1 - look.sine * look.sine, 0))
        close = distance * across < self.near * look.reach
        far = self.far.seen(there, look.frames, look.reach, held, rows, shape, close)
        return FibreVertices(there, look.frames, look.reach, held, shape, far)

    def _look(
        self,
        triangle: Int32[np.ndarray, " n"],
        place: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
    ) -> "_Look":
        count = len(triangle)
        found = _Look(
            np.empty((count, 3, 3), np.float32),
            np.empty((6, count), np.float32),
            np.empty(count, np.int32),
            *np.empty((4, count), np.float32),
        )
        where = triangle, place, directions, self.first, self.pieces, self.rings, self.reach
        _look(*where, found.frames, found.rows, found.strand, found.reach, found.sine, found.offset, found.width)
        return found

    def met(
        self,
        triangle: Int32[np.ndarray, " n"],
        u: Float32[np.ndarray, " n"],
        v: Float32[np.ndarray, " n"],
        directions: Float32[np.ndarray, "n 3"],
        throughput: Float32[np.ndarray, "3 n"],
        owner: Int32[np.ndarray, " n"],
        distance: Float32[np.ndarray, " n"],
    ) -> tuple[Int32[np.ndarray, " n"], FibreVertices | None]:
        """Triangles that rays hit, -1 now where they are a strand's, and the paths that met one, from whatever side."""
        hit = np.flatnonzero(triangle >= self.first)
        if not len(hit):
            return triangle, None
        others = triangle.copy()
        others[hit] = -1
        place = self.tracer.on_triangle(triangle[hit], u[hit], v[hit])
        return others, self.seen(triangle[hit], place, -directions[hit], throughput[:, hit], owner[hit], distance[hit])

    def begun(
        self,
        origins: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        triangle: Int32[np.ndarray, " n"],
    ) -> Float32[np.ndarray, "3 n"]:
        """Throughput of paths at their first rays; where they leave strands, what these make of light.

        The prism's outline is wider from some sides than from others; the round fibre's is not.
        """
        throughput = np.ones((3, len(triangle)), np.float32)
        mine = np.flatnonzero(triangle >= self.first)
        if len(mine):
            towards = np.ascontiguousarray(directions[mine])
            look = self._look(triangle[mine], origins[mine], towards)
            gain = fibre.gain(self.gains, look.sine, self.absorption[look.strand])
            throughput[:, mine] = (gain * look.width[:, None]).T
        return throughput


@dataclass(frozen=True, eq=False)
class _Look:
    """Lines of sight that meet strands: see `FibreVertices` for frames and reach, `Vertices` for rows.

    Attributes:
      strand: which.
      sine: of the angle with the plane across the fibre.
      offset: how far off the axis they meet it, as a share of the outline's half width.
      width: of the round fibre over that of the prism, seen along them.
    """

    frames: Float32[np.ndarray, "n 3 3"]
    rows: Float32[np.ndarray, "6 n"]
    strand: Int32[np.ndarray, " n"]
    reach: Float32[np.ndarray, " n"]
    sine: Float32[np.ndarray, " n"]
    offset: Float32[np.ndarray, " n"]
    width: Float32[np.ndarray, " n"]


@compiled
def _look(
    triangle: np.ndarray,
    place: np.ndarray,
    towards: np.ndarray,
    first: int,
    pieces: int,
    rings: np.ndarray,
    reach: np.ndarray,
    frames: np.ndarray,
    rows: np.ndarray,
    strand: np.ndarray,
    far: np.ndarray,
    sine: np.ndarray,
    offset: np.ndarray,
    width: np.ndarray,
) -> None:
    """The fibre's frame, its axis next to a place, and how far off it the line of sight passes."""
    axis, across, beside, corner = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(triangle)):
        piece = (triangle[i] - first) // (2 * SIDES)
        strand[i] = piece // pieces
        low = piece + strand[i]  # a strand has a ring more than pieces
        length, along = 0.0, 0.0
        for k in range(3):
            axis[k] = rings[low + 1, 0, k] - rings[low, 0, k]
            length += axis[k] * axis[k]
            along += axis[k] * (place[i, k] - rings[low, 0, k])
        share, length = min(max(along / length, 0.0), 1.0), np.sqrt(length)
        s = 0.0
        for k in range(3):
            axis[k] /= length
            s += axis[k] * towards[i, k]
        size = 0.0
        for k in range(3):
            across[k] = towards[i, k] - s * axis[k]
            size += across[k] * across[k]
        if size < _NOT_ACROSS * _NOT_ACROSS:  # then any will do: the first corner's
            size, s_corner = 0.0, 0.0
            for k in range(3):
                across[k] = rings[low, 1, k] - rings[low, 0, k]
                s_corner += across[k] * axis[k]
            for k in range(3):
                across[k] -= s_corner * axis[k]
                size += across[k] * across[k]
        size = np.sqrt(size)
        for k in range(3):
            across[k] /= size
        for k in range(3):
            beside[k] = axis[(k + 1) % 3] * across[(k + 2) % 3] - axis[(k + 2) % 3] * across[(k + 1) % 3]
        least, most, own, round_ = np.inf, -np.inf, 0.0, 0.0
        for side in range(SIDES):
            off = 0.0
            for k in range(3):
                corner[k] = (1 - share) * rings[low, 1 + side, k] + share * rings[low + 1, 1 + side, k]
                off += beside[k] * (corner[k] - (1 - share) * rings[low, 0, k] - share * rings[low + 1, 0, k])
            least, most = min(least, off), max(most, off)
        for k in range(3):
            centre = (1 - share) * rings[low, 0, k] + share * rings[low + 1, 0, k]
            own += beside[k] * (place[i, k] - centre)
            rows[k, i], rows[3 + k, i] = centre, across[k]
            frames[i, 0, k], frames[i, 1, k], frames[i, 2, k] = axis[k], across[k], beside[k]
        offset[i] = min(max(1 - 2 * (own - least) / (most - least), -1.0), 1.0)  # positive against `beside`, as angles turn
        for k in range(3):
            centre = (1 - share) * rings[low, 0, k] + share * rings[low + 1, 0, k]
            edge = (1 - share) * rings[low, 1, k] + share * rings[low + 1, 1, k] - centre
            round_ += edge * edge
        width[i] = 2 * np.sqrt(round_) / (CORNER * (most - least))
        far[i], sine[i] = max(reach[low], reach[low + 1]), s


@compiled
def _leave(
    there: np.ndarray, frames: np.ndarray, reach: np.ndarray, directions: np.ndarray, local: np.ndarray, place: np.ndarray
) -> None:
    """Directions in the fibre's frame, and rays' origins: out of the prism, across it, where they go."""
    for i in range(len(reach)):
        x, y, z = np.float32(0), np.float32(0), np.float32(0)
        for k in range(3):
            x += frames[i, 0, k] * directions[i, k]
            y += frames[i, 1, k] * directions[i, k]
            z += frames[i, 2, k] * directions[i, k]
        local[i, 0], local[i, 1], local[i, 2] = x, y, z
        size = np.sqrt(y * y + z * z)
        y, z = (y / size, z / size) if size > 0 else (np.float32(1), np.float32(0))
        for k in range(3):
            place[k, i] = there[k, i] + reach[i] * (y * frames[i, 1, k] + z * frames[i, 2, k])
            place[3 + k, i] = directions[i, k]
