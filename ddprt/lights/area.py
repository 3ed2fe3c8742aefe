"""Lights with size: rectangles and spheres. They emit; they never occlude."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ddprt.axes import Float
from ddprt.compiled import compiled
from ddprt.lights.light import Colour, Extent, Illumination, LightModel, Vector, brightened, columns, moved, place


class RectLight(LightModel):
    """A parallelogram that emits along half_u x half_v, radiance in W/(m² sr); its back is dark.

    Sampled uniformly by area: E = mean of L * area * cos_light / r².
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
        where = place(self.center, points)
        _rectangle(columns(points), columns(u), where, sides, out.direction.T, out.distance, out.strength)
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


@compiled
def _rectangle(
    points: np.ndarray,
    u: np.ndarray,
    center: np.ndarray,
    sides: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
    strength: np.ndarray,
) -> None:
    """Area times the light's own cosine / r², in float64 whatever the arrays hold."""
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
