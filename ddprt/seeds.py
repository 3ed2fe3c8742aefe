"""One seed, many named streams.

A random number is addressed by what it is for, never by when it is drawn: row 517 is the same whatever the number of
workers, and a resumed bake continues as if it had never stopped.
"""

import zlib

import numpy as np


def _sequence(seed: int, name: str, index: tuple[int, ...]) -> np.random.SeedSequence:
    # The count of indices is part of the address: NumPy pads with zeros, so that (0, 5) and (0, 5, 0) would be one stream.
    return np.random.SeedSequence([seed, zlib.crc32(name.encode()), len(index), *index])


def stream(seed: int, name: str, *index: int) -> np.random.Generator:
    """Independent generator for (seed, name, index...), e.g. `stream(0, "lightings", 517)`."""
    return np.random.Generator(np.random.SFC64(_sequence(seed, name, index)))


def number(seed: int, name: str, *index: int) -> int:
    """A 32-bit seed for libraries that want an integer (Sobol scrambles, JAX keys)."""
    return int(_sequence(seed, name, index).generate_state(1)[0])


def digest(values: np.ndarray) -> int:
    """A checksum of an array, for keys."""
    return zlib.crc32(np.ascontiguousarray(values).tobytes())
