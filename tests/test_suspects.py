"""Held-out lightings that are drawn where errors are likely to be large: what they count for, and what that buys."""

import numpy as np
import pytest

from ddprt.bench.tune.held_out import error_of, spread_of
from ddprt.bench.tune.planner import Guess
from ddprt.bench.tune.suspects import Suspects, balanced, unknown
from ddprt.report.metrics import Tally
from ddprt.sampling.design import RIDGE


def tally(error: np.ndarray, mean: np.ndarray) -> Tally:
    flat = np.repeat(mean[:, None], 3, 1)
    return Tally(error, error, flat, flat, np.ones(len(error), np.float32))


def test_what_is_unknown_is_the_variance_of_a_gaussian_process() -> None:
    """By its own formula, with an inverse and a loop."""
    rng = np.random.default_rng(0)
    values, trained = rng.random((6, 5, 3)), rng.random((2, 5, 3))
    rows = np.array([trained[at, :, c] / np.linalg.norm(trained[at, :, c]) for at in range(2) for c in range(3)])
    inverse = np.linalg.inv(rows @ rows.T + RIDGE * np.eye(6))
    for row, found in zip(values, unknown(values, trained), strict=True):
        wanted = 0.0
        for c in range(3):
            like = rows @ row[:, c]
            wanted += (1 + RIDGE) * row[:, c] @ row[:, c] - like @ inverse @ like
        assert found == pytest.approx(wanted, rel=1e-9)
    assert unknown(3 * values, 7 * trained) == pytest.approx(9 * unknown(values, trained), rel=1e-9)
    assert unknown(np.zeros((2, 5, 3)), trained) == pytest.approx([0, 0])
    # Of one that was trained on its own map leaves ridge / (1 + ridge), other channels less, and the ridge comes to that.
    known = unknown(trained[:1], trained[:1]) / (trained[0] ** 2).sum()
    assert RIDGE < known[0] < 2 * RIDGE


def world(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors as the Cornell box has them, and what goes along with them: 0.95 of its logarithm."""
    told = 1.5 * rng.normal(size=count)
    return np.exp(told + 0.5 * rng.normal(size=count)), np.exp(told)


def some(told: np.ndarray) -> Suspects:
    """Made without a model and lightings, which its statistics do not look at."""
    found = object.__new__(Suspects)
    mean = float(told.mean())
    for name, value in (("lightings", [()] * len(told)), ("mean", mean), ("density", 0.2 + 0.8 * told / mean)):
        object.__setattr__(found, name, value)
    return found


def test_means_stay_those_of_an_even_draw() -> None:
    rng, even, drawn = np.random.default_rng(1), 8, 24
    error, told = world(rng, 5000)
    light = 1 + told / told.mean()
    suspects, means = some(told), []
    for seed in range(3000):
        first = rng.integers(0, len(error), even)
        chosen = np.random.default_rng(seed).choice(5000, drawn, p=suspects.density / suspects.density.sum())
        assert seed or np.array_equal(suspects.draw(drawn, seed)[1], suspects.density[chosen])
        at = np.concatenate([first, chosen])
        found = balanced(tally(error[at], light[at]), suspects.density[at], even)
        means.append((found.error.mean(), found.mean.mean(), found.squares.mean(), found.bias.mean()))
    sure = np.std(means, 0) / np.sqrt(len(means))
    wanted = [error.mean(), light.mean(), error.mean(), light.mean()]
    assert (np.abs(np.mean(means, 0) - wanted) < 4 * sure).all()
    alone = balanced(tally(error[:8], light[:8]), suspects.density[:8], 8)
    assert np.array_equal(alone.error, error[:8]), "where all are even, none is weighed"


def test_a_claim_of_nine_in_ten_is_one() -> None:
    """Few even lightings claim too much; one more that is twice as bad, or lightings drawn where errors are large, do not."""
    rng, draws = np.random.default_rng(2), 1200
    error, told = world(rng, 100_000)
    whole, suspects = float(np.sqrt(error.mean())), some(told)
    density = suspects.density
    chance = np.cumsum(density) / density.sum()
    wrong = {"even": 0, "worse": 0, "suspects": 0}
    for _ in range(draws):
        at = rng.integers(0, len(error), 24)
        few = tally(error[at], np.ones(24))
        more = np.concatenate([at, np.searchsorted(chance, rng.random(24))])
        both = balanced(tally(error[more], np.ones(48)), density[more], 24)
        both = tally(both.error, np.ones(48))  # light is alike here, so that its mean is known
        for name, found, worse in (("even", few, 0.0), ("worse", few, 2.0), ("suspects", both, 0.0)):
            guess = Guess(float(np.log(error_of(found))), *spread_of(found, worse))
            wrong[name] += guess.chance(whole) > np.log(0.9)
    share = {name: number / draws for name, number in wrong.items()}
    # Of 1200 draws a share of 0.1 is known to 0.0087, four of which are 0.035.
    assert share["even"] > 0.1 + 0.07, "what this is about"
    assert share["worse"] < 0.1 + 0.035
    assert share["suspects"] < 0.1 + 0.035


def test_one_more_that_is_worse_widens_the_claim() -> None:
    error, more, even = np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 4.0, 8.0]), np.ones(4)
    assert spread_of(tally(error, even[:3]), 2.0) == spread_of(tally(more, even)) > spread_of(tally(error, even[:3]))
    # Brightness that varies as the errors do takes it out again; what is known does not become surer by what is made up.
    bright = np.array([1.0, 1.0, 3.0])
    assert spread_of(tally(error, bright), 2.0) == spread_of(tally(error, bright))
    assert spread_of(tally(more, np.append(bright, 3.0))) < spread_of(tally(error, bright))


def test_what_the_candidates_do_not_tell_is_told() -> None:
    """The mean of what is unknown, of so many candidates, against that of all."""
    rng, count, draws = np.random.default_rng(3), 400, 2000
    told = np.exp(0.7 * rng.normal(size=(draws, count)))
    spreads = np.array([some(row).spread for row in told[:200]])
    # Half the logarithm of a mean: its standard deviation is known to 1 / sqrt(4000) = 1.6 %, that of a spread to less.
    assert np.log(told.mean(1)).std() / 2 == pytest.approx(spreads.mean(), rel=0.08)
