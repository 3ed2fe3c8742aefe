"""Lights: closed forms, laws, JSON, and records that are refused."""

import json
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
from oracles import above_horizon, chi_square, polygon_irradiance
from pydantic import ValidationError

from ddprt import warp
from ddprt.dataset.splits import doubt, grouped
from ddprt.errors import UserError
from ddprt.lights import LIGHTS, Light, lighting_json, load_lightings, parse_lighting
from ddprt.lights.area import _solid_angle, _turned, invert_rectangle, pdf_rectangle, sample_rectangle
from ddprt.lights.light import Illumination
from ddprt.scene.library import build
from ddprt.transport.embree import Tracer

RECORDS: dict[str, dict[str, Any]] = {
    "point": {"type": "point", "position": [0.3, 1.2, -0.4], "intensity": [1.0, 2.0, 0.5]},
    "spot": {
        "type": "spot",
        "position": [0.3, 1.2, -0.4],
        "direction": [0.1, -2.0, 0.3],
        "intensity": [1.0, 2.0, 0.5],
        "inner_deg": 20.0,
        "outer_deg": 35.0,
    },
    "directional": {"type": "directional", "direction": [0.5, -1.0, 0.2], "irradiance": [3.0, 2.0, 1.0]},
    "rect": {
        "type": "rect",
        "center": [0.3, 1.2, -0.4],
        "half_u": [0.4, 0.0, 0.1],
        "half_v": [0.0, 0.1, 0.3],
        "radiance": [1.0, 2.0, 0.5],
    },
    "sphere": {"type": "sphere", "center": [0.3, 1.2, -0.4], "radius": 0.2, "radiance": [1.0, 2.0, 0.5]},
    "mesh": {
        "type": "mesh",
        "mesh": [[[-0.25, 0.0, -0.25], [0.25, 0.0, -0.25], [0.0, 0.0, 0.5]]],
        "position": [0.3, 1.2, -0.4],
        "radiance": [1.0, 2.0, 0.5],
    },
    "environment": {"type": "environment", "image": "sun-sky", "rotation_deg": 30.0, "scale": 2.0},
}
UP = np.array([0.0, 1.0, 0.0])


def light(record: dict[str, Any], **changes: Any) -> Light:
    return parse_lighting({**record, **changes})[0]


def sampled(lamp: Light, point: np.ndarray, normal: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Mean irradiance at a point and its standard error."""
    u = np.random.default_rng(seed).random((count, 2))
    sample = lamp.illuminate(np.broadcast_to(point, (count, 3)).astype(np.float64), u)
    values = sample.irradiance * np.maximum(sample.direction @ normal, 0)[:, None]
    return values.mean(0), values.std(0) / np.sqrt(count)


# --- closed forms -----------------------------------------------------------------------------------------------------


def test_point_light_falls_with_the_square() -> None:
    lamp = light(RECORDS["point"])
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    away = np.array(RECORDS["point"]["position"]) - points
    r = np.linalg.norm(away, axis=1)
    sample = lamp.illuminate(points, np.zeros((50, 2)))
    np.testing.assert_allclose(sample.irradiance, np.array([1.0, 2.0, 0.5]) / r[:, None] ** 2, rtol=1e-14)
    np.testing.assert_allclose(sample.direction, away / r[:, None], rtol=0, atol=1e-15)
    np.testing.assert_allclose(sample.distance, r, rtol=1e-14)
    mean, _ = sampled(lamp, np.zeros(3), UP, 1)
    distance = np.linalg.norm(RECORDS["point"]["position"])
    np.testing.assert_allclose(mean, np.array([1, 2, 0.5]) * (1.2 / distance) / distance**2, rtol=1e-14)


@pytest.mark.parametrize(
    ("angle", "share"),
    [
        (0.0, 1.0),
        (19.999, 1.0),
        # glTF: clamp((cos a - cos outer) / (cos inner - cos outer))²
        (25.0, ((np.cos(np.radians(25)) - np.cos(np.radians(35))) / (np.cos(np.radians(20)) - np.cos(np.radians(35)))) ** 2),
        (30.0, ((np.cos(np.radians(30)) - np.cos(np.radians(35))) / (np.cos(np.radians(20)) - np.cos(np.radians(35)))) ** 2),
        (35.001, 0.0),
        (90.0, 0.0),
        (180.0, 0.0),
    ],
)
def test_spot_falls_off_as_in_gltf(angle: float, share: float) -> None:
    lamp = light(RECORDS["spot"], position=[0, 0, 0], direction=[0, 0, -3], intensity=[2, 2, 2])
    point = 4 * np.array([[np.sin(np.radians(angle)), 0, -np.cos(np.radians(angle))]])
    irradiance = lamp.illuminate(point, np.zeros((1, 2))).irradiance
    np.testing.assert_allclose(irradiance, np.full((1, 3), 2 / 16 * share), rtol=1e-12, atol=1e-15)


def test_spot_angles_are_half_angles_about_any_axis() -> None:
    lamp = light(RECORDS["spot"])
    axis = np.array(RECORDS["spot"]["direction"]) / np.linalg.norm(RECORDS["spot"]["direction"])
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lit = lamp.illuminate(np.array(RECORDS["spot"]["position"]) + directions, np.zeros((20_000, 2))).irradiance.any(1)
    np.testing.assert_array_equal(lit, directions @ axis > np.cos(np.radians(35)))


def test_directional_light_is_given_on_a_plane_that_faces_it() -> None:
    lamp = light(RECORDS["directional"])
    sample = lamp.illuminate(np.random.default_rng(0).normal(size=(5, 3)), np.zeros((5, 2)))
    towards = -np.array([0.5, -1.0, 0.2]) / np.linalg.norm([0.5, -1.0, 0.2])
    np.testing.assert_allclose(sample.direction, np.tile(towards, (5, 1)), rtol=1e-15)
    np.testing.assert_array_equal(sample.irradiance, np.tile([3.0, 2.0, 1.0], (5, 1)))
    assert np.isinf(sample.distance).all()
    mean, _ = sampled(lamp, np.zeros(3), UP, 1)
    np.testing.assert_allclose(mean, np.array([3, 2, 1]) * towards[1], rtol=1e-14)


RECTS = {
    "ceiling": ([0.1, 2.0, -0.2], [0.7, 0.0, 0.0], [0.0, 0.0, 0.4]),
    "slanted parallelogram": ([0.5, 1.5, 0.3], [0.3, -0.2, 0.1], [0.2, 0.1, 0.6]),
    "close": ([0.0, 0.15, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.5]),
    "half below the horizon": ([0.8, 0.1, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]),
}


@pytest.mark.parametrize("name", RECTS)
def test_rectangle_light_meets_lamberts_formula(name: str) -> None:
    center, half_u, half_v = (np.array(vector) for vector in RECTS[name])
    if np.cross(half_u, half_v) @ center > 0:  # turn the front to the origin
        half_u = -half_u
    corners = np.array([center + a * half_u + b * half_v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    expected = polygon_irradiance(above_horizon(corners, np.zeros(3), UP), 3.0, np.zeros(3), UP)
    lamp = light(RECORDS["rect"], center=center.tolist(), half_u=half_u.tolist(), half_v=half_v.tolist(), radiance=[3, 3, 3])
    mean, error = sampled(lamp, np.zeros(3), UP, 1 << 18)
    assert 0 < error[0] < 0.01 * expected
    assert abs(mean[0] - expected) < 4 * error[0]
    back = light(RECORDS["rect"], center=center.tolist(), half_u=half_v.tolist(), half_v=half_u.tolist(), radiance=[3, 3, 3])
    assert not sampled(back, np.zeros(3), UP, 1000)[0].any()


@pytest.mark.parametrize(
    ("center", "radius"), [((0.0, 2.0, 0.0), 0.5), ((0.5, 1.0, -0.3), 0.9), ((0.0, 1.0, 0.0), 0.999), ((30.0, 40.0, 0.0), 1e-3)]
)
def test_sphere_light_has_a_closed_form(center: tuple[float, float, float], radius: float) -> None:
    """E = pi L sin² cos(theta) for a ball wholly above the horizon: that of a disk of the same outline."""
    distance = np.linalg.norm(center)
    expected = np.pi * 3 * (radius / distance) ** 2 * center[1] / distance
    mean, error = sampled(light(RECORDS["sphere"], center=center, radius=radius, radiance=[3, 3, 3]), np.zeros(3), UP, 1 << 16)
    # Every sample of a far ball has nearly the same cosine: rounding (1e-13 of it) then outweighs the standard error.
    assert abs(mean[0] - expected) < 4 * error[0] + 1e-12 * expected


def test_far_spheres_keep_their_precision_in_float32() -> None:
    lamp = light(RECORDS["sphere"], center=[0, 1000, 0], radius=0.1, radiance=[1, 1, 1])
    sample = lamp.illuminate(np.zeros((4, 3), np.float32), np.random.default_rng(0).random((4, 2), np.float32))
    assert sample.irradiance.dtype == sample.direction.dtype == sample.distance.dtype == np.float32
    np.testing.assert_allclose(sample.irradiance, np.pi * 1e-8, rtol=1e-6)  # ten roundings of 6e-8
    np.testing.assert_allclose(sample.direction[:, 1], 1, atol=1e-6)


def test_shadow_rays_reach_the_near_side_of_a_sphere() -> None:
    u = np.random.default_rng(0).random((1000, 2))
    sample = light(RECORDS["sphere"], center=[0, 2, 0], radius=0.5).illuminate(np.zeros((1000, 3)), u)
    hit = sample.direction * sample.distance[:, None]
    np.testing.assert_allclose(np.linalg.norm(hit - [0, 2, 0], axis=1), 0.5, rtol=1e-6)  # a root near 0 halves the digits
    assert (hit[:, 1] < 2).all()


def test_a_sphere_lights_nothing_inside_itself() -> None:
    points = np.array([[0.3, 1.2, -0.4], [0.35, 1.2, -0.4], [0.3, 1.399, -0.4]])
    sample = light(RECORDS["sphere"]).illuminate(points, np.full((3, 2), 0.3))
    assert not sample.irradiance.any()


# --- near rectangles --------------------------------------------------------------------------------------------------

ENDS = {
    "before the middle": ([-0.7, 0.5], [-0.2, 0.4], 0.3),
    "aside": ([0.2, 1.5], [0.1, 0.9], 0.4),
    "almost touched": ([-1.0, 1.0], [-0.5, 0.5], 0.01),
    "long and thin": ([-4.0, 2.0], [0.3, 0.31], 0.2),
    "edge on": ([0.5, 1.5], [0.5, 1.5], 1e-4),
}


@pytest.mark.parametrize("name", ENDS)
def test_points_of_a_near_rectangle_fit_their_density(name: str) -> None:
    """Shares of 12 x 12 cells against the solid angles of their spherical polygons: interior angles less those of the plane."""
    x, y, z = np.array(ENDS[name][0]), np.array(ENDS[name][1]), ENDS[name][2]
    at = sample_rectangle(x, y, z, np.random.default_rng(4).random((100_000, 2)))
    edges = [np.linspace(*ends, 13) for ends in (x, y)]

    def excess(x0: float, x1: float, y0: float, y1: float) -> mpmath.mpf:
        corners = [mpmath.matrix(corner) for corner in ((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))]
        total = mpmath.mpf(0)
        for a, b, c in ((0, 1, 2), (0, 2, 3)):  # van Oosterom and Strackee 1983
            p, q, r = corners[a], corners[b], corners[c]
            lengths = [mpmath.norm(corner) for corner in (p, q, r)]
            triple = mpmath.det(mpmath.matrix([list(p), list(q), list(r)]))
            rest = (p.T * q)[0] * lengths[2] + (p.T * r)[0] * lengths[1] + (q.T * r)[0] * lengths[0]
            total += 2 * mpmath.atan2(triple, lengths[0] * lengths[1] * lengths[2] + rest)
        return total

    with mpmath.workdps(40):
        expected = np.array([
            [float(excess(edges[0][i], edges[0][i + 1], edges[1][j], edges[1][j + 1])) for j in range(12)] for i in range(12)
        ])  # fmt: skip
        whole = float(excess(*x, *y))
    assert expected.sum() == pytest.approx(whole, rel=1e-12)
    assert chi_square(np.histogram2d(*at.T, edges)[0], expected) > 1e-4
    # Arctangents are good to 1e-16 of a turn, whatever the solid angle.
    assert _solid_angle(*x, *y, z) == pytest.approx(whole, abs=2e-15)
    middle = np.array([[x.mean(), y.mean()]])
    with mpmath.workdps(40):
        tiny = 1e-6 * np.array([x[1] - x[0], y[1] - y[0]])
        ((low, high),) = np.stack([middle - tiny / 2, middle + tiny / 2], 1)
        share = float(excess(low[0], high[0], low[1], high[1])) / whole / tiny.prod()
    np.testing.assert_allclose(pdf_rectangle(x, y, z, middle), share, rtol=1e-6)


@pytest.mark.parametrize("name", ENDS)
def test_points_of_a_near_rectangle_there_and_back(name: str) -> None:
    x, y, z = np.array(ENDS[name][0]), np.array(ENDS[name][1]), ENDS[name][2]
    u = np.random.default_rng(5).uniform(0.01, 0.99, (1000, 2))
    at = sample_rectangle(x, y, z, u)
    assert ((at >= [x[0], y[0]]) & (at <= [x[1], y[1]])).all()
    # Sines within z² of 1 are subtracted from each other on the way there: of 1e-16 each, that leaves 1e-16 / z².
    np.testing.assert_allclose(invert_rectangle(x, y, z, at), u, rtol=0, atol=1e-12 + 1e-15 / z**2)


@pytest.mark.parametrize("height", [0.02, 0.1, 0.4, 1.0, 3.0])
def test_near_rectangles_are_quiet_and_meet_lamberts_formula(height: float) -> None:
    """A sample of a near one brings radiance times solid angle times a cosine: its deviation is that of a cosine, at most 1."""
    record = {"type": "rect", "center": [0.3, height, 0.1], "half_u": [1.0, 0, 0], "half_v": [0, 0, 0.6], "radiance": [2, 2, 2]}
    corners = np.array([[0.3 + a, height, 0.1 + 0.6 * b] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    expected = polygon_irradiance(corners, 2.0, np.zeros(3), UP)
    mean, error = sampled(light(record), np.zeros(3), UP, 1 << 16)
    assert abs(mean[0] - expected) < 4 * error[0]
    assert (
        256 * error[0] < 0.7 * expected
    )  # a cosine's own deviation is 0.58 of its mean on a hemisphere of directions, 1 / sqrt(3)
    turned = {**record, "half_u": [0, 0, 0.6], "half_v": [1.0, 0, 0]}
    assert not sampled(light(turned), np.zeros(3), UP, 100)[0].any(), "its back is dark"


def test_sides_of_near_and_far_give_the_same_light() -> None:
    """Points about 1.5 half-diagonals away, some sampled by area and some by solid angle: all agree with the closed form."""
    lamp = light(RECORDS["rect"], center=[0, 0, 0], half_u=[0.4, 0, 0], half_v=[0, 0, 0.3], radiance=[1, 1, 1])
    corners = np.array([[0.4 * a, 0.0, 0.3 * b] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    for distance in (0.74, 0.76):
        point = distance * np.array([0.6, -0.64, 0.48])
        mean, error = sampled(lamp, point, UP, 1 << 16)
        assert abs(mean[0] - polygon_irradiance(corners, 1.0, point, UP)) < 4 * error[0]
        sample = lamp.illuminate(np.tile(point, (9, 1)), np.random.default_rng(0).random((9, 2)))
        assert (np.ptp(sample.strength) == 0) == (distance < 0.75)
        np.testing.assert_allclose((point + sample.direction * sample.distance[:, None])[:, 1], 0, atol=1e-15)


# --- slow twins -------------------------------------------------------------------------------------------------------


def rectangle_twin(record: dict[str, Any], point: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    half_u, half_v = np.array(record["half_u"]), np.array(record["half_v"])
    away = record["center"] + (2 * u[0] - 1) * half_u + (2 * u[1] - 1) * half_v - point
    distance = float(np.linalg.norm(away))
    across = np.cross(half_u, half_v)
    cosine = max(-away / distance @ across / np.linalg.norm(across), 0)
    return away / distance, distance, np.array(record["radiance"]) * 4 * np.linalg.norm(across) * cosine / distance**2


def sphere_twin(record: dict[str, Any], point: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    away, radius = np.array(record["center"]) - point, record["radius"]
    length = np.linalg.norm(away)
    cap = 1 - np.sqrt(1 - (radius / length) ** 2)
    local = warp.sample_cone(u, cap)
    direction = local @ warp.frame(away / length)
    along = direction @ away
    distance = along - np.sqrt(radius**2 - length**2 + along**2)
    return direction, distance, np.array(record["radiance"]) * 2 * np.pi * cap


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 2e-6), (np.float64, 1e-13)])
@pytest.mark.parametrize(("kind", "twin"), [("rect", rectangle_twin), ("sphere", sphere_twin)])
def test_lights_with_size_agree_with_loops(kind: str, twin: Any, dtype: type, tolerance: float) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-2, 2, (300, 3)).astype(dtype)
    points = points[np.linalg.norm(points - RECORDS[kind]["center"], axis=1) > 0.5]
    u = rng.random((len(points), 2)).astype(dtype)
    fast = light(RECORDS[kind]).illuminate(points, u)
    for i, (point, numbers) in enumerate(zip(points.astype(np.float64), u.astype(np.float64), strict=True)):
        direction, distance, irradiance = twin(RECORDS[kind], point, numbers)
        np.testing.assert_allclose(fast.direction[i], direction, atol=tolerance)
        np.testing.assert_allclose(fast.irradiance[i], irradiance, rtol=tolerance, atol=tolerance)
        # Where a ray grazes the ball the root of a rounding is left: half the digits.
        np.testing.assert_allclose(fast.distance[i], distance, rtol=tolerance if kind == "rect" else np.sqrt(tolerance))


def test_turns_are_good_to_the_last_bit() -> None:
    u = np.concatenate([np.arange(0, 1, 1 / 64), np.nextafter(np.arange(1, 9) / 8, 0), np.random.default_rng(0).random(1000)])
    cosine, sine = np.transpose([_turned(turns) for turns in u])
    # NumPy's cos(2 pi u) would round its argument. Here an eighth of a turn is rounded twice: 1.7e-16, and the results once.
    np.testing.assert_allclose(cosine, [float(mpmath.cospi(2 * turns)) for turns in u], rtol=0, atol=3e-16)
    np.testing.assert_allclose(sine, [float(mpmath.sinpi(2 * turns)) for turns in u], rtol=0, atol=3e-16)


# --- laws of every light ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LIGHTS)
def test_every_light_does_its_duty(kind: str) -> None:
    lamp = light(RECORDS[kind])
    assert isinstance(lamp, Light)
    assert lamp.kind == kind == RECORDS[kind]["type"]
    assert lamp.delta is (kind in ("point", "spot", "directional"))
    place = RECORDS[kind].get("position", RECORDS[kind].get("center"))
    np.testing.assert_array_equal(lamp.anchor(), place)
    with pytest.raises(ValidationError):
        lamp.type = "other"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", LIGHTS)
def test_directions_are_unit_and_nothing_is_negative(kind: str, dtype: type) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (500, 3)).astype(dtype)
    sample = light(RECORDS[kind]).illuminate(points, rng.random((500, 2)).astype(dtype))
    assert sample.irradiance.dtype == sample.direction.dtype == sample.distance.dtype == dtype
    np.testing.assert_allclose(np.linalg.norm(sample.direction, axis=1), 1, atol=8 * np.finfo(dtype).eps)
    assert (sample.irradiance >= 0).all()
    assert (sample.distance >= 0).all()
    assert sample.irradiance.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", LIGHTS)
def test_points_on_the_light_stay_finite(kind: str, dtype: type) -> None:
    lamp = light(RECORDS[kind])
    anchor = lamp.anchor()
    place = np.zeros(3) if anchor is None else anchor
    aside = np.array([1.0, 0, 0])
    points = np.stack([place, place + 1e-20 * aside, place + 0.2 * aside, place * (1 + 1e-7)]).astype(dtype)
    for u in (0.0, 0.5, 0.999):
        sample = lamp.illuminate(points, np.full((4, 2), u, dtype))
        assert np.isfinite(sample.irradiance).all()
        assert np.isfinite(sample.direction).all()


@pytest.mark.parametrize("kind", ["point", "spot", "sphere"])
def test_a_point_on_the_lamp_receives_nothing_in_float32(kind: str) -> None:
    lamp = light(RECORDS[kind])
    assert not lamp.illuminate(lamp.anchor()[None].astype(np.float32), np.full((1, 2), 0.3, np.float32)).irradiance.any()


@pytest.mark.parametrize("kind", LIGHTS)
def test_arrays_may_be_filled_again(kind: str) -> None:
    rng = np.random.default_rng(0)
    points, u = rng.uniform(-2, 2, (2, 500, 3)), rng.random((2, 500, 2))
    fresh = light(RECORDS[kind]).illuminate(points[1], u[1])
    used = light(RECORDS["spot"]).illuminate(points[0], u[0], Illumination.at(points[0]))
    again = light(RECORDS[kind]).illuminate(points[1], u[1], used)
    assert (again is used) is (kind != "environment")
    assert again.direction is used.direction
    for name in ("direction", "distance", "strength", "colour", "irradiance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))


@pytest.mark.parametrize("kind", LIGHTS)
def test_too_much_light_is_infinite_without_a_warning(kind: str) -> None:
    lamp = light(RECORDS[kind]).scaled(1e30)
    near = lamp.anchor() if kind in ("point", "spot") else np.zeros(3)
    points = (near + [[0.01, -0.2, 0.02]] * 3).astype(np.float32)
    with np.errstate(all="raise", under="ignore"):
        assert (lamp.scaled(1e10).illuminate(points, np.full((3, 2), 0.5, np.float32)).irradiance == np.inf).any()


@pytest.mark.parametrize("kind", LIGHTS)
def test_moving_lamp_and_points_together_changes_nothing(kind: str) -> None:
    rng = np.random.default_rng(1)
    points, u, offset = rng.uniform(-1, 1, (40, 3)), rng.random((40, 2)), np.array([0.5, -3.0, 8.0])
    here = light(RECORDS[kind]).illuminate(points, u)
    there = light(RECORDS[kind]).translated(offset).illuminate(points + offset, u)
    # Coordinates near 10 carry 2e-15; the square of a distance of some 0.5 m magnifies it a few times.
    np.testing.assert_allclose(there.irradiance, here.irradiance, rtol=1e-12)
    np.testing.assert_allclose(there.direction, here.direction, atol=1e-13)
    np.testing.assert_allclose(there.distance, here.distance, rtol=1e-12)


@pytest.mark.parametrize("kind", LIGHTS)
def test_scaled_light_scales(kind: str) -> None:
    rng = np.random.default_rng(1)
    points, u = rng.uniform(-1, 1, (40, 3)), rng.random((40, 2))
    once, twice = (light(RECORDS[kind]).scaled(factor).illuminate(points, u) for factor in (1.0, 2.0))
    np.testing.assert_array_equal(twice.irradiance, 2 * once.irradiance)
    np.testing.assert_array_equal(twice.direction, once.direction)
    assert not light(RECORDS[kind]).scaled(0.0).illuminate(points, u).irradiance.any()


# --- JSON -------------------------------------------------------------------------------------------------------------


def test_json_there_and_back(tmp_path: Path) -> None:
    lighting = parse_lighting(list(RECORDS.values()))
    text = json.dumps(lighting_json(lighting))
    assert parse_lighting(json.loads(text)) == lighting
    assert [record["type"] for record in json.loads(text)] == list(RECORDS)
    (tmp_path / "lightings.json").write_text(json.dumps([lighting_json(lighting), lighting_json(lighting[:1])]))
    assert load_lightings(tmp_path / "lightings.json") == [lighting, lighting[:1]]


def test_lights_records_and_lists_are_taken_alike() -> None:
    record = RECORDS["point"]
    lamp = light(record)
    assert parse_lighting(record) == parse_lighting([record]) == parse_lighting(lamp) == parse_lighting((lamp,)) == (lamp,)
    assert parse_lighting([lamp, record]) == (lamp, lamp)


def without(kind: str, key: str) -> dict[str, Any]:
    return {name: value for name, value in RECORDS[kind].items() if name != key}


BAD: list[tuple[Any, str]] = [
    ({**RECORDS["point"], "type": "pont"}, r'\[0\]\.type: got .pont., expected one of .*did you mean "point"'),
    ({**RECORDS["point"], "type": ["point"]}, r"\[0\]\.type: got \[.point.\], expected one of"),
    (
        without("point", "type"),
        r"\[0\]\.type: got None, expected one of directional, environment, mesh, point, rect, sphere, spot",
    ),
    (without("point", "intensity"), r"lighting\[0\]\.intensity: got none, expected it among type, position, intensity; add it"),
    (without("rect", "half_v"), r"\[0\]\.half_v: got none, expected it among type, center, half_u, half_v, radiance; add it"),
    ({**RECORDS["point"], "colour": [1, 1, 1]}, r"\[0\]\.colour: unknown key; known here: type, position, intensity"),
    ({**RECORDS["point"], "positon": [1, 1, 1]}, r'\[0\]\.positon: unknown key; did you mean "position"\?; known here: type'),
    (
        {**RECORDS["point"], "intensity": [1, -1, 1]},
        r"^lighting\[0\]\.intensity\[1\]: got -1, expected greater than or equal to 0; raise it$",
    ),
    ({**RECORDS["point"], "position": 1}, r"\[0\]\.position: got 1, expected a list such as \[0, 1, 0\]; mend it"),
    ({**RECORDS["point"], "position": [0, "x", 0]}, r"\[0\]\.position\[1\]: got 'x', expected number; mend it"),
    ({**RECORDS["sphere"], "radiance": [1, float("nan"), 1]}, r"radiance\[1\]: got nan, expected a finite number; mend it"),
    (
        {**RECORDS["directional"], "irradiance": [1, 1, float("inf")]},
        r"irradiance\[2\]: got inf, expected a finite number; mend it",
    ),
    ({**RECORDS["point"], "position": [0, float("nan"), 0]}, r"position\[1\]: got nan, expected a finite number; mend it"),
    ({**RECORDS["point"], "position": [0, 0]}, r"position: got \[0, 0\], expected at least 3 entries; mend it"),
    ({**RECORDS["point"], "position": [0, 0, 0, 0]}, r"position: got \[0, 0, 0, 0\], expected at most 3 entries; mend it"),
    ({**RECORDS["point"], "position": "here"}, "position: got 'here'"),
    (
        {**RECORDS["directional"], "direction": [0, 0, 0]},
        r"^lighting\[0\]\.direction: got a vector of length 0, .*; give it one",
    ),
    ({**RECORDS["spot"], "direction": [0, 0, 0]}, "direction: got a vector of length 0, expected a direction"),
    (
        {**RECORDS["spot"], "inner_deg": 40},
        r"^lighting\[0\]\.inner_deg: got 40.0, expected less than outer_deg \(35.0\); lower it",
    ),
    ({**RECORDS["spot"], "outer_deg": 91}, "outer_deg: got 91"),
    ({**RECORDS["rect"], "half_u": [0, 0, 0]}, "half_u: got a vector of length 0"),
    (
        {**RECORDS["rect"], "half_u": [0, 0.2, 0.6]},
        r"\[0\]\.half_v: got a vector parallel to half_u, expected a rectangle with area; turn one",
    ),
    ({**RECORDS["sphere"], "radius": 0}, "radius: got 0, .*greater than 0"),
    ({**RECORDS["sphere"], "radius": -1}, "radius: got -1"),
    ("point", "got str, expected a light or a list of lights; write"),
    (None, "got NoneType"),
    (7, "got int"),
    ([], "got no light, expected at least one; write"),
    ((), "got no light, expected at least one"),
    ([RECORDS["point"], 5], r"lighting\[1\]: got 5, expected a light; write \[\{"),
    ([RECORDS["point"], {**RECORDS["point"], "type": "bulb"}], r"lighting\[1\]\.type"),
]


@pytest.mark.parametrize(("records", "message"), BAD)
def test_bad_records_get_one_line(records: Any, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        parse_lighting(records)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("lighting")
    assert "; " in str(caught.value), "what to do"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "got No such file or directory, expected a readable JSON list of lightings; check the path"),
        ("", "got text that is not JSON .*, expected a list of lightings; mend it"),
        ("[[{", "not JSON"),
        (b"\xff\xfe\x00", "not JSON"),
        ("[]", r"got an empty list, expected a list of lightings; write \[\[\{"),
        ("{}", "got dict, expected a list of lightings"),
        ('[[{"type": "lamp"}]]', r"lightings\.json\[0\]\[0\]\.type: got 'lamp'"),
        ("[[]]", r"json\[0\]: got no light, expected at least one"),
        (
            '[[{"type": "point", "position": [0, 0, 0], "intensity": [1, 1, 1]}],'
            ' [{"type": "point", "position": [0, 0, NaN], "intensity": [1, 1, 1]}]]',
            r"json\[1\]\[0\]\.position\[2\]: got nan",
        ),
    ],
)
def test_bad_files_get_one_line(tmp_path: Path, content: str | bytes | None, message: str) -> None:
    path = tmp_path / "lightings.json"
    if content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(UserError, match=message) as caught:
        load_lightings(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("length", [1e-300, 1e-46, 1e-25, 1.0, 1e20, 1e300])
def test_directions_of_any_length_mean_the_same(length: float) -> None:
    points, u = np.zeros((1, 3), np.float32), np.zeros((1, 2), np.float32)
    for record in (
        {"type": "directional", "irradiance": [1, 1, 1]},
        {"type": "spot", "position": [0, 0, 1], "intensity": [1, 1, 1], "inner_deg": 5, "outer_deg": 60},
    ):
        expected, got = (
            parse_lighting({**record, "direction": [0, 0.6 * size, -0.8 * size]})[0].illuminate(points, u)
            for size in (1, length)
        )
        np.testing.assert_allclose(got.irradiance, expected.irradiance, rtol=1e-6)
        np.testing.assert_allclose(got.direction, expected.direction, rtol=1e-6)


def test_reading_a_direction_back_changes_nothing() -> None:
    light = parse_lighting({"type": "directional", "direction": [0.3, -2.1, 0.7], "irradiance": [1, 1, 1]})
    assert parse_lighting(lighting_json(light)) == light


# --- doubts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("height", "why"),
    [
        (0.0, "stands on a surface"),
        (1e-30, "stands on a surface"),
        (-1e-7, "stands on a surface"),  # nearer than a ray's origin is to its surface: neither side is known
        (-1e-3, "stands inside a solid or behind a wall"),
        (1e-3, ""),
    ],
)
def test_a_lamp_on_a_floor_stands_in_no_solid(height: float, why: str) -> None:
    scene = build("cornell")
    low, high = scene.bounds
    lamp = parse_lighting({**RECORDS["point"], "position": [*((low + high) / 2)[:1], low[1] + height, ((low + high) / 2)[2]]})
    assert doubt(lamp, False, scene, Tracer.of(scene)) == why


def test_a_reason_is_told_once() -> None:
    reasons = {
        "0 (train)": "has no intensity",
        "1 (train)": "faces away",
        "2 (test)": "has no intensity",
        "3 (test)": "faces away",
    }
    assert grouped(reasons, 8) == "0 (train), 2 (test): has no intensity; 1 (train), 3 (test): faces away"
    assert grouped(dict.fromkeys("abcd", "faces away"), 2) == "a, b and 2 more: faces away"
    assert grouped({}, 2) == ""
