"""A ball of fur: as many strands as are asked for, on a skin."""

import numpy as np

from ddprt.errors import UserError
from ddprt.scene.checks import checked
from ddprt.scene.material import Fibre, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import icosphere
from ddprt.scene.strands import Strands
from ddprt.scene.tubes import TEXELS, with_strands

COLOUR = (0.45, 0.18, 0.05)
_THIN, _MANY = 4e-5, 140_000  # radius of so many hairs; fewer are thicker, by the root of their number
_TURN = np.pi * (3 - 5**0.5)  # from one root to the next, about the ball


def furball(
    *,
    strands: int = 1000,
    radius: float = 0.05,
    length: float = 0.04,
    curl: float = 0.15,
    along: float = 0.3,
    around: float = 0.3,
    subdivisions: int = 3,
) -> Scene:
    """A ball of ginger fur: strands stand on a sphere, bend down by their weight and wind a little.

    Args:
      strands: how many; those of the paper's hair ball were 140 000.
      radius: of the skin, metres.
      length: of a strand, metres.
      curl: how far strands wind about their way, as a share of the length.
      along, around: roughness of the fibres, see `Fibre`.
      subdivisions: 20 * 4^n triangles of skin.
    Raises:
      UserError: no strands, or a size or roughness that cannot be.
    """
    if strands < 1 or min(radius, length) <= 0 or not (0 < along <= 1 and 0 < around <= 1):
        raise UserError(
            f"furball: got {strands} strands, radius {radius:g} m, length {length:g} m, along {along:g} and around {around:g}, "
            "expected a strand, sizes above 0 and roughness from 0 to 1; correct them"
        )
    number = np.arange(strands)
    height, turn = 1 - (2 * number + 1) / strands, number * _TURN
    flat = np.sqrt(1 - height**2)
    outward = np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], 1)
    share = np.linspace(0, 1, TEXELS + 1)[None, :, None]
    sideways = np.cross(outward, [0.36, 0.48, 0.8])
    beside = np.cross(outward, sideways)
    phase = (0.7548776662466927 * number)[:, None, None] % 1
    wound = (
        curl
        * share
        * (
            np.sin(2 * np.pi * (share + phase)) * sideways[:, None]
            + np.cos(2 * np.pi * (1.3 * share + phase)) * beside[:, None]
        )
    )
    way = outward[:, None] * share + wound + 0.45 * share**2 * np.array([0.0, -1.0, 0.0])
    points = np.round(radius * outward[:, None] + length * way, 9)  # sines differ in their last bit among machines
    thick = _THIN * (_MANY / strands) ** 0.5 * (radius / 0.05)
    widths = np.broadcast_to(np.linspace(1.0, 0.4, TEXELS + 1) * thick, (strands, TEXELS + 1))
    start = (TEXELS + 1) * np.arange(strands + 1)
    fur = Strands(points.reshape(-1, 3), widths.ravel().copy(), start, np.tile(np.array(COLOUR, np.float32), (strands, 1)))
    directions, faces = icosphere(subdivisions)
    skin = checked("furball", radius * directions, faces, normals=directions, materials=(Material("skin", (0.5, 0.35, 0.28)),))
    return with_strands(skin, "furball", fur, Material("fur", COLOUR, fibre=Fibre(along, around)))
