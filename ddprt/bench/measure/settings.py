"""Settings that are tried: changes about a configuration, from [sweep] or from a plan of our own."""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ddprt.config import Config, checked
from ddprt.errors import UserError
from ddprt.methods import METHODS

ASKED = ("bench", "sweep", "leagues", "budget", "tune", "report")
"""Sections that say what is measured, not what is made."""
BAKED = ("scene", "atlas", "lightings", "points", "transport", "effects")
"""Sections that a dataset depends on."""
_HALVINGS = (8, 4, 2)
_SENDERS = 128  # along a side, at most, where transport.sender_resolution is 0
_MOST = 10_000
"""Settings of a sweep: at a second each that is hours, and beyond it a grid that nobody meant."""


@dataclass(frozen=True)
class Setting:
    """A configuration, and how it differs from the one that all are compared with.

    Attributes:
      changes: dotted keys and their values; empty for the base itself.
      config: the whole.
    """

    changes: dict[str, Any]
    config: Config

    @property
    def name(self) -> str:
        """In words: "fit.bases = 4, fit.space = gamma"."""
        return ", ".join(f"{key} = {_spoken(value)}" for key, value in self.changes.items()) or "as configured"

    @property
    def digest(self) -> str:
        """Hash of all that the results depend on."""
        return digest_of(self.config.model_dump(mode="json", exclude=set(ASKED)))

    @property
    def bake_digest(self) -> str:
        """Hash of all that training maps and points depend on: equal ones share a dataset.

        Held-out lightings count, since `points.depth` goes by the nearest of all lamps.
        """
        document = self.config.model_dump(mode="json", include={*BAKED, "seed"})
        for unused, section in (("quantity", "points"), ("test_samples", "transport"), ("threads", "transport")):
            document[section].pop(unused)
        return digest_of(document)


def changed(config: Config, changes: dict[str, Any]) -> Config:
    """A configuration with other values at dotted keys.

    Raises:
      UserError: a value that its setting does not take.
    """
    document = config.model_dump(mode="json")
    for key, value in changes.items():
        *parents, leaf = key.split(".")
        table = document
        for parent in parents:
            table = table[parent]
        table[leaf] = value
    return checked(document, "[sweep]")


def settings_of(config: Config) -> list[Setting]:
    """The base, and what is tried about it; those that share a dataset stand together.

    Args:
      config: with [sweep], or without one for `plan_of`; `bench.combine` says whether knobs are turned each or all together.
    Raises:
      UserError: a value that its setting does not take, or a grid of more than 10,000 settings.
    """
    sweep = config.sweep or plan_of(config)
    if config.bench.combine == "grid":
        count = math.prod(len(values) for values in sweep.values())
        if count > _MOST:
            raise UserError(
                f"[sweep]: got a grid of {count} settings, expected at most {_MOST}; "
                'name fewer knobs or values in [sweep], or set bench.combine = "each"'
            )
        ways: Iterator[dict[str, Any]] = (
            dict(zip(sweep, values, strict=True)) for values in itertools.product(*sweep.values())
        )
    else:
        ways = ({key: value} for key, values in sweep.items() for value in values)
    found: dict[str, Setting] = {}
    for changes in ({}, *ways):
        whole = changed(config, changes)
        told = {key: value for key, value in changes.items() if _at(whole, key) != _at(config, key)}
        setting = Setting(told, whole)
        found.setdefault(setting.digest, setting)
    together: dict[str, list[Setting]] = {}
    for setting in found.values():
        together.setdefault(setting.bake_digest, []).append(setting)
    return [setting for group in together.values() for setting in group]


def plan_of(config: Config) -> dict[str, tuple[Any, ...]]:
    """Every knob that trades error against time, memory or bytes, from coarse to fine about where it stands.

    Knobs that have no effect, because a file or another setting says what they would, are left out.
    """
    points, lightings, resolution = config.points.count, config.lightings.train, config.atlas.resolution
    fewer = lambda count, least: tuple(count // part for part in _HALVINGS if count // part >= least)  # noqa: E731
    plan: dict[str, tuple[Any, ...]] = {
        "fit.bases": tuple(bases for bases in (4, 8, 16, 32, 64) if bases < 3 * lightings),
        "fit.points": () if config.points.file else fewer(points, 4),
        "fit.ridge": ("auto", 0.0, 1e-4, 1e-2),
        "fit.space": ("linear", "gamma"),
        "fit.centre": ("none", "mean"),
        "fit.channels": ("mono", "multi"),
        "fit.method": tuple(METHODS),
        "export.precision": ("half", "float"),
        "lightings.train": () if config.lightings.file else (*fewer(lightings, 4), 2 * lightings),
        **_rays(config),
        "transport.sender_resolution": _senders(config),
        "transport.bounces": (1, 2, 4),
        "points.supersample": () if config.points.file else (1, 2, 4, 8, 16),
        "atlas.resolution": (*fewer(resolution, 32)[1:], 2 * resolution) if resolution < 512 else fewer(resolution, 32),
    }
    return {key: values for key, values in plan.items() if values}


def _rays(config: Config) -> dict[str, tuple[Any, ...]]:
    """The knob of noise: what is aimed at, or the samples themselves where they are given."""
    samples, noise = config.transport.samples, config.transport.target_noise
    if samples == "auto":
        return {"transport.target_noise": tuple(max(1e-4, min(1.0, noise * factor)) for factor in (8, 4, 2, 0.5))}
    return {"transport.samples": tuple(sorted({max(1, samples // 4), max(1, samples // 2), min(65536, 2 * samples)}))}


def _senders(config: Config) -> tuple[int, ...]:
    """Resolutions of senders that make others than there are: senders are whole texels, so several give the same."""
    if config.transport.integrator not in ("auto", "operator"):
        return ()
    found = {_block(config, config.transport.sender_resolution): 0}
    for side in (32, 64, 128):
        found.setdefault(_block(config, side), side)
    return tuple(side for side in found.values() if side)


def _block(config: Config, side: int) -> int:
    """Texels along a sender, as `transport/operator.py` cuts them."""
    resolution = config.atlas.resolution
    return max(1, round(resolution / (side or min(resolution, _SENDERS))))


def _at(config: Config, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value[part] if isinstance(value, dict) else getattr(value, part)
    return value


def _spoken(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def digest_of(document: Any) -> str:
    """Hash of what JSON can say."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]
