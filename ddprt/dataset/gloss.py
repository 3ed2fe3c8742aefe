"""Layers of glossy texels in a dataset: what the eye sees on them, indirect light that leaves towards every direction.

One layer for each order of harmonics that occurs, so that a rough metal beside a smooth one pays only for itself. Held-out
lightings are the mean of two independent halves, with half their difference as "noise", as in the lightmap. Nothing of the
simulation is imported where nothing glosses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from ddprt import harmonics
from ddprt.axes import Float32
from ddprt.config import Config
from ddprt.dataset.layers import Layer, read_layer, write_halves, write_light, write_places
from ddprt.dataset.manifest import Manifest, layer_lacks, layer_name
from ddprt.dataset.scratch import Scratch
from ddprt.dataset.store import Dataset
from ddprt.progress import Progress, Stage
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import plan
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import glossy

RAYS_FOR_A_PATH = 8
"""How many rays leave a glossy texel for each path that a texel of the lightmap is given, which takes some 15 rays itself."""

Shown = Float32[np.ndarray, "texels 3 lightings"]
"""Direct and indirect light of texels, W/m²."""


def _simulation(scene: Scene) -> ModuleType | None:
    return import_module("ddprt.transport.exitant") if any(glossy(scene)) else None


def gloss_layers(config: Config, scene: Scene) -> list[dict[str, Any]]:
    """What dataset.json tells of glossy texels; empty where none is simulated, or none is to be kept."""
    module = _simulation(scene) if config.effects.glossy_layers else None
    glows = {"constant": True} if module and plan(scene, ()).called("emission") else {}
    return [{**_entry(order), **glows} for order in module.orders(scene)] if module else []


def _entry(order: int) -> dict[str, Any]:
    return {"name": f"gloss-{order}", "quantity": "radiance", "order": order}


@dataclass(frozen=True, eq=False)
class GlossBake:
    """What is needed to bake the layer of one order.

    Attributes:
      module: of the simulation.
      exits: the places, as it knows them.
      layer: the same, as the dataset keeps them.
      config, scene, tracer, atlas, dataset, manifest, bounces: of the bake.
    """

    module: ModuleType
    exits: Any
    layer: Layer
    config: Config
    scene: Scene
    tracer: Tracer
    atlas: Atlas
    dataset: Dataset
    manifest: Manifest
    bounces: int

    @classmethod
    def all(
        cls,
        config: Config,
        scene: Scene,
        tracer: Tracer,
        atlas: Atlas,
        dataset: Dataset,
        manifest: Manifest,
        *,
        bounces: int,
    ) -> "tuple[GlossBake, ...]":
        """Finds the glossy texels and writes where they are, unless that is there; empty where nothing glosses.

        An order whose materials are nowhere in the open has a layer without places, which nothing learns.
        """
        module = _simulation(scene) if config.effects.glossy_layers else None
        if module is None:
            return ()
        found = list[GlossBake]()
        for entry in map(_entry, module.orders(scene)):
            exits = module.Exits.of(scene, atlas, entry["order"])
            if not manifest.holds(layer_name(entry["name"], "places")):
                layer = Layer(**entry, position=atlas.position[exits.texel], weight=exits.weight, texel=exits.texel)
                write_places(dataset.folder, layer, manifest)
            layer = read_layer(dataset, entry["name"])
            found.append(cls(module, exits, layer, config, scene, tracer, atlas, dataset, manifest, bounces))
        return tuple(found)

    def run(self, split: str, indices: Sequence[int], shown: Callable[[int], Shown], progress: Progress) -> None:
        """Bakes the layer of a split's lightings where some are missing.

        Args:
          split, indices: "train" (with validation) or "test", and its lightings.
          shown: the light on the atlas that each half is made from.
          progress: told of the stage.
        """
        kinds = ("light", "noise")[: 1 + (split == "test")]
        todo = layer_lacks(self.manifest, self.layer.name, kinds, indices)
        if not todo:
            return
        with progress.stage(f"gloss {split}, order {self.layer.order}") as stage:
            before, count, parts = self.tracer.rays, self.exits.count, []
            stage.facts |= {"texels": count}
            if self.bounces == 0 or count == 0:
                dark = np.zeros((count, self.layer.coefficients, 3), np.float32)
                write_halves(self.dataset.folder, self.layer.name, todo, lambda index: [dark] * len(kinds), self.manifest)
            else:
                lightings, samples = [self.dataset.lightings[index] for index in indices], 0
                for half in range(len(kinds)):
                    lit = self._lit(lightings, shown(half))
                    if half == 0:
                        samples = self._samples(lit, split, len(kinds), stage, progress)
                        stage.pace(len(kinds) * samples * count)
                    parts.append(self._traced(lit, f"{split}-{half}", len(indices), samples, stage))
                shape = count, harmonics.count(self.layer.order), 3

                def halves(index: int) -> list[np.ndarray]:
                    return [part.maps[indices.index(index)].reshape(shape) for part in parts]

                write_halves(self.dataset.folder, self.layer.name, todo, halves, self.manifest)
                for part in parts:
                    part.remove()
            stage.facts["rays"] = self.tracer.rays - before

    def _lit(self, *shown: Any) -> Any:
        """What is to be seen: lightings, light on the atlas, and what glows."""
        return import_module("ddprt.transport.reflected").Lit.of(self.tracer, self.scene, self.atlas, *shown)

    def lacks_constant(self) -> bool:
        """Whether the light of what glows is missing."""
        return not self.manifest.holds(layer_name(self.layer.name, "constant"))

    def constant(self, irradiance: Float32[np.ndarray, "texels 3"]) -> None:
        """Bakes the light of what glows, straight from there and by what it lights.

        Args:
          irradiance: of it, direct and indirect, on every texel.
        """
        light = np.zeros((1, self.exits.count * self.layer.coefficients, 3), np.float32)
        if self.bounces != 0 and self.exits.count:
            emitters = import_module("ddprt.transport.emission").Emitters.of(self.scene)
            lit = self._lit([()], irradiance[:, :, None], emitters)
            config, stream = self.config.transport, self._stream("constant")
            samples = RAYS_FOR_A_PATH * config.test_samples if isinstance(config.test_samples, int) else None
            address: dict[str, Any] = {"seed": self.config.seed, "stream": stream}
            if samples is None:
                samples, _ = self.module.choose_samples(lit, self.exits, target=config.target_noise, **address)
            for _ in self.module.trace_exitant(lit, self.exits, light, samples=samples, **address):
                pass
        places = light.reshape(self.exits.count, self.layer.coefficients, 3)
        write_light(self.dataset.folder, self.layer.name, "constant", places, self.manifest)

    def _samples(self, lit: Any, split: str, halves: int, stage: Stage, progress: Progress) -> int:
        """Rays of each half and place: by the paths that are configured, or as the noise that is aimed at asks."""
        config = self.config.transport
        paths = config.test_samples if split == "test" else config.samples
        given = RAYS_FOR_A_PATH * paths if isinstance(paths, int) else paths
        if given == "auto":
            address = {"seed": self.config.seed, "stream": self._stream(split)}
            given, noise = self.module.choose_samples(lit, self.exits, target=config.target_noise, **address)
            stage.facts["noise_expected"] = float(f"{noise:.3g}")
            if noise > 1.5 * config.target_noise:
                setting = f"transport.{'test_' if split == 'test' else ''}samples"
                progress.warn(
                    f"{self.layer.name}: {given} rays per glossy texel leave {100 * noise:.2g} % of noise in what leaves "
                    f"it, and no more are traced unasked; set {setting} or raise transport.target_noise"
                )
        samples = max(1, given // halves)
        stage.facts["samples"] = samples * halves
        return int(samples)

    def _stream(self, part: str) -> str:
        return f"{self.layer.name} {part}"

    def _traced(self, lit: Any, part: str, lightings: int, samples: int, stage: Stage) -> Scratch:
        """One half of a split, tile by tile; what an interrupted bake left of it is taken over."""
        shape = lightings, self.exits.count * self.layer.coefficients, 3
        path = self.dataset.folder / f"{self.layer.name}-{part}.part"
        scratch = Scratch(path, shape, {"dataset": self.dataset.description, "layer": self.layer.name, "paths": samples})
        there, tile = scratch.done, 0

        def told(places: int) -> None:
            nonlocal tile
            stage.advance(samples * places, found=tile < there)
            tile += 1

        address: dict[str, Any] = {"samples": samples, "seed": self.config.seed, "stream": self._stream(part)}
        scratch.follow(self.module.trace_exitant(lit, self.exits, scratch.maps, skip=scratch.done, **address), told)
        return scratch
