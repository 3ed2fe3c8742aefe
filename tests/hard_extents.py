"""Scale, place and strength: rooms and lamps of any size, light that must add up, values past what floats hold."""

from typing import Any

import numpy as np
from hard_bakes import (
    FAINTEST,
    FLOAT,
    HALF,
    LAMPS,
    alike,
    baked,
    everything,
    finite,
    fitted,
    from_lamp,
    given_points,
    moved,
    over,
    point,
    refused,
    room,
    within,
    worst,
)
from hard_cases import REFUSED, HardCase, Outcome


def of_another_size(exponent: int) -> Outcome:
    """Powers of two change no mantissa: light is 4^-exponent times as bright, bit for bit, up to the relit map."""
    here, there = moved(LAMPS), moved(LAMPS, 2.0**exponent)
    one, other = baked(room(), here), baked(room(size=2.0**exponent), there)
    pairs = list(zip(everything(one), everything(other), strict=True))
    pairs.append((fitted(one, here)[1], fitted(other, there)[1]))
    return Outcome(
        worst(*(alike(np.ldexp(a, -2 * exponent), b) for a, b in pairs)),
        finite=finite(*(array for pair in pairs for array in pair)),
    )


def of_another_strength(exponent: int) -> Outcome:
    """Equal bits again, up to the relit map; what falls below the least normal number of float32 there may be flushed."""
    here, there = moved(LAMPS), moved(LAMPS, strength=2.0**exponent)
    one, other = baked(room(), here), baked(room(), there)
    pairs = list(zip(everything(one), everything(other), strict=True))
    relit, brighter = fitted(one, here)[1], fitted(other, there)[1]
    ratios = [alike(np.ldexp(a, exponent), b) for a, b in pairs]
    ratios.append(worst(over(brighter, np.ldexp(relit.astype(np.float64), exponent), 2.0**-126)))
    return Outcome(worst(*ratios), finite=finite(brighter, *(b for _, b in pairs)))


def _far_away() -> Outcome:
    """Coordinates are dyadic, so the room and its lamps are the same about its centre: equal maps, bit for bit.

    Samples are placed in world space: they move by at most the spacing of float64 there, far below the shift of `from_lamp`.
    """
    at = 2.0**14
    one, other = baked(room(), moved(LAMPS)), baked(room(at=at), moved(LAMPS, at=at))
    (direct, _, indirect), (direct_there, measured, indirect_there) = everything(one), everything(other)
    ratios = [alike(direct, direct_there), alike(indirect, indirect_there)]
    for light, record in zip(measured, moved(LAMPS, at=at), strict=False):
        expected, bound = from_lamp(room(at=at), record, other.samples.position, other.samples.normal)
        ratios.append(worst(over(light, expected, bound)))
    return Outcome(worst(*ratios), finite=finite(direct_there, measured, indirect_there))


def _dark_lamp() -> Outcome:
    data = baked(room(), [*LAMPS, point(0.5, 0.5, 0.5, 0.0)])  # four lit, as elsewhere: nothing compiles twice
    _, relit = fitted(data, [point(0.5, 0.5, 0.5, 0.0)])
    zero = [array[4] for array in everything(data)]
    return Outcome(0.0 if not any(array.any() for array in (*zero, relit)) else np.inf, finite=finite(relit))


def added(one: dict[str, Any], other: dict[str, Any]) -> Outcome:
    """E(a + b) = E(a) + E(b): the same rays for all lightings of a bake.

    Halves round each of three maps once, and once more the direct light that they were gathered from; what is fainter than
    2^-29 of a map's peak has the spacing of its faintest halves. Sums in float32 are of at most 4096 values of one sign.
    """
    data = baked(room(), [one, other, [one, other]])
    ratios = []
    for stored, light in zip((True, False, True), everything(data), strict=True):
        light = light.astype(np.float64)
        total = light[0] + light[1]
        peaks = light[:3].max((1, 2)).sum()
        bound = (4 * HALF + 4096 * FLOAT) * total + 2 * FAINTEST * peaks if stored else 8 * FLOAT * total
        ratios.append(worst(over(light[2], total, bound)))
    return Outcome(worst(*ratios), finite=finite(light))


def _red() -> Outcome:
    red = [{**record, "intensity": [record["intensity"][0], 0.0, 0.0]} for record in LAMPS]  # type: ignore[call-overload]
    data = baked(room(), red)
    light = [*everything(data), fitted(data, red)[1], fitted(data, red, channels="multi")[1]]
    clean = all(array[..., 0].any() and not array[..., 1:].any() for array in light)
    return Outcome(0.0 if clean else np.inf, finite=finite(*light))


def _past_half() -> Outcome:
    """A lamp 1 m off three walls and as strong as a lighthouse: values past 65504 keep the eleven bits of a half."""
    strong = point(0.5, 0.5, 0.5, 2.0**24)
    data = baked(room(), [LAMPS[0], strong], transport={"direct_samples": 64})
    direct, measured, indirect = everything(data)
    # Every wall sees the lamp from 0.5 m: E lies between those of a corner and of the middle, and the texel is their mean.
    low, high = (0.5 / np.array([0.75**1.5, 0.5**3])) * 2.0**24
    inside = within(direct[1], low, high)
    return Outcome(worst(inside, 0.0 if direct[1].max() > 65504 else np.inf), finite=finite(direct, measured, indirect))


def _past_float_at_a_point() -> Outcome:
    """0.02 mm above a measurement point 1e30 W/sr give more than float32 holds, and nowhere on the texels."""
    entries = [{"position": [0.3, 0.0, 0.3], "normal": [0, 1, 0]}, {"position": [0.7, 0.0, 0.7], "normal": [0, 1, 0]}]
    return refused(lambda: given_points(room(), entries, [point(0.3, 2e-5, 0.3, 1e30)], LAMPS), "float32", "point")


def _past_float() -> Outcome:
    """In a room of a micrometre E is 1e42 and more, everywhere."""
    return refused(lambda: baked(room(size=2.0**-20), [point(*[2.0**-21] * 3, 1e30)]), "float32")


CASES: tuple[HardCase, ...] = (
    HardCase(
        "room of 0.1 mm", "absolute tolerances would show", "equal bits but for the power of two", lambda: of_another_size(-13)
    ),
    HardCase(
        "room of 100 km", "absolute tolerances would show", "equal bits but for the power of two", lambda: of_another_size(17)
    ),
    HardCase("room 16 km away", "float32 has 1 mm there", "equal maps, bit for bit", _far_away),
    HardCase(
        "intensity of 1e-30", "squares underflow", "equal bits but for the power of two", lambda: of_another_strength(-99)
    ),
    HardCase("intensity of 1e30", "squares overflow", "equal bits but for the power of two", lambda: of_another_strength(98)),
    HardCase("intensity 0", "a column of zeros", "exactly nothing, relit too", _dark_lamp),
    HardCase(
        "two lamps", "three columns of two lamps", "E(a + b) = E(a) + E(b) up to rounding", lambda: added(LAMPS[1], LAMPS[2])
    ),  # type: ignore[arg-type]
    HardCase(
        "two lamps, one 1e6 times brighter",
        "the dim one is far below the bright one's peak",
        "E(a + b) = E(a) + E(b) up to rounding",
        lambda: added(point(0.25, 0.5, 0.25, 1e6), point(0.75, 0.25, 0.5)),
    ),
    HardCase(
        "lamp 2 mm off a wall beside another",
        "one map spans a million to one",
        "E(a + b) = E(a) + E(b) up to rounding of each value",
        lambda: added(point(0.5, 0.002, 0.5), point(0.75, 0.5, 0.5)),
    ),
    HardCase("pure red lamps", "two channels of zeros", "green and blue exactly 0 through the whole chain", _red),
    HardCase("values past half floats", "halves end at 65504", "eleven bits, under an exposure", _past_half),
    HardCase("light past float32", "1e30 W/sr in a room of a micrometre", "refused", _past_float, REFUSED),
    HardCase(
        "light past float32 at a point",
        "the maps are finite, what is measured is not",
        "refused",
        _past_float_at_a_point,
        REFUSED,
    ),
)
