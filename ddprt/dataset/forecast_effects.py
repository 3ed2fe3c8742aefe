"""What each effect that a plan calls for will take of a bake: its own stages, and its part in those of others."""

import numpy as np

from ddprt import seeds, warp
from ddprt.dataset.sampled import Expected, Sampled
from ddprt.lights import LIGHTS
from ddprt.progress import amount
from ddprt.scene.holes import pierced
from ddprt.scene.sheets import backs
from ddprt.transport.effects import Plan
from ddprt.transport.embree import lifted
from ddprt.transport.glossiness import glossy

_RAYS = 1 << 13  # that tell what surfaces and holes rays meet


def belongs(stage: str, effect: str) -> bool:
    """Whether a stage is an effect's work: those of direct light are every kind of light's, indirect light is the bounces'."""
    lights = effect.removesuffix(" lights") in LIGHTS
    begins = "indirect" if effect == "diffuse bounces" else "direct" if lights else effect
    return f"{stage} ".startswith(f"{begins} ")


def effect_costs(job: Sampled, stages: list[Expected], effects: Plan) -> dict[str, str]:
    """Expected cost of each effect that is called for, in words, by name.

    Args:
      job: the bake.
      stages: of it, all that are foreseen.
      effects: its plan.
    """
    seconds, costs = max(sum(stage.seconds for stage in stages), np.finfo(float).tiny), dict[str, str]()
    within = _within(job, effects)
    lights = sum(effect.called and belongs("direct", effect.name) for effect in effects.effects)
    for effect in (effect for effect in effects.effects if effect.called):
        own, told = [stage for stage in stages if belongs(stage.name, effect.name)], list[str]()
        if own:
            spent = sum(stage.seconds for stage in own)
            together = " together with other lights" if lights > 1 and belongs("direct", effect.name) else ""
            rays = amount(sum(stage.rays for stage in own))
            told.append(f"about {rays} rays and {spent:.2g} s{together}, {100 * spent / seconds:.2g} % of the bake")
        told += [within[effect.name]] if effect.name in within else []
        if told:
            costs[effect.name] = "; ".join(told)
    return costs


def _within(job: Sampled, effects: Plan) -> dict[str, str]:
    """What effects do within the stages of others, told by rays that leave the surfaces as light is gathered."""
    found = dict[str, str]()
    if effects.called("two-sided sheets"):
        share = job.scene.areas[backs(job.scene)].sum() / job.scene.areas.sum()
        found["two-sided sheets"] = f"backs are {100 * share:.2g} % of all surfaces, and of the texels"
    if not effects.called("gloss") and not effects.called("cut-outs"):
        return found
    rng, tracer, atlas = seeds.stream(0, "forecast effects"), job.tracer, job.atlas
    piece = rng.choice(len(atlas.piece_area), _RAYS, p=atlas.piece_area / atlas.piece_area.sum())
    u, starts = rng.random((_RAYS, 4), np.float32), atlas.piece_triangle[piece]
    inner = warp.sample_triangle(u[:, :2])
    weights = np.concatenate([1 - inner.sum(1, keepdims=True), inner], 1)
    origins = lifted(tracer, np.einsum("nc,ncd->nd", weights, atlas.piece_corners[piece]), tracer.normals[starts])
    directions = warp.to_world(warp.sample_cosine(u[:, 2:]), tracer.frames[starts])
    before = tracer.rays
    triangle = tracer.first(origins.astype(np.float32), directions)[0]
    each = (tracer.rays - before) / _RAYS
    if effects.called("gloss"):
        met = np.array(glossy(job.scene))[job.scene.material[triangle]] & (triangle >= 0)
        found["gloss"] = f"{100 * met.mean():.2g} % of all rays that are gathered meet it, and go on as its lobes scatter"
    if effects.called("cut-outs"):
        holes = ", ".join(f'"{one.name}"' for one in job.scene.used_materials if pierced(one))
        found["cut-outs"] = (
            f"{each:.3g} rays for each that is gathered, {100 * (1 - 1 / each):.2g} % of them to pass holes of {holes}"
        )
    return found
