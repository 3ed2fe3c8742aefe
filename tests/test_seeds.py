"""A random number is addressed by what it is for, never by when it is drawn."""

import numpy as np
import pytest

from ddprt import seeds


def test_an_address_gives_the_same_numbers_whatever_was_drawn_before() -> None:
    alone = seeds.stream(0, "lightings", 517).random(8)
    for index in range(517):
        seeds.stream(0, "lightings", index).random(index % 7)
    np.testing.assert_array_equal(seeds.stream(0, "lightings", 517).random(8), alone)
    assert seeds.number(0, "lightings", 517) == seeds.number(0, "lightings", 517)


def test_addresses_that_differ_give_numbers_that_differ() -> None:
    addresses = [
        (seed, name, *index) for seed in (0, 1) for name in ("a", "b", "ab") for index in ((), (0,), (1,), (0, 0), (0, 1))
    ]
    assert len({seeds.stream(*address).random() for address in addresses}) == len(addresses)
    assert len({seeds.number(*address) for address in addresses}) == len(addresses)


def test_streams_are_not_correlated() -> None:
    draws = np.array([seeds.stream(0, "x", index).random(1000) for index in range(100)])
    correlation = np.corrcoef(draws)[np.triu_indices(100, 1)]
    # Independent rows of 1000 have correlations of standard deviation 1 / sqrt(1000); 4950 of them reach 3.9 of it at most
    # in the median, and 5.5 with probability 2e-4.
    assert np.abs(correlation).max() < 5.5 / np.sqrt(1000)
    assert correlation.std() == pytest.approx(1 / np.sqrt(1000), rel=0.05)  # its own standard error is 1 %


def test_numbers_are_32_bit_integers() -> None:
    assert all(0 <= seeds.number(seed, "x", index) < 2**32 for seed in (0, 2**32 - 1) for index in range(50))
