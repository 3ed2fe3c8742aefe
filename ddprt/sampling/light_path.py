"""A path of small steps for one lighting, so that relighting can be watched for flicker."""

import numpy as np

from ddprt import seeds, warp
from ddprt.axes import Float64
from ddprt.lights import Light, Lighting, lighting_json, parse_lighting
from ddprt.sampling.lightings import Clearance

SHARE = 0.9
"""Of the free radius about a lamp: how far it goes to either side."""
TURN_DEG = 5.0
"""How far a distant light turns to either side."""


def light_path(lighting: Lighting, clearance: Clearance, frames: int, *, seed: int = 0) -> tuple[Lighting, ...]:
    """Frames of a lighting whose lights all move evenly, from one end of their way to the other.

    A lamp goes along a straight line through where it stands and keeps all of itself inside the free ball about it, so that it
    never enters a solid. A lamp that has no room stays. Distant lights turn about an axis across their direction.

    Args:
      lighting: in the middle of the path.
      clearance: free radius about positions, such as that of a `Tracer`.
      frames: how many, at least 2; evenly spaced, the first and the last at the ends.
      seed: of the run; it decides where to each light moves.
    Raises:
      ValueError: fewer than 2 frames.
    """
    if frames < 2:
        raise ValueError(f"frames: got {frames}, expected at least 2")
    towards = [
        warp.sample_sphere(seeds.stream(seed, "light path", index).random((1, 2)))[0].astype(np.float64)
        for index in range(len(lighting))
    ]
    room = [_room(light, clearance) for light in lighting]
    return tuple(
        tuple(_moved(light, way, free, step) for light, way, free in zip(lighting, towards, room, strict=True))
        for step in np.linspace(-1, 1, frames).tolist()
    )


def _room(light: Light, clearance: Clearance) -> float:
    """Metres that a lamp may go to either side; 0 for distant lights."""
    place = light.anchor()
    return 0.0 if place is None else max(0.0, SHARE * float(clearance(place[None])[0] - light.reach()))


def _moved(light: Light, towards: Float64[np.ndarray, "3"], room: float, step: float) -> Light:
    """A light at a step between -1 and 1 of its way."""
    if light.anchor() is not None:
        return light.translated(step * room * towards)
    record = lighting_json((light,))[0]
    if "rotation_deg" in record:
        return parse_lighting([{**record, "rotation_deg": record["rotation_deg"] + step * TURN_DEG}])[0]
    direction = np.array(record["direction"])
    across = towards - (towards @ direction) * direction
    across /= np.linalg.norm(across)
    angle = np.radians(step * TURN_DEG)
    turned = np.cos(angle) * direction + np.sin(angle) * across
    return parse_lighting([{**record, "direction": turned.tolist()}])[0]
