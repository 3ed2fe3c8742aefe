"""The lightmap: which texel is where in the world."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddprt import warp
from ddprt.axes import Bool, Float, Float32, Float64, Int, Int32
from ddprt.errors import UserError
from ddprt.scene.mesh import Scene
from ddprt.scene.raster import rasterise
from ddprt.scene.unwrap import unwrap


@dataclass(frozen=True, eq=False)
class SurfaceSampler:
    """Uniform points on groups of surface pieces, a group being a texel or a coarser sender.

    Attributes:
      start: first piece of each group, and the number of pieces at the end.
      reach: group index plus the share of the group's area up to and with this piece: rising from 0 to the group count.
      width: share of its group's area that each piece has.
      place: first corner of each piece and the edges to the other two, nine numbers in a row, metres.
      triangle: mesh triangle of each piece.
    """

    start: Int[np.ndarray, " groups_and_end"]
    reach: Float64[np.ndarray, " pieces"]
    width: Float64[np.ndarray, " pieces"]
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
        group, area, corners, triangle = group[order], area[order], corners[order], triangle[order]
        start = np.searchsorted(group, np.arange(group[-1] + 2))
        total = np.add.reduceat(area, start[:-1])
        running = np.cumsum(area)
        before = running[start[:-1]] - area[start[:-1]]
        reach = group + np.clip((running - before[group]) / total[group], 0, 1)
        reach[start[1:] - 1] = group[start[1:] - 1] + 1
        place = np.concatenate([corners[:, :1], corners[:, 1:] - corners[:, :1]], 1).reshape(-1, 9)
        return cls(start, reach, area / total[group], place, triangle)

    def sample(
        self, group: Int[np.ndarray, " n"], u: Float32[np.ndarray, "n 2"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]:
        """Positions (metres) and mesh triangles, one in each given group; groups in rising order are fastest."""
        first, last = self.start[group.min()], self.start[group.max() + 1]
        choice = group + u[:, 0].astype(np.float64)
        piece = first + np.searchsorted(self.reach[first:last], choice, side="right")
        piece = np.minimum(piece, np.take(self.start, group + 1) - 1)
        width = np.take(self.width, piece)
        within = (choice - np.take(self.reach, piece) + width) / np.maximum(width, 1e-300)
        weights = warp.sample_triangle(np.stack([np.clip(within, 0, 1).astype(np.float32), u[:, 1]], 1))
        second, third = np.ascontiguousarray(weights.T)
        place = np.take(self.place, piece, axis=0)
        positions = np.empty((len(group), 3), np.float32)
        for axis in range(3):  # a column at a time: three times as fast as broadcasting over rows of three
            positions[:, axis] = place[:, axis] + second * place[:, 3 + axis] + third * place[:, 6 + axis]
        return positions, np.take(self.triangle, piece)


@dataclass(frozen=True, eq=False)
class Senders:
    """The coarser atlas that light bounces off: blocks of texels that never cross charts.

    Attributes:
      of_texel: sender of each covered texel, -1 for texels that take no part.
      area: m².
      albedo: area-weighted mean of the texels' albedo.
      sampler: points on each sender.
    """

    of_texel: Int32[np.ndarray, " texels"]
    area: Float64[np.ndarray, " senders"]
    albedo: Float64[np.ndarray, "senders 3"]
    sampler: SurfaceSampler


@dataclass(frozen=True, eq=False)
class Atlas:
    """Covered texels in row-major order, and where they lie on the scene.

    Attributes:
      resolution: texels per side.
      uv: corners of each triangle in the unit square, origin top-left, row 0 at the top.
      texel: row * resolution + column of each covered texel.
      slot: covered index at each texel, -1 where there is none.
      position: a point of the surface inside the texel, metres, world space.
      normal, geometric_normal: unit vectors there.
      albedo: area-weighted mean, linear.
      area: m²; sums to the area of the mesh.
      coverage: share of the texel's square that is covered.
      chart: xatlas chart.
      centre: of the scene; `sampler` works relative to it, so that float32 suffices.
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
        padded = np.pad(self.slot, 1, constant_values=-1)  # so that nothing wraps around the image
        lookup = padded.copy()
        for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
            lookup = np.where(lookup < 0, np.roll(padded, shift, axis), lookup)
        return np.ascontiguousarray(lookup[1:-1, 1:-1])

    def image(self, values: Float[np.ndarray, "texels ..."], fill: float = 0.0) -> np.ndarray:
        """Values of covered texels as a (height, width, ...) image, row 0 at the top."""
        image = np.full((self.resolution**2, *values.shape[1:]), fill, values.dtype)
        image[self.texel] = values
        return image.reshape(self.resolution, self.resolution, *values.shape[1:])

    def senders(self, resolution: int, exposed: Bool[np.ndarray, " texels"]) -> Senders:
        """Groups the exposed texels (at least one) so that about `resolution` senders lie along a side."""
        block = max(1, round(self.resolution / resolution))
        row, column = np.divmod(self.texel, self.resolution)
        across = -(-self.resolution // block)
        key = (self.chart.astype(np.int64) * across + row // block) * across + column // block
        _, group = np.unique(key[exposed], return_inverse=True)
        weight = self.area[exposed]
        area = np.bincount(group, weight)
        albedo = np.stack([np.bincount(group, weight * self.albedo[exposed, c]) for c in range(3)], 1) / area[:, None]
        of_texel = np.full(self.count, -1, np.int32)
        of_texel[exposed] = group
        kept = exposed[self.piece_texel]
        pieces = self.piece_texel[kept], self.piece_area[kept], self.piece_corners[kept], self.piece_triangle[kept]
        return Senders(of_texel, area, albedo, SurfaceSampler.build(of_texel[pieces[0]], *pieces[1:]))


def build_atlas(scene: Scene, resolution: int = 256, padding: int = 2) -> Atlas:
    """Unwraps a scene and measures every texel.

    Args:
      scene: what to unwrap.
      resolution: texels per side, met exactly.
      padding: empty texels between charts.
    Raises:
      UserError: the charts do not fit.
    """
    uv, chart = unwrap(scene, resolution, padding)
    pieces = rasterise(uv * resolution, resolution)
    if len(pieces.texel) == 0:
        raise UserError(f'atlas.resolution: got {resolution}, but "{scene.name}" covers no texel; raise atlas.resolution')
    texel, of_piece = np.unique(pieces.texel, return_inverse=True)
    slot = np.full(resolution**2, -1, np.int32)
    slot[texel] = np.arange(len(texel))
    area = pieces.share * scene.areas[pieces.triangle]
    middle = pieces.barycentric.mean(1)

    total = np.bincount(of_piece, area)
    largest = np.lexsort((-area, of_piece))[np.searchsorted(of_piece, np.arange(len(texel)))]
    home, weights = pieces.triangle[largest], middle[largest]
    normal = np.einsum("nc,ncd->nd", weights, scene.normals[scene.triangles[home]])
    albedo = area[:, None] * scene.albedo_at(pieces.triangle, middle)
    corners = scene.corners - scene.centre
    return Atlas(
        resolution=resolution,
        uv=uv,
        texel=texel,
        slot=slot.reshape(resolution, resolution),
        position=np.einsum("nc,ncd->nd", weights, scene.corners[home]),
        normal=normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300),
        geometric_normal=scene.geometric_normals[home],
        albedo=np.stack([np.bincount(of_piece, albedo[:, c]) for c in range(3)], 1) / total[:, None],
        area=total,
        coverage=np.bincount(of_piece, pieces.uv_area),
        chart=chart[home],
        centre=scene.centre,
        piece_texel=of_piece,
        piece_area=area,
        piece_corners=np.einsum("npc,ncd->npd", pieces.barycentric, corners[pieces.triangle]).astype(np.float32),
        piece_triangle=pieces.triangle,
    )
