"""Lights without size: points and spots."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ddprt.axes import Float
from ddprt.lights.light import Colour, Direction, Illumination, LightModel, Vector, brightened, moved, unit


class PointLight(LightModel):
    """Shines equally in all directions: E = I cos(theta) / r², I in W/sr."""

    kind: ClassVar[str] = "point"
    delta: ClassVar[bool] = True
    type: Literal["point"] = "point"
    position: Vector
    intensity: Colour

    def illuminate(self, points: Float[np.ndarray, "n 3"], u: Float[np.ndarray, "n 2"]) -> Illumination:
        """See `Light`; a point on the lamp itself receives nothing, since no cosine is defined there."""
        away = np.asarray(self.position, points.dtype) - points
        squared = np.einsum("nd,nd->n", away, away)
        reciprocal = np.divide(1, squared, out=np.zeros_like(squared), where=squared > 0)
        irradiance = reciprocal[:, None] * np.asarray(self.intensity, points.dtype)
        return Illumination(unit(away), np.sqrt(squared), irradiance)

    def translated(self, offset: Float[np.ndarray, "3"]) -> "PointLight":
        """See `Light`."""
        return self.model_copy(update={"position": moved(self.position, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.position)

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
            raise ValueError(f"inner_deg: got {self.inner_deg}, expected less than outer_deg ({self.outer_deg})")
        return self

    def illuminate(self, points: Float[np.ndarray, "n 3"], u: Float[np.ndarray, "n 2"]) -> Illumination:
        """See `Light`."""
        full = PointLight(position=self.position, intensity=self.intensity).illuminate(points, u)
        axis = unit(np.asarray(self.direction, points.dtype))
        inner, outer = np.cos(np.deg2rad([self.inner_deg, self.outer_deg]))
        falloff = np.clip((-full.direction @ axis - outer) / max(inner - outer, 1e-6), 0, 1) ** 2
        return Illumination(full.direction, full.distance, full.irradiance * falloff[:, None].astype(points.dtype))

    def translated(self, offset: Float[np.ndarray, "3"]) -> "SpotLight":
        """See `Light`."""
        return self.model_copy(update={"position": moved(self.position, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.position)

    def scaled(self, factor: float) -> "SpotLight":
        """See `Light`."""
        return self.model_copy(update={"intensity": brightened(self.intensity, factor)})
