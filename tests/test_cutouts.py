"""Holes let light through: closed forms, a slow twin, and what is kept of them on the lightmap and on disk."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load_file
from small_job import call

import ddprt
from ddprt.config import checked as configured
from ddprt.dataset.store import open_dataset
from ddprt.lights import parse_lighting
from ddprt.sampling.points import place_samples
from ddprt.scene.atlas import SHUT, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.holes import Holes
from ddprt.scene.library import SCENES, build
from ddprt.scene.material import Cutout, Material, bilinear
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, hollow
from ddprt.transport import cutouts
from ddprt.transport.effects import force, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas

SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
SUN = {"type": "directional", "direction": [0, 0, -1], "irradiance": [1.0, 2.0, 3.0]}
LAMP = {"type": "point", "position": [0.5, 0.5, 2.0], "intensity": [1.0, 1.0, 1.0]}


def chequered(squares: int, pixels: int = 1) -> NDArray[np.float32]:
    """Half of it open: the bilinear mask and its complement are the same pattern, moved by a square."""
    return np.kron(np.indices((squares, squares)).sum(0) % 2, np.ones((pixels, pixels))).astype(np.float32)


def stack(heights: list[float], mask: NDArray[np.float32] | None, *, two_sided: bool = False) -> Scene:
    """Unit squares over another, facing up, the lowest whole; all others have a mask."""
    positions = np.concatenate([np.column_stack([SQUARE, np.full(4, height)]) for height in heights])
    triangles = (4 * np.arange(len(heights))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    cutout = None if mask is None else Cutout(mask)
    materials = Material("floor", (0.5,) * 3), Material("leaf", (0.5,) * 3, two_sided=two_sided, cutout=cutout)
    index = np.repeat(np.arange(len(heights)) > 0, 2).astype(int)
    return checked("stack", positions, triangles, material=index, materials=materials, uv=np.tile(SQUARE, (len(heights), 1)))


def lattice(side: int, height: float, low: float = 0.0, high: float = 1.0) -> NDArray[np.float64]:
    line = low + (high - low) * (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.full(side**2, height)], 1)


def irradiance(scene: Scene, light: dict[str, Any], places: NDArray[np.float64], samples: int = 1) -> tuple[np.ndarray, ...]:
    return ddprt.irradiance(scene, light, places, np.tile([0.0, 0, 1], (len(places), 1)), samples=samples, seed=3)


@pytest.mark.parametrize("two_sided", [False, True])
def test_half_of_the_sun_comes_through_a_mask_that_is_half_open(two_sided: bool) -> None:
    scene = stack([0.0, 0.5], chequered(4), two_sided=two_sided)
    # 96 places to a square of 8 pixels each: the pattern moved by a square meets the same places, so that exactly half are
    # lit, but for those at the cutoff itself, of which the lattice (its points lie at odd 192nds) has none.
    places = lattice(96, 0.0)
    direct = irradiance(scene, SUN, places)[0]
    lit = bilinear(chequered(4), places[:, :2]) < 0.5
    np.testing.assert_array_equal(direct, lit[:, None] * np.array([1.0, 2.0, 3.0]))
    assert direct.mean(0).tolist() == [0.5, 1.0, 1.5]


def test_half_of_a_lamp_comes_through() -> None:
    """From a point: squares of shadow differ from their neighbours by what E changes across one."""
    squares, side = 32, 160
    scene = stack([0.0, 0.5], chequered(squares))
    places = lattice(side, 0.0)
    direct, whole = irradiance(scene, LAMP, places)[0][:, 0], irradiance(stack([0.0], None), LAMP, places)[0][:, 0]
    on_mask = LAMP["position"][:2] + 0.75 * (places[:, :2] - LAMP["position"][:2])  # type: ignore[index,operator]
    lit = bilinear(chequered(squares), on_mask) < 0.5
    sure = np.abs(bilinear(chequered(squares), on_mask) - 0.5) > 1e-3
    np.testing.assert_allclose(direct[sure], (lit * whole)[sure], rtol=2e-4)  # rays start up to 2e-5 off the floor
    # A square's shadow is 1/24 wide, and E falls by less than 0.5 of itself per metre here; pairs differ by so much at most.
    # The rim cuts 96 of some 600 shadows, whose share open is half only to +-1/2 each: at random 0.5 * 96 ** 0.5 / 600.
    assert direct.mean() / whole.mean() == pytest.approx(0.5, abs=0.5 / 24 / 2 + 0.5 * 96**0.5 / 600)


def test_a_mask_without_holes_is_not_called_for_and_changes_nothing() -> None:
    solid, plain = stack([0.0, 0.5], np.ones((4, 4), np.float32)), stack([0.0, 0.5], None)
    assert Holes.of(solid) is None
    assert not plan(solid, [parse_lighting([LAMP])]).called("cut-outs")
    places = lattice(9, 0.2)
    for one, other in zip(irradiance(solid, LAMP, places, 64), irradiance(plain, LAMP, places, 64), strict=True):
        np.testing.assert_array_equal(one, other)


def test_holes_that_no_triangle_has_change_no_bit() -> None:
    """The image is open beyond the part of it that is used: the way is another, the light is not."""
    mask = np.ones((8, 8), np.float32)
    mask[:, 6] = 0
    uv_half = [0.5, 1.0]
    unused, plain = (replace(s, uv=s.uv * uv_half) for s in (stack([0.0, 0.5, 0.7], m) for m in (mask, None)))  # type: ignore[operator]
    tracer = Tracer.of(unused)
    assert tracer.openwork is not None
    places = lattice(9, 0.2, 0.05, 0.95)
    for one, other in zip(irradiance(unused, LAMP, places, 64), irradiance(plain, LAMP, places, 64), strict=True):
        np.testing.assert_array_equal(one, other)
    with_holes, without = build_open_atlas(tracer, unused, 48)[0], build_open_atlas(Tracer.of(plain), plain, 48)[0]
    for name in ("texel", "slot", "position", "albedo", "area", "coverage", "piece_area", "piece_corners"):
        np.testing.assert_array_equal(getattr(with_holes, name), getattr(without, name))


def test_what_is_all_hole_is_not_there() -> None:
    gone, never = stack([0.0, 0.5, 1.0], np.zeros((2, 2), np.float32)), stack([0.0, 1.0], None)
    gone = replace(gone, material=np.array([0, 0, 1, 1, 0, 0], np.int32))
    places = lattice(9, 0.2)
    for one, other in zip(irradiance(gone, LAMP, places, 64), irradiance(never, LAMP, places, 64), strict=True):
        np.testing.assert_array_equal(one, other)
    atlas = build_open_atlas(Tracer.of(gone), gone, 48)[0]
    assert atlas.area.sum() == pytest.approx(2.0, rel=1e-9)
    assert set(atlas.position[:, 2].round(9)) == {0.0, 1.0}


def test_a_stack_of_a_hundred_leaves_is_passed_and_every_ray_counted() -> None:
    scene = stack([0.0, *(0.5 + 0.005 * np.arange(100)).tolist()], chequered(2, 4), two_sided=True)
    tracer = Tracer.of(scene)
    x = np.linspace(0.03, 0.97, 64)
    places = np.stack([x, 0.5 * x + 0.3, np.full(64, 3.0)], 1)
    down = np.tile([0, 0, -1], (64, 1)).astype(np.float32)
    is_open = bilinear(chequered(2, 4), places[:, :2]) < 0.5
    hits = tracer.closest((places - tracer.centre).astype(np.float32), down)
    np.testing.assert_array_equal(hits.triangle < 2, is_open)
    assert hits.front.all()
    np.testing.assert_allclose(hits.distance, np.where(is_open, 3.0, 3.0 - 0.995), atol=1e-5)
    # One ray each, then for those in holes one for what is behind, and one for each of the other 199 sides and what follows.
    assert tracer.rays == 64 + is_open.sum() * (1 + 199 + 1)
    tracer.rays = 0
    seen = tracer.unoccluded((places - tracer.centre).astype(np.float32), down, np.full(64, 2.9, np.float32))
    np.testing.assert_array_equal(seen != 0, is_open)
    assert tracer.rays == 64 + (~is_open).sum() + is_open.sum() * 201


def test_more_layers_than_the_bound_stop_a_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cutouts, "LAYERS", 20)
    place, down = np.array([[0.25, 0.25, 3.0]]), np.array([[0, 0, -1]], np.float32)
    for leaves, through in ((20, True), (21, True), (22, False), (100, False)):
        scene = stack([0.0, *(0.5 + 0.005 * np.arange(leaves)).tolist()], np.zeros((1, 1), np.float32))
        tracer = Tracer.of(scene)
        hits = tracer.closest((place - tracer.centre).astype(np.float32), down)
        # The first hole is met by the first ray, LAYERS more are passed.
        assert bool(hits.triangle[0] < 2) is through


def test_rays_along_a_mask_end() -> None:
    """Where rounding gives the same triangle again, steps double: some 40 of them lead out of any scene."""
    scene = stack([0.0, 0.5], np.zeros((1, 1), np.float32), two_sided=True)
    tracer, rng = Tracer.of(scene), np.random.default_rng(0)
    for slope in (1e-2, 1e-4, 1e-6, 1e-7, 1e-8):
        directions = np.column_stack([np.ones(500), np.zeros(500), slope * rng.choice([-1, 1], 500)]).astype(np.float32)
        places = np.column_stack([np.zeros(500), rng.random(500), 0.5 + rng.normal(size=500) * slope])
        tracer.rays = 0
        hits = tracer.closest((places - tracer.centre).astype(np.float32), directions)
        assert tracer.rays < 500 * 84  # both sides
        assert (hits.triangle < 2).all()


def test_no_ray_goes_through_a_wall_behind_a_hole() -> None:
    """Sheets with holes in the very planes of a room's walls, and nearer to them than a step."""
    room = hollow(np.ones((1, 1, 1), bool), *(np.array([-1.0, 1.0]),) * 3)
    for inwards in (0.0, 1e-7, 1e-6, 1e-3):
        quads = np.concatenate([room, room * (1 - inwards)])
        scene = faceted("room", quads, (Material("wall", (0.5,) * 3), Material("paper", (0.5,) * 3)), np.repeat([0, 1], 6))
        mask = np.zeros((1, 1), np.float32)
        materials = scene.materials[0], replace(scene.materials[1], cutout=Cutout(mask))
        scene = replace(scene, materials=materials, uv=np.zeros((len(scene.positions), 2)))
        tracer = Tracer.of(scene)
        directions = np.random.default_rng(0).normal(size=(20_000, 3))
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        hits = tracer.closest(np.zeros_like(directions), directions)
        assert (hits.front & (scene.material[hits.triangle] == 0)).all()
        assert not tracer.unoccluded(np.zeros_like(directions), directions, np.full(20_000, 9, np.float32)).any()


def first_solid(scene: Scene, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> tuple[int, float, float]:
    """The slow twin: triangle, distance, and how far every decision on the way was from being another."""
    a, b, c = np.moveaxis(scene.corners, 1, 0)
    place = np.linalg.solve(
        np.stack([b - a, c - a, -np.broadcast_to(direction, a.shape)], 2), (origin - a)[..., None]
    )[..., 0]  # fmt: skip
    u, v, distance = place.T
    inside = np.minimum(np.minimum(u, v), 1 - u - v)
    sure = np.abs(inside[distance > 0]).min(initial=1.0)
    for triangle in np.argsort(distance):
        if distance[triangle] > 0 and inside[triangle] > 0:
            cutout = scene.materials[scene.material[triangle]].cutout
            if cutout is None:
                return int(triangle), distance[triangle], sure
            weights = np.array([[1 - u[triangle] - v[triangle], u[triangle], v[triangle]]])
            opacity = bilinear(cutout.opacity, scene.uv_at(np.array([triangle]), weights))[0]
            sure = min(sure, abs(opacity - cutout.cutoff))
            if opacity >= cutout.cutoff:
                return int(triangle), distance[triangle], sure
    return -1, np.inf, sure


def test_rays_agree_with_their_slow_twin() -> None:
    rng = np.random.default_rng(1)
    corners = rng.uniform(-1, 1, (60, 1, 3)) + 0.8 * rng.normal(size=(60, 3, 3))
    masks = [rng.random(shape).astype(np.float32) for shape in ((3, 5), (8, 4))]
    materials = (
        Material("a", (0.5,) * 3),
        *(Material("m", (0.5,) * 3, cutout=Cutout(m, 0.3 + 0.3 * k)) for k, m in enumerate(masks)),
    )
    scene = checked(
        "soup", corners.reshape(-1, 3), np.arange(180).reshape(-1, 3), material=np.arange(60) % 5 % 3, materials=materials,
        uv=rng.uniform(-2, 2, (180, 2)),
    )  # fmt: skip
    tracer = Tracer.of(scene)
    origins, directions = rng.uniform(-2, 2, (1500, 3)), rng.normal(size=(1500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    local, along = (origins - tracer.centre).astype(np.float32), directions.astype(np.float32)
    hits = tracer.closest(local, along)
    reach = rng.uniform(0, 4, 1500).astype(np.float32)
    seen = tracer.unoccluded(local, along, reach.copy())
    compared = 0
    for ray in range(1500):
        triangle, distance, sure = first_solid(scene, origins[ray], directions[ray])
        if sure > 1e-4:  # rounding to float32 moves what a ray meets by some 1e-6
            compared += 1
            assert hits.triangle[ray] == triangle
            if triangle >= 0:
                assert hits.distance[ray] == pytest.approx(distance, abs=1e-5)
            if abs(distance - reach[ray]) > 1e-4:
                assert (seen[ray] != 0) == (distance > reach[ray])
    assert compared > 1200


def test_lookups_agree_with_the_materials() -> None:
    rng = np.random.default_rng(0)
    mask = rng.random((5, 7)).astype(np.float32)
    scene = replace(stack([0.0, 0.5], mask), uv=rng.uniform(-3, 3, (8, 2)))
    holes = Holes.of(scene)
    assert holes is not None
    triangle, weights = rng.integers(-1, 4, 4000), rng.dirichlet(np.ones(3), 4000)
    expected = (triangle >= 2) & (bilinear(mask, scene.uv_at(np.maximum(triangle, 0), weights)) < 0.5)
    np.testing.assert_array_equal(holes.open_at(triangle, weights[:, 1], weights[:, 2]), expected)


def test_texels_count_what_of_them_is_there() -> None:
    mask = np.zeros((16, 16), np.float32)
    mask[4:12] = 1  # a stripe from 1/4 to 3/4, its rims straight and at the cutoff
    scene = stack([0.0, 0.5], mask)
    tracer = Tracer.of(scene)
    whole, atlas = build_atlas(scene, 64), build_open_atlas(tracer, scene, 64)[0]
    upper = atlas.position[:, 2] > 0.25
    # Each rim, 1 m long, is met to an eighth of a piece, and pieces are no larger than texels.
    texel = 1 / whole.texels_per_metre
    assert atlas.area[upper].sum() == pytest.approx(0.5, abs=2 * texel / 8)
    assert atlas.area[~upper].sum() == pytest.approx(1.0, rel=1e-9)
    assert (np.abs(atlas.position[upper, 1] - 0.5) < 0.25).all()
    np.testing.assert_allclose(atlas.coverage / atlas.area, atlas.texels_per_metre**2, rtol=1e-6)
    assert (atlas.slot > SHUT).all()  # beside a leaf a hit finds it, as beside any chart
    # Whole texels keep every bit.
    kept = whole.slot.ravel()[atlas.texel]
    same = atlas.area == whole.area[kept]
    assert same.mean() > 0.9
    np.testing.assert_array_equal(atlas.position[same], whole.position[kept][same])
    places, face = atlas.sampler.sample(np.arange(atlas.count), np.random.default_rng(0).random((atlas.count, 2), np.float32))
    on_leaf = scene.material[face] == 1
    assert (np.abs(places[on_leaf, 1]) < 0.25 + texel / 8).all()


@pytest.mark.parametrize("whole", [True, False])
def test_no_point_is_measured_in_a_hole(whole: bool) -> None:
    scene = stack([0.0, 0.5], chequered(4, 4))
    atlas = None if whole else build_open_atlas(Tracer.of(scene), scene, 48)[0]
    samples = place_samples(scene, 300, on="surface", seed=0, atlas=atlas)
    upper = samples.position[:, 2] > 0.25
    opacity = bilinear(chequered(4, 4), samples.position[:, :2])
    assert (opacity[upper] >= 0.5).all()
    assert upper.sum() == pytest.approx(100, abs=15)  # a third of the area; blue noise is steadier than chance, 8
    assert (opacity[~upper] < 0.5).any()


def test_forced_off_the_cards_are_whole(tmp_path: Path) -> None:
    scene = stack([0.0, 0.5], chequered(4))
    plan_on = plan(scene, [parse_lighting([SUN])])
    assert plan_on.called("cut-outs")
    assert plan_on.module("cut-outs") is cutouts
    off = force(scene, off=["cut-outs"])
    effect = next(e for e in plan(off, [parse_lighting([SUN])]).effects if e.name == "cut-outs")
    assert (effect.called, effect.forced, effect.bound) == (False, True, None)
    assert '"leaf"' in effect.why
    assert off.digest != scene.digest
    assert not irradiance(off, SUN, lattice(8, 0.0))[0].any()


def test_scenes_without_holes_do_not_import_the_effect() -> None:
    code = """
import sys
sys.modules["ddprt.transport.cutouts"] = None
import numpy as np, ddprt
from ddprt.scene.library import build
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas
scene = build("plates")
assert Tracer.of(scene).openwork is None
build_open_atlas(Tracer.of(scene), scene, 32)
try:
    Tracer.of(build("leaves"))
except ImportError:
    print("refused")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "refused", done.stderr


CONFIG = configured(
    {
        "atlas": {"resolution": 40},
        "transport": {"samples": 8, "test_samples": 8, "direct_samples": 2, "threads": 2},
        "points": {"count": 16, "supersample": 2},
        "fit": {"bases": 3},
    }
)
LAMPS = [[{**LAMP, "position": [0.3 + 0.15 * k, 0.4 + 0.1 * k, 1.2]}] for k in range(8)]


def test_models_and_datasets_carry_the_holes(tmp_path: Path) -> None:
    scene = stack([0.0, 0.5], chequered(4, 4), two_sided=True)
    lightings = [parse_lighting(lamp) for lamp in LAMPS]
    data = ddprt.bake(scene, lightings, config=CONFIG, out=tmp_path / "data")
    model = ddprt.fit(data)
    expected = data.values([0], model.points, model.quantity)[0]
    np.testing.assert_array_equal(model.measure(LAMPS[0]), expected)
    whole = replace(model, holes=None)
    assert not np.array_equal(whole.measure(LAMPS[0]), expected)
    model.save(tmp_path / "model")
    loaded = ddprt.load_model(tmp_path / "model")
    np.testing.assert_array_equal(loaded.measure(LAMPS[0]), expected)
    np.testing.assert_array_equal(loaded.relight(LAMPS[3]), model.relight(LAMPS[3]))
    # Another bake of the same goes on; one without holes is another scene.
    assert open_dataset(tmp_path / "data").holes is not None
    with pytest.raises(ddprt.UserError, match=r"scene\.digest"):
        ddprt.bake(force(scene, off=["cut-outs"]), lightings, config=CONFIG, out=tmp_path / "data")


def test_a_scene_that_is_all_holes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    bare = Cutout(np.zeros((2, 2), np.float32))
    vanished = stack([0.0, 0.5], None).made_of(lambda material: replace(material, cutout=bare))
    words = "nothing of the scene is left to light, expected some surface"
    with pytest.raises(ddprt.UserError, match=f"stack: got .*{words}"):
        build_open_atlas(Tracer.of(vanished), vanished, 32)
    whole = force(vanished, off=["cut-outs"])
    assert build_open_atlas(Tracer.of(whole), whole, 32)[0].count
    monkeypatch.setitem(SCENES, "vanished", lambda: vanished)
    smoke = Path(__file__).parent.parent / "configs" / "smoke.toml"
    bake = ["bake", smoke, "--scene.name", "vanished", "--lightings.distribution", "around", "--out", tmp_path / "run"]
    for verb in (["inspect", "vanished", "--atlas.resolution", "32"], bake, [*bake, "--dry-run"]):
        assert call(*verb) == 2
        told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ddprt: ")]
        assert len(told) == 1
        assert words in told[0]


def test_without_holes_files_are_what_they_were(tmp_path: Path) -> None:
    data = ddprt.bake(stack([0.0, 0.5], None), [parse_lighting(lamp) for lamp in LAMPS], config=CONFIG, out=tmp_path / "data")
    assert set(load_file(tmp_path / "data" / "scene.safetensors")) == {"corners", "uv"}
    assert data.holes is None
    model = ddprt.fit(data)
    model.save(tmp_path / "model")
    assert not any(name.startswith("holes") for name in load_file(tmp_path / "model" / "tensors.safetensors"))
    assert "holes" not in json.loads((tmp_path / "model" / "model.json").read_text())
    assert ddprt.load_model(tmp_path / "model").holes is None


@pytest.mark.parametrize(
    "damage",
    [
        {"holes.row": np.full(4, 2, np.int32)},
        {"holes.row": np.full(5, -1, np.int32)},
        {"holes.row": np.full(4, -2, np.int32)},
        {"holes.image": np.array([0, 1], np.int32)},
        {"holes.image": np.array([0, -1], np.int32)},
        {"holes.image": np.array([0.0, 0.0])},
        {"holes.size": np.array([[4, 5]])},
        {"holes.size": np.array([[-4, -4]])},
        {"holes.cutoff": np.zeros(2)},
        {"holes.uv": np.zeros((1, 3, 2))},
        {"holes.opacity": np.zeros(15, np.float32)},
        {"holes.opacity": None},
    ],
)
def test_holes_that_do_not_fit_are_refused(damage: dict[str, np.ndarray | None]) -> None:
    holes = Holes.of(stack([0.0, 0.5], chequered(4)))
    assert holes is not None
    again = Holes.read(holes.tensors, 4)
    assert again is not None
    np.testing.assert_array_equal(again.uv, holes.uv)
    tensors = {name: array for name, array in (holes.tensors | damage).items() if array is not None}
    with pytest.raises(ValueError, match="do not fit"):
        Holes.read(tensors, 4)


def test_leaves_in_a_furnace_keep_the_energy() -> None:
    """Closed, of one albedo a, about a lamp of flux F: the mean of direct light is F/A, of indirect light F/A a/(1-a).

    A counts both sides of what of the cards is there.
    """
    scene = build("leaves", albedo=0.5)
    scene = scene.made_of(lambda material: replace(material, albedo=(0.5,) * 3))
    lamp = [{"type": "point", "position": [1.0, 1.0, 1.0], "intensity": [1.0, 1.0, 1.0]}]
    config = CONFIG.model_copy(
        update={
            "atlas": CONFIG.atlas.model_copy(update={"resolution": 96}),
            "transport": CONFIG.transport.model_copy(update={"samples": 32, "test_samples": 32, "direct_samples": 16}),
        }
    )
    data = ddprt.bake(scene, {split: [parse_lighting(lamp)] for split in ("train", "validation", "test")}, config=config)
    direct, indirect = (data.maps(kind, [0])[0][:, 0].astype(float) @ data.area for kind in ("direct", "indirect"))
    print(direct / (4 * np.pi) - 1, indirect / direct - 1)
    # Rims of leaves are met to an eighth of a texel of 4 cm: of some 12 m of rim, half of it lit, a random share of 5 mm is
    # gained or lost every 4 cm: 0.004 * 0.04 * 150 ** 0.5 m² of 24 m² is nothing. 16 places of 5000 texels meet E, which
    # varies by itself within texels by a tenth: 0.1 / 80000 ** 0.5; half shadows along rims and leaves' edges: 300 texels of
    # variance 1/4 / 16 each: 0.125 * 300 ** 0.5 / 5000 = 4e-4; three times that. What is bounced is exact to the noise, 5e-3.
    assert direct == pytest.approx(4 * np.pi, rel=1.5e-3)
    assert indirect == pytest.approx(direct, rel=5e-3)
