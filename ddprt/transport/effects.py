"""Simulate only the effects a scene calls for.

An effect is a part of light transport that some scenes lack. The plan says for each: called for or not, why, and, where it
is left out, an upper bound of the light it could have added. A new effect is one file, which is not even imported unless a
plan calls for it, and one entry of `EFFECTS`, which decides by what scene and lightings say of themselves.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from types import MappingProxyType, ModuleType

import numpy as np

from ddprt.catalogue import Catalogue
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.lights import LIGHTS, Lighting, parse_lighting
from ddprt.progress import amount
from ddprt.scene.holes import pierced
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.sheets import backs, without_backs
from ddprt.sections import TransportConfig
from ddprt.transport.convexity import sees_nothing
from ddprt.transport.fogginess import foggy
from ddprt.transport.glossiness import glossy, lobe_left, worth_gloss
from ddprt.transport.hairiness import diffuse, hairy
from ddprt.transport.translucency import filled, opaque


@dataclass(frozen=True)
class Effect:
    """One line of a plan.

    Attributes:
      name: entry of `EFFECTS`.
      called: whether it is simulated.
      why: the material, light or shape that decides.
      bound: upper bound of the light left out, as a share of the largest direct irradiance; None where it is unbounded.
      forced: the user decided, not the scene.
    """

    name: str
    called: bool
    why: str
    bound: float | None = 0.0
    forced: bool = False


@dataclass(frozen=True)
class Plan:
    """What will be simulated.

    Attributes:
      effects: every entry of `EFFECTS`, in order.
      bounces: -1 follows light until nothing is left, 0 traces none.
      costs: what effects that are called for will take, in words, by name, as far as scene and lightings tell.
    """

    effects: tuple[Effect, ...]
    bounces: int
    costs: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self, costs: Mapping[str, str] = MappingProxyType({})) -> list[str]:
        """A line for each effect: called for or not, why, and its cost or the bound of what leaving it out can cost.

        Args:
          costs: in words, by name of the effect, where more is known than the plan knew.
        """
        costs, rows = {**self.costs, **costs}, []
        for effect in self.effects:
            most = "any amount" if effect.bound is None else f"{effect.bound:.2g}"
            cut = effect.bound is None or effect.bound > 0
            told = [costs[effect.name]] if effect.called and effect.name in costs else []
            told += [f"at most {most} of the direct light is left out"] if effect.called and cut else []
            told += [] if effect.called else [f"at most {most} of the direct light"]
            state = f"{'called for' if effect.called else 'left out'}{' (forced)' if effect.forced else ''}"
            rows.append("; ".join([f"{effect.name}: {state}: {effect.why}", *told]))
        return rows

    def called(self, name: str) -> bool:
        """Whether an effect is simulated."""
        return any(effect.called for effect in self.effects if effect.name == name)

    def module(self, name: str) -> ModuleType | None:
        """The file of an effect, imported now; None where it is not called for, or has none of its own."""
        file = EFFECTS[name].module
        return import_module(f"ddprt.transport.{file}") if file and self.called(name) else None


@dataclass(frozen=True)
class Question:
    """What a plan is made from.

    Attributes:
      scene, lightings: of the bake.
      bounces: asked for; -1 lets the scene decide.
      direct_samples: shadow rays per texel and light.
      probes: which are asked for, in words; empty for none.
    """

    scene: Scene
    lightings: Sequence[Lighting]
    bounces: int = -1
    direct_samples: int = TransportConfig().direct_samples
    probes: str = ""

    def users(self, has: Callable[[Material], object]) -> str:
        """The materials in use that have something, in words; empty where none has."""
        found = [f'"{material.name}"' for material in self.scene.used_materials if has(material)]
        return f"material {', '.join(found[:3])}{f' and {len(found) - 3} more' if len(found) > 3 else ''}" if found else ""


@dataclass(frozen=True)
class Entry:
    """How an effect is decided on, and where it lives.

    Attributes:
      decide: the line of a plan that nobody forces; never imports the effect's file. What can be forced is decided on by the
        scene alone.
      module: its file in `ddprt.transport`; empty for what transport always has.
      without: the scene with what calls for the effect taken out; None where it cannot be forced.
      left: bound of the light left out when it is forced off; None where it is unbounded.
      cost: what it will take, in words; empty where scene and lightings do not tell.
    """

    decide: Callable[[str, Question], Effect]
    module: str = ""
    without: Callable[[Scene], Scene] | None = None
    left: Callable[[Question], float | None] = lambda question: None
    cost: Callable[[Question], str] = lambda question: ""


def plan(
    scene: Scene,
    lightings: Sequence[Lighting],
    *,
    bounces: int = -1,
    direct_samples: int = TransportConfig().direct_samples,
    probes: str = "",
) -> Plan:
    """Decides what to simulate.

    Args:
      scene: its materials and shape; from `force` where the user decides.
      lightings: all that will be baked.
      bounces: -1 lets the scene decide; 0 and up is forced.
      direct_samples: shadow rays per texel and light, for what it will cost.
      probes: which are asked for, in words (`config.probes.asked`); empty for none.
    Returns:
      A plan; printed, it has a line for each effect.
    Raises:
      UserError: no list of lightings, a lighting that cannot be read, or less than -1 bounces.
    """
    if isinstance(lightings, str) or not isinstance(lightings, Sequence):
        raise UserError(f"lightings: got {type(lightings).__name__}, expected a list of lightings; put one alone in brackets")
    if bounces < -1:
        raise UserError(f"bounces: got {bounces}, expected 0 and up, or -1; leave it out to let the scene decide")
    parsed = [parse_lighting(lighting, f"lighting {index}") for index, lighting in enumerate(lightings)]
    question = Question(scene, parsed, bounces, direct_samples, probes)
    effects = tuple(_decided(name, entry, question) for name, entry in EFFECTS.items())
    told = {effect.name: EFFECTS[effect.name].cost(question) for effect in effects if effect.called}
    return Plan(effects, bounces if effects[0].called else 0, {name: cost for name, cost in told.items() if cost})


def force(scene: Scene, *, on: Sequence[str] = (), off: Sequence[str] = ()) -> Scene:
    """A scene whose plan simulates some effects, or leaves them out, whatever it calls for by itself.

    What is said of an effect replaces what was said of it before, and what changes nothing gives the scene itself back.

    Args:
      scene: from `ddprt.load_scene` or from here.
      on, off: entries of `EFFECTS`. What is off is left out by taking out of the scene what calls for it.
    Raises:
      UserError: no lists of names, unknown names, effects that cannot be forced, or both on and off.
    """
    for way, names in (("on", on), ("off", off)):
        if isinstance(names, str) or not (isinstance(names, Collection) and all(isinstance(name, str) for name in names)):
            raise UserError(f'effects.{way}: got {names!r}, expected a list of names; write {way}=["gloss"] or the like')
    for name in (*on, *off):
        if EFFECTS[name].without is None:
            can = ", ".join(f'"{name}"' for name, entry in EFFECTS.items() if entry.without)
            also = "; transport.bounces forces those" if name == "diffuse bounces" else ""
            raise UserError(f'effects: got "{name}", which cannot be forced, expected some of {can}{also}')
        if name in on and name in off:
            raise UserError(f'effects: got "{name}" both on and off, expected one or the other; choose')
    if not on and not off:
        return scene
    forced, refused = {*scene.forced, *on} - {*off}, {*scene.refused, *off} - {*on}
    unforced = replace(scene.whole or scene, forced=(), refused=())
    alone = {name: EFFECTS[name].decide(name, Question(unforced, ())) for name in {*forced, *refused}}
    forced = {name for name in forced if not alone[name].called or alone[name].bound != 0}  # the others change nothing
    left = whole = replace(unforced, forced=tuple(sorted(forced)))
    for name, entry in EFFECTS.items():
        if name in refused and alone[name].called and entry.without:
            left = entry.without(left)
    return replace(left, whole=whole if left is not whole else None, refused=tuple(sorted(refused)))


def _decided(name: str, entry: Entry, question: Question) -> Effect:
    """What is forced off is judged by the whole scene; no entry's judgement knows what is forced."""
    scene = question.scene
    judged = (name in scene.refused and scene.whole) or scene
    asked = replace(question, scene=replace(judged, forced=(), refused=()) if scene.forced or scene.refused else scene)
    effect = entry.decide(name, asked)
    if name in scene.refused and effect.called:
        return Effect(name, False, f"forced off, though it is called for: {effect.why}", entry.left(asked), True)
    if name in scene.forced and not (effect.called and effect.bound == 0):
        why = f"forced on in full: {effect.why}" if effect.called else f"forced on, though {effect.why}"
        return Effect(name, True, why, 0.0, True)
    return effect


def _diffuse_bounces(name: str, question: Question) -> Effect:
    bounces = question.bounces
    brightest = max(map(opaque, question.scene.used_materials), key=lambda material: material.brightest)
    albedo, misty = brightest.brightest, foggy(question.scene)
    inside = any(filled(question.scene)) or hairy(question.scene) or misty
    if albedo == 0 and not any(glossy(question.scene)) and not hairy(question.scene) and not misty:
        return Effect(name, False, "every material is black")
    if question.scene.tubes is None and not misty and sees_nothing(question.scene):
        return Effect(name, False, "no surface faces another: the scene is convex seen from outside")
    if bounces >= 0:
        glows = any(_brightest(material) for material in question.scene.used_materials)  # with lamps however dim
        left = albedo ** (bounces + 1) / (1 - albedo) if albedo < 1 and not (glows or inside) else None
        return Effect(name, bounces > 0, f"forced to {bounces} (largest albedo {albedo:.3g})", left, True)
    why = f'largest albedo {albedo:.3g} ("{brightest.name}"), and {"fog is about" if misty else "surfaces face each other"}'
    if albedo >= 1:
        return Effect(name, True, f"{why}; where they close it in, light never dies away: lower it", None)
    return Effect(name, True, why)


def _gathered(question: Question) -> str:
    return "as many rays as the noise that is asked for takes, which `ddprt inspect` tries"


def _light_kind(kind: str) -> Entry:
    def decide(name: str, question: Question) -> Effect:
        lightings = question.lightings
        users = [index for index, lighting in enumerate(lightings) if any(light.kind == kind for light in lighting)]
        why = f"{len(users)} of {len(lightings)} lightings, first {users[0]}" if users else "no lighting has one"
        return Effect(name, bool(users), why)

    def cost(question: Question) -> str:
        count = sum(light.kind == kind for lighting in question.lightings for light in lighting)
        rays = amount(count * question.direct_samples)
        return f"up to {rays} shadow rays per texel for all lightings, and more near lamps"

    return Entry(decide, cost=cost)


def _material(has: Callable[[Material], object], lacking: str) -> Callable[[str, Question], Effect]:
    """Called for where a material in use has something."""

    def decide(name: str, question: Question) -> Effect:
        users = question.users(has)
        return Effect(name, bool(users), users or lacking)

    return decide


def _gloss(name: str, question: Question) -> Effect:
    scene = question.scene
    rough = [
        entry
        for entry, chosen in zip(scene.materials, glossy(scene), strict=True)
        if entry.gloss and entry in scene.used_materials and not chosen
    ]
    left = lobe_left(scene, rough)
    users = question.users(worth_gloss)
    if users:
        return Effect(name, True, users, left)
    if rough:
        return Effect(
            name, False, f"{question.users(lambda entry: entry.gloss)} too rough: less bright than a white wall", left
        )
    return Effect(name, False, "no material has any")


def _without_gloss(scene: Scene) -> Scene:
    return scene.made_of(lambda material: replace(material, gloss=None) if material.gloss else material)


def _gloss_left(question: Question) -> float | None:
    return lobe_left(question.scene, question.scene.used_materials)


def _without_cutouts(scene: Scene) -> Scene:
    return scene.made_of(lambda material: replace(material, cutout=None) if material.cutout else material)


def _two_sided(name: str, question: Question) -> Effect:
    users = question.users(lambda material: material.two_sided)
    count = int(np.count_nonzero(backs(question.scene))) if users else 0
    why = f"{users}: {count} triangles have a back of their own" if count else "no open surface has two sides"
    return Effect(name, count > 0, why)


def _emission(name: str, question: Question) -> Effect:
    users, used = question.users(_brightest), question.scene.used_materials
    if not users:
        return Effect(name, False, "no material emits light")
    brightest, albedo = max(map(_brightest, used)), max(material.brightest for material in used)
    bound = f"at most {np.pi * brightest / (1 - albedo):.3g}" if albedo < 1 else "any amount of"
    return Effect(name, True, f"{users}, {bound} W/m² of irradiance")


def _brightest(material: Material) -> float:
    """Largest radiance that it emits."""
    part = material.emission
    return 0.0 if part is None else max(part.radiance) * (1.0 if part.texture is None else float(part.texture.max()))


def _without_emission(scene: Scene) -> Scene:
    return scene.made_of(lambda material: replace(material, emission=None))


def _subsurface(name: str, question: Question) -> Effect:
    users = question.users(lambda material: material.subsurface)
    return Effect(name, bool(users), users or "no material is filled with a medium")


def _subsurface_left(question: Question) -> float | None:
    """A body alone sends out at most what falls on it, and no less than nothing; among others light may go round."""
    return 1.0 if sees_nothing(question.scene) else None


def _hair(name: str, question: Question) -> Effect:
    tubes = question.scene.tubes
    if tubes is None or not hairy(question.scene):
        return Effect(name, False, "the scene has no strands" if tubes is None else "its strands are diffuse")
    return Effect(name, True, f"{len(tubes.axis)} strands of {question.users(lambda entry: entry.fibre)}")


def _fog(name: str, question: Question) -> Effect:
    fog = question.scene.fog
    if fog is None or not foggy(question.scene):
        return Effect(name, False, "the air is clear" if fog is None else "the bounding box is flat and holds no air")
    paths = 2 * question.scene.radius / min(fog.mean_free_path)
    return Effect(name, True, f"the scene is up to {paths:.3g} free paths wide, its fog's largest albedo {max(fog.albedo):.3g}")


def _probes(name: str, question: Question) -> Effect:
    asked = question.probes
    return Effect(name, bool(asked), f"the configuration asks for {asked}" if asked else "the configuration asks for none")


def probed(config: Config, scene: Scene) -> bool:
    """Whether a bake has probes, without the rest of its plan."""
    return _decided("probes", EFFECTS["probes"], Question(scene, (), probes=config.probes.asked)).called


EFFECTS: Catalogue[Entry] = Catalogue(
    "effect",
    {
        "diffuse bounces": Entry(_diffuse_bounces, cost=_gathered),
        **{f"{kind} lights": _light_kind(kind) for kind in LIGHTS},
        "gloss": Entry(_gloss, "gloss", _without_gloss, _gloss_left),
        "cut-outs": Entry(_material(pierced, "no material has holes"), "cutouts", _without_cutouts),
        "two-sided sheets": Entry(_two_sided, without=without_backs),
        "emission": Entry(_emission, "emission", _without_emission),
        "subsurface": Entry(
            _subsurface,
            "subsurface",
            lambda scene: scene.made_of(opaque),
            _subsurface_left,
            lambda question: (
                "as many walks as the noise that is asked for takes, each of many short rays, once for all lightings"
            ),
        ),
        "hair": Entry(
            _hair,
            "hair",
            lambda scene: scene.made_of(diffuse),
            cost=lambda question: "as many paths as the noise that is asked for takes, which go from strand to strand",
        ),
        "fog": Entry(
            _fog,
            "fog",
            lambda scene: replace(scene, fog=None),
            cost=lambda question: "as many paths as the noise that is asked for takes, lit all along their way by each lamp",
        ),
        "probes": Entry(_probes, "probes", lambda scene: scene, lambda question: 0.0),  # no lightmap has light from them
        "animation": Entry(
            lambda name, asked: Effect(name, bool(asked.scene.rest), "a pose" if asked.scene.rest else "static")
        ),
    },
)
