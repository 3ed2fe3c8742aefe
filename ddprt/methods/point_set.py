"""An encoder over the unordered set of measurement points: what does losing some of them cost?

Points are told by value, position and normal. Features f(p) of a point do not depend on light; the sums over points of f z and
of f f^T are all that is known of a set, and neither an order nor a number of points is in them. What follows is not linear in
these sums (Zaheer et al., "Deep Sets", NeurIPS 2017):

    c = (sum f f^T + noise)^-1 sum f z,    u = M F c + gate * network(size of F's columns * c).

F holds the features of the trained points, as training tells which values occur together, z ~ F c with c of unit variance. So c
is the conditional mean of a Gaussian whose covariance is that of the training light, and F c what all trained points would have
measured ("gappy POD": Everson and Sirovich, JOSA A 1995). A ridge transfer M takes it from there; where every trained point is
there it takes their own values, and is svd-ridge. A point that is none of the trained ones gets its features from these by
attention, with weights d^-4 of a distance d that counts place and facing (Shepard, "A two-dimensional interpolation function
for irregularly-spaced data", 1968).

The network learns, with points dropped at random, what transfers miss that have not seen the lighting in question. How much of
it is taken is decided on validation lightings, once for all points and once for fewer; it is none where it makes them worse.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from pydantic import Field

from ddprt.fitting.basis import Basis, entry_weights, fit_basis
from ddprt.fitting.selection import RANK_CUT
from ddprt.methods.learned import Layers, Learned, Network, Seen, forward, told
from ddprt.methods.method import Examples, FitReport, Frame, array_bytes, as_pytree, columns, grouped, measured
from ddprt.methods.svd_ridge import compose, targets, transfer_to

_FOLDS = 8  # transfers that have each not seen one part of the lightings
_MASKS = 32  # sets of points that training goes through, beside all points
_CHECKED = 8  # of them, those that validation lightings are looked at with
_SAME = 1e-12  # squared distance that counts as none: next to it a point at distance 1 weighs nothing in float32
_NOISES = tuple(10.0**power for power in range(-6, 0))  # tried, in units of the mean square norm of measurements


def squared_distances(
    places: Float[Array, "asking 3"],
    normals: Float[Array, "asking 3"],
    other_places: Float[Array, "there 3"],
    other_normals: Float[Array, "there 3"],
    trained: Float[Array, "trained 3"],
) -> Float[Array, "asking there"]:
    """Of place, in half diagonals of the trained points' box, and of facing."""
    diagonal = jnp.sum((jnp.max(trained, 0) - jnp.min(trained, 0)) ** 2)
    apart = jnp.sum((places[:, None] - other_places) ** 2, -1) / jnp.where(diagonal > 0, diagonal / 4, 1)
    return apart + jnp.sum((normals[:, None] - other_normals) ** 2, -1)


def attention(squares: Float[Array, "asking there"]) -> Float[Array, "asking there"]:
    """How much each that asks takes of each that is there; rows add up to 1, and who is there takes from himself."""
    return jax.nn.softmax(-2 * jnp.log(jnp.maximum(squares, _SAME)), -1)


def reader(at: Float[Array, "points colours latent"], noise: Float[Array, ""] | float) -> Float[Array, "latent points colours"]:
    """From values at points to c.

    Args:
      at: features of the points; zero for those that are not there.
      noise: variance of a value.
    """
    f = at.reshape(-1, at.shape[2])
    # By QR of the stacked problem: the sums of squares would have the square of its condition, too much for float32.
    Q, R = jnp.linalg.qr(jnp.concatenate([f, jnp.sqrt(noise) * jnp.eye(f.shape[1])]))
    return jax.scipy.linalg.solve_triangular(R, Q[: len(f)].T).reshape(-1, *at.shape[:2])


def strength(features: Float[Array, "points colours latent"]) -> Float[Array, " latent"]:
    """Size of F's columns: how much light each entry of c stands for, without which a network would heed what is rare."""
    return jnp.sqrt(jnp.sum(features**2, (0, 1)))


def corrected(layers: Layers, read: Float[Array, "frames groups latent"]) -> Float[Array, "frames groups bases"]:
    """What the network adds; twice the values add twice as much."""
    square = jnp.sum(read**2, -1, keepdims=True)
    size = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    return forward(layers, read / jnp.where(size > 0, size, 1)).astype(jnp.float32) * size


@as_pytree
@dataclass(frozen=True)
class SetEncoder:
    """u = M F c + gate * spread * network(c), y = U u; M z in place of M F c where every trained point is there."""

    matrix: Float[Array, "groups bases inputs"]
    basis: Float[Array, "bases entries"]
    positions: Float[Array, "trained 3"]
    normals: Float[Array, "trained 3"]
    features: Float[Array, "trained colours latent"]
    noise: Float[Array, ""]
    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    spread: Float[Array, " bases"]
    gates: Float[Array, "2"]
    report: FitReport = field(default=FitReport(), compare=False)

    any_points: ClassVar[bool] = True

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        groups, F = len(self.matrix), self.features
        values = jnp.moveaxis(frame.values, 2, 1)[..., None] if groups == 3 else frame.values[:, None]
        apart = squared_distances(self.positions, self.normals, frame.positions, frame.normals, self.positions)
        whole = jnp.all(jnp.min(apart, 1) <= _SAME)
        read = reader(jnp.einsum("pt,tcr->pcr", attention(apart.T), F, precision="highest"), self.noise)
        transfer = self.matrix.reshape(*self.matrix.shape[:2], *F.shape[:2])
        own = jnp.einsum("gbtc,tp->gbpc", transfer, attention(apart), precision="highest")
        filled = jnp.einsum("gbtc,tcr,rpd->gbpd", transfer, F, read, precision="highest")
        u = jnp.einsum("gbpc,fgpc->fgb", jnp.where(whole, own, filled), values, precision="highest")
        gate = jnp.where(whole, self.gates[0], self.gates[1])
        c = jnp.einsum("rpc,fgpc->fgr", read, values, precision="highest")
        # Where the gate is shut, even a network that has gone wrong adds nothing.
        added = corrected(tuple(zip(self.weights, self.biases, strict=True)), c * strength(F)) * self.spread
        light = compose(u + jnp.where(gate > 0, gate * added, 0), self.basis, jnp.zeros(self.basis.shape[1]))
        return light if groups == 3 else light.reshape(len(light), -1, 3)

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`; of all points. What depends on points alone, not on light, is done once for all frames."""
        groups, bases, inputs = self.matrix.shape
        network = inputs * self.features.shape[2] + sum(int(weight.size) for weight in self.weights)
        return 2 * groups * (bases * (inputs + self.basis.shape[1]) + network)


class Sets(NamedTuple):
    """Sets of points, all of them first: what is read from each, and what the transfer misses.

    Attributes:
      read: c times the size of F's columns, over the norm of that.
      left: true coefficients less those of the transfer, over that norm and `size`.
      importance: of each, as in `Seen`.
      size: what coefficients were divided by.
    """

    read: Float[Array, "masks lightings groups latent"]
    left: Float[Array, "masks lightings groups bases"]
    importance: Float[Array, "masks lightings groups"]
    size: Float[Array, " bases"]

    def of(self, mask: Array | int) -> Seen:
        """One set of points."""
        return Seen(self.read[mask], self.left[mask], self.importance[mask], self.size)

    def over(self, size: Float[Array, " bases"]) -> "Sets":
        """With what is missed of about 1."""
        return self._replace(left=self.left / size, size=size)

    @property
    def spread(self) -> Float[Array, " bases"]:
        """See `Seen`: of all sets together."""
        return self.of(0)._replace(targets=self.left.reshape(-1, *self.left.shape[2:])).spread


@dataclass(frozen=True)
class SomePoints:
    """See `Problem`: a network that sees what was read from some of the points.

    Attributes:
      network: what is trained.
    """

    network: Network

    def initial(self, data: Sets, key: Array) -> Layers:
        """See `Network`."""
        return self.network.initial(data.of(0), key)

    def loss(self, parameters: Layers, data: Sets, key: Array) -> Float[Array, ""]:
        """Of all lightings at once: every other time by all points, else by some of them."""
        coin, which = jax.random.split(key)
        some = jax.random.randint(which, (), 1, len(data.read))
        return self.network.check(parameters, data.of(jnp.where(jax.random.bernoulli(coin), some, 0)))

    def check(self, parameters: Layers, held: Sets) -> Float[Array, ""]:
        """Half of it by all points, half by fewer."""
        each = jax.lax.map(lambda mask: self.network.check(parameters, held.of(mask)), jnp.arange(len(held.read)))
        return (each[0] + jnp.mean(each[1:])) / 2


class PointSet(Learned):
    """Sums over points of their features, a ridge transfer and a network from there."""

    relighter: ClassVar[type] = SetEncoder
    why: ClassVar[str] = "learned: any number of points in any order; what does losing some of them cost?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "latent": (24, 48, 64),
        "width": (16, 32, 64),
        "depth": (1, 2),
        "learning_rate": (1e-4, 3e-4, 1e-3),
        "keep": (0.25, 0.5),
    }
    streams: ClassVar[bool] = True
    bases: int = Field(16, ge=1)
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"
    latent: int = Field(64, ge=1, description="numbers that stand for all measurements")
    width: int = Field(64, ge=1, le=4096)
    depth: int = Field(2, ge=1, le=16)
    keep: float = Field(0.25, gt=0, le=1, description="least share of the points that training goes down to")
    steps: int = Field(600, ge=1)
    learning_rate: float = Field(3e-4, gt=0)
    weight_decay: float = Field(1e-2, ge=0)

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> SetEncoder:
        """See `Method`."""
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        basis = fit_basis(columns(train)[0], entries, bases=self.bases)
        whole = transfer_to(basis, train, self.ridge)
        groups, bases, inputs = whole.matrix.shape
        at, points = (train.frame.positions, train.frame.normals), len(train.frame.positions)
        if bases == 0:
            layers = (jnp.zeros((groups + 1, 0)),), (jnp.zeros(0),)
            blind = jnp.zeros((points, inputs // points, 1)), jnp.ones(())
            return SetEncoder(whole.matrix, whole.basis, *at, *blind, *layers, jnp.zeros(0), jnp.zeros(2), whole.report)
        draw, step = jax.random.split(key)
        masks = _drawn(draw, points, self.keep)
        few = masks[:: _MASKS // _CHECKED]
        seen, held = (Seen.of(part, groups, basis.vectors, entries) for part in (train, validation))
        fold = np.arange(len(train.scale)) % _FOLDS
        parts = [np.flatnonzero(fold != number) if len(fold) > 1 else np.arange(1) for number in range(_FOLDS)]
        apart = jnp.stack([_features(seen.inputs, part, points, self.latent) for part in parts])
        own = _features(seen.inputs, np.arange(len(fold)), points, self.latent)
        unseen = _unseen(basis, train, whole.report.ridge, parts)
        tried = [_sets(apart, unseen, noise, seen, masks) for noise in _NOISES]
        best = int(np.argmin([_missing(sets) for sets in tried]))
        sets, known = tried[best], _sets(own[None], whole.matrix[None], _NOISES[best], held, few)
        size = sets.spread
        sets, known = sets.over(size), known.over(size)
        network = Network(self.width, self.depth, silent=True)
        trained = self.trained("point-set", SomePoints(network), sets, known, step)
        report = told(whole.report, trained)
        weights, biases = zip(*trained.parameters, strict=True)
        noise, gates = jnp.float32(_NOISES[best]), _worth(trained.parameters, known)
        return SetEncoder(whole.matrix, whole.basis, *at, own, noise, weights, biases, size, gates, report)


def _drawn(key: Array, points: int, keep: float) -> Bool[Array, "masks points"]:
    """All points; then sets of them whose shares fall from all to `keep`, none of them empty."""
    lot = jax.random.uniform(key, (_MASKS, points))
    share = jnp.linspace(1.0, keep, _MASKS + 1)[1:, None]
    some = lot <= jnp.maximum(share, jnp.min(lot, 1, keepdims=True))
    return jnp.concatenate([jnp.ones((1, points), bool), some])


def _features(inputs: Array, part: np.ndarray, points: int, latent: int) -> Float[Array, "points colours latent"]:
    """F, so that F F^T is nearest to the mean of z z^T."""
    rows = np.asarray(inputs, np.float64)[part].reshape(-1, inputs.shape[2])
    _, S, Pt = np.linalg.svd(rows, full_matrices=False)
    F = np.zeros((rows.shape[1], min(latent, *inputs.shape[2:])))
    count = min(F.shape[1], len(S))
    F[:, :count] = Pt[:count].T * S[:count] / np.sqrt(len(rows))
    return jnp.asarray(F.reshape(points, -1, F.shape[1]), jnp.float32)


@jax.jit
def _sets(
    features: Float[Array, "folds points colours latent"],
    matrices: Float[Array, "folds groups bases inputs"],
    noise: Array | float,
    seen: Seen,
    masks: Bool[Array, "masks points"],
) -> Sets:
    """What is read from each set of points, and what is missed; each lighting by the fold that has not seen it."""
    fold = (jnp.arange(len(seen.inputs)) % len(features))[None, :, None, None]

    def by(mask: Array) -> tuple[Array, Array, Array]:
        def one(F: Array, matrix: Array) -> tuple[Array, Array]:
            read = reader(F * mask[:, None, None], noise).reshape(F.shape[2], -1)
            c = jnp.einsum("ri,ngi->ngr", read, seen.inputs, precision="highest")
            there = jnp.einsum("ir,ngr->ngi", F.reshape(-1, F.shape[2]), c, precision="highest")
            z = jnp.where(jnp.all(mask), seen.inputs, there)
            return c * strength(F), jnp.einsum("gbi,ngi->ngb", matrix, z, precision="highest")

        c, found = (jnp.take_along_axis(each, fold, 0)[0] for each in jax.vmap(one)(features, matrices))
        size = jnp.sqrt(jnp.sum(c**2, -1, keepdims=True))
        over = jnp.where(size > 0, size, 1)
        return c / over, jnp.where(size > 0, (seen.targets - found) / over, 0), seen.importance * size[..., 0] ** 2

    read, left, importance = jax.lax.map(by, masks)
    return Sets(read, left, importance, jnp.ones(seen.targets.shape[2]))


def _missing(sets: Sets) -> float:
    """Error of light by fewer points than all, the geometric mean over sets, up to a factor; endless where not finite."""
    squares = jnp.mean(sets.importance[1:, ..., None] * sets.left[1:] ** 2, (1, 2, 3))
    return float(jnp.nan_to_num(jnp.mean(jnp.log(jnp.maximum(squares, jnp.finfo(jnp.float32).tiny))), nan=jnp.inf))


def _unseen(
    basis: Basis, train: Examples, ridges: tuple[float, ...], parts: list[np.ndarray]
) -> Float[Array, "folds groups bases inputs"]:
    """Transfers at the ridges given, each from some lightings alone."""
    wanted = targets(basis, train)
    found = np.zeros((len(parts), len(wanted), wanted[0].shape[1], grouped(train.frame.values, len(wanted)).shape[2]))
    for seen, ridge in zip(measured(train), ridges, strict=True):
        X, C = np.asarray(seen.values, np.float64), wanted[seen.group][seen.rows]
        for fold, part in enumerate(parts):
            rest = np.isin(seen.rows, part)
            Q, S, Pt = np.linalg.svd(X[rest], full_matrices=False)
            held = RANK_CUT * S.max(initial=0) < S
            found[fold, seen.group] = ((Pt[held].T * (S[held] / (S[held] ** 2 + ridge))) @ (Q[:, held].T @ C[rest])).T
    return jnp.asarray(found, jnp.float32)


@jax.jit
def _worth(layers: Layers, held: Sets) -> Float[Array, "2"]:
    """The shares of the correction that lower the error the most, of all points and of fewer: 0 to 1, 0 where not finite."""
    relative = (held.size / jnp.max(held.size)) ** 2

    def products(mask: Array) -> Float[Array, "2"]:
        seen = held.of(mask)
        share, found = seen.importance[..., None] * relative, forward(layers, seen.inputs)
        return jnp.stack([jnp.sum(share * found * seen.targets), jnp.sum(share * found**2)])

    each = jax.lax.map(products, jnp.arange(len(held.read)))
    both = jnp.stack([each[0], jnp.sum(each[1:], 0)])
    best = both[:, 0] / jnp.maximum(both[:, 1], jnp.finfo(jnp.float32).tiny)
    return jnp.where(jnp.isfinite(best), jnp.clip(best, 0, 1), 0.0)
