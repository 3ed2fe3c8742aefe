"""Light from all around, as a picture of the sky."""

from functools import lru_cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from ddprt.axes import Float, Float64
from ddprt.lights.light import Illumination, LightModel, Strength


class EnvironmentLight(LightModel):
    """A distant sphere that shines inwards: an equirectangular image of linear radiance in W/(m² sr), times `scale`.

    The pixel at u = 1/2 + atan2(x, -z) / (2 pi), v = acos(y) / pi, row 0 at the top, is seen towards (x, y, z); so the middle
    of the image lies at -z, and its right half towards +x. `rotation_deg` turns the sky about +Y by the right-hand rule,
    counter-clockwise seen from above: 90 brings the middle of the image from -z to -x. A glTF node turned about +Y does the
    same, and Mitsuba's `to_world` of rotate([0, 1, 0], degrees), but that its images are rolled by half their width.

    `image` is an EXR or Radiance HDR file, or a key of `panorama.SKIES`. It is read when light is first asked for, and again
    when the file has changed since.
    """

    kind: ClassVar[str] = "environment"
    delta: ClassVar[bool] = False
    type: Literal["environment"] = "environment"
    image: Annotated[str, Field(min_length=1)]
    rotation_deg: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    scale: Strength = 1.0

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`; every sample has a colour of its own.

        Raises:
          UserError: the image is missing, damaged, or no picture of light.
        """
        from ddprt.lights.sky import load_sky, shine  # most scenes have no sky, and need none of this

        out = Illumination.tinted(points, out)
        out.distance[:], out.colour[:] = np.inf, self.scale
        shine(load_sky(self.image), np.deg2rad(self.rotation_deg), u, normals, out)
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "EnvironmentLight":
        """See `Light`; it has no place to move."""
        return self

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`."""
        return None

    def reach(self) -> float:
        """See `Light`."""
        return 0.0

    def scaled(self, factor: float) -> "EnvironmentLight":
        """See `Light`."""
        return self.model_copy(update={"scale": self.scale * factor})

    def harmonics(self, order: int) -> Float64[np.ndarray, "harmonics 3"]:
        """Coefficients of its radiance, W/m², by `ddprt.harmonics`: exact sums over the pixels.

        Raises:
          UserError: the image is missing, damaged, or no picture of light.
        """
        from ddprt import harmonics
        from ddprt.lights.panorama import stamp

        unturned = _projected(self.image, stamp(self.image), order)
        return self.scale * harmonics.turned(unturned, np.deg2rad(self.rotation_deg))


@lru_cache(32)  # 1024 x 512 pixels take 50 ms, which every turn of a sky would pay anew
def _projected(image: str, stamp: tuple[int, ...], order: int) -> Float64[np.ndarray, "harmonics 3"]:
    from ddprt import harmonics
    from ddprt.lights.sky import load_sky

    return harmonics.of_panorama(load_sky(image).radiance, order)
