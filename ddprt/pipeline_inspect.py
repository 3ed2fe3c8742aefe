"""What would happen, without doing it: the text of `ddprt inspect` and `ddprt doctor`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import seeds
from ddprt.config import Config, load_config
from ddprt.errors import UserError
from ddprt.machine import PACKAGES, installed, machine
from ddprt.progress import amount

_LOOKED_AT = 8  # lightings that stand for all
_FORESEEN = "gloss", "cut-outs", "two-sided sheets", "emission", "probes"  # what takes more than lamps and bounces


@dataclass(frozen=True)
class Examined:
    """A scene as a bake would have it, and what there is to say of it, a name and a text in each line."""

    text: str
    config: Config
    scene: Any
    tracer: Any
    atlas: Any

    def page(self) -> str:
        """All of it as HTML, with pictures and what a bake is expected to take."""
        from ddprt.dataset.forecast import forecast
        from ddprt.report.inspection import inspection_page

        try:
            words = str(forecast(self.scene, self.config))
        except UserError as error:
            words = f"cannot be told: {error}"
        rows = [("forecast" if k == 0 else "").ljust(12) + line for k, line in enumerate(words.splitlines())]
        return inspection_page(self.scene, self.tracer, self.atlas, "\n".join([self.text, *rows]))


def examine(source: str, overrides: dict[str, str]) -> Examined:
    """A scene, its atlas and its plan.

    Args:
      source: a configuration, a scene name or a mesh file.
      overrides: of the configuration.
    """
    from ddprt.dataset.generate import check_points
    from ddprt.dataset.sameness import baked_settings
    from ddprt.transport.configured import configured_scene
    from ddprt.transport.effects import plan
    from ddprt.transport.embree import Tracer
    from ddprt.transport.openness import build_open_atlas

    configured = Path(source).suffix == ".toml"
    config = load_config(
        source if configured else None, overrides if configured else {**overrides, "scene.name": f'"{source}"'}
    )
    scene = configured_scene(config)
    size = scene.bounds[1] - scene.bounds[0]
    lines = [
        f"scene       {scene.name}: {len(scene.triangles)} triangles, {scene.areas.sum():.4g} m², "
        f"{size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} m",
        *(f"note        {note}" for note in scene.notes),
        *(f"material    {m.name}: albedo {np.round(m.albedo, 4).tolist()}{', textured' if m.texture is not None else ''}"
          for m in scene.materials),
    ]  # fmt: skip
    if config.animated:
        lines.append(_poses(config))
    tracer = Tracer.of(scene)
    atlas, hidden = build_open_atlas(tracer, scene, config.atlas.resolution, config.atlas.padding)
    charts, of = len(np.unique(atlas.chart)), "" if scene.lightmap is None else " of the file"
    lines.append(
        f"atlas       {atlas.resolution} x {atlas.resolution}: {atlas.count} texels covered "
        f"({100 * atlas.count / atlas.resolution**2:.0f} %), {charts} charts{of}, {atlas.texels_per_metre:.4g} texels per metre"
    )
    if any(hidden.values()):
        lines.append("            " + ", ".join(f"{count} {what}" for what, count in hidden.items()) + " by other geometry")
    if not config.points.file:
        try:
            check_points(config, scene, atlas)
        except UserError as error:
            lines.append(f"points      cannot be placed as configured: {error}")
    settings = config.lightings
    lightings, told = _some_lightings(config, scene, tracer)
    lines += told
    count = settings.train + settings.validation + settings.test
    shadow = atlas.count * config.transport.direct_samples * count
    bake = [f"a bake      {count} lightings: {amount(shadow)} shadow rays per lamp"]
    effects = plan(scene, lightings, bounces=config.transport.bounces, probes=config.probes.asked)
    costs: dict[str, str] = {}
    if lightings:
        direct, costs = _direct(config, tracer, atlas, lightings, count)
        bake += _darkness(lightings, direct, scene, tracer)
        integrator = baked_settings(config, scene)["transport"]["integrator"]
        if effects.bounces and integrator != "operator":
            bake.append(f"            indirect light by {integrator}, whose rays `ddprt bake --dry-run` tells")
        elif effects.bounces and any(light.any() for light in direct):
            told, costs["diffuse bounces"] = _gathering(config, tracer, atlas, lightings, direct)
            bake += told
        if any(effects.called(name) for name in _FORESEEN):
            told, foreseen = _foreseen(scene, config)
            bake, costs = bake + told, {**foreseen, **costs}
    known = [line for line in effects.lines(costs) if lightings or not line.split(":")[0].endswith(" lights")]
    text = "\n".join([*lines, *(f"effect      {line}" for line in known), *bake])
    return Examined(text, config, scene, tracer, atlas)


def _poses(config: Config) -> str:
    """How many bakes an animation makes, of which one is looked at."""
    from ddprt.scene.poses import configured_animation

    animation = configured_animation(config)
    times, between = ", ".join(f"{time:g}" for time in animation.times), len(animation.between(config.animation.between))
    return (
        f"animation   {animation.keys} keyframes, at {times} s, each with a bake as below, which is that of the first; "
        f"{between} poses between with {2 + config.lightings.test} lightings each"
    )


def _foreseen(scene: Any, config: Config) -> tuple[list[str], dict[str, str]]:
    """What to say of a bake that is foreseen, and what each effect will take, as `ddprt bake --dry-run` tells."""
    import warnings

    from ddprt.dataset.forecast import forecast
    from ddprt.progress import Doubt

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", Doubt)
        try:
            costs = dict(forecast(scene, config).effects.costs)
        except UserError as error:
            return [f"            what effects take cannot be told: {error}"], {}
    return [f"            {one.message}" for one in told if issubclass(one.category, Doubt)], costs


def _some_lightings(config: Config, scene: Any, tracer: Any) -> tuple[Any, list[str]]:
    """A few lightings as configured, and what to say; where a room has no free space, lamps about it as an asset."""
    from ddprt.lights import load_lightings
    from ddprt.sampling.lightings import draw_lightings

    settings = config.lightings
    if settings.file:
        listed = load_lightings(settings.file, settings.gltf_units)
        return listed[:_LOOKED_AT], [
            f"lightings   {settings.file}: {len(listed)}, of which the first {_LOOKED_AT} are looked at"
        ]
    drawn = min(_LOOKED_AT, settings.train)

    def draw(**changes: Any) -> Any:
        changed = settings.model_copy(update=changes)
        return draw_lightings(changed, "train", drawn, bounds=scene.bounds, clearance=tracer.clearance, seed=config.seed)

    try:
        found = draw()
    except UserError as error:  # an asset can be looked at before its lamps are configured
        try:
            draw(clearance=0.0, size=1e-9, region_low=(0.0,) * 3, region_high=(1.0,) * 3)
        except UserError:
            return draw(distribution="around").lightings, [
                "lightings   cannot be drawn as configured: got no free space for lamps inside the bounding box, as with a "
                'closed solid or a flat sheet; set lightings.distribution = "around", as is assumed below'
            ]
        return (), [f"lightings   cannot be drawn as configured: {str(error).removeprefix('lightings: ')}"]
    tried = f"{found.candidates} positions tried, {found.rejected} rejected for the first {drawn}"
    return found.lightings, [f"lightings   {settings.distribution}: {tried}"]


def _direct(config: Config, tracer: Any, atlas: Any, lightings: Any, count: int) -> tuple[list[np.ndarray], dict[str, str]]:
    """Direct light of each lighting on the texels, and what each kind of light will take for so many lightings, in words."""
    from ddprt.transport.direct import Texels

    texels = Texels.of(tracer, atlas, config.transport.direct_samples, seeds.stream(config.seed, "texel positions"))
    found, rays = [], dict[str, int]()
    for index, lighting in enumerate(lightings):
        stream, total = seeds.stream(config.seed, "direct", index), np.zeros((atlas.count, 3), np.float32)
        for kind in dict.fromkeys(light.kind for light in lighting):
            before = tracer.rays
            total += texels.irradiance(tuple(light for light in lighting if light.kind == kind), stream)
            rays[kind] = rays.get(kind, 0) + tracer.rays - before
        found.append(total)
    share = count / len(lightings)
    return found, {f"{kind} lights": f"about {amount(traced * share)} shadow rays" for kind, traced in rays.items()}


def _darkness(lightings: Any, direct: list[np.ndarray], scene: Any, tracer: Any) -> list[str]:
    """How many lightings light nothing, and why the first of them does not."""
    from ddprt.dataset.splits import doubt

    dark = [index for index, light in enumerate(direct) if not light.any()]
    if not dark:
        return []
    refused = "; a bake where all do is refused" if len(dark) == len(direct) else ""
    advice = 'check where fronts look, or set lightings.distribution = "around" for an asset'
    why = doubt(lightings[dark[0]], True, scene, tracer).removeprefix("lights nothing: ")
    told = f"{len(dark)} of {len(direct)} lightings light nothing{refused}; the first {why.removeprefix('it ')}; {advice}"
    return [f"            {told}"]


def _gathering(config: Config, tracer: Any, atlas: Any, lightings: Any, direct: list[np.ndarray]) -> tuple[list[str], str]:
    """What the operator would choose for these lightings, and how many rays its maps of all lightings take, in words."""
    from ddprt.transport.effort import choose_rays
    from ddprt.transport.operator import Operator

    operator = Operator.of(tracer, atlas, config.transport.sender_resolution)
    averaged = np.concatenate([operator.averaged(light) for light in direct], 1)
    lines, traced = [], 0.0
    for name, halves in (("training", 1), ("held-out", 2)):
        address: dict[str, Any] = {"seed": config.seed, "stream": f"inspect {name}"}
        before = tracer.rays
        radiosity = operator.bounce(averaged, bounces=config.transport.bounces, **address).radiosity
        traced += halves * (tracer.rays - before)
        near = operator.near(lightings, averaged, bounces=config.transport.bounces)
        facts = choose_rays(operator, radiosity, config.transport, near=near, held_out=halves == 2, **address).facts
        rays, noise = facts["samples"], 100 * facts["noise_expected"]
        total = amount(rays * atlas.count)
        traced += rays * atlas.count
        lines.append(f"            {name} maps: {rays:g} gather rays per texel ({total}), noise about {noise:.2g} %")
    return lines, f"about {amount(traced)} rays for all lightings together"


def checkup() -> tuple[str, bool]:
    """The machine, the packages, and a ray, an EXR and a matrix product to see that they work."""
    facts = machine()
    lines = [
        f"{facts['processor']}, {facts['cores']} cores, {facts['memory_gib']} GiB, {facts['system']}, Python {facts['python']}"
    ]
    fine = True
    for name in PACKAGES:
        found = installed(name)
        fine &= found is not None
        lines.append(f"{'ok' if found else 'MISSING':<8}{name} {found or '- pip install ' + name}")
    for name, check in (("ray tracing", _try_ray), ("EXR files", _try_exr), ("JAX", _try_jax)):
        try:
            lines.append(f"ok      {name}: {check()}")
        except (UserError, ImportError, OSError, RuntimeError) as error:
            fine = False
            lines.append(f"BROKEN  {name}: {error}")
    return "\n".join(lines), fine


def _try_ray() -> str:
    from ddprt.scene.library import build
    from ddprt.transport.embree import Tracer
    from ddprt.transport.packets import embree

    tracer = Tracer.of(build("furnace"))
    hits = tracer.closest(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
    if not hits.front[0] or abs(hits.distance[0] - 1) > 0.01:
        raise RuntimeError(f"a ray in a unit sphere got {hits.distance[0]}, expected 1")
    return f"a ray in a unit sphere hits its wall; Embree {embree().version}, {embree().width} rays at a time"


def _try_exr() -> str:
    import tempfile

    from ddprt.scene.exr import read_exr, write_exr

    image = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    with tempfile.TemporaryDirectory() as folder:
        write_exr(Path(folder) / "a.exr", image, half=True)
        if not (read_exr(Path(folder) / "a.exr")[0] == image).all():
            raise RuntimeError("an image came back changed")
    return "an image comes back as it was written"


def _try_jax() -> str:
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):
        product = float(jnp.sum(jnp.ones((8, 8), jnp.float64) @ jnp.ones((8, 8), jnp.float64)))
    if product != 512:
        raise RuntimeError(f"a matrix product gave {product}, expected 512")
    return f"{jax.default_backend()} with {jax.device_count()} device(s), float64 on demand"
