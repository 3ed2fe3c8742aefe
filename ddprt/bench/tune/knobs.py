"""What each of the planner's knobs may be."""

from collections.abc import Sequence

from ddprt.config import Config

FACTORS: dict[str, tuple[float, ...]] = {
    "atlas.resolution": (0.25, 0.5, 2**-0.5, 1.0),
    "lightings.train": (0.125, 0.25, 0.5, 1.0, 2.0),
    "transport.target_noise": (0.5, 1.0, 2.0, 4.0, 8.0),
    "points.count": (0.5, 1.0, 2.0, 4.0),
}
_LEAST = {"atlas.resolution": 16, "lightings.train": 4, "transport.target_noise": 1e-3, "points.count": 4}


def value_of(config: Config, knob: str) -> float:
    """Where a knob of a configuration stands."""
    section, key = knob.split(".")
    return float(getattr(getattr(config, section), key))


def around(config: Config, knob: str, base: float, factors: Sequence[float]) -> tuple[float, ...]:
    """What a knob may be; alone what it is where it has no effect."""
    still = (knob == "transport.target_noise" and config.transport.samples != "auto") or (
        knob == "points.count" and bool(config.points.file)
    )
    if still or (knob == "lightings.train" and config.lightings.file):
        return (base,)
    steps = {max(_LEAST[knob], factor * base) for factor in factors if factor != 1}
    if knob == "transport.target_noise":
        return tuple(sorted({base, *(min(1.0, float(f"{step:.3g}")) for step in steps)}))
    if knob == "atlas.resolution":
        return tuple(sorted({base, *(step for each in steps if (step := float(8 * round(each / 8))) < base)}))
    return tuple(sorted({base, *(float(round(step)) for step in steps)}))
