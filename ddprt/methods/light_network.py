"""A network that is told the lights, and measures nothing: how much of what points see is where the lamps stand?

Each light is a lobe: a strength, and numbers that say where it stands, where it shines to and how wide. One hidden layer of
cosines turns these numbers into coefficients of the SVD basis per unit of strength, f_c(t) = A_c sqrt(2 / n) cos(B t + b); a
lighting's coefficients are the sum of strength times f_c over its lights. So the answer is linear in the light, whatever the
number of lights, and non-linear in where they are. Measurements only set the scale that all methods work in.

Frequencies start as draws from a normal distribution of one over `length`, which makes the layer a Gaussian process in all but
name (Rahimi and Recht, "Random Features for Large-Scale Kernel Machines", NIPS 2007; Tancik et al., "Fourier Features Let
Networks Learn High Frequency Functions in Low Dimensional Domains", NeurIPS 2020). A is the ridge solution of these, length and
ridge by leaving one lighting out; then A, B and b are trained from there, and kept where validation lightings gain by it.

Areas are told by their centre, their mean direction and their reach; a sky is the sum of directional lights that its harmonics
up to `SKY` make, so a method that was trained under suns answers for it.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from pydantic import Field

from ddprt import harmonics
from ddprt.errors import UserError
from ddprt.fitting.basis import Basis, entry_weights, fit_basis
from ddprt.fitting.selection import Choice, choose_ridge, decompose
from ddprt.fitting.transfer import Transfer, solve_transfer
from ddprt.methods.learned import Learned, Seen, told
from ddprt.methods.method import Examples, FitReport, Frame, array_bytes, as_pytree, columns, found_in, static
from ddprt.methods.svd_ridge import compose
from ddprt.progress import Doubt

SKY = 6
"""Order of the harmonics that a sky is told by."""
LENGTHS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Tried by "auto": over which the answer changes, in radii of the measured points; directions and cosines count as they are."""

Lobe = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, " told"]]
_TOLD = 11
_ROUND = (-1.0, -1.0)  # cosines of inner and outer half-angle of what shines all around
_NOWHERE = np.zeros(3)


@dataclass(frozen=True)
class Surroundings:
    """What lights are told relative to.

    Attributes:
      centre: of the measured points' box, metres.
      radius: half its diagonal, metres; 1 where the points are one.
    """

    centre: Float64[np.ndarray, "3"]
    radius: float

    @classmethod
    def of(cls, positions: Float[np.ndarray, "points 3"]) -> "Surroundings":
        """Those of some points."""
        low, high = np.asarray(positions, np.float64).min(0), np.asarray(positions, np.float64).max(0)
        return cls((low + high) / 2, float(np.linalg.norm(high - low)) / 2 or 1.0)

    def lobes(self, light: Any) -> list[Lobe]:
        """A light as strengths, and what is told of each.

        A strength is what parallel light brings, or a lamp at the centre of the points if it shone there; of lamps nearer than
        a radius, where that has no bounds, what they bring at one. So less is left to learn of how light falls off.

        Raises:
          UserError: a kind that is not known here.
        """
        if light.kind == "directional":
            return [self._distant(light.irradiance, np.array(light.direction))]
        if light.kind == "environment":
            return self._sky(light)
        if light.kind not in _LAMPS:
            known = ", ".join(sorted({"directional", "environment", *_LAMPS}))
            raise UserError(f"light-network: got a light of type {light.kind}, expected one of {known}; use another method")
        strength, direction, cone, facing = _LAMPS[light.kind](light)
        place = (light.anchor() - self.centre) / self.radius
        told = np.concatenate([place, direction, cone, [facing, 1.0, light.reach() / self.radius]])
        return [(np.asarray(strength, np.float64) / (self.radius**2 * max(1.0, float(place @ place))), told)]

    def _distant(self, irradiance: Any, direction: np.ndarray) -> Lobe:
        return np.asarray(irradiance, np.float64), np.concatenate([_NOWHERE, direction, _ROUND, np.zeros(3)])

    def _sky(self, light: Any) -> list[Lobe]:
        """Directional lights at the nodes of a quadrature that is exact for products of two harmonics up to `SKY`."""
        z, weight = np.polynomial.legendre.leggauss(SKY + 1)
        turn = 2 * np.pi * np.arange(2 * SKY + 1) / (2 * SKY + 1)
        flat = np.sqrt(1 - z**2)[:, None]
        towards = np.stack(np.broadcast_arrays(flat * np.cos(turn), flat * np.sin(turn), z[:, None]), -1).reshape(-1, 3)
        share = np.repeat(weight, len(turn)) * 2 * np.pi / len(turn)
        light_from = harmonics.harmonics(towards, SKY) @ light.harmonics(SKY) * share[:, None]
        return [self._distant(irradiance, -direction) for irradiance, direction in zip(light_from, towards, strict=True)]


def _flat(light: Any) -> tuple[Any, np.ndarray, tuple[float, float], float]:
    across = 4 * np.cross(light.half_u, light.half_v)
    area = float(np.linalg.norm(across))
    return np.multiply(light.radiance, area), across / area, _ROUND, 1.0


def _mesh(light: Any) -> tuple[Any, np.ndarray, tuple[float, float], float]:
    shape = light.shape
    areas = np.diff(shape.cumulative, prepend=0.0)
    return np.multiply(light.radiance, shape.area), areas @ shape.normals, _ROUND, 1.0


def _spot(light: Any) -> tuple[Any, np.ndarray, tuple[float, float], float]:
    cone = float(np.cos(np.deg2rad(light.inner_deg))), float(np.cos(np.deg2rad(light.outer_deg)))
    return light.intensity, np.array(light.direction), cone, 0.0


_LAMPS: dict[str, Any] = {
    "point": lambda light: (light.intensity, _NOWHERE, _ROUND, 0.0),
    "spot": _spot,
    "rect": _flat,
    "sphere": lambda light: (np.multiply(light.radiance, np.pi * light.radius**2), _NOWHERE, _ROUND, 0.0),
    "mesh": _mesh,
}
"""Of what has a place: intensity at its strongest, W/sr; mean direction; cosines of its cone; whether it is a surface."""


class Cosines(NamedTuple):
    """The network: t -> sqrt(2 / n) cos(B t + b) A."""

    frequencies: Float[Array, "told features"]
    phases: Float[Array, " features"]
    outputs: Float[Array, "3 features bases"]


@as_pytree
@dataclass(frozen=True)
class LightNetwork:
    """u_c = sum over lights of strength_c f_c(t), y = U u; for interleaved colours u is the sum over c."""

    frequencies: Float[Array, "told features"]
    phases: Float[Array, " features"]
    outputs: Float[Array, "3 features bases"]
    basis: Float[Array, "bases entries"]
    centre: Float[Array, "3"]
    radius: Float[Array, ""]
    groups: int = static(default=3)
    kinds: str = static(default="")  # of light that it was trained with, with commas; nothing where that is not known
    report: FitReport = field(default=FitReport(), compare=False)

    def describe(self, lightings: Sequence[Any]) -> Float64[np.ndarray, "lightings bases 3"]:
        """See `AsksForLights`: coefficients of the basis, each colour of light apart.

        A kind of light that training never showed is told as a `Doubt`.

        Raises:
          UserError: a kind of light that is not known.
        """
        around = Surroundings(np.asarray(self.centre, np.float64), float(self.radius))
        found = np.zeros((len(lightings), self.outputs.shape[2], 3))
        B, b, A = (np.asarray(part, np.float64) for part in (self.frequencies, self.phases, self.outputs))
        for row, lights in zip(found, lightings, strict=True):
            if lobes := [lobe for light in lights for lobe in around.lobes(light)]:
                strength, told = (np.stack(part) for part in zip(*lobes, strict=True))
                row += np.einsum("lc,lf,cfb->bc", strength, _features(told, B, b), A, optimize=True)
        if self.kinds and (unseen := ", ".join(sorted(_kinds(lightings) - {*self.kinds.split(",")}))):
            words = f"light-network: got light of type {unseen}, but was trained with {self.kinds.replace(',', ', ')} alone"
            warnings.warn(f"{words}; what it answers is a guess", Doubt, stacklevel=2)
        return found

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        assert frame.described is not None
        u = jnp.moveaxis(frame.described, 2, 1)
        u = u if self.groups == 3 else jnp.sum(u, 1, keepdims=True)
        light = compose(u, self.basis, jnp.zeros(self.basis.shape[1]))
        return light if self.groups == 3 else light.reshape(len(light), -1, 3)

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`; for one light."""
        return 2 * int(self.frequencies.size + self.outputs.size) + 2 * 3 * int(self.basis.size)


class Lit(NamedTuple):
    """Lightings as lobes and the coefficients that they bring, both over the size of the strengths: float64, then float32.

    Attributes:
      told: (lightings, lobes, numbers); lightings with fewer lobes than others have some of no strength.
      strength: (lightings, lobes, 3), over `size`.
      targets: (lightings, groups, bases), coefficients over `size`.
      importance: (lightings, groups), mean 1: its share in squared errors of light.
      size: (lightings, groups), norm of the strengths, 0 where nothing is known of the light.
    """

    told: Any
    strength: Any
    targets: Any
    importance: Any
    size: Any

    @classmethod
    def of(cls, examples: Examples, basis: Basis, entries: Array, around: Surroundings) -> "Lit":
        """Lightings that some point sees; the rest have size and targets 0."""
        groups = 3 if examples.channels == "mono" else 1
        given = examples.frame.lightings or ((),) * len(examples.scale)
        lobes = [[lobe for light in lights for lobe in around.lobes(light)] for lights in given]
        count = max(map(len, lobes), default=0) or 1
        told, strength = np.zeros((len(lobes), count, _TOLD)), np.zeros((len(lobes), count, 3))
        for row, each in enumerate(lobes):
            for place, (strong, numbers) in enumerate(each):
                told[row, place], strength[row, place] = numbers, strong
        scale = np.asarray(examples.scale, np.float64)[:, :groups]
        size = np.linalg.norm(strength, axis=1) if groups == 3 else np.linalg.norm(strength, axis=(1, 2))[:, None]
        size = np.where(scale > 0, size, 0)
        targets = np.asarray(Seen.of(examples, groups, basis.vectors, entries).targets, np.float64)
        with np.errstate(over="ignore"):
            targets = targets * (scale / _positive(size))[..., None] * (size > 0)[..., None]
        share = (size / (size.max(initial=0) or 1)) ** 2
        return cls(told, strength * ((size > 0) / _positive(size))[:, None], targets, share / (share.mean() or 1), size)

    def over(self, spread: Float64[np.ndarray, " bases"]) -> "Lit":
        """With targets of about 1, for training."""
        parts = self._replace(targets=self.targets / spread)
        return Lit(*(jnp.asarray(part, jnp.float32) for part in parts))


@dataclass(frozen=True)
class Refining:
    """See `Problem`: a network that starts where the ridge ends, under the ridge's own penalty.

    Attributes:
      ridge: weight of the outputs' squares.
    """

    ridge: float

    def initial(self, data: tuple[Lit, Cosines], key: Array) -> Cosines:
        """The network as it came."""
        return data[1]

    def loss(self, parameters: Cosines, data: tuple[Lit, Cosines], key: Array) -> Float[Array, ""]:
        """Of all lightings at once, whatever their strength."""
        lit = data[0]
        off = _coefficients(parameters, lit) - lit.targets
        penalty = self.ridge * jnp.sum(parameters.outputs.astype(jnp.float32) ** 2)
        return (jnp.sum(off.astype(jnp.float32) ** 2) + penalty) / lit.targets.size

    def check(self, parameters: Cosines, held: tuple[Lit, Array]) -> Float[Array, ""]:
        """Mean squared error of light."""
        lit, spread = held
        share = (spread / jnp.max(spread)) ** 2
        off = (_coefficients(parameters, lit) - lit.targets).astype(jnp.float32)
        return jnp.mean(lit.importance[..., None] * share * off**2)


def _coefficients(network: Cosines, lit: Lit) -> Float[Array, "lightings groups bases"]:
    B, b, A = network
    features = jnp.sqrt(2 / B.shape[1]).astype(B.dtype) * jnp.cos(lit.told.astype(B.dtype) @ B + b)
    each = jnp.einsum("nlc,nlf->ncf", lit.strength.astype(B.dtype), features)
    found = jnp.einsum("ncf,cfb->ncb", each, A, precision="highest")
    return found if lit.targets.shape[1] == 3 else jnp.sum(found, 1, keepdims=True)


class LightNetworks(Learned):
    """Cosines of where lights are, to coefficients of the SVD basis."""

    relighter: ClassVar[type] = LightNetwork
    why: ClassVar[str] = "learned: sees where the lamps are and nothing else, so what do measurements add?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "features": (64, 128, 256, 512),
        "steps": (100, 300),
        "weight_decay": (0.0, 1e-4),
    }
    streams: ClassVar[bool] = True
    space: Literal["linear"] = "linear"
    bases: int = Field(16, ge=1)
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"
    features: int = Field(256, ge=1, le=4096)
    length: Literal["auto"] | Annotated[float, Field(gt=0)] = "auto"
    steps: int = Field(300, ge=1)
    weight_decay: float = Field(0.0, ge=0)

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> LightNetwork:
        """See `Method`: the ridge, then all of the network from there; what is worse on `validation` is not taken.

        Raises:
          UserError: a kind of light that is not known.
        """
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        basis = fit_basis(columns(train)[0], entries, bases=self.bases)
        around = Surroundings.of(np.asarray(train.frame.positions))
        lit, held = (Lit.of(part, basis, entries, around) for part in (train, validation))
        draw, step = jax.random.split(key)
        start, report = self._start(lit, draw)
        report = replace(report, numerical_rank=basis.rank, singular_values=tuple(np.asarray(basis.singular_values).tolist()))
        report = report.noting(*found_in(train), basis.status)
        groups, place = lit.targets.shape[1], (jnp.asarray(around.centre, jnp.float32), jnp.float32(around.radius))
        kinds = ",".join(sorted(_kinds(train.frame.lightings or ())))
        if not lit.targets.any():
            return LightNetwork(*_single(start), basis.vectors, *place, groups, kinds, report.noting("no_signal"))
        spread = np.maximum(np.sqrt(np.mean(lit.targets**2, (0, 1))), 1e-12 * np.abs(lit.targets).max())
        begun = _single(start._replace(outputs=start.outputs / spread))
        problem = Refining(report.ridge[0])
        known = held.over(spread), jnp.asarray(spread / spread.max(), jnp.float32)
        trained = self.trained("light-network", problem, (lit.over(spread), begun), known, step)
        gains = problem.check(trained.parameters, known) < problem.check(begun, known)
        best = trained.parameters if bool(gains) else begun
        outputs = jnp.asarray(np.asarray(best.outputs, np.float64) * spread, jnp.float32)
        report = told(report, trained)
        return LightNetwork(best.frequencies, best.phases, outputs, basis.vectors, *place, groups, kinds, report)

    def _start(self, lit: Lit, key: Array) -> tuple[Cosines, FitReport]:
        """Random frequencies and the ridge's outputs, of the length that predicts left-out lightings best."""
        wave, turn = jax.random.split(key)
        B = np.asarray(jax.random.normal(wave, (_TOLD, self.features)), np.float64)
        b = np.asarray(jax.random.uniform(turn, (self.features,), maxval=2 * np.pi), np.float64)
        tried = [_solved(lit, B / length, b, self.ridge) for length in (LENGTHS if self.length == "auto" else (self.length,))]
        return min(tried, key=lambda one: one[1].leave_one_out[:1] and sum(e**2 for e in one[1].leave_one_out))


def _solved(lit: Lit, B: np.ndarray, b: np.ndarray, ridge: float | str) -> tuple[Cosines, FitReport]:
    groups = lit.targets.shape[1]
    each = np.einsum("nlc,nlf->ncf", lit.strength, _features(lit.told, B, b), optimize=True)
    rows = [np.flatnonzero(lit.size[:, group] > 0) for group in range(groups)]
    seen = [group for group in range(groups) if len(rows[group])]
    inputs = [each[rows[g]].reshape(len(rows[g]), -1) if groups == 1 else each[rows[g], g] for g in seen]
    spectra = [
        decompose(jnp.asarray(X, jnp.float32), jnp.asarray(lit.targets[rows[g], g], jnp.float32))
        for g, X in zip(seen, inputs, strict=True)
    ]
    weight = [lit.size[rows[g], g] ** 2 for g in seen]
    choice: Choice | None = choose_ridge(spectra, weight, [rows[g] for g in seen]) if ridge == "auto" and seen else None
    used = choice.ridge if choice else ridge if ridge != "auto" else 0.0
    solved: list[Transfer] = [solve_transfer(one, used, None, w) for one, w in zip(spectra, weight, strict=True)]  # type: ignore[arg-type]
    outputs = np.zeros((3, B.shape[1], lit.targets.shape[2]))
    for group, transfer in zip(seen, solved, strict=True):
        matrix = np.asarray(transfer.matrix, np.float64).T
        if groups == 1:
            outputs[:] = matrix.reshape(outputs.shape)
        else:
            outputs[group] = matrix
    remarks = {name for one in solved for name in one.remarks if name != "rank_deficient"}  # lamps fill few features, always
    report = FitReport(
        bases=lit.targets.shape[2],
        ridge=tuple(one.ridge for one in solved) or (0.0,),
        ridge_chosen_by="loo" if ridge == "auto" else "given",
        ridge_second=(choice.second,) * len(solved) if choice else (),
        leave_one_out=tuple(one.leave_one_out for one in solved),
    ).noting(*remarks, *(choice.remarks if choice else ()))
    return Cosines(B, b, outputs), report  # type: ignore[arg-type]


def _kinds(lightings: Iterable[Iterable[Any]]) -> set[str]:
    """What is told apart: a sky is told as directional lights."""
    return {"directional" if light.kind == "environment" else light.kind for lights in lightings for light in lights}


def _features(told: Float64[np.ndarray, "*n told"], B: np.ndarray, b: np.ndarray) -> Float64[np.ndarray, "*n features"]:
    return np.sqrt(2 / B.shape[1]) * np.cos(told @ B + b)


def _single(network: Cosines) -> Cosines:
    return Cosines(*(jnp.asarray(part, jnp.float32) for part in network))


def _positive(size: np.ndarray) -> np.ndarray:
    return np.where(size > 0, size, 1)
