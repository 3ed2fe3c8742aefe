"""The training loop.

All steps between two looks at the validation data are one compiled call, which equal problems share: rates, decay and the
number of steps are data to it, so that a search over them compiles once. A step's randomness follows from the key and its
number alone: whoever goes on from a checkpoint goes the very way of whoever was never stopped.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ddprt.training.journal import Entry, journal
from ddprt.training.schedule import Schedule, memory, rate

Tree = Any


@runtime_checkable
class Problem(Protocol):
    """What is trained. Hashable: equal problems share what is compiled. Products take place in the type of the parameters."""

    def initial(self, data: Tree, key: Array) -> Tree:
        """Parameters to start from."""
        ...

    def loss(self, parameters: Tree, data: Tree, key: Array) -> Float[Array, ""]:
        """What a step lowers, float32; `key` draws its batch."""
        ...

    def check(self, parameters: Tree, held: Tree) -> Float[Array, ""]:
        """What the best parameters are chosen by: the loss of all validation data, float32."""
        ...


class State(NamedTuple):
    """Everything that training goes on from."""

    step: Int[Array, ""]
    parameters: Tree
    memory: Tree
    best: Tree
    lowest: Float[Array, ""]
    waited: Int[Array, ""]


@dataclass(frozen=True)
class Trained:
    """What came of it.

    Attributes:
      parameters: the best on the validation data; those at the start where none was finite.
      history: a look at the validation data each.
      trouble: what went wrong, in words; empty where nothing did.
    """

    parameters: Tree
    history: tuple[Entry, ...]
    trouble: str = ""


def train(
    name: str, problem: Problem, data: Tree | Callable[[int], Tree], held: Tree, schedule: Schedule, key: Array
) -> Trained:
    """Trains to the end of the schedule, until nothing gets better, or until numbers are not finite.

    Args:
      name: of the method, for the journal.
      problem: what is trained.
      data: arrays; or a function from the number of a round to the arrays of that round, where they do not fit into memory.
      held: validation data.
      schedule: how long and how fast.
      key: the only randomness.
    """
    of_round = data if callable(data) else lambda _: data
    start_key, step_key = jax.random.split(key)
    first = of_round(0)
    with journal(name, problem, schedule, key, (first, held)) as log:
        state, history = log.resumed(_begin(problem, schedule.by, first, start_key))
        trouble, how = _trouble(history), _How(schedule.round, schedule.dtype, schedule.by)
        for number in range(len(history), schedule.rounds):
            if trouble or (schedule.patience and int(state.waited) >= schedule.patience):
                break
            state, seen = _round(problem, how, schedule.numbers, state, of_round(number), held, step_key)
            entry = Entry(int(state.step), *map(float, np.asarray(seen)))
            history.append(entry)
            trouble = _trouble(history)
            log.add(entry, state, history)
    if not trouble:
        return Trained(state.best, tuple(history))
    begun = _begin(problem, schedule.by, first, start_key).parameters
    looks = [look for look in history if np.isfinite(look.validation)]
    best = min(looks, key=lambda look: look.validation, default=None)
    if best is None or best.validation > float(problem.check(begun, held)):
        return Trained(begun, tuple(history), f"{trouble}; the parameters it began with are kept")
    kept = f"of step {best.step}, with a validation loss of {best.validation:.3g}"
    return Trained(state.best, tuple(history), f"{trouble}; the parameters {kept} are kept")


def _trouble(history: Sequence[Entry]) -> str:
    """What is not finite at the last look, and what was seen before it; empty where all is well."""
    if not history or np.isfinite((history[-1].loss, history[-1].validation, history[-1].gradient)).all():
        return ""
    entry, earlier = history[-1], history[:-1]
    names = {"loss": "the loss", "gradient": "the gradient", "validation": "the validation loss"}
    what = next(words for name, words in names.items() if not np.isfinite(getattr(entry, name)))
    told = f"{what} was not finite by step {entry.step}, at a learning rate of {entry.rate:.3g}"
    if earlier:
        first, last = earlier[0], earlier[-1]
        told += f"; by step {last.step} the loss was {last.loss:.3g} ({first.loss:.3g} by step {first.step})"
        told += f" and its gradient had a norm of {last.gradient:.3g}"
        return told
    return f"{told}; nothing was looked at before, a smaller check_every tells more"


@partial(jax.jit, static_argnums=(0, 1))
def _begin(problem: Problem, by: str, data: Tree, key: Array) -> State:
    parameters = problem.initial(data, key)
    zero = jnp.zeros((), jnp.int32)
    return State(zero, parameters, memory(by).init(parameters), parameters, jnp.array(jnp.inf, jnp.float32), zero)


class _How(NamedTuple):
    """What of a schedule is compiled: steps of a round, the type of products, and how steps are made."""

    steps: int
    dtype: jnp.dtype
    by: str


@partial(jax.jit, static_argnums=(0, 1))
def _round(
    problem: Problem, how: _How, numbers: Array, state: State, data: Tree, held: Tree, key: Array
) -> tuple[State, Float[Array, " 4"]]:
    """Some steps and a look: the steps' mean loss, the check, and norm of the gradient and rate of the last step."""

    def step(carry: tuple[Array, Tree, Tree], _: None) -> tuple[tuple[Array, Tree, Tree], Float[Array, " 2"]]:
        count, parameters, remembered = carry
        drawn = jax.random.fold_in(key, count)

        def loss(parameters: Tree) -> Array:
            return problem.loss(jax.tree.map(lambda leaf: leaf.astype(how.dtype), parameters), data, drawn)

        made = _adam if how.by == "adam" else _l_bfgs
        parameters, remembered, value, norm = made(loss, parameters, remembered, numbers, count)
        return (count + 1, parameters, remembered), jnp.stack([value, norm])

    (count, parameters, remembered), seen = jax.lax.scan(
        step, (state.step, state.parameters, state.memory), None, length=how.steps
    )
    now = problem.check(parameters, held)
    better = now < state.lowest  # never of NaN: parameters that are not finite are not kept
    best = jax.tree.map(lambda a, b: jnp.where(better, a, b), parameters, state.best)
    waited = jnp.where(better, 0, state.waited + 1)
    after = State(count, parameters, remembered, best, jnp.where(better, now, state.lowest), waited)
    return after, jnp.stack([seen[:, 0].mean(), now, seen[-1, 1], rate(numbers, count - 1)])


Loss = Callable[[Tree], Array]


def _adam(loss: Loss, parameters: Tree, remembered: Tree, numbers: Array, count: Array) -> tuple[Tree, Tree, Array, Array]:
    value, gradient = jax.value_and_grad(loss)(parameters)
    norm = optax.tree.norm(gradient)
    gradient = jax.tree.map(lambda leaf: leaf * jnp.minimum(1, numbers[3] / jnp.maximum(norm, 1e-30)), gradient)
    updates, remembered = memory("adam").update(gradient, remembered)
    pace, decay = rate(numbers, count), numbers[1]
    parameters = jax.tree.map(lambda leaf, update: leaf - pace * (update + decay * leaf), parameters, updates)
    return parameters, remembered, value, norm


def _l_bfgs(loss: Loss, parameters: Tree, remembered: Tree, numbers: Array, count: Array) -> tuple[Tree, Tree, Array, Array]:
    value, gradient = optax.value_and_grad_from_state(loss)(parameters, state=remembered)
    updates, remembered = memory("l-bfgs").update(gradient, remembered, parameters, value=value, grad=gradient, value_fn=loss)
    return optax.apply_updates(parameters, updates), remembered, value, optax.tree.norm(gradient)
