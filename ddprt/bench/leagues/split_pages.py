"""splits.md and the page's part of it: what was asked, a row for each method, a curve where numbers grow, and words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ddprt.bench.leagues.contest import Record
from ddprt.bench.leagues.search import BASELINE
from ddprt.bench.leagues.splits import SPLITS
from ddprt.bench.leagues.standings import Difference, difference, pooled
from ddprt.bench.leagues.words import against, with_spread
from ddprt.files import write_text
from ddprt.report.league_figures import growth_figure

TABLE = "splits.md"


@dataclass(frozen=True)
class Found:
    """What came out of one split.

    Attributes:
      name, question: of the split.
      cannot: why nothing came out; nothing where something did.
      sides: labels of what was asked, the first what the others are compared with.
      rows: of each method its cells, one for each side.
      words: about the sides, but for the first where it is only there to be compared with.
      curve: SVG of error over what grows, of a split that is a curve; nothing of others.
    """

    name: str
    question: str
    cannot: str = ""
    sides: Sequence[str] = ()
    rows: Sequence[tuple[str, Sequence[str]]] = ()
    words: Sequence[str] = ()
    curve: str = ""


def told(records: Sequence[Record], names: Sequence[str]) -> list[Found]:
    """What came out of each split, or why it cannot be done.

    Args:
      records: of `Generalisation.run`.
      names: entries of `SPLITS`.
    """
    return [_told(name, [record for record in records if record["split"] == name]) for name in names]


def _told(name: str, records: Sequence[Record]) -> Found:
    split = SPLITS[name]
    if hindered := [record["failed"] for record in records if record["what"] == "split"]:
        return Found(name, split.question, cannot=hindered[0])
    sides, methods = (list(dict.fromkeys(record[key] for record in records)) for key in ("side", "method"))
    cells = {
        (method, side): [one for one in records if one["method"] == method and one["side"] == side]
        for method in methods
        for side in sides
    }
    return Found(
        name,
        split.question,
        sides=sides,
        rows=[(method, [_cell(cells[method, side], cells[BASELINE, side]) for side in sides]) for method in methods],
        words=[_sentence(side, {method: cells[method, side] for method in methods}) for side in sides[not split.axis :]],
        curve=_curve(split.axis, {method: [cells[method, side] for side in sides] for method in methods}) if split.axis else "",
    )


def compared(own: Sequence[Record], base: Sequence[Record]) -> Difference | None:
    """A method beside the baseline; None where either could not do it."""
    if any(record["failed"] for record in (*own, *base)) or own[0]["method"] == BASELINE:
        return None
    return difference(own, base)


def _cell(own: Sequence[Record], base: Sequence[Record]) -> str:
    if failed := [record["failed"] for record in own if record["failed"]]:
        return failed[0]
    errors = pooled(own)
    spread = float(errors.std(ddof=1)) if len(errors) > 1 else None
    apart = compared(own, base)
    beside = "" if apart is None else f" ({against(apart)}, {apart.verdict})"
    return with_spread(float(errors.mean()), spread) + beside


def _sentence(side: str, by_method: Mapping[str, Sequence[Record]]) -> str:
    base = by_method[BASELINE]
    if any(record["failed"] for record in base):
        rivals_that_can = [name for name, own in by_method.items() if not any(record["failed"] for record in own)]
        return f"{side}: {BASELINE} cannot do it; {', '.join(rivals_that_can) or 'nobody'} can."
    apart = {name: found for name, own in by_method.items() if (found := compared(own, base)) is not None}
    better = sorted((name for name in apart if apart[name].verdict == "better"), key=lambda name: apart[name].mean)
    if better:
        return f"{side}: better than {BASELINE} by more than the spread: " + ", ".join(
            f"{name} ({against(apart[name])})" for name in better
        ) + "."  # fmt: skip
    return f"{side}: nobody is better than {BASELINE} by more than the spread."


def _curve(axis: str, sides: Mapping[str, Sequence[Sequence[Record]]]) -> str:
    """Errors of each method over where its sides stand; of sides that it could not do there is no mark."""
    curves = {}
    for method, by_side in sides.items():
        known = [own for own in by_side if not any(record["failed"] for record in own)]
        curves[method] = [(own[0]["at"], pooled(own)) for own in known]
    return growth_figure(curves, axis)


def write_splits(folder: Path, found: Sequence[Found], title: str) -> Path:
    """Writes splits.md, and beside it a file for each curve.

    Args:
      folder: that there is.
      found: of `told`.
      title: names the scene.
    Returns:
      The table's file.
    Raises:
      UserError: a file cannot be written.
    """
    for split in found:
        if split.curve:
            write_text(folder / _picture(split), split.curve)
    write_text(folder / TABLE, markdown(found, title))
    return folder / TABLE


def _picture(split: Found) -> str:
    return f"splits-{split.name}.svg"


def markdown(splits: Sequence[Found], title: str) -> str:
    """splits.md."""
    lines = [f"# Splits: {title}", ""]
    for split in splits:
        lines += [f"## {split.name}", "", split.question, ""]
        if split.cannot:
            lines += [f"Cannot be done here: {split.cannot}.", ""]
            continue
        lines += ["| method | " + " | ".join(split.sides) + " |", "|" + " --- |" * (1 + len(split.sides))]
        refused = {cell: "–" for name, cells in split.rows for cell in cells if cell.startswith(f"{name}: ")}
        lines += [f"| {name} | " + " | ".join(refused.get(cell, cell) for cell in cells) + " |" for name, cells in split.rows]
        lines += ["", f"![{split.name}]({_picture(split)})"] if split.curve else []
        lines += ["", *(f"- {line}" for line in (*split.words, *refused)), ""]
    return "\n".join(lines)
