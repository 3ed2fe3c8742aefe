"""What does lighting samples from behind their surface do where there are few of them?

Question: points.depth = "auto" calls a lamp near where it is nearer to a surface than samples to each other. With few samples
          all lamps are near, and the depth is a large part of the room: does it still help?
Command:  python experiments/few_samples.py
Answer:   docs/stability.md
"""

import ddprt
from ddprt.config import load_config
from ddprt.report.evaluate import evaluate

FEW = ((4, 1), (8, 2), (16, 1), (16, 4), (32, 2), (64, 1), (64, 8))
DEPTHS = ("0", "auto")
SETTINGS = {
    "lightings.train": "64",
    "lightings.validation": "8",
    "lightings.test": "24",
    "atlas.resolution": "40",
    "transport.samples": "48",
    "transport.test_samples": "48",
}


def main() -> None:
    print(f"{'scene':10}{'points':>7}{'samples':>8}{'spacing m':>10}" + "".join(f"{'depth ' + depth:>12}" for depth in DEPTHS))
    for name in ("cornell", "corridor"):
        scene = ddprt.load_scene(name)
        for points, each in FEW:
            errors = []
            for depth in DEPTHS:
                places = {"points.count": str(points), "points.supersample": str(each), "points.depth": depth}
                data = ddprt.bake(scene, config=load_config(None, SETTINGS | places))
                scores = evaluate(data, {"svd-ridge": ddprt.fit(data)}, {}).metrics["methods"]["svd-ridge"]
                errors.append(scores["relative_rmse"])
            row = "".join(f"{error:12.3f}" for error in errors)
            print(f"{name:10}{points:7}{points * each:8}{data.samples.spacing:10.2f}{row}", flush=True)


if __name__ == "__main__":
    main()
