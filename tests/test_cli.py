"""The command line: exit codes, one-line errors, files where they are promised."""

import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddprt import cli
from ddprt.cli import LATER, VERBS, WHOLE, main, parse
from ddprt.config import keys, load_config
from ddprt.progress import Doubt
from ddprt.scene.exr import read_exr

SMALL = """
[scene]
name = "cornell"
[atlas]
resolution = 32
[lightings]
train = 6
validation = 2
test = 3
[points]
count = 8
supersample = 2
[transport]
samples = 16
test_samples = 32
[fit]
bases = 3
[methods]
compare = ["svd-ridge", "mean"]
[report]
rows = 1
bases_curve = [1, 2, 3]
spot_check_texels = 16
spot_check_lightings = 1
spot_check_samples = 16
"""


def call(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("job") / "job.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="module")
def done(job: Path) -> Path:
    assert call("run", job, "--out", job.parent / "run", "--quiet") == 0
    return job.parent / "run"


def test_run_leaves_what_is_promised(done: Path, job: Path) -> None:
    names = {path.name for path in done.iterdir()}
    assert names == {"config.toml", "run.json", "dataset", "model.ddprt", "metrics.json", "report.html", "export"}
    assert load_config(done / "config.toml") == load_config(job)
    metrics = json.loads((done / "metrics.json").read_text())
    assert metrics["schema"] == 1
    assert metrics["lightings"] == {"train": 6, "validation": 2, "test": 3}
    assert set(metrics["methods"]) == {"svd-ridge", "mean"}
    keys = "relative_rmse relative_mse psnr_db energy_bias median_lighting_relative_rmse p90_lighting_relative_rmse"
    keys += " worst_lighting_relative_rmse fit_seconds relight_seconds bytes bases status"
    assert set(keys.split()) <= set(metrics["methods"]["svd-ridge"])
    assert set(metrics["floors"]) == {"noise_relative_rmse", "projection_relative_rmse", "mean_relative_rmse"}
    numerics = "measurement_condition measurement_rank numerical_rank ridge ridge_chosen_by ridge_second_opinion leave_one_out"
    assert set(metrics["numerics"]) == set(numerics.split())
    assert set(metrics["trust"]) == {"spearman", "median_expected_error", "median_error", "flagged_share", "unseen"}
    assert all(isinstance(score["remarks"], list) for score in metrics["methods"].values())
    assert metrics["floors"]["projection_relative_rmse"] <= metrics["methods"]["svd-ridge"]["relative_rmse"]
    run = json.loads((done / "run.json").read_text())
    assert {"stages", "effects", "seed", "machine", "seconds"} <= set(run)
    bounces = run["effects"][0]
    assert bounces["name"] == "diffuse bounces"
    assert bounces["called"]
    assert bounces["rays"] > 0
    assert 0 < bounces["energy_share"] < 1
    assert sum(effect["energy_share"] for effect in run["effects"]) == pytest.approx(1)
    assert not any(effect["rays"] for effect in run["effects"] if not effect["called"])


def test_resolved_configuration_runs_again_without_baking(done: Path, capfd: pytest.CaptureFixture) -> None:
    before = {path: path.stat().st_mtime_ns for path in (done / "dataset").rglob("*") if path.is_file()}
    assert call("run", done / "config.toml") == 0
    assert {path: path.stat().st_mtime_ns for path in (done / "dataset").rglob("*") if path.is_file()} == before
    out = capfd.readouterr().out
    for name in ("report.html", "model.ddprt", "metrics.json", "export"):
        assert str(done / name) in out


def test_each_step_on_its_own(job: Path, tmp_path: Path) -> None:
    for verb in ("bake", "fit", "eval", "export"):
        assert call(verb, job, "--out", tmp_path / "run", "--quiet") == 0
    assert (tmp_path / "run" / "report.html").stat().st_size > 1000
    assert (tmp_path / "run" / "export" / "manifest.json").exists()
    assert call("verify", tmp_path / "run") == 0


def test_relight(done: Path, tmp_path: Path) -> None:
    lamp = {"type": "point", "position": [0.3, 0.4, 0.3], "intensity": [1, 1, 1]}
    assert call("relight", done / "model.ddprt", "--lighting", json.dumps([lamp]), "--out", tmp_path / "one.exr") == 0
    one = read_exr(tmp_path / "one.exr")[0]
    assert one.shape == (32, 32, 3)
    assert one.max() > 0
    (tmp_path / "two.json").write_text(json.dumps([[lamp], [{**lamp, "intensity": [2, 2, 2]}]]))
    assert call("relight", done, "--lighting", tmp_path / "two.json", "--out", tmp_path / "two.exr") == 0
    first, second = (read_exr(tmp_path / f"two_00{k}.exr")[0] for k in (0, 1))
    np.testing.assert_array_equal(first, one)
    np.testing.assert_allclose(second, 2 * one, rtol=1e-5, atol=1e-5 * one.max())


def test_inspect_and_doctor(capsys: pytest.CaptureFixture) -> None:
    assert call("inspect", "cornell", "--atlas.resolution", "64") == 0
    text = capsys.readouterr().out
    assert "30 triangles" in text
    assert "diffuse bounces: called for" in text
    assert "spot lights: left out" in text
    assert call("doctor") == 0
    assert "BROKEN" not in capsys.readouterr().out


FAULTS = {
    "unknown verb": (["rnu"], 'no verb "rnu"; did you mean "run"?'),
    "later verb": (["status", "x"], "not built yet"),
    "no file": (["run"], "got 0 files, expected a configuration"),
    "a scene for a configuration": (
        ["bake", "cornell"],
        "got the scene cornell, expected a configuration; write ddprt bake configs/cornell.toml --scene.name cornell",
    ),
    "a mesh for a configuration": (["run", "room.GLB"], "configs/cornell.toml --scene.name room.GLB"),
    "empty folder": (["run", "{job}", "--out", ""], "--out: got an empty value, expected DIR; give one or leave it out"),
    "empty folder after =": (["fit", "{job}", "--out="], "--out: got an empty value, expected DIR"),
    "unknown setting of bake": (["bake", "{job}", "--fit.basis", "3"], "`ddprt bake --help` lists all"),
    "missing file": (["run", "nothing.toml"], "expected a readable TOML file"),
    "unknown option": (
        ["run", "{job}", "--otu", "x"],
        'did you mean "out"? `ddprt run --help` lists all',
    ),
    "option like no other": (["run", "{job}", "--zzzz", "x"], "--zzzz: unknown option; `ddprt run --help` lists all"),
    "a sweep that is no table": (["bench", "{job}", "--sweep", "[4]"], "--sweep: got [4], expected dictionary"),
    "a knob without a list": (["bench", "{job}", "--sweep", "{{fit.bases = 4}}"], "--sweep: got 4, expected a list"),
    "option without value": (["run", "{job}", "--fit.bases"], "--fit.bases: got no value"),
    "unknown setting": (["run", "{job}", "--fit.basis", "3"], 'did you mean "fit.bases"?'),
    "wrong type": (["run", "{job}", "--fit.bases=x"], "--fit.bases: got 'x', expected integer"),
    "zero lightings": (["run", "{job}", "--lightings.train", "0"], "--lightings.train: got 0"),
    "unknown scene": (["run", "{job}", "--scene.name", "cornel"], 'did you mean "cornell"?'),
    "missing mesh": (["run", "{job}", "--scene.name", "room.glb"], "room.glb"),
    "unknown method": (["run", "{job}", "--fit.method", "svd"], 'no method "svd"'),
    "unknown method setting": (["run", "{job}", "--methods.settings.mlp", "{{stepz = 3}}"], 'did you mean "steps"?'),
    "too many points": (["run", "{job}", "--points.count", "60000"], "points.count: got 60000"),
    "too small an atlas": (["run", "{job}", "--atlas.resolution", "8"], "atlas.resolution: got 8"),
    "no free place": (["run", "{job}", "--lightings.clearance", "9"], "got no free position"),
    "folder in the way": (["run", "{job}", "--out", "{job}/below"], "cannot be made"),
    "fit without a bake": (["fit", "{job}", "--out", "{tmp}/none"], "got no dataset, expected a run folder"),
    "export without a model": (["export", "{job}", "--out", "{tmp}/none"], "expected a model folder"),
    "fit of another scene": (["fit", "{job}", "--out", "{run}", "--scene.name", "furnace"], 'got a dataset of scene "cornell"'),
    "bake over another": (["bake", "{job}", "--out", "{run}", "--seed", "7"], "holds another dataset"),
    "relight without a lighting": (["relight", "{run}/model.ddprt"], "got no --lighting"),
    "relight with a bad light": (
        ["relight", "{run}/model.ddprt", "--lighting", '[{{"type": "pint"}}]'],
        'did you mean "point"?',
    ),
    "relight to a PNG": (["relight", "{run}/model.ddprt", "--lighting", "[]", "--out", "a.png"], "ends in .exr"),
    "verify nothing": (["verify", "{tmp}/none"], "expected a dataset"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_one_line_and_exit_code_2(
    name: str, job: Path, done: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words, expected = FAULTS[name]
    before = {path: path.read_bytes() for path in done.rglob("*") if path.is_file()}
    assert call(*[word.format(job=job, run=done, tmp=tmp_path) for word in words]) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("ddprt: ")]
    assert len(lines) == 1, error
    assert "; " in lines[0] or "did you mean" in lines[0] or "known: " in lines[0], "what to do"
    assert expected in lines[0]
    assert "Traceback" not in error
    assert {path: path.read_bytes() for path in done.rglob("*") if path.is_file()} == before, "earlier results are untouched"


def test_our_own_fault_is_exit_code_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    import ddprt.pipeline_inspect as inspection

    monkeypatch.setattr(inspection, "checkup", lambda: 1 / 0)
    assert call("doctor") == 1
    assert "this is our fault" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError):
        main(["doctor", "--debug"])


def test_embreex_missing_is_said_plainly(tmp_path: Path) -> None:
    (tmp_path / "embreex").mkdir()
    (tmp_path / "embreex" / "__init__.py").write_text("raise ImportError('no embree here')")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    answer = subprocess.run(
        [sys.executable, "-m", "ddprt", "inspect", "cornell"], capture_output=True, text=True, env=environment, check=False
    )
    assert answer.returncode == 2
    assert answer.stderr.count("\n") == 1
    assert "embreex" in answer.stderr
    assert "pip install embreex" in answer.stderr


def test_help_is_whole_and_instant() -> None:
    """No timing here: what must not be imported is what would make it slow."""
    code = "import sys; from ddprt.cli import main\ntry: main(['--help'])\nexcept SystemExit: print(sorted(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(verb in answer.stdout for verb in VERBS)
    assert not LATER & set(VERBS)
    loaded = answer.stdout.rsplit("[", 1)[1]
    assert not any(f"'{name}'" in loaded for name in ("jax", "numpy", "pydantic", "tyro", "rich"))


def test_verb_help_lists_every_setting(capsys: pytest.CaptureFixture) -> None:
    from ddprt.config import keys

    assert call("run", "--help") == 0
    text = capsys.readouterr().out
    assert "--out" in text
    squeezed = "".join(text.split())
    assert [key for key in keys() if f"--{key.replace('_', '-')}" not in squeezed and f"--{key}" not in squeezed] == []


def test_help_says_what_a_verb_works_on(capsys: pytest.CaptureFixture) -> None:
    assert call("--help") == 0
    assert "usage: ddprt VERB FILE [" in capsys.readouterr().out
    for name, verb in VERBS.items():
        assert call(name, "--help") == 0
        text = capsys.readouterr().out
        assert text.startswith(f"ddprt {name} {verb.file}".rstrip() + ": ")
        assert "[FILE]" not in text
    assert call("bake", "--help") == 0
    squeezed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "for assets seen from outside" in squeezed
    assert "metres to keep from every surface, whatever the size of the scene" in squeezed


def test_more_bases_than_rank_is_a_warning(job: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert call("bake", job, "--out", tmp_path / "run", "--quiet") == 0
    assert call("fit", job, "--out", tmp_path / "run", "--fit.bases", "100") == 0
    assert "warning: fit.bases: asked for 100, the data has rank 18: 18 are given" in capsys.readouterr().err


DARK = {
    "no bounce": ["--transport.bounces", "0"],
    "lonely body": ["--scene.name", "convex", "--lightings.distribution", "around"],
    "points that see no light": ["--points.on", "hull"],
    "a network without light": ["--transport.bounces", "0", "--fit.method", "mlp"],
    "black room": [
        "--scene.name",
        "furnace",
        "--scene.parameters.albedo",
        "0",
        "--fit.centre",
        "mean",
        "--fit.channels",
        "multi",
    ],
}


@pytest.mark.parametrize("name", DARK)
def test_darkness_is_a_status_and_a_black_result(name: str, job: Path, tmp_path: Path) -> None:
    assert call("run", job, "--out", tmp_path / "run", "--quiet", *DARK[name]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    method = "mlp" if "mlp" in DARK[name] else "svd-ridge"
    assert metrics["methods"][method]["status"] == "no_signal"
    assert (tmp_path / "run" / "report.html").stat().st_size > 1000


def test_fewer_points_than_baked_and_what_is_refused(job: Path, done: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(done, tmp_path / "run")
    assert call("fit", job, "--out", tmp_path / "run", "--quiet", "--fit.points", "4") == 0
    assert call("run", tmp_path / "run" / "config.toml", "--quiet") == 0, "the configuration still fits the dataset"
    for change in (["--points.count", "4"], ["--seed", "3"], ["--transport.samples", "9"], ["--lightings.train", "3"]):
        assert call("fit", job, "--out", tmp_path / "run", "--quiet", *change) == 2


def test_a_lamp_that_lights_nothing_is_said(done: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    lamp = '{"type": "point", "position": [0, 9, 0], "intensity": [1, 1, 1]}'
    assert call("relight", done / "model.ddprt", "--lighting", lamp, "--out", tmp_path / "dark.exr") == 0
    assert "lights no measurement point" in capsys.readouterr().err


def test_export_leaves_no_stale_textures(job: Path, done: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(done, tmp_path / "run")
    for bases, count in (("9", 3), ("3", 1)):
        assert call("fit", job, "--out", tmp_path / "run", "--quiet", "--fit.bases", bases) == 0
        assert call("export", job, "--out", tmp_path / "run", "--quiet", "--fit.bases", bases) == 0
        assert len(list((tmp_path / "run" / "export").glob("basis_*.exr"))) == count


def test_heartbeat_without_a_terminal(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    from ddprt.progress import Progress

    clock = iter(range(0, 1000, 6))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    progress = Progress()
    with progress.stage("baking", 4) as stage:
        for _ in range(4):
            stage.advance()
    lines = capsys.readouterr().err.splitlines()
    assert any("baking: 2 of 4" in line and "s left" in line for line in lines)
    assert progress.stages[0]["name"] == "baking"


def test_neither_a_pilot_nor_what_was_found_done_sets_the_pace(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pilot of an hour, 500 steps that an earlier run left, then 11 s a step: 11 * 499 s are left after the first."""
    from ddprt.progress import Progress

    now = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    with Progress().stage("baking", 7) as stage:
        now += 3600
        stage.pace(1000)
        stage.advance(500, found=True)
        now += 11
        stage.advance()
    assert "baking: 501 of 1 k after 3611 s, about 5489 s left" in capsys.readouterr().err


def test_a_terminal_shows_the_same_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    """rich takes the first sample for the start: what was found must lie in it, and nothing else."""
    from rich.progress import Progress as Bar

    from ddprt.progress import Progress

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    seen: list[float] = []
    monkeypatch.setattr(Bar, "advance", lambda self, task, steps: seen.append(steps))
    with Progress().stage("baking", 7) as stage:
        stage.pace(1000)
        stage.advance(300, found=True)
        stage.advance(200, found=True)
        stage.advance(2)
        stage.advance(3)
        assert stage._live.tasks[0].total == 1000
        stage._live.tasks[0].total = 505
    assert seen == [502, 3]


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0"), (7, "7"), (999, "999"), (1000, "1 k"), (4096, "4.1 k"), (45056, "45 k"), (99_499, "99 k"), (314_159, "314 k"),
        (999_499, "999 k"), (999_500, "1 M"), (27e6, "27 M"), (1.5e9, "1.5 G"), (2e12, "2 T"), (3e16, "30000 T"),
    ],
)  # fmt: skip
def test_counts_are_told_in_the_unit_that_suits_them(count: float, text: str) -> None:
    from ddprt.progress import amount

    assert amount(count) == text


def mesh(path: Path, corners: list, faces: list) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f " + " ".join(str(corner + 1) for corner in face) for face in faces]
    path.write_text("\n".join(lines))
    return str(path)


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 0, -1), (0, 0, -1)]


def test_inspect_of_a_small_scene_counts_its_rays(capsys: pytest.CaptureFixture) -> None:
    assert call("inspect", "plates", "--atlas.resolution", "8", "--points.count", "8") == 0
    text = capsys.readouterr().out
    # 8 texels, 4 shadow rays on each, 176 lightings.
    assert "8 texels covered" in text
    assert "176 lightings: 5.6 k shadow rays per lamp" in text
    assert "(0 M)" not in text
    assert "points " not in text
    assert call("inspect", "plates", "--atlas.resolution", "8") == 0
    assert 'points      cannot be placed as configured: points.count: got 128, but "plates" covers 8' in capsys.readouterr().out


@pytest.mark.parametrize("source", ["convex", "sheet"])
def test_inspect_of_what_has_no_free_space_assumes_lamps_about_it(
    source: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    name = mesh(tmp_path / "sheet.obj", SQUARE, [(0, 1, 2, 3)]) if source == "sheet" else source
    assert call("inspect", name, "--atlas.resolution", "32") == 0
    text = capsys.readouterr().out
    assert 'set lightings.distribution = "around", as is assumed below' in text
    assert "point lights: called for: 8 of 8 lightings" in text
    assert "lower lightings.clearance" not in text


def test_inspect_tells_lamps_that_light_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A triangle's bounding box is flat: lamps in it stand in its plane."""
    name = mesh(tmp_path / "one.obj", SQUARE[:2] + SQUARE[3:], [(0, 1, 2)])
    assert call("inspect", name, "--atlas.resolution", "32") == 0
    assert "8 of 8 lightings light nothing; a bake where all do is refused; the first faces away" in capsys.readouterr().out
    assert call("inspect", "cornell", "--atlas.resolution", "32") == 0
    assert "light nothing" not in capsys.readouterr().out


def test_inspect_says_what_is_too_wide_a_berth(capsys: pytest.CaptureFixture) -> None:
    assert call("inspect", "cornell", "--atlas.resolution", "32", "--lightings.clearance", "9") == 0
    text = capsys.readouterr().out
    assert "lower lightings.clearance" in text
    assert "as is assumed below" not in text
    assert "point lights" not in text, "without a lighting nobody knows"


def test_inspect_looks_at_the_lightings_that_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    listed = tmp_path / "lights.json"
    listed.write_text(json.dumps([[{"type": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]}]]))
    assert call("inspect", "plates", "--atlas.resolution", "16", "--lightings.file", listed) == 0
    text = capsys.readouterr().out
    assert "directional lights: called for: 1 of 1 lightings" in text
    assert "point lights: left out" in text


WHITE = ["--scene.name", "furnace", "--scene.parameters.albedo", "1", "--scene.parameters.subdivisions", "2"]


def test_light_that_never_dies_is_said_once_even_when_quiet(job: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert call("bake", job, "--out", tmp_path / "run", "--quiet", *WHITE) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len([line for line in lines if line.startswith("warning: light was followed for 512 bounces")]) == 1, lines
    assert all(line.startswith("warning: ") for line in lines), "no progress, and no line of code"


def test_the_smallest_atlas_works_where_its_charts_fit(job: Path, tmp_path: Path) -> None:
    small = ["--scene.name", "plates", "--atlas.resolution", "8", "--quiet"]
    assert call("bake", job, "--out", tmp_path / "run", *small) == 0
    assert call("fit", job, "--out", tmp_path / "run", *small) == 0


def test_configuration_of_a_run_is_plain_toml(done: Path) -> None:
    document = tomllib.loads((done / "config.toml").read_text())
    assert document["fit"]["bases"] == 3


def test_an_error_that_an_interrupt_makes_is_an_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def interrupted(call: Any) -> None:
        try:
            raise KeyboardInterrupt
        finally:
            raise RuntimeError("cannot release un-acquired lock")

    def broken(call: Any) -> None:
        raise RuntimeError("cannot release un-acquired lock")

    for work, code, words in ((interrupted, 130, "goes on from there"), (broken, 1, "this is our fault")):
        monkeypatch.setitem(VERBS, "doctor", replace(VERBS["doctor"], work=work))
        with pytest.raises(SystemExit) as end:
            main(["doctor"])
        assert end.value.code == code
        assert words in capsys.readouterr().err


def test_an_interrupt_that_a_callback_drops_comes_again(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """Python ignores what a callback of its garbage collector raises; other errors there stay what they were."""
    ignored: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: ignored.append(dropped.exc_type))
    raised: list[type[BaseException]] = [KeyboardInterrupt, ValueError]

    def callback(phase: str, info: dict[str, int]) -> None:
        if raised:
            raise raised.pop()

    def work(call: Any) -> None:
        gc.callbacks.append(callback)
        try:
            gc.collect()
            assert not raised
            threading.Event().wait(60)  # a wait that only a signal ends early
            raise AssertionError("no interrupt came")
        finally:
            gc.callbacks.remove(callback)

    monkeypatch.setitem(VERBS, "doctor", replace(VERBS["doctor"], work=work))
    as_before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a runner of tests may ignore it
    begun = time.perf_counter()
    try:
        with pytest.raises(SystemExit) as end:
            main(["doctor"])
    finally:
        signal.signal(signal.SIGINT, as_before)
    assert end.value.code == 130
    assert time.perf_counter() - begun < 40, "the wait was woken"
    assert "goes on from there" in capsys.readouterr().err
    assert ignored == [ValueError]


def test_settings_in_no_section_are_options_of_their_own() -> None:
    """As they are named where an option is unknown."""
    assert {*WHOLE} == {key for key in keys() if "." not in key}
    call = parse("bench", ["job.toml", "--sweep", "{fit.bases = [4, 8], fit.space = ['gamma']}", "--seed=3"])
    assert call.files == ["job.toml"]
    config = load_config(None, call.overrides)
    assert config.sweep == {"fit.bases": (4, 8), "fit.space": ("gamma",)}
    assert config.seed == 3


def test_a_doubt_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    with cli._doubts_in_one_line():
        for words in ("one", "two", "one"):
            warnings.warn(words, Doubt, stacklevel=1)
    assert capsys.readouterr().err == "warning: one\nwarning: two\n"
