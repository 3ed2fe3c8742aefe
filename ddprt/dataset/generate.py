"""Bakes a dataset: many lightings, in parallel, resumable.

What a stage needs is read back from the files of the stage before it, never from memory: an interrupted bake that goes on
gives the same bits as one that was never stopped.
"""

import shutil
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
from ddprt.dataset.splits import SPLITS, Splits, choose_lightings, doubt
from ddprt.dataset.store import Dataset, Manifest, map_name
from ddprt.errors import UserError
from ddprt.files import write_tensors
from ddprt.lights import Lighting, lighting_json
from ddprt.progress import Progress
from ddprt.sampling.points import Samples, load_samples, place_samples
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import on_texels, texel_irradiance
from ddprt.transport.effects import Plan, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure
from ddprt.transport.openness import build_open_atlas

DEPTH = 0.75  # of the distance between samples: what they mistake for a constant shrinks to 1.8 %
_NAMED = 8  # doubtful lightings that a warning spells out


def bake(
    scene: Scene,
    lightings: Sequence[Lighting] | Splits | None = None,
    *,
    resolution: int | None = None,
    samples: int | Literal["auto"] | None = None,
    seed: int | None = None,
    config: Config | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Renders pairs of direct and indirect lightmaps.

    Args:
      scene: from `ddprt.load_scene`.
      lightings: a mapping of "train", "validation" and "test" to lightings; or one list, of which the last fifth becomes test
        and the tenth before it validation; or None to draw them as the configuration says.
      resolution: texels per side of the lightmap; 256 unless given.
      samples: gather rays per texel (twice as many for held-out lightings); "auto", the default, as many as
        `config.transport.target_noise` asks for.
      seed: of all random numbers; 0 unless given.
      config: all settings at once, in place of `resolution`, `samples` and `seed`.
      out: folder; an unfinished bake of the same settings there goes on. None bakes into a temporary folder that lives as
        long as the dataset.
      progress: shown if given.
    Returns:
      The finished dataset.
    Raises:
      UserError: no lightings, all of them dark, too many points, a folder that holds another dataset, a setting out of its
        range, or a configuration together with one of the settings that it replaces.
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
    keep_alive = tempfile.TemporaryDirectory(prefix="ddprt-") if out is None else None
    folder = Path(keep_alive.name if keep_alive else str(out))
    return _Bake(scene, config, folder, progress or Progress(quiet=True)).run(lightings, keep_alive)


def baked_settings(config: Config, scene: Scene) -> dict[str, Any]:
    """What a dataset depends on besides its lightings and points."""
    transport = config.transport.model_dump(exclude={"threads"})
    return {
        "scene": {"name": scene.name, "digest": scene.digest, "notes": list(scene.notes)},
        "atlas": config.atlas.model_dump(),
        "seed": config.seed,
        "transport": transport | {"integrator": "operator" if transport["integrator"] == "auto" else transport["integrator"]},
        "placing": config.points.model_dump(exclude={"quantity"}),
    }


def other_settings(description: dict[str, Any], config: Config, scene: Scene) -> list[str]:
    """Names of the settings in which a baked dataset differs from a configuration; empty where it is the same."""
    wanted: dict[str, Any] = baked_settings(config, scene)
    if not config.lightings.file:
        splits = [entry["split"] for entry in description["lightings"]]
        wanted["counts"] = {name: getattr(config.lightings, name) for name in SPLITS}
        description = {**description, "counts": {name: splits.count(name) for name in SPLITS}}
    return [name for name, value in wanted.items() if description.get(name) != value]


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


class _Bake:
    """One bake from start to end; every stage skips what the manifest already holds."""

    def __init__(self, scene: Scene, config: Config, folder: Path, progress: Progress) -> None:
        self.scene, self.config, self.folder, self.progress = scene, config, folder, progress
        self.tracer = Tracer.of(scene, config.transport.threads)

    def run(self, given: Sequence[Lighting] | Splits | None, keep_alive: Any) -> Dataset:
        if self.config.transport.denoise:
            find_denoiser()
        with self.progress.stage("lightings") as stage:
            entries, drawn = choose_lightings(given, self.config.lightings, self.scene, self.tracer, self.config.seed)
            stage.facts |= {"lightings": len(entries), **drawn}
        effects = plan(self.scene, [lighting for _, lighting in entries], bounces=self.config.transport.bounces)
        if self.config.transport.integrator in ("paths", "reference"):  # the operator tells what it left out, if anything
            for effect in effects.effects:
                if effect.bound is None and not effect.forced:
                    self.progress.warn(f"{effect.name}: {effect.why}")
        with self.progress.stage("atlas") as stage:
            settings = self.config.atlas
            atlas, hidden = build_open_atlas(self.tracer, self.scene, settings.resolution, settings.padding)
            stage.facts |= {"texels": atlas.count, "texels_per_metre": round(atlas.texels_per_metre, 3), **hidden}
        with self.progress.stage("points") as stage:
            samples = self._sunk(self._samples(atlas), [lighting for _, lighting in entries])
            stage.facts |= {"samples": len(samples.position), "depth": round(samples.depth, 6)}
        description = self._description(entries, effects, drawn, samples)
        fresh = self._claim(description)
        manifest = Manifest(self.folder)
        self._write_places(manifest, atlas, samples)
        dataset = Dataset(self.folder, description, keep_alive)
        self._direct(dataset, manifest, atlas, samples)
        self._judge_lightings(dataset, fresh)
        indirect = IndirectBake(self.config, self.scene, self.tracer, atlas, effects, dataset, manifest, self.progress)
        indirect.run("train", dataset.split("train") + dataset.split("validation"))
        indirect.run("test", dataset.split("test"))
        return dataset

    def _description(
        self, entries: Sequence[tuple[str, Lighting]], effects: Plan, drawn: dict[str, int], samples: Samples
    ) -> dict[str, Any]:
        return {
            "schema": store.SCHEMA,
            "ddprt": __version__,
            **baked_settings(self.config, self.scene),
            "quantity": "irradiance",
            "unit": "W/m2",
            "points": {"count": self.config.points.count, "digest": samples.digest},
            "plan": [asdict(effect) for effect in effects.effects],
            "drawn": drawn,
            "lightings": [{"split": split, "lights": lighting_json(lighting)} for split, lighting in entries],
        }

    def _claim(self, description: dict[str, Any]) -> bool:
        """Writes dataset.json (True), or makes sure that what lies there is this very bake (False)."""
        if not (self.folder / "dataset.json").exists():
            store.write_description(self.folder, description)
            return True
        there = store.read_description(self.folder)
        differs = [key for key in description if key != "ddprt" and there.get(key) != description[key]]
        if differs:
            name = there.get("scene", {}).get("name")
            raise UserError(
                f'{self.folder}: holds another dataset (scene "{name}"; {", ".join(differs)} differ); '
                "choose another --out, or delete that folder"
            )
        return False

    def _samples(self, atlas: Atlas) -> Samples:
        config = self.config.points
        if config.file:
            samples = load_samples(config.file)
            if len(samples.position) < config.count:
                raise UserError(
                    f"points.count: got {config.count}, but {config.file} has {len(samples.position)}; "
                    "lower points.count or list more points"
                )
        else:
            check_points(self.config, self.scene, atlas)
            count = config.count * config.supersample
            samples = place_samples(self.scene, count, on=config.on, seed=self.config.seed, atlas=atlas)
        return samples

    def _sunk(self, samples: Samples, lightings: Sequence[Lighting]) -> Samples:
        """Samples that are lit from behind their surface where lamps are nearer to one than samples to each other."""
        depth = self.config.points.depth
        if depth == "auto":
            lamps = [place for lighting in lightings for light in lighting if (place := light.anchor()) is not None]
            asked = bool(lamps) and not self.config.points.file  # given points may stand in the open, at any distance
            near = asked and self.tracer.clearance(np.array(lamps)).min() < samples.spacing
            depth = DEPTH if near else 0.0
        return replace(samples, depth=depth * samples.spacing)

    def _write_places(self, manifest: Manifest, atlas: Atlas, samples: Samples) -> None:
        """Points, occluders and the G-buffer, unless they are there."""
        if not manifest.holds("points.safetensors"):
            spans = {"spacing": np.array([samples.spacing]), "depth": np.array([samples.depth])}
            tensors = {"position": samples.position, "normal": samples.normal, "albedo": samples.albedo}
            write_tensors(self.folder / "points.safetensors", {**tensors, **spans})
            manifest.add("points.safetensors")
        if not manifest.holds("scene.safetensors"):
            write_tensors(self.folder / "scene.safetensors", {"corners": self.scene.corners, "uv": atlas.uv})
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
        places = on_texels(self.tracer, atlas, self.config.transport.direct_samples, seeds.stream(seed, "texel positions"))

        def work(index: int) -> int:
            light = texel_irradiance(self.tracer, atlas, dataset.lightings[index], places, seeds.stream(seed, "direct", index))
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
        faults, dark = [], 0

        def is_black(index: int) -> bool:
            return not store.read_map(self.folder / map_name("direct", index)).any()

        lit = zip(dataset.lightings, self.tracer.map(is_black, range(len(dataset.lightings))), strict=True)
        for index, (lighting, black) in enumerate(lit):
            dark += black
            why = doubt(lighting, black, self.scene, self.tracer)
            if why:
                faults.append(f"{index} ({dataset.description['lightings'][index]['split']}): {why}")
        if dark == len(dataset.lightings):
            if fresh:  # nothing in it is worth keeping, and it would be in the way of the next try
                shutil.rmtree(self.folder)
            raise UserError(
                f"lightings: all {dark} light nothing, expected light on the scene; the first: {faults[0]}; "
                "check positions, directions and intensities"
            )
        if faults:
            more = f"; and {len(faults) - _NAMED} more" if len(faults) > _NAMED else ""
            self.progress.warn(f"{len(faults)} doubtful lightings: {'; '.join(faults[:_NAMED])}{more}")
