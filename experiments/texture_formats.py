"""Error against bytes of every format of textures.

Question: what do 8 bits a channel or BC6H cost beside half and float, what does fitting the transfer to rounded textures gain,
          and which range should maps be moved to before BC6H?
Command:  python experiments/texture_formats.py                      configs/cornell.toml, minutes
          python experiments/texture_formats.py --resolution 1024    the same with more texels
          python experiments/texture_formats.py --quick              at 128², 64 lightings to learn from
Answer:   docs/export.md, "Formats"

BC6H needs `pip install "ddprt[textures]"`. The bake lies in runs/formats-SIDE. The last line is JSON: bytes and held-out
relative RMSE of each format, and whether BC6H keeps within 10 % of the error of floats.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import ddprt
from ddprt.config import load_config
from ddprt.errors import UserError
from ddprt.export.formats.bc6h import LAYER, encode_bc6h
from ddprt.export.formats.bc6h_decode import decode_bc6h
from ddprt.export.formats.format import layered, unlayered
from ddprt.export.formats.format import ranges as moved
from ddprt.export.refit import Stock, transfer_for
from ddprt.export.stored import over_texels, weights_of
from ddprt.export.table import HeldOut, format_table, told
from ddprt.export.textures import textures
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.report.metrics import Truth
from ddprt.runtime.model import Model
from ddprt.runtime.precision import composed

BASES = 16
QUICK = {"atlas.resolution": "128", "lightings.train": "64", "lightings.validation": "4", "lightings.test": "16"}
QUICK |= {"transport.target_noise": "0.02"}
RANGES = ((0.0, 1.0), (0.25, 1.25), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0), (0.0, 60000.0))


def main() -> None:
    """Bakes, fits and tells the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--resolution", type=int)
    asked = parser.parse_args()
    changes = (QUICK if asked.quick else {}) | ({"atlas.resolution": str(asked.resolution)} if asked.resolution else {})
    config = load_config("configs/cornell.toml", changes)
    folder = Path("runs") / f"formats-{config.atlas.resolution}"
    data = ddprt.bake(ddprt.load_scene("cornell"), config=config, out=folder / "data")
    test = data.split("test")
    formats: dict[str, dict[str, float | int | None]] = {}
    for space, channels in (("linear", "mono"), ("gamma", "mono"), ("linear", "multi")):
        model = ddprt.fit(data, bases=BASES, points=config.points.count, space=space, channels=channels)
        held_out = HeldOut(data.values(test, model.points, model.quantity), data.maps("indirect", test))
        print(f"\n{space}, {channels}: {BASES} bases at {config.atlas.resolution}²")
        rows, plain = (format_table(model, held_out, refit=refit) for refit in (True, False))
        print(told(rows))
        print("held out without fitting anew:", {row.name: row.held_out_relative_rmse for row in plain if not row.skipped})
        if (space, channels) == ("linear", "mono"):
            formats = {row.name: {"bytes": row.bytes, "relative_rmse": row.held_out_relative_rmse} for row in rows}
            skipped = {row.name: row.skipped for row in rows if row.skipped}
            ranges(model, held_out)
    exact, small = (formats[name]["relative_rmse"] for name in ("exact, float32", "bc6h"))
    rise = None if not exact or small is None else small / exact - 1
    kept = None if rise is None else rise <= 0.1
    print(json.dumps({"formats": formats, "skipped": skipped, "bc6h_rise": rise, "bc6h_within_a_tenth": kept}))


def ranges(model: Model, held_out: HeldOut) -> None:
    """Rounding and held-out error of BC6H, all else equal, by the range that maps are moved to."""
    truth = Truth(held_out.indirect, np.asarray(model.area, np.float64))
    maps, _ = textures(model)
    height, width = maps.known.shape
    exact = over_texels(model, maps.values)
    assert isinstance(model.relighter, LinearTransfer)
    for low, high in RANGES:
        scale, bias, t = moved(maps, low, high)
        try:
            data = encode_bc6h(layered(t, LAYER))
        except UserError as problem:
            print(problem)
            return
        size = height * width
        layers = np.stack([decode_bc6h(data[at : at + size], height, width) for at in range(0, len(data), size)])
        t = over_texels(model, unlayered(layers, maps))
        found = transfer_for(model.relighter, Stock(exact, t, scale, bias, weights_of(model)))
        parts = {"matrix": found.matrix, "offset": found.offset, "intercept": found.intercept}
        light = composed(model, np.concatenate([t, np.ones_like(t[:1])]), **parts).predict(held_out.values, constant=False)
        error = truth.relative_rmse(light - held_out.indirect)
        print(f"BC6H of maps from {low:g} to {high:g}: rounding {found.refitted:.4f}, held out {error:.5f}")


if __name__ == "__main__":
    main()
