"""What geometry that reaches through texels does to a lightmap, before and after only what is in the open is kept.

Question: how much light gets through a wall thinner than a texel, and how many floor texels beside boxes are too dark?
Command:  python experiments/faults.py [PICTURE.png] [ATLAS RESOLUTION]
"""

import sys
from pathlib import Path

import numpy as np

import ddprt
from ddprt.lights import parse_lighting
from ddprt.report.view import Camera, exposure_for, png, take_view, tonemap
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Landing, Receivers, seen_from
from ddprt.transport.openness import open_atlas
from ddprt.transport.reference import on_texels, trace_reference

LAMP = parse_lighting({"type": "point", "position": [0.45, 0.9, 0.6], "intensity": [1, 1, 1]})
RAYS, PATHS, TRUTH, BOUNCES, PIXELS, SENDERS, STOPS = 256, 64, 4096, 12, 420, 64, 6
VIEWS = (
    Camera((0.75, 0.75, -0.15), (0.42, 0.05, 0.4), 35.0, 1.0),  # boxes on the lit floor
    Camera((1.55, 0.9, 0.6), (1.02, 0.0, 0.6), 60.0, 1.0),  # the foot of the wall in the dark room
)


def main(out: str = "faults.png", resolution: str = "128") -> None:
    scene = ddprt.load_scene("faults")
    tracer, before = Tracer.of(scene), build_atlas(scene, int(resolution))
    after, facts = open_atlas(tracer, before, scene)
    print(f"{before.count} texels; {facts}")
    light = {"before": bake(tracer, before, scene), "after": bake(tracer, after, scene)}
    for (name, maps), atlas in zip(light.items(), (before, after), strict=True):
        dark = atlas.position[:, 0] - 1 > 0.01 + (atlas.position[:, 2] - 0.6) * np.tan(np.radians(7))
        power = atlas.area * maps[1][:, 0]
        lit = power[~dark].sum()
        print(f"{name:6s}  indirect light in the dark room: {power[dark].sum() / lit:.2e} of the lit room's, ", end="")
        print(f"brightest texel {maps[1][dark, 0].max() / (lit / atlas.area[~dark].sum()):.2e} of its mean")

    index = before.slot.ravel()[after.texel]
    floor = np.flatnonzero(
        (after.area < 0.999 * before.area[index]) & (np.abs(after.position[:, 1]) < 1e-6) & (after.position[:, 0] < 0.8)
    )
    truth = trace_reference(tracer, scene, LAMP, on_texels(tracer, after, floor), len(floor), TRUTH, seed=1)
    total, noise = (truth.direct + truth.indirect)[:, 0], np.sqrt(truth.direct_variance + truth.indirect_variance)[:, 0]
    for name, row in (("before", index[floor]), ("after", floor)):
        value = sum(maps[row, 0] for maps in light[name])
        off = np.sqrt(np.mean((value - total) ** 2) / np.mean(total**2))
        dim, bright = np.mean(value < 0.9 * total - 3 * noise), np.mean(value > 1.1 * total + 3 * noise)
        print(f"{name:6s}  {len(floor)} trimmed floor texels: {dim:.0%} more than 10 % too dark, ", end="")
        print(f"{bright:.0%} too bright, RMS error {off:.1%}")

    exposure = exposure_for(sum(light["after"]))
    rows = []
    for camera, stops in zip(VIEWS, (exposure, exposure + STOPS), strict=True):
        pair = [
            tonemap(take_view(tracer, atlas.uv, atlas.slot >= 0, camera, PIXELS).render(sum(light[name])), stops)
            for name, atlas in (("before", before), ("after", after))
        ]
        rows.append(np.concatenate(pair, 1))
    Path(out).write_bytes(png(np.concatenate(rows)))
    print(f"{out}: left before, right after; below the dark room, {STOPS} stops brighter")


def bake(tracer: Tracer, atlas: Atlas, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Direct light, and indirect light gathered from blocks of texels."""
    start = on_texels(tracer, atlas, np.arange(atlas.count))
    direct = trace_reference(tracer, scene, LAMP, start, atlas.count, PATHS, seed=0, bounces=0).direct
    senders = atlas.senders(max(1, atlas.resolution // SENDERS))
    landing, receivers = Landing.of(atlas, senders.of_texel), Receivers.texels(atlas, RAYS, 0, "faults")
    cells = [
        np.concatenate([seen.cells for seen in seen_from(tracer, receivers, tile, landing)]).T for tile in receivers.tiles()
    ]
    share = atlas.area / senders.area[senders.of_texel]
    indirect = np.zeros_like(direct)
    for _ in range(BOUNCES):
        light = np.stack([np.bincount(senders.of_texel, share * (direct + indirect)[:, c]) for c in range(3)], 1)
        radiosity = np.concatenate([senders.albedo * light, np.zeros((2, 3))])  # negative cells are dark
        indirect = np.concatenate([radiosity[part].mean(1) for part in cells])
    return direct, indirect


if __name__ == "__main__":
    main(*sys.argv[1:])
