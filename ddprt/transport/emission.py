"""Light of surfaces that glow by themselves and never change: one map of irradiance, direct and all bounces, beside the pairs.

Its direct part is looked for from both sides, since neither does alone. A point of the emitters, chosen by their power, finds
small and far ones; a ray of the hemisphere finds those that a surface touches, where 1 / r² has no bound. Their densities
weigh them (balance heuristic), so no sample is worth more than pi times the radiance. What bounces is the operator's, from
senders as small as texels, which for a single lighting costs little.

Reference: Veach and Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float, Float32, Float64, Int
from ddprt.lights import Lighting
from ddprt.lights.mesh import cumulated, pdf_triangles, sample_triangles
from ddprt.scene.atlas import Atlas
from ddprt.scene.material import bilinear
from ddprt.scene.mesh import Scene
from ddprt.sections import TransportConfig
from ddprt.transport.direct import Places
from ddprt.transport.embree import Tracer, lifted

_FEW, _MOST = 16, 4096  # samples of each texel and half that tell the noise, and that are taken unasked
_BATCH = 1 << 15  # samples that go through together
_LOOKED_UP = 64  # places of a textured triangle that tell its power
_FAINTEST = 1 / 64  # of the power that the brightest of its texels would give it: what lies between those places


@dataclass(frozen=True, eq=False)
class Emitters:
    """The triangles of a scene that glow.

    Attributes:
      scene: theirs.
      triangle: of the scene.
      corners: relative to the scene's centre, metres.
      cumulative: power of the triangles up to and with each, as a share of all.
      density: of a chosen point, per m², on each triangle of the scene; 0 where none is chosen.
    """

    scene: Scene
    triangle: Int[np.ndarray, " glowing"]
    corners: Float64[np.ndarray, "glowing 3 3"]
    cumulative: Float64[np.ndarray, " glowing"]
    density: Float64[np.ndarray, " triangles"]

    @classmethod
    def of(cls, scene: Scene) -> "Emitters":
        """Those of a scene, which may have none."""
        base = np.array([entry.emission.radiance if entry.emission else (0, 0, 0) for entry in scene.materials], float)
        triangle = np.flatnonzero(base.max(1)[scene.material] > 0)
        none = cls(scene, triangle, scene.corners[triangle] - scene.centre, np.ones(len(triangle)), np.zeros(len(scene.areas)))
        shares = none._powers(base)
        if not shares.any():
            return replace(none, triangle=triangle[:0], corners=none.corners[:0], cumulative=none.cumulative[:0])
        some = shares > 0
        triangle, cumulative = triangle[some], cumulated(shares[some])
        density = none.density.copy()
        density[triangle] = pdf_triangles(cumulative, scene.areas[triangle])
        return cls(scene, triangle, none.corners[some], cumulative, density)

    def _powers(self, base: Float64[np.ndarray, "materials 3"]) -> Float64[np.ndarray, " glowing"]:
        """Area times radiance, mean over the channels; of textures a mean over some places, and never quite nothing."""
        powers = self.scene.areas[self.triangle] * base[self.scene.material[self.triangle]].mean(1)
        places = warp.sample_triangle(warp.sobol(_LOOKED_UP, 2, seed=0))
        for index, entry in enumerate(self.scene.materials):
            chosen = np.flatnonzero(self.scene.material[self.triangle] == index)
            if entry.emission and entry.emission.texture is not None and len(chosen):
                light = np.mean(
                    [self.radiance(self.triangle[chosen], np.tile(place, (len(chosen), 1))).mean(1) for place in places], axis=0
                )
                floor = _FAINTEST * base[index].mean() * float(entry.emission.texture.max())
                powers[chosen] = self.scene.areas[self.triangle[chosen]] * np.maximum(light, floor)
        return powers

    def radiance(self, triangle: Int[np.ndarray, " n"], weights: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """What leaves the fronts of triangles, by weights of their second and third corner; nothing where they have holes."""
        material = self.scene.material[triangle]
        light = np.array([entry.emission.radiance if entry.emission else (0, 0, 0) for entry in self.scene.materials], float)
        light = light[material]
        for index, entry in enumerate(self.scene.materials):
            texture = entry.emission.texture if entry.emission else None
            if not entry.emission or (texture is None and entry.cutout is None):
                continue
            chosen = np.flatnonzero(material == index)
            uv = self.scene.uv_at(triangle[chosen], np.column_stack([1 - weights[chosen].sum(1), weights[chosen]]))
            if texture is not None:
                light[chosen] *= bilinear(texture, uv)
            if entry.cutout is not None:
                light[chosen[bilinear(entry.cutout.opacity, uv) < entry.cutout.cutoff]] = 0
        return light

    def irradiance(
        self,
        tracer: Tracer,
        origins: Float32[np.ndarray, "n 3"],
        normals: Float32[np.ndarray, "n 3"],
        u: Float32[np.ndarray, "n 4"],
    ) -> Float64[np.ndarray, "n 3"]:
        """One sample of their direct irradiance from either side, W/m²; its mean over `u` is exact.

        Args:
          tracer: the occluders, which the emitters are among.
          origins: of rays, off the surface (see `lifted`), centred frame, metres.
          normals: unit, geometric.
          u: uniform numbers.
        """
        light = np.zeros((len(origins), 3))
        self._chosen_points(tracer, origins, normals, u[:, :2], light)
        self._chosen_directions(tracer, origins, normals, u[:, 2:], light)
        return light

    def shine(
        self, tracer: Tracer, lighting: Lighting, places: Places, rng: np.random.Generator
    ) -> Float32[np.ndarray, "places 3"]:
        """The same at places of one sample each, as `mean_irradiance` gives that of lights; `lighting` is nothing to it."""
        rows = places.blocks.swapaxes(1, 2).reshape(-1, 6)[: places.count]
        origins, normals = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:])
        return self.irradiance(tracer, origins, normals, rng.random((len(rows), 4), np.float32)).astype(np.float32)

    def _chosen_points(
        self, tracer: Tracer, origins: np.ndarray, normals: np.ndarray, u: np.ndarray, light: Float64[np.ndarray, "n 3"]
    ) -> None:
        """Adds what comes from points of the emitters, one for each origin."""
        index, weights = sample_triangles(self.cumulative, u)
        triangle = self.triangle[index]
        a, b, c = np.moveaxis(self.corners[index], 1, 0)
        point = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)
        facing = self.scene.geometric_normals[triangle]
        squared, cosine, their_cosine = _facing(origins, normals, point, facing)
        seen = np.flatnonzero((cosine > 0) & (their_cosine > 0))
        # The ray ends as far off the emitter as it starts off the receiver, however flat it meets either.
        way = (point + tracer.offset * facing - origins)[seen]
        length = np.linalg.norm(way, axis=1)
        reach = np.maximum(length - tracer.offset / 2, 0).astype(np.float32)
        towards = np.ascontiguousarray(way / np.maximum(length, 1e-300)[:, None], np.float32)
        seen = seen[tracer.unoccluded(np.ascontiguousarray(origins[seen]), towards, reach) != 0]
        weight = _balanced(cosine[seen], their_cosine[seen], squared[seen], self.density[triangle[seen]])
        light[seen] += weight[:, None] * self.radiance(triangle[seen], weights[seen].astype(np.float64))

    def _chosen_directions(
        self, tracer: Tracer, origins: np.ndarray, normals: np.ndarray, u: np.ndarray, light: Float64[np.ndarray, "n 3"]
    ) -> None:
        """Adds what comes along cosine-weighted directions, one for each origin."""
        directions = warp.to_world(warp.sample_cosine(u), warp.frame(normals))
        hits = tracer.closest(origins, directions)
        met = np.flatnonzero(hits.front & (self.density[hits.triangle] > 0))
        there = hits.triangle[met]
        weights = np.stack([hits.u[met], hits.v[met]], 1).astype(np.float64)
        a, b, c = np.moveaxis(self.scene.corners[there] - self.scene.centre, 1, 0)
        point = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)
        squared, cosine, their_cosine = _facing(origins[met], normals[met], point, self.scene.geometric_normals[there])
        weight = _balanced(cosine, their_cosine, squared, self.density[there])
        light[met] += weight[:, None] * self.radiance(there, weights)


@dataclass(frozen=True, eq=False)
class Constant:
    """The light of a scene's emitters.

    Attributes:
      irradiance: W/m², the mean of two halves.
      noise: half their difference, W/m².
      facts: samples and rays of each texel, and the noise that they left.
      relative: noise over light, both RMS over the surface.
    """

    irradiance: Float32[np.ndarray, "texels 3"]
    noise: Float32[np.ndarray, "texels 3"]
    facts: dict[str, Any]
    relative: float


def constant_light(
    scene: Scene, tracer: Tracer, atlas: Atlas, config: TransportConfig, *, seed: int, bounces: int = -1
) -> Constant:
    """Irradiance of all emitters on every texel, direct and indirect, in two independent halves.

    Args:
      scene, tracer, atlas: what glows, what occludes, what is lit.
      config: rays of held-out maps, or the noise to aim at.
      seed: of all random numbers.
      bounces: of the plan: -1 until nothing is left, 0 none.
    """
    emitters = Emitters.of(scene)
    if len(emitters.triangle) == 0:
        dark = np.zeros((atlas.count, 3), np.float32)
        return Constant(dark, dark, {"emitters": 0}, 0.0)
    samples = _FEW if config.test_samples == "auto" else max(1, config.test_samples // 2)
    direct = [_direct(emitters, tracer, atlas, samples, seed, half) for half in range(2)]
    if config.test_samples == "auto":
        wanted = int(min(_MOST, np.ceil(_FEW * (_relative(direct, atlas) / config.target_noise) ** 2)))
        if wanted > samples:
            samples = wanted
            direct = [_direct(emitters, tracer, atlas, samples, seed, half) for half in range(2)]
    facts: dict[str, Any] = {"emitters": len(emitters.triangle), "direct_samples": 2 * samples}
    halves = direct
    if bounces != 0:
        indirect, rays = _indirect(emitters, tracer, atlas, direct, config, seed, bounces)
        facts["samples"] = rays
        halves = [one + other for one, other in zip(direct, indirect, strict=True)]
    relative = _relative(halves, atlas)
    facts["noise"] = float(f"{relative:.3g}")
    irradiance, noise = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
    return Constant(irradiance, noise, facts, relative)


def _direct(
    emitters: Emitters, tracer: Tracer, atlas: Atlas, samples: int, seed: int, half: int
) -> Float32[np.ndarray, "texels 3"]:
    """Mean direct irradiance of each texel: places, points and directions from one sequence, shifted for each texel."""
    sequence = warp.sobol(samples, 6, seeds.number(seed, "emission", half, samples))
    block = max(1, _BATCH // samples)

    def work(first: int) -> Float32[np.ndarray, "some 3"]:
        texels = np.arange(first, min(first + block, atlas.count))
        shift = seeds.stream(seed, "emission", half, samples, first).random((len(texels), 1, 6), np.float32)
        u = (shift + sequence).reshape(-1, 6)
        u -= u >= 1
        positions, triangle = atlas.sampler.sample(np.repeat(texels, samples), u[:, :2])
        normals = tracer.normals[triangle]
        light = emitters.irradiance(tracer, lifted(tracer, positions, normals), normals, u[:, 2:])
        return light.reshape(len(texels), samples, 3).mean(1).astype(np.float32)

    return np.concatenate(list(tracer.map(work, range(0, atlas.count, block))))


def _indirect(
    emitters: Emitters,
    tracer: Tracer,
    atlas: Atlas,
    direct: list[Float32[np.ndarray, "texels 3"]],
    config: TransportConfig,
    seed: int,
    bounces: int,
) -> tuple[list[Float32[np.ndarray, "texels 3"]], float]:
    """What each half's direct light bounces on to, and gather rays of both per texel."""
    from ddprt.transport.effort import choose_rays
    from ddprt.transport.operator import Operator

    operator = Operator.of(tracer, atlas, atlas.resolution)
    found, rays = [], np.zeros(0, np.int64)
    for half, light in enumerate(direct):
        address: dict[str, Any] = {"seed": seed, "stream": f"emission {half}"}
        averaged = operator.averaged(light)
        radiosity = operator.bounce(averaged, **address, bounces=bounces).radiosity
        near = replace(operator.near([()], averaged, bounces=bounces), shine=emitters.shine)
        if half == 0:
            rays = choose_rays(operator, radiosity, config, near=near, held_out=True, **address).rays
        out = np.zeros((1, atlas.count, 3), np.float32)
        for _ in operator.gather(radiosity, out, rays, near=near, **address):
            pass
        found.append(out[0])
    return found, float(2 * np.mean(rays))


def _facing(
    origins: np.ndarray, normals: np.ndarray, points: np.ndarray, facing: np.ndarray
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Squared distances of pairs, and the cosines at both ends; the second ends must not touch the first."""
    away = points - origins
    squared = np.maximum(np.einsum("nd,nd->n", away, away), 1e-300)
    inverse = 1 / np.sqrt(squared)
    return squared, np.einsum("nd,nd->n", away, normals) * inverse, -np.einsum("nd,nd->n", away, facing) * inverse


def _balanced(
    cosine: Float64[np.ndarray, " n"],
    their_cosine: Float64[np.ndarray, " n"],
    squared: Float64[np.ndarray, " n"],
    density: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, " n"]:
    """cosine / (density of points + density of directions, both per steradian); nothing where a side is not met."""
    towards = their_cosine > 0
    by_point = density * squared / np.where(towards, their_cosine, 1)
    return np.where(towards & (cosine > 0), cosine / (by_point + np.maximum(cosine, 1e-300) / np.pi), 0.0)


def _relative(halves: list[Float32[np.ndarray, "texels 3"]], atlas: Atlas) -> float:
    """RMS of half the difference over that of the mean, over the surface."""
    one, other = (half.astype(np.float64) for half in halves)
    noise, light = (np.einsum("t,tc->", atlas.area, part**2) for part in (one - other, one + other))
    return float(np.sqrt(noise / light)) if light > 0 else 0.0
