"""What an engine gets: files as they are, and files that are printed for the model."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ddprt.export.engines.packed import Packed

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Engine:
    """One entry of `ENGINES`.

    Attributes:
      files: names in the folder of this package, copied as they are.
      printed: name of a file, and what prints it for a model.
    """

    files: tuple[str, ...]
    printed: Mapping[str, Callable[[Packed], str]] = field(default_factory=dict)
