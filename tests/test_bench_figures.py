"""Figures of a sweep, the ticks of their axes and the words about their fronts."""

import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sweep import bent, examples

from ddprt.bench.frontier import pareto
from ddprt.bench.frontier.page import BASE, SEVERAL, Sweep, ticks
from ddprt.bench.frontier.pareto import COSTS, DRAWN
from ddprt.report import fronts


@pytest.fixture(scope="module")
def found() -> Sweep:
    return Sweep(examples())


# --- words and ticks --------------------------------------------------------------------------------------------------


def test_what_one_more_digit_costs_in_words() -> None:
    """100 times less error for 10 times the cost up to the knee, then 10 times less for 1000 times."""
    assert bent([(1, 0.5), (10, 0.005), (1e4, 0.0005)]).words("error", "bake") == [
        "From “as configured” (50.0\u00a0%, 1 s) to the knee, “fit.bases = 1” (0.50\u00a0%, 10 s): "
        "at this rate ten times less error costs 3.2 times as much.",
        "From the knee to “fit.bases = 2” (0.05\u00a0%, 1e+04 s): at this rate ten times less error costs 1,000 times as much.",
    ]


def test_flat_ends_are_said_to_be_flat() -> None:
    flat, knee = bent([(1, 0.5), (1000, 0.49)]).words("error", "bake")
    assert flat.endswith("would cost more than 10,000 times as much; the error hardly falls any more.")
    assert knee == "The front has no knee: fewer than three settings make it up."
    assert bent([(1, 1), (10, 0.1), (100, 0.01)]).words("error", "bake")[-1] == "The front has no knee: it hardly bends."
    assert Sweep([]).words("pu21", "bake") == ["No setting tells both PU21-PSNR and seconds to bake."]


def test_decibels_are_spoken_as_such(found: Sweep) -> None:
    assert any("20 dB more" in sentence for sentence in found.words("pu21", "bake"))
    assert not any("less error" in sentence for sentence in found.words("pu21", "bake"))


FORMS = ("percent", "decibel", "seconds", "bytes", "gib", "count")


@settings(deadline=None)
@given(st.sampled_from(FORMS), st.floats(-3, 3), st.floats(0.2, 12))
def test_ticks_are_few_rise_and_are_told_apart(form: str, start: float, decades: float) -> None:
    scale = {"bytes": 1e6, "count": 1e7}.get(form, 1.0)
    low, high = scale * 10**start, scale * 10 ** (start + decades)
    found = ticks(low, high, form)
    values, texts = [value for value, _ in found], [text for _, text in found]
    assert 2 <= len(found) <= 6
    assert values == sorted(set(values))
    assert len(set(texts)) == len(texts)
    # a decibel's place on the axis is computed back from its logarithm, which may round past the end
    assert low * (1 - 1e-12) <= values[0]
    assert values[-1] <= high * (1 + 1e-12)


def test_ticks_say_what_they_are() -> None:
    assert [text for _, text in ticks(0.9 * 2**18, 1.1 * 2**22, "bytes")] == ["256 KiB", "512 KiB", "1 MiB", "2 MiB", "4 MiB"]
    assert ticks(0.009, 0.11, "percent") == [(0.01, "1\u00a0%"), (0.03, "3\u00a0%"), (0.1, "10\u00a0%")]
    assert [text for _, text in ticks(0.001, 0.1, "decibel")] == ["60 dB", "50 dB", "40 dB", "30 dB", "20 dB"]
    assert [text for _, text in ticks(9e-6, 2e-2, "seconds")] == ["10 µs", "100 µs", "1 ms", "10 ms"]


# --- figures for papers -----------------------------------------------------------------------------------------------


def written(svg: str) -> list[str]:
    return ["".join(node.itertext()) for node in ElementTree.fromstring(svg).iter() if node.tag.endswith("}text")]


@pytest.mark.parametrize("cost", DRAWN)
def test_figures_are_a_column_wide_and_their_text_is_text(cost: str, found: Sweep) -> None:
    svg = found.figures[cost]
    texts, root = written(svg), ElementTree.fromstring(svg)
    assert root.get("width") == f"{3.4 * 72:g}pt"
    assert {COSTS[cost].title, "relative RMSE", BASE, SEVERAL} <= set(texts)
    assert "noise floor (0.40\u00a0%)" in texts
    assert any(text.startswith("projection floor") for text in texts)
    knee = pareto.knee(*found.pair("error", cost))
    assert any(text.startswith("knee") for text in texts) == (knee is not None)
    assert "#9aa2aa" in svg
    assert not re.search(r"<(image|script)|href=\"(?!#)", svg)


def test_fronts_are_drawn_as_steps_through_their_settings(found: Sweep) -> None:
    """Upright at the cost of each setting and where the axis ends; there it comes down to that setting's error."""
    for cost in DRAWN:
        (line,) = re.findall(
            r'<path d="([^"]*)"[^>]*stroke: #24292f; stroke-width: 0.9; stroke-linecap: square', found.figure(cost)
        )
        places = np.array([[float(number) for number in pair] for pair in re.findall(r"[ML] (\S+) (\S+)", line)])
        assert (np.diff(places, axis=0) == 0).any(1).all(), "every stretch is level or upright"
        assert (np.diff(places, axis=0) >= 0).all(), "to the right, and downwards on paper"
        costs, errors = found.pair("error", cost)
        logarithms = np.log([errors[index] for index in pareto.path(costs, errors)])
        across = np.unique(places[:, 0])[:-1]
        assert len(across) == len(logarithms)
        down = np.array([places[places[:, 0] == x, 1].max() for x in across])
        # six decimals are written, of points; the front spans more than 10 of them
        expected = (logarithms - logarithms[0]) / (logarithms[-1] - logarithms[0])
        np.testing.assert_allclose((down - down[0]) / (down[-1] - down[0]), expected, rtol=0, atol=4 * 0.5e-6 / 10)


def test_dollars_in_a_name_are_no_formula() -> None:
    sweep = bent([(1, 0.5), (10, 0.005), (1e4, 0.0005)])
    sweep.settings[1]["name"] = "$x_1$ = 2"
    assert "knee: $x_1$ = 2" in written(sweep.figure("bake"))


def test_axes_hold_the_bars() -> None:
    sweep = bent([(1, 0.5), (2, 0.4)])
    for record, low, high in zip(sweep.settings, (1e-9, 1e-5), (1e-3, 50.0), strict=True):
        record["frame"] |= {"low": low, "high": high}
    axis = sweep.axis(COSTS["frame"])
    assert axis.low < 1e-9
    assert axis.high > 50


def test_labels_lie_apart_and_inside(found: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    boxes: list[Any] = []
    placed = fronts._placed

    def watched(axes: Any, cloud: Any, index: int, text: str, frame: Any, taken: list[Any]) -> bool:
        before = len(taken)
        done = placed(axes, cloud, index, text, frame, taken)
        if done:
            box = taken[before]
            assert frame.x0 <= box.x0 < box.x1 <= frame.x1
            assert frame.y0 <= box.y0 < box.y1 <= frame.y1
            assert not any(box.overlaps(other) for other in taken[:before])
            boxes.append(box)
        return done

    monkeypatch.setattr(fronts, "_placed", watched)
    for cost in DRAWN:
        before = len(boxes)
        found.figure(cost)
        assert 3 <= len(boxes) - before <= fronts._LABELS
