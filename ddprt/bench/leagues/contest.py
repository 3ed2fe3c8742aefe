"""Every method's trials, fitted once and noted in one file, which a contest that was stopped goes on from.

Validation lightings choose; held-out ones are looked at when the search of a method and seed has ended, and only with what
was chosen.
"""

import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ddprt.bench.leagues.deals import deal, lit_by, method_seed, tally
from ddprt.bench.leagues.search import BASELINE, Trial, rivals, trials_of
from ddprt.bench.leagues.standings import LEAGUES, Budgets, budgets_of, chosen
from ddprt.bench.measure.settings import digest_of
from ddprt.bench.measure.timing import compiling
from ddprt.bench.measure.trial import environment, frame_seconds, measured_here, why
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import append_line, write_text
from ddprt.progress import Progress
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_method
from ddprt.scene.mesh import Scene
from ddprt.training.journal import keeping, seconds_of
from ddprt.transport.embree import Tracer

SCHEMA = 1
RESULTS = "leagues.jsonl"
_SHORT = 2.0  # seconds below which a fit is done twice: what the first one waits for is not all told as compiling

Record = dict[str, Any]


@dataclass(eq=False)
class Contest:
    """The trials of all methods on one dataset.

    Attributes:
      config: with [leagues].
      data: baked once.
      scene: what it is of.
      folder: for leagues.jsonl.
      progress: shown while working.
    """

    config: Config
    data: Dataset
    scene: Scene
    folder: Path
    progress: Progress
    _known: dict[str, Record] = field(default_factory=dict)
    _models: dict[str, Model] = field(default_factory=dict)

    @cached_property
    def source(self) -> str:
        """Hash of the data."""
        return digest_of(self.data.description)

    def run(self) -> list[Record]:
        """Trials and tests of this configuration, those that were noted before among them.

        Raises:
          UserError: the baseline cannot be fitted, no such method, or the file cannot be written.
        """
        self._known = known(self.folder / RESULTS, self.progress)
        for left in self.folder.glob(".fit-*"):  # of one that was killed
            shutil.rmtree(left, ignore_errors=True)
        names, seeds = rivals(self.config), range(self.config.leagues.seeds)
        searches = {(name, seed): trials_of(self.config, name, seed) for name in names for seed in seeds}
        first = [self._tried(searches[BASELINE, seed][0]) for seed in seeds]
        if failed := next((record["failed"] for record in first if record["failed"]), None):
            raise UserError(f"leagues: got a baseline that cannot be fitted, expected one to compare with: {failed}")
        budgets = budgets_of(self.config.leagues, first)
        found: dict[str, Record] = {}
        with self.progress.stage("leagues", sum(map(len, searches.values()))) as stage:
            for trials in searches.values():
                records = []
                for trial in trials:
                    records.append(self._tried(trial))
                    stage.advance(1)
                best = self._picked(records, budgets)
                for record in (*records, *(self._tested(trial, record) for trial, record in zip(trials, records, strict=True)
                                           if record["digest"] in best)):  # fmt: skip
                    found[f"{record['what']} {record['digest']}"] = record
                self._models.clear()
        return [self.header, *found.values()]

    @cached_property
    def header(self) -> Record:
        """What the records are of: the held-out lightings and their lights."""
        lit = lit_by(self.data, self.data.split("test"), Tracer.of(self.scene, self.config.transport.threads))
        return {"schema": SCHEMA, "what": "data", "digest": self.source, "scene": self.scene.name, "lightings": lit}

    def model(self, trial: Trial) -> Model:
        """The model of a trial as it ships: kept from its fit, or fitted again to the same bits."""
        digest = trial.digest(self.config, self.source)
        if digest not in self._models:
            self._models[digest] = self._fitted(trial)[0]
        return self._models[digest]

    def _picked(self, records: list[Record], budgets: Budgets) -> set[str]:
        best = (chosen(records, league, budgets) for league in LEAGUES)
        return {record["digest"] for record in best if record is not None}

    def _tried(self, trial: Trial) -> Record:
        """The record of a trial; noted, unless it was before."""
        try:
            digest = trial.digest(self.config, self.source)
        except UserError as error:  # e.g. settings that do not go together
            digest, failed = digest_of([self.source, trial.method, trial.seed, trial.settings]), self._failed(error)
            return self._noted("trial", digest, trial, lambda: failed)
        return self._noted("trial", digest, trial, lambda: self._measured(trial, digest))

    def _failed(self, error: BaseException) -> Record:
        return {"failed": why(error), "environment": environment()}

    def _measured(self, trial: Trial, digest: str) -> Record:
        try:
            model, took = self._fitted(trial)
        except (UserError, MemoryError) as error:
            return self._failed(error)
        self._models[digest] = model
        dealt = deal(self.data, self.config.seed, trial.seed)
        scores = tally(model, dealt, "validation").scores()
        report = model.relighter.report
        return {
            "failed": None if scores["relative_rmse"] is not None else "got black validation lightings, expected light",
            "validation": scores["relative_rmse"],
            "bytes": shipped_bytes(model, self.config.export.precision),
            "flops": model.relighter.flops,
            **took,
            "bases": report.bases,
            "status": report.status,
            "trouble": report.trouble,
            "environment": environment(),
        }

    def _fitted(self, trial: Trial) -> tuple[Model, Record]:
        """The model as it ships, and seconds of its training; its looks at validation by seconds, where it is trained."""
        whole = trial.configured(self.config)
        dealt = deal(self.data, self.config.seed, trial.seed)
        seconds: list[float] = []
        curve: list[list[float]] = []
        spent = [0.0]
        for turn in range(2):
            with tempfile.TemporaryDirectory(prefix=".fit-", dir=self.folder) as place:
                begun = time.perf_counter()
                with compiling() as waited, keeping(place, every=float("inf")):
                    model = fit_method(
                        dealt, whole.fit, trial.method, whole.methods.settings[trial.method], points=whole.fit.points or None,
                        quantity=whole.points.quantity, seed=method_seed(self.config.seed, trial.seed),
                    )  # fmt: skip
                seconds.append(max(time.perf_counter() - begun - waited[0], 1e-6))
                looks = model.relighter.report.loss
                curve = [[at, look[2]] for at, look in zip(seconds_of(Path(place), looks), looks, strict=False)]
            spent = waited if not turn else spent
            if seconds[-1] > _SHORT:
                break
        took = {"seconds": round(min(seconds), 5), "compile": round(spent[0], 3), "curve": curve}
        return stored(model, self.config.export.precision), took

    def _tested(self, trial: Trial, record: Record) -> Record:
        """What a chosen trial comes to on the held-out lightings; looked at once."""

        def look() -> Record:
            model = self.model(trial)
            found = tally(model, self.data, "test")
            timing = frame_seconds(model, self.data, self.config.bench.repeats)["frame"]
            return {**parts(found), "failed": None, "frame": timing, "environment": environment()}

        return self._noted("test", record["digest"], trial, look)

    def _noted(self, what: str, digest: str, trial: Trial, work: Callable[[], Record]) -> Record:
        key = f"{what} {digest}"
        if key not in self._known:
            about = {"schema": SCHEMA, "what": what, "digest": digest, "method": trial.method, "seed": trial.seed}
            record = {**about, "settings": trial.settings, **work()}
            append_line(self.folder / RESULTS, json.dumps(record, allow_nan=False))
            if what == "trial":
                told = record["failed"] or f"validation error {record['validation']:.4g} in {record['seconds']:.3g} s"
                self.progress.say(f"{trial.method}, seed {trial.seed}, {spoken(trial.settings)}: {told}")
            self._known[key] = record
        return self._known[key]


def parts(found: Tally) -> Record:
    """What errors of any lightings can be pooled from, and the pooled one."""
    return {
        "relative_rmse": found.scores()["relative_rmse"],
        "error": [float(value) for value in found.error],
        "squares": [float(value) for value in found.squares],
        "mean": [float(value) for value in found.mean.mean(1)],
    }


def spoken(settings: Mapping[str, Any]) -> str:
    """Settings of a trial in words."""
    told = (f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {value}" for key, value in settings.items())
    return ", ".join(told) or "as configured"


def known(path: Path, progress: Progress) -> dict[str, Record]:
    """Whole records of a machine and version like these, by what they are of; the last one of each.

    Half a line, which whoever was killed left behind, goes from the file.
    """
    lines = path.read_text("utf-8").splitlines() if path.is_file() else []
    records = [_from_json(line) for line in lines]
    if None in records:
        write_text(path, "".join(f"{line}\n" for line, record in zip(lines, records, strict=True) if record is not None))
    found = [record for record in records if _whole(record)]
    if len(found) < len(lines):
        progress.say(
            f"{path.name}: {len(found)} of {len(lines)} lines are whole and of this machine and version; others do not count"
        )
    return {f"{record['what']} {record['digest']}": record for record in found}


def _from_json(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _whole(record: Any) -> bool:
    if not isinstance(record, dict) or record.get("schema") != SCHEMA or not isinstance(record.get("environment"), dict):
        return False
    return {"what", "digest", "failed"} <= set(record) and measured_here(record["environment"])


def forget(folders: Iterable[Path]) -> None:
    """Deletes datasets that only a comparison needed."""
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
