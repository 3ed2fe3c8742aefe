"""Who stands where: accuracy before time, turns that alternate, and who is left out untried."""

import time
from collections.abc import Callable
from itertools import groupby
from typing import Any

import numpy as np
import pytest

from ddprt.bench.measure.timing import Timing
from ddprt.bench.peers import standing
from ddprt.bench.peers.standing import OURS, Peer, best, compare, in_turn, verdict

TORCHLESS = {"needs": "no_such_library"}


class Number:
    """A problem whose answer is 1 and whose errors are blurred by 0.01."""

    def __init__(self, hardness: float = 0.0) -> None:
        self.hardness = hardness

    @property
    def blur(self) -> dict[str, float]:
        return {"off": 0.01}

    def judge(self, result: Any, /) -> dict[str, float]:
        return {"off": abs(result - 1)}


def says(answer: float) -> Callable[..., Callable[[], float]]:
    return lambda problem, effort=None: lambda: answer


@pytest.mark.parametrize(
    ("error", "ours", "blur", "expected"),
    [
        (1e-3, 1e-3, 0.0, "equal or better"),
        (1.01e-3, 1e-3, 0.0, "less accurate"),
        (1e-3, 1e-9, 2e-3, "equal or better"),
        (1e-3, 1e-9, 5e-4, "less accurate"),
        (float("nan"), 1.0, 1.0, "less accurate"),
    ],
)
def test_verdict_is_by_error_alone(error: float, ours: float, blur: float, expected: str) -> None:
    others = {"angle": 0.0}
    assert verdict({"off": error} | others, {"off": ours} | others, {"off": blur} | others) == expected


def test_the_less_accurate_are_timed_but_not_ranked(monkeypatch: pytest.MonkeyPatch) -> None:
    took = {
        "slow and right": [20.0],
        "quick and wrong": [1.0],
        "a yardstick": [7.0],
        OURS: [5.0],
        "right within rounding": [10.0],
    }
    monkeypatch.setattr(standing, "in_turn", lambda works, repeats: {name: took[name] for name in works})
    crew = [
        Peer("slow and right", says(1.0)),
        Peer("quick and wrong", says(1.5)),
        Peer("a yardstick", says(7.0), yardstick=True),
        Peer("lacking", says(1.0), **TORCHLESS),
        Peer(OURS, says(1.001)),
        Peer("right within rounding", says(1.009)),
    ]
    rows = compare(crew, Number(), repeats=3)
    assert [row.name for row in rows] == [
        OURS,
        "right within rounding",
        "slow and right",
        "quick and wrong",
        "a yardstick",
        "lacking",
    ]
    found = {row.name: row for row in rows}
    assert found["quick and wrong"].verdict == "less accurate"
    assert found["quick and wrong"].errors == {"off": 0.5}
    assert found["quick and wrong"].ratio == 0.2
    assert found["lacking"].verdict == "skipped"
    assert "no_such_library is not installed" in found["lacking"].reason
    assert "pip install no_such_library" in found["lacking"].reason
    first = best(rows)
    assert first is not None
    assert first.name == "right within rounding"
    assert best([row for row in rows if row.verdict != "equal or better"]) is None


def test_ratios_are_of_medians_and_seconds_of_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    took = {OURS: [1.0, 9.0, 2.0], "other": [8.0, 1.0, 8.0]}
    monkeypatch.setattr(standing, "in_turn", lambda works, repeats: took)
    rows = {row.name: row for row in compare([Peer(OURS, says(1.0)), Peer("other", says(1.0))], Number(), repeats=3, frames=4)}
    assert (rows[OURS].ratio, rows["other"].ratio) == (1, 4)
    # Quartiles of three are halfway to the median.
    assert rows[OURS].seconds == Timing(2 / 4, 1.5 / 4, 5.5 / 4, rows[OURS].seconds.compile, 3)  # type: ignore[union-attr]
    assert rows["other"].seconds.median == 8 / 4  # type: ignore[union-attr]


def test_turns_alternate() -> None:
    order: list[str] = []
    seconds = in_turn({name: lambda name=name: order.append(name) for name in "abc"}, 3)
    assert [name for name, _ in groupby(order)] == [*"abcabcabc"]
    assert {name: len(found) for name, found in seconds.items()} == {"a": 3, "b": 3, "c": 3}


def test_what_is_short_is_warm_before_it_is_timed_and_what_is_long_runs_once() -> None:
    calls: list[float] = []

    def work(pause: float) -> None:
        calls.append(pause)
        time.sleep(pause if len(calls) % 5 else 0)  # every fifth call of the short one is the quick one

    short = in_turn({"short": lambda: work(0.02)}, 2)["short"]
    assert len(calls) == 10
    assert max(short) < 0.02, "the calls before it do not count"
    calls.clear()
    (slow,) = in_turn({"long": lambda: work(0.1)}, 1)["long"]
    assert len(calls) == 1
    assert slow >= 0.1


@pytest.mark.parametrize(
    ("answers", "whole_from", "name", "standing"),
    [
        ((1.5, 1.0, 1.0), 0, "p, 4 turns", "equal or better"),
        ((1.5, 1.0, 1.0), 8, "p, 8 turns", "equal or better"),
        ((3.0, 2.0, 1.5), 0, "p, 8 turns", "less accurate"),
    ],
)
def test_who_iterates_gets_as_many_turns_as_accuracy_takes(
    answers: tuple[float, ...], whole_from: float, name: str, standing: str
) -> None:
    efforts = (2.0, 4.0, 8.0)

    def prepare(problem: Number, effort: float) -> Callable[[], float]:
        # On the whole, all below `whole_from` are wrong, though the piece did not tell.
        return lambda: 9.0 if effort < problem.hardness else answers[efforts.index(effort)]

    crew = [Peer("p", prepare, efforts=efforts, unit="turns"), Peer(OURS, says(1.0))]
    rows = compare(crew, Number(whole_from), repeats=1, piece=Number())
    assert (rows[1].name, rows[1].verdict) == (name, standing)


def test_who_would_take_too_long_or_too_much_is_left_out_untried(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, piece, ran = Number(), Number(), []

    def slow(problem: Number) -> Callable[[], float]:
        return lambda: ran.append(problem) or time.sleep(0.02) or 1.0

    def wide(problem: Number) -> Callable[[], float]:
        return lambda: ran.append(problem) or float(np.ones(1 << 23).max())  # 64 MiB

    crew = [Peer(OURS, says(1.0)), Peer("slow", slow)]
    rows = compare(crew, whole, repeats=1, piece=piece, times=1000, limit=5)
    assert rows[1].verdict == "skipped"
    assert "more than the 5 s" in rows[1].reason
    monkeypatch.setattr(standing, "_available_gib", lambda: 0.5)
    rows = compare([Peer(OURS, says(1.0)), Peer("wide", wide)], whole, repeats=1, piece=piece, times=10)
    assert rows[1].verdict == "skipped"
    assert "more than the 0.5 GiB" in rows[1].reason
    assert whole not in ran
    assert compare([Peer(OURS, says(1.0)), Peer("wide", wide)], whole, repeats=1, piece=piece, times=2)[1].ratio is not None
