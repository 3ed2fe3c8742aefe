"""Data-driven precomputed radiance transfer: learn how a scene answers to light, relight it without tracing a ray.

Everything the command line does, in plain Python:

    scene = ddprt.load_scene("cornell")
    data  = ddprt.bake(scene, resolution=128)
    model = ddprt.fit(data, bases=16)
    image = model.relight({"type": "point", "position": [0.3, 0.4, 0.2], "intensity": [1, 1, 1]})

Names are loaded when they are first used; importing this package is instant and imports no JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from ddprt.dataset.animated import bake_animation as bake_animation
    from ddprt.dataset.generate import bake as bake
    from ddprt.dataset.store import open_dataset as open_dataset
    from ddprt.errors import UserError as UserError
    from ddprt.lights import load_lightings as load_lightings
    from ddprt.lights import scene_lights as scene_lights
    from ddprt.methods import METHODS as METHODS
    from ddprt.runtime.animated_file import load_animated as load_animated
    from ddprt.runtime.model_file import load_model as load_model
    from ddprt.runtime.train import fit as fit
    from ddprt.runtime.train_animated import fit_animation as fit_animation
    from ddprt.scene.files import load_scene as load_scene
    from ddprt.scene.library import SCENES as SCENES
    from ddprt.scene.poses import load_animation as load_animation
    from ddprt.transport.effects import force as force
    from ddprt.transport.effects import plan as plan
    from ddprt.transport.irradiance import irradiance as irradiance

_HOMES = {
    "METHODS": "ddprt.methods",
    "SCENES": "ddprt.scene.library",
    "UserError": "ddprt.errors",
    "bake": "ddprt.dataset.generate",
    "bake_animation": "ddprt.dataset.animated",
    "fit": "ddprt.runtime.train",
    "fit_animation": "ddprt.runtime.train_animated",
    "force": "ddprt.transport.effects",
    "irradiance": "ddprt.transport.irradiance",
    "load_animated": "ddprt.runtime.animated_file",
    "load_animation": "ddprt.scene.poses",
    "load_lightings": "ddprt.lights",
    "load_model": "ddprt.runtime.model_file",
    "load_scene": "ddprt.scene.files",
    "open_dataset": "ddprt.dataset.store",
    "plan": "ddprt.transport.effects",
    "scene_lights": "ddprt.lights",
}
__all__ = ["__version__", *sorted(_HOMES)]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'ddprt' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
