"""Charts by xatlas, packed to exactly the resolution that was asked for, remembered by mesh hash."""

import hashlib
import os
import tempfile
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import xatlas

from ddprt.axes import Float64, Int32
from ddprt.errors import UserError
from ddprt.scene.mesh import Scene

_STEPS = 14  # of the bisection: texel density is met to 1e-4
_FORMAT = "1"  # part of the cache key: raise it when the unwrapping changes


def unwrap(
    scene: Scene, resolution: int, padding: int
) -> tuple[Float64[np.ndarray, "triangles 3 2"], Int32[np.ndarray, " triangles"]]:
    """Lightmap coordinates of every triangle corner.

    Args:
      scene: what to unwrap.
      resolution: texels per side; the packing fills exactly this square.
      padding: empty texels between charts.
    Returns:
      Corners in the unit square (origin top-left as in glTF), and the chart of each triangle.
    Raises:
      UserError: the charts cannot be packed into so few texels.
    """
    key = hashlib.sha256(f"{_FORMAT} {scene.digest} {resolution} {padding} {xatlas.__version__}".encode()).hexdigest()[:24]
    path = _cache_folder() / f"unwrap-{key}.npz"
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
    positions = ((scene.positions - scene.centre) / scene.radius).astype(np.float32)
    charts = xatlas.Atlas()
    charts.add_mesh(positions, scene.triangles.astype(np.uint32), scene.normals.astype(np.float32))
    charts.generate()
    _, corners, uv = charts[0]
    _, chart_of_vertex = charts.get_mesh_vertex_assignment(0)
    if charts.atlas_count != 1:
        raise UserError(f'scene "{scene.name}": got {charts.atlas_count} atlases from xatlas, expected 1; repair the mesh')
    flat = (uv * [charts.width, charts.height] / charts.texels_per_unit).astype(np.float32)
    low, high, best = 0.0, float(resolution), None
    for _ in range(_STEPS):
        density = 0.5 * (low + high)
        packed = _pack(flat, corners, density, resolution, padding)
        low, high, best = (density, high, packed) if packed is not None else (low, density, best)
    if best is None:
        raise UserError(
            f'atlas.resolution: got {resolution}, too small for the {charts.chart_count} charts of "{scene.name}" '
            f"with padding {padding}; raise atlas.resolution or lower atlas.padding"
        )
    return best[corners].astype(np.float64), chart_of_vertex[corners[:, 0]].astype(np.int32)


def _pack(flat: np.ndarray, corners: np.ndarray, density: float, resolution: int, padding: int) -> np.ndarray | None:
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(flat, corners)
    options = xatlas.PackOptions()
    options.resolution, options.texels_per_unit, options.padding = resolution, density, padding
    atlas.generate(pack_options=options)
    if atlas.atlas_count != 1 or max(atlas.width, atlas.height) > resolution:
        return None
    vertex, order, uv = atlas[0]
    if not (order == corners).all() or not (vertex == np.arange(len(flat))).all():
        return None
    return np.clip(uv * [atlas.width / resolution, atlas.height / resolution], 0, 1)


def _cache_folder() -> Path:
    base = os.environ.get("DDPRT_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ddprt"
    return Path(base)


def _remember(path: Path, **arrays: np.ndarray) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        Path(file.name).replace(path)
    except OSError:
        pass  # a cache that cannot be written only costs time
