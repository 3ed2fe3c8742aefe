"""From the unit square to where rays start and go.

Every sampler comes in threes: `sample_x` maps uniform numbers to x, `pdf_x` is its density, `invert_x` maps back.
Arrays keep their floating type, so transport stays in float32.
"""

import numpy as np

from ddprt.axes import Float, Float32

_TWO_PI = 2 * np.pi


def sample_triangle(u: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Weights of the second and third corner, uniform over a triangle of unit area.

    Reference: Heitz, "A Low-Distortion Map Between Triangle and Square", 2019.
    """
    x, y = u[..., 0], u[..., 1]
    low = np.minimum(x, y) * u.dtype.type(0.5)
    return np.stack([x - low, y - low], -1) if u.ndim > 1 else np.array([x - low, y - low], u.dtype)


def pdf_triangle(weights: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    """Density over the reference triangle (area 1/2): 2 inside."""
    inside = (weights >= 0).all(-1) & (weights.sum(-1) <= 1)
    return np.where(inside, weights.dtype.type(2), weights.dtype.type(0))


def invert_triangle(weights: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """The uniform numbers that give these weights."""
    x, y = weights[..., 0], weights[..., 1]
    low = np.minimum(x, y)
    return np.stack([x + low, y + low], -1)


def sample_cosine(u: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
    """Unit directions about +z with density cos(theta) / pi."""
    radius, phi = np.sqrt(u[..., 0]), u.dtype.type(_TWO_PI) * u[..., 1]
    z = np.sqrt(np.maximum(1 - u[..., 0], 0))
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], -1)


def pdf_cosine(direction: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Per steradian."""
    return np.maximum(direction[..., 2], 0) / np.pi


def invert_cosine(direction: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """The uniform numbers that give these directions."""
    x, y = direction[..., 0], direction[..., 1]
    return np.stack([x * x + y * y, np.mod(np.arctan2(y, x) / _TWO_PI, 1.0)], -1)


def sample_sphere(u: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
    """Unit directions, uniform over the sphere."""
    return sample_cone(u, 2.0)


def pdf_sphere(direction: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Per steradian."""
    return pdf_cone(direction, 2.0)


def invert_sphere(direction: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """The uniform numbers that give these directions."""
    return invert_cone(direction, 2.0)


def sample_cone(u: Float[np.ndarray, "*n 2"], cap: float | np.ndarray) -> Float[np.ndarray, "*n 3"]:
    """Unit directions, uniform within a cone about +z; `cap` = 1 - cos(theta_max) keeps narrow cones exact."""
    drop = u[..., 0] * np.asarray(cap, u.dtype)
    radius, phi = np.sqrt(np.maximum(drop * (2 - drop), 0)), u.dtype.type(_TWO_PI) * u[..., 1]
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), 1 - drop], -1)


def pdf_cone(direction: Float[np.ndarray, "*n 3"], cap: float | np.ndarray) -> Float[np.ndarray, "*n"]:
    """Per steradian."""
    inside = 1 - direction[..., 2] <= cap
    return np.where(inside, 1 / (_TWO_PI * np.asarray(cap)), 0.0).astype(direction.dtype)


def invert_cone(direction: Float[np.ndarray, "*n 3"], cap: float | np.ndarray) -> Float[np.ndarray, "*n 2"]:
    """The uniform numbers that give these directions."""
    turn = np.mod(np.arctan2(direction[..., 1], direction[..., 0]) / _TWO_PI, 1.0)
    return np.stack([(1 - direction[..., 2]) / np.asarray(cap, direction.dtype), turn], -1)


def frame(normal: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Right-handed orthonormal rows (tangent, bitangent, normal).

    Reference: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017.
    """
    x, y, z = np.moveaxis(normal, -1, 0)
    sign = np.copysign(normal.dtype.type(1), z)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangent = np.stack([b, sign + y * y * a, -y], -1)
    return np.stack([tangent, bitangent, normal], -2)


def to_world(
    local: Float[np.ndarray, "n 3"], frames: Float[np.ndarray, "n 3 3"] | Float[np.ndarray, "n 9"]
) -> Float[np.ndarray, "n 3"]:
    """Directions about +z turned into the frames that `frame` makes, a column at a time."""
    rows, (x, y, z) = frames.reshape(-1, 9), np.ascontiguousarray(local.T)
    world = np.empty_like(local)
    for axis in range(3):
        world[:, axis] = x * rows[:, axis] + y * rows[:, 3 + axis] + z * rows[:, 6 + axis]
    return world


def sobol(count: int, dimensions: int, seed: int) -> Float32[np.ndarray, "count dimensions"]:
    """Owen-scrambled Sobol points in [0, 1); any count is allowed, powers of two are the best balanced."""
    from scipy.stats import qmc  # half a second to import: only where it is needed

    engine = qmc.Sobol(dimensions, scramble=True, rng=seed)
    points = engine.random_base2(max(count - 1, 0).bit_length())[:count]
    return np.minimum(points, np.nextafter(np.float32(1), np.float32(0))).astype(np.float32)
