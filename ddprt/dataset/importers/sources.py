"""What an import starts from: pairs of maps, maps and measured values, or photographs under known lights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddprt import seeds
from ddprt.axes import Float32
from ddprt.catalogue import Catalogue
from ddprt.dataset.importers.files import by_key, paired
from ddprt.dataset.importers.lamps import match, read_table
from ddprt.dataset.importers.light_positions import read_lp
from ddprt.dataset.importers.points import read_vectors
from ddprt.dataset.importers.recipe import Recipe
from ddprt.errors import UserError
from ddprt.lights import Lighting

FEWEST = 3


@dataclass(frozen=True, eq=False)
class Shots:
    """The lightings of an import, in order.

    Attributes:
      kind: of source.
      names: of the lightings.
      indirect: picture to learn, of each.
      direct: picture of direct light; None where there is none.
      measured: values, where they are given.
      lightings: lights; () where they are not known.
      splits: "train", "validation" or "test".
      notes: what is to be told of them, a line each.
    """

    kind: str
    names: tuple[str, ...]
    indirect: tuple[Path, ...]
    direct: tuple[Path, ...] | None
    measured: Float32[np.ndarray, "lightings points 3"] | None
    lightings: tuple[Lighting, ...]
    splits: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        """All pictures."""
        return (*self.indirect, *(self.direct or ()))


def find_shots(recipe: Recipe, folder: Path) -> Shots:
    """The lightings that a recipe means.

    Raises:
      UserError: files that are missing or do not fit together.
    """
    if recipe.lights.lower().endswith(".lp"):
        kind = "photographs"
    elif recipe.measured:
        kind = "vectors"
    elif recipe.direct and recipe.indirect:
        kind = "pairs"
    else:
        lacks = "indirect" if not recipe.indirect else "direct"
        raise UserError(
            f"import: got no {lacks} light, expected pairs of maps (--direct, --indirect), measured values (--measured, "
            "--indirect) or photographs (--lights FILE.lp)"
        )
    return SOURCES[kind](recipe, folder)


def _pairs(recipe: Recipe, folder: Path) -> Shots:
    direct, indirect = by_key(folder, recipe.direct, "--direct"), by_key(folder, recipe.indirect, "--indirect")
    paired(direct, indirect)
    keys = tuple(indirect)
    lightings, splits, notes = _lit(recipe, folder, keys)
    return Shots("pairs", keys, tuple(indirect.values()), tuple(direct[key] for key in keys), None, lightings, splits, notes)


def _vectors(recipe: Recipe, folder: Path) -> Shots:
    if not recipe.indirect:
        raise UserError("--measured: got no --indirect beside it, expected pictures of what is to be learned; add it")
    indirect = by_key(folder, recipe.indirect, "--indirect")
    values, keys = read_vectors(folder / recipe.measured), tuple(indirect)
    if len(values) != len(keys):
        raise UserError(
            f"{recipe.measured}: got {len(values)} lightings for {len(keys)} pictures, expected as many; mend one of them"
        )
    direct = by_key(folder, recipe.direct, "--direct") if recipe.direct else None
    if direct is not None:
        paired(direct, indirect)
    lightings, splits, notes = _lit(recipe, folder, keys)
    maps = None if direct is None else tuple(direct[key] for key in keys)
    return Shots("vectors", keys, tuple(indirect.values()), maps, values, lightings, splits, notes)


def _photographs(recipe: Recipe, folder: Path) -> Shots:
    for key in ("direct", "indirect", "measured"):
        if getattr(recipe, key):
            raise UserError(f"--{key}: got it beside an .lp file, whose photographs are what is learned; leave it out")
    shots = read_lp(folder / recipe.lights)
    keys = tuple(path.stem for path, _ in shots)
    splits = _dealt(recipe, len(keys))
    return Shots(
        "photographs", keys, tuple(path for path, _ in shots), None, None, tuple(lighting for _, lighting in shots), splits
    )


SOURCES: Catalogue[Callable[[Recipe, Path], Shots]] = Catalogue(
    "source", {"pairs": _pairs, "vectors": _vectors, "photographs": _photographs}
)
"""What each makes of a recipe and its folder."""


def _lit(recipe: Recipe, folder: Path, keys: Sequence[str]) -> tuple[tuple[Lighting, ...], tuple[str, ...], tuple[str, ...]]:
    """Lights and split of each picture, and what to note of the table."""
    if not recipe.lights:
        return ((),) * len(keys), _dealt(recipe, len(keys)), ()
    table = read_table(folder / recipe.lights)
    rows = match(table, keys, recipe.lights)
    idle = [row.name for row in table if row.name and row.name not in keys]
    notes = (f'{recipe.lights}: {len(idle)} lightings name no picture and are left out, the first "{idle[0]}"',) if idle else ()
    if not rows[0].split:
        splits = _dealt(recipe, len(keys))
    else:
        splits = tuple(row.split for row in rows)
        lacks = [name for name in ("train", "validation", "test") if name not in splits]
        if lacks:
            raise UserError(f"{recipe.lights}: got no lighting for {lacks[0]}, expected one at least; mend the column split")
    return tuple(row.lighting for row in rows), splits, notes


def _dealt(recipe: Recipe, count: int) -> tuple[str, ...]:
    """Splits at random, of the shares that are asked, at least one each."""
    if count < FEWEST:
        raise UserError(f"lightings: got {count}, expected at least {FEWEST} (train, validation, test); add some")
    test, validation = (max(1, round(share * count)) for share in (recipe.test, recipe.validation))
    while test + validation >= count:
        test, validation = max(1, test - 1), max(1, validation - (test == 1))
    splits = ["train"] * count
    order = seeds.stream(recipe.seed, "import split").permutation(count)
    for place, index in enumerate(order[: test + validation]):
        splits[index] = "test" if place < test else "validation"
    return tuple(splits)
