"""The same small search for every method: how its settings are drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.bench.measure.settings import changed, digest_of
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.methods import known_methods, make_method, method_named
from ddprt.methods.floors import MeanLightmap, NearestLighting

BASELINE = "svd-ridge"
_MEANT_FOR = 16  # bases that choices of `bases` are written for
_REDRAWN = 100  # times, where a draw was there before


@dataclass(frozen=True)
class Trial:
    """One method with settings of its own, to be fitted on one deal.

    Attributes:
      method: entry of `METHODS`.
      seed: number of the deal.
      settings: what differs from the configuration; "fit.KEY" belongs to [fit], all else to the method.
    """

    method: str
    seed: int
    settings: dict[str, Any]

    def configured(self, config: Config) -> Config:
        """The configuration with these settings.

        Raises:
          UserError: a value that its setting does not take.
        """
        own = {**config.methods.settings.get(self.method, {})}
        own |= {key: value for key, value in self.settings.items() if not key.startswith("fit.")}
        of_fit = {key: value for key, value in self.settings.items() if key.startswith("fit.")}
        document = changed(config, of_fit) if of_fit else config
        return document.model_copy(update={"methods": document.methods.model_copy(update={"settings": {self.method: own}})})

    def digest(self, config: Config, source: str) -> str:
        """Hash of all that its fit depends on; `source` is that of the data.

        Raises:
          UserError: a value that its setting does not take.
        """
        whole = self.configured(config)
        shared = whole.fit.model_dump(mode="json", exclude={"method", "checkpoint_seconds", "tensorboard"})
        own = make_method(
            self.method, whole.fit.model_dump(exclude={"method", "points"}), whole.methods.settings[self.method]
        ).model_dump(mode="json")
        asked = [config.seed, config.points.quantity, config.export.precision]
        return digest_of([source, self.method, self.seed, shared, own, asked])


def rivals(config: Config) -> list[str]:
    """The baseline, and who is compared with it.

    Raises:
      UserError: no such method, or a floor.
    """
    floors = {name for name in known_methods() if issubclass(method_named(name), MeanLightmap | NearestLighting)}
    asked = config.leagues.methods or [name for name in known_methods() if name not in floors]
    for name in asked:
        method_named(name)
        if name in floors:
            raise UserError(f'leagues.methods: got "{name}", which is a floor, expected rivals of {BASELINE}; leave it out')
    return [BASELINE, *(name for name in dict.fromkeys(asked) if name != BASELINE)]


def trials_of(config: Config, method: str, seed: int, count: int | None = None) -> list[Trial]:
    """What a method tries for a seed: the configuration as it stands, then draws from its `search`.

    Every choice of a setting comes about as often as the others. Methods with fewer different settings have fewer trials, and
    those without a `search` one.

    Args:
      config: with [leagues].
      method: entry of `METHODS`.
      seed: number of the deal.
      count: of trials; None takes `leagues.trials`.
    """
    count = config.leagues.trials if count is None else count
    choices = _scaled(method_named(method).search, config, method)
    found = [Trial(method, seed, {})]
    if not choices:
        return found
    rng = seeds.stream(config.seed, f"search {method}", seed)
    columns = {key: _evenly(values, count - 1, rng) for key, values in choices.items()}
    defaults = _defaults(config, method)
    seen = [{key: defaults.get(key) for key in choices}]
    for row in range(count - 1):
        drawn = {key: column[row] for key, column in columns.items()}
        for _ in range(_REDRAWN):
            if drawn not in seen:
                break
            drawn = {key: values[rng.integers(len(values))] for key, values in choices.items()}
        if drawn not in seen:
            seen.append(drawn)
            found.append(Trial(method, seed, drawn))
    return found


def _scaled(search: Mapping[str, Sequence[Any]], config: Config, method: str) -> dict[str, list[Any]]:
    own = config.methods.settings.get(method, {})
    bases = int(own.get("bases", config.fit.bases))
    told = {key: list(values) for key, values in search.items()}
    if "bases" in told:
        told["bases"] = list(dict.fromkeys(max(1, round(value * bases / _MEANT_FOR)) for value in told["bases"]))
    return told


def _defaults(config: Config, method: str) -> dict[str, Any]:
    shared = config.fit.model_dump(exclude={"method", "points"})
    own = make_method(method, shared, config.methods.settings.get(method, {})).model_dump()
    return {f"fit.{key}": value for key, value in shared.items()} | own


def _evenly(values: Sequence[Any], count: int, rng: np.random.Generator) -> list[Any]:
    """So many of the values by chance, each about as often as the others."""
    order: list[Any] = []
    while len(order) < count:
        order += [values[index] for index in rng.permutation(len(values))]
    return order[:count]
