"""Fog as a ray sees it: how much of it lies ahead, what light it lets through, and where along the ray it scatters.

In a tracer's frame the box that it fills lies about the origin.
"""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from ddprt.axes import Float, Float32, Float64
from ddprt.compiled import compiled
from ddprt.lights import Light
from ddprt.lights.light import Illumination
from ddprt.scene.fog import Fog

_NARROW = 1e-6  # radians: a stretch that a lamp sees under less is as good as all at one distance from it


@dataclass(frozen=True, eq=False)
class Medium:
    """Fog in a box.

    Attributes:
      extinction: per metre and channel.
      albedo: of single scattering per channel.
      anisotropy: mean cosine of the angle of scattering.
      half: edges of the box, halved, metres.
    """

    extinction: Float64[np.ndarray, "3"]
    albedo: Float64[np.ndarray, "3"]
    anisotropy: float
    half: Float64[np.ndarray, "3"]

    @classmethod
    def of(cls, fog: Fog, half: Float64[np.ndarray, "3"]) -> "Medium":
        """Of what a scene says."""
        return cls(1 / np.array(fog.mean_free_path), np.array(fog.albedo), float(fog.anisotropy), np.asarray(half, np.float64))

    def veiled(self, light: Light) -> Light:
        """The light (centred frame) as it is seen through the fog."""
        return cast(Light, Veiled(light, self))

    def spans(
        self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"], reach: Float32[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "2 n"]:
        """From where to where rays of a length are in the fog, metres along them; equal where they are not."""
        out = np.empty((2, len(reach)))
        _spans(origins, directions, reach, self.half, out)
        return out

    def fly(
        self,
        span: Float64[np.ndarray, "2 n"],
        throughput: Float32[np.ndarray, "3 n"],
        numbers: Float32[np.ndarray, "2 n"],
    ) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "3 n"]]:
        """How far paths fly before they meet fog, and what that is worth.

        A channel is drawn in proportion to the throughput, and each weighs by its own chance over that of the draw (the balance
        heuristic), so that the sum of throughputs never grows: spectral multiple importance sampling, anew for each flight.

        Args:
          span: as `spans` gives it.
          throughput: of paths, per channel.
          numbers: uniform, for the channel and the flight.
        Returns:
          Metres along the ray, infinity for those that pass; factors of the throughput, without the fog's albedo.
        Reference: Wilkie et al., "Hero Wavelength Spectral Sampling", 2014.
        """
        where, factor = np.empty(span.shape[1]), np.empty(throughput.shape)
        _fly(span, throughput, numbers, self.extinction, where, factor)
        return where, factor

    def stops(
        self,
        place: Float32[np.ndarray, "6 n"],
        span: Float64[np.ndarray, "2 n"],
        throughput: Float32[np.ndarray, "3 n"],
        numbers: Float32[np.ndarray, "2 n"],
        lamp: Float[np.ndarray, "3"] | None,
    ) -> tuple[Float32[np.ndarray, "6 n"], Float32[np.ndarray, "3 n"]]:
        """A place on each stretch of fog to ask one lamp for its light, and the throughput there, albedo included.

        Half of them are evenly spread over the angle that the lamp sees the stretch under: its light falls off by the square of
        the distance, and places drawn by the fog alone would have no finite variance. The other half are drawn by what the fog
        lets through, with each channel as often as its share of the throughput. All weigh by the balance heuristic.

        Args:
          place: origins and directions of rays.
          span, throughput, numbers: as for `fly`.
          lamp: where it stands; None for light from afar, of which all places are drawn by the fog.
        Reference: Kulla and Fajardo, "Importance Sampling Techniques for Path Tracing in Participating Media", 2012.
        """
        there, worth = np.empty_like(place), np.empty_like(throughput)
        anchor = np.zeros(3) if lamp is None else np.asarray(lamp, np.float64)
        _stop(place, span, throughput, numbers, anchor, lamp is not None, self.extinction, self.albedo, there, worth)
        return there, worth

    def phase(self, cosine: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Per steradian, of the cosine between the ways of light before and after."""
        g = self.anisotropy
        return ((1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)).astype(cosine.dtype)

    def scattered(
        self, directions: Float32[np.ndarray, "n 3"], numbers: Float32[np.ndarray, "n 2"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Ways on, drawn by the phase function."""
        out = np.empty_like(directions)
        _scatter(directions, numbers, self.anisotropy, out)
        return out


@dataclass(frozen=True, eq=False)
class Veiled:
    """A light behind fog: all that `Light` asks for, with less of it the further away it is.

    Attributes:
      light: in the tracer's frame.
      medium: what is in between.
    """

    light: Light
    medium: Medium

    @property
    def kind(self) -> str:
        """See `Light`."""
        return self.light.kind

    @property
    def delta(self) -> bool:
        """See `Light`."""
        return self.light.delta

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`; tinted where channels have free paths of their own."""
        sample = self.light.illuminate(points, u, out, normals)
        least = float(self.medium.extinction.min())
        more, tint = self.medium.extinction - least, sample.tint
        if tint is None and more.any():
            tint = np.ones((3, len(points)), points.dtype).T
        filled = np.ones((3, 0), points.dtype) if tint is None else tint.T
        _dim(points.T, sample.direction.T, sample.distance, self.medium.half, least, more, sample.strength, filled)
        return sample if tint is sample.tint else replace(sample, tint=tint)

    def translated(self, offset: Float[np.ndarray, "3"]) -> "Veiled":
        """See `Light`; the fog stays."""
        return replace(self, light=self.light.translated(offset))

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return self.light.anchor()

    def reach(self) -> float:
        """See `Light`."""
        return self.light.reach()

    def scaled(self, factor: float) -> "Veiled":
        """See `Light`."""
        return replace(self, light=self.light.scaled(factor))


@compiled
def _span(x: float, y: float, z: float, a: float, b: float, c: float, reach: float, half: np.ndarray) -> tuple:
    """From where to where a ray is in the box."""
    near, far = 0.0, reach
    for axis in range(3):
        place = x if axis == 0 else (y if axis == 1 else z)
        way = a if axis == 0 else (b if axis == 1 else c)
        if way == 0.0:
            far = far if abs(place) <= half[axis] else 0.0
        else:
            one, other = (-half[axis] - place) / way, (half[axis] - place) / way
            near, far = max(near, min(one, other)), min(far, max(one, other))
    return near, max(near, far)


@compiled
def _spans(origins: np.ndarray, directions: np.ndarray, reach: np.ndarray, half: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(reach)):
        x, y, z = np.float64(origins[i, 0]), np.float64(origins[i, 1]), np.float64(origins[i, 2])
        a, b, c = np.float64(directions[i, 0]), np.float64(directions[i, 1]), np.float64(directions[i, 2])
        out[0, i], out[1, i] = _span(x, y, z, a, b, c, np.float64(reach[i]), half)


@compiled
def _dim(
    points: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
    half: np.ndarray,
    least: float,
    more: np.ndarray,
    strength: np.ndarray,
    tint: np.ndarray,
) -> None:
    """Beer and Lambert's law: what all channels lose goes off the strength, what some lose besides off the tint."""
    coloured = tint.shape[1] > 0
    for i in range(len(strength)):
        x, y, z = np.float64(points[0, i]), np.float64(points[1, i]), np.float64(points[2, i])
        a, b, c = np.float64(direction[0, i]), np.float64(direction[1, i]), np.float64(direction[2, i])
        near, far = _span(x, y, z, a, b, c, np.float64(distance[i]), half)
        strength[i] *= np.exp(-least * (far - near))
        if coloured:
            for channel in range(3):
                tint[channel, i] *= np.exp(-more[channel] * (far - near))


@compiled
def _fly(
    span: np.ndarray,
    throughput: np.ndarray,
    numbers: np.ndarray,
    extinction: np.ndarray,
    where: np.ndarray,
    factor: np.ndarray,
) -> None:
    least = min(extinction[0], extinction[1], extinction[2])
    for i in range(len(where)):
        total = np.float64(throughput[0, i]) + throughput[1, i] + throughput[2, i]
        pick = numbers[0, i] * total
        channel = 0 if pick < throughput[0, i] else (1 if pick < np.float64(throughput[0, i]) + throughput[1, i] else 2)
        length = span[1, i] - span[0, i]
        flight = -np.log(1.0 - numbers[1, i]) / extinction[channel]
        meets = flight < length
        flown = flight if meets else length
        mean = 0.0
        for k in range(3):  # over what the clearest channel has left: no more than 1, and not all 0
            factor[k, i] = np.exp((least - extinction[k]) * flown) * (extinction[k] if meets else 1.0)
            mean += throughput[k, i] * factor[k, i]
        for k in range(3):
            factor[k, i] *= total / mean
        where[i] = span[0, i] + flight if meets else np.inf


@compiled
def _stop(
    place: np.ndarray,
    span: np.ndarray,
    throughput: np.ndarray,
    numbers: np.ndarray,
    lamp: np.ndarray,
    stands: bool,
    extinction: np.ndarray,
    albedo: np.ndarray,
    there: np.ndarray,
    worth: np.ndarray,
) -> None:
    for i in range(throughput.shape[1]):
        near, far = span[0, i], span[1, i]
        length = far - near
        along, squared = 0.0, 0.0
        for axis in range(3):
            along += (lamp[axis] - place[axis, i]) * place[3 + axis, i]
        for axis in range(3):
            squared += (lamp[axis] - place[axis, i] - along * place[3 + axis, i]) ** 2
        beside = max(np.sqrt(squared), 1e-6 * length)
        low, high = np.arctan2(near - along, beside), np.arctan2(far - along, beside)
        share = 0.5 if stands and high - low > _NARROW else 0.0
        pick = np.float64(numbers[0, i])
        if pick < share:
            flown = along + beside * np.tan(low + numbers[1, i] * (high - low)) - near
        else:
            pick = (pick - share) / (1 - share) * (np.float64(throughput[0, i]) + throughput[1, i] + throughput[2, i])
            k = 0 if pick < throughput[0, i] else (1 if pick < np.float64(throughput[0, i]) + throughput[1, i] else 2)
            flown = -np.log1p(numbers[1, i] * np.expm1(-extinction[k] * length)) / extinction[k]
        flown = min(max(flown, 0.0), length)
        weight, density = np.float64(0), np.float64(0)
        for k in range(3):
            density += throughput[k, i] * extinction[k] * np.exp(-extinction[k] * flown) / -np.expm1(-extinction[k] * length)
            weight += throughput[k, i]
        density = (1 - share) * density / weight
        if share > 0:
            off = near + flown - along
            density += share * beside / ((high - low) * (beside * beside + off * off))
        for k in range(3):
            worth[k, i] = throughput[k, i] * albedo[k] * extinction[k] * np.exp(-extinction[k] * flown) / density
            there[k, i] = place[k, i] + (near + flown) * place[3 + k, i]
            there[3 + k, i] = place[3 + k, i]


@compiled
def _scatter(directions: np.ndarray, numbers: np.ndarray, g: float, out: np.ndarray) -> None:
    """Directions at Henyey and Greenstein's angles to others, by the inverse that `random_walk.scattered_at` has too."""
    for i in range(len(directions)):
        u, turn = np.float64(numbers[i, 0]), 2 * np.pi * numbers[i, 1]
        part = (1 - g * g) / (1 - g + 2 * g * u)
        drawn = 2 * u - 1 if abs(g) < 1e-6 else (1 + g * g - part * part) / (2 * g)
        cosine = min(max(drawn, -1.0), 1.0)
        x, y, z = np.float64(directions[i, 0]), np.float64(directions[i, 1]), np.float64(directions[i, 2])
        sign = 1.0 if z >= 0 else -1.0
        a = -1 / (sign + z)
        b = x * y * a
        sine = np.sqrt(1 - cosine * cosine)
        p, q = sine * np.cos(turn), sine * np.sin(turn)
        r = p * (1 + sign * x * x * a) + q * b + cosine * x
        s = p * sign * b + q * (sign + y * y * a) + cosine * y
        t = -p * sign * x - q * y + cosine * z
        size = 1 / np.sqrt(r * r + s * s + t * t)
        out[i, 0], out[i, 1], out[i, 2] = r * size, s * size, t * size
