"""Small squares that texels are cut into: pieces of the surface in each, their corners, and how they hang together."""

from dataclasses import dataclass

import numpy as np

from ddprt.axes import Bool, Float32, Float64, Int, Int32
from ddprt.compiled import compiled

CUT = 5
"""Squares along a texel's side, and along a crossed square's; odd, so that the middle of a chart is never a rim."""
SQUARES = CUT**2
"""Smallest squares along a texel's side."""


@dataclass(frozen=True, eq=False)
class Cut:
    """Pieces of the surface, each in a square, which stands for what they are grouped by.

    Attributes:
      source: piece of the atlas that each is part of.
      square: which.
      area: m².
      corners: relative to the atlas' centre, metres.
    """

    source: Int[np.ndarray, " pieces"]
    square: Int[np.ndarray, " pieces"]
    area: Float64[np.ndarray, " pieces"]
    corners: Float32[np.ndarray, "pieces 3 3"]

    def some(self, chosen: np.ndarray, square: np.ndarray | None = None) -> "Cut":
        """Chosen pieces, in other squares if given."""
        square = self.square[chosen] if square is None else square
        return Cut(self.source[chosen], square, self.area[chosen], self.corners[chosen])

    def joined(self, other: "Cut") -> "Cut":
        """These pieces, then others."""
        return Cut(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in Cut.__dataclass_fields__))


def grown(image: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """With the neighbours to all four sides."""
    result = image.copy()
    result[1:] |= image[:-1]
    result[:-1] |= image[1:]
    result[:, 1:] |= image[:, :-1]
    result[:, :-1] |= image[:, 1:]
    return result


def as_images(values: np.ndarray, back: bool = False) -> np.ndarray:
    """Rows of 25 for each of 25 squares of a texel as 25 x 25 images, or back again."""
    if back:
        return values.reshape(-1, CUT, CUT, CUT, CUT).swapaxes(2, 3).reshape(-1, CUT**2)
    return values.reshape(-1, CUT, CUT, CUT, CUT).swapaxes(2, 3).reshape(-1, SQUARES, SQUARES)


def find_places(clear: Bool[np.ndarray, "texels down across"]) -> Int32[np.ndarray, "texels down across"]:
    """Numbers from 1 the sets of clear squares of one texel that touch side by side; 0 elsewhere."""
    from scipy.ndimage import label

    touching = np.zeros((3, 3, 3), int)
    touching[1, 1], touching[1, :, 1] = 1, 1
    return np.asarray(label(clear, touching)[0], np.int32)


@compiled
def find_corners(
    square: np.ndarray,
    corners: np.ndarray,
    triangle: np.ndarray,
    on_map: np.ndarray,
    normals: np.ndarray,
    lift: np.ndarray,
    ends: np.ndarray,
) -> None:
    """Both ends of both diagonals of each square: the corners that lie farthest that way on the map, lifted."""
    low, high = np.full((2, len(lift)), np.inf), np.full((2, len(lift)), -np.inf)
    for piece in range(len(square)):
        home, face = square[piece], triangle[piece]
        for corner in range(3):
            column, row = on_map[face, 0, 3], on_map[face, 1, 3]
            for axis in range(3):
                column += on_map[face, 0, axis] * corners[piece, corner, axis]
                row += on_map[face, 1, axis] * corners[piece, corner, axis]
            for diagonal in range(2):
                along = column + row if diagonal == 0 else column - row
                if along < low[diagonal, home]:
                    low[diagonal, home] = along
                    for axis in range(3):
                        ends[2 * diagonal, home, axis] = corners[piece, corner, axis] + lift[home] * normals[face, axis]
                if along > high[diagonal, home]:
                    high[diagonal, home] = along
                    for axis in range(3):
                        ends[2 * diagonal + 1, home, axis] = corners[piece, corner, axis] + lift[home] * normals[face, axis]
