"""What moves without coming apart: one topology in several poses.

Vertices move, triangles stay what they are. So the lightmap is unwrapped once, on the first pose, and rides on the mesh, as
measurement points do (`ddprt.sampling.riding`). Every pose is a `Scene` like any other, that knows the one it is unwrapped on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from ddprt.axes import Float64, Int
from ddprt.config import Config
from ddprt.errors import UserError
from ddprt.scene.checks import FARTHEST, negligible, vertex_normals
from ddprt.scene.files import EXPECTED, load_scene
from ddprt.scene.gltf_motion import Motion, load_moving
from ddprt.scene.library import SCENES
from ddprt.scene.mesh import Scene
from ddprt.scene.motions import MOTIONS
from ddprt.scene.winding import welded

MOST_KEYS = 256
_TORN = 1e-5  # of the radius: files round positions of one vertex alike


@dataclass(frozen=True, eq=False)
class Animation:
    """A scene in several poses; make one with `ddprt.load_animation`.

    Attributes:
      scene: the first pose, and what all have in common.
      times: of the keyframes, seconds, rising.
      positions: of the vertices at these, metres.
      motion: vertices at any time, as the source tells; of a list of files straight lines between them.
    """

    scene: Scene
    times: Float64[np.ndarray, " keys"]
    positions: Float64[np.ndarray, "keys vertices 3"]
    motion: Motion

    @property
    def keys(self) -> int:
        """How many keyframes."""
        return len(self.times)

    def key(self, index: int) -> Scene:
        """The scene at a keyframe."""
        return posed(self.scene, self.positions[index], f"key {index}")

    def pose(self, time: float) -> Scene:
        """The scene at any time between the first key and the last, as the source has it.

        Raises:
          UserError: a time outside of these, or a pose that is none.
        """
        self.check(time)
        found = np.flatnonzero(self.times == time)
        return self.key(int(found[0])) if len(found) else posed(self.scene, self.motion(time), f"the pose at {time:g} s")

    def check(self, time: float) -> None:
        """Refuses a time outside of the keyframes.

        Raises:
          UserError: it is.
        """
        check_time(self.times, time)

    def between(self, fractions: Sequence[float]) -> list[float]:
        """Times that lie so far on the way from each keyframe to the next."""
        pairs = zip(self.times[:-1].tolist(), self.times[1:].tolist(), strict=True)
        return [first + share * (last - first) for first, last in pairs for share in fractions]


def check_time(times: Float64[np.ndarray, " keys"], time: Any) -> float:
    """A time in seconds that lies within some keyframes.

    Raises:
      UserError: it is none, or lies outside of them.
    """
    given = isinstance(time, Real) and not isinstance(time, bool)
    if not given or not times[0] <= time <= times[-1]:
        got = f"{float(time):g} s" if given else _shown(time)
        raise UserError(
            f"time: got {got}, expected {times[0]:g} to {times[-1]:g}, as the keyframes do; give seconds within these"
        )
    return float(time)


def check_pose(
    positions: Any,
    triangles: Int[np.ndarray, "triangles 3"],
    vertices: int,
    name: str,
    do: str = "mend the pose, or take them out of the mesh",
) -> Float64[np.ndarray, "vertices 3"]:
    """Vertices of a mesh in another pose.

    Args:
      positions: what was given for them, metres.
      triangles, vertices: of the mesh.
      name: of the pose, for messages.
      do: about triangles that have lost their area.
    Raises:
      UserError: no numbers, another number of vertices, one that is not finite or too far away, or triangles without area.
    """
    try:
        found = np.asarray(positions, np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name}: got {_shown(positions)}, expected an array of numbers, metres; pass vertices") from None
    if found.shape != (vertices, 3):
        raise UserError(
            f"{name}: got shape {found.shape}, expected {(vertices, 3)}, a row for each vertex as in the first pose; keep them"
        )
    if not (np.abs(found) < FARTHEST).all():
        odd = int(np.flatnonzero(~(np.abs(found) < FARTHEST).all(1))[0])
        raise UserError(
            f"{name}: got vertex {odd} at {found[odd].tolist()}, expected finite metres, nearer than {FARTHEST:g}; mend it"
        )
    if flat := int(np.count_nonzero(negligible(found[triangles]))):
        raise UserError(f"{name}: got {flat} triangles without area that have some in the first pose, expected none; {do}")
    return found


def posed(rest: Scene, positions: Any, name: str) -> Scene:
    """A scene whose vertices have moved; shading normals turn as the faces about their vertex do.

    Args:
      rest: the pose that the lightmap is unwrapped on.
      positions: of its vertices, (vertices, 3), metres.
      name: of the pose, for messages.
    Raises:
      UserError: see `check_pose`.
    """
    moved = check_pose(positions, rest.triangles, len(rest.positions), f'{name} of "{rest.name}"')
    if np.array_equal(moved, rest.positions):
        return replace(rest, rest=rest)
    before, after = vertex_normals(rest.positions, rest.triangles), vertex_normals(moved, rest.triangles)
    return replace(rest, positions=moved, normals=_turned(rest.normals, before, after), rest=rest)


def load_animation(source: Any, *, keys: Any = 0, clip: Any = "", **parameters: Any) -> Animation:
    """A moving scene by name, from the clip of a glTF file, or from files that hold a pose each.

    Args:
      source: a key of `MOTIONS`, a path that ends in .glb or .gltf, or a list of mesh files of one topology, a second apart.
      keys: how many keyframes, evenly over the motion, or their times in seconds; 0 takes 3, or every file of a list.
      clip: name or number of the animation in a glTF file; empty takes the first.
      parameters: numbers that a scene of the library takes.
    Raises:
      UserError: nothing that moves, files of different topology, times that do not rise or lie outside of the motion, poses
        that are none, or what `load_scene` refuses.
    """
    if isinstance(clip, bool) or not isinstance(clip, str | Integral):
        raise UserError(f"animation.clip: got {_shown(clip)}, expected the name or the number of an animation; give one")
    clip = str(clip)
    if "fog" in parameters:
        raise UserError("fog: got fog about an animation, expected clear air; leave it out")
    if not isinstance(source, str | Path):
        return _of_files(source, keys, clip, parameters)
    path = Path(source)
    if path.suffix.lower() in (".glb", ".gltf"):
        if parameters:
            raise UserError(f"{path.name}: got parameter {next(iter(parameters))}, expected none for a file; leave it out")
        return _of_clip(path, keys, clip)
    if str(source) in SCENES or not path.suffix:
        move = MOTIONS[str(source)]
        if clip:
            raise UserError(f'animation.clip: got "{clip}" for "{source}", expected none; leave it out')
        scene = load_scene(source, fog=None, **parameters)
        times = chosen_times(keys, (0.0, 1.0))
        return _made(scene, times, lambda time: move(scene.positions, time), move(scene.positions, float(times[0])))
    raise UserError(
        f"{path.name}: got one mesh file, expected a .glb or .gltf with a clip; give poses as a list: scene.poses = [...]"
    )


def configured_animation(config: Config) -> Animation:
    """The animation of a configuration.

    Raises:
      UserError: see `load_animation`.
    """
    settings, scene = config.animation, config.scene
    source: str | list[str] = list(scene.poses) if scene.poses else scene.name
    parameters = scene.parameters
    if scene.poses and parameters:
        raise UserError("scene.parameters: got some beside scene.poses, expected none for files; leave them out")
    if scene.fog.given:
        raise UserError("scene.fog: got fog about an animation, expected clear air; leave [scene.fog] or [animation] out")
    return load_animation(source, keys=settings.keys, clip=settings.clip, **parameters)


def chosen_times(keys: Any, span: tuple[float, float]) -> Float64[np.ndarray, " keys"]:
    """Times of keyframes.

    Args:
      keys: how many, 0 for 3; or the times themselves.
      span: first and last second of the motion.
    Raises:
      UserError: neither, times that do not rise or lie outside, or several keys of a motion that takes no time.
    """
    if _is_count(keys):
        count = int(keys) or 3
        if count > 1 and span[0] == span[1]:
            raise UserError(f"animation.keys: got {count} of a clip that takes no time, expected 1; set it")
        return np.linspace(span[0], span[1], count) if count > 1 else np.array([span[0]], np.float64)
    try:
        times = np.asarray(keys, np.float64)
        fine = times.ndim == 1 and len(times) > 0 and bool((np.diff(times) > 0).all())
        fine = fine and bool(times[0] >= span[0] and times[-1] <= span[1])
    except (TypeError, ValueError):
        fine = False
    if not fine:
        raise UserError(
            f"animation.keys: got {_shown(keys)}, expected rising seconds from {span[0]:g} to {span[1]:g}, or a number of "
            f"keyframes up to {MOST_KEYS}; mend it"
        )
    return times


def _is_count(keys: Any) -> bool:
    return isinstance(keys, Integral) and not isinstance(keys, bool) and 0 <= int(keys) <= MOST_KEYS


def _shown(value: Any) -> str:
    """What was given, on a line."""
    return " ".join(repr(value).split())[:60]


def _of_clip(path: Path, keys: Any, clip: str) -> Animation:
    if not path.is_file():
        raise UserError(f"{path}: got no such file, expected a mesh; check the path")
    try:
        first = lambda span: float(chosen_times(keys, span)[0])  # noqa: E731
        scene, motion, found = load_moving(path, clip, first)
        return _made(scene, chosen_times(keys, found.span), motion, scene.positions)
    except UserError:
        raise
    except Exception as problem:
        raise UserError(
            f"{path.name}: got a damaged file, expected {EXPECTED['.gltf']} and a clip; export it again, or run with --debug "
            "to see where reading stopped"
        ) from problem


def _of_files(sources: Any, keys: Any, clip: str, parameters: dict[str, Any]) -> Animation:
    if not isinstance(sources, Sequence) or not all(isinstance(source, str | Path) for source in sources):
        raise UserError(
            f"load_animation: got {_shown(sources)}, expected a name of a scene that moves, a .glb or .gltf, or a list of mesh "
            "files; name one"
        )
    if not len(sources):
        raise UserError("scene.poses: got an empty list, expected mesh files of one topology; name at least one")
    if clip or not (_is_count(keys) and keys in (0, len(sources))):
        raise UserError(
            f"scene.poses: got {len(sources)} files beside animation.keys = {_shown(keys)} and clip = {clip!r}, expected "
            "neither, since files are keyframes a second apart; leave both out"
        )
    if parameters:
        raise UserError(f"scene.poses: got parameter {next(iter(parameters))}, expected none for files; leave it out")
    scenes = [load_scene(source) for source in sources]
    for source, scene in zip(sources, scenes, strict=True):
        same = scene.positions.shape == scenes[0].positions.shape and np.array_equal(scene.triangles, scenes[0].triangles)
        if not same or not _hangs_together(scenes[0], scene):
            raise UserError(
                f"scene.poses: got {len(scene.triangles)} triangles in {source} that are not those of {sources[0]} "
                f"({len(scenes[0].triangles)}), expected one topology; export all poses of one mesh without repairs"
            )
    positions = np.stack([scene.positions for scene in scenes])
    times = np.arange(len(sources), dtype=np.float64)

    def straight(time: float) -> np.ndarray:
        k = int(np.clip(np.floor(time), 0, max(0, len(positions) - 2)))
        return positions[k] if time == k else positions[k] + (time - k) * (positions[k + 1] - positions[k])

    return _made(scenes[0], times, straight, positions[0])


def _hangs_together(first: Scene, other: Scene) -> bool:
    """Whether vertices at one place in the first pose are so in another: files tell corners apart that a mesh shares."""
    _, some, number = np.unique(welded(first.positions), return_index=True, return_inverse=True)
    apart = np.abs(other.positions - other.positions[some[number]]).max()
    return bool(apart <= _TORN * other.radius)


def _made(scene: Scene, times: np.ndarray, motion: Motion, first: np.ndarray) -> Animation:
    """Checked in all its keyframes."""
    if scene.tubes is not None:
        raise UserError(f'"{scene.name}": got strands in an animation, expected triangles alone; hair does not move yet')
    rest = scene if np.array_equal(first, scene.positions) else replace(posed(scene, first, "key 0"), rest=None)
    positions = np.stack([rest.positions, *(motion(float(time)) for time in times[1:])])
    found = Animation(rest, times, positions, motion)
    for index in range(1, len(times)):
        found.key(index)
    return found


def _turned(
    normals: Float64[np.ndarray, "vertices 3"],
    before: Float64[np.ndarray, "vertices 3"],
    after: Float64[np.ndarray, "vertices 3"],
) -> Float64[np.ndarray, "vertices 3"]:
    """Normals turned by what takes `before` to `after` the shortest way; half a turn goes through the opposite."""
    cosine = np.einsum("vd,vd->v", before, after)[:, None]
    axis = np.cross(before, after)
    along = np.einsum("vd,vd->v", axis, normals)[:, None]
    turned = cosine * normals + np.cross(axis, normals) + axis * along / np.maximum(1 + cosine, 1e-9)
    turned = np.where(cosine > -1 + 1e-9, turned, -normals)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)
