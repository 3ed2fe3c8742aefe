"""Seconds and memory of a piece of work, compilation apart from running."""

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")
_COMPILING = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
_PATIENCE = 20.0  # seconds after which no further repeat begins
_KIB = 2**10


@dataclass(frozen=True)
class Timing:
    """How long something takes once it is compiled.

    Attributes:
      median, low, high: seconds of a run; low and high are the quartiles.
      compile: seconds that the first call spent on tracing and compiling.
      repeats: runs that these are of.
    """

    median: float
    low: float
    high: float
    compile: float
    repeats: int

    def each(self, count: int) -> "Timing":
        """Seconds of one of `count` calls that a run was made of."""
        return Timing(self.median / count, self.low / count, self.high / count, self.compile, self.repeats)

    def record(self) -> dict[str, float]:
        """As plain numbers to five digits."""
        return {name: float(f"{value:.5g}") for name, value in asdict(self).items()}


def timed(work: Callable[[], T], repeats: int) -> tuple[T, Timing]:
    """Runs `work` once to compile it, then `repeats` times (fewer where that takes longer than 20 s, but once at least).

    Args:
      work: without side effects; what it returns is waited for, JAX's arrays included.
      repeats: at least 1.
    Returns:
      What the last run returned, and the seconds.
    """
    with compiling() as spent:
        jax.block_until_ready(work())
    seconds: list[float] = []
    begun = time.perf_counter()
    while len(seconds) < repeats and (not seconds or time.perf_counter() - begun < _PATIENCE):
        start = time.perf_counter()
        result = jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    low, median, high = np.quantile(seconds, [0.25, 0.5, 0.75])
    return result, Timing(float(median), float(low), float(high), spent[0], len(seconds))


_spent = [0.0]


def _note(event: str, duration_secs: float, **_: Any) -> None:
    if event in _COMPILING:
        _spent[0] += duration_secs


jax.monitoring.register_event_duration_secs_listener(_note)


@contextmanager
def compiling() -> Iterator[list[float]]:
    """Seconds that JAX spends on tracing and compiling inside; one entry, filled in at the end."""
    found, before = [0.0], _spent[0]
    try:
        yield found
    finally:
        found[0] = _spent[0] - before


@contextmanager
def peak_memory() -> Iterator[list[float | None]]:
    """GiB of resident memory at the highest beyond what the process held before; one entry, filled in at the end.

    None where the system does not tell (it is Linux that does).
    """
    found: list[float | None] = [None]
    gc.collect()
    before = None
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # sets the peak back to what is held now
        before = _status("VmRSS")
    try:
        yield found
    finally:
        if before is not None:
            found[0] = round(max(0, _status("VmHWM") - before) * _KIB / 2**30, 4)


def _status(name: str) -> int:
    """An entry of /proc/self/status, KiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))
