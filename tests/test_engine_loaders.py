"""Loaders of engines: what Node, Mono and three.js in a browser make of model.bin, and what they refuse."""

import base64
import importlib.util
import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up_rivals import SHAPE
from test_engines import CASES, close
from test_engines import made as made
from three_page import needs_three, told_by_three

from ddprt.export.engines.packed import Packed
from ddprt.runtime.model import Model

NODE, MONO, MCS = map(shutil.which, ("node", "mono", "mcs"))
Made = Callable[[str], tuple[Model, Path]]
DAMAGED = ["not a model of this version of ddprt", "damaged", "damaged"]


def shaded_of(model: Model) -> np.ndarray:
    return (np.arange(3 * len(model.samples.position), dtype=np.float32) % 7).reshape(-1, 3)


def averaged(model: Model) -> np.ndarray:
    """Measured light of the points, of that."""
    leaving, home = shaded_of(model) * model.samples.albedo, model.samples.nearest_point(model.points)
    return np.stack([leaving[home == point].mean(0) for point in range(model.points)])


def check_told(told: dict, model: Model, golden: dict) -> None:
    """Rows, averages and words of a loader that was run on golden numbers and on damaged files."""
    close(np.array(told["rows"]).reshape(-1, 4), np.array(golden["rows"]), 1e-6)
    close(np.array(told["average"]).reshape(-1, 3), averaged(model), 1e-6)
    assert [line.split(": ")[1].split(";")[0] for line in told["refused"]] == DAMAGED
    assert told["dark"] == "ddprt: measured light is not finite"


NODE_SCRIPT = """
import { readFileSync } from "node:fs";
import { Model } from "FOLDER/model.js";
const bytes = readFileSync("FOLDER/model.bin"), whole = () => Uint8Array.from(bytes).buffer;
const model = new Model(whole()), golden = JSON.parse(readFileSync("FOLDER/golden.json"));
const flipped = () => { const b = whole(); new Uint8Array(b)[100] ^= 1; return b; };
const words = (work) => { try { work(); return null; } catch (error) { return error.message; } };
const refused = [whole().slice(0, 40), whole().slice(0, -1), flipped()].map((buffer) => words(() => new Model(buffer)));
const dark = words(() => model.rows(golden.values.flat().map(() => NaN)));
const shaded = Float32Array.from({ length: 3 * model.samples }, (_, i) => i % 7);
const average = [...model.average(shaded)];
console.log(JSON.stringify({ rows: [...model.rows(golden.values.flat())], average, refused, dark }));
"""


@pytest.mark.skipif(NODE is None, reason="needs node")
@pytest.mark.parametrize("case", CASES)
def test_node_makes_the_golden_rows(case: str, made: Made, tmp_path: Path) -> None:
    model, folder = made(case)
    (tmp_path / "try.mjs").write_text(NODE_SCRIPT.replace("FOLDER", str(folder / "three")))
    done = subprocess.run([str(NODE), str(tmp_path / "try.mjs")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    check_told(json.loads(done.stdout), model, json.loads((folder / "three/golden.json").read_text()))


MONO_PROGRAM = """
using System; using System.Globalization; using System.IO; using System.Linq;
static class Try {
  static void Words(Action work) {
    try { work(); } catch (Exception told) { Console.WriteLine(told.Message.Split((char)10)[0]); }
  }
  static void List(float[] all) {
    Console.WriteLine(string.Join(" ", all.Select(x => x.ToString("R", CultureInfo.InvariantCulture))));
  }
  static void Main(string[] told) {
    byte[] whole = File.ReadAllBytes(told[0]), flipped = (byte[])whole.Clone();
    flipped[100] ^= 1;
    var model = DdprtModel.Parse(whole);
    var values = File.ReadLines(told[1]).Skip(1).Take(model.Points).SelectMany(line => line.Split(' '))
      .Select(word => float.Parse(word, CultureInfo.InvariantCulture)).ToArray();
    List(model.Rows(values));
    List(model.Average(Enumerable.Range(0, 3 * model.Samples).Select(i => (float)(i % 7)).ToArray()));
    foreach (var bytes in new[] { whole.Take(40).ToArray(), whole.Take(whole.Length - 1).ToArray(), flipped })
      Words(() => DdprtModel.Parse(bytes));
    Words(() => model.Rows(values.Select(x => float.NaN).ToArray()));
  }
}
"""


@pytest.mark.slow
@pytest.mark.skipif(MONO is None or MCS is None, reason="needs mono and mcs (mono-mcs)")
@pytest.mark.parametrize("case", CASES)
def test_mono_makes_the_golden_rows(case: str, made: Made, tmp_path: Path) -> None:
    model, folder = made(case)
    (tmp_path / "Try.cs").write_text(MONO_PROGRAM)
    sources = [str(tmp_path / "Try.cs"), str(folder / "unity/DdprtModel.cs")]
    built = subprocess.run([str(MCS), "-warnaserror", f"-out:{tmp_path / 'try.exe'}", *sources], capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    command = [str(MONO), str(tmp_path / "try.exe"), str(folder / "unity/model.bin"), str(folder / "unity/golden.txt")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows, average, *refused, dark = done.stdout.splitlines()
    told = {"rows": np.fromstring(rows, sep=" "), "average": np.fromstring(average, sep=" "), "refused": refused, "dark": dark}
    check_told(told, model, json.loads((folder / "unity/golden.json").read_text()))


COMPOSED = """
  const { Lightmap } = await import("/model/lightmap.js"), renderer = new THREE.WebGLRenderer();
  const lightmap = await Lightmap.load(THREE, renderer, new URL("/model/", location.href));
  lightmap.relight(Float32Array.from({ length: 3 * lightmap.model.samples }, (_, i) => i % 7));
  const { width, height } = lightmap.model, light = new Float32Array(4 * width * height);
  renderer.readRenderTargetPixels(lightmap.target, 0, 0, width, height, light);
  told = { light: text(light), channel: lightmap.texture.channel };
"""


@pytest.mark.slow
@needs_three
@pytest.mark.parametrize("case", CASES)
def test_three_composes_the_lightmap(case: str, made: Made, tmp_path: Path) -> None:
    model, folder = made(case)
    told = told_by_three(COMPOSED, folder / "three", tmp_path)
    light = np.frombuffer(base64.b64decode(told["light"]), np.float32).reshape(*SHAPE, 4)[..., :3]
    packed = Packed.read(folder)
    expected = packed.light(packed.rows(*packed.frame(averaged(model))), np.argwhere(np.ones(SHAPE))).reshape(*SHAPE, 3)
    close(light, expected, 1e-5)
    assert told["channel"] == 1


@pytest.mark.skipif(importlib.util.find_spec("gdtoolkit") is None, reason="needs gdtoolkit")
def test_the_script_of_godot_parses(made: Made) -> None:
    from gdtoolkit.parser import parser  # type: ignore[import-not-found]

    assert parser.parse((made("plain")[1] / "godot/ddprt_lightmap.gd").read_text())
