"""Laws of the plan, for every entry of EFFECTS whatever it simulates: what is left out costs nothing and is told."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

import made_up_effect
import numpy as np
import pytest
from small_job import base, call

import ddprt
import ddprt.transport
from ddprt.bench.effects.ablation import Variant, _row, counterparts, variants
from ddprt.dataset.generate import bake
from ddprt.errors import UserError
from ddprt.lights import LIGHTS, Lighting, parse_lighting
from ddprt.pipeline import Run, _effects
from ddprt.progress import Doubt, Progress
from ddprt.scene.atlas import build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.files import load_scene
from ddprt.scene.library import SCENES, build
from ddprt.scene.material import Emission, Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import box, faceted, icosphere, rectangle
from ddprt.sections import EffectsConfig, LightingsConfig
from ddprt.transport.configured import configured_scene
from ddprt.transport.convexity import sees_nothing
from ddprt.transport.effects import EFFECTS, Plan, force, plan
from ddprt.transport.embree import Tracer
from ddprt.transport.reference import on_texels, trace_reference

CENTRE = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]})
LAMP = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})
WHITE = {"albedo": 0.96, "subdivisions": 2}
KINDS = [kind for kind in LIGHTS if kind in get_args(get_args(LightingsConfig.model_fields["kinds"].annotation)[0])]
HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def sparkle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """All laws hold for an effect more, which is entered as any other."""
    monkeypatch.setattr(ddprt.transport, "__path__", list(ddprt.transport.__path__))
    monkeypatch.setitem(EFFECTS, made_up_effect.NAME, made_up_effect.ENTRY)
    made_up_effect.register(tmp_path)
    yield
    sys.modules.pop(made_up_effect.MODULE, None)


@pytest.fixture(scope="module")
def calling() -> dict[str, Scene]:
    """By effect that can be forced, a scene that calls for it by itself, if the library has one."""
    found = {made_up_effect.NAME: build("furnace", **WHITE)}
    for scene in map(build, SCENES):
        for effect in plan(scene, ()).effects:
            if effect.called and EFFECTS[effect.name].without:
                found.setdefault(effect.name, scene)
    return found


def single(name: str, quads: np.ndarray, albedo: float = 0.8) -> Scene:
    return faceted(name, quads, (Material("plain", (albedo,) * 3),))


def drawn(kind: str, scene: Scene) -> Lighting:
    from ddprt.sampling.lightings import draw_lightings

    config = LightingsConfig(kinds=(kind,))
    free = Tracer.of(scene).clearance
    return draw_lightings(config, "train", 1, bounds=scene.bounds, clearance=free, seed=0).lightings[0]


# --- what is not called for ----------------------------------------------------------------------------------------------


def in_a_process(*words: str) -> dict[str, Any]:
    paths = os.pathsep.join([str(HERE), str(HERE.parent), os.environ.get("PYTHONPATH", "")])
    answer = subprocess.run(
        [sys.executable, str(HERE / "effects_apart.py"), *words],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": paths},
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr[-2000:]
    return json.loads(answer.stdout.splitlines()[-1])


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_is_left_out_is_not_imported_compiled_or_traced_and_changes_no_bit(every: bool) -> None:
    """Each library scene is baked while files of effects that it does not call for raise on import, then with all imported.

    The fast suite has one scene for each set of effects. Scenes with fewer effects come first, since what is once imported
    stays. That a scene calls for the effects of an entry tells nothing of lights, which all live in `lights` and are
    imported always.
    """
    called = {name: {entry.module for key, entry in EFFECTS.items() if plan(build(name), ()).called(key)} for name in SCENES}
    some = SCENES if every else {frozenset(modules): name for name, modules in reversed(called.items())}.values()
    names = sorted(some, key=lambda name: len(called[name]))
    with ThreadPoolExecutor(2) as pool:
        apart, together = pool.map(lambda way: in_a_process(way, *names), ("apart", "together"))
    assert apart["early"] == [], "importing the bake imports files of effects"
    for name in names:
        one, other = apart["scenes"][name], together["scenes"][name]
        assert set(one["called"]) == called[name] - {""}
        assert one["rays"] == other["rays"] > 0
        assert len(one["files"]) > 10
        assert one["files"] == other["files"], name
    used = {module for modules in called.values() for module in modules}
    grown = {name for name, count in together["after"].items() if count > together["before"][name]}
    assert made_up_effect.MODULE + ".twice" in together["before"], "compiled functions are found at all"
    assert not {name for name in grown if name.split(".")[2] not in used}


def test_a_plan_imports_what_it_calls_for_when_it_is_asked() -> None:
    called, left_out = plan(build("furnace", **WHITE), [CENTRE]), plan(build("furnace", subdivisions=1), [CENTRE])
    assert called.called(made_up_effect.NAME)
    assert made_up_effect.MODULE not in sys.modules
    assert left_out.module(made_up_effect.NAME) is None
    assert made_up_effect.MODULE not in sys.modules
    module = called.module(made_up_effect.NAME)
    assert module is sys.modules[made_up_effect.MODULE]


def test_files_of_effects_are_there(calling: dict[str, Scene]) -> None:
    for name, entry in EFFECTS.items():
        if entry.module and name in calling:
            assert plan(calling[name], ()).module(name).__doc__  # type: ignore[union-attr]


# --- what a plan says ----------------------------------------------------------------------------------------------------


def test_a_plan_names_every_effect_and_why(cornell: Scene) -> None:
    decided = plan(cornell, [LAMP, (*drawn("spot", cornell), *drawn("directional", cornell))])
    assert [effect.name for effect in decided.effects] == list(EFFECTS)
    called = {effect.name for effect in decided.effects if effect.called}
    assert called == {"diffuse bounces", "point lights", "spot lights", "directional lights"}
    assert decided.bounces == -1
    assert '"white"' in decided.effects[0].why
    assert decided.effects[2].why == "1 of 2 lightings, first 1"
    assert all(effect.bound == 0 for effect in decided.effects)
    assert not any(effect.forced for effect in decided.effects)


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_of_light_is_called_for_by_its_lightings_alone(kind: str, cornell: Scene) -> None:
    decided = plan(cornell, [LAMP, drawn(kind, cornell), drawn(kind, cornell)])
    lights = {effect.name: effect for effect in decided.effects if effect.name.removesuffix(" lights") in LIGHTS}
    assert {name for name, effect in lights.items() if effect.called} == {"point lights", f"{kind} lights"}
    expected = "3 of 3 lightings, first 0" if kind == "point" else "2 of 3 lightings, first 1"
    assert lights[f"{kind} lights"].why == expected
    assert all(effect.bound == 0 and effect.why == "no lighting has one" for effect in lights.values() if not effect.called)
    count = 3 if kind == "point" else 2
    assert f"up to {4 * count} shadow rays per texel" in decided.costs[f"{kind} lights"]


def test_who_calls_for_an_effect_is_named(calling: dict[str, Scene]) -> None:
    for name, scene in calling.items():
        effect = next(effect for effect in plan(scene, ()).effects if effect.name == name)
        callers = ["its fog"] if name == "fog" else [f'"{material.name}"' for material in scene.used_materials]
        assert any(caller in effect.why for caller in callers), effect


@pytest.mark.parametrize("name", SCENES)
def test_what_the_scene_leaves_out_has_a_bound(name: str) -> None:
    for effect in plan(build(name), [LAMP]).effects:
        assert effect.why
        assert not effect.forced
        if not effect.called:
            assert effect.bound is not None, effect
            assert effect.bound >= 0


def test_a_plan_prints_a_line_for_every_effect(cornell: Scene) -> None:
    decided = plan(cornell, [LAMP], bounces=1)
    lines = str(decided).splitlines()
    assert [line.split(": ")[0] for line in lines] == list(EFFECTS)
    for effect, line in zip(decided.effects, lines, strict=True):
        assert effect.why in line
        assert ("called for" in line) is effect.called
        assert ("left out: " in line) is not effect.called
        assert ("(forced)" in line) is effect.forced
    assert f"at most {decided.effects[0].bound:.2g} of the direct light is left out" in lines[0]
    assert "up to 4 shadow rays" in lines[1]
    assert "at most 0 of the direct light" in lines[2]
    assert "any amount" in str(plan(build("furnace", albedo=1, subdivisions=1), [CENTRE], bounces=2)).splitlines()[0]
    assert "point lights: called for: 1 of 1 lightings, first 0; a guess" in decided.lines({"point lights": "a guess"})


def test_inspect_lists_every_effect_with_rays_or_a_bound(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A sun from above lights one face of a cube: of 4 samples a texel, those there take a shadow ray each."""
    listed = tmp_path / "lights.json"
    listed.write_text(json.dumps([[{"type": "directional", "direction": [0, -1, 0], "irradiance": [1, 1, 1]}]] * 3))
    small = ["--atlas.resolution", "24", "--lightings.train", 1, "--lightings.validation", 1, "--lightings.test", 1]
    assert call("inspect", "convex", *small, "--points.count", 8, "--lightings.file", listed) == 0
    lines = [line.removeprefix("effect").strip() for line in capsys.readouterr().out.splitlines() if line.startswith("effect")]
    assert [line.split(": ")[0] for line in lines] == list(EFFECTS)
    scene = build("convex")
    top = (build_atlas(scene, 24, 2).geometric_normal[:, 1] > 0.5).sum()
    assert f"directional lights: called for: 3 of 3 lightings, first 0; about {3 * 4 * top} shadow rays" in lines
    for line in lines:
        assert ("left out" in line) is ("at most" in line), line
    assert call("inspect", "plates", "--atlas.resolution", 16, "--points.count", 8) == 0
    assert "rays for all lightings together" in capsys.readouterr().out


# --- what is forced ------------------------------------------------------------------------------------------------------


def test_forced_off_is_told_with_a_bound_or_none(calling: dict[str, Scene]) -> None:
    for name, scene in calling.items():
        by_itself = next(effect for effect in plan(scene, ()).effects if effect.name == name)
        decided = plan(force(scene, off=[name]), ())
        effect = next(effect for effect in decided.effects if effect.name == name)
        assert effect.forced
        assert not effect.called
        assert decided.module(name) is None
        assert effect.why == f"forced off, though it is called for: {by_itself.why}"
        assert effect.bound is None or effect.bound >= 0
        assert "left out (forced)" in str(decided)
    bounds = {effect.name: effect.bound for effect in plan(force(build("furnace", **WHITE), off=["sparkle"]), ()).effects}
    assert bounds["sparkle"] == 40.0


def test_forced_on_is_told(cornell: Scene) -> None:
    for name in forceable():
        decided = plan(force(cornell, on=[name]), [LAMP])
        effect = next(effect for effect in decided.effects if effect.name == name)
        assert effect.forced
        assert effect.called
        assert effect.why.startswith("forced on, though ")
        assert decided.module(name) is not None or not EFFECTS[name].module
        others = [effect for effect in decided.effects if effect.name != name]
        assert others == [effect for effect in plan(cornell, [LAMP]).effects if effect.name != name]


def test_what_is_said_last_holds(calling: dict[str, Scene], cornell: Scene) -> None:
    """Forcing twice is forcing once, off and on again is the scene as it was, and the order of names does not matter."""
    names = forceable()
    for name, scene in [*((name, cornell) for name in names), *calling.items()]:
        for way in ("on", "off"):
            other = {"on": "off", "off": "on"}[way]
            once = force(scene, **{way: [name]})
            assert told(force(once, **{way: [name]})) == told(once)
            assert told(force(force(scene, **{other: [name]}), **{way: [name]})) == told(once)
        back = force(force(scene, off=[name]), on=[name])
        if name in calling and plan(scene, ()).effects[list(EFFECTS).index(name)].bound == 0 and scene is calling[name]:
            assert back.digest == scene.digest
            assert back.whole is None
        one_by_one = scene
        for each in reversed(names):
            one_by_one = force(one_by_one, off=[each])
        assert told(one_by_one) == told(force(scene, off=names))
    assert force(cornell) is cornell


def test_digests_change_where_the_plan_does_and_nowhere_else(calling: dict[str, Scene], cornell: Scene) -> None:
    names = forceable()
    for scene in [cornell, *calling.values()]:
        before = [(effect.name, effect.called, effect.bound) for effect in plan(scene, ()).effects]
        for name, way in product(names, ("on", "off")):
            forced = force(scene, **{way: [name]})
            after = [(effect.name, effect.called, effect.bound) for effect in plan(forced, ()).effects]
            assert (forced.digest == scene.digest) is (after == before), (name, way)


def test_a_configuration_forces_as_force_does() -> None:
    config = base(scene__name="furnace", scene__parameters=WHITE)
    forced = config.model_copy(update={"effects": EffectsConfig(off=("sparkle",))})
    scene = load_scene("furnace", **WHITE)
    assert configured_scene(config).digest == scene.digest
    assert told(configured_scene(forced)) == told(force(scene, off=["sparkle"]))


REFUSED = {
    "unknown": (["--effects.on", "['sparkel']"], 'did you mean "sparkle"?'),
    "unknown, off": (["--effects.off", "['bouncing']"], 'no effect "bouncing"; known: '),
    "a light": (["--effects.off", "['point lights']"], 'got "point lights", which cannot be forced, expected some of'),
    "bounces": (["--effects.off", "['diffuse bounces']"], "transport.bounces forces those"),
    "both": (["--effects.on", "['sparkle']", "--effects.off", "['sparkle']"], 'got "sparkle" both on and off'),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_forced_is_refused_in_one_line(name: str, capsys: pytest.CaptureFixture) -> None:
    words, expected = REFUSED[name]
    for verb in ("inspect", "bench", "bake"):
        source = "cornell" if verb == "inspect" else HERE.parent / "configs" / "smoke.toml"
        flags = ["--effects"] if verb == "bench" else []
        assert call(verb, source, *flags, *words) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ddprt: ")]
        assert len(lines) == 1
        assert expected in lines[0]


@pytest.mark.parametrize("way", ["on", "off"])
def test_one_name_alone_is_no_list_of_names(way: str, cornell: Scene) -> None:
    with pytest.raises(UserError, match=rf"effects\.{way}: got 'gloss', expected a list of names; write {way}=\[\"gloss\"\]"):
        force(cornell, **{way: "gloss"})


def test_what_types_rule_out_is_refused_in_one_line_too() -> None:
    """In a process of its own, where nothing but the functions themselves looks at types."""
    code = """
import ddprt
from ddprt.lights import parse_lighting
from ddprt.scene.library import build
scene, lamp = build("plates"), {"type": "point", "position": [0, 0, 1], "intensity": [1, 1, 1]}
light = parse_lighting(lamp)[0]
tries = [lambda: ddprt.force(scene, off=None), lambda: ddprt.force(scene, on=[["gloss"]])]
tries += [lambda given=given: ddprt.plan(scene, given) for given in (lamp, light, None, "lamps.json")]
for one in tries:
    try:
        print("accepted", one())
    except ddprt.UserError as error:
        print(error)
assert ddprt.plan(scene, [lamp]).called("point lights")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    names = 'expected a list of names; write {0}=["gloss"] or the like'
    lightings = "lightings: got {0}, expected a list of lightings; put one alone in brackets"
    assert done.stdout.splitlines() == [
        f"effects.off: got None, {names.format('off')}",
        f"effects.on: got [['gloss']], {names.format('on')}",
        *(lightings.format(kind) for kind in ("dict", "PointLight", "NoneType", "str")),
    ]


def test_bounces_below_what_lets_the_scene_decide_are_refused(cornell: Scene) -> None:
    with pytest.raises(UserError, match=r"bounces: got -5, expected 0 and up, or -1; leave it out"):
        plan(cornell, [LAMP], bounces=-5)
    assert plan(cornell, [LAMP], bounces=-1) == plan(cornell, [LAMP])


def test_every_effect_is_forceable_or_refused(cornell: Scene) -> None:
    for name in EFFECTS:
        for way in ("on", "off"):
            if name in forceable():
                force(cornell, **{way: [name]})
            else:
                with pytest.raises(UserError, match="cannot be forced"):
                    force(cornell, **{way: [name]})


def forceable() -> list[str]:
    return [name for name, entry in EFFECTS.items() if entry.without]


def told(scene: Scene) -> tuple[str, Plan, str]:
    return scene.digest, plan(scene, ()), scene.whole.digest if scene.whole else ""


# --- bounces -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["black", "convex"])
def test_black_and_convex_scenes_trace_shadow_rays_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = build("furnace", albedo=0.0, subdivisions=2) if name == "black" else build("convex")
    lamp = CENTRE if name == "black" else parse_lighting({"type": "point", "position": [0, 2, 0.3], "intensity": [1, 1, 1]})
    atlas = build_atlas(scene, 32)
    decided = plan(scene, [lamp])
    assert decided.bounces == 0
    assert not decided.called("diffuse bounces")
    monkeypatch.setattr(Tracer, "first", None)
    tracer = Tracer.of(scene)
    found = trace_reference(
        tracer, scene, lamp, on_texels(tracer, atlas, np.arange(atlas.count)), atlas.count, 4, seed=0, bounces=decided.bounces
    )
    towards = lamp[0].anchor() - atlas.position
    facing = np.einsum("nd,nd->n", towards, atlas.geometric_normal) > 0
    assert tracer.rays == 4 * facing.sum()
    assert found.direct.any()
    assert not found.indirect.any()


def test_a_black_room_is_probed_without_bounce_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracer, "first", None)
    direct, indirect = ddprt.irradiance(
        build("furnace", albedo=0, subdivisions=1), CENTRE, [[0, 0.5, 0]], [[0, -1, 0]], samples=2
    )
    np.testing.assert_allclose(direct, 4, rtol=1e-4)  # the origin stands 7e-6 off
    assert not indirect.any()


CONVEX = {
    "cube": lambda: build("convex"),
    "cube far away": lambda: single("far", box(np.full(3, 1e4), np.full(3, 1e4 + 1))),
    "one square": lambda: single("square", np.array([rectangle((0.0, 0.0), (1.0, 1.0), 0.0, 1, facing=1)])),
    "sphere from outside": lambda: checked("ball", *icosphere(2)),
    "back to back": lambda: single(
        "sheets", np.array([rectangle((0.0, 0.0), (1.0, 1.0), at, 1, facing=f) for at, f in ((0.0, -1), (0.1, 1))])
    ),
}


@pytest.mark.parametrize("name", CONVEX)
def test_what_sees_nothing(name: str) -> None:
    assert sees_nothing(CONVEX[name]())


@pytest.mark.parametrize("name", ["cornell", "plates", "furnace", "corridor", "statue"])
def test_what_sees_something(name: str, request: pytest.FixtureRequest) -> None:
    assert not sees_nothing(request.getfixturevalue(name))


def test_a_dent_is_noticed() -> None:
    points, triangles = icosphere(2)
    points[0] *= 0.9
    assert not sees_nothing(checked("dented", points, triangles))


def test_two_cubes_see_each_other() -> None:
    one, two = box(np.zeros(3), np.ones(3)), box(np.full(3, 2.0), np.full(3, 3.0))
    assert not sees_nothing(single("two", np.concatenate([one, two])))


@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_forced_bounces_come_with_a_bound(bounces: int) -> None:
    scene = build("furnace", albedo=0.5, subdivisions=1)
    decided = plan(scene, [CENTRE], bounces=bounces)
    assert decided.bounces == bounces
    assert decided.effects[0].forced
    assert decided.effects[0].called is (bounces > 0)
    # a^(B + 1) + a^(B + 2) + ... of the largest direct light; in a furnace it is exactly what is missing.
    assert decided.effects[0].bound == pytest.approx(0.5 ** (bounces + 1) / 0.5)


def test_lamps_do_not_bound_the_bounces_of_light_that_is_not_theirs() -> None:
    assert plan(build("neon"), [CENTRE], bounces=1).effects[0].bound is None
    assert plan(force(build("neon"), off=["emission"]), [CENTRE], bounces=1).effects[0].bound > 0


def test_an_effect_that_cannot_occur_is_not_forced_on() -> None:
    assert plan(build("convex"), [LAMP], bounces=5).bounces == 0
    assert plan(build("furnace", albedo=0, subdivisions=1), [LAMP], bounces=5).bounces == 0
    assert plan(build("furnace", albedo=1, subdivisions=1), [LAMP], bounces=2).effects[0].bound is None


# --- what an effect is worth ---------------------------------------------------------------------------------------------


def in_a_furnace(**changes: Any) -> Any:
    """A job in a closed sphere of albedo a under lamps anywhere, where light of n bounces is a^n of the mean direct light."""
    small = {"atlas__resolution": 24, "lightings__test": 2, "transport__test_samples": 64, "points__count": 4}
    return base(scene__name="furnace", scene__parameters={**WHITE, "subdivisions": 3}, **small, **changes)


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EFFECTS, made_up_effect.NAME, made_up_effect.ENTRY)
        job = Run(in_a_furnace(), tmp_path_factory.mktemp("ablation"), quiet=True)
        text = job.ablate()
    lines = (job.folder / "bench" / "effects.jsonl").read_text().splitlines()
    assert (job.folder / "bench" / "effects.md").read_text() == text
    return job.folder / "bench", {row["variant"]: row for row in map(json.loads, lines)}


def test_what_an_effect_changes_is_told_in_light_rays_and_seconds(rows: tuple[Path, dict[str, Any]]) -> None:
    """With a = 0.96 all light is a / (1 - a) = 24 times the mean direct; at 0.5, once; of one bounce, a times.

    The mesh of 1280 facets of edge e = 0.14 R departs from the sphere's closed form by up to e² / 2 = 1 % of each bounce where
    a texel gathers, and what departs cancels over the surface; 64 rays for each of 350 texels leave less. 2 % is for both.
    """
    folder, found = rows
    a = WHITE["albedo"]
    assert list(found) == ["as planned", "without sparkle", "0 bounces", "1 bounce"]
    planned, dull, none, one = found.values()
    assert planned["relative_rmse"] == planned["energy_share"] == planned["largest_change"] == planned["bound"] == 0
    for row, share in ((dull, 1 - 1 / (a / (1 - a))), (none, 1.0), (one, a)):
        assert row["energy_share"] == pytest.approx(share, abs=0.02)
        assert row["relative_rmse"] == pytest.approx(share, abs=0.02)
        assert row["noise"] < 0.05
    assert none["energy_share"] == none["relative_rmse"] == 1
    assert dull["bound"] == 40.0
    assert none["bound"] == pytest.approx(a / (1 - a))
    assert one["bound"] == pytest.approx(a**2 / (1 - a))
    for row in (dull, none, one):
        assert 0 < row["largest_change"] < row["bound"]
        assert row["seconds"] > 0
        assert row["why"]
    assert none["rays"] < one["rays"] < planned["rays"]
    assert planned["environment"]["ddprt"] == ddprt.__version__
    assert not [path.name for path in folder.iterdir() if path.suffix not in (".jsonl", ".md")]
    text = (folder / "effects.md").read_text()
    assert [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines()[2:]] == list(found)
    assert "| 100.00% |" in text


def test_of_white_walls_paths_say_that_light_never_dies_and_nothing_else(tmp_path: Path) -> None:
    """Where an albedo is 1, rough gloss that is left out has no bound either, which the plan tells."""
    white = build("plates").made_of(lambda material: replace(material, albedo=(1.0,) * 3, gloss=Gloss(1.0)))
    lamp = parse_lighting({"type": "point", "position": [0, 0.5, 0], "intensity": [1, 1, 1]})
    assert [effect.name for effect in plan(white, [lamp]).effects if effect.bound is None] == ["diffuse bounces", "gloss"]
    config = base(atlas__resolution=24, points__count=4, transport__integrator="paths", transport__samples=2)
    with pytest.warns(Doubt) as told:
        bake(white, [lamp] * 3, config=config, out=tmp_path / "data")
    started = [str(line.message).split(":")[0] for line in told]
    assert [name for name in started if name in EFFECTS] == ["diffuse bounces"]


def test_changes_have_no_share_of_lamps_that_light_nothing(tmp_path: Path) -> None:
    """A sky outside of a closed room that glows: what glowing changes is no share of the direct light, rather than 0 of it."""
    room = build("furnace", subdivisions=2).made_of(lambda material: replace(material, emission=Emission((1.0, 1.0, 1.0))))
    sky = parse_lighting({"type": "environment", "image": "white"})
    lightings = {"train": [CENTRE], "validation": [CENTRE], "test": [sky]}
    config = base(atlas__resolution=24, points__count=4)
    planned = bake(room, lightings, config=config, out=tmp_path / "planned")
    dull = bake(force(room, off=["emission"]), lightings, config=config, out=tmp_path / "dull")
    told = _row(Variant("without emission", "emission", -1), room, [sky], planned, dull, 1.0, 0, "")
    assert (told.largest_change, told.relative_rmse, told.energy_share) == (None, 1.0, 1.0)


def test_variants_are_what_can_be_left_out(cornell: Scene) -> None:
    config = in_a_furnace()
    furnace = build("furnace", **WHITE)
    assert [v.name for v in variants(cornell, [LAMP], config)] == ["as planned", "0 bounces", "1 bounce"]
    assert [v.name for v in variants(furnace, [CENTRE], config)][:2] == ["as planned", "without sparkle"]
    assert [v.name for v in variants(build("convex"), [LAMP], config)] == ["as planned"]
    one = in_a_furnace(transport__bounces=1)
    assert [v.name for v in variants(cornell, [LAMP], one)] == ["as planned", "0 bounces"]
    assert Variant("without sparkle", "sparkle", -1).scene(furnace).digest == force(furnace, off=["sparkle"]).digest
    assert Variant("1 bounce", "diffuse bounces", 1).scene(furnace) is furnace


def test_texels_of_other_lightmaps_are_found_by_place_and_side(tmp_path: Path) -> None:
    """A sheet's two sides lie on each other: the side that another scene lacks has no counterpart there."""
    above, below = (rectangle((0.0, 0.0), (1.0, 1.0), 0.0, 1, facing=side) for side in (1, -1))
    lamp = parse_lighting({"type": "point", "position": [0.5, 0.4, 0.5], "intensity": [1, 1, 1]})
    config = base(atlas__resolution=24, points__count=2, points__supersample=1)
    both, alone = (
        bake(single(name, np.array(quads)), [lamp] * 3, config=config, out=tmp_path / name)
        for name, quads in (("both", [above, below]), ("alone", [above]))
    )
    place = counterparts(both, alone)
    up = both.gbuffer["geometric_normal"][:, 1] > 0
    assert up.any()
    assert (place[up] >= 0).all()
    assert (place[~up] == -1).all()
    apart = np.linalg.norm(both.gbuffer["position"][up] - alone.gbuffer["position"][place[up]], axis=1)
    assert apart.max() <= 1.5 * np.sqrt(np.median(both.area))
    assert (counterparts(both, both) == np.arange(len(both.area))).all()


def test_peers_and_effects_are_two_commands(capsys: pytest.CaptureFixture) -> None:
    assert call("bench", HERE.parent / "configs" / "smoke.toml", "--effects", "--peers") == 2
    assert "expected one of them" in capsys.readouterr().err


@pytest.mark.parametrize("flag", [["--sweep.fit.bases", "[2, 4]"], ["--sweep", "{fit.bases = [2, 4]}"]])
def test_effects_sweep_nothing(flag: list[str], capsys: pytest.CaptureFixture) -> None:
    assert call("bench", HERE.parent / "configs" / "smoke.toml", "--effects", *flag) == 2
    told = capsys.readouterr().err
    assert f"{flag[0]}: got --effects, which sweeps nothing" in told
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize("flag", [["--sweep.fit.bases", "[2, 4]"], ["--quick"]])
@pytest.mark.parametrize("asked", [["--leagues"], ["--splits", "noise"]])
def test_leagues_neither_sweep_nor_are_shortened(asked: list[str], flag: list[str], capsys: pytest.CaptureFixture) -> None:
    assert call("bench", HERE.parent / "configs" / "smoke.toml", *asked, *flag) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"ddprt: {flag[0]}: got ")
    assert len(told.splitlines()) == 1


def test_stages_belong_to_the_effect_that_they_are_named_after(tmp_path: Path) -> None:
    """Those of direct light count for every kind of light; what has no stage of its own cannot be told apart."""
    config = in_a_furnace()
    scene, progress = configured_scene(config), Progress(quiet=True)
    data = bake(scene, config=config, out=tmp_path, progress=progress)
    decided = plan(scene, data.lightings)
    stages = progress.stages
    before = {row["name"]: row for row in _effects(decided, stages, data)}
    assert before["sparkle"] == asdict(decided.effects[-1]) | {"rays": None, "seconds": None, "energy_share": None}
    more = [{"name": "sparkle", "seconds": 2.0}, {"name": "sparkle test", "seconds": 1.0, "rays": 7}]
    other = {"name": "sparkling", "seconds": 8.0, "rays": 100}
    after = {row["name"]: row for row in _effects(decided, [*stages, *more, other], data)}
    assert after.pop("sparkle") == asdict(decided.effects[-1]) | {"rays": 7, "seconds": 3.0, "energy_share": None}
    assert before.pop("sparkle")
    assert before == after
    rays = {
        name: sum(int(s.get("rays", 0)) for s in stages if str(s["name"]).split()[0] == name) for name in ("direct", "indirect")
    }
    assert before["diffuse bounces"]["rays"] == rays["indirect"] > 0
    assert before["point lights"]["rays"] == rays["direct"] > 0
    assert before["point lights"]["energy_share"] + before["diffuse bounces"]["energy_share"] == pytest.approx(1)
    assert before["spot lights"]["rays"] == before["spot lights"]["energy_share"] == 0


@pytest.mark.parametrize("factor", [0.0, 0.25])
def test_albedo_textures_count(factor: float) -> None:
    """A white material under a dark texture is as dark as the texture: no bounce where that is black, a bound where not."""
    room = ddprt.load_scene("cornell")
    image = np.full((4, 4, 3), factor)
    dark = replace(
        room.made_of(lambda material: replace(material, albedo=(1.0, 1.0, 1.0), texture=image)),
        uv=np.zeros((len(room.positions), 2)),
    )
    found = ddprt.plan(dark, [], bounces=1).effects[0]
    if factor:
        # At most a² / (1 - a) of the direct light is left out by one bounce.
        assert found.called
        assert found.bound == pytest.approx(factor**2 / (1 - factor))
    else:
        assert (found.called, found.bound) == (False, 0)
        assert "every material is black" in found.why
