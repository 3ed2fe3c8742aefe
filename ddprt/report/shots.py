"""Pictures of the scene from given places, under two held-out lightings; see `ddprt.report.scenery`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ddprt.axes import Float64
from ddprt.dataset.layers import Layer, read_light
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.report.evaluate import Evaluation
from ddprt.report.eyes import NEAREST, Eye, looking
from ddprt.report.lamps import has_size, on_picture
from ddprt.report.scenery import Scenery, close_cameras, middle_of_gloss
from ddprt.report.view import Camera, default_camera, diverging, exposure_for, png, signed_range, tonemap
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer


def cameras(scene: Scene, tracer: Tracer, eyes: Sequence[Eye], layers: Sequence[Layer]) -> list[Camera]:
    """From where the scene is shown: from given places (metres) towards the middle of what is glossy, or of the scene.

    Where none is given, as in the default picture, and from two places near to what is glossy.

    Raises:
      UserError: a place that is looked at itself.
    """
    first = default_camera(scene)
    if not eyes:
        return [first, *close_cameras(tracer, first, layers)]
    found, target = [], middle_of_gloss(layers)
    target = scene.centre if target is None else target
    for eye in eyes:
        if np.linalg.norm(target - eye) < NEAREST * scene.radius:
            raise UserError(f"report.views: got {list(eye)}, which is what all of them look at; expected places at a distance")
        found.append(looking(first, np.array(eye), target))
    return found


def chosen(errors: Float64[np.ndarray, " lightings"]) -> list[tuple[int, str]]:
    """The median held-out lighting and the worst; dark ones (NaN) are neither."""
    order = np.argsort(errors, kind="stable")[: int(np.isfinite(errors).sum())]
    if len(order) == 0:
        return []
    middle, worst = int(order[round(0.5 * (len(order) - 1))]), int(order[-1])
    return [(middle, "median"), *([(worst, "worst")] if worst != middle else [])]


def shots(
    evaluation: Evaluation,
    data: Dataset,
    main: str,
    model: Model,
    scene: Scene,
    tracer: Tracer,
    uv: Float64[np.ndarray, "triangles 3 2"],
    eyes: Sequence[Eye] = (),
) -> list[dict[str, Any]]:
    """A row for each lighting: its facts, and for every camera a picture of ours, of the reference and of the difference.

    Args:
      evaluation, data, main, model: what is shown, and how it is called.
      scene, tracer: of the dataset.
      uv: lightmap coordinates of the triangles' corners, origin top-left.
      eyes: places to look from, metres; none for the usual ones.
    """
    truth, predicted, test = evaluation.truth, evaluation.predicted[main], data.split("test")
    errors, layers = truth.errors_per_lighting(predicted), [part.layer for part in model.layers.values()]
    picked = chosen(errors)
    views = [
        Scenery.of(tracer, scene, uv, data.covered, camera, layers)
        for camera in (cameras(scene, tracer, eyes, layers) if picked else [])
    ]
    rows = []
    for row, label in picked:
        index, lighting = test[row], data.lightings[test[row]]
        direct, values = data.shaded([index])[0], data.values([index], model.points, model.quantity)[0]
        ours = {name: part.predict(values, lightings=lighting) for name, part in model.layers.items()}
        reference = {layer.name: read_light(data, layer, [index])[0] for layer in layers}
        for name, part in model.layers.items():
            if part.model.constant is not None:
                reference[name] = reference[name] + part.model.constant.reshape(reference[name].shape)
        lamps = [light.anchor() for light in lighting if not has_size(light)]
        shown = []
        for view in views:
            untouched, lit = view.emitted(lighting), view.lit(lighting, direct, data.constant)
            answers = view.learned(predicted[row], ours), view.learned(truth.reference[row], reference)
            shown.append((view, view.alpha(()), untouched, lit, *answers))
        # One exposure for all pictures of a lighting; lamps and what glows are left to be clipped.
        exposure = exposure_for(np.concatenate([(lit + true)[alpha > 0] for _, alpha, _, lit, _, true in shown]))
        limit = signed_range(np.concatenate([(mine - true).mean(2)[alpha > 0] for _, alpha, _, _, mine, true in shown]))
        facts = {"index": index, "label": label, "exposure": exposure, "limit": limit}
        pictures = []
        for view, alpha, untouched, lit, mine, true in shown:
            named = {"ours": tonemap(untouched + lit + mine, exposure), "reference": tonemap(untouched + lit + true, exposure)}
            named["difference"] = diverging((mine - true).mean(2), limit)
            veils = {**dict.fromkeys(named, view.alpha(lighting)), "difference": alpha}
            size = float(true.sum())
            pictures.append(
                {
                    **{name: png(np.concatenate([image, veils[name][..., None]], 2)) for name, image in named.items()},
                    "eye": view.rays.camera.eye,
                    "off": float(np.sqrt(np.mean((mine - true) ** 2)) / (size / true.size)) if size > 0 else None,
                    "lamps": on_picture(view.rays.camera, lamps),
                }
            )
        rows.append({**facts, "views": pictures})
    return rows
