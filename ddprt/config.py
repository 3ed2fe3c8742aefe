"""Every setting of a run: one frozen model per section, in the order of the walk.

TOML goes in, the resolved configuration comes out and is accepted as input again. `--section.key value` on the command
line overrides the file. Relative paths count from the folder of the file that they stand in, and on the command line from
the working folder. This module imports no room, so that `ddprt --help` stays instant.
"""

import hashlib
import json
import os
import tomllib
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, ValidationError, field_validator

from ddprt.errors import UserError, nearest, spoken
from ddprt.errors import explain as explained
from ddprt.sections import (
    AnimationConfig,
    AtlasConfig,
    BenchConfig,
    BudgetConfig,
    EffectsConfig,
    ExportConfig,
    FitConfig,
    LeaguesConfig,
    LightingsConfig,
    MethodsConfig,
    PointsConfig,
    ProbesConfig,
    ReportConfig,
    SceneConfig,
    Section,
    TransportConfig,
    TuneConfig,
)

_PATHS = (
    "scene.name",
    "scene.poses",
    "lightings.file",
    "lightings.environment",
    "points.file",
    "probes.file",
    "export.gltf_preview",
)
_NAMED = ("scene.name", "lightings.environment")  # a path, or the name of one in code


class Config(Section):
    """A whole run."""

    seed: int = Field(0, ge=0, le=2**32 - 1, description="every random number follows from it")
    scene: SceneConfig = SceneConfig()
    animation: AnimationConfig = AnimationConfig()
    atlas: AtlasConfig = AtlasConfig()
    lightings: LightingsConfig = LightingsConfig()
    points: PointsConfig = PointsConfig()
    transport: TransportConfig = TransportConfig()
    effects: EffectsConfig = EffectsConfig()
    probes: ProbesConfig = ProbesConfig()
    fit: FitConfig = FitConfig()
    methods: MethodsConfig = MethodsConfig()
    report: ReportConfig = ReportConfig()
    export: ExportConfig = ExportConfig()
    bench: BenchConfig = BenchConfig()
    sweep: dict[str, tuple[Any, ...]] = Field(
        {}, description="values that `ddprt bench` tries of a setting, e.g. {fit.bases = [4, 16, 64]}; empty: a plan of its own"
    )
    leagues: LeaguesConfig = LeaguesConfig()
    budget: BudgetConfig = BudgetConfig()
    tune: TuneConfig = TuneConfig()

    @field_validator("sweep", mode="before")
    @classmethod
    def _knobs(cls, table: Any) -> Any:
        """Dotted keys, quoted or not, each with a list of values that its setting takes."""
        if not isinstance(table, dict):
            return table
        knobs = dict(_flat(table))
        asks = ("bench", "sweep", "leagues", "budget", "tune", "report")
        known = [key for key in keys() if key.split(".")[0] not in asks]
        for key, values in knobs.items():
            if key not in known:
                hint = nearest(key, known) or "; `ddprt bench --help` lists them all"
                raise ValueError(f"{key}: got {_toml(key)}, expected a setting of a run{hint}")
            if not isinstance(values, list | tuple) or not values:
                raise ValueError(f"{key}: got {values!r}, expected a list of at least one value; write {_listed(key, values)}")
        return knobs

    @property
    def animated(self) -> bool:
        """Whether keyframes are asked for."""
        return bool(self.animation.keys) or bool(self.scene.poses)

    def to_toml(self, folder: Path | None = None) -> str:
        """The resolved configuration as TOML, accepted as input again; of a file that will lie in `folder`, if one is given."""
        document = self.model_dump(mode="json")
        if folder:
            _move(document, lambda path: seen_from(path, folder))
        lines = [f"seed = {document.pop('seed')}"]
        for section, values in document.items():
            lines += ["", f"[{section}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
        return "\n".join(lines) + "\n"

    def digest(self, *sections: str) -> str:
        """Hash of the named sections (all, if none are named) and the seed: equal digests mean equal results."""
        chosen = self.model_dump(mode="json", include={*sections, "seed"} if sections else None)
        return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()[:16]


def load_config(path: str | Path | None, overrides: dict[str, str] | None = None) -> Config:
    """Reads a TOML file (or the defaults) and applies overrides.

    Args:
      path: the file, or None for the defaults.
      overrides: dotted key to the text given on the command line, e.g. `{"fit.bases": "32"}`.
    Returns:
      The validated configuration. Relative paths in it count from the working folder; those of the file have been moved.
    Raises:
      UserError: one line with file, key, got, expected and what to do for the first fault.
    """
    document: dict[str, Any] = {}
    if path is not None:
        try:
            document = tomllib.loads(Path(path).read_text("utf-8"))
        except OSError as error:
            raise UserError(f"{path}: got {error.strerror or error}, expected a readable TOML file; check the path") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UserError(
                f"{path}: got text that is not TOML ({error}), expected [section] and key = value; mend it"
            ) from None
        folder = Path(path).parent
        _move(document, lambda path: seen_from(str(folder / path), Path()))
    overrides = {_as_written(dotted): text for dotted, text in (overrides or {}).items()}
    for dotted, text in overrides.items():
        check_key(dotted)
        *parents, leaf = dotted.split(".")
        table = document
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise UserError(f"--{dotted}: got a table, but {path} gives {parent} a plain value; mend the file")
        table[leaf] = _literal(text)
    return checked(document, path, overrides)


def checked(document: dict[str, Any], path: str | Path | None = None, overrides: dict[str, str] | None = None) -> Config:
    """A nested dictionary as a configuration; `path` and `overrides` are where it came from.

    Raises:
      UserError: see `load_config`.
    """
    try:
        return Config.model_validate(document)
    except ValidationError as error:
        raise UserError(explain(error, path, overrides or {})) from None


def keys(model: type[BaseModel] = Config, prefix: str = "") -> list[str]:
    """Every dotted key, e.g. "fit.bases"."""
    found = []
    for name, field in model.model_fields.items():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, Section):
            found += keys(annotation, f"{prefix}{name}.")
        else:
            found.append(prefix + name)
    return found


def explain(error: ValidationError, path: str | Path | None, overrides: dict[str, str]) -> str:
    """First fault of a pydantic error as one line: file, key, got, expected, what to do."""
    faults = error.errors()
    fault = faults[0]
    key, text = spoken(fault)
    place = [str(part) for part in (*fault["loc"], key) if part != ""]
    names = [".".join(place[:n]) for n in range(len(place), 0, -1)]
    dotted = next((name for name in names if name in keys()), names[0])
    given = next((name for name in names[: names.index(dotted) + 1] if name in overrides), None)
    source = f"--{given}" if given else f"{path or 'configuration'}: {names[0] if key else dotted}"
    if fault["type"] == "extra_forbidden":
        siblings = [key for key in keys() if key.split(".")[:-1] == place[:-1]] or keys()
        sections = [*siblings, *(key.split(".")[0] for key in keys())] if len(place) == 1 else siblings
        names = sorted({key.rsplit(".", 1)[-1] for key in sections})
        return f"{source}: unknown key{nearest(place[-1], names)}; known here: {', '.join(names)}"
    if text:
        return f"{source}: {text}"
    # A list whose entries are faulty counts as short of them, too.
    related = [
        other
        for other in faults
        if ".".join(map(str, other["loc"])).startswith(dotted) and (other is fault or other["type"] != "too_short")
    ]
    default: Any = Config()
    for part in dotted.split("."):
        default = getattr(default, part, None)
    shown = "" if default is None or isinstance(default, Section | dict) else f", {_toml(default)}"
    return f"{source}: {explained(related, default, f'mend it, or leave it out for the default{shown}')}"


def _as_written(dotted: str) -> str:
    """The key as the file spells it: the help prints hyphens, as command lines do."""
    plain = dotted.replace("-", "_")
    return plain if plain in keys() else dotted


def check_key(dotted: str, verb: str = "run") -> None:
    """Makes sure that `--dotted` is a setting.

    Raises:
      UserError: it is not; `verb` is the one whose help is named.
    """
    known, free = keys(), ("scene.parameters.", "methods.settings.", "sweep.", "budget.scenario.")
    if _as_written(dotted) not in known and not dotted.startswith(free):
        raise UserError(f"--{dotted}: unknown key{nearest(dotted, known)}; `ddprt {verb} --help` lists all")


def _move(document: dict[str, Any], move: Callable[[str], str]) -> None:
    """Changes the paths of a document in place; what is of the wrong kind is refused later."""

    def moved(dotted: str, value: Any) -> Any:
        if isinstance(value, list):
            return [moved(dotted, one) for one in value]
        named = dotted in _NAMED and isinstance(value, str) and not Path(value).suffix and os.path.basename(value) == value
        return move(value) if isinstance(value, str) and value and not named else value

    if isinstance(document.get("sweep"), dict):
        document["sweep"] = dict(_flat(document["sweep"]))
    budget = document.get("budget")
    scenario = budget.get("scenario") if isinstance(budget, dict) else None
    for dotted in _PATHS:
        section, leaf = dotted.split(".")
        tables = (document.get(section), leaf), (document.get("sweep"), dotted)
        for table, key in (*tables, *([(scenario, leaf)] if section == "lightings" else [])):
            if isinstance(table, dict) and key in table:
                table[key] = moved(dotted, table[key])


def seen_from(path: str, folder: Path) -> str:
    """A path as it counts from a folder, through whatever links lead to either; absolute ones stay."""
    if os.path.isabs(path):
        return path
    parent, name = os.path.split(path)
    return os.path.relpath(os.path.join(os.path.realpath(parent), name), os.path.realpath(folder))


def _flat(table: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Entries of nested tables by their dotted keys."""
    found: list[tuple[str, Any]] = []
    for key, value in table.items():
        found += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return found


def _literal(text: str) -> Any:
    """A TOML value if the text is one, else the text itself: `0.1`, `[1, 2]` and `auto` all work."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _listed(key: str, value: Any) -> str:
    """How the list is written that a value is the inside or the beginning of; of the default, where there is none."""
    inner = value.strip("[(,)] ") if isinstance(value, str) else value
    if isinstance(inner, str | list | tuple) and not inner:
        return _toml([reduce(getattr, key.split("."), Config())])
    listed = _literal(f"[{inner}]") if isinstance(inner, str) else [inner]
    return _toml(listed if isinstance(listed, list) else [inner.strip("'\"")])


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML allows no raw DEL
    return json.dumps(value)
