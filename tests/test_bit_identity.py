"""Equal seeds give equal bits, from bake to relight and export, whatever the number of threads.

What may differ is named here: seconds, and the files that tell of one run on one machine.
"""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddprt.config import Config, load_config
from ddprt.pipeline import Run
from ddprt.progress import Stage

OF_ONE_RUN = ("config.toml", "run.json", "report.html")
"""They name the threads, the seconds and the machine."""
LAMPS = [
    {"type": "point", "position": [0.2, 0.4, 0.3], "intensity": [3.0, 1.0, 0.1]},
    {"type": "sphere", "center": [0.4, 0.5, 0.1], "radius": 0.05, "radiance": [1.0, 2.0, 3.0]},
]
SMALL: dict[str, dict[str, Any]] = {
    "atlas": {"resolution": 32},
    "lightings": {"train": 5, "validation": 2, "test": 2, "kinds": ["point", "rect"]},
    "points": {"count": 8, "supersample": 2},
    "transport": {"samples": "auto", "test_samples": 32, "target_noise": 0.2, "direct_samples": 2},
    "fit": {"bases": 3},
    "methods": {"compare": ["svd-ridge", "mean"]},
    "report": {"bases_curve": [1, 3], "spot_check_texels": 16, "spot_check_lightings": 1, "spot_check_samples": 16},
}
INTEGRATORS = {"operator": "auto", "paths": "auto", "reference": 4}
"""And their samples: the reference has no target for its noise."""


def by(integrator: str, threads: int) -> Config:
    return configured(transport={"integrator": integrator, "threads": threads, "samples": INTEGRATORS[integrator]})


def configured(**changes: dict[str, Any]) -> Config:
    return Config.model_validate({key: {**SMALL.get(key, {}), **changes.get(key, {})} for key in {*SMALL, *changes}})


def chain(config: Config, folder: Path) -> None:
    """Everything but the page, which tells the time; relit maps beside the rest."""
    run = Run(config, folder, quiet=True)
    data = run.bake()
    models, seconds = run.fit(data)
    run.evaluate(data, models, seconds)
    model = models["svd-ridge"]
    run.export(model)
    np.save(folder / "relit.npy", np.stack([model.relight(lamp) for lamp in [*LAMPS, LAMPS]]))


def fingerprint(folder: Path) -> dict[str, str]:
    """sha256 of every file that equal seeds must make equal; of metrics without seconds."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and name not in OF_ONE_RUN:
            content = path.read_bytes()
            if path.name == "metrics.json":
                content = json.dumps(_without_seconds(json.loads(content))).encode()
            if path.name == "manifest.jsonl":  # what is made again stands further down
                content = b"".join(sorted(content.splitlines(keepends=True)))
            found[name] = hashlib.sha256(content).hexdigest()
    return found


def of_dataset(whole: dict[str, str]) -> dict[str, str]:
    return {name.removeprefix("dataset/"): digest for name, digest in whole.items() if name.startswith("dataset/")}


def differing(one: dict[str, str], other: dict[str, str]) -> list[str]:
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def _without_seconds(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_seconds(part) for key, part in value.items() if not key.endswith("seconds")}
    return [_without_seconds(part) for part in value] if isinstance(value, list) else value


@pytest.fixture(scope="module")
def by_one_thread(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, dict[str, str]]]:
    """Fingerprints of the whole chain on one thread, per integrator, made when they are first asked for."""

    class Made(dict[str, dict[str, str]]):
        def __missing__(self, integrator: str) -> dict[str, str]:
            folder = tmp_path_factory.mktemp(integrator)
            chain(by(integrator, 1), folder)
            self[integrator] = fingerprint(folder)
            return self[integrator]

    return Made()


def test_the_chain_leaves_what_is_compared(by_one_thread: dict[str, dict[str, str]]) -> None:
    names = set(by_one_thread["operator"])
    assert {"metrics.json", "relit.npy", "model.ddprt/tensors.safetensors", "dataset/points.safetensors"} <= names
    for kind, count in (("direct", 9), ("indirect", 9), ("measured", 9), ("noise", 2)):
        assert sum(name.startswith(f"dataset/{kind}/") for name in names) == count
    assert any(name.startswith("export/") and name.endswith(".exr") for name in names)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_whole_chain_on_three_threads(integrator: str, by_one_thread: dict[str, dict[str, str]], tmp_path: Path) -> None:
    chain(by(integrator, 3), tmp_path)
    assert differing(fingerprint(tmp_path), by_one_thread[integrator]) == []


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_bake_on_two_threads(integrator: str, by_one_thread: dict[str, dict[str, str]], tmp_path: Path) -> None:
    Run(by(integrator, 2), tmp_path, quiet=True).bake()
    assert differing(fingerprint(tmp_path / "dataset"), of_dataset(by_one_thread[integrator])) == []


def test_another_seed_changes_the_light(by_one_thread: dict[str, dict[str, str]], tmp_path: Path) -> None:
    chain(configured().model_copy(update={"seed": 1}), tmp_path)
    changed = differing(fingerprint(tmp_path), by_one_thread["operator"])
    assert {"relit.npy", "metrics.json", "dataset/indirect/000000.exr", "dataset/points.safetensors"} <= set(changed)


@pytest.mark.parametrize("stop", [2, 6, 11])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_bake_that_was_stopped(
    integrator: str, stop: int, by_one_thread: dict[str, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among the direct maps or the indirect ones, and gone on with by another number of threads."""
    steps, advance = iter(range(stop)), Stage.advance

    def stopped(stage: Stage, *arguments: Any, **named: Any) -> None:
        if next(steps, None) is None:
            raise KeyboardInterrupt
        advance(stage, *arguments, **named)

    with monkeypatch.context() as patch:
        patch.setattr(Stage, "advance", stopped)
        with pytest.raises(KeyboardInterrupt):
            Run(by(integrator, 1), tmp_path, quiet=True).bake()
    assert not (tmp_path / "dataset" / "noise" / "000008.exr").exists()
    Run(by(integrator, 3), tmp_path, quiet=True).bake()
    assert differing(fingerprint(tmp_path / "dataset"), of_dataset(by_one_thread[integrator])) == []


def test_clocks_and_caches_choose_nothing(
    by_one_thread: dict[str, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine on which every look at the clock takes an hour, and that never unwrapped the scene."""
    import time

    hours = iter(range(0, 3_600_000_000, 3600))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(hours)))
    monkeypatch.setenv("DDPRT_CACHE", str(tmp_path / "cache"))
    chain(configured(), tmp_path / "run")
    assert differing(fingerprint(tmp_path / "run"), by_one_thread["operator"]) == []


LIBRARIES: dict[str, dict[str, str]] = {
    "blas": {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    "xla": {"NPROC": "1"},
    "one core": {"CORES": "1"},
}
"""What sets the threads of NumPy's and SciPy's BLAS, of XLA's pool (that is the name it reads), and of all at once."""

CHILD = """
import os, sys
if os.environ.get("CORES") == "1":
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
sys.path.insert(0, os.path.dirname(sys.argv[1]))
from pathlib import Path
from test_bit_identity import chain
from ddprt.config import load_config
chain(load_config(sys.argv[2]), Path(sys.argv[3]))
"""


def in_a_process(config: Config, folder: Path, **environment: str) -> dict[str, str]:
    """The fingerprint of a chain that another process makes, with threads of libraries as its environment says."""
    job = folder.with_suffix(".toml")
    job.write_text(config.to_toml())
    assert load_config(job) == config
    command = [sys.executable, "-c", CHILD, __file__, str(job), str(folder)]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return fingerprint(folder)


@pytest.fixture(scope="module")
def large() -> Config:
    """Large enough that libraries share the work out: bounces between 2,500 blocks, 288 columns of a Gram matrix."""
    return configured(
        atlas={"resolution": 64},
        lightings={"train": 96},
        points={"count": 128, "supersample": 4},
        transport={"samples": 8, "test_samples": 8},
        fit={"bases": 16},
    )


@pytest.fixture(scope="module")
def with_all_threads(large: Config, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return in_a_process(large, tmp_path_factory.mktemp("all") / "run", PYTHONHASHSEED="1")


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARIES)
def test_threads_of_libraries(name: str, large: Config, with_all_threads: dict[str, str], tmp_path: Path) -> None:
    found = in_a_process(large, tmp_path / "run", PYTHONHASHSEED="2", **LIBRARIES[name])
    assert differing(found, with_all_threads) == []
