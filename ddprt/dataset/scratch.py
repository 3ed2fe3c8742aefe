"""Maps in the making: too large for memory perhaps, and worth keeping if the bake is stopped."""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.errors import UserError
from ddprt.files import make_folder, write_text

_EVERY = 10.0  # seconds between two entries in the journal


class Scratch:
    """An array of maps on disk, and how many tiles of it are done.

    The journal is written after the tiles are, so what it counts is there even if the machine goes down.

    Args:
      path: of the array; the journal lies beside it.
      shape: (lightings, texels, 3).
      key: all that the contents depend on; what was left under another key is begun anew.
    Raises:
      UserError: the disk is full or the folder cannot be written.
    """

    def __init__(self, path: Path, shape: tuple[int, int, int], key: dict[str, Any]) -> None:
        self.path, self.journal = path, path.with_suffix(".json")
        self.key = hashlib.sha256(json.dumps([*shape, key], sort_keys=True).encode()).hexdigest()
        self.done = 0
        self._noted = time.monotonic()
        try:
            entry = json.loads(self.journal.read_text("utf-8"))
            if entry["key"] == self.key and path.stat().st_size == 4 * int(np.prod(shape)):
                self.done = int(entry["tiles"])
        except (OSError, ValueError, KeyError, TypeError, OverflowError):
            pass  # nothing to go on from
        make_folder(path.parent)
        try:
            if not self.done:
                self.journal.unlink(missing_ok=True)  # it must never speak for what comes now
                path.unlink(missing_ok=True)  # never cut: another process might still have it mapped
                with path.open("xb") as file:
                    os.posix_fallocate(file.fileno(), 0, 4 * int(np.prod(shape)))  # full: an error now, no signal later
            self.maps = np.memmap(path, np.float32, "r+", shape=shape)
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({error.strerror or error}); free some space") from None
        self._open = self.done

    def follow(self, tiles: Iterator[int], told: Callable[[int], None]) -> None:
        """Counts tiles as they are finished, and tells their texels."""
        for texels in tiles:
            self.advance()
            told(texels)
        self.note()

    def advance(self) -> None:
        """Counts one more tile; now and then makes sure that it is on disk."""
        self._open += 1
        if time.monotonic() - self._noted > _EVERY:
            self.note()

    def note(self) -> None:
        """Writes all that is done to disk and into the journal."""
        try:
            self.maps.flush()
        except OSError as error:
            raise UserError(f"{self.path}: cannot be written ({error.strerror or error}); free some space") from None
        self.done, self._noted = self._open, time.monotonic()
        write_text(self.journal, json.dumps({"key": self.key, "tiles": self.done}))

    def remove(self) -> None:
        """The maps are in their own files now."""
        del self.maps
        remove_left(self.path)


def remove_left(path: Path) -> None:
    """Removes maps in the making and their journal."""
    for left in (path.with_suffix(".json"), path):
        left.unlink(missing_ok=True)
