"""Light that a dataset keeps besides the lightmap: functions on the sphere at places, as harmonics.

A lightmap holds one number a texel and channel; what leaves a glossy surface, or passes a point in free air, depends on
direction. A layer keeps `(order + 1)²` coefficients of such functions (`ddprt.harmonics`) for each of its places. To a method
coefficients are entries as texels are, so basis and transfer stay what they are; only that light may not be negative is a law
of texels alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ddprt import harmonics
from ddprt.axes import Bool, Float32, Float64
from ddprt.dataset.manifest import Manifest, layer_name
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import read_tensors, write_tensors

QUANTITIES = {"irradiance": 1 / (4 * np.pi), "radiance": np.pi / 4}
"""What functions are of, and what turns a sum of squared coefficients into a mean squared irradiance: pi times radiance counts
as irradiance, so that errors of layers and of texels are in one unit."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Where a layer's functions are, and what they are of.

    Attributes:
      name: of the effect that fills it.
      quantity: "irradiance" (W/m², on a plane with the normal that is asked for) or "radiance" (W/(m² sr), towards there).
      order: of the harmonics.
      position: metres.
      weight: what each place counts in errors, m².
      texel: of the lightmap, in row-major order of the covered ones; -1 for places in free air.
    """

    name: str
    quantity: str
    order: int
    position: Float64[np.ndarray, "places 3"]
    weight: Float64[np.ndarray, " places"]
    texel: np.ndarray

    @property
    def coefficients(self) -> int:
        """Numbers per place and channel."""
        return harmonics.count(self.order)

    def towards(
        self, light: Float32[np.ndarray, "*frames places coefficients 3"], directions: np.ndarray
    ) -> Float32[np.ndarray, "*frames places 3"]:
        """Values of the functions in a direction for all places, or in one for each, of any length; never below 0.

        Raises:
          UserError: directions of another shape, of length 0 or not finite.
        """
        Y = harmonics.harmonics(self._unit(directions), self.order)
        return np.maximum(np.einsum("...pkc,pk->...pc", light, Y.astype(np.float32)), 0)

    def _unit(self, directions: np.ndarray) -> Float64[np.ndarray, "places 3"]:
        shape = self.position.shape
        expected = f"expected (3,) or {shape}, of some length; pass where each place is looked at from"
        try:
            given = np.asarray(directions, np.float64)
        except (TypeError, ValueError):
            raise UserError(f"directions: got no numbers, {expected}") from None
        if given.shape not in ((3,), shape):
            raise UserError(f"directions: got shape {given.shape}, {expected}")
        size = np.linalg.norm(given, axis=-1, keepdims=True)
        if not (np.isfinite(size) & (size > 0)).all():
            raise UserError(f"directions: got one of length 0 or not finite, {expected}")
        return np.broadcast_to(given / size, shape)


def write_places(folder: Path, layer: Layer, manifest: Manifest) -> None:
    """Where the layer's functions are."""
    name = layer_name(layer.name, "places")
    write_tensors(folder / name, {"position": layer.position, "weight": layer.weight, "texel": layer.texel})
    manifest.add(name)


def write_light(folder: Path, layer: str, index: int | str, light: np.ndarray, manifest: Manifest, kind: str = "light") -> None:
    """Coefficients of one lighting, or of what no lighting changes ("constant"), (places, coefficients, 3) float32.

    Raises:
      UserError: not finite.
    """
    name = layer_name(layer, index, kind)
    if not np.isfinite(light).all():
        raise UserError(f"{name}: got light past the range of float32; lower the intensities or keep lamps off the surfaces")
    write_tensors(folder / name, {kind: light.astype(np.float32)})
    manifest.add(name)


def write_halves(
    folder: Path,
    layer: str,
    indices: Sequence[int],
    halves: Callable[[int], Sequence[np.ndarray]],
    manifest: Manifest,
) -> None:
    """Coefficients of lightings: what `halves` gives for one, or of two the mean as "light" and half the difference as "noise".

    Raises:
      UserError: not finite.
    """
    for index in indices:
        parts = halves(index)
        write_light(folder, layer, index, parts[0] if len(parts) == 1 else (parts[0] + parts[1]) / 2, manifest)
        if len(parts) > 1:
            write_light(folder, layer, index, (parts[0] - parts[1]) / 2, manifest, "noise")


def read_layer(data: Dataset, name: str) -> Layer:
    """A layer of a dataset.

    Raises:
      UserError: it has none of that name.
    """
    found = {entry["name"]: entry for entry in data.description.get("layers", [])}
    if name not in found:
        raise UserError(f'{data.folder}: got no layer "{name}", expected one of {sorted(found)}; bake with that effect')
    places = read_tensors(data.folder / layer_name(name, "places"))
    kind = {key: found[name][key] for key in ("name", "quantity", "order")}
    return Layer(**kind, position=places["position"], weight=places["weight"], texel=places["texel"])


def layers(data: Dataset) -> list[Layer]:
    """All that a dataset has, but those without places: of gloss that nobody sees."""
    found = [read_layer(data, entry["name"]) for entry in data.description.get("layers", [])]
    return [layer for layer in found if len(layer.position)]


def read_light(
    data: Dataset, layer: Layer, indices: Sequence[int | str], kind: str = "light"
) -> Float32[np.ndarray, "lightings places coefficients 3"]:
    """Coefficients of lightings or of "constant"; kind is "light" or, of held-out ones, "noise" (half of what halves differ).

    Raises:
      UserError: a file that is not of this layer or holds what is not finite.
    """
    shape = len(layer.position), layer.coefficients, 3
    light = np.empty((len(indices), *shape), np.float32)
    for row, index in enumerate(indices):
        path = data.folder / layer_name(layer.name, index, kind)
        stored = read_tensors(path)[kind]
        if stored.shape != shape or not np.isfinite(stored).all():
            raise UserError(f"{path}: got light of shape {stored.shape} or not finite, expected {shape}; bake it again")
        light[row] = stored
    return light


@dataclass(frozen=True, eq=False)
class LayerData(Dataset):
    """A dataset whose texels are the coefficients of one of its layers: what a fit of the layer learns from.

    Attributes:
      layer: which.
    """

    layer: Layer | None = None

    @classmethod
    def of(cls, data: Dataset, layer: Layer) -> "LayerData":
        """The layer of a dataset, with the same lightings and measurements."""
        return cls(data.folder, data.description, data.keep_alive, layer)

    @property
    def _layer(self) -> Layer:
        assert self.layer is not None
        return self.layer

    @cached_property
    def covered(self) -> Bool[np.ndarray, "height width"]:
        """Places down, coefficients across."""
        return np.ones((len(self._layer.position), self._layer.coefficients), bool)

    @property
    def area(self) -> Float64[np.ndarray, " texels"]:
        """What each coefficient counts: squared errors weighted so are those of irradiance."""
        return np.repeat(self._layer.weight, self._layer.coefficients) * QUANTITIES[self._layer.quantity]

    @cached_property
    def occluders(self) -> Float64[np.ndarray, "triangles 3 3"]:
        """None: the model of the lightmap measures."""
        return np.zeros((0, 3, 3))

    @cached_property
    def uv(self) -> None:
        """None."""
        return None

    @cached_property
    def constant(self) -> Float32[np.ndarray, "texels 3"] | None:
        """Coefficients of emissive surfaces, in no other file of the layer; None where none were baked."""
        entry = next(entry for entry in self.description["layers"] if entry["name"] == self._layer.name)
        return read_light(self, self._layer, ["constant"])[0].reshape(-1, 3) if entry.get("constant") else None

    def maps(self, kind: str, indices: Sequence[int]) -> Float32[np.ndarray, "lightings texels 3"]:
        """Coefficients in place of texels; kind is "indirect" or "noise"."""
        light = read_light(self, self._layer, indices, "light" if kind == "indirect" else kind)
        return light.reshape(len(indices), -1, 3)

    def packed(self) -> None:
        """Layers are held in memory."""
        return
