"""Light of surfaces that glow by themselves and never change: one map of irradiance, direct and all bounces, beside the pairs.

Its direct part is looked for from both sides, since neither does alone. A point of the emitters, chosen by their power, finds
small and far ones; a ray of the hemisphere finds those that a surface touches, where 1 / r² has no bound. Their densities
weigh them (balance heuristic), so no sample is worth more than pi times the radiance. What bounces is the operator's, from
senders as small as texels, which for a single lighting costs little. Where surfaces gloss it comes by paths: at each of their
vertices emitters are looked for in the same way, at glossy ones with a ray of the lobe in place of one of the hemisphere.

Reference: Veach and Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from ddprt.transport.glossiness import glossy

FEW, MOST = 16, 4096  # samples of each texel and half that tell the noise, and that are taken unasked
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
        u: Float32[np.ndarray, "n numbers"],
        lobes: Any = None,
    ) -> Float64[np.ndarray, "n 3"]:
        """One sample of their direct irradiance from either side, W/m²; its mean over `u` is exact.

        Args:
          tracer: the occluders, which the emitters are among.
          origins: of rays, off the surface (see `lifted`), centred frame, metres.
          normals: unit, geometric.
          u: uniform numbers, 4 of each; 5 where there are lobes.
          lobes: the `ddprt.transport.gloss.Lobes` of glossy surfaces; then it is pi times the radiance that they send out.
        """
        light = np.zeros((len(origins), 3))
        directions = lobes.scattered(u[:, 2:])[0] if lobes else warp.to_world(warp.sample_cosine(u[:, 2:]), warp.frame(normals))
        for found in (self.at_points(tracer, origins, u[:, :2], normals), self.along(tracer, origins, directions)):
            if lobes:
                some = lobes.part(found.which)
                worth, density = np.pi * some.reflected(found.towards), some.density(found.towards)
            else:
                cosine = found.cosine(normals)
                worth, density = np.maximum(cosine, 0)[:, None], np.maximum(cosine, 1e-300) / np.pi
            light[found.which] += found.balanced(worth, density)
        return light

    def shine(
        self, tracer: Tracer, lighting: Lighting, places: Places, rng: np.random.Generator
    ) -> Float32[np.ndarray, "places 3"]:
        """The same at places of one sample each, as `mean_irradiance` gives that of lights; `lighting` is nothing to it."""
        rows = places.blocks.swapaxes(1, 2).reshape(-1, 6)[: places.count]
        origins, normals = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:])
        return self.irradiance(tracer, origins, normals, rng.random((len(rows), 4), np.float32)).astype(np.float32)

    def at_points(
        self,
        tracer: Tracer,
        origins: Float32[np.ndarray, "n 3"],
        u: Float32[np.ndarray, "n 2"],
        normals: Float32[np.ndarray, "n 3"] | None = None,
    ) -> "Found":
        """A point of theirs for each origin, where it is seen from there; with normals, in front of these alone."""
        index, weights = sample_triangles(self.cumulative, u)
        triangle = self.triangle[index]
        a, b, c = np.moveaxis(self.corners[index], 1, 0)
        point = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)
        facing = self.scene.geometric_normals[triangle]
        away = point - origins
        there = np.einsum("nd,nd->n", away, facing) < 0
        if normals is not None:
            there &= np.einsum("nd,nd->n", away, normals) > 0
        seen = np.flatnonzero(there)
        # The ray ends as far off the emitter as it starts off the receiver, however flat it meets either.
        way = (point + tracer.offset * facing - origins)[seen]
        length = np.linalg.norm(way, axis=1)
        reach = np.maximum(length - tracer.offset / 2, 0).astype(np.float32)
        towards = np.ascontiguousarray(way / np.maximum(length, 1e-300)[:, None], np.float32)
        free = tracer.unoccluded(np.ascontiguousarray(origins[seen]), towards, reach) != 0
        seen = seen[free]
        return self._found(seen, towards[free], away[seen], triangle[seen], weights[seen].astype(np.float64))

    def along(self, tracer: Tracer, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]) -> "Found":
        """Where rays meet them."""
        hits = tracer.closest(origins, directions)
        met = np.flatnonzero(hits.front & (self.density[hits.triangle] > 0))
        there = hits.triangle[met]
        weights = np.stack([hits.u[met], hits.v[met]], 1).astype(np.float64)
        a, b, c = np.moveaxis(self.scene.corners[there] - self.scene.centre, 1, 0)
        point = a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a)
        return self._found(met, directions[met], point - origins[met], there, weights)

    def _found(
        self, which: np.ndarray, towards: np.ndarray, away: np.ndarray, triangle: np.ndarray, weights: np.ndarray
    ) -> "Found":
        squared = np.maximum(np.einsum("nd,nd->n", away, away), 1e-300)
        facing = -np.einsum("nd,nd->n", away, self.scene.geometric_normals[triangle]) / np.sqrt(squared)
        by_point = self.density[triangle] * squared / np.where(facing > 0, facing, 1)
        light = np.where(facing[:, None] > 0, self.radiance(triangle, weights), 0.0)
        return Found(which, towards, away, light, by_point)


@dataclass(frozen=True, eq=False)
class Found:
    """What some rays found of the emitters.

    Attributes:
      which: of the rays.
      towards: unit directions, world.
      away: from their origins to the emitters, metres.
      radiance: that comes from there, W/(m² sr).
      by_point: density of `at_points` there, per steradian.
    """

    which: Int[np.ndarray, " n"]
    towards: Float32[np.ndarray, "n 3"]
    away: Float64[np.ndarray, "n 3"]
    radiance: Float64[np.ndarray, "n 3"]
    by_point: Float64[np.ndarray, " n"]

    def cosine(self, normals: Float32[np.ndarray, "rays 3"]) -> Float64[np.ndarray, " n"]:
        """Between the directions and normals at the origins of all rays."""
        squared = np.maximum(np.einsum("nd,nd->n", self.away, self.away), 1e-300)
        return np.einsum("nd,nd->n", self.away, normals[self.which]) * (1 / np.sqrt(squared))

    def balanced(
        self, worth: Float[np.ndarray, "n channels"], density: Float[np.ndarray, " n"] | float
    ) -> Float64[np.ndarray, "n 3"]:
        """Worth times radiance over the densities of both sides, per steradian: `density` is that of the directions."""
        return worth / np.maximum(self.by_point + density, 1e-300)[:, None] * self.radiance


@dataclass(frozen=True, eq=False)
class Constant:
    """The light of a scene's emitters.

    Attributes:
      irradiance: W/m², the mean of two halves.
      noise: half their difference, W/m².
      direct: of the first, what comes straight from the emitters.
      facts: samples and rays of each texel, and the noise that they left.
      relative: noise over light, both RMS over the surface.
    """

    irradiance: Float32[np.ndarray, "texels 3"]
    noise: Float32[np.ndarray, "texels 3"]
    direct: Float32[np.ndarray, "texels 3"]
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
        return Constant(dark, dark, dark, {"emitters": 0}, 0.0)
    samples = FEW if config.test_samples == "auto" else max(1, config.test_samples // 2)
    direct = [straight(emitters, tracer, atlas, samples, seed, half) for half in range(2)]
    if config.test_samples == "auto":
        wanted = wanted_samples(direct, atlas.area, config.target_noise)
        if wanted > samples:
            samples = wanted
            direct = [straight(emitters, tracer, atlas, samples, seed, half) for half in range(2)]
    facts: dict[str, Any] = {"emitters": len(emitters.triangle), "direct_samples": 2 * samples}
    halves = direct
    if bounces != 0:
        if any(glossy(scene)):
            indirect, rays = _by_paths(emitters, tracer, atlas, config, seed, bounces)
        else:
            indirect, rays = _by_operator(emitters, tracer, atlas, direct, config, seed, bounces)
        facts["samples"] = rays
        halves = [one + other for one, other in zip(direct, indirect, strict=True)]
    relative = _relative(halves, atlas.area)
    facts["noise"] = float(f"{relative:.3g}")
    irradiance, noise = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
    return Constant(irradiance, noise, (direct[0] + direct[1]) / 2, facts, relative)


def wanted_samples(
    halves: Sequence[Float32[np.ndarray, "texels 3"]], area: Float64[np.ndarray, " texels"], target: float
) -> int:
    """Samples of each texel and half that a noise takes, from two halves of `FEW`."""
    return int(min(MOST, np.ceil(FEW * (_relative(halves, area) / target) ** 2)))


def straight(
    emitters: Emitters,
    tracer: Tracer,
    atlas: Atlas,
    samples: int,
    seed: int,
    half: int,
    chosen: Int[np.ndarray, " texels"] | None = None,
) -> Float32[np.ndarray, "texels 3"]:
    """Mean direct irradiance of texels: places, points and directions from one sequence, shifted for each texel."""
    sequence = warp.sobol(samples, 6, seeds.number(seed, "emission", half, samples))
    block, wanted = max(1, _BATCH // samples), np.arange(atlas.count) if chosen is None else chosen

    def work(first: int) -> Float32[np.ndarray, "some 3"]:
        texels = wanted[first : first + block]
        shift = seeds.stream(seed, "emission", half, samples, first).random((len(texels), 1, 6), np.float32)
        u = (shift + sequence).reshape(-1, 6)
        u -= u >= 1
        positions, triangle = atlas.sampler.sample(np.repeat(texels, samples), u[:, :2])
        normals = tracer.normals[triangle]
        light = emitters.irradiance(tracer, lifted(tracer, positions, normals), normals, u[:, 2:])
        return light.reshape(len(texels), samples, 3).mean(1).astype(np.float32)

    return np.concatenate(list(tracer.map(work, range(0, len(wanted), block))))


def _by_operator(
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


def along_paths(
    emitters: Emitters, tracer: Tracer, atlas: Atlas, out: Float32[np.ndarray, "lightings texels 3"], **settings: Any
) -> Iterator[int]:
    """Their mean indirect irradiance on texels, tile by tile; settings as of `ddprt.transport.paths.follow`."""
    from ddprt.transport.paths import follow

    def shading(met: Any, rng: np.random.Generator, sums: Float64[np.ndarray, "lightings receivers 3"]) -> None:
        lobes = getattr(met, "lobes", None)
        there, u = met.there if lobes else met, rng.random((len(met.owner), 4 + bool(lobes)), np.float32)
        origins, normals = (np.ascontiguousarray(part.T) for part in (met.place[:3], met.place[3:]))
        light = emitters.irradiance(tracer, origins, normals, u, lobes) * there.throughput.T
        for channel in range(3):
            sums[0, :, channel] += np.bincount(met.owner, light[:, channel], minlength=sums.shape[1])

    return follow(tracer, emitters.scene, atlas, shading, out, **settings)


def _by_paths(
    emitters: Emitters, tracer: Tracer, atlas: Atlas, config: TransportConfig, seed: int, bounces: int
) -> tuple[list[Float32[np.ndarray, "texels 3"]], float]:
    """The same without lookups, which glossy surfaces do not allow: two halves, and paths of both per texel."""
    from ddprt.transport.paths import samples_for

    tracing, address = partial(along_paths, emitters, tracer, atlas), {"seed": seed, "bounces": bounces}
    samples = config.test_samples
    if samples == "auto":
        samples, _ = samples_for(tracing, atlas, 1, target=config.target_noise, stream="emission", **address)
    each, halves = max(1, samples // 2), np.zeros((2, 1, atlas.count, 3), np.float32)
    for half, out in enumerate(halves):
        for _ in tracing(out, samples=each, stream=f"emission {half}", **address):
            pass
    return [half[0] for half in halves], float(2 * each)


def _relative(halves: Sequence[Float32[np.ndarray, "texels 3"]], area: Float64[np.ndarray, " texels"]) -> float:
    """RMS of half the difference over that of the mean, over the surface."""
    one, other = (half.astype(np.float64) for half in halves)
    noise, light = (np.einsum("t,tc->", area, part**2) for part in (one - other, one + other))
    return float(np.sqrt(noise / light)) if light > 0 else 0.0
