"""What of a lightmap is in the open: no light is gathered, and none sent, inside solids or through walls.

Where geometry reaches through a texel, the texel is cut into small squares. A square is *crossed* where something stands
between its corners just above the surface, found by short rays: any line through a square crosses one of its diagonals, and
any wedge that pokes into it crosses one of its sides. Squares that touch without being crossed form *places*, which are wholly
inside a solid or wholly in the open; a few rays tell which. Of the open places the largest keeps the texel. What lands on the
others is looked up in a neighbour on their side. Charts are numbered anew, so that nothing averages over texels that a wall
keeps apart.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Bool, Float32, Int, Int32
from ddprt.errors import UserError
from ddprt.scene.atlas import Atlas, SurfaceSampler, build_atlas, restricted
from ddprt.scene.mesh import Scene
from ddprt.scene.raster import interpolate, rasterise
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import BACK, Landing, Pattern, Receivers, seen_from
from ddprt.transport.hairiness import hairy
from ddprt.transport.squares import CUT, Cut, as_images, find_corners, find_places, grown

_FIRST, _SECOND = 8, 32  # rays that look for backs in every texel, and from each place of a doubtful one
_LIFT = 1 / 64  # of a texel's width: height of the rays that look for walls
_CLEAR = 4  # offsets between those and the surface, and between their ends and the corners, at least
_LINES = ((0, 1), (2, 3), (0, 2), (2, 1), (1, 3), (3, 0))  # diagonals and sides of a square, by its corners in `find_corners`
_INWARDS = 0.01  # of the way to a square's middle that its corners are moved: walls stand along the rims of charts
_CHUNK = 1 << 15  # of those, traced together
_BATCH = 512  # doubtful texels that are cut together
_ALL = 1 - 1e-6  # share of a piece's area that makes it whole again


@dataclass(frozen=True, eq=False)
class _Split:
    """Some doubtful texels.

    Attributes:
      altered: those that lose something, or all.
      kept: the pieces that they keep.
      parted: those of them whose squares are not all their own.
      table: what hits on their squares belong to: 0 the texel itself, -1 nothing, k the k-th of the lost places.
      lost: texel of each open place that is not its texel's own.
      point, normal: somewhere on each of those.
    """

    altered: Int[np.ndarray, " altered"]
    kept: Cut
    parted: Int[np.ndarray, " parted"]
    table: Int32[np.ndarray, "parted down across"]
    lost: Int[np.ndarray, " lost"]
    point: Float32[np.ndarray, "lost 3"]
    normal: Float32[np.ndarray, "lost 3"]


def build_open_atlas(tracer: Tracer, scene: Scene, resolution: int, padding: int = 2) -> tuple[Atlas, dict[str, int]]:
    """Unwraps a scene and keeps what is there and in the open; see `build_atlas`, `open_atlas` and `transport.cutouts`.

    Raises:
      UserError: all of it is holes, or buried.
    """
    if scene.tubes is not None:
        return _with_strands(scene, resolution, padding, tracer.threads)
    atlas = build_atlas(scene, resolution, padding)
    if tracer.openwork:
        atlas = tracer.openwork.left_of(atlas, scene)
        if not atlas.count:
            raise UserError(
                f"{scene.name}: got opacity below the cutoff everywhere, so that nothing of the scene is left to light, "
                'expected some surface between holes; mend the opacity of its materials, or set effects.off = ["cut-outs"]'
            )
    return open_atlas(tracer, atlas, scene)


def _with_strands(scene: Scene, resolution: int, padding: int, threads: int) -> tuple[Atlas, dict[str, int]]:
    """The same of a scene with strands, which bury nothing: what they grow from is looked at as if they were not there."""
    from ddprt.scene.strand_texels import square_beside, with_strand_texels
    from ddprt.scene.tubes import bald

    side, rest = square_beside(scene, resolution), bald(scene)
    atlas, hidden = (None, {}) if rest is None else build_open_atlas(Tracer.of(rest, threads), rest, side, padding)
    return with_strand_texels(atlas, scene, resolution, simulated=hairy(scene)), hidden


def open_atlas(tracer: Tracer, atlas: Atlas, scene: Scene) -> tuple[Atlas, dict[str, int]]:
    """The atlas of what is in the open.

    A place is buried where more than half of its cosine-weighted rays meet the back of a surface first. Texels that nothing
    reaches through keep every bit. Of the others remains the largest open place, without a rim of up to 1/25 of a texel.

    Args:
      tracer: of the scene.
      atlas: of the whole surface.
      scene: what it unwraps.
    Returns:
      The atlas, and counts of texels: `buried` (dropped), `trimmed` (smaller than before), `parted` (hits on them are looked
      up square by square).
    Raises:
      UserError: everything is buried.
    """
    opener = _Opener(tracer, atlas, scene)
    whole = Cut(np.arange(len(atlas.piece_texel)), atlas.piece_texel, atlas.piece_area, atlas.piece_corners)
    receivers = Receivers.texels(atlas, _FIRST, 0, "openness")
    backs = np.concatenate(list(tracer.map(lambda tile: opener.backs(receivers, tile), receivers.tiles())))
    crossed = opener.crossed(whole, np.arange(atlas.count), _LINES[:2], tracer.map)
    # What pokes in between the diagonals comes from next door.
    near = grown(atlas.image(crossed.astype(np.float32)) > 0).ravel()[atlas.texel]
    shut = (backs == _FIRST) & ~near
    splits = opener.split(whole, np.flatnonzero((near | (backs > 0)) & ~shut), 2 * backs > _FIRST)
    changed = shut
    for split in splits:
        changed[split.altered] = True
    reduced = atlas
    if changed.any():
        kept = whole.some(np.flatnonzero(~changed[atlas.piece_texel]))
        for split in splits:
            kept = kept.joined(split.kept)
        if not len(kept.source):
            raise UserError(
                f"{scene.name}: got a surface that sees backs wherever it looks, expected fronts that face the free space; "
                "turn its triangles around"
            )
        kept = kept.some(np.argsort(kept.source, kind="stable"))
        pieces = atlas.piece_texel[kept.source], kept.area, kept.corners, atlas.piece_triangle[kept.source]
        reduced = restricted(atlas, scene, changed, pieces)
    reduced = opener.with_regions(opener.with_parts(reduced, splits))
    buried = atlas.count - reduced.count
    return reduced, {"buried": buried, "trimmed": int(changed.sum()) - buried, "parted": len(reduced.parted)}


class _Opener:
    """The steps of `open_atlas`; texels and triangles are those of the whole atlas."""

    def __init__(self, tracer: Tracer, atlas: Atlas, scene: Scene) -> None:
        self.tracer, self.atlas = tracer, atlas
        self.landing = Landing.of(atlas, np.zeros(atlas.count, np.int32))
        width = np.sqrt(atlas.area / atlas.coverage)
        self.lift = np.maximum(_LIFT * width, _CLEAR * float(tracer.offset)).astype(np.float32)
        self.low = np.stack([atlas.texel % atlas.resolution, atlas.texel // atlas.resolution], 1)
        # Texel coordinates of a point x on triangle t: on_map[t, :, :3] x + on_map[t, :, 3].
        corners, uv = scene.corners - atlas.centre, atlas.uv * atlas.resolution
        linear = np.einsum("tkc,tdk->tcd", uv[:, 1:] - uv[:, :1], np.linalg.pinv(corners[:, 1:] - corners[:, :1]))
        start = uv[:, 0] - np.einsum("tcd,td->tc", linear, corners[:, 0])
        self.on_map = np.concatenate([linear, start[..., None]], 2)

    @cached_property
    def own(self) -> Int[np.ndarray, " pairs"]:
        """Sorted keys of all pairs of a texel and a triangle on it."""
        return np.unique(self.key(self.atlas.piece_texel, self.atlas.piece_triangle))

    def key(self, texel: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        return texel.astype(np.int64) * len(self.tracer.normals) + triangle

    def backs(self, receivers: Receivers, tile: slice) -> Int[np.ndarray, " tile"]:
        """Rays of each receiver that meet the back of a surface."""
        rays = seen_from(self.tracer, receivers, tile, self.landing)
        return np.asarray(sum((seen.cells == BACK).sum(0) for seen in rays))

    def crossed(
        self,
        cut: Cut,
        texel: Int[np.ndarray, " squares"],
        lines: tuple[tuple[int, int], ...] = _LINES,
        spread: Callable[..., Any] = map,
    ) -> Bool[np.ndarray, " squares"]:
        """Squares (given by their texels) that geometry other than the texel's own stands in, just above the surface."""
        ends = np.zeros((4, len(texel), 3), np.float32)
        triangle = self.atlas.piece_triangle[cut.source]
        find_corners(cut.square, cut.corners, triangle, self.on_map, self.tracer.normals, self.lift[texel], ends)

        def work(first: int) -> np.ndarray:
            part = slice(first, first + _CHUNK)
            inwards = ends[:, part].mean(0) - ends[:, part]
            away = np.maximum(np.linalg.norm(inwards, axis=2, keepdims=True), 1e-30)
            inner = ends[:, part] + np.clip(_CLEAR * self.tracer.offset / away, _INWARDS, 0.25) * inwards
            found = np.zeros(inner.shape[1], bool)
            for one, other in lines:
                found |= self.blocked(inner[one], inner[other], texel[part], texel[part])
            return found

        return np.concatenate([np.zeros(0, bool), *spread(work, range(0, len(texel), _CHUNK))])

    def blocked(
        self,
        start: Float32[np.ndarray, "segments 3"],
        end: Float32[np.ndarray, "segments 3"],
        home: Int[np.ndarray, " segments"],
        away: Int[np.ndarray, " segments"],
    ) -> Bool[np.ndarray, " segments"]:
        """Whether something stands between points on two texels, other than the triangles of those."""
        along = end - start
        length = np.linalg.norm(along, axis=1)
        clear = np.float32(_CLEAR * self.tracer.offset)
        result = np.zeros(len(start), bool)
        chosen = np.flatnonzero(length > 4 * clear)
        directions = along[chosen] / length[chosen, None]
        origins, reach = start[chosen] + clear * directions, length[chosen] - 2 * clear
        stopped = np.flatnonzero(self.tracer.unoccluded(origins, directions, reach) == 0)
        if len(stopped):
            triangle, _, _, distance = self.tracer.first(origins[stopped], directions[stopped])
            other = (triangle >= 0) & (distance <= reach[stopped])
            for texel in (home, away):
                key = self.key(texel[chosen[stopped]], triangle)
                other &= self.own[np.minimum(np.searchsorted(self.own, key), len(self.own) - 1)] != key
            result[chosen[stopped]] = other
        return result

    def split(self, whole: Cut, doubtful: Int[np.ndarray, " texels"], buried: Bool[np.ndarray, " all"]) -> list[_Split]:
        """Cuts doubtful texels into squares and decides what they keep; `buried` is what the first rays say."""
        pattern = Pattern.of(_SECOND, seeds.number(0, "openness"))
        start = np.searchsorted(whole.square, np.arange(self.atlas.count + 1))

        def work(first: int) -> _Split:
            texel = doubtful[first : first + _BATCH]
            count = start[texel + 1] - start[texel]
            local = np.repeat(np.arange(len(texel)), count)
            chosen = np.arange(len(local)) + np.repeat(start[texel] - (np.cumsum(count) - count), count)
            return self._split(texel, whole.some(chosen, local), buried[texel], pattern)

        return list(self.tracer.map(work, range(0, len(doubtful), _BATCH)))

    def _split(self, texel: np.ndarray, whole: Cut, buried: np.ndarray, pattern: Pattern) -> _Split:
        """Squares and places of a batch of texels."""
        low, many = self.low[texel], CUT**2
        step = np.stack(np.divmod(np.arange(many), CUT)[::-1], 1) / CUT
        coarse = self._cut_up(whole, low, 1)
        crossed = self.crossed(coarse, np.repeat(texel, many))
        which = np.flatnonzero(crossed)
        number = np.cumsum(crossed) - 1
        inside = np.flatnonzero(crossed[coarse.square])
        fine = coarse.some(inside, number[coarse.square[inside]])
        fine = self._cut_up(fine, (low[:, None] + step).reshape(-1, 2)[which], CUT)
        through = self.crossed(fine, np.repeat(texel[which // many], many))

        # All on the lattice of the smallest squares: first square by square of the coarse ones, then as an image.
        covered = np.repeat(np.bincount(coarse.square, minlength=len(crossed)) > 0, many).reshape(-1, many)
        covered[which] = (np.bincount(fine.square, minlength=len(through)) > 0).reshape(-1, many)
        clear = covered.copy()
        clear[which] &= ~through.reshape(-1, many)
        place = find_places(as_images(clear))
        of_square = as_images(place, back=True)
        outside, rest = np.flatnonzero(~crossed[coarse.square]), np.flatnonzero(~through[fine.square])
        large = coarse.some(outside, of_square[coarse.square[outside], 0] - 1)
        small = fine.square[rest]
        cut = large.joined(fine.some(rest, of_square[which[small // many], small % many] - 1))
        return self._decided(texel, whole, cut, place, as_images(covered), buried, pattern)

    def _cut_up(self, cut: Cut, low: np.ndarray, scale: int) -> Cut:
        """Pieces cut along the sides of 5 x 5 smaller squares; `low` is each square's corner, `scale` how many fit a texel.

        Squares are laid out side by side as the texels of one large map, and cut as texels are.
        """
        across = int(np.ceil(np.sqrt(max(len(low), 1))))
        on_map = self.on_map[self.atlas.piece_triangle[cut.source]]
        uv = np.einsum("nxd,ncd->ncx", on_map[..., :3], cut.corners) + on_map[:, None, :, 3]
        uv = np.clip((uv - low[cut.square][:, None]) * scale, 0, 1)
        corner = np.stack([cut.square % across, cut.square // across], 1)
        pieces = rasterise((uv + corner[:, None]) * CUT, across * CUT)
        row, column = np.divmod(pieces.texel, across * CUT)
        square = (row // CUT * across + column // CUT) * CUT**2 + row % CUT * CUT + column % CUT
        parent = pieces.triangle
        corners = interpolate(pieces.barycentric, parent, cut.corners.astype(np.float64), np.float32)
        return Cut(cut.source[parent], square, cut.area[parent] * pieces.share, corners)

    def _decided(
        self,
        texel: np.ndarray,
        whole: Cut,
        cut: Cut,
        place: np.ndarray,
        covered: np.ndarray,
        buried: np.ndarray,
        pattern: Pattern,
    ) -> _Split:
        """Keeps the largest open place of each texel; squares of `cut` are places, `place` counts them from 1."""
        from scipy.ndimage import maximum_filter, minimum_filter

        places = int(place.max(initial=0))
        home = np.zeros(places, np.int64)
        home[place[place > 0] - 1] = np.nonzero(place)[0]
        area = np.bincount(cut.square, cut.area, places)
        is_open = np.zeros(places + 1, bool)  # of places counted from 1
        if places:
            sampler = SurfaceSampler.build(cut.square, cut.area, cut.corners, self.atlas.piece_triangle[cut.source])
            row, column = np.divmod(self.atlas.texel[texel[home]], self.atlas.resolution)
            deal = pattern.deal(row, column, seeds.number(0, "openness"))
            receivers = Receivers(sampler, pattern, np.arange(places), *deal)
            backs = np.concatenate([self.backs(receivers, tile) for tile in receivers.tiles()])
            is_open[1:] = 2 * backs <= _SECOND
        best = np.flatnonzero(is_open[1:])
        best = best[np.lexsort((-area[best], home[best]))]
        owner, first = np.unique(home[best], return_index=True)
        mine = np.full(len(texel), -1)
        mine[owner] = best[first]
        # Where every square is crossed there is no place: the first rays decide on the whole texel.
        crowded = (np.bincount(home, minlength=len(texel)) == 0) & ~buried
        altered = (covered & (place != (mine + 1)[:, None, None])).any((1, 2)) & ~crowded

        kept = cut.some(np.flatnonzero((mine[home] == np.arange(places))[cut.square]))
        kept = kept.some(np.flatnonzero(altered[home[kept.square]]))
        piece = np.searchsorted(whole.source, kept.source)
        entire = np.bincount(piece, kept.area, len(whole.source)) >= _ALL * whole.area
        kept = whole.some(np.flatnonzero(entire)).joined(kept.some(np.flatnonzero(~entire[piece])))

        lost = np.flatnonzero(is_open[1:] & (mine[home] != np.arange(places)))
        value = np.where(is_open, 0, -1).astype(np.int32)
        value[lost + 1] = 1 + np.arange(len(lost))
        beside = np.where(is_open[place], place, 0)
        high = maximum_filter(beside, (1, 3, 3), mode="constant")
        low = minimum_filter(np.where(beside > 0, beside, places + 1), (1, 3, 3), mode="nearest")
        solid = maximum_filter((place > 0) & ~is_open[place], (1, 3, 3), mode="constant")
        # A crossed square between a solid and one open place belongs to that: the solid is wider than a square, so nothing else
        # can lie behind it. In all others a thin wall may stand.
        rim = np.where((high == low) & solid, value[high], -1)
        table = np.where(covered, np.where(place > 0, value[place], rim), 0).astype(np.int32)
        parted = np.flatnonzero(altered & (mine >= 0) & table.any((1, 2)))
        largest = np.lexsort((-cut.area, cut.square))[np.searchsorted(np.sort(cut.square), lost)]
        return _Split(
            texel[altered],
            kept,
            texel[parted],
            table[parted],
            texel[home[lost]],
            cut.corners[largest].mean(1),
            self.tracer.normals[self.atlas.piece_triangle[cut.source[largest]]],
        )

    def with_parts(self, reduced: Atlas, splits: list[_Split]) -> Atlas:
        """The reduced atlas, with what hits on texels on both sides of a wall belong to."""
        parted, part = [], []
        for split in splits:
            if len(split.parted):
                own = reduced.slot.ravel()[self.atlas.texel[split.parted]]
                value = np.concatenate([[-1], self._neighbours(reduced, split)]).astype(np.int32)
                found = np.where(split.table > 0, value[np.maximum(split.table, 0)], -1)
                parted.append(own.astype(np.int64))
                part.append(np.where(split.table == 0, own[:, None, None], found).astype(np.int32))
        return replace(reduced, parted=np.concatenate(parted), part=np.concatenate(part)) if parted else reduced

    def _neighbours(self, reduced: Atlas, split: _Split) -> Int32[np.ndarray, " lost"]:
        """For each lost place the nearest texel next to its own that it sees, -1 for none."""
        size = self.atlas.resolution
        start = split.point + self.lift[split.lost, None] * split.normal
        nearest, result = np.full(len(split.lost), np.inf), np.full(len(split.lost), -1, np.int32)
        for down, right in ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y):
            column, row = (self.low[split.lost] + [right, down]).T
            inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < size)
            row, column = np.clip(row, 0, size - 1), np.clip(column, 0, size - 1)
            other, before = reduced.slot[row, column], self.atlas.slot[row, column]
            fits = np.flatnonzero(inside & (other >= 0) & (self.atlas.chart[before] == self.atlas.chart[split.lost]))
            end = self._places_of(reduced, other[fits], before[fits])
            distance = np.linalg.norm(end - start[fits], axis=1)
            seen = ~self.blocked(start[fits], end, split.lost[fits], before[fits]) & (distance < nearest[fits])
            nearest[fits[seen]], result[fits[seen]] = distance[seen], other[fits[seen]]
        return result

    def _places_of(self, reduced: Atlas, texel: np.ndarray, before: np.ndarray) -> Float32[np.ndarray, "n 3"]:
        """Positions of texels, lifted; `before` is their index in the whole atlas."""
        lifted = reduced.position[texel] - self.atlas.centre + self.lift[before, None] * reduced.geometric_normal[texel]
        return lifted.astype(np.float32)

    def with_regions(self, reduced: Atlas) -> Atlas:
        """The reduced atlas, with each chart divided into the regions that walls on it bound."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        slot = reduced.slot
        pairs = [np.stack([slot[:, :-1], slot[:, 1:]], -1).reshape(-1, 2), np.stack([slot[:-1], slot[1:]], -1).reshape(-1, 2)]
        pair = np.concatenate(pairs)
        pair = pair[(pair >= 0).all(1)]
        pair = pair[reduced.chart[pair[:, 0]] == reduced.chart[pair[:, 1]]]
        before = self.atlas.slot.ravel()[reduced.texel]
        place = self._places_of(reduced, np.arange(reduced.count), before)

        def work(first: int) -> np.ndarray:
            one, other = pair[first : first + _CHUNK].T
            return self.blocked(place[one], place[other], before[one], before[other])

        blocked = np.concatenate([np.zeros(0, bool), *self.tracer.map(work, range(0, len(pair), _CHUNK))])
        if not blocked.any():
            return reduced
        one, other = pair[~blocked].T
        graph = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(reduced.count,) * 2)
        return replace(reduced, chart=connected_components(graph, directed=False)[1].astype(np.int32))
