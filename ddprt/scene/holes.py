"""Where a surface is not there: the holes of cut-out materials, triangle by triangle, as rays and files need them."""

from dataclasses import dataclass, fields

import numpy as np

from ddprt.axes import Bool, Float, Float32, Float64, Int, Int32, Int64
from ddprt.compiled import compiled
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene

_NAMED = "holes."


def pierced(material: Material) -> bool:
    """Whether a material has holes at all: a mask that is opaque everywhere is none."""
    return material.cutout is not None and bool(material.cutout.opacity.min() < material.cutout.cutoff)


@dataclass(frozen=True, eq=False)
class Holes:
    """The holes of a mesh; its triangles are counted as there.

    Attributes:
      row: for each triangle of the mesh its place in the two that follow, -1 where it has no holes.
      uv: texture coordinates at the corners of those that have, origin top-left.
      image: which image each of them is looked up in.
      size: height and width of each image.
      cutoff: least opacity of each that stops light.
      opacity: all images, one after another, row by row.
    """

    row: Int32[np.ndarray, " triangles"]
    uv: Float64[np.ndarray, "masked 3 2"]
    image: Int32[np.ndarray, " masked"]
    size: Int64[np.ndarray, "images 2"]
    cutoff: Float64[np.ndarray, " images"]
    opacity: Float32[np.ndarray, " pixels"]

    @classmethod
    def of(cls, scene: Scene) -> "Holes | None":
        """Those of a scene; None where it has none."""
        numbers = [index for index in np.unique(scene.material) if pierced(scene.materials[index])]
        if not numbers or scene.uv is None:
            return None
        image = np.full(len(scene.materials), -1, np.int32)
        image[numbers] = np.arange(len(numbers))
        masked = np.flatnonzero(image[scene.material] >= 0)
        row = np.full(len(scene.triangles), -1, np.int32)
        row[masked] = np.arange(len(masked))
        cutouts = [cutout for index in numbers if (cutout := scene.materials[index].cutout)]
        return cls(
            row,
            scene.uv[scene.triangles[masked]],
            image[scene.material[masked]],
            np.array([cutout.opacity.shape for cutout in cutouts], np.int64),
            np.array([cutout.cutoff for cutout in cutouts], np.float64),
            np.concatenate([np.asarray(cutout.opacity, np.float32).ravel() for cutout in cutouts]),
        )

    @classmethod
    def read(cls, tensors: dict[str, np.ndarray], triangles: int) -> "Holes | None":
        """From the tensors of a file; None where it has none.

        Args:
          tensors: of the file.
          triangles: of the mesh.
        Raises:
          ValueError: they do not fit together.
        """
        if f"{_NAMED}row" not in tensors:
            return None
        row, uv, image, size, cutoff, opacity = (tensors.get(f"{_NAMED}{entry.name}", np.zeros(0)) for entry in fields(cls))
        kinds = [array.dtype.str[1:] for array in (row, uv, image, size, cutoff, opacity)]
        fits = (
            kinds == ["i4", "f8", "i4", "i8", "f8", "f4"]
            and row.shape == (triangles,)
            and uv.shape == (len(image), 3, 2)
            and image.ndim == cutoff.ndim == opacity.ndim == 1
            and size.shape == (len(cutoff), 2)
            and len(image) > 0
            and (row >= -1).all()
            and (row < len(image)).all()
            and (image >= 0).all()
            and (image < len(size)).all()
            and (size >= 1).all()
            and (size <= len(opacity)).all()
            and size.prod(1).sum() == len(opacity)
        )
        if not fits:
            raise ValueError("the masks of its holes do not fit its triangles")
        return cls(row, uv, image, size, cutoff, opacity)

    @property
    def tensors(self) -> dict[str, np.ndarray]:
        """What `read` reads, by name."""
        return {f"{_NAMED}{entry.name}": getattr(self, entry.name) for entry in fields(self)}

    def open_at(
        self, triangle: Int[np.ndarray, " n"], u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether points lie in holes.

        Args:
          triangle: of the mesh; below 0 for none, which is no hole.
          u, v: weights of its second and third corner.
        """
        found = np.zeros(len(triangle), bool)
        end = np.cumsum(self.size.prod(1))
        _find(triangle, u, v, self.row, self.uv, self.image, end, self.size, self.cutoff, self.opacity, found)
        return found


@compiled
def _find(
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    row: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    end: np.ndarray,
    size: np.ndarray,
    cutoff: np.ndarray,
    opacity: np.ndarray,
    found: np.ndarray,
) -> None:
    """Bilinear and repeating, as `material.bilinear`."""
    for i in range(len(triangle)):
        if triangle[i] < 0 or row[triangle[i]] < 0:
            continue
        corners = uv[row[triangle[i]]]
        number = image[row[triangle[i]]]
        height, width = size[number]
        second, third = np.float64(u[i]), np.float64(v[i])
        first = 1 - second - third
        x = (first * corners[0, 0] + second * corners[1, 0] + third * corners[2, 0]) * width - 0.5
        y = (first * corners[0, 1] + second * corners[1, 1] + third * corners[2, 1]) * height - 0.5
        left, top = np.floor(x), np.floor(y)
        x0, y0 = np.int64(left) % width, np.int64(top) % height
        x1, y1 = (x0 + 1) % width, (y0 + 1) % height
        across, down = x - left, y - top
        start = end[number] - height * width
        above = opacity[start + y0 * width + x0] * (1 - across) + opacity[start + y0 * width + x1] * across
        below = opacity[start + y1 * width + x0] * (1 - across) + opacity[start + y1 * width + x1] * across
        found[i] = above * (1 - down) + below * down < cutoff[number]
