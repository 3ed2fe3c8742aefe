"""How many rays each texel gets: as many as a target for the noise asks, and more where they are needed."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32, Float64, Int
from ddprt.sections import TransportConfig
from ddprt.transport.footprint import Footprints, find_footprints
from ddprt.transport.gather import Receivers
from ddprt.transport.near import NearField, columns_of
from ddprt.transport.operator import Operator

_PILOT = 8  # rays of every texel that tell distances and variances, and are thrown away
_PROBED = 1024  # texels whose noise is measured
_TIMED = 1 << 18  # rays of each thread, at most, that tell how long one takes
_TIMED_SHARE = 8  # of all rays, this part at most
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
    each, traced = (per_ray * rays.sum() * halves for per_ray in _cost_per_ray(operator, *whole, rays))
    facts["seconds_expected"] = float(f"{each:.2g}")
    if adaptive:
        facts["variance_over_even"] = round(ratio, 3)
    return Choice(rays, footprints, facts, power, float(each), int(traced))


def _cost_per_ray(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    near: NearField | None,
    rays: Int[np.ndarray, " texels"],
) -> tuple[float, float]:
    """Seconds that a ray takes on all threads together, with all lightings and near senders, and rays traced for each.

    Each thread gathers a stretch as the bake will: as many neighbours with as many rays each, since rays of neighbours cost
    less than scattered ones, fewer of them stay in the cache where texels have few, and every stretch lights its near senders
    once for every lighting, which on a statue costs as much as its rays. What a call costs before its first ray is in a call
    for a single texel, and drops out.
    """
    threads = operator.tracer.threads
    values, numbers = np.unique(rays[rays > 0], return_counts=True)
    usual = int(values[np.argmax(values * numbers)])  # of the texels that hold most of the rays
    there = np.flatnonzero(rays == usual)
    tile = _tile(operator, usual)
    most = min(_TIMED, int(rays.sum()) // (_TIMED_SHARE * threads)) // usual
    windows, size = max(1, min(_TILES, most // tile)), min(tile, max(most, 16), len(there))
    starts = np.linspace(0, len(there) - size, windows * threads).astype(int).reshape(windows, threads)
    spent = []
    for single in (True, False):

        def work(thread: int, single: bool = single) -> int:
            own = np.unique(np.concatenate([there[first : first + size] for first in starts[:, thread]]))
            texels = own[:1] if single else own
            field = None if single else near
            operator.gather_some(radiosity, texels, usual, seed=thread, stream="rate", near=field)
            return len(texels)

        begun, before = time.perf_counter(), operator.tracer.rays
        asked = usual * sum(operator.tracer.map(work, range(threads)))
        spent.append(np.array([time.perf_counter() - begun, operator.tracer.rays - before, asked]))
    seconds, traced, asked = spent[1] - spent[0]
    if asked == 0:  # an atlas of a single texel
        seconds, traced, asked = spent[1]
    return max(seconds, 0.1 * spent[1][0]) / asked, traced / asked  # a busy machine may turn the two around


def _tile(operator: Operator, samples: int) -> int:
    """Texels whose rays a gather traces together."""
    some = Receivers.texels(operator.atlas, samples, 0, "rate", np.arange(min(operator.atlas.count, _MOST)))
    first = next(some.tiles())
    return first.stop - first.start


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
      seconds, traced: of the gather, both halves of held-out maps; with the rays that go on from near senders.
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
