"""Parts of the export that were made apart, used together: formats, learned methods, what moves, and the viewer."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up_rivals import POINTS, TEXELS, model_of, relighters
from small_job import SMALL, call

from ddprt.config import checked
from ddprt.errors import UserError
from ddprt.export.animated import export_animated
from ddprt.export.deployed import export_model
from ddprt.export.formats.listing import FORMATS
from ddprt.export.frame import Frames
from ddprt.files import read_tensors
from ddprt.pipeline_animation import AnimatedRun
from ddprt.runtime.animated import AnimatedModel
from ddprt.sampling.riding import Riders
from ddprt.scene.fog import Fog


def moving() -> AnimatedModel:
    """A made-up model of two keyframes, half a second apart, by the second of which it is twice as large."""
    rest = replace(model_of(relighters(5, 3)["plain"]), method="svd-ridge")
    corners = rest.occluders.reshape(-1, 3).astype(np.float64)
    riders = Riders(np.arange(POINTS) % 2, np.full((POINTS, 3), 1 / 3), rest.samples)
    parts = [np.stack([np.asarray(getattr(rest.relighter, name))] * 2) for name in ("matrix", "offset", "intercept")]
    return AnimatedModel(
        rest,
        np.array([0.0, 0.5]),
        np.stack([corners, 2 * corners]),
        np.arange(6).reshape(2, 3),
        riders,
        *parts,
        np.ones((2, TEXELS)),
    )


@pytest.mark.parametrize("kind", ["plain", "perceptron", "cosines"])
def test_formats_of_networks_take_features(kind: str, tmp_path: Path) -> None:
    """Whatever makes the features, textures in a format weigh what its own transfer makes of them."""
    model = model_of(relighters(3, 3)[kind])
    export_model(model, tmp_path, formats=("exr", "raw"), stitch=False, gutter=2)
    manifest, golden = (json.loads((tmp_path / name).read_text()) for name in ("manifest.json", "golden.json"))
    frames, told = Frames.read(tmp_path), manifest["formats"]["raw"]
    inputs = {name: np.array(golden[name]) for name in ("values", "strength", "told") if name in golden}
    rows = replace(frames, transfer=read_tensors(tmp_path / told["transfer"]), manifest=_wider(manifest)).rows(inputs)
    weights, s = rows[: told["maps"] + 1, :3], rows[-1, :3]
    layers = np.frombuffer((tmp_path / "basis.rgba16f").read_bytes(), "<f2").reshape(-1, *model.covered.shape, 4)
    maps = np.concatenate(layers.astype(np.float32), 2)[..., : told["maps"]]
    y = np.maximum(maps @ weights[:-1] + weights[-1], 0) * s
    expected = np.array(golden["light"])
    np.testing.assert_allclose(y[tuple(np.transpose(golden["texels"]))], expected, atol=2e-3 * expected.max())
    learned = kind != "plain"
    assert any("(f - offset)" in step for step in manifest["decode_formats"]) == learned


def _wider(manifest: dict) -> dict:
    """Of a frame whose u has the rows of a format: all maps and the texture of ones."""
    count = manifest["formats"]["raw"]["maps"] + 1
    return manifest | {"deployment": manifest["deployment"] | {"frame": {"u": [0, count], "s": [count, 1]}}}


@pytest.mark.parametrize("kind", ["linear", "perceptron"])
def test_without_layers_there_is_no_shader_and_the_manifest_says_why(kind: str, tmp_path: Path) -> None:
    export_model(model_of(relighters(3, 3)[kind]), tmp_path)
    files = export_model(model_of(relighters(3, 3)[kind]), tmp_path, formats=("raw", "bytes"))
    told = json.loads((tmp_path / "manifest.json").read_text())["deployment"]
    assert told["shader"] == {"file": None, "why": 'it reads EXR layers; add "exr" to export.formats'}
    assert told["golden"] is None
    assert {path.name for path in files} == {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("kind", ["plain", "cosines", "nearest"])
def test_exports_of_all_kinds_tell_their_fog(kind: str, tmp_path: Path) -> None:
    """Methods that are told lamps too: the engine's direct light on surfaces is attenuated, whatever makes the indirect."""
    model = model_of(relighters(3, 3)[kind])
    for fog, told in ((None, (False, 0)), (Fog((1.0, 2.0, 3.0)), (True, 1))):
        *_, path = export_model(replace(model, fog=fog), tmp_path, stitch=False, gutter=2)
        manifest = json.loads(path.read_text())
        assert ("fog" in manifest, sum("fog" in step for step in manifest["decode"])) == told


@pytest.mark.parametrize("kind", ["decoder", "turned decoder", "mean", "nearest"])
def test_texels_that_do_more_than_add_up_have_no_further_formats(kind: str, tmp_path: Path) -> None:
    for name in FORMATS:
        if name != "exr":
            with pytest.raises(UserError, match=f'export.formats: got "{name}" with made-up, whose texels'):
                export_model(model_of(relighters(3, 3)[kind]), tmp_path, formats=("exr", name))
    assert not any(tmp_path.iterdir())


def test_an_animation_is_exported_in_layers_alone(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=re.escape('export.formats: got "raw" with an animation, expected "exr" alone')):
        export_animated(moving(), tmp_path, formats=("exr", "raw"))
    assert not any(tmp_path.iterdir())
    bending = {"scene": {"name": "bending"}, "animation": {"keys": 2}, "export": {"formats": ["ktx2"]}}
    with pytest.raises(UserError, match=r'export\.formats: got "ktx2" with an animation'):  # before anything is baked
        AnimatedRun(checked(bending), tmp_path / "run", quiet=True).bake()
    assert not any(tmp_path.iterdir())


def test_a_model_that_moves_is_viewed_at_a_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, page = moving(), tmp_path / "page.html"
    model.save(tmp_path / "model.ddprt")
    pages = []
    for time in ("0", "0.5"):
        assert call("view", tmp_path, "--html", page, "--time", time) == 0
        pages.append(json.loads(re.search(r'id="model">(.*?)</script>', page.read_text())[1]))
    assert pages[0]["corners"] != pages[1]["corners"]
    assert pages[0]["maps"] == pages[1]["maps"]
    page.unlink()
    still = tmp_path / "still.ddprt"
    model.rest.save(still)
    capsys.readouterr()
    for words, says in (
        ((tmp_path,), "ddprt view: got an animation and no --time"),
        ((still, "--time", "0"), "ddprt view: got --time and a model that stands still"),
        ((tmp_path, "--time", "3"), "got 3 s, expected 0 to 0.5"),
        ((tmp_path, "--time", "0", "--dataset", tmp_path), "--dataset: got one beside --time, expected none"),
    ):
        assert call("view", *words, "--html", page) == 2
        error = capsys.readouterr().err
        assert says in error
        assert error.count("\n") == 1
    assert not page.exists()


def test_settings_that_no_method_could_meet_are_told_before_the_bake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "job.toml").write_text(SMALL.replace("resolution = 32", "resolution = 30"))
    words = "run", tmp_path / "job.toml", "--out", tmp_path / "run", "--fit.method", "mlp", "--quiet"
    assert call(*words, "--export.formats", '["bc6h"]') == 2
    assert "30x30" in capsys.readouterr().err
    assert not (tmp_path / "run" / "dataset").exists()
