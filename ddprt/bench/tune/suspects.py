"""Held-out lightings that are drawn where an error is likely to be large, and what each of them counts for.

Where a few lightings in a hundred make most of a mean square, those drawn at random mostly lack them: nothing that is computed
from 24 of these tells what is missing. But which lightings they are is known before a map is baked. What a ridge map does not
know of a lighting x after its training lightings is the variance of a Gaussian process with the kernel x . x' (see
`ddprt.sampling.design`); times |x|² it goes along with the squared error, and asks for shadow rays at the points alone.
Lightings are drawn from many candidates with a density in proportion to it, a share of them whatever it says, so that no
weight exceeds 1 / share.

All that are held out, drawn evenly or so, are pooled by the balance heuristic (E. Veach and L. Guibas, Optimally combining
sampling techniques for Monte Carlo rendering, SIGGRAPH 1995): with n_u even ones and n_s of density d (over the even one),
each counts (n_u + n_s) / (n_u + n_s d). The mean stays that over the distribution of the configuration.
"""

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from ddprt import seeds
from ddprt.axes import Float, Float64
from ddprt.config import Config
from ddprt.dataset.splits import choose_lightings
from ddprt.dataset.store import Dataset
from ddprt.lights import Lighting
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model
from ddprt.sampling.design import RIDGE
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

CANDIDATES = 1024
"""Lightings that are measured, to draw from and to tell what the density integrates to."""
_EVENLY = 0.2  # share that is drawn whatever a measurement says


@threadpool_limits.wrap(limits=1, user_api="blas")  # the last bits of a product depend on how many threads it has
def unknown(
    values: Float[np.ndarray, "lightings points 3"], trained: Float[np.ndarray, "others points 3"]
) -> Float64[np.ndarray, " lightings"]:
    """What maps of some lightings do not tell of others: their variance times the square of what they measure.

    Args:
      values: what the points measure under the lightings that are asked about, in any unit.
      trained: under those that maps are known of, in the same.
    """
    rows = np.moveaxis(trained, 2, 1).reshape(-1, trained.shape[1]).astype(np.float64)
    norm = np.linalg.norm(rows, axis=1)
    rows = rows[norm > 0] / norm[norm > 0, None]
    gram = np.linalg.cholesky(rows @ rows.T + RIDGE * np.eye(len(rows)))
    found = np.zeros(len(values))
    for channel in np.moveaxis(values.astype(np.float64), 2, 0):
        size = np.linalg.norm(channel, axis=1)
        explained = np.linalg.solve(gram, rows @ (channel / np.where(size > 0, size, 1)[:, None]).T)
        found += size**2 * (np.maximum(1 - (explained**2).sum(0), 0) + RIDGE)
    return found


@dataclass(frozen=True)
class Suspects:
    """Candidates, and how likely each is to be drawn.

    Attributes:
      model: whose points measure.
      trained: what these measure under the lightings that it was trained on.
      lightings: the candidates, drawn as held-out lightings are.
      mean: of what is unknown of them.
      density: of each, over the even one; their mean is 1.
    """

    model: Model
    trained: Float[np.ndarray, "others points 3"]
    lightings: list[Lighting]
    mean: float
    density: Float64[np.ndarray, " candidates"]

    @classmethod
    def of(
        cls, model: Model, data: Dataset, lightings: list[Lighting], values: Float[np.ndarray, "lightings points 3"]
    ) -> "Suspects":
        """How likely candidates are to be drawn.

        Args:
          model: fitted to `data`.
          data: whose training lightings the model knows.
          lightings: the candidates, see `draw_candidates`.
          values: what the model's points measure under them, see `Model.measure_all`.
        """
        trained = data.values(data.split("train"), model.points, model.quantity)
        told = unknown(values, trained)
        mean = float(told.mean())
        return cls(model, trained, lightings, mean, _density(told, mean))

    @property
    def digest(self) -> str:
        """Of whatever a draw depends on besides its seed."""
        return hashlib.sha256(self.density.tobytes() + str(self.lightings).encode()).hexdigest()[:12]

    def density_of(self, values: Float[np.ndarray, "lightings points 3"]) -> Float64[np.ndarray, " lightings"]:
        """That of other lightings, by what the model's points measure under them."""
        return _density(unknown(values, self.trained), self.mean)

    def draw(self, count: int, seed: int) -> tuple[list[Lighting], Float64[np.ndarray, " lightings"]]:
        """So many of the candidates, each as likely as its density says, and their densities; a candidate may come twice."""
        chance = self.density / self.density.sum()
        chosen = np.random.default_rng(seed).choice(len(chance), count, p=chance)
        return [self.lightings[index] for index in chosen], self.density[chosen]

    @property
    def spread(self) -> float:
        """How far off the logarithm of a pooled error is since `mean` is that of so many candidates, not of all."""
        part = (self.density - _EVENLY) / (1 - _EVENLY)
        return float(np.sqrt(part.var() / len(part)) / 2)


def draw_candidates(scene: Scene, config: Config, count: int = CANDIDATES) -> list[Lighting]:
    """Lightings of the configuration's distribution, by a seed of their own.

    Raises:
      UserError: no free position is found for a light.
    """
    drawn = {"choose": "random", "target_error": 0.0, "train": 1, "validation": 1, "test": count}
    tracer, seed = Tracer.of(scene, config.transport.threads), seeds.number(config.seed, "suspects")
    entries, _ = choose_lightings(None, config.lightings.model_copy(update=drawn), scene, tracer, seed)
    return [lighting for split, lighting in entries if split == "test"]


def balanced(tally: Tally, density: Float64[np.ndarray, " lightings"], even: int) -> Tally:
    """Errors of lightings of which the first were drawn evenly, the others by a density, so that plain means are right.

    Args:
      tally: of all of them.
      density: of all of them, over the even one.
      even: how many were drawn evenly.
    """
    count = len(density)
    weight = count / (even + (count - even) * density)
    scaled = {name: getattr(tally, name) * weight for name in ("error", "squares")}
    return replace(tally, **scaled, **{name: getattr(tally, name) * weight[:, None] for name in ("bias", "mean")})


def _density(told: Float64[np.ndarray, " lightings"], mean: float) -> Float64[np.ndarray, " lightings"]:
    """The even density, mixed with one in proportion to what is unknown."""
    return _EVENLY + (1 - _EVENLY) * told / mean if mean > 0 else np.ones(len(told))
