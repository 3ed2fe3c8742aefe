"""Lights with size: rectangles and spheres. They emit; they never occlude."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ddprt import warp
from ddprt.axes import Float
from ddprt.lights.light import Colour, Extent, Illumination, LightModel, Vector, brightened, moved, unit


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
            raise ValueError("half_u and half_v: got parallel vectors, expected a rectangle with area")
        return self

    def illuminate(self, points: Float[np.ndarray, "n 3"], u: Float[np.ndarray, "n 2"]) -> Illumination:
        """See `Light`."""
        dtype = points.dtype
        half_u, half_v = np.asarray(self.half_u, dtype), np.asarray(self.half_v, dtype)
        across = np.cross(half_u, half_v)
        area = 4 * np.linalg.norm(across)
        offset = (2 * u[:, :1] - 1) * half_u + (2 * u[:, 1:] - 1) * half_v
        away = np.asarray(self.center, dtype) + offset - points
        squared = np.einsum("nd,nd->n", away, away)
        direction = unit(away)
        cosine = np.maximum(-direction @ unit(across), 0)
        weight = np.divide(area * cosine, squared, out=np.zeros_like(squared), where=squared > 0)
        return Illumination(direction, np.sqrt(squared), weight[:, None] * np.asarray(self.radiance, dtype))

    def translated(self, offset: Float[np.ndarray, "3"]) -> "RectLight":
        """See `Light`."""
        return self.model_copy(update={"center": moved(self.center, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.center)

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

    def illuminate(self, points: Float[np.ndarray, "n 3"], u: Float[np.ndarray, "n 2"]) -> Illumination:
        """See `Light`."""
        dtype = points.dtype
        away = np.asarray(self.center, dtype) - points
        squared = np.einsum("nd,nd->n", away, away)
        sine2 = np.divide(self.radius**2, squared, out=np.full_like(squared, 2), where=squared > 0)
        outside = sine2 < 1
        sine2 = np.minimum(sine2, 1).astype(dtype)
        cap = sine2 / (1 + np.sqrt(1 - sine2))  # 1 - cos(theta_max), free of cancellation for far lamps
        local = warp.sample_cone(u.astype(dtype), cap)
        direction = warp.to_world(local, warp.frame(unit(away)))
        along = np.einsum("nd,nd->n", direction, away)
        chord = np.sqrt(np.maximum(self.radius**2 - (squared - along**2), 0))
        solid_angle = np.where(outside, 2 * np.pi * cap, 0).astype(dtype)
        irradiance = solid_angle[:, None] * np.asarray(self.radiance, dtype)
        return Illumination(direction, np.maximum(along - chord, 0).astype(dtype), irradiance)

    def translated(self, offset: Float[np.ndarray, "3"]) -> "SphereLight":
        """See `Light`."""
        return self.model_copy(update={"center": moved(self.center, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return np.array(self.center)

    def scaled(self, factor: float) -> "SphereLight":
        """See `Light`."""
        return self.model_copy(update={"radiance": brightened(self.radiance, factor)})
