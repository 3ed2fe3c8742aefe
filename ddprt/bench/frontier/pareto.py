"""Which settings no other one beats, where their front bends, and what a further digit costs along it.

A setting is *dominated* where another one costs no more, errs no more, and is better in one of the two. What is left is the
front. The knee is the point of the front that lies farthest below the chord between its ends, in logarithms of cost and error
that are scaled to the unit square. A tenth of the error costs 10^p times as much, p being the slope of the front there.
"""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ddprt.axes import Bool, Float64
from ddprt.files import write_text

Record = Mapping[str, Any]
"""A line of results.jsonl."""
Values = Sequence[float | int | None] | np.ndarray
"""One number per setting; None or NaN where there is none."""
Form = Literal["percent", "decibel", "seconds", "bytes", "gib", "count"]

_SHALLOW = 0.05  # of the unit square: a bend of less than this is what the noise of timings makes as well
_DECIBELS = 20.0  # in a factor of ten of an amplitude


@dataclass(frozen=True)
class Measure:
    """A number that every setting has.

    Attributes:
      at: dotted place in a record; `low` and `high` beside it, if there, are the quartiles of the repeats.
      title: what it is, in words.
      form: its unit and how it is spoken.
      per: dotted place of what it is shared out among; empty for nothing.
    """

    at: str
    title: str
    form: Form
    per: str = ""

    def of(self, record: Record) -> float | None:
        """The number as it stands in a record; None where there is none."""
        value = number(record, self.at)
        if not self.per or value is None:
            return value
        share = number(record, self.per)
        return value / share if share else None

    def falling(self, record: Record) -> float | None:
        """The same so that less is better: decibels become the amplitude 10^(-dB/20)."""
        value = self.of(record)
        return 10.0 ** (-value / _DECIBELS) if value is not None and self.form == "decibel" else value

    def spread(self, record: Record) -> tuple[float, float] | None:
        """Quartiles of the repeats, or None for what is measured once."""
        place, _, _ = self.at.rpartition(".")
        low, high = (Measure(f"{place}.{end}", "", self.form, self.per).of(record) for end in ("low", "high"))
        return None if low is None or high is None or not self.at.endswith(".median") else (low, high)


ERRORS = {
    "error": Measure("scores.relative_rmse", "relative RMSE", "percent"),
    "worst": Measure("scores.worst_lighting_relative_rmse", "error of the worst lighting", "percent"),
    "flicker": Measure("scores.flicker", "flicker along a light path", "percent"),
    "flip": Measure("scores.flip", "HDR-FLIP", "percent"),
    "pu21": Measure("scores.pu21_psnr_db", "PU21-PSNR", "decibel"),
}
"""What a setting may be judged by; less is better but for PU21-PSNR."""

COSTS = {
    "bake": Measure("bake.seconds", "seconds to bake", "seconds"),
    "fit": Measure("fit.median", "seconds to fit", "seconds"),
    "frame": Measure("frame.median", "time of one frame", "seconds"),
    "bytes": Measure("bytes", "bytes that ship", "bytes"),
    "batch": Measure("batch.median", "time of a frame among many", "seconds", per="batch.frames"),
    "coefficients": Measure("coefficients.median", "time of the coefficients alone", "seconds"),
    "rays": Measure("bake.rays", "rays of the bake", "count"),
    "flops": Measure("flops", "operations of a frame", "count"),
    "bake-memory": Measure("bake.peak_gib", "peak memory of the bake", "gib"),
    "fit-memory": Measure("fit.peak_gib", "peak memory of the fit", "gib"),
}
"""What a setting may cost; the first four are drawn in every report."""
DRAWN = ("bake", "fit", "frame", "bytes")


def front(costs: Values, errors: Values) -> Bool[np.ndarray, " settings"]:
    """Which settings are not dominated; of equal ones all stay, and what is not a finite number never does.

    Args:
      costs, errors: of each setting; less is better.
    """
    x, y = _columns(costs, errors)
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    known = known[np.lexsort((y[known], x[known]))]
    x, y = x[known], y[known]
    mask = np.zeros(len(costs), bool)
    if not len(known):
        return mask
    least = np.concatenate([[np.inf], np.minimum.accumulate(y)[:-1]])
    head = np.concatenate([[True], (x[1:] != x[:-1]) | (y[1:] != y[:-1])])  # equal ones stand together and share a fate
    mask[known] = (y < least)[head][np.cumsum(head) - 1]
    return mask


def path(costs: Values, errors: Values) -> list[int]:
    """The front from the cheapest to the most exact, one setting of each place that has logarithms."""
    x, y = _columns(costs, errors)
    found: dict[tuple[float, float], int] = {}
    for index in np.flatnonzero(front(costs, errors)):
        if x[index] > 0 and y[index] > 0:
            found.setdefault((float(x[index]), float(y[index])), int(index))
    return [found[place] for place in sorted(found)]


def knee(costs: Values, errors: Values) -> int | None:
    """Where the front bends: its point farthest below the chord between its ends, both axes logarithmic and scaled to 0..1.

    Returns:
      Index of the setting (of equal ones the first); None where fewer than three places make up the front, or where none of
      them lies a twentieth of the square below the chord.
    """
    along = path(costs, errors)
    if len(along) < 3:
        return None
    x, y = (np.log(values[along]) for values in _columns(costs, errors))
    depth = 1 - (x - x[0]) / (x[-1] - x[0]) - (y - y[-1]) / (y[0] - y[-1])
    deepest = int(np.argmax(depth))
    return along[deepest] if depth[deepest] >= _SHALLOW else None


@dataclass(frozen=True)
class Leg:
    """A part of the front.

    Attributes:
      start, end: indices of the settings at its cheap and at its exact end.
      slope: p, the power of one over the error that the cost grows with.
    """

    start: int
    end: int
    slope: float

    @property
    def factor(self) -> float:
        """So many times as much a tenth of the error costs; infinite past what a float holds."""
        return 10.0**self.slope if self.slope < 300 else math.inf


def slopes(costs: Values, errors: Values, *, at: Sequence[int] | None = None) -> list[Leg]:
    """What a further digit costs along the front: d log(cost) / d log(1 / error), from each of its places to the next.

    Args:
      costs, errors: of each setting.
      at: settings of the front to stop at, from cheap to exact; None: all of them.
    """
    along = path(costs, errors) if at is None else list(at)
    x, y = (np.log10(values[along]) for values in _columns(costs, errors))
    return [Leg(along[i], along[i + 1], float((x[i + 1] - x[i]) / (y[i] - y[i + 1]))) for i in range(len(along) - 1)]


def latest(records: Sequence[Record]) -> list[Record]:
    """Of records of the same setting the last one, in the place of the first."""
    return list({record["digest"]: record for record in records}.values())


def measured(records: Sequence[Record]) -> list[Record]:
    """Records of settings that did not fail."""
    return [record for record in records if not record["failed"]]


def number(record: Record, place: str) -> float | None:
    """The finite number at a dotted place; None where there is none."""
    value: Any = record
    for part in place.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    whole = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if whole else None


def write_csv(records: Sequence[Record], path: str | Path) -> Path:
    """Writes one row per setting and one column per number, named by its place in the record.

    `front.bake`, `front.fit`, `front.frame` and `front.bytes` say whether the setting is on the front of relative RMSE against
    that cost. Numbers are written so that they read back to the last bit; what is absent is empty. The resolved configuration,
    which is not flat, is left out.

    Raises:
      UserError: the file cannot be written.
    """
    records = latest(records)
    rows = [flat(record) for record in records]
    working = [index for index, record in enumerate(records) if not record["failed"]]
    for name in DRAWN:
        on = front(
            [COSTS[name].of(records[i]) for i in working],
            [ERRORS["error"].of(records[i]) for i in working],
        )
        for index, member in zip(working, on, strict=True):
            rows[index][f"front.{name}"] = _cell(bool(member))
    first = ("digest", "name", "failed", *(f"front.{name}" for name in DRAWN))
    columns = list(dict.fromkeys([*first, *(key for row in rows for key in row)]))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(Path(path), buffer.getvalue())
    return Path(path)


def flat(record: Record, place: str = "") -> dict[str, str]:
    """Every leaf of a record by its dotted place, as text; lists as JSON."""
    found: dict[str, str] = {}
    for key, value in record.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{place}{key}.")
        elif f"{place}{key}" != "config":
            found[f"{place}{key}"] = _cell(value)
    return found


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return repr(value) if isinstance(value, float) else json.dumps(value)


def _columns(costs: Values, errors: Values) -> tuple[Float64[np.ndarray, " settings"], Float64[np.ndarray, " settings"]]:
    if len(costs) != len(errors):
        raise ValueError(f"got {len(costs)} costs and {len(errors)} errors, expected one of each per setting")
    return np.array(costs, np.float64), np.array(errors, np.float64)
