"""A scene before its bake on one page: its texels as a checker, how dense they are, where its charts part, where it faces."""

import base64
from dataclasses import dataclass

import numpy as np

from ddprt import __version__
from ddprt.axes import Float64
from ddprt.report.view import default_camera, diverging, png, take_view
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

_SQUARE = 4  # texels
_STOPS = 1.0  # doublings of the density at both ends of its colours
_TWICE = 1.01  # of a texel: more than that of it is covered by more than one place
_GOLDEN = 0.618034  # of a turn of the hue between one chart and the next
_GROUND = 0.12


@dataclass(frozen=True)
class Shown:
    """A quantity of the texels in colours.

    Attributes:
      name, told: its title, and what is to be seen.
      colours: of each texel, 0 to 1, as displayed.
    """

    name: str
    told: str
    colours: Float64[np.ndarray, "texels 3"]


def shown(atlas: Atlas) -> list[Shown]:
    """What the page draws, on the scene and on the lightmap."""
    row, column = np.divmod(atlas.texel, atlas.resolution)
    light = (row // _SQUARE + column // _SQUARE) % 2 == 0
    hue = _hues(atlas.chart)
    spread = np.log2(densities(atlas) / atlas.texels_per_metre)
    low, middle, high = np.quantile(densities(atlas), [0.05, 0.5, 0.95])
    lapped = atlas.coverage > _TWICE
    charts = len(np.unique(atlas.chart))
    return [
        Shown(
            "Checker",
            f"Squares of {_SQUARE} x {_SQUARE} texels, a hue for each of {charts} charts: seams are where hues meet; squares "
            "that are no squares are stretched texels.",
            hue * np.where(light, 1.0, 0.55)[:, None],
        ),
        Shown(
            "Density",
            f"White: {atlas.texels_per_metre:.3g} texels per metre, the mean; red is twice as dense, blue half. Nine of ten "
            f"texels have {low:.3g} to {high:.3g}, the median {middle:.3g}.",
            diverging(spread, _STOPS),
        ),
        Shown(
            "Normals",
            "Where fronts face: red, green and blue are x, y and z, -1 to 1. Backs are not drawn: what is missing here is "
            "seen from behind.",
            0.5 + 0.5 * atlas.normal,
        ),
        Shown(
            "Overlaps",
            f"Red: {int(lapped.sum())} of {atlas.count} texels are taken more than once. Brighter greys are covered more.",
            np.where(lapped[:, None], [0.85, 0.1, 0.1], 0.25 + 0.6 * np.clip(atlas.coverage, 0, 1)[:, None]),
        ),
        Shown("Albedo", "What the surface reflects, as displayed.", np.clip(atlas.albedo, 0, 1) ** (1 / 2.2)),
    ]


def densities(atlas: Atlas) -> Float64[np.ndarray, " texels"]:
    """Texels per metre about each texel, by what of it is covered and the m² of that."""
    return np.sqrt(atlas.coverage / np.maximum(atlas.area, 1e-300))


def inspection_page(scene: Scene, tracer: Tracer, atlas: Atlas, told: str) -> str:
    """The page as HTML, which opens from disk.

    Args:
      scene, tracer, atlas: as a bake would have them.
      told: what `ddprt inspect` says of them, a name and a text in each line.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("ddprt", "report")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    covered = atlas.slot >= 0
    view = take_view(tracer, atlas.uv, covered, default_camera(scene))
    pictures = []
    for one in shown(atlas):
        flat = np.full((*covered.shape, 3), _GROUND)
        flat[covered] = one.colours[atlas.slot[covered]]
        seen = np.concatenate([view.render(one.colours) + _GROUND * (1 - view.alpha[..., None])], 2)
        pictures.append({"name": one.name, "told": one.told, "seen": _inline(seen), "flat": _inline(flat)})
    lines = [(line[:12].strip(), line[12:]) for line in told.splitlines()]
    return environment.get_template("inspection.html.j2").render(
        version=__version__, scene=scene.name, pictures=pictures, lines=lines
    )


def _hues(chart: np.ndarray) -> Float64[np.ndarray, "texels 3"]:
    """A bright colour for each chart, far from those of the charts before and after it."""
    _, number = np.unique(chart, return_inverse=True)
    turn = (number * _GOLDEN % 1)[:, None] + np.array([0, 1 / 3, 2 / 3])
    return 0.62 + 0.33 * np.cos(2 * np.pi * turn)


def _inline(image: Float64[np.ndarray, "height width 3"]) -> str:
    return "data:image/png;base64," + base64.b64encode(png(image)).decode()
