"""What light passes through, fur and fog: error over bases, beside the paper's Figures 13 and 14.

Question: how well do 4, 16 and 64 bases answer where light does more than leave surfaces, in linear and gamma space?
Command:  python experiments/paper_effects.py            minutes; writes docs/paper-effects.png
          python experiments/paper_effects.py --quick    small and noisy, the picture into runs/paper-quick
Answer:   docs/paper.md; what moves is asked by animation.py

128 lamps around (in fog: in the room) to learn from, 32 held out, 256 points, mono channel; errors and fit as in
paper_figures.py.
Only exitant texels count where a body or strands have them: the ground beside them is what every scene has.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from paper_figures import BASES, ENCODINGS, Held, average_rmse, curve, draw_pictures, fit, rendered

import ddprt
from ddprt.config import checked
from ddprt.dataset.store import Dataset
from ddprt.report.metrics import Truth

AROUND = {"distribution": "around"}
SCENES: dict[str, dict[str, Any]] = {
    "statue-marble": {
        "atlas": {"resolution": 128},
        "lightings": AROUND,
        "transport": {"samples": 256, "test_samples": 1024},
    },
    "furball": {
        "atlas": {"resolution": 128},
        "lightings": AROUND,
        "points": {"on": "hull"},
        "transport": {"samples": 128, "test_samples": 1024},
    },
    "foggy-room": {
        "atlas": {"resolution": 64},
        "lightings": {"region_low": [0.1, 0.5, 0.1], "region_high": [0.9, 0.9, 0.9]},
        "transport": {"samples": 128, "test_samples": 1024},
    },
}
SHARED = {"lightings": {"train": 128, "validation": 1, "test": 32}, "points": {"count": 256, "supersample": 8}}
QUICK = {
    "atlas": {"resolution": 96},
    "lightings": {"train": 24, "test": 4},
    "points": {"count": 64},
    "transport": {"samples": 16, "test_samples": 32},
}
SPACES = {label.split()[0]: encoding for label, encoding in ENCODINGS.items() if label.endswith("mono")}


def bake(name: str, quick: bool) -> Dataset:
    sections: dict[str, dict[str, Any]] = {"scene": {"name": name}}
    for part in (SHARED, SCENES[name], QUICK if quick else {}):
        sections |= {key: {**sections.get(key, {}), **values} for key, values in part.items()}
    out = Path("runs") / f"paper-{name}{'-quick' if quick else ''}"
    return ddprt.bake(ddprt.load_scene(name), config=checked(sections), out=out)


def of_effect(data: Dataset, held: Held) -> Held:
    """The same, of texels that light passes where there are any: others weigh nothing."""
    exitant = data.exitant
    return held if exitant is None else replace(held, truth=Truth(held.truth.reference, np.where(exitant, data.area, 0)))


def main(quick: bool) -> None:
    pictures = {}
    print("| scene, space | error | " + " | ".join(f"{bases} bases" for bases in BASES) + " |")
    print("| --- " * (2 + len(BASES)) + "|")
    for name in SCENES:
        data = bake(name, quick)
        whole = Held.of(data, data.description["points"]["count"])
        held, noise = of_effect(data, whole), data.maps("noise", data.split("test"))
        floors = average_rmse(noise, held.unit), float(held.truth.relative_rmse(noise) or 0.0)
        for space, encoding in SPACES.items():
            model = fit(data, "ours", encoding)
            rows = curve(data, model, held)
            for which, metric in enumerate(("paper's, all texels", "ours")):
                cells = [f"{transfer[which]:.4f} / {floor[which]:.4f}" for _, transfer, floor in rows]
                print(f"| {name}, {space} | {metric}; noise {floors[which]:.4f} | " + " | ".join(cells) + " |", flush=True)
            if space == "linear":
                pictures[name] = rendered(data, model, whole)
    folder = Path("runs/paper-quick" if quick else "docs")
    folder.mkdir(parents=True, exist_ok=True)
    draw_pictures(pictures, folder / "paper-effects.png")


if __name__ == "__main__":
    import matplotlib

    matplotlib.use("Agg")
    main("--quick" in sys.argv[1:])
