"""What moves: one basis over keyframes, and one transfer matrix for all of them or one for each, in poses seen and unseen.

Question: what does a matrix for each keyframe bring over one for the whole animation, and what holds between keyframes?
Command:  python experiments/animation.py [--quick]     minutes; writes docs/animation.png; the last line is JSON
Answer:   docs/effects.md, Animation

The paper (section 5.4) says that for subsurface scattering one matrix worked well, and gives no number; its Figures 13 and 14
are of assets that stand still. An arm bows to a floor of two colours (half a circle and more in one second), under suns and
lamps about it; at poses half-way between keyframes nobody learned from, points follow the true motion. `own` is the bound: a
basis and a matrix of each keyframe's own, as of a scene that stands still.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.config import checked
from ddprt.dataset.animated import AnimatedData, bake_animation
from ddprt.report.animated import noise, picture, poses, score
from ddprt.report.metrics import Tally, Truth
from ddprt.runtime.animated import AnimatedModel
from ddprt.runtime.train import fit_config
from ddprt.runtime.train_animated import fit_animation
from ddprt.scene.poses import load_animation

BASES, QUICK_BASES = (4, 16, 64), (4, 16)
KEYS, QUICK_KEYS = (3, 5), (3,)


def settings(keys: int, quick: bool) -> dict[str, Any]:
    return {
        "scene": {"name": "bending"},
        "animation": {"keys": keys},
        "atlas": {"resolution": 48 if quick else 64},
        "lightings": {
            "train": 24 if quick else 64,
            "validation": 2,
            "test": 8,
            "distribution": "around",
            "kinds": ["directional"],
        },
        "points": {"count": 64 if quick else 128, "supersample": 4},
        "transport": {"samples": 64 if quick else 256, "test_samples": 128 if quick else 1024, "threads": 2},
        "fit": {"bases": 16},
    }


def own_bases(data: AnimatedData, config: Any) -> float | None:
    """Error at the keyframes of models that each keyframe has to itself."""
    tallies = []
    for part in data.keys:
        model, test = fit_config(part, config, "svd-ridge"), part.split("test")
        light = model.predict(part.values(test, model.points, model.quantity), constant=False)
        tallies.append(Truth(part.maps("indirect", test), part.area).tally(light))
    return Tally.joined(tallies).scores()["relative_rmse"]


def measure(keys: int, quick: bool, folder: str) -> tuple[dict[str, Any], AnimatedData, dict[str, AnimatedModel]]:
    plain = settings(keys, quick)
    data = bake_animation(load_animation("bending", keys=keys), config=checked(plain), out=f"{folder}/{keys}")
    rows: list[dict[str, Any]] = []
    kept: dict[str, AnimatedModel] = {}
    for space in ("linear", "gamma"):
        for bases in QUICK_BASES if quick else BASES:
            config = checked(plain | {"fit": {"bases": bases, "space": space}})
            models = fit_animation(data, config)
            kept = models if (space, bases) == ("linear", 16) else kept
            found = score(data, models)
            row = {"space": space, "bases": bases, "own": own_bases(data, config)}
            for way, own in found.items():
                row[way] = {name: own[name]["relative_rmse"] for name in ("seen", "between")}
            rows.append(row)
            cells = "  ".join(
                f"{way} {own['seen']:.3f} / {own['between']:.3f}" for way, own in row.items() if isinstance(own, dict)
            )
            print(f"{keys} keys  {space:6s} {bases:2d} bases  own {row['own']:.3f}  {cells}", flush=True)
    return {"keys": keys, "noise": noise(data), "rows": rows}, data, kept


def draw(data: AnimatedData, model: AnimatedModel, path: Path) -> None:
    """A keyframe and the poses about it that nobody learned from, indirect light alone, each under a sun of its own."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [pose for pose in poses(data) if 0 < pose.time < 1]
    shots = [picture(model, pose, 1, 330, lamps=False) for pose in shown]
    seen = np.logical_or.reduce([image[..., 3] > 0 for shot in shots for image in shot.values()])
    rows, columns = (np.flatnonzero(seen.any(axis)) for axis in (1, 0))
    figure, axes = plt.subplots(len(shown), 3, figsize=(9.6, 2.1 * len(shown)), layout="constrained")
    for row, pose, shot in zip(axes, shown, shots, strict=True):
        for axis, (name, image) in zip(row, shot.items(), strict=True):
            axis.imshow(np.clip(image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 0, 1))
            axis.set(xticks=[], yticks=[], frame_on=False)
            if pose is shown[0]:
                axis.set_title(f"{name} x 4" if name == "difference" else f"{name}, indirect light", fontsize=10)
        row[0].set_ylabel(f"{pose.time:.2f} s, {'a keyframe' if pose.seen else 'between'}", fontsize=10)
    figure.savefig(path, dpi=90)


def main() -> None:
    quick = "--quick" in sys.argv
    with tempfile.TemporaryDirectory(prefix="animation-") as folder:
        found = []
        for keys in QUICK_KEYS if quick else KEYS:
            record, data, models = measure(keys, quick, folder)
            found.append(record)
            if keys == 3 and not quick:
                draw(data, models["each"], Path(__file__).parents[1] / "docs" / "animation.png")
    print(json.dumps({"animation": found}))


if __name__ == "__main__":
    main()
