"""Sheets without thickness: rays meet the side that they come from, and nothing else changes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ddprt.scene.library import build
from ddprt.scene.shapes import box, hollow, icosphere
from ddprt.scene.sheets import back_to_back
from ddprt.transport.embree import Tracer

Triangles = NDArray[np.float64]
TILT = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def sheet(squares: int) -> Triangles:
    """A square from -1 to 1 in the plane y = 0, cut into twice as many triangles as squares, facing up."""
    line = np.linspace(-1, 1, squares + 1)
    x, z = np.meshgrid(line, line, indexing="ij")
    place = np.stack([x, 0 * x, z], -1)
    a, b, c, d = place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1]
    return np.concatenate([np.stack(part, -2).reshape(-1, 3, 3) for part in ((a, b, c), (a, c, d))])


def halved(quads: Triangles) -> Triangles:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def two_sides(one: int = 7, other: int = 5) -> Triangles:
    return np.concatenate([sheet(one), sheet(other)[:, ::-1]])


def backs_met(corners: Triangles, towards: Triangles, rays: int = 20_000) -> int:
    """Rays from about `towards`, at both sides of the sheet through it, that meet its back or nothing."""
    tracer, rng = Tracer(corners), np.random.default_rng(0)
    normal = tracer.normals[0].astype(np.float64)
    target = towards[0] + rng.uniform(-0.4, 0.4, (rays, 2)) @ towards[1:]
    origin = target + rng.choice([-1, 1], (rays, 1)) * normal + rng.uniform(-0.3, 0.3, (rays, 2)) @ towards[1:]
    along = target - origin
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    hits = tracer.closest((origin - tracer.centre).astype(np.float32), along.astype(np.float32))
    return int(np.count_nonzero(~hits.front))


@pytest.mark.parametrize("turn", [np.eye(3), TILT], ids=["level", "tilted"])
@pytest.mark.parametrize("away", [0.0, 1e5])
@pytest.mark.parametrize("cuts", [(7, 5), (1, 40), (3, 3)])
def test_both_sides_of_a_sheet_are_met_from_their_fronts(turn: Triangles, away: float, cuts: tuple[int, int]) -> None:
    plane = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]) @ turn.T + [[away], [0], [0]]
    assert backs_met(two_sides(*cuts) @ turn.T + away, plane) == 0


def test_receivers_stay_before_their_own_side() -> None:
    """Straight down from where rays start lies the triangle itself, at half the offset."""
    tracer = Tracer(two_sides() @ TILT.T)
    middle = tracer.corners.mean(1)
    hits = tracer.closest(middle + tracer.offset * tracer.normals, -tracer.normals)
    np.testing.assert_array_equal(hits.triangle, np.arange(len(middle)))
    assert hits.front.all()
    # Rounding of coordinates up to a radius, several times: origin, normal, shifted corners and Embree's own.
    np.testing.assert_allclose(hits.distance, tracer.offset / 2, atol=8 * 2.0**-24 * tracer.radius)
    np.testing.assert_allclose([hits.u, hits.v], 1 / 3, atol=1e-4)


def test_doubled_walls_of_a_room_are_met_from_inside() -> None:
    """A room in a box of the same size: walls cut along the other diagonal."""
    inner = halved(hollow(np.ones((1, 1, 1), bool), *(np.array([-1.0, 1.0]),) * 3))
    outer = halved(np.roll(box(-np.ones(3), np.ones(3)), 1, axis=1))
    tracer = Tracer(np.concatenate([inner, outer]))
    directions = np.random.default_rng(0).normal(size=(50_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = tracer.closest(np.zeros(directions.shape, np.float32), directions.astype(np.float32))
    assert hits.front.all()
    assert (hits.triangle < len(inner)).all()


@pytest.mark.parametrize("name", ["cornell", "corridor", "furnace", "plates", "convex", "statue"])
def test_scenes_without_sheets_keep_every_coordinate(name: str) -> None:
    corners = Tracer.of(build(name)).corners.astype(np.float64)
    assert not back_to_back(corners, 2e-6).any()


def test_what_is_no_sheet() -> None:
    one, other = sheet(3), sheet(4)[:, ::-1]
    assert not back_to_back(np.concatenate([one, other - [0, 1e-3, 0]]), 1e-4).any()  # it has thickness
    assert not back_to_back(np.concatenate([one, other[:, ::-1]]), 1e-4).any()  # both face the same way
    assert not back_to_back(np.concatenate([one, other + np.array([2, 0, 0])]), 1e-4).any()  # they share an edge alone
    wedge = np.array([[[0.0, 0, 0], [0, 0, 1], [1, 0, 0]], [[0, 0, 0], [1, 0.01, 0], [0, 0, 1]]])
    assert not back_to_back(wedge, 1e-4).any()


def test_only_what_lies_on_another_is_found() -> None:
    """A tile upside down in the middle of a floor, and a box that stands on it."""
    floor, tile = sheet(10), 0.15 * sheet(1)[:, ::-1]
    found = back_to_back(np.concatenate([floor, tile]), 1e-6)
    reach = np.abs(floor[..., [0, 2]]).max(1)
    assert found[len(floor) :].all()
    assert not found[: len(floor)][(reach > 0.41).any(1)].any()
    assert found[: len(floor)].sum() >= 8


def one_by_one(corners: Triangles, tolerance: float) -> NDArray[np.bool_]:
    """The slow twin for level triangles: they overlap unless one of their edges parts them."""

    def parted(one: Triangles, other: Triangles) -> bool:
        for triangle in (one, other):
            for k in range(3):
                edge = triangle[(k + 1) % 3] - triangle[k]
                across = np.array([edge[2], 0, -edge[0]]) / np.linalg.norm(edge)
                if (
                    min((one @ across).max(), (other @ across).max()) - max((one @ across).min(), (other @ across).min())
                    < tolerance
                ):
                    return True
        return False

    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1] > 0
    found = np.zeros(len(corners), bool)
    for i in range(len(corners)):
        for j in range(i):
            if up[i] != up[j] and abs(corners[i, 0, 1] - corners[j, 0, 1]) <= tolerance and not parted(corners[i], corners[j]):
                found[[i, j]] = True
    return found


@pytest.mark.parametrize("seed", range(4))
def test_the_search_agrees_with_its_slow_twin(seed: int) -> None:
    """Triangles of many sizes on three floors, some overlapping, some not, turned any way as a whole."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-2, 0, (80, 1, 1))
    corners = rng.uniform(-1, 1, (80, 1, 3)) + size * rng.normal(size=(80, 3, 3))
    corners[..., 1] = rng.choice([-0.5, 0, 0.003], (80, 1))
    expected = one_by_one(corners, 1e-6)
    assert 10 < expected.sum() < 75
    np.testing.assert_array_equal(back_to_back(corners, 1e-6), expected)
    np.testing.assert_array_equal(back_to_back(corners @ TILT.T, 1e-6), expected)


def test_planes_are_known_as_well_as_their_corners() -> None:
    """Small sheets everywhere: rounding to float32 tilts a side of height w by 1e-7 / w, and moves its plane by 5e-7 / w."""
    rng = np.random.default_rng(0)
    side = np.array([[0.0, 0, 0], [0, 0, 1e-3], [1e-3, 0, 0]])
    turns = np.linalg.qr(rng.normal(size=(2000, 3, 3)))[0]
    places = rng.uniform(-0.5, 0.5, (2000, 1, 3))
    up, down = (place @ turns.swapaxes(1, 2) + places for place in (side, 0.9 * side[::-1] + [1e-5, 0, 1e-5]))
    corners = np.concatenate([up, down]).astype(np.float32).astype(np.float64)
    assert back_to_back(corners, 2e-6).all()


def test_a_large_sheet_takes_no_longer_than_its_triangles() -> None:
    """No figure of time: pairs looked at would be 4e8 if every triangle met every other."""
    directions, outward = icosphere(5)
    assert not back_to_back(directions[outward], 1e-6).any()
    assert back_to_back(two_sides(100, 99), 1e-6).all()
