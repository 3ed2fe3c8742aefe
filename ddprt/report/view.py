"""From light to what is displayed: cameras, tone map, colours of signed values.

Lightmaps are seen by a camera, so that an error is judged where it shows. A view is linear in the lightmap: one sparse
matrix from texels to pixels, traced once and applied to every lightmap. Back faces do not hide: a room can be looked into
from outside, through the walls that turn their backs.
"""

import io
import math
from dataclasses import dataclass, fields

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix

from ddprt.axes import Bool, Float, Float32, Float64, Int
from ddprt.scene.mesh import Scene
from ddprt.scene.viewpoint import Viewpoint
from ddprt.transport.embree import Hits, Tracer

_LAYERS = 8  # back faces that a ray may pass
_GRID = 2  # rays per pixel and axis
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec.709 channels."""
_BRIGHT = 0.8  # displayed value of the 99th percentile


@dataclass(frozen=True)
class Camera:
    """A pinhole.

    Attributes:
      eye, target: metres.
      fov_deg: vertical opening angle.
      aspect: width over height.
      up: what is upright in the picture.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov_deg: float = 35.0
    aspect: float = 4 / 3
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)

    @property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """Rows: right, up, forward; unit vectors."""
        forward = np.subtract(self.target, self.eye)
        right = np.cross(forward, self.up)
        return np.array([_unit(right), _unit(np.cross(right, forward)), _unit(forward)])

    @property
    def reach(self) -> Float64[np.ndarray, "2"]:
        """Half width and half height of the picture at distance 1."""
        return np.tan(np.radians(self.fov_deg) / 2) * np.array([self.aspect, 1.0])

    def directions(self, places: Float64[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 3"]:
        """Unit ray directions through places of the picture: (0, 0) is its top left corner, (1, 1) its bottom right."""
        across = (2 * places - 1) * [1, -1] * self.reach
        return _unit(np.concatenate([across, np.ones((len(places), 1))], 1) @ self.axes).astype(np.float32)

    def project(self, positions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Where positions (metres) appear in the picture; NaN behind the camera."""
        local = (positions - self.eye) @ self.axes.T
        depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
        return (local[:, :2] / depth / self.reach * [1, -1] + 1) / 2


_CORNELL = Camera((0.278, 0.273, -0.8), (0.278, 0.273, 0.0), 39.3, 1.0)  # as photographed in Cornell
_STATUE = Camera((1.5, 1.9, 3.4), (0.0, 0.75, 0.0))
_LION = Camera((1.72, 1.08, 1.43), (0.0, 0.42, 0.0))  # from its flank, which is what fills a picture
_BENDING = Camera((1.3, 1.45, 2.0), (0.1, 0.35, 0.0))  # without the corners of its floor
_CAMERAS = {
    **dict.fromkeys(("cornell", "cornell-hole", "glossy-room", "foggy-room"), _CORNELL),
    "statue": _STATUE,
    "lion": _LION,
    "bending": _BENDING,
}


def default_camera(scene: Scene) -> Camera:
    """That of its file, or the customary one of library scenes, or one that sees all of it from outside at three quarters."""
    return camera_for(scene.name, scene.corners, scene.viewpoint)


def camera_for(name: str, triangles: Float64[np.ndarray, "triangles 3 3"], given: Viewpoint | None = None) -> Camera:
    """The same by the scene's name, its triangles' corners (metres), and where its file has it seen from."""
    if given is not None:
        return Camera(given.eye, given.target, given.fov_deg, given.aspect or Camera.aspect, given.up)
    if name in _CAMERAS:
        return _CAMERAS[name]
    away = _unit(np.array([0.5, 0.55, 1.0]))
    # Only what shows its front is seen, so only that has to fit.
    showing = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) @ away > 0
    corners = triangles[showing if showing.any() else slice(None)].reshape(-1, 3)
    target = (corners.min(0) + corners.max(0)) / 2
    camera = Camera(triple(target + away), triple(target))
    across, depth = np.split((corners - target) @ camera.axes.T, [2], 1)
    distance = float((np.abs(across) / (0.92 * camera.reach) - depth).max())
    return Camera(triple(target + distance * away), triple(target))


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays of a picture, some for each pixel, and the first front that each meets.

    Attributes:
      camera: whose they are.
      shape: height and width of the picture in pixels.
      directions: unit vectors, rows of the finer picture from the top.
      pixel: row-major index of the pixel that each belongs to.
      hits: what they meet; distances count from the last back that was passed.
    """

    camera: Camera
    shape: tuple[int, int]
    directions: Float32[np.ndarray, "rays 3"]
    pixel: Int[np.ndarray, " rays"]
    hits: Hits

    @classmethod
    def of(cls, tracer: Tracer, camera: Camera, height: int) -> "Rays":
        """Traces those of a camera; the width follows from it."""
        width = max(1, round(height * camera.aspect))
        across, down = ((np.arange(count * _GRID) + 0.5) / (count * _GRID) for count in (width, height))
        directions = camera.directions(np.stack(np.meshgrid(across, down), -1).reshape(-1, 2))
        row, column = np.divmod(np.arange(len(directions)), width * _GRID)
        hits = first_fronts(tracer, np.asarray(camera.eye), directions)
        return cls(camera, (height, width), directions, row // _GRID * width + column // _GRID, hits)

    def mean(self, values: Float[np.ndarray, "rays ..."]) -> np.ndarray:
        """(height, width, ...): what pixels show of a value for each ray."""
        height, width = self.shape
        return values.reshape(height, _GRID, width, _GRID, *values.shape[1:]).mean((1, 3))

    def weights(self, rays: Int[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """What each corner of the triangle that is met counts where some rays meet it."""
        u, v = self.hits.u[rays], self.hits.v[rays]
        return np.stack([1 - u - v, u, v], 1).astype(np.float64)


@dataclass(frozen=True)
class View:
    """What a camera sees of a lightmap.

    Attributes:
      camera: whose picture it is.
      lookup: (pixels, texels) weights; a row sums to the share of the pixel that the scene fills.
      alpha: share of each pixel that the scene fills.
    """

    camera: Camera
    lookup: csr_matrix
    alpha: Float64[np.ndarray, "height width"]

    def render(self, values: Float[np.ndarray, "texels ..."]) -> np.ndarray:
        """Picture of a quantity that is stored per texel, (height, width, ...), 0 where the scene is not.

        Albedo times irradiance in W/m² renders as radiosity, pi times the radiance that reaches the camera.
        """
        return (self.lookup @ values).reshape(*self.alpha.shape, *values.shape[1:])


def take_view(
    tracer: Tracer,
    uv: Float64[np.ndarray, "triangles 3 2"],
    covered: Bool[np.ndarray, "rows columns"],
    camera: Camera,
    height: int = 320,
) -> View:
    """Traces the rays of a camera.

    Args:
      tracer: of the scene.
      uv: lightmap coordinates of the triangles' corners in the unit square, origin top-left.
      covered: texels that carry light.
      camera: from where.
      height: pixels; the width follows from the camera.
    """
    rays = Rays.of(tracer, camera, height)
    hit = np.flatnonzero(rays.hits.triangle >= 0)
    place, share = np.einsum("nc,ncd->nd", rays.weights(hit), uv[rays.hits.triangle[hit]]), 1 / _GRID**2
    lookup = look_up(place, rays.pixel[hit], np.full(len(hit), share), math.prod(rays.shape), covered)
    return View(camera, lookup, rays.mean((rays.hits.triangle >= 0).astype(np.float64)))


def look_up(
    place: Float64[np.ndarray, "n 2"],
    row: Int[np.ndarray, " n"],
    share: Float64[np.ndarray, " n"],
    rows: int,
    covered: Bool[np.ndarray, "height width"],
) -> csr_matrix:
    """Bilinear look-ups in a lightmap as a (rows, texels) matrix: each row is the sum of `share` times those that go to it.

    Args:
      place: on the lightmap, in the unit square.
      row: where each goes.
      share: its weight there.
      rows: how many there are.
      covered: texels that carry light; only they are looked up.
    """
    texels, weights = _bilinear(place, covered)
    entries = (share[:, None] * weights).ravel(), (np.repeat(row, 4), texels.ravel())
    return csr_matrix(entries, (rows, int(covered.sum())))


def nearest_texels(place: Float64[np.ndarray, "n 2"], covered: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, " n"]:
    """The covered texel that each place of the lightmap lies in, or the nearest one."""
    slot = np.cumsum(covered).reshape(covered.shape) - 1
    near = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    column, row = np.clip((place * covered.shape[::-1]).astype(int), 0, np.array(covered.shape[::-1]) - 1).T
    return slot[near[0, row, column], near[1, row, column]]


def first_fronts(tracer: Tracer, eye: Float64[np.ndarray, "3"], directions: Float32[np.ndarray, "rays 3"]) -> Hits:
    """First front face along each ray from an eye (metres); back faces let it pass, and distances count from the last one."""
    origins = np.tile((eye - tracer.centre).astype(np.float32), (len(directions), 1))
    hits = tracer.closest(origins, directions)
    for _ in range(_LAYERS):
        behind = np.flatnonzero((hits.triangle >= 0) & ~hits.front)
        if len(behind) == 0:
            return hits
        origins[behind] += (hits.distance[behind] + 10 * tracer.offset)[:, None] * directions[behind]
        again = tracer.closest(origins[behind], directions[behind])
        for entry in fields(Hits):
            getattr(hits, entry.name)[behind] = getattr(again, entry.name)
    hits.triangle[~hits.front] = -1
    return hits


def seen(tracer: Tracer, camera: Camera, positions: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether surface points (metres) are in the picture and not hidden behind a front face."""
    away = positions - np.asarray(camera.eye)
    hits = first_fronts(tracer, np.asarray(camera.eye), _unit(away).astype(np.float32))
    ground = np.take(tracer.corners[:, 0], hits.triangle, axis=0, mode="clip") + tracer.centre
    height = np.einsum("nd,nd->n", positions - ground, np.take(tracer.normals, hits.triangle, axis=0, mode="clip"))
    place = camera.project(positions)
    inside = ((place >= 0) & (place <= 1)).all(1)
    # The ray through a point meets the plane the point is in; float32 and shared edges leave a little room.
    return inside & (hits.triangle >= 0) & (np.abs(height) < 1e-4 * tracer.radius)


def tonemap(image: Float[np.ndarray, "*shape 3"], exposure: float) -> Float64[np.ndarray, "*shape 3"]:
    """Linear Rec.709 to displayed sRGB, 0 to 1: times 2^exposure, clipped, encoded.

    Args:
      image: any linear unit.
      exposure: stops (EV).
    """
    linear = np.clip(image * 2.0**exposure, 0, 1).astype(np.float64)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def exposure_for(reference: Float[np.ndarray, "texels 3"]) -> float:
    """Stops that show the 99th percentile of luminance at about 0.8 of full white, in tenths; 0 where all is black."""
    bright = float(np.quantile(reference @ LUMINANCE, 0.99)) if len(reference) else 0.0
    linear = ((_BRIGHT + 0.055) / 1.055) ** 2.4
    return round(float(np.log2(linear / bright)), 1) if bright > 0 else 0.0


def signed_range(differences: Float[np.ndarray, "*shape"]) -> float:
    """Half width of a signed colour scale: the 99.5th percentile of the magnitudes, to two digits."""
    size = float(np.quantile(np.abs(differences), 0.995)) if differences.size else 0.0
    return float(f"{size:.1e}")


def diverging(values: Float[np.ndarray, "*shape"], limit: float) -> Float64[np.ndarray, "*shape 3"]:
    """Signed values as blue (-limit), white (0) and red (limit); a limit of 0 shows signs alone."""
    from matplotlib import colormaps

    share = np.clip(np.asarray(values, np.float64) / max(limit, 1e-300), -1, 1)
    # Two halves of one map instead of its middle entry: zero is exactly white, and both signs are equally strong.
    strength = colormaps["Reds"](np.abs(share) * 0.9)[..., :3], colormaps["Blues"](np.abs(share) * 0.9)[..., :3]
    colour = np.where(share[..., None] > 0, *strength)
    return np.where((np.abs(share) < 1e-9)[..., None], 1.0, colour)


def png(image: Float[np.ndarray, "height width rgba"]) -> bytes:
    """Displayed values, 0 to 1, with or without alpha, as a PNG file."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, np.round(np.clip(image, 0, 1) * 255).astype(np.uint8), format="png", metadata={"Software": "ddprt"})
    return buffer.getvalue()


def _bilinear(uv: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4) covered texels about each place and their weights; where none is covered, the nearest one that is."""
    rows, columns = covered.shape
    slot = np.cumsum(covered).reshape(covered.shape) - 1
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    x, y = uv[:, 0] * columns - 0.5, uv[:, 1] * rows - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    texels, weights = np.empty((len(uv), 4), int), np.empty((len(uv), 4))
    for corner, (down, right) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        i, j = np.clip(top + down, 0, rows - 1), np.clip(left + right, 0, columns - 1)
        texels[:, corner] = slot[nearest[0, i, j], nearest[1, i, j]]
        share = np.where(right, x - left, 1 - x + left) * np.where(down, y - top, 1 - y + top)
        weights[:, corner] = np.where(covered[i, j], share, 1e-6)
    return texels, weights / weights.sum(1, keepdims=True)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def triple(vector: np.ndarray) -> tuple[float, float, float]:
    """A vector as a camera has it."""
    x, y, z = vector.tolist()
    return x, y, z
