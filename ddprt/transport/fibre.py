"""How a fibre scatters light: the model of Chiang et al., as compiled loops.

A fibre is a dielectric cylinder with tilted scales. Light leaves it after p passes through its inside: reflected at the surface
(R), through it (TT), reflected once within (TRT), and after all longer ways together. Each lobe is a product: of a
longitudinal part, about the cone of specular reflection; of an azimuthal part, about the angle at which a ray that meets the
fibre a share h of its radius off the axis leaves it; and of what Fresnel's law and absorption leave.

Directions are given in the fibre's frame: x along it towards the tip, y across it towards the viewer's side. What is called
phase here is the radiance that leaves towards the viewer for each W/m² that arrives, on a plane that faces where it comes
from, 1/sr: over all directions of light it sums to 1 where nothing is absorbed. The model is not reciprocal: attenuation and
tilt follow from the viewer's direction alone. Everything that uses it goes from viewer to light.

Reference: Chiang, Bitterli, Tappan and Burley, "A Practical and Controllable Hair and Fur Model for Production Path Tracing",
CGF 35(2), 2016; d'Eon et al., "An Energy-Conserving Hair Reflectance Model", CGF 30(4), 2011, for the longitudinal part.
"""

import numpy as np

from ddprt.axes import Float, Float32, Float64
from ddprt.compiled import compiled
from ddprt.scene.material import Fibre

HELD = 23
"""Numbers that `prepared` keeps of a fibre seen from one direction."""

_DARKEST = 1e-4  # colours below it absorb as it does: the logarithm of nothing has no bound
_CLARITIES, _ANGLES, _SEEN, _ACROSS = 65, 257, 256, 64  # of the table of gains, and of the sums that make it
_GRAZING = 1e-4  # cosine: of a fibre seen along itself nothing is seen
SIN, COS, TURN, PASS = 0, 4, 8, 11  # rows of what is held: four tilts, three angles, three channels of four lobes

Numbers = Float[np.ndarray, "n channels"]
Shape = Float64[np.ndarray, "6"]
"""Variances of the four longitudinal parts, scale of the azimuthal ones, and what that leaves within half a turn."""


def shape_of(fibre: Fibre) -> Shape:
    """What roughness makes of lobes (Chiang et al., 4.1 and 4.2)."""
    along, around = fibre.along, fibre.around
    variance = (0.726 * along + 0.812 * along**2 + 3.7 * along**20) ** 2
    scale = np.sqrt(np.pi / 8) * (0.265 * around + 1.194 * around**2 + 5.372 * around**22)
    left = 1 / (1 + np.exp(-np.pi / scale)) - 1 / (1 + np.exp(np.pi / scale))
    return np.array([variance, variance / 4, 4 * variance, 4 * variance, scale, left])


def absorption_of(colour: Float[np.ndarray, "*n 3"], around: float) -> Float64[np.ndarray, "*n 3"]:
    """Optical depth of a radius that gives much hair a colour (Chiang et al., Eq. 9); white has none."""
    powers = np.array([5.969, -0.215, 2.532, -10.73, 5.574, 0.245]) @ around ** np.arange(6)
    return (np.log(np.clip(np.asarray(colour, np.float64), _DARKEST, 1)) / powers) ** 2


def prepared(
    outgoing: Float[np.ndarray, " n"], offset: Float[np.ndarray, " n"], absorption: Numbers, fibre: Fibre
) -> Float32[np.ndarray, "n 23"]:
    """What is the same wherever light comes from.

    Args:
      outgoing: sine of the angle between the viewer's direction and the plane across the fibre.
      offset: how far off the axis the line of sight meets it, as a share of the radius, -1 to 1.
      absorption: optical depth of a radius, per channel.
      fibre: its index of refraction and tilt.
    """
    held = np.empty((len(outgoing), HELD), np.float32)
    turns = np.deg2rad(fibre.tilt_deg) * np.array([-2.0, 1.0, 4.0, 0.0])
    _prepare(outgoing, offset, absorption, fibre.index, np.cos(turns), np.sin(turns), held)
    return held


def phase(held: Float32[np.ndarray, "n 23"], shape: Shape, incoming: Numbers) -> Float32[np.ndarray, "n 3"]:
    """Of light from unit directions in the fibre's frame, 1/sr."""
    found = np.empty((len(held), 3), np.float32)
    _phase(held, shape, incoming, found)
    return found


def pdf(held: Float32[np.ndarray, "n 23"], shape: Shape, incoming: Numbers) -> Float32[np.ndarray, " n"]:
    """Density of what `sample` gives, per steradian."""
    found = np.empty(len(held), np.float32)
    _pdf(held, shape, incoming, found)
    return found


def sample(
    held: Float32[np.ndarray, "n 23"], shape: Shape, u: Float[np.ndarray, "n 4"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Unit directions that light may come from, in the fibre's frame, and phase over density."""
    directions, weight = np.empty((2, len(held), 3), np.float32)
    _sample(held, shape, u, directions, weight)
    return directions, weight


def gains(fibre: Fibre) -> Float64[np.ndarray, "clarities angles"]:
    """What a fibre makes of light from some direction: what leaves it, to all sides and averaged about it, over what falls on.

    Falling light is weighed by the cosine with the plane across the fibre, on either side. Rows are exp(-absorption) from 0
    to 1, columns the angle of the light with that plane, from -90 to 90 degrees in equal steps. Values are times its cosine:
    at grazing angles more leaves than falls on (and less at others): the model keeps energy from the viewer's side. To 2e-4.
    """
    shape = shape_of(fibre)
    clarity, angle = np.linspace(0, 1, _CLARITIES), np.linspace(-np.pi / 2, np.pi / 2, _ANGLES)
    seen = (np.arange(_SEEN) + 0.5) / _SEEN * np.pi - np.pi / 2
    offset = np.tile((np.arange(_ACROSS) + 0.5) / _ACROSS * 2 - 1, _CLARITIES)
    depth = np.repeat(-np.log(np.maximum(clarity, 1e-12)), _ACROSS)
    absorption = np.stack([depth, depth, depth], 1)
    found = np.zeros((_CLARITIES, _ANGLES))
    for direction in seen:
        held = prepared(np.full(len(offset), np.sin(direction)), offset, absorption, fibre)
        passed = held[:, PASS::3].reshape(_CLARITIES, _ACROSS, 4).mean(1, dtype=np.float64)
        _add_gain(passed, held[0].astype(np.float64), shape, angle, np.cos(direction) ** 2 * np.pi / _SEEN, found)
    return found


def gain(table: Float64[np.ndarray, "clarities angles"], sine: Float[np.ndarray, " n"], absorption: Numbers) -> Numbers:
    """`gains` for light from directions of some sine with the plane across, per channel, without the cosine."""
    column = (np.arcsin(np.clip(sine.astype(np.float64), -1, 1)) / np.pi + 0.5) * (_ANGLES - 1)
    row = np.exp(-absorption) * (_CLARITIES - 1)
    left, low = np.minimum(column.astype(int), _ANGLES - 2), np.minimum(row.astype(int), _CLARITIES - 2)
    right, high, left = (column - left)[:, None], row - low, left[:, None]
    above = table[low, left] * (1 - right) + table[low, left + 1] * right
    below = table[low + 1, left] * (1 - right) + table[low + 1, left + 1] * right
    cosine = np.sqrt(np.maximum(1 - sine.astype(np.float64) ** 2, _GRAZING**2))
    return (above + high * (below - above)) / cosine[:, None]


@compiled
def _add_gain(
    passed: np.ndarray, held: np.ndarray, shape: np.ndarray, angles: np.ndarray, weight: float, found: np.ndarray
) -> None:
    for j in range(len(angles)):
        sine, cosine = np.sin(angles[j]), np.cos(angles[j])
        for p in range(4):
            density = weight * _longitudinal(sine, cosine, held[SIN + p], held[COS + p], shape[p])
            for i in range(len(passed)):
                found[i, j] += density * passed[i, p]


@compiled
def _fresnel(cosine: float, index: float) -> float:
    """Share that a dielectric reflects of unpolarised light that comes from outside."""
    sine = (1 - cosine * cosine) / (index * index)
    within = np.sqrt(max(0.0, 1 - sine))
    parallel = (index * cosine - within) / (index * cosine + within)
    across = (cosine - index * within) / (cosine + index * within)
    return 0.5 * (parallel * parallel + across * across)


@compiled
def _prepare(
    outgoing: np.ndarray,
    offset: np.ndarray,
    absorption: np.ndarray,
    index: float,
    cosines: np.ndarray,
    sines: np.ndarray,
    held: np.ndarray,
) -> None:
    for i in range(len(held)):
        sine = min(max(float(outgoing[i]), -1.0), 1.0)
        cosine = np.sqrt(max(1 - sine * sine, 1e-12))
        h = min(max(float(offset[i]), -1.0), 1.0)
        for p in range(4):
            held[i, SIN + p] = sine * cosines[p] + cosine * sines[p]
            held[i, COS + p] = abs(cosine * cosines[p] - sine * sines[p])
        refracted = np.sqrt(max(index * index - sine * sine, 1e-12)) / cosine  # index for what is seen across the fibre
        bent = h / refracted
        entering, inside = np.arcsin(h), np.arcsin(bent)
        for p in range(3):
            held[i, TURN + p] = 2 * p * inside - 2 * entering + p * np.pi
        chord = 2 * np.sqrt(1 - bent * bent) / np.sqrt(1 - sine * sine / (index * index))
        mirrored = _fresnel(cosine * np.sqrt(max(1 - h * h, 0.0)), index)
        for channel in range(3):
            passed = np.exp(-absorption[i, channel] * chord)
            through = (1 - mirrored) * (1 - mirrored) * passed
            back = mirrored * passed
            held[i, PASS + channel] = mirrored
            held[i, PASS + 3 + channel] = through
            held[i, PASS + 6 + channel] = through * back
            held[i, PASS + 9 + channel] = through * back * back / (1 - back) if back < 1 else 0.0


@compiled
def _longitudinal(sine: float, cosine: float, seen_sine: float, seen_cosine: float, variance: float) -> float:
    """Eq. 7 of d'Eon et al., by Bessel's I0 times exp(-x) (Abramowitz and Stegun, 9.8.1 and 9.8.2: to 2e-7)."""
    x, y = cosine * seen_cosine / variance, sine * seen_sine / variance
    if x < 3.75:
        t = (x / 3.75) * (x / 3.75)
        series = 1.2067492 + t * (0.2659732 + t * (0.0360768 + t * 0.0045813))
        scaled = np.exp(-x) * (1 + t * (3.5156229 + t * (3.0899424 + t * series)))
    else:
        t = 3.75 / x
        series = -0.02057706 + t * (0.02635537 + t * (-0.01647633 + t * 0.00392377))
        series = 0.39894228 + t * (0.01328592 + t * (0.00225319 + t * (-0.00157565 + t * (0.00916281 + t * series))))
        scaled = series / np.sqrt(x)
    return np.exp(x - y - 1 / variance) * scaled / (variance * (1 - np.exp(-2 / variance)))


@compiled
def _azimuthal(angle: float, scale: float, left: float) -> float:
    """Logistic density of an angle in radians, taken from -pi to pi, of which that much is left within."""
    away = abs(angle - 2 * np.pi * np.round(angle / (2 * np.pi)))
    decay = np.exp(-away / scale)
    return decay / (scale * (1 + decay) * (1 + decay) * left)


@compiled
def _lobe(held: np.ndarray, shape: np.ndarray, p: int, sine: float, cosine: float, angle: float) -> float:
    """Density of a direction in one lobe, per steradian."""
    flat = _longitudinal(sine, cosine, held[SIN + p], held[COS + p], shape[p])
    return flat * (_azimuthal(angle - held[TURN + p], shape[4], shape[5]) if p < 3 else 0.5 / np.pi)


@compiled
def _chance(held: np.ndarray, p: int) -> float:
    """Of a lobe: its share of what leaves, all channels together."""
    total, own = 0.0, 0.0
    for channel in range(3):
        own += held[PASS + 3 * p + channel]
        for q in range(4):
            total += held[PASS + 3 * q + channel]
    return own / total


@compiled
def _phase(held: np.ndarray, shape: np.ndarray, incoming: np.ndarray, found: np.ndarray) -> None:
    for i in range(len(held)):
        sine = min(max(float(incoming[i, 0]), -1.0), 1.0)
        cosine, angle = np.sqrt(1 - sine * sine), np.arctan2(float(incoming[i, 2]), float(incoming[i, 1]))
        red, green, blue = 0.0, 0.0, 0.0
        for p in range(4):
            density = _lobe(held[i], shape, p, sine, cosine, angle)
            red += density * held[i, PASS + 3 * p]
            green += density * held[i, PASS + 3 * p + 1]
            blue += density * held[i, PASS + 3 * p + 2]
        found[i, 0], found[i, 1], found[i, 2] = red, green, blue


@compiled
def _pdf(held: np.ndarray, shape: np.ndarray, incoming: np.ndarray, found: np.ndarray) -> None:
    for i in range(len(held)):
        sine = min(max(float(incoming[i, 0]), -1.0), 1.0)
        cosine, angle = np.sqrt(1 - sine * sine), np.arctan2(float(incoming[i, 2]), float(incoming[i, 1]))
        total = 0.0
        for p in range(4):
            total += _chance(held[i], p) * _lobe(held[i], shape, p, sine, cosine, angle)
        found[i] = total


@compiled
def _sample(held: np.ndarray, shape: np.ndarray, u: np.ndarray, directions: np.ndarray, weight: np.ndarray) -> None:
    """A lobe by its share, an angle on its cone (d'Eon et al., "A Fiber Scattering Model with Non-Separable Lobes", 2014), and
    one about the fibre by the inverse of the logistic distribution."""
    for i in range(len(held)):
        p, below = 0, _chance(held[i], 0)
        while p < 3 and u[i, 0] >= below:
            p += 1
            below += _chance(held[i], p)
        variance = shape[p]
        height = max(float(u[i, 1]), 1e-12)
        on_cone = 1 + variance * np.log(height + (1 - height) * np.exp(-2 / variance))
        off_cone = np.sqrt(max(0.0, 1 - on_cone * on_cone))
        turned = np.cos(2 * np.pi * u[i, 2])
        sine = -on_cone * held[i, SIN + p] + off_cone * turned * held[i, COS + p]
        sine = min(max(sine, -1.0), 1.0)
        cosine = np.sqrt(1 - sine * sine)
        if p < 3:
            least = 1 / (1 + np.exp(np.pi / shape[4]))
            number = min(max(least + float(u[i, 3]) * shape[5], 1e-300), 1 - 1e-16)
            angle = float(held[i, TURN + p]) - shape[4] * np.log(1 / number - 1)
        else:
            angle = 2 * np.pi * u[i, 3]
        directions[i, 0], directions[i, 1], directions[i, 2] = sine, cosine * np.cos(angle), cosine * np.sin(angle)
        total, red, green, blue = 0.0, 0.0, 0.0, 0.0
        for q in range(4):
            density = _lobe(held[i], shape, q, sine, cosine, angle)
            total += _chance(held[i], q) * density
            red += density * held[i, PASS + 3 * q]
            green += density * held[i, PASS + 3 * q + 1]
            blue += density * held[i, PASS + 3 * q + 2]
        total = max(total, 1e-30)
        weight[i, 0], weight[i, 1], weight[i, 2] = red / total, green / total, blue / total
