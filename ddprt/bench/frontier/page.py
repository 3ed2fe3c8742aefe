"""What a sweep found, for people: a page that opens from disk, figures for papers, a table for other programs.

All numbers, fronts, words and ticks are made here; the page's script only draws what it is given.
"""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.bench.frontier import pareto
from ddprt.bench.frontier.pareto import COSTS, DRAWN, ERRORS, Form, Leg, Measure, Record
from ddprt.files import make_folder, write_text
from ddprt.report import words
from ddprt.report.fronts import SHAPES, STAR, Axis, Cloud, front_figure, marker

PAGE, TABLE = "frontier.html", "frontier.csv"
BASE, SEVERAL = "as configured", "several knobs at once"
_ROOM, _TINY = 0.08, 1.5  # free part at each end of an axis, and the least ratio of its ends
_FEWEST, _MOST = 3, 6  # ticks
_FLAT = 1e4  # a tenth of the error for so many times the cost is as good as never
_MANTISSAS = ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7), tuple(i / 10 for i in range(10, 100)))
_BINARY = ((1,), (1, 1.5), (1, 1.25, 1.5, 1.75), tuple(1 + i / 16 for i in range(16)))
_UNITS = {2.0**30: "GiB", 2.0**20: "MiB", 2.0**10: "KiB", 1.0: "B"}
_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)  # decibels
_ROWS = ("error", "worst", "flicker", "flip", "pu21")


def write_all(folder: str | Path, records: Sequence[Record], *, title: str = "", base_digest: str | None = None) -> list[Path]:
    """Writes the page, the table and a figure of relative RMSE against each of the four costs.

    Args:
      folder: is made where it is missing.
      records: lines of results.jsonl; of the same setting the last one counts.
      title: names the scene.
      base_digest: of the setting that all others are compared with; None: the one that changes nothing.
    Returns:
      The files.
    Raises:
      UserError: a file cannot be written.
    """
    folder = Path(folder)
    make_folder(folder)
    found = Sweep(records, base_digest)
    for cost, figure in found.figures.items():
        write_text(folder / f"error-{cost}.svg", figure)
    write_text(folder / PAGE, _page(found, title))
    pareto.write_csv(records, folder / TABLE)
    return [folder / PAGE, folder / TABLE, *(folder / f"error-{cost}.svg" for cost in found.figures)]


def write_page(path: str | Path, records: Sequence[Record], *, title: str, base_digest: str | None = None) -> Path:
    """Writes the page, which needs nothing but itself.

    Args:
      path: of the HTML file.
      records: lines of results.jsonl; of the same setting the last one counts.
      title: names the scene.
      base_digest: of the setting that all others are compared with; None: the one that changes nothing.
    Raises:
      UserError: the file cannot be written.
    """
    write_text(Path(path), _page(Sweep(records, base_digest), title))
    return Path(path)


def embedded(data: Any) -> str:
    """JSON that may stand in a script element: it can neither end it nor begin a comment."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


class Sweep:
    """Records by what is shown of them.

    Attributes:
      settings: records of settings that did not fail.
      failed: the others.
      base: the record that all are compared with, None where it is missing or failed.
      knobs: dotted keys that are changed in any of the settings.
    """

    def __init__(self, records: Sequence[Record], base_digest: str | None = None) -> None:
        records = pareto.latest(records)
        self.settings = pareto.measured(records)
        self.failed = [record for record in records if record["failed"]]
        self.base: Record | None = None
        for record in self.settings:
            if record["digest"] == base_digest or (base_digest is None and not record["changes"]):
                self.base = record
        self.knobs = list(dict.fromkeys(key for record in self.settings for key in record["changes"]))

    def kind(self, record: Record) -> str:
        """What a setting is an instance of: the base, the one knob it changes, or several of them."""
        if record is self.base:
            return BASE
        changes = list(record["changes"])
        return changes[0] if len(changes) == 1 else SEVERAL if changes else BASE

    def markers(self) -> dict[str, tuple[str, list[tuple[float, float]]]]:
        """Colour and outline of every kind that occurs, the base first."""
        kinds = {self.kind(record) for record in self.settings}
        own = {BASE: ("#24292f", STAR), **{knob: marker(order) for order, knob in enumerate(self.knobs)}}
        own[SEVERAL] = marker(max(len(SHAPES) - 1, len(self.knobs)))
        return {name: look for name, look in own.items() if name in kinds}

    def pair(self, error: str, cost: str) -> tuple[list[float | None], list[float | None]]:
        """Costs and errors of all settings, less being better."""
        return [COSTS[cost].of(record) for record in self.settings], [ERRORS[error].falling(record) for record in self.settings]

    def floors(self) -> list[tuple[str, float]]:
        """What no setting can be seen to pass: noise of the held-out maps, and what the base's basis leaves."""
        named = {"noise": "noise floor", "projection": "projection floor"}
        found = [(text, pareto.number(self.base or {}, f"floors.{key}_relative_rmse")) for key, text in named.items()]
        return [(f"{text} ({words.percent(level)})", level) for text, level in found if level]

    def axis(self, measure: Measure, more: Sequence[float] = ()) -> Axis:
        """An axis that holds all settings, the bars of their repeats, and more."""
        values = [value for record in self.settings if (value := measure.falling(record)) is not None]
        values += [end for record in self.settings for end in measure.spread(record) or ()]
        values = [value for value in (*values, *more) if value > 0]
        low, high = (min(values), max(values)) if values else (1.0, 10.0)
        wide = max(math.log10(high / low), math.log10(_TINY))
        middle, half = math.log10(low * high) / 2, wide * (0.5 + _ROOM)
        low, high = 10 ** (middle - half), 10 ** (middle + half)
        return Axis(measure.title, low, high, ticks(low, high, measure.form))

    @cached_property
    def figures(self) -> dict[str, str]:
        """SVG of relative RMSE against each of the costs that are always drawn."""
        return {cost: self.figure(cost) for cost in DRAWN}

    def figure(self, cost: str, error: str = "error") -> str:
        """SVG of a pair for papers."""
        costs, errors = (np.array(values, np.float64) for values in self.pair(error, cost))
        bars = [COSTS[cost].spread(record) or (np.nan, np.nan) for record in self.settings]
        low, high = np.array(bars, np.float64).reshape(-1, 2).T
        markers, floors = self.markers(), self.floors() if error == "error" else []
        cloud = Cloud(
            costs, errors, low, high,
            names=[record["name"] for record in self.settings],
            kinds=[list(markers).index(self.kind(record)) for record in self.settings],
            markers=[(name, *look) for name, look in markers.items()],
            front=pareto.path(costs, errors),
            knee=pareto.knee(costs, errors),
            base=next((index for index, record in enumerate(self.settings) if record is self.base), None),
        )  # fmt: skip
        y = self.axis(ERRORS[error], [level for _, level in floors])
        return front_figure(cloud, self.axis(COSTS[cost]), y, floors=floors, note="no setting has both")

    def words(self, error: str, cost: str) -> list[str]:
        """What a further digit costs, in sentences."""
        costs, errors = self.pair(error, cost)
        along, knee = pareto.path(costs, errors), pareto.knee(costs, errors)
        title = COSTS[cost].title
        if not along:
            return [f"No setting tells both {ERRORS[error].title} and {title}."]
        if len(along) == 1:
            return [f"{self._spot(along[0], error, cost)} is the best in both: nothing is to be traded."]
        inner = [] if knee is None or knee in (along[0], along[-1]) else [knee]
        said = []
        legs = pareto.slopes(costs, errors, at=[along[0], *inner, along[-1]])
        for order, leg in enumerate(legs):
            start = "From the knee" if order else f"From {self._spot(leg.start, error, cost)}"
            end = f"the knee, {self._spot(leg.end, error, cost)}" if leg.end == knee else self._spot(leg.end, error, cost)
            said.append(f"{start} to {end}: {_rate(leg, ERRORS[error])}.")
        if not inner:
            few = "fewer than three settings make it up" if len(along) < 3 else "it hardly bends"
            said.append(f"The front has no knee: {few}.")
        return said

    def data(self) -> dict[str, Any]:
        """All that the page's script draws."""
        floors = self.floors()
        markers = self.markers()
        settings = [
            {
                "digest": record["digest"],
                "name": record["name"],
                "knobs": [*record["changes"]],
                "kind": list(markers).index(self.kind(record)),
                "errors": [_told(measure, record) for measure in ERRORS.values()],
                "costs": [_told(measure, record) for measure in COSTS.values()],
            }
            for record in self.settings
        ]
        pairs = {}
        for error in ERRORS:
            for cost in COSTS:
                values = self.pair(error, cost)
                pairs[f"{error}/{cost}"] = {
                    "path": pareto.path(*values),
                    "front": [int(index) for index in np.flatnonzero(pareto.front(*values))],
                    "knee": pareto.knee(*values),
                    "words": self.words(error, cost),
                }
        axes = {
            name: [
                {"key": key, **_axis(self.axis(measure, [level for _, level in floors] if key == "error" else ()))}
                for key, measure in table.items()
            ]
            for name, table in (("errors", ERRORS), ("costs", COSTS))
        }
        looks = [{"name": name, "colour": colour, "outline": outline} for name, (colour, outline) in markers.items()]
        return {
            **axes,
            "drawn": list(DRAWN),
            "settings": settings,
            "pairs": pairs,
            "floors": floors,
            "markers": looks,
            "base": self.settings.index(self.base) if self.base else None,
        }

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table, the most exact setting first."""
        fronts = {cost: pareto.front(*self.pair("error", cost)) for cost in DRAWN}
        order = sorted(
            range(len(self.settings)), key=lambda index: (ERRORS["error"].of(self.settings[index]) or math.inf, index)
        )
        return [self._row(self.settings[index], [cost for cost in DRAWN if fronts[cost][index]]) for index in order]

    def columns(self) -> list[str]:
        """Heads of the table."""
        return [
            *(ERRORS[key].title for key in _ROWS), "bake", "fit", "fit, compiling", "frame", "frame, compiling", "ships",
        ]  # fmt: skip

    def machines(self) -> list[dict[str, Any]]:
        """Where and when the settings were measured: one entry per machine, version and commit."""
        found: dict[str, dict[str, Any]] = {}
        for record in [*self.settings, *self.failed]:
            place = record["environment"]
            key = json.dumps([place.get("ddprt"), place.get("commit"), place.get("machine")], sort_keys=True)
            entry = found.setdefault(key, {**place, "count": 0, "first": place["when"], "last": place["when"]})
            entry["count"] += 1
            entry["first"], entry["last"] = min(entry["first"], place["when"]), max(entry["last"], place["when"])
        return list(found.values())

    def missing(self) -> list[str]:
        """Why a score is missing, each reason once."""
        reasons = [record["scores"].get("flip_reason") for record in self.settings if record["scores"].get("flip") is None]
        return list(dict.fromkeys(f"HDR-FLIP: {reason}" for reason in reasons if reason))

    def _row(self, record: Record, on: list[str]) -> dict[str, Any]:
        first = {cost: Measure(f"{cost}.compile", "", "seconds") for cost in ("fit", "frame")}
        shown = [ERRORS[key] for key in _ROWS]
        shown += [COSTS["bake"], COSTS["fit"], first["fit"], COSTS["frame"], first["frame"], COSTS["bytes"]]
        cells = [(measure.of(record), _plain(measure, record), _between(measure, record)) for measure in shown]
        numbers = {key: value for key, value in pareto.flat(record).items() if not key.startswith(("environment.", "changes."))}
        return {"record": record, "cells": cells, "on": on, "numbers": numbers, "base": record is self.base}

    def _spot(self, index: int, error: str, cost: str) -> str:
        record = self.settings[index]
        return f"“{record['name']}” ({_plain(ERRORS[error], record)}, {_plain(COSTS[cost], record)})"


def _page(found: Sweep, title: str) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("ddprt.bench", "frontier")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template("page.html.j2").render(
        version=__version__,
        title=title,
        found=found,
        base=found.base,
        costs=COSTS,
        errors=ERRORS,
        pictures={cost: base64.b64encode(figure.encode()).decode() for cost, figure in found.figures.items()},
        words={cost: found.words("error", cost) for cost in DRAWN},
        spoken=spoken,
        noise=_say(noise, "percent") if (noise := pareto.number(found.base or {}, "floors.noise_relative_rmse")) else "",
        data=embedded(found.data()),
    )


def ticks(low: float, high: float, form: Form) -> list[tuple[float, str]]:
    """Round values between the ends of a logarithmic axis, six at most and rising, and how they are written."""
    if form == "decibel":
        ends = [-20 * math.log10(end) for end in (high, low)]
        for step in _STEPS:
            steps = range(math.ceil(ends[0] / step), math.floor(ends[1] / step) + 1)
            if len(steps) <= _MOST:
                break
        return [(10 ** (-i * step / 20), f"{i * step:g} dB") for i in reversed(steps)]
    base, mantissas = (2, _BINARY) if form in ("bytes", "gib") else (10, _MANTISSAS)
    first, last = math.floor(math.log(low, base)), math.ceil(math.log(high, base))
    values: list[float] = []
    for mantissa in mantissas:
        values = [m * float(base) ** power for power in range(first, last + 1) for m in mantissa]
        values = [value for value in values if low <= value <= high]
        if len(values) >= _FEWEST:
            break
    values = values[:: -(-len(values) // _MOST)] if values else []
    return [(value, _short(value, form)) for value in values]


def _short(value: float, form: Form) -> str:
    """A round value as it stands at an axis."""
    if form == "percent":
        return f"{100 * value:g}\u00a0%"
    if form in ("bytes", "gib"):
        value = value * 2**30 if form == "gib" else value
        scale = next((scale for scale in _UNITS if value >= scale), 1.0)
        return f"{value / scale:g} {_UNITS[scale]}"
    return _say(value, form)


def spoken(measure: Measure, record: Record) -> str:
    """A number with its unit, and the quartiles of its repeats if there are any."""
    between = _between(measure, record)
    return _plain(measure, record) + (f" ({between})" if between else "")


def _between(measure: Measure, record: Record) -> str:
    spread = measure.spread(record)
    return "" if spread is None else " – ".join(_say(end, measure.form) for end in spread)


def _plain(measure: Measure, record: Record) -> str:
    value = measure.of(record)
    return "–" if value is None else f"{value:.1f} dB" if measure.form == "decibel" else _say(value, measure.form)


def _say(value: float, form: Form) -> str:
    if form == "gib":
        return words.size(value * 2**30)
    if form == "percent":
        return words.percent(value) if value >= 1e-3 else f"{100 * value:.2g}\u00a0%"
    ways: Mapping[str, Any] = {"seconds": words.seconds, "bytes": words.size, "count": words.count}
    return ways[form](value)


def _told(measure: Measure, record: Record) -> list[Any] | None:
    """Place on the axis, in words, and the ends of the bar."""
    value = measure.falling(record)
    return None if value is None else [value, spoken(measure, record), *(measure.spread(record) or ())]


def _axis(axis: Axis) -> dict[str, Any]:
    return {"title": axis.title, "low": axis.low, "high": axis.high, "ticks": [list(tick) for tick in axis.ticks]}


def _rate(leg: Leg, measure: Measure) -> str:
    less = "20 dB more" if measure.form == "decibel" else "ten times less error"
    if leg.factor >= _FLAT:
        return f"at this rate {less} would cost more than {_FLAT:,.0f} times as much; the error hardly falls any more"
    return f"at this rate {less} costs {_twice(leg.factor)} times as much"


def _twice(factor: float) -> str:
    """Two digits below ten thousand, without powers."""
    return f"{float(f'{factor:.2g}'):,.10g}"
