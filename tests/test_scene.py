"""The library's scenes and the checks that every scene passes: closed forms, orientation, bad inputs, winding."""

import re

import numpy as np
import pytest

from ddprt.errors import UserError
from ddprt.scene.checks import checked, vertex_normals
from ddprt.scene.cornell import colour_matching, linear_rgb, spectra
from ddprt.scene.library import SCENES, build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, hollow, icosphere

SMALL = {"furnace": {"subdivisions": 2}, "statue": {"subdivisions": 3}, "furball": {"strands": 60}}
FREE = {
    "cornell": [(0.05, 0.3, 0.1), (0.28, 0.5, 0.3), (0.5, 0.2, 0.5), (0.25, 0.2, 0.05)],
    "cornell-hole": [(0.05, 0.3, 0.1), (0.28, 0.5, 0.3)],
    "furnace": [(0, 0, 0), (0.5, 0.3, -0.4)],
    "plates": [(0, 0.5, 0), (0.2, 0.1, 0.3)],
    "corridor": [(1, 1, 1), (5, 2, 2), (3, 1, 1.5)],
    "statue": [(2, 1, 0), (-1, 0.1, 2), (0, 3, 0)],
    "statue-marble": [(0.35, 0.17, 0), (-0.17, 0.02, 0.35), (0, 0.5, 0)],
    "convex": [(0.6, 0, 0), (0.7, 0.8, 0.9), (0, -3, 0.1)],
    "neon": [(0.0, 1.0, 2.5), (-0.3, 1.5, 0.3), (1.2, 0.2, 1.0)],
    "faults": [(0.2, 0.5, 0.9), (1.7, 0.8, 0.2)],
    "glossy-room": [(0.05, 0.3, 0.1), (0.28, 0.5, 0.3), (0.19, 0.4, 0.17)],
    "lion": [(0.5, 0.4, 0), (-0.45, 0.3, 0.3), (0, 0.95, 0.2)],
    "foggy-room": [(0.05, 0.3, 0.1), (0.28, 0.5, 0.3)],
    "furball": [(0.1, 0.0, 0.0), (0.0, 0.08, 0.05), (-0.07, -0.03, 0.08)],
    "bending": [(0.5, 0.4, 0), (-0.4, 0.3, 0.3), (0, 0.05, 0.6)],
    "leaves": [(1.0, 1.8, 1.0), (0.2, 0.1, 0.2), (1.9, 1.2, 1.1)],
}


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {name: build(name, **SMALL.get(name, {})) for name in SCENES}


def solid_angle(scene: Scene, point: np.ndarray) -> float:
    """Sum of signed solid angles over 4 pi (Van Oosterom and Strackee): 1 inside a body, -1 inside a room, 0 outside."""
    a, b, c = np.moveaxis(scene.corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    dot = lambda u, v: (u * v).sum(1)  # noqa: E731
    top = dot(a, np.cross(b, c))
    return float(np.arctan2(top, la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb).sum() / (2 * np.pi))


def volume(scene: Scene) -> float:
    return float(np.linalg.det(scene.corners).sum() / 6)


def edges(scene: Scene) -> np.ndarray:
    """How often each directed edge, by place, is run through along minus against, and how many triangles it has."""
    _, place = np.unique(np.round(scene.positions, 9), axis=0, return_inverse=True)
    corners = place.reshape(-1)[scene.triangles]
    run = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge = np.unique(np.sort(run, axis=1), axis=0, return_inverse=True)
    return np.stack([np.bincount(edge, np.where(run[:, 0] < run[:, 1], 1, -1)), np.bincount(edge)], axis=1)


def front_hits(scene: Scene, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """For each ray that hits: whether its nearest triangle shows its front (Moeller and Trumbore)."""
    a, b, c = np.moveaxis(scene.corners, 1, 0)
    found = []
    for direction in directions:
        p = np.cross(direction, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / ((b - a) * p).sum(1)
            u = ((origin - a) * p).sum(1) * scale
            q = np.cross(origin - a, b - a)
            v, t = (q @ direction) * scale, ((c - a) * q).sum(1) * scale
            t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9), t, np.inf)
        if np.isfinite(t.min()):
            nearest = t <= t.min() + 1e-9  # both sides of a sheet
            found.append(bool((scene.geometric_normals[nearest] @ direction < 0).any()))
    return np.array(found)


@pytest.mark.parametrize("name", list(SCENES))
def test_fronts_face_the_free_space(scenes: dict[str, Scene], name: str) -> None:
    directions = np.random.default_rng(1).normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = np.concatenate([front_hits(scenes[name], np.array(point, float), directions) for point in FREE[name]])
    assert len(hits) > 20
    assert hits.all()


@pytest.mark.parametrize("name", list(SCENES))
def test_library_scenes_need_no_repair(scenes: dict[str, Scene], name: str) -> None:
    scene = scenes[name]
    assert scene.notes == (("10 triangles of two-sided materials have a back of their own",) if name == "leaves" else ())
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1, atol=1e-12)
    surface = slice(0, len(scene.triangles) - (scene.tubes.triangles if scene.tubes else 0))  # strands are round, prisms not
    facing = np.einsum("tcd,td->tc", scene.normals[scene.triangles], scene.geometric_normals)
    assert (facing[surface] > 0.5).all()
    assert (facing > 0).all()
    assert scene.digest == build(name, **SMALL.get(name, {})).digest


@pytest.mark.parametrize(("name", "expected"), [("furnace", -1), ("corridor", -1), ("statue", 0), ("convex", 0)])
def test_solid_angle_from_the_free_space(scenes: dict[str, Scene], name: str, expected: int) -> None:
    point = np.array(FREE[name][0], float)
    scene = scenes[name]
    if name == "statue":
        scene = Scene(name, scene.positions, scene.triangles[:-2], scene.normals, scene.material[:-2], scene.materials)
    assert solid_angle(scene, point) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", ["furnace", "corridor", "convex"])
def test_closed_scenes_have_no_open_edge(scenes: dict[str, Scene], name: str) -> None:
    balance, count = edges(scenes[name]).T
    assert (balance == 0).all()
    assert (count == 2).all()


def test_furnace_is_a_sphere_seen_from_inside() -> None:
    scene = build("furnace", radius=2, subdivisions=5)
    assert len(scene.triangles) == 20 * 4**5
    assert scene.areas.sum() == pytest.approx(4 * np.pi * 4, rel=1e-3)
    assert volume(scene) == pytest.approx(-4 / 3 * np.pi * 8, rel=2e-3)
    np.testing.assert_allclose(scene.normals, -scene.positions / 2, atol=1e-12)


def test_icosphere_is_even_and_welded() -> None:
    points, triangles = icosphere(3)
    assert len(points) == 10 * 4**3 + 2
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)
    corners = points[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.max() / areas.min() < 2
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(4 / 3 * np.pi, rel=0.02)


def test_plates_corridor_and_cube_have_their_measures(scenes: dict[str, Scene]) -> None:
    plates = build("plates", size=2, distance=0.5)
    assert plates.areas.sum() == pytest.approx(8)
    np.testing.assert_allclose(plates.bounds, [[-1, 0, -1], [1, 0.5, 1]])
    np.testing.assert_allclose(plates.geometric_normals[:, 1], [1, 1, -1, -1])
    corridor = scenes["corridor"]
    wall, door = 0.2 * 2.5 * 3, 0.2 * 0.9 * 2
    assert volume(corridor) == pytest.approx(-(6 * 2.5 * 3 - wall + door))
    for material, x in ((1, 0.0), (2, 6.0)):
        assert corridor.areas[corridor.material == material].sum() == pytest.approx(7.5)
        assert (corridor.corners[corridor.material == material][..., 0] == x).all()
    assert volume(scenes["convex"]) == pytest.approx(1)


def test_statue_is_closed_hollowed_and_stands_on_the_ground() -> None:
    from scipy.spatial import ConvexHull

    scene = build("statue")
    body = Scene("body", scene.positions, scene.triangles[:-2], scene.normals, scene.material[:-2], scene.materials)
    balance, count = edges(body).T
    assert (balance == 0).all()
    assert (count == 2).all()
    assert 15_000 < len(body.triangles) < 25_000
    assert 0 < volume(body) < 0.9 * ConvexHull(body.positions[np.unique(body.triangles)]).volume
    assert body.bounds[0, 1] == 0
    assert body.bounds[1, 1] == pytest.approx(1.8)
    # A graph over the sphere around the middle cannot cut itself; that point lies where the displacement starts.
    centre = scene.positions[scene.triangles[:-2]].reshape(-1, 3).mean(0)
    assert solid_angle(body, centre) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(scene.geometric_normals[-2:], [[0, 1, 0]] * 2, atol=1e-12)


def test_hollow_of_two_cells_shares_no_inner_wall() -> None:
    quads = hollow(np.ones((2, 1, 1), bool), np.array([0.0, 1, 3]), np.array([0.0, 1]), np.array([0.0, 1]))
    assert len(quads) == 10
    assert len(box(np.zeros(3), np.ones(3))) == 6


def test_cornell_is_as_published(scenes: dict[str, Scene]) -> None:
    scene = scenes["cornell"]
    assert len(scene.triangles) == 30
    np.testing.assert_allclose(scene.bounds, [[0, 0, 0], [0.556, 0.5488, 0.5592]])
    names = [scene.materials[index].name for index in scene.material]
    assert {name: names.count(name) for name in set(names)} == {"white": 26, "red": 2, "green": 2}
    assert (scene.corners[scene.material == 1][..., 0] == 0).all()
    assert (scene.corners[scene.material == 2][..., 0] > 0.54).all()
    middles = {"short": np.array([0.1855, 0.08, 0.169]), "tall": np.array([0.3685, 0.16, 0.351])}
    for block, middle in middles.items():
        faces = slice(8, 18) if block == "short" else slice(18, 28)
        outward = np.einsum("td,td->t", scene.corners.mean(1)[faces] - middle, scene.geometric_normals[faces])
        assert (outward > 0.05).all(), block
    walls = scene.geometric_normals[:8:2].round(1) + 0.0
    np.testing.assert_array_equal(walls, [[0, 1, 0], [0, -1, 0], [0, 0, -1], [-1, 0, 0]])


def test_cornell_hole_opens_the_green_wall(scenes: dict[str, Scene]) -> None:
    closed, holed = scenes["cornell"], scenes["cornell-hole"]
    assert closed.areas.sum() - holed.areas.sum() == pytest.approx(0.25 * 0.2)
    out = np.array([[-1.0, 0.0, 0.0]])
    assert front_hits(holed, np.array([0.05, 0.3, 0.28]), out).size == 0
    assert front_hits(holed, np.array([0.05, 0.3, 0.45]), out).all()


def test_cornell_albedo() -> None:
    measured = spectra()
    assert {name: (row[0], row[25], row[-1]) for name, row in measured.items()} == {
        "white": (0.343, 0.747, 0.737),
        "green": (0.092, 0.285, 0.159),
        "red": (0.040, 0.058, 0.642),
    }
    albedo = {entry.name: entry.albedo for entry in build("cornell").materials}
    # From the CIE's own tables of the observer and of D65 instead of the fit (computed once with Mitsuba's copies).
    np.testing.assert_allclose(albedo["white"], (0.7384, 0.7358, 0.7397), atol=1e-3)
    np.testing.assert_allclose(albedo["green"], (0.0685, 0.3981, 0.0866), atol=1e-3)
    np.testing.assert_allclose(albedo["red"], (0.4935, 0.0491, 0.0512), atol=4e-3)
    np.testing.assert_array_equal(linear_rgb(np.array([np.ones(76), np.full(76, 0.25)])), [[1, 1, 1], [0.25, 0.25, 0.25]])


def test_colour_matching_peaks() -> None:
    wavelength = np.arange(400.0, 701.0)
    x, y, z = colour_matching(wavelength)
    assert [wavelength[curve.argmax()] for curve in (x, y, z)] == pytest.approx([599, 556, 446], abs=4)
    assert [x.max(), y.max(), z.max()] == pytest.approx([1.062, 1.0, 1.782], abs=0.02)


@pytest.mark.parametrize(
    ("name", "parameters", "says"),
    [
        ("furnance", {}, 'did you mean "furnace"'),
        ("furnace", {"albdo": 0.5}, "known: albedo, radius, subdivisions"),
        ("cornell", {"albedo": 0.5}, "it takes none"),
        ("furnace", {"subdivisions": 2.5}, "whole number"),
        ("furnace", {"subdivisions": 9}, "0 to 8"),
        ("furnace", {"albedo": 1.5}, 'material "wall"'),
        ("furnace", {"radius": float("nan")}, "finite number"),
        ("furnace", {"radius": -1}, "0 or more"),
        ("furnace", {"radius": 0}, "no area"),
        ("plates", {"size": 0}, "no area"),
        ("corridor", {"door_height": 3}, "corridor.door_height"),
        ("cornell-hole", {"y_low": 0.5}, "y_low"),
    ],
)
def test_bad_parameters(name: str, parameters: dict[str, float], says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        build(name, **parameters)
    assert "\n" not in str(caught.value)


def test_whole_numbers_may_come_as_floats() -> None:
    assert build("furnace", subdivisions=1.0).digest == build("furnace", subdivisions=1).digest


SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])
PLAIN = (Material("a", (0.5, 0.5, 0.5)),)
PICTURE = Material("a", (0.5, 0.5, 0.5), np.ones((2, 2, 3)))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"triangles": TWO[:0]}, "got no triangles"),
        ({"triangles": TWO + 2}, "corner index 4 .*out of range.* 0 to 3"),
        ({"triangles": TWO - 1}, "corner index -1"),
        ({"triangles": TWO.astype(float)}, "type float64, expected integers"),
        ({"triangles": TWO[:, :2]}, r"triangles of shape \(2, 2\)"),
        ({"positions": SQUARE[:, :2]}, r"positions of shape \(4, 2\)"),
        (
            {"positions": np.where(np.arange(4)[:, None] >= 2, np.nan, SQUARE)},
            "2 vertices whose position is not finite.* index 2",
        ),
        (
            {"positions": SQUARE * 1e200},
            "3 vertices whose position is too large, .*expected numbers below 1e.15; correct the unit",
        ),
        ({"positions": SQUARE * [1, 0, 0]}, "only triangles of no area"),
        ({"positions": SQUARE * 1e-200}, "only triangles of no area"),
        ({"materials": (Material("paint", (0.5, np.nan, 0.5)),)}, 'material "paint"'),
        ({"materials": (Material("paint", (0.5, 0.5, 1.2)),)}, 'material "paint"'),
        ({"materials": (Material("paint", (-0.1, 0.5, 0.5)),)}, 'material "paint"'),
        ({"materials": ()}, "material index 0"),
        ({"material": np.array([0, 1])}, "material index 1"),
        ({"material": np.array([0])}, "materials of shape"),
        ({"materials": (PICTURE,)}, "expected texture coordinates too"),
        ({"materials": (PICTURE,), "uv": np.full((4, 2), np.inf)}, "texture coordinate is not finite"),
        ({"materials": (PICTURE,), "uv": np.zeros((3, 2))}, r"uv of shape \(3, 2\), expected \(4, 2\)"),
        ({"materials": (Material("a", (1.0, 1.0, 1.0), np.full((2, 2, 3), 1.5)),), "uv": np.zeros((4, 2))}, "values 0 to 1"),
        ({"normals": np.zeros((3, 3))}, "normals of shape"),
    ],
)
def test_what_cannot_be_mended_is_refused(arguments: dict, says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        checked("bad", **{"positions": SQUARE, "triangles": TWO, "materials": PLAIN, **arguments})
    assert str(caught.value).startswith("bad: got")
    assert "\n" not in str(caught.value)


UP = np.array([[0.0, 0, 1]] * 4)
LOW, LOST = np.vstack([SQUARE, [0.5, 1e-10, 0]]), np.vstack([SQUARE, [[np.nan] * 3]])


@pytest.mark.parametrize(
    ("arguments", "notes", "count"),
    [
        ({}, [], 2),
        ({"triangles": np.array([[0, 1, 2], [0, 1, 1], [0, 2, 3]])}, ["1 triangles of no area"], 2),
        (
            {"triangles": np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4]]), "positions": LOW, "normals": UP[[0] * 5]},
            ["1 triangles of no area", "1 vertices"],
            2,
        ),
        ({"triangles": np.array([[0, 1, 2], [0, 2, 3], [1, 2, 0]])}, ["1 repeated triangles removed$"], 2),
        (
            {"triangles": np.array([[0, 1, 2], [0, 2, 3], [3, 2, 0], [1, 0, 2]])},
            [r"2 repeated triangles removed, 2 of them the back of another: the side facing \(0, 0, 1\) is lit; give"],
            2,
        ),
        (
            {"triangles": np.array([[0, 1, 2], [2, 0, 3], [3, 2, 0]])},
            ["1 repeated triangles removed$", "1 triangles turned"],
            2,
        ),
        ({"normals": None}, ["normals made from the faces"], 2),
        ({"normals": np.array([[0, 0, 0], [0, 0, np.nan], [0, 0, np.inf], [0, 0, 7]])}, ["3 missing shading normals"], 2),
        ({"normals": -UP}, ["4 shading normals point behind"], 2),
        ({"triangles": np.array([[0, 1, 2], [0, 3, 2]])}, ["1 triangles turned"], 2),
        ({"positions": np.vstack([SQUARE, SQUARE]), "normals": np.vstack([UP, UP])}, ["4 vertices of no triangle"], 2),
        (
            {"positions": LOST, "normals": UP[[0] * 5]},
            ["1 vertices of no triangle"],
            2,
        ),
    ],
)
def test_what_can_be_mended_is_noted(arguments: dict, notes: list[str], count: int) -> None:
    scene = checked("mended", **{"positions": SQUARE, "triangles": TWO, "normals": UP, **arguments})
    assert len(scene.notes) == len(notes), scene.notes
    assert all(re.search(pattern, note) for pattern, note in zip(notes, scene.notes, strict=True)), scene.notes
    assert len(scene.triangles) == count
    assert len(scene.positions) == 4
    np.testing.assert_allclose(scene.geometric_normals, [[0, 0, 1]] * count, atol=1e-9)
    if "point behind" not in "".join(scene.notes):
        np.testing.assert_allclose(scene.normals, UP, atol=1e-9)


def test_a_sheet_names_the_side_that_is_lit_after_turning() -> None:
    """One triangle of each side stands first: the second is turned to the first's side, and that one is named."""
    for up, facing in ((True, "(0, 0, 1)"), (False, "(0, 0, -1)")):
        sides = np.array([[0, 1, 2], [3, 2, 0], [2, 1, 0], [0, 2, 3]])
        scene = checked("sheet", SQUARE, sides if up else sides[:, ::-1])
        assert f"2 of them the back of another: the side facing {facing} is lit" in scene.notes[0]
        assert scene.notes[1].startswith("1 triangles turned")
        np.testing.assert_allclose(scene.geometric_normals[:, 2], 1 if up else -1, atol=1e-9)


def test_where_sheets_face_many_ways_the_file_decides() -> None:
    points, ball = icosphere(2)
    scene = checked("ball", points, np.concatenate([ball, ball[:, ::-1]]))
    assert "the side that comes first in the file is lit" in scene.notes[0]
    assert solid_angle(scene, np.zeros(3)) == pytest.approx(1)


def test_repeats_keep_the_first_and_its_material() -> None:
    scene = checked(
        "sheet", SQUARE, np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0]]), material=np.array([1, 0, 0]), materials=PLAIN * 2
    )
    assert scene.material.tolist() == [1, 0]
    np.testing.assert_array_equal(scene.triangles[0], [0, 1, 2])


@pytest.mark.parametrize("welded", [True, False])
@pytest.mark.parametrize("inward", [False, True])
def test_shuffled_winding_is_repaired_and_the_majority_stays(welded: bool, inward: bool) -> None:
    points, triangles = icosphere(4)
    triangles = triangles[:, ::-1] if inward else triangles
    generator = np.random.default_rng(5)
    mixed = triangles[generator.permutation(len(triangles))]
    turned = generator.random(len(mixed)) < 0.4
    mixed[turned] = mixed[turned, ::-1]
    if not welded:
        points, mixed = points[mixed.ravel()], np.arange(mixed.size).reshape(-1, 3)
    scene = checked("ball", points, mixed)
    assert scene.notes[0] == f"{turned.sum()} triangles turned to face as the rest of their surface"
    assert solid_angle(scene, np.zeros(3)) == pytest.approx(-1 if inward else 1)
    balance, count = edges(scene).T
    assert (balance == 0).all()
    assert (count == 2).all()


def test_bodies_are_judged_one_by_one_and_never_turned_as_a_whole() -> None:
    points, triangles = icosphere(2)
    both = np.concatenate([triangles, len(points) + triangles[:, ::-1]])
    positions = np.concatenate([points, points + np.array([5, 0, 0])])
    scene = checked("two", positions, both, normals=vertex_normals(positions, both))
    assert scene.notes == ()
    assert [round(solid_angle(scene, np.array(middle, float))) for middle in ((0, 0, 0), (5, 0, 0))] == [1, -1]
    damaged = both.copy()
    damaged[[3, len(triangles) + 7]] = damaged[[3, len(triangles) + 7], ::-1]
    np.testing.assert_array_equal(checked("two", positions, damaged).triangles, scene.triangles)


def test_majority_is_by_area_not_by_count() -> None:
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [10, 10, 0], [-1, 0, 0]])
    small_down_large_up = np.array([[0, 2, 1], [0, 4, 2], [1, 3, 2]])
    scene = checked("fan", positions, small_down_large_up)
    assert scene.notes[0].startswith("2 triangles turned")
    np.testing.assert_allclose(scene.geometric_normals[:, 2], 1)


def test_pages_of_a_book_are_left_alone() -> None:
    """Over an edge of more than two triangles nothing says which of them belong together."""
    positions = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])
    for pages in ([[0, 1, 2], [0, 1, 3], [1, 0, 4]], [[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 1, 5]]):
        np.testing.assert_array_equal(checked("book", positions[: np.max(pages) + 1], np.array(pages)).triangles, pages)


def test_one_sided_surface_is_left_and_named() -> None:
    turns = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    across = np.stack([np.cos(turns / 2) * np.cos(turns), np.sin(turns / 2), np.cos(turns / 2) * np.sin(turns)], axis=1)
    rim = np.stack([np.cos(turns), 0 * turns, np.sin(turns)], axis=1)
    positions = np.concatenate([rim - 0.3 * across, rim + 0.3 * across])
    k = np.arange(30)
    low, high = np.where(k == 29, 30, k + 1), np.where(k == 29, 0, k + 31)
    triangles = np.concatenate([np.stack([k, low, high], 1), np.stack([k, high, k + 30], 1)])
    scene = checked("strip", positions, triangles)
    assert "1 surfaces have one side only" in scene.notes[0]
    np.testing.assert_array_equal(scene.triangles, triangles)


def test_vertex_normals_do_not_depend_on_the_cut() -> None:
    """At a cube's corner each of three faces counts once, though one of them is cut through the corner."""
    quads = box(np.zeros(3), np.ones(3))
    positions, place = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
    corner = place.reshape(-1, 4)
    triangles = np.concatenate([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    np.testing.assert_allclose(vertex_normals(positions, triangles), (2 * positions - 1) / np.sqrt(3), atol=1e-12)


def test_normals_exist_where_faces_cancel() -> None:
    scene = checked("fold", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 0]]), np.array([[0, 1, 2], [1, 0, 3]]))
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1)
