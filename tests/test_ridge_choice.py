"""The choice of a ridge against brute force, and what might fool it; every status by a small dataset that calls for it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from suns import ALL_METHODS, sun_of

from ddprt.errors import UserError
from ddprt.fitting.selection import SECOND_OPINION, TWINS, Choice, choose_ridge, decompose, left_out
from ddprt.fitting.transfer import fit_transfer
from ddprt.methods import METHODS, make_method
from ddprt.methods.method import Examples, FitReport, Frame, unseen_share
from ddprt.methods.statuses import BLIND, NOTES, STATUSES, worst_first

EPS32, EPS64 = float(np.finfo(np.float32).eps), float(np.finfo(float).eps)


def problem(lightings: int, points: int, bases: int = 3, seed: int = 0, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    X = rng.random((lightings, points)).astype(np.float32)
    C = X @ rng.normal(size=(points, bases)) + noise * rng.normal(size=(lightings, bases))
    return X, C.astype(np.float32)


def refits(X: np.ndarray, C: np.ndarray, ridge: float, intercept: bool, group: np.ndarray | None = None) -> np.ndarray:
    """Squared error of each row, by a fit to all rows of other groups: least squares with rows of sqrt(ridge) below."""
    X, C = X.astype(float), C.astype(float)
    group = np.arange(len(X)) if group is None else group
    squares = []
    for left in range(len(X)):
        keep = group != group[left]
        x0, c0 = (X[keep].mean(0), C[keep].mean(0)) if intercept else (0.0, 0.0)
        A, B = X[keep] - x0, C[keep] - c0
        if ridge > 0:
            A = np.vstack([A, np.sqrt(ridge) * np.eye(X.shape[1])])
            B = np.vstack([B, np.zeros((X.shape[1], C.shape[1]))])
        M = np.linalg.lstsq(A, B, rcond=1e-12)[0]
        squares.append(((C[left] - c0 - (X[left] - x0) @ M) ** 2).sum())
    return np.array(squares)


def sensitivity(X: np.ndarray, ridge: float, intercept: bool) -> float:
    """Condition of the ridge problems that leaving a row out makes, the worst of them."""
    worst = 1.0
    for left in range(len(X)):
        A = np.delete(X.astype(float), left, 0)
        S = np.linalg.svd(A - A.mean(0) * intercept, compute_uv=False)
        S = S[1e-9 * S[0] < S] if len(S) and S[0] > 0 else np.ones(1)
        worst = max(worst, float(np.sqrt((S[0] ** 2 + ridge) / (S[-1] ** 2 + ridge))))
    return worst


@pytest.mark.parametrize("intercept", [False, True])
@pytest.mark.parametrize("ridge", [0.0, 1e-14, 1e-6, 1e-2, 1.0, 1e10])
@pytest.mark.parametrize(("lightings", "points"), [(25, 6), (8, 20), (12, 12), (3, 5), (4, 1)])
def test_leave_one_out_against_refits(lightings: int, points: int, ridge: float, intercept: bool) -> None:
    X, C = problem(lightings, points)
    got = left_out(decompose(jnp.asarray(X), jnp.asarray(C), intercept=intercept), np.array([ridge]))[0][0]
    exact = refits(X, C, ridge, intercept)
    # Both sides solve least squares backward stably: errors of eps64 times the condition, squared condition where residuals
    # are large (Wedin), times the number of terms. Where the ridge is tiny against the rows that leave it nothing to fit
    # (lightings <= points), the refit's own stacked system has the condition sqrt(S² + ridge) / sqrt(ridge) on top.
    stacked = np.sqrt(1 + np.linalg.norm(X, 2) ** 2 / ridge) if ridge > 0 and lightings <= points + 1 else 1.0
    condition = sensitivity(X, ridge, intercept)
    bound = 4 * (lightings + points) * EPS64 * condition * max(condition, stacked) * (C.astype(float) ** 2).sum()
    assert np.abs(got - exact).max() <= bound


@pytest.mark.parametrize("intercept", [False, True])
@pytest.mark.parametrize("ridge", [0.0, 1e-8, 0.1])
def test_twins_are_left_out_together(ridge: float, intercept: bool) -> None:
    """The same lamp at other brightnesses: scaled rows are equal up to rounding."""
    X, C = problem(10, 6)
    X[7], X[4] = X[1], X[1] * np.float32(1 + 2 * EPS32)
    spectrum = decompose(jnp.asarray(X), jnp.asarray(C), intercept=intercept)
    assert spectrum.group.tolist() == [0, 1, 2, 3, 1, 4, 5, 1, 6, 7]
    got = left_out(spectrum, np.array([ridge]))[0][0]
    exact = refits(X, C, ridge, intercept, spectrum.group)
    # Merging moves a row by at most TWINS of its size, the prediction by that times the condition and the size of C.
    bound = 4 * TWINS * sensitivity(X, ridge, intercept) * (C.astype(float) ** 2).sum()
    assert np.abs(got - exact).max() <= bound
    alone = refits(X, C, ridge, intercept)
    assert np.abs(got - alone).max() > 10 * bound, "a row whose twin stays would have been predicted by it"


def test_twins_do_not_change_the_matrix() -> None:
    X, C = problem(10, 6)
    X = np.concatenate([X, X[:3]])
    C = np.concatenate([C, C[:3] + np.float32(0.1)])
    for intercept in (False, True):
        M = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=0.01, intercept=intercept).matrix
        A, B = X.astype(float) - X.mean(0, dtype=float) * intercept, C.astype(float) - C.mean(0, dtype=float) * intercept
        exact = np.linalg.solve(A.T @ A + 0.01 * np.eye(6), A.T @ B).T
        condition = np.linalg.cond(A.T @ A + 0.01 * np.eye(6))
        np.testing.assert_allclose(M, exact, atol=(EPS32 + 20 * EPS64 * condition) * np.abs(exact).max(), rtol=0)


def test_twins_cannot_hide_noise() -> None:
    """Every lighting twice, targets that are pure noise alike in both: a plain leave-one-out would take ridge 0."""
    rng = np.random.default_rng(1)
    X = rng.random((8, 20)).astype(np.float32)
    C = rng.normal(size=(8, 3)).astype(np.float32)
    twice = fit_transfer(jnp.asarray(np.tile(X, (2, 1))), jnp.asarray(np.tile(C, (2, 1))))
    once = fit_transfer(jnp.asarray(X), jnp.asarray(C))
    grid = 10**0.25  # ridges per step; the doubled rows double S²
    assert twice.ridge / 2 == pytest.approx(once.ridge, rel=grid - 1)
    assert twice.ridge > 0


def test_all_channels_share_one_ridge_and_lose_a_lighting_together() -> None:
    """One matrix per channel, rows missing where a channel is dark, uneven weights: against a plain sum of refits."""
    importance, rows, spectra, data = [], [], [], []
    rng = np.random.default_rng(3)
    for channel, lit in enumerate((np.arange(9), np.array([0, 2, 3, 5, 8]), np.arange(1, 9))):
        X, C = problem(len(lit), 4, seed=channel)
        spectra.append(decompose(jnp.asarray(X), jnp.asarray(C)))
        importance.append(10 ** rng.uniform(-1, 0, len(lit)))
        rows.append(lit)
        data.append((X, C))
    for power in (1.0, 2.0):
        choice = choose_ridge(spectra, importance, rows, power=power)
        expected = []
        for ridge in choice.path[:, 0]:
            errors, weight = np.zeros(9), np.zeros(9)
            for (X, C), w, lit in zip(data, importance, rows, strict=True):
                errors[lit] += w * refits(X, C, ridge, False)
                weight[lit] += w
            expected.append((np.sum(errors ** (power / 2)) / np.sum(weight ** (power / 2))) ** (1 / power))
        condition = max(sensitivity(X, 0.0, False) for X, _ in data)
        # The bound of a single refit, carried through a weighted mean of norms.
        np.testing.assert_allclose(choice.path[:, 1], expected, rtol=200 * EPS64 * condition**2)
        assert choice.ridge == choice.path[np.argmin(expected), 0]
        assert "dominated" not in choice.remarks


def test_generalised_cross_validation_is_what_it_says() -> None:
    X, C = problem(20, 6)
    ridges = np.array([0.0, 1e-3, 1.0, 100.0])
    got = left_out(decompose(jnp.asarray(X), jnp.asarray(C)), ridges)[1]
    X, C = X.astype(float), C.astype(float)
    for row, ridge in zip(got, ridges, strict=True):
        H = X @ np.linalg.solve(X.T @ X + ridge * np.eye(6), X.T)
        expected = np.sum((C - H @ C) ** 2, 1) / (1 - np.trace(H) / 20) ** 2
        np.testing.assert_allclose(row, expected, rtol=40 * EPS64 * np.linalg.cond(X) ** 2)


def chosen(X: np.ndarray, C: np.ndarray, importance: np.ndarray | None = None, power: float = 1.0) -> Choice:
    weight = np.ones(len(X)) if importance is None else importance
    return choose_ridge([decompose(jnp.asarray(X), jnp.asarray(C))], [weight], [np.arange(len(X))], power=power)


@pytest.mark.parametrize("factor", [1e-200, 1e-30, 1e30, 1e200])
def test_units_of_importance_do_not_matter(factor: float) -> None:
    X, C = problem(12, 20)
    weight = np.logspace(-30, 30, 12)
    plain, scaled = chosen(X, C, weight), chosen(X, C, weight * factor)
    assert plain.ridge == scaled.ridge
    # A product with the factor and a quotient: two roundings of each weight.
    np.testing.assert_allclose(plain.path, scaled.path, rtol=50 * EPS64)


@pytest.mark.parametrize("size", [5e-324, 1e-310, 1e308])
def test_importance_at_the_ends_of_the_range(size: float) -> None:
    """A sum of twelve of the largest would be infinite, and a product with the smallest has no digits."""
    X, C = problem(12, 20)
    np.testing.assert_array_equal(chosen(X, C, np.full(12, size)).path, chosen(X, C).path)


def test_what_is_predicted_exactly_counts_as_predicted_to_rounding() -> None:
    """Each lighting has a point of its own, so that left out it is predicted as black; one is black, and one decides alone.

    Their geometric mean has a floor of one float64 rounding, below which no residual tells anything: the fifth root of
    1 * 1 * 1 * 1000 * eps at every ridge, each logarithm and the root rounded.
    """
    choice = chosen(np.eye(5, dtype=np.float32), np.array([[1], [1], [1], [1000], [0]], np.float32))
    assert "dominated" in choice.remarks
    np.testing.assert_allclose(choice.path[:, 1], (1e3 * EPS64) ** 0.2, rtol=5 * 36 * EPS64)  # |log eps| = 36, five of them


def test_importance_of_zero_counts_all_alike() -> None:
    X, C = problem(12, 20)
    np.testing.assert_array_equal(chosen(X, C, np.zeros(12)).path, chosen(X, C).path)
    assert np.isfinite(fit_transfer(jnp.asarray(X), jnp.asarray(C), importance=jnp.zeros(12)).leave_one_out)


def test_one_ruined_lighting_moves_squares_further_than_norms() -> None:
    """One row of 40 whose target is 10 times too far off: its square is 100 ordinary ones, its norm 10."""
    X, C = problem(40, 20, noise=0.02)
    C[3] += 10 * np.abs(C).max()
    norms, squares = chosen(X, C), chosen(X, C, power=2.0)
    assert norms.ridge <= squares.ridge
    clean = chosen(*problem(40, 20, noise=0.02)).ridge
    assert abs(np.log(norms.ridge / clean)) < abs(np.log(squares.ridge / clean))


def test_the_ends_of_the_path() -> None:
    """Without noise less ridge is always better; with nothing to learn more ridge is. Both are said."""
    X, _ = problem(40, 5)
    exact = X.astype(float) @ np.random.default_rng(4).normal(size=(5, 3))
    with jax.enable_x64(True):
        low = choose_ridge([decompose(jnp.asarray(X), jnp.asarray(exact))], [np.ones(40)], [np.arange(40)])
    assert low.ridge <= low.path[1, 0]
    rng = np.random.default_rng(5)
    X, C = rng.normal(size=(40, 5)).astype(np.float32), rng.normal(size=(40, 3)).astype(np.float32)
    high = chosen(X, C)
    assert high.ridge > np.linalg.norm(X, 2) ** 2
    for choice in (low, high):
        assert ("ridge_at_end" in choice.remarks) == (choice.ridge in (choice.path[0, 0], choice.path[-1, 0]))
    assert np.linalg.norm(X, 2) ** 2 * 9 < high.path[-1, 0], "the path goes on until hardly anything is left"
    assert (np.diff(high.path[:, 0]) > 0).all()


EDGES = {
    "one lighting": np.ones((1, 4)),
    "one lighting many times": np.ones((6, 4)),
    "coincident points": np.tile(np.arange(1.0, 7)[:, None], (1, 4)),
    "collinear points": np.outer(np.arange(1.0, 7), [1, 2, 3, 4]),
    "clustered singular values": np.eye(6, 4),
    "dark": np.zeros((6, 4)),
    "one point": np.arange(1.0, 7)[:, None],
    "wide": np.random.default_rng(0).random((3, 9)),
    "tiny": 1e-30 * np.random.default_rng(0).random((6, 4)),
    "large": 1e30 * np.random.default_rng(0).random((6, 4)),
    "six decades among points": np.random.default_rng(0).random((6, 4)) * np.logspace(-6, 6, 4),
}


@pytest.mark.parametrize("intercept", [False, True])
@pytest.mark.parametrize("name", EDGES)
def test_edges_are_finite_whatever_the_ridge(name: str, intercept: bool) -> None:
    X = EDGES[name].astype(np.float32)
    C = np.random.default_rng(1).normal(size=(len(X), 2)).astype(np.float32)
    points = X.shape[1]
    spread = tuple(np.logspace(-30, 30, points).tolist()) if points > 1 else (1e-30,)
    for ridge in ("auto", 0.0, 0, 1, 1e-30, 1e30, 1e300, (1e-30,) * points, spread, spread[::-1]):
        fit = fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge, intercept=intercept)
        assert np.isfinite(fit.matrix).all(), ridge
        assert np.isfinite(fit.leave_one_out), ridge
        assert np.isfinite(fit.path).all()
        assert fit.rank <= min(X.shape)
        # A ridge never makes a prediction of a training row larger than its targets' norm: ||H|| <= 1, and M is float32.
        light = X.astype(float) @ np.asarray(fit.matrix, float).T if not intercept else np.zeros(1)
        slack = 2 * points * EPS32 * np.linalg.norm(np.abs(X) @ np.abs(np.asarray(fit.matrix, float)).T)
        assert np.linalg.norm(light) <= np.linalg.norm(C.astype(float)) * (1 + 1e-6) + slack, ridge


@pytest.mark.parametrize("ridge", [np.inf, np.nan, -1.0, (1.0, np.inf), (1.0, np.nan), (0.0, 1.0)])
def test_ridges_that_mean_nothing_are_refused(ridge: float | tuple[float, ...]) -> None:
    X, C = problem(5, 2)
    with pytest.raises(UserError, match=r"fit\.ridge: got"):
        fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge)


def test_a_tiny_ridge_tends_to_the_pseudo_inverse() -> None:
    X, C = problem(12, 10)
    X[:, 9] = X[:, 7] = X[:, 8]
    zero = np.asarray(fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=0.0).matrix, float)
    S = np.linalg.svd(X.astype(float), compute_uv=False)
    for ridge in (1e-300, 1e-30, 1e-20):
        tiny = np.asarray(fit_transfer(jnp.asarray(X), jnp.asarray(C), ridge=ridge).matrix, float)
        # The kept directions change by ridge / S², at the smallest kept one; then both are rounded to float32.
        bound = ridge / S[7] ** 2 * np.linalg.norm(zero) + EPS32 * np.abs(zero).max()
        assert np.abs(tiny - zero).max() <= bound


# --- statuses ---------------------------------------------------------------------------------------------------------


def pairs(measured: np.ndarray, indirect: np.ndarray, channels: str = "mono") -> Examples:
    """What a method gets of arrays (lightings, points) and (lightings, texels), or with a last axis of channels."""
    from ddprt.fitting.encoding import Encoding

    X, Y = (np.asarray(part, np.float32) for part in (measured, indirect))
    X, Y = (np.repeat(part[..., None], 3, -1) if part.ndim == 2 else part for part in (X, Y))
    encoding = Encoding(channels=channels)
    values, light = jnp.asarray(X), jnp.asarray(Y)
    scale = encoding.scale(values)
    places = jnp.zeros((X.shape[1], 3))
    frame = Frame(encoding.encode(values, scale), places, places, [sun_of(row, np.zeros(places.shape)) for row in X])
    unseen = unseen_share(np.asarray(scale), Y)
    area = np.ones(Y.shape[1], np.float32)
    return Examples(frame, encoding.encode(light, scale), scale, area, "area", channels, unseen)


def report(examples: Examples, method: str = "svd-ridge", **settings: object) -> FitReport:
    return make_method(method, {}, settings).fit(examples, examples, key=jax.random.key(0)).report


def room(lightings: int = 24, points: int = 8, texels: int = 30, rank: int = 6, noise: float = 0.01) -> list[np.ndarray]:
    """Light that a few sources share out, positive on both sides."""
    rng = np.random.default_rng(2)
    source = rng.random((lightings, rank))
    measured, indirect = source @ rng.random((rank, points)), source @ rng.random((rank, texels))
    return [measured, indirect * (1 + noise * rng.normal(size=indirect.shape))]


def natural(status: str) -> FitReport:
    """A small dataset that a user might bring, for each status."""
    X, Y = room()
    rng = np.random.default_rng(6)
    match status:
        case "ok":
            return report(pairs(X, Y), bases=4)
        case "no_signal":
            return report(pairs(X * 0, Y))
        case "diverged":
            return report(pairs(X, Y), "mlp", learning_rate=1e38, steps=20, check_every=5, width=8)
        case "overfitted":
            few, many = room(lightings=9, points=9, rank=9, noise=0.5)
            return report(pairs(few, many), ridge=0.0, bases=4)
        case "ill_conditioned":
            X = X + 0.1 * rng.random(X.shape)
            X[:, 7] = X[:, 6] * (1 + 3e-6 * rng.random(24))
            return report(pairs(X, Y), ridge=0.0, bases=4)
        case "blind":
            X[3] = 0
            return report(pairs(X, Y), bases=4)
        case "overdamped":
            return report(pairs(X, Y), ridge=1e4, bases=4)
        case "rank_deficient":
            return report(pairs(*room(noise=0.0)), bases=12)
        case "few_lightings":
            return report(pairs(X[[0, 1, 1, 1]] * np.array([1, 1, 3, 7])[:, None], Y[[0, 1, 1, 1]]), bases=1)
        case "dominated":
            bright = np.where(np.arange(24) == 5, 1e6, 1)[:, None]
            return report(pairs(X * bright, Y * bright), bases=4)
        case "ridge_at_end":
            return report(pairs(np.eye(8), Y[:8]), bases=4)  # each lighting seen by a point of its own
        case "choices_disagree":
            return natural("few_lightings")
    raise AssertionError(status)


ELSEWHERE = {"worse_than_mean", "extrapolating"}  # judged on validation lightings; tests/test_methods.py and its own


@pytest.mark.parametrize("status", [status for status in STATUSES if status not in ELSEWHERE])
def test_every_status_has_a_dataset(status: str) -> None:
    found = natural(status)
    assert status == "ok" if not found.remarks else status in found.remarks
    if status not in NOTES and status != "ok":
        assert found.status == worst_first(set(found.remarks))[0]
        assert found.status != "ok"


def remarks(X: object, C: object, ridge: float, importance: object = None) -> tuple[str, ...]:
    weight = None if importance is None else jnp.asarray(importance, jnp.float32)
    return fit_transfer(jnp.asarray(X, jnp.float32), jnp.asarray(C, jnp.float32), ridge=ridge, importance=weight).remarks


@pytest.mark.parametrize(
    ("smallest", "ridge", "said"), [(5e-6, 0, False), (1e-6, 0, True), (1e-6, 8e-12, True), (1e-6, 8e-11, False)]
)
def test_limits_of_ill_conditioning(smallest: float, ridge: float, said: bool) -> None:
    """A condition past a million, and a ridge of no more than the square of a millionth of the largest singular value.

    Here that is 4: 1.6e-11. A ridge of that times 5 holds back all that condition would blow up.
    """
    assert ("ill_conditioned" in remarks(np.diag([4, 2, smallest]), np.eye(3), ridge)) is said


@pytest.mark.parametrize(("ridge", "said"), [(3.9, False), (4.1, True)])
def test_limits_of_overdamping(ridge: float, said: bool) -> None:
    """More than half is taken of a direction whose squared singular value, here 4, is less than the ridge."""
    assert ("overdamped" in remarks(np.diag([2, 1, 1]), np.eye(3), ridge)) is said


@pytest.mark.parametrize(("importance", "said"), [(None, True), ([1, 1, 0.01, 0.01], False), ([0.01, 0.01, 1, 1], True)])
def test_overfitting_heeds_importance(importance: list[float] | None, said: bool) -> None:
    """Two points that see two lightings each: from one to the other the first predicts all, the second the opposite.

    Squared errors left out are 0, 0, 4 and 16 where black makes 1, 4, 1 and 4.
    """
    X, C = [[1, 0], [2, 0], [0, 1], [0, 2]], [[1], [2], [1], [-2]]
    assert ("overfitted" in remarks(X, C, 0, importance)) is said


def test_condition_is_of_what_counts() -> None:
    """Singular values 4, 2 and one of rounding: rank 2 and condition 2."""
    fit = fit_transfer(jnp.diag(jnp.array([4.0, 2.0, 1e-7])), jnp.eye(3), ridge=0.0)
    assert fit.rank == 2
    assert fit.condition == pytest.approx(2, rel=10 * EPS64)  # two backward stable singular values and a quotient


def test_a_ridge_per_point_is_reported_by_its_mean() -> None:
    assert fit_transfer(*(jnp.asarray(part) for part in problem(12, 3)), ridge=(1.0, 2.0, 6.0)).ridge == 3


def test_every_status_says_what_why_and_what_to_do() -> None:
    for name, text in STATUSES.items():
        happened, rest = text.split(" Likely causes: ")
        causes, remedy = rest.split(" What to do: ")
        assert all(
            len(part.split()) >= (1 if name == "ok" else 5) and part.endswith(".") for part in (happened, causes, remedy)
        )


def test_the_worst_status_leads_and_none_is_lost() -> None:
    found = FitReport().noting("few_lightings", "rank_deficient").noting("ok", "ill_conditioned").noting("dominated")
    assert found.status == "ill_conditioned"
    assert found.remarks == ("ill_conditioned", "rank_deficient", "few_lightings", "dominated")
    assert FitReport().noting("dominated").status == "ok"
    assert FitReport(status="diverged").noting("rank_deficient").remarks == ("diverged", "rank_deficient")
    assert FitReport().noting("rank_deficient", "of a plug-in").status == "of a plug-in"


def test_limits_of_blindness() -> None:
    X, Y = room()
    X[0], Y[0] = 0, 0
    assert unseen_share(np.asarray(pairs(X, Y).scale), np.repeat(Y[..., None], 3, -1).astype(np.float32)) == 0
    for share, said in ((0.5 * BLIND, False), (2 * BLIND, True)):
        assert ("blind" in report(replace(pairs(X, Y), unseen=share), "mean").remarks) is said


def test_second_opinion_is_asked() -> None:
    choice_path = natural("choices_disagree")
    assert choice_path.ridge_second[0] != choice_path.ridge[0]
    assert SECOND_OPINION > 1


@pytest.mark.slow
@pytest.mark.parametrize("method", ALL_METHODS)
def test_methods_all_know_the_statuses(method: str) -> None:
    X, Y = room()
    known = METHODS[method].model_fields
    settings = {key: value for key, value in {"steps": 5, "check_every": 5, "width": 4}.items() if key in known}
    assert report(pairs(X * 0, Y), method, **settings).status == "no_signal"
    assert report(pairs(X, Y * 0), method, **settings).status == "no_signal"
    X[3] = 0
    assert "blind" in report(pairs(X, Y), method, **settings).remarks
