"""What the experiments beside the paper compute, against closed forms and slow obvious twins."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.report.evaluate import projection_error
from ddprt.runtime.model import Model
from ddprt.scene.exr import read_exr

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import paper_figures as figures
import paper_storage as storage
import paper_table1 as table1

KIB, MIB = 2**10, 2**20
SMALL = {"atlas.resolution": "48", "lightings.train": "14", "lightings.validation": "1", "lightings.test": "3"}
SMALL |= {"points.count": "12", "points.supersample": "2", "transport.samples": "32", "transport.test_samples": "32"}


@pytest.fixture(scope="module")
def data() -> Dataset:
    return ddprt.bake(ddprt.load_scene("cornell"), config=load_config("configs/cornell.toml", SMALL))


@pytest.fixture(scope="module")
def held(data: Dataset) -> figures.Held:
    return figures.Held.of(data, 12)


@pytest.fixture(scope="module")
def plain(data: Dataset) -> Model:
    return figures.fit(data, "ours", figures.ENCODINGS["linear mono"])


def test_textures_of_the_paper_are_whole_floats() -> None:
    assert storage.texture_bytes(16, 1024, storage.FLOAT) == 64 * MIB
    assert storage.texture_bytes(16, 1024, storage.HALF) == 32 * MIB
    assert storage.texture_bytes(5, 8, storage.HALF) == 2 * 4 * 64 * 2  # the second texture is three quarters empty
    assert storage.texture_bytes(5, 8, storage.HALF, channels="multi") == 5 * 3 * 64 * 2


def test_no_reading_of_the_paper_gives_its_matrix() -> None:
    sizes = storage.readings()
    assert sizes["one matrix"] == 16 * KIB
    assert sizes["three matrices (mono channel)"] == 48 * KIB
    assert [name for name, size in sizes.items() if size == 36 * KIB] == [
        "three matrices of 12 rows, which is what 36 KiB would take"
    ]


@pytest.mark.parametrize(("channels", "precision"), [("mono", "half"), ("multi", "float")])
def test_counted_bytes_are_those_of_an_export(data: Dataset, tmp_path: Path, channels: str, precision: str) -> None:
    model = ddprt.fit(data, bases=6, points=12, channels=channels)
    found = storage.on_disk(model, tmp_path, precision)
    images = [read_exr(path)[0] for path in sorted(tmp_path.glob("basis_*.exr"))]
    width = storage.HALF if precision == "half" else storage.FLOAT
    assert sum(image.size for image in images) * width == storage.texture_bytes(6, 48, width, channels=channels)
    # One matrix of interleaved colours is as large as three of one; the rest is offset, intercept and a header.
    assert 0 < found["matrices"] - storage.matrix_bytes(6, 12, matrices=3) < 1024
    assert sum(found.values()) == sum(path.stat().st_size for path in tmp_path.iterdir())
    rounded = all(np.array_equal(image, image.astype(np.float16)) for image in images)
    assert rounded == (precision == "half")


def test_error_of_the_paper_is_a_mean_over_lightings() -> None:
    difference = np.stack([np.full((5, 3), value, np.float32) for value in (2, -3, 7)])
    # RMSE 2 in units of 1 and 3 in units of 6; nothing measures the third.
    assert figures.average_rmse(difference, np.array([1.0, 6.0, 0.0])) == pytest.approx((2 + 0.5) / 2, rel=1e-12)


def test_unit_is_the_norm_without_the_number_of_points(data: Dataset, held: figures.Held) -> None:
    measured = held.values.astype(np.float64)
    norm = [np.sqrt(sum(value**2 for value in one.ravel())) for one in measured]
    np.testing.assert_allclose(held.unit * np.sqrt(12 * 3), norm, rtol=1e-12)


@pytest.mark.parametrize("label", ["linear mono", "gamma multi"])
def test_projection_is_that_of_the_report(data: Dataset, held: figures.Held, label: str) -> None:
    model = figures.fit(data, "ours", figures.ENCODINGS[label], bases=6)
    for bases in (3, 6):
        short = figures.shortened(model, bases)
        assert short is not None
        _, ours = held.errors(figures.projected(short, held, data.area))
        # Float32 rounds a sum of 6 products to 1e-6 of the light, so an error of a hundredth of it to 1e-4.
        assert ours > 0.01
        assert ours == pytest.approx(projection_error(data, model, held.truth, bases), rel=1e-4)


def test_projection_keeps_what_the_basis_spans(data: Dataset, held: figures.Held) -> None:
    model = figures.fit(data, "paper", figures.ENCODINGS["linear mono"], bases=6)
    relighter = model.relighter
    scale = np.asarray(model.encoding.scale(jnp.asarray(held.values)))
    inside = relighter.mean + 0.1 * relighter.basis[0] / np.abs(relighter.basis[0]).max() * np.asarray(relighter.mean).min()
    maps = (scale[:, None] * np.asarray(inside)[None, :, None]).astype(np.float32)
    truth = replace(held, truth=SimpleNamespace(reference=maps))
    assert maps.min() > 0  # so that the clamp takes nothing
    np.testing.assert_allclose(figures.projected(model, truth, data.area), maps, rtol=1e-4)  # float32, as above


def test_curves_fall_and_end_with_the_data(data: Dataset, held: figures.Held, plain: Model) -> None:
    rows = figures.curve(data, plain, held)
    assert [bases for bases, *_ in rows] == [4, 8, 16, 32]  # 14 lightings of 3 channels have no 64
    floors = [floor[1] for *_, floor in rows]
    assert all(np.diff(floors) < 0)
    # Past the projection nothing is left: the transfer is the farther one, by an orthogonal part that the clamp only shrinks.
    assert all(transfer[1] > floor[1] for _, transfer, floor in rows)


def test_mean_counts_as_a_base(data: Dataset) -> None:
    model = figures.fit(data, "paper", figures.ENCODINGS["linear mono"], bases=6)
    short = figures.shortened(model, 4)
    assert short is not None
    assert [bool(np.any(vector)) for vector in np.asarray(short.relighter.basis)] == [True] * 3 + [False] * 2
    assert figures.shortened(model, 7) is None


@pytest.mark.parametrize("label", ["linear mono", "gamma multi"])
def test_as_it_reads_solves_its_normal_equations(data: Dataset, label: str) -> None:
    encoding = figures.ENCODINGS[label]
    model = figures.fit(data, "as read", encoding, bases=6)
    relighter = model.relighter
    train = data.split("train")
    values, light = data.values(train, 12, "radiosity").astype(np.float64), data.maps("indirect", train).astype(np.float64)
    mono, power = encoding["channels"] == "mono", 1 / 2.2 if encoding["space"] == "gamma" else 1.0
    norm = np.sqrt(np.sum(values**2, 1 if mono else (1, 2), keepdims=True))
    x, y = (values / norm) ** power, (light / norm) ** power
    X = np.moveaxis(x, 2, 0) if mono else x.reshape(1, len(x), -1)
    Y = np.moveaxis(y, 2, 0) if mono else y.reshape(1, len(y), -1)
    mean, basis = np.asarray(relighter.mean, np.float64), np.asarray(relighter.basis, np.float64)
    for group, (inputs, maps) in enumerate(zip(X, Y, strict=True)):
        C = np.array([[np.mean((row - mean) * vector) for vector in basis] for row in maps])
        M = C.T @ inputs @ np.linalg.inv(inputs.T @ inputs + figures.RIDGE * np.eye(inputs.shape[1]))
        # Coefficients are rounded to 1e-6 of the light, and the inverse stretches that by 1 / (2 sqrt(ridge)) = 16 at most.
        np.testing.assert_allclose(np.asarray(relighter.matrix[group]), M, atol=2e-5 * np.abs(C).max())
    assert not np.any(relighter.offset)
    assert not np.any(relighter.intercept)
    assert np.any(relighter.mean)


def test_eigenvalues_are_those_of_the_autocorrelation(data: Dataset) -> None:
    model = figures.fit(data, "ours", figures.ENCODINGS["linear multi"], bases=6)
    train = data.split("train")
    values, light = data.values(train, 12, "radiosity").astype(np.float64), data.maps("indirect", train).astype(np.float64)
    columns = light / np.sqrt(np.sum(values**2, (1, 2), keepdims=True))
    gram = np.einsum("itc,jtc,t->ij", columns, columns, data.area / data.area.sum())
    expected = np.linalg.eigvalsh(gram)[::-1]
    # Columns and weights are float32: 1e-7 of the largest, which is 1e-3 of what is a ten-thousandth of it.
    kept = expected / expected[0] > 1e-4
    assert kept.sum() > 3
    np.testing.assert_allclose(figures.eigenvalues(model)[kept], (expected / expected[0])[kept], rtol=1e-3)


def test_dimensions() -> None:
    assert figures.dimensions(np.array([1.0, 0.5, 0.0101, 0.006])) == (3, 2, 3, 4)


def test_coefficients_of_a_frame(plain: Model, held: figures.Held) -> None:
    wide = table1.widened(plain, 5, 7)
    x = held.values[0].astype(np.float64)
    expected = [np.asarray(wide.relighter.matrix[c], np.float64) @ x[:, c] / np.linalg.norm(x[:, c]) for c in range(3)]
    np.testing.assert_allclose(table1.coefficients(wide, held.values[0])[0], expected, atol=1e-5)  # 12 float32 products
    scaled = np.array(expected) * np.linalg.norm(x, axis=0)[:, None]  # the other way that is timed has the scale in it
    np.testing.assert_allclose(wide.coefficients(held.values[0]), scaled, atol=1e-5 * np.linalg.norm(x))


def test_composition_answers_as_the_model(plain: Model, held: figures.Held) -> None:
    values = held.values[0]
    scale = plain.encoding.scale(jnp.asarray(values[None]))
    composed = table1._compose(plain.relighter, plain.encoding, table1.coefficients(plain, values), scale)
    peak = plain.predict(values).max()
    np.testing.assert_allclose(composed[0], plain.predict(values), atol=1e-5 * peak)  # two orders of the same float32 sums
    relighter = plain.relighter
    moved = relighter.basis.nbytes + relighter.mean.nbytes + composed.nbytes
    assert table1.composed_bytes(len(relighter.basis), relighter.basis.shape[1]) == moved
