"""All formats that textures can be exported in."""

from collections.abc import Sequence

from ddprt.catalogue import Catalogue
from ddprt.export.formats.bc6h import BC6H_DDS, BC6H_KTX2
from ddprt.export.formats.exr import EXR, EXR_GRID
from ddprt.export.formats.format import Format
from ddprt.export.formats.ktx2 import KTX2
from ddprt.export.formats.png import BYTES
from ddprt.export.formats.raw import RAW

FORMATS: Catalogue[Format] = Catalogue(
    "format of textures",
    {
        "exr": EXR,
        "exr-grid": EXR_GRID,
        "raw": RAW,
        "ktx2": KTX2,
        "bytes": BYTES,
        "bc6h": BC6H_DDS,
        "bc6h-ktx2": BC6H_KTX2,
    },
)
"""What may stand in `export.formats`."""


def check_formats(names: Sequence[str], height: int, width: int) -> None:
    """Refuses what cannot be written, before anything is.

    Args:
      names: of `FORMATS`.
      height, width: of the lightmap.

    Raises:
      UserError: no such format, a side that it cannot hold, or a library is missing.
    """
    for name in names:
        FORMATS[name].fits(height, width)
