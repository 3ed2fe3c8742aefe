"""Skies: closed forms, samplers against their densities, the sense of turning, images that are refused, and what they cost."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import chi_square, polygon_irradiance

import ddprt
from ddprt import seeds
from ddprt.bench.budget.shadow_maps import engine_irradiance
from ddprt.cli import main
from ddprt.config import load_config
from ddprt.dataset.splits import doubt
from ddprt.errors import UserError
from ddprt.lights import EnvironmentLight, Lighting, parse_lighting
from ddprt.lights.panorama import SKIES, read_panorama
from ddprt.lights.sky import (
    LUMINANCE,
    Sky,
    _half_turns_down,
    _pixel,
    _spun,
    _turns_of,
    invert_bright,
    load_sky,
    pdf_bright,
    sample_bright,
)
from ddprt.sampling.lightings import draw_lightings
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.exr import write_exr
from ddprt.scene.library import build
from ddprt.scene.material import Material
from ddprt.scene.mesh import Scene
from ddprt.scene.shapes import faceted, icosphere, rectangle
from ddprt.transport.direct import Places, Texels, _lattice, _shifted, mean_irradiance
from ddprt.transport.embree import Tracer
from ddprt.transport.measure import measure
from ddprt.transport.paths import trace_paths
from ddprt.transport.reference import on_texels, trace_reference

SIGNIFICANT = 1e-4
"""Of a chi-square: seeds are fixed, so a sound sampler passes always."""
SIGMAS = 4.5
"""Of a mean: the tests look at some hundred in all, of which chance puts one this far off in 1500 sets of seeds."""
UP = np.array([0.0, 1.0, 0.0])
BLACK = Material("black", (0.0, 0.0, 0.0))


def sky(image: str = "white", **changes: Any) -> EnvironmentLight:
    return EnvironmentLight(image=image, **changes)


def plane(size: float = 2.0) -> Scene:
    half = size / 2
    return faceted("plane", rectangle((-half, -half), (half, half), 0.0, 1, facing=1)[None], (BLACK,))


@pytest.fixture(scope="module")
def patchwork(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sky without any symmetry: 24 x 12 pixels, each of its own colour, some black, one as bright as all others together."""
    rng = np.random.default_rng(5)
    pixels = rng.exponential(1, (12, 24, 3)) * rng.integers(0, 2, (12, 24, 1))
    pixels[3, 17] = (150, 100, 60)
    path = tmp_path_factory.mktemp("sky") / "patchwork.exr"
    write_exr(path, pixels.astype(np.float32))
    return path


def directions(height: int, width: int, fine: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Centres of pixels (or of fine x fine parts of each) and their solid angles, by the definition of the picture alone."""
    v, u = (np.arange(height * fine) + 0.5) / (height * fine), (np.arange(width * fine) + 0.5) / (width * fine)
    polar, turn = np.meshgrid(
        np.pi * v, 2 * np.pi * (u - 0.5), indexing="ij"
    )  # v = acos(y) / pi, u = 1/2 + atan2(x, -z) / 2 pi
    towards = np.stack([np.sin(polar) * np.sin(turn), np.cos(polar), -np.sin(polar) * np.cos(turn)], -1)
    step = np.pi / (height * fine)
    return towards, 2 * np.sin(step / 2) * np.sin(polar) * 2 * np.pi / (width * fine)


def about_y(degrees: float) -> np.ndarray:
    """Right-handed turn about +Y, as in glTF."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def drawn(light: EnvironmentLight, normal: np.ndarray | None, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Directions and their share of radiance over density, (count, 3) each."""
    u = np.random.default_rng(seed).random((count, 2))
    facing = None if normal is None else np.tile(normal, (count, 1))
    sample = light.illuminate(np.zeros((count, 3)), u, None, facing)
    return sample.direction, sample.irradiance


# --- closed forms -----------------------------------------------------------------------------------------------------


def test_a_white_sky_on_an_open_plane_and_on_a_ball() -> None:
    direct, _ = ddprt.irradiance(plane(), sky(scale=2.5), [[0.3, 0, 0.1]], [UP], samples=4)
    # Every sample is pi L but for the rounding of float32: directions, cosines and their product.
    np.testing.assert_allclose(direct, 2.5 * np.pi, rtol=1e-6)
    outward, triangles = icosphere(2)
    ball = checked("ball", outward, triangles, materials=(Material("grey", (0.5,) * 3),))
    places, normals = ball.corners.mean(1), ball.geometric_normals
    direct, indirect = ddprt.irradiance(ball, sky(scale=2.5), places, normals, samples=4)
    np.testing.assert_allclose(direct, 2.5 * np.pi, rtol=2e-6)
    assert not indirect.any()


@pytest.mark.parametrize("height", [-1.0, -0.3, 0.0, 0.6, 1.0])
def test_a_gradient_in_closed_form(height: float) -> None:
    """L = (1 + y) / 2: irradiance pi / 2 + pi / 3 n_y (clamped cosine: pi for the constant, 2 pi / 3 for the first order)."""
    normal = np.array([0.6 * np.sqrt(1 - height**2), height, 0.8 * np.sqrt(1 - height**2)])
    expected = (np.pi / 2 + np.pi / 3 * height) * np.array([0.6, 0.8, 1.0])
    count = 1 << 16
    towards, light = drawn(sky("gradient"), normal, count)
    values = light * np.maximum(towards @ normal, 0)[:, None]
    # Rows hold the mean of y, so what steps leave out is of second order in pi / 256: a relative 2e-5 at most.
    bound = SIGMAS * values.std(0) / np.sqrt(count) + 1e-4 * expected
    assert (abs(values.mean(0) - expected) < bound).all()
    assert (bound < 0.02 * np.pi).all()


def test_a_wall_takes_away_the_sky_behind_it() -> None:
    """A black wall beside the point: what it hides of a white sky is what it would send as a lamp (Lambert's polygon)."""
    wall = np.array([[0.5, 0.0, -2.0], [0.5, 0.0, 2.0], [0.5, 1.5, 2.0], [0.5, 1.5, -2.0]])
    scene = faceted("wall", wall[None], (BLACK,))
    hidden = max(polygon_irradiance(corners, 1.0, np.zeros(3), UP) for corners in (wall, wall[::-1]))
    assert hidden > 0.5
    samples = 1 << 14
    found, _, variance, _ = ddprt.irradiance(scene, sky(), [[0, 0, 0]], [UP], samples=samples, return_variance=True)
    assert abs(found[0, 0] - (np.pi - hidden)) < SIGMAS * np.sqrt(variance[0, 0])
    assert np.sqrt(variance[0, 0]) < 0.02


@pytest.mark.parametrize("name", SKIES)
def test_all_light_of_the_picture_arrives(name: str) -> None:
    """The mean of radiance over density is the integral of radiance over all directions, with or without a normal."""
    pixels = read_panorama(name).astype(np.float64)
    height, width = pixels.shape[:2]
    solid_angle = directions(height, width)[1] if height > 1 else np.array([[4 * np.pi]])
    assert solid_angle.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    expected = np.einsum("hwc,hw->c", pixels, solid_angle)
    _, light = drawn(sky(name), None, 1 << 16)
    assert (abs(light.mean(0) - expected) <= SIGMAS * light.std(0) / 256 + 1e-12).all()
    towards, up = drawn(sky(name), UP, 1 << 16)
    below, down = drawn(sky(name), -UP, 1 << 16)
    half = [np.where((along @ facing > 0)[:, None], part, 0) for along, part, facing in ((towards, up, UP), (below, down, -UP))]
    # The part that is not bright has no finite variance here, for lack of the cosine: only its mean is right.
    assert half[0].mean(0) + half[1].mean(0) == pytest.approx(expected, rel=0.1)


def test_skies_made_in_code_are_as_said() -> None:
    pixels = read_panorama("sun-sky").astype(np.float64)
    towards, solid_angle = directions(*pixels.shape[:2])
    sun = np.array([0.0, np.sin(np.radians(40)), -np.cos(np.radians(40))])
    inside = towards @ sun > np.cos(np.radians(2.5))
    assert (pixels[inside] > 700).all()
    assert pixels[~inside].max() < 1
    facing = np.einsum("hwc,hw,hw->c", pixels, solid_angle * inside, towards @ sun)
    # pi sin² 2.5 degrees times 1500; the rim is 45 pixels long and a pixel's square root of them uncertain: 2 %.
    np.testing.assert_allclose(facing, 1500 * np.pi * np.sin(np.radians(2.5)) ** 2 * np.array([1, 0.9, 0.75]), rtol=0.02)
    assert pixels[0, 0] == pytest.approx([0.20, 0.40, 0.85], abs=2e-3)
    assert pixels[-1, 0] == pytest.approx([0.12, 0.11, 0.10], abs=1e-6)


# --- samplers ---------------------------------------------------------------------------------------------------------


def test_the_bright_part_fits_its_density(patchwork: Path) -> None:
    found = load_sky(str(patchwork))
    towards = sample_bright(found, np.random.default_rng(1).random((200_000, 2)))
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1, atol=1e-12)
    y, turn = towards[:, 1], np.arctan2(towards[:, 0], -towards[:, 2]) / (2 * np.pi) + 0.5
    # Halves of pixels in height (by solid angle) and thirds in longitude: places within pixels are looked at as well.
    heights = np.sort(np.concatenate([found.heights, (found.heights[1:] + found.heights[:-1]) / 2]))
    counts = np.histogram2d(y, turn, (heights, np.linspace(0, 1, 3 * found.radiance.shape[1] + 1)))[0][::-1]
    assert chi_square(counts, np.repeat(np.repeat(pixel_shares(found), 2, 0), 3, 1)) > SIGNIFICANT


def pixel_shares(found: Sky) -> np.ndarray:
    towards, solid_angle = directions(*found.radiance.shape[:2])
    shares = solid_angle * pdf_bright(found, towards.reshape(-1, 3)).reshape(solid_angle.shape)
    assert shares.sum() == pytest.approx(1, rel=1e-12)
    return shares


def pixel_counts(found: Sky, towards: np.ndarray) -> np.ndarray:
    height, width = found.radiance.shape[:2]
    v, u = np.arccos(np.clip(towards[:, 1], -1, 1)) / np.pi, np.arctan2(towards[:, 0], -towards[:, 2]) / (2 * np.pi) + 0.5
    return np.histogram2d(v, u, (height, width), [[0, 1], [0, 1]])[0]


def test_the_bright_part_there_and_back(patchwork: Path) -> None:
    for image in (str(patchwork), "gradient", "sun-sky"):
        found = load_sky(image)
        u = np.random.default_rng(2).random((1000, 2))
        back = invert_bright(found, sample_bright(found, u))
        # A direction carries 1e-16, which the pixel's width (6e-3) and the height of rows near a pole (4e-5) magnify.
        np.testing.assert_allclose(back, u, atol=1e-10)


@pytest.mark.parametrize("normal", [None, UP, np.array([0.48, -0.6, 0.64])], ids=["none", "up", "aside"])
def test_both_techniques_together_fit_their_density(patchwork: Path, normal: np.ndarray | None) -> None:
    """Directions against share * bright + (1 - share) * cosine, and light against each one's part over its density."""
    found, turn = load_sky(str(patchwork)), 75.0
    assert found.share == 0.5
    assert load_sky("gradient").share == load_sky("white").share == 0
    towards, light = drawn(sky(str(patchwork), rotation_deg=turn), normal, 200_000, seed=3)

    def densities(there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rest = np.full(len(there), 1 / (4 * np.pi)) if normal is None else np.maximum(there @ normal, 0) / np.pi
        return found.share * pdf_bright(found, there @ about_y(turn)), (1 - found.share) * rest

    fine = 8
    unturned, solid_angle = directions(*found.radiance.shape[:2], fine)
    shares = solid_angle * sum(densities(unturned.reshape(-1, 3) @ about_y(turn).T)).reshape(solid_angle.shape)
    height, width = found.radiance.shape[:2]
    shares = shares.reshape(height, fine, width, fine).sum((1, 3))
    assert shares.sum() == pytest.approx(1, abs=1e-3)  # the horizon cuts through fine pixels
    assert chi_square(pixel_counts(found, towards @ about_y(turn)), shares) > SIGNIFICANT

    row, column = (np.clip(part.astype(int), 0, most - 1) for part, most in zip(
        (np.arccos(np.clip(towards[:, 1], -1, 1)) / np.pi * height,
         ((np.arctan2(*(towards @ about_y(turn)).T[[0, 2]] * [[1], [-1]]) / (2 * np.pi) + 0.5) % 1) * width),
        (height, width), strict=True))  # fmt: skip
    luminance = found.radiance[row, column] @ LUMINANCE
    from_bright = np.random.default_rng(3).random((200_000, 2))[:, 0] < found.share
    part = np.where(from_bright, np.maximum(luminance - found.mean, 0), np.minimum(luminance, found.mean))
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = found.radiance[row, column] * (part / luminance / np.where(from_bright, *densities(towards)))[:, None]
    expected[luminance == 0] = 0
    edge = abs(expected - light).max(1) > 1e-9 * (1 + expected.max(1))
    assert edge.mean() < 1e-3, "but for samples on the very edge of a pixel"
    assert 0.4 < from_bright.mean() < 0.6


def test_samples_are_spent_on_the_sun_and_on_what_faces_the_surface() -> None:
    """Relative deviation of one sample on an open plane, in closed form 0 for a white sky."""

    def deviation(name: str) -> float:
        towards, light = drawn(sky(name), UP, 1 << 14)
        values = (light * np.maximum(towards @ UP, 0)[:, None]) @ LUMINANCE
        return float(values.std() / values.mean())

    assert deviation("white") < 1e-12
    # Light alone gives 1.09 and 1.02, the cosine alone 0.24 and 13 (docs/effects.md): both techniques are at work.
    assert deviation("gradient") < 0.6
    assert deviation("sun-sky") < 0.6


@pytest.mark.parametrize("normal", [None, UP])
def test_no_direction_outweighs_the_others(normal: np.ndarray | None) -> None:
    """A sample brings the bright part's flux over its share, or at most the mean over the density of the rest; never both."""
    found = load_sky("sun-sky")
    towards, light = drawn(sky("sun-sky"), normal, 1 << 16)
    share = found.share
    from_bright = np.random.default_rng(0).random((1 << 16, 2))[:, 0] < share
    brought = light @ LUMINANCE * (1 if normal is None else np.abs(towards @ normal))
    whole = 4 * np.pi if normal is None else np.pi
    np.testing.assert_allclose((light @ LUMINANCE)[from_bright], found.bright / share, rtol=1e-12)
    assert brought[~from_bright].max() <= found.mean * whole / (1 - share) * (1 + 1e-12)
    hit = found.radiance[*_pixel(found, towards)[:2]].max(1) > 700
    assert hit[~from_bright].any(), "of 32768 directions some hit the sun, a thousandth of the sphere"


def test_angles_are_as_exact_as_said() -> None:
    rng = np.random.default_rng(0)
    x, z = rng.normal(size=(2, 2000))
    x[:8], z[:8] = [0, 0, 1, -1, 1e-9, -1e-9, 1, 1], [1, -1, 0, 0, 1, -1, 1, -1]
    found = np.array([_turns_of(*pair) for pair in zip(x.tolist(), z.tolist(), strict=True)])
    away = abs(found - np.arctan2(x, z) / (2 * np.pi))
    assert np.minimum(away, 1 - away).max() < 5e-10
    y = np.concatenate([[-1, 0, 1, 1 - 1e-16, 1e-9 - 1], rng.uniform(-1, 1, 2000)])
    down = [_half_turns_down(height) for height in y.tolist()]
    np.testing.assert_allclose(down, np.arccos(y) / np.pi, rtol=0, atol=1e-8)
    turns = rng.uniform(-3, 3, 2000)
    np.testing.assert_allclose(
        [_spun(turn) for turn in turns.tolist()],
        np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], 1),
        atol=1e-14,
    )


def test_bits_do_not_depend_on_the_threads() -> None:
    scene = build("statue", subdivisions=2)
    maps = []
    for threads in (1, 2):
        tracer = Tracer.of(scene, threads)
        texels = Texels.of(tracer, build_atlas(scene, 24, 2), 16, seeds.stream(0, "a"))
        lightings = [parse_lighting(sky("sun-sky", rotation_deg=turn)) for turn in (0.0, 50.0, 100.0, 150.0)]
        work = partial(_one, texels)
        maps.append(np.array(list(tracer.map(work, enumerate(lightings)))))
    np.testing.assert_array_equal(*maps)


def _one(texels: Texels, numbered: tuple[int, Lighting]) -> np.ndarray:
    index, lighting = numbered
    return texels.irradiance(lighting, seeds.stream(1, "b", index))


@pytest.mark.parametrize("samples", [2, 4, 16, 64])
def test_groups_divide_evenly_between_the_techniques(samples: int) -> None:
    words = np.random.default_rng(0).integers(0, 1 << 32, (100, 2), np.uint32)
    u = np.empty((2, 100 * samples), np.float32)
    _shifted(words, _lattice(samples), 0, u)
    np.testing.assert_array_equal((u[0].reshape(100, samples) < 0.5).sum(1), samples // 2)
    assert ((u >= 0) & (u < 1)).all()


def test_noise_of_a_group_is_that_of_even_samples() -> None:
    """Sixteen samples on an open plane under a sun: their places in the sky are spread, and the sun gets eight of them."""
    tracer = Tracer.of(plane())
    places = Places.of(tracer, np.zeros((16 * 4096, 3), np.float32), np.tile(np.float32(UP), (16 * 4096, 1)), 16)
    found = mean_irradiance(tracer, (sky("sun-sky"),), places, np.random.default_rng(0))
    towards, light = drawn(sky("sun-sky"), UP, 1 << 14)
    independent = (light[:, 1] * np.maximum(towards @ UP, 0)).std() / 4
    # Found to be 0.06 of that, and 0.19 with the sequence that other lights use.
    assert found[:, 1].std() < 0.1 * independent
    np.testing.assert_allclose(found.mean(0, dtype=np.float64), read_in_closed_form("sun-sky"), rtol=1e-3)


def read_in_closed_form(name: str) -> np.ndarray:
    """Irradiance of an open plane: the integral of y over a row is half the difference of squared heights of its edges."""
    pixels = read_panorama(name).astype(np.float64)
    height, width = pixels.shape[:2]
    edges = np.maximum(np.cos(np.pi * np.arange(height + 1) / height), 0)
    return np.einsum("hwc,h->c", pixels, -np.diff(edges**2) * np.pi / width)


# --- the sense of turning ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.0, 90.0, -33.0, 400.0])
def test_turning_moves_light_as_said(patchwork: Path, turn: float) -> None:
    """Mean direction of each channel's light, against a sum over parts of pixels turned by a matrix."""
    pixels = read_panorama(str(patchwork)).astype(np.float64)
    towards, solid_angle = directions(*pixels.shape[:2], 16)
    fine = np.repeat(np.repeat(pixels, 16, 0), 16, 1)
    expected = np.einsum("hwc,hw,hwd->cd", fine, solid_angle, towards) @ about_y(turn).T
    found, light = drawn(sky(str(patchwork), rotation_deg=turn), None, 1 << 17)
    vectors = light[:, :, None] * found[:, None]
    error = vectors.std(0) / np.sqrt(len(vectors))
    assert (abs(vectors.mean(0) - expected) < SIGMAS * error + 1e-3).all()
    assert error.max() < 0.02 * np.linalg.norm(expected)


def test_the_middle_of_the_picture_lies_at_minus_z_and_turns_to_minus_x(tmp_path: Path) -> None:
    pixels = np.zeros((64, 128, 3), np.float32)
    pixels[31:33, 63:65] = 1
    write_exr(tmp_path / "spot.exr", pixels)
    right = np.roll(pixels, 32, 1)
    write_exr(tmp_path / "right.exr", right)
    for name, turn, expected in (
        ("spot", 0, [0, 0, -1]), ("spot", 90, [-1, 0, 0]), ("spot", 180, [0, 0, 1]), ("right", 0, [1, 0, 0]),
        ("right", 90, [0, 0, -1]),
    ):  # fmt: skip
        towards, light = drawn(sky(str(tmp_path / f"{name}.exr"), rotation_deg=turn), None, 4096)
        # The spot is two pixels of 1/64 pi wide, so its mean direction is known to half of that with certainty.
        np.testing.assert_allclose((towards * light[:, :1]).sum(0) / light[:, 0].sum(), expected, atol=np.pi / 128)


# --- transport --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def statue() -> tuple[Scene, Tracer, Atlas]:
    scene = build("statue", subdivisions=3)
    return scene, Tracer.of(scene), build_atlas(scene, 48, 2)


def test_texels_agree_with_the_reference(statue: tuple[Scene, Tracer, Atlas]) -> None:
    scene, tracer, atlas = statue
    lighting = parse_lighting(sky("sun-sky", rotation_deg=70))
    chosen = np.arange(0, atlas.count, atlas.count // 100)
    truth = trace_reference(tracer, scene, lighting, on_texels(tracer, atlas, chosen), len(chosen), 2048, seed=1, bounces=0)
    runs = np.array([
        Texels.of(tracer, atlas, 16, seeds.stream(seed, "a")).irradiance(lighting, seeds.stream(seed, "b"))[chosen]
        for seed in range(24)
    ])  # fmt: skip
    error = np.sqrt(truth.direct_variance + runs.var(0, ddof=1) / len(runs))
    lit = error[:, 1] > 1e-6  # the statue's foot sees nothing
    assert lit.mean() > 0.9
    z = (runs.mean(0) - truth.direct)[lit, 1] / error[lit, 1]
    # Some 100 scores; Student's t of 23 degrees of freedom is 5 % wider than a normal distribution.
    assert abs(z.mean()) < SIGMAS / np.sqrt(len(z))
    assert 0.75 < z.std() < 1.3
    assert truth.direct.max() > 5


def test_paths_and_reference_agree_in_every_channel(statue: tuple[Scene, Tracer, Atlas]) -> None:
    scene, tracer, atlas = statue
    lightings = [parse_lighting([sky("sun-sky", rotation_deg=70)]), parse_lighting([sky("gradient", scale=3), LAMP])]
    chosen = np.arange(0, atlas.count, atlas.count // 200)
    found = np.zeros((8, 2, len(chosen), 3))
    for seed in range(8):
        out = np.zeros((2, atlas.count, 3), np.float32)
        for _ in trace_paths(tracer, scene, atlas, lightings, out, samples=64, seed=seed, stream="test", texels=chosen):
            pass
        found[seed] = out[:, chosen]
    for index, lighting in enumerate(lightings):
        truth = trace_reference(tracer, scene, lighting, on_texels(tracer, atlas, chosen), len(chosen), 1024, seed=2)
        mean, spread = found[:, index].mean((0, 1)), found[:, index].mean(1).std(0, ddof=1) / np.sqrt(8)
        error = np.sqrt(spread**2 + truth.indirect_variance.sum(0) / len(chosen) ** 2)
        # Student's t of 7 degrees of freedom: 5.4 is as rare as 4 of a normal distribution; six scores.
        assert (abs(mean - truth.indirect.mean(0)) < 5.4 * error).all()
        assert (error < 0.02 * truth.indirect.mean(0)).all()


LAMP = {"type": "point", "position": [1.0, 2.0, 0.5], "intensity": [0.5, 1.0, 3.0]}


def test_light_of_a_sky_and_a_lamp_adds_up(statue: tuple[Scene, Tracer, Atlas]) -> None:
    _, tracer, atlas = statue
    parts = [*parse_lighting([LAMP]), sky("gradient")]
    texels = Texels.of(tracer, atlas, 2, seeds.stream(0, "a"))
    together = texels.irradiance(tuple(parts), seeds.stream(0, "b"))
    apart = sum(texels.irradiance((part,), seeds.stream(0, "b")) for part in parts)
    np.testing.assert_allclose(together, apart, rtol=1e-6, atol=1e-6)


def test_sunk_points_see_a_sky_as_it_is(statue: tuple[Scene, Tracer, Atlas]) -> None:
    _, tracer, atlas = statue
    places, normals = atlas.position[::50], atlas.normal[::50]
    on, sunk = (measure(tracer, (sky("sun-sky"),), places, normals, seed=1, depth=depth) for depth in (0.0, 0.05))
    np.testing.assert_array_equal(on, sunk)
    assert on.any()


def test_shadow_maps_refuse_a_sky(statue: tuple[Scene, Tracer, Atlas]) -> None:
    _, tracer, atlas = statue
    with pytest.raises(UserError, match="got an environment light, expected light from one place or direction"):
        engine_irradiance(tracer, (sky(),), atlas.position[:3], atlas.normal[:3], resolution=8, taps=1)


# --- what it costs where there is none --------------------------------------------------------------------------------

BARE = """
import sys
import numpy as np
if len(sys.argv) > 1:
    for name in ("ddprt.lights.sky", "ddprt.lights.panorama", "ddprt.transport.tinted"):
        sys.modules[name] = None
import ddprt
from ddprt.lights import parse_lighting
from ddprt.scene.atlas import build_atlas
from ddprt.scene.library import build
from ddprt.transport.direct import Texels
from ddprt.transport.embree import Tracer
from ddprt.transport.paths import trace_paths
scene = build("cornell")
tracer, atlas = Tracer.of(scene), build_atlas(scene, 24, 1)
lamps = parse_lighting([
    {"type": "point", "position": [0.2, 0.4, 0.3], "intensity": [3.0, 1.0, 0.1]},
    {"type": "sphere", "center": [0.4, 0.5, 0.1], "radius": 0.05, "radiance": [1.0, 2.0, 3.0]},
])
direct = Texels.of(tracer, atlas, 2, np.random.default_rng(0)).irradiance(lamps, np.random.default_rng(1))
out = np.zeros((1, atlas.count, 3), np.float32)
list(trace_paths(tracer, scene, atlas, [lamps], out, samples=4, seed=0, stream="x"))
used = [m for m in ("ddprt.lights.sky", "ddprt.lights.panorama", "ddprt.transport.tinted") if sys.modules.get(m)]
print(used, tracer.rays, hash((direct.tobytes(), out.tobytes())))
"""


def test_without_a_sky_nothing_of_it_is_imported_and_nothing_changes() -> None:
    answers = [
        subprocess.run(
            [sys.executable, "-c", BARE, *more],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": "0"},
        ).stdout
        for more in ([], ["blocked"])
    ]
    assert answers[0].startswith("[] ")
    assert answers[0] == answers[1]


# --- images -----------------------------------------------------------------------------------------------------------


def rgbe(pixels: np.ndarray, packed: bool) -> bytes:
    """A Radiance picture of values that it holds exactly: (mantissa + 1/2) / 256 * 2^(exponent - 128)."""
    height, width = pixels.shape[:2]
    lines = b""
    for row in pixels:
        if packed:
            lines += bytes([2, 2, width >> 8, width & 255])
            for channel in range(4):
                values, at = row[:, channel].tolist(), 0
                while at < width:
                    run = 1
                    while at + run < width and run < 127 and values[at + run] == values[at]:
                        run += 1
                    lines += bytes([128 + run, values[at]]) if run > 2 else bytes([run, *values[at : at + run]])
                    at += run
        else:
            lines += row.tobytes()
    return b"#?RADIANCE\n# made here\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {height} +X {width}\n".encode() + lines


@pytest.mark.parametrize("packed", [False, True])
def test_radiance_pictures(tmp_path: Path, packed: bool) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(3, 256, (9, 300, 4), np.uint8)
    pixels[:, 40:250] = pixels[:, 40:41]
    pixels[..., 3] = rng.integers(120, 140, (9, 300))
    pixels[4, 5] = 0
    path = tmp_path / "a.hdr"
    path.write_bytes(rgbe(pixels, packed))
    expected = [[[(m + 0.5) / 256 * 2.0 ** (e - 128) if e else 0 for m in p] for *p, e in row] for row in pixels.tolist()]
    np.testing.assert_array_equal(read_panorama(str(path)), np.array(expected, np.float32))


def test_radiance_pictures_are_divided_by_all_their_exposures(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    found = []
    for lines in ((), ("4.000000e+00",), (" 4", "0.125 ")):
        path.write_bytes(exposed(*lines))
        found.append(read_panorama(str(path)))
    np.testing.assert_array_equal(found[0], np.full((4, 16, 3), 130.5 * 2.0 ** (130 - 136), np.float32))
    np.testing.assert_array_equal(found[1], found[0] / 4)
    np.testing.assert_array_equal(found[2], found[0] * 2)


def test_radiance_pictures_are_divided_by_all_their_colour_corrections(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    path.write_bytes(exposed(key="COLORCORR"))
    plain = read_panorama(str(path))
    path.write_bytes(corrected("2 4 0.5", " 2  1 1 ").replace(b"FORMAT", b"EXPOSURE=8\nFORMAT", 1))
    np.testing.assert_array_equal(read_panorama(str(path)), plain / np.array([32, 32, 4], np.float32))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_pictures_of_any_channels_and_aspect(tmp_path: Path, channels: int) -> None:
    pixels = np.random.default_rng(0).random((7, 5, channels)).astype(np.float32)
    write_exr(tmp_path / "a.exr", pixels)
    np.testing.assert_array_equal(read_panorama(str(tmp_path / "a.exr")), np.broadcast_to(pixels[..., :3], (7, 5, 3)))
    _, light = drawn(sky(str(tmp_path / "a.exr")), UP, 100)
    assert np.isfinite(light).all()


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, np.ones((4, 8, 3), np.float32))
    assert load_sky(str(path)) is load_sky(str(path))
    assert drawn(sky(str(path)), UP, 1)[1] == pytest.approx(drawn(sky(), UP, 1)[1])
    write_exr(path, np.full((4, 8, 3), 7, np.float32))
    os.utime(path, ns=(0, 0))
    assert drawn(sky(str(path)), UP, 1)[1] == pytest.approx(7 * drawn(sky(), UP, 1)[1])


def black(path: Path) -> None:
    write_exr(path, np.zeros((4, 8, 3), np.float32))


def bad(value: float) -> Callable[[Path], None]:
    pixels = np.ones((4, 8, 3), np.float32)
    pixels[2, 5, 1] = value

    def write(path: Path) -> None:  # our own writer refuses what is not finite, as it should
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": pixels}).write(str(path))

    return write


def depth(path: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": np.ones((4, 8), np.float32)}).write(str(path))


def exposed(*values: str, key: str = "EXPOSURE") -> bytes:
    """`GOOD_HDR` with such lines."""
    return GOOD_HDR.replace(b"FORMAT", "".join(f"{key}={value}\n" for value in values).encode() + b"FORMAT")


def corrected(*values: str) -> bytes:
    """`GOOD_HDR` with such COLORCORR lines."""
    return exposed(*values, key="COLORCORR")


PICTURE = ", expected an EXR or HDR picture; check the path or write it again$"
GOOD_HDR = rgbe(np.full((4, 16, 4), 130, np.uint8), True)
BAD: dict[str, tuple[str, Callable[[Path], object] | None, str]] = {
    "no such file": ("sky.exr", None, rf"image \S+sky\.exr: got No such file or directory{PICTURE}"),
    "no such name": ("sun-ski", None, r'image: got "sun-ski", expected a file that ends in \.exr or .* one of "white"'),
    "another format": ("sky.png", None, r"expected a file that ends in \.exr or \.hdr"),
    "not an EXR": ("sky.exr", lambda path: path.write_bytes(b"nothing"), rf"image \S+: got not a whole EXR .*\){PICTURE}"),
    "a folder": ("sky.exr", Path.mkdir, rf"image \S+sky\.exr: got no file{PICTURE}"),
    "a folder, too": ("sky.hdr", Path.mkdir, rf"image \S+sky\.hdr: got Is a directory{PICTURE}"),
    "depth": ("sky.exr", depth, rf"image \S+sky\.exr: got channels Z{PICTURE}"),
    "not a number": ("sky.exr", bad(np.nan), r"not finite in row 2, column 5 \(\[1\.0, nan, 1\.0\]\), expected"),
    "infinite": ("sky.exr", bad(np.inf), "not finite in row 2, column 5"),
    "negative": ("sky.exr", bad(-0.5), r"a negative radiance in row 2, column 5 .*; clip the image at 0"),
    "too bright": ("sky.exr", bad(1e31), r"a radiance above 1e\+30 in row 2"),
    "black": ("sky.exr", black, "got a black image, expected a sky that shines"),
    "not Radiance": ("sky.hdr", lambda path: path.write_bytes(b"P6 4 4"), rf"image \S+: got no Radiance RGBE .*{PICTURE}"),
    "cut short": ("sky.hdr", lambda path: path.write_bytes(GOOD_HDR[:-3]), rf"got not a whole Radiance image .*{PICTURE}"),
    "turned": ("sky.hdr", lambda path: path.write_bytes(GOOD_HDR.replace(b"-Y", b"+Y")), r'got "\+Y 4 \+X 16", expected rows'),
    "no exposure": ("sky.hdr", lambda path: path.write_bytes(exposed("0")), 'got "EXPOSURE=0", expected finite numbers'),
    "exposed below 0": ("sky.hdr", lambda path: path.write_bytes(exposed("-2", "-3")), 'got "EXPOSURE=-2", expected finite'),
    "exposed to words": ("sky.hdr", lambda path: path.write_bytes(exposed("1", "much")), 'got "EXPOSURE=much", expected'),
    "exposed for ever": ("sky.hdr", lambda path: path.write_bytes(exposed("inf")), 'got "EXPOSURE=inf", expected finite'),
    "exposed too far": ("sky.hdr", lambda path: path.write_bytes(exposed(*["1e200"] * 2)), 'got "EXPOSURE=1e200", expected'),
    "no colour": ("sky.hdr", lambda path: path.write_bytes(corrected("1 0 1")), 'got "COLORCORR=1 0 1", expected 3'),
    "two colours": ("sky.hdr", lambda path: path.write_bytes(corrected("1 2")), 'got "COLORCORR=1 2", expected 3'),
    "an empty colour": ("sky.hdr", lambda path: path.write_bytes(corrected("")), 'got "COLORCORR=", expected 3'),
    "turned twice": ("sky.hdr", lambda path: path.write_bytes(corrected("-1 1 1", "-1 1 1")), 'got "COLORCORR=-1 1 1"'),
    "too large": ("sky.hdr", lambda path: path.write_bytes(GOOD_HDR.replace(b"X 16", b"X 99999")), "got 99999 x 4 pixels"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_images_get_one_line(tmp_path: Path, case: str) -> None:
    name, write, message = BAD[case]
    if write is not None:
        write(tmp_path / name)
    image = str(tmp_path / name) if "." in name else name
    with pytest.raises(UserError, match=message) as caught:
        ddprt.irradiance(plane(), {"type": "environment", "image": image}, [[0, 0, 0]], [UP], samples=2)
    assert "\n" not in str(caught.value)


# --- drawing ----------------------------------------------------------------------------------------------------------


def free(positions: np.ndarray) -> np.ndarray:
    return np.ones(len(positions))


def test_drawn_skies_turn_any_way(patchwork: Path) -> None:
    settings = {
        "lightings.kinds": '["environment"]',
        "lightings.intensity": "[0.5, 2.0]",
        "lightings.environment": str(patchwork),
    }
    config = load_config(None, settings).lightings
    bounds = np.array([[0.0, 0, 0], [1, 1, 1]])
    found = draw_lightings(config, "train", 400, bounds=bounds, clearance=free, seed=0)
    lights = [light for (light,) in found.lightings]
    assert all(isinstance(light, EnvironmentLight) and light.image == str(patchwork) for light in lights)
    turns, scales = np.array([[light.rotation_deg, light.scale] for light in lights]).T  # type: ignore[attr-defined]
    for values, low, high in ((turns, 0, 360), (np.log(scales), np.log(0.5), np.log(2))):
        assert chi_square(np.histogram(values, 8, (low, high))[0], np.ones(8)) > SIGNIFICANT
        assert ((values >= low) & (values <= high)).all()
    missing = load_config(None, settings | {"lightings.environment": "missing.exr"}).lightings
    with pytest.raises(UserError, match="No such file"):
        draw_lightings(missing, "train", 1, bounds=bounds, clearance=free, seed=0)


def test_a_sky_is_doubtful_only_without_light(statue: tuple[Scene, Tracer, Atlas]) -> None:
    scene, tracer, _ = statue
    assert doubt((sky(),), False, scene, tracer) == ""
    assert doubt((sky(scale=0),), True, scene, tracer) == "lights nothing: it has no intensity"


@pytest.mark.slow
def test_the_whole_chain_under_skies(tmp_path: Path) -> None:
    """`ddprt run configs/smoke.toml` with skies on the statue: bakes by the operator, judged by the reference."""
    file = Path(__file__).parent.parent / "configs" / "smoke.toml"
    changes = {"scene.name": "statue", "lightings.kinds": '["environment"]', "atlas.resolution": "48"}
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "run",
                str(file),
                "--out",
                str(tmp_path),
                *(word for key, value in changes.items() for word in (f"--{key}", value)),
            ]
        )
    assert ended.value.code == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    check = metrics["spot_check"]
    # Scores of bake against reference, both noises counted; its noise per texel is five times the operator's bias.
    assert abs(check["mean"]) < SIGMAS / np.sqrt(check["count"])
    assert 0.6 < check["std"] < 1.4
    assert metrics["methods"]["svd-ridge"]["relative_rmse"] < 0.7 * metrics["methods"]["mean"]["relative_rmse"]
    described = json.loads((tmp_path / "dataset" / "dataset.json").read_text())
    assert {effect["name"] for effect in described["plan"] if effect["called"]} == {"diffuse bounces", "environment lights"}
    model = ddprt.load_model(tmp_path / "model.ddprt")
    lit, twice = (model.relight({"type": "environment", "image": "sun-sky", "scale": scale}) for scale in (1.0, 2.0))
    assert lit.any()
    np.testing.assert_allclose(twice, 2 * lit, rtol=1e-4, atol=1e-5 * lit.max())
