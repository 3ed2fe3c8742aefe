"""The public yardstick: light at any points, by the unbiased reference integrator and nothing else."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ddprt.axes import Float64
from ddprt.errors import UserError
from ddprt.lights import Light, Lighting, parse_lighting
from ddprt.scene.checks import FARTHEST
from ddprt.scene.mesh import Scene
from ddprt.transport.embree import Tracer
from ddprt.transport.glossiness import glossy
from ddprt.transport.reference import on_points, trace_reference


def irradiance(
    scene: Scene,
    lighting: Lighting | Light | Sequence[dict[str, Any]] | dict[str, Any],
    positions: Any,
    normals: Any,
    *,
    samples: int = 1024,
    seed: int = 0,
    return_variance: bool = False,
) -> tuple[Float64[np.ndarray, "points 3"], ...]:
    """Direct and indirect irradiance at points, before albedo.

    Args:
      scene: from `ddprt.load_scene`.
      lighting: a light, several, or their JSON records.
      positions: (points, 3) world space, metres.
      normals: (points, 3); they are normalised.
      samples: independent paths per point.
      seed: of the paths.
      return_variance: also return the variances of both estimates, (W/m²)²; needs at least 2 samples.
    Returns:
      direct, indirect (points, 3) in W/m²; with `return_variance` also their variances.
    Raises:
      UserError: shapes that do not match, values that are not finite, or too few samples.
    """
    place, facing = np.asarray(positions, np.float64), np.asarray(normals, np.float64)
    if place.ndim != 2 or place.shape[1] != 3 or facing.shape != place.shape or len(place) == 0:
        raise UserError(
            f"positions and normals: got shapes {place.shape} and {facing.shape}, expected (points, 3) for both, points > 0"
        )
    if not np.isfinite([place, facing]).all() or not facing.any(1).all():
        raise UserError("positions and normals: got a number that is not finite or a normal of length 0")
    if np.abs(place).max() > FARTHEST:
        raise UserError(f"positions: got {np.abs(place).max():.3g} m, expected at most {FARTHEST:g}; mind the unit")
    facing = facing / np.abs(facing).max(1, keepdims=True)  # squares of the rest neither overflow nor vanish
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    if samples < 1 + return_variance:
        raise UserError(f"samples: got {samples}, expected at least {1 + return_variance}")
    parsed = parse_lighting(lighting)
    tracer = Tracer.of(scene)
    # A probe may float in free air, where even a convex scene sends light to it: only black scenes end at direct light, if
    # they do not gloss, and no fog is about.
    dull = all(material.brightest == 0 for material in scene.materials) and not any(glossy(scene))
    black = dull and not tracer.medium
    start = on_points(tracer, place, facing)
    estimate = trace_reference(tracer, scene, parsed, start, len(place), samples, seed=seed, bounces=0 if black else -1)
    if return_variance:
        return estimate.direct, estimate.indirect, estimate.direct_variance, estimate.indirect_variance
    return estimate.direct, estimate.indirect
