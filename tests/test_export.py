"""What engines load decodes to what `predict` says, by the decoder that the docs print."""

import json
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.textures import export_textures
from ddprt.scene.gutter import fill_gutter
from ddprt.scene.mesh import Scene

DOCS = Path(__file__).parent.parent / "docs" / "export.md"
EPS32 = float(np.finfo(np.float32).eps)


@pytest.fixture(scope="module")
def data(cornell: Scene) -> Dataset:
    changes = {"atlas.resolution": "32", "lightings.train": "12", "lightings.validation": "2", "lightings.test": "3"}
    changes |= {"points.count": "16", "points.supersample": "2", "transport.samples": "64", "transport.test_samples": "64"}
    return ddprt.bake(cornell, config=load_config(None, changes))


def documented_decoder() -> dict:
    """The Python block of docs/export.md, executed."""
    block = re.search(r"```python\n(.*?def decode.*?)```", DOCS.read_text(), re.DOTALL)
    assert block, "docs/export.md has no decoder"
    body = [line for line in block[1].split("def decode")[1].splitlines() if line.strip()]
    assert len(body) <= 11, "a decoder of ten lines"
    scope: dict = {}
    exec(block[1], scope)
    return scope


@pytest.mark.parametrize("precision", ["half", "float"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"space": "gamma"},
        {"centre": "mean"},
        {"channels": "multi"},
        {"channels": "multi", "centre": "mean", "space": "gamma"},
    ],
    ids=str,
)
def test_decoder_reproduces_predict(options: dict, precision: str, data: Dataset, tmp_path: Path) -> None:
    model = ddprt.fit(data, bases=6, **options)
    export_textures(model, tmp_path, precision=precision)
    decode = documented_decoder()["decode"]
    frames = data.values(data.split("test"), 16, "radiosity")
    step = 2.0**-11 if precision == "half" else EPS32
    for values in frames:
        expected = model.predict(values)
        got = decode(tmp_path, values)[model.covered]
        # Each texture value is rounded by `step` of itself and each |u| <= about ||z||: the sum over bases of |u| |texture|
        # bounds the encoded error; the mean map adds one more texture; gamma multiplies it by its slope.
        scale = np.asarray(model.encoding.scale(jnp.asarray(values[None])))[0]
        bound = rounding_bound(model, values, step)
        assert (np.abs(got - expected) <= bound + 200 * EPS32 * scale * np.abs(expected / scale).max()).all()


def rounding_bound(model: ddprt.runtime.model.Model, values: np.ndarray, step: float) -> np.ndarray:
    """Largest error of the result when every texture value is off by `step` of itself, W/m²."""
    batch = jnp.asarray(values[None])
    scale = model.encoding.scale(batch)
    encoded = np.asarray(model.encoding.encode(batch, scale))
    relighter = model.relighter
    inputs = np.moveaxis(encoded, 2, 1) if len(relighter.matrix) == 3 else encoded.reshape(1, 1, -1)
    u = np.einsum("gbp,fgp->fgb", relighter.matrix, inputs - np.asarray(relighter.offset)) + np.asarray(relighter.intercept)
    size = np.abs(u) @ np.abs(np.asarray(relighter.basis)) + np.abs(np.asarray(relighter.mean))
    size = np.moveaxis(size, 1, 2)[0] if len(relighter.matrix) == 3 else size.reshape(-1, 3)
    error = step * size + 1e-7
    if model.encoding.space == "gamma":
        gamma = model.encoding.gamma
        value = np.maximum(np.asarray(model.predict(values)) / np.asarray(scale)[0], 0) ** (1 / gamma)
        error = gamma * (value + error) ** (gamma - 1) * error
    return error * np.asarray(scale)[0]


def test_layers_hold_four_bases_each(data: Dataset, tmp_path: Path) -> None:
    model = ddprt.fit(data, bases=6)
    written = export_textures(model, tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["layers"] == ["basis_00.exr", "basis_01.exr"]
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()}
    from ddprt.scene.exr import read_exr

    first, second = (read_exr(tmp_path / name)[0] for name in manifest["layers"])
    assert first.shape == second.shape == (32, 32, 4)
    assert (second[..., 2:] == 0).all()
    np.testing.assert_allclose(np.abs(first).max((0, 1)), 1, atol=2**-11)


def test_only_linear_models_export(data: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UserError, match='got a model of method "mean", expected svd-ridge'):
        export_textures(ddprt.fit(data, "mean"), tmp_path)


def test_images_are_not_flipped(data: Dataset, tmp_path: Path) -> None:
    """An asymmetric image through the exporter comes back the same way up and round."""
    from dataclasses import replace

    from ddprt.scene.exr import read_exr

    model = ddprt.fit(data, bases=1)
    row, column = np.nonzero(model.covered)
    asymmetric = (row * 100 + column + 1).astype(np.float32)[None]
    odd = replace(model, relighter=replace(model.relighter, basis=jnp.asarray(asymmetric)))
    export_textures(odd, tmp_path, precision="float", gutter=0)
    image = read_exr(tmp_path / "basis_00.exr")[0][..., 0] * asymmetric.max()
    np.testing.assert_allclose(image[model.covered], asymmetric[0], rtol=1e-6)


def test_gutter_is_smooth_linear_and_leaves_charts_alone() -> None:
    rng = np.random.default_rng(0)
    covered = np.zeros((20, 20), bool)
    covered[5:9, 5:9] = True
    one, two = rng.random((2, 20, 20, 2))
    filled = fill_gutter(one, covered, 3)
    np.testing.assert_array_equal(filled[covered], one[covered])
    assert (filled[2:12, 2:12] > 0).all()
    assert (filled[:2] == 0).all()
    np.testing.assert_allclose(fill_gutter(2 * one + two, covered, 3), 2 * filled + fill_gutter(two, covered, 3))
    constant = fill_gutter(np.ones((20, 20, 1)), covered, 3)
    np.testing.assert_allclose(constant[2:12, 2:12], 1)
