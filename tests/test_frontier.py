"""Sweeps: what is tried, what is noted, and how one that was stopped goes on."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from small_job import SMALL, base, call

from ddprt.bench.frontier.sweep import RESULTS, read_results, sweep
from ddprt.bench.measure import trial
from ddprt.bench.measure.settings import settings_of
from ddprt.bench.measure.trial import Workshop
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.files import alone_in
from ddprt.progress import Progress

SWEEP = {
    "fit.bases": (2, 400),
    "fit.method": ("mlp", "nearest"),
    "points.count": (5000,),
    "points.choose": ("qr",),
    "lightings.choose": ("active",),
    "scene.name": ("plates",),
}
FAIL = {"points.count", "scene.name"}


def quiet(config: Config, folder: Path) -> list[Path]:
    return sweep(config, folder, Progress(quiet=True))


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], list[Path]]:
    """A sweep's folder, the datasets that it baked in their order, and what it gave back."""
    folder, baked = tmp_path_factory.mktemp("sweep"), []
    real = trial.bake

    def counting(*arguments: Any, out: Path, **more: Any) -> Any:
        baked.append(out.name)
        return real(*arguments, out=out, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trial, "bake", counting)
        files = quiet(base(sweep=SWEEP), folder)
    return folder, baked, files


@pytest.fixture
def again(swept: tuple[Path, list[str], list[Path]], tmp_path: Path) -> Path:
    """The results of that sweep, in a folder where they may be spoilt."""
    (tmp_path / RESULTS).write_bytes((swept[0] / RESULTS).read_bytes())
    return tmp_path


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch, swept: tuple[Path, list[str], list[Path]]) -> list[str]:
    """Names of settings that are measured; nothing is baked, the record of the sweep comes back."""
    names: list[str] = []
    records = read_results(swept[0] / RESULTS)

    def note(shop: Workshop, setting: Any) -> dict[str, Any]:
        names.append(setting.name)
        if records[setting.digest]["failed"]:
            raise UserError(records[setting.digest]["failed"])
        return records[setting.digest]

    monkeypatch.setattr(Workshop, "measure", note)
    monkeypatch.setattr(Workshop, "yardstick", None)
    return names


FAILING = ["points.count = 5000", "scene.name = plates"]


@pytest.mark.slow
def test_every_setting_is_noted_once(swept: tuple[Path, list[str], list[Path]]) -> None:
    lines = [json.loads(line) for line in (swept[0] / RESULTS).read_text().splitlines()]
    settings = settings_of(base(sweep=SWEEP))
    assert [line["digest"] for line in lines] == [setting.digest for setting in settings]
    assert len(lines) == 1 + sum(map(len, SWEEP.values()))
    for line in lines:
        assert bool(line["failed"]) == bool(set(line["changes"]) & FAIL), line["failed"]


@pytest.mark.slow
def test_reasons_of_failures_are_kept(swept: tuple[Path, list[str], list[Path]]) -> None:
    failed = {record["name"]: record["failed"] for record in read_results(swept[0] / RESULTS).values() if record["failed"]}
    assert sorted(failed) == FAILING
    assert "expected that of the configuration" in failed["scene.name = plates"]
    assert 'points.count: got 5000, but "cornell" covers' in failed["points.count = 5000"]


@pytest.mark.slow
def test_bases_beyond_the_rank_are_no_failure(swept: tuple[Path, list[str], list[Path]]) -> None:
    found = {record["name"]: record for record in read_results(swept[0] / RESULTS).values()}
    many = found["fit.bases = 400"]
    assert many["bases"] <= 3 * 8, "a lighting gives a column per channel"
    assert many["scores"]["relative_rmse"] <= found["fit.bases = 2"]["scores"]["relative_rmse"]
    assert found["fit.method = nearest"]["coefficients"] is None


@pytest.mark.slow
def test_equal_datasets_are_baked_once_and_go_afterwards(swept: tuple[Path, list[str], list[Path]]) -> None:
    folder, baked, files = swept
    settings = settings_of(base(sweep=SWEEP))
    fails_before = {setting.bake_digest for setting in settings if "scene.name" in setting.changes}
    assert sorted(baked) == sorted({setting.bake_digest for setting in settings} - fails_before)
    assert sorted(path.name for path in folder.iterdir() if path.is_dir()) == [
        f"truth-{Workshop(base(), folder, Progress(quiet=True)).truth}"
    ], "the truth alone stays, for a sweep that goes on"
    assert all(path.is_file() for path in files)
    assert files[0] == folder / RESULTS


def test_kept_datasets_stay(tmp_path: Path) -> None:
    config = base(sweep={"fit.bases": (2,)}, bench__keep=True)
    quiet(config, tmp_path)
    assert [path.name for path in (tmp_path / "datasets").iterdir()] == [settings_of(config)[0].bake_digest]


@pytest.mark.slow
def test_nothing_is_measured_twice(again: Path, measured: list[str]) -> None:
    quiet(base(sweep=SWEEP), again)
    assert sorted(measured) == FAILING, "only what failed is tried again"


@pytest.mark.slow
def test_a_sweep_of_more_repeats_is_measured_anew(again: Path, measured: list[str]) -> None:
    quiet(base(sweep={"fit.bases": (2,)}, bench__repeats=2), again)
    assert measured == ["as configured", "fit.bases = 2"]


@pytest.mark.slow
def test_other_sweeps_find_theirs(again: Path, measured: list[str]) -> None:
    quiet(base(sweep={"fit.bases": (2,)}), again)
    assert measured == []
    rows = (again / "frontier.csv").read_text().splitlines()
    assert len(rows) == 1 + 2, "what is drawn is what was asked for"


def edited(path: Path, name: str, change: Callable[[dict[str, Any]], Any]) -> None:
    records = [json.loads(line) for line in path.read_text().splitlines()]
    for record in records:
        if record["name"] == name:
            change(record)  # which may take its name
    path.write_text("".join(json.dumps(record) + "\n" for record in records))


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        lambda record: record["environment"]["machine"].update(processor="another"),
        lambda record: record["environment"].update(ddprt="0.0.0"),
        lambda record: record.update(truth="another"),
        lambda record: record.update(sources="others"),
        lambda record: record.update(schema=0),
        lambda record: record.pop("failed"),
        lambda record: record.pop("environment"),
        lambda record: record["environment"].pop("when"),
        lambda record: record["environment"].update(machine="this one"),
        lambda record: record["environment"]["machine"].update(packages=["numpy"]),
        lambda record: record.update(scores="nine"),
        lambda record: record["scores"].update(relative_rmse="nine"),
        lambda record: record["scores"].pop("relative_rmse"),
        lambda record: record.update(bake=[1.0]),
        lambda record: record.pop("bytes"),
        lambda record: record.pop("config"),
        lambda record: record.update(changes="fit.bases"),
        lambda record: record.update(remarks="none"),
        lambda record: record.update(remarks=[{}, {}]),
        lambda record: record.pop("name"),
        lambda record: record.update(repeats="many"),
    ],
    ids=[
        *("machine", "version", "truth", "files", "schema", "no outcome", "no surroundings", "no date", "no machine"),
        *("no packages", "no scores", "score in words", "no score", "no bake", "no bytes", "no configuration", "no changes"),
        *("no remarks", "no words", "no name", "repeats in words"),
    ],
)
def test_what_does_not_compare_is_measured_anew(again: Path, measured: list[str], change: Any) -> None:
    edited(again / RESULTS, "fit.bases = 2", change)
    quiet(base(sweep=SWEEP), again)
    assert sorted(measured) == sorted(["fit.bases = 2", *FAILING])
    assert not read_results(again / RESULTS)[settings_of(base(sweep=SWEEP))[1].digest]["failed"], "the last one counts"


@pytest.mark.slow
def test_a_finer_atlas_has_all_scored_on_its_truth(again: Path, measured: list[str]) -> None:
    with pytest.raises(KeyError):  # the finer setting itself is not in the sweep that stands in for measuring
        quiet(base(sweep={"fit.bases": (2,), "atlas.resolution": (48,)}), again)
    assert measured[:2] == ["as configured", "fit.bases = 2"]


@pytest.mark.slow
@pytest.mark.parametrize("cut", [1, 40, -1])
def test_a_line_that_was_cut_is_measured_anew(again: Path, measured: list[str], cut: int) -> None:
    path = again / RESULTS
    *whole, last = path.read_bytes().splitlines(keepends=True)
    lost = json.loads(last)["name"]
    path.write_bytes(b"".join(whole) + last[: cut if cut > 0 else len(last) // 2])
    quiet(base(sweep=SWEEP), again)
    assert sorted(measured) == sorted({lost, *FAILING})
    kept = path.read_bytes().splitlines(keepends=True)
    assert kept[: len(whole)] == whole, "nothing that was there is lost"
    assert len(read_results(path)) == len(whole) + 1


@pytest.mark.slow
@pytest.mark.parametrize("text", ["null", "[]", '"digest"', "{}", '{"digest": []}', '{"digest": "x"', "\x00", "[" * 10**5])
def test_lines_that_are_no_records_are_passed_over_and_counted(
    again: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = again / RESULTS
    first, *more, last = path.read_text().splitlines()
    path.write_text("\n".join([first, *more, last]) + "\n")
    whole = read_results(path, Progress())
    assert capsys.readouterr().err == "", "nothing is said where nothing is left out"
    path.write_text("\n".join([first, text, *more, last]) + "\n")
    assert read_results(path, Progress()) == whole
    assert capsys.readouterr().err == f"{RESULTS}: {len(whole)} of {len(whole) + 1} lines are whole; the others do not count\n"


@pytest.mark.slow
def test_a_sweep_says_how_many_lines_do_not_count(again: Path, measured: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    edited(again / RESULTS, "fit.bases = 2", lambda record: record.pop("environment"))
    sweep(base(sweep={"fit.bases": (2,)}), again, Progress())
    assert "lines are whole; the others do not count" in capsys.readouterr().err
    assert measured == ["fit.bases = 2"]


def test_results_that_cannot_be_read_are_told_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / RESULTS).write_bytes(b"\xff\xfe\n")
    with pytest.raises(UserError, match=r"results.jsonl: cannot be read .*; save it as UTF-8, or delete it"):
        quiet(base(), tmp_path)
    assert (tmp_path / RESULTS).read_bytes() == b"\xff\xfe\n"


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_what_it_has(again: Path, measured: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    (again / RESULTS).unlink()
    note = Workshop.measure

    def stop_at_third(shop: Workshop, setting: Any) -> dict[str, Any]:
        if len(measured) == 2:
            raise KeyboardInterrupt
        return note(shop, setting)

    monkeypatch.setattr(Workshop, "measure", stop_at_third)
    with pytest.raises(KeyboardInterrupt):
        quiet(base(sweep=SWEEP), again)
    first = list(measured)
    assert len(read_results(again / RESULTS)) == 2
    monkeypatch.setattr(Workshop, "measure", note)
    quiet(base(sweep=SWEEP), again)
    assert len(measured) == len(set(measured)) == len(settings_of(base(sweep=SWEEP)))
    assert measured[:2] == first


@pytest.mark.slow
def test_too_little_memory_is_a_failure_like_others(again: Path, measured: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    edited(again / RESULTS, "fit.bases = 2", lambda record: record.update(schema=0))

    def greedy(*_: Any) -> None:
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.setattr(Workshop, "measure", greedy)
    quiet(base(sweep={"fit.bases": (2,)}), again)
    (failed,) = [record["failed"] for record in read_results(again / RESULTS).values() if record["name"] == "fit.bases = 2"]
    assert failed == "got too little memory, expected enough for this setting; lower it"


@pytest.mark.slow
def test_two_sweeps_at_once_are_one_too_many(again: Path, measured: list[str]) -> None:
    with alone_in(again), pytest.raises(UserError, match="working in this folder; wait for it"):
        quiet(base(sweep=SWEEP), again)
    assert measured == []


def test_all_failing_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    words = ["--out", tmp_path / "run", "--points.count", "5000", "--sweep.fit.bases", "[2]", "--quiet"]
    assert call("bench", job, *words) == 2
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        "ddprt: sweep: got no setting that works, expected one at least; the first says: points.count: got 5000, but "
        '"cornell" covers 282 texels; lower points.count or raise atlas.resolution'
    ]
    assert len(read_results(tmp_path / "run" / "bench" / RESULTS)) == 2


def test_the_command_line_sweeps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    assert call("bench", job, "--out", tmp_path / "run", "--sweep.fit.bases", "[2, 3]") == 0
    said = capsys.readouterr()
    assert [line.split(":")[0] for line in said.out.splitlines()] == ["results", "page", "figures"]
    assert "1 of 3: as configured: error 0." in said.err
    assert "3 of 3: fit.bases = 3: error 0." in said.err
    assert (tmp_path / "run" / "bench" / "frontier.html").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--quick"], "--quick: got no --peers"),
        (["--sweep.fit.bases", "4"], "--sweep.fit.bases: got 4, expected a list of at least one value; write [4]"),
        (["--sweep.fit.bases", "[4,"], "--sweep.fit.bases: got '[4,', expected a list of at least one value; write [4]"),
        (["--sweep.fit.bases", "4, 8]"], "got '4, 8]', expected a list of at least one value; write [4, 8]"),
        (["--sweep.fit.bases", "[]"], "--sweep.fit.bases: got [], expected a list of at least one value; write [16]"),
        (["--sweep.fit.bases", "["], "got '[', expected a list of at least one value; write [16]"),
        (["--sweep.fit.method", "['mlp"], 'expected a list of at least one value; write ["mlp"]'),
        (["--sweep.fit.bases", "['x']"], "fit.bases: got 'x', expected integer"),
        (["--sweep.fit.basis", "[4]"], 'got "fit.basis", expected a setting of a run; did you mean "fit.bases"?'),
        (["--bench.repeats", "0"], "--bench.repeats: got 0"),
        (["--bench.combine", "all"], "--bench.combine: got"),
        (["--bench.combine", "grid"], "[sweep]: got a grid of"),
        (["--bench.path_frames", "2"], "bench.path_frames: got 2, expected 0 or at least 3"),
        (["--fit.method", "svd"], 'no method "svd"; did you mean'),
        (["--lightings.target_error", "0.1"], "lightings.target_error: got 0.1, expected 0"),
    ],
)
def test_wrong_words_are_one_line(words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    assert call("bench", job, "--out", tmp_path / "run", "--quiet", *words) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert message in said[0]
    assert not (tmp_path / "run" / "bench" / RESULTS).exists()


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    assert call("bench", job, "--out", job / "below", "--quiet") == 2
    assert "folder cannot be made" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"scene__name": "furnace", "scene__parameters": {"subdivisions": 2}},
        {"scene__name": "statue", "scene__parameters": {"subdivisions": 2}, "lightings__distribution": "around"},
        {"scene__name": "corridor"},
        {"lightings__choose": "active", "points__choose": "qr"},
        {"transport__integrator": "reference", "bench__path_frames": 6},
        {"transport__integrator": "paths"},
    ],
    ids=["furnace", "statue", "corridor", "chosen", "reference", "paths"],
)
def test_other_scenes_and_ways_are_swept(changes: dict[str, Any], tmp_path: Path) -> None:
    quiet(base(**changes, sweep={"fit.bases": (2,)}), tmp_path)
    for record in read_results(tmp_path / RESULTS).values():
        assert not record["failed"]
        # A few noisy maps may do worse than black, which has about 1; a scale that is off by the lamps' would have far more.
        assert 0 < record["scores"]["relative_rmse"] < 10


@pytest.mark.slow
def test_listed_lightings_are_swept_and_a_changed_list_is_measured_anew(tmp_path: Path) -> None:
    places = [[0.15 + 0.04 * i, 0.45, 0.2 + 0.02 * i] for i in range(7)]
    listed = tmp_path / "lightings.json"

    def write(strength: float) -> None:
        lamps = [[{"type": "point", "position": place, "intensity": [strength] * 3}] for place in places]
        listed.write_text(json.dumps(lamps))

    counts = {"lightings__file": str(listed), "lightings__train": 4, "lightings__validation": 1, "lightings__test": 2}
    config = base(**counts, sweep={"fit.bases": (2,), "lightings.train": (5,)})
    for strength in (1.0, 2.0):
        write(strength)
        quiet(config, tmp_path / "run")
    records = [json.loads(line) for line in (tmp_path / "run" / RESULTS).read_text().splitlines()]
    assert len({record["truth"] for record in records if not record["failed"]}) == 2
    failed = {record["failed"] for record in records if record["failed"]}
    assert len(failed) == 1
    assert "got 7 lightings, expected 8" in failed.pop()


@pytest.mark.slow
def test_a_killed_sweep_goes_on(tmp_path: Path) -> None:
    """Killed without warning after its first setting, interrupted after another one, then run to its end."""
    job, results = tmp_path / "job.toml", tmp_path / "run" / "bench" / RESULTS
    job.write_text(SMALL)
    words = ["bench", str(job), "--out", str(tmp_path / "run"), "--sweep.seed", "[1, 2, 3]", "--sweep.fit.bases", "[2]"]
    command = [sys.executable, "-m", "ddprt", *words]

    def stopped(how: signal.Signals, after: int) -> int:
        heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # shells let what they start in the background ignore it
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, preexec_fn=heard)
        patience = time.monotonic() + 120
        while (not results.exists() or len(results.read_text().splitlines()) < after) and time.monotonic() < patience:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(how)
        return process.wait(60)

    assert stopped(signal.SIGKILL, 1) == -signal.SIGKILL
    assert stopped(signal.SIGINT, len(results.read_text().splitlines()) + 1) == 130
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.startswith("results:")
    names = [json.loads(line)["name"] for line in results.read_text().splitlines()]
    assert sorted(names) == ["as configured", "fit.bases = 2", "seed = 1", "seed = 2", "seed = 3"]
    assert not (results.parent / "datasets").exists()
