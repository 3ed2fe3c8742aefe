"""The baseline: an SVD basis and a ridge-regularised linear transfer (Belcour et al., HPG 2022).

Linear, closed-form and small: the reference point that learned methods must beat.

A smooth ridge weighs M K^-1 M^T instead of M M^T, where K says how alike two points are expected to act. With a root R of
K = R R^T that is the plain ridge on M' = M K^-1 R for measurements X R, so that the path of ridges and leaving one lighting
out hold as they stand; M = M' R^T has the size of the plain one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field
from scipy.spatial.distance import cdist

from ddprt.errors import UserError
from ddprt.fitting.basis import Basis, entry_weights, fit_basis
from ddprt.fitting.selection import Spectrum, choose_ridge, decompose
from ddprt.fitting.transfer import point_stretch, solve_transfer
from ddprt.methods.method import (
    Examples,
    FitReport,
    Frame,
    Method,
    array_bytes,
    as_pytree,
    columns,
    found_in,
    grouped,
    measured,
)

Ridge = Literal["auto"] | float | tuple[float, ...]
"""In units of scaled measured²; one per measurement, or "auto"."""

_ADDED_UP = 16  # bases up to which a sum is faster than a product of matrices


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
        values = grouped(frame.values, len(self.matrix))
        return jnp.einsum("gbp,fgp->fgb", self.matrix, values - self.offset, precision="highest") + self.intercept

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        light = compose(self.coefficients(frame), self.basis, self.mean)
        return light if len(self.matrix) == 3 else light.reshape(len(light), -1, 3)

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


def compose(
    coefficients: Float[Array, "frames groups bases"], basis: Float[Array, "bases entries"], mean: Float[Array, " entries"]
) -> Float[Array, "frames entries groups"]:
    """y = mean + U u, each entry's groups side by side.

    Few bases are added up in one loop that reads each once and writes y in place, at the pace of the memory; a product of
    matrices writes y by rows first and turns it around in a second pass, which only pays where there is much to multiply.
    """
    if len(basis) > _ADDED_UP:
        return jnp.moveaxis(jnp.matmul(coefficients, basis, precision="highest") + mean, 1, 2)

    def frame(u: Array) -> Array:
        return sum((vector[:, None] * u[:, k] for k, vector in enumerate(basis)), mean[:, None])

    return jnp.broadcast_to(jax.vmap(frame)(coefficients), (len(coefficients), basis.shape[1], coefficients.shape[1]))


class SvdRidge(Method):
    """SVD basis, ridge transfer; all channels share one ridge."""

    relighter: ClassVar[type] = LinearTransfer
    why: ClassVar[str] = "the paper's baseline: closed form, linear, the reference point"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "smooth": (0.0, 1.0, 3.0),
        "centre": ("none", "mean"),
        "fit.space": ("linear", "linear", "gamma"),
        "fit.channels": ("mono", "mono", "multi"),
    }
    streams: ClassVar[bool] = True
    bases: int = Field(16, ge=1)
    centre: Literal["none", "mean"] = "none"
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] | tuple[Annotated[float, Field(ge=0)], ...] = "auto"
    smooth: float = Field(0.0, ge=0, description="reach over which points act alike, in distances between points; 0: off")

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> LinearTransfer:
        """See `Method`; neither `validation` nor `key` is used.

        Raises:
          UserError: a ridge per measurement that is not one per measurement and above 0, or that is to be smooth; one basis
            where the mean is that one.
        """
        if self.smooth and isinstance(self.ridge, tuple):
            raise UserError(
                f"fit.ridge: got a ridge per measurement with smooth = {self.smooth:g}; give one number or auto, or smooth = 0"
            )
        if self.bases == 1 and self.centre == "mean":
            raise UserError("fit.bases: got 1 with centre = mean, which counts as one; raise it, or take the method mean")
        rows, _ = columns(train)
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        centre = self.centre == "mean"
        basis = fit_basis(rows, entries, bases=self.bases - centre, centre=centre)
        return transfer_to(basis, train, self.ridge, centre=centre, smooth=self.smooth)


def transfer_to(
    basis: Basis, train: Examples, ridge: Ridge = "auto", *, centre: bool = False, smooth: float = 0.0
) -> LinearTransfer:
    """The ridge transfer from measurements to coefficients of a basis.

    Args:
      basis: of the training columns, orthonormal under the entries' weights.
      train: pairs to learn from.
      ridge: "auto" chooses by leaving one lighting out.
      centre: whether the basis has a mean, so that measurements have one too.
      smooth: see `SvdRidge`.
    """
    per_group = targets(basis, train)
    seen = measured(train) if basis.rank else []
    inputs = train.frame.values.shape[1] * (1 if train.channels == "mono" else 3)
    stretch = point_stretch(ridge, inputs)
    parts = [(part.values, jnp.asarray(per_group[part.group][part.rows])) for part in seen]
    if smooth:
        root = likeness_root(train.frame, smooth)
        root = root if train.channels == "mono" else np.kron(root, np.eye(3))
        spectra = [_smoothed(X, C, root, intercept=centre) for X, C in parts]
    else:
        spectra = [decompose(X, C, stretch=stretch, intercept=centre) for X, C in parts]
    weight = [part.importance for part in seen]
    choice = choose_ridge(spectra, weight, [part.rows for part in seen]) if ridge == "auto" and seen else None
    chosen = choice.ridge if choice else ridge
    solved = [solve_transfer(spectrum, chosen, stretch, w) for spectrum, w in zip(spectra, weight, strict=True)]  # type: ignore[arg-type]
    fitted = {part.group: transfer for part, transfer in zip(seen, solved, strict=True)}
    shape = (basis.vectors.shape[0], inputs)
    stack = lambda pick, size: jnp.stack(  # noqa: E731
        [pick(fitted[g]) if g in fitted else jnp.zeros(size) for g in range(len(per_group))]
    )
    report = FitReport(
        bases=int(shape[0]) + centre,
        numerical_rank=basis.rank,
        condition=tuple(t.condition for t in solved),
        ranks=tuple(t.rank for t in solved),
        ridge=tuple(t.ridge for t in solved),
        ridge_chosen_by="loo" if ridge == "auto" else "given",
        ridge_second=(choice.second,) * len(solved) if choice else (),
        leave_one_out=tuple(t.leave_one_out for t in solved),
        singular_values=tuple(np.asarray(basis.singular_values).tolist()),
        ridge_path=tuple(tuple(zip(choice.path[:, 0].tolist(), own.tolist(), strict=True)) for own in choice.own)
        if choice
        else ((),) * len(solved),
    ).noting(*found_in(train), basis.status, *(r for t in solved for r in t.remarks), *(choice.remarks if choice else ()))
    return LinearTransfer(
        stack(lambda t: t.matrix, shape),
        stack(lambda t: t.offset, shape[1]),
        stack(lambda t: t.intercept, shape[0]),
        basis.vectors,
        basis.mean,
        report,
    )


def likeness_root(frame: Frame, smooth: float) -> Float[np.ndarray, "points points"]:
    """A root R of K = R R^T with K_pq = exp(-|p - q| / L) max(0, n_p . n_q), less what of K is negative.

    Args:
      frame: positions and normals of the points.
      smooth: L in units of the median distance from a point to the nearest one that lies elsewhere.
    """
    position, normal = np.asarray(frame.positions, np.float64), np.asarray(frame.normals, np.float64)
    distance = cdist(position, position)
    nearest = np.min(distance, 1, where=distance > 0, initial=np.inf)
    apart = nearest[np.isfinite(nearest)]
    reach = smooth * np.median(apart) if len(apart) else 1.0
    values, vectors = np.linalg.eigh(np.exp(-distance / reach) * np.maximum(normal @ normal.T, 0))
    return vectors * np.sqrt(np.maximum(values, 0))


def _smoothed(X: Array, C: Array, root: np.ndarray, *, intercept: bool) -> Spectrum:
    """The problem of X R, whose solution comes out as M = M' R^T about the mean of X."""
    plain = np.asarray(X, np.float64)
    with jax.enable_x64(True):
        spectrum = decompose(jnp.asarray(plain @ root), C, intercept=intercept)
        offset = plain.mean(0) if intercept else np.zeros(plain.shape[1])
        return replace(spectrum, right=jnp.asarray(np.asarray(spectrum.right) @ root.T), offset=jnp.asarray(offset))


def targets(basis: Basis, train: Examples) -> list[np.ndarray]:
    """Coefficients of the lit columns in their places, (lightings, bases) for each group, zero for dark ones."""
    coefficients, bases = basis.coefficients, len(basis.vectors)
    groups = 3 if train.channels == "mono" else 1
    lit = np.asarray(train.scale[:, :groups]).reshape(-1) > 0
    placed = np.zeros((len(lit), bases))
    placed[lit] = np.asarray(coefficients)
    return list(placed.reshape(len(train.scale), groups, bases).swapaxes(0, 1))
