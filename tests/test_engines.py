"""Folders of engines: one file that all load, the C runtime against `predict`, and files that are damaged."""

import json
import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_rivals import SHAPE, TEXELS, model_of, relighters

from ddprt.errors import UserError
from ddprt.export.deployed import export_model
from ddprt.export.engines.engine import HERE
from ddprt.export.engines.listing import ENGINES
from ddprt.export.engines.packed import Packed
from ddprt.export.golden import example_values
from ddprt.runtime.model import Model
from ddprt.sampling.points import Samples
from ddprt.scene.fog import Fog
from ddprt.sections import ExportConfig

COMPILER = shutil.which("gcc") or shutil.which("clang")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O1")
SAFE = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs gcc or clang on the path")

CASES: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "plain": ("plain", "mono", "linear", {}),
    "mean in gamma": ("linear", "mono", "gamma", {}),
    "colours": ("linear", "multi", "linear", {}),
    "colours that glow, in gamma": (
        "linear",
        "multi",
        "gamma",
        {
            "constant": np.random.default_rng(2).random((TEXELS, 3)).astype(np.float32),
            "exitant": np.arange(TEXELS) % 3 == 0,
        },
    ),
}


def crowded(samples: Samples) -> Samples:
    """With two more near the fourth point and one near the sixth."""
    extra = [3, 3, 5]
    parts = {
        name: np.concatenate([rows, rows[extra] + 1e-3]) for name in ("position", "normal") for rows in [getattr(samples, name)]
    }
    return replace(samples, albedo=np.concatenate([samples.albedo, [[0.1] * 3, [0.9] * 3, [0.3] * 3]]), **parts)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Model, Path]]:
    """A model and its export for all engines, made once."""
    kept: dict[str, tuple[Model, Path]] = {}

    def make(case: str) -> tuple[Model, Path]:
        if case not in kept:
            kind, channels, space, more = CASES[case]
            model = model_of(relighters(3, 3 if channels == "mono" else 1)[kind], channels, space, **more)
            model = replace(model, samples=crowded(model.samples))
            folder = tmp_path_factory.mktemp("engines")
            export_model(model, folder, precision="float", engines=list(ENGINES), stitch=False, gutter=2)
            kept[case] = model, folder
        return kept[case]

    return make


@pytest.fixture(scope="module")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tests/runtime_probe.c with the sanitizers on."""
    out = tmp_path_factory.mktemp("built") / "probe"
    source = Path(__file__).with_name("runtime_probe.c")
    done = subprocess.run(
        [str(COMPILER), *STRICT, *SAFE, f"-I{HERE / 'c'}", str(source), "-o", str(out), "-lm"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out


def close(found: np.ndarray, expected: np.ndarray, relative: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * float(np.abs(expected).max()))


@pytest.mark.parametrize("case", CASES)
def test_what_is_packed_answers_as_the_model(case: str, made: Callable[[str], tuple[Model, Path]]) -> None:
    """To the rounding of halves, of which a power by gamma makes that many times as much."""
    model, folder = made(case)
    packed, values = Packed.read(folder), example_values(model)
    light = packed.light(packed.rows(*packed.frame(values)), np.argwhere(model.covered))
    close(light, model.predict(values), 4e-3)
    assert packed.mono == (model.encoding.channels == "mono")
    golden = json.loads((folder / "c" / "golden.json").read_text())
    close(np.array(golden["light"]), model.image(model.predict(values))[tuple(np.transpose(golden["texels"]))], 4e-3)
    assert len(golden["texels"]) == 5
    head = struct.unpack("<8s8I2f", (folder / "c" / "model.bin").read_bytes()[:48])
    assert head[:3] == (b"ddprt001", SHAPE[1], SHAPE[0])
    assert head[8] == (1 if "constant" in CASES[case][3] else 0) + (2 if "exitant" in CASES[case][3] else 0) + 4
    assert head[9] == pytest.approx(2.2 if "gamma" in case else 1)


@needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_c_answers_as_the_model(case: str, made: Callable[[str], tuple[Model, Path]], probe: Path) -> None:
    model, folder = made(case)
    packed, shaded = Packed.read(folder), np.random.default_rng(4).random((len(model.samples.position), 3), np.float32) * 7
    done = subprocess.run([str(probe), str(folder / "c" / "model.bin")], input=shaded.tobytes(), capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    values, rows, light = np.split(
        np.frombuffer(done.stdout, np.float32), np.cumsum([3 * model.points, 4 * (3 * len(packed.layers) + 2)])
    )
    home = model.samples.nearest_point(model.points)
    leaving = shaded * model.samples.albedo
    expected = np.stack([leaving[home == point].mean(0) for point in range(model.points)])
    close(values.reshape(-1, 3), expected, 1e-6)
    own = packed.rows(*packed.frame(values.reshape(-1, 3)))
    close(rows.reshape(-1, 4), own, 1e-6)
    image = light.reshape(*SHAPE, 3)
    every = np.argwhere(np.ones(SHAPE))
    close(image.reshape(-1, 3), packed.light(own, every), 2e-6)
    close(image[model.covered], model.predict(values.reshape(-1, 3)), 4e-3)


@needs_compiler
@pytest.mark.parametrize("case", ["plain", "colours that glow, in gamma"])
def test_check_of_the_c_folder_passes_and_can_fail(
    case: str, made: Callable[[str], tuple[Model, Path]], tmp_path: Path
) -> None:
    shutil.copytree(made(case)[1] / "c", tmp_path / "c")
    command = [str(COMPILER), *STRICT, "check.c", "-o", "check", "-lm"]
    assert subprocess.run(command, cwd=tmp_path / "c", capture_output=True).returncode == 0
    check = lambda: subprocess.run(["./check"], cwd=tmp_path / "c", capture_output=True, text=True)  # noqa: E731
    assert check().returncode == 0
    lines = (tmp_path / "c" / "golden.txt").read_text().splitlines()
    *row, blue = lines[-1].split()
    (tmp_path / "c" / "golden.txt").write_text("\n".join([*lines[:-1], " ".join([*row, str(float(blue) * 1.01 + 0.01)])]))
    assert check().returncode == 1
    (tmp_path / "c" / "model.bin").unlink()
    assert check().stderr == "check: the file cannot be read\n"


@needs_compiler
@pytest.mark.parametrize("case", ["plain", "colours that glow, in gamma"])
def test_damaged_files_are_refused_and_nothing_is_read_past_its_end(
    case: str, made: Callable[[str], tuple[Model, Path]], probe: Path
) -> None:
    path = made(case)[1] / "c" / "model.bin"
    done = subprocess.run([str(probe), str(path), "abuse"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    fine, _, other, _, short, damaged, *_ = map(int, done.stdout.split())
    assert short > 1000
    assert damaged > 1000
    assert fine > 100
    assert other + 8 <= done.stdout.count(" ") + 4000


@needs_compiler
def test_wrong_files_and_light_are_told_apart(made: Callable[[str], tuple[Model, Path]], probe: Path, tmp_path: Path) -> None:
    model, folder = made("plain")
    good = (folder / "c" / "model.bin").read_bytes()
    samples = 3 * len(model.samples.position)

    def sealed(data: bytes) -> bytes:
        return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))

    home = 48 + 4 * (9 * len(model.samples.position) + 7 * 3 + 7 * (7 * 3 + 3))
    table = {
        "no file": (None, b"", 1),
        "empty": (b"", b"", 2),
        "a picture": (b"\x89PNG\r\n\x1a\n" + good, b"", 2),
        "another version": (good.replace(b"ddprt001", b"ddprt002"), b"", 3),
        "cut off": (good[:-1], b"", 4),
        "more than it says": (good + b"\0", b"", 5),
        "one bit": (good[:60] + bytes([good[60] ^ 1]) + good[61:], b"", 5),
        "a NaN": (sealed(good[:48] + struct.pack("<f", np.nan) + good[52:]), b"", 5),
        "a point that is not there": (sealed(good[:home] + struct.pack("<I", 7) + good[home + 4 :]), b"", 5),
        "a point without samples": (sealed(good[:home] + struct.pack("<I", 1) + good[home + 4 :]), b"", 5),
        "NaN is measured": (good, np.full(samples, np.nan, np.float32).tobytes(), 7),
        "nothing is measured": (good, np.zeros(samples, np.float32).tobytes(), 0),
    }
    for name, (data, measured, status) in table.items():
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        done = subprocess.run([str(probe), str(path)], input=measured, capture_output=True)
        assert done.returncode == status, name
        assert bool(done.stderr) == (status != 0), name
        if status == 0:
            assert not np.frombuffer(done.stdout, np.float32)[-3 * SHAPE[0] * SHAPE[1] :].any(), name


def test_every_engine_gets_its_folder_and_loses_it_when_it_is_not_asked_for(tmp_path: Path) -> None:
    model = model_of(relighters(3, 3)["plain"])
    files = export_model(model, tmp_path, engines=list(ENGINES))
    on_disk = {path for path in tmp_path.rglob("*") if path.is_file()}
    assert set(files) == on_disk
    for name in ENGINES:
        assert {"README.md", "model.bin", "golden.json", "golden.txt"} <= {path.name for path in (tmp_path / name).iterdir()}
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("kept")
    export_model(model, tmp_path)
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {"mine"}
    assert not (tmp_path / "basis.rgba16f").exists()


def test_settings_know_all_engines() -> None:
    assert ExportConfig().engines == ()
    assert set(ExportConfig(engines=tuple(ENGINES)).engines) == set(ENGINES)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="more than once"):
        ExportConfig(engines=("c", "c"))
    with pytest.raises(UserError, match='no engine "cry"'):
        ENGINES["cry"]


@pytest.mark.parametrize("kind", ["perceptron", "decoder", "mean", "cosines"])
def test_what_takes_more_than_a_matrix_is_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"export\.engines: got made-up, whose frames take more than a matrix"):
        export_model(model_of(relighters(3, 3)[kind]), tmp_path, engines=["c"])
    assert not any(tmp_path.iterdir())


def test_engines_are_told_of_fog(tmp_path: Path) -> None:
    model = model_of(relighters(3, 3)["plain"])
    for fog, told in ((None, False), (Fog((1.5, 2.0, 3.0)), True)):
        export_model(replace(model, fog=fog), tmp_path, engines=list(ENGINES))
        for name in ENGINES:
            text = (tmp_path / name / "README.md").read_text("utf-8")
            assert ("**Fog.**" in text) == told
            assert ("1.5, 2, 3" in text) == told
