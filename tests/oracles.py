"""Slow obvious twins: float64, loops, nothing shared with what they check but the definitions."""

import numpy as np
from scipy import stats

from ddprt.lights import Lighting
from ddprt.scene.mesh import Scene

NUDGE = 1e-9
"""Metres that rays start off their surface; float64 coordinates of a metre carry 2e-16."""


def chi_square(counts: np.ndarray, expected: np.ndarray) -> float:
    """p-value of counts against expected counts; bins that expect fewer than 5 are pooled."""
    counts, expected = counts.ravel().astype(float), expected.ravel() * (counts.sum() / expected.sum())
    order = np.argsort(expected)
    counts, expected = counts[order], expected[order]
    rare = expected < 5
    if rare.any():
        counts = np.append(counts[~rare], counts[rare].sum())
        expected = np.append(expected[~rare], expected[rare].sum())
    if expected[-1] == 0:
        assert counts[-1] == 0, "samples fell where the density is 0"
        counts, expected = counts[:-1], expected[:-1]
    return float(stats.chisquare(counts, expected).pvalue)


def clipped_area(corners: np.ndarray, column: int, row: int, side: int) -> tuple[float, float]:
    """Area of a triangle inside one texel, and how wrong it can be.

    Counts the centres of side x side cells. A cell whose centre is farther from every edge than its own half diagonal is
    wholly in or out; the others are the doubt.
    """
    x, y = np.meshgrid(column + (np.arange(side) + 0.5) / side, row + (np.arange(side) + 0.5) / side)
    centre = np.stack([x.ravel(), y.ravel()], 1)
    signs, doubtful = [], np.zeros(len(centre), bool)
    for k in range(3):
        start, end = corners[k], corners[(k + 1) % 3]
        along = end - start
        signs.append(along[0] * (centre[:, 1] - start[1]) - along[1] * (centre[:, 0] - start[0]))
        share = np.clip((centre - start) @ along / (along @ along), 0, 1)
        doubtful |= np.linalg.norm(centre - start - share[:, None] * along, axis=1) < np.sqrt(0.5) / side
    inside = np.all(np.array(signs) > 0, axis=0) | np.all(np.array(signs) < 0, axis=0)
    return inside.mean(), doubtful.mean()


def first_hit(scene: Scene, origin: np.ndarray, direction: np.ndarray) -> tuple[int, float, float, float]:
    """Triangle (-1: none), distance and weights of the second and third corner, by trying every triangle.

    Reference: Moeller and Trumbore, "Fast, Minimum Storage Ray-Triangle Intersection", JGT 1997.
    """
    a, b, c = scene.corners.swapaxes(0, 1)
    p = np.cross(direction, c - a)
    determinant = ((b - a) * p).sum(1)
    parallel = determinant == 0
    determinant[parallel] = 1
    q = np.cross(origin - a, b - a)
    u, v = ((origin - a) * p).sum(1) / determinant, q @ direction / determinant
    distance = ((c - a) * q).sum(1) / determinant
    distance[parallel | (u < 0) | (v < 0) | (u + v > 1) | (distance <= 0)] = np.inf
    nearest = int(distance.argmin())
    if np.isinf(distance[nearest]):
        return -1, np.inf, 0.0, 0.0
    return nearest, float(distance[nearest]), float(u[nearest]), float(v[nearest])


def direct_irradiance(scene: Scene, lighting: Lighting, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Irradiance from lights without size at one point, with shadows."""
    total = np.zeros(3)
    for light in lighting:
        record = light.model_dump()
        if record["type"] == "directional":
            towards = -np.array(record["direction"])
            towards /= np.linalg.norm(towards)
            distance, strength = np.inf, np.array(record["irradiance"])
        else:
            away = np.array(record["position"]) - position
            distance = np.linalg.norm(away)
            towards, strength = away / distance, np.array(record["intensity"]) / distance**2
        if record["type"] == "spot":
            axis = np.array(record["direction"]) / np.linalg.norm(record["direction"])
            outer, inner = np.cos(np.radians(record["outer_deg"])), np.cos(np.radians(record["inner_deg"]))
            strength = strength * np.clip((-towards @ axis - outer) / (inner - outer), 0, 1) ** 2
        cosine = normal @ towards
        if cosine > 0 and first_hit(scene, position + NUDGE * normal, towards)[1] >= distance - 2 * NUDGE:
            total += cosine * strength
    return total


def cosine_direction(normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A cosine-weighted direction: the normal plus a point of the unit sphere, normalised."""
    while True:
        point = rng.uniform(-1, 1, 3)
        if 0 < point @ point <= 1:
            direction = normal + point / np.linalg.norm(point)
            return direction / np.linalg.norm(direction)


def indirect_irradiance(
    scene: Scene, lighting: Lighting, position: np.ndarray, normal: np.ndarray, depth: int, paths: int, rng: np.random.Generator
) -> np.ndarray:
    """Indirect irradiance of `depth` bounces at one point, one row per path: no roulette, each path goes its whole way."""
    results = np.zeros((paths, 3))
    for path in range(paths):
        here, facing, throughput = position, normal, np.ones(3)
        for _ in range(depth):
            direction = cosine_direction(facing, rng)
            triangle, distance, _, _ = first_hit(scene, here + NUDGE * facing, direction)
            if triangle < 0 or scene.geometric_normals[triangle] @ direction >= 0:
                break
            here, facing = here + NUDGE * facing + distance * direction, scene.geometric_normals[triangle]
            throughput = throughput * scene.materials[scene.material[triangle]].albedo
            results[path] += throughput * direct_irradiance(scene, lighting, here, facing)
    return results


def polygon_irradiance(corners: np.ndarray, radiance: float, position: np.ndarray, normal: np.ndarray) -> float:
    """Irradiance from a polygon of uniform radiance, all of it above the horizon (Lambert, 1760).

    E = L / 2 * sum over edges of the angle it subtends times the cosine between the receiver's and the edge's normal.
    """
    towards = corners - position
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    total = 0.0
    for k in range(len(corners)):
        a, b = towards[k], towards[(k + 1) % len(corners)]
        across = np.cross(a, b)
        total += np.arctan2(np.linalg.norm(across), a @ b) * (across / np.linalg.norm(across)) @ normal
    return abs(radiance * total / 2)


def above_horizon(corners: np.ndarray, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The part of a polygon in front of the receiver's plane."""
    height = (corners - position) @ normal
    kept = []
    for k in range(len(corners)):
        after = (k + 1) % len(corners)
        if height[k] >= 0:
            kept.append(corners[k])
        if (height[k] >= 0) != (height[after] >= 0):
            kept.append(corners[k] + height[k] / (height[k] - height[after]) * (corners[after] - corners[k]))
    return np.array(kept)


def eliminate(position: np.ndarray, keep: int, area: float, ties: list[int]) -> list[int]:
    """Sample elimination, every weight summed anew in every round; halved on to one sample, last survivor first.

    Two samples that crowd none but each other tie but for rounding: then the one that `ties` lists later (or not) goes.
    """
    alive, order, target = list(range(len(position))), [], keep
    while True:
        reach = np.sqrt(area / (2 * np.sqrt(3) * target))
        low = reach * (1 - (target / len(alive)) ** 1.5) * 0.65
        gone = []
        while len(alive) > target:
            crowding = {}
            for i in alive:
                crowding[i] = 0.0
                for j in alive:
                    distance = np.linalg.norm(position[i] - position[j])
                    if i != j and distance < 2 * reach:
                        crowding[i] += (1 - max(distance, 2 * low) / (2 * reach)) ** 8
            worst = [i for i in alive if crowding[i] >= max(crowding.values()) - 1e-12]
            gone.append(max(worst, key=lambda i: ties.index(i) if i in ties else len(ties)))
            alive.remove(gone[-1])
        if target < keep:
            order = gone[::-1] + order
        if target == 1:
            return alive + order
        target //= 2


def distance_to_triangle(point: np.ndarray, corners: np.ndarray) -> float:
    """Shortest distance: to the plane where the foot lies inside, else to the nearest edge."""
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    height = (point - a) @ normal
    foot = point - height * normal
    if all(np.cross(corners[(k + 1) % 3] - corners[k], foot - corners[k]) @ normal >= 0 for k in range(3)):
        return abs(height)
    nearest = np.inf
    for k in range(3):
        start, along = corners[k], corners[(k + 1) % 3] - corners[k]
        share = np.clip((point - start) @ along / (along @ along), 0, 1)
        nearest = min(nearest, np.linalg.norm(point - start - share * along))
    return float(nearest)


# Tops of Cornell's two blocks as published, x and z in metres, and their heights.
BLOCKS = [
    (np.array([[130, 65], [82, 225], [240, 272], [290, 114]]) / 1000, 0.165),
    (np.array([[423, 247], [265, 296], [314, 456], [472, 406]]) / 1000, 0.330),
]


def inside_a_block(point: np.ndarray) -> bool:
    """Whether a point lies in one of Cornell's prisms: below its top, and on one side of all four edges."""
    for corners, height in BLOCKS:
        along = np.roll(corners, -1, axis=0) - corners
        offset = point[[0, 2]] - corners
        side = along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0]
        if point[1] < height and (np.all(side > 0) or np.all(side < 0)):
            return True
    return False
