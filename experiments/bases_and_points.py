"""Error against number of bases, for several numbers of measurement points: the paper's Figure 14.

Question: how close to the projection floor does the transfer come, and what do more points buy?
Command:  python experiments/bases_and_points.py [CONFIG] [points ...]
Answer:   docs/results.md
"""

import sys
from pathlib import Path

import ddprt
from ddprt.config import load_config
from ddprt.report.evaluate import bases_curve
from ddprt.report.metrics import Truth


def main(source: str = "configs/cornell.toml", *counts: str) -> None:
    numbers = [int(count) for count in counts] or [128, 512]
    config = load_config(source, {"points.count": str(max(numbers))})
    folder = Path("runs") / f"{Path(source).stem}-points"
    data = ddprt.bake(ddprt.load_scene(config.scene.name), config=config, out=folder)
    test = data.split("test")
    truth = Truth(data.maps("indirect", test), data.area)
    print(f"noise floor {truth.relative_rmse(data.maps('noise', test)):.4f}")
    print("points  bases  transfer  projection  ratio")
    for points in numbers:
        fewer = config.model_copy(update={"fit": config.fit.model_copy(update={"points": points})})
        for bases, error, floor in bases_curve(data, fewer, truth):
            print(f"{points:6d}  {bases:5d}  {error:8.4f}  {floor:10.4f}  {error / floor:5.3f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
