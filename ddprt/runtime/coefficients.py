"""What a frame asks of the basis textures: u = M x in microseconds, on the CPU and past the overhead of a JAX call.

A shader composes y = max(0, sum over textures of u_b B_b)^gamma. Here the scale of the measured light is folded into u, and a
mean counts as the first texture, so that these numbers and the textures are all that it needs. A frame is answered by one
compiled loop; many frames by a product of matrices, of the plain light where the model is linear without a mean.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ddprt.axes import Float32
from ddprt.compiled import compiled
from ddprt.errors import UserError
from ddprt.fitting.encoding import Encoding
from ddprt.methods.svd_ridge import LinearTransfer

_MANY = 16  # frames from which BLAS is faster than the loop
_LARGEST = float(np.finfo(np.float32).max)
_LANES = 16
_DIVISIBLE = 2.0**126  # as in `ddprt.fitting.encoding`


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The transfer of a linear model, laid out for the CPU.

    Attributes:
      matrix: M transposed, so that the loop over bases runs along memory.
      offset, intercept: as in `LinearTransfer`.
      power: 1 / gamma; 1 in linear space.
      leads: 1 where a mean is the first texture, else 0.
    """

    matrix: Float32[np.ndarray, "groups inputs bases"]
    offset: Float32[np.ndarray, "groups inputs"]
    intercept: Float32[np.ndarray, "groups bases"]
    power: float
    leads: int

    @cached_property
    def _at_once(self) -> Float32[np.ndarray, "values answers"] | None:
        """M of all groups as one matrix for measured light as it lies in memory; None where answers are not M x.

        Two thirds of it are zeros for three channels, which costs less than to pull the channels apart.
        """
        if self.power != 1 or self.leads or self.offset.any() or self.intercept.any():
            return None
        groups, inputs, bases = self.matrix.shape
        wide = np.zeros((inputs, groups, groups, bases), np.float32)
        for group in range(groups):
            wide[:, group, group] = self.matrix[group]
        return wide.reshape(inputs * groups, groups * bases)

    @classmethod
    def of(cls, relighter: object, encoding: Encoding) -> "Coefficients":
        """Those of a model.

        Raises:
          UserError: its method is not linear.
        """
        if not isinstance(relighter, LinearTransfer):
            raise UserError("coefficients: got a method without a linear basis, expected svd-ridge; use predict instead")
        return cls(
            np.ascontiguousarray(np.asarray(relighter.matrix).swapaxes(1, 2)),
            np.asarray(relighter.offset),
            np.asarray(relighter.intercept),
            1.0 if encoding.space == "linear" else 1 / encoding.gamma,
            int(np.asarray(relighter.mean).any()),
        )

    def answer(self, values: Float32[np.ndarray, "frames points 3"]) -> Float32[np.ndarray, "frames groups textures"] | None:
        """Weights of the textures for each frame; None where light is not finite."""
        frames = len(values)
        groups, inputs, bases = self.matrix.shape
        seen = values if groups == 3 else values.reshape(frames, inputs, 1)
        out = np.zeros((frames, groups, bases + self.leads), np.float32)
        power = np.float32(self.power)
        if frames < _MANY:
            fine = _answer(seen, self.matrix, self.offset, self.intercept, power, self.leads, out)
            return out if fine else None
        if self._at_once is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                answered = values.reshape(frames, -1) @ self._at_once
            # Zeros times infinity are NaN: light that is not finite shows. So does a sum past the range, which scaling keeps.
            if np.isfinite(answered).all():
                return answered.reshape(frames, groups, bases)
        encoded, size = np.empty((groups, frames, inputs), np.float32), np.empty((groups, frames, 1), np.float32)
        if not _encode(seen, self.offset, power, encoded, size):
            return None
        with np.errstate(over="ignore"):
            answered = size * (encoded @ self.matrix + self.intercept[:, None])
        out[:, :, self.leads :] = np.clip(answered, -_LARGEST, _LARGEST).swapaxes(0, 1)
        if self.leads:
            out[:, :, 0] = size[..., 0].T
        return out


@compiled
def _answer(
    values: np.ndarray,
    matrix: np.ndarray,
    offset: np.ndarray,
    intercept: np.ndarray,
    power: np.floating,
    leads: int,
    out: np.ndarray,
) -> bool:
    """Fills `out`; False where the measured light is not finite. Frames without light stay 0."""
    groups, inputs, bases = matrix.shape
    encoded, sizes = np.empty((groups, 1, inputs), np.float32), np.empty((groups, 1, 1), np.float32)
    for frame in range(len(values)):
        if not _encode(values[frame : frame + 1], offset, power, encoded, sizes):
            return False
        for group in range(groups):
            size, z, M = sizes[group, 0, 0], encoded[group, 0], matrix[group]
            if size == 0:
                continue
            u = out[frame, group, leads:]
            u[:] = intercept[group]
            whole = inputs // 4 * 4
            for p in range(0, whole, 4):  # four at a time: u is read and written a quarter as often
                a, b, c, d = z[p], z[p + 1], z[p + 2], z[p + 3]
                for k in range(bases):
                    u[k] += (a * M[p, k] + b * M[p + 1, k]) + (c * M[p + 2, k] + d * M[p + 3, k])
            for p in range(whole, inputs):
                for k in range(bases):
                    u[k] += z[p] * M[p, k]
            for k in range(bases):
                u[k] = min(max(u[k] * size, np.float32(-_LARGEST)), np.float32(_LARGEST))
            if leads:
                out[frame, group, 0] = size
    return True


@compiled
def _encode(values: np.ndarray, offset: np.ndarray, power: np.floating, z: np.ndarray, size: np.ndarray) -> bool:
    """Scaled, bent and centred values, (groups, frames, inputs), and what answers are multiplied by before a shader's gamma.

    The factor of a dark frame is 0. False where a value is not finite.
    """
    groups, inputs = z.shape[0], z.shape[2]
    parts = np.empty(_LANES)
    for frame in range(len(values)):
        for p in range(inputs):
            for group in range(groups):
                z[group, frame, p] = values[frame, p, group]
        for group in range(groups):
            row = z[group, frame]
            parts[:] = 0
            whole = inputs // _LANES * _LANES
            for p in range(0, whole, _LANES):  # side by side, which a plain sum may not be turned into
                for lane in range(_LANES):
                    parts[lane] += np.float64(row[p + lane]) * np.float64(row[p + lane])
            total = parts.sum()
            for p in range(whole, inputs):
                total += np.float64(row[p]) * np.float64(row[p])  # no float32's square leaves the range of float64
            if not np.isfinite(total):
                return False
            scale = np.float32(min(np.sqrt(total), _DIVISIBLE))
            size[group, frame, 0] = scale**power
            if scale == 0:
                row[:] = 0
                continue
            for p in range(inputs):
                row[p] /= scale
            if power != 1:
                for p in range(inputs):
                    bent = abs(row[p]) ** power
                    row[p] = bent if row[p] >= 0 else -bent
            for p in range(inputs):
                row[p] -= offset[group, p]
    return True
