"""Errors of relit lightmaps on held-out lightings, in linear light.

`relative_rmse` = sqrt(area-weighted mean over texels, channels and lightings of (y - ref)²) / area-weighted mean of ref.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from ddprt.axes import Float32, Float64

Maps = Float32[np.ndarray, "lightings texels 3"]


@dataclass(frozen=True, eq=False)
class Tally:
    """What pooled scores are made of, lighting by lighting, so that maps may come one after another.

    Attributes:
      error, squares: area-weighted mean square over texels and channels, of the difference and of the reference, (W/m²)².
      bias, mean: area-weighted mean over texels of the same, W/m².
      peak: largest value of the reference, W/m².
    """

    error: Float64[np.ndarray, " lightings"]
    squares: Float64[np.ndarray, " lightings"]
    bias: Float64[np.ndarray, "lightings 3"]
    mean: Float64[np.ndarray, "lightings 3"]
    peak: Float32[np.ndarray, " lightings"]

    @classmethod
    def joined(cls, parts: Sequence["Tally"]) -> "Tally":
        """The tally of all lightings of some others."""
        return cls(*(np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(cls)))

    def per_lighting(self) -> Float64[np.ndarray, " lightings"]:
        """Norm of the difference over norm of the reference; NaN where the reference is dark."""
        lit = self.squares > 0
        return np.sqrt(np.divide(self.error, self.squares, out=np.full_like(self.error, np.nan), where=lit))

    def scores(self) -> dict[str, float | None]:
        """All numbers of the method table."""
        mean, peak, square = float(np.mean(self.mean)), float(self.peak.max(initial=0)), self.error.mean()
        lit = self.per_lighting()
        lit = lit[np.isfinite(lit)]
        return {
            "relative_rmse": float(np.sqrt(square) / mean) if mean > 0 else None,
            "relative_mse": float(square / mean**2) if mean > 0 else None,
            "psnr_db": float(10 * np.log10(peak**2 / square)) if square > 0 and peak > 0 else None,
            "psnr_peak": peak,
            "energy_bias": float(np.mean(self.bias) / mean) if mean > 0 else None,
            "median_lighting_relative_rmse": float(np.median(lit)) if len(lit) else None,
            "p90_lighting_relative_rmse": float(np.quantile(lit, 0.9)) if len(lit) else None,
            "worst_lighting_relative_rmse": float(lit.max()) if len(lit) else None,
        }


class Truth:
    """Held-out reference maps and what is needed to compare with them.

    Args:
      reference: indirect irradiance, W/m².
      area: of the texels, m².
    """

    def __init__(self, reference: Maps, area: Float64[np.ndarray, " texels"]) -> None:
        self.reference = reference
        self.weight = area / area.sum()
        self.squares = self.per_lighting(reference)
        self.means = self.channel_means(reference)
        self.mean = float(np.mean(self.means))
        self.peak = float(reference.max(initial=0))

    def per_lighting(self, difference: Maps) -> Float64[np.ndarray, " lightings"]:
        """Area-weighted mean square over texels and channels of each lighting."""
        rows = [np.einsum("tc,tc,t->", row, row, self.weight, dtype=np.float64) / 3 for row in difference]
        return np.array(rows)

    def channel_means(self, maps: Maps) -> Float64[np.ndarray, "lightings 3"]:
        """Area-weighted mean over texels of each lighting and channel."""
        rows = [np.einsum("tc,t->c", row, self.weight, dtype=np.float64) for row in maps]
        return np.array(rows).reshape(-1, 3)

    def relative_rmse(self, difference: Maps) -> float | None:
        """Pooled error over the mean of the reference; None where the reference is black."""
        if self.mean <= 0:
            return None
        return float(np.sqrt(self.per_lighting(difference).mean()) / self.mean)

    def errors_per_lighting(self, predicted: Maps) -> Float64[np.ndarray, " lightings"]:
        """Norm of the difference over norm of the reference; NaN where the reference is dark."""
        return self.tally(predicted).per_lighting()

    def tally(self, predicted: Maps) -> Tally:
        """What its scores are made of."""
        difference = predicted - self.reference
        error, bias = self.per_lighting(difference), self.channel_means(difference)
        return Tally(error, self.squares, bias, self.means, self.reference.max((1, 2), initial=0))

    def flicker(self, predicted: Maps) -> float | None:
        """Jitter that the prediction adds to that of the reference, over the mean of the reference; lightings are frames.

        Jitter is taken of the difference, so that what moves in the reference itself does not count, and jumps of the two
        cannot make up for each other. None where the reference is black.
        """
        return jitter(predicted - self.reference, self.weight) / self.mean if self.mean > 0 else None

    def scores(self, predicted: Maps) -> dict[str, float | None]:
        """All numbers of the method table."""
        return self.tally(predicted).scores()


def negative_shares(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> Float64[np.ndarray, " lightings"]:
    """Energy of negative light before the clamp as a share of the positive, of each lighting.

    Returns:
      0 for a dark map; infinity where there is nothing but negative light.
    """
    negative, positive = below_and_above(unclamped, weight)
    nothing = np.where(negative > 0, np.inf, 0.0)
    return np.divide(negative, positive, out=nothing, where=positive > 0)


def negative_share(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> float:
    """The same of all lightings together: the mean of theirs, each weighted by its positive energy."""
    return share_below(below_and_above(unclamped, weight))


def share_below(energies: Float64[np.ndarray, "2 lightings"]) -> float:
    """`negative_share` of the energies that `below_and_above` tells."""
    negative, positive = energies.sum(1)
    return float(negative / positive) if positive > 0 else float(np.inf if negative > 0 else 0)


def below_and_above(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> Float64[np.ndarray, "2 lightings"]:
    """Area-weighted energy below and above zero of each lighting, summed over channels."""
    signs = (-1, 1)
    return np.array([[np.einsum("tc,t->", np.maximum(sign * row, 0), weight) for row in unclamped] for sign in signs])


def jitter(frames: Iterable[Float32[np.ndarray, "texels 3"]], weight: Float64[np.ndarray, " texels"]) -> float:
    """How unsteady maps are along a path of small steps: RMS of their second difference in time over sqrt(6), W/m².

    Light that stays or changes evenly has none, a smooth change has little (it falls with the square of the step), and a jump
    counts in full. The factor makes noise that is independent from frame to frame read as its standard deviation.

    Args:
      frames: evenly spaced in time; three are held at once.
      weight: of the texels, summing to 1.
    Raises:
      ValueError: fewer than three frames.
    """
    last, count, squares = deque[np.ndarray](maxlen=3), 0, []
    for count, frame in enumerate(frames, 1):
        last.append(frame)
        if count >= 3:
            bend = np.diff(np.stack(last).astype(np.float64), 2, axis=0)[0]
            squares.append(np.einsum("tc,t->", bend**2, weight) / 3)
    if count < 3:
        raise ValueError(f"frames: got {count}, expected at least 3")
    return float(np.sqrt(np.mean(squares) / 6))


def z_scores(
    value: Float64[np.ndarray, "*n"], truth: Float64[np.ndarray, "*n"], variance: Float64[np.ndarray, "*n"]
) -> Mapping[str, float | int | None]:
    """Mean and standard deviation of (value - truth) / sqrt(variance) where the variance is positive.

    None where there is nothing to tell them from: all three without a z-score, the bias without light.
    """
    known = variance > 0
    z = (value[known] - truth[known]) / np.sqrt(variance[known])
    if len(z) == 0:
        return {"count": 0, "mean": None, "std": None, "relative_bias": None}
    total = float(truth.sum())
    bias = float((value - truth).sum() / total) if total > 0 else None
    return {"count": len(z), "mean": float(z.mean()), "std": float(z.std()), "relative_bias": bias}
