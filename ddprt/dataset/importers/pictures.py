"""Pictures of any of the formats that renderers and cameras write, as linear Rec.709."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ddprt.axes import Float32
from ddprt.catalogue import Catalogue
from ddprt.dataset.importers.channels import OVER_PI, choose
from ddprt.dataset.importers.colour import Found, detect
from ddprt.errors import UserError
from ddprt.scene.exr import read_channels

_NEGATIVE = 1e-5  # of the brightest value: what a filter or a codec leaves below 0 counts as 0


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture that has been read.

    Attributes:
      light: linear Rec.709 (or plain numbers, where they are no colours), row 0 at the top.
      alpha: where the file has it.
      colour: what its numbers are, in words.
      layer: that was read; "" for plain RGB.
      coarse: it has 8 bits a channel.
      quantity: what its header or its layer says that it holds; "" where they do not.
    """

    light: Float32[np.ndarray, "height width 3"]
    alpha: Float32[np.ndarray, "height width"] | None
    colour: str
    layer: str = ""
    coarse: bool = False
    quantity: str = ""


@dataclass(frozen=True)
class Wanted:
    """What is to be read of a picture.

    Attributes:
      kind: "direct", "indirect", "albedo" and so on.
      channels: see `channels.choose`.
      colour: a key of `SPACES`, "auto", or "" for numbers that are no colours.
    """

    kind: str
    channels: str = ""
    colour: str = "auto"


def read_picture(path: Path, wanted: Wanted) -> Picture:
    """Reads a picture by its suffix.

    Raises:
      UserError: missing, damaged, of an unknown format, without the channels, or with a number that is not finite.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise UserError(f'{path}: got suffix "{path.suffix}", expected one of {", ".join(READERS)}; convert it')
    if not path.is_file():
        raise UserError(f"{path}: got no such file, expected a picture of {wanted.kind}; check the path")
    picture = READERS[suffix](path, wanted)
    if not np.isfinite(picture.light).all():
        row, column = np.argwhere(~np.isfinite(picture.light).all(2))[0].tolist()
        raise UserError(f"{path}: got NaN or infinity in row {row}, column {column}, expected light; render or repair it")
    return picture


def no_negatives(path: Path, light: Float32[np.ndarray, "height width 3"], *, clip: bool) -> np.ndarray:
    """Light without what is below 0.

    Args:
      path: named in the message.
      light: as read.
      clip: cut off any amount.
    Raises:
      UserError: more is below 0 than rounding leaves.
    """
    low = float(light.min(initial=0))
    if low < -_NEGATIVE * float(light.max(initial=0)) and not clip:
        row, column = np.argwhere(light.min(2) == low)[0].tolist()
        raise UserError(
            f"{path}: got {low:.3g} in row {row}, column {column}, expected light of 0 or more; render with a filter without "
            "negative lobes, or cut it off with --clip"
        )
    return np.maximum(light, 0)


def _exr(path: Path, wanted: Wanted) -> Picture:
    file = read_channels(path)
    layer, names = choose(file.planes, wanted.channels, wanted.kind, str(path))
    planes = [file.planes[name] for name in names]
    image = np.ascontiguousarray(np.stack(planes * (3 if len(planes) == 1 else 1), 2))
    prefix = f"{layer}." if layer else ""
    alpha = next((file.planes[name] for name in (f"{prefix}A", "A") if name in file.planes), None)
    quantity = file.attributes.get("ddprt_quantity", "")
    if layer.lower().endswith(OVER_PI):
        quantity = "E/pi"
    image = np.ldexp(image, int(file.attributes.get("ddprt_exposure", "0")))
    return _coloured(path, wanted, image, alpha, file.attributes, file.chromaticities, layer=layer, quantity=quantity)


def _hdr(path: Path, wanted: Wanted) -> Picture:
    from ddprt.lights.panorama import read_hdr

    try:
        image = read_hdr(path)
    except UserError as error:
        raise UserError(str(error).removeprefix("environment.image ")) from None
    return _coloured(path, wanted, image, None, {}, None)


def _plain(path: Path, wanted: Wanted) -> Picture:
    try:
        with Image.open(path) as opened:
            deep = opened.mode.startswith("I")
            if deep:
                grey = np.asarray(opened, np.float32) / 65535
                pixels, alpha = np.repeat(grey[..., None], 3, 2), None
            else:
                whole = np.asarray(opened.convert("RGBA"), np.float32) / 255
                pixels, alpha = np.ascontiguousarray(whole[..., :3]), whole[..., 3]
                alpha = alpha if "A" in opened.getbands() or "transparency" in opened.info else None
    except (OSError, ValueError, SyntaxError) as error:
        raise UserError(f"{path}: not a whole picture ({error}); write it or copy it again") from None
    return _coloured(path, wanted, pixels, alpha, {}, None, encoded=True, coarse=not deep)


READERS: Catalogue[Callable[[Path, Wanted], Picture]] = Catalogue(
    "picture format",
    {".exr": _exr, ".hdr": _hdr, ".png": _plain, ".jpg": _plain, ".jpeg": _plain, ".tif": _plain, ".tiff": _plain},
)
"""By suffix. PNG, JPEG and TIFF are taken as sRGB."""


def _coloured(
    path: Path,
    wanted: Wanted,
    image: np.ndarray,
    alpha: np.ndarray | None,
    attributes: dict[str, str],
    chromaticities: tuple[float, ...] | None,
    *,
    encoded: bool = False,
    coarse: bool = False,
    layer: str = "",
    quantity: str = "",
) -> Picture:
    if not wanted.colour:
        return Picture(np.ascontiguousarray(image, np.float32), alpha, "plain numbers", layer, coarse, quantity)
    found: Found = detect(wanted.colour, path, attributes, chromaticities, encoded=encoded)
    return Picture(found.linear(image), alpha, found.told, layer, coarse, quantity)
