"""Real spherical harmonics: functions on the sphere as a few numbers.

Orthonormal, without the Condon-Shortley phase, polar axis z: Y_00 = 0.282095, then 0.488603 (y, z, x), as Ramamoorthi and
Hanrahan list them ("An Efficient Representation for Irradiance Environment Maps", 2001). Index l² + l + m; order L has (L + 1)²
of them. World axes are taken as they are, whichever of them is up.
"""

from math import factorial

import numpy as np

from ddprt.axes import Float, Float64


def count(order: int) -> int:
    """Harmonics up to an order."""
    return (order + 1) ** 2


def harmonics(directions: Float[np.ndarray, "*n 3"], order: int) -> Float[np.ndarray, "*n harmonics"]:
    """Values of all harmonics up to an order at unit vectors, in the type of these.

    Polynomials in x, y and z by the recurrences of the associated Legendre functions, free of trigonometry and of poles.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    found = np.empty((*x.shape, count(order)))
    cosine, sine = np.ones_like(x), np.zeros_like(x)  # of m turns, times the sine of the polar angle to the m
    for m in range(order + 1):
        before, legendre = np.zeros_like(z), np.full_like(z, _double_factorial(2 * m - 1))
        for degree in range(m, order + 1):
            scale = np.sqrt((2 * degree + 1) / (4 * np.pi) * factorial(degree - m) / factorial(degree + m))
            middle = degree * degree + degree
            if m == 0:
                found[..., middle] = scale * legendre
            else:
                found[..., middle + m] = np.sqrt(2) * scale * legendre * cosine
                found[..., middle - m] = np.sqrt(2) * scale * legendre * sine
            following = ((2 * degree + 1) * z * legendre - (degree + m) * before) / (degree + 1 - m)
            before, legendre = legendre, following
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return found.astype(np.asarray(directions).dtype)


def clamped_cosine(order: int) -> Float64[np.ndarray, " harmonics"]:
    """What turns coefficients of radiance into those of irradiance: pi, 2 pi / 3, pi / 4, 0, -pi / 24, ... for each harmonic.

    Reference: Ramamoorthi and Hanrahan, "On the relationship between radiance and irradiance", JOSA A 2001, equation 24.
    """
    bands = []
    for degree in range(order + 1):
        if degree == 1:
            band = 2 * np.pi / 3
        elif degree % 2:
            band = 0.0
        else:
            half = degree // 2
            sign = -1 if half % 2 == 0 else 1
            band = 2 * np.pi * sign / ((degree + 2) * (degree - 1)) * factorial(degree) / (2**degree * factorial(half) ** 2)
        bands += [band] * (2 * degree + 1)
    return np.array(bands)


def of_panorama(radiance: Float[np.ndarray, "height width channels"], order: int) -> Float64[np.ndarray, "harmonics channels"]:
    """Integral over the sphere of a picture times each harmonic: its coefficients, sr times its unit.

    Exact for a picture that is constant within each pixel. Along a row harmonics are sums of sines and cosines of up to `order`
    turns, whose integrals over a pixel are known; down a row Gauss' rule leaves less than rounding.

    Args:
      radiance: equirectangular, as `EnvironmentLight` has it: row 0 about +Y, the middle of a row at -Z, its right half at +X.
      order: of the harmonics.
    """
    height, width = radiance.shape[:2]
    waves = np.arange(1, order + 1)
    edges = 2 * np.pi * (np.arange(width + 1) / width - 0.5)
    sines, cosines = np.diff(np.sin(np.outer(waves, edges))) / waves[:, None], np.diff(np.cos(np.outer(waves, edges)))
    pixels = np.concatenate([np.full((1, width), 2 * np.pi / width), sines, -cosines / waves[:, None]])
    along = np.tensordot(pixels, radiance.astype(np.float64), (1, 1))  # of cosines and sines, for each row

    x, weight = np.polynomial.legendre.leggauss(8 + 4 * (order + 1) // height)
    polar = np.pi * (np.arange(height)[:, None] + (x + 1) / 2) / height
    turn = np.pi * np.arange(2 * order + 2) / (order + 1)  # enough to tell sums of `order` turns
    flat = np.sin(polar)[..., None]
    towards = np.broadcast_arrays(flat * np.sin(turn), np.cos(polar)[..., None], -flat * np.cos(turn))
    angles = np.outer(waves, turn)
    told = np.concatenate([np.full((1, len(turn)), 0.5), np.cos(angles), np.sin(angles)]) / (order + 1)
    down = weight * np.sin(polar) * np.pi / 2 / height
    return np.einsum("hg,hgtk,mt,mhc->kc", down, harmonics(np.stack(towards, -1), order), told, along, optimize=True)


def turned(coefficients: Float64[np.ndarray, "harmonics channels"], angle: float) -> Float64[np.ndarray, "harmonics channels"]:
    """Those of the same function turned about +Y, right-handed, radians."""
    order = round(len(coefficients) ** 0.5) - 1
    height, weight = np.polynomial.legendre.leggauss(order + 1)  # this rule integrates products of two harmonics exactly
    turn = 2 * np.pi * np.arange(2 * order + 1) / (2 * order + 1)
    flat = np.sqrt(1 - height**2)[:, None]
    directions = np.stack(np.broadcast_arrays(flat * np.cos(turn), height[:, None], flat * np.sin(turn)), -1)
    cosine, sine = np.cos(angle), np.sin(angle)
    about_y = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    share = (weight * 2 * np.pi / len(turn))[:, None, None]
    values = harmonics(directions, order) @ coefficients * share
    return np.einsum("gtk,gtc->kc", harmonics(directions @ about_y.T, order), values, optimize=True)


def _double_factorial(number: int) -> float:
    return float(np.prod(np.arange(number, 0, -2, dtype=np.float64)))
