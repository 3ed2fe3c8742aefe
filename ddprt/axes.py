"""Axis words and array aliases: shapes are part of every signature.

Words: lightings, texels, points, bases, rgb, samples, rays, vertices, triangles, height, width, columns, rows, frames.
`rgb` is linear Rec.709. `F32` and friends are NumPy arrays of the rooms up to the dataset; JAX arrays come after it.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

Array = np.ndarray

Points3 = Float[np.ndarray, "n 3"]
"""Positions in metres or unit vectors, one row each."""

Rgb = Float[np.ndarray, "n 3"]
"""One colour per row."""

Maps = Float[np.ndarray, "lightings texels 3"]
"""A lightmap over covered texels per lighting, W/m²."""

__all__ = ["Array", "Bool", "Float", "Float32", "Float64", "Int", "Int32", "Int64", "Maps", "Points3", "Rgb"]
