"""The folders of engines: a model in one file, loader, shader, notes, and golden numbers made from that file."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Bool, Float
from ddprt.errors import UserError
from ddprt.export.engines.listing import ENGINES
from ddprt.export.engines.packed import Packed
from ddprt.files import make_folder, write_text, written_whole
from ddprt.runtime.deployment import Deployment

MODEL, GOLDEN, NUMBERS, README = "model.bin", "golden.json", "golden.txt", "README.md"
TEXELS = 5


def check_engines(found: Deployment, method: str) -> None:
    """Refuses what takes more than a matrix a frame and a sum a texel, which is all that the loaders do.

    Raises:
      UserError: it does.
    """
    if found.shape != "compose" or found.features != ("z",) or found.tensors:
        raise UserError(
            f"export.engines: got {method}, whose frames take more than a matrix of measured light, expected a linear method "
            'such as svd-ridge; set export.engines = [] and see docs/deployment.md, or fit.method = "svd-ridge"'
        )


def export_engines(
    folder: Path,
    names: Sequence[str],
    covered: Bool[np.ndarray, "height width"],
    values: Float[np.ndarray, "points 3"],
    notes: Sequence[str] = (),
) -> list[Path]:
    """Writes a folder for each engine into an export that has the format of `packed.FORMAT`; others that were there go.

    Args:
      folder: of the export.
      names: of `ENGINES`.
      covered: texels that light is known of.
      values: measured light for the golden numbers, W/m².
      notes: what else each engine is to heed, a paragraph each, for the end of its README.
    Returns:
      The files.
    Raises:
      UserError: there are more layers than engines take, or a folder cannot be written.
    """
    for name in ENGINES:
        if name not in names and (folder / name / MODEL).is_file():
            shutil.rmtree(folder / name)
    if not names:
        return []
    packed = Packed.read(folder)
    document, data = _golden(packed, covered, values), packed.to_bytes()
    written = []
    for name in names:
        place = folder / name
        make_folder(place)
        texts = ENGINES[name].texts(packed) | {
            GOLDEN: json.dumps(document, allow_nan=False) + "\n",
            NUMBERS: _as_text(document),
        }
        texts[README] = "\n".join([texts[README], *(f"{note}\n" for note in notes)])
        for file, text in texts.items():
            write_text(place / file, text)
        with written_whole(place / MODEL) as temporary:
            temporary.write_bytes(data)
        written += [place / file for file in (*texts, MODEL)]
    return written


def _golden(packed: Packed, covered: np.ndarray, values: np.ndarray) -> dict[str, Any]:
    """A frame from measured light to five texels, in float64 from what the file holds."""
    lit = np.argwhere(covered)
    texels = lit[np.unique(np.linspace(0, len(lit) - 1, min(TEXELS, len(lit))).astype(int))]
    u, s = packed.frame(values)
    rows = packed.rows(u, s)
    return {
        "values": np.asarray(values, np.float32).tolist(),
        "s": s.tolist(),
        "u": u.tolist(),
        "rows": rows.tolist(),
        "texels": texels.tolist(),
        "light": packed.light(rows, texels).tolist(),
    }


def _as_text(document: dict[str, Any]) -> str:
    """The same for languages that read no JSON: counts of points and texels, values, then row, column and light each."""
    lines = [f"{len(document['values'])} {len(document['texels'])}"]
    lines += [" ".join(map(repr, value)) for value in document["values"]]
    lines += [" ".join(map(repr, [*texel, *light])) for texel, light in zip(document["texels"], document["light"], strict=True)]
    return "\n".join(lines) + "\n"
