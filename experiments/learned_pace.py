"""No question of its own: steps per second of the mlp, of the same model in torch, and of its matrix products alone.

`learned.py` asks for it. The three take turns in one process, so that whoever else uses the machine hinders all of them alike.
"""

import importlib
import time
from collections.abc import Callable
from itertools import pairwise
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ddprt.methods.learned import Network, Seen
from ddprt.training.loop import train
from ddprt.training.schedule import Schedule

LIGHTINGS, GROUPS, POINTS, WIDTH, BASES = 128, 3, 128, 128, 16
RATE, DECAY = 2e-3, 1e-4
REST = 0.3  # seconds: threads of whoever went before may still be waiting for work, and take the cores while they do


def made_up() -> Seen:
    """Measurements and coefficients of the default job's sizes; what they are makes no step longer or shorter."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.standard_normal(shape), jnp.float32)  # noqa: E731
    return Seen(draw(LIGHTINGS, GROUPS, POINTS), draw(LIGHTINGS, GROUPS, BASES), jnp.ones((LIGHTINGS, GROUPS)), jnp.ones(BASES))


def ours(seen: Seen, steps: int) -> Callable[[], None]:
    """All steps of a training, looks at validation data included."""
    schedule = Schedule(steps=steps, learning_rate=RATE, weight_decay=DECAY, check_every=steps)
    return lambda: jax.block_until_ready(train("pace", Network(WIDTH, 2), seen, seen, schedule, jax.random.key(0)).parameters)


def products(seen: Seen, steps: int) -> Callable[[], None]:
    """The products of matrices that forward and backward passes cannot do without, and no function between them."""
    X = seen.inputs.reshape(-1, POINTS)
    X = jnp.concatenate([X, jnp.ones((len(X), GROUPS))], 1)
    Y = seen.targets.reshape(-1, BASES) * 1e-6
    sizes = [X.shape[1], WIDTH, WIDTH, BASES]
    weights = [jax.random.normal(jax.random.key(k), (a, b)) / a**0.5 for k, (a, b) in enumerate(pairwise(sizes))]

    @jax.jit
    def run(weights: list[jax.Array]) -> list[jax.Array]:
        def step(weights: list[jax.Array], _: None) -> tuple[list[jax.Array], None]:
            first, second, last = weights
            one = X @ first
            two = one @ second
            back = two @ last - Y
            of_two = back @ last.T
            of_one = of_two @ second.T
            gradients = [X.T @ of_one, one.T @ of_two, two.T @ back]
            return [weight - 1e-9 * gradient for weight, gradient in zip(weights, gradients, strict=True)], None

        return jax.lax.scan(step, weights, None, length=steps)[0]

    return lambda: jax.block_until_ready(run(weights))


def torchs(seen: Seen, steps: int, threads: int) -> Callable[[], None]:
    """The same network, loss, optimiser, clip and schedule in torch on so many threads.

    Raises:
      ImportError: there is no torch.
    """
    torch: Any = importlib.import_module("torch")
    which = np.broadcast_to(np.eye(GROUPS, dtype=np.float32), (LIGHTINGS, GROUPS, GROUPS))
    inputs = torch.tensor(np.concatenate([np.asarray(seen.inputs) * POINTS**0.5, which], -1))
    targets, size = torch.tensor(np.asarray(seen.targets)), torch.ones(BASES)
    importance = torch.tensor(np.asarray(seen.importance))

    def run() -> None:
        torch.set_num_threads(threads)
        torch.manual_seed(0)
        layers = torch.nn
        sizes = [POINTS + GROUPS, WIDTH, WIDTH, BASES]
        linear = [layers.Linear(a, b) for a, b in pairwise(sizes)]
        gate = layers.Softsign()

        def network(values: Any) -> Any:
            for layer in linear[:-1]:
                values = layer(values)
                values = 0.5 * values * (1 + gate(values))
            return linear[-1](values)

        parameters = [parameter for layer in linear for parameter in layer.parameters()]
        optimiser = torch.optim.AdamW(parameters, lr=RATE, weight_decay=DECAY)
        paces = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        share = size**2 / (size**2).sum()
        for _ in range(steps):
            optimiser.zero_grad(set_to_none=True)
            loss = (importance[..., None] * share * (network(inputs) - targets) ** 2).mean()
            loss.backward()
            layers.utils.clip_grad_norm_(parameters, 1.0)
            optimiser.step()
            paces.step()

    return run


def pace(steps: int, turns: int) -> dict[str, float | str | None]:
    """Medians over turns. Torch is taken at its better of one thread and two, for as many steps as the others.

    Returns:
      mlp_steps_per_second; mlp_over_torch, above 1 where ours is the faster (None without torch, and why in `torch`);
      mlp_of_product_bound, at most 1: the seconds of the products over ours.
    """
    seen = made_up()
    works = {"ours": ours(seen, steps), "products": products(seen, steps)}
    version = ""
    try:
        works |= {f"torch {threads}": torchs(seen, steps, threads) for threads in (1, 2)}
        version = str(importlib.import_module("torch").__version__)
    except ImportError as error:
        version = f"not measured: {error}"
    for work in works.values():
        work()
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(turns):
        for name, work in works.items():
            time.sleep(REST)
            begun = time.perf_counter()
            work()
            taken[name].append(time.perf_counter() - begun)
    mine = median(taken["ours"])
    peers = [median(found) for name, found in taken.items() if name.startswith("torch")]
    return {
        "mlp_steps_per_second": round(steps / mine, 1),
        "mlp_over_torch": round(min(peers) / mine, 3) if peers else None,
        "mlp_of_product_bound": round(median(taken["products"]) / mine, 3),
        "torch": version,
    }
