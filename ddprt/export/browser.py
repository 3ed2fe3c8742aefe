"""The shader of an export on a page of its own, run by a browser without a window: what it gives, and how long it takes."""

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float32
from ddprt.errors import UserError
from ddprt.scene.exr import read_exr

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    *("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--dump-dom"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
)
_PAGE = """<!doctype html><meta charset="utf-8"><title>decode.glsl</title><pre id="told"></pre>
<script type="application/json" id="given">GIVEN</script>
<script>
const given = JSON.parse(document.getElementById("given").textContent), told = {};
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
function text(array) {
  const view = new Uint8Array(array.buffer), parts = [];
  for (let at = 0; at < view.length; at += 8192) parts.push(String.fromCharCode(...view.subarray(at, at + 8192)));
  return btoa(parts.join(""));
}
function run() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) throw Error("no WebGL2");
  if (!gl.getExtension("EXT_color_buffer_float")) throw Error("no float targets");
  const filter = given.half || gl.getExtension("OES_texture_float_linear") ? gl.LINEAR : gl.NEAREST;
  const named = gl.getExtension("WEBGL_debug_renderer_info");
  told.renderer = gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  const program = gl.createProgram();
  const vertex = "#version 300 es\\nout vec2 lightmap; void main() { vec2 at = vec2(gl_VertexID & 1, gl_VertexID >> 1);"
    + " lightmap = 2.0 * at; gl_Position = vec4(4.0 * at - 1.0, 0.0, 1.0); }";
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, given.source]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const bind = (unit, target, name, how) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(target, gl.createTexture());
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, side, gl.CLAMP_TO_EDGE);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, side, how);
    gl.uniform1i(gl.getUniformLocation(program, name), unit);
  };
  const [count, height, width] = given.shape;
  bind(0, gl.TEXTURE_2D_ARRAY, "layers", filter);
  if (given.half) gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.RGBA16F, width, height, count, 0, gl.RGBA, gl.HALF_FLOAT,
    new Uint16Array(bytes(given.layers)));
  else gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.RGBA32F, width, height, count, 0, gl.RGBA, gl.FLOAT,
    new Float32Array(bytes(given.layers)));
  if (given.constant) {
    bind(1, gl.TEXTURE_2D, "constant", gl.getExtension("OES_texture_float_linear") ? gl.LINEAR : gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, new Float32Array(bytes(given.constant)));
  }
  const rows = new Float32Array(bytes(given.rows));
  if (gl.getUniformLocation(program, "rows")) {
    bind(2, gl.TEXTURE_2D, "rows", gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, rows.length / 4, 1, 0, gl.RGBA, gl.FLOAT, rows);
  } else {
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, gl.createBuffer());
    gl.bufferData(gl.UNIFORM_BUFFER, rows, gl.DYNAMIC_DRAW);
    gl.uniformBlockBinding(program, gl.getUniformBlockIndex(program, "Frame"), 0);
  }
  gl.activeTexture(gl.TEXTURE3);
  const target = gl.createTexture(), [down, across] = given.size;
  gl.bindTexture(gl.TEXTURE_2D, target);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, across, down);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) throw Error("no float target");
  gl.viewport(0, 0, across, down);
  const read = (x, y) => {
    const pixels = new Float32Array(4 * x * y);
    gl.readPixels(0, 0, x, y, gl.RGBA, gl.FLOAT, pixels);
    return pixels;
  };
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  told.light = text(read(across, down));
  told.milliseconds = [];
  for (let batch = 0; batch < given.batches; ++batch) {
    const begun = performance.now();
    for (let draw = 0; draw < given.draws; ++draw) gl.drawArrays(gl.TRIANGLES, 0, 3);
    read(1, 1);  // which waits for all of them
    told.milliseconds.push((performance.now() - begun) / given.draws);
  }
  const fault = gl.getError();
  if (fault) throw Error("WebGL error " + fault);
}
try { run(); } catch (error) { told.fault = String(error.message || error); }
document.getElementById("told").textContent = JSON.stringify(told);
</script>
"""


def browser() -> str | None:
    """A browser on the path; None where there is none."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def layer_stack(folder: Path) -> Float32[np.ndarray, "layers height width 4"]:
    """What the shader's array texture holds: layers of the export in order, then its mean."""
    manifest = json.loads((folder / "manifest.json").read_text())
    names = [*manifest["layers"], *([manifest["mean"]] if manifest["mean"] else [])]
    return np.stack([_four(read_exr(folder / name)[0]) for name in names])


def shaded(
    folder: Path,
    rows: Float32[np.ndarray, "rows 4"],
    scratch: Path,
    *,
    size: tuple[int, int] | None = None,
    batches: int = 0,
    draws: int = 8,
) -> dict[str, Any]:
    """Runs the shader of an export in a browser that renders in software.

    Args:
      folder: of the export.
      rows: of a frame.
      scratch: a folder for the page and the browser's profile.
      size: height and width of what is drawn; None for a pixel per texel.
      batches: of draws that are timed.
      draws: in each.
    Returns:
      `light` (height, width, 3) in W/m²; `milliseconds` of a draw, one for each batch; `renderer`.
    Raises:
      UserError: no browser, no shader, or the browser could not run it; with its words.
    """
    source = folder / "decode.glsl"
    if not source.is_file():
        raise UserError(f"shader: got {folder} without decode.glsl, expected an export with one; its manifest says why")
    manifest = json.loads((folder / "manifest.json").read_text())
    layers, half, constant = layer_stack(folder), manifest["precision"] == "half", manifest.get("constant")
    glow = read_exr(folder / constant)[0] if constant else None
    return drawn(source.read_text(), layers, rows, scratch, half=half, glow=glow, size=size, batches=batches, draws=draws)


def drawn(
    source: str,
    layers: Float32[np.ndarray, "layers height width 4"],
    rows: Float32[np.ndarray, "rows 4"],
    scratch: Path,
    *,
    half: bool = True,
    glow: Float32[np.ndarray, "height width 3"] | None = None,
    size: tuple[int, int] | None = None,
    batches: int = 0,
    draws: int = 8,
) -> dict[str, Any]:
    """The same of any fragment shader that reads `layers`, `constant`, and `rows`: a texture, or the block `Frame`.

    Args:
      source: GLSL ES 3.00.
      layers: of the array texture.
      rows, scratch, size, batches, draws: as for `shaded`.
      half: whether the textures are halves.
      glow: what `constant` holds.
    Raises:
      UserError: no browser, or it could not run the shader; with its words.
    """
    found = browser()
    if found is None:
        raise UserError(f"shader: got no browser on the path, expected one of {', '.join(BROWSERS)}; install one")
    height, width = size or layers.shape[1:3]
    given = {
        "source": source,
        "shape": layers.shape[:3],
        "half": half,
        "layers": _text(layers.astype(np.float16 if half else np.float32)),
        "constant": None if glow is None else _text(_four(glow)),
        "rows": _text(rows),
        "size": (height, width),
        "batches": batches,
        "draws": draws,
    }
    page = scratch / "page.html"
    page.write_text(_PAGE.replace("GIVEN", json.dumps(given).replace("<", "\\u003c")))
    done = subprocess.run(
        [found, *_FLAGS, f"--user-data-dir={scratch / 'profile'}", page.as_uri()], capture_output=True, text=True, check=False
    )
    answer = re.search(r'<pre id="told">(\{.*?\})</pre>', done.stdout)
    told = json.loads(answer[1]) if answer else {"fault": "no answer"}
    if "fault" in told:
        raise UserError(f"shader: the browser said: {told['fault']}")
    light = np.frombuffer(base64.b64decode(told["light"]), np.float32).reshape(height, width, 4)[..., :3]
    return {"light": light, "milliseconds": told["milliseconds"], "renderer": told["renderer"]}


def _four(image: np.ndarray) -> Float32[np.ndarray, "height width 4"]:
    return np.pad(image, ((0, 0), (0, 0), (0, 4 - image.shape[2]))).astype(np.float32)


def _text(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
