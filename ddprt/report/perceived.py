"""Errors as they are seen: PSNR of perceptually uniform values of a lightmap, and HDR-FLIP of pictures.

Light is scaled before it is looked at, each lighting for itself, as an eye or a camera adapts: so neither number depends on
the lamps' strength, and both are told from the reference alone how bright to show things, whatever is compared with it.
"""

from collections.abc import Callable, Sequence
from types import ModuleType

import numpy as np

from ddprt.axes import Float, Float32, Float64
from ddprt.report.view import LUMINANCE

PEAK = 256.0
"""Peak of PU21-PSNR. The encoding is scaled to take 100 cd/m² there, as the white of an ordinary display is 255 in sRGB."""
DARKEST, BRIGHTEST = 0.005, 10000.0  # cd/m², the range that PU21 was fitted to
WHITE = 100.0  # cd/m² of a white diffuse surface under the light that counts as bright
_BRIGHT = 0.99  # share of the surface that is darker than that light
_BANDING_GLARE = (0.353487901, 0.3734658629, 8.277049286e-5, 0.9062562627, 0.09150303166, 0.9099517204, 596.3148142)

PIXELS_PER_DEGREE = 67.0
"""HDR-FLIP: of visual angle; FLIP's own default, a screen of 3840 pixels and 0.7 m seen from 0.7 m."""
_SHOWN = 0.85  # tone mapped value that HDR-FLIP's exposures show the brightest and the median luminance at
_ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)  # (a x² + b x) / (c x² + d x + e), as in FLIP


def pu21(luminance: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Luminance in cd/m² to perceptually uniform values: 0 at 0.005 cd/m², near 256 at 100, 595 at 10000; clipped beyond.

    Reference: Mantiuk and Azimi, "PU21: A novel perceptually uniform encoding for adapting existing quality metrics for HDR",
    Picture Coding Symposium 2021; parameters of banding_glare, the recommended one, from github.com/gfxdisp/pu21.
    """
    p = _BANDING_GLARE
    power = np.clip(luminance, DARKEST, BRIGHTEST).astype(np.float64) ** p[3]
    return p[6] * (((p[0] + p[1] * power) / (1 + p[2] * power)) ** p[4] - p[5])


def pu21_squares(
    predicted: Float32[np.ndarray, "lightings texels 3"],
    reference: Float32[np.ndarray, "lightings texels 3"],
    weight: Float64[np.ndarray, " texels"],
) -> Float64[np.ndarray, " lightings"]:
    """Area-weighted mean square of the difference of perceptually uniform values, over texels and channels of each lighting.

    Lightmaps hold W/m². Light whose luminance is exceeded on 1 % of the surface only, in the reference, makes a white diffuse
    surface show 100 cd/m²; all else is in proportion. Channels are encoded one by one, as the paper does for PSNR of colours.

    Args:
      predicted, reference: irradiance, W/m².
      weight: of the texels, summing to 1.
    Returns:
      NaN for lightings that light less than 1 % of the surface: there is nothing to adapt to.
    """
    squares = np.full(len(reference), np.nan)
    for row, (light, truth) in enumerate(zip(predicted, reference, strict=True)):
        bright = _quantile(truth @ LUMINANCE, weight, _BRIGHT)
        if bright > 0:
            ours, theirs = (pu21(np.asarray(light, np.float64) * (WHITE / bright)) for light in (light, truth))
            squares[row] = np.einsum("tc,t->", (ours - theirs) ** 2, weight) / 3
    return squares


def pu21_psnr(squares: Float64[np.ndarray, " lightings"]) -> float | None:
    """Pooled PU21-PSNR in dB with a peak of 256; None where nothing is lit, or where nothing differs."""
    lit = squares[np.isfinite(squares)]
    return float(10 * np.log10(PEAK**2 / lit.mean())) if len(lit) and lit.mean() > 0 else None


def _quantile(values: Float[np.ndarray, " n"], weight: Float64[np.ndarray, " n"], share: float) -> float:
    """The least value that is not exceeded on `share` of the total weight."""
    order = np.argsort(values, kind="stable")
    upto = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(upto, share * upto[-1])]]) if len(values) else 0.0


def flip(
    pictures: Sequence[tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"]]],
    alpha: Float64[np.ndarray, "height width"],
) -> tuple[float | None, str]:
    """Mean HDR-FLIP over pictures and over the pixels that the scene fills: 0 where nothing is seen to differ, at most 1.

    Reference: Andersson et al., "Visualizing Errors in Rendered High Dynamic Range Images", Eurographics 2021, by the
    authors' own code (package flip-evaluator, extra `flip`).

    Args:
      pictures: (test, reference), linear Rec.709 in any unit.
      alpha: share of each pixel that the scene fills.
    Returns:
      The mean, and why there is none where it is None. Pictures with a black reference, which nothing can be exposed for, are
      left out.
    """
    package = find_flip()
    if isinstance(package, str):
        return None, package
    errors = []
    for test, reference in pictures:
        luminance = (reference @ LUMINANCE)[alpha > 0]
        lit = luminance[luminance > 0]
        if len(lit):
            # In units of the brightest light, so that float32 has room for all of it.
            ours, theirs = (np.ascontiguousarray(light / lit.max(), np.float32) for light in (test, reference))
            errors.append(float(np.sum(alpha * _error_map(package, ours, theirs, lit / lit.max())) / alpha.sum()))
    return (float(np.mean(errors)), "") if errors else (None, "no picture with light in it")


def find_flip() -> ModuleType | str:
    """The package, or why it cannot be had."""
    try:
        import flip_evaluator
    except ImportError as error:
        return f'got {error}, expected flip-evaluator; pip install "ddprt[flip]"'
    return flip_evaluator


def exposures(lit: Float[np.ndarray, " pixels"]) -> tuple[float, float, int]:
    """The stops (EV) between which a picture is looked at, and how many, at most one apart.

    From where FLIP's tone curve shows the brightest luminance at 0.85 to where it shows the median so. Black pixels have no
    say; in all else it is what HDR-FLIP chooses by itself.

    Args:
      lit: luminances above 0 of the reference.
    """
    a, b, c, d, e = _ACES
    a, b, e = a - _SHOWN * c, b - _SHOWN * d, -_SHOWN * e
    linear = (-b + np.sqrt(b * b - 4 * a * e)) / (2 * a)
    start, stop = (float(np.log2(linear / level)) for level in (lit.max(), np.median(lit)))
    return start, stop, max(2, int(np.ceil(stop - start)))


def _error_map(
    package: ModuleType,
    test: Float32[np.ndarray, "height width 3"],
    reference: Float32[np.ndarray, "height width 3"],
    lit: Float[np.ndarray, " pixels"],
) -> Float32[np.ndarray, "height width"]:
    """HDR-FLIP of every pixel."""
    start, stop, count = exposures(lit)
    settings = {"ppd": PIXELS_PER_DEGREE, "startExposure": start, "stopExposure": stop, "numExposures": count}
    evaluate: Callable[..., tuple[np.ndarray, float, dict[str, object]]] = package.evaluate
    found = evaluate(reference, test, "HDR", applyMagma=False, parameters={**settings, "tonemapper": "aces"})
    return np.asarray(found[0], np.float32)[..., 0]
