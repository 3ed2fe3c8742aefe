"""Sheets of two sides: both are lit and reflect, closed bodies have none, backs of all others absorb."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import ddprt
from ddprt.config import checked as configured
from ddprt.lights import parse_lighting
from ddprt.scene.checks import checked
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted, rectangle
from ddprt.scene.sheets import backs, without_backs
from ddprt.transport.effects import force, plan
from ddprt.transport.embree import Tracer

ALBEDO = 0.5


def sheet_between_plates(two_sided: bool, distance: float = 1.0) -> Scene:
    """A black plate below, a sheet, and a black plate above; unit squares."""
    quads = [
        rectangle((0.0, 0.0), (1.0, 1.0), at, 1, facing=facing) for at, facing in ((0.0, 1), (distance, 1), (2 * distance, -1))
    ]
    materials = Material("black", (0.0,) * 3), Material("sheet", (ALBEDO,) * 3, two_sided=two_sided)
    return faceted("sandwich", np.array(quads), materials, np.array([0, 1, 0]))


def facing_squares(size: float, distance: float) -> float:
    """Form factor of equal squares that face each other (Hottel); X = Y = size / distance."""
    x = size / distance
    root = np.sqrt(1 + x * x)
    total = np.log((1 + x * x) / np.sqrt(1 + 2 * x * x)) + 2 * x * root * np.arctan(x / root) - 2 * x * np.arctan(x)
    return float(2 / (np.pi * x * x) * total)


def bounced(scene: Scene, light: dict[str, Any], plate: float, normal: float) -> NDArray[np.float64]:
    """Indirect irradiance at a lattice on one of the plates, with its deviation, channel 0."""
    line = (np.arange(24) + 0.5) / 24
    x, z = np.meshgrid(line, line)
    places = np.stack([x.ravel(), np.full(x.size, plate), z.ravel()], 1)
    normals = np.tile([0.0, normal, 0], (len(places), 1))
    found = ddprt.irradiance(scene, light, places, normals, samples=256, seed=1, return_variance=True)
    return np.array([found[1][:, 0].mean(), np.sqrt(found[3][:, 0].sum()) / len(places)])


@pytest.mark.parametrize("from_above", [True, False])
def test_either_side_of_a_sheet_reflects_to_its_plate(from_above: bool) -> None:
    """The sun shines through one plate's place on to the sheet: that plate gets albedo E F by one bounce, the other nothing."""
    scene = sheet_between_plates(True)
    sun = {"type": "directional", "direction": [0, -1 if from_above else 1, 0], "irradiance": [2.0, 2.0, 2.0]}
    # The plate on the sun's side would shade the sheet: its place is measured without it.
    height = scene.corners[..., 1].mean(1)
    keep = height < 1.5 if from_above else height > 0.5
    lit = replace(scene, triangles=scene.triangles[keep], material=scene.material[keep])
    above, below = bounced(lit, sun, 2.0, -1), bounced(lit, sun, 0.0, 1)
    expected = ALBEDO * 2.0 * facing_squares(1, 1)
    bright, dark = (above, below) if from_above else (below, above)
    # A lattice of 24 x 24 midpoints is off by 1/24 of the second derivative's share, below 2e-3 of the mean; 4 deviations.
    assert abs(bright[0] - expected) < 4 * bright[1] + 2e-3 * expected
    assert dark[0] == 0
    if not from_above:  # a one-sided sheet absorbs at its back
        assert bounced(without_backs(lit), sun, 0.0, 1)[0] == 0


def test_a_furnace_cut_in_half_by_a_sheet_is_two_furnaces() -> None:
    """A box halved by a two-sided sheet of the same albedo: each half is closed, and its mean F/A and F/A a/(1-a)."""
    walls = box(np.zeros(3), np.array([1.0, 2.0, 1.0]))[:, ::-1]
    quads = np.concatenate([walls, [rectangle((0.0, 0.0), (1.0, 1.0), 1.0, 1, facing=1)]])
    materials = Material("wall", (ALBEDO,) * 3), Material("sheet", (ALBEDO,) * 3, two_sided=True)
    scene = faceted("halves", quads, materials, np.repeat([0, 1], [6, 1]))
    config = configured(
        {
            "atlas": {"resolution": 96},
            "transport": {"samples": 32, "test_samples": 32, "direct_samples": 16, "threads": 2},
            "points": {"count": 16},
        }
    )
    for height in (0.5, 1.5):
        lamp = parse_lighting({"type": "point", "position": [0.5, height, 0.5], "intensity": [1.0] * 3})
        data = ddprt.bake(scene, {split: [lamp] for split in ("train", "validation", "test")}, config=config)
        normal, position = data.gbuffer["geometric_normal"][:, 1], data.gbuffer["position"][:, 1]
        on_sheet = (np.abs(position - 1) < 1e-5) & (np.abs(normal) > 0.5)
        low = np.where(on_sheet, normal < 0, position < 1)
        lit = low == (height < 1)
        light, bounce = (data.maps(kind, [0])[0][:, 0].astype(float) for kind in ("direct", "indirect"))
        # A texel that the sheet's rim crosses keeps the larger side: along 4 m of wall up to half a texel is lost, where E is
        # 0.5 / 0.5^1.5 = 1.41 W/m² and what is bounced twice the mean of direct light, 2.1, at most.
        lost = 4 * 0.5 * float(np.sqrt((data.gbuffer["area"] / data.gbuffer["coverage"]).mean()))
        assert data.area[lit].sum() == pytest.approx(6.0, abs=lost)
        assert light[~lit].sum() < 2e-3 * light.sum()  # texels along the rim, by their middles, lie on either side
        # Of 16 places in each of some 3000 texels E varies by 0.3; of what is bounced the noise is below 5e-3.
        assert light @ data.area == pytest.approx(4 * np.pi, abs=1.41 * lost + 0.02)
        assert bounce @ data.area == pytest.approx(4 * np.pi * ALBEDO / (1 - ALBEDO), abs=2.1 * 2 * lost + 0.06)
        assert bounce[~lit] @ data.area[~lit] < 5e-3 * (bounce @ data.area)


def test_closed_bodies_get_no_backs() -> None:
    paper = Material("paper", (0.5,) * 3, two_sided=True)
    cube = faceted("cube", box(np.zeros(3), np.ones(3)), (paper,))
    assert len(cube.triangles) == 12
    assert not backs(cube).any()
    assert not any(effect.called for effect in plan(cube, []).effects if effect.name == "two-sided sheets")
    open_box = faceted("open", box(np.zeros(3), np.ones(3))[:5], (paper,))
    assert len(open_box.triangles) == 20
    assert backs(open_box).sum() == 10
    both = np.concatenate([box(np.zeros(3), np.ones(3)), [rectangle((3.0, 3.0), (4.0, 4.0), 3.0, 1, facing=1)]])
    mixed = faceted("mixed", both, (paper,))
    assert backs(mixed).sum() == 2
    assert np.abs(mixed.corners[backs(mixed)] - 3.5).max() < 1


def test_backs_face_the_other_way_and_can_be_left_out() -> None:
    scene = sheet_between_plates(True)
    back = backs(scene)
    np.testing.assert_array_equal(scene.geometric_normals[back], np.tile([0.0, -1, 0], (2, 1)))
    effect = next(effect for effect in plan(scene, []).effects if effect.name == "two-sided sheets")
    assert effect.called
    assert '"sheet": 2 triangles' in effect.why
    off = force(scene, off=["two-sided sheets"])
    told = next(effect for effect in plan(off, []).effects if effect.name == "two-sided sheets")
    assert (told.called, told.forced) == (False, True)
    one_sided = sheet_between_plates(False)
    np.testing.assert_array_equal(off.corners, one_sided.corners)
    np.testing.assert_array_equal(off.normals, one_sided.normals)
    np.testing.assert_array_equal(off.material, one_sided.material)
    assert off.digest == one_sided.digest
    assert without_backs(one_sided) is one_sided
    hits = Tracer.of(off).closest(np.array([[0, -0.5, 0]], np.float32), np.array([[0, 1, 0]], np.float32))
    assert not hits.front[0]  # it still blocks


def test_backs_keep_textures_and_shading_normals() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    texture = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)
    tilted = np.tile([0.0, 0.6, 0.8], (4, 1))
    material = Material("m", (1.0,) * 3, texture, two_sided=True)
    scene = checked("m", square, np.array([[0, 1, 2], [0, 2, 3]]), normals=tilted, uv=square[:, :2], materials=(material,))
    weights = np.random.default_rng(1).dirichlet(np.ones(3), 20)
    place = np.einsum("nc,cd->nd", weights, scene.corners[0])
    behind = scene.corners[2]
    solved = np.linalg.lstsq(np.vstack([behind.T, np.ones(3)]), np.vstack([place.T, np.ones(20)]), rcond=None)[0].T
    front, back = scene.albedo_at(np.zeros(20, int), weights), scene.albedo_at(np.full(20, 2), solved)
    np.testing.assert_allclose(front, back, atol=1e-9)
    np.testing.assert_array_equal(scene.normals[scene.triangles[2]], -tilted[:3])
    one = without_backs(scene)
    np.testing.assert_array_equal(one.uv, square[:, :2])
    np.testing.assert_array_equal(one.positions, square)
