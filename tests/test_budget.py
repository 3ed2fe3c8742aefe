"""The budget of error: an identity on real bakes, and each part moved by its own cause and by no other.

All budgets of this file share their bakes next to free of noise, so that what does not depend on a setting is the same bits.
"""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddprt.bench.budget import best_fit
from ddprt.bench.budget.advice import record, turn, weigh_knobs
from ddprt.bench.budget.bakes import Bakery
from ddprt.bench.budget.best_fit import best_transfer, projected, same_fit
from ddprt.bench.budget.budget import CAUSES, Budget, measure_budget, table
from ddprt.bench.budget.chain import Link, squared_error, take_apart
from ddprt.config import load_config
from ddprt.errors import UserError
from ddprt.export.formats.exr import LAYER
from ddprt.export.textures import export_textures
from ddprt.fitting.transfer import fit_transfer
from ddprt.lights import lighting_json
from ddprt.pipeline import Run
from ddprt.runtime.model import Model
from ddprt.runtime.precision import PRECISIONS, shipped_bytes, stored
from ddprt.scene.exr import read_exr

SMALL = {
    "atlas.resolution": "24",
    "lightings.train": "24",
    "lightings.validation": "3",
    "lightings.test": "2",
    "lightings.region_low": "[0.1, 0.5, 0.1]",
    "lightings.region_high": "[0.9, 0.8, 0.9]",
    "points.count": "24",
    "points.supersample": "4",
    "transport.samples": "256",
    "transport.test_samples": "16",
    "transport.threads": "2",
    "fit.bases": "6",
    "methods.compare": "[]",
    "budget.lightings": "12",
    "budget.noise": "0.02",
    "budget.abundance": "3",
    "budget.truth_samples": "256",
    "budget.shadow_map": "256",
}
NOTHING_BUT = {  # what a setting of the shipped model or its fit may move beside its own part
    "noise": {"clamp", "runtime mismatch", "quantisation", "noise"},
    "quantisation": {"clamp", "runtime mismatch", "quantisation"},
    "runtime mismatch": {"clamp", "runtime mismatch"},
}
LOW_LAMPS = {"region_low": [0.1, 0.05, 0.1], "region_high": [0.9, 0.3, 0.9]}


class Workshop:
    """Runs and budgets of this file, each made once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.made: dict[str, tuple[Budget, Model, Bakery]] = {}

    def bakery(self, **settings: Any) -> tuple[Run, Bakery]:
        """A run that was baked and where its budget is baked; nothing is fitted yet."""
        config = load_config(None, SMALL | {key.replace("__", "."): str(value) for key, value in settings.items()})
        baked = config.digest("atlas", "lightings", "points", "transport")
        run = Run(config, self.folder / baked, quiet=True)
        apart = f"budget-{config.seed}-{config.points.choose}-{bool(config.lightings.file)}"  # whose bakes are others
        return run, Bakery(run.scene, config, run.bake(), self.folder / apart, run.progress)

    def __call__(self, **settings: Any) -> tuple[Budget, Model, Bakery]:
        key = json.dumps({name: str(value) for name, value in settings.items()}, sort_keys=True)
        if key not in self.made:
            run, bakery = self.bakery(**settings)
            model = run.fit(bakery.data)[0][bakery.config.fit.method]
            self.made[key] = measure_budget(model, bakery), model, bakery
        return self.made[key]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(tmp_path_factory.mktemp("budget"))


def squares(budget: Budget) -> dict[str, float]:
    return {cause: budget.parts.part(cause) for cause in budget.parts.causes}


def moved(before: Budget, after: Budget) -> set[str]:
    """Parts that are not the same bits."""
    one, other = squares(before), squares(after)
    return {cause for cause in one if one[cause] != other[cause]}


def test_parts_and_cross_terms_are_the_error(workshop: Workshop) -> None:
    budget, model, bakery = workshop()
    from ddprt.bench.budget.budget import engine_values

    engine, _ = engine_values(model, budget.lightings, bakery.config.budget)
    ships = np.maximum(stored(model, "half").predict(engine, clamp=False), 0).astype(np.float64)
    one, other = (ships - half.astype(np.float64) for half in budget.truth)
    area = bakery.data.area
    mean = sum(float((half.astype(np.float64) * area[:, None]).sum()) for half in budget.truth) / 2
    mean /= area.sum() * 3 * len(ships)
    total = float((one * other * area[:, None]).sum() / area.sum() / (3 * len(ships))) / mean**2
    document = budget.parts.record()
    assert tuple(budget.parts.causes) == tuple(cause for cause in CAUSES if cause != "the rest")
    # Sums of some 1e5 products in float64, of which the terms may be a hundred times their sum.
    assert document["total"]["relative_square"] == pytest.approx(total, rel=1e-10)
    shares = [part["share"] for part in document["parts"]] + [pair["share"] for pair in document["cross_terms"]]
    assert sum(shares) == pytest.approx(1, abs=1e-10)
    assert document["closure"] == pytest.approx(sum(part["share"] for part in document["parts"]), abs=1e-12)


def test_noise_of_the_truth_is_in_no_part(workshop: Workshop) -> None:
    """A field that is the truth itself has a squared error of 0, although its halves are noisy."""
    budget, _, _ = workshop()
    mean = (budget.truth[0] + budget.truth[1]) / 2
    noisy = float(np.einsum("ltc,t->", (mean - budget.truth[0]).astype(np.float64) ** 2, budget.weight)) / (3 * len(mean))
    # The mean shares each half's noise: <m - a, m - b> = -||a - b||² / 4, whose sign tells that it is no square.
    assert squared_error(mean, budget.truth, budget.weight) == pytest.approx(-noisy, rel=1e-3)  # float32 means
    rng = np.random.default_rng(0)
    light = rng.uniform(1, 2, (8, 4000, 3)).astype(np.float32)
    one, other = (light + rng.normal(0, 0.5, light.shape).astype(np.float32) for _ in range(2))
    weight = np.full(4000, 1 / 4000)
    # Noise of variance 0.25 in either half: their product's mean over 96000 values is 0 to 0.25 / sqrt(96000).
    assert abs(squared_error(light, (one, other), weight)) < 5 * 0.25 / np.sqrt(light.size)


def test_projection_is_orthogonal_to_its_span(workshop: Workshop) -> None:
    budget, _, _ = workshop()
    causes, products = budget.parts.causes, budget.parts.products
    last = causes.index("truncation")
    whole = max(float((half.astype(np.float64) ** 2 * budget.weight[:, None]).sum() / (3 * len(half))) for half in budget.truth)
    for cause in ("noise", "regularisation", "measurement", "operator bias"):
        i = causes.index(cause)
        # Fields are rounded to float32 (2^-24 of the light) where they are encoded and decoded, four times at most: what is
        # left of a product is that of rounding with a step.
        assert abs(products[i, last]) < 4 * 2**-24 * np.sqrt(whole) * (np.sqrt(products[i, i]) + np.sqrt(products[last, last]))


@pytest.mark.slow
def test_parts_close(workshop: Workshop) -> None:
    """Cross terms stay within 5 %, by three standard errors of the mean over seeds, none of which was picked."""
    budgets = [workshop(seed=seed)[0] for seed in range(3)]
    closures = np.array([budget.parts.closure for budget in budgets])
    spread = closures.std(ddof=1) / np.sqrt(len(closures))
    chance = np.hypot.reduce([budget.chance for budget in budgets]) / len(budgets)
    assert abs(closures.mean() - 1) < 0.05 + 3 * np.hypot(spread, chance)


def test_best_transfer_leaves_nothing_linear(workshop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a ridge, over all that it is fitted on: what it leaves has no product with another transfer's answers."""
    budget, model, bakery = workshop()
    config = bakery.config
    parts = budget.yardsticks.unseen()
    monkeypatch.setattr(best_fit, "fit_transfer", partial(fit_transfer, ridge=0.0))
    values = np.concatenate([data.values(indices, model.points, model.quantity) for data, indices in parts])
    light = np.concatenate([data.maps("indirect", indices) for data, indices in parts])
    best = best_transfer(model, *parts).predict(values, clamp=False)
    other = same_fit(model, budget.yardsticks.bounded(budget.yardsticks.clean, budget.yardsticks.train), config)
    chain = [Link.sure("one", other.predict(values, clamp=False)), Link.sure("two", best)]
    products = take_apart([*chain, Link.sure("", projected(model, values, light))], budget.weight).products
    one, two = products[0, 0], products[1, 1]
    assert not set(parts[0][1]) & set(budget.yardsticks.clean.split("train")[: budget.yardsticks.train])
    # Matrices are float32: answers are off by 2^-24 (6e-8) of what their terms cancel, for which there is room a hundredfold.
    assert abs(products[0, 1]) < 100 * 2**-24 * np.sqrt(one * two)


def test_noise_to_the_basis_is_noise(workshop: Workshop) -> None:
    """Squares that move between parts leave their sum, and take what is left out beyond what a clean basis leaves out."""
    budget = workshop(transport__samples=8)[0]
    parts = budget.parts
    i, j = (parts.causes.index(cause) for cause in ("truncation", "noise"))
    left = [
        take_apart(
            [Link("", tuple(projected(m, budget.values, h) for h in budget.truth)), Link("", budget.truth)], budget.weight
        )
        for m in (budget.model, budget.clean)
    ]
    gross, clean = (float(one.products.sum()) for one in left)
    assert parts.squares.sum() == pytest.approx(np.trace(parts.products), rel=1e-12)
    assert parts.squares[i] == pytest.approx(clean, rel=1e-6)
    assert parts.squares[j] == pytest.approx(parts.products[j, j] + gross - clean, rel=1e-6)
    assert gross > 1.1 * clean


def test_noise_reacts_to_noisy_maps_alone(workshop: Workshop) -> None:
    plain, noisy = workshop()[0], workshop(transport__samples=8)[0]
    assert noisy.parts.part("noise") > 4 * plain.parts.part("noise")
    grown = noisy.parts.part("noise") - plain.parts.part("noise")
    others = moved(plain, noisy) - NOTHING_BUT["noise"]
    # Those stand on the noisy basis: they move with it, but less by an order of magnitude than what they are not about.
    assert others <= {"regularisation", "measurement", "operator bias", "truncation"}
    clean = [budget.parts.part("truncation") for budget in (plain, noisy)]
    assert clean[1] == pytest.approx(clean[0], rel=1e-12)  # taken out of another square: the same but for float64 rounding
    assert sum(abs(noisy.parts.part(cause) - plain.parts.part(cause)) for cause in others) < 0.1 * grown


def test_truncation_reacts_to_fewer_bases(workshop: Workshop) -> None:
    plain, fewer = workshop()[0], workshop(fit__bases=3)[0]
    assert fewer.parts.part("truncation") > 1.5 * plain.parts.part("truncation")
    assert fewer.parts.part("operator bias") <= plain.parts.part("operator bias")  # a smaller span shows less of it


def test_quantisation_reacts_to_fewer_bits(workshop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, exact = workshop()[0], workshop(export__precision="float")[0]
    assert exact.parts.part("quantisation") == 0 < plain.parts.part("quantisation")
    assert moved(plain, exact) <= NOTHING_BUT["quantisation"]
    monkeypatch.setitem(PRECISIONS, "half", (1, lambda values: (np.rint(7 * values) / 7).astype(np.float32)))
    _, model, bakery = workshop()
    crude = measure_budget(model, bakery)
    assert crude.parts.part("quantisation") > 1e4 * plain.parts.part("quantisation")  # 7 levels for 1024: 2e4 times the square
    assert moved(plain, crude) <= NOTHING_BUT["quantisation"]


def test_mismatch_reacts_to_the_shadow_map(workshop: Workshop) -> None:
    plain, coarse = workshop()[0], workshop(budget__shadow_map=8)[0]
    assert coarse.parts.part("runtime mismatch") > 4 * plain.parts.part("runtime mismatch")
    assert moved(plain, coarse) <= NOTHING_BUT["runtime mismatch"]


def test_regularisation_reacts_to_the_ridge(workshop: Workshop) -> None:
    plain, damped = workshop()[0], workshop(fit__ridge=3.0)[0]
    assert damped.parts.part("regularisation") > 2 * plain.parts.part("regularisation")
    same = {"scenario shift", "measurement", "truncation", "operator bias"}
    assert not moved(plain, damped) & same  # the basis does not know the ridge


@pytest.mark.slow
def test_scenario_shift_is_there_with_a_scenario_alone(workshop: Workshop) -> None:
    plain = workshop()[0]
    shifted = workshop(budget__scenario=json.dumps(LOW_LAMPS).replace(":", " ="))[0]
    assert plain.parts.part("scenario shift") == 0
    assert not plain.parts.products[plain.parts.causes.index("scenario shift")].any()
    assert shifted.parts.part("scenario shift") > 0.05 * shifted.parts.squared
    lamps = np.array([lighting[0].anchor() for lighting in shifted.lightings])
    low, high = shifted.clean.occluders.reshape(-1, 3).min(0), shifted.clean.occluders.reshape(-1, 3).max(0)
    assert (lamps[:, 1] < low[1] + 0.3 * (high - low)[1]).all()


@pytest.mark.slow
def test_other_spaces_and_methods(workshop: Workshop) -> None:
    bent = workshop(fit__space="gamma", fit__centre="mean", fit__channels="multi")[0]
    document = bent.parts.record()
    shares = [part["share"] for part in document["parts"]] + [pair["share"] for pair in document["cross_terms"]]
    assert sum(shares) == pytest.approx(1, abs=1e-10)
    assert 0.5 < document["closure"] < 1.5  # orthogonal in the encoded space only: told, and not bounded by any law
    budget, model, bakery = workshop(fit__method="nearest")
    assert budget.parts.causes == (
        "clamp", "runtime mismatch", "quantisation", "noise", "scenario shift", "the rest", "operator bias"
    )  # fmt: skip
    assert max(squares(budget), key=lambda cause: squares(budget)[cause]) == "the rest"
    assert {knob.cause for knob in weigh_knobs(budget, model, bakery)} <= set(budget.parts.causes)


def test_projection_and_best_transfer_are_the_best(workshop: Workshop) -> None:
    """No other coefficients come nearer to a field, and no other transfer to the lightings that it is fitted on."""
    budget = workshop()[0]
    model, data = budget.clean, budget.yardsticks.clean
    shown = projected(model, budget.values, budget.own[0])
    light = (budget.own[0], budget.own[0])
    least = squared_error(shown, light, budget.weight)
    again = projected(model, budget.values, shown)
    np.testing.assert_allclose(again, shown, atol=1e-5 * shown.max())  # of a projection nothing is left; float32 bases
    basis = np.asarray(model.relighter.basis)  # type: ignore[attr-defined]
    for vector in basis:
        nudge = 0.01 * shown.std() * np.repeat(vector[:, None], 3, 1)[None].astype(np.float32)
        assert squared_error(shown + nudge, light, budget.weight) > least
    train = data.split("train")
    best, values = best_transfer(model, (data, train)), data.values(train, model.points, model.quantity)
    trained = data.maps("indirect", train)
    error = squared_error(best.predict(values, clamp=False), (trained, trained), budget.weight)
    assert error < squared_error(model.predict(values, clamp=False), (trained, trained), budget.weight)


def test_the_first_knob_does_what_is_said(workshop: Workshop) -> None:
    budget, model, bakery = workshop()
    document = record(budget, model, bakery)
    assert document["schema"] == 1
    assert json.loads(json.dumps(document, allow_nan=False))
    first, done = document["predicted"][0], document["measured"]
    assert first["relative_rmse"] == min(knob["relative_rmse"] for knob in document["predicted"])
    gain, found = (document["now"]["relative_rmse"] - after["relative_rmse"] for after in (first, done))
    assert found > 0
    assert gain == pytest.approx(found, rel=0.5)  # a prediction that is out by more than half is none
    assert (first["bytes"], first["flops"]) == (done["bytes"], done["flops"])
    assert first["setting"] in document["advice"]
    assert f"{done['relative_rmse']:.2%}" in document["advice"]
    assert all(cause in table(document) for cause in budget.parts.causes)
    assert "exactly 0" in table(document)


def test_knobs_that_bake(workshop: Workshop) -> None:
    budget, _, bakery = workshop(transport__samples=8)
    knobs = {knob.cause: knob for knob in weigh_knobs(budget, *workshop(transport__samples=8)[1:])}
    done = turn(knobs["noise"], budget, bakery)
    assert knobs["noise"].setting == "transport.samples"
    assert knobs["noise"].then == 32
    assert done.relative_rmse < np.sqrt(budget.parts.squared)
    assert done.bake_seconds is not None
    assert turn(knobs["noise"], budget, bakery).bake_seconds is None


def test_points_chosen_by_lightings_are_taken_apart(workshop: Workshop) -> None:
    """Every bake of the budget measures at the points that the run's training lightings chose, and at no others."""
    even = workshop.bakery()[1].data
    _, bakery = workshop.bakery(points__choose="qr", budget__scenario="{region_low = [0.1, 0.05, 0.1]}", budget__abundance=2)
    yard, own = bakery.yardsticks(), bakery.data
    assert own.samples.digest != even.samples.digest
    assert yard.elsewhere is not None
    for other in (yard.clean, yard.truth, yard.elsewhere):
        assert other.samples.digest == own.samples.digest
        assert (other.samples.spacing, other.samples.depth) == (own.samples.spacing, own.samples.depth)
    train = [own.lightings[index] for index in own.split("train")]
    abundant = [yard.clean.lightings[index] for index in yard.clean.split("train")]
    assert abundant[: yard.train] == train
    assert len(abundant) == 2 * yard.train == len(yard.elsewhere.split("train"))
    assert not {*map(repr, train)} & {repr(yard.elsewhere.lightings[index]) for index in yard.elsewhere.split("train")}
    assert [yard.clean.lightings[i] for i in yard.clean.split("validation")] == [
        own.lightings[i] for i in own.split("validation")
    ]
    assert len(yard.clean.split("test")) == 12
    # Maps and measurements belong together: those of a training lighting are those of the run, but for what noise they have.
    there, here = yard.clean.measured([0]), own.measured([0])
    np.testing.assert_array_equal(there, here)
    (index,) = yard.clean.split("train")[:1]
    light, noisy = yard.clean.maps("indirect", [index]), own.maps("indirect", own.split("train")[:1])
    other = yard.clean.maps("indirect", yard.clean.split("train")[1:2])
    assert np.linalg.norm(light - noisy) < 0.5 * np.linalg.norm(other - noisy)


@pytest.mark.slow
def test_chosen_lightings_are_taken_apart(workshop: Workshop) -> None:
    """The trained ones are those that were chosen; what abounds is drawn, and held out as ever."""
    budget, _, bakery = workshop(lightings__choose="active", lightings__candidates=2)
    yard = budget.yardsticks
    assert yard.clean.lightings[: yard.train] == tuple(bakery.data.lightings[i] for i in bakery.data.split("train"))
    assert [*budget.lightings] == [*workshop()[0].lightings]
    assert budget.parts.record()["total"]["relative_square"] > 0


def listed(path: Path, lightings: list[Any]) -> str:
    path.write_text(json.dumps([lighting_json(lighting) for lighting in lightings]))
    return str(path)


def of_a_file(workshop: Workshop, folder: Path) -> dict[str, Any]:
    """Settings of a run whose lightings are listed: those of the plain one, of which more are held out."""
    clean = workshop.bakery()[1].yardsticks().clean
    kept = listed(folder / "lamps.json", [*clean.lightings[: 24 + 5 + 12]])
    return {"lightings__file": kept, "lightings__validation": 5, "lightings__test": 12, "fit__points": 16}


def test_lightings_of_a_file_are_those_that_it_holds_out(workshop: Workshop, tmp_path: Path) -> None:
    """The best transfer is fitted on them and on those of validation, and none is drawn."""
    _, bakery = workshop.bakery(**of_a_file(workshop, tmp_path))
    yard, own = bakery.yardsticks(), bakery.data
    held_out = [own.lightings[index] for index in own.split("test")]
    assert [yard.clean.lightings[index] for index in yard.clean.split("test")] == held_out
    assert len(yard.clean.split("train")) == yard.train == 24
    fitted = [data.lightings[index] for data, indices in yard.unseen() for index in indices]
    assert fitted == [own.lightings[index] for split in ("validation", "test") for index in own.split(split)]


@pytest.mark.slow
def test_lightings_of_a_file_are_taken_apart(workshop: Workshop, tmp_path: Path) -> None:
    budget, model, bakery = workshop(**of_a_file(workshop, tmp_path))
    assert budget.lightings == [bakery.data.lightings[index] for index in bakery.data.split("test")]
    shares = budget.parts.record()
    assert sum(part["share"] for part in shares["parts"]) + sum(pair["share"] for pair in shares["cross_terms"]) == (
        pytest.approx(1, abs=1e-10)
    )
    assert budget.parts.part("measurement") > 0
    assert "lightings.train" not in {knob.setting for knob in weigh_knobs(budget, model, bakery)}, "there are no more to list"


@pytest.mark.parametrize(
    ("section", "changes", "message"),
    [
        (
            "fit",
            {"points": 0},
            r"lightings\.file: got 3 \+ 2 of lamps\.json for validation and test, expected more than the 24",
        ),
        ("fit", {"points": 5}, r"expected more than the 5 points, since .* share out more of the file to lightings\.test"),
        (
            "budget",
            {"scenario": {"region_low": [0.1, 0.05, 0.1]}},
            r"budget\.scenario: got \{.*\} beside lightings\.file lamps",
        ),
    ],
)
def test_a_file_that_holds_out_too_few_is_told(workshop: Workshop, section: str, changes: dict[str, Any], message: str) -> None:
    _, model, bakery = workshop()
    file = bakery.config.lightings.model_copy(update={"file": "lamps.json"})
    changed = getattr(bakery.config, section).model_copy(update=changes)
    other = replace(bakery, config=bakery.config.model_copy(update={"lightings": file, section: changed}))
    with pytest.raises(UserError, match=message):
        measure_budget(model, other)


@pytest.mark.parametrize("channels", ["mono", pytest.param("multi", marks=pytest.mark.slow)])
def test_stored_is_what_the_export_holds(channels: str, workshop: Workshop, tmp_path: Path) -> None:
    from ddprt.runtime.train import fit

    model = fit(workshop()[2].data, bases=5, channels=channels, centre="mean")
    export_textures(model, tmp_path, precision="half", gutter=0, stitch=False)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    layers = [read_exr(tmp_path / name)[0][model.covered] for name in manifest["layers"]]
    kept = np.asarray(stored(model, "half").relighter.basis)  # type: ignore[attr-defined]
    for index, (vector, scale) in enumerate(zip(kept, manifest["basis_scale"], strict=True)):
        texture = layers[index // LAYER][:, index % LAYER] if channels == "mono" else layers[index].reshape(-1)
        np.testing.assert_allclose(texture * np.float32(scale), vector, rtol=1e-6)  # two float32 products
    mean = read_exr(tmp_path / "mean.exr")[0][model.covered].reshape(-1)
    np.testing.assert_array_equal(mean, np.asarray(stored(model, "half").relighter.mean))  # type: ignore[attr-defined]
    assert stored(model, "float") is model


def test_bytes_that_ship(workshop: Workshop) -> None:
    model = workshop()[1]
    relighter = model.relighter
    bases, entries = relighter.basis.shape  # type: ignore[attr-defined]
    empty = 4 * entries  # of the mean, which is not there
    assert shipped_bytes(model, "float") == relighter.nbytes - empty + 4 * bases
    assert shipped_bytes(model, "float") - shipped_bytes(model, "half") == 2 * bases * entries
    assert shipped_bytes(model, "half") - shipped_bytes(model, "byte") == bases * entries
    nearest = workshop(fit__method="nearest")[1]
    assert shipped_bytes(nearest, "float") == nearest.relighter.nbytes
    maps = np.asarray(nearest.relighter.maps)  # type: ignore[attr-defined]
    scales = len(maps)  # one for each lighting, as a texture has
    assert shipped_bytes(nearest, "half") == nearest.relighter.nbytes - 2 * maps.size + 4 * scales
    worse = [
        float(np.abs(stored(nearest, name).relighter.maps - nearest.relighter.maps).max())  # type: ignore[attr-defined]
        for name in ("float", "half", "byte")
    ]
    assert worse[0] == 0 < worse[1] < worse[2]
    largest = np.abs(maps).max((1, 2), keepdims=True)
    kept = np.float32(np.float16(maps / largest)) * largest
    np.testing.assert_array_equal(stored(nearest, "half").relighter.maps, kept)  # type: ignore[attr-defined]
    with pytest.raises(UserError, match='no precision "halb"'):
        stored(model, "halb")


def test_steps_are_told_apart_in_closed_form() -> None:
    """Two constant steps of 1 and 2 in the same direction: squares 1 and 4, a cross term of 4, nine in all."""
    field = lambda value: np.full((2, 5, 3), value, np.float32)  # noqa: E731
    parts = take_apart([Link.sure("one", field(4)), Link.sure("two", field(3)), Link.sure("", field(1))], np.full(5, 0.2))
    np.testing.assert_allclose(parts.products, [[1, 2], [2, 4]], rtol=1e-14)
    assert (parts.squared, parts.closure) == (pytest.approx(9), pytest.approx(5 / 9))
    assert parts.shrunk("one", 0.0) == pytest.approx(4)
    assert parts.shrunk("two", 0.25) == pytest.approx(4)
    assert parts.shrunk("three", 0.0) == pytest.approx(9)
    assert parts.part("three") == 0


def test_halves_that_differ_leave_nothing_over() -> None:
    rng = np.random.default_rng(1)
    draw = lambda: rng.normal(1, 1, (3, 7, 3)).astype(np.float32)  # noqa: E731
    chain = [Link.sure("one", draw()), Link("two", (draw(), draw())), Link("", (draw(), draw()))]
    document = take_apart(chain, np.full(7, 1 / 7)).record()
    shares = [part["share"] for part in document["parts"]] + [pair["share"] for pair in document["cross_terms"]]
    assert sum(shares) == pytest.approx(1, abs=1e-10)  # float64 sums of 63 products
