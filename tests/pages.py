"""Pages of the viewer as a browser without a window sees them."""

import html
import json
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddprt.report.view import Camera, first_fronts
from ddprt.transport.embree import Tracer

BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
FLAGS = ("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--disable-background-networking", "--no-first-run")
FLAGS += ("--disable-component-update", "--disable-sync", "--virtual-time-budget=5000", "--window-size=800,300", "--dump-dom")
FAULTS = """<script>window.faults = [];
window.addEventListener("error", (event) => window.faults.push(event.message));
for (const name of ["error", "warn"]) console[name] = (...said) => window.faults.push(said.join(" "));</script>"""


def browsed(whole: str, question: dict[str, Any], probe: str, folder: Path, *flags: str) -> dict[str, Any]:
    """What a probe finds in a page, with further flags for the browser."""
    if BROWSER is None:
        pytest.skip("needs chromium or google-chrome on the path")
    text = json.dumps(question).replace("<", "\\u003c")
    added = f'<script type="application/json" id="asked">{text}</script><script>{probe}</script></body>'
    whole = whole.replace("<body>", f"<body>{FAULTS}", 1)
    at = whole.rindex("</body>")
    made = folder / "page.html"
    made.write_text(whole[:at] + added + whole[at + len("</body>") :], "utf-8")
    command = [BROWSER, *FLAGS, *flags, f"--user-data-dir={folder / 'profile'}", made.as_uri()]
    dumped = subprocess.run(command, capture_output=True, text=True, check=True, timeout=200).stdout
    answer = re.search(r'<p id="probe">(.*?)</p>', dumped)
    assert answer, "the page did not come to an end"
    return json.loads(html.unescape(answer[1]))


@dataclass(frozen=True)
class Seen:
    """What lies behind some pixels of a page's picture, by rays.

    Attributes:
      shown: (pixels, 3) what the page shows there, 0 to 1.
      triangle, corners: that is hit, and the shares of its corners.
      position, normal: of the place, world space.
    """

    shown: np.ndarray
    triangle: np.ndarray
    corners: np.ndarray
    position: np.ndarray
    normal: np.ndarray


def seen(picture: dict[str, Any], camera: Camera, fov: float, tracer: Tracer) -> Seen:
    """Every eighth pixel of a picture either way, where something is."""
    width, height = picture["width"], picture["height"]
    shown = np.reshape(picture["data"], (height, width, 4))[..., :3] / 255
    camera = replace(camera, aspect=width / height, fov_deg=float(fov))
    down, across = np.mgrid[4:height:8, 4:width:8]
    directions = camera.directions(np.stack([(across + 0.5) / width, (down + 0.5) / height], -1).reshape(-1, 2))
    hits = first_fronts(tracer, np.asarray(camera.eye), directions)
    hit = np.flatnonzero(hits.triangle >= 0)
    assert len(hit) > 80
    triangle, u, v = hits.triangle[hit], hits.u[hit], hits.v[hit]
    position, normal = tracer.on_triangle(triangle, u, v) + tracer.centre, tracer.normals[triangle].astype(float)
    corners = np.stack([1 - u - v, u, v], 1).astype(np.float64)
    return Seen(shown[down.ravel()[hit], across.ravel()[hit]], triangle, corners, position, normal)


def displayed(light: np.ndarray) -> np.ndarray:
    """As a screen has it: cut to 0 to 1 and sRGB-encoded."""
    linear = np.clip(light, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def off(found: Seen, expected: np.ndarray) -> float:
    """The share of pixels that are not as expected; edges of objects, shadows and charts are."""
    assert (expected.max(1) > 0.1).mean() > 0.2, "a picture of something"
    return float(np.mean(np.abs(found.shown - expected).max(1) >= 0.02))
