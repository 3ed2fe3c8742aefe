"""Settings of a sweep: what is changed, what shares a dataset, and what is refused."""

from typing import Any

import pytest

from ddprt.bench.measure.settings import Setting, changed, plan_of, settings_of
from ddprt.config import Config, checked, load_config
from ddprt.errors import UserError
from ddprt.scene.atlas import build_atlas
from ddprt.scene.files import load_scene
from ddprt.transport.embree import Tracer
from ddprt.transport.operator import Operator


def config(**sweep: Any) -> Config:
    return checked({"sweep": {key.replace("__", "."): value for key, value in sweep.items()}})


def test_each_turns_one_knob_at_a_time() -> None:
    found = settings_of(config(fit__bases=[4, 16, 32], fit__space=["linear", "gamma"]))
    assert found[0].changes == {}, "the base comes first"
    assert [setting.changes for setting in found[1:]] == [{"fit.bases": 4}, {"fit.bases": 32}, {"fit.space": "gamma"}]


def test_a_grid_turns_all_together() -> None:
    base = config(fit__bases=[4, 16], fit__space=["linear", "gamma"])
    grid = base.model_copy(update={"bench": base.bench.model_copy(update={"combine": "grid"})})
    changes = [setting.changes for setting in settings_of(grid)]
    assert len(changes) == 4
    assert {"fit.bases": 4, "fit.space": "gamma"} in changes


def test_settings_that_share_a_dataset_stand_together() -> None:
    base = config(fit__bases=[4], transport__samples=[16, 32], fit__space=["gamma"], fit__points=[8])
    digests = [setting.bake_digest for setting in settings_of(base)]
    assert digests == sorted(digests, key=digests.index), "no dataset is left and come back to"
    assert len(set(digests)) == 3


@pytest.mark.parametrize(
    ("key", "value", "same"),
    [
        ("fit.bases", 3, True),
        ("points.quantity", "irradiance", True),
        ("transport.threads", 1, True),
        ("transport.test_samples", 64, True),
        ("lightings.test", 5, False),
        ("export.precision", "float", True),
        ("seed", 7, False),
        ("points.supersample", 2, False),
        ("lightings.train", 5, False),
        ("transport.target_noise", 0.5, False),
        ("atlas.resolution", 64, False),
        ("scene.name", "corridor", False),
        ("effects.on", ["gloss"], False),
        ("effects.off", ["gloss"], False),
    ],
)
def test_only_what_training_maps_depend_on_asks_for_another_bake(key: str, value: Any, same: bool) -> None:
    base, other = Setting({}, Config()), Setting({key: value}, changed(Config(), {key: value}))
    assert (base.bake_digest == other.bake_digest) == same
    assert base.digest != other.digest


def test_what_is_measured_does_not_change_what_a_setting_is() -> None:
    other = checked({"bench": {"repeats": 9}, "tune": {"max_frame_us": 3.0}, "report": {"rows": 2}})
    assert Setting({}, Config()).digest == Setting({}, other).digest


def test_names_and_files_round_trip(tmp_path: Any) -> None:
    (tmp_path / "a.toml").write_text('[sweep]\nfit.bases = [4, 8]\n"fit.ridge" = ["auto", 1e-3]\n')
    read = load_config(tmp_path / "a.toml")
    assert read.sweep == {"fit.bases": (4, 8), "fit.ridge": ("auto", 1e-3)}
    (tmp_path / "b.toml").write_text(read.to_toml())
    assert load_config(tmp_path / "b.toml") == read
    assert [setting.name for setting in settings_of(read)] == [
        "as configured",
        "fit.bases = 4",
        "fit.bases = 8",
        "fit.ridge = 0.001",
    ]


def test_command_lines_sweep_too() -> None:
    assert load_config(None, {"sweep.fit.bases": "[4, 8]"}).sweep == {"fit.bases": (4, 8)}
    with pytest.raises(UserError, match=r"--sweep: got 4, expected a list"):
        load_config(None, {"sweep": "{fit.bases = 4}"})


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        ({"fit.base": [1]}, 'got "fit.base", expected a setting of a run; did you mean "fit.bases"'),
        ({"fit.bases": 3}, r"sweep.fit.bases: got 3, expected a list of at least one value; write \[3\]"),
        ({"fit.bases": []}, r"expected a list of at least one value; write \[16\]"),
        ({"bench.repeats": [3]}, "expected a setting of a run"),
        ({"sweep": [3]}, "expected a setting of a run"),
    ],
)
def test_faulty_sweeps_are_refused(sweep: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        checked({"sweep": sweep})


def test_a_value_that_its_setting_does_not_take_is_refused() -> None:
    with pytest.raises(UserError, match=r"fit.bases: got 0"):
        settings_of(config(fit__bases=[0]))


def test_the_plan_of_our_own_holds_and_turns_every_kind_of_knob() -> None:
    plan = plan_of(Config())
    sections = {key.split(".")[0] for key in plan}
    assert sections == {"fit", "export", "lightings", "transport", "points", "atlas"}
    found = settings_of(Config())
    assert len({setting.digest for setting in found}) == len(found) > 30
    for key in plan:
        assert any(key in setting.changes for setting in found), key


def test_knobs_that_a_file_or_another_setting_overrules_are_not_in_the_plan() -> None:
    plan = plan_of(
        changed(
            Config(),
            {"lightings.file": "a.json", "points.file": "b.json", "transport.samples": 3, "transport.integrator": "paths"},
        )
    )
    assert not {"lightings.train", "points.supersample", "fit.points", "transport.target_noise"} & set(plan)
    assert plan["transport.samples"] == (1, 6)
    assert "transport.sender_resolution" not in plan
    assert "transport.samples" not in plan_of(Config())


@pytest.mark.parametrize("resolution", [40, 96, 100, 200, 256])
@pytest.mark.parametrize("asked", [0, 64, 96])
def test_senders_of_the_plan_are_all_others(resolution: int, asked: int) -> None:
    """A bake that cannot differ tells how noisy the clock is, and looks like a choice."""
    config = changed(Config(), {"atlas.resolution": resolution, "transport.sender_resolution": asked})
    scene = load_scene("furnace", subdivisions=1)
    tracer, atlas = Tracer.of(scene), build_atlas(scene, resolution)

    def block(side: int) -> int:
        return Operator.of(tracer, atlas, side).senders.block

    sides = plan_of(config).get("transport.sender_resolution", ())
    blocks = [block(side) for side in (asked, *sides)]
    assert len(set(blocks)) == len(blocks), "each is another"
    assert {block(side) for side in (32, 64, 128)} <= {*blocks}, "and none is missing"
    assert list(sides) == sorted(sides), "from coarse to fine"


def test_the_plan_stays_within_what_settings_take() -> None:
    for changes in ({"transport.target_noise": 1e-4}, {"transport.target_noise": 1.0}, {"transport.samples": 65536}):
        assert settings_of(changed(Config(), changes))


def test_a_grid_that_nobody_meant_is_refused_at_once() -> None:
    """The plan of our own in all combinations is some 10^7 settings."""
    base = changed(Config(), {"bench.combine": "grid"})
    with pytest.raises(UserError, match=r"\[sweep\]: got a grid of \d{7,} settings, expected at most 10000; name fewer"):
        settings_of(base)
    exact = base.model_copy(update={"sweep": {"seed": tuple(range(101)), "fit.points": tuple(range(100))}})
    with pytest.raises(UserError, match="got a grid of 10100 settings"):
        settings_of(exact)


def test_small_configurations_get_a_plan_that_can_be_baked() -> None:
    small = changed(Config(), {"lightings.train": 5, "points.count": 6, "atlas.resolution": 40})
    for setting in settings_of(small):
        assert setting.config.lightings.train >= 4
        assert setting.config.fit.points <= setting.config.points.count
        assert setting.config.atlas.resolution >= 20
