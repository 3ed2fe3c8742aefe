"""Rays in packets: what embreex answers one by one, bit by bit, whatever the rays, their number and the width of a packet."""

import ctypes
import gc
import platform
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import as_strided

from ddprt.errors import UserError
from ddprt.transport import packets
from ddprt.transport.packets import FAR, Geometry, embree

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]


class OneByOne:
    """Triangles as embreex traces them."""

    def __init__(self, corners: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        index = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
        self._mesh = TriangleMesh(self._scene, corners.reshape(-1, 3), index)

    def first(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        distances = None if reach is None else reach.copy()
        found = self._scene.run(origins, directions, dists=distances, query="INTERSECT", output=True)
        return found["primID"], found["u"], found["v"], found["tfar"]

    def unoccluded(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> np.ndarray:
        return self._scene.run(origins, directions, dists=reach.copy(), query="OCCLUDED")


def soup(triangles: int, seed: int) -> np.ndarray:
    """Random triangles, at random places, the size of which falls with their number."""
    rng = np.random.default_rng(seed)
    size = triangles ** (-1 / 3)
    return (rng.uniform(-1, 1, (triangles, 1, 3)) + size * rng.normal(size=(triangles, 3, 3))).astype(np.float32)


def random_rays(count: int, seed: int) -> Rays:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins, reach = rng.uniform(-1, 1, (count, 3)), rng.uniform(0, 2, count)
    return origins.astype(np.float32), directions.astype(np.float32), reach.astype(np.float32)


def bad_rays(count: int, seed: int) -> Rays:
    """One in five with a number that no ray should have."""
    rng = np.random.default_rng(seed)
    rays = random_rays(count, seed)
    bad = np.array([np.nan, np.inf, -np.inf, 0, -0.0, 1e38, -1e38, 1e-45, 3e-39, -1], np.float32)
    for array in rays:
        chosen = rng.integers(0, array.size, array.size // 30 if array.ndim == 2 else array.size // 10)
        array.ravel()[chosen] = rng.choice(bad, len(chosen))
    rays[1][: count // 100] = 0
    return rays


def grid_rays(count: int, seed: int) -> Rays:
    """Towards edges and corners of `squares`."""
    rng = np.random.default_rng(seed)
    target = np.stack([rng.integers(-4, 5, count) / 4, rng.integers(-4, 5, count) / 4, np.zeros(count)], 1)
    along = rng.integers(0, 3, count)
    target[along == 1, 0] += rng.random((along == 1).sum()) / 4
    target[along == 2, :2] += (rng.random((along == 2).sum()) / 4)[:, None]
    origins = rng.uniform([-1, -1, 1], [1, 1, 3], (count, 3))
    directions = target - origins
    reach = np.linalg.norm(directions, axis=1)
    return origins.astype(np.float32), (directions / reach[:, None]).astype(np.float32), (1.01 * reach).astype(np.float32)


def squares() -> np.ndarray:
    """A plane of eight by eight squares, each of two triangles."""
    x, y = np.meshgrid(np.arange(-4, 4) / 4, np.arange(-4, 4) / 4)
    corner = np.stack([x.ravel(), y.ravel(), np.zeros(64)], 1)[:, None]
    both = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]]) / 4
    return np.concatenate([corner + each for each in both]).astype(np.float32)


def agree(corners: np.ndarray, rays: Rays, traced: Geometry | None = None, doubtful: np.ndarray | None = None) -> np.ndarray:
    """Asserts equal bits, but for shadow rays that are `doubtful`; returns which rays see their end."""
    one, other = OneByOne(corners), traced or Geometry(corners)
    origins, directions, reach = rays
    for limit in (None, reach):
        expected = one.first(origins, directions, limit)
        found = other.first(origins, directions, None if limit is None else limit.copy())
        hit = expected[0] >= 0
        np.testing.assert_array_equal(found[0], expected[0])
        for mine, theirs in zip(found[1:3], expected[1:3], strict=True):
            np.testing.assert_array_equal(mine[hit], theirs[hit])
            assert not mine[~hit].any()
        np.testing.assert_array_equal(found[3], expected[3])
    seen = other.unoccluded(origins, directions, reach) != 0
    differs = seen != (one.unoccluded(origins, directions, reach) != 0)
    assert not (differs if doubtful is None else differs & ~doubtful).any()
    return seen


@pytest.mark.parametrize("triangles", [1, 2, 50, 5000, 100_000])
def test_random_scenes(triangles: int) -> None:
    seen = agree(soup(triangles, triangles), random_rays(100_000, 1)).sum()
    assert min(seen, 100_000 - seen) > 50


def from_the_rim(rays: Rays) -> np.ndarray:
    """How far within the plane, metres, `grid_rays` meet it; less than 0 beyond its end."""
    return 1 - np.abs(rays[0] + rays[1] * (rays[2] / np.float32(1.01))[:, None])[:, :2].max(1)


def test_edges_let_almost_nothing_through() -> None:
    """Within a surface packets know no other gaps than single rays; at its rim alone rounding decides, one way or the other."""
    corners, rays = squares(), grid_rays(200_000, 2)
    inside = from_the_rim(rays)
    seen = agree(corners, rays, doubtful=np.abs(inside) < 1e-5)
    assert seen[inside < -1e-5].all()
    assert (inside > 1e-5).sum() > 100_000
    # Embree's robust scenes are not quite tight: 3 in some 5 million such rays passed, by embreex as well. That more than three
    # of these do has a chance of 1e-5 at that rate.
    assert seen[inside > 1e-5].sum() <= 3


def test_rays_that_are_none() -> None:
    """They get embreex's answers, and spoil nobody else's."""
    corners, rays = soup(2000, 3), bad_rays(50_000, 3)
    agree(corners, rays)
    good = np.isfinite(np.concatenate([rays[0], rays[1]], 1)).all(1)
    assert 0.5 < good.mean() < 0.95
    alone, together = Geometry(corners), Geometry(corners)
    chosen = [np.ascontiguousarray(array[good]) for array in rays]
    for mine, theirs in zip(alone.first(*chosen[:2]), together.first(*rays[:2]), strict=True):
        np.testing.assert_array_equal(mine, theirs[good])
    np.testing.assert_array_equal(alone.unoccluded(*chosen), together.unoccluded(*rays)[good])


def of_width(width: int, monkeypatch: pytest.MonkeyPatch, corners: np.ndarray) -> Geometry:
    """On the usual device, but with packets of another width."""
    usual = embree()
    where = [
        ctypes.cast(getattr(usual.calls, f"rtc{name}{width}"), ctypes.c_void_p).value for name in ("Intersect", "Occluded")
    ]
    changed = replace(usual, width=width, intersect=where[0], occluded=where[1])
    with monkeypatch.context() as patch:
        patch.setattr(packets, "embree", lambda: changed)
        return Geometry(corners)


@pytest.mark.parametrize("width", [4, 8, 16])
def test_every_width_of_a_packet(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for corners, rays in ((soup(3000, 4), random_rays(30_003, 4)), (squares(), grid_rays(30_003, 5))):
        agree(corners, rays, of_width(width, monkeypatch, corners), np.abs(from_the_rim(rays)) < 1e-5)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names instruction sets of x86")
def test_processors_that_take_fewer_rays_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other instructions round otherwise: hits are the same but next to edges and to where two triangles cross."""
    corners, rays = soup(3000, 6), random_rays(100_000, 6)
    triangle, u, _, distance = Geometry(corners).first(*rays[:2])
    for settings, width in ((b"isa=avx2", 8), (b"isa=sse4.2", 4)):
        older = embree(settings)
        assert older.width == width
        with monkeypatch.context() as patch:
            patch.setattr(packets, "embree", lambda older=older: older)
            found = Geometry(corners).first(*rays[:2])
        same = found[0] == triangle
        # A weight is a ratio of two areas of triangles some 0.07 wide, from differences of numbers up to 2 that are rounded to
        # 2^-24: about 1e-5, so that each of three edges is doubtful for the share 1e-5 of rays, and twice that with crossings.
        assert (~same).sum() <= 6
        hit = same & (triangle >= 0)
        assert np.median(np.abs(found[1] - u)[hit]) < 1e-6
        assert np.median(np.abs(found[3] - distance)[hit]) < 1e-6


def test_every_number_of_rays() -> None:
    """Packets that are not full: the answers of the first rays of many, and nothing written behind them."""
    geometry, rays = Geometry(soup(300, 7)), random_rays(40, 7)
    whole, seen = geometry.first(*rays[:2]), geometry.unoccluded(*rays)
    assert 5 < (whole[0] >= 0).sum() < 35
    assert 5 < (seen != 0).sum() < 35
    for count in range(34):
        for mine, theirs in zip(geometry.first(rays[0][:count], rays[1][:count]), whole, strict=True):
            np.testing.assert_array_equal(mine, theirs[:count])
        np.testing.assert_array_equal(geometry.unoccluded(*(array[:count] for array in rays)), seen[:count])
        reach = np.full(40, FAR, np.float32)
        distance = geometry.first(rays[0][:count], rays[1][:count], reach[:count])[3]
        assert np.shares_memory(distance, reach) or not count
        np.testing.assert_array_equal(reach, np.where(np.arange(40) < count, whole[3], np.float32(FAR)))


def test_what_is_left_of_a_packet_is_not_traced() -> None:
    rays, packet = random_rays(19, 7), packets._packet(8)
    assert [packets._load(packet, first, *rays) for first in (0, 8, 16)] == [8, 8, 3]
    assert packet[packets._VALID].view(np.int32).tolist() == [-1] * 3 + [0] * 5


def test_shadow_rays_leave_their_reach_as_it_is() -> None:
    rays = random_rays(1000, 8)
    before = rays[2].copy()
    Geometry(soup(300, 8)).unoccluded(*rays)
    np.testing.assert_array_equal(rays[2], before)


def test_nothing_to_hit() -> None:
    rays = random_rays(20, 9)
    geometry = Geometry(np.zeros((0, 3, 3), np.float32))
    triangle, _, _, distance = geometry.first(*rays[:2])
    assert (triangle == -1).all()
    assert (distance == np.float32(FAR)).all()
    assert geometry.unoccluded(*rays).all()


@pytest.mark.parametrize("width", [4, 8, 16])
def test_packets_begin_at_a_cache_line(width: int) -> None:
    kept = []
    for size in range(64):
        kept += [np.empty(size + 1, np.int8), packets._packet(width)]
        assert kept[-1].ctypes.data % 64 == 0
        assert kept[-1].shape == (22, width)


def test_many_threads_trace_one_scene() -> None:
    geometry, rays = Geometry(soup(5000, 10)), random_rays(64_000, 10)
    whole, seen = geometry.first(*rays[:2]), geometry.unoccluded(*rays)

    def work(part: int) -> tuple[np.ndarray, ...]:
        mine = [array[1000 * part : 1000 * (part + 1)] for array in rays]
        return *geometry.first(*mine[:2]), geometry.unoccluded(*mine)

    with ThreadPoolExecutor(16) as pool:
        parts = list(pool.map(work, [part for _ in range(4) for part in range(64)]))
    for index, expected in enumerate([*whole, seen]):
        np.testing.assert_array_equal(np.concatenate([part[index] for part in parts]), np.tile(expected, 4))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_memory_goes_with_the_object() -> None:
    corners = soup(5000, 11)

    def resident() -> float:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

    def build(scenes: int) -> None:
        for _ in range(scenes):
            Geometry(corners)

    build(50)
    before = resident()
    build(400)
    # Embree's copies of corners and indices alone are 48 bytes per triangle, which would be 92 MiB in all.
    assert resident() - before < 9


def test_what_embree_refuses_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(packets, "_THREE_FLOATS", 0)
        with pytest.raises(
            UserError, match=r"^Embree: got error 3 \(invalid vertex buffer format\), expected a buffer of 9 rows; "
        ):
            Geometry(soup(3, 12))
    geometry = Geometry(soup(3, 12))  # an error is told once
    huge = as_strided(np.zeros((1, 3), np.float32), (1 << 44, 3), (12, 4))
    mesh = embree().calls.rtcNewGeometry(embree().device, packets._TRIANGLES)
    with pytest.raises(UserError, match=r"got error 2 \(buffer too large\), expected a buffer of 17592186044416 rows"):
        geometry._fill(mesh, packets._VERTEX, packets._THREE_FLOATS, huge)
    embree().calls.rtcReleaseGeometry(mesh)
    with pytest.raises(UserError, match=r"^Embree: got error 1 \(.*integer expected\), expected a device; "):
        embree(b"threads=many")


def test_another_library_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(packets._FUNCTIONS, "rtcOfTomorrow", (None,))
    with pytest.raises(
        UserError, match=r"^embreex: got .*rtcOfTomorrow.*, expected Embree 4.4; pip install embreex==4.4.0.post1"
    ):
        embree(b"verbose=0")  # settings that nobody has asked for yet


def test_doctor_tells_what_is_in_use() -> None:
    from ddprt.pipeline_inspect import checkup

    assert f"Embree {embree().version}, {embree().width} rays at a time" in checkup()[0]
