"""A Model: a Relighter with everything that an engine needs around it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ddprt.catalogue import Catalogue
from ddprt.dataset.layers import Layer
from ddprt.dataset.store import average_into_points
from ddprt.errors import UserError
from ddprt.fitting.encoding import Encoding
from ddprt.lights import Light, Lighting, parse_lighting
from ddprt.methods import packages
from ddprt.methods.learned import TakesAnyPoints
from ddprt.methods.method import AsksForLights, Frame, Relighter
from ddprt.runtime.coefficients import Coefficients
from ddprt.runtime.trust import Trust, Yardstick
from ddprt.sampling.points import Samples
from ddprt.scene.fog import Fog
from ddprt.scene.holes import Holes
from ddprt.scene.viewpoint import Viewpoint

_LARGEST = float(np.finfo(np.float32).max)
_AT_ONCE = 64  # lightings whose samples are averaged into points together
_NOT_FINITE = "values: got NaN or infinity in float32, expected finite W/m²; check how the points are shaded"


@dataclass(frozen=True, eq=False)
class Model:
    """Relights a scene; make one with `ddprt.fit` or `ddprt.load_model`.

    Attributes:
      method: entry of `METHODS`.
      relighter: what was learned.
      encoding: scale and space of the light it sees.
      samples: where to shade, all supersamples in progressive order.
      points: how many values they are averaged into.
      quantity: what is measured there, "radiosity" or "irradiance".
      covered: which texels of the lightmap carry light.
      area: of the covered texels, m².
      occluders: triangle corners that cast shadows, metres.
      scene: name and digest of what it was trained on; "unmeasured" tells why it cannot measure lights by itself, if it cannot.
      uv: lightmap coordinates of the occluders' corners, origin top-left; None in models of older versions.
      yardstick: what trust is measured with; None likewise.
      layers: what answers for light besides the lightmap, by name of the layer.
      holes: where light passes through the occluders; None where it nowhere does.
      constant: irradiance of emissive surfaces, which no light changes, W/m²; None where nothing glows.
      exitant: covered texels whose light is all that leaves them, to which no diffuse reflection of lamps comes; None where
        there are none.
      albedo: of the covered texels, linear, to show them by; no answer depends on it. None in models of older versions.
      fog: what fills the bounding box of the occluders; None for clear air.
      viewpoint: from where a viewer starts; None for its own choice. No answer depends on it.
    """

    method: str
    relighter: Relighter
    encoding: Encoding
    samples: Samples
    points: int
    quantity: str
    covered: np.ndarray
    area: np.ndarray
    occluders: np.ndarray
    scene: dict[str, str]
    uv: np.ndarray | None = None
    yardstick: Yardstick | None = None
    layers: "Mapping[str, LayerModel]" = field(default_factory=lambda: Catalogue("layer", {}))
    holes: Holes | None = None
    constant: np.ndarray | None = None
    exitant: np.ndarray | None = None
    albedo: np.ndarray | None = None
    fog: Fog | None = None
    viewpoint: Viewpoint | None = None

    def predict(
        self,
        values: Any,
        *,
        lightings: Any = None,
        points: Any = None,
        clamp: bool | str = True,
        fade: bool = False,
        constant: bool = True,
    ) -> np.ndarray:
        """Indirect irradiance from measured light, and the light of what glows.

        Args:
          values: (points, 3) or (frames, points, 3) measured light in W/m², of `quantity`.
          lightings: what was measured: a lighting, or one for each frame. Only methods that answer from lights look at it.
          points: which of the model's points `values` are of, in that order, where not all of them; for methods that take any.
          clamp: cut negative light off, as an engine does; "energy": in the way that keeps the total of each frame and channel
            (see `ddprt.fitting.encoding.without_negatives`); False keeps it.
          fade: where trust is low, go over to the mean lightmap, as bright as the measurements are.
          constant: add the light of emissive surfaces, where there are any, last; False leaves what the lights change.
        Returns:
          (texels, 3) or (frames, texels, 3) float32, W/m², covered texels in row-major order.
        Raises:
          UserError: wrong shape, not real numbers, not finite, no such clamp, nothing to fade by, no lightings where the method
            asks for them, or points where it takes no other than all.
        """
        chosen = None if points is None else self._chosen(points)
        frames, single = self._frames(values, None if chosen is None else len(chosen))
        if not isinstance(clamp, bool | np.bool_ | str) or clamp not in (True, False, "energy"):
            raise UserError(f'clamp: got {clamp!r}, expected True, False or "energy"')
        area = self._shares if clamp == "energy" else None
        with packages.blamed(self.method):
            told = self._described(lightings, len(frames), single) if isinstance(self.relighter, AsksForLights) else None
        if fade and told is not None:
            raise UserError(f"fade: got True for {self.method}, which answers from lights; leave it out, or fit svd-ridge")
        if fade and self.yardstick is None:
            raise UserError("fade: got a model of an older version, which knows no trust; fit it again")
        if fade and chosen is not None:
            raise UserError("fade: got True with points, but trust is measured by all of them; leave one of the two out")
        places = self._places if chosen is None else (self._places[0][chosen], self._places[1][chosen])
        with packages.blamed(self.method):
            light = np.asarray(_relight(self.relighter, self.encoding, frames, told, *places, bool(clamp), area))
            if self.method in packages.ORIGINS and not np.isfinite(light).all():
                raise FloatingPointError("answers that are not finite")
        if fade and self.yardstick is not None:
            kept = self.yardstick.kept(self.yardstick.measure(self.encoding, frames).score)[:, None, None]
            scale = np.asarray(self.encoding.scale(frames), np.float64)[:, None]
            faded = kept * light + (1 - kept) * (self.predict(self.yardstick.mean, clamp=clamp, constant=False) * scale)
            light = np.where(kept < 1, np.clip(faded, -_LARGEST, _LARGEST), light).astype(np.float32)
        if constant and self.constant is not None:
            light = light + self.constant
        return light[0] if single else light

    def coefficients(self, values: Any) -> np.ndarray:
        """What each basis texture counts in a frame: y = max(0, sum of coefficients times `textures`)^gamma, in W/m².

        What `constant` holds comes on top of y.

        The brightness of the frame is in them; a mean lightmap, where there is one, is the first texture. Quick: a few
        microseconds for one frame.

        Args:
          values: as for `predict`.
        Returns:
          (channels, textures) or (frames, channels, textures) float32; for "multi" all channels share one row.
        Raises:
          UserError: as for `predict`, or the method is not linear.
        """
        known = type(values) is np.ndarray and values.dtype == np.float32
        measured = values if known else _real(values)
        single = measured.ndim == 2
        self._check_shape(measured, self.points)
        answer = self._transfer.answer(measured[None] if single else measured)
        if answer is None:
            raise UserError(_NOT_FINITE)
        return answer[0] if single else answer

    @cached_property
    def textures(self) -> np.ndarray:
        """(textures, texels) float32 for "mono", (textures, texels, 3) for "multi": what `coefficients` weigh.

        Raises:
          UserError: the method is not linear.
        """
        leads, relighter = self._transfer.leads, self.relighter
        entries = np.concatenate([relighter.mean[None], relighter.basis]) if leads else np.asarray(relighter.basis)  # type: ignore[attr-defined]
        return entries if self.encoding.channels == "mono" else entries.reshape(len(entries), -1, 3)

    def trust(self, values: Any) -> Trust | None:
        """How far measured light lies from what the model was trained on, and what error to expect; None in older models.

        It goes by measurements alone: of a method that answers from lights, for kinds of light that it was trained with.

        Args:
          values: as for `predict`. Lamps that no measurement point sees are not told from lamps that are off.
        Raises:
          UserError: wrong shape, not real numbers, or not finite.
        """
        frames, single = self._frames(values)
        if self.yardstick is None:
            return None
        found = self.yardstick.measure(self.encoding, frames)
        return Trust(*(np.asarray(getattr(found, entry.name)[0]) for entry in fields(found))) if single else found

    def measure(self, lighting: Lighting | Light | Sequence[dict[str, Any]] | dict[str, Any]) -> np.ndarray:
        """(points, 3) float32: direct light at the points with shadow rays, W/m², as `predict` takes it.

        Raises:
          UserError: no lighting, or a model of imported light that lacks what it would take.
        """
        return self.measure_all([lighting])[0]

    def measure_all(self, lightings: Sequence[Any]) -> np.ndarray:
        """(lightings, points, 3) float32: `measure` of each, on all cores; the same bits."""
        from ddprt.transport.measure import measure

        if "unmeasured" in self.scene:
            raise UserError(f"measure: got a lighting, but {self.scene['unmeasured']}")
        samples = self.samples

        def work(lighting: Any) -> np.ndarray:
            return measure(
                self._tracer, parse_lighting(lighting), samples.position, samples.normal, seed=0, depth=samples.depth
            )

        found = [np.zeros((0, self.points, 3), np.float32)]
        for first in range(0, len(lightings), _AT_ONCE):
            light = np.stack(list(self._tracer.map(work, lightings[first : first + _AT_ONCE])))
            found.append(average_into_points(light, samples, self.points, self.quantity))
        return np.concatenate(found)

    def relight(
        self, lighting: Lighting | Light | Sequence[dict[str, Any]] | dict[str, Any], *, constant: bool = True
    ) -> np.ndarray:
        """Indirect lightmap of a lighting, and the light of what glows.

        Args:
          lighting: a light, several, or their JSON records.
          constant: as for `predict`.
        Returns:
          (height, width, 3) float32 irradiance in W/m², row 0 at the top, 0 where nothing is covered.
        """
        return self.image(self.predict(self.measure(lighting), lightings=lighting, constant=constant))

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values of covered texels as an image."""
        image = np.zeros((*self.covered.shape, *values.shape[1:]), values.dtype)
        image[self.covered] = values
        return image

    def save(self, folder: str | Path) -> None:
        """Writes a self-contained folder: model.json and tensors.safetensors."""
        from ddprt.runtime.model_file import save_model

        save_model(self, Path(folder))

    def _chosen(self, points: Any) -> np.ndarray:
        """Which points, as indices.

        Raises:
          UserError: the method takes all of them or none, or they are no indices of different points.
        """
        if not isinstance(self.relighter, TakesAnyPoints):
            raise UserError(
                f"points: got some of them, but {self.method} answers from all {self.points}; leave it out, or fit point-set"
            )
        chosen = np.asarray(points)
        fine = chosen.ndim == 1 and len(chosen) > 0 and np.issubdtype(chosen.dtype, np.integer)
        if not fine or chosen.min() < 0 or chosen.max() >= self.points or len(np.unique(chosen)) < len(chosen):
            raise UserError(
                f"points: got {' '.join(repr(points).split())[:60]}, expected different whole numbers from 0 to "
                f"{self.points - 1}; name each measured point once"
            )
        return chosen

    def _frames(self, values: Any, points: int | None = None) -> tuple[Float[Array, "frames points 3"], bool]:
        """Measured light as frames, and whether it was a single one."""
        measured = _real(values)
        single = measured.ndim == 2
        self._check_shape(measured, self.points if points is None else points)
        if not np.isfinite(measured).all():
            raise UserError(_NOT_FINITE)
        return jnp.asarray(measured[None] if single else measured), single

    def _described(self, lightings: Any, frames: int, single: bool) -> Float[Array, "frames numbers 3"]:
        if lightings is None:
            raise UserError(
                f"lightings: got none, expected what was measured, since {self.method} answers from lights; "
                "pass lightings to predict, or use relight"
            )
        each = [lightings] if single else list(lightings)
        if len(each) != frames:
            raise UserError(f"lightings: got {len(each)}, expected one for each of {frames} frames; pass as many")
        # One without lights is dark.
        return jnp.asarray(self.relighter.describe([one and parse_lighting(one) for one in each]), jnp.float32)  # type: ignore[attr-defined]

    def _check_shape(self, measured: np.ndarray, points: int) -> None:
        if measured.shape[-2:] != (points, 3) or measured.ndim not in (2, 3):
            raise UserError(f"values: got shape {measured.shape}, expected ({points}, 3) or (frames, {points}, 3)")

    @cached_property
    def _transfer(self) -> Coefficients:
        return Coefficients.of(self.relighter, self.encoding)

    @cached_property
    def _places(self) -> tuple[Array, Array]:
        return (
            jnp.asarray(self.samples.position[: self.points], jnp.float32),
            jnp.asarray(self.samples.normal[: self.points], jnp.float32),
        )

    @cached_property
    def _shares(self) -> Array:
        # Shares before float32, which knows neither the sum of huge areas nor a tiny one.
        return jnp.asarray(self.area / self.area.max(initial=np.finfo(float).tiny), jnp.float32)

    @cached_property
    def _tracer(self) -> Any:
        from ddprt.transport.embree import Tracer

        return Tracer(self.occluders, holes=self.holes, fog=self.fog)


@dataclass(frozen=True, eq=False)
class LayerModel:
    """What answers for a layer: the same measurements, a basis and a transfer of its own.

    Attributes:
      layer: where its functions are.
      model: its texels are coefficients, places down and harmonics across.
    """

    layer: Layer
    model: Model

    def predict(self, values: Any, *, lightings: Any = None, constant: bool = True) -> np.ndarray:
        """Harmonics from measured light, and the light of what glows.

        Args:
          values, lightings, constant: as for `Model.predict`.
        Returns:
          (places, coefficients, 3) or (frames, places, coefficients, 3) float32, in the layer's quantity.
        Raises:
          UserError: likewise.
        """
        light = self.model.predict(values, lightings=lightings, clamp=False, constant=constant)
        return light.reshape(*light.shape[:-2], *self.model.covered.shape, 3)

    def towards(self, values: Any, directions: Any, *, lightings: Any = None, constant: bool = True) -> np.ndarray:
        """Values of the functions in a direction (3,), or in one for each place (places, 3); never below 0."""
        light = self.predict(values, lightings=lightings, constant=constant)
        return self.layer.towards(light, np.asarray(directions, np.float64))


def _real(values: Any) -> np.ndarray:
    """What was given as float32, infinite where that is past its range.

    Raises:
      UserError: it is no array of real numbers.
    """
    expected = "expected an array of real numbers, W/m²; pass what the measurement points receive"
    try:
        given = np.asarray(values)
    except ValueError:
        raise UserError(f"values: got rows of unequal length, {expected}") from None
    if not (jnp.issubdtype(given.dtype, jnp.floating) or jnp.issubdtype(given.dtype, jnp.integer)):
        raise UserError(f"values: got {given.dtype} entries, {expected}")
    with np.errstate(over="ignore"):
        return given.astype(np.float32, copy=False)


@jax.jit
def _relight(
    relighter: Relighter,
    encoding: Encoding,
    values: Float[Array, "frames points 3"],
    described: Float[Array, "frames numbers 3"] | None,
    positions: Float[Array, "points 3"],
    normals: Float[Array, "points 3"],
    clamp: bool | Array,
    area: Float[Array, " texels"] | None,
) -> Float[Array, "frames texels 3"]:
    scale = encoding.scale(values)
    told = None if described is None else encoding.encode(described, scale)
    frame = Frame(encoding.encode(values, scale), positions, normals, described=told)
    return encoding.decode(relighter.predict(frame), scale, clamp=clamp, energy_over=area)
