"""Trainings within `ddprt fit`: interrupted, changed, diverged, and what they leave."""

import html
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import SMALL, call

from ddprt.files import alone_in, read_tensors
from ddprt.methods.statuses import STATUSES
from ddprt.training import loop

LONG = {"steps": 20000, "check_every": 20, "width": 8, "depth": 1}
ROUNDS = 1000
HEARS = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let what they start in the background ignore it
from ddprt.cli import main
main(sys.argv[1:])
"""
MLP = "{" + ", ".join(f"{key} = {value}" for key, value in LONG.items()) + "}"
WORDS = ["--fit.method", "mlp", "--methods.compare", "[]", "--methods.settings.mlp", MLP]


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a job and its run, baked and not fitted."""
    folder = tmp_path_factory.mktemp("training")
    (folder / "job.toml").write_text(SMALL)
    assert call("bake", folder / "job.toml", "--out", folder / "run", "--quiet") == 0
    return folder


@pytest.fixture(scope="module")
def whole(baked: Path) -> Path:
    """The run of a fit that was not interrupted."""
    shutil.copytree(baked / "run", baked / "whole")
    assert call("fit", baked / "job.toml", "--out", baked / "whole", "--quiet", *WORDS) == 0
    return baked / "whole"


@pytest.fixture(scope="module")
def interrupted(baked: Path) -> Path:
    """The run of a process that Ctrl-C has stopped while it trained."""
    shutil.copytree(baked / "run", baked / "interrupted")
    words = ["fit", str(baked / "job.toml"), "--out", str(baked / "interrupted"), *WORDS, "--fit.checkpoint_seconds", "0.1"]
    process = subprocess.Popen([sys.executable, "-c", HEARS, *words], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (kept := baked / "interrupted" / "training" / "mlp" / "mlp.safetensors").exists() and time.monotonic() < deadline:
        assert process.poll() is None, process.stderr and process.stderr.read()
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "the same command goes on from there" in errors
    assert 0 < len(read_tensors(kept)["looks"]) < ROUNDS
    return baked / "interrupted"


def lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "training" / "mlp" / "mlp.jsonl").read_text().splitlines()]


def test_an_interrupted_fit_goes_on_to_the_same_bits(
    whole: Path, interrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command; every byte of the model is that of a fit which nobody stopped, and nothing is trained twice."""
    run = tmp_path / "run"
    shutil.copytree(interrupted, run)
    done = len(read_tensors(run / "training" / "mlp" / "mlp.safetensors")["looks"])
    before, counted, make = lines(run)[done - 1]["seconds"], [], loop._round
    monkeypatch.setattr(loop, "_round", lambda *arguments: counted.append(0) or make(*arguments))
    assert call("fit", interrupted.parent / "job.toml", "--out", run, *WORDS) == 0
    assert f"went_on_from_step {20 * done}," in capsys.readouterr().err
    assert len(counted) == ROUNDS - done
    for file in ("tensors.safetensors", "model.json"):
        assert (run / "model.ddprt" / file).read_bytes() == (whole / "model.ddprt" / file).read_bytes()
    ours, theirs = ([{**line, "seconds": 0, "steps_per_second": 0} for line in lines(each)] for each in (run, whole))
    assert ours == theirs
    assert [line["step"] for line in ours] == list(range(20, 20001, 20))
    seconds = np.array([line["seconds"] for line in lines(run)])
    assert (np.diff(seconds) >= 0).all(), "the clock goes on where the interrupted run stopped"
    assert seconds[done - 1] == before
    assert not list(run.glob("training/*/*.safetensors")), "what is saved as a model needs no checkpoint"


def test_changed_settings_train_anew_and_it_is_said(
    interrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, job = tmp_path / "run", interrupted.parent / "job.toml"
    shutil.copytree(interrupted, run)
    changed = [*WORDS[:-1], "{steps = 100, check_every = 20, width = 8, depth = 1, learning_rate = 1e-3}"]
    assert call("fit", job, "--out", run, *changed) == 0
    told = capsys.readouterr().err
    assert "mlp.safetensors: settings, data or seed are others than those of this checkpoint; trains anew" in told
    assert [line["step"] for line in lines(run)] == [20, 40, 60, 80, 100]
    assert call("fit", job, "--out", run, *changed) == 0
    assert "trains anew" not in capsys.readouterr().err, "a finished training leaves nothing in the way"


def test_what_cannot_be_fitted_is_told_before_anything_is(
    baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Settings of a method that there is not, and another process in the folder."""
    run, job = tmp_path / "run", baked / "job.toml"
    shutil.copytree(baked / "run", run)
    assert call("fit", job, "--out", run, "--methods.settings.neural_lightmap", "{steps = 3}") == 2
    assert 'ddprt: no method "neural_lightmap"; did you mean "neural-lightmap"?' in capsys.readouterr().err
    with alone_in(run):
        assert call("fit", job, "--out", run, *WORDS) == 2
    assert "another command is working in this folder" in capsys.readouterr().err
    assert not (run / "model.ddprt").exists()


def test_divergence_is_explained_wherever_a_result_is_told(
    baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On the terminal, in metrics.json, on the page and in the model; the lines have null where a number was not finite."""
    run = tmp_path / "run"
    shutil.copytree(baked / "run", run)
    huge = [*WORDS[:-1], "{steps = 100, check_every = 20, width = 8, depth = 1, learning_rate = 1e30}"]
    less = ["--report.spot_check_texels", "0", "--report.bases_curve", "[2]", "--report.rows", "1"]
    assert call("eval", baked / "job.toml", "--out", run, *huge, *less) == 0
    expected = re.compile(
        r"the (loss|gradient|validation loss) was not finite by step 20, at a learning rate of \d\S+e\+\d\d; "
        r"nothing was looked at before, a smaller check_every tells more; the parameters it began with are kept"
    )
    told = capsys.readouterr().err
    assert re.search(rf"mlp: {expected.pattern}", told)
    assert STATUSES["diverged"] in told
    score = json.loads((run / "metrics.json").read_text())["methods"]["mlp"]
    assert score["status"] == "diverged"
    assert expected.fullmatch(score["trouble"])
    report = json.loads((run / "model.ddprt" / "model.json").read_text(), parse_constant=pytest.fail)["report"]
    assert (report["status"], report["trouble"]) == ("diverged", score["trouble"])
    assert f"T{score['trouble'][1:]}. {STATUSES['diverged']}" in html.unescape((run / "report.html").read_text())
    (line,) = lines(run)
    assert None in (line["loss"], line["validation"], line["gradient"])
    # Worse is shown as it is: of the held-out light, not of a network that was trained again in secret.
    assert score["relative_rmse"] > 0.1


def test_event_files_are_asked_for_by_a_setting(baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their package is asked for before anything is trained."""
    import importlib.util

    if importlib.util.find_spec("tensorboardX"):
        pytest.skip("the package is here; tests/test_training.py looks at what is written")
    shutil.copytree(baked / "run", tmp_path / "run")
    assert call("fit", baked / "job.toml", "--out", tmp_path / "run", "--quiet", *WORDS, "--fit.tensorboard", "true") == 2
    assert "install ddprt[tensorboard]" in capsys.readouterr().err
    assert not (tmp_path / "run" / "training").exists()
