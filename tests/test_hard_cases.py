"""The catalogue of hard cases: finite, within the bound, under a status that fits."""

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from hard_cases import CASES, FILES, REFUSED, HardCase, Outcome, passed
from oracles import over_bound

import ddprt.fitting.transfer
import ddprt.methods.svd_ridge
from ddprt.fitting.transfer import Transfer
from ddprt.methods.statuses import STATUSES

OF_ARRAYS = tuple(case for file in FILES[: FILES.index("hard_bounces")] for case in import_module(file).CASES)
OF_TRANSFER = tuple(
    case
    for file in ("hard_degenerate", "hard_magnitudes", "hard_basis", "hard_transfer", "hard_splits")
    for case in import_module(file).CASES
)
_NOTHING = "nothing was measured, nothing bounces, or nothing differs from the mean: the right matrix is 0"
_REFUSED = "refused before anything is solved"
_ALONE = "asks for leave-one-out errors, which are not made of the matrix"
_BASIS = "asks for the basis alone"
_TWICE = "compares two answers of one transfer"
NO_MATTER = {  # cases of the above that hold whatever the transfer matrix is
    "all lightings dark": _NOTHING,
    "all lightings equal, mean": _NOTHING,
    "lightings 1e-7 apart, mean": _NOTHING,
    "nothing bounces": _NOTHING,
    "one lighting, mean": _NOTHING,
    "subnormal intensities": _NOTHING,
    "ridge 1e300": "the right matrix is below every float32",
    "all areas 0": _REFUSED,
    "energy clamp over areas of 4.25353e+37": _TWICE,
    "energy clamp over areas of 9.18355e-41": _TWICE,
    "ridge infinite": _REFUSED,
    "ridge NaN": _REFUSED,
    "ridge negative": _REFUSED,
    "ridge per point, one NaN": _REFUSED,
    "ridge per point, one infinite": _REFUSED,
    "ridge per point, all 1e-300": _REFUSED,
    "ridge per point, all the smallest number": _REFUSED,
    "ridge per point, from 1e-300 to 1e3": _REFUSED,
    "leave-one-out": _ALONE,
    "leave-one-out, intercept": _ALONE,
    "leave-one-out, importance over twelve decades": _ALONE,
    "leave-one-out, fewer lightings than points": _ALONE,
    "ends of the ridge path": _ALONE,
    "leading subspaces over six decades": _BASIS,
    "signs and order of columns": _BASIS,
}


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


def _survivors(patch: pytest.MonkeyPatch, factor: float, *, slow: bool) -> set[str]:
    """Names of the cases that pass with every transfer matrix times a factor."""
    right = ddprt.fitting.transfer.solve_transfer

    def wrong(*parts: Any, **named: Any) -> Transfer:
        fit = right(*parts, **named)
        return replace(fit, matrix=fit.matrix * np.float32(factor))

    patch.setattr(ddprt.fitting.transfer, "solve_transfer", wrong)
    patch.setattr(ddprt.methods.svd_ridge, "solve_transfer", wrong)
    survivors = set()
    for case in OF_TRANSFER:
        if case.slow == slow and passed(case, case.run()):
            survivors.add(case.name)
    return survivors


@pytest.mark.parametrize("slow", [pytest.param(False, id="fast"), pytest.param(True, marks=pytest.mark.slow, id="slow")])
@pytest.mark.parametrize("factor", [pytest.param(0.0, marks=pytest.mark.slow), 1.01])
def test_a_wrong_matrix_fails_nearly_all(monkeypatch: pytest.MonkeyPatch, factor: float, slow: bool) -> None:
    """A package whose transfer is nothing, or off by a hundredth, holds in no case but those that say why."""
    expected = {case.name for case in OF_TRANSFER if case.slow == slow} & set(NO_MATTER)
    assert _survivors(monkeypatch, factor, slow=slow) == expected


def test_refusing_everything_fails_all_but_refusals() -> None:
    """A refusal is right where nothing else is, or where the case is named here."""
    either: dict[str, str] = {}
    for case in CASES:
        assert "refused" not in case.statuses or case.statuses == REFUSED or case.name in either, case.name
    assert sum(case.statuses == REFUSED for case in OF_ARRAYS) < len(OF_ARRAYS) / 4


def test_cases_of_arrays_know_their_status() -> None:
    """One status, or two where rounding or chance decides between them."""
    for case in OF_ARRAYS:
        assert 1 <= len(case.statuses) <= 2, case.name
