"""Splits that generalise: trained on one thing, asked about another. One entry each."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ddprt.catalogue import Catalogue
from ddprt.config import Config
from ddprt.errors import UserError

_PLACED = {"point", "spot", "rect", "sphere"}
_COLOURED = {*_PLACED, "directional"}
_SIZES = (8, 16, 32, 64, 128, 256, 512, 1024)
_SHARES = (2, 4)  # of the points that are left
_FEWER = (4, 16)  # times fewer rays
_CROWD = 4  # times as many lights


@dataclass(frozen=True)
class Side:
    """One way to train and to ask; the first side of a split is what the others are compared with.

    Attributes:
      label: for the table.
      learn: dotted settings in which the training side differs; it is baked anew where there are any.
      judge: settings of [lightings] in which held-out lightings differ; those of the configuration where there are none.
      train: keep only so many training lightings; 0 keeps all.
      points: fit with so many; 0 as configured.
      asked: ask with so many, of a model that was fitted with all; 0 asks as it was fitted.
      at: where it stands on the axis of a split that is a curve.
    """

    label: str
    learn: dict[str, Any] = field(default_factory=dict)
    judge: dict[str, Any] = field(default_factory=dict)
    train: int = 0
    points: int = 0
    asked: int = 0
    at: int = 0


@dataclass(frozen=True)
class Split:
    """A question about what lies beyond the training lightings.

    Attributes:
      question: in words.
      sides: of a configuration; raises UserError for one that it cannot be asked about.
      axis: what its sides are a curve over; nothing where they are none.
    """

    question: str
    sides: Callable[[Config], list[Side]]
    axis: str = ""


def _kind(config: Config) -> list[Side]:
    _drawn(config)
    spot, sun = {"lightings.kinds": ["spot"]}, {"lightings.kinds": ["directional"]}
    return [Side("spot, as trained", spot, spot), Side("directional", spot, sun)]


def _outside(config: Config) -> list[Side]:
    _drawn(config)
    settings = config.lightings
    if not set(settings.kinds) & _COLOURED:
        raise UserError(f"lightings.kinds: got {', '.join(settings.kinds)}, which stand nowhere and come from everywhere")
    if settings.distribution == "around" or not set(settings.kinds) & _PLACED:
        low, high = settings.elevation_deg
        if high - low < 1:
            raise UserError("lightings.elevation_deg: got a range of less than a degree, expected one with two halves")
        middle = (low + high) / 2
        above, below = {"lightings.elevation_deg": [middle, high]}, {"lightings.elevation_deg": [low, middle]}
        return [Side(f"above {middle:.3g}°, as trained", above, above), Side(f"below {middle:.3g}°", above, below)]
    extent = [high - low for low, high in zip(settings.region_low, settings.region_high, strict=True)]
    axis = extent.index(max(extent))
    middle = (settings.region_low[axis] + settings.region_high[axis]) / 2
    inner, outer = list(settings.region_high), list(settings.region_low)
    inner[axis] = outer[axis] = middle
    near, far = {"lightings.region_high": inner}, {"lightings.region_low": outer}
    return [Side(f"lower half of {'xyz'[axis]}, as trained", near, near), Side(f"upper half of {'xyz'[axis]}", near, far)]


def _colour(config: Config) -> list[Side]:
    _drawn(config)
    if not set(config.lightings.kinds) & _COLOURED:
        raise UserError(f"lightings.kinds: got {', '.join(config.lightings.kinds)}, whose colours are those of their picture")
    white, bright = {"lightings.saturation": [0.0, 0.0]}, {"lightings.saturation": [0.8, 1.0]}
    return [Side("white, as trained", white, white), Side("saturated colours", white, bright)]


def _crowd(config: Config) -> list[Side]:
    _drawn(config)
    many = _CROWD * config.lightings.lights[1]
    own = config.lightings.lights
    as_trained = f"{own[0]} to {own[1]} lights" if own[0] < own[1] else f"{own[0]} light{'s' if own[0] > 1 else ''}"
    return [Side(f"{as_trained}, as trained"), Side(f"{many} lights", {}, {"lightings.lights": [many, many]})]


def _points(config: Config) -> list[Side]:
    count = config.fit.points or config.points.count
    fewer = [count // share for share in _SHARES if count // share >= 2]
    if not fewer:
        raise UserError(f"points.count: got {count}, expected at least 4 to leave some out")
    told = [Side(f"{count} points")]
    told += [Side(f"{left} of {count}, not fitted again", asked=left) for left in fewer]
    return [*told, *(Side(f"fitted with {left}", points=left) for left in fewer)]


def _noise(config: Config) -> list[Side]:
    transport = config.transport
    told = [Side("rays as configured")]
    for times in _FEWER:
        if transport.samples == "auto":  # rays grow with the inverse square of the noise that is aimed at
            noise = transport.target_noise * times**0.5
            fewer: dict[str, Any] = {"transport.target_noise": noise} if noise <= 1 else {}
        else:
            fewer = {"transport.samples": transport.samples // times} if transport.samples >= times else {}
        if fewer:
            told.append(Side(f"a {times}th of the rays", fewer))
    if len(told) < 2:
        raise UserError(f"transport.samples: got {transport.samples}, of which there is no part")
    return told


def _size(config: Config) -> list[Side]:
    whole = config.lightings.train
    fewer = [count for count in _SIZES if count < whole]
    if not fewer:
        raise UserError(f"lightings.train: got {whole}, expected more than {_SIZES[0]} for a curve")
    return [Side(f"{count} lightings", train=count, at=count) for count in (whole, *reversed(fewer))]


def _drawn(config: Config) -> None:
    if config.lightings.file:
        raise UserError(f"lightings.file: got {config.lightings.file}, expected lightings that are drawn")


SPLITS: Catalogue[Split] = Catalogue(
    "split",
    {
        "kind": Split("Trained on spot lights, asked about parallel light (the paper's Figure 8).", _kind),
        "outside": Split("Trained in one half of the places (or heights) of lights, asked about the other.", _outside),
        "colour": Split("Trained on white light, asked about saturated colours (the paper's Figure 5).", _colour),
        "crowd": Split("Asked about more lights at once than were ever on in training.", _crowd),
        "points": Split("Fewer measurement points: those that a fitted model loses, and a fit with fewer.", _points),
        "noise": Split(
            "Training maps of a fraction of the rays; held-out maps as they are. Who profits from cheap data?", _noise
        ),
        "size": Split("Fewer training lightings, as a curve.", _size, "training lightings"),
    },
)


def split_names(asked: str) -> list[str]:
    """Names of entries from a list with commas; "all" for every one.

    Raises:
      UserError: no such split.
    """
    names = [*SPLITS] if asked.strip() == "all" else [name.strip() for name in asked.split(",") if name.strip()]
    for name in names:
        SPLITS[name]
    return list(dict.fromkeys(names))
