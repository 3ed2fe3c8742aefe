"""Glowing meshes as lights: closed forms, the choice of triangles, files, and the same light by other means."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import chi_square, polygon_irradiance
from test_lights import light, sampled

import ddprt
from ddprt.errors import UserError
from ddprt.lights import MeshLight, lighting_json, parse_lighting
from ddprt.lights.mesh import cumulated, invert_triangles, pdf_triangles, sample_triangles
from ddprt.scene.library import build
from ddprt.scene.shapes import icosphere

UP = np.array([0.0, 1.0, 0.0])
SIGNIFICANT = 1e-4
"""Seeds are fixed, so a sound sampler passes always; one that is off by a percent in a bin fails by many decades."""
SIGMAS = 4.0
RECT: dict[str, Any] = {
    "type": "rect",
    "center": [0.2, 0.45, 0.25],
    "half_u": [0.1, 0.0, 0.02],
    "half_v": [0.0, 0.03, 0.06],
    "radiance": [5.0, 4.0, 3.0],
}
POWERS = np.array([1.0, 4.0, 0.0, 2.0, 0.5])


def corners_of(rect: dict[str, Any]) -> np.ndarray:
    u, v = np.array(rect["half_u"]), np.array(rect["half_v"])
    return np.array([-u - v, u - v, u + v, v - u])


def as_mesh(rect: dict[str, Any]) -> dict[str, Any]:
    quad = corners_of(rect)
    triangles = [quad[[0, 1, 2]].tolist(), quad[[0, 2, 3]].tolist()]
    return {"type": "mesh", "mesh": triangles, "position": rect["center"], "radiance": rect["radiance"]}


# --- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [(0.2, 0.0, 0.25), (0.9, 0.1, -0.3), (0.05, 0.3, 0.2), (0.2, 0.3, 0.6)])
@pytest.mark.parametrize("kind", ["rect", "mesh"])
def test_a_rectangle_meets_lamberts_formula_either_way(kind: str, point: tuple[float, float, float]) -> None:
    front = np.cross(RECT["half_u"], RECT["half_v"])
    rect = RECT if front[1] < 0 else {**RECT, "half_u": RECT["half_v"], "half_v": RECT["half_u"]}
    expected = polygon_irradiance(corners_of(rect) + rect["center"], 5.0, np.array(point), UP)
    mean, error = sampled(light(rect if kind == "rect" else as_mesh(rect)), np.array(point), UP, 1 << 17)
    assert 0 < error[0] < 0.02 * expected
    assert abs(mean[0] - expected) < SIGMAS * error[0]


def test_a_tetrahedron_lights_as_the_faces_that_it_shows() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0]], float) * 0.4
    faces = corners[[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]]
    lamp = light({"type": "mesh", "mesh": faces.tolist(), "position": [0.1, 1.0, 0.2], "radiance": [2, 2, 2]})
    point = np.array([0.3, 0.0, 0.4])
    faces += np.array([0.1, 1.0, 0.2])
    across = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    shown = np.einsum("td,td->t", across, point - faces[:, 0]) > 0
    assert 0 < shown.sum() < 4
    expected = sum(polygon_irradiance(face, 2.0, point, UP) for face in faces[shown])
    mean, error = sampled(lamp, point, UP, 1 << 17)
    assert abs(mean[0] - expected) < SIGMAS * error[0] < 0.05 * expected


def test_a_ball_of_triangles_lights_as_a_ball() -> None:
    directions, triangles = icosphere(4)
    position, radius = [0.5, 2.0, -0.3], 0.6
    record = {
        "type": "mesh",
        "mesh": directions[triangles].tolist(),
        "position": position,
        "scale": radius,
        "radiance": [3] * 3,
    }
    squared = float(np.dot(position, position))
    expected = np.pi * 3 * radius**2 / squared * position[1] / np.sqrt(squared)
    mean, error = sampled(light(record), np.zeros(3), UP, 1 << 17)
    # The hull of its corners: an edge spans 2 / (4 * 16) of a turn at most, and lies 1 - cos(half of that) below the ball.
    flat = 1 - np.cos(np.pi / 40)
    assert abs(mean[0] - expected) < SIGMAS * error[0] + 2 * flat * expected


# --- the choice of triangles ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_triangles_are_chosen_by_power_and_points_uniformly(dtype: type) -> None:
    u = np.random.default_rng(0).random((200_000, 2)).astype(dtype)
    triangle, weights = sample_triangles(cumulated(POWERS), u)
    assert weights.dtype == dtype
    part = np.where(weights[:, 0] > 0.5, 1, np.where(weights[:, 1] > 0.5, 2, np.where(weights.sum(1) < 0.5, 3, 0)))
    counts = np.bincount(4 * triangle + part, minlength=20).astype(float)
    expected = np.repeat(POWERS / POWERS.sum() / 4, 4)  # the middles of the edges cut a triangle into four equal ones
    assert not counts[expected == 0].any()
    assert chi_square(counts[expected > 0], expected[expected > 0]) > SIGNIFICANT
    assert chi_square(counts[expected > 0], np.full(16, 1 / 16)) < SIGNIFICANT, "a density that is wrong is noticed"


def test_triangles_there_and_back() -> None:
    u = np.random.default_rng(1).random((2000, 2))
    triangle, weights = sample_triangles(cumulated(POWERS), u)
    # What the choice leaves of a number is stretched by 1 / share <= 15, and shrunk again.
    np.testing.assert_allclose(invert_triangles(cumulated(POWERS), triangle, weights), u, atol=1e-14)


def test_density_counts_to_one() -> None:
    areas = np.array([0.5, 2.0, 1.0, 0.1, 3.0])
    density = pdf_triangles(cumulated(POWERS), areas)
    np.testing.assert_allclose(density * areas, POWERS / POWERS.sum(), atol=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_ends_of_the_unit_square_lie_on_triangles(dtype: type) -> None:
    last = np.nextafter(dtype(1), dtype(0))
    u = np.array([[0, 0], [0, last], [last, 0], [last, last]], dtype)
    triangle, weights = sample_triangles(cumulated(np.array([1.0, 1e-12, 1.0, 0.0])), u)
    np.testing.assert_array_equal(triangle, [0, 0, 2, 2])
    assert (weights >= 0).all()
    assert (weights.sum(1) <= 1).all()


# --- the same light by other means ------------------------------------------------------------------------------------


def test_mesh_and_rectangle_light_a_room_alike() -> None:
    scene = build("cornell")
    rng = np.random.default_rng(3)
    triangle = rng.choice(len(scene.areas), 64, p=scene.areas / scene.areas.sum())
    positions = np.einsum("nc,ncd->nd", rng.dirichlet(np.ones(3), 64), scene.corners[triangle])
    normals = scene.geometric_normals[triangle]
    found = [
        ddprt.irradiance(scene, record, positions, normals, samples=512, seed=seed, return_variance=True)
        for seed, record in enumerate((RECT, as_mesh(RECT)))
    ]
    for part in (0, 1):
        difference, variance = found[0][part] - found[1][part], found[0][part + 2] + found[1][part + 2]
        lit = variance[:, 1] > 0
        z = difference[lit, 1] / np.sqrt(variance[lit, 1])
        assert lit.sum() > 30
        assert abs(z.mean()) * np.sqrt(len(z)) < SIGMAS
        assert np.abs(z).max() < 5.5  # 64 skewed means


# --- files ------------------------------------------------------------------------------------------------------------

OBJ = "v 0 0 0\nv 1 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


@pytest.fixture
def lamp_file(tmp_path: Path) -> Path:
    path = tmp_path / "lamp.obj"
    path.write_text(OBJ)
    return path


def test_a_file_is_scaled_then_turned_then_moved(lamp_file: Path) -> None:
    half = np.sqrt(0.5)
    turned = {"rotation": [0.0, 0.0, half, half], "scale": 0.5}  # a quarter turn about z: x becomes y
    lamp = light({"type": "mesh", "mesh": str(lamp_file), "position": [1, 2, 3], "radiance": [1, 1, 1], **turned})
    assert isinstance(lamp, MeshLight)
    given = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0]])[[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]]
    expected = 0.5 * np.stack([-given[..., 1], given[..., 0], given[..., 2]], -1)
    np.testing.assert_allclose(lamp.shape.corners, expected, atol=1e-15)
    twice = light({**lighting_json((lamp,))[0], "rotation": [0.0, 0.0, 2 * half, 2 * half]})
    np.testing.assert_allclose(twice.shape.corners, expected, atol=1e-15, err_msg="a quaternion of any length")
    centre = np.average(expected.mean(1), axis=0, weights=[1, 1, 1, np.sqrt(3)])
    np.testing.assert_allclose(lamp.anchor(), np.array([1, 2, 3]) + centre, atol=1e-14)
    assert lamp.reach() == pytest.approx(np.linalg.norm(expected - centre, axis=2).max())


def test_what_is_stored_names_the_file_and_what_was_in_it(lamp_file: Path) -> None:
    record = {"type": "mesh", "mesh": str(lamp_file), "position": [0, 1, 0], "radiance": [1, 1, 1]}
    lamp = light(record)
    stored = json.loads(json.dumps(lighting_json((lamp,))))[0]
    assert stored["mesh"] == str(lamp_file)
    assert len(stored["digest"]) == 16
    lamp_file.write_text(OBJ.replace("v 0 1 0", "v 0 2 0"))
    again = light(stored)  # a dataset opens though its lamps are gone
    assert again == lamp
    points, u = np.zeros((1, 3)), np.full((1, 2), 0.5)
    ddprt.lights.mesh._read.cache_clear()
    with pytest.raises(UserError, match="but the light was made of"):
        again.illuminate(points, u)
    lamp_file.unlink()
    with pytest.raises(UserError, match=r"got no file .*lamp\.obj, expected the mesh of a light; check the path"):
        light(stored).illuminate(points, u)


def test_copies_keep_their_shape() -> None:
    lamp = light(as_mesh(RECT))
    moved = lamp.translated(np.array([1.0, 2.0, 3.0])).scaled(2.0)
    np.testing.assert_allclose(moved.anchor(), np.add(RECT["center"], [1, 2, 3]), atol=1e-15)
    assert moved.radiance == (10.0, 8.0, 6.0)
    assert parse_lighting(lighting_json((moved,))) == (moved,)
    assert moved != lamp


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mesh": "nowhere.obj"}, r"lighting\[0\]\.mesh: got no file nowhere\.obj, expected the mesh of a light; check"),
        ({"mesh": "pyproject.toml"}, r"lighting\[0\]\.mesh: pyproject.toml: got suffix"),
        ({"mesh": []}, r"lighting\[0\]\.mesh: got \[\], expected a file or triangles of finite corners; write \[\[\["),
        ({"mesh": [[[0, 0, 0], [1, 0, 0]]]}, "expected a file or triangles"),
        ({"mesh": [[[0, 0, 0], [1, 0, 0], [0, 1, float("nan")]]]}, "expected a file or triangles"),
        ({"mesh": [[[0, 0, 0], [1, 0, 0], [0, 1, "x"]]]}, "expected a file or triangles"),
        ({"mesh": [[[0, 0, 0], [1, 0, 0], [0, 1e13, 0]]]}, "expected a file or triangles"),
        ({"mesh": 7}, r"lighting\[0\]\.mesh: got 7, expected a file or triangles"),
        ({"mesh": [[[0, 0, 0], [1, 0, 0], [2, 0, 0]]]}, "got no triangle with area, expected a surface; check its corners"),
        ({"rotation": [0, 0, 0, 0]}, r"\.rotation: got a quaternion of length 0, expected a turn; write"),
        ({"scale": 0}, r"\.scale: got 0, expected greater than 0; raise it"),
        ({"radiance": [1, -1, 1]}, r"\.radiance\[1\]: got -1"),
    ],
)
def test_bad_meshes_get_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        parse_lighting({**as_mesh(RECT), **changes})
    assert "\n" not in str(caught.value)


def test_readers_are_imported_by_those_who_have_files() -> None:
    code = (
        "import sys; from ddprt.lights import parse_lighting; import numpy as np\n"
        f"parse_lighting({as_mesh(RECT)!r})[0].illuminate(np.zeros((1, 3)), np.zeros((1, 2)))\n"
        "print([m for m in ('trimesh', 'pygltflib', 'ddprt.scene.files') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"
