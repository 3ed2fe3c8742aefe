"""Probes: points in free air that keep the indirect light from all sides, for objects that move through the scene.

What a plane there receives, for any normal n, is nine numbers: irradiance E(n) = sum over lm of E_lm Y_lm(n) up to order 2,
with E_lm = A_l L_lm, the radiance L arriving at the point projected on the harmonics, and A of a clamped cosine. L is that of
the senders that rays over the whole sphere land on, so one trace serves all lightings, and the light on the senders is what
the lightmap is gathered from. Light that a probe sees of lamps or a sky themselves is direct, and not in it.

Reference: Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment Maps", 2001: order 2 leaves a mean
error of 1 % of the irradiance under any one distribution of light, 9 % at worst.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ddprt import harmonics, seeds, warp
from ddprt.axes import Bool, Float32, Float64, Int
from ddprt.compiled import compiled
from ddprt.errors import UserError
from ddprt.scene.checks import FARTHEST
from ddprt.sections import ProbesConfig
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Seen, landed_on
from ddprt.transport.near import NearField, columns_of
from ddprt.transport.operator import Operator

ORDER = 2
MOST = 1 << 20  # probes
CALL = 1 << 14  # rays of one call
_FEW, _MANY = 64, 256  # rays of the probes that tell how noise falls, twice each
_PILOTS, _LIGHTINGS = 64, 32  # probes and lightings that are looked at
_FEWEST, _MOST = 64, 1 << 16  # rays that are traced unasked
_BAND = np.sqrt(4 * np.pi)  # a coefficient of order 0 over the mean that it stands for


def places(config: ProbesConfig, bounds: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, "places 3"]:
    """Where probes are asked for: of a grid in the middle of each cell, x the slowest and z the fastest; metres.

    Raises:
      UserError: none are asked for, more than `MOST`, or a file that does not list positions.
    """
    if config.file:
        return _listed(config.file)
    if not config.asked:
        raise UserError("probes.grid: got none, expected where probes stand, since they are forced on; set a grid or a file")
    _refuse_too_many("grid", math.prod(config.grid), "lower it")
    low, size = bounds[0], bounds[1] - bounds[0]
    axes = [
        low[axis] + size[axis] * (start + (stop - start) * (np.arange(count) + 0.5) / count)
        for axis, (count, start, stop) in enumerate(zip(config.grid, config.region_low, config.region_high, strict=True))
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def digest(position: Float64[np.ndarray, "places 3"]) -> str:
    """Hash of all places."""
    return hashlib.sha256(np.ascontiguousarray(position).tobytes()).hexdigest()[:16]


def _refuse_too_many(key: str, count: int, way: str) -> None:
    if count > MOST:
        raise UserError(f"probes.{key}: got {count} probes, expected at most {MOST}; {way}")


def _listed(path: str) -> Float64[np.ndarray, "places 3"]:
    try:
        listed = json.loads(Path(path).read_text("utf-8"))
        _refuse_too_many(f"file {path}", len(listed) if isinstance(listed, list) else 0, "list fewer")
        position = np.array(listed, np.float64)
        if position.ndim != 2 or position.shape[1] != 3 or len(position) == 0:
            raise ValueError(f"got shape {position.shape}")
        if odd := [entry for place in listed for entry in place if isinstance(entry, bool | str)]:
            raise ValueError(f"got {odd[0]!r} for a number")
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"probes.file {path}: got {error.strerror or error}, expected a JSON list of positions") from None
    except (ValueError, TypeError, RecursionError) as error:
        raise UserError(f"probes.file {path}: not a JSON list of positions [x, y, z] ({error}); mend the file") from None
    if not (np.abs(position) < FARTHEST).all():
        raise UserError(f"probes.file {path}: got a position past {FARTHEST:g} m or not finite; mend the file")
    return position


def in_the_open(tracer: Tracer, position: Float64[np.ndarray, "places 3"]) -> Bool[np.ndarray, " places"]:
    """Which probes stand in free air, neither inside a solid nor behind a room's walls; see `Tracer.clearance`."""
    step = 1 << 10
    parts = tracer.map(tracer.clearance, (position[first : first + step] for first in range(0, len(position), step)))
    return np.concatenate(list(parts)) > 0


def gather(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    position: Float64[np.ndarray, "places 3"],
    rays: int,
    *,
    seed: int,
    stream: str,
    near: NearField | None = None,
) -> Iterator[Float32[np.ndarray, "lightings some harmonics 3"]]:
    """Harmonics of irradiance, W/m², of some probes after others.

    Args:
      operator, radiosity: what is seen; from `Operator.bounce`.
      position: in free air, metres, world space.
      rays: of each, a power of two.
      seed, stream: address of the random numbers.
      near: looks closer at near senders, if given.
    """
    tracer, count, step = operator.tracer, harmonics.count(ORDER), max(1, CALL // rays)
    cosine = harmonics.clamped_cosine(ORDER) * (4 * np.pi / rays / np.pi)  # radiance is radiosity / pi

    def work(first: int) -> np.ndarray:
        local = (position[first : first + step] - tracer.centre).astype(np.float32)
        address = *stream.encode(), rays, first
        uniform = warp.sobol(rays * len(local), 2, seeds.number(seed, "probe pattern", *address))
        directions = warp.sample_sphere(uniform)
        triangle, u, v, distance = tracer.first(np.repeat(local, rays, 0), directions)
        cells = landed_on(tracer, operator.landing, directions, triangle, u, v)
        Y = harmonics.harmonics(directions, ORDER)
        sums = np.zeros((len(local), count, radiosity.shape[1]), np.float32)
        _project(cells, np.arange(len(cells)) // rays, Y, radiosity, sums)
        if near:
            met = near.pick(Seen(cells[None], distance[None], triangle, u, v), 0)  # each ray its own receiver
            row, ray = np.arange(len(met.cell), dtype=np.int32), met.receiver
            change = np.zeros((len(row), radiosity.shape[1]), np.float32)
            near.add([replace(met, receiver=row)], radiosity, seeds.stream(seed, "near probes", *address), change)
            _project(row, ray.astype(np.int64) // rays, Y[ray], change, sums)
        light = sums * cosine.astype(np.float32)[:, None]
        return np.moveaxis(light.reshape(len(local), count, -1, 3), 2, 0)

    return tracer.map(work, range(0, len(position), step))


def choose_rays(
    operator: Operator,
    radiosity: Float32[np.ndarray, "senders columns"],
    position: Float64[np.ndarray, "places 3"],
    target: float,
    *,
    halves: int,
    seed: int,
    stream: str,
    near: NearField | None = None,
) -> tuple[int, float]:
    """Rays of each probe (of each half) that reach a noise, and the noise that they will leave.

    Args:
      operator, radiosity, position, near, seed, stream: as for `gather`; its random numbers stay independent of these.
      target: relative RMSE of irradiance over the sphere, all probes and lightings together.
      halves: that are averaged.
    """
    some, chosen = pilots(len(position), radiosity.shape[1] // 3)
    light, near = columns_of(radiosity, chosen), near.some(chosen) if near else None

    def gathered(rays: int, stream: str) -> Iterator[np.ndarray]:
        return gather(operator, light, position[some], rays, seed=seed, stream=stream, near=near)

    return rays_for(gathered, target, halves, stream)


def pilots(places: int, lightings: int) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " lightings"]]:
    """Probes and lightings that stand for all where rays are chosen."""
    probes, chosen = (
        np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
        for count, most in ((places, _PILOTS), (lightings, _LIGHTINGS))
    )
    return probes, chosen


def rays_for(
    gathered: Callable[[int, str], Iterator[Float32[np.ndarray, "lightings some harmonics 3"]]],
    target: float,
    halves: int,
    stream: str,
) -> tuple[int, float]:
    """Rays of each probe (of each half) that reach a noise, and the noise that they will leave.

    Args:
      gathered: light of some probes by so many rays, from a stream of random numbers.
      target, halves, stream: see `choose_rays`.
    """

    def run(rays: int, turn: int) -> Float64[np.ndarray, "lightings some harmonics 3"]:
        return np.concatenate(list(gathered(rays, f"{stream} probe pilot {turn}")), 1).astype(np.float64)

    runs = {rays: (run(rays, 0), run(rays, 1)) for rays in (_FEW, _MANY)}
    mean = float(np.mean([part[:, :, 0].mean() for part in runs[_MANY]])) / _BAND
    if mean <= 0:
        return _FEWEST, 0.0
    few, many = (float(((a - b) ** 2).sum(2).mean()) / 2 / _BAND**2 / mean**2 for a, b in runs.values())
    if not (few and many):
        return _FEWEST, 0.0
    power = float(np.clip(np.log(few / many) / np.log(_MANY / _FEW), 1.0, 2.0))
    wanted = _MANY * (many / halves / target**2) ** (1 / power)
    rays = power_of_two(int(np.clip(np.ceil(wanted), _FEWEST, _MOST)))
    return rays, float(np.sqrt(many / halves * (_MANY / rays) ** power))


def power_of_two(rays: int) -> int:
    """The next one: so many points of the sequence are spread best."""
    return 1 << max(rays - 1, 0).bit_length()


@compiled
def _project(
    cells: Int[np.ndarray, " rays"],
    probe: Int[np.ndarray, " rays"],
    Y: Float32[np.ndarray, "rays harmonics"],
    table: Float32[np.ndarray, "cells columns"],
    sums: Float32[np.ndarray, "probes harmonics columns"],
) -> None:
    """Adds to each probe the table's rows that its rays land on, times the harmonics of their directions."""
    for ray in range(len(cells)):
        cell, own = cells[ray], probe[ray]
        if cell >= 0:
            for k in range(Y.shape[1]):
                weight = Y[ray, k]
                for column in range(table.shape[1]):
                    sums[own, k, column] += weight * table[cell, column]
