"""Probes beside surfaces that gloss: closed forms, the reference integrator, and the way through a bake."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_probes import RAYS, baked, job, noise_of_rays, traced

from ddprt.dataset.layers import layers, read_layer, read_light
from ddprt.lights import parse_lighting
from ddprt.progress import Progress
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.library import build
from ddprt.scene.material import Emission, Gloss, Material
from ddprt.scene.mesh import Scene
from ddprt.sections import TransportConfig
from ddprt.transport.embree import Tracer
from ddprt.transport.emission import Emitters
from ddprt.transport.emission_probes import probe_light
from ddprt.transport.lit_probes import gather
from ddprt.transport.reflected import Lit

LAMP = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [1, 1, 1]})
PLACES = np.array([[0.0, 0.0, 0.0], [0.4, -0.3, 0.5]])


@pytest.fixture(scope="module")
def mirrored() -> tuple[Scene, Atlas]:
    """A closed sphere, half of it a wall of albedo 1/2 that glows, half a mirror that keeps all but 4e-4 of the light."""
    scene = build("furnace", albedo=0.5, subdivisions=3)
    mirror = Material("mirror", (1.0, 1.0, 1.0), gloss=Gloss(0.1, 1.0))
    wall = replace(scene.materials[0], emission=Emission((0.5, 0.5, 0.5)))
    scene = replace(scene, materials=(wall, mirror), material=(scene.corners.mean(1)[:, 0] > 0).astype(np.int32))
    return scene, build_atlas(scene, 32)


def shown(scene: Scene, atlas: Atlas, radiance: float, emitters: Any = None) -> np.ndarray:
    """Harmonics at two places in the sphere whose wall scatters some radiance."""
    irradiance = np.full((atlas.count, 3, 1), 2 * np.pi * radiance, np.float32)
    lit = Lit.of(Tracer.of(scene, 2), scene, atlas, [()], irradiance, emitters)
    return np.concatenate(list(gather(lit, PLACES, RAYS, seed=0, stream="test")), 1)[0].astype(float)


def test_between_mirrors_all_sides_are_as_bright(mirrored: tuple[Scene, Atlas]) -> None:
    """A wall of radiance 1 fills mirrors with radiance 1; a path of white mirrors is kept 999 times of 1000, for 1 / 0.999."""
    found = shown(*mirrored, 1.0)
    expected, loss = np.pi * np.sqrt(4 * np.pi), 8 * 4e-4  # at most eight mirrors in a row but for one path in thousands
    noise = 4 * noise_of_rays(np.pi, RAYS) * np.sqrt(8 * 0.001)  # of roulette alone: all rays find the same
    assert (np.abs(found[:, 0] - expected) < noise[0] + loss * expected).all()
    assert (np.abs(found[:, 1:]) < 4 * noise_of_rays(np.pi, RAYS)[1:, None]).all()


def test_what_glows_is_seen_in_mirrors_but_not_straight(mirrored: tuple[Scene, Atlas]) -> None:
    """Half of the wall's radiance of 1 is its own glow. Straight from there it is direct light, told apart by `probe_light`."""
    scene, atlas = mirrored
    emitters = Emitters.of(scene)
    found, whole = shown(scene, atlas, 0.5, emitters), shown(scene, atlas, 1.0)
    dark, config = np.zeros((atlas.count, 3), np.float32), TransportConfig()
    straight = probe_light(emitters, Tracer.of(scene, 2), atlas, dark, PLACES, config, RAYS, seed=1, bounces=0)
    assert straight.light[:, 0].min() > 0.5  # half of pi sqrt(4 pi) / 2, more or less
    bound = 4 * noise_of_rays(np.pi, RAYS) * 2  # three estimates, of light up to 1, 1 and 1/2
    assert (np.abs(whole - found - straight.light) < bound[:, None]).all()


def test_light_is_that_of_the_reference() -> None:
    """All light of a bake, gold that lights the wall beside it included, with a metal vase and its layer in the same bake."""
    scene, rng = build("glossy-room", roughness=0.4), np.random.default_rng(3)
    low, high = scene.bounds
    place = low + (high - low) * rng.uniform(0.08, 0.92, (40, 3))
    place = place[Tracer.of(scene).clearance(place) > 0.05][:6]
    shown = Progress(quiet=True)
    config = job(atlas={"resolution": 48}, transport={"samples": 2, "test_samples": 32, "direct_samples": 16})
    config = config.model_copy(update={"probes": config.probes.model_copy(update={"grid": (0, 0, 0), "rays": 2048})})
    one = {"train": [LAMP], "validation": [LAMP], "test": [LAMP]}
    data = baked(scene, config, one, place.tolist(), progress=shown)
    assert {layer.name for layer in layers(data)} == {"probes", "gloss-8"}
    assert {"probes train", "probes test"} <= {str(stage["name"]) for stage in shown.stages}
    layer = read_layer(data, "probes")
    ours, noise = (read_light(data, layer, [2], kind)[0].astype(float) for kind in ("light", "noise"))
    truth, spread = traced(scene, place, 256)
    own = (noise**2).mean(0)  # of each harmonic, pooled over probes
    z = ((ours - truth) / np.sqrt(spread + own))[..., 1]
    print(f"z {z.mean():+.3f} +- {z.std():.3f}; bias {ours[:, 0].sum() / truth[:, 0].sum() - 1:+.4f}")
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.std() - 1) < 4 / np.sqrt(2 * z.size)
