"""The light of a texel as a function in a shading language: one description, and the words of each language.

A frame is 3 * layers + 2 rows of four floats. Of layer l, rows 3 l, 3 l + 1 and 3 l + 2 are what its channels count in red,
green and blue; the row before the last is added, and the last is the brightness. Mono and multi channel differ in the rows
alone, and a mean lightmap is a map like the others.
"""

from dataclasses import dataclass
from typing import Any

from ddprt.export.engines.packed import Packed


@dataclass(frozen=True)
class Words:
    """A shading language, as far as the description needs it; {number} stands for a layer or a row.

    Attributes:
      vec3, vec4: types of three and four floats.
      layer: reads a layer of the textures at `uv`, filtered.
      row: reads a row of the frame.
      constant: reads the light that no lamp changes at `uv`, filtered.
      function: first line of the function, up to its opening brace.
    """

    vec3: str
    vec4: str
    layer: str
    row: str
    constant: str
    function: str


GLSL = Words(
    "vec3",
    "vec4",
    "texture(layers, vec3(uv, {number}.0))",
    "texelFetch(rows, ivec2({number}, 0), 0)",
    "texture(constant, uv).rgb",
    "vec3 ddprt_light(vec2 uv)",
)
GDSHADER = Words("vec3", "vec4", GLSL.layer, GLSL.row, "texture(constant_light, uv).rgb", GLSL.function)
UNITY = Words(
    "float3",
    "float4",
    "_DdprtLayers.SampleLevel(ddprt_linear_clamp_sampler, float3(uv, {number}.0), 0)",
    "_DdprtRow[{number}]",
    "_DdprtConstant.SampleLevel(ddprt_linear_clamp_sampler, uv, 0).rgb",
    "float3 DdprtLight(float2 uv)",
)
UNREAL = Words(
    "float3",
    "float4",
    "Layers.SampleLevel(LayersSampler, float3(uv, {number}.0), 0)",
    "Rows.Load(int3({number}, 0, 0))",
    "Constant.SampleLevel(ConstantSampler, uv, 0).rgb",
    "float3 DdprtLight(Texture2DArray Layers, SamplerState LayersSampler, Texture2D Rows, {constant}float2 uv)",
)


def row_count(packed: Packed) -> int:
    """Rows of a frame."""
    return 3 * len(packed.layers) + 2


def light(words: Words, packed: Packed) -> str:
    """The function for a model; its result is indirect irradiance in W/m², before albedo.

    Args:
      words: of the language.
      packed: the model, of which layers, gamma and whether something glows are looked at.
    """
    row = lambda number: words.row.format(number=number)  # noqa: E731
    count, last = len(packed.layers), row_count(packed) - 1
    glows = "Texture2D Constant, SamplerState ConstantSampler, " if packed.constant is not None else ""
    lines = [f"{words.vec3} y = {row(last - 1)}.rgb;", f"{words.vec4} t;"]
    for layer in range(count):
        lines.append(f"t = {words.layer.format(number=layer)};")
        lines.append(f"y += {words.vec3}({', '.join(f'dot(t, {row(3 * layer + colour)})' for colour in range(3))});")
    lines.append(f"y = max(y, {words.vec3}(0.0, 0.0, 0.0));")
    if packed.gamma != 1:
        lines.append(f"y = pow(y, {words.vec3}({', '.join([repr(packed.gamma)] * 3)}));")
    glow = f" + {words.constant}" if packed.constant is not None else ""
    lines.append(f"return {row(last)}.rgb * y{glow};")
    return words.function.format(constant=glows) + " {\n" + "".join(f"  {line}\n" for line in lines) + "}\n"


def filled(template: str, words: Words, packed: Packed) -> str:
    """A file of an engine: `@LIGHT@` becomes the function and `@ROWS@` the number of rows; lines that begin with `@GLOW@` stay
    where something glows, those with `@DARK@` where nothing does."""
    glows = packed.constant is not None
    kept = [line for line in template.splitlines() if not line.startswith("@DARK@" if glows else "@GLOW@")]
    text = "\n".join(line.removeprefix("@GLOW@").removeprefix("@DARK@") for line in kept) + "\n"
    values: dict[str, Any] = {"@LIGHT@\n": light(words, packed), "@ROWS@": str(row_count(packed))}
    for mark, value in values.items():
        text = text.replace(mark, value)
    return text
