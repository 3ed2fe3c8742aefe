"""Metal-rough reflection as in Appendix B of glTF 2.0: how much light goes where, and directions drawn accordingly.

GGX facets with alpha = roughness², Schlick's Fresnel, and a metal that is `metallic` of the way from a dielectric:

    f0 = (1 - metallic) dielectric + metallic base,   F = f0 + (1 - f0) (1 - o.h)^5
    f = F D V + (1 - metallic) base / pi (1 - E(o)) (1 - E(i)) / (1 - mean E)

Where the appendix leaves a choice: V is Smith's term with correlated heights, as in Khronos' sample renderer and most engines
(the appendix prints the product of both sides). The diffuse part is weighed by what the facets' albedo E leaves over, the form
that the notes on KHR_materials_specular give, and not by 1 - F, which would send out 1.9 times the light at grazing angles.
So a white dielectric sends back what it gets. Metals lose what facets would reflect twice (`LOSS`), as they do in an engine's
own light from lamps; a lobe that made up for it would bake light that nobody sees on the metal itself.

Directions are unit vectors in the surface's frame, z along its normal; "out" is where the light goes, "in" where it comes from.
References: Walter et al., EGSR 2007; Heitz, JCGT 2014 and 2018; Kelemen and Szirmay-Kalos, Eurographics 2001 (diffuse part).
"""

from functools import lru_cache

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int
from ddprt.compiled import compiled

SMOOTHEST = 0.05
"""Least roughness: the lobe is then half as wide as the sun. Anything smoother is a mirror to light from lamps without size."""

LOSS = {0.1: 0.0005, 0.2: 0.006, 0.3: 0.0235, 0.4: 0.06, 0.5: 0.118, 0.6: 0.197, 0.7: 0.292, 0.8: 0.396, 0.9: 0.498, 1.0: 0.591}
"""Share of light from everywhere that a white metal swallows, by roughness."""

_ROUGH, _TILT = 32, 64  # nodes of the table of albedos
_LATTICE, _STEP = 1597, 987  # Fibonacci numbers: points of the quadrature behind each node

Directions = Float[np.ndarray, "n 3"]


def evaluate(outgoing: Directions, incoming: Directions, base: Directions, gloss: Directions) -> Float32[np.ndarray, "n 3"]:
    """BSDF times the cosine of the incoming direction, per steradian; 0 where either lies below the surface.

    Args:
      outgoing, incoming: unit, in the surface's frame.
      base: colour, 0 to 1.
      gloss: roughness, metallic and the dielectric's reflectance, each 0 to 1.
    """
    value = np.empty((len(outgoing), 3), np.float32)
    _evaluate(outgoing, incoming, base, gloss, *tables(), value)
    return value


def sample(
    outgoing: Directions, u: Directions, base: Directions, gloss: Directions
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Incoming directions for uniform numbers, of which the third chooses between facets and diffuse part.

    Returns:
      The directions, and `evaluate` over `pdf` there: 0 where a facet reflects below the surface.
    """
    incoming, weight = np.empty((2, len(outgoing), 3), np.float32)
    _sample(outgoing, u, base, gloss, *tables(), incoming, weight)
    return incoming, weight


def pdf(outgoing: Directions, incoming: Directions, base: Directions, gloss: Directions) -> Float32[np.ndarray, " n"]:
    """Density of `sample`, per steradian; its integral over the hemisphere is the share of samples that stay above it."""
    density = np.empty(len(outgoing), np.float32)
    _pdf(outgoing, incoming, base, gloss, *tables(), density)
    return density


def shared(
    incoming: Directions,
    base: Directions,
    gloss: Directions,
    group: Int[np.ndarray, "n 2"],
    outgoing: Float[np.ndarray, "all 3"],
    factor: Float[np.ndarray, "all factors"],
) -> Float32[np.ndarray, "n factors 3"]:
    """What light from each incoming direction is worth to sums over outgoing ones, by the balance heuristic.

    Args:
      incoming, base, gloss: n directions that `sample` drew for outgoing ones of their groups, one for each, and surfaces.
      group: first and last but one of each one's group among the outgoing directions.
      outgoing, factor: all directions, and how often each counts in each of the sums.
    Returns:
      The sum over a group of factor times `evaluate`, over the sum of `pdf`; 0 for directions below the surface.
    """
    worth = np.empty((len(incoming), factor.shape[1], 3), np.float32)
    _shared(incoming, base, gloss, group, outgoing, factor, *tables(), worth)
    return worth


def sample_visible(
    u: Float[np.ndarray, "n 2"], outgoing: Directions, alpha: Float[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Normals of facets, as often as they are seen from `outgoing`; alpha is roughness squared."""
    facing = np.empty((len(u), 3))
    _visible_all(u, outgoing, alpha, facing)
    return facing


def pdf_visible(facing: Directions, outgoing: Directions, alpha: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Density of these normals, per steradian."""
    z, along = outgoing[:, 2], np.einsum("nd,nd->n", facing, outgoing)
    slope = (facing[:, 0] ** 2 + facing[:, 1] ** 2) / alpha**2 + facing[:, 2] ** 2
    seen = 2 / (z + np.sqrt(alpha**2 + (1 - alpha**2) * z**2))
    return np.where((facing[:, 2] > 0) & (along > 0), seen * along / (np.pi * alpha**2 * slope**2), 0.0)


def invert_visible(facing: Directions, outgoing: Directions, alpha: Float[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
    """The uniform numbers that give these normals."""
    stretched, tilted = outgoing * np.stack([alpha, alpha, np.ones_like(alpha)], 1), facing.astype(np.float64)
    stretched, tilted = stretched.astype(np.float64), tilted / np.stack([alpha, alpha, np.ones_like(alpha)], 1)
    stretched, tilted = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (stretched, tilted))
    across = np.stack([-stretched[:, 1], stretched[:, 0], np.zeros(len(stretched))], 1)
    flat = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(flat > 0, across / np.where(flat > 0, flat, 1), [1.0, 0.0, 0.0])
    x = np.einsum("nd,nd->n", tilted, across)
    y = np.einsum("nd,nd->n", tilted, np.cross(stretched, across))
    lift = (1 + stretched[:, 2]) / 2
    y = (y - (1 - lift) * np.sqrt(np.maximum(1 - x * x, 0))) / lift
    return np.stack([x * x + y * y, np.mod(np.arctan2(y, x) / (2 * np.pi), 1.0)], -1)


def albedo(cosine: Float[np.ndarray, " n"], roughness: float, f0: float) -> Float64[np.ndarray, " n"]:
    """Share of light along directions of some cosine to the normal that facets of reflectance f0 send back."""
    table, _ = tables()
    found = np.empty(len(cosine))
    _albedos(cosine, roughness, f0, table, found)
    return found


def mean_albedo(roughness: float, f0: float) -> float:
    """The same of light from everywhere."""
    _, means = tables()
    return between_means(means, float(roughness), float(f0))


@lru_cache(maxsize=1)
def tables() -> tuple[np.ndarray, np.ndarray]:
    """Albedos of facets by roots of roughness and cosine, f0 times the first plus the second; and their means.

    The means are those of what is interpolated, so that the diffuse part gives back exactly what the table takes.
    """
    table = np.empty((_ROUGH, _TILT, 2))
    edge = np.linspace(0, 1, _TILT)
    _integrate(SMOOTHEST + (1 - SMOOTHEST) * np.linspace(0, 1, _ROUGH) ** 2, edge, table)
    low, high, step = edge[:-1], edge[1:], edge[1]
    # Of light from everywhere, 8 t^7 dt comes at cosines of t^4; a line between two nodes integrates to a sum of powers.
    whole, first = high**8 - low**8, 8 / 9 * (high**9 - low**9)
    right = (first - low * whole) / step
    means = np.einsum("s,rsk->rk", whole - right, table[:, :-1]) + np.einsum("s,rsk->rk", right, table[:, 1:])
    return table, means


@compiled
def _visible(x: float, y: float, z: float, alpha: float, first: float, second: float) -> tuple[float, float, float]:
    """A facet's normal: a point of the half disc that the stretched hemisphere shows (Heitz 2018)."""
    x, y = alpha * x, alpha * y
    size = 1 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * size, y * size, z * size
    flat = np.sqrt(x * x + y * y)
    across_x, across_y = (-y / flat, x / flat) if flat > 0 else (1.0, 0.0)
    up_x, up_y, up_z = -z * across_y, z * across_x, x * across_y - y * across_x
    radius, turn = np.sqrt(first), 2 * np.pi * second
    a, b = radius * np.cos(turn), radius * np.sin(turn)
    lift = 0.5 * (1 + z)
    b = (1 - lift) * np.sqrt(max(0.0, 1 - a * a)) + lift * b
    c = np.sqrt(max(0.0, 1 - a * a - b * b))
    normal_x, normal_y = alpha * (a * across_x + b * up_x + c * x), alpha * (a * across_y + b * up_y + c * y)
    normal_z = max(1e-12, b * up_z + c * z)
    size = 1 / np.sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z)
    return normal_x * size, normal_y * size, normal_z * size


@compiled
def _visible_all(u: np.ndarray, outgoing: np.ndarray, alpha: np.ndarray, facing: np.ndarray) -> None:
    for i in range(len(u)):
        x, y, z = outgoing[i, 0], outgoing[i, 1], outgoing[i, 2]
        facing[i, 0], facing[i, 1], facing[i, 2] = _visible(x, y, z, alpha[i], u[i, 0], u[i, 1])


@compiled
def root(alpha: float, cosine: float) -> float:
    """Of Smith's term: what a direction's facets hide."""
    return np.sqrt(alpha * alpha + (1 - alpha * alpha) * cosine * cosine)


@compiled
def _facets(outgoing: np.ndarray, incoming: np.ndarray, alpha: float) -> tuple[float, float]:
    """How dense facets are that reflect one direction into the other, and 1 - F's fifth power there."""
    x, y = float(outgoing[0]) + incoming[0], float(outgoing[1]) + incoming[1]
    z = float(outgoing[2]) + incoming[2]
    square = x * x + y * y + z * z
    slope = ((x * x + y * y) / (alpha * alpha) + z * z) / square
    grazing = max(0.0, 1 - 0.5 * np.sqrt(square))  # the half vector's cosine is half the length of the sum
    return 1 / (np.pi * alpha * alpha * slope * slope), grazing**5


@compiled
def between(table: np.ndarray, roughness: float, cosine: float, f0: float) -> float:
    """Albedo of facets, between the table's nodes."""
    row = np.sqrt((roughness - SMOOTHEST) / (1 - SMOOTHEST)) * (table.shape[0] - 1)
    column = np.sqrt(np.sqrt(cosine)) * (table.shape[1] - 1)
    r, c = min(int(row), table.shape[0] - 2), min(int(column), table.shape[1] - 2)
    down, right = row - r, column - c
    total = 0.0
    for k in range(2):
        above = table[r, c, k] * (1 - right) + table[r, c + 1, k] * right
        below = table[r + 1, c, k] * (1 - right) + table[r + 1, c + 1, k] * right
        total += (1.0 if k else f0) * (above * (1 - down) + below * down)
    return total


@compiled
def between_means(means: np.ndarray, roughness: float, f0: float) -> float:
    """The same of light from everywhere."""
    row = np.sqrt((max(roughness, SMOOTHEST) - SMOOTHEST) / (1 - SMOOTHEST)) * (len(means) - 1)
    r = min(int(row), len(means) - 2)
    down = row - r
    return (f0 * means[r, 0] + means[r, 1]) * (1 - down) + (f0 * means[r + 1, 0] + means[r + 1, 1]) * down


@compiled
def _albedos(cosine: np.ndarray, roughness: float, f0: float, table: np.ndarray, found: np.ndarray) -> None:
    for i in range(len(cosine)):
        found[i] = between(table, max(roughness, SMOOTHEST), cosine[i], f0)


@compiled
def _integrate(rough: np.ndarray, tilt: np.ndarray, table: np.ndarray) -> None:
    """Albedos with F = 1, less those with F = (1 - o.h)^5, and the latter: means over facets that are seen."""
    for r in range(len(rough)):
        alpha = rough[r] * rough[r]
        for t in range(len(tilt)):
            z = max(tilt[t] ** 4, 1e-8)
            x = np.sqrt(1 - z * z)
            whole, grazing = 0.0, 0.0
            for k in range(_LATTICE):
                a, _, c = _visible(x, 0.0, z, alpha, (k + 0.5) / _LATTICE, (k * _STEP % _LATTICE) / _LATTICE)
                along = a * x + c * z
                under = 2 * along * c - z
                if under > 0:
                    share = under * (z + root(alpha, z)) / (z * root(alpha, under) + under * root(alpha, z))
                    whole += share
                    grazing += share * max(0.0, 1 - along) ** 5
            table[r, t, 0], table[r, t, 1] = (whole - grazing) / _LATTICE, grazing / _LATTICE


@compiled
def _odds(outgoing: np.ndarray, base: np.ndarray, gloss: np.ndarray, table: np.ndarray) -> float:
    """Chance of a sample by facets: their share of what both parts send out, about."""
    roughness, metallic, dielectric = max(float(gloss[0]), SMOOTHEST), float(gloss[1]), float(gloss[2])
    colour = (float(base[0]) + float(base[1]) + float(base[2])) / 3
    out = float(outgoing[2])
    facets = between(table, roughness, out, dielectric + metallic * (colour - dielectric))
    diffuse = (1 - metallic) * colour * (1 - between(table, roughness, out, dielectric))
    return facets / (facets + diffuse)


@compiled
def _terms(
    outgoing: np.ndarray, incoming: np.ndarray, base: np.ndarray, gloss: np.ndarray, table: np.ndarray, means: np.ndarray
) -> tuple[float, float, float, float]:
    """BSDF times cosine: what is to be multiplied by f0, by nothing and by the base colour; and the density of samples."""
    out, under = float(outgoing[2]), float(incoming[2])
    if not (out > 0 and under > 0):
        return 0.0, 0.0, 0.0, 0.0
    roughness, metallic, dielectric = max(float(gloss[0]), SMOOTHEST), float(gloss[1]), float(gloss[2])
    alpha = roughness * roughness
    dense, grazing = _facets(outgoing, incoming, alpha)
    lobe = 0.5 * dense * under / (out * root(alpha, under) + under * root(alpha, out))
    diffuse = (1 - between(table, roughness, out, dielectric)) * (1 - between(table, roughness, under, dielectric))
    diffuse *= (1 - metallic) * under / (np.pi * (1 - between_means(means, roughness, dielectric)))
    odds = _odds(outgoing, base, gloss, table)
    density = odds * dense / (2 * (out + root(alpha, out))) + (1 - odds) * under / np.pi
    return (1 - grazing) * lobe, grazing * lobe, diffuse, density


@compiled
def _evaluate(
    outgoing: np.ndarray,
    incoming: np.ndarray,
    base: np.ndarray,
    gloss: np.ndarray,
    table: np.ndarray,
    means: np.ndarray,
    value: np.ndarray,
) -> None:
    for i in range(len(value)):
        mirrored, grazing, diffuse, _ = _terms(outgoing[i], incoming[i], base[i], gloss[i], table, means)
        for channel in range(3):
            f0 = gloss[i, 2] + gloss[i, 1] * (base[i, channel] - gloss[i, 2])
            value[i, channel] = f0 * mirrored + grazing + base[i, channel] * diffuse


@compiled
def _pdf(
    outgoing: np.ndarray,
    incoming: np.ndarray,
    base: np.ndarray,
    gloss: np.ndarray,
    table: np.ndarray,
    means: np.ndarray,
    density: np.ndarray,
) -> None:
    for i in range(len(density)):
        density[i] = _terms(outgoing[i], incoming[i], base[i], gloss[i], table, means)[3]


@compiled
def _sample(
    outgoing: np.ndarray,
    u: np.ndarray,
    base: np.ndarray,
    gloss: np.ndarray,
    table: np.ndarray,
    means: np.ndarray,
    incoming: np.ndarray,
    weight: np.ndarray,
) -> None:
    for i in range(len(weight)):
        x, y, z = float(outgoing[i, 0]), float(outgoing[i, 1]), float(outgoing[i, 2])
        if u[i, 2] < _odds(outgoing[i], base[i], gloss[i], table):
            roughness = max(float(gloss[i, 0]), SMOOTHEST)
            a, b, c = _visible(x, y, z, roughness * roughness, float(u[i, 0]), float(u[i, 1]))
            along = 2 * (a * x + b * y + c * z)
            incoming[i, 0], incoming[i, 1], incoming[i, 2] = along * a - x, along * b - y, along * c - z
        else:
            radius, turn = np.sqrt(float(u[i, 0])), 2 * np.pi * u[i, 1]
            incoming[i, 0], incoming[i, 1] = radius * np.cos(turn), radius * np.sin(turn)
            incoming[i, 2] = np.sqrt(1 - float(u[i, 0]))
        mirrored, grazing, diffuse, density = _terms(outgoing[i], incoming[i], base[i], gloss[i], table, means)
        for channel in range(3):
            f0 = gloss[i, 2] + gloss[i, 1] * (base[i, channel] - gloss[i, 2])
            value = f0 * mirrored + grazing + base[i, channel] * diffuse
            weight[i, channel] = value / density if density > 0 else 0.0


@compiled
def _shared(
    incoming: np.ndarray,
    base: np.ndarray,
    gloss: np.ndarray,
    group: np.ndarray,
    outgoing: np.ndarray,
    factor: np.ndarray,
    table: np.ndarray,
    means: np.ndarray,
    worth: np.ndarray,
) -> None:
    factors = factor.shape[1]
    sums = np.empty((3, factors))
    for i in range(len(incoming)):
        worth[i] = 0
        if not incoming[i, 2] > 0:
            continue
        sums[:] = 0
        total = 0.0
        for j in range(group[i, 0], group[i, 1]):
            mirrored, grazing, diffuse, density = _terms(outgoing[j], incoming[i], base[i], gloss[i], table, means)
            total += density
            for k in range(factors):
                sums[0, k] += factor[j, k] * mirrored
                sums[1, k] += factor[j, k] * grazing
                sums[2, k] += factor[j, k] * diffuse
        if total > 0:
            for channel in range(3):
                f0 = gloss[i, 2] + gloss[i, 1] * (base[i, channel] - gloss[i, 2])
                for k in range(factors):
                    worth[i, k, channel] = (f0 * sums[0, k] + sums[1, k] + base[i, channel] * sums[2, k]) / total
