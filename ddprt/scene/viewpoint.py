"""Where a scene's maker would have it seen from: a place to look from, which no light depends on."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from ddprt.errors import UserError

_ASKEW = 1e-6  # sine of the angle between what is upright and the line of sight, at least

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole's place and direction.

    Attributes:
      eye: metres.
      target: what stands in the middle of the picture, metres.
      up: what is upright in the picture, not along the line of sight.
      fov_deg: vertical opening angle, 0 to 180, both excluded.
      aspect: width over height; None where the maker names none.
    """

    eye: Triple
    target: Triple
    up: Triple
    fov_deg: float
    aspect: float | None = None

    @property
    def record(self) -> dict[str, Any]:
        """The same as JSON has it; `of` takes it back."""
        return asdict(self)

    @classmethod
    def of(cls, given: Any, where: str) -> "Viewpoint":
        """Checked values.

        Args:
          given: what `record` gives.
          where: named in messages.
        Raises:
          UserError: another shape, or numbers that are no view.
        """
        try:
            assert isinstance(given, Mapping)
            eye, target, up = (_triple(given[name]) for name in ("eye", "target", "up"))
            aspect = None if given.get("aspect") is None else float(given["aspect"])
            found = cls(eye, target, up, float(given["fov_deg"]), aspect)
        except (AssertionError, KeyError, TypeError, ValueError):
            raise UserError(
                f"{where}: got {str(given)[:60]}, expected eye, target, up and fov_deg; write the file anew"
            ) from None
        if not found.sound:
            raise UserError(f"{where}: got {str(given)[:60]}, from where nothing can be seen; write the file anew")
        return found

    @property
    def sound(self) -> bool:
        """Whether a picture can be taken."""
        forward = [b - a for a, b in zip(self.eye, self.target, strict=True)]
        x, y, z = self.up
        side = (forward[1] * z - forward[2] * y, forward[2] * x - forward[0] * z, forward[0] * y - forward[1] * x)
        wide = self.aspect is None or 0 < self.aspect < math.inf
        least = _ASKEW * math.hypot(*forward) * math.hypot(x, y, z)
        return wide and 0 < self.fov_deg < 180 and least < math.hypot(*side) < math.inf


def _triple(given: Any) -> Triple:
    x, y, z = (float(number) for number in given)
    return x, y, z
