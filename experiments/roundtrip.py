"""What leaves by every exit, read back: how near to the model, and what a damaged file leads to.

Question: how far are textures, the C runtime, three.js's shader and the viewer's page from `Model.predict`, does the scene
          come back by glTF as it went, and does every damaged file end in one line?
Command:  python experiments/roundtrip.py            Cornell box at 128², 3000 damaged files, minutes
          python experiments/roundtrip.py --quick    at 64², 400 damaged files
Answer:   docs/engines.md, "Back again"

What a machine lacks (a compiler, a browser) is null. The last line is JSON: bytes and held-out relative RMSE of each format,
largest errors over the largest light of a frame, and whether all damaged files loaded soundly or were refused.
"""

import itertools
import json
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from test_gltf_mutations import chosen, holds, of_the_bytes, of_the_text  # damaged files, and the law that holds for them
from test_viewer import browsed  # the page with a probe in it

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.export.browser import browser, drawn
from ddprt.export.deployed import export_model
from ddprt.export.engines.engine import HERE
from ddprt.export.engines.packed import Packed
from ddprt.export.gltf.writing import export_gltf
from ddprt.export.table import HeldOut, format_table, told
from ddprt.export.viewer.pack import pack
from ddprt.export.viewer.page import page
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene

SETTINGS = {"lightings.train": "48", "lightings.validation": "4", "lightings.test": "12", "transport.target_noise": "0.03"}
QUICK = SETTINGS | {"atlas.resolution": "64", "transport.target_noise": "0.05"}
FRAMES = 4
PROBE = """const { values } = JSON.parse(document.getElementById("asked").textContent), { frame } = window.ddprt;
const maps = values.map((one) => {
  const { s, z } = frame.transfer.encoded(one.flat());
  frame.composer.compose(frame.transfer.weights(z), s, 99);
  return Array.from(frame.composer.read());
});
const node = Object.assign(document.createElement("p"), { id: "probe", textContent: JSON.stringify({ faults, maps }) });
document.body.append(node);"""


def main(quick: bool) -> None:
    changes = QUICK if quick else SETTINGS | {"atlas.resolution": "128"}
    config = load_config("configs/cornell.toml", changes)
    scene = ddprt.load_scene("cornell")
    data = ddprt.bake(scene, config=config, out=Path("runs") / f"roundtrip-{config.atlas.resolution}")
    model = ddprt.fit(data, bases=16)
    test = data.split("test")
    rows = format_table(model, HeldOut(data.values(test, model.points, model.quantity), data.maps("indirect", test)))
    print(told(rows))
    found: dict[str, Any] = {
        "formats": {row.name: {"bytes": row.bytes, "relative_rmse": row.held_out_relative_rmse} for row in rows}
    }
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        export_model(model, folder / "export", engines=["c", "three"], stitch=False)
        found |= {
            "c_runtime_max_error": in_c(model, data, folder),
            "shader_max_error": in_a_shader(model, data, folder),
            "viewer_max_error": in_the_viewer(model, data, folder),
            "gltf_same": by_gltf(model, scene, folder),
            **damaged(400 if quick else 3000, folder),
        }
    print(json.dumps(found))


def off(light: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference, in units of the largest light of its frame."""
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(light, expected, strict=True))


def frames_of(model: Model, data: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Some held-out measurements, and what the model makes of them."""
    values = data.values(data.split("test")[:FRAMES], model.points, model.quantity)
    return values, model.predict(values)


def in_c(model: Model, data: Dataset, folder: Path) -> float | None:
    """By ddprt_runtime.h, from samples that were shaded."""
    compiler = shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    source, probe = Path(__file__).parents[1] / "tests" / "runtime_probe.c", folder / "probe"
    subprocess.run([compiler, "-std=c99", "-O2", f"-I{HERE / 'c'}", str(source), "-o", str(probe), "-lm"], check=True)
    values, expected = frames_of(model, data)
    home, maps = model.samples.nearest_point(model.points), []
    for frame in values:
        shaded = frame[home] / (model.samples.albedo if model.quantity == "radiosity" else 1)
        answer = subprocess.run(
            [str(probe), str(folder / "export/c/model.bin")],
            input=np.float32(shaded).tobytes(),
            capture_output=True,
            check=True,
        )
        light = np.frombuffer(answer.stdout, np.float32)[-3 * model.covered.size :]
        maps.append(light.reshape(*model.covered.shape, 3)[model.covered])
    return off(np.stack(maps), expected)


def in_a_shader(model: Model, data: Dataset, folder: Path) -> float | None:
    """By the fragment shader for three.js, in a browser that renders in software."""
    if browser() is None:
        return None
    packed, (values, expected) = Packed.read(folder / "export"), frames_of(model, data)
    source, maps = (folder / "export/three/compose.frag").read_text(), []
    for frame in values[:1]:
        rows = packed.rows(*packed.frame(frame))
        drawing = drawn(source, packed.layers.astype(np.float32), rows, folder, glow=packed.constant)
        maps.append(drawing["light"][model.covered])
    return off(np.stack(maps), expected[:1])


def in_the_viewer(model: Model, data: Dataset, folder: Path) -> float | None:
    """By the page of `ddprt view`."""
    if browser() is None:
        return None
    values, expected = frames_of(model, data)
    answer = browsed(page(pack(model, stitch=False)), {"values": values.tolist()}, PROBE, folder)
    assert not answer["faults"], answer["faults"]
    maps = np.array(answer["maps"]).reshape(len(values), *model.covered.shape, 4)
    return off(maps[:, model.covered][..., :3], expected)


def by_gltf(model: Model, scene: Scene, folder: Path) -> bool:
    """Whether triangles and lightmap coordinates come back, to the last bit of float32."""
    again = ddprt.load_scene(export_gltf(model, folder, scene))
    if again.lightmap is None or model.uv is None:
        return False

    def rows(corners: np.ndarray, uv: np.ndarray) -> np.ndarray:
        flat = np.float32(np.concatenate([corners.reshape(len(corners), 9), uv.reshape(len(uv), 6)], 1))
        return flat[np.lexsort(flat.T)]

    return np.array_equal(rows(again.corners, again.lightmap[again.triangles]), rows(scene.corners, model.uv))


def damaged(count: int, folder: Path) -> dict[str, Any]:
    """Damaged glTF files: each must load soundly, or be refused in one line."""
    files = list(itertools.chain(chosen(), of_the_text(count // 2), of_the_bytes(count // 2)))
    loaded = refused = 0
    unclean = []
    for name, data in files:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the library that reads the JSON
                fine, told_off = holds([(name, data)], folder / "bad.glb")
        except Exception as problem:
            unclean.append(f"{name}: {type(problem).__name__}")
        else:
            loaded, refused = loaded + fine, refused + told_off
    print(f"{len(files)} damaged files: {loaded} loaded, {refused} refused, {len(unclean)} neither", *unclean[:9], sep="\n")
    return {"malformed_files": len(files), "malformed_clean": not unclean}


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
