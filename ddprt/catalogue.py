"""Tables from a name to an entry, with errors that help."""

from typing import Generic, TypeVar

from ddprt.errors import UserError, nearest

Entry = TypeVar("Entry")


class Catalogue(dict[str, Entry], Generic[Entry]):
    """A dictionary whose missing keys explain themselves.

    Args:
      noun: what an entry is called in messages, e.g. "method".
      entries: the initial table.
    """

    def __init__(self, noun: str, entries: dict[str, Entry]) -> None:
        self.noun = noun
        self.update(entries)

    def __missing__(self, name: str) -> Entry:
        known = ", ".join(sorted(self)) or "none"
        raise UserError(f'no {self.noun} "{name}"{nearest(str(name), self)}; known: {known}')
