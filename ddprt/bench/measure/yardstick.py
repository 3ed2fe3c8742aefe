"""One held-out truth that models of any atlas, points and method are scored on, so that settings of a sweep compare.

A truth per setting would measure different things: coarse atlases hide what they blur, and their noise and their lightings
differ. So one dataset is baked once, finer in noise than any setting asks for. A model measures its own points under the
held-out lightings and predicts its own lightmap; where that is another one, it is looked up bilinearly, as an engine does,
wherever the reference has a texel. Held-out maps are read and scored one after another, so that memory is that of a few.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from threadpoolctl import threadpool_limits

from ddprt import seeds
from ddprt.axes import Float32, Float64
from ddprt.config import Config
from ddprt.dataset.generate import bake
from ddprt.dataset.splits import SPLITS, choose_lightings
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.report.evaluate import projected
from ddprt.report.metrics import Maps, Tally, Truth, below_and_above, jitter, share_below
from ddprt.report.perceived import flip, pu21_psnr, pu21_squares
from ddprt.report.view import View, default_camera, look_up, take_view
from ddprt.runtime.model import Model
from ddprt.sampling.light_path import light_path
from ddprt.scene.atlas import Atlas, weights_at
from ddprt.scene.mesh import Scene
from ddprt.sections import PointsConfig
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas

_PIXELS = 320  # height of the pictures
_FEWEST = 3  # frames that flicker can be told of
_AT_ONCE = 16  # maps that are projected together


def make_yardstick(
    scene: Scene, config: Config, folder: str | Path, progress: Progress | None = None, *, resolution: int = 0
) -> "Yardstick":
    """Bakes what all settings are scored on, or finds it baked; an interrupted bake goes on.

    Held-out lightings are those that a bake of `config` has. To them come the frames of a path about the first one
    (`bench.path_frames`), which only flicker is told of. Points and training maps, which nobody uses, are the fewest allowed.
    Held-out lightings are drawn whatever `lightings.choose` says, so bases that choose theirs and that do not share a truth.

    Args:
      scene: what is lit.
      config: the base configuration of a sweep.
      folder: for the dataset.
      progress: shown if given.
      resolution: texels per side, for a sweep of finer atlases; never fewer than the configuration has.
    Raises:
      UserError: one or two frames, or whatever hinders a bake.
    """
    frames = config.bench.path_frames
    if 0 < frames < _FEWEST:
        raise UserError(f"bench.path_frames: got {frames}, expected 0 or at least {_FEWEST}; raise it, or set it to 0")
    drawn = config.lightings.model_copy(update={"choose": "random", "target_error": 0.0})
    config = config.model_copy(update={"lightings": drawn})
    tracer = Tracer.of(scene, config.transport.threads)
    splits = {name: lightings[: None if name == "test" else 1] for name, lightings in _lightings(scene, config, tracer).items()}
    path = light_path(splits["test"][0], tracer.clearance, frames, seed=config.seed) if frames else ()
    changes: dict[str, Any] = {
        "atlas": config.atlas.model_copy(update={"resolution": max(resolution, config.atlas.resolution)})
    }
    changes |= {"points": PointsConfig(count=1, supersample=1, depth=0.0), "transport": _transport(config)}
    given = splits | {"test": [*splits["test"], *path]}
    data = bake(scene, given, config=config.model_copy(update=changes), out=folder, progress=progress)
    return Yardstick(scene, data, frames, config.bench.pictures)


def _lightings(scene: Scene, config: Config, tracer: Tracer) -> dict[str, list[Any]]:
    """Lightings of each split, of which training and validation may be cut short."""
    settings = config.lightings
    if not settings.file:  # each is drawn by itself, so fewer of the others leave the held-out ones alone
        settings = settings.model_copy(update={"train": 1, "validation": 1})
    entries, _ = choose_lightings(None, settings, scene, tracer, config.seed)
    return {name: [lighting for split, lighting in entries if split == name] for name in SPLITS}


def _transport(config: Config) -> Any:
    """Held-out maps as finely as `bench.noise` asks, training maps as cheaply as can be."""
    cheap = {"samples": 1, "footprint": 0.0, "adaptive": False, "denoise": False}
    fine: dict[str, Any] = {"target_noise": config.bench.noise}
    if config.transport.integrator != "reference":  # it knows no target, and goes by the samples that it is told
        fine["test_samples"] = "auto"
    return config.transport.model_copy(update=cheap | fine)


@dataclass(frozen=True, eq=False)
class Yardstick:
    """Held-out maps, and everything that scores of a model need besides the model.

    Attributes:
      scene: what they are of.
      data: the dataset; its test split holds the held-out lightings, then the frames of the light path.
      frames: how many of these there are.
      pictures: held-out lightings that the camera sees, the first ones.
    """

    scene: Scene
    data: Dataset
    frames: int = 0
    pictures: int = 0
    _measured: dict[tuple[str, float, int, str], np.ndarray] = field(default_factory=dict, init=False, repr=False)
    _carried: dict[tuple[int, ...], csr_matrix] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def held_out(self) -> list[int]:
        """Indices of the held-out lightings in the dataset."""
        return self.data.split("test")[: -self.frames or None]

    @cached_property
    def path(self) -> list[int]:
        """Indices of the frames of the light path."""
        return self.data.split("test")[len(self.held_out) :]

    @threadpool_limits.wrap(limits=1, user_api="blas")  # so that scores are the same bits on any number of cores
    def score(self, model: Model) -> dict[str, Any]:
        """Everything that settings are compared by.

        Args:
          model: of this scene; any atlas, points, method.
        Returns:
          relative_rmse, relative_mse, psnr_db, psnr_peak, energy_bias, median_lighting_relative_rmse and the same with p90 and
          worst: as in metrics.json (`Tally.scores`). pu21_psnr_db and flip: see `ddprt.report.perceived`; flip_reason says
          why there is no flip, empty where there is. negative_share: of the model's own lightmap before the clamp. flicker:
          jitter along the light path beyond the truth's own, over its mean; None without a path. unseen_lightings: how many
          have indirect light that no measurement point sees. A number that does not exist is None.
        Raises:
          UserError: the model is of another scene, or of a version that kept no lightmap coordinates.
        """
        values, own = self.measured(model), model.area / model.area.sum()
        tallies, perceived, energies, pictures, unseen = [], [], [], [], 0
        for row, index in enumerate(self.held_out):
            truth = self._truth(index)
            unclamped = model.predict(values[row], lightings=self.data.lightings[index], clamp=False, constant=False)[None]
            predicted = self._carry(model, np.maximum(unclamped, 0))
            tallies.append(truth.tally(predicted))
            perceived.append(pu21_squares(predicted, truth.reference, truth.weight))
            energies.append(below_and_above(unclamped, own))
            unseen += bool(truth.squares[0] > 0 and not values[row].any())
            if row < self.pictures:
                pictures.append((self._picture(predicted[0]), self._picture(truth.reference[0])))
        flipped, reason = flip(pictures, self.view.alpha) if pictures else (None, "bench.pictures = 0")
        negative = share_below(np.concatenate(energies, 1))
        return {
            **Tally.joined(tallies).scores(),
            "pu21_psnr_db": pu21_psnr(np.concatenate(perceived)),
            "flip": flipped,
            "flip_reason": reason,
            "negative_share": negative if np.isfinite(negative) else None,
            "flicker": self._flicker(model, values[len(self.held_out) :]) if self.frames else None,
            "unseen_lightings": unseen,
        }

    @threadpool_limits.wrap(limits=1, user_api="blas")
    def tally(self, model: Model) -> Tally:
        """The errors of `score` alone, lighting by lighting; quicker.

        Raises:
          UserError: as for `score`.
        """
        values, tallies = self.measured(model), []
        for row, index in enumerate(self.held_out):
            predicted = model.predict(values[row], lightings=self.data.lightings[index], constant=False)[None]
            tallies.append(self._truth(index).tally(self._carry(model, predicted)))
        return Tally.joined(tallies)

    @cached_property
    def noise(self) -> float | None:
        """Relative RMSE that the truth's own noise makes: of half differences; None where it is black."""
        return self._pooled(self.data.maps("noise", [index]) for index in self.held_out)

    @threadpool_limits.wrap(limits=1, user_api="blas")
    def projection(self, model: Model) -> float | None:
        """Relative RMSE of the best possible coefficients; None for models without a basis, or where the truth is black.

        A basis of another atlas is carried over first, which is what its light would be; in gamma space that is a close
        estimate, since there the powers would have to be taken before.
        """
        basis = getattr(model.relighter, "basis", None)
        if basis is None:
            return None
        vectors, texels = np.asarray(basis, np.float64), len(model.area)
        vectors = vectors[vectors.any(1)]  # one that is cut short keeps its shape
        mean = np.asarray(getattr(model.relighter, "mean", 0.0), np.float64)
        values = self.measured(model)

        def over(entries: Float64[np.ndarray, "rows entries"]) -> Float64[np.ndarray, "rows others"]:
            return self._carry(model, entries.reshape(len(entries), texels, -1)).reshape(len(entries), -1)

        vectors = over(vectors) if len(vectors) else vectors
        mean = over(mean.reshape(1, -1))[0] if mean.size > 1 else mean

        def differences() -> Iterator[Maps]:
            for first in range(0, len(self.held_out), _AT_ONCE):
                some = slice(first, min(first + _AT_ONCE, len(self.held_out)))
                reference = self.data.maps("indirect", self.held_out[some])
                if not len(vectors):
                    yield from reference[:, None]
                    continue
                light = projected(model.encoding, vectors, mean, values[some], reference, self.data.area)
                yield from (light - reference)[:, None]

        return self._pooled(differences())

    def measured(self, model: Model) -> Float32[np.ndarray, "lightings points 3"]:
        """Light at a model's points under the held-out lightings and the frames of the path, W/m²; measured once.

        Raises:
          UserError: the model is of another scene.
        """
        if model.scene["digest"] != self.scene.digest:
            raise UserError(
                f'model: got one of scene "{model.scene["name"]}" ({model.scene["digest"]}), expected "{self.scene.name}" '
                f"({self.scene.digest}); score it on a yardstick of its own scene"
            )
        key = model.samples.digest, model.samples.spacing, model.points, model.quantity
        if key not in self._measured:
            indices = [*self.held_out, *self.path]
            self._measured[key] = model.measure_all([self.data.lightings[index] for index in indices])
        return self._measured[key]

    def _truth(self, index: int) -> Truth:
        return Truth(self.data.maps("indirect", [index]), self.data.area)

    def _pooled(self, differences: Iterator[Maps]) -> float | None:
        """Relative RMSE of differences from the held-out maps, one after another."""
        tallies = []
        for index, difference in zip(self.held_out, differences, strict=True):
            truth = self._truth(index)
            tallies.append(replace(truth.tally(truth.reference), error=truth.per_lighting(difference)))
        return Tally.joined(tallies).scores()["relative_rmse"]

    def _flicker(self, model: Model, values: Float32[np.ndarray, "frames points 3"]) -> float | None:
        """`Truth.flicker` of the path, a frame at a time."""
        means = []

        def differences() -> Iterator[Float32[np.ndarray, "texels 3"]]:
            for index, frame in zip(self.path, values, strict=True):
                truth = self._truth(index)
                means.append(truth.means)
                predicted = model.predict(frame, lightings=self.data.lightings[index], constant=False)[None]
                yield (self._carry(model, predicted) - truth.reference)[0]

        unsteady = jitter(differences(), self.data.area / self.data.area.sum())
        mean = float(np.mean(means))
        return unsteady / mean if mean > 0 else None

    @cached_property
    def view(self) -> View:
        """What the scene's default camera sees of the reference's lightmap."""
        return take_view(Tracer.of(self.scene), self.uv, self.data.covered, default_camera(self.scene), _PIXELS)

    def _picture(self, light: Float32[np.ndarray, "texels 3"]) -> np.ndarray:
        """Radiosity that the camera sees, W/m²."""
        return self.view.render(self.data.gbuffer["albedo"] * light)

    @property
    def uv(self) -> Float64[np.ndarray, "triangles 3 2"]:
        """Lightmap coordinates of the scene's triangles."""
        if self.data.uv is None:
            raise UserError(f"{self.data.folder}: got a dataset without lightmap coordinates; delete it and bake again")
        return self.data.uv

    @cached_property
    def atlas(self) -> Atlas:
        """The reference's lightmap, with the pieces of surface that its texels are made of."""
        settings = self.data.description["atlas"]
        atlas, _ = build_open_atlas(Tracer.of(self.scene), self.scene, settings["resolution"], settings["padding"])
        if not (np.array_equal(atlas.uv, self.uv) and np.array_equal(atlas.slot >= 0, self.data.covered)):
            raise UserError(f"{self.data.folder}: got another lightmap than this version makes; delete it and bake again")
        return atlas

    def _carry(self, model: Model, maps: np.ndarray) -> np.ndarray:
        """Maps (lightings, texels, channels) of a model on the texels of the reference; as they are where both are alike."""
        if model.uv is None:
            raise UserError("model: got one of an older version, which kept no lightmap coordinates; fit it again")
        if np.array_equal(model.covered, self.data.covered) and np.array_equal(model.uv, self.uv):
            return maps
        key = (*model.covered.shape, seeds.digest(model.covered), seeds.digest(model.uv))
        if key not in self._carried:
            self._carried[key] = carrier(self.atlas, self.scene, model.uv, model.covered)
        return np.stack([self._carried[key] @ values for values in maps]).astype(maps.dtype)


def carrier(atlas: Atlas, scene: Scene, uv: Float64[np.ndarray, "triangles 3 2"], covered: np.ndarray) -> csr_matrix:
    """From the texels of one lightmap to those of another: a sparse matrix whose rows sum to 1.

    A texel holds the mean light of the pieces of triangles inside it. Each piece is looked up in its middle, bilinearly, with
    weights renormalised over the covered texels about it, and counts by its area. So what is linear in the coordinates of a
    chart is carried exactly, but for texels next to the chart's rim.

    Args:
      atlas: to which.
      scene: what both unwrap.
      uv, covered: from which; see `Atlas.uv`.
    """
    face = atlas.piece_triangle
    middle = atlas.piece_corners.mean(1, dtype=np.float64)
    weights = weights_at(scene.corners[face] - atlas.centre, middle)
    place = np.einsum("nc,ncd->nd", weights, uv[face])
    share = atlas.piece_area / np.bincount(atlas.piece_texel, atlas.piece_area, atlas.count)[atlas.piece_texel]
    return look_up(place, atlas.piece_texel, share, atlas.count, covered)
