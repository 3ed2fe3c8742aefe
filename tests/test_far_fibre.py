"""The phase averaged over offsets: its table against sums in float64, its energy, its rows; texels that borrow."""

from dataclasses import replace

import numpy as np
import pytest

from ddprt.scene.material import Fibre
from ddprt.scene.tubes import TEXELS
from ddprt.transport import fibre
from ddprt.transport.along_strands import borrowed, borrowing
from ddprt.transport.far_fibre import FarFibre, FarVertices
from ddprt.transport.walk import Vertices

OF = Fibre(0.3, 0.3)


@pytest.fixture(scope="module")
def far() -> FarFibre:
    return FarFibre.of(OF)


def vertices(tables: FarFibre, sine: np.ndarray, absorption: np.ndarray, number: np.ndarray, reach: float = 0.0) -> FarVertices:
    """Fibres along x, seen from above the xy plane's y: one after another, each its own receiver, of throughput 1 / pi."""
    count = len(sine)
    held = fibre.prepared(sine, np.zeros(count), absorption, OF)
    place = np.arange(6 * count, dtype=np.float32).reshape(6, count)
    there = Vertices(place, np.full((3, count), 1 / np.pi, np.float32), np.arange(count, dtype=np.int32))
    frames = np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))
    rows, close = tables.rows(sine, absorption, number), np.zeros(count, bool)
    return tables.seen(there, frames, np.full(count, reach, np.float32), held, rows, fibre.shape_of(OF), close)


def summed(of: Fibre, sine: np.ndarray, absorption: np.ndarray, towards: np.ndarray, steps: int = 256) -> np.ndarray:
    """Mean of the phase of single offsets, which are sines of evenly spread angles."""
    entering = (np.arange(steps) + 0.5) / steps * np.pi - np.pi / 2
    share = np.cos(entering) / np.cos(entering).sum()
    offset = np.tile(np.sin(entering), len(sine))
    held = fibre.prepared(np.repeat(sine, steps), offset, np.repeat(absorption, steps, 0), of)
    values = fibre.phase(held, fibre.shape_of(of), np.repeat(towards, steps, 0)).astype(np.float64)
    return (values.reshape(len(sine), steps, 3) * share[:, None]).sum(1)


def directions(height: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Unit, of a sine with the plane across x, and a turn about it from y."""
    flat = np.sqrt(1 - height**2)
    return np.stack([height, flat * np.cos(turn), flat * np.sin(turn)], 1).astype(np.float32)


def test_the_table_is_the_sum_over_offsets(far: FarFibre) -> None:
    """0.11 % of RMS and 0.06 % of energy were found with 2000 directions; most is the angle's step near grazing."""
    rng, count = np.random.default_rng(0), 500
    sine, turn = rng.uniform(-0.98, 0.98, count), rng.uniform(-np.pi, np.pi, count)
    lit = np.clip(-np.arcsin(sine) + rng.normal(0, 0.2, count), -1.5, 1.5)  # about the cone of reflection, where light is
    absorption, towards = rng.choice([0, 0.02, 0.1, 0.5, 2], size=(count, 3)), directions(np.sin(lit), turn)
    expected = summed(OF, sine, absorption, towards)
    numbers = (np.arange(32) + 0.5) / 32
    found = np.mean([vertices(far, sine, absorption, np.full(count, n)).lit_from(towards).throughput.T for n in numbers], 0)
    error = found - expected
    print(f"RMS {np.sqrt((error**2).mean() / (expected**2).mean()):.5f}, energy {found.sum() / expected.sum() - 1:+.5f}")
    assert np.sqrt((error**2).mean()) < 2e-3 * np.sqrt((expected**2).mean())
    assert abs(error).max() < 4e-3 * expected.max()
    assert found.sum() == pytest.approx(expected.sum(), rel=1.5e-3)


@pytest.mark.parametrize("sine", [-0.9, 0.0, 0.4])
def test_a_white_fibre_keeps_its_energy(far: FarFibre, sine: float) -> None:
    cells = 256
    middle = (np.arange(cells) + 0.5) / cells
    height, turn = (axis.ravel() for axis in np.meshgrid(2 * middle - 1, 2 * np.pi * middle, indexing="ij"))
    count = len(height)
    seen = vertices(far, np.full(count, sine), np.zeros((count, 3)), (np.arange(count) * 0.6180339887) % 1)
    whole = seen.lit_from(directions(height, turn)).throughput.mean(1, dtype=np.float64) * 4 * np.pi
    np.testing.assert_allclose(whole, 1, atol=2e-3)


def test_light_from_either_side_is_the_same_and_from_along_the_fibre_is_finite(far: FarFibre) -> None:
    height, turn = np.array([0.1, -0.4, 0.8]), np.array([0.3, 1.5, 3.0])
    seen = vertices(far, np.array([0.2, 0.5, -0.7]), np.full((3, 3), 0.1), np.full(3, 0.5), reach=0.5)
    one, other = (seen.lit_from(directions(height, sign * turn)) for sign in (1, -1))
    np.testing.assert_allclose(one.throughput, other.throughput, rtol=1e-4)
    # Shadow rays start off the axis, across the fibre, where the light is; their normals are the light's directions.
    out = np.stack([0 * turn, np.cos(turn), np.sin(turn)])
    np.testing.assert_allclose(one.place[:3] - seen.place[:3], 0.5 * out, atol=1e-5)
    np.testing.assert_array_equal(one.place[3:], directions(height, turn).T)
    along = seen.lit_from(np.tile(np.array([1, 0, 0], np.float32), (3, 1)))
    assert np.isfinite(along.throughput).all()
    assert np.isfinite(along.place).all()


def test_rows_are_chosen_as_often_as_they_are_near(far: FarFibre) -> None:
    """Mean of the chosen angle and of the chosen clarity is what was asked for."""
    numbers = (np.arange(10_000) + 0.5) / 10_000
    for sine, clarity in ((0.3, 0.77), (-0.3, 0.2), (0.999, 0.0), (0.0, 1.0), (-1.0, 0.5)):
        depth = np.full((len(numbers), 3), -np.log(max(clarity, 1e-30)))
        row, column = np.divmod(far.rows(np.full(len(numbers), sine), depth, numbers), 33)
        assert row[:, 0].mean() == pytest.approx(np.arcsin(abs(sine)) / (np.pi / 2) * 32, abs=2e-3)
        assert column[:, 1].mean() == pytest.approx(clarity * 32, abs=2e-3)


def test_what_is_close_keeps_its_own_offset(far: FarFibre) -> None:
    rng, count = np.random.default_rng(5), 64
    sine, absorption = rng.uniform(-0.9, 0.9, count), rng.uniform(0, 1, (count, 3))
    towards = directions(rng.uniform(-0.9, 0.9, count), rng.uniform(-3, 3, count))
    seen = vertices(far, sine, absorption, np.full(count, 0.5))
    close = np.arange(count) % 3 == 0
    found = replace(seen, close=close).lit_from(towards).throughput.T
    single = fibre.phase(fibre.prepared(sine, np.zeros(count), absorption, OF), fibre.shape_of(OF), towards)
    np.testing.assert_allclose(found[close], single[close], rtol=1e-5)
    np.testing.assert_array_equal(found[~close], seen.lit_from(towards).throughput.T[~close])


def test_parts_are_the_whole(far: FarFibre) -> None:
    rng, count = np.random.default_rng(3), 40_000
    seen = vertices(far, rng.uniform(-1, 1, count), rng.uniform(0, 2, (count, 3)), rng.random(count))
    towards = directions(rng.uniform(-1, 1, count), rng.uniform(-3, 3, count))
    whole = seen.lit_from(towards)
    parts, first = [], 0
    for part in FarVertices.joined([seen]).blocks():
        parts.append(part.lit_from(towards[first : first + len(part.owner)]))
        first += len(part.owner)
    assert len(parts) > 1
    joined = Vertices.joined(parts)
    np.testing.assert_array_equal(joined.throughput, whole.throughput)
    np.testing.assert_array_equal(joined.place, whole.place)
    np.testing.assert_array_equal(joined.owner, whole.owner)


@pytest.mark.parametrize("paths", [1, 128, 1 << 20, 1 << 30])
def test_lines_along_a_strand_are_kept(paths: int) -> None:
    """Up to its ends; against a fit by least squares, written out."""
    weights, place = borrowing(0.05, paths), np.arange(TEXELS, dtype=np.float64)
    line = np.stack([np.ones(TEXELS), place], 1)
    np.testing.assert_allclose(weights @ line, line, atol=1e-9)
    deviation = max(1.2 * (1024 / paths) ** 0.2, 0.1)
    bent = place**2
    for own in (0, 4, 9):
        near = np.sqrt(np.exp(-0.5 * ((place - own) / deviation) ** 2) + 1e-12 * (abs(place - own) == 1))
        fitted = np.linalg.lstsq(near[:, None] * np.stack([np.ones(TEXELS), place - own], 1), near * bent, rcond=None)[0]
        assert (weights @ bent)[own] == pytest.approx(fitted[0], abs=1e-6)


def test_more_paths_borrow_less() -> None:
    kept = [np.trace(borrowing(0.05, paths)) / TEXELS for paths in (16, 128, 1024, 1 << 30)]
    assert kept == sorted(kept)
    assert kept[-1] == pytest.approx(1, abs=1e-6)
    np.testing.assert_array_equal(borrowing(0.0, 128), np.eye(TEXELS))
    assert (borrowing(0.05, 128) ** 2).sum(1)[2:8].max() < 0.3  # noise of three in four texels' worth is gone


def test_only_strands_borrow_and_each_of_itself() -> None:
    rng = np.random.default_rng(4)
    light = rng.random((7 + 3 * TEXELS, 3), np.float32)
    weights = borrowing(0.05, 64)
    found = borrowed(light, 3, weights)
    np.testing.assert_array_equal(found[:7], light[:7])
    for strand in range(3):
        part = slice(7 + strand * TEXELS, 7 + (strand + 1) * TEXELS)
        np.testing.assert_allclose(found[part], weights @ light[part], rtol=1e-5, atol=1e-6)
