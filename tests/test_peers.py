"""Peers solve the same problems as we do, and the record of them all holds what a claim needs."""

import json
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import pytest

from ddprt.bench.measure.timing import Timing
from ddprt.bench.peers import fit, peers, relight, ridge, roofline, standing
from ddprt.bench.peers.fit import EPS, Maps, centred, fit_rows, make_columns
from ddprt.bench.peers.relight import learned, make_frames, make_model, make_scenes, relight_rows, transfer_rows
from ddprt.bench.peers.ridge import Pairs, make_pairs, ridge_rows
from ddprt.bench.peers.standing import OURS, Row

# Fit.


@pytest.fixture(scope="module")
def maps() -> Maps:
    """Singular values from 1 to 1e-12, of which the 6th is 2.5e-3: too deep for float32 arithmetic."""
    return Maps(make_columns(np.logspace(0, -12, 24), 3000, 0), 6)


def test_truth_is_that_of_the_whole_decomposition(maps: Maps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "_TILE", 700)
    sigma, right = Maps(maps.columns, maps.bases).exact
    _, whole, vectors = np.linalg.svd(maps.columns.astype(float), full_matrices=False)
    # Both are stable: off by a few eps sigma_1, and vectors by that over the gap, which is 0.6 of the 6th value.
    np.testing.assert_allclose(sigma, whole, atol=100 * 2.2e-16 * whole[0])
    np.testing.assert_allclose(np.abs(right @ vectors[:6].T), np.eye(6), atol=100 * 2.2e-16 * whole[0] / (0.6 * whole[5]))


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 0.5])
def test_judge_tells_angle_and_values(maps: Maps, angle: float) -> None:
    _, sigma, right = np.linalg.svd(maps.columns.astype(float), full_matrices=False)
    turned = right[:6].copy()
    turned[3] = np.cos(angle) * right[3] + np.sin(angle) * right[20]
    found = maps.judge((sigma * (1 + np.eye(24)[2] * 1e-3), turned * np.array([[1, -2, 3, 4, 5, 6]]).T))
    # Rounding of the decomposition leaves 100 eps sigma_1 over the gap, as above: 1.5e-11.
    assert found["sine of angle"] == pytest.approx(np.sin(angle), abs=1e-10)
    assert found["singular values"] == pytest.approx(1e-3, abs=1e-10)
    assert np.isnan(maps.judge((sigma[:5], right[:5]))["sine of angle"])


def test_blur_is_of_the_size_of_what_rounding_does(maps: Maps) -> None:
    rng = np.random.default_rng(0)
    moved = maps.columns.astype(float) * (1 + EPS * rng.uniform(-1, 1, maps.columns.shape))
    _, sigma, right = np.linalg.svd(moved, full_matrices=False)
    off = maps.judge((sigma, right.astype(np.float32)))
    assert off["sine of angle"] <= maps.blur["sine of angle"] <= 20 * off["sine of angle"]
    assert off["singular values"] <= maps.blur["singular values"]


def test_columns_have_the_spectrum_and_no_mean() -> None:
    spectrum = np.logspace(0, -3, 20)
    columns = make_columns(spectrum, 40_000, 3)
    assert columns.dtype == np.float32
    found = np.linalg.svd(columns.astype(float), compute_uv=False)
    # Gaussian rows are orthonormal to 2 sqrt(n/T) + n/T (Davidson and Szarek 2001), five spreads 1/sqrt(T) on top: 0.07.
    np.testing.assert_allclose(found, spectrum, rtol=2 * np.sqrt(20 / 40_000) + 20 / 40_000 + 5 / np.sqrt(40_000))
    rms = np.sqrt((columns.astype(float) ** 2).mean(1))
    # The mean itself was rounded to float32, and so were the T differences, with random signs.
    assert (np.abs(columns.mean(1, dtype=float)) < EPS * rms).all()
    shifted = centred(columns[:, :100] + np.float32(1))
    assert (np.abs(shifted.mean(1, dtype=float)) < 2 * EPS).all()
    assert (make_columns(spectrum, 300, 1) != make_columns(spectrum, 300, 2)).any()


SOME = (
    OURS,
    "numpy.linalg.svd",
    "scipy.linalg.svd, gesdd",
    "scipy.linalg.svd, gesdd, float32",
    "scipy.sparse.linalg.svds",
    "NumPy Gram product",
    "sklearn PCA, covariance_eigh",
    "sklearn randomized_svd",
)
"""One of each kind: ours, whole decompositions, single precision, iterations, a yardstick, one that subtracts the mean, one
that is told how hard to try."""


@pytest.mark.parametrize("some", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_way_to_a_basis_is_the_same_way(some: bool, maps: Maps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(standing, "_REST", 0.0)  # nobody is timed here
    monkeypatch.setattr(standing, "_WARM", 1)
    if some:
        monkeypatch.setattr(fit, "PEERS", [peer for peer in fit.PEERS if peer.name in SOME])
    rows = fit_rows(maps, repeats=1, limit=60)
    assert len(rows) == (len(SOME) if some else len(fit.PEERS))
    found = {row.name: row for row in rows}
    assert rows[0].verdict == "ours"
    # Single precision is off by eps sigma_1, 400 times as much of the 6th value: less accurate, whatever its time.
    assert found["scipy.linalg.svd, gesdd, float32"].verdict == "less accurate"
    for row in rows[1:]:
        if row.name != "scipy.linalg.svd, gesdd, float32" and row.verdict not in ("yardstick", "skipped"):
            assert row.verdict == "equal or better", row
    for name in ("numpy.linalg.svd", "scipy.linalg.svd, gesdd", "scipy.sparse.linalg.svds"):
        assert found[name].verdict == "equal or better", found[name]
    assert found["NumPy Gram product"].verdict == "yardstick"
    assert all("not installed" in row.reason for row in rows if row.verdict == "skipped")


def test_the_yardstick_is_the_whole_product(maps: Maps) -> None:
    gram = next(peer for peer in fit.PEERS if peer.name == peers.GRAM)
    A = maps.columns.astype(float)
    np.testing.assert_allclose(gram.prepare(maps)(), A @ A.T, rtol=1e-12, atol=1e-12 * np.linalg.norm(A) ** 2)


# Transfer.


def test_every_ridge_map_is_the_same_map() -> None:
    pairs = make_pairs(np.logspace(0, -3, 30), 40, 5, 0)
    X, C = pairs.measured.astype(float), pairs.coefficients.astype(float)
    expected = np.linalg.solve(X.T @ X + pairs.ridge * np.eye(40), X.T @ C).T
    # Normal equations have the condition 1/1e-6 here; times eps and the 40 of their size.
    np.testing.assert_allclose(pairs.exact, expected, atol=40 * 1e6 * 2.2e-16 * np.abs(expected).max())
    assert pairs.judge(expected * 1.25)["map"] == pytest.approx(0.25, rel=1e-6)
    rows = ridge_rows(pairs, repeats=1)
    assert all(row.verdict in ("ours", "equal or better", "skipped") for row in rows), rows
    assert sum(row.verdict == "equal or better" for row in rows) >= 2
    other = Pairs(pairs.measured, pairs.coefficients, 10 * pairs.ridge)
    assert pairs.judge(other.exact)["map"] > 1e-3, "another ridge must show"


# Relighting.


def oracle(model: Any, values: np.ndarray) -> np.ndarray:
    """Light of a frame, by loops in float64, (texels, 3)."""
    part = learned(model)
    matrix, basis = (np.asarray(array, float) for array in (part.matrix, part.basis))
    light = np.zeros((basis.shape[1], 3))
    for channel in range(3):
        for k in range(len(basis)):
            light[:, channel] += sum(matrix[channel, k, p] * values[p, channel] for p in range(len(values))) * basis[k]
    return light


def test_every_frame_is_the_same_light() -> None:
    scenes = make_scenes(50, 4, 9, 3, 0)
    assert scenes.moved == 4 * 50 * (4 + 3)
    lights = [oracle(model, scenes.values) for model in scenes.models]
    works = [peer.prepare(scenes) for peer in relight.RELIGHT if not peer.missing]
    assert len(works) >= 5
    for work in [*works, *works]:
        before = scenes.turn
        light = np.asarray(work())
        assert scenes.turn == (before + 1) % 3, "cold: what the last one read is not asked for again"
        light = light if light.shape == (50, 3) else light.T
        # n EPS as `blur` has it, per entry, since everything is positive.
        np.testing.assert_allclose(light, lights[scenes.turn], rtol=(4 + 9 + 2) * EPS)
        assert scenes.judge(light)["relative RMSE"] <= scenes.blur["relative RMSE"]
        assert scenes.judge(lights[before])["relative RMSE"] > 0.01
    assert all(row.verdict in ("ours", "equal or better", "yardstick", "skipped") for row in relight_rows(scenes, repeats=2))


@pytest.mark.parametrize("one", [True, False])
def test_every_transfer_is_the_same(one: bool) -> None:
    model = make_model(20, 4, 9, 0)
    frames = make_frames(model, 33, 0, one=one)
    assert len(frames.values) == (relight._LOOP if one else 33)
    assert frames.flops == 2 * 3 * 4 * 9 * len(frames.values)
    matrix = np.asarray(learned(model).matrix, float)
    wanted = np.array(
        [[[sum(matrix[c, k] * frame[:, c]) for k in range(4)] for c in range(3)] for frame in frames.values.astype(float)]
    )
    np.testing.assert_allclose(frames.exact, wanted, rtol=1e-12)
    for peer in relight.TRANSFER:
        if not peer.missing:
            found = np.asarray(peer.prepare(frames)()).reshape(wanted[-1].shape if one else wanted.shape)
            np.testing.assert_allclose(found, wanted[-1] if one else wanted, rtol=20 * EPS)
            assert frames.judge(found * 1.5)["relative RMSE"] == pytest.approx(0.5, rel=1e-4)
    rows = transfer_rows(frames, repeats=2)
    assert all(row.verdict in ("ours", "equal or better", "skipped") for row in rows)


# The whole.

WHOLE = """
import json, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("sklearn", "torch", "mitsuba"):
            raise ModuleNotFoundError(f"No module named {name!r}")

sys.meta_path.insert(0, Absent())
from ddprt.bench.peers.peers import Sizes, measure, table
from ddprt.config import load_config
from ddprt.progress import Progress

sizes = Sizes(900, 5, 4, 16, side=32, frames=32, repeats=2, limit=30, product=64, disk=4096, stream=1 << 16)
config = load_config(None, {"atlas.resolution": "32"})
record = measure(config, Progress(), sizes)
print(json.dumps({"record": record, "table": table(record)}))
"""


@pytest.fixture(scope="module")
def whole() -> dict[str, Any]:
    answer = subprocess.run([sys.executable, "-c", WHOLE], capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr[-3000:]
    return json.loads(answer.stdout.splitlines()[-1])


@pytest.mark.slow
def test_the_record_says_who_is_missing_and_what_to_do(whole: dict[str, Any]) -> None:
    skipped = {
        row["name"]: row["reason"]
        for entry in whole["record"]["comparisons"]
        for row in entry["rows"]
        if row["verdict"] == "skipped"
    }
    for name, package in (
        ("sklearn PCA, full", "scikit-learn"),
        ("sklearn Ridge, svd", "scikit-learn"),
        ("torch.linalg.svd", "torch"),
    ):
        assert "is not installed" in skipped[name]
        assert f"pip install {package}" in skipped[name]
    assert "experiments/bake_speed.py" in skipped["Mitsuba 3"]
    assert all(f"skipped: {reason}" in whole["table"] for reason in skipped.values())


@pytest.mark.slow
def test_the_record_holds_what_a_claim_needs(whole: dict[str, Any]) -> None:
    record = whole["record"]
    assert record["threads"] == roofline.threads()
    assert record["machine"]["packages"]["numpy"] == np.__version__
    assert record["machine"]["backend"] == jax.default_backend()
    assert [entry["name"] for entry in record["comparisons"]] == [
        "fit",
        "transfer fit",
        "relight, cold",
        "relight, warm",
        "transfer, one frame",
        "transfer, batch",
        "bake",
    ]
    by_name = {entry["name"]: {row["name"]: row for row in entry["rows"]} for entry in record["comparisons"]}
    summary, fit, cold = record["summary"], by_name["fit"], by_name["relight, cold"]
    # Figures are kept to four digits, ratios and seconds to four and five.
    assert summary["fit_over_gram"] == pytest.approx(1 / fit["NumPy Gram product"]["ratio"], rel=2e-3)
    ranked = [row["ratio"] for row in fit.values() if row["verdict"] == "equal or better"]
    assert summary["fit_speedup_best_peer"] == pytest.approx(min(ranked), rel=1e-3)
    rate, moved = record["limits"]["stream"]["rate"] * 1e9, 4 * 32 * 32 * (4 + 3)
    expected = moved / rate / cold[OURS]["seconds"]["median"]
    assert summary["relight_bandwidth_fraction"] == pytest.approx(expected, abs=1e-4 + 1e-3 * expected)
    batch = by_name["transfer, batch"][OURS]["seconds"]["median"]
    peak = record["limits"]["float32 product"]["rate"] * 1e9
    expected = 2 * 3 * 4 * 16 / batch / peak
    assert summary["transfer_product_fraction"] == pytest.approx(expected, abs=1e-4 + 0.02 * expected)
    assert summary["transfer_frames_per_second"] == pytest.approx(1 / batch, rel=1e-3)
    assert summary["transfer_microseconds"] == pytest.approx(
        1e6 * by_name["transfer, one frame"][OURS]["seconds"]["median"], rel=1e-3
    )
    # 64 KiB of models with 16 KiB of bases each: four hold as much, one more makes sure.
    assert "5 models in turn" in record["comparisons"][2]["what"]


@pytest.mark.slow
def test_the_table_shows_every_row(whole: dict[str, Any]) -> None:
    rows = [row for entry in whole["record"]["comparisons"] for row in entry["rows"]]
    lines = whole["table"].splitlines()
    assert sum(line.startswith("| ") for line in lines) == len(rows) + 2 * 7  # two lines of head for each comparison
    less = Row("x", "less accurate", 0.5, Timing(1.0, 0.9, 1.2, 0.0, 3), {"off": 0.25}).record()
    assert peers._line(less, False) == "| 0.5 | x | 1 (0.9 to 1.2) | off 2.5e-01 | less accurate |"


def test_every_crew_has_one_of_us() -> None:
    for crew in (fit.PEERS, ridge.PEERS, relight.RELIGHT, relight.TRANSFER):
        names = [peer.name for peer in crew]
        assert names.count(OURS) == 1
        assert len(set(names)) == len(names)
