"""The viewer under fingers, and in browsers that cannot draw it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_rivals import model_of, relighters
from pages import browsed
from tab import tab

from ddprt.export.viewer.pack import pack
from ddprt.export.viewer.page import page
from ddprt.scene.mesh import Scene


@pytest.fixture
def packed(cornell: Scene) -> dict[str, Any]:
    """A made-up model in a room, which has but one texel for all its walls."""
    corners, uv = cornell.corners, np.zeros((len(cornell.corners), 3, 2), np.float32)
    of_room = {"method": "svd-ridge", "occluders": corners, "uv": uv, "scene": {"name": "cornell", "digest": "0"}}
    return pack(replace(model_of(relighters(5, 3)["plain"]), **of_room), stitch=False)


def test_browsers_that_cannot_draw_it_are_told_on_the_page(packed: dict[str, Any], tmp_path: Path) -> None:
    probe = """const line = document.getElementById("warning"), node = document.createElement("p");
    node.id = "probe";
    node.textContent = JSON.stringify({ faults, said: line.textContent, shown: line.getClientRects().length > 0,
      panel: document.getElementById("panel").getClientRects().length > 0 });
    document.body.append(node);"""
    found = browsed(page(packed), {}, probe, tmp_path, "--disable-gpu", "--disable-3d-apis")
    assert found["said"].startswith("this page needs WebGL2")
    assert (found["faults"], found["shown"], found["panel"]) == ([], True, False)
    found = browsed(page({**packed, "manifest": None}), {}, probe, tmp_path)
    assert found["said"].startswith("this page could not start: ")
    assert (found["shown"], found["panel"]) == (True, False)


@pytest.mark.slow
def test_fingers_turn_zoom_pick_and_drag(packed: dict[str, Any], tmp_path: Path) -> None:
    """One finger turns, two zoom, a touch picks a lamp, one on its arrow drags it and turns nothing."""
    lights = [{"type": "point", "position": [x, 0.3, 0.2], "intensity": [1, 1, 1]} for x in (0.15, 0.4)]
    (tmp_path / "a.html").write_text(page({**packed, "lights": lights}), "utf-8")
    with tab((tmp_path / "a.html").as_uri()) as hand:
        hand.until("Boolean(window.ddprt)")
        eye = lambda: np.array(hand.value("ddprt.view.looking().eye"))  # noqa: E731
        target, first = np.array(hand.value("ddprt.view.looking().target")), eye()
        away = lambda place: float(np.linalg.norm(place - target))  # noqa: E731

        def settled() -> None:
            hand.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

        def place(index: int, axis: str | None = None) -> tuple[float, float]:
            mark = f"ddprt.view.lamps.group.children[{index}].position.clone()"
            along = f".add({{x: 0, y: 0, z: 0, {axis}: ddprt.model.radius * 0.12}})" if axis else ""
            there = hand.value(
                f"(() => {{ const p = {mark}{along}.project(ddprt.view.camera), b = ddprt.view.canvas.getBoundingClientRect();"
                "return [b.left + (p.x + 1) / 2 * b.width, b.top + (1 - p.y) / 2 * b.height]; })()"
            )
            return there[0], there[1]

        def drawn(*steps: list[tuple[float, float]]) -> None:
            hand.touch("touchStart", *steps[0])
            for step in steps[1:]:
                hand.touch("touchMove", *step)
            hand.touch("touchEnd")
            settled()

        drawn(*[[(100 + 10 * i, 450)] for i in range(8)])
        turned = eye()
        assert np.linalg.norm(turned - first) > 0.1 * away(first)
        assert away(turned) == pytest.approx(away(first), rel=1e-6)
        drawn(*[[(200 - 10 * i, 450), (260 + 10 * i, 450)] for i in range(8)])
        assert away(eye()) < 0.8 * away(turned)

        hand.value("ddprt.reset()")
        settled()
        drawn([(100, 450), place(1)])
        assert hand.value("ddprt.state.chosen") == 0, "two fingers pick no lamp, though one is on it"
        drawn([place(1)])
        assert hand.value("ddprt.state.chosen") == 1
        x, y = place(1, "x")
        drawn(*[[(x - 4 * i, y)] for i in range(8)])
        lamp = hand.value("ddprt.state.lamps[1].position")
        assert abs(lamp[0] - 0.4) > 0.02
        np.testing.assert_allclose(lamp[1:], lights[1]["position"][1:], atol=1e-6)
        np.testing.assert_allclose(eye(), first, atol=1e-6)
        drawn(*[[(100 + 10 * i, 450)] for i in range(8)])
        assert hand.value("document.getElementById('panel').getClientRects().length") == 1
        assert np.linalg.norm(eye() - first) > 0.1 * away(first), "and after that fingers turn again"
