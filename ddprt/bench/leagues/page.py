"""leagues.md and leagues.html: tables, figures and pictures of a comparison; the page opens from disk."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddprt import __version__
from ddprt.bench.leagues import words
from ddprt.bench.leagues.search import BASELINE
from ddprt.bench.leagues.split_pages import Found
from ddprt.bench.leagues.standings import LEAGUES, Budgets, Place, Record, groups_of
from ddprt.dataset.store import Dataset
from ddprt.files import write_text
from ddprt.report import figures
from ddprt.report import league_figures as drawn
from ddprt.report.view import default_camera, take_view
from ddprt.runtime.model import Model
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

PAGE, TABLE = "leagues.html", "leagues.md"


@dataclass(frozen=True)
class Shown:
    """Pictures of one lighting.

    Attributes:
      title, text: above them.
      pictures: caption and PNG of each.
    """

    title: str
    text: str
    pictures: Sequence[tuple[str, str]] = field(default=())


def write_pages(
    folder: Path,
    records: Sequence[Record],
    table: Mapping[str, Sequence[Place]],
    budgets: Budgets,
    *,
    title: str,
    trials: int,
    seeds: int,
    shown: Sequence[Shown] = (),
    splits: Sequence[Found] = (),
) -> list[Path]:
    """Writes both files.

    Args:
      folder: that there is.
      records: of `Contest.run`.
      table: of `standings`.
      budgets: of the leagues.
      title: names the scene.
      trials, seeds: as configured.
      shown: pictures, of `pictures_of`.
      splits: of `ddprt.bench.leagues.split_pages.told`.
    Raises:
      UserError: a file cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    found = [*words.findings(table, budgets, title, trials, seeds), *words.failures(records)]
    write_text(folder / TABLE, words.markdown(table, budgets, found, title))
    lightings = next(record for record in records if record["what"] == "data")["lightings"]
    names = _names(table)
    loader = PackageLoader("ddprt.bench", "leagues")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.get_template("page.html.j2").render(
        version=__version__,
        title=title,
        findings=found,
        heads=words.HEADS,
        methods=names,
        trials=trials,
        seeds=seeds,
        count=len(lightings),
        leagues=[_league(league, places, budgets) for league, places in table.items()],
        time=_over_time(records, table, names, budgets),
        scatters=_scatters(table, lightings),
        pictures=shown,
        splits=[(split, _encoded(split.curve.encode())) for split in splits],
        machines=_machines(records),
    )
    write_text(folder / PAGE, page)
    return [folder / TABLE, folder / PAGE]


def leader(table: Mapping[str, Sequence[Place]]) -> Place | None:
    """The first rival that beats the baseline in a league, else the best of the first league that has one."""
    rivals = [place for places in table.values() for place in places if place.difference is not None]
    return next(
        (place for place in rivals if place.difference and place.difference.verdict == "better"), next(iter(rivals), None)
    )


def pictures_of(place: Place, base: Model, own: Model, data: Dataset, scene: Scene) -> list[Shown]:
    """The held-out lightings on which a rival is best and worst beside the baseline.

    Args:
      place: of the rival; its first test chooses the lightings.
      base, own: models of the first seed.
      data: with the held-out lightings.
      scene: that is looked at.
    """
    test = data.split("test")
    ours, theirs = _errors(data, own), _errors(data, base)
    ratio = np.where(theirs > 0, ours / np.maximum(theirs, 1e-30), np.nan)
    if not np.isfinite(ratio).any() or data.uv is None:
        return []
    view = take_view(Tracer.of(scene), data.uv, data.covered, default_camera(scene))
    told = []
    for row, what in ((int(np.nanargmin(ratio)), "Best"), (int(np.nanargmax(ratio)), "Worst")):
        index = test[row]
        reference, direct = (data.maps(kind, [index])[0] for kind in ("indirect", "direct"))
        light = {name: _answer(data, index, model) for name, model in ((BASELINE, base), (place.method, own))}
        made = {
            name: figures.lighting_row(direct, found, reference, data.gbuffer["albedo"], data.covered, view)
            for name, found in light.items()
        }
        of_ours, of_base = made[place.method]["view"], made[BASELINE]["view"]
        pictures = [("reference, indirect light", of_ours["reference"]), (place.method, of_ours["ours"])]
        pictures += [(f"{place.method} − reference", of_ours["difference"]), (f"{BASELINE} − reference", of_base["difference"])]
        text = (
            f"Held-out lighting {index}: {place.method} errs by {100 * ours[row]:.2f}\u00a0%, {BASELINE} by "
            f"{100 * theirs[row]:.2f}\u00a0%, of the first seed. Differences are each drawn in a range of their own."
        )
        told.append(Shown(f"{what} lighting of {place.method}", text, [(name, _encoded(png)) for name, png in pictures]))
    return told


def _answer(data: Dataset, index: int, model: Model) -> np.ndarray:
    values = data.values([index], model.points, model.quantity)[0]
    return model.predict(values, lightings=data.lightings[index], constant=False)


def _errors(data: Dataset, model: Model) -> np.ndarray:
    from ddprt.bench.leagues.deals import tally

    return tally(model, data, "test").per_lighting()


def _names(table: Mapping[str, Sequence[Place]]) -> list[str]:
    found = [place.method for places in table.values() for place in places]
    return [BASELINE, *sorted(set(found) - {BASELINE})]


def _league(league: str, places: Sequence[Place], budgets: Budgets) -> dict[str, Any]:
    groups = list(next((place.groups for place in places if place.groups), {}))
    by_group = [
        (place.method, [f"{words.against(place.groups[group])}, {place.groups[group].verdict}" for group in groups])
        for place in places
        if place.groups
    ]
    title = LEAGUES[league].title
    limit = words.amount(league, getattr(budgets, LEAGUES[league].key))
    return {
        "title": title[0].upper() + title[1:],
        "limit": limit,
        "rows": words.rows(places),
        "groups": groups,
        "by_group": by_group,
    }


def _over_time(
    records: Sequence[Record], table: Mapping[str, Sequence[Place]], names: Sequence[str], budgets: Budgets
) -> list[tuple[str, str]]:
    tried = [record for record in records if record["what"] == "trial" and not record["failed"]]
    points = {
        name: [(one["seconds"], one["validation"]) for one in tried if one["method"] == name and one["validation"] > 0]
        for name in names
    }
    curves: dict[str, list[Any]] = {}
    for places in reversed(list(table.values())):
        for place in places:
            own = [trial["curve"] for trial in place.trials if len(trial["curve"]) > 1]
            curves |= {place.method: own} if own else {}
    found = [("Every trial: its error on validation against the seconds of its training; dashed the budget of the league.",
              drawn.trials_figure(points, budgets.seconds))]  # fmt: skip
    if curves:
        caption = "How training went, of chosen trials: each method's own loss on validation over its first look."
        found.append((caption, drawn.losses_figure(curves, names)))
    return [(caption, _encoded(figure.encode())) for caption, figure in found]


def _scatters(table: Mapping[str, Sequence[Place]], lightings: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    groups, found = groups_of(lightings), {}
    for league, places in table.items():
        base = next(place for place in places if place.method == BASELINE)
        for place in places:
            if place.difference is None or place.method in found:
                continue
            ours, theirs = (_by_lighting(one) for one in (place, base))
            caption = f"{place.method} against {BASELINE}, league of {LEAGUES[league].title}"
            figure = drawn.lightings_figure(ours, theirs, place.method, groups)
            found[place.method] = (caption, _encoded(figure.encode()))
    return list(found.values())


def _by_lighting(place: Place) -> np.ndarray:
    error, squares = (np.array([test[key] for test in place.tests]) for key in ("error", "squares"))
    lit = squares > 0
    each = np.sqrt(np.divide(error, squares, out=np.full(error.shape, np.nan), where=lit))
    return each.mean(0)


def _machines(records: Sequence[Record]) -> list[str]:
    found = []
    for record in records:
        if place := record.get("environment"):
            own = place["machine"]
            found.append(
                f"{own['processor']}, {own['cores']} cores, {own['system']}, ddprt {place['ddprt']} at {place['commit']}"
            )
    return list(dict.fromkeys(found))


def _encoded(data: bytes) -> str:
    return base64.b64encode(data).decode()
