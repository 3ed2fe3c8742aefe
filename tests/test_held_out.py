"""Held-out lightings that a search draws when those of the configuration do not tell: on real small bakes."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import base

from ddprt.bench.measure.settings import Setting
from ddprt.bench.measure.trial import Workshop
from ddprt.bench.measure.yardstick import Yardstick
from ddprt.bench.tune import held_out as module
from ddprt.bench.tune import search as tuning
from ddprt.bench.tune.fitted import Fitted
from ddprt.bench.tune.held_out import HeldOut, error_of, spread_of
from ddprt.bench.tune.planner import Plan, Planner
from ddprt.bench.tune.search import Search
from ddprt.bench.tune.suspects import draw_candidates, unknown
from ddprt.config import Config
from ddprt.lights import lighting_json, parse_lighting
from ddprt.progress import Progress
from ddprt.runtime.train import fit_config

QUIET = Progress(quiet=True)


@pytest.fixture(scope="module", autouse=True)
def few_candidates() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(draw_candidates, "__defaults__", (24,))
        yield


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(base(), tmp_path_factory.mktemp("held-out"), QUIET)


@pytest.fixture(scope="module")
def fitted(workshop: Workshop) -> Fitted:
    data, _ = workshop.bake(Setting({}, base()))
    model = fit_config(data, base(), "svd-ridge")
    return Fitted(model, data, {}, 0.0)


def drawn(held_out: HeldOut) -> list[str]:
    yardsticks = held_out.workshop.yardstick, *held_out._more
    return [repr(each.data.lightings[index]) for each in yardsticks for index in each.held_out]


@pytest.mark.slow
def test_each_time_there_are_more_of_the_same_density(workshop: Workshop, fitted: Fitted) -> None:
    held_out = HeldOut(workshop)
    assert held_out.count == 4
    first = drawn(held_out)
    assert not held_out.more(lambda: pytest.fail("asked for"), 0.5, 1.9, 2, lambda count, noise: 0.5 * count), "expected: 2 s"
    assert (held_out.seconds, held_out.count) == (0, 4)
    assert held_out.more(lambda: fitted, 0.5, 0.0), "what nobody expects anything of is not too dear"
    assert not held_out.more(lambda: fitted, 0.5, 0.0), "the second is"
    assert held_out.count == 8
    assert held_out.more(lambda: pytest.fail("drawn for another model"), 0.5, 1e9, 3)
    assert held_out.count == 24
    assert len({*drawn(held_out)}) > 8, "a candidate may come twice"
    assert drawn(held_out)[:4] == first
    candidates = json.loads(next(workshop.folder.glob("truth-*-candidates/lightings.json")).read_text())
    assert {*drawn(held_out)[4:]} < {repr(parse_lighting(each)) for each in candidates}
    again = HeldOut(workshop)
    assert again.more(lambda: fitted, 0.5, 0.0)
    assert drawn(again) == drawn(held_out)[:8]
    took = [
        json.loads(next(workshop.folder.glob(f"truth-*-{what}/took.json")).read_text())["seconds"]
        for what in ("candidates", "candidates-*", "0-4-*")
    ]
    assert again.seconds == pytest.approx(sum(took)), "what lay there is told as it was baked"
    assert again.seconds < held_out.seconds
    assert all(took)


def test_their_maps_are_as_fine_as_a_tenth_of_the_limit_asks(
    workshop: Workshop, fitted: Fitted, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Config] = []

    def note(_: Any, config: Config, *__: Any) -> Yardstick:
        asked.append(config)
        return workshop.yardstick

    monkeypatch.setattr(module, "make_yardstick", note)
    for limit, noise in ((0.5, 0.3), (4.0, 0.4), (100.0, 1.0)):  # the configuration's is 0.3
        assert HeldOut(workshop).more(lambda: fitted, limit, 0.0)
        assert asked[-1].bench.noise == noise


def test_errors_are_pooled_over_all_of_them_by_what_each_counts_for(workshop: Workshop, fitted: Fitted) -> None:
    model, data = fitted.model, fitted.data
    held_out = HeldOut(workshop)
    few = held_out.tally(model)
    assert held_out.spread(few) == spread_of(few, 2.0)
    held_out.more(lambda: fitted, 0.5, 0.0)
    told = {workshop.yardstick: replace(few, error=0 * few.error)}
    assert not held_out.tally(model, told).error[:4].any(), "what was told is not asked for again"
    assert set(told) == {workshop.yardstick, held_out._more[0]}
    tally, other = held_out.tally(model), held_out._more[0].tally(model)
    # Four drawn evenly and four by a density: each counts 8 / (4 + 4 d), d by what the model's own points measure.
    candidates = [parse_lighting(each) for each in json.loads(next(workshop.folder.glob("*-candidates/*s.json")).read_text())]
    known = data.values(data.split("train"), model.points, model.quantity)
    average = unknown(model.measure_all(candidates), known).mean()
    yardsticks = workshop.yardstick, held_out._more[0]
    lightings = [each.data.lightings[index] for each in yardsticks for index in each.held_out]
    density = 0.2 + 0.8 * unknown(model.measure_all(lightings), known) / average
    weight = 8 / (4 + 4 * density)
    assert tally.error == pytest.approx(weight * np.concatenate([few.error, other.error]), rel=1e-6)
    mean = (weight[:, None] * np.concatenate([few.mean, other.mean])).mean()
    assert error_of(tally) == pytest.approx(float(np.sqrt(tally.error.mean()) / mean), rel=1e-6)
    spread, skew = held_out.spread(tally)
    own = spread_of(tally)
    assert own[0] < spread < 2 * own[0], "few candidates more leave little open"
    assert abs(skew) <= abs(own[1])


def test_a_file_has_no_others(workshop: Workshop, tmp_path: Path) -> None:
    listed = tmp_path / "lamps.json"
    data, _ = workshop.bake(Setting({}, base()))
    listed.write_text(json.dumps([lighting_json(lighting) for lighting in data.lightings]))
    counts = {f"lightings__{split}": len(data.split(split)) for split in ("train", "validation", "test")}
    shop = Workshop(base(lightings__file=str(listed), **counts), tmp_path, QUIET)
    assert not HeldOut(shop).more(lambda: pytest.fail("asked for"), 0.5, 1e9)


def test_what_was_tried_is_scored_on_all_before_another_bake(workshop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit just below the error that few lightings tell: they are doubled until it is decided, or another setting is."""
    model = fit_config(workshop.bake(Setting({}, base()))[0], base(fit__bases=128), "svd-ridge")
    told = error_of(workshop.yardstick.tally(model))
    search = Search(base(tune__max_relative_rmse=0.97 * told, tune__trials=1), workshop)
    seen: list[Any] = []
    before = Planner.replace

    def note(planner: Planner, trial: Any) -> None:
        seen.append(trial)
        before(planner, trial)

    monkeypatch.setattr(Planner, "replace", note)
    monkeypatch.setattr(Planner, "undecided", lambda planner, plan: not seen and isinstance(plan, Plan))
    fits: list[int] = []
    monkeypatch.setattr(tuning, "fit_config", lambda data, config, name: fits.append(1) or fit_config(data, config, name))
    outcome = search.run()
    assert len(fits) == 2 * len(search._fits), "each setting once, and once before that is not timed"
    assert search.fitted(outcome.plan) is search._fits[outcome.plan.place, outcome.plan.bases]
    assert outcome.held_out == search.held_out.count == 16, "so near, twice as many are not likely to tell"
    (trial,) = seen
    model = fit_config(workshop.bake(Setting({}, base()))[0], base(fit__bases=trial.bases[-1]), "svd-ridge")
    # Stored as halves, which a trial's errors are of: a basis is rounded by a share of 2**-11, its light by no more.
    assert trial.errors[-1] == pytest.approx(error_of(search.held_out.tally(model)), abs=2 * 2**-11)
    assert trial.error_spread == pytest.approx(search.held_out.spread(search.held_out.tally(model))[0], rel=0.02)
    assert len(search.planner.trials) == 1
    monkeypatch.undo()
    assert search.planner.trials[0].errors[-1] == pytest.approx(trial.errors[-1], abs=1e-3)
