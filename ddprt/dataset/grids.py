"""Light between probes: what an object takes as it moves through a grid of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int
from ddprt.dataset.layers import Layer
from ddprt.errors import UserError


@dataclass(frozen=True, eq=False)
class ProbeGrid:
    """A layer whose places are a grid, ready to be looked up.

    Attributes:
      axes: coordinates of the planes along x, y and z, metres, rising.
      source: whose light each place has: its own, or that of the nearest place in free air.
    """

    axes: tuple[np.ndarray, ...]
    source: Int[np.ndarray, " places"]

    @classmethod
    def of(cls, layer: Layer) -> "ProbeGrid":
        """The grid of a layer.

        Raises:
          UserError: its places are no grid in the order in which `ddprt.transport.probes` makes one.
        """
        axes = tuple(np.unique(layer.position[:, axis]) for axis in range(3))
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        if grid.shape != layer.position.shape or not (grid == layer.position).all():
            raise UserError(
                f'layer "{layer.name}": got {len(layer.position)} places that are no grid, expected one to look light up '
                "between; set probes.grid, or take the light of the places themselves"
            )
        return cls(axes, nearest_valid(layer))

    def at(
        self, light: Float32[np.ndarray, "*frames places coefficients 3"], position: Any
    ) -> Float[np.ndarray, "*frames n coefficients 3"]:
        """Coefficients at any positions, trilinear between the eight probes around each; beyond the outermost, theirs.

        Args:
          light: of all places, as `LayerModel.predict` gives it.
          position: (n, 3) metres.
        Raises:
          UserError: positions that are none, or light that is not of all places.
        """
        position, shape = _positions(position), tuple(map(len, self.axes))
        if light.ndim < 3 or light.shape[-3] != len(self.source) or light.shape[-1] != 3:
            raise UserError(
                f"light: got shape {light.shape}, expected (..., {len(self.source)}, coefficients, 3), the light of all "
                "places; give what LayerModel.predict gives"
            )
        low, share = [], []
        for axis, planes in enumerate(self.axes):
            at = np.interp(position[:, axis], planes, np.arange(len(planes)))
            below = np.minimum(at.astype(int), max(len(planes) - 2, 0))
            low.append(below)
            share.append(at - below)
        found: Any = 0.0
        for corner in np.ndindex(2, 2, 2):
            index = [np.minimum(low[a] + corner[a], shape[a] - 1) for a in range(3)]
            weight = np.prod([share[a] if corner[a] else 1 - share[a] for a in range(3)], axis=0)
            place = self.source[np.ravel_multi_index(index, shape)]
            found = found + weight[:, None, None].astype(np.float32) * light[..., place, :, :]
        return np.asarray(found)


def _positions(given: Any) -> Float64[np.ndarray, "n 3"]:
    try:
        position = np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"position: got no array of numbers ({error}), expected (n, 3) metres; mend it") from None
    if position.ndim != 2 or position.shape[1] != 3:
        raise UserError(f"position: got shape {position.shape}, expected (n, 3) metres; write [[x, y, z]] for one alone")
    lost = np.flatnonzero(np.isnan(position).any(1))
    if len(lost):
        raise UserError(f"position[{lost[0]}]: got {position[lost[0]].tolist()}, expected numbers; leave out what is nowhere")
    return position


def nearest_valid(layer: Layer) -> Int[np.ndarray, " places"]:
    """For each place the nearest one that counts: itself, or, where it stands in a solid, the one to take light from."""
    from scipy.spatial import cKDTree

    valid = np.flatnonzero(layer.weight > 0)
    source = np.arange(len(layer.position))
    shut = np.flatnonzero(layer.weight == 0)
    source[shut] = valid[cKDTree(layer.position[valid]).query(layer.position[shut])[1]] if len(shut) else source[shut]
    return source
