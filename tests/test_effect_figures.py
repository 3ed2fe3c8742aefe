"""`experiments/effects.py`: every effect has a figure, the figures are right, and what they stand on agrees with slow twins."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from oracles import polygon_irradiance

from ddprt.transport.effects import EFFECTS

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import asset_sh
import effect_figures as figures
import effects

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
BIASED = {
    # Rays start 2e-5 of the scene's radius off the ground, 0.3 mm of 1.6 m: the shadow of a point moves by no more.
    "point lights": 1e-3,
    "spot lights": 1e-3,
    "directional lights": 1e-6,  # float32
    "cut-outs": 1e-3,  # two rims in 16384 steps, and the rays' offset over a stripe of 0.3 m
    "probes": 1e-3,  # flat triangles of a sphere, of 2e-3 of its area
}


def test_every_effect_has_a_figure() -> None:
    assert list(figures.FIGURES) == [name for name in EFFECTS if name in figures.FIGURES], "in the catalogue's order"
    assert set(figures.FIGURES) == set(EFFECTS)


def test_an_effect_without_a_figure_ends_the_experiment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects, "EFFECTS", {**EFFECTS, "made-up": EFFECTS["gloss"]})
    monkeypatch.setattr(sys, "argv", ["effects.py", "--quick"])
    with pytest.raises(SystemExit, match="no figure for made-up; add one") as ended:
        effects.main()
    assert ended.value.code != 0


@pytest.mark.parametrize("name", figures.FIGURES)
def test_figures_are_within_their_uncertainty(name: str) -> None:
    """The largest of up to 64 deviations: 5 standard errors, where single points have up to twice the mean square's root."""
    figure = figures.FIGURES[name](True)
    assert ("standard_error" in figure) or name in BIASED
    assert figure["closed_form_error"] < 10 * figure.get("standard_error", 0.0) + BIASED.get(name, 0.0)


def test_irradiance_of_a_polygon_is_that_of_the_oracle() -> None:
    corners = np.array([[0.1, 1, 0.2], [0.9, 1.2, 0.1], [0.8, 0.7, 1.0]])
    place, normal = np.array([0.3, 0.0, -0.2]), np.array([0.0, 0.8, 0.6])
    found = figures.lambert(corners, place, tuple(normal))
    assert found == pytest.approx(polygon_irradiance(corners, 1.0, place, normal), rel=1e-13)


def test_the_largest_deviation_is_told() -> None:
    found = figures.compared([1.0, 2.2], [1.0, 2.0], [0.0, 0.2])
    assert found == pytest.approx({"closed_form_error": 0.1, "standard_error": 0.1})
    assert figures.compared([1.0, 1.0], [1.0, 1.0], [0.3, 0.4])["standard_error"] == pytest.approx(0.5 / np.sqrt(2))
    assert figures.compared([0.5], [0.0], unit=2.0) == {"closed_form_error": 0.25}


def test_the_darkest_share_of_a_surface() -> None:
    light, area = np.array([[5.0, 1, 3, 0], [0, 1, 2, 3]]), np.array([1.0, 2, 2, 1])
    expected = [[False, True, False, True], [True, True, False, False]]
    np.testing.assert_array_equal(asset_sh.darkest(light, area, 0.5), expected)
    np.testing.assert_array_equal(
        asset_sh.darkest(light, area, 0.45), [[False, False, False, True], [True, False, False, False]]
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere lights", "mesh lights"])
def test_mitsuba_agrees(name: str) -> None:
    """In a process of its own, since Mitsuba runs in one variant at a time; the other effects have tests of their own."""
    pytest.importorskip("mitsuba", reason='needs the extra "reference"')
    code = f"import json, effect_mitsuba; print(json.dumps(effect_mitsuba.second_opinion({name!r})))"
    done = subprocess.run([sys.executable, "-c", code], cwd=EXPERIMENTS, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    print(name, found)
    # 400 scores and more, direct and indirect light of 256 points: known to 0.05 and 0.035; four of these each.
    assert found["z_count"] > 400
    assert abs(found["z_mean"]) < 0.2
    assert abs(found["z_std"] - 1) < 0.15
