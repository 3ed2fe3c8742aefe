"""What stays still: triangles with materials.

Metres, right-handed, Y up. A triangle's front is where its corners run counter-clockwise; back faces block and absorb.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int, Int32
from ddprt.scene.fog import Fog
from ddprt.scene.material import Material, bilinear
from ddprt.scene.viewpoint import Viewpoint

SIDES = 3
"""Of the prisms that strands are made of."""


@dataclass(frozen=True, eq=False)
class Tubes:
    """Strands of a scene, whose last triangles they are: strand by strand, piece by piece, two for each side.

    Attributes:
      axis: points at equal arc lengths, metres, world space.
      radius: of the fibre there, metres.
      colour: of each strand; see `ddprt.scene.strands.Strands`.
    """

    axis: Float64[np.ndarray, "strands rings 3"]
    radius: Float64[np.ndarray, "strands rings"]
    colour: Float32[np.ndarray, "strands 3"]

    @property
    def pieces(self) -> int:
        """Of a strand."""
        return self.axis.shape[1] - 1

    @property
    def triangles(self) -> int:
        """Of all strands."""
        return len(self.axis) * self.pieces * 2 * SIDES


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
      whole: the scene that this one is, when a user has left effects out of it; see `ddprt.transport.effects.force`.
      forced: effects that a user wants simulated whatever the materials say.
      refused: effects that a user wants left out likewise.
      tubes: strands, of which the last triangles are; None where there are none.
      colour: linear factor on the albedo per vertex, 0 to 1, or None where it is 1 everywhere.
      lightmap: where the file would have each vertex on a lightmap, unchecked; see `ddprt.scene.own_charts`.
      fog: what fills the bounding box; None for clear air.
      viewpoint: from where its maker would have it seen; None where nobody says. No light depends on it.
      rest: the pose of an animation that this one's lightmap is unwrapped on; None where nothing moves.
    """

    name: str
    positions: Float64[np.ndarray, "vertices 3"]
    triangles: Int32[np.ndarray, "triangles 3"]
    normals: Float64[np.ndarray, "vertices 3"]
    material: Int32[np.ndarray, " triangles"]
    materials: tuple[Material, ...]
    uv: Float64[np.ndarray, "vertices 2"] | None = None
    notes: tuple[str, ...] = ()
    whole: "Scene | None" = None
    forced: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    tubes: Tubes | None = None
    colour: Float64[np.ndarray, "vertices 3"] | None = None
    lightmap: Float64[np.ndarray, "vertices 2"] | None = None
    fog: Fog | None = None
    rest: "Scene | None" = None
    viewpoint: Viewpoint | None = None

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
        """Hash of geometry, materials and fog: equal digests bake equal light."""
        state = hashlib.sha256()
        arrays = [self.positions, self.triangles, self.normals, self.material, self.uv]
        for array in [*arrays, *(material.texture for material in self.materials)]:
            if array is not None:
                state.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        for name, rows in (("colour", self.colour), ("lightmap", self.lightmap)):
            if rows is not None:
                state.update(f"{name} {rows.shape}".encode() + np.ascontiguousarray(rows).tobytes())
        state.update(repr([material.albedo for material in self.materials]).encode())
        for index, material in enumerate(self.materials):
            for part in (material.cutout, material.emission, material.gloss, material.subsurface, material.fibre):
                if part is not None:
                    state.update(f"{index} {part}".encode())
            for name, image in material.textures.items():
                if name != "albedo":
                    state.update(f"{index} {name} {image.shape}".encode() + np.ascontiguousarray(image).tobytes())
        state.update(repr(self.forced).encode() if self.forced else b"")
        if self.tubes is not None:
            state.update(f"{self.tubes.axis.shape}".encode() + self.tubes.radius.tobytes() + self.tubes.colour.tobytes())
        state.update(f"{self.fog}".encode() if self.fog else b"")
        state.update(b"" if self.rest is None else f"rest {self.rest.digest}".encode())
        return state.hexdigest()[:16]

    @cached_property
    def used_materials(self) -> tuple[Material, ...]:
        """Those that some triangle has."""
        return tuple(self.materials[index] for index in np.unique(self.material))

    @property
    def strand_material(self) -> Material | None:
        """What its strands are made of; None where there are none."""
        return None if self.tubes is None else self.materials[self.material[-1]]

    def made_of(self, change: Callable[[Material], Material]) -> "Scene":
        """The same shape of other materials."""
        materials = tuple(map(change, self.materials))
        same = all(new is old for new, old in zip(materials, self.materials, strict=True))
        return self if same else replace(self, materials=materials)

    def albedo_at(self, triangle: Int[np.ndarray, " n"], barycentric: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Linear albedo at points given by triangle and weights of its three corners."""
        material = self.material[triangle]
        albedo = np.array([entry.albedo for entry in self.materials])[material]
        if self.colour is not None:
            albedo *= np.einsum("nc,ncd->nd", barycentric, self.colour[self.triangles[triangle]])
        if self.uv is None:
            return albedo
        uv = self.uv_at(triangle, barycentric)
        for index, entry in enumerate(self.materials):
            if entry.texture is not None:
                chosen = material == index
                albedo[chosen] *= bilinear(entry.texture, uv[chosen])
        return albedo

    def uv_at(self, triangle: Int[np.ndarray, " n"], barycentric: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Texture coordinates at such points; the scene must have some."""
        assert self.uv is not None
        return np.einsum("nc,ncd->nd", barycentric, self.uv[self.triangles[triangle]])
