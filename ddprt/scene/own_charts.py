"""A lightmap layout that the file brings along: taken as it is where it is sound, or the fault told.

In glTF it is TEXCOORD_1. Its triangles must lie in the unit square, each with an area of its own, nowhere on each other, and
charts as many texels apart as the atlas asks for at its resolution.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ddprt.axes import Float64, Int32
from ddprt.errors import UserError
from ddprt.scene.folds import folded
from ddprt.scene.mesh import Scene
from ddprt.scene.raster import rasterise
from ddprt.scene.sheets import backs
from ddprt.scene.winding import welded

Use = Literal["auto", "own", "new"]

_BEYOND = 1e-6  # of the square: rounding of a packer, moved back in
_TOUCHING = 1e-6  # of the square: overlap that is none
_THIN = 1e-6  # share of the mean density of texels below which a triangle has no area on the map
_HAIR = 1e-3  # of a texel: less of a chart in it is rounding
_KEPT = "lightmap: the file's own second texture coordinates are used"


def charted(scene: Scene, use: Use, resolution: int, padding: int) -> Scene:
    """The scene with its own layout where that is to be used, and without where not; a note says which, and why.

    Args:
      scene: as loaded.
      use: "auto": its own where it has one that is sound; "own": that or nothing; "new": never.
      resolution, padding: of the atlas.
    Raises:
      UserError: "own", and there is none, or it is not sound.
    """
    if use == "own" and scene.lightmap is None:
        raise UserError(
            f'atlas.use: got "own", but "{scene.name}" has no second texture coordinates (TEXCOORD_1), expected a layout '
            'of its own; unwrap it, or set atlas.use = "auto"'
        )
    if scene.lightmap is None:
        return scene
    fault = "" if use == "new" else fault_of(scene, resolution, padding)
    if use == "own" and fault:
        raise UserError(
            f'atlas.use: got "own", but the layout of "{scene.name}" {fault}; mend its second texture coordinates, or set '
            'atlas.use = "auto"'
        )
    if use == "new" or fault:
        why = "as asked" if use == "new" else f"since it {fault}"
        return replace(scene, lightmap=None, notes=(*scene.notes, f"lightmap: the file's own layout is not used, {why}"))
    return scene if _KEPT in scene.notes else replace(scene, notes=(*scene.notes, _KEPT))


def fault_of(scene: Scene, resolution: int, padding: int) -> str:
    """What keeps the scene's own layout from being its lightmap at this resolution, after "it"; empty if nothing does."""
    uv = _corners(scene)
    if np.isnan(uv).any():
        return f"leaves out {np.count_nonzero(np.isnan(uv).any((1, 2)))} of {len(uv)} triangles"
    if not ((uv >= -_BEYOND) & (uv <= 1 + _BEYOND)).all():
        return f"reaches from {uv.min():.4g} to {uv.max():.4g}, beyond the unit square"
    edges = uv[:, 1:] - uv[:, :1]
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    flat = area <= _THIN * area.sum() / scene.areas.sum() * scene.areas
    if flat.any():
        return f"has {np.count_nonzero(flat)} triangles of no area"
    if backs(scene).any():
        return "has no place for the backs of two-sided surfaces, which would share the texels of their fronts"
    if folded(np.clip(uv, 0, 1), np.zeros(len(uv), np.int64), _TOUCHING)[0]:
        return "lies on itself, as where several nodes share a mesh"
    gap = _gap(*own_charts(scene), resolution, padding)
    if gap < padding:
        apart = f"only {gap} texels apart" if gap >= 0 else "in the same texels"
        remedy = "raise atlas.resolution" + (f" or lower atlas.padding to {gap}" if gap > 0 else "")
        return f"has charts {apart} at atlas.resolution {resolution}, less than atlas.padding {padding} ({remedy})"
    return ""


def charts_apart(scene: Scene, resolution: int, texels: int) -> bool:
    """Whether charts of the scene's own layout have so many empty texels between them; its coordinates must be all there."""
    return _gap(*own_charts(scene), resolution, texels) >= texels


def own_charts(scene: Scene) -> tuple[Float64[np.ndarray, "triangles 3 2"], Int32[np.ndarray, " triangles"]]:
    """Corners of the scene's own layout in the unit square, origin top-left, and the chart of each triangle.

    Triangles are of one chart where they share a corner in space and on the map.
    """
    uv = np.clip(_corners(scene), 0, 1)
    place = np.column_stack([welded(scene.positions)[scene.triangles].ravel(), uv.reshape(-1, 2)])
    _, corner = np.unique(place, axis=0, return_inverse=True)
    a, b, c = corner.reshape(-1, 3).T
    links = coo_matrix((np.ones(2 * len(a)), (np.concatenate([a, b]), np.concatenate([b, c]))), shape=(corner.max() + 1,) * 2)
    return uv, connected_components(links, directed=False)[1][a].astype(np.int32)


def _corners(scene: Scene) -> Float64[np.ndarray, "triangles 3 2"]:
    assert scene.lightmap is not None
    return scene.lightmap[scene.triangles]


def _gap(uv: np.ndarray, chart: np.ndarray, resolution: int, enough: int) -> int:
    """Empty texels between charts, at most `enough`; -1 where two are in one texel."""
    pieces = rasterise(uv * resolution, resolution)
    charts = int(chart.max()) + 1
    key, index = np.unique(pieces.texel * charts + chart[pieces.triangle], return_inverse=True)
    key = key[np.bincount(index, pieces.uv_area) > _HAIR]
    texel, own = np.divmod(key, charts)
    if (np.diff(texel) == 0).any():
        return -1
    first = np.full((resolution, resolution), -1)
    first.ravel()[texel] = own
    last = np.where(first < 0, charts, first)
    gap = 0
    while gap < enough:  # charts that are further apart do not meet in a window of this size about a texel
        size = 2 * (gap + 1) + 1
        most, least = (
            maximum_filter(first, size, mode="constant", cval=-1),
            minimum_filter(last, size, mode="constant", cval=charts),
        )
        if ((first >= 0) & ((most != first) | (least != last))).any():
            break
        gap += 1
    return gap
