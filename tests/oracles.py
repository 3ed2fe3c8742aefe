"""Slow obvious twins: float64, loops, nothing shared with what they check but the definitions."""

import math

import mpmath
import numpy as np
from scipy import stats

from ddprt.fitting.basis import RANK_CUT
from ddprt.fitting.encoding import Encoding
from ddprt.lights import Lighting
from ddprt.methods.svd_ridge import LinearTransfer
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


# --- bounds of the linear algebra -------------------------------------------------------------------------------------

U32, U64 = 2.0**-24, 2.0**-53
"""Unit roundoffs of float32 and float64."""
TINY32 = 2.0**-126
"""Smallest normal float32; compiled code may flush what is below to 0."""
LARGEST32 = float(np.finfo(np.float32).max)


def rounding(operations: int, unit: float) -> float:
    """Relative error of a sum or product after so many roundings, in any order: n u / (1 - n u) (Higham 2002, 3.1)."""
    return operations * unit / (1 - operations * unit)


def over_bound(error: np.ndarray | float, bound: np.ndarray | float) -> float:
    """Worst error over its bound; 0 / 0 is 0, and what is not finite is infinitely wrong."""
    error, bound = np.broadcast_arrays(np.abs(np.asarray(error, float)), np.asarray(bound, float))
    if not np.isfinite(error).all() or np.isnan(bound).any():
        return np.inf
    shares = np.divide(error, bound, out=np.where(error > 0, np.inf, 0.0), where=bound > 0)
    return float(shares.max(initial=0))


def bound_scale(values: np.ndarray, channels: str) -> tuple[np.ndarray, float]:
    """Norm of each lighting and channel, and the relative error of a float32 one.

    The sum of n squares of quotients has n + 3 roundings (one of a quotient counts twice), the root halves them, root and
    product with the peak add two, and a quotient by a reciprocal one more.
    """
    axes = (1,) if channels == "mono" else (1, 2)
    size = np.sqrt((values.astype(np.longdouble) ** 2).sum(axes, keepdims=True)).astype(float)
    terms = int(np.prod([values.shape[axis] for axis in axes]))
    return np.broadcast_to(size, (len(values), 1, 3)), rounding(terms // 2 + 6, U32)


def bound_power(base: np.ndarray, error: np.ndarray, exponent: float) -> tuple[np.ndarray, np.ndarray]:
    """sign(x) |x|^p, and the error of a float32 one whose base is off by `error`.

    The power moves by as much as between the ends of [|x| - error, |x| + error]; through 0 it moves by both sides. Its own
    rounding is that of exp(p log|x|): p |log|x|| of two roundings turns into a relative error, and two more follow.
    """
    size = np.abs(base)
    high, low = (size + error) ** exponent, np.maximum(size - error, 0) ** exponent
    moved = np.where(size >= error, high - low, high + size**exponent)
    with np.errstate(divide="ignore"):
        logarithm = np.where(high > 0, np.abs(np.log(size + error)), 0)
    own = high * (2 * exponent * logarithm + 4) * U32
    return np.sign(base) * size**exponent, moved + own * (1 + 4 * U32) + TINY32


def bound_encode(values: np.ndarray, measured: np.ndarray, encoding: Encoding) -> tuple[np.ndarray, np.ndarray]:
    """Encoded light under the scale of what was measured, and the error of a float32 one: scale, quotient, power.

    Past the range of float32 the largest number stands, and light below its smallest normal number may count as dark, as
    `Encoding` says.
    """
    scale, relative = bound_scale(measured, encoding.channels)
    dark = scale < TINY32
    quotient = np.where(dark, 0, values / np.where(dark, 1, scale))
    quotient = np.clip(quotient, -LARGEST32, LARGEST32)
    error = np.abs(quotient) * (relative + 3 * U32) + np.where(dark, 0, TINY32 + TINY32 / np.where(dark, 1, scale))
    return (quotient, error) if encoding.space == "linear" else bound_power(quotient, error, 1 / encoding.gamma)


def bound_gram(rows: np.ndarray) -> float:
    """How far a float64 Gram matrix of the rows, and its eigenvalues, may be off (2-norm).

    Rounding of weights, differences and sums of n products: (n + 6) u64 of |A| |A|^T, whose norm is at most ||A||_F². A
    backward stable eigensolver adds N u64 of the norm, N rows. By Weyl each squared singular value moves by no more.
    """
    return (rounding(rows.shape[1] + 6, U64) + rounding(len(rows), U64)) * float(np.sum(rows**2))


def bound_singular_values(exact: np.ndarray, moved: float) -> np.ndarray:
    """Error of singular values whose squares are off by `moved`: moved / sigma, at most its root."""
    return moved / np.maximum(np.maximum(exact, np.sqrt(moved)), 1e-300) + U64 * exact


def exact_ridge(X: np.ndarray, C: np.ndarray, ridge: float | np.ndarray, digits: int = 50) -> np.ndarray:
    """M of min ||X M^T - C||² + sum of ridge_p ||M_p||² by elimination in so many decimal digits, in its smaller form."""
    with mpmath.workdps(digits):
        A, B = mpmath.matrix(X.tolist()), mpmath.matrix(C.tolist())
        weight = [mpmath.mpf(float(value)) for value in np.broadcast_to(ridge, X.shape[1])]
        if len(X) >= X.shape[1]:
            M = ((A.T * A + mpmath.diag(weight)) ** -1 * (A.T * B)).T
        else:
            spread = mpmath.diag([1 / value for value in weight])
            M = (spread * A.T * (A * spread * A.T + mpmath.eye(len(X))) ** -1 * B).T
        return np.array(M.tolist(), dtype=float)


def truncated_ridge(X: np.ndarray, C: np.ndarray, ridge: float, rank: int) -> np.ndarray:
    """The same on the first `rank` singular directions alone, in float64; at ridge 0 the pseudo-inverse."""
    Q, S, Pt = np.linalg.svd(X, full_matrices=False)
    Q, S, Pt = Q[:, :rank], S[:rank], Pt[:rank]
    return (C.T @ Q * (S / (S**2 + ridge))) @ Pt


def bound_ridge(X: np.ndarray, C: np.ndarray, M: np.ndarray, ridge: float, rank: int, doubt: float = 0.0) -> np.ndarray:
    """Entry by entry, how far a float32 M from a backward stable float64 SVD of X may be off.

    With G = (X^T X + ridge)^-1, dM = (C^T - M X^T) dX G - M dX^T X G, so
    ||dM|| <= ||dX|| (||C - X M^T|| ||G|| + 2 ||M|| ||X G||), where ||dX|| <= p u64 sigma_1 with p = lightings + points, twice
    for an intercept's means; ||G|| = 1 / (sigma² + ridge) and ||X G|| <= 1 / max(sigma, 2 sqrt(ridge)), sigma the smallest
    singular value. The second ||M|| ||X G|| is for a cut at rank r, where kept and dropped directions mix by ||dX|| over the
    gap sigma_r - sigma_r+1, which then stands for sigma. Products after the SVD add p u64 ||C|| ||X G||, float32 u32 |M|, and
    a C that is off by `doubt` (2-norm) that times ||X G||.
    Reference: Bjorck 1996, 1.4 and 2.7; Wedin 1973.
    """
    S = np.append(np.linalg.svd(X, compute_uv=False), 0.0)
    p = 2 * sum(X.shape)
    held = rank < X.shape[1] and ridge >= (RANK_CUT * S[0]) ** 2  # nothing below the cut counts under such a ridge
    least = 0.0 if held else S[rank - 1] - (S[rank] if rank < X.shape[1] else 0.0)
    inverse = 1 / (least**2 + ridge)
    slope = 1 / max(least, 2 * np.sqrt(ridge))
    moved = rounding(p, U64) * S[0] * (np.linalg.norm(C - X @ M.T) * inverse + 2 * np.linalg.norm(M) * slope)
    return moved + (rounding(p, U64) * np.linalg.norm(C) + doubt) * slope + U32 * np.abs(M) + TINY32


def bound_predict(
    relighter: LinearTransfer, encoding: Encoding, values: np.ndarray, *, clamp: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """A linear model's answer from its own stored arrays in float64, and the error of a float32 one, entry by entry.

    Errors of the encoding go through |M| and |U|; sums of n products add (n + 2) u32 of their absolute values.
    """
    M, offset, start, U, mean = (
        np.asarray(getattr(relighter, name), float) for name in ("matrix", "offset", "intercept", "basis", "mean")
    )
    frames, groups = len(values), len(M)
    z, dz = bound_encode(values, values, encoding)
    z, dz = (np.moveaxis(a, 2, 1) if groups == 3 else a.reshape(frames, 1, -1) for a in (z, dz))
    z, dz = z - offset, dz + U32 * (np.abs(z - offset) + dz)
    total = lambda a, b: np.einsum("gbp,fgp->fgb", a, b)  # noqa: E731
    u = total(M, z) + start
    du = total(np.abs(M), dz) + rounding(M.shape[2] + 2, U32) * (total(np.abs(M), np.abs(z) + dz) + np.abs(start))
    y = u @ U + mean
    dy = du @ np.abs(U) + rounding(len(U) + 2, U32) * ((np.abs(u) + du) @ np.abs(U) + np.abs(mean)) + TINY32
    y, dy = (np.moveaxis(a, 1, 2) if groups == 3 else a.reshape(frames, -1, 3) for a in (y, dy))
    if encoding.space == "gamma":
        y, dy = bound_power(y, dy, encoding.gamma)
    scale, relative = bound_scale(values, encoding.channels)
    error = scale * (dy + (np.abs(y) + dy) * (relative + 2 * U32)) + TINY32
    return np.clip((np.maximum(y, 0) if clamp else y) * scale, -LARGEST32, LARGEST32), error


def exact_singular_values(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Singular values of columns times the roots of their weights, with forty digits, falling."""
    with mpmath.workdps(40):
        roots = [mpmath.sqrt(mpmath.mpf(float(weight))) for weight in weights]
        rows = mpmath.matrix([[mpmath.mpf(float(v)) * root for v, root in zip(row, roots, strict=True)] for row in columns])
        return np.array([float(value) for value in mpmath.svd_r(rows, compute_uv=False)])


def winding_number(outline: np.ndarray, place: np.ndarray) -> int:
    """How often a plane outline runs round a place, by the angles that its edges are seen under."""
    total = 0.0
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        a, b = start - place, end - place
        total += math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    return round(total / (2 * math.pi))


def covers(triangle: np.ndarray, place: np.ndarray) -> bool:
    """Whether a plane triangle has a place inside, on the left of all its edges."""
    return all(
        (b[0] - a[0]) * (place[1] - a[1]) > (b[1] - a[1]) * (place[0] - a[0])
        for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True)
    )
