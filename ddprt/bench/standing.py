"""Who stands where: equal accuracy first, then time.

Everyone is run on a small piece of the problem first. That warms them up, and tells those that would take too long or too
much memory on the whole, who are left out with that as the reason. Then all take turns, so that whatever else the machine
does hits them alike.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from ddprt.bench.timing import Timing, compiling

OURS = "ddprt"
_PATIENCE = 60.0  # seconds after which no further turn begins

Verdict = Literal["ours", "equal or better", "less accurate", "yardstick", "skipped"]


@dataclass(frozen=True)
class Peer:
    """Another way to the same result.

    Attributes:
      name: as its users call it.
      prepare: takes the problem, leaves the work to be timed; conversions of the input happen here, at no charge.
      needs: module that must be installed.
      package: what pip calls it.
      remark: what it does more or less than we do.
      yardstick: timed and shown, but not a way to the result.
    """

    name: str
    prepare: Callable[[Any], Callable[[], Any]]
    needs: str = ""
    package: str = ""
    remark: str = ""
    yardstick: bool = False

    @property
    def missing(self) -> str:
        """Why it cannot run here; empty where it can."""
        if not self.needs:
            return ""
        try:
            found = find_spec(self.needs)
        except (ImportError, ValueError):
            found = None
        return "" if found else f'{self.needs} is not installed; pip install "ddprt[peers]", or {self.package or self.needs} alone'


@dataclass(frozen=True)
class Row:
    """One line of a comparison.

    Attributes:
      name: of the peer.
      verdict: "equal or better" and "less accurate" are by the errors; only the former are ranked.
      ratio: its median seconds over ours.
      seconds: of a run.
      errors: by name, the smaller the better.
      reason: why it was skipped, or what it does more or less than we do.
    """

    name: str
    verdict: Verdict
    ratio: float | None = None
    seconds: Timing | None = None
    errors: dict[str, float] = field(default_factory=dict)
    reason: str = ""

    def record(self) -> dict[str, Any]:
        """As plain values, ratio first."""
        return {
            "name": self.name,
            "verdict": self.verdict,
            "ratio": None if self.ratio is None else float(f"{self.ratio:.4g}"),
            "seconds": None if self.seconds is None else self.seconds.record(),
            "errors": {name: float(f"{value:.3g}") for name, value in self.errors.items()},
            "reason": self.reason,
        }


def verdict(errors: Mapping[str, float], ours: Mapping[str, float], blur: Mapping[str, float]) -> Verdict:
    """Equal or better where no error passes ours, or what rounding alone does to it (`blur`); NaN passes everything."""
    within = all(errors[name] <= max(ours[name], blur[name]) for name in ours)
    return "equal or better" if within else "less accurate"


def in_turn(works: Mapping[str, Callable[[], Any]], repeats: int) -> tuple[dict[str, Any], dict[str, Timing]]:
    """Results and seconds of several works that take turns; the first turn compiles and is not counted.

    Args:
      works: without side effects; what they return is waited for.
      repeats: turns that count, at least 1; fewer where they take longer than a minute.
    """
    results, spent, seconds = {}, {}, {name: list[float]() for name in works}
    for name, work in works.items():
        with compiling() as found:
            results[name] = jax.block_until_ready(work())
        spent[name] = found[0]
    begun = time.perf_counter()
    for turn in range(repeats):
        if turn and time.perf_counter() - begun > _PATIENCE:
            break
        for name, work in works.items():
            start = time.perf_counter()
            jax.block_until_ready(work())
            seconds[name].append(time.perf_counter() - start)
    timings = {}
    for name, found in seconds.items():
        low, median, high = np.quantile(found, [0.25, 0.5, 0.75])
        timings[name] = Timing(float(median), float(low), float(high), spent[name], len(found))
    return results, timings


def compare(
    peers: Sequence[Peer],
    whole: Any,
    judge: Callable[[Any], dict[str, float]],
    blur: Mapping[str, float],
    *,
    repeats: int,
    piece: Any = None,
    times: float = 1.0,
    limit: float = np.inf,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Row]:
    """Rows of a comparison: ours first, then the accurate ones by time, the less accurate ones, yardsticks, those skipped.

    Args:
      peers: `OURS` among them.
      whole: the problem.
      judge: errors of a result.
      blur: what rounding alone does to each error; differences below it tell nothing.
      repeats: turns.
      piece: a smaller problem to try everyone on first; None tries nobody.
      times: how much more work `whole` is than `piece`.
      limit: seconds that a run of `whole` may be expected to take.
      progress: is told who is at work.
    """
    works: dict[str, Callable[[], Any]] = {}
    skipped = {peer.name: peer.missing for peer in peers if peer.missing}
    for peer in peers:
        if peer.name in skipped:
            continue
        progress(peer.name)
        reason = "" if piece is None or peer.name == OURS else _too_much(peer.prepare(piece), times, limit)
        if reason:
            skipped[peer.name] = reason
        else:
            works[peer.name] = peer.prepare(whole)
    progress("all in turn")
    results, timings = in_turn(works, repeats)
    ours = judge(results[OURS])
    rows = []
    for peer in peers:
        if peer.name in skipped:
            rows.append(Row(peer.name, "skipped", reason=skipped[peer.name]))
            continue
        ratio, seconds = timings[peer.name].median / timings[OURS].median, timings[peer.name]
        if peer.yardstick:
            rows.append(Row(peer.name, "yardstick", ratio, seconds, reason=peer.remark))
            continue
        errors = ours if peer.name == OURS else judge(results[peer.name])
        mark: Verdict = "ours" if peer.name == OURS else verdict(errors, ours, blur)
        rows.append(Row(peer.name, mark, ratio, seconds, errors, peer.remark))
    order = ("ours", "equal or better", "less accurate", "yardstick", "skipped")
    return sorted(rows, key=lambda row: (order.index(row.verdict), row.ratio or 0))


def best(rows: Sequence[Row]) -> Row | None:
    """The fastest peer of those that are as accurate as we are."""
    ranked = [row for row in rows if row.verdict == "equal or better"]
    return min(ranked, key=lambda row: row.ratio or np.inf, default=None)


def _too_much(work: Callable[[], Any], times: float, limit: float) -> str:
    """Why the whole is not tried, from a run of the piece; empty where it is."""
    work()
    start = time.perf_counter()
    work()
    seconds = (time.perf_counter() - start) * times
    if seconds > limit:
        return f"1/{times:g} of the problem says that a run takes {seconds:.0f} s, more than the {limit:.0f} s that it may"
    return ""


def available_memory() -> float:
    """Bytes that the system could still give; infinity where it does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return np.inf
