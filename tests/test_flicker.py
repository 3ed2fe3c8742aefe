"""Light that is not there and light that will not keep still: negative shares and jitter in closed form."""

import numpy as np
import pytest

from ddprt.report.metrics import Truth, jitter, negative_share, negative_shares

EPS = float(np.finfo(np.float64).eps)


def even(texels: int) -> np.ndarray:
    return np.full(texels, 1 / texels)


def frames(values: list[float], texels: int = 4) -> np.ndarray:
    """The same value in every texel and channel of a frame."""
    return np.broadcast_to(np.float32(values)[:, None, None], (len(values), texels, 3)).copy()


# --- negative light ---------------------------------------------------------------------------------------------------


def test_negative_shares_by_hand() -> None:
    maps = np.float32([[[1, 0, 0], [-0.5, 0, 0]], [[2, 2, 0], [-1, 0, -3]], [[0, 0, 0], [0, 0, 0]]])
    weight = np.array([0.75, 0.25])
    np.testing.assert_array_equal(negative_shares(maps, weight), [0.125 / 0.75, 1.0 / 3.0, 0.0])
    assert negative_share(maps, weight) == 1.125 / 3.75
    assert negative_share(maps[2:], weight) == 0


def test_nothing_but_negative_light_is_no_good_sign() -> None:
    maps = np.float32([[[-1, 0, 0]], [[1, 0, 0]]])
    np.testing.assert_array_equal(negative_shares(maps, np.ones(1)), [np.inf, 0.0])
    assert negative_share(maps, np.ones(1)) == 1
    assert negative_share(maps[:1], np.ones(1)) == np.inf


def test_shares_of_lightings_sum_up_to_the_pooled_one() -> None:
    rng = np.random.default_rng(0)
    maps = (10.0 ** rng.uniform(-6, 6, (40, 1, 1)) * rng.normal(0.5, 1, (40, 50, 3))).astype(np.float32)
    weight = rng.dirichlet(np.ones(50))
    positive = np.einsum("ltc,t->l", np.maximum(maps, 0).astype(np.float64), weight)
    pooled = negative_shares(maps, weight) @ positive / positive.sum()
    # Sums of 150 and of 40 positive terms on either side, and a few products.
    assert abs(pooled - negative_share(maps, weight)) <= 2 * (150 + 40 + 5) * EPS * pooled


# --- flicker ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [[3, 3, 3, 3], [0, 0.5, 1, 1.5, 2], [8, 4, 0, -4]])
def test_light_that_stays_or_changes_evenly_has_none(values: list[float]) -> None:
    assert jitter(frames(values), even(4)) == 0


def test_jitter_in_closed_form() -> None:
    # Alternating between +a and -a: every second difference is 4 a.
    assert jitter(frames([0.25, -0.25] * 5), even(4)) == pytest.approx(1 / np.sqrt(6), rel=8 * EPS)
    # A jump of a among n second differences bends twice, by a and by -a.
    assert jitter(frames([0] * 6 + [1] * 6), even(4)) == pytest.approx(np.sqrt(2 / 10 / 6), rel=8 * EPS)
    # A parabola bends by 2 everywhere, and by a quarter of that in steps half as long.
    assert jitter(frames([0, 1, 4, 9, 16]), even(4)) == pytest.approx(2 / np.sqrt(6), rel=8 * EPS)
    assert jitter(frames([0, 0.25, 1, 2.25, 4]), even(4)) == pytest.approx(0.5 / np.sqrt(6), rel=8 * EPS)


def test_jitter_weighs_texels_by_area_and_averages_channels() -> None:
    light = np.zeros((6, 2, 3), np.float32)
    light[::2, 0, 1] = 1  # alternating by 1 in one channel of one texel: second differences of 2
    assert jitter(light, np.array([0.25, 0.75])) == pytest.approx(np.sqrt(0.25 * 4 / 3 / 6), rel=8 * EPS)


def test_independent_noise_reads_as_its_standard_deviation() -> None:
    count, texels, sigma = 200, 300, 0.01
    noise = np.random.default_rng(1).normal(0, sigma, (count, texels, 3)).astype(np.float32)
    # Second differences of white noise are correlated by 1, -4/6, 1/6: the variance of their mean square is 2 (1 + 2 (16 + 1)
    # / 36) over their number, relative; the root halves its deviation. Five deviations.
    allowed = 5 * 0.5 * np.sqrt(2 * (1 + 34 / 36) / (count * texels * 3))
    assert jitter(noise, even(texels)) == pytest.approx(sigma, rel=allowed)


def test_flicker_is_what_relighting_adds_over_the_mean() -> None:
    reference = frames([2, 4, 1, 3, 5, 3])  # mean 3, restless by itself
    truth = Truth(reference, np.ones(4))
    assert truth.flicker(reference) == 0
    assert truth.flicker(reference + frames([0, 1, 2, 3, 4, 5])) == 0
    assert truth.flicker(reference + frames([0.25, -0.25] * 3)) == pytest.approx(1 / np.sqrt(6) / 3, rel=8 * EPS)
    # A prediction that stands still where the light does not misses its jitter, and that counts as well.
    assert truth.flicker(np.ones_like(reference)) == pytest.approx(jitter(reference, even(4)) / 3, rel=8 * EPS)
    twice = Truth(2 * reference, np.ones(4))
    assert twice.flicker(4 * reference) == pytest.approx(truth.flicker(2 * reference), rel=8 * EPS)
    assert Truth(np.zeros_like(reference), np.ones(4)).flicker(reference) is None


def test_two_frames_are_no_path() -> None:
    with pytest.raises(ValueError, match="got 2, expected at least 3"):
        jitter(frames([1, 2]), even(4))
