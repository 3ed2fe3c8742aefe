"""Paths shared by all lightings: unbiased, addressed, resumable."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import ddprt
from ddprt.config import Config
from ddprt.lights import Lighting, parse_lighting
from ddprt.report.evaluate import evaluate
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, icosphere, rectangle
from ddprt.transport import shading
from ddprt.transport.embree import Tracer
from ddprt.transport.paths import choose_samples, trace_paths
from ddprt.transport.reference import Estimate, on_texels, trace_reference

CENTRE = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]})
LAMP = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})
SPOT = parse_lighting(
    {"type": "spot", "position": [0.4, 0.5, 0.1], "direction": [-0.5, -1, 0.7], "intensity": [2, 1, 0.5], "outer_deg": 40}
)
SUN = parse_lighting({"type": "directional", "direction": [0.1, -0.4, 1], "irradiance": [0.5, 1, 2]})
PANEL = parse_lighting(
    {"type": "rect", "center": [0.3, 0.5, 0.3], "half_u": [0.1, 0, 0], "half_v": [0, 0, 0.1], "radiance": [20, 30, 10]}
)
BALL = parse_lighting({"type": "sphere", "center": [0.4, 0.42, 0.15], "radius": 0.05, "radiance": [9, 30, 50]})
BATCH = [LAMP, SPOT, SUN, PANEL, BALL]


def traced(scene: Scene, atlas: Atlas, lightings: list[Lighting], samples: int, **settings: Any) -> np.ndarray:
    """Indirect irradiance (lightings, texels, rgb)."""
    out = settings.pop("out", None)
    out = np.full((len(lightings), atlas.count, 3), np.nan, np.float32) if out is None else out
    settings = {"seed": 0, "stream": "test", **settings}
    tracer = Tracer.of(scene, settings.pop("threads", 0))
    done = sum(trace_paths(tracer, scene, atlas, lightings, out, samples=samples, **settings))
    assert done == (atlas.count if settings.get("texels") is None else len(settings["texels"]))
    return out


def reference(scene: Scene, atlas: Atlas, lighting: Lighting, samples: int, seed: int, bounces: int = -1) -> Estimate:
    tracer = Tracer.of(scene)
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    return trace_reference(tracer, scene, lighting, start, atlas.count, samples, seed=seed, bounces=bounces)


def mean(atlas: Any, values: np.ndarray) -> np.ndarray:
    """Area-weighted mean of the texels, which come last but one."""
    return np.einsum("t,...tc->...c", atlas.area / atlas.area.sum(), values)


def agree(atlas: Atlas, ours: np.ndarray, found: np.ndarray) -> None:
    """Means of runs (runs, texels, rgb) of either kind are the same, by their own scatter, for each channel."""
    one, two = mean(atlas, ours), mean(atlas, found)
    error = np.sqrt(one.var(0, ddof=1) / len(one) + two.var(0, ddof=1) / len(two))
    assert (error < 0.01 * two.mean(0)).all()
    # Three t-values with some 12 degrees of freedom.
    assert (np.abs(one.mean(0) - two.mean(0)) < 5 * error).all()


@pytest.fixture(scope="module")
def bare(cornell: Scene) -> Scene:
    """The Cornell box without its blocks."""
    walls = [*range(8), 28, 29]
    return checked(
        "bare", cornell.positions, cornell.triangles[walls], material=cornell.material[walls], materials=cornell.materials
    )


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("albedo", "samples"),
    [(0.0, 8), pytest.param(0.2, 64, marks=pytest.mark.slow), (0.5, 128), pytest.param(0.9, 48, marks=pytest.mark.slow)],
)
def test_furnace(albedo: float, samples: int) -> None:
    """A closed uniform mesh: mean indirect F / A * a / (1 - a), whatever its facets."""
    scene = build("furnace", albedo=albedo, subdivisions=3)
    atlas = build_atlas(scene, 64)
    runs = np.array([mean(atlas, traced(scene, atlas, [CENTRE], samples, stream=f"{k}")[0])[0] for k in range(8)])
    expected = 4 * np.pi / scene.areas.sum() * albedo / (1 - albedo)
    if albedo == 0:
        assert not runs.any()
        return
    error = runs.std(ddof=1) / np.sqrt(8)
    assert 0 < error < 0.002 * expected
    # Origins stand 7e-6 of the radius nearer to the lamp: direct light is 1.4e-5 too high. t with 7 degrees of freedom.
    assert abs(runs.mean() - expected) < 6 * error + 2e-5 * expected


@pytest.mark.parametrize("bounces", [1, 2, 5])
def test_forced_bounces_of_the_furnace(bounces: int) -> None:
    scene = build("furnace", albedo=0.9, subdivisions=3)
    atlas = build_atlas(scene, 64)
    runs = np.array([mean(atlas, traced(scene, atlas, [CENTRE], 64, stream=f"{k}", bounces=bounces)[0])[0] for k in range(8)])
    expected = 4 * np.pi / scene.areas.sum() * sum(0.9**k for k in range(1, bounces + 1))
    error = runs.std(ddof=1) / np.sqrt(8)
    assert error < 0.002 * expected
    assert abs(runs.mean() - expected) < 6 * error + 2e-5 * expected


def test_colours_of_the_furnace_do_not_mix() -> None:
    """Each channel has its own albedo; the brightest decides how long a path lives, and must not weigh the others."""
    points, triangles = icosphere(2)
    albedo = np.array([0.8, 0.0, 0.4])
    scene = checked("room", points, triangles[:, ::-1], materials=(Material("magenta", tuple(albedo.tolist())),))
    atlas = build_atlas(scene, 64)
    lamp = tuple(light.scaled(2.0) for light in CENTRE)
    runs = np.array([mean(atlas, traced(scene, atlas, [lamp], 64, stream=f"{k}")[0]) for k in range(8)])
    expected = 8 * np.pi / scene.areas.sum() * albedo / (1 - albedo)
    error = runs.std(0, ddof=1) / np.sqrt(8)
    assert not runs[:, 1].any()
    assert (error < 0.002 * expected + 1e-30).all()
    assert (np.abs(runs.mean(0) - expected) <= 6 * error + 2e-5 * expected).all()


# --- against the reference --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cornell", *(pytest.param(name, marks=pytest.mark.slow) for name in ("bare", "corridor"))])
def test_agrees_with_the_reference_texel_by_texel(name: str, request: pytest.FixtureRequest) -> None:
    scene = request.getfixturevalue(name)
    atlas = build_atlas(scene, 64)
    lamp = parse_lighting({"type": "point", "position": [1, 1.5, 1], "intensity": [1, 1, 1]}) if name == "corridor" else LAMP
    # Path sums are skewed: a low mean comes with a low variance, which would shift z. So the variances are other runs'.
    found, other = (reference(scene, atlas, lamp, 400, seed) for seed in (2, 3))
    runs = np.array([traced(scene, atlas, [lamp], 64, stream=f"run {k}")[0] for k in range(16)], np.float64)
    ours, variance = runs[:6].mean(0), runs[6:].var(0, ddof=1) / 6
    # Hardly any path leads to light from behind the door, or from the rim of what lies under a block: far from normal.
    lit = (runs.mean(0) > 0.1 * np.median(runs.mean(0), axis=0)).all(1)
    assert lit.mean() > 0.9
    z = (ours - found.indirect)[lit] / np.sqrt(variance + other.indirect_variance)[lit]
    assert (np.abs(z.mean(0)) < 0.08).all()  # 2000 texels: 0.02 of noise
    assert (np.abs(z.std(0) - 1) < 0.1).all()
    expected = mean(atlas, found.indirect)
    error = np.sqrt((atlas.area / atlas.area.sum()) ** 2 @ (found.indirect_variance + variance))
    assert (error < 0.005 * expected).all()
    assert (np.abs(mean(atlas, ours) - expected) < 5 * error).all()


def test_every_kind_of_light_agrees_with_the_reference(cornell: Scene, cornell_atlas: Atlas) -> None:
    ours = np.array([traced(cornell, cornell_atlas, BATCH, 32, stream=f"{k}") for k in range(8)])
    for index, lighting in enumerate(BATCH):
        found = np.array([reference(cornell, cornell_atlas, lighting, 48, seed).indirect for seed in range(8)])
        agree(cornell_atlas, ours[:, index], found)


def test_one_bounce_agrees_with_the_reference(cornell: Scene, cornell_atlas: Atlas) -> None:
    ours = np.array([traced(cornell, cornell_atlas, [LAMP], 32, stream=f"{k}", bounces=1)[0] for k in range(8)])
    found = np.array([reference(cornell, cornell_atlas, LAMP, 64, seed, bounces=1).indirect for seed in range(8)])
    agree(cornell_atlas, ours, found)
    assert (mean(cornell_atlas, ours).mean(0) < 0.9 * mean(cornell_atlas, traced(cornell, cornell_atlas, [LAMP], 32)[0])).all()


def test_textures_colour_the_light() -> None:
    """A furnace whose texture is one texel, half as bright as the material: albedo is their product."""
    points, triangles = icosphere(2)
    material = Material("papered", (0.8, 0.6, 0.4), np.full((1, 1, 3), 0.5, np.float32))
    scene = checked("papered", points, triangles[:, ::-1], uv=points[:, :2], materials=(material,))
    atlas = build_atlas(scene, 64)
    ours = mean(atlas, traced(scene, atlas, [CENTRE], 256)[0])
    albedo = np.array([0.4, 0.3, 0.2])
    np.testing.assert_allclose(ours, 4 * np.pi / scene.areas.sum() * albedo / (1 - albedo), rtol=0.002)


def test_backs_absorb() -> None:
    """A sheet lit from above, with its back to the floor beneath it: the floor gets nothing, the sheet neither."""
    floor, sheet = (rectangle((0.0, 0.0), (1.0, 1.0), at, 1, facing=1) for at in (0.0, 0.5))
    scene = faceted("table", np.array([floor, sheet]), (Material("white", (0.9,) * 3),))
    atlas = build_atlas(scene, 32)
    above = parse_lighting({"type": "point", "position": [0.5, 1, 0.5], "intensity": [1, 1, 1]})
    below = parse_lighting({"type": "point", "position": [0.5, 0.25, 0.5], "intensity": [1, 1, 1]})
    tracer = Tracer.of(scene)
    assert not traced(scene, atlas, [above, below], 32).any()
    flipped = faceted("shelf", np.array([floor, sheet[::-1]]), scene.materials)
    assert traced(flipped, build_atlas(flipped, 32), [below], 32).any(), "the other way round there is something to see"
    assert tracer.rays == 0


# --- laws -------------------------------------------------------------------------------------------------------------


def test_lights_of_a_lighting_add_up(cornell: Scene, cornell_atlas: Atlas) -> None:
    """The same paths and numbers for all: only the order of float64 sums differs, and float32 at the end."""
    together = tuple(light for lighting in BATCH for light in lighting)
    found = traced(cornell, cornell_atlas, [*BATCH, together], 24).astype(np.float64)
    np.testing.assert_allclose(found[-1], found[:-1].sum(0), rtol=5e-7)
    assert (mean(cornell_atlas, found) > 0).all()


def test_twice_the_light_is_twice_the_result(cornell: Scene, cornell_atlas: Atlas) -> None:
    twice = [tuple(light.scaled(2.0) for light in lighting) for lighting in BATCH]
    once = traced(cornell, cornell_atlas, BATCH, 16)
    np.testing.assert_array_equal(traced(cornell, cornell_atlas, twice, 16), 2 * once)


def test_no_light_gives_exactly_nothing(cornell: Scene, cornell_atlas: Atlas) -> None:
    dark = tuple(light.scaled(0.0) for light in LAMP)
    away = parse_lighting({"type": "spot", "position": [0.28, 0.5, -5], "direction": [0, 0, -1], "intensity": [1, 1, 1]})
    found = traced(cornell, cornell_atlas, [dark, away, LAMP], 8)
    assert not found[:2].any()
    assert found[2].any()


def test_bits_depend_on_nothing_but_the_address(cornell: Scene, cornell_atlas: Atlas) -> None:
    whole = traced(cornell, cornell_atlas, BATCH, 40, threads=1)
    np.testing.assert_array_equal(traced(cornell, cornell_atlas, BATCH, 40, threads=3), whole)
    alone = traced(cornell, cornell_atlas, [LAMP], 40)
    np.testing.assert_array_equal(alone[0], whole[0], "a lighting does not know what else is in the batch")
    for change in ({"seed": 1}, {"stream": "other"}):
        other = traced(cornell, cornell_atlas, [LAMP], 40, **change)
        both = np.stack([alone[0, :, 1], other[0, :, 1]])
        # Deviations from the other run's neighbourhood are noise: uncorrelated to 1 / sqrt(1100) within independent pairs.
        noise = both[:, 1::2] - both[:, :-1:2]
        middle = np.abs(noise).max(0) < np.quantile(np.abs(noise).max(0), 0.9)
        steps = noise[:, middle]
        assert abs(np.corrcoef(steps[0], steps[1])[0, 1]) < 0.5
        assert (alone != other).mean() > 0.9


def test_halves_are_independent(cornell: Scene, cornell_atlas: Atlas) -> None:
    """The half difference of two streams is as large as the scatter of many says: chi-square over lit texels."""
    runs = np.array([traced(cornell, cornell_atlas, [LAMP], 32, stream=f"paths {k}")[0, :, 1] for k in range(12)], np.float64)
    spread = runs[2:].var(0, ddof=1)
    lit = spread > 0
    ratio = (runs[0] - runs[1])[lit] ** 2 / 2 / spread[lit]
    # Each is F(1, 9)-distributed for normal noise, with median 0.494; skew and 2000 texels leave a tenth.
    assert np.median(ratio) == pytest.approx(stats.f.median(1, 9), rel=0.15)


def test_goes_on_where_it_stopped(cornell: Scene, cornell_atlas: Atlas) -> None:
    whole = traced(cornell, cornell_atlas, BATCH, 300)
    tracer = Tracer.of(cornell, 2)
    out = np.full_like(whole, np.nan)
    tiles = trace_paths(tracer, cornell, cornell_atlas, BATCH, out, samples=300, seed=0, stream="test")
    finished = sum(next(tiles) for _ in range(5))
    tiles.close()
    before, shot = np.isfinite(out).all((0, 2)), tracer.rays
    assert 0 < finished <= before.sum() < cornell_atlas.count
    out[:, finished:] = np.nan
    first = out[:, :finished].copy()
    out[:, :finished] = 7  # skipped tiles are left alone
    traced(cornell, cornell_atlas, BATCH, 300, out=out, skip=5)
    assert (out[:, :finished] == 7).all()
    np.testing.assert_array_equal(np.concatenate([first, out[:, finished:]], 1), whole)
    assert shot > 0


def test_chosen_texels_alone(cornell: Scene, cornell_atlas: Atlas) -> None:
    chosen = np.arange(0, cornell_atlas.count, 20)
    found = traced(cornell, cornell_atlas, [LAMP], 1024, texels=chosen)
    assert np.isnan(np.delete(found, chosen, axis=1)).all()
    whole = traced(cornell, cornell_atlas, [LAMP], 256)[0, chosen]
    error = np.sqrt(np.mean((found[0, chosen] - whole) ** 2)) / whole.mean()
    assert error < 0.15  # 256 paths have a noise of 8 %; another texel's light would differ by half
    np.testing.assert_allclose(found[0, chosen].mean(0), whole.mean(0), rtol=0.04)


@pytest.mark.parametrize("share", [0.0, 8.0])
def test_roulette_of_shadow_rays_changes_no_mean(
    share: float, cornell: Scene, cornell_atlas: Atlas, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None at all, and so much that most light is left to it."""
    aim = shading._aim
    monkeypatch.setattr(shading, "_aim", lambda faint, *given: aim(share, *given))
    chosen = np.arange(0, cornell_atlas.count, 40)
    area = np.zeros(cornell_atlas.count)
    area[chosen] = cornell_atlas.area[chosen]

    def runs(count: int) -> np.ndarray:
        found = [traced(cornell, cornell_atlas, [LAMP], 32, stream=f"{k}", texels=chosen)[0, chosen] for k in range(count)]
        return np.average(found, axis=1, weights=area[chosen])

    ours = runs(6)
    monkeypatch.undo()
    plain = runs(24)
    error = np.sqrt(ours.var(0, ddof=1) / 6 + plain.var(0, ddof=1) / 24)
    assert (error < 0.06 * plain.mean(0)).all()
    assert (np.abs(ours.mean(0) - plain.mean(0)) < 6 * error).all()


# --- how many ---------------------------------------------------------------------------------------------------------


def test_the_noise_is_what_was_predicted(bare: Scene) -> None:
    atlas = build_atlas(bare, 48)
    tracer = Tracer.of(bare)
    samples, expected = choose_samples(tracer, bare, atlas, [LAMP, SPOT], target=0.1, seed=0, stream="a")
    assert samples % 8 == 0
    assert expected <= 0.1
    one, two = (traced(bare, atlas, [LAMP, SPOT], samples, stream=name).astype(np.float64) for name in "ab")
    scale = mean(atlas, one).mean()
    noise = np.sqrt(mean(atlas, ((one - two) / scale) ** 2).mean() / 2)
    assert noise == pytest.approx(expected, rel=0.25)
    more, _ = choose_samples(tracer, bare, atlas, [LAMP, SPOT], target=0.05, seed=0, stream="a")
    assert more == pytest.approx(4 * samples, rel=0.3)


def test_darkness_needs_few(cornell: Scene, cornell_atlas: Atlas) -> None:
    dark = tuple(light.scaled(0.0) for light in LAMP)
    assert choose_samples(Tracer.of(cornell), cornell, cornell_atlas, [dark], target=0.1, seed=0, stream="a") == (8, 0.0)


# --- in a bake --------------------------------------------------------------------------------------------------------


def job(**transport: Any) -> Config:
    return Config.model_validate(
        {
            "atlas": {"resolution": 32},
            "lightings": {"train": 12, "validation": 2, "test": 4, "clearance": 0.1},
            "points": {"count": 32, "supersample": 2},
            "transport": {"samples": 256, "test_samples": 512, "integrator": "paths", **transport},
        }
    )


def test_a_bake_by_paths(cornell: Scene, tmp_path: Path) -> None:
    data = ddprt.bake(cornell, config=job(), out=tmp_path / "paths")
    again = ddprt.bake(cornell, config=job(threads=3), out=tmp_path / "again")
    assert data.description["transport"]["integrator"] == "paths"
    assert not list((tmp_path / "paths").glob("*.part")), "scratch is gone"
    every = range(18)
    indirect = data.maps("indirect", every)
    np.testing.assert_array_equal(indirect, again.maps("indirect", every))
    assert np.isfinite(indirect).all()
    assert (indirect.mean((1, 2)) > 0).all()
    one_by_one = ddprt.bake(cornell, config=job(integrator="reference"))
    ratio = mean(data, indirect) / mean(data, one_by_one.maps("indirect", every))
    np.testing.assert_allclose(ratio, 1, atol=0.05)  # the noise of either is 1 % where a lamp is near a wall
    test = data.split("test")
    noise, held = data.maps("noise", test), data.maps("indirect", test)
    level = np.sqrt((noise**2).mean((1, 2))) / held.mean((1, 2))
    assert (level > 0.005).all()
    assert (level < 0.3).all()
    model = ddprt.fit(data)
    metrics = evaluate(data, {"svd-ridge": model}, {}).metrics
    assert 0 < metrics["floors"]["noise_relative_rmse"] < metrics["methods"]["svd-ridge"]["relative_rmse"] < 1


def test_auto_samples_follow_the_target(cornell: Scene, tmp_path: Path) -> None:
    levels = []
    for target in (0.2, 0.1):
        data = ddprt.bake(cornell, config=job(samples="auto", test_samples="auto", target_noise=target))
        test = data.split("test")
        noise, held = data.maps("noise", test), data.maps("indirect", test)
        levels.append(np.sqrt((noise**2).mean()) / held.mean() / target)
    np.testing.assert_allclose(levels, 1, rtol=0.4)
