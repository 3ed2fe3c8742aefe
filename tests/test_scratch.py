"""Maps in the making: when they may go on, when they must not, and bakes that are killed while they gather."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddprt.config import Config
from ddprt.dataset import scratch
from ddprt.dataset.generate import bake
from ddprt.dataset.scratch import Scratch
from ddprt.dataset.store import open_dataset
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.scene.mesh import Scene
from ddprt.transport import operator
from ddprt.transport.operator import Operator

SHAPE, KEY = (2, 5, 3), {"seed": 1, "rays": 7}


def begun(folder: Path, tiles: int = 3) -> Path:
    """Maps of ones with so many tiles noted, as a process that has ended leaves them."""
    path = folder / "maps.part"
    made = Scratch(path, SHAPE, KEY)
    made.maps[:] = 1
    for _ in range(tiles):
        made.advance()
    made.note()
    del made
    return path


def again(path: Path, shape: tuple[int, int, int] = SHAPE, key: dict[str, Any] | None = None) -> Scratch:
    return Scratch(path, shape, KEY if key is None else key)


def test_it_goes_on_where_the_journal_ends(tmp_path: Path) -> None:
    path = begun(tmp_path)
    resumed = again(path, key=dict(reversed(KEY.items())))  # the order of keys means nothing
    assert resumed.done == 3
    np.testing.assert_array_equal(resumed.maps, np.ones(SHAPE, np.float32))
    assert resumed.maps.dtype == np.float32
    resumed.maps[0] = 2
    resumed.advance()
    resumed.note()
    assert resumed.done == 4
    last = again(path)
    assert last.done == 4
    assert last.maps[0, 0, 0] == 2
    assert last.maps[1, 0, 0] == 1


@pytest.mark.parametrize(
    ("shape", "key"),
    [
        (SHAPE, {"seed": 2, "rays": 7}),
        (SHAPE, {"seed": 1}),
        (SHAPE, {"seed": 1, "rays": 7, "half": 0}),
        ((5, 2, 3), KEY),  # as many bytes, other maps
        ((2, 6, 3), KEY),
        ((3, 5, 3), KEY),
    ],
)
def test_another_key_or_shape_begins_anew(tmp_path: Path, shape: tuple[int, int, int], key: dict[str, Any]) -> None:
    fresh = again(begun(tmp_path), shape, key)
    assert fresh.done == 0
    assert fresh.maps.shape == shape
    assert not fresh.maps.any()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def with_tiles(journal: Path, tiles: str) -> None:
    journal.write_text(journal.read_text().replace('"tiles": 3', f'"tiles": {tiles}'))


def without_tiles(journal: Path) -> None:
    journal.write_text(json.dumps({"key": json.loads(journal.read_text())["key"]}))


DAMAGE: dict[str, Callable[[Path, Path], Any]] = {
    "journal gone": lambda maps, journal: journal.unlink(),
    "journal cut": lambda maps, journal: cut(journal),
    "journal empty": lambda maps, journal: journal.write_bytes(b""),
    "journal of noise": lambda maps, journal: journal.write_bytes(bytes(range(256))),
    "journal of a list": lambda maps, journal: journal.write_text("[1, 2]"),
    "journal of a number": lambda maps, journal: journal.write_text("3"),
    "journal without tiles": lambda maps, journal: without_tiles(journal),
    "journal with null tiles": lambda maps, journal: with_tiles(journal, "null"),
    "journal with endless tiles": lambda maps, journal: with_tiles(journal, "1e999"),
    "journal is a folder": lambda maps, journal: (journal.unlink(), journal.mkdir()),
    "maps gone": lambda maps, journal: maps.unlink(),
    "maps cut": lambda maps, journal: cut(maps),
    "maps too long": lambda maps, journal: maps.write_bytes(maps.read_bytes() + b"x"),
    "maps empty": lambda maps, journal: maps.write_bytes(b""),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_begins_anew(tmp_path: Path, damage: str) -> None:
    path = begun(tmp_path)
    DAMAGE[damage](path, path.with_suffix(".json"))
    if damage == "journal is a folder":
        with pytest.raises(UserError) as caught:
            again(path).note()
        assert "\n" not in str(caught.value)
        return
    fresh = again(path)
    assert fresh.done == 0
    assert not fresh.maps.any()
    fresh.maps[:] = 5
    fresh.advance()
    fresh.note()
    assert again(path).done == 1


@pytest.mark.parametrize("key", [KEY, {"seed": 2}])
def test_beginning_anew_takes_nothing_from_who_is_still_at_work(tmp_path: Path, key: dict[str, Any]) -> None:
    """Where no lock keeps two bakes apart, each has maps of its own."""
    made = Scratch(tmp_path / "maps.part", SHAPE, KEY)
    made.maps[:] = 1
    made.advance()
    again(made.path, key=key).maps[:] = 2
    np.testing.assert_array_equal(made.maps, np.ones(SHAPE, np.float32))


@pytest.mark.parametrize("reason", ["maps gone", "maps cut", "another key"])
def test_an_old_journal_never_speaks_for_new_maps(tmp_path: Path, reason: str) -> None:
    """Begun anew and killed before the first entry: nothing of the new maps is done, whatever was done of the old ones."""
    path = begun(tmp_path)
    if reason == "another key":
        again(path, key={"seed": 2}).maps[0] = 9
    else:
        DAMAGE[reason](path, path.with_suffix(".json"))
        again(path)
    assert again(path).done == 0


def test_tiles_are_noted_now_and_then_and_never_before_they_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "maps.part"
    now = [0.0]
    monkeypatch.setattr(scratch.time, "monotonic", lambda: now[0])
    made, noted = Scratch(path, SHAPE, KEY), []
    flush = np.memmap.flush
    monkeypatch.setattr(np.memmap, "flush", lambda self: (noted.append(path.with_suffix(".json").exists()), flush(self)))
    for second in (1, 5, 9.9, 11, 12, 20, 22):
        now[0] = second
        made.advance()
        assert made.done == {11: 4, 12: 4, 20: 4, 22: 7}.get(second, 0)
        assert again(path).done == made.done if made.done else not path.with_suffix(".json").exists()
    assert noted == [False, True]  # first the maps, then the journal


def test_nothing_stays_behind(tmp_path: Path) -> None:
    path = begun(tmp_path / "deep" / "er")
    last = again(path)
    last.remove()
    assert list(path.parent.iterdir()) == []
    unnoted = again(path)
    unnoted.remove()
    assert list(path.parent.iterdir()) == []


# --- the disk ---------------------------------------------------------------------------------------------------------


def one_line(caught: pytest.ExceptionInfo) -> None:
    assert "\n" not in str(caught.value)
    assert "maps" in str(caught.value)


@pytest.mark.parametrize("fault", ["a file for a folder", "a folder for the file"])
def test_places_that_cannot_be_written(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "maps" / "maps.part"
    if fault == "a file for a folder":
        (tmp_path / "maps").write_text("")
    else:
        path.mkdir(parents=True)
    with pytest.raises(UserError) as caught:
        again(path)
    one_line(caught)


LIMITED = """
import resource, sys
from pathlib import Path
from ddprt.dataset.scratch import Scratch
from ddprt.errors import UserError
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16))
try:
    Scratch(Path(sys.argv[1]), (100, 1000, 3), {}).maps[:] = 1
except UserError as error:
    print(error)
"""


def test_a_file_that_may_not_grow(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", LIMITED, str(tmp_path / "maps.part")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "maps.part: cannot be written" in done.stdout
    assert done.stdout.count("\n") == 1


FULL = """
import sys
from pathlib import Path
import numpy as np
from ddprt.dataset.scratch import Scratch
from ddprt.errors import UserError
try:
    made = Scratch(Path(sys.argv[1]), (100, 1000, 3), {})
    made.maps[:] = 1
    made.note()
except UserError as error:
    print(error)
"""


def test_a_full_disk_is_an_error_and_not_a_signal(tmp_path: Path) -> None:
    """A real file system of 256 KiB, where this user may mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    mounted = (
        subprocess.run([mount, "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)], capture_output=True) if mount else None
    )
    if mounted is None or mounted.returncode != 0:
        pytest.skip("no right to mount a small disk")
    try:
        done = subprocess.run([sys.executable, "-c", FULL, str(disk / "maps.part")], capture_output=True, text=True)
    finally:
        subprocess.run(["umount", str(disk)], check=True)
    assert done.returncode == 0, f"died by signal {-done.returncode}: {done.stderr}"
    assert "maps.part: cannot be written (No space left on device)" in done.stdout
    assert done.stdout.count("\n") == 1


def test_maps_that_cannot_be_flushed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Scratch(tmp_path / "maps.part", SHAPE, KEY)

    def full(_: np.memmap) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.memmap, "flush", full)
    made.advance()
    with pytest.raises(UserError) as caught:
        made.note()
    one_line(caught)
    monkeypatch.undo()
    assert again(made.path).done == 0


# --- bakes ------------------------------------------------------------------------------------------------------------

CONFIG = Config.model_validate(
    {
        "atlas": {"resolution": 48},
        "lightings": {"train": 3, "validation": 1, "test": 2, "clearance": 0.05},
        "points": {"count": 8, "supersample": 1},
        "transport": {"samples": 64, "test_samples": 128, "direct_samples": 2, "threads": 2},
    }
)


def contents(folder: Path) -> dict[str, bytes]:
    names = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in names}


def rays_of(
    folder: Path, cornell: Scene, monkeypatch: pytest.MonkeyPatch, tiles: list[list[int]] | None = None, **settings: Any
) -> list[int]:
    """Bakes, and counts the rays that each gather traces; those of each of its tiles, traced or not, go into `tiles`."""
    counts, gather, seen_from = [], Operator.gather, operator.seen_from
    traced: list[int] = []  # rays that leave texels; what near ones go on to is not counted

    def noted(*given: Any) -> Any:
        for seen in seen_from(*given):
            traced.append(seen.cells.size)
            yield seen

    def counted(self: Operator, radiosity: np.ndarray, out: np.ndarray, rays: np.ndarray, **where: Any) -> Any:
        if not isinstance(out, np.memmap):
            yield from gather(self, radiosity, out, rays, **where)  # a probe
            return
        before = sum(traced)
        yield from gather(self, radiosity, out, rays, **where)
        counts.append(sum(traced) - before)
        if tiles is not None:
            tiles.append([])
            for samples in np.unique(rays):
                texels, size = int((rays == samples).sum()), max(64, (1 << 14) // int(samples))
                tiles[-1] += [int(samples) * min(size, texels - first) for first in range(0, texels, size)]

    with monkeypatch.context() as patch:
        patch.setattr(operator, "seen_from", noted)
        patch.setattr(Operator, "gather", counted)
        bake(cornell, config=CONFIG, out=folder, **settings)
    return counts


@pytest.fixture(scope="module", autouse=True)
def _single_tiles() -> Iterator[None]:
    """Stretches of one tile, so that even these small maps have many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(operator, "_TOGETHER", 1)
        yield


@pytest.fixture(scope="module")
def whole(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], list[int]]:
    """An uninterrupted bake: its files, and the rays of its three gathers (training, and two halves of the held-out)."""
    folder = tmp_path_factory.mktemp("whole") / "dataset"
    with pytest.MonkeyPatch.context() as patch:
        counts = rays_of(folder, cornell, patch)
    assert len(counts) == 3
    count = int(open_dataset(folder).covered.sum())
    assert counts[1:] == [64 * count, 64 * count]  # as was asked for: two halves of 128 rays
    assert 0.9 * 64 * count < counts[0] <= 64 * count
    assert not list(folder.glob("*.part"))
    assert not list(folder.glob("*-*.json"))
    return contents(folder), counts


class StoppedError(Exception):
    pass


@pytest.mark.parametrize(("part", "after"), [(0, 4), (1, 3), pytest.param(2, 2, marks=pytest.mark.slow)])
def test_a_stopped_bake_goes_on_with_the_same_bits(
    part: int, after: int, cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    whole: tuple[dict[str, bytes], list[int]],
) -> None:  # fmt: skip
    """StoppedError after some tiles of the training maps or of either half: the rest is traced, and no more."""
    folder, stopped = tmp_path / "dataset", []
    advance = Scratch.advance

    def stopping(self: Scratch) -> None:
        advance(self)
        name = ("train-0.part", "test-0.part", "test-1.part")[part]
        if self.path.name == name and self.done == after:
            stopped.append(self.path)
            raise StoppedError

    monkeypatch.setattr(scratch, "_EVERY", -1)  # note every tile
    with monkeypatch.context() as patch:
        patch.setattr(Scratch, "advance", stopping)
        with pytest.raises(StoppedError):
            bake(cornell, config=CONFIG, out=folder)
    assert json.loads(stopped[0].with_suffix(".json").read_text())["tiles"] == after
    with pytest.raises(UserError, match="expected a finished bake"):
        open_dataset(folder)
    tiles: list[list[int]] = []
    counts = rays_of(folder, cornell, monkeypatch, tiles)
    files, expected = whole
    assert contents(folder).keys() == files.keys()
    assert [name for name, data in contents(folder).items() if data != files[name] and name != "manifest.jsonl"] == []
    # A finished half is read, not traced, and finished training maps are not asked for; the one that was stopped lacks its
    # first tiles.
    skipped = {0: [after, 0, 0], 1: [after, 0], 2: [1000, after]}[part]
    assert [sum(rays) for rays in tiles] == expected[len(expected) - len(skipped) :]
    assert counts == [sum(rays[first:]) for rays, first in zip(tiles, skipped, strict=True)]


KILLED = """
import os, signal, sys
from ddprt.config import load_config
from ddprt.dataset import scratch
from ddprt.dataset.generate import bake
from ddprt.dataset.scratch import Scratch
from ddprt.scene.library import build
from ddprt.transport import operator
advance = Scratch.advance
def killed(self):
    advance(self)
    if self.path.name == "train-0.part" and self.done == 5:
        os.kill(os.getpid(), signal.SIGKILL)
Scratch.advance, scratch._EVERY, operator._TOGETHER = killed, -1, 1
bake(build("cornell"), config=load_config(sys.argv[1]), out=sys.argv[2])
"""


def test_a_killed_bake_goes_on_with_the_same_bits(
    cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: tuple[dict[str, bytes], list[int]]
) -> None:
    """SIGKILL in a process of its own; a third process' settings (threads) may differ."""
    folder, job = tmp_path / "dataset", tmp_path / "job.toml"
    job.write_text(CONFIG.model_copy(update={"transport": CONFIG.transport.model_copy(update={"threads": 1})}).to_toml())
    done = subprocess.run([sys.executable, "-c", KILLED, str(job), str(folder)], capture_output=True, text=True, env=os.environ)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert json.loads((folder / "train-0.json").read_text())["tiles"] == 5
    files, expected = whole
    tiles: list[list[int]] = []
    counts = rays_of(folder, cornell, monkeypatch, tiles)
    assert counts == [sum(tiles[0][5:]), *expected[1:]]
    assert counts[0] < expected[0] == sum(tiles[0])
    assert contents(folder).keys() == files.keys()
    assert [name for name, data in contents(folder).items() if data != files[name] and name != "manifest.jsonl"] == []


def test_maps_of_other_rays_are_not_gone_on_with(
    cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: tuple[dict[str, bytes], list[int]]
) -> None:
    """Rays are chosen anew when a bake goes on; were they chosen otherwise, what is there would belong to others."""
    from ddprt.transport import effort

    folder, choose = tmp_path / "dataset", effort.choose_rays

    def otherwise(*given: Any, **settings: Any) -> Any:
        chosen = choose(*given, **settings)
        return effort.Choice(chosen.rays + (np.arange(len(chosen.rays)) == 0), chosen.footprints, chosen.facts)

    def stopping(self: Scratch) -> None:
        advance(self)
        if self.done == 4:
            raise StoppedError

    advance = Scratch.advance
    monkeypatch.setattr(scratch, "_EVERY", -1)
    with monkeypatch.context() as patch:
        patch.setattr(effort, "choose_rays", otherwise)
        patch.setattr(Scratch, "advance", stopping)
        with pytest.raises(StoppedError):
            bake(cornell, config=CONFIG, out=folder)
    counts = rays_of(folder, cornell, monkeypatch)
    files, expected = whole
    assert counts == expected
    assert [name for name, data in contents(folder).items() if data != files[name] and name != "manifest.jsonl"] == []


def test_finished_maps_are_not_gathered_again(
    cornell: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: tuple[dict[str, bytes], list[int]]
) -> None:
    """StoppedError between the last tile and the last file: a bake that goes on writes files and traces no gather ray."""
    folder, files = tmp_path / "dataset", whole[0]

    def stopping(_: Scratch) -> None:
        raise StoppedError

    with monkeypatch.context() as patch:
        patch.setattr(Scratch, "remove", stopping)
        with pytest.raises(StoppedError):
            bake(cornell, config=CONFIG, out=folder)
    (folder / "indirect" / "000001.exr").unlink()
    progress = Progress(quiet=True)
    counts = rays_of(folder, cornell, monkeypatch, progress=progress)
    assert counts[0] == 0
    assert contents(folder)["indirect/000001.exr"] == files["indirect/000001.exr"]
    assert not list(folder.glob("*.part"))
