"""Every file of the glTF catalogue, from the file to the browser: baked, fitted, exported for an engine and as glTF, opened."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from gltf_files import QUAD
from pages import browsed
from small_job import call
from test_engines import COMPILER, STRICT, needs_compiler
from test_gltf import FILES, File, written

import ddprt
from ddprt.scene.files import load_scene

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")]

TINY = """
[atlas]
resolution = 24
[lightings]
train = 6
validation = 1
test = 1
clearance = 0.1
[points]
count = 8
supersample = 1
[transport]
samples = 16
test_samples = 16
threads = 2
[fit]
bases = 2
[methods]
compare = ["svd-ridge"]
[report]
rows = 1
bases_curve = [2]
spot_check_texels = 8
spot_check_lightings = 1
spot_check_samples = 16
[export]
engines = ["c"]
gltf = true
"""
PROBE = """const { frame, view } = window.ddprt, { lamps } = JSON.parse(document.getElementById("asked").textContent);
const pixels = (lamps) => new Promise((done) => {
  window.ddprt.set({ lamps, lighting: null, show: "both", albedo: false });
  const shot = new Image(), canvas = document.createElement("canvas");
  shot.onload = () => {
    [canvas.width, canvas.height] = [shot.width, shot.height];
    canvas.getContext("2d").drawImage(shot, 0, 0);
    done(canvas.getContext("2d").getImageData(0, 0, shot.width, shot.height).data);
  };
  shot.src = view.screenshot();
});
(async () => {
  const [dark, bright] = [await pixels([]), await pixels(lamps)];
  const measured = Array.from(frame.measuring.measure(lamps)), { s, z } = frame.transfer.encoded(measured);
  frame.composer.compose(frame.transfer.weights(z), s, 99);
  const map = Array.from(frame.composer.read()), node = document.createElement("p");
  const lit = bright.filter((x, i) => x > dark[i] + 5).length / (0.75 * bright.length);
  node.id = "probe";
  node.textContent = JSON.stringify({ faults, measured, map, lit });
  document.body.append(node);
})();"""


def faced(file: File) -> File:
    """The file and a card that faces all that it holds, a metre above, so that light goes back and forth."""
    low, high = file.corners.min((0, 1)), file.corners.max((0, 1))
    corners = np.where(QUAD[[1, 0, 3, 2]] > 0, high, low)
    corners[:, 2] = high[2] + 1
    writer = file.writer
    attributes = {"POSITION": writer.accessor(corners), "NORMAL": writer.accessor(np.array([[0.0, 0, -1]] * 4))}
    writer.node(mesh=writer.quad(**attributes))
    return file


def run(path: Path, folder: Path, *words: str) -> int:
    (folder / "tiny.toml").write_text(TINY, "utf-8")
    return call("run", folder / "tiny.toml", "--scene.name", path, "--out", folder / "run", *words)


@needs_compiler
@pytest.mark.parametrize("name", FILES)
def test_from_file_to_browser(name: str, tmp_path: Path) -> None:
    file = faced(FILES[name]())
    path = written(file, tmp_path)
    assert run(path, tmp_path) == 0
    out = tmp_path / "run"

    scene, again = load_scene(path), load_scene(out / "export" / "scene.glb")
    by_place = [rows[np.lexsort(rows.T[::-1])] for rows in (one.corners.reshape(-1, 9) for one in (scene, again))]
    np.testing.assert_array_equal(*by_place)
    assert again.lightmap is not None

    build = [str(COMPILER), *STRICT, "check.c", "-o", str(tmp_path / "check"), "-lm"]
    subprocess.run(build, cwd=out / "export" / "c", check=True, capture_output=True)
    subprocess.run([tmp_path / "check"], cwd=out / "export" / "c", check=True, capture_output=True)

    assert call("view", out, "--dataset", out / "dataset", "--html", tmp_path / "a.html") == 0
    middle = (file.corners.min((0, 1)) + file.corners.max((0, 1))) / 2
    middle[2] = file.corners[..., 2].max() + 0.5
    strength = float(np.sum(np.square(np.ptp(file.corners, (0, 1)))))  # as bright in a long room as in a small one
    lamps = [{"type": "point", "position": middle.tolist(), "intensity": [strength] * 3}]
    found = browsed((tmp_path / "a.html").read_text("utf-8"), {"lamps": lamps}, PROBE, tmp_path)
    assert found["faults"] == []
    assert found["lit"] > 0.01, "a picture of something"
    model = ddprt.load_model(out / "model.ddprt")
    values = model.measure(lamps)
    np.testing.assert_allclose(np.reshape(found["measured"], (-1, 3)), values, rtol=2e-4, atol=2e-5 * values.max())
    expected = model.predict(values)
    assert expected.max() > 0
    shown = np.reshape(found["map"], (*model.covered.shape, 4))[model.covered][:, :3]
    assert np.abs(shown - expected).max() < 2e-3 * expected.max()


def test_a_lone_rectangle_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It sends nothing back to itself, and has no room inside."""
    path = written(FILES["colour factor"](), tmp_path)
    for distribution, said in (("around", "export.formats: got a model without any light"), ("room", "lightings: got no free")):
        assert run(path, tmp_path, "--lightings.distribution", distribution) == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith(f"ddprt: {said}")
