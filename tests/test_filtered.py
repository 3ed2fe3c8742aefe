"""Textures finer than texels: the mean over each piece of the surface, against brute force and closed forms."""

import numpy as np
import pytest

from ddprt.scene.atlas import build_atlas
from ddprt.scene.checks import checked
from ddprt.scene.filtered import area_mean, mean_albedo
from ddprt.scene.material import Material, bilinear
from ddprt.scene.mesh import Scene


def textured(texture: np.ndarray, repeat: float = 1.0) -> Scene:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    material = Material("m", (0.8, 0.9, 1.0), texture.astype(np.float32))
    return checked("square", square, np.array([[0, 1, 2], [0, 2, 3]]), uv=repeat * square[:, :2], materials=(material,))


@pytest.mark.parametrize("width", [128, 512, 2048])
def test_a_chequerboard_finer_than_texels_is_grey(width: int) -> None:
    squares = np.indices((width, width)).sum(0) % 2
    atlas = build_atlas(textured(np.repeat(squares[..., None], 3, 2)), 32)
    pixels = width / np.sqrt(atlas.coverage.sum())  # along a texel
    assert pixels > 3
    # Boxes of w >= 1 pixels are off by half a pixel along two sides, of alternating sign along these: 1 / (2 w), only where
    # they are a pixel wide and stand at its middle. Sums over a texel's pieces leave what alternates along its rim alone: a
    # pixel of 4 sides, of which what is left over is less than one row of half weight each.
    bound = 0.5 / pixels
    np.testing.assert_allclose(atlas.albedo, np.tile([0.4, 0.45, 0.5], (atlas.count, 1)), atol=bound)
    # A single lookup, as it would be, is black or white.
    middle = bilinear(squares.astype(float), atlas.position[:, :2])
    assert np.abs(middle - 0.5).max() > 2 * bound


@pytest.mark.parametrize("size", [0.002, 0.05, 0.3, 4.0])
def test_means_agree_with_brute_force(size: float) -> None:
    rng = np.random.default_rng(0)
    image = rng.random((37, 23, 2))
    corners = rng.uniform(-3, 3, (60, 1, 2)) + rng.uniform(-size, size, (60, 3, 2))
    flat = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) < 0.2 * size**2
    corners = corners[~flat]
    weights = rng.dirichlet(np.ones(3), 20_000)
    values = np.stack([bilinear(image, weights @ triangle) for triangle in corners])
    expected, noise = values.mean(1), values.std(1) / 20_000**0.5
    error = area_mean(image, corners) - expected
    # Small triangles of at most half a pixel each: their middles stand for what is linear exactly, for a change of slope by up
    # to 2 per pixel within one to an eighth of their width, along each axis. Where there are too many pixels for that, boxes
    # reach a thirty-second of the piece beyond its rim: of a mean of independent pixels, less than 15 % are others there.
    pixels = np.ptp(corners * [23, 37], axis=1).max(1, keepdims=True)
    bound = np.where(pixels <= 8, 2 * 2 / 8 * np.minimum(pixels, 0.5), 0.15 * values.std(1))
    assert (np.abs(error) < 5 * noise + bound).all()
    # These errors have either sign; a single lookup is off by the whole deviation.
    assert np.sqrt((error**2).mean()) < 0.05 * np.sqrt(values.var(1).mean()) + 5 * noise.max()


def test_a_piece_finer_than_the_pixels_is_one_lookup() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((5, 9, 3))
    corners = rng.uniform(-3, 3, (500, 1, 2)) + rng.uniform(-0.02, 0.02, (500, 3, 2))
    np.testing.assert_allclose(area_mean(image, corners), bilinear(image, corners.mean(1)), atol=1e-12)


def test_a_step_in_the_middle_of_a_texel_is_shared() -> None:
    """Left half black, right half white, 3 pixels to each texel: the mean over the surface is kept."""
    texture = np.zeros((90, 90, 3))
    texture[:, 45:] = 1
    atlas = build_atlas(textured(texture), 34)
    mean = atlas.area @ atlas.albedo / atlas.area.sum()
    # Both rims of the white half are a pixel wide ramps, symmetric; what boxes mistake cancels to a percent of a texel's row.
    np.testing.assert_allclose(mean, [0.4, 0.45, 0.5], atol=0.01 / 30)


def test_plain_colours_keep_every_bit() -> None:
    scene = textured(np.ones((2, 2, 3)))
    plain = checked("plain", scene.positions, scene.triangles, materials=(Material("m", (0.8, 0.9, 1.0)),))
    weights = np.random.default_rng(0).dirichlet(np.ones(3), (50, 3))
    found = mean_albedo(plain, np.zeros(50, np.int32), weights)
    np.testing.assert_array_equal(found, np.tile([0.8, 0.9, 1.0], (50, 1)))
