"""Probes by paths: in fog, and in clear air where the lightmap is traced without the operator."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_probes import LAMP, job, traced

import ddprt
from ddprt.dataset.forecast import forecast
from ddprt.dataset.layers import read_layer, read_light
from ddprt.lights import parse_lighting
from ddprt.progress import Progress
from ddprt.scene.fog import Fog
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, hollow
from ddprt.transport import path_probes
from ddprt.transport.embree import Tracer
from ddprt.transport.path_probes import Walks

SUN = parse_lighting({"type": "directional", "direction": [0.2, -0.3, 1], "irradiance": [1, 1, 1]})
SMALL = job(atlas={"resolution": 24}, points={"count": 8}, probes={"grid": [2, 2, 2], "rays": 256})
PLACES = np.array([[0.28, 0.3, 0.1], [0.1, 0.45, 0.4], [0.45, 0.08, 0.1], [0.28, 0.5, 0.5], [0.03, 0.2, 0.03], [0.5, 0.3, 0.3]])


def gathered(scene: Scene, lightings: Any, places: np.ndarray, rays: int, *, bounces: int = -1, **address: Any) -> np.ndarray:
    walks = Walks.of(Tracer.of(scene, 2), scene, lightings, bounces)
    parts = path_probes.gather(walks, places, rays, **{"seed": 0, "stream": "test", **address})
    return np.concatenate(list(parts), 1).astype(float)


@pytest.mark.parametrize("name", ["foggy-room", "cornell"])
def test_light_is_that_of_the_reference(name: str) -> None:
    """Nine coefficients each; the variance of ours is that of eight runs, which widens scores to 1.2."""
    scene, rays = build(name), 512
    runs = np.stack([gathered(scene, [LAMP], PLACES, rays, stream=f"run {run}")[0] for run in range(8)])
    truth, spread = traced(scene, PLACES, 512)
    z = ((runs.mean(0) - truth) / np.sqrt(spread + runs.var(0, ddof=1) / 8))[..., 1]
    energy = runs.mean(0)[:, 0].sum() / truth[:, 0].sum()
    print(f"{name}: z {z.mean():+.3f} +- {z.std():.3f}, energy {energy - 1:+.4f}")
    assert abs(z.mean()) < 4 * 1.2 / np.sqrt(z.size)
    assert 0.7 < z.std() < 1.7
    assert abs(energy - 1) < 0.05


def test_a_probe_in_black_fog_sees_walls_through_it() -> None:
    """A furnace of radius 1 with a lamp in its middle: what walls send back there once fades on the way to them and back."""
    scene = build("furnace", subdivisions=4)
    lamp, middle = parse_lighting({"type": "point", "position": [0, 0, 0], "intensity": [2, 2, 2]}), np.zeros((1, 3))
    first = 2 * 0.5 * np.sqrt(4 * np.pi)  # of irradiance that is the same for all normals: intensity times albedo
    for path in (np.full(3, np.inf), np.array([1.0, 0.5, 4.0])):
        there = scene if np.isinf(path).all() else replace(scene, fog=Fog(tuple(path.tolist()), (0.0,) * 3))
        runs = np.stack([gathered(there, [lamp], middle, 4096, bounces=1, stream=f"run {run}")[0, 0] for run in range(8)])
        mean, error = runs.mean(0), runs.std(0, ddof=1) / 8**0.5
        expected = first * np.exp(-2 / path)
        assert (error[0] < 0.04 * expected).all()
        # Student's t of 7 degrees of freedom exceeds 5.4 once in a thousand times; facets lie up to 0.3 % nearer than 1.
        assert (np.abs(mean[0] - expected) < 5.4 * error[0] + 5e-3 * expected).all()
        assert (np.abs(mean[1:]) < 5.4 * error[1:] + 2e-3 * first).all()


def test_light_adds_and_knows_no_threads() -> None:
    room = build("foggy-room")
    bright = parse_lighting({"type": "point", "position": [0.28, 0.45, 0.28], "intensity": [2, 2, 2]})
    lightings = [LAMP, SUN, (*LAMP, *SUN), bright]
    lamp, sun, both, twice = gathered(room, lightings, PLACES, 64)
    one = Walks.of(Tracer.of(room, 1), room, [LAMP], -1)
    alone = np.concatenate(list(path_probes.gather(one, PLACES, 64, seed=0, stream="test")), 1)[0]
    np.testing.assert_array_equal(lamp, alone)
    np.testing.assert_array_equal(twice, 2 * lamp)
    np.testing.assert_allclose(both, lamp + sun, rtol=1e-4, atol=1e-5 * np.abs(both).max())


def test_rays_are_chosen_by_the_noise_that_they_leave() -> None:
    """Told against eight runs; twice the target takes a quarter of the rays, up to the powers of two."""
    room = build("foggy-room")
    walks = Walks.of(Tracer.of(room, 2), room, [LAMP], -1)
    rays, told = path_probes.choose_rays(walks, PLACES, 0.15, halves=1, seed=0, stream="choice")
    fewer, _ = path_probes.choose_rays(walks, PLACES, 0.3, halves=1, seed=0, stream="choice")
    runs = np.stack([gathered(room, [LAMP], PLACES, rays, stream=f"run {run}")[0] for run in range(8)])
    found = np.sqrt(runs.var(0, ddof=1).sum(1).mean()) / runs[:, :, 0].mean()
    print(rays, fewer, told, found)
    assert 2 <= rays / fewer <= 8
    assert told <= 0.15
    assert found == pytest.approx(told, rel=0.5)


# --- in a bake -----------------------------------------------------------------------------------------------------------


def test_probes_in_fog_are_baked() -> None:
    with pytest.warns(UserWarning, match="inside solids"):
        foggy = ddprt.bake(build("foggy-room"), config=SMALL)
    layer = read_layer(foggy, "probes")
    light, noise = (read_light(foggy, layer, foggy.split("test"), kind) for kind in ("light", "noise"))
    open_air = layer.weight > 0
    assert 0 < open_air.sum() < len(open_air)
    assert (light[:, open_air, 0] > 0).all()
    assert not light[:, ~open_air].any()
    assert 0 < np.abs(noise[:, open_air]).mean() < np.abs(light[:, open_air, 0]).mean()


def test_a_black_room_in_fog_lights_its_probes() -> None:
    half = np.array([-0.5, 0.5])
    room = faceted("box", hollow(np.ones((1, 1, 1), bool), half, half, half), (Material("black", (0.0,) * 3),))
    few: dict[str, Any] = {"atlas": {"resolution": 16}, "points": {"count": 4}, "probes": {"grid": [1, 1, 1], "rays": 64}}
    for albedo, lit in ((1.0, True), (0.0, False)):
        data = ddprt.bake(replace(room, fog=Fog((0.5,) * 3, (albedo,) * 3)), config=job(**few))
        assert read_light(data, read_layer(data, "probes"), [0]).any() == lit


def test_probes_of_every_integrator_agree(cornell: Scene) -> None:
    """By senders, by paths, and beside maps of the reference: what leaves walls, but for noise and the size of senders."""
    places: dict[str, Any] = {"grid": [2, 2, 1], "region_low": [0, 0, 0], "region_high": [1, 1, 0.5], "rays": 1024}
    few: dict[str, Any] = {"atlas": {"resolution": 24}, "points": {"count": 4}, "probes": places}
    found = []
    for integrator in ("operator", "paths", "reference"):
        config = job(**few, transport={"integrator": integrator, "samples": 4, "test_samples": 4})
        shown = Progress(quiet=True)
        data = ddprt.bake(cornell, [LAMP] * 14, config=config, progress=shown)
        found.append(read_light(data, read_layer(data, "probes"), data.split("test")[:1])[0].astype(float))
        rays = next(stage["rays"] for stage in shown.stages if stage["name"] == "probes train")
        assert (rays > 4 * 1024) == (integrator != "operator")
    np.testing.assert_array_equal(found[1], found[2])
    assert np.linalg.norm(found[1] - found[0]) < 0.12 * np.linalg.norm(found[0])


def test_a_dry_run_tells_the_rays_of_probes_in_fog() -> None:
    room, shown = build("foggy-room"), Progress(quiet=True)
    with pytest.warns(UserWarning, match="inside solids"):
        told = {stage.name: stage.rays for stage in forecast(room, config=SMALL, progress=Progress(quiet=True)).stages}
    with pytest.warns(UserWarning, match="inside solids"):
        ddprt.bake(room, config=SMALL, progress=shown)
    took = {str(stage["name"]): stage.get("rays") for stage in shown.stages}
    for split in ("probes train", "probes test"):
        assert told[split] == pytest.approx(took[split], rel=0.1)
