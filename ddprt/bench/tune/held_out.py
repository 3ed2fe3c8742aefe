"""The held-out lightings that a search scores on: those of the configuration, and as many more as it takes to tell an error.

A pooled error is a mean of squares over lightings, most of which a few of them may make up: lamps close to a wall, or seen
through a door. Where that is so, the error on few held-out lightings is mostly too small, and now and then much too large.
Those that come to them are therefore drawn where errors are likely to be large (`ddprt.bench.tune.suspects`), and as long as
there are none of these, a lighting worse than all is reckoned with.
"""

import json
import time
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ddprt import seeds
from ddprt.axes import Float64
from ddprt.bench.measure.settings import digest_of
from ddprt.bench.measure.trial import Workshop, measured_here
from ddprt.bench.measure.trial import environment as here
from ddprt.bench.measure.yardstick import Yardstick, make_yardstick
from ddprt.bench.tune.fitted import Fitted
from ddprt.bench.tune.suspects import Suspects, balanced, draw_candidates
from ddprt.errors import UserError
from ddprt.files import make_folder, read_tensors, write_tensors, write_text
from ddprt.lights import Lighting, lighting_json, parse_lighting
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model

_LISTED = "lightings.json"
_VALUES = "values.safetensors"
_TOLD = "took.json"  # seconds of a bake, beside its dataset
_WORSE = 2.0  # times the largest squared error, of one more lighting that is reckoned with; measured in docs/tuning.md
_SHARE = 0.1  # noise of more held-out maps over the limit of the error: adds 0.5 % to an error that is at the limit


@dataclass(eq=False)
class HeldOut:
    """Yardsticks of one scene, each with lightings of its own.

    Args:
      workshop: whose yardstick is the first.
    Attributes:
      seconds: that drawing and baking more lightings took.
    """

    workshop: Workshop
    seconds: float = field(default=0.0, init=False)
    _more: list[Yardstick] = field(default_factory=list, init=False)
    _each: float = field(default=0.0, init=False)
    _suspects: Suspects | None = field(default=None, init=False)
    _drawn: list[np.ndarray] = field(default_factory=list, init=False)

    @property
    def count(self) -> int:
        """Lightings, all in all."""
        return sum(len(yardstick.held_out) for yardstick in (self.workshop.yardstick, *self._more))

    def tally(self, model: Model, told: MutableMapping[Yardstick, Tally] | None = None) -> Tally:
        """Errors of a model under all of them, each lighting weighed so that means are those over the configuration's.

        Args:
          model: that is scored.
          told: what was told of this very model before, by yardstick; what is not there yet comes to it.
        """
        known: MutableMapping[Yardstick, Tally] = {} if told is None else told
        yardsticks = self.workshop.yardstick, *self._more
        for yardstick in yardsticks:
            if yardstick not in known:
                known[yardstick] = yardstick.tally(model)
        found = Tally.joined([known[yardstick] for yardstick in yardsticks])
        if self._suspects is None:
            return found
        even = self.workshop.yardstick.measured(self._suspects.model)[: len(self.workshop.yardstick.held_out)]
        return balanced(found, np.concatenate([self._suspects.density_of(even), *self._drawn]), len(even))

    def spread(self, tally: Tally) -> tuple[float, float]:
        """How far off the logarithm of the relative RMSE is, and how skewed: see `spread_of`.

        Lightings drawn at random are reckoned to lack one that is worse than all of them.
        """
        if self._suspects is None:
            return spread_of(tally, worse=_WORSE)
        spread, skew = spread_of(tally)
        whole = float(np.hypot(spread, self._suspects.spread))
        # Third moments add up, and that of a mean of many candidates is small.
        return whole, skew * (spread / whole) ** 3 if whole else 0.0

    def more(
        self,
        fitted: Callable[[], Fitted],
        limit: float,
        allowance: float,
        times: int = 2,
        expected: Callable[[int, float], float] | None = None,
    ) -> bool:
        """Draws some more, where that is possible and costs no more than is allowed.

        Args:
          fitted: gives a model, whose errors the lightings are drawn for the first time; later ones are drawn for the same, so
            that what each counts for stays.
          limit: the error that is to be told from what is beyond it; held-out maps are baked as finely as that takes.
          allowance: seconds that more lightings may take, all in all.
          times: how many times as many there are then.
          expected: seconds that a bake of so many lightings, as noisy as that, is expected to take the first time; None allows
            these whatever they take. After that a lighting is expected to take as long as one did the last time.
        Returns:
          Whether there are more; never where they come from a file, which has no others.
        """
        config, count = self.workshop.config, (times - 1) * self.count
        noise = max(config.bench.noise, float(f"{min(1.0, _SHARE * limit):.1g}"))
        taking = count * self._each if self._more else expected(count, noise) if expected else 0.0
        if config.lightings.file or (taking and self.seconds + taking > allowance):
            return False
        scene, progress = self.workshop.scene, self.workshop.progress
        suspects = self._suspects or self._measured(fitted())
        lightings, density = suspects.draw(count, seeds.number(config.seed, "more held-out lightings", len(self._more)))
        folder = self.workshop.folder / f"truth-{self.workshop.truth}-{suspects.digest}-{len(self._more)}-{count}-{noise:g}"
        make_folder(folder)
        listed = folder / _LISTED
        _write(listed, [*suspects.lightings[:2], *lightings])  # one to train on and one to validate, which nobody uses
        told = {"file": str(listed), "train": 1, "validation": 1, "test": count, "choose": "random", "target_error": 0.0}
        changes = {
            "lightings": config.lightings.model_copy(update=told),
            "bench": config.bench.model_copy(update={"noise": noise, "path_frames": 0, "pictures": 0}),
        }
        progress.say(f"{count} more held-out lightings, to tell whether the error is within its limit")
        begun = time.perf_counter()
        found = make_yardstick(scene, config.model_copy(update=changes), folder / "maps", progress)
        took = _took(folder, time.perf_counter() - begun)
        self._suspects = suspects
        self._drawn.append(density)
        self._more.append(found)
        self.seconds, self._each = self.seconds + took, took / count
        return True

    def _measured(self, fitted: Fitted) -> Suspects:
        """Candidates and how likely each is to be drawn, as measured before or now; what that took is counted in.

        What points measure does not depend on what was learned, so models with the same points share it, and so do searches.
        """
        lightings, model = self._candidates(), fitted.model
        key = digest_of([model.samples.digest, model.samples.spacing, model.points, model.quantity])
        folder = self.workshop.folder / f"truth-{self.workshop.truth}-candidates-{key}"
        path, begun = folder / _VALUES, time.perf_counter()
        if path.is_file():
            values = read_tensors(path)["values"]
        else:
            values = model.measure_all(lightings)
            make_folder(folder)
            write_tensors(path, {"values": values})
        self.seconds += _took(folder, time.perf_counter() - begun)
        return Suspects.of(model, fitted.data, lightings, values)

    def _candidates(self) -> list[Lighting]:
        """Lightings to draw from, as they were drawn before or now; what that took is counted in."""
        folder = self.workshop.folder / f"truth-{self.workshop.truth}-candidates"
        listed, begun = folder / _LISTED, time.perf_counter()
        if listed.is_file():
            found = [parse_lighting(each) for each in json.loads(listed.read_text("utf-8"))]
        else:
            found = draw_candidates(self.workshop.scene, self.workshop.config)
            make_folder(folder)
            _write(listed, found)
        self.seconds += _took(folder, time.perf_counter() - begun)
        return found


def _write(path: Path, lightings: Sequence[Lighting]) -> None:
    write_text(path, json.dumps([lighting_json(lighting) for lighting in lightings]) + "\n")


def _took(folder: Path, now: float) -> float:
    """Seconds that what lies in a folder took: as it was made here before, else now, which is noted."""
    path = folder / _TOLD
    if path.is_file() and measured_here((before := json.loads(path.read_text("utf-8")))["environment"]):
        return float(before["seconds"])
    write_text(path, json.dumps({"seconds": round(now, 4), "environment": here()}) + "\n")
    return now


def error_of(tally: Tally) -> float:
    """Relative RMSE over all lightings.

    Raises:
      UserError: they are dark.
    """
    error = tally.scores()["relative_rmse"]
    if error is None:
        raise UserError("tune: got held-out lightings without indirect light, expected some; there is nothing to learn")
    return float(error)


def spread_of(tally: Tally, worse: float = 0.0) -> tuple[float, float]:
    """How far off the logarithm of the relative RMSE is on held-out lightings, by leaving each out (the jackknife).

    Args:
      tally: of the lightings.
      worse: times the largest squared error, of one more lighting as bright as that one, which moments are taken with where
        that widens the spread, and the error itself is not; 0 for none. Of few lightings out of many that differ, the moments
        lack what the error lacks.
    Returns:
      Its standard error, and its skewness: that of the values that stand for the lightings, over the root of their number.
    """
    error, means = tally.error, tally.mean.mean(1)
    if len(error) < 2 or not error.any():
        return 1.0, 0.0
    found = _jackknife(error, means)
    if worse:
        most = int(error.argmax())
        found = max(found, _jackknife(np.append(error, worse * error[most]), np.append(means, means[most])))
    return found


def _jackknife(error: Float64[np.ndarray, " lightings"], means: Float64[np.ndarray, " lightings"]) -> tuple[float, float]:
    """Spread and skew of half the logarithm of the mean of the first, less that of the second's."""
    count = len(error)
    others = (error.sum() - error) / (count - 1), (means.sum() - means) / (count - 1)
    logs = 0.5 * np.log(np.maximum(others[0], 1e-300)) - np.log(np.maximum(others[1], 1e-300))
    values = logs.mean() - logs  # what is larger without a lighting is smaller with it
    square = float(np.mean(values**2))
    skew = float(np.mean(values**3)) / square**1.5 / np.sqrt(count) if square > 1e-24 else 0.0
    return float(np.sqrt((count - 1) * square)), float(skew)
