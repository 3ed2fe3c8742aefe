"""Rays at a scene: closest hits and shadow rays, threaded over slices. They reach Embree through `packets`.

Rays live in the scene's own frame (relative to its centre), so that float32 keeps its precision far from the origin.
Every origin is moved off its surface by one named distance, and shadow rays stop short of the light by the same. Sides of a
sheet without thickness, which a ray could not tell apart, are traced that distance from each other.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import islice
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from ddprt import warp
from ddprt.axes import Bool, Float32, Float64, Int32
from ddprt.scene.distance import distance_within
from ddprt.scene.fog import Fog
from ddprt.scene.holes import Holes
from ddprt.scene.mesh import Scene
from ddprt.scene.sheets import back_to_back
from ddprt.transport.packets import Geometry

SELF_OFFSET = 2e-6
"""Distance between a ray's origin and its surface, as a share of the bounding box's diagonal: about 30 times the rounding
of float32 coordinates there, and 1.6 micrometres for the Cornell box."""

_PROBES = 256  # directions that tell free space from a solid's inside

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Hits:
    """Closest hits of rays.

    Attributes:
      triangle: index, -1 where the ray escaped.
      u, v: weights of the second and third corner.
      front: the triangle was met from its front.
      distance: metres; undefined where the ray escaped.
    """

    triangle: Int32[np.ndarray, " rays"]
    u: Float32[np.ndarray, " rays"]
    v: Float32[np.ndarray, " rays"]
    front: Bool[np.ndarray, " rays"]
    distance: Float32[np.ndarray, " rays"]


class Tracer:
    """A scene that rays can be shot at.

    Args:
      corners: triangle corners, world space, metres.
      threads: workers of `map`; 0 takes one per core.
      holes: where rays pass through triangles, if anywhere.
      fog: what fills the bounding box; None for clear air.
    Raises:
      UserError: embreex is missing (there is no slow fallback).
    """

    def __init__(
        self,
        corners: Float64[np.ndarray, "triangles 3 3"],
        threads: int = 0,
        holes: Holes | None = None,
        fog: Fog | None = None,
    ) -> None:
        self._world, self._boxes = corners, np.stack([corners.min(1), corners.max(1)], 1)
        low, high = self._boxes[:, 0].min(0), self._boxes[:, 1].max(0)
        self.centre = (low + high) / 2
        self.radius = float(np.linalg.norm(high - low) / 2)
        self.offset = np.float32(2 * SELF_OFFSET * self.radius)
        self.threads = threads or (os.cpu_count() or 1)
        self.rays = 0
        self._counting = Lock()
        local = (corners - self.centre).astype(np.float32)
        self.corners = local
        cross = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0]).astype(np.float64)
        self.normals = (cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)).astype(np.float32)
        self.frames = warp.frame(self.normals)
        # Each side of a sheet forward by half: receivers, lifted by the whole, stay before their own. Only Embree knows.
        traced, sheets = local.copy(), back_to_back(local.astype(np.float64), float(self.offset) / 2)
        traced[sheets] += self.offset / 2 * self.normals[sheets, None]
        self._geometry, self.openwork = Geometry(traced), None
        if holes is not None:
            from ddprt.transport.cutouts import Openwork

            self.openwork = Openwork(holes, traced, self.offset, self._count)
        self.medium: Any = None
        if fog is not None:
            from ddprt.transport.medium import Medium

            self.medium = Medium.of(fog, (high - low) / 2)

    @classmethod
    def of(cls, scene: Scene, threads: int = 0) -> "Tracer":
        """The tracer of a scene."""
        return cls(scene.corners, threads, Holes.of(scene), scene.fog)

    def closest(self, origins: Float32[np.ndarray, "rays 3"], directions: Float32[np.ndarray, "rays 3"]) -> Hits:
        """First surface along each ray (centred frame, unit directions)."""
        triangle, u, v, distance = self.first(np.ascontiguousarray(origins), np.ascontiguousarray(directions))
        normals = np.take(self.normals, triangle, axis=0, mode="wrap")
        front = np.einsum("nd,nd->n", normals, directions) < 0
        return Hits(triangle, u, v, front & (triangle >= 0), distance)

    def first(
        self, origins: Float32[np.ndarray, "rays 3"], directions: Float32[np.ndarray, "rays 3"]
    ) -> tuple[np.ndarray, ...]:
        """Triangle (-1: none), u, v and distance of the first hit of each ray, as Embree gives them; contiguous arrays."""
        self._count(len(origins))
        found = self._geometry.first(origins, directions)
        return self.openwork.first(origins, directions, found) if self.openwork else found

    def unoccluded(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        reach: Float32[np.ndarray, " rays"],
    ) -> Int32[np.ndarray, " rays"]:
        """Not 0 where nothing lies within `reach` metres of an origin; contiguous arrays."""
        if self.openwork:
            return self.openwork.unoccluded(origins, directions, reach)
        self._count(len(origins))
        return self._geometry.unoccluded(origins, directions, reach)

    def on_triangle(
        self, triangle: Int32[np.ndarray, " n"], u: Float32[np.ndarray, " n"], v: Float32[np.ndarray, " n"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Places of hits, by weights of the corners: nearer to the surface than a distance along the ray tells."""
        a, b, c = np.moveaxis(self.corners[triangle], 1, 0)
        return a + u[:, None] * (b - a) + v[:, None] * (c - a)

    def _count(self, rays: int) -> None:
        with self._counting:
            self.rays += rays

    def clearance(self, positions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Free radius about positions in world space, metres; 0 inside a solid or behind a room's walls.

        A position counts as free when less than half of the surfaces it sees along 256 spread rays show their backs. The
        radius is exact.
        """
        directions = _probes()
        origins = np.repeat((positions - self.centre).astype(np.float32), _PROBES, 0)
        hits = self.closest(origins, np.tile(directions, (len(positions), 1)))
        hit = (hits.triangle >= 0).reshape(-1, _PROBES)
        back = hit & ~hits.front.reshape(-1, _PROBES)
        nearest = np.where(hit, hits.distance.reshape(-1, _PROBES), np.inf).min(1).astype(np.float64)
        free = 2 * back.sum(1) <= hit.sum(1)
        exact = [
            distance_within(self._world, self._boxes, position, reach)
            for position, reach in zip(positions[free], nearest[free], strict=True)
        ]
        nearest[free], nearest[~free] = exact, 0.0
        return nearest

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results of `work` in the order of `items`, at most twice the threads ahead; NumPy and Embree free the GIL."""
        pool = ThreadPoolExecutor(self.threads)
        waiting: list[Future[Result]] = []
        source = iter(items)
        try:
            waiting += [pool.submit(work, item) for item in islice(source, 2 * self.threads)]
            while waiting:
                yield waiting.pop(0).result()
                waiting += [pool.submit(work, item) for item in islice(source, 1)]
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@cache
def _probes() -> Float32[np.ndarray, "rays 3"]:
    """Directions that are spread all around."""
    directions = warp.sample_sphere(warp.sobol(_PROBES, 2, seed=1))
    directions.flags.writeable = False
    return directions


def lifted(tracer: Tracer, positions: Any, normals: Any) -> Float32[np.ndarray, "n 3"]:
    """Ray origins: centred positions moved off their surface along its normal."""
    return positions + tracer.offset * normals
