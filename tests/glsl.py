"""Runs the text of a fragment shader on arrays: as much of GLSL as `ddprt.export.glsl` writes, for all texels at once."""

import re

import numpy as np


class Vec:
    """Components last: (texels, n), or (n) for what is the same everywhere."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = np.asarray(values, np.float64)

    def __add__(self, other: "Vec | float") -> "Vec":
        return Vec(self.values + of(other))

    def __mul__(self, other: "Vec | float") -> "Vec":
        return Vec(self.values * of(other))

    __radd__, __rmul__ = __add__, __mul__

    def __getattr__(self, names: str) -> "Vec":
        if not re.fullmatch("[rgba]{1,4}", names):
            raise AttributeError(names)
        return Vec(self.values[..., ["rgba".index(name) for name in names]])

    def set(self, name: str, value: "Vec") -> None:
        self.values[..., "rgba".index(name)] = value.values[..., 0]


class Mat:
    """Sixteen numbers, or four vectors: column by column."""

    def __init__(self, *parts: "Vec | float") -> None:
        self.values = np.concatenate([np.ravel(of(part)) for part in parts]).reshape(4, 4)

    def __mul__(self, vector: Vec) -> Vec:
        return Vec(vector.values @ self.values)


def of(value: "Vec | float") -> np.ndarray:
    return value.values if isinstance(value, Vec) else np.asarray(value, np.float64)


def vec(*parts: "Vec | float") -> Vec:
    return Vec(np.concatenate([np.atleast_1d(of(part)) for part in np.broadcast_arrays(*map(of, parts))], -1))


def run(source: str, layers: np.ndarray, rows: np.ndarray, constant: np.ndarray | None = None) -> np.ndarray:
    """What the shader makes of each texel, (texels, 3).

    Args:
      source: the shader.
      layers: (layers, texels, 4), as an array texture holds them.
      rows: (rows, 4) of the frame; as many as the shader declares.
      constant: (texels, 3).
    """
    assert int(re.search(r"vec4 row\[(\d+)\]", source)[1]) == len(rows)
    texels = layers.shape[1]
    wide = lambda size, parts: Vec(np.stack([np.broadcast_to(np.squeeze(of(p)), texels) for p in parts], -1) * np.ones(size))  # noqa: E731
    scope = {
        "layers": layers,
        "constant": constant,
        "lightmap": None,
        "row": [Vec(row) for row in rows],
        "mat4": Mat,
        "vec4": lambda *parts: Vec(np.array([float(part) for part in parts])) if len(parts) == 4 else _lit(parts),
        "vec3": lambda *parts: At(parts[1]) if parts[0] is None else wide(3, parts * (3 // len(parts))),
        "gated": lambda a: Vec(0.5 * a.values * (1 + a.values / (1 + np.abs(a.values)))),
        "dot": lambda a, b: Vec((a.values * b.values).sum(-1, keepdims=True)),
        "max": lambda a, b: Vec(np.maximum(a.values, b)),
        "pow": lambda a, b: Vec(a.values**b.values),
        "texture": lambda image, at: Vec(image[at.layer] if isinstance(at, At) else image),
        "Vec": Vec,
    }
    body = source.split("void main() {\n")[1].rsplit("}", 1)[0]
    for line in body.splitlines():
        statement = re.sub(r"^(vec3|vec4) ", "", line.strip().removesuffix(";"))
        part = re.fullmatch(r"y\.([rgb]) \+= (.*)", statement)
        exec(f"y.set('{part[1]}', y.{part[1]} + ({part[2]}))" if part else statement, scope)
    return scope["light"].values


class At:
    """A layer of an array texture."""

    def __init__(self, layer: "Vec | float") -> None:
        self.layer = int(np.ravel(of(layer))[0])


def _lit(parts: "tuple[Vec, float]") -> Vec:
    assert parts[1] == 1.0, "alpha"
    return parts[0]
