"""What a comparison found, in words and tables, all from the numbers."""

from collections.abc import Mapping, Sequence

from ddprt.bench.leagues.contest import spoken
from ddprt.bench.leagues.search import BASELINE
from ddprt.bench.leagues.standings import LEAGUES, Budgets, Difference, Place, Record
from ddprt.report import words

_FORMS = {"bytes": words.size, "count": words.count, "seconds": words.seconds}
HEADS = ("method", "error", "against svd-ridge", "verdict", "ships", "operations", "training", "frame", "settings by seed")


def amount(key: str, value: float | int) -> str:
    """A number of a league with its unit."""
    return _FORMS[LEAGUES[key].form](value)


def with_spread(mean: float, spread: float | None) -> str:
    """An error and how far seeds are apart, in percent."""
    return f"{100 * mean:.2f}" + (f" ± {100 * spread:.2f}\u00a0%" if spread is not None else "\u00a0%")


def against(found: Difference | None) -> str:
    """How much more or less a rival errs than the baseline."""
    if found is None:
        return "–"
    spread = "" if found.spread is None else f" ± {100 * found.spread:.1f}"
    return f"{100 * found.mean:+.1f}{spread}\u00a0%".replace("-", "−")


def rows(places: Sequence[Place]) -> list[tuple[str, ...]]:
    """Cells of a league's table, under `HEADS`."""
    told: list[tuple[str, ...]] = []
    for place in places:
        if not place.errors:
            told.append((place.method, *("–",) * 2, "out", *("–",) * 4, place.why))
            continue
        largest = {key: max(trial[key] for trial in place.trials) for key in LEAGUES}
        frame = max(test["frame"]["median"] for test in place.tests)
        verdict = "baseline" if place.method == BASELINE else place.difference.verdict if place.difference else "–"
        settings = "; ".join(dict.fromkeys(spoken(trial["settings"]) for trial in place.trials))
        told.append((
            place.method, with_spread(place.mean, place.spread), against(place.difference), verdict,
            *(amount(key, largest[key]) for key in LEAGUES), words.seconds(frame), settings,
        ))  # fmt: skip
    return told


def findings(table: Mapping[str, Sequence[Place]], budgets: Budgets, scene: str, trials: int, seeds: int) -> list[str]:
    """A paragraph for each league, and one for all of them."""
    told = []
    won: dict[str, list[str]] = {}
    for league, places in table.items():
        title, limit = LEAGUES[league].title, amount(league, getattr(budgets, LEAGUES[league].key))
        base = next(place for place in places if place.method == BASELINE)
        if not base.errors:
            told.append(f"League of {title} (at most {limit}): {BASELINE} itself is out ({base.why}), so nobody is compared.")
            continue
        rivals = [place for place in places if place.difference is not None]
        better = [place for place in rivals if place.difference and place.difference.verdict == "better"]
        for place in better:
            won.setdefault(place.method, []).append(title)
        line = f"League of {title} (at most {limit}): {BASELINE} errs by {with_spread(base.mean, base.spread)}. "
        if better:
            first = better[0]
            line += f"{first.method} beats it by more than the spread: {with_spread(first.mean, first.spread)}"
            line += f", {against(first.difference)} paired by seed."
            others = [f"{place.method} ({against(place.difference)})" for place in better[1:]]
            line += f" So do {', '.join(others)}." if others else ""
        elif rivals:
            first = rivals[0]
            line += (
                f"No rival beats it by more than the spread; the nearest, {first.method}, is at {against(first.difference)}."
            )
        else:
            line += "No rival keeps the budget for every seed."
        line += _where(better[0] if better else rivals[0]) if rivals else ""
        out = [place.method for place in places if not place.errors]
        line += f" Out: {', '.join(out)}." if out else ""
        told.append(line)
    names = "; ".join(f"{name} (leagues of {' and '.join(titles)})" for name, titles in won.items())
    whole = f"On {scene}, with up to {trials} trials each and {seeds} seeds, "
    if seeds < 2:
        whole += "one seed has no spread: no claim is made."
    else:
        whole += f"the baseline is beaten by more than the spread by {names}." if won else (
            "the linear baseline is not beaten by more than the spread in any league."
        )  # fmt: skip
    everywhere = [{place.method for place in places if not place.errors} for places in table.values()]
    if out := sorted(set.intersection(*everywhere) - {BASELINE}):
        whole += f" In no league at all: {', '.join(out)}."
    return [whole, *told]


def failures(records: Sequence[Record]) -> list[str]:
    """A sentence for each method of which some trials could not be done; of whom none could be, the tables say it."""
    told, trials = [], [record for record in records if record["what"] == "trial"]
    for method in dict.fromkeys(record["method"] for record in trials):
        own = [record for record in trials if record["method"] == method]
        if 0 < len(failed := [record["failed"] for record in own if record["failed"]]) < len(own):
            told.append(f"{len(failed)} of {len(own)} trials of {method} could not be done; the first: {failed[0]}.")
    return told


def _where(place: Place) -> str:
    """On which kind of lighting a rival differs most from the baseline, and where least."""
    groups = place.groups or {}
    if len(groups) < 2:
        return ""
    order = sorted(groups, key=lambda group: groups[group].mean)
    parts = [f"{against(groups[group])} on {group} ({groups[group].verdict})" for group in order]
    return f" By kind of lighting it is at {', '.join(parts)}."


def markdown(table: Mapping[str, Sequence[Place]], budgets: Budgets, told: Sequence[str], title: str) -> str:
    """leagues.md."""
    lines = [f"# Leagues: {title}", "", *(f"{line}\n" for line in told)]
    for league, places in table.items():
        limit = amount(league, getattr(budgets, LEAGUES[league].key))
        lines += [f"## {LEAGUES[league].title[0].upper()}{LEAGUES[league].title[1:]}, at most {limit}", ""]
        lines += ["| " + " | ".join(HEADS) + " |", "|" + " --- |" * len(HEADS)]
        lines += ["| " + " | ".join(row) + " |" for row in rows(places)]
        groups = list(next((place.groups for place in places if place.groups), {}))
        if groups:
            lines += ["", "| against svd-ridge on | " + " | ".join(groups) + " |", "|" + " --- |" * (1 + len(groups))]
            for place in places:
                if place.groups:
                    cells = [f"{against(place.groups[group])}, {place.groups[group].verdict}" for group in groups]
                    lines.append(f"| {place.method} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)
