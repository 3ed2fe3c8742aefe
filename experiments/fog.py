"""What does fog do to the light of a room?

    python experiments/fog.py    # docs/fog.png

The Cornell box in clear air, in thin and in dense fog, under a spot lamp and with the indirect light alone: light that fog or
a wall has scattered before, on the walls. The air itself, which an engine would show too, is not drawn.
"""

import argparse
from pathlib import Path

import numpy as np

import ddprt
from ddprt.lights import parse_lighting
from ddprt.report.view import default_camera, exposure_for, png, take_view, tonemap
from ddprt.transport.embree import Tracer
from ddprt.transport.openness import build_open_atlas
from ddprt.transport.paths import trace_paths

SPOT = {
    "type": "spot", "position": [0.45, 0.5, 0.1], "direction": [-0.5, -1.0, 0.6], "intensity": [2.0, 2.0, 2.0],
    "inner_deg": 20.0, "outer_deg": 30.0,
}  # fmt: skip
FOGS = {"clear": None, "thin": 1.0, "dense": 0.15}
"""Mean free paths in metres of a room of 0.56 m."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", default="docs/fog.png")
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--resolution", type=int, default=64)
    asked = parser.parse_args()
    columns, stops = [], None
    for name, path in FOGS.items():
        fog = None if path is None else {"mean_free_path": path, "albedo": 0.95, "anisotropy": 0.3}
        scene = ddprt.load_scene("cornell", fog=fog)
        tracer = Tracer.of(scene)
        atlas, _ = build_open_atlas(tracer, scene, asked.resolution)
        light = np.zeros((1, atlas.count, 3), np.float32)
        for _ in trace_paths(
            tracer, scene, atlas, [parse_lighting(SPOT)], light, samples=asked.samples, seed=0, stream="picture"
        ):
            pass
        stops = exposure_for(light[0]) if stops is None else stops
        mean = atlas.area @ light[0] / atlas.area.sum()
        print(f"{name}: mean indirect irradiance {np.array2string(mean, precision=4)} W/m²")
        view = take_view(tracer, atlas.uv, atlas.slot >= 0, default_camera(scene), 320)
        columns.append(tonemap(view.render(light[0]), stops))
    Path(asked.out).write_bytes(png(np.concatenate(columns, 1)))


if __name__ == "__main__":
    main()
