"""Triangles and vertex colours of a glTF primitive, whatever way they are stored."""

from typing import Any

import numpy as np

from ddprt.axes import Float64, Int64
from ddprt.scene.accessors import Container

TRIANGLES, STRIP, FAN = 4, 5, 6
"""Modes of a primitive that have triangles; those below are points and lines."""


def triangles_of(file: Container, primitive: Any, count: int) -> tuple[Int64[np.ndarray, "triangles 3"], int]:
    """Corner indices of a primitive's triangles, each in its winding; strips and fans are taken apart.

    Args:
      file: it is from.
      primitive: of mode `TRIANGLES`, `STRIP` or `FAN`.
      count: of its vertices.
    Returns:
      The triangles, and how many corners are left over after the last.
    Raises:
      UserError: another mode, or an index out of range.
    """
    mode = TRIANGLES if primitive.mode is None else primitive.mode
    if mode not in (TRIANGLES, STRIP, FAN):
        raise file.fault(f"got a primitive of mode {mode}, expected 0 to 6; export it again")
    index = np.arange(count) if primitive.indices is None else file.accessor(primitive.indices, 1)[:, 0].astype(np.int64)
    if index.size and not 0 <= index.min() <= index.max() < count:
        beyond = index[(index < 0) | (index >= count)][0]
        raise file.fault(f"got vertex index {beyond}, expected 0 to {count - 1}; export it again")
    if mode == TRIANGLES:
        whole = len(index) // 3 * 3
        return index[:whole].reshape(-1, 3), len(index) - whole
    if len(index) < 3:
        return np.zeros((0, 3), np.int64), len(index)
    if mode == FAN:
        return np.stack([index[1:-1], index[2:], np.broadcast_to(index[0], len(index) - 2)], 1), 0
    triangles = np.stack([index[:-2], index[1:-1], index[2:]], 1)
    triangles[1::2] = triangles[1::2, [0, 2, 1]]  # every other one runs the other way round
    return triangles, 0


def colours_of(file: Container, primitive: Any) -> Float64[np.ndarray, "vertices channels"] | None:
    """Linear factors on the base colour of each vertex, with opacity as a fourth where the file has one; or None.

    Raises:
      UserError: neither three nor four numbers a vertex.
    """
    number = getattr(primitive.attributes, "COLOR_0", None)
    if number is None:
        return None
    width = file.width(number)
    if width not in (3, 4):
        kind = file.entry("accessors", number).type
        raise file.fault(f"got vertex colours (accessor {number}) of {kind}, expected VEC3 or VEC4; export it again")
    return file.accessor(number, width)
