"""A lightmap of learned features that a tiny network decodes: what can a texel tell beyond the maps that it stores?

Each texel ships a few features, as many numbers as it has in the baseline's textures. Light is y = f . u + h(f) . W u: the
baseline, whose maps f may now move, and hidden units h that make further maps out of those stored. The matrix W says from the
frame's coefficients u what each unit counts. Decoded so, light of two frames still adds up, and W u is a matter of the frame,
not of the texel. With `light = "everywhere"` coefficients also turn the first layer, which bends the map from light to light.

Training starts from the baseline: f is its basis, W is zero. What is kept is the best on the validation lightings, the
baseline among it, so that there nothing gets worse.

Reference: Thies, Zollhoefer and Niessner, "Deferred neural rendering: image synthesis using neural textures", SIGGRAPH 2019
(features per texel and a decoder, learned together); Vaidyanathan et al., "Random-access neural compression of material
textures", SIGGRAPH 2023 (decoders small enough for a fragment shader).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import Field

from ddprt.fitting.basis import entry_weights, fit_basis
from ddprt.methods.learned import Layers, Learned, Seen, dense_layers, gated, importance_of, told
from ddprt.methods.method import Examples, FitReport, Frame, Maps, array_bytes, as_pytree, columns, grouped
from ddprt.methods.svd_ridge import LinearTransfer, transfer_to

RUNS, RUN = 16, 1024  # of light on disk a round of training knows so many runs of so many texels
CHECKED = 4  # times as many texels for looks at validation light on disk


class Decoder(NamedTuple):
    """What is trained, and shipped.

    Attributes:
      features: f of each texel; three rows of them where colours are interleaved.
      layers: from all features of a texel to hidden units.
      turn: what each coefficient adds to the first layer, its biases last; of no coefficients where light enters last.
      head: W, what each coefficient makes of each unit; where light enters everywhere, one row that counts whatever the light.
    """

    features: Float[Array, "texels out features"]
    layers: Layers
    turn: Float[Array, "_ _ _"]
    head: Float[Array, "_ hidden out"]

    def units(self, features: Float[Array, "some out features"], light: Array | None = None) -> Float[Array, "some hidden"]:
        """h of some texels; under a light where that turns the first layer."""
        hidden, layers = features.reshape(len(features), -1), self.layers
        if light is not None:
            turn = jnp.tensordot(light, self.turn, 1, precision="highest")
            layers = ((layers[0][0] + turn[:-1], layers[0][1] + turn[-1]), *layers[1:])
        for weight, bias in layers:
            hidden = gated(jnp.matmul(hidden, weight, precision="highest") + bias)
        return hidden

    def decode(
        self,
        features: Float[Array, "some out features"],
        light: Float[Array, "frames groups bases"],
        gain: Float[Array, " features"],
        rest: Float[Array, ""],
    ) -> Float[Array, "frames groups some out"]:
        """y = f . (gain u) + rest h . W u of some texels, or rest h(u) . W."""
        sums = partial(jnp.einsum, precision="highest")
        linear = sums("tok,fgk->fgto", features, light[..., : len(gain)] * gain)
        if not len(self.turn):
            counts = sums("fgk,kho->fgho", light, self.head) * rest
            return linear + sums("th,fgho->fgto", self.units(features), counts)
        # One frame after the other: units of all of them at once would fill the memory.
        each = light.reshape(-1, light.shape[2])
        bent = jax.lax.map(lambda u: jnp.matmul(self.units(features, u), self.head[0] * rest, precision="highest"), each)
        return linear + bent.reshape(linear.shape)


@as_pytree
@dataclass(frozen=True)
class NeuralLightmap:
    """u = M z, decoded texel by texel; what comes first is what an array in few bits has a scale for.

    Attributes:
      matrix: M, over the size of each coefficient.
      gain: that size, for as many as there are features.
      basis: f, a map each, colours interleaved for "multi".
      weights, biases, turn, head: see `Decoder`.
    """

    matrix: Float[Array, "bases groups inputs"]
    gain: Float[Array, " features"]
    basis: Float[Array, "features entries"]
    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]
    turn: Float[Array, "_ _ _"]
    head: Float[Array, "_ hidden out"]
    report: FitReport = field(default=FitReport(), compare=False)

    def predict(self, frame: Frame) -> Float[Array, "frames texels 3"]:
        """See `Relighter`."""
        groups = self.matrix.shape[1]
        light = jnp.einsum("bgp,fgp->fgb", self.matrix, grouped(frame.values, groups), precision="highest")
        features = _by_texel(self.basis, groups)
        decoder = Decoder(features, tuple(zip(self.weights, self.biases, strict=True)), self.turn, self.head)
        found = decoder.decode(features, light, self.gain, jnp.ones(()))
        return jnp.moveaxis(found[..., 0], 1, 2) if groups == 3 else found[:, 0]

    @property
    def nbytes(self) -> int:
        """See `Relighter`."""
        return array_bytes(self)

    @property
    def flops(self) -> int:
        """See `Relighter`: two per multiply-add; units are counted once for all channels unless light turns the first layer."""
        groups, (features, entries), (_, hidden, out) = self.matrix.shape[1], self.basis.shape, self.head.shape
        units = sum(int(weight.size) for weight in self.weights) * (groups if len(self.turn) else 1)
        per_frame = self.matrix.size + groups * (self.turn.size + self.head.size)
        return 2 * int(per_frame + entries // out * units + groups * entries * (features + hidden))


def _by_texel(maps: Float[Array, "features entries"], groups: int) -> Float[Array, "texels out features"]:
    out = 3 // groups
    return jnp.moveaxis(maps.reshape(len(maps), maps.shape[1] // out, out), 0, 2)  # there may be no map at all


class NeuralMap(Learned):
    """Features per texel and a tiny decoder, trained on lightings and texels drawn anew for each step."""

    relighter: ClassVar[type] = NeuralLightmap
    why: ClassVar[str] = "learned: do a texel's numbers make further maps through a network that a fragment shader can run?"
    search: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "bases": (6, 8, 12, 14, 16, 24, 32),
        "width": (8, 16, 32, 64),
        "light": ("last", "last", "everywhere"),
        "learning_rate": (2e-3, 5e-3, 1e-2),
        "steps": (500, 2000),
    }
    streams: ClassVar[bool] = True
    bases: int = Field(16, ge=1, description="features of a texel, each the baseline's basis texture to begin with")
    coefficients: int = Field(
        0, ge=0, description="numbers that tell of the light; 0: twice the bases, as many as them where it enters everywhere"
    )
    width: int = Field(32, ge=1, le=256)
    depth: int = Field(1, ge=1, le=4)
    light: Literal["last", "everywhere"] = Field("last", description="where coefficients enter: last keeps light additive")
    ridge: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"
    learning_rate: float = Field(5e-3, gt=0)
    lightings: int = Field(16, ge=1, description="of a step")
    texels: int = Field(512, ge=1, description="of a step")

    def fit(self, train: Examples, validation: Examples, *, key: Array) -> NeuralLightmap:
        """See `Method`: of light on disk each round of training sees other texels, drawn anew."""
        entries = jnp.asarray(entry_weights(train.area, train.weights, train.channels))  # type: ignore[arg-type]
        turned = self.light == "everywhere"
        count = self.coefficients or self.bases * (1 if turned else 2)
        basis = fit_basis(columns(train)[0], entries, bases=max(self.bases, count))
        linear = transfer_to(basis, train, self.ridge)
        groups, bases, _ = linear.matrix.shape
        out, kept = 3 // groups, min(self.bases, bases)
        matrix = jnp.swapaxes(linear.matrix, 0, 1)
        if bases == 0:
            none = (
                (jnp.zeros((0, self.width)),),
                (jnp.zeros(self.width),),
                jnp.zeros((0, 0, 0)),
                jnp.zeros((0, self.width, out)),
            )
            return NeuralLightmap(matrix, jnp.zeros(0), basis.vectors, *none, linear.report)
        start = _by_texel(basis.vectors[:kept], groups)
        share = entries.reshape(-1, out) * entries.size
        seen, held = (_lit(part, linear, start, share) for part in (train, validation))
        spread = Seen(seen.light, seen.light, seen.importance, jnp.ones(bases)).spread
        gain = spread[:kept]
        seen, held = (part._replace(light=part.light / spread, gain=gain) for part in (seen, held))
        draw = jax.random.fold_in(key, 0)
        rest = _left(_looked_at(seen, train, draw, 0))
        seen, held = seen._replace(rest=rest), held._replace(rest=rest)
        of_round = partial(_looked_at, seen, train, draw)
        held = _looked_at(held, validation, draw, 0, CHECKED)
        problem = Decoding(self.width, self.depth, turned, self.lightings, self.texels)
        data = of_round if isinstance(train.indirect, Maps) else of_round(0)
        trained = self.trained("neural-lightmap", problem, data, held, key)
        silent = trained.parameters._replace(features=start, head=jnp.zeros_like(trained.parameters.head))
        better = _check(problem, trained.parameters, held) < _check(problem, silent, held)
        chosen: Decoder = trained.parameters if better else silent
        report = told(replace(linear.report, bases=kept), trained)
        weights, biases = zip(*chosen.layers, strict=True)
        maps = jnp.moveaxis(chosen.features, 2, 0).reshape(kept, -1)
        matrix = matrix / spread[:, None, None]
        return NeuralLightmap(matrix, gain, maps, weights, biases, chosen.turn, chosen.head * rest, report)


class Lit(NamedTuple):
    """Lightings by their coefficients, and the light that they make at the texels that are looked at.

    Attributes:
      light: u, over its root mean square in training.
      importance: of each lighting and group, mean 1: its share in squared errors of light.
      start: features of all texels to begin with.
      share: of each entry of a map in squared errors, mean 1 over all of them.
      at: which texels are looked at.
      target: their encoded indirect light.
      gain: what u was divided by, for as many as there are features.
      rest: root mean square of what the baseline leaves of the training light.
    """

    light: Float[Array, "lightings groups bases"]
    importance: Float[Array, "lightings groups"]
    start: Float[Array, "texels out features"]
    share: Float[Array, "some out"]
    at: Int[Array, " some"]
    target: Float[Array, "lightings groups some out"]
    gain: Float[Array, " features"]
    rest: Float[Array, ""]


def _lit(examples: Examples, linear: LinearTransfer, start: Array, share: Array) -> Lit:
    light = linear.coefficients(examples.frame)
    target = jnp.zeros((*light.shape[:2], 0, share.shape[1]))
    importance, none = importance_of(light.shape[1], examples.scale), jnp.zeros(0, jnp.int32)
    return Lit(light, importance, start, share, none, target, jnp.zeros(0), jnp.ones(()))


def _looked_at(lit: Lit, examples: Examples, key: Array, number: int, times: int = 1) -> Lit:
    """With the light of a round: all of it, or of what stays on disk `times` as many runs of texels as usual, drawn anew."""
    light, groups, whole = examples.indirect, lit.light.shape[1], len(lit.share)
    if isinstance(light, Maps):
        run = min(RUN, whole)
        starts = jax.random.randint(jax.random.fold_in(key, number), (min(times * RUNS, -(-whole // run)),), 0, whole)
        at, some = (starts[:, None] + jnp.arange(run)).reshape(-1) % whole, light.runs(np.asarray(starts).tolist(), run)
    else:
        at, some = jnp.arange(whole), light
    rows = grouped(some, groups)
    return lit._replace(at=at, share=lit.share[at], target=rows.reshape(*rows.shape[:2], -1, 3 // groups))


@dataclass(frozen=True)
class Decoding:
    """See `Problem`: features and decoder together.

    Attributes:
      width, depth: of the hidden layers.
      turned: whether coefficients enter in the first layer, too.
      lightings, texels: drawn for a step.
    """

    width: int
    depth: int
    turned: bool
    lightings: int
    texels: int

    def initial(self, data: Lit, key: Array) -> Decoder:
        """The baseline: hidden units by chance, of which nothing is made."""
        layers_key, turn_key = jax.random.split(key)
        (_, out, features), bases = data.start.shape, data.light.shape[2]
        layers = dense_layers([out * features, *[self.width] * self.depth], layers_key)
        size = (bases if self.turned else 0, out * features + 1, self.width)
        turn = jax.random.normal(turn_key, size) / jnp.sqrt(max(bases * out * features, 1))
        return Decoder(data.start, layers, turn, jnp.zeros((1 if self.turned else bases, self.width, out)))

    def loss(self, parameters: Decoder, data: Lit, key: Array) -> Float[Array, ""]:
        """Of texels and lightings that the key draws."""
        texel_key, lighting_key = jax.random.split(key)
        texel = jax.random.randint(texel_key, (self.texels,), 0, len(data.share))
        lighting = jax.random.randint(lighting_key, (self.lightings,), 0, len(data.light))
        drawn = data._replace(
            light=data.light[lighting],
            target=data.target[lighting[:, None], :, texel].swapaxes(1, 2),
            importance=data.importance[lighting],
            share=data.share[texel],
        )
        return _error(parameters, parameters.features[data.at[texel]], drawn)

    def check(self, parameters: Decoder, held: Lit) -> Float[Array, ""]:
        """Mean squared error of light, in units of what the baseline leaves of the training light."""
        return _error(parameters, parameters.features[held.at], held)


def _error(decoder: Decoder, features: Array, data: Lit) -> Float[Array, ""]:
    kind = features.dtype
    found = decoder.decode(features, data.light.astype(kind), data.gain.astype(kind), data.rest.astype(kind))
    share = data.importance[:, :, None, None] * data.share
    return jnp.mean(share * ((found.astype(jnp.float32) - data.target) / data.rest) ** 2)


@partial(jax.jit, static_argnums=0)
def _check(problem: Decoding, parameters: Decoder, held: Lit) -> Array:
    return problem.check(parameters, held)


@jax.jit
def _left(data: Lit) -> Float[Array, ""]:
    """See `Lit.rest`; no less than what float32 tells from the light itself."""
    light = data.light[..., : len(data.gain)] * data.gain
    baseline = jnp.einsum("tok,fgk->fgto", data.start[data.at], light, precision="highest")
    root = lambda light: jnp.sqrt(jnp.mean(data.importance[:, :, None, None] * data.share * light**2))  # noqa: E731
    floor = jnp.finfo(jnp.float32).eps * root(data.target)
    return jnp.maximum(jnp.maximum(root(baseline - data.target), floor), jnp.finfo(jnp.float32).tiny)
