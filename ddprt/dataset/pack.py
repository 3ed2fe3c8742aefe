"""The pack: all maps of one kind in one file, so that a fit reads what it needs of them at the speed of the disk.

`pack/indirect.f16` holds the covered texels alone, lightings x texels x 3, little-endian, as the EXR maps store them (half
floats under a power-of-two exposure, or `.f32` where a map is no half float): what is read is bit for bit what the maps give.
`pack/indirect.json` says so and names what it was made from, by size and hash. It is a copy that may be deleted at any time:
the manifest does not name it, and once a map changes it no longer counts.
"""

import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float32
from ddprt.errors import UserError
from ddprt.files import alone_in, make_folder, sha256, write_text, written_whole
from ddprt.progress import Doubt

FOLDER = "pack"
_SCHEMA = 1
_NORMAL = 127  # from here on a power of two is no normal float32
_TYPES: dict[str, np.dtype[Any]] = {"f16": np.dtype("<f2"), "f32": np.dtype("<f4")}

Stored = tuple[Float32[np.ndarray, "height width 3"], int]
"""A map as it is stored, and its exposure: light is stored * 2**exposure."""


@dataclass(frozen=True, eq=False)
class Pack:
    """A pack that was whole and fitted its maps when it was opened.

    Attributes:
      path: of the data.
      texels: covered ones.
      dtype: of the stored values.
      exposures: of the lightings.
    """

    path: Path
    texels: int
    dtype: np.dtype[Any]
    exposures: tuple[int, ...]
    _seen: dict[str, tuple[int, int]] = field(repr=False)

    @property
    def nbytes(self) -> int:
        """Bytes of the data."""
        return len(self.exposures) * self._row

    @property
    def _row(self) -> int:
        return self.texels * 3 * self.dtype.itemsize

    def untouched(self, names: Sequence[str] | None = None) -> bool:
        """Whether files that it was made from (all, if none are named) have neither changed nor gone since it was opened."""
        root, asked = self.path.parent.parent, list(self._seen) if names is None else names
        return all(_stamp(root / name) == self._seen.get(name) for name in asked) and _stamp(self.path)[0] == self.nbytes

    def read(self, rows: Sequence[int], start: int = 0, stop: int | None = None) -> Float32[np.ndarray, "lightings texels 3"]:
        """Light of some lightings at the texels from `start` to `stop`, W/m².

        Reads rather than maps the file: pages of a mapping would count as memory of this process.

        Raises:
          UserError: the file is gone or was cut short.
        """
        stop = self.texels if stop is None else stop
        light = np.empty((len(rows), stop - start, 3), np.float32)
        stored = np.empty(light.shape[1:], self.dtype)
        for place, row in zip(light, rows, strict=True):
            self._fill(stored, row * self._row + start * 3 * self.dtype.itemsize)
            exposure = self.exposures[row]
            if abs(exposure) < _NORMAL:  # rounded as ldexp rounds, in a third of the time
                np.multiply(stored, np.float32(2.0**exposure), out=place, dtype=np.float32)
            else:
                np.ldexp(stored.astype(np.float32), exposure, out=place)
        return light

    def expect(self, rows: Sequence[int], start: int, stop: int) -> None:
        """Tells the system what will be read next; it may fetch that while others compute."""
        size = self.dtype.itemsize * 3
        if hasattr(os, "posix_fadvise"):
            for row in rows:
                os.posix_fadvise(self._file, row * self._row + start * size, (stop - start) * size, os.POSIX_FADV_WILLNEED)

    @cached_property
    def _file(self) -> int:
        return os.open(self.path, os.O_RDONLY | getattr(os, "O_BINARY", 0))

    def __del__(self) -> None:
        if "_file" in self.__dict__:
            os.close(self._file)

    def _fill(self, place: np.ndarray, offset: int) -> None:
        left = memoryview(place.reshape(-1).view(np.uint8))  # type: ignore[arg-type]
        try:
            while left and (got := os.preadv(self._file, [left], offset)):
                left, offset = left[got:], offset + got
        except OSError as error:
            raise UserError(f"{self.path}: cannot be read ({error.strerror or error}); delete it") from None
        if left:
            raise UserError(f"{self.path}: got a file cut short, expected {self.nbytes} bytes; delete it")


class Shelf:
    """Where the pack of one kind of maps of a dataset lies; what was found there is looked at again once something changed.

    Args:
      folder: of the dataset.
      kind: of the maps.
      sources: gives the manifest's entries for all that a pack of now would be made from, by name; none if some are missing.
    """

    def __init__(self, folder: Path, kind: str, sources: Callable[[], Mapping[str, Mapping[str, Any]]]) -> None:
        self.folder, self.kind, self.sources = folder, kind, sources
        self.refused = False
        self._stamps: list[tuple[int, int]] = []
        self._found: Pack | str | None = None

    def find(self, names: Sequence[str] | None = None) -> "Pack | str | None":
        """The pack, if none of the files it was made from has changed (or of `names` alone); else see `open_pack`."""
        stamps = [_stamp(self.folder / name) for name in ("manifest.jsonl", f"{FOLDER}/{self.kind}.json")]
        touched = isinstance(self._found, Pack) and not self._found.untouched(names)
        if stamps != self._stamps or touched:
            self._stamps, sources = stamps, self.sources()
            self._found = open_pack(self.folder, self.kind, sources) if sources else None
        return self._found

    def fill(
        self, names: Sequence[str], covered: Bool[np.ndarray, "height width"], read: Callable[[str], Stored]
    ) -> Pack | None:
        """The pack, made now if there is none that fits the maps; None where that cannot be, which is said once.

        Args:
          names: of the maps, by lighting.
          covered: the texels to keep.
          read: gives the map of a name.
        Raises:
          UserError: a map that cannot be read.
        """
        found = self.find()
        if isinstance(found, Pack) or self.refused or not (sources := self.sources()):
            return found if isinstance(found, Pack) else None
        if found is not None:
            warnings.warn(
                f"{self.folder}: the pack of its maps no longer counts ({found}); it is made anew", Doubt, stacklevel=3
            )
        if why := write_pack(self.folder, self.kind, sources, names, covered, read):
            self.refused = True
            warnings.warn(f"{self.folder}: no pack of its maps ({why}); every fit reads all of them", Doubt, stacklevel=3)
            return None
        found = self.find()
        return found if isinstance(found, Pack) else None


def open_pack(folder: Path, kind: str, sources: Mapping[str, Mapping[str, Any]]) -> "Pack | str | None":
    """The pack of a dataset, why it no longer counts, or None where there is none.

    A map counts as unchanged if the manifest names the contents that were packed and its size and time are as they were; where
    only the time differs, as in a copy of the dataset, the contents are hashed.

    Args:
      folder: of the dataset.
      kind: of the maps.
      sources: entries of the manifest for all that a pack of now would be made from, by name.
    """
    header = folder / FOLDER / f"{kind}.json"
    try:
        entry = json.loads(header.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError):
        return f"{header.name} cannot be read"
    try:
        dtype = _TYPES[entry["dtype"]]
        lightings, texels, _ = (int(size) for size in entry["shape"])
        exposures, of = tuple(map(int, entry["exposures"])), entry["of"]
        path = header.with_suffix(f".{entry['dtype']}")
        if entry["schema"] != _SCHEMA or len(exposures) != lightings or set(of) != set(sources):
            return "it was made from other maps"
        seen = {}
        for name, known in of.items():
            if sources[name]["sha256"] != known["sha256"]:
                return f"{name} was baked anew"
            seen[name] = _stamp(folder / name)
            if seen[name] != (known["bytes"], known["changed"]) and not (
                seen[name][0] == known["bytes"] and sha256(folder / name) == known["sha256"]
            ):
                return f"{name} has changed"
    except (KeyError, TypeError, ValueError, AttributeError):
        return f"{header.name} is damaged"
    pack = Pack(path, texels, dtype, exposures, seen)
    return pack if _stamp(path)[0] == pack.nbytes else f"{path.name} is not whole"


def write_pack(
    folder: Path,
    kind: str,
    sources: Mapping[str, Mapping[str, Any]],
    names: Sequence[str],
    covered: Bool[np.ndarray, "height width"],
    read: Callable[[str], Stored],
) -> str | None:
    """Makes the pack of maps, one at a time; returns why it could not be made, or None.

    Args:
      folder: of the dataset.
      kind: of the maps.
      sources: entries of the manifest for all that the pack depends on, by name.
      names: of the maps, by lighting.
      covered: the texels to keep.
      read: gives the map of a name.
    Raises:
      UserError: a map that cannot be read.
    """
    place = folder / FOLDER
    stamps = {name: _stamp(folder / name) for name in sources}
    for name, entry in sources.items():
        if stamps[name][0] != entry["bytes"] or sha256(folder / name) != entry["sha256"]:
            return f"{name} differs from its hash in manifest.jsonl"
    faulty: list[UserError] = []

    def row(name: str) -> tuple[np.ndarray, int]:
        try:
            image, exposure = read(name)
            return image[covered], exposure
        except UserError as error:
            faulty.append(error)
            raise

    try:
        make_folder(folder)
        with alone_in(place):
            for left in place.glob(f"{kind}.*"):  # the header first: it must never speak for what comes now
                if left.suffix == ".json":
                    left.unlink()
            for dtype in _TYPES:
                path = place / f"{kind}.{dtype}"
                exposures = _written(path, names, row, _TYPES[dtype])
                if exposures is not None:
                    break
            of = {
                name: {"bytes": entry["bytes"], "sha256": entry["sha256"], "changed": stamps[name][1]}
                for name, entry in sources.items()
            }
            shape = [len(names), int(covered.sum()), 3]
            text = json.dumps({"schema": _SCHEMA, "shape": shape, "dtype": dtype, "exposures": exposures, "of": of}, indent=1)
            write_text(place / f"{kind}.json", text + "\n")
            for other in set(_TYPES) - {dtype}:
                (place / f"{kind}.{other}").unlink(missing_ok=True)
    except UserError as error:
        if error in faulty:
            raise
        return str(error)
    except OSError as error:
        return f"{place}: {error.strerror or error}"
    return None


def remove_packs(folder: Path) -> None:
    """Removes the packs of a dataset, and their folder if nothing else is in it."""
    for path in (folder / FOLDER).glob("*"):
        if path.suffix[1:] in (*_TYPES, "json"):
            path.unlink(missing_ok=True)
    with suppress(OSError):
        (folder / FOLDER).rmdir()


def _written(
    path: Path, names: Sequence[str], row: Callable[[str], tuple[np.ndarray, int]], dtype: np.dtype[Any]
) -> list[int] | None:
    """Exposures of the maps that were written, or None if one of them does not fit in the type."""
    exposures: list[int] = []
    with written_whole(path) as temporary, temporary.open("wb") as file:
        for name in names:
            values, exposure = row(name)
            with np.errstate(over="ignore"):
                stored = values.astype(dtype)
            if dtype.itemsize == 2 and not (stored == values).all():
                break
            file.write(stored.tobytes())
            exposures.append(exposure)
    if len(exposures) == len(names):
        return exposures
    path.unlink()
    return None


def _stamp(path: Path) -> tuple[int, int]:
    """Size and time of the last change, (-1, -1) where there is no file."""
    try:
        known = path.stat()
    except OSError:
        return -1, -1
    return known.st_size, known.st_mtime_ns
