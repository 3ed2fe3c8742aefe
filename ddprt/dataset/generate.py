"""Bakes a dataset: many lightings, in parallel, resumable.

What a stage needs is read back from the files of the stage before it, never from memory: an interrupted bake that goes on
gives the same bits as one that was never stopped.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ddprt import __version__, seeds
from ddprt.config import Config, checked
from ddprt.dataset import store
from ddprt.dataset.denoise import find_denoiser
from ddprt.dataset.indirect import IndirectBake
from ddprt.dataset.light_files import kept, pictures
from ddprt.dataset.manifest import Manifest, map_name
from ddprt.dataset.probes import probe_layers
from ddprt.dataset.sameness import baked_settings, counts, differences
from ddprt.dataset.scratch import remove_left
from ddprt.dataset.splits import Once, Splits, check_choice, choose_lightings, chosen, doubt, grouped
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import alone_in, write_tensors
from ddprt.lights import Lighting
from ddprt.progress import Progress
from ddprt.sampling.points import Samples, load_samples, place_samples
from ddprt.scene.atlas import Atlas
from ddprt.scene.checks import check_materials
from ddprt.scene.mesh import Scene
from ddprt.scene.own_charts import charted
from ddprt.sections import PointsConfig
from ddprt.transport.direct import Texels
from ddprt.transport.effects import Plan, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.fogginess import foggy, long_in_fog, refuse_beside_fog
from ddprt.transport.glossiness import scattering, valid_integrator
from ddprt.transport.hairiness import refuse_beside
from ddprt.transport.measure import measure
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.translucency import filled, refuse_filled

DEPTH = 0.75  # of the distance between samples: what they mistake for a constant shrinks to 1.8 %
_NAMED = 8  # doubtful lightings, or altered files, that a message spells out


def bake(
    scene: Scene,
    lightings: Sequence[Lighting] | Splits | str | None = None,
    *,
    resolution: int | None = None,
    samples: int | Literal["auto"] | None = None,
    seed: int | None = None,
    config: Config | None = None,
    out: str | Path | None = None,
    first: int | None = None,
    once: Once | None = None,
    progress: Progress | None = None,
    places: Samples | None = None,
) -> Dataset:
    """Renders pairs of direct and indirect lightmaps.

    Args:
      scene: from `ddprt.load_scene`.
      lightings: a mapping of "train", "validation" and "test" to lightings; or one list, of which the last fifth becomes test
        and the tenth before it validation; or None to draw them as the configuration says; or "active" to draw them so and
        choose those of training by what they tell (`lightings.choose`).
      resolution: texels per side of the lightmap; 256 unless given.
      samples: gather rays per texel (twice as many for held-out lightings); "auto", the default, as many as
        `config.transport.target_noise` asks for.
      seed: of all random numbers; 0 unless given.
      config: all settings at once, in place of `resolution`, `samples` and `seed`.
      out: folder; an unfinished bake of the same settings there goes on. None bakes into a temporary folder that lives as
        long as the dataset.
      first: of the training lightings that are chosen, bake only so many, the most telling; None bakes all.
      once: of several bakes with this scene and these settings, whatever their `first`: candidates are drawn and measured once.
      progress: shown if given.
      places: where light is measured, in place of samples that are distributed; of a pose, those that ride on it.
    Returns:
      The finished dataset.
    Raises:
      UserError: no lightings, all of them dark, too many points, a folder that holds another dataset or altered files or that
        another bake is working in, a setting out of its range, or a configuration together with one of the settings that it
        replaces.
    Warns:
      Doubt: lamps that light nothing, light that does not die away, noise that is not reached; where progress is shown, these
        are lines of it.
    """
    given = {
        name: value for name, value in (("resolution", resolution), ("samples", samples), ("seed", seed)) if value is not None
    }
    if config is None:
        rays = given.get("samples", "auto")
        transport = {"samples": rays, "test_samples": rays if rays == "auto" else 2 * rays}
        atlas = {"resolution": given.get("resolution", 256)}
        config = checked({"seed": given.get("seed", 0), "atlas": atlas, "transport": transport})
    elif given:
        raise UserError(f"bake: got {' and '.join(given)} beside a config, expected one or the other; set it in the config")
    check_materials(scene)
    if isinstance(lightings, str):
        if lightings != "active":
            raise UserError(f'bake: got lightings "{lightings}", expected a list, splits, "active" or none')
        asked = config.lightings.model_copy(update={"choose": "active"})
        config, lightings = config.model_copy(update={"lightings": asked}), None
    keep_alive = tempfile.TemporaryDirectory(prefix="ddprt-") if out is None else None
    folder = Path(keep_alive.name if keep_alive else str(out))
    return _Bake(scene, config, folder, progress or Progress(quiet=True), first, once or Once(), places).run(
        lightings, keep_alive
    )


def check_points(config: Config, scene: Scene, atlas: Atlas) -> None:
    """Makes sure that there are as many texels as points to distribute.

    Raises:
      UserError: there are fewer.
    """
    count = config.points.count
    if count > atlas.count:
        raise UserError(
            f'points.count: got {count}, but "{scene.name}" covers {atlas.count} texels; '
            "lower points.count or raise atlas.resolution"
        )


def sunk(samples: Samples, lightings: Sequence[Lighting], config: PointsConfig, tracer: Tracer) -> Samples:
    """Samples that are lit from behind their surface where lamps are nearer to one than samples to each other.

    Args:
      samples, tracer: where light is measured, and what occludes it.
      lightings, config: all, those that are yet to be chosen among too; of the points, whose own depth is taken if given.
    """
    depth = config.depth
    if depth == "auto":
        lamps = [place for lighting in lightings for light in lighting if (place := light.anchor()) is not None]
        asked = bool(lamps) and not config.file  # given points may stand in the open, at any distance
        depth = DEPTH if asked and tracer.clearance(np.array(lamps)).min() < samples.spacing else 0.0
    return replace(samples, depth=depth * samples.spacing)


def _records(entries: Sequence[tuple[str, Lighting]], folder: Path) -> list[dict[str, Any]]:
    return [{"split": split, "lights": kept(lighting, folder)} for split, lighting in entries]


class _Bake:
    """One bake from start to end; every stage skips what the manifest already holds."""

    def __init__(
        self,
        scene: Scene,
        config: Config,
        folder: Path,
        progress: Progress,
        first: int | None,
        once: Once,
        places: Samples | None = None,
    ) -> None:
        scene = charted(scene, config.atlas.use, config.atlas.resolution, config.atlas.padding)
        self.scene, self.config, self.folder, self.progress, self.first = scene, config, folder, progress, first
        self.places = places
        once.bind(scene.digest, config.model_dump_json(include={"seed", "atlas", "lightings", "points"}))
        self.tracer, self.once = Tracer.of(scene, config.transport.threads), once

    def run(self, given: Sequence[Lighting] | Splits | None, keep_alive: Any) -> Dataset:
        if self.config.transport.denoise:
            find_denoiser()
        check_choice(self.config, self.first)
        if foggy(self.scene):
            self._judge_fog()
        probe_layers(self.config, self.scene)  # a list of probes that cannot be read is told before the work, not after it
        with alone_in(self.folder):
            return self._alone(given, keep_alive)

    def _judge_fog(self) -> None:
        """Refuses, before anything is made, what fog cannot be simulated beside; warns of fog that takes long."""
        asked = self.config.transport
        refuse_beside_fog(plan(self.scene, (), bounces=asked.bounces, probes=self.config.probes.asked).called)
        valid_integrator(asked.integrator, self.scene)
        if (slow := long_in_fog(self.scene, asked.bounces)) is not None:
            self.progress.warn(slow)

    def _alone(self, given: Sequence[Lighting] | Splits | None, keep_alive: Any) -> Dataset:
        there = store.read_description(self.folder) if (self.folder / "dataset.json").exists() else None
        if there is not None:
            self._refuse_other(there, baked_settings(self.config, self.scene))
            self._refuse_altered()
        listed = self._listed()
        with self.progress.stage("lightings") as stage:
            config = self.config.lightings
            entries, drawn = self.once(choose_lightings, given, config, self.scene, self.tracer, self.config.seed)
            stage.facts |= {"lightings": len(entries), **drawn}
        lightings = [lighting for _, lighting in entries]
        listed = listed and self._sunk(listed, lightings)
        active = self.config.lightings.choose == "active"
        if there is not None and not active:
            points = {"points": self._points(listed)} if listed else {}
            self._refuse_other(
                there, {"counts": counts(_records(entries, self.folder)), "lightings": _records(entries, self.folder), **points}
            )
        with self.progress.stage("atlas") as stage:
            size = self.config.atlas
            atlas, hidden = build_open_atlas(self.tracer, scattering(self.scene), size.resolution, size.padding)
            stage.facts |= {} if self.scene.lightmap is None else {"charts": "the file's own"}
            stage.facts |= {"texels": atlas.count, "texels_per_metre": float(f"{atlas.texels_per_metre:.4g}"), **hidden}
        with self.progress.stage("points") as stage:
            samples = listed or self._sunk(self._placed(atlas), lightings)
            stage.facts |= {"samples": len(samples.position), "depth": round(samples.depth, 6)}
        if active or self.config.points.choose == "qr":
            with self.progress.stage("choose") as stage:
                entries, samples, shadow_rays = chosen(entries, samples, self.config, self.tracer, self.first, self.once)
                stage.facts |= {"train": sum(split == "train" for split, _ in entries), "shadow_rays": shadow_rays}
            lightings = [lighting for _, lighting in entries]
        effects = plan(self.scene, lightings, bounces=self.config.transport.bounces, probes=self.config.probes.asked)
        refuse_beside(effects.called, self.config.transport.denoise)
        description = self._description(entries, effects, drawn, samples)
        bounces = next(effect for effect in effects.effects if effect.name == "diffuse bounces")
        operator = description["transport"]["integrator"] == "operator"  # which tells what it left out, if anything
        if not operator or effects.called("emission"):
            refuse_filled(self.scene, "transport.integrator" if not effects.called("emission") else "emission")
        if bounces.bound is None and not bounces.forced and not operator:  # what else has no bound stands in the plan
            self.progress.warn(f"{bounces.name}: {bounces.why}")
        if there is None:
            (self.folder / "manifest.jsonl").unlink(missing_ok=True)  # it tells of a dataset that nobody knows any more
            store.write_description(self.folder, description)
        else:
            told = {key: value for key, value in description.items() if key not in ("ddprt", "viewpoint")}
            self._refuse_other(there, told)
        manifest = Manifest(self.folder)
        self._write_places(manifest, atlas, samples)
        dataset = Dataset(self.folder, description, keep_alive)
        self._direct(dataset, manifest, atlas, samples)
        self._judge_lightings(dataset, fresh=there is None)
        IndirectBake(self.config, self.scene, self.tracer, atlas, effects, dataset, manifest, self.progress).all()
        self._end(description)
        return dataset

    def _end(self, description: dict[str, Any]) -> None:
        """Makes sure that all is there, by the manifest on disk; what a bake killed near its end left behind goes."""
        manifest, expected = Manifest(self.folder), store.expected_files(description)
        missing = [name for name in expected if not manifest.holds(name)]
        if missing:
            raise UserError(
                f"{self.folder}: got {len(missing)} files missing at the end of the bake (first {missing[0]}), expected all "
                f"{len(expected)}; see that nothing else changes this folder, and bake again to go on"
            )
        for part in self.folder.glob("*-[01].part"):
            remove_left(part)

    def _description(
        self, entries: Sequence[tuple[str, Lighting]], effects: Plan, drawn: dict[str, int], samples: Samples
    ) -> dict[str, Any]:
        return {
            "schema": store.SCHEMA,
            "ddprt": __version__,
            **{key: value for key, value in baked_settings(self.config, self.scene).items() if value != []},
            "quantity": "irradiance",
            **({"exitant": exitant} if (exitant := self._exitant()) else {}),
            **({"fog": self.scene.fog.record} if self.scene.fog else {}),
            **({"viewpoint": self.scene.viewpoint.record} if self.scene.viewpoint else {}),
            "unit": "W/m2",
            "points": self._points(samples),
            "plan": [asdict(effect) for effect in effects.effects],
            "drawn": drawn,
            "lightings": _records(entries, self.folder),
            **({"skies": skies} if (skies := pictures([lighting for _, lighting in entries], self.folder)) else {}),
        }

    def _exitant(self) -> list[str]:
        """Materials whose texels hold what leaves them, W/m² before albedo, instead of the irradiance."""
        inside = filled(self.scene)
        return [entry.name for entry, chosen in zip(self.scene.materials, inside, strict=True) if chosen or entry.fibre]

    def _points(self, samples: Samples) -> dict[str, Any]:
        return {"count": self.config.points.count, "digest": samples.digest}

    def _refuse_other(self, there: dict[str, Any], wanted: dict[str, Any]) -> None:
        """Makes sure that what lies in the folder is, so far, this very bake."""
        differs = differences(there, wanted)
        if differs:
            raise UserError(f"{self.folder}: holds another dataset ({differs}); choose another --out, or delete that folder")

    def _refuse_altered(self) -> None:
        """Makes sure that what the bake goes on from is what was baked; files lost or cut short are made again unasked."""
        manifest = Manifest(self.folder)
        names = [name for name in manifest.entries if manifest.holds(name)]
        altered = [name for name, fits in zip(names, self.tracer.map(manifest.fits, names), strict=True) if not fits]
        if altered:
            more = f" and {len(altered) - _NAMED} more" if len(altered) > _NAMED else ""
            raise UserError(
                f"{self.folder}: got contents that differ from their hash in manifest.jsonl, expected what was baked: "
                f"{', '.join(altered[:_NAMED])}{more}; delete {'it' if len(altered) == 1 else 'them'} and bake again"
            )

    def _listed(self) -> Samples | None:
        """The points that are given, as they are or by `points.file`."""
        config = self.config.points
        if self.places is not None:
            return self.places
        if not config.file:
            return None
        samples = load_samples(config.file)
        if len(samples.position) < config.count:
            raise UserError(
                f"points.count: got {config.count}, but {config.file} has {len(samples.position)}; "
                "lower points.count or list more points"
            )
        return samples

    def _placed(self, atlas: Atlas) -> Samples:
        check_points(self.config, self.scene, atlas)
        config = self.config.points
        return place_samples(self.scene, config.count * config.supersample, on=config.on, seed=self.config.seed, atlas=atlas)

    def _sunk(self, samples: Samples, lightings: Sequence[Lighting]) -> Samples:
        return self.once(sunk, samples, lightings, self.config.points, self.tracer)

    def _write_places(self, manifest: Manifest, atlas: Atlas, samples: Samples) -> None:
        """Points, occluders and the G-buffer, unless they are there."""
        if not manifest.holds("points.safetensors"):
            spans = {"spacing": np.array([samples.spacing]), "depth": np.array([samples.depth])}
            write_tensors(self.folder / "points.safetensors", {**samples.tensors, **spans})
            manifest.add("points.safetensors")
        if not manifest.holds("scene.safetensors"):
            write_tensors(self.folder / "scene.safetensors", store.scene_tensors(self.scene, atlas))
            manifest.add("scene.safetensors")
        if not all(manifest.holds(name) for name in store.ATLAS_FILES):
            store.write_atlas(self.folder, atlas, manifest)

    def _direct(self, dataset: Dataset, manifest: Manifest, atlas: Atlas, samples: Samples) -> None:
        """Direct lightmaps and measured values, a lighting per task."""
        todo = [
            i for i in range(len(dataset.lightings)) if not all(manifest.holds(map_name(k, i)) for k in ("direct", "measured"))
        ]
        if not todo:
            return
        seed = self.config.seed
        texels = Texels.of(self.tracer, atlas, self.config.transport.direct_samples, seeds.stream(seed, "texel positions"))

        def work(index: int) -> int:
            light = texels.irradiance(dataset.lightings[index], seeds.stream(seed, "direct", index))
            store.write_map(self.folder / map_name("direct", index), atlas.image(light))
            measured = measure(
                self.tracer,
                dataset.lightings[index],
                samples.position,
                samples.normal,
                seed=seed,
                index=index,
                depth=samples.depth,
            )
            if not np.isfinite(measured).all():
                raise UserError(
                    f"lighting {index}: got light past the range of float32 at a measurement point; lower the intensities or "
                    "keep lamps off the points"
                )
            write_tensors(self.folder / map_name("measured", index), {"irradiance": measured})
            return index

        with self.progress.stage("direct", len(todo)) as stage:
            before = self.tracer.rays
            for index in self.tracer.map(work, todo):
                manifest.add(map_name("direct", index))
                manifest.add(map_name("measured", index))
                stage.advance()
            stage.facts["rays"] = self.tracer.rays - before

    def _judge_lightings(self, dataset: Dataset, fresh: bool) -> None:
        """Names lightings that light nothing or stand where no lamp should, and why; refuses a bake of darkness."""
        dark, faults = 0, dict[str, str]()

        def is_black(index: int) -> bool:
            return not store.read_map(self.folder / map_name("direct", index)).any()

        lit = zip(dataset.lightings, self.tracer.map(is_black, range(len(dataset.lightings))), strict=True)
        for index, (lighting, black) in enumerate(lit):
            dark += black
            why = doubt(lighting, black, self.scene, self.tracer)
            if why:
                faults[f"{index} ({dataset.description['lightings'][index]['split']})"] = why
        if dark == len(dataset.lightings):
            if fresh:  # nothing in it is worth keeping, and it would be in the way of the next try
                store.discard(self.folder)
            raise UserError(
                f"lightings: all {dark} light nothing, expected light on the scene; {grouped(faults, 1)}; "
                "check positions, directions and intensities"
            )
        if faults:
            self.progress.warn(f"{len(faults)} doubtful lightings: {grouped(faults, _NAMED)}")
