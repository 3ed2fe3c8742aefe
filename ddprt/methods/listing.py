"""The list of all methods (`ddprt bench --methods`): where each is from, what it is for, what it takes."""

import json

from ddprt.methods import METHODS, known_methods
from ddprt.methods.learned import Learned
from ddprt.methods.method import Method
from ddprt.methods.packages import ORIGINS, REFUSED

_COLUMNS = ("method", "from", "learned", "streams", "lights", "why")
_LEGEND = (
    "learned: trained by steps; streams: light may stay on disk while it learns; lights: answers from the lights themselves.\n"
    "Below each its settings and what they are unless [fit] or [methods.settings.NAME] says otherwise."
)


def table() -> str:
    """One row for each entry of `METHODS` with its settings below it, then what was left out, and why."""
    known_methods()
    rows = {name: _row(name, METHODS[name]) for name in METHODS}
    widths = [max(map(len, column)) for column in zip(_COLUMNS, *rows.values(), strict=True)]
    line = lambda cells: "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)).rstrip()  # noqa: E731
    lines = [line(_COLUMNS)]
    for name, row in rows.items():
        lines += [line(row), f"    {_settings(METHODS[name])}"]
    return "\n".join([*lines, "", _LEGEND, *(f"left out: {why}" for why in REFUSED.values())])


def _row(name: str, method: type[Method]) -> tuple[str, ...]:
    is_so = (issubclass(method, Learned), method.streams, hasattr(method.relighter, "describe"))
    return (name, ORIGINS.get(name, "ddprt"), *("yes" if so else "no" for so in is_so), method.why)


def _settings(method: type[Method]) -> str:
    told = []
    for name, field in method.model_fields.items():
        value = "to be given" if field.is_required() else json.dumps(field.get_default(call_default_factory=True), default=str)
        told.append(f"{name} = {value}")
    return ", ".join(told) or "no settings"
