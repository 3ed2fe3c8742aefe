"""Gather rays: even numbers, ways to surfaces against brute force, and compiled loops against plain ones."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import oracles
import pytest
from scipy.stats import qmc

from ddprt import warp
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.mesh import Scene
from ddprt.transport import gather, operator
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import BACK, NOTHING, Landing, Pattern, Receivers, seen_from


def uniform(pattern: Pattern) -> np.ndarray:
    """The four uniform numbers behind each ray: of its direction, and of its place."""
    disk = pattern.disk.astype(float)
    z = np.sqrt(np.maximum(1 - (disk**2).sum(-1, keepdims=True), 0))
    u = np.concatenate([warp.invert_cosine(np.concatenate([disk, z], -1)), pattern.place], -1)
    return np.clip(u, 0, 1 - 1e-9)


# --- even numbers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [2, 7])
def test_any_ray_of_any_block_is_uniform(samples: int) -> None:
    """One ray of each of 800 patterns: they are independent, so chi-square holds as it stands."""
    rng = np.random.default_rng(0)
    drawn = []
    for seed in range(800):
        pattern = Pattern.of(samples, seed)
        drawn.append(uniform(pattern)[rng.integers(samples), rng.integers(pattern.disk.shape[1])])
    cells = (np.array(drawn) * 8).astype(int)
    for one in range(4):
        for other in range(one):
            counts = np.bincount(8 * cells[:, one] + cells[:, other], minlength=64)
            assert oracles.chi_square(counts, np.ones(64)) > 1e-4


def test_a_block_is_sorted_by_direction_not_by_place() -> None:
    """Sample k goes about the same way in all blocks; where it starts has nothing to do with that."""
    pattern = Pattern.of(64, 3)
    together = np.linalg.norm(pattern.disk.std(1), axis=1).mean()
    assert together < 0.25 * np.linalg.norm(pattern.disk.reshape(-1, 2).std(0))
    assert pattern.place.std(1).mean() == pytest.approx(np.sqrt(1 / 12), rel=0.05)


@pytest.mark.parametrize("samples", [16, 64])
def test_blocks_and_aligned_groups_of_them_are_nets(samples: int) -> None:
    """A power of two of points: each box of area 1 / points, however long, holds exactly one direction.

    Digits of places come later in Sobol's table: up to three to a box. A point in a thousand may sit on a rim in float32.
    """
    u = uniform(Pattern.of(samples, 11))
    for size in (1, 4, 16, 256):
        digits = (samples * size).bit_length() - 1
        for dimensions, most in ((slice(0, 2), 1), (slice(2, 4), 3)):
            for first in range(0, 256, size):
                points = u[:, first : first + size].reshape(-1, 4)[:, dimensions]
                for split in range(digits + 1):
                    box = (points * [1 << split, 1 << (digits - split)]).astype(int) @ [1 << (digits - split), 1]
                    counts = np.bincount(box, minlength=samples * size)
                    assert (counts > most).sum() <= samples * size / 1000


# Discrepancy of independent numbers over ours, for one block, 2 x 2 and 4 x 4: three quarters of what was measured.
EVENNESS = {
    1: (0.7, 1.0, 1.9),
    3: (0.8, 1.0, 2.3),
    7: (0.9, 1.6, 2.7),
    16: (2.0, 3.2, 5.5),
    24: (1.5, 2.8, 5.6),
    48: (2.4, 4.0, 7.0),
    100: (2.7, 4.8, 8.0),
    300: (3.6, 7.0, 11.0),
}


@pytest.mark.parametrize("samples", EVENNESS)
def test_numbers_are_far_more_even_than_independent_ones(samples: int) -> None:
    """Root mean square L2 star discrepancy; for n independent points in d dimensions its square is (2^-d - 3^-d) / n."""
    ours = np.zeros((3, 2))
    for k, size in enumerate((1, 4, 16)):
        patterns = [uniform(Pattern.of(samples, seed)) for seed in (1, 2)]
        starts = range(0, min(patterns[0].shape[1], (8 if samples < 300 else 2) * size), size)
        groups = [u[:, first : first + size].reshape(-1, 4) for u in patterns for first in starts]
        for j, dimensions in enumerate((slice(0, 2), slice(2, 4))):
            found = [qmc.discrepancy(group[:, dimensions], method="L2-star") for group in groups]
            ours[k, j] = np.sqrt((1 / 4 - 1 / 9) / (samples * size)) / np.sqrt(np.mean(np.square(found)))
    assert (ours.min(1) > EVENNESS[samples]).all(), ours


@pytest.mark.parametrize(("samples", "blocks"), [(1, 256), (256, 256), (257, 128), (5000, 8), (65536, 4)])
def test_every_texel_gets_a_block(samples: int, blocks: int) -> None:
    pattern = Pattern(np.zeros((1, 4, 2), np.float32), np.zeros((1, 4, 2), np.float32))
    if samples < 65536:
        pattern = Pattern.of(samples, 0)
        assert pattern.disk.shape == pattern.place.shape == (samples, blocks, 2)
    row, column = np.divmod(np.arange(48 * 48), 48)
    block, turn = pattern.deal(row, column, 5)
    assert block.dtype == np.int32
    np.testing.assert_allclose((turn.astype(float) ** 2).sum(1), 1, rtol=1e-6)
    image = block.reshape(48, 48)
    side = 1 << ((blocks.bit_length() - 1) // 2)  # the widest aligned square whose texels can all differ
    for top in range(0, 48, side):
        for left in range(0, 48, side):
            square = image[top : top + side, left : left + side]
            assert len(np.unique(square)) == square.size
            assert 0 <= square.min() <= square.max() < blocks
            # Consecutive blocks of the sequence, but for the tile's shuffle: aligned groups stay groups.
            assert len(np.unique(square // square.size)) == 1


def test_tiles_are_shuffled_and_turned_each_in_its_own_way() -> None:
    pattern = Pattern.of(4, 0)
    row, column = np.divmod(np.arange(128 * 128), 128)
    deals = [pattern.deal(row, column, seed) for seed in (0, 1)]
    tiles = (row // 16) * 8 + column // 16
    for block, turn in deals:
        angle = np.arctan2(turn[:, 1], turn[:, 0])
        first = np.array([np.flatnonzero(tiles == tile)[0] for tile in range(64)])
        np.testing.assert_array_equal(angle, angle[first][tiles])
        assert len(np.unique(angle[first])) == 64
        assert len(np.unique(block[first])) > 40  # 64 draws out of 256: 57 different ones expected
        quarter = np.bincount(((angle[first] / np.pi + 1) * 2).astype(int), minlength=4)
        assert oracles.chi_square(quarter, np.ones(4)) > 1e-4
        assert len(np.unique(turn[first, 0] * np.roll(turn[first, 0], 1))) > 60  # neighbours' turns do not repeat
    assert (deals[0][0] != deals[1][0]).mean() > 0.9
    assert (deals[0][1] != deals[1][1]).any(1).all()


def test_a_texels_deal_does_not_depend_on_which_others_are_dealt_to() -> None:
    pattern = Pattern.of(4, 0)
    row, column = np.divmod(np.arange(64 * 64), 64)
    whole = pattern.deal(row, column, 7)
    for chosen in (np.flatnonzero(row >= 16), np.flatnonzero((row // 16 + column // 16) % 2 == 0), np.array([4095])):
        part = pattern.deal(row[chosen], column[chosen], 7)
        for mine, all_of_them in zip(part, whole, strict=True):
            np.testing.assert_array_equal(mine, all_of_them[chosen])


# --- unbiased ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("samples", "seeds"), [(1, 400), (3, 300), (16, 200)])
def test_the_mean_over_seeds_is_the_truth(plates: Scene, samples: int, seeds: int) -> None:
    """Shares of the hemisphere that texels of the lower plate see of the upper one, by Lambert's formula and quadrature."""
    atlas, tracer = build_atlas(plates, 16), Tracer.of(plates, 1)
    upper = atlas.position[:, 1] > 0.5
    landing = Landing.of(atlas, np.where(upper, 0, NOTHING).astype(np.int32))
    lower = np.flatnonzero(~upper)
    corner = lower[np.abs(atlas.position[lower]).sum(1).argmax()]
    chosen = np.unique(np.append(lower[:: len(lower) // 5], corner))
    corners = plates.corners[plates.geometric_normals[:, 1] < 0].reshape(-1, 3)[[0, 1, 2, 5]]
    truth = []
    for texel in chosen:
        total = 0.0
        for piece in np.flatnonzero(atlas.piece_texel == texel):
            a, b, c = atlas.piece_corners[piece].astype(float) + atlas.centre
            middles = [(i + (1 + flip) / 3, j + (1 + flip) / 3) for i in range(6) for j in range(6 - i) for flip in (0, 1)]
            inside = [(x / 6, y / 6) for x, y in middles if x + y < 6]
            assert len(inside) == 36
            values = [oracles.polygon_irradiance(corners, 1 / np.pi, a + x * (b - a) + y * (c - a), np.array([0.0, 1, 0]))
                      for x, y in inside]  # fmt: skip
            total += atlas.piece_area[piece] * np.mean(values)
        truth.append(total / atlas.area[texel])
    found = np.zeros((seeds, len(chosen)))
    for seed in range(seeds):
        receivers = Receivers.texels(atlas, samples, seed, "unbiased", chosen)
        for seen in seen_from(tracer, receivers, slice(0, len(chosen)), landing):
            found[seed] += (seen.cells == 0).sum(0) / samples
    error = found.std(0, ddof=1) / np.sqrt(seeds)
    assert (error < 0.15 * np.array(truth)).all()
    assert (np.abs(found.mean(0) - truth) < 4 * error + 1e-4).all()  # the quadrature: 36 places per triangle of a texel
    if samples == 16:  # evenness pays: less than half of the variance of independent rays
        assert (found.var(0, ddof=1) < 0.5 * np.array(truth) * (1 - np.array(truth)) / samples).mean() > 0.7


# --- what rays see ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small_atlas(cornell: Scene) -> Atlas:
    return build_atlas(cornell, 32)


def slow_cell(
    scene: Scene, atlas: Atlas, tracer: Tracer, receivers: Receivers, receiver: int, sample: int, of_texel: np.ndarray
) -> tuple[int, float, bool]:
    """Cell that one ray meets, how far away, and whether that is too close to a rim to tell."""
    block, (cosine, sine) = receivers.block[receiver], receivers.turn[receiver].astype(float)
    place, face = receivers.sampler.sample(receivers.patch[[receiver]], receivers.pattern.place[sample, [block]])
    tangent, bitangent, _ = tracer.frames[face[0]].astype(float)
    normal = scene.geometric_normals[face[0]]
    x, y = receivers.pattern.disk[sample, block].astype(float)
    x, y = cosine * x - sine * y, sine * x + cosine * y
    direction = x * tangent + y * bitangent + np.sqrt(max(0, 1 - x * x - y * y)) * normal
    origin = place[0] + float(tracer.offset) * normal + atlas.centre
    triangle, distance, u, v = oracles.first_hit(scene, origin, direction)
    if triangle < 0:
        return NOTHING, np.inf, False
    if scene.geometric_normals[triangle] @ direction >= 0:
        return BACK, distance, False
    at = np.array([1 - u - v, u, v]) @ atlas.uv[triangle] * atlas.resolution
    column, row = np.clip(at.astype(int), 0, atlas.resolution - 1)
    texel, fine = atlas.lookup[row, column], 1
    parted = np.flatnonzero(atlas.parted == atlas.slot[row, column])
    if atlas.slot[row, column] >= 0 and len(parted):
        fine = atlas.part.shape[1]
        down, across = np.clip(((at - [column, row]) * fine).astype(int), 0, fine - 1)[::-1]
        texel = atlas.part[parted[0], down, across]
    rim = np.abs(at * fine - np.rint(at * fine)).min() < 1e-3
    return (of_texel[texel] if texel >= 0 else NOTHING), distance, bool(rim)


def agree(
    scene: Scene, atlas: Atlas, tracer: Tracer, receivers: Receivers, tile: slice, of_texel: np.ndarray, pairs: np.ndarray
) -> set[int]:
    """Compares chosen (sample, receiver of the tile) pairs with the slow twin; gives the kinds of cells that there were."""
    chunks = list(seen_from(tracer, receivers, tile, Landing.of(atlas, of_texel)))
    cells, distance = (np.concatenate([getattr(seen, name) for seen in chunks]) for name in ("cells", "distance"))
    assert cells.shape == (receivers.samples, tile.stop - tile.start)
    kinds, wrong, unclear = set(), 0, 0
    for sample, receiver in pairs:
        cell, away, rim = slow_cell(scene, atlas, tracer, receivers, tile.start + receiver, sample, of_texel)
        unclear += rim
        if rim:
            continue
        kinds.add(min(cell, 0))
        wrong += cells[sample, receiver] != cell
        if np.isinf(away):
            assert distance[sample, receiver] > 1e30
        elif cells[sample, receiver] == cell:
            # Float32 coordinates are good to 3e-8 m; rays that graze a surface stretch that.
            assert distance[sample, receiver] == pytest.approx(away, rel=2e-3, abs=1e-6)
    assert unclear <= 0.05 * len(pairs) + 2
    assert wrong <= 0.002 * len(pairs)  # silhouettes, where float32 decides
    return kinds


def some(rng: np.random.Generator, samples: int, count: int, most: int = 250) -> np.ndarray:
    pairs = np.stack(np.divmod(np.arange(samples * count), count), 1)
    return pairs if len(pairs) <= most else rng.permutation(pairs)[:most]


@pytest.mark.parametrize("samples", [1, 3, 7, 16, 300, 5000])
def test_rays_land_where_brute_force_says(cornell: Scene, small_atlas: Atlas, samples: int) -> None:
    rng = np.random.default_rng(samples)
    tracer = Tracer.of(cornell, 1)
    receivers = Receivers.texels(small_atlas, samples, 4, "law")
    # Cells are groups of texels, and a tenth of the texels is in none.
    of_texel = np.where(rng.random(small_atlas.count) < 0.1, NOTHING, rng.integers(0, 200, small_atlas.count)).astype(np.int32)
    tiles = list(receivers.tiles())
    for tile in (tiles[0], tiles[-1]) if len(tiles) > 1 else tiles:
        agree(cornell, small_atlas, tracer, receivers, tile, of_texel, some(rng, samples, tile.stop - tile.start))


def test_all_kinds_of_cells_occur(cornell: Scene, small_atlas: Atlas) -> None:
    """Fronts, backs (from under the blocks) and the open side of the box; single receivers, and a last tile cut short."""
    rng = np.random.default_rng(8)
    tracer, of_texel = Tracer.of(cornell, 1), np.arange(small_atlas.count, dtype=np.int32)
    above = small_atlas.position + np.array([0, 1e-4, 0])
    floor = small_atlas.position[:, 1] == 0
    under = np.flatnonzero(floor & np.array([oracles.inside_a_block(place) for place in above]))
    assert len(under) > 3
    receivers = Receivers.texels(small_atlas, 24, 4, "law", np.concatenate([under, np.arange(0, small_atlas.count, 9)]))
    count = receivers.count
    kinds = [
        agree(cornell, small_atlas, tracer, receivers, tile, of_texel, some(rng, 24, tile.stop - tile.start, 500))
        for tile in (
            slice(0, len(under)),
            slice(len(under), count),
            slice(0, 1),
            slice(count - 1, count),
            slice(count - 3, count),
        )
    ]
    assert BACK in kinds[0]
    assert {0, NOTHING} <= kinds[1]


def test_parted_texels_are_looked_up_square_by_square(cornell: Scene, small_atlas: Atlas) -> None:
    """Each fifth texel is cut into 5 x 5 squares that belong to it, to any other texel, or to none."""
    rng = np.random.default_rng(2)
    parted = np.arange(0, small_atlas.count, 5)
    part = rng.integers(-1, small_atlas.count, (len(parted), 5, 5)).astype(np.int32)
    part[rng.random(part.shape) < 0.2] = -1
    cut = replace(small_atlas, parted=parted, part=part)
    receivers = Receivers.texels(cut, 16, 4, "law", np.arange(0, cut.count, 3))
    tile = slice(0, receivers.count)
    agree(
        cornell,
        cut,
        Tracer.of(cornell, 1),
        receivers,
        tile,
        np.arange(cut.count, dtype=np.int32),
        some(rng, 16, tile.stop, 900),
    )


def everything(receivers: Receivers, look: Callable[[slice], Any]) -> tuple[np.ndarray, np.ndarray]:
    """Cells and distances of all receivers, tile by tile."""
    columns = []
    for tile in receivers.tiles():
        columns.append(
            [np.concatenate(part) for part in zip(*((seen.cells, seen.distance) for seen in look(tile)), strict=True)]
        )
    return tuple(np.concatenate(part, 1) for part in zip(*columns, strict=True))  # type: ignore[return-value]


@pytest.mark.parametrize("samples", [1, 3, 16, 300])
def test_cells_do_not_depend_on_tiles_and_chunks(
    samples: int, cornell: Scene, small_atlas: Atlas, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracer = Tracer.of(cornell, 1)
    landing = Landing.of(small_atlas, np.arange(small_atlas.count, dtype=np.int32))
    receivers = Receivers.texels(small_atlas, samples, 4, "law", np.arange(0, small_atlas.count, 19))
    look = lambda tile: seen_from(tracer, receivers, tile, landing)  # noqa: E731
    usual = everything(receivers, look)
    assert usual[0].shape == (samples, receivers.count)
    for least, call in ((1, 1), (5, 64), (receivers.count - 1, 100), (1000, 1 << 20)):
        monkeypatch.setattr(gather, "TILE", least)
        monkeypatch.setattr(gather, "_CALL", call)
        tiles = list(receivers.tiles())
        assert [tile.start for tile in tiles] + [receivers.count] == [0] + [tile.stop for tile in tiles]
        assert all(seen.cells.size <= max(call, tiles[0].stop) for seen in look(tiles[0]))
        before = tracer.rays
        for mine, other in zip(everything(receivers, look), usual, strict=True):
            np.testing.assert_array_equal(mine, other)
        assert tracer.rays - before == samples * receivers.count


def test_neighbours_do_not_share_directions_or_places(small_atlas: Atlas) -> None:
    """Streams, seeds and sample counts have numbers of their own."""
    made = [Receivers.texels(small_atlas, samples, seed, stream)
            for samples, seed, stream in ((8, 0, "a"), (8, 0, "a"), (8, 1, "a"), (8, 0, "b"), (9, 0, "a"))]  # fmt: skip
    np.testing.assert_array_equal(made[0].pattern.disk, made[1].pattern.disk)
    np.testing.assert_array_equal(made[0].block, made[1].block)
    for other in made[2:]:
        # Two sets of 4096 numbers with 24 bits meet once by chance.
        assert np.isin(other.pattern.place, made[0].pattern.place).mean() < 0.01
        assert (other.turn != made[0].turn).mean() > 0.99


# --- compiled loops ---------------------------------------------------------------------------------------------------


@pytest.fixture(params=[1, 2, 3, 4, 5, 7, 8, 30])
def seen(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    """Cells of as many samples at nine receivers, a third of them dark, and distances, some of them endless."""
    rng = np.random.default_rng(request.param)
    cells = rng.integers(0, 11, (request.param, 9)).astype(np.int32)
    dark = rng.random(cells.shape)
    cells[dark < 0.2], cells[dark > 0.85] = NOTHING, BACK
    cells[:, 3] = BACK
    distance = rng.random(cells.shape).astype(np.float32)
    distance[cells == NOTHING] = np.inf
    return cells, distance


def test_light_is_added_ray_by_ray(seen: tuple[np.ndarray, np.ndarray]) -> None:
    """Whole numbers are exact in float32, so every bit must agree; sums that are there already are kept."""
    cells, _ = seen
    rng = np.random.default_rng(0)
    table = np.concatenate([rng.integers(0, 1000, (11, 7)), np.zeros((1, 7))]).astype(np.float32)
    sums = rng.integers(0, 1000, (9, 7)).astype(np.float32)
    expected = sums.astype(float)
    for sample in range(len(cells)):
        for receiver in range(9):
            if cells[sample, receiver] >= 0:
                expected[receiver] += table[cells[sample, receiver]]
    operator._add_seen(cells, table, sums)
    np.testing.assert_array_equal(sums, expected)


def test_landings_are_counted_ray_by_ray(seen: tuple[np.ndarray, np.ndarray]) -> None:
    cells, _ = seen
    home = np.array([0, 0, 1, 1, 1, 2, 3, 3, 4, 4, 5], np.int32)
    rows = np.full((9, 6), 2, np.float32)
    expected = rows.astype(float)
    for sample in range(len(cells)):
        for receiver in range(9):
            if cells[sample, receiver] >= 0:
                expected[receiver, home[cells[sample, receiver]]] += 1
    operator._count_seen(cells, home, rows)
    np.testing.assert_array_equal(rows, expected)


def test_nearness_is_added_ray_by_ray(seen: tuple[np.ndarray, np.ndarray]) -> None:
    """Backs count, since they are near; what escapes does not. Touching counts much, but not without end."""
    cells, distance = seen
    distance = distance.copy()
    distance[0, 0], cells[0, 0] = 0, 5
    near = np.ones(9)
    expected = near.copy()
    for sample in range(len(cells)):
        for receiver in range(9):
            if np.isfinite(distance[sample, receiver]):
                expected[receiver] += 1 / max(float(distance[sample, receiver]), 1e-30)
    operator._add_nearness(cells, distance, near)
    assert np.isfinite(near).all()
    np.testing.assert_allclose(near, expected, rtol=1e-6)  # one division in float32 each


def test_rows_are_stored_as_maps() -> None:
    """Only the given texels are written, lightings apart, channels in order."""
    rng = np.random.default_rng(0)
    sums, texels = rng.random((5, 6)).astype(np.float32), np.array([7, 0, 3, 9, 4])
    out = np.full((2, 11, 3), np.nan, np.float32)
    operator._store(sums, texels, np.float32(0.25), out)
    for lighting in range(2):
        for texel in range(11):
            for channel in range(3):
                if texel in texels:
                    expected = 0.25 * sums[texels.tolist().index(texel), 3 * lighting + channel]
                    assert out[lighting, texel, channel] == expected
                else:
                    assert np.isnan(out[lighting, texel, channel])
