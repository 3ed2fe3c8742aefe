"""Ways to get from measured light to indirect light, under one contract.

Enters: scaled and encoded pairs. Leaves: a Relighter. Files, scenes and metrics never enter.
"""

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from ddprt.catalogue import Catalogue
from ddprt.errors import UserError, explain, nearest
from ddprt.methods import packages
from ddprt.methods.autoencoder import Autoencoder
from ddprt.methods.floors import MeanLightmap, NearestLighting
from ddprt.methods.light_network import LightNetworks
from ddprt.methods.method import Method
from ddprt.methods.mlp import Mlp
from ddprt.methods.neural_lightmap import NeuralMap
from ddprt.methods.nonnegative import Nonnegative
from ddprt.methods.point_set import PointSet
from ddprt.methods.residual import Residual
from ddprt.methods.sh_prt import ShPrt
from ddprt.methods.svd_ridge import SvdRidge

METHODS: Catalogue[type[Method]] = Catalogue(
    "method",
    {
        "svd-ridge": SvdRidge,
        "mean": MeanLightmap,
        "nearest": NearestLighting,
        "mlp": Mlp,
        "autoencoder": Autoencoder,
        "residual": Residual,
        "nonnegative": Nonnegative,
        "neural-lightmap": NeuralMap,
        "sh-prt": ShPrt,
        "light-network": LightNetworks,
        "point-set": PointSet,
    },
)
packages.register(METHODS)


def known_methods() -> tuple[str, ...]:
    """Names of all entries, those of packages that were still being imported when `METHODS` was made among them."""
    packages.register_postponed(METHODS)
    return tuple(METHODS)


def method_named(name: str) -> type[Method]:
    """An entry of `METHODS`.

    Raises:
      UserError: there is none, or it is of another package that had to be left out.
    """
    if name not in known_methods() and name in packages.REFUSED:
        raise UserError(packages.REFUSED[name])
    return METHODS[name]


def make_method(name: str, shared: Mapping[str, Any], own: Mapping[str, Any]) -> Method:
    """A method with its settings.

    Args:
      name: entry of `METHODS`.
      shared: settings of the [fit] section; each method takes those it knows.
      own: the method's own settings, all of which it must know.
    Raises:
      UserError: unknown method or setting, wrong type or range, or a method of another package that had to be left out.
    """
    method = method_named(name)
    known = method.model_fields
    for setting in own:
        if setting not in known:
            raise UserError(
                f"methods.settings.{name}.{setting}: unknown setting{nearest(setting, known)}; "
                f"known: {', '.join(sorted(known))}"
            )
    try:
        return method(**{**{key: value for key, value in shared.items() if key in known}, **own})
    except ValidationError as error:
        faults = error.errors()
        # Several where a value may be of several kinds.
        of_one = [fault for fault in faults if fault["loc"][:1] == faults[0]["loc"][:1]]
        place = ".".join(map(str, faults[0]["loc"][:1]))
        raise UserError(f"methods.settings.{name}.{place}: {explain(of_one)}") from None


__all__ = ["METHODS", "Method", "known_methods", "make_method", "method_named"]
