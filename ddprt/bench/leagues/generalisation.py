"""Methods as configured on splits of `SPLITS`, noted in one file, which a comparison that was stopped goes on from."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ddprt.bench.leagues.contest import SCHEMA, Record, known, parts
from ddprt.bench.leagues.deals import deal, method_seed
from ddprt.bench.leagues.search import Trial, rivals
from ddprt.bench.leagues.splits import SPLITS, Side
from ddprt.bench.measure.settings import changed, digest_of
from ddprt.bench.measure.trial import environment, why
from ddprt.bench.measure.yardstick import Yardstick
from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.splits import SPLITS as PARTS
from ddprt.dataset.splits import choose_lightings
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import alone_in, append_line, make_folder
from ddprt.lights import Lighting
from ddprt.progress import Progress
from ddprt.report.metrics import Tally, Truth
from ddprt.runtime.model import Model
from ddprt.runtime.precision import stored
from ddprt.runtime.train import fit_method
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

RESULTS = "splits.jsonl"


@dataclass(eq=False)
class Generalisation:
    """Splits of one configuration.

    Attributes:
      config: with [leagues], of which methods and seeds count; settings are as configured, nothing is searched.
      data: baked by it.
      scene: what it is of.
      folder: for splits.jsonl, and datasets beside it.
      progress: shown while working.
    """

    config: Config
    data: Dataset
    scene: Scene
    folder: Path
    progress: Progress
    _known: dict[str, Record] = field(default_factory=dict)
    _baked: dict[str, Dataset] = field(default_factory=dict)
    _models: dict[str, Model] = field(default_factory=dict)

    def run(self, names: Sequence[str]) -> list[Record]:
        """Records of all sides, methods and seeds; splits and methods that cannot do it say so in words.

        Raises:
          UserError: no such method, or the folder cannot be written.
        """
        make_folder(self.folder)
        with alone_in(self.folder):
            self._known = known(self.folder / RESULTS, self.progress)
            found = []
            for name in names:
                self.progress.say(f"split {name}: {SPLITS[name].question}")
                try:
                    found += self._split(name, SPLITS[name].sides(self.config))
                except UserError as error:
                    found.append({"what": "split", "split": name, "failed": str(error)})
        return found

    def _split(self, name: str, sides: Sequence[Side]) -> list[Record]:
        """Sides of one split; datasets first, so that what hinders one of them hinders all."""
        for side in sides:
            self._check_light(side, self._truth(side))
        found = []
        with self.progress.stage(f"split {name}", len(sides) * len(rivals(self.config)) * self.config.leagues.seeds) as stage:
            for method in rivals(self.config):
                for seed in range(self.config.leagues.seeds):
                    for side in sides:
                        found.append(self._side(name, side, method, seed))
                        stage.advance(1)
                    self._models.clear()
        return found

    def _check_light(self, side: Side, truth: Yardstick) -> None:
        if truth.noise is None:
            raise UserError(f"{side.label}: none of that light gets into the scene, or there is nothing that it bounces off")

    def _side(self, name: str, side: Side, method: str, seed: int) -> Record:
        try:
            fitted = Trial(method, seed, {}).digest(self.config, self._source)
        except UserError:  # settings that it does not take: its record will say so
            fitted = digest_of([self._source, method, seed, self.config.methods.settings.get(method, {})])
        digest = digest_of([fitted, name, asdict(side)])
        key = f"side {digest}"
        if key not in self._known:
            about = {"schema": SCHEMA, "what": "side", "digest": digest, "split": name, "side": side.label, "at": side.at}
            record = {
                **about,
                "method": method,
                "seed": seed,
                **self._measured(side, method, seed),
                "environment": environment(),
            }
            append_line(self.folder / RESULTS, json.dumps(record, allow_nan=False))
            self._known[key] = record
        return self._known[key]

    def _measured(self, side: Side, method: str, seed: int) -> Record:
        try:
            model = self._model(side, method, seed)
            truth = self._truth(side)
            return {"failed": None, **parts(tally_with(model, truth, side.asked) if side.asked else truth.tally(model))}
        except (UserError, MemoryError) as error:
            return {"failed": why(error)}

    def _model(self, side: Side, method: str, seed: int) -> Model:
        key = digest_of([side.learn, side.train, side.points, method, seed])
        if key not in self._models:
            config = self.config
            points = side.points or config.fit.points or None
            dealt = deal(self._learnt(side), config.seed, seed, side.train)
            model = fit_method(
                dealt, config.fit, method, config.methods.settings.get(method, {}), points=points,
                quantity=config.points.quantity, seed=method_seed(config.seed, seed),
            )  # fmt: skip
            self._models[key] = stored(model, config.export.precision)
        return self._models[key]

    def _learnt(self, side: Side) -> Dataset:
        """What a side learns from; of held-out lightings, which nobody looks at, it has one."""
        if not side.learn:
            return self.data
        config = changed(self._plain, side.learn)
        lightings = self._lightings(config)
        return self._bake("learn", side.learn, config, {**lightings, "test": lightings["test"][:1]})

    def _truth(self, side: Side) -> Yardstick:
        """Held-out maps of a side, with rays as configured."""
        if not side.judge:
            return Yardstick(self.scene, self.data)
        config = changed(self._plain, side.judge)
        first = {name: lightings[:1] for name, lightings in self._lightings(config).items()}
        held = {**first, "test": self._lightings(config)["test"]}
        return Yardstick(self.scene, self._bake("judge", side.judge, config, held))

    def _bake(
        self, what: str, changes: Mapping[str, Any], config: Config, lightings: Mapping[str, Sequence[Lighting]]
    ) -> Dataset:
        key = digest_of([self._source, what, changes])
        if key not in self._baked:
            place = self.folder / "splits" / f"{what}-{key}"
            self._baked[key] = bake(self.scene, lightings, config=config, out=place, progress=self.progress)
        return self._baked[key]

    def _lightings(self, config: Config) -> dict[str, list[Lighting]]:
        entries, _ = choose_lightings(None, config.lightings, self.scene, self._tracer, config.seed)
        return {name: [lighting for split, lighting in entries if split == name] for name in PARTS}

    @cached_property
    def _plain(self) -> Config:
        """The configuration without a choice of lightings: each side draws its own."""
        return changed(self.config, {"lightings.choose": "random", "lightings.target_error": 0.0})

    @cached_property
    def _source(self) -> str:
        return digest_of(self.data.description)

    @cached_property
    def _tracer(self) -> Tracer:
        return Tracer.of(self.scene, self.config.transport.threads)


def asked_with(model: Model, points: int) -> Model:
    """A fitted model that is given fewer points than it was fitted with.

    Raises:
      UserError: its method takes no other number.
    """
    if not getattr(model.relighter, "any_points", False):
        raise UserError(f"{model.method}: takes the {model.points} points that it was fitted with, and no other number")
    return replace(model, points=points)


def tally_with(model: Model, truth: Yardstick, points: int) -> Tally:
    """Errors of a fitted model where all but the first points are gone; those that are left measure what they did before.

    Raises:
      UserError: its method takes no other number of points.
    """
    fewer, found = asked_with(model, points), []
    for values, index in zip(truth.measured(model), truth.held_out, strict=True):
        predicted = fewer.predict(values[:points], lightings=truth.data.lightings[index], constant=False)[None]
        found.append(Truth(truth.data.maps("indirect", [index]), truth.data.area).tally(predicted))
    return Tally.joined(found)
