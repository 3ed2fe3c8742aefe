"""What a fit says of itself from its validation lightings, and an evaluation from the held-out ones."""

import numpy as np
import pytest
import suns
from hard_arrays import TEST, TRAIN, VALIDATION, make_data, room

from ddprt.dataset.store import average_into_points
from ddprt.report.evaluate import evaluate
from ddprt.sampling.points import Samples

HELD_BACK = slice(TRAIN, TRAIN + VALIDATION)
METHOD = pytest.mark.parametrize("method", suns.ALL_METHODS)


def status(measured: np.ndarray, indirect: np.ndarray, method: str = "svd-ridge") -> str:
    return suns.fit(make_data(measured, indirect), method, bases=6).relighter.report.status


@METHOD
def test_validation_lightings_that_no_point_sees_are_said(method: str) -> None:
    measured, indirect = room()
    assert status(measured, indirect, method) != "blind"
    measured[HELD_BACK] = 0
    report = suns.fit(make_data(measured, indirect), method, bases=6).relighter.report
    assert "blind" in report.remarks


@METHOD
def test_held_out_lightings_that_no_point_sees_are_said(method: str) -> None:
    measured, indirect = room()
    measured[-TEST:] = 0
    data = make_data(measured, indirect)
    scores = evaluate(suns.under_suns(data), {method: suns.bare(suns.fit(data, method, bases=6))}, {}).metrics["methods"][
        method
    ]
    assert "blind" in scores["remarks"]
    assert scores["status"] != "ok"


@METHOD
@pytest.mark.parametrize(
    "factor", [1e-25, pytest.param(1e-3, marks=pytest.mark.slow), pytest.param(1e3, marks=pytest.mark.slow), 1e25]
)
def test_validation_in_other_units_than_training_is_not_ok(method: str, factor: float) -> None:
    measured, indirect = room()
    measured[HELD_BACK] *= np.float32(factor)
    model = suns.fit(make_data(measured, indirect), method, bases=6)
    assert "worse_than_mean" in model.relighter.report.remarks
    found = model.trust(measured[HELD_BACK])
    assert found is not None
    assert (found.score < 0.05).all(), "an error as large as the light itself, or larger"


def test_rounding_is_no_worse_than_the_mean() -> None:
    """All lightings equal: the mean lightmap is right to the last bit, the baseline but for rounding."""
    measured, indirect = room()
    measured[:], indirect[:] = measured[0], indirect[0]
    assert status(measured, indirect) == "rank_deficient"


def test_a_mean_of_lights_near_the_end_of_float32_is_finite() -> None:
    rng = np.random.default_rng(0)
    places, up = rng.random((24, 3)), np.tile([0.0, 1.0, 0.0], (24, 1))
    samples = Samples(places, up, np.ones((24, 3)), 0.1)
    light = np.full((2, 24, 3), 3e38, np.float32)
    found = average_into_points(light, samples, 3, "irradiance")
    # Each of up to 24 shares and their sum are rounded once.
    np.testing.assert_allclose(found, 3e38, rtol=25 * np.finfo(np.float32).eps)
