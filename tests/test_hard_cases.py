"""The catalogue of hard cases: finite, within the bound, under a status that fits."""

import pytest
from hard_cases import CASES, HardCase, Outcome, passed
from oracles import over_bound

from ddprt.methods.statuses import STATUSES


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name, marks=[pytest.mark.slow] if case.slow else []) for case in CASES]
)
def test_hard_case(case: HardCase) -> None:
    outcome = case.run()
    assert outcome.finite, case.right
    assert outcome.status in case.statuses, case.right
    assert outcome.error_over_bound <= 1, case.right


def test_the_catalogue_is_whole() -> None:
    assert len(CASES) >= 60
    assert len({case.name for case in CASES}) == len(CASES)
    assert all(case.statuses <= {*STATUSES, "refused"} for case in CASES)
    assert all(
        text and text == text.strip() and "\n" not in text for case in CASES for text in (case.name, case.why, case.right)
    )


def test_a_case_can_fail() -> None:
    case = HardCase("a", "b", "c", lambda: Outcome(0))
    assert passed(case, case.run())
    for outcome in (Outcome(1.01), Outcome(float("nan")), Outcome(0, "no_signal"), Outcome(0, "ok", finite=False)):
        assert not passed(case, outcome)
    assert over_bound([1.0, float("nan")], 2.0) == over_bound(1.0, 0.0) == over_bound(float("inf"), 1.0) == float("inf")
    assert over_bound([0.0, 1.0], [0.0, 4.0]) == 0.25
