"""Samples that are lit from behind their surface: against a slow twin, Poisson's sum and its laws, from bake to export."""

import itertools
import json
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import oracles
import pytest
from oracles import U32, over_bound

import ddprt
from ddprt.config import Config, load_config
from ddprt.dataset.generate import DEPTH
from ddprt.dataset.store import Dataset, open_dataset
from ddprt.errors import UserError
from ddprt.export.textures import export_textures
from ddprt.files import read_tensors, write_tensors
from ddprt.lights import Light, Lighting, parse_lighting
from ddprt.sampling.points import place_samples
from ddprt.scene.fog import Fog
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, rectangle
from ddprt.transport.direct import centred
from ddprt.transport.embree import Tracer, lifted
from ddprt.transport.measure import measure

DOCS = Path(__file__).parent.parent / "docs" / "export.md"
GREY = (Material("grey", (0.5,) * 3),)
POINT = {"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1.0, 0.5, 0.0]}
SPOT = {"type": "spot", "position": [0.4, 0.5, 0.1], "direction": [-0.5, -1, 0.7], "intensity": [2, 1, 0.5], "outer_deg": 50}
SUN = {"type": "directional", "direction": [0.1, -0.4, 1], "irradiance": [0.5, 1, 2]}
RECT = {"type": "rect", "center": [0.1, 0.3, 0], "half_u": [0.1, 0, 0], "half_v": [0, 0, 0.2], "radiance": [9, 6, 3]}
BALL = {"type": "sphere", "center": [0.1, 0.3, 0], "radius": 0.1, "radiance": [9, 6, 3]}
NEAR = {"type": "point", "position": [0.3, 0.002, 0.03], "intensity": [1, 2, 3]}  # 2 mm above Cornell's floor


def floor(*more: np.ndarray, half: float = 1.0) -> Tracer:
    """A square floor about the origin that faces up, and other quads."""
    return Tracer.of(faceted("floor", np.array([rectangle((-half, -half), (half, half), 0.0, 1, facing=1), *more]), GREY), 1)


def upwards(positions: Any) -> np.ndarray:
    return np.tile([0.0, 1.0, 0.0], (len(positions), 1))


# --- against a slow twin ----------------------------------------------------------------------------------------------


def unshadowed(lamp: Light, place: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """E of a point or spot lamp with nothing in between, and the most by which float32 may miss it, before colour.

    Coordinates of unit vectors are off by u each, so a cosine of three products and two sums by 6 u at most, and its product
    with strength by 2 u more, all in units of 1 / r². Half the squared distance of two unit vectors is off by at most
    2 sqrt(3) u of each coordinate plus 5 of its own; the cone's falloff by that over its width, its square by twice that.
    """
    record = lamp.model_dump()  # type: ignore[attr-defined]
    away = np.array(record["position"], np.float32).astype(float) - place
    distance = np.linalg.norm(away)
    towards, strength, slack = away / distance, 1 / distance**2, 8.0
    if record["type"] == "spot":
        outer, inner = np.cos(np.radians([record["outer_deg"], record["inner_deg"]]))
        strength *= np.clip((-towards @ np.array(record["direction"]) - outer) / (inner - outer), 0, 1) ** 2
        slack += 2 * (2 * np.sqrt(3) + 5) / (inner - outer)
    return max(normal @ towards, 0.0) * strength * np.array(record["intensity"]), slack * U32 / distance**2


def twin(scene: Scene, tracer: Tracer, lamp: Light, position: np.ndarray, normal: np.ndarray, depth: float) -> tuple:
    """V max(0, 2 E(e) - E(2 e)) of a lamp without size, and the bound of a float32 one; V by trying every triangle."""
    world = lamp.model_dump()  # type: ignore[attr-defined]
    away = np.array(world["position"]) - position
    distance = float(np.linalg.norm(away))
    nearest = oracles.first_hit(scene, position + oracles.NUDGE * normal, away / distance)[1]
    if away @ normal <= 0 or nearest < distance - 2 * oracles.NUDGE:
        return np.zeros(3), np.zeros(3)
    (inner,) = centred(tracer, (lamp,))
    facing = normal.astype(np.float32)
    below = ((position - e * normal - tracer.centre).astype(np.float32) for e in (depth, 2 * depth))
    at = (lifted(tracer, place[None], facing[None])[0].astype(float) for place in below)
    (near, a), (far, b) = (unshadowed(inner, place, facing.astype(float)) for place in at)
    colour = np.array(world["intensity"])
    # Two more roundings of each, by its colour and the sum; where the difference is cut off at 0, it is off by no more.
    return np.maximum(2 * near - far, 0), (2 * a + b) * colour + 2 * U32 * (2 * near + far)


@pytest.mark.parametrize("depth", [0.01, 0.1])
@pytest.mark.parametrize("record", [POINT, SPOT, NEAR, {**SPOT, "inner_deg": 49}], ids=["point", "spot", "near", "sharp spot"])
def test_lamps_without_size_against_loops(cornell: Scene, record: dict, depth: float) -> None:
    tracer, samples = Tracer.of(cornell, 1), place_samples(cornell, 120, on="surface", seed=1)
    lighting = parse_lighting(record)
    got = measure(tracer, lighting, samples.position, samples.normal, seed=0, depth=depth)
    rows = [
        twin(cornell, tracer, lighting[0], position, normal, depth)
        for position, normal in zip(samples.position, samples.normal, strict=True)
    ]
    exact, bound = (np.array(part) for part in zip(*rows, strict=True))
    assert over_bound(got - exact, bound) <= 1
    assert 10 < (got.max(1) > 0).sum() < 120
    plain = measure(tracer, lighting, samples.position, samples.normal, seed=0)
    assert over_bound(got - plain, bound) > 100, "a depth that changes nothing would pass"


def test_parallel_light_has_no_depth(cornell: Scene) -> None:
    """E does not depend on the place, and 2 E - E is E to the bit."""
    tracer, samples = Tracer.of(cornell, 1), place_samples(cornell, 120, on="surface", seed=1)
    plain, sunk = (
        measure(tracer, parse_lighting(SUN), samples.position, samples.normal, seed=0, depth=depth) for depth in (0.0, 0.1)
    )
    assert plain.any()
    np.testing.assert_array_equal(sunk, plain)


@pytest.mark.parametrize("kind", ["rect", "sphere"])
@pytest.mark.parametrize("depth", [0.0, 0.05, 0.3])
def test_lamps_with_size_against_closed_forms(kind: str, depth: float) -> None:
    """Unshadowed, so that the mean over random numbers is unbiased: 4000 times the same sample."""

    def exact(depth: float) -> float:
        place = np.array([0.0, -depth, 0.0])
        if kind == "sphere":
            away = np.array([0.1, 0.3, 0]) - place
            return float(np.pi * 9 * 0.1**2 / (away @ away) * away[1] / np.linalg.norm(away))
        corners = np.array([[0.1 + 0.1 * a, 0.3, 0.2 * b] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        return oracles.polygon_irradiance(corners, 9.0, place, np.array([0.0, 1, 0]))

    count = 4000
    record = RECT if kind == "rect" else BALL
    positions = np.zeros((count, 3))
    got = measure(floor(), parse_lighting(record), positions, upwards(positions), seed=5, depth=depth)[:, 0].astype(float)
    expected = 2 * exact(depth) - exact(2 * depth)
    # Five standard errors of the mean; its rounding: sums of 64 positive float32 terms of 12 roundings each, 2 E and E. The
    # sample lies 6 micrometres above its place at a distance of 0.2 m and more: 3 of its share at most.
    rounding = 80 * U32 * (2 * exact(depth) + exact(2 * depth)) + 3 * float(floor().offset) / 0.2 * expected
    assert abs(got.mean() - expected) <= 5 * got.std() / np.sqrt(count) + rounding
    assert 5 * got.std() / np.sqrt(count) < 0.01 * expected


@pytest.mark.parametrize("record", [RECT, BALL], ids=["rect", "sphere"])
def test_partial_shadow_keeps_its_share(record: dict) -> None:
    """The part of a lamp that a surface point sees is the part of its sunk light that it gets."""
    roof = rectangle((-1.0, -1.0), (1.0, 1.0), 1.0, 1, facing=-1)  # the same bounds, and so the same frame, in both
    blocker = rectangle((-0.5, 0.1), (0.5, 0.5), 0.15, 1, facing=1)  # z -0.5..0.5, x 0.1..0.5: below the lamps
    shaded, free = floor(roof, blocker), floor(roof)
    positions = np.stack([np.linspace(-0.9, 0.9, 101), np.zeros(101), np.full(101, 0.02)], 1)

    def of(tracer: Tracer, depth: float) -> np.ndarray:
        return measure(tracer, parse_lighting(record), positions, upwards(positions), seed=2, depth=depth)[:, 0].astype(float)

    share = of(shaded, 0.0) / of(free, 0.0)
    assert ((share > 0.05) & (share < 0.95)).sum() > 5, "partial shadows"
    assert (share == 0).any()
    # The same random numbers: all there is to round is the quotient and the product.
    expected = share * of(free, 0.1)
    assert over_bound(of(shaded, 0.1) - expected, 3 * U32 * expected) <= 1


# --- what a depth is for ----------------------------------------------------------------------------------------------


def aliasing(spacing: float, height: float, depth: float) -> float:
    """Most that a square grid of samples mistakes of a lamp's flux on a plane, as a share of it.

    Poisson's sum: the mean over the grid is the transform of E at the waves k = 2 pi (m, n) / d, and that of a lamp at height
    h is 2 pi I exp(-k h). Corrected, each is multiplied by exp(-k e) (2 - exp(-k e)); a lamp right above a sample has all of
    them in phase.
    """
    total = 0.0
    for m, n in itertools.product(range(-8, 9), repeat=2):  # further waves have less than exp(-16 pi 0.8) each
        k = 2 * np.pi / spacing * np.hypot(m, n)
        total += np.exp(-k * (height + depth)) * (2 - np.exp(-k * depth)) * (k > 0)
    return total


def beyond(radius: float, height: float, depth: float) -> float:
    """Share of the corrected light outside a circle about a lamp."""
    far = [(height + e) / np.hypot(radius, height + e) for e in (depth, 2 * depth)]
    return 2 * far[0] - far[1]


def test_a_grid_of_sunk_samples_sees_the_flux_of_a_lamp_between_them() -> None:
    """A lamp at a twentieth of the distance between samples, anywhere: what a regular grid measures on average is its flux."""
    spacing, side = 0.02, 101
    height, depth = 0.05 * spacing, DEPTH * spacing
    ticks = spacing * (np.arange(side) - side // 2)
    positions = np.stack([np.repeat(ticks, side), np.zeros(side**2), np.tile(ticks, side)], 1)
    tracer = floor(half=1.1)
    shifts = np.concatenate([[[0, 0], [0.5, 0], [0.5, 0.5]], np.random.default_rng(0).random((9, 2))])
    errors: dict[float, list[float]] = {0.0: [], depth: []}
    for (x, z), e in itertools.product(spacing * shifts, errors):
        lamp = parse_lighting({"type": "point", "position": [x, height, z], "intensity": [1, 1, 1]})
        found = measure(tracer, lamp, positions, upwards(positions), seed=0, depth=e)[:, 0].astype(float)
        errors[e].append(abs(found.sum() * spacing**2 / (2 * np.pi) - 1))
    # Samples are lifted, so that their lamp is nearer by as much. What lies outside of the grid is missing: all of E past the
    # circle inside it, and as E falls there, at most what lies past a circle a cell's diagonal smaller.
    inside = spacing * (side // 2 - 1 - np.sqrt(2))
    bound = aliasing(spacing, height - float(tracer.offset), depth) + beyond(inside, height, depth) + 30 * U32
    assert bound < 0.1
    assert max(errors[depth]) <= bound
    assert max(errors[depth]) > 0.5 * bound, "the bound is met by the lamp right above a sample"
    assert min(errors[0.0]) > bound, "on the surface there is no lamp that the grid measures so well"
    assert max(errors[0.0]) > 10


def test_a_spot_on_the_floor_between_the_samples_is_seen() -> None:
    """Its cone on the surface is a disc smaller than the gaps: shadows are asked for without the cone."""
    spot = {"type": "spot", "position": [0.5, 0.05, 0.5], "direction": [0, -1, 0], "intensity": [1, 1, 1], "outer_deg": 60}
    corners = np.array([[x, 0.0, z] for x in (0.0, 1.0) for z in (0.0, 1.0)])
    tracer = floor(half=2.0)
    assert not measure(tracer, parse_lighting(spot), corners, upwards(corners), seed=0).any()
    sunk = measure(tracer, parse_lighting(spot), corners, upwards(corners), seed=0, depth=0.75)
    assert (sunk > 0).all()


# --- laws -------------------------------------------------------------------------------------------------------------

ALL = [POINT, SPOT, SUN, RECT, BALL, NEAR]


@pytest.fixture(scope="module")
def room(cornell: Scene) -> tuple[Tracer, np.ndarray, np.ndarray]:
    samples = place_samples(cornell, 200, on="surface", seed=2)
    return Tracer.of(cornell, 1), samples.position, samples.normal


def sunk(room: tuple[Tracer, np.ndarray, np.ndarray], lighting: Lighting, depth: float = 0.05) -> np.ndarray:
    return measure(*room[:1], lighting, *room[1:], seed=0, depth=depth)


def test_twice_the_light_is_twice_the_result_and_black_stays_black(room: tuple) -> None:
    lighting = parse_lighting(ALL)
    base = sunk(room, lighting)
    assert base.any()
    np.testing.assert_array_equal(sunk(room, tuple(lamp.scaled(2.0) for lamp in lighting)), 2 * base)
    assert not sunk(room, tuple(lamp.scaled(0.0) for lamp in lighting)).any()
    assert not sunk(room, ()).any()


def test_lights_add_up(room: tuple) -> None:
    """To the bit, and also where a spot's cone opens on the deeper place alone, which must not take from another lamp."""
    narrow = {"type": "spot", "position": [0.1, 0.3, 0.1], "direction": [0, -1, 0], "intensity": [9, 9, 9], "outer_deg": 20}
    for records in ([POINT, SPOT, SUN, NEAR, narrow], [RECT, BALL]):  # apart, since lamps with size ask for more samples
        total = np.zeros_like(room[1], np.float32)
        for record in records:
            total += sunk(room, parse_lighting(record))
        together = sunk(room, parse_lighting(records))
        assert together.any()
        np.testing.assert_array_equal(together, total)
    open_below = np.array([lamp_sign(room, narrow, row) for row in range(len(together))])
    assert (open_below < 0).any(), "no sample where 2 E(e) - E(2 e) is negative"


def lamp_sign(room: tuple, record: dict, row: int) -> float:
    """2 E(e) - E(2 e) of a sample, shadows left out."""
    tracer, positions, normals = room
    (lamp,) = centred(tracer, parse_lighting(record))
    near, far = (unshadowed(lamp, positions[row] - tracer.centre - e * normals[row], normals[row])[0][0] for e in (0.05, 0.1))
    return float(2 * near - far)


@pytest.mark.parametrize("record", [POINT, SPOT, RECT, BALL], ids=lambda record: record["type"])
@pytest.mark.parametrize("height", [0.0, 1e-9, 1e-6, 1e-3])
def test_a_lamp_on_a_sample_gives_finite_light(record: dict, height: float) -> None:
    key = "position" if "position" in record else "center"
    positions = np.array([[0.0, 0, 0], [0.1, 0, 0.1]])
    lighting = parse_lighting({**record, key: [0.0, height, 0.0]})
    found = measure(floor(), lighting, positions, upwards(positions), seed=0, depth=0.01)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    if record is POINT and height == 1e-3:  # a lamp that stands above its lifted samples is seen, and not too bright
        assert 0 < found[0, 0] <= 2 / 0.01**2


def test_a_lamp_inside_a_block_lights_nothing_outside(cornell: Scene, room: tuple) -> None:
    middle = np.append(oracles.BLOCKS[1][0].mean(0), 0.2)[[0, 2, 1]]
    assert oracles.inside_a_block(middle)
    outside = [not oracles.inside_a_block(place + 1e-3 * normal) for place, normal in zip(*room[1:], strict=True)]
    lamp = {"type": "point", "position": middle.tolist(), "intensity": [1, 1, 1]}
    # As deep as the block is wide, every sample on its faces has the lamp in front of where it is lit from.
    found = measure(room[0], parse_lighting(lamp), room[1][outside], room[2][outside], seed=0, depth=0.2)
    assert len(found) > 100
    assert not found.any()


# --- from configuration to export -------------------------------------------------------------------------------------


def job(**points: Any) -> Config:
    transport = {"samples": 16, "test_samples": 16, "direct_samples": 1, "threads": 1}
    settings = {"count": 32, "supersample": 8, **points}
    return Config.model_validate({"atlas": {"resolution": 32}, "points": settings, "transport": transport})


def lamps(*heights: float) -> list[Lighting]:
    """Lamps above free floor of the Cornell box, in front of the blocks."""
    places = [[x, height, 0.02] for x, height in zip(np.linspace(0.2, 0.4, len(heights)), heights, strict=True)]
    return [parse_lighting({"type": "point", "position": place, "intensity": [1, 2, 3]}) for place in places]


@pytest.fixture(scope="module")
def data(cornell: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Every other lamp stands 2 mm above the floor."""
    return ddprt.bake(cornell, lamps(*[0.002, 0.2] * 6), config=job(), out=tmp_path_factory.mktemp("depth") / "data")


@pytest.mark.parametrize("nearest", [0.98, 1.02])
def test_depth_is_for_lamps_nearer_than_samples_are_to_each_other(cornell: Scene, data: Dataset, nearest: float) -> None:
    spacing = data.samples.spacing
    samples = ddprt.bake(cornell, lamps(0.27, 0.27, nearest * spacing), config=job()).samples
    assert samples.spacing == spacing
    assert samples.depth == (DEPTH * spacing if nearest < 1 else 0)


def test_depth_as_asked(cornell: Scene, tmp_path: Path) -> None:
    """A number is taken as it is; auto leaves light without a place alone, and given points, which may stand anywhere."""
    near, suns = lamps(0.27, 0.27, 0.002), [parse_lighting({**SUN, "direction": [x, -0.4, 1]}) for x in (0, 0.1, 0.2)]
    given = [{"position": [0.1 + 0.05 * k, 0, 0.03], "normal": [0, 1, 0]} for k in range(8)]
    (tmp_path / "points.json").write_text(json.dumps(given))
    listed = {"file": str(tmp_path / "points.json"), "count": 8, "supersample": 1}

    def depth(lightings: list[Lighting], **points: Any) -> float:
        samples = ddprt.bake(cornell, lightings, config=job(**points)).samples
        return samples.depth / samples.spacing

    assert depth(near, depth=0) == 0
    assert depth(lamps(0.27, 0.27, 0.27), depth=0.5) == 0.5
    assert depth(suns) == 0
    assert depth(near, **listed) == 0
    assert depth(near, **listed, depth=0.5) == 0.5


@pytest.mark.parametrize("depth", ["auto", 0.0, 0.75, 8.0])
def test_configured_depth_survives_the_round_trip(depth: Any) -> None:
    config = job(depth=depth)
    again = Config.model_validate(tomllib.loads(config.to_toml()))
    assert (again, again.points.depth) == (config, depth)
    assert load_config(None, {"points.depth": str(depth)}).points.depth == depth


@pytest.mark.parametrize("depth", ["-0.1", "8.1", "nan", "deep"])
def test_a_depth_out_of_range_is_one_line(depth: str) -> None:
    with pytest.raises(UserError, match=r"points\.depth") as caught:
        load_config(None, {"points.depth": depth})
    assert "\n" not in str(caught.value)


def test_a_saved_model_measures_what_was_baked(data: Dataset, tmp_path: Path) -> None:
    model = ddprt.fit(data, bases=2)
    model.save(tmp_path / "model.ddprt")
    loaded = ddprt.load_model(tmp_path / "model.ddprt")
    assert loaded.samples.depth == data.samples.depth == DEPTH * data.samples.spacing
    for index, lighting in enumerate(data.lightings):
        np.testing.assert_array_equal(loaded.measure(lighting), data.values([index], 32, "radiosity")[0])
    assert data.samples.digest != without_depth(data, tmp_path / "older").samples.digest


def without_depth(data: Dataset, folder: Path) -> Dataset:
    """The same dataset as it was before there was a depth."""
    shutil.copytree(data.folder, folder)
    tensors = read_tensors(folder / "points.safetensors")
    write_tensors(folder / "points.safetensors", {name: value for name, value in tensors.items() if name != "depth"})
    return open_dataset(folder)


def test_older_datasets_and_models_lie_on_the_surface(data: Dataset, tmp_path: Path) -> None:
    assert without_depth(data, tmp_path / "data").samples.depth == 0
    model = ddprt.fit(data, bases=2)
    model.save(tmp_path / "model.ddprt")
    path = tmp_path / "model.ddprt" / "model.json"
    document = json.loads(path.read_text())
    assert document["points"].pop("depth") == data.samples.depth
    path.write_text(json.dumps(document))
    older = ddprt.load_model(tmp_path / "model.ddprt")
    assert older.samples.depth == 0
    plain = measure(Tracer(older.occluders), data.lightings[1], data.samples.position, data.samples.normal, seed=0)
    one_each = np.zeros((32, 3))
    for point, light in zip(data.samples.nearest_point(32), plain * data.samples.albedo, strict=True):
        one_each[point] += light
    sizes = np.bincount(data.samples.nearest_point(32))[:, None]
    # Means of some tens of float32 terms.
    np.testing.assert_allclose(older.measure(data.lightings[1]), one_each / sizes, rtol=2 * sizes.max() * U32)


@pytest.mark.parametrize("fog", [None, Fog((0.3, 0.5, 2.0), (0.9, 0.8, 0.7), 0.3)], ids=["clear", "fog"])
def test_exported_samples_shade_by_the_documented_steps(fog: Fog | None, data: Dataset, tmp_path: Path) -> None:
    """The block of docs/export.md that says what depth and fog mean, against what the model measures."""
    model = replace(ddprt.fit(data, bases=2), fog=fog)
    export_textures(model, tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["depth"] == model.samples.depth > 0
    assert any("depth" in line for line in manifest["decode"])
    assert any("fog" in line for line in manifest["decode"]) == ("fog" in manifest) == (fog is not None)
    if fog is not None:
        box = {"low": model.occluders.min((0, 1)).tolist(), "high": model.occluders.max((0, 1)).tolist()}
        assert manifest["fog"] == {**fog.record, **box}
    block = re.search(r"```python\n(def shade.*?)```", DOCS.read_text(), re.DOTALL)
    assert block, "docs/export.md does not say how to shade"
    scope: dict = {"json": json, "np": np, "Path": Path}
    exec(block[1], scope)
    for index in (0, 1):
        (lamp,) = data.lightings[index]
        place = np.array(lamp.position)
        # Visible is what has light on the surface: shadow rays are the engine's.
        visible = measure(Tracer(model.occluders), (lamp,), model.samples.position, model.samples.normal, seed=0).any(1)
        got = scope["shade"](tmp_path, place, np.array(lamp.intensity), visible)
        expected = model.measure(lamp)
        # float32 against float64, as in the twin (at most 10 u of three times the light that would fall straight on), and
        # samples that are lifted off the surface: E moves by at most 3 of its share offset / distance.
        distance = np.linalg.norm(place - model.samples.position + model.samples.depth * model.samples.normal, axis=1)
        straight = 3 * max(lamp.intensity) / distance**2
        slack = 12 * U32 + 8 * float(Tracer(model.occluders).offset) / distance
        bound = np.zeros(32)
        np.maximum.at(bound, model.samples.nearest_point(32), straight * slack)
        assert over_bound(np.abs(got - expected).max(1), bound + 64 * U32 * expected.max(1)) <= 1
        assert expected.max() > 100 * bound.max()
