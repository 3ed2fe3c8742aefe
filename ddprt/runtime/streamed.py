"""Indirect light of a split that stays in its pack while a method learns from it."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Float32

from ddprt.dataset.pack import Pack
from ddprt.fitting.encoding import Encoding
from ddprt.methods.method import block_texels


@jax.jit
def encoded(encoding: Encoding, indirect: Array, scale: Array) -> Array:
    """Light as methods learn it, from W/m²."""
    return encoding.encode(indirect, scale)


@dataclass(frozen=True, eq=False)
class StreamedMaps:
    """See `Maps`. A thread reads what comes next meanwhile.

    Attributes:
      pack: where the light lies.
      indices: of the lightings.
      encoding: what it is encoded with.
      scale: of the lightings.
    """

    pack: Pack
    indices: tuple[int, ...]
    encoding: Encoding
    scale: Float[Array, "lightings 3"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """See `Maps`."""
        return len(self.indices), self.pack.texels, 3

    def blocks(self) -> Iterator[Float[Array, "lightings block 3"]]:
        """See `Maps`."""
        for light in self._read(block_texels(len(self.indices))):
            yield self._encode(light, self.scale)

    def some(self, lightings: slice) -> Float[Array, "some texels 3"]:
        """See `Maps`."""
        return self._encode(self.pack.read(self.indices[lightings]), self.scale[lightings])

    def runs(self, starts: Sequence[int], texels: int) -> Float[Array, "lightings some 3"]:
        """See `Maps`."""
        whole = self.pack.texels
        parts = [(start, min(start + texels, whole)) for start in starts]
        parts = [part for start, stop in parts for part in ((start, stop), (0, start + texels - stop)) if part[0] < part[1]]
        return self._encode(np.concatenate([self.pack.read(self.indices, *part) for part in parts], 1), self.scale)

    def _encode(self, light: np.ndarray, scale: Array) -> Array:
        with jax.enable_x64(False):  # as in memory, whoever asks
            return encoded(self.encoding, light, scale)

    def _read(self, texels: int) -> Iterator[Float32[np.ndarray, "lightings block 3"]]:
        """Light in blocks of so many texels, one ahead of what has been asked for."""

        def read(start: int) -> np.ndarray:
            stop, after = (min(start + count * texels, self.pack.texels) for count in (1, 2))
            self.pack.expect(self.indices, stop, after)
            return self.pack.read(self.indices, start, stop)

        starts = range(0, self.pack.texels, texels)
        with ThreadPoolExecutor(1) as reader:
            coming = [reader.submit(read, starts[0])]
            for start in (*starts[1:], None):
                light = coming.pop().result()
                if start is not None:
                    coming.append(reader.submit(read, start))
                yield light
                del light
