"""What moves: clips of glTF files beside a slow twin in loops, files as poses, motions in code, and points that ride along."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_scene_files import TRIANGLE, Writer

from ddprt.errors import UserError
from ddprt.sampling.points import Samples, place_samples
from ddprt.sampling.riding import place_riders
from ddprt.scene.atlas import Atlas, build_atlas
from ddprt.scene.gltf_motion import Channel, load_clip
from ddprt.scene.library import build
from ddprt.scene.mesh import Scene
from ddprt.scene.motions import BENT, bent, twisted
from ddprt.scene.poses import Animation, chosen_times, load_animation, posed

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning:dataclasses_json")

FAN = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1, 0], [-1, 1, 0.1], [-1, 0.3, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
JOINTS = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0]])
WEIGHTS = np.array([[0.5, 0.5, 0, 0], [1, 0, 0, 0], [0.25, 0.75, 0, 0], [0.9, 0.1, 0, 0], [1, 0, 0, 0], [0.6, 0.4, 0, 0]])
OFFSETS = np.array([[[0.1, 0.0, 0.3]] * 6, np.linspace(-0.3, 0.3, 18).reshape(6, 3)])
HALF = np.sqrt(0.5)
TURNS = np.array([[0, 0, 0, 1], [0, HALF, 0, HALF]])
"""No turn, and a quarter about y."""


def matrices(writer: Writer, rows: np.ndarray) -> int:
    """An accessor of 4 x 4 matrices, which glTF stores by columns."""
    number = writer.accessor(rows.swapaxes(1, 2).reshape(-1, 1))
    writer.json["accessors"][number] |= {"type": "MAT4", "count": len(rows)}
    return number


def fours(writer: Writer, rows: np.ndarray, kind: str = "<f4") -> int:
    number = writer.accessor(rows.reshape(-1, 1), kind)
    writer.json["accessors"][number] |= {"type": "VEC4", "count": len(rows)}
    return number


def bind() -> np.ndarray:
    found = np.tile(np.eye(4), (2, 1, 1))
    found[1, :3, 3] = [-0.5, 0.25, 0.0]
    return found


def creature(*, weights: np.ndarray = WEIGHTS, joints: np.ndarray = JOINTS, way: str = "LINEAR") -> Writer:
    """Six vertices that two bones bend and two targets blend; bone 1 turns a quarter about y and is moved in a second."""
    writer = Writer()
    targets = [{"POSITION": writer.accessor(part)} for part in OFFSETS]
    attributes = {"JOINTS_0": fours(writer, joints, "|u1"), "WEIGHTS_0": fours(writer, weights)}
    mesh = writer.mesh(positions=FAN, normals=False, indices=None, targets=targets, attributes=attributes)
    writer.json["meshes"][mesh]["primitives"][0]["indices"] = writer.accessor(FACES.ravel(), "<u2")
    writer.json["meshes"][mesh]["weights"] = [0.25, 0.0]
    writer.node(mesh=mesh, skin=0, translation=[7, 7, 7])  # that a bent body does not heed
    tip = writer.node(root=False, translation=[0.5, 0, 0])
    writer.node(children=[tip], translation=[0, 2, 0], scale=[2, 2, 2])
    writer.json["skins"] = [{"joints": [2, tip], "inverseBindMatrices": matrices(writer, bind())}]
    times = writer.accessor(np.array([0.0, 1.0]))

    def rows(values: np.ndarray) -> np.ndarray:
        """With slopes of 0 where there are to be some."""
        still = 0 * values
        return np.stack([still, values, still], 1).reshape(-1, values.shape[-1]) if way == "CUBICSPLINE" else values

    samplers = [
        {"input": times, "output": fours(writer, rows(TURNS)), "interpolation": way},
        {"input": times, "output": writer.accessor(rows(np.array([[0.5, 0, 0], [0.5, 1, 0]]))), "interpolation": way},
        {"input": times, "output": writer.accessor(rows(np.array([[0.0, 0.0], [1.0, 0.5]])).ravel()), "interpolation": way},
    ]
    channels = [
        {"sampler": 0, "target": {"node": tip, "path": "rotation"}},
        {"sampler": 1, "target": {"node": tip, "path": "translation"}},
        {"sampler": 2, "target": {"node": 0, "path": "weights"}},
    ]
    writer.json["animations"] = [{"name": "wave", "channels": channels, "samplers": samplers}]
    return writer


def slow(time: float) -> np.ndarray:
    """The creature at a time, one number after another in float64."""
    angle = time * np.pi / 2
    turned = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    bones = [np.array([[2, 0, 0, 0], [0, 2, 0, 2], [0, 0, 2, 0], [0, 0, 0, 1.0]])]
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = turned, [0.5, time, 0]
    bones.append(bones[0] @ local)
    out = np.zeros((6, 3))
    for v in range(6):
        place = [FAN[v][a] + time * OFFSETS[0, v, a] + 0.5 * time * OFFSETS[1, v, a] for a in range(3)] + [1.0]
        for k in range(4):
            moved = bones[JOINTS[v, k]] @ (bind()[JOINTS[v, k]] @ place)
            for a in range(3):
                out[v, a] += WEIGHTS[v, k] * moved[a]
    return out


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_bones_and_targets_agree_with_loops(tmp_path: Path, time: float) -> None:
    moving = load_animation(creature().glb(tmp_path / "creature.glb"), keys=[0.0, 0.3, 1.0])
    scene = moving.pose(time)
    np.testing.assert_allclose(scene.corners, slow(time)[FACES], atol=1e-6)  # the file holds float32
    np.testing.assert_array_equal(scene.triangles, moving.scene.triangles)
    assert scene.rest is moving.scene
    assert not [note for note in scene.notes if "ignored" in note]


def test_between_keys_the_clip_speaks_not_the_chord(tmp_path: Path) -> None:
    moving = load_animation(creature().glb(tmp_path / "creature.glb"), keys=2)
    np.testing.assert_allclose(moving.times, [0, 1])
    np.testing.assert_allclose(moving.pose(0.5).corners, slow(0.5)[FACES], atol=1e-6)
    assert np.abs(moving.positions.mean(0) - moving.pose(0.5).positions).max() > 0.1
    assert moving.between([0.25, 0.5]) == [0.25, 0.5]


@pytest.mark.parametrize(("way", "share"), [("STEP", 0.0), ("LINEAR", 0.25), ("CUBICSPLINE", 3 / 16 - 2 / 64)])
def test_interpolation_of_a_channel(tmp_path: Path, way: str, share: float) -> None:
    clip = load_clip(creature(way=way).glb(tmp_path / "creature.glb"))
    found = clip.at(0.25).values
    np.testing.assert_allclose(found[1, "translation"], [0.5, share, 0], atol=1e-7)
    np.testing.assert_allclose(found[0, "weights"], [share, 0.5 * share], atol=1e-7)
    angle = share * np.pi / 2
    turn = found[1, "rotation"]
    if way == "CUBICSPLINE":
        plain = (1 - share) * TURNS[0] + share * TURNS[1]
        np.testing.assert_allclose(turn, plain / np.linalg.norm(plain), atol=1e-7)
    else:
        np.testing.assert_allclose(turn, [0, np.sin(angle / 2), 0, np.cos(angle / 2)], atol=1e-7)
    for outside, inside in ((-3.0, 0.0), (9.0, 1.0)):
        np.testing.assert_array_equal(clip.at(outside).values[1, "rotation"], clip.at(inside).values[1, "rotation"])


def test_slopes_of_a_spline_are_per_second() -> None:
    """A cubic is met by a spline that has its values and slopes: t³ - 2t over two seconds."""
    times = np.array([1.0, 3.0])
    slopes, values = 3 * times**2 - 2, times**3 - 2 * times
    channel = Channel(0, "weights", times, np.stack([slopes, values, slopes], 1)[:, :, None], "CUBICSPLINE")
    for time in (1.0, 1.5, 2.2, 3.0):
        assert channel.at(time)[0] == pytest.approx(time**3 - 2 * time, rel=1e-12)


def test_turns_take_the_short_way_at_even_speed() -> None:
    channel = Channel(0, "rotation", np.array([0.0, 1.0]), np.array([[0, 0, 0, 1.0], [0, -HALF, 0, -HALF]]), "LINEAR")
    for time in (0.25, 0.5):
        angle = time * np.pi / 2
        np.testing.assert_allclose(channel.at(time), [0, np.sin(angle / 2), 0, np.cos(angle / 2)], atol=1e-12)


def test_nodes_carry_what_hangs_on_them(tmp_path: Path) -> None:
    writer = Writer()
    child = writer.node(root=False, mesh=writer.mesh(), translation=[1, 0, 0])
    parent = writer.node(children=[child])
    times, turns = writer.accessor(np.array([0.0, 2.0])), fours(writer, TURNS)
    channels = [{"sampler": 0, "target": {"node": parent, "path": "rotation"}}]
    writer.json["animations"] = [{"channels": channels, "samplers": [{"input": times, "output": turns}]}]
    moving = load_animation(writer.glb(tmp_path / "arm.glb"), keys=2)
    np.testing.assert_allclose(moving.times, [0, 2])
    np.testing.assert_allclose(moving.key(0).positions, TRIANGLE + np.array([1, 0, 0]), atol=1e-6)
    # A quarter turn about y takes x to -z.
    np.testing.assert_allclose(moving.key(1).positions, (TRIANGLE + np.array([1, 0, 0]))[:, [2, 1, 0]] * [1, 1, -1], atol=1e-6)
    np.testing.assert_allclose(moving.key(1).normals, [[1, 0, 0]] * 3, atol=1e-6)


def test_weights_of_a_node_count_where_no_channel_moves_them(tmp_path: Path) -> None:
    found = []
    for number, change in enumerate(({}, {"weights": [1.0, 0.5]})):
        writer = creature()
        writer.json["nodes"][0] |= change
        writer.json["animations"][0]["channels"].pop()
        found.append(load_animation(writer.gltf(tmp_path / f"{number}.gltf"), keys=[0.0, 1.0]))
    np.testing.assert_allclose(found[1].key(1).corners, slow(1.0)[FACES], atol=1e-6)
    assert np.abs(found[0].key(1).positions - found[1].key(1).positions).max() > 0.1


def test_weights_that_miss_1_are_scaled_and_told(tmp_path: Path) -> None:
    even = load_animation(creature().glb(tmp_path / "even.glb"), keys=2)
    moving = load_animation(creature(weights=WEIGHTS * 0.5).glb(tmp_path / "half.glb"), keys=2)
    np.testing.assert_allclose(moving.positions, even.positions, atol=1e-6)
    assert sum("6 vertices did not add up to 1" in note for note in moving.scene.notes) == 1
    assert not [note for note in even.scene.notes if "add up" in note]


def spoilt(change: Callable[[dict], object], **more: np.ndarray) -> Callable[[], Writer]:
    def make() -> Writer:
        writer = creature(**more)
        change(writer.json)
        return writer

    return make


def sampler(json: dict, number: int = 0) -> dict:
    return json["animations"][0]["samplers"][number]


def target(json: dict, number: int = 0) -> dict:
    return json["animations"][0]["channels"][number]["target"]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (spoilt(lambda json: json.update(animations=[])), "got no animation"),
        (spoilt(lambda json: json["animations"][0].update(channels=[])), 'animation "wave" without a channel'),
        (spoilt(lambda json: target(json).update(node=9)), "number 9 among nodes"),
        (spoilt(lambda json: target(json).update(path="colour")), 'animation of "colour", expected translation'),
        (spoilt(lambda json: json["animations"][0]["channels"][0].update(sampler=7)), "sampler 7 of 3"),
        (spoilt(lambda json: sampler(json).update(interpolation="WILD")), 'interpolation "WILD"'),
        (spoilt(lambda json: sampler(json).update(input=sampler(json, 2)["output"])), "times do not rise"),
        (spoilt(lambda json: sampler(json, 1).update(interpolation="CUBICSPLINE")), "for 2 keys of an animation, expected 6"),
        (spoilt(lambda json: json["skins"][0].update(joints=[])), "skin without joints"),
        (spoilt(lambda json: json["skins"][0].update(joints=[2])), "2 bind matrices for 1 joints"),
        (spoilt(lambda json: json["skins"][0].update(joints=[2, 77])), "number 77 among nodes"),
        (spoilt(lambda json: json.update(skins=[])), "number 0 among skins"),
        (spoilt(lambda json: json["meshes"][0]["primitives"][0]["attributes"].pop("JOINTS_0")), "no JOINTS_0"),
        (spoilt(lambda json: json["meshes"][0]["primitives"][0]["attributes"].pop("WEIGHTS_0")), "JOINTS_0 without WEIGHTS_0"),
        (spoilt(lambda json: None, joints=JOINTS + 5), "joint 6 of 2"),
        (spoilt(lambda json: None, weights=WEIGHTS * 0), "weights are negative, not finite or all 0"),
        (spoilt(lambda json: None, weights=-WEIGHTS), "weights are negative, not finite or all 0"),
        (spoilt(lambda json: json["meshes"][0]["primitives"][0]["targets"].pop()), "2 weights for 1 morph targets"),
        (spoilt(lambda json: json["nodes"][1].update(children=[2])), "got a damaged file|above itself|twice in the hierarchy"),
    ],
)
def test_faulty_clips_are_refused_in_one_line(tmp_path: Path, make: Callable[[], Writer], says: str) -> None:
    with pytest.raises(UserError, match=says) as caught:
        load_animation(make().gltf(tmp_path / "bad.gltf"), keys=2)
    assert "\n" not in str(caught.value)


def test_clips_by_name(tmp_path: Path) -> None:
    path = creature().glb(tmp_path / "creature.glb")
    assert load_clip(path, "wave").name == load_clip(path, "0").name == "wave"
    with pytest.raises(UserError, match='got "wafe"; did you mean "wave"'):
        load_clip(path, "wafe")


def obj(path: Path, positions: np.ndarray, faces: np.ndarray = FACES) -> Path:
    rows = [f"v {x} {y} {z}" for x, y, z in positions] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_files_are_poses(tmp_path: Path) -> None:
    paths = [obj(tmp_path / f"{k}.obj", FAN + np.array([0, 0, k * k])) for k in range(3)]
    moving = load_animation([*paths])
    np.testing.assert_array_equal(moving.times, [0, 1, 2])
    np.testing.assert_allclose(moving.pose(1.25).corners, (FAN + np.array([0, 0, 1 + 3 * 0.25]))[FACES])
    np.testing.assert_array_equal(moving.key(2).positions, moving.pose(2.0).positions)


def test_poses_that_are_none(tmp_path: Path) -> None:
    first = obj(tmp_path / "a.obj", FAN)
    other = obj(tmp_path / "b.obj", FAN, FACES[[0, 1, 3, 2]])
    flat = obj(tmp_path / "c.obj", FAN * [1, 1, 0])
    table = [
        (lambda: load_animation([]), "empty list"),
        (lambda: load_animation([first, other]), "4 triangles in .*b.obj that are not those of .*a.obj"),
        (lambda: load_animation([first, flat], keys=5), "2 files beside animation.keys = 5"),
        (lambda: load_animation(first), "got one mesh file, expected a .glb or .gltf"),
        (lambda: load_animation("cornell"), 'no scene that moves "cornell"'),
        (lambda: load_animation(tmp_path / "gone.glb"), "no such file"),
        (lambda: load_animation("bending", keys=[0.5, 0.5]), "expected rising seconds from 0 to 1"),
        (lambda: load_animation("bending", keys=[0.5, 1.5]), "expected rising seconds from 0 to 1"),
        (lambda: load_animation("bending", clip="wave"), "animation.clip"),
        (lambda: load_animation("bending", keys=[0.0, 0.5]).pose(0.75), "got 0.75 s, expected 0 to 0.5"),
        (lambda: chosen_times(2, (1.0, 1.0)), "takes no time"),
        (lambda: load_animation([first, first], keys=[0, 10]), r"keys = \[0, 10\].*files are keyframes a second apart"),
        (lambda: load_animation([first, first], keys=-1), "2 files beside animation.keys = -1"),
        (lambda: load_animation([first], keys=True), "1 files beside animation.keys = True"),
        (lambda: load_animation([first], rings=3), "got parameter rings, expected none for files"),
        (lambda: load_animation(None), "load_animation: got None, expected a name"),
        (lambda: load_animation([None, 1]), r"load_animation: got \[None, 1\], expected a name"),
        (lambda: load_animation("bending", fog={"mean_free_path": 1.0}), "fog: got fog about an animation"),
        (lambda: load_animation("bending", keys=-1), "got -1, expected rising seconds.* or a number of keyframes up to 256"),
        (lambda: load_animation("bending", keys=257), "got 257, expected rising seconds"),
        (lambda: load_animation("bending", keys=True), "got True, expected rising seconds"),
        (lambda: load_animation("bending", keys="all"), "got 'all', expected rising seconds"),
        (lambda: load_animation("bending", keys=None), "got None, expected rising seconds"),
        (lambda: load_animation("bending", clip=True), "animation.clip: got True, expected the name or the number"),
        (lambda: load_animation("bending", clip=[1]), r"animation.clip: got \[1\], expected the name or the number"),
        (lambda: posed(build("plates"), np.zeros((3, 3)), "key 1"), r'key 1 of "plates": got shape \(3, 3\)'),
        (lambda: posed(build("plates"), build("plates").positions * np.nan, "key 1"), r"got vertex 0 at \[nan, nan, nan\]"),
        (lambda: posed(build("plates"), [["a"]], "key 1"), "expected an array of numbers"),
        (lambda: posed(build("plates"), build("plates").positions * [0.0, 1, 1], "key 1"), "triangles without area"),
    ]
    for work, says in table:
        with pytest.raises(UserError, match=says) as caught:
            work()
        assert "\n" not in str(caught.value)


def test_odd_settings_are_no_damage_to_a_file(tmp_path: Path) -> None:
    """A sound file is not called damaged for what was asked of it, and a clip is found by its number."""
    writer = creature()
    first = writer.json["animations"][0]
    writer.json["animations"].append({"name": "rise", "channels": first["channels"][1:2], "samplers": first["samplers"]})
    path = writer.glb(tmp_path / "two.glb")
    assert load_animation(path, clip=1).motion(0.5).tolist() == load_animation(path, clip="1").motion(0.5).tolist()
    assert not np.array_equal(load_animation(path, clip=1).positions, load_animation(path, clip=0).positions)
    for keys in (2.5, [0.5, np.nan], [0.0, np.nan, 0.5], [np.nan], -1, [[0.0]], []):
        with pytest.raises(UserError, match=r"animation\.keys: got .*, expected rising seconds from 0 to"):
            load_animation(path, keys=keys)


@pytest.fixture(scope="module")
def arm() -> Animation:
    return load_animation("bending", keys=3, rings=10, around=8)


def test_motions_begin_at_rest_and_keep_their_word(arm: Animation, statue: Scene) -> None:
    np.testing.assert_array_equal(arm.key(0).positions, arm.scene.positions)
    line = np.stack([np.zeros(201), np.linspace(0, 1, 201), np.zeros(201)], 1)
    curve = bent(line, 0.7)
    assert np.linalg.norm(np.diff(curve, axis=0), axis=1).sum() == pytest.approx(1.0, rel=1e-4), "as long as before"
    tip = curve[-1] - curve[-2]
    assert np.arctan2(tip[0], tip[1]) == pytest.approx(0.7 * BENT * (1 - 1 / 400), rel=1e-9)
    turned = twisted(statue.positions, 0.5)
    np.testing.assert_array_equal(turned[:, 1], statue.positions[:, 1])
    np.testing.assert_allclose(np.hypot(*turned[:, [0, 2]].T), np.hypot(*statue.positions[:, [0, 2]].T), rtol=1e-12)
    floor = arm.scene.positions[:, 1] == 0
    assert floor.any()
    np.testing.assert_array_equal(arm.key(2).positions[floor], arm.scene.positions[floor])


def test_charts_ride_on_the_mesh(arm: Animation) -> None:
    rest, moved = (build_atlas(scene, 32) for scene in (arm.scene, arm.key(2)))
    np.testing.assert_array_equal(rest.uv, moved.uv)
    np.testing.assert_array_equal(rest.texel, moved.texel)
    assert moved.area.sum() == pytest.approx(arm.key(2).areas.sum(), rel=1e-9)
    assert not np.allclose(rest.area, moved.area)
    assert len({arm.scene.digest, arm.key(0).digest, arm.key(1).digest}) == 3


def test_points_ride_on_the_mesh(arm: Animation) -> None:
    atlas: Atlas = build_atlas(arm.scene, 32)
    still = place_samples(arm.scene, 40, on="surface", seed=3, atlas=atlas)
    riders = place_riders(arm.scene, 40, seed=3, atlas=atlas)
    at_rest = riders.at(arm.scene.corners)
    assert at_rest.digest == still.digest
    scene = arm.key(2)
    moved = riders.at(scene.corners)
    for k in range(40):
        corners = scene.positions[scene.triangles[riders.triangle[k]]]
        place = sum(riders.weights[k, c] * corners[c] for c in range(3))
        across = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        np.testing.assert_allclose(moved.position[k], place, atol=1e-12)
        np.testing.assert_allclose(moved.normal[k], across / np.linalg.norm(across), atol=1e-12)
    assert moved.spacing == still.spacing


def test_a_sample_stays_with_its_point(arm: Animation) -> None:
    riders = place_riders(arm.scene, 96, seed=3, atlas=build_atlas(arm.scene, 32))
    at_rest, moved = (riders.at(arm.key(index).corners, depth=0.5) for index in (0, 2))
    home = at_rest.nearest_point(12)
    assert at_rest.rest is None
    assert (replace(moved, rest=None).nearest_point(12) != home).any(), "by nearness alone some would change"
    np.testing.assert_array_equal(moved.nearest_point(12), home)
    kept = Samples.read(moved.tensors, moved.spacing, moved.depth)
    np.testing.assert_array_equal(kept.nearest_point(12), home)
    assert kept.digest == moved.digest != replace(moved, rest=None).digest
    assert (kept.depth, kept.spacing) == (0.5, at_rest.spacing)


def test_shading_normals_turn_with_their_faces(statue: Scene) -> None:
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    scene = posed(statue, statue.positions @ turn.T + [1, 2, 3], "turned")
    np.testing.assert_allclose(scene.normals, statue.normals @ turn.T, atol=1e-7)
    opposite = posed(statue, statue.positions * [-1.0, -1.0, 1.0], "half a turn")
    np.testing.assert_allclose(opposite.normals, statue.normals * [-1, -1, 1], atol=1e-6)
