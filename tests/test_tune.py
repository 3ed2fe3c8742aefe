"""The search for a setting within a budget: on real small bakes, and its pure parts against what they are short for."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_job import SMALL, base, call

import ddprt
from ddprt.bench.measure import trial as trials
from ddprt.bench.measure.settings import Setting, changed
from ddprt.bench.measure.timing import Timing
from ddprt.bench.measure.trial import Workshop
from ddprt.bench.tune import curves
from ddprt.bench.tune import search as tuning
from ddprt.bench.tune.curves import first_bases, middle, spread_of_time, time_of_frame, with_measured
from ddprt.bench.tune.held_out import HeldOut, spread_of
from ddprt.bench.tune.knobs import FACTORS, around, value_of
from ddprt.bench.tune.outcome import Doubt, Outcome
from ddprt.bench.tune.planner import KNOBS, QUANTITIES, Guess, Plan, Trial, seconds
from ddprt.bench.tune.search import Search, told, tune
from ddprt.config import Config, load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.files import alone_in
from ddprt.pipeline import Run
from ddprt.progress import Progress
from ddprt.report.metrics import Tally
from ddprt.runtime.precision import shipped_bytes, stored
from ddprt.runtime.train import fit_config

QUIET = Progress(quiet=True)
ROOMY = {"tune__max_relative_rmse": 5.0, "tune__max_megabytes": 5.0, "bench__keep": True}


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """A search that a budget with room ends at once, and whose datasets stay."""
    folder = tmp_path_factory.mktemp("tune")
    return folder, tune(base(**ROOMY), folder, QUIET)


@pytest.fixture(scope="module")
def data(tuned: tuple[Path, Outcome]) -> Dataset:
    return Workshop(base(), tuned[0], QUIET).bake(Setting({}, base()))[0]


def test_a_budget_with_room_is_met_in_one_trial(tuned: tuple[Path, Outcome]) -> None:
    folder, outcome = tuned
    assert outcome.met
    assert outcome.trials == 1
    assert outcome.chance > 0.9
    assert set(outcome.reached) == set(QUANTITIES)
    assert outcome.reached["relative_rmse"] <= 5.0
    assert outcome.binding == "relative_rmse"
    names = {path.name for path in folder.iterdir()}
    assert {"tuned.toml", "trials.jsonl", "datasets"} <= names
    assert "nearest.toml" not in names
    (line,) = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()]
    assert {"trial", "bake", "environment", "config", "digest"} <= set(line)
    assert line["trial"]["bases"] == sorted(line["trial"]["bases"])


def test_what_is_written_makes_it_again(
    tuned: tuple[Path, Outcome], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through the command line, from nothing: the same error to the last digit, the same bytes."""
    folder, outcome = tuned
    written, run = folder / "tuned.toml", tmp_path / "run"
    assert load_config(written) == outcome.setting.config
    assert call("bake", written, "--out", run, "--quiet") == 0
    assert call("fit", written, "--out", run, "--methods.compare", "['svd-ridge']", "--quiet") == 0
    precision = load_config(written).export.precision
    model = stored(ddprt.load_model(run / "model.ddprt"), precision)
    truth = Workshop(base(), folder, QUIET).yardstick
    assert truth.tally(model).scores()["relative_rmse"] == outcome.reached["relative_rmse"]
    assert shipped_bytes(model, precision) == round(1e6 * outcome.reached["megabytes"])


def test_the_table_tells_the_trade(tuned: tuple[Path, Outcome]) -> None:
    text = told(tuned[1])
    assert "meets the budget: fit.bases = " in text
    assert "the least room is left by relative_rmse" in text
    assert [line.split()[0] for line in text.splitlines()[1:6]] == list(QUANTITIES)
    assert "5 MB" in text
    assert "undecided" not in text


@pytest.mark.parametrize("met", [True, False])
@pytest.mark.parametrize("elsewhere", [True, False])
def test_what_cannot_be_shown_is_said_with_its_bounds(tuned: tuple[Path, Outcome], met: bool, elsewhere: bool) -> None:
    outcome = tuned[1]
    plan = replace(outcome.plan, bases=3) if elsewhere else outcome.plan
    doubt = Doubt(plan, Setting({"fit.bases": 3}, base()), 0.4, "relative_rmse", 5.1, 4.6, 5.9)
    text = told(replace(outcome, met=met, doubt=doubt))
    assert "undecided within 16%, it cannot be shown: relative_rmse lies at 5.1, between 4.6 and 5.9, the limit is 5" in text
    assert ("the chance that the limits are kept with fit.bases = 3 is 40%" in text) == elsewhere
    assert ("the chance that the limits are kept is 40%" in text) != elsewhere
    assert ("may meet the budget: " in text) == met
    assert ("no setting is known to meet the budget; nearest: " in text) != met
    assert "no setting meets" not in text
    assert "\nmeets" not in text


def test_what_cannot_be_shown_is_no_claim_that_nothing_meets_it(
    tuned: tuple[Path, Outcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    doubt = Doubt(tuned[1].plan, tuned[1].setting, 0.4, "frame_us", 5.1, 4.6, 5.9)
    monkeypatch.setattr(Run, "tune", lambda self: replace(tuned[1], met=False, doubt=doubt))
    (tmp_path / "job.toml").write_text(SMALL)
    assert call("tune", tmp_path / "job.toml", "--out", tmp_path / "run", "--max-frame-us", "5", "--quiet") == 2
    assert capsys.readouterr().err == (
        "ddprt: ddprt tune: got a budget that cannot be shown to be met, frame_us is in doubt; "
        f"raise --max-frame-us, or take {tmp_path / 'run' / 'tune' / 'nearest.toml'}\n"
    )


def test_a_search_that_was_stopped_bakes_nothing_again(tuned: tuple[Path, Outcome], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, before = tuned

    def forbidden(*_: Any, **__: Any) -> Dataset:
        raise AssertionError("baked again")

    monkeypatch.setattr(trials, "bake", forbidden)
    after = tune(base(**ROOMY), folder, QUIET)
    assert after.reached["relative_rmse"] == before.reached["relative_rmse"]
    assert after.reached["bake_seconds"] == before.reached["bake_seconds"]
    assert len((folder / "trials.jsonl").read_text().splitlines()) == 1, "those of the search before are not mixed in"


def test_what_cannot_be_met_is_one_line_and_a_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job, folder = tmp_path / "job.toml", tmp_path / "run" / "tune"
    job.write_text(SMALL)
    words = ["--out", tmp_path / "run", "--max-relative-rmse", "1e-4", "--max-frame-us", "1e9", "--tune.trials", "1", "--quiet"]
    folder.mkdir(parents=True)
    (folder / "tuned.toml").write_text("of an earlier budget")
    assert call("tune", job, *words) == 2
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        "ddprt: ddprt tune: got a budget that no setting meets, relative_rmse stands in the way; "
        f"raise --max-relative-rmse, or take {folder / 'nearest.toml'}"
    ]
    assert "no setting meets the budget; relative_rmse stands in the way; nearest: " in said.out
    assert "after 1 bakes" in said.out
    assert sorted(path.name for path in folder.iterdir()) == ["nearest.toml", "trials.jsonl"]
    assert load_config(folder / "nearest.toml").tune.max_relative_rmse == 1e-4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "ddprt tune: got no limit, expected at least one of --max-relative-rmse, --max-frame-us, --max-megabytes"),
        (["--max-frame-us", "0"], "got no limit"),
        (["--max-frame-us", "-1"], "max_frame_us: got -1, expected greater than or equal to 0"),
        (["--max-frame-us", "fast"], "max_frame_us: got 'fast', expected number"),
        (["--max-frame-us", "nan"], "max_frame_us: got nan, expected a finite number"),
        (["--max-frame-us"], "--max-frame-us: got no value"),
        (["--max-frame-us="], "--max-frame-us: got an empty value"),
        (["--max-frames", "3"], '--max-frames: unknown option; did you mean "max-frame-us"?'),
        (["--max-frame-us", "9", "--tune.trials", "0"], "--tune.trials: got 0"),
        (["--max-frame-us", "9", "--fit.method", "mean"], 'fit.method: got "mean", expected "svd-ridge"'),
        (["--max-frame-us", "9", "--methods.compare", "['svd']"], 'no method "svd"'),
        (["--max-frame-us", "9", "--lightings.target_error", "1"], "lightings.target_error: got 1, expected 0"),
        (["--max-frame-us", "9", "--points.count", "4000"], "points.count: got 4000, but"),
        (["--max-frame-us", "9", "--points.file", "no.json"], "no.json"),
        (["--max-frame-us", "9", "--lightings.file", "no.json"], "no.json"),
        (["--max-relative-rmse", "1", "--transport.bounces", "0"], "without indirect light"),
    ],
)
def test_wrong_words_are_one_line(words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job = tmp_path / "job.toml"
    job.write_text(SMALL)
    assert call("tune", job, "--out", tmp_path / "run", "--quiet", *words) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
    assert len(said) == 1
    assert message in said[0]
    assert "our fault" not in said[0]


def test_two_searches_at_once_are_one_too_many(tmp_path: Path) -> None:
    with alone_in(tmp_path), pytest.raises(UserError, match="working in this folder"):
        tune(base(tune__max_frame_us=1e9), tmp_path, QUIET)


# --- searches whose bakes are stood in for ---


class Bench:
    """Stands in for bakes: which places were asked for, and which of them can be made."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, works: Any = lambda place: True, off: float = 0.02) -> None:
        self.asked: list[tuple[float, ...]] = []
        self.reason = "points.count: got too many"

        def fake(search: Search, place: tuple[float, ...]) -> None:
            self.asked.append(place)
            if not works(place):
                raise UserError(self.reason)
            size = place[0] / search.base[0]
            error = 0.5 / size**0.3 * (search.base[1] / place[1]) ** 0.4
            curve = (error * 1.5, error)
            half = (size**2, 2 * size**2)
            search.planner.add(
                Trial(
                    place,
                    (4, 16),
                    curve,
                    0.05,
                    0.0,
                    (10.0, 20.0),
                    (off, off),
                    {"half": half, "float": half},
                    10 * size**1.5,
                    1.0,
                )
            )

        def verify(search: Search, plan: Plan) -> dict[str, float]:
            return {name: float(np.exp(guess.mean)) for name, guess in search.planner.guesses(plan).items()}

        def found(held_out: HeldOut) -> int:
            return 4

        monkeypatch.setattr(HeldOut, "more", lambda *_: False)
        monkeypatch.setattr(HeldOut, "count", property(found))
        monkeypatch.setattr(Search, "_try", fake)
        monkeypatch.setattr(Search, "_verify", verify)


def searching(tmp_path: Path, **changes: Any) -> Search:
    config = base(**changes)
    return Search(config, Workshop(config, tmp_path, QUIET))


def test_places_that_cannot_be_baked_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And those that cannot for the same reason with them, so that it is told once."""
    search = searching(tmp_path, tune__max_relative_rmse=0.42)
    search.workshop = replace(search.workshop, progress=Progress())
    bench = Bench(monkeypatch, lambda place: place[3] <= 12)
    outcome = search.run()
    assert outcome.met
    assert len(bench.asked) == len(set(bench.asked)), "nothing is tried twice"
    failed = [place for place in bench.asked if place[3] > 12]
    for later, place in enumerate(failed):
        barred = any(place[0] == tried[0] and place[3] >= tried[3] for tried in failed[:later])
        assert not barred, "as many points or more are not tried again at a resolution"
    alike = {
        place
        for place in product(*search.planner.values)
        if any(place[0] == tried[0] and place[3] >= tried[3] for tried in failed)
    }
    assert search.planner.barred == alike
    assert outcome.trials == len(bench.asked) - len(failed)
    assert capsys.readouterr().err.count("got too many") == len(failed)


def test_a_resolution_that_cannot_be_unwrapped_does_not_end_the_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though more places have it than trials are allowed."""
    search = searching(
        tmp_path, tune__max_bake_seconds=0.95, tune__max_relative_rmse=5.0, atlas__resolution=128, tune__trials=4
    )
    monkeypatch.setattr(Search, "_start", lambda search: search.base)
    bench = Bench(monkeypatch, lambda place: place[0] != 32)
    bench.reason = "atlas.resolution: got 32, expected more"
    every = [*product(*search.planner.values)]
    search.bar(next(place for place in every if place[0] == 32), bench.reason)
    assert search.planner.barred == {place for place in every if place[0] == 32}
    assert len(search.planner.barred) > 4
    outcome = search.run()
    assert 1 < outcome.trials <= 4
    assert not {place for place in bench.asked if place[0] == 32}


def test_where_only_the_base_can_be_baked_it_is_the_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching(tmp_path, tune__max_relative_rmse=0.42)
    bench = Bench(monkeypatch, lambda place: place == search.base)
    outcome = search.run()
    assert not outcome.met
    assert outcome.plan.place == search.base
    assert outcome.trials == 1
    assert len(bench.asked) <= 12, "tries that fail are tries, too"


def test_a_mean_counts_as_a_basis_and_is_none_alone(tmp_path: Path) -> None:
    """A fit refuses it, so that a search may not come to ask for it."""
    assert min(searching(tmp_path, tune__max_frame_us=1.0).planner.bases) == 1
    assert min(searching(tmp_path, tune__max_frame_us=1.0, fit__centre="mean").planner.bases) == 2


@pytest.mark.parametrize("works", [True, False])
def test_a_base_that_takes_too_long_is_begun_below(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, works: bool) -> None:
    expected = SimpleNamespace(training_seconds=1000.0)
    monkeypatch.setattr(tuning, "forecast", lambda *_: expected)
    search = searching(tmp_path, tune__max_bake_seconds=20.0, transport__samples="auto", transport__target_noise=0.012345)
    bench = Bench(monkeypatch, lambda place: works or place == search.base)
    assert search.run().met
    assert bench.asked[0] != search.base
    assert all(value in values for value, values in zip(bench.asked[0], search.planner.values, strict=True))
    assert (search.base in bench.asked) >= (not works), "what is coarser cannot be baked: the base is tried instead"


def test_of_plans_that_are_as_far_off_the_nearest_errs_least(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching(tmp_path, tune__max_bake_seconds=1e-3, tune__trials=1)
    Bench(monkeypatch)
    monkeypatch.setattr(Search, "_start", lambda search: search.base)
    outcome = search.run()
    assert outcome.binding == "bake_seconds"
    assert outcome.plan.bases >= 16, "the bake costs the same, however many bases are kept"


def test_the_nearest_to_a_limit_of_frames_far_out_of_reach_keeps_few_bases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching(tmp_path, tune__max_frame_us=1e-3, tune__trials=3)
    Bench(monkeypatch)
    outcome = search.run()
    assert not outcome.met
    assert outcome.plan.bases <= 4, "16 take twice as long"


def test_the_nearest_to_a_limit_of_bakes_far_out_of_reach_is_the_cheapest_that_was_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching(tmp_path, tune__max_bake_seconds=1e-4, tune__trials=3)
    bench = Bench(monkeypatch)
    monkeypatch.setattr(Search, "_start", lambda search: search.base)
    outcome = search.run()
    assert len(bench.asked) > 1
    assert outcome.plan.place[0] == min(place[0] for place in bench.asked) < search.base[0]
    assert outcome.plan.bases >= 16, "the bake costs the same, however many bases are kept"


def proposing(search: Search, monkeypatch: pytest.MonkeyPatch, *plans: Plan) -> None:
    """Has the planner propose these, the last one from then on."""
    left = list(plans)
    monkeypatch.setattr(search.planner, "next", lambda: (left.pop(0) if len(left) > 1 else left[0], 0.5))


def test_a_nearer_plan_that_was_tried_last_is_the_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where an earlier one was verified, and no trial is left for what looks better still."""
    search = searching(tmp_path, tune__max_relative_rmse=0.1, tune__trials=2)
    Bench(monkeypatch)
    better, best = ((*search.base[:1], factor * search.base[1], *search.base[2:]) for factor in (2, 4))
    proposing(search, monkeypatch, *(Plan(place, 16, "half") for place in (search.base, better, best)))
    outcome = search.run()
    assert outcome.trials == 2
    assert outcome.plan.place == better


def test_what_was_measured_within_the_limits_is_better_than_what_was_likelier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching(tmp_path, tune__max_relative_rmse=0.6, tune__max_frame_us=15.0)
    Bench(monkeypatch)
    within, beyond = Plan(search.base, 8, "half"), Plan(search.base, 12, "half")
    reached = {within: 0.599, beyond: 0.601}
    measured = {"frame_us": 14.9, "megabytes": 1.0, "bake_seconds": 1.0, "fit_seconds": 1.0}
    monkeypatch.setattr(Search, "_verify", lambda search, plan: {"relative_rmse": reached[plan], **measured})
    monkeypatch.setattr(search.planner, "rank", lambda plan: (-1.0 if plan == beyond else -2.0, 0.0, 0.0))
    proposing(search, monkeypatch, within, beyond)
    outcome = search.run()
    assert outcome.met
    assert outcome.plan == within


def test_a_frame_that_takes_as_long_as_it_may_is_in_doubt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the quartiles of a busy machine leave open is neither met nor refused, and no place is baked to be lucky at."""
    for limit, met, open_ in ((9.9, False, True), (10.1, True, True), (14.0, True, False), (6.0, False, False)):
        search = searching(tmp_path, tune__max_frame_us=limit)
        search.planner.values = [(value,) for value in search.base[:1]] + [*search.planner.values[1:]]
        search.bases = search.planner.bases = (4, 16)  # those that the bench knows
        bench = Bench(monkeypatch, off=0.1)
        outcome = search.run()
        assert outcome.met == met, limit
        assert (outcome.doubt is not None) == open_, limit
        if outcome.doubt:
            assert outcome.doubt.quantity == "frame_us"
            # Ten known to a tenth: 1.28 standard deviations of a Gaussian are exceeded once in ten.
            wide = np.exp(0.1 * 1.2815516)
            assert (outcome.doubt.low, outcome.doubt.high) == pytest.approx((10 / wide, 10 * wide), rel=1e-6)
            assert outcome.doubt.within == pytest.approx(wide - 1, rel=1e-6)
            assert len(bench.asked) == 1, limit


def test_a_search_ends_when_it_has_cost_its_share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an error that no setting is sure to keep to, whatever `tune.trials` allows."""
    search = searching(tmp_path, tune__max_relative_rmse=0.3, tune__trials=1000)
    bench = Bench(monkeypatch)
    monkeypatch.setattr(search.planner, "surer", lambda plan: None)
    most = [place for place in product(*search.planner.values) if place != search.base]

    def likely() -> tuple[Plan, float]:
        return Plan(most[len(bench.asked)], 16, "half"), 0.5

    monkeypatch.setattr(search.planner, "next", likely)
    outcome = search.run()
    whole = sum(10 * (place[0] / search.base[0]) ** 3 + 1 for place in product(*search.planner.values))
    spent = sum(map(seconds, search.planner.trials))
    dearest = max(map(seconds, search.planner.trials))
    # What all places cost is expected from those that were tried; the bench's law has another exponent than the prior's.
    assert 0.5 * 0.1 * whole - dearest < spent < 2 * 0.1 * whole
    assert 3 < outcome.trials < len(most)
    assert not outcome.met


def test_where_it_is_just_so_a_place_that_promises_more_is_baked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching(tmp_path, tune__max_relative_rmse=0.501)
    Bench(monkeypatch)
    outcome = search.run()
    assert outcome.trials > 1, "the base errs by 0.5, known to a twentieth"
    assert outcome.met
    assert outcome.doubt is None
    assert outcome.chance >= 0.9
    alone = searching(tmp_path, tune__max_relative_rmse=0.501)
    monkeypatch.setattr(alone.planner, "surer", lambda plan: None)
    monkeypatch.setattr(alone.planner, "next", lambda: (Plan(alone.base, 16, "half"), 0.5))
    outcome = alone.run()
    assert outcome.trials == 1
    assert outcome.met
    assert outcome.doubt is not None
    assert outcome.doubt.plan == outcome.plan
    assert outcome.doubt.low < 0.5 < 0.501 < outcome.doubt.high


def test_no_more_bakes_than_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching(tmp_path, tune__max_relative_rmse=0.3, tune__trials=2)
    bench = Bench(monkeypatch)
    assert search.run().trials <= 2
    assert len(bench.asked) <= 2


# --- pure parts ---


@pytest.mark.parametrize("knob", KNOBS)
@pytest.mark.parametrize("value", [2, 12, 16, 20, 32, 100, 181, 0.0005, 0.012345, 0.3, 1.0])
def test_a_knob_can_stay_where_it_is(knob: str, value: float) -> None:
    noise = knob == "transport.target_noise"
    if noise != (value <= 1) or (knob == "atlas.resolution" and value < 8):
        return
    config = changed(Config(), {knob: value})
    values = around(config, knob, float(value), FACTORS[knob])
    assert value in values
    assert list(values) == sorted(set(values))
    for each in values:
        changed(config, {knob: each if noise else round(each)})  # its setting takes it
    if knob == "atlas.resolution":
        assert max(values) == value, "never finer than the truth"


@pytest.mark.parametrize(
    ("changes", "still"),
    [
        ({"transport.samples": 8}, "transport.target_noise"),
        ({"points.file": "a.json"}, "points.count"),
        ({"lightings.file": "a.json"}, "lightings.train"),
    ],
)
def test_knobs_without_effect_are_not_turned(changes: dict[str, Any], still: str) -> None:
    config = changed(Config(), changes)
    for knob in KNOBS:
        assert (len(around(config, knob, value_of(config, knob), FACTORS[knob])) == 1) == (knob == still)


@pytest.mark.parametrize("centre", ["none", "mean"])
@pytest.mark.parametrize(("channels", "space"), [("mono", "linear"), ("multi", "gamma")])
def test_first_bases_are_a_fit_with_fewer(data: Dataset, centre: str, channels: str, space: str) -> None:
    how = {"fit.centre": centre, "fit.channels": channels, "fit.space": space, "fit.ridge": 1e-3}
    whole = fit_config(data, base(**{"fit.bases": 7, **how}), "svd-ridge")
    values = data.values(data.split("validation"), whole.points, whole.quantity)
    for count in (2 if centre == "mean" else 1, 3, whole.relighter.report.bases):
        fewer = fit_config(data, base(**{"fit.bases": count, **how}), "svd-ridge")
        short = first_bases(whole, count)
        assert short.relighter.report.bases == fewer.relighter.report.bases == count
        assert shipped_bytes(short, "half") == shipped_bytes(fewer, "half")
        light = fewer.predict(values)
        # The same vectors and columns, added up in another order: some ten float32 roundings of the largest value, times
        # the encoding's steepness, which near black is unbounded in gamma space only for what is far below that value.
        assert np.abs(short.predict(values) - light).max() <= 1e-5 * light.max()
    assert np.abs(first_bases(whole, 2).predict(values) - whole.predict(values)).max() > 1e-3 * whole.predict(values).max()


def tally(error: np.ndarray, mean: np.ndarray) -> Tally:
    count = len(error)
    flat = np.repeat(mean[:, None], 3, 1)
    return Tally(error, error, flat, flat, np.ones(count, np.float32))


def log_error(error: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return 0.5 * np.log(error.mean(-1)) - np.log(mean.mean(-1))


def test_spread_agrees_with_a_bootstrap() -> None:
    rng = np.random.default_rng(0)
    count, draws = 200, 4000
    error, mean = rng.lognormal(0, 0.5, count), rng.lognormal(0, 0.3, count)
    error *= mean**2  # brighter lightings err more, which a ratio partly takes out
    rows = rng.integers(0, count, (draws, count))
    logs = log_error(error[rows], mean[rows])
    spread, skew = spread_of(tally(error, mean))
    # A standard deviation of 4000 draws is known to 1 / sqrt(8000) = 1.1 %, five of which are 5.6 %; the two differ by
    # sqrt(199 / 200) and terms of second order, of a share 1 / 200 each.
    assert spread == pytest.approx(float(logs.std()), rel=0.056 + 0.0025 + 0.01)
    # The values that stand for the lightings, by the derivative of the logarithm, to terms of a share 1 / 200.
    values = 0.5 * error / error.mean() - mean / mean.mean() + 0.5
    assert skew == pytest.approx(np.mean(values**3) / np.mean(values**2) ** 1.5 / np.sqrt(count), rel=0.05)
    assert skew > 0.05


def test_spread_of_two_is_half_their_difference() -> None:
    error, mean = np.array([0.04, 0.25]), np.array([1.0, 2.0])
    # Leaving one out leaves the other: logs a and b, sqrt(1/2 * 2 * ((a - b) / 2)²). Two lie evenly about their middle.
    first, second = log_error(error[:1], mean[:1]), log_error(error[1:], mean[1:])
    assert spread_of(tally(error, mean)) == pytest.approx((abs(first - second) / 2, 0.0), rel=1e-12, abs=1e-12)


def test_spread_knows_no_units_and_nothing_of_one_lighting() -> None:
    rng = np.random.default_rng(1)
    error, mean = rng.lognormal(size=9), rng.lognormal(size=9)
    assert spread_of(tally(error * 1e-20, mean * 1e9)) == pytest.approx(spread_of(tally(error, mean)), rel=1e-9)
    assert spread_of(tally(np.ones(5), np.ones(5))) == pytest.approx((0, 0), abs=1e-12)
    assert spread_of(tally(error[:1], mean[:1])) == (1, 0)
    assert spread_of(tally(np.zeros(5), np.ones(5))) == (1, 0)


@pytest.mark.parametrize("count", [32, 128])
def test_a_sure_error_is_sure_although_few_lightings_make_most_of_it(count: int) -> None:
    """Squared errors as a corridor has them: of a lognormal of spread 1.2, the largest hundredth makes a tenth of the mean."""
    rng = np.random.default_rng(2)
    whole, draws = float(log_error(rng.lognormal(0, 1.2, 10**6), np.ones(1))), 1500
    sure = {"skewed": 0, "Gaussian": 0}
    for _ in range(draws):
        error = rng.lognormal(0, 1.2, count)
        spread, skew = spread_of(tally(error, np.ones(count)))
        for name, third in (("skewed", skew), ("Gaussian", 0.0)):
            # The limit is the error of all; it is within it just so, which is to be believed in one case of ten.
            chance = Guess(float(log_error(error, np.ones(1))), spread, third).chance(float(np.exp(whole)))
            sure[name] += chance > np.log(0.9)
    # Of 1500 draws a share of 0.1 is known to 0.0077, four of which are 0.031; what is left of the skew is of order 1 / count,
    # whose factor grows with the fourth moment: it is not derived but bounded by half the error of the Gaussian beyond that.
    wrong = {name: number / draws for name, number in sure.items()}
    assert wrong["Gaussian"] > 0.1 + 0.031, "what this is about"
    assert wrong["skewed"] < 0.1 + 0.031 + (wrong["Gaussian"] - 0.1) / 2


def test_a_measurement_takes_its_place_on_the_curves() -> None:
    place = (32.0, 8.0, 0.01, 12.0)
    sizes = {"half": (1.0, 2.0, 4.0), "float": (2.0, 4.0, 8.0)}
    known = Trial(place, (2, 4, 8), (0.3, 0.2, 0.1), 0.05, 0.1, (10.0, 11.0, 12.0), (0.01, 0.02, 0.03), sizes, 7.0, 3.0)
    reached = {"relative_rmse": 0.15, "frame_us": 20.0, "megabytes": 2.9, "bake_seconds": 99.0, "fit_seconds": 5.0}
    between = with_measured(known, Plan(place, 6, "half"), reached, 0.5, 0.2, 0.04)
    assert between.bases == (2, 4, 6, 8)
    assert between.errors == (0.3, 0.2, 0.15, 0.1)
    assert between.frame_us == (10.0, 11.0, 20.0, 12.0)
    assert between.frame_spread == (0.01, 0.02, 0.04, 0.03)
    assert between.megabytes == {"half": (1.0, 2.0, 2.9, 4.0), "float": (2.0, 4.0, 6.0, 8.0)}
    assert (between.error_spread, between.error_skew) == (0.5, 0.2)
    assert (between.bake_seconds, between.fit_seconds) == (7.0, 5.0)
    there = with_measured(known, Plan(place, 4, "float"), reached, 0.5, 0.2, 0.04)
    assert there.bases == known.bases
    assert there.errors == (0.3, 0.15, 0.1)
    assert there.megabytes == {"half": (1.0, 2.0, 4.0), "float": (2.0, 2.9, 8.0)}


def test_a_time_is_known_as_well_as_its_quartiles_and_two_measurements_tell() -> None:
    rng = np.random.default_rng(5)
    seconds = np.exp(0.2 * rng.normal(size=4000))
    low, median, high = np.quantile(seconds, [0.25, 0.5, 0.75])
    # Quartiles of 4000 draws: their distance is known to a share of 1.166 / sqrt(4000) = 1.8 %, five of which are 9.2 %.
    assert spread_of_time(Timing(median, low, high, 0.0, 4000)) == pytest.approx(0.2, rel=0.092)
    assert spread_of_time(Timing(1.0, 1.0, 1.0, 0.0, 1)) == 0
    assert spread_of_time(Timing(0.0, 0.0, 0.0, 0.0, 1)) == 1, "shorter than the clock tells"
    assert middle([(100.0, 0.02)]) == (100.0, 0.02)
    # A median of 101 Gaussians of logarithm, each as sure as it says: to terms of a share 1 / 101, and 4000 draws, of 1.1 %.
    draws = np.exp(0.2 * rng.normal(size=(4000, 101)))
    spread = float(np.median([middle([(each, 0.2) for each in row])[1] for row in draws[:200]]))
    assert np.log(np.median(draws, 1)).std() == pytest.approx(spread, rel=0.1)
    assert middle([(100.0, 0.01), (100.0, 0.01), (400.0, 0.01)])[0] == 100
    differ = np.log([1, 1, 4]).std(ddof=1) * np.sqrt(np.pi / 6)
    assert middle([(100.0, 0.01), (100.0, 0.01), (400.0, 0.01)])[1] == pytest.approx(differ, rel=1e-12), "whatever each says"


def test_a_time_near_its_limit_is_measured_again(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    model = fit_config(data, base(), "svd-ridge")
    told: list[float] = []

    def measured(*_: Any) -> tuple[float, float]:
        told.append(100.0)
        return 100.0, 0.1

    monkeypatch.setattr(curves, "_time_of_frame", measured)
    monkeypatch.setattr(curves, "_APART", 0.0)
    # Of n measurements a median is known to 0.1 sqrt(pi / 2 / n), of which 2.05 lie within the room to the limit:
    # n > (2.05 * 0.1)² pi / 2 / room², and the spread of one is 0.1 itself.
    for limit, count in ((None, 1), (300.0, 1), (81.0, 1), (112.0, 6), (86.0, 3), (101.0, 8)):
        told.clear()
        found = time_of_frame(model, np.zeros((1, 3), np.float32), limit=limit)
        assert len(told) == count, limit
        assert found[0] == 100
    told.clear()
    time_of_frame(model, np.zeros((1, 3), np.float32), limit=101.0, before=[(100.0, 0.1)] * 5)
    assert len(told) == 3, "what was measured before counts"


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"scene__name": "furnace", "scene__parameters": {"subdivisions": 2}},
        {"scene__name": "corridor"},
        {"scene__name": "statue", "scene__parameters": {"subdivisions": 2}, "lightings__distribution": "around"},
        {"lightings__choose": "active", "points__choose": "qr"},
        {"fit__centre": "mean", "fit__channels": "multi", "fit__space": "gamma"},
        {"atlas__resolution": 24, "lightings__train": 2, "points__count": 2},
    ],
    ids=["furnace", "corridor", "statue", "chosen", "multi", "tiny"],
)
def test_other_scenes_and_ways_are_tuned(changes: dict[str, Any], tmp_path: Path) -> None:
    outcome = tune(base(**changes, tune__max_relative_rmse=50.0, tune__max_bake_seconds=600.0), tmp_path, QUIET)
    assert outcome.met
    assert load_config(tmp_path / "tuned.toml") == outcome.setting.config
