"""Cut-outs: surfaces with holes that let light through, as leaves and fences have.

Embree is not asked to look at masks: a ray that ends in a hole goes on from behind it. How far it may go is known beforehand,
from a geometry of all that has no holes, so that no step, however rounded, leads through a wall; up to there it passes the
masked triangles, which are a geometry of their own, one after another. Rays that meet none of them pay nothing.

Steps are a quarter of the offset between a ray's origin and its surface. The sides of a sheet without thickness are traced
that whole offset apart (see `embree`), so that none is skipped. Where two masked triangles are nearer than a step to each
other along a ray, and not sides of one sheet, the second is skipped if the first is a hole there.
"""

from collections.abc import Callable

import numpy as np

from ddprt.axes import Float32, Float64, Int, Int32
from ddprt.compiled import compiled
from ddprt.scene.atlas import SHUT, Atlas, restricted, weights_at
from ddprt.scene.holes import Holes
from ddprt.scene.mesh import Scene
from ddprt.transport.packets import Geometry

LAYERS = 1024
"""Holes that a ray may pass; the next one stops it as if it were none. So no scene keeps a ray for ever."""

_STEP = 0.25  # of the offset
_FINEST = 5  # halvings of a piece's sides that look for holes in it, at most
_COARSEST = 3  # and at least: the rim of a hole is met to an eighth of a piece
_CHUNK = 1 << 20  # places that are looked up together


class Openwork:
    """The holes of a scene, for rays.

    Args:
      holes: where they are.
      corners: of all triangles as Embree knows them, centred frame, metres.
      offset: between a ray's origin and its surface, metres.
      count: is told how many rays are traced.
    """

    def __init__(
        self,
        holes: Holes,
        corners: Float32[np.ndarray, "triangles 3 3"],
        offset: np.float32,
        count: Callable[[int], None],
    ) -> None:
        self.holes, self.step, self._count = holes, _STEP * float(offset), count
        self._solid, self._masked = np.flatnonzero(holes.row < 0), np.flatnonzero(holes.row >= 0)
        self._opaque, self._layers = Geometry(corners[self._solid]), Geometry(corners[self._masked])
        self._low, self._high = corners[self._masked].min((0, 1)) - offset, corners[self._masked].max((0, 1)) + offset

    def first(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        found: tuple[np.ndarray, ...],
    ) -> tuple[np.ndarray, ...]:
        """First hits that are no holes; `found` are those with all triangles, and changed in place."""
        triangle, u, v, distance = found
        through = np.flatnonzero(self.holes.open_at(triangle, u, v))
        if not len(through):
            return found
        origins, directions = origins[through], directions[through]
        self._count(len(through))
        behind, *place, reach = self._opaque.first(origins, directions)
        met = np.where(behind >= 0, self._solid[behind] if len(self._solid) else -1, -1)
        layer = self._passed(origins, directions, reach, distance[through].astype(np.float64), triangle[through])
        stopped = layer[0] >= 0
        for mine, wall, leaf in zip(found, (met, *place, reach), layer, strict=True):
            mine[through] = np.where(stopped, leaf, wall)
        return found

    def unoccluded(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        reach: Float32[np.ndarray, " rays"],
    ) -> Int32[np.ndarray, " rays"]:
        """As `Tracer.unoccluded`."""
        self._count(len(origins))
        seen = self._opaque.unoccluded(origins, directions, reach)
        chosen = np.empty(len(seen) + 1, np.int64)
        near = chosen[: _choose(seen, origins, directions, reach, self._low, self._high, chosen)]
        if len(near):
            none = np.full(len(near), -1, np.int32)
            layer = self._passed(origins[near], directions[near], reach[near], np.full(len(near), -self.step), none)
            seen[near[layer[0] >= 0]] = 0
        return seen

    def left_of(self, atlas: Atlas, scene: Scene) -> Atlas:
        """See `without_holes`."""
        return without_holes(atlas, scene, self.holes)

    def _passed(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        reach: Float32[np.ndarray, " rays"],
        travelled: Float64[np.ndarray, " rays"],
        before: Int32[np.ndarray, " rays"],
    ) -> tuple[np.ndarray, ...]:
        """Masked triangle that stops each ray (-1: none within its reach), weights and distance.

        Args:
          origins, directions, reach: of the rays.
          travelled: distance to the hole that each has passed, metres.
          before: triangle of that hole.
        """
        rays = len(origins)
        stop = np.full(rays, -1, np.int32)
        u, v, distance = np.zeros((3, rays), np.float32)
        step = np.full(rays, self.step)
        alive = np.arange(rays)
        for layer in range(LAYERS + 1):
            alive = alive[travelled[alive] + step[alive] < reach[alive]]
            if not len(alive):
                break
            at = travelled[alive] + step[alive]
            starts = (origins[alive] + at[:, None] * directions[alive]).astype(np.float32)
            self._count(len(alive))
            found, second, third, length = self._layers.first(starts, directions[alive], (reach[alive] - at).astype(np.float32))
            hit = np.flatnonzero(found >= 0)
            alive, second, third = alive[hit], second[hit], third[hit]
            triangle = self._masked[found[hit]].astype(np.int32)
            travelled[alive] = at[hit] + length[hit]
            is_open = self.holes.open_at(triangle, second, third) & (layer < LAYERS)
            # Along a surface a step may be lost to rounding, and the ray meets it again.
            step[alive] = np.where(triangle == before[alive], 2 * step[alive], self.step)
            before[alive] = triangle
            end = alive[~is_open]
            stop[end], u[end], v[end] = triangle[~is_open], second[~is_open], third[~is_open]
            distance[end] = travelled[end]
            alive = alive[is_open]
        return stop, u, v, distance


@compiled
def _choose(
    seen: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    reach: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    chosen: np.ndarray,
) -> int:
    """Writes which rays that see their light pass the box of the masked triangles; returns their number."""
    count = 0
    for ray in range(len(seen)):
        if seen[ray] == 0:
            continue
        enter, leave = np.float32(0), reach[ray]
        for axis in range(3):
            along, place = directions[ray, axis], origins[ray, axis]
            if along == 0:
                if place < low[axis] or place > high[axis]:
                    leave = np.float32(-1)
                continue
            one, other = (low[axis] - place) / along, (high[axis] - place) / along
            enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
        chosen[count] = ray
        count += enter <= leave
    return count


def without_holes(atlas: Atlas, scene: Scene, holes: Holes) -> Atlas:
    """The atlas of what is there: texels keep what of them is no hole, those wholly in holes go.

    Pieces that a hole cuts are halved, up to five times, into triangles that are kept where their middle is no hole.

    Args:
      atlas: of the whole surface.
      scene: what it unwraps.
      holes: of the scene.
    """
    masked = np.flatnonzero(holes.row[atlas.piece_triangle] >= 0)
    if not len(masked):
        return atlas
    triangle, corners = atlas.piece_triangle[masked], atlas.piece_corners[masked]
    around = (scene.corners - atlas.centre)[triangle]
    weights = np.stack([weights_at(around, corners[:, corner].astype(np.float64)) for corner in range(3)], 1)
    row = holes.row[triangle]
    uv = np.einsum("nkc,ncd->nkd", weights, holes.uv[row])
    pixels = (np.ptp(uv, axis=1) * holes.size[holes.image[row], ::-1]).max(1)
    depth = np.clip(np.ceil(np.log2(np.maximum(2 * pixels, 1))), _COARSEST, _FINEST).astype(int)
    whole, source, shape = np.zeros(len(masked), bool), [], []
    for level in np.unique(depth):
        group = np.flatnonzero(depth == level)
        for first in range(0, len(group), max(1, _CHUNK >> (2 * level))):
            part = group[first : first + max(1, _CHUNK >> (2 * level))]
            entire, parent, cut = _solid_parts(holes, triangle[part], weights[part], int(level))
            whole[part[entire]] = True
            source.append(part[parent])
            shape.append(cut)
    changed = np.zeros(atlas.count, bool)
    changed[atlas.piece_texel[masked[~whole]]] = True
    origin, cut = np.concatenate(source), np.concatenate(shape)
    kept = np.ones(len(atlas.piece_texel), bool)
    kept[masked[~whole]] = False
    old, home = np.flatnonzero(kept), masked[origin]
    small = np.einsum("nkc,ncd->nkd", cut, corners[origin].astype(np.float64)).astype(np.float32)
    texel = np.concatenate([atlas.piece_texel[old], atlas.piece_texel[home]])
    area = np.concatenate([atlas.piece_area[old], atlas.piece_area[home] * np.abs(np.linalg.det(cut))])
    place = np.concatenate([atlas.piece_corners[old], small])
    face = np.concatenate([atlas.piece_triangle[old], triangle[origin]])
    order = np.argsort(texel, kind="stable")
    reduced = restricted(atlas, scene, changed, (texel[order], area[order], place[order], face[order]))
    # A ray that meets what little is left of a texel finds its neighbours, as beside any chart.
    reduced.slot[reduced.slot == SHUT] = -1
    return reduced


def _solid_parts(
    holes: Holes, triangle: Int32[np.ndarray, " n"], weights: Float64[np.ndarray, "n 3 3"], depth: int
) -> tuple[np.ndarray, Int[np.ndarray, " parts"], Float64[np.ndarray, "parts 3 3"]]:
    """Pieces without holes, and of the others the parts that are none: whose they are and weights of the piece's corners."""
    levels = _halved(depth)
    middle = levels[-1].mean(1)
    place = np.einsum("mk,nkc->nmc", middle, weights).reshape(-1, 3)
    is_open = holes.open_at(np.repeat(triangle, len(middle)), place[:, 1].copy(), place[:, 2].copy())
    solid = [np.asarray(~is_open).reshape(len(triangle), -1)]
    for _ in range(depth):
        solid.append(np.asarray(solid[-1].reshape(len(triangle), -1, 4).all(2)))
    solid.reverse()
    parent, cut = [np.zeros(0, np.int64)], [np.zeros((0, 3, 3))]
    covered = solid[0]
    for level in range(1, depth + 1):
        covered = np.repeat(covered, 4, axis=1)
        piece, part = np.nonzero(solid[level] & ~covered)
        parent.append(piece)
        cut.append(levels[level][part])
        covered |= solid[level]
    return solid[0][:, 0], np.concatenate(parent), np.concatenate(cut)


def _halved(depth: int) -> list[Float64[np.ndarray, "parts 3 3"]]:
    """A triangle's parts, halved in each direction again and again, as weights of its corners; four in a row make one."""
    levels = [np.eye(3)[None]]
    for _ in range(depth):
        a, b, c = np.moveaxis(levels[-1], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        levels.append(np.stack([np.stack(part, 1) for part in parts], 1).reshape(-1, 3, 3))
    return levels
