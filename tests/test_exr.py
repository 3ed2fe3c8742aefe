"""Images and files: round trips, refusals, damage, full disks and forbidden folders."""

import errno
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ddprt.errors import UserError
from ddprt.files import make_folder, write_text, written_whole
from ddprt.scene.exr import HALF_MAX, exposure_for, read_exr, write_exr


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


@contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """Every write past `limit` bytes of a file fails, for C++ as well: EFBIG instead of ENOSPC, by the same paths."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_floats_come_back_bit_by_bit(tmp_path: Path, channels: int) -> None:
    image = noise(37, 21, channels)
    write_exr(tmp_path / "a.exr", image)
    back, _ = read_exr(tmp_path / "a.exr")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, image)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_halves_come_back_rounded(tmp_path: Path, channels: int) -> None:
    image = noise(37, 21, channels)
    write_exr(tmp_path / "a.exr", image, half=True)
    back, _ = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(back, image.astype(np.float16).astype(np.float32))
    assert (tmp_path / "a.exr").stat().st_size < 0.7 * 4 * image.size


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize(
    "view",
    [
        lambda a: a[::-1],
        lambda a: a[:, ::-1],
        lambda a: a[..., ::-1],
        lambda a: a.swapaxes(0, 1),
        lambda a: a[3:20, 2:9],
        lambda a: a[::2, ::3],
        lambda a: np.asfortranarray(a),
        lambda a: a.astype(np.float64),
    ],
)
def test_any_memory_layout_is_written_as_it_reads(tmp_path: Path, view: Callable[[np.ndarray], np.ndarray], half: bool) -> None:
    image = view(noise(37, 21, 3))
    write_exr(tmp_path / "a.exr", image, half=half)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], image.astype(np.float16 if half else np.float32))


def test_row_0_is_the_top_of_the_file(tmp_path: Path) -> None:
    import OpenEXR

    image = np.zeros((5, 7, 3), np.float32)
    image[0, 1] = 1, 2, 3
    write_exr(tmp_path / "a.exr", image)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        header, channels = file.header(), file.channels()
        assert "INCREASING_Y" in str(header["lineOrder"]).upper()
        assert [float(channels[name].pixels[0, 1]) for name in "RGB"] == [1, 2, 3]
        assert float(channels["R"].pixels.sum()) == 1
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], image)


def test_attributes_come_back(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", noise(4, 4, 3), attributes={"ddprt:unit": "W/m²", "exposure": "3"})
    _, header = read_exr(tmp_path / "a.exr")
    assert header["ddprt:unit"] == "W/m²"
    assert header["exposure"] == "3"


@pytest.mark.parametrize(
    ("value", "half", "fits"),
    [
        (HALF_MAX, True, True),
        (-HALF_MAX, True, True),
        (65505.0, True, False),
        (-70000.0, True, False),
        (65520.0, False, True),
        (3.4e38, False, True),
        (1e39, False, False),
        (np.nan, False, False),
        (np.nan, True, False),
        (np.inf, False, False),
        (-np.inf, True, False),
    ],
)
def test_what_the_format_cannot_hold_is_refused(tmp_path: Path, value: float, half: bool, fits: bool) -> None:
    image = np.zeros((3, 3, 3))
    image[1, 2, 0] = value
    if fits:
        write_exr(tmp_path / "a.exr", image, half=half)
        assert read_exr(tmp_path / "a.exr")[0][1, 2, 0] == np.float32(value)
    else:
        with pytest.raises(ValueError, match="do not fit"):
            write_exr(tmp_path / "a.exr", image, half=half)
        assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("peak", [1e-30, 0.3, 1.0, 65504.0, 1e6, 3e38])
def test_exposure_brings_any_peak_into_half_range(peak: float) -> None:
    exposure = exposure_for(peak)
    assert isinstance(exposure, int)
    assert 0.5 < peak * 2.0**-exposure <= 1
    assert exposure_for(0.0) == exposure_for(np.inf) == exposure_for(np.nan) == 0


# --- bad files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.03, 0.1, 0.5, 0.9, 0.999, 1.0])
def test_truncated_files_are_named(tmp_path: Path, share: float) -> None:
    write_exr(tmp_path / "whole.exr", noise(64, 48, 3))
    whole = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: min(int(share * len(whole)), len(whole) - 1)])
    with pytest.raises(UserError, match=r"cut\.exr: not a whole EXR image") as caught:
        read_exr(tmp_path / "cut.exr")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("place", ["absent.exr", "folder.exr", "below/absent.exr"])
def test_missing_files_are_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "folder.exr").mkdir()
    with pytest.raises(UserError, match="got no file, expected an EXR image"):
        read_exr(tmp_path / place)


def test_what_is_no_exr_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_bytes(b"\x89PNG\r\n" + bytes(1000))
    with pytest.raises(UserError, match="not a whole EXR image"):
        read_exr(tmp_path / "a.exr")


def test_channels_that_are_not_colours_are_named(tmp_path: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"depth": np.ones((4, 4), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(UserError, match="got channels depth, expected RGB, RGBA or Y"):
        read_exr(tmp_path / "a.exr")


# --- whole or absent --------------------------------------------------------------------------------------------------


def test_the_old_file_stays_when_the_writer_fails(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with written_whole(path) as temporary:
            temporary.write_text("new, but not whole")
            raise KeyError("a fault of the writer")

    with pytest.raises(KeyError):
        fail()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with written_whole(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == path.parent  # a rename is atomic within one file system only
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_folders_are_made(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "b" / "c.txt", "grüße")
    assert (tmp_path / "a" / "b" / "c.txt").read_bytes() == "grüße".encode()


WRITERS: dict[str, Callable[[Path], None]] = {
    "text": lambda path: write_text(path, "x" * 50_000),
    "exr": lambda path: write_exr(path, noise(64, 64, 3)),
    "small exr": lambda path: write_exr(path, np.ones((2, 2, 3), np.float32)),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_unwritable_places_are_named(tmp_path: Path, writer: str) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "a.exr", tmp_path / "file" / "deep" / "a.exr", tmp_path / "folder"):
        with pytest.raises(UserError, match=r"folder cannot be made|cannot be written") as caught:
            WRITERS[writer](path)
        assert "\n" not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]
    with pytest.raises(UserError, match="folder cannot be made"):
        make_folder(tmp_path / "file" / "deep")


@pytest.mark.parametrize("limit", [0, 100, 300])
@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, writer: str, limit: int) -> None:
    path = tmp_path / "a.exr"
    path.write_text("old")
    with full_disk(limit), pytest.raises(UserError, match=r"a\.exr: cannot be written .*free some space") as caught:
        WRITERS[writer](path)
    assert "tmp" not in str(caught.value).removeprefix(str(path))
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.exr"]


def test_a_disk_that_fills_within_the_last_buffer_is_noticed(tmp_path: Path) -> None:
    image = noise(64, 64, 3)
    write_exr(tmp_path / "a.exr", image)
    whole = (tmp_path / "a.exr").stat().st_size
    for missing in (1, 10, 1000):
        with full_disk(whole - missing), pytest.raises(UserError, match="cannot be written"):
            write_exr(tmp_path / "b.exr", image)
    assert os.listdir(tmp_path) == ["a.exr"]


def test_a_flush_that_fails_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write_text(tmp_path / "a.txt", "old")
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(UserError, match="No space left on device"):
        write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]
