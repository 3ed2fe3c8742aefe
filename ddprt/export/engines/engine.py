"""What an engine gets: files as they are, and shaders that are printed for the model."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ddprt.export.engines.packed import Packed
from ddprt.export.engines.shader import Words, filled

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Engine:
    """One entry of `ENGINES`; names count from the folder of this package, of which only the last part is kept.

    Attributes:
      files: copied as they are.
      shaders: templates, and the words of their language.
    """

    files: tuple[str, ...]
    shaders: Mapping[str, Words]

    def texts(self, packed: Packed) -> dict[str, str]:
        """Its files for a model, by name."""
        given = {name: (HERE / name).read_text("utf-8") for name in (*self.files, *self.shaders)}
        printed = {name: filled(given[name], words, packed) for name, words in self.shaders.items()}
        return {Path(name).name: text for name, text in (given | printed).items()}
