"""What does each method ship to an engine, and what does a frame of it cost there?

Question: bytes of the export that a frame reads, microseconds that the processor takes to make a frame of measured light, and
          milliseconds of the shader on a lightmap of 256², for every method of `METHODS` on one dataset. The shader runs in
          a browser that renders in SOFTWARE (SwiftShader): it tells how methods compare, not what a graphics card takes.
Command:  python experiments/deployment.py [--quick] [--methods mlp nearest ...]
Answer:   docs/deployment.md
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.export.browser import browser, shaded
from ddprt.export.deployed import export_model
from ddprt.export.frame import Frames
from ddprt.export.golden import example_values
from ddprt.lights import parse_lighting
from ddprt.methods import known_methods, method_named
from ddprt.methods.learned import Learned
from ddprt.runtime.deployment import deployment_of
from ddprt.runtime.model import Model

SIDE = 256  # pixels of the lightmap that is drawn
LAMPS = {"atlas.resolution": "64", "lightings.train": "64", "lightings.validation": "16", "lightings.test": "8"}
QUICK = {"atlas.resolution": "32", "lightings.train": "16", "lightings.validation": "4", "lightings.test": "4"}
QUICK |= {"points.count": "32", "transport.samples": "16"}
SUNS = {"lightings.kinds": '["directional"]', "lightings.distribution": "around"}
WITHOUT_BASES = {"mean", "nearest", "sh-prt"}


def baked(quick: bool, suns: bool) -> Dataset:
    """The Cornell box under lamps; or, for the method that knows distant light alone, a statue under suns."""
    changes = (QUICK if quick else LAMPS) | (SUNS if suns else {})
    return ddprt.bake(ddprt.load_scene("statue" if suns else "cornell"), config=load_config(None, changes))


def fitted(name: str, data: Dataset, quick: bool) -> Model:
    """With 16 bases where a method has some; for a look, trained for a moment, which changes no cost unless a gate shuts."""
    options: dict[str, Any] = {} if name in WITHOUT_BASES else {"bases": 8 if quick else 16}
    if quick and issubclass(method_named(name), Learned):
        options["settings"] = {"steps": 100}
    return ddprt.fit(data, name, **options)


def microseconds(call: Any, times: int) -> float:
    """Median of many calls, each by itself."""
    taken = []
    for _ in range(times):
        begun = time.perf_counter_ns()
        call()
        taken.append(time.perf_counter_ns() - begun)
    return float(np.median(taken)) / 1000


def costs(name: str, model: Model, folder: Path, quick: bool) -> dict[str, Any]:
    """A row of the table."""
    export_model(model, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    told, found = manifest["deployment"], deployment_of(model)
    lighting = parse_lighting(list(found.example)) if found.example else None
    inputs = found.lights(lighting) if found.lights and lighting else {"values": example_values(model)}
    frames = Frames.read(folder)
    numbers = [manifest["matrix"]["file"], *([told["network"]] if told["network"] else [])]
    size = lambda names: sum((folder / one).stat().st_size for one in names)  # noqa: E731
    row: dict[str, Any] = {
        "method": name,
        "shape": told["shape"],
        "textures_kib": size([*manifest["layers"], *([manifest["mean"]] if manifest["mean"] else [])]) / 1024,
        "numbers_kib": size(numbers) / 1024,
        "frame_us": microseconds(lambda: frames.rows(inputs), 50 if quick else 500),
        "frame_bytes": 16 * sum(count for _, count in told["frame"].values()),
        "mflop": model.relighter.flops / 1e6,
        "reads": told["shader"].get("reads"),
        "shader_ms": None,
        "renderer": told["shader"].get("why", "no browser"),
    }
    if told["shader"]["file"] and browser() is not None:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            side = 64 if quick else SIDE
            ran = shaded(folder, frames.rows(inputs), Path(scratch), size=(side, side), batches=5 if quick else 25)
        row |= {"shader_ms": float(np.median(ran["milliseconds"])), "renderer": ran["renderer"]}
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """For docs/deployment.md."""
    head = "| method | shape | textures, KiB | numbers, KiB | frame, µs | shader, ms (software) | reads | Mflop counted |"
    lines = [head, "|" + " --- |" * 8]
    for row in rows:
        shader = "none" if row["shader_ms"] is None else f"{row['shader_ms']:.2f}"
        shipped = f"{row['textures_kib']:.0f} | {row['numbers_kib']:.1f} | {row['frame_us']:.0f}"
        lines.append(f"| {row['method']} | {row['shape']} | {shipped} | {shader} | {row['reads'] or ''} | {row['mflop']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Prints the table, and the rows as JSON in the last line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small dataset, eight bases and 64² pixels: for a look")
    parser.add_argument("--methods", nargs="+", default=list(known_methods()))
    asked = parser.parse_args()
    rows, data = [], {suns: baked(asked.quick, suns) for suns in {name == "sh-prt" for name in asked.methods}}
    with tempfile.TemporaryDirectory() as folder:
        for name in asked.methods:
            model = fitted(name, data[name == "sh-prt"], asked.quick)
            rows.append(costs(name, model, Path(folder) / name, asked.quick))
            print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    print(json.dumps({"quick": asked.quick, "rows": rows}))


if __name__ == "__main__":
    main()
