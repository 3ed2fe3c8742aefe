"""Polygons of OBJ and PLY: their triangles cover them once and keep their side, whatever the outline."""

import struct
from pathlib import Path

import numpy as np
import pytest
from gltf_files import png
from oracles import covers, winding_number

from ddprt.errors import UserError
from ddprt.scene.cutting import cut_polygons, notes_on
from ddprt.scene.files import load_scene
from ddprt.scene.images import srgb_to_linear

DART = [[2, 0], [0.5, 0.5], [0, 2], [0, 0]]
ELL = [[2, 0], [2, 1], [1, 1], [1, 2], [0, 2], [0, 0]]
COMB = [
    [0, 0],
    [7, 0],
    [7, 2],
    [6, 2],
    [6, 1],
    [5, 1],
    [5, 2],
    [4, 2],
    [4, 1],
    [3, 1],
    [3, 2],
    [2, 2],
    [2, 1],
    [1, 1],
    [1, 2],
    [0, 2],
]
KEYHOLE = [[0, 0], [3, 0], [3, 3], [0, 3], [0, 0], [1, 1], [1, 2], [2, 2], [2, 1], [1, 1]]
IN_LINE = [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]]
TWICE = [[0, 0], [1, 0], [1, 0], [1, 1], [0, 1], [0, 1]]
SPIRAL = [[np.cos(a) * r, np.sin(a) * r] for r, a in [(1 + 0.2 * k, 0.5 * k) for k in range(30)]]
SPIRAL += [[np.cos(a) * r, np.sin(a) * r] for r, a in [(0.6 + 0.2 * k, 0.5 * k) for k in range(29, -1, -1)]]
OUTLINES = {"dart": DART, "ell": ELL, "comb": COMB, "keyhole": KEYHOLE, "in line": IN_LINE, "twice": TWICE, "spiral": SPIRAL}


def area(outline: np.ndarray) -> float:
    x, y = outline.T
    return float(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def in_space(outline: np.ndarray) -> np.ndarray:
    """On a plane that is no one's axis, far from the origin, its front on the outline's left."""
    turn, _ = np.linalg.qr(np.array([[1.0, 2, 3], [0.5, -1, 2], [3, 0, 1]]))
    turn *= np.sign(np.linalg.det(turn))
    return np.concatenate([outline, np.zeros((len(outline), 1))], 1) @ turn.T + [5, -7, 3]


@pytest.mark.parametrize("start", range(3))
@pytest.mark.parametrize("name", OUTLINES)
def test_triangles_cover_an_outline_once(name: str, start: int) -> None:
    flat = np.roll(np.array(OUTLINES[name], float), start, axis=0)
    flat = flat if area(flat) > 0 else flat[::-1]
    cut = cut_polygons(in_space(flat), np.array([len(flat)]))
    assert not cut.crossing.any()
    assert len(cut.triangles) == len(flat) - 2
    areas = [area(flat[row]) for row in cut.triangles]
    assert min(areas) >= 0
    assert sum(areas) == pytest.approx(area(flat))
    places = np.random.default_rng(1).uniform(flat.min(0) - 0.1, flat.max(0) + 0.1, (200, 2))
    for place in places:
        assert sum(covers(flat[row], place) for row in cut.triangles) == (winding_number(flat, place) != 0)
    normal = in_space(np.array([[0.0, 0], [1, 0], [0, 1]]))
    front = np.cross(normal[1] - normal[0], normal[2] - normal[0])
    a, b, c = np.moveaxis(in_space(flat)[cut.triangles], 1, 0)
    assert (np.cross(b - a, c - a) @ front >= -1e-9).all()


def test_corners_in_line_make_no_slivers() -> None:
    cut = cut_polygons(in_space(np.array(IN_LINE, float)), np.array([8]))
    assert min(area(np.array(IN_LINE, float)[row]) for row in cut.triangles) > 0.4


def test_random_outlines_of_many_sizes_at_once() -> None:
    """Stars about a point are simple however ragged; their triangles' areas add up, polygon by polygon."""
    generator = np.random.default_rng(2)
    sizes = generator.integers(0, 24, 60)
    stars = []
    for size in sizes:
        angle = (np.arange(size) + generator.uniform(0, 0.9, size)) / max(size, 3) * 2 * np.pi
        stars.append(generator.uniform(0.1, 1, (size, 1)) * np.stack([np.cos(angle), np.sin(angle)], 1))
    corners = np.concatenate(stars)
    cut = cut_polygons(in_space(corners), sizes)
    assert not cut.crossing.any()
    areas = np.array([area(corners[row]) for row in cut.triangles])
    assert areas.min() > 0
    totals = np.bincount(cut.owner, areas, len(sizes))
    np.testing.assert_allclose(totals, [area(star) if len(star) > 2 else 0.0 for star in stars], atol=1e-12)
    assert 0 < cut.fans.sum() < (sizes > 2).sum()
    assert notes_on(cut, in_space(corners), sizes) == [f"{(sizes < 3).sum()} faces of fewer than three corners left out"]


@pytest.mark.parametrize(
    "outline",
    [
        [[0, 0], [1, 1], [1, 0], [0, 1]],  # two lobes that cancel out
        [[0, 0], [3, 2], [3, 0], [0, 1]],
        [[np.cos(a), np.sin(a)] for a in np.arange(5) * 4 * np.pi / 5],
        [[2, 3], [1, 1], [3, 4], [0, 0], [3, 1]],  # whose corners could be taken for ears to the end
        [
            [0, 0],
            *([np.cos(0.9 * k) * (1 + 0.1 * k), np.sin(0.9 * k) * (1 + 0.1 * k)] for k in range(10)),
        ],  # round its first one
    ],
)
def test_outlines_that_cross_themselves_are_told(outline: list) -> None:
    corners = np.concatenate([in_space(np.array(DART, float)), in_space(np.array(outline, float))])
    sizes = np.array([4, len(outline)])
    cut = cut_polygons(corners, sizes)
    assert cut.crossing.tolist() == [False, True]
    (note,) = notes_on(cut, corners, sizes)
    x, y, z = corners[4].round(4)
    assert note.startswith(f"1 polygons cross themselves, the first at ({x:g}, {y:g}, {z:g}) m")


def test_an_outline_without_area_crosses_nothing() -> None:
    cut = cut_polygons(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]), np.array([4]))
    assert not cut.crossing.any()
    assert len(cut.triangles) == 2


def obj(outlines: list[list], *between: str) -> str:
    """Objects of one polygon each, each at a height of its own."""
    text, first = "", 1
    for number, outline in enumerate(outlines):
        text += "".join(f"v {x} {y} {number}\n" for x, y in outline) + (between[number] if between else "")
        text += "f " + " ".join(str(first + k) for k in range(len(outline))) + "\n"
        first += len(outline)
    return text


PENTAGON = [[0, 0], [1, 0], [1.3, 1], [0.5, 1.5], [-0.3, 1]]


@pytest.mark.parametrize("outlines", [[PENTAGON], [PENTAGON] * 3, [DART], [ELL], [DART, PENTAGON, [[0, 0], [1, 0], [0, 1]]]])
def test_obj_polygons(tmp_path: Path, outlines: list) -> None:
    (tmp_path / "a.obj").write_text(obj(outlines))
    scene = load_scene(tmp_path / "a.obj")
    assert scene.areas.sum() == pytest.approx(sum(area(np.array(outline)) for outline in outlines))
    np.testing.assert_allclose(scene.geometric_normals, [[0, 0, 1]] * len(scene.triangles))
    assert not any("turned" in note or "no area" in note for note in scene.notes)


def test_obj_quads_that_halve_stay_as_they_were_read(tmp_path: Path) -> None:
    """One at once, halves after halves: what was baked of such a file stands."""
    (tmp_path / "a.obj").write_text(obj([[[0, 0], [1, 0], [1, 1], [0, 1]]] * 2))
    corners = load_scene(tmp_path / "a.obj").corners
    np.testing.assert_array_equal(corners[:, 0, 2], [0, 1, 0, 1])
    np.testing.assert_array_equal(corners[0, :, :2], [[0, 0], [1, 0], [1, 1]])


def test_obj_polygons_keep_their_texture_coordinates(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 1 1\nmap_Kd a.png\n")
    (tmp_path / "a.png").write_bytes(png())
    places = "".join(f"v {x} {y} 0\nvt {x / 4} {1 - y / 4}\n" for x, y in ELL)
    corners = " ".join(f"{k}/{k}" for k in range(1, 7))
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\nusemtl a\n{places}f {corners}\n")
    scene = load_scene(tmp_path / "a.obj")
    assert scene.uv is not None
    np.testing.assert_allclose(scene.uv, scene.positions[:, :2] / 4, atol=1e-12)
    assert scene.areas.sum() == pytest.approx(3)


def test_obj_numbers_from_the_end_count_what_precedes(tmp_path: Path) -> None:
    """Not from the end of the file, where the second object is."""
    quad = "v 0 0 {0}\nv 1 0 {0}\nv 1 1 {0}\nv 0 1 {0}\n{1}"
    polygons = quad.format(0, "f -4 -3 -2 -1\n") + quad.format(1, "f -4 -3 \\\n-2\n") + "f 1 2\n"
    (tmp_path / "a.obj").write_text(polygons)
    scene = load_scene(tmp_path / "a.obj")
    assert sorted(scene.corners[:, 0, 2]) == [0, 0, 1]
    assert scene.areas.sum() == pytest.approx(1.5)
    assert "1 faces of fewer than three corners left out" in scene.notes
    (tmp_path / "a.obj").write_text("f -3 -2 -1\n" + obj([DART]))
    with pytest.raises(UserError, match=r"a\.obj: got a face with vertex -2, expected vertex indices from 1 to 4"):
        load_scene(tmp_path / "a.obj")


def ply(path: Path, outlines: list[list], order: str, *, colours: bool = False, uv: bool = False) -> Path:
    """Polygons at heights of their own; red is the number of each."""
    spelled = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    places = [(x, y, number) for number, outline in enumerate(outlines) for x, y in outline]
    head = f"ply\nformat {spelled} 1.0\nelement vertex {len(places)}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(outlines)}\nproperty list uchar uint vertex_indices\n"
    head += (
        "property uchar red\nproperty uchar green\nproperty uchar blue\n" * colours
        + "property list uchar float texcoord\n" * uv
    )
    body, first = [("f", place) for place in places], 0
    for number, outline in enumerate(outlines):
        body += [("B", (len(outline),)), ("I", tuple(range(first, first + len(outline))))]
        body += [("B", (40 * number, 9, 200))] if colours else []
        body += [("B", (2 * len(outline),)), ("f", tuple(v for x, y in outline for v in (x / 4, 1 - y / 4)))] if uv else []
        first += len(outline)
    if order:
        data = b"".join(struct.pack(order + kind * len(values), *values) for kind, values in body)
    else:
        data = "\n".join(_lines(body, len(places), 2 + colours + 2 * uv)).encode() + b"\n"
    path.write_bytes((head + "end_header\n").encode() + data)
    return path


def _lines(body: list, vertices: int, parts: int) -> list[str]:
    """Words of a PLY in ASCII, an element a line, `parts` entries a face."""

    def row(entries: list) -> str:
        return " ".join(str(value) for _, values in entries for value in values)

    faces = body[vertices:]
    return [row([entry]) for entry in body[:vertices]] + [row(faces[k : k + parts]) for k in range(0, len(faces), parts)]


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("outlines", [[PENTAGON] * 2, [DART, PENTAGON, [[0, 0], [1, 0], [0, 1]]], [DART] * 2, [ELL]])
def test_ply_polygons(tmp_path: Path, outlines: list, order: str) -> None:
    scene = load_scene(ply(tmp_path / "a.ply", outlines, order, colours=True))
    assert scene.areas.sum() == pytest.approx(sum(area(np.array(outline)) for outline in outlines))
    np.testing.assert_allclose(scene.geometric_normals, [[0, 0, 1]] * len(scene.triangles), atol=1e-6)
    count = len(scene.triangles)
    albedo = scene.albedo_at(np.arange(count), np.full((count, 3), 1 / 3))
    np.testing.assert_allclose(albedo[:, 0], srgb_to_linear(scene.corners[:, 0, 2] * 40 / 255), atol=1e-9)


def test_ply_polygons_keep_their_texture_coordinates(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png())
    path = ply(tmp_path / "a.ply", [ELL, DART], "<", uv=True)
    path.write_bytes(path.read_bytes().replace(b"1.0\n", b"1.0\ncomment TextureFile a.png\n", 1))
    scene = load_scene(path)
    assert scene.uv is not None
    np.testing.assert_allclose(scene.uv, scene.positions[:, :2] / 4, atol=1e-6)


@pytest.mark.parametrize("spare", [-1, 1])
def test_a_binary_ply_of_polygons_has_the_length_it_says(tmp_path: Path, spare: int) -> None:
    path = ply(tmp_path / "a.ply", [PENTAGON, DART], "<")
    path.write_bytes(path.read_bytes()[:spare] if spare < 0 else path.read_bytes() + b"\0")
    with pytest.raises(UserError, match=r"a\.ply: got a damaged file"):
        load_scene(path)
