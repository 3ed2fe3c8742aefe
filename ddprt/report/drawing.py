"""What all figures share: their look, a blank one, and one as a file. Matplotlib is loaded when something is drawn."""

import io
from collections.abc import Mapping
from typing import Any

INK = {"ink": "#24292f", "muted": "#6e7781", "grid": "#d8dee4"}


def blank(width: float, height: float, layout: Any = "constrained") -> Any:
    """A figure of so many inches, outside of pyplot's state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def saved(figure: Any, kind: str, **options: Any) -> bytes:
    """A figure as a file of that kind."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **{"transparent": "facecolor" not in options, **options})
    return buffer.getvalue()


def style(more: Mapping[str, Any] | None = None) -> Any:
    """Settings that all figures are drawn under, as a context; `more` comes on top."""
    from matplotlib import rc_context

    quiet = {
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.linewidth": 0.6,
    }
    colours = {f"{part}": INK["ink"] for part in ("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor")}
    lines = {
        "axes.edgecolor": INK["muted"],
        "xtick.color": INK["muted"],
        "ytick.color": INK["muted"],
        "grid.color": INK["grid"],
    }
    sizes = {"font.size": 8.5, "axes.labelsize": 8.5, "lines.linewidth": 1.5, "lines.markersize": 4.5, "svg.fonttype": "none"}
    return rc_context({**quiet, **lines, **colours, **sizes, **(more or {})})
