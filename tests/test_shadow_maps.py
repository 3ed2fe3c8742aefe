"""Shadow maps: closed forms of a lone plane, depth against rays, and shadows that come right with resolution."""

import numpy as np
import pytest

from ddprt.bench.budget.shadow_maps import ShadowMap, engine_irradiance
from ddprt.lights import parse_lighting
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure

POINT = {"type": "point", "position": [0.3, 1.1, -0.2], "intensity": [1, 2, 3]}
SPOT = {
    "type": "spot",
    "position": [0.2, 1.4, 0.1],
    "direction": [0.2, -1, 0.1],
    "intensity": [3, 2, 1],
    "inner_deg": 20,
    "outer_deg": 40,
}
WIDE = SPOT | {"inner_deg": 50, "outer_deg": 80}
SUN = {"type": "directional", "direction": [0.4, -1, 0.3], "irradiance": [1, 2, 3]}
SMALL = 1e-3
SPHERE = {"type": "sphere", "center": [0.3, 1.1, -0.2], "radius": SMALL, "radiance": [1e5, 1e5, 1e5]}
RECT = {
    "type": "rect",
    "center": [0.3, 1.1, -0.2],
    "half_u": [SMALL, 0, 0],
    "half_v": [0, 0, SMALL],
    "radiance": [1e5, 1e5, 1e5],
}
NO_SIZE = {"point": POINT, "spot": SPOT, "wide spot": WIDE, "sun": SUN}


def square(height: float, half: float) -> np.ndarray:
    """Two triangles that face up."""
    a, b, c, d = ([x, height, z] for x, z in ((-half, -half), (-half, half), (half, half), (half, -half)))
    return np.array([[a, b, c], [a, c, d]], float)


def floor(count: int = 400, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    at = np.random.default_rng(seed).uniform(-2, 2, (count, 3)) * [1, 0, 1]
    return at, np.tile([0.0, 1.0, 0.0], (count, 1))


@pytest.mark.parametrize("taps", [1, 2, 3, 6])
@pytest.mark.parametrize("resolution", [8, 64, 500])
@pytest.mark.parametrize("name", NO_SIZE)
def test_a_lone_plane_reads_the_exact_light(name: str, resolution: int, taps: int) -> None:
    """The bias is the bound of what a plane's own depth differs by within the filter: no acne at any resolution."""
    tracer, lighting, (at, up) = Tracer(square(0, 2)), parse_lighting(NO_SIZE[name]), floor()
    exact = measure(tracer, lighting, at, up, seed=0)
    ours = engine_irradiance(tracer, lighting, at, up, resolution=resolution, taps=taps)
    assert exact.any()
    # Both shade the same lifted float32 points: what differs is the order of a product of three.
    np.testing.assert_allclose(ours, exact, rtol=4 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("name", NO_SIZE)
def test_sunk_samples_read_the_exact_light(name: str) -> None:
    tracer, lighting, (at, up) = Tracer(square(0, 2)), parse_lighting(NO_SIZE[name]), floor()
    exact = measure(tracer, lighting, at, up, seed=0, depth=0.05)
    ours = engine_irradiance(tracer, lighting, at, up, resolution=64, taps=3, depth=0.05)
    # 2 a - b of float32 numbers of like size loses a few eps of the larger; the cone of a spot is left by the surface first,
    # where no shadow is known to either side.
    np.testing.assert_allclose(ours, exact, rtol=1e-5, atol=1e-6 * float(exact.max()))


@pytest.mark.parametrize("name", NO_SIZE)
def test_occluders_come_right_with_resolution(name: str) -> None:
    """Misjudged are points within about a texel of an edge, so their share falls as one over the resolution."""
    tracer = Tracer(np.concatenate([square(0, 2), square(0.6, 0.35)]))
    lighting, (at, up) = parse_lighting(NO_SIZE[name]), floor(4000)
    exact = measure(tracer, lighting, at, up, seed=0)[:, 0]
    shadowed = (exact == 0) & (engine_irradiance(Tracer(square(0, 2)), lighting, at, up, resolution=8, taps=1)[:, 0] > 0)
    assert shadowed.mean() > 0.005
    wrong = []
    for resolution in (16, 64, 256, 1024):
        ours = engine_irradiance(tracer, lighting, at, up, resolution=resolution, taps=1)[:, 0]
        wrong.append(float(np.mean(~np.isclose(ours, exact, rtol=1e-5))))
    assert wrong[0] > wrong[2]
    assert wrong[1] >= wrong[2] >= wrong[3]
    # 64 times the resolution leaves a sixty-fourth; 4000 points count a share p to sqrt(p / 4000), so a quarter is safe.
    assert wrong[3] < wrong[0] / 4
    assert wrong[3] < 0.01


@pytest.mark.parametrize("name", NO_SIZE)
def test_the_filter_gives_shares_of_its_taps(name: str) -> None:
    tracer = Tracer(np.concatenate([square(0, 2), square(0.6, 0.35)]))
    light = parse_lighting(NO_SIZE[name])[0].translated(-tracer.centre)
    at, up = floor(2000)
    lit = ShadowMap.of(tracer, light, 64).lit(at - tracer.centre, up, 3)
    assert ((lit > 0) & (lit < 1)).any()
    np.testing.assert_allclose(9 * lit, np.rint(9 * lit), atol=1e-12)  # counts of nine taps, in float64


@pytest.mark.parametrize("name", NO_SIZE)
def test_depth_is_that_of_rays(name: str, cornell: Scene) -> None:
    """A texel's depth times the length of its view is the distance that a ray through its centre goes."""
    tracer = Tracer.of(cornell)
    record = dict(NO_SIZE[name])
    record.pop("position", None)
    middle = (tracer.centre + np.array([0.02, 0.05, 0.01])).tolist()
    light = parse_lighting(record | ({} if name == "sun" else {"position": middle}))[0].translated(-tracer.centre)
    shadows = ShadowMap.of(tracer, light, 32)
    rng = np.random.default_rng(0)
    texels = np.stack([rng.integers(0, count, 200) for count in (len(shadows.axes), 32, 32)], 1)
    depth = shadows.depth(texels)
    for (face, column, row), ours in zip(texels, depth, strict=True):
        across, down, along = shadows.axes[face]
        x, y = (shadows.extent * ((2 * i + 1) / 32 - 1) for i in (column, row))
        start = shadows.place + (x * across + y * down if shadows.parallel else 0)
        way = along if shadows.parallel else along + x * across + y * down
        unit = way / np.linalg.norm(way)
        hit = tracer.closest(start[None].astype(np.float32), unit[None].astype(np.float32))
        expected = float(hit.distance[0]) / np.linalg.norm(way) if hit.triangle[0] >= 0 else np.inf
        # The same ray but for the rounding of its direction in float32: an eps of the distance over the slope it is met at.
        assert ours == pytest.approx(expected, rel=1e-4)


def test_lamps_of_little_size_are_their_centre() -> None:
    """Seen from a thousand radii or more away, light differs across a lamp by two radii over the distance at most: 2e-3."""
    tracer, (at, up) = Tracer(square(0, 2)), floor()
    for record in (SPHERE, RECT | {"half_v": [0, 0, SMALL], "half_u": [SMALL, 0, 0]}):
        lighting = parse_lighting(record)
        exact = measure(tracer, lighting, at, up, seed=0)
        ours = engine_irradiance(tracer, lighting, at, up, resolution=64, taps=3)
        np.testing.assert_allclose(ours, exact, rtol=2e-3)
    up_facing = parse_lighting(RECT | {"half_u": [0, 0, SMALL], "half_v": [SMALL, 0, 0]})
    down_facing = parse_lighting(RECT)
    lit = [engine_irradiance(tracer, one, at, up, resolution=64, taps=3).any() for one in (up_facing, down_facing)]
    assert sorted(lit) == [False, True]


def test_large_lamps_cast_hard_shadows() -> None:
    """What an engine misses of a lamp with size: the penumbra."""
    tracer = Tracer(np.concatenate([square(0, 2), square(0.6, 0.35)]))
    lighting, (at, up) = parse_lighting(SPHERE | {"radius": 0.3, "radiance": [1, 1, 1]}), floor(2000)
    exact = measure(tracer, lighting, at, up, seed=0)[:, 0]
    ours = engine_irradiance(tracer, lighting, at, up, resolution=256, taps=1)[:, 0]
    in_between = (exact > 0.1 * exact.max()) & (exact < 0.4 * exact.max())
    assert in_between.any()
    assert (ours == 0).mean() > (exact == 0).mean()


def test_a_mesh_is_asked_for_its_light_all_over() -> None:
    """A closed lamp shines to all sides; asked at one spot of one triangle it would be dark from three of these four."""
    scene = build("plates", size=10.0, distance=20.0)
    quads = box(np.array([-0.1, 9.9, -0.1]), np.array([0.1, 10.1, 0.1]))
    triangles = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3).tolist()
    lamp = parse_lighting({"type": "mesh", "mesh": triangles, "position": [0, 0, 0], "radiance": [1, 1, 1]})
    at = np.array([[0.0, 6.0, 0.0], [0.0, 14.0, 0.0], [4.0, 10.0, 0.0], [-4.0, 10.0, 0.0]])
    facing = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = engine_irradiance(Tracer.of(scene), lamp, at, facing, resolution=64, taps=1, depth=0.0)
    assert (found > 0).all()
