"""Measurement points: where an engine looks at direct light.

Sample elimination (Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", 2015) thins a dense random set
to blue noise. Elimination goes on to a single point; read backwards it is an order in which every beginning is itself
evenly spread, so that a fit may use fewer points than were baked.
"""

import hashlib
import heapq
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from ddprt import seeds, warp
from ddprt.axes import Bool, Float, Float64, Int
from ddprt.errors import UserError
from ddprt.lights.light import unit
from ddprt.scene.atlas import SHUT, Atlas
from ddprt.scene.checks import FARTHEST
from ddprt.scene.holes import Holes
from ddprt.scene.mesh import Scene

_DENSITY = 5  # candidates per sample kept, as the paper advises
_ALPHA, _BETA, _GAMMA = 8, 0.65, 1.5  # the paper's weight exponents


@dataclass(frozen=True, eq=False)
class Samples:
    """Places where direct light is measured, in progressive order.

    Attributes:
      position: metres, world space.
      normal: unit, geometric.
      albedo: linear.
      spacing: metres; typical distance between neighbours, to weigh position against orientation.
      depth: metres behind the surface that light is evaluated at, see `transport.measure`; 0 on it.
      rest: the same samples in the pose that points share them out in; None where that is this one.
    """

    position: Float64[np.ndarray, "samples 3"]
    normal: Float64[np.ndarray, "samples 3"]
    albedo: Float64[np.ndarray, "samples 3"]
    spacing: float
    depth: float = 0.0
    rest: "Samples | None" = None

    @property
    def tensors(self) -> dict[str, np.ndarray]:
        """All places by name, as `read` takes them."""
        rest = {} if self.rest is None else {"rest.position": self.rest.position, "rest.normal": self.rest.normal}
        return {"position": self.position, "normal": self.normal, "albedo": self.albedo, **rest}

    @classmethod
    def read(cls, tensors: Mapping[str, np.ndarray], spacing: float, depth: float = 0.0) -> "Samples":
        """Of what `tensors` gave."""
        albedo, rest = tensors["albedo"], None
        if "rest.position" in tensors:
            rest = cls(tensors["rest.position"], tensors["rest.normal"], albedo, spacing)
        return cls(tensors["position"], tensors["normal"], albedo, spacing, depth, rest)

    @property
    def digest(self) -> str:
        """Hash of all places: equal digests measure equal light."""
        state = hashlib.sha256()
        for array in self.tensors.values():
            state.update(np.ascontiguousarray(array).tobytes())
        if self.depth:
            state.update(np.float64(self.depth).tobytes())
        return state.hexdigest()[:16]

    def nearest_point(self, points: int) -> Int[np.ndarray, " samples"]:
        """The point (one of the first `points` samples) that each sample is averaged into.

        A quarter turn of the normal counts as one spacing between points, so that a wall's two sides stay apart. Whatever
        moves, a sample stays with the point that it has at rest: matrices are mixed between poses, and values must not jump.
        """
        if self.rest is not None:
            return self.rest.nearest_point(points)
        spread = self.spacing * np.sqrt(len(self.position) / points)
        places = np.concatenate([self.position / spread, self.normal / np.sqrt(2)], 1)
        home = cKDTree(places[:points]).query(places)[1]
        home[:points] = np.arange(points)  # of points at one place each keeps its own light
        return home


def place_samples(scene: Scene, count: int, *, on: str, seed: int, atlas: Atlas | None = None) -> Samples:
    """Blue-noise samples on the surface or on the convex hull.

    Args:
      scene: where.
      count: samples, that is points times supersampling.
      on: "surface" or "hull" (hull samples have the albedo of the nearest surface).
      seed: of the run.
      atlas: of what is in the open, which samples on the surface keep to; None takes the whole of it.
    Raises:
      UserError: the hull is flat, or next to nothing is in the open.
    """
    return placed(scene, count, on=on, seed=seed, atlas=atlas)[0]


def placed(
    scene: Scene, count: int, *, on: str, seed: int, atlas: Atlas | None = None
) -> tuple[Samples, Int[np.ndarray, " samples"], Float64[np.ndarray, "samples 3"]]:
    """The same, and where they are on it: the triangle of each (of the hull, if they are on that), and its corners' weights."""
    rng = seeds.stream(seed, "points")
    if on == "hull":
        corners, normals = _hull(scene)
    else:
        corners, normals = scene.corners, scene.geometric_normals
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    area, within = float(areas.sum()), atlas if on == "surface" else None
    candidates = round(_DENSITY * count * (area / within.area.sum() if within else 1))
    # One stratum per candidate: areas are met far better than by independent draws.
    strata = (np.arange(candidates) + rng.random(candidates)) / candidates * area
    triangle = np.minimum(np.searchsorted(np.cumsum(areas), strata, side="right"), len(areas) - 1)
    weights = warp.sample_triangle(rng.random((candidates, 2)))
    weights = np.stack([1 - weights.sum(1), weights[:, 0], weights[:, 1]], 1)
    if on == "surface":
        is_open = _in_the_open(scene, within, triangle, weights)
        if not is_open.all():
            area = float(within.area.sum()) if within else area * float(is_open.mean())
            triangle, weights = triangle[is_open], weights[is_open]
        if len(triangle) < count:
            raise UserError(
                f'points.count: got {count} samples to place, but {len(triangle)} of {candidates} candidates on "{scene.name}" '
                "are in the open; lower points.count or points.supersample, or take out what lies inside solids"
            )
    position = np.einsum("nc,ncd->nd", weights, corners[triangle])
    order = eliminate(position, count, area)
    position, triangle, weights = position[order], triangle[order], weights[order]
    if on == "hull":
        nearest = cKDTree(scene.corners.mean(1)).query(position)[1]
        albedo = scene.albedo_at(nearest, np.full((count, 3), 1 / 3))
    else:
        albedo = scene.albedo_at(triangle, weights)
    return Samples(position, normals[triangle], albedo, float(np.sqrt(area / count))), triangle, weights


def _in_the_open(
    scene: Scene, atlas: Atlas | None, triangle: Int[np.ndarray, " n"], weights: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Which places on a scene are no holes, and not left out by its atlas of the open, to a small square of a texel."""
    holes = Holes.of(scene)
    there = np.ones(len(triangle), bool) if holes is None else ~holes.open_at(triangle, *weights[:, 1:].T.copy())
    if atlas is None:
        return there
    place = np.einsum("nc,ncd->nd", weights, atlas.uv[triangle]) * atlas.resolution
    column, row = np.clip(place.astype(int), 0, atlas.resolution - 1).T
    slot = atlas.slot[row, column]
    of_texel = np.full(atlas.count, -1)
    of_texel[atlas.parted] = np.arange(len(atlas.parted))
    parted = np.flatnonzero((slot >= 0) & (of_texel[slot] >= 0))
    squares = atlas.part.shape[1]
    across, down = np.clip((place[parted] - np.stack([column, row], 1)[parted]) * squares, 0, squares - 1).astype(int).T
    is_open = slot != SHUT  # nothing is known of what rounding moves off its chart
    is_open[parted] = atlas.part[of_texel[slot[parted]], down, across] >= 0
    return is_open & there


def load_samples(path: str | Path) -> Samples:
    """Given points: a JSON list of {"position": [..], "normal": [..], "albedo": [..]}, albedo 1 where it is left out.

    Raises:
      UserError: missing, not JSON, or a faulty entry.
    """
    try:
        records = json.loads(Path(path).read_text("utf-8"))
        position, normal = (np.array([record[key] for record in records], float) for key in ("position", "normal"))
        albedo = np.array([record.get("albedo", [1, 1, 1]) for record in records], float)
        if not position.shape == normal.shape == albedo.shape == (len(records), 3) or len(records) == 0:
            raise ValueError("expected lists of three numbers")
    except OSError as error:
        raise UserError(f"points.file {path}: got {error.strerror or error}, expected a JSON list of points") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f'points.file {path}: not a JSON list of {{"position", "normal", "albedo"}} with three numbers each ({error})'
        ) from None
    largest = np.abs(normal).max(1, keepdims=True)
    if not np.isfinite([position, normal, albedo]).all() or not (largest > 0).all():
        raise UserError(f"points.file {path}: got a number that is not finite or a normal of length 0; mend the file")
    if (np.abs(position) >= FARTHEST).any():
        raise UserError(f"points.file {path}: got a position past {FARTHEST:g} m; mend the file")
    normal /= largest  # so that no square overflows
    if (albedo < 0).any() or (albedo > 1).any():
        raise UserError(f"points.file {path}: got albedo {albedo.min():g} to {albedo.max():g}, expected 0 to 1; mend the file")
    extent = float(np.ptp(position, axis=0).max()) or 1.0
    return Samples(position, unit(normal), albedo, extent / np.sqrt(len(position)))


def eliminate(position: Float[np.ndarray, "n 3"], keep: int, area: float) -> Int[np.ndarray, " keep"]:
    """Indices of the `keep` samples left, in progressive order (the last one eliminated comes first).

    Args:
      position: candidates, metres.
      keep: how many stay.
      area: of the surface, m²; sets the greatest possible distance between `keep` samples.
    """
    order: list[int] = []
    alive = np.arange(len(position))
    target = keep
    # Halving with the radius of each size, as the paper does for progressive sets; ends when one sample is left.
    while True:
        alive, removed = _thin(position, alive, target, area)
        if target < keep:
            order = removed + order
        if target == 1:
            return np.array([int(alive[0]), *order])
        target = max(1, target // 2)


def _thin(position: np.ndarray, alive: np.ndarray, keep: int, area: float) -> tuple[np.ndarray, list[int]]:
    """Removes the most crowded sample until `keep` are left; the removed ones come last-removed first."""
    reach = np.sqrt(area / (2 * np.sqrt(3) * keep))  # the paper's r_max for samples on a surface
    low = reach * (1 - (keep / len(alive)) ** _GAMMA) * _BETA
    tree = cKDTree(position[alive])
    pairs = tree.query_pairs(2 * reach, output_type="ndarray")
    distance = np.linalg.norm(position[alive[pairs[:, 0]]] - position[alive[pairs[:, 1]]], axis=1)
    weight = (1 - np.maximum(distance, 2 * low) / (2 * reach)) ** _ALPHA
    count = len(alive)
    crowding = np.bincount(pairs.ravel(), np.repeat(weight, 2), minlength=count)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    by_sample = np.argsort(both[:, 0], kind="stable")
    neighbour, strength = both[by_sample, 1].tolist(), np.tile(weight, 2)[by_sample].tolist()
    start = np.searchsorted(both[by_sample, 0], np.arange(count + 1)).tolist()
    current = crowding.tolist()
    heap = [(-value, index) for index, value in enumerate(current)]
    heapq.heapify(heap)
    gone = [False] * count
    removed: list[int] = []
    while count - len(removed) > keep:
        value, index = heapq.heappop(heap)
        if gone[index] or -value != current[index]:
            continue  # an outdated entry: a lighter one is further down
        gone[index] = True
        removed.append(int(alive[index]))
        for slot in range(start[index], start[index + 1]):
            other = neighbour[slot]
            if not gone[other]:
                current[other] -= strength[slot]
                heapq.heappush(heap, (-current[other], other))
    return alive[~np.array(gone)], removed[::-1]


def _hull(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    try:
        # A corner of a strand belongs to six triangles or so.
        corners = scene.corners.reshape(-1, 3) if scene.tubes is None else scene.positions
        hull = ConvexHull(corners - scene.centre)
    except Exception as error:
        raise UserError(f'points.on: got "hull", but "{scene.name}" has a flat hull ({str(error).split(chr(10))[0]})') from None
    corners = hull.points[hull.simplices]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("nd,nd->n", cross, hull.equations[:, :3]) < 0
    corners[inward] = corners[inward][:, [0, 2, 1]]
    return corners + scene.centre, hull.equations[:, :3]
