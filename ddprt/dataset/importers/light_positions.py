"""Photographs under known lights: .lp files, as reflectance transformation imaging writes them, and a white ball.

An .lp file begins with a count; each line after it has the name of a photograph and a direction towards its light (x to the
right, y up, z towards the camera), of any length. What an engine measures of such a light has to come from the light alone: a
white ball stands beside the object, and its irradiance is the measurement. It is a body that casts its shadow on itself
alone, so the measured values of any light of ddprt are what `Model.measure` finds on it.
"""

from pathlib import Path

import numpy as np

from ddprt import seeds
from ddprt.axes import Float64
from ddprt.errors import UserError
from ddprt.lights import DirectionalLight, Lighting
from ddprt.sampling.points import Samples, eliminate
from ddprt.scene.shapes import icosphere

_DENSITY = 5
_SUBDIVISIONS = 3


def read_lp(path: Path) -> list[tuple[Path, Lighting]]:
    """Photographs and their lights, of irradiance 1 W/m² each.

    Raises:
      UserError: missing, cut short, a line that is none, or a photograph that is not there or there twice.
    """
    try:
        text = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: got {error}, expected a readable .lp file; check the path") from None
    (_, first), *lines = [(number, line.strip()) for number, line in enumerate(text, 1) if line.strip()] or [(1, "")]
    if not first.isdigit():
        raise UserError(f'{path}: got "{first[:40]}" first, expected the number of photographs; mend the file')
    if int(first) != len(lines):
        raise UserError(f"{path}: got {len(lines)} lines for {first} photographs, expected as many; mend the file")
    found: list[tuple[Path, Lighting]] = []
    for number, line in lines:
        name, *words = line.rsplit(None, 3)
        try:
            x, y, z = (float(word) for word in words)
            if not 0 < x * x + y * y + z * z < np.inf:
                raise ValueError
        except ValueError:
            raise UserError(
                f'{path}: got "{line[:60]}" in line {number}, expected a name and a direction of three numbers; mend it'
            ) from None
        photo = path.parent / name.replace("\\", "/")
        if not photo.is_file():
            raise UserError(f"{path}: got {name} in line {number}, which is not there, expected it at {photo}; copy it there")
        if any(photo == known for known, _ in found):
            raise UserError(f"{path}: got {name} again in line {number}, expected each photograph once; mend the file")
        light = DirectionalLight(direction=(-x, -y, -z), irradiance=(1.0, 1.0, 1.0))
        found.append((photo, (light,)))
    return found


def white_ball(count: int, seed: int) -> tuple[Samples, Float64[np.ndarray, "triangles 3 3"]]:
    """Points evenly spread over a white ball of 1 m about the origin, and the triangles that cast its shadow.

    Args:
      count: points.
      seed: of the run.
    """
    rng = seeds.stream(seed, "white ball")
    tried = np.arange(_DENSITY * count) + rng.random(_DENSITY * count)
    height, turn = 1 - 2 * tried / (_DENSITY * count), np.pi * (3 - np.sqrt(5)) * tried
    ring = np.sqrt(np.maximum(1 - height**2, 0))
    places = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], 1)
    normal = places[eliminate(places, count, 4 * np.pi)]
    vertices, triangles = icosphere(_SUBDIVISIONS)
    samples = Samples(normal.copy(), normal, np.ones((count, 3)), float(np.sqrt(4 * np.pi / count)))
    return samples, np.ascontiguousarray(vertices[triangles], np.float64)
