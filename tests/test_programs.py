"""Compiled programs are let go before a process runs out of memory maps."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from ddprt.runtime import programs

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory maps are counted on Linux alone")


@pytest.fixture(autouse=True)
def long_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "_looked", [-programs._SECONDS])


def compiled() -> int:
    """How often a function of a new shape was traced, asked twice."""
    traced = []

    @jax.jit
    def function(values: jax.Array) -> jax.Array:
        traced.append(1)
        return values + 1

    function(jnp.ones(3))
    programs.make_room()
    function(jnp.ones(3))
    return len(traced)


def test_what_was_compiled_stays_while_there_is_room() -> None:
    assert compiled() == 1


def test_it_goes_where_maps_are_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit = tmp_path / "limit"
    limit.write_text("10")
    monkeypatch.setattr(programs, "_LIMIT", limit)
    assert compiled() == 2


def test_programs_really_leave_the_maps() -> None:
    """The sixty that are compiled here, each in a shape of its own."""
    maps = lambda: programs._MAPS.read_bytes().count(b"\n")  # noqa: E731
    jax.clear_caches()
    before = maps()
    functions = [jax.jit(lambda values, number=number: jnp.sin(values @ values.T).sum() + number) for number in range(60)]
    for number, function in enumerate(functions):
        function(jnp.ones((number + 2, 3)))
    full = maps()
    jax.clear_caches()
    assert full - before > 60
    assert maps() - before < (full - before) / 2


def test_nothing_is_done_where_nobody_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "_MAPS", tmp_path / "none")
    assert compiled() == 1
