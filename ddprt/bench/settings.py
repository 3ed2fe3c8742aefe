"""Settings that are tried: changes about a configuration, from [sweep] or from a plan of our own."""

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ddprt.config import Config, checked
from ddprt.methods import METHODS

ASKED = ("bench", "sweep", "budget", "tune", "report")
"""Sections that say what is measured, not what is made."""
BAKED = ("scene", "atlas", "lightings", "points", "transport")
"""Sections that a dataset depends on."""
_HALVINGS = (8, 4, 2)


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
        return _digest(self.config.model_dump(mode="json", exclude=set(ASKED)))

    @property
    def bake_digest(self) -> str:
        """Hash of all that the training maps depend on: equal ones share a dataset."""
        document = self.config.model_dump(mode="json", include={*BAKED, "seed"})
        document["points"].pop("quantity")
        for unused, section in (("test", "lightings"), ("test_samples", "transport"), ("threads", "transport")):
            document[section].pop(unused)
        return _digest(document)


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
      UserError: a value that its setting does not take.
    """
    sweep = config.sweep or plan_of(config)
    if config.bench.combine == "grid":
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
    """Every knob that trades error against time, memory or bytes, from coarse to fine about where it stands."""
    points, lightings, resolution = config.points.count, config.lightings.train, config.atlas.resolution
    noise = config.transport.target_noise
    fewer = lambda count, least: tuple(count // part for part in _HALVINGS if count // part >= least)  # noqa: E731
    plan: dict[str, tuple[Any, ...]] = {
        "fit.bases": tuple(bases for bases in (4, 8, 16, 32, 64) if bases < 3 * lightings),
        "fit.points": fewer(points, 4),
        "fit.ridge": ("auto", 0.0, 1e-4, 1e-2),
        "fit.space": ("linear", "gamma"),
        "fit.centre": ("none", "mean"),
        "fit.channels": ("mono", "multi"),
        "fit.method": tuple(METHODS),
        "export.precision": ("half", "float"),
        "lightings.train": (*fewer(lightings, 4), 2 * lightings),
        "transport.target_noise": tuple(min(1.0, noise * factor) for factor in (8, 4, 2, 0.5)),
        "transport.sender_resolution": (32, 64, 128),
        "transport.bounces": (1, 2, 4),
        "points.supersample": (1, 2, 4, 8, 16),
        "atlas.resolution": (*fewer(resolution, 32)[1:], 2 * resolution) if resolution < 512 else fewer(resolution, 32),
    }
    return {key: values for key, values in plan.items() if values}


def _at(config: Config, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value[part] if isinstance(value, dict) else getattr(value, part)
    return value


def _spoken(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _digest(document: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]
