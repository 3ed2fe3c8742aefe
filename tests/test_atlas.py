"""The lightmap: areas, places, conventions, senders, and the cache of unwraps."""

import os
from pathlib import Path

import numpy as np
import pytest
from oracles import chi_square, clipped_area

from ddprt.errors import UserError
from ddprt.scene import unwrap as unwrapping
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.scene.raster import rasterise

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
    senders = furnace_atlas.senders(8, np.ones(furnace_atlas.count, bool))
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


@pytest.mark.parametrize("resolution", [8, 16, 32, 64])
def test_senders(cornell_atlas: Atlas, resolution: int) -> None:
    senders = cornell_atlas.senders(resolution, np.ones(cornell_atlas.count, bool))
    block = 64 // resolution
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
    if resolution == 64:
        assert len(senders.area) == cornell_atlas.count


def test_senders_of_exposed_texels_alone(cornell_atlas: Atlas) -> None:
    exposed = cornell_atlas.position[:, 1] < 0.3
    senders = cornell_atlas.senders(16, exposed)
    assert ((senders.of_texel >= 0) == exposed).all()
    assert senders.area.sum() == pytest.approx(cornell_atlas.area[exposed].sum(), rel=1e-12)
    local, _ = senders.sampler.sample(np.arange(len(senders.area)), np.full((len(senders.area), 2), 0.5, np.float32))
    assert (local[:, 1] + cornell_atlas.centre[1] < 0.32).all()


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
    with pytest.raises(UserError, match=r"atlas.resolution: got 8, too small .* raise atlas.resolution or lower atlas.padding"):
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
