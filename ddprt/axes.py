"""Axis words and array aliases: shapes are part of every signature.

Words: lightings, texels, points, bases, rgb, samples, rays, vertices, triangles, height, width, columns, rows, frames.
`rgb` is linear Rec.709. `F32` and friends are NumPy arrays of the rooms up to the dataset; JAX arrays come after it.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

Rgb = Float[np.ndarray, "n 3"]
"""One colour per row."""

__all__ = ["Bool", "Float", "Float32", "Float64", "Int", "Int32", "Int64", "Rgb"]
