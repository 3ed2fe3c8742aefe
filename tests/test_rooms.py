"""The walk: every room imports only what lies to its left, and the heavy libraries have one door each."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "ddprt"
GROUND = {"errors", "axes", "catalogue", "compiled", "seeds", "warp", "harmonics", "files", "progress", "machine"}
WALK = [
    "sections",
    "config",
    "scene",
    "lights",
    "sampling",
    "transport",
    "dataset",
    "fitting",
    "training",
    "methods",
    "runtime",
    "report",
    "export",
    "bench",
    "pipeline_active",
    "pipeline",
    "pipeline_animation",
    "pipeline_inspect",
    "call",
    "verbs_alone",
    "verbs",
    "cli",
]
BENCH = {
    "measure": [],
    "budget": [],
    "frontier": ["measure"],
    "tune": ["measure"],
    "peers": ["measure"],
    "effects": ["measure"],
    "leagues": ["measure"],
}
"""The parts of that room, and which other parts each may import."""
FILES = sorted(PACKAGE.rglob("*.py"))
NUMPY_ROOMS = {"scene", "lights", "sampling", "transport", "dataset", "export", *GROUND, "config"}


def imports(path: Path) -> list[str]:
    """Every module that a file imports, at the top or inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.append(node.module or "")
            if node.module == "ddprt":
                found += [f"ddprt.{alias.name}" for alias in node.names if is_room(alias.name)]
    return found


def is_room(name: str) -> bool:
    return (PACKAGE / name).is_dir() or (PACKAGE / f"{name}.py").exists()


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def own(module: str) -> str | None:
    parts = module.split(".")
    return (parts[1] if len(parts) > 1 else "__init__") if parts[0] == "ddprt" else None


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_nothing_imports_to_its_right(path: Path) -> None:
    here = room(path)
    if here in ("__init__", "__main__"):
        return
    for module in imports(path):
        target = own(module)
        if target is None or target in ("__init__", *GROUND):
            assert here not in GROUND or target != "config"
            continue
        assert target in WALK, f"{path}: imports {module}, which is in no room"
        assert here not in GROUND, f"{path}: the ground imports {module}"
        assert WALK.index(target) <= WALK.index(here), f"{path}: {here} imports {module}, which lies to its right"


@pytest.mark.parametrize("part", sorted({path.parts[-2] for path in FILES if path.parts[-3] == "bench"}))
def test_parts_of_the_bench_know_only_what_measures(part: str) -> None:
    for path in (PACKAGE / "bench" / part).glob("*.py"):
        found = [module.split(".")[2:] for module in imports(path) if module.startswith("ddprt.bench")]
        assert all(found), f"{path}: imports from ddprt.bench, expected one of its parts"
        assert {names[0] for names in found} <= {part, *BENCH[part]}, path


def test_modules_of_the_bench_stand_in_its_parts() -> None:
    assert [path.name for path in (PACKAGE / "bench").glob("*.py")] == ["__init__.py"]


def doors(library: str) -> set[str]:
    return {
        str(path.relative_to(PACKAGE)) for path in FILES if any(module.split(".")[0] == library for module in imports(path))
    }


def test_each_heavy_library_has_its_door() -> None:
    assert doors("embreex") == {"transport/packets.py"}
    assert doors("OpenEXR") == {"scene/exr.py"}
    assert doors("xatlas") == {"scene/unwrap.py"}
    assert doors("pyoidn") == {"dataset/denoise.py"}
    assert doors("numba") == doors("llvmlite") == {"compiled.py"}
    assert doors("flip_evaluator") == {"report/perceived.py"}
    assert doors("ispc_texcomp") == {"export/formats/bc6h.py"}
    assert doors("optax") == {"training/loop.py", "training/schedule.py"}
    assert {Path(name).parts[0] for name in doors("matplotlib")} == {"report"}


def test_jax_begins_after_the_dataset() -> None:
    assert not {name for name in doors("jax") if room(PACKAGE / name) in NUMPY_ROOMS}


def test_every_room_says_what_enters_and_leaves() -> None:
    for folder in {path.parent for path in FILES} - {PACKAGE}:
        text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
        assert text, folder
        assert "Enters" in text, folder
        assert "Leaves" in text, folder


def test_files_hold_one_idea() -> None:
    long = {str(path.relative_to(PACKAGE)): n for path in FILES if (n := len(path.read_text().splitlines())) > 400}
    assert not long


@pytest.mark.parametrize("statement", ["import ddprt", "import ddprt.cli", "from ddprt.config import Config"])
def test_light_imports_stay_light(statement: str) -> None:
    heavy = ("jax", "embreex", "numba", "matplotlib", "tyro", "rich", "scipy")
    code = f"{statement}\nimport sys; print([m for m in {heavy} if m in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_public_names_resolve() -> None:
    import ddprt

    for name in ddprt.__all__:
        assert getattr(ddprt, name) is not None
    assert callable(ddprt.fit), "a room must not hide a public name"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        ddprt.nothing  # noqa: B018
