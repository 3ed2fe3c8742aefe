"""A peer: Mitsuba 3 bakes the same maps, one lighting at a time.

Question: what does indirect irradiance at all texels cost with a good path tracer, per lighting?
Command:  python experiments/peer_mitsuba.py [SCENE] [resolution]     seconds and error
          python experiments/peer_mitsuba.py check [seed]              agreement with ddprt's own reference
Answer:   docs/results.md

Needs the extra "reference" and a libLLVM newer than 15. The settings are the best ones found (Cornell box, 15 k texels, 64
paths, two cores; time is of the cores, error * sqrt(time) decides):

    llvm_ad_rgb, one kernel, multijitter, roulette from the 5th bounce    0.32 s at 0.148: chosen
    roulette from the 3rd; 2nd; 1st bounce                                0.26 s at 0.164; 0.24 s at 0.178; 0.23 s at 0.193
    sampler ldsampler; stratified; independent                            0.32 s at 0.154; 0.31 s at 0.168; 0.32 s at 0.229
    wavefronts instead of one kernel                                      twice the time
    samples in the outer, texels in the inner order                       the same time, but samplers lose their strata
    sums by block_sum of an unevaluated array                             2.9 times the time: paths traced once per channel
    one mesh with albedo per face; one mesh per material                  equal
"""

import os
import sys
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt import seeds, warp
from ddprt.config import load_config
from ddprt.errors import UserError
from ddprt.lights import DirectionalLight, Light, Lighting, PointLight, SpotLight, parse_lighting
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import SELF_OFFSET, Tracer
from ddprt.transport.reference import on_texels, trace_reference

LLVM = ("/usr/lib", "/usr/local/lib", "/opt/homebrew/opt/llvm", "/usr/local/opt/llvm")
NEWEST, OLDEST = 30, 16

PLACES = 256
"""Places per texel that paths start from: scrambled Sobol points with a shift per texel, taken in turn. They are laid out
before the clock starts and serve every lighting."""
MOST_PLACES = 1 << 26
MOST_PATHS = 1 << 30
"""In one launch; Dr.Jit counts them with 32 bits."""
THIN = 0.01
"""Degrees: Mitsuba's spots fall off in another way than glTF's, so only rims thinner than this can be compared."""

LIGHTINGS = 4
SAMPLES = (16, 64, 256)
"""Squares, which multijitter arranges without rounding."""


def find_llvm() -> None:
    """Points Dr.Jit at the newest libLLVM, unless the user did.

    Raises:
      UserError: there is none newer than 15.
    """
    if os.environ.get("DRJIT_LIBLLVM_PATH"):
        return
    names = ("libLLVM-{0}.so", "libLLVM.so.{0}*", "libLLVM.{0}*")
    for version in range(NEWEST, OLDEST - 1, -1):
        for folder, depth, name in product(LLVM, ("", "*/", "*/lib/"), names):
            for found in sorted(Path(folder).glob(depth + name.format(version))):
                os.environ["DRJIT_LIBLLVM_PATH"] = str(found)
                return
    raise UserError("mitsuba: got no libLLVM newer than 15, expected one; apt-get install libllvm19, or set DRJIT_LIBLLVM_PATH")


def load_mitsuba() -> tuple[Any, Any]:
    """Mitsuba and Dr.Jit in the variant `llvm_ad_rgb`; a process must use no other.

    Raises:
      UserError: Mitsuba or libLLVM is missing, or another variant is in use.
    """
    find_llvm()
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise UserError(f'mitsuba: got {error}, expected the extra; pip install "ddprt[reference]"') from None
    if mitsuba.variant() not in (None, "llvm_ad_rgb"):
        raise UserError(f"mitsuba: got variant {mitsuba.variant()}, expected llvm_ad_rgb; start another process")
    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba, drjit


@dataclass(frozen=True)
class _Stage:
    """A Mitsuba scene for lightings of the same kinds, and the handles that move its lights."""

    scene: Any
    parameters: Any


class MitsubaBaker:
    """Indirect irradiance at all covered texels of an atlas, by `path` with next-event estimation and roulette.

    The first bake of a number of samples and of the lights' kinds compiles a kernel; those after it do not.

    Args:
      scene: without textures.
      atlas: of that scene.
      rr_depth: bounce after which roulette begins.
    Raises:
      UserError: Mitsuba or libLLVM is missing, or the scene has textures.
    """

    def __init__(self, scene: Scene, atlas: Atlas, rr_depth: int = 5) -> None:
        self.mi, self.dr = mi, _ = load_mitsuba()
        if any(material.texture is not None for material in scene.materials):
            raise UserError(f'mitsuba: got textures in "{scene.name}", expected plain albedos; choose another scene')
        self.texels, self.centre, self.corners = atlas.count, scene.centre, scene.corners - scene.centre
        self.albedo = np.array([material.albedo for material in scene.materials])[scene.material]
        self.path = mi.load_dict({"type": "path", "hide_emitters": True, "max_depth": -1, "rr_depth": rr_depth})
        self.sampler = mi.load_dict({"type": "multijitter"})
        self.stages: dict[tuple[str, ...], _Stage] = {}

        self.pool = int(max(1, min(PLACES, MOST_PLACES // atlas.count)))
        u = warp.sobol(self.pool, 2, seeds.number(0, "peer places"))[None]
        u = u + seeds.stream(0, "peer places").random((atlas.count, 1, 2), np.float32)
        u = np.minimum(u - np.floor(u), np.nextafter(np.float32(1), np.float32(0))).reshape(-1, 2)
        place, triangle = atlas.sampler.sample(np.repeat(np.arange(atlas.count), self.pool), u)
        normals = scene.geometric_normals.astype(np.float32)
        place += np.float32(2 * SELF_OFFSET * scene.radius) * normals[triangle]
        self.place = mi.Float(place.reshape(-1))
        self.triangle = mi.UInt32(triangle.astype(np.uint32))
        self.normals = mi.Float(normals.reshape(-1))

    def bake(self, lighting: Lighting, samples: int, seed: int) -> np.ndarray:
        """Mean indirect irradiance of every texel, (texels, 3) float32, W/m².

        Args:
          lighting: points, directionals, and spots without falloff.
          samples: paths per texel; must be a product of two near-equal numbers, such as a square.
          seed: of the paths.
        Raises:
          UserError: a light that Mitsuba does not share, or a number of samples that it would round.
        """
        mi, dr = self.mi, self.dr
        stage = self._stage(lighting)
        self._place_lights(stage, lighting)
        self.sampler.set_sample_count(samples)
        if self.sampler.sample_count() != samples:
            raise UserError(f"samples: got {samples}, expected a square or the like; try {self.sampler.sample_count()}")
        self.sampler.set_samples_per_wavefront(samples)
        turn = dr.opaque(mi.UInt32, seeds.number(seed, "peer turn") % self.pool)
        block = max(1, min(self.texels, MOST_PATHS // samples))
        total = dr.zeros(mi.Color3f, self.texels)
        for first in range(0, self.texels, block):
            count = min(block, self.texels - first)
            self.sampler.seed(seeds.number(seed, "peer paths", first), count * samples)
            path = dr.arange(mi.UInt32, count * samples)
            own = path // samples
            texel = own + dr.opaque(mi.UInt32, first)
            place = texel * self.pool + (path - own * samples + turn) % self.pool
            facing = dr.gather(mi.Normal3f, self.normals, dr.gather(mi.UInt32, self.triangle, place))
            towards = mi.Frame3f(facing).to_world(mi.warp.square_to_cosine_hemisphere(self.sampler.next_2d()))
            ray = mi.RayDifferential3f(dr.gather(mi.Point3f, self.place, place), towards)
            light, _, _ = self.path.sample(stage.scene, self.sampler, ray, None, True)
            dr.scatter_reduce(dr.ReduceOp.Add, total, light, texel)
            dr.eval(total)
        return np.ascontiguousarray(np.array(total * (dr.pi / samples), np.float32).T)

    def _stage(self, lighting: Lighting) -> _Stage:
        """The scene with lights of these kinds; made when it is first asked for."""
        kinds = tuple(light.kind for light in lighting)
        if kinds not in self.stages:
            mi = self.mi
            # Grey would turn into a spectrum with one number instead of three.
            colour = {"type": "rgb", "value": [1.0, 0.5, 0.25]}
            models = {
                "point": {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": colour},
                "spot": {"type": "spot", "cutoff_angle": 40.0, "beam_width": 39.9, "intensity": colour},
                "directional": {"type": "directional", "direction": [0.0, -1.0, 0.0], "irradiance": colour},
            }
            unknown = sorted(set(kinds) - set(models))
            if unknown:
                raise UserError(f"mitsuba: got a {unknown[0]} light, expected {', '.join(models)}; area lights occlude there")
            lights = {f"light{index}": models[kind] for index, kind in enumerate(kinds)}
            scene = mi.load_dict({"type": "scene", "mesh": self._mesh(), **lights})
            self.stages[kinds] = _Stage(scene, mi.traverse(scene))
        return self.stages[kinds]

    def _mesh(self) -> Any:
        """Flat one-sided triangles: backs block and reflect nothing, as in ddprt."""
        mi, count = self.mi, len(self.corners)
        properties = mi.Properties()
        properties["face_normals"] = True
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_albedo"}})
        mesh = mi.Mesh("scene", 3 * count, count, props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = self.corners.reshape(-1).astype(np.float32)
        parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
        parameters.update()
        mesh.add_attribute("face_albedo", 3, self.albedo.reshape(-1).astype(np.float32))
        return mesh

    def _place_lights(self, stage: _Stage, lighting: Lighting) -> None:
        for index, light in enumerate(lighting):
            for key, value in self._translated(light).items():
                stage.parameters[f"light{index}.{key}"] = value
        stage.parameters.update()

    def _translated(self, light: Light) -> dict[str, Any]:
        """A light's parameters in Mitsuba's words, in the centred frame."""
        mi = self.mi
        if isinstance(light, DirectionalLight):
            return {
                "to_world": self._aimed(np.zeros(3), np.array(light.direction)),
                "irradiance.value": mi.Color3f(*light.irradiance),
            }
        assert isinstance(light, PointLight | SpotLight)
        position, intensity = np.array(light.position) - self.centre, mi.Color3f(*light.intensity)
        if isinstance(light, PointLight):
            return {"position": mi.Point3f(*position.tolist()), "intensity.value": intensity}
        if light.outer_deg - light.inner_deg > THIN:
            raise UserError(
                f"mitsuba: got a spot from {light.inner_deg:g} to {light.outer_deg:g} degrees, whose falloff is not Mitsuba's; "
                f"expected a rim of at most {THIN:g}"
            )
        return {
            "to_world": self._aimed(position, np.array(light.direction)),
            "intensity.value": intensity,
            "cutoff_angle": light.outer_deg,
            "beam_width": light.inner_deg,
        }

    def _aimed(self, origin: np.ndarray, direction: np.ndarray) -> Any:
        up = np.eye(3)[np.argmin(np.abs(direction))]
        return self.mi.AffineTransform4f().look_at(origin=origin.tolist(), target=(origin + direction).tolist(), up=up.tolist())


def draw(scene: Scene, count: int) -> tuple[Lighting, ...]:
    """Held-out lightings of the default job's distribution."""
    config = load_config("configs/cornell.toml")
    clearance = Tracer.of(scene).clearance
    return draw_lightings(config.lightings, "test", count, bounds=scene.bounds, clearance=clearance, seed=config.seed).lightings


def measure(name: str, resolution: int = 152) -> None:
    """Seconds per lighting, and error of one map by two independent ones."""
    scene = ddprt.load_scene(name)
    atlas = build_atlas(scene, resolution)
    baker = MitsubaBaker(scene, atlas)
    lightings = draw(scene, LIGHTINGS)
    print(f"{name}: {atlas.count} texels, {LIGHTINGS} lightings one by one, {baker.dr.thread_count()} threads")
    print("samples  seconds per lighting  cores' time / threads  relative RMSE  per lighting")
    for samples in SAMPLES:
        baker.bake(lightings[0], samples, 10_000)
        wall, busy, errors = [], [], []
        for index, lighting in enumerate(lightings):
            maps = []
            for run in range(2):
                start, cpu = time.perf_counter(), time.process_time()
                maps.append(baker.bake(lighting, samples, 2 * index + run))
                wall.append(time.perf_counter() - start)
                busy.append((time.process_time() - cpu) / baker.dr.thread_count())
            error = np.sqrt(np.mean((maps[0] - maps[1]).astype(float) ** 2) / 2)
            errors.append(error / np.mean(maps, dtype=float))
        each = " ".join(f"{error:.4f}" for error in errors)
        print(f"{samples:7d}  {np.median(wall):20.3f}  {np.median(busy):21.3f}  {np.median(errors):13.4f}  {each}", flush=True)


SPOT = {"type": "spot", "inner_deg": 39.999, "outer_deg": 40.0, "intensity": [2.0, 2.0, 3.0]}
CHECKED: dict[str, dict[str, list[dict[str, Any]]]] = {
    "cornell": {
        "point": [{"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1.0, 0.8, 0.6]}],
        "spot": [{**SPOT, "position": [0.45, 0.5, 0.1], "direction": [-0.5, -1.0, 0.6]}],
        "directional": [{"type": "directional", "direction": [-0.3, -0.5, 1.0], "irradiance": [1.0, 0.9, 0.8]}],
        "two": [
            {"type": "point", "position": [0.1, 0.45, 0.28], "intensity": [1.0, 1.0, 1.0]},
            {"type": "point", "position": [0.4, 0.40, 0.2], "intensity": [0.2, 0.8, 0.6]},
        ],
    },
    "corridor": {
        "point": [{"type": "point", "position": [1.2, 1.6, 1.0], "intensity": [1.0, 0.8, 0.6]}],
        "spot": [{**SPOT, "position": [2.0, 2.2, 1.5], "direction": [1.0, -0.7, 0.1]}],
    },
}


def check(seed: int = 0, resolution: int = 48, texels: int = 128, paths: int = 2048, runs: int = 32) -> None:
    """Means and z-scores against ddprt's reference integrator, both variances counted; one channel, as they share paths."""
    print(f"atlas of {resolution}, {texels} texels, {paths} paths on both sides; z should be 0 +- 1")
    for name, lightings in CHECKED.items():
        scene = ddprt.load_scene(name)
        atlas, tracer = build_atlas(scene, resolution), Tracer.of(scene)
        baker = MitsubaBaker(scene, atlas)
        chosen = np.sort(seeds.stream(seed, "peer check").choice(atlas.count, texels, replace=False))
        for kind, records in lightings.items():
            lighting = parse_lighting(records)
            ours = trace_reference(tracer, scene, lighting, on_texels(tracer, atlas, chosen), texels, paths, seed=seed)
            baked = np.array([baker.bake(lighting, paths // runs, 1000 * seed + run)[chosen] for run in range(runs)], float)
            mean, variance = baked.mean(0), baked.var(0, ddof=1) / runs
            spread = ours.indirect_variance + variance
            seen = spread[:, 1] > 1e-12 * (ours.indirect + mean)[:, 1] ** 2
            z = ((mean - ours.indirect)[seen] / np.sqrt(spread[seen]))[:, 1]
            ratio = mean.mean(0) / ours.indirect.mean(0) - 1
            known = np.sqrt(spread.sum(0)) / texels / ours.indirect.mean(0)
            print(
                f"{name:9s} {kind:12s} z {z.mean():+.2f} +- {z.std():.2f}, largest {np.abs(z).max():.1f}, {len(z)} texels; "
                f"mean {ratio[1]:+.4f} +- {known[1]:.4f}",
                flush=True,
            )


def main(name: str = "cornell", *numbers: str) -> None:
    if name == "check":
        check(*map(int, numbers))
    else:
        measure(name, *map(int, numbers))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except UserError as error:
        sys.exit(f"error: {error}")
