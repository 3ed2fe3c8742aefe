"""Distances to triangles against trimesh, which looks for the nearest point by regions of the plane."""

import numpy as np
import pytest
import trimesh

from ddprt.scene.distance import distance_within

RNG = np.random.default_rng(0)
CORNERS = RNG.normal(size=(60, 3, 3))
CORNERS[:5, 1] = CORNERS[:5, 0]  # a needle
CORNERS[5:8] = CORNERS[5:8, :1]  # a point
BOUNDS = np.stack([CORNERS.min(1), CORNERS.max(1)], 1)
PLACES = RNG.normal(size=(40, 3)) * 2


def nearest(place: np.ndarray) -> float:
    """Of the triangles that have an area, and of the edges of the others."""
    whole = trimesh.triangles.closest_point(CORNERS[8:], np.broadcast_to(place, (len(CORNERS) - 8, 3)))
    start, edge = CORNERS[:8, 0], CORNERS[:8, 2] - CORNERS[:8, 0]
    along = np.einsum("nd,nd->n", place - start, edge) / np.maximum(np.einsum("nd,nd->n", edge, edge), 1e-300)
    thin = start + np.clip(along, 0, 1)[:, None] * edge
    return float(np.linalg.norm(np.concatenate([whole, thin]) - place, axis=1).min())


@pytest.mark.parametrize("reach", [np.inf, 0.5])
def test_it_is_that_of_another_library(reach: float) -> None:
    found = [distance_within(CORNERS, BOUNDS, place, reach) for place in PLACES]
    expected = [min(nearest(place), reach) for place in PLACES]
    assert np.ptp(expected) > 0.3 * min(reach, 1)  # some are near, some far
    # Each is a root of sums of products of numbers up to 10, relative to differences that are no smaller than 1e-2.
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_what_is_known_stays_to_the_bit() -> None:
    far = np.array([1e3, 0.0, 0.0])
    for reach in (0.1, 1 / 3, 7e-5):
        assert distance_within(CORNERS, BOUNDS, far, reach) == reach
