"""Fronts against a slow oracle, knees of curves drawn by hand, slopes in closed form, and a table that reads back exactly."""

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_sweep import example, examples, failure

from ddprt.bench.frontier.pareto import COSTS, DRAWN, ERRORS, Measure, flat, front, knee, latest, path, slopes, write_csv
from ddprt.errors import UserError

EPS = float(np.finfo(np.float64).eps)
COARSE = st.integers(-3, 3).map(float)  # few values, so that ties are common
NUMBERS = st.one_of(COARSE, st.floats(allow_nan=True, allow_infinity=True), st.none())
PLACES = st.lists(st.tuples(NUMBERS, NUMBERS), max_size=24)


def columns(places: list[tuple[Any, Any]]) -> tuple[list[Any], list[Any]]:
    return [cost for cost, _ in places], [error for _, error in places]


def slow_front(places: list[tuple[Any, Any]]) -> list[bool]:
    """By the definition, every pair looked at."""
    known = [cost is not None and error is not None and math.isfinite(cost) and math.isfinite(error) for cost, error in places]

    def beats(one: int, other: int) -> bool:
        (a, b), (c, d) = places[one], places[other]
        return a <= c and b <= d and (a < c or b < d)

    everyone = range(len(places))
    return [known[i] and not any(known[j] and beats(j, i) for j in everyone) for i in everyone]


# --- fronts -----------------------------------------------------------------------------------------------------------


@given(PLACES)
def test_front_is_what_the_definition_says(places: list[tuple[Any, Any]]) -> None:
    assert front(*columns(places)).tolist() == slow_front(places)


@given(PLACES, st.randoms(use_true_random=False))
def test_front_does_not_ask_for_an_order(places: list[tuple[Any, Any]], random: Any) -> None:
    order = list(range(len(places)))
    random.shuffle(order)
    mask = front(*columns(places))
    assert front(*columns([places[i] for i in order])).tolist() == [bool(mask[i]) for i in order]


def test_equal_settings_stay_together() -> None:
    assert front([1, 1, 2, 2, 2], [5, 5, 3, 3, 4]).tolist() == [True, True, True, True, False]
    assert front([0.0, -0.0], [1, 1]).tolist() == [True, True]


def test_what_has_no_number_is_never_on_the_front() -> None:
    assert front([None, np.nan, np.inf, -np.inf, 1], [0, 0, 0, 0, 9]).tolist() == [False] * 4 + [True]
    assert front([1, 2], [None, np.nan]).tolist() == [False, False]
    assert front([], []).tolist() == []


def test_columns_must_be_of_one_length() -> None:
    with pytest.raises(ValueError, match="got 2 costs and 1 errors"):
        front([1, 2], [1])


def test_path_goes_from_cheap_to_exact_and_leaves_out_zeros_and_twins() -> None:
    costs, errors = [9, 4, 4, 1, 0, 16], [1, 2, 2, 5, 7, 0]
    assert front(costs, errors).all()
    assert path(costs, errors) == [3, 1, 0]


# --- knees ------------------------------------------------------------------------------------------------------------


def test_knee_of_a_corner() -> None:
    costs, errors = [1, 2, 4, 100, 1000], [1.0, 0.5, 0.01, 0.008, 0.005]
    assert knee(costs, errors) == 2


def test_knee_by_hand() -> None:
    """Logarithms 0, 1, 2, 4 and 0, -1, -3, -4 over 4: depths 1 - x - y are 0, 0, 1/4, 0 of the square."""
    assert knee([1, 10, 100, 1e4], [1, 1e-1, 1e-3, 1e-4]) == 2
    assert knee([1e4, 100, 10, 1], [1e-4, 1e-3, 1e-1, 1]) == 1, "the order of the settings does not matter"


def test_straight_and_bulging_fronts_have_no_knee() -> None:
    powers = np.arange(6.0)
    assert knee(10**powers, 10**-powers) is None
    assert knee(10**powers, 10 ** -(powers**1.5)) is None


def test_a_bend_of_less_than_a_twentieth_is_no_knee() -> None:
    """The middle of three at (1/2, 1/2 - depth) of the square."""
    bend = lambda depth: knee([1, 10, 100], [1, 10 ** -(1 + 2 * depth), 1e-2])  # noqa: E731
    assert bend(0.049) is None
    assert bend(0.051) == 1


@pytest.mark.parametrize("places", [[], [(1, 1)], [(1, 2), (2, 1)], [(1, 2), (1, 2), (2, 1)], [(0, 3), (1, 2), (2, 1)]])
def test_fewer_than_three_places_have_no_knee(places: list[tuple[float, float]]) -> None:
    assert knee(*columns(places)) is None


def test_dominated_settings_do_not_move_the_knee() -> None:
    costs, errors = [1, 10, 100, 1e4], [1, 1e-1, 1e-3, 1e-4]
    assert knee([*costs, 1e-9, 1e9, 50], [*errors, None, 5.0, 0.5]) == 2


@given(st.floats(1e-6, 1e6), st.floats(0.2, 4), st.floats(1e-6, 1e6), st.floats(0.2, 4))
def test_knee_does_not_ask_for_units(cost: float, stretch: float, error: float, squeeze: float) -> None:
    costs, errors = np.array([1, 3, 9, 81, 700]), np.array([1, 0.3, 0.02, 0.011, 0.01])
    assert knee(cost * costs**stretch, error * errors**squeeze) == knee(costs, errors) == 2


# --- slopes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [0.25, 1.0, 2.0, 7.0])
def test_slope_of_a_power_law(power: float) -> None:
    errors = np.array([1.0, 1e-1, 1e-2, 1e-3])
    legs = slopes(3 * errors**-power, errors)
    assert [(leg.start, leg.end) for leg in legs] == [(0, 1), (1, 2), (2, 3)]
    # logarithms up to 22 are right to half a unit in the last place, as are the costs: 4 roundings of 22 eps over a step of 1
    tolerance = 4 * 22 * EPS
    np.testing.assert_allclose([leg.slope for leg in legs], power, rtol=0, atol=tolerance)
    # 10^p magnifies an error of p by ln 10 < 3
    np.testing.assert_allclose([leg.factor for leg in legs], 10**power, rtol=3 * tolerance)


def test_one_more_digit_by_hand() -> None:
    """From an error of 8 % to 2 % (a quarter) at 16 times the cost: a tenth costs 10^2 times as much."""
    (leg,) = slopes([1, 5, 16], [0.08, 0.07, 0.02], at=[0, 2])
    assert leg.slope == pytest.approx(2, abs=16 * EPS)  # logarithms below 2 over a difference of 0.6
    assert (leg.start, leg.end) == (0, 2)


def test_a_steep_slope_has_an_infinite_factor() -> None:
    (leg,) = slopes([1, 1e9], [1, 1 - 1e-9])
    assert leg.factor == math.inf


# --- measures ---------------------------------------------------------------------------------------------------------


def test_measures_find_their_numbers() -> None:
    record = example({}, 0)
    assert COSTS["bake"].of(record) == record["bake"]["seconds"]
    assert COSTS["batch"].of(record) == record["batch"]["median"] / 16
    assert COSTS["frame"].spread(record) == (record["frame"]["low"], record["frame"]["high"])
    assert COSTS["batch"].spread(record) == (record["batch"]["low"] / 16, record["batch"]["high"] / 16)
    assert COSTS["bake"].spread(record) is None
    assert COSTS["fit-memory"].spread(record) is None, "quartiles of seconds are none of memory"
    assert COSTS["bytes"].spread(record) is None


def test_decibels_become_an_error_that_falls() -> None:
    """20 dB are a factor of ten: 40 dB an amplitude of 1/100."""
    record = {"scores": {"pu21_psnr_db": 40.0}}
    assert ERRORS["pu21"].of(record) == 40
    assert ERRORS["pu21"].falling(record) == pytest.approx(0.01, rel=4 * EPS)


@pytest.mark.parametrize("value", [None, True, "7", math.nan, math.inf, {"median": 1}])
def test_what_is_no_number_is_none(value: Any) -> None:
    assert Measure("a.b", "", "count").of({"a": {"b": value}}) is None
    assert Measure("a.b", "", "count").of({"a": value}) is None


def test_of_one_setting_the_last_record_counts_in_the_first_place() -> None:
    first, second = example({}, 1), example({}, 2)
    again = {**first, "bytes": 7}
    assert [record["bytes"] for record in latest([first, second, again])] == [7, second["bytes"]]


# --- the table --------------------------------------------------------------------------------------------------------


def leaves(value: Any, place: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {place: value}
    return {name: leaf for key, entry in value.items() for name, leaf in leaves(entry, f"{place}.{key}".lstrip(".")).items()}


def test_table_reads_back_to_the_last_bit(tmp_path: Path) -> None:
    why = 'got "a, b"\nand = more; lower it'
    records = [*examples(), failure(901, name='x = "1, 2"', why=why)]
    with write_csv(records, tmp_path / "frontier.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(records)
    for row, record in zip(rows, records, strict=True):
        held = {key: value for key, value in leaves(record).items() if key != "config"}
        for key, value in held.items():
            told = row[key]
            if isinstance(value, bool | list):
                continue
            assert told == value if isinstance(value, str) else told == "" if value is None else float(told) == value, key
        numbers = {key for key, value in row.items() if value and not key.startswith("front.")}
        assert numbers <= {key for key, value in held.items() if value is not None}
    assert rows[-1]["failed"] == why
    assert rows[-1]["front.bake"] == ""
    assert "config" not in rows[0]


def test_table_tells_the_fronts(tmp_path: Path) -> None:
    records = [record for record in examples() if not record["failed"]]
    with write_csv(records, tmp_path / "frontier.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for cost in DRAWN:
        places = [(COSTS[cost].of(record), record["scores"]["relative_rmse"]) for record in records]
        assert [row[f"front.{cost}"] for row in rows] == ["true" if on else "false" for on in slow_front(places)]
        assert 1 < sum(slow_front(places)) < len(records)


def test_table_says_where_it_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file"):
        write_csv(examples(), tmp_path / "file" / "frontier.csv")


def test_lists_are_kept_as_json() -> None:
    assert flat({"remarks": ["a", "b"], "on": True, "none": None, "empty": {}}) == {
        "remarks": '["a", "b"]',
        "on": "true",
        "none": "",
    }
