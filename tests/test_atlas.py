"""The lightmap: areas, places, conventions, senders, and the cache of unwraps."""

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from oracles import chi_square, clipped_area

from ddprt.errors import UserError
from ddprt.scene import atlas as atlases
from ddprt.scene import unwrap as unwrapping
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.filtered import mean_albedo
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.raster import interpolate, rasterise

SIGNIFICANT = 1e-4
"""Of chi-square tests; the seeds are fixed."""


def moved(scene: Scene, factor: float, offset: tuple[float, float, float]) -> Scene:
    positions = factor * scene.positions + offset
    return checked(
        scene.name, positions, scene.triangles, normals=scene.normals, material=scene.material, materials=scene.materials
    )


def barycentric(scene: Scene, triangle: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the three corners, and the distance to the triangle's plane."""
    a, b, c = np.moveaxis(scene.corners[triangle], 1, 0)
    normal, offset = np.cross(b - a, c - a), position - a
    squared = (normal**2).sum(1)
    second = (np.cross(offset, c - a) * normal).sum(1) / squared
    third = (np.cross(b - a, offset) * normal).sum(1) / squared
    height = np.abs((offset * normal).sum(1)) / np.sqrt(squared)
    return np.stack([1 - second - third, second, third], 1), height


def place_on_image(scene: Scene, atlas: Atlas, triangle: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Column and row, in texels, of points on triangles."""
    weights, _ = barycentric(scene, triangle, position)
    return np.einsum("nc,ncd->nd", weights, atlas.uv[triangle]) * atlas.resolution


@pytest.fixture(scope="module")
def stepped() -> Scene:
    """Three rectangles of different sizes and slopes: no symmetry hides a flip."""
    positions = [[0, 0, 0], [2, 0, 0], [2, 0, 1], [0, 0, 1], [2, 0.7, 0], [2, 0.7, 1], [3.1, 1.2, 0], [3.1, 1.2, 1]]
    triangles = [[0, 2, 1], [0, 3, 2], [1, 2, 5], [1, 5, 4], [4, 5, 7], [4, 7, 6]]
    return checked("stepped", np.array(positions, float), np.array(triangles))


# --- cutting triangles along the grid ---------------------------------------------------------------------------------


def test_pieces_agree_with_supersampling() -> None:
    rng = np.random.default_rng(0)
    triangles = rng.uniform(0, 6, (12, 3, 2))
    pieces = rasterise(triangles, 6)
    for index, corners in enumerate(triangles):
        mine = pieces.triangle == index
        areas = np.bincount(pieces.texel[mine], pieces.uv_area[mine], minlength=36)
        for texel, area in enumerate(areas):
            expected, doubt = clipped_area(corners, texel % 6, texel // 6, 100)
            assert abs(area - expected) <= doubt + 1e-9  # the slivers that are dropped


def exact_areas(corners: np.ndarray, resolution: int) -> np.ndarray:
    """Area of a triangle inside every texel, in rational numbers: clipped against each side of each square in turn."""
    areas = np.zeros((resolution, resolution))
    low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
    for row in range(low[1], high[1]):
        for column in range(low[0], high[0]):
            polygon = [(Fraction(x), Fraction(y)) for x, y in corners.tolist()]
            for axis, sign, bound in ((0, 1, column), (0, -1, column + 1), (1, 1, row), (1, -1, row + 1)):
                kept = []
                for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                    here, there = sign * (p[axis] - bound), sign * (q[axis] - bound)
                    kept += [p] if here >= 0 else []
                    if here * there < 0:
                        kept.append(tuple(a + (b - a) * here / (here - there) for a, b in zip(p, q, strict=True)))
                polygon = kept
            around = zip(polygon, polygon[1:] + polygon[:1], strict=True)
            areas[row, column] = abs(sum(p[0] * q[1] - p[1] * q[0] for p, q in around)) / 2
    return areas


def awkward_triangles(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Forty triangles inside [0, 12]², of a kind that is hard to cut."""
    corners = rng.uniform(0, 12, (40, 3, 2))
    if kind == "slivers":
        along = rng.random((40, 1))
        middle = corners[:, 0] * along + corners[:, 1] * (1 - along)
        corners[:, 2] = np.clip(middle + rng.uniform(-1, 1, (40, 2)) * 10.0 ** rng.uniform(-12, -1, (40, 1)), 0, 12)
    elif kind == "inside a texel":
        corners = np.floor(corners[:, :1]) + rng.uniform(0, 1, (40, 1, 2)) * 0.9 + rng.uniform(0, 0.1, (40, 3, 2))
    elif kind == "on the grid":
        corners = np.concatenate([np.round(corners[:20]), np.round(2 * corners[20:]) / 2])
    elif kind == "next to the grid":
        corners = np.round(corners)
        corners = np.clip(corners + rng.integers(-3, 4, corners.shape) * np.spacing(corners), 0, 12)
    elif kind == "huge":
        corners = np.array([[0.0, 0], [12, 0], [12, 12], [0, 12]])[[rng.permutation(4)[:3] for _ in range(40)]]
        corners[8:] = np.clip(corners[8:] + rng.uniform(-1, 1, (32, 3, 2)), 0, 12)
    return corners


@pytest.mark.parametrize("kind", ["any", "slivers", "inside a texel", "on the grid", "next to the grid", "huge"])
def test_pieces_agree_with_rational_clipping(kind: str) -> None:
    triangles = awkward_triangles(kind, np.random.default_rng(2))
    pieces = rasterise(triangles, 12)
    # Ordered, so that texels are runs of pieces and sums over them never depend on how the cutting went.
    assert (np.diff(pieces.texel * len(triangles) + pieces.triangle) >= 0).all()
    assert (pieces.uv_area > 0).all()
    for index, corners in enumerate(triangles):
        mine = pieces.triangle == index
        expected = exact_areas(corners, 12)
        areas = np.bincount(pieces.texel[mine], pieces.uv_area[mine], minlength=144).reshape(12, 12)
        assert (areas[expected == 0] == 0).all()
        # A fan has up to 5 slivers of 1e-9 to drop; the rest is rounding of coordinates below 12, with room to spare.
        assert np.abs(areas - expected).max() <= 5e-9
        assert np.abs(areas - expected)[expected > 1e-3].max(initial=0) <= 3e-9
        np.testing.assert_allclose(
            pieces.share[mine] * expected.sum() ** 2, pieces.uv_area[mine] * expected.sum(), rtol=0, atol=1e-12
        )
        assert (np.bincount(pieces.texel[mine], minlength=144)[expected.ravel() == 1] == 2).all()
    weights = pieces.barycentric
    assert weights.min() >= 0
    assert weights.max() <= 1
    place = np.einsum("npc,ncd->npd", weights, triangles[pieces.triangle])
    low = np.stack([pieces.texel % 12, pieces.texel // 12], 1)[:, None]
    # Weights are quotients by the triangle's area: their rounding grows as a sliver thins.
    whole = np.minimum(np.bincount(pieces.triangle, pieces.uv_area)[pieces.triangle], 1)
    assert (np.minimum(place - low, low + 1 - place).min((1, 2)) * whole > -1e-12).all()
    edges = place[:, 1:] - place[:, :1]
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2
    np.testing.assert_allclose(area * whole, pieces.uv_area * whole, rtol=0, atol=1e-12)


def test_pieces_do_not_depend_on_what_else_is_cut() -> None:
    triangles = np.concatenate([awkward_triangles(kind, np.random.default_rng(3)) for kind in ("any", "huge", "on the grid")])
    pieces, last = rasterise(triangles, 12), rasterise(triangles[-50:], 12)
    late = pieces.triangle >= len(triangles) - 50
    np.testing.assert_array_equal(pieces.texel[late], last.texel)
    np.testing.assert_array_equal(pieces.barycentric[late], last.barycentric)


def test_interpolation_weighs_corners() -> None:
    rng = np.random.default_rng(0)
    weights, triangle, corners = rng.random((50, 2, 3)), rng.integers(0, 7, 50, np.int32), rng.normal(size=(7, 3, 3))
    expected = np.einsum("npc,ncd->npd", weights, corners[triangle])
    np.testing.assert_allclose(interpolate(weights, triangle, corners), expected, atol=1e-14)
    single = interpolate(weights, triangle, corners, np.float32)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, atol=1e-6)


def test_pieces_keep_the_whole_area() -> None:
    rng = np.random.default_rng(1)
    triangles = rng.uniform(0, 32, (200, 3, 2))
    pieces = rasterise(triangles, 32)
    share = np.bincount(pieces.triangle, pieces.share)
    edges = triangles[:, 1:] - triangles[:, :1]
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) / 2
    # A triangle crosses at most 96 texels of a row or column on its rim, and loses up to 5 slivers of 1e-9 in each.
    assert (np.abs(share - 1) * area < 500e-9).all()
    np.testing.assert_allclose(np.bincount(pieces.triangle, pieces.uv_area), share * area, rtol=1e-12)
    np.testing.assert_allclose(pieces.barycentric.sum(2), 1, atol=1e-9)


def test_small_v_is_the_top_row() -> None:
    assert rasterise(np.array([[[5.2, 0.1], [5.8, 0.1], [5.2, 0.8]]]), 8).texel.tolist() == [5]
    assert rasterise(np.array([[[5.2, 7.1], [5.8, 7.1], [5.2, 7.8]]]), 8).texel.tolist() == [7 * 8 + 5]


@pytest.mark.parametrize("winding", [1, -1])
def test_mirrored_charts_are_cut_as_well(winding: int) -> None:
    corners = np.array([[[0.0, 0], [3, 0], [0, 3]]])[:, ::winding]
    assert rasterise(corners, 4).uv_area.sum() == pytest.approx(4.5, abs=1e-12)


def test_triangles_on_the_rim_stay_inside() -> None:
    pieces = rasterise(np.array([[[0.0, 0], [4, 0], [4, 4]], [[4.0, 4], [0, 4], [0, 0]]]), 4)
    assert pieces.uv_area.sum() == pytest.approx(16, abs=1e-12)
    assert np.unique(pieces.texel).tolist() == list(range(16))


def test_triangles_without_area_have_no_pieces() -> None:
    flat = np.array([[[1.0, 1], [2, 2], [3, 3]], [[0.0, 0], [1, 0], [0, 1]]])
    assert np.unique(rasterise(flat, 4).triangle).tolist() == [1]


# --- texels --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "resolution", "padding"), [("cornell", 64, 2), ("cornell", 77, 1), ("corridor", 48, 3)])
def test_the_resolution_is_met_exactly(name: str, resolution: int, padding: int) -> None:
    atlas = build_atlas(build(name), resolution, padding)
    assert atlas.slot.shape == (resolution, resolution)
    assert atlas.image(atlas.area).shape == (resolution, resolution)
    assert (atlas.uv >= 0).all()
    assert (atlas.uv <= 1).all()
    # The density is bisected until a finer one no longer fits, so the charts reach across, up to padding and a rounding of
    # chart sizes to whole texels on each side.
    assert atlas.uv.max() * resolution > resolution - 2 - 2 * padding


def test_areas_sum_to_the_mesh(cornell: Scene, cornell_atlas: Atlas, furnace: Scene, furnace_atlas: Atlas) -> None:
    for scene, atlas in ((cornell, cornell_atlas), (furnace, furnace_atlas)):
        # Slivers below 1e-9 texels are dropped where edges cross texels: measured 1e-15 and 4e-13 of the whole.
        assert atlas.area.sum() == pytest.approx(scene.areas.sum(), rel=1e-12)
        assert (atlas.area > 0).all()


def test_coverage_sums_to_the_charts(cornell: Scene, cornell_atlas: Atlas) -> None:
    edges = cornell_atlas.uv[:, 1:] - cornell_atlas.uv[:, :1]
    area = np.abs(np.linalg.det(edges)) / 2 * 64**2
    assert cornell_atlas.coverage.sum() == pytest.approx(area.sum(), rel=1e-9)
    assert cornell_atlas.coverage.max() <= 1 + 1e-9  # charts that overlap would cover a texel twice
    density = np.sqrt(area.sum() / cornell.areas.sum())
    assert cornell_atlas.texels_per_metre == pytest.approx(density, rel=1e-6)
    # xatlas rounds each chart to whole texels, so density differs between charts; within a flat one it is constant up to
    # float32 coordinates (64 * 6e-8 texels) over the smallest piece compared.
    whole = cornell_atlas.coverage > 0.01
    for chart in np.unique(cornell_atlas.chart):
        local = (cornell_atlas.coverage / cornell_atlas.area)[whole & (cornell_atlas.chart == chart)]
        np.testing.assert_allclose(local, np.median(local), rtol=2e-3)


@pytest.mark.parametrize(("name", "padding"), [("cornell", 1), ("cornell", 2), ("cornell", 4), ("furnace", 2)])
def test_charts_keep_their_distance(name: str, padding: int) -> None:
    atlas = build_atlas(build(name), 96, padding)
    charts = np.full((96, 96), -1)
    charts.ravel()[atlas.texel] = atlas.chart
    assert len(np.unique(atlas.chart)) > 1
    for shift in range(1, padding + 1):
        for axis in (0, 1):
            near, far = np.moveaxis(charts, axis, 0)[:-shift], np.moveaxis(charts, axis, 0)[shift:]
            assert ((near == far) | (near < 0) | (far < 0)).all()


def test_no_texel_has_pieces_of_two_charts(cornell: Scene) -> None:
    atlas = build_atlas(cornell, 128, 1)
    _, chart = unwrapping.unwrap(cornell, 128, 1)
    assert len(np.unique(np.stack([atlas.piece_texel, chart[atlas.piece_triangle]]), axis=1).T) == atlas.count


def test_texels_stand_where_the_image_says(stepped: Scene) -> None:
    """Row 0 is at the top: the uv of a texel's position lies in that texel's row and column."""
    atlas = build_atlas(stepped, 40)
    outside = []
    for triangle in range(6):
        weights, height = barycentric(stepped, np.full(atlas.count, triangle), atlas.position)
        outside.append(np.abs(weights).sum(1) + 9 * height)
    home = np.argmin(outside, axis=0)
    place = place_on_image(stepped, atlas, home, atlas.position)
    row, column = np.divmod(atlas.texel, 40)
    np.testing.assert_array_equal(np.floor(place).astype(int), np.stack([column, row], 1))
    np.testing.assert_allclose(atlas.geometric_normal, stepped.geometric_normals[home], atol=1e-12)
    v = atlas.image(place[:, 1])
    assert v[3:].max() > 30
    assert all(v[r][v[r] > 0].min() >= r for r in range(40) if (v[r] > 0).any())
    assert (atlas.slot.ravel()[atlas.texel] == np.arange(atlas.count)).all()


@pytest.fixture(scope="module")
def papered() -> Scene:
    """A bumpy sphere with a texture, so that no two pieces of a texel have the same albedo."""
    sphere = build("furnace", subdivisions=2)
    picture = np.random.default_rng(0).random((7, 5, 3))
    paper = Material("paper", (0.9, 0.5, 0.2), picture)
    return checked("papered", sphere.positions, sphere.triangles, materials=(paper,), uv=sphere.positions[:, :2].copy())


def test_texels_agree_with_a_loop_over_pieces(papered: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlases, "_BLOCK", 100)  # many blocks, and a last one that is not full
    atlas = build_atlas(papered, 48)
    uv, chart = unwrapping.unwrap(papered, 48, 2)
    pieces = rasterise(uv * 48, 48)
    assert len(pieces.texel) % 100 > 0
    assert np.unique(pieces.texel).tolist() == atlas.texel.tolist()
    for index, texel in enumerate(atlas.texel):
        mine = np.flatnonzero(pieces.texel == texel)
        triangle, middle = pieces.triangle[mine], pieces.barycentric[mine].mean(1)
        area = pieces.share[mine] * papered.areas[triangle]
        albedo = mean_albedo(papered, triangle, pieces.barycentric[mine])
        np.testing.assert_allclose(atlas.area[index], area.sum(), rtol=1e-12)
        np.testing.assert_allclose(atlas.coverage[index], pieces.uv_area[mine].sum(), rtol=1e-12)
        np.testing.assert_allclose(atlas.albedo[index], area @ albedo / area.sum(), rtol=1e-12)
        first = np.flatnonzero(area >= area.max() * (1 - 1e-9))[0]
        home, weights = triangle[first], middle[first]
        normal = weights @ papered.normals[papered.triangles[home]]
        np.testing.assert_allclose(atlas.position[index], weights @ papered.corners[home], atol=1e-12)
        np.testing.assert_allclose(atlas.normal[index], normal / np.linalg.norm(normal), atol=1e-12)
        np.testing.assert_allclose(atlas.geometric_normal[index], papered.geometric_normals[home], atol=1e-12)
        assert atlas.chart[index] == chart[home]
        assert (atlas.piece_texel[mine] == index).all()
    np.testing.assert_allclose(atlas.piece_area, pieces.share * papered.areas[pieces.triangle], rtol=1e-12)
    np.testing.assert_array_equal(atlas.piece_triangle, pieces.triangle)
    corners = np.einsum("npc,ncd->npd", pieces.barycentric, (papered.corners - papered.centre)[pieces.triangle])
    np.testing.assert_allclose(atlas.piece_corners, corners, atol=1e-7)


def test_rounding_does_not_choose_among_equal_pieces(cornell_atlas: Atlas, cornell: Scene) -> None:
    """The two halves of a whole texel are equal but for rounding: the first is taken, whatever the processor rounds."""
    start = np.searchsorted(cornell_atlas.piece_texel, np.arange(cornell_atlas.count + 1))
    area = cornell_atlas.piece_area
    whole = [
        t for t in range(cornell_atlas.count) if start[t + 1] - start[t] == 2 and np.isclose(*area[start[t] : start[t + 1]])
    ]
    assert len(whole) > 1000
    middle = cornell_atlas.piece_corners[start[:-1]].mean(1) + cornell.centre
    np.testing.assert_allclose(cornell_atlas.position[whole], middle[whole], atol=1e-6)


def test_albedo_of_a_texel_is_that_of_its_material(cornell: Scene, cornell_atlas: Atlas) -> None:
    albedo = np.array([material.albedo for material in cornell.materials])
    order = np.argsort(cornell_atlas.piece_texel, kind="stable")
    home = cornell_atlas.piece_triangle[order][
        np.searchsorted(cornell_atlas.piece_texel[order], np.arange(cornell_atlas.count))
    ]
    # Flat rectangles are charts of their own or meet others of the same paint.
    np.testing.assert_allclose(cornell_atlas.albedo, albedo[cornell.material[home]], atol=1e-12)


def test_lookup_closes_holes_without_wrapping_around(cornell_atlas: Atlas) -> None:
    slot, lookup = cornell_atlas.slot, cornell_atlas.lookup
    np.testing.assert_array_equal(lookup[slot >= 0], slot[slot >= 0])
    texel = np.full(64**2, -1)
    for row, column in np.argwhere((slot < 0) & (lookup >= 0)):
        texel = cornell_atlas.texel[lookup[row, column]]
        assert abs(texel // 64 - row) + abs(texel % 64 - column) == 1
    assert (lookup[slot < 0] >= 0).any()


# --- points on texels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cornell", "furnace"])
def test_samples_stay_in_their_texel_and_on_their_triangle(name: str, request: pytest.FixtureRequest) -> None:
    scene, atlas = request.getfixturevalue(name), request.getfixturevalue(f"{name}_atlas")
    group = np.repeat(np.arange(atlas.count), 16)
    u = np.random.default_rng(0).random((len(group), 2), np.float32)
    local, triangle = atlas.sampler.sample(group, u)
    position = local + atlas.centre
    weights, height = barycentric(scene, triangle, position)
    # Float32 coordinates of half a box carry 3e-8 of it; a metre is about 14 to 40 texels here, and edges divide by the
    # smallest height of a triangle (an eighth of the radius).
    assert height.max() < 4e-7 * scene.radius
    assert weights.min() > -1e-5
    place = place_on_image(scene, atlas, triangle, position)
    low = np.stack([atlas.texel[group] % 64, atlas.texel[group] // 64], 1)
    assert (place - low).min() > -1e-4
    assert (place - low).max() < 1 + 1e-4


def test_samples_are_uniform_by_area(furnace: Scene, furnace_atlas: Atlas) -> None:
    """Senders with many triangles: each triangle gets its share of the area, and so does each quarter of a triangle."""
    senders = furnace_atlas.senders(8)
    chosen = np.argsort(senders.area)[-3:]
    rng = np.random.default_rng(1)
    share = np.zeros((len(senders.area), len(furnace.triangles)))
    np.add.at(share, (senders.of_texel[furnace_atlas.piece_texel], furnace_atlas.piece_triangle), furnace_atlas.piece_area)
    for sender in np.sort(chosen):
        group = np.full(40_000, sender)
        local, triangle = senders.sampler.sample(group, rng.random((len(group), 2), np.float32))
        assert (share[sender] > 0).sum() > 20
        assert chi_square(np.bincount(triangle, minlength=len(furnace.triangles)), share[sender]) > SIGNIFICANT
        whole = np.isclose(share[sender], furnace.areas, rtol=1e-6)[triangle]
        assert whole.sum() > 5000
        weights, _ = barycentric(furnace, triangle[whole], local[whole] + furnace_atlas.centre)
        quarter = np.where(weights.max(1) > 0.5, weights.argmax(1), 3)
        assert chi_square(np.bincount(quarter, minlength=4), np.ones(4)) > SIGNIFICANT


@pytest.mark.parametrize("first", [0.0, np.nextafter(np.float32(1), np.float32(0))])
def test_extreme_numbers_stay_in_their_group(cornell_atlas: Atlas, first: float) -> None:
    group = np.arange(cornell_atlas.count)
    u = np.full((len(group), 2), first, np.float32)
    _, triangle = cornell_atlas.sampler.sample(group, u)
    pieces = set(zip(cornell_atlas.piece_texel.tolist(), cornell_atlas.piece_triangle.tolist(), strict=True))
    assert set(zip(group.tolist(), triangle.tolist(), strict=True)) <= pieces


# --- senders --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [1, 2, 4, 8])
def test_senders(cornell_atlas: Atlas, block: int) -> None:
    senders = cornell_atlas.senders(block)
    assert senders.area.sum() == pytest.approx(cornell_atlas.area.sum(), rel=1e-12)
    np.testing.assert_allclose(senders.area, np.bincount(senders.of_texel, cornell_atlas.area))
    row, column = np.divmod(cornell_atlas.texel, 64)
    for sender in range(len(senders.area)):
        mine = senders.of_texel == sender
        assert mine.any()
        assert len(np.unique(cornell_atlas.chart[mine])) == 1
        assert np.ptp(row[mine] // block) == np.ptp(column[mine] // block) == 0
        expected = np.average(cornell_atlas.albedo[mine], axis=0, weights=cornell_atlas.area[mine])
        np.testing.assert_allclose(senders.albedo[sender], expected, rtol=1e-12)
        assert (row[mine] // block == senders.row[sender]).all()
        assert (column[mine] // block == senders.column[sender]).all()
        assert (cornell_atlas.chart[mine] == senders.chart[sender]).all()
    if block == 1:
        assert len(senders.area) == cornell_atlas.count


# --- the cache of unwraps ---------------------------------------------------------------------------------------------


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DDPRT_CACHE", str(tmp_path))
    return tmp_path


def test_the_second_unwrap_comes_from_the_cache(own_cache: Path, cornell: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    uv, chart = unwrapping.unwrap(cornell, 32, 2)
    assert len(os.listdir(own_cache)) == 1
    monkeypatch.setattr(unwrapping, "_unwrap", None)
    again, same = unwrapping.unwrap(cornell, 32, 2)
    np.testing.assert_array_equal(uv, again)
    np.testing.assert_array_equal(chart, same)
    with pytest.raises(TypeError):
        unwrapping.unwrap(cornell, 33, 2)  # another resolution is another entry


@pytest.mark.parametrize("damage", [b"", b"garbage", "half", "flip"])
def test_a_damaged_cache_is_made_anew(own_cache: Path, cornell: Scene, damage: bytes | str) -> None:
    uv, chart = unwrapping.unwrap(cornell, 32, 2)
    (path,) = own_cache.iterdir()
    whole = path.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    path.write_bytes({"half": whole[:middle], "flip": flipped}.get(damage, damage))
    again, same = unwrapping.unwrap(cornell, 32, 2)
    np.testing.assert_array_equal(uv, again)
    np.testing.assert_array_equal(chart, same)
    assert len(path.read_bytes()) == len(whole)
    assert len(os.listdir(own_cache)) == 1


def test_a_cache_that_cannot_be_written_costs_only_time(
    tmp_path: Path, cornell: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DDPRT_CACHE", str(tmp_path / "file" / "cache"))
    uv, _ = unwrapping.unwrap(cornell, 32, 2)
    assert uv.shape == (30, 3, 2)


def test_too_few_texels_are_refused() -> None:
    with pytest.raises(UserError, match=r"atlas.resolution: got 8, expected more .* raise .* or lower atlas.padding"):
        build_atlas(build("cornell-hole"), 8, 8)


# --- scale and place --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "offset"),
    [
        (2.0**-20, (0, 0, 0)),
        (2.0**20, (0, 0, 0)),
        (1e-6, (0, 0, 0)),
        (1e6, (0, 0, 0)),
        (1, (1e4, -1e4, 500)),
        (1, (0.1, 0.2, 0.3)),
    ],
)
def test_scale_and_place_do_not_change_the_atlas(
    cornell: Scene, cornell_atlas: Atlas, factor: float, offset: tuple[float, float, float]
) -> None:
    atlas = build_atlas(moved(cornell, factor, offset), 64)
    # Centred and scaled corners differ by a rounding of float32 (6e-8), which the density's bisection (1e-4) may magnify
    # into another of its steps: 64 texels * 1e-4.
    np.testing.assert_allclose(atlas.uv * 64, cornell_atlas.uv * 64, atol=0.0064)
    np.testing.assert_array_equal(atlas.chart[:10], cornell_atlas.chart[:10])
    assert atlas.area.sum() == pytest.approx(cornell_atlas.area.sum() * factor**2, rel=1e-9)
