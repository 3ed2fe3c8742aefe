"""Strands as tubes of triangles, which are traced, cut into texels and lit as any surface is.

A tube is a prism of three sides whose perimeter is that of the round fibre, 2 pi r. So its side area is the fibre's; and
since a convex outline is on average as wide as its perimeter over pi (Cauchy), it stops as much light: 2 r. Each strand is
turned about its own axis by another angle. Pieces of a strand are of equal length, a whole number of them to a texel.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ddprt.axes import Float64, Int
from ddprt.scene.material import Fibre, Material
from ddprt.scene.mesh import SIDES, Scene, Tubes
from ddprt.scene.strands import Strands, load_strands

TEXELS = 10
"""Of a strand, by arc length (Belcour et al., HPG 2022, 6.3)."""

CORNER = 2 * np.pi / (SIDES * 2 * np.sin(np.pi / SIDES))
"""How far corners are from the axis, in radii."""

_MOST = 4  # pieces of a texel: what is curlier is cut short
_GOLDEN = 0.6180339887498949


def resampled(strands: Strands) -> Tubes:
    """The strands at equal steps of arc length, as finely as the one with most points needs, within bounds."""
    finest = int(np.diff(strands.start).max()) - 1
    pieces = TEXELS * int(np.clip(-(-finest // TEXELS), 1, _MOST))
    owner = np.repeat(np.arange(strands.count), np.diff(strands.start))
    step = np.linalg.norm(np.diff(strands.points, axis=0, prepend=strands.points[:1]), axis=1)
    step[strands.start[:-1]] = 0
    along = np.cumsum(step)
    along -= along[strands.start[:-1]][owner]
    length = along[strands.start[1:] - 1]
    # Strand k lies in [2 k, 2 k + 1], so that one search finds the place of all rings.
    key = 2.0 * owner + along / length[owner]
    key[strands.start[1:] - 1] = 2.0 * np.arange(strands.count) + 1
    wanted = 2.0 * np.arange(strands.count)[:, None] + np.linspace(0, 1, pieces + 1)
    after = np.searchsorted(key, wanted.ravel())
    last, first = np.repeat(strands.start[1:] - 1, pieces + 1), np.repeat(strands.start[:-1], pieces + 1)
    after = np.clip(after, first + 1, last)
    share = np.clip((wanted.ravel() - key[after - 1]) / (key[after] - key[after - 1]), 0, 1)
    rows = np.concatenate([strands.points, strands.radius[:, None]], 1)
    rows = rows[after - 1] + share[:, None] * (rows[after] - rows[after - 1])
    rows = rows.reshape(strands.count, pieces + 1, 4)
    return Tubes(np.ascontiguousarray(rows[..., :3]), np.ascontiguousarray(rows[..., 3]), strands.colour)


def ring_corners(tubes: Tubes) -> Float64[np.ndarray, "strands rings sides 3"]:
    """Corners of the prisms, each ring across the direction in which its strand goes there, turned with it without a twist."""
    piece = np.diff(tubes.axis, axis=1)
    length = np.linalg.norm(piece, axis=2, keepdims=True)
    piece = piece / np.where(length > 0, length, 1)
    ahead = np.concatenate([piece[:, :1], piece[:, 1:] + piece[:, :-1], piece[:, -1:]], 1)
    size = np.linalg.norm(ahead, axis=2, keepdims=True)
    ahead = np.where(size > 1e-6, ahead / np.where(size > 0, size, 1), np.concatenate([piece, piece[:, -1:]], 1))
    least = np.argmin(np.abs(ahead[:, 0]), axis=1)
    across = np.cross(ahead[:, 0], np.eye(3)[least])
    angle = 2 * np.pi * ((np.arange(len(ahead)) * _GOLDEN) % 1)[:, None] + 2 * np.pi * np.arange(SIDES) / SIDES
    found = np.empty((*tubes.axis.shape[:2], SIDES, 3))
    for ring in range(tubes.axis.shape[1]):
        along = ahead[:, ring]
        across = across - np.einsum("sd,sd->s", across, along)[:, None] * along
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        beside = np.cross(along, across)
        turned = np.cos(angle)[..., None] * across[:, None] + np.sin(angle)[..., None] * beside[:, None]
        found[:, ring] = tubes.axis[:, ring, None] + CORNER * tubes.radius[:, ring, None, None] * turned
    return found


def tube_triangles(strands: int, pieces: int) -> Int[np.ndarray, "triangles 3"]:
    """Corners of all triangles, counted over strands, rings and sides; fronts face outwards.

    Of a side's first triangle the third corner lies on the next ring, of its second all but the third.
    """
    ring = SIDES * (np.arange(strands)[:, None] * (pieces + 1) + np.arange(pieces))[..., None]
    a, b = ring + np.arange(SIDES), ring + (np.arange(SIDES) + 1) % SIDES
    c, d = a + SIDES, b + SIDES
    return np.stack([np.stack([a, b, c], -1), np.stack([d, c, b], -1)], -2).reshape(-1, 3)


def with_strands(scene: Scene | None, name: str, strands: Strands, material: Material) -> Scene:
    """A scene with strands of a material; of strands alone where there is no other."""
    tubes = resampled(strands)
    corners = ring_corners(tubes)
    outward = (corners - tubes.axis[:, :, None]) / (CORNER * tubes.radius[..., None, None])
    positions, normals = corners.reshape(-1, 3), outward.reshape(-1, 3)
    triangles = tube_triangles(len(tubes.axis), tubes.pieces).astype(np.int32)
    kind = np.zeros(len(triangles), np.int32)
    if scene is None:
        return Scene(name, positions, triangles, normals, kind, (material,), tubes=tubes)
    return replace(
        scene,
        name=name,
        positions=np.concatenate([scene.positions, positions]),
        triangles=np.concatenate([scene.triangles, triangles + np.int32(len(scene.positions))]),
        normals=np.concatenate([scene.normals, normals]),
        material=np.concatenate([scene.material, kind + np.int32(len(scene.materials))]),
        materials=(*scene.materials, material),
        uv=None if scene.uv is None else np.concatenate([scene.uv, np.zeros((len(positions), 2))]),
        colour=None if scene.colour is None else np.concatenate([scene.colour, np.ones((len(positions), 3))]),
        lightmap=None if scene.lightmap is None else np.concatenate([scene.lightmap, np.zeros((len(positions), 2))]),
        tubes=tubes,
    )


def bald(scene: Scene) -> Scene | None:
    """A scene without its strands; None where nothing is left."""
    if scene.tubes is None:
        return scene
    kept = len(scene.triangles) - scene.tubes.triangles
    if not kept:
        return None
    used = int(scene.triangles[:kept].max()) + 1
    return replace(
        scene,
        positions=scene.positions[:used],
        triangles=scene.triangles[:kept],
        normals=scene.normals[:used],
        material=scene.material[:kept],
        uv=None if scene.uv is None else scene.uv[:used],
        colour=None if scene.colour is None else scene.colour[:used],
        lightmap=None if scene.lightmap is None else scene.lightmap[:used],
        tubes=None,
        whole=None,
    )


def load_hair(path: Path, scale: float = 1.0) -> Scene:
    """A file of strands as a scene of its own; see `ddprt.scene.strands.load_strands`."""
    strands = load_strands(path, scale)
    red, green, blue = strands.colour.mean(0, dtype=np.float64).tolist()
    return with_strands(None, path.stem, strands, Material("hair", (red, green, blue), fibre=Fibre()))
