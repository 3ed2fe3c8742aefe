"""The scene as an engine shows it: albedo of every pixel, lamps as they are, indirect light from the maps and layers.

What a view of the lightmap cannot show is here: what surfaces reflect towards the eye, skies behind them, surfaces that glow,
and probes, as small white balls. A picture is the sum of what is `emitted` and `lit`, the same for every method, and of what is
`learned`: an error is seen where it would be.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np
from scipy.sparse import csr_matrix

from ddprt import harmonics
from ddprt.axes import Bool, Float, Float32, Float64, Int
from ddprt.dataset.layers import Layer
from ddprt.lights import EnvironmentLight, Lighting
from ddprt.lights.light import unit
from ddprt.report.lamps import seen_lamps
from ddprt.report.mirrored import mirrored
from ddprt.report.view import Camera, Rays, look_up, nearest_texels, seen, triple
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import glossy_surfaces, scattering
from ddprt.transport.measure import measure

WHITE = 0.8
"""Albedo of the balls that probes are shown as."""
_BALL = 0.16  # radius of a ball over the median distance of a probe from the next
_LARGEST = 0.03  # of the scene's radius, that of a ball at most
_BLOCK = 1 << 14  # rays whose harmonics are held at once
_CLOSE = 0.75  # of half a picture, what is glossy fills of a close one
_ASIDE = (30.0, 50.0, 75.0, 110.0)  # degrees that the eye may step aside for a close picture


@dataclass(frozen=True, eq=False)
class Shown:
    """Rays that end at places of a layer.

    Attributes:
      name: of the layer.
      rays: which of the picture.
      lookup: what the coefficients of each place count in those of a ray.
      directions: that the layer is asked for.
      order: of its harmonics.
      factor: from its values to pi times radiance.
    """

    name: str
    rays: Int[np.ndarray, " n"]
    lookup: csr_matrix
    directions: Float64[np.ndarray, "n 3"]
    order: int
    factor: float

    def values(self, light: Float32[np.ndarray, "places coefficients 3"]) -> Float64[np.ndarray, "n 3"]:
        """Pi times the radiance that reaches the eye, W/m²; never below 0."""
        flat, found = light.reshape(len(light), -1).astype(np.float64), np.empty((len(self.rays), 3))
        for first in range(0, len(found), _BLOCK):
            part = slice(first, first + _BLOCK)
            there = (self.lookup[part] @ flat).reshape(-1, *light.shape[1:])
            found[part] = np.einsum("nkc,nk->nc", there, harmonics.harmonics(self.directions[part], self.order))
        return self.factor * np.maximum(found, 0)


@dataclass(frozen=True, eq=False)
class Balls:
    """Rays that end at probes.

    Attributes:
      rays: which of the picture.
      probe: which of its layer each meets.
      position: metres.
      normal: unit.
    """

    rays: Int[np.ndarray, " n"]
    probe: Int[np.ndarray, " n"]
    position: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Scenery:
    """A picture of a scene without its light.

    Attributes:
      scene, tracer: what is seen.
      rays: of the picture.
      ends: metres that each goes; infinity where it meets nothing.
      met: rays that end on a surface.
      lookup: (met, texels) weights of the lightmap.
      albedo: what surfaces scatter there in all directions.
      glow: pi times the radiance that surfaces send out by themselves, W/m²; None where none does.
      shiny: those of `met` that end on something glossy.
      shown: rays that end at places of layers.
      balls: rays that end at probes, by layer.
    """

    scene: Scene
    tracer: Tracer
    rays: Rays
    ends: Float64[np.ndarray, " rays"]
    met: Int[np.ndarray, " met"]
    lookup: csr_matrix
    albedo: Float64[np.ndarray, "met 3"]
    glow: Float64[np.ndarray, "met 3"] | None
    shiny: Int[np.ndarray, " shiny"]
    shown: tuple[Shown, ...]
    balls: tuple[Balls, ...]

    @classmethod
    def of(
        cls,
        tracer: Tracer,
        scene: Scene,
        uv: Float64[np.ndarray, "triangles 3 2"],
        covered: Bool[np.ndarray, "height width"],
        camera: Camera,
        layers: Sequence[Layer] = (),
        height: int = 320,
    ) -> "Scenery":
        """What a camera sees.

        Args:
          tracer, scene: of the scene.
          uv: lightmap coordinates of the triangles' corners in the unit square, origin top-left.
          covered: texels that carry light.
          camera: from where.
          layers: what there is besides the lightmap.
          height: pixels.
        """
        rays = Rays.of(tracer, camera, height)
        ends = _distances(tracer, rays)
        balls = {layer.name: _balls(tracer, rays, ends, layer) for layer in layers if layer.quantity == "irradiance"}
        for one in balls.values():
            rays.hits.triangle[one.rays] = -1
        met = np.flatnonzero(rays.hits.triangle >= 0)
        triangle, weights = rays.hits.triangle[met], rays.weights(met)
        place = np.einsum("nc,ncd->nd", weights, uv[triangle])
        lookup = look_up(place, np.arange(len(met)), np.ones(len(met)), len(met), covered)
        gloss = glossy_surfaces(tracer, scene)
        shiny = np.flatnonzero(gloss.shiny[triangle]) if gloss else np.zeros(0, int)
        exitant = [layer for layer in layers if layer.quantity == "radiance"]
        shown = _from_texels(exitant, rays, met[shiny], place[shiny], covered) if len(shiny) else []
        for layer in layers:
            if layer.name in balls:
                one = balls[layer.name]
                size = len(one.rays), len(layer.position)
                pick = csr_matrix((np.ones(len(one.rays)), (np.arange(len(one.rays)), one.probe)), size)
                shown.append(Shown(layer.name, one.rays, pick, one.normal, layer.order, WHITE))
        glow = None
        if any(material.emission for material in scene.used_materials):
            emitters = import_module("ddprt.transport.emission").Emitters.of(scene)
            glow = np.pi * emitters.radiance(triangle, weights[:, 1:])
        albedo = scattering(scene).albedo_at(triangle, weights)
        return cls(scene, tracer, rays, ends, met, lookup, albedo, glow, shiny, tuple(shown), tuple(balls.values()))

    def emitted(self, lighting: Lighting) -> Float64[np.ndarray, "height width 3"]:
        """What reaches the eye untouched, of lamps, skies and surfaces that glow: pi times radiance, W/m²."""
        found = np.pi * seen_lamps(lighting, np.asarray(self.rays.camera.eye), self.rays.directions, self.ends)
        if self.glow is not None:
            found[self.met] += self.glow
        return self.rays.mean(found)

    def lit(
        self,
        lighting: Lighting,
        direct: Float32[np.ndarray, "texels 3"],
        constant: Float32[np.ndarray, "texels 3"] | None = None,
    ) -> Float64[np.ndarray, "height width 3"]:
        """What surfaces and probes send to the eye of lamps and skies that shine on them, and of surfaces that glow.

        Args:
          lighting: what shines.
          direct: its lightmap, W/m²; on glossy surfaces and probes lamps are looked at from the very place.
          constant: irradiance of surfaces that glow, W/m².
        Returns:
          Pi times radiance, W/m².
        """
        found = np.zeros((len(self.rays.directions), 3))
        surface = self.lookup @ direct.astype(np.float64) * self.albedo
        if len(self.shiny):
            surface[self.shiny] = self._reflected(lighting)
        if constant is not None:
            surface += self.lookup @ constant.astype(np.float64) * self.albedo
        found[self.met] = surface
        for one in self.balls:
            found[one.rays] = WHITE * measure(self.tracer, lighting, one.position, one.normal, seed=0)
        return self.rays.mean(found)

    def learned(
        self, indirect: Float32[np.ndarray, "texels 3"], layers: Mapping[str, np.ndarray]
    ) -> Float64[np.ndarray, "height width 3"]:
        """What indirect light brings to the eye.

        Args:
          indirect: lightmap, W/m².
          layers: coefficients of every layer that the scenery was made with, (places, coefficients, 3).
        Returns:
          Pi times radiance, W/m².
        """
        found = np.zeros((len(self.rays.directions), 3))
        found[self.met] = self.albedo * (self.lookup @ indirect.astype(np.float64))
        for part in self.shown:
            found[part.rays] = part.values(layers[part.name])
        return self.rays.mean(found)

    def alpha(self, lighting: Lighting) -> Float64[np.ndarray, "height width"]:
        """Share of each pixel that shows something: all where there is a sky."""
        sky = any(isinstance(light, EnvironmentLight) for light in lighting)
        return self.rays.mean((np.isfinite(self.ends) | sky).astype(np.float64))

    def _reflected(self, lighting: Lighting) -> Float64[np.ndarray, "shiny 3"]:
        """What glossy surfaces send to the eye of lamps and skies, diffuse part and lobe."""
        rays, hits = self.met[self.shiny], self.rays.hits
        where = hits.triangle[rays], hits.u[rays], hits.v[rays]
        lobes = glossy_surfaces(self.tracer, self.scene).lobes(*where, self.rays.directions[rays])
        return mirrored(self.tracer, lighting, self.tracer.on_triangle(*where), self.tracer.normals[where[0]], lobes)


def middle_of_gloss(layers: Sequence[Layer]) -> Float64[np.ndarray, "3"] | None:
    """Of the box about all that is glossy, metres; None where nothing is."""
    place = np.concatenate([np.zeros((0, 3)), *(layer.position for layer in layers if layer.quantity == "radiance")])
    return (place.min(0) + place.max(0)) / 2 if len(place) else None


def close_cameras(tracer: Tracer, camera: Camera, layers: Sequence[Layer]) -> list[Camera]:
    """Two cameras near to what is glossy, right and left of the way from which another looks at it; none where nothing is.

    Of some on each side, the one that sees the most of it.
    """
    target = middle_of_gloss(layers)
    if target is None:
        return []
    place = np.concatenate([layer.position for layer in layers if layer.quantity == "radiance"])
    back = np.asarray(camera.eye) - target
    reach = float(np.linalg.norm(place - target, axis=1).max()) / (_CLOSE * float(camera.reach.min()))
    back *= min(1.0, reach / float(np.linalg.norm(back)))
    up, found = np.asarray(camera.up), []
    for side in (-1, 1):
        tried = []
        for angle in side * np.radians(_ASIDE):
            turned = back * np.cos(angle) + np.cross(up, back) * np.sin(angle) + up * (up @ back) * (1 - np.cos(angle))
            tried.append(replace(camera, eye=triple(target + turned), target=triple(target)))
        found.append(max(tried, key=lambda one: int(seen(tracer, one, place).sum())))
    return found


def _distances(tracer: Tracer, rays: Rays) -> Float64[np.ndarray, " rays"]:
    """Metres from the eye to what each ray meets; infinity where it meets nothing."""
    found, hits = np.full(len(rays.directions), np.inf), rays.hits
    met = np.flatnonzero(hits.triangle >= 0)
    place = tracer.on_triangle(hits.triangle[met], hits.u[met], hits.v[met]) + tracer.centre
    found[met] = np.linalg.norm(place - np.asarray(rays.camera.eye), axis=1)
    return found


def _from_texels(
    layers: Sequence[Layer],
    rays: Rays,
    shiny: Int[np.ndarray, " shiny"],
    place: Float64[np.ndarray, "shiny 2"],
    covered: Bool[np.ndarray, "height width"],
) -> list[Shown]:
    """Rays that end on something glossy: each asks the layer that its texel belongs to, or the nearest one that has any."""
    owner = np.full(int(covered.sum()), -1)
    for index, layer in enumerate(layers):
        owner[layer.texel] = index
    owned = covered.copy()
    owned[covered] = owner >= 0
    whose = owner[owner >= 0][nearest_texels(place, owned)] if owned.any() else np.full(len(place), -1)
    found = []
    for index, layer in enumerate(layers):
        mine, own = np.flatnonzero(whose == index), np.zeros_like(covered)
        own[covered] = np.isin(np.arange(len(owner)), layer.texel)
        # Look-ups count the layer's texels in their order on the lightmap, which need not be that of its places.
        texels = look_up(place[mine], np.arange(len(mine)), np.ones(len(mine)), len(mine), own).tocoo()
        lookup = csr_matrix((texels.data, (texels.row, np.argsort(layer.texel)[texels.col])), texels.shape)
        towards = -rays.directions[shiny[mine]].astype(np.float64)
        found.append(Shown(layer.name, shiny[mine], lookup, towards, layer.order, np.pi))
    return found


def _balls(tracer: Tracer, rays: Rays, ends: Float64[np.ndarray, " rays"], layer: Layer) -> Balls:
    """Rays that meet a probe in free air before anything else; `ends` becomes how far they go."""
    open_air = np.flatnonzero(layer.weight > 0)
    radius, eye = _radius(tracer, layer.position[open_air]), np.asarray(rays.camera.eye)
    probe = np.full(len(ends), -1)
    finer = np.array([rays.shape[1], rays.shape[0]]) * round(np.sqrt(len(ends) / (rays.shape[0] * rays.shape[1])))
    directions = rays.directions.reshape(finer[1], finer[0], 3)
    for index in open_air:
        away = layer.position[index] - eye
        depth = float(away @ rays.camera.axes[2])
        if depth <= radius:
            continue
        middle = rays.camera.project(layer.position[index][None])[0]
        half = 1.5 * radius / (depth - radius) / (2 * rays.camera.reach)
        low, high = (np.clip((middle + sign * half) * finer, 0, finer).astype(int) for sign in (-1, 1))
        box = slice(low[1], high[1] + 1), slice(low[0], high[0] + 1)
        towards = unit(directions[box].astype(np.float64))
        along = towards @ away
        under = along**2 - (away @ away - radius**2)
        distance = along - np.sqrt(np.maximum(under, 0))
        row, column = np.nonzero((under > 0) & (distance > 0))
        ray = (row + box[0].start) * finer[0] + column + box[1].start
        nearer = distance[row, column] < ends[ray]
        ray = ray[nearer]
        ends[ray], probe[ray] = distance[row, column][nearer], index
    mine = np.flatnonzero(probe >= 0)
    position = eye + ends[mine, None] * unit(rays.directions[mine].astype(np.float64))
    return Balls(mine, probe[mine], position, unit(position - layer.position[probe[mine]]))


def _radius(tracer: Tracer, position: Float[np.ndarray, "probes 3"]) -> float:
    """Of the balls, metres."""
    from scipy.spatial import cKDTree

    most = _LARGEST * tracer.radius
    if len(position) < 2:
        return most
    return min(most, _BALL * float(np.median(cKDTree(position).query(position, 2)[0][:, 1])))
