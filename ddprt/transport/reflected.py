"""What is to be seen in glossy surfaces, or from probes beside them: the scene as its lightmaps show it.

A ray that lands on a diffuse surface takes the light that the lightmaps have there, direct and indirect, and ends. So all
lightings share rays, no lamp is asked but on glossy surfaces that are seen in glossy ones, and the noise is that of maps, which
are means over texels and over many paths.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ddprt.axes import Float32, Float64, Int, Int32
from ddprt.compiled import compiled
from ddprt.lights import Lighting
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import BACK, Landing, landed_on
from ddprt.transport.gloss import Surfaces
from ddprt.transport.shading import Lamp, lamps_of, shade
from ddprt.transport.walk import Albedo, albedo_of


class Arriving(NamedTuple):
    """Light that rays find: row `row` of a table, times a factor for each channel, is the radiance that arrives along `ray`.

    Attributes:
      ray, row: indices.
      factor: per channel.
      table: W/m² or W/(m² sr), a lighting after another within each channel.
    """

    ray: Int32[np.ndarray, " found"]
    row: Int32[np.ndarray, " found"]
    factor: Float32[np.ndarray, "found 3"]
    table: Float32[np.ndarray, "rows 3 lightings"]

    def add(
        self,
        worth: Float32[np.ndarray, "rays harmonics 3"],
        slot: Int[np.ndarray, " rays"],
        sums: Float64[np.ndarray, "slots harmonics 3 lightings"],
    ) -> None:
        """Adds what each ray found, times what that is worth to each harmonic, to the ray's slot, in place."""
        _add(*self, worth, slot, sums)


@dataclass(frozen=True, eq=False)
class Lit:
    """A scene as its lightmaps show it.

    Attributes:
      surfaces: its glossy triangles.
      albedo, lamps: of what is diffuse, and of the lightings, as `walked` and `shade` ask for them.
      landing: where on the atlas a hit lies.
      irradiance: direct and indirect light of each texel, W/m².
      emitters: what glows, `ddprt.transport.emission.Emitters`, where that is to be seen; else None.
    """

    surfaces: Surfaces
    albedo: Albedo
    lamps: Sequence[Sequence[Lamp]]
    landing: Landing
    irradiance: Float32[np.ndarray, "texels 3 lightings"]
    emitters: Any = None

    @classmethod
    def of(
        cls,
        tracer: Tracer,
        scene: Scene,
        atlas: Atlas,
        lightings: Sequence[Lighting],
        irradiance: Float32[np.ndarray, "texels 3 lightings"],
        emitters: Any = None,
    ) -> "Lit":
        """A scene, lightings in world space, and the light that they, or emitters, bring to an atlas."""
        lamps = lamps_of(tracer, lightings)
        landing = Landing.of(atlas, np.arange(atlas.count, dtype=np.int32))
        return cls(Surfaces.of(tracer, scene), albedo_of(scene), lamps, landing, irradiance, emitters)

    def arriving(
        self,
        origins: Float32[np.ndarray, "rays 3"],
        directions: Float32[np.ndarray, "rays 3"],
        alive: Int[np.ndarray, " alive"],
        walk: np.random.Generator,
        chance: np.random.Generator,
        *,
        straight: bool = True,
    ) -> Iterator[Arriving]:
        """What rays find; those that meet something glossy go on from there until they land on something that is not.

        Args:
          origins, directions: of rays; centred frame.
          alive: indices of those that are followed.
          walk, chance: random numbers of what goes on, and of lights at glossy surfaces.
          straight: whether what rays meet first shows its own glow, too; never for whom that is direct light.
        """
        tracer, ray = self.surfaces.tracer, alive.astype(np.int32)
        origins, directions, throughput = origins[ray], directions[ray], np.ones((3, len(ray)), np.float32)
        sums: Float64[np.ndarray, "lightings rays 3"] | None = None
        while len(ray):
            triangle, u, v, _ = tracer.first(origins, directions)
            cells = landed_on(tracer, self.landing, directions, triangle, u, v)
            if self.emitters is not None and straight:
                front = np.flatnonzero((triangle >= 0) & (cells != BACK))
                light = self.emitters.radiance(triangle[front], np.stack([u[front], v[front]], 1))
                factor = (throughput[:, front].T * light).astype(np.float32)
                yield Arriving(ray[front], np.zeros(len(front), np.int32), factor, np.ones((1, 3, 1), np.float32))
            triangle, met = self.surfaces.met(triangle, u, v, directions, throughput, ray)
            lit = np.flatnonzero((triangle >= 0) & (cells >= 0))
            colour = self.albedo(triangle[lit], u[lit], v[lit])
            yield Arriving(ray[lit], cells[lit], throughput[:, lit].T * colour / np.float32(np.pi), self.irradiance)
            if met is None:
                break
            sums = np.zeros((len(self.lamps), alive.max() + 1, 3)) if sums is None else sums
            for part in met.blocks():
                shade(tracer, self.lamps, part, chance, sums)
            origins, directions, throughput, ray = met.go_on(walk)
            straight = True
        if sums is not None:
            seen = np.flatnonzero(sums.any((0, 2))).astype(np.int32)
            table = np.ascontiguousarray(sums[:, seen].transpose(1, 2, 0), np.float32)
            factor = np.full((len(seen), 3), 1 / np.pi, np.float32)  # paths count irradiance, spread over by cosine
            yield Arriving(seen, np.arange(len(seen), dtype=np.int32), factor, table)


@compiled
def _add(
    ray: np.ndarray,
    row: np.ndarray,
    factor: np.ndarray,
    table: np.ndarray,
    worth: np.ndarray,
    slot: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Adds what each ray found, times what that is worth to each harmonic, to its slot: all lightings in one go."""
    for i in range(len(ray)):
        light, share, own = table[row[i]], worth[ray[i]], sums[slot[ray[i]]]
        for k in range(len(share)):
            for channel in range(3):
                times = np.float64(share[k, channel] * factor[i, channel])
                for lighting in range(light.shape[1]):
                    own[k, channel, lighting] += times * light[channel, lighting]
