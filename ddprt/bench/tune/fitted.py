"""What a search keeps of a setting, so that nothing is fitted or scored twice."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ddprt.axes import Float32
from ddprt.bench.measure.yardstick import Yardstick
from ddprt.dataset.store import Dataset
from ddprt.report.metrics import Tally
from ddprt.runtime.model import Model


@dataclass(frozen=True, eq=False)
class Fitted:
    """A setting that was baked and fitted.

    Attributes:
      model: in float32.
      data: what it was fitted to.
      bake: what that took, see `Workshop.bake`.
      seconds: of the fit.
      tallies: errors that were told of it, by number of bases that are kept and precision, then by yardstick.
    """

    model: Model
    data: Dataset
    bake: dict[str, Any]
    seconds: float
    tallies: dict[tuple[int, str], dict[Yardstick, Tally]] = field(default_factory=dict)

    @property
    def values(self) -> Float32[np.ndarray, "points rgb"]:
        """What the points measure under the first lighting of training, W/m²."""
        return self.data.values(self.data.split("train")[:1], self.model.points, self.model.quantity)[0]
