"""Splits beyond the training lightings: what each trains on and asks about, and who says that he cannot."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import base
from small_rival import Gain

import ddprt
from ddprt.bench.leagues.generalisation import Generalisation, asked_with, tally_with
from ddprt.bench.leagues.search import BASELINE
from ddprt.bench.leagues.split_pages import Found, markdown, told, write_splits
from ddprt.bench.leagues.splits import SPLITS, split_names
from ddprt.bench.measure.settings import changed
from ddprt.errors import UserError
from ddprt.lights import PointLight
from ddprt.methods import METHODS
from ddprt.methods.floors import MeanMap
from ddprt.progress import Progress
from ddprt.report.metrics import Truth

QUIET = Progress(quiet=True)


@pytest.mark.parametrize("name", list(SPLITS))
def test_sides_are_settings_that_are_taken(name: str) -> None:
    config = base(lightings__train=40)
    sides = SPLITS[name].sides(config)
    assert len({side.label for side in sides}) == len(sides) > 1
    for side in sides:
        for changes in (side.learn, side.judge):
            changed(config, changes)
    for side in sides[1:]:
        assert side != sides[0]


def test_what_is_asked_about_is_outside_of_what_is_trained_on() -> None:
    room = SPLITS["outside"].sides(base(lightings__region_low=[0.1, 0.2, 0.3], lightings__region_high=[0.5, 0.8, 0.6]))
    assert room[0].judge == room[0].learn == {"lightings.region_high": [0.5, 0.5, 0.6]}
    assert room[1].judge == {"lightings.region_low": [0.1, 0.5, 0.3]}
    around = SPLITS["outside"].sides(base(lightings__distribution="around", lightings__elevation_deg=[10, 50]))
    assert around[0].learn == {"lightings.elevation_deg": [30, 50]}
    assert around[1].judge == {"lightings.elevation_deg": [10, 30]}
    noisy = SPLITS["noise"].sides(base(transport__samples="auto", transport__target_noise=0.01))
    assert noisy[2].learn == {"transport.target_noise": 0.04}  # a sixteenth of the rays has four times the noise
    assert [side.train for side in SPLITS["size"].sides(base(lightings__train=40))] == [40, 32, 16, 8]


def test_a_configuration_that_cannot_be_asked_says_why(tmp_path: Path) -> None:
    given = base(lightings__file=str(tmp_path / "lights.json"))
    for name in ("kind", "outside", "colour", "crowd"):
        with pytest.raises(UserError, match=r"lightings\.file"):
            SPLITS[name].sides(given)
    skies = base(lightings__kinds=["environment"])
    for name in ("outside", "colour"):
        with pytest.raises(UserError, match="environment"):
            SPLITS[name].sides(skies)
    for name, key, value in (
        ("size", "lightings__train", 8),
        ("points", "points__count", 3),
        ("noise", "transport__samples", 1),
    ):
        with pytest.raises(UserError, match="got"):
            SPLITS[name].sides(base(**{key: value}))
    assert split_names("all") == list(SPLITS)
    assert split_names("size, kind,size") == ["size", "kind"]
    with pytest.raises(UserError, match='no split "sise"'):
        split_names("sise")


def test_more_lights_are_asked_about_and_noted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a side asks about is baked and scored apart from its training; a second run has all of it in its file."""
    monkeypatch.setitem(METHODS, "gain", Gain)
    config, scene = base(leagues__seeds=2, leagues__methods=["gain"]), ddprt.load_scene("cornell")
    data = ddprt.bake(scene, config=config, out=tmp_path / "data")
    first = Generalisation(config, data, scene, tmp_path, QUIET)
    records = first.run(["crowd"])
    sides = SPLITS["crowd"].sides(config)
    truth = [first._truth(side).data for side in sides]
    assert truth[0].folder == data.folder
    assert {len(truth[1].lightings[index]) for index in truth[1].split("test")} == {4}
    assert len(records) == 2 * 2 * 2
    assert all(len(record["error"]) == 4 for record in records)
    for record in records:
        judged = truth[record["side"] == "4 lights"]
        squares = Truth(judged.maps("indirect", judged.split("test")), judged.area).squares
        np.testing.assert_array_equal(record["squares"], squares)
    found = told(records, ["crowd"])[0]
    assert [name for name, _ in found.rows] == [BASELINE, "gain"]
    assert found.sides == ["1 light, as trained", "4 lights"]
    assert "4 lights: " in found.words[0]
    model = first._model(sides[0], BASELINE, 0)
    with pytest.raises(UserError, match="the 12 points that it was fitted with"):
        asked_with(model, 6)
    monkeypatch.setattr(MeanMap, "any_points", True, raising=False)
    mean = first._model(sides[0], "gain", 0)
    assert asked_with(mean, 6).points == 6
    # What is left of the points is bright as before, which is all that this rival heeds: with all points nothing changes.
    whole, fewer = (tally_with(mean, first._truth(sides[0]), points) for points in (12, 6))
    np.testing.assert_array_equal(whole.error, first._truth(sides[0]).tally(mean).error)
    assert (whole.error != fewer.error).any()

    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("was measured again")

    monkeypatch.setattr(Generalisation, "_measured", never)
    again = Generalisation(config, data, scene, tmp_path, QUIET)
    assert again.run(["crowd"]) == records

    class Another(Gain):
        """The same by another default."""

        more: float = 1.5

    monkeypatch.setitem(METHODS, "gain", Another)
    again._side("crowd", sides[0], BASELINE, 0)
    with pytest.raises(AssertionError, match="was measured again"):
        again._side("crowd", sides[0], "gain", 0)


@pytest.mark.slow
def test_light_that_does_not_get_in_is_told_and_a_method_that_cannot_too(tmp_path: Path) -> None:
    """A closed box has no parallel light from above."""
    config = base(leagues__seeds=1, leagues__methods=["sh-prt"], lightings__elevation_deg=[80, 90])
    scene = ddprt.load_scene("cornell")
    data = ddprt.bake(scene, config=config, out=tmp_path / "data")
    with pytest.warns(UserWarning, match="doubtful"):
        records = Generalisation(config, data, scene, tmp_path, QUIET).run(["kind", "size"])
    kind, size = told(records, ["kind", "size"]) if len(records) > 1 else (told(records, ["kind"])[0], None)
    assert "none of that light gets into the scene" in kind.cannot
    assert "Cannot be done here" in markdown([kind], "box")
    assert size is None or size.cannot  # eight lightings have no smaller size
    own = Generalisation(config, data, scene, tmp_path, QUIET).run(["crowd"])
    by_name = {record["method"]: record["failed"] for record in own}
    assert by_name[BASELINE] is None
    assert "got a light of type point" in by_name["sh-prt"]
    assert isinstance(data.lightings[0][0], PointLight)


def test_a_refusal_is_told_once_under_its_table() -> None:
    rows = [("svd-ridge", ["3 %", "4 %"]), ("sh-prt", ["sh-prt: takes suns", "sh-prt: takes suns"])]
    text = markdown([Found("kind", "?", sides=["a", "b"], rows=rows, words=["b: nobody."])], "box")
    assert "| sh-prt | – | – |\n" in text
    assert text.count("sh-prt: takes suns") == 1
    assert text.endswith("- b: nobody.\n- sh-prt: takes suns\n")


def test_a_split_that_grows_is_a_curve_beside_its_table(tmp_path: Path) -> None:
    """Marks stand where numbers of lightings do, none where a method failed."""
    sides = SPLITS["size"].sides(base(lightings__train=40))
    assert [side.at for side in sides] == [40, 32, 16, 8]
    made = [
        {"what": "side", "split": "size", "side": side.label, "at": side.at, "method": name, "seed": seed, "mean": [1.0, 1.0]}
        | {"error": [1.0 / side.at, (1.0 + 0.1 * seed) / side.at]}
        | {"failed": "gain: too few" if name == "gain" and side.at == 8 else None}
        for name in (BASELINE, "gain", "mlp")
        for seed in (0, 1)
        for side in sides
    ]
    found = told(made, ["size"])
    text = write_splits(tmp_path, found, "box").read_text()
    assert "![size](splits-size.svg)" in text
    assert "| gain |" in text
    picture = (tmp_path / "splits-size.svg").read_text()
    assert picture == found[0].curve
    for word in (BASELINE, "gain", "mlp", "training lightings", ">8<", ">16<", ">32<", ">40<"):
        assert word in picture
    assert told([{"what": "split", "split": "size", "failed": "no"}], ["size"])[0].curve == ""
