"""What probes see of surfaces that glow: straight from them, and what bounces, as harmonics that no lamp changes.

Emitters are looked for from both sides, as for texels: points of theirs find small ones, rays over the whole sphere those that
are near. What bounces is gathered from the senders, as the light of lamps is.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ddprt import harmonics, seeds, warp
from ddprt.axes import Float32, Float64
from ddprt.scene.atlas import Atlas
from ddprt.sections import TransportConfig
from ddprt.transport import probes
from ddprt.transport.embree import Tracer
from ddprt.transport.emission import Emitters
from ddprt.transport.sources import Sent, Shown

_FEW, _MOST = 256, 1 << 14  # samples of each probe and half that tell the noise, and that are taken unasked
_CALL = 1 << 14  # samples of one call


@dataclass(frozen=True, eq=False)
class Glow:
    """Light of emitters at probes.

    Attributes:
      light: harmonics of irradiance, W/m².
      direct: what of it comes straight from them.
      facts: samples of each probe, rays that gather what bounces, and the noise of the direct part.
    """

    light: Float32[np.ndarray, "probes harmonics 3"]
    direct: Float32[np.ndarray, "probes harmonics 3"]
    facts: dict[str, Any]


def probe_light(
    emitters: Emitters,
    tracer: Tracer,
    atlas: Atlas,
    irradiance: Float32[np.ndarray, "texels 3"],
    position: Float64[np.ndarray, "probes 3"],
    config: TransportConfig,
    rays: int | str,
    *,
    seed: int,
    bounces: int = -1,
    shown: Shown | None = None,
) -> Glow:
    """Harmonics of irradiance at probes, direct and all bounces.

    Args:
      emitters, tracer, atlas: what glows, what occludes, and the senders.
      irradiance: of the emitters, direct, on every texel: `Constant.direct`.
      position: in free air, metres, world space.
      config: the noise to aim at.
      rays: of each probe, or "auto".
      seed: of all random numbers.
      bounces: of the plan.
      shown: what bounces, as the lightmaps show it, where something glosses; None takes the operator's senders.
    """
    count = harmonics.count(probes.ORDER)
    dark = np.zeros((len(position), count, 3), np.float32)
    if len(emitters.triangle) == 0:
        return Glow(dark, dark, {})
    samples = _FEW if rays == "auto" else int(rays)
    halves = [_direct(emitters, tracer, position, samples, seed, half) for half in range(2)]
    if rays == "auto":
        wanted = probes.power_of_two(int(min(_MOST, np.ceil(samples * (_relative(halves) / config.target_noise) ** 2))))
        if wanted > samples:
            samples = wanted
            halves = [_direct(emitters, tracer, position, samples, seed, half) for half in range(2)]
    direct = ((halves[0] + halves[1]) / 2).astype(np.float32)
    facts: dict[str, Any] = {"probe_samples": 2 * samples, "probe_noise": float(f"{_relative(halves):.3g}")}
    if bounces == 0:
        return Glow(direct, direct, facts)
    source = shown or _sent(emitters, tracer, atlas, irradiance, seed, bounces)
    if rays == "auto":
        chosen, _ = source.choose_rays(position, config.target_noise, 1)
    else:
        chosen = probes.power_of_two(int(rays))
    facts["probe_rays"] = chosen
    gathered = np.concatenate(list(source.gather(position, chosen)), 1)[0]
    return Glow(direct + gathered, direct, facts)


def _sent(
    emitters: Emitters, tracer: Tracer, atlas: Atlas, irradiance: Float32[np.ndarray, "texels 3"], seed: int, bounces: int
) -> Sent:
    """What bounces, on the operator's senders."""
    from ddprt.transport.operator import Operator

    operator = Operator.of(tracer, atlas, atlas.resolution)
    address: dict[str, Any] = {"seed": seed, "stream": "emission probes"}
    averaged = operator.averaged(irradiance)
    near = replace(operator.near([()], averaged, bounces=bounces), shine=emitters.shine)
    return Sent(operator, operator.bounce(averaged, **address, bounces=bounces), {**address, "near": near})


def _direct(
    emitters: Emitters, tracer: Tracer, position: Float64[np.ndarray, "probes 3"], samples: int, seed: int, half: int
) -> Float64[np.ndarray, "probes harmonics 3"]:
    """Harmonics of what comes straight from emitters, one point and one direction for each sample."""
    order = probes.ORDER
    cosine, step = harmonics.clamped_cosine(order)[:, None], max(1, _CALL // samples)

    def work(first: int) -> np.ndarray:
        local = (position[first : first + step] - tracer.centre).astype(np.float32)
        origins, sums = np.repeat(local, samples, 0), np.zeros((len(local), harmonics.count(order), 3))
        numbers = seeds.number(seed, "emission probes", half, samples, first)
        u = warp.sobol(samples * len(local), 4, numbers)
        directions = warp.sample_sphere(u[:, 2:])
        for found in (emitters.at_points(tracer, origins, u[:, :2]), emitters.along(tracer, origins, directions)):
            light = found.balanced(np.ones((len(found.which), 1)), 1 / (4 * np.pi))
            Y = harmonics.harmonics(found.towards, order)
            np.add.at(sums, found.which // samples, Y[:, :, None] * light[:, None])
        return cosine * sums / samples

    return np.concatenate(list(tracer.map(work, range(0, len(position), step))))


def _relative(halves: list[Float64[np.ndarray, "probes harmonics 3"]]) -> float:
    """RMS of half the difference of two halves over that of their mean."""
    light = float(((halves[0] + halves[1]) ** 2).sum())
    return float(np.sqrt(((halves[0] - halves[1]) ** 2).sum() / light)) if light > 0 else 0.0
