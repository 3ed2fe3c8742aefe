"""What glossy surfaces send out, towards every direction: harmonics of exitant indirect radiance, texel by texel.

An eye sees radiance that leaves a surface towards it, L(o) = integral of f(o, i) cos(i) L(i), lobe and diffuse part together.
It lives on a hemisphere. Mirrored at the surface's plane it becomes a function on the sphere, continuous at the horizon, whose
harmonics ring little; in the surface's own frame those with odd l + m vanish. Coefficients are c_k = integral over the
hemisphere of (Y_k(o) + Y_k(mirrored o)) L(o): linear in light, so that basis and transfer hold for them as for texels.

What a surface shows is what is there to be seen: see `ddprt.transport.reflected`. What is blurred there by the width of a texel
would be blurred by the harmonics all the more.

Each ray is drawn for a direction o of its own, spread evenly over the hemisphere, and by the lobe about it; what it finds then
counts for all directions of its group. With rays i_p that are drawn for o_p, the sum over p of

    L(i_p) * [sum over j of (Y_k(o_j) + ...) f(o_j, i_p) cos(i_p)] / [sum over j of pdf(i_p given o_j)]

is what the balance heuristic (Veach and Guibas 1995) makes of as many techniques as there are directions, and so unbiased.
The rougher a surface, the more directions what a ray found is good for.

How many harmonics a lobe needs follows from its width: see `order_for`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import k1

from ddprt import harmonics, seeds, warp
from ddprt.axes import Float32, Float64, Int, Int32
from ddprt.scene.atlas import Atlas, SurfaceSampler, weights_at
from ddprt.scene.material import Gloss
from ddprt.scene.mesh import Scene
from ddprt.transport import ggx
from ddprt.transport.embree import lifted
from ddprt.transport.gloss import Surfaces
from ddprt.transport.glossiness import glossy, least_roughness
from ddprt.transport.reflected import Lit

ORDERS = (4, 6, 8)
"""Orders that layers have: few, so that surfaces of about equal roughness share one. Order 2 would do for the blur of the
roughest, but not for how they change towards the horizon: a metal of roughness 1 would look 39 % too dark from above."""

KEPT = 0.2
"""Least attenuation of a harmonic that is worth keeping; see `order_for`."""

_GROUP = 32  # rays that count for each other's directions
_CALL = 1 << 12  # rays that are traced together
_PLACES = 16  # that are traced together: sums of all lightings take much room
PROBED, _PILOT = 128, 64  # texels, and rays of each in two independent runs, that predict how many are needed
_LEAST, _MOST = 8, 8192  # rays per texel that "auto" may choose


def order_for(roughness: float) -> int:
    """The order that a lobe is worth: the least of `ORDERS` above which harmonics are attenuated below `KEPT`.

    Seen along the normal a GGX lobe is (1 + (t / 2 alpha)²)^-2 at an angle t from the mirrored direction, alpha = roughness²,
    since directions turn by twice as much as facets. On the plane its Fourier transform at wave number l is x K1(x),
    x = 2 alpha l, with the modified Bessel function K1: so much of degree l of the light that arrives is left in what leaves.
    """
    for order in ORDERS[:-1]:
        x = 2 * max(roughness, ggx.SMOOTHEST) ** 2 * (order + 1)
        if x * k1(x) < KEPT:
            return order
    return ORDERS[-1]


def orders(scene: Scene) -> dict[int, tuple[int, ...]]:
    """Orders that a scene's glossy materials need, rising, and the indices of these materials."""
    found: dict[int, list[int]] = {}
    for index, chosen in enumerate(glossy(scene)):
        part = scene.materials[index].gloss
        if chosen and isinstance(part, Gloss):
            found.setdefault(order_for(least_roughness(part)), []).append(index)
    return {order: tuple(found[order]) for order in sorted(found)}


@dataclass(frozen=True, eq=False)
class Exits:
    """Where the glossy surfaces of an order lie on an atlas: texels that hold some of them.

    Attributes:
      order: of the harmonics.
      texel: of the atlas.
      weight: m² of these surfaces in each texel.
      sampler: points on them alone, also where a texel holds others too; a group for each texel.
    """

    order: int
    texel: Int[np.ndarray, " places"]
    weight: Float64[np.ndarray, " places"]
    sampler: SurfaceSampler | None

    @classmethod
    def of(cls, scene: Scene, atlas: Atlas, order: int) -> "Exits":
        """Those of the materials that need an order; no places where none of them is in the open."""
        pieces = np.flatnonzero(np.isin(scene.material[atlas.piece_triangle], orders(scene)[order]) & (atlas.piece_area > 0))
        texel, group = np.unique(atlas.piece_texel[pieces], return_inverse=True)
        area = atlas.piece_area[pieces]
        place = group, area, atlas.piece_corners[pieces], atlas.piece_triangle[pieces]
        return cls(
            order, texel, np.bincount(group, area).astype(np.float64), SurfaceSampler.build(*place) if len(pieces) else None
        )

    @property
    def count(self) -> int:
        """How many texels."""
        return len(self.texel)


@dataclass(frozen=True, eq=False)
class Departures:
    """Rays that leave glossy surfaces, and what each is drawn for.

    Attributes:
      origins: centred frame, metres.
      triangle: that each starts on.
      outgoing, incoming: unit directions in the triangle's frame: where light is asked for, and where the ray looks for it.
      base, gloss: of the surface there; see `ggx.evaluate`.
    """

    origins: Float32[np.ndarray, "rays 3"]
    triangle: Int32[np.ndarray, " rays"]
    outgoing: Float32[np.ndarray, "rays 3"]
    incoming: Float32[np.ndarray, "rays 3"]
    base: Float32[np.ndarray, "rays 3"]
    gloss: Float32[np.ndarray, "rays 3"]

    @classmethod
    def of(
        cls, surfaces: Surfaces, sampler: SurfaceSampler, group: Int[np.ndarray, " rays"], u: Float32[np.ndarray, "rays 7"]
    ) -> "Departures":
        """One ray of each group: two numbers for its place, two for where light goes, three for where it comes from."""
        tracer = surfaces.tracer
        positions, triangle = sampler.sample(group, np.ascontiguousarray(u[:, :2]))
        weights = weights_at(tracer.corners[triangle].astype(np.float64), positions.astype(np.float64)).astype(np.float32)
        outgoing = warp.sample_cone(np.ascontiguousarray(u[:, 2:4]), 1.0)
        base, gloss = surfaces.finish(triangle, weights[:, 1], weights[:, 2])
        incoming, _ = ggx.sample(outgoing, np.ascontiguousarray(u[:, 4:]), base, gloss)
        origins = lifted(tracer, positions, tracer.normals[triangle]).astype(np.float32)
        return cls(origins, triangle, outgoing, incoming, base, gloss)


def trace_exitant(
    lit: Lit,
    exits: Exits,
    out: Float32[np.ndarray, "lightings entries 3"],
    *,
    samples: int,
    seed: int,
    stream: str,
    skip: int = 0,
    chosen: Int[np.ndarray, " chosen"] | None = None,
) -> Iterator[int]:
    """Coefficients of exitant indirect radiance of all places for every lighting, tile by tile.

    Equal seeds and streams give equal bits, whatever the number of threads and whatever else is in the batch.

    Args:
      lit, exits: the scene, its lightings, and the places.
      out: written in place, W/(m² sr), (order + 1)² entries for each place that is wanted; may lie on disk.
      samples: rays per place.
      seed, stream: address of the random numbers; another stream gives independent noise.
      skip: tiles that `out` holds already.
      chosen: the places that are wanted; None for all.
    Yields:
      The number of places of each finished tile, in order, the skipped ones included.
    """
    places = np.arange(exits.count) if chosen is None else chosen
    step = max(1, min(_CALL // samples, _PLACES))

    def work(first: int) -> int:
        tile = places[first : first + step]
        if first // step >= skip:
            address = *stream.encode(), samples, int(tile[0])
            sums = _tile(lit, exits, tile, samples, seed, address)
            count = harmonics.count(exits.order)
            with np.errstate(over="ignore"):  # what is not finite is refused where light is stored
                out[:, first * count : (first + len(tile)) * count] = sums.reshape(len(sums), -1, 3)
        return len(tile)

    yield from lit.surfaces.tracer.map(work, range(0, len(places), step))


def _tile(
    lit: Lit, exits: Exits, tile: np.ndarray, samples: int, seed: int, address: tuple[int, ...]
) -> Float64[np.ndarray, "lightings places harmonics 3"]:
    """Coefficients of a few places, in world space."""
    assert exits.sampler is not None
    tracer, count = lit.surfaces.tracer, samples * len(tile)
    u = warp.sobol(count, 7, seeds.number(seed, "exitant pattern", *address))
    walk, chance = (seeds.stream(seed, name, *address) for name in ("exitant walk", "exitant lights"))
    paths = Departures.of(lit.surfaces, exits.sampler, np.repeat(tile, samples), u)
    directions = warp.to_world(paths.incoming, tracer.frames[paths.triangle])
    edges = np.append((samples * np.arange(len(tile))[:, None] + np.arange(0, samples, _GROUP)).ravel(), count)
    group = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    Y = (mirrored(paths.outgoing, exits.order) * (2 * np.pi / samples)).astype(np.float32)  # uniform over the hemisphere
    place = np.repeat(np.arange(len(tile)), samples)
    slots, slot = np.unique(np.stack([place, paths.triangle], 1), axis=0, return_inverse=True)  # in a frame each
    sums = np.zeros((len(slots), Y.shape[1], 3, lit.irradiance.shape[2]))
    for first in range(0, count, _CALL):
        part = slice(first, min(first + _CALL, count))
        shared = np.stack([edges[group[part]], edges[group[part] + 1]], 1)
        worth = ggx.shared(paths.incoming[part], paths.base[part], paths.gloss[part], shared, paths.outgoing, Y)
        alive = np.flatnonzero(paths.incoming[part, 2] > 0)
        for light in lit.arriving(paths.origins[part], directions[part], alive, walk, chance):
            light.add(worth, slot[part], sums)
    return _in_world(sums, slots[:, 0], tracer.frames[slots[:, 1]].astype(np.float64), exits.order)


def mirrored(directions: Float32[np.ndarray, "n 3"], order: int) -> Float32[np.ndarray, "n even"]:
    """Y(o) + Y(o mirrored) in a surface's frame, without those that vanish: l + m odd."""
    return 2 * harmonics.harmonics(directions, order)[:, _even(order)]


def _even(order: int) -> np.ndarray:
    """Indices of the harmonics with l + m even."""
    return np.array([degree * degree + degree + m for degree in range(order + 1) for m in range(-degree, degree + 1, 2)])


def _turned(frames: Float64[np.ndarray, "n 3 3"], order: int) -> Float64[np.ndarray, "n even wide"]:
    """World coefficients, of its own degree alone, of each even harmonic of a frame; by a quadrature that is exact."""
    z, weight = np.polynomial.legendre.leggauss(order + 1)
    turn = 2 * np.pi * np.arange(2 * order + 1) / (2 * order + 1)
    flat = np.sqrt(1 - z**2)[:, None]
    local = np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), z[:, None]), -1).reshape(-1, 3)
    share = np.repeat(weight, len(turn)) * (2 * np.pi / len(turn))
    own = harmonics.harmonics(local, order) * share[:, None]
    world = harmonics.harmonics(np.einsum("qi,nij->nqj", local, frames), order)
    rows, found = 0, np.zeros((len(frames), len(_even(order)), 2 * order + 1))
    for degree in range(order + 1):
        band, even = slice(degree**2, (degree + 1) ** 2), degree**2 + np.arange(0, 2 * degree + 1, 2)
        found[:, rows : rows + degree + 1, : 2 * degree + 1] = np.einsum("qe,nqk->nek", own[:, even], world[..., band])
        rows += degree + 1
    return found


def _in_world(
    sums: Float64[np.ndarray, "slots even 3 lightings"],
    place: Int[np.ndarray, " slots"],
    frames: Float64[np.ndarray, "slots 3 3"],
    order: int,
) -> Float64[np.ndarray, "lightings places harmonics 3"]:
    """Coefficients of each slot's frame, added up in the world's for each place."""
    found = np.zeros((sums.shape[3], place[-1] + 1, harmonics.count(order), 3))
    turns, row = _turned(frames, order), 0
    for degree in range(order + 1):
        rows, wide = slice(row, row + degree + 1), 2 * degree + 1
        turned = np.einsum("sek,secl->lskc", turns[:, rows, :wide], sums[:, rows])
        for slot, home in enumerate(place):
            found[:, home, degree**2 : (degree + 1) ** 2] += turned[:, slot]
        row += degree + 1
    return found


def choose_samples(lit: Lit, exits: Exits, *, target: float, seed: int, stream: str) -> tuple[int, float]:
    """Rays per place that a target for the noise takes, measured at a few places, and the noise to expect.

    Args:
      lit, exits: see `trace_exitant`.
      target: RMSE over all directions, places and lightings as a share of the mean; more than so many thousand rays are never
        chosen.
      seed, stream: address of the random numbers; independent of those of `trace_exitant` with that stream.
    """
    odds = exits.weight / exits.weight.sum()
    drawn = seeds.stream(seed, "exitant probes", *stream.encode()).choice(exits.count, PROBED, p=odds)
    chosen, times = np.unique(drawn, return_counts=True)
    count, runs = harmonics.count(exits.order), []
    for run in range(2):
        out = np.zeros((len(lit.lamps), len(chosen) * count, 3), np.float32)
        settings: dict[str, Any] = {"samples": _PILOT, "seed": seed, "stream": f"{stream} pilot {run}", "chosen": chosen}
        for _ in trace_exitant(lit, exits, out, **settings):
            pass
        runs.append(out.reshape(len(out), len(chosen), count, 3).astype(np.float64))
    values = 3 * len(lit.lamps) * PROBED
    mean = float(((runs[0] + runs[1]) / 2)[:, :, 0].sum((0, 2)) @ times) / values
    if mean <= 0:
        return _LEAST, 0.0
    single = _PILOT * float((((runs[0] - runs[1]) / mean) ** 2).sum((0, 2, 3)) @ times) / values / 2
    samples = int(np.clip(8 * np.ceil(single / target**2 / 8), _LEAST, _MOST))
    return samples, float(np.sqrt(single / samples))
