"""Directions towards the bright parts of a sky; imported when a lighting really has one.

Radiance is constant within a pixel (looked up without interpolation), and is the sum of two parts, each drawn by the technique
that fits it:

- the *bright part*, what exceeds the sky's mean: pixels by luminance above the mean times solid angle, so that every sample
  brings the same light but for the cosine;
- the rest, at most the mean: cosine-weighted directions about the normal, or uniform ones where no normal is known.

Neither looks at the other's part, so no direction found by chance outweighs the others, as one of the cosine that hits the sun
would under the balance heuristic (Veach 1997, 9.2.4). Half of the samples are drawn for each: groups of any even number then
divide evenly, and on that noise hangs where all samples are spread evenly. A sky that is nowhere four times as bright as its
mean is left to the cosine whole. That the mean is taken off is MIS compensation (Karlik, Sik, Vevoda, Skrivan and Krivanek,
"MIS Compensation", SIGGRAPH Asia 2019), carried to its end. docs/effects.md says what each of these gains.
"""

from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int32
from ddprt.compiled import compiled
from ddprt.lights.light import Illumination, columns
from ddprt.lights.panorama import read_panorama, stamp

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear Rec.709."""

_KEPT = 8  # skies held in memory: 24 bytes per pixel
_ONE_AT_A_TIME = Lock()
_BELOW_ONE = 1 - 2**-53
_PEAKED = 4.0  # times the mean: below that, the cosine alone is never far off
_STRIP = 256  # directions that are worked on together: their numbers stay in the first cache


@dataclass(frozen=True, eq=False)
class Sky:
    """A picture, and tables that draw pixels of its bright part by inverting their distribution.

    Attributes:
      radiance: W/(m² sr), row 0 at the top.
      heights: cosines of the polar angle at the edges of rows, 1 to -1.
      rows: cumulative chances of the rows, 0 to 1.
      along: cumulative chances of the pixels within each row, 0 to 1.
      row_guide, along_guide: the first row (pixel) that a number of a given stretch of [0, 1) can choose.
      mean: luminance that is taken off; the bright part is what exceeds it.
      bright: integral of the bright part over all directions, W/m².
      share: of samples that are drawn from the bright part.
    """

    radiance: Float32[np.ndarray, "height width 3"]
    heights: Float64[np.ndarray, " edges"]
    rows: Float64[np.ndarray, " edges"]
    along: Float64[np.ndarray, "height pixel_edges"]
    row_guide: Int32[np.ndarray, " height"]
    along_guide: Int32[np.ndarray, "height width"]
    mean: float
    bright: float
    share: float

    @classmethod
    def of(cls, radiance: Float32[np.ndarray, "height width 3"]) -> "Sky":
        """Tables for a picture that is finite, nowhere negative and somewhere lit."""
        height, width = radiance.shape[:2]
        heights = np.cos(np.pi * np.arange(height + 1) / height)
        heights[[0, -1]] = 1, -1
        solid_angle = -np.diff(heights)[:, None] * 2 * np.pi / width
        luminance = radiance @ LUMINANCE
        total = float((luminance * solid_angle).sum())
        mean = total / (4 * np.pi)
        above = np.maximum(luminance - mean, 0)
        above[above < 1e-9 * mean] = 0  # rounding: a sky of one brightness has no bright part
        flux = above * solid_angle
        bright = float(flux.sum())
        along = _cumulative(flux)
        rows = _cumulative(flux.sum(1)[None])
        guides = _guide(rows)[0], _guide(along)
        peaked = bool(luminance.max() > _PEAKED * mean)
        return cls(radiance, heights, rows[0], along, *guides, mean, bright, 0.5 if peaked else 0.0)

    @property
    def tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What drawing a pixel takes."""
        return self.heights, self.rows, self.along, self.row_guide, self.along_guide


def load_sky(image: str) -> Sky:
    """The sky of an image, read once for each state of the file.

    Raises:
      UserError: see `panorama.read_panorama`.
    """
    with _ONE_AT_A_TIME:  # or each thread of a bake would read it
        return _loaded(image, stamp(image))


@lru_cache(_KEPT)
def _loaded(image: str, stamp: tuple[int, ...]) -> Sky:
    return Sky.of(read_panorama(image))


def sample_bright(sky: Sky, u: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Unit directions with density proportional to luminance above the mean, in the image's own frame."""
    found = np.empty((3, len(u)))
    _sample(columns(u), *sky.tables, found)
    return found.T


def pdf_bright(sky: Sky, direction: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Per steradian; 0 everywhere where a sky has no bright part."""
    row, column, _, _ = _pixel(sky, direction)
    luminance = sky.radiance[row, column] @ LUMINANCE
    return np.maximum(luminance - sky.mean, 0) / sky.bright if sky.bright else np.zeros(len(direction))


def invert_bright(sky: Sky, direction: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """The uniform numbers that give these directions."""
    row, column, down, across = _pixel(sky, direction)
    low, high = sky.rows[row], sky.rows[row + 1]
    left, right = sky.along[row, column], sky.along[row, column + 1]
    return np.stack([low + (high - low) * down, left + (right - left) * across], -1)


def shine(sky: Sky, turn: float, u: np.ndarray, normals: np.ndarray | None, out: Illumination) -> None:
    """Draws a direction for each point, and fills `direction`, `strength` and `tint`.

    Args:
      sky: unturned.
      turn: about +Y, radians, right-handed.
      u: (n, 2) uniform numbers.
      normals: (n, 3), unit; None draws the part that is not bright uniformly.
      out: filled.
    """
    facing = np.empty((3, 0), u.dtype) if normals is None else columns(normals)
    assert out.tint is not None
    there = out.direction.T, out.strength, out.tint.T
    _shine(columns(u), facing, turn / (2 * np.pi), sky.share, sky.mean, sky.bright, sky.radiance, *sky.tables, *there)


def _cumulative(weights: Float64[np.ndarray, "lists n"]) -> Float64[np.ndarray, "lists edges"]:
    """Sums from the left, 0 to 1; lists without weight are never drawn from, and get equal steps."""
    weights = np.where(weights.sum(1, keepdims=True) > 0, weights, 1.0)
    sums = np.zeros((len(weights), weights.shape[1] + 1))
    np.cumsum(weights, axis=1, out=sums[:, 1:])
    sums /= sums[:, -1:]
    return sums


def _guide(sums: Float64[np.ndarray, "lists edges"]) -> Int32[np.ndarray, "lists n"]:
    """Where to begin to look: of n equal stretches of [0, 1), the last entry that begins at or before each.

    Reference: Chen and Asau, "On Generating Random Variates from an Empirical Distribution", AIIE Transactions 1974.
    """
    count = sums.shape[1] - 1
    starts = np.arange(count) / count
    return np.array([np.searchsorted(line[1:-1], starts, side="right") for line in sums], np.int32)


def _pixel(sky: Sky, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """Row, column, and where within them by solid angle, of directions in the image's own frame."""
    height, width = sky.radiance.shape[:2]
    x, y, z = np.asarray(direction, np.float64).T
    row = np.clip(np.searchsorted(-sky.heights, -y, side="right") - 1, 0, height - 1)
    u = (0.5 + np.arctan2(x, -z) / (2 * np.pi)) % 1 * width
    column = np.minimum(u.astype(int), width - 1)
    top, bottom = sky.heights[row], sky.heights[row + 1]
    return row, column, (top - y) / (top - bottom), u - column


@compiled
def _find(number: float, sums: np.ndarray, guide: np.ndarray) -> int:
    """The entry whose stretch of [0, 1) a number lies in."""
    count = len(guide)
    entry = int(guide[min(int(number * count), count - 1)])
    while entry < count - 1 and sums[entry + 1] <= number:
        entry += 1
    return entry


@compiled
def _draw(
    s: float,
    t: float,
    heights: np.ndarray,
    rows: np.ndarray,
    along: np.ndarray,
    row_guide: np.ndarray,
    along_guide: np.ndarray,
) -> tuple[int, int, float, float]:
    """A pixel of the bright part, and within it a height y and a longitude in turns, uniform by solid angle."""
    row = _find(s, rows, row_guide)
    down = min((s - rows[row]) / (rows[row + 1] - rows[row]), 1.0)
    column = _find(t, along[row], along_guide[row])
    across = min((t - along[row, column]) / (along[row, column + 1] - along[row, column]), 1.0)
    y = heights[row] + (heights[row + 1] - heights[row]) * down
    return row, column, y, (column + across) / len(along_guide[row]) - 0.5


@compiled
def _spun(turns: float) -> tuple[float, float]:
    """Cosine and sine of any number of turns, good to the last bits; the polynomials of `area`, which must stay in its file."""
    turns -= np.floor(turns)
    quarter = np.floor(4.0 * turns + 0.5)
    x = (turns - 0.25 * quarter) * 2 * np.pi
    xx = x * x
    sine = -2.50507602534068634195e-08 + xx * 1.58969099521155010221e-10
    sine = 8.33333333332248946124e-03 + xx * (-1.98412698298579493134e-04 + xx * (2.75573137070700676789e-06 + xx * sine))
    sine = x + x * xx * (-1.66666666666666324348e-01 + xx * sine)
    cosine = -2.75573143513906633035e-07 + xx * (2.08757232129817482790e-09 - xx * 1.13596475577881948265e-11)
    cosine = 4.16666666666666019037e-02 + xx * (-1.38888888888741095749e-03 + xx * (2.48015872894767294178e-05 + xx * cosine))
    cosine = 1 - 0.5 * xx + xx * xx * cosine
    odd = quarter == 1 or quarter == 3
    first, second = (-sine, cosine) if odd else (cosine, sine)
    flip = -1.0 if quarter == 2 or quarter == 3 else 1.0
    return first * flip, second * flip


@compiled
def _turns_of(x: float, z: float) -> float:
    """atan2(x, z) in turns, to 5e-10: nine terms of the series of the arctangent, at most tan(1/16 turn)^19 / 19 off."""
    across, along = abs(x), abs(z)
    low, high = min(across, along), max(across, along)
    steep = low > 0.41421356237309503 * high
    upper, lower = (low - high, low + high) if steep else (low, high)
    q = upper / max(lower, 1e-300)
    qq = q * q
    series = 1 / 9 - qq * (1 / 11 - qq * (1 / 13 - qq * (1 / 15 - qq / 17)))
    turns = q * (1 - qq * (1 / 3 - qq * (1 / 5 - qq * (1 / 7 - qq * series)))) * (0.5 / np.pi)
    turns += 0.125 if steep else 0.0
    turns = 0.25 - turns if across > along else turns
    turns = 0.5 - turns if z < 0 else turns
    return -turns if x < 0 else turns


@compiled
def _half_turns_down(y: float) -> float:
    """acos(y) / pi, to 1e-8: Abramowitz and Stegun, "Handbook of Mathematical Functions", 4.4.46."""
    a = min(abs(y), 1.0)
    series = -0.0170881256 + a * (0.0066700901 - a * 0.0012624911)
    series = 1.5707963050 + a * (-0.2145988016 + a * (0.0889789874 + a * (-0.0501743046 + a * (0.0308918810 + a * series))))
    down = np.sqrt(1 - a) * series * (1 / np.pi)
    return 1 - down if y < 0 else down


@compiled
def _sample(
    u: np.ndarray,
    heights: np.ndarray,
    rows: np.ndarray,
    along: np.ndarray,
    row_guide: np.ndarray,
    along_guide: np.ndarray,
    found: np.ndarray,
) -> None:
    for i in range(u.shape[1]):
        _, _, y, turns = _draw(np.float64(u[0, i]), np.float64(u[1, i]), heights, rows, along, row_guide, along_guide)
        flat, (cosine, sine) = np.sqrt(max(1 - y * y, 0.0)), _spun(turns)
        found[0, i], found[1, i], found[2, i] = flat * sine, y, -flat * cosine


@compiled
def _shine(
    u: np.ndarray,
    normals: np.ndarray,
    turn: float,
    share: float,
    mean: float,
    bright: float,
    radiance: np.ndarray,
    heights: np.ndarray,
    rows: np.ndarray,
    along: np.ndarray,
    row_guide: np.ndarray,
    along_guide: np.ndarray,
    direction: np.ndarray,
    strength: np.ndarray,
    tint: np.ndarray,
) -> None:
    """Each part's luminance over its density, and the colour of that luminance; in float64 whatever the arrays hold."""
    faced, most, scale = normals.shape[1] > 0, mean if share > 0 else np.inf, 1 / share if share > 0 else 0.0
    height, width = radiance.shape[0], radiance.shape[1]
    pixels, count = radiance.reshape(-1, 3), u.shape[1]
    drawn, rest = np.empty(_STRIP, np.int64), np.empty(_STRIP, np.int64)
    numbers, facing, towards, pixel = (
        np.empty((2, _STRIP)),
        np.zeros((3, _STRIP)),
        np.empty((4, _STRIP)),
        np.empty(_STRIP, np.int64),
    )
    for first in range(0, count, _STRIP):
        bright_ones = others = 0
        for i in range(first, min(first + _STRIP, count)):  # written always and kept by counting, as in `direct`
            drawn[bright_ones], rest[others] = i, i
            from_bright = u[0, i] < share
            bright_ones += from_bright
            others += not from_bright
        for k in range(bright_ones):
            s, t = min(np.float64(u[0, drawn[k]]) * scale, _BELOW_ONE), np.float64(u[1, drawn[k]])
            row, column, y, turns = _draw(s, t, heights, rows, along, row_guide, along_guide)
            pixel[k], numbers[0, k], numbers[1, k] = row * width + column, y, turns - turn
        for k in range(bright_ones):
            y, (along_z, along_x) = numbers[0, k], _spun(numbers[1, k])
            flat = np.sqrt(max(1 - y * y, 0.0))
            towards[0, k], towards[1, k], towards[2, k] = flat * along_x, y, -flat * along_z
        for k in range(bright_ones):
            i = drawn[k]
            _colour(pixels, pixel[k], i, tint)
            direction[0, i], direction[1, i], direction[2, i] = towards[0, k], towards[1, k], towards[2, k]
            strength[i] = bright * scale
        for k in range(others):
            i = rest[k]
            numbers[0, k], numbers[1, k] = u[0, i], u[1, i]
            if faced:
                facing[0, k], facing[1, k], facing[2, k] = normals[0, i], normals[1, i], normals[2, i]
        _about(numbers, facing, faced, turn, share, others, height, width, towards, pixel)
        for k in range(others):
            i = rest[k]
            luminance = _colour(pixels, pixel[k], i, tint)
            direction[0, i], direction[1, i], direction[2, i] = towards[0, k], towards[1, k], towards[2, k]
            strength[i] = min(luminance, most) * towards[3, k]


@compiled
def _about(
    numbers: np.ndarray,
    facing: np.ndarray,
    faced: bool,
    turn: float,
    share: float,
    count: int,
    height: int,
    width: int,
    towards: np.ndarray,
    pixel: np.ndarray,
) -> None:
    """Directions by the cosine (uniform if not `faced`), one over their density, and the pixels they meet: it fills vectors."""
    scale = 1 / (1 - share)
    for k in range(count):
        s, t = min(max(numbers[0, k] - share, 0.0) * scale, _BELOW_ONE), numbers[1, k]
        cosine = np.sqrt(1 - s) if faced else 1 - 2 * s
        flat, (right, up) = np.sqrt(max(1 - cosine * cosine, 0.0)), _spun(t)
        right, up = right * flat, up * flat
        nx, ny, nz = (facing[0, k], facing[1, k], facing[2, k]) if faced else (0.0, 1.0, 0.0)
        # Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
        sign = np.copysign(1.0, nz)
        a = -1 / (sign + nz)
        b = nx * ny * a
        x = right * (1 + sign * nx * nx * a) + up * b + cosine * nx
        y = right * sign * b + up * (sign + ny * ny * a) + cosine * ny
        z = -right * sign * nx - up * ny + cosine * nz
        turns = 0.5 + _turns_of(x, -z) + turn
        row = min(int(_half_turns_down(y) * height), height - 1)
        pixel[k] = row * width + min(int((turns - np.floor(turns)) * width), width - 1)
        towards[0, k], towards[1, k], towards[2, k] = x, y, z
        towards[3, k] = np.pi * scale / cosine if faced else 4 * np.pi * scale


@compiled
def _colour(pixels: np.ndarray, pixel: int, i: int, tint: np.ndarray) -> float:
    """Luminance of a pixel, and its colour by that luminance (black stays black)."""
    red, green, blue = np.float64(pixels[pixel, 0]), np.float64(pixels[pixel, 1]), np.float64(pixels[pixel, 2])
    luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    inverse = 1 / max(luminance, 1e-300)
    tint[0, i], tint[1, i], tint[2, i] = red * inverse, green * inverse, blue * inverse
    return luminance
