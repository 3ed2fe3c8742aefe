"""R, what senders send on of the light that falls on them: opaque ones at once, bodies that light passes from elsewhere."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt.axes import Float32, Int
from ddprt.scene.atlas import Senders


@dataclass(frozen=True, eq=False)
class Reflection:
    """R: what leaves senders of the light that falls on them, for some lightings.

    Attributes:
      albedo, coarse: of opaque senders and of the coarse blocks of them; 0 for others.
      largest: share of the light that leaves the brightest sender.
      bodies: senders that light passes, None where there are none.
      home, share: coarse block of each of them, and its share of that block's area.
      leaving: what their surface lets out, a factor.
      passage: a `ddprt.transport.subsurface.Passage` among them.
    """

    albedo: Float32[np.ndarray, "senders columns"]
    coarse: Float32[np.ndarray, "coarse columns"]
    largest: float
    bodies: Int[np.ndarray, " inside"] | None = None
    home: Int[np.ndarray, " inside"] | None = None
    share: Float32[np.ndarray, " inside"] | None = None
    leaving: Float32[np.ndarray, "inside columns"] | None = None
    passage: Any = None

    @classmethod
    def of(cls, senders: Senders, coarser: Senders, lightings: int, passage: Any = None) -> "Reflection":
        """R among senders and their coarse blocks.

        Args:
          senders, coarser: see `ddprt.transport.operator.Operator`.
          lightings: how many.
          passage: through bodies, if there are any.
        """
        fine, coarse = (blocks.albedo.astype(np.float32) for blocks in (senders, coarser))
        if passage is None:
            return cls(np.tile(fine, lightings), np.tile(coarse, lightings), float(fine.max()))
        bodies = passage.senders
        home = np.zeros(senders.count, np.int64)
        home[senders.of_texel] = coarser.of_texel
        leaving = np.tile(fine[bodies], lightings)
        fine[bodies], coarse[home[bodies]] = 0, 0
        share = senders.area[bodies] / np.bincount(home, senders.area)[home[bodies]]
        opaque = np.tile(fine, lightings), np.tile(coarse, lightings), max(float(fine.max()), passage.largest)
        return cls(*opaque, bodies, home[bodies], share.astype(np.float32), leaving, passage)

    def radiosity(self, light: Float32[np.ndarray, "senders columns"]) -> Float32[np.ndarray, "senders columns"]:
        """Radiosity, W/m²."""
        sent = light * self.albedo
        if self.passage:
            sent[self.bodies] = self.leaving * self.passage.of(light[self.bodies])
        return sent

    def coarsely(self, light: Float32[np.ndarray, "coarse columns"], finer: Any) -> Float32[np.ndarray, "coarse columns"]:
        """The same on coarse blocks; light goes through bodies between senders, since it may not get far."""
        sent = self.coarse * light
        if self.passage:
            assert self.home is not None
            assert self.share is not None
            passed = self.leaving * self.passage.of((finer[self.bodies] @ light).astype(np.float32))
            np.add.at(sent, self.home, self.share[:, None] * passed)
        return sent

    def arrived(self, *light: Float32[np.ndarray, "senders columns"]) -> Float32[np.ndarray, "inside columns"] | None:
        """The sum of light on senders of bodies."""
        return None if self.bodies is None else sum(part[self.bodies] for part in light[1:]) + light[0][self.bodies]
