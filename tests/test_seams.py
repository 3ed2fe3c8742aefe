"""Seams: both sides filter to the same, linearly, by the least squares that a slow twin solves densely."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.export.seams import PULL, Seams, Stitcher, find_seams
from ddprt.export.textures import export_textures
from ddprt.runtime.model import Model
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.exr import read_exr
from ddprt.scene.gutter import fill_gutter
from ddprt.scene.mesh import Scene

LOW = np.array([[2.5, 2.5], [7.5, 2.5], [7.5, 7.5], [2.5, 7.5]])  # a quad on a 20 x 20 atlas, in texels: its edges on centres
STATUE = 64


def sheet(bend_deg: float = 0.0, *, length: float = 1.0) -> np.ndarray:
    """Triangle corners of two quads that meet on the z axis, 1 m wide; the second is bent up by an angle."""
    across, up = math.cos(math.radians(bend_deg)), math.sin(math.radians(bend_deg))
    first = np.array([[-1, 0, 0], [0, 0, 0], [0, 0, length], [-1, 0, length]])
    second = np.array([[0, 0, 0], [across, up, 0], [across, up, length], [0, 0, length]])
    return cut(first, second)


def cut(*quads: np.ndarray) -> np.ndarray:
    """Two triangles of each quad."""
    return np.concatenate([quad[[[0, 1, 2], [0, 2, 3]]] for quad in quads]).astype(float)


def chart(angle_deg: float, size: float, x: float, y: float) -> np.ndarray:
    """The quad `LOW` turned about the origin, scaled and shifted, in texels."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return size * LOW @ np.array([[c, s], [-s, c]]) + np.array([x, y])


@pytest.fixture
def known() -> np.ndarray:
    return np.ones((20, 20), bool)


@pytest.fixture
def oblique() -> np.ndarray:
    """Charts of the sheet at different angles and sizes, with nothing on the texel grid."""
    return cut(chart(20, 1, 1.0, 1.3), chart(-35, 0.8, 9.3, 10.6)) / 20


@pytest.mark.parametrize("pull", [0.001, 0.01, 1.0])
def test_a_seam_of_one_texel_has_a_closed_form(pull: float, known: np.ndarray) -> None:
    """An edge from centre to centre filters two texels a side.

    With e the step of each, the d - 2 e left between the sides costs (d - 2 e)² over one texel of length and the steps cost
    4 pull e² in all: 2 e = d / (1 + pull), and pull / (1 + pull) of the difference is left.
    """
    uv = cut(LOW, chart(0, 1, 10, 8))
    uv[..., 1] = np.where(uv[..., 1] == 7.5, 3.5, np.where(uv[..., 1] == 15.5, 11.5, uv[..., 1]))  # one texel high
    stitcher = Stitcher(find_seams(sheet(), uv / 20, known), pull)
    image = np.full((20, 20, 1), 3.0)
    image[9:] = 5.0  # the second chart
    closed = stitcher.stitch(image)
    np.testing.assert_array_equal(stitcher.texels, [2 * 20 + 7, 3 * 20 + 7, 10 * 20 + 12, 11 * 20 + 12])
    np.testing.assert_allclose(closed[2:4, 7], 3 + 1 / (1 + pull), rtol=1e-12)
    np.testing.assert_allclose(closed[10:12, 12], 5 - 1 / (1 + pull), rtol=1e-12)
    np.testing.assert_allclose(stitcher.mismatch(image), 2, rtol=1e-12)
    np.testing.assert_allclose(stitcher.mismatch(closed), 2 * pull / (1 + pull), rtol=1e-10)
    untouched = np.setdiff1d(np.arange(400), stitcher.texels)
    np.testing.assert_array_equal(closed.reshape(-1)[untouched], image.reshape(-1)[untouched])


@pytest.mark.parametrize("pull", [0.001, 0.01, 0.1])
def test_both_sides_agree_as_well_as_the_pull_lets_them(pull: float, known: np.ndarray, oblique: np.ndarray) -> None:
    """The optimum costs no more than both charts at the middle, pull * texels * (d / 2)²: that bounds what is left."""
    stitcher = Stitcher(find_seams(sheet(), oblique, known), pull)
    image = np.full((20, 20, 1), 3.0)
    image[:, 10:] = 5.0
    np.testing.assert_allclose(gap(image, oblique), -2, rtol=1e-12)
    bound = np.sqrt(pull * len(stitcher.texels) / stitcher.seams.length.sum())
    left = gap(stitcher.stitch(image), oblique)
    assert np.sqrt(np.mean(left**2)) <= 1.05 * bound  # the edge is walked here at other places than it was sampled


def gap(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """First side of the sheet's cut less the second."""
    return along(image, 20 * uv[0, 1], 20 * uv[0, 2]) - along(image, 20 * uv[2, 0], 20 * uv[3, 2])


def along(image: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """An image filtered at places of an edge."""
    return np.array([filtered(image, start + t * (end - start)) for t in np.linspace(0, 1, 101)])


def filtered(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Bilinear lookup as graphics interfaces define it: texel centres at one half."""
    return sum(share * image[row, column] for row, column, share in taps(place, *image.shape[:2]))


def taps(place: np.ndarray, height: int, width: int) -> Iterator[tuple[int, int, float]]:
    """Row, column and weight of the four texels about a place."""
    x, y = place - 0.5
    for column in (math.floor(x), math.floor(x) + 1):
        for row in (math.floor(y), math.floor(y) + 1):
            share = (1 - abs(x - column)) * (1 - abs(y - row))
            yield min(max(row, 0), height - 1), min(max(column, 0), width - 1), share


def slowly(
    corners: np.ndarray, uv: np.ndarray, image: np.ndarray, pull: float, crease_deg: float = 30.0
) -> tuple[np.ndarray, int]:
    """Twin: edges by comparing all, one row of a dense matrix per sample, solved by SVD; the image and the number of edges."""
    height, width, channels = image.shape
    rows, found = [], 0
    normal = [np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a)) for a, b, c in corners]
    for t in range(len(corners)):
        for u in range(t):
            for k in range(3):
                for j in range(3):
                    p, q = corners[t][k], corners[t][(k + 1) % 3]
                    if not (np.array_equal(p, corners[u][(j + 1) % 3]) and np.array_equal(q, corners[u][j])):
                        continue
                    here, there = uv[t][[k, (k + 1) % 3]], uv[u][[(j + 1) % 3, j]]
                    here, there = here * [width, height], there * [width, height]
                    bent = math.degrees(math.acos(min(1.0, float(normal[t] @ normal[u]))))
                    if bent > crease_deg or np.abs(here - there).max() < 1e-3:
                        continue
                    found += 1
                    length = max(math.dist(*here), math.dist(*there))
                    count = math.ceil(4 * length)
                    for i in range(count):
                        row = np.zeros((height, width))
                        for side, sign in ((here, 1), (there, -1)):
                            for y, x, share in taps(side[0] + (i + 0.5) / count * (side[1] - side[0]), height, width):
                                row[y, x] += sign * share
                        rows.append(math.sqrt(length / count) * row.ravel())
    given = image.reshape(-1, channels)
    demands = np.concatenate([np.array(rows), math.sqrt(pull) * np.eye(height * width)])
    wanted = np.concatenate([np.zeros((len(rows), channels)), math.sqrt(pull) * given])
    return np.linalg.lstsq(demands, wanted, rcond=None)[0].reshape(image.shape), found


@pytest.mark.parametrize("bend_deg", [0.0, 25.0])
def test_twin_by_dense_least_squares(bend_deg: float, known: np.ndarray, oblique: np.ndarray) -> None:
    image = np.random.default_rng(1).normal(size=(20, 20, 3))
    stitcher = Stitcher(find_seams(sheet(bend_deg), oblique, known))
    expected, edges = slowly(sheet(bend_deg), oblique, image, PULL)
    assert stitcher.seams.edges == edges == 1
    np.testing.assert_allclose(stitcher.stitch(image), expected, atol=1e-9)


def test_twin_on_a_closed_surface(known: np.ndarray) -> None:
    """A folded strip of many charts, some sharing an edge on the atlas, some at its border."""
    rng = np.random.default_rng(2)
    angles = np.radians(np.arange(0, 360, 24))
    low, high = (np.stack([np.cos(angles), np.full(15, height), np.sin(angles)], 1) for height in (0.0, 1.0))
    quads = np.stack([low, high, np.roll(high, -1, 0), np.roll(low, -1, 0)], 1)
    places = [chart(*rng.uniform([-180, 0.3, 5, 5], [180, 0.5, 15, 15])) for _ in quads]
    places[4] = places[3] + places[3][3] - places[3][0]
    places[0] -= places[0].min(0)
    corners, uv = cut(*quads), cut(*places) / 20
    image = rng.normal(size=(20, 20, 2))
    stitcher = Stitcher(find_seams(corners, uv, known))
    expected, edges = slowly(corners, uv, image, PULL)
    assert stitcher.seams.edges == edges == 14
    np.testing.assert_allclose(stitcher.stitch(image), expected, atol=1e-9)


def test_stitching_is_linear_and_keeps_constants(known: np.ndarray, oblique: np.ndarray) -> None:
    one, two = np.random.default_rng(3).normal(size=(2, 20, 20, 4))
    stitch = Stitcher(find_seams(sheet(), oblique, known)).stitch
    np.testing.assert_allclose(stitch(one + 2 * two), stitch(one) + 2 * stitch(two), atol=1e-12)
    constant = np.full((20, 20, 1), 0.7)
    np.testing.assert_allclose(stitch(constant), constant, rtol=1e-14)
    single = one.astype(np.float32)
    assert stitch(single).dtype == np.float32
    np.testing.assert_allclose(stitch(single), stitch(one), atol=1e-6)


def test_creases_and_charts_that_hang_together_are_left_alone(known: np.ndarray, oblique: np.ndarray) -> None:
    assert find_seams(sheet(29), oblique, known).edges == 1
    assert find_seams(sheet(31), oblique, known).edges == 0
    assert find_seams(sheet(90), oblique, known).edges == 0
    assert find_seams(sheet(90), oblique, known, crease_deg=91.0).edges == 1
    assert find_seams(sheet(), cut(LOW, chart(0, 1, 5, 0)) / 20, known).edges == 0
    back, uv = sheet(), oblique.copy()
    back[2:], uv[2:] = back[2:, ::-1], uv[2:, ::-1]  # fronts on opposite sides
    assert find_seams(back, uv, known).edges == 0
    image = np.random.default_rng(4).normal(size=(20, 20, 3))
    bent = Stitcher(find_seams(sheet(90), oblique, known))
    np.testing.assert_array_equal(bent.stitch(image), image)
    np.testing.assert_array_equal(bent.mismatch(image), 0)


def test_sheets_back_to_back_keep_to_their_own_side(known: np.ndarray, oblique: np.ndarray) -> None:
    """Four triangles at one edge, two fronts and two backs: two seams, and none through the sheet."""
    corners = np.concatenate([sheet(), sheet()[:, ::-1]])
    uv = np.concatenate([oblique, oblique[:, ::-1, ::-1]])
    assert find_seams(corners, uv, known).edges == 2


def test_texels_of_nothing_take_no_part(known: np.ndarray, oblique: np.ndarray) -> None:
    whole = find_seams(sheet(), oblique, known)
    row, column = np.divmod(int(whole.texel[0, np.argmax(whole.weight[0])]), 20)
    known[row, column] = False
    part = find_seams(sheet(), oblique, known)
    assert 0 < len(part.length) < len(whole.length)
    assert row * 20 + column not in Stitcher(part).texels
    nothing: Seams = find_seams(sheet(), oblique, np.zeros_like(known))
    image = np.ones((20, 20, 1))
    np.testing.assert_array_equal(Stitcher(nothing).stitch(image), image)


def test_what_has_no_area_on_the_atlas_has_no_seams(known: np.ndarray, oblique: np.ndarray) -> None:
    oblique[2:] = 0
    assert find_seams(sheet(), oblique, known).edges == 0


@pytest.fixture(scope="module")
def baked(statue: Scene) -> Dataset:
    changes = {"atlas.resolution": str(STATUE), "lightings.train": "10", "lightings.validation": "2", "lightings.test": "2"}
    changes |= {"points.count": "16", "transport.samples": "64", "transport.test_samples": "64"}
    changes |= {"lightings.distribution": "around"}
    return ddprt.bake(statue, config=load_config(None, changes))


@pytest.fixture(scope="module")
def model(baked: Dataset) -> Model:
    return ddprt.fit(baked, bases=6, centre="mean")


@pytest.fixture(scope="module")
def atlas(statue: Scene) -> Atlas:
    return build_atlas(statue, STATUE)


def read(folder: Path) -> tuple[np.ndarray, dict]:
    """All textures at the scale they were learned at, and the manifest."""
    manifest = json.loads((folder / "manifest.json").read_text())
    layers = [read_exr(folder / name)[0] for name in manifest["layers"]]
    textures = np.concatenate(layers, 2)[..., : manifest["bases"]] * manifest["basis_scale"]
    return np.concatenate([textures, read_exr(folder / manifest["mean"])[0]], 2), manifest


def test_statue_is_stitched_at_export(model: Model, statue: Scene, atlas: Atlas, tmp_path: Path) -> None:
    """Every texture, and with them any relit map: seams close, texels away from them keep every bit of their value."""
    for name, stitch in (("raw", False), ("closed", True)):
        export_textures(model, tmp_path / name, precision="float", stitch=stitch)
    (raw, plain), (closed, told) = read(tmp_path / "raw"), read(tmp_path / "closed")
    assert plain["seams"] == {"stitched": False, "why": "export.stitch is false"}
    seams = told["seams"]
    assert seams["stitched"]
    known = fill_gutter(model.covered[..., None].astype(np.float32), model.covered, 4)[..., 0] > 0
    found = find_seams(statue.corners, atlas.uv, known)
    stitcher = Stitcher(found)
    assert (seams["edges"], seams["texels"]) == (found.edges, len(stitcher.texels))
    assert found.edges == 64, "as counted edge by edge in a loop"
    # Measured 14 to 26, texture by texture.
    assert (stitcher.mismatch(closed) * 10 < stitcher.mismatch(raw)).all()
    assert seams["difference_after"] * 10 < seams["difference_before"]
    away = np.setdiff1d(np.arange(STATUE**2), stitcher.texels)
    step = 2e-7 * np.abs(raw).max((0, 1))  # scaled and scaled back in float32
    assert (np.abs(closed - raw).reshape(STATUE**2, -1)[away] <= step).all()
    assert len(np.intersect1d(away, np.flatnonzero(model.covered))) > 0.8 * model.covered.sum()
    # Relighting commutes with stitching: the relit map of stitched textures is the stitched relit map.
    u = np.random.default_rng(5).normal(size=raw.shape[2])
    np.testing.assert_allclose(closed @ u, stitcher.stitch((raw @ u)[..., None])[..., 0], atol=1e-5 * np.abs(raw @ u).max())


def test_statue_seams_are_those_of_a_loop(statue: Scene, atlas: Atlas) -> None:
    sides: dict[tuple, tuple[int, np.ndarray]] = {}
    found = 0
    for t, corners in enumerate(statue.corners):
        for k in range(3):
            p, q = tuple(corners[k]), tuple(corners[(k + 1) % 3])
            sides[p, q] = t, atlas.uv[t, [k, (k + 1) % 3]]
            if (q, p) not in sides:
                continue
            u, there = sides[q, p]
            smooth = statue.geometric_normals[t] @ statue.geometric_normals[u] >= math.cos(math.radians(30))
            found += bool(smooth and np.abs(sides[p, q][1] - there[::-1]).max() > 1e-6)
    assert find_seams(statue.corners, atlas.uv, np.ones((STATUE, STATUE), bool)).edges == found == 64


def test_a_model_file_carries_the_coordinates(model: Model, atlas: Atlas, tmp_path: Path) -> None:
    model.save(tmp_path / "model")
    again = ddprt.load_model(tmp_path / "model")
    np.testing.assert_array_equal(again.uv, atlas.uv)
    for name, either in (("before", model), ("after", again)):
        export_textures(either, tmp_path / name)
    for path in (tmp_path / "before").iterdir():
        assert path.read_bytes() == (tmp_path / "after" / path.name).read_bytes()
    replace(model, uv=None).save(tmp_path / "old")
    assert ddprt.load_model(tmp_path / "old").uv is None
    replace(model, uv=atlas.uv[1:]).save(tmp_path / "odd")
    with pytest.raises(ddprt.UserError, match="do not fit together"):
        ddprt.load_model(tmp_path / "odd")


def test_export_says_why_it_did_not_stitch(model: Model, tmp_path: Path) -> None:
    for old, gutter, why in ((model, 0, "export.gutter is 0"), (replace(model, uv=None), 4, "imported without a mesh")):
        export_textures(old, tmp_path, gutter=gutter)
        seams = json.loads((tmp_path / "manifest.json").read_text())["seams"]
        assert not seams["stitched"]
        assert why in seams["why"]


def test_no_textures_have_no_seams(model: Model, tmp_path: Path) -> None:
    """A dark bake: no bases and no mean."""
    old = model.relighter
    none = {"matrix": old.matrix[:, :0], "intercept": old.intercept[:, :0], "basis": old.basis[:0], "mean": 0 * old.mean}
    export_textures(replace(model, relighter=replace(old, **none)), tmp_path)
    seams = json.loads((tmp_path / "manifest.json").read_text())["seams"]
    assert seams["stitched"]
    assert seams["difference_before"] == seams["difference_after"] == 0


def test_edges_of_a_room_stay(cornell: Scene, cornell_atlas: Atlas) -> None:
    assert find_seams(cornell.corners, cornell_atlas.uv, np.ones((64, 64), bool)).edges == 0
