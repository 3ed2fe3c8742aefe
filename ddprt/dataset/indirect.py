"""Indirect lightmaps of a dataset: by the operator or by shared paths for all lightings at once, or one by one."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Int
from ddprt.config import Config
from ddprt.dataset.denoise import denoised
from ddprt.dataset.gloss import GlossBake
from ddprt.dataset.manifest import Manifest, map_name
from ddprt.dataset.probes import ProbeBake
from ddprt.dataset.sampled import scratched, stored
from ddprt.dataset.scratch import Scratch
from ddprt.dataset.store import CONSTANT, Dataset, read_map, write_map
from ddprt.progress import Progress, Stage
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import Texels
from ddprt.transport.effects import Plan
from ddprt.transport.embree import Tracer
from ddprt.transport.footprint import Footprints
from ddprt.transport.glossiness import glossy
from ddprt.transport.hairiness import borrowed_along
from ddprt.transport.sources import Sent, Shown, Source, Walked
from ddprt.transport.translucency import filled

_SHARE, _LARGE = 64, 1 << 26  # of maps in the making that is tried out; bytes below which they take no time that matters
_REFERENCE_SAMPLES = 512  # paths of the reference where nothing else is asked for

Leaving = tuple[Int[np.ndarray, " inside"], Float32[np.ndarray, "lightings inside 3"]]
"""Texels of bodies that light passes, and what leaves them."""


@dataclass(frozen=True, eq=False)
class IndirectBake:
    """What all indirect maps of a dataset have in common.

    Held-out maps are the mean of two independent halves, texel by texel, and their half difference is kept as `noise`. Training
    maps may share rays between neighbouring texels and spread them unevenly: cheaper, with a bias that no score is told of.
    """

    config: Config
    scene: Scene
    tracer: Tracer
    atlas: Atlas
    effects: Plan
    dataset: Dataset
    manifest: Manifest
    progress: Progress

    def all(self) -> None:
        """Bakes whatever is missing."""
        self.run("train", self.dataset.split("train") + self.dataset.split("validation"))
        self.run("test", self.dataset.split("test"))
        self.constant()

    def run(self, split: str, indices: list[int]) -> None:
        """Bakes lightings that share their gather rays: "train" (with validation), or "test"."""
        sent: Callable[[int], Sent] = partial(self._sent, split, indices)
        if self._probes or self._passing:
            sent = cache(sent)  # of maps, bodies and probes
        self._maps(split, indices, sent, self._leaving(split, indices, sent))
        if self._probes:
            self._probes.run(split, indices, self._source(split, indices, sent), self.progress)
        for layer in self._glossy:
            layer.run(split, indices, partial(self._shown, split, indices), self.progress)

    @cached_property
    def _probes(self) -> ProbeBake | None:
        scene = self.scene, self.tracer, self.atlas
        return ProbeBake.of(self.effects, self.config, *scene, self.dataset, self.manifest)

    @cached_property
    def _glossy(self) -> tuple[GlossBake, ...]:
        scene = self.scene, self.tracer, self.atlas
        return GlossBake.all(self.config, *scene, self.dataset, self.manifest, bounces=self.effects.bounces)

    @cached_property
    def _passing(self) -> Any:
        """The `ddprt.transport.subsurface.Inside` of bodies that light passes; None where there are none."""
        module = self.effects.module("subsurface")
        return module.Inside.of(self._solid, self.scene) if module and any(filled(self.scene)) else None

    def _leaving(self, split: str, indices: list[int], sent: Callable[[int], Sent]) -> list[Leaving]:
        """What leaves texels of bodies, for each half; nothing where there are none, or where it is baked."""
        kinds = ["indirect", "noise"] if split == "test" else ["indirect"]
        if self._passing is None or not self.manifest.lacks(kinds, indices):
            return []
        config, texels, found, facts = self.config.transport, self._passing.texels, list[Leaving](), {}
        given, before = config.test_samples if split == "test" else config.samples, self.tracer.rays
        sharing = split != "test" and config.footprint > 0 and given != 1  # neighbours share walks where nothing is scored on
        with self.progress.stage(f"subsurface {split}", (len(kinds) + sharing) * len(texels)) as stage:
            for half in range(len(kinds)):
                light, address = sent(half).bounced.arrived, self._address(split, half)
                if given == "auto":
                    each, noise = self._passing.choose(light, config.target_noise * len(kinds) ** 0.5, **address)
                    given = each * len(kinds)
                    stage.facts["noise_expected"] = float(f"{noise / len(kinds) ** 0.5:.3g}")
                leave = self._passing.borrowed if sharing else self._passing.whole
                values, facts = leave(light, max(1, given // len(kinds)), stage.advance, **address)
                found.append((texels, values))
            stage.facts |= facts | {"walks": given, "rays": self.tracer.rays - before}
        return found

    def _maps(self, split: str, indices: list[int], sent: Callable[[int], Sent], leaving: list[Leaving]) -> None:
        kinds = ["indirect", "noise"] if split == "test" else ["indirect"]
        todo = self.manifest.lacks(kinds, indices)
        if not todo:
            return
        with self.progress.stage(f"indirect {split}", len(kinds) * self.atlas.count) as stage:
            before = self.tracer.rays
            stage.facts["integrator"] = integrator = self.dataset.description["transport"]["integrator"]
            if self.effects.bounces == 0:
                dark = np.zeros((len(indices), self.atlas.count, 3), np.float32)
                self._finish([dark] * len(kinds), indices, todo, kinds, np.asarray, leaving)
            elif integrator == "reference":
                self._by_reference(split, todo, kinds, stage)
            elif integrator == "paths":
                self._by_paths(split, indices, todo, kinds, stage)
            else:
                self._by_operator(split, indices, todo, kinds, stage, sent, leaving)
            stage.facts["rays"] = self.tracer.rays - before

    def constant(self) -> None:
        """Bakes the light of what glows, if a plan calls for it."""
        emission = self.effects.module("emission")
        probes = self._probes if self._probes and self._probes.lacks_constant() else None
        glossy = [layer for layer in self._glossy if layer.lacks_constant()] if emission else []
        if emission is None or (self.manifest.holds(CONSTANT) and probes is None and not glossy):
            return
        config, before = self.config.transport, self.tracer.rays
        with self.progress.stage("emission") as stage:
            address = {"seed": self.config.seed, "bounces": self.effects.bounces}
            found = emission.constant_light(self.scene, self.tracer, self.atlas, config, **address)
            if config.test_samples == "auto" and found.relative > 1.5 * config.target_noise:
                self.progress.warn(
                    f"transport.target_noise: got {config.target_noise:g}, but the most samples that are taken unasked leave "
                    f"{found.relative:.2g} in the light of emissive surfaces; raise it, or set transport.test_samples"
                )
            write_map(self.dataset.folder / CONSTANT, self.atlas.image(found.irradiance))
            self.manifest.add(CONSTANT)
            more = probes.constant(found, self.atlas, self.scene, self.effects.bounces) if probes else {}
            for layer in glossy:
                layer.constant(found.irradiance)
            stage.facts |= found.facts | more | {"rays": self.tracer.rays - before}

    @cached_property
    def _operator(self) -> Any:
        return replace(self._solid, inside=self._passing) if self._passing else self._solid

    @cached_property
    def _solid(self) -> Any:
        """As if no light passed anything."""
        from ddprt.transport.operator import Operator

        return Operator.of(self.tracer, self.atlas, self.config.transport.sender_resolution)

    def _sent(self, split: str, indices: list[int], half: int) -> Sent:
        """What the senders of a half of a split send to its lightings' maps and probes."""
        operator, address = self._operator, self._address(split, half)
        bounces = self.effects.bounces or 1  # of a lonely convex body, whose light reaches probes alone
        direct = self._averaged(operator, indices, half)
        bounced = operator.bounce(direct, **address, bounces=bounces)
        near = operator.near([self.dataset.lightings[index] for index in indices], direct, bounces=bounces)
        return Sent(operator, bounced, address | {"near": near})

    def _source(self, split: str, indices: list[int], sent: Callable[[int], Sent]) -> Callable[[int], Source]:
        """What rays of probes end in, for each half."""
        lightings = [self.dataset.lightings[index] for index in indices]
        if any(glossy(self.scene)):
            scene = self.tracer, self.scene, self.atlas, lightings
            return lambda half: Shown.of(*scene, self._shown(split, indices, half), **self._address(split, half))
        if self.dataset.description["transport"]["integrator"] == "operator":
            return sent
        walks = self.tracer, self.scene, lightings, self.effects.bounces or 1  # as in `_sent`
        return lambda half: Walked.of(*walks, **self._address(split, half))

    def _address(self, split: str, half: int) -> dict[str, Any]:
        return {"seed": self.config.seed, "stream": f"{split} {half}"}

    def _by_operator(
        self,
        split: str,
        indices: list[int],
        todo: list[int],
        kinds: list[str],
        stage: Stage,
        sent: Callable[[int], Sent],
        leaving: list[Leaving],
    ) -> None:
        from ddprt.transport.effort import choose_rays

        config, test = self.config.transport, split == "test"
        parts, rays, footprints = [], None, None
        begun = time.perf_counter()
        for half in range(len(kinds)):
            light = sent(half)
            operator, bounced, address = light.operator, light.bounced, light.address
            if rays is None:
                bouncing = time.perf_counter() - begun
                chosen = choose_rays(operator, bounced.radiosity, config, held_out=test, **address)
                rays, footprints = chosen.rays.copy(), chosen.footprints
                for texels, _ in leaving:
                    rays[texels] = 0
                stage.facts |= chosen.facts | self._facts(bounced, operator)
                storing = self._storing(indices, todo, kinds, chosen.facts["noise_expected"], footprints)
                spent = storing + time.perf_counter() - begun + (len(kinds) - 1) * bouncing  # each half bounces its own light
                stage.facts["seconds_expected"] = float(f"{chosen.facts['seconds_expected'] + spent:.2g}")
                stage.pace(len(kinds) * int(rays.sum()))
                given, expected = config.test_samples if test else config.samples, chosen.facts["noise_expected"]
                if given == "auto" and expected > 1.5 * config.target_noise:
                    self.progress.warn(
                        f"transport.target_noise: got {config.target_noise:g}, but the most rays that are traced "
                        f"unasked leave {expected:.2g}; raise it, or set transport.{'test_' if test else ''}samples"
                    )
            scratch = self._scratch(split, half, indices, rays=seeds.digest(rays))
            tiles = operator.gather(bounced.radiosity, scratch.maps, rays, skip=scratch.done, **address)
            self._follow(scratch, tiles, stage, rays)
            parts.append(scratch)
        last = footprints.pooled if footprints else np.asarray
        self._finish([part.maps for part in parts], indices, todo, kinds, last, leaving)
        for part in parts:
            part.remove()

    def _storing(
        self, indices: list[int], todo: list[int], kinds: list[str], noise: float, footprints: Footprints | None
    ) -> float:
        """Seconds that maps will take, in the making and as files: told by direct light with the noise that they will have."""
        light = read_map(self.dataset.folder / map_name("direct", indices[0]))[self.dataset.covered]
        dither = light * (noise * seeds.stream(0, "storing").standard_normal(light.shape, np.float32))
        maps = [np.maximum(light + dither, 0), dither][: len(kinds)]
        filtered, threads = self.config.transport.denoise and len(kinds) == 1, self.tracer.threads

        def made(values: np.ndarray) -> np.ndarray:
            smooth = footprints.pooled(values) if footprints else values
            return denoised(self.atlas, smooth) if filtered else smooth

        size = 12 * len(kinds) * len(indices) * self.atlas.count
        writing = scratched(self.dataset.folder, size, size // _SHARE, threads) if size >= _LARGE else 0.0
        return writing + len(todo) * stored(self.dataset.folder, self.atlas, maps, made, threads)

    def _follow(self, scratch: Scratch, tiles: Iterator[int], stage: Stage, rays: Int[np.ndarray, " texels"]) -> None:
        """Follows tiles of texels; a step is a ray, since texels with few rays come first and tell little about the others."""
        upto = np.concatenate([[0], np.cumsum(np.sort(rays[rays > 0]))])
        texel, tile, there = 0, 0, scratch.done

        def told(texels: int) -> None:
            nonlocal texel, tile
            stage.advance(int(upto[texel + texels] - upto[texel]), found=tile < there)
            texel, tile = texel + texels, tile + 1

        scratch.follow(tiles, told)

    def _scratch(self, split: str, half: int, indices: list[int], **rays: int) -> Scratch:
        """Where a half of a split's maps is made."""
        key = {"dataset": self.dataset.description, "half": half, **rays}
        return Scratch(self.dataset.folder / f"{split}-{half}.part", (len(indices), self.atlas.count, 3), key)

    def _finish(
        self,
        parts: Sequence[np.ndarray],
        indices: list[int],
        todo: list[int],
        kinds: list[str],
        last: Callable[[Any], Any],
        leaving: Sequence[Leaving] = (),
    ) -> None:
        """Writes the maps: the mean of two halves and half their difference, or what `last` makes of the only part.

        What leaves bodies takes its place in them. Few rays that meet something near (transport/near.py) may reach below zero,
        which ends here: 1.5e-5 of the Cornell box's energy at 8 rays per texel, 8e-7 at 32, nothing at the default noise.
        """

        def finished(index: int) -> list[np.ndarray]:
            row = indices.index(index)
            halves = [part[row] for part in parts] if len(parts) > 1 else [last(parts[0][row])]
            for half, (texels, values) in enumerate(leaving):
                halves[half] = halves[half].copy()
                halves[half][texels] = values[row]
            return [np.maximum(sum(halves) / len(halves), 0), (halves[0] - halves[-1]) / 2][: len(halves)]

        self._write(todo, finished, kinds)

    def _facts(self, bounced: Any, operator: Any) -> dict[str, Any]:
        """What the series left out; said aloud where that matters."""
        remainder = f"{bounced.remainder:.2g}" if np.isfinite(bounced.remainder) else "unbounded"
        if self.effects.bounces < 0 and not bounced.converged:
            self.progress.warn(
                f"light was followed for {bounced.bounces} bounces and has not died away (bound on the rest: "
                f"{remainder} of each lighting's peak); lower the largest albedo"
            )
        return {"bounces": bounced.bounces, "senders": operator.senders.count, "remainder": remainder}

    def _averaged(self, operator: Any, indices: Sequence[int], half: int) -> Float32[np.ndarray, "senders columns"]:
        """Direct light of all lightings on the senders."""
        direct = self._direct(half)

        def work(index: int) -> Float32[np.ndarray, "senders 3"]:
            light = direct(index)
            if operator.inside:
                rng = seeds.stream(self.config.seed, "entering", index, half)
                light = operator.inside.entering(light, self.dataset.lightings[index], rng)
            return operator.averaged(light)

        return np.concatenate(list(self.tracer.map(work, indices)), 1)

    def _direct(self, half: int) -> Callable[[int], Float32[np.ndarray, "texels 3"]]:
        """Direct light of a lighting on the texels: as it was baked, or a second time for an independent half."""
        seed, samples = self.config.seed, self.config.transport.direct_samples
        if half == 0:
            return lambda index: read_map(self.dataset.folder / map_name("direct", index))[self.dataset.covered]
        texels = Texels.of(self.tracer, self.atlas, samples, seeds.stream(seed, "texel positions", half))
        return lambda index: texels.irradiance(self.dataset.lightings[index], seeds.stream(seed, "direct", index, half))

    def _shown(self, split: str, indices: Sequence[int], half: int) -> Float32[np.ndarray, "texels 3 lightings"]:
        """All light on the texels, of a half where there are two."""
        found, direct = np.empty((self.atlas.count, 3, len(indices)), np.float32), self._direct(half)

        def work(row: int) -> None:
            light, index = direct(indices[row]), indices[row]
            for kind in ("indirect", "noise")[: 1 + (split == "test")]:
                stored = read_map(self.dataset.folder / map_name(kind, index))[self.dataset.covered]
                light = light - stored if kind == "noise" and half else light + stored
            found[:, :, row] = light

        list(self.tracer.map(work, range(len(indices))))
        return found

    def _by_paths(self, split: str, indices: list[int], todo: list[int], kinds: list[str], stage: Stage) -> None:
        from ddprt.transport.paths import choose_samples, trace_paths

        config, halves, stream, test = self.config.transport, len(kinds), f"{split} paths", split == "test"
        given, smooth = config.test_samples if test else config.samples, not test and config.footprint > 0
        scene = self.tracer, self.scene, self.atlas, [self.dataset.lightings[index] for index in indices]
        shared: dict[str, Any] = {"seed": self.config.seed, "bounces": self.effects.bounces, "smooth": smooth}
        if given == "auto":
            given, noise = choose_samples(*scene, target=config.target_noise, stream=stream, **shared)
            stage.facts["noise_expected"] = float(f"{noise:.3g}")
            if noise > 1.5 * config.target_noise:
                other = "force gloss off" if self.effects.called("gloss") else "use the operator"
                self.progress.warn(
                    f"{given} paths per texel leave about {100 * noise:.2g} % of noise, and no more are traced "
                    f"unasked; set transport.samples, raise transport.target_noise, or {other}"
                )
        samples = max(1, given // halves)
        stage.facts["samples"] = samples * halves
        parts, paths = [], np.full(self.atlas.count, samples)
        stage.pace(halves * int(paths.sum()))
        for half in range(halves):
            scratch = self._scratch(split, half, indices, paths=samples)
            address: dict[str, Any] = {"samples": samples, "stream": f"{stream} {half}", **shared}
            self._follow(scratch, trace_paths(*scene, scratch.maps, skip=scratch.done, **address), stage, paths)
            parts.append(scratch)
        self._finish([part.maps for part in parts], indices, todo, kinds, borrowed_along(self.scene, config.footprint, samples))
        for part in parts:
            part.remove()

    def _by_reference(self, split: str, todo: list[int], kinds: list[str], stage: Stage) -> None:
        from ddprt.transport.reference import on_texels, trace_reference

        config, halves, atlas = self.config.transport, len(kinds), self.atlas
        given = config.test_samples if split == "test" else config.samples
        samples = _REFERENCE_SAMPLES if given == "auto" else max(1, given // halves)
        for index in todo:
            parts = []
            for half in range(halves):
                estimate = trace_reference(
                    self.tracer,
                    self.scene,
                    self.dataset.lightings[index],
                    on_texels(self.tracer, atlas, np.arange(atlas.count)),
                    atlas.count,
                    samples,
                    seed=seeds.number(self.config.seed, "reference bake", index, half),
                    bounces=self.effects.bounces,
                )
                parts.append(estimate.indirect)
            maps = [sum(parts) / halves, (parts[0] - parts[-1]) / 2]
            self._write([index], lambda _, maps=maps: [values.astype(np.float32) for values in maps], kinds)
            stage.advance(halves * atlas.count // len(todo))

    def _write(self, indices: Sequence[int], maps: Any, kinds: list[str]) -> None:
        """Writes the maps of lightings side by side, and names them in order."""
        filtered = self.config.transport.denoise and "noise" not in kinds  # never what scores are computed on

        def work(index: int) -> int:
            for kind, values in zip(kinds, maps(index), strict=False):
                smooth = denoised(self.atlas, values) if filtered else values
                write_map(self.dataset.folder / map_name(kind, index), self.atlas.image(smooth))
            return index

        for index in self.tracer.map(work, indices):
            for kind in kinds:
                self.manifest.add(map_name(kind, index))
