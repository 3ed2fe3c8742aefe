"""Figures of error against cost for papers: SVG as wide as a column, text kept as text, the same bytes every time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt.report.figures import INK, _figure, _save, _style

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito's, told apart by all
_GREY = "#9aa2aa"  # of what is dominated
_WIDTH, _PLOT, _ROW = 3.4, 2.35, 0.118  # inches: of a column, height of the axes with their labels, of a row of the legend
_COLUMNS = 2  # of the legend
_SMALL = 5.8  # points, of what stands inside the axes
_CLEAR = 1.0  # points between labels and what else is drawn
_LABELS = 7  # at most, the knee and the ends of the front first


def _star(spikes: int, inner: float, turn: float = 0.0) -> list[tuple[float, float]]:
    angles = np.pi * (np.arange(2 * spikes) / spikes + turn)
    radii = np.where(np.arange(2 * spikes) % 2, inner, 1.0)
    return [(round(float(r * np.sin(a)), 4), round(float(r * np.cos(a)), 4)) for r, a in zip(radii, angles, strict=True)]


def _polygon(corners: int, size: float, turn: float = 0.0) -> list[tuple[float, float]]:
    return [(round(size * x, 4), round(size * y, 4)) for x, y in _star(corners, 1.0, turn)[::2]]


SHAPES = (
    _polygon(24, 0.84),
    _polygon(4, 1, 0.25),
    _polygon(3, 1),
    _polygon(4, 1),
    _polygon(3, 1, 1 / 3),
    _star(4, 0.42, 0.25),
    _polygon(5, 0.95),
    _polygon(3, 1, 0.5),
    _polygon(6, 0.92),
    _polygon(3, 1, -0.5),
    _star(4, 0.42),
)
"""Outlines of markers within a circle of radius 1, y upwards."""
STAR = _star(5, 0.45)


@dataclass(frozen=True)
class Axis:
    """A logarithmic axis.

    Attributes:
      title: what it shows.
      low, high: its ends, positive.
      ticks: values between them and what is written there.
    """

    title: str
    low: float
    high: float
    ticks: Sequence[tuple[float, str]]


@dataclass(frozen=True)
class Cloud:
    """Settings in a plot.

    Attributes:
      costs, errors: positive; NaN where a setting has none and is not drawn.
      low, high: ends of the bar through each cost; NaN for no bar.
      names: of the settings.
      kinds: which of the markers each one has.
      markers: name, colour and outline of every kind, in the order of the legend.
      front: indices of the settings that no other one beats, from the cheapest to the most exact.
      knee: index of the setting where the front bends, if it does.
    """

    costs: np.ndarray
    errors: np.ndarray
    low: np.ndarray
    high: np.ndarray
    names: Sequence[str]
    kinds: Sequence[int]
    markers: Sequence[tuple[str, str, Sequence[tuple[float, float]]]]
    front: Sequence[int]
    knee: int | None


def marker(order: int) -> tuple[str, list[tuple[float, float]]]:
    """Colour and outline of a knob by its order: 66 different ones, told apart by either alone among neighbours."""
    return COLOURS[order % len(COLOURS)], SHAPES[order % len(SHAPES)]


def front_figure(cloud: Cloud, x: Axis, y: Axis, *, floors: Sequence[tuple[str, float]] = (), note: str = "") -> str:
    """Error against cost: what is dominated grey, the front as a step line, the knee ringed, floors dashed.

    Args:
      cloud: the settings.
      x, y: of cost and error.
      floors: what is written at each, and the error below which nothing can be seen or reached.
      note: stands in the middle where there is nothing to draw.
    Returns:
      A whole SVG document, 3.4 inches wide.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    used = sorted({kind for kind, cost, error in zip(cloud.kinds, cloud.costs, cloud.errors, strict=True) if cost * error > 0})
    legend = _ROW * -(-len(used) // _COLUMNS)
    height = _PLOT + legend + (0.06 if used else 0)
    with _style({"svg.hashsalt": f"{x.title}/{y.title}", "font.size": 7, "axes.labelsize": 7, "axes.grid": False}):
        figure = _figure(_WIDTH, height, layout=None)
        FigureCanvasAgg(figure)
        bottom = (height - _PLOT + 0.36) / height
        axes = figure.add_axes((0.145, bottom, 0.835, 1 - bottom - 0.06 / height))
        _scale(axes, x, y)
        if not used:
            axes.text(0.5, 0.5, note, transform=axes.transAxes, ha="center", color=INK["muted"], parse_math=False)
            return _save(figure, "svg", metadata={"Date": None, "Creator": None}).decode()
        taken = _floors(axes, floors, y)
        drawn = _points(axes, cloud, x, y)
        _label(axes, cloud, drawn, taken)
        handles = [_handle(*cloud.markers[kind]) for kind in used]
        figure.legend(
            handles=handles, loc="lower left", bbox_to_anchor=(0.02, 0), ncols=_COLUMNS, frameon=False, fontsize=_SMALL,
            handletextpad=0.1, labelspacing=0.25, columnspacing=1.0, borderpad=0.1, handlelength=1.6,
        )  # fmt: skip
        return _save(figure, "svg", metadata={"Date": None, "Creator": None}).decode()


def _scale(axes: Any, x: Axis, y: Axis) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set(xlim=(x.low, x.high), ylim=(y.low, y.high), xlabel=x.title, ylabel=y.title)
    for side, axis in ((axes.xaxis, x), (axes.yaxis, y)):
        side.set_ticks([value for value, _ in axis.ticks], [text for _, text in axis.ticks])
        side.set_ticks([], minor=True)
    axes.grid(True, zorder=0)
    axes.tick_params(length=2, width=0.6, pad=2)


def _floors(axes: Any, floors: Sequence[tuple[str, float]], y: Axis) -> list[Any]:
    """Dashed lines and their labels, whose boxes are returned."""
    boxes = []
    for text, level in floors:
        if y.low <= level <= y.high:
            axes.axhline(level, color=INK["muted"], linewidth=0.8, linestyle=(0, (4, 2)), zorder=1.5)
            place = {"xycoords": ("axes fraction", "data"), "xytext": (-2, 1.5), "textcoords": "offset points"}
            said = axes.annotate(text, (1, level), **place, ha="right", va="bottom", fontsize=_SMALL, color=INK["muted"])
            boxes.append(said.get_window_extent())
    return boxes


def _points(axes: Any, cloud: Cloud, x: Axis, y: Axis) -> np.ndarray:
    """Draws everything that stands for a setting; returns which ones there are."""
    on = list(cloud.front)
    drawn = np.flatnonzero((cloud.costs > 0) & (cloud.errors > 0))
    grey = {"color": _GREY, "alpha": 0.75, "zorder": 2, "linestyle": "none"}
    for index in (index for index in drawn if index not in on):
        axes.plot(cloud.costs[index], cloud.errors[index], marker=_outline(cloud, index), markersize=3.4, mew=0, **grey)
    if on:
        costs, errors = cloud.costs[on], cloud.errors[on]
        axes.step([costs[0], *costs, x.high], [y.high, *errors, errors[-1]], where="post", color=INK["ink"], lw=0.9, zorder=2.5)
    for index in drawn:
        if cloud.high[index] > cloud.low[index]:
            ends = cloud.low[index], cloud.high[index]
            colour = cloud.markers[cloud.kinds[index]][1] if index in on else _GREY
            axes.plot(ends, [cloud.errors[index]] * 2, color=colour, lw=0.6, zorder=2.2, solid_capstyle="butt")
    for index in on:
        colour = cloud.markers[cloud.kinds[index]][1]
        look = {"color": colour, "mec": "white", "mew": 0.4, "zorder": 3, "linestyle": "none", "clip_on": False}
        axes.plot(cloud.costs[index], cloud.errors[index], marker=_outline(cloud, index), markersize=5.2, **look)
    if cloud.knee is not None:
        ring = {"marker": "o", "markersize": 10, "mfc": "none", "mec": INK["ink"], "mew": 0.9, "zorder": 3.5}
        axes.plot(cloud.costs[cloud.knee], cloud.errors[cloud.knee], linestyle="none", **ring)
    return drawn


def _label(axes: Any, cloud: Cloud, drawn: np.ndarray, taken: list[Any]) -> None:
    """Names of the knee, of the ends of the front, and of what else of it leaves room."""
    from matplotlib.transforms import Bbox

    figure, on = axes.get_figure(), list(cloud.front)
    point = figure.dpi / 72
    places = axes.transData.transform(np.stack([cloud.costs[drawn], cloud.errors[drawn]], 1))
    radii = [(6.0 if index == cloud.knee else 2.8 if index in on else 1.8) * point for index in drawn]
    taken += [Bbox([(px - r, py - r), (px + r, py + r)]) for (px, py), r in zip(places, radii, strict=True)]
    frame, ring = axes.get_window_extent(), [index for index in on if index == cloud.knee]
    named = 0
    for index in dict.fromkeys([*ring, *on[:1], *on[-1:], *_spaced(on)]):
        away = 7.5 if index == cloud.knee else 4.5
        text = f"knee: {cloud.names[index]}" if index == cloud.knee else cloud.names[index]
        for across, up, side, rise in _around(away):
            said = axes.annotate(
                text, (cloud.costs[index], cloud.errors[index]), (across, up), textcoords="offset points", ha=side, va=rise,
                fontsize=_SMALL, color=INK["ink"], parse_math=False, zorder=4, weight="bold" if index in ring else "normal",
            )  # fmt: skip
            box = said.get_window_extent().padded(_CLEAR * point)
            inside = frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1
            if inside and named < _LABELS and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                named += 1
                break
            said.remove()


def _around(away: float) -> list[tuple[float, float, str, str]]:
    """Where a label may stand about its point, best first: offset in points and alignment."""
    near = 0.75 * away
    ways = [(near, near, "left", "bottom"), (-near, -near, "right", "top"), (away, 0.0, "left", "center")]
    ways += [(-away, 0.0, "right", "center"), (0.0, away, "center", "bottom"), (0.0, -away, "center", "top")]
    ways += [(-near, near, "right", "bottom"), (near, -near, "left", "top")]
    return [(reach * x, reach * y, side, rise) for reach in (1.0, 2.2, 3.6) for x, y, side, rise in ways]


def _spaced(on: Sequence[int]) -> list[int]:
    """The front's middle, then the middles of its halves and so on: what is named first stands apart."""
    if not on:
        return []
    middle = len(on) // 2
    left, right = _spaced(on[:middle]), _spaced(on[middle + 1 :])
    mixed = [index for pair in zip(left, right, strict=False) for index in pair]
    return [on[middle], *mixed, *left[len(right) :], *right[len(left) :]]


def _outline(cloud: Cloud, index: int) -> np.ndarray:
    return _closed(cloud.markers[cloud.kinds[index]][2])


def _closed(outline: Sequence[tuple[float, float]]) -> np.ndarray:
    return np.array([*outline, outline[0]])


def _handle(name: str, colour: str, outline: Sequence[tuple[float, float]]) -> Any:
    from matplotlib.lines import Line2D

    look = {"marker": _closed(outline), "markersize": 5, "color": colour, "mew": 0, "linestyle": "none"}
    return Line2D([], [], label=name.lstrip("_") or " ", **look)
