"""The layer of probes in a dataset: where they stand, and their light under every lighting.

Probes take the light that the senders send to the lightmap, so they cost their own rays alone; where something glosses their
rays end in the lightmaps, and where the lightmap is made without senders they are first steps of paths. Held-out lightings are
the mean of two independent halves, with half their difference as "noise", as in the lightmap.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float32
from ddprt.config import Config
from ddprt.dataset.layers import Layer, read_layer, write_halves, write_light, write_places
from ddprt.dataset.manifest import Manifest, layer_lacks, layer_name
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import Plan, plan, probed
from ddprt.transport.embree import Tracer
from ddprt.transport.fogginess import hazy
from ddprt.transport.glossiness import glossy
from ddprt.transport.sources import Shown, Source

NAME = "probes"
_NAMED = 8  # probes that a message spells out


def scatters(scene: Scene) -> bool:
    """Whether anything sends light on: a surface, or fog."""
    return any(entry.brightest for entry in scene.materials) or any(glossy(scene)) or hazy(scene)


def probe_layers(config: Config, scene: Scene) -> list[dict[str, Any]]:
    """What dataset.json tells of probes, and all that their light depends on; empty where there are none.

    Raises:
      UserError: probes cannot be placed.
    """
    if not probed(config, scene):
        return []
    probes = import_module("ddprt.transport.probes")
    position = probes.places(config.probes, scene.bounds)
    places = {"count": len(position), "digest": probes.digest(position), "rays": config.probes.rays}
    glows = {"constant": True} if plan(scene, ()).called("emission") else {}
    return [{"name": NAME, "quantity": "irradiance", "order": probes.ORDER, **places, **glows}]


def placed_probes(module: ModuleType, config: Config, scene: Scene, tracer: Tracer, atlas: Atlas) -> Layer:
    """Where probes stand, `module` being their file. Those not in free air count nothing, the others as much as the lightmap.

    Raises:
      UserError: none is in free air.
    """
    position = module.places(config.probes, scene.bounds)
    valid = module.in_the_open(tracer, position)
    if not valid.any():
        raise UserError(
            f"probes: got {len(position)}, none of them in free air, expected some; move the grid (probes.region_low and "
            "region_high) or the positions of the file out of solids and walls"
        )
    weight = np.where(valid, atlas.area.sum() / valid.sum(), 0.0)
    return Layer(NAME, "irradiance", module.ORDER, position, weight, np.full(len(position), -1))


def shown_glow(
    tracer: Tracer, scene: Scene, atlas: Atlas, irradiance: Float32[np.ndarray, "texels 3"], emitters: Any, seed: int
) -> Shown | None:
    """Light of what glows as the lightmaps show it, direct and indirect; None where nothing glosses."""
    address: dict[str, Any] = {"seed": seed, "stream": "emission probes"}
    light = irradiance[:, :, None]
    return Shown.of(tracer, scene, atlas, [()], light, emitters, **address) if any(glossy(scene)) else None


@dataclass(frozen=True, eq=False)
class ProbeBake:
    """What is needed to bake probes.

    Attributes:
      module: of the effect.
      layer: the probes.
      dark: no light leaves a surface or fog, or none is to be followed.
      config, tracer, dataset, manifest: of the bake.
    """

    module: ModuleType
    layer: Layer
    dark: bool
    config: Config
    tracer: Tracer
    dataset: Dataset
    manifest: Manifest

    @classmethod
    def of(
        cls, effects: Plan, config: Config, scene: Scene, tracer: Tracer, atlas: Atlas, dataset: Dataset, manifest: Manifest
    ) -> "ProbeBake | None":
        """Places probes, unless they are there; None where a plan does not call for any.

        Raises:
          UserError: none is in free air.
        """
        module = effects.module(NAME)
        if module is None:
            return None
        if manifest.holds(layer_name(NAME, "places")):
            layer = read_layer(dataset, NAME)
        else:
            layer = placed_probes(module, config, scene, tracer, atlas)
            write_places(dataset.folder, layer, manifest)
        dark = config.transport.bounces == 0 or not scatters(scene)
        return cls(module, layer, dark, config, tracer, dataset, manifest)

    def run(
        self,
        split: str,
        indices: Sequence[int],
        sent: Callable[[int], Source],
        progress: Progress,
    ) -> None:
        """Bakes the probes of a split's lightings where some are missing.

        Args:
          split, indices: "train" (with validation) or "test", and its lightings.
          sent: the light of each half.
          progress: told of the stage, and of probes that are not in free air.
        """
        kinds = ("light", "noise")[: 1 + (split == "test")]
        todo = layer_lacks(self.manifest, NAME, kinds, indices)
        if not todo:
            return
        valid = self.layer.weight > 0
        with progress.stage(f"probes {split}") as stage:
            before = self.tracer.rays
            stage.facts |= {"probes": len(valid), "in_the_open": int(valid.sum())}
            halves = [np.zeros((len(indices), len(valid), self.layer.coefficients, 3), np.float32) for _ in kinds]
            if not self.dark:
                rays = 0
                for half, light in enumerate(halves):
                    source = sent(half)
                    if not rays:
                        rays = self._rays(source, len(kinds), stage)
                        stage.pace(len(kinds) * rays * int(valid.sum()))
                    light[:, valid] = self._gathered(source, rays, stage)
                    del source  # before the next half's maps are read
                if split == "train":
                    unlit = valid & ~halves[0].any((0, 2, 3))
                    stage.facts["unlit"] = int(unlit.sum())
                    name_unlit(self.layer, unlit, progress)
            write_halves(
                self.dataset.folder, NAME, todo, lambda index: [half[indices.index(index)] for half in halves], self.manifest
            )
            stage.facts["rays"] = self.tracer.rays - before
        name_shut(self.layer, progress)

    def lacks_constant(self) -> bool:
        """Whether the light of what glows is missing."""
        return not self.manifest.holds(layer_name(NAME, "constant"))

    def constant(self, glowing: Any, atlas: Atlas, scene: Scene, bounces: int) -> dict[str, Any]:
        """Bakes the light of what glows, and tells how.

        Args:
          glowing: of it, on every texel: `ddprt.transport.emission.Constant`.
          atlas, scene, bounces: of the bake.
        """
        glow, emission = (import_module(f"ddprt.transport.{name}") for name in ("emission_probes", "emission"))
        valid, config, emitters = self.layer.weight > 0, self.config, emission.Emitters.of(scene)
        found = glow.probe_light(
            emitters,
            self.tracer,
            atlas,
            glowing.direct,
            self.layer.position[valid],
            config.transport,
            config.probes.rays,
            seed=config.seed,
            bounces=bounces,
            shown=shown_glow(self.tracer, scene, atlas, glowing.irradiance, emitters, config.seed),
        )
        light = np.zeros((len(valid), self.layer.coefficients, 3), np.float32)
        light[valid] = found.light
        write_light(self.dataset.folder, NAME, "constant", light, self.manifest)
        return dict(found.facts)

    def _rays(self, source: Source, halves: int, stage: Any) -> int:
        """Rays of each probe, as configured or as the noise that is aimed at asks."""
        given = self.config.probes.rays
        if given == "auto":
            position, target = self.layer.position[self.layer.weight > 0], self.config.transport.target_noise
            rays, noise = source.choose_rays(position, target, halves)
            stage.facts["noise_expected"] = float(f"{noise:.3g}")
        else:
            rays = self.module.power_of_two(given)
        stage.facts["samples"] = rays * halves
        return int(rays)

    def _gathered(self, source: Source, rays: int, stage: Any) -> Float32[np.ndarray, "lightings valid harmonics 3"]:
        position = self.layer.position[self.layer.weight > 0]
        parts = []
        for part in source.gather(position, rays):
            parts.append(part)
            stage.advance(rays * part.shape[1])
        return np.concatenate(parts, 1)


def name_shut(layer: Layer, progress: Progress) -> None:
    """Names the probes that are not in free air."""
    shut = layer.weight == 0
    if shut.any():
        _name(layer, shut, "stand inside solids or behind walls, and stay dark", progress)


def name_unlit(layer: Layer, unlit: Bool[np.ndarray, " places"], progress: Progress) -> None:
    """Names those in free air that no light of any training lighting reaches."""
    if unlit.any():
        way = "move the grid (probes.region_low and region_high), or see that lamps stand where probes do"
        what = f"get no light under any training lighting, as outside of a closed room; {way}"
        _name(layer, unlit, what, progress)


def _name(layer: Layer, which: Bool[np.ndarray, " places"], what: str, progress: Progress) -> None:
    found = np.flatnonzero(which)
    told = ", ".join(f"{i} at {np.round(layer.position[i], 4).tolist()}" for i in found[:_NAMED])
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    progress.warn(f"probes: {len(found)} of {len(which)} {what}: {told}{more}")
