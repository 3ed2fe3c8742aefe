"""Fog on the way of light: where paths scatter in the air, and how lamps light them there.

A path that goes through fog leaves the whole stretch behind, not just the place where it scatters. Each lamp is asked for its
light at a place of its own on it (`Medium.stops`), since where light is strong depends on where the lamp stands, and the path
does not know which one is on. So all lightings share the paths as ever, and a lamp in the fog costs no fireflies.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ddprt.axes import Float32, Float64, Int32
from ddprt.lights import Light
from ddprt.transport.direct import BLOCK
from ddprt.transport.medium import Medium
from ddprt.transport.walk import MAX_SURVIVAL, SURVIVAL, Vertices


@dataclass(frozen=True, eq=False)
class AirVertices:
    """Stretches of paths through fog, and, `under` a lamp, vertices on them.

    Attributes:
      there: origins and directions of stretches (in place of normals), or vertices likewise; receivers; the throughput is that
        of the path where the fog begins, under a lamp what a receiver gains for each W/(m² sr) that scatters to it, over pi.
      span: from where to where along it, metres.
      numbers: uniform, for the place that a lamp is asked for its light at.
      medium: the fog.
    """

    there: Vertices
    span: Float64[np.ndarray, "2 n"]
    numbers: Float32[np.ndarray, "2 n"]
    medium: Medium

    @classmethod
    def joined(cls, parts: "Sequence[AirVertices]") -> "AirVertices":
        """One list of many."""
        span, numbers = np.concatenate([part.span for part in parts], 1), np.concatenate([part.numbers for part in parts], 1)
        return cls(Vertices.joined([part.there for part in parts]), span, numbers, parts[0].medium)

    @property
    def place(self) -> Float32[np.ndarray, "6 n"]:
        """Places in the air, and the ways that paths took there."""
        return self.there.place

    @property
    def owner(self) -> Int32[np.ndarray, " n"]:
        """The receivers."""
        return self.there.owner

    @property
    def facing(self) -> None:
        """Light from all sides counts."""

    def blocks(self) -> "Iterator[AirVertices]":
        """Parts of about equal size that fit into a core's cache."""
        edges = np.linspace(0, len(self.owner), -(-len(self.owner) // BLOCK) + 1).astype(int)
        for (low, high), there in zip(pairwise(edges), self.there.blocks(), strict=True):
            span, numbers = (np.ascontiguousarray(values[:, low:high]) for values in (self.span, self.numbers))
            yield AirVertices(there, span, numbers, self.medium)

    def under(self, light: Light, start: Float32[np.ndarray, "3"]) -> "AirVertices":
        """Where the light of one lamp is asked for."""
        numbers = self.numbers + start[:2, None]
        numbers -= numbers >= 1
        place, throughput = self.medium.stops(self.there.place, self.span, self.there.throughput, numbers, light.anchor())
        return replace(self, there=Vertices(place, throughput, self.there.owner))

    def lit_from(self, directions: Float32[np.ndarray, "n 3"]) -> Vertices:
        """What each W/m² that arrives from directions, on a plane that faces it, is worth to the receivers.

        Normals are the directions themselves, which weigh nothing.
        """
        towards = directions.T
        cosine = np.einsum("dn,dn->n", self.there.place[3:], towards)
        place = np.concatenate([self.there.place[:3], towards])
        throughput = self.there.throughput * (np.float32(np.pi) * self.medium.phase(cosine))
        return Vertices(place, throughput, self.there.owner)


@dataclass(frozen=True, eq=False)
class Flights:
    """What became of rays in the air.

    Attributes:
      ways: all stretches of fog, to be lit; None where there are none, or the fog is black.
      origins, directions: of the rays that met fog, at the meeting.
      throughput, owner: of these.
      medium: the fog.
    """

    ways: AirVertices | None
    origins: Float32[np.ndarray, "n 3"]
    directions: Float32[np.ndarray, "n 3"]
    throughput: Float32[np.ndarray, "3 n"]
    owner: Int32[np.ndarray, " n"]
    medium: Medium

    def go_on(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Origins and directions of the paths that survive roulette, their throughput and receivers."""
        survival = np.minimum(np.float32(SURVIVAL) * self.throughput.max(0), np.float32(MAX_SURVIVAL))
        kept = np.flatnonzero(rng.random(len(survival), np.float32) < survival)
        directions = self.medium.scattered(self.directions[kept], rng.random((len(kept), 2), np.float32))
        return self.origins[kept], directions, self.throughput[:, kept] / survival[kept], self.owner[kept]


@dataclass(frozen=True, eq=False)
class Air:
    """The fog of a scene, on the way of paths."""

    medium: Medium

    def crossed(
        self,
        origins: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        hit: tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]],
        throughput: Float32[np.ndarray, "3 n"],
        owner: Int32[np.ndarray, " n"],
        rng: np.random.Generator,
    ) -> tuple[Int32[np.ndarray, " n"], Flights]:
        """Triangles that rays hit, -1 now where they met fog before, and what the fog did; the throughput is changed in place.

        Args:
          origins, directions, throughput, owner: of the rays.
          hit: triangle, -1 for none, and distance, metres.
          rng: of the walk.
        """
        triangle, distance = hit
        reach = np.where(triangle >= 0, distance, np.float32(np.inf))
        span = self.medium.spans(origins, directions, reach)
        numbers = rng.random((4, len(owner)), np.float32)
        ways, some = None, np.flatnonzero(span[1] > span[0])
        if len(some) and self.medium.albedo.any():
            place = np.concatenate([origins[some].T, directions[some].T])
            there = Vertices(place, np.ascontiguousarray(throughput[:, some]), owner[some])
            ways = AirVertices(there, np.ascontiguousarray(span[:, some]), np.ascontiguousarray(numbers[2:, some]), self.medium)
        where, factor = self.medium.fly(span, throughput, numbers[:2])
        throughput *= factor
        met = np.flatnonzero(where < np.inf)
        left = (throughput[:, met] * self.medium.albedo[:, None]).astype(np.float32)
        start = (origins[met] + where[met, None] * directions[met]).astype(np.float32)
        others = triangle.copy()
        others[met] = -1
        return others, Flights(ways, start, directions[met], left, owner[met], self.medium)
