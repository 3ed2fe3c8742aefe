"""PNG of 8 bits a channel: a quarter of floats, read by everything, with a scale and a bias for each map.

Written and read here, by the standard library: image libraries multiply colours by alpha, or bring them into sRGB, more easily
than one would think. A file has no gamma and no profile; the numbers are what they are.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from ddprt.errors import UserError
from ddprt.export.formats.format import Format, Maps, Stored, layered, ranges, unlayered
from ddprt.files import written_whole

LAYER = 4
_MAGIC = b"\x89PNG\r\n\x1a\n"
_KINDS = {3: 2, 4: 6}  # channels: colour type

IMPORT = (
    "t = byte / 255. Linear data in all channels: import without sRGB, mip levels by plain averages, no block compression. "
    "Alpha is a map like the others: straight, not premultiplied, no colours bled into where it is 0; in a browser "
    'createImageBitmap(blob, {premultiplyAlpha: "none", colorSpaceConversion: "none"})'
)


def png_bytes(image: np.ndarray) -> bytes:
    """The file of (height, width, 3 or 4) uint8, row 0 at the top."""
    height, width, channels = image.shape
    header = struct.pack(">IIBBBBB", width, height, 8, _KINDS[channels], 0, 0, 0)
    rows = image.reshape(height, width * channels)
    above = np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.concatenate([np.full((height, 1), 2, np.uint8), rows - above], 1)  # the Up filter: what a smooth map likes
    parts = [(b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes(), 9)), (b"IEND", b"")]
    data = [struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts]
    return _MAGIC + b"".join(data)


def write_png(path: Path, image: np.ndarray) -> None:
    """Writes (height, width, 3 or 4) uint8, row 0 at the top."""
    with written_whole(path) as temporary:
        temporary.write_bytes(png_bytes(image))


def read_png(path: Path) -> np.ndarray:
    """What `write_png` wrote.

    Raises:
      UserError: it is anything else.
    """
    data = path.read_bytes()
    width, height, depth, kind = struct.unpack_from(">IIBB", data, 16) if data.startswith(_MAGIC) else (0, 0, 0, 0)
    channels = {code: count for count, code in _KINDS.items()}.get(kind, 0)
    (length,) = struct.unpack_from(">I", data, 33) if channels and depth == 8 else (0,)
    rows = np.frombuffer(zlib.decompress(data[41 : 41 + length]) if length else b"", np.uint8)
    if rows.size == 0 or rows.size != height * (1 + width * channels) or (rows[:: 1 + width * channels] != 2).any():
        raise UserError(f"{path}: got another kind of PNG, expected one that ddprt wrote; export again")
    filtered = rows.reshape(height, -1)[:, 1:]
    return np.cumsum(filtered, axis=0, dtype=np.uint8).reshape(height, width, channels)


def _write(maps: Maps, folder: Path) -> Stored:
    scale, bias, t = ranges(maps, 0.0, 1.0)
    layers = np.rint(255 * layered(t, LAYER)).astype(np.uint8)
    names = tuple(f"basis_{index:02d}.png" for index in range(len(layers)))
    for name, layer in zip(names, layers, strict=True):
        write_png(folder / name, layer)
    return Stored(names, len(layers), layers[..., :1].size * 4, scale, bias, {"import": IMPORT})


def _read(maps: Maps, folder: Path) -> np.ndarray:
    count = len(layered(maps.values, LAYER))
    layers = np.stack([read_png(folder / f"basis_{index:02d}.png") for index in range(count)])
    return unlayered((layers / np.float32(255)).astype(np.float32), maps)


BYTES = Format("8-bit PNG", ("basis_*.png",), LAYER, _write, _read)
