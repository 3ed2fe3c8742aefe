"""Skies as harmonics: exact sums over pixels, turned as light is, and learned and answered for by classical PRT."""

from pathlib import Path

import numpy as np
import pytest
from test_sh_prt import SMALL, fitted, pairs, spiral, suns, transport

import ddprt
from ddprt.config import load_config
from ddprt.harmonics import count, harmonics, of_panorama, turned
from ddprt.lights import EnvironmentLight
from ddprt.methods.sh_prt import describe
from ddprt.scene.exr import write_exr
from ddprt.scene.lion import lion

EPS = float(np.finfo(float).eps)
ORDER = 6
ROUNDING = 1000 * EPS
"""Of sums over some hundred pixels times the 8 to 36 places of a rule, relative to the largest coefficient."""


def about_y(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def picture(height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(height)
    return rng.exponential(1, (height, width, 3)) * rng.integers(0, 2, (height, width, 1))


def by_pixels(pixels: np.ndarray, order: int, angle: float = 0.0) -> np.ndarray:
    """The slow twin: Gauss' rule in both angles of each pixel, which are cut in four where they are large."""
    height, width = pixels.shape[:2]
    down, across = max(1, 16 // height), max(1, 16 // width)
    fine = np.kron(pixels, np.ones((down, across, 1)))
    height, width = fine.shape[:2]
    x, weight = np.polynomial.legendre.leggauss(10)
    total = np.zeros((count(order), 3))
    for row in range(height):
        polar = np.pi * (row + (x + 1) / 2) / height
        for column in range(width):
            turn = 2 * np.pi * ((column + (x + 1) / 2) / width - 0.5)
            flat = np.sin(polar)[:, None]
            towards = np.stack(np.broadcast_arrays(flat * np.sin(turn), np.cos(polar)[:, None], -flat * np.cos(turn)), -1)
            area = np.outer(weight * np.sin(polar), weight) * np.pi / 2 / height * np.pi / width
            Y = harmonics(towards @ about_y(angle).T, order)
            total += np.outer((Y * area[..., None]).sum((0, 1)), fine[row, column])
    return total


def test_a_white_sky_is_its_mean() -> None:
    """L = 1: sqrt(4 pi) of the first harmonic, and nothing of the others, from one pixel or many."""
    expected = np.zeros((count(ORDER), 3))
    expected[0] = np.sqrt(4 * np.pi)
    for shape in ((1, 1), (1, 3), (3, 1), (40, 80)):
        np.testing.assert_allclose(of_panorama(np.ones((*shape, 3)), ORDER), expected, atol=ROUNDING * 4)


@pytest.mark.parametrize(("shape", "degrees"), [((1, 1), 0.0), ((2, 3), -100.0), ((12, 24), 70.0), ((5, 4), 400.0)])
@pytest.mark.parametrize("order", [0, 1, ORDER])
def test_pictures_agree_with_their_slow_twin(shape: tuple[int, int], degrees: float, order: int) -> None:
    pixels, angle = picture(*shape), np.deg2rad(degrees)
    expected = by_pixels(pixels, order, angle)
    found = turned(of_panorama(pixels, order), angle)
    np.testing.assert_allclose(found, expected, atol=ROUNDING * max(np.abs(expected).max(), 1))


def test_turns_are_those_of_the_pixels() -> None:
    """A quarter turn moves the middle of the picture from -z to -x, a quarter of the width to the left."""
    pixels = picture(6, 16)
    rolled = of_panorama(np.roll(pixels, -4, 1), ORDER)
    np.testing.assert_allclose(turned(of_panorama(pixels, ORDER), np.pi / 2), rolled, atol=ROUNDING * np.abs(rolled).max())
    there_and_back = turned(turned(rolled, 1.3), -1.3)
    np.testing.assert_allclose(there_and_back, rolled, atol=ROUNDING * np.abs(rolled).max())


def test_harmonics_are_those_of_the_light_that_arrives(tmp_path: Path) -> None:
    """What the light's own samples say of it, directions and turn included."""
    pixels = picture(12, 24).astype(np.float32)
    write_exr(tmp_path / "sky.exr", pixels)
    sky = EnvironmentLight(image=str(tmp_path / "sky.exr"), rotation_deg=70.0, scale=1.5)
    u = np.random.default_rng(0).random((1 << 17, 2))
    light = sky.illuminate(np.zeros((len(u), 3)), u)
    values = light.irradiance[:, None] * harmonics(np.ascontiguousarray(light.direction), 2)[..., None]
    error = values.std(0) / np.sqrt(len(u))
    found = sky.harmonics(2)
    assert (np.abs(values.mean(0) - found) < 5 * error + 1e-6 * np.abs(found).max()).all()  # 27 of them; of float32 pixels
    assert error.max() < 0.02 * np.abs(found).max()
    np.testing.assert_allclose(describe([(*suns(spiral(1))[0], sky)], 2)[0], found + describe(suns(spiral(1)), 2)[0])


def test_a_picture_that_changed_is_projected_anew(tmp_path: Path) -> None:
    path = tmp_path / "sky.exr"
    for level, shape in ((1.0, (2, 4)), (3.0, (2, 8))):  # of other sizes, so that the file's state differs for certain
        write_exr(path, np.full((*shape, 3), level, np.float32))
        assert EnvironmentLight(image=str(path)).harmonics(1)[0, 0] == pytest.approx(level * np.sqrt(4 * np.pi))


def test_transport_is_learned_from_suns_and_skies_together() -> None:
    truth = transport(2)
    skies = [(EnvironmentLight(image="sun-sky", rotation_deg=10.0 * turn, scale=1.0 + turn),) for turn in range(6)]
    lightings = [*suns(spiral(20)), *skies, (*skies[0], *suns(spiral(3))[1])]
    light = np.einsum("lkc,ktc->ltc", describe(lightings, 2), truth)
    found = np.asarray(fitted(pairs(light, lightings), order=2, ridge=0.0).transfer)
    # Rows are scaled to length 1 before they are solved, and were rounded to float32 before: see the test of suns.
    np.testing.assert_allclose(found, truth, atol=1e-5)


def test_the_whole_chain_under_skies() -> None:
    """A small lion under suns, skies and both: classical PRT answers for all of them, by which way the sky is turned."""
    settings = {**SMALL, "transport.samples": "64", "transport.test_samples": "64"}
    skies = [(EnvironmentLight(image="sun-sky", rotation_deg=60.0 * turn),) for turn in range(7)]
    lit = suns(spiral(40))
    splits = {
        "train": [*lit, *skies[1:5], (*skies[1], *lit[10])],
        "validation": skies[5:6],
        "test": [skies[6], skies[5] + lit[3]],
    }
    data = ddprt.bake(lion(cells=24), splits, config=load_config(None, settings))
    model = ddprt.fit(data, "sh-prt", settings={"order": 3})
    test = data.split("test")
    lightings = [data.lightings[index] for index in test]
    values, truth = data.values(test, 16, "radiosity"), data.maps("indirect", test)
    found = model.predict(values, lightings=lightings)
    exact = np.einsum("fkc,ktc->ftc", describe(lightings, 3), np.asarray(model.relighter.transfer, np.float64))
    np.testing.assert_allclose(found, np.maximum(exact, 0), atol=1e-5 * np.abs(exact).max())  # float32 sums of 16
    away = [tuple(light.model_copy(update={"rotation_deg": 180.0}) if light.kind == "environment" else light for light in one)
            for one in lightings]  # fmt: skip
    wrong = model.predict(values, lightings=away)
    errors = [float(np.linalg.norm(light - truth)) for light in (found, wrong)]
    print(errors, np.linalg.norm(truth))
    assert errors[0] < errors[1] / 1.5
    image = model.relight({"type": "environment", "image": "sun-sky", "rotation_deg": 360.0})
    np.testing.assert_allclose(image[model.covered], found[0], atol=1e-4 * found[0].max())
