"""The operator and what spares it rays: bounces against a dense float64 solve, footprints, and the choice of rays."""

import itertools
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from ddprt.lights import parse_lighting
from ddprt.scene.atlas import Atlas, Senders, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.sections import TransportConfig
from ddprt.transport import effort, operator
from ddprt.transport.effort import Choice, allot, choose_rays
from ddprt.transport.embree import Tracer
from ddprt.transport.footprint import Footprints, find_footprints
from ddprt.transport.gather import Receivers, seen_from
from ddprt.transport.operator import Operator
from ddprt.transport.reference import on_texels, trace_reference

LAMPS = [(0.28, 0.45, 0.28), (0.1, 0.3, 0.1), (0.45, 0.2, 0.1)]


@dataclass
class Made:
    """The Cornell box, ready to gather: `direct` on the senders, columns (lighting, channel)."""

    scene: Scene
    atlas: Atlas
    operator: Operator
    direct: np.ndarray


def made(scene: Scene, atlas: Atlas, threads: int = 0, sender_resolution: int = 0) -> Made:
    tracer = Tracer.of(scene, threads)
    ready = Operator.of(tracer, atlas, sender_resolution)
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    columns = []
    for place in LAMPS:
        lamp = parse_lighting({"type": "point", "position": place, "intensity": [1, 1, 1]})
        light = trace_reference(tracer, scene, lamp, start, atlas.count, 16, seed=0, bounces=0).direct
        columns.append(ready.averaged(light.astype(np.float32)))
    return Made(scene, atlas, ready, np.concatenate(columns, 1))


@pytest.fixture(scope="module")
def box(cornell: Scene, cornell_atlas: Atlas) -> Made:
    return made(cornell, cornell_atlas)


@pytest.fixture(scope="module")
def light(box: Made) -> np.ndarray:
    """What leaves the senders of the box, all bounces."""
    return box.operator.bounce(box.direct, seed=0, stream="light").radiosity


@pytest.fixture(scope="module")
def small(cornell: Scene) -> Made:
    return made(cornell, build_atlas(cornell, 32))


@pytest.fixture
def coarsely(monkeypatch: pytest.MonkeyPatch, small: Made) -> Made:
    """The small box, its bounces solved on at most 120 blocks."""
    monkeypatch.setattr(operator, "_COARSE", 120)
    return replace(small, operator=Operator.of(small.operator.tracer, small.atlas))


def gathered(ready: Operator, radiosity: np.ndarray, samples: int, seed: int = 0, stream: str = "maps") -> np.ndarray:
    return ready.gather_some(radiosity, np.arange(ready.atlas.count), samples, seed=seed, stream=stream)


# --- between blocks ---------------------------------------------------------------------------------------------------


def slow_between(senders: Senders, coarse: Senders) -> np.ndarray:
    """Bilinear weights of each sender's centre among the blocks of its chart that there are, one pair at a time."""
    ratio = senders.block / coarse.block
    result = np.zeros((senders.count, coarse.count))
    for i in range(senders.count):
        for j in np.flatnonzero(coarse.chart == senders.chart[i]):
            down = abs((senders.row[i] + 0.5) * ratio - (coarse.row[j] + 0.5))
            right = abs((senders.column[i] + 0.5) * ratio - (coarse.column[j] + 0.5))
            result[i, j] = max(0, 1 - down) * max(0, 1 - right)
        result[i] /= result[i].sum()
    return result


@pytest.mark.parametrize(("fine", "wide"), [(1, 2), (1, 3), (2, 10), (3, 12), (2, 32)])
def test_interpolation_between_blocks_agrees_with_loops(small: Made, fine: int, wide: int) -> None:
    senders, coarse = small.atlas.senders(fine), small.atlas.senders(wide)
    found = operator._between(senders, coarse).toarray()
    np.testing.assert_allclose(found, slow_between(senders, coarse), atol=1e-6)
    np.testing.assert_allclose(found.sum(1), 1, atol=1e-6)
    assert (found >= 0).all()
    assert not found[senders.chart[:, None] != coarse.chart].any()


def test_slopes_are_kept_inside_charts(box: Made) -> None:
    senders, coarse = box.atlas.senders(1), box.atlas.senders(4)
    matrix = operator._between(senders, coarse)
    rng = np.random.default_rng(0)
    slope = rng.normal(size=(3, coarse.chart.max() + 1))  # another one in every chart

    def ramp(blocks: Senders) -> np.ndarray:
        a, b, c = slope[:, blocks.chart]
        return a + b * (blocks.row + 0.5) * blocks.block + c * (blocks.column + 0.5) * blocks.block

    inner = np.diff(matrix.indptr) == 4
    assert inner.mean() > 0.5
    np.testing.assert_allclose((matrix @ ramp(coarse))[inner], ramp(senders)[inner], rtol=1e-5, atol=1e-4)


def test_equal_blocks_are_not_interpolated(small: Made) -> None:
    senders = small.operator.senders
    np.testing.assert_array_equal(operator._between(senders, senders).toarray(), np.eye(senders.count))


@pytest.mark.parametrize("resolution", [0, 5, 11, 32, 1024])
def test_senders_and_blocks(small: Made, resolution: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator, "_COARSE", 150)
    ready = Operator.of(small.operator.tracer, small.atlas, resolution)
    assert ready.senders.block == {0: 1, 5: 6, 11: 3, 32: 1, 1024: 1}[resolution]
    assert ready.coarse.count <= 150
    assert ready.coarse.block % ready.senders.block == 0  # so that a sender lies in one block
    if ready.coarse.block > ready.senders.block:  # no coarser than it must be
        assert small.atlas.senders(ready.coarse.block - ready.senders.block).count > 150


def test_charts_are_never_joined(small: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """More charts than blocks were asked for: one block each, and the same bits as where they were not too many."""
    charts = len(np.unique(small.atlas.chart))
    monkeypatch.setattr(operator, "_COARSE", charts // 5)
    ready, matrices = Operator.of(small.operator.tracer, small.atlas), []
    assert ready.coarse.count == charts > 4 * (charts // 5)
    for most in (charts // 5, charts):
        monkeypatch.setattr(operator, "_COARSE", most)
        found = ready.bounce(small.direct, seed=0, stream="charts", bounces=4)
        matrices.append((ready._between_senders(small.direct, 0, "charts")[0], found.radiosity))
    np.testing.assert_array_equal(matrices[0][0].toarray(), matrices[1][0].toarray())
    np.testing.assert_array_equal(matrices[0][1], matrices[1][1])


# --- bounces ----------------------------------------------------------------------------------------------------------


def slow_series(made: Made, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """G among the blocks, e_1 and P in float64, from the cells that rays are seen to land in."""
    ready, seen = made.operator, {}

    def watched(tracer: Tracer, receivers: Receivers, tile: slice, landing: Any) -> Iterator[Any]:
        for rays in seen_from(tracer, receivers, tile, landing):
            seen.setdefault(tile.start, []).append(rays.cells.copy())
            yield rays

    with monkeypatch.context() as patch:
        patch.setattr(operator, "seen_from", watched)
        ready.bounce(made.direct, seed=0, stream="twin", bounces=2)
    cells = np.concatenate([np.concatenate(seen[start]) for start in sorted(seen)], 1)
    assert cells.shape == (operator._COARSE_SAMPLES, ready.coarse.count)
    home = {}
    for texel in range(made.atlas.count):
        home[int(ready.senders.of_texel[texel])] = int(ready.coarse.of_texel[texel])
    radiosity = made.direct * np.tile(ready.senders.albedo, made.direct.shape[1] // 3)
    among, first = np.zeros((ready.coarse.count,) * 2), np.zeros((ready.coarse.count, made.direct.shape[1]))
    for sample in range(len(cells)):
        for block in range(ready.coarse.count):
            cell = int(cells[sample, block])
            if cell >= 0:
                among[block, home[cell]] += 1 / len(cells)
                first[block] += radiosity[cell] / len(cells)
    return among, first, slow_between(ready.senders, ready.coarse)


@pytest.mark.parametrize("bounces", [2, 3, 6, -1])
def test_bounces_agree_with_a_dense_solve(coarsely: Made, bounces: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sum of the series is (I - G R)^-1 e_1; a forced number of terms, summed one by one."""
    ready = coarsely.operator
    assert ready.coarse.block > ready.senders.block
    among, first, between = slow_series(coarsely, monkeypatch)
    found = ready.bounce(coarsely.direct, seed=0, stream="twin", bounces=bounces)
    expected = np.zeros_like(coarsely.direct, dtype=float)
    for column in range(expected.shape[1]):
        reflect = among * ready.coarse.albedo[:, column % 3]
        if bounces < 0:
            total = np.linalg.solve(np.eye(len(among)) - reflect, first[:, column])
        else:
            total = sum(np.linalg.matrix_power(reflect, k) @ first[:, column] for k in range(bounces - 1))
        albedo = ready.senders.albedo[:, column % 3]
        expected[:, column] = albedo * (coarsely.direct[:, column] + between @ total)
    assert found.bounces == bounces or bounces < 0
    # What the series leaves out is known to be at most `remainder` of the peak; float32 sums of 256 rays.
    left = found.remainder if bounces < 0 else 0
    np.testing.assert_allclose(found.radiosity, expected, rtol=2e-5, atol=left * expected.max())
    assert bounces > 0 or np.abs(found.radiosity / expected - 1).max() > 0  # a solve and a series are not the same sum


def test_bounces_are_counted(small: Made) -> None:
    for bounces in (1, 2, 3, 7):
        assert small.operator.bounce(small.direct, seed=0, stream="n", bounces=bounces).bounces == bounces
    single = small.operator.bounce(small.direct, seed=0, stream="n", bounces=1)
    np.testing.assert_array_equal(single.radiosity, small.direct * np.tile(small.operator.senders.albedo.astype(np.float32), 3))
    free = small.operator.bounce(small.direct, seed=0, stream="n")
    assert free.converged
    assert free.remainder <= operator._TOLERANCE
    shorter = small.operator.bounce(small.direct, seed=0, stream="n", bounces=free.bounces - 1)
    assert not shorter.converged
    same = small.operator.bounce(small.direct, seed=0, stream="n", bounces=free.bounces)
    np.testing.assert_array_equal(same.radiosity, free.radiosity)


def test_the_remainder_bounds_all_further_light(small: Made) -> None:
    """Against 200 bounces of the same rays, texel by texel, and each lighting and channel on its own."""
    ready = small.operator
    whole = gathered(ready, ready.bounce(small.direct, seed=0, stream="r", bounces=200).radiosity, 64)
    for bounces in (1, 2, 3, 5, 9, -1):
        found = ready.bounce(small.direct, seed=0, stream="r", bounces=bounces)
        missing = np.abs(whole - gathered(ready, found.radiosity, 64)).max(1) / whole.max(1)
        assert 0 < missing.max() <= found.remainder + 1e-6
        assert found.remainder < 100 * missing.max()  # not for the asking


@pytest.mark.parametrize("bounces", [1, 2, 3, 8])
def test_the_remainder_of_a_furnace_is_known(bounces: int) -> None:
    """Every term is the albedo times the one before: last over sum, times a / (1 - a)."""
    scene = build("furnace", albedo=0.6, subdivisions=2)
    ready = Operator.of(Tracer.of(scene), build_atlas(scene, 32))
    direct = np.ones((ready.senders.count, 3), np.float32)
    terms = [0.6**k for k in range(1, max(bounces, 2))]
    found = ready.bounce(direct, seed=0, stream="f", bounces=bounces)
    # A ray in a thousand slips between two facets or finds no sender.
    assert found.remainder == pytest.approx(terms[-1] / sum(terms) * 0.6 / 0.4, rel=0.02)


def test_the_slowest_lighting_decides_however_dim(small: Made) -> None:
    found = [small.operator.bounce(small.direct[:, k : k + 3], seed=0, stream="s", bounces=5).remainder for k in (0, 3, 6)]
    assert len(set(found)) == 3
    for order in itertools.permutations((1e-6, 1.0, 1e6)):
        together = small.operator.bounce(
            small.direct * np.repeat(np.array(order, np.float32), 3), seed=0, stream="s", bounces=5
        )
        assert together.remainder == pytest.approx(max(found), rel=1e-4)
    dark = np.concatenate([small.direct, np.zeros_like(small.direct)], 1)
    assert small.operator.bounce(dark, seed=0, stream="s", bounces=5).remainder == pytest.approx(max(found), rel=1e-4)


def test_nothing_comes_from_nothing(small: Made) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = small.operator.bounce(np.zeros_like(small.direct), seed=0, stream="dark")
        assert not found.radiosity.any()
        assert found.remainder == 0
        assert found.converged
        pilot = small.operator.pilot(found.radiosity, 4, seed=0, stream="dark")
        assert not pilot.variance.any()
        assert not gathered(small.operator, found.radiosity, 4).any()


def test_mirrors_of_all_light_never_end() -> None:
    """Albedo 1 in a closed room: no bound, and the series stops all the same."""
    scene = build("furnace", albedo=1.0, subdivisions=1)
    ready = Operator.of(Tracer.of(scene), build_atlas(scene, 16))
    found = ready.bounce(np.ones((ready.senders.count, 3), np.float32), seed=0, stream="white")
    assert found.bounces == operator._MAX_BOUNCES
    assert found.remainder == float("inf")
    assert not found.converged


# --- gathering --------------------------------------------------------------------------------------------------------


def uneven(atlas: Atlas, seed: int = 0) -> np.ndarray:
    """Rays of each texel: whole regions without any 16, and texels without any at all."""
    rays = np.random.default_rng(seed).choice([0, 3, 16, 100], atlas.count, p=[0.1, 0.3, 0.3, 0.3])
    rays[(atlas.texel // atlas.resolution < 20) & (rays == 16)] = 100
    return rays


def test_uneven_rays_are_those_of_even_ones(box: Made, light: np.ndarray) -> None:
    """A texel's rays depend on its own number of them alone. Sums run over other tiles: float32 rounding."""
    rays = uneven(box.atlas)
    out = np.full((3, box.atlas.count, 3), np.nan, np.float32)
    tiles = list(box.operator.gather(light, out, rays, seed=0, stream="maps"))
    assert sum(tiles) == (rays > 0).sum()
    assert np.isnan(out[:, rays == 0]).all()
    for samples in (3, 16, 100):
        even = gathered(box.operator, light, samples)
        np.testing.assert_allclose(out[:, rays == samples], even[:, rays == samples], rtol=1e-5)
        few = np.flatnonzero(rays == samples)[5:9]
        some = box.operator.gather_some(light, few, samples, seed=0, stream="maps")
        np.testing.assert_allclose(some, even[:, few], rtol=1e-5)


def test_gather_agrees_with_loops(small: Made) -> None:
    """Irradiance is the mean radiosity of what a texel's rays land on, channel by channel."""
    ready, rng = small.operator, np.random.default_rng(0)
    radiosity = rng.random((ready.senders.count, 6)).astype(np.float32)
    found = ready.gather_some(radiosity, np.arange(small.atlas.count), 9, seed=1, stream="loops")
    receivers = Receivers.texels(small.atlas, 9, 1, "loops", np.arange(small.atlas.count))
    for tile in itertools.islice(receivers.tiles(), 2):
        cells = np.concatenate([seen.cells for seen in seen_from(ready.tracer, receivers, tile, ready.landing)])
        for receiver in range(0, tile.stop - tile.start, 5):
            for lighting in range(2):
                for channel in range(3):
                    column = radiosity[:, 3 * lighting + channel].astype(float)
                    expected = sum(column[cell] for cell in cells[:, receiver] if cell >= 0) / 9
                    assert found[lighting, tile.start + receiver, channel] == pytest.approx(expected, rel=1e-6, abs=1e-7)


def test_averages_agree_with_loops(coarsely: Made) -> None:
    rng, atlas = np.random.default_rng(0), coarsely.atlas
    ready = Operator.of(coarsely.operator.tracer, atlas, 8)
    values = rng.random((atlas.count, 3)).astype(np.float32)
    found = ready.averaged(values)
    for sender in range(0, ready.senders.count, 3):
        texels = np.flatnonzero(ready.senders.of_texel == sender)
        expected = (atlas.area[texels, None] * values[texels]).sum(0) / atlas.area[texels].sum()
        np.testing.assert_allclose(found[sender], expected, rtol=1e-5)


@pytest.mark.parametrize("skip", [0, 4, 1000])
def test_skipped_tiles_are_left_alone_and_the_rest_has_the_same_bits(
    box: Made, light: np.ndarray, skip: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operator, "_TOGETHER", 1)
    rays, tracer = uneven(box.atlas), box.operator.tracer
    whole, rest = np.full((2, 3, box.atlas.count, 3), np.nan, np.float32)
    before = tracer.rays
    sizes = list(box.operator.gather(light, whole, rays, seed=0, stream="maps"))
    assert tracer.rays - before == rays.sum()
    assert len(sizes) > 8
    before = tracer.rays
    assert list(box.operator.gather(light, rest, rays, seed=0, stream="maps", skip=skip)) == sizes
    left_out = np.isnan(rest).all((0, 2)) & (rays > 0)
    assert left_out.sum() == sum(sizes[:skip])
    assert tracer.rays - before == rays[~left_out].sum()
    np.testing.assert_array_equal(rest[:, ~left_out], whole[:, ~left_out])
    # In order: the tiles that come first are those with the fewest rays.
    assert not left_out.any() or rays[left_out].max() <= rays[~left_out & (rays > 0)].min(initial=100)


def test_bits_depend_on_the_seed_but_not_on_the_threads(cornell: Scene, cornell_atlas: Atlas, box: Made) -> None:
    results = []
    for threads, seed in ((1, 0), (3, 0), (3, 1)):
        ready = Operator.of(Tracer.of(cornell, threads), cornell_atlas)
        bounced = ready.bounce(box.direct, seed=seed, stream="bits")
        pilot = ready.pilot(bounced.radiosity, 5, seed=seed, stream="bits")
        maps = np.zeros((3, cornell_atlas.count, 3), np.float32)
        sizes = list(ready.gather(bounced.radiosity, maps, uneven(cornell_atlas), seed=seed, stream="bits"))
        results.append((bounced.radiosity, pilot.nearness, pilot.variance, maps, sizes, bounced.remainder))
    for one, three, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, three)
        assert isinstance(one, list) or np.any(one != other)


def test_a_pilot_agrees_with_loops(small: Made) -> None:
    """Mean of 1 / distance, and the variance of single rays in units of the largest radiosity squared."""
    ready, rng = small.operator, np.random.default_rng(0)
    radiosity = (1e-3 * rng.random((ready.senders.count, 6))).astype(np.float32)
    pilot = ready.pilot(radiosity, 12, seed=3, stream="look")
    receivers = Receivers.texels(small.atlas, 12, 3, "look pilot")
    tile = next(receivers.tiles())
    chunks = list(seen_from(ready.tracer, receivers, tile, ready.landing))
    cells, distance = (np.concatenate([getattr(seen, name) for seen in chunks]) for name in ("cells", "distance"))
    for receiver in range(0, tile.stop, 40):
        near, rows = 0.0, []
        for sample in range(12):
            near += 1 / float(distance[sample, receiver]) / 12
            cell = cells[sample, receiver]
            rows.append(radiosity[cell].astype(float) / radiosity.max() if cell >= 0 else np.zeros(6))
        assert pilot.nearness[receiver] == pytest.approx(near, rel=1e-5, abs=1e-20)
        assert pilot.variance[receiver] == pytest.approx(np.var(rows, axis=0).sum(), rel=1e-4, abs=1e-5)
    bright = ready.pilot(radiosity * np.float32(2**80), 12, seed=3, stream="look")
    np.testing.assert_array_equal(bright.variance, pilot.variance)


def test_uneven_rays_agree_with_the_reference(cornell: Scene) -> None:
    """Texel by texel with both variances, as for even rays; the box without its blocks, where no sender hides anything."""
    walls = [*range(8), 28, 29]
    scene = checked(
        "bare", cornell.positions, cornell.triangles[walls], material=cornell.material[walls], materials=cornell.materials
    )
    atlas, tracer = build_atlas(scene, 40), Tracer.of(scene)
    lamp = parse_lighting({"type": "point", "position": LAMPS[0], "intensity": [1, 1, 1]})
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    direct = trace_reference(tracer, scene, lamp, start, atlas.count, 64, seed=1, bounces=0).direct
    found, other = (trace_reference(tracer, scene, lamp, start, atlas.count, 300, seed=seed) for seed in (2, 3))
    ready = Operator.of(tracer, atlas)
    averaged = ready.averaged(direct.astype(np.float32))
    runs = np.zeros((6, 1, atlas.count, 3), np.float32)
    for k in range(6):
        rays = 2 ** np.random.default_rng(k).integers(4, 8, atlas.count)
        bounced = ready.bounce(averaged, seed=k, stream="z")
        for _ in ready.gather(bounced.radiosity, runs[k], rays, seed=k, stream="z"):
            pass
    by_operator, variance = runs.mean(0, dtype=float)[0], runs.var(0, ddof=1, dtype=float)[0] / len(runs)
    lit = by_operator[:, 1] > 0.1 * np.median(by_operator[:, 1])
    assert lit.mean() > 0.95
    z = ((by_operator - found.indirect) / np.sqrt(variance + other.indirect_variance))[lit, 1]
    assert abs(z.mean()) < 0.15  # 900 texels: 0.03 of noise, and the light averaged in senders of 14 mm
    assert abs(z.std() - 1) < 0.1
    weights = atlas.area / atlas.area.sum()
    total, error = weights @ found.indirect[:, 1], np.sqrt(weights**2 @ found.indirect_variance[:, 1])
    assert error < 0.007 * total
    assert abs(weights @ by_operator[:, 1] - total) < 4 * error


# --- footprints -------------------------------------------------------------------------------------------------------


def dense(footprints: Footprints) -> np.ndarray:
    """The weights as a matrix, texel to texel."""
    count, side = len(footprints.centre), round(np.sqrt(footprints.weight.shape[1]))
    matrix = np.zeros((count, count))
    for texel in range(count):
        row, column = divmod(int(footprints.centre[texel]), footprints.slot.shape[1])
        assert footprints.slot[row, column] == texel
        for tap in range(side**2):
            other = footprints.slot[row + tap // side - side // 2, column + tap % side - side // 2]
            if footprints.weight[texel, tap] != 0:
                assert other >= 0
                matrix[texel, other] += footprints.weight[texel, tap]
    return matrix


def slow_footprint(atlas: Atlas, nearness: np.ndarray, share: float, texel: int) -> dict[int, float]:
    """Weights of one texel's neighbours: area times a Gaussian, tilted so that the mean stays in place."""
    row, column = divmod(int(atlas.texel[texel]), atlas.resolution)
    taps = {}
    for y in range(-2, 3):
        for x in range(-2, 3):
            if not (0 <= row + y < atlas.resolution and 0 <= column + x < atlas.resolution):
                continue
            other = atlas.slot[row + y, column + x]
            if other < 0 or atlas.chart[other] != atlas.chart[texel]:
                continue
            if other != texel and (share == 0 or atlas.geometric_normal[other] @ atlas.geometric_normal[texel] <= 0.9):
                continue
            away = np.linalg.norm(atlas.position[other] - atlas.position[texel]) if other != texel else 0.0
            turned = 1 - atlas.geometric_normal[other] @ atlas.geometric_normal[texel] if other != texel else 0.0
            error = (away * max(nearness[other], nearness[texel])) ** 2 + turned
            taps[int(other)] = (x, y, atlas.area[other] * np.exp(-0.5 * error / share**2 if error else 0.0))
    place, mass = np.array([tap[:2] for tap in taps.values()], float), np.array([tap[2] for tap in taps.values()])
    spread = (mass[:, None, None] * place[:, :, None] * place[:, None, :]).sum(0) + 1e-3 * mass.sum() * np.eye(2)
    tilt = np.linalg.solve(spread, mass @ place)
    mass = mass * np.clip(1 - place @ tilt, 0, 3)
    return dict(zip(taps, mass / mass.sum(), strict=True))


@pytest.fixture(scope="module")
def near(box: Made, light: np.ndarray) -> np.ndarray:
    return box.operator.pilot(light, 64, seed=0, stream="near").nearness


@pytest.mark.parametrize("share", [0.0, 0.05, 0.1, 1.0])
def test_footprints_agree_with_loops(box: Made, near: np.ndarray, share: float) -> None:
    matrix = dense(find_footprints(box.atlas, near, share))
    for texel in range(0, box.atlas.count, 7):
        slow = slow_footprint(box.atlas, near, share, texel)
        expected = np.zeros(box.atlas.count)
        expected[list(slow)] = list(slow.values())
        np.testing.assert_allclose(matrix[texel], expected, atol=2e-5)  # positions in float32, squared and times 1e4


@pytest.mark.parametrize("share", [1e-9, 0.05, 0.1, 1.0])
def test_footprints_are_means_within_a_chart(box: Made, near: np.ndarray, share: float) -> None:
    footprints = find_footprints(box.atlas, near, share)
    matrix, chart = dense(footprints), box.atlas.chart
    assert (footprints.weight >= 0).all()
    np.testing.assert_allclose(matrix.sum(1), 1, atol=1e-6)
    assert not matrix[chart[:, None] != chart].any()
    if share < 1e-6:
        np.testing.assert_array_equal(matrix, np.eye(box.atlas.count))
    else:
        assert (matrix > 0).sum() > (1.5 if share < 0.1 else 3) * box.atlas.count
    values = np.random.default_rng(0).random((box.atlas.count, 3)).astype(np.float32)
    np.testing.assert_allclose(footprints.pooled(values), matrix @ values, rtol=1e-5)
    constant = np.full((box.atlas.count, 1), 7, np.float32)
    np.testing.assert_allclose(footprints.pooled(constant), 7, rtol=1e-6)
    np.testing.assert_allclose(footprints.burden(box.atlas.area), (matrix**2).T @ box.atlas.area, rtol=1e-6)


def test_the_burden_is_what_noise_leaves(box: Made, near: np.ndarray) -> None:
    """Independent noise of each texel, pooled: its area-weighted square is burden times variance."""
    footprints, rng = find_footprints(box.atlas, near, 0.1), np.random.default_rng(0)
    deviation = rng.lognormal(sigma=1.0, size=box.atlas.count)
    noise = (rng.normal(size=(box.atlas.count, 2000)) * deviation[:, None]).astype(np.float32)
    measured = (box.atlas.area @ (footprints.pooled(noise) ** 2)).mean()
    # 2000 draws of a sum over 2400 texels.
    assert footprints.burden(box.atlas.area) @ deviation**2 == pytest.approx(measured, rel=0.01)


@pytest.mark.parametrize(("degrees", "shared"), [(0, True), (24, True), (27, False), (90, False), (180, False)])
def test_folds_are_not_crossed(plates: Scene, degrees: float, shared: bool) -> None:
    """Half of each chart's normals are turned: beyond acos 0.9 = 25.8 degrees, nothing is borrowed from there."""
    atlas = build_atlas(plates, 32)
    turned = atlas.position[:, 0] > 0.01
    normal = atlas.geometric_normal.copy()
    angle = np.radians(degrees)
    normal[turned] = np.stack(
        [np.zeros(turned.sum()), np.cos(angle) * normal[turned, 1], np.full(turned.sum(), np.sin(angle))], 1
    )
    folded = replace(atlas, geometric_normal=normal)
    matrix = dense(find_footprints(folded, np.zeros(atlas.count), 0.1))
    assert bool(matrix[turned][:, ~turned].any()) is shared
    assert matrix[turned][:, turned].any(1).all()


def test_charts_that_touch_do_not_share(plates: Scene) -> None:
    """As on both sides of a wall: neighbours on the map, facing the same way, and no light in common."""
    atlas = build_atlas(plates, 32)
    beyond = atlas.position[:, 0] > 0.01
    parted = replace(atlas, chart=(2 * atlas.chart + beyond).astype(np.int32))
    open_plane, walled = (dense(find_footprints(which, np.zeros(atlas.count), 0.1)) for which in (atlas, parted))
    assert open_plane[beyond][:, ~beyond].any()
    assert not walled[beyond][:, ~beyond].any()
    assert not walled[~beyond][:, beyond].any()
    np.testing.assert_allclose(walled.sum(1), 1, atol=1e-6)


def test_slopes_in_an_open_plane_are_exact(plates: Scene, plates_atlas: Atlas) -> None:
    """Texel coordinates come out as they went in: inside a chart, and but for a thousandth along its rims."""
    atlas = plates_atlas
    row, column = np.divmod(atlas.texel, atlas.resolution)
    ramp = np.stack([row, column, 3 * row - 2 * column], 1).astype(np.float32)
    spacing = np.sqrt(np.median(atlas.area))
    # Texels that lie in one triangle, as do all their neighbours: their places form a lattice.
    home = np.full((2, atlas.count), [[len(plates.triangles)], [-1]])
    np.minimum.at(home[0], atlas.piece_texel, atlas.piece_triangle)
    np.maximum.at(home[1], atlas.piece_texel, atlas.piece_triangle)
    plain = np.zeros(atlas.slot.shape, bool)
    plain.ravel()[atlas.texel] = (home[0] == home[1]) & (atlas.area > 0.999 * spacing**2)
    shifts = list(itertools.product(range(-2, 3), repeat=2))
    lattice = np.all([np.roll(plain, shift, (0, 1)).ravel()[atlas.texel] for shift in shifts], axis=0)
    assert lattice.mean() > 0.4
    for deviation in (0.4, 1.0, 3.0, np.inf):
        footprints = find_footprints(atlas, np.full(atlas.count, 0.1 / (deviation * spacing)), 0.1)
        wrong = np.abs(footprints.pooled(ramp) - ramp)
        np.testing.assert_allclose(wrong[lattice], 0, atol=4e-5)  # float32 at values of 60 to 180
        assert (footprints.weight > 1e-3).sum(1)[lattice].min() >= (5 if deviation < 1 else 9)
        # Elsewhere places are off the lattice (texels that two triangles cross) or half of the square is missing (rims), and
        # weights are tilted, up to three times. Measured: 0.06 of a texel for nine texels of ten, 0.5 at worst.
        assert np.quantile(wrong[:, :2], 0.9) < 0.1
        assert wrong[:, :2].max() < 0.8


def test_footprints_shrink_in_corners(box: Made, near: np.ndarray) -> None:
    """On the floor, away from the blocks: the standard deviation in metres against the distance to the nearest wall."""
    atlas = box.atlas
    matrix = dense(find_footprints(atlas, near, 0.1))
    width, depth = atlas.position[:, 0].max(), atlas.position[:, 2].max()
    x, z = atlas.position[:, 0], atlas.position[:, 2]
    wall = np.minimum(np.minimum(x, width - x), depth - z)
    centre = matrix @ atlas.position
    spread = np.sqrt(np.maximum(matrix @ (atlas.position**2).sum(1) - (centre**2).sum(1), 0))
    ceiling = atlas.position[:, 1] > 0.54
    tight, wide = spread[ceiling & (wall < 0.015)], spread[ceiling & (wall > 0.15)]
    assert len(tight) > 10
    assert len(wide) > 10
    assert np.median(tight) < 0.35 * np.median(wide)
    # Where a texel touches a wall, its harmonic mean distance is below a texel: hardly anything is borrowed.
    assert np.median(matrix.diagonal()[ceiling & (wall < 0.008)]) > 0.6


def test_footprints_cost_little_and_spare_much(box: Made, light: np.ndarray, near: np.ndarray) -> None:
    """Against two converged maps: the square of the bias is the product of their two differences, free of their noise.

    At 1024 rays a map's own error is 2 %, and that of the product of two far less. Measured on this box: bias 0.0041,
    0.0136, 0.028 and 0.053 of the mean for shares of 0.05, 0.1, 0.2 and 0.4; noise of 16 rays falls by 1.19, 1.7, 2.4 and 2.9.
    """
    weights = box.atlas.area / box.atlas.area.sum()
    square = lambda one, other: float(weights @ (one * other).mean((0, 2)))  # noqa: E731
    converged = [gathered(box.operator, light, 1024, seed=seed) for seed in (1, 2)]
    noisy = [gathered(box.operator, light, 16, seed=seed) for seed in (3, 4)]
    mean = float(weights @ np.mean(converged, axis=0).mean((0, 2)))
    error = converged[0] - converged[1]
    assert np.sqrt(square(error, error) / 2) < 0.03 * mean
    for share, bias, factor in ((0.05, 0.006, 1.15), (0.1, 0.018, 1.55), (0.2, 0.037, 2.1)):
        footprints = find_footprints(box.atlas, near, share)
        pool = lambda maps, footprints=footprints: np.stack([footprints.pooled(lit) for lit in maps])  # noqa: E731
        moved = [pool(maps) - maps for maps in converged]
        assert np.sqrt(max(square(*moved), 0)) < bias * mean
        before, after = noisy[0] - noisy[1], pool(noisy[0]) - pool(noisy[1])
        assert np.sqrt(square(before, before) / square(after, after)) > factor
        # Light is kept: what footprints move about sums to the same.
        assert weights @ pool(converged[0]).mean((0, 2)) == pytest.approx(mean, rel=bias / 2)


# --- how many rays ----------------------------------------------------------------------------------------------------


def cost(variance: np.ndarray, burden: np.ndarray, share: np.ndarray, power: float) -> float:
    return float((variance * burden * share**-power).sum() / (variance * burden).sum())


@pytest.mark.parametrize("power", [1.0, 1.4, 1.8])
def test_shares_are_nearly_the_best_there_are(power: float) -> None:
    """Against all 6^5 ways to deal levels to five texels without spending more than the mean."""
    levels = np.array(list(itertools.product(2.0 ** np.arange(-2, 4), repeat=5)))
    levels = levels[levels.mean(1) <= 1]
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(60):
        variance, burden = rng.lognormal(sigma=2.0, size=5), rng.lognormal(sigma=0.5, size=5)
        best = min(cost(variance, burden, share, power) for share in levels)
        ratio, share = allot(variance, burden, power)
        assert ratio == pytest.approx(cost(variance, burden, share, power))
        assert share.mean() <= 1
        assert best <= ratio + 1e-12
        assert ratio == 1 or ratio < effort._WORTHWHILE
        assert ratio == 1 or (np.log2(share) % 1 == 0).all()
        ratios.append(ratio / best)
    # With five texels alone, one step of one level is a fifth of the budget.
    assert np.median(ratios) < 1.15
    assert max(ratios) < 2


@pytest.mark.parametrize("power", [1.0, 1.3, 1.8])
@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0, 2.0])
def test_many_texels_come_close_to_the_continuous_optimum(power: float, sigma: float) -> None:
    """Without levels, n goes with cost^(1 / (1 + power)): least total mean(c^(1/(1+p)))^(1+p) (Lagrange)."""
    rng = np.random.default_rng(1)
    variance, burden = rng.lognormal(sigma=sigma, size=4000), rng.lognormal(sigma=0.2 * sigma, size=4000)
    ratio, share = allot(variance, burden, power)
    product = variance * burden
    best = np.mean(product ** (1 / (1 + power))) ** (1 + power) / product.mean()
    assert best <= ratio + 1e-12
    if ratio == 1:
        assert (share == 1).all()
        assert best > 0.8
    else:
        assert ratio < (1.15 if sigma < 2 else 1.25) * best  # levels of two cost 6 to 11 %; none is above 8
        assert 0.97 < share.mean() <= 1
        assert (share[product.argsort()][1:] >= share[product.argsort()][:-1]).all()


def test_the_promised_ratio_is_what_a_simulation_gives() -> None:
    """Independent normal numbers, 64 a texel on average, by area."""
    rng = np.random.default_rng(3)
    variance, burden = rng.lognormal(sigma=1.5, size=300), rng.lognormal(sigma=0.5, size=300)
    ratio, share = allot(variance, burden)
    assert ratio < 0.8
    rays = np.rint(64 * share).astype(int)
    assert rays.sum() <= 64 * 300
    error = np.zeros(2)
    for texel in range(300):
        draws = np.sqrt(variance[texel]) * rng.normal(size=(200, rays[texel] + 64))
        means = draws[:, : rays[texel]].mean(1), draws[:, rays[texel] :].mean(1)
        error += [burden[texel] * (part**2).mean() for part in means]
    assert error[0] / error[1] == pytest.approx(ratio, rel=0.05)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_shares_do_not_depend_on_units(scale: float) -> None:
    rng = np.random.default_rng(0)
    variance = rng.lognormal(sigma=2.0, size=500)
    with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
        warnings.simplefilter("error")
        for power in (1.0, 1.8):
            ratio, share = allot(variance * scale, np.full(500, 1 / scale), power)
            plain = allot(variance, np.ones(500), power)
            assert ratio == pytest.approx(plain[0], rel=1e-6)
            assert (share != plain[1]).mean() < 0.01
            once, twice = allot(variance * scale, np.full(500, scale)), allot(variance, np.ones(500))
            assert once[0] == pytest.approx(twice[0], rel=1e-6)


def test_awkward_variances() -> None:
    with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
        warnings.simplefilter("error")
        for variance in (np.zeros(7), np.ones(1), np.full(1, 1e-30), np.ones(9), np.zeros(1)):
            for power in (1.0, 1.8):
                ratio, share = allot(variance, np.ones(len(variance)), power)
                assert ratio == 1
                np.testing.assert_array_equal(share, 1)
        wide = 10.0 ** np.linspace(-30, 30, 61)
        ratio, share = allot(wide, np.ones(61), 1.8)
        assert 0 < ratio < 0.5
        assert share.mean() <= 1
        assert share[-1] == 8
        single = np.zeros(50)
        single[3] = 1
        ratio, share = allot(single, np.ones(50))
        assert share[3] == 8
        assert ratio == pytest.approx(1 / 8)


def measured_noise(box: Made, light: np.ndarray, choice: Choice, halves: int) -> float:
    """Relative RMSE over the surface, from maps of two streams that share nothing."""
    runs = []
    for run in range(2):
        parts = []
        for half in range(halves):
            out = np.zeros((3, box.atlas.count, 3), np.float32)
            for _ in box.operator.gather(light, out, choice.rays, seed=50, stream=f"measure {run} {half}"):
                pass
            parts.append(out)
        maps = np.mean(parts, axis=0)
        runs.append(np.stack([choice.footprints.pooled(lit) for lit in maps]) if choice.footprints else maps)
    weights = box.atlas.area / box.atlas.area.sum()
    mean = weights @ np.mean(runs, axis=0).mean((0, 2))
    return float(np.sqrt(weights @ ((runs[0] - runs[1]) ** 2).mean((0, 2)) / 2) / mean)


CHOICES: dict[str, dict[str, Any]] = {
    "0.1": {"target_noise": 0.1},
    "0.03": {"target_noise": 0.03},
    "0.015": {"target_noise": 0.015},
    "even": {"target_noise": 0.03, "adaptive": False},
    "alone": {"target_noise": 0.05, "footprint": 0.0},
    "alone and even": {"target_noise": 0.05, "footprint": 0.0, "adaptive": False},
    "fixed": {"samples": 100, "test_samples": 200},
}


@pytest.mark.parametrize(
    ("name", "held_out"), [*((name, False) for name in CHOICES), *((name, True) for name in ("0.1", "0.03", "fixed"))]
)
def test_expected_noise_is_what_comes(box: Made, light: np.ndarray, name: str, held_out: bool) -> None:
    config = TransportConfig(**CHOICES[name])
    choice = choose_rays(box.operator, light, config, held_out=held_out, seed=3, stream="choice")
    halves = 2 if held_out else 1
    noise = measured_noise(box, light, choice, halves)
    assert choice.facts["noise_expected"] == pytest.approx(noise, rel=0.3)
    if name != "fixed":
        # Rays come in eights, and no more than are needed.
        assert 0.85 * config.target_noise < choice.facts["noise_expected"] <= 1.005 * config.target_noise
        assert noise < 1.3 * config.target_noise
    assert choice.facts["samples"] == pytest.approx(halves * choice.rays.mean(), abs=0.06)
    assert (choice.footprints is None) is (held_out or config.footprint == 0)
    assert ("variance_over_even" in choice.facts) is (config.adaptive and not held_out)
    if held_out or not config.adaptive:
        assert (choice.rays == choice.rays[0]).all()
    if name == "fixed":
        assert choice.rays.mean() <= 100
        assert choice.rays.mean() > 95


@pytest.mark.parametrize("footprint", [0.0, 0.1])
def test_uneven_rays_are_worth_what_they_promise(box: Made, light: np.ndarray, footprint: float) -> None:
    """Squared error over that of as many even rays, from eight pairs of runs."""
    for seed in (3, 4):
        config = TransportConfig(samples=64, footprint=footprint)
        choice = choose_rays(box.operator, light, config, held_out=False, seed=seed, stream="choice")
        even = replace(choice, rays=np.full(box.atlas.count, 64))
        ratio = (measured_noise(box, light, choice, 1) / measured_noise(box, light, even, 1)) ** 2
        assert choice.facts["variance_over_even"] == pytest.approx(ratio, rel=0.25)
        assert ratio < 1.1


@pytest.mark.parametrize("held_out", [False, True])
@pytest.mark.parametrize("samples", [1, 3, 17])
def test_fixed_samples_are_respected(box: Made, light: np.ndarray, samples: int, held_out: bool) -> None:
    config = TransportConfig(samples=samples, test_samples=2 * samples, adaptive=False)
    choice = choose_rays(box.operator, light, config, held_out=held_out, seed=0, stream="fixed")
    np.testing.assert_array_equal(choice.rays, samples)
    assert choice.facts["samples"] == (2 if held_out else 1) * samples
    spread = choose_rays(
        box.operator, light, config.model_copy(update={"adaptive": True}), held_out=False, seed=0, stream="fixed"
    )
    assert spread.rays.min() >= 1
    assert spread.rays.mean() <= samples or samples < 4


@pytest.mark.parametrize("held_out", [False, True])
@pytest.mark.parametrize("scale", [0.0, 1e-25, 1e-10, 1e10, 1e25])
def test_dark_and_dazzling_scenes_give_the_same_choice(box: Made, light: np.ndarray, scale: float, held_out: bool) -> None:
    with warnings.catch_warnings(), np.errstate(over="raise", invalid="raise", divide="raise"):
        warnings.simplefilter("error")
        config = TransportConfig(target_noise=0.05)
        found = choose_rays(box.operator, light * np.float32(scale), config, held_out=held_out, seed=0, stream="scale")
    assert all(np.isfinite(value) for value in found.facts.values())
    if scale == 0:
        assert found.facts["noise_expected"] == 0
        assert (found.rays == (4 if held_out else 8)).all()
        return
    plain = choose_rays(box.operator, light, config, held_out=held_out, seed=0, stream="scale")
    assert found.facts["samples"] == pytest.approx(plain.facts["samples"], rel=0.05)
    assert found.facts["noise_expected"] == pytest.approx(plain.facts["noise_expected"], rel=0.05)


def test_choices_are_addressed(box: Made, light: np.ndarray) -> None:
    config = TransportConfig(target_noise=0.05)
    one, same, other = (
        choose_rays(box.operator, light, config, held_out=False, seed=seed, stream="again") for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one.rays, same.rays)
    for name in one.facts.keys() - {"seconds_expected"}:  # a clock's
        assert one.facts[name] == same.facts[name]
    assert (one.rays != other.rays).any()
