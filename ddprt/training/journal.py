"""What training writes down: losses as JSON lines, and checkpoints from which it goes on bit for bit.

Nothing is written unless somebody asked for it by `keeping`. A checkpoint holds the number of steps, parameters, moments and
the best so far, and a hash of what it belongs to, the key among it; the order of data follows from key and step.
"""

import hashlib
import importlib.util
import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
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
      anew: is told, in words, that a checkpoint of another training makes way; None refuses such a checkpoint.
      names: how often each name was trained under so far.
      earlier: seconds that interrupted runs spent on what was found in checkpoints.
    """

    folder: Path | None = None
    stage: Stage | None = None
    tensorboard: bool = False
    every: float = 10.0
    anew: Callable[[str], None] | None = None
    names: dict[str, int] = field(default_factory=dict)
    earlier: float = 0.0

    def called(self, name: str) -> str:
        """The name, numbered from the second training of that name on."""
        self.names[name] = count = self.names.get(name, 0) + 1
        return name if count == 1 else f"{name}-{count}"


_keeping: ContextVar[Keeping | None] = ContextVar("keeping", default=None)


@contextmanager
def keeping(
    folder: str | Path | None,
    stage: Stage | None = None,
    *,
    tensorboard: bool = False,
    every: float = 10.0,
    anew: Callable[[str], None] | None = None,
) -> Iterator[Keeping]:
    """Trainings in this block write into a folder, and go on from checkpoints that lie there.

    Args:
      folder: made where it is missing; NAME.jsonl and NAME.safetensors for each training.
      stage: shows steps and losses if given.
      tensorboard: event files too.
      every: seconds between checkpoints.
      anew: trains from the start where a checkpoint is of other settings, data or another seed, and is told so; without it
        such a checkpoint is an error.
    Raises:
      UserError: event files are asked for, and the package that writes them is missing.
    """
    if tensorboard and importlib.util.find_spec("tensorboardX") is None:
        raise UserError("tensorboard: got no package tensorboardX, expected it; install ddprt[tensorboard], or leave it out")
    kept = Keeping(None if folder is None else Path(folder), stage, tensorboard, every, anew)
    token = _keeping.set(kept)
    try:
        yield kept
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
        self._before = 0.0  # seconds of the runs before this one
        self._paced = 0, self._begun  # steps and moment that the pace counts from

    def resumed(self, state: Any) -> tuple[Any, list[Entry]]:
        """The state and the looks to go on from: those of a checkpoint, if there is one.

        Raises:
          UserError: it is of another training and none is to begin anew, or it is damaged.
        """
        history = list[Entry]()
        if self.path is not None:
            make_folder(self.path.parent)
            if self.path.exists():
                state, history = self._read(state)
            self._open(history)
        found = history[-1].step if history else 0
        self._paced = found, self._begun
        if self.where.stage is not None:
            self.where.stage.pace(self.where.stage.done + self.schedule.round * self.schedule.rounds)
            self.where.stage.advance(found, found=True)
            if found:
                self.where.stage.facts["went_on_from_step"] = found
        return state, history

    def add(self, entry: Entry, state: Any, history: Sequence[Entry]) -> None:
        """Notes a look, and saves the state now and then."""
        now = time.perf_counter()
        pace = (entry.step - self._paced[0]) / max(now - self._paced[1], 1e-9)
        if self._paced[1] == self._begun:  # what the first round waits for is compiled once, and is no pace
            self._paced = entry.step, now
        if self._lines is not None:
            print(_line(entry, self._before + now - self._begun, pace), file=self._lines, flush=True)
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
            if self.where.anew is not None:
                self.where.anew(f"{self.path}: settings, data or seed are others than those of this checkpoint; trains anew")
                self.path.unlink()
                return state, []
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
        path, events = self.path.with_suffix(".jsonl"), self.path.with_suffix(".events")
        found = {int(line["step"]): line for line in read_lines(path)} if history else {}
        kept = [found.get(entry.step) or json.loads(_line(entry, None, None)) for entry in history]
        write_text(path, "".join(json.dumps(line) + "\n" for line in kept))
        self._before = max((line["seconds"] or 0.0 for line in kept), default=0.0)
        self.where.earlier += self._before
        self._lines = path.open("a", encoding="utf-8")
        if self.where.tensorboard:
            from tensorboardX import SummaryWriter

            if not history:
                shutil.rmtree(events, ignore_errors=True)
            self._events = SummaryWriter(str(events), purge_step=history[-1].step + 1 if history else None)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON lines of a training, as far as they are whole: who was killed may leave half of one, and nothing after it.

    Returns:
      `Entry` as names and numbers (None for what was not finite), with "seconds" since the start, those of interrupted runs
      up to their last checkpoint counted in, and "steps_per_second"; none where there is no file.
    """
    lines = list[dict[str, Any]]()
    for line in path.read_text("utf-8").splitlines() if path.is_file() else []:
        try:
            lines.append(json.loads(line))
        except ValueError:
            break
    return lines


def seconds_of(folder: Path, looks: Sequence[tuple[int, float, float]]) -> list[float]:
    """Seconds since the start of each look (step, loss, validation) of a training, from the lines that it left.

    Returns:
      As many as looks; none for a training that left no lines in the folder, or whose lines do not know them all.
    """
    for path in sorted(folder.glob("*.jsonl")):
        lines = [line for line in read_lines(path) if None not in (line["loss"], line["validation"])]
        if [(line["step"], line["loss"], line["validation"]) for line in lines] == [tuple(look) for look in looks]:
            return [] if any(line["seconds"] is None for line in lines) else [line["seconds"] for line in lines]
    return []


def _line(entry: Entry, seconds: float | None, pace: float | None) -> str:
    told = {**entry._asdict(), "seconds": seconds and round(seconds, 4), "steps_per_second": pace and round(pace, 2)}
    return json.dumps({key: value if value is not None and np.isfinite(value) else None for key, value in told.items()})


def _leaves(state: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_flatten_with_path(state)[0]


def _identity(problem: Any, schedule: Schedule, key: Array, data: Any) -> bytes:
    found = hashlib.sha256(f"{type(problem).__qualname__} {problem!r} {schedule!r}".encode())
    for leaf in (jax.random.key_data(key), *jax.tree_util.tree_leaves(data)):
        array = np.ascontiguousarray(leaf)
        found.update(f"{array.dtype} {array.shape}".encode())
        found.update(array.data)
    return found.digest()
