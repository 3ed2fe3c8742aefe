"""A process of its own for tests/test_effects.py: bakes while files of effects may not be imported, or all are beforehand.

What it prints as JSON: by scene, a hash of every file of the dataset, and all rays that were traced.
"""

import importlib
import json
import sys
import tempfile
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any

import made_up_effect
from numba.core.dispatcher import Dispatcher

from ddprt.config import checked
from ddprt.dataset.generate import bake
from ddprt.errors import UserError
from ddprt.files import sha256
from ddprt.scene.library import build
from ddprt.transport.effects import EFFECTS, plan
from ddprt.transport.embree import Tracer

JOB: dict[str, Any] = {
    "atlas": {"resolution": 48},
    "points": {"count": 4, "supersample": 1},
    "transport": {"samples": 8, "test_samples": 8, "threads": 2},
}
AROUND = ("statue", "convex", "lion", "furball")
SMALL = {"statue": {"subdivisions": 2}, "furnace": {"subdivisions": 2}, "lion": {"cells": 36}, "furball": {"strands": 40}}
RESOLUTIONS = {"lion": 128}  # of a body in many charts
ROOM = "ddprt.transport."


class Absent(MetaPathFinder):
    """Refuses to import."""

    modules: frozenset[str] = frozenset()

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name in self.modules:
            raise ImportError(f"{name} was imported, and nothing calls for it")


def signatures(modules: list[str]) -> dict[str, int]:
    """How many types each compiled function of some modules was compiled for."""
    return {
        f"{name}.{key}": len(value.signatures)
        for name in modules
        for key, value in vars(sys.modules[name]).items()
        if isinstance(value, Dispatcher) and value.py_func.__module__ == name
    }


def baked(name: str, absent: Absent, apart: bool) -> dict[str, Any]:
    scene = build(name, **SMALL.get(name, {}))
    for distribution in ("around",) if name in AROUND else ("room", "around"):
        lightings = {"train": 2, "validation": 1, "test": 1, "distribution": distribution, "clearance": 0.02}
        resolution = RESOLUTIONS.get(name, JOB["atlas"]["resolution"])
        config = checked({**JOB, "atlas": {"resolution": resolution}, "lightings": lightings})
        called = {entry.module for key, entry in EFFECTS.items() if plan(scene, ()).called(key)}
        modules = {ROOM + entry.module for entry in EFFECTS.values() if entry.module and entry.module not in called}
        absent.modules = frozenset(modules if apart else ())
        before = rays[0]
        with tempfile.TemporaryDirectory() as folder:
            try:
                bake(scene, config=config, out=folder)
            except UserError:
                if distribution == "around":
                    raise
                continue
            files = {str(path.relative_to(folder)): sha256(path) for path in sorted(Path(folder).rglob("*")) if path.is_file()}
        return {"files": files, "rays": rays[0] - before, "called": sorted(called - {""})}
    raise AssertionError("unreachable")


rays = [0]
_count = Tracer._count


def counted(self: Tracer, number: int) -> None:
    _count(self, number)
    rays[0] += number


if __name__ == "__main__":
    apart, names = sys.argv[1] == "apart", sys.argv[2:]
    Tracer._count = counted  # type: ignore[method-assign]
    absent = Absent()
    sys.meta_path.insert(0, absent)
    with tempfile.TemporaryDirectory() as folder:
        made_up_effect.register(Path(folder))
        modules = sorted({ROOM + entry.module for entry in EFFECTS.values() if entry.module})
        early = [name for name in modules if name in sys.modules]
        if not apart:
            for module in modules:
                importlib.import_module(module)
        before = {} if apart else signatures(modules)
        found = {name: baked(name, absent, apart) for name in names}
        after = {} if apart else signatures(modules)
    print(json.dumps({"scenes": found, "early": early, "before": before, "after": after}))
