"""The picture on top of the README.

Question: what does one held-out lighting look like: direct, ours, reference, difference?
Command:  python experiments/hero.py            (after `make cornell`)
Figure:   docs/hero.png
"""

import sys
from pathlib import Path

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.report.figures import hero
from ddprt.report.metrics import Truth
from ddprt.report.view import default_camera, take_view
from ddprt.scene.atlas import build_atlas
from ddprt.transport.embree import Tracer


def main(run: Path = Path("runs/cornell"), out: Path = Path("docs/hero.png")) -> None:
    config = load_config(run / "config.toml")
    data, model = ddprt.open_dataset(run / "dataset"), ddprt.load_model(run / "model.ddprt")
    scene = ddprt.load_scene(config.scene.name)
    atlas = build_atlas(scene, config.atlas.resolution, config.atlas.padding)
    view = take_view(Tracer.of(scene), atlas.uv, data.covered, default_camera(scene), height=420)
    test = data.split("test")
    truth = Truth(data.maps("indirect", test), data.area)
    predicted = model.predict(data.values(test, model.points, model.quantity))
    errors = truth.errors_per_lighting(predicted)
    row = int(np.argsort(errors)[len(errors) // 2])  # the median, not the best
    direct = data.maps("direct", [test[row]])[0]
    title = f"lighting {test[row]}, the median of {len(test)} held out: {100 * errors[row]:.1f} % off"
    out.write_bytes(hero(direct, predicted[row], truth.reference[row], data.gbuffer["albedo"], data.covered, view, title=title))
    print(out, title)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
