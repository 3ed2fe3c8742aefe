"""The training loop: it learns, stops, breaks off and goes on."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddprt.errors import UserError
from ddprt.progress import Progress
from ddprt.training import loop
from ddprt.training.journal import keeping, read_lines, seconds_of
from ddprt.training.loop import Trained, train
from ddprt.training.schedule import Schedule, rate

EPS32 = float(np.finfo(np.float32).eps)
SCHEDULE = Schedule(steps=400, check_every=20, learning_rate=0.05, weight_decay=0)


@dataclass(frozen=True)
class Line:
    """y = a x + b from a few pairs drawn anew for each step."""

    drawn: int = 8

    def initial(self, data: Any, key: jax.Array) -> dict[str, jax.Array]:
        return {"a": jax.random.normal(key, ()), "b": jnp.zeros(())}

    def loss(self, parameters: dict[str, jax.Array], data: Any, key: jax.Array) -> jax.Array:
        which = jax.random.choice(key, len(data["x"]), (self.drawn,))
        return self.check(parameters, {name: values[which] for name, values in data.items()})

    def check(self, parameters: dict[str, jax.Array], held: Any) -> jax.Array:
        x = held["x"].astype(parameters["a"].dtype)
        return jnp.mean((parameters["a"] * x + parameters["b"] - held["y"]).astype(jnp.float32) ** 2)


def pairs(seed: int, count: int = 64) -> dict[str, jax.Array]:
    x = jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, count), jnp.float32)
    return {"x": x, "y": 3 * x - 2}


def trained(schedule: Schedule = SCHEDULE, data: Any = None, seed: int = 0) -> Trained:
    return train("line", Line(), pairs(0) if data is None else data, pairs(1), schedule, jax.random.key(seed))


def bits(of: Trained) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(of.parameters)]


def broken_off(schedule: Schedule, folder: Path, rounds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trains so many rounds with a checkpoint after each, and is killed in the next."""
    whole = loop._round
    done = 0

    def some(*arguments: Any) -> Any:
        nonlocal done
        if done == rounds:
            raise KeyboardInterrupt
        done += 1
        return whole(*arguments)

    with monkeypatch.context() as patch, keeping(folder, every=0.0):
        patch.setattr(loop, "_round", some)
        with pytest.raises(KeyboardInterrupt):
            trained(schedule)


def test_it_finds_a_line() -> None:
    found = trained()
    # Adam's steps are no longer than the rate, which the cosine has brought below 0.05 (1 - cos(pi / 20)) / 2 = 3e-4 in the
    # last 20 of them.
    assert found.parameters["a"] == pytest.approx(3, abs=20 * 3e-4)
    assert found.parameters["b"] == pytest.approx(-2, abs=20 * 3e-4)
    assert [entry.step for entry in found.history] == list(range(20, 401, 20))
    assert found.trouble == ""


def test_the_best_is_kept() -> None:
    found = trained(SCHEDULE.model_copy(update={"learning_rate": 1.0}))
    kept = float(Line().check(found.parameters, pairs(1)))
    assert kept == pytest.approx(min(entry.validation for entry in found.history), rel=64 * EPS32)


def test_equal_keys_give_equal_bits_and_others_do_not() -> None:
    assert bits(trained()) == bits(trained())
    assert bits(trained()) != bits(trained(seed=1))


@pytest.mark.parametrize("rounds", [1, 7, 19])
def test_whoever_goes_on_gets_what_whoever_never_stopped_gets(
    rounds: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_off(SCHEDULE, tmp_path, rounds, monkeypatch)
    counted = []
    whole = loop._round
    monkeypatch.setattr(loop, "_round", lambda *arguments: counted.append(0) or whole(*arguments))
    with keeping(tmp_path):
        resumed = trained()
    assert len(counted) == SCHEDULE.rounds - rounds
    assert bits(resumed) == bits(trained())
    assert resumed.history == trained().history
    lines = [json.loads(line) for line in (tmp_path / "line.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [entry.step for entry in resumed.history]
    assert [line["validation"] for line in lines] == [entry.validation for entry in resumed.history]


def test_lines_past_the_checkpoint_come_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_off(SCHEDULE, tmp_path, 3, monkeypatch)
    kept = (tmp_path / "line.safetensors").read_bytes()
    broken_off(SCHEDULE, tmp_path, 2, monkeypatch)  # two more, of which the checkpoint below knows nothing
    (tmp_path / "line.safetensors").write_bytes(kept)
    with keeping(tmp_path):
        trained()
    steps = [json.loads(line)["step"] for line in (tmp_path / "line.jsonl").read_text().splitlines()]
    assert steps == list(range(20, 401, 20))


def test_a_finished_training_is_not_trained_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with keeping(tmp_path):
        first = trained()
    monkeypatch.setattr(loop, "_round", None)
    with keeping(tmp_path):
        assert bits(trained()) == bits(first)


@pytest.mark.parametrize(
    "other",
    [
        lambda: trained(SCHEDULE.model_copy(update={"learning_rate": 0.01})),
        lambda: trained(data=pairs(2)),
        lambda: trained(seed=5),
        lambda: train("line", Line(9), pairs(0), pairs(1), SCHEDULE, jax.random.key(0)),
    ],
    ids=["settings", "data", "seed", "problem"],
)
def test_a_checkpoint_of_another_training_is_refused(other: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_off(SCHEDULE, tmp_path, 2, monkeypatch)
    kept = (tmp_path / "line.safetensors").read_bytes()
    with keeping(tmp_path), pytest.raises(UserError, match="got a checkpoint of other settings, data or seed"):
        other()
    assert (tmp_path / "line.safetensors").read_bytes() == kept


def test_a_checkpoint_of_another_training_makes_way_where_that_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_off(SCHEDULE, tmp_path, 2, monkeypatch)
    said: list[str] = []
    with keeping(tmp_path, anew=said.append):
        found = trained(seed=5)
    assert len(said) == 1
    assert said[0].startswith(f"{tmp_path / 'line.safetensors'}: settings, data or seed are others")
    assert bits(found) == bits(trained(seed=5))
    assert len((tmp_path / "line.jsonl").read_text().splitlines()) == SCHEDULE.rounds
    with keeping(tmp_path, anew=said.append):  # its own checkpoint stands in nobody's way
        assert bits(trained(seed=5)) == bits(found)
    assert len(said) == 1


def test_trouble_is_not_forgotten_with_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gradient beyond float32 leaves parameters that are finite, and a checkpoint: whoever goes on has the trouble too."""
    whole = loop._round

    def bad(*arguments: Any) -> Any:
        state, seen = whole(*arguments)
        return state, seen.at[2].set(jnp.inf) if int(state.step) == 60 else seen

    with monkeypatch.context() as patch, keeping(tmp_path, every=0.0):
        patch.setattr(loop, "_round", bad)
        first = trained()
    assert first.trouble.startswith("the gradient was not finite by step 60, at a learning rate of 0.0")
    assert f"by step 40 the loss was {first.history[1].loss:.3g}" in first.trouble
    assert len(first.history) == 3
    with keeping(tmp_path):
        again = trained()
    assert (again.trouble, bits(again)) == (first.trouble, bits(first))
    assert again.history == first.history


def test_the_clock_goes_on_from_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_off(SCHEDULE, tmp_path, 4, monkeypatch)
    lines = read_lines(tmp_path / "line.jsonl")
    (tmp_path / "line.jsonl").write_text("".join(json.dumps({**line, "seconds": 100.0}) + "\n" for line in lines))
    with keeping(tmp_path) as kept:
        found = trained()
    assert kept.earlier == 100.0
    looks = [(entry.step, entry.loss, entry.validation) for entry in found.history]
    seconds = seconds_of(tmp_path, looks)
    assert seconds[:4] == [100.0] * 4
    assert all(100.0 <= moment < 1000.0 for moment in seconds[4:])
    assert len(seconds) == SCHEDULE.rounds
    assert seconds_of(tmp_path, looks[1:]) == []  # lines of another training
    (tmp_path / "line.jsonl").unlink()
    with keeping(tmp_path):
        trained()  # the looks are in the checkpoint, their seconds are not
    assert [line["step"] for line in read_lines(tmp_path / "line.jsonl")] == [entry.step for entry in found.history]
    assert seconds_of(tmp_path, looks) == []


def test_half_a_line_ends_the_lines(tmp_path: Path) -> None:
    (tmp_path / "line.jsonl").write_text('{"step": 1}\n{"step": 2, "lo')
    assert read_lines(tmp_path / "line.jsonl") == [{"step": 1}]
    assert read_lines(tmp_path / "none.jsonl") == []


def test_event_files_hold_what_the_lines_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever goes on takes back what was written past the checkpoint; whoever begins anew takes all of it back."""
    begun: list[tuple[str, int | None]] = []
    written: list[tuple[str, float, int]] = []

    class Writer:
        def __init__(self, folder: str, purge_step: int | None) -> None:
            begun.append((folder, purge_step))

        def add_scalar(self, name: str, value: float, step: int) -> None:
            written.append((name, value, step))

        def close(self) -> None:
            pass

    monkeypatch.setitem(sys.modules, "tensorboardX", SimpleNamespace(SummaryWriter=Writer))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    broken_off(SCHEDULE, tmp_path, 3, monkeypatch)
    with keeping(tmp_path, tensorboard=True):
        found = trained()
    folder = tmp_path / "line.events"
    assert begun == [(str(folder), 61)]
    assert [(value, step) for name, value, step in written if name == "validation"] == [
        (entry.validation, entry.step) for entry in found.history[3:]
    ]
    folder.mkdir()
    (folder / "events.old").write_text("")
    with keeping(tmp_path, tensorboard=True, anew=lambda _: None):
        trained(seed=5)
    assert begun[1] == (str(folder), None)
    assert not (folder / "events.old").exists()


def test_the_terminal_counts_all_trainings_of_a_stage() -> None:
    with Progress(quiet=True).stage("fit line") as stage, keeping(None, stage):
        trained()
        trained(seed=1)
        assert (stage.done, stage.total) == (800, 800)


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / "line.safetensors").write_bytes(b"half a checkpoint")
    with keeping(tmp_path), pytest.raises(UserError, match=r"line\.safetensors: not a whole tensor file"):
        trained()


def test_a_second_training_of_a_name_has_files_of_its_own(tmp_path: Path) -> None:
    with keeping(tmp_path):
        one, two = trained(), trained(seed=1)
    assert bits(one) != bits(two)
    assert {path.name for path in tmp_path.iterdir()} == {
        f"{name}{end}" for name in ("line", "line-2") for end in (".jsonl", ".safetensors")
    }


def test_nothing_is_written_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    trained()
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_are_not_finite_end_training_and_are_explained(tmp_path: Path) -> None:
    data = pairs(0)
    with keeping(tmp_path):
        found = trained(SCHEDULE.model_copy(update={"learning_rate": 1e38}), {**data, "y": data["y"] * 1e30})
    assert "not finite" in found.trouble
    assert "step 20" in found.trouble
    assert len(found.history) == 1
    assert np.isfinite(jax.tree.leaves(found.parameters)).all()
    line = json.loads((tmp_path / "line.jsonl").read_text().splitlines()[0])  # JSON knows no NaN
    assert None in line.values()
    assert not (tmp_path / "line.safetensors").exists()


def test_what_diverges_leaves_nothing_worse_than_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """After looks that are finite and far off, and one that is not."""
    whole = loop._round

    def bad(*arguments: Any) -> Any:
        state, seen = whole(*arguments)
        return state, seen.at[2].set(jnp.inf) if int(state.step) == 60 else seen

    monkeypatch.setattr(loop, "_round", bad)
    far = trained(SCHEDULE.model_copy(update={"learning_rate": 1e4}))
    assert min(look.validation for look in far.history) > 1e5
    assert far.trouble.endswith("the parameters it began with are kept")
    begun = Line().initial(pairs(0), jax.random.split(jax.random.key(0))[0])
    assert bits(far) == [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(begun)]


def test_patience_ends_training_that_gets_no_better() -> None:
    frozen = {**pairs(0), "y": jnp.full(64, jnp.float32(5))}  # leads away from what is held out
    patient = SCHEDULE.model_copy(update={"patience": 3})
    found = train("line", Line(), frozen, pairs(1), patient, jax.random.key(0))
    best = int(np.argmin([entry.validation for entry in found.history]))
    assert len(found.history) == best + 1 + 3 < SCHEDULE.rounds


def test_a_search_over_rates_and_lengths_compiles_once() -> None:
    trained()
    before = loop._round._cache_size()
    for changed in (
        {"learning_rate": 0.3},
        {"weight_decay": 0.1},
        {"steps": 600},
        {"warmup": 0.2},
        {"clip": 0.1},
        {"patience": 2},
    ):
        trained(SCHEDULE.model_copy(update=changed))
    assert loop._round._cache_size() == before


def test_the_rate_rises_and_falls() -> None:
    schedule = Schedule(steps=100, learning_rate=2.0, warmup=0.1)
    found = np.array([rate(schedule.numbers, jnp.int32(step)) for step in range(100)])
    np.testing.assert_allclose(found[:10], 2.0 * np.arange(1, 11) / 10, rtol=8 * EPS32)
    falling = 1 + np.cos(np.pi * np.arange(90) / 90)
    np.testing.assert_allclose(found[10:], falling, atol=16 * EPS32)  # float32's cosine, of angles up to pi


def test_weight_decay_draws_to_zero() -> None:
    """Without a gradient a parameter loses a share `rate` x `decay` of itself each step."""
    nothing = {"x": jnp.zeros(64), "y": jnp.zeros(64)}
    schedule = Schedule(steps=20, check_every=20, learning_rate=0.1, weight_decay=0.5)
    start = float(Line().initial(None, jax.random.split(jax.random.key(0))[0])["a"])
    paces = np.array([rate(schedule.numbers, jnp.int32(step)) for step in range(20)], np.float64)
    found = train("line", Line(), nothing, nothing, schedule, jax.random.key(0))
    # b stays at 0 and x is 0, so every check is 0 and the first round is kept.
    assert float(found.parameters["a"]) == pytest.approx(start * np.prod(1 - 0.5 * paces), rel=40 * EPS32)


def test_half_precision_learns_in_half_precision() -> None:
    half = trained(SCHEDULE.model_copy(update={"precision": "bfloat16"}))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(half.parameters))
    assert bits(half) != bits(trained())
    # bfloat16 rounds to 2^-9: of a and x, of their product, of b and of the sum, each at most 5.
    assert float(half.parameters["a"]) == pytest.approx(3, abs=5 * 5 * 2**-8)


def test_data_may_come_round_by_round() -> None:
    """The same arrays each time give the bits of arrays in memory; a round's own give that round's."""
    assert bits(trained(data=lambda number: pairs(0))) == bits(trained())
    asked = []
    trained(data=lambda number: asked.append(number) or pairs(number))
    assert asked == [0, *range(SCHEDULE.rounds)]


def test_the_terminal_is_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ddprt.progress._HEARTBEAT", 0.0)
    with Progress().stage("fit line") as stage, keeping(None, stage):
        trained()
    told = capsys.readouterr().err.splitlines()
    assert told[-2].startswith("fit line: 400 of 400 after")
    assert "validation" in told[-2]
    assert "steps/s" in told[-2]


def test_event_files_need_their_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"install ddprt\[tensorboard\]"), keeping(tmp_path, tensorboard=True):
        trained()
    assert list(tmp_path.iterdir()) == []
