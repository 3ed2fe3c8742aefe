"""A fit of light that stays on disk: seconds, MB/s against the disk's own, and memory against the fit in memory.

Random maps of known rank with falling strengths, half floats, straight into a pack: 10^6 texels x 128 lightings x RGB, 0.77 GB.
The page cache forgets the file before every measurement. The disk's own rate is that of the same file read in pieces of 8 MiB
in the same run, before and after. Each fit runs in a process of its own, compiled by a first one of the same shapes
and 3 blocks; so its peak is that of the fit, with the 0.1 GiB or so that compiling leaves held already.

    python experiments/streaming.py            10^6 texels, minutes
    python experiments/streaming.py --quick    10^5 texels, under a minute
    --folder DIR    where the pack goes: the disk that is measured (default: a temporary folder)
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ddprt.bench.measure.timing import peak_memory
from ddprt.dataset.pack import Pack
from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.fitting.encoding import Encoding
from ddprt.methods.method import Examples, Frame, block_texels, columns
from ddprt.runtime.train import StreamedMaps

LIGHTINGS, POINTS, BASES, RANK = 128, 128, 16, 40
EXPOSURE = -3


def write(path: Path, texels: int) -> None:
    """Light of rank `RANK` with strengths that fall a hundredfold, a strip of texels per lighting at a time."""
    rng = np.random.default_rng(0)
    shapes = rng.random((RANK, texels * 3), np.float32)
    with path.open("wb") as file:
        for _ in range(LIGHTINGS):
            strengths = rng.random(RANK, np.float32) * np.geomspace(1, 1e-2, RANK, dtype=np.float32)
            file.write((strengths @ shapes).astype("<f2").tobytes())
        file.flush()
        os.fsync(file.fileno())


def forget(path: Path) -> None:
    """Drops a file from the page cache."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def disk_rate(path: Path) -> float:
    """MB/s of reading a file from one end to the other."""
    forget(path)
    buffer, start = bytearray(2**23), time.perf_counter()
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass
    return path.stat().st_size / 1e6 / (time.perf_counter() - start)


def examples(path: Path, texels: int, *, held: bool) -> Examples:
    """Pairs whose light lies in the pack, or in memory."""
    pack = Pack(path, path.stat().st_size // (6 * LIGHTINGS), np.dtype("<f2"), (EXPOSURE,) * LIGHTINGS, {})
    if texels < pack.texels:
        pack = Pack(path, texels, np.dtype("<f2"), (EXPOSURE,) * LIGHTINGS, {})
    scale = jnp.full((LIGHTINGS, 3), 2.0)
    maps = StreamedMaps(pack, tuple(range(LIGHTINGS)), Encoding(), scale)
    where = jnp.zeros((POINTS, 3))
    frame = Frame(jnp.zeros((LIGHTINGS, POINTS, 3)), where, where)
    light = maps.some(slice(None)) if held else maps
    return Examples(frame, light, scale, np.ones(texels, np.float32))


def basis(path: Path, texels: int, *, held: bool) -> dict[str, float]:
    """Seconds of the basis, from the bytes on disk on."""
    start = time.perf_counter()
    pairs = examples(path, texels, held=held)
    loaded = time.perf_counter() - start
    rows, _ = columns(pairs)
    entries = jnp.asarray(entry_weights(pairs.area, pairs.weights, pairs.channels))
    vectors = jax.block_until_ready(fit_basis(rows, entries, bases=BASES).vectors)
    return {"seconds": time.perf_counter() - start, "loading": loaded, "check": float(jnp.sum(jnp.abs(vectors)))}


def passes(path: Path, texels: int) -> dict[str, float]:
    """Seconds of walking through the light once as a fit does, reading and encoding alone."""
    start = time.perf_counter()
    for block in examples(path, texels, held=False).indirect.blocks():
        jax.block_until_ready(block)
    return {"seconds": time.perf_counter() - start}


def child(path: Path, texels: int, what: str) -> None:
    """One measurement, compiled beforehand."""
    size = block_texels(LIGHTINGS)
    work = passes if what == "pass" else lambda *job: basis(*job, held=what == "held")
    work(path, min(texels, 2 * size + texels % size))
    forget(path)
    with peak_memory() as peak:
        found = work(path, texels)
    print(json.dumps({**found, "peak_gib": peak[0]}))


def measured(path: Path, texels: int, what: str) -> dict[str, float]:
    """The same in a process of its own."""
    arguments = [sys.executable, __file__, "--child", what, "--folder", str(path), "--texels", str(texels)]
    answer = subprocess.run(arguments, capture_output=True, text=True, check=True)
    return dict(json.loads(answer.stdout.splitlines()[-1]))


def main() -> None:
    """Prints the table, and the figures as JSON in the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="10^5 texels")
    parser.add_argument("--folder", default=None, help="where the pack goes")
    parser.add_argument("--texels", type=int, default=10**6, help=argparse.SUPPRESS)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(Path(given.folder), given.texels, given.child)
        return
    texels = 10**5 if given.quick else given.texels
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        path = Path(folder) / "indirect.f16"
        write(path, texels)
        size = path.stat().st_size / 1e6
        before = disk_rate(path)
        once, streamed, held = (measured(path, texels, what) for what in ("pass", "streamed", "held"))
        rates = before, disk_rate(path)
    disk = max(rates)
    print(
        f"{texels} texels x {LIGHTINGS} lightings x RGB, {size:.0f} MB; the disk reads {rates[0]:.0f} and {rates[1]:.0f} MB/s"
    )
    print(f"walking through once      {once['seconds']:7.2f} s  {size / once['seconds']:7.0f} MB/s")
    for name, found, walks in (("basis, streamed", streamed, 2), ("basis, in memory", held, 1)):
        rate = walks * size / found["seconds"]
        print(f"{name:<25} {found['seconds']:7.2f} s  {rate:7.0f} MB/s  {found['peak_gib']:.2f} GiB of memory")
    print(f"same vectors: {streamed['check'] == held['check']}")
    figures = {
        "disk_mb_per_s": disk,
        "walk_share_of_disk": size / once["seconds"] / disk,
        "fit_share_of_disk": 2 * size / streamed["seconds"] / disk,
        "streamed_seconds": streamed["seconds"],
        "held_seconds": held["seconds"],
        "streamed_gib": streamed["peak_gib"],
        "held_gib": held["peak_gib"],
    }
    print(json.dumps({name: float(f"{value:.4g}") for name, value in figures.items()}))


if __name__ == "__main__":
    main()
