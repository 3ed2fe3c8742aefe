"""Suns in the place of lamps, for laws that hold for methods that answer from lights as for those that answer from points.

Whoever measured a frame had lights on. Here they are a sun each: it stands where the frame is bright, and has its colour.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hard_arrays import Arrays

import ddprt
from ddprt.dataset.store import Dataset
from ddprt.lights import DirectionalLight, Lighting, lighting_json
from ddprt.methods import METHODS
from ddprt.methods.learned import Learned
from ddprt.methods.method import AsksForLights
from ddprt.runtime.model import Model

SETTINGS: dict[str, dict[str, Any]] = {
    "mlp": {"steps": 300, "width": 32},
    "residual": {"steps": 300, "width": 32},
    "neural-lightmap": {"steps": 100, "width": 8},
    "sh-prt": {"order": 1, "space": "linear"},
    "light-network": {"features": 16, "length": 1.0, "steps": 100, "space": "linear"},
    "point-set": {"steps": 100, "width": 16},
}


def _slow(method: str) -> bool:
    return issubclass(METHODS[method], Learned) and method != "mlp"


ALL_METHODS = [pytest.param(name, marks=[pytest.mark.slow] if _slow(name) else []) for name in sorted(METHODS)]
"""For laws that no method has code of its own for: of those that are trained, which takes seconds, one is in the fast suite."""


def asks(method: str) -> bool:
    """Whether it answers from lights."""
    return hasattr(METHODS[method].relighter, "describe")


def sun_of(frame: np.ndarray, positions: np.ndarray) -> Lighting:
    """A sun over the brightest side of measured points. Its direction knows no unit: a power of two changes no digit of it."""
    peak = frame.max(0, initial=0).astype(np.float64)
    relative = (frame / np.where(peak > 0, peak, 1)).sum(1, dtype=np.float64)
    towards = relative @ (positions - positions.mean(0)) + [0.0, 1e-6, 0.0]
    return (DirectionalLight(direction=tuple((-towards).tolist()), irradiance=tuple(peak.tolist())),)


def under_suns(data: Dataset) -> Arrays:
    """The same light, said to come from suns."""
    every = range(len(data.lightings))
    points = data.description["points"]["count"]
    measured = data.values(every, points, "radiosity")
    entries = [
        {**entry, "lights": lighting_json(sun_of(frame, data.samples.position[:points]))}
        for entry, frame in zip(data.description["lightings"], measured, strict=True)
    ]
    other = Arrays(data.folder, {**data.description, "lightings": entries}, None, measured, data.maps("indirect", every))
    other.__dict__.update({name: getattr(data, name) for name in ("gbuffer", "covered", "samples", "occluders", "uv", "holes")})
    return other


@dataclass(frozen=True, eq=False)
class Lit:
    """A model that answers from lights, asked as one that answers from points."""

    model: Any

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)

    def predict(self, values: np.ndarray, **options: Any) -> np.ndarray:
        positions = self.model.samples.position[: self.model.points]
        suns = [sun_of(frame, positions) for frame in values.reshape(-1, *values.shape[-2:])]
        return self.model.predict(values, lightings=suns[0] if values.ndim == 2 else suns, **options)


def fit(data: Dataset, method: str, *, settings: dict[str, Any] | None = None, **options: Any) -> Any:
    """`ddprt.fit` with settings for a quick test; methods that answer from lights learn from suns."""
    settings = SETTINGS.get(method) if settings is None else settings
    if not asks(method):
        return ddprt.fit(data, method, settings=settings, **options)
    return Lit(ddprt.fit(under_suns(data), method, settings=settings, **options))


def bare(model: Any) -> Model:
    """The model itself, to be handed to the package."""
    return model.model if isinstance(model, Lit) else model


def load_model(folder: str) -> Any:
    """`ddprt.load_model`, likewise."""
    model = ddprt.load_model(folder)
    return Lit(model) if isinstance(model.relighter, AsksForLights) else model
