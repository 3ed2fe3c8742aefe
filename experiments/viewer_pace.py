"""A frame of the viewer, part by part, in a browser that renders in software.

Question: what do shadow rays, composing and drawing take when a lamp moves?
Command:  python experiments/viewer_pace.py [--resolution 1024] [--bases 16]    Cornell box, half a minute at 1024²
Answer:   docs/viewer.md, "How it works"

Parts are medians over frames, milliseconds; each ends with a pixel read back, which waits for all that was asked for. The last
line is JSON.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from pages import browsed  # the page with a probe in it

import ddprt
from ddprt.config import load_config
from ddprt.export.viewer.pack import pack
from ddprt.export.viewer.page import page

FRAMES = 15
SMALL = {"lightings.train": "32", "lightings.validation": "1", "lightings.test": "1"}
SMALL |= {"transport.samples": "8", "transport.test_samples": "8"}  # grain takes no longer than light
PROBE = """
const asked = JSON.parse(document.getElementById("asked").textContent), app = window.ddprt, told = {};
const timed = (name, work) => {
  const begun = performance.now();
  work();
  (told[name] ??= []).push(performance.now() - begun);
};
const gl = app.view.renderer.getContext(), pixel = new Uint8Array(4), light = new Float32Array(4);
const { composer } = app.frame;
const waited = () => app.view.renderer.readRenderTargetPixels(composer.target, 0, 0, 1, 1, light);
for (let frame = 0; frame <= asked.frames; frame++) {
  const turn = (2 * Math.PI * frame) / asked.frames, [x, y, z] = asked.place;
  const position = [x + 0.05 * Math.cos(turn), y, z + 0.05 * Math.sin(turn)];
  timed("update", () => {
    app.set({ lamps: [{ type: "point", position, intensity: [0.05, 0.05, 0.05] }] }, { link: false });
    waited();
  });
  for (const [part, taken] of Object.entries(app.frame.milliseconds)) (told[part] ??= []).push(taken);
  timed("compose", () => {
    composer.compose(app.frame.weights, app.frame.scale, 99);
    waited();
  });
  timed("draw", () => {
    app.view.draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  });
}
const median = (all) => all.slice(1).sort((a, b) => a - b)[(all.length - 1) >> 1]; // the first compiles
const named = gl.getExtension("WEBGL_debug_renderer_info");
const report = Object.fromEntries(Object.entries(told).map(([part, all]) => [part, median(all)]));
report.rays = app.frame.measuring.rays;
report.renderer = gl.getParameter(named.UNMASKED_RENDERER_WEBGL);
report.picture = [gl.drawingBufferWidth, gl.drawingBufferHeight];
const found = Object.assign(document.createElement("p"), { id: "probe", textContent: JSON.stringify(report) });
document.body.append(found);
"""


def main() -> None:
    """Bakes, fits, makes the page and times it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=1024)
    parser.add_argument("--bases", type=int, default=16)
    asked = parser.parse_args()
    config = load_config("configs/cornell.toml", SMALL | {"atlas.resolution": str(asked.resolution)})
    scene = ddprt.load_scene("cornell")
    question: dict[str, Any] = {"frames": FRAMES, "place": scene.positions.mean(0).tolist()}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        data = ddprt.bake(scene, config=config, out=folder / "data")
        model = ddprt.fit(data, bases=asked.bases, points=config.points.count)
        found = browsed(page(pack(model)), question, PROBE, folder)
    print(json.dumps({"resolution": asked.resolution, "bases": asked.bases, **found}))


if __name__ == "__main__":
    main()
