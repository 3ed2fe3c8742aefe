"""KTX2 with one array of layers and one level, not supercompressed: uploaded to the GPU as it lies in the file.

Reference: Khronos Texture 2.0; the descriptor of texels is that of the Khronos Data Format Specification 1.3.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddprt.errors import UserError
from ddprt.export.formats.format import Format, Maps, Stored, unlayered
from ddprt.export.formats.raw import LAYER, halves
from ddprt.files import written_whole

NAME = "basis.ktx2"
_MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
_HEADER = 80  # bytes, magic and index in them
_LEVEL = 24
_FLOAT, _SIGNED = 0x80, 0x40  # qualifiers of a channel
_ONE = 0x3F800000  # 1.0


@dataclass(frozen=True)
class Texel:
    """What Vulkan and the descriptor call a kind of texel.

    Attributes:
      vulkan: VkFormat.
      model: colour model of the descriptor.
      type_size: bytes of a number; 1 for blocks.
      block: texels along a side of what is kept together.
      bytes: of one such block.
      samples: (first bit, bits, channel and qualifiers, least value) of each channel.
    """

    vulkan: int
    model: int
    type_size: int
    block: int
    bytes: int
    samples: tuple[tuple[int, int, int, int], ...]


RGBA16F = Texel(
    97, 1, 2, 1, 8, tuple((16 * at, 16, name | _FLOAT | _SIGNED, 0xBF800000) for at, name in enumerate((0, 1, 2, 15)))
)
BC6H = Texel(143, 133, 1, 4, 16, ((0, 128, _FLOAT, 0),))


def write_ktx2(path: Path, texel: Texel, height: int, width: int, layers: int, data: bytes) -> None:
    """Writes an array texture: layers one after another, each from the top row down."""
    descriptor = _descriptor(texel)
    pairs = b"".join(_pair(key, value) for key, value in (("KTXorientation", "rd"), ("KTXwriter", "ddprt")))
    start = _HEADER + _LEVEL
    end = start + len(descriptor) + len(pairs)
    first = -(-end // 16) * 16
    index = struct.pack("<IIIIQQ", start, len(descriptor), start + len(descriptor), len(pairs), 0, 0)
    header = struct.pack("<9I", texel.vulkan, texel.type_size, width, height, 0, layers, 1, 1, 0)
    level = struct.pack("<QQQ", first, len(data), len(data))
    with written_whole(path) as temporary:
        temporary.write_bytes(_MAGIC + header + index + level + descriptor + pairs + bytes(first - end) + data)


def read_ktx2(path: Path, texel: Texel) -> tuple[int, int, int, bytes]:
    """Height, width, layers and data of what `write_ktx2` wrote.

    Raises:
      UserError: it is anything else.
    """
    data = path.read_bytes()
    vulkan, _, width, height, _, layers = struct.unpack_from("<6I", data, 12) if data.startswith(_MAGIC) else (0,) * 6
    first, length = struct.unpack_from("<QQ", data, _HEADER) if vulkan else (0, 0)
    if vulkan != texel.vulkan or len(data) != first + length:
        raise UserError(f"{path}: got another kind of KTX2, expected one that ddprt wrote; export again")
    return height, width, layers, data[first:]


def _descriptor(texel: Texel) -> bytes:
    """Linear light, BT.709 primaries, straight alpha."""
    side = texel.block - 1
    head = struct.pack("<BBBB4B8B", texel.model, 1, 1, 0, side, side, 0, 0, texel.bytes, *[0] * 7)
    samples = b"".join(
        struct.pack("<HBB4BII", at, bits - 1, kind, 0, 0, 0, 0, least, _ONE) for at, bits, kind, least in texel.samples
    )
    size = 8 + len(head) + len(samples)
    return struct.pack("<IIHH", 4 + size, 0, 2, size) + head + samples


def _pair(key: str, value: str) -> bytes:
    body = key.encode() + b"\0" + value.encode() + b"\0"
    return struct.pack("<I", len(body)) + body + bytes(-len(body) % 4)


def _write(maps: Maps, folder: Path) -> Stored:
    scale, bias, layers = halves(maps)
    count, height, width, _ = layers.shape
    write_ktx2(folder / NAME, RGBA16F, height, width, count, layers.tobytes())
    return Stored((NAME,), count, layers.nbytes, scale, bias, {"texel": "VK_FORMAT_R16G16B16A16_SFLOAT, an array of layers"})


def _read(maps: Maps, folder: Path) -> np.ndarray:
    height, width, count, data = read_ktx2(folder / NAME, RGBA16F)
    layers = np.frombuffer(data, "<f2").reshape(count, height, width, LAYER)
    return unlayered(layers.astype(np.float32), maps)


KTX2 = Format("half floats in one KTX2 array texture", (NAME,), LAYER, _write, _read)
