"""How well layers are answered for on the held-out lightings; see `ddprt.dataset.layers`."""

from dataclasses import replace
from typing import Any

import numpy as np

from ddprt import warp
from ddprt.axes import Float32
from ddprt.dataset.layers import QUANTITIES, Layer, LayerData
from ddprt.dataset.store import Dataset
from ddprt.report.evaluate import projected
from ddprt.runtime.model import LayerModel, Model

_DIRECTIONS = 64  # that errors are looked at from
Coefficients = Float32[np.ndarray, "lightings entries 3"]


def layer_scores(data: Dataset, model: Model) -> dict[str, Any]:
    """Errors of a model's layers, by name.

    Returns:
      relative_rmse: root of the mean square irradiance of the error, over the sphere, all places by their weight, lightings and
        channels, as a share of the mean irradiance; None where there is no light. noise_relative_rmse is the same of what the
        held-out light is uncertain by, projection_relative_rmse of what the best coefficients on the basis would leave. curve:
        the error of the first 1, 2, 4, ... bases alone, up to all. Where the method has no basis: no projection and no curve.
        seen_relative_rmse, of radiance on surfaces: the same of what eyes see, values in 64 directions before each place's
        surface, each weighed by its cosine as by its share of a picture; never below 0. unlit, of probes: how many in free air
        get no light, neither in the reference nor of the model.
    """
    return {name: _scores(data, part) for name, part in model.layers.items()}


def _scores(data: Dataset, part: LayerModel) -> dict[str, Any]:
    layer, model, test = part.layer, part.model, data.split("test")
    own = LayerData.of(data, layer)
    values, reference = data.values(test, model.points, model.quantity), own.maps("indirect", test)
    whole = 3 * len(test) * layer.weight.sum()
    first = reference.reshape(len(test), *own.covered.shape, 3)[:, :, 0]
    mean = float(np.einsum("lpc,p->", first, layer.weight, dtype=np.float64) / whole) * QUANTITIES[layer.quantity] ** 0.5

    def share(error: Coefficients) -> float | None:
        square = sum(np.einsum("ec,ec,e->", row, row, own.area, dtype=np.float64) for row in error) / whole
        return float(np.sqrt(square) / mean) if mean > 0 else None

    lightings = [data.lightings[index] for index in test]
    predicted = model.predict(values, lightings=lightings, clamp=False, constant=False)
    found: dict[str, Any] = {
        "places": int((layer.weight > 0).sum()),
        "relative_rmse": share(predicted - reference),
        "noise_relative_rmse": share(own.maps("noise", test)),
    }
    if layer.quantity == "radiance" and (layer.texel >= 0).all():
        light = part.predict(values, lightings=lightings, constant=False)
        found["seen_relative_rmse"] = _seen(
            layer, light, reference.reshape(light.shape), data.gbuffer["geometric_normal"][layer.texel]
        )
    if layer.quantity == "irradiance":
        light = np.concatenate([reference, predicted]).reshape(-1, *own.covered.shape, 3)
        found["unlit"] = int(((layer.weight > 0) & ~light.any((0, 2, 3))).sum())
    basis = getattr(model.relighter, "basis", None)
    if basis is None or len(basis) == 0:
        return found
    vectors, centre = np.asarray(basis, np.float64), np.asarray(getattr(model.relighter, "mean", 0.0), np.float64)
    best = projected(model.encoding, vectors, centre, values, reference, own.area, clamp=False)
    found["projection_relative_rmse"] = share(best - reference)
    found["curve"] = []
    for bases in sorted({*(2**power for power in range(len(basis).bit_length())), len(basis)}):
        shorter = replace(model, relighter=model.relighter.truncated(bases))  # type: ignore[attr-defined]
        error = share(shorter.predict(values, clamp=False, constant=False) - reference)
        found["curve"].append({"bases": bases, "relative_rmse": error})
    return found


def _seen(layer: Layer, ours: np.ndarray, reference: np.ndarray, normal: Float32[np.ndarray, "places 3"]) -> float | None:
    """RMSE of what eyes see in directions that are spread evenly, over the mean of the reference; None where that is dark."""
    square = total = whole = 0.0
    for direction in warp.sample_sphere(warp.sobol(_DIRECTIONS, 2, seed=0)).astype(np.float64):
        weight = layer.weight * np.maximum(normal @ direction, 0)
        theirs = layer.towards(reference, direction)
        square += float(np.einsum("lpc,p->", (layer.towards(ours, direction) - theirs) ** 2, weight, dtype=np.float64))
        total += float(np.einsum("lpc,p->", theirs, weight, dtype=np.float64))
        whole += theirs.size / len(weight) * float(weight.sum())
    return float(np.sqrt(square / whole) / (total / whole)) if total > 0 else None
