"""What a sweep becomes: numbers on a page and in files, escaped, and the same every time."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sweep import example, examples, failure

from ddprt.bench.frontier import pareto
from ddprt.bench.frontier.page import BASE, SEVERAL, Sweep, embedded, write_all, write_page
from ddprt.bench.frontier.pareto import COSTS, DRAWN, ERRORS


class Outline(HTMLParser):
    """Complains about elements that are not closed in order, and collects what a page points at."""

    VOID = ("meta", "img", "br", "hr", "input", "link")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.targets: list[str] = []
        self.ids: list[str] = []
        self.scripts: list[str] = []
        self.texts: list[str] = []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.targets += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "srcset")]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        (self.scripts if self.open and self.open[-1] == "script" else self.texts).append(data)


def data_of(page: str) -> dict[str, Any]:
    return json.loads(Outline(page).scripts[0])


def text_of(page: str) -> str:
    return " ".join(" ".join(Outline(page).texts).split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    write_all(folder, examples(), title="cornell")
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return (folder / "frontier.html").read_text("utf-8")


@pytest.fixture(scope="module")
def found() -> Sweep:
    return Sweep(examples())


# --- files ------------------------------------------------------------------------------------------------------------


def test_all_files_are_named_and_the_same_every_time(folder: Path, found: Sweep, tmp_path: Path) -> None:
    made = write_all(tmp_path / "new", examples(), title="cornell")
    names = ["frontier.html", "frontier.csv", *(f"error-{cost}.svg" for cost in ("bake", "fit", "frame", "bytes"))]
    assert [path.name for path in made] == names
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(names)
    for path in made:
        assert path.read_bytes() == (folder / path.name).read_bytes(), path.name
    for cost, figure in found.figures.items():
        assert (folder / f"error-{cost}.svg").read_text("utf-8") == figure


def test_of_a_setting_measured_twice_the_last_counts(tmp_path: Path) -> None:
    records = [example({}, 0), example({"fit.bases": 4}, 1)]
    stale = {**records[0], "scores": {**records[0]["scores"], "relative_rmse": 1e-6}}
    one, two = (
        write_page(tmp_path / "page.html", given, title="").read_text("utf-8") for given in (records, [stale, *records])
    )
    assert one == two


# --- the page ---------------------------------------------------------------------------------------------------------


def test_page_is_whole_and_needs_nothing_else(page: str) -> None:
    outline = Outline(page)
    assert len(outline.ids) == len(set(outline.ids))
    assert {"result", "fronts", "settings", "failed", "definitions", "machine"} <= set(outline.ids)
    for target in outline.targets:
        assert target.startswith("data:image/svg+xml;base64,") or target.removeprefix("#") in outline.ids, target[:60]
    outside = re.findall(r"(?:https?:)?//[a-z][^\s\"'`]*", re.sub(r"base64,[\w+/=]+", "", page))
    assert set(outside) <= {"http://www.w3.org/2000/svg"}, "the name of a format, not an address"
    assert len(outline.scripts) == 2


def test_every_setting_has_its_row(page: str) -> None:
    text, outline = text_of(page), Outline(page)
    for record in examples():
        assert record["digest"] in outline.ids
        assert record["name"] in text
        assert record["failed"] is None or record["failed"] in text
        if not record["failed"]:
            assert repr(record["scores"]["relative_rmse"]) in text
            assert " ".join(record["config"].split()) in text
    for word in ("Example CPU", "2.3.5", "9b11239", "2026-11-22T11:00:00+00:00", "800 ms", "the scene has no camera"):
        assert word in text


def test_rows_go_from_exact_to_coarse_and_name_their_fronts(found: Sweep) -> None:
    rows = found.rows()
    errors = [row["record"]["scores"]["relative_rmse"] for row in rows]
    assert errors == sorted(errors)
    for cost in DRAWN:
        on = [
            record["digest"]
            for record, best in zip(found.settings, pareto.front(*found.pair("error", cost)), strict=True)
            if best
        ]
        assert sorted(row["record"]["digest"] for row in rows if cost in row["on"]) == sorted(on)
    assert [row["record"]["name"] for row in rows if row["base"]] == [BASE]


def test_a_front_is_told_as_what_no_setting_beats(page: str, found: Sweep) -> None:
    """Not as what none errs less than: that is the most exact setting alone, and fronts have others."""
    assert any(row["on"] for row in found.rows()[1:])
    assert "no other one beats it there" in page
    assert not re.search("no other (setting|one) errs less", page)


def test_data_holds_every_pair_and_lies_within_its_axes(page: str, found: Sweep) -> None:
    data = data_of(page)
    assert [axis["key"] for axis in data["errors"]] == list(ERRORS)
    assert [axis["key"] for axis in data["costs"]] == list(COSTS)
    assert set(data["pairs"]) == {f"{error}/{cost}" for error in ERRORS for cost in COSTS}
    for name, pair in data["pairs"].items():
        costs, errors = found.pair(*name.split("/"))
        assert pair["path"] == pareto.path(costs, errors)
        assert pair["front"] == np.flatnonzero(pareto.front(costs, errors)).tolist()
        assert pair["knee"] == pareto.knee(costs, errors)
        assert pair["words"]
    for record, setting in zip(found.settings, data["settings"], strict=True):
        assert (setting["digest"], setting["name"], setting["knobs"]) == (
            record["digest"],
            record["name"],
            list(record["changes"]),
        )
        for axes, values in ((data["errors"], setting["errors"]), (data["costs"], setting["costs"])):
            for axis, value in zip(axes, values, strict=True):
                for number in [value[0], *value[2:]] if value else []:
                    assert number == 0 or axis["low"] < number < axis["high"]
    error = data["errors"][0]
    assert [level for _, level in data["floors"]] == [0.004, found.base["floors"]["projection_relative_rmse"]]
    assert all(error["low"] < level < error["high"] for _, level in data["floors"])
    assert data["settings"][data["base"]]["name"] == BASE


def test_kinds_are_the_knob_the_base_or_several(found: Sweep) -> None:
    kinds = {record["name"]: found.kind(record) for record in found.settings}
    assert kinds[BASE] == BASE
    assert kinds["fit.bases = 4"] == "fit.bases"
    assert kinds["fit.bases = 64, lightings.train = 256"] == SEVERAL
    looks = list(found.markers().values())
    assert len({json.dumps(outline) for _, outline in looks}) == len(looks), "grey ones differ by outline alone"


WICKED = ("</script><script>alert(1)</script>", "<!-- <script>", "a & b < c > d", "\"'`${x}", "$x_1$ % \\", "\u2028\u2029é漢")


@pytest.mark.parametrize("name", WICKED)
def test_names_are_text_and_nothing_else(name: str, tmp_path: Path) -> None:
    records = [example({}, 0), {**example({"scene.name": name}, 1), "name": name, "config": name, "status": name}]
    records.append(failure(2, name=name, why=name))
    page = write_page(tmp_path / "page.html", records, title=name).read_text("utf-8")
    assert len(Outline(page).scripts) == 2
    data = data_of(page)
    assert data["settings"][1]["name"] == name
    assert data["markers"][1]["name"] == "scene.name"
    assert text_of(page).count(" ".join(name.split())) >= 5
    svg = ElementTree.fromstring(Sweep(records).figure("bytes"))
    assert svg.tag.endswith("svg")


@settings(max_examples=40)
@given(st.recursive(st.none() | st.text() | st.integers(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_embedded_json_reads_back_and_cannot_leave_its_element(value: Any) -> None:
    text = embedded(value)
    assert json.loads(text) == value
    assert text.isascii()
    assert not set("<>&") & set(text)


def test_embedded_numbers_are_finite() -> None:
    with pytest.raises(ValueError, match="JSON"):
        embedded([math.nan])


def test_nothing_measured_is_said(tmp_path: Path) -> None:
    for records in ([], [failure(1)]):
        made = write_all(tmp_path, records)
        assert "No setting could be measured." in text_of(made[0].read_text("utf-8"))
        assert "no setting has both" in made[2].read_text("utf-8")
    assert "got too little memory; lower it" in text_of(made[0].read_text("utf-8"))


def test_one_setting_alone_is_drawn(tmp_path: Path) -> None:
    page = write_page(tmp_path / "page.html", [example({}, 0)], title="").read_text("utf-8")
    data = data_of(page)
    assert data["pairs"]["error/bake"]["path"] == [0]
    assert data["pairs"]["error/bake"]["words"][0].endswith("is the best in both: nothing is to be traded.")
    for axis in (*data["errors"], *data["costs"]):
        assert axis["low"] * 1.49 < axis["high"]


def test_a_missing_base_is_said(tmp_path: Path) -> None:
    page = write_page(tmp_path / "page.html", [example({"fit.bases": 4}, 1)], title="").read_text("utf-8")
    assert "The configuration that all others are compared with was not measured." in text_of(page)
    assert data_of(page)["floors"] == []


def test_the_base_may_be_named(found: Sweep) -> None:
    other = found.settings[3]
    assert Sweep(examples(), other["digest"]).base == other


def test_other_machines_are_warned_of(tmp_path: Path) -> None:
    one, two = example({}, 0), example({"fit.bases": 4}, 1)
    two["environment"]["machine"]["processor"] = "Another CPU"
    text = text_of(write_page(tmp_path / "page.html", [one, two], title="").read_text("utf-8"))
    assert "Measured in 2 surroundings." in text
    assert "Another CPU" in text
    assert "surroundings" not in text_of(write_page(tmp_path / "page.html", [one], title="").read_text("utf-8"))
