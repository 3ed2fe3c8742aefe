"""What a run ran on: recorded beside every measured second."""

import hashlib
import os
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("numpy", "scipy", "jax", "jaxlib", "optax", "trimesh", "embreex", "OpenEXR", "xatlas", "pydantic", "safetensors")


def machine() -> dict[str, Any]:
    """Processor, cores, memory, system, and the versions that results depend on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
        if hasattr(os, "sysconf")
        else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: installed(name) for name in PACKAGES},
    }


def instruction_set() -> str:
    """What code compiled here may ask of a processor, as eight digits: elsewhere it might not run."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        kinds = sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    except OSError:
        kinds = [platform.processor()]
    return hashlib.sha256("\n".join([platform.machine(), *kinds]).encode()).hexdigest()[:8]


@cache
def installed(package: str) -> str | None:
    """Version of an installed package, None where it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def commit() -> str | None:
    """Short hash of the checkout that this code runs from, "+" where files differ from it; None where it is no checkout."""
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():
        return None
    try:
        found = subprocess.run(["git", "-C", str(root), "describe", "--always", "--dirty=+"], capture_output=True, text=True)
    except OSError:  # no git
        return None
    return found.stdout.strip() or None


def peak_memory_gib() -> float | None:
    """Largest resident memory of this process so far."""
    try:
        import resource
    except ImportError:
        return None
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"
