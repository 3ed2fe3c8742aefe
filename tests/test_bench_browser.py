"""The page of a sweep in a real browser: what is pointed at, clicked, chosen and sorted, and that names run nothing."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from made_up_sweep import example, examples

from ddprt.bench.frontier import pareto
from ddprt.bench.frontier.page import Sweep, spoken, write_page
from ddprt.bench.frontier.pareto import COSTS, DRAWN, ERRORS

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
  plot(0).querySelector('a[data-index="3"]').dispatchEvent(new MouseEvent("click", { bubbles: true, cancelable: true }));
  let looks = 0;
  const look = () => {
    const place = document.querySelector("tbody.pinned")?.getBoundingClientRect();
    const seen = place && place.top >= 0 && place.top < window.innerHeight;
    if (!seen && (looks += 1) < 10) return setTimeout(look, 300); // a busy browser scrolls when it gets round to it
    report.hash = location.hash;
    report.pinned = count('a[data-index="3"].pinned');
    report.row = document.querySelector("tbody.pinned").id;
    report.seen = seen;
    const node = document.createElement("p");
    node.id = "probe";
    node.textContent = JSON.stringify(report);
    document.body.append(node);
  };
  setTimeout(look, 300);
}, 300);
</script></body>"""


def browsed(path: Path, scratch: Path) -> str:
    """What a page has become after its scripts have run."""
    assert BROWSER is not None
    command = [BROWSER, *FLAGS, f"--user-data-dir={scratch}", path.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=100).stdout


@needs_browser
def test_page_works_in_a_browser(tmp_path: Path) -> None:
    found, made = Sweep(examples()), write_page(tmp_path / "page.html", examples(), title="cornell")
    made.write_text(made.read_text("utf-8").replace("</body>", PROBE), "utf-8")
    dumped = browsed(made, tmp_path / "profile")
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
