"""What training writes down: losses as JSON lines, and checkpoints from which it goes on bit for bit.

Nothing is written unless somebody asked for it by `keeping`. A checkpoint holds the number of steps, parameters, moments and
the best so far, and a hash of what it belongs to, the key among it; the order of data follows from key and step.
"""

import hashlib
import importlib.util
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from ddprt.errors import UserError
from ddprt.files import make_folder, read_tensors, write_tensors, write_text
from ddprt.progress import Stage
from ddprt.training.schedule import Schedule


class Entry(NamedTuple):
    """A look at the validation data.

    Attributes:
      step: steps done.
      loss: mean over the steps since the last look.
      validation: what the best parameters are chosen by.
      gradient: norm of the last step's, before it is clipped.
      rate: learning rate of the last step.
    """

    step: int
    loss: float
    validation: float
    gradient: float
    rate: float


@dataclass
class Keeping:
    """Where and how trainings write; see `keeping`.

    Attributes:
      folder: of checkpoints and JSON lines; None writes nothing.
      stage: shows steps and losses; None shows nothing.
      tensorboard: also write event files.
      every: seconds between checkpoints, at least.
      names: how often each name was trained under so far.
    """

    folder: Path | None = None
    stage: Stage | None = None
    tensorboard: bool = False
    every: float = 10.0
    names: dict[str, int] = field(default_factory=dict)

    def called(self, name: str) -> str:
        """The name, numbered from the second training of that name on."""
        self.names[name] = count = self.names.get(name, 0) + 1
        return name if count == 1 else f"{name}-{count}"


_keeping: ContextVar[Keeping | None] = ContextVar("keeping", default=None)


@contextmanager
def keeping(
    folder: str | Path | None, stage: Stage | None = None, *, tensorboard: bool = False, every: float = 10.0
) -> Iterator[None]:
    """Trainings in this block write into a folder, and go on from checkpoints that lie there.

    Args:
      folder: made where it is missing; NAME.jsonl and NAME.safetensors for each training.
      stage: shows steps and losses if given.
      tensorboard: event files too.
      every: seconds between checkpoints.
    Raises:
      UserError: event files are asked for, and the package that writes them is missing.
    """
    if tensorboard and importlib.util.find_spec("tensorboardX") is None:
        raise UserError("tensorboard: got no package tensorboardX, expected it; install ddprt[tensorboard], or leave it out")
    token = _keeping.set(Keeping(None if folder is None else Path(folder), stage, tensorboard, every))
    try:
        yield
    finally:
        _keeping.reset(token)


@contextmanager
def journal(name: str, problem: Any, schedule: Schedule, key: Array, data: Any) -> "Iterator[Journal]":
    """The journal of one training, which writes where `keeping` says, and closes it at the end of the block."""
    where = _keeping.get() or Keeping()
    log = Journal(where, where.called(name), schedule)
    if log.path is not None:
        log.identity = _identity(problem, schedule, key, data)
    try:
        yield log
    finally:
        log.close()


class Journal:
    """See `journal`.

    Attributes:
      path: of the checkpoint; None where nothing is written.
      identity: hash of all that a checkpoint must agree on.
    """

    def __init__(self, where: Keeping, name: str, schedule: Schedule) -> None:
        self.where, self.name, self.schedule = where, name, schedule
        self.path = None if where.folder is None else where.folder / f"{name}.safetensors"
        self.identity = b""
        self._lines: Any = None
        self._events: Any = None
        self._saved = self._begun = time.perf_counter()
        self._first = 0

    def resumed(self, state: Any) -> tuple[Any, list[Entry]]:
        """The state and the looks to go on from: those of a checkpoint, if there is one.

        Raises:
          UserError: it is of another training, or damaged.
        """
        history = list[Entry]()
        if self.path is not None:
            make_folder(self.path.parent)
            if self.path.exists():
                state, history = self._read(state)
            self._open(history)
        self._first = history[-1].step if history else 0
        if self.where.stage is not None:
            self.where.stage.pace(self.schedule.round * self.schedule.rounds)
            self.where.stage.advance(self._first, found=True)
        return state, history

    def add(self, entry: Entry, state: Any, history: Sequence[Entry]) -> None:
        """Notes a look, and saves the state now and then."""
        seconds = time.perf_counter() - self._begun
        pace = (entry.step - self._first) / seconds if seconds > 0 else 0.0
        if self._lines is not None:
            told = {**entry._asdict(), "seconds": round(seconds, 4), "steps_per_second": round(pace, 2)}
            print(
                json.dumps({key: value if np.isfinite(value) else None for key, value in told.items()}),
                file=self._lines,
                flush=True,
            )
        if self._events is not None:
            for key, value in entry._asdict().items():
                self._events.add_scalar(key, value, entry.step)
        if self.where.stage is not None:
            self.where.stage.advance(self.schedule.round)
            self.where.stage.tell(f"{self.name}: loss {entry.loss:.3g}, validation {entry.validation:.3g}, {pace:.3g} steps/s")
        last = len(history) == self.schedule.rounds
        if (
            self.path is not None
            and np.isfinite(entry.validation)
            and (last or time.perf_counter() - self._saved >= self.where.every)
        ):
            self._save(state, history)

    def close(self) -> None:
        """Closes what was opened."""
        for opened in (self._lines, self._events):
            if opened is not None:
                opened.close()

    def _save(self, state: Any, history: Sequence[Entry]) -> None:
        assert self.path is not None
        leaves = {f"state{jax.tree_util.keystr(place)}": np.asarray(leaf) for place, leaf in _leaves(state)}
        looks = np.array(history, np.float64).reshape(-1, len(Entry._fields))
        write_tensors(self.path, {**leaves, "looks": looks, "identity": np.frombuffer(self.identity, np.uint8)})
        self._saved = time.perf_counter()

    def _read(self, state: Any) -> tuple[Any, list[Entry]]:
        assert self.path is not None
        found = read_tensors(self.path)
        names = [f"state{jax.tree_util.keystr(place)}" for place, _ in _leaves(state)]
        same = found.get("identity", np.zeros(0, np.uint8)).tobytes() == self.identity
        if not same or not {*names, "looks"} <= set(found):
            raise UserError(
                f"{self.path}: got a checkpoint of other settings, data or seed, expected one of this training; "
                "delete it to train anew, or keep checkpoints in another folder"
            )
        state = jax.tree_util.tree_unflatten(
            jax.tree_util.tree_structure(state), [jax.numpy.asarray(found[name]) for name in names]
        )
        return state, [Entry(int(row[0]), *map(float, row[1:])) for row in found["looks"]]

    def _open(self, history: Sequence[Entry]) -> None:
        """Opens the lines for more; those past the checkpoint go, as they come again."""
        assert self.path is not None
        path = self.path.with_suffix(".jsonl")
        kept = path.read_text("utf-8").splitlines()[: len(history)] if path.exists() else []
        write_text(path, "".join(line + "\n" for line in kept))
        self._lines = path.open("a", encoding="utf-8")
        if self.where.tensorboard:
            from tensorboardX import SummaryWriter

            self._events = SummaryWriter(str(self.path.with_suffix(".events")))


def _leaves(state: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_flatten_with_path(state)[0]


def _identity(problem: Any, schedule: Schedule, key: Array, data: Any) -> bytes:
    found = hashlib.sha256(f"{type(problem).__qualname__} {problem!r} {schedule!r}".encode())
    for leaf in (jax.random.key_data(key), *jax.tree_util.tree_leaves(data)):
        array = np.ascontiguousarray(leaf)
        found.update(f"{array.dtype} {array.shape}".encode())
        found.update(array.data)
    return found.digest()
