"""The whole duty of a light, on one screen.

Lights are frozen pydantic models: their JSON is validated with the same one-line errors as the configuration. All arrays
are float32 or float64 NumPy, world space, metres.
"""

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Protocol, runtime_checkable

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from ddprt.axes import Float, Float64

_LARGEST = 1e30  # W/sr and the like: its square still has room in the exponent of the sums that follow
FARTHEST = 1e12
"""Metres: its square still fits into float32."""
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Strength = Annotated[float, Field(ge=0, le=_LARGEST)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Colour = tuple[Strength, Strength, Strength]


def _not_zero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise ValueError("got a vector of length 0, expected a direction; give it one")
    return vector


def _normalised(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """Unit length, in float64 and safe at any size; a unit vector stays as it is, so that reading back changes nothing."""
    relative = np.array(_not_zero(vector)) / max(map(abs, vector))
    length = float(np.linalg.norm(np.array(vector))) if max(map(abs, vector)) < FARTHEST else np.inf
    if abs(length - 1) < 1e-12:
        return vector
    x, y, z = (relative / np.linalg.norm(relative)).tolist()
    return (x, y, z)


Extent = Annotated[Vector, AfterValidator(_not_zero)]
Direction = Annotated[tuple[float, float, float], AfterValidator(_normalised)]


class LightModel(BaseModel):
    """Base of the light records: unknown keys are errors, numbers are finite, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class Illumination:
    """One sample of a light for each shaded point, in arrays that may be filled again.

    Attributes:
      direction: unit vectors from the point towards the light, a coordinate after another in memory.
      distance: metres that a shadow ray must cross; infinity for distant lights.
      strength: how much of `colour` arrives on a plane that faces `direction`, divided by the sampling density.
      colour: the light's intensity, irradiance or radiance.
      tint: what `colour` is multiplied by at each point; None where the light has one colour.
    """

    direction: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, " n"]
    strength: Float[np.ndarray, " n"]
    colour: Float64[np.ndarray, "3"]
    tint: Float[np.ndarray, "n 3"] | None = None

    @classmethod
    def at(cls, points: Float[np.ndarray, "n 3"], out: "Illumination | None" = None) -> "Illumination":
        """Arrays to be filled, for as many points and of their type; those of `out` if given, without its tint."""
        if out is not None:
            return out if out.tint is None else replace(out, tint=None)
        count, dtype = len(points), points.dtype
        return cls(np.empty((3, count), dtype).T, np.empty(count, dtype), np.empty(count, dtype), np.zeros(3))

    @classmethod
    def tinted(cls, points: Float[np.ndarray, "n 3"], out: "Illumination | None" = None) -> "Illumination":
        """The same with a colour for each point."""
        if out is not None and out.tint is not None:
            return out
        return replace(out or cls.at(points), tint=np.empty((3, len(points)), points.dtype).T)

    @property
    def irradiance(self) -> Float[np.ndarray, "n 3"]:
        """W/m² on a plane that faces `direction`, divided by the sampling density; infinity where that is too much."""
        colour = self.colour if self.tint is None else self.colour * self.tint
        with np.errstate(over="ignore"):
            return (self.strength[:, None] * colour).astype(self.strength.dtype)


@runtime_checkable
class Light(Protocol):
    """What transport asks of a light. A new kind is one class and one entry of `LIGHTS`.

    Attributes:
      kind: its name in JSON, in plans and in messages.
      delta: one ray reaches all of it, so more samples per point would be wasted.
    """

    kind: ClassVar[str]
    delta: ClassVar[bool]

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """Samples the light from each point: the mean over uniform `u` of irradiance * cosine * visible is E.

        Fills and returns `out` if given (with a tint or without, as the light is): fresh memory for every block of points would
        cost more than the arithmetic. Light from all around is sampled better where `normals` are known; others ignore them.
        """
        ...

    def translated(self, offset: Float[np.ndarray, "3"]) -> "Light":
        """The same light moved by `offset` metres: transport works relative to the scene's centre."""
        ...

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """Where the light stands, to tell whether that is inside a solid; None for distant lights."""
        ...

    def reach(self) -> float:
        """Metres from there to its farthest part: 0 for lights without size."""
        ...

    def scaled(self, factor: float) -> "Light":
        """The same light, `factor` times as strong."""
        ...


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Normalises; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, np.finfo(vectors.dtype).tiny)


def columns(vectors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k n"]:
    """A coordinate after another in memory: loops over points then fill the processor's vectors. No copy where it is so."""
    return np.ascontiguousarray(vectors.T)


def place(position: Vector, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3"]:
    """A lamp's place, rounded as the points are, so that a point on the lamp is known as such; then float64."""
    return np.array(position, points.dtype).astype(np.float64)


def brightened(colour: Colour, factor: float) -> Colour:
    """A colour times a factor."""
    red, green, blue = colour
    return (red * factor, green * factor, blue * factor)


def moved(position: Vector, offset: Float[np.ndarray, "3"]) -> Vector:
    """A position plus an offset."""
    x, y, z = (np.asarray(position) + offset).tolist()
    return (x, y, z)
