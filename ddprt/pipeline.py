"""The whole chain: bake, fit, evaluate, report, export. Every step reads what the one before it left on disk."""

import json
import time
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.config import Config
from ddprt.dataset.forecast import Forecast, forecast
from ddprt.dataset.forecast_effects import belongs
from ddprt.dataset.generate import bake
from ddprt.dataset.importers.places import stored_scene
from ddprt.dataset.light_files import check_skies
from ddprt.dataset.sameness import other_settings
from ddprt.dataset.store import Dataset, open_dataset
from ddprt.errors import UserError
from ddprt.files import alone_in, make_folder, write_text
from ddprt.machine import machine, peak_memory_gib
from ddprt.progress import Progress
from ddprt.scene.files import IMPORTED
from ddprt.scene.mesh import Scene
from ddprt.transport.configured import configured_scene
from ddprt.transport.effects import Plan, plan
from ddprt.transport.glossiness import valid_integrator

_AFTER_BAKE = ("fit", "evaluate", "bases curve", "spot check", "report", "export")

# What learns and draws is imported where it is used: a bake needs no JAX and no matplotlib.


class Run:
    """One run folder, and the steps that fill it.

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
        self._scene: Scene | None = None

    @property
    def scene(self) -> Scene:
        """The scene, loaded once; its repairs are told."""
        if self._scene is None:
            self._scene = configured_scene(self.config)
            for note in self._scene.notes:
                self.progress.say(f"scene: {note}")
        return self._scene

    def _check(self) -> None:
        """Refuses what a run would stumble over at its end."""
        from ddprt.methods.names import check_names  # takes its time

        check_names(self.config)
        self._check_views()
        if self.config.export.gltf_preview:
            from ddprt.export.gltf.writing import preview_lighting

            preview_lighting(self.config.export.gltf_preview)
        if self.config.export.formats != ("exr",):
            from ddprt.export.formats.listing import check_formats

            check_formats(self.config.export.formats, self.config.atlas.resolution, self.config.atlas.resolution)

    def _check_views(self) -> None:
        if self.config.report.views:
            from ddprt.report.eyes import check_eyes

            check_eyes(self.scene, self.config.report.views, layers=self.config.effects.glossy_layers)

    def bake(self) -> Dataset:
        """Bakes (or goes on with, or finds finished) the dataset; writes the resolved configuration.

        Imported light is taken as it is.
        """
        if self.config.scene.name == IMPORTED:
            return self.dataset()
        self._check()
        scene = self.scene
        make_folder(self.folder)
        if self.config.lightings.target_error:
            from ddprt.pipeline_active import bake_to_target

            data = bake_to_target(scene, self.config, self.folder / "dataset", self.progress)
        else:
            data = bake(scene, config=self.config, out=self.folder / "dataset", progress=self.progress)
        write_text(self.folder / "config.toml", self.config.to_toml(self.folder))
        if not any(stage.get("rays") for stage in self.progress.stages):
            self._remember_bake()
        return data

    def forecast(self) -> Forecast:
        """What `bake` would take from nothing; samples of files are written beside the folder of the run, and removed."""
        begun = time.perf_counter()
        self._check()  # takes its time, as it will when the bake begins
        scene, loading = self.scene, time.perf_counter() - begun
        beside = next(path for path in self.folder.absolute().parents if path.is_dir())
        return forecast(scene, self.config, self.progress, beside=beside, loading=loading)

    def _remember_bake(self) -> None:
        """Takes the stages of the bake from an earlier run.json where this run found everything baked."""
        try:
            earlier = json.loads((self.folder / "run.json").read_text())["stages"]
        except (OSError, ValueError, KeyError):
            return
        baked = [stage for stage in earlier if not str(stage["name"]).startswith(_AFTER_BAKE)]
        self.progress.stages[:] = [{**stage, "earlier": "yes"} for stage in baked] or self.progress.stages

    def dataset(self, *, shines: bool = False) -> Dataset:
        """The finished dataset of this run's folder.

        Args:
          shines: whether its lightings are to shine again, for which the pictures of skies must be there.
        Raises:
          UserError: there is none, it is of another scene or atlas, or it lacks such a picture.
        """
        if not (self.folder / "dataset" / "dataset.json").is_file():
            raise UserError(f"{self.folder}: got no dataset, expected a run folder; run `ddprt bake` with the same --out first")
        data = open_dataset(self.folder / "dataset")
        if data.imported and self.config.scene.name == IMPORTED:
            if self.config.report.views:
                raise UserError("report.views: got some, but imported light is seen in its maps alone; leave them out")
            return data
        self._check_views()
        differs = other_settings(data.description, self.config, self.scene)
        if differs:
            name = data.description["scene"]["name"]
            raise UserError(
                f'{self.folder}: got a dataset of scene "{name}" baked otherwise ({differs}), expected '
                f'"{self.scene.name}" as configured now; bake again into another --out'
            )
        if shines:
            check_skies(data.description, data.lightings, data.folder)
        return data

    def fit(self, data: Dataset) -> tuple[dict[str, Any], dict[str, float]]:
        """Fits every method of the comparison and saves the main one; returns models and seconds by name.

        What trains leaves its JSON lines in the folder `training`, and until all are fitted, checkpoints: who was
        interrupted goes on from there.

        Raises:
          UserError: a method or setting that there is not, a method that cannot learn from this, or another process in the
            folder.
        """
        from ddprt.methods.names import check_names

        check_names(self.config)
        with alone_in(self.folder):
            return self._fitted(data)

    def _fitted(self, data: Dataset) -> tuple[dict[str, Any], dict[str, float]]:
        from ddprt.methods.statuses import NOTES, STATUSES, worst_first
        from ddprt.runtime.train import fit_config
        from ddprt.training.journal import keeping

        names = [self.config.fit.method, *(name for name in self.config.methods.compare if name != self.config.fit.method)]
        models, seconds = {}, {}
        for name in names:
            with self.progress.stage(f"fit {name}") as stage:
                start, folder = time.perf_counter(), self.folder / "training" / name
                tensorboard, every = self.config.fit.tensorboard, self.config.fit.checkpoint_seconds
                with keeping(folder, stage, tensorboard=tensorboard, every=every, anew=self.progress.warn) as kept:
                    models[name] = fit_config(data, self.config, name)
                seconds[name] = time.perf_counter() - start + kept.earlier
                stage.facts["status"] = models[name].relighter.report.status
            if name == names[0]:  # whatever becomes of those that it is compared with
                models[name].save(self.folder / "model.ddprt")
                write_text(self.folder / "config.toml", self.config.to_toml(self.folder))
        report = models[names[0]].relighter.report
        if report.bases and report.bases < self.config.fit.bases:
            self.progress.warn(
                f"fit.bases: asked for {self.config.fit.bases}, the data has rank {report.numerical_rank}: "
                f"{report.bases} are given"
            )
        remarks = {name: model.relighter.report.remarks for name, model in models.items()}
        for remark in worst_first({remark for found in remarks.values() for remark in found}):
            told = ", ".join(name for name, found in remarks.items() if remark in found)
            line = f"{told}: {remark}: {STATUSES.get(remark, '')}"
            self.progress.say(f"note: {line}") if remark in NOTES else self.progress.warn(line)
        for name, model in models.items():
            if model.relighter.report.trouble:
                self.progress.warn(f"{name}: {model.relighter.report.trouble}")
        for name in names:  # another fit is to take its own time
            for path in (self.folder / "training" / name).glob("*.safetensors"):
                path.unlink()
        return models, seconds

    def evaluate(self, data: Dataset, models: dict[str, Any], seconds: dict[str, float]) -> Any:
        """Scores the models, checks the held-out maps, and writes metrics.json."""
        from ddprt.report.evaluate import bases_curve, evaluate, spot_check

        with self.progress.stage("evaluate"):
            evaluation = evaluate(data, models, seconds)
        with self.progress.stage("bases curve"):
            evaluation.curve = bases_curve(data, self.config, evaluation.truth)
        with self.progress.stage("spot check") as stage:
            evaluation.spot_check = {} if data.imported else spot_check(self.scene, data, self.config)
            stage.facts |= {key: evaluation.spot_check[key] for key in ("rays",) if key in evaluation.spot_check}
        summary = {key: value for key, value in evaluation.spot_check.items() if key not in ("baked", "truth", "variance")}
        evaluation.metrics["spot_check"] = summary
        report = next(iter(models.values())).relighter.report
        evaluation.metrics["numerics"] |= {
            "measurement_rank": list(report.ranks),
            "ridge_second_opinion": list(report.ridge_second),
            "leave_one_out": list(report.leave_one_out),
        }
        evaluation.metrics["curve"] = [
            {"bases": bases, "relative_rmse": error, "projection_relative_rmse": floor}
            for bases, error, floor in evaluation.curve
        ]
        write_text(self.folder / "metrics.json", json.dumps(evaluation.metrics, indent=1, allow_nan=False) + "\n")
        return evaluation

    def budget(self, data: Dataset, models: dict[str, Any]) -> dict[str, Any]:
        """Takes the error of the main model apart, and writes budget.json; its bakes stay in the folder `budget`."""
        from ddprt.bench.budget.advice import record
        from ddprt.bench.budget.bakes import Bakery
        from ddprt.bench.budget.budget import measure_budget

        # What "auto" takes is told, since causes of error and knobs depend on it.
        chosen = {"integrator": valid_integrator(self.config.transport.integrator, self.scene)}
        config = self.config.model_copy(update={"transport": self.config.transport.model_copy(update=chosen)})
        bakery = Bakery(self.scene, config, data, self.folder / "budget", self.progress)
        model = next(iter(models.values()))
        document = record(measure_budget(model, bakery), model, bakery)
        write_text(self.folder / "budget.json", json.dumps(document, indent=1, allow_nan=False) + "\n")
        return document

    def report(self, data: Dataset, models: dict[str, Any], evaluation: Any, *, budget: dict[str, Any] | None = None) -> Path:
        """Writes report.html; `budget` is what `Run.budget` gave."""
        from ddprt.report.page import write_page
        from ddprt.training.journal import seconds_of

        path, trained = self.folder / "report.html", self.folder / "training"
        with self.progress.stage("report"):
            write_page(
                path,
                evaluation=evaluation,
                data=data,
                models=models,
                config=self.config,
                stages=self.progress.stages,
                scene=stored_scene(data) if data.imported else self.scene,
                plan_effects=self.effects(data).effects,
                effect_costs={str(row["name"]): row for row in self.costs(data)},
                command=self.command,
                budget=budget,
                seconds={name: seconds_of(trained / name, model.relighter.report.loss) for name, model in models.items()},
            )
        return path

    def export(self, model: Any) -> list[Path]:
        """Writes what engines load."""
        from ddprt.export.deployed import export_model
        from ddprt.export.gltf.writing import write_gltf
        from ddprt.export.layers import export_layers

        settings = self.config.export
        with self.progress.stage("export"):
            files = export_model(model, self.folder / "export", **settings.model_dump(exclude={"gltf", "gltf_preview"}))
            export_layers(model, self.folder / "export")
            imported = self.config.scene.name == IMPORTED
            write_gltf(model, self.folder / "export", settings, lambda: None if imported else self.scene)
        seams = json.loads(files[-1].read_text())["seams"]
        if self.config.export.stitch and not seams["stitched"]:
            self.progress.warn(f"export.stitch: seams stay open: {seams['why']}")
        return files

    def format_table(self, model: Any) -> str:
        """What every format of textures costs, on held-out lightings where the run has its dataset; also `formats.json`."""
        from ddprt.export.table import HeldOut, as_json, format_table, told

        held_out = None
        if (self.folder / "dataset" / "dataset.json").is_file():
            data = self.dataset()
            test = data.split("test")
            held_out = HeldOut(data.values(test, model.points, model.quantity), data.maps("indirect", test))
        with self.progress.stage("format table"):
            settings = self.config.export
            rows = format_table(model, held_out, gutter=settings.gutter, stitch=settings.stitch, refit=settings.refit)
        write_text(self.folder / "export" / "formats.json", as_json(rows))
        return told(rows)

    def sweep(self) -> list[Path]:
        """Tries settings about the configuration (`ddprt bench`); returns the results and what shows them."""
        from ddprt.bench.frontier.sweep import sweep

        return sweep(self.config, self.folder / "bench", self.progress)

    def ablate(self) -> str:
        """Bakes with each effect and without (`ddprt bench --effects`); the table, and files in the folder `bench`."""
        from ddprt.bench.effects.ablation import ablation, table

        return table(ablation(self.config, self.folder / "bench", self.progress))

    def tune(self) -> Any:
        """Searches a setting within the limits of [tune]; see `ddprt.bench.tune.search.Outcome`."""
        from ddprt.bench.tune.search import tune

        return tune(self.config, self.folder / "tune", self.progress)

    def effects(self, data: Dataset) -> Plan:
        """The plan that the dataset was baked under; empty for imported light."""
        if data.imported:
            return Plan((), 0)
        return plan(self.scene, data.lightings, bounces=self.config.transport.bounces, probes=self.config.probes.asked)

    def costs(self, data: Dataset) -> list[dict[str, Any]]:
        """The plan's effects with their rays, seconds and share of the light."""
        return [] if data.imported else _effects(self.effects(data), self.progress.stages, data)

    def all(self) -> dict[str, Path]:
        """Everything, and where it is; no textures where the method does not say how it is deployed."""
        from ddprt.runtime.deployment import refusal

        data = self.bake()
        models, seconds = self.fit(data)
        evaluation = self.evaluate(data, models, seconds)
        report = self.report(data, models, evaluation)
        main = next(iter(models.values()))
        left_out = refusal(main)
        if left_out:
            self.progress.warn(left_out)
        exported = [] if left_out else self.export(main)
        self.record(data)
        return {
            "report": report,
            "model": self.folder / "model.ddprt",
            "metrics": self.folder / "metrics.json",
            **({"textures": exported[0].parent} if exported else {}),
        }

    def record(self, data: Dataset) -> None:
        """Writes run.json."""
        stages = self.progress.stages
        document = {
            "schema": 1,
            "ddprt": __version__,
            "command": self.command,
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - self._clock, 3),
            "peak_memory_gib": peak_memory_gib(),
            "seed": self.config.seed,
            "digest": self.config.digest(),
            "stages": stages,
            "effects": self.costs(data),
            "machine": machine(),
        }
        write_text(self.folder / "run.json", json.dumps(document, indent=1, allow_nan=False) + "\n")


def _effects(effects: Plan, stages: list[dict[str, Any]], data: Dataset) -> list[dict[str, Any]]:
    """The plan with what each effect cost and what it gave.

    Shares are of all irradiance of all lightings; direct light is shared out equally among the kinds of a
    lighting's lights. None stands for what cannot be told apart: what an effect does within the stages of others, which
    `ddprt bench --effects` measures.
    """
    weight = data.area / data.area.sum()
    indices = range(len(data.lightings))
    direct = np.array([np.einsum("tc,t->", data.maps("direct", [i])[0], weight) for i in indices])
    energy: dict[str, float] = {
        "diffuse bounces": float(sum(np.einsum("tc,t->", data.maps("indirect", [i])[0], weight) for i in indices)),
        **_constant(data, weight),
    }
    for amount, lighting in zip(direct, data.lightings, strict=True):
        for light in lighting:
            kind = f"{light.kind} lights"
            energy[kind] = energy.get(kind, 0.0) + float(amount) / len(lighting)
    total, rows = sum(energy.values()), []
    for effect in effects.effects:
        own = [stage for stage in stages if belongs(str(stage["name"]), effect.name) and effect.called]
        rays, seconds = sum(int(s.get("rays", 0)) for s in own), sum(float(s["seconds"]) for s in own)
        apart = bool(own) or not effect.called
        share = energy.get(effect.name, None if effect.called else 0.0)
        rows.append(
            asdict(effect)
            | {"rays": rays if apart else None, "seconds": round(seconds, 4) if apart else None}
            | {"energy_share": share / total if share and total > 0 else share}
        )
    return rows


def _constant(data: Dataset, weight: np.ndarray) -> dict[str, float]:
    """Light that no lighting changes, of each lighting, where the dataset has some."""
    if data.constant is None:
        return {}
    return {"emission": len(data.lightings) * float(np.einsum("tc,t->", data.constant, weight))}
