"""model.bin: all that a linear model is at run time, in one little-endian file that a dozen lines read in any language.

The layout is told in docs/engines.md and read by `c/ddprt_runtime.h` and the loaders beside it; this is its twin in NumPy, with
which the golden numbers are made.
"""

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int
from ddprt.errors import UserError
from ddprt.files import read_tensors
from ddprt.scene.exr import read_exr

FORMAT = "raw"
"""The entry of `export.formats` that is packed."""
MAGIC = b"ddprt001"
_HEAD = struct.Struct("<8s8I2f")
CONSTANT, EXITANT, RADIOSITY = 1, 2, 4
MOST_LAYERS = 256
"""Of an array texture, the least that all engines promise."""


@dataclass(frozen=True, eq=False)
class Packed:
    """A model as engines load it; the order of the fields is that of the file.

    Attributes:
      maps: how many.
      points: values that measured light has.
      gamma: 1 in linear space.
      depth: of `Samples`, metres.
      radiosity: whether samples count times albedo.
      position, normal, albedo: of the samples.
      offset, matrix, intercept: the transfer of the format, see `ddprt.export.refit`.
      home: the point of each sample.
      layers: half floats, row 0 at the top.
      constant: light that no lamp changes, W/m².
      exitant: 1 where texels hold all that leaves.
    """

    maps: int
    points: int
    gamma: float
    depth: float
    radiosity: bool
    position: Float32[np.ndarray, "samples 3"]
    normal: Float32[np.ndarray, "samples 3"]
    albedo: Float32[np.ndarray, "samples 3"]
    offset: Float32[np.ndarray, "groups inputs"]
    matrix: Float32[np.ndarray, "groups weights inputs"]
    intercept: Float32[np.ndarray, "groups weights"]
    home: Int[np.ndarray, " samples"]
    layers: Float[np.ndarray, "layers height width 4"]
    constant: Float32[np.ndarray, "height width 3"] | None = None
    exitant: Float32[np.ndarray, "height width"] | None = None

    @classmethod
    def read(cls, folder: Path) -> "Packed":
        """What an export folder holds.

        Raises:
          UserError: the lightmap has more layers than an array texture is sure to hold.
        """
        manifest, points = (json.loads((folder / name).read_text("utf-8")) for name in ("manifest.json", "points.json"))
        told = manifest["formats"][FORMAT]
        if told["layers"] > MOST_LAYERS:
            raise UserError(
                f"export.engines: got {told['layers']} layers of textures, expected at most {MOST_LAYERS}, which is what array "
                "textures are sure to hold; lower fit.bases"
            )
        shape = told["layers"], manifest["height"], manifest["width"], 4
        extra: dict[str, Any] = {
            name: read_exr(folder / file)[0] for name in ("constant", "exitant") if (file := manifest.get(name))
        }
        return cls(
            told["maps"],
            manifest["points"],
            manifest["gamma"] if manifest["space"] == "gamma" else 1.0,
            float(manifest["depth"]),
            manifest["quantity"] == "radiosity",
            **{name: np.array(points[name], np.float32).reshape(-1, 3) for name in ("position", "normal", "albedo")},
            **read_tensors(folder / told["transfer"]),
            home=np.array(points["home"]),
            layers=np.frombuffer((folder / told["files"][0]).read_bytes(), "<f2").reshape(shape),
            constant=extra.get("constant"),
            exitant=extra["exitant"][..., 0] if "exitant" in extra else None,
        )

    @property
    def mono(self) -> bool:
        """Whether each colour channel has a transfer of its own, and maps lie in the four channels of a layer."""
        return len(self.matrix) == 3

    def to_bytes(self) -> bytes:
        """The file."""
        flags = CONSTANT * (self.constant is not None) | EXITANT * (self.exitant is not None) | RADIOSITY * self.radiosity
        count, height, width, _ = self.layers.shape
        sizes = width, height, count, self.maps, len(self.matrix), self.points, len(self.home), flags
        named = "position", "normal", "albedo", "offset", "matrix", "intercept"
        parts: list[tuple[str, Any]] = [("<f4", getattr(self, name)) for name in named]
        parts += [("<u4", self.home), ("<f2", self.layers)]
        parts += [] if self.constant is None else [("<f4", self.constant)]
        parts += [] if self.exitant is None else [("<u1", self.exitant)]
        body = b"".join(np.ascontiguousarray(part, kind).tobytes() for kind, part in parts)
        whole = _HEAD.pack(MAGIC, *sizes, self.gamma, self.depth) + body
        return whole + struct.pack("<I", zlib.crc32(whole))

    def frame(self, values: Float[np.ndarray, "points 3"]) -> tuple[Float64[np.ndarray, "3 weights"], Float64[np.ndarray, "3"]]:
        """u of each colour, the last one counting a texture of ones, and s."""
        x = np.asarray(values, np.float64)
        s = np.linalg.norm(x, axis=0 if self.mono else None) * np.ones(3)
        z = x / np.where(s > 0, s, 1)
        z = np.sign(z) * np.abs(z) ** (1 / self.gamma)
        told = (z.T if self.mono else z.reshape(1, -1)) - self.offset
        return (np.einsum("gkp,gp->gk", self.matrix, told) + self.intercept) * np.ones((3, 1)), s

    def rows(self, u: Float64[np.ndarray, "3 weights"], s: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "rows 4"]:
        """What shaders read of a frame: three rows of weights for each layer, then the last u, then s."""
        count = len(self.layers)
        weights = np.zeros((count, 3, 4))
        for k in range(self.maps):
            for colour in range(3):
                weights[(k // 4, colour, k % 4) if self.mono else (k, colour, colour)] = u[colour, k]
        last = np.pad(np.stack([u[:, self.maps], s]), ((0, 0), (0, 1)))
        return np.concatenate([weights.reshape(-1, 4), last]).astype(np.float32)

    def light(self, rows: Float[np.ndarray, "rows 4"], texels: Int[np.ndarray, "texels 2"]) -> Float64[np.ndarray, "texels 3"]:
        """At rows and columns of texels, as a shader makes it, W/m²."""
        row, column = texels.T
        weights = rows[:-2].reshape(-1, 3, 4).astype(np.float64)
        y = np.einsum("ltk,lck->tc", self.layers[:, row, column].astype(np.float64), weights) + rows[-2, :3]
        glow = 0 if self.constant is None else self.constant[row, column]
        return rows[-1, :3] * np.maximum(y, 0) ** self.gamma + glow
