"""The closed loop: bakes chosen lightings in growing groups, fits after each, and stops when the error is low enough.

The groups are beginnings of one list, so what is baked does not depend on how the fits went, only on how far they had to go.
Each group is tried in a dataset of its own whose training and validation maps are the finished ones to the bit; its held-out
maps, which nothing looks at, are next to free. The finished dataset is then what baking its list at once would have made.
"""

import shutil
from pathlib import Path

from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.splits import Once
from ddprt.dataset.store import Dataset, read_description
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.scene.mesh import Scene
from ddprt.sections import ProbesConfig

FIRST_GROUP = 16
"""Lightings of the first group; each group is twice the one before."""
_FEWEST = 2  # rays per texel of held-out maps that nothing looks at


def bake_to_target(scene: Scene, config: Config, folder: Path, progress: Progress) -> Dataset:
    """Bakes as many chosen lightings as `lightings.target_error` asks for, at most `lightings.train`.

    A bake that was interrupted goes on; a finished one is kept where it meets the target.

    Args:
      scene: to bake.
      config: all settings, with a target above 0.
      folder: of the dataset; groups are tried in a folder beside it, which goes at the end.
      progress: is told how each group did.
    Raises:
      UserError: see `bake`; the folder holds a dataset that does not meet the target, and stopped short of all lightings.
    """
    target, sizes = config.lightings.target_error, group_sizes(config.lightings.train)
    trials = folder.with_name(f"{folder.name}.trials")
    count, once = _begun(folder, sizes), Once()
    if count is None:
        count = sizes[-1]
        fewest = config.transport.model_copy(update={"test_samples": _FEWEST})
        bare = config.effects.model_copy(update={"glossy_layers": False})  # nothing looks at what is beside their lightmaps
        rough = config.model_copy(update={"transport": fewest, "probes": ProbesConfig(), "effects": bare})
        for size in sizes[:-1]:
            trial = bake(scene, config=rough, out=trials / f"{size:06d}", first=size, once=once, progress=progress)
            if _told(trial, config, progress) <= target:
                count = size
                break
    data = bake(scene, config=config, out=folder, first=count, once=once, progress=progress)
    error = _told(data, config, progress)
    if error > target and count < sizes[-1]:
        raise UserError(
            f"{folder}: holds {count} training lightings with a validation error of {error:.3g}, expected at most {target:g}; "
            "choose another --out, or delete that folder"
        )
    if error > target:
        progress.warn(
            f"lightings.target_error: got {error:.3g} with all {count} training lightings, expected at most {target:g}; "
            "raise lightings.train, fit.bases, points.count or the target"
        )
    shutil.rmtree(trials, ignore_errors=True)
    return data


def group_sizes(most: int) -> list[int]:
    """16, 32, 64 and so on below `most`, then `most`."""
    sizes, size = [], FIRST_GROUP
    while size < most:
        sizes.append(size)
        size *= 2
    return [*sizes, most]


def validation_error(data: Dataset, config: Config) -> float:
    """Relative RMSE on the validation split of what `fit.method` makes of a dataset; infinite where its maps are black."""
    from ddprt.report.metrics import Truth
    from ddprt.runtime.train import fit_config

    model, held = fit_config(data, config, config.fit.method), data.split("validation")
    lightings, values = [data.lightings[index] for index in held], data.values(held, model.points, config.points.quantity)
    light = model.predict(values, lightings=lightings, constant=False)
    truth = Truth(data.maps("indirect", held), data.area)
    error = truth.relative_rmse(light - truth.reference)
    return float("inf") if error is None else error


def _told(data: Dataset, config: Config, progress: Progress) -> float:
    """The validation error, with a line of progress."""
    count = len(data.split("train"))
    with progress.stage(f"fit {count} lightings") as stage:
        error = validation_error(data, config)
        stage.facts |= {"validation_relative_rmse": float(f"{error:.4g}"), "target": config.lightings.target_error}
    return error


def _begun(folder: Path, sizes: list[int]) -> int | None:
    """How many training lightings a dataset that lies in the folder has; None where there is none."""
    if not (folder / "dataset.json").exists():
        return None
    splits = [entry["split"] for entry in read_description(folder).get("lightings", [])]
    return splits.count("train") if splits.count("train") in sizes else sizes[-1]
