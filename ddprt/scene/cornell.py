"""The Cornell box from the published measurements, open in front, metres.

Geometry and reflectance spectra: Cornell University Program of Computer Graphics, "Cornell Box Data". One departure: the
ceiling's hole for the lamp is closed, because lights move here, and there is no lamp. The blocks have no bottoms, as
published, since they stand on the floor. The left wall is not quite flat and the floor a little narrower than the
ceiling: so was the real box.
"""

import numpy as np

from ddprt.axes import Float, Rgb
from ddprt.errors import UserError
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, rectangle

# Millimetres, counter-clockwise from the front.
_FLOOR = [[552.8, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 559.2], [549.6, 0.0, 559.2]]
_CEILING = [[556.0, 548.8, 0.0], [556.0, 548.8, 559.2], [0.0, 548.8, 559.2], [0.0, 548.8, 0.0]]
_BACK = [[549.6, 0.0, 559.2], [0.0, 0.0, 559.2], [0.0, 548.8, 559.2], [556.0, 548.8, 559.2]]
_RIGHT = [[0.0, 0.0, 559.2], [0.0, 0.0, 0.0], [0.0, 548.8, 0.0], [0.0, 548.8, 559.2]]
_LEFT = [[552.8, 0.0, 0.0], [549.6, 0.0, 559.2], [556.0, 548.8, 559.2], [556.0, 548.8, 0.0]]
_SHORT = [
    [[130.0, 165.0, 65.0], [82.0, 165.0, 225.0], [240.0, 165.0, 272.0], [290.0, 165.0, 114.0]],
    [[290.0, 0.0, 114.0], [290.0, 165.0, 114.0], [240.0, 165.0, 272.0], [240.0, 0.0, 272.0]],
    [[130.0, 0.0, 65.0], [130.0, 165.0, 65.0], [290.0, 165.0, 114.0], [290.0, 0.0, 114.0]],
    [[82.0, 0.0, 225.0], [82.0, 165.0, 225.0], [130.0, 165.0, 65.0], [130.0, 0.0, 65.0]],
    [[240.0, 0.0, 272.0], [240.0, 165.0, 272.0], [82.0, 165.0, 225.0], [82.0, 0.0, 225.0]],
]
_TALL = [
    [[423.0, 330.0, 247.0], [265.0, 330.0, 296.0], [314.0, 330.0, 456.0], [472.0, 330.0, 406.0]],
    [[423.0, 0.0, 247.0], [423.0, 330.0, 247.0], [472.0, 330.0, 406.0], [472.0, 0.0, 406.0]],
    [[472.0, 0.0, 406.0], [472.0, 330.0, 406.0], [314.0, 330.0, 456.0], [314.0, 0.0, 456.0]],
    [[314.0, 0.0, 456.0], [314.0, 330.0, 456.0], [265.0, 330.0, 296.0], [265.0, 0.0, 296.0]],
    [[265.0, 0.0, 296.0], [265.0, 330.0, 296.0], [423.0, 330.0, 247.0], [423.0, 0.0, 247.0]],
]

# Reflectance in thousandths at 400, 404, ... 700 nm.
_SPECTRA = {
    "white": """
        343 445 551 624 665 687 708 723 715 710 745 758 739 767 777 765 751 745 748 729 745 757 753 750 746 747 735 732
        739 734 725 721 733 725 732 743 744 748 728 716 733 726 713 740 754 764 752 736 734 741 740 732 745 755 751 744
        731 733 744 731 712 708 729 730 727 707 703 729 750 760 751 739 724 730 740 737""",
    "green": """
        92 96 98 97 98 95 95 97 95 94 97 98 96 101 103 104 107 109 112 115 125 140 160 187 229 285 343 390 435 464 472
        476 481 462 447 441 426 406 373 347 337 314 285 277 266 250 230 207 186 171 160 148 141 136 130 126 123 121 122
        119 114 115 117 117 118 120 122 128 132 139 144 146 150 152 157 159""",
    "red": """
        40 46 48 53 49 50 53 55 57 56 59 57 61 61 60 62 62 62 61 62 60 59 57 58 58 58 56 55 56 59 57 55 59 59 58 59 61
        61 63 63 67 68 72 80 90 99 124 154 192 255 287 349 402 443 487 513 558 584 620 606 609 651 612 610 650 638 627
        620 630 628 642 639 657 639 635 642""",
}

# CIE standard illuminant D65 at 400, 410, ... 700 nm, relative power.
_D65 = """
    82.7549 91.4860 93.4318 86.6823 104.865 117.008 117.812 114.861 115.923 108.811 109.354 107.802 104.790 107.689 104.405
    104.046 100.000 96.3342 95.7880 88.6856 90.0062 89.5991 87.6987 83.2886 83.6992 80.0268 80.2146 82.2778 78.2842 69.7213
    71.6091"""

# Rows X, Y, Z; per lobe: height, centre (nm), inverse width below and above the centre (1/nm).
_LOBES = (
    ((1.056, 599.8, 0.0264, 0.0323), (0.362, 442.0, 0.0624, 0.0374), (-0.065, 501.1, 0.0490, 0.0382)),
    ((0.821, 568.8, 0.0213, 0.0247), (0.286, 530.9, 0.0613, 0.0322)),
    ((1.217, 437.0, 0.0845, 0.0278), (0.681, 459.0, 0.0385, 0.0725)),
)

_XYZ_TO_REC709 = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def spectra() -> dict[str, Float[np.ndarray, "76"]]:
    """Published reflectance of the paints, 0 to 1, at 400, 404, ... 700 nm."""
    return {name: np.array(table.split(), dtype=np.float64) / 1000 for name, table in _SPECTRA.items()}


def colour_matching(wavelength: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3 n"]:
    """CIE 1931 colour-matching functions x, y, z at wavelengths in nm, within 0.04 of the tables.

    Reference: Wyman, Sloan, Shirley, Simple Analytic Approximations to the CIE XYZ Color Matching Functions, JCGT 2(2), 2013,
    the multi-lobe fit.
    """

    def lobe(height: float, centre: float, below: float, above: float) -> Float[np.ndarray, " n"]:
        distance = wavelength - centre
        return height * np.exp(-0.5 * (distance * np.where(distance < 0, below, above)) ** 2)

    return np.array([sum(lobe(*parameters) for parameters in lobes) for lobes in _LOBES])


def linear_rgb(reflectance: Float[np.ndarray, "n 76"]) -> Rgb:
    """Reflectance spectra as linear Rec.709 albedo.

    Under D65 a surface of reflectance r shows XYZ_i = sum over wavelengths of D65 * cmf_i * r; a matrix takes XYZ to linear
    Rec.709; each channel is divided by that of r = 1, so that a perfect white reflector is exactly (1, 1, 1) whatever the
    spectral range. The fit of the matching functions costs at most 0.004 against the CIE's tables. Rounded to 1e-6, so that
    all machines get the same scene.

    Args:
      reflectance: rows of 76 values 0 to 1 at 400, 404, ... 700 nm.
    """
    wavelength = np.linspace(400.0, 700.0, 76)
    light = np.interp(wavelength, np.linspace(400.0, 700.0, 31), np.array(_D65.split(), dtype=np.float64))
    channel = _XYZ_TO_REC709 @ (colour_matching(wavelength) * light)
    return np.round(reflectance @ channel.T / channel.sum(axis=1), 6)


def cornell() -> Scene:
    """The box with its two blocks: 15 quads, 30 triangles; x to the left as seen from the open front at z = 0."""
    return _assemble(np.array([_RIGHT]) / 1000)


def cornell_hole(*, y_low: float = 0.15, y_high: float = 0.40, z_low: float = 0.18, z_high: float = 0.38) -> Scene:
    """The box with a rectangular hole in the right (green) wall, which light from outside enters by.

    Args:
      y_low: lower rim of the hole, metres above the floor.
      y_high: upper rim, below 0.5488.
      z_low: rim nearer to the open front, metres from it.
      z_high: rim nearer to the back wall, below 0.5592.
    Raises:
      UserError: the rims are not in this order within the wall.
    """
    top, deep = 0.5488, 0.5592
    for name, low, high, end in (("y", y_low, y_high, top), ("z", z_low, z_high, deep)):
        if not 0 < low < high < end:
            raise UserError(
                f"cornell-hole: got {name}_low = {low:g}, {name}_high = {high:g}, expected 0 < low < high < {end:g} m;"
                " move the rims"
            )
    y, z = (0.0, y_low, y_high, top), (0.0, z_low, z_high, deep)
    cells = [(j, k) for j in range(3) for k in range(3) if (j, k) != (1, 1)]
    return _assemble(
        np.array([rectangle((y[j], z[k]), (y[j + 1], z[k + 1]), 0.0, 0, facing=1) for j, k in cells]), "cornell-hole"
    )


def _assemble(right: Float[np.ndarray, "quads 4 3"], name: str = "cornell") -> Scene:
    reflectance = spectra()
    albedo = linear_rgb(np.array(list(reflectance.values())))
    materials = tuple(
        Material(paint, (float(r), float(g), float(b))) for paint, (r, g, b) in zip(reflectance, albedo, strict=True)
    )
    others = np.array([_FLOOR, _CEILING, _BACK, _LEFT, *_SHORT, *_TALL]) / 1000
    paint = np.array([0, 0, 0, 2, *[0] * (len(_SHORT) + len(_TALL)), *[1] * len(right)])
    return faceted(name, np.concatenate([others, right]), materials, paint)
