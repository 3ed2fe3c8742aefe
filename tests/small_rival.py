"""A rival that is fitted at once, as another package would bring it: the mean lightmap, some share brighter than it is."""

from collections.abc import Mapping
from typing import Any, ClassVar

from ddprt.methods.floors import MeanLightmap, MeanMap
from ddprt.methods.method import Examples, Method


class Gain(Method):
    """Another brightness."""

    relighter: ClassVar[type] = MeanMap
    why: ClassVar[str] = "learns nothing, in no time"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {"gain": (0.5, 1.0, 2.0)}
    gain: float = 1.0

    def fit(self, train: Examples, validation: Examples, *, key: Any) -> MeanMap:
        """See `Method`."""
        found = MeanLightmap().fit(train, validation, key=key)
        return MeanMap(self.gain * found.mean, found.report)
