"""Lamps and skies as an eye sees them: what reaches it without touching anything."""

from collections.abc import Sequence

import numpy as np

from ddprt.axes import Float32, Float64
from ddprt.lights import EnvironmentLight, Light, Lighting, MeshLight, RectLight, SphereLight
from ddprt.report.view import Camera, first_fronts
from ddprt.transport.embree import Tracer


def seen_lamps(
    lighting: Lighting,
    eye: Float64[np.ndarray, "3"],
    directions: Float32[np.ndarray, "rays 3"],
    ends: Float64[np.ndarray, " rays"],
) -> Float64[np.ndarray, "rays 3"]:
    """Radiance of lamps with size, W/(m² sr): of their fronts, and on top of what is behind, as lamps hide nothing.

    Args:
      lighting: what shines.
      eye: metres.
      directions: unit.
      ends: metres that each ray goes; what is farther is not seen. Infinity where nothing stops it, and a sky shows.
    """
    found = np.zeros((len(directions), 3))
    for light in lighting:
        if isinstance(light, EnvironmentLight):
            past = np.isinf(ends)
            found[past] += sky_radiance(light, directions[past].astype(np.float64))
        elif isinstance(light, RectLight | MeshLight | SphereLight):
            found[_distance(light, eye, directions) < ends] += light.radiance
    return found


def sky_radiance(light: EnvironmentLight, directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """What a sky shows in unit directions, W/(m² sr)."""
    from ddprt.lights.sky import load_sky

    image = load_sky(light.image).radiance
    height, width = image.shape[:2]
    x, y, z = into_picture(light, directions).T
    row = np.minimum((np.arccos(np.clip(y, -1, 1)) / np.pi * height).astype(int), height - 1)
    column = np.minimum(((0.5 + np.arctan2(x, -z) / (2 * np.pi)) % 1 * width).astype(int), width - 1)
    return light.scale * image[row, column].astype(np.float64)


def into_picture(light: EnvironmentLight, directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Directions in the frame of a sky's own picture, before it is turned."""
    turn = np.radians(light.rotation_deg)
    x, y, z = directions.T
    return np.stack([x * np.cos(turn) - z * np.sin(turn), y, x * np.sin(turn) + z * np.cos(turn)], 1)


def _distance(
    light: RectLight | MeshLight | SphereLight, eye: Float64[np.ndarray, "3"], directions: Float32[np.ndarray, "rays 3"]
) -> Float64[np.ndarray, " rays"]:
    """Metres to the front of a lamp; infinity where a ray misses it."""
    found = np.full(len(directions), np.inf)
    if isinstance(light, SphereLight):
        away = np.asarray(light.center) - eye
        along = directions.astype(np.float64) @ away
        under = along**2 - (away @ away - light.radius**2)
        met = (under > 0) & (along > np.sqrt(np.maximum(under, 0)))
        found[met] = along[met] - np.sqrt(under[met])
        return found
    tracer = Tracer(_corners(light))
    hits = first_fronts(tracer, eye, directions)
    met = np.flatnonzero(hits.triangle >= 0)
    place = tracer.on_triangle(hits.triangle[met], hits.u[met], hits.v[met]) + tracer.centre
    found[met] = np.linalg.norm(place - eye, axis=1)
    return found


def _corners(light: RectLight | MeshLight) -> Float64[np.ndarray, "triangles 3 3"]:
    """Triangles of a lamp, metres."""
    if isinstance(light, MeshLight):
        return light.shape.corners + np.asarray(light.position)
    middle, u, v = (np.asarray(part) for part in (light.center, light.half_u, light.half_v))
    a, b, c, d = middle - u - v, middle + u - v, middle + u + v, middle - u + v
    return np.array([[a, b, c], [a, c, d]])


def has_size(light: Light) -> bool:
    """Whether an eye sees the lamp itself."""
    return isinstance(light, EnvironmentLight | RectLight | MeshLight | SphereLight)


def on_picture(camera: Camera, lamps: Sequence[Float64[np.ndarray, "3"] | None]) -> list[tuple[float, float]]:
    """Where lamps stand in a camera's picture, percent from left and top; those that are not in it are left out."""
    placed = [lamp for lamp in lamps if lamp is not None]
    if not placed:
        return []
    places = camera.project(np.array(placed, np.float64))
    return [(float(100 * x), float(100 * y)) for x, y in places if 0 <= x <= 1 and 0 <= y <= 1]
