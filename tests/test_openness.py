"""What of a lightmap is in the open: exact areas, exact darkness behind thin walls, and nothing lost elsewhere."""

import dataclasses

import numpy as np
import oracles
import pytest

from ddprt.errors import UserError
from ddprt.lights import parse_lighting
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted, hollow, rectangle
from ddprt.transport import openness
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import BACK, NOTHING, Landing, Receivers, seen_from
from ddprt.transport.openness import open_atlas
from ddprt.transport.reference import on_texels, trace_reference
from ddprt.transport.squares import SQUARES

LAMP = parse_lighting({"type": "point", "position": [0.45, 0.9, 0.6], "intensity": [1, 1, 1]})


def opened(scene: Scene, atlas: Atlas, threads: int = 0) -> tuple[Atlas, dict[str, int]]:
    return open_atlas(Tracer.of(scene, threads), atlas, scene)


def before(whole: Atlas, reduced: Atlas) -> np.ndarray:
    """Index in the whole atlas of every texel of the reduced one."""
    return whole.slot.ravel()[reduced.texel]


def landed(scene: Scene, atlas: Atlas, samples: int = 64) -> np.ndarray:
    """Texels that rays from every texel land on, one row each."""
    landing = Landing.of(atlas, np.arange(atlas.count, dtype=np.int32))
    receivers, tracer = Receivers.texels(atlas, samples, 0, "test"), Tracer.of(scene)
    tiles = (np.concatenate([seen.cells for seen in seen_from(tracer, receivers, tile, landing)]) for tile in receivers.tiles())
    return np.concatenate([cells.T for cells in tiles])


@pytest.fixture(scope="module")
def faults() -> Scene:
    return build("faults")


# --- what is kept -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [64, 150])
def test_the_open_floor_of_the_cornell_box(cornell: Scene, resolution: int) -> None:
    """Its area less the blocks' footprints, less a rim: whatever shares a square with an edge of a footprint."""
    whole = build_atlas(cornell, resolution)
    reduced, facts = opened(cornell, whole)
    corners = np.array([block for block, _ in oracles.BLOCKS])
    along = np.roll(corners, -1, axis=1) - corners
    rim = np.linalg.norm(along, axis=2).sum() * np.sqrt(2) / SQUARES / whole.texels_per_metre
    floor, all_floor = np.abs(reduced.position[:, 1]) < 1e-9, np.abs(whole.position[:, 1]) < 1e-9
    open_area = whole.area[all_floor].sum() - sum(
        abs(np.sum(block[:, 0] * np.roll(block[:, 1], -1) - block[:, 1] * np.roll(block[:, 0], -1))) / 2 for block in corners
    )
    # Rays run 1/64 of a texel above the floor, the blocks' sides are upright: no other error than float32.
    assert open_area - rim < reduced.area[floor].sum() < open_area * (1 + 1e-6)
    assert reduced.area[floor].sum() < open_area - 0.2 * rim  # the bound is not idle
    # Nothing but the feet of the blocks is lost elsewhere: less than a square along their edges.
    assert whole.area[~all_floor].sum() - reduced.area[~floor].sum() < 1e-3 * rim
    assert facts["buried"] == whole.count - reduced.count > 0
    assert facts["trimmed"] > 0


def test_places_agree_with_prisms(cornell: Scene, cornell_atlas: Atlas) -> None:
    """Every point that is kept is outside the blocks; every texel that is dropped was inside, but for squares on the rim."""
    reduced, _ = opened(cornell, cornell_atlas)
    rng = np.random.default_rng(0)
    floor = np.flatnonzero(reduced.position[:, 1] == 0)
    place, _ = reduced.sampler.sample(np.repeat(floor, 40), rng.random((40 * len(floor), 2), np.float32))
    inside = [oracles.inside_a_block(point + cornell.centre + [0, 1e-4, 0]) for point in place.astype(float)]
    assert not any(inside)
    gone = np.flatnonzero((reduced.slot.ravel()[cornell_atlas.texel] < 0) & (cornell_atlas.position[:, 1] == 0))
    place, _ = cornell_atlas.sampler.sample(np.repeat(gone, 40), rng.random((40 * len(gone), 2), np.float32))
    inside = [oracles.inside_a_block(point + cornell.centre + [0, 1e-4, 0]) for point in place.astype(float)]
    assert len(gone) > 30
    assert np.mean(inside) > 0.995


def test_what_is_left_is_measured_anew(cornell: Scene, cornell_atlas: Atlas) -> None:
    reduced, _ = opened(cornell, cornell_atlas)
    index = before(cornell_atlas, reduced)
    same = reduced.area == cornell_atlas.area[index]
    assert 0.8 < same.mean() < 1
    for name in ("position", "normal", "geometric_normal", "albedo", "coverage"):
        np.testing.assert_array_equal(getattr(reduced, name)[same], getattr(cornell_atlas, name)[index[same]])
    np.testing.assert_allclose(np.bincount(reduced.piece_texel, reduced.piece_area), reduced.area, rtol=1e-12)
    edges = reduced.piece_corners[:, 1:] - reduced.piece_corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    # Corners are float32 of half a metre: 3e-8 m on edges of a texel, 0.03 m.
    np.testing.assert_allclose(np.bincount(reduced.piece_texel, area), reduced.area, atol=2 * 3e-8 * 0.03)
    share = reduced.area / cornell_atlas.area[index]
    np.testing.assert_allclose(reduced.coverage, share * cornell_atlas.coverage[index], rtol=1e-6)
    np.testing.assert_allclose(reduced.albedo, cornell_atlas.albedo[index], rtol=1e-12)  # one paint per surface
    np.testing.assert_array_equal(reduced.geometric_normal, cornell_atlas.geometric_normal[index])
    assert (reduced.slot.ravel()[reduced.texel] == np.arange(reduced.count)).all()
    assert (reduced.slot >= 0).sum() == reduced.count
    for texel in np.flatnonzero(~same & (reduced.position[:, 1] == 0)):
        assert not oracles.inside_a_block(reduced.position[texel] + [0, 1e-4, 0])


@pytest.mark.parametrize("name", ["furnace", "corridor", "plates", "convex"])
def test_scenes_without_faults_are_left_alone(name: str) -> None:
    scene = build(name)
    whole = build_atlas(scene, 128)  # texels of the corridor are thinner than its wall
    reduced, facts = opened(scene, whole)
    assert reduced is whole
    assert not any(facts.values())


@pytest.mark.parametrize("height", [0.05, 0.5])
def test_a_sheet_seen_from_behind_costs_only_what_it_hides(height: float) -> None:
    """The floor under a one-sided sheet goes where the sheet's back fills more than half of its view, and nowhere else."""
    floor, sheet = (
        rectangle((-1.0, -1.0), (1.0, 1.0), 0.0, 1, facing=1),
        rectangle((-0.3, -0.3), (0.3, 0.3), height, 1, facing=1),
    )
    scene = faceted("sheet", np.array([floor, sheet]), (Material("grey", (0.5,) * 3),))
    whole = build_atlas(scene, 64)
    reduced, _ = opened(scene, whole)
    lost = whole.area.sum() - reduced.area.sum()
    # View factor of a square, 1.2 heights away from its middle: 0.35; 12 heights: nearly 1, and one half below its edges.
    assert lost == pytest.approx(0.36 if height == 0.05 else 0.0, rel=0.15)
    assert abs(reduced.area[np.abs(reduced.position[:, 1] - height) < 1e-9].sum() - 0.36) < 1e-9


def test_a_curved_surface_does_not_hide_from_itself(furnace: Scene) -> None:
    """On a ball, lines between the corners of a texel pass below its facets; only where charts end, facets of others count."""
    ball = checked("ball", furnace.positions, furnace.triangles[:, ::-1])
    whole = build_atlas(ball, 48)
    reduced, facts = opened(ball, whole)
    assert facts["buried"] == 0
    assert facts["trimmed"] < 0.02 * whole.count  # measured: 9 of 802, which lose a square or two
    assert reduced.area.sum() > 0.9995 * whole.area.sum()


def test_a_surface_without_open_places_is_refused(furnace: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hard to build: the outermost surface faces either free space or itself. So all rays are made to meet backs."""
    everywhere = lambda self, receivers, tile: np.full(tile.stop - tile.start, receivers.samples)  # noqa: E731
    monkeypatch.setattr(openness._Opener, "backs", everywhere)
    with pytest.raises(UserError, match="furnace: got a surface that sees backs wherever it looks, expected fronts") as caught:
        opened(furnace, build_atlas(furnace, 32))
    assert "\n" not in str(caught.value)


def test_the_result_does_not_depend_on_threads(faults: Scene) -> None:
    whole = build_atlas(faults, 96)
    one, three = (opened(faults, whole, threads)[0] for threads in (1, 3))
    assert len(one.parted) > 0
    for entry in dataclasses.fields(Atlas):
        np.testing.assert_array_equal(getattr(one, entry.name), getattr(three, entry.name))


# --- walls ------------------------------------------------------------------------------------------------------------


def rooms(atlas: Atlas) -> tuple[np.ndarray, np.ndarray]:
    """Texels in the lit room and in the dark one of "faults", by a point above each."""
    above = atlas.position + 1e-3 * atlas.geometric_normal
    inside = ((above > 0) & (above < [2, 1, 1.2])).all(1)
    behind = above[:, 0] - 1 - (above[:, 2] - 0.6) * np.tan(np.radians(7))
    return inside & (behind < 0), inside & (behind > 0)


@pytest.mark.parametrize("resolution", [64, 128])
def test_no_light_comes_through_a_wall_thinner_than_a_texel(faults: Scene, resolution: int) -> None:
    whole = build_atlas(faults, resolution)
    reduced, facts = opened(faults, whole)
    assert whole.texels_per_metre * 0.003 < 1
    assert facts["parted"] > 50
    tracer, found = Tracer.of(faults), []
    for atlas in (whole, reduced):
        lit, dark = rooms(atlas)
        start = on_texels(tracer, atlas, np.arange(atlas.count))
        direct = trace_reference(tracer, faults, LAMP, start, atlas.count, 16, seed=0, bounces=0).direct[:, 0]
        senders = atlas.senders(2)
        cells = landed(faults, atlas)
        group = np.append(senders.of_texel, -1)[np.maximum(cells, -1)]
        share, indirect = atlas.area / senders.area[senders.of_texel], np.zeros(atlas.count)
        for _ in range(8):
            radiosity = 0.7 * np.bincount(senders.of_texel, share * (direct + indirect))
            indirect = np.append(radiosity, 0)[group].mean(1)
        assert indirect[lit].mean() > 0.1
        found.append((direct[dark].max(), indirect[dark].max(), (cells[lit | dark] == NOTHING).mean()))
    assert found[0][0] > 0.01
    assert found[0][1] > 0.01
    assert found[1][:2] == (0, 0)
    # Crossed squares are dark to what looks at them: up to three of 25 across a texel that something stands on.
    assert found[1][2] < 3 / SQUARES * facts["trimmed"] / reduced.count


def test_hits_are_looked_up_on_their_own_side(faults: Scene) -> None:
    whole = build_atlas(faults, 96)
    reduced, _ = opened(faults, whole)
    lit, dark = rooms(reduced)
    cells = landed(faults, reduced, 256)
    assert not lit[cells[dark]][cells[dark] >= 0].any()
    assert not dark[cells[lit]][cells[lit] >= 0].any()
    assert cells.min() >= BACK
    # The strip in front of the wall that belongs to the other room's texels is not dark but its neighbours'.
    assert (reduced.part >= 0).mean() > 0.7
    others = (reduced.part >= 0) & (reduced.part != reduced.parted[:, None, None])
    assert others.sum() > 5000
    assert np.isin(whole.chart[before(whole, reduced)[lit]], whole.chart[before(whole, reduced)[dark]]).any()
    assert not np.isin(reduced.chart[lit], reduced.chart[dark]).any()


def test_a_wall_without_thickness_parts_texels() -> None:
    """Two halves of a room, divided by two sheets back to back a hundredth of a texel apart."""
    x, y, z = np.array([0.0, 1.0]), np.array([0.0, 0.5]), np.array([0.0, 0.5])
    wall = [rectangle((0.0, 0.0), (0.5, 0.5), 0.513 + 1e-4 * facing, 0, facing=facing) for facing in (-1, 1)]
    quads = np.concatenate([hollow(np.ones((1, 1, 1), bool), x, y, z), np.array(wall)])
    scene = faceted("divided", quads, (Material("grey", (0.5,) * 3),))
    whole = build_atlas(scene, 48)
    reduced, facts = opened(scene, whole)
    left = reduced.position[:, 0] + 1e-3 * reduced.geometric_normal[:, 0] < 0.513
    cells = landed(scene, reduced, 256)
    assert facts["parted"] > 10
    share = reduced.area / whole.area[before(whole, reduced)]
    assert share.min() > 0.5 - 2 / SQUARES  # the larger side is kept
    assert not left[cells[~left]][cells[~left] >= 0].any()
    assert not (~left)[cells[left]][cells[left] >= 0].any()
    assert (cells == BACK).sum() == 0


def test_a_box_below_a_gap_keeps_its_floor() -> None:
    """The floor under a box that hovers is dark, but in the open: it sees the front of the box."""
    floor = rectangle((0.0, 0.0), (1.0, 1.0), 0.0, 1, facing=1)
    quads = np.concatenate([[floor], box(np.array([0.3, 0.02, 0.3]), np.array([0.6, 0.3, 0.6]))])
    scene = faceted("hovering", quads, (Material("grey", (0.5,) * 3),))
    whole = build_atlas(scene, 64)
    reduced, facts = opened(scene, whole)
    assert not any(facts.values())
    assert reduced is whole
