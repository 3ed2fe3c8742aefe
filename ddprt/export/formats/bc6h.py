"""BC6H: a byte per texel for three maps, in blocks that the GPU reads as they are, as DDS or KTX2.

The encoder knows positive light only, and bases have signs: every map is moved to where half floats lie evenly. Between 1 and 2
their steps are equal, so that lines between two end points, which a block draws through the bits of half floats, are lines of
values; experiments/texture_formats.py tries other ranges.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from ddprt.errors import UserError
from ddprt.export.formats.bc6h_decode import BLOCK, BYTES, decode_bc6h
from ddprt.export.formats.format import Format, Maps, Stored, layered, ranges, unlayered
from ddprt.export.formats.ktx2 import BC6H as TEXEL
from ddprt.export.formats.ktx2 import read_ktx2, write_ktx2
from ddprt.files import written_whole

DDS = "basis-bc6h.dds"
KTX2 = "basis-bc6h.ktx2"
LAYER = 3
RANGE = 1.0, 2.0
_PROFILE: Final = "slow"  # "veryslow" gains a thousandth
_HEADER = 148  # bytes of a DDS header with its DX10 part


def encode_bc6h(layers: np.ndarray) -> bytes:
    """Blocks of (layers, height, width, 3) positive numbers, layer after layer.

    Raises:
      UserError: the encoder is not installed.
    """
    try:
        from ispc_texcomp import BC6HEncSettings, RGBASurface, compress_blocks_bc6h
    except ImportError as error:
        raise UserError(f'export.formats: got {error}, expected ispc-texcomp for BC6H; pip install "ddprt[textures]"') from None
    settings = BC6HEncSettings.from_profile(_PROFILE)
    count, height, width, _ = layers.shape
    texels = np.ones((count, height, width, 4), "<f2")
    texels[..., :3] = layers
    return b"".join(compress_blocks_bc6h(RGBASurface(layer.tobytes(), width, height, 8 * width), settings) for layer in texels)


def _fits(height: int, width: int) -> None:
    if height % BLOCK or width % BLOCK:
        raise UserError(
            f"export.formats: got a lightmap of {width}x{height} texels, expected multiples of {BLOCK} for BC6H; set "
            f"atlas.resolution to {-(-max(height, width) // BLOCK) * BLOCK} and bake again, or take another format"
        )
    encode_bc6h(np.ones((0, BLOCK, BLOCK, 3)))


def write_dds(path: Path, height: int, width: int, layers: int, data: bytes) -> None:
    """An array of unsigned BC6H layers."""
    flags = 0x1 | 0x2 | 0x4 | 0x1000 | 0x80000  # caps, height, width, pixel format, linear size
    head = struct.pack("<7I44x", 124, flags, height, width, len(data) // max(layers, 1), 1, 1)
    pixel = struct.pack("<II4s20x", 32, 0x4, b"DX10")
    more = struct.pack("<I16x", 0x1000)  # a texture
    dx10 = struct.pack("<5I", 95, 3, 0, layers, 0)  # BC6H_UF16, two dimensions, layers
    with written_whole(path) as temporary:
        temporary.write_bytes(b"DDS " + head + pixel + more + dx10 + data)


def _writer(name: str, told: str) -> Callable[[Maps, Path], Stored]:
    def write(maps: Maps, folder: Path) -> Stored:
        scale, bias, t = ranges(maps, *RANGE)
        layers = layered(t, LAYER)
        data = encode_bc6h(layers)
        count, height, width, _ = layers.shape
        if name == DDS:
            write_dds(folder / name, height, width, count, data)
        else:
            write_ktx2(folder / name, TEXEL, height, width, count, data)
        more: dict[str, Any] = {"texel": told, "layer_bytes": len(data) // count}
        return Stored((name,), count, len(data), scale, bias, more)

    return write


def _reader(name: str) -> Callable[[Maps, Path], np.ndarray]:
    def read(maps: Maps, folder: Path) -> np.ndarray:
        height, width = maps.known.shape
        data = (folder / name).read_bytes()[_HEADER:] if name == DDS else read_ktx2(folder / name, TEXEL)[3]
        size = height * width // BLOCK**2 * BYTES
        layers = [decode_bc6h(data[at : at + size], height, width) for at in range(0, len(data), size)]
        return unlayered(np.stack(layers), maps)

    return read


_WHAT = "BC6H blocks, a byte a texel for three maps, as {} array"
BC6H_DDS = Format(
    _WHAT.format("a DDS"), (DDS,), LAYER, _writer(DDS, "DXGI_FORMAT_BC6H_UF16, an array of layers"), _reader(DDS), _fits
)
BC6H_KTX2 = Format(
    _WHAT.format("a KTX2"),
    (KTX2,),
    LAYER,
    _writer(KTX2, "VK_FORMAT_BC6H_UFLOAT_BLOCK, an array of layers"),
    _reader(KTX2),
    _fits,
)
