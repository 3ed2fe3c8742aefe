"""Unbiased path tracing of one lighting: the truth that everything else is measured against.

Next-event estimation to every light at every vertex, cosine-weighted directions, depth ended by Russian roulette alone.
Irradiance E = integral of L cos over the hemisphere = pi * mean(L) under cosine sampling, and a diffuse surface that was
hit sends L = albedo * E_hit / pi; so one path contributes the sum over its vertices of (product of albedos) * E_direct.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float32, Float64, Int, Int32
from ddprt.lights import Lighting
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import centred, direct_irradiance
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.fogginess import refuse_fog_beside
from ddprt.transport.glossiness import glossy, glossy_surfaces
from ddprt.transport.hairiness import refuse_hairy
from ddprt.transport.translucency import refuse_filled

_BATCH = 1 << 15  # paths traced together
_MAX_SURVIVAL = 0.999  # a white closed room would never let a path go; a lower cap has no finite variance above its root

Start = Callable[[Int[np.ndarray, " n"], np.random.Generator], tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]]
"""Maps receiver indices to positions (centred frame) and geometric normals."""


@dataclass(frozen=True)
class Estimate:
    """Monte Carlo means and the variance of those means, per receiver and channel, W/m² and its square."""

    direct: Float64[np.ndarray, "n 3"]
    indirect: Float64[np.ndarray, "n 3"]
    direct_variance: Float64[np.ndarray, "n 3"]
    indirect_variance: Float64[np.ndarray, "n 3"]


def trace_reference(
    tracer: Tracer,
    scene: Scene,
    lighting: Lighting,
    start: Start,
    receivers: int,
    samples: int,
    *,
    seed: int,
    bounces: int = -1,
) -> Estimate:
    """Estimates direct and indirect irradiance by independent paths.

    Args:
      tracer, scene: the geometry and its albedo.
      lighting: world space.
      start: where the paths of each receiver begin.
      receivers: how many there are.
      samples: paths per receiver, at least 1; the variance needs 2.
      seed: of the paths; equal seeds give equal bits whatever the number of threads.
      bounces: -1 follows every path to its end by roulette; otherwise at most this many.
    """
    refuse_hairy(scene, "the reference", "use transport.trace_paths")
    refuse_filled(scene, "unbiased paths")
    refuse_fog_beside(scene, any(glossy(scene)))
    lights = centred(tracer, lighting)
    foggy = import_module("ddprt.transport.fog_reference").paths if tracer.medium else None
    trace = foggy or partial(_paths, gloss=glossy_surfaces(tracer, scene))
    block = max(1, _BATCH // samples)
    rounds = -(-samples // _BATCH)

    def work(first: int) -> tuple[np.ndarray, np.ndarray]:
        count = min(block, receivers - first)
        sums, squares = np.zeros((2, count, 2, 3))
        for turn in range(rounds):
            rng = seeds.stream(seed, "reference", first, turn)
            paths = min(_BATCH, samples - turn * _BATCH)
            index = np.repeat(np.arange(first, first + count), paths)
            values = np.stack(trace(tracer, scene, lights, start(index, rng), rng, bounces), 1)
            values = values.reshape(count, paths, 2, 3).astype(np.float64)
            sums += values.sum(1)
            squares += (values**2).sum(1)
        return sums, squares

    results = list(tracer.map(work, range(0, receivers, block)))
    sums, squares = (np.concatenate(parts) for parts in zip(*results, strict=True))
    mean = sums / samples
    spread = np.maximum(squares / samples - mean**2, 0) / max(samples - 1, 1)
    return Estimate(mean[:, 0], mean[:, 1], spread[:, 0], spread[:, 1])


def _paths(
    tracer: Tracer,
    scene: Scene,
    lights: Lighting,
    start: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
    bounces: int,
    gloss: Any,
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Direct and indirect contribution of one path each."""
    positions, normals = start
    direct = direct_irradiance(tracer, lights, positions, normals, _numbers(rng, len(lights), len(positions)))
    indirect = np.zeros_like(direct)
    alive = np.arange(len(positions))
    throughput = np.ones_like(direct)
    depth, shiny, lobes = 0, np.zeros(0, np.intp), None
    while len(alive) and depth != bounces:
        frames = warp.frame(normals)
        directions = warp.to_world(warp.sample_cosine(rng.random((len(alive), 2), np.float32)), frames)
        if lobes:
            directions[shiny], weight = lobes.scattered(rng.random((len(shiny), 3), np.float32))
        hits = tracer.closest(lifted(tracer, positions, normals), directions)
        albedo = _albedo(scene, hits.triangle, hits.u, hits.v)
        if gloss:
            albedo[gloss.shiny[hits.triangle]] = 1  # what it reflects is told by direction, below
        if lobes:
            albedo[shiny] *= weight
        survival = np.minimum(albedo.max(1), _MAX_SURVIVAL)
        keep = np.flatnonzero(hits.front & (rng.random(len(alive), np.float32) < survival))
        alive, triangle = alive[keep], hits.triangle[keep]
        throughput = throughput[keep] * albedo[keep] / survival[keep, None]
        normals = tracer.normals[triangle]
        positions = tracer.on_triangle(triangle, hits.u[keep], hits.v[keep])
        numbers = _numbers(rng, len(lights), len(alive))
        light = direct_irradiance(tracer, lights, positions, normals, numbers)
        if gloss:
            shiny = np.flatnonzero(gloss.shiny[triangle])
            where = triangle[shiny], hits.u[keep][shiny], hits.v[keep][shiny]
            lobes = gloss.lobes(*where, directions[keep][shiny]) if len(shiny) else None
        if lobes:
            light[shiny] = reflected(tracer, lights, positions[shiny], normals[shiny], lobes, numbers[:, shiny])
        indirect[alive] += throughput * light
        depth += 1
    return direct, indirect


def reflected(
    tracer: Tracer,
    lights: Lighting,
    positions: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    lobes: Any,
    u: Float32[np.ndarray, "lights n 2"],
) -> Float32[np.ndarray, "n 3"]:
    """Pi times the radiance that lobes send out of one sample of every light: what a diffuse surface's radiosity would be."""
    total, origins = np.zeros_like(positions), lifted(tracer, positions, normals)
    for light, numbers in zip(lights, u, strict=True):
        sample = light.illuminate(origins, numbers, None, normals)
        directions = np.ascontiguousarray(sample.direction)
        reach = np.maximum(sample.distance - tracer.offset, 0)
        seen = tracer.unoccluded(origins, directions, reach) != 0
        cosine = np.einsum("nd,nd->n", normals, directions)
        lit = np.flatnonzero(seen & (cosine > 0))
        total[lit] += np.pi * lobes.reflected(directions)[lit] * sample.irradiance[lit]
    return total


def _numbers(rng: np.random.Generator, lights: int, count: int) -> Float32[np.ndarray, "lights n 2"]:
    return rng.random((lights, count, 2), np.float32)


def _albedo(scene: Scene, triangle: Int32[np.ndarray, " n"], u: np.ndarray, v: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    weights = np.stack([1 - u - v, u, v], 1)
    return scene.albedo_at(triangle, weights).astype(np.float32)


def on_texels(tracer: Tracer, atlas: Atlas, texels: Int[np.ndarray, " receivers"]) -> Start:
    """Paths that begin anywhere in a texel, uniform by area: the estimate is the texel's mean irradiance."""

    def start(index: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        positions, triangle = atlas.sampler.sample(texels[index], rng.random((len(index), 2), np.float32))
        return positions, tracer.normals[triangle]

    return start


def on_points(
    tracer: Tracer, positions: Float64[np.ndarray, "receivers 3"], normals: Float64[np.ndarray, "receivers 3"]
) -> Start:
    """Paths that begin at given world-space points."""
    local, facing = (positions - tracer.centre).astype(np.float32), normals.astype(np.float32)
    return lambda index, rng: (local[index], facing[index])
