"""A bake's own code on a share of its work: what `forecast` measures, and the laws by which it grows."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32
from ddprt.config import Config
from ddprt.dataset.layers import Layer, write_light
from ddprt.dataset.manifest import Manifest, layer_name
from ddprt.dataset.scratch import Scratch, remove_left
from ddprt.dataset.store import write_map
from ddprt.files import sha256, write_text
from ddprt.lights import Lighting
from ddprt.machine import peak_memory_gib
from ddprt.progress import Progress
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

SAMPLE = "sample-0.part"  # a file that is timed and goes
PATIENCE = 0.7  # seconds after which no further sample of a kind is taken
WIDE = 512  # lightings whose columns are really made
_ROUND = 4  # calls of each thread, after one that loads and compiles

Number = float | int
Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Expected:
    """What is expected of a stage; `name` as in run.json, or "files": all that lies between stages."""

    name: str
    seconds: float
    rays: int = 0
    files: int = 0
    bytes: int = 0


@dataclass(frozen=True)
class Part:
    """A part of a bake that a setting could shorten.

    Attributes:
      what: in words: "gather rays for held-out maps".
      seconds: that it takes.
      setting: what to set instead: "transport.target_noise = 0.02".
      then: seconds that it would take so.
    """

    what: str
    seconds: float
    setting: str
    then: float


def extrapolated(spent: Sequence[tuple[Number, Number]], whole: Number) -> float:
    """Seconds of work from rounds of it: the first, which also loads and compiles, and the rate of all others.

    Args:
      spent: amount of work and seconds of each round, in order.
      whole: amount of the whole, these rounds included.
    """
    (first, cold), *others = spent
    done = sum(size for size, _ in others)
    rate = sum(seconds for _, seconds in others) / done if done else cold / first
    return float(cold + (whole - first) * rate)


def on_a_line(one: tuple[Number, Number], other: tuple[Number, Number], at: Number) -> float:
    """What a constant and something for each come to, from two measurements of (number, seconds); numbers cost, at least 0."""
    (few, low), (many, high) = one, other
    return float(high + (at - many) * max(high - low, 0.0) / (many - few) if many > few else high * at / many)


@dataclass
class Sampled:
    """One bake, of which a share is done in a folder that will go.

    Attributes:
      bounces: of the plan.
      peak: GiB at the highest so far.
    """

    scene: Scene
    config: Config
    folder: Path
    progress: Progress
    tracer: Tracer
    lightings: Sequence[Lighting]
    bounces: int
    atlas: Atlas
    manifest: Manifest
    peak: float

    def each(
        self,
        work: Callable[[Item], Result],
        items: Sequence[Item],
        whole: Number,
        size: Callable[[Item], Number] = lambda item: 1.0,
        names: Callable[[Item], Sequence[str]] = lambda item: (),
        least: int = 0,
    ) -> tuple[float, list[Result]]:
        """Works on as many items as patience allows; two rounds at least, if there are as many.

        Args:
          work: what the bake does with one.
          items: in an order of which any beginning stands for all.
          whole: work of the bake, in the unit of `size`.
          size: work of an item.
          names: files that are then named in the manifest.
          least: items that are done however long they take.
        Returns:
          Seconds of the whole, and what was done.
        """
        results: list[Result] = []
        spent: list[tuple[Number, Number]] = []
        step = self.tracer.threads
        while len(results) < len(items) and (
            len(spent) < 2 or len(results) < least or sum(seconds for _, seconds in spent) < PATIENCE
        ):
            chunk = items[len(results) : len(results) + step]
            begun = time.perf_counter()
            for item, result in zip(chunk, self.tracer.map(work, chunk), strict=True):
                for name in names(item):
                    self.manifest.add(name)
                results.append(result)
            spent.append((sum(map(size, chunk)), time.perf_counter() - begun))
            step = 4 * self.tracer.threads  # the ends of rounds, where threads wait for each other, must not count for much
        return extrapolated(spent, whole), results

    def rounds(self, work: Callable[[np.ndarray], None], items: np.ndarray, step: int = 1) -> tuple[float, float]:
        """Seconds and rays of all items, from a call of each thread and some more.

        Args:
          work: what the bake does with some.
          items: places, or tiles of them; some are drawn.
          step: items of a call.
        """
        order, spent, done = seeds.stream(0, "forecast places").permutation(len(items)), list[tuple[Number, Number]](), 0
        before = self.tracer.rays
        for calls in (1, _ROUND):
            some = order[done : done + calls * step * self.tracer.threads]
            if len(some):
                begun = time.perf_counter()
                work(items[some])
                spent.append((len(some), time.perf_counter() - begun))
                done += len(some)
        return extrapolated(spent, len(items)), (self.tracer.rays - before) * len(items) / done

    def layered(self, layer: Layer, indices: Sequence[int], halves: int) -> tuple[float, int]:
        """Seconds and bytes of a layer's files of all lightings, from some; held-out light has two files, of two halves."""
        light = np.zeros((len(layer.position), layer.coefficients, 3), np.float32)
        some, begun, kinds = indices[: 8 * self.tracer.threads], time.perf_counter(), ("light", "noise")[:halves]
        for index in some:
            for kind in kinds:
                write_light(self.folder, layer.name, index, light, self.manifest, kind)
        share, names = len(indices) / len(some), [layer_name(layer.name, index, kind) for index in some for kind in kinds]
        return share * (time.perf_counter() - begun), round(share * self.size(names))

    def size(self, names: Sequence[str]) -> int:
        """Bytes of files that the manifest names."""
        return sum(self.manifest.entries[name]["bytes"] for name in names)

    def holds(self, *sizes: Number) -> None:
        """So many bytes are needed beside what is held now."""
        self.peak = max(self.peak, resident() + sum(sizes) / 2**30)


def scratched(folder: Path, size: Number, most: Number, threads: int) -> float:
    """Seconds that the disk takes for so many bytes of maps in the making, from at most `most` of them."""
    texels = max(1, int(min(size, most)) // 12)
    noise = seeds.stream(0, "scratched").random((1, texels, 3), np.float32)
    begun = time.perf_counter()
    scratch = Scratch(folder / SAMPLE, noise.shape, {})
    reserved = time.perf_counter()
    scratch.maps[:] = noise
    filled = time.perf_counter()
    scratch.note()
    scratch.remove()
    spent = time.perf_counter() - filled + reserved - begun + (filled - reserved) / threads
    return spent * max(1.0, size / (12 * texels))


def stored(
    folder: Path, atlas: Atlas, maps: Sequence[Float32[np.ndarray, "texels 3"]], made: Callable[[Any], Any], threads: int
) -> float:
    """Seconds that the files of a lighting take, from one that is made and removed again.

    Args:
      folder: on the disk that files will be written to.
      atlas: where texels lie in a map.
      maps: what is stored, a file each.
      made: what is done to each before.
      threads: that make and compress files side by side; hashes are taken one after the other.
    """
    path, begun = folder / SAMPLE, time.perf_counter()
    hashing = 0.0
    for values in maps:
        write_map(path, atlas.image(made(values)))
        whole = time.perf_counter()
        write_text(path.with_suffix(".json"), sha256(path))
        hashing += time.perf_counter() - whole
    spent = time.perf_counter() - begun
    remove_left(path)
    return (spent - hashing) / threads + hashing


def resident() -> float:
    """GiB that this process holds in memory; at the highest where the system does not tell what it holds now."""
    with suppress(OSError):
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 2**20
    return peak_memory_gib() or 0.0
