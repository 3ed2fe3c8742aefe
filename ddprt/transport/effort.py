"""How many rays each texel gets: as many as a target for the noise asks, and more where they are needed."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from heapq import heapreplace
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64, Int
from ddprt.sections import TransportConfig
from ddprt.transport.footprint import Footprints, find_footprints
from ddprt.transport.gather import Pattern, Receivers, seen_from
from ddprt.transport.near import NearField, columns_of
from ddprt.transport.operator import Operator

_PILOT = 8  # rays of every texel that tell distances and variances, and are thrown away
_PROBED = 1024  # texels whose noise is measured
_TIMED = 1 << 18  # rays of each thread and turn, at most, that tell how long one takes
_TIMED_SHARE = 8  # of all rays, this part at most
_TURNS = 2  # times that rays are timed, with other texels: a machine does not always do the same
_TILES = 8  # neighbours' tiles that go through together in a gather
_LIGHTINGS = 32  # that are looked at
_FEW, _MANY = 24, 96  # rays there, twice each; no powers of two, which do 10 % better than what lies between
_WIDE = 0.4  # of the harmonic mean distance: over how far variances seen by few rays are averaged
_LEVELS = 2.0 ** np.arange(-2, 4)  # rays of a texel over the mean
_WORTHWHILE = 0.9  # of the even variance: what an uneven share must reach to be used
_MOST = 65536


@dataclass(frozen=True, eq=False)
class Choice:
    """What was chosen, and why.

    Attributes:
      rays: of each texel.
      footprints: neighbours that share rays; None where none do.
      facts: mean rays, expected relative RMSE of the maps, seconds of the gather, variance over that of an even share.
      power: how fast variance falls with the number of rays; 1 for independent ones.
      seconds, traced: of the gather, both halves of held-out maps; with the rays that go on from near senders.
    """

    rays: Int[np.ndarray, " texels"]
    footprints: Footprints | None
    facts: dict[str, Any]
    power: float = 1.0
    seconds: float = 0.0
    traced: int = 0


def choose_rays(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    config: TransportConfig,
    *,
    near: NearField | None = None,
    held_out: bool,
    seed: int,
    stream: str,
) -> Choice:
    """Looks around with a few rays, measures the noise at a thousand texels, and predicts.

    Held-out maps are two independent halves of even rays, and no texel borrows from another.

    Args:
      operator, radiosity: what will be gathered.
      config: samples or the noise to aim at, footprint, adaptive.
      near: the light of near senders, for as many lightings.
      held_out: for scores rather than for training.
      seed, stream: address of the random numbers; independent of those that gather.
    Returns:
      Rays of each texel (of each half), and what they will do.
    """
    halves, samples = (2, config.test_samples) if held_out else (1, config.samples)
    footprint, adaptive = (0.0, False) if held_out else (config.footprint, config.adaptive)
    area = operator.atlas.area
    whole = radiosity, near
    lightings = radiosity.shape[1] // 3
    chosen = np.unique(np.linspace(0, lightings - 1, min(lightings, _LIGHTINGS)).astype(int))  # enough to tell what is needed
    radiosity, near = columns_of(radiosity, chosen), near.some(chosen) if near else None
    pilot = operator.pilot(radiosity, _PILOT, seed=seed, stream=stream)
    footprints = find_footprints(operator.atlas, pilot.nearness, footprint) if footprint > 0 else None
    burden = footprints.burden(area) if footprints else area
    variance = _smoothed(operator, pilot.nearness, pilot.variance, _WIDE)
    few, power, texels, error = _measure_noise(operator, radiosity, near, burden, variance, seed, stream)
    ratio, share = allot(variance, burden, power) if adaptive else (1.0, np.ones(len(area)))
    if ratio < 1 and error.any():  # the pilot chose, so only the probes can tell what that is worth
        ratio = float(error @ share[texels] ** -power / error.sum())
        ratio, share = (ratio, share) if ratio < _WORTHWHILE else (1.0, np.ones(len(area)))

    if samples == "auto":
        wanted = halves * _FEW * (few * ratio / halves / config.target_noise**2) ** (1 / power)
        samples = int(np.clip(8 * np.ceil(wanted / 8), 8, _MOST * halves))
    rays = np.maximum(1, np.rint(share * (samples / halves))).astype(np.int64)
    expected = np.sqrt(few * ratio * (samples / halves / _FEW) ** -power / halves)
    facts = {"samples": round(float(rays.mean()) * halves, 1), "noise_expected": float(f"{expected:.3g}")}
    seconds, traced = (halves * cost for cost in _cost(operator, *whole, rays))
    facts["seconds_expected"] = float(f"{seconds:.2g}")
    if adaptive:
        facts["variance_over_even"] = round(ratio, 3)
    return Choice(rays, footprints, facts, power, seconds, int(traced))


def _cost(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    near: NearField | None,
    rays: Int[np.ndarray, " texels"],
) -> tuple[float, float]:
    """Seconds of a gather on all threads, and its rays with those that go on from near senders.

    Two things cost: rays, with what near senders add to each, and stretches that meet near senders, each of which lights them
    once for every lighting; on a statue that comes to as much as its rays. Both are timed as the bake does them, as many
    neighbours with as many rays each: rays of neighbours cost less than scattered ones. What a call costs before its first ray
    is in a call for a single texel, and drops out.
    """
    if not rays.any():
        return 0.0, 0.0
    threads, gathered = operator.tracer.threads, partial(_timed, operator, radiosity)
    values, numbers = np.unique(rays[rays > 0], return_counts=True)
    usual = int(values[np.argmax(values * numbers)])  # of the texels that hold most of the rays
    tile = _tile(operator, usual)
    most = min(_TIMED, int(rays.sum()) // (_TIMED_SHARE * threads)) // usual
    windows, size = max(1, min(_TILES, most // tile)), min(tile, max(most, 16))
    odds = _near_odds(operator, near, min(_PILOT, max(1, usual // _PILOT))) if near else np.zeros(len(rays))
    lighting = 0.0
    if odds.any():
        nearest = [np.argsort(-odds, kind="stable")[:1]] * threads  # of one texel: what it costs before the first shadow ray
        lighting = max(0.0, gathered(nearest, _PILOT, near)[0] - gathered(nearest, _PILOT, None)[0])
    dealt = _standing_for_all(rays, odds, size, _TURNS * windows * threads)
    spent = []
    for turn in range(_TURNS):
        shares = [dealt[turn * threads + thread :: _TURNS * threads] or dealt[:1] for thread in range(threads)]
        own = [np.unique(np.concatenate(tiles)) for tiles in shares]
        whole, one = gathered(own, usual, near), gathered([texels[:1] for texels in own], usual, None)
        lit = lighting * np.mean([odds[texels].any() for texels in own])
        spent.append([whole[0] - one[0] - lit, whole[1] - one[1], whole[2] - one[2], 0.1 * whole[0]])
    seconds, asked, traced, least = np.sum(spent, 0)
    if asked == 0:  # an atlas of a single texel
        seconds, asked, traced = gathered(own, usual, near)
    each = max(seconds, least) / asked  # a busy machine may turn whole and single around
    return _until_done(_spans(operator, rays, odds, threads * each, lighting), threads), rays.sum() * traced / asked


def _timed(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    own: Sequence[np.ndarray],
    samples: int,
    near: NearField | None,
) -> tuple[float, int, int]:
    """Seconds that a thread is busy with texels of its own while all are, rays asked of all, and rays traced."""

    def work(thread: int) -> float:
        begun = time.perf_counter()
        operator.gather_some(radiosity, own[thread], samples, seed=thread, stream="rate", near=near)
        return time.perf_counter() - begun

    before = operator.tracer.rays
    seconds = float(np.mean(list(operator.tracer.map(work, range(len(own))))))
    return seconds, samples * sum(map(len, own)), operator.tracer.rays - before


def _near_odds(operator: Operator, near: NearField, samples: int) -> Float64[np.ndarray, " texels"]:
    """How many near senders a ray of each texel meets for every far one; by so many rays, one more taken to be far.

    Odds, not the share of near rays: a ray that meets something near goes on from there, where as much is near. In a crevice
    it goes on many times.
    """
    receivers = Receivers.texels(operator.atlas, samples, 0, "near odds")

    def work(stretch: slice) -> np.ndarray:
        met = np.zeros(stretch.stop - stretch.start)
        for tile in receivers.tiles(within=stretch):
            own = met[tile.start - stretch.start : tile.stop - stretch.start]
            for seen in seen_from(operator.tracer, receivers, tile, operator.landing):
                own += np.bincount(near.pick(seen, 0).receiver, minlength=len(own))
        return met / (samples + 1 - met)

    return np.concatenate(list(operator.tracer.map(work, receivers.tiles(_TILES))))


def _standing_for_all(
    rays: Int[np.ndarray, " texels"], odds: Float64[np.ndarray, " texels"], size: int, count: int
) -> list[np.ndarray]:
    """At most so many tiles of neighbours with as many rays, which stand for as many rays each.

    Texels in corners have ten times the near senders of others, and more rays, so a few tiles at equal distances tell little.
    Here tiles are sorted by their odds of near senders and dealt into strata of equal rays; of each goes the tile that is
    nearest to its mean, and among equals the one in the middle.
    """
    order = np.argsort(rays, kind="stable")[np.count_nonzero(rays == 0) :]
    _, first, number = np.unique(rays[order], return_index=True, return_counts=True)
    starts = np.concatenate([np.arange(start, start + many, size) for start, many in zip(first, number, strict=True)])
    weight = np.add.reduceat(rays[order].astype(np.float64), starts)
    level = np.add.reduceat((rays * odds)[order], starts) / weight
    tiles, ranked = np.split(order, starts[1:]), np.argsort(level, kind="stable")
    upto = np.cumsum(weight[ranked]) - weight[ranked] / 2
    stratum = (upto * (count / weight.sum())).astype(int)
    chosen = []
    for ranks in np.split(np.arange(len(ranked)), np.flatnonzero(np.diff(stratum)) + 1):
        inside = ranked[ranks]
        off = np.abs(level[inside] - np.average(level[inside], weights=weight[inside]))
        chosen.append(inside[np.lexsort((np.abs(ranks - ranks.mean()), off))[0]])
    return [tiles[index] for index in chosen]


def _spans(
    operator: Operator, rays: Int[np.ndarray, " texels"], odds: Float64[np.ndarray, " texels"], each: float, lighting: float
) -> list[float]:
    """Seconds of each stretch of a gather, in its order, at so many for a ray and for lighting what is near."""
    spans = []
    for samples in np.unique(rays[rays > 0]):
        there, step = np.flatnonzero(rays == samples), _TILES * _tile(operator, int(samples))
        for start in range(0, len(there), step):
            texels = there[start : start + step]
            spans.append(float(each * samples * len(texels) + lighting * odds[texels].any()))
    return spans


def _until_done(spans: Sequence[float], threads: int) -> float:
    """Seconds until all is done, each span by the thread that is free first."""
    busy = [0.0] * threads
    for span in spans:
        heapreplace(busy, busy[0] + span)
    return max(busy)


def _tile(operator: Operator, samples: int) -> int:
    """Texels whose rays a gather traces together."""
    disk, none = np.zeros((samples, 1, 2), np.float32), np.zeros(0, np.int32)
    bare = Receivers(operator.atlas.sampler, Pattern(disk, disk), none, none, np.zeros((0, 2), np.float32))
    return next(bare.tiles(within=slice(0, _MOST))).stop


def allot(
    variance: Float64[np.ndarray, " texels"], burden: Float64[np.ndarray, " texels"], power: float = 1.0
) -> tuple[float, Float64[np.ndarray, " texels"]]:
    """Rays of each texel for the least total squared error.

    Minimises sum_j burden_j variance_j n_j^-power at a fixed sum of n_j: n_j goes with (burden_j variance_j)^(1 / (1 + power)),
    rounded to powers of two of the mean between a quarter and eight times.

    Args:
      variance: of one ray.
      burden: weight of each texel's variance in the total squared error.
      power: how fast variance falls with the number of rays; 1 for independent ones.
    Returns:
      The expected variance over that of an even share, and rays over their mean: 1 and ones where even is about as good.
    """
    even = 1.0, np.ones(len(variance))
    cost = variance * burden
    wish = cost ** (1 / (1 + power))
    if not wish.any():
        return even
    low, high = 0.0, 64 * len(wish) / wish.sum()
    for _ in range(40):  # the total never falls as the scale grows
        scale = (low + high) / 2
        low, high = (scale, high) if _rounded(scale * wish).mean() < 1 else (low, scale)
    share = _rounded(low * wish)
    ratio = float((cost * share**-power).sum() / cost.sum())
    return (ratio, share) if ratio < _WORTHWHILE else even


def _rounded(share: Float64[np.ndarray, " texels"]) -> Float64[np.ndarray, " texels"]:
    """The nearest level, on a logarithmic scale."""
    step = np.rint(np.log2(np.maximum(share, _LEVELS[0]))) - np.log2(_LEVELS[0])
    return _LEVELS[np.clip(step, 0, len(_LEVELS) - 1).astype(int)]


def _smoothed(
    operator: Operator, nearness: Float64[np.ndarray, " texels"], variance: Float64[np.ndarray, " texels"], share: float
) -> Float64[np.ndarray, " texels"]:
    """Variances of few rays, averaged over neighbours; a tenth of the mean stays where none was seen."""
    wide = find_footprints(operator.atlas, nearness, share).pooled(variance.astype(np.float32)[:, None])[:, 0]
    return np.maximum(wide, 0).astype(np.float64) + 0.1 * float(variance.mean())


def _measure_noise(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    near: NearField | None,
    burden: Float64[np.ndarray, " texels"],
    variance: Float64[np.ndarray, " texels"],
    seed: int,
    stream: str,
) -> tuple[float, float, Int[np.ndarray, " probed"], Float64[np.ndarray, " probed"]]:
    """Squared relative RMSE of maps at `_FEW` rays per texel, the power with which it falls, and each probed texel's share.

    Texels are probed where they matter: drawn with a probability near their share of the error, and weighted accordingly.
    """
    area, count = operator.atlas.area, operator.atlas.count
    matter = np.sqrt(variance * burden)
    odds = 0.5 / count + 0.5 * matter / max(matter.sum(), 1e-300) if matter.any() else np.full(count, 1 / count)
    drawn = seeds.stream(seed, "probed", *stream.encode()).choice(count, _PROBED, p=odds / odds.sum())
    texels, times = np.unique(drawn, return_counts=True)
    weight = times / _PROBED / odds[texels]
    lightings = radiosity.shape[1] // 3
    runs = {}
    for rays in (_FEW, _MANY):
        for run in range(2):
            runs[rays, run] = operator.gather_some(
                radiosity, texels, rays, seed=seed, stream=f"{stream} probe {run}", near=near
            )
    mean = float((weight * area[texels]) @ np.mean(list(runs.values()), axis=0).sum((0, 2))) / (3 * lightings * area.sum())
    if mean == 0:
        return 0.0, 1.0, texels, np.zeros(len(texels))
    scale = weight * burden[texels] / (2 * 3 * lightings * area.sum())
    each = [scale * (((runs[rays, 0] - runs[rays, 1]) / mean) ** 2).sum((0, 2)) for rays in (_FEW, _MANY)]
    few, many = (float(part.sum()) for part in each)
    if not (few and many):
        return few, 1.0, texels, each[0]
    power = float(np.clip(np.log(few / many) / np.log(_MANY / _FEW), 1.0, 1.8))
    return few, power, texels, each[0] / few + each[1] / many
