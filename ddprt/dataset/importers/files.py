"""Which files belong together: patterns with a star, and what the star stands for."""

import re
from pathlib import Path

from ddprt.errors import UserError

_SHOWN = 3


def by_key(folder: Path, pattern: str, option: str) -> dict[str, Path]:
    """Files by what the pattern's star stands for in their names, in natural order (2 before 10).

    Args:
      folder: that the pattern counts from.
      pattern: with one star in the name of the file or of a folder, such as "direct/*.exr".
      option: named in messages.
    Raises:
      UserError: no star or several, or no such file.
    """
    if pattern.count("*") != 1:
        raise UserError(
            f'{option}: got "{pattern}" with {pattern.count("*")} stars, expected one, for the name of the lighting; write '
            f"{option} 'direct/*.exr' or the like"
        )
    before, after = pattern.split("*")
    found = {}
    for path in folder.glob(pattern):
        relative = path.relative_to(folder).as_posix()
        found[relative[len(before.removeprefix("./")) : len(relative) - len(after)]] = path
    if not found:
        raise UserError(f'{option}: got no file for "{pattern}" in {folder}, expected one for each lighting; check the pattern')
    return dict(sorted(found.items(), key=lambda item: natural(item[0])))


def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """A key to sort by in which numbers count as numbers."""
    return tuple((0, int(part), part) if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text) if part)


def paired(direct: dict[str, Path], indirect: dict[str, Path]) -> None:
    """Makes sure that both kinds have the same lightings.

    Raises:
      UserError: some have no partner.
    """
    for one, other, have, lack in ((direct, indirect, "direct", "indirect"), (indirect, direct, "indirect", "direct")):
        lone = [key for key in one if key not in other]
        if lone:
            more = f" and {len(lone) - _SHOWN} more" if len(lone) > _SHOWN else ""
            raise UserError(
                f"pairs: got {have} light but no {lack} of {', '.join(lone[:_SHOWN])}{more}, expected both; add the files, or "
                "take the others away"
            )
