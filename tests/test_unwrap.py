"""Charts: small meshes as xatlas makes them, all others in patches that never overlap, and no mesh that ends the process."""

import subprocess
import sys

import numpy as np
import pytest
import xatlas

from ddprt.errors import UserError
from ddprt.scene import patches as patching
from ddprt.scene import unwrap as unwrapping
from ddprt.scene.checks import checked
from ddprt.scene.folds import folded
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.scene.patches import POCKET, cut, hard_parts
from ddprt.scene.raster import rasterise
from ddprt.scene.winding import welded


def sheet(name: str, across: int, down: int) -> Scene:
    """A rectangle of squares, rolled up (`tube`), wound up beyond a full turn (`roll`), twisted (`ramp`) or bumpy (`hills`)."""
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, across + 1), np.linspace(0, 1, down + 1), indexing="ij"))
    turn = 2 * np.pi * u
    places = {
        "tube": (np.cos(turn), v, np.sin(turn)),
        "roll": ((0.2 + u) * np.cos(3 * turn), v, (0.2 + u) * np.sin(3 * turn)),
        "ramp": ((1 + 0.2 * v) * np.cos(2.5 * turn), 0.5 * u, (1 + 0.2 * v) * np.sin(2.5 * turn)),
        "hills": (u, 0.08 * np.sin(9 * u) * np.cos(7 * v), v),
    }
    i, j = (x.ravel() for x in np.meshgrid(np.arange(across), np.arange(down), indexing="ij"))
    a, b = i * (down + 1) + j, (i + 1) * (down + 1) + j
    return checked(
        name, np.stack(places[name], 1), np.concatenate([np.stack([a, a + 1, b + 1], 1), np.stack([a, b + 1, b], 1)])
    )


def rough(subdivisions: int, amplitude: float) -> Scene:
    sphere = build("furnace", subdivisions=subdivisions)
    bumps = 1 + amplitude * np.random.default_rng(0).standard_normal((len(sphere.positions), 1))
    return checked("rough", sphere.positions * bumps, sphere.triangles)


def parts(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    positions = ((scene.positions - scene.centre) / scene.radius).astype(np.float32)
    return hard_parts(positions[scene.triangles], welded(positions)[scene.triangles])


def plain(scene: Scene, resolution: int, padding: int) -> tuple[np.ndarray, np.ndarray]:
    """The path that all scenes took before there were patches."""
    positions = ((scene.positions - scene.centre) / scene.radius).astype(np.float32)
    charts = xatlas.Atlas()
    charts.add_mesh(positions, scene.triangles.astype(np.uint32), scene.normals.astype(np.float32))
    charts.generate()
    _, corners, uv = charts[0]
    flat = (uv * [charts.width, charts.height] / charts.texels_per_unit).astype(np.float32)
    low, high = 0.0, float(resolution)
    for _ in range(14):
        density = 0.5 * (low + high)
        packed = unwrapping._pack(flat, corners, None, density, resolution, padding)
        if packed is None:
            high = density
        else:
            low, best = density, packed
    return best[corners].astype(np.float64), charts.get_mesh_vertex_assignment(0)[1][corners[:, 0]]


# `furnace` with 5 subdivisions is the largest of the library that xatlas takes: 20480 triangles that almost are a plane to it.
LIBRARY = ["cornell", "cornell-hole", "corridor", "plates", "convex", "faults", "furnace"]
LARGE = [pytest.param("furnace", 5, marks=pytest.mark.slow), pytest.param("statue", 5, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("name", "subdivisions"), [*((name, None) for name in LIBRARY), ("statue", 4), *LARGE])
def test_small_meshes_are_as_xatlas_makes_them(name: str, subdivisions: int | None) -> None:
    scene = build(name) if subdivisions is None else build(name, subdivisions=subdivisions)
    uv, chart = unwrapping._unwrap(scene, 96, 2)
    expected, charts = plain(scene, 96, 2)
    np.testing.assert_array_equal(uv, expected)
    np.testing.assert_array_equal(chart, charts)


@pytest.mark.parametrize("name", ["furnace", "statue"])
def test_library_scenes_at_their_largest_stay_whole(name: str) -> None:
    assert not parts(build(name, subdivisions=5))[1].any()


def test_large_and_bent_surfaces_are_hard() -> None:
    scenes = [build("furnace", subdivisions=6), build("statue", subdivisions=6), sheet("tube", 500, 1), sheet("hills", 80, 80)]
    assert [parts(scene)[1].tolist() for scene in scenes] == [[True], [True, False], [True], [True]]
    assert parts(sheet("tube", 100, 1))[1].tolist() == [False]


def test_triangles_that_xatlas_drops_are_hard() -> None:
    large, small = build("plates", size=100.0), build("convex", size=0.01)
    positions = np.concatenate([large.positions, small.positions])
    scene = checked("mixed", positions, np.concatenate([large.triangles, len(large.positions) + small.triangles]))
    part, hard = parts(scene)
    assert hard[part].tolist() == [False] * 4 + [True] * 12


# --- every layout -----------------------------------------------------------------------------------------------------

SHEETS = {
    "tube": lambda: sheet("tube", 500, 1),
    "roll": lambda: sheet("roll", 600, 1),
    "ramp": lambda: sheet("ramp", 1200, 2),
    "hills": lambda: sheet("hills", 80, 80),
    "rough": lambda: rough(4, 0.02),
    "fine": lambda: build("furnace", subdivisions=6),
    "statue": lambda: build("statue", subdivisions=6),
}


@pytest.mark.parametrize("name", SHEETS)
def test_layouts_keep_their_promises(name: str) -> None:
    scene, resolution, padding = SHEETS[name](), 192, 2
    uv, chart = unwrapping._unwrap(scene, resolution, padding)
    assert uv.shape == (len(scene.triangles), 3, 2)
    assert uv.min() >= 0
    assert uv.max() <= 1
    assert not folded(uv, chart, 1e-5).any()
    edges = uv[:, 1:] - uv[:, :1]
    density = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / scene.areas
    mean = np.average(density, weights=scene.areas)
    if parts(scene)[1].all():  # all in patches: of a cosine above that of `POCKET`, and each of its area in sum
        assert density.min() > 0.25 * mean
        assert density.max() < 4 * mean
    pieces = rasterise(uv * resolution, resolution)
    assert len(np.unique(pieces.triangle)) == len(scene.triangles)
    assert np.bincount(pieces.texel, pieces.uv_area).max() < 1 + 1e-4  # no texel is covered twice
    image = np.full(resolution**2, -1)
    image[pieces.texel] = chart[pieces.triangle]
    assert (image[pieces.texel] == chart[pieces.triangle]).all()
    image = image.reshape(resolution, resolution)
    for shift in range(1, padding + 1):
        for axis in (0, 1):
            near, far = np.moveaxis(image, axis, 0)[:-shift], np.moveaxis(image, axis, 0)[shift:]
            assert ((near == far) | (near < 0) | (far < 0)).all()


def test_layouts_repeat() -> None:
    scene = sheet("hills", 80, 80)
    one, other = (unwrapping._unwrap(scene, 128, 2) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_easy_surfaces_keep_their_charts_beside_hard_ones() -> None:
    """The ground of a fine statue is one square, and of the same density as the body."""
    scene = build("statue", subdivisions=6)
    uv, chart = unwrapping._unwrap(scene, 256, 2)
    ground = chart[-2:]
    assert ground[0] == ground[1]
    assert (chart[:-2] != ground[0]).all()
    edges = uv[:, 1:] - uv[:, :1]
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    assert area[-2:].sum() / scene.areas[-2:].sum() == pytest.approx(area[:-2].sum() / scene.areas[:-2].sum(), rel=0.1)


def test_the_mesh_that_ended_the_process_is_unwrapped() -> None:
    code = (
        "from ddprt.scene.library import build; from ddprt.scene.unwrap import unwrap;"
        "print(unwrap(build('furnace', subdivisions=6), 128, 2)[1].max() < 40)"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (answer.returncode, answer.stdout.strip()) == (0, "True"), answer.stderr


def test_patches_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"atlas.resolution: got 8, expected more for the .* charts"):
        unwrapping._unwrap(sheet("tube", 500, 1), 8, 8)


# --- patches ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHEETS)
def test_patches_stay_in_their_cone_and_in_one_piece(name: str) -> None:
    scene = SHEETS[name]()
    weld = welded(scene.positions)[scene.triangles]
    patch, axis, flat = cut(scene.corners, weld)
    cosine = np.einsum("nd,nd->n", scene.geometric_normals, axis[patch])
    assert cosine.min() > np.cos(np.radians(POCKET)) - 1e-12
    assert np.bincount(patch).min() > 0
    edges = flat[:, 1:] - flat[:, :1]
    area = 0.5 * (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    assert area.min() > 0  # none is turned over
    np.testing.assert_allclose(np.bincount(patch, area), np.bincount(patch, scene.areas), rtol=1e-9)
    one, other = patching._edges(weld, exactly_two=True)
    inner = patch[one] == patch[other]
    pieces, _ = patching._components(one[inner], other[inner], len(patch))
    assert pieces == len(axis)


def triangles_overlap(one: np.ndarray, other: np.ndarray) -> bool:
    """By clipping one with the sides of the other: is any area left?"""
    turn = np.cross(other[1] - other[0], other[2] - other[0])
    polygon = list(one)
    for a, b in zip(other, np.roll(other, -1, axis=0), strict=True):
        height = [np.sign(turn) * np.cross(b - a, p - a) for p in polygon]
        kept = []
        for p, q, h, k in zip(polygon, polygon[1:] + polygon[:1], height, height[1:] + height[:1], strict=True):
            kept += [p] if h >= 0 else []
            if h * k < 0:
                kept.append(p + (q - p) * h / (h - k))
        polygon = kept
        if len(polygon) < 3:
            return False
    x, y = np.array(polygon).T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) > 1e-7


@pytest.mark.filterwarnings("ignore:Arrays of 2-dimensional vectors")
@pytest.mark.parametrize("stretch", [1.0, 0.02])
def test_folds_agree_with_clipping(stretch: float) -> None:
    rng = np.random.default_rng(3)
    count = 60
    chart = np.repeat(np.arange(count), 6)
    flat = rng.uniform(0, 1, (len(chart), 1, 2)) + 0.25 * rng.uniform(-1, 1, (len(chart), 3, 2)) * [1, stretch]
    found = folded(flat, chart, 1e-9)
    for index in range(count):
        mine = flat[chart == index]
        assert found[index] == any(triangles_overlap(mine[i], mine[j]) for i in range(6) for j in range(i))
    assert 0 < found.sum() < count


def test_one_fold_among_many_triangles_is_found() -> None:
    hills = sheet("hills", 60, 60)
    flat, chart = hills.corners[:, :, [0, 2]].copy(), np.zeros(len(hills.triangles), np.int64)
    assert not folded(flat, chart, 1e-9).any()
    flat[1234] += [0.3 / 60, 0]
    assert folded(flat, chart, 1e-9).all()


@pytest.mark.slow
def test_a_million_triangles_take_a_minute() -> None:
    uv, chart = unwrapping._unwrap(build("furnace", subdivisions=8), 1024, 2)
    assert len(uv) == 20 * 4**8
    assert chart.max() < 40
