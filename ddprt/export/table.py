"""What each format of textures weighs, and what it costs in error: `ddprt export --table`.

Two rows have no file. They are what a predecessor does to its matrices: 16-bit integers, and small entries left out, of which
the others are kept with their places.
"""

import json
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float32
from ddprt.errors import UserError
from ddprt.export.formats.format import Maps, peaks
from ddprt.export.formats.listing import FORMATS, check_formats
from ddprt.export.refit import Stock, transfer_for
from ddprt.export.stored import as_seen, over_texels, weights_of, write_format
from ddprt.export.textures import textures
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.report.metrics import Truth
from ddprt.runtime.model import Model
from ddprt.runtime.precision import composed

_SMALL = 0.02  # of a map's largest magnitude, below which the sparse row drops entries
_INDEX, _SHORT, _FLOAT = 4, 2, 4  # bytes


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Lightings that a format is judged by.

    Attributes:
      values: what is measured, W/m².
      indirect: reference maps, W/m².
    """

    values: Float32[np.ndarray, "frames points 3"]
    indirect: Float32[np.ndarray, "frames texels 3"]


@dataclass(frozen=True)
class Row:
    """One way to store textures.

    Attributes:
      name: entry of `FORMATS`, or what it is.
      bytes: of its files and transfer; of rows without a file, over covered texels.
      memory_bytes: of its textures in graphics memory.
      rounding: relative distance to the exact answer, over all measurements alike; refitted if that was asked for.
      relative_rmse: against exact textures over the held-out lightings, in units of their mean light; None without them.
      held_out_relative_rmse: against the reference, likewise.
      skipped: why there is nothing to tell, or "".
    """

    name: str
    bytes: int | None = None
    memory_bytes: int | None = None
    rounding: float | None = None
    relative_rmse: float | None = None
    held_out_relative_rmse: float | None = None
    skipped: str = ""


def format_table(
    model: Model, held_out: HeldOut | None = None, *, gutter: int = 4, stitch: bool = True, refit: bool = True
) -> list[Row]:
    """Every format beside exact textures, and what else has been tried.

    Args:
      model: of method svd-ridge.
      held_out: to measure errors in light by.
      gutter, stitch, refit: as for `export_textures`.
    Raises:
      UserError: the method has no linear export.
    """
    judge = _Judge(model, held_out, textures(model, precision="half", gutter=gutter, stitch=stitch)[0], refit)
    full = Maps(judge.maps.values, judge.maps.bases, judge.maps.known, "float")
    rows = [judge.exact(), judge.file("exr", full, "exr, float"), judge.file("exr", judge.maps, "exr, half")]
    rows += [judge.file(name, judge.maps, name) for name in FORMATS if name != "exr"]
    return [*rows, judge.whole_numbers(), judge.sparse()]


def told(rows: Iterable[Row]) -> str:
    """The table in words and columns."""
    lines = [f"{'format':<14}{'bytes':>12}{'in memory':>12}{'rounding':>12}{'against exact':>15}{'held out':>11}"]
    for row in rows:
        if row.skipped:
            lines.append(f"{row.name:<14}{row.skipped}")
            continue
        sizes = [f"{size:12,}" if size is not None else f"{'':12}" for size in (row.bytes, row.memory_bytes)]
        errors = [(row.rounding, 12), (row.relative_rmse, 15), (row.held_out_relative_rmse, 11)]
        lines.append(
            f"{row.name:<14}" + "".join(sizes) + "".join(f"{'-' if e is None else f'{e:.5f}':>{n}}" for e, n in errors)
        )
    return "\n".join(lines)


def as_json(rows: Iterable[Row]) -> str:
    """The table as a JSON document."""
    return json.dumps([asdict(row) for row in rows], indent=1, allow_nan=False) + "\n"


class _Judge:
    """What all rows are measured with."""

    def __init__(self, model: Model, held_out: HeldOut | None, maps: Maps, refit: bool) -> None:
        assert isinstance(model.relighter, LinearTransfer)
        self.model, self.held_out, self.maps, self.refit = model, held_out, maps, refit
        self.relighter = model.relighter
        self.entries = over_texels(model, maps.values)
        self.exactly = self._shown(self.entries, np.ones(len(self.entries), np.float32), refit=False)[0]
        self.expected = None if held_out is None else self.exactly.predict(held_out.values, constant=False)
        self.truth = None if held_out is None else Truth(held_out.indirect, np.asarray(model.area, np.float64))

    def exact(self) -> Row:
        return self._row("exact, float32", _FLOAT * self.entries.size + self._transfer_bytes, 0.0, self.exactly, None)

    def file(self, name: str, maps: Maps, label: str) -> Row:
        """A format's row, from files that are written and read for it."""
        try:
            check_formats([name], *maps.known.shape)
        except UserError as problem:
            return Row(label, skipped=str(problem))
        with tempfile.TemporaryDirectory() as folder:
            _, entry = write_format(self.model, maps, name, Path(folder), refit=self.refit and FORMATS[name].refit)
            seen = as_seen(self.model, maps, name, Path(folder), entry)
        return self._row(label, entry["bytes"], entry["rounding"]["refitted"], seen, entry["memory_bytes"])

    def whole_numbers(self) -> Row:
        """16-bit integers, a scale for each map."""
        stored, scale = self._short()
        seen, rounding = self._shown(stored, scale, refit=self.refit)
        return self._row("int16", _SHORT * stored.size + self._transfer_bytes, rounding, seen, None)

    def sparse(self) -> Row:
        """The same without what is small, in rows of values and places."""
        stored, scale = self._short()
        kept = np.where(np.abs(stored) >= _SMALL, stored, 0).astype(np.float32)
        seen, rounding = self._shown(kept, scale, refit=self.refit)
        size = (_SHORT + _INDEX) * int(np.count_nonzero(kept)) + _INDEX * (len(kept) + 1)
        return self._row("int16, sparse", size + self._transfer_bytes, rounding, seen, None)

    @property
    def _transfer_bytes(self) -> int:
        relighter = self.relighter
        return _FLOAT * (relighter.matrix.size + relighter.offset.size + relighter.intercept.size)

    def _short(self) -> tuple[np.ndarray, np.ndarray]:
        scale, _ = peaks(self.maps)
        return (np.rint(self.entries / scale[:, None] * 32767) / 32767).astype(np.float32), scale

    def _shown(self, stored: np.ndarray, scale: np.ndarray, *, refit: bool) -> tuple[Model, float]:
        stock = Stock(self.entries, stored, scale, np.zeros(len(scale), np.float32), weights_of(self.model))
        transfer = transfer_for(self.relighter, stock, refit=refit)
        parts = {"matrix": transfer.matrix, "offset": transfer.offset, "intercept": transfer.intercept}
        return composed(self.model, np.concatenate([stored, np.ones_like(stored[:1])]), **parts), transfer.refitted

    def _row(self, name: str, size: int, rounding: float, seen: Model, memory: int | None) -> Row:
        errors: dict[str, Any] = {}
        if self.held_out is not None and self.truth is not None:
            light = seen.predict(self.held_out.values, constant=False)
            errors["relative_rmse"] = self.truth.relative_rmse(light - self.expected)
            errors["held_out_relative_rmse"] = self.truth.relative_rmse(light - self.held_out.indirect)
        return Row(name, int(size), memory, rounding, **errors)
