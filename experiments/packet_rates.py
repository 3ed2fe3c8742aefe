"""What does a ray cost, handed to Embree one by one by embreex or in packets?

Question: nanoseconds of closest hits and shadow rays, for packets of 4, 8 and 16 rays.
Command:  python experiments/packet_rates.py [SCENE ...]; cornell and statue unless given
Answer:   docs/baking.md

All rays are those of a bake at 64²; each way takes the same ones in turn, and the best of seven rounds on one thread counts.
Those from anywhere to anywhere are random. Answers are compared with embreex's; bits that differ are counted.
"""

import ctypes
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from bake_costs import _recorded
from bake_stage import stage

from ddprt import seeds
from ddprt.lights import EnvironmentLight, PointLight, parse_lighting
from ddprt.transport import packets
from ddprt.transport.direct import Texels
from ddprt.transport.embree import Tracer
from ddprt.transport.gather import Receivers, seen_from
from ddprt.transport.operator import Operator

Batches = list[tuple[np.ndarray, ...]]
ROUNDS = 7


class OneByOne:
    """Triangles as embreex traces them."""

    def __init__(self, corners: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = EmbreeScene()
        self.mesh = TriangleMesh(self.scene, corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3))

    def first(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
        found = self.scene.run(origins, directions, query="INTERSECT", output=True)
        return found["primID"], found["u"], found["v"], found["tfar"]

    def unoccluded(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> np.ndarray:
        return self.scene.run(origins, directions, dists=reach, query="OCCLUDED")


def of_width(width: int, corners: np.ndarray) -> packets.Geometry:
    usual = packets.embree()
    where = [
        ctypes.cast(getattr(usual.calls, f"rtc{name}{width}"), ctypes.c_void_p).value for name in ("Intersect", "Occluded")
    ]
    geometry = packets.Geometry(corners)
    geometry._embree = replace(usual, width=width, intersect=where[0], occluded=where[1])
    return geometry


def rays(name: str) -> tuple[Tracer, dict[str, tuple[str, Batches]]]:
    """Some of a bake's rays, by what they are for, with the query that they ask."""
    on = stage(name, 64, 1, 1)
    tracer, atlas = on.tracer, on.atlas
    operator, receivers = Operator.of(tracer, atlas), Receivers.texels(atlas, 64, 0, "rate")
    texels = Texels.of(tracer, atlas, 16, seeds.stream(0, "texel positions"))
    low, high = on.scene.bounds
    lamp = PointLight(position=tuple(0.3 * low + 0.7 * high + 0.01), intensity=(1.0, 1.0, 1.0))

    def gather(tile: slice) -> None:
        for _ in seen_from(tracer, receivers, tile, operator.landing):
            pass

    def shade(light: Any) -> None:
        texels.irradiance(parse_lighting(light), seeds.stream(0, "direct"))

    rng = np.random.default_rng(0)
    origins = rng.uniform(-0.6, 0.6, (20, 1 << 14, 3)) * tracer.radius
    directions = rng.normal(size=origins.shape)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    return tracer, {
        "gather": ("first", _recorded(tracer, "first", gather, list(receivers.tiles()))),
        "anywhere": ("first", list(zip(origins.astype(np.float32), directions.astype(np.float32), strict=True))),
        "to the sky": ("unoccluded", _recorded(tracer, "unoccluded", shade, [EnvironmentLight(image="sun-sky")])),
        "to a lamp": ("unoccluded", _recorded(tracer, "unoccluded", shade, [lamp])),
    }


def nanoseconds(ask: Callable[..., Any], batches: Batches) -> float:
    start = time.thread_time()
    for batch in batches:
        ask(*batch)
    return 1e9 * (time.thread_time() - start) / sum(len(batch[0]) for batch in batches)


def bits(query: str, answers: Any) -> bytes:
    return (
        (answers != 0).tobytes()
        if query == "unoccluded"
        else b"".join(np.where(answers[0] < 0, 0, x).tobytes() for x in answers)
    )


def main(*names: str) -> None:
    for name in names or ("cornell", "statue"):
        tracer, kinds = rays(name)
        ways = {"embreex": OneByOne(tracer.corners), **{str(width): of_width(width, tracer.corners) for width in (4, 8, 16)}}
        print(f"{name}, {len(tracer.corners)} triangles; ns a ray, and batches with other bits than embreex's")
        for kind, (query, batches) in kinds.items():
            best = dict.fromkeys(ways, np.inf)
            for _ in range(ROUNDS):
                for way, geometry in ways.items():
                    best[way] = min(best[way], nanoseconds(getattr(geometry, query), batches))
            differ = sum(
                bits(query, getattr(geometry, query)(*batch)) != bits(query, getattr(ways["embreex"], query)(*batch))
                for geometry in ways.values()
                for batch in batches
            )
            print(
                f"{kind:12s}" + "".join(f"{way:>10s}: {seconds:5.1f}" for way, seconds in best.items()) + f"  {differ}",
                flush=True,
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
