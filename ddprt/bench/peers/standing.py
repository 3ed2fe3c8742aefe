"""Who stands where: equal accuracy first, then time.

Where there is a small piece of the problem, it tells who would take too long or too much memory on the whole, and leaves them
out with that as the reason. The others are run once and judged; then they take turns, so that whatever else the machine does
hits them alike.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np

from ddprt.bench.measure.timing import Timing, compiling, peak_memory

OURS = "ddprt"
_PIP = {"sklearn": "scikit-learn"}  # packages that pip calls otherwise
_REST = 0.1  # seconds; OpenBLAS's threads spin for some 30 ms
_SHORT = 0.05  # seconds
_WARM = 4  # calls before one that is timed
_PATIENCE = 60.0  # seconds after which no further turn begins

Verdict = Literal["ours", "equal or better", "less accurate", "yardstick", "skipped"]


@runtime_checkable
class Problem(Protocol):
    """What peers solve."""

    @property
    def blur(self) -> dict[str, float]:
        """What rounding alone does to each error; differences below it tell nothing."""
        ...

    def judge(self, result: Any, /) -> dict[str, float]:
        """Errors of a result, the smaller the better."""
        ...


@dataclass(frozen=True)
class Peer:
    """Another way to the same result.

    Attributes:
      name: as its users call it.
      prepare: takes the problem, leaves the work to be timed; conversions of the input happen here, at no charge.
      needs: module that must be installed.
      remark: what it does more or less than we do.
      yardstick: timed and shown, but not a way to the result.
      efforts: what `prepare` takes beside the problem, from the cheapest on; the first is taken that is accurate enough.
      unit: of the efforts, for the name.
    """

    name: str
    prepare: Callable[..., Callable[[], Any]]
    needs: str = ""
    remark: str = ""
    yardstick: bool = False
    efforts: tuple[float | int, ...] = ()
    unit: str = ""

    def at(self, effort: float | int | None) -> "Peer":
        """The same with this effort settled; None for one that takes none."""
        if effort is None:
            return self
        return replace(self, name=f"{self.name}, {effort:g} {self.unit}", prepare=lambda problem: self.prepare(problem, effort))

    @property
    def missing(self) -> str:
        """Why it cannot run here; empty where it can."""
        if not self.needs:
            return ""
        try:
            import_module(self.needs)
        except ImportError as error:
            return f"{self.needs} is not installed ({error}); pip install {_PIP.get(self.needs, self.needs)}"
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

    Threads of BLAS go on spinning for a while when they have nothing to do, which is at the cost of whoever comes next: so each
    turn begins with a rest. Memory that the one before gave back comes with page faults, some milliseconds for a lightmap: so
    what is short is called a few times before it is timed, as frame follows frame.

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
            time.sleep(_REST)
            for _ in range(_WARM):
                start = time.perf_counter()
                jax.block_until_ready(work())
                if time.perf_counter() - start > _SHORT:
                    break
            else:
                start = time.perf_counter()
                jax.block_until_ready(work())
            seconds[name].append(time.perf_counter() - start)
    return seconds


def compare(
    peers: Sequence[Peer],
    whole: Problem,
    *,
    repeats: int,
    frames: int = 1,
    piece: Problem | None = None,
    times: float | int = 1,
    limit: float | int = np.inf,
    tell: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Rows of a comparison: ours first, then the accurate ones by time, the less accurate ones, yardsticks, those skipped.

    Args:
      peers: `OURS` among them.
      whole: the problem.
      repeats: turns.
      frames: how many problems a work solves; seconds are of one.
      piece: a smaller problem to try everyone on first; None tries nobody.
      times: how much more work `whole` is than `piece`.
      limit: seconds that a run of `whole` may be expected to take.
      tell: called once for each peer.
    """
    works: dict[str, Callable[[], Any]] = {}
    rows: dict[str, Row] = {}
    spent: dict[str, float] = {}
    ours: dict[str, float] = {}
    small: dict[str, float] = {}
    for peer in sorted(peers, key=lambda peer: peer.name != OURS):
        tell()
        if peer.missing:
            rows[peer.name] = Row(peer.name, "skipped", reason=peer.missing)
            continue
        for effort in _worth_trying(peer, piece, small):
            tried = peer.at(effort)
            reason = "" if piece is None or peer.name == OURS else _too_much(tried.prepare(piece), times, limit)
            if reason:
                rows[peer.name] = rows.get(peer.name) or Row(tried.name, "skipped", reason=reason)
                break
            work = tried.prepare(whole)
            with compiling() as found:
                result = jax.block_until_ready(work())
            errors = {} if peer.yardstick else whole.judge(result)
            del result  # it may be gigabytes
            if peer.name == OURS:
                ours, small = errors, piece.judge(peer.prepare(piece)()) if piece is not None else {}
            fixed: Verdict | None = "ours" if peer.name == OURS else "yardstick" if peer.yardstick else None
            mark = fixed or verdict(errors, ours, whole.blur)
            works[peer.name], spent[peer.name] = work, found[0]
            rows[peer.name] = Row(tried.name, mark, errors=errors, reason=peer.remark)
            if mark != "less accurate":
                break
    timings = {name: _timing(found, spent[name]).each(frames) for name, found in in_turn(works, repeats).items()}
    for name, timing in timings.items():
        rows[name] = replace(rows[name], seconds=timing, ratio=timing.median / timings[OURS].median)
    order = ("ours", "equal or better", "less accurate", "yardstick", "skipped")
    return sorted(rows.values(), key=lambda row: (order.index(row.verdict), row.ratio or 0))


def _worth_trying(peer: Peer, piece: Problem | None, ours: Mapping[str, float]) -> Sequence[float | int | None]:
    """Efforts from the first that does on the piece, the last one at least; a single None for a peer that takes none."""
    if not peer.efforts or piece is None:
        return peer.efforts or (None,)
    for index, effort in enumerate(peer.efforts):
        if verdict(piece.judge(peer.at(effort).prepare(piece)()), ours, piece.blur) == "equal or better":
            return peer.efforts[index:]
    return peer.efforts[-1:]


def _timing(seconds: list[float], compile: float) -> Timing:
    low, median, high = np.quantile(seconds, [0.25, 0.5, 0.75])
    return Timing(float(median), float(low), float(high), compile, len(seconds))


def best(rows: Sequence[Row]) -> Row | None:
    """The fastest peer of those that are as accurate as we are."""
    ranked = [row for row in rows if row.verdict == "equal or better"]
    return min(ranked, key=lambda row: row.ratio or np.inf, default=None)


def _too_much(work: Callable[[], Any], times: float | int, limit: float | int) -> str:
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
