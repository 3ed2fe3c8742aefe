"""The pack: the bits of the maps, and never those of maps that have changed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from ddprt.dataset import pack as packing
from ddprt.dataset.manifest import Manifest, map_name
from ddprt.dataset.pack import Pack, open_pack
from ddprt.dataset.store import Dataset, discard, open_dataset, write_description, write_map
from ddprt.errors import UserError
from ddprt.progress import Doubt
from ddprt.scene.exr import write_exr

SIDE, COUNT = 12, 5


def light(index: int, exposure: int = 0) -> np.ndarray:
    """A map with bright and faint light, subnormal halves and zeros among it."""
    rng = np.random.default_rng(index)
    image = rng.random((SIDE, SIDE, 3)) * 10.0 ** rng.integers(-12, 3, (SIDE, SIDE, 3))
    image[rng.random((SIDE, SIDE)) < 0.1] = 0
    return np.ldexp(image, exposure).astype(np.float32)


@pytest.fixture
def data(tmp_path: Path) -> Dataset:
    """A dataset of maps alone, of very different exposures, one of them such that float32 comes to its end."""
    folder = tmp_path / "data"
    covered = np.random.default_rng(9).random((SIDE, SIDE, 1)) < 0.7
    lightings = [{"split": "train", "lights": [{"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]}]}] * COUNT
    write_description(folder, {"schema": 1, "atlas": {"resolution": SIDE}, "lightings": lightings})
    manifest = Manifest(folder)
    write_exr(folder / "atlas" / "coverage.exr", covered.astype(np.float32))
    manifest.add("atlas/coverage.exr")
    for index, exposure in zip(range(COUNT), (0, 100, -110, -130, 110), strict=True):
        write_map(folder / map_name("indirect", index), light(index, exposure))
        manifest.add(map_name("indirect", index))
    return Dataset(folder, json.loads((folder / "dataset.json").read_text()))


def again(data: Dataset) -> Dataset:
    """The same folder, as another process finds it."""
    return Dataset(data.folder, data.description)


def rebake(data: Dataset, index: int) -> None:
    """Another map under the same name, as a bake would leave it."""
    write_map(data.folder / map_name("indirect", index), light(100 + index))
    Manifest(data.folder).add(map_name("indirect", index))


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).view(np.uint32)


def packed(data: Dataset) -> Pack:
    found = data.packed()
    assert found is not None
    return found


def test_a_pack_has_the_bits_of_the_maps(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = data.maps("indirect", range(COUNT))
    assert (np.abs(maps[maps != 0]) < np.finfo(np.float32).tiny).any(), "nothing subnormal is among it"
    pack = packed(data)
    assert pack.path.name == "indirect.f16"
    assert pack.path.stat().st_size == maps.size * 2
    monkeypatch.setattr("ddprt.dataset.store.read_exr", None)
    chosen = [4, 0, 3]
    for one in (data, again(data)):
        one.__dict__["covered"] = data.covered
        np.testing.assert_array_equal(bits(one.maps("indirect", range(COUNT))), bits(maps))
        np.testing.assert_array_equal(bits(one.maps("indirect", chosen)), bits(maps[chosen]))
    np.testing.assert_array_equal(bits(pack.read(chosen, 5, 17)), bits(maps[chosen, 5:17]))
    pack.expect(chosen, 5, 17)


def test_maps_that_are_no_halves_are_packed_as_they_are(data: Dataset) -> None:
    path = data.folder / map_name("indirect", 3)
    write_exr(path, light(3) * np.float32(1 / 3), attributes={"ddprt_exposure": "2"})
    Manifest(data.folder).add(map_name("indirect", 3))
    maps = again(data).maps("indirect", range(COUNT))
    pack = packed(data)
    assert [path.name for path in sorted(pack.path.parent.iterdir())] == ["indirect.f32", "indirect.json"]
    np.testing.assert_array_equal(bits(pack.read(range(COUNT))), bits(maps))


@pytest.mark.parametrize("exposure", [130, -160])
def test_exposures_past_float32_keep_their_light(data: Dataset, exposure: int) -> None:
    """2**exposure is infinite or 0 in float32, and light under it is neither."""
    stored = np.ldexp(np.random.default_rng(0).random((SIDE, SIDE, 3)) + 1, -8 if exposure > 0 else 14).astype(np.float16)
    write_exr(
        data.folder / map_name("indirect", 2),
        stored.astype(np.float32),
        half=True,
        attributes={"ddprt_exposure": str(exposure)},
    )
    Manifest(data.folder).add(map_name("indirect", 2))
    expected = np.ldexp(stored.astype(np.float64), exposure).astype(np.float32)[data.covered]
    assert expected.all()
    np.testing.assert_array_equal(bits(packed(again(data)).read([2])[0]), bits(expected))


def test_a_pack_is_made_once(data: Dataset) -> None:
    before = packed(data).path.stat().st_mtime_ns
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert packed(data).path.stat().st_mtime_ns == before
        assert packed(again(data)).path.stat().st_mtime_ns == before


@pytest.mark.parametrize("fresh", [True, False], ids=["another process", "the same dataset"])
def test_a_map_baked_anew_makes_it_stale(data: Dataset, fresh: bool) -> None:
    old = packed(data).read([2])
    rebake(data, 2)
    truth = Dataset(data.folder, data.description)
    shutil.copytree(data.folder, data.folder.with_name("copy"), ignore=shutil.ignore_patterns("pack"))
    expected = Dataset(data.folder.with_name("copy"), data.description).maps("indirect", range(COUNT))
    one = again(data) if fresh else data
    np.testing.assert_array_equal(bits(one.maps("indirect", range(COUNT))), bits(expected))
    with pytest.warns(Doubt, match=r"indirect/000002.exr was baked anew.; it is made anew"):
        pack = packed(one)
    np.testing.assert_array_equal(bits(pack.read(range(COUNT))), bits(expected))
    assert (pack.read([2]) != old).any()
    assert isinstance(truth._shelf.find(), Pack)


def test_a_map_changed_behind_the_manifest_is_noticed(data: Dataset) -> None:
    packed(data)
    write_map(data.folder / map_name("indirect", 1), light(77))
    expected = light(77)[data.covered]
    for one in (data, again(data)):
        assert np.abs(one.maps("indirect", [1])[0] / np.where(expected > 1, expected, np.inf)).max() < 1 + 2**-10
        with pytest.warns(Doubt) as caught:
            assert one.packed() is None
        said = " ".join(str(entry.message) for entry in caught)
        assert "differs from its hash in manifest.jsonl" in said
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # said once
            assert one.packed() is None


def test_another_coverage_makes_it_stale(data: Dataset) -> None:
    packed(data)
    covered = np.ones((SIDE, SIDE, 1), np.float32)
    write_exr(data.folder / "atlas" / "coverage.exr", covered)
    Manifest(data.folder).add("atlas/coverage.exr")
    assert again(data).maps("indirect", [0]).shape == (1, SIDE * SIDE, 3)


def test_a_copy_keeps_its_pack(data: Dataset) -> None:
    packed(data)
    copy = data.folder.with_name("copy")
    shutil.copytree(data.folder, copy, copy_function=shutil.copyfile)  # other times
    assert isinstance(Dataset(copy, data.description)._shelf.find(), Pack)


@pytest.mark.parametrize("how", ["cut", "gone", "header cut", "header of another kind"])
def test_a_damaged_pack_is_made_anew(data: Dataset, how: str) -> None:
    pack = packed(data)
    maps = pack.read(range(COUNT))
    header = pack.path.with_suffix(".json")
    if how == "cut":
        os.truncate(pack.path, pack.nbytes - 1)
    elif how == "gone":
        pack.path.unlink()
    elif how == "header cut":
        header.write_text(header.read_text()[:-20])
    else:
        header.write_text("[1]")
    np.testing.assert_array_equal(bits(data.maps("indirect", range(COUNT))), bits(maps))
    with pytest.warns(Doubt, match="made anew"):
        np.testing.assert_array_equal(bits(packed(again(data)).read(range(COUNT))), bits(maps))


def test_a_pack_cut_short_under_a_reader_is_an_error(data: Dataset) -> None:
    pack = packed(data)
    os.truncate(pack.path, pack.nbytes - 1)
    with pytest.raises(UserError, match="cut short"):
        pack.read([COUNT - 1])


KILLED = """
import os, signal, sys
from pathlib import Path
import ddprt.dataset.store as store
seen, whole = [0], store._read_stored
def read(path):
    seen[0] += 1
    if seen[0] == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(path)
store._read_stored = read
folder = Path(sys.argv[1])
store.Dataset(folder, store.read_description(folder)).packed()
"""


def test_killed_while_packing_leaves_no_half_pack(data: Dataset) -> None:
    maps = data.maps("indirect", range(COUNT))
    code = subprocess.run([sys.executable, "-c", KILLED, str(data.folder)], check=False).returncode
    assert code == -signal.SIGKILL
    left = list((data.folder / "pack").iterdir())
    assert any(path.suffix == ".f16" for path in left), "it was not killed while packing"
    assert again(data)._shelf.find() is None
    np.testing.assert_array_equal(bits(again(data).maps("indirect", range(COUNT))), bits(maps))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        packed(again(data))
    assert sorted(path.name for path in (data.folder / "pack").iterdir()) == ["indirect.f16", "indirect.json"]


def test_a_folder_that_cannot_be_written_to_does_without(data: Dataset) -> None:
    (data.folder / "pack").write_text("in the way")
    maps = data.maps("indirect", range(COUNT))
    with pytest.warns(Doubt, match="no pack of its maps"):
        assert data.packed() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert data.packed() is None
    np.testing.assert_array_equal(bits(data.maps("indirect", range(COUNT))), bits(maps))


def test_maps_that_are_no_light_are_refused_as_ever(data: Dataset) -> None:
    image = light(1)
    image[data.covered.nonzero()[0][0], data.covered.nonzero()[1][0]] = -1
    write_exr(data.folder / map_name("indirect", 1), image)
    Manifest(data.folder).add(map_name("indirect", 1))
    with pytest.raises(UserError, match=r"000001.exr: got negative values"):
        data.packed()
    assert not (data.folder / "pack" / "indirect.json").exists()


def test_the_manifest_and_a_discard(data: Dataset) -> None:
    packed(data)
    manifest = Manifest(data.folder)
    assert not manifest.damaged()
    assert not any("pack" in name for name in manifest.entries)
    discard(data.folder)
    assert not data.folder.exists() or not any(data.folder.rglob("*"))


def test_a_dataset_without_all_its_maps_has_no_pack(data: Dataset) -> None:
    (data.folder / "manifest.jsonl").unlink()
    assert data.packed() is None
    assert open_pack(data.folder, "indirect", {}) is None
    with pytest.raises(UserError, match="files missing"):
        open_dataset(data.folder)


def test_the_header_goes_first(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Data of now must never lie beside a header of then, whenever the process is killed."""
    packed(data)
    rebake(data, 0)
    header, seen = data.folder / "pack" / "indirect.json", []
    whole = packing._written
    monkeypatch.setattr(packing, "_written", lambda *job: (seen.append(header.exists()), whole(*job))[1])
    with pytest.warns(Doubt):
        packed(data)
    assert seen == [False]
