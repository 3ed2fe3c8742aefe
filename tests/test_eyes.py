"""Places that pictures are asked for from: nonsense is refused in one line, before anything is baked."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import call

from ddprt.config import checked
from ddprt.errors import UserError
from ddprt.report.eyes import check_eyes
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene


@pytest.mark.parametrize(
    ("eye", "fault"),
    [
        ((0.186, 0.08, 0.169), "inside a solid"),
        ((0.28, 0.28, 1e30), "expected less than"),
        ((0.0, 0.0, 1e5), "nothing of the scene is seen"),
    ],
    ids=["in the short block", "past what is a place", "so far that no pixel shows it"],
)
def test_places_that_show_nothing_are_refused(cornell: Scene, eye: tuple[float, float, float], fault: str) -> None:
    with pytest.raises(UserError, match=rf"report\.views\[1\]: got .*{fault}") as told:
        check_eyes(cornell, [(0.1, 0.3, -0.5), eye], layers=True)
    assert "\n" not in str(told.value)


def test_what_is_looked_at_is_the_gloss_where_it_has_layers(cornell: Scene) -> None:
    vase = build("glossy-room")
    shiny = vase.corners[vase.material == len(vase.materials) - 1].reshape(-1, 3)
    middle = (shiny.min(0) + shiny.max(0)) / 2
    above = middle + np.array([0, 0.2, 0])
    for scene, eye, layers in ((cornell, cornell.centre, True), (vase, vase.centre, False), (vase, middle, True)):
        with pytest.raises(UserError, match="which is what all views look at"):
            check_eyes(scene, [tuple(eye.tolist())], layers=layers)
    check_eyes(vase, [tuple(vase.centre.tolist()), tuple(above.tolist())], layers=True)


def test_a_closed_room_may_be_looked_into_through_its_walls() -> None:
    room = build("neon")
    check_eyes(room, [(0.0, 1.2, 6.0), (0.0, 1.5, 1.0)], layers=True)


@pytest.mark.parametrize(
    "view", [[0.1, float("nan"), 0.2], [0.1, 0.2, float("inf")], [0.1, 0.2], [0.1, 0.2, 0.3, 400.0], ["a"] * 3]
)
def test_a_place_is_three_finite_numbers(view: list[Any]) -> None:
    with pytest.raises(UserError, match=r"report\.views"):
        checked({"report": {"views": [view]}})


@pytest.mark.parametrize("verb", [["run"], ["bake"], ["bake", "--dry-run"]])
def test_nothing_is_baked_before(verb: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert call(*verb, "configs/smoke.toml", "--out", out, "--report.views", "[[0.186, 0.08, 0.169]]") == 2
    assert "report.views[0]" in capsys.readouterr().err
    assert not out.exists()
