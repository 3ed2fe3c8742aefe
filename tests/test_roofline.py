"""Limits of the machine: each counts the bytes that it moves, and says what stood in its way."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from ddprt.bench.measure.timing import Timing
from ddprt.bench.peers import roofline


@pytest.mark.parametrize(("reads", "writes", "length"), [(1, 1, 1), (2, 1, 1000), (16, 3, 777)])
def test_triad_counts_each_stream_once(reads: int, writes: int, length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Timing(2.0, 1.0, 4.0, 0.0, 3)
    monkeypatch.setattr(roofline, "timed", lambda work, repeats: (work(), seen))
    found = roofline.triad(reads, writes, 4 * length * (reads + writes))
    assert found.moved == 4 * length * (reads + writes)
    assert (found.rate, found.low, found.high) == (found.moved / 2, found.moved / 4, found.moved)
    assert roofline.triad(reads, writes, 4 * length * (reads + writes) - 1).moved == found.moved  # never less than asked for


def test_triad_is_the_best_of_its_kernels_and_within_physics() -> None:
    found = roofline.triad(16, 3, 1 << 20, repeats=3)
    assert found.rate == max(found.rates.values()) == found.rates[found.kernel]
    assert found.low <= found.rate <= found.high
    assert len(found.rates) == 4
    # A core that moved no byte per 1000 cycles would be broken; none moves more than 3 x 64 bytes in each of 6e9 a second.
    assert 1e6 < found.rate < 192 * 6e9 * roofline.threads()


def test_triad_reaches_past_the_caches_unless_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roofline, "cache_bytes", lambda: roofline.Cache(10_000, "here"))
    assert 40_000 <= roofline.triad(2, 1, repeats=1).moved < 40_000 + 12


@pytest.mark.parametrize("wrong", [(0, 1), (1, 0)])
def test_triad_refuses_what_moves_nothing(wrong: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected at least one of each"):
        roofline.triad(*wrong, 1000)


@pytest.mark.parametrize("block", [1, 7, 64, 5000])
def test_streaming_kernels_read_and_write_everything(block: int) -> None:
    source = np.arange(3 * 1000, dtype=np.float32).reshape(3, 1000)
    target = np.full((2, 1000), -1, np.float32)
    roofline._add(source, target, 0, 501, block)
    assert (target[:, 501:] == -1).all()
    roofline._add(source, target, 501, 1000, block)
    assert (target == source.sum(0)).all()  # whole numbers below 2^24: exact
    for w, stream in enumerate(roofline._by_xla(tuple(map(jnp.asarray, source)), 2)()):
        assert (np.asarray(stream) == source.sum(0) + w).all()


def core(folder: Path, name: str, caches: list[tuple[int, str, str, str]]) -> None:
    for index, entry in enumerate(caches):
        here = folder / name / "cache" / f"index{index}"
        here.mkdir(parents=True)
        for key, value in zip(("level", "type", "size", "shared_cpu_list"), entry, strict=True):
            (here / key).write_text(f"{value}\n")


def test_cache_counts_each_last_level_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    for name, shared in (("cpu0", "0-1"), ("cpu1", "0-1"), ("cpu2", "2-3"), ("cpu3", "2-3"), ("cpu4", "4")):
        first = (1, "Instruction", "900M", name[3:])
        core(tmp_path, name, [first, (2, "Unified", "1024K", name[3:]), (3, "Unified", "32M", shared)])
    found = roofline.cache_bytes(tmp_path)
    assert (found.bytes, found.source) == (2 * 32 * 2**20, str(tmp_path))


def test_cache_says_where_it_is_assumed(tmp_path: Path) -> None:
    found = roofline.cache_bytes(tmp_path)
    assert found.bytes == 128 * 2**20
    assert "assumed" in found.source


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_peak_is_the_larger_rate_of_products_in_that_precision(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    results: list[Any] = []

    def spy(work: Callable[[], Any], repeats: int) -> tuple[Any, Timing]:
        results.append(work())
        return results[-1], Timing(1.0 / len(results), 1.0, 1.0, 0.0, repeats)

    monkeypatch.setattr(roofline, "timed", spy)
    found = roofline.matrix_product_peak(dtype, size=32)
    assert found.rates == {"NumPy": 2 * 32**3, "JAX": 4 * 32**3}
    assert found.rate == 4 * 32**3
    assert [str(result.dtype) for result in results] == [dtype, dtype]
    # The two add up in other orders: 32 products, each off by half a spacing, of numbers that add up to some 32 at most.
    np.testing.assert_allclose(np.asarray(results[1]), results[0], atol=32 * 32 * float(np.finfo(dtype).eps))


def test_disk_reads_a_whole_file_and_says_whether_it_was_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: (sizes.append(os.fstat(file).st_size), sync(file)))
    monkeypatch.setattr(roofline, "_PIECE", 1000)
    found = roofline.disk_read_rate(tmp_path, bytes=2500, repeats=2)
    assert sizes == [2500] == [found.bytes]
    assert found.rate > 0
    assert (found.cold is True) == (found.remark == "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("state", "cold", "says"), [(True, True, ""), (False, False, "kept"), (None, None, "does not tell")])
def test_disk_says_what_stood_in_the_way(
    state: bool | None, cold: bool | None, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roofline, "_is_cold", lambda _: state)
    found = roofline.disk_read_rate(tmp_path, bytes=100, repeats=1)
    assert found.cold is cold
    assert says in found.remark
    monkeypatch.delattr(os, "posix_fadvise")
    assert "no posix_fadvise" in roofline.disk_read_rate(tmp_path, bytes=100, repeats=1).remark
