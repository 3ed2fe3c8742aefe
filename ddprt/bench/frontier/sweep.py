"""A sweep: every setting tried and noted in one file, which a sweep that was stopped goes on from."""

import json
import time
from pathlib import Path
from typing import Any

from ddprt.bench.frontier.page import write_all
from ddprt.bench.measure.settings import Setting, settings_of
from ddprt.bench.measure.trial import Workshop, about, environment, why
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.files import alone_in, append_line, make_folder
from ddprt.progress import Progress

RESULTS = "results.jsonl"


def sweep(config: Config, folder: Path, progress: Progress) -> list[Path]:
    """Tries every setting that is not noted yet, and draws what came out.

    Args:
      config: the base, with [sweep] and [bench].
      folder: for the results; what another sweep left there stays.
      progress: shown while working.
    Returns:
      results.jsonl, and what was made from it: the page, the table and the figures.
    Raises:
      UserError: a value that its setting does not take, all settings fail, or the folder cannot be written.
    """
    settings = settings_of(config)
    make_folder(folder)
    with alone_in(folder):
        return _sweep(config, settings, folder, progress)


def _sweep(config: Config, settings: list[Setting], folder: Path, progress: Progress) -> list[Path]:
    path = folder / RESULTS
    known = read_results(path)
    finest = max(setting.config.atlas.resolution for setting in settings)
    workshop = Workshop(config, folder, progress, finest)
    workshop.check(config)
    todo = [setting for setting in settings if not workshop.holds(known.get(setting.digest, {}), setting)]
    found = len(settings) - len(todo)
    progress.say(f"sweep: {len(settings)} settings" + (f", {found} of them measured before" if found else ""))
    if todo:
        _ = workshop.yardstick  # baked first: what hinders that hinders every setting
    for index, setting in enumerate(todo):
        begun = time.perf_counter()
        record = _tried(workshop, setting)
        came = record["failed"] or f"error {record['scores']['relative_rmse']:.4g}"
        progress.say(f"{index + 1} of {len(todo)}: {setting.name}: {came} ({time.perf_counter() - begun:.1f} s)")
        append_line(path, json.dumps(record, allow_nan=False))
        known[setting.digest] = record
        rest = {other.bake_digest for other in todo[index + 1 :]}
        if not config.bench.keep and setting.bake_digest not in rest:
            workshop.forget(setting)
    if not config.bench.keep:
        workshop.forget_all(but_truth=True)
    records = [known[setting.digest] for setting in settings]
    if all(record["failed"] for record in records):
        raise UserError(f"sweep: got no setting that works, expected one at least; the first says: {records[0]['failed']}")
    return [path, *write_all(folder, records, title=config.scene.name, base_digest=settings[0].digest)]


def read_results(path: Path) -> dict[str, dict[str, Any]]:
    """Records by digest, the last one of each; a line cut short by a kill does not count."""
    found: dict[str, dict[str, Any]] = {}
    try:
        lines = path.read_text("utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error}); mend its permissions, or delete it to measure anew") from None
    for line in lines:
        try:
            record = json.loads(line)
            found[record["digest"]] = record
        except (ValueError, KeyError, TypeError):
            continue
    return found


def _tried(workshop: Workshop, setting: Setting) -> dict[str, Any]:
    """The record of a setting, or of why it cannot be."""
    try:
        return workshop.measure(setting)
    except (UserError, MemoryError) as error:
        return {**about(setting), "failed": why(error), "environment": environment()}
