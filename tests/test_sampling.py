"""Lightings and measurement points: addressed by index, in free space, evenly spread, on the surface."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import oracles
import pytest
from scipy.spatial import cKDTree

from ddprt.errors import UserError
from ddprt.lights import Lighting, lighting_json
from ddprt.sampling.lightings import Draw, draw_lightings
from ddprt.sampling.points import eliminate, load_samples, place_samples
from ddprt.scene.atlas import SHUT, Atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted
from ddprt.sections import LightingsConfig
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas


def true_clearance(scene: Scene, point: np.ndarray) -> float:
    return min(oracles.distance_to_triangle(point, corners) for corners in scene.corners)


def draw(scene: Scene, count: int, split: str = "train", seed: int = 0, **settings: Any) -> Draw:
    config = LightingsConfig(**settings)
    return draw_lightings(config, split, count, bounds=scene.bounds, clearance=Tracer.of(scene).clearance, seed=seed)


def anchors(lightings: tuple[Lighting, ...]) -> np.ndarray:
    return np.array([light.anchor() for lighting in lightings for light in lighting])


# --- lightings --------------------------------------------------------------------------------------------------------


def test_the_first_lightings_do_not_depend_on_how_many_follow(cornell: Scene) -> None:
    settings: dict[str, Any] = {
        "kinds": ("point", "spot", "rect"),
        "lights": (1, 3),
        "intensity": (0.5, 2),
        "saturation": (0, 1),
    }
    few, many = draw(cornell, 5, **settings), draw(cornell, 30, **settings)
    assert few.lightings == many.lightings[:5]
    assert few.rejected <= many.rejected
    assert few.candidates - few.rejected == sum(map(len, few.lightings))


def test_splits_and_seeds_are_drawn_apart(cornell: Scene) -> None:
    drawn = [draw(cornell, 8, split, seed) for split in ("train", "validation", "test") for seed in (0, 1)]
    places = np.concatenate([anchors(part.lightings) for part in drawn])
    assert len(np.unique(places, axis=0)) == len(places)


def test_lamps_are_never_inside_a_solid(cornell: Scene) -> None:
    drawn = draw(cornell, 150, clearance=0.0)
    places = anchors(drawn.lightings)
    assert drawn.rejected > 0
    assert drawn.candidates == drawn.rejected + 150
    assert not any(oracles.inside_a_block(place) for place in places)
    assert oracles.inside_a_block(np.array([0.2, 0.1, 0.15]))  # the test can tell
    # Walls have fronts inwards: the free side of every plane that a lamp stands before.
    for wall in (*range(8), 28, 29):
        assert ((places - cornell.corners[wall, 0]) @ cornell.geometric_normals[wall] > -1e-3).all()
    # Turned down is what the blocks fill (8 %) and what lies behind the slanted walls (1 %), and no more: 9 % of 165 tries
    # have a standard deviation of 2.2 %.
    assert 0.02 < drawn.rejected / drawn.candidates < 0.16


@pytest.mark.parametrize("kind", ["point", "rect", "sphere"])
def test_clearance_is_kept_by_the_whole_lamp(cornell: Scene, kind: str) -> None:
    """With exact distances for a clearance function, no corner of a lamp comes nearer than asked."""
    config = LightingsConfig(kinds=(kind,), clearance=0.06, size=0.1)
    exact = lambda points: np.array([0.0 if oracles.inside_a_block(p) else true_clearance(cornell, p) for p in points])  # noqa: E731
    drawn = draw_lightings(config, "train", 25, bounds=cornell.bounds, clearance=exact, seed=0)
    nearest = np.inf
    for (light,) in drawn.lightings:
        record = light.model_dump()
        middle, spread = light.anchor(), 0.0
        if kind == "rect":
            u, v = np.array(record["half_u"]), np.array(record["half_v"])
            for corner in (u + v, u - v, -u + v, -u - v):
                nearest = min(nearest, true_clearance(cornell, middle + corner))
        else:
            spread = record.get("radius", 0.0)
        nearest = min(nearest, true_clearance(cornell, middle) - spread)
    assert nearest >= 0.06 - 1e-12
    assert nearest < 0.12  # the whole of the free space is used, not its middle alone


def test_clearance_of_the_tracer(cornell: Scene, corridor: Scene) -> None:
    rng = np.random.default_rng(0)
    for scene in (cornell, corridor):
        places = rng.uniform(*scene.bounds, (120, 3))
        found = Tracer.of(scene).clearance(places)
        exact = np.array([true_clearance(scene, place) for place in places])
        free = found > 0
        # Float64 on both sides, but for the bound from float32 rays where that is the nearest surface already.
        np.testing.assert_allclose(found[free], exact[free], rtol=1e-6)
        if scene is cornell:
            assert [oracles.inside_a_block(place) for place in places[~free]] == [True] * np.count_nonzero(~free) or all(
                oracles.inside_a_block(p) or p[0] > 0.5496 for p in places[~free]
            )
            assert not any(oracles.inside_a_block(place) for place in places[free])


def test_outside_and_inside_of_solids(statue: Scene, furnace: Scene) -> None:
    body = Tracer.of(statue).clearance(np.array([[0.0, 0.9, 0.0], [2.0, 1.0, 0.0], [0.0, 5.0, 0.0]]))
    assert (body[0], body[1] > 0, body[2] > 0) == (0, True, True)
    room = Tracer.of(furnace).clearance(np.array([[0.0, 0, 0], [0.5, 0, 0], [3.0, 0, 0]]))
    # 1280 facets sag by 0.4 % below the sphere.
    assert room[0] == pytest.approx(1, abs=0.01)
    assert 0.49 < room[1] < 0.5
    assert room[2] == 0


@pytest.mark.parametrize("kind", ["point", "spot", "directional", "rect", "sphere"])
def test_ranges_are_respected(cornell: Scene, kind: str) -> None:
    drawn = draw(
        cornell, 60, kinds=(kind,), lights=(2, 4), intensity=(0.5, 8.0), saturation=(0.2, 0.6), spot_outer_deg=(30, 40),
        region_low=(0.1, 0.6, 0.2), region_high=(0.9, 0.95, 0.8), clearance=0.02, size=0.04,
    )  # fmt: skip
    counts = [len(lighting) for lighting in drawn.lightings]
    assert set(counts) == {2, 3, 4}
    strength, saturation = [], []
    for record in (record for lighting in drawn.lightings for record in lighting_json(lighting)):
        assert record["type"] == kind
        colour = np.array(next(record[key] for key in ("intensity", "irradiance", "radiance") if key in record))
        if kind == "sphere":
            assert record["radius"] == pytest.approx(0.04 * cornell.radius)
            colour = colour * np.pi * record["radius"] ** 2  # intensity of a ball
        if kind == "rect":
            area = 4 * np.linalg.norm(np.cross(record["half_u"], record["half_v"]))
            assert area == pytest.approx((2 * 0.04 * cornell.radius) ** 2)
            colour = colour * area  # along its axis
        strength.append(colour.max())
        saturation.append(1 - colour.min() / colour.max())
        if kind == "spot":
            assert 30 <= record["outer_deg"] <= 40
            assert record["inner_deg"] == pytest.approx(0.6 * record["outer_deg"])
    assert min(strength) >= 0.5 * (1 - 1e-12)
    assert max(strength) <= 8 * (1 + 1e-12)
    assert min(saturation) >= 0.2 - 1e-12
    assert max(saturation) <= 0.6 + 1e-12
    # Log-uniform: the middle is the geometric mean; log2 has a standard deviation of 4 / sqrt(12), over 180 lamps 0.086.
    assert np.median(np.log2(strength)) == pytest.approx(1, abs=4 * 1.25 * 0.086)
    if kind != "directional":
        share = (anchors(drawn.lightings) - cornell.bounds[0]) / np.diff(cornell.bounds, axis=0)[0]
        assert (share >= [0.1, 0.6, 0.2]).all()
        assert (share <= [0.9, 0.95, 0.8]).all()


def test_all_kinds_are_drawn_equally_often(cornell: Scene) -> None:
    kinds = ("point", "spot", "directional", "rect", "sphere")
    drawn = draw(cornell, 100, kinds=kinds, lights=(3, 3), clearance=0.01, size=0.01)
    counts = np.array([sum(light.kind == kind for lighting in drawn.lightings for light in lighting) for kind in kinds])
    assert oracles.chi_square(counts, np.ones(5)) > 1e-4


def test_lamps_about_an_asset(statue: Scene) -> None:
    drawn = draw(statue, 200, distribution="around", distance=(1.5, 3.0), elevation_deg=(10, 80), kinds=("point",))
    away = anchors(drawn.lightings) - statue.centre
    length = np.linalg.norm(away, axis=1)
    assert length.min() >= 1.5 * statue.radius
    assert length.max() <= 3 * statue.radius
    rise = away[:, 1] / length
    assert np.degrees(np.arcsin(rise)).min() >= 10
    assert np.degrees(np.arcsin(rise)).max() <= 80
    # Uniform over the band of the sphere: the sine of the elevation is uniform, and so is the turn.
    low, high = np.sin(np.radians([10, 80]))
    assert oracles.chi_square(np.histogram(rise, 8, (low, high))[0], np.ones(8)) > 1e-4
    assert oracles.chi_square(np.histogram(np.arctan2(away[:, 2], away[:, 0]), 8, (-np.pi, np.pi))[0], np.ones(8)) > 1e-4


@pytest.mark.parametrize("kind", ["directional", "rect", "spot"])
def test_lamps_about_an_asset_shine_at_it(statue: Scene, kind: str) -> None:
    drawn = draw(statue, 30, distribution="around", kinds=(kind,))
    surface = statue.corners[:-2].mean(1)
    for (light,) in drawn.lightings:
        sample = light.illuminate(surface, np.full((len(surface), 2), 0.5))
        assert sample.irradiance.any()
        if kind == "directional":
            assert (sample.direction[:, 1] > 0).all()


def test_impossible_clearance_is_refused(cornell: Scene) -> None:
    with pytest.raises(UserError, match=r"got no free position in 4096 tries, .*lower lightings.clearance"):
        draw(cornell, 1, clearance=0.4)


# --- measurement points -----------------------------------------------------------------------------------------------


def spacing(position: np.ndarray) -> np.ndarray:
    return cKDTree(position).query(position, k=2)[0][:, 1]


def packing(area: float, count: int) -> float:
    """The greatest distance that `count` samples on an area can keep: that of the hexagonal packing."""
    return float(2 * np.sqrt(area / (2 * np.sqrt(3) * count)))


@pytest.mark.parametrize(("count", "keep"), [(40, 8), (60, 12), (60, 60), (5, 1), (33, 7)])
def test_elimination_agrees_with_the_greedy_twin(count: int, keep: int) -> None:
    position = np.random.default_rng(count).random((count, 3)) * [1, 1, 0]
    order = eliminate(position, keep, 1.0).tolist()
    assert order == oracles.eliminate(position, keep, 1.0, order)


def test_samples_lie_on_the_surface(cornell: Scene) -> None:
    samples = place_samples(cornell, 64, on="surface", seed=0)
    assert samples.position.shape == samples.normal.shape == samples.albedo.shape == (64, 3)
    colours = np.array([material.albedo for material in cornell.materials])
    for position, normal, albedo in zip(samples.position, samples.normal, samples.albedo, strict=True):
        distance = np.array([oracles.distance_to_triangle(position, corners) for corners in cornell.corners])
        home = distance < 1e-12
        assert home.any()
        assert any(np.allclose(normal, n, atol=1e-12) for n in cornell.geometric_normals[home])
        assert any(np.allclose(albedo, colours[index]) for index in cornell.material[home])


def test_samples_are_blue_noise(plates: Scene) -> None:
    """Two squares far enough apart that neighbours lie on one of them; the paper's sets reach 0.7 of the packing."""
    samples = place_samples(plates, 256, on="surface", seed=0)
    best = packing(2.0, 256)
    rng = np.random.default_rng(0)
    random = np.concatenate([rng.random((256, 2)), rng.integers(0, 2, (256, 1))], 1)
    assert spacing(samples.position).min() > 0.6 * best
    assert spacing(random).min() < 0.2 * best
    assert spacing(samples.position).std() < 0.1 * best


@pytest.mark.parametrize("first", [16, 32, 64, 128, 200])
def test_every_beginning_is_evenly_spread(plates: Scene, first: int) -> None:
    samples = place_samples(plates, 256, on="surface", seed=0)
    nearest = spacing(samples.position[:first])
    # Sizes between the halvings are a little less even than those at them; random ones reach 0.05 at 200 and 0.2 at 16.
    assert nearest.min() > (0.55 if first & (first - 1) == 0 else 0.4) * packing(2.0, first)


def test_samples_share_the_area_fairly(cornell: Scene) -> None:
    samples = place_samples(cornell, 512, on="surface", seed=1)
    areas = [cornell.areas[cornell.material == index].sum() for index in range(3)]
    colours = np.array([material.albedo for material in cornell.materials])
    counts = [(np.abs(samples.albedo - colour).max(1) < 1e-9).sum() for colour in colours]
    # Blue noise varies less than independent draws would: 3 standard deviations of those.
    expected = 512 * np.array(areas) / sum(areas)
    assert (np.abs(counts - expected) < 3 * np.sqrt(expected)).all()


def test_samples_stay_in_the_open(cornell: Scene) -> None:
    """None on the floor under a block; the rest has the area and the spacing of what is left."""
    atlas, _ = build_open_atlas(Tracer.of(cornell), cornell, 64)
    samples = place_samples(cornell, 1024, on="surface", seed=0, atlas=atlas)
    whole = place_samples(cornell, 1024, on="surface", seed=0)
    under = [[oracles.inside_a_block(place) for place in at.position + 1e-6 * at.normal] for at in (samples, whole)]
    # A candidate is judged by squares of a 25th of a texel: what a block's rim makes of one is no wider.
    hidden = 1 - atlas.area.sum() / cornell.areas.sum()
    assert (sum(under[0]), sum(under[1]) > 0.5 * 1024 * hidden) == (0, True)
    assert samples.spacing == pytest.approx(np.sqrt(atlas.area.sum() / 1024), rel=1e-12)
    assert spacing(samples.position).min() > 0.5 * packing(atlas.area.sum(), 1024)


@pytest.mark.parametrize("name", ["furnace", "convex", "plates"])
def test_where_nothing_is_hidden_samples_are_the_same(name: str) -> None:
    scene = build(name)
    atlas, hidden = build_open_atlas(Tracer.of(scene), scene, 64)
    assert not any(hidden.values())
    once, again = (place_samples(scene, 64, on="surface", seed=0, atlas=given) for given in (None, atlas))
    assert (once.digest, once.spacing) == (again.digest, again.spacing)


def test_too_little_in_the_open_is_refused(cornell: Scene, cornell_atlas: Atlas) -> None:
    shut = replace(cornell_atlas, slot=np.full_like(cornell_atlas.slot, SHUT))
    with pytest.raises(UserError, match=r"points\.count: got 8 samples to place, but 0 of 40 candidates") as caught:
        place_samples(cornell, 8, on="surface", seed=0, atlas=shut)
    assert "\n" not in str(caught.value)
    assert len(place_samples(cornell, 8, on="hull", seed=0, atlas=shut).position) == 8  # a hull is not unwrapped


def test_samples_depend_on_the_seed_alone(cornell: Scene) -> None:
    once, again, other = (place_samples(cornell, 32, on="surface", seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(once.position, again.position)
    assert not np.isin(once.position, other.position).all()


def test_hull_points_look_outwards_from_the_hull(statue: Scene) -> None:
    samples = place_samples(statue, 128, on="hull", seed=0)
    corners = statue.positions
    for position, normal in zip(samples.position, samples.normal, strict=True):
        height = (corners - position) @ normal
        assert abs(height.max()) < 1e-9 * statue.radius  # it touches the hull, and nothing lies before it
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-12)
    assert (samples.position.max(0) > corners.max(0) - 0.3 * statue.radius).all()
    known = np.array([material.albedo for material in statue.materials])
    assert all(np.isclose(albedo, known).all(1).any() for albedo in samples.albedo)


def test_a_flat_hull_is_refused() -> None:
    flat = checked("flat", np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), np.array([[0, 2, 1]]))
    with pytest.raises(UserError, match='"flat" has a flat hull') as caught:
        place_samples(flat, 8, on="hull", seed=0)
    assert "\n" not in str(caught.value)


def test_one_sample_is_enough(cornell: Scene) -> None:
    assert place_samples(cornell, 1, on="surface", seed=0).position.shape == (1, 3)


def test_supersamples_go_to_the_nearest_point(plates: Scene) -> None:
    samples = place_samples(plates, 64 * 8, on="surface", seed=0)
    point = samples.nearest_point(64)
    assert point.shape == (512,)
    np.testing.assert_array_equal(point[:64], np.arange(64))
    spread = samples.spacing * np.sqrt(8)
    assert spread == pytest.approx(np.sqrt(2.0 / 64))
    for index, home in enumerate(point):
        apart = np.linalg.norm(samples.position[:64] - samples.position[index], axis=1) / spread
        turned = np.linalg.norm(samples.normal[:64] - samples.normal[index], axis=1) / np.sqrt(2)
        assert np.hypot(apart, turned).argmin() == home
    assert (samples.normal[point] == samples.normal).all()  # never across to the other plate
    assert np.bincount(point, minlength=64).min() >= 2  # each gets its share of 8, more or less


def test_two_sides_of_a_sheet_are_seldom_mixed() -> None:
    """A point on the other side counts as sqrt(2) spacings away: it is taken in holes wider than that alone."""
    sheet = faceted("sheet", box(np.zeros(3), np.array([1.0, 1e-3, 1.0])), (Material("white", (0.8,) * 3),))
    samples = place_samples(sheet, 64 * 8, on="surface", seed=0)
    side = samples.normal[:, 1].round()
    crossed = np.flatnonzero((side[samples.nearest_point(64)] != side) & (side != 0))
    assert len(crossed) < 0.02 * 512  # by position alone it would be a half; measured 0.4 %
    for index in crossed:
        same = np.flatnonzero(side[:64] == side[index])
        apart = np.linalg.norm(samples.position[same] - samples.position[index], axis=1).min()
        assert apart > np.sqrt(2) * samples.spacing * np.sqrt(8)


# --- given points -----------------------------------------------------------------------------------------------------


def test_given_points_are_read(tmp_path: Path) -> None:
    records = [
        {"position": [0, 1, 2], "normal": [0, 2, 0], "albedo": [0.1, 0.2, 0.3]},
        {"position": [3, 1, 2], "normal": [0, 0, -1]},
    ]
    (tmp_path / "points.json").write_text(json.dumps(records))
    samples = load_samples(tmp_path / "points.json")
    np.testing.assert_array_equal(samples.position, [[0, 1, 2], [3, 1, 2]])
    np.testing.assert_array_equal(samples.normal, [[0, 1, 0], [0, 0, -1]])
    np.testing.assert_array_equal(samples.albedo, [[0.1, 0.2, 0.3], [1, 1, 1]])
    assert samples.spacing > 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "got No such file or directory"),
        ("", "not a JSON list"),
        ("{", "not a JSON list"),
        ("[]", "expected lists of three numbers"),
        ("{}", "not a JSON list"),
        ("[1, 2]", "not a JSON list"),
        ("null", "not a JSON list"),
        ('[{"position": [0, 0, 0]}]', "normal"),
        ('[{"position": [0, 0], "normal": [0, 1]}]', "three numbers"),
        ('[{"position": [0, 0, 0], "normal": [0, 1, 0]}, {"position": [0, 0], "normal": [0, 1, 0]}]', "three numbers"),
        ('[{"position": [0, 0, "x"], "normal": [0, 1, 0]}]', "three numbers"),
        ('[{"position": [0, 0, NaN], "normal": [0, 1, 0]}]', "not finite"),
        ('[{"position": [0, 0, 0], "normal": [0, 0, 0]}]', "normal of length 0"),
        ('[{"position": [0, 0, 0], "normal": [0, 1, 0], "albedo": [1, Infinity, 1]}]', "not finite"),
        ('[{"position": [0, 0, 0], "normal": [0, 1, 0], "albedo": 0.5}]', "three numbers"),
    ],
)
def test_bad_point_files_get_one_line(tmp_path: Path, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / "points.json").write_text(content)
    with pytest.raises(UserError, match=message) as caught:
        load_samples(tmp_path / "points.json")
    assert "\n" not in str(caught.value)
    assert "points.json" in str(caught.value)


def test_points_of_a_scene_far_from_the_origin() -> None:
    near = build("convex")
    far = checked("far", near.positions + 1e6, near.triangles)
    samples = place_samples(far, 32, on="hull", seed=0)
    assert np.abs(np.abs(samples.position - 1e6).max(1) - 0.5).max() < 1e-8
