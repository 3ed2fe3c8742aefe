"""Leagues: what is tried, who is chosen by what, what counts as better, and how a contest that was stopped goes on."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from small_job import base
from small_rival import Gain

import ddprt
from ddprt.bench.leagues import contest
from ddprt.bench.leagues.contest import RESULTS, Contest
from ddprt.bench.leagues.deals import deal, method_seed
from ddprt.bench.leagues.leagues import judged, leagues
from ddprt.bench.leagues.search import BASELINE, Trial, rivals, trials_of
from ddprt.bench.leagues.standings import Budgets, Difference, budgets_of, chosen, difference, groups_of, pooled, standings
from ddprt.bench.leagues.words import against, failures, findings, markdown
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.methods import METHODS, known_methods
from ddprt.methods.mlp import Perceptron
from ddprt.progress import Progress
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.scene.library import SCENES
from ddprt.sections import LeaguesConfig

QUIET = Progress(quiet=True)
SMALL = {"leagues__trials": 2, "leagues__seeds": 2, "leagues__methods": ["gain"]}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return ddprt.bake(ddprt.load_scene("cornell"), config=base(), out=tmp_path_factory.mktemp("data"))


def test_all_methods_try_as_much_and_their_defaults_first() -> None:
    config = base(leagues__trials=5, fit__bases=8)
    for name in rivals(config):
        for seed in range(2):
            trials = trials_of(config, name, seed)
            assert trials[0].settings == {}
            assert len(trials) == (5 if METHODS[name].search else 1)
            assert len({json.dumps(trial.settings) for trial in trials}) == len(trials)
            assert trials == trials_of(config, name, seed)
    first, second = (trials_of(config, BASELINE, seed) for seed in range(2))
    assert first[1:] != second[1:]


def test_choices_come_evenly_and_bases_grow_with_the_configuration() -> None:
    search = METHODS[BASELINE].search["bases"]
    for bases in (16, 32):
        trials = trials_of(base(fit__bases=bases), BASELINE, 0, 1 + len(search))
        drawn = sorted(trial.settings["bases"] for trial in trials[1:])
        assert drawn == [round(choice * bases / 16) for choice in search]


@pytest.mark.parametrize("name", [name for name in known_methods() if METHODS[name].search])
def test_every_choice_is_taken(name: str) -> None:
    config = base()
    for key, choices in METHODS[name].search.items():
        for choice in choices:
            whole = Trial(name, 0, {key: choice}).configured(config)
            if key.startswith("fit."):
                assert getattr(whole.fit, key.removeprefix("fit.")) == choice
            assert Trial(name, 0, {key: choice}).digest(config, "data")


def test_floors_and_unknown_rivals_are_refused() -> None:
    assert not {"mean", "nearest"} & set(rivals(base()))
    with pytest.raises(UserError, match="a floor"):
        rivals(base(leagues__methods=["mean"]))
    with pytest.raises(UserError, match="did you mean"):
        rivals(base(leagues__methods=["nonegative"]))


def test_deals_share_out_the_same_lightings(data: Dataset) -> None:
    parts = [deal(data, 0, number) for number in range(3)]
    assert parts[0].description == data.description
    trained = [part.split("train") for part in parts]
    for part in parts:
        assert part.split("test") == data.split("test")
        pool = {*part.split("train"), *part.split("validation")}
        assert pool == {*data.split("train"), *data.split("validation")}
        assert len(part.split("train")) == len(data.split("train"))
    assert trained[1] != trained[0] != trained[2] != trained[1]
    fewer = deal(data, 0, 1, train=3)
    assert set(fewer.split("train")) < set(trained[1])
    assert len(fewer.split("train")) == 3
    assert fewer.split("validation") == parts[1].split("validation")
    assert method_seed(7, 0) == 7 != method_seed(7, 1) != method_seed(7, 2)


def trial(method: str, seed: int, validation: float, digest: str, **costs: Any) -> dict[str, Any]:
    spent = {"bytes": 100, "flops": 100, "seconds": 1.0, **costs}
    about = {"what": "trial", "method": method, "seed": seed, "settings": {}, "digest": digest}
    return {**about, "failed": None, "validation": validation, "curve": [], **spent}


def test_of_those_within_the_budget_validation_chooses() -> None:
    own = [
        trial("mlp", 0, 0.5, "a"),
        trial("mlp", 0, 0.1, "b", bytes=101),
        trial("mlp", 0, 0.3, "c", bytes=100, flops=999),
        {**trial("mlp", 0, 0.0, "d"), "failed": "broke"},
    ]
    budgets = Budgets(100, 100, 1.0)
    assert [chosen(own, league, budgets) for league in ("bytes", "flops", "seconds")] == [own[2], own[1], own[1]]
    assert chosen(own, "seconds", Budgets(1, 1, 0.5)) is None


def test_budgets_are_those_given_or_the_baselines() -> None:
    whole = [trial(BASELINE, 0, 0.1, "a", seconds=2.0), trial(BASELINE, 1, 0.1, "b", seconds=4.0)]
    assert budgets_of(LeaguesConfig(), whole) == Budgets(100, 100, 6.0)
    assert budgets_of(LeaguesConfig(bytes=5, flops=6, seconds=7.0), whole) == Budgets(5, 6, 7.0)


@pytest.mark.parametrize(
    ("mean", "spread", "doubt", "verdict"),
    [
        (-0.2, 0.1, 0.05, "better"),
        (0.2, 0.1, 0.05, "worse"),
        (-0.1, 0.1, 0.0, "within the spread"),
        (-0.2, 0.1, 0.2, "within the spread"),
        (-0.2, None, 0.0, "one seed"),
        (-0.0004, 0.0001, 0.0, "within the spread"),
        (-0.0006, 0.0001, 0.0, "better"),
    ],
)
def test_verdicts(mean: float, spread: float | None, doubt: float, verdict: str) -> None:
    assert Difference(mean, spread, doubt).verdict == verdict


def test_differences_are_paired_and_pooled() -> None:
    """Errors of 3 and 4 under light of mean 2 and 8: sqrt((9 + 16) / 2) / 5; twice of it is 100 % more for every seed."""
    record = {"error": [9.0, 16.0], "mean": [2.0, 8.0]}
    twice = {"error": [36.0, 64.0], "mean": [2.0, 8.0]}
    np.testing.assert_allclose(pooled([record]), math.sqrt(12.5) / 5, rtol=1e-15)
    np.testing.assert_allclose(pooled([record], [0]), 1.5, rtol=1e-15)
    found = difference([twice, record], [record, twice])
    # One seed has 100 % more, the other 50 % less, whatever lightings are drawn.
    np.testing.assert_allclose([found.mean, found.spread, found.doubt], [0.25, 1.5 / math.sqrt(2), 0], atol=1e-12)
    assert math.isnan(pooled([{"error": [1.0], "mean": [0.0]}])[0])


def test_lightings_are_told_apart_by_kind_or_by_distance() -> None:
    near = [{"kind": "point", "distance": distance} for distance in (0.1, 0.3, 0.2, 0.4)]
    assert list(groups_of(near).values()) == [[0, 2], [1, 3]]
    assert groups_of([*near, {"kind": "sphere", "distance": 1.0}]) == {"point": [0, 1, 2, 3], "sphere": [4]}
    assert groups_of([{"kind": "directional", "distance": None}] * 3) == {}


def made_up(rival: float) -> list[dict[str, Any]]:
    """Records of a baseline and of a rival that errs so many times as much; its second seed has no trial within the budget."""
    records: list[dict[str, Any]] = [
        {
            "what": "data",
            "lightings": [{"index": i, "kind": kind, "distance": None} for i, kind in enumerate(("point", "spot"))],
        }
    ]
    for method, factor in ((BASELINE, 1.0), ("mlp", rival), ("<b>", 1.0)):
        for seed in range(2):
            many = 101 if method == "<b>" and seed else 100
            name = f"{method} {seed}"
            records.append(trial(method, seed, 0.1, name, bytes=many))
            error = [(factor * (1 + 0.01 * seed)) ** 2, factor**2]
            told = {"relative_rmse": factor, "error": error, "squares": [4.0, 4.0], "mean": [2.0, 2.0]}
            place = {"machine": {"processor": "p", "cores": 2, "system": "s"}, "ddprt": "0", "commit": None}
            records.append(
                {"what": "test", "digest": name, "method": method, "frame": {"median": 1e-4}, "environment": place, **told}
            )
    return records


def test_a_table_says_who_wins_by_how_much_and_where() -> None:
    budgets = Budgets(100, 100, 1.5)
    table = standings(made_up(0.5), budgets, 2)
    assert [place.method for place in table["bytes"]] == ["mlp", BASELINE, "<b>"]
    first, _, out = table["bytes"]
    assert first.difference is not None
    assert first.difference.verdict == "better"
    np.testing.assert_allclose(first.difference.mean, -0.5, rtol=1e-12)
    assert first.groups is not None
    assert {name: found.verdict for name, found in first.groups.items()} == {
        "point": "within the spread", "spot": "within the spread",
    }  # fmt: skip  # one lighting of a kind says nothing about others
    assert out.why == "no trial keeps the budget for 1 of 2 seeds"
    told = findings(table, budgets, "box", 8, 2)
    assert told[
        0
    ] == "On box, with up to 8 trials each and 2 seeds, the baseline is beaten by more than the spread by mlp (leagues of " + (
        "shipped bytes and operations per frame and training seconds)."
    )
    assert "−50.0 ± 0.0" in told[1]
    assert "| mlp | 50.00 ± 0.00" in markdown(table, budgets, told, "box")
    worse = findings(standings(made_up(1.5), budgets, 2), budgets, "box", 8, 2)
    assert "not beaten" in worse[0]
    assert against(Difference(0.5, None, 0.0)) == "+50.0\u00a0%"


def test_few_lightings_leave_more_open() -> None:
    """Half of the 95 % interval of a mean of 2, of 4 and of 1000 values by Student: 12.7, 3.18 and 1.96 standard errors."""
    rng = np.random.default_rng(0)
    for count in (2, 4, 1000):
        base = [{"error": np.ones(count), "mean": np.ones(count)}]
        own = [{"error": (1 + 0.01 * rng.standard_normal(count)) ** 2, "mean": np.ones(count)}]
        relative = np.sqrt(own[0]["error"])
        half = stats.t.ppf(0.975, count - 1) * relative.std(ddof=1) / count**0.5
        np.testing.assert_allclose(difference(own, base).doubt, half, rtol=0.1)
    assert difference([{"error": [4.0], "mean": [1.0]}], [{"error": [1.0], "mean": [1.0]}]).doubt == np.inf


def test_trials_that_could_not_be_done_are_told() -> None:
    """Some of a method's; of one that could do none the table says it."""
    made = [
        {"what": "trial", "method": name, "failed": "kernel.nosuch: unknown setting" if fails else None}
        for name, fails in (("mlp", False), ("kernel", False), ("kernel", True), ("broken", True))
    ]
    assert failures(made) == ["1 of 2 trials of kernel could not be done; the first: kernel.nosuch: unknown setting."]


def test_half_a_line_goes_from_the_file_and_nothing_else(tmp_path: Path) -> None:
    path, other = tmp_path / "leagues.jsonl", json.dumps({"schema": 0, "of": "another version"})
    path.write_text(f'{other}\n{{"schema": 1, "wha\n{other}\n')
    assert contest.known(path, Progress(quiet=True)) == {}
    assert path.read_text() == f"{other}\n{other}\n"


def test_a_contest_chooses_before_it_looks_and_goes_on(data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, scene = base(**SMALL), ddprt.load_scene("cornell")
    monkeypatch.setitem(METHODS, "gain", Gain)
    monkeypatch.setattr(METHODS[BASELINE], "search", {"ridge": ("auto", 1e-5, 1e-3)})  # needs nothing compiled
    looked: list[str] = []
    real = contest.tally

    def noting(model: Any, part: Any, split: str) -> Any:
        looked.append(f"{model.method} {split}")
        return real(model, part, split)

    monkeypatch.setattr(contest, "tally", noting)
    records = Contest(config, data, scene, tmp_path, QUIET).run()
    for name in (BASELINE, "gain"):
        own = [split for method, split in map(str.split, looked) if method == name]
        assert own.count("validation") == 4
        assert 2 <= own.count("test") <= 4  # a trial in three leagues is looked at once
        assert own.index("test") >= 2  # both trials of the seed are over
    tests = [record["digest"] for record in records if record["what"] == "test"]
    assert len(set(tests)) == len(tests)
    table, budgets = judged(records, config)
    picked = [trial["digest"] for places in table.values() for place in places for trial in place.trials]
    assert set(tests) == set(picked)
    for league, places in table.items():
        for place in places:
            assert all(own[league] <= getattr(budgets, league) for own in place.trials)
    before, lines = (tmp_path / RESULTS).read_text(), len((tmp_path / RESULTS).read_text().splitlines())
    looked.clear()
    (tmp_path / ".fit-killed" / "x").mkdir(parents=True)
    again = Contest(config, data, scene, tmp_path, QUIET).run()
    assert not looked
    assert not list(tmp_path.glob(".fit-*"))
    assert [one.get("digest") for one in again] == [one.get("digest") for one in records]
    assert (tmp_path / RESULTS).read_text() == before
    cut = before.splitlines()
    (tmp_path / RESULTS).write_text("\n".join([*cut[:-1], cut[-1][:30]]) + "\n")
    Contest(config, data, scene, tmp_path, QUIET).run()
    assert len(looked) == 1
    assert len((tmp_path / RESULTS).read_text().splitlines()) == lines
    files = leagues(config, data, scene, tmp_path, QUIET)[1]
    page = files[2].read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "Best lighting of gain" in page


def test_settings_of_a_trial_are_those_it_is_fitted_with(data: Dataset, tmp_path: Path) -> None:
    config = base(**SMALL)
    own = Contest(config, data, SCENES["cornell"](), tmp_path, QUIET)
    three, gamma = Trial(BASELINE, 0, {"bases": 3}), Trial(BASELINE, 0, {"fit.space": "gamma"})
    assert own.model(three).relighter.basis.shape[0] == 3  # type: ignore[attr-defined]
    assert own.model(gamma).encoding.space == "gamma"
    plain = ddprt.fit(data, BASELINE, bases=4)
    assert np.array_equal(own.model(Trial(BASELINE, 0, {})).relighter.matrix, stored(plain, "half").relighter.matrix)  # type: ignore[attr-defined]


def test_a_baseline_that_cannot_be_fitted_is_told(data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METHODS, "gain", Gain)
    wrong: Config = base(**SMALL, fit__bases=1, fit__centre="mean")
    with pytest.raises(UserError, match="baseline that cannot be fitted"):
        Contest(wrong, data, SCENES["cornell"](), tmp_path, QUIET).run()


def test_maps_are_rounded_and_matrices_are_not(data: Dataset) -> None:
    """Of every method, so that bytes are judged alike; each map keeps its largest value, the others are off by half a step."""
    plain: Any = ddprt.fit(data, BASELINE, bases=4)
    weights = jax.random.normal(jax.random.key(0), (15, 4))
    relighter = Perceptron((weights,), (jnp.full(4, 0.1),), plain.relighter.basis, jnp.array([1.0, 0.3, 0.03, 0.003]))
    model = replace(plain, relighter=relighter)
    rounded: Any = stored(model, "byte").relighter
    assert np.array_equal(rounded.weights[0], weights)
    assert np.array_equal(rounded.spread, relighter.spread)
    basis = np.asarray(relighter.basis)
    off, largest = np.abs(np.asarray(rounded.basis) - basis), np.abs(basis).max(1, keepdims=True)
    assert (off <= largest * (0.5 / 127 + 1e-6)).all()  # half a step, and float32's rounding
    assert off.max() > 0
    assert shipped_bytes(model, "float") - shipped_bytes(model, "byte") == 3 * basis.size - 4 * 4
    assert shipped_bytes(model, "float") == relighter.nbytes
