"""A chain of predictions, each with one more cause of error removed, and the squares and products of its steps.

With fields y_0 ... y_K, y_K the truth, and steps d_i = y_i - y_(i+1), the error is e = y_0 - y_K = sum of the d_i, and
||e||² = sum of ||d_i||² + 2 sum over i < j of <d_i, d_j>, an identity in any inner product.

Fields that hold the noise of a bake come as two halves whose noise is independent. Then every product is taken between a step
of the one half and a step of the other, which the noise of neither half enters but by chance: the truth may be far noisier
than what is to be told apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ddprt.axes import Float32, Float64

Field = Float32[np.ndarray, "lightings texels 3"]


@dataclass(frozen=True, eq=False)
class Link:
    """One field of a chain.

    Attributes:
      cause: what the step from here to the next field removes; empty for the truth.
      halves: the field twice, or its two independent halves, W/m².
    """

    cause: str
    halves: tuple[Field, Field]

    @classmethod
    def sure(cls, cause: str, field: Field) -> "Link":
        """A field that no noise of held-out maps enters."""
        return cls(cause, (field, field))


@dataclass(frozen=True, eq=False)
class Parts:
    """A squared error taken apart.

    Attributes:
      causes: of the steps, from the shipped model to the truth.
      products: mean products of the steps over lightings, channels and (by area) texels, (W/m²)².
      mean: of the truth, W/m².
      shared: squares of a step that are due to another cause, (W/m²)², by (step, cause); the sum of all parts stays.
    """

    causes: tuple[str, ...]
    products: Float64[np.ndarray, "parts parts"]
    mean: float
    shared: dict[tuple[str, str], float] = field(default_factory=dict)

    @property
    def squares(self) -> Float64[np.ndarray, " parts"]:
        """Of the parts, (W/m²)²: those of the steps, but for what is due to other causes."""
        found = np.diagonal(self.products).copy()
        for (step, cause), square in self.shared.items():
            found[self.causes.index(step)] -= square
            found[self.causes.index(cause)] += square
        return found

    @property
    def squared(self) -> float:
        """The whole, relative to the squared mean of the truth: parts and cross terms."""
        return float(self.products.sum()) / self.mean**2

    @property
    def closure(self) -> float:
        """Squared parts over the squared whole: 1 where all steps are orthogonal."""
        return float(np.trace(self.products) / self.products.sum())

    def part(self, cause: str) -> float:
        """The relative square of a part; below 0 only by chance, 0 where the chain lacks it."""
        return float(self.squares[i]) / self.mean**2 if (i := self._place(cause)) is not None else 0.0

    def shrunk(self, cause: str, kept: float) -> float:
        """The relative square of the whole if a part's square shrank to a share, and its cross terms by the root of that."""
        i = self._place(cause)
        if i is None:
            return self.squared
        factors = np.ones(len(self.causes))
        factors[i] = np.sqrt(kept)
        crossed = self.products - np.diag(np.diagonal(self.products))
        return float(factors @ crossed @ factors + factors**2 @ self.squares) / self.mean**2

    def record(self) -> dict[str, Any]:
        """Total, parts, cross terms and closure as plain numbers; relative RMSEs and shares of the squared total."""
        whole, square = self.products.sum(), self.mean**2
        parts = [
            {"cause": cause, "relative_rmse": _root(float(value) / square), "share": float(value / whole)}
            for cause, value in zip(self.causes, self.squares, strict=True)
        ]
        pairs = [(i, j) for i in range(len(self.causes)) for j in range(i + 1, len(self.causes))]
        crossed = [
            {"causes": [self.causes[i], self.causes[j]], "share": float(2 * self.products[i, j] / whole)} for i, j in pairs
        ]
        total = {"relative_rmse": _root(self.squared), "relative_square": self.squared, "mean": self.mean}
        return {"total": total, "parts": parts, "cross_terms": crossed, "closure": self.closure}

    def _place(self, cause: str) -> int | None:
        return self.causes.index(cause) if cause in self.causes else None


def take_apart(chain: Sequence[Link], weight: Float64[np.ndarray, " texels"]) -> Parts:
    """Squares and products of all steps of a chain.

    Args:
      chain: from the shipped model to the truth; neighbours that are the same arrays make a part that is exactly 0.
      weight: of the texels, summing to 1.
    """
    causes, truth = tuple(link.cause for link in chain[:-1]), chain[-1].halves
    products = np.zeros((len(causes), len(causes)))
    for row in range(len(truth[0])):
        one, other = (_steps(chain, row, half) for half in range(2))
        products += np.einsum("itc,jtc,t->ij", one, other, weight, optimize=True) / 3
    mean = np.mean([np.einsum("ltc,t->", half, weight, dtype=np.float64) for half in truth]) / (3 * len(truth[0]))
    return Parts(causes, (products + products.T) / (2 * len(truth[0])), float(mean))


def squared_error(field: Field, truth: tuple[Field, Field], weight: Float64[np.ndarray, " texels"]) -> float:
    """Mean squared error against the truth, free of the noise of its halves, (W/m²)²."""
    return float(take_apart([Link.sure("error", field), Link("", truth)], weight).products.sum())


def _steps(chain: Sequence[Link], row: int, half: int) -> Float64[np.ndarray, "parts texels 3"]:
    fields = np.stack([link.halves[half][row] for link in chain]).astype(np.float64)
    return fields[:-1] - fields[1:]


def _root(square: float) -> float:
    return float(np.sqrt(max(float(square), 0.0)))
