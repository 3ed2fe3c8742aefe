"""Denoising: of training maps alone, and only where it is asked for."""

import sys

import numpy as np
import pytest

from ddprt.config import Config
from ddprt.dataset.denoise import denoised
from ddprt.dataset.generate import bake
from ddprt.dataset.store import Dataset
from ddprt.errors import UserError
from ddprt.scene.atlas import Atlas
from ddprt.scene.mesh import Scene

pytest.importorskip("pyoidn")


def small(denoise: bool, samples: int) -> Config:
    return Config.model_validate(
        {
            "atlas": {"resolution": 64},
            "lightings": {"train": 2, "validation": 1, "test": 1},
            "points": {"count": 16, "supersample": 1},
            "transport": {"samples": samples, "test_samples": 32, "footprint": 0.0, "denoise": denoise},
        }
    )


def test_training_maps_gain_and_held_out_maps_stay(cornell: Scene) -> None:
    plain, smooth, truth = (bake(cornell, config=small(*how)) for how in ((False, 16), (True, 16), (False, 2048)))
    reference = truth.maps("indirect", [0, 1])

    def error(data: Dataset) -> float:
        return float(np.sqrt(np.mean((data.maps("indirect", [0, 1]) - reference) ** 2)) / reference.mean())

    assert error(smooth) < 0.6 * error(plain)
    assert smooth.maps("indirect", [0, 1]).mean() == pytest.approx(reference.mean(), rel=0.03)
    for kind in ("indirect", "noise"):
        np.testing.assert_array_equal(smooth.maps(kind, [3]), plain.maps(kind, [3]))
    np.testing.assert_array_equal(smooth.maps("direct", range(4)), plain.maps("direct", range(4)))


def test_any_brightness(cornell_atlas: Atlas) -> None:
    light = np.random.default_rng(0).gamma(4, 0.25, (cornell_atlas.count, 3)).astype(np.float32)
    assert not denoised(cornell_atlas, np.zeros_like(light)).any()
    once, bright = denoised(cornell_atlas, light), denoised(cornell_atlas, light * np.float32(2.0**40))
    np.testing.assert_allclose(bright, once * np.float32(2.0**40), rtol=1e-3)  # the filter reckons in half floats


def test_without_the_package_one_line_and_no_bake(cornell: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(UserError, match=r"^transport\.denoise: got .*; pip install \"ddprt\[denoise\]\"$"):
        bake(cornell, config=small(True, 16))
