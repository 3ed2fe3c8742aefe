"""The lightmap: which texel is where in the world."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ddprt.axes import Bool, Float, Float32, Float64, Int, Int32
from ddprt.compiled import compiled
from ddprt.errors import UserError
from ddprt.scene.filtered import mean_albedo
from ddprt.scene.mesh import Scene
from ddprt.scene.raster import interpolate, rasterise
from ddprt.scene.unwrap import unwrap

_EQUAL = 1e-9  # pieces whose areas differ by less are taken in their order, so that rounding never chooses
SHUT = -2
"""In `Atlas.slot`: a texel that charts cover, but of which nothing is in the open."""
_BLOCK = 1 << 18  # pieces whose albedo is looked up at once: bounds the memory at about 20 MB


@dataclass(frozen=True, eq=False)
class SurfaceSampler:
    """Uniform points on groups of surface pieces, a group being a texel or a coarser sender.

    Attributes:
      start: first piece of each group, and the number of pieces at the end.
      reach: share of its group's area up to and with each piece, rising to 1.
      width: share of its group's area that each piece has.
      place: first corner of each piece and the edges to the other two, nine numbers in a row, metres.
      triangle: mesh triangle of each piece.
    """

    start: Int[np.ndarray, " groups_and_end"]
    reach: Float32[np.ndarray, " pieces"]
    width: Float32[np.ndarray, " pieces"]
    place: Float32[np.ndarray, "pieces 9"]
    triangle: Int32[np.ndarray, " pieces"]

    @classmethod
    def build(
        cls,
        group: Int[np.ndarray, " pieces"],
        area: Float64[np.ndarray, " pieces"],
        corners: Float32[np.ndarray, "pieces 3 3"],
        triangle: Int32[np.ndarray, " pieces"],
    ) -> "SurfaceSampler":
        """Orders pieces by group. Every group from 0 up must have at least one piece with area."""
        order = np.argsort(group, kind="stable")
        group, area, place, triangle = group[order], area[order], corners.reshape(-1, 9)[order], triangle[order]
        start = np.searchsorted(group, np.arange(group[-1] + 2))
        total = np.add.reduceat(area, start[:-1])
        running = np.cumsum(area)
        before = running[start[:-1]] - area[start[:-1]]
        reach = np.clip((running - before[group]) / total[group], 0, 1)
        reach[start[1:] - 1] = 1
        place[:, 3:6] -= place[:, :3]
        place[:, 6:] -= place[:, :3]
        return cls(start, reach.astype(np.float32), (area / total[group]).astype(np.float32), place, triangle)

    def sample(
        self, group: Int[np.ndarray, " n"], u: Float32[np.ndarray, "n 2"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]:
        """Positions (metres) and mesh triangles, one in each given group."""
        positions, faces = np.empty((len(group), 3), np.float32), np.empty(len(group), np.int32)
        _place(group, u, self.start, self.reach, self.width, self.place, self.triangle, positions, faces)
        return positions, faces

    def spread(
        self, group: Int[np.ndarray, " tile"], u: Float32[np.ndarray, "samples blocks 2"], block: Int32[np.ndarray, " tile"]
    ) -> tuple[Float32[np.ndarray, "rays 3"], Int32[np.ndarray, " rays"]]:
        """The same for a tile of groups and some samples, sample by sample; each group has its block of `u`."""
        rays = len(u) * len(group)
        positions, faces = np.empty((rays, 3), np.float32), np.empty(rays, np.int32)
        _spread(group, u, block, self.start, self.reach, self.width, self.place, self.triangle, positions, faces)
        return positions, faces


@compiled
def _place(
    group: np.ndarray,
    u: np.ndarray,
    start: np.ndarray,
    reach: np.ndarray,
    width: np.ndarray,
    place: np.ndarray,
    triangle: np.ndarray,
    positions: np.ndarray,
    faces: np.ndarray,
) -> None:
    for i in range(len(group)):
        faces[i] = triangle[_point(np.uint64(group[i]), u[i, 0], u[i, 1], start, reach, width, place, positions[i])]


@compiled
def _spread(
    group: np.ndarray,
    u: np.ndarray,
    block: np.ndarray,
    start: np.ndarray,
    reach: np.ndarray,
    width: np.ndarray,
    place: np.ndarray,
    triangle: np.ndarray,
    positions: np.ndarray,
    faces: np.ndarray,
) -> None:
    i = 0
    for sample in range(len(u)):
        for k in range(len(group)):
            pair = u[sample, np.uint32(block[k])]
            faces[i] = triangle[_point(np.uint64(group[k]), pair[0], pair[1], start, reach, width, place, positions[i])]
            i += 1


@compiled
def _point(
    group: np.integer,
    u: np.floating,
    v: np.floating,
    start: np.ndarray,
    reach: np.ndarray,
    width: np.ndarray,
    place: np.ndarray,
    position: np.ndarray,
) -> np.integer:
    """A point of a group, and its piece: the first number chooses it and is used again within; see `warp.sample_triangle`."""
    # Unsigned indices spare the look at whether they count from the end.
    low, high = np.uint64(start[group]), np.uint64(start[group + np.uint64(1)] - 1)
    while low < high:
        middle = (low + high) >> np.uint64(1)
        if u < reach[middle]:
            high = middle
        else:
            low = middle + np.uint64(1)
    within = (u - reach[low] + width[low]) / max(width[low], np.float32(1e-30))
    x = min(max(within, np.float32(0)), np.float32(1))
    smaller = np.float32(0.5) * min(x, v)
    second, third = x - smaller, v - smaller
    corner = place[low]
    for axis in range(3):
        position[axis] = corner[axis] + second * corner[3 + axis] + third * corner[6 + axis]
    return low


@dataclass(frozen=True, eq=False)
class Senders:
    """The coarser atlas that light bounces off: blocks of texels that never cross charts.

    Attributes:
      of_texel: sender of each covered texel.
      area: m².
      albedo: area-weighted mean of the texels' albedo.
      chart, row, column: where each lies, rows and columns counted in blocks.
      block: texels along a block's side.
      sampler: points on each sender.
    """

    of_texel: Int32[np.ndarray, " texels"]
    area: Float64[np.ndarray, " senders"]
    albedo: Float64[np.ndarray, "senders 3"]
    chart: Int[np.ndarray, " senders"]
    row: Int[np.ndarray, " senders"]
    column: Int[np.ndarray, " senders"]
    block: int
    sampler: SurfaceSampler

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.area)


@dataclass(frozen=True, eq=False)
class Atlas:
    """Covered texels in row-major order, and where they lie on the scene.

    Attributes:
      resolution: texels per side.
      uv: corners of each triangle in the unit square, origin top-left, row 0 at the top.
      texel: row * resolution + column of each covered texel.
      slot: covered index at each texel, -1 where there is none, `SHUT` where there was one that is not in the open.
      position: a point of the surface inside the texel, metres, world space.
      normal, geometric_normal: unit vectors there.
      albedo: area-weighted mean, linear.
      area: m²; sums to the area of the mesh, or to what of it is in the open (see `transport.openness`).
      coverage: share of the texel's square that is covered.
      chart: of xatlas or of the file; where walls stand on one, each region that they bound has its own number.
      centre: of the scene; `sampler` works relative to it, so that float32 suffices.
      parted: texels that lie on both sides of a wall, and belong to one of them.
      part: which texel's light lies on each small square of those; -1 for none, where a square touches the wall itself.
      order: to trace texels in, so that rays near each other follow each other; None where rows and columns do that.
    """

    resolution: int
    uv: Float64[np.ndarray, "triangles 3 2"]
    texel: Int[np.ndarray, " texels"]
    slot: Int32[np.ndarray, "height width"]
    position: Float64[np.ndarray, "texels 3"]
    normal: Float64[np.ndarray, "texels 3"]
    geometric_normal: Float64[np.ndarray, "texels 3"]
    albedo: Float64[np.ndarray, "texels 3"]
    area: Float64[np.ndarray, " texels"]
    coverage: Float64[np.ndarray, " texels"]
    chart: Int32[np.ndarray, " texels"]
    centre: Float64[np.ndarray, "3"]
    piece_texel: Int[np.ndarray, " pieces"] = field(repr=False)
    piece_area: Float64[np.ndarray, " pieces"] = field(repr=False)
    piece_corners: Float32[np.ndarray, "pieces 3 3"] = field(repr=False)
    piece_triangle: Int32[np.ndarray, " pieces"] = field(repr=False)
    parted: Int[np.ndarray, " parted"] = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    part: Int32[np.ndarray, "parted down across"] = field(default_factory=lambda: np.zeros((0, 1, 1), np.int32), repr=False)
    order: Int[np.ndarray, " texels"] | None = field(default=None, repr=False)

    @property
    def count(self) -> int:
        """Number of covered texels."""
        return len(self.texel)

    @property
    def texels_per_metre(self) -> float:
        """Linear density: square root of texels per square metre."""
        return float(np.sqrt(self.coverage.sum() / self.area.sum()))

    @cached_property
    def sampler(self) -> SurfaceSampler:
        """Points on each texel, uniform by area, that never leave the chart; relative to `centre`."""
        return SurfaceSampler.build(self.piece_texel, self.piece_area, self.piece_corners, self.piece_triangle)

    @cached_property
    def lookup(self) -> Int32[np.ndarray, "height width"]:
        """`slot`, with holes next to covered texels closed: a hit on a chart's edge always finds a texel."""
        lookup = np.pad(self.slot, 1, constant_values=-1)  # so that nothing wraps around the image
        beside = np.maximum(lookup, -1)
        for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
            lookup = np.where(lookup == -1, np.roll(beside, shift, axis), lookup)
        return np.ascontiguousarray(lookup[1:-1, 1:-1])

    def image(self, values: Float[np.ndarray, "texels ..."], fill: float = 0.0) -> np.ndarray:
        """Values of covered texels as a (height, width, ...) image, row 0 at the top."""
        image = np.full((self.resolution**2, *values.shape[1:]), fill, values.dtype)
        image[self.texel] = values
        return image.reshape(self.resolution, self.resolution, *values.shape[1:])

    def senders(self, block: int) -> Senders:
        """Groups the texels into squares of `block` texels a side, within each chart."""
        row, column = np.divmod(self.texel, self.resolution)
        across = -(-self.resolution // block)
        key = (self.chart.astype(np.int64) * across + row // block) * across + column // block
        keys, group = np.unique(key, return_inverse=True)
        area = np.bincount(group, self.area)
        albedo = np.stack([np.bincount(group, self.area * self.albedo[:, c]) for c in range(3)], 1) / area[:, None]
        sampler = SurfaceSampler.build(group[self.piece_texel], self.piece_area, self.piece_corners, self.piece_triangle)
        place = keys // across**2, keys // across % across, keys % across
        return Senders(group.astype(np.int32), area, albedo, *place, block, sampler)


def build_atlas(scene: Scene, resolution: int = 256, padding: int = 2) -> Atlas:
    """Unwraps a scene and measures every texel.

    Args:
      scene: what to unwrap.
      resolution: texels per side, met exactly.
      padding: empty texels between charts.
    Raises:
      UserError: the charts do not fit.
    """
    return measured_atlas(scene, *unwrap(scene, resolution, padding), resolution)


def measured_atlas(
    scene: Scene, uv: Float64[np.ndarray, "triangles 3 2"], chart: Int32[np.ndarray, " triangles"], resolution: int
) -> Atlas:
    """Measures every texel of a scene that is unwrapped.

    Args:
      scene: what is unwrapped.
      uv: corners of each triangle in the unit square, origin top-left.
      chart: of each triangle.
      resolution: texels per side.
    Raises:
      UserError: no texel is covered.
    """
    pieces = rasterise(uv * resolution, resolution)
    if len(pieces.texel) == 0:
        raise UserError(f'atlas.resolution: got {resolution}, but "{scene.name}" covers no texel; raise atlas.resolution')
    first = np.flatnonzero(np.diff(pieces.texel, prepend=-1))
    texel, of_piece = pieces.texel[first], np.repeat(np.arange(len(first)), np.diff(first, append=len(pieces.texel)))
    slot = np.full(resolution**2, -1, np.int32)
    slot[texel] = np.arange(len(texel))
    area = pieces.share * scene.areas[pieces.triangle]
    large = np.flatnonzero(area > (1 - _EQUAL) * np.maximum.reduceat(area, first)[of_piece])
    largest = large[np.searchsorted(large, first)]
    home, weights = pieces.triangle[largest], pieces.barycentric[largest].mean(1, keepdims=True)
    normal = interpolate(weights, home, scene.normals[scene.triangles])[:, 0]
    reflected = np.zeros((3, len(texel)))
    for start in range(0, len(area), _BLOCK):
        part = slice(start, start + _BLOCK)
        albedo = mean_albedo(scene, pieces.triangle[part], pieces.barycentric[part])
        for channel in range(3):
            np.add.at(reflected[channel], of_piece[part], area[part] * albedo[:, channel])
    total = np.bincount(of_piece, area)
    return Atlas(
        resolution=resolution,
        uv=uv,
        texel=texel,
        slot=slot.reshape(resolution, resolution),
        position=interpolate(weights, home, scene.corners)[:, 0],
        normal=normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300),
        geometric_normal=scene.geometric_normals[home],
        albedo=(reflected / total).T.copy(),
        area=total,
        coverage=np.bincount(of_piece, pieces.uv_area),
        chart=chart[home],
        centre=scene.centre,
        piece_texel=of_piece,
        piece_area=area,
        piece_corners=interpolate(pieces.barycentric, pieces.triangle, scene.corners - scene.centre, np.float32),
        piece_triangle=pieces.triangle,
    )


def restricted(
    atlas: Atlas,
    scene: Scene,
    changed: Bool[np.ndarray, " texels"],
    pieces: tuple[
        Int[np.ndarray, " pieces"],
        Float64[np.ndarray, " pieces"],
        Float32[np.ndarray, "pieces 3 3"],
        Int32[np.ndarray, " pieces"],
    ],
) -> Atlas:
    """The atlas with other pieces: what is left of some texels is measured anew, texels without pieces are dropped.

    Args:
      atlas: to start from.
      scene: what it unwraps.
      changed: texels whose pieces differ; all others keep every bit.
      pieces: texel (index in `atlas`), area, corners relative to `centre` and mesh triangle of each piece, ordered by texel.
    """
    texel, area, corners, triangle = pieces
    kept = np.bincount(texel, minlength=atlas.count) > 0
    number = np.where(kept, np.cumsum(kept) - 1, SHUT).astype(np.int32)
    slot = atlas.slot.copy()
    slot.ravel()[atlas.texel] = number
    fresh = np.flatnonzero(changed & kept)
    mine = np.flatnonzero(changed[texel])
    first = np.searchsorted(texel[mine], fresh)
    group = np.repeat(np.arange(len(fresh)), np.diff(first, append=len(mine)))
    face, size, middle = triangle[mine], area[mine], corners[mine].mean(1, dtype=np.float64)
    total = np.bincount(group, size, len(fresh))
    inner = np.stack([np.bincount(group, size * middle[:, axis], len(fresh)) for axis in range(3)], 1) / total[:, None]
    away = np.linalg.norm(middle - inner[group], axis=1)  # the piece next to the middle of what is left stands for all
    chosen = np.lexsort((np.arange(len(mine)), away, group))[first]
    weights = weights_at(scene.corners[face] - scene.centre, middle)
    home, place = face[chosen], weights[chosen][:, None]
    normal = interpolate(place, home, scene.normals[scene.triangles])[:, 0]
    home_corners = np.repeat(scene.corners[face] - scene.centre, 3, axis=0)
    shape = weights_at(home_corners, corners[mine].reshape(-1, 3).astype(np.float64))
    reflected = size[:, None] * mean_albedo(scene, face, shape.reshape(-1, 3, 3))
    edges = (atlas.uv[:, 1:] - atlas.uv[:, :1]) * atlas.resolution
    density = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / (2 * scene.areas)
    values = {
        "position": interpolate(place, home, scene.corners)[:, 0],
        "normal": normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300),
        "geometric_normal": scene.geometric_normals[home],
        "albedo": np.stack([np.bincount(group, reflected[:, c], len(fresh)) for c in range(3)], 1) / total[:, None],
        "area": total,
        "coverage": np.bincount(group, size * density[face], len(fresh)),
    }
    measured = {}
    for name, found in values.items():
        column = getattr(atlas, name).copy()
        column[fresh] = found
        measured[name] = column[kept]
    return replace(
        atlas,
        texel=atlas.texel[kept],
        slot=slot,
        chart=atlas.chart[kept],
        piece_texel=number[texel].astype(np.int64),
        piece_area=area,
        piece_corners=corners,
        piece_triangle=triangle,
        **measured,
    )


def weights_at(corners: Float64[np.ndarray, "n 3 3"], point: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Weights of triangles' corners at points on them; points beyond an edge by rounding are moved onto it."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal, offset = np.cross(b - a, c - a), point - a
    squared = (normal**2).sum(1)
    second = (np.cross(offset, c - a) * normal).sum(1) / squared
    third = (np.cross(b - a, offset) * normal).sum(1) / squared
    weights = np.clip(np.stack([1 - second - third, second, third], 1), 0, None)
    return weights / weights.sum(1, keepdims=True)
