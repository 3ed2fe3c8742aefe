"""Every lighting at once: paths do not know which light is on.

The gather operator G says which share of a receiver's cosine-weighted hemisphere sees which sender. It is traced once,
and every lighting of the batch is then one column of a matrix product:

    senders:    x = E0 + G R x                 solved as a Neumann series (R = diagonal albedo)
    receivers:  E_indirect = G R x

Senders are the receivers' own texels in blocks (`Atlas.senders`), so their direct light is an area-weighted mean that
costs no ray. Texels inside a solid (a floor under a block that stands on it) take no part: nothing sees them. The price
is light averaged inside a sender: a bias that the report's spot check measures against `reference`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Bool, Float32, Int, Int32
from ddprt.scene.atlas import Atlas, Senders, SurfaceSampler
from ddprt.transport.embree import Hits, Tracer, lifted

_TILE_RAYS = 1 << 16  # rays gathered together by one thread
_PROBES = 16  # rays that tell an open texel from one inside a solid
_TOLERANCE = 1e-4  # of a lighting's largest indirect value: where the series stops
_MAX_BOUNCES = 512  # a closed white room never ends; what is left is reported


@dataclass(frozen=True)
class OperatorResult:
    """Indirect light of all lightings.

    Attributes:
      indirect: irradiance, W/m².
      bounces: terms of the series that were summed.
      remainder: bound on the light of all further bounces, as a share of the lighting's largest indirect value.
      senders: number of senders.
    """

    indirect: Float32[np.ndarray, "lightings texels 3"]
    bounces: int
    remainder: float
    senders: int

    @property
    def converged(self) -> bool:
        """Whether what is left is negligible."""
        return self.remainder <= _TOLERANCE


def operator_indirect(
    tracer: Tracer,
    atlas: Atlas,
    direct: Float32[np.ndarray, "lightings texels 3"],
    *,
    samples: int,
    sender_resolution: int,
    seed: int,
    stream: str,
    bounces: int = -1,
    advance: Callable[[int], None] = lambda texels: None,
) -> OperatorResult:
    """Indirect irradiance at every covered texel for every lighting.

    Args:
      tracer, atlas: the scene.
      direct: direct irradiance on the atlas, W/m².
      samples: gather rays per texel and per sender.
      sender_resolution: senders along a side of the atlas.
      seed, stream: address of the random numbers; another stream gives independent noise.
      bounces: -1 sums the series until what is left is negligible; otherwise exactly this many, at least 1.
      advance: told the number of texels after each finished tile.
    """
    exposed = find_exposed(tracer, atlas)
    if not exposed.any():
        return OperatorResult(np.zeros_like(direct), 0, 0.0, 0)
    senders = atlas.senders(sender_resolution, exposed)
    rng = seeds.stream(seed, "gather", *stream.encode())
    pattern = warp.sobol(samples, 4, seeds.number(seed, "gather pattern", *stream.encode()))
    light, summed, remainder = _solve(tracer, atlas, senders, direct, pattern, rng, bounces)

    indirect = np.empty((direct.shape[1], light.shape[1]), np.float32)
    shifts = rng.random((atlas.count, 4), np.float32)
    for texels, rows in _rows(tracer, atlas, senders, atlas.sampler, pattern, shifts):
        indirect[texels] = rows @ light
        advance(len(rows))
    shape = (atlas.count, len(direct), 3)
    return OperatorResult(np.ascontiguousarray(indirect.reshape(shape).swapaxes(0, 1)), summed, remainder, len(senders.area))


def find_exposed(tracer: Tracer, atlas: Atlas) -> Bool[np.ndarray, " texels"]:
    """Texels in the open: at least half of what they see along 16 rays are fronts, or nothing."""
    pattern = warp.sobol(_PROBES, 4, seed=1)

    def work(first: int) -> Bool[np.ndarray, " tile"]:
        last = min(first + _TILE_RAYS // _PROBES, atlas.count)
        u = np.tile(pattern, (last - first, 1))
        hits = _gather(tracer, atlas.sampler, np.repeat(np.arange(first, last), _PROBES), u)
        return (hits.front | (hits.triangle < 0)).reshape(-1, _PROBES).sum(1) * 2 >= _PROBES

    return np.concatenate(list(tracer.map(work, range(0, atlas.count, _TILE_RAYS // _PROBES))))


def _solve(
    tracer: Tracer,
    atlas: Atlas,
    senders: Senders,
    direct: Float32[np.ndarray, "lightings texels 3"],
    pattern: Float32[np.ndarray, "samples 4"],
    rng: np.random.Generator,
    bounces: int,
) -> tuple[Float32[np.ndarray, "senders columns"], int, float]:
    """Radiosity R (E0 + G R E0 + ...) of every sender, the bounces it holds, and the share left out."""
    count, lightings = len(senders.area), len(direct)
    term = _mean_over_senders(senders, atlas, direct)
    albedo = np.tile(senders.albedo.astype(np.float32), (1, lightings))
    total = term.copy()
    largest = float(senders.albedo.max())
    if bounces == 1 or largest == 0:
        return albedo * total, 1, _remainder(largest, term, total)
    gather = np.empty((count, count), np.float32)
    for tile, rows in _rows(tracer, atlas, senders, senders.sampler, pattern, rng.random((count, 4), np.float32)):
        gather[tile] = rows
    summed, left = 1, np.inf
    while (left > _TOLERANCE if bounces < 0 else summed < bounces) and summed < _MAX_BOUNCES:
        term = gather @ (albedo * term)
        total += term
        summed += 1
        left = _remainder(largest, term, total)
    return albedo * total, summed, left


def _remainder(largest: float, term: np.ndarray, total: np.ndarray) -> float:
    """Bound on the light of all further terms: rows of G sum to at most 1, so each is at most `largest` times the last."""
    peak = total.max(0)
    ratio = np.divide(term.max(0), peak, out=np.zeros_like(peak), where=peak > 0).max(initial=0)
    return float(ratio * largest / (1 - largest)) if largest < 1 else float("inf" if ratio > 0 else 0)


def _mean_over_senders(
    senders: Senders, atlas: Atlas, direct: Float32[np.ndarray, "lightings texels 3"]
) -> Float32[np.ndarray, "senders columns"]:
    from scipy.sparse import csr_array

    texel = np.flatnonzero(senders.of_texel >= 0)
    sender = senders.of_texel[texel]
    share = (atlas.area[texel] / senders.area[sender]).astype(np.float32)
    mean = csr_array((share, (sender, texel)), shape=(len(senders.area), atlas.count))
    return mean @ np.ascontiguousarray(direct.swapaxes(0, 1)).reshape(atlas.count, -1)


def _rows(
    tracer: Tracer,
    atlas: Atlas,
    senders: Senders,
    receivers: SurfaceSampler,
    pattern: Float32[np.ndarray, "samples 4"],
    shifts: Float32[np.ndarray, "receivers 4"],
) -> Iterator[tuple[slice, Float32[np.ndarray, "tile senders"]]]:
    """Tiles of G in order: (receiver slice, shares of the hemisphere that see each sender)."""
    samples, count = len(pattern), len(senders.area)
    size = max(1, _TILE_RAYS // samples)
    to_sender = np.where(atlas.lookup >= 0, senders.of_texel[atlas.lookup], -1).astype(np.int32)
    edges = atlas.uv[:, 1:] - atlas.uv[:, :1]
    charts = np.concatenate([atlas.uv[:, :1], edges], 1).reshape(-1, 6) * atlas.resolution
    charts = charts.astype(np.float32)

    def work(first: int) -> tuple[slice, Float32[np.ndarray, "tile senders"]]:
        last = min(first + size, len(shifts))
        rows = np.zeros((last - first) * count, np.int64)
        for start in range(0, samples, _TILE_RAYS):
            u = pattern[None, start : start + _TILE_RAYS] + shifts[first:last, None]
            u -= np.floor(u)
            receiver = np.repeat(np.arange(last - first), u.shape[1])
            seen = _senders_seen(tracer, receivers, first + receiver, u.reshape(-1, 4), to_sender, charts)
            flat = (receiver * count + seen)[seen >= 0]
            rows += np.bincount(flat, minlength=len(rows))
        return slice(first, last), (rows.reshape(-1, count) * np.float32(1 / samples)).astype(np.float32)

    return tracer.map(work, range(0, len(shifts), size))


def _gather(
    tracer: Tracer, receivers: SurfaceSampler, receiver: Int[np.ndarray, " rays"], u: Float32[np.ndarray, "rays 4"]
) -> Hits:
    """What one cosine-weighted ray per entry meets, from a place anywhere in its receiver."""
    positions, triangle = receivers.sample(receiver, u[:, :2])
    frames = np.take(tracer.frames.reshape(-1, 9), triangle, axis=0)
    directions = warp.to_world(warp.sample_cosine(u[:, 2:]), frames)
    return tracer.closest(lifted(tracer, positions, frames[:, 6:]), directions)


def _senders_seen(
    tracer: Tracer,
    receivers: SurfaceSampler,
    receiver: Int[np.ndarray, " rays"],
    u: Float32[np.ndarray, "rays 4"],
    to_sender: Int32[np.ndarray, "height width"],
    charts: Float32[np.ndarray, "triangles 6"],
) -> Int32[np.ndarray, " rays"]:
    """Sender that one cosine-weighted ray per entry meets from its front, -1 where there is none."""
    hits = _gather(tracer, receivers, receiver, u)
    chart = np.take(charts, hits.triangle, axis=0, mode="wrap")
    column, row = (chart[:, k] + hits.u * chart[:, 2 + k] + hits.v * chart[:, 4 + k] for k in (0, 1))
    side = len(to_sender)
    texel = np.clip(row.astype(np.int32), 0, side - 1) * side + np.clip(column.astype(np.int32), 0, side - 1)
    return np.where(hits.front, np.take(to_sender, texel), -1)
