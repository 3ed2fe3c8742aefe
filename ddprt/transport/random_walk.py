"""Random walks of light through a homogeneous medium that fills a closed body, from the surface to the surface.

Compiled code draws how far each walk flies, and scatters it, for as long as a grid of depths says that it stays inside; Embree
tells whether the surface comes first where it may, for all walks of a call together. One walk serves all channels: for each
flight a channel is drawn in proportion to the walk's weights, and each weight is multiplied by its own channel's chance over
that of the draw (the balance heuristic). So no weight leaves its bounds: their sum never grows.

A thick body would keep walks for ever. Two things shorten them. Once a direction is forgotten (the anisotropy to the power of
the scatterings is below `_FORGOTTEN`) the medium becomes the similar one that scatters evenly, sigma_s' = (1 - g) sigma_s. And
where the surface is further than `FAR` of its free paths, a walk goes at once to a sphere about it that just fits, where it
comes first with equal odds everywhere: a step of the walk on spheres for diffusion (Muller, "Some Continuous Monte Carlo
Methods for the Dirichlet Problem", 1956). What it lost on the way is x / sinh x with x = (radius + 0.71 free paths) / the
diffusion length (see `diffusion.weight_of_jump`), and directions there lean outwards as in Milne's problem. Both are measured
in docs/effects.md. Light weaker than `_FAINT` plays roulette.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt.axes import Float32, Int32
from ddprt.compiled import compiled
from ddprt.scene.material import Subsurface
from ddprt.transport.diffusion import EXTRAPOLATED, decay_rate, depths
from ddprt.transport.packets import Geometry

FAR = 3.0
"""Free paths between a walk and the surface from which on it jumps: there the weight is off by 1e-4 where a meeting leaves 99 %
of the light, by 6e-3 where it leaves 95 %."""

WHITE = 0.9
"""Least albedo of a channel with which walks jump; darker ones end before they get that far."""

LEANING = 0.707, 0.26
"""Mean cosine, to the normal, of light that comes first to a sphere: Milne's, and what 1 / (radius in free paths) adds."""

_FORGOTTEN = 0.05
_FAINT = 0.5  # of a sum of three weights
_CELLS = 160  # of the grid of depths, along the body's longest side, at most
_STEP = 0.25  # cells; where the surface is nearer to a flight than that, a ray tells which of them comes first
_ROUNDING = 1e-5  # of a cell's squared edge
_MOST = 200_000  # rays of a walk; only a white body in which light is caught reaches them


@dataclass(frozen=True, eq=False)
class Exits:
    """Where walks left their body, in no order.

    Attributes:
      owner: index of the walk.
      triangle, u, v: of the body's boundary.
      direction: unit, outwards, after refraction.
      weight: what is left, per channel.
      rays: of all walks together.
      lost: walks that slipped through a seam, or never ended.
    """

    owner: Int32[np.ndarray, " exits"]
    triangle: Int32[np.ndarray, " exits"]
    u: Float32[np.ndarray, " exits"]
    v: Float32[np.ndarray, " exits"]
    direction: Float32[np.ndarray, "exits 3"]
    weight: Float32[np.ndarray, "exits 3"]
    rays: int
    lost: int


@dataclass(frozen=True, eq=False)
class Body:
    """A medium and what shuts it in.

    Attributes:
      geometry: the boundary, for rays.
      normals: of its triangles, outwards.
      corners: of its triangles, metres.
      offset: between a ray's origin and its surface, metres.
      extinction, albedo: of the medium and of the similar one, 1/m and per channel.
      decay: 1 / diffusion length of the similar one, 1/m.
      anisotropy, index: see `Subsurface`.
      switch: scatterings after which a walk goes through the similar medium.
      far: depth from which on it jumps, metres.
      depth: lower bounds of the squared distance from cell centres to the surface, m²; exact near it.
      low, cell: corner of that grid and edge of its cells, metres.
      bounds: of the corners, with a margin.
    """

    geometry: Geometry
    normals: Float32[np.ndarray, "triangles 3"]
    corners: Float32[np.ndarray, "triangles 3 3"]
    offset: float
    extinction: Float32[np.ndarray, "2 3"]
    albedo: Float32[np.ndarray, "2 3"]
    decay: Float32[np.ndarray, "3"]
    anisotropy: float
    index: float
    switch: int
    far: float
    depth: Float32[np.ndarray, "x y z"]
    low: Float32[np.ndarray, "3"]
    cell: float
    bounds: Float32[np.ndarray, "2 3"]

    @classmethod
    def of(
        cls, medium: Subsurface, corners: Float32[np.ndarray, "triangles 3 3"], offset: float, *, jumps: bool = True
    ) -> "Body":
        """A body of some triangles; without jumps it walks every step of the medium itself, which is what jumps are judged by.

        Args:
          medium: what fills it.
          corners: a closed surface seen from outside, metres.
          offset: see `Body`.
          jumps: False for every step, by the medium's own phase function.
        """
        corners = np.ascontiguousarray(corners, np.float32)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).astype(np.float64)
        normals = (cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)).astype(np.float32)
        extinction, albedo = 1 / np.array(medium.mean_free_path), np.array(medium.albedo)
        similar = extinction * (1 - medium.anisotropy * albedo)
        even = (1 - medium.anisotropy) * albedo / (1 - medium.anisotropy * albedo)
        decay = similar * np.array([decay_rate(share) for share in even])
        switch = int(np.ceil(np.log(_FORGOTTEN) / np.log(max(abs(medium.anisotropy), 1e-9))))
        low, high = corners.min((0, 1)), corners.max((0, 1))
        far = FAR / float(similar.min()) if jumps and even.min() >= WHITE else np.inf
        finest = max(float((high - low).max()) / _CELLS, 0.5 / float(similar.max()))
        within = low - finest, high + finest  # so that all of the body lies between centres
        depth, cell = depths(corners, *within, finest)
        bounds = np.stack([low, high]) + np.array([[-10.0], [10.0]]) * offset
        return cls(
            Geometry(corners),
            normals,
            corners,
            offset,
            np.stack([extinction, similar]).astype(np.float32),
            np.stack([albedo, even]).astype(np.float32),
            decay.astype(np.float32),
            medium.anisotropy,
            medium.index,
            switch if jumps else np.iinfo(np.int32).max,
            far,
            depth,
            within[0].astype(np.float32),
            cell,
            bounds.astype(np.float32),
        )

    def walk(
        self,
        origins: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
        weight: Float32[np.ndarray, "n 3"],
        rng: np.random.Generator,
    ) -> Exits:
        """Walks from inside until all have left or are forgotten.

        Args:
          origins, directions: inside, metres and unit.
          weight: of each, per channel.
          rng: of this call alone.
        """
        count = len(origins)
        state: tuple[Any, ...] = (
            origins.copy(),
            directions.copy(),
            weight.copy(),
            np.arange(count, dtype=np.int32),
            np.zeros(count, np.int32),
        )
        state = *state, rng.integers(0, 1 << 64, count, np.uint64)
        out = np.empty((count, 6), np.float32), np.empty((count, 2), np.float32), np.empty((count, 2), np.int32)
        triangle, u, v, reach = np.empty(count, np.int32), *np.empty((3, count), np.float32)
        bends = np.float32(self.anisotropy), np.float32(self.index), self.switch
        surface = self.normals, self.corners, np.float32(self.offset)
        grid = self.depth, self.low, np.float32(self.cell), self.bounds, np.float32(self.far)
        constants: tuple[Any, ...] = self.extinction, self.albedo, self.decay, *bends, *surface, *grid
        given: tuple[Any, ...] = *state, triangle, u, v, reach, True, *constants, 0, *out
        count, left, lost = _advance(*given)
        rays, turn = 0, 0
        while count and turn < _MOST:
            state = tuple(part[:count] for part in state)
            triangle, u, v, reach = self.geometry.first(state[0], state[1], reach[:count])
            rays, turn = rays + count, turn + 1
            given = *state, triangle, u, v, reach, False, *constants, left, *out
            count, left, gone = _advance(*given)
            lost += gone
        flat, weights, which = (part[:left] for part in out)
        at, towards = weights.T.copy(), flat[:, :3].copy()
        return Exits(which[:, 0].copy(), which[:, 1].copy(), at[0], at[1], towards, flat[:, 3:].copy(), rays, lost + count)


@compiled
def scattered_at(u: np.float32, g: np.float32) -> np.float32:
    """The cosine of an angle of scattering; see `ddprt.transport.meetings`."""
    one, two = np.float32(1), np.float32(2)
    if abs(g) < np.float32(1e-3):
        return two * u - one
    part = (one - g * g) / (one - g + two * g * u)
    return min(max((one + g * g - part * part) / (two * g), -one), one)


@compiled
def flown(u: np.float32, extinction: np.float32) -> np.float32:
    """The length of a flight, metres; see `ddprt.transport.meetings`."""
    return -np.log(np.float32(1) - u) / extinction


@compiled
def drawn(state: np.ndarray, i: int) -> np.float32:
    """The next of a walk's own uniform numbers (SplitMix64)."""
    state[i] += np.uint64(0x9E3779B97F4A7C15)
    bits = state[i]
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.float32((bits ^ (bits >> np.uint64(31))) >> np.uint64(40)) * np.float32(2**-24)


@compiled
def _free(x: np.float32, y: np.float32, z: np.float32, depth: np.ndarray, low: np.ndarray, cell: np.float32) -> np.float32:
    """A lower bound of the distance to the surface.

    The square of a distance less that of the place is a least value of linear functions, so it is nowhere less than what is
    interpolated: the squares of distances about a place, averaged trilinearly, less those of the centres from the place.
    """
    half, one = np.float32(0.5), np.float32(1)
    p, q, r = (x - low[0]) / cell - half, (y - low[1]) / cell - half, (z - low[2]) / cell - half
    i, j, k = int(p), int(q), int(r)
    if p < 0 or q < 0 or r < 0 or i + 1 >= depth.shape[0] or j + 1 >= depth.shape[1] or k + 1 >= depth.shape[2]:
        return np.float32(0)
    p, q, r = p - i, q - j, r - k
    a = (one - r) * depth[i, j, k] + r * depth[i, j, k + 1]
    b = (one - r) * depth[i, j + 1, k] + r * depth[i, j + 1, k + 1]
    c = (one - r) * depth[i + 1, j, k] + r * depth[i + 1, j, k + 1]
    d = (one - r) * depth[i + 1, j + 1, k] + r * depth[i + 1, j + 1, k + 1]
    mean = (one - p) * ((one - q) * a + q * b) + p * ((one - q) * c + q * d)
    spread = p * (one - p) + q * (one - q) + r * (one - r) + np.float32(_ROUNDING)
    return np.sqrt(max(mean - spread * cell * cell, np.float32(0)))


@compiled
def _turned(x: np.float32, y: np.float32, z: np.float32, cosine: np.float32, turn: np.float32) -> tuple:
    """A unit direction at an angle to a unit direction, turned about it by a share of the whole turn."""
    one = np.float32(1)
    sign = one if z >= 0 else -one
    a = -one / (sign + z)
    b = x * y * a
    sine = np.sqrt(max(np.float32(0), one - cosine * cosine))
    p, q = sine * np.cos(np.float32(2 * np.pi) * turn), sine * np.sin(np.float32(2 * np.pi) * turn)
    r = p * (one + sign * x * x * a) + q * b + cosine * x
    s = p * sign * b + q * (sign + y * y * a) + cosine * y
    t = -p * sign * x - q * y + cosine * z
    size = one / np.sqrt(r * r + s * s + t * t)
    return r * size, s * size, t * size


@compiled
def _advance(
    position: np.ndarray,
    direction: np.ndarray,
    weight: np.ndarray,
    owner: np.ndarray,
    order: np.ndarray,
    state: np.ndarray,
    triangle: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    reach: np.ndarray,
    fresh: bool,
    extinction: np.ndarray,
    albedo: np.ndarray,
    decay: np.ndarray,
    anisotropy: np.float32,
    index: np.float32,
    switch: int,
    normals: np.ndarray,
    corners: np.ndarray,
    offset: np.float32,
    depth: np.ndarray,
    low: np.ndarray,
    cell: np.float32,
    bounds: np.ndarray,
    far: np.float32,
    left: int,
    flat: np.ndarray,
    weights: np.ndarray,
    which: np.ndarray,
) -> tuple:
    """Takes each walk from what its ray met, if it is not fresh, to where it needs the next; keeps those that do, in order.

    Returns:
      How many go on, how many have left so far, how many were lost.
    """
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    faint, milne, least_step = np.float32(_FAINT), np.float32(EXTRAPOLATED), np.float32(_STEP) * cell
    count, lost = 0, 0
    for i in range(len(triangle)):
        px, py, pz = position[i, 0], position[i, 1], position[i, 2]
        x, y, z = direction[i, 0], direction[i, 1], direction[i, 2]
        a, b, c = weight[i, 0], weight[i, 1], weight[i, 2]
        times, met, free = order[i], not fresh, zero
        while True:
            stage = 1 if times >= switch else 0
            if met:
                t, hit = reach[i], triangle[i]
                met = False
            else:
                pick = drawn(state, i) * (a + b + c)
                channel = 0 if pick < a else (1 if pick < a + b else 2)
                t, hit = flown(drawn(state, i), extinction[stage, channel]), np.int32(-1)
                while free < t:
                    step = _free(px + free * x, py + free * y, pz + free * z, depth, low, cell)
                    if step < least_step:
                        break
                    free += step
                if t >= free:
                    position[count, 0], position[count, 1], position[count, 2] = px, py, pz
                    direction[count, 0], direction[count, 1], direction[count, 2] = x, y, z
                    weight[count, 0], weight[count, 1], weight[count, 2] = a, b, c
                    owner[count], order[count], state[count], reach[count] = owner[i], times, state[i], t
                    count += 1
                    break
            least = min(extinction[stage, 0], extinction[stage, 1], extinction[stage, 2])
            red = np.exp((least - extinction[stage, 0]) * t)
            green = np.exp((least - extinction[stage, 1]) * t)
            blue = np.exp((least - extinction[stage, 2]) * t)
            if hit < 0:
                red, green, blue = red * extinction[stage, 0], green * extinction[stage, 1], blue * extinction[stage, 2]
            share = (a + b + c) / (a * red + b * green + c * blue)
            a, b, c = a * red * share, b * green * share, c * blue * share
            if hit >= 0:
                m, n, o = normals[hit, 0], normals[hit, 1], normals[hit, 2]
                cosine = x * m + y * n + z * o
                if not cosine > zero:
                    lost += 1
                    break
                outer, reflected = cosine, zero
                if index > one:
                    squared = one - index * index * (one - cosine * cosine)
                    outer, reflected = np.sqrt(max(squared, zero)), one
                    if squared > zero:
                        across = (outer - index * cosine) / (outer + index * cosine)
                        along = (index * outer - cosine) / (index * outer + cosine)
                        reflected = (across * across + along * along) / two
                if drawn(state, i) >= reflected:
                    which[left, 0], which[left, 1] = owner[i], hit
                    weights[left, 0], weights[left, 1] = u[i], v[i]
                    bend = outer - index * cosine
                    flat[left, 0], flat[left, 1] = index * x + bend * m, index * y + bend * n
                    flat[left, 2] = index * z + bend * o
                    flat[left, 3], flat[left, 4], flat[left, 5] = a, b, c
                    left += 1
                    break
                p, q = u[i], v[i]
                r = one - p - q
                px = r * corners[hit, 0, 0] + p * corners[hit, 1, 0] + q * corners[hit, 2, 0] - offset * m
                py = r * corners[hit, 0, 1] + p * corners[hit, 1, 1] + q * corners[hit, 2, 1] - offset * n
                pz = r * corners[hit, 0, 2] + p * corners[hit, 1, 2] + q * corners[hit, 2, 2] - offset * o
                x, y, z = x - two * cosine * m, y - two * cosine * n, z - two * cosine * o
                free = zero
                continue
            a, b, c = a * albedo[stage, 0], b * albedo[stage, 1], c * albedo[stage, 2]
            px, py, pz = px + t * x, py + t * y, pz + t * z
            outside = px < bounds[0, 0] or py < bounds[0, 1] or pz < bounds[0, 2]
            if outside or px > bounds[1, 0] or py > bounds[1, 1] or pz > bounds[1, 2]:
                lost += 1
                break
            total = a + b + c
            if total < faint:
                if drawn(state, i) * faint >= total:
                    break
                share = faint / total
                a, b, c = a * share, b * share, c * share
            cosine = scattered_at(drawn(state, i), zero if stage else anisotropy)
            x, y, z = _turned(x, y, z, cosine, drawn(state, i))
            times += 1
            free = _free(px, py, pz, depth, low, cell)
            if free > far and times >= switch:
                # Evenly anywhere on the sphere, and on from there as light leaves a thick wall.
                x, y, z = _turned(zero, zero, one, two * drawn(state, i) - one, drawn(state, i))
                px, py, pz = px + free * x, py + free * y, pz + free * z
                widest = max(one / extinction[1, 0], one / extinction[1, 1], one / extinction[1, 2])
                mean = np.float32(LEANING[0]) + np.float32(LEANING[1]) * widest / free
                power = (one - mean) / mean  # of a density mu^k with that mean: k + 1 = mean / (1 - mean)
                x, y, z = _turned(x, y, z, drawn(state, i) ** power, drawn(state, i))
                a *= _survival(decay[0] * (free + milne / extinction[1, 0]))
                b *= _survival(decay[1] * (free + milne / extinction[1, 1]))
                c *= _survival(decay[2] * (free + milne / extinction[1, 2]))
                free = _free(px, py, pz, depth, low, cell)
                if not a + b + c > zero:
                    break
    return count, left, lost


@compiled
def _survival(x: np.float32) -> np.float32:
    if x < np.float32(1e-3):
        return np.float32(1)
    return x / np.sinh(x) if x < np.float32(80) else np.float32(0)
