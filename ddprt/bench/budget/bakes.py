"""The bakes that a budget of error is measured with: a truth, a bake next to free of noise, and lightings in abundance.

Each lies in a folder of its own under a name that tells its settings, goes on where it was interrupted, and stays: the same
budget asked for again finds it. What other settings left there goes.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.config import Config, checked
from ddprt.dataset.generate import DEPTH, bake
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.lights import Lighting, lighting_json
from ddprt.progress import Progress
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

_UNBIASED = ("paths", "reference")


@dataclass(frozen=True, eq=False)
class Yardsticks:
    """What a budget is measured with.

    Attributes:
      clean: next to no noise, by the integrator of the run; its training lightings are those of the run, then others of the
        same distribution; its held-out ones are those that the error is taken apart on.
      truth: the same held-out lightings by unbiased paths; `clean` itself where the run is unbiased.
      elsewhere: as many lightings as `clean` trains on, of the held-out ones' distribution; None where that is the same.
      train: how many training lightings the run has.
    """

    clean: Dataset
    truth: Dataset
    elsewhere: Dataset | None
    train: int

    def halves(self, data: Dataset) -> tuple[np.ndarray, np.ndarray]:
        """The held-out maps of a bake as its two independent halves, W/m²."""
        test = data.split("test")
        light, noise = data.maps("indirect", test), data.maps("noise", test)
        return light + noise, light - noise

    def unseen(self) -> list[tuple[Dataset, list[int]]]:
        """What the best transfer is fitted on: lightings as held out that the run has not trained on, and those held out.

        Where no lightings abound, those of validation are all that the run has not trained on besides.

        The held-out ones are among them so that what it leaves of theirs is orthogonal to what it answers: in least squares
        that holds for the lightings that are fitted, and for others only but for the fit's own luck.
        """
        clean, held_out = self.clean, (self.clean, self.clean.split("test"))
        if self.elsewhere is not None:
            return [(self.elsewhere, self.elsewhere.split("train")), held_out]
        return [(clean, clean.split("train")[self.train :] or clean.split("validation")), held_out]

    def bounded(self, data: Dataset, count: int) -> Dataset:
        """A bake with its first so many training lightings alone."""
        kept = data.split("train")[:count]
        entries = [
            entry if entry["split"] != "train" or index in kept else {**entry, "split": "spare"}
            for index, entry in enumerate(data.description["lightings"])
        ]
        return replace(data, description={**data.description, "lightings": entries})


@dataclass(frozen=True, eq=False)
class Bakery:
    """Bakes for a budget, beside the dataset of a run.

    Attributes:
      scene, config, data: of the run.
      folder: where the bakes go.
      progress: told of every bake.
    """

    scene: Scene
    config: Config
    data: Dataset
    folder: Path
    progress: Progress

    def yardsticks(self) -> Yardsticks:
        """All that the chain needs.

        Raises:
          UserError: the lightings come from a file that holds out too few, or stands beside a scenario.
        """
        budget, integrator = self.config.budget, self.config.transport.integrator
        train, validation = (self._own(split) for split in ("train", "validation"))
        if self.config.lightings.file:
            count, held_out = len(train), self._held_out_of_file(len(validation))
        else:
            count, held_out = len(train) * budget.abundance, self._drawn("test", budget.lightings, scenario=True)
        abundant = [*train, *self._drawn("abundance", count - len(train))]
        # The unbiased integrators share one truth; the slower of them only traces what the faster would.
        unbiased = integrator in _UNBIASED
        quiet = {"target_noise": budget.noise, "samples": "auto", "test_samples": "auto", "footprint": 0.0, "denoise": False}
        clean_settings = quiet | {"integrator": "paths" if unbiased else "operator"}
        clean = self.bake(
            "clean", {"train": abundant, "validation": validation, "test": held_out}, transport=clean_settings, pinned=True
        )
        few = {"train": train[:1], "validation": validation[:1]}
        elsewhere = None
        if budget.scenario:
            there = {**few, "train": self._drawn("abundance", count, scenario=True), "test": held_out[:1]}
            elsewhere = self.bake("scenario", there, transport=clean_settings | {"test_samples": 2}, pinned=True)
        if unbiased:
            return Yardsticks(clean, clean, elsewhere, len(train))
        paths = {"integrator": "paths", "samples": 1, "test_samples": budget.truth_samples}
        # Halves take the noise s of a truth out of every square but for about 2 s² / sqrt(texels), which is to be at most the
        # square of the noise that counts as none.
        noise = min(1.0, budget.noise * (clean.covered.sum() / 4) ** 0.25)
        settings = paths | {"target_noise": float(noise)}
        truth = self.bake("truth", {**few, "test": held_out}, transport=settings, pinned=True)
        return Yardsticks(clean, truth, elsewhere, len(train))

    def bake(
        self,
        name: str,
        lightings: Mapping[str, Sequence[Lighting]],
        *,
        config: Config | None = None,
        transport: dict[str, Any],
        pinned: bool = False,
    ) -> Dataset:
        """A bake of given lightings; what is not said is as in the run, the depth of its samples included.

        Args:
          name: of its folder.
          lightings: by split.
          config: another than the run's.
          transport: settings that differ from it.
          pinned: measured at the points of the run also where these are chosen by its training lightings.
        """
        splits = None
        if pinned and self.config.points.choose == "qr":
            lightings, splits = self._chosen_by_own(lightings)
        config = config or self.config
        depth = DEPTH if self.data.samples.depth > 0 else 0.0
        depth = depth if config.points.depth == "auto" else config.points.depth
        config = checked(
            {
                **config.model_dump(include={"seed", "scene", "atlas", "points", "fit"}),
                "transport": config.transport.model_dump() | transport,
                "points": config.points.model_dump() | {"depth": depth},
                "effects": {"glossy_layers": False},
            }
        )
        records = {split: [lighting_json(lighting) for lighting in listed] for split, listed in lightings.items()}
        settings = config.model_dump(mode="json", include={"seed", "atlas", "points", "transport"})
        settings["transport"].pop("threads")
        key = json.dumps([__version__, self.scene.digest, settings, records], sort_keys=True)
        place = self.folder / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
        for other in self.folder.glob(f"{name}-*"):
            if other != place:
                shutil.rmtree(other)
        self.progress.say(f"budget: {name}: {', '.join(f'{len(rows)} {split}' for split, rows in records.items())} lightings")
        baked = bake(self.scene, lightings, config=config, out=place, progress=self.progress)
        if splits is None:
            return baked
        entries = [{**entry, "split": split} for entry, split in zip(baked.description["lightings"], splits, strict=True)]
        return replace(baked, description={**baked.description, "lightings": entries})

    def more(self, count: int, *, scenario: bool = False) -> list[Lighting]:
        """Training lightings beyond those of the run, the first of the abundant ones; or of the scenario's."""
        return self._drawn("abundance", count, scenario=scenario)

    def _chosen_by_own(self, lightings: Mapping[str, Sequence[Lighting]]) -> tuple[dict[str, list[Lighting]], list[str]]:
        """The same lightings so that a bake trains on those of the run alone, which choose its points, and what each is for.

        What else is to be trained on stands among those of validation, of which a bake of its own makes no other use.
        """
        train, own = [*lightings["train"]], self._own("train")
        kept = len(own) if train[: len(own)] == own else len(train) if train == own[: len(train)] else 0
        given = {"train": own, "validation": [*train[kept:], *lightings["validation"]], "test": [*lightings["test"]]}
        splits = ["train"] * kept + ["spare"] * (len(own) - kept) + ["train"] * (len(train) - kept)
        splits += ["validation"] * len(lightings["validation"]) + ["test"] * len(lightings["test"])
        return given, splits

    def _held_out_of_file(self, validation: int) -> list[Lighting]:
        """Those that the file of the lightings holds out, `budget.lightings` of them at most."""
        config = self.config
        if config.budget.scenario:
            raise UserError(
                f"budget.scenario: got {config.budget.scenario} beside lightings.file {config.lightings.file}, expected none, "
                "since it describes how lightings are drawn; leave one of the two out"
            )
        found = self._own("test")[: config.budget.lightings]
        points = config.fit.points or config.points.count
        if validation + len(found) <= points:
            raise UserError(
                f"lightings.file: got {validation} + {len(found)} of {config.lightings.file} for validation and test, expected "
                f"more than the {points} points, since the best that these can tell is fitted on lightings that were "
                "not trained on, and no more of a file's kind can be drawn; share out more of the file to lightings.test and "
                "raise budget.lightings, or lower fit.points"
            )
        return found

    def _own(self, split: str) -> list[Lighting]:
        return [self.data.lightings[index] for index in self.data.split(split)]

    def _drawn(self, split: str, count: int, *, scenario: bool = False) -> list[Lighting]:
        """Lightings of the run's distribution, or of the scenario's; without one, held-out ones begin with the run's own."""
        settings = self.config.lightings.model_dump()
        if scenario:
            settings |= self.config.budget.scenario
        tracer = Tracer.of(self.scene, self.config.transport.threads)
        drawn = draw_lightings(
            checked({"lightings": settings}).lightings,
            split,
            count,
            bounds=self.scene.bounds,
            clearance=tracer.clearance,
            seed=self.config.seed,
        )
        return list(drawn.lightings)
