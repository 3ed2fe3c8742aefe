"""Figures of a report: pictures as PNG bytes, plots as SVG text.

Plots name their colours as CSS variables with a fallback, so that a page may turn them dark; pictures are transparent where
the lightmap or the view holds nothing. Matplotlib is loaded when something is drawn.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float, Float64
from ddprt.dataset.store import Dataset
from ddprt.methods.method import FitReport
from ddprt.report.drawing import INK, blank, saved, style
from ddprt.report.evaluate import Evaluation
from ddprt.report.view import LUMINANCE, View, diverging, exposure_for, png, seen, signed_range, tonemap
from ddprt.transport.embree import Tracer

SERIES = {"first": "#1f5fa8", "second": "#b8501c", "third": "#2f7d4f"}
CHANNELS = {"red": "#c0392b", "green": "#2f8f57", "blue": "#2c6fbf"}
_LARGEST = 512  # pixels along a side of a lightmap's picture


def on_atlas(colours: Float[np.ndarray, "texels 3"], covered: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """Displayed colours of covered texels as a lightmap with alpha; large ones are thinned out for display."""
    image = np.zeros((*covered.shape, 4))
    image[covered] = np.concatenate([colours, np.ones((len(colours), 1))], 1)
    step = -(-max(covered.shape) // _LARGEST)
    return image[::step, ::step]


def in_view(colours: Float[np.ndarray, "height width 3"], view: View) -> np.ndarray:
    """A picture with the view's alpha."""
    return np.concatenate([colours, np.minimum(view.alpha, 1)[..., None]], 2)


def choose_rows(errors: Float64[np.ndarray, " lightings"], count: int) -> list[tuple[int, str]]:
    """Held-out lightings worth a picture, best first: the median, the 90th percentile, the worst, then evenly spread ones.

    Args:
      errors: per lighting; NaN (dark) ones are not chosen.
      count: at most so many.
    Returns:
      Row of `errors` and what it stands for.
    """
    order = np.argsort(errors, kind="stable")[: int(np.isfinite(errors).sum())]
    last = len(order) - 1
    if last < 0:
        return []
    named = [(0.5, "median"), (0.9, "90th percentile"), (1.0, "worst"), (0.0, "best")]
    spread = [(share, f"{100 * share:.0f}th percentile") for share in np.linspace(0, 1, max(count, 2))[1:-1]]
    chosen: dict[int, str] = {}
    for share, label in [*named, *spread, *((rank / max(last, 1), f"rank {rank + 1}") for rank in range(last + 1))]:
        if len(chosen) < count:
            chosen.setdefault(round(share * last), label)
    return [(int(order[rank]), label) for rank, label in sorted(chosen.items())]


def lighting_row(
    direct: Float[np.ndarray, "texels 3"],
    ours: Float[np.ndarray, "texels 3"],
    reference: Float[np.ndarray, "texels 3"],
    albedo: Float[np.ndarray, "texels 3"],
    covered: Bool[np.ndarray, "height width"],
    view: View | None,
) -> dict[str, Any]:
    """All pictures of one lighting under one exposure and one scale of differences.

    Args:
      direct, ours, reference: irradiance in W/m²; the last two are indirect.
      albedo: linear.
      covered: which texels they belong to.
      view: shows radiosity (W/m²) beside the lightmaps; None where there is no scene to look at.
    Returns:
      "exposure" in stops, "limit" of the differences in W/m² (mean of the channels), and "atlas" and "view": pictures by name.
    """
    exposure = exposure_for(reference)
    error = (ours - reference).mean(1)
    limit = signed_range(error)
    light = {"direct": direct, "ours": ours, "reference": reference}
    atlas = {name: png(on_atlas(tonemap(values, exposure), covered)) for name, values in light.items()}
    atlas["difference"] = png(on_atlas(diverging(error, limit), covered))
    seen_by_camera: dict[str, bytes] = {}
    if view is not None:
        light |= {"ours with direct": direct + ours, "reference with direct": direct + reference}
        for name, values in light.items():
            seen_by_camera[name] = png(in_view(tonemap(view.render(albedo * values), exposure), view))
        leaving = view.render(albedo * (ours - reference)).mean(2)
        seen_by_camera["difference"] = png(in_view(diverging(leaving, limit), view))
    return {"exposure": exposure, "limit": limit, "atlas": atlas, "view": seen_by_camera}


def basis_pictures(
    basis: Float[np.ndarray, "bases entries"], covered: Bool[np.ndarray, "height width"], view: View | None, count: int = 8
) -> list[dict[str, bytes]]:
    """Figure 2 (c): the first basis vectors, each signed about white under its own scale; colours are averaged."""
    pictures = []
    for vector in basis[:count]:
        values = vector.reshape(int(covered.sum()), -1).mean(1)
        limit = signed_range(values)
        pictures.append({"atlas": png(on_atlas(diverging(values, limit), covered))})
        if view is not None:
            pictures[-1]["view"] = png(in_view(diverging(view.render(values), limit), view))
    return pictures


def points_pictures(
    data: Dataset, points: int, tracer: Tracer, view: View, shading: Float[np.ndarray, "texels 3"]
) -> tuple[bytes, bytes]:
    """Figure 4: (a) the measurement points, (b) all supersamples, coloured by the point that each is averaged into.

    Args:
      data: whose samples.
      points: how many points they are averaged into.
      tracer: tells which samples are hidden.
      view: from where.
      shading: irradiance (W/m²) that shows the shape, e.g. the mean of all indirect maps.
    """
    clay = np.repeat((shading @ LUMINANCE)[:, None], 3, 1)
    ground = in_view(0.25 + 0.65 * tonemap(view.render(clay), exposure_for(clay)), view)
    home = data.samples.nearest_point(points)
    turn = np.random.default_rng(1).permutation(points) / points
    hue = 0.5 + 0.42 * np.cos(2 * np.pi * (turn[:, None] - np.array([0, 1, 2]) / 3))
    visible = seen(tracer, view.camera, data.samples.position)
    places = view.camera.project(data.samples.position)
    single = visible & (np.arange(len(home)) < points)
    return (
        _scatter(ground, places[single], SERIES["first"], 30),
        _scatter(ground, places[visible], hue[home[visible]], 12),
    )


def hero(
    direct: Float[np.ndarray, "texels 3"],
    ours: Float[np.ndarray, "texels 3"],
    reference: Float[np.ndarray, "texels 3"],
    albedo: Float[np.ndarray, "texels 3"],
    covered: Bool[np.ndarray, "height width"],
    view: View,
    *,
    title: str = "",
) -> bytes:
    """One wide picture of one lighting: direct, ours, reference, signed difference; seen by a camera, lightmaps below."""
    exposure, error = exposure_for(reference), (ours - reference).mean(1)
    limit = signed_range(error)
    difference = in_view(diverging(view.render(albedo * (ours - reference)).mean(2), limit), view)
    total = [
        in_view(tonemap(view.render(albedo * light), exposure), view) for light in (direct, direct + ours, direct + reference)
    ]
    maps = [on_atlas(tonemap(light, exposure), covered) for light in (direct, ours, reference)]
    rows = [*total, difference], [*maps, on_atlas(diverging(error, limit), covered)]
    share = limit / max(float(reference.mean()), 1e-300)
    titles = "direct", "direct + ours", "direct + reference", f"ours − reference, ±{100 * share:.0f} % of mean indirect"
    below = "direct lightmap", "indirect, ours", "indirect, reference", "difference"
    with style():
        figure = blank(12.0, 6.5 if view.camera.aspect <= 1 else 5.8)
        for axes, picture, label in zip(figure.subplots(2, 4).flat, [*rows[0], *rows[1]], [*titles, *below], strict=True):
            axes.imshow(picture, interpolation="lanczos" if axes.get_subplotspec().rowspan.start == 0 else "nearest")
            axes.set_title(label, fontsize=10)
            axes.set_facecolor("#2b2f33")
            axes.set(xticks=[], yticks=[])
            axes.grid(False)
            for spine in axes.spines.values():
                spine.set_visible(False)
        if title:
            figure.suptitle(title, fontsize=11)
        return saved(figure, "png", dpi=120, facecolor="white")


def eigenvalues(report: FitReport) -> str:
    """Figure 3: eigenvalues of the autocorrelation of indirect light over the first, bases in use and rank marked."""

    def draw(axes: Any) -> None:
        squares = np.square(report.singular_values) / max(report.singular_values[0] ** 2, 1e-300)
        axes.semilogy(np.arange(1, len(squares) + 1), np.maximum(squares, 1e-20), color=SERIES["first"])
        axes.axhline(0.01, color=INK["muted"], linestyle=":")
        _mark(axes, report.bases, f"{report.bases} bases", SERIES["second"])
        if report.numerical_rank < len(squares):
            _mark(axes, report.numerical_rank, f"rank {report.numerical_rank}", INK["muted"])
        axes.set(xlabel="eigenvalue", ylabel="share of the first", xlim=(1, None), ylim=(max(squares.min() / 3, 1e-16), 2))

    return _plot("eigenvalues", draw)


def bases_curve(rows: Sequence[tuple[int, float, float]], noise: float | None) -> str:
    """Figure 14: error against number of bases; transfer plain, projection dashed, noise floor dotted."""

    def draw(axes: Any) -> None:
        bases, transfer, projection = np.array(rows, float).reshape(-1, 3).T
        axes.loglog(bases, transfer, "o-", color=SERIES["first"], label="transfer")
        axes.loglog(bases, projection, "s--", color=SERIES["second"], label="projection")
        if noise:
            axes.axhline(noise, color=INK["muted"], linestyle=":", label="noise floor")
        axes.set(xlabel="bases", ylabel="relative RMSE")
        axes.set_xticks(bases, [f"{value:.0f}" for value in bases])
        axes.minorticks_off() if len(bases) > 1 else None
        _percent(axes)
        axes.legend(frameon=False)

    return _plot("bases", draw)


def ridge_path(report: FitReport) -> str:
    """Leave-one-out residual against the ridge, a line per transfer matrix, the chosen ridge marked."""

    def draw(axes: Any) -> None:
        mono = len(report.ridge_path) == 3
        lines = CHANNELS if mono else {"all channels": SERIES["first"]}
        for (name, colour), path, chosen in zip(lines.items(), report.ridge_path, report.ridge, strict=False):
            ridge, residual = np.array(path).T
            positive = ridge > 0
            axes.loglog(ridge[positive], residual[positive], color=colour, label=name)
            if chosen > 0:
                axes.plot(chosen, np.interp(chosen, ridge, residual), "o", color=colour)
        axes.set(xlabel="ridge (scaled measured²)", ylabel="leave-one-out residual")
        axes.legend(frameon=False)

    return _plot("ridge", draw)


def errors_by_distance(distance: Float64[np.ndarray, " lightings"], errors: Float64[np.ndarray, " lightings"]) -> str:
    """Error of each held-out lighting against the distance (metres) from its nearest lamp to the nearest surface."""

    def draw(axes: Any) -> None:
        known = np.isfinite(errors)
        near = known & np.isfinite(distance)
        axes.semilogy(distance[near], np.maximum(errors[near], 1e-9), "o", color=SERIES["first"], alpha=0.75)
        for share, name in ((0.5, "median"), (0.9, "90th percentile")):
            level = float(np.quantile(errors[known], share))
            axes.axhline(level, color=INK["muted"], linestyle="--" if share == 0.5 else ":")
            label = {"text": f"{name} {100 * level:.1f} %", "ha": "right", "va": "bottom", "color": INK["muted"]}
            axes.annotate(xy=(1, level), xycoords=("axes fraction", "data"), **label)
        axes.set(xlabel="lamp to nearest surface (m)", ylabel="error of the lighting")
        _percent(axes)

    return _plot("distance", draw)


def spot_check(check: Mapping[str, Any]) -> str:
    """Baked against traced values at the checked texels, mean of the channels."""

    def draw(axes: Any) -> None:
        baked, traced = (np.asarray(check[side], np.float64).reshape(-1, 3).mean(1) for side in ("baked", "truth"))
        top = max(float(baked.max(initial=0)), float(traced.max(initial=0)))
        axes.plot([0, top], [0, top], color=INK["muted"], linestyle=":")
        axes.plot(traced, baked, ".", color=SERIES["first"], alpha=0.35, markersize=4, markeredgewidth=0)
        axes.set(xlabel="traced (W/m²)", ylabel="baked (W/m²)")

    return _plot("spot", draw)


def z_histogram(check: Mapping[str, Any]) -> str:
    """Distribution of the z-scores beside the unit normal; the outermost bins hold all beyond."""

    def draw(axes: Any) -> None:
        known = check["variance"] > 0
        z = (check["baked"] - check["truth"])[known] / np.sqrt(check["variance"][known])
        x = np.linspace(-5, 5, 201)
        if len(z):
            bins = np.arange(-5, 5.01, 0.25)
            axes.hist(np.clip(z, -4.99, 4.99), bins, density=True, color=SERIES["first"], alpha=0.6)
        axes.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=SERIES["second"], label="unit normal")
        axes.set(xlabel="(baked − traced) / standard error", ylabel="density")
        axes.legend(frameon=False)

    return _plot("zscores", draw)


def budget_bars(budget: Mapping[str, Any]) -> str:
    """Relative RMSE of each part of the error, and of the whole; shares of the square beside them."""

    def draw(axes: Any) -> None:
        rows = [*((part["cause"], part["relative_rmse"], part["share"]) for part in budget["parts"])]
        rows.append(("all", budget["total"]["relative_rmse"], 1.0))
        names, values, shares = zip(*rows, strict=True)
        colours = [SERIES["first"]] * (len(rows) - 1) + [INK["muted"]]
        axes.barh(range(len(rows)), 100 * np.array(values), color=colours, height=0.62)
        for row, (value, share) in enumerate(zip(values, shares, strict=True)):
            axes.annotate(f"{100 * share:.1f} %", (100 * value, row), (4, 0), textcoords="offset points", va="center")
        axes.set(yticks=range(len(rows)), yticklabels=names, xlabel="relative RMSE (%); beside: share of the square")
        axes.set(xlim=(0, 122 * max(values)))
        axes.invert_yaxis()
        axes.grid(False, axis="y")
        axes.set_position((0.29, 0.15, 0.69, 0.81))

    return _plot("budget", draw)


def loss_history(report: FitReport, seconds: Sequence[float] = (), name: str = "loss") -> str:
    """Training and validation loss of a learned method over its steps and, where they are known, seconds (above)."""

    def draw(axes: Any) -> None:
        steps, train, validation = np.array(report.loss).T
        positive = min(train.min(), validation.min()) > 0  # a loss may be a logarithm itself
        axes.set_yscale("log" if positive else "linear")
        axes.plot(steps, train, color=SERIES["first"], label="train", marker="." if len(steps) == 1 else None)
        axes.plot(steps, validation, color=SERIES["second"], label="validation")
        axes.plot(*(values[np.argmin(validation)] for values in (steps, validation)), "o", color=SERIES["second"])
        axes.set(xlabel="step", ylabel="loss", xlim=(0, steps[-1]))
        axes.legend(frameon=False)
        if len(seconds):
            _clock(axes, np.append(0, steps), np.append(0, seconds))

    return _plot(name, draw)


def _clock(axes: Any, steps: np.ndarray, seconds: np.ndarray) -> None:
    """Seconds along the upper edge; they need not be even in steps, as the first ones wait for what is compiled."""
    upper = axes.twiny()
    upper.grid(visible=False)
    upper.spines["top"].set_visible(True)
    at = np.linspace(0, steps[-1], 5)
    upper.set(xlim=axes.get_xlim(), xlabel="seconds")
    upper.set_xticks(at, [f"{moment:.3g}" for moment in np.interp(at, steps, seconds)])
    for each in (axes, upper):
        each.set_position((0.19, 0.15, 0.78, 0.69))


def plots(
    evaluation: Evaluation,
    reports: Mapping[str, FitReport],
    main: str,
    seconds: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, str]:
    """Every plot that the data allows, by name; `seconds` are those of `loss_history`, by name of the method."""
    errors = evaluation.truth.errors_per_lighting(evaluation.predicted[main])
    report, found = reports[main], {}
    if report.singular_values:
        found["eigenvalues"] = eigenvalues(report)
    if evaluation.curve:
        found["bases"] = bases_curve(evaluation.curve, evaluation.metrics["floors"]["noise_relative_rmse"])
    if any(report.ridge_path):
        found["ridge"] = ridge_path(report)
    if len(evaluation.distance) and (np.isfinite(evaluation.distance) & np.isfinite(errors)).any():
        found["distance"] = errors_by_distance(evaluation.distance, errors)
    if evaluation.spot_check:
        found["spot"] = spot_check(evaluation.spot_check)
        if "variance" in evaluation.spot_check:
            found["zscores"] = z_histogram(evaluation.spot_check)
    for name, entry in reports.items():
        if entry.loss:
            found[f"loss of {name}"] = loss_history(entry, (seconds or {}).get(name, ()), f"loss-{name}")
    return found


def _scatter(ground: np.ndarray, places: np.ndarray, colours: Any, size: int) -> bytes:
    height, width = ground.shape[:2]
    with style():
        figure = blank(width / 100, height / 100, layout=None)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.imshow(ground, extent=(0, 1, 1, 0), aspect="auto", interpolation="bicubic")
        axes.scatter(*places.T, c=colours, s=size, edgecolors="white", linewidths=0.5)
        axes.set(xlim=(0, 1), ylim=(1, 0))
        axes.set_axis_off()
        return saved(figure, "png", dpi=200)


def _plot(name: str, draw: Callable[[Any], None]) -> str:
    """SVG text of one pair of axes, ready to stand in a page: no header, no fixed size, themed, and with its own ids."""
    with style({"svg.hashsalt": name}):
        figure = blank(4.6, 3.1, layout=None)  # fixed margins: laying out by measuring would draw everything twice
        axes = figure.add_axes((0.16, 0.15, 0.82, 0.81))
        draw(axes)
        if axes.get_yscale() == "log" and not axes.dataLim.y1 > 0:  # darkness has no logarithm
            axes.set_yscale("linear")
        text = saved(figure, "svg", metadata={"Date": None, "Creator": None}).decode()
    text = re.sub(r"^.*?(?=<svg)|<metadata>.*?</metadata>|<style.*?</style>", "", text, flags=re.S)
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2)
    text = re.sub(r"font-family: [^;]*;", "font-family: inherit;", text)
    text = re.sub(r'(id=")|(url\(#)|(href="#)', lambda found: f"{found.group(0)}{name}-", text)
    for key, colour in {**INK, **SERIES, **CHANNELS}.items():
        text = text.replace(colour, f"var(--plot-{key}, {colour})")
    return text


def _mark(axes: Any, at: int, label: str, colour: str) -> None:
    axes.axvline(at, color=colour, linewidth=1)
    axes.annotate(label, (at, 1), (4, 0), ("data", "axes fraction"), "offset points", va="top", color=colour)


def _percent(axes: Any) -> None:
    """Errors on a log axis in percent rather than powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))
    axes.yaxis.set_minor_formatter("")
