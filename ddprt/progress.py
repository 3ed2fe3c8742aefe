"""Progress with an ETA on a terminal, plain heartbeat lines elsewhere; warnings that reach the user even where it is hidden."""

import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_HEARTBEAT = 10.0  # seconds between lines where no terminal is


class Doubt(UserWarning):
    """Something in a result that its user should know; `ddprt` says it as one line, in Python it is an ordinary warning."""


def amount(count: float | int) -> str:
    """A count in the unit that suits it, to two digits or three: "312", "4.1 k", "27 M", "1.5 G"."""
    size, unit = float(count), ""
    for larger in ("k", "M", "G", "T"):
        if size < 999.5:
            break
        size, unit = size / 1000, f" {larger}"
    return f"{size:.0f}{unit}" if size >= 99.5 or not unit else f"{size:.2g}{unit}"


class Progress:
    """Stages of a run: shows them, and remembers their seconds.

    Args:
      quiet: show nothing, only remember.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.stages: list[dict[str, float | int | str]] = []
        self._warned: set[str] = set()

    @contextmanager
    def stage(self, name: str, total: int = 0) -> Iterator["Stage"]:
        """A named stage; `total` steps give it an ETA."""
        current = Stage(name, total, self.quiet)
        try:
            with current:
                yield current
        finally:
            self.stages.append({"name": name, "seconds": round(current.seconds, 4), **current.facts})

    def say(self, line: str) -> None:
        """A line for the user."""
        if not self.quiet:
            print(line, file=sys.stderr, flush=True)

    def warn(self, line: str) -> None:
        """Something to mend or to know, said once: a line like the others, or a `Doubt` where nothing is shown."""
        if line in self._warned:
            return
        self._warned.add(line)
        if self.quiet:
            warnings.warn(line, Doubt, stacklevel=2)
        else:
            self.say(f"warning: {line}")


class Stage:
    """One stage that is under way; see `Progress.stage`.

    Attributes:
      facts: numbers that go into run.json beside the seconds.
    """

    def __init__(self, name: str, total: int, quiet: bool) -> None:
        self.name, self.total, self.done = name, total, 0
        self.facts: dict[str, float | int | str] = {}
        self.seconds = 0.0
        self._live: Any = None
        self._words = ""
        self._quiet = quiet
        self._spoken = self._start = self._paced = time.perf_counter()
        self._made = self._shown = 0  # steps that took time since `_paced`; steps that the terminal shows

    def __enter__(self) -> "Stage":
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            parts = (
                TextColumn("{task.description:<22}"),
                BarColumn(),
                TimeElapsedColumn(),
                TextColumn("eta"),
                TimeRemainingColumn(),
            )
            self._live = Progress(*parts, console=Console(stderr=True))
            self._task = self._live.add_task(self.name, total=self.total or None)
            self._live.start()
        return self

    def pace(self, total: int) -> None:
        """So many steps in all, and the next one is the first that tells how long one takes: pilots are no steps.

        Args:
          total: of the whole stage, in the unit of `advance`.
        """
        self.total, self._paced, self._made = total, time.perf_counter(), 0
        if self._live is not None:
            self._live.update(self._task, total=total)

    def advance(self, steps: int = 1, *, found: bool = False) -> None:
        """Notes finished steps; those that an earlier run left (`found`) do not tell how long one takes."""
        self.done += steps
        self._made += 0 if found else steps
        if self._live is not None:
            if not found:  # what was found rides with the first step that is made, which rich takes for a start, not for speed
                self._live.advance(self._task, self.done - self._shown)
                self._shown = self.done
        elif not self._quiet and time.perf_counter() - self._spoken > _HEARTBEAT:
            self._spoken = time.perf_counter()
            rate = (self._spoken - self._paced) / self._made if self._made else 0.0
            left = f", about {rate * (self.total - self.done):.0f} s left" if rate and self.total else ""
            counts = f"{amount(self.done)} of {amount(self.total)}"
            words = f", {self._words}" if self._words else ""
            print(f"{self.name}: {counts} after {self._spoken - self._start:.0f} s{left}{words}", file=sys.stderr, flush=True)

    def tell(self, words: str) -> None:
        """How things stand, in place of the stage's name on a terminal and after it elsewhere, with the next line."""
        self._words = words
        if self._live is not None:
            self._live.update(self._task, description=words)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.seconds = time.perf_counter() - self._start
        if self._live is not None:
            if kind is None and self.total:
                self._live.update(self._task, completed=self.total)
            self._live.stop()
        elif not self._quiet and kind is None:
            facts = "".join(f", {key} {value}" for key, value in self.facts.items())
            print(f"{self.name}: {self.seconds:.1f} s{facts}", file=sys.stderr, flush=True)
