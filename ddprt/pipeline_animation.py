"""The chain for what moves: bake every keyframe, fit one basis, score keyframes and what lies between, report, export."""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from ddprt import __version__
from ddprt.config import Config
from ddprt.dataset.animated import AnimatedData, bake_animation, open_animation, refuse_still
from ddprt.errors import UserError
from ddprt.files import make_folder, write_text
from ddprt.machine import machine, peak_memory_gib
from ddprt.progress import Progress
from ddprt.scene.poses import Animation, configured_animation
from ddprt.transport.effects import plan

_TYPED = {
    "forecast": "--dry-run",
    "budget": "--budget",
    "format_table": "--table",
    "ablate": "--effects",
    "sweep": "ddprt bench",
    "scene": "--leagues and --splits",
    "tune": "ddprt tune",
}
"""Steps that only a run of what stands still has, as they are asked for."""


class AnimatedRun:
    """One run folder of an animation, and the steps that fill it; see `pipeline.Run`, whose steps have the same names.

    Args:
      config: all settings.
      folder: where everything goes.
      command: as typed, for the record.
      quiet: no progress.
    """

    def __init__(self, config: Config, folder: Path, *, command: str = "", quiet: bool = False) -> None:
        self.config, self.folder, self.command = config, folder, command
        self.progress = Progress(quiet)
        self.started, self._clock = datetime.now(UTC), time.perf_counter()

    @cached_property
    def animation(self) -> Animation:
        """What moves, loaded once; repairs are told."""
        found = configured_animation(self.config)
        for note in found.scene.notes:
            self.progress.say(f"scene: {note}")
        return found

    def bake(self) -> AnimatedData:
        """Bakes (or goes on with, or finds finished) the datasets; writes the resolved configuration."""
        self._check()
        make_folder(self.folder)
        data = bake_animation(self.animation, config=self.config, out=self.folder / "dataset", progress=self.progress)
        write_text(self.folder / "config.toml", self.config.to_toml(self.folder))
        return data

    def dataset(self, *, shines: bool = False) -> AnimatedData:
        """The finished datasets of this run's folder; pictures of skies are not looked for, since nothing shines again."""
        return open_animation(self.animation, self.config, self.folder / "dataset")

    def fit(self, data: AnimatedData) -> tuple[dict[str, Any], dict[str, float]]:
        """Fits the matrices that are asked for, and saves the first; returns models and seconds by name."""
        from ddprt.runtime.train_animated import fit_animation

        if others := [name for name in self.config.methods.compare if name != "svd-ridge"]:
            self.progress.say(
                f"methods.compare: {', '.join(others)} left out: with an animation, matrices of svd-ridge are compared"
            )
        with self.progress.stage("fit svd-ridge") as stage:
            begun = time.perf_counter()
            models = fit_animation(data, self.config)
            seconds = time.perf_counter() - begun
            stage.facts["status"] = ", ".join(sorted({status for model in models.values() for status in model.statuses}))
        next(iter(models.values())).save(self.folder / "model.ddprt")
        write_text(self.folder / "config.toml", self.config.to_toml(self.folder))
        return models, dict.fromkeys(models, seconds)

    def evaluate(self, data: AnimatedData, models: Mapping[str, Any], seconds: Mapping[str, float]) -> dict[str, Any]:
        """Scores the models at keyframes and between, and writes metrics.json."""
        from ddprt.report.animated import noise, score, table

        with self.progress.stage("evaluate"):
            ways = score(data, models)
        first = data.keys[0]
        metrics = {
            "schema": 1,
            "scene": data.animation.scene.name,
            "texels": int(data.covered.sum()),
            "keys": data.animation.times.tolist(),
            "between": [time for time, _ in data.between],
            "lightings": {split: len(first.split(split)) for split in ("train", "validation", "test")},
            "noise_relative_rmse": noise(data),
            "fit_seconds": round(max(seconds.values()), 4),
            "ways": ways,
        }
        write_text(self.folder / "metrics.json", json.dumps(metrics, indent=1, allow_nan=False) + "\n")
        self.progress.say(table(ways))
        return metrics

    def report(self, data: AnimatedData, models: Mapping[str, Any], evaluation: Mapping[str, Any], **_: Any) -> Path:
        """Writes report.html."""
        from ddprt.report.animated import write_page

        with self.progress.stage("report"):
            return write_page(self.folder / "report.html", data, models, evaluation)

    def export(self, model: Any) -> list[Path]:
        """Writes what engines load."""
        from ddprt.export.animated import export_animated

        with self.progress.stage("export"):
            return export_animated(model, self.folder / "export", **self.config.export.model_dump())

    def all(self) -> dict[str, Path]:
        """Everything, and where it is."""
        data = self.bake()
        models, seconds = self.fit(data)
        report = self.report(data, models, self.evaluate(data, models, seconds))
        exported = self.export(next(iter(models.values())))
        self.record(data)
        return {
            "report": report,
            "model": self.folder / "model.ddprt",
            "metrics": self.folder / "metrics.json",
            "textures": exported[0].parent,
        }

    def record(self, data: AnimatedData) -> None:
        """Writes run.json."""
        bounces, probes = self.config.transport.bounces, self.config.probes.asked
        effects = plan(self.animation.key(0), data.keys[0].lightings, bounces=bounces, probes=probes).effects
        document = {
            "schema": 1,
            "ddprt": __version__,
            "command": self.command,
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - self._clock, 3),
            "peak_memory_gib": peak_memory_gib(),
            "seed": self.config.seed,
            "digest": self.config.digest(),
            "stages": self.progress.stages,
            "effects": [asdict(effect) for effect in effects],
            "machine": machine(),
        }
        write_text(self.folder / "run.json", json.dumps(document, indent=1, allow_nan=False) + "\n")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise UserError(
            f"{_TYPED.get(name, name)}: got an animation, expected a scene that stands still; set animation.keys = 0, or bake, "
            "fit, eval, export"
        )

    def _check(self) -> None:
        """Refuses what a run would stumble over at its end."""
        from ddprt.methods.names import check_names  # takes its time

        check_names(self.config)
        if self.config.fit.method != "svd-ridge":
            raise UserError(f'fit.method: got "{self.config.fit.method}" with an animation, expected "svd-ridge"; set it')
        refuse_still(self.animation.key(0), self.config)
        from ddprt.export.animated import check_settings

        check_settings(self.config.export.model_dump())
