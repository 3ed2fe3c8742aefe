"""Fog: a homogeneous medium that fills the free space of a scene.

It fills the scene's bounding box and no more. Without an end it would swallow all light that comes from afar, of suns and
skies; and the box is where things are that it could show on.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ddprt.errors import UserError, nearest

LONGEST = 1e12
"""Metres of a mean free path: no scene is as large, so a longer one is as good as no fog."""
SHORTEST = 1e-9
"""Metres of a mean free path, likewise the other way."""
_KEYS = ("mean_free_path", "albedo", "anisotropy")


@dataclass(frozen=True)
class Fog:
    """What fills the bounding box of a scene.

    Attributes:
      mean_free_path: between two meetings of light with it, metres per channel.
      albedo: of single scattering, 0 to 1 per channel: the share that is not swallowed at such a meeting.
      anisotropy: mean cosine of the angle of scattering (Henyey and Greenstein 1941), -1 to 1, both excluded.
    """

    mean_free_path: tuple[float, float, float]
    albedo: tuple[float, float, float] = (1.0, 1.0, 1.0)
    anisotropy: float = 0.0

    @classmethod
    def of(cls, given: "Fog | Mapping[str, Any]", where: str = "fog") -> "Fog":
        """Checked values; one number stands for all channels.

        Args:
          given: fog, or its attributes by name, of which the mean free path must be there.
          where: named in messages.
        Raises:
          UserError: an unknown or missing name, or a value out of its range.
        """
        values = {key: getattr(given, key) for key in _KEYS} if isinstance(given, Fog) else given
        if not isinstance(values, Mapping):
            raise UserError(f"{where}: got {values!r}, expected a table; write {{'mean_free_path': 0.5}} or the like")
        for key in values:
            if key not in _KEYS:
                raise UserError(f"{where}.{key}: unknown key{nearest(str(key), _KEYS)}; known here: {', '.join(_KEYS)}")
        if "mean_free_path" not in values:
            raise UserError(f"{where}: got no mean_free_path, expected metres per channel; add it, or leave the fog out")
        path, albedo = (_channels(where, key, values.get(key, 1.0)) for key in _KEYS[:2])
        if not all(SHORTEST <= length <= LONGEST for length in path):
            raise UserError(
                f"{where}.mean_free_path: got {list(path)}, expected {SHORTEST:g} to {LONGEST:g} m; correct it, or "
                "leave the fog out"
            )
        if not all(0 <= share <= 1 for share in albedo):
            raise UserError(f"{where}.albedo: got {list(albedo)}, expected 0 to 1; correct it")
        bend = values.get("anisotropy", 0.0)
        if not isinstance(bend, int | float) or isinstance(bend, bool) or not -1 < bend < 1:
            raise UserError(f"{where}.anisotropy: got {bend!r}, expected a number between -1 and 1, both excluded; correct it")
        return cls(path, albedo, float(bend))

    @property
    def record(self) -> dict[str, Any]:
        """The same as JSON has it; `of` takes it back."""
        return {"mean_free_path": list(self.mean_free_path), "albedo": list(self.albedo), "anisotropy": self.anisotropy}


def _channels(where: str, key: str, given: Any) -> tuple[float, float, float]:
    values = [given] * 3 if isinstance(given, int | float) else given
    sound = isinstance(values, Sequence) and all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
    if not sound or len(values) not in (1, 3) or not all(map(math.isfinite, values)):
        raise UserError(f"{where}.{key}: got {given!r}, expected a finite number, or three (red, green, blue); correct it")
    red, green, blue = (float(one) for one in (values if len(values) == 3 else [*values] * 3))
    return red, green, blue
