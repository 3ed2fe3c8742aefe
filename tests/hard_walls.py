"""Geometry: doubled walls, sheets, repeated and empty triangles, needles, crumbs."""

import numpy as np
from hard_bakes import (
    LAMPS,
    MIDDLE,
    alike,
    baked,
    everything,
    finite,
    from_lamp,
    furnace_range,
    moved,
    over,
    point,
    room,
    within,
    worst,
)
from hard_cases import HardCase, Outcome

from ddprt.scene.checks import checked
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import hollow, icosphere


def even(scene: Scene, albedo: float = 0.5) -> Outcome:
    """A closed room that direct light fills evenly stays even: see `white_furnace`. What faces outwards is dark."""
    data = baked(scene, MIDDLE, atlas={"resolution": 48, "padding": 1})
    low, high = furnace_range(scene)
    direct, measured, indirect = everything(data)
    outside = (data.gbuffer["position"] * data.gbuffer["geometric_normal"]).sum(1) > 0
    dark = not direct[:, outside].any() and not indirect[:, outside].any()
    direct, indirect, whole = direct[:, ~outside], indirect[:, ~outside], albedo / (1 - albedo)
    return Outcome(
        worst(within(direct, low, high), within(indirect, low * whole * (1 - 1e-3), high * whole), 0.0 if dark else np.inf),
        finite=finite(direct, measured, indirect),
    )


def split_again(every: int, *, opposed: bool = False) -> Scene:
    """The furnace with some of its triangles once more, cut at their middle, facing the same way or the other."""
    directions, outward = icosphere(2)
    inward = outward[:, ::-1]
    chosen = inward[::every]
    middle = len(directions) + np.arange(len(chosen))
    a, b, c = chosen.T
    copies = np.concatenate([np.stack(part, 1) for part in ((a, b, middle), (b, c, middle), (c, a, middle))])
    positions = np.concatenate([directions, directions[chosen].mean(1)])
    # Vertices of their own: joined to the first surface, they would be turned to its winding.
    copies = copies[:, ::-1] if opposed else copies
    apart = np.concatenate([positions, positions[copies].reshape(-1, 3)])
    fresh = len(positions) + np.arange(3 * len(copies)).reshape(-1, 3)
    used, faces = np.unique(np.concatenate([inward, fresh]), return_inverse=True)
    return checked("split", apart[used], faces.reshape(-1, 3), materials=(Material("wall", (0.5,) * 3),))


def cleaned(extra: np.ndarray, note: str) -> Outcome:
    """Triangles that are no surface are taken out, and said; what is left bakes to the same bits."""
    clean = room()
    positions = np.concatenate([clean.positions, extra.reshape(-1, 3)])
    fresh = len(clean.positions) + np.arange(len(extra) * 3).reshape(-1, 3)
    normals = np.concatenate([clean.normals, np.tile([0.0, 1.0, 0.0], (len(extra) * 3, 1))])
    faces = np.concatenate([clean.triangles, fresh])
    dirty = checked("room", positions, faces, normals=normals, materials=clean.materials)
    ratios = [alike(a, b) for a, b in zip(everything(baked(clean, LAMPS)), everything(baked(dirty, LAMPS)), strict=True)]
    return Outcome(worst(*ratios, 0.0 if any(note in line for line in dirty.notes) else np.inf))


def _slivers() -> Outcome:
    """The room's floor cut into needles two hundred times as long as wide, fanned out from one corner.

    Light at the measurement points is that of a plain room; a needle's normal is as exact as its corners.
    """
    quads = hollow(np.ones((1, 1, 1), bool), *(np.array([0.0, 1.0]),) * 3)
    flat = (quads[..., 1] == 0).all(1)
    edge = np.linspace(0, 1, 201)
    rim = np.stack([np.ones_like(edge), 0 * edge, edge], 1)
    fan = np.stack([np.zeros((200, 3)), rim[1:], rim[:-1]], 1)
    rest = np.array([[[0.0, 0, 0], [0, 0, 1], [1, 0, 1]]])
    walls = quads[~flat][:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
    triangles = np.concatenate([walls, fan, rest])
    scene = checked("needles", triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    data = baked(scene, LAMPS, atlas={"resolution": 32})
    ratios = [0.0 if abs(scene.areas.sum() - 6) < 1e-12 else np.inf]
    for light, record in zip(data.measured(range(len(LAMPS))), moved(LAMPS), strict=True):
        expected, bound = from_lamp(scene, record, data.samples.position, data.samples.normal)
        ratios.append(worst(over(light, expected, bound)))
    return Outcome(worst(*ratios), finite=finite(*everything(data)))


def _texels_of_no_area() -> Outcome:
    """Crumbs next to nothing in a corner, just large enough not to be taken out: nothing divides by their area."""
    clean, size = room(), 3e-8
    crumb = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5 + 1], [0.5 + size, 0.5, 0.5]])
    scene = checked(
        "crumbs",
        np.concatenate([clean.positions, crumb]),
        np.concatenate([clean.triangles, len(clean.positions) + np.arange(3)[None]]),
        materials=clean.materials,
    )
    data = baked(scene, [point(0.5, 0.75, 0.25), *LAMPS[1:]])
    light = everything(data)
    kept = len(scene.triangles) == len(clean.triangles) + 1
    return Outcome(0.0 if kept and (data.area > 0).all() else np.inf, finite=finite(*light, data.area))


CASES: tuple[HardCase, ...] = (
    HardCase("doubled walls", "coplanar, cut another way: rays hit either", "as the single wall", lambda: even(split_again(5))),
    HardCase(
        "sheet without thickness",
        "front and back in one plane: rays hit either",
        "as the front alone",
        lambda: even(split_again(5, opposed=True)),
    ),
    HardCase(
        "repeated triangles",
        "every other wall stands twice",
        "removed, said, equal bits",
        lambda: cleaned(room().corners[::2], "repeated triangles removed"),
    ),
    HardCase(
        "backs of triangles",
        "a sheet of two sides made of one set of corners",
        "removed, said, equal bits",
        lambda: cleaned(room().corners[::2, ::-1], "the back of another"),
    ),
    HardCase(
        "triangles of no area",
        "points and lines",
        "removed, said, equal bits",
        lambda: cleaned(
            np.array([[[0.5] * 3] * 3, [[0.1, 0.1, 0.1], [0.9, 0.9, 0.9], [0.5, 0.5, 0.5]]]), "triangles of no area removed"
        ),
    ),
    HardCase("slivers", "needles two hundred times as long as wide", "the light of a plain room", _slivers),
    HardCase("texels of no area", "a crumb of 1e-8 m²", "nothing divides by it", _texels_of_no_area),
)
