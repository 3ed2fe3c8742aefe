"""A sweep: every setting tried and noted in one file, which a sweep that was stopped goes on from."""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import Any

from ddprt.bench.frontier.page import write_all
from ddprt.bench.frontier.pareto import COSTS, DRAWN, ERRORS
from ddprt.bench.measure.settings import Setting, settings_of
from ddprt.bench.measure.trial import Workshop, about, environment, why
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.files import alone_in, append_line, make_folder
from ddprt.progress import Progress

RESULTS = "results.jsonl"
_ALWAYS = {"digest": str, "name": str, "changes": dict, "config": str, "failed": str | None, "environment": dict}
_SURROUNDINGS = {"ddprt": str, "commit": str | None, "when": str, "machine": dict}
_MEASURED = {"repeats": int, "scores": dict, "floors": dict, "status": str, "remarks": list}


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
    known = read_results(path, progress)
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


def read_results(path: Path, progress: Progress | None = None) -> dict[str, dict[str, Any]]:
    """Records by digest, the last one of each.

    Args:
      path: of results.jsonl; it may be missing.
      progress: is told how many lines do not count: cut short by a kill, or edited so that something is missing.
    Raises:
      UserError: it cannot be read, or is no text.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error}); mend its permissions, or delete it to measure anew") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: cannot be read ({error}); save it as UTF-8, or delete it to measure anew") from None
    records = [record for line in lines if _whole(record := _from_json(line))]
    if progress and len(records) < len(lines):
        progress.say(f"{path.name}: {len(records)} of {len(lines)} lines are whole; the others do not count")
    return {record["digest"]: record for record in records}


def _from_json(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _whole(record: Any) -> bool:
    """Whether a line holds all that is drawn of a setting, each of its kind."""
    if not _holds(record, _ALWAYS) or not _holds(record["environment"], _SURROUNDINGS):
        return False
    if not _holds(record["environment"]["machine"], {"packages": dict}):
        return False
    if record["failed"]:
        return True
    if not _holds(record, _MEASURED) or not all(isinstance(remark, str) for remark in record["remarks"]):
        return False
    return all(measure.of(record) is not None for measure in (ERRORS["error"], *(COSTS[name] for name in DRAWN)))


def _holds(table: Any, kinds: Mapping[str, type | UnionType]) -> bool:
    return isinstance(table, dict) and all(key in table and isinstance(table[key], kind) for key, kind in kinds.items())


def _tried(workshop: Workshop, setting: Setting) -> dict[str, Any]:
    """The record of a setting, or of why it cannot be."""
    try:
        return workshop.measure(setting)
    except (UserError, MemoryError) as error:
        return {**about(setting), "failed": why(error), "environment": environment()}
