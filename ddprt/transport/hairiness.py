"""Whether strands are simulated as hair, and what cannot be simulated beside it.

Judged from the scene alone: what simulates hair is `ddprt.transport.hair`, which is imported where there is some.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from ddprt.errors import UserError
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer

BESIDE = ("gloss", "emission", "probes")
"""Effects that nothing simulates yet in a scene with hair."""


def hairy(scene: Scene) -> bool:
    """Whether a scene has strands that scatter as fibres do; others are diffuse tubes."""
    return scene.strand_material is not None and scene.strand_material.fibre is not None


def diffuse(material: Material) -> Material:
    """The material of plain tubes in place of fibres."""
    return replace(material, fibre=None) if material.fibre else material


def strands_of(tracer: Tracer, scene: Scene, smooth: bool = False) -> Any:
    """The `ddprt.transport.hair.Hair` of a scene; None, and nothing imported, where there is none."""
    return import_module("ddprt.transport.hair").Hair.of(tracer, scene, smooth) if hairy(scene) else None


def borrowed_along(scene: Scene, share: float, paths: int) -> Callable[[np.ndarray], np.ndarray]:
    """What texels of strands make of a map by borrowing along them (`ddprt.transport.along_strands`); without hair, nothing."""
    if scene.tubes is None or not hairy(scene) or share == 0:
        return lambda light: light
    module = import_module("ddprt.transport.along_strands")
    return partial(module.borrowed, strands=len(scene.tubes.axis), weights=module.borrowing(share, paths))


def refuse_hairy(scene: Scene, what: str, remedy: str) -> None:
    """Makes sure that a scene has no hair.

    Raises:
      UserError: it has.
    """
    if hairy(scene):
        raise UserError(
            f"{what}: got hair, which would be taken for diffuse tubes, expected a scene without; {remedy}, or "
            'set effects.off = ["hair"]'
        )


def refuse_beside(called: Callable[[str], bool], denoised: bool) -> None:
    """Makes sure that a plan with hair has nothing that knows no hair.

    Args:
      called: whether an effect is simulated, by name.
      denoised: maps are to be smoothed, which knows neighbours on surfaces and none on strands.
    Raises:
      UserError: it has.
    """
    if not called("hair"):
        return
    found = [name for name in BESIDE if called(name)]
    if found or denoised:
        remedy = "ask for no probes" if found == ["probes"] else f'set effects.off = ["{found[0]}"]' if found else ""
        what = (
            f"effects: got hair beside {' and '.join(found)}" if found else "transport.denoise: got true for a scene with hair"
        )
        raise UserError(f"{what}, which is not simulated yet, expected one without the other; {remedy or 'set it to false'}")
