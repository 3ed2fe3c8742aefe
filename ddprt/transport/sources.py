"""What rays of probes end in: the senders of the operator, the lightmaps where something glosses, or no sooner than paths do.

All are asked in the same words. What gathers from them is imported when it is asked for.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.lights import Lighting
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

Gathered = Float32[np.ndarray, "lightings some harmonics 3"]
"""Harmonics of irradiance of some probes, W/m²."""


@dataclass(frozen=True)
class Sent:
    """Light on its way from the senders to whatever gathers it.

    Attributes:
      operator: the scene.
      bounced: see `Operator.bounce`.
      address: seed and stream of the random numbers, and the near field.
    """

    operator: Any
    bounced: Any
    address: dict[str, Any]

    def choose_rays(self, position: Float64[np.ndarray, "places 3"], target: float, halves: int) -> tuple[int, float]:
        """Rays of each probe, and the noise that they will leave."""
        from ddprt.transport.probes import choose_rays

        return choose_rays(self.operator, self.bounced.radiosity, position, target, halves=halves, **self.address)

    def gather(self, position: Float64[np.ndarray, "places 3"], rays: int) -> Iterator[Gathered]:
        """Light of some probes after others."""
        from ddprt.transport.probes import gather

        return gather(self.operator, self.bounced.radiosity, position, rays, **self.address)


@dataclass(frozen=True)
class Shown:
    """Light on the lightmaps, where something glosses: what rays of probes end in.

    Attributes:
      lit: the scene as they show it, a `ddprt.transport.reflected.Lit`.
      address: seed and stream of the random numbers.
    """

    lit: Any
    address: dict[str, Any]

    @classmethod
    def of(cls, tracer: Tracer, scene: Scene, atlas: Atlas, *shown: Any, seed: int, stream: str) -> "Shown":
        """What `Lit.of` takes, and an address."""
        lit = import_module("ddprt.transport.reflected").Lit.of(tracer, scene, atlas, *shown)
        return cls(lit, {"seed": seed, "stream": stream})

    def choose_rays(self, position: Float64[np.ndarray, "places 3"], target: float, halves: int) -> tuple[int, float]:
        """Rays of each probe, and the noise that they will leave."""
        from ddprt.transport.lit_probes import choose_rays

        return choose_rays(self.lit, position, target, halves=halves, **self.address)

    def gather(self, position: Float64[np.ndarray, "places 3"], rays: int) -> Iterator[Gathered]:
        """Light of some probes after others."""
        from ddprt.transport.lit_probes import gather

        return gather(self.lit, position, rays, **self.address)


@dataclass(frozen=True)
class Walked:
    """Light along paths, where the lightmap is traced without the operator.

    Attributes:
      walks: the scene under its lightings, a `ddprt.transport.path_probes.Walks`.
      address: seed and stream of the random numbers.
    """

    walks: Any
    address: dict[str, Any]

    @classmethod
    def of(
        cls, tracer: Tracer, scene: Scene, lightings: Sequence[Lighting], bounces: int, *, seed: int, stream: str
    ) -> "Walked":
        """What `Walks.of` takes, and an address."""
        walks = import_module("ddprt.transport.path_probes").Walks.of(tracer, scene, lightings, bounces)
        return cls(walks, {"seed": seed, "stream": stream})

    def choose_rays(self, position: Float64[np.ndarray, "places 3"], target: float, halves: int) -> tuple[int, float]:
        """Paths of each probe, and the noise that they will leave."""
        from ddprt.transport.path_probes import choose_rays

        return choose_rays(self.walks, position, target, halves=halves, **self.address)

    def gather(self, position: Float64[np.ndarray, "places 3"], rays: int) -> Iterator[Gathered]:
        """Light of some probes after others."""
        from ddprt.transport.path_probes import gather

        return gather(self.walks, position, rays, **self.address)


Source = Sent | Shown | Walked
