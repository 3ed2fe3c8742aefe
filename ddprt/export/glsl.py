"""Fragment shaders that turn the textures of an export into light: GLSL ES 3.00, one for each model.

Straight lines with numbers written out: nothing is indexed by a variable, so that all of it stays in registers. What a frame
changes comes as one uniform block.
"""

from collections.abc import Sequence

import numpy as np

from ddprt.export.texel import LANES, Texel

_HEAD = """#version 300 es
// Indirect irradiance at a point of the lightmap, W/m², before albedo. Written by ddprt {version}, shape "{shape}".
// layers: every file of "layers" in manifest.json, in order{mean}; linear filter, clamped to the edge, row 0 first.
// row: a frame, made of measurements or lights as docs/deployment.md says; rows: {rows}.
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray layers;
{constant}layout(std140) uniform Frame {{
  vec4 row[{size}];
}};
in vec2 lightmap;
out vec4 light;
"""
_GATED = """
vec4 gated(vec4 a) {
  return 0.5 * a * (1.0 + a / (1.0 + abs(a)));
}
"""
_LETTERS = "rgba"


def shader(texel: Texel, version: str) -> str:
    """Source of the fragment shader.

    Args:
      texel: what it does.
      version: of ddprt.
    """
    rows = ", ".join(f"{name} {first} to {first + count - 1}" for name, (first, count) in texel.rows.items())
    head = _HEAD.format(
        version=version,
        shape=texel.shape,
        mean=", then the mean" if texel.mean else "",
        constant="uniform highp sampler2D constant;\n" if texel.constant else "",
        rows=rows,
        size=texel.size,
    )
    lines = [*_BODIES[texel.shape](texel)]
    if texel.mean:
        lines.append(f"y += {_tap(texel.taps)}.{'rgb' if texel.rgb else 'rrr'};")
    lines.append("y = max(y, 0.0);")
    if texel.gamma != 1:
        lines.append(f"y = pow(y, vec3({_number(texel.gamma)}));")
    glow = " + texture(constant, lightmap).rgb" if texel.constant else ""
    lines.append(f"light = vec4(row[{texel.rows['s'][0]}].rgb * y{glow}, 1.0);")
    gated = _GATED if texel.shape == "decode" else ""
    return head + gated + "\nvoid main() {\n" + "".join(f"  {line}\n" for line in lines) + "}\n"


def _compose(texel: Texel) -> list[str]:
    lines = [f"vec4 t{tap} = {_tap(tap)};" for tap in range(texel.taps)]
    lines.append("vec3 y = vec3(0.0);")
    for k in range(texel.maps):
        held = f"t{k}.rgb" if texel.rgb else f"t{k // LANES}.{_LETTERS[k % LANES]}"
        lines.append(f"y += row[{texel.rows['u'][0] + k}].rgb * {held};")
    return lines


def _decode(texel: Texel) -> list[str]:
    lines, taps = _compose(texel), [f"t{tap}" for tap in range(texel.taps)]
    if texel.head is None:
        first, count = texel.rows["counts"]
        units = _dense(lines, texel, "h", taps, range(len(texel.layers)))
        for j in range(count):
            lines.append(f"y += row[{first + j}].rgb * {units[j // LANES]}.{_LETTERS[j % LANES]};")
        return lines
    first, count = texel.rows["first"]
    groups = 1 if texel.rgb else 3
    each = LANES * texel.taps + 1  # rows of a block
    blocks = count // groups // each
    for group in range(groups):
        name = "h" if groups == 1 else f"h{_LETTERS[group]}"
        units = []
        for block in range(blocks):
            start = first + (group * blocks + block) * each
            sums = [
                f"mat4({', '.join(f'row[{start + LANES * t + c}]' for c in range(LANES))}) * t{t}" for t in range(texel.taps)
            ]
            units.append(f"{name}0_{block}")
            lines.append(f"vec4 {units[-1]} = gated(row[{start + each - 1}] + {' + '.join(sums)});")
        units = _dense(lines, texel, name, units, range(1, len(texel.layers) + 1))
        for block, unit in enumerate(units):
            for colour in range(3) if groups == 1 else (group,):
                lines.append(f"y.{_LETTERS[colour]} += dot({unit}, {_vector(texel.head[block][:, colour])});")
    return lines


def _dense(lines: list[str], texel: Texel, name: str, taps: list[str], numbers: Sequence[int]) -> list[str]:
    """Adds the lines of dense layers, and gives the names of the last one's units, four in each."""
    for number, (weights, biases) in zip(numbers, texel.layers, strict=True):
        units = [f"{name}{number}_{block}" for block in range(len(weights))]
        for unit, blocks, bias in zip(units, weights, biases, strict=True):
            sums = [f"mat4({', '.join(map(_number, one.ravel()))}) * {tap}" for one, tap in zip(blocks, taps, strict=True)]
            lines.append(f"vec4 {unit} = gated({_vector(bias)} + {' + '.join(sums)});")
        taps = units
    return taps


def _table(texel: Texel) -> list[str]:
    row = texel.rows["best"][0]
    reads = (f"texture(layers, vec3(lightmap, row[{row}].{letter})).{letter}" for letter in _LETTERS[:3])
    return [f"vec3 y = vec3({', '.join(reads)});"]


_BODIES = {"compose": _compose, "decode": _decode, "table": _table}


def _tap(layer: int) -> str:
    return f"texture(layers, vec3(lightmap, {layer}.0))"


def _vector(values: np.ndarray) -> str:
    return f"vec4({', '.join(map(_number, values))})"


def _number(value: float) -> str:
    """The shortest digits that give the same float32."""
    return np.format_float_scientific(np.float32(value), trim="0", exp_digits=1) if value else "0.0"
