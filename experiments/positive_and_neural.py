"""What do a basis without negative texels and a decoded lightmap cost and save, beside the baseline?

Question: at 16 maps, who has the lower error on held-out lightings, in floats and with maps of eight bits? How many bytes and
          operations does that take, and how does it hang on settings?
Command:  python experiments/positive_and_neural.py [--seeds 3] [--variants]
Answer:   docs/rivals.md
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.fitting.basis import entry_weights
from ddprt.fitting.encoding import Encoding
from ddprt.methods.method import columns
from ddprt.methods.nonnegative import Nonnegative
from ddprt.runtime.model import Model
from ddprt.runtime.train import examples
from ddprt.training.loop import train
from ddprt.training.schedule import Schedule

SETTINGS = {"atlas.resolution": "64", "lightings.train": "64", "lightings.validation": "16", "lightings.test": "32"}
MAIN: dict[str, tuple[str, int, dict[str, Any]]] = {
    "svd-ridge": ("svd-ridge", 16, {}),
    "svd-ridge, 24 bases": ("svd-ridge", 24, {}),
    "svd-ridge, 32 bases": ("svd-ridge", 32, {}),
    "nonnegative": ("nonnegative", 16, {}),
    "nonnegative, positive": ("nonnegative", 16, {"coefficients": "positive"}),
    "neural-lightmap": ("neural-lightmap", 16, {}),
    "neural-lightmap, everywhere": ("neural-lightmap", 16, {"light": "everywhere"}),
}
VARIANTS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "nonnegative, positive, 1000 sweeps": ("nonnegative", 16, {"coefficients": "positive", "sweeps": 1000}),
    "nonnegative, positive, from columns": ("nonnegative", 16, {"coefficients": "positive", "start": "random"}),
    "nonnegative, from columns": ("nonnegative", 16, {"start": "random"}),
    "nonnegative, 50 sweeps": ("nonnegative", 16, {"sweeps": 50}),
    "svd-ridge, 8 bases": ("svd-ridge", 8, {}),
    "neural-lightmap, 8 bases": ("neural-lightmap", 8, {}),
    "neural-lightmap, 16 wide": ("neural-lightmap", 16, {"width": 16}),
    "neural-lightmap, 64 wide": ("neural-lightmap", 16, {"width": 64}),
    "neural-lightmap, 2 x 16": ("neural-lightmap", 16, {"width": 16, "depth": 2}),
    "neural-lightmap, 16 coefficients": ("neural-lightmap", 16, {"coefficients": 16}),
    "neural-lightmap, everywhere, 16 wide": ("neural-lightmap", 16, {"light": "everywhere", "width": 16}),
}


def unsigned(maps: Float[np.ndarray, "bases entries"], levels: int = 255) -> Float[np.ndarray, "bases entries"]:
    """Maps as textures of unsigned bytes hold them: each between its ends, the lower 0 where nothing is negative."""
    low = np.minimum(maps.min(1, keepdims=True), 0)
    size = np.maximum(maps.max(1, keepdims=True) - low, np.finfo(np.float32).tiny)
    return np.rint((maps - low) / size * levels) / levels * size + low


def signed(maps: Float[np.ndarray, "bases entries"]) -> Float[np.ndarray, "bases entries"]:
    """As textures of signed bytes hold them."""
    size = np.abs(maps).max(1, keepdims=True)
    return np.rint(maps / size * 127) / 127 * size


def stored(model: Model, rounding: Callable[[np.ndarray], np.ndarray]) -> Model:
    """Maps in bytes, all else as it is: small beside them, and no texture."""
    relighter: Any = model.relighter
    return replace(model, relighter=replace(relighter, basis=jnp.asarray(rounding(np.asarray(relighter.basis)), jnp.float32)))


def error(model: Model, data: Dataset) -> float:
    """Relative RMSE over the held-out lightings, area-weighted."""
    test = data.split("test")
    truth, weight = data.maps("indirect", test).astype(np.float64), data.area / data.area.sum()
    off = model.predict(data.values(test, model.points, model.quantity)) - truth
    return float(np.sqrt(np.einsum("ltc,t->", off**2, weight) / np.einsum("ltc,t->", truth**2, weight)))


@dataclass(frozen=True)
class Roots:
    """See `Problem`: maps and coefficients as squares, for the sake of gradient descent."""

    bases: int

    def initial(self, data: dict[str, Array], key: Array) -> tuple[Array, Array]:
        """The same maps as HALS starts from where it starts from columns."""
        maps = data["rows"][jax.random.choice(key, len(data["rows"]), (self.bases,), replace=False)]
        return jnp.full((len(data["rows"]), self.bases), self.bases**-0.5), jnp.sqrt(jnp.maximum(maps, 0))

    def loss(self, parameters: tuple[Array, Array], data: dict[str, Array], key: Array) -> Array:
        return self.check(parameters, data)

    def check(self, parameters: tuple[Array, Array], held: dict[str, Array]) -> Array:
        coefficients, maps = (part**2 for part in parameters)
        off = held["rows"] - jnp.matmul(coefficients, maps, precision="highest")
        return jnp.sum(off**2 * held["entries"]) / jnp.sum(held["rows"] ** 2 * held["entries"])


def descent(data: Dataset) -> None:
    """What is left of the training light after HALS and after gradient descent, of squares of roots."""
    config = load_config(None, {}).fit
    one = examples(data, "train", Encoding(), config, data.description["points"]["count"], "radiosity")
    entries = jnp.asarray(entry_weights(one.area, "area", "mono"))
    whole = {"rows": columns(one)[0], "entries": entries}
    key = jax.random.key(0)
    begun = time.perf_counter()
    for start in ("random", "svd"):
        found = Nonnegative(coefficients="positive", start=start, sweeps=1000).fit(one, one, key=key)
        shown = ", ".join(f"{step}: {left:.2e}" for step, left, _ in found.report.loss[::5])
        print(f"HALS from {start:7} {time.perf_counter() - begun:5.1f} s  {shown}", flush=True)
    for by, rate in (("l-bfgs", 1.0), ("adam", 3e-3), ("adam", 1e-2), ("adam", 3e-2)):
        begun = time.perf_counter()
        schedule = Schedule(steps=1000, check_every=100, learning_rate=rate, weight_decay=0, by=by)
        history = train("roots", Roots(16), whole, whole, schedule, key).history
        shown = ", ".join(f"{entry.step}: {entry.validation:.2e}" for entry in history[::3])
        print(f"{by} {rate:5} {time.perf_counter() - begun:12.1f} s  {shown}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--variants", action="store_true", help="other settings, and gradient descent; of the first seed alone")
    asked = parser.parse_args()
    seeds = range(1 if asked.variants else asked.seeds)
    scene = ddprt.load_scene("cornell")
    baked = [ddprt.bake(scene, config=load_config("configs/cornell.toml", SETTINGS | {"seed": str(seed)})) for seed in seeds]
    print(f"{'method':38}{'error':>17}{'signed bytes':>14}{'unsigned':>10}{'KiB':>7}{'Mflop':>7}{'s':>7}  status")
    for name, (method, bases, settings) in (VARIANTS if asked.variants else MAIN).items():
        found, seconds, model = [], [], None
        for seed, data in zip(seeds, baked, strict=True):
            begun = time.perf_counter()
            model = ddprt.fit(data, method, bases=bases, settings=settings, seed=seed)
            seconds.append(time.perf_counter() - begun)
            found.append([error(one, data) for one in (model, stored(model, signed), stored(model, unsigned))])
        assert model is not None
        mean, spread = np.mean(found, 0), np.std(found, 0, ddof=1) if len(found) > 1 else np.zeros(3)
        numbers = f"{mean[1]:14.5f}{mean[2]:10.5f}{model.relighter.nbytes / 1024:7.0f}{model.relighter.flops / 1e6:7.2f}"
        status = model.relighter.report.status
        print(f"{name:38}{mean[0]:9.5f} ±{spread[0]:.5f}{numbers}{np.median(seconds):7.1f}  {status}", flush=True)
    if asked.variants:
        descent(baked[0])


if __name__ == "__main__":
    main()
