"""The catalogue of hard cases: what makes relighting numerically difficult, and what right means in each.

`tests/test_hard_cases.py` runs it, `experiments/stability.py` makes a table of it. Cases stand in one file per
subject, `FILES`: those of arrays alone build on `hard_arrays.py`, `hard_flaws.py` and `hard_judges.py`, those that bake on
`hard_bakes.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    CASES: "tuple[HardCase, ...]"


@dataclass(frozen=True)
class Outcome:
    """What running a case returned.

    Attributes:
      error_over_bound: worst error over its theoretical bound; 0 where the outcome is exactly right or a named refusal.
      status: "ok", another name of `ddprt.methods.method.STATUSES`, or "refused": a `UserError` with one clear line.
      finite: whether everything that came out was.
    """

    error_over_bound: float
    status: str = "ok"
    finite: bool = True


@dataclass(frozen=True)
class HardCase:
    """One hard case.

    Attributes:
      name: such as "duplicate points".
      why: why it is hard, one sentence.
      right: what right means, one sentence.
      run: runs it through the package.
      statuses: statuses that count as right; "refused" for a `UserError`.
      slow: left to `make test-slow` and the full experiment.
    """

    name: str
    why: str
    right: str
    run: Callable[[], Outcome]
    statuses: frozenset[str] = frozenset({"ok"})
    slow: bool = False


REFUSED = frozenset({"refused"})
"""Statuses of a case whose only right outcome is a `UserError`."""

FILES = (
    "hard_degenerate",
    "hard_magnitudes",
    "hard_basis",
    "hard_transfer",
    "hard_stores",
    "hard_imports",
    "hard_learners",
    "hard_splits",
    "hard_bounces",
    "hard_lights",
    "hard_extents",
    "hard_walls",
    "hard_points",
)
"""Where cases stand, each with its own `CASES`: first those of arrays, then those that bake."""


def passed(case: HardCase, outcome: Outcome) -> bool:
    """Finite output within its bound, under a status that the case allows."""
    return outcome.finite and outcome.error_over_bound <= 1 and outcome.status in case.statuses


def __getattr__(name: str) -> "tuple[HardCase, ...]":
    # Files of cases import the types above, so that they can only be imported once these are there.
    if name != "CASES":
        raise AttributeError(name)
    return tuple(case for file in FILES for case in import_module(file).CASES)
