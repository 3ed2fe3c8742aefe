"""What one bake tells of all numbers of bases: models with fewer of them, what a frame of each takes, curves of it all."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ddprt.axes import Float32
from ddprt.bench.measure.timing import Timing, timed
from ddprt.bench.tune.planner import Plan, Trial
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model

_FRAMES = 50  # timings of a frame
_MOST = 8  # measurements of it
_APART = 0.2  # seconds between two of them
_CLEAR = 2.05  # spreads from a limit, which are exceeded once in fifty
_LEAST = 0.03  # spread that a measurement has at least
_QUARTILES = 1.349  # standard deviations between those of a Gaussian


def first_bases(model: Model, count: int) -> Model:
    """The model with its first bases alone; a mean counts as one of them."""
    linear = model.relighter
    assert isinstance(linear, LinearTransfer), "the planner fits svd-ridge"
    report = linear.report
    kept = count - (report.bases - len(linear.basis))
    shorter = replace(linear, matrix=linear.matrix[:, :kept], intercept=linear.intercept[:, :kept], basis=linear.basis[:kept])
    return replace(model, relighter=replace(shorter, report=replace(report, bases=count)))


def without_last(model: Model, count: int) -> Model:
    """The same with its last bases black: shapes stay, so that nothing compiles again."""
    linear = model.relighter
    assert isinstance(linear, LinearTransfer), "the planner fits svd-ridge"
    return replace(model, relighter=linear.truncated(len(linear.basis) - count))


def with_measured(trial: Trial, plan: Plan, reached: dict[str, float], spread: float, skew: float, off: float) -> Trial:
    """A trial with one more number of bases on its curves, or with another value there.

    Args:
      trial, plan: of one place.
      reached: what the plan was measured to be.
      spread, skew: of its error's logarithm.
      off: spread of the logarithm of its frame's time.
    """
    curves = zip(trial.bases, trial.errors, trial.frame_us, trial.frame_spread, strict=True)
    rows = {
        bases: (error, frame, {name: sizes[i] for name, sizes in trial.megabytes.items()}, other)
        for i, (bases, error, frame, other) in enumerate(curves)
    }
    between = {name: float(np.interp(plan.bases, trial.bases, sizes)) for name, sizes in trial.megabytes.items()}
    rows[plan.bases] = reached["relative_rmse"], reached["frame_us"], {**between, plan.precision: reached["megabytes"]}, off
    order: Sequence[int] = sorted(rows)
    return replace(
        trial,
        bases=tuple(order),
        errors=tuple(rows[bases][0] for bases in order),
        error_spread=spread,
        error_skew=skew,
        frame_us=tuple(rows[bases][1] for bases in order),
        frame_spread=tuple(rows[bases][3] for bases in order),
        megabytes={name: tuple(rows[bases][2][name] for bases in order) for name in trial.megabytes},
        fit_seconds=reached["fit_seconds"],
    )


def time_of_frame(
    model: Model,
    values: Float32[np.ndarray, "points rgb"],
    *,
    limit: float | None = None,
    before: Sequence[tuple[float, float]] = (),
) -> tuple[float, float]:
    """Microseconds that a frame takes, and how far off their logarithm is.

    Args:
      model, values: what is measured at the points.
      limit: microseconds; measured again, a while apart, until it is clear on which side of them a frame is, or eight times.
      before: what was measured before, to be counted in.
    """
    times = [*before, _time_of_frame(model, values)]
    while limit is not None and len(times) < _MOST:
        time_us, spread = middle(times)
        if abs(np.log(time_us / limit)) > _CLEAR * max(spread, _LEAST):
            break
        time.sleep(_APART)
        times.append(_time_of_frame(model, values))
    return middle(times)


def _time_of_frame(model: Model, values: Float32[np.ndarray, "points rgb"]) -> tuple[float, float]:
    timing = timed(lambda: model.predict(values), _FRAMES)[1]
    return 1e6 * timing.median, spread_of_time(timing)


def spread_of_time(timing: Timing) -> float:
    """How far off the logarithm of a median of times is: as far as a single one, by the quartiles.

    Repeats at once do not make it surer: what slows one down (other work on the machine, its clock) slows the next, too.
    """
    return float(np.log(timing.high / timing.low)) / _QUARTILES if timing.low > 0 else 1.0


def middle(times: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """What several measurements say that lie a while apart: their median, and how far off its logarithm is.

    Args:
      times: each with the spread of its logarithm. That of the median is theirs, or what they differ by if that is more, over
        the root of their number, times sqrt(pi / 2), by which a median of Gaussians is less sure than their mean.
    """
    found, spreads = np.array(times).T
    if len(times) == 1:
        return float(found[0]), float(spreads[0])
    each = max(float(np.median(spreads)), float(np.log(found).std(ddof=1)))
    return float(np.median(found)), each * float(np.sqrt(np.pi / 2 / len(times)))
