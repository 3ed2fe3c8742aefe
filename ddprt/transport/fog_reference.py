"""The yardstick in fog: one path for one lighting, in double precision, by other means than the bake's.

A path keeps to one channel, drawn when it begins, and weighs all three by the chance that each of them had to draw the whole
path (Wilkie et al., "Hero Wavelength Spectral Sampling", 2014). Lamps are asked for their light at one place on each stretch of
fog, drawn by the angle that they see it under alone, or by the path's channel where they are far away.
"""

from dataclasses import dataclass

import numpy as np

from ddprt import warp
from ddprt.axes import Bool, Float32, Float64, Int
from ddprt.lights import Light, Lighting
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import direct_irradiance
from ddprt.transport.embree import Hits, Tracer, lifted

_MAX_SURVIVAL = 0.999  # as that of the reference without fog
_BEAM = 1e-9  # of a stretch: nearer to a ray, a lamp counts as so far from it


@dataclass(eq=False)
class _Paths:
    """Paths on their way.

    Attributes:
      index: of each among all.
      hero: its channel.
      origins, ways: its ray.
      throughput: of surfaces and fog that it met, per channel.
      density: of the whole path in each channel, over that of its draw.
    """

    index: Int[np.ndarray, " n"]
    hero: Int[np.ndarray, " n"]
    origins: Float32[np.ndarray, "n 3"]
    ways: Float32[np.ndarray, "n 3"]
    throughput: Float64[np.ndarray, "n 3"]
    density: Float64[np.ndarray, "n 3"]

    def only(self, kept: Int[np.ndarray, " kept"]) -> "_Paths":
        """Some of them."""
        return _Paths(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))


def paths(
    tracer: Tracer,
    scene: Scene,
    lights: Lighting,
    start: tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]],
    rng: np.random.Generator,
    bounces: int,
) -> tuple[Float32[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Direct and indirect irradiance of one path each.

    Args:
      tracer, scene: the geometry with its fog, and its albedo.
      lights: in the tracer's frame, behind the fog.
      start: positions and normals, likewise.
      rng: of these paths.
      bounces: meetings with surfaces and fog at most; -1 for as many as roulette lets be.
    """
    positions, normals = start
    fog, count = tracer.medium, len(positions)
    direct = _light_on(tracer, lights, positions, normals, rng)
    ways = _from_surface(normals, rng)
    ones, indirect = np.ones((count, 3)), np.zeros((count, 3))
    now = _Paths(np.arange(count), rng.integers(0, 3, count), lifted(tracer, positions, normals), ways, ones, ones.copy())
    depth = 0
    while len(now.index) and depth != bounces:
        hits = tracer.closest(now.origins, now.ways)
        near, far = stretch(fog.half, now.origins, now.ways, np.where(hits.triangle >= 0, hits.distance.astype(float), np.inf))
        for light in lights:
            indirect[now.index] += _from_air(tracer, light, now, near, far, rng)
        flight = near - np.log1p(-rng.random(len(near))) / fog.extinction[now.hero]
        airy, flown = flight < far, np.minimum(flight, far) - near
        now.density *= np.where(airy[:, None], fog.extinction, 1) * np.exp(-fog.extinction * flown[:, None])
        now.density /= now.density.mean(1, keepdims=True)
        albedo = scene.albedo_at(hits.triangle, np.stack([1 - hits.u - hits.v, hits.u, hits.v], 1))
        albedo = np.where(airy[:, None], fog.albedo, albedo)
        survival = np.minimum(albedo.max(1), _MAX_SURVIVAL)
        kept = np.flatnonzero((airy | hits.front) & (rng.random(len(near)) < survival))
        now.throughput = now.throughput * albedo / np.maximum(survival, 1e-300)[:, None]
        now = now.only(kept)
        _turn(tracer, now, hits, kept, airy[kept], flight[kept], rng)
        wall = np.flatnonzero(~airy[kept])
        if len(wall):
            at, facing = _place(tracer, hits, kept[wall]), tracer.normals[hits.triangle[kept[wall]]]
            light_there = _light_on(tracer, lights, at, facing, rng)
            indirect[now.index[wall]] += now.throughput[wall] * now.density[wall] * light_there
        depth += 1
    return direct, indirect


def stretch(
    half: Float64[np.ndarray, "3"],
    origins: Float32[np.ndarray, "n 3"],
    ways: Float32[np.ndarray, "n 3"],
    reach: Float64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """From where to where rays of a length are in a box about the origin, metres; equal where they are not."""
    place, way = origins.astype(np.float64), ways.astype(np.float64)
    way = np.where(way == 0, 1e-30, way)
    sides = np.stack([(-half - place) / way, (half - place) / way])
    near = np.maximum(sides.min(0).max(1), 0)
    return near, np.maximum(np.minimum(sides.max(0).min(1), reach), near)


def turned(ways: Float32[np.ndarray, "n 3"], anisotropy: float, rng: np.random.Generator) -> Float32[np.ndarray, "n 3"]:
    """Ways on, drawn by Henyey and Greenstein's phase function."""
    g, (u, turn) = anisotropy, rng.random((2, len(ways)))
    cosine = 1 - 2 * u
    if g:
        cosine = (1 + g * g - ((1 - g * g) / (1 + g * cosine)) ** 2) / (2 * g)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    local = np.stack([sine * np.cos(2 * np.pi * turn), sine * np.sin(2 * np.pi * turn), cosine], 1)
    return warp.to_world(local.astype(np.float32), warp.frame(ways))


def _from_air(
    tracer: Tracer,
    light: Light,
    now: _Paths,
    near: Float64[np.ndarray, " n"],
    far: Float64[np.ndarray, " n"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "n 3"]:
    """Pi times the radiance that one light scatters into each ray."""
    fog, (u, *numbers) = tracer.medium, rng.random((3, len(near)))
    length, anchor = np.maximum(far - near, 1e-300), light.anchor()
    if anchor is None:
        own = fog.extinction[now.hero]
        along = near - np.log1p(u * np.expm1(-own * length)) / own
        spread = (
            fog.extinction * np.exp(-fog.extinction * (along - near)[:, None]) / -np.expm1(-fog.extinction * length[:, None])
        )
        odds = (now.density * spread).mean(1)
    else:
        off = anchor - now.origins
        foot = np.einsum("nd,nd->n", off, now.ways)
        beside = np.maximum(np.linalg.norm(off - foot[:, None] * now.ways, axis=1), _BEAM * length)
        low, high = np.arctan((near - foot) / beside), np.arctan((far - foot) / beside)
        along = np.clip(foot + beside * np.tan(low + u * (high - low)), near, far)
        odds = now.density.mean(1) * beside / ((beside**2 + (along - foot) ** 2) * np.maximum(high - low, 1e-300))
    places = (now.origins + along[:, None] * now.ways).astype(np.float32)
    sample = light.illuminate(places, np.stack(numbers, 1).astype(np.float32))
    towards = np.ascontiguousarray(sample.direction)
    short = np.maximum(sample.distance - tracer.offset, 0).astype(np.float32)
    seen = (tracer.unoccluded(places, towards, short) != 0) & (far > near)
    cosine = np.einsum("nd,nd->n", towards, now.ways).astype(np.float64)
    phase = (1 - fog.anisotropy**2) / (4 * np.pi * (1 + fog.anisotropy**2 - 2 * fog.anisotropy * cosine) ** 1.5)
    arrives = fog.extinction * fog.albedo * np.exp(-fog.extinction * (along - near)[:, None]) * sample.irradiance
    found = np.pi * now.throughput * now.density * arrives * (phase / odds)[:, None]
    return np.where(seen[:, None], found, 0.0)


def _turn(
    tracer: Tracer,
    now: _Paths,
    hits: Hits,
    kept: Int[np.ndarray, " n"],
    airy: Bool[np.ndarray, " n"],
    flight: Float64[np.ndarray, " n"],
    rng: np.random.Generator,
) -> None:
    """New rays from where paths met fog or a wall."""
    air, wall = np.flatnonzero(airy), np.flatnonzero(~airy)
    now.origins[air] += (flight[air, None] * now.ways[air]).astype(np.float32)
    now.ways[air] = turned(now.ways[air], tracer.medium.anisotropy, rng)
    normals = tracer.normals[hits.triangle[kept[wall]]]
    now.origins[wall] = lifted(tracer, _place(tracer, hits, kept[wall]), normals)
    now.ways[wall] = _from_surface(normals, rng)


def _place(tracer: Tracer, hits: Hits, some: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3"]:
    return tracer.on_triangle(hits.triangle[some], hits.u[some], hits.v[some])


def _from_surface(normals: Float32[np.ndarray, "n 3"], rng: np.random.Generator) -> Float32[np.ndarray, "n 3"]:
    return warp.to_world(warp.sample_cosine(rng.random((len(normals), 2), np.float32)), warp.frame(normals))


def _light_on(
    tracer: Tracer,
    lights: Lighting,
    positions: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "n 3"]:
    numbers = rng.random((len(lights), len(positions), 2), np.float32)
    return direct_irradiance(tracer, lights, positions, normals, numbers)
