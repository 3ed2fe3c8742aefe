"""What this machine can do at best: the limits that seconds are held against, measured in the same run.

A streaming kernel can be no faster than memory, a product of matrices no faster than the best one found here, reading a
dataset no faster than the disk. Bytes are those that the program reads and writes, as McCalpin's STREAM counts them: lines
that a processor fetches before it overwrites them come on top, for the kernel and for what is compared with it alike.
"""

import errno
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ddprt.bench.measure.timing import timed
from ddprt.compiled import compiled

BEYOND = 4
"""Buffers that are to lie outside of the caches are at least so many times their size."""
_UNTOLD = 128 << 20  # bytes, where nobody tells: more than the second cache of any one GPU or the third of most processors
_BLOCKS = (64, 256, 1024)  # floats of each stream in a row; their sum stays in the first cache
_CACHES = Path("/sys/devices/system/cpu")
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30}
_PIECE = 8 << 20  # bytes of one read


def threads() -> int:
    """Cores that this process may run on: what JAX takes, so what every peer gets."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Cache:
    """The last-level cache.

    Attributes:
      bytes: of all those together that this process' cores have; on a GPU what is assumed of it.
      source: who said so.
    """

    bytes: int
    source: str


def cache_bytes(folder: Path = _CACHES) -> Cache:
    """Size of the last-level cache as Linux lists it; 128 MiB are assumed, and said to be, where nobody tells.

    Args:
      folder: of Linux' list of processors (Documentation/ABI/testing/sysfs-devices-system-cpu: size, level, shared_cpu_list).
    """
    if jax.default_backend() != "cpu":
        return Cache(_UNTOLD, f"assumed: a {jax.default_backend()} does not tell")
    found: dict[tuple[int, str], int] = {}
    allowed = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    for entry in (entry for core in allowed for entry in (folder / f"cpu{core}" / "cache").glob("index*")):
        try:
            level, kind, size, shared = (
                (entry / name).read_text().strip() for name in ("level", "type", "size", "shared_cpu_list")
            )
        except OSError:
            continue
        if kind != "Instruction":
            found[int(level), shared] = int(size.rstrip("KMG")) * _UNITS.get(size[-1], 1)
    if not found:
        return Cache(_UNTOLD, f"assumed: {folder} does not tell")
    last = max(level for level, _ in found)
    return Cache(sum(size for (level, _), size in found.items() if level == last), str(folder))


@dataclass(frozen=True)
class Bandwidth:
    """Of a streaming kernel.

    Attributes:
      rate: bytes read and written per second, by the median of repeats of the fastest kernel.
      low, high: the same by the quartiles.
      moved: bytes that one run reads and writes.
      reads, writes: streams of float32.
      kernel: which of the candidates was the fastest.
      rates: of all candidates.
    """

    rate: float
    low: float
    high: float
    moved: int
    reads: int
    writes: int
    kernel: str
    rates: dict[str, float]

    def record(self) -> dict[str, Any]:
        """As plain numbers, in GB/s."""
        plain = asdict(self) | {name: round(getattr(self, name) / 1e9, 3) for name in ("rate", "low", "high")}
        return plain | {"rates": {name: round(rate / 1e9, 3) for name, rate in self.rates.items()}, "unit": "GB/s"}


def triad(reads: int, writes: int, bytes: int | None = None, *, repeats: int = 7) -> Bandwidth:
    """Bandwidth of y_w = sum_r x_r, element by element, with any mix of streams.

    The best of these counts: compiled loops on all threads, which go through the streams in blocks of several lengths, and
    XLA's own loops.

    Args:
      reads: streams that are read, at least 1.
      writes: streams that are written, at least 1.
      bytes: of all streams together, about; four times the last-level cache unless given.
      repeats: runs of each kernel.
    Reference: McCalpin, Memory bandwidth and machine balance, IEEE TCCA Newsletter 1995.
    """
    if min(reads, writes) < 1:
        raise ValueError(f"got {reads} streams read and {writes} written, expected at least one of each")
    total = bytes if bytes is not None else BEYOND * cache_bytes().bytes
    length = max(1, -(-total // (4 * (reads + writes))))
    moved = 4 * length * (reads + writes)
    source, target = np.ones((reads, length), np.float32), np.zeros((writes, length), np.float32)
    works: dict[str, Callable[[], Any]] = {"XLA": _by_xla(tuple(map(jnp.asarray, source)), writes)}
    with ThreadPoolExecutor(threads()) as pool:
        if jax.default_backend() == "cpu":
            works |= {f"blocks of {block}": _by_loops(pool, source, target, block) for block in _BLOCKS}
        found = {name: timed(work, repeats)[1] for name, work in works.items()}
    best = min(found, key=lambda name: found[name].median)
    rates = {name: moved / timing.median for name, timing in found.items()}
    return Bandwidth(rates[best], moved / found[best].high, moved / found[best].low, moved, reads, writes, best, rates)


def _by_xla(source: tuple[jax.Array, ...], writes: int) -> Callable[[], Any]:
    # Each stream is another sum, or they would be one.
    add = jax.jit(lambda source: tuple(sum(source[1:], source[0]) + w for w in range(writes)))
    return lambda: add(source)


def _by_loops(pool: ThreadPoolExecutor, source: np.ndarray, target: np.ndarray, block: int) -> Callable[[], None]:
    ends = np.linspace(0, source.shape[1], threads() + 1).astype(int)

    def work() -> None:
        for done in [pool.submit(_add, source, target, start, stop, block) for start, stop in pairwise(ends)]:
            done.result()

    return work


@compiled
def _add(source: np.ndarray, target: np.ndarray, start: int, stop: int, block: int) -> None:
    total = np.empty(block, np.float32)
    for low in range(start, stop, block):
        count = min(block, stop - low)
        total[:count] = source[0, low : low + count]
        for r in range(1, source.shape[0]):
            for i in range(count):
                total[i] += source[r, low + i]
        for w in range(target.shape[0]):
            for i in range(count):
                target[w, low + i] = total[i]


@dataclass(frozen=True)
class Peak:
    """Floating-point operations per second of a product of matrices, two per multiply-add.

    Attributes:
      rate: the larger of the rates.
      rates: by NumPy's BLAS and by JAX.
      size: rows and columns of the factors.
      dtype: of the factors.
    """

    rate: float
    rates: dict[str, float]
    size: int
    dtype: str

    def record(self) -> dict[str, Any]:
        """As plain numbers, in GFlop/s."""
        rates = {name: round(rate / 1e9, 2) for name, rate in self.rates.items()}
        return asdict(self) | {"rate": round(self.rate / 1e9, 2), "rates": rates, "unit": "GFlop/s"}


def matrix_product_peak(dtype: str, *, size: int = 3072, repeats: int = 5) -> Peak:
    """The rate of large square products, by NumPy's BLAS and by JAX.

    Args:
      dtype: "float32" or "float64".
      size: rows and columns of the factors.
      repeats: products of which the median counts.
    """
    factor = np.random.default_rng(0).standard_normal((size, size)).astype(dtype)
    work = 2 * size**3
    rates = {"NumPy": work / timed(lambda: factor @ factor, repeats)[1].median}
    with jax.enable_x64(True):
        moved = jnp.asarray(factor)
        product = jax.jit(lambda a: jnp.matmul(a, a, precision="highest"))
        rates["JAX"] = work / timed(lambda: product(moved), repeats)[1].median
    return Peak(max(rates.values()), rates, size, dtype)


@dataclass(frozen=True)
class DiskRate:
    """Of a file that is read from its begin to its end.

    Attributes:
      rate: bytes per second, median of repeats.
      bytes: of the file.
      cold: the system let go of its copy of the file in memory before each repeat; None where it does not tell.
      remark: what stood in the way; empty where it is cold.
    """

    rate: float
    bytes: int
    cold: bool | None
    remark: str

    def record(self) -> dict[str, Any]:
        """As plain numbers, in GB/s."""
        return asdict(self) | {"rate": round(self.rate / 1e9, 3), "unit": "GB/s"}


def disk_read_rate(folder: str | Path, *, bytes: int = 512 << 20, repeats: int = 3) -> DiskRate:
    """Rate of reading a file in the folder, in pieces of 8 MiB, with the system's copy in memory dropped before.

    The drop is asked for by posix_fadvise(POSIX_FADV_DONTNEED) after fsync, and looked at by preadv2(RWF_NOWAIT), which
    refuses to read what is not in memory. What a virtual machine's host keeps in its own memory cannot be dropped from here.

    Args:
      folder: on the disk in question; a file of that size is made there and removed.
      bytes: of the file.
      repeats: reads of which the median counts.
    """
    piece = np.random.default_rng(0).bytes(min(_PIECE, bytes))
    seconds, states, remark = [], [], ""
    with tempfile.NamedTemporaryFile(dir=folder, prefix="ddprt-disk-") as file:
        for left in range(bytes, 0, -len(piece)):
            file.write(piece[: min(left, len(piece))])
        file.flush()
        os.fsync(file.fileno())
        buffer = bytearray(_PIECE)
        for _ in range(repeats):
            remark = _drop(file.fileno())
            states.append(False if remark else _is_cold(file.fileno()))
            with open(file.name, "rb", buffering=0) as reader:
                start = time.perf_counter()
                while reader.readinto(buffer):
                    pass
                seconds.append(time.perf_counter() - start)
    cold = None if None in states else all(states)
    remark = remark or {True: "", False: "the system kept the file in memory", None: "the system does not tell"}[cold]
    return DiskRate(bytes / float(np.median(seconds)), bytes, cold, remark)


def _drop(file: int) -> str:
    """Asks the system to forget its copy of a file; what stood in the way, if anything."""
    if not hasattr(os, "posix_fadvise"):
        return "this system has no posix_fadvise"
    try:
        os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
    except OSError as error:
        return f"posix_fadvise: {error.strerror}"
    return ""


def _is_cold(file: int) -> bool | None:
    """Whether the first bytes of a file are not in memory; None where the system does not tell."""
    if not hasattr(os, "RWF_NOWAIT"):
        return None
    try:
        os.preadv(file, [bytearray(1)], 0, os.RWF_NOWAIT)
    except OSError as error:
        return True if error.errno == errno.EAGAIN else None
    return False
