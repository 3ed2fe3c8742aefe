"""What a sweep becomes: numbers on a page, figures and tables, escaped, the same every time, and right in a real browser."""

import html
import json
import math
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddprt.bench.frontier import pareto
from ddprt.bench.frontier.page import BASE, SEVERAL, Sweep, embedded, spoken, ticks, write_all, write_page
from ddprt.bench.frontier.pareto import COSTS, DRAWN, ERRORS
from ddprt.report import fronts

KNOBS: dict[str, tuple[Any, ...]] = {
    "fit.bases": (2, 4, 8, 32, 64),
    "fit.points": (16, 32, 64),
    "fit.ridge": (0.0, 1e-4, 1e-2),
    "fit.space": ("gamma",),
    "fit.centre": ("mean",),
    "fit.method": ("mean", "nearest", "mlp"),
    "export.precision": ("float",),
    "lightings.train": (16, 32, 64, 256),
    "transport.target_noise": (0.005, 0.02, 0.04, 0.08),
    "transport.sender_resolution": (32, 64, 128),
    "transport.bounces": (1, 2, 4),
    "points.supersample": (1, 2, 4, 16),
    "atlas.resolution": (64, 96, 192, 512),
}


def example(changes: dict[str, Any], order: int) -> dict[str, Any]:
    """An invented record, shaped as a sweep's own; its numbers are made up by rules of thumb, not measured."""
    rng = np.random.default_rng(order)
    jitter = lambda: float(np.exp(0.04 * rng.standard_normal()))  # noqa: E731
    at = {"fit.bases": 16, "fit.points": 128, "fit.ridge": "auto", "fit.space": "linear", "fit.centre": "none"}
    at |= {"fit.method": "svd-ridge", "export.precision": "half", "lightings.train": 128, "transport.target_noise": 0.01}
    at |= {"transport.sender_resolution": 96, "transport.bounces": 7, "points.supersample": 8, "atlas.resolution": 256}
    at |= changes
    bases, texels, method = at["fit.bases"], 0.8 * at["atlas.resolution"] ** 2, at["fit.method"]
    projection = 0.11 * (4 / bases) ** 0.75
    squares = projection**2 + (0.9 / at["fit.points"]) ** 2 * 4 + (1.1 / at["lightings.train"]) ** 2 + 2e-5
    squares += (
        at["transport.target_noise"] ** 2
        + (0.6 / at["transport.sender_resolution"]) ** 2
        + (0.01 * 8 / at["points.supersample"]) ** 2 / 8
    )
    squares += (2.2 / at["atlas.resolution"]) ** 2 + (0.5 ** at["transport.bounces"] * 0.4) ** 2
    squares *= {"linear": 1.0, "gamma": 0.86}[at["fit.space"]] * {"none": 1.0, "mean": 1.04}[at["fit.centre"]]
    squares *= 1.0 if at["fit.ridge"] == "auto" else {0.0: 2.4, 1e-4: 1.05, 1e-2: 1.3}[at["fit.ridge"]]
    error = math.sqrt(squares) * {"svd-ridge": 1.0, "mean": 9.0, "nearest": 5.0, "mlp": 0.8}[method]
    bake = (3 + 90 * texels / 5e4 * (0.01 / at["transport.target_noise"]) ** 2 / 10 + 0.02 * at["lightings.train"]) * jitter()
    fit = (
        (0.02 + 2e-9 * texels * at["lightings.train"] ** 2)
        * {"mean": 0.1, "nearest": 0.3, "mlp": 160}.get(method, 1.0)
        * jitter()
    )
    frame = (1.2e-5 + 2.4e-10 * texels * (1 if method == "mean" else bases)) * (3 if method == "mlp" else 1) * jitter()
    if at["fit.space"] == "gamma":
        frame *= 3.1
    size = int(texels * 3 * (1 if method == "mean" else bases) * (4 if at["export.precision"] == "float" else 2))

    def timing(seconds: float, compile_seconds: float, repeats: int) -> dict[str, Any]:
        low, high = seconds * (1 - 0.02 * jitter()), seconds * (1 + 0.06 * jitter())
        return {"median": seconds, "low": low, "high": high, "compile": compile_seconds, "repeats": repeats}

    flip = None if order % 17 == 5 else 0.9 * error * jitter()
    scores = {
        "relative_rmse": error,
        "relative_mse": error**2 * 1.7,
        "psnr_db": -20 * math.log10(error) + 14,
        "pu21_psnr_db": -20 * math.log10(error) + 21 + 0.3 * jitter(),
        "flip": flip,
        "flip_reason": "the scene has no camera" if flip is None else "",
        "energy_bias": -0.1 * error,
        "median_lighting_relative_rmse": 0.7 * error,
        "p90_lighting_relative_rmse": 1.6 * error,
        "worst_lighting_relative_rmse": 3.2 * error * jitter(),
        "negative_share": 0.002,
        "flicker": 0.0 if method == "mean" else 0.2 * error * jitter(),
        "unseen_lightings": 0,
    }
    name = ", ".join(f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {value}" for key, value in changes.items())
    linear = method == "svd-ridge"
    return {
        "schema": 1,
        "digest": f"{order + 10:012x}",
        "digest_bake": f"{order:012x}",
        "name": name or BASE,
        "changes": changes,
        "failed": None,
        "scores": scores,
        "floors": {"noise_relative_rmse": 0.004, "projection_relative_rmse": projection if linear else None},
        "bake": {"seconds": bake, "stages": {"direct": 0.2 * bake, "indirect train": 0.7 * bake}, "rays": int(2e6 * bake),
                 "bytes": int(400 * texels), "peak_gib": 0.4 + texels / 2e5},
        "fit": {**timing(fit, 0.8, 5), "peak_gib": 0.3 * jitter()},
        "frame": timing(frame, 0.11, 100),
        "batch": {**timing(9 * frame, 0.13, 5), "frames": 16},
        "coefficients": timing(4e-6 * jitter(), 0.0, 100) if linear else None,
        "bytes": size,
        "flops": int(6 * texels * bases),
        "bases": bases,
        "method": method,
        "status": "ok" if bases < 64 else "rank_deficient",
        "remarks": [],
        "config": f'[scene]\nname = "cornell"\n\n[fit]\nbases = {bases}\nmethod = "{method}"\n',
        "environment": {"ddprt": "0.1.0", "commit": "9b11239", "when": f"2026-11-22T11:{order % 60:02d}:00+00:00",
                        "machine": {"processor": "Example CPU", "cores": 2, "memory_gib": 8.0, "system": "Linux x86_64",
                                    "python": "3.11.7", "packages": {"numpy": "2.3.5", "jax": "0.10.0"}}},
    }  # fmt: skip


def failure(order: int, name: str = "atlas.resolution = 4096", why: str = "got too little memory; lower it") -> dict[str, Any]:
    record = example({}, order)
    kept = {key: record[key] for key in ("schema", "digest", "digest_bake", "config", "environment")}
    return {**kept, "name": name, "changes": {"atlas.resolution": 4096}, "failed": why}


def examples() -> list[dict[str, Any]]:
    """A sweep of every knob on its own, one setting of two, and one that failed."""
    ways = [{}, *({key: value} for key, values in KNOBS.items() for value in values)]
    ways += [{"fit.bases": 64, "lightings.train": 256}]
    return [*(example(changes, order) for order, changes in enumerate(ways)), failure(900)]


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


def test_all_files_are_named_and_the_same_every_time(folder: Path, tmp_path: Path) -> None:
    made = write_all(tmp_path / "new", examples(), title="cornell")
    names = ["frontier.html", "frontier.csv", *(f"error-{cost}.svg" for cost in ("bake", "fit", "frame", "bytes"))]
    assert [path.name for path in made] == names
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(names)
    for path in made:
        assert path.read_bytes() == (folder / path.name).read_bytes(), path.name


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


@settings(max_examples=40, deadline=None)
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


# --- words and ticks --------------------------------------------------------------------------------------------------


def bent(places: list[tuple[float, float]]) -> Sweep:
    """Settings with given bake seconds and errors."""
    records = []
    for order, (cost, error) in enumerate(places):
        record = example({} if order == 0 else {"fit.bases": order}, order)
        record["bake"] = {**record["bake"], "seconds": cost}
        record["scores"] = {**record["scores"], "relative_rmse": error}
        records.append(record)
    return Sweep(records)


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
def test_figures_are_a_column_wide_and_their_text_is_text(cost: str, folder: Path, found: Sweep) -> None:
    svg = (folder / f"error-{cost}.svg").read_text("utf-8")
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


# --- in a real browser ------------------------------------------------------------------------------------------------

BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="needs chromium or google-chrome on the path")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")
FLAGS += ("--disable-sync", "--no-first-run", "--virtual-time-budget=5000", "--window-size=1400,1000", "--dump-dom")
PROBE = """<script>
const report = {};
window.addEventListener("error", (event) => { report.fault = String(event.message); });
const count = (selector) => document.querySelectorAll(selector).length;
const plot = (at) => document.querySelectorAll(".plot")[at];
setTimeout(() => {
  report.links = [...document.querySelectorAll(".plot")].map((figure) => figure.querySelectorAll("a[data-index]").length);
  report.fronts = [...document.querySelectorAll(".plot")].map((figure) => figure.querySelectorAll("a.best").length);
  report.knees = [...document.querySelectorAll(".plot")].map((figure) => figure.querySelectorAll("circle.knee").length);
  report.labels = plot(0).querySelectorAll("text.label").length;
  report.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const mark = plot(0).querySelector('a[data-index="3"]');
  mark.dispatchEvent(new PointerEvent("pointerenter", { clientX: 300, clientY: 300 }));
  report.tip = document.getElementById("tip").textContent;
  report.pointed = count('a[data-index="3"].pointed');
  mark.dispatchEvent(new PointerEvent("pointerleave"));
  report.left = document.getElementById("tip").hidden;
  mark.dispatchEvent(new MouseEvent("click", { bubbles: true, cancelable: true }));
  document.querySelector('button[data-knob="fit.bases"]').click();
  report.rows = [...document.querySelectorAll("#settings-table tbody")].filter((row) => !row.hidden).length;
  report.faded = plot(0).querySelectorAll("a.faded").length;
  document.querySelector('button[data-knob="fit.bases"]').click();
  const error = document.getElementById("error-choice");
  error.value = "pu21";
  error.dispatchEvent(new Event("change"));
  const choice = plot(1).querySelector("select");
  choice.value = "coefficients";
  choice.dispatchEvent(new Event("change"));
  report.chosen = plot(1).querySelector("svg").getAttribute("aria-label");
  report.words = plot(1).querySelector(".words").textContent;
  report.without = plot(1).querySelector(".left-out").textContent;
  document.querySelectorAll("#settings-table thead button")[6].click();
  const bake = (body) => Number(body.rows[0].cells[6].dataset.value);
  report.sorted = [...document.querySelectorAll("#settings-table tbody")].map(bake);
  setTimeout(() => {
    report.hash = location.hash;
    report.pinned = count('a[data-index="3"].pinned');
    report.row = document.querySelector("tbody.pinned").id;
    const box = document.querySelector("tbody.pinned").getBoundingClientRect();
    report.seen = box.top >= 0 && box.top < window.innerHeight;
    const node = document.createElement("p");
    node.id = "probe";
    node.textContent = JSON.stringify(report);
    document.body.append(node);
  }, 300);
}, 300);
</script></body>"""


def browsed(path: Path, scratch: Path) -> str:
    """What a page has become after its scripts have run."""
    assert BROWSER is not None
    command = [BROWSER, *FLAGS, f"--user-data-dir={scratch}", path.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=100).stdout


@needs_browser
def test_page_works_in_a_browser(page: str, found: Sweep, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(page.replace("</body>", PROBE), "utf-8")
    dumped = browsed(tmp_path / "page.html", tmp_path / "profile")
    report = json.loads(html.unescape(re.search(r'<p id="probe">(.*?)</p>', dumped)[1]))
    assert "fault" not in report
    drawn = [found.pair("error", cost) for cost in DRAWN]
    assert report["links"] == [len(found.settings)] * 4
    assert report["fronts"] == [int(pareto.front(*pair).sum()) for pair in drawn]
    assert report["knees"] == [int(pareto.knee(*pair) is not None) for pair in drawn]
    assert 3 <= report["labels"] <= 9
    assert report["wide"] == 0, "nothing sticks out"
    record = found.settings[3]
    for measure in (ERRORS["error"], ERRORS["pu21"], COSTS["frame"], COSTS["fit-memory"]):
        assert f"{measure.title}{spoken(measure, record)}" in report["tip"]
    assert report["tip"].startswith(record["name"])
    assert report["pointed"] == 4
    assert report["left"]
    bases = sum("fit.bases" in one["changes"] for one in found.settings)
    assert (report["rows"], report["faded"]) == (bases + 1, len(found.settings) - bases - 1), "the base stays"
    assert report["chosen"] == "PU21-PSNR against time of the coefficients alone"
    assert report["words"] == "".join(found.words("pu21", "coefficients"))
    missing = sum(one["coefficients"] is None for one in found.settings)
    assert report["without"].startswith(f"{missing} of {len(found.settings)} settings")
    assert report["sorted"] == sorted(one["bake"]["seconds"] for one in found.settings)
    assert report["hash"] == f"#{record['digest']}"
    assert report["pinned"] == 4
    assert report["row"] == record["digest"]
    assert report["seen"], "a click goes to the row"


@needs_browser
def test_a_wicked_name_runs_nothing(tmp_path: Path) -> None:
    records = [example({}, 0), {**example({"scene.name": "x"}, 1), "name": "<img src=x onerror=document.title='run'>"}]
    wicked = write_page(tmp_path / "page.html", records, title="</script><script>document.title='run'</script>")
    hover = "document.querySelectorAll('a[data-index=\"1\"]')[0].dispatchEvent(new PointerEvent('pointerenter'))"
    text = wicked.read_text("utf-8").replace("</body>", f"<script>setTimeout(() => {hover}, 200)</script></body>")
    wicked.write_text(text, "utf-8")
    dumped = browsed(wicked, tmp_path / "profile")
    assert "<title>run" not in dumped
    assert "<strong>&lt;img src=x" in dumped, "what is pointed at is named as text"
    assert "<img src=" not in dumped.split("<noscript>")[0]
    assert len(re.findall(r'<a [^>]*data-index="\d', dumped)) == 8


if __name__ == "__main__":
    for made in write_all(sys.argv[1], examples(), title="EXAMPLE (invented numbers)"):
        print(made)
