"""Datasets of an animation: an ordinary one for each keyframe, and one for each pose between them that is tested.

All share the charts of the first pose. A texel that a pose buries in a solid is left out of that pose's dataset, but another
pose may show it: together they have the texels that any keyframe shows, and where a keyframe buries one, it counts as dark,
which is what it is, with an area of nothing. Lightings are drawn anew for each pose: in use, any light meets any pose.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float32, Float64
from ddprt.config import Config
from ddprt.dataset.generate import bake, check_points
from ddprt.dataset.manifest import map_name
from ddprt.dataset.splits import SPLITS, Splits
from ddprt.dataset.store import Dataset, open_dataset, read_map
from ddprt.errors import UserError
from ddprt.lights import Lighting, load_lightings
from ddprt.progress import Progress
from ddprt.sampling.riding import Riders, place_riders
from ddprt.scene.exr import read_exr
from ddprt.scene.mesh import Scene
from ddprt.scene.poses import Animation
from ddprt.transport.effects import force
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import glossy, scattering
from ddprt.transport.openness import build_open_atlas


@dataclass(frozen=True, eq=False)
class AnimatedData:
    """What a bake of an animation leaves.

    Attributes:
      animation: what moves.
      riders: where light is measured.
      keys: the dataset of each keyframe.
      between: times that are tested, and the datasets there.
      folder: where all of them lie.
      keep_alive: whatever must live as long as they do.
    """

    animation: Animation
    riders: Riders
    keys: tuple[Dataset, ...]
    between: tuple[tuple[float, Dataset], ...]
    folder: Path
    keep_alive: Any = field(default=None, repr=False)

    @cached_property
    def covered(self) -> Bool[np.ndarray, "height width"]:
        """Texels that any keyframe shows."""
        return np.logical_or.reduce([data.covered for data in self.keys])

    @cached_property
    def albedo(self) -> Float32[np.ndarray, "texels 3"]:
        """Of these texels, each from the first keyframe that shows it."""
        image = np.zeros((*self.covered.shape, 3), np.float32)
        for data in reversed(self.keys):
            image[data.covered] = data.gbuffer["albedo"]
        return image[self.covered]

    @cached_property
    def wide(self) -> tuple["WideData", ...]:
        """The keyframes' datasets on these texels."""
        return tuple(WideData(data.folder, data.description, data.keep_alive, self.covered) for data in self.keys)


@dataclass(frozen=True, eq=False)
class WideData(Dataset):
    """A dataset on the texels of several: those that it lacks are dark and have no area.

    Attributes:
      texels: which, as an image.
    """

    texels: Any = None

    @property
    def _narrow(self) -> Dataset:
        return Dataset(self.folder, self.description, self.keep_alive)

    @cached_property
    def covered(self) -> Bool[np.ndarray, "height width"]:
        """Texels of all."""
        return np.asarray(self.texels)

    @cached_property
    def area(self) -> Float64[np.ndarray, " texels"]:
        """In this pose, m²."""
        return read_exr(self.folder / "atlas" / "area.exr")[0][..., 0][self.covered].astype(np.float64)

    @cached_property
    def exitant(self) -> Bool[np.ndarray, " texels"] | None:
        """See `Dataset`."""
        narrow = self._narrow
        if narrow.exitant is None:
            return None
        image = np.zeros(self.covered.shape, bool)
        image[narrow.covered] = narrow.exitant
        return image[self.covered]

    def maps(self, kind: str, indices: Sequence[int]) -> Float32[np.ndarray, "lightings texels 3"]:
        """See `Dataset`."""
        values = np.zeros((len(indices), int(self.covered.sum()), 3), np.float32)
        for row, index in enumerate(indices):
            values[row] = read_map(self.folder / map_name(kind, index))[self.covered]
        return values

    def packed(self) -> None:
        """Held in memory."""
        return


def bake_animation(
    animation: Animation,
    lightings: Sequence[Splits | Sequence[Lighting]] | None = None,
    *,
    config: Config,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> AnimatedData:
    """Renders pairs of direct and indirect lightmaps for every keyframe, and held-out ones between.

    Args:
      animation: from `ddprt.load_animation`.
      lightings: of each keyframe, as for `ddprt.bake`; None draws them as the configuration says, others for each pose.
      config: all settings; of `animation` what is tested between keyframes.
      out: folder; an unfinished bake of the same settings there goes on. None bakes into a temporary folder.
      progress: shown if given.
    Raises:
      UserError: settings that cannot follow a pose, or what `ddprt.bake` refuses.
    """
    refuse_still(animation.key(0), config)
    if lightings is not None and len(lightings) != animation.keys:
        raise UserError(f"lightings: got {len(lightings)}, expected those of each of {animation.keys} keyframes; pass as many")
    keep_alive = tempfile.TemporaryDirectory(prefix="ddprt-") if out is None else None
    folder = Path(keep_alive.name if keep_alive else str(out))
    riders, found, factor = _riders(animation, config), [], None
    for index in range(animation.keys):
        scene = _forced(animation.key(index), config)
        given = None if lightings is None else lightings[index]
        data = _baked(scene, riders, _of_pose(config, index, factor), given, folder / f"key-{index:02d}", progress)
        # Measured alike in every pose, since their matrices are to be mixed.
        factor = data.samples.depth / data.samples.spacing if factor is None else factor
        found.append(data)
    tested = []
    for index, time in enumerate(animation.between(config.animation.between)):
        asked = _of_pose(config, animation.keys + index, factor)
        asked, given = _held_out(asked)
        where = folder / f"between-{index:02d}"
        tested.append((time, _baked(_forced(animation.pose(time), config), riders, asked, given, where, progress)))
    return AnimatedData(animation, riders, tuple(found), tuple(tested), folder, keep_alive)


def open_animation(animation: Animation, config: Config, folder: str | Path) -> AnimatedData:
    """The finished datasets that `bake_animation` left in a folder.

    Raises:
      UserError: one is missing, or is of another scene.
    """
    folder = Path(folder)
    times = animation.between(config.animation.between)
    names = [f"key-{index:02d}" for index in range(animation.keys)] + [f"between-{index:02d}" for index in range(len(times))]
    for name in names:
        if not (folder / name / "dataset.json").is_file():
            raise UserError(f"{folder / name}: got no dataset, expected a pose; run `ddprt bake` with the same --out first")
    sets = [open_dataset(folder / name) for name in names]
    scenes = [animation.key(index) for index in range(animation.keys)] + [animation.pose(time) for time in times]
    riders = _riders(animation, config)
    for data, scene in zip(sets, scenes, strict=True):
        digest = _forced(scene, config).digest
        if data.description["scene"]["digest"] != digest or data.resolution != config.atlas.resolution:
            raise UserError(
                f"{data.folder}: got a dataset of another pose or atlas, expected those of the configuration; bake again into "
                "another --out"
            )
        if (data.samples.rest is None) != (riders.at(scene.corners).rest is None):
            raise UserError(
                f"{data.folder}: got samples of an older version, that change their point from pose to pose, expected those of "
                "the first pose; bake again into another --out"
            )
    return AnimatedData(
        animation, riders, tuple(sets[: animation.keys]), tuple(zip(times, sets[animation.keys :], strict=True)), folder
    )


def refuse_still(scene: Scene, config: Config) -> None:
    """Makes sure that nothing is asked for that cannot follow a pose.

    Raises:
      UserError: something is.
    """
    wants = {
        f'points.on = "{config.points.on}"': ("points on the surface", config.points.on != "surface"),
        "points.file": ("points that ride on the mesh", bool(config.points.file)),
        'points.choose = "qr"': ('"blue-noise"', config.points.choose != "blue-noise"),
        'lightings.choose = "active"': ('"random"', config.lightings.choose != "random"),
        "probes": ("none", bool(config.probes.asked)),
        "effects.glossy_layers": ("false", config.effects.glossy_layers and any(glossy(_forced(scene, config)))),
    }
    for key, (expected, wrong) in wants.items():
        if wrong:
            raise UserError(f"{key}: got that beside an animation, expected {expected}; set it so")


def _riders(animation: Animation, config: Config) -> Riders:
    scene = _forced(animation.key(0), config)
    size = config.atlas
    atlas, _ = build_open_atlas(Tracer.of(scene, config.transport.threads), scattering(scene), size.resolution, size.padding)
    check_points(config, scene, atlas)
    return place_riders(scene, config.points.count * config.points.supersample, seed=config.seed, atlas=atlas)


def _baked(
    scene: Scene,
    riders: Riders,
    config: Config,
    lightings: Splits | Sequence[Lighting] | None,
    out: Path,
    progress: Progress | None,
) -> Dataset:
    if progress is not None:
        progress.say(f"pose {out.name}")
    return bake(scene, lightings, config=config, out=out, progress=progress, places=riders.at(scene.corners))


def _forced(scene: Scene, config: Config) -> Scene:
    return force(scene, on=config.effects.on, off=config.effects.off)


def _of_pose(config: Config, index: int, depth: float | None) -> Config:
    """Settings of a pose: random numbers of its own, so that noise of one is not that of all."""
    points = config.points if depth is None else config.points.model_copy(update={"depth": round(depth, 9)})
    return config.model_copy(update={"seed": (config.seed + index) % 2**32, "points": points})


def _held_out(config: Config) -> tuple[Config, Splits | None]:
    """Settings of a pose that nobody learns from: one lighting each for what a dataset has to have, and all of test."""
    lightings = config.lightings
    update: dict[str, Any] = {"train": 1, "validation": 1}
    if not lightings.file:
        return config.model_copy(update={"lightings": lightings.model_copy(update=update)}), None
    listed, splits, start = load_lightings(lightings.file), {}, 0
    for name in SPLITS:
        splits[name] = listed[start : start + getattr(lightings, name)]
        start += getattr(lightings, name)
    short = {name: entries if name == "test" else entries[:1] for name, entries in splits.items()}
    return config.model_copy(update={"lightings": lightings.model_copy(update={**update, "file": ""})}), short
