"""Names of a dataset's files, and the list of those that are whole."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ddprt.errors import UserError
from ddprt.files import sha256


def map_name(kind: str, index: int) -> str:
    """Relative path of a lighting's map; kind is "direct", "indirect", "noise" or "measured"."""
    return f"{kind}/{index:06d}.{'safetensors' if kind == 'measured' else 'exr'}"


def layer_name(layer: str, index: int | str, kind: str = "light") -> str:
    """Relative path of a lighting's coefficients in a layer, or of its "places"; kind is "light" or "noise"."""
    stem = index if isinstance(index, str) else f"{index:06d}{'' if kind == 'light' else f'.{kind}'}"
    return f"{layer}/{stem}.safetensors"


def layer_lacks(manifest: "Manifest", layer: str, kinds: Sequence[str], indices: Iterable[int]) -> list[int]:
    """The lightings that some kind of a layer's light is still missing of."""
    return [index for index in indices if not all(manifest.holds(layer_name(layer, index, kind)) for kind in kinds)]


class Manifest:
    """The list of whole files of a folder; appending is safe against being killed at any moment."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / "manifest.jsonl"
        self.entries: dict[str, dict[str, Any]] = {}
        self._whole = 0
        try:
            raw = self.path.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            raise UserError(f"{self.path}: cannot be read ({error.strerror or error}); mend the folder's permissions") from None
        for line in raw.splitlines(keepends=True):
            try:
                entry = json.loads(line)
                name = entry["file"]
            except (ValueError, KeyError, TypeError):
                break  # a line cut short by a kill: it and all after it do not count
            if not line.endswith(b"\n"):
                break
            self.entries[name] = entry
            self._whole += len(line)

    def add(self, name: str) -> None:
        """Names a file that has just been moved into place; naming the same contents again adds nothing."""
        path = self.folder / name
        entry = {"file": name, "bytes": path.stat().st_size, "sha256": sha256(path)}
        if self.entries.get(name) == entry:
            return
        line = (json.dumps(entry) + "\n").encode()
        try:
            with self.path.open("r+b" if self.path.exists() else "wb") as file:
                file.truncate(self._whole)
                file.seek(self._whole)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UserError(f"{self.path}: cannot be written ({error.strerror or error}); free some space") from None
        self._whole += len(line)
        self.entries[name] = entry

    def holds(self, name: str) -> bool:
        """Whether a file is named and still there in its full length."""
        entry = self.entries.get(name)
        path = self.folder / name
        return entry is not None and path.is_file() and path.stat().st_size == entry["bytes"]

    def fits(self, name: str) -> bool:
        """Whether the contents of a named file are those of its hash."""
        return bool(sha256(self.folder / name) == self.entries[name]["sha256"])

    def lacks(self, kinds: Sequence[str], indices: Iterable[int]) -> list[int]:
        """The lightings that some kind of map is still missing of."""
        return [index for index in indices if not all(self.holds(map_name(kind, index)) for kind in kinds)]

    def damaged(self) -> list[str]:
        """One line for each named file that is missing or differs from its hash."""
        faults = []
        for name, entry in self.entries.items():
            path = self.folder / name
            if not path.is_file():
                faults.append(f"{name}: missing")
            elif path.stat().st_size != entry["bytes"]:
                faults.append(f"{name}: got {path.stat().st_size} bytes, expected {entry['bytes']}")
            elif not self.fits(name):
                faults.append(f"{name}: contents differ from their hash")
        return faults
