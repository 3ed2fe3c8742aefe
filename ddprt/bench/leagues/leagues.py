"""`ddprt bench --leagues`: the contest, its standings, and the pages that show them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ddprt.bench.leagues.contest import RESULTS, Contest
from ddprt.bench.leagues.page import leader, pictures_of, write_pages
from ddprt.bench.leagues.search import BASELINE, Trial
from ddprt.bench.leagues.split_pages import Found
from ddprt.bench.leagues.standings import Place, budgets_of, standings
from ddprt.config import Config
from ddprt.dataset.store import Dataset
from ddprt.files import alone_in, make_folder
from ddprt.progress import Progress
from ddprt.scene.mesh import Scene


def leagues(
    config: Config,
    data: Dataset,
    scene: Scene,
    folder: Path,
    progress: Progress,
    *,
    splits: Sequence[Found] = (),
) -> tuple[dict[str, list[Place]], list[Path]]:
    """Compares methods under three budgets.

    Args:
      config: with [leagues].
      data: baked by it.
      scene: what it is of.
      folder: for leagues.jsonl, which a contest that was stopped goes on from, and the pages.
      progress: shown while working.
      splits: what was found on other splits, for the page.
    Returns:
      Of each league all methods, the best first; and the files.
    Raises:
      UserError: no such method, the baseline cannot be fitted, or the folder cannot be written.
    """
    make_folder(folder)
    with alone_in(folder):
        contest = Contest(config, data, scene, folder, progress)
        records = contest.run()
        table, budgets = judged(records, config)
        found = leader(table)
        shown = []
        if found is not None:
            base = next(place for places in table.values() if found in places for place in places if place.method == BASELINE)
            own, theirs = (
                contest.model(Trial(place.method, place.trials[0]["seed"], place.trials[0]["settings"]))
                for place in (found, base)
            )
            shown = pictures_of(found, theirs, own, data, scene)
        asked = config.leagues
        files = write_pages(
            folder, records, table, budgets,
            title=config.scene.name, trials=asked.trials, seeds=asked.seeds, shown=shown, splits=splits,
        )  # fmt: skip
    return table, [folder / RESULTS, *files]


def judged(records: Sequence[Mapping[str, Any]], config: Config) -> tuple[dict[str, list[Place]], Any]:
    """Standings of the records under the configuration's budgets, and these."""
    trials = [record for record in records if record["what"] == "trial" and record["method"] == BASELINE]
    budgets = budgets_of(config.leagues, [record for record in trials if not record["settings"]])
    return standings(records, budgets, config.leagues.seeds), budgets
