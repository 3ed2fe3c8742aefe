"""Figures of error against cost for papers: SVG as wide as a column, text kept as text, the same bytes every time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt.report.drawing import INK, blank, saved, style

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito's, told apart by all
_GREY = "#9aa2aa"  # of what is dominated
_WIDTH, _PLOT, _ROW = 3.4, 2.3, 0.118  # inches: of a column, height of the axes with their labels, of a row of the legend
_BELOW = 0.36  # inches for what is written below the axes
_COLUMNS = 2  # of the legend
_SMALL = 5.8  # points, of what stands inside the axes
_LETTERS = 7.0  # pixels: what is higher is text, a point or an upright line
_CLEAR = 1.0  # points between labels and what else is drawn
_BESIDE = tuple(
    (at, across, side, up, rise)
    for at, across, side in ((1, -2, "right"), (0, 2, "left"), (0.5, 0, "center"))
    for up, rise in ((1.5, "bottom"), (-1.5, "top"))
)  # where a floor's label may stand: share of the width, points aside, and likewise upwards
_LABELS = 7  # at most, the knee and the ends of the front first


def _star(spikes: int, inner: float, turn: float = 0.0) -> list[tuple[float, float]]:
    angles = np.pi * (np.arange(2 * spikes) / spikes + turn)
    radii = np.where(np.arange(2 * spikes) % 2, inner, 1.0)
    return [(round(float(r * np.sin(a)), 4), round(float(r * np.cos(a)), 4)) for r, a in zip(radii, angles, strict=True)]


def _polygon(corners: int, size: float, turn: float = 0.0) -> list[tuple[float, float]]:
    return [(round(size * x, 4), round(size * y, 4)) for x, y in _star(corners, 1.0, turn)[::2]]


def _spokes(count: int, turn: float) -> list[tuple[float, float]]:
    """Thick arms of equal width about the centre, as a plus has four."""
    inner, half = 0.32 / float(np.sin(np.pi / count)), float(np.arcsin(0.32 / 0.95)) / np.pi
    corners = []
    for arm in range(count):
        way = 2 * arm / count + turn
        corners += [(0.95, way - half), (0.95, way + half), (inner, way + 1 / count)]
    return [(round(r * float(np.sin(np.pi * a)), 4), round(r * float(np.cos(np.pi * a)), 4)) for r, a in corners]


SHAPES = (
    _polygon(24, 0.84),
    _polygon(4, 1.0, 0.25),
    _polygon(3, 1.0),
    _polygon(4, 1.0),
    _polygon(3, 1.0, 1 / 3),
    _spokes(4, 0.25),
    _polygon(3, 1.0, 0.5),
    _polygon(5, 0.95),
    _spokes(4, 0.0),
    _polygon(3, 1.0, -0.5),
    _star(4, 0.42),
    [(-1.0, 0.45), (1.0, 0.45), (1.0, -0.45), (-1.0, -0.45)],
    _spokes(3, 0.0),
    _star(6, 0.5),
    [(-0.45, 1.0), (0.45, 1.0), (0.45, -1.0), (-0.45, -1.0)],
    _polygon(6, 0.92),
    _spokes(3, 1.0),
)
"""Outlines of markers within a circle of radius 1.1, y upwards."""
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
      base: index of the setting that all others are compared with, if it is there; never grey.
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
    base: int | None


def marker(order: int) -> tuple[str, list[tuple[float, float]]]:
    """Colour and outline of a knob by its order: 102 different ones, and 17 that differ in outline alone, as grey ones must."""
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
    height = _PLOT + legend
    with style({"svg.hashsalt": f"{x.title}/{y.title}", "font.size": 7, "axes.labelsize": 7, "axes.grid": False}):
        figure = blank(_WIDTH, height, layout=None)
        FigureCanvasAgg(figure)
        bottom = (legend + _BELOW) / height
        axes = figure.add_axes((0.165, bottom, 0.795, 1 - bottom - 0.06 / height))
        _scale(axes, x, y)
        if not used:
            axes.text(0.5, 0.5, note, transform=axes.transAxes, ha="center", color=INK["muted"], parse_math=False)
            return saved(figure, "svg", metadata={"Date": None, "Creator": None}).decode()
        drawn = _points(axes, cloud, x, y)
        taken = _boxes(axes, cloud, drawn, x)
        _floors(axes, floors, y, taken)
        _label(axes, cloud, drawn, taken)
        handles = [_handle(*cloud.markers[kind]) for kind in used]
        figure.legend(
            handles=handles, loc="lower left", bbox_to_anchor=(0.02, 0), ncols=_COLUMNS, frameon=False, fontsize=_SMALL,
            handletextpad=0.1, labelspacing=0.25, columnspacing=1.0, borderpad=0.1, handlelength=1.6,
        )  # fmt: skip
        return saved(figure, "svg", metadata={"Date": None, "Creator": None}).decode()


def _scale(axes: Any, x: Axis, y: Axis) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set(xlim=(x.low, x.high), ylim=(y.low, y.high), xlabel=x.title, ylabel=y.title)
    for side, axis in ((axes.xaxis, x), (axes.yaxis, y)):
        side.set_ticks([value for value, _ in axis.ticks], [text for _, text in axis.ticks])
        side.set_ticks([], minor=True)
    axes.grid(True, zorder=0)
    axes.tick_params(length=2, width=0.6, pad=2)


def _floors(axes: Any, floors: Sequence[tuple[str, float]], y: Axis, taken: list[Any]) -> None:
    """Dashed lines, and their labels where they hide the fewest points; both join what is taken."""
    from matplotlib.transforms import Bbox

    frame = axes.get_window_extent()
    for text, level in floors:
        if not y.low <= level <= y.high:
            continue
        axes.axhline(level, color=INK["muted"], linewidth=0.8, linestyle=(0, (4, 2)), zorder=1.5)
        said = axes.annotate(text, (1, level), (0, 0), ("axes fraction", "data"), "offset points", fontsize=_SMALL)
        said.set_color(INK["muted"])
        tried: list[tuple[int, Any]] = []
        for at, across, side, up, rise in _BESIDE:
            said.xy = (at, level)
            said.set(ha=side, va=rise, position=(across, up))
            box = said.get_window_extent()
            tried.append((sum(box.overlaps(other) for other in taken), box))
        best = min(range(len(tried)), key=lambda way: tried[way][0])
        at, across, side, up, rise = _BESIDE[best]
        said.xy = (at, level)
        said.set(ha=side, va=rise, position=(across, up))
        height = axes.transData.transform((y.low, level))[1]
        taken += [tried[best][1], Bbox([(frame.x0, height - 0.5), (frame.x1, height + 0.5)])]


def _boxes(axes: Any, cloud: Cloud, drawn: Sequence[int], x: Axis) -> list[Any]:
    """What points and the front's line cover, in pixels."""
    from matplotlib.transforms import Bbox

    point = axes.get_figure().dpi / 72
    radii = dict.fromkeys(drawn, 1.8) | dict.fromkeys(cloud.front, 2.8)
    radii |= {cloud.knee: 6.0} if cloud.knee is not None else {}
    found = []
    for index in drawn:
        px, py = axes.transData.transform((cloud.costs[index], cloud.errors[index]))
        reach = radii[index] * point
        found.append(Bbox([(px - reach, py - reach), (px + reach, py + reach)]))
        if cloud.high[index] > cloud.low[index]:
            bar = axes.transData.transform([(end[index], cloud.errors[index]) for end in (cloud.low, cloud.high)])
            found.append(Bbox([bar[0] - 0.3 * point, bar[1] + 0.3 * point]))
    ends = [*(cloud.costs[list(cloud.front)]), x.high]
    for index, end in zip(cloud.front, ends[1:], strict=True):
        px, py = axes.transData.transform((cloud.costs[index], cloud.errors[index]))
        right, _ = axes.transData.transform((end, cloud.errors[index]))
        found.append(Bbox([(px, py - 0.4 * point), (right, py + 0.4 * point)]))
    for before, index in zip([None, *cloud.front], cloud.front, strict=False):
        px, py = axes.transData.transform((cloud.costs[index], cloud.errors[index]))
        top = axes.get_window_extent().y1 if before is None else axes.transData.transform((1, cloud.errors[before]))[1]
        found.append(Bbox([(px - 0.4 * point, py), (px + 0.4 * point, top)]))
    return found


def _points(axes: Any, cloud: Cloud, x: Axis, y: Axis) -> list[int]:
    """Draws everything that stands for a setting; returns which ones there are."""
    on, own = list(cloud.front), {*cloud.front, cloud.base}
    drawn: list[int] = np.flatnonzero((cloud.costs > 0) & (cloud.errors > 0)).tolist()
    grey = {"color": _GREY, "alpha": 0.75, "zorder": 2, "linestyle": "none"}
    for index in (index for index in drawn if index not in own):
        axes.plot(cloud.costs[index], cloud.errors[index], marker=_outline(cloud, index), markersize=3.4, mew=0, **grey)
    if on:
        costs, errors = cloud.costs[on], cloud.errors[on]
        axes.step([costs[0], *costs, x.high], [y.high, *errors, errors[-1]], where="post", color=INK["ink"], lw=0.9, zorder=2.5)
    for index in drawn:
        if cloud.high[index] > cloud.low[index]:
            ends = cloud.low[index], cloud.high[index]
            colour = cloud.markers[cloud.kinds[index]][1] if index in own else _GREY
            axes.plot(ends, [cloud.errors[index]] * 2, color=colour, lw=0.6, zorder=2.2, solid_capstyle="butt")
    for index in sorted((index for index in drawn if index in own), key=lambda index: index == cloud.base):
        colour = cloud.markers[cloud.kinds[index]][1]
        look = {"color": colour, "mec": "white", "mew": 0.4, "zorder": 3, "linestyle": "none", "clip_on": False}
        axes.plot(cloud.costs[index], cloud.errors[index], marker=_outline(cloud, index), markersize=5.2, **look)
    if cloud.knee is not None:
        ring = {"marker": "o", "markersize": 10, "mfc": "none", "mec": INK["ink"], "mew": 0.9, "zorder": 3.5}
        axes.plot(cloud.costs[cloud.knee], cloud.errors[cloud.knee], linestyle="none", **ring)
    return drawn


def _label(axes: Any, cloud: Cloud, drawn: Sequence[int], taken: list[Any]) -> None:
    """Names of the knee, of the base, of the ends of the front, and of what else of it leaves room."""
    on, frame = list(cloud.front), axes.get_window_extent()
    base = [cloud.base] if cloud.base is not None and cloud.base in drawn else []
    ring = [cloud.knee] if cloud.knee is not None else []
    named = 0
    for index in dict.fromkeys([*ring, *base, *on[:1], *on[-1:], *_spaced(on)]):
        name = cloud.names[index]
        said = [f"knee: {name}", "knee"] if index in ring else [name]
        if named < _LABELS and any(_placed(axes, cloud, index, text, frame, taken) for text in said):
            named += 1


def _placed(axes: Any, cloud: Cloud, index: int, text: str, frame: Any, taken: list[Any]) -> bool:
    """Writes beside a point where nothing else is, or not at all."""
    at_knee = index == cloud.knee
    look = {"fontsize": _SMALL, "color": INK["ink"], "parse_math": False, "zorder": 4}
    look["weight"] = "bold" if at_knee else "normal"
    leader = {"arrowstyle": "-", "lw": 0.4, "color": INK["muted"], "shrinkA": 0, "shrinkB": 6 if at_knee else 3}
    for reach, across, up, side, rise in _around(7.5 if at_knee else 4.5):
        said = axes.annotate(
            text, (cloud.costs[index], cloud.errors[index]), (across, up), textcoords="offset points", ha=side, va=rise,
            arrowprops=leader if reach > 1 else None, **look,
        )  # fmt: skip
        box = _text_box(said).padded(_CLEAR * axes.get_figure().dpi / 72)
        inside = frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1
        line = _leader(axes, cloud, index, across, up) if reach > 1 else []
        words = [other for other in taken if other.height > _LETTERS]
        free = not any(box.overlaps(other) for other in taken)
        if inside and free and not any(other.overlaps(bit) for bit in line for other in words):
            taken += [box, *line]
            return True
        said.remove()
    return False


def _leader(axes: Any, cloud: Cloud, index: int, across: float, up: float) -> list[Any]:
    """What the line from a point to its label covers, bit by bit; its first part lies among the points."""
    from matplotlib.transforms import Bbox

    start = axes.transData.transform((cloud.costs[index], cloud.errors[index]))
    way = np.array([across, up]) * axes.get_figure().dpi / 72
    bits = [start + share * way for share in np.linspace(0.4, 1, 9)]
    return [Bbox([(x - 0.5, y - 0.5), (x + 0.5, y + 0.5)]) for x, y in bits]


def _text_box(said: Any) -> Any:
    """Of the words alone, without their leader."""
    from matplotlib.text import Text

    said.update_positions(said.get_figure().canvas.get_renderer())
    return Text.get_window_extent(said)


def _around(away: float) -> list[tuple[float, float, float, str, str]]:
    """Where a label may stand about its point, best first: how far out, offset in points, and alignment."""
    near = 0.75 * away
    ways = [(near, near, "left", "bottom"), (-near, -near, "right", "top"), (away, 0.0, "left", "center")]
    ways += [(-away, 0.0, "right", "center"), (0.0, away, "center", "bottom"), (0.0, -away, "center", "top")]
    ways += [(-near, near, "right", "bottom"), (near, -near, "left", "top")]
    return [(reach, reach * x, reach * y, side, rise) for reach in (1.0, 2.2, 3.6) for x, y, side, rise in ways]


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

    look: dict[str, Any] = {"marker": _closed(outline), "markersize": 5, "color": colour, "mew": 0, "linestyle": "none"}
    return Line2D([], [], label=name.lstrip("_") or " ", **look)
