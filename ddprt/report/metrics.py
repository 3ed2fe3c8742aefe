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


def negative_share(unclamped: Maps, weight: Float64[np.ndarray, " texels"]) -> float:
    """Energy of negative light before the clamp, as a share of the positive."""
    total = np.einsum("ltc,t->", np.abs(unclamped), weight, dtype=np.float64)
    negative = np.einsum("ltc,t->", np.maximum(-unclamped, 0), weight, dtype=np.float64)
    return float(negative / (total - negative)) if total > negative else 0.0


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
