"""From the datasets of an animation to models: one basis of all keyframes, one transfer for all or one for each.

Reference: Belcour et al., HPG 2022, section 5.4.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from ddprt.config import Config
from ddprt.dataset.animated import AnimatedData
from ddprt.errors import UserError
from ddprt.fitting.basis import Basis, entry_weights, fit_basis
from ddprt.fitting.encoding import Encoding
from ddprt.methods import make_method
from ddprt.methods.method import Examples, Relighter, columns
from ddprt.methods.svd_ridge import LinearTransfer, SvdRidge, transfer_to
from ddprt.runtime.animated import AnimatedModel
from ddprt.runtime.model import Model
from ddprt.runtime.train import examples, judged


@threadpool_limits.wrap(limits=1, user_api="blas")  # as in `fit_method`
def fit_animation(data: AnimatedData, config: Config) -> dict[str, AnimatedModel]:
    """Learns from all keyframes together.

    Args:
      data: from `ddprt.bake_animation`.
      config: [fit] and the settings of svd-ridge; `animation.matrices` says which models are made.
    Returns:
      By name, "each" and "one" or either of them.
    Raises:
      UserError: another method than svd-ridge, or more points than there are samples.
    """
    if config.fit.method != "svd-ridge":
        raise UserError(f'fit.method: got "{config.fit.method}" with an animation, expected "svd-ridge"; set it')
    fit, quantity, first = config.fit, config.points.quantity, data.wide[0]
    settings = config.methods.settings.get(fit.method, {})
    method = make_method(fit.method, fit.model_dump(exclude={"method", "points"}), settings)
    assert isinstance(method, SvdRidge)
    if method.bases == 1 and method.centre == "mean":
        raise UserError("fit.bases: got 1 with centre = mean, which counts as one; raise it")
    points = fit.points or first.description["points"]["count"]
    if points > len(first.samples.position):
        raise UserError(f"fit.points: got {points}, but there are {len(first.samples.position)} samples; bake with more")
    encoding = Encoding(fit.space, fit.gamma, fit.channels)
    parts = {
        split: [examples(part, split, encoding, fit, points, quantity) for part in data.wide]
        for split in ("train", "validation")
    }
    train, validation = (joined(parts[split]) for split in ("train", "validation"))
    centre = method.centre == "mean"
    weights = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
    basis = fit_basis(columns(train)[0], weights, bases=method.bases - centre, centre=centre)

    def transfer(basis: Basis, part: Examples) -> LinearTransfer:
        return transfer_to(basis, part, method.ridge, centre=centre, smooth=method.smooth)

    one, yardstick = judged(transfer(basis, train), encoding, train, validation)
    found = {"one": [one]}
    if config.animation.matrices != "one":
        own = [transfer(own, part) for own, part in zip(_shared_out(basis, parts["train"]), parts["train"], strict=True)]
        found = {
            "each": [judged(*given)[0] for given in zip(own, [encoding] * len(own), *parts.values(), strict=True)],
            **({} if config.animation.matrices == "each" else found),
        }
    areas = np.stack([part.area for part in data.wide])
    constants = [part.constant for part in data.wide]

    def stacked(name: str, transfers: Sequence[Relighter]) -> np.ndarray:
        return np.stack([np.asarray(getattr(entry, name)) for entry in transfers])

    def model(transfers: Sequence[Relighter]) -> AnimatedModel:
        rest = Model(
            fit.method,
            transfers[0],
            encoding,
            first.samples,
            points,
            quantity,
            data.covered,
            areas[0],
            first.occluders,
            {key: first.description["scene"][key] for key in ("name", "digest")},
            first.uv,
            yardstick,
            holes=first.holes,
            constant=constants[0],
            exitant=_any_exitant(data),
            albedo=data.albedo,
            viewpoint=first.viewpoint,
        )
        return AnimatedModel(
            rest,
            data.animation.times,
            data.animation.positions,
            data.animation.scene.triangles,
            data.riders,
            stacked("matrix", transfers),
            stacked("offset", transfers),
            stacked("intercept", transfers),
            areas,
            None if constants[0] is None else np.stack([entry for entry in constants if entry is not None]),
            tuple(entry.report.status for entry in transfers),
        )

    return {name: model(transfers) for name, transfers in found.items()}


def joined(parts: Sequence[Examples]) -> Examples:
    """Pairs of several keyframes as one set: places are those of the first, a texel counts by the mean of its areas."""
    frame = replace(
        parts[0].frame,
        values=jnp.concatenate([part.frame.values for part in parts]),
        lightings=[lighting for part in parts for lighting in part.frame.lightings or ()],
    )
    area = np.stack([part.area for part in parts]).mean(axis=0, dtype=np.float64).astype(np.float32)
    return replace(
        parts[0],
        frame=frame,
        indirect=jnp.concatenate([part.indirect for part in parts]),
        scale=jnp.concatenate([part.scale for part in parts]),
        area=area,
        unseen=max(part.unseen for part in parts),
    )


def _shared_out(basis: Basis, parts: Sequence[Examples]) -> list[Basis]:
    """The basis with the coefficients of each keyframe's columns alone, which lie in it one keyframe after another."""
    ends = np.cumsum([0, *(columns(part)[0].shape[0] for part in parts)])
    return [replace(basis, coefficients=basis.coefficients[first:last]) for first, last in pairwise(ends.tolist())]


def _any_exitant(data: AnimatedData) -> np.ndarray | None:
    found = [part.exitant for part in data.wide if part.exitant is not None]
    return np.logical_or.reduce(found) if found else None
