"""Forecasts of bakes: laws, rays and files against the bake that follows, nothing left behind."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ddprt
from ddprt.cli import main
from ddprt.config import Config, checked
from ddprt.dataset.forecast import Forecast, forecast
from ddprt.dataset.generate import bake
from ddprt.dataset.sampled import extrapolated, on_a_line
from ddprt.dataset.splits import choose_lightings
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.scene.atlas import build_atlas
from ddprt.transport import effort
from ddprt.transport.direct import Texels
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Receivers
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.operator import Operator


def config_of(scene: str = "plates", side: int = 32, counts: tuple[int, int, int] = (6, 2, 3), **sections: Any) -> Config:
    lightings = dict(zip(("train", "validation", "test"), counts, strict=True)) | sections.pop("lightings", {})
    transport = {"samples": 16, "test_samples": 32, "threads": 2} | sections.pop("transport", {})
    sections |= {"lightings": lightings, "transport": transport, "points": {"count": 8, "supersample": 2}}
    return checked({"scene": {"name": scene}, "atlas": {"resolution": side}, **sections})


def both(config: Config, folder: Path) -> tuple[Forecast, dict[str, dict[str, Any]], dict[str, tuple[int, int]]]:
    """A forecast, the stages of the bake, and files and bytes of each stage."""
    scene = ddprt.load_scene(config.scene.name)
    beside = folder / "beside"
    beside.mkdir()
    found = forecast(scene, config, beside=beside)
    assert not [*beside.iterdir()]
    progress = Progress(quiet=True)
    data = bake(scene, config=config, out=folder / "dataset", progress=progress)
    held, files = data.split("test"), dict[str, list[int]]()
    for path in data.folder.rglob("*"):
        if path.is_file():
            kind = path.parent.name
            test = kind == "noise" or (kind == "indirect" and int(path.stem) in held)
            stage = {"direct": "direct", "measured": "direct", "indirect": "indirect train"}.get(kind, "files")
            files.setdefault("indirect test" if test else stage, []).append(path.stat().st_size)
    stages = {str(stage["name"]): dict(stage) for stage in progress.stages}
    return found, stages, {name: (len(sizes), sum(sizes)) for name, sizes in files.items()}


def test_work_grows_in_proportion_after_the_first_round() -> None:
    """3 s for the first 2 items, which load and compile; half a second for each one after."""
    spent = [(2.0, 3.0), (4.0, 2.5), (8.0, 3.5)]
    assert extrapolated(spent, 14) == pytest.approx(9.0)  # all was done: exactly what it took
    assert extrapolated(spent, 102) == pytest.approx(3.0 + 100 * 0.5)
    assert extrapolated(spent, 202) - extrapolated(spent, 102) == pytest.approx(100 * 0.5)
    assert extrapolated([(2.0, 3.0)], 2) == 3.0
    assert extrapolated([(2.0, 3.0)], 6) == 9.0


def test_columns_cost_a_constant_and_each_the_same() -> None:
    assert on_a_line((4, 5.0), (16, 8.0), 16) == 8.0
    assert on_a_line((4, 5.0), (16, 8.0), 144) == pytest.approx(4.0 + 0.25 * 144)
    assert on_a_line((4, 8.0), (16, 5.0), 144) == 5.0, "a busy machine may turn them around; no column costs less than nothing"
    assert on_a_line((3, 1.0), (3, 2.0), 3) == 2.0


def test_few_tiles_stand_for_all_rays() -> None:
    """Even rays, near senders in the last of 16 stretches alone; then a fifth of the texels hold half of the rays."""
    odds = np.repeat([0.0, 1.0], [15 * 64, 64])
    tiles = effort._standing_for_all(np.full(1024, 8), odds, 16, 16)
    assert [len(tile) for tile in tiles] == [16] * 16
    assert np.mean([odds[tile].mean() for tile in tiles]) == 1 / 16
    assert all(np.array_equal(np.diff(tile), np.ones(15)) for tile in tiles), "neighbours"
    rays = np.where(np.arange(1280) % 5 == 0, 32, 8)
    tiles = effort._standing_for_all(rays, np.zeros(1280), 16, 8)
    assert sorted(rays[tile][0] for tile in tiles) == [8] * 4 + [32] * 4
    assert all(len(set(rays[tile])) == 1 for tile in tiles)
    mixed = np.tile([0.0, 0.5, 1.0], 5)  # a stratum's mean, not its ends; no ray of a texel that has none
    (middle,) = effort._standing_for_all(np.r_[np.full(15, 4), 0], np.r_[mixed, 9.0], 1, 1)
    assert mixed[middle] == 0.5


def test_threads_take_the_next_span_when_free() -> None:
    assert effort._until_done([3.0, 3.0, 3.0], 2) == 6.0
    assert effort._until_done([1.0, 1.0, 2.0], 2) == 3.0
    assert effort._until_done([1.0] * 4, 8) == 1.0
    assert effort._until_done([1.0, 2.0], 1) == 3.0


def test_tiles_are_those_of_a_gather() -> None:
    scene = ddprt.load_scene("plates")
    atlas = build_atlas(scene, 48)
    operator = Operator.of(Tracer.of(scene, 1), atlas)
    for samples in (2, 100, 8000):
        first = next(Receivers.texels(atlas, samples, 0, "any").tiles(within=slice(0, 1 << 16)))
        assert effort._tile(operator, samples) == first.stop


@pytest.mark.parametrize("scene", ["cornell", "corridor", "faults"])
def test_rays_that_go_on_are_foretold_where_few_texels_are_in_corners(scene: str) -> None:
    """Within the quarter that issue 5 asks for; 6 % at most were measured in these scenes at 64²."""
    config = config_of(scene, 48, transport={"samples": 256, "threads": 1})
    made = ddprt.load_scene(scene)
    tracer = Tracer.of(made, 1)
    atlas, _ = build_open_atlas(tracer, made, 48, config.atlas.padding)
    operator = Operator.of(tracer, atlas)
    lightings = [lighting for _, lighting in choose_lightings(None, config.lightings, made, tracer, 0)[0]]
    texels = Texels.of(tracer, atlas, 1, np.random.default_rng(0))
    light = [operator.averaged(texels.irradiance(lighting, np.random.default_rng(1))) for lighting in lightings]
    direct = np.concatenate(light, 1)
    near = operator.near(lightings, direct)
    choice = effort.choose_rays(operator, direct, config.transport, near=near, held_out=False, seed=0, stream="some")
    before, out = tracer.rays, np.zeros((len(lightings), atlas.count, 3), np.float32)
    for _ in operator.gather(direct, out, choice.rays, seed=0, stream="some", near=near):
        pass
    onwards = tracer.rays - before - choice.rays.sum()
    assert onwards > 0.1 * choice.rays.sum()
    assert choice.traced - choice.rays.sum() == pytest.approx(onwards, rel=0.25)


class RayClock:
    """A clock that only rays move, a microsecond each: what it tells does not depend on what else the machine does.

    For bakes on one thread: it goes on by the rays of all, as if they came one after the other."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.rays, count = 0, Tracer._count

        def counted(tracer: Tracer, rays: int) -> None:
            count(tracer, rays)
            self.rays += rays

        patch.setattr(Tracer, "_count", counted)
        patch.setattr(time, "perf_counter", lambda: self.rays / 1e6)


def test_what_is_known_beforehand_is_told_exactly(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where all lightings are looked at and no sender is near, the forecast traces what the bake does."""
    RayClock(monkeypatch)
    config = config_of(transport={"samples": "auto", "test_samples": "auto", "target_noise": 0.1, "threads": 1})
    found, stages, files = both(config, tmp_path)
    assert [stage.name for stage in found.stages] == [*stages, "files"]
    told = {stage.name: stage for stage in found.stages}
    for name in ("direct", "indirect train", "indirect test"):
        assert told[name].rays == stages[name]["rays"], name
        assert told[name].seconds == pytest.approx(float(stages[name]["seconds"]), abs=1e-4), "a stage's seconds have 4 digits"
    assert {name: told[name].files for name in files} == {name: count for name, (count, _) in files.items()}
    assert found.files == sum(count for count, _ in files.values())
    assert told["direct"].bytes == files["direct"][1]
    assert found.bytes == sum(stage.bytes for stage in found.stages)


@pytest.mark.parametrize(
    ("scene", "transport"),
    [
        ("cornell", {}),
        ("cornell", {"integrator": "paths"}),
        ("cornell", {"integrator": "reference"}),
        ("convex", {}),
    ],
)
def test_files_and_rays_come_as_foretold(scene: str, transport: dict[str, Any], tmp_path: Path) -> None:
    around = {"distribution": "around"} if scene == "convex" else {"clearance": 0.1}
    found, stages, files = both(config_of(scene, 48, lightings=around, transport=transport), tmp_path)
    told = {stage.name: stage for stage in found.stages}
    assert {name: told[name].files for name in files} == {name: count for name, (count, _) in files.items()}
    for name, (_, size) in files.items():
        assert told[name].bytes == pytest.approx(size, rel=0.25), name  # what issue 5 asks for
    for name in ("direct", "indirect train", "indirect test"):  # all lightings are seen; near senders and roulette: see below
        assert told[name].rays == pytest.approx(stages[name]["rays"], rel=0.1), name


@pytest.mark.parametrize(
    ("transport", "wide"),
    [
        ({"samples": 64, "test_samples": 256}, 16),
        pytest.param({"samples": 64, "test_samples": 256}, 512, marks=pytest.mark.slow),
        ({"integrator": "paths"}, 512),
        pytest.param({"integrator": "reference"}, 512, marks=pytest.mark.slow),
    ],
)
def test_every_ray_of_a_bake_is_in_its_forecast(
    transport: dict[str, Any], wide: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """More lightings than are looked at. Shadow rays differ by 19 % between them (measured), so 64 of 80 tell their mean to
    1.1 % and 32 of 40, for the second half of held-out maps, to 1.5 %; what goes on from near senders is told from a stretch of
    texels, and was 4 % of all rays off here. Three standard errors and that: a tenth."""
    monkeypatch.setattr("ddprt.dataset.forecast_indirect.WIDE", wide)  # past so many, columns are extrapolated
    RayClock(monkeypatch)
    config = config_of("cornell", 24, (36, 4, 40), lightings={"clearance": 0.1}, transport={**transport, "threads": 1})
    found, stages, _ = both(config, tmp_path)
    told = {stage.name: stage for stage in found.stages}
    for name, stage in stages.items():
        if name != "atlas" and float(stage["seconds"]) > 1e-3:
            assert told[name].seconds == pytest.approx(float(stage["seconds"]), rel=0.1), name
    without = [told[name].seconds for name in ("lightings", "atlas", "points", "indirect train")]
    assert found.training_seconds == pytest.approx(sum(without) + told["direct"].seconds / 2 + told["files"].seconds, rel=0.05)
    assert found.seconds == pytest.approx(sum(stage.seconds for stage in found.stages))


def test_a_stage_expects_what_its_files_take(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A clock that only maps, hashes and maps in the making move, on one thread: a stage then takes what it expected."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def costs(name: str, seconds: float) -> None:
        module, _, called = name.rpartition(".")
        work = getattr(sys.modules[module], called)

        def slow(*given: Any, **named: Any) -> Any:
            now[0] += seconds
            return work(*given, **named)

        monkeypatch.setattr(name, slow)

    for room in ("indirect", "sampled"):
        costs(f"ddprt.dataset.{room}.write_map", 8.0)
    for room in ("sampled", "manifest"):
        costs(f"ddprt.dataset.{room}.sha256", 3.0)
    progress = Progress(quiet=True)
    bake(ddprt.load_scene("plates"), config=config_of(transport={"threads": 1}), out=tmp_path / "data", progress=progress)
    stages = {str(stage["name"]): stage for stage in progress.stages if "seconds_expected" in stage}
    for name, maps in (("indirect train", 8), ("indirect test", 6)):
        sample = 11 * (1 if name == "indirect train" else 2)
        assert stages[name]["seconds"] == 11 * maps + sample
        assert stages[name]["seconds_expected"] == pytest.approx(stages[name]["seconds"], rel=0.05)  # told in two digits
    assert not [*(tmp_path / "data").glob("*.part")]


def test_a_large_stage_expects_its_maps_in_the_making(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """They are tried out at a share of their size; below a size they count for nothing."""
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr("ddprt.dataset.indirect.scratched", lambda _, size, most, __: asked.append((size, most)) or 5000.0)
    progress = Progress(quiet=True)
    monkeypatch.setattr("ddprt.dataset.indirect._LARGE", 12 * 8 * 1024)  # 8 training maps of 32² texels, of which few are bare
    monkeypatch.setattr("ddprt.dataset.indirect._SHARE", 4)
    bake(ddprt.load_scene("plates"), config=config_of(side=32, counts=(20, 4, 2)), out=tmp_path / "data", progress=progress)
    stages = {str(stage["name"]): stage for stage in progress.stages if "seconds_expected" in stage}
    assert [most for _, most in asked] == [size // 4 for size, _ in asked]
    for name, large in (("indirect train", True), ("indirect test", False)):
        assert (float(stages[name]["seconds_expected"]) >= 4900) == large, name


def test_what_dominates_is_said_with_what_would_shorten_it() -> None:
    config = config_of(transport={"samples": 64, "test_samples": 2048})
    found = forecast(ddprt.load_scene("plates"), config)
    seconds = {part.what: part for part in found.parts}
    part = seconds["gather rays for held-out maps"]
    assert part.setting == "transport.test_samples = 1024"
    assert part.then == pytest.approx(part.seconds / 2)
    assert found.parts == tuple(sorted(found.parts, key=lambda part: -part.seconds))
    lines = str(found).splitlines()
    told = [line.split("  ")[0] for line in lines[1:]]
    assert told[: told.index("total") + 1] == [*(stage.name for stage in found.stages), "total"]
    dominant = lines[told.index("total") + 3]  # below that of memory
    assert dominant.startswith(f"of {found.seconds:.3g} s, ")
    assert found.parts[0].setting in dominant
    called = [effect.name for effect in found.effects.effects if effect.called]
    assert [line.split(":")[0] for line in lines[told.index("total") + 4 :]] == [f"effect {name}" for name in called]
    assert 0.01 < found.peak_gib < 64
    assert found.spent > 0


def called(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0), *capsys.readouterr()


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "job.toml").write_text(
        '[scene]\nname = "plates"\n[atlas]\nresolution = 24\n[lightings]\ntrain = 2\nvalidation = 1\ntest = 1\n'
        "[points]\ncount = 4\n[transport]\nsamples = 8\ntest_samples = 8\n"
    )
    code, told, _ = called(capsys, "bake", tmp_path / "job.toml", "--dry-run", "--out", tmp_path / "a" / "b")
    assert code == 0
    assert told.splitlines()[0].split() == ["stage", "seconds", "rays", "files", "MB"]
    assert [path.name for path in tmp_path.iterdir()] == ["job.toml"]
    for wrong in (
        ["--points.count", "100000"],
        ["--scene.name", "nowhere"],
        ["--atlas.resolution", "1"],
        ["--fit.method", "x"],
    ):
        code, told, why = called(capsys, "bake", tmp_path / "job.toml", "--dry-run", *wrong)
        assert (code, told, len(why.splitlines())) == (2, "", 1), why
    assert [path.name for path in tmp_path.iterdir()] == ["job.toml"]


def test_a_forecast_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"scene": {"name": "plates"}, "atlas": {"resolution": 32}}
    with pytest.raises(UserError, match=r"points.count: got 100000"):
        forecast(ddprt.load_scene("plates"), checked({**small, "points": {"count": 100000}}), beside=tmp_path)
    monkeypatch.setattr("ddprt.dataset.forecast.measure", lambda *_, **__: np.zeros("no"))  # type: ignore[call-overload]
    with pytest.raises(TypeError):
        forecast(ddprt.load_scene("plates"), config_of(), beside=tmp_path)
    assert not [*tmp_path.iterdir()]


def test_no_jax_is_needed() -> None:
    code = "import sys, ddprt.dataset.forecast; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
