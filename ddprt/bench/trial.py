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

from ddprt import __version__
from ddprt.bench.settings import Setting
from ddprt.bench.timing import peak_memory, timed
from ddprt.bench.yardstick import Yardstick, make_yardstick
from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.splits import SPLITS, choose_lightings
from ddprt.dataset.store import Dataset, open_dataset
from ddprt.files import write_text
from ddprt.machine import commit, machine
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.progress import Progress
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config
from ddprt.scene.files import load_scene
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

SCHEMA = 1
_TOLD = "baked.json"  # what a bake took, beside its dataset
_HELD_OUT = "indirect test"
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
        return load_scene(self.config.scene.name, **self.config.scene.parameters)

    @cached_property
    def yardstick(self) -> Yardstick:
        """The truth, baked when it is first asked for."""
        place = self.folder / f"truth-{max(self.resolution, self.config.atlas.resolution)}"
        return make_yardstick(self.scene, self.config, place, self.progress, resolution=self.resolution)

    def bake(self, setting: Setting) -> tuple[Dataset, dict[str, Any]]:
        """The training data of a setting, and what baking them took; held-out maps, which nobody uses, are one and coarse.

        A bake that was cut off begins anew, since a part of it says nothing about the seconds of the whole. The atlas, which is
        unwrapped once per scene and resolution and then found in the cache, is told among the stages but not counted.

        Raises:
          UserError: whatever hinders a bake.
        """
        folder = self._dataset(setting)
        told = folder / _TOLD
        if told.is_file():
            return open_dataset(folder), json.loads(told.read_text("utf-8"))
        shutil.rmtree(folder, ignore_errors=True)
        config, lightings = self._training_only(setting.config)
        scene = load_scene(config.scene.name, **config.scene.parameters)
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
        write_text(told, json.dumps(record) + "\n")
        return data, record

    def forget(self, setting: Setting) -> None:
        """Deletes the training data of a setting."""
        shutil.rmtree(self._dataset(setting), ignore_errors=True)

    def forget_all(self) -> None:
        """Deletes all training data, and the truth."""
        for folder in (self.folder / "datasets", *self.folder.glob("truth-*")):
            shutil.rmtree(folder, ignore_errors=True)

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
        """The same with a single coarse held-out lighting."""
        coarse = config.transport.model_copy(update={"test_samples": 2})
        lightings = config.lightings.model_copy(update={"test": 1})
        if not config.lightings.file:  # every lighting is drawn by itself
            return config.model_copy(update={"transport": coarse, "lightings": lightings}), None
        tracer = Tracer.of(self.scene, config.transport.threads)
        entries, _ = choose_lightings(None, config.lightings, self.scene, tracer, config.seed)
        splits = {name: [lighting for split, lighting in entries if split == name] for name in SPLITS}
        return config.model_copy(update={"transport": coarse}), splits | {"test": splits["test"][:1]}


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
    measured = data.values(data.split("train"), model.points, model.quantity)
    many = measured[: min(len(measured), 16)]
    _, frame = timed(lambda: model.predict(measured[0]), _SHORT * repeats)
    _, batch = timed(lambda: model.predict(many), repeats)
    coefficients = None
    if isinstance(model.relighter, LinearTransfer):
        values = measured[0]
        _, timing = timed(_hundred(lambda: model.coefficients(values)), _SHORT * repeats)
        coefficients = timing.each(100).record()
    return {"frame": frame.record(), "batch": {**batch.record(), "frames": len(many)}, "coefficients": coefficients}


def _hundred(work: Callable[[], Any]) -> Callable[[], None]:
    """A hundred calls, since one is about as short as the clock's own."""

    def run() -> None:
        for _ in range(100):
            work()

    return run


def environment() -> dict[str, Any]:
    """What a measurement depends on besides its setting."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"ddprt": __version__, "commit": commit(), "when": now, "machine": machine()}
