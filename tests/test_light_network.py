"""The network that is told the lights: what it is told, that light adds up, and that it learns where lamps are."""

import warnings
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_learned import error

from ddprt import harmonics
from ddprt.errors import UserError
from ddprt.lights import PointLight, parse_lighting
from ddprt.methods.light_network import LightNetwork, LightNetworks, Surroundings
from ddprt.methods.method import Examples, Frame
from ddprt.progress import Doubt

AROUND = Surroundings(np.array([1.0, 2.0, 3.0]), 2.0)
POSITIONS = np.random.default_rng(5).uniform(0, 1, (12, 3))
NORMALS = np.tile([0.0, 1.0, 0.0], (12, 1))
SQUARE = {"center": [1, 2, 5], "half_u": [0.5, 0, 0], "half_v": [0, 0.25, 0], "radiance": [1, 2, 4]}
TRIANGLES = [[[-0.5, -0.25, 2], [0.5, -0.25, 2], [0.5, 0.25, 2]], [[-0.5, -0.25, 2], [0.5, 0.25, 2], [-0.5, 0.25, 2]]]
LAMPS = {
    "point": {"type": "point", "position": [1, 2, 5], "intensity": [1, 2, 4]},
    "spot": {"type": "spot", "position": [1, 2, 5], "direction": [0, -1, 0], "intensity": [1, 2, 4], "outer_deg": 60},
    "directional": {"type": "directional", "direction": [0, -1, 0], "irradiance": [1, 2, 4]},
    "rect": {"type": "rect", **SQUARE},
    "sphere": {"type": "sphere", "center": [1, 2, 5], "radius": 0.5, "radiance": [1, 2, 4]},
    "mesh": {"type": "mesh", "mesh": TRIANGLES, "position": [1, 2, 3], "radiance": [1, 2, 4]},
}


def lamps(seed: int, count: int) -> list[Any]:
    """One to three points of light each, of any colour."""
    rng = np.random.default_rng(seed)
    lamp = lambda: PointLight(position=tuple(rng.uniform(0, 1, 3)), intensity=tuple(rng.uniform(0.1, 5, 3)))  # noqa: E731
    return [tuple(lamp() for _ in range(rng.integers(1, 4))) for _ in range(count)]


def pairs(seed: int, count: int, *, channels: str = "mono") -> Examples:
    """Light that waves with the place of each lamp, not with what points see of it."""
    world, lightings = np.random.default_rng(0), lamps(seed, count)
    waves, turns, maps = world.normal(0, 2, (3, 6)), world.uniform(0, 6, 6), world.standard_normal((6, 40))

    def total(of: Any) -> np.ndarray:
        return np.array([sum(np.outer(of(np.array(one.position)), one.intensity) for one in lights) for lights in lightings])

    light = total(lambda place: (np.cos(place @ waves + turns)) @ maps)
    values = total(lambda place: 1 / np.sum((POSITIONS - place) ** 2 + 0.1, 1))
    scale = np.linalg.norm(values, axis=1) if channels == "mono" else np.tile(np.linalg.norm(values, axis=(1, 2))[:, None], 3)
    frame = Frame(*(jnp.asarray(part, jnp.float32) for part in (values / scale[:, None], POSITIONS, NORMALS)), lightings)
    light = jnp.asarray(light / scale[:, None], jnp.float32)
    return Examples(frame, light, jnp.asarray(scale, jnp.float32), np.ones(40, np.float32), channels=channels)


def fitted(channels: str = "mono", **settings: Any) -> LightNetwork:
    method = LightNetworks(bases=6, features=64, steps=20, check_every=10, **settings)  # type: ignore[call-arg]
    return method.fit(pairs(1, 60, channels=channels), pairs(2, 12, channels=channels), key=jax.random.key(0))


def asked(network: LightNetwork, part: Examples) -> Examples:
    told = network.describe(part.frame.lightings or ()) / np.asarray(part.scale, np.float64)[:, None]
    return replace(part, frame=replace(part.frame, described=jnp.asarray(told, jnp.float32)))


@pytest.fixture(scope="module")
def network() -> LightNetwork:
    return fitted()


@pytest.mark.parametrize("channels", ["mono", "multi"])
def test_it_learns_where_lamps_are(channels: str, network: LightNetwork) -> None:
    found = network if channels == "mono" else fitted("multi")
    test = asked(found, pairs(3, 20, channels=channels))
    dark = replace(found, outputs=jnp.zeros_like(found.outputs))
    nothing = error(dark, asked(dark, test))
    # A tenth of the light, as root mean square: six smooth waves from 60 lightings; interleaved colours share six bases.
    assert error(found, test) < (0.1**2 if channels == "mono" else 0.3**2) * nothing


def test_lights_add_up_and_brightness_is_a_factor(network: LightNetwork) -> None:
    one, two = lamps(7, 2)
    apart = network.describe([one, two])
    # Sums in float64 in another order.
    np.testing.assert_allclose(network.describe([one + two])[0], apart.sum(0), rtol=1e-12, atol=1e-12 * np.abs(apart).max())
    bright = tuple(light.scaled(8.0) for light in one)
    np.testing.assert_array_equal(network.describe([bright])[0], 8 * apart[0])
    assert (network.describe([()]) == 0).all()


def test_where_a_lamp_stands_counts(network: LightNetwork) -> None:
    near, far = (parse_lighting({**LAMPS["point"], "position": [x, 0.5, 0.5]}) for x in (0.2, 0.8))
    assert not np.allclose(network.describe([near]), network.describe([far]), rtol=0.1)


@pytest.mark.parametrize("kind", LAMPS)
def test_every_kind_of_lamp_is_told(kind: str, network: LightNetwork) -> None:
    (light,) = parse_lighting(LAMPS[kind])
    ((strength, told),) = AROUND.lobes(light)
    power = {"rect": 0.5, "mesh": 0.5, "sphere": np.pi * 0.25}.get(kind, 1.0)  # area, or what a disc of its radius has
    unit = 1.0 if kind == "directional" else 4.0  # squared radius
    np.testing.assert_allclose(strength, power / unit * np.array([1, 2, 4]), rtol=1e-12)
    np.testing.assert_allclose(told[:3], [0, 0, 0] if kind == "directional" else [0, 0, 1], atol=1e-12)
    towards = {"spot": [0, -1, 0], "directional": [0, -1, 0], "rect": [0, 0, 1], "mesh": [0, 0, 1]}.get(kind, [0, 0, 0])
    np.testing.assert_allclose(told[3:6], towards, atol=1e-12)
    np.testing.assert_allclose(told[6:8], [1, 0.5] if kind == "spot" else [-1, -1], atol=1e-12)
    reach = {"rect": np.hypot(0.5, 0.25), "mesh": np.hypot(0.5, 0.25), "sphere": 0.5}.get(kind, 0.0)
    np.testing.assert_allclose(told[8:], [kind in ("rect", "mesh"), kind != "directional", reach / 2], atol=1e-12)
    assert np.isfinite(replace(network, kinds=kind).describe([(light,)])).all()


def test_a_kind_that_training_never_showed_is_doubted(network: LightNetwork) -> None:
    """A sky is told as directional lights, and is known where these are."""
    assert network.kinds == "point"
    lights = [parse_lighting(LAMPS[kind]) for kind in ("spot", "directional", "point")]
    sky = SimpleNamespace(kind="environment", harmonics=lambda order: np.ones((harmonics.count(order), 3)))
    with pytest.warns(Doubt, match="got light of type directional, spot, but was trained with point alone"):
        network.describe(lights)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        network.describe([lights[2], ()])
        replace(network, kinds="directional,spot").describe([lights[0] + lights[1], lights[0] + (sky,)])


@pytest.mark.parametrize(("radii", "share"), [(0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (2.0, 1 / 4), (10.0, 1 / 100)])
def test_a_lamp_counts_by_what_it_brings_to_the_centre(radii: float, share: float) -> None:
    """Of 4 W/sr, over a radius of 2 m; no more than from there, however near."""
    x, y, z = map(float, AROUND.centre)
    ((strength, told),) = AROUND.lobes(PointLight(position=(x, y + 2 * radii, z), intensity=(4.0, 4.0, 4.0)))
    np.testing.assert_allclose(strength, share, rtol=1e-12)
    assert told[1] == pytest.approx(radii)


def test_a_sky_is_directional_lights_of_its_harmonics(network: LightNetwork) -> None:
    """Sums over the nodes give back the harmonics that the sky has: the quadrature is exact for products of two."""
    given = np.random.default_rng(0).standard_normal((harmonics.count(6), 3))
    lobes = AROUND.lobes(SimpleNamespace(kind="environment", harmonics=lambda order: given))
    towards = -np.array([told[3:6] for _, told in lobes])
    np.testing.assert_allclose(harmonics.harmonics(towards, 6).T @ [strength for strength, _ in lobes], given, atol=1e-12)


def test_an_unknown_kind_is_refused(network: LightNetwork) -> None:
    with pytest.raises(UserError, match=r"^light-network: got a light of type laser, expected one of directional, [^\n]*$"):
        network.describe([(SimpleNamespace(kind="laser"),)])


def test_training_that_gains_nothing_is_not_taken() -> None:
    """A rate that ruins the network leaves the ridge's, to the bit."""
    wild, still = (fitted(learning_rate=rate, length=0.5) for rate in (1e3, 1e-30))
    test = pairs(3, 20)
    np.testing.assert_array_equal(*(one.predict(asked(one, test).frame) for one in (wild, still)))
