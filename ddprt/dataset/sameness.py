"""What a dataset was baked with, and where that differs from what is asked for."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ddprt.config import Config
from ddprt.dataset.gloss import gloss_layers
from ddprt.dataset.probes import probe_layers
from ddprt.dataset.splits import SPLITS
from ddprt.files import sha256
from ddprt.scene.mesh import Scene
from ddprt.transport.glossiness import valid_integrator

_TOLD = 4  # settings that differ and that a message spells out
_WIDTH = 60  # characters of a value in a message
_SAID = {"placing": "points", "counts": "lightings"}  # what dataset.json calls otherwise than the configuration does


def baked_settings(config: Config, scene: Scene) -> dict[str, Any]:
    """What a dataset depends on besides its lightings and points."""
    transport = config.transport.model_dump(exclude={"threads"})
    placing, file = config.points.model_dump(exclude={"quantity"}), Path(config.points.file)
    placing |= {"file": sha256(file)[:16]} if file.is_file() else {}  # its content counts, wherever it lies
    return {
        "scene": {"name": scene.name, "digest": scene.digest, "notes": list(scene.notes)},
        "atlas": config.atlas.model_dump(exclude={"use"}),  # the scene's digest says which charts are used
        "seed": config.seed,
        "transport": transport | {"integrator": valid_integrator(transport["integrator"], scene)},
        "placing": placing,
        "layers": probe_layers(config, scene) + gloss_layers(config, scene),
    }


def other_settings(description: dict[str, Any], config: Config, scene: Scene) -> str:
    """The settings in which a baked dataset differs from a configuration, in words; empty where it is the same."""
    wanted: dict[str, Any] = baked_settings(config, scene)
    if not config.lightings.file:
        wanted["counts"] = {name: getattr(config.lightings, name) for name in SPLITS}
        baked = counts(description.get("lightings", []))["train"]
        if config.lightings.target_error and 0 < baked < config.lightings.train:  # it was reached by so many
            wanted["counts"]["train"] = baked
    return differences(description, wanted)


def differences(description: dict[str, Any], wanted: dict[str, Any]) -> str:
    """Where a baked dataset differs from what is asked for: "transport.samples: holds 16, asked 17"; empty if nowhere."""
    holds = {"layers": [], "skies": {}, **description, "counts": counts(description.get("lightings", []))}
    lines: list[str] = []
    for key, value in wanted.items():
        one, other = (_of_weight(entries) if key == "plan" else entries for entries in (holds.get(key, ...), value))
        _compare(_SAID.get(key, key), one, other, lines)
    more = [f"and {len(lines) - _TOLD} more"] if len(lines) > _TOLD else []
    return "; ".join(lines[:_TOLD] + more)


def _of_weight(entries: Any) -> Any:
    """The lines of a plan that make a dataset what it is, whatever other effects its version knew of."""
    return [entry for entry in entries if entry["called"] or entry["forced"]] if isinstance(entries, list) else entries


def counts(entries: Sequence[dict[str, Any]]) -> dict[str, int]:
    """How many lightings of a description are in each split."""
    splits = [entry["split"] for entry in entries]
    return {name: splits.count(name) for name in SPLITS}


def _compare(name: str, holds: Any, asked: Any, lines: list[str]) -> None:
    """Adds a line for every leaf that differs; the ellipsis stands for what is not there."""
    if isinstance(holds, dict) and isinstance(asked, dict):
        for key in dict.fromkeys([*asked, *holds]):
            _compare(f"{name}.{key}", holds.get(key, ...), asked.get(key, ...), lines)
    elif isinstance(holds, list) and isinstance(asked, list) and len(holds) == len(asked):
        for index, (one, other) in enumerate(zip(holds, asked, strict=True)):
            _compare(f"{name}[{index}]", one, other, lines)
    elif holds != asked:
        lines.append(f"{name}: holds {_shown(holds)}, asked {_shown(asked)}")


def _shown(value: Any) -> str:
    words = "nothing" if value is ... else json.dumps(value)
    if len(words) <= _WIDTH:
        return words
    return f"a list of {len(value)}" if isinstance(value, list) else f"{words[: _WIDTH // 2]}...{words[-_WIDTH // 2 :]}"
