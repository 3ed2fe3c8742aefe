"""What makes a dataset another one: pictures of its skies, effects that were simulated; not effects that nobody called for."""

from pathlib import Path

import numpy as np
import pytest

import ddprt
from ddprt.config import checked
from ddprt.dataset.probes import probe_layers
from ddprt.dataset.sameness import check_skies, differences, pictures
from ddprt.errors import UserError
from ddprt.lights import parse_lighting
from ddprt.scene.library import build
from ddprt.scene.material import Gloss, Material


def line(name: str, *, called: bool = False, forced: bool = False) -> dict[str, object]:
    return {"name": name, "called": called, "why": "said so", "bound": 0.0, "forced": forced}


def test_effects_that_nobody_called_for_make_no_other_dataset() -> None:
    old = {"plan": [line("diffuse bounces", called=True)]}
    newer = {"plan": [line("diffuse bounces", called=True), line("fog")]}
    assert differences(old, newer) == ""
    assert differences(newer, old) == ""


@pytest.mark.parametrize("how", ["called", "forced"])
def test_effects_that_were_decided_on_do(how: str) -> None:
    old = {"plan": [line("diffuse bounces", called=True)]}
    assert differences(old, {"plan": [*old["plan"], line("fog", **{how: True})]}).startswith("plan: ")


def test_a_sky_whose_picture_has_changed_makes_another_dataset(tmp_path: Path) -> None:
    path = tmp_path / "sky.exr"
    sky = [parse_lighting({"type": "environment", "image": name}) for name in (str(path), "sun-sky")]
    path.write_bytes(b"one")
    before = pictures(sky)
    assert list(before) == [str(path)], "skies in code have no file"
    path.write_bytes(b"another")
    assert differences({"skies": before}, {"skies": before}) == ""
    assert differences({"skies": before}, {"skies": pictures(sky)}).startswith(f"skies.{path}: ")
    assert differences({}, {"skies": before}) != "", "a dataset of an older version, which knew of none"


@pytest.mark.parametrize("integrator", ["auto", "paths", "reference"])
def test_probes_stand_in_a_glossy_room_whatever_makes_its_maps(integrator: str) -> None:
    config, scene = checked({"probes": {"grid": [2, 2, 2]}, "transport": {"integrator": integrator}}), build("glossy-room")
    assert len(probe_layers(config, scene)) == 1


def test_a_sky_that_is_to_shine_again_is_there_and_the_same(tmp_path: Path) -> None:
    path = tmp_path / "sky.exr"
    sky = [parse_lighting({"type": "environment", "image": name}) for name in (str(path), "sun-sky")]
    path.write_bytes(b"one")
    before = {"skies": pictures(sky)}
    check_skies(before, sky)
    check_skies({}, sky)  # of an older version, which knew of none
    path.write_bytes(b"another")
    with pytest.raises(UserError, match=r"sky\.exr: got another picture than the dataset was baked with"):
        check_skies(before, sky)
    path.unlink()
    with pytest.raises(UserError, match=r"sky\.exr: got No such file"):
        check_skies(before, sky)


def test_black_surfaces_that_gloss_send_light_on() -> None:
    """A ball of black metal still reflects at grazing angles: Schlick's Fresnel is 1 there."""
    lamp = {"type": "point", "position": [0.3, 0.1, 0.2], "intensity": [1, 1, 1]}
    black = build("furnace", albedo=0.0, subdivisions=1)
    metal = black.made_of(lambda entry: Material(entry.name, entry.albedo, gloss=Gloss(roughness=0.3, metallic=1.0)))
    at, facing = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    dark, lit = (ddprt.irradiance(scene, lamp, at, facing, samples=4096, seed=1)[1] for scene in (black, metal))
    assert not dark.any()
    assert lit.min() > 0
