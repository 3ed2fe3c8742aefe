"""Random walks of light through a homogeneous medium that fills a closed body, from the surface to the surface.

All walks of a call take their steps together: compiled code draws how far each flies, Embree tells whether the surface comes
first, compiled code scatters, refracts or ends them. One walk serves all channels: for each flight a channel is drawn in
proportion to the walk's weights, and each weight is multiplied by what its own channel's chance would have been over that of
the draw (the balance heuristic). So no weight leaves its bounds: their sum never grows.

A thick body would keep walks for ever. Two things shorten them: once a direction is forgotten (the anisotropy to the power of
the scatterings is below `_FORGOTTEN`) the medium becomes the similar one that scatters evenly, sigma_s' = (1 - g) sigma_s; and
where the surface is further than `FAR` of its free paths, a walk goes at once to a sphere about it that just fits, where it
comes first with equal odds everywhere: a step of the walk on spheres for diffusion (Muller 1956), as few as log(depth). What
it lost on the way, x / sinh x with x = (radius + 0.71 free paths) / the diffusion length, is exact far from start and end
(see `weight_of_jump`). Light weaker than `_FAINT` plays roulette.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ddprt.axes import Float, Float32, Float64, Int32
from ddprt.compiled import compiled
from ddprt.scene.material import Subsurface
from ddprt.transport.packets import Geometry

FAR = 8.0
"""Free paths between a walk and the surface from which on it jumps."""

EXTRAPOLATED = 0.7104
"""Free paths by which diffusion's boundary lies outside: Milne's constant."""

_FORGOTTEN = 0.05
_FAINT = 0.5  # of a sum of three weights
_CELLS = 40  # of the grid of depths, along the body's longest side
_MOST = 200_000  # steps of a walk; only a white body in which light is caught reaches them


@dataclass(frozen=True, eq=False)
class Exits:
    """Where walks left their body, in no order.

    Attributes:
      owner: index of the walk.
      triangle, u, v: of the body's boundary.
      direction: unit, outwards, after refraction.
      weight: what is left, per channel.
      steps: flights of all walks together, each a ray.
      lost: walks that slipped through a seam, or never ended.
    """

    owner: Int32[np.ndarray, " exits"]
    triangle: Int32[np.ndarray, " exits"]
    u: Float32[np.ndarray, " exits"]
    v: Float32[np.ndarray, " exits"]
    direction: Float32[np.ndarray, "exits 3"]
    weight: Float32[np.ndarray, "exits 3"]
    steps: int
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
      depth: lower bounds of the distance from cell centres to the surface, metres; a single 0 where no walk ever jumps.
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
        g = abs(medium.anisotropy)
        switch = 0 if g == 0 else int(np.ceil(np.log(_FORGOTTEN) / np.log(g)))
        low, high = corners.min((0, 1)), corners.max((0, 1))
        reach = FAR / float(similar.min())
        if jumps and (high - low).min() > 2 * reach:
            depth, cell = depths(corners, low, high)
        else:
            depth, cell = np.zeros((1, 1, 1), np.float32), 1.0
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
            depth,
            low.astype(np.float32),
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
        state = origins.copy(), directions.copy(), weight.copy()
        owner, order = np.arange(count, dtype=np.int32), np.zeros(count, np.int32)
        out = np.empty((count, 6), np.float32), np.empty((count, 2), np.float32), np.empty((count, 2), np.int32)
        numbers_each, left, lost, steps, turn = 8 if self.depth.size > 1 else 5, 0, 0, 0, 0
        far = np.float32(FAR / self.extinction[1].min())
        bends = np.float32(self.anisotropy), np.float32(self.index), self.switch
        surface = self.normals, self.corners, np.float32(self.offset)
        grid = self.depth, self.low, np.float32(self.cell), self.bounds, far
        constants: tuple[Any, ...] = self.extinction, self.albedo, self.decay, *bends, *surface, *grid
        while count and turn < _MOST:
            parts = tuple(part[:count] for part in (*state, owner, order))
            position, direction, now, own, times = parts
            numbers = rng.random((count, numbers_each), np.float32)
            reach = np.empty(count, np.float32)
            _fly(now, times, self.extinction, self.switch, numbers, reach)
            triangle, u, v, reach = self.geometry.first(position, direction, reach)
            steps, turn = steps + count, turn + 1
            hits: tuple[Any, ...] = triangle, u, v, reach, numbers
            count, left, gone = _step(position, direction, now, own, times, *hits, *constants, left, *out)
            lost += gone
        flat, weights, which = (part[:left] for part in out)
        return Exits(
            which[:, 0].copy(), which[:, 1].copy(), weights[:, 0].copy(), weights[:, 1].copy(),
            flat[:, :3].copy(), flat[:, 3:].copy(), steps, lost + count,
        )  # fmt: skip


def decay_rate(albedo: float) -> float:
    """Diffusion length's inverse in free paths, of a medium that scatters evenly: the root of albedo atanh(k) / k = 1."""
    if albedo >= 1:
        return 0.0
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if albedo * np.arctanh(middle) < middle else (low, middle)
    return low


def weight_of_jump(radius: float, extinction: float, albedo: float) -> float:
    """What is left of light that starts evenly in a medium of even scattering when it first comes so far, metres."""
    x = decay_rate(albedo) * (radius * extinction + EXTRAPOLATED)
    return float(x / np.sinh(x)) if x > 0 else 1.0


def depths(
    corners: Float32[np.ndarray, "triangles 3 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> tuple[Float32[np.ndarray, "x y z"], float]:
    """Lower bounds of the distance from the centres of cubic cells to a surface, and the edge of the cells, metres.

    Points are spread over the surface so that none of it is further from one than an edge over the root of three.
    """
    from scipy.spatial import cKDTree

    cell = float((high - low).max()) / _CELLS
    size = np.ceil((high - low) / cell).astype(int) + 1
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    cuts, spread = np.maximum(np.ceil(longest / cell), 1).astype(int), []
    for number in np.unique(cuts):
        i, j = np.mgrid[: number + 1, : number + 1]
        weights = np.stack([i, j, number - i - j], -1)[i + j <= number] / number
        spread.append(np.einsum("kc,tcd->tkd", weights, corners[cuts == number]).reshape(-1, 3))
    centres = np.stack(np.meshgrid(*(np.arange(count) + 0.5 for count in size), indexing="ij"), -1) * cell + low
    distance, _ = cKDTree(np.concatenate(spread)).query(centres.reshape(-1, 3))
    step = float((longest / cuts).max()) / 3**0.5
    return np.maximum(distance - step, 0).reshape(size).astype(np.float32), cell


def sample_henyey(u: Float64[np.ndarray, " n"], anisotropy: float) -> Float64[np.ndarray, " n"]:
    """Cosines of the angle of scattering, as walks draw them."""
    return np.array([_henyey(np.float32(one), np.float32(anisotropy)) for one in u], np.float64)


def pdf_henyey(cosine: Float[np.ndarray, " n"], anisotropy: float) -> Float[np.ndarray, " n"]:
    """Per steradian. Reference: Henyey and Greenstein, "Diffuse Radiation in the Galaxy", 1941."""
    g = anisotropy
    return (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def invert_henyey(cosine: Float[np.ndarray, " n"], anisotropy: float) -> Float[np.ndarray, " n"]:
    """The uniform numbers that give these cosines."""
    g = anisotropy
    if abs(g) < 1e-3:
        return (1 + cosine) / 2
    return ((1 - g * g) / np.sqrt(1 + g * g - 2 * g * cosine) - 1 + g) / (2 * g)


@compiled
def _henyey(u: np.float32, g: np.float32) -> np.float32:
    one, two = np.float32(1), np.float32(2)
    if abs(g) < np.float32(1e-3):
        return two * u - one
    part = (one - g * g) / (one - g + two * g * u)
    return min(max((one + g * g - part * part) / (two * g), -one), one)


@compiled
def _fly(
    weight: np.ndarray, order: np.ndarray, extinction: np.ndarray, switch: int, numbers: np.ndarray, reach: np.ndarray
) -> None:
    """How far each walk would fly: by the chance of a channel that is drawn by weight."""
    for i in range(len(reach)):
        stage = 1 if order[i] >= switch else 0
        pick = numbers[i, 0] * (weight[i, 0] + weight[i, 1] + weight[i, 2])
        channel = 0 if pick < weight[i, 0] else (1 if pick < weight[i, 0] + weight[i, 1] else 2)
        reach[i] = -np.log(np.float32(1) - numbers[i, 1]) / extinction[stage, channel]


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
def _step(
    position: np.ndarray, direction: np.ndarray, weight: np.ndarray, owner: np.ndarray, order: np.ndarray,
    triangle: np.ndarray, u: np.ndarray, v: np.ndarray, reach: np.ndarray, numbers: np.ndarray,
    extinction: np.ndarray, albedo: np.ndarray, decay: np.ndarray, anisotropy: np.float32, index: np.float32, switch: int,
    normals: np.ndarray, corners: np.ndarray, offset: np.float32, depth: np.ndarray, low: np.ndarray, cell: np.float32,
    bounds: np.ndarray, far: np.float32, left: int, flat: np.ndarray, weights: np.ndarray, which: np.ndarray,
) -> tuple:  # fmt: skip
    """Scatters each walk, or lets it out, or reflects it; keeps those that go on, in order.

    Returns:
      How many go on, how many have left so far, how many were lost.
    """
    zero, one = np.float32(0), np.float32(1)
    count, lost, jumping = 0, 0, depth.size > 1
    for i in range(len(reach)):
        stage = 1 if order[i] >= switch else 0
        t, hit = reach[i], triangle[i]
        x, y, z = direction[i, 0], direction[i, 1], direction[i, 2]
        least = min(extinction[stage, 0], extinction[stage, 1], extinction[stage, 2])
        red = np.exp((least - extinction[stage, 0]) * t)
        green = np.exp((least - extinction[stage, 1]) * t)
        blue = np.exp((least - extinction[stage, 2]) * t)
        if hit < 0:
            red, green, blue = red * extinction[stage, 0], green * extinction[stage, 1], blue * extinction[stage, 2]
        a, b, c = weight[i, 0], weight[i, 1], weight[i, 2]
        share = (a + b + c) / (a * red + b * green + c * blue)
        a, b, c = a * red * share, b * green * share, c * blue * share
        if hit >= 0:
            m, n, o = normals[hit, 0], normals[hit, 1], normals[hit, 2]
            cosine = x * m + y * n + z * o
            if not cosine > zero:
                lost += 1
                continue
            outer, reflected = cosine, zero
            if index > one:
                squared = one - index * index * (one - cosine * cosine)
                outer, reflected = np.sqrt(max(squared, zero)), one
                if squared > zero:
                    across = (outer - index * cosine) / (outer + index * cosine)
                    along = (index * outer - cosine) / (index * outer + cosine)
                    reflected = (across * across + along * along) / np.float32(2)
            if numbers[i, 2] >= reflected:
                which[left, 0], which[left, 1] = owner[i], hit
                weights[left, 0], weights[left, 1] = u[i], v[i]
                bend = outer - index * cosine
                flat[left, 0], flat[left, 1], flat[left, 2] = index * x + bend * m, index * y + bend * n, index * z + bend * o
                flat[left, 3], flat[left, 4], flat[left, 5] = a, b, c
                left += 1
                continue
            for axis in range(3):
                first = corners[hit, 0, axis]
                place = first + u[i] * (corners[hit, 1, axis] - first) + v[i] * (corners[hit, 2, axis] - first)
                position[count, axis] = place - offset * normals[hit, axis]
            direction[count, 0], direction[count, 1] = x - 2 * cosine * m, y - 2 * cosine * n
            direction[count, 2] = z - 2 * cosine * o
            order[count] = order[i]
        else:
            a, b, c = a * albedo[stage, 0], b * albedo[stage, 1], c * albedo[stage, 2]
            px, py, pz = position[i, 0] + t * x, position[i, 1] + t * y, position[i, 2] + t * z
            outside = px < bounds[0, 0] or py < bounds[0, 1] or pz < bounds[0, 2]
            if outside or px > bounds[1, 0] or py > bounds[1, 1] or pz > bounds[1, 2]:
                lost += 1
                continue
            total = a + b + c
            if total < np.float32(_FAINT):
                if numbers[i, 4] * np.float32(_FAINT) >= total:
                    continue
                share = np.float32(_FAINT) / total
                a, b, c = a * share, b * share, c * share
            g = zero if stage else anisotropy
            x, y, z = _turned(x, y, z, _henyey(numbers[i, 2], g), numbers[i, 3])
            if jumping and order[i] + 1 >= switch:
                k, m_, n_ = int((px - low[0]) / cell), int((py - low[1]) / cell), int((pz - low[2]) / cell)
                k, m_, n_ = (
                    min(max(k, 0), depth.shape[0] - 1),
                    min(max(m_, 0), depth.shape[1] - 1),
                    min(max(n_, 0), depth.shape[2] - 1),
                )
                half = np.float32(0.5)
                dx, dy = px - low[0] - (k + half) * cell, py - low[1] - (m_ + half) * cell
                dz = pz - low[2] - (n_ + half) * cell
                free = depth[k, m_, n_] - np.sqrt(dx * dx + dy * dy + dz * dz)
                if free > far:
                    # Evenly anywhere on the sphere, and on from there as Milne's light leaves a thick wall: mu (mu + 0.71).
                    x, y, z = _turned(zero, zero, one, np.float32(2) * numbers[i, 2] - one, numbers[i, 3])
                    px, py, pz = px + free * x, py + free * y, pz + free * z
                    some = np.sqrt(numbers[i, 5])
                    if numbers[i, 6] < np.float32(1 / 3 / (1 / 3 + EXTRAPOLATED / 2)):
                        some = numbers[i, 5] ** np.float32(1 / 3)
                    x, y, z = _turned(x, y, z, some, numbers[i, 7])
                    a *= _survival(decay[0] * (free + np.float32(EXTRAPOLATED) / extinction[1, 0]))
                    b *= _survival(decay[1] * (free + np.float32(EXTRAPOLATED) / extinction[1, 1]))
                    c *= _survival(decay[2] * (free + np.float32(EXTRAPOLATED) / extinction[1, 2]))
                    if not a + b + c > zero:
                        continue
            position[count, 0], position[count, 1], position[count, 2] = px, py, pz
            direction[count, 0], direction[count, 1], direction[count, 2] = x, y, z
            order[count] = min(order[i] + 1, 1 << 30)
        weight[count, 0], weight[count, 1], weight[count, 2] = a, b, c
        owner[count] = owner[i]
        count += 1
    return count, left, lost


@compiled
def _survival(x: np.float32) -> np.float32:
    if x < np.float32(1e-3):
        return np.float32(1)
    return x / np.sinh(x) if x < np.float32(80) else np.float32(0)
