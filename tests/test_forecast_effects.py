"""What each effect is foreseen to take of a bake: in `ddprt inspect`, and in `ddprt bake --dry-run`."""

import re
from typing import Any

import numpy as np
import pytest
from small_job import call

import ddprt
from ddprt.config import checked
from ddprt.dataset.forecast import Forecast, forecast
from ddprt.progress import Progress
from ddprt.scene.library import build

SMALL: dict[str, Any] = {
    "atlas": {"resolution": 32, "padding": 1},
    "lightings": {"train": 4, "validation": 1, "test": 1},
    "points": {"count": 4},
    "transport": {"samples": 16, "test_samples": 16, "sender_resolution": 24, "threads": 2},
}


def words(found: Forecast) -> dict[str, str]:
    return {line.split(":")[0].removeprefix("effect "): line for line in str(found).splitlines() if line.startswith("effect ")}


@pytest.mark.slow
def test_holes_and_backs_are_counted_as_the_bake_meets_them() -> None:
    """Gather rays of a bake with holes over those of one without; the share of backs is that of half the cards."""
    scene = build("leaves")
    told = words(forecast(scene, checked(SMALL)))
    each, share = map(float, re.findall(r"; ([\d.]+) rays for each .* gathered, ([\d.]+) % of them", told["cut-outs"])[0])
    rays = []
    for one in (scene, ddprt.force(scene, off=["cut-outs"])):
        shown = Progress(quiet=True)
        ddprt.bake(one, config=checked(SMALL), progress=shown)
        rays.append(next(float(stage["rays"]) for stage in shown.stages if stage["name"] == "indirect train"))
    assert each == pytest.approx(rays[0] / rays[1], rel=0.1)  # bounces are of other places, and leaves left whole see less
    assert share == pytest.approx(100 * (1 - 1 / each), rel=0.02)
    cards = scene.areas[np.array([one.name == "leaf" for one in scene.materials])[scene.material]].sum() / 2
    (backs,) = re.findall(r"backs are ([\d.]+) %", told["two-sided sheets"])
    assert float(backs) == pytest.approx(100 * cards / scene.areas.sum(), rel=0.05)


def test_stages_are_shares_of_the_bake() -> None:
    """Whatever has stages of its own tells their rays and seconds, and what is left out tells nothing."""
    found = forecast(build("neon"), checked({**SMALL, "probes": {"grid": [2, 1, 2], "rays": 64}}))
    told = words(found)
    assert set(told) == {"diffuse bounces", "point lights", "emission", "probes"}
    for name, begins in (
        ("emission", "emission"),
        ("probes", "probes"),
        ("diffuse bounces", "indirect"),
        ("point lights", "direct"),
    ):
        own = [stage for stage in found.stages if stage.name.startswith(begins)]
        (seconds, share) = re.findall(r"rays and (\S+) s, (\S+) % of the bake", told[name])[0]
        assert float(seconds) == pytest.approx(sum(stage.seconds for stage in own), rel=0.06), name
        assert float(share) == pytest.approx(100 * sum(stage.seconds for stage in own) / found.seconds, rel=0.06), name


def test_inspect_tells_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    small = [word for section, keys in SMALL.items() for key, value in keys.items() for word in (f"--{section}.{key}", value)]
    assert call("inspect", "glossy-room", *small, "--probes.grid", "[2, 2, 2]") == 0
    lines = capsys.readouterr().out.splitlines()
    (gloss,) = (line for line in lines if line.startswith("effect      gloss:"))
    assert re.search(r"about \S+( [kM])? rays and \S+ s, \S+ % of the bake; \S+ % of all rays that are gathered meet it", gloss)
    (probes,) = (line for line in lines if line.startswith("effect      probes:"))
    assert "% of the bake" in probes
    assert any("1 of 8 stand inside solids or behind walls" in line for line in lines)
