"""Scenes in code: small, exact, and each there for a reason."""

import inspect
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ddprt.catalogue import Catalogue
from ddprt.errors import UserError, nearest
from ddprt.scene.checks import checked, vertex_normals
from ddprt.scene.cornell import cornell, cornell_hole
from ddprt.scene.fog import Fog
from ddprt.scene.furball import furball
from ddprt.scene.lion import lion
from ddprt.scene.material import Cutout, Emission, Gloss, Material, Subsurface
from ddprt.scene.mesh import Scene
from ddprt.scene.motions import bending
from ddprt.scene.shapes import box, faceted, hollow, icosphere, rectangle


def furnace(*, albedo: float = 0.5, radius: float = 1.0, subdivisions: int = 4) -> Scene:
    """A closed sphere seen from inside: from a uniform source the indirect light is E * albedo / (1 - albedo), everywhere.

    Args:
      albedo: of the whole wall.
      radius: metres.
      subdivisions: 20 * 4^n triangles.
    """
    directions, outward = icosphere(subdivisions)
    material = Material("wall", (albedo,) * 3)
    return checked("furnace", radius * directions, outward[:, ::-1], normals=-directions, materials=(material,))


def plates(*, albedo: float = 0.5, size: float = 1.0, distance: float = 1.0) -> Scene:
    """Two equal squares that face each other: their form factor has a closed form (0.1998 for size = distance).

    Args:
      albedo: of both.
      size: edge, metres.
      distance: between them, metres.
    """
    half = size / 2
    quads = [rectangle((-half, -half), (half, half), at, 1, facing=facing) for at, facing in ((0.0, 1), (distance, -1))]
    return faceted("plates", np.array(quads), (Material("plate", (albedo,) * 3),))


def corridor(
    *,
    length: float = 6.0,
    height: float = 2.5,
    width: float = 3.0,
    thickness: float = 0.2,
    door_width: float = 0.9,
    door_height: float = 2.0,
    albedo: float = 0.75,
) -> Scene:
    """Two rooms joined by a door in a wall of some thickness; one far end is red, the other blue.

    A lamp in one room reaches the other by bounces alone, and colours what is behind the door. The surface is closed.

    Args:
      length: of both rooms and the wall between them, along x, metres.
      height: along y, metres.
      width: along z, metres.
      thickness: of the dividing wall in the middle, metres.
      door_width: metres, centred.
      door_height: metres from the floor.
      albedo: of all that is not a far end.
    Raises:
      UserError: the wall does not fit into the rooms, or the door not into the wall.
    """
    fits = (("thickness", thickness, length), ("door_width", door_width, width), ("door_height", door_height, height))
    for name, inner, outer in fits:
        if not 0 < inner < outer:
            raise UserError(f"corridor.{name}: got {inner:g} m, expected more than 0 and less than {outer:g} m; make it fit")
    x = np.array([0.0, (length - thickness) / 2, (length + thickness) / 2, length])
    y = np.array([0.0, door_height, height])
    z = np.array([0.0, (width - door_width) / 2, (width + door_width) / 2, width])
    free = np.ones((3, 2, 3), bool)
    free[1] = False
    free[1, 0, 1] = True
    quads = hollow(free, x, y, z)
    paint = np.where((quads[..., 0] == 0).all(axis=1), 1, np.where((quads[..., 0] == length).all(axis=1), 2, 0))
    ends = Material("red end", (0.65, 0.08, 0.06)), Material("blue end", (0.08, 0.18, 0.6))
    return faceted("corridor", quads, (Material("plaster", (albedo,) * 3), *ends), paint)


def statue(*, height: float = 1.8, ground: float = 5.0, subdivisions: int = 5) -> Scene:
    """One bumpy closed body, head on waist on base, that stands on a square: the single asset of the paper's second kind.

    A sphere displaced along its radii, hence free of self-intersections, with hollows that gather their own light.

    Args:
      height: of the body, metres.
      ground: edge of the square, metres.
      subdivisions: 20 * 4^n triangles of the body.
    """
    directions, triangles = icosphere(subdivisions)
    reach = 1.0 + 0.22 * np.cos(9.0 * directions[:, 1] - 0.6)
    for turn in range(1, 7):
        angle = 2.399963 * turn
        along = np.array([np.cos(angle), 0.45 * np.sin(1.7 * turn), np.sin(angle)])
        reach += 0.09 / turn**0.5 * np.sin((2.0 + turn) * (directions @ along) + turn)
    body = directions * reach[:, None] * [0.55, 1.0, 0.42]
    # Rounded: sines differ in their last bit from machine to machine.
    body = np.round(body * height / np.ptp(body[:, 1]), 9)
    body[:, 1] -= body[:, 1].min()
    square = rectangle((-ground / 2, -ground / 2), (ground / 2, ground / 2), 0.0, 1, facing=1)
    positions = np.concatenate([body, square])
    faces = np.concatenate([triangles, len(body) + np.array([[0, 1, 2], [0, 2, 3]])])
    return checked(
        "statue",
        positions,
        faces,
        normals=vertex_normals(positions, faces),
        material=np.repeat([0, 1], [len(triangles), 2]),
        materials=(Material("stone", (0.66, 0.58, 0.48)), Material("ground", (0.45, 0.47, 0.5))),
    )


def statue_marble(
    *,
    height: float = 0.3,
    ground: float = 0.9,
    subdivisions: int = 5,
    mean_free_path: float = 0.002,
    anisotropy: float = 0.0,
    index: float = 1.3,
) -> Scene:
    """The statue as a figurine of a marble that light passes: lit from behind, its thin parts glow.

    Args:
      height: of the body, metres.
      ground: edge of the square, metres.
      subdivisions: 20 * 4^n triangles of the body.
      mean_free_path: of green light in it, metres; red goes a fifth further, blue a fifth less.
      anisotropy: mean cosine of the angle of scattering.
      index: of refraction.
    Raises:
      UserError: a medium that cannot be.
    """
    of_stone = statue(height=height, ground=ground, subdivisions=subdivisions)
    paths = (1.2 * mean_free_path, mean_free_path, 0.8 * mean_free_path)
    marble = Material("marble", (1.0, 1.0, 1.0), subsurface=Subsurface((0.9995, 0.999, 0.997), paths, anisotropy, index))
    return checked(
        "statue-marble",
        of_stone.positions,
        of_stone.triangles,
        normals=of_stone.normals,
        material=of_stone.material,
        materials=(marble, of_stone.materials[1]),
    )


def foggy_room(*, mean_free_path: float = 0.5, albedo: float = 0.95, anisotropy: float = 0.3, brightness: float = 1.0) -> Scene:
    """The Cornell box in fog, which light scatters in before it reaches a wall, and beams of spots show in.

    Args:
      mean_free_path: of green light in it, metres; red goes a fifth further, blue a fifth less.
      albedo: of single scattering.
      anisotropy: mean cosine of the angle of scattering.
      brightness: of the walls, as a share of what was published; 0 paints them black.
    Raises:
      UserError: fog that cannot be, or walls brighter than that.
    """
    if brightness > 1:
        raise UserError(f"foggy-room.brightness: got {brightness:g}, expected 0 to 1; lower it")
    paths = (1.2 * mean_free_path, mean_free_path, 0.8 * mean_free_path)
    fog = Fog.of({"mean_free_path": paths, "albedo": albedo, "anisotropy": anisotropy}, "foggy-room")
    room = cornell()
    room = room.made_of(lambda wall: _darker(wall, brightness)) if brightness < 1 else room
    return replace(room, name="foggy-room", fog=fog)


def _darker(material: Material, share: float) -> Material:
    red, green, blue = (share * own for own in material.albedo)
    return replace(material, albedo=(red, green, blue))


def convex(*, albedo: float = 0.8, size: float = 1.0) -> Scene:
    """A cube on its own: nothing faces it, so the indirect light is exactly nothing.

    Args:
      albedo: of all faces.
      size: edge, metres.
    """
    half = np.full(3, size / 2)
    return faceted("convex", box(-half, half), (Material("cube", (albedo,) * 3),))


def faults(*, albedo: float = 0.7, thickness: float = 0.003, gap: float = 0.004) -> Scene:
    """Two rooms made to go wrong on a lightmap, and nothing in them lies along its texels.

    A wall thinner than a texel divides a closed room in two and reaches into all its sides, so that light in one half leaves
    the other exactly dark. In each half a box stands on the floor, one is sunk into it and one hovers a little above it.

    Args:
      albedo: of everything.
      thickness: of the dividing wall, metres.
      gap: below the hovering boxes, metres.
    Raises:
      UserError: a wall without thickness.
    """
    if thickness <= 0:
        raise UserError(f"faults.thickness: got {thickness:g} m, expected more than 0; give the wall two sides")
    x, y, z = np.array([0.0, 2.0]), np.array([0.0, 1.0]), np.array([0.0, 1.2])
    quads = [hollow(np.ones((1, 1, 1), bool), x, y, z), _turned((1.0, 0.5, 0.6), (thickness, 1.04, 1.36), 7.0)]
    for side in (0.0, 1.03):
        quads += [
            _turned((0.35 + side, 0.1, 0.3), (0.24, 0.2, 0.2), 23.0),
            _turned((0.62 + side, 0.0, 0.62), (0.22, 0.3, 0.22), 37.0),
            _turned((0.3 + side, 0.075 + gap, 0.85), (0.25, 0.15, 0.18), 61.0),
        ]
    return faceted("faults", np.concatenate(quads), (Material("grey", (albedo,) * 3),))


def glossy_room(*, roughness: float = 0.25, metallic: float = 1.0, around: int = 24) -> Scene:
    """The Cornell box with a golden vase in place of its short block: one glossy thing in a diffuse room.

    Args:
      roughness: of the vase.
      metallic: of the vase; 0 makes a glazed yellow pot.
      around: facets of the vase in a ring, at least 3.
    Raises:
      UserError: too few facets.
    """
    if around < 3:
        raise UserError(f"glossy-room.around: got {around}, expected at least 3; a vase is round")
    room = cornell()
    kept = np.r_[0:8, 18:30]  # the short block is five quads after the four walls
    used, walls = np.unique(room.triangles[kept], return_inverse=True)
    height = np.linspace(0.0, 1.0, 13)
    reach = 0.075 * (0.62 + 0.42 * np.sin(2.3 * np.pi * height**0.8 - 0.35) * (1 - 0.45 * height))
    angle = 2 * np.pi * np.arange(around) / around
    rim = np.stack([np.cos(angle), np.zeros(around), np.sin(angle)], 1)
    rings = reach[:, None, None] * rim + (0.24 * height[:, None] * [0.0, 1.0, 0.0])[:, None]
    vase = np.append(rings.reshape(-1, 3), [[0.0, 0.24, 0.0]], axis=0) + np.array([0.186, 0.0, 0.169])
    low = (around * np.arange(12)[:, None] + np.arange(around)).ravel()
    after = (around * np.arange(12)[:, None] + (np.arange(around) + 1) % around).ravel()
    top, last = len(vase) - 1, 12 * around + np.arange(around)
    lid = np.stack([last, np.full(around, top), np.roll(last, -1)], 1)
    faces = np.concatenate([np.stack([low, low + around, after], 1), np.stack([after, low + around, after + around], 1), lid])
    material = Material("gilt", (0.9, 0.65, 0.3), gloss=Gloss(roughness, metallic))
    positions = np.concatenate([room.positions[used], np.round(vase, 9)])  # sines differ in their last bit among machines
    triangles = np.concatenate([walls.reshape(-1, 3), faces + len(used)])
    return checked(
        "glossy-room",
        positions,
        triangles,
        normals=vertex_normals(positions, triangles),
        material=np.concatenate([room.material[kept], np.full(len(faces), len(room.materials))]),
        materials=(*room.materials, material),
    )


def neon(*, radiance: float = 40.0, albedo: float = 0.7) -> Scene:
    """A small room with a glowing sign: LIT in bars before the back wall, two letters pink and one blue, and a table.

    The sign lights the room whatever lamps there are besides, from surfaces that are narrow and near a wall.

    Args:
      radiance: of the brighter letters' strongest channel, W/(m² sr).
      albedo: of walls, floor and ceiling.
    """
    room = hollow(np.ones((1, 1, 1), bool), np.array([-1.5, 1.5]), np.array([0.0, 2.4]), np.array([0.0, 3.0]))
    bars = [
        (-0.65, 1.2, -0.6, 1.9),
        (-0.59, 1.2, -0.3, 1.25),
        (-0.05, 1.2, 0.0, 1.9),
        (0.3, 1.85, 0.7, 1.9),
        (0.475, 1.2, 0.525, 1.84),
    ]
    sign = [box(np.array([left, low, 0.05]), np.array([right, high, 0.1])) for left, low, right, high in bars]
    table = box(np.array([-0.7, 0.68, 1.1]), np.array([0.7, 0.75, 1.8]))
    paint = np.repeat([0, 1, 2, 1, 3], [6, 12, 6, 12, 6])
    glass, grey = (0.1,) * 3, (albedo,) * 3
    tubes = [
        Material(f"{name} tube", glass, emission=Emission((radiance * red, radiance * green, radiance * blue)))
        for name, (red, green, blue) in (("pink", (1.0, 0.12, 0.35)), ("blue", (0.08, 0.4, 0.9)))
    ]
    return faceted(
        "neon",
        np.concatenate([room, *sign, table]),
        (Material("plaster", grey), *tubes, Material("wood", (0.5, 0.3, 0.15))),
        paint,
    )


def _turned(centre: tuple[float, float, float], size: tuple[float, float, float], degrees: float) -> np.ndarray:
    """A closed box seen from outside, turned about the vertical."""
    half, angle = np.array(size) / 2, math.radians(degrees)
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return np.round(box(-half, half) @ turn.T + centre, 9)  # sines differ in their last bit from machine to machine


def leaves(*, albedo: float = 0.6, cards: int = 5) -> Scene:
    """A closed room of 2 m with cards that leaves are cut out of: light passes between them, and both their sides reflect.

    Args:
      albedo: of the walls.
      cards: how many, side by side at several heights; 12 at most.
    Raises:
      UserError: more cards than there is room for.
    """
    if cards > 12:
        raise UserError(f"leaves.cards: got {cards}, expected 12 at most; take away some")
    room = hollow(np.ones((1, 1, 1), bool), *(np.array([0.0, 2.0]),) * 3)
    quads, spots = [*room], [(0.55, 0.8, 0.5), (1.4, 1.1, 0.6), (1.0, 0.6, 1.1), (0.5, 1.3, 1.4), (1.5, 0.75, 1.5)]
    spots += [(0.3 + 0.45 * (k % 4), 1.65, 0.4 + 0.6 * (k // 4)) for k in range(7)]
    for index, spot in enumerate(spots[:cards]):
        turn, tilt = 1.1 * index, 0.35 + 0.25 * (index % 3)
        along = np.array([math.cos(turn), 0.0, math.sin(turn)])
        across = np.array([-math.sin(turn) * math.cos(tilt), math.sin(tilt), math.cos(turn) * math.cos(tilt)])
        size = 0.42 if index < 5 else 0.18
        quads.append(np.array(spot) + size * np.array([-along - across, along - across, along + across, across - along]))
    positions = np.round(np.concatenate(quads), 9)  # sines differ in their last bit from machine to machine
    triangles = (4 * np.arange(len(quads))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    return checked(
        "leaves",
        positions,
        triangles,
        normals=vertex_normals(positions, triangles),
        material=np.repeat([0, 1], [2 * len(room), 2 * cards]),
        materials=(
            Material("wall", (albedo,) * 3),
            Material("leaf", (0.25, 0.5, 0.12), two_sided=True, cutout=Cutout(_foliage(96))),
        ),
        uv=np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (len(quads), 1)),
    )


def _foliage(size: int) -> np.ndarray:
    """Opacity of a twig with six leaves, its rims soft over two pixels."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    inside = 0.012 - np.abs(x - 0.5) + 0 * y  # the twig: how far inside a point lies
    for index in range(6):
        side = 1 if index % 2 else -1
        angle, reach = side * (0.75 + 0.1 * index), 0.21
        middle_x, middle_y = 0.5 + side * reach * math.sin(0.95), 0.8 - 0.12 * index
        along = (x - middle_x) * math.sin(angle) - (y - middle_y) * math.cos(angle)
        across = (x - middle_x) * math.cos(angle) + (y - middle_y) * math.sin(angle)
        inside = np.maximum(inside, 0.085 * (1 - (along / reach) ** 2) - np.abs(across))
    return np.clip(0.5 + 0.5 * size * inside, 0, 1).round(4).astype(np.float32)


SCENES: Catalogue[Callable[..., Scene]] = Catalogue(
    "scene",
    {
        "cornell": cornell,
        "cornell-hole": cornell_hole,
        "furnace": furnace,
        "plates": plates,
        "corridor": corridor,
        "statue": statue,
        "statue-marble": statue_marble,
        "convex": convex,
        "faults": faults,
        "glossy-room": glossy_room,
        "leaves": leaves,
        "neon": neon,
        "lion": lion,
        "furball": furball,
        "foggy-room": foggy_room,
        "bending": bending,
    },
)


def build(name: str, **parameters: float | int) -> Scene:
    """A scene of the library by name.

    Args:
      name: key of `SCENES`.
      parameters: keyword arguments of its builder; what its signature calls an int must be a whole number (4.0 will do).
    Raises:
      UserError: no such scene or parameter, a number that is negative, not finite or not whole.
    """
    builder = SCENES[name]
    known = inspect.signature(builder).parameters
    settings: dict[str, float] = {}
    for key, value in parameters.items():
        if key not in known:
            listed = f"known: {', '.join(known)}" if known else "it takes none"
            raise UserError(f'scene "{name}" has no parameter "{key}"{nearest(key, known)}; {listed}')
        whole = known[key].annotation is int
        if not isinstance(value, int | float) or not math.isfinite(value) or value < 0 or (whole and value != int(value)):
            raise UserError(
                f"{name}.{key}: got {value!r}, expected {'a whole' if whole else 'a finite'} number, 0 or more; correct it"
            )
        settings[key] = int(value) if whole else float(value)
    return builder(**settings)
