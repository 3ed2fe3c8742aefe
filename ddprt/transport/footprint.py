"""How far a texel may borrow light from its neighbours: indirect light is smooth where nothing is near.

Ward's harmonic mean of the distances that a texel sees bounds how fast irradiance changes there with place, and the turn of
the normal how fast it changes on a curved surface. So texels of one chart share their rays within a small fraction of that
distance and a small turn; in corners and under edges it shrinks to nothing.
The weights reproduce linear functions, so that slopes and the rims of charts are kept. It is a linear operation, the same for
every lighting.

Reference: Ward, Rubinstein and Clear, "A Ray Tracing Solution for Diffuse Interreflection", SIGGRAPH 1988.
"""

from dataclasses import dataclass

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int32
from ddprt.compiled import compiled
from ddprt.scene.atlas import Atlas

_REACH = 2  # texels that a footprint may extend to each side
_TAPS = (2 * _REACH + 1) ** 2


@dataclass(frozen=True, eq=False)
class Footprints:
    """A weighted mean over each texel's neighbourhood.

    Attributes:
      weight: of the texels in the square around each, row by row; they sum to 1.
      slot: covered index at each texel of the atlas, with a margin of `_REACH` on every side, -1 where there is none.
      centre: index of each covered texel in the flattened `slot`.
    """

    weight: Float32[np.ndarray, "texels taps"]
    slot: Int32[np.ndarray, "rows columns"]
    centre: Int32[np.ndarray, " texels"]

    def pooled(self, values: Float32[np.ndarray, "texels channels"]) -> Float32[np.ndarray, "texels channels"]:
        """The mean over each footprint."""
        result = np.zeros_like(values)
        _pool(self.weight, self.slot, self.centre, values, result)
        return result

    def burden(self, area: Float64[np.ndarray, " texels"]) -> Float64[np.ndarray, " texels"]:
        """How much each texel's own variance counts in the area-weighted squared error after pooling."""
        result = np.zeros(len(area))
        _spread_squares(self.weight, self.slot, self.centre, area, result)
        return result


def find_footprints(atlas: Atlas, nearness: Float[np.ndarray, " texels"], share: float) -> Footprints:
    """Footprints from what texels see.

    Args:
      atlas: the texels.
      nearness: mean of 1 / distance over each texel's cosine-weighted rays, 1/m; infinitely far counts 0.
      share: standard deviation of a footprint as a share of 1 / nearness; 0 borrows nothing. A turn of the normal by an angle t
        counts as sqrt(1 - cos t) of it.
    """
    slot = np.pad(atlas.slot, _REACH, constant_values=-1)
    row, column = np.divmod(atlas.texel, atlas.resolution)
    centre = ((row + _REACH) * slot.shape[1] + column + _REACH).astype(np.int32)
    weight = np.zeros((atlas.count, _TAPS), np.float32)
    place = (atlas.position - atlas.centre).astype(np.float32)
    _weigh(
        slot,
        centre,
        place,
        atlas.geometric_normal.astype(np.float32),
        atlas.area,
        atlas.chart,
        np.asarray(nearness, np.float64),
        share,
        weight,
    )
    return Footprints(weight, slot, centre)


@compiled
def _weigh(
    slot: np.ndarray,
    centre: np.ndarray,
    place: np.ndarray,
    normal: np.ndarray,
    area: np.ndarray,
    chart: np.ndarray,
    nearness: np.ndarray,
    share: float,
    weight: np.ndarray,
) -> None:
    wide = slot.shape[1]
    flat = slot.reshape(-1)
    own = np.zeros(_TAPS)
    for texel in range(len(centre)):
        # Moments of the neighbours' offsets in texels: mass, first and second.
        mass, mx, my, mxx, mxy, myy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for tap in range(_TAPS):
            own[tap] = 0
            x, y = tap % (2 * _REACH + 1) - _REACH, tap // (2 * _REACH + 1) - _REACH
            other = flat[centre[texel] + y * wide + x]
            if other < 0 or chart[other] != chart[texel]:
                continue
            away, facing = 0.0, 0.0
            for axis in range(3):
                away += (place[other, axis] - place[texel, axis]) ** 2
                facing += normal[other, axis] * normal[texel, axis]
            near = max(nearness[other], nearness[texel])
            if other == texel:
                own[tap] = area[other]
            elif share > 0 and facing > 0.9:  # Ward's estimate of the error, in units of what is allowed; squares added
                own[tap] = area[other] * np.exp(-0.5 * (away * near * near + max(1 - facing, 0)) / share**2)
            mass += own[tap]
            mx += own[tap] * x
            my += own[tap] * y
            mxx += own[tap] * x * x
            mxy += own[tap] * x * y
            myy += own[tap] * y * y
        # A slope that cancels the first moments; a little of the mass keeps it finite where all neighbours lie on a line.
        mxx += 1e-3 * mass
        myy += 1e-3 * mass
        determinant = mxx * myy - mxy * mxy
        a, b = (mx * myy - my * mxy) / determinant, (my * mxx - mx * mxy) / determinant
        total = 0.0
        for tap in range(_TAPS):
            x, y = tap % (2 * _REACH + 1) - _REACH, tap // (2 * _REACH + 1) - _REACH
            own[tap] *= min(max(1 - a * x - b * y, 0.0), 3.0)
            total += own[tap]
        for tap in range(_TAPS):
            weight[texel, tap] = own[tap] / total


@compiled
def _pool(weight: np.ndarray, slot: np.ndarray, centre: np.ndarray, values: np.ndarray, result: np.ndarray) -> None:
    wide = slot.shape[1]
    flat = slot.reshape(-1)
    for texel in range(len(centre)):
        for tap in range(_TAPS):
            share = weight[texel, tap]
            if share != 0:
                x, y = tap % (2 * _REACH + 1) - _REACH, tap // (2 * _REACH + 1) - _REACH
                other = flat[centre[texel] + y * wide + x]
                for channel in range(values.shape[1]):
                    result[texel, channel] += share * values[other, channel]


@compiled
def _spread_squares(weight: np.ndarray, slot: np.ndarray, centre: np.ndarray, area: np.ndarray, result: np.ndarray) -> None:
    wide = slot.shape[1]
    flat = slot.reshape(-1)
    for texel in range(len(centre)):
        for tap in range(_TAPS):
            share = weight[texel, tap]
            if share != 0:
                x, y = tap % (2 * _REACH + 1) - _REACH, tap // (2 * _REACH + 1) - _REACH
                result[flat[centre[texel] + y * wide + x]] += area[texel] * np.float64(share) ** 2
