"""Light that went through a body against Mitsuba's `volpath`: z-scores with both variances.

Under a sky light needs no shadow rays through the boundary, so that both sides follow the same paths, and nothing is averaged:
what a walk of ours is worth is the sky where it came out.
"""

from typing import Any

import numpy as np
import pytest
from test_mitsuba import GREEN, POINTS, mi, stepped, z_scores

from ddprt import warp
from ddprt.scene.library import build
from ddprt.scene.material import Subsurface
from ddprt.transport.embree import Tracer
from ddprt.transport.random_walk import Body
from ddprt.transport.refraction import entered

pytestmark = pytest.mark.slow

SAMPLES = 512
"""Walks per point on both sides."""

SKY = np.zeros((8, 16, 3), np.float32) + np.array([0.2, 0.3, 0.4], np.float32)
SKY[1:4, 2:6] = (6, 5, 4)

MEDIA = {
    "index-matched": Subsurface((0.99, 0.95, 0.8), (0.06, 0.04, 0.03), 0.0, 1.0),
    "forwards": Subsurface((0.99, 0.97, 0.8), (0.06, 0.02, 0.03), 0.7, 1.0),
    "refractive": Subsurface((0.99, 0.97, 0.8), (0.06, 0.04, 0.03), 0.3, 1.4),
}


def body_alone() -> np.ndarray:
    """The statue's triangles, half a metre high, without the ground: convex it is not, so light goes in again."""
    scene = build("statue", height=0.5, subdivisions=3)
    return np.ascontiguousarray(scene.corners[scene.material == 0] - [0, 0.25, 0], np.float64)


def sky(directions: np.ndarray) -> np.ndarray:
    """Radiance from there: pixels, not interpolated; physics.md's panorama."""
    u = np.mod(0.5 + np.arctan2(directions[:, 0], -directions[:, 2]) / (2 * np.pi), 1)
    v = np.arccos(np.clip(directions[:, 1], -1, 1)) / np.pi
    rows, columns = SKY.shape[:2]
    return SKY[np.minimum((v * rows).astype(int), rows - 1), np.minimum((u * columns).astype(int), columns - 1)]


def leaving(
    medium: Subsurface,
    corners: np.ndarray,
    places: np.ndarray,
    normals: np.ndarray,
    rng: np.random.Generator,
    *,
    jumps: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Exit radiosity of points and its variance: walks end in the sky, or go into the body again, reflected or refracted."""
    tracer = Tracer(corners)
    body = Body.of(medium, tracer.corners, float(tracer.offset), jumps=jumps)
    count = len(places) * SAMPLES
    place = np.repeat((places - tracer.centre).astype(np.float32), SAMPLES, 0)
    normal = np.repeat(normals.astype(np.float32), SAMPLES, 0)
    outwards = warp.to_world(warp.sample_cosine(rng.random((count, 2), np.float32)), warp.frame(normal))
    inwards, share = entered(outwards, normal, medium.index)
    owner, weight = np.arange(count), np.repeat(share[:, None], 3, 1)
    total = np.zeros((count, 3))
    while len(owner):
        exits = body.walk(place - tracer.offset * normal, inwards, weight, rng)
        owner, weight, out = owner[exits.owner], exits.weight, exits.direction
        normal = tracer.normals[exits.triangle]
        start = tracer.on_triangle(exits.triangle, exits.u, exits.v) + tracer.offset * normal
        again: list[tuple[np.ndarray, ...]] = []
        while len(owner):
            hits = tracer.closest(start, out)
            away = hits.triangle < 0
            total[owner[away]] += weight[away] * sky(out[away])
            kept = np.flatnonzero(hits.front)
            owner, weight, towards, triangle = owner[kept], weight[kept], out[kept], hits.triangle[kept]
            at, normal = tracer.on_triangle(triangle, hits.u[kept], hits.v[kept]), tracer.normals[triangle]
            inwards, share = entered(-towards, normal, medium.index)
            goes_in = rng.random(len(owner)) < share
            again.append((owner[goes_in], weight[goes_in], at[goes_in], normal[goes_in], inwards[goes_in]))
            back = ~goes_in
            cosine = np.einsum("nd,nd->n", towards[back], normal[back])
            out = np.ascontiguousarray(towards[back] - 2 * cosine[:, None] * normal[back])
            owner, weight, start = owner[back], weight[back], at[back] + tracer.offset * normal[back]
        owner, weight, place, normal, inwards = (
            (np.concatenate(column) for column in zip(*again, strict=True)) if again else (owner,) * 5
        )
    values = np.pi * total.reshape(len(places), SAMPLES, 3)
    return values.mean(1), values.var(1) / SAMPLES


def in_mitsuba(medium: Subsurface, corners: np.ndarray) -> Any:
    properties = mi.Properties()
    properties["face_normals"] = True
    matched = medium.index == 1
    surface = {"type": "null"} if matched else {"type": "dielectric", "int_ior": medium.index, "ext_ior": 1.0}
    properties["bsdf"] = mi.load_dict(surface)
    shortest = min(medium.mean_free_path)
    properties["interior"] = mi.load_dict(
        {
            "type": "homogeneous",
            "albedo": {"type": "rgb", "value": list(medium.albedo)},
            "sigma_t": {"type": "rgb", "value": [shortest / length for length in medium.mean_free_path]},
            "scale": 1 / shortest,
            "phase": {"type": "hg", "g": medium.anisotropy},
        }
    )
    mesh = mi.Mesh("body", 3 * len(corners), len(corners), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners.reshape(-1).astype(np.float32)
    parameters["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
    parameters.update()
    light = {"type": "envmap", "bitmap": mi.Bitmap(stepped(SKY, 32)), "scale": 1.0}
    return mi.load_dict({"type": "scene", "light": light, "body": mesh})


def mitsuba_leaving(
    scene: Any, medium: Subsurface, places: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """From outside towards the body; what its surface reflects by itself is left out by weighing with what enters."""
    integrator = mi.load_dict({"type": "volpathmis", "max_depth": -1, "rr_depth": 64})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(int(rng.integers(2**31)))
    found = []
    inside = scene.shapes()[0].interior_medium()
    for place, normal in zip(places, normals, strict=True):
        facing = np.repeat(normal[None].astype(np.float32), SAMPLES, 0)
        outwards = warp.to_world(warp.sample_cosine(rng.random((SAMPLES, 2), np.float32)), warp.frame(facing))
        inwards, share = entered(outwards, facing, medium.index)
        origin = (place - 1e-5 * normal).tolist()
        rays = (
            integrator.sample(scene, sampler, mi.RayDifferential3f(origin, towards), inside)[0] for towards in inwards.tolist()
        )
        # Radiance inside is as many times that outside as the index squared; it comes out with the share that enters.
        values = np.pi * share * np.array([ray[GREEN] for ray in rays]) / medium.index**2
        found.append((values.mean(), values.var() / SAMPLES))
    means, variances = np.array(found).T
    return means, variances


@pytest.mark.parametrize("name", MEDIA)
def test_light_through_a_body_agrees_with_mitsuba(name: str) -> None:
    mi.set_variant("scalar_rgb")
    rng = np.random.default_rng(2)
    corners, medium = body_alone(), MEDIA[name]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    triangle = rng.choice(len(area), POINTS, p=area / area.sum())
    places = np.einsum("nc,ncd->nd", rng.dirichlet(np.ones(3), POINTS), corners[triangle])
    normals = (cross / area[:, None])[triangle]
    theirs, their_variance = mitsuba_leaving(in_mitsuba(medium, corners), medium, places, normals, rng)
    for jumps in (True, False):
        ours, variance = leaving(medium, corners, places, normals, rng, jumps=jumps)
        z = z_scores(np.array([ours[:, GREEN], theirs, variance[:, GREEN], their_variance]))
        print(f"{name}, {'jumps' if jumps else 'every step'}: {len(z)} points, z {z.mean():+.3f} +- {z.std():.3f}; "
              f"means {ours[:, GREEN].mean():.4f}, {theirs.mean():.4f}")  # fmt: skip
        assert len(z) == POINTS
        # 256 scores: the mean is known to 0.0625, the standard deviation to 0.044; four of these each.
        assert abs(z.mean()) < 0.25
        assert abs(z.std() - 1) < 0.18
