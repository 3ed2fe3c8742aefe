"""Errors of relit lightmaps on held-out lightings, in linear light.

`relative_rmse` = sqrt(area-weighted mean over texels, channels and lightings of (y - ref)²) / area-weighted mean of ref.
"""

from collections.abc import Mapping

import numpy as np

from ddprt.axes import Float32, Float64

Maps = Float32[np.ndarray, "lightings texels 3"]


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
        self.mean = float(np.mean(np.einsum("ltc,t->lc", reference, self.weight, dtype=np.float64)))
        self.peak = float(reference.max(initial=0))

    def per_lighting(self, difference: Maps) -> Float64[np.ndarray, " lightings"]:
        """Area-weighted mean square over texels and channels of each lighting."""
        rows = [np.einsum("tc,tc,t->", row, row, self.weight, dtype=np.float64) / 3 for row in difference]
        return np.array(rows)

    def relative_rmse(self, difference: Maps) -> float | None:
        """Pooled error over the mean of the reference; None where the reference is black."""
        if self.mean <= 0:
            return None
        return float(np.sqrt(self.per_lighting(difference).mean()) / self.mean)

    def errors_per_lighting(self, predicted: Maps) -> Float64[np.ndarray, " lightings"]:
        """Norm of the difference over norm of the reference; NaN where the reference is dark."""
        squares = self.per_lighting(predicted - self.reference)
        lit = self.squares > 0
        return np.sqrt(np.divide(squares, self.squares, out=np.full_like(squares, np.nan), where=lit))

    def flicker(self, predicted: Maps) -> float | None:
        """Jitter that the prediction adds to that of the reference, over the mean of the reference; lightings are frames.

        Jitter is taken of the difference, so that what moves in the reference itself does not count, and jumps of the two
        cannot make up for each other. None where the reference is black.
        """
        return jitter(predicted - self.reference, self.weight) / self.mean if self.mean > 0 else None

    def scores(self, predicted: Maps) -> dict[str, float | None]:
        """All numbers of the method table."""
        difference = predicted - self.reference
        square = self.per_lighting(difference).mean()
        lit = self.errors_per_lighting(predicted)
        lit = lit[np.isfinite(lit)]
        bias = np.mean(np.einsum("ltc,t->lc", difference, self.weight, dtype=np.float64))
        return {
            "relative_rmse": self.relative_rmse(difference),
            "relative_mse": float(square / self.mean**2) if self.mean > 0 else None,
            "psnr_db": float(10 * np.log10(self.peak**2 / square)) if square > 0 and self.peak > 0 else None,
            "psnr_peak": self.peak,
            "energy_bias": float(bias / self.mean) if self.mean > 0 else None,
            "median_lighting_relative_rmse": float(np.median(lit)) if len(lit) else None,
            "p90_lighting_relative_rmse": float(np.quantile(lit, 0.9)) if len(lit) else None,
            "worst_lighting_relative_rmse": float(lit.max()) if len(lit) else None,
        }


def negative_shares(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> Float64[np.ndarray, " lightings"]:
    """Energy of negative light before the clamp as a share of the positive, of each lighting.

    Returns:
      0 for a dark map; infinity where there is nothing but negative light.
    """
    negative, positive = _below_and_above(unclamped, weight)
    nothing = np.where(negative > 0, np.inf, 0.0)
    return np.divide(negative, positive, out=nothing, where=positive > 0)


def negative_share(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> float:
    """The same of all lightings together: the mean of theirs, each weighted by its positive energy."""
    negative, positive = _below_and_above(unclamped, weight).sum(1)
    return float(negative / positive) if positive > 0 else float(np.inf if negative > 0 else 0)


def _below_and_above(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> Float64[np.ndarray, "2 lightings"]:
    """Area-weighted energy below and above zero, summed over channels."""
    signs = (-1, 1)
    return np.array([[np.einsum("tc,t->", np.maximum(sign * row, 0), weight) for row in unclamped] for sign in signs])


def jitter(frames: Maps, weight: Float64[np.ndarray, " texels"]) -> float:
    """How unsteady maps are along a path of small steps: RMS of their second difference in time over sqrt(6), W/m².

    Light that stays or changes evenly has none, a smooth change has little (it falls with the square of the step), and a jump
    counts in full. The factor makes noise that is independent from frame to frame read as its standard deviation.

    Args:
      frames: evenly spaced in time.
      weight: of the texels, summing to 1.
    Raises:
      ValueError: fewer than three frames.
    """
    if len(frames) < 3:
        raise ValueError(f"frames: got {len(frames)}, expected at least 3")
    bends = (np.diff(frames[first : first + 3].astype(np.float64), 2, axis=0)[0] for first in range(len(frames) - 2))
    return float(np.sqrt(np.mean([np.einsum("tc,t->", bend**2, weight) / 3 for bend in bends]) / 6))


def z_scores(
    value: Float64[np.ndarray, "*n"], truth: Float64[np.ndarray, "*n"], variance: Float64[np.ndarray, "*n"]
) -> Mapping[str, float | int]:
    """Mean and standard deviation of (value - truth) / sqrt(variance) where the variance is positive."""
    known = variance > 0
    z = (value[known] - truth[known]) / np.sqrt(variance[known])
    if len(z) == 0:
        return {"count": 0, "mean": 0.0, "std": 0.0, "relative_bias": 0.0}
    total = float(truth.sum())
    bias = float((value - truth).sum() / total) if total > 0 else 0.0
    return {"count": len(z), "mean": float(z.mean()), "std": float(z.std()), "relative_bias": bias}
