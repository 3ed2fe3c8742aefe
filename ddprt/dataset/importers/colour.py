"""Colour spaces: what a file says of its own, and the way from there to linear Rec.709."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddprt.axes import Float, Float32, Float64
from ddprt.catalogue import Catalogue
from ddprt.errors import UserError
from ddprt.scene.images import srgb_to_linear

_D65, _ACES = (0.3127, 0.3290), (0.32168, 0.33767)
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
_ATTRIBUTES = ("colorspace", "oiio:colorspace", "colorinteropid", "colourspace", "color_space")
_SAME = 2e-3  # in x and y: files round their chromaticities
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


@dataclass(frozen=True)
class Space:
    """A colour space.

    Attributes:
      chromaticities: x and y of red, green, blue and white.
      encoded: values are behind the sRGB curve.
      names: that files and programs call it by, in small letters with underscores.
    """

    chromaticities: tuple[float, ...]
    encoded: bool = False
    names: tuple[str, ...] = ()


SPACES: Catalogue[Space] = Catalogue(
    "colour space",
    {
        "linear-rec709": Space(
            (*_REC709, *_D65),
            names=(
                "lin_rec709",
                "lin_rec709_scene",
                "linear",
                "scene_linear",
                "linear_rec_709",
                "linear_rec709",
                "rec709_linear",
                "linear_srgb",
                "lin_srgb",
                "non_color",
                "raw",
                "data",
            ),
        ),
        "srgb": Space(
            (*_REC709, *_D65),
            encoded=True,
            names=("srgb", "srgb_texture", "srgb_rec709_display", "srgb_rec709_scene", "srgb_display", "g22_rec709"),
        ),
        "linear-rec2020": Space(
            (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
            names=("rec2020", "lin_rec2020", "lin_rec2020_scene", "linear_rec_2020", "linear_rec2020"),
        ),
        "linear-p3": Space(
            (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
            names=("lin_p3d65", "lin_p3d65_scene", "linear_p3_d65", "linear_p3", "display_p3_linear"),
        ),
        "acescg": Space(
            (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES),
            names=("acescg", "aces_acescg", "lin_ap1", "lin_ap1_scene", "aces_cg"),
        ),
        "aces2065-1": Space(
            (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *_ACES),
            names=("aces2065_1", "aces_aces2065_1", "lin_ap0", "lin_ap0_scene"),
        ),
    },
)
"""What `--colour` takes; "auto" looks at the file."""


@dataclass(frozen=True)
class Found:
    """What a picture's numbers mean, and how that was found out.

    Attributes:
      chromaticities: x and y of red, green, blue and white.
      encoded: behind the sRGB curve.
      told: in words.
    """

    chromaticities: tuple[float, ...]
    encoded: bool
    told: str

    def linear(self, image: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Linear Rec.709, at the same brightness; colours that it cannot show have a negative channel."""
        light = srgb_to_linear(image.astype(np.float64)) if self.encoded else image
        if np.allclose(self.chromaticities, SPACES["linear-rec709"].chromaticities, atol=_SAME):
            return np.ascontiguousarray(light, np.float32)
        return np.ascontiguousarray(light.astype(np.float64) @ to_rec709(self.chromaticities).T, np.float32)


def detect(
    asked: str, path: Path, attributes: Mapping[str, str], chromaticities: Sequence[float] | None, *, encoded: bool
) -> Found:
    """What the numbers of a picture are: as asked, as its header says, by its name, else assumed.

    Args:
      asked: a key of `SPACES`, or "auto".
      path: of the picture; its name may hold a word such as "acescg".
      attributes: strings of its header.
      chromaticities: of its header.
      encoded: pictures of this format are sRGB unless they say otherwise.
    Raises:
      UserError: an unknown name, asked for or in the header.
    """
    if asked != "auto":
        return _named(asked, "as asked")
    for key, value in attributes.items():
        if key.lower() in _ATTRIBUTES and value.strip():
            name = _known(value)
            if name is None:
                raise UserError(
                    f'{path}: got {key} "{value}", expected a colour space that is known here; say which with --colour, one of '
                    f"{', '.join(SPACES)}"
                )
            return _named(name, f'the file says {key} "{value}"')
    if chromaticities is not None:
        for name, space in SPACES.items():
            if not space.encoded and np.allclose(space.chromaticities, chromaticities, atol=_SAME):
                return _named(name, "by the file's chromaticities")
        return Found(tuple(chromaticities), False, "linear, with the file's own chromaticities")
    words = re.split(r"[^a-z0-9]+", path.stem.lower())
    for size in (3, 2, 1):
        for first in range(len(words) - size + 1):
            found = _known("_".join(words[first : first + size]))
            if found is not None and (size > 1 or words[first] not in ("linear", "data", "raw")):
                return _named(found, "by the file's name")
    return _named("srgb", "taken as sRGB, 8 bits a channel or so") if encoded else _named("linear-rec709", "assumed")


def to_rec709(chromaticities: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Matrix from linear colours of a space to linear Rec.709; white stays white (Bradford)."""
    source, target = np.asarray(chromaticities, float), np.asarray(SPACES["linear-rec709"].chromaticities)
    cones = [_BRADFORD @ _white(space) for space in (source, target)]
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(cones[1] / cones[0]) @ _BRADFORD
    return np.linalg.inv(_to_xyz(target)) @ adapted @ _to_xyz(source)


def _to_xyz(chromaticities: Float[np.ndarray, "8"]) -> Float64[np.ndarray, "3 3"]:
    x, y = chromaticities[:6:2], chromaticities[1:6:2]
    primaries = np.stack([x, y, 1 - x - y])
    return primaries * np.linalg.solve(primaries, _white(chromaticities))


def _white(chromaticities: Float[np.ndarray, "8"]) -> Float64[np.ndarray, "3"]:
    x, y = chromaticities[6:]
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _named(name: str, why: str) -> Found:
    space = SPACES[name]
    return Found(space.chromaticities, space.encoded, f"{name} ({why})")


def _known(text: str) -> str | None:
    word = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return next((name for name, space in SPACES.items() if word in (*space.names, name.replace("-", "_"))), None)
