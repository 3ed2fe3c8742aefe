"""Lights with size: rectangles and spheres. They emit; they never occlude."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ddprt.axes import Float, Float64
from ddprt.compiled import compiled
from ddprt.lights.light import Colour, Extent, Illumination, LightModel, Vector, brightened, columns, moved, place

_NEAR = 1.5
"""Half-diagonals from its centre within which a rectangle is sampled by solid angle."""
_SQUARE = 1e-9
"""Cosine of the angle between sides up to which they count as square to each other."""

_THIN = 1e-6
"""Half-sides before its plane within which a rectangle is taken to be seen edge on, and is sampled by area."""


class RectLight(LightModel):
    """A parallelogram that emits along half_u x half_v, radiance in W/(m² sr); its back is dark.

    Sampled uniformly by area: E = mean of L * area * cos_light / r². From points near to it, where that varies without bound,
    and if its sides are square to each other, uniformly by solid angle: E = mean of L * solid angle.
    """

    kind: ClassVar[str] = "rect"
    delta: ClassVar[bool] = False
    type: Literal["rect"] = "rect"
    center: Vector
    half_u: Extent
    half_v: Extent
    radiance: Colour

    @model_validator(mode="after")
    def _has_area(self) -> "RectLight":
        if not np.cross(self.half_u, self.half_v).any():
            raise ValueError("half_v: got a vector parallel to half_u, expected a rectangle with area; turn one of them")
        return self

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`."""
        out = Illumination.at(points, out)
        out.colour[:] = self.radiance
        sides = np.array([self.half_u, self.half_v])
        lengths = np.linalg.norm(sides, axis=1)
        square = abs(sides[0] @ sides[1]) <= _SQUARE * lengths[0] * lengths[1]
        near = _NEAR**2 * float(lengths @ lengths) if square else 0.0
        where = place(self.center, points)
        _rectangle(columns(points), columns(u), where, sides, near, out.direction.T, out.distance, out.strength)
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "RectLight":
        """See `Light`."""
        return self.model_copy(update={"center": moved(self.center, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.center)

    def reach(self) -> float:
        """See `Light`."""
        corners = np.add(self.half_u, self.half_v), np.subtract(self.half_u, self.half_v)
        return float(np.linalg.norm(corners, axis=1).max())

    def scaled(self, factor: float) -> "RectLight":
        """See `Light`."""
        return self.model_copy(update={"radiance": brightened(self.radiance, factor)})


class SphereLight(LightModel):
    """A glowing ball, radiance in W/(m² sr); from outside, sampled uniformly within the cone it fills.

    A point inside the ball receives nothing from it: a lamp's interior is not part of the scene.
    """

    kind: ClassVar[str] = "sphere"
    delta: ClassVar[bool] = False
    type: Literal["sphere"] = "sphere"
    center: Vector
    radius: Annotated[float, Field(gt=0, le=1e12)]
    radiance: Colour

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`."""
        out = Illumination.at(points, out)
        out.colour[:] = self.radiance
        where = place(self.center, points)
        _ball(columns(points), columns(u), where, self.radius, out.direction.T, out.distance, out.strength)
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "SphereLight":
        """See `Light`."""
        return self.model_copy(update={"center": moved(self.center, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.center)

    def reach(self) -> float:
        """See `Light`."""
        return self.radius

    def scaled(self, factor: float) -> "SphereLight":
        """See `Light`."""
        return self.model_copy(update={"radiance": brightened(self.radiance, factor)})


def sample_rectangle(x: np.ndarray, y: np.ndarray, z: float, u: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """Points of a rectangle, uniform by the solid angle that it fills at the origin.

    Args:
      x, y: both ends of its sides, in its own plane.
      z: distance of that plane, > 0.
      u: uniform numbers.
    Reference: Urena, Fajardo and King, "An Area-Preserving Parametrization for Spherical Rectangles", EGSR 2013; corners by
      arctangents in place of arccosines, which keeps thin ones exact.
    """
    found = np.empty((len(u), 2))
    for i, (s, t) in enumerate(u.tolist()):
        found[i] = _seen(x[0], x[1], y[0], y[1], z, s, t)[:2]
    return found


def pdf_rectangle(x: np.ndarray, y: np.ndarray, z: float, at: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
    """Per m² of the rectangle."""
    return z / (at[:, 0] ** 2 + at[:, 1] ** 2 + z * z) ** 1.5 / _solid_angle(x[0], x[1], y[0], y[1], z)


def invert_rectangle(x: np.ndarray, y: np.ndarray, z: float, at: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
    """The uniform numbers that give these points."""
    s = np.array([_solid_angle(x[0], end, y[0], y[1], z) for end in at[:, 0].tolist()]) / _solid_angle(
        x[0], x[1], y[0], y[1], z
    )
    across = np.hypot(at[:, 0], z)
    low, here, high = (end / np.hypot(across, end) for end in (y[0], at[:, 1], y[1]))
    return np.stack([s, (here - low) / (high - low)], -1)


@compiled
def _lune(x: float, y0: float, y1: float, z: float) -> float:
    """Solid angle, signed, between a side at x and the foot of the perpendicular: a difference of two arctangents, by one."""
    square = x * x + z * z
    a, b, c, d = x * y0, z * np.sqrt(square + y0 * y0), x * y1, z * np.sqrt(square + y1 * y1)
    return np.arctan2(c * b - a * d, b * d + a * c)


@compiled
def _solid_angle(x0: float, x1: float, y0: float, y1: float, z: float) -> float:
    return _lune(x1, y0, y1, z) - _lune(x0, y0, y1, z)


@compiled
def _seen(x0: float, x1: float, y0: float, y1: float, z: float, s: float, t: float) -> tuple[float, float, float]:
    """A point of the rectangle at distance z, and its solid angle."""
    left = _lune(x0, y0, y1, z)
    whole = _lune(x1, y0, y1, z) - left
    turns = (s * whole + left) / (2 * np.pi)
    cosine, sine = _turned(turns + 1 if turns < 0 else turns)
    below, above = y0 * y0 + z * z, y1 * y1 + z * z
    f = (y1 / np.sqrt(above) - y0 / np.sqrt(below) * cosine) / sine
    x = np.copysign(z, f) / np.sqrt(max(f * f - z * z / below, 1e-300))
    x = min(max(x, x0), x1)
    squared = x * x + z * z
    low, high = y0 / np.sqrt(squared + y0 * y0), y1 / np.sqrt(squared + y1 * y1)
    h = low + t * (high - low)
    y = h * np.sqrt(squared / max(1 - h * h, 1e-300))
    return x, min(max(y, y0), y1), whole


@compiled
def _rectangle(
    points: np.ndarray,
    u: np.ndarray,
    center: np.ndarray,
    sides: np.ndarray,
    near: float,
    direction: np.ndarray,
    distance: np.ndarray,
    strength: np.ndarray,
) -> None:
    """Area times the light's own cosine / r², or its solid angle within `near` m²; in float64 whatever the arrays hold."""
    across = 4 * np.cross(sides[0], sides[1])
    corner = center - sides[0] - sides[1]
    for i in range(points.shape[1]):
        s, t = 2.0 * u[0, i], 2.0 * u[1, i]
        x = corner[0] + s * sides[0, 0] + t * sides[1, 0] - points[0, i]
        y = corner[1] + s * sides[0, 1] + t * sides[1, 1] - points[1, i]
        z = corner[2] + s * sides[0, 2] + t * sides[1, 2] - points[2, i]
        length = np.sqrt(x * x + y * y + z * z)
        inverse = 1 / length if length > 0 else 0.0
        x, y, z = x * inverse, y * inverse, z * inverse
        direction[0, i], direction[1, i], direction[2, i], distance[i] = x, y, z, length
        strength[i] = max(-(x * across[0] + y * across[1] + z * across[2]), 0.0) * inverse * inverse
    if near == 0:
        return
    half_u, half_v = np.sqrt(np.sum(sides[0] ** 2)), np.sqrt(np.sum(sides[1] ** 2))
    right, up, front = sides[0] / half_u, sides[1] / half_v, across / (4 * half_u * half_v)
    for i in range(points.shape[1]):
        x, y, z = center[0] - points[0, i], center[1] - points[1, i], center[2] - points[2, i]
        if x * x + y * y + z * z < near:
            along, above = x * right[0] + y * right[1] + z * right[2], x * up[0] + y * up[1] + z * up[2]
            away = -(x * front[0] + y * front[1] + z * front[2])
            if away > _THIN * half_u and away > _THIN * half_v:  # else edge on, or behind
                a, b, whole = _seen(along - half_u, along + half_u, above - half_v, above + half_v, away, u[0, i], u[1, i])
                length = np.sqrt(a * a + b * b + away * away)
                for axis in range(3):
                    direction[axis, i] = (a * right[axis] + b * up[axis] - away * front[axis]) / length
                distance[i], strength[i] = length, whole


@compiled
def _ball(
    points: np.ndarray,
    u: np.ndarray,
    center: np.ndarray,
    radius: float,
    direction: np.ndarray,
    distance: np.ndarray,
    strength: np.ndarray,
) -> None:
    """A direction of the cone that the ball fills, and the cone's solid angle; in float64 whatever the arrays hold."""
    for i in range(points.shape[1]):
        x, y, z = center[0] - points[0, i], center[1] - points[1, i], center[2] - points[2, i]
        squared = x * x + y * y + z * z
        length = np.sqrt(squared)
        inverse = 1 / length if length > 0 else 0.0
        x, y, z = x * inverse, y * inverse, z * inverse
        outside = squared > radius * radius
        widest = radius * inverse * radius * inverse if outside else 1.0  # squared sine of the cone's half-angle
        cap = widest / (1 + np.sqrt(1 - widest))  # 1 - its cosine, free of cancellation for far lamps
        drop = u[0, i] * cap
        sine2 = drop * (2 - drop)
        sine, cosine = np.sqrt(sine2), 1 - drop
        right, up = _turned(u[1, i])
        right, up = right * sine, up * sine
        # Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
        sign = np.copysign(1.0, z)
        a = -1 / (sign + z)
        b = x * y * a
        direction[0, i] = right * (1 + sign * x * x * a) + up * b + cosine * x
        direction[1, i] = right * sign * b + up * (sign + y * y * a) + cosine * y
        direction[2, i] = -right * sign * x - up * y + cosine * z
        chord = np.sqrt(max(radius * radius - squared * sine2, 0.0))
        distance[i] = max(cosine * length - chord, 0.0)
        strength[i] = 2 * np.pi * cap if outside else 0.0


@compiled
def _turned(turns: float) -> tuple[float, float]:
    """Cosine and sine of a number of turns in [0, 1): polynomials of an eighth of a turn, which fill the vectors.

    Coefficients of FreeBSD's __kernel_sin and __kernel_cos, good to the last bit of float64.
    """
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
