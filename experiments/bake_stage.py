"""What the experiments about baking stand on: a scene with its lightings, all of its maps, and the truth about them.

Question: none of its own; `bake_speed.py` and `bake_costs.py` import it.
Command:  none
Answer:   none

Seconds are those of making the indirect maps in memory, all that depends on a lighting included (so the direct light that the
operator bounces, but no file). Atlas, tree of the scene and compilation are left out.

Truth is two independent halves of unbiased paths, r and r'. The error of maps y is then mean((y - r)(y - r')), which holds no
noise of the truth; and the bias of two independent bakes y and y' is mean((y - r)(y' - r')), which holds no noise at all.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import ddprt
from ddprt import seeds
from ddprt.config import Config, load_config
from ddprt.lights import Lighting
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import Texels
from ddprt.transport.effort import choose_rays
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.operator import Operator
from ddprt.transport.paths import trace_paths

RESOLUTION = 152  # 15 k texels on the Cornell box


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene, its atlas and its lightings."""

    name: str
    scene: Scene
    atlas: Atlas
    tracer: Tracer
    config: Config
    train: tuple[Lighting, ...]
    test: tuple[Lighting, ...]


def stage(name: str, resolution: int, train: int, test: int, **options: int) -> Stage:
    """A scene of the library, made with its own options, and numbers of lightings drawn as a bake would."""
    around = {"lightings.distribution": "around"} if name == "statue" else {}
    config = load_config("configs/cornell.toml", around)
    scene = ddprt.load_scene(name, **options)
    tracer = Tracer.of(scene)
    atlas, _ = build_open_atlas(tracer, scene, resolution)
    draws = [
        draw_lightings(config.lightings, split, n, bounds=scene.bounds, clearance=tracer.clearance, seed=0).lightings
        for split, n in (("train", train), ("test", test))
    ]
    return Stage(name, scene, atlas, tracer, config, *draws)


def bake(
    on: Stage, lightings: Sequence[Lighting], samples: int | str, stream: str = "train 0"
) -> tuple[np.ndarray, float, dict]:
    """All indirect maps by the operator, as `ddprt.bake` makes training maps: (lightings, texels, 3), seconds, facts."""
    tracer, atlas = on.tracer, on.atlas
    transport = on.config.transport.model_copy(update={"samples": samples})
    start = time.perf_counter()
    address = stream.encode()
    texels = Texels.of(tracer, atlas, transport.direct_samples, seeds.stream(0, "texel positions", *address))
    operator = Operator.of(tracer, atlas, transport.sender_resolution)

    def direct(index: int) -> np.ndarray:
        light = texels.irradiance(lightings[index], seeds.stream(0, "direct", index, *address))
        return operator.averaged(light)

    sent = np.concatenate(list(tracer.map(direct, range(len(lightings)))), 1)
    near = operator.near(lightings, sent)
    bounced = operator.bounce(sent, seed=0, stream=stream)
    chosen = choose_rays(operator, bounced.radiosity, transport, near=near, held_out=False, seed=0, stream=stream)
    maps = np.empty((len(lightings), atlas.count, 3), np.float32)
    for _ in operator.gather(bounced.radiosity, maps, chosen.rays, near=near, seed=0, stream=stream):
        pass
    if chosen.footprints:
        for index, pooled in enumerate(tracer.map(lambda index: chosen.footprints.pooled(maps[index]), range(len(lightings)))):
            maps[index] = pooled
    np.maximum(maps, 0, out=maps)
    return maps, time.perf_counter() - start, chosen.facts


def bake_twice(on: Stage, lightings: Sequence[Lighting]) -> tuple[np.ndarray, np.ndarray, dict]:
    """Two independent bakes with as many rays as the configuration asks for, and the facts of the first."""
    (maps, _, facts), (others, _, _) = (bake(on, lightings, "auto", f"run {k}") for k in range(2))
    return maps, others, facts


@dataclass(frozen=True, eq=False)
class Truth:
    """Two independent halves of unbiased light at some texels, and how much of the surface each stands for."""

    texels: np.ndarray
    halves: np.ndarray  # (2, lightings, texels, 3)
    weights: np.ndarray

    @property
    def mean(self) -> float:
        return self.averaged(self.halves.mean(0))

    def averaged(self, values: np.ndarray) -> float:
        """Mean over lightings, surface and channels."""
        return float(np.mean(np.einsum("ltc,t->lc", values.astype(float), self.weights)))

    def error(self, maps: np.ndarray, others: np.ndarray | None = None) -> float:
        """Relative RMSE of maps, or the bias that two independent sets of maps share."""
        return float(np.sqrt(max(self._squares(maps, others).sum(), 0.0)) / self.mean)

    def _squares(self, maps: np.ndarray, others: np.ndarray | None) -> np.ndarray:
        """Each texel's share of the squared error."""
        one, two = maps[:, self.texels], (maps if others is None else others)[:, self.texels]
        return self.weights * np.mean((one - self.halves[0]) * (two - self.halves[1]).astype(float), (0, 2))

    def between(self, maps: np.ndarray, others: np.ndarray) -> tuple[float, float]:
        """Where the bias lies, two standard errors to both sides, by drawing texels again."""
        squares, rng = self._squares(maps, others), np.random.default_rng(0)
        spread = np.std([squares[rng.integers(0, len(squares), len(squares))].sum() for _ in range(200)])
        low, high = (np.sqrt(max(squares.sum() + way * spread, 0.0)) / self.mean for way in (-2, 2))
        return float(low), float(high)

    def noise(self, maps: np.ndarray, others: np.ndarray) -> float:
        """Relative RMSE of each of two independent sets of maps about their mean."""
        return float(np.sqrt(self.averaged((maps - others)[:, self.texels] ** 2) / 2) / self.mean)


def truth(on: Stage, lightings: Sequence[Lighting], texels: int, paths: int) -> Truth:
    chosen = np.sort(seeds.stream(0, "truth").choice(on.atlas.count, texels, replace=False))
    halves = np.zeros((2, len(lightings), on.atlas.count, 3), np.float32)
    for half in range(2):
        for _ in trace_paths(
            on.tracer,
            on.scene,
            on.atlas,
            lightings,
            halves[half],
            samples=paths,
            seed=0,
            stream=f"truth {half}",
            texels=chosen,
        ):
            pass
    area = on.atlas.area[chosen]
    return Truth(chosen, halves[:, :, chosen], area / area.sum())


def command(verbs: Mapping[str, Callable[..., None]]) -> None:
    """Does what the command line names, with or without dashes; the first verb if it names none."""
    verb, *words = sys.argv[1:] or list(verbs)[:1]
    if verb.removeprefix("--") not in verbs:
        sys.exit(f'error: no command "{verb}"; known: {", ".join(verbs)}')
    verbs[verb.removeprefix("--")](*words)
