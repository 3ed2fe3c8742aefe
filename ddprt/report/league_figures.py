"""Figures of methods compared: error against training seconds or data, losses over time, a rival against the baseline.

SVG text that stands by itself, the same bytes every time.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ddprt.axes import Float64
from ddprt.report.drawing import INK, blank, saved, style
from ddprt.report.fronts import COLOURS

_MARKERS = "os^Dv*PXh"


def looks(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each method, the baseline first and in ink."""
    own = {names[0]: (INK["ink"], "o")}
    for order, name in enumerate(names[1:]):
        own[name] = COLOURS[order % len(COLOURS)], _MARKERS[1 + order % (len(_MARKERS) - 1)]
    return own


def trials_figure(trials: Mapping[str, Sequence[tuple[float, float]]], budget: float | int) -> str:
    """Validation error of every trial against the seconds that its training took; the budget dashed.

    Args:
      trials: (seconds, relative RMSE) by method, the baseline first.
      budget: seconds of the league.
    """

    def draw(axes: Any) -> None:
        for name, (colour, mark) in looks(list(trials)).items():
            found = np.array(trials[name], np.float64).reshape(-1, 2)
            if len(found):
                axes.loglog(found[:, 0], 100 * found[:, 1], mark, color=colour, alpha=0.7, label=name, markeredgewidth=0)
        axes.axvline(budget, color=INK["muted"], linestyle="--", linewidth=0.8)
        axes.set(xlabel="training seconds, without compiling", ylabel="error on validation (%)")
        _plain(axes.xaxis, axes.yaxis)
        _legend(axes)

    return _svg("trials", draw)


def losses_figure(curves: Mapping[str, Sequence[Sequence[tuple[float, float]]]], names: Sequence[str]) -> str:
    """Validation loss over its first look against seconds of training, a line for each seed.

    Args:
      curves: (seconds, loss) of each seed by method; those without a curve are left out.
      names: of all methods, the baseline first, so that colours agree with the other figures.
    """

    def draw(axes: Any) -> None:
        for name, (colour, _) in looks(names).items():
            for order, curve in enumerate(curves.get(name, ())):
                seconds, loss = np.array(curve, np.float64).T
                if loss[0] > 0:
                    axes.plot(seconds, loss / loss[0], color=colour, linewidth=1, label="_" if order else name)
        axes.set(xlabel="seconds since training began, compiling included", ylabel="validation loss over its first look")
        axes.set_xscale("log")
        if (np.concatenate([line.get_ydata() for line in axes.lines] or [np.ones(1)]) > 0).all():
            axes.set_yscale("log")
        _legend(axes)

    return _svg("losses", draw)


def lightings_figure(
    own: Float64[np.ndarray, " lightings"],
    base: Float64[np.ndarray, " lightings"],
    name: str,
    groups: Mapping[str, Sequence[int]],
) -> str:
    """Errors of a rival against those of the baseline, a mark for each held-out lighting: below the line the rival is better.

    Args:
      own, base: norm of the difference over norm of the reference, mean over seeds; NaN for dark lightings.
      name: of the rival.
      groups: lightings that are told apart.
    """

    def draw(axes: Any) -> None:
        known = np.isfinite(own) & np.isfinite(base) & (own > 0) & (base > 0)
        parts = groups or {"held-out lightings": range(len(own))}
        for order, (group, rows) in enumerate(parts.items()):
            at = np.array([row for row in rows if known[row]], int)
            axes.loglog(100 * base[at], 100 * own[at], _MARKERS[order % len(_MARKERS)], color=COLOURS[order % len(COLOURS)],
                        alpha=0.75, markeredgewidth=0, label=group)  # fmt: skip
        if known.any():
            ends = [
                100 * float(end) for end in (min(own[known].min(), base[known].min()), max(own[known].max(), base[known].max()))
            ]
            axes.plot(ends, ends, color=INK["muted"], linewidth=0.8)
        axes.set(xlabel="svd-ridge, error of the lighting (%)", ylabel=f"{name} (%)")
        _plain(axes.xaxis, axes.yaxis)
        _legend(axes)

    return _svg(f"lightings-{name}", draw)


def growth_figure(curves: Mapping[str, Sequence[tuple[int, Float64[np.ndarray, " seeds"]]]], axis: str) -> str:
    """Error of each method over a number that grows, and one standard deviation over seeds to both sides.

    Args:
      curves: (number, relative RMSE of each seed) by method, the baseline first; those without any are left out.
      axis: what the number is of.
    """

    def draw(axes: Any) -> None:
        from matplotlib.ticker import NullLocator

        known = {name: sorted(curve, key=lambda pair: pair[0]) for name, curve in curves.items() if curve}
        for order, (name, (colour, mark)) in enumerate(looks(list(known)).items()):
            found = known[name]
            at, mean = [number for number, _ in found], np.array([100 * errors.mean() for _, errors in found])
            spread = np.array([100 * errors.std(ddof=1) if len(errors) > 1 else 0.0 for _, errors in found])
            axes.errorbar(at, mean, spread, fmt=f"{mark}-", color=colour, label=name, linewidth=1, elinewidth=0.7,
                          zorder=3 if order else 4)  # fmt: skip  # the baseline lies on top
        axes.set(xlabel=axis, ylabel="relative RMSE (%)", xscale="log", yscale="log")
        axes.set_xticks(sorted({number for curve in known.values() for number, _ in curve}))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        _plain(axes.yaxis)
        _legend(axes)

    return _svg("growth", draw)


def _plain(*along: Any) -> None:
    """Ticks at 1, 2 and 5 of each power of ten, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    for axis in along:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter("")


def _legend(axes: Any) -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=6.5)


def _svg(name: str, draw: Callable[[Any], None]) -> str:
    with style({"svg.hashsalt": name}):
        figure = blank(4.6, 3.2)
        draw(figure.add_subplot())
        return saved(figure, "svg", metadata={"Date": None, "Creator": None}).decode()
