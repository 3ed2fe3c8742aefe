"""Scores of models of what moves: at the keyframes that they learned from, and at poses between them, on held-out lightings."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.axes import Float32, Float64
from ddprt.dataset.animated import AnimatedData
from ddprt.dataset.store import Dataset
from ddprt.files import write_text
from ddprt.report.metrics import Tally, Truth
from ddprt.report.view import default_camera, diverging, exposure_for, png, signed_range, take_view, tonemap
from ddprt.runtime.animated import AnimatedModel
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

WAYS = {
    "one": "one basis, one matrix for all keyframes",
    "each": "one basis, a matrix for each keyframe, mixed between them",
    "nearest": "one basis, the matrix of the nearest keyframe",
}
_TALL = 200  # pixels of a picture


@dataclass(frozen=True, eq=False)
class Pose:
    """A pose that models are tested at.

    Attributes:
      time: seconds.
      seen: whether it is a keyframe.
      data: its held-out lightings.
      scene: the mesh there.
    """

    time: float
    seen: bool
    data: Dataset
    scene: Scene


def poses(data: AnimatedData) -> list[Pose]:
    """All that have held-out lightings, in the order of time."""
    animation = data.animation
    keys = [Pose(float(t), True, d, animation.key(k)) for k, (t, d) in enumerate(zip(animation.times, data.keys, strict=True))]
    between = [Pose(time, False, found, animation.pose(time)) for time, found in data.between]
    return sorted(keys + between, key=lambda pose: pose.time)


def at_pose(model: AnimatedModel, way: str, pose: Pose) -> Model:
    """A model at a pose as whoever animates the mesh has it."""
    found = model.at(pose.time, pose.scene.positions)
    if way != "nearest" or pose.seen or len(model.matrix) == 1:
        return found
    key = model.at(float(model.times[np.abs(model.times - pose.time).argmin()]))
    return replace(found, relighter=key.relighter)


def maps(model: Model, data: Dataset) -> tuple[Float32[np.ndarray, "lightings texels 3"], Truth]:
    """What a model makes of a pose's own measurements, on the texels of the pose, and the truth there.

    A texel that no keyframe shows is dark: the model knows nothing of it.
    """
    test = data.split("test")
    light = model.predict(data.values(test, model.points, model.quantity), constant=False)
    wide = np.zeros((len(light), *model.covered.shape, 3), np.float32)
    wide[:, model.covered] = light
    return wide[:, data.covered], Truth(data.maps("indirect", test), data.area)


def score(data: AnimatedData, models: Mapping[str, AnimatedModel]) -> dict[str, Any]:
    """Scores of each way (see `WAYS`) pooled over keyframes, over poses between, and of every pose.

    Args:
      data: of `bake_animation`.
      models: of `fit_animation`.
    """
    ways = {**models, **({"nearest": models["each"]} if "each" in models and data.between else {})}
    found: dict[str, Any] = {}
    for way, model in ways.items():
        tallies: list[tuple[Pose, Tally]] = []
        for pose in poses(data):
            light, truth = maps(at_pose(model, way, pose), pose.data)
            tallies.append((pose, truth.tally(light)))
        groups = {name: [t for pose, t in tallies if pose.seen == seen] for name, seen in (("seen", True), ("between", False))}
        found[way] = {
            **{name: Tally.joined(part).scores() if part else None for name, part in groups.items()},
            "poses": [
                {"time": pose.time, "seen": pose.seen, "relative_rmse": tally.scores()["relative_rmse"]}
                for pose, tally in tallies
            ],
            "bytes": model.nbytes,
            "status": list(model.statuses),
        }
    return found


def noise(data: AnimatedData) -> float | None:
    """Relative RMSE of the held-out maps themselves, from the difference of their halves; None where all is dark."""
    squares, means = [], []
    for pose in poses(data):
        test = pose.data.split("test")
        truth = Truth(pose.data.maps("indirect", test), pose.data.area)
        squares.append(truth.per_lighting(pose.data.maps("noise", test)).mean())
        means.append(truth.mean)
    return float(np.sqrt(np.mean(squares)) / np.mean(means)) if np.mean(means) > 0 else None


def table(scores: Mapping[str, Any]) -> str:
    """The scores as Markdown."""
    shown = lambda part: "none" if part is None or part["relative_rmse"] is None else f"{part['relative_rmse']:.2%}"  # noqa: E731
    rows = [
        f"| {WAYS[way]} | {shown(own['seen'])} | {shown(own['between'])} | {own['bytes'] / 1e3:.0f} kB |"
        for way, own in scores.items()
    ]
    return "\n".join(["| | at keyframes | between | bytes |", "| --- | --- | --- | --- |", *rows])


def picture(
    model: AnimatedModel, pose: Pose, lighting: int, height: int = _TALL, *, lamps: bool = True
) -> dict[str, Float64[np.ndarray, "height width rgba"]]:
    """A pose under one held-out lighting as a camera sees it: reference, relit, and the difference times 4.

    Args:
      model: that relights.
      pose: which.
      lighting: position in the split "test".
      height: pixels.
      lamps: show the light that comes straight from them too; without, what was learned alone.
    """
    data = pose.data
    light, truth = maps(at_pose(model, "each", pose), data)
    albedo, index = data.gbuffer["albedo"], data.split("test")[lighting]
    camera = default_camera(pose.scene)
    view = take_view(Tracer.of(pose.scene), data.uv, data.covered, camera, height)  # type: ignore[arg-type]
    direct = lamps * data.shaded([index])[0]
    exposure = exposure_for(albedo * (direct + truth.reference[lighting]))
    shots = {
        name: tonemap(view.render(albedo * (direct + part)), exposure)
        for name, part in (("reference", truth.reference[lighting]), ("relit", light[lighting]))
    }
    off = (light[lighting] - truth.reference[lighting]).mean(1)
    limit = max(signed_range(truth.reference[lighting]) / 4, 1e-12)
    shots["difference"] = diverging(view.render(off), limit)
    return {name: np.concatenate([shot, view.alpha[..., None]], 2) for name, shot in shots.items()}


def write_page(path: Path, data: AnimatedData, models: Mapping[str, AnimatedModel], metrics: Mapping[str, Any]) -> Path:
    """Writes report.html: the table, the error of every pose, and each pose under one held-out lighting.

    Raises:
      UserError: the file cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("ddprt", "report")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    main = next(iter(models.values()))
    shown = [
        {
            "time": pose.time,
            "seen": pose.seen,
            "pictures": {
                name: "data:image/png;base64," + base64.b64encode(png(shot)).decode()
                for name, shot in picture(main, pose, 0).items()
            },
        }
        for pose in poses(data)
    ]
    page = environment.get_template("animation.html.j2").render(
        version=__version__, metrics=metrics, ways=WAYS, shown=shown, points=main.rest.points, bases=len(main.rest.textures)
    )
    write_text(path, page)
    return path
