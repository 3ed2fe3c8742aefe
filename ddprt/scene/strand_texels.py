"""Strands on the lightmap: each has its ten texels in a row, by arc length, as many strands in a row as there is room for.

Nothing is unwrapped. Rows of strands follow below the square that the rest of the scene is unwrapped into; the strip to the
right of that square stays empty. A texel is a tenth of its strand, all about it: its area is the fibre's side area.

Strands lie on the lightmap as they are numbered, which says little about where they stand. So they are traced in another order,
along a Z-curve through their middles: shadow rays then find what they meet in the cache (docs/effects.md, Hair).
"""

from dataclasses import replace

import numpy as np

from ddprt.axes import Float64, Int
from ddprt.errors import UserError
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import SIDES, Scene, Tubes
from ddprt.scene.tubes import TEXELS, ring_corners, tube_triangles


def square_beside(scene: Scene, resolution: int) -> int:
    """Side of the square that is left for all that is no strand, in texels.

    Raises:
      UserError: there is no room for the strands, or for anything beside them.
    """
    assert scene.tubes is not None
    strands = len(scene.tubes.axis)
    others = len(scene.triangles) > scene.tubes.triangles
    rows = -(-strands // max(resolution // TEXELS, 1))
    if resolution < TEXELS or rows + others > resolution:
        least = int(np.ceil(np.sqrt(TEXELS * strands)))
        while -(-strands // (least // TEXELS)) + others > least:
            least += 1
        raise UserError(
            f'atlas.resolution: got {resolution}, but the {strands} strands of "{scene.name}" take {TEXELS} texels each, '
            f"expected at least {least}{' and room for the rest of the scene' if others else ''}; raise atlas.resolution"
        )
    return resolution - rows


def with_strand_texels(atlas: Atlas | None, scene: Scene, resolution: int, *, simulated: bool) -> Atlas:
    """The atlas of a scene with strands.

    Args:
      atlas: of what is no strand, `square_beside` texels a side; None where there is nothing else.
      scene: all of it.
      resolution: texels per side.
      simulated: the strands scatter as fibres: their texels keep what leaves them, so their albedo is 1.
    """
    tubes = scene.tubes
    assert tubes is not None
    strands = len(tubes.axis)
    number = np.arange(strands * TEXELS)
    strand, tenth = np.divmod(number, TEXELS)
    across = resolution // TEXELS
    row, column = square_beside(scene, resolution) + strand // across, TEXELS * (strand % across) + tenth
    texel = row * resolution + column
    own = _own(scene, tubes, texel, column[::TEXELS], row[::TEXELS], resolution)
    own["albedo"] = np.tile(np.ones(3) if simulated else np.array(scene.materials[scene.material[-1]].albedo), (len(number), 1))
    own["chart"] = strand.astype(np.int32)
    own["order"] = number.reshape(strands, TEXELS)[along_curve(tubes.axis.mean(1))].ravel()
    slot = np.full((resolution, resolution), -1, np.int32)
    if atlas is None:
        slot.ravel()[texel] = number
        return Atlas(resolution=resolution, centre=scene.centre, slot=slot, **own)
    side, count = atlas.resolution, atlas.count
    slot[:side, :side] = atlas.slot
    slot.ravel()[texel] = count + number
    there = np.divmod(atlas.texel, side)
    own["chart"] += int(atlas.chart.max()) + 1
    own["piece_texel"] = own["piece_texel"] + count
    own["order"] = own["order"] + count
    moved = (atlas.piece_corners + (atlas.centre - scene.centre)).astype(np.float32)
    before = {
        **{name: getattr(atlas, name) for name in own},
        "uv": atlas.uv * (side / resolution),
        "texel": there[0] * resolution + there[1],
        "piece_corners": moved,
        "order": np.arange(count),
    }
    joined = {name: np.concatenate([before[name], own[name]]).astype(before[name].dtype) for name in own}
    return replace(atlas, resolution=resolution, centre=scene.centre, slot=slot, **joined)


def along_curve(points: Float64[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Order of points along a Z-curve through 1024 cells a side (Morton 1966)."""
    cell = ((points - points.min(0)) * (1023 / max(float(np.ptp(points, axis=0).max()), 1e-300))).astype(np.int64)
    bits = (((cell[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    return np.argsort(sum(bits, np.zeros(len(points), np.int64)), kind="stable")


def _own(
    scene: Scene, tubes: Tubes, texel: np.ndarray, column: np.ndarray, row: np.ndarray, resolution: int
) -> dict[str, np.ndarray]:
    """What an `Atlas` keeps of strands: their texels are counted from 0, their triangles as in the scene."""
    strands, pieces = len(tubes.axis), tubes.pieces
    corners = ring_corners(tubes)
    faces = tube_triangles(strands, pieces)
    of_triangle = np.arange(len(faces)) // (2 * SIDES * pieces // TEXELS)
    place = (corners.reshape(-1, 3)[faces] - scene.centre).astype(np.float32)
    area = scene.areas[-len(faces) :]
    middle = pieces // TEXELS * np.arange(TEXELS) + pieces // (2 * TEXELS)
    low, high = middle, middle + (pieces // TEXELS) % 2  # of an even number of pieces the middle is a ring
    point = (corners[:, low, 0] + corners[:, high, 0]) / 2
    axis = (tubes.axis[:, low] + tubes.axis[:, high]) / 2
    normal = _unit(point - axis)
    return {
        "uv": _uv(tubes, column, row, resolution),
        "texel": texel,
        "position": point.reshape(-1, 3),
        "normal": normal.reshape(-1, 3),
        "geometric_normal": normal.reshape(-1, 3).copy(),
        "area": np.bincount(of_triangle, area),
        "coverage": np.ones(len(texel)),
        "piece_texel": of_triangle,
        "piece_area": area.copy(),
        "piece_corners": place,
        "piece_triangle": np.arange(len(scene.triangles) - len(faces), len(scene.triangles), dtype=np.int32),
    }


def _uv(tubes: Tubes, column: np.ndarray, row: np.ndarray, resolution: int) -> Float64[np.ndarray, "triangles 3 2"]:
    """All about a strand is at the height of its texels' middles."""
    strands, pieces = len(tubes.axis), tubes.pieces
    along = np.linspace(0, TEXELS, pieces + 1)
    x = np.broadcast_to((column[:, None] + along)[..., None], (strands, pieces + 1, SIDES))
    y = np.broadcast_to((row + 0.5)[:, None, None], x.shape)
    return np.stack([x, y], -1).reshape(-1, 2)[tube_triangles(strands, pieces)] / resolution


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-300)
