"""The one exception that means: the user can mend this.

The command line prints it as a single line (got, expected, do) and exits with 2; in Python it is an ordinary `ValueError`.
"""

import difflib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


class UserError(ValueError):
    """Bad input or a bad environment, explained in one line: what was found, what was expected, what to do."""


def nearest(word: str, known: Iterable[str]) -> str:
    """The known spelling closest to `word` as a hint ("; did you mean ...?"), or an empty string."""
    names = list(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.6) or [n for n in names if word and n.startswith(word)]
    return f'; did you mean "{close[0]}"?' if close else ""


def spoken(fault: Mapping[str, Any]) -> tuple[str, str]:
    """The key and the words of a fault that one of our own validators found: ("", "") for pydantic's own.

    A validator of one value says "got ..."; one that looks at several puts the key in front: "region_low: got ...".
    """
    if fault["type"] != "value_error":
        return "", ""
    key, _, text = f": {fault['ctx']['error']}".partition(": got ")
    return key.removeprefix(": "), f"got {text}"


def explain(faults: Sequence[Mapping[str, Any]], example: Any = None, otherwise: str = "mend it") -> str:
    """Faults that pydantic found with one value, as "got, expected, do".

    Args:
      faults: entries of `ValidationError.errors()`; several where a value may be of several kinds.
      example: a good value; shown where a list is asked for, if it is one.
      otherwise: what to do where the faults do not tell.
    """
    short = [fault for fault in faults if fault["type"] == "missing" and isinstance(fault["loc"][-1], int)]
    told = [fault for fault in faults if fault not in short[:-1]]  # the last entry that is missing says how many there must be
    expected = " or ".join(dict.fromkeys(_expected(fault, example) for fault in told))
    return f"got {_as_json(faults[0]['input'])}, expected {expected}; {_remedy(faults) or otherwise}"


def _as_json(value: Any) -> str:
    """A value as the user wrote it, brackets and all; what is not JSON as Python has it."""
    return json.dumps(value, default=repr) if isinstance(value, list | tuple | dict) else repr(value)


def _expected(fault: Mapping[str, Any], example: Any) -> str:
    kind, context, where = fault["type"], fault.get("ctx", {}), fault["loc"][-1]
    if kind in ("too_short", "too_long"):
        bound, count = ("at least", context["min_length"]) if kind == "too_short" else ("at most", context["max_length"])
        return f"{bound} {count} {'entry' if count == 1 else 'entries'}"
    if kind == "missing" and isinstance(where, int):
        return f"at least {where + 1} entries"
    if kind == "tuple_type":
        example = example if isinstance(example, list | tuple) and example else [fault["input"]]
        return f"a list such as {_as_json(example)}"
    text = fault["msg"].removeprefix("Input should be ").removeprefix("a valid ")
    return text.removeprefix("Input should have ").split(", unable")[0]


def _remedy(faults: Sequence[Mapping[str, Any]]) -> str:
    """The nearest spelling or which way to go; empty where the faults do not tell."""
    for fault in faults:
        if fault["type"] == "literal_error" and isinstance(fault["input"], str):
            choices = fault["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", ")
            hint = nearest(fault["input"], choices)
            if hint:
                return hint.removeprefix("; ")
    kinds = {fault["type"] for fault in faults}
    if kinds & {"greater_than", "greater_than_equal"}:
        return "raise it"
    return "lower it" if kinds & {"less_than", "less_than_equal"} else ""
