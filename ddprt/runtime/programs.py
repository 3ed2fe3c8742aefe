"""Compiled programs, of which a process can hold only so many."""

import time
from pathlib import Path

import jax

_MAPS, _LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_SHARE = 0.5  # of the memory maps that a process may have: what is compiled before the next look has to fit into the rest
_SECONDS = 10.0  # between looks, since one takes up to 0.04 s
_looked = [-_SECONDS]


def make_room() -> None:
    """Lets go of everything that JAX compiled once this process has half of the memory maps that Linux grants it.

    JAX keeps each program as long as the process lives, in a few maps each, 65 530 of which are granted by default. Whoever
    fits many methods in many shapes comes to that within an hour, and the compiler then takes the process down. What is asked
    for again is compiled again. Elsewhere than on Linux nothing is done.
    """
    if time.monotonic() - _looked[0] < _SECONDS:
        return
    _looked[0] = time.monotonic()
    try:
        maps, limit = _MAPS.read_bytes().count(b"\n"), int(_LIMIT.read_text("ascii"))
    except (OSError, ValueError):
        return
    if maps > _SHARE * limit:
        jax.clear_caches()
