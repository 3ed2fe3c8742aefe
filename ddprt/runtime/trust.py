"""How far a lighting lies from those a model was trained on, and what error that lets expect.

It is told from the measured light alone, so it serves every method. With D the scaled and encoded training measurements
(columns) of a channel and x a new one, lambda x^T (D D^T + lambda Id)^-1 x / ||x||² is the share of its energy that training
does not account for: here its *novelty*, in [0, 1], lambda times the leverage. With the singular values S and left singular
vectors P of D it is, for an x of norm 1, the sum of two parts that cannot be negative,

    sum_j lambda / (S_j² + lambda) (p_j . x)² + ||x - P P^T x||²,

so nothing cancels in float32. Errors follow novelty by a power law through (1, 1), since a light that training knows nothing
of is answered with black or with something unrelated: expected error = novelty ** exponent. The exponent is fitted to the
validation lightings, near 1/2 where error is what novelty takes out of the light. Trust is one minus the expected error.
"""

import math
from dataclasses import dataclass, fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ddprt.fitting.basis import entry_weights
from ddprt.fitting.encoding import Encoding
from ddprt.fitting.selection import RANK_CUT, Spectrum, choose_ridge, decompose
from ddprt.methods.method import Examples, Maps, measured

FALSE_ALARMS = 0.05
"""Share of lightings like the training ones that are called extrapolating."""
_SKETCH = 16  # random combinations of texels: their squared errors have those of the whole map as their mean
_LEAST = float(np.finfo(np.float32).eps) ** 2  # energy that rounding of a measurement makes up


@dataclass(frozen=True)
class Trust:
    """What `Model.trust` says of each frame, in arrays of shape (frames,), or () for a single one.

    Scaling the light changes nothing but rounding.

    Attributes:
      score: 1 less the expected error of the relit map, norm over norm; 1 where no light was measured.
      leverage: x^T (D D^T + lambda Id)^-1 x, the mean over channels weighted by their energy.
      unexplained: ||lambda (D D^T + lambda Id)^-1 x|| / ||x||, the root of the mean square likewise.
      extrapolating: whether the lighting is stranger than all but `FALSE_ALARMS` of the training lightings are to the others.
    """

    score: Float[np.ndarray, "*frames"]
    leverage: Float[np.ndarray, "*frames"]
    unexplained: Float[np.ndarray, "*frames"]
    extrapolating: Bool[np.ndarray, "*frames"]


@dataclass(frozen=True, eq=False)
class Yardstick:
    """What trust is measured with.

    Attributes:
      directions: P^T per transfer matrix: one per channel for mono, one of interleaved colours for multi.
      shares: lambda / (S² + lambda) of each direction.
      mean: mean training measurement of unit scale; what the model answers to it is the map that `fade` goes to.
      ridge: lambda.
      exponent: of the expected error.
      level: novelty above which a lighting counts as extrapolating.
      fade_from: expected error at which fading begins: that of the mean lightmap on the validation lightings.
    """

    directions: Float[np.ndarray, "groups directions inputs"]
    shares: Float[np.ndarray, "groups directions"]
    mean: Float[np.ndarray, "points 3"]
    ridge: float
    exponent: float = 0.5
    level: float = 1.0
    fade_from: float = 1.0

    @property
    def nbytes(self) -> int:
        """Bytes that ship."""
        return sum(value.nbytes for entry in fields(self) if isinstance(value := getattr(self, entry.name), np.ndarray))

    def measure(self, encoding: Encoding, values: Float[Array, "frames points 3"]) -> Trust:
        """Trust of frames of measured light, W/m²."""
        found = _measure(self.directions, self.shares, encoding, _below_the_cap(values))
        novelty, leverage, unexplained = map(np.asarray, found)
        novelty = np.where(np.isfinite(novelty), novelty, 1)  # what cannot be told is not trusted
        error = np.where(novelty > 0, novelty**self.exponent, 0)
        return Trust(1 - error, leverage / self.ridge, unexplained, novelty > self.level)

    def novelty(
        self, encoded: Float[Array, "frames points 3"], scale: Float[Array, "frames 3"]
    ) -> Float[np.ndarray, " frames"]:
        """Share of the energy that training does not account for; 0 where it is dark."""
        return np.asarray(_parts(jnp.asarray(self.directions), jnp.asarray(self.shares), encoded, scale)[0])

    def kept(self, score: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " frames"]:
        """Share of the prediction that fading keeps: 1 down to where fading begins, then smoothly to 0 at score 0."""
        rest = 1 - self.fade_from
        share = np.clip(score / rest, 0, 1) if rest > 0 else (score > 0).astype(score.dtype)
        return share**2 * (3 - 2 * share)


def make_yardstick(train: Examples, encoding: Encoding) -> Yardstick:
    """Directions, ridge and level from the training lightings; the ridge is the one that predicts left-out maps best."""
    seen, sketches = measured(train), _sketched(train)
    spectra = [decompose(part.values, jnp.asarray(sketches[part.group][part.rows])) for part in seen]
    ridge = choose_ridge(spectra, [part.importance for part in seen], [part.rows for part in seen]).ridge if seen else 0.0
    # Directions that are rounding alone count as unexplained.
    ridge = max(ridge, (RANK_CUT * max((spectrum.largest for spectrum in spectra), default=1.0)) ** 2)
    inputs = train.frame.values.shape[1] * (1 if train.channels == "mono" else 3)
    directions = np.zeros((len(sketches), max((len(s.right) for s in spectra), default=0), inputs), np.float32)
    shares = np.ones(directions.shape[:2], np.float32)
    novelty, weight = np.zeros(len(train.scale)), np.zeros(len(train.scale))
    for part, spectrum in zip(seen, spectra, strict=True):
        count = len(spectrum.right)
        directions[part.group, :count] = np.asarray(spectrum.right)
        shares[part.group, :count] = ridge / (np.asarray(spectrum.values)[:count] ** 2 + ridge)
        size = np.sum(np.asarray(part.values, np.float64) ** 2, 1)
        novelty[part.rows] += part.importance * np.minimum(_left_out(spectrum, ridge) / size, 1)
        weight[part.rows] += part.importance
    alone = np.sort(novelty[weight > 0] / weight[weight > 0])
    place = math.ceil((len(alone) + 1) * (1 - FALSE_ALARMS))  # of one more lighting of the same kind among them
    level = float(alone[min(place, len(alone)) - 1]) if len(alone) else 0.0
    return Yardstick(directions, shares, _mean(train, encoding), ridge, level=level)


def calibrated(
    yardstick: Yardstick,
    novelty: Float[np.ndarray, " lightings"],
    error: Float[np.ndarray, " lightings"],
    of_mean: Float[np.ndarray, " lightings"],
) -> Yardstick:
    """The same with an exponent from held-out lightings: least squares of log error on log novelty, through (1, 1).

    Args:
      yardstick: from `make_yardstick`.
      novelty: of the lightings.
      error: of the model there, norm over norm; NaN where the reference is dark.
      of_mean: that of the mean lightmap.
    """
    known = ~np.isnan(error) & (novelty > 0) & (novelty < 1)
    if not known.any():
        return yardstick
    x, y = (np.log(np.clip(part[known], _LEAST, 1 / _LEAST)) for part in (novelty, error))
    exponent = max(float(x @ y / (x @ x)), 0.0)
    return replace(yardstick, exponent=exponent, fade_from=min(float(np.median(of_mean[known])), 1.0))


def outside(yardstick: Yardstick, novelty: Float[np.ndarray, " lightings"]) -> bool:
    """Whether held-out lightings as a whole are of another kind: at least three, and more than half, lie above the level.

    Lightings like the training ones do so by chance in 0.12 % of fits at most: that of 3 of 5 at 5 % each.
    """
    above = int(np.sum(novelty > yardstick.level))
    return above >= 3 and 2 * above > len(novelty)


def _left_out(spectrum: Spectrum, ridge: float) -> np.ndarray:
    """lambda x^T (D D^T + lambda Id - R R^T)^-1 x of each row, R being the row and its like: lambda h / (1 - h) by itself."""
    left, squares = np.asarray(spectrum.left), np.asarray(spectrum.values) ** 2
    held, loose = squares / (squares + ridge), ridge / (squares + ridge)
    odds = left**2 @ held / (left**2 @ loose)
    for rows in spectrum.repeats:
        bound, free = (left[rows] * share @ left[rows].T for share in (held, loose))
        odds[rows[0]] = bound[0] @ np.linalg.pinv(free, hermitian=True)[0]
    return (ridge * odds / np.asarray(spectrum.count))[spectrum.group]


def _sketched(train: Examples) -> np.ndarray:
    """(groups, lightings, _SKETCH) random combinations of the encoded texels."""
    entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
    shape = lambda light: light if train.channels == "mono" else light.reshape(len(light), -1, 1)  # noqa: E731
    if not isinstance(train.indirect, Maps):
        return np.asarray(_sketch(shape(train.indirect), entries))
    signs, start = _signs(len(entries)), 0
    total = np.zeros(())
    for block in map(shape, train.indirect.blocks()):
        stop = start + block.shape[1]
        total, start = total + np.asarray(_combined(block, entries[start:stop], signs[start:stop]), np.float64), stop
    return total.astype(np.float32)


@jax.jit
def _sketch(rows: Array, entries: Array) -> Array:
    return _combined(rows, entries, _signs(rows.shape[1]))


def _combined(rows: Array, entries: Array, signs: Array) -> Array:
    weights = jnp.sqrt(entries / _SKETCH)[:, None] * signs.astype(jnp.float32)
    return jnp.einsum("lec,es->cls", rows, weights, precision="highest")


@partial(jax.jit, static_argnums=0)
def _signs(entries: int) -> Array:
    return jax.random.rademacher(jax.random.key(0), (entries, _SKETCH), jnp.int8)


def _mean(train: Examples, encoding: Encoding) -> np.ndarray:
    """Mean of the scaled measurements in linear light, weighted by s² as the mean lightmap is."""
    scale = np.asarray(train.scale, np.float64)
    weight = (scale / max(float(scale.max(initial=0)), float(np.finfo(np.float32).tiny))) ** 2
    linear = np.asarray(encoding.decode(train.frame.values, jnp.ones_like(train.scale), clamp=False), np.float64)
    return (np.einsum("lc,lpc->pc", weight, linear) / np.maximum(weight.sum(0), 1e-300)).astype(np.float32)


@jax.jit
def _below_the_cap(values: Array) -> Array:
    """Light of which no scale meets its end at 2^126, where norms are not 1; powers of two take no digit off it."""
    return values * jnp.where(jnp.max(jnp.abs(values), (1, 2), keepdims=True, initial=0) > 2.0**90, 2.0**-32, 1)


@jax.jit
def _measure(directions: Array, shares: Array, encoding: Encoding, values: Array) -> tuple[Array, Array, Array]:
    scale = encoding.scale(values)
    return _parts(directions, shares, encoding.encode(values, scale), scale)


@jax.jit
def _parts(directions: Array, shares: Array, encoded: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Novelty, lambda times the leverage, and the unexplained part of each frame."""
    frames, groups = len(encoded), len(directions)
    x = jnp.moveaxis(encoded, 2, 1) if groups == 3 else encoded.reshape(frames, 1, -1)
    p = jnp.einsum("gdi,fgi->fgd", directions, x, precision="highest")
    rest = jnp.sum((x - jnp.einsum("gdi,fgd->fgi", directions, p, precision="highest")) ** 2, 2)
    held = jnp.sum(shares * p**2, 2) + rest
    loose = jnp.sum((shares * p) ** 2, 2) + rest
    size = jnp.sum(x**2, 2)
    peak = jnp.max(scale, 1, keepdims=True)
    weight = (scale[:, :groups] / jnp.where(peak > 0, peak, 1)) ** 2
    weight = weight / jnp.maximum(jnp.sum(weight, 1, keepdims=True), jnp.finfo(jnp.float32).tiny)
    size = jnp.where(size > 0, size, 1)
    novelty, square = (jnp.minimum(jnp.sum(weight * part / size, 1), 1) for part in (held, loose))
    return novelty, jnp.sum(weight * held, 1), jnp.sqrt(square)
