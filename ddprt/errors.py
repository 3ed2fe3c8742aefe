"""The one exception that means: the user can mend this.

The command line prints it as a single line (got, expected, do) and exits with 2; in Python it is an ordinary `ValueError`.
"""

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """Bad input or a bad environment, explained in one line: what was found, what was expected, what to do."""


def nearest(word: str, known: Iterable[str]) -> str:
    """The known spelling closest to `word` as a hint ("; did you mean ...?"), or an empty string."""
    names = list(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.6) or [n for n in names if word and n.startswith(word)]
    return f'; did you mean "{close[0]}"?' if close else ""
