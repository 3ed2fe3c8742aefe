"""The held-out lightings that a search scores on: those of the configuration, and as many more as it takes to tell an error.

A pooled error is a mean of squares over lightings, most of which a few of them may make up: lamps close to a wall, or seen
through a door. Where that is so, the error on few held-out lightings is mostly too small, and now and then much too large.
"""

import json
import time
from dataclasses import dataclass, field

import numpy as np

from ddprt import seeds
from ddprt.bench.measure.trial import Workshop, measured_here
from ddprt.bench.measure.trial import environment as here
from ddprt.bench.measure.yardstick import Yardstick, make_yardstick
from ddprt.errors import UserError
from ddprt.files import write_text
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model

_TOLD = "took.json"  # seconds of a bake, beside its dataset
_SHARE = 0.1  # noise of more held-out maps over the limit of the error: adds 0.5 % to an error that is at the limit


@dataclass(eq=False)
class HeldOut:
    """Yardsticks of one scene, each with lightings of its own.

    Args:
      workshop: whose yardstick is the first.
    Attributes:
      seconds: that baking more lightings took.
    """

    workshop: Workshop
    seconds: float = field(default=0.0, init=False)
    _more: list[Yardstick] = field(default_factory=list, init=False)
    _each: float = field(default=0.0, init=False)

    @property
    def count(self) -> int:
        """Lightings, all in all."""
        return sum(len(yardstick.held_out) for yardstick in (self.workshop.yardstick, *self._more))

    def tally(self, model: Model) -> Tally:
        """Errors of a model under all of them."""
        return Tally.joined([yardstick.tally(model) for yardstick in (self.workshop.yardstick, *self._more)])

    def more(self, limit: float, allowance: float, times: int = 2) -> bool:
        """Draws some more, where that is possible and costs no more than is allowed.

        Args:
          limit: the error that is to be told from what is beyond it; held-out maps are baked as finely as that takes.
          allowance: seconds that more lightings may take, all in all. Those drawn first are never too dear, since what they
            take is not known yet; after that a lighting is expected to take as long as one did the last time.
          times: how many times as many there are then.
        Returns:
          Whether there are more; never where they come from a file, which has no others.
        """
        config, count = self.workshop.config, (times - 1) * self.count
        if config.lightings.file or (self._more and self.seconds + count * self._each > allowance):
            return False
        noise = max(config.bench.noise, float(f"{min(1.0, _SHARE * limit):.1g}"))
        changes = {
            "seed": seeds.number(config.seed, "more held-out lightings", len(self._more)),
            "lightings": config.lightings.model_copy(update={"test": count}),
            "bench": config.bench.model_copy(update={"noise": noise, "path_frames": 0, "pictures": 0}),
        }
        folder = self.workshop.folder / f"truth-{self.workshop.truth}-{len(self._more)}-{count}-{noise:g}"
        self.workshop.progress.say(f"{count} more held-out lightings, to tell whether the error is within its limit")
        begun = time.perf_counter()
        found = make_yardstick(self.workshop.scene, config.model_copy(update=changes), folder, self.workshop.progress)
        took, told = time.perf_counter() - begun, folder / _TOLD
        if told.is_file() and measured_here((before := json.loads(told.read_text("utf-8")))["environment"]):
            took = before["seconds"]  # of when it was baked
        else:
            write_text(told, json.dumps({"seconds": round(took, 4), "environment": here()}) + "\n")
        self._more.append(found)
        self.seconds, self._each = self.seconds + took, took / count
        return True


def error_of(tally: Tally) -> float:
    """Relative RMSE over all lightings.

    Raises:
      UserError: they are dark.
    """
    error = tally.scores()["relative_rmse"]
    if error is None:
        raise UserError("tune: got held-out lightings without indirect light, expected some; there is nothing to learn")
    return float(error)


def spread_of(tally: Tally) -> tuple[float, float]:
    """How far off the logarithm of the relative RMSE is on held-out lightings, by leaving each out (the jackknife).

    Returns:
      Its standard error, and its skewness: that of the values that stand for the lightings, over the root of their number.
    """
    count = len(tally.error)
    if count < 2 or not tally.error.any():
        return 1.0, 0.0
    means = tally.mean.mean(1)
    others = (tally.error.sum() - tally.error) / (count - 1), (means.sum() - means) / (count - 1)
    logs = 0.5 * np.log(np.maximum(others[0], 1e-300)) - np.log(np.maximum(others[1], 1e-300))
    values = logs.mean() - logs  # what is larger without a lighting is smaller with it
    square = float(np.mean(values**2))
    skew = float(np.mean(values**3)) / square**1.5 / np.sqrt(count) if square > 1e-24 else 0.0
    return float(np.sqrt((count - 1) * square)), float(skew)
