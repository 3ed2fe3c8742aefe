"""Light of near senders, looked at where rays land.

A sender holds the mean of its direct light, and bounced light lives on blocks that are coarser still. From afar that is all
there is to see of them. From a few of their widths the edge of a shadow counts, or the dark of a crevice. So a ray that meets
a sender that near goes on as a path would: the direct light of that very point, for all lightings, and a further ray that
stands for the rest; until one meets something far.

Reference: Christensen, "Faster Photon Map Global Illumination", 1999, goes on in the same way where a final gather's rays are
short.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ddprt import warp
from ddprt.axes import Float32, Int, Int32
from ddprt.compiled import compiled
from ddprt.lights import Lighting
from ddprt.transport.direct import Places, mean_irradiance
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.gather import Landing, Seen, landed_on

WIDTHS = 0.5
"""How near is near: in widths of a block that bounces are solved on, the root of its area."""
_DEPTH = 16  # most times that a path goes on


@dataclass(frozen=True, eq=False)
class Near:
    """Rays that met something near.

    Attributes:
      receiver: whose they are, counted within the stretch.
      cell: the sender that they met.
      position, normal: where; centred frame, metres.
    """

    receiver: Int32[np.ndarray, " near"]
    cell: Int32[np.ndarray, " near"]
    position: Float32[np.ndarray, "near 3"]
    normal: Float32[np.ndarray, "near 3"]


@dataclass(frozen=True, eq=False)
class NearField:
    """What is needed to look closer.

    Attributes:
      tracer: the occluders.
      landing: from hits to senders.
      lightings: lights in the tracer's centred frame.
      direct: mean direct irradiance of the senders, W/m², columns (lighting, channel).
      albedo: of the senders.
      reach: square of the distance within which each sender is near, m².
      endless: all bounces are followed; otherwise only the direct light is looked at.
      shine: what tells a lighting's light at places: `mean_irradiance`, or what takes the same.
    """

    tracer: Tracer
    landing: Landing
    lightings: Sequence[Lighting]
    direct: Float32[np.ndarray, "senders columns"]
    albedo: Float32[np.ndarray, "senders 3"]
    reach: Float32[np.ndarray, " senders"]
    endless: bool
    shine: Callable[..., Float32[np.ndarray, "places 3"]] = mean_irradiance

    def some(self, chosen: Int[np.ndarray, " chosen"]) -> "NearField":
        """The same for a few of the lightings."""
        lightings = [self.lightings[index] for index in chosen]
        return replace(self, lightings=lightings, direct=columns_of(self.direct, chosen))

    def pick(self, seen: Seen, first: int) -> Near:
        """The near ones of some rays; `first` is added to their receivers."""
        chosen = self._chosen(seen.cells.reshape(-1), seen.distance.reshape(-1))
        receiver = (chosen % seen.cells.shape[1] + first).astype(np.int32)
        return self._at(receiver, seen.cells.reshape(-1)[chosen], seen.triangle[chosen], seen.u[chosen], seen.v[chosen])

    def add(
        self,
        met: Sequence[Near],
        table: Float32[np.ndarray, "senders_and_dark columns"],
        rng: np.random.Generator,
        sums: Float32[np.ndarray, "receivers columns"],
    ) -> None:
        """Replaces, in sums of radiosity over rays, that of near senders by what lies where each ray met them."""
        near, weight = _joined(met), np.ones((sum(len(part.cell) for part in met), 3), np.float32)
        places, weights = [], []
        for _ in range(_DEPTH if self.endless else 1):
            if len(near.cell) == 0:
                break
            reflected = weight * self.albedo[near.cell]
            places.append(near)
            weights.append(reflected)
            if self.endless:
                _add_rows(near.receiver, near.cell, -weight, table, sums)
                _add_rows(near.receiver, near.cell, reflected, self.direct, sums)
                near, weight = self._onwards(near, reflected, table, rng, sums)
        if places:
            self._light(_joined(places), np.concatenate(weights), rng, sums)

    def _light(self, near: Near, weight: np.ndarray, rng: np.random.Generator, sums: np.ndarray) -> None:
        """Adds the difference that direct light makes.

        A place costs a shadow ray for every lighting, so with n lightings one place in sqrt(n) stands for the others: the same
        ones for all, so that G stays linear.
        """
        count = len(near.cell)
        share = rng.permutation(count)[: -(-count // max(1, round(len(self.lightings) ** 0.5)))]
        weight = weight[share] * np.float32(count / len(share))
        places = Places.of(self.tracer, near.position[share], near.normal[share])
        for index, lighting in enumerate(self.lightings):
            light = self.shine(self.tracer, lighting, places, rng)
            _add_difference(near.receiver[share], near.cell[share], light, self.direct, weight, 3 * index, sums)

    def _onwards(
        self, near: Near, weight: np.ndarray, table: np.ndarray, rng: np.random.Generator, sums: np.ndarray
    ) -> tuple[Near, np.ndarray]:
        """Sends a ray from each, adds what the senders there radiate, and gives those that are near again."""
        local = warp.sample_cosine(rng.random((len(near.cell), 2), np.float32))
        directions = warp.to_world(local, warp.frame(near.normal))
        triangle, u, v, distance = self.tracer.first(lifted(self.tracer, near.position, near.normal), directions)
        cells = landed_on(self.tracer, self.landing, directions, triangle, u, v)
        lit = np.flatnonzero(cells >= 0)
        _add_rows(near.receiver[lit], cells[lit], weight[lit], table, sums)
        chosen = self._chosen(cells, distance)
        return self._at(near.receiver[chosen], cells[chosen], triangle[chosen], u[chosen], v[chosen]), weight[chosen]

    def _chosen(self, cells: np.ndarray, distance: np.ndarray) -> np.ndarray:
        chosen = np.empty(len(cells) + 1, np.int64)
        return chosen[: _pick(cells, distance, self.reach, chosen)]

    def _at(self, receiver: np.ndarray, cell: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> Near:
        return Near(receiver, cell, self.tracer.on_triangle(triangle, u, v), self.tracer.normals[triangle])


def _joined(parts: Sequence[Near]) -> Near:
    return Near(*(np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(Near)))


def columns_of(
    light: Float32[np.ndarray, "senders columns"], chosen: Int[np.ndarray, " chosen"]
) -> Float32[np.ndarray, "senders chosen_columns"]:
    """The columns of some lightings."""
    return np.ascontiguousarray(light.reshape(len(light), -1, 3)[:, chosen].reshape(len(light), -1))


@compiled
def _pick(cells: np.ndarray, distance: np.ndarray, reach: np.ndarray, chosen: np.ndarray) -> int:
    """Writes which rays meet a sender within its reach; returns their number."""
    count = 0
    for ray in range(len(cells)):
        cell = cells[ray]
        if cell >= 0:
            chosen[count] = ray
            count += distance[ray] * distance[ray] < reach[cell]
    return count


@compiled
def _add_difference(
    receiver: np.ndarray,
    cell: np.ndarray,
    light: np.ndarray,
    direct: np.ndarray,
    weight: np.ndarray,
    column: int,
    sums: np.ndarray,
) -> None:
    """Adds to a lighting's columns of receivers the weighted difference between light at points and on their senders."""
    for ray in range(len(receiver)):
        row, sender = receiver[ray], cell[ray]
        for channel in range(3):
            difference = light[ray, channel] - direct[sender, column + channel]
            sums[row, column + channel] += weight[ray, channel] * difference


@compiled
def _add_rows(receiver: np.ndarray, cell: np.ndarray, weight: np.ndarray, table: np.ndarray, sums: np.ndarray) -> None:
    """Adds weighted rows of a table to the receivers'."""
    for ray in range(len(receiver)):
        row, sender = receiver[ray], cell[ray]
        for column in range(0, sums.shape[1], 3):
            for channel in range(3):
                sums[row, column + channel] += weight[ray, channel] * table[sender, column + channel]
