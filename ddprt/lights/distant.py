"""Lights too far away to have a place: directional."""

from typing import ClassVar, Literal

import numpy as np

from ddprt.axes import Float
from ddprt.lights.light import Colour, Direction, Illumination, LightModel, brightened, unit


class DirectionalLight(LightModel):
    """Parallel light; `direction` is where it travels, `irradiance` in W/m² on a plane that faces it."""

    kind: ClassVar[str] = "directional"
    delta: ClassVar[bool] = True
    type: Literal["directional"] = "directional"
    direction: Direction
    irradiance: Colour

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`."""
        out = Illumination.at(points, out)
        out.direction.T[:] = -unit(np.array(self.direction))[:, None]
        out.distance[:], out.strength[:], out.colour[:] = np.inf, 1, self.irradiance
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "DirectionalLight":
        """See `Light`; it has no place to move."""
        return self

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return None

    def reach(self) -> float:
        """See `Light`."""
        return 0.0

    def scaled(self, factor: float) -> "DirectionalLight":
        """See `Light`."""
        return self.model_copy(update={"irradiance": brightened(self.irradiance, factor)})
