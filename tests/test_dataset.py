"""Baking, storing, interrupting, going on, and finding damage."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import ddprt
from ddprt.config import Config
from ddprt.dataset import generate
from ddprt.dataset.generate import bake
from ddprt.dataset.indirect import IndirectBake
from ddprt.dataset.manifest import Manifest
from ddprt.dataset.sameness import differences
from ddprt.dataset.scratch import Scratch
from ddprt.dataset.splits import split_lightings
from ddprt.dataset.store import average_into_points, expected_files, open_dataset, read_map, write_map
from ddprt.errors import UserError
from ddprt.files import alone_in
from ddprt.progress import Progress
from ddprt.sampling.points import Samples
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas

SMALL = {
    "atlas": {"resolution": 32},
    "lightings": {"train": 4, "validation": 2, "test": 2, "clearance": 0.05},
    "points": {"count": 8, "supersample": 2},
    "transport": {"samples": 16, "test_samples": 32, "direct_samples": 2},
}


def small(**changes: dict) -> Config:
    return Config.model_validate({key: {**SMALL.get(key, {}), **changes.get(key, {})} for key in {*SMALL, *changes}})


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def baked(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("baked") / "dataset"
    bake(cornell, config=small(), out=folder)
    return folder


def test_everything_expected_is_there(baked: Path) -> None:
    data = open_dataset(baked)
    assert set(expected_files(data.description)) <= set(files(baked))
    assert [len(data.split(name)) for name in ("train", "validation", "test")] == [4, 2, 2]
    direct, indirect = data.maps("direct", range(8)), data.maps("indirect", range(8))
    assert direct.shape == indirect.shape == (8, int(data.covered.sum()), 3)
    assert np.isfinite(direct).all()
    assert (direct >= 0).all()
    assert (indirect >= 0).all()
    assert (indirect.mean((1, 2)) > 0).all()
    assert data.measured([0]).shape == (1, 16, 3)
    assert not (baked / "noise" / "000000.exr").exists(), "only held-out lightings carry a noise map"


def test_gbuffer_agrees_with_the_scene(baked: Path, cornell: Scene) -> None:
    data = open_dataset(baked)
    # Areas are stored as float32: each is good to eps32 / 2, and so is their sum. What lies under the blocks is left out.
    atlas, _ = build_open_atlas(Tracer.of(cornell), cornell, data.resolution)
    assert data.area.sum() == pytest.approx(atlas.area.sum(), rel=1.2e-7)
    assert 0.96 * cornell.areas.sum() < data.area.sum() < 0.98 * cornell.areas.sum()
    np.testing.assert_allclose(np.linalg.norm(data.gbuffer["geometric_normal"], axis=1), 1, atol=1e-6)
    low, high = cornell.bounds
    assert ((data.gbuffer["position"] >= low - 1e-6) & (data.gbuffer["position"] <= high + 1e-6)).all()


def test_equal_seeds_give_equal_bytes_whatever_the_threads(baked: Path, cornell: Scene, tmp_path: Path) -> None:
    bake(cornell, config=small(transport={"threads": 3}), out=tmp_path / "again")
    one, two = files(baked), files(tmp_path / "again")
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []
    bake(cornell, config=small().model_copy(update={"seed": 1}), out=tmp_path / "other")
    assert files(tmp_path / "other")["indirect/000000.exr"] != one["indirect/000000.exr"]


@pytest.mark.parametrize(
    "lost", ["direct/000003.exr", "measured/000001.safetensors", "indirect/000002.exr", "noise/000007.exr"]
)
def test_a_lost_file_is_made_again_with_the_same_bits(lost: str, baked: Path, cornell: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    (folder / lost).unlink()
    bake(cornell, config=small(), out=folder)
    now, before = files(folder), files(baked)
    assert {name: now[name] for name in now if name != "manifest.jsonl"} == {
        name: before[name] for name in before if name != "manifest.jsonl"
    }
    assert Manifest(folder).damaged() == []


@pytest.mark.parametrize("rest", [b"", b"x" * 5000])
def test_a_truncated_manifest_line_does_not_count(rest: bytes, baked: Path, cornell: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    manifest = folder / "manifest.jsonl"
    lines = manifest.read_bytes().splitlines(keepends=True)
    manifest.write_bytes(b"".join(lines[:-3]) + lines[-3][:25] + rest)
    assert len(Manifest(folder).entries) == len(lines) - 3
    bake(cornell, config=small(), out=folder)
    named = [json.loads(line)["file"] for line in manifest.read_text().splitlines()]
    assert len(named) == len(set(named)) == len(lines), "nothing lost, nothing twice"


INTERRUPTED = """
import sys, ddprt
from ddprt.config import load_config
from ddprt.cli import main
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas
main(["bake", sys.argv[1], "--out", sys.argv[2]])
"""


def test_killed_and_interrupted_bakes_go_on(cornell: Scene, tmp_path: Path) -> None:
    """Real signals to a real process, at three moments; the end is the same bytes as without."""
    config = small(lightings={"train": 24}, atlas={"resolution": 64}, transport={"samples": 64, "threads": 1})
    job = tmp_path / "job.toml"
    job.write_text(config.to_toml())
    bake(cornell, config=config, out=tmp_path / "whole")
    for number, when in ((signal.SIGINT, 1), (signal.SIGKILL, 8), (signal.SIGINT, 30)):
        process = subprocess.Popen(
            [sys.executable, "-c", INTERRUPTED, str(job), str(tmp_path / "run")], stderr=subprocess.PIPE, text=True
        )
        manifest, deadline = tmp_path / "run" / "dataset" / "manifest.jsonl", time.time() + 60
        while process.poll() is None and time.time() < deadline:
            if manifest.exists() and manifest.read_bytes().count(b"\n") > 8 + when:
                process.send_signal(number)
                break
            time.sleep(0.001)
        _, errors = process.communicate(timeout=60)
        if number == signal.SIGINT and process.returncode != 0:
            assert process.returncode == 130, errors
            assert "the same command goes on" in errors
            assert "Traceback" not in errors
        assert Manifest(tmp_path / "run" / "dataset").damaged() == []
    bake(cornell, config=config, out=tmp_path / "run" / "dataset")
    whole, resumed = files(tmp_path / "whole"), files(tmp_path / "run" / "dataset")
    resumed = {name: data for name, data in resumed.items() if not name.rsplit("/", 1)[-1].startswith(".")}
    assert [n for n in whole if n != "manifest.jsonl" and whole[n] != resumed.get(n)] == []
    assert set(whole) == set(resumed)


OCCUPIED = """
import sys, time
from pathlib import Path
from ddprt.files import alone_in
with alone_in(Path(sys.argv[1])):
    print("in", flush=True)
    time.sleep(600)
"""


def test_a_lock_dies_with_its_process_and_keeps_no_reader_out(
    baked: Path, cornell: Scene, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    from ddprt.cli import main

    folder = tmp_path / "run" / "dataset"
    shutil.copytree(baked, folder)
    job = tmp_path / "job.toml"
    job.write_text(small().to_toml())
    with subprocess.Popen([sys.executable, "-c", OCCUPIED, str(folder)], stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "in\n"
            with pytest.raises(SystemExit) as refused:
                main(["bake", str(job), "--out", str(folder.parent)])
            assert refused.value.code == 2
            words = f"{folder}: another command is working in this folder; wait for it, or give another --out\n"
            assert capsys.readouterr().err.endswith(words)
            assert len(open_dataset(folder).maps("indirect", range(8))) == 8
            with pytest.raises(SystemExit) as fine:
                main(["verify", str(folder)])
            assert fine.value.code == 0
        finally:
            other.kill()
    assert (folder / ".lock").exists(), "nobody could remove it"
    bake(cornell, config=small(), out=folder)
    assert files(folder) == files(baked)


def test_a_bake_is_alone_to_its_end(baked: Path, cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused = []

    def intruding(self: Scratch) -> None:
        with pytest.raises(UserError, match="another command is working in this folder"):
            bake(cornell, config=small(), out=tmp_path / "dataset")
        refused.append(self.path.name)
        remove(self)

    remove = Scratch.remove
    monkeypatch.setattr(Scratch, "remove", intruding)
    bake(cornell, config=small(), out=tmp_path / "dataset")
    assert refused == ["train-0.part", "test-0.part", "test-1.part"]
    assert files(tmp_path / "dataset") == files(baked)


def test_a_lock_whose_file_was_just_removed_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one before removes its file between our opening and our locking: others would lock a new one beside us."""
    fcntl = pytest.importorskip("fcntl")
    flock, tries = fcntl.flock, []

    def late(file: int, operation: int) -> None:
        tries.append(file)
        if len(tries) == 1:
            (tmp_path / "dataset" / ".lock").unlink()
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with alone_in(tmp_path / "dataset"):
        assert len(tries) == 2
        with pytest.raises(UserError, match="another command"), alone_in(tmp_path / "dataset"):
            pass
    assert list(tmp_path.iterdir()) == [], "no folder where nothing was written"


@pytest.mark.parametrize("why", ["no flock on this platform", "none on this file system"])
def test_where_there_is_no_lock_nothing_is_kept_out_or_removed(
    why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = tmp_path / ".000000.exr.25623.tmp.exr"
    left.write_text("")
    if why == "no flock on this platform":
        monkeypatch.setitem(sys.modules, "fcntl", None)
    else:

        def none(file: int, operation: int) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(pytest.importorskip("fcntl"), "flock", none)
    with alone_in(tmp_path), alone_in(tmp_path):
        pass
    assert left.exists(), "it might be another's"


def test_what_killed_bakes_left_goes_and_what_others_put_there_stays(baked: Path, cornell: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    for name in (".dataset.json.7.tmp.json", "direct/.000000.exr.25623.tmp.exr", "train-0.part", "test-1.part", "test-1.json"):
        (folder / name).write_text("")
    for name in ("notes.txt", ".mine.tmp", "direct/.mine.tmp.exr", "direct/000000.tmp"):
        (folder / name).write_text("mine")
    bake(cornell, config=small(), out=folder)
    assert {name for name, data in files(folder).items() if data == b"mine"} == set(files(folder)) - set(files(baked))
    assert len(files(folder)) == len(files(baked)) + 4


def test_a_bake_that_lost_lines_of_its_manifest_does_not_end_well(
    cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where there is no lock and another bake cuts the manifest to what itself has written."""
    run = IndirectBake.run

    def losing(self: IndirectBake, split: str, indices: list[int]) -> None:
        run(self, split, indices)
        path = self.dataset.folder / "manifest.jsonl"
        if split == "test":
            path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-3]))

    with monkeypatch.context() as patch:
        patch.setattr(IndirectBake, "run", losing)
        with pytest.raises(UserError, match=r"got 3 files missing at the end of the bake \(first noise/000006\.exr\)"):
            bake(cornell, config=small(), out=tmp_path / "dataset")
    bake(cornell, config=small(), out=tmp_path / "dataset")
    open_dataset(tmp_path / "dataset")


@pytest.mark.parametrize("altered", ["direct/000002.exr", "indirect/000007.exr", "measured/000001.safetensors"])
def test_altered_files_are_named_and_the_advice_works(
    altered: str, baked: Path, cornell: Scene, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    data = bytearray((folder / altered).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / altered).write_bytes(data)
    (folder / "indirect" / "000002.exr").unlink()  # which needs the direct light of all
    with pytest.raises(UserError, match=f"expected what was baked: {altered}; delete it and bake again") as caught:
        bake(cornell, config=small(), out=folder)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")
    (folder / altered).unlink()
    bake(cornell, config=small(), out=folder)
    assert {**files(folder), "manifest.jsonl": b""} == {**files(baked), "manifest.jsonl": b""}


def test_a_map_that_cannot_be_read_says_what_to_do(baked: Path, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    os.truncate(folder / "indirect" / "000005.exr", 99)
    with pytest.raises(UserError, match=r"not a whole EXR image .*; delete it and bake again, or copy it again"):
        open_dataset(folder).maps("indirect", [5])


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove"])
def test_verify_finds_damage(damage: str, baked: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from ddprt.cli import main

    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    with pytest.raises(SystemExit) as fine:
        main(["verify", str(folder)])
    assert fine.value.code == 0
    victim = folder / "indirect" / "000005.exr"
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    {"flip": lambda: victim.write_bytes(data), "truncate": lambda: os.truncate(victim, 99), "remove": victim.unlink}[damage]()
    with pytest.raises(SystemExit) as found:
        main(["verify", str(folder)])
    assert found.value.code == 2
    assert "indirect/000005.exr" in capsys.readouterr().out


def test_another_bake_is_never_overwritten(baked: Path, cornell: Scene, furnace: Scene, tmp_path: Path) -> None:
    before = files(baked)
    for scene, config in ((furnace, small(lightings={"clearance": 0.0})), (cornell, small(transport={"samples": 17}))):
        with pytest.raises(UserError, match="holds another dataset"):
            bake(scene, config=config, out=baked)
    assert files(baked) == before
    changed = tmp_path / "dataset"
    shutil.copytree(baked, changed)
    description = json.loads((changed / "dataset.json").read_text())
    (changed / "dataset.json").write_text(json.dumps({**description, "schema": 99}))
    with pytest.raises(UserError, match="got schema 99, expected 1"):
        bake(cornell, config=small(), out=changed)
    (changed / "dataset.json").write_text("{")
    with pytest.raises(UserError, match="not a dataset description"):
        open_dataset(changed)


ASKED = {
    "noise": ({"transport": {"target_noise": 0.04}}, "transport.target_noise: holds 0.01, asked 0.04"),
    "rays": ({"transport": {"samples": 17}}, "transport.samples: holds 16, asked 17"),
    "automatic rays": ({"transport": {"samples": "auto"}}, 'transport.samples: holds 16, asked "auto"'),
    "points": (
        {"points": {"count": 9, "on": "hull"}},
        'points.count: holds 8, asked 9; points.on: holds "surface", asked "hull"',
    ),
    "lightings": ({"lightings": {"train": 5}}, "lightings.train: holds 4, asked 5"),
    "places": ({"lightings": {"clearance": 0.06}}, "lightings[2].lights[0].position[0]: holds 0.284"),
}


@pytest.mark.parametrize("name", ASKED)
def test_another_dataset_is_refused_before_anything_is_built(
    name: str, baked: Path, cornell: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generate, "build_open_atlas", lambda *_: pytest.fail("the atlas was built"))
    changes, words = ASKED[name]
    with pytest.raises(UserError, match=re.escape(f"{baked}: holds another dataset ({words}")):
        bake(cornell, config=small(**changes), out=baked)


def test_faults_of_given_points_come_before_the_atlas(cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "points.json"
    place = {"position": [0.3, 0.0, 0.05], "normal": [0, 1, 0]}
    path.write_text(json.dumps([place] * 3))
    bake(cornell, config=small(points={"file": str(path), "count": 3}), out=tmp_path / "dataset")
    path.write_text(json.dumps([{**place, "position": [0.2, 0.0, 0.05]}] * 3))
    monkeypatch.setattr(generate, "build_open_atlas", lambda *_: pytest.fail("the atlas was built"))
    for count, file, words in (
        (3, path, r'holds another dataset \(points\.file: holds "\w{16}", asked "\w{16}"\)'),
        (4, path, r"points\.count: holds 3, asked 4"),
        (3, tmp_path / "none.json", r'points\.file: holds "\w{16}", asked "/.*/none\.json"\)'),
    ):
        with pytest.raises(UserError, match=words):
            bake(cornell, config=small(points={"file": str(file), "count": count}), out=tmp_path / "dataset")
    for count, file, words in ((4, path, "points.count: got 4, but .* has 3"), (3, tmp_path / "none.json", "got No such file")):
        with pytest.raises(UserError, match=words):
            bake(cornell, config=small(points={"file": str(file), "count": count}), out=tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_differences_are_told_leaf_by_leaf() -> None:
    holds = {"seed": 1, "transport": {"samples": 3, "old": True}, "scene": {"notes": ["a" * 80]}, "lightings": []}
    asked = {"seed": 2, "transport": {"samples": 3, "new": None}, "scene": {"notes": ["a" * 80, "b"]}}
    assert differences(holds, holds) == ""
    assert differences(holds, asked) == (
        "seed: holds 1, asked 2; transport.new: holds nothing, asked null; transport.old: holds true, asked nothing; "
        "scene.notes: holds a list of 1, asked a list of 2"
    )
    assert differences({"a": [1, 2]}, {"a": [1, 3]}) == "a[1]: holds 2, asked 3"
    assert differences({"a": [0] * 6}, {"a": [1] * 6}).endswith("a[3]: holds 0, asked 1; and 2 more")


def test_unfinished_and_missing_datasets_are_refused(baked: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a dataset"):
        open_dataset(tmp_path / "nothing")
    folder = tmp_path / "dataset"
    shutil.copytree(baked, folder)
    lines = (folder / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "manifest.jsonl").write_bytes(b"".join(lines[:-2]))
    with pytest.raises(UserError, match="2 files missing"):
        open_dataset(folder)


LAMP = {"type": "point", "position": [0.3, 0.4, 0.3], "intensity": [1, 1, 1]}
OUTSIDE = {"type": "point", "position": [0.3, 0.4, 5.0], "intensity": [1, 1, 1]}
IN_BLOCK = {"type": "point", "position": [0.186, 0.08, 0.169], "intensity": [1, 1, 1]}
OFF = {**LAMP, "intensity": [0, 0, 0]}


def lightings(*records: dict) -> list:
    from ddprt.lights import parse_lighting

    return [parse_lighting(record) for record in records]


def test_changed_points_are_another_dataset(cornell: Scene, tmp_path: Path) -> None:
    path = tmp_path / "points.json"
    place = {"position": [0.3, 0.0, 0.05], "normal": [0, 1, 0]}
    path.write_text(json.dumps([place] * 3))
    config = small(points={"file": str(path), "count": 3})
    bake(cornell, config=config, out=tmp_path / "dataset")
    path.write_text(json.dumps([{**place, "position": [0.2, 0.0, 0.05]}] * 3))
    with pytest.raises(UserError, match="holds another dataset"):
        bake(cornell, config=config, out=tmp_path / "dataset")
    path.write_text(json.dumps([{**place, "albedo": [-1, 0, 0]}] * 3))
    with pytest.raises(UserError, match="expected 0 to 1"):
        bake(cornell, config=config, out=tmp_path / "other")


@pytest.mark.parametrize("name", ["position", "normal", "geometric_normal", "albedo", "area", "coverage"])
def test_each_lost_atlas_file_is_made_again(name: str, baked: Path, cornell: Scene, tmp_path: Path) -> None:
    shutil.copytree(baked, tmp_path / "dataset")
    (tmp_path / "dataset" / "atlas" / f"{name}.exr").unlink()
    bake(cornell, config=small(), out=tmp_path / "dataset")
    assert files(tmp_path / "dataset")[f"atlas/{name}.exr"] == files(baked)[f"atlas/{name}.exr"]


def test_dark_and_blocked_lightings_are_named(cornell: Scene, capsys: pytest.CaptureFixture) -> None:
    given = {"train": lightings(LAMP, OFF, OUTSIDE, IN_BLOCK), "validation": lightings(LAMP), "test": lightings(LAMP)}
    data = bake(cornell, given, config=small(), progress=Progress())
    words = capsys.readouterr().err
    assert "1 (train): lights nothing: it has no intensity" in words
    assert "2 (train): lights nothing: it stands outside the scene" in words
    assert "3 (train): lights nothing: it stands inside a solid or behind a wall" in words
    assert "0 (train)" not in words
    assert (data.maps("indirect", [1, 2]) == 0).all()
    model = ddprt.fit(data, bases=2)
    assert np.isfinite(model.predict(data.values([0, 1, 2, 3], 8, "radiosity"))).all()


@pytest.mark.parametrize("records", [(OFF, OFF, OFF), (OUTSIDE, OUTSIDE, OUTSIDE)])
def test_all_dark_is_an_error(records: tuple, cornell: Scene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="all 3 light nothing"):
        bake(cornell, lightings(*records), config=small(), out=tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()
    bake(cornell, lightings(LAMP, LAMP, LAMP), config=small(), out=tmp_path / "dataset")  # nothing is in the way


def test_a_bake_of_darkness_removes_only_what_it_wrote(cornell: Scene, tmp_path: Path) -> None:
    (tmp_path / "direct").mkdir()
    for name in ("thesis.txt", "direct/thesis.txt"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match="all 3 light nothing"):
        bake(cornell, lightings(OFF, OFF, OFF), config=small(), out=tmp_path)
    assert files(tmp_path) == {"thesis.txt": b"mine", "direct/thesis.txt": b"mine"}


def test_a_manifest_without_its_description_does_not_count(baked: Path, cornell: Scene, tmp_path: Path) -> None:
    folder, config = tmp_path / "dataset", small(transport={"samples": 17})
    shutil.copytree(baked, folder)
    (folder / "dataset.json").unlink()
    bake(cornell, config=config, out=folder)
    bake(cornell, config=config, out=tmp_path / "fresh")
    assert files(folder) == files(tmp_path / "fresh")


def test_a_refused_bake_is_not_in_the_way_of_the_next(cornell: Scene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"lower points\.count"):
        bake(cornell, config=small(points={"count": 5000}), out=tmp_path / "dataset")
    bake(cornell, config=small(), out=tmp_path / "dataset")


def test_too_few_lightings_or_points(cornell: Scene, tmp_path: Path) -> None:
    for given in ([], lightings(LAMP), {"train": lightings(LAMP), "validation": [], "test": lightings(LAMP)}):
        with pytest.raises(UserError, match="lightings: got"):
            bake(cornell, given, config=small(), out=tmp_path / "dataset")
    with pytest.raises(UserError, match=r"points.count: got 600, but .* texels; lower points.count"):
        bake(cornell, config=small(points={"count": 600}, atlas={"resolution": 24}), out=tmp_path / "many")
    listed = tmp_path / "lights.json"
    listed.write_text(json.dumps([[LAMP]] * 3))
    with pytest.raises(UserError, match="got 3 lightings, expected 8"):
        bake(cornell, config=small(lightings={"file": str(listed)}), out=tmp_path / "listed")


def test_one_list_is_split_by_order() -> None:
    splits = split_lightings(lightings(*[LAMP] * 20))
    assert {name: len(rows) for name, rows in splits.items()} == {"train": 14, "validation": 2, "test": 4}


def test_black_and_lonely_scenes_trace_no_bounce(furnace: Scene, tmp_path: Path) -> None:
    from ddprt.scene.library import build

    records = lightings(*[{**LAMP, "position": [0.1, 0.1, 0.1 * k]} for k in range(3)])
    black = bake(build("furnace", albedo=0.0, subdivisions=2), records, config=small())
    far = lightings(*[{**LAMP, "position": [3.0, 3.0, 1.0 + k]} for k in range(3)])
    lonely = bake(build("convex"), far, config=small())
    for data in (black, lonely):
        assert (data.maps("indirect", range(3)) == 0).all()
        assert data.description["plan"][0]["called"] is False


def test_half_floats_keep_their_range(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((8, 9, 3)).astype(np.float32)
    for size in (1e-20, 1e-6, 1.0, 1e6, 1e20):
        write_map(tmp_path / "map.exr", image * np.float32(size))
        # Half floats round by 2^-11 of each value down to the smallest normal number, 2^-14 of the peak's power of two.
        np.testing.assert_allclose(read_map(tmp_path / "map.exr"), image * np.float32(size), rtol=2**-11, atol=size * 2**-25)
    write_map(tmp_path / "map.exr", np.zeros((2, 2, 3), np.float32))
    assert (read_map(tmp_path / "map.exr") == 0).all()


def test_supersamples_average_into_the_nearest_point() -> None:
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0.1, 0, 0], [0.9, 0, 0], [0.2, 0, 0]])
    up = np.tile([0.0, 0, 1], (5, 1))
    albedo = np.tile([[0.5, 1.0, 0.25]], (5, 1))
    values = np.arange(15, dtype=np.float32).reshape(1, 5, 3)
    samples = Samples(position, up, albedo, 0.5)
    got = average_into_points(values, samples, 2, "irradiance")
    rounded = 6 * np.finfo(np.float32).eps  # three shares, each product and each sum rounds once
    np.testing.assert_allclose(got[0, 0], values[0, [0, 2, 4]].mean(0), rtol=rounded)
    np.testing.assert_allclose(got[0, 1], values[0, [1, 3]].mean(0), rtol=rounded)
    np.testing.assert_allclose(average_into_points(values, samples, 2, "radiosity"), got * albedo[0], rtol=1e-6)


def test_reference_integrator_bakes_the_same_light(cornell: Scene) -> None:
    """Operator and unbiased paths agree in the mean over texels within the paths' noise (16 x 32 x 2 per map) and bias."""
    many = {"direct_samples": 256, "samples": 256}  # a lamp 5 cm off a wall is a hot spot within one texel of this atlas
    by_paths = bake(cornell, config=small(transport={**many, "integrator": "reference"}))
    by_operator = bake(cornell, config=small(transport=many))
    weight = by_paths.area / by_paths.area.sum()
    one, two = (np.einsum("ltc,t->lc", d.maps("indirect", range(4)), weight) for d in (by_paths, by_operator))
    np.testing.assert_allclose(one, two, rtol=0.05)


def test_a_noise_out_of_reach_is_said(cornell: Scene, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    from ddprt.transport import effort

    monkeypatch.setattr(effort, "_MOST", 32)
    config = small(transport={"samples": "auto", "target_noise": 0.001})
    bake(cornell, config=config, progress=Progress())
    words = capsys.readouterr().err
    assert "warning: transport.target_noise: got 0.001, but the most rays that are traced unasked leave 0." in words
    assert "transport.test_samples" not in words


def test_a_setting_out_of_range_is_one_line(cornell: Scene) -> None:
    with pytest.raises(UserError, match=r"^configuration: atlas\.resolution: got 4, expected .* equal to 8; raise it$"):
        bake(cornell, resolution=4)


WHITE = {"train": ((0.1, 0.1, 0.0),), "validation": ((0.1, 0.0, 0.1),), "test": ((0.0, 0.1, 0.1),)}


@pytest.mark.parametrize(
    ("integrator", "words"),
    [("operator", "light was followed for 512 bounces"), ("paths", "diffuse bounces: largest albedo 1")],
)
def test_a_library_warns_once_and_never_prints(
    integrator: str, words: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ddprt.progress import Doubt
    from ddprt.scene.library import build

    given = {split: lightings(*[{**LAMP, "position": place} for place in places]) for split, places in WHITE.items()}
    room = build("furnace", albedo=1.0, subdivisions=1)
    config = small(points={"count": 4}, transport={"samples": 2, "test_samples": 2, "integrator": integrator, "threads": 2})
    with pytest.warns(Doubt) as caught:
        bake(room, given, config=config)
    doubts = [str(entry.message) for entry in caught if entry.category is Doubt]
    assert [doubt.startswith(words) for doubt in doubts] == [True], [(entry.category, str(entry.message)) for entry in caught]
    assert capsys.readouterr() == ("", "")


def test_doubtful_lightings_reach_a_quiet_caller(cornell: Scene) -> None:
    from ddprt.progress import Doubt

    given = {"train": lightings(LAMP, OFF), "validation": lightings(LAMP), "test": lightings(LAMP)}
    with pytest.warns(Doubt, match="1 doubtful lightings: 1 .train.: lights nothing: it has no intensity"):
        bake(cornell, given, config=small())


def test_the_seconds_that_were_expected_are_those_it_takes(cornell: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that only rays and bounces move: a ray costs 1 ms. What near senders cost is looked at in test_forecast.py."""
    from ddprt.transport.operator import Operator

    now = 0.0
    gather, some, bounce = Operator.gather, Operator.gather_some, Operator.bounce

    def costs(rays: int) -> None:
        nonlocal now
        now += rays / 1000

    def gathered(self: Operator, radiosity: np.ndarray, out: np.ndarray, rays: np.ndarray, **address: object):
        yield from gather(self, radiosity, out, rays, **address)
        costs(int(rays.sum()))

    def some_gathered(self: Operator, radiosity: np.ndarray, texels: np.ndarray, samples: int, **address: object) -> np.ndarray:
        costs(len(texels) * samples)
        return some(self, radiosity, texels, samples, **address)

    def bounced(self: Operator, *given: object, **address: object) -> object:
        nonlocal now
        now += 200.0
        return bounce(self, *given, **address)

    for name, instead in (("gather", gathered), ("gather_some", some_gathered), ("bounce", bounced)):
        monkeypatch.setattr(Operator, name, instead)
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    progress = Progress(quiet=True)
    bake(cornell, config=small(transport={"samples": 512, "test_samples": 2048, "threads": 1}), progress=progress)
    stages = [stage for stage in progress.stages if "seconds_expected" in stage]
    assert [stage["name"] for stage in stages] == ["indirect train", "indirect test"]
    for stage in stages:  # said in two digits: half a unit of the second is at most 5 % of the whole
        assert stage["seconds_expected"] == pytest.approx(stage["seconds"], rel=0.05)


def test_a_bake_paces_itself_by_rays(cornell: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every ray is a step, of this run or found done; texels with few rays come first and count for less."""
    from ddprt.progress import Stage

    paced: list[int] = []
    steps: list[int] = []
    pace, advance = Stage.pace, Stage.advance
    monkeypatch.setattr(Stage, "pace", lambda self, total: (paced.append(total), pace(self, total))[1])
    monkeypatch.setattr(Stage, "advance", lambda self, n=1, **how: (steps.append(n), advance(self, n, **how))[1])
    progress = Progress(quiet=True)
    data = bake(cornell, config=small(transport={"samples": 64, "test_samples": 128}), progress=progress)
    facts = [stage for stage in progress.stages if "variance_over_even" in stage or "samples" in stage][-2:]
    texels = int(data.covered.sum())
    assert paced == pytest.approx([stage["samples"] * texels for stage in facts], rel=0.05 / 64 * 2)  # samples: to a tenth
    assert sum(steps) - len(data.lightings) == sum(paced), "a lighting is a step of direct light"


@pytest.mark.parametrize("beside", [{"resolution": 64}, {"samples": 8}, {"seed": 0}, {"resolution": 32, "seed": 1}])
def test_settings_beside_a_config_are_refused(beside: dict, cornell: Scene) -> None:
    with pytest.raises(UserError, match=f"got {' and '.join(beside)} beside a config"):
        bake(cornell, config=Config(), **beside)
