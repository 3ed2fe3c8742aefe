"""A Model of what moves: one basis, and a transfer matrix for each keyframe or one for all.

Between keyframes matrices are mixed linearly, which is what an engine does with two sets of numbers and a share; points and
what casts shadows follow the mesh, as the engine has it or along straight lines between keyframes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ddprt.axes import Float32, Float64, Int
from ddprt.lights import Light, Lighting
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model
from ddprt.sampling.riding import Riders
from ddprt.scene.poses import check_pose, check_time


@dataclass(frozen=True, eq=False)
class AnimatedModel:
    """Relights what moves; make one with `ddprt.fit_animation` or `ddprt.load_animated`.

    Attributes:
      rest: the model of the first keyframe, which holds the basis and all else that keyframes share.
      times: of the keyframes, seconds.
      positions: of the vertices there, metres.
      triangles: of the mesh.
      riders: where light is measured.
      matrix, offset, intercept: of each keyframe, or of all; see `LinearTransfer`.
      area: of the texels in each keyframe, m².
      constant: light of what glows there, W/m²; None where nothing does.
      statuses: of each fit.
    """

    rest: Model
    times: Float64[np.ndarray, " keys"]
    positions: Float64[np.ndarray, "keys vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]
    riders: Riders
    matrix: Float32[np.ndarray, "matrices groups bases inputs"]
    offset: Float32[np.ndarray, "matrices groups inputs"]
    intercept: Float32[np.ndarray, "matrices groups bases"]
    area: Float64[np.ndarray, "keys texels"]
    constant: Float32[np.ndarray, "keys texels 3"] | None = None
    statuses: tuple[str, ...] = ()

    @property
    def nbytes(self) -> int:
        """Bytes that ship: the basis once, and the matrices."""
        shared = self.rest.relighter
        own = sum(array.nbytes for array in (self.matrix, self.offset, self.intercept))
        return int(shared.basis.nbytes + shared.mean.nbytes + own)  # type: ignore[attr-defined]

    def at(self, time: Any, positions: Any = None) -> Model:
        """The model of a moment.

        Args:
          time: from the first keyframe to the last, seconds.
          positions: of the vertices then, (vertices, 3), metres, as whoever animates them has them; None goes straight from
            key to key.
        Raises:
          UserError: a time outside of the keyframes, or a pose that is none; see `check_pose`.
        """
        time = check_time(self.times, time)
        k, share = self._place(time)
        name, do = "positions", "mend the pose"
        if positions is None:
            positions = _mixed(self.positions, k, share)
            name, do = f"the pose straight between keyframes at {time:g} s", "pass positions, or take more keyframes"
        corners = check_pose(positions, self.triangles, self.positions.shape[1], name, do)[self.triangles]
        own = (0, 0.0) if len(self.matrix) == 1 else (k, share)
        relighter = self.rest.relighter
        assert isinstance(relighter, LinearTransfer)
        parts: dict[str, Any] = {
            name: jnp.asarray(_mixed(getattr(self, name), *own)) for name in ("matrix", "offset", "intercept")
        }
        return replace(
            self.rest,
            relighter=replace(relighter, **parts),
            samples=self.riders.at(corners, self.rest.samples.depth),
            area=_mixed(self.area, k, share),
            occluders=corners,
            constant=None if self.constant is None else _mixed(self.constant, k, share),
        )

    def relight(
        self,
        lighting: Lighting | Light | Sequence[dict[str, Any]] | dict[str, Any],
        *,
        time: Any,
        positions: Any = None,
    ) -> Float32[np.ndarray, "height width 3"]:
        """Indirect lightmap of a lighting at a time; see `Model.relight` and `at`."""
        return self.at(time, positions).relight(lighting)

    def save(self, folder: str | Path) -> None:
        """Writes a self-contained folder: the model of the first keyframe, animation.json and animation.safetensors."""
        from ddprt.runtime.animated_file import save_animated

        save_animated(self, Path(folder))

    def _place(self, time: float) -> tuple[int, float]:
        """The keyframe at or before a time, and the share of the way to the next."""
        k = int(np.searchsorted(self.times, time, side="right")) - 1
        if time == self.times[k]:
            return k, 0.0
        return k, float((time - self.times[k]) / (self.times[k + 1] - self.times[k]))


def _mixed(values: np.ndarray, k: int, share: float) -> np.ndarray:
    """Between the k-th and the next; of a keyframe itself every bit."""
    if share == 0:
        return values[k]
    return ((1 - share) * values[k] + share * values[k + 1]).astype(values.dtype)
