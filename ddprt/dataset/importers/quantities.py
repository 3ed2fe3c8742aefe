"""From what other programs write to the irradiance that a dataset holds: a factor, and the albedo where light has it."""

from dataclasses import dataclass

import numpy as np

from ddprt.axes import Bool, Float32
from ddprt.catalogue import Catalogue

DARKEST = 1e-3
"""Albedo in a channel below which light that was multiplied by it cannot be divided again."""


@dataclass(frozen=True)
class Quantity:
    """What the numbers of a map are.

    Attributes:
      factor: from them to irradiance (or to irradiance times albedo), W/m².
      albedo: they hold the albedo.
      exitant: they are all light that leaves, which no albedo can be taken out of.
      told: in words.
    """

    factor: float
    albedo: bool
    exitant: bool
    told: str


QUANTITIES: Catalogue[Quantity] = Catalogue(
    "quantity",
    {
        "irradiance": Quantity(1.0, False, False, "irradiance E, before albedo"),
        "E/pi": Quantity(float(np.pi), False, False, "E/pi, as Blender's diffuse passes without colour"),
        "radiosity": Quantity(1.0, True, False, "radiosity B = albedo E"),
        "radiance": Quantity(float(np.pi), True, False, "radiance L = albedo E/pi of matt surfaces"),
        "exitant": Quantity(1.0, False, True, "all light that leaves, kept as it is"),
    },
)


def irradiance(
    values: Float32[np.ndarray, "n 3"], quantity: Quantity, albedo: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Irradiance in W/m² (or what is kept as it is) from values of a map; albedo must be divisible where it counts."""
    light = values.astype(np.float64) * quantity.factor
    return (light / albedo if quantity.albedo else light).astype(np.float32)


def divisible(albedo: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Where light can be freed of the albedo."""
    return np.asarray((albedo >= DARKEST).all(1))
