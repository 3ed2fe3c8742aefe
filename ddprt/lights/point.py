"""Lights without size: points and spots."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ddprt.axes import Float
from ddprt.compiled import compiled
from ddprt.lights.light import Colour, Direction, Illumination, LightModel, Vector, brightened, columns, moved, place, unit


class PointLight(LightModel):
    """Shines equally in all directions: E = I cos(theta) / r², I in W/sr."""

    kind: ClassVar[str] = "point"
    delta: ClassVar[bool] = True
    type: Literal["point"] = "point"
    position: Vector
    intensity: Colour

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`; a point on the lamp itself receives nothing, since no cosine is defined there."""
        out = Illumination.at(points, out)
        out.colour[:] = self.intensity
        _point(columns(points), place(self.position, points), out.direction.T, out.distance, out.strength)
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "PointLight":
        """See `Light`."""
        return self.model_copy(update={"position": moved(self.position, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.position)

    def reach(self) -> float:
        """See `Light`."""
        return 0.0

    def scaled(self, factor: float) -> "PointLight":
        """See `Light`."""
        return self.model_copy(update={"intensity": brightened(self.intensity, factor)})


class SpotLight(LightModel):
    """A point light within a cone, with the falloff of glTF's KHR_lights_punctual; half-angles from the axis."""

    kind: ClassVar[str] = "spot"
    delta: ClassVar[bool] = True
    type: Literal["spot"] = "spot"
    position: Vector
    direction: Direction
    intensity: Colour
    inner_deg: Annotated[float, Field(ge=0, lt=90)] = 0.0
    outer_deg: Annotated[float, Field(gt=0, le=90)] = 45.0

    @model_validator(mode="after")
    def _cone_opens(self) -> "SpotLight":
        if self.inner_deg >= self.outer_deg:
            raise ValueError(f"inner_deg: got {self.inner_deg}, expected less than outer_deg ({self.outer_deg}); lower it")
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
        out.colour[:] = self.intensity
        _point(columns(points), place(self.position, points), out.direction.T, out.distance, out.strength)
        inner, outer = 2 * np.sin(np.deg2rad([self.inner_deg, self.outer_deg]) / 2) ** 2
        _within_cone(unit(np.array(self.direction)), outer, max(outer - inner, 1e-300), out.direction.T, out.strength)
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "SpotLight":
        """See `Light`."""
        return self.model_copy(update={"position": moved(self.position, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.position)

    def reach(self) -> float:
        """See `Light`."""
        return 0.0

    def scaled(self, factor: float) -> "SpotLight":
        """See `Light`."""
        return self.model_copy(update={"intensity": brightened(self.intensity, factor)})


@compiled
def _point(points: np.ndarray, position: np.ndarray, direction: np.ndarray, distance: np.ndarray, strength: np.ndarray) -> None:
    """1 / r², in float64 whatever the arrays hold."""
    for i in range(points.shape[1]):
        x, y, z = position[0] - points[0, i], position[1] - points[1, i], position[2] - points[2, i]
        length = np.sqrt(x * x + y * y + z * z)
        inverse = 1 / length if length > 0 else 0.0
        direction[0, i], direction[1, i], direction[2, i] = x * inverse, y * inverse, z * inverse
        distance[i], strength[i] = length, inverse * inverse


@compiled
def _within_cone(axis: np.ndarray, outer: float, width: float, direction: np.ndarray, strength: np.ndarray) -> None:
    """Takes away what a spot withholds: `outer` is 1 - cosine at the rim, `width` the way from full light's to there.

    1 - cosine is half the squared distance of the two unit vectors: in a narrow cone the cosine itself would be all rounding.
    """
    for i in range(len(strength)):
        x, y, z = direction[0, i] + axis[0], direction[1, i] + axis[1], direction[2, i] + axis[2]
        drop = 0.5 * (x * x + y * y + z * z)
        falloff = min(max((outer - drop) / width, 0.0), 1.0)
        strength[i] *= falloff * falloff
