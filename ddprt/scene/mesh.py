"""What stays still: triangles with materials.

Metres, right-handed, Y up. A triangle's front is where its corners run counter-clockwise; back faces block and absorb.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddprt.axes import Float, Float64, Int, Int32


@dataclass(frozen=True)
class Material:
    """A diffuse surface.

    Attributes:
      name: for messages.
      albedo: linear Rec.709 reflectance, each 0 to 1.
      texture: (height, width, 3) linear factor on the albedo, row 0 at the top, or None.
    """

    name: str
    albedo: tuple[float, float, float]
    texture: np.ndarray | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True, eq=False)
class Scene:
    """A checked triangle mesh; make one with `ddprt.load_scene`.

    Attributes:
      name: library name or file stem.
      positions: metres.
      triangles: corner indices, counter-clockwise seen from the front.
      normals: unit shading normals per vertex (exported; transport uses the geometric ones).
      material: index into `materials` per triangle.
      materials: at least one.
      uv: texture coordinates per vertex, origin top-left, or None where no material has a texture.
      notes: what the checks repaired, one line each.
    """

    name: str
    positions: Float64[np.ndarray, "vertices 3"]
    triangles: Int32[np.ndarray, "triangles 3"]
    normals: Float64[np.ndarray, "vertices 3"]
    material: Int32[np.ndarray, " triangles"]
    materials: tuple[Material, ...]
    uv: Float64[np.ndarray, "vertices 2"] | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def corners(self) -> Float64[np.ndarray, "triangles 3 3"]:
        """Corner positions, metres."""
        return self.positions[self.triangles]

    @cached_property
    def _cross(self) -> Float64[np.ndarray, "triangles 3"]:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> Float64[np.ndarray, " triangles"]:
        """World areas, m²."""
        return 0.5 * np.linalg.norm(self._cross, axis=1)

    @cached_property
    def geometric_normals(self) -> Float64[np.ndarray, "triangles 3"]:
        """Unit normals of the triangles' fronts."""
        return self._cross / (2 * self.areas[:, None])

    @cached_property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Lowest and highest corner of the bounding box, metres."""
        return np.stack([self.corners.min((0, 1)), self.corners.max((0, 1))])

    @property
    def centre(self) -> Float64[np.ndarray, "3"]:
        """Middle of the bounding box, metres."""
        return self.bounds.mean(0)

    @property
    def radius(self) -> float:
        """Half the bounding box's diagonal, metres."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]) / 2)

    @cached_property
    def digest(self) -> str:
        """Hash of geometry and materials: equal digests bake equal light."""
        state = hashlib.sha256()
        arrays = [self.positions, self.triangles, self.normals, self.material, self.uv]
        for array in [*arrays, *(material.texture for material in self.materials)]:
            if array is not None:
                state.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        state.update(repr([material.albedo for material in self.materials]).encode())
        return state.hexdigest()[:16]

    def albedo_at(self, triangle: Int[np.ndarray, " n"], barycentric: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Linear albedo at points given by triangle and weights of its three corners."""
        material = self.material[triangle]
        albedo = np.array([entry.albedo for entry in self.materials])[material]
        if self.uv is None:
            return albedo
        uv = np.einsum("nc,ncd->nd", barycentric, self.uv[self.triangles[triangle]])
        for index, entry in enumerate(self.materials):
            if entry.texture is not None:
                chosen = material == index
                albedo[chosen] *= _bilinear(entry.texture, uv[chosen])
        return albedo


def _bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Repeating bilinear lookup, texel centres at half-integers."""
    height, width = image.shape[:2]
    position = uv * [width, height] - 0.5
    corner = np.floor(position).astype(int)
    fx, fy = (position - corner).T[..., None]
    x0, y0 = corner[:, 0] % width, corner[:, 1] % height
    x1, y1 = (x0 + 1) % width, (y0 + 1) % height
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    return top * (1 - fy) + bottom * fy
