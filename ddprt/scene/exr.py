"""The only door to OpenEXR: contiguous arrays in, half floats that never overflow, files that are whole or absent."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float, Float32
from ddprt.errors import UserError
from ddprt.files import written_whole

HALF_MAX = 65504.0


def write_exr(
    path: Path,
    image: Float[np.ndarray, "height width channels"],
    *,
    half: bool = False,
    attributes: dict[str, str] | None = None,
) -> None:
    """Writes a ZIP-compressed scanline EXR, row 0 at the top.

    Args:
      path: where; written under another name first, so that a reader never sees half a file.
      image: 1 (Y), 3 (RGB) or 4 (RGBA) channels.
      half: store 16-bit floats; values past 65504 are an error, since they would turn into infinity.
      attributes: strings for the header.
    Raises:
      UserError: the disk or the folder refuses.
      ValueError: not finite, or too large for half floats.
    """
    import OpenEXR

    channels = image.shape[2]
    stored = np.ascontiguousarray(image, dtype=np.float16 if half else np.float32) if _fits(image, half) else None
    if stored is None:
        raise ValueError(f"{path.name}: values up to {np.abs(image).max():g} do not fit, expected finite and within the format")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    name = {1: "Y", 3: "RGB", 4: "RGBA"}[channels]
    with written_whole(path) as temporary:
        file = OpenEXR.File(header, {name: stored[..., 0].copy() if channels == 1 else stored})
        try:
            file.write(str(temporary))
        except RuntimeError as error:  # what a full disk is to OpenEXR
            raise OSError(str(error).rstrip(".").rsplit(". ", 1)[-1]) from None
        try:
            read_exr(temporary)  # OpenEXR keeps silent when its last buffer, up to 8 KB, does not fit on the disk
        except UserError:
            raise OSError("only a part of it fitted") from None


def read_exr(path: Path) -> tuple[Float[np.ndarray, "height width channels"], dict[str, str]]:
    """Reads an EXR as float32 with row 0 at the top, and its string attributes.

    Raises:
      UserError: missing, truncated or not an EXR.
    """
    import OpenEXR

    if not path.is_file():
        raise UserError(f"{path}: got no file, expected an EXR image; bake again or mend the path")
    try:
        with OpenEXR.File(str(path)) as file:
            channels = file.channels()
            names = ", ".join(channels)  # closing empties the table
            header = {key: value for key, value in file.header().items() if isinstance(value, str)}
            for name in ("RGBA", "RGB", "Y"):
                if name in channels:
                    pixels = np.array(channels[name].pixels, np.float32)
                    return pixels if pixels.ndim == 3 else pixels[..., None], header
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"{path}: not a whole EXR image ({str(error).splitlines()[0]}); delete it and bake again, or copy it again"
        ) from None
    raise UserError(f"{path}: got channels {names}, expected RGB, RGBA or Y")


@dataclass(frozen=True, eq=False)
class Channels:
    """All channels of an EXR, of all its parts.

    Attributes:
      planes: by full name, such as "R" or "ViewLayer.DiffDir.R"; row 0 at the top.
      attributes: strings of the header.
      chromaticities: x and y of red, green, blue and white, where the file tells them.
    """

    planes: dict[str, Float32[np.ndarray, "height width"]]
    attributes: dict[str, str]
    chromaticities: tuple[float, ...] | None


def read_channels(path: Path) -> Channels:
    """Reads an EXR that somebody else wrote: any channels, any number of parts.

    Raises:
      UserError: missing, damaged, cropped, or with channels of several sizes.
    """
    import OpenEXR

    if not path.is_file():
        raise UserError(f"{path}: got no file, expected an EXR image; check the path")
    planes: dict[str, np.ndarray] = {}
    header: dict[str, Any] = {}
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            for part in file.parts:
                header = {**part.header, **header}
                for name, channel in part.channels.items():
                    full = name if name not in planes else f"{part.name()}.{name}"
                    planes[full] = np.array(channel.pixels, np.float32)
    except Exception as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path}: not a whole EXR image ({what}); write it or copy it again") from None
    data, display = (np.ravel(header[key]).tolist() for key in ("dataWindow", "displayWindow"))
    if data != display:
        raise UserError(f"{path}: got pixels {data} of a picture {display}, expected all of it; save it without cropping")
    if len({plane.shape for plane in planes.values()}) != 1:
        raise UserError(f"{path}: got channels of several sizes, expected one; save it without subsampling")
    colours = header.get("chromaticities")
    return Channels(
        planes,
        {key: value for key, value in header.items() if isinstance(value, str)},
        None if colours is None else tuple(float(value) for value in colours),
    )


def exposure_for(peak: float) -> int:
    """Power of two that brings `peak` safely into half range: stored = value * 2**-exposure."""
    return 0 if not 0 < peak < np.inf else int(np.ceil(np.log2(peak)))


def _fits(image: np.ndarray, half: bool) -> bool:
    return bool(np.isfinite(image).all() and np.abs(image).max(initial=0) <= (HALF_MAX if half else np.finfo(np.float32).max))
