"""Direct light at the points as an engine shades it: shadow maps, filtered and biased, and lamps without size.

A shadow map holds, texel by texel, how far from the lamp the first surface lies. Points, spheres and rectangles get a cube of
six faces about their centre, spots one face as wide as their cone (a cube from 60 degrees on), directional lights a parallel
view of the scene's bounding sphere. A point is lit to the share of the texels about its own (percentage-closer filter; Reeves,
Salesin and Cook 1987) that are not nearer to the lamp than the point is, less a bias.

The bias is what the point's own plane needs and no more (Isidoro, "Shadow Mapping: GPU-based Tips and Techniques", 2006): seen
through texels that lie up to r off (at depth 1), a plane at depth z comes nearer by z t / (1 + t) at most, where
t = r (|n_u| + |n_v|) / |n . q| and q is the view of the point at depth 1. So a lone plane never shadows itself, and what is
lost are occluders within the bias.

Only the texels that are read are traced: 1024 samples and nine taps read a hundredth of a cube, and the rest would change
nothing.
"""

from dataclasses import dataclass

import numpy as np

from ddprt import warp
from ddprt.axes import Bool, Float32, Float64, Int
from ddprt.errors import UserError
from ddprt.lights import DirectionalLight, EnvironmentLight, Light, Lighting, MeshLight, PointLight, SphereLight, SpotLight
from ddprt.transport.embree import Tracer, lifted

_MESH_SPOTS = 16
_WIDEST_SPOT = 60.0  # degrees of a spot's half-angle past which one face would spend its texels on the rim


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """The depth of the first surface over one face, or six.

    Attributes:
      tracer: what casts shadows.
      place: of the lamp, centred frame, metres; for directional lights the middle of the plane that rays start from.
      axes: of each face: across, down and along the view, unit vectors in rows.
      extent: half the width of a face at depth 1, or in metres for parallel views.
      parallel: rays start on a plane and run side by side.
      resolution: texels per side.
    """

    tracer: Tracer
    place: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "faces 3 3"]
    extent: float
    parallel: bool
    resolution: int

    @classmethod
    def of(cls, tracer: Tracer, light: Light, resolution: int) -> "ShadowMap":
        """The map of a light that is given in the tracer's centred frame.

        Raises:
          UserError: the light comes from all around.
        """
        anchor = light.anchor()
        if isinstance(light, EnvironmentLight):
            raise UserError(
                "shadow maps: got an environment light, expected light from one place or direction, which such a map can hold; "
                "leave it out of the lightings"
            )
        if isinstance(light, DirectionalLight) or anchor is None:
            along = np.array(light.direction, np.float64)  # type: ignore[attr-defined]
            return cls(tracer, -2 * tracer.radius * along, warp.frame(along)[None], tracer.radius, True, resolution)
        if isinstance(light, SpotLight) and light.outer_deg <= _WIDEST_SPOT:
            axes, extent = warp.frame(np.array(light.direction, np.float64))[None], np.tan(np.deg2rad(light.outer_deg))
            return cls(tracer, anchor, axes, float(extent), False, resolution)
        cube = np.stack([warp.frame(sign * axis) for axis in np.eye(3) for sign in (1.0, -1.0)])
        return cls(tracer, anchor, cube, 1.0, False, resolution)

    def depth(self, texels: Int[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Metres along the view to what the centres of texels (face, column, row) see first; infinity where nothing is."""
        face, at = self.axes[texels[:, 0]], self.extent * (2 * (texels[:, 1:] + 0.5) / self.resolution - 1)
        across = np.einsum("nk,nkd->nd", at, face[:, :2])
        along = face[:, 2]
        toward = along if self.parallel else across + along
        length = np.linalg.norm(toward, axis=1)
        origin = self.place + across if self.parallel else np.broadcast_to(self.place, toward.shape)
        hits = self.tracer.closest(origin.astype(np.float32), (toward / length[:, None]).astype(np.float32))
        return np.where(hits.triangle >= 0, hits.distance.astype(np.float64) / length, np.inf)

    def lit(
        self, positions: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"], taps: int
    ) -> Float64[np.ndarray, " n"]:
        """Share of the filter's taps that see each point, 0 to 1.

        Args:
          positions: centred frame, metres.
          normals: unit, of the planes that the points lie on.
          taps: per side of the filter.
        """
        away = positions - self.place
        face = np.argmax(np.einsum("fd,nd->nf", self.axes[:, 2], away), 1)
        u, v, z = np.einsum("nkd,nd->kn", self.axes[face], away)
        u_plane, v_plane, z_plane = np.abs(np.einsum("nkd,nd->kn", self.axes[face], normals))
        ahead = z > 0
        reach = self.extent * taps / self.resolution  # from a point to the centre of the furthest tap, at most
        if self.parallel:
            at, facing = np.stack([u, v], 1), z_plane
            bias = np.minimum(reach * (u_plane + v_plane) / np.maximum(facing, 1e-12), 2 * self.tracer.radius)
        else:
            safe = np.where(ahead, z, 1)
            at, facing = np.stack([u, v], 1) / safe[:, None], np.abs(np.einsum("nd,nd->n", away, normals)) / safe
            tilt = reach * (u_plane + v_plane) / np.maximum(facing, 1e-12)
            bias = safe * tilt / (1 + tilt)
        first = np.floor((at / self.extent + 1) / 2 * self.resolution - (taps - 1) / 2).astype(np.int64)
        inside = ahead & (np.abs(at) <= self.extent * (1 + 1e-9)).all(1)
        nearest = z - bias - 2 * self.tracer.offset
        seen = np.zeros(len(positions))
        wanted, back = self._taps(face, first, inside, taps)
        depth = self.depth(wanted)[back].reshape(-1, taps * taps)
        seen[inside] = (depth >= nearest[inside, None]).mean(1)
        return np.where(inside, seen, 1.0)  # what no face sees, no cone lights either

    def _taps(
        self, face: Int[np.ndarray, " n"], first: Int[np.ndarray, "n 2"], inside: Bool[np.ndarray, " n"], taps: int
    ) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, " reads"]]:
        """The texels that are read, each once, and where each read finds its own; edges of a face are repeated."""
        step = np.stack(np.meshgrid(np.arange(taps), np.arange(taps), indexing="ij"), -1).reshape(1, -1, 2)
        at = np.clip(first[inside, None] + step, 0, self.resolution - 1).reshape(-1, 2)
        number = (np.repeat(face[inside], taps * taps) * self.resolution + at[:, 0]) * self.resolution + at[:, 1]
        kept, back = np.unique(number, return_inverse=True)
        return np.stack(np.unravel_index(kept, (len(self.axes), self.resolution, self.resolution)), 1), back.reshape(-1)


def engine_irradiance(
    tracer: Tracer,
    lighting: Lighting,
    positions: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    *,
    resolution: int,
    taps: int,
    depth: float = 0.0,
) -> Float32[np.ndarray, "n 3"]:
    """Direct irradiance (W/m²) at world-space points as an engine shades them; see `ddprt.transport.measure.measure`.

    Args:
      tracer: what casts shadows.
      lighting: world space; lights with size shine from their centre, as strongly along every direction as from there.
      positions: metres.
      normals: unit.
      resolution, taps: of the shadow maps and of their filter, per side.
      depth: how far behind the surface light is evaluated, metres; shadows are those of the surface.
    """
    places, total = positions - tracer.centre, np.zeros((len(positions), 3), np.float32)
    for light in (one.translated(-tracer.centre) for one in lighting):
        seen = ShadowMap.of(tracer, light, resolution).lit(places, normals, taps)
        lamp, spots = _without_size(light), _spots(light)
        lamp = tracer.medium.veiled(lamp) if tracer.medium else lamp

        def shine(behind: float, lamp: Light = lamp, spots: np.ndarray = spots) -> Float32[np.ndarray, "n 3"]:
            at = lifted(tracer, (places - behind * normals).astype(np.float32), normals.astype(np.float32))
            total = np.zeros((len(at), 3), np.float32)
            for spot in spots:
                sample = lamp.illuminate(at, np.broadcast_to(spot, (len(at), 2)))
                cosine = np.maximum(np.einsum("nd,nd->n", sample.direction, normals.astype(np.float32)), 0)
                total += sample.irradiance * cosine[:, None]
            return total / np.float32(len(spots))

        light_there = shine(0.0) if depth == 0 else np.maximum(2 * shine(depth) - shine(2 * depth), 0)
        total += seen.astype(np.float32)[:, None] * light_there
    return total


def _spots(light: Light) -> Float32[np.ndarray, "spots 2"]:
    """Where an engine asks a lamp for its light: in the middle; a mesh, which has none, at places all over it."""
    return warp.sobol(_MESH_SPOTS, 2, seed=0) if isinstance(light, MeshLight) else np.full((1, 2), 0.5, np.float32)


def _without_size(light: Light) -> Light:
    """A sphere as the point that is as bright from afar; a rectangle is asked for its centre by `illuminate` itself."""
    if not isinstance(light, SphereLight):
        return light
    red, green, blue = (np.pi * light.radius**2 * np.array(light.radiance)).tolist()
    return PointLight(position=light.center, intensity=(red, green, blue))
