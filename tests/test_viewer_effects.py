"""The viewer beside every effect that it shows, in a browser: light in fog, through holes, from what glows, out of marble.

Also held-out lightings of all kinds of lamps, those that the browser cannot draw among them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import Seen, browsed, displayed, off, seen

import ddprt
from ddprt.config import load_config
from ddprt.export.viewer.pack import pack
from ddprt.export.viewer.page import page
from ddprt.lights import lighting_json, parse_lighting
from ddprt.report.view import camera_for
from ddprt.runtime.model import Model
from ddprt.scene.exr import write_exr
from ddprt.scene.library import build
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure

PROBE = "".join((Path(__file__).parent / name).read_text("utf-8") for name in ("page_probe.js", "effects_probe.js"))
SMALL = {"atlas.resolution": "40", "points.count": "16", "points.supersample": "4", "transport.samples": "32"}
SMALL |= {"transport.test_samples": "32", "transport.threads": "2"}
AROUND = {"points.on": "hull", "lightings.distribution": "around"}


def lamps(x: float, y: float, z: float, size: float) -> list[list[dict[str, Any]]]:
    """Lightings about a place: points, a spot with a sun, and a spot with a rectangle."""
    point = {"type": "point", "intensity": [4 * size**2, 2 * size**2, 3 * size**2]}
    spot = {"type": "spot", "position": [x, y, z], "direction": [0.2, -1, 0.3], "outer_deg": 60, "intensity": [9 * size**2] * 3}
    sun = {"type": "directional", "direction": [0.3, -0.5, 1], "irradiance": [1, 2, 3]}
    rect = {
        "type": "rect",
        "center": [x, y, z],
        "half_u": [size / 8, 0, 0],
        "half_v": [0, 0, size / 8],
        "radiance": [20, 30, 40],
    }
    train = [[{**point, "position": [x + dx * size, y, z + dz * size]}] for dx in (-0.5, 0, 0.5) for dz in (-0.5, 0, 0.4)]
    return [*train, [spot, sun], [spot], [spot, sun, train[4][0]], [{**spot, "intensity": [size**2] * 3}, rect]]


CASES: dict[str, tuple[Any, dict[str, str], list[list[dict[str, Any]]]]] = {
    "foggy-room": (lambda: build("foggy-room", mean_free_path=0.4), {"transport.bounces": "2"}, lamps(0.28, 0.4, 0.28, 0.3)),
    "leaves": (lambda: build("leaves"), {}, lamps(1.0, 1.7, 1.0, 1.0)),
    "neon": (lambda: build("neon"), {}, lamps(0.0, 1.8, 1.6, 1.5)),
    "statue-marble": (lambda: build("statue-marble", subdivisions=3), AROUND, lamps(0.05, 0.5, -0.3, 0.4)),
}


@dataclass(frozen=True)
class Shown:
    """A scene, its model, what the page holds and what it showed."""

    scene: Any
    model: Model
    packed: dict[str, Any]
    data: Any
    found: dict[str, Any]

    def pixels(self, name: str) -> Seen:
        camera = camera_for(self.model.scene["name"], self.model.occluders)
        return seen(self.found[name], camera, self.found["fov"], Tracer.of(self.scene))

    def displayed(self, name: str, light: np.ndarray) -> np.ndarray:
        """Irradiance on white as it is shown at the exposure of a picture."""
        return displayed(2.0 ** self.found[name]["exposure"] / np.pi * light)

    def reflects(self, there: Seen) -> np.ndarray:
        """(pixels, 1) whether lamps are reflected there: not by what light passes."""
        solid = np.array([material.subsurface is None for material in self.scene.materials])[
            self.scene.material[there.triangle]
        ]
        assert solid.all() if self.model.exitant is None else 0.05 < solid.mean() < 0.95
        return solid[:, None]

    def texel(self, there: Seen, name: str) -> np.ndarray:
        """A map (height, width, 4) that the page told, as it is filtered on the screen."""
        image = np.reshape(self.found[name], (*self.model.covered.shape, 4))[..., :3]
        uv = np.einsum("nc,ncd->nd", there.corners, self.model.uv[there.triangle])
        height, width = image.shape[:2]
        x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
        left, top = np.floor(x).astype(int), np.floor(y).astype(int)
        column, row = (np.clip([at, at + 1], 0, size - 1) for at, size in ((left, width), (top, height)))
        a, b = (x - left)[:, None], (y - top)[:, None]
        lines = [image[r, column[0]] * (1 - a) + image[r, column[1]] * a for r in row]
        return lines[0] * (1 - b) + lines[1] * b


@pytest.fixture(scope="module", params=CASES)
def shown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Shown:
    make, changes, lightings = CASES[request.param]
    scene, folder = make(), tmp_path_factory.mktemp("shown")
    if request.param == "statue-marble":  # the others are closed, or all but
        write_exr(
            folder / "sky.exr",
            np.tile(np.linspace(0.2, 1, 32)[:, None, None], (16, 1, 3)).astype(np.float32).reshape(16, 32, 3),
        )
        lightings = [*lightings, [{"type": "environment", "image": str(folder / "sky.exr")}]]
    listed = [parse_lighting(one) for one in lightings]
    split = {"train": listed[:9], "validation": listed[9:10], "test": listed[10:]}
    data = ddprt.bake(scene, split, config=load_config(None, SMALL | changes), out=folder / "data")
    model = ddprt.fit(data, bases=5)
    packed = pack(model, data, stitch=False)
    question = {"lamps": lightings[11]}
    return Shown(scene, model, packed, data, browsed(page(packed), question, PROBE, folder))


@pytest.mark.slow
def test_own_lamps_are_measured_and_answered_as_by_the_model(shown: Shown) -> None:
    found, model = shown.found, shown.model
    assert found["faults"] == []
    lamps = [light.model_dump(mode="json") for light in shown.data.lightings[11]]
    measured = model.measure(lamps)
    assert (measured > 0).mean() > 0.2
    np.testing.assert_allclose(np.reshape(found["measured"], (-1, 3)), measured, rtol=2e-4, atol=2e-5 * measured.max())
    got, expected = np.reshape(found["own"], (*model.covered.shape, 4))[model.covered][:, :3], model.predict(measured)
    assert np.abs(got - expected).max() < 3e-3 * expected.max()
    assert found["notes"] == shown.packed["notes"]
    assert any("fog" in note for note in found["notes"]) == (model.fog is not None)


@pytest.mark.slow
def test_all_light_on_the_screen_is_right(shown: Shown) -> None:
    """Direct light through fog and holes, but none on what light passes; indirect light with that of what glows."""
    there = shown.pixels("both")
    tracer = Tracer.of(shown.scene)
    direct = measure(tracer, shown.data.lightings[11], there.position, there.normal, seed=0)
    direct *= shown.reflects(there)
    light = direct + shown.texel(there, "own")
    assert off(there, shown.displayed("both", light)) < 0.1


@pytest.mark.slow
def test_held_out_lightings_show_their_reference_and_error(shown: Shown) -> None:
    stored = shown.packed["stored"]
    assert [entry["index"] for entry in stored] == shown.data.split("test")
    for entry, told in zip(stored, shown.found["stored"], strict=True):
        (values,) = shown.data.values([entry["index"]], shown.model.points, shown.model.quantity)
        got = np.reshape(told["map"], (*shown.model.covered.shape, 4))[shown.model.covered][:, :3]
        expected = shown.model.predict(values)
        assert np.abs(got - expected).max() < 3e-3 * expected.max()
        lamps = shown.data.lightings[entry["index"]]
        drawn = tuple(light for light in lamps if light.kind in ("point", "spot", "directional"))
        assert entry["lights"] == lighting_json(drawn)
        assert told["lamps"] == len(drawn)
        for light in lamps:
            assert (f"1 {light.kind}" in told["said"]) == (light not in drawn)
    there = shown.pixels("reference")
    assert off(there, shown.displayed("reference", shown.texel(there, "truth"))) < 0.1
    there = shown.pixels("error")
    size = np.linalg.norm(shown.texel(there, "ours") - shown.texel(there, "truth"), axis=1) / (0.5 * stored[0]["rms"])
    x = 4 * np.clip(size, 0, 1)
    heat = np.clip(np.stack([x - 1, x - 2, np.where(x < 2, np.minimum(x, 2 - x), x - 3)], 1), 0, 1)
    assert np.mean(np.abs(there.shown - heat).max(1) < 0.05) > 0.9


@pytest.mark.slow
def test_lamps_that_are_not_drawn_light_the_scene_by_the_datasets_lightmap(shown: Shown) -> None:
    at = len(shown.packed["stored"]) - 1
    entry = shown.packed["stored"][at]
    assert entry["omitted"]
    assert shown.packed["stored"][0]["direct"] is None, "nothing is stored that the browser draws by itself"
    (direct,) = shown.data.maps("direct", [entry["index"]])
    laid = np.reshape(shown.found["laid"], (*shown.model.covered.shape, 4))[shown.model.covered][:, :3]
    np.testing.assert_allclose(laid, direct, rtol=2**-10, atol=1e-6)
    there = shown.pixels("spread")
    assert off(there, shown.displayed("spread", shown.reflects(there) * shown.texel(there, "laid"))) < 0.1
