"""Indirect light in a foggy room against Mitsuba's `volpathmis`: z-scores with both variances.

A box without a surface of its own holds the fog there. The light is the sun's: a lamp in the fog has no finite variance where
places are drawn by the fog alone, as they are there.
"""

from typing import Any

import numpy as np
import pytest
from test_mitsuba import GREEN, POINTS, mi, mitsuba_scene, surface_points, z_scores

import ddprt
from ddprt import warp
from ddprt.scene.fog import Fog
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.transport.effects import force

pytestmark = pytest.mark.slow

SAMPLES = 128
"""Paths per point on both sides."""

SUN: dict[str, Any] = {"type": "directional", "direction": [-0.3, -0.5, 1.0], "irradiance": [1.0, 0.9, 0.8]}
MARGIN = 1e-4
"""Metres between the room's walls and the box: one inside the other, not one on the other."""


def in_fog(scene: Scene, fog: Fog) -> tuple[Any, Any]:
    """The scene there, and its fog."""
    shortest = min(fog.mean_free_path)
    medium = mi.load_dict(
        {
            "type": "homogeneous",
            "albedo": {"type": "rgb", "value": list(fog.albedo)},
            "sigma_t": {"type": "rgb", "value": [shortest / length for length in fog.mean_free_path]},
            "scale": 1 / shortest,
            "phase": {"type": "hg", "g": fog.anisotropy},
        }
    )
    low, high = scene.bounds[0] - MARGIN, scene.bounds[1] + MARGIN
    place = mi.ScalarTransform4f().translate(((low + high) / 2).tolist()).scale(((high - low) / 2).tolist())
    box = mi.load_dict({"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium})
    room = mitsuba_scene(scene, SUN)
    parts = {f"part{index}": shape for index, shape in enumerate(room.shapes())}
    return mi.load_dict({"type": "scene", "light": mi.load_dict(_sun()), "box": box, **parts}), medium


def _sun() -> dict[str, Any]:
    return {"type": "directional", "direction": SUN["direction"], "irradiance": {"type": "rgb", "value": SUN["irradiance"]}}


@pytest.mark.parametrize("fog", [Fog((0.6, 0.4, 0.3), (1.0, 0.9, 0.7), 0.0), Fog((0.3, 0.2, 0.3), (0.9, 0.95, 0.9), 0.6)])
def test_light_in_a_foggy_room_agrees_with_mitsuba(fog: Fog) -> None:
    mi.set_variant("scalar_rgb")
    rng, scene = np.random.default_rng(6), build("foggy-room")
    places, normals = surface_points(scene, rng)
    there, medium = in_fog(scene, fog)
    integrator = mi.load_dict({"type": "volpathmis", "hide_emitters": True, "max_depth": -1, "rr_depth": 64})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1)
    found = []
    for place, normal in zip(places, normals, strict=True):
        facing = np.repeat(normal[None].astype(np.float32), SAMPLES, 0)
        ways = warp.to_world(warp.sample_cosine(rng.random((SAMPLES, 2), np.float32)), warp.frame(facing))
        origin = (place + 1e-6 * normal).tolist()
        rays = (integrator.sample(there, sampler, mi.RayDifferential3f(origin, way), medium)[0] for way in ways.tolist())
        values = np.pi * np.array([ray[GREEN] for ray in rays])
        found.append((values.mean(), values.var() / SAMPLES))
    theirs, their_variance = np.array(found).T
    misty = ddprt.load_scene("foggy-room", fog=fog)
    ours = ddprt.irradiance(misty, SUN, places, normals, samples=SAMPLES, seed=1, return_variance=True)
    z = z_scores(np.array([ours[1][:, GREEN], theirs, ours[3][:, GREEN], their_variance]))
    clear = ddprt.irradiance(force(misty, off=["fog"]), SUN, places, normals, samples=SAMPLES, seed=1)[1][:, GREEN]
    print(f"{len(z)} points, z {z.mean():+.3f} +- {z.std():.3f}; {ours[1][:, GREEN].mean():.4f}, {theirs.mean():.4f}, "
          f"in clear air {clear.mean():.4f}")  # fmt: skip
    assert len(z) > 0.95 * POINTS
    # 256 scores: the mean is known to 0.0625, the standard deviation to 0.044; four of these each.
    assert abs(z.mean()) < 0.25
    assert abs(z.std() - 1) < 0.18
    assert abs(ours[1][:, GREEN].mean() / theirs.mean() - 1) < 0.05
