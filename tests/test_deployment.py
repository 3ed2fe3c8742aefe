"""Exports of every method: documented decoders, shaders and golden numbers against `predict`, and what cannot be exported."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import glsl
import jax.numpy as jnp
import numpy as np
import pytest
from made_up_rivals import POINTS, SHAPE, TEXELS, as_exported, model_of, relighters
from small_job import SMALL, call

from ddprt.errors import UserError
from ddprt.export import texel
from ddprt.export.browser import browser, layer_stack, shaded
from ddprt.export.deployed import export_model
from ddprt.export.frame import Frames
from ddprt.export.golden import example_values
from ddprt.export.textures import export_textures
from ddprt.lights import parse_lighting
from ddprt.methods import METHODS
from ddprt.methods.floors import MeanMap
from ddprt.methods.method import as_pytree
from ddprt.runtime.deployment import Deployment, deployment_of, refusal
from ddprt.runtime.deployments import DEPLOYMENTS
from ddprt.runtime.model import Model

DOCS = Path(__file__).parent.parent / "docs" / "deployment.md"
EPS32 = float(np.finfo(np.float32).eps)
KINDS = sorted(relighters(0, 3))
ALIKE = {("plain", "multi"), ("deep decoder", "mono"), ("turned decoder", "mono"), ("turned decoder", "multi")}
LINEAR_ONLY = {"harmonics", "cosines"}  # methods that answer from lights know no gamma
GLOW = np.random.default_rng(9).random((TEXELS, 3)).astype(np.float32)
VALIDATOR = shutil.which("glslangValidator")


@dataclass(frozen=True)
class Exported:
    """An export, what it was made of, and the model as its textures hold it."""

    model: Model
    held: Model
    folder: Path
    manifest: dict[str, Any]
    inputs: dict[str, np.ndarray]

    @property
    def expected(self) -> np.ndarray:
        """Light of the covered texels."""
        lighting = parse_lighting(list(deployment_of(self.model).example)) if "values" not in self.inputs else None
        return self.held.predict(example_values(self.model), lightings=lighting)

    @property
    def tolerance(self) -> float:
        """Of sums of a hundred products in float32, over the brightest texel; the power of the gamma space doubles it."""
        return 400 * EPS32 * float(np.abs(self.expected).max())


def exported(folder: Path, model: Model, **options: Any) -> Exported:
    export_model(model, folder, **options)
    manifest = json.loads((folder / "manifest.json").read_text())
    found = deployment_of(model)
    lighting = parse_lighting(list(found.example)) if found.lights else None
    inputs = {"values": example_values(model)} if found.lights is None else found.lights(lighting)
    return Exported(model, as_exported(model, folder, manifest), folder, manifest, inputs)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Exported]:
    """Exports of every kind, made once: halves in linear space for mono, floats in gamma space, with a glow, for multi."""
    kept: dict[tuple[str, str], Exported] = {}

    def make(kind: str, channels: str) -> Exported:
        if (kind, channels) not in kept:
            relighter = relighters(3, 3 if channels == "mono" else 1)[kind]
            gamma = channels == "multi" and kind not in LINEAR_ONLY
            more = {"constant": GLOW} if channels == "multi" else {}
            model = model_of(relighter, channels, "gamma" if gamma else "linear", **more)
            precision = "half" if channels == "mono" else "float"
            kept[kind, channels] = exported(
                tmp_path_factory.mktemp("export"), model, precision=precision, gutter=2, stitch=channels == "mono"
            )
        return kept[kind, channels]

    return make


@pytest.fixture(scope="module")
def docs() -> dict[str, Any]:
    """The Python blocks of docs/deployment.md, executed."""
    scope: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL):
        exec(block, scope)
    return scope


EVERY = pytest.mark.parametrize(
    ("kind", "channels"),
    [(kind, channels) for kind in KINDS for channels in ("mono", "multi") if (kind, channels) not in ALIKE],
)


@EVERY
def test_documented_decoder_and_shader_say_what_predict_says(
    kind: str, channels: str, made: Callable[[str, str], Exported], docs: dict[str, Any]
) -> None:
    one = made(kind, channels)
    rows = docs["frame"](one.folder, **one.inputs)
    own = Frames.read(one.folder).rows(one.inputs)
    np.testing.assert_allclose(own, rows, rtol=1e-5, atol=1e-5 * float(np.abs(rows).max()))
    assert one.expected.max() > 0.1
    image = docs["light"](one.folder, rows)
    assert image.shape == (*SHAPE, 3)
    np.testing.assert_allclose(image[one.model.covered], one.expected, rtol=0, atol=one.tolerance)
    source = (one.folder / "decode.glsl").read_text()
    ran = glsl.run(source, layer_stack(one.folder)[:, one.model.covered], rows, one.model.constant)
    np.testing.assert_allclose(ran, one.expected, rtol=0, atol=one.tolerance)


@EVERY
def test_golden_numbers_are_those_of_the_exported_precision(
    kind: str, channels: str, made: Callable[[str, str], Exported]
) -> None:
    one = made(kind, channels)
    golden = json.loads((one.folder / "golden.json").read_text())
    for name, given in one.inputs.items():
        np.testing.assert_allclose(golden[name], given, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(np.float32(golden["rows"]), Frames.read(one.folder).rows(one.inputs))
    places = np.array(golden["texels"])
    assert len(np.unique(places, axis=0)) == 5
    # Floats come back to rounding; halves may round apart where the model's scale of a map is not the texture's.
    step = 2.0**-9 if one.manifest["precision"] == "half" else 1e-5
    expected = one.model.image(one.expected)[tuple(places.T)]
    np.testing.assert_allclose(golden["light"], expected, rtol=0, atol=step * np.abs(one.expected).max())


def test_golden_light_is_rounded_as_the_textures_are(tmp_path: Path) -> None:
    """Where nothing is stitched and no gutter is brighter, it is that of the textures to the rounding of floats."""
    one = exported(tmp_path, model_of(relighters(6, 3)["plain"]), gutter=0, stitch=False)
    golden = json.loads((tmp_path / "golden.json").read_text())
    places = tuple(np.transpose(golden["texels"]))
    exact, unrounded = (one.model.image(light)[places] for light in (one.expected, one.model.predict(one.inputs["values"])))
    np.testing.assert_allclose(golden["light"], exact, rtol=0, atol=one.tolerance)
    assert np.abs(np.array(golden["light"]) - unrounded).max() > 2 * one.tolerance


@pytest.mark.skipif(VALIDATOR is None, reason="needs glslangValidator (glslang-tools)")
@EVERY
def test_shaders_compile(kind: str, channels: str, made: Callable[[str, str], Exported], tmp_path: Path) -> None:
    path = tmp_path / "decode.frag"
    path.write_text((made(kind, channels).folder / "decode.glsl").read_text())
    done = subprocess.run([str(VALIDATOR), str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_every_method_leaves_a_kind_that_is_deployed() -> None:
    assert {method.relighter for name, method in METHODS.items() if method.__module__.startswith("ddprt.")} <= set(DEPLOYMENTS)
    assert {type(one) for one in relighters(0, 3).values()} == set(DEPLOYMENTS)


@pytest.mark.parametrize("kind", ["linear", "plain"])
def test_linear_exports_stay_as_they_were(kind: str, made: Callable[[str, str], Exported], tmp_path: Path) -> None:
    one = made(kind, "mono")
    export_textures(one.model, tmp_path, gutter=2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    after = {path.name: path.read_bytes() for path in one.folder.iterdir()}
    assert after.keys() - before.keys() == {"decode.glsl", "golden.json"}
    manifest = one.manifest.copy()
    del manifest["deployment"]
    assert json.dumps(manifest, indent=1, ensure_ascii=False) + "\n" == before.pop("manifest.json").decode()
    assert {name: after[name] for name in before} == before


def test_another_export_leaves_nothing_of_the_one_before(tmp_path: Path) -> None:
    rivals = relighters(1, 3)
    for kind in ("nearest", "decoder", "plain"):
        files = export_model(model_of(rivals[kind]), tmp_path)
        assert {path.name for path in files} == {path.name for path in tmp_path.iterdir()}, kind
        assert files[-1].name == "manifest.json"


@pytest.mark.parametrize(
    ("kind", "field"), [("corrected", "gate"), ("set", "gates"), ("decoder", "head"), ("turned decoder", "head")]
)
def test_what_adds_nothing_is_not_shipped(kind: str, field: str, docs: dict[str, Any], tmp_path: Path) -> None:
    relighter = relighters(2, 3)[kind]
    shut = replace(relighter, **{field: jnp.zeros_like(getattr(relighter, field))})
    one = exported(tmp_path, model_of(shut), precision="float")
    assert one.manifest["deployment"]["shape"] == "compose"
    assert not (tmp_path / "network.safetensors").exists()
    image = docs["light"](tmp_path, docs["frame"](tmp_path, **one.inputs))
    np.testing.assert_allclose(image[one.model.covered], one.expected, rtol=0, atol=one.tolerance)


def test_both_sides_of_a_seam_are_decoded_to_the_same(tmp_path: Path, docs: dict[str, Any]) -> None:
    """Filtered first, decoded then: what is left of a jump in the features is left of one in the light."""
    from ddprt.export.seams import find_seams

    gaps = {}
    for stitch in (False, True):
        model = model_of(relighters(4, 3)["decoder"])
        one = exported(tmp_path / str(stitch), model, precision="float", gutter=4, stitch=stitch)
        rows = docs["frame"](one.folder, **one.inputs)
        known = np.ones(SHAPE, bool)
        seams = find_seams(model.occluders, model.uv, known)
        layers = np.stack([docs["image"](one.folder / name) for name in one.manifest["layers"]]).reshape(
            -1, SHAPE[0] * SHAPE[1], 4
        )
        sides = [
            glsl.run(
                (one.folder / "decode.glsl").read_text(),
                np.einsum("lspc,sp->lsc", layers[:, seams.texel[:, part]], np.abs(seams.weight[:, part])),
                rows,
            )
            for part in (slice(0, 4), slice(4, 8))
        ]
        gaps[stitch] = np.abs(sides[0] - sides[1]).mean() / np.abs(sides[0]).mean()
        assert one.manifest["seams"]["stitched"] == stitch
    assert gaps[False] > 0.1
    assert gaps[True] < 0.1 * gaps[False]


def test_a_map_that_no_point_saw_is_never_the_nearest(tmp_path: Path, docs: dict[str, Any]) -> None:
    """Light at a point that all maps have dark is equally far from all of them: the first one that is lit answers."""
    relighter = relighters(8, 3)["nearest"]
    model = model_of(replace(relighter, values=relighter.values.at[:, 0].set(0).at[0, :, 1].set(0)))
    one = exported(tmp_path, model, precision="float")
    values = np.zeros((POINTS, 3))
    values[0] = 2
    rows = Frames.read(tmp_path).rows({"values": values})
    np.testing.assert_array_equal(rows[0, :3], [0, 1, 0])
    np.testing.assert_array_equal(rows, docs["frame"](tmp_path, values))
    image = docs["light"](tmp_path, rows)[model.covered]
    np.testing.assert_allclose(image, one.held.predict(values), rtol=0, atol=one.tolerance)


def test_no_light_is_black_and_no_trouble(made: Callable[[str, str], Exported], docs: dict[str, Any]) -> None:
    dark = np.zeros((POINTS, 3))
    for kind in ("set", "decoder", "nearest", "perceptron"):
        folder = made(kind, "mono").folder
        rows = Frames.read(folder).rows({"values": dark})
        assert np.isfinite(rows).all()
        np.testing.assert_array_equal(rows, docs["frame"](folder, dark))
        assert not docs["light"](folder, rows).any()


@pytest.mark.parametrize(
    ("kind", "limit", "why"),
    [
        ("turned decoder", "MOST_ROWS", "a frame of 61 rows, and a uniform block is only sure to hold 3"),
        ("nearest", "MOST_LAYERS", "4 textures, and an array texture is only sure to hold 3"),
    ],
)
def test_shaders_that_could_not_run_are_not_written(
    kind: str, limit: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (texel.MOST_ROWS, texel.MOST_LAYERS) == (16384 // 16, 256), "what WebGL2 promises"
    monkeypatch.setattr(texel, limit, 3)
    one = exported(tmp_path, model_of(relighters(0, 3)[kind]))
    assert one.manifest["deployment"]["shader"] == {"file": None, "why": why}
    assert not (tmp_path / "decode.glsl").exists()
    assert (tmp_path / "golden.json").exists()


@as_pytree
@dataclass(frozen=True)
class Foreign(MeanMap):
    """Of another package: a kind that nobody knows."""


@as_pytree
@dataclass(frozen=True)
class Polite(MeanMap):
    """One that says how it is deployed."""

    def deployment(self, model: Model) -> Deployment:
        return DEPLOYMENTS[MeanMap](self, model)


def _refused() -> Iterator[tuple[str, Model, str]]:
    mean = relighters(0, 3)["mean"].mean
    dark = relighters(0, 3)["perceptron"]
    dark = replace(dark, basis=dark.basis[:0], spread=dark.spread[:0])
    yield "foreign", model_of(Foreign(mean)), 'got a model of method "made-up", whose Foreign does not say how it is deployed'
    yield "dark", model_of(dark), "got a model without bases, whose light is black"
    layer = SimpleNamespace(model=model_of(dark))
    layered = model_of(relighters(0, 3)["plain"], layers={"probes": layer})
    yield "layered", layered, 'got layer "probes" of method "made-up", expected a linear transfer'


@pytest.mark.parametrize(("model", "line"), [case[1:] for case in _refused()], ids=[case[0] for case in _refused()])
def test_what_cannot_be_exported_is_said_in_one_line(model: Model, line: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=re.escape(line)) as raised:
        export_model(model, tmp_path)
    assert str(raised.value) == refusal(model)
    assert "\n" not in refusal(model)
    assert not any(tmp_path.iterdir())


def test_a_method_of_another_package_may_say_how_it_is_deployed(tmp_path: Path) -> None:
    model = model_of(Polite(relighters(0, 3)["mean"].mean))
    assert refusal(model) == ""
    export_model(model, tmp_path)
    assert json.loads((tmp_path / "manifest.json").read_text())["deployment"]["shape"] == "table"


@pytest.mark.slow
@pytest.mark.skipif(browser() is None, reason="needs chromium or google-chrome on the path")
@EVERY
def test_a_browser_runs_the_shader(kind: str, channels: str, made: Callable[[str, str], Exported], tmp_path: Path) -> None:
    """In software, from textures as they are stored to light in floats."""
    one = made(kind, channels)
    found = shaded(one.folder, Frames.read(one.folder).rows(one.inputs), tmp_path, batches=1)
    assert len(found["milliseconds"]) == 1
    np.testing.assert_allclose(found["light"][one.model.covered], one.expected, rtol=0, atol=one.tolerance)


@pytest.mark.slow
def test_a_run_ends_with_an_export_whatever_the_method(tmp_path: Path) -> None:
    (tmp_path / "job.toml").write_text(SMALL)
    for method in ("nearest", "mlp"):
        assert call("run", tmp_path / "job.toml", "--out", tmp_path / method, "--fit.method", method, "--quiet") == 0
        told = json.loads((tmp_path / method / "export" / "manifest.json").read_text())["deployment"]
        assert told["shape"] == ("table" if method == "nearest" else "compose")
        assert call("export", tmp_path / "job.toml", "--out", tmp_path / method, "--quiet") == 0
