"""All engines that can be written for."""

from ddprt.catalogue import Catalogue
from ddprt.export.engines.engine import Engine

ENGINES: Catalogue[Engine] = Catalogue(
    "engine",
    {
        "c": Engine(("c/ddprt_runtime.h", "c/check.c", "c/README.md")),
    },
)
"""What may stand in `export.engines`."""
