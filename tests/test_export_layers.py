"""What engines load of glossy surfaces decodes to what the layer says, by the decoder that the docs print."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ddprt
from ddprt import harmonics, warp
from ddprt.config import checked
from ddprt.dataset import store
from ddprt.dataset.layers import Layer, write_light, write_places
from ddprt.dataset.manifest import Manifest
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.layers import export_layers
from ddprt.files import read_tensors
from ddprt.scene.mesh import Scene

DOCS = Path(__file__).parent.parent / "docs" / "effects.md"
EPS = float(np.finfo(np.float32).eps)
ORDER, PLACES, POINTS = 4, 90, 16
OPTIONS: list[Any] = [
    pytest.param({}, marks=pytest.mark.slow),
    {"channels": "multi", "centre": "mean", "space": "gamma"},
]


@pytest.fixture(scope="module")
def data(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A small bake, to which a layer of texels is added by hand: a fixed map of the lightmap's light."""
    config = checked(
        {
            "atlas": {"resolution": 24},
            "lightings": {"train": 12, "validation": 2, "test": 3},
            "points": {"count": POINTS, "supersample": 2},
            "transport": {"samples": 16, "test_samples": 32},
        }
    )
    folder = tmp_path_factory.mktemp("layered") / "dataset"
    shutil.copytree(ddprt.bake(cornell, config=config, out=tmp_path_factory.mktemp("plain")).folder, folder)
    description = json.loads((folder / "dataset.json").read_text())
    description["layers"] = [{"name": "gloss-4", "quantity": "radiance", "order": ORDER, "constant": True}]
    store.write_description(folder, description)
    plain, manifest, rng = Dataset(folder, description), Manifest(folder), np.random.default_rng(0)
    texel = rng.permutation(len(plain.area))[:PLACES]
    layer = Layer("gloss-4", "radiance", ORDER, plain.gbuffer["position"][texel].astype(float), plain.area[texel], texel)
    write_places(folder, layer, manifest)
    mix = rng.normal(size=(PLACES, layer.coefficients, len(plain.area))) / len(plain.area)
    for index in range(len(plain.lightings)):
        light = np.einsum("pkt,tc->pkc", mix, plain.maps("indirect", [index])[0])
        write_light(folder, layer.name, index, light, manifest)
        if description["lightings"][index]["split"] == "test":
            write_light(folder, layer.name, index, 0 * light, manifest, "noise")
    write_light(folder, layer.name, "constant", rng.uniform(0, 1, (PLACES, layer.coefficients, 3)).astype(np.float32), manifest)
    return ddprt.open_dataset(folder)


@pytest.fixture(scope="module")
def scope() -> dict[str, Any]:
    """The Python block of docs/effects.md that decodes gloss, executed."""
    block = re.search(r"```python\n((?:(?!```).)*?def exitant.*?)```", DOCS.read_text(), re.DOTALL)
    assert block, "docs/effects.md has no decoder of gloss"
    found: dict[str, Any] = {}
    exec(block[1], found)
    return found


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_the_documented_decoder_reproduces_gloss(
    options: dict[str, Any], data: Dataset, scope: dict[str, Any], tmp_path: Path
) -> None:
    model = ddprt.fit(data, bases=6, **options)
    files = export_layers(model, tmp_path)
    assert [file.name for file in files] == ["gloss-4.safetensors", "gloss-4.json"]
    part = model.layers["gloss-4"]
    towards = warp.sample_sphere(warp.sobol(PLACES, 2, seed=4)).astype(float)
    for values in data.values(data.split("test"), POINTS, "radiosity"):
        light = part.predict(values)
        expected = part.layer.towards(light, towards)
        assert (expected > 0).any()
        # u, the sum over bases and that over harmonics are float32 on one side and float64 on the other; gamma makes 2.2 of it.
        bound = 300 * EPS * np.abs(light).max()
        np.testing.assert_allclose(scope["exitant"](tmp_path, "gloss-4", values, towards), expected, atol=bound)
    told = json.loads(files[1].read_text())
    golden = told["golden"]
    ones = np.full((POINTS, 3), golden["x"])
    size = np.abs(part.predict(ones)).max()
    assert len(golden["place"]) == 64  # of 90
    for direction, radiance in zip(golden["towards"], golden["radiance"], strict=True):
        got = scope["exitant"](tmp_path, "gloss-4", ones, np.tile(direction, (PLACES, 1)))[golden["place"]]
        np.testing.assert_allclose(got, radiance, atol=300 * EPS * size)
    row, column = read_tensors(files[0])["texel"].T
    lightmap = np.full(model.covered.shape, -1)
    lightmap[model.covered] = np.arange(len(data.area))
    np.testing.assert_array_equal(lightmap[row, column], part.layer.texel)
    assert told["quantity"] == "radiance"


def test_the_documented_harmonics_are_ours(scope: dict[str, Any]) -> None:
    directions = np.vstack([warp.sample_sphere(warp.sobol(50, 2, seed=1)).astype(float), np.eye(3), -np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for order in (0, 1, 2, 8):
        np.testing.assert_allclose(scope["harmonics"](directions, order), harmonics.harmonics(directions, order), atol=1e-12)


def test_what_earlier_exports_left_goes_and_nothing_else(data: Dataset, tmp_path: Path) -> None:
    model = ddprt.fit(data, bases=3)
    export_layers(model, tmp_path)
    for name in ("notes.json", "notes.safetensors", "points.json", "transfer.safetensors"):
        (tmp_path / name).write_text('{"ddprt": "1", "file": "other.safetensors"}')
    for suffix in (".json", ".safetensors"):
        shutil.copy(tmp_path / f"gloss-4{suffix}", tmp_path / f"gloss-2{suffix}")
    told = json.loads((tmp_path / "gloss-2.json").read_text())
    (tmp_path / "gloss-2.json").write_text(json.dumps({**told, "file": "gloss-2.safetensors"}))
    kept = {"notes.json", "notes.safetensors", "points.json", "transfer.safetensors"}
    export_layers(model, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == kept | {"gloss-4.json", "gloss-4.safetensors"}
    assert export_layers(replace(model, layers={}), tmp_path) == []
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_layers_of_methods_without_a_basis_are_refused(data: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UserError, match='layer "gloss-4" of method "mean"'):
        export_layers(ddprt.fit(data, "mean"), tmp_path)
