"""Classical precomputed radiance transfer: distant light as spherical harmonics, a matrix from them to every texel.

A lighting is told by the coefficients of its radiance, L_k = integral of L Y_k, of one colour channel: E Y_k(-d) for parallel
light of irradiance E that travels along d, sums over its pixels for a sky. Nothing is measured; the points only set the scale
that all methods work in.

Sloan, Kautz and Snyder (2002) fill the matrix by projection: T_k = integral over the sphere of I(w) Y_k(w), where I(w) is the
indirect light under unit light from w; by linearity that is the light under the harmonic Y_k as a lamp. Here it is the least
squares fit of I(w_i) = sum of T_k Y_k(w_i) over the training lightings, which needs nothing that a dataset lacks. With A the
rows Y(w_i), and r what of I no harmonic up to the order makes, the fit is off the projection by (A^T A)^-1 A^T r: nothing where
the directions integrate products of harmonics with I exactly, and ever less as they fill the sphere evenly
(tests/test_sh_prt.py holds it to that bound). Where they cover a part of the sphere, as above a ground, the fit knows that part
alone, and is better there than a projection, which has to make the rest.

Either way what is left is light without the frequencies that the order lacks: a sharp sun becomes a broad blur that reaches
behind the object. `window` takes the ringing of that blur down, and blurs more (Sloan, "Stupid Spherical Harmonics (SH)
Tricks", 2008).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from pydantic import Field

from ddprt import harmonics
from ddprt.errors import UserError
from ddprt.fitting.basis import entry_weights
from ddprt.fitting.selection import RANK_CUT, Spectrum, choose_ridge, decompose
from ddprt.fitting.transfer import solve_transfer
from ddprt.methods.method import (
    Examples,
    FitReport,
    Frame,
    Method,
    array_bytes,
    as_pytree,
    found_in,
    in_memory,
    static,
)


def describe(lightings: Sequence[Any], order: int) -> Float64[np.ndarray, "lightings harmonics 3"]:
    """Coefficients of the radiance that comes from each direction, W/(m² sr) times sr.

    Args:
      lightings: each a sequence of lights: directional, or of a kind that knows its own coefficients: `harmonics(order)`,
        (harmonics, 3), the integral of radiance times each harmonic of `ddprt.harmonics`.
      order: of the harmonics.
    Raises:
      UserError: a light that has a place.
    """
    found = np.zeros((len(lightings), harmonics.count(order), 3))
    for row, lights in zip(found, lightings, strict=True):
        for light in lights:
            if hasattr(light, "harmonics"):
                row += light.harmonics(order)
            elif light.kind == "directional":
                row += np.outer(harmonics.harmonics(-np.array(light.direction), order), light.irradiance)
            else:
                raise UserError(
                    f"sh-prt: got a light of type {light.kind}, which stands somewhere; expected distant light, as "
                    'lightings.kinds = ["directional", "environment"] draws; take another method for lamps'
                )
    return found


@as_pytree
@dataclass(frozen=True)
class HarmonicTransfer:
    """y = T L, each colour channel by itself."""

    transfer: Float[Array, "harmonics texels 3"]
    order: int = static(default=0)
    report: FitReport = field(default=FitReport(), compare=False)

    def describe(self, lightings: Sequence[Any]) -> Float64[np.ndarray, "lightings harmonics 3"]:
        """See `AsksForLights`."""
        return describe(lightings, self.order)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        return jnp.einsum("fkc,ktc->ftc", frame.described, self.transfer, precision="highest")

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`."""
        return 2 * int(self.transfer.size)


class ShPrt(Method):
    """Least-squares transfer from harmonics of distant light; all channels share one ridge."""

    relighter: ClassVar[type] = HarmonicTransfer
    why: ClassVar[str] = "classical: light itself is cut to low frequencies, whatever the scene does with it"
    space: Literal["linear"] = "linear"
    order: int = Field(3, ge=0, le=6, description="of the harmonics; (order + 1)² of them")
    window: Literal["none", "hanning", "lanczos"] = "none"
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> HarmonicTransfer:
        """See `Method`; neither `validation` nor `key` is used. A lighting counts whatever its strength.

        Raises:
          UserError: a light that has a place.
        """
        described = describe(train.frame.lightings or (), self.order)
        light, scale = np.asarray(in_memory(train.indirect)), np.asarray(train.scale, np.float64)
        root = np.sqrt(entry_weights(train.area, train.weights, "mono").astype(np.float64))  # type: ignore[arg-type]
        size = np.linalg.norm(described, axis=1)
        X, relative = described / _positive(size)[:, None], scale / _positive(size)
        lit = [np.flatnonzero(size[:, channel] > 0) for channel in range(3)]
        seen = [c for c in range(3) if len(lit[c])]
        spectra = [_spectrum(X[lit[c], :, c], light[lit[c], :, c] * relative[lit[c], c, None] * root) for c in seen]
        weight = [size[lit[c], c] ** 2 for c in seen]
        choice = choose_ridge(spectra, weight, [lit[c] for c in seen]) if self.ridge == "auto" and seen else None
        ridge = choice.ridge if choice else self.ridge if self.ridge != "auto" else 0.0
        solved = [solve_transfer(spectrum, ridge, None, w) for spectrum, w in zip(spectra, weight, strict=True)]
        transfer = np.zeros((harmonics.count(self.order), light.shape[1], 3))
        for c in seen:
            rows = lit[c]
            transfer[:, :, c] = _solution(X[rows, :, c], ridge) * relative[rows, c] @ light[rows, :, c].astype(np.float64)
        transfer *= window(self.window, self.order)[:, None, None]
        remarks = {name for one in solved for name in one.remarks if name != "rank_deficient"}  # which speaks of bases there
        few = any(one.rank < harmonics.count(self.order) for one in solved)
        dark = not (light.any() and scale.any())
        report = FitReport(
            bases=harmonics.count(self.order),
            numerical_rank=max((one.rank for one in solved), default=0),
            condition=tuple(one.condition for one in solved),
            ranks=tuple(one.rank for one in solved),
            ridge=tuple(one.ridge for one in solved),
            ridge_chosen_by="loo" if self.ridge == "auto" else "given",
            ridge_second=(choice.second,) * len(solved) if choice else (),
            leave_one_out=tuple(one.leave_one_out for one in solved),
            ridge_path=tuple(tuple(zip(choice.path[:, 0].tolist(), own.tolist(), strict=True)) for own in choice.own)
            if choice
            else ((),) * len(solved),
        ).noting(
            *found_in(train),
            *remarks,
            *(choice.remarks if choice else ()),
            *(("rank_deficient",) if few else ()),
            *(("no_signal",) if dark else ()),
        )
        return HarmonicTransfer(jnp.asarray(transfer, jnp.float32), self.order, report)


def window(name: str, order: int) -> Float64[np.ndarray, " harmonics"]:
    """Factor of each harmonic: 1 for the mean, falling towards 0 one band past the last. "none" is 1 throughout.

    Reference: Sloan 2008, section "Ringing artifacts and windowing", windows of width order + 1.
    """
    band = np.arange(order + 1)
    share = band / (order + 1)
    shapes = {"none": np.ones(order + 1), "hanning": (1 + np.cos(np.pi * share)) / 2, "lanczos": np.sinc(share)}
    return np.repeat(shapes[name], 2 * band + 1)


def _spectrum(X: Float64[np.ndarray, "lightings harmonics"], light: Float64[np.ndarray, "lightings texels"]) -> Spectrum:
    """The problem with rows of light told by a few numbers of the same products: all that leaving one out asks of them."""
    values, vectors = np.linalg.eigh(light @ light.T)
    with jax.enable_x64(True):
        return decompose(jnp.asarray(X), jnp.asarray(vectors * np.sqrt(np.maximum(values, 0))))


def _solution(X: Float64[np.ndarray, "lightings harmonics"], ridge: float) -> Float64[np.ndarray, "harmonics lightings"]:
    """(X^T X + ridge)^-1 X^T, without directions that are rounding."""
    Q, S, Pt = np.linalg.svd(X, full_matrices=False)
    held = RANK_CUT * S.max(initial=0) < S
    return (Pt[held].T * (S[held] / (S[held] ** 2 + ridge))) @ Q[:, held].T


def _positive(size: np.ndarray) -> np.ndarray:
    return np.where(size > 0, size, 1)
