"""The transfer of textures as they are stored: rounding is made up for by coefficients, as far as that goes.

An engine sees U~ and m~ where learning found the bases U and the mean m. For every u that the transfer gives, the nearest light
to U u + m that the stored textures can show, under the texels' areas W, is that of

    u~ = G u + g,  G = (U~' W U~)^+ U~' W U,  g = (U~' W U~)^+ U~' W (m - m~)

so that M~ = G M and an intercept of G i + g project the old answer on the stored textures. No dataset is needed, and the
distance is never larger than that of u itself. In gamma space all this holds before the power. Scale and bias of what files
hold are folded in, which leaves one more row: the weight of a texture that is 1 everywhere.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.methods.svd_ridge import LinearTransfer

_BLOCK = 1 << 16  # entries at once in float64
_RANK_CUT = 1e-13  # of the eigenvalues of U~' W U~, maps scaled to a norm of 1


@dataclass(frozen=True, eq=False)
class Stock:
    """Textures over covered texels, as learned and as stored; colours of a texel side by side for multi channel.

    Attributes:
      maps: the bases and, where there is one, the mean.
      stored: t, what files hold of them: scale * t + bias is what an engine sees.
      scale, bias: of each map.
      weights: of the entries.
    """

    maps: Float32[np.ndarray, "maps entries"]
    stored: Float32[np.ndarray, "maps entries"]
    scale: Float32[np.ndarray, " maps"]
    bias: Float32[np.ndarray, " maps"]
    weights: Float64[np.ndarray, " entries"]

    def blocks(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Maps as learned, as seen, and weights, in float64, some entries after others."""
        for at in range(0, len(self.weights), _BLOCK):
            part = slice(at, at + _BLOCK)
            seen = self.stored[:, part] * self.scale[:, None].astype(np.float64) + self.bias[:, None]
            yield self.maps[:, part].astype(np.float64), seen, self.weights[part]


@dataclass(frozen=True, eq=False)
class StoredTransfer:
    """u = matrix (z - offset) + intercept, y = sum over maps of u times t, plus the last u.

    Attributes:
      matrix, offset, intercept: as in `LinearTransfer`; rows are all maps, the mean among them, and the constant.
      kept: relative distance to the answer of the exact textures, over all measurements alike, with the old coefficients.
      refitted: the same with those that are written; equal to `kept` where nothing was refitted.
      rank: of the stored bases.
    """

    matrix: Float32[np.ndarray, "groups rows inputs"]
    offset: Float32[np.ndarray, "groups inputs"]
    intercept: Float32[np.ndarray, "groups rows"]
    kept: float
    refitted: float
    rank: int


def transfer_for(relighter: LinearTransfer, stock: Stock, *, refit: bool = True) -> StoredTransfer:
    """The transfer of stored textures.

    Args:
      relighter: what was learned; of its basis and mean nothing but the number is looked at.
      stock: its textures.
      refit: project the old answer; otherwise coefficients stay as they are.
    Raises:
      ValueError: a texture is not finite.
    """
    count, bases = len(stock.maps), np.asarray(relighter.basis).shape[0]
    M, i = np.asarray(relighter.matrix, np.float64), np.asarray(relighter.intercept, np.float64)
    if not (np.isfinite(stock.maps).all() and np.isfinite(stock.stored).all()):
        raise ValueError("export: got textures that are not finite")
    cross, gram = np.zeros((count, count)), np.zeros((count, count))
    for exact, seen, weights in stock.blocks():
        cross += (seen * weights) @ exact.T
        gram += (seen * weights) @ seen.T
    size = np.sqrt(np.where(np.diag(gram) > 0, np.diag(gram), 1))
    values, vectors = np.linalg.eigh((gram / np.outer(size, size))[:bases, :bases])
    used = values > _RANK_CUT * values.max(initial=0)
    inverse = (vectors[:, used] / values[used]) @ vectors[:, used].T / np.outer(size[:bases], size[:bases])
    project = np.eye(count)
    if refit:
        project[:bases, :bases] = inverse @ cross[:bases, :bases]
        project[:bases, bases:] = inverse @ (cross - gram)[:bases, bases:]
    # Columns: what each measurement adds, and what is there without any; the mean counts once in the latter.
    answers = np.zeros((len(M), count, M.shape[2] + 1))
    answers[:, :bases, :-1], answers[:, :bases, -1], answers[:, bases:, -1] = M, i, 1
    kept, refitted = (_distance(stock, answers, way) for way in (np.eye(count), project))
    told = np.einsum("kb,gbp->gkp", project, answers)
    scale, bias = stock.scale.astype(np.float64), stock.bias.astype(np.float64)
    rows = np.concatenate([told * scale[:, None], np.einsum("k,gkp->gp", bias, told)[:, None]], 1).astype(np.float32)
    offset = np.asarray(relighter.offset, np.float32)
    return StoredTransfer(rows[..., :-1], offset, rows[..., -1], kept, refitted, int(used.sum()))


def _distance(stock: Stock, answers: np.ndarray, way: np.ndarray) -> float:
    """Norm of what the stored textures answer, less what the exact ones do, over the norm of the latter; 0 where that is 0."""
    count = len(stock.maps)
    apart, whole = np.zeros((count, count)), np.zeros((count, count))
    for exact, seen, weights in stock.blocks():
        difference = way.T @ seen - exact
        apart += (difference * weights) @ difference.T
        whole += (exact * weights) @ exact.T
    above, below = (float(np.einsum("gbp,bc,gcp->", answers, square, answers)) for square in (apart, whole))
    return float(np.sqrt(max(above, 0.0) / below)) if below > 0 else 0.0
