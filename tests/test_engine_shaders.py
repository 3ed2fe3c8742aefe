"""Shaders of engines: the text of each function run on arrays, what compiles, and what a browser makes of it."""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_up_rivals import SHAPE
from test_engines import CASES, close
from test_engines import made as made

from ddprt.export.browser import browser, drawn
from ddprt.export.engines.listing import ENGINES
from ddprt.export.engines.packed import Packed
from ddprt.export.engines.shader import GDSHADER, GLSL, UNITY, UNREAL, Words, light
from ddprt.export.golden import example_values
from ddprt.runtime.model import Model

LANGUAGES = {"glsl": GLSL, "gdshader": GDSHADER, "unity": UNITY, "unreal": UNREAL}
SHADERS = {
    "glsl": "three/compose.frag",
    "gdshader": "godot/ddprt.gdshader",
    "unity": "unity/Ddprt.hlsl",
    "unreal": "unreal/Ddprt.ush",
}
VALIDATOR, CROSS = map(shutil.which, ("glslangValidator", "spirv-cross"))
Made = Callable[[str], tuple[Model, Path]]


def frame(made: Made, case: str) -> SimpleNamespace:
    """A model's folder, a frame of it, and the light of all texels."""
    model, folder = made(case)
    packed = Packed.read(folder)
    rows = packed.rows(*packed.frame(example_values(model)))
    expected = packed.light(rows, np.argwhere(np.ones(SHAPE))).reshape(*SHAPE, 3)
    return SimpleNamespace(model=model, folder=folder, packed=packed, rows=rows, expected=expected)


def run(source: str, words: Words, packed: Packed, rows: np.ndarray) -> np.ndarray:
    """The function of a language on all texels at once."""
    body = source[source.index(words.function.split("(")[0]) :].split("{\n", 1)[1].split("\n}\n", 1)[0]
    for name, call in (("layer", words.layer), ("row", words.row), ("glow", words.constant)):
        body = re.sub(
            re.escape(call).replace(re.escape("{number}"), r"(\d+)"), rf"{name}(\1)" if "{" in call else "glow()", body
        )
    stack = lambda *parts: np.stack([np.broadcast_to(part, SHAPE) for part in parts], -1)  # noqa: E731
    scope: dict[str, Any] = {
        "layer": lambda number: packed.layers[number].astype(np.float64),
        "row": lambda number: SimpleNamespace(vec=rows[number].astype(np.float64), rgb=rows[number, :3].astype(np.float64)),
        "glow": lambda: packed.constant,
        words.vec3: stack,
        "dot": lambda a, b: a @ b.vec,
        "max": np.maximum,
        "pow": np.power,
    }
    for line in body.splitlines():
        statement = line.strip().removesuffix(";").removeprefix(words.vec3 + " ").replace("return ", "found = ")
        if statement != f"{words.vec4} t":
            exec(statement.replace("y += ", "y = y + "), scope)
    return scope["found"]


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("case", CASES)
def test_every_language_computes_the_same_light(case: str, language: str, made: Made) -> None:
    one = frame(made, case)
    source = (one.folder / SHADERS[language]).read_text()
    found = run(source, LANGUAGES[language], one.packed, one.rows)
    close(found, one.expected, 1e-12)
    assert "@" not in source
    assert light(LANGUAGES[language], one.packed) in source
    count = len(one.rows)
    assert re.search(rf"\b{count}\b", source) or language == "glsl"


def test_no_shader_is_forgotten() -> None:
    printed = {name: words for engine in ENGINES.values() for name, words in engine.shaders.items()}
    assert printed == {SHADERS[name]: words for name, words in LANGUAGES.items()}


def compiled(folder: Path, language: str, stage: str, source: str, *flags: str) -> None:
    path = folder / f"{language}.{stage}"
    path.write_text(source)
    done = subprocess.run([str(VALIDATOR), *flags, "-S", stage, str(path)], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def pixel(folder: Path, glows: bool) -> dict[str, str]:
    """A fragment shader of each language around its function."""
    texts = {name: (folder / path).read_text() for name, path in SHADERS.items()}
    main = "float4 main(float2 at : TEXCOORD0) : SV_Target {{ return float4({}, 1.0); }}\n"
    glow = "Constant, ConstantSampler, " if glows else ""
    globals_ = (
        "Texture2DArray Layers; SamplerState LayersSampler; Texture2D Rows; Texture2D Constant; SamplerState ConstantSampler;\n"
    )
    leaving = "DdprtLeaving(float3(1.0, 1.0, 1.0), float3(0.0, 0.0, 0.0), DdprtLight(at), 0.0) / 0.3183098862"
    surface = re.sub(r" : [a-z_, ]+(?= = |;)", "", texts["gdshader"].replace("shader_type spatial;", ""))
    surface = re.sub(r"uniform vec4 albedo = .*;", "uniform vec4 albedo;", surface.replace("void fragment()", "void main()"))
    head = "#version 300 es\nprecision highp float; precision highp sampler2DArray; precision highp sampler2D;\n"
    head += "in vec2 UV, UV2; const float PI = 3.14159265; vec3 ALBEDO, EMISSION;\n"
    return {
        "glsl": texts["glsl"],
        "unity": texts["unity"] + main.format(leaving),
        "unreal": texts["unreal"] + globals_ + main.format(f"DdprtLight(Layers, LayersSampler, Rows, {glow}at)"),
        "gdshader": head + surface,
    }


@pytest.mark.skipif(VALIDATOR is None, reason="needs glslangValidator (glslang-tools)")
@pytest.mark.parametrize("case", ["plain", "colours that glow, in gamma"])
def test_shaders_compile(case: str, made: Made, tmp_path: Path) -> None:
    folder = made(case)[1]
    sources = pixel(folder, "glow" in case)
    for language, source in sources.items():
        compiled(tmp_path, language, "frag", source, *(("-D", "-e", "main", "-V") if language.startswith("un") else ()))
    unity = (folder / "unity/DdprtCompose.compute").read_text().replace("#pragma kernel Compose", "")
    unity = unity.replace('#include "Ddprt.hlsl"', (folder / SHADERS["unity"]).read_text())
    compiled(tmp_path, "unity", "comp", unity, "-D", "-e", "Compose", "-V")


@pytest.mark.slow
@pytest.mark.skipif(browser() is None, reason="needs chromium or google-chrome on the path")
@pytest.mark.parametrize("language", ["glsl", "gdshader"])
@pytest.mark.parametrize("case", CASES)
def test_a_browser_runs_glsl_and_what_is_like_it(case: str, language: str, made: Made, tmp_path: Path) -> None:
    one = frame(made, case)
    source = pixel(one.folder, "glow" in case)[language]
    if language == "gdshader":
        source = (
            source.split("void main()")[0]
            .replace("constant_light", "constant")
            .replace("UV2;", "UV2, lightmap; out vec4 light;")
        )
        source += "void main() { light = vec4(ddprt_light(lightmap), 1.0); }"
    found = drawn(source, one.packed.layers.astype(np.float32), one.rows, tmp_path, glow=one.packed.constant)
    close(found["light"], one.expected, 1e-5)


@pytest.mark.slow
@pytest.mark.skipif(
    browser() is None or CROSS is None or VALIDATOR is None, reason="needs a browser, glslang-tools and spirv-cross"
)
@pytest.mark.parametrize("language", ["unity", "unreal"])
@pytest.mark.parametrize("case", CASES)
def test_a_browser_runs_hlsl_as_it_was_compiled(case: str, language: str, made: Made, tmp_path: Path) -> None:
    """HLSL to SPIR-V to GLSL by tools of others, with names brought back to those that the page knows."""
    one = frame(made, case)
    compiled(
        tmp_path,
        language,
        "frag",
        pixel(one.folder, "glow" in case)[language],
        "-D",
        "-e",
        "main",
        "-V",
        "-o",
        str(tmp_path / "a.spv"),
    )
    done = subprocess.run([str(CROSS), str(tmp_path / "a.spv"), "--es", "--version", "300"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    source = re.sub(r"SPIRV_Cross_Combined_?(?:_Ddprt)?Layers\w*", "layers", done.stdout)
    source = re.sub(r"SPIRV_Cross_Combined_?(?:_Ddprt)?Constant\w*", "constant", source)
    source = re.sub(r"SPIRV_Cross_CombinedRows\w*", "rows", source)
    source = re.sub(r"layout\(.*?\) uniform .*? \{", "layout(std140) uniform Frame {", source.replace("\n{", " {"))
    given = re.search(r"\bin (?:highp |mediump )?vec2 (\w+);", source)[1]
    source = re.sub(rf"\b{given}\b", "lightmap", source)
    found = drawn(source, one.packed.layers.astype(np.float32), one.rows, tmp_path, glow=one.packed.constant)
    close(found["light"], one.expected, 1e-5)
