"""BC6H blocks back to half floats, as graphics hardware reads them: what an engine will see is measured here.

A block is 16 bytes for 4 x 4 texels. Its mode says how many regions the texels fall into, with how many bits the end points of
each region's line of colours are kept, and where in the block each bit lies; then each texel has an index along its line.
Only the unsigned variant. Blocks of one mode are decoded together.

Reference: Khronos Data Format Specification 1.3, section "BC6H"; `BC6H_UF16` of Direct3D 11.
"""

import re
from dataclasses import dataclass

import numpy as np

from ddprt.axes import Int

BLOCK = 4  # texels along a side
BYTES = 16

# Where the bits lie that follow the mode's own. Colours r, g and b of end points w and x of the first region, y and z of the
# second; "high:low" is a run that begins with its lowest bit, "low<high" one that begins with its highest.
_LAYOUTS = {
    0b00: "gy4 by4 bz4 rw9:0 gw9:0 bw9:0 rx4:0 gz4 gy3:0 gx4:0 bz0 gz3:0 bx4:0 bz1 by3:0 ry4:0 bz2 rz4:0 bz3",
    0b01: "gy5 gz4 gz5 rw6:0 bz0 bz1 by4 gw6:0 by5 bz2 gy4 bw6:0 bz3 bz5 bz4 rx5:0 gy3:0 gx5:0 gz3:0 bx5:0 by3:0 ry5:0 rz5:0",
    0b00010: "rw9:0 gw9:0 bw9:0 rx4:0 rw10 gy3:0 gx3:0 gw10 bz0 gz3:0 bx3:0 bw10 bz1 by3:0 ry4:0 bz2 rz4:0 bz3",
    0b00110: "rw9:0 gw9:0 bw9:0 rx3:0 rw10 gz4 gy3:0 gx4:0 gw10 gz3:0 bx3:0 bw10 bz1 by3:0 ry3:0 bz0 bz2 rz3:0 gy4 bz3",
    0b01010: "rw9:0 gw9:0 bw9:0 rx3:0 rw10 by4 gy3:0 gx3:0 gw10 bz0 gz3:0 bx4:0 bw10 by3:0 ry3:0 bz1 bz2 rz3:0 bz4 bz3",
    0b01110: "rw8:0 by4 gw8:0 gy4 bw8:0 bz4 rx4:0 gz4 gy3:0 gx4:0 bz0 gz3:0 bx4:0 bz1 by3:0 ry4:0 bz2 rz4:0 bz3",
    0b10010: "rw7:0 gz4 by4 gw7:0 bz2 gy4 bw7:0 bz3 bz4 rx5:0 gy3:0 gx4:0 bz0 gz3:0 bx4:0 bz1 by3:0 ry5:0 rz5:0",
    0b10110: "rw7:0 bz0 by4 gw7:0 gy5 gy4 bw7:0 gz5 bz4 rx4:0 gz4 gy3:0 gx5:0 gz3:0 bx4:0 bz1 by3:0 ry4:0 bz2 rz4:0 bz3",
    0b11010: "rw7:0 bz1 by4 gw7:0 by5 gy4 bw7:0 bz5 bz4 rx4:0 gz4 gy3:0 gx4:0 bz0 gz3:0 bx5:0 by3:0 ry4:0 bz2 rz4:0 bz3",
    0b11110: "rw5:0 gz4 bz0 bz1 by4 gw5:0 gy5 by5 bz2 gy4 bw5:0 gz5 bz3 bz5 bz4 rx5:0 gy3:0 gx5:0 gz3:0 bx5:0 by3:0 ry5:0 "
    "rz5:0",
    0b00011: "rw9:0 gw9:0 bw9:0 rx9:0 gx9:0 bx9:0",
    0b00111: "rw9:0 gw9:0 bw9:0 rx8:0 rw10 gx8:0 gw10 bx8:0 bw10",
    0b01011: "rw9:0 gw9:0 bw9:0 rx7:0 rw10<11 gx7:0 gw10<11 bx7:0 bw10<11",
    0b01111: "rw9:0 gw9:0 bw9:0 rx3:0 rw10<15 gx3:0 gw10<15 bx3:0 bw10<15",
}
_PLAIN = (0b11110, 0b00011)  # modes whose end points are not differences to the first

# For each of the 32 shapes: texel i lies in the second region where bit i is set, and the texel whose index there lacks a bit.
_SHAPES = (
    "cccc8888eeeeecc8c880feecfec8ec80c800ffecfe80e800ffe8ff00fff0f000"
    "f710008e710008ce008c731031008cce088c31106666366c17e80ff0718e399c"
)
_SECOND = np.array([[int(_SHAPES[at : at + 4], 16) >> texel & 1 for texel in range(16)] for at in range(0, len(_SHAPES), 4)])
_ANCHOR = np.array([15] * 17 + [2, 8, 2, 2, 8, 8, 15, 2, 8, 2, 2, 8, 8, 2, 2])
_WEIGHTS = {
    3: np.array([0, 9, 18, 27, 37, 46, 55, 64]),
    4: np.array([0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64]),
}


@dataclass(frozen=True)
class _Mode:
    """One way to lay a block out.

    Attributes:
      places: (end point 0 to 3, colour 0 to 2, bit of it) of each bit of the block after the mode's own.
      skipped: bits of the mode's own.
      bits: of each end point and colour, (4, 3).
      regions: 1 or 2.
      relative: whether end points but the first are differences to it.
    """

    places: tuple[tuple[int, int, int], ...]
    skipped: int
    bits: Int[np.ndarray, "4 3"]
    regions: int
    relative: bool


def decode_bc6h(blocks: bytes, height: int, width: int) -> np.ndarray:
    """Unsigned BC6H.

    Args:
      blocks: row by row from the top, 16 bytes each.
      height, width: multiples of 4.
    Returns:
      (height, width, 3) float32; blocks of reserved modes are black, as hardware has them.
    Raises:
      ValueError: another number of bytes than the image has blocks.
    """
    rows, columns = height // BLOCK, width // BLOCK
    if len(blocks) != rows * columns * BYTES or height % BLOCK or width % BLOCK:
        raise ValueError(f"got {len(blocks)} bytes, expected those of {height}x{width} texels in blocks of 4x4")
    data = np.frombuffer(blocks, np.uint8).reshape(-1, BYTES)
    bits = np.unpackbits(data, axis=1, bitorder="little").astype(np.int64)
    short = data[:, 0] & 0b11
    which = np.where(short < 2, short, data[:, 0] & 0b11111)
    halves = np.zeros((len(data), 16, 3), np.int64)
    for number, mode in _MODES.items():
        found = np.flatnonzero(which == number)
        if len(found):
            halves[found] = _decoded(bits[found], mode)
    texels = halves.astype(np.uint16).view(np.float16).astype(np.float32)
    return texels.reshape(rows, columns, BLOCK, BLOCK, 3).swapaxes(1, 2).reshape(height, width, 3)


def _decoded(bits: np.ndarray, mode: _Mode) -> np.ndarray:
    """(blocks, 16, 3) bits of half floats."""
    ends = np.zeros((len(bits), 4, 3), np.int64)
    for at, (end, colour, bit) in enumerate(mode.places, mode.skipped):
        ends[:, end, colour] |= bits[:, at] << bit
    if mode.relative:
        sign = 1 << (mode.bits[1:] - 1)
        ends[:, 1:] = (ends[:, 1:] ^ sign) - sign + ends[:, :1]
        ends &= (1 << mode.bits[0]) - 1
    size = mode.bits[0]  # what is plain has the same number for all end points
    wide = np.where(ends == 0, 0, np.where(ends == (1 << size) - 1, 0xFFFF, ((ends << 16) + 0x8000) >> size))
    wide = np.where(size >= 15, ends, wide)

    at, index_bits = (82, 3) if mode.regions == 2 else (65, 4)
    shape = bits[:, 77:82] @ (1 << np.arange(5)) if mode.regions == 2 else np.zeros(len(bits), np.int64)
    second = _SECOND[shape] if mode.regions == 2 else np.zeros((len(bits), 16), np.int64)
    anchor = np.zeros((len(bits), 16), bool)
    anchor[:, 0] = True
    if mode.regions == 2:
        anchor[np.arange(len(bits)), _ANCHOR[shape]] = True
    length = index_bits - anchor
    start = at + np.cumsum(length, axis=1) - length
    index = sum(np.where(k < length, _bit(bits, start + k), 0) << k for k in range(index_bits))
    weight = _WEIGHTS[index_bits][index][..., None]
    block = np.arange(len(bits))[:, None]
    low, high = wide[block, 2 * second], wide[block, 2 * second + 1]
    return (low * (64 - weight) + high * weight + 32 >> 6) * 31 >> 6


def _bit(bits: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The bit of each block at each of its places; past the end of the block there is none."""
    return np.take_along_axis(bits, np.minimum(at, bits.shape[1] - 1), axis=1)


def _mode(number: int, layout: str) -> _Mode:
    places: list[tuple[int, int, int]] = []
    for colour, end, first, way, last in re.findall(r"([rgb])([wxyz])(\d+)(?:([:<])(\d+))?", layout):
        a, b = int(first), int(last or first)
        run = range(b, a - 1, -1) if way == "<" else range(b, a + 1)
        places += [("wxyz".index(end), "rgb".index(colour), bit) for bit in run]
    bits = np.zeros((4, 3), np.int64)
    for end, colour, bit in places:
        bits[end, colour] = max(bits[end, colour], bit + 1)
    return _Mode(tuple(places), 2 if number < 2 else 5, bits, 2 if "y" in layout else 1, number not in _PLAIN)


_MODES = {number: _mode(number, layout) for number, layout in _LAYOUTS.items()}
