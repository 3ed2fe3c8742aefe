"""Glowing triangle meshes as lights that move, and the choice of a point on many glowing triangles by their power.

A light's file is read, by the reader of scenes, when the light is made; of one that is read back, when it first shines.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ddprt import warp
from ddprt.axes import Float, Float64, Int
from ddprt.compiled import compiled
from ddprt.errors import UserError
from ddprt.files import sha256
from ddprt.lights.light import FARTHEST, Colour, Coordinate, Illumination, LightModel, Vector, brightened, columns, moved, place

Triangle = tuple[Vector, Vector, Vector]
_LAST = 1 - 2**-24  # the largest number below 1 in float32


def _turn(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if not any(quaternion):
        raise ValueError("got a quaternion of length 0, expected a turn; write [0, 0, 0, 1] for none")
    return quaternion


def _file_or_triangles(mesh: Any) -> str | tuple[Triangle, ...]:
    if isinstance(mesh, str):
        return mesh
    try:
        corners = np.array(mesh, np.float64)
    except (TypeError, ValueError):  # rows of unequal length, or no numbers
        corners = np.zeros(0)
    if corners.shape[1:] != (3, 3) or not (np.abs(corners) <= FARTHEST).all():
        example = "[[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]"
        raise ValueError(f"got {repr(mesh)[:40]}, expected a file or triangles of finite corners; write {example} or the like")
    return tuple(tuple(tuple(corner) for corner in triangle) for triangle in corners.tolist())


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles that glow, turned and scaled, about the light's position.

    Attributes:
      corners: metres.
      normals: unit, of their fronts.
      area: of all, m².
      cumulative: area of the triangles up to and with each, as a share of all.
      middle: centre of area, metres.
    """

    corners: Float64[np.ndarray, "triangles 3 3"]
    normals: Float64[np.ndarray, "triangles 3"]
    area: float
    cumulative: Float64[np.ndarray, " triangles"]
    middle: Float64[np.ndarray, "3"]

    @classmethod
    def of(cls, corners: Float64[np.ndarray, "triangles 3 3"]) -> "Shape":
        """The shape of some triangles; those of no area are left out.

        Raises:
          ValueError: none has any.
        """
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice = np.linalg.norm(cross, axis=1)
        some = twice > 0
        if not some.any():
            raise ValueError("got no triangle with area, expected a surface; check its corners")
        corners, areas = corners[some], twice[some] / 2
        middle = np.average(corners.mean(1), axis=0, weights=areas)
        return cls(corners, cross[some] / twice[some, None], float(areas.sum()), cumulated(areas), middle)


class MeshLight(LightModel):
    """A mesh that emits from the fronts of its triangles, radiance in W/(m² sr); its backs are dark, and it never occludes.

    A triangle is chosen by its power, hence by its area, and a point on it uniformly: E = mean of L * area * cos_light / r².

    Attributes:
      mesh: a file (.glb, .gltf, .obj, .ply, .stl; metres), or triangles, each of three corners.
      position: of the mesh's origin.
      rotation: quaternion (x, y, z, w) as in glTF.
      scale: of the mesh, before it is turned and moved.
      radiance: of all its triangles; what the file says of light is not read.
      digest: of the file's contents; filled in when a light is made, and compared when a stored one shines.
    """

    kind: ClassVar[str] = "mesh"
    delta: ClassVar[bool] = False
    type: Literal["mesh"] = "mesh"
    mesh: Annotated[str | tuple[Triangle, ...], BeforeValidator(_file_or_triangles)]
    position: Vector
    rotation: Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate], AfterValidator(_turn)] = (0.0, 0.0, 0.0, 1.0)
    scale: Annotated[float, Field(gt=0, le=1e12)] = 1.0
    radiance: Colour
    digest: str = ""

    @model_validator(mode="before")
    @classmethod
    def _with_digest(cls, record: Any) -> Any:
        if isinstance(record, dict) and isinstance(path := record.get("mesh"), str) and not record.get("digest"):
            try:
                digest = _digest(path)
                _read(path, digest)  # so that what is wrong with it is said now
            except UserError as error:
                raise ValueError(f"mesh: {error}") from None
            return {**record, "digest": digest}
        return record

    @model_validator(mode="after")
    def _has_area(self) -> "MeshLight":
        if not isinstance(self.mesh, str):
            try:
                _ = self.shape
            except ValueError as error:
                raise ValueError(f"mesh: {error}") from None
        return self

    # Kept in copies: `translated` and `scaled`, the only ones made, change nothing that it depends on.
    @cached_property
    def shape(self) -> Shape:
        """What glows, about `position`."""
        corners = _read(self.mesh, self.digest) if isinstance(self.mesh, str) else np.array(self.mesh, np.float64)
        return Shape.of(self.scale * corners @ _matrix(self.rotation).T)

    def illuminate(
        self,
        points: Float[np.ndarray, "n 3"],
        u: Float[np.ndarray, "n 2"],
        out: Illumination | None = None,
        normals: Float[np.ndarray, "n 3"] | None = None,
    ) -> Illumination:
        """See `Light`."""
        out = out or Illumination.at(points)
        out.colour[:] = self.radiance
        shape = self.shape
        triangle, weights = sample_triangles(shape.cumulative, u)
        where = place(self.position, points)
        arrays = columns(weights), where, shape.corners, shape.area * shape.normals
        _glowing(columns(points), triangle, *arrays, out.direction.T, out.distance, out.strength)
        return out

    def translated(self, offset: Float[np.ndarray, "3"]) -> "MeshLight":
        """See `Light`."""
        return self.model_copy(update={"position": moved(self.position, offset)})

    def anchor(self) -> Float[np.ndarray, "3"] | None:
        """See `Light`: the centre of its area."""
        return np.array(self.position) + self.shape.middle

    def reach(self) -> float:
        """See `Light`."""
        return float(np.linalg.norm(self.shape.corners - self.shape.middle, axis=2).max())

    def scaled(self, factor: float) -> "MeshLight":
        """See `Light`."""
        return self.model_copy(update={"radiance": brightened(self.radiance, factor)})


def cumulated(powers: Float64[np.ndarray, " triangles"]) -> Float64[np.ndarray, " triangles"]:
    """Share of power of the triangles up to and with each; not all powers are 0."""
    total = np.cumsum(powers)
    return total / total[-1]


def sample_triangles(
    cumulative: Float64[np.ndarray, " triangles"], u: Float[np.ndarray, "n 2"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Triangles chosen by their power, and weights of their second and third corner, uniform over each.

    The first number chooses, and what it leaves over chooses again: numbers that are spread evenly stay so on each triangle.
    """
    first = u[:, 0].astype(np.float64)
    triangle = np.searchsorted(cumulative, first, side="right")  # one without power is never the first that lies above
    low = np.where(triangle > 0, cumulative[triangle - 1], 0.0)
    rest = np.clip((first - low) / (cumulative[triangle] - low), 0, _LAST)
    return triangle, warp.sample_triangle(np.stack([rest, u[:, 1]], 1).astype(u.dtype))


def pdf_triangles(
    cumulative: Float64[np.ndarray, " triangles"], areas: Float64[np.ndarray, " triangles"]
) -> Float64[np.ndarray, " triangles"]:
    """Density of a point per m² of each triangle."""
    return np.diff(cumulative, prepend=0.0) / areas


def invert_triangles(
    cumulative: Float64[np.ndarray, " triangles"], triangle: Int[np.ndarray, " n"], weights: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """The uniform numbers that give these triangles and weights."""
    u = warp.invert_triangle(weights)
    low = np.where(triangle > 0, cumulative[triangle - 1], 0.0)
    first = low + u[:, 0] * (cumulative[triangle] - low)
    return np.stack([first.astype(u.dtype), u[:, 1]], 1)


def _matrix(quaternion: tuple[float, float, float, float]) -> Float64[np.ndarray, "3 3"]:
    """The rotation of a quaternion (x, y, z, w) of any length."""
    x, y, z, w = np.array(quaternion) / max(map(abs, quaternion))
    size = x * x + y * y + z * z + w * w
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 / size * (w * cross + cross @ cross))


def _digest(path: str) -> str:
    """Hash of a mesh file's contents."""
    if not Path(path).is_file():
        raise UserError(f"got no file {path}, expected the mesh of a light; check the path")
    return str(sha256(Path(path))[:16])


@lru_cache(maxsize=64)
def _read(path: str, digest: str) -> Float64[np.ndarray, "triangles 3 3"]:
    """Triangles of a mesh file, whose contents are those of the digest.

    Raises:
      UserError: they are not, or the file is damaged.
    """
    from ddprt.scene.files import load_scene

    found = _digest(path)
    if found != digest:
        raise UserError(
            f"{path}: got contents with digest {found}, but the light was made of {digest}; bring that file back, or make "
            "the light anew without a digest"
        )
    return load_scene(Path(path)).corners


@compiled
def _glowing(
    points: np.ndarray,
    triangle: np.ndarray,
    weights: np.ndarray,
    where: np.ndarray,
    corners: np.ndarray,
    across: np.ndarray,
    direction: np.ndarray,
    distance: np.ndarray,
    strength: np.ndarray,
) -> None:
    """The whole area times the light's own cosine / r², in float64 whatever the arrays hold."""
    for i in range(points.shape[1]):
        t, second, third = triangle[i], weights[0, i], weights[1, i]
        first = 1.0 - second - third
        x = where[0] + first * corners[t, 0, 0] + second * corners[t, 1, 0] + third * corners[t, 2, 0] - points[0, i]
        y = where[1] + first * corners[t, 0, 1] + second * corners[t, 1, 1] + third * corners[t, 2, 1] - points[1, i]
        z = where[2] + first * corners[t, 0, 2] + second * corners[t, 1, 2] + third * corners[t, 2, 2] - points[2, i]
        length = np.sqrt(x * x + y * y + z * z)
        inverse = 1 / length if length > 0 else 0.0
        x, y, z = x * inverse, y * inverse, z * inverse
        direction[0, i], direction[1, i], direction[2, i], distance[i] = x, y, z, length
        strength[i] = max(-(x * across[t, 0] + y * across[t, 1] + z * across[t, 2]), 0.0) * inverse * inverse
