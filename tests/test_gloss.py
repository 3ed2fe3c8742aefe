"""Glossy surfaces as senders and carriers of light: closed forms, both integrators, and what scenes without them pay."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ddprt
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.lights import Lighting, parse_lighting
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.library import build
from ddprt.scene.material import Gloss
from ddprt.scene.mesh import Scene
from ddprt.transport import ggx, gloss
from ddprt.transport.direct import Texels
from ddprt.transport.effects import Effect, force, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import GRAZING, glossy, scattering, valid_integrator
from ddprt.transport.paths import trace_paths
from ddprt.transport.reference import on_texels, trace_reference

CENTRE = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]})
LAMP = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})
SUN = parse_lighting({"type": "directional", "direction": [0.1, -0.4, 1], "irradiance": [0.5, 1, 2]})
PANEL = parse_lighting(
    {"type": "rect", "center": [0.3, 0.5, 0.3], "half_u": [0.1, 0, 0], "half_v": [0, 0, 0.1], "radiance": [20, 30, 10]}
)
BATCH = [LAMP, SUN, PANEL]


def traced(scene: Scene, atlas: Atlas, lightings: list[Lighting], samples: int, **settings: Any) -> np.ndarray:
    """Indirect irradiance (lightings, texels, rgb)."""
    out = np.full((len(lightings), atlas.count, 3), np.nan, np.float32)
    tracer = Tracer.of(scene, settings.pop("threads", 2))
    settings = {"seed": 0, "stream": "test", **settings}
    assert sum(trace_paths(tracer, scene, atlas, lightings, out, samples=samples, **settings)) == atlas.count
    return out


def mean(atlas: Atlas, values: np.ndarray) -> np.ndarray:
    """Area-weighted mean of the texels, which come last but one."""
    return np.einsum("t,...tc->...c", atlas.area / atlas.area.sum(), values)


def by_reference(scene: Scene, atlas: Atlas, lighting: Lighting, samples: int, seed: int, bounces: int = -1) -> np.ndarray:
    tracer = Tracer.of(scene, 2)
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    found = trace_reference(tracer, scene, lighting, start, atlas.count, samples, seed=seed, bounces=bounces)
    return mean(atlas, found.indirect)


def coated(scene: Scene, part: Gloss | None) -> Scene:
    return scene.made_of(lambda material: replace(material, gloss=part))


def entry(scene: Scene) -> Effect:
    return next(effect for effect in plan(scene, [LAMP]).effects if effect.name == "gloss")


@pytest.fixture(scope="module")
def room() -> Scene:
    return build("glossy-room")


@pytest.fixture(scope="module")
def room_atlas(room: Scene) -> Atlas:
    return build_atlas(room, 48)


# --- closed forms -----------------------------------------------------------------------------------------------------


def arrivals(base: float, part: Gloss) -> float:
    """How often light from the centre of a glossy sphere arrives at its wall, after the first time.

    Chords leave and arrive at the same angle, so the cosine of a path is a Markov chain: N(i) = integral over o of
    f(i, o) cos (1 + N(o)), solved at Gauss nodes.
    """
    x, weight = np.polynomial.legendre.leggauss(64)
    tilt, turn = (x + 1) / 2, 2 * np.pi * (np.arange(256) + 0.5) / 256
    tilts = np.append(tilt, 1.0)
    i, o, phi = (grid.ravel() for grid in np.meshgrid(tilts, tilt, turn, indexing="ij"))
    flat = np.sqrt(1 - i**2)
    arriving = np.stack([flat, np.zeros_like(flat), i], 1)
    leaving = np.stack([np.sqrt(1 - o**2) * np.cos(phi), np.sqrt(1 - o**2) * np.sin(phi), o], 1)
    finish = np.tile([part.roughness, part.metallic, part.dielectric], (len(i), 1))
    value = ggx.evaluate(arriving, leaving, np.full((len(i), 3), base), finish)[:, 0].astype(np.float64)
    kernel = value.reshape(65, 64, 256).mean(2) * 2 * np.pi * weight / 2
    later = np.linalg.solve(np.eye(64) - kernel[:64], kernel[:64].sum(1))
    return float(kernel[64] @ (1 + later))


@pytest.mark.parametrize(
    ("base", "part"),
    [
        (1.0, Gloss(0.7, 1.0)),
        (0.7, Gloss(0.5, 0.0)),
        pytest.param(0.7, Gloss(0.5, 1.0), marks=pytest.mark.slow),
        pytest.param(0.8, Gloss(0.6, 0.5), marks=pytest.mark.slow),
    ],
)
def test_furnace(base: float, part: Gloss) -> None:
    """A closed sphere of any finish: of white metal, light dies away by the stated loss alone."""
    scene = force(coated(build("furnace", albedo=base, subdivisions=3), part), on=["gloss"])
    atlas = build_atlas(scene, 32)
    expected = 4 * np.pi / scene.areas.sum() * arrivals(base, part)
    runs = np.array([mean(atlas, traced(scene, atlas, [CENTRE], 24, stream=f"{k}")[0])[0] for k in range(8)])
    reference = np.array([by_reference(scene, atlas, CENTRE, 32, k)[0] for k in range(6)])
    for found in (runs, reference):
        error = found.std(ddof=1) / np.sqrt(len(found))
        assert error < 0.008 * expected
        # t with 5 or 7 degrees of freedom. Facets turn normals by up to 0.07, which changes it by some 0.07².
        assert abs(found.mean() - expected) < 6 * error + 0.005 * expected


@pytest.mark.parametrize("bounces", [1, 2])
def test_forced_bounces(bounces: int, room: Scene, room_atlas: Atlas) -> None:
    """What bounces are counted is the same for both integrators, and each adds light."""
    ours = np.array(
        [mean(room_atlas, traced(room, room_atlas, [PANEL], 32, stream=f"{k}", bounces=bounces)[0]) for k in range(4)]
    )
    theirs = np.array([by_reference(room, room_atlas, PANEL, 64, k, bounces) for k in range(4)])
    error = np.sqrt(ours.var(0, ddof=1) / 4 + theirs.var(0, ddof=1) / 4)
    assert (np.abs(ours.mean(0) - theirs.mean(0)) < 6 * error).all()  # t with 6 degrees of freedom, three times
    assert (error < 0.03 * theirs.mean(0)).all()


# --- the two integrators ----------------------------------------------------------------------------------------------


def test_paths_agree_with_the_reference(room: Scene, room_atlas: Atlas) -> None:
    """Texel by texel: z-scores of unbiased paths against independent ones, both variances counted."""
    runs = np.array([traced(room, room_atlas, BATCH, 48, stream=f"{k}") for k in range(12)], np.float64)
    tracer, chosen = Tracer.of(room, 2), np.arange(0, room_atlas.count, 4)
    for index, lighting in enumerate(BATCH):
        start = on_texels(tracer, room_atlas, chosen)
        theirs = trace_reference(tracer, room, lighting, start, len(chosen), 576, seed=index)
        ours, spread = runs[:, index, chosen, 1].mean(0), runs[:, index, chosen, 1].var(0, ddof=1) / 12
        lit = spread + theirs.indirect_variance[:, 1] > 0  # below the blocks nothing is
        z = (ours - theirs.indirect[:, 1])[lit] / np.sqrt(spread + theirs.indirect_variance[:, 1])[lit]
        print(f"{index}: {len(z)} texels, z {z.mean():+.3f} +- {z.std():.3f}")
        # Texels share directions among the paths of one run, so their scores are not independent: a few times 1 / sqrt(n).
        assert abs(z.mean()) < 0.3
        assert abs(z.std() - 1) < 0.2
        total = np.array([by_reference(room, room_atlas, lighting, 24, k) for k in range(4)])
        found = mean(room_atlas, runs[:, index])
        error = np.sqrt(found.var(0, ddof=1) / 12 + total.var(0, ddof=1) / 4)
        assert (np.abs(found.mean(0) - total.mean(0)) < 6 * error).all()


def test_bits_do_not_depend_on_threads(room: Scene, room_atlas: Atlas) -> None:
    one, two = (traced(room, room_atlas, BATCH, 16, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(traced(room, room_atlas, BATCH[1:2], 16)[0], one[1])  # and not on the batch


def test_textures_are_factors(room: Scene, room_atlas: Atlas) -> None:
    """A texture of 0.5 and 0.8 on roughness and metallic gives the bits of a material that has the products."""
    uv = np.random.default_rng(0).random((len(room.positions), 2))
    image = np.tile(np.array([0.5, 0.75], np.float32), (4, 4, 1))
    textured = replace(coated_vase(room, Gloss(0.5, 1.0, texture=image)), uv=uv)
    plain = replace(coated_vase(room, Gloss(0.25, 0.75)), uv=uv)
    ours, theirs = (traced(scene, room_atlas, [PANEL], 8) for scene in (textured, plain))
    np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_allclose(
        build_atlas(scattering(textured), 32).albedo, build_atlas(scattering(plain), 32).albedo, rtol=1e-6
    )


def coated_vase(room: Scene, part: Gloss | None) -> Scene:
    return room.made_of(lambda material: replace(material, gloss=part) if material.gloss else material)


# --- only what is hit pays --------------------------------------------------------------------------------------------


def test_only_rays_that_hit_the_vase_pay(room: Scene, room_atlas: Atlas, monkeypatch: pytest.MonkeyPatch) -> None:
    """Diffuse vertices are those that they would be without gloss, and no others meet the lobes."""
    seen: list[tuple[int, int]] = []
    met = gloss.Surfaces.met

    def counted(self: gloss.Surfaces, triangle: np.ndarray, *rest: np.ndarray) -> Any:
        others, found = met(self, triangle, *rest)
        hit = self.shiny[triangle] & (triangle >= 0)
        assert (others[~hit] == triangle[~hit]).all()
        assert (others[hit] == -1).all()
        seen.append((int(hit.sum()), 0 if found is None else len(found.owner)))
        return others, found

    monkeypatch.setattr(gloss.Surfaces, "met", counted)
    traced(room, room_atlas, [LAMP], 8, threads=1)
    hits, carried = np.sum(seen, 0)
    assert 0.9 * hits < carried <= hits  # the floor below it sees the vase from within, through its open bottom


def test_a_diffuse_scene_imports_and_changes_nothing() -> None:
    """With both files made to raise on import, the Cornell box gives the same bits: it never asks for them."""
    code = """
import hashlib, sys
import numpy as np
if len(sys.argv) > 1:
    sys.modules["ddprt.transport.gloss"] = sys.modules["ddprt.transport.ggx"] = None
from ddprt.lights import parse_lighting
from ddprt.scene.atlas import build_atlas
from ddprt.scene.library import build
from ddprt.transport.effects import force, plan
from ddprt.transport.glossiness import glossy_surfaces, scattering
from ddprt.transport.embree import Tracer
from ddprt.transport.paths import trace_paths
from ddprt.transport.reference import on_texels, trace_reference
lamp = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})
scene, off = build("cornell"), force(build("glossy-room"), off=["gloss"])
atlas, tracer = build_atlas(scene, 24), Tracer.of(scene, 1)
out = np.zeros((1, atlas.count, 3), np.float32)
list(trace_paths(tracer, scene, atlas, [lamp], out, samples=8, seed=0, stream="a"))
found = trace_reference(tracer, scene, lamp, on_texels(tracer, atlas, np.arange(9)), 9, 8, seed=0)
plan(scene, [lamp]), plan(off, [lamp])
assert glossy_surfaces(tracer, off) is None and scattering(off) is off
print(hashlib.sha256(out.tobytes() + found.indirect.tobytes()).hexdigest(), tracer.rays)
"""
    runs = [
        subprocess.run([sys.executable, "-c", code, *more], capture_output=True, text=True, check=True) for more in ([], ["x"])
    ]
    assert runs[0].stdout == runs[1].stdout
    assert len(runs[0].stdout.split()) == 2


def test_forced_off_scatters_the_base_colour(room: Scene, room_atlas: Atlas) -> None:
    off, diffuse = force(room, off=["gloss"]), coated_vase(room, None)
    np.testing.assert_array_equal(*(traced(scene, room_atlas, [LAMP], 8) for scene in (off, diffuse)))
    assert (traced(room, room_atlas, [LAMP], 8) != traced(off, room_atlas, [LAMP], 8)).any()


# --- the plan ---------------------------------------------------------------------------------------------------------


def test_the_plan(room: Scene, cornell: Scene) -> None:
    assert entry(room) == Effect("gloss", True, 'material "gilt"', 0.0)
    assert entry(cornell) == Effect("gloss", False, "no material has any", 0.0)
    off = entry(force(room, off=["gloss"]))
    assert (off.called, off.forced, off.bound) == (False, True, None)
    for roughness, dielectric, called in ((0.31, 0.04, True), (0.32, 0.04, False), (0.32, 0.05, True), (0.0, 0.0, False)):
        scene = coated_vase(room, Gloss(roughness, 0.0, dielectric))
        assert entry(scene).called == called
        assert glossy(scene) == (False, False, False, called)
        assert glossy(force(scene, on=["gloss"])) == (False, False, False, True)
    rough = coated_vase(room, Gloss(0.8, 0.0))
    effect = entry(rough)
    assert "too rough" in effect.why
    share = 0.04 + 0.96 * 0.075
    assert effect.bound == pytest.approx(share / ((1 - 0.9) * (1 - share)))
    forced = entry(force(rough, on=["gloss"]))
    assert (forced.called, forced.forced, forced.bound) == (True, True, 0.0)


def test_part_of_a_scene_may_gloss(room: Scene) -> None:
    """Walls of rough plastic stay diffuse beside a metal vase, and the plan says what their lobes could have added."""
    mixed = room.made_of(lambda material: material if material.gloss else replace(material, gloss=Gloss(0.6, 0.0)))
    assert glossy(mixed) == (False, False, False, True)
    effect = entry(mixed)
    assert effect.called
    assert effect.bound is not None
    assert effect.bound > 0


def test_albedos_of_lobes_stay_below_their_bound() -> None:
    tilts = np.linspace(0, 1, 1001)
    for step, bound in enumerate(GRAZING):
        found = ggx.albedo(tilts, step / 10, 0.0).max()
        # The table's own error is 0.002; the bound is of use only where it is near.
        assert found + 0.002 < bound or bound == 1
        assert bound < 1.1 * found + 0.01


def test_the_bound_holds(cornell: Scene, cornell_atlas: Atlas) -> None:
    """Everything of rough plastic: what lobes add to the mean is below what the plan says, and not nothing."""
    scene = coated(cornell, Gloss(0.6, 0.0))
    bound = entry(scene).bound
    forced = force(scene, on=["gloss"])
    direct = Texels.of(Tracer.of(scene), cornell_atlas, 4, np.random.default_rng(0))
    lit = mean(cornell_atlas, direct.irradiance(LAMP, np.random.default_rng(1)))
    with_lobes, without = (
        np.mean([mean(cornell_atlas, traced(s, cornell_atlas, [LAMP], 32, stream=f"{k}")[0]) for k in range(4)], 0)
        for s in (forced, scene)
    )
    added = (with_lobes - without) / lit
    assert bound is not None
    assert (added > 0.002).all()
    assert (added < bound).all()


def test_a_black_room_may_still_gloss(room: Scene) -> None:
    """Black plastic sends light on: the plan follows bounces though no albedo asks for them."""
    black = room.made_of(lambda material: replace(material, albedo=(0.0, 0.0, 0.0)))
    assert plan(black, [LAMP]).bounces == -1
    assert plan(coated_vase(black, None), [LAMP]).bounces == 0


# --- in a bake --------------------------------------------------------------------------------------------------------


def job(**transport: Any) -> Config:
    return Config.model_validate(
        {
            "atlas": {"resolution": 32},
            "lightings": {"train": 3, "validation": 1, "test": 1, "clearance": 0.1},
            "points": {"count": 32, "supersample": 2},
            "transport": {"samples": 16, "test_samples": 32, **transport},
        }
    )


def test_auto_chooses_paths(room: Scene, cornell: Scene, tmp_path: Path) -> None:
    data = ddprt.bake(room, config=job(), out=tmp_path / "gloss")
    assert data.description["transport"]["integrator"] == "paths"
    albedo = data.gbuffer["albedo"]
    assert (albedo.max(1) == 0).any(), "a metal scatters nothing"
    assert valid_integrator("auto", cornell) == "operator"
    assert valid_integrator("auto", force(room, off=["gloss"])) == "operator"
    assert valid_integrator("reference", room) == "reference"


def test_the_operator_is_refused(room: Scene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r'transport.integrator: got "operator".*material "gilt".*expected "auto"'):
        ddprt.bake(room, config=job(integrator="operator"), out=tmp_path / "operator")
    off = ddprt.bake(force(room, off=["gloss"]), config=job(integrator="operator"), out=tmp_path / "off")
    assert off.description["transport"]["integrator"] == "operator"
