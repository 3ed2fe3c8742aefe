"""Who stands where: equal accuracy first, then time.

Everyone is run on a small piece of the problem first. That warms them up, and tells those that would take too long or too
much memory on the whole, who are left out with that as the reason. Then all take turns, so that whatever else the machine
does hits them alike.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from ddprt.bench.timing import Timing, compiling, peak_memory

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
    prepare: Callable[..., Callable[[], Any]]
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
            import_module(self.needs)
        except ImportError as error:
            return f"{self.needs} is not installed ({error}); pip install {self.package or self.needs}"
        return ""


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


def in_turn(works: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, list[float]]:
    """Seconds of several works that take turns, compiled before.

    Args:
      works: without side effects; what they return is waited for.
      repeats: turns, at least 1; fewer where they take longer than a minute.
    """
    seconds: dict[str, list[float]] = {name: [] for name in works}
    begun = time.perf_counter()
    for turn in range(repeats):
        if turn and time.perf_counter() - begun > _PATIENCE:
            break
        for name, work in works.items():
            start = time.perf_counter()
            jax.block_until_ready(work())
            seconds[name].append(time.perf_counter() - start)
    return seconds


def compare(
    peers: Sequence[Peer],
    whole: Any,
    judge: Callable[[Any], dict[str, float]],
    blur: Mapping[str, float],
    *,
    repeats: int,
    frames: int = 1,
    piece: Any = None,
    times: float = 1.0,
    limit: float = np.inf,
    tell: Callable[[str], None] = lambda line: None,
) -> list[Row]:
    """Rows of a comparison: ours first, then the accurate ones by time, the less accurate ones, yardsticks, those skipped.

    Args:
      peers: `OURS` among them.
      whole: the problem.
      judge: errors of a result.
      blur: what rounding alone does to each error; differences below it tell nothing.
      repeats: turns.
      frames: how many problems a work solves; seconds are of one.
      piece: a smaller problem to try everyone on first; None tries nobody.
      times: how much more work `whole` is than `piece`.
      limit: seconds that a run of `whole` may be expected to take.
      tell: is told who is at work.
    """
    works: dict[str, Callable[[], Any]] = {}
    errors: dict[str, dict[str, float]] = {}
    spent, skipped = {}, {peer.name: peer.missing for peer in peers if peer.missing}
    for peer in peers:
        if peer.name in skipped:
            continue
        tell(peer.name)
        reason = "" if piece is None or peer.name == OURS else _too_much(peer.prepare(piece), times, limit)
        if reason:
            skipped[peer.name] = reason
            continue
        works[peer.name] = peer.prepare(whole)
        with compiling() as found:
            result = jax.block_until_ready(works[peer.name]())
        spent[peer.name] = found[0]
        errors[peer.name] = {} if peer.yardstick else judge(result)
        del result  # it may be gigabytes
    tell("all in turn")
    timings = {name: _timing(np.array(found) / frames, spent[name]) for name, found in in_turn(works, repeats).items()}
    rows = [Row(name, "skipped", reason=reason) for name, reason in skipped.items()]
    for peer in peers:
        if peer.name in works:
            mark: Verdict = "ours" if peer.name == OURS else "yardstick" if peer.yardstick else "less accurate"
            if mark == "less accurate":
                mark = verdict(errors[peer.name], errors[OURS], blur)
            timing = timings[peer.name]
            rows.append(Row(peer.name, mark, timing.median / timings[OURS].median, timing, errors[peer.name], peer.remark))
    order = ("ours", "equal or better", "less accurate", "yardstick", "skipped")
    return sorted(rows, key=lambda row: (order.index(row.verdict), row.ratio or 0))


def _timing(seconds: np.ndarray, compile: float) -> Timing:
    low, median, high = np.quantile(seconds, [0.25, 0.5, 0.75])
    return Timing(float(median), float(low), float(high), compile, len(seconds))


def enough(peer: Peer, efforts: Sequence[float], word: str, problem: Any, ours: Mapping[str, float]) -> Peer:
    """A peer that iterates, at the first effort that makes it as accurate as we are; at the last one where none does.

    Args:
      peer: its `prepare` takes the problem and the effort.
      efforts: from the cheapest on.
      word: what efforts are counted in, for the name.
      problem: has `judge` and `blur`; a piece of the problem will do.
      ours: our errors on it.
    """
    if peer.missing:
        return peer
    for effort in efforts:
        if verdict(problem.judge(peer.prepare(problem, effort)()), ours, problem.blur) == "equal or better":
            break
    return replace(peer, name=f"{peer.name}, {effort:g} {word}", prepare=lambda problem: peer.prepare(problem, effort))


def best(rows: Sequence[Row]) -> Row | None:
    """The fastest peer of those that are as accurate as we are."""
    ranked = [row for row in rows if row.verdict == "equal or better"]
    return min(ranked, key=lambda row: row.ratio or np.inf, default=None)


def _too_much(work: Callable[[], Any], times: float, limit: float) -> str:
    """Why the whole is not tried, from runs of the piece; empty where it is."""
    with peak_memory() as memory:
        work()
    start = time.perf_counter()
    work()
    seconds, needed, held = (time.perf_counter() - start) * times, (memory[0] or 0) * times, _available_gib()
    if seconds > limit:
        return f"1/{times:g} of the problem says that a run takes {seconds:.0f} s, more than the {limit:.0f} s that it may"
    if needed > held:
        return f"1/{times:g} of the problem says that it needs {needed:.1f} GiB, more than the {held:.1f} GiB that are free"
    return ""


def _available_gib() -> float:
    """Memory that the system could still give; infinity where it does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return np.inf
