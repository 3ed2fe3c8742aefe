"""What a frame and a bake cost, stage by stage: the paper's Table 1.

Question: how long does it take to shade the measurement points, to make u = M x and to compose y = U u of 4, 16 and 64 bases,
          on the CPU and through JAX on a GPU where there is one? And how long is a bake of 128 lightings?
Command:  python experiments/paper_table1.py            minutes
          python experiments/paper_table1.py --quick    small bakes, a lightmap of 256² instead of 1024²
Answer:   docs/paper.md

fake G-buffer  `Model.measure`: shadow rays from 256 points of 8 samples each to one point lamp, and their means; always on the
               CPU (Embree)
transfer       scale and encode 256 values per channel, and u = M x for three channels, from host memory to host memory: by
               `Model.coefficients`, which is compiled for the CPU, and by JAX on the device
compose        y = U u for all three channels of every texel of the lightmap, scaled and clamped, in the device's memory; bytes
               are those that must be read and written once
frame          `Model.predict`, which is both and copies the lightmap to the host

The values in the basis do not matter to time, so at the paper's resolution they are random numbers. The bake's seconds are a
user's for the training half: from scene to EXR files, less those of held-out maps. All bakes follow a tiny one that compiles.
"""

import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from paper_figures import POINTS, SCENES

import ddprt
from ddprt import seeds
from ddprt.bench.measure.timing import Timing, timed
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.fitting.encoding import Encoding
from ddprt.machine import machine
from ddprt.methods.method import Frame
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.progress import Progress
from ddprt.runtime.model import Model

BASES = (4, 16, 64)
REPEATS = 101
CALLS = 100  # in one timing of what takes but microseconds itself
HELD_OUT = {"indirect validation", "indirect test"}
PAPER = {  # microseconds of the fragment shader: Cornell, Viking, Dragon, Hairball
    "No GI": (221, 232, 418, 8729),
    4: (325, 348, 490, 8910),
    16: (428, 483, 658, 9547),
    64: (892, 1068, 1358, 11971),
}


def main(quick: bool) -> None:
    print({key: value for key, value in machine().items() if key in ("processor", "cores")})
    side = 256 if quick else 1024
    baked = {name: bake(name, 64 if quick else 256, quick) for name in SCENES}
    if not quick:
        bake("cornell", 1024, quick)
    print("\nfake G-buffer, microseconds (quartiles): direct light with shadow rays at the points")
    for name, data in baked.items():
        model = ddprt.fit(data, bases=4)
        lighting = data.lightings[data.split("test")[0]]
        measured, seconds = timed(lambda model=model, lighting=lighting: model.measure(lighting), REPEATS)
        print(f"| {name} | {len(model.samples.position)} samples | {micro(seconds)} |", flush=True)
        if name == "cornell":
            first = model, measured
    model, values = first
    places = devices()
    for place in places:
        with jax.default_device(place):
            frames(model, values, side, place)
    if len(places) == 1:
        print("no GPU here")
    print("\npaper: shader less its No GI, microseconds (RTX 2080; Cornell, Viking, Dragon, Hairball)")
    for bases in BASES:
        print(f"| {bases} | " + " | ".join(str(whole - none) for whole, none in zip(PAPER[bases], PAPER["No GI"], strict=True)))


def devices() -> list[Any]:
    """The CPU, and what JAX computes on by itself where that is something else."""
    places = [jax.devices("cpu")[0]]
    return places if jax.default_backend() == "cpu" else [*places, jax.devices()[0]]


def bake(name: str, size: int, quick: bool) -> Dataset:
    """128 lightings (24 in a quick run) at the default noise of 1 %, into a temporary folder; prints what it cost."""
    changes = {"atlas.resolution": str(size), "points.count": str(POINTS), **SCENES[name]}
    changes |= {"lightings.validation": "1", "lightings.test": "1", "transport.target_noise": "0.05" if quick else "0.01"}
    if quick:
        changes["lightings.train"] = "24"
    scene = ddprt.load_scene(name)
    tiny = {"atlas.resolution": "48", "lightings.train": "2", "points.count": "4", "transport.target_noise": "0.5"}
    if name not in _WARM:
        _WARM.add(name)
        ddprt.bake(scene, config=load_config("configs/cornell.toml", changes | tiny))
    progress = Progress(quiet=True)
    data = ddprt.bake(scene, config=load_config("configs/cornell.toml", changes), progress=progress)
    stages = {stage["name"]: stage for stage in progress.stages}
    seconds = sum(float(stage["seconds"]) for key, stage in stages.items() if key not in HELD_OUT)
    rays = sum(int(stage.get("rays", 0)) for key, stage in stages.items() if key not in HELD_OUT)
    print(f"| bake | {name} | {size}² | {int(data.covered.sum())} texels | {len(data.split('train'))} lightings | ", end="")
    print(f"{rays / 1e6:.0f} M rays | {seconds:.1f} s |", flush=True)
    return data


_WARM: set[str] = set()


def frames(model: Model, values: np.ndarray, side: int, place: Any) -> None:
    """Transfer, composition and both, on one device."""
    print(f"\n{place.platform} ({place.device_kind}): {side}² texels, {model.points} points, RGB, mono channel; quartiles")
    print("| bases | transfer µs | by JAX µs | compose µs | bytes through memory | GB/s | frame µs |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for bases in BASES:
        wide = widened(model, bases, side * side)
        _, quick = timed(lambda wide=wide: [wide.coefficients(values) for _ in range(CALLS)], REPEATS)
        u, transfer = timed(lambda wide=wide: np.asarray(coefficients(wide, values)), REPEATS)
        on_device = jnp.asarray(u), wide.encoding.scale(jnp.asarray(values[None]))
        _, composing = timed(lambda wide=wide, given=on_device: _compose(wide.relighter, wide.encoding, *given), REPEATS)
        _, whole = timed(lambda wide=wide: wide.predict(values), REPEATS)
        moved = composed_bytes(bases, side * side)
        print(f"| {bases} | {micro(quick, CALLS)} | {micro(transfer)} | {micro(composing)} | {moved / 1e6:.1f} MB | ", end="")
        print(f"{moved / composing.median / 1e9:.1f} | {micro(whole)} |", flush=True)


def widened(model: Model, bases: int, texels: int) -> Model:
    """The model with random bases over so many texels, all else as it is."""
    rng = seeds.stream(0, "paper table 1", bases)
    matrix = jnp.asarray(rng.standard_normal((3, bases, model.points), dtype=np.float32))
    basis = jnp.asarray(rng.standard_normal((bases, texels), dtype=np.float32))
    nothing = jnp.zeros((3, model.points)), jnp.zeros((3, bases)), basis, jnp.zeros(texels)
    return replace(model, relighter=LinearTransfer(matrix, *nothing))


def composed_bytes(bases: int, texels: int) -> int:
    """Basis and mean read once, three channels written once, all float32."""
    return 4 * texels * (bases + 1 + 3)


def coefficients(model: Model, values: np.ndarray) -> jax.Array:
    """u of one frame by JAX, (1, rgb, bases), without the frame's scale."""
    return _coefficients(model.relighter, model.encoding, jnp.asarray(values[None]))


@jax.jit
def _coefficients(relighter: LinearTransfer, encoding: Encoding, values: jax.Array) -> jax.Array:
    encoded = encoding.encode(values, encoding.scale(values))
    return relighter.coefficients(Frame(encoded, jnp.zeros(encoded.shape[1:]), jnp.zeros(encoded.shape[1:])))


@jax.jit
def _compose(relighter: LinearTransfer, encoding: Encoding, u: jax.Array, scale: jax.Array) -> jax.Array:
    light = jnp.matmul(u, relighter.basis, precision="highest") + relighter.mean
    return encoding.decode(jnp.moveaxis(light, 1, 2), scale)


def micro(seconds: Timing, calls: int = 1) -> str:
    median, low, high = (value * 1e6 / calls for value in (seconds.median, seconds.low, seconds.high))
    digits = 0 if median >= 100 else 1
    return f"{median:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
