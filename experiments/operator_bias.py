"""Bias of the operator against the unbiased reference, over sender resolutions.

Question: what does averaging light over senders cost?
Command:  python experiments/operator_bias.py [SCENE] [sender resolutions ...]
Answer:   docs/results.md
"""

import sys
import time

import numpy as np

import ddprt
from ddprt import seeds
from ddprt.config import load_config
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.atlas import build_atlas
from ddprt.transport.direct import centred, direct_irradiance
from ddprt.transport.embree import Tracer
from ddprt.transport.operator import operator_indirect
from ddprt.transport.reference import on_texels, trace_reference

LIGHTINGS, TEXELS, PATHS, RAYS, DIRECT = 8, 512, 4096, 4096, 16


def main(name: str = "cornell", *sides: str) -> None:
    config = load_config("configs/cornell.toml")
    scene = ddprt.load_scene(name)
    atlas, tracer = build_atlas(scene, config.atlas.resolution), Tracer.of(scene)
    draw = draw_lightings(
        config.lightings, "test", LIGHTINGS, bounds=scene.bounds, clearance=tracer.clearance, seed=config.seed
    )
    chosen = np.sort(seeds.stream(0, "bias").choice(atlas.count, TEXELS, replace=False))
    truth, variance = [], []
    for index, lighting in enumerate(draw.lightings):
        paths = trace_reference(tracer, scene, lighting, on_texels(tracer, atlas, chosen), TEXELS, PATHS, seed=index)
        truth.append(paths.indirect)
        variance.append(paths.indirect_variance)
    reference = np.array(truth)
    group = np.repeat(np.arange(atlas.count), DIRECT)
    place, triangle = atlas.sampler.sample(group, seeds.stream(0, "places").random((len(group), 2), np.float32))
    direct = np.stack(
        [
            direct_irradiance(
                tracer, centred(tracer, lighting), place, tracer.normals[triangle], np.zeros((1, len(group), 2), np.float32)
            )
            .reshape(atlas.count, DIRECT, 3)
            .mean(1)
            for lighting in draw.lightings
        ]
    )
    floor = np.sqrt(np.mean(variance)) / reference.mean()
    print(f"{name}: relative RMSE of the reference itself {floor:.4f}")
    print("sender side  senders  relative RMSE  less the reference's noise  relative bias of the mean  seconds")
    for side in [int(side) for side in sides] or [16, 32, 64, 128]:
        start = time.perf_counter()
        baked = operator_indirect(tracer, atlas, direct, samples=RAYS, sender_resolution=side, seed=0, stream="bias")
        seconds = time.perf_counter() - start
        error = baked.indirect[:, chosen] - reference
        rmse = np.sqrt(np.mean(error**2)) / reference.mean()
        clean = np.sqrt(max(rmse**2 - floor**2, 0))
        bias = error.mean() / reference.mean()
        print(f"{side:11d}  {baked.senders:7d}  {rmse:13.4f}  {clean:26.4f}  {bias:+25.4f}  {seconds:7.1f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
