"""One setting, really tried: baked, fitted, timed, and scored on the truth that all settings share."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.bench.measure.settings import Setting, digest_of
from ddprt.bench.measure.timing import peak_memory, timed
from ddprt.bench.measure.yardstick import Yardstick, make_yardstick
from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.splits import SPLITS, choose_lightings
from ddprt.dataset.store import Dataset, open_dataset
from ddprt.errors import UserError
from ddprt.files import sha256, write_text
from ddprt.lights import Lighting
from ddprt.machine import commit, machine
from ddprt.methods.names import check_names
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.progress import Progress
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config
from ddprt.scene.mesh import Scene
from ddprt.transport.configured import configured_scene
from ddprt.transport.embree import Tracer

SCHEMA = 1
_TOLD = "baked.json"  # what a bake took, beside its dataset
_HELD_OUT = "indirect test"
_TRAINING = ("samples", "target_noise", "footprint", "adaptive", "denoise", "threads")  # settings that no held-out map knows
_MACHINE = ("processor", "cores", "system")  # alike where seconds may be compared
_SHORT = 20  # times as many repeats of what takes microseconds


@dataclass(frozen=True, eq=False)
class Workshop:
    """Where settings are tried.

    Attributes:
      config: the one that all settings are about.
      folder: holds the truth and the datasets.
      progress: shown while working.
      resolution: of the truth, at least; for sweeps of finer atlases.
    """

    config: Config
    folder: Path
    progress: Progress
    resolution: int = 0

    @cached_property
    def scene(self) -> Scene:
        """The scene of the configuration."""
        return configured_scene(self.config)

    @cached_property
    def truth(self) -> str:
        """Hash of all that scores depend on besides the model: those of another truth do not compare."""
        config = self.config
        document = config.model_dump(mode="json", include={"seed", "atlas", "lightings", "transport"})
        document["atlas"]["resolution"] = max(self.resolution, config.atlas.resolution)
        for unused in (*_TRAINING, *(() if config.transport.integrator == "reference" else ("test_samples",))):
            document["transport"].pop(unused)
        for unused in ("choose", "candidates", "target_error", *(() if config.lightings.file else ("train", "validation"))):
            document["lightings"].pop(unused)
        asked = config.bench.model_dump(mode="json", include={"noise", "path_frames", "pictures"})
        return digest_of([document, asked, self.scene.digest, _contents(config.lightings.file)])

    @cached_property
    def yardstick(self) -> Yardstick:
        """The truth, baked when it is first asked for.

        Raises:
          UserError: it is black, or whatever hinders a bake.
        """
        place = self.folder / f"truth-{self.truth}"
        found = make_yardstick(self.scene, self.config, place, self.progress, resolution=self.resolution)
        if found.noise is None:
            raise UserError(
                "lightings: got held-out lightings without indirect light, expected some to score on; "
                "raise transport.bounces, or move the lights"
            )
        return found

    def sources(self, config: Config) -> str:
        """Hash of the scene and of the files that a configuration names, which may change under the same names."""
        return digest_of([self.scene.digest, _contents(config.lightings.file), _contents(config.points.file)])

    def check(self, config: Config) -> None:
        """Makes sure of what can be known before a bake.

        Raises:
          UserError: a method or setting that there is none of, another scene than the truth's, or a bake that needs fits.
        """
        check_names(config)
        if config.scene != self.config.scene:
            raise UserError(
                f'scene: got "{config.scene.name}", expected that of the configuration, "{self.config.scene.name}", '
                "which all are scored on; give it a sweep of its own"
            )
        if config.lightings.target_error:
            raise UserError(
                f"lightings.target_error: got {config.lightings.target_error:g}, expected 0, since settings are baked whole; "
                "set lightings.train instead"
            )

    def bake(self, setting: Setting) -> tuple[Dataset, dict[str, Any]]:
        """The training data of a setting, and what baking them took; held-out maps, which nobody uses, are one and coarse.

        A bake that was cut off begins anew, since a part of it says nothing about the seconds of the whole, and so does one of
        another version, machine or content of files. The atlas, which is unwrapped once per scene and resolution and then found
        in the cache, is told among the stages but not counted.

        Raises:
          UserError: whatever hinders a bake.
        """
        self.check(setting.config)
        folder, sources = self._dataset(setting), self.sources(setting.config)
        before = _told_of(folder)
        if before and before["sources"] == sources and measured_here(before["environment"]):
            return open_dataset(folder), before["bake"]
        shutil.rmtree(folder, ignore_errors=True)
        config, lightings = self._training_only(setting.config)
        scene = configured_scene(config)
        progress = Progress(self.progress.quiet)
        progress.say(f"bake: {setting.name}")
        with peak_memory() as peak:
            begun = time.perf_counter()
            data = bake(scene, lightings, config=config, out=folder, progress=progress)
            whole = time.perf_counter() - begun
        stages = {str(stage["name"]): float(stage["seconds"]) for stage in progress.stages}
        record = {
            "seconds": round(whole - stages.pop(_HELD_OUT, 0.0) - stages["atlas"], 4),
            "stages": stages,
            "rays": sum(int(stage.get("rays", 0)) for stage in progress.stages if stage["name"] != _HELD_OUT),
            "bytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
            "peak_gib": peak[0],
        }
        write_text(folder / _TOLD, json.dumps({"bake": record, "sources": sources, "environment": environment()}) + "\n")
        return data, record

    def forget(self, setting: Setting) -> None:
        """Deletes the training data of a setting."""
        shutil.rmtree(self._dataset(setting), ignore_errors=True)

    def forget_all(self, *, but_truth: bool = False) -> None:
        """Deletes all training data, and every truth, or those that are not of this configuration."""
        kept = {self.folder / f"truth-{self.truth}"} if but_truth else set()
        for folder in (self.folder / "datasets", *({*self.folder.glob("truth-*")} - kept)):
            shutil.rmtree(folder, ignore_errors=True)

    def holds(self, record: dict[str, Any], setting: Setting) -> bool:
        """Whether a setting was measured on this truth, from these files, by this version, on a machine like this, as often."""
        return (
            record.get("schema") == SCHEMA
            and not record.get("failed", True)
            and record.get("truth") == self.truth
            and record.get("sources") == self.sources(setting.config)
            and record.get("repeats", 0) >= self.config.bench.repeats
            and measured_here(record["environment"])
        )

    def fit(self, setting: Setting, data: Dataset, repeats: int) -> tuple[Model, dict[str, Any]]:
        """The model of a setting as it ships, and what fitting it took."""
        config = setting.config
        with peak_memory() as peak:
            model, timing = timed(lambda: fit_config(data, config, config.fit.method), repeats)
        return stored(model, config.export.precision), {**timing.record(), "peak_gib": peak[0]}

    def measure(self, setting: Setting) -> dict[str, Any]:
        """All that `ddprt bench` tells of a setting.

        Raises:
          UserError: whatever hinders a bake or a fit.
        """
        repeats, config = self.config.bench.repeats, setting.config
        data, baked = self.bake(setting)
        model, fitted = self.fit(setting, data, repeats)
        report = model.relighter.report
        return {
            **about(setting),
            "failed": None,
            "truth": self.truth,
            "sources": self.sources(config),
            "repeats": repeats,  # that were asked for; of what takes long fewer are made
            "scores": self.yardstick.score(model),
            "floors": {
                "noise_relative_rmse": self.yardstick.noise,
                "projection_relative_rmse": self.yardstick.projection(model),
            },
            "bake": baked,
            "fit": fitted,
            **frame_seconds(model, data, repeats),
            "bytes": shipped_bytes(model, config.export.precision),
            "flops": model.relighter.flops,
            "bases": report.bases,
            "method": config.fit.method,
            "status": report.status,
            "remarks": list(report.remarks),
            "environment": environment(),
        }

    def _dataset(self, setting: Setting) -> Path:
        return self.folder / "datasets" / setting.bake_digest

    def _training_only(self, config: Config) -> tuple[Config, Any]:
        """The same with a single coarse held-out lighting, or the fewest that leave `points.depth` what it is with all.

        That depth goes by the nearest of all lamps, so where a held-out one is the nearest, its lighting has to be there.
        """
        tracer = Tracer.of(self.scene, config.transport.threads)
        drawn = config.lightings.model_copy(update={"choose": "random"}) if not config.lightings.file else config.lightings
        entries, _ = choose_lightings(None, drawn, self.scene, tracer, config.seed)
        splits = {name: [lighting for split, lighting in entries if split == name] for name in SPLITS}
        held = [_nearest(lighting, tracer) for lighting in splits["test"]]
        others = min(_nearest(lighting, tracer) for name in SPLITS if name != "test" for lighting in splits[name])
        nearest = int(np.argmin(held)) if min(held) < others else 0
        update: dict[str, Any] = {"transport": config.transport.model_copy(update={"test_samples": 2})}
        if config.lightings.file:
            return config.model_copy(update=update), splits | {"test": splits["test"][nearest : nearest + 1]}
        update["lightings"] = config.lightings.model_copy(update={"test": nearest + 1})  # every lighting is drawn by itself
        return config.model_copy(update=update), None


def about(setting: Setting) -> dict[str, Any]:
    """What a setting is, without having tried it."""
    return {
        "schema": SCHEMA,
        "digest": setting.digest,
        "digest_bake": setting.bake_digest,
        "name": setting.name,
        "changes": setting.changes,
        "config": setting.config.to_toml(),
    }


def frame_seconds(model: Model, data: Dataset, repeats: int) -> dict[str, Any]:
    """Seconds of one frame, of many at once, and of the coefficients alone (None for methods that have none)."""
    indices = data.split("train")[:16]
    many, lightings = data.values(indices, model.points, model.quantity), [data.lightings[index] for index in indices]
    _, frame = timed(lambda: model.predict(many[0], lightings=lightings[0]), _SHORT * repeats)
    _, batch = timed(lambda: model.predict(many, lightings=lightings), repeats)
    coefficients = None
    if isinstance(model.relighter, LinearTransfer):
        values = many[0]
        _, timing = timed(_hundred(lambda: model.coefficients(values)), _SHORT * repeats)
        coefficients = timing.each(100).record()
    return {"frame": frame.record(), "batch": {**batch.record(), "frames": len(many)}, "coefficients": coefficients}


def _hundred(work: Callable[[], Any]) -> Callable[[], None]:
    """A hundred calls, since one is about as short as the clock's own."""

    def run() -> None:
        for _ in range(100):
            work()

    return run


def why(error: BaseException) -> str:
    """What hindered a setting, in words."""
    return str(error) if isinstance(error, UserError) else "got too little memory, expected enough for this setting; lower it"


def measured_here(there: dict[str, Any]) -> bool:
    """Whether an `environment` has this version and a machine like this; seconds of another say nothing here."""
    here, machine_there = machine(), there.get("machine")
    alike = isinstance(machine_there, dict) and all(machine_there.get(key) == here[key] for key in _MACHINE)
    return alike and there.get("ddprt") == __version__


def _told_of(folder: Path) -> dict[str, Any] | None:
    """What a bake noted beside its dataset; None where there is nothing, or somebody spoilt it."""
    try:
        before = json.loads((folder / _TOLD).read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    kinds = {"bake": dict, "sources": str, "environment": dict}
    whole = isinstance(before, dict) and all(isinstance(before.get(key), kind) for key, kind in kinds.items())
    return before if whole and isinstance(before["bake"].get("seconds"), float) else None


def _nearest(lighting: Lighting, tracer: Tracer) -> float:
    """Metres from the nearest lamp to a surface; infinite for lights that stand nowhere."""
    places = [place for light in lighting if (place := light.anchor()) is not None]
    return float(tracer.clearance(np.array(places)).min()) if places else float("inf")


def _contents(file: str) -> str:
    """Hash of a file; empty where there is none, which whoever reads it will tell."""
    return sha256(Path(file)) if file and Path(file).is_file() else ""


def environment() -> dict[str, Any]:
    """What a measurement depends on besides its setting."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"ddprt": __version__, "commit": commit(), "when": now, "machine": machine()}
