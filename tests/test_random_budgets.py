"""What `experiments/frontier.py` asks of `tune`: it goes on where it was stopped, and judges refusals as a slow twin does."""

import json
import sys
import time
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from ddprt.bench.measure.settings import Setting
from ddprt.bench.peers import roofline
from ddprt.bench.tune.outcome import Doubt, Outcome
from ddprt.bench.tune.planner import Place, Plan, Trial
from ddprt.bench.tune.search import Search
from ddprt.errors import UserError

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import frontier
import frontier_peers
import frontier_tune

TRIAL = Trial(
    (32.0, 24.0, 0.02, 64.0),
    (1, 4, 16),
    (0.4, 0.2, 0.1),
    0.05,
    0.0,
    (50.0, 80.0, 200.0),
    (0.03, 0.03, 0.03),
    {"half": (0.1, 0.4, 1.6), "float": (0.2, 0.8, 3.2)},
    3.0,
    0.5,
)


@pytest.fixture
def visited(monkeypatch: pytest.MonkeyPatch) -> list[Place]:
    """Places where a bake would have been made; what is found there is made up."""
    seen: list[Place] = []

    def measure(_: Search, place: Place) -> Trial:
        seen.append(place)
        if len(seen) == 4:
            raise RuntimeError("power cut")
        return replace(TRIAL, place=place, bake_seconds=float(len(seen)))

    monkeypatch.setattr(Search, "measure", measure)
    return seen


def test_a_grid_goes_on_where_it_was_stopped(visited: list[Place], tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="power cut"):
        frontier_tune.Contest("cornell", tmp_path, quick=True).grid()
    known = frontier_tune.Contest("cornell", tmp_path, quick=True).grid()
    assert visited[3] == visited[4]  # the place that was cut off
    assert len(set(visited)) == len(visited) - 1 == len(known) == 8
    assert [known[place].bake_seconds for place in visited[:3]] == [1, 2, 3]
    assert list(known) == visited[:3] + visited[4:]
    frontier_tune.Contest("cornell", tmp_path, quick=True).grid()
    assert len(visited) == 9


def test_what_was_measured_of_other_settings_is_not_taken(visited: list[Place], tmp_path: Path) -> None:
    visited.extend([()] * 4)  # none is cut off
    frontier_tune.Contest("cornell", tmp_path, quick=True).grid()
    lines = (tmp_path / "grid.jsonl").read_text("utf-8").splitlines()
    for line in lines:
        entry = json.loads(line)
        entry["key"][1] = "another truth"
        (tmp_path / "grid.jsonl").write_text(json.dumps(entry) + "\n", "utf-8")
    frontier_tune.Contest("cornell", tmp_path, quick=True).grid()
    assert len(visited) == 4 + 2 * 8


def test_time_that_is_up_ends_it_in_one_line(visited: list[Place], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert frontier.tune(["cornell", "--minutes", "0", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().out == "cornell: 0 of 60 places measured, time is up; the same command goes on from here\n"
    assert not visited
    assert frontier_tune.Contest("cornell", tmp_path / "more", quick=True, until=time.monotonic() + 3600)
    assert (tmp_path / "cornell").is_dir()


def test_a_trial_comes_back_from_json() -> None:
    assert frontier_tune.trial_of(json.loads(json.dumps(asdict(TRIAL)))) == TRIAL
    assert frontier_tune.seconds(TRIAL) == 3.5


def test_refusals_are_judged_by_the_best_that_a_place_can_do() -> None:
    rng = np.random.default_rng(3)
    seen = set()
    for _ in range(200):
        room = rng.uniform(0.6, 1.8, 4)
        limits = {"relative_rmse": 0.2, "frame_us": 80.0, "megabytes": 0.4, "bake_seconds": 3.0}
        limits = {name: limit * share for (name, limit), share in zip(limits.items(), room, strict=True)}
        expected = []
        for bases, precision in product((1, 2, 4, 8, 16), ("half", "float")):
            # Curves are straight in logarithms between the numbers of bases that were scored.
            where = np.interp(np.log(bases), np.log(TRIAL.bases), range(3))
            low, share = min(int(where), 1), where - min(int(where), 1)

            def at(curve: tuple[float, ...], low: int = low, share: float = share) -> float:
                return float(curve[low] ** (1 - share) * curve[low + 1] ** share)

            cheap = at(TRIAL.frame_us) <= limits["frame_us"] and at(TRIAL.megabytes[precision]) <= limits["megabytes"]
            if cheap and limits["bake_seconds"] >= 3:
                expected.append((at(TRIAL.errors), bases))
        found = frontier_tune.best_within(TRIAL, limits, (1, 2, 4, 8, 16, 32), limits["relative_rmse"])
        # Known to a twentieth, without skew: one in a thousand is 3.09 standard deviations.
        hopeless = not expected or np.log(min(expected)[0] / limits["relative_rmse"]) > 0.05 * 3.0902
        assert (found is None) == hopeless, limits
        if found is not None:
            assert found[1].bases == min(expected)[1]
        seen.add((bool(expected), hopeless))
    assert seen == {(True, False), (True, True), (False, True)}


def test_an_error_is_pooled_over_the_first_or_all() -> None:
    error, mean = np.array([1.0, 4.0, 25.0]), np.array([[1.0] * 3, [3.0] * 3, [8.0] * 3])
    tally = frontier_tune.Tally(error, error, mean, mean, np.ones(3, np.float32))
    assert frontier_tune.pooled(tally) == pytest.approx(np.sqrt(10) / 4)
    assert frontier_tune.pooled(tally, 2) == pytest.approx(np.sqrt(2.5) / 2)


@pytest.mark.parametrize("met", [True, False])
@pytest.mark.parametrize(("truth", "held"), [(0.2, True), (0.16, True), (0.14, False), (0.26, False)])
def test_an_answer_that_cannot_be_shown_is_no_hit(
    met: bool, truth: float, held: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """But held, where what is in doubt lies within the bounds that were told; whichever side of the limit that is."""
    contest = frontier_tune.Contest("cornell", tmp_path, quick=True)
    limits = {"relative_rmse": 0.21, "frame_us": 80.0, "megabytes": 1.0, "bake_seconds": 9.0}
    plan, setting = Plan(TRIAL.place, 4, "half"), Setting({}, contest.base)
    doubt = Doubt(plan, setting, 0.5, "relative_rmse", 0.2, 0.15, 0.25)
    outcome = Outcome(plan, {}, 0.5, met, doubt, "relative_rmse", 2, 32, setting, limits)
    flat = np.ones((3, 3))
    tally = frontier_tune.Tally(np.full(3, truth**2), np.ones(3), flat, flat, np.ones(3, np.float32))
    monkeypatch.setattr(Search, "run", lambda _: outcome)
    monkeypatch.setattr(frontier_tune.Contest, "_tally", lambda *_: tally)
    monkeypatch.setattr(frontier_tune.Contest, "_frame_us", lambda *_: 90.0)
    answer = contest._answer(limits, {})
    assert (answer["right"], answer["undecided"], answer["held"]) == (False, True, held)
    assert answer["frame_beyond"] == met, "of settings that are said to do"
    assert answer["within"] == pytest.approx(0.2 / 0.15 - 1)


def test_a_resolution_that_cannot_be_unwrapped_is_left_out_and_told_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason, seen = 'atlas.resolution: got 24, expected more for the 90 charts of "faults"', []

    def measure(_: Search, place: Place) -> Trial:
        seen.append(place)
        if place[0] == 24:
            raise UserError(reason)
        return replace(TRIAL, place=place)

    monkeypatch.setattr(Search, "measure", measure)
    for _ in range(2):
        contest = frontier_tune.Contest("faults", tmp_path, quick=False)
        known = contest.grid()
        assert [place[0] for place in known] == [48.0] * 30
        assert set(contest.barred.values()) == {reason}
        assert len(contest.barred) == 30
        assert capsys.readouterr().out == f"  faults: 30 places cannot be baked: {reason}\n"
    assert len(seen) == 31, "one place tells of all that have its resolution, also to those that go on"
    search = contest.search({"max_megabytes": 1.0}, known)
    assert not search._tried(next(iter(contest.barred)))
    assert search.planner.barred == set(contest.barred)


def test_cold_models_lie_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = frontier_peers.Sizes(side=16, bases=3, points=5)
    monkeypatch.setattr(roofline, "cache_bytes", lambda: roofline.Cache(4 * 256 * 3, "told"))
    scenes = frontier_peers.cold_scenes(sizes, 0)
    assert len(scenes.models) == 1 + roofline.BEYOND
    bases = [frontier_peers.relight.learned(model).basis for model in scenes.models]
    assert len({jnp.asarray(basis).unsafe_buffer_pointer() for basis in bases}) == len(bases)
    assert all(np.array_equal(basis, bases[0]) for basis in bases)


def test_who_is_left_out_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    kept = frontier_peers._kept(frontier_peers.fit.PEERS, frontier_peers.QUICK_FIT)
    assert {peer.name for peer in kept} == set(frontier_peers.QUICK_FIT)
    told = capsys.readouterr().out
    assert all(peer.name in told for peer in frontier_peers.fit.PEERS if peer not in kept)
    assert {peer.name for peer in frontier_peers._kept(frontier_peers.relight.RELIGHT, frontier_peers.QUICK_RELIGHT)} == set(
        frontier_peers.QUICK_RELIGHT
    )
