"""Charts made to agree where they meet: least squares on the texels along seams.

A smooth surface that was cut to be unwrapped lies in two places of the atlas, and the two were filled apart from each other:
bilinear filtering then shows a line along the cut. Following Iwanicki ("Lighting Technology of The Last of Us", SIGGRAPH
2013) and Sylvan ("Fixing lightmap seams", 2016), the two filtered values are asked to be equal at many places along the cut,
and the texels to stay where they were:

    minimise  sum over samples of length (D x)²  +  PULL * sum over texels of (x - given)²

D takes the filtered value of one side from that of the other. The answer is linear in what was given, so stitching the bases
is the same as stitching every relit map. It is found as a correction, given - (D' L D + PULL)^-1 D' L D given: where both
sides agree already, nothing moves.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, diags, identity
from scipy.sparse.linalg import splu

from ddprt.axes import Bool, Float, Float64, Int, Int64
from ddprt.scene.winding import welded

CREASE_DEG = 30.0
"""Edges bent by more than this are creases: light really jumps there, and they are left alone."""

PULL = 0.01
"""Weight of the given values, per texel, against one texel's length of seam; experiments/seams.py tries others."""

_SAMPLES = 4  # per texel of an edge's length: bilinear filtering is quadratic between texel centres at most
_APART = 1e-3  # texels; charts that share an edge share its corners exactly


@dataclass(frozen=True, eq=False)
class Seams:
    """Places where one point of the surface is two places of the atlas.

    Attributes:
      edges: how many mesh edges are cut, and smooth.
      texel: row * width + column of the four texels that are filtered on either side.
      weight: of these texels; the second side's are negative, so that a constant image gives 0.
      length: of the piece of seam that each sample stands for, in texels.
    """

    edges: int
    texel: Int64[np.ndarray, "samples 8"]
    weight: Float64[np.ndarray, "samples 8"]
    length: Float64[np.ndarray, " samples"]


def find_seams(
    corners: Float[np.ndarray, "triangles 3 3"],
    uv: Float[np.ndarray, "triangles 3 2"],
    known: Bool[np.ndarray, "height width"],
    *,
    crease_deg: float = CREASE_DEG,
) -> Seams:
    """Samples the edges that are whole on the surface but cut on the atlas.

    An edge counts where two triangles share both corners (to rounding), run along it in opposite directions, bend by at most
    `crease_deg`, and lie apart on the atlas. Edges that meet only in part are not found.

    Args:
      corners: metres.
      uv: of these corners in the unit square, origin top-left.
      known: texels that hold something, charts and gutter; samples that would filter others are dropped.
      crease_deg: largest angle between the geometric normals.
    """
    height, width = known.shape
    texels = uv.astype(np.float64) * [width, height]
    here, there = _cut_edges(corners.astype(np.float64), texels, crease_deg)
    length = np.maximum(*(np.linalg.norm(side[:, 1] - side[:, 0], axis=1) for side in (here, there)))
    count = np.ceil(_SAMPLES * length).astype(np.int64)
    edge = np.repeat(np.arange(len(count)), count)
    along = ((np.arange(len(edge)) - (np.cumsum(count) - count)[edge] + 0.5) / count[edge])[:, None]
    sides = [_bilinear(side[edge, 0] + along * (side[edge, 1] - side[edge, 0]), width, height) for side in (here, there)]
    texel = np.concatenate([side[0] for side in sides], 1)
    weight = np.concatenate([sides[0][1], -sides[1][1]], 1)
    kept = (known.ravel()[texel] | (weight == 0)).all(1)
    return Seams(len(count), texel[kept], weight[kept], (length / count)[edge][kept])


@dataclass(frozen=True, eq=False)
class Stitcher:
    """The least squares of one atlas, factored once and applied to any number of images.

    Attributes:
      seams: from `find_seams`.
      pull: weight of the given values, above 0.
    """

    seams: Seams
    pull: float = PULL

    def stitch(self, image: Float[np.ndarray, "height width channels"]) -> Float[np.ndarray, "height width channels"]:
        """The image with texels along seams moved so that both sides filter to the same; linear, constants stay."""
        stitched = image.copy()
        if len(self.texels):
            flat = stitched.reshape(-1, image.shape[2])
            given = flat[self.texels].astype(np.float64)
            pushed = self._difference.T @ (self.seams.length[:, None] * (self._difference @ given))
            flat[self.texels] = given - self._factored.solve(pushed)
        return stitched

    def mismatch(self, image: Float[np.ndarray, "height width channels"]) -> Float64[np.ndarray, " channels"]:
        """Mean difference between the two sides over the length of all seams, in the image's unit; 0 without seams."""
        if not len(self.texels):
            return np.zeros(image.shape[2])
        differences = self._difference @ image.reshape(-1, image.shape[2])[self.texels].astype(np.float64)
        return np.average(np.abs(differences), axis=0, weights=self.seams.length)

    @cached_property
    def texels(self) -> Int[np.ndarray, " texels"]:
        """Those that take part: row * width + column, rising."""
        return np.unique(self.seams.texel[self.seams.weight != 0])

    @cached_property
    def _difference(self) -> csr_matrix:
        """D over `texels`."""
        sample, corner = np.nonzero(self.seams.weight)
        column = np.searchsorted(self.texels, self.seams.texel[sample, corner])
        return csr_matrix((self.seams.weight[sample, corner], (sample, column)), (len(self.seams.length), len(self.texels)))

    @cached_property
    def _factored(self) -> Any:
        normal = self._difference.T @ diags(self.seams.length) @ self._difference + self.pull * identity(len(self.texels))
        symmetric = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        return splu(normal.tocsc(), **symmetric)


def _cut_edges(corners: np.ndarray, texels: np.ndarray, crease_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of every smooth edge that is cut, (edges, 2, 2) texels: as one triangle has it, and as the other does."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    u, v = np.moveaxis(texels[:, 1:] - texels[:, :1], 1, 0)
    drawn = np.repeat(u[:, 0] * v[:, 1] != u[:, 1] * v[:, 0], 3)  # what has no area on the atlas is never looked up
    vertex = welded(corners.reshape(-1, 3)).reshape(-1, 3).astype(np.int64)
    start, end = vertex.ravel(), np.roll(vertex, -1, 1).ravel()
    half = np.stack([texels, np.roll(texels, -1, 1)], 2).reshape(-1, 2, 2)
    rising, falling = np.flatnonzero(drawn & (start < end)), np.flatnonzero(drawn & (start > end))
    # Each edge has one name, whichever way a triangle runs along it: low vertex, then high vertex.
    count = len(corners) * 3
    names, others = start[rising] * count + end[rising], end[falling] * count + start[falling]
    falling, others = falling[np.argsort(others, kind="stable")], np.sort(others)
    first, last = np.searchsorted(others, names, "left"), np.searchsorted(others, names, "right")
    pair = np.repeat(np.arange(len(rising)), last - first)
    one = rising[pair]
    other = falling[first[pair] + np.arange(len(pair)) - (np.cumsum(last - first) - (last - first))[pair]]
    here, there = half[one], half[other, ::-1]
    smooth = np.einsum("ed,ed->e", normal[one // 3], normal[other // 3]) >= np.cos(np.radians(crease_deg))
    cut = smooth & (np.abs(here - there).max((1, 2), initial=0) > _APART)
    return here[cut], there[cut]


def _bilinear(place: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4) texels about each place and their weights: centres at half-integers, borders repeated."""
    corner = np.floor(place - 0.5).astype(np.int64)
    fx, fy = (place - 0.5 - corner).T
    column = np.clip(corner[:, :1] + [0, 1, 0, 1], 0, width - 1)
    row = np.clip(corner[:, 1:] + [0, 0, 1, 1], 0, height - 1)
    return row * width + column, np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
