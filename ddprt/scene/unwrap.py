"""Charts by xatlas, packed to exactly the resolution that was asked for, remembered by mesh hash; or the file's own."""

import hashlib
import tempfile
import time
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import xatlas

from ddprt.axes import Float64, Int32
from ddprt.errors import UserError
from ddprt.files import cache_folder
from ddprt.scene.folds import folded
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import fault_of, own_charts
from ddprt.scene.patches import Patches, cut, hard_parts
from ddprt.scene.winding import welded

_STEPS = 14  # of the bisection: texel density is met to 1e-4
_FINE, _USUAL, _LESS = 2e-3, 0.8, 0.85  # for patches: how close density is met; begin of the search against full cover; step
_TOUCHING = 1e-5  # of a chart's size: overlap of two triangles in xatlas' float32 that is none
_MAGNIFIED = 4096.0
_ASLEEP = 0.002  # seconds until xatlas' threads sleep: its destructor waits for ever for one about to
_FORMAT = "2"  # part of the cache key: raise it when the unwrapping changes


def unwrap(
    scene: Scene, resolution: int, padding: int
) -> tuple[Float64[np.ndarray, "triangles 3 2"], Int32[np.ndarray, " triangles"]]:
    """Lightmap coordinates of every triangle corner: the scene's own where it has sound ones, else new ones.

    Args:
      scene: what to unwrap; of a pose its rest pose, so that charts stay on the mesh as it moves.
      resolution: texels per side; the packing fills exactly this square.
      padding: empty texels between charts.
    Returns:
      Corners in the unit square (origin top-left as in glTF), and the chart of each triangle.
    Raises:
      UserError: the charts cannot be packed into so few texels.
    """
    scene = scene.rest or scene
    if scene.lightmap is not None and not fault_of(scene, resolution, padding):
        return own_charts(scene)
    key = hashlib.sha256(f"{_FORMAT} {scene.digest} {resolution} {padding} {xatlas.__version__}".encode()).hexdigest()[:24]
    path = cache_folder() / f"unwrap-{key}.npz"
    try:
        with np.load(path) as stored:
            return stored["uv"], stored["chart"]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        pass  # absent, or damaged: make it anew
    uv, chart = _unwrap(scene, resolution, padding)
    _remember(path, uv=uv, chart=chart)
    return uv, chart


def _unwrap(scene: Scene, resolution: int, padding: int) -> tuple[np.ndarray, np.ndarray]:
    # Centred and scaled, so that float32 and xatlas' own tolerances mean the same for every scene size.
    placed = (scene.positions - scene.centre) / scene.radius
    positions = placed.astype(np.float32)
    weld = welded(positions)[scene.triangles]
    part, hard = hard_parts(positions[scene.triangles], weld)
    while True:  # until no chart of xatlas lies on itself: what does is cut into patches too
        easy = ~hard[part]
        flat, corners, chart = _charts(scene, positions, easy)
        bad = folded(flat[corners].astype(np.float64), chart, _TOUCHING) if easy.any() else np.zeros(0, bool)
        if not bad.any():
            break
        hard[part[easy][bad[chart]]] = True
    if hard.any():
        patches = cut(placed[scene.triangles[~easy]], weld[~easy])
        flat, corners, chart = _joined(flat, corners, chart, patches, weld, easy)
        best = _fitted(flat, corners, chart, resolution, padding)
    else:
        best = _bisected(flat, corners, resolution, padding)
    if best is None:
        remedy = "raise atlas.resolution" + (" or lower atlas.padding" if padding > 1 else "")
        raise UserError(
            f'atlas.resolution: got {resolution}, expected more for the {chart.max() + 1} charts of "{scene.name}" '
            f"with padding {padding}; {remedy}"
        )
    return best[corners].astype(np.float64), chart


def _charts(scene: Scene, positions: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat vertices of xatlas' charts of the chosen triangles in units of the scene's radius, corners, chart of each."""
    triangles, normals = scene.triangles[chosen], scene.normals
    if not len(triangles):
        return np.zeros((0, 2), np.float32), np.zeros((0, 3), np.uint32), np.zeros(0, np.int32)
    if len(triangles) < len(chosen):
        used, triangles = np.unique(triangles, return_inverse=True)
        positions, normals, triangles = positions[used], normals[used], triangles.reshape(-1, 3)
    charts = xatlas.Atlas()
    charts.add_mesh(positions, triangles.astype(np.uint32), normals.astype(np.float32))
    charts.generate()
    time.sleep(_ASLEEP)
    _, corners, uv = charts[0]
    _, chart_of_vertex = charts.get_mesh_vertex_assignment(0)
    if charts.atlas_count != 1:
        raise UserError(f'scene "{scene.name}": got {charts.atlas_count} atlases from xatlas, expected 1; repair the mesh')
    flat = (uv * [charts.width, charts.height] / charts.texels_per_unit).astype(np.float32)
    return flat, corners, chart_of_vertex[corners[:, 0]].astype(np.int32)


def _joined(
    flat: np.ndarray, corners: np.ndarray, chart: np.ndarray, patches: Patches, weld: np.ndarray, easy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, corners and charts of all triangles, those of xatlas first."""
    key = patches.patch[:, None] * (int(weld.max()) + 1) + weld[~easy]
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    all_corners, all_charts = np.empty((len(easy), 3), np.uint32), np.empty(len(easy), np.int32)
    all_corners[easy], all_corners[~easy] = corners, len(flat) + number.reshape(-1, 3)
    all_charts[easy], all_charts[~easy] = chart, (chart.max() + 1 if len(chart) else 0) + patches.patch
    return np.concatenate([flat, patches.flat.reshape(-1, 2)[first].astype(np.float32)]), all_corners, all_charts


def _bisected(flat: np.ndarray, corners: np.ndarray, resolution: int, padding: int) -> np.ndarray | None:
    low, high, best = 0.0, float(resolution), None
    for _ in range(_STEPS):
        density = 0.5 * (low + high)
        packed = _pack(flat, corners, None, density, resolution, padding)
        low, high, best = (density, high, packed) if packed is not None else (low, density, best)
    return best


def _fitted(flat: np.ndarray, corners: np.ndarray, chart: np.ndarray, resolution: int, padding: int) -> np.ndarray | None:
    """The densest packing to `_FINE`: down from what charts usually reach until one fits, then bisected."""
    area = _area(flat[corners])
    low, high, best = 0.0, _full(flat[corners], chart, resolution, padding), None
    density, failures = _USUAL * high, 0
    while density > resolution * 0.5**_STEPS:
        packed = _pack(flat, corners, chart, density, resolution, padding)
        if packed is not None and _area(packed[corners] * resolution) < 0.99 * density**2 * area:
            packed = None  # xatlas has shrunk a chart that was larger than the atlas
        low, high, best = (density, high, packed) if packed is not None else (low, density, best)
        failures += best is None
        if high - low < _FINE * high:
            break
        density = 0.5 * (low + high) if best is not None or failures > 3 else _LESS * high
    return best


def _full(corners: np.ndarray, chart: np.ndarray, resolution: int, padding: int) -> float:
    """Density at which discs of the charts' areas, each within half the padding, would cover everything: none is denser."""
    size = np.bincount(chart, _areas(corners))
    # sum of pi (r d + padding / 2)², a square of d
    a, b, c = size.sum(), padding * np.sqrt(np.pi * size).sum(), 0.25 * np.pi * padding**2 * len(size) - resolution**2
    return float((np.sqrt(max(b * b - 4 * a * c, 0.0)) - b) / (2 * a))


def _area(corners: np.ndarray) -> float:
    return float(_areas(corners).sum())


def _areas(corners: np.ndarray) -> np.ndarray:
    a, b = np.moveaxis(corners[:, 1:].astype(np.float64) - corners[:, :1], 1, 0)
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _pack(
    flat: np.ndarray, corners: np.ndarray, chart: np.ndarray | None, density: float, resolution: int, padding: int
) -> np.ndarray | None:
    """Corners in the unit square; without `chart`, what touches in `flat` is one."""
    atlas = xatlas.Atlas()
    # xatlas drops triangles below 1.2e-7 of area: charts that it did not make itself come to it magnified.
    scale = 1.0 if chart is None else _MAGNIFIED
    atlas.add_uv_mesh(flat * np.float32(scale), corners, None if chart is None else chart.astype(np.uint32)[:, None])
    options = xatlas.PackOptions()
    options.resolution, options.texels_per_unit, options.padding = resolution, density / scale, padding
    atlas.generate(pack_options=options)
    time.sleep(_ASLEEP)
    if atlas.atlas_count != 1 or max(atlas.width, atlas.height) > resolution:
        return None
    vertex, order, uv = atlas[0]
    if not (order == corners).all() or not (vertex == np.arange(len(flat))).all():
        return None
    return np.clip(uv * [atlas.width / resolution, atlas.height / resolution], 0, 1)


def _remember(path: Path, **arrays: np.ndarray) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        Path(file.name).replace(path)
    except OSError:
        pass  # a cache that cannot be written only costs time
