"""Measurement points of an import: texels of the direct maps, given ones, or numbers without a place."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ddprt import seeds
from ddprt.axes import Float, Float32, Int
from ddprt.dataset.importers.places import Places
from ddprt.errors import UserError
from ddprt.sampling.points import Samples, eliminate, load_samples

_DENSITY = 5  # candidates for each point kept


@dataclass(frozen=True, eq=False)
class Chosen:
    """Points, and where their light is found.

    Attributes:
      samples: the points.
      texel: covered texel of each.
    """

    samples: Samples
    texel: Int[np.ndarray, " points"]


def choose_points(asked: str, folder: Path, places: Places, seed: int) -> Chosen:
    """Texels of the direct maps: evenly spread by area, or those that are given.

    Args:
      asked: how many, or a JSON file in the folder: of {"position", "normal", "albedo"} in the world as for `points.file` of a
        bake, or of {"texel": [column, row]}.
      folder, places: of the import.
      seed: of the run.
    Raises:
      UserError: more points than texels, a faulty file, or a point on no texel.
    """
    if asked.isdigit():
        return _spread(int(asked), places, seed)
    path = folder / asked
    if not asked.endswith(".json"):
        raise UserError(f'--points: got "{asked}", expected how many, or a .json file of points; mend it')
    texel = _texels(path, places)
    if texel is None:
        if "position" not in places.known:
            raise UserError(f"{path}: got positions, but texels without a place; give --geometry, --position, or texels")
        given = load_samples(path)
        texel = cKDTree(places.position).query(given.position)[1]
    return Chosen(_samples(places, texel), texel)


def _spread(count: int, places: Places, seed: int) -> Chosen:
    total = len(places.area)
    if count < 1:
        raise UserError(f"--points: got {count}, expected 1 to {total}, as many as texels count; raise --points")
    if count > total:
        raise UserError(f"--points: got {count}, but {total} texels count; lower --points")
    rng = seeds.stream(seed, "import points")
    weight = np.cumsum(places.area, dtype=np.float64)
    tried = _DENSITY * count
    strata = (np.arange(tried) + rng.random(tried)) / tried * weight[-1]
    candidates = np.unique(np.minimum(np.searchsorted(weight, strata, side="right"), total - 1))
    if len(candidates) < count:
        rest = np.setdiff1d(np.arange(total), candidates)
        candidates = np.concatenate([candidates, rng.permutation(rest)[: count - len(candidates)]])
    order = eliminate(places.position[candidates].astype(np.float64), count, float(weight[-1]))
    return Chosen(_samples(places, candidates[order]), candidates[order])


def _samples(places: Places, texel: Int[np.ndarray, " points"]) -> Samples:
    position, normal, albedo = (getattr(places, name)[texel].astype(np.float64) for name in ("position", "normal", "albedo"))
    return Samples(position, normal, albedo, float(np.sqrt(places.area.sum(dtype=np.float64) / len(texel))))


def _texels(path: Path, places: Places) -> Int[np.ndarray, " points"] | None:
    """Covered texels of a file of [column, row]; None where it has none of these."""
    try:
        records = json.loads(path.read_text("utf-8"))
        if not isinstance(records, list) or not records or "texel" not in records[0]:
            return None
        at = np.array([record["texel"] for record in records])
        if at.shape != (len(records), 2) or not np.issubdtype(at.dtype, np.integer):
            raise ValueError("expected two whole numbers each")
    except OSError as error:
        raise UserError(f"--points {path}: got {error.strerror or error}, expected a JSON list of points") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f'--points {path}: not a JSON list of {{"texel": [column, row]}} ({error}); mend it') from None
    slot = np.full(places.covered.shape, -1)
    slot[places.covered] = np.arange(len(places.area))
    for column, row in at.tolist():
        if not (0 <= row < slot.shape[0] and 0 <= column < slot.shape[1]) or slot[row, column] < 0:
            raise UserError(f"--points {path}: got texel [{column}, {row}], which does not count; choose one inside the mask")
    return slot[at[:, 1], at[:, 0]]


def read_vectors(path: Path) -> Float32[np.ndarray, "lightings points 3"]:
    """Measured values: .npy or .npz of (lightings, points, 3), or a .csv of a lighting per row, r, g, b of each point in turn.

    Raises:
      UserError: missing, of another shape, not finite, negative, or dark.
    """
    try:
        if path.suffix.lower() == ".csv":
            with path.open(newline="", encoding="utf-8-sig") as file:
                lines = [line for line in csv.reader(file) if line and not line[0].startswith("#")]
            table = np.array([[float(cell) for cell in line] for line in lines])
            if table.ndim != 2 or table.shape[1] % 3:
                raise ValueError(f"got rows of {table.shape[1:]} numbers, expected three for each point")
            values = table.reshape(len(table), -1, 3)
        else:
            loaded = np.load(path, allow_pickle=False)
            values = loaded[loaded.files[0]] if hasattr(loaded, "files") else loaded
    except OSError as error:
        raise UserError(f"{path}: got {error.strerror or error}, expected measured values; check the path") from None
    except (ValueError, IndexError, EOFError) as error:
        raise UserError(f"{path}: not a table of measured values ({error}); write (lightings, points, 3) numbers") from None
    if values.ndim != 3 or values.shape[2] != 3 or 0 in values.shape or not np.issubdtype(values.dtype, np.number):
        raise UserError(f"{path}: got shape {values.shape}, expected (lightings, points, 3); write it so")
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(values, np.float32)
    if not np.isfinite(values).all() or values.min() < 0:
        row = int(np.argwhere(~(np.isfinite(values) & (values >= 0)))[0][0])
        raise UserError(f"{path}: got a negative or infinite value, or NaN, in lighting {row}, expected light; mend it")
    if not values.any():
        raise UserError(
            f"{path}: got zeros alone, expected measured light, which tells lightings apart; check what was written"
        )
    return values


def nowhere(points: int) -> Samples:
    """Places for values whose place is not known: a metre apart on a line, so that each is its own."""
    position = np.zeros((points, 3))
    position[:, 0] = np.arange(points)
    normal: Float[np.ndarray, "points 3"] = np.tile([0.0, 0.0, 1.0], (points, 1))
    return Samples(position, normal, np.ones((points, 3)), 1.0)
