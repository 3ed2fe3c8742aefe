"""Where skies come from: EXR and Radiance files, and a few made in code, so that a test or an example needs no file.

Skies in code are pictures, not models: none of them follows the physics of an atmosphere.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.catalogue import Catalogue
from ddprt.compiled import compiled
from ddprt.errors import UserError, nearest
from ddprt.scene.exr import read_exr

FILES = (".exr", ".hdr")
LARGEST = 1 << 14
"""Pixels per side: the tables of such a picture take 3 GB."""

SUN_HEIGHT_DEG, SUN_RADIUS_DEG = 40.0, 2.5
_BRIGHTEST = 1e30  # W/(m² sr), as for all lights: sums and squares still have room


def read_panorama(image: str) -> Float32[np.ndarray, "height width 3"]:
    """Linear radiance of a sky in W/(m² sr), row 0 at the top; any aspect is allowed, and 2:1 gives square pixels.

    Args:
      image: a key of `SKIES`, or an .exr or .hdr file. Alpha is dropped, a grey picture repeated over the channels.
    Raises:
      UserError: missing, damaged, too large, not finite, somewhere negative, or black.
    """
    if image in SKIES:
        return SKIES[image]()
    path = Path(image)
    if path.suffix.lower() == ".hdr":
        pixels = read_hdr(path)
    else:
        try:
            found = read_exr(path)[0]
        except UserError as error:  # which takes the file for one that was baked, and says to bake it again
            what = str(error).removeprefix(f"{path}: ").removeprefix("got ")
            raise _unusable(path, what.partition("; delete it")[0].partition(", expected")[0]) from None
        pixels = np.ascontiguousarray(np.repeat(found, 3, axis=2) if found.shape[2] == 1 else found[..., :3])
    height, width = pixels.shape[:2]
    if max(height, width) > LARGEST:
        raise UserError(f"{path}: got {width} x {height} pixels, expected at most {LARGEST} a side; make it smaller")
    for wrong, what, remedy in (
        (~np.isfinite(pixels), "a number that is not finite", "mend the image"),
        (pixels < 0, "a negative radiance", "clip the image at 0"),
        (pixels > _BRIGHTEST, f"a radiance above {_BRIGHTEST:g}", "darken the image, and use `scale`"),
    ):
        if wrong.any():
            row, column = np.argwhere(wrong.any(2))[0].tolist()
            value = pixels[row, column].tolist()
            raise UserError(
                f"{path}: got {what} in row {row}, column {column} ({value}), expected linear radiance, 0 or more; {remedy}"
            )
    if not pixels.any():
        raise UserError(f"{path}: got a black image, expected a sky that shines; leave the light out, or use another image")
    return pixels


def stamp(image: str) -> tuple[int, ...]:
    """What changes when a file does; nothing for a sky made in code.

    Raises:
      UserError: there is no such file.
    """
    if image in SKIES:
        return ()
    path = Path(image)
    if path.suffix.lower() not in FILES:
        known = ", ".join(f'"{name}"' for name in SKIES)
        raise UserError(
            f'environment image: got "{image}", expected a file that ends in {" or ".join(FILES)}, or one of {known}'
            f"{nearest(image, SKIES) or '; choose one'}"
        )
    try:
        found = path.stat()
    except OSError as error:
        raise _unusable(path, error.strerror or str(error)) from None
    return found.st_mtime_ns, found.st_size


def read_hdr(path: Path) -> Float32[np.ndarray, "height width 3"]:
    """Reads a Radiance picture (RGBE, flat or run-length encoded), row 0 at the top.

    Mantissas are read with + 0.5, the middle of what they stand for, as by Radiance's own code; readers that leave it out get
    a brightest channel that is darker by up to 0.4 %. Pixels are divided by all the header's EXPOSURE lines and, channel by
    channel, by all its COLORCORR lines, which tell what they were multiplied with.

    Raises:
      UserError: not such a picture, not readable, cut short, in another order than rows from the top, or of no valid exposure
        or colour correction.
    Reference: Ward, "Real Pixels", Graphics Gems II, 1991: (mantissa + 1/2) / 256 * 2^(exponent - 128), 0 where exponent is 0.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unusable(path, error.strerror or str(error)) from None
    head, _, rest = data.partition(b"\n\n")
    size, _, body = rest.partition(b"\n")
    words = size.split()
    if not head.startswith((b"#?RADIANCE", b"#?RGBE")) or b"32-bit_rle_rgbe" not in head:
        raise _unusable(path, "no Radiance RGBE header")
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X" or not (words[1] + words[3]).isdigit():
        shown = size.decode("ascii", "replace")[:40]
        raise UserError(f'{path}: got "{shown}", expected rows from the top ("-Y height +X width"); save it again')
    exposure = _factors(path, head, b"EXPOSURE", 1) * _factors(path, head, b"COLORCORR", 3)
    height, width = int(words[1]), int(words[3])
    if not 0 < height <= LARGEST or not 0 < width <= LARGEST:
        raise UserError(f"{path}: got {width} x {height} pixels, expected 1 to {LARGEST} a side; make it smaller")
    packed = np.zeros((height, 4, width), np.uint8)
    if not _unpacked(np.frombuffer(body, np.uint8), packed):
        raise _unusable(path, "not a whole Radiance image (its rows end early or overrun)")
    exponent = packed[:, 3, :, None].astype(np.int32)
    mantissa = packed[:, :3].swapaxes(1, 2).astype(np.float32)
    light = np.where(exponent > 0, np.ldexp(mantissa + np.float32(0.5), exponent - 136), np.float32(0))
    with np.errstate(over="ignore"):  # infinity is told with the pixel that it is in
        return np.ascontiguousarray(light.astype(np.float64) / exposure, np.float32)


def _factors(path: Path, head: bytes, key: bytes, count: int) -> Float64[np.ndarray, " count"]:
    """Product of a Radiance header's lines of a kind, each of so many numbers; 1 where there is none."""
    product = np.ones(count)
    for line in head.splitlines():
        if not line.startswith(key + b"="):
            continue
        shown = line.partition(b"=")[2].strip().decode("ascii", "replace")[:40]
        try:
            values = np.array(shown.split() or ["none"], np.float64)
        except ValueError:  # as for no number at all
            values = np.zeros(count)
        with np.errstate(over="ignore", under="ignore"):
            product = product * (values if len(values) == count else 0)
        if not ((product > 0) & np.isfinite(product) & (values.min() > 0)).all():
            what = "finite numbers" if count == 1 else f"{count} finite numbers each"
            raise UserError(f'{path}: got "{key.decode()}={shown}", expected {what} above 0; mend the header or save it again')
    return product


def _unusable(path: Path, what: str) -> UserError:
    """A file that is no picture of a sky."""
    return UserError(f"environment.image {path}: got {what}, expected an EXR or HDR picture; check the path or write it again")


def white() -> Float32[np.ndarray, "1 1 3"]:
    """Radiance 1 from everywhere: E = pi in the open."""
    return np.ones((1, 1, 3), np.float32)


def gradient() -> Float32[np.ndarray, "height width 3"]:
    """Radiance (1 + y) / 2 * (0.6, 0.8, 1): from nothing below to that colour overhead."""
    y = _rows(256)
    return ((1 + y)[:, None, None] / 2 * np.array([0.6, 0.8, 1.0])).astype(np.float32)


def sun_sky() -> Float32[np.ndarray, "height width 3"]:
    """A blue sky above dim ground, and a warm sun 40 degrees above the horizon, towards -z in the middle of the image.

    Above the horizon L = (0.80, 0.85, 0.90) + sqrt(y) * ((0.20, 0.40, 0.85) - (0.80, 0.85, 0.90)), below (0.12, 0.11, 0.10);
    the sun, a disc of 2.5 degrees' radius, adds L = 1500 * (1, 0.9, 0.75), which is 9 W/m² of red on a plane that faces it.
    """
    width = 1024
    y = _rows(width // 2)[:, None, None]
    horizon, zenith = np.array([0.80, 0.85, 0.90]), np.array([0.20, 0.40, 0.85])
    above = horizon + np.sqrt(np.maximum(y, 0)) * (zenith - horizon)
    light = np.broadcast_to(np.where(y > 0, above, [0.12, 0.11, 0.10]), (width // 2, width, 3)).copy()
    turn = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    height = np.deg2rad(SUN_HEIGHT_DEG)
    cosine = np.sqrt(1 - y[..., 0] ** 2) * np.cos(turn) * np.cos(height) + y[..., 0] * np.sin(height)
    light[cosine > np.cos(np.deg2rad(SUN_RADIUS_DEG))] += 1500 * np.array([1.0, 0.9, 0.75])
    return light.astype(np.float32)


SKIES: Catalogue[Callable[[], Float32[np.ndarray, "height width 3"]]] = Catalogue(
    "sky", {"white": white, "gradient": gradient, "sun-sky": sun_sky}
)


def _rows(height: int) -> np.ndarray:
    """Mean of y over each row, by solid angle."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return (edges[:-1] + edges[1:]) / 2


@compiled
def _unpacked(data: np.ndarray, packed: np.ndarray) -> bool:
    """Fills rows of (red, green, blue, exponent) lines; False where the data do not fit them."""
    height, _, width = packed.shape
    at = 0
    for row in range(height):
        if at + 4 > len(data):
            return False
        lines = data[at] == 2 and data[at + 1] == 2 and 256 * int(data[at + 2]) + int(data[at + 3]) == width
        if not lines or width < 8:
            if data[at] == 1 and data[at + 1] == 1 and data[at + 2] == 1:  # runs of whole pixels, of before 1991
                return False
            if at + 4 * width > len(data):
                return False
            for column in range(width):
                for channel in range(4):
                    packed[row, channel, column] = data[at + 4 * column + channel]
            at += 4 * width
            continue
        at += 4
        for channel in range(4):
            column = 0
            while column < width:
                if at + 1 >= len(data):
                    return False
                run = data[at] > 128
                count = int(data[at]) - (128 if run else 0)
                if count == 0 or column + count > width or (not run and at + count >= len(data)):
                    return False
                for step in range(count):
                    packed[row, channel, column + step] = data[at + 1 + (0 if run else step)]
                column += count
                at += 2 if run else 1 + count
    return True
