"""Subsurface scattering in scenes: who may hold a medium, R as an operator, whole bakes, and what is refused."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_job import base

import ddprt
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.export.textures import export_textures
from ddprt.files import read_tensors, write_tensors
from ddprt.lights import parse_lighting
from ddprt.progress import Progress
from ddprt.report import figures, page, shots
from ddprt.report.evaluate import evaluate, spot_check
from ddprt.report.scenery import Scenery
from ddprt.scene.atlas import build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.exr import read_exr
from ddprt.scene.library import build
from ddprt.scene.material import Emission, Gloss, Material, Subsurface
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted, icosphere, rectangle
from ddprt.transport.effects import force, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.operator import Operator
from ddprt.transport.refraction import fresnel, mean_entering
from ddprt.transport.subsurface import Inside

MILK = Subsurface((1.0, 1.0, 1.0), (0.2, 0.2, 0.2))


def ball(medium: Subsurface = MILK, *, subdivisions: int = 2, radius: float = 1.0) -> Scene:
    points, triangles = icosphere(subdivisions)
    return checked("ball", radius * points, triangles, materials=(Material("milk", (1.0,) * 3, subsurface=medium),))


def lamp(*position: float) -> list[dict[str, Any]]:
    return [{"type": "point", "position": list(position), "intensity": [1.0, 1.0, 1.0]}]


@pytest.fixture(scope="module")
def passing() -> tuple[Operator, Inside]:
    scene = ball(Subsurface((1.0, 0.99, 0.9), (0.2, 0.2, 0.2), 0.3, 1.4))
    operator = Operator.of(Tracer.of(scene, 2), build_atlas(scene, 32, 1))
    return operator, Inside.of(operator, scene)


# --- scenes --------------------------------------------------------------------------------------------------------------


def test_a_leaking_body_is_refused_and_its_edges_are_counted() -> None:
    points, triangles = icosphere(1)
    milk = (Material("milk", (1.0,) * 3, subsurface=MILK),)
    with pytest.raises(UserError, match=r'got 3 open edges on a surface of material "milk"'):
        checked("leaking", points, triangles[1:], materials=milk)
    assert checked("opaque", points, triangles[1:]).materials[0].subsurface is None
    checked("whole", points, triangles, materials=milk)


@pytest.mark.parametrize(
    ("medium", "says"),
    [(MILK, "got 3 open edges"), (replace(MILK, albedo=(2.0,) * 3), "three albedos from 0 to 1")],
)
def test_materials_changed_since_a_scene_was_read_are_looked_at_again(medium: Subsurface, says: str, tmp_path: Any) -> None:
    points, triangles = icosphere(1)
    scene = checked("ball", points, triangles[1:])
    with pytest.raises(UserError, match=says):
        ddprt.bake(scene.made_of(lambda material: replace(material, subsurface=medium)), resolution=16, out=tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_a_body_turned_inside_out_or_shared_is_refused() -> None:
    points, triangles = icosphere(1)
    milk, stone = Material("milk", (1.0,) * 3, subsurface=MILK), Material("stone", (0.5,) * 3)
    with pytest.raises(UserError, match="fronts face inwards"):
        checked("turned", points, triangles[:, ::-1], materials=(milk,))
    half = (np.arange(len(triangles)) < 40).astype(np.int32)
    with pytest.raises(UserError, match='"milk", "stone" that hangs together'):
        checked("shared", points, triangles, material=half, materials=(milk, stone))


@pytest.mark.parametrize(
    "changes",
    [{"albedo": (1.1, 1, 1)}, {"mean_free_path": (0.0, 1, 1)}, {"anisotropy": 1.0}, {"index": 0.9}, {"albedo": (1.0, 1.0)}],
)
def test_a_medium_that_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises((UserError, Exception), match=r"expected three albedos|Type-check"):
        ball(replace(MILK, **changes))


def test_digests_tell_media_apart() -> None:
    assert ball().digest != ball(replace(MILK, index=1.1)).digest != ball(replace(MILK, anisotropy=0.1)).digest
    assert (
        build("statue-marble", subdivisions=2).digest
        != force(build("statue-marble", subdivisions=2), off=["subsurface"]).digest
    )


def test_forced_off_a_body_is_as_bright_as_its_medium_where_it_is_thick() -> None:
    marble = build("statue-marble", subdivisions=2)
    off = force(marble, off=["subsurface"])
    assert off.materials[0].subsurface is None
    assert off.materials[0].albedo == pytest.approx(marble.materials[0].subsurface.thick_albedo)  # type: ignore[union-attr]
    decided = {effect.name: effect for effect in plan(marble, ()).effects}
    assert decided["subsurface"].called
    assert '"marble"' in decided["subsurface"].why
    assert {e.name: e for e in plan(off, ()).effects}["subsurface"].bound is None
    assert {e.name: e for e in plan(force(ball(), off=["subsurface"]), ()).effects}["subsurface"].bound == 1.0


# --- R -------------------------------------------------------------------------------------------------------------------


def test_rows_of_a_white_body_add_up_to_what_enters(passing: tuple[Operator, Inside]) -> None:
    """The furnace by the operator: of light from everywhere as much leaves as enters; red is white, blue swallows."""
    _, inside = passing
    red, green, blue = (rows.sum(1) for rows in inside.matrix(seed=0, stream="furnace").channels)
    area = inside.atlas.area  # a sender is a texel here
    mean = [float(rows @ area / area.sum()) for rows in (red, green, blue)]
    # 64 walks of each of some 500 senders, each worth its share of entering light: 0.1 % of noise; 0.5 % is asked.
    assert mean[0] == pytest.approx(mean_entering(1.4), rel=0.005)
    assert mean[0] > mean[1] > mean[2] > 0.1


def test_light_through_a_body_is_the_same_both_ways(passing: tuple[Operator, Inside]) -> None:
    """Areas times R is symmetric, however the surface is cut into senders; here over three belts."""
    operator, inside = passing
    rows = inside.matrix(seed=1, stream="both").channels[1]
    belt = np.digitize(inside.atlas.position[:, 1], [-0.4, 0.4])
    flow = np.zeros((3, 3))
    where = rows.tocoo()
    np.add.at(flow, (belt[where.row], belt[where.col]), inside.atlas.area[where.row] * where.data)
    share = np.abs(flow - flow.T) / np.minimum(flow, flow.T)
    # The rarest way, pole to pole, is taken by some 1000 walks: 3 % of noise on either side; four of these.
    assert share.max() < 0.17
    assert len(operator.senders.area) == len(inside.senders)


def test_light_that_comes_flat_enters_less() -> None:
    """On a ball of glass under one lamp: what enters is irradiance times Fresnel's transmittance at that texel's angle."""
    scene = ball(replace(MILK, index=1.5), subdivisions=3)
    operator = Operator.of(Tracer.of(scene, 2), build_atlas(scene, 32, 1))
    inside = Inside.of(operator, scene)
    light = np.ones((operator.atlas.count, 3), np.float32)
    sun = parse_lighting({"type": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]})
    entering = inside.entering(light, sun, np.random.default_rng(0))
    cosine = operator.atlas.geometric_normal[:, 1]
    lit = cosine > 0.3  # a texel's four places are on facets that differ by up to 0.15 in angle; on the mean that is little
    inner = np.sqrt(1 - (1 - cosine[lit] ** 2) / 1.5**2)
    expected = (1 - fresnel(cosine[lit], inner, 1.5)) / mean_entering(1.5)
    assert np.abs(entering[lit, 0] / expected - 1).mean() < 0.02
    assert entering[lit, 0].min() < 0.92 < 1.03 < entering[lit, 0].max()
    both = (*sun, *parse_lighting({"type": "point", "position": [0, 3, 0], "intensity": [1, 1, 1]}))
    assert inside.entering(light, both, np.random.default_rng(0))[lit].max() < 1.2
    matched = replace(inside, bodies=tuple((replace(body, index=1.0), own) for body, own in inside.bodies))
    assert matched.entering(light, sun, np.random.default_rng(0)) is light


def test_neighbours_share_walks_as_far_as_it_pays_and_no_further(passing: tuple[Operator, Inside]) -> None:
    """Noise alone is shared over the widest footprints, detail without noise over none; the error told is the true one."""
    _, inside = passing
    rng, count = np.random.default_rng(0), len(inside.texels)
    detail = rng.random((4, count, 3), np.float32)
    light, facts = inside.shared(detail, detail)
    np.testing.assert_array_equal(light, detail)
    assert facts == {"shared_over": 0.0, "error_expected": 0.0}
    height = 2 + inside.atlas.position[inside.texels, 1].astype(np.float32)[None, :, None]
    smooth = np.broadcast_to(height, (4, count, 3))
    halves = [smooth + 0.5 * rng.standard_normal((4, count, 3), np.float32) for _ in range(2)]
    light, facts = inside.shared(*halves)
    weight = inside.atlas.area[inside.texels] / inside.atlas.area[inside.texels].sum()
    error = float(np.einsum("ltc,t->", (light - smooth) ** 2, weight) / 12) ** 0.5
    plain = float(np.einsum("ltc,t->", ((halves[0] + halves[1]) / 2 - smooth) ** 2, weight) / 12) ** 0.5
    assert facts["shared_over"] == 1.0
    assert error < 0.6 * plain
    # Some 300 texels of 12 values, about five of which are one after sharing: 1 / sqrt(2 * 700), 3 %; four of these.
    assert facts["error_expected"] * float(np.einsum("tc,t->", smooth[0], weight) / 3) == pytest.approx(error, rel=0.12)


# --- bakes ---------------------------------------------------------------------------------------------------------------


def baked(scene: Scene, lights: list[Any], tmp_path: Any, progress: Progress | None = None, **changes: Any) -> Dataset:
    config = base(atlas__resolution=24, points__count=4, points__supersample=1, transport__threads=2, **changes)
    return bake(scene, [parse_lighting(light) for light in lights], config=config, out=tmp_path, progress=progress)


def test_a_lonely_body_glows_from_behind_by_as_much_light_as_enters(tmp_path: Any) -> None:
    """White and index-matched, convex: all light that falls on it leaves, and none is gathered; also where no lamp shines."""
    scene = ball()
    progress = Progress(quiet=True)
    data = baked(scene, [lamp(0, 3, 0)] * 3, tmp_path, progress, transport__samples=64, transport__test_samples=64)
    direct, indirect = (data.maps(kind, [0])[0] for kind in ("direct", "indirect"))
    area = data.area
    # 64 walks from each of 300 texels: single walks differ by about 1, so 0.7 % of noise; four of these.
    assert (area @ indirect)[1] == pytest.approx((area @ direct)[1], rel=0.03)
    dark = data.gbuffer["geometric_normal"][:, 1] < -0.2
    assert not direct[dark].any()
    assert (indirect[dark].max(1) > 0).mean() > 0.95  # of 64 walks from the far pole all may stay there
    assert data.description["exitant"] == ["milk"]
    stages = {stage["name"]: stage for stage in progress.stages}
    assert stages["subsurface train"]["shared_over"] >= 0
    assert "shared_over" not in stages["subsurface test"]
    noise = data.maps("noise", data.split("test"))
    assert noise.any()
    assert spot_check(scene, data, base(report__spot_check_texels=8)) == {}  # by the reference, which cannot see it


@pytest.fixture(scope="module")
def above(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Dataset, Dataset]:
    """A ball above a floor, baked twice."""
    milk = Material("milk", (1.0,) * 3, subsurface=Subsurface((1.0,) * 3, (0.3,) * 3))
    points, triangles = icosphere(2)
    floor = rectangle((-1.5, -1.5), (1.5, 1.5), -1.3, 1, facing=1)
    scene = checked(
        "above",
        np.concatenate([points, floor]),
        np.concatenate([triangles, len(points) + np.array([[0, 1, 2], [0, 2, 3]])]),
        material=np.repeat([0, 1], [len(triangles), 2]),
        materials=(milk, Material("dark", (0.25,) * 3)),
    )
    small = {"transport__samples": 16, "transport__test_samples": 32}
    lamps, folder = [lamp(0, 4, 0), lamp(2, 3, 0), lamp(0, 4, 0)], tmp_path_factory.mktemp("above")
    one, two = (baked(scene, lamps, folder / name, **small) for name in ("one", "two"))
    return scene, one, two


def test_equal_seeds_give_equal_bits_and_a_body_lights_the_ground(above: tuple[Scene, Dataset, Dataset]) -> None:
    """The floor's lamp-side is as with an opaque ball, its shadow is lit through the ball."""
    _, one, two = above
    maps = [(data.folder / "manifest.jsonl").read_text() for data in (one, two)]
    hashes = [[json.loads(line) for line in text.splitlines()] for text in maps]
    assert hashes[0] == hashes[1]
    ground = two.gbuffer["position"][:, 1] < -1.2
    shade = ground & (np.abs(two.gbuffer["position"][:, [0, 2]]).max(1) < 0.5)
    assert shade.any()
    assert not two.maps("direct", [0])[0][shade].any()
    assert (one.maps("indirect", [0])[0][shade] > 0).all()


# --- shown and exported ------------------------------------------------------------------------------------------------


def test_pictures_show_no_diffuse_light_of_lamps_on_a_body(
    above: tuple[Scene, Dataset, Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that pictures are made of: the floor's direct light as it is, none on the ball, whose lit side has plenty."""
    scene, data, _ = above
    exitant, test = data.exitant, data.split("test")
    assert exitant is not None
    np.testing.assert_array_equal(exitant, data.gbuffer["position"][:, 1] > -1.2)
    direct, seen = data.maps("direct", test)[0], list[np.ndarray]()
    assert direct[exitant].max() > 0.1
    lit = Scenery.lit

    def told(light: np.ndarray, *_: Any) -> None:
        seen.append(light)
        raise InterruptedError  # all other pictures are of other things

    def shown(self: Scenery, lighting: Any, light: np.ndarray, *more: Any) -> np.ndarray:
        seen.append(light)
        return lit(self, lighting, light, *more)

    monkeypatch.setattr(Scenery, "lit", shown)
    monkeypatch.setattr(shots, "Scenery", SimpleNamespace(of=partial(Scenery.of, height=24)))
    monkeypatch.setattr(page, "take_view", partial(page.take_view, height=24))
    monkeypatch.setattr(figures, "lighting_row", told)
    model, config = ddprt.fit(data, bases=1), base(atlas__resolution=24)
    with pytest.raises(InterruptedError):
        page._pictures(evaluate(data, {"svd-ridge": model}, {}), data, "svd-ridge", model, config, scene)
    assert len(seen) == 2
    for light in seen:
        assert not light[exitant].any()
        np.testing.assert_array_equal(light[~exitant], direct[~exitant])


def test_a_dataset_that_lost_its_exitant_texels_says_so(above: tuple[Scene, Dataset, Dataset]) -> None:
    _, data, _ = above
    other = replace(data, description={**data.description, "exitant": ["milk"]})
    tensors = read_tensors(data.folder / "scene.safetensors")
    write_tensors(data.folder / "scene.safetensors", {key: value for key, value in tensors.items() if key != "exitant"})
    try:
        with pytest.raises(UserError, match="got none exitant texels"):
            other.shaded([0])
    finally:
        write_tensors(data.folder / "scene.safetensors", tensors)


def test_engines_are_told_where_no_lamp_is_to_be_added(above: tuple[Scene, Dataset, Dataset], tmp_path: Any) -> None:
    """By the decoder that the docs print, after a save and a load: albedo times direct light on the floor alone."""
    _, data, _ = above
    ddprt.fit(data, bases=1).save(tmp_path / "model")
    model = ddprt.load_model(tmp_path / "model")
    written = export_textures(model, tmp_path / "export")
    assert {path.name for path in written} == {path.name for path in (tmp_path / "export").iterdir()}
    blocks = re.findall(r"```python\n(.*?)```", (Path(__file__).parent.parent / "docs" / "export.md").read_text(), re.DOTALL)
    scope: dict[str, Any] = {}
    for name in ("def decode", "def leaving"):
        exec(next(block for block in blocks if name in block), scope)
    values, direct = data.values([0], 4, "radiosity")[0], model.image(data.maps("direct", [0])[0])
    indirect, albedo = scope["decode"](tmp_path / "export", values), model.image(data.gbuffer["albedo"])
    out = scope["leaving"](tmp_path / "export", albedo, direct, indirect)[model.covered]
    ball, dark, learned = data.exitant, ~data.exitant, indirect[model.covered]
    np.testing.assert_array_equal(out[ball], learned[ball])  # the ball's albedo is 1
    np.testing.assert_array_equal(out[dark], data.gbuffer["albedo"][dark] * (data.maps("direct", [0])[0] + learned)[dark])
    assert data.maps("direct", [0])[0][ball].max() > 0.1
    mask = read_exr(tmp_path / "export" / "exitant.exr")[0]
    assert set(np.unique(mask)) == {0, 1}
    opaque = replace(model, exitant=None)
    export_textures(opaque, tmp_path / "export")
    assert not (tmp_path / "export" / "exitant.exr").exists()
    assert "exitant" not in json.loads((tmp_path / "export" / "manifest.json").read_text())


# --- refused -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "config", "expected"),
    [
        ({"gloss": Gloss(0.2, 1.0)}, {}, "transport.integrator"),
        ({"emission": Emission((1.0, 1.0, 1.0))}, {}, "emission"),
        ({}, {"transport__integrator": "paths"}, "transport.integrator"),
        ({}, {"transport__integrator": "reference"}, "transport.integrator"),
    ],
)
def test_what_does_not_go_together_is_refused(
    part: dict[str, Any], config: dict[str, Any], expected: str, tmp_path: Any
) -> None:
    points, triangles = icosphere(1)
    floor = rectangle((-1.5, -1.5), (1.5, 1.5), -1.3, 1, facing=1)
    scene = checked(
        "mixed",
        np.concatenate([points, floor]),
        np.concatenate([triangles, len(points) + np.array([[0, 1, 2], [0, 2, 3]])]),
        material=np.repeat([0, 1], [len(triangles), 2]),
        materials=(Material("milk", (1.0,) * 3, subsurface=MILK), Material("other", (0.5,) * 3, **part)),
    )
    with pytest.raises(UserError, match=rf'{expected}: got material "milk" with subsurface'):
        baked(scene, [lamp(0, 4, 0)] * 3, tmp_path, **config)


def test_the_yardstick_refuses_what_it_cannot_see() -> None:
    with pytest.raises(UserError, match='material "milk" with subsurface scattering'):
        ddprt.irradiance(ball(), lamp(0, 3, 0), [[0, 1, 0]], [[0, 1, 0]], samples=4)


def test_forced_on_where_nothing_is_filled_changes_no_light(tmp_path: Any) -> None:
    scene = faceted("cube", box(np.zeros(3), np.ones(3)), (Material("plain", (0.5,) * 3),))
    data = baked(force(scene, on=["subsurface"]), [lamp(0.5, 3, 0.5)] * 3, tmp_path)
    assert not data.maps("indirect", [0]).any()
    assert "exitant" not in data.description
