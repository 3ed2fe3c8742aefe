"""Direct light traced again: whether imported maps are what their lights, mesh and quantity say."""

from collections.abc import Sequence

import numpy as np

from ddprt.axes import Float32
from ddprt.dataset.importers.places import Places
from ddprt.lights import Lighting
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure

_OFF = 0.1  # of the brightness, by which two renderers may differ
_ALIKE = 0.9  # correlation of maps that show the same
_LIKELY = {np.pi: "they look like E where E/pi was said", 1 / np.pi: "they look like E/pi: try --quantity E/pi"}


def told(
    places: Places,
    texel: np.ndarray,
    lightings: Sequence[Lighting],
    direct: Float32[np.ndarray, "lightings texels 3"],
    turned: Float32[np.ndarray, "lightings texels 3"],
) -> tuple[str, bool]:
    """How imported direct light compares with shadow rays of our own, and whether it agrees.

    Args:
      places: with a mesh.
      texel: where it is compared.
      lightings: some.
      direct: their maps, W/m².
      turned: the same of maps that are upside down.
    """
    tracer = Tracer(places.corners)
    position, normal = (getattr(places, name)[texel].astype(np.float64) for name in ("position", "normal"))
    traced = np.stack([measure(tracer, lighting, position, normal, seed=0) for lighting in lightings]).astype(np.float64)
    given = direct[:, texel].astype(np.float64)
    if not traced.any() and not given.any():
        return "direct light traced again: dark, as imported, so it tells nothing", True
    if not given.any() or not traced.any():
        dark, lit = ("imported", "traced again") if traced.any() else ("traced again", "imported")
        words = f"direct light is dark as {dark}, and is not as {lit}, at {len(texel)} texels of {len(lightings)} lightings"
        upside = not given.any() and _correlation(turned[:, texel].astype(np.float64), traced) > _ALIKE
        look = "they look upside down: row 0 of a map is its top" if upside else "look at the lights, the axes and the way up"
        return f"{words}; {look}", False
    ratio, alike = float(given.sum() / traced.sum()), _correlation(given, traced)
    words = f"direct light traced again at {len(texel)} texels of {len(lightings)} lightings: imported / traced {ratio:.3f}"
    words += f", correlation {alike:.3f}"
    fits = abs(ratio - 1) < _OFF and alike > _ALIKE
    for factor, why in _LIKELY.items():
        if abs(ratio / factor - 1) < _OFF and alike > _ALIKE:
            words += f"; {why}"
    if alike <= _ALIKE and _correlation(turned[:, texel].astype(np.float64), traced) > max(alike, _ALIKE):
        words += "; they look upside down: row 0 of a map is its top"
    elif not fits and alike <= _ALIKE:
        words += "; look at the order of the lights, the axes (Y up) and the lightmap coordinates"
    return words, fits


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    a, b = one.ravel() - one.mean(), other.ravel() - other.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else 0.0
