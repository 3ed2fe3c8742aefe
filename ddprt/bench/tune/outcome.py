"""What a search comes to: the setting, what it reached, and what stays open."""

from dataclasses import dataclass

from ddprt.bench.measure.settings import Setting
from ddprt.bench.tune.planner import Plan

UNITS = {"relative_rmse": "", "frame_us": " µs", "megabytes": " MB", "bake_seconds": " s", "fit_seconds": " s"}


@dataclass(frozen=True)
class Doubt:
    """A limit of which it cannot be shown, for what a search may cost, whether it is kept.

    Attributes:
      plan: the likeliest to keep all limits of those that were tried, or where these have no chance, of all.
      setting: the plan as a configuration.
      chance: that it keeps all limits.
      quantity: whose limit is the most doubtful.
      expected, low, high: what it is, and what it is below in one case of ten (in fewer where the limit is lower) and in nine.
    """

    plan: Plan
    setting: Setting
    chance: float
    quantity: str
    expected: float
    low: float
    high: float

    @property
    def within(self) -> float:
        """How far off the quantity may be, as a share of what is expected."""
        return max(self.high / self.expected, self.expected / self.low) - 1


@dataclass(frozen=True)
class Outcome:
    """What came of a search.

    Attributes:
      plan: the best that was tried.
      reached: each of `QUANTITIES`, as measured.
      chance: that lightings of another seed are within the limits, too.
      met: whether the budget is met, as far as it was measured.
      doubt: what stays open; None where the answer is sure: a chance of nine in ten that the budget is met, or of less than one
        in fifty for every setting.
      binding: the limit that stands in the way, or that was met with the least room.
      trials: bakes that were made.
      held_out: lightings that the error was told on.
      setting: the plan as a configuration.
      limits: what was asked for.
    """

    plan: Plan
    reached: dict[str, float]
    chance: float
    met: bool
    doubt: Doubt | None
    binding: str
    trials: int
    held_out: int
    setting: Setting
    limits: dict[str, float]
