"""What makes a dataset another one: pictures of its skies, effects that were simulated; not effects that nobody called for."""

from pathlib import Path

import numpy as np
import pytest

import ddprt
from ddprt.config import checked
from ddprt.dataset.light_files import check_skies, kept, lit, pictures
from ddprt.dataset.probes import probe_layers
from ddprt.dataset.sameness import differences
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
    before = pictures(sky, tmp_path)
    assert list(before) == [str(path)], "skies in code have no file"
    path.write_bytes(b"another")
    assert differences({"skies": before}, {"skies": before}) == ""
    assert differences({"skies": before}, {"skies": pictures(sky, tmp_path)}).startswith(f"skies.{path}: ")
    assert differences({}, {"skies": before}) != "", "a dataset of an older version, which knew of none"


@pytest.mark.parametrize("integrator", ["auto", "paths", "reference"])
def test_probes_stand_in_a_glossy_room_whatever_makes_its_maps(integrator: str) -> None:
    config, scene = checked({"probes": {"grid": [2, 2, 2]}, "transport": {"integrator": integrator}}), build("glossy-room")
    assert len(probe_layers(config, scene)) == 1


def test_a_sky_that_is_to_shine_again_is_there_and_the_same(tmp_path: Path) -> None:
    path = tmp_path / "sky.exr"
    sky = [parse_lighting({"type": "environment", "image": name}) for name in (str(path), "sun-sky")]
    path.write_bytes(b"one")
    before = {"skies": pictures(sky, tmp_path)}
    check_skies(before, sky, tmp_path)
    check_skies({}, sky, tmp_path)  # of an older version, which knew of none
    path.write_bytes(b"another")
    with pytest.raises(UserError, match=r"sky\.exr: got another picture than the dataset was baked with"):
        check_skies(before, sky, tmp_path)
    path.unlink()
    with pytest.raises(UserError, match=r"sky\.exr: got No such file"):
        check_skies(before, sky, tmp_path)


def test_files_of_lights_are_named_from_the_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run" / "dataset"
    folder.mkdir(parents=True)
    (tmp_path / "sky.exr").write_bytes(b"one")
    (tmp_path / "lamp.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    records = [
        {"type": "environment", "image": "sky.exr"},
        {"type": "environment", "image": str(tmp_path / "sky.exr")},
        {"type": "environment", "image": "sun-sky"},
        {"type": "mesh", "mesh": "lamp.obj", "position": [0, 0, 0], "radiance": [1, 1, 1]},
    ]
    monkeypatch.chdir(tmp_path)
    lighting = parse_lighting(records)
    there = kept(lighting, Path("run/dataset"))
    assert [one.get("image") or one["mesh"] for one in there] == [
        "../../sky.exr", str(tmp_path / "sky.exr"), "sun-sky", "../../lamp.obj"
    ]  # fmt: skip
    assert set(pictures([lighting], Path("run/dataset"))) == {"../../sky.exr", str(tmp_path / "sky.exr")}
    assert parse_lighting(lit(there, Path("run/dataset"))) == lighting
    monkeypatch.chdir("/")
    again = parse_lighting(lit(there, folder))
    assert Path(again[0].image).resolve() == (tmp_path / "sky.exr").resolve()
    check_skies({"skies": pictures([again], folder)}, [again], folder)
    triangles = parse_lighting([{**records[3], "mesh": [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]}])
    assert parse_lighting(lit(kept(triangles, folder), folder)) == triangles


def test_black_surfaces_that_gloss_send_light_on() -> None:
    """A ball of black metal still reflects at grazing angles: Schlick's Fresnel is 1 there."""
    lamp = {"type": "point", "position": [0.3, 0.1, 0.2], "intensity": [1, 1, 1]}
    black = build("furnace", albedo=0.0, subdivisions=1)
    metal = black.made_of(lambda entry: Material(entry.name, entry.albedo, gloss=Gloss(roughness=0.3, metallic=1.0)))
    at, facing = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    dark, lit = (ddprt.irradiance(scene, lamp, at, facing, samples=4096, seed=1)[1] for scene in (black, metal))
    assert not dark.any()
    assert lit.min() > 0
