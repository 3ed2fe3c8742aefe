"""Thirty-two rectangles in one lighting: does every light need a sample of its own?

Question: noise of direct irradiance on texels at equal time, a sample of every light against Mitsuba's choice among emitters.
Command:  python experiments/area_lights.py [resolution]
          python experiments/area_lights.py near              one large lamp close to surfaces, by area and by solid angle
Answer:   docs/effects.md

Both bake the Cornell box under the same 32 rectangles on the same texels, places laid out before the clock starts. ddprt takes
a number of samples of every light at every place; Mitsuba (llvm_ad_rgb) chooses one emitter per sample, uniformly or by power,
and takes as many samples as it likes, by the samplers it has. Emitters occlude in Mitsuba, so the rectangles lie in one plane,
where none hides another's light. Error is that of 16 independent bakes about their mean, over the surface. Seconds are those of
the cores, since a bake lights as many lightings side by side as there are threads. What decides is error times the root of
seconds, and the least of all settings counts for each.
"""

import sys
import time
from typing import Any

import numpy as np
from peer_mitsuba import load_mitsuba

from ddprt import seeds, warp
from ddprt.lights import Lighting, area, parse_lighting
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import Texels
from ddprt.transport.embree import SELF_OFFSET, Tracer

RESOLUTION = 96
BAKES = 16
OURS = (1, 2, 4, 8, 16)
THEIRS = (16, 64, 256, 576)
"""Squares, which multijitter arranges without rounding."""
SAMPLERS = ("independent", "stratified", "multijitter")
POOL = 576


def rectangles() -> Lighting:
    """Eight by four under the ceiling of the Cornell box, of unequal power."""
    rng = np.random.default_rng(0)
    lights = [
        {
            "type": "rect",
            "center": [0.06 + 0.06 * column, 0.45, 0.08 + 0.13 * row],
            "half_u": [0.02, 0.0, 0.0],
            "half_v": [0.0, 0.0, 0.03],
            "radiance": (np.array([1.0, 0.8, 0.6]) * rng.uniform(2, 20)).tolist(),
        }
        for column in range(8)
        for row in range(4)
    ]
    return parse_lighting(lights)


def spread(maps: np.ndarray, area: np.ndarray) -> float:
    """RMS of bakes about their mean over the RMS of that, over the surface."""
    weight = area / area.sum()
    mean = maps.mean(0)
    variance = ((maps - mean) ** 2).sum(0) / (len(maps) - 1)
    return float(np.sqrt(np.einsum("t,tc->", weight, variance) / np.einsum("t,tc->", weight, mean**2)))


def ours(tracer: Tracer, atlas: Atlas, lighting: Lighting, samples: int) -> tuple[np.ndarray, float]:
    """Bakes, and the median seconds of one."""
    maps, seconds = [], []
    for run in range(BAKES + 1):
        texels = Texels.of(tracer, atlas, samples, seeds.stream(run, "area lights places"))
        start = time.process_time()
        light = texels.irradiance(lighting, seeds.stream(run, "area lights"))
        seconds.append(time.process_time() - start)
        maps.append(light)
    return np.array(maps[1:], np.float64), float(np.median(seconds[1:]))


class Peer:
    """Mitsuba's direct light on texels, one kernel."""

    def __init__(self, scene: Scene, atlas: Atlas, lighting: Lighting, sampler: str, by_power: bool) -> None:
        self.mi, self.dr = mi, _ = load_mitsuba()
        self.texels, self.sampler = atlas.count, mi.load_dict({"type": sampler})
        corners = scene.corners - scene.centre
        properties = mi.Properties()
        properties["face_normals"] = True
        mesh = mi.Mesh("scene", 3 * len(corners), len(corners), props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = corners.reshape(-1).astype(np.float32)
        parameters["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
        parameters.update()
        parts: dict[str, Any] = {"type": "scene", "mesh": mesh}
        for index, light in enumerate(lighting):
            u, v, radiance = np.array(light.half_u), np.array(light.half_v), np.array(light.radiance)  # type: ignore[attr-defined]
            columns = np.eye(4)
            across = np.cross(u, v)
            columns[:3] = np.stack([u, v, across / np.linalg.norm(across), light.center - scene.centre], 1)  # type: ignore[attr-defined]
            weight = float(radiance.mean() * np.linalg.norm(across)) if by_power else 1.0
            emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}, "sampling_weight": weight}
            parts[f"light{index}"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f(columns), "emitter": emitter}
        self.scene = mi.load_dict(parts)
        u = warp.sobol(POOL, 2, seeds.number(0, "peer places"))[None]
        u = u + seeds.stream(0, "peer places").random((atlas.count, 1, 2), np.float32)
        u = np.minimum(u - np.floor(u), np.nextafter(np.float32(1), np.float32(0))).reshape(-1, 2)
        place, triangle = atlas.sampler.sample(np.repeat(np.arange(atlas.count), POOL), u)
        normals = scene.geometric_normals.astype(np.float32)
        place += np.float32(2 * SELF_OFFSET * scene.radius) * normals[triangle]
        self.place, self.normal = mi.Float(place.reshape(-1)), mi.Float(normals[triangle].reshape(-1))

    def bake(self, samples: int, seed: int) -> np.ndarray:
        """Mean direct irradiance of every texel, W/m²."""
        mi, dr = self.mi, self.dr
        self.sampler.set_sample_count(samples)
        self.sampler.set_samples_per_wavefront(samples)
        self.sampler.seed(seeds.number(seed, "peer"), self.texels * samples)
        turn = dr.opaque(mi.UInt32, seeds.number(seed, "peer turn") % POOL)
        path = dr.arange(mi.UInt32, self.texels * samples)
        texel = path // samples
        place = texel * POOL + (path - texel * samples + turn) % POOL
        at = dr.zeros(mi.SurfaceInteraction3f, self.texels * samples)
        at.p, at.n = dr.gather(mi.Point3f, self.place, place), dr.gather(mi.Normal3f, self.normal, place)
        at.sh_frame = mi.Frame3f(at.n)
        sample, weight = self.scene.sample_emitter_direction(at, self.sampler.next_2d(), True)
        total = dr.zeros(mi.Color3f, self.texels)
        dr.scatter_reduce(dr.ReduceOp.Add, total, weight * dr.maximum(dr.dot(at.n, sample.d), 0), texel)
        dr.eval(total)
        return np.ascontiguousarray(np.array(total / samples, np.float64).T)

    def measured(self, samples: int) -> tuple[np.ndarray, float]:
        """Bakes after one that compiles, and the median seconds of one."""
        self.bake(samples, BAKES)
        maps, seconds = [], []
        for seed in range(BAKES):
            start = time.process_time()
            maps.append(self.bake(samples, seed))
            seconds.append(time.process_time() - start)
        return np.array(maps), float(np.median(seconds))


def main(resolution: int) -> None:
    scene, lighting = build("cornell"), rectangles()
    tracer, atlas = Tracer.of(scene), build_atlas(scene, resolution)
    print(
        f"{atlas.count} texels, {len(lighting)} rectangles, {tracer.threads} threads; error of a bake, seconds, product of root"
    )
    costs: dict[str, list[float]] = {"ddprt": [], "mitsuba": []}
    means = {}
    for samples in OURS:
        maps, seconds = ours(tracer, atlas, lighting, samples)
        error = spread(maps, atlas.area)
        means["ddprt"] = maps.mean(0)
        costs["ddprt"].append(error * seconds**0.5)
        print(
            f"ddprt   {samples:3} of each                    {error:.4f}  {seconds:.3f} s  {error * seconds**0.5:.5f}",
            flush=True,
        )
    for sampler in SAMPLERS:
        for by_power in (False, True):
            peer = Peer(scene, atlas, lighting, sampler, by_power)
            for samples in THEIRS:
                maps, seconds = peer.measured(samples)
                error = spread(maps, atlas.area)
                means["mitsuba"] = maps.mean(0)
                costs["mitsuba"].append(error * seconds**0.5)
                way = f"{samples:3} {sampler}{', by power' if by_power else ''}"
                print(f"mitsuba {way:32} {error:.4f}  {seconds:.3f} s  {error * seconds**0.5:.5f}", flush=True)
    agree = np.average(means["mitsuba"], axis=0, weights=atlas.area) / np.average(means["ddprt"], axis=0, weights=atlas.area)
    print(f"mean light, theirs over ours: {agree.round(4).tolist()}")
    print(f"least error x root of seconds, ours over theirs: {min(costs['ddprt']) / min(costs['mitsuba']):.2f}")


def near() -> None:
    """Error and seconds of lamps close to the walls, sampled by area everywhere and as `lights/area.py` does."""
    scene = build("cornell")
    tracer, atlas, usual = Tracer.of(scene), build_atlas(scene, 64), area._NEAR
    for half, height in ((0.05, 0.54), (0.2, 0.54), (0.1, 0.01)):
        sides = {"half_u": [half, 0, 0], "half_v": [0, 0, half]}
        middle = [0.278, height, 0.28] if height > 0.1 else [0.1, height, 0.12]
        lighting = parse_lighting({"type": "rect", "center": middle, **sides, "radiance": [5, 5, 5]})
        for samples in (4, 16):
            for name, area._NEAR in (("by area", 0.0), ("by solid angle where near", usual)):
                maps, seconds = ours(tracer, atlas, lighting, samples)
                error = spread(maps, atlas.area)
                way = f"{100 * half:3.0f} cm half, at {height} m, {samples:2} samples, {name}"
                print(f"{way:62} {error:.4f}  {seconds:.4f} s  {error * seconds**0.5:.5f}")


if __name__ == "__main__":
    if sys.argv[1:] == ["near"]:
        near()
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else RESOLUTION)
