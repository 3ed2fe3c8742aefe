"""How many bytes does an engine load? The paper's section 6.5.

Question: do the paper's 64 MB of basis textures and 36 KB of matrix follow from its own numbers, and what do exports weigh?
Command:  python experiments/paper_storage.py            minutes: bakes the Cornell box at 1024²
          python experiments/paper_storage.py --quick    at 64², with few points
Answer:   docs/paper.md

Textures are counted twice: decoded, as they lie in graphics memory, and as EXR files on disk, which are compressed. Empty
texels of the atlas count in the first and cost next to nothing in the second. Maps are of few lightings and rays, which
matters to compression alone: noise does not compress. The bake and the rows lie in runs/storage-SIDE, so that a run that was
stopped goes on where it was; delete that folder after a change of the export. KiB and MiB are powers of two, which is what the
paper's 64 MB is.
"""

import itertools
import json
import sys
import tempfile
from pathlib import Path

import ddprt
from ddprt.config import load_config
from ddprt.dataset.store import Dataset
from ddprt.export.formats.exr import LAYER
from ddprt.export.textures import export_textures
from ddprt.methods.svd_ridge import LinearTransfer
from ddprt.runtime.model import Model

KIB, MIB = 2**10, 2**20
FLOAT, HALF = 4, 2
BASES, SIDE, POINTS = 16, 1024, 256  # of the paper's figures


def texture_bytes(bases: int, side: int, width: int, *, channels: str = "mono") -> int:
    """Bases packed four to an RGBA texture (mono), or one to an RGB texture each (multi), decoded.

    Args:
      bases: the mean counted in where it shares their textures, as the paper's does.
      side: texels per side.
      width: bytes of a number.
      channels: "mono" or "multi".
    """
    layers, each = (-(-bases // LAYER), LAYER) if channels == "mono" else (bases, 3)
    return layers * each * side * side * width


def matrix_bytes(bases: int, points: int, *, matrices: int = 1, width: int = FLOAT) -> int:
    return matrices * bases * points * width


def on_disk(model: Model, folder: Path, precision: str) -> dict[str, int]:
    """Bytes of an export by kind of file."""
    found = {"textures": 0, "matrices": 0, "points": 0, "trust": 0, "manifest": 0}
    kinds = {
        "transfer.safetensors": "matrices",
        "points.json": "points",
        "trust.safetensors": "trust",
        "manifest.json": "manifest",
    }
    for path in export_textures(model, folder, precision=precision):
        found[kinds.get(path.name, "textures")] += path.stat().st_size
    return found


def main(quick: bool) -> None:
    arithmetic()
    side, points = (64, 64) if quick else (SIDE, POINTS)
    changes = {"atlas.resolution": str(side), "points.count": str(points), "lightings.train": "32", "lightings.validation": "1"}
    changes |= {"lightings.test": "1", "transport.target_noise": "0.1" if quick else "0.02"}
    kept = Path("runs") / f"storage-{side}"
    data = ddprt.bake(ddprt.load_scene("cornell"), config=load_config("configs/cornell.toml", changes), out=kept / "data")
    known = json.loads((kept / "rows.json").read_text()) if (kept / "rows.json").is_file() else {}
    covered = data.covered.mean()
    print(
        f"\nours: Cornell box at {side}², {covered:.0%} of the texels covered, {BASES} bases, {points} points of 8 samples each"
    )
    print("| space | channels | precision | textures decoded | on disk | matrices | points | trust | manifest |")
    print("| --- " * 9 + "|")
    for space, channels, precision in itertools.product(("linear", "gamma"), ("mono", "multi"), ("half", "float")):
        row = f"{space} {channels} {precision}"
        if row not in known:
            known[row] = weighed(data, points, space, channels, precision)
            (kept / "rows.json").write_text(json.dumps(known))
        files = dict(known[row])
        decoded = texture_bytes(BASES, side, HALF if precision == "half" else FLOAT, channels=channels)
        cells = [
            f"{decoded / MIB:.1f} MiB",
            f"{files.pop('textures') / MIB:.1f} MiB",
            *(f"{n / KIB:.0f} KiB" for n in files.values()),
        ]
        print(f"| {space} | {channels} | {precision} | " + " | ".join(cells) + " |", flush=True)


def weighed(data: Dataset, points: int, space: str, channels: str, precision: str) -> dict[str, int]:
    """Bytes of one way to fit and export."""
    model = ddprt.fit(data, bases=BASES, points=points, space=space, channels=channels)
    assert isinstance(model.relighter, LinearTransfer)
    if model.relighter.basis.shape[0] != BASES:
        raise SystemExit(f"got {model.relighter.basis.shape[0]} bases, expected {BASES}: the data has no more")
    with tempfile.TemporaryDirectory() as folder:
        return on_disk(model, Path(folder), precision)


def arithmetic() -> None:
    """What the paper's own numbers come to."""
    print("textures at 1024², mono, MiB: float / half")
    for bases in (4, 16, 64):
        both = [texture_bytes(bases, SIDE, width) / MIB for width in (FLOAT, HALF)]
        print(f"| {bases} bases | {-(-bases // LAYER)} textures | {both[0]:.0f} / {both[1]:.0f} |")
    print("matrix for 256 points and 16 bases, KiB (the paper: 36 KB)")
    for what, size in readings().items():
        print(f"| {what} | {size / KIB:.1f} |")
    print("The paper weighs nothing else. Its subsurface, hair and animated assets have no row: it tells no bytes of them, and")
    print("ddprt has none of the three.")


def readings() -> dict[str, int]:
    """Ways to count the paper's matrix."""
    return {
        "one matrix": matrix_bytes(BASES, POINTS),
        "one matrix, the mean needs no row": matrix_bytes(BASES - 1, POINTS),
        "three matrices (mono channel)": matrix_bytes(BASES, POINTS, matrices=3),
        "three matrices, the mean needs no row": matrix_bytes(BASES - 1, POINTS, matrices=3),
        "three matrices in half floats": matrix_bytes(BASES, POINTS, matrices=3, width=HALF),
        "three matrices of 12 rows, which is what 36 KiB would take": matrix_bytes(12, POINTS, matrices=3),
    }


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
