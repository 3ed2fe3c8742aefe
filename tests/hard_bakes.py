"""Hard cases that bake: rooms, lamps, bakes of a few rays, and comparisons that need no other renderer.

Most rooms are closed and convex, so that light has closed forms in them: every lamp is seen from every wall, and where direct
light is even, so is indirect light, whatever rays are drawn. What stands beside `bound` says where it comes from.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hard_cases import Outcome

import ddprt
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.lights import Lighting, parse_lighting
from ddprt.methods.statuses import STATUSES
from ddprt.progress import Progress
from ddprt.runtime.model import Model
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, hollow
from ddprt.transport.embree import SELF_OFFSET

HALF, FLOAT = 2.0**-11, 2.0**-24
"""Unit roundoffs of what maps are stored in and of what light is computed in."""
FAINTEST = 2.0**-38
"""Spacing of a map's faintest halves, 2^-24, over the least that its brightest value is stored as, 2^14."""
SIGMAS = 6.0
"""Two-sided probability 2e-9 for a normal estimate: over all values that the cases look at, below 1e-5."""
LIT = frozenset(STATUSES) - {"no_signal", "diverged"}
"""Where light is judged, and not what a fit of four lamps says of itself."""
BLACK = frozenset({"no_signal", "blind"})


Records = Sequence[dict[str, Any] | list[dict[str, Any]]]


def room(albedo: float = 0.5, *, size: float = 1.0, at: float = 0.0) -> Scene:
    """A closed cube seen from inside; its coordinates are exact wherever size and place are powers of two."""
    planes = at + size * np.array([0.0, 1.0])
    return faceted("room", hollow(np.ones((1, 1, 1), bool), planes, planes, planes), (Material("wall", (albedo,) * 3),))


def point(x: float, y: float, z: float, *intensity: float) -> dict[str, Any]:
    red, green, blue = intensity * 3 if len(intensity) == 1 else intensity or (1.0, 1.0, 1.0)
    return {"type": "point", "position": [x, y, z], "intensity": [red, green, blue]}


LAMPS: Records = [point(0.5, 0.75, 0.5), point(0.25, 0.5, 0.25), point(0.75, 0.25, 0.5), point(0.5, 0.5, 0.75, 3.0, 2.0, 1.0)]


def baked(
    scene: Scene, records: Records, *, out: Path | None = None, progress: Progress | None = None, **sections: dict
) -> Dataset:
    """All lightings for training; validation and test repeat ordinary ones."""
    parsed = [parse_lighting(record) for record in records]
    given: dict[str, Sequence[Lighting]] = {"train": parsed, "validation": parsed[:1], "test": parsed[:1]}
    transport = {"samples": 16, "test_samples": 16, "direct_samples": 2, **sections.pop("transport", {})}
    points = {"count": 8, "supersample": 2, "depth": 0, **sections.pop("points", {})}  # so few that every lamp is near them
    settings = {"atlas": {"resolution": 16}, "points": points, **sections}
    config = Config.model_validate({**settings, "transport": transport})
    return ddprt.bake(scene, given, config=config, out=out, progress=progress)


def worst(*ratios: float | np.ndarray) -> float:
    """Largest of errors over bounds; infinity for what is no number."""
    flat = np.concatenate([np.ravel(ratio).astype(np.float64) for ratio in ratios])
    return float(np.where(np.isfinite(flat), flat, np.inf).max(initial=0))


def over(found: np.ndarray, expected: np.ndarray, bound: np.ndarray | float) -> np.ndarray:
    """Error over bound; no error over no bound is 0."""
    error = np.abs(np.asarray(found, np.float64) - expected)
    return np.divide(error, bound, out=np.where(error > 0, np.inf, 0.0), where=np.broadcast_to(bound, error.shape) > 0)


def alike(one: np.ndarray, other: np.ndarray) -> float:
    """0 for equal bits, infinity else."""
    return 0.0 if np.array_equal(one, other) else np.inf


def everything(data: Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Direct, measured and indirect light of all lightings."""
    indices = range(len(data.lightings))
    return data.maps("direct", indices), data.measured(indices), data.maps("indirect", indices)


def finite(*arrays: np.ndarray) -> bool:
    return all(bool(np.isfinite(array).all()) for array in arrays)


def refused(action: Callable[[], Any], *words: str) -> Outcome:
    """The outcome of what must be refused, in one line that has these words."""
    try:
        action()
    except UserError as error:
        line = str(error)
        return Outcome(0.0 if "\n" not in line and all(word in line for word in words) else np.inf, "refused")
    return Outcome(np.inf)


def from_lamp(scene: Scene, record: dict[str, Any], places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance I cos(theta) / r² of a lamp that nothing hides, in float64, and the error that float32 may make of it.

    Rays start off the surface by `SELF_OFFSET` of the diagonal, and lamp and place are rounded to float32 about the centre:
    both move by at most `shift` in all. E = I n.d / |d|³ has a gradient of at most 4 I / |d|³, taken as near as it can be.
    Normals, cosine, strength and colour round some ten times more. Nearer than twice the shift nothing is known but the sign.
    """
    towards = np.array(record["position"]) - places
    distance = np.linalg.norm(towards, axis=1)
    reach = np.abs(np.array(record["position"]) - scene.centre).max() + scene.radius
    shift = 2 * SELF_OFFSET * scene.radius + 2 * np.sqrt(3) * FLOAT * reach
    with np.errstate(divide="ignore", invalid="ignore"):
        irradiance = np.maximum((normals * towards).sum(1), 0) / distance**3
        slope = np.where(distance > 2 * shift, 4 * shift / np.maximum(distance - shift, 0) ** 3, np.inf)
        bound = slope + 10 * FLOAT / distance**2
    intensity = np.array(record["intensity"], np.float64)
    return np.nan_to_num(irradiance)[:, None] * intensity, np.nan_to_num(bound, nan=np.inf, posinf=np.inf)[:, None] * intensity


def moved(records: Records, size: float = 1.0, at: float = 0.0, strength: float = 1.0) -> list[dict[str, Any]]:
    return [
        {
            **record,
            "position": [at + size * x for x in record["position"]],
            "intensity": [strength * x for x in record["intensity"]],
        }
        for record in records
        if isinstance(record, dict)
    ]


def fitted(data: Dataset, records: Records, **settings: Any) -> tuple[Model, np.ndarray]:
    model = ddprt.fit(data, bases=3, **settings)
    return model, np.stack([model.relight(record) for record in records])


def given_points(
    scene: Scene, entries: list[dict[str, Any]], lamps: Records, relit: Records
) -> tuple[Dataset, np.ndarray, str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "points.json"
        path.write_text(json.dumps(entries))
        places = {"file": str(path), "count": len(entries), "supersample": 1}
        data = baked(scene, lamps, points=places, atlas={"resolution": 16 if scene.name == "room" else 32})
        model, images = fitted(data, relit)
        return data, images, model.relighter.report.status


def furnace_range(scene: Scene) -> tuple[float, float]:
    """Least and most direct light of a lamp of 1 W/sr in the middle: E = h / r³ with h the distance of a face's plane."""
    corners = scene.corners
    height = np.abs((corners[:, 0] * scene.geometric_normals).sum(1))
    return float((height / np.linalg.norm(corners, axis=2).max(1) ** 3).min()), float((height**-2).max())


def within(found: np.ndarray, low: float, high: float) -> float:
    """How far values lie from the middle of a range, over half its width; halves and their floats widen it."""
    low, high = low * (1 - 4 * HALF), high * (1 + 4 * HALF)  # direct light is stored and read, and so is the result
    return worst(over(found, np.full(found.shape, (low + high) / 2), (high - low) / 2))


MIDDLE: Records = [point(0, 0, 0)]
