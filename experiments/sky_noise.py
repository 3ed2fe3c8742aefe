"""A sky of 1024 x 512 pixels: noise of direct light on texels for the seconds spent, against Mitsuba's samplers.

Question: how noisy is direct irradiance on all texels under a sky, at equal time, with each way of sampling it?
Command:  python experiments/sky_noise.py [SCENE] [resolution]
Answer:   docs/effects.md, "Environment lights"

Both look at the same picture (Mitsuba interpolates between its pixels) from places laid out before the clock starts; time is
that of all cores together, shadow rays included. Noise is that of one map by two independent ones. `noise * sqrt(time)` is what
counts: where errors fall with the root of the number of samples it does not depend on that number. Samples are spread evenly on
both sides, so that it falls, and rows of about equal time are to be compared. Needs the extra "reference" for Mitsuba's rows.

Ours: the sampler of `lights/sky.py`; pixels by luminance alone; the cosine alone; what exceeds half, or twice, of the mean as
the bright part.
Mitsuba: emitter sampling alone; emitter and cosine, a sample of each, combined by the balance heuristic; the same with its
`mis_compensation`.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from peer_mitsuba import MitsubaBaker

import ddprt
from ddprt import seeds
from ddprt.errors import UserError
from ddprt.lights import EnvironmentLight, parse_lighting, sky
from ddprt.lights.panorama import SKIES, read_panorama
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.direct import Texels
from ddprt.transport.embree import Tracer

SAMPLES = (4, 16, 64)
TURNS = (0.0, 70.0, 140.0, 210.0)
REPEATS = 3
"""Of which the quickest counts."""

Map = Callable[[float, int, int], np.ndarray]
"""(texels, 3) direct light under the sky turned by so many degrees, with so many samples and a seed."""


def smooth() -> np.ndarray:
    """The sky of `sun-sky` without its sun."""
    pixels = SKIES["sun-sky"]().copy()
    pixels[pixels.max(2) > 1] = pixels[0, 0]
    return pixels


def by_luminance(found: sky.Sky) -> sky.Sky:
    """The whole picture as its bright part, and almost nothing left for the cosine."""
    return with_mean(found, 0.0, 1 - 1e-9)


def by_cosine(found: sky.Sky) -> sky.Sky:
    return replace(found, share=0.0)


def above_half(found: sky.Sky) -> sky.Sky:
    return with_mean(found, found.mean / 2, 0.5)


def above_twice(found: sky.Sky) -> sky.Sky:
    return with_mean(found, 2 * found.mean, 0.5)


def with_mean(found: sky.Sky, mean: float, share: float) -> sky.Sky:
    """Tables for another part of the light as the bright one."""
    flux = np.maximum(found.radiance @ sky.LUMINANCE - mean, 0) * -np.diff(found.heights)[:, None]
    flux *= 2 * np.pi / flux.shape[1]
    rows, along = sky._cumulative(flux.sum(1)[None]), sky._cumulative(flux)
    guides = {"row_guide": sky._guide(rows)[0], "along_guide": sky._guide(along)}
    return replace(found, rows=rows[0], along=along, mean=mean, bright=float(flux.sum()), share=share, **guides)


def ours(tracer: Tracer, atlas: Atlas) -> Map:
    """On one thread: a bake of many lightings has one of them on each."""
    places: dict[tuple[int, int], Texels] = {}

    def bake(turn: float, samples: int, seed: int) -> np.ndarray:
        if (samples, seed % 2) not in places:
            places[samples, seed % 2] = Texels.of(tracer, atlas, samples, seeds.stream(seed % 2, "sky places"))
        lighting = parse_lighting(EnvironmentLight(image="sun-sky", rotation_deg=turn))
        return places[samples, seed % 2].irradiance(lighting, seeds.stream(seed, "sky", samples))

    return bake


class MitsubaSky(MitsubaBaker):
    """Direct light of a sky by one kernel; the baker's places, sampler and mesh."""

    def __init__(self, scene: Scene, atlas: Atlas, pixels: np.ndarray, combined: bool, compensated: bool) -> None:
        super().__init__(scene, atlas)
        mi = self.mi
        rolled = np.ascontiguousarray(np.roll(pixels, pixels.shape[1] // 2, 1))
        light = {"type": "envmap", "bitmap": mi.Bitmap(rolled), "mis_compensation": compensated}
        self.lit = mi.load_dict({"type": "scene", "mesh": self._mesh(), "sky": light})
        self.handles, self.combined = mi.traverse(self.lit), combined

    def direct(self, turn: float, samples: int, seed: int) -> np.ndarray:
        mi, dr = self.mi, self.dr
        self.handles["sky.to_world"] = mi.Transform4f().rotate([0, 1, 0], turn)
        self.handles.update()
        self.sampler.set_sample_count(samples)
        self.sampler.set_samples_per_wavefront(samples)
        shift = dr.opaque(mi.UInt32, seeds.number(seed, "peer turn") % self.pool)
        self.sampler.seed(seeds.number(seed, "peer paths"), self.texels * samples)
        path = dr.arange(mi.UInt32, self.texels * samples)
        texel = path // samples
        place = texel * self.pool + (path - texel * samples + shift) % self.pool
        facing = dr.gather(mi.Normal3f, self.normals, dr.gather(mi.UInt32, self.triangle, place))
        here = dr.zeros(mi.SurfaceInteraction3f, self.texels * samples)
        here.p, here.n, here.sh_frame = dr.gather(mi.Point3f, self.place, place), facing, mi.Frame3f(facing)
        light = self._by_emitter(here) + (self._by_cosine(here) if self.combined else 0)
        total = dr.zeros(mi.Color3f, self.texels)
        dr.scatter_reduce(dr.ReduceOp.Add, total, light, texel)
        dr.eval(total)
        return np.ascontiguousarray(np.array(total / samples, np.float32).T)

    def _by_emitter(self, here: Any) -> Any:
        mi, dr = self.mi, self.dr
        there, weight = self.lit.sample_emitter_direction(here, self.sampler.next_2d(), False)
        cosine = dr.dot(here.n, there.d)
        active = cosine > 0
        active &= ~self.lit.ray_test(mi.Ray3f(here.p, there.d), active)
        if self.combined:
            weight *= there.pdf / (there.pdf + cosine / dr.pi)
        return dr.select(active, weight * cosine, 0)

    def _by_cosine(self, here: Any) -> Any:
        mi, dr = self.mi, self.dr
        local = mi.warp.square_to_cosine_hemisphere(self.sampler.next_2d())
        towards = here.sh_frame.to_world(local)
        active = ~self.lit.ray_test(mi.Ray3f(here.p, towards))
        emitter, seen = self.lit.emitters()[0], dr.zeros(mi.SurfaceInteraction3f, dr.width(towards))
        seen.wi = -towards
        sample = dr.zeros(mi.DirectionSample3f)
        sample.d = towards
        density = emitter.pdf_direction(here, sample)
        cosine = local.z / dr.pi
        return dr.select(active, emitter.eval(seen) * dr.pi * cosine / (cosine + density), 0)


def rows(name: str, bake: Map) -> None:
    """Noise and seconds of a way of sampling."""
    for samples in SAMPLES:
        bake(TURNS[0], samples, 0)
        noise, brightness, seconds = 0.0, 0.0, 0.0
        for turn in TURNS:
            maps, best = [], np.inf
            for seed in range(2 * REPEATS):
                start = time.process_time()
                maps.append(bake(turn, samples, 2 + seed))
                best = min(best, time.process_time() - start)
            seconds += best / len(TURNS)
            noise += float(np.mean((maps[0] - maps[1]).astype(np.float64) ** 2) / 2)
            brightness += float(np.mean(maps))
        relative = np.sqrt(noise * len(TURNS)) / brightness
        print(
            f"{name:<34}{samples:>8}{relative:>10.4f}{1e3 * seconds:>10.1f}{relative * np.sqrt(1e3 * seconds):>18.3f}",
            flush=True,
        )


def main(name: str = "statue", resolution: int = 128) -> None:
    scene = ddprt.load_scene(name)
    atlas = build_atlas(scene, resolution)
    tracer = Tracer.of(scene)
    print(f"{name}, {atlas.count} texels, {len(TURNS)} turns of a sky; ms of all cores together")
    pictures = {"with a sun": read_panorama("sun-sky"), "smooth": smooth()}
    for title, pixels in pictures.items():
        print(f"\n{title:<34}{'samples':>8}{'noise':>10}{'ms':>10}{'noise * sqrt(ms)':>18}")
        found, load = sky.Sky.of(pixels), sky.load_sky
        for label, change in {
            "ours": None, "ours, luminance alone": by_luminance, "ours, cosine alone": by_cosine,
            "ours, above half the mean": above_half, "ours, above twice the mean": above_twice,
        }.items():  # fmt: skip
            changed = change(found) if change else found
            if not changed.bright:
                print(f"{label}: the sky is nowhere so bright")
                continue
            sky.load_sky = lambda image, changed=changed: changed  # type: ignore[assignment]
            rows(label, ours(tracer, atlas))
        sky.load_sky = load
        for label, settings in {
            "Mitsuba, emitter": (False, False), "Mitsuba, both": (True, False), "Mitsuba, both, compensated": (True, True),
        }.items():  # fmt: skip
            try:
                rows(label, MitsubaSky(scene, atlas, pixels, *settings).direct)
            except UserError as error:
                print(f"{label}: {error}")


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
