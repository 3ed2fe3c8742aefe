"""Light of near senders: paths where senders are coarse, nothing where none is near, and the error that it takes away."""

from dataclasses import dataclass

import numpy as np
import pytest

from ddprt import seeds
from ddprt.lights import Lighting, parse_lighting
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene
from ddprt.transport import operator
from ddprt.transport.direct import Texels, centred, direct_irradiance, mean_irradiance
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Receivers, seen_from
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.operator import Operator
from ddprt.transport.reference import on_texels, trace_reference

LAMPS = [
    {"type": "point", "position": (0.28, 0.45, 0.28), "intensity": [1, 1, 1]},
    {"type": "point", "position": (0.2, 0.3, 0.15), "intensity": [0.2, 0, 0.1]},
    {"type": "sphere", "center": (0.45, 0.3, 0.1), "radius": 0.03, "radiance": [3, 2, 1]},
]
EVERYWHERE = 1e3
"""Widths within which all of the box is near."""


@dataclass
class Box:
    """The Cornell box in senders so coarse that their means are wrong."""

    tracer: Tracer
    atlas: Atlas
    operator: Operator
    lightings: list[Lighting]
    direct: np.ndarray


def boxed(scene: Scene, resolution: int, senders: int) -> Box:
    tracer = Tracer.of(scene)
    atlas, _ = build_open_atlas(tracer, scene, resolution)
    ready, lightings = Operator.of(tracer, atlas, senders), [parse_lighting(lamp) for lamp in LAMPS]
    places, rng = Texels.of(tracer, atlas, 64, seeds.stream(0, "places")).places, seeds.stream(0, "lights")
    light = [mean_irradiance(tracer, centred(tracer, lighting), places, rng) for lighting in lightings]
    return Box(tracer, atlas, ready, lightings, np.concatenate([ready.averaged(part) for part in light], 1))


@pytest.fixture(scope="module")
def box(cornell: Scene) -> Box:
    return boxed(cornell, 32, 8)


def gathered(box: Box, rays: int, run: int, *, widths: float | None, bounces: int = -1) -> np.ndarray:
    bounced = box.operator.bounce(box.direct, seed=run, stream="near", bounces=bounces)
    near = None if widths is None else box.operator.near(box.lightings, box.direct, bounces=bounces, widths=widths)
    chosen = np.arange(box.atlas.count)
    return box.operator.gather_some(bounced.radiosity, chosen, rays, seed=run, stream="near", near=near)


def test_where_everything_is_near_the_operator_is_a_path_tracer(box: Box, cornell: Scene) -> None:
    """z-test per texel against the reference, with senders of 7 cm; without it the same test fails."""
    start, count = on_texels(box.tracer, box.atlas, np.arange(box.atlas.count)), box.atlas.count
    runs = {widths: np.stack([gathered(box, 64, run, widths=widths) for run in range(8)]) for widths in (None, EVERYWHERE)}
    for index, lighting in enumerate(box.lightings):
        found, other = (trace_reference(box.tracer, cornell, lighting, start, count, 400, seed=seed) for seed in (1, 2))
        lit = found.indirect[:, 2] > 0.1 * np.median(found.indirect[:, 2])
        spread = {}
        for widths, maps in runs.items():
            blue = maps[:, index, lit, 2].astype(float)
            variance = blue.var(0, ddof=1) / len(blue) + other.indirect_variance[lit, 2]
            z = (blue.mean(0) - found.indirect[lit, 2]) / np.sqrt(variance)
            spread[widths] = z.mean(), z.std()
        # 900 texels: 0.033 of noise in the mean, 0.024 in the spread, whose tails are heavier than normal with 8 runs
        assert abs(spread[EVERYWHERE][0]) < 0.15, (index, spread)
        assert 0.85 < spread[EVERYWHERE][1] < 1.2, (index, spread)
        assert spread[None][1] > 1.3, (index, spread)


def test_where_nothing_is_near_nothing_changes(box: Box) -> None:
    before = gathered(box, 24, 0, widths=None)
    rays = box.tracer.rays
    np.testing.assert_array_equal(gathered(box, 24, 0, widths=0.0), before)
    assert box.tracer.rays - rays <= 2 * (24 * box.atlas.count + 256 * box.operator.coarse.count)


def test_a_single_bounce_agrees_with_loops(box: Box) -> None:
    """Each near ray's direct light, one at a time, in place of its sender's mean; lamps without size, so nothing is random."""
    lamps, widths, rays, count = box.lightings[:2], 0.6, 5, box.atlas.count
    ready, direct = box.operator, np.ascontiguousarray(box.direct[:, :6])
    radiosity = ready.bounce(direct, seed=0, stream="loops", bounces=1).radiosity
    near = ready.near(lamps, direct, bounces=1, widths=widths)
    assert not near.endless
    found = ready.gather_some(radiosity, np.arange(count), rays, seed=0, stream="loops", near=near)
    expected, looked = np.zeros((2, count, 3)), 0
    receivers = Receivers.texels(box.atlas, rays, 0, "loops", np.arange(count))
    for tile in receivers.tiles():
        first = 0
        for seen in seen_from(box.tracer, receivers, tile, ready.landing):
            samples, texels = seen.cells.shape
            for sample in range(samples):
                for receiver in range(texels):
                    cell, ray = seen.cells[sample, receiver], sample * texels + receiver
                    if cell < 0:
                        continue
                    light = radiosity[cell].reshape(2, 3).astype(float)
                    block = ready.coarse.of_texel[ready.senders.of_texel == cell][0]
                    if seen.distance[sample, receiver] < widths * np.sqrt(ready.coarse.area[block]):
                        triangle, looked = seen.triangle[ray], looked + 1
                        weights = np.array([1 - seen.u[ray] - seen.v[ray], seen.u[ray], seen.v[ray]])
                        place = (weights @ box.tracer.corners[triangle])[None].astype(np.float32)
                        normal, unused = box.tracer.normals[[triangle]], np.zeros((1, 1, 2), np.float32)
                        for index, lamp in enumerate(lamps):
                            lit = direct_irradiance(box.tracer, centred(box.tracer, lamp), place, normal, unused)[0]
                            light[index] += ready.senders.albedo[cell] * (lit - direct[cell, 3 * index : 3 * index + 3])
                    expected[:, tile.start + receiver] += light / rays
            first += samples
        assert first == rays
    assert 0.02 < looked / (rays * count) < 0.5
    assert not np.allclose(expected, ready.gather_some(radiosity, np.arange(count), rays, seed=0, stream="loops"), rtol=1e-3)
    # places by their corners differ in the last bits, so that rays along a shadow's edge may part: fewer than one in 1000
    same = np.isclose(found, expected, rtol=1e-4, atol=1e-5 * expected.max())
    assert same.mean() > 0.999


def test_stretches_do_not_change_a_single_bounce(box: Box, monkeypatch: pytest.MonkeyPatch) -> None:
    lamps, direct = box.lightings[:2], np.ascontiguousarray(box.direct[:, :6])
    radiosity = box.operator.bounce(direct, seed=0, stream="loops", bounces=1).radiosity
    near, rays = box.operator.near(lamps, direct, bounces=1), np.full(box.atlas.count, 16)
    maps = np.zeros((2, 2, box.atlas.count, 3), np.float32)
    for together, out in zip((1, 8), maps, strict=True):
        monkeypatch.setattr(operator, "_TOGETHER", together)
        list(box.operator.gather(radiosity, out, rays, seed=0, stream="loops", near=near))
    np.testing.assert_allclose(maps[0], maps[1], rtol=1e-5, atol=1e-6 * maps[0].max())  # sums in another order


def test_some_lightings_are_the_same_columns(box: Box) -> None:
    near = box.operator.near(box.lightings, box.direct)
    few = near.some(np.array([2, 0]))
    assert few.lightings == [near.lightings[2], near.lightings[0]]
    np.testing.assert_array_equal(few.direct, np.concatenate([box.direct[:, 6:9], box.direct[:, :3]], 1))


def test_contacts_are_far_better_for_it(cornell: Scene) -> None:
    """Floor texels along blocks and walls, against two independent references."""
    box = boxed(cornell, 64, 32)
    floor = box.atlas.geometric_normal[:, 1] > 0.9
    contact = np.flatnonzero(floor & (box.atlas.coverage < 0.9) & (box.atlas.position[:, 1] < 0.01))
    assert 20 < len(contact) < 200
    start = on_texels(box.tracer, box.atlas, contact)
    lamp = box.lightings[0]
    truth = [trace_reference(box.tracer, cornell, lamp, start, len(contact), 8000, seed=seed).indirect for seed in (3, 4)]
    error = {}
    for widths in (None, operator.WIDTHS):
        runs = [gathered(box, 512, run, widths=widths)[0, contact] for run in range(2)]
        products = (runs[0] - truth[0]) * (runs[1] - truth[1])  # free of noise on both sides
        error[widths] = products.sum(1) @ box.atlas.area[contact]
    assert error[operator.WIDTHS] < 0.6 * error[None], error
