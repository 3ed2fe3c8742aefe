"""Progress with an ETA on a terminal, plain heartbeat lines elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_HEARTBEAT = 10.0  # seconds between lines where no terminal is


class Progress:
    """Stages of a run: shows them, and remembers their seconds.

    Args:
      quiet: show nothing, only remember.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.stages: list[dict[str, float | int | str]] = []

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
        self._quiet = quiet
        self._spoken = self._start = time.perf_counter()

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

    def advance(self, steps: int = 1) -> None:
        """Notes finished steps."""
        self.done += steps
        if self._live is not None:
            self._live.advance(self._task, steps)
        elif not self._quiet and time.perf_counter() - self._spoken > _HEARTBEAT:
            self._spoken = time.perf_counter()
            elapsed = self._spoken - self._start
            left = f", about {elapsed * (self.total - self.done) / self.done:.0f} s left" if self.done and self.total else ""
            print(f"{self.name}: {self.done} of {self.total} after {elapsed:.0f} s{left}", file=sys.stderr, flush=True)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.seconds = time.perf_counter() - self._start
        if self._live is not None:
            if kind is None and self.total:
                self._live.update(self._task, completed=self.total)
            self._live.stop()
        elif not self._quiet and kind is None:
            facts = "".join(f", {key} {value}" for key, value in self.facts.items())
            print(f"{self.name}: {self.seconds:.1f} s{facts}", file=sys.stderr, flush=True)
