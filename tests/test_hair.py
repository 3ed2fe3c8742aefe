"""Hair in transport: energy, laws of linear light, plans, refusals, and bakes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_job import call

import ddprt
from ddprt.config import Config, checked
from ddprt.errors import UserError
from ddprt.lights import parse_lighting
from ddprt.report.evaluate import spot_check
from ddprt.scene.exr import write_exr
from ddprt.scene.library import build
from ddprt.scene.material import Emission, Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.strand_texels import along_curve
from ddprt.scene.tubes import TEXELS, bald, with_strands
from ddprt.transport import fibre
from ddprt.transport.along_strands import borrowing
from ddprt.transport.direct import Texels
from ddprt.transport.effects import force, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Receivers
from ddprt.transport.hair import Hair
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.paths import trace_paths
from ddprt.transport.walk import starts

SUN: dict[str, Any] = {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": [1, 1, 1]}
LAMP: dict[str, Any] = {"type": "point", "position": [0.2, 0.1, 0.1], "intensity": [0.1, 0.1, 0.1]}


@pytest.fixture(scope="module")
def fur() -> Scene:
    return build("furball", strands=60, subdivisions=1)


def white(scene: Scene) -> Scene:
    """Nothing absorbs."""
    assert scene.tubes is not None
    bright = replace(scene, tubes=replace(scene.tubes, colour=np.ones_like(scene.tubes.colour)))
    return bright.made_of(lambda material: replace(material, albedo=(1.0, 1.0, 1.0)))


def traced(scene: Scene, lightings: list[Any], samples: int, resolution: int = 48, threads: int = 2, **given: Any) -> Any:
    tracer = Tracer.of(scene, threads)
    atlas, _ = build_open_atlas(tracer, scene, resolution)
    out = np.zeros((len(lightings), atlas.count, 3), np.float32)
    lamps = [parse_lighting(lighting) for lighting in lightings]
    for _ in trace_paths(tracer, scene, atlas, lamps, out, samples=samples, **{"seed": 0, "stream": "test", **given}):
        pass
    return out, atlas, tracer


def test_white_fur_under_a_white_sky_is_as_bright_as_the_sky(fur: Scene, tmp_path: Path) -> None:
    """Radiance 1 from everywhere: what leaves a texel is pi. Of that, light straight from the sky is no part of its map."""
    scene = white(fur)
    write_exr(tmp_path / "white.exr", np.ones((4, 8, 3), np.float32))
    samples = 512
    out, atlas, tracer = traced(scene, [{"type": "environment", "image": str(tmp_path / "white.exr")}], samples)
    strands = Hair.of(tracer, scene)
    receivers = Receivers.texels(atlas, samples, 0, "test paths")  # the very first rays of the bake
    straight = np.zeros(atlas.count)
    for tile in receivers.tiles():
        for (origins, directions, owner), triangle in starts(tracer, receivers, tile):
            weight = strands.begun(origins, directions, triangle)[0]
            escaped = tracer.first(origins, directions)[0] < 0
            np.add.at(straight, tile.start + owner[escaped], weight[escaped] / samples)
    total = out[0, :, 0] / np.pi + straight
    fibres = np.arange(atlas.count) >= atlas.count - 60 * TEXELS
    for chosen in (fibres, ~fibres):
        values = total[chosen]
        deviation = values.std() / np.sqrt(len(values))
        print(f"{values.mean():.4f} +- {deviation:.4f}, straight {straight[chosen].mean():.3f}")
        # The issue asks for 0.5 %. Texels share random numbers in blocks, which widens the mean's spread by less than twice.
        assert values.mean() == pytest.approx(1, abs=0.005 + 4 * deviation)
        assert deviation < 0.005
        assert 0.2 < straight[chosen].mean() < 0.97


def test_light_adds_and_knows_no_threads(fur: Scene) -> None:
    out, _, _ = traced(fur, [[SUN], [LAMP], [SUN, LAMP], [{**SUN, "irradiance": [2, 2, 2]}]], 16)
    again, _, _ = traced(fur, [[SUN]], 16, threads=1)
    np.testing.assert_array_equal(out[0], again[0])
    np.testing.assert_allclose(out[3], 2 * out[0], rtol=1e-5)  # the same rays, twice as bright
    np.testing.assert_allclose(out[2], out[0] + out[1], rtol=1e-5)
    assert (out >= 0).all()
    assert out[0].max() > 0


def test_a_lone_fibre_gets_nothing_and_two_do() -> None:
    """Straight ones, one behind the other; light that a fibre scatters itself is direct."""
    from ddprt.scene.strands import Strands

    def lit(count: int, way: list[float]) -> np.ndarray:
        points = np.array([[[0, 0, x], [0, 1, x]] for x in np.linspace(0, 0.03, count)], np.float64)
        strands = Strands(
            points.reshape(-1, 3), np.full(2 * count, 0.01), 2 * np.arange(count + 1), np.ones((count, 3), np.float32)
        )
        scene = with_strands(None, "row", strands, Material("hair", (1.0, 1.0, 1.0), fibre=fibre.Fibre()))
        return traced(scene, [{**SUN, "direction": way}], 64, 24)[0][0, :, 0]

    ahead, across = [0, 0, 1], [1, 0, 0]
    assert not lit(1, ahead).any()
    first, second = lit(2, ahead).reshape(2, TEXELS).mean(1)
    assert first == 0  # the other one lies in its shadow
    assert second == pytest.approx(0.195, rel=0.2)  # six streams of 1024 paths gave 0.189 to 0.201; these are 64
    # Light from the side takes the way between R and TT. Were offsets from the axis of the other sign, it would be over 0.01.
    assert 0.002 < lit(2, across).mean() < 0.008


def test_forward_light_is_coloured_by_what_it_passes(fur: Scene) -> None:
    """Ginger: fur lit by white light sends out more red than blue, as gains say of light that goes through it once."""
    out, atlas, _ = traced(fur, [SUN], 128)
    red, green, blue = out[0, -60 * TEXELS :].mean(0)
    assert red > 1.1 * green > 1.2 * blue
    white_fur, _, _ = traced(white(fur), [SUN], 128)
    assert white_fur[0, -60 * TEXELS :].mean() > red
    assert atlas.count > 60 * TEXELS


def test_forced_bounces_are_a_beginning(fur: Scene) -> None:
    # Means of the strands are 0.0426, 0.0481 and 0.0487 with standard errors of 0.0006 (512 paths, four streams).
    one, two, more = (traced(white(fur), [SUN], 512, bounces=count)[0][0, -60 * TEXELS :].mean() for count in (1, 2, -1))
    assert 0.04 < one < 0.045 < two < 0.051
    assert abs(more - 0.0487) < 0.0025


def test_roulette_keeps_the_mean(fur: Scene) -> None:
    """Paths of white fibres with a throughput of 0.2 go on as often as 0.4, by `SURVIVAL`, and weigh as much the more."""
    tracer, count = Tracer.of(fur, 1), 20_000
    strands = Hair.of(tracer, white(fur))
    rng = np.random.default_rng(0)
    triangle = rng.integers(strands.first, len(fur.triangles), count).astype(np.int32)
    place, towards = tracer.corners[triangle].mean(1), tracer.normals[triangle]
    there = strands.seen(
        triangle,
        place,
        towards,
        np.full((3, count), 0.2, np.float32),
        np.arange(count, dtype=np.int32),
        np.ones(count, np.float32),
    )
    origins, directions, throughput, owner = there.go_on(rng)
    assert len(origins) == len(directions) == len(owner) == throughput.shape[1]
    # Binomial: 0.87 % of the sum.
    assert throughput[0].sum() == pytest.approx(0.2 * count, rel=4 * 0.0087)
    assert len(owner) == pytest.approx(0.4 * count, rel=4 * 0.0087)


def test_who_is_close_is_told_by_the_distance_across(fur: Scene) -> None:
    """Eight reaches, measured across the fibre."""
    tracer, count = Tracer.of(fur, 1), 500
    strands = Hair.of(tracer, fur, smooth=True)
    rng = np.random.default_rng(0)
    triangle = rng.integers(strands.first, len(fur.triangles), count).astype(np.int32)
    towards = rng.normal(size=(count, 3)).astype(np.float32)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    distance = rng.uniform(0, 0.1, count).astype(np.float32)
    ones, owner = np.ones((3, count), np.float32), np.arange(count, dtype=np.int32)
    there = strands.seen(triangle, tracer.corners[triangle].mean(1), towards, ones, owner, distance)
    along = np.einsum("nd,nd->n", there.frames[:, 0], towards)
    np.testing.assert_array_equal(there.far.close, distance * np.sqrt(1 - along**2) < 8 * there.reach)
    assert 0.1 < there.far.close.mean() < 0.9


def test_the_plan_names_strands_and_off_makes_them_diffuse(fur: Scene, cornell: Scene) -> None:
    entry = {effect.name: effect for effect in plan(fur, ()).effects}["hair"]
    assert entry.called
    assert entry.why == '60 strands of material "fur"'
    assert plan(fur, ()).module("hair") is not None
    assert not plan(cornell, ()).called("hair")
    off = force(fur, off=["hair"])
    assert not plan(off, ()).called("hair")
    left_out = {effect.name: effect for effect in plan(off, ()).effects}["hair"]
    assert left_out.bound is None
    assert left_out.forced
    tracer = Tracer.of(off, 1)
    atlas, _ = build_open_atlas(tracer, off, 48)
    np.testing.assert_allclose(atlas.albedo[-60 * TEXELS :], [[0.45, 0.18, 0.05]] * 60 * TEXELS)


def job(**changes: Any) -> Config:
    base: dict[str, Any] = {
        "atlas": {"resolution": 48},
        "points": {"count": 8, "on": "hull", "supersample": 1},
        "lightings": {"train": 3, "validation": 1, "test": 1, "distribution": "around"},
        "transport": {"samples": 8, "test_samples": 16, "threads": 2},
    }
    return checked({**base, **{key: {**base.get(key, {}), **value} for key, value in changes.items()}})


@pytest.mark.slow
def test_a_bake_keeps_what_leaves_fibres(fur: Scene, tmp_path: Path) -> None:
    data = ddprt.bake(fur, config=job(), out=tmp_path / "a")
    assert data.description["exitant"] == ["fur"]
    assert data.description["transport"]["integrator"] == "paths"
    fibres = (data.gbuffer["albedo"] == 1).all(1)
    assert fibres.sum() == 60 * TEXELS
    maps = data.maps("indirect", range(5))
    assert maps[:, fibres].mean() > 0
    assert maps[:, ~fibres].mean() > 0
    assert data.exitant is None  # what lamps make there comes on top
    assert ddprt.fit(data, bases=2).exitant is None
    assert spot_check(fur, data, job()) == {}  # the reference takes strands for tubes: nothing to compare with
    again = ddprt.bake(fur, config=job(), out=tmp_path / "a")  # all is there
    np.testing.assert_array_equal(again.maps("indirect", range(5)), maps)
    diffuse = ddprt.bake(force(fur, off=["hair"]), config=job())
    assert "exitant" not in diffuse.description
    assert diffuse.description["transport"]["integrator"] == "operator"


@pytest.mark.slow  # a whole run
def test_a_run_of_hair_ends_with_its_report(tmp_path: Path) -> None:
    smoke = Path(__file__).parent.parent / "configs" / "smoke.toml"
    given = {"scene.name": "furball", "scene.parameters": "{strands = 60, subdivisions = 1}", "lightings.train": 4}
    given |= {"lightings.distribution": "around", "atlas.resolution": 64, "methods.compare": '["svd-ridge"]', "fit.bases": 2}
    given |= {"transport.samples": 2, "transport.test_samples": 2, "report.bases_curve": "[1, 2]"}
    words = [str(word) for key, value in given.items() for word in (f"--{key}", value)]
    assert call("run", smoke, *words, "--out", tmp_path) == 0
    assert "follows no light through bodies or hair" in (tmp_path / "report.html").read_text("utf-8")
    assert (tmp_path / "export" / "manifest.json").is_file()


def test_only_maps_to_learn_from_are_smooth(fur: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless light is shared, lamps are weighed by the offset of each ray; in held-out maps always."""
    near: list[float] = []
    made = Hair.of
    monkeypatch.setattr(
        Hair, "of", lambda tracer, scene, smooth=False: (found := made(tracer, scene, smooth), near.append(found.near))[0]
    )
    ddprt.bake(fur, config=job())
    assert near == [8.0, np.inf, np.inf]  # what is learned from, and two halves of what is held out
    near.clear()
    ddprt.bake(fur, config=job(transport={"footprint": 0.0}))
    assert set(near) == {np.inf}


def test_smooth_fur_is_as_bright(fur: Scene) -> None:
    """Means of 24 lamps of 60 strands, which scatter by 0.6 % of each other with these seeds: the bias is below that."""
    rng = np.random.default_rng(3)
    lamps = [{**SUN, "direction": way} for way in rng.standard_normal((24, 3)).tolist()]
    exact, smooth = (traced(fur, lamps, 64, smooth=on)[0][:, -60 * TEXELS :].mean() for on in (False, True))
    assert exact != smooth
    assert smooth == pytest.approx(exact, rel=0.02)


def test_strands_borrow_where_nothing_is_scored_on(fur: Scene) -> None:
    shared, own = ddprt.bake(fur, config=job()), ddprt.bake(fur, config=job(transport={"footprint": 1e-6}))
    fibres = (own.gbuffer["albedo"] == 1).all(1)
    first, other = shared.maps("indirect", range(5)), own.maps("indirect", range(5))
    for indices in (shared.split("train"), shared.split("validation")):
        np.testing.assert_array_equal(first[indices][:, ~fibres], other[indices][:, ~fibres])
        weights = borrowing(0.05, 8)
        expected = weights @ other[indices][:, fibres].reshape(len(indices), 60, TEXELS, 3)
        np.testing.assert_allclose(
            first[indices][:, fibres], np.maximum(expected, 0).reshape(len(indices), -1, 3), rtol=2e-3, atol=1e-3 * other.max()
        )
    np.testing.assert_array_equal(first[shared.split("test")], other[own.split("test")])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transport": {"integrator": "operator"}}, "got hair, which would be taken for diffuse tubes"),
        ({"transport": {"integrator": "reference"}}, "got hair, which would be taken for diffuse tubes"),
        ({"transport": {"denoise": True}}, "transport.denoise: got true for a scene with hair"),
        ({"probes": {"grid": [2, 2, 2]}}, "got hair beside probes, which is not simulated yet"),
    ],
)
def test_what_knows_no_hair_is_refused_in_one_line(fur: Scene, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        ddprt.bake(fur, config=job(**change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("part", "name"), [({"gloss": Gloss(0.3, 1.0)}, "gloss"), ({"emission": Emission((1.0, 1.0, 1.0))}, "emission")]
)
def test_what_is_beside_hair_is_refused_in_one_line(fur: Scene, part: dict[str, Any], name: str) -> None:
    other = fur.made_of(lambda material: replace(material, **part) if material.name == "skin" else material)
    with pytest.raises(UserError, match=f"got hair beside {name}, which is not simulated yet"):
        ddprt.bake(other, config=job())


def test_a_scene_without_strands_loads_nothing_of_hair(fur: Scene) -> None:
    alone = bald(fur)
    assert alone is not None
    assert alone.tubes is None
    assert len(alone.triangles) + fur.tubes.triangles == len(fur.triangles)  # type: ignore[union-attr]
    assert bald(alone) is alone


def test_neighbours_follow_each_other_along_the_curve() -> None:
    points = np.random.default_rng(0).random((4096, 3)) * [1, 2, 0.5]
    strides = [np.linalg.norm(np.diff(one, axis=0), axis=1).mean() for one in (points[along_curve(points)], points)]
    assert strides[0] < 0.15 * strides[1]
    assert along_curve(points[:1]).tolist() == [0]
    np.testing.assert_array_equal(along_curve(np.zeros((3, 3))), np.arange(3))


def test_strands_are_traced_by_place_and_stored_by_number(fur: Scene) -> None:
    tracer = Tracer.of(fur, 1)
    atlas, _ = build_open_atlas(tracer, fur, 96)
    strands, order = len(fur.tubes.axis), atlas.order
    skin = atlas.count - strands * TEXELS
    np.testing.assert_array_equal(order[:skin], np.arange(skin))
    np.testing.assert_array_equal(np.sort(order), np.arange(atlas.count))
    rows = (order[skin:] - skin).reshape(strands, TEXELS)
    np.testing.assert_array_equal(rows % TEXELS, np.tile(np.arange(TEXELS), (strands, 1)))
    np.testing.assert_array_equal(rows[:, 0] // TEXELS, along_curve(fur.tubes.axis.mean(1)))
    lamps = parse_lighting({"type": "point", "position": [0.1, 0.15, 0.05], "intensity": [1.0, 2.0, 3.0]})
    sun = parse_lighting({"type": "directional", "direction": [0.3, -1.0, 0.2], "irradiance": [1.0, 1.0, 1.0]})
    for lighting in (lamps, sun):
        found = [
            Texels.of(tracer, one, 4, np.random.default_rng(0)).irradiance(lighting, np.random.default_rng(1))
            for one in (atlas, replace(atlas, order=None))
        ]
        assert found[0].any()
        np.testing.assert_allclose(found[0], found[1], rtol=1e-6)
    light = [np.zeros((1, atlas.count, 3), np.float32) for _ in range(2)]
    settings = {"samples": 8, "seed": 2, "stream": "order"}
    done = sum(trace_paths(tracer, fur, atlas, [sun], light[0], **settings))
    for _ in trace_paths(tracer, fur, replace(atlas, order=None), [sun], light[1], **settings):
        pass
    assert done == atlas.count
    ours, plain = (one.sum((0, 2))[skin:].reshape(strands, TEXELS).mean(1) for one in light)
    assert np.corrcoef(ours, plain)[0, 1] > 0.5, "each strand has its own light, whatever the order"
