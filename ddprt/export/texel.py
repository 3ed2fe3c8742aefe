"""What a shader does at a texel, as numbers in the order that it reads them.

A frame reaches the shader as one buffer of rows of four floats: `row[16]` holds what map 16 counts in red, green and blue. Maps
come as taps, four numbers at once: four maps of one channel in RGBA, or one map in RGB. Weights of hidden units are cut to
4 x 4 blocks accordingly, so that a layer is a sum of matrix times tap.
"""

from dataclasses import dataclass

import numpy as np

from ddprt.axes import Float
from ddprt.runtime.deployment import Deployment, Layers, Units

LANES = 4
MOST_ROWS = 1024
"""Of a frame: 16 KiB, the least that WebGL2 and OpenGL ES 3.0 promise for a uniform block."""
MOST_LAYERS = 256
"""Of an array texture, likewise."""


@dataclass(frozen=True, eq=False)
class Texel:
    """See the module.

    Attributes:
      shape: of the `Deployment`.
      maps: how many.
      rgb: whether each has colours of its own.
      mean: whether one more layer counts 1 always.
      constant: whether light is added that no lamp changes, W/m².
      gamma: of the encoding; 1 in linear space.
      layers: of hidden units in blocks: weights (blocks, taps, 4, 4), biases (blocks, 4); without the first one where it is
        part of the frame.
      head: (blocks, 4, 3): what each unit adds to a colour, where no frame changes that.
      rows: name of each part of the frame, its first row and their number.
    """

    shape: str
    maps: int
    rgb: bool
    mean: bool
    constant: bool
    gamma: float
    layers: Layers
    head: np.ndarray | None
    rows: dict[str, tuple[int, int]]

    @property
    def taps(self) -> int:
        """Layers that hold maps."""
        return self.maps if self.rgb else -(-self.maps // LANES)

    @property
    def reads(self) -> int:
        """Reads of all textures; a table is read once for each colour."""
        return (3 if self.shape == "table" else self.taps) + self.mean + self.constant

    @property
    def size(self) -> int:
        """Rows of a frame."""
        return sum(count for _, count in self.rows.values())

    @property
    def why_not(self) -> str:
        """Why there is no shader, in words; empty where there is one."""
        if self.taps + self.mean > MOST_LAYERS:
            return f"{self.taps + self.mean} textures, and an array texture is only sure to hold {MOST_LAYERS}"
        if self.size > MOST_ROWS:
            return f"a frame of {self.size} rows, and a uniform block is only sure to hold {MOST_ROWS}"
        return "" if self.maps else "there are no maps"


def texel_of(
    found: Deployment, scale: Float[np.ndarray, " maps"], *, gamma: float, constant: bool
) -> tuple[Texel, dict[str, np.ndarray]]:
    """The texel's part of a deployment, and what the frame's part needs for it.

    Args:
      found: the deployment.
      scale: what textures were divided by.
      gamma: of the encoding; 1 in linear space.
      constant: whether there is light that no lamp changes.
    """
    layers: Layers = ()
    head, tensors = None, dict[str, np.ndarray]()
    parts = {"best": 1} if found.shape == "table" else {"u": len(found.maps)}
    if found.units is not None:
        layers, head, tensors, more = _units(found.units, scale, found.rgb)
        parts |= more
    parts["s"] = 1
    first = np.cumsum([0, *parts.values()]).tolist()
    rows = {name: (start, count) for start, (name, count) in zip(first, parts.items(), strict=False)}
    plain = found.shape, len(found.maps), found.rgb, found.mean is not None, constant, gamma
    return Texel(*plain, layers, head, rows), tensors


def _units(
    units: Units, scale: np.ndarray, rgb: bool
) -> tuple[Layers, np.ndarray | None, dict[str, np.ndarray], dict[str, int]]:
    """Layers and head of the shader, tensors of the frame, and rows of the frame."""
    each = np.tile(scale.astype(np.float64), 3 if rgb else 1)[:, None]
    (weight, bias), *rest = units.layers
    further = tuple((_outputs(_inputs(w, False)), _outputs(b)) for w, b in rest)
    first = _outputs(_inputs(weight * each, rgb)), _outputs(bias)
    tensors = {"first": _rows(*first)}
    for number, (weights, biases) in enumerate(further, 1):
        tensors |= {f"layer_{number}": _rows(weights, biases)}
    if not units.turned:
        counts = np.einsum("gki,kho->oghi", units.coefficients, units.head)
        counts = counts[:, 0] if rgb else counts[0]  # colours, units, features
        counts = np.pad(counts, ((0, 0), (0, -counts.shape[1] % LANES), (0, 0)))
        return (first, *further), None, {**tensors, "counts": counts}, {"counts": counts.shape[1]}
    turn = np.stack([_rows(_outputs(_inputs(one[:-1] * each, rgb)), _outputs(one[-1])) for one in units.turn])
    head = _outputs(np.broadcast_to(units.head[0].T, (3, units.head.shape[1]))).swapaxes(1, 2)
    tensors |= {"coefficients": units.coefficients, "turn": turn, "head": head.reshape(-1, 3)}
    return further, head, tensors, {"first": len(units.coefficients) * len(_rows(*first))}


def _inputs(weight: Float[np.ndarray, "_ _"], rgb: bool) -> Float[np.ndarray, "taps 4 _"]:
    """Rows of a layer as taps hold their inputs, with zeros for what a tap has too many."""
    if rgb:  # colours one after the other, each with all maps
        return np.pad(weight.reshape(3, -1, weight.shape[1]).swapaxes(0, 1), ((0, 0), (0, 1), (0, 0)))
    return np.pad(weight, ((0, -len(weight) % LANES), (0, 0))).reshape(-1, LANES, weight.shape[1])


def _outputs(values: np.ndarray) -> np.ndarray:
    """The last axis in fours, which come first: (..., units) to (blocks, ..., 4), filled up with units that stay 0."""
    wide = np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, -values.shape[-1] % LANES)])
    return np.moveaxis(wide.reshape(*values.shape[:-1], -1, LANES), -2, 0)


def _rows(weights: Float[np.ndarray, "blocks taps 4 4"], biases: Float[np.ndarray, "blocks 4"]) -> Float[np.ndarray, "_ 4"]:
    """As a frame holds them: of each block of units its matrices, column by column, and its biases."""
    columns = weights.reshape(len(weights), -1, LANES)
    return np.concatenate([columns, biases[:, None]], 1).reshape(-1, LANES)
