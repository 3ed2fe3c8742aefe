"""The baseline: an SVD basis and a ridge-regularised linear transfer (Belcour et al., HPG 2022).

Linear, closed-form and small: the reference point that learned methods must beat.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.fitting.transfer import Transfer, fit_transfer
from ddprt.methods.method import Examples, FitReport, Frame, Method, array_bytes, as_pytree, columns, measurements


@as_pytree
@dataclass(frozen=True)
class LinearTransfer:
    """u = M (z - offset) + intercept, y = mean + U u; one M per channel (mono) or one for interleaved colours (multi)."""

    matrix: Float[Array, "groups bases inputs"]
    offset: Float[Array, "groups inputs"]
    intercept: Float[Array, "groups bases"]
    basis: Float[Array, "bases entries"]
    mean: Float[Array, " entries"]
    report: FitReport = field(default=FitReport(), compare=False)

    def coefficients(self, frame: Frame) -> Float[Array, "frames groups bases"]:
        """u for each frame."""
        frames, groups = len(frame.values), len(self.matrix)
        values = jnp.moveaxis(frame.values, 2, 1) if groups == 3 else frame.values.reshape(frames, 1, -1)
        return jnp.einsum("gbp,fgp->fgb", self.matrix, values - self.offset, precision="highest") + self.intercept

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        light = jnp.matmul(self.coefficients(frame), self.basis, precision="highest") + self.mean
        if len(self.matrix) == 3:
            return jnp.moveaxis(light, 1, 2)
        return light.reshape(len(light), -1, 3)

    def truncated(self, bases: int) -> "LinearTransfer":
        """The same with all but the first `bases` vectors set to zero; shapes stay, so nothing compiles again."""
        kept = (jnp.arange(self.basis.shape[0]) < bases)[:, None]
        return replace(self, basis=self.basis * kept)

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`: two per multiply-add of transfer and composition."""
        groups, bases, inputs = self.matrix.shape
        return 2 * groups * bases * (inputs + self.basis.shape[1])


class SvdRidge(Method):
    """SVD basis, ridge transfer."""

    relighter: ClassVar[type] = LinearTransfer
    why: ClassVar[str] = "the paper's baseline: closed form, linear, the reference point"
    bases: int = Field(16, ge=1)
    centre: Literal["none", "mean"] = "none"
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] | tuple[Annotated[float, Field(ge=0)], ...] = "auto"

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> LinearTransfer:
        """See `Method`; neither `validation` nor `key` is used."""
        rows, _ = columns(train)
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        centre = self.centre == "mean"
        basis = fit_basis(rows, entries, bases=max(self.bases - centre, 1), centre=centre)
        per_group = _spread(basis.coefficients, train, basis.vectors.shape[0])
        transfers: list[Transfer | None] = []
        for group, inputs in enumerate(np.asarray(measurements(train))):
            scale = np.asarray(train.scale[:, group])
            lit = np.flatnonzero(scale > 0)
            if len(lit) == 0:
                transfers.append(None)
                continue
            transfers.append(
                fit_transfer(
                    jnp.asarray(inputs[lit]),
                    jnp.asarray(per_group[group][lit]),
                    ridge=self.ridge,
                    importance=jnp.asarray((scale[lit] / scale.max()) ** 2),  # relative: squares do not overflow
                    intercept=centre,
                )
            )
        shape = (basis.vectors.shape[0], measurements(train).shape[2])
        stack = lambda pick, size: jnp.stack([jnp.zeros(size) if t is None else pick(t) for t in transfers])  # noqa: E731
        fitted = [t for t in transfers if t is not None]
        worst = next((s for s in ("no_signal", "ill_conditioned", "rank_deficient") if s in {t.status for t in fitted}), "ok")
        report = FitReport(
            status=basis.status if basis.status != "ok" else worst if fitted else "no_signal",
            bases=int(shape[0]) + centre,
            numerical_rank=basis.rank,
            condition=tuple(t.condition for t in fitted),
            ridge=tuple(t.ridge for t in fitted),
            ridge_chosen_by="loo" if self.ridge == "auto" else "given",
            singular_values=tuple(np.asarray(basis.singular_values).tolist()),
            ridge_path=tuple(tuple(map(tuple, np.asarray(t.path).tolist())) for t in fitted),
        )
        return LinearTransfer(
            stack(lambda t: t.matrix, shape),
            stack(lambda t: t.offset, shape[1]),
            stack(lambda t: t.intercept, shape[0]),
            basis.vectors,
            basis.mean,
            report,
        )


def _spread(coefficients: Array, train: Examples, bases: int) -> list[np.ndarray]:
    """Coefficients of the lit columns back in their (group, lighting) places, zero for dark ones."""
    groups = 3 if train.channels == "mono" else 1
    lit = np.asarray(train.scale[:, :groups]).reshape(-1) > 0
    placed = np.zeros((len(lit), bases))
    placed[lit] = np.asarray(coefficients)
    return list(placed.reshape(len(train.scale), groups, bases).swapaxes(0, 1))
