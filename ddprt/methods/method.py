"""The whole duty of a method, on one screen.

A method is a frozen record of its settings with `fit(train, validation, *, key) -> Relighter`. A Relighter is a frozen
dataclass of arrays, registered as a pytree, that answers `predict(frame)`. Light reaches both scaled and encoded (see
`ddprt.fitting.encoding`), so a method need not know about units, and scaling the light scales the result by construction.

Laws, tested for every entry of `METHODS` (tests/test_methods.py): batch equals loop, save equals load, no second compile
for equal shapes, no NaN for a dark lighting, twice the light is twice the result, and on its own validation set better than
the mean lightmap or `FitReport.status` says so. What statuses there are, and what each asks for: `STATUSES`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import BaseModel, ConfigDict

from ddprt.fitting.basis import Columns, block_entries
from ddprt.methods.statuses import BLIND, NOTES, STATUSES, worst_first  # noqa: F401  (STATUSES is part of the contract)


@dataclass(frozen=True)
class Frame:
    """What an engine has at hand.

    Attributes:
      values: measured light at the points, scaled and encoded.
      positions, normals: of the points, metres and unit vectors.
      lightings: the lights themselves, of training pairs.
      described: what a Relighter that `AsksForLights` made of the lights; over the scale of `values`, 0 where that is 0.
    """

    values: Float[Array, "frames points 3"]
    positions: Float[Array, "points 3"]
    normals: Float[Array, "points 3"]
    lightings: Sequence[Any] | None = None
    described: Float[Array, "frames numbers 3"] | None = None


@runtime_checkable
class Maps(Protocol):
    """Scaled and encoded indirect light that stays on disk and comes in parts, as often as it is asked for."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Lightings, texels and 3."""
        ...

    def blocks(self) -> Iterator[Float[Array, "lightings block 3"]]:
        """All texels in order, a whole number of tiles of `fit_basis` in each block but the last."""
        ...

    def some(self, lightings: slice) -> Float[Array, "some texels 3"]:
        """Whole maps of some lightings."""
        ...

    def runs(self, starts: Sequence[int], texels: int) -> Float[Array, "lightings some 3"]:
        """So many texels from each start on; after the last texel comes the first."""
        ...


@dataclass(frozen=True)
class Examples:
    """Pairs to learn from, lightings first.

    Attributes:
      frame: measurements of all lightings.
      indirect: scaled and encoded indirect light; `Maps` where it does not fit in memory and the method `streams`.
      scale: s of each lighting and channel; errors in W/m² are s times encoded ones.
      area: of the texels, m².
      weights: share of each texel in errors, summing to 1.
      channels: "mono" or "multi": whether colours are separate columns.
      unseen: share of the indirect light's squares that lies in lightings no point sees; encoding makes them black.
      signed: entries may be negative, as coefficients of harmonics are.
    """

    frame: Frame
    indirect: Float[Array, "lightings texels 3"] | Maps
    scale: Float[Array, "lightings 3"]
    area: Float[np.ndarray, " texels"]
    weights: str = "area"
    channels: str = "mono"
    unseen: float = 0.0
    signed: bool = False


@dataclass(frozen=True)
class FitReport:
    """What a fit says about itself; per-channel values have one entry per transfer matrix (3 for mono, 1 for multi).

    Attributes:
      status: the worst entry of `STATUSES` that holds, "ok" where none does or only `NOTES` do.
      remarks: all that hold, the worst first.
      bases: vectors in use, the mean counted in.
      numerical_rank: of the indirect light.
      condition, ranks: of the measurements.
      ridge, ridge_chosen_by: in use, and whether "given" or by leave-one-out ("loo").
      ridge_second: what generalised cross-validation would have chosen; empty where the ridge was given.
      leave_one_out: leave-one-out error of the coefficients at the ridge in use.
      singular_values: of the indirect light.
      ridge_path: (ridge, leave-one-out error) of each matrix.
      loss: (step, training loss, validation loss) of learned methods, where both are finite.
      trouble: how training went wrong, in words; empty where it did not.
    """

    status: str = "ok"
    bases: int = 0
    numerical_rank: int = 0
    condition: tuple[float, ...] = ()
    ridge: tuple[float, ...] = ()
    ridge_chosen_by: str = ""
    singular_values: tuple[float, ...] = ()
    ridge_path: tuple[tuple[tuple[float, float], ...], ...] = ()
    loss: tuple[tuple[int, float, float], ...] = ()
    remarks: tuple[str, ...] = ()
    ranks: tuple[int, ...] = ()
    ridge_second: tuple[float, ...] = ()
    leave_one_out: tuple[float, ...] = ()
    trouble: str = ""

    def noting(self, *names: str) -> "FitReport":
        """The same with further statuses; the worst of all leads, whatever the order they were found in."""
        remarks = worst_first({self.status, *self.remarks, *names})
        return replace(self, status=next((name for name in remarks if name not in NOTES), "ok"), remarks=remarks)


@runtime_checkable
class Relighter(Protocol):
    """What a fit leaves: everything needed to answer a frame."""

    @property
    def report(self) -> FitReport:
        """What the fit says about itself."""
        ...

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """Encoded indirect light; linear in nothing by contract, NaN for nothing."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes that ship."""
        ...

    @property
    def flops(self) -> int:
        """Floating-point operations per frame."""
        ...


@runtime_checkable
class AsksForLights(Protocol):
    """A Relighter that answers from the lights themselves; `Model.predict` then has to be given them."""

    def describe(self, lightings: Sequence[Any]) -> Float[np.ndarray, "lightings numbers 3"]:
        """Lightings as arrays of one shape, outside of compiled code: linear in the light, W/m² or the like."""
        ...


class Method(BaseModel):
    """Base of the methods' settings records; those that can learn from `Maps` say that they `streams`.

    A method with a field `space` fits in that space alone.
    `search` says what `ddprt bench --leagues` may try: settings of the method (or "fit.KEY" of [fit]) and their choices; those
    of `bases` are meant for 16 and grow with the configuration's. A method without one runs with its defaults alone.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    streams: ClassVar[bool] = False
    relighter: ClassVar[type]
    why: ClassVar[str]
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {}

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> Relighter:
        """Learns from `train`; `validation` may stop it early; `key` is its only randomness."""
        raise NotImplementedError


def as_pytree(cls: type) -> type:
    """Registers a Relighter: arrays (or tuples of them, or None) are data, the rest is static, the report is dropped."""
    data = [entry.name for entry in fields(cls) if not entry.metadata.get("static") and entry.name != "report"]
    static = [entry.name for entry in fields(cls) if entry.metadata.get("static")]
    return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=static, drop_fields=["report"])


def static(**options: Any) -> Any:
    """A field that is part of the structure rather than an array."""
    return field(metadata={"static": True}, **options)


def array_bytes(relighter: Any) -> int:
    """Bytes of all arrays."""
    return sum(leaf.nbytes for leaf in jax.tree_util.tree_leaves(relighter))


def columns(examples: Examples) -> tuple[Float[Array, "columns entries"] | Columns, Float[Array, " columns"]]:
    """Indirect light as rows of the basis' data, and the scale of each.

    Mono channel gives a row per lighting and channel (all channels share one basis), multi channel one row per lighting
    with colours interleaved. Dark rows are left out. Light that stays on disk gives rows that do.
    """
    values, mono = examples.indirect, examples.channels == "mono"
    size = examples.scale.reshape(-1) if mono else examples.scale[:, 0]
    lit = np.flatnonzero(np.asarray(size) > 0)
    if isinstance(values, Maps):
        return _Rows(values, mono, lit), size[lit]
    rows = _rows(values, mono)
    return (rows, size) if len(lit) == len(size) else (rows[lit], size[lit])


@dataclass(frozen=True, eq=False)
class _Rows:
    """See `columns`."""

    maps: Maps
    mono: bool
    lit: Int[np.ndarray, " columns"]

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.lit), self.maps.shape[1] * (1 if self.mono else 3)

    def blocks(self) -> Iterator[Array]:
        every = self.maps.shape[0] * (3 if self.mono else 1)
        for block in self.maps.blocks():
            rows = _rows(block, self.mono)
            yield rows if len(self.lit) == every else rows[self.lit]


def _rows(values: Array, mono: bool) -> Array:
    return jnp.moveaxis(values, 2, 1).reshape(-1, values.shape[1]) if mono else values.reshape(len(values), -1)


def in_memory(light: Float[Array, "lightings texels 3"] | Maps) -> Float[Array, "lightings texels 3"]:
    """All of it, for methods that do not stream."""
    return jnp.concatenate(list(light.blocks()), 1) if isinstance(light, Maps) else light


def block_texels(lightings: int) -> int:
    """Texels of so many maps that go well in one block of `fit_basis`, whatever the channels."""
    return block_entries(3 * lightings)


def grouped(values: Float[Array, "frames _ 3"], groups: int) -> Float[Array, "frames groups _inputs"]:
    """Channels apart (3 groups) or interleaved (1): what a transfer is applied to."""
    return jnp.moveaxis(values, 2, 1) if groups == 3 else values.reshape(len(values), 1, -1)


@dataclass(frozen=True)
class Measured:
    """What one transfer matrix learns from.

    Attributes:
      group: which matrix: one per channel for mono, one of interleaved colours for multi.
      rows: the lightings that its channel sees.
      values: scaled and encoded light of these at the points.
      importance: s² of each.
    """

    group: int
    rows: Int[np.ndarray, " rows"]
    values: Float[Array, "rows inputs"]
    importance: Float[np.ndarray, " rows"]


def measured(examples: Examples) -> list[Measured]:
    """One per transfer matrix that any lighting is seen by."""
    values, scale = examples.frame.values, np.asarray(examples.scale, np.float64)
    groups = jnp.moveaxis(values, 2, 0) if examples.channels == "mono" else values.reshape(1, len(values), -1)
    lit = [np.flatnonzero(scale[:, group] > 0) for group in range(len(groups))]
    return [Measured(g, rows, groups[g][rows], scale[rows, g] ** 2) for g, rows in enumerate(lit) if len(rows)]


def unseen_share(scale: Float[np.ndarray, "lightings 3"], indirect: Iterable[Float[np.ndarray, "texels 3"]]) -> float:
    """Share of the indirect light's squares that lies in lightings and channels that no point sees: encoding blackens it."""
    squares = np.array([np.einsum("tc,tc->c", light, light, dtype=np.float64) for light in indirect]).reshape(-1, 3)
    total = float(squares.sum())
    return float(squares[np.asarray(scale) == 0].sum()) / total if total > 0 else 0.0


def found_in(examples: Examples) -> set[str]:
    """Statuses that the data alone calls for, whatever is learned from it."""
    light = examples.indirect
    dark = not bool((examples.scale > 0).any())
    black = not any(bool((part != 0).any()) for part in (light.blocks() if isinstance(light, Maps) else [light]))
    return {name for name, holds in (("no_signal", dark or black), ("blind", examples.unseen > BLIND)) if holds}
